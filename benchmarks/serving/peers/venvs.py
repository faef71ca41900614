"""A virtual environment for each peer, with the pipeline's libraries at the versions that Streetfix runs with."""

import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

from benchmarks.report import ROOT

FOLDER = ROOT / "data" / "peers"
#: Exact requirements of each peer: the framework and the packages that it serves with.
REQUIREMENTS: dict[str, tuple[str, ...]] = {
    "litserve": (
        "litserve==0.2.19",
        "fastapi==0.165.0",
        "httptools==0.9.0",
        "python-multipart==0.0.34",
        "starlette==1.10.0",
        "uvicorn==0.54.0",
        "uvloop==0.23.0",
    ),
    "bentoml": (
        "bentoml==1.4.39",
        "httptools==0.9.0",
        "python-multipart==0.0.34",
        "starlette==1.10.0",
        "uvicorn==0.54.0",
        "uvloop==0.23.0",
    ),
    "mlserver": (
        "mlserver==1.7.1",
        "fastapi==0.115.14",
        "httptools==0.9.0",
        "orjson==3.13.0",
        "python-multipart==0.0.34",
        "starlette==0.46.2",
        "uvicorn==0.54.0",
        "uvloop==0.23.0",
    ),
    "ray": (
        "ray[serve]==2.60.0",
        "fastapi==0.165.0",
        "httptools==0.9.0",
        "python-multipart==0.0.34",
        "starlette==1.10.0",
        "uvicorn==0.54.0",
        "uvloop==0.23.0",
    ),
}
#: Packages that the pipeline and the contract import. Equal versions keep the comparison fair. Streetfix's gRPC side is
#: left out: it needs a newer protobuf than MLServer.
PIPELINE = (
    "deflate",
    "faiss-cpu",
    "jaxtyping",
    "lz4",
    "numpy",
    "onnxruntime",
    "opencv-python-headless",
    "prometheus-client",
    "pydantic",
    "pydantic-settings",
    "zstandard",
)


class PeerError(Exception):
    """A peer could not be installed, started or queried; the message goes into the report."""


def python_of(name: str, folder: Path = FOLDER) -> Path:
    """Return the interpreter of a peer's environment; create the environment if it differs from the table.

    Args:
        name: name of the peer.
        folder: folder of the environments.

    Raises:
        PeerError: it cannot be installed.
    """
    place = folder / name
    python, stamp = place / "bin" / "python", place / "installed.txt"
    pinned = [f"{each}=={version(each)}" for each in PIPELINE]
    wanted = "\n".join([sys.version, *REQUIREMENTS[name], *pinned]) + "\n"
    if not stamp.exists() or stamp.read_text() != wanted:
        # Do not install Streetfix: a peer runs the code of this checkout by PYTHONPATH, and needs only its imports.
        uv("venv", "--clear", "--python", sys.executable, str(place))
        uv("pip", "install", "--compile-bytecode", "--python", str(python), *REQUIREMENTS[name], *pinned)
        stamp.write_text(wanted)
    return python


def uv(*arguments: str) -> None:
    """Run uv.

    Args:
        *arguments: arguments of uv.

    Raises:
        PeerError: uv is absent, or failed; the message ends with its last output.
    """
    command = [str(Path(sys.executable).with_name("uv")), *arguments, "--quiet"]
    try:
        subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    except FileNotFoundError as error:
        raise PeerError(f"{command[0]} not found; `make .venv/.uv` installs it") from error
    except subprocess.CalledProcessError as error:
        said = " ".join(error.stderr.split())[-300:]
        raise PeerError(f"uv {arguments[0]} failed: {said}") from error
