"""The pipeline in MLServer: ``python -m benchmarks.serving.peers.mlserver_app BUNDLE PORT``.

``parallel_workers`` is 0, so models run in the server's own process
(docs.seldon.ai/mlserver/user-guide/parallel-inference). On one core a second process only adds copies. Batching,
metrics, gzip and access log are off. A custom REST handler takes multipart, because JSON of the V2 protocol would need
base64 for the images. The handler runs in the event loop, as MLServer's own runtimes do without workers.
"""

import json
import os
import sys
from pathlib import Path

from benchmarks.serving.peers.pipeline import PATH, Pipeline, parts_of  # first: it limits the pools
from benchmarks.serving.peers.ports import free_port

from fastapi import Request, Response  # isort: skip
from mlserver import MLModel  # isort: skip
from mlserver.handlers import custom_handler  # isort: skip


class Localization(MLModel):  # type: ignore[misc]  # MLServer is in its own environment
    """Service that takes the parts of a request and returns JSON."""

    async def load(self) -> bool:
        """Open the map."""
        self._pipeline = Pipeline(Path(self.settings.parameters.uri))
        return True

    @custom_handler(rest_path=PATH)  # type: ignore[untyped-decorator]  # MLServer is in its own environment
    async def localize(self, request: Request) -> Response:
        """Localize one query.

        Args:
            request: multipart request.
        """
        async with request.form() as form:
            rgb, depth, asked = [await part.read() for part in parts_of(form)]
        return Response(self._pipeline.answer(rgb, depth, asked), media_type="application/json")


def main() -> None:
    """Write the settings to the current folder, and replace this process by ``mlserver start``."""
    bundle, port = sys.argv[1:]
    settings = {
        "debug": False,
        "parallel_workers": 0,
        "host": "127.0.0.1",
        "http_port": int(port),
        "grpc_port": free_port(),
        "metrics_endpoint": None,
        "gzip_enabled": False,
    }
    model = {
        "name": "streetfix",
        "implementation": "benchmarks.serving.peers.mlserver_app.Localization",
        "parameters": {"uri": bundle},
    }
    Path("settings.json").write_text(json.dumps(settings))
    Path("model-settings.json").write_text(json.dumps(model))
    command = Path(sys.executable).with_name("mlserver")
    os.execv(sys.executable, [sys.executable, str(command), "start", "."])  # noqa: S606  # no shell


if __name__ == "__main__":
    main()
