"""Which version of the code gave answers that are stored: a hash of its files.

The hash uses Git's hashes of the files. So a commit whose files have the hash can be found without a checkout.
"""

import hashlib
from collections.abc import Iterable
from functools import cache
from pathlib import Path

#: Folders and files that the answers of the calibration depend on, relative to the repository or the installation.
CODE = (
    *(f"service/{name}" for name in ("imaging", "geometry", "maps", "registration", "retrieval", "scoring", "confidence", "localization")),
    *(f"model_training/{name}" for name in ("simulation", "datasets", "mapping")),
    *(f"model_training/calibration/{name}.py" for name in ("collect", "families", "out_of_map", "plans", "rigs")),
)  # fmt: skip
#: Endings of the files that count.
ENDINGS = (".py", ".c", ".h", ".onnx")
_ROOT = Path(__file__).resolve().parents[2]


@cache
def code_of_answers(root: Path = _ROOT) -> str:
    """Return the hash of the present code (16 hexadecimal digits).

    Args:
        root: folder that contains the packages.
    """
    found = [root / name for name in CODE]
    files = [
        path for each in found for path in ([each] if each.is_file() else each.rglob("*")) if path.suffix in ENDINGS
    ]
    return hash_of((path.relative_to(root).as_posix(), _git_hash(path.read_bytes())) for path in files)


def hash_of(files: Iterable[tuple[str, str]]) -> str:
    """Return the hash of a version (16 hexadecimal digits).

    Args:
        files: path of each file, relative to the repository, and Git's hash of it. Files with other ``ENDINGS`` do not count.
    """
    counted = sorted(f"{path} {git_hash}\n" for path, git_hash in files if path.endswith(ENDINGS))
    return hashlib.sha256("".join(counted).encode()).hexdigest()[:16]


def _git_hash(content: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()
