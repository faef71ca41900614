"""Which version of the code gave answers that are stored: a hash of its files.

The hash uses Git's hashes of the files. So a commit whose files have the hash can be found without a checkout.
"""

import hashlib
from collections.abc import Iterable
from functools import cache
from pathlib import Path

#: Folders of the code that makes simulated cities and maps and answers queries, relative to the repository or the installation.
ANSWERING = (
    *(f"service/{name}" for name in ("imaging", "geometry", "maps", "registration", "retrieval", "scoring", "confidence", "localization")),
    *(f"model_training/{name}" for name in ("simulation", "datasets", "mapping")),
)  # fmt: skip
#: Folders and files that the answers of the calibration depend on.
CODE = (
    *ANSWERING,
    *(f"model_training/calibration/{name}.py" for name in ("collect", "families", "out_of_map", "plans", "rigs")),
)
#: Endings of the files that count.
ENDINGS = (".py", ".c", ".h", ".onnx")
_ROOT = Path(__file__).resolve().parents[2]


@cache
def code_of_answers(root: Path = _ROOT) -> str:
    """Return the hash of the present code (16 hexadecimal digits).

    Args:
        root: folder that contains the packages.
    """
    return code_of(CODE, root=root)


def code_of(names: Iterable[str], *, endings: tuple[str, ...] = ENDINGS, root: Path = _ROOT) -> str:
    """Return the hash of the present content of files and folders (16 hexadecimal digits).

    Args:
        names: files and folders, relative to ``root``.
        endings: endings of the files that count, some of ``ENDINGS``.
        root: folder that contains the packages.
    """
    found = [root / name for name in names]
    files = [
        path for each in found for path in ([each] if each.is_file() else each.rglob("*")) if path.suffix in endings
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
