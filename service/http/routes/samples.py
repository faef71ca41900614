"""Routes for sample image pairs of the console."""

from typing import Any, Literal

from fastapi import APIRouter
from starlette.responses import FileResponse, Response

from service.console.samples import Samples
from service.contract import schema
from service.http.described import problems
from service.runtime.settings import Settings

_MEDIA_TYPES = ("image/jpeg", "image/png", "image/webp", "image/tiff", "application/octet-stream")
_PICTURE: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The image.",
        "content": {each: {"schema": {"type": "string", "format": "binary"}} for each in _MEDIA_TYPES},
    },
    **problems(404, 422),
}


def router_for(settings: Settings) -> APIRouter:
    """Create the routes for the sample folder of the settings.

    Args:
        settings: of the service.

    Raises:
        DatasetError: the folder is missing, or a pair in it is incomplete.
    """
    router = APIRouter(tags=["console"])
    samples = Samples() if settings.samples is None else Samples.open(settings.samples)

    @router.get("/v1/samples", operation_id="listSamples", summary="List image pairs to try the service with")
    async def list_samples() -> schema.SampleList:
        """List the image pairs in the folder that the setting `samples` names. `streetfix demo` creates some."""
        return schema.SampleList(samples=[each.message() for each in samples.by_name.values()])

    @router.get(
        "/v1/samples/{sample}/{part}",
        operation_id="getSample",
        summary="Get an image of a sample pair",
        response_class=Response,
        responses=_PICTURE,
    )
    async def get_sample(sample: str, part: Literal["rgb", "depth"]) -> Response:
        picture = samples.picture(sample, part)
        return FileResponse(picture.path, media_type=picture.media_type)

    return router
