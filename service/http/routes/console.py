"""The page of the browser console. It requests its data like any other client."""

from fastapi import APIRouter
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from service.console.page import HEADERS, INDEX, BuiltFile, built_files

_YEAR_S = 31_536_000


def router_for() -> APIRouter:
    """Create the routes. The page is the same for every service."""
    router = APIRouter(tags=["console"], include_in_schema=False)
    files = built_files()

    # Redirects are relative, so that a proxy may put the service below a path of its own.
    @router.get("/", operation_id="getRoot")
    async def get_root() -> Response:
        return RedirectResponse(
            "console/", status_code=307, headers=HEADERS
        )  # temporary: the console may be switched off

    @router.get("/console", operation_id="getConsole")
    async def get_console() -> Response:
        return RedirectResponse("console/", status_code=308, headers=HEADERS)

    @router.get("/console/{name:path}", operation_id="getConsoleFile")
    async def get_console_file(name: str, request: Request) -> Response:
        file = files.get(name or INDEX)
        if file is None:
            raise HTTPException(404, "console file not found")
        return _file_response(file, request)

    return router


def _file_response(file: BuiltFile, request: Request) -> Response:
    lasts = f"public, max-age={_YEAR_S}, immutable" if file.lasts else "no-cache"
    headers = HEADERS | {"ETag": file.etag, "Cache-Control": lasts, "Vary": "Accept-Encoding"}
    if request.headers.get("if-none-match") == file.etag:
        return Response(status_code=304, headers=headers)
    if "gzip" in request.headers.get("accept-encoding", ""):
        return Response(file.compressed, media_type=file.media_type, headers=headers | {"Content-Encoding": "gzip"})
    return Response(file.content, media_type=file.media_type, headers=headers)
