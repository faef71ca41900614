"""An HTTP server with the part of Qdrant's REST interface that the adapter uses. Qdrant's own local mode does the work."""

import json
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


class FakeQdrant:
    """A server on loopback.

    Attributes:
        client: the local mode that holds the points.
        requests: method and path of every request, without the name of the collection.
        keys: the key of every request, or None.
        sent: number of points that were stored, with repetitions.
        before: called with the request before it is answered. It may answer itself, and then returns True.
    """

    def __init__(self) -> None:
        from qdrant_client import QdrantClient

        self.client = QdrantClient(":memory:")
        self.requests: list[str] = []
        self.keys: list[str | None] = []
        self.sent = 0
        self.before: Callable[[BaseHTTPRequestHandler], bool] = lambda _: False
        self.url = ""
        self._alone = threading.Lock()  # the local mode is for one thread

    @contextmanager
    def serving(self) -> Iterator["FakeQdrant"]:
        fake = self

        class Handler(BaseHTTPRequestHandler):
            def _answer(self) -> None:
                length = int(self.headers.get("Content-Length") or 0)
                body = json.loads(self.rfile.read(length)) if length else {}
                path = self.path.partition("?")[0].split("/")
                what = f"{self.command} /{'/'.join(path[3:])}"
                fake.requests.append(what)
                fake.keys.append(self.headers.get("api-key"))
                if fake.before(self):
                    return
                try:
                    with fake._alone, warnings.catch_warnings():
                        warnings.simplefilter("ignore")  # local mode has no payload index
                        status, result = 200, fake._result(what, path[2], body)
                except ValueError as error:
                    status, result = 404 if "not found" in str(error) else 400, str(error)
                told = {"result": result, "status": "ok"} if status == 200 else {"status": {"error": result}}
                content = json.dumps({**told, "time": 0.0}).encode()
                self.send_response(status)
                self.send_header("Content-Type", "application/json")
                self.send_header("Content-Length", str(len(content)))
                self.end_headers()
                self.wfile.write(content)

            def do_GET(self) -> None:
                self._answer()

            def do_PUT(self) -> None:
                self._answer()

            def do_POST(self) -> None:
                self._answer()

            def log_message(self, *args: Any) -> None:
                pass

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        self.url = f"http://127.0.0.1:{server.server_port}"
        try:
            yield self
        finally:
            server.shutdown()
            server.server_close()
            thread.join()

    def _result(self, what: str, name: str, body: dict[str, Any]) -> Any:
        from qdrant_client import models

        client, only = self.client, models.Filter.model_validate(body.get("filter") or {})
        if what == "GET /exists":
            return {"exists": client.collection_exists(name)}
        if what == "PUT /":
            made = models.CreateCollection.model_validate(body)
            return client.create_collection(name, vectors_config=made.vectors)
        if what == "GET /":
            return client.get_collection(name).model_dump(mode="json")
        if what == "POST /facet":
            asked = models.FacetRequest.model_validate(body)
            return client.facet(name, asked.key, facet_filter=asked.filter, limit=asked.limit).model_dump(mode="json")
        if what == "PUT /points":
            batch = models.PointsBatch.model_validate(body).batch
            self.sent += len(batch.ids)
            client.upsert(name, batch)
        if what == "POST /points/count":
            return {"count": client.count(name, count_filter=only).count}
        if what == "POST /points/delete":
            client.delete(name, models.FilterSelector(filter=only))
        if what == "POST /points/query":
            asked = models.QueryRequest.model_validate(body)
            found = client.query_points(
                name, query=asked.query, query_filter=asked.filter, limit=asked.limit, with_payload=asked.with_payload
            )
            return found.model_dump(mode="json")
        return {"operation_id": 0, "status": "completed"}
