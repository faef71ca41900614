"""The pipeline in BentoML: ``python -m benchmarks.serving.peers.bentoml_app BUNDLE PORT``.

The settings follow BentoML's documentation. One worker with one thread serves one core (docs.bentoml.com, "Parallelize
requests handling"). The method is synchronous; BentoML runs it beside its event loop. There is no batching. Access log,
metrics and monitoring are off, and tracing excludes the path ("Configurations"). Files come as multipart (``Path``,
"Input and output types"), the JSON as a model that BentoML validates.
"""

import os
import sys
from pathlib import Path

from benchmarks.serving.peers.pipeline import PATH, Pipeline  # first: it limits the pools
from service.contract.schema import LocalizeRequest

import bentoml  # isort: skip
from starlette.responses import Response  # isort: skip

#: BentoML imports this file again in its worker, which does not get our arguments.
BUNDLE = "STREETFIX_PEER_BUNDLE"


@bentoml.service(
    workers=1,
    threads=1,
    traffic={"timeout": 60},
    metrics={"enabled": False},
    monitoring={"enabled": False},
    logging={"access": {"enabled": False}},
    tracing={"excluded_urls": [PATH]},
)
class Localization:
    """Service that takes the parts of a request and returns JSON."""

    def __init__(self) -> None:
        self._pipeline = Pipeline(Path(os.environ[BUNDLE]))

    @bentoml.api(route=PATH)  # type: ignore[untyped-decorator]  # BentoML is in its own environment
    def localize(self, rgb: Path, depth: Path, request: LocalizeRequest):  # type: ignore[no-untyped-def]  # no schema of a response
        """Localize one query.

        Args:
            rgb: file of the RGB image.
            depth: file of the depth image.
            request: the parsed request.
        """
        answer = self._pipeline.answer(rgb.read_bytes(), depth.read_bytes(), request)
        return Response(answer, media_type="application/json")


def main() -> None:
    """Replace this process by ``bentoml serve``."""
    command = Path(sys.executable).with_name("bentoml")
    os.environ[BUNDLE] = sys.argv[1]
    named = f"{Path(__file__).stem}:Localization"
    where = ["--working-dir", str(Path(__file__).parent), "--host", "127.0.0.1", "--port", sys.argv[2]]
    os.execv(sys.executable, [sys.executable, str(command), "serve", named, *where])  # noqa: S606  # no shell


if __name__ == "__main__":
    main()
