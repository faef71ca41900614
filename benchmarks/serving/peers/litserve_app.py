"""The pipeline in LitServe: ``python -m benchmarks.serving.peers.litserve_app BUNDLE PORT``.

One inference worker serves one core, with one API server (lightning.ai/docs/litserve/api-reference/litserver: "for CPU,
set to the number of cores"). Batching, request tracking and OpenAPI are off, and the log holds only warnings. Files
come as multipart, read with ``request["rgb"].file``. Answers go through ZeroMQ (``fast_queue``). LitServe advises
ZeroMQ above a hundred requests per second; below, it costs no more.
"""

import sys
from pathlib import Path

from benchmarks.serving.peers.pipeline import PATH, Pipeline  # first: it limits the pools

import litserve  # isort: skip
from fastapi import Response  # isort: skip


class Localization(litserve.LitAPI):  # type: ignore[misc]  # LitServe is in its own environment
    """Service that takes the parts of a request and returns JSON."""

    def setup(self, device: str) -> None:  # noqa: ARG002  # LitServe's signature
        """Open the map in the worker.

        Args:
            device: unused device name of LitServe.
        """
        self._pipeline = Pipeline(Path(sys.argv[1]))

    def decode_request(self, request):  # type: ignore[no-untyped-def]  # FastAPI would take an annotation for a body's schema
        """Read the three parts of the multipart body.

        Args:
            request: the request of LitServe.
        """
        return tuple(request[name].file.read() for name in ("rgb", "depth", "request"))

    def predict(self, x: tuple[bytes, bytes, bytes]) -> bytes:
        """Localize one query.

        Args:
            x: RGB image, depth image and request, as bytes.
        """
        return self._pipeline.answer(*x)

    def encode_response(self, output: bytes) -> Response:
        """Return the JSON unchanged; FastAPI would parse and write it again.

        Args:
            output: the JSON.
        """
        return Response(output, media_type="application/json")


def main() -> None:
    """Serve until the process is stopped."""
    server = litserve.LitServer(
        Localization(api_path=PATH),
        accelerator="cpu",
        devices=1,
        workers_per_device=1,
        disable_openapi_url=True,
        fast_queue=True,
    )
    server.run(
        host="127.0.0.1",
        port=int(sys.argv[2]),
        num_api_servers=1,
        log_level="warning",
        generate_client_file=False,
        access_log=False,
    )


if __name__ == "__main__":
    main()
