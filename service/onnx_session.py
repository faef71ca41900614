"""Open a network under ONNX Runtime."""

import os
from typing import Any, TypeAlias

# Otherwise the import of ONNX Runtime writes a device id and an event file into the home folder of the user.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
import onnxruntime

#: A network that is ready to run: ``onnxruntime.InferenceSession``, which has no types.
Session: TypeAlias = Any
#: Threads of one run. The service runs whole requests in parallel, and inner thread pools would compete with them.
THREADS = 1


def session_of(data: bytes, *, threads: int = THREADS, provider: str = "CPUExecutionProvider") -> Session:
    """Open a network. Errors of ONNX Runtime have no common base class, so callers catch ``Exception``.

    Args:
        data: content of an ONNX file.
        threads: threads of one run. One is best for a service, because it runs whole requests in parallel.
        provider: execution provider, as ONNX Runtime names it.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(data, options, providers=[provider])


def installed_providers() -> list[str]:
    """Return the execution providers of the installed ONNX Runtime, as it names them."""
    found: list[str] = onnxruntime.get_available_providers()
    return found
