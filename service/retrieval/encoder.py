"""The encoder under ONNX Runtime: from the planes of a view to a unit descriptor."""

import hashlib
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from service.errors import EncoderError
from service.imaging.view_grid import PLANES
from service.onnx_session import THREADS, Session, installed_providers, session_of

Side = Literal["survey", "query"]
Descriptors = Float32[NDArray[np.float32], "B D"]

#: Execution providers that a setting can choose, and their names in ONNX Runtime.
Provider = Literal["cpu", "cuda", "openvino"]
_PROVIDERS: dict[Provider, str] = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
}
#: Package that contains each provider. It replaces ``onnxruntime``.
_PACKAGES: dict[Provider, str] = {"cpu": "onnxruntime", "cuda": "onnxruntime-gpu", "openvino": "onnxruntime-openvino"}


class Encoder:
    """One encoder for survey views and query views; safe to use from several threads.

    Build it with ``open``.

    Args:
        session: session of ONNX Runtime with the network.
        sha256: hash of the ONNX file.

    Attributes:
        sha256: hash of the ONNX file.
        rows: rows of the views that the encoder reads.
        columns: columns of these views.
        dimension: length of a descriptor.

    Raises:
        EncoderError: the inputs, the outputs or the number of planes are not those of a Streetfix encoder.
    """

    def __init__(self, session: Session, sha256: str) -> None:
        self._session = session
        self.sha256 = sha256
        inputs = {i.name: list(i.shape) for i in session.get_inputs()}
        outputs = {o.name: list(o.shape) for o in session.get_outputs()}
        if set(inputs) != {"planes", "side"} or "descriptor" not in outputs or len(inputs["planes"]) != 4:
            raise EncoderError(
                f"the encoder reads {sorted(inputs)} and returns {sorted(outputs)}, but planes, side -> descriptor are expected; "
                "export it with `streetfix export`"
            )
        planes, self.rows, self.columns = inputs["planes"][1:]
        if planes != len(PLANES):
            raise EncoderError(
                f"the encoder reads {planes} planes, but a view has {len(PLANES)} ({', '.join(PLANES)}); "
                "export it with `streetfix export`"
            )
        self.dimension = int(outputs["descriptor"][1])
        #: Cities of the training data, as ``KIND-SEED``; empty if the file does not name them.
        self.trained_on = tuple(session.get_modelmeta().custom_metadata_map.get("trained_on", "").split())

    @staticmethod
    def open(source: Path | bytes, *, threads: int = THREADS, provider: Provider = "cpu") -> "Encoder":
        """Open an encoder from an ONNX file or from its bytes.

        Args:
            source: path of the file, or its content.
            threads: threads of one run. One is best for a service, because it runs whole requests in parallel.
            provider: execution provider that runs the network.

        Raises:
            EncoderError: the file cannot be read, is no Streetfix encoder, or the provider is not installed.
        """
        require_provider(provider)
        try:
            data = source if isinstance(source, bytes) else source.read_bytes()
        except OSError as error:  # the text of the error names the file
            raise EncoderError(f"the encoder cannot be read ({error}); check the path", field="encoder") from error
        try:
            session = session_of(data, threads=threads, provider=_PROVIDERS[provider])
        except Exception as error:  # the exceptions of ONNX Runtime have no common base class
            raise EncoderError(
                f"ONNX Runtime cannot load the encoder ({error}); export it with `streetfix export`", field="encoder"
            ) from error
        return Encoder(session, hashlib.sha256(data).hexdigest())

    def encode(self, planes: Float32[NDArray[np.float32], "B 6 rows columns"], side: Side) -> Descriptors:
        """Compute the unit descriptors of views of one side.

        Args:
            planes: planes of each view, in the order and units of ``service.imaging.view_grid.PLANES``.
            side: "survey" for LiDAR views, "query" for fused RGB-D views.
        """
        flags = np.full(len(planes), 1.0 if side == "query" else 0.0, np.float32)
        (descriptors,) = self._session.run(["descriptor"], {"planes": planes, "side": flags})
        result: Descriptors = descriptors
        return result


def require_provider(provider: Provider) -> None:
    """Refuse a provider that is not installed.

    ONNX Runtime itself would use the CPU instead, without an error.

    Args:
        provider: execution provider.

    Raises:
        EncoderError: the provider is not installed. The error names the installed ones.
    """
    available = installed_providers()
    if _PROVIDERS[provider] not in available:
        known = ", ".join(name for name, full in _PROVIDERS.items() if full in available)
        raise EncoderError(
            f"provider: ONNX Runtime lacks {provider!r} (available: {known}); install {_PACKAGES[provider]} instead of "
            "onnxruntime, or choose another provider",
            field="provider",
        )
