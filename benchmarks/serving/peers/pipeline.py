"""The pipeline that every peer hosts: ``benchmarks.serving.bare`` with the service's own parsing and writing.

It runs in a peer's environment, so it imports the core and the contract, but no request handler.
"""

from collections.abc import Iterator
from pathlib import Path

from starlette.datastructures import FormData, UploadFile

from service.runtime.threads import limit_pools, limit_pools_before_import

limit_pools_before_import()

from service.contract.convert import answer_from, parsed, query_from  # noqa: E402  # after the pools' limits
from service.contract.schema import LocalizeRequest  # noqa: E402  # after the pools' limits
from service.imaging.decode import decode_depth, decode_rgb  # noqa: E402
from service.localization.localizer import Localizer  # noqa: E402
from service.maps.reader import MapBundle  # noqa: E402
from service.retrieval.encoder import Encoder  # noqa: E402
from service.retrieval.query import Query  # noqa: E402
from service.runtime.engine import Located  # noqa: E402

#: Path of every peer, so that one load generator sends the same bytes to all.
PATH = "/v1/localize"


def parts_of(form: FormData) -> Iterator[UploadFile]:
    """Yield the parts of a multipart request: RGB image, depth image, request.

    Args:
        form: the parsed body.

    Raises:
        TypeError: a part is not a file.
    """
    for name in ("rgb", "depth", "request"):
        part = form[name]
        if not isinstance(part, UploadFile):
            raise TypeError(f"{name}: a text field, not a file; send the part with a file name")
        yield part


class Pipeline:
    """An open map that answers requests.

    Args:
        bundle: the map.
    """

    def __init__(self, bundle: Path) -> None:
        limit_pools()
        self._bundle = MapBundle.open(bundle)
        self._localizer = Localizer(self._bundle, Encoder.open(self._bundle.encoder_bytes()))

    def answer(self, rgb: bytes, depth: bytes, request: LocalizeRequest | bytes) -> bytes:
        """Return the JSON of REST's answer to the three parts of its body.

        Args:
            rgb: encoded RGB image.
            depth: encoded depth image.
            request: the JSON of the request, or the parsed request.
        """
        read = parsed(request, LocalizeRequest) if isinstance(request, bytes) else request
        asked = query_from(read, rgb=rgb, depth=depth)
        depth_m = decode_depth(
            depth,
            camera=asked.camera,
            encoding=asked.depth_encoding,
            scale_m=asked.scale_m,
            kind=asked.depth_kind,
            baseline_m=asked.baseline_m,
            max_range_m=asked.max_range_m,
        )
        query = Query(
            rgb=decode_rgb(rgb),
            depth_m=depth_m,
            camera=asked.camera,
            neighbours=asked.neighbours,
            refine=asked.refine,
            baseline_m=asked.baseline_m,
        )
        answer = answer_from(Located(self._localizer.localize(query), self._bundle))
        return answer.model_dump_json(by_alias=True).encode()
