"""A dataset's queries as requests, encoded once so that a load generator only sends bytes."""

import json
import uuid
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset, QueryFrame
from model_training.datasets.files import read_bytes
from service.client.grpc_messages import DEPTH_KINDS
from service.errors import DatasetError
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.imaging.depth_formats import read_depth_values
from service.imaging.picture_headers import DEFAULT_LIMITS
from service.imaging.raw16 import write_raw16


@dataclass(frozen=True, slots=True, eq=False)
class Payload:
    """One request.

    Attributes:
        body: multipart/form-data for REST.
        content_type: content type of the body.
        message: the same request for gRPC.
        true_m: position of the camera, metres, map frame; None without ground truth.
    """

    body: bytes
    content_type: str
    message: pb.LocalizeRequest
    true_m: Float64[NDArray[np.float64], "3"] | None


def payloads(
    dataset: Dataset, queries: str | None, *, map_name: str | None, refine: bool, most: int, cheap_depth: bool = False
) -> list[Payload]:
    """Encode the requests of a query set, in its order.

    Args:
        dataset: an open dataset.
        queries: name of a set; None takes the first one with ground truth, else the first.
        map_name: name of the map; None if the service has one.
        refine: whether to request registration.
        most: largest number of requests, evenly spread.
        cheap_depth: whether to send depth as raw16+lz4, the cheapest to encode and decode, instead of the file.

    Raises:
        DatasetError: there is no such set, it is empty, or its depth does not fit raw16.
    """
    names = dataset.query_sets(with_truth=True) or dataset.query_sets()
    if not names or queries not in (None, *dataset.query_sets()):
        known = ", ".join(dataset.query_sets()) or "none"
        raise DatasetError(
            f"{dataset.folder}: query set {queries or '(any)'} not found; the dataset has: {known}", field="queries"
        )
    frames = list(dataset.queries(queries or names[0]))
    if not frames:
        raise DatasetError(f"{dataset.folder}: the query set {queries or names[0]} is empty", field="queries")
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(most, len(frames))).round().astype(int))
    return [_payload(frames[k], map_name, refine, cheap_depth) for k in chosen]


def _payload(frame: QueryFrame, map_name: str | None, refine: bool, cheap_depth: bool) -> Payload:
    rgb, depth, spec = read_bytes(frame.rgb_path), read_bytes(frame.depth_path), frame.camera.depth
    if cheap_depth:
        depth = _as_raw16(depth, frame)
    document: dict[str, Any] = frame.request() | {"options": {"refine": refine}}
    if map_name is not None:
        document["map"] = map_name
    boundary = uuid.uuid4().hex
    parts = {"rgb": rgb, "depth": depth, "request": json.dumps(document).encode()}
    body = b"".join(
        f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"; filename="{name}"\r\n\r\n'.encode()
        + content
        + b"\r\n"
        for name, content in parts.items()
    )
    message = pb.LocalizeRequest(
        rgb=rgb,
        depth=depth,
        camera=pb.Camera(**document["camera"]),
        map=map_name,
        options=pb.Options(refine=refine),
        depth_format=pb.DepthFormat(
            scale_m=spec.scale_m, kind=DEPTH_KINDS[spec.kind], baseline_m=spec.baseline_m, max_range_m=spec.max_range_m
        ),
    )
    true_m = None if frame.T_map_camera is None else frame.T_map_camera[:3, 3].copy()
    return Payload(body + f"--{boundary}--\r\n".encode(), f"multipart/form-data; boundary={boundary}", message, true_m)


def _as_raw16(depth: bytes, frame: QueryFrame) -> bytes:
    values = read_depth_values(depth, encoding=None, limits=DEFAULT_LIMITS)
    if values.dtype != np.uint16:
        raise DatasetError(
            f"{frame.depth_path}: raw16 needs 16-bit values, but these are {values.dtype}; send the depth file "
            "unchanged",
            field="cheap_depth",
        )
    return write_raw16(values, "lz4")
