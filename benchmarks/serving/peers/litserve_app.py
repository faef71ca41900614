"""The pipeline in LitServe: ``python -m benchmarks.serving.peers.litserve_app BUNDLE PORT``.

One inference worker for one core and one API server (lightning.ai/docs/litserve/api-reference/litserver: "for CPU, set to the
number of cores"), no batching, no request tracking, no OpenAPI, warnings alone in the log; files come as multipart, read with
``request["rgb"].file``. Answers go through ZeroMQ (``fast_queue``), advised above a hundred requests a second and no dearer below.
"""

import sys
from pathlib import Path

from benchmarks.serving.peers.pipeline import PATH, Pipeline  # first: it limits the pools

import litserve  # isort: skip
from fastapi import Response  # isort: skip


class Localization(litserve.LitAPI):
    """Parts in, JSON out."""

    def setup(self, device: str) -> None:  # noqa: ARG002  # LitServe's signature
        """Open the map, in the worker."""
        self._pipeline = Pipeline(Path(sys.argv[1]))

    def decode_request(self, request):  # noqa: D102  # an annotation would name a body to FastAPI
        return tuple(request[name].file.read() for name in ("rgb", "depth", "request"))

    def predict(self, x: tuple[bytes, bytes, bytes]) -> bytes:
        """Localize."""
        return self._pipeline.answer(*x)

    def encode_response(self, output: bytes) -> Response:
        """As it is: FastAPI would read the JSON to write it again."""
        return Response(output, media_type="application/json")


def main() -> None:
    """Serve until told to stop."""
    server = litserve.LitServer(
        Localization(api_path=PATH),
        accelerator="cpu",
        devices=1,
        workers_per_device=1,
        disable_openapi_url=True,
        fast_queue=True,
    )
    server.run(
        host="127.0.0.1", port=int(sys.argv[2]), num_api_servers=1, log_level="warning", generate_client_file=False,
        access_log=False,
    )  # fmt: skip


if __name__ == "__main__":
    main()
