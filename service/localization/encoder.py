"""The encoder under ONNX Runtime: planes in, unit descriptors out."""

import hashlib
import os
from pathlib import Path
from typing import Literal

import numpy as np

# Importing ONNX Runtime would else write a device id and an event file into the user's home.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
import onnxruntime
from jaxtyping import Float32
from numpy.typing import NDArray

from service.errors import EncoderError
from service.imaging.view_grid import PLANES

Side = Literal["survey", "query"]
Descriptors = Float32[NDArray[np.float32], "B D"]

#: What runs the network: ONNX Runtime's names of the providers that a setting chooses between.
Provider = Literal["cpu", "cuda", "openvino"]
_PROVIDERS: dict[Provider, str] = {
    "cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider", "openvino": "OpenVINOExecutionProvider",
}  # fmt: skip
#: Packages that bring them, in place of ``onnxruntime``.
_PACKAGES: dict[Provider, str] = {"cpu": "onnxruntime", "cuda": "onnxruntime-gpu", "openvino": "onnxruntime-openvino"}
#: Of one run: whole requests run side by side, and inner pools only get in their way.
THREADS = 1


class Encoder:
    """One encoder for both sides; a session may be used from several threads.

    Build it with ``open``.
    """

    def __init__(self, session: onnxruntime.InferenceSession, sha256: str) -> None:
        self._session = session
        self.sha256 = sha256
        inputs = {i.name: list(i.shape) for i in session.get_inputs()}
        outputs = {o.name: list(o.shape) for o in session.get_outputs()}
        if set(inputs) != {"planes", "side"} or "descriptor" not in outputs or len(inputs["planes"]) != 4:
            raise EncoderError(
                f"the encoder reads {sorted(inputs)} and gives {sorted(outputs)}; wanted: planes, side -> descriptor; "
                "export it with `streetfix export`"
            )
        planes, self.rows, self.columns = inputs["planes"][1:]
        if planes != len(PLANES):
            raise EncoderError(f"the encoder wants {planes} planes, a view has {len(PLANES)}: {', '.join(PLANES)}")
        self.dimension = int(outputs["descriptor"][1])
        #: Cities that the encoder was trained on, as ``KIND-SEED``; empty where the file does not say.
        self.trained_on = tuple(session.get_modelmeta().custom_metadata_map.get("trained_on", "").split())

    @staticmethod
    def open(source: Path | bytes, *, threads: int = THREADS, provider: Provider = "cpu") -> "Encoder":
        """Open an ONNX file, or its bytes.

        Args:
            source: where it is.
            threads: of one run; whole requests run side by side, so one is best for a service.
            provider: what runs it.

        Raises:
            EncoderError: it cannot be read, is no encoder of ours, or the provider is not installed.
        """
        require_provider(provider)
        try:
            data = source if isinstance(source, bytes) else source.read_bytes()
        except OSError as error:  # its text names the file
            raise EncoderError(f"the encoder cannot be read: {error}", field="encoder") from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3
        try:
            session = onnxruntime.InferenceSession(data, options, providers=[_PROVIDERS[provider]])
        except Exception as error:  # ONNX Runtime raises a family of its own that has no common root
            raise EncoderError(f"the encoder is no ONNX model that runs here: {error}", field="encoder") from error
        return Encoder(session, hashlib.sha256(data).hexdigest())

    def encode(self, planes: Float32[NDArray[np.float32], "B 6 rows columns"], side: Side) -> Descriptors:
        """Unit descriptors of views of one side.

        Args:
            planes: as ``service.imaging.view_grid.PLANES`` says, metres, grey levels, spreads.
            side: LiDAR views of the survey, or fused RGB-D queries.
        """
        flags = np.full(len(planes), 1.0 if side == "query" else 0.0, np.float32)
        (descriptors,) = self._session.run(["descriptor"], {"planes": planes, "side": flags})
        result: Descriptors = descriptors
        return result


def require_provider(provider: Provider) -> None:
    """Refuse a provider that this installation of ONNX Runtime does not have; it would fall back to the processor in silence.

    Raises:
        EncoderError: naming those there are.
    """
    there = onnxruntime.get_available_providers()
    if _PROVIDERS[provider] not in there:
        known = ", ".join(name for name, full in _PROVIDERS.items() if full in there)
        raise EncoderError(
            f"provider: ONNX Runtime has no {provider!r} here (it has {known}); install {_PACKAGES[provider]} instead of "
            "onnxruntime, or choose another",
            field="provider",
        )
