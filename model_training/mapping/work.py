"""The finished parts of a build, kept beside its output until it is whole: a killed build goes on where it was.

Beside ``maps/town`` they lie in ``maps/.town.building``; a service that mounts ``maps`` looks at no name with a dot. Each part is a
file that is there whole or not at all, and its name carries a hash of all that it was made of: what was made of other scans,
another encoder, with other settings or by other code is never taken.
"""

import fcntl
import hashlib
import json
import os
import shutil
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

import model_training
import service
from model_training.datasets.dataset import Dataset
from model_training.datasets.files import reading
from model_training.mapping.settings import BuildSettings
from service.errors import BundleError

Arrays = dict[str, NDArray[Any]]
#: Settings that no part depends on.
_NOT_IN_PARTS = ("name", "licence", "calibration", "passes_vote")
#: Code that parts are made by.
_CODE = (
    (model_training, ("mapping", "datasets")),
    (service, ("imaging", "geometry", "registration", "localization", "maps")),
)


class Work:
    """Finished parts of one build.

    Args:
        folder: where they lie.
        key: hash of what they are made of.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self.folder, self.key = folder, key

    def part(self, name: str, make: Callable[[], Arrays]) -> Arrays:
        """The part of that name: as it was kept, or made now and kept."""
        path = self.folder / f"{name}-{self.key}.npz"
        kept = _read(path)
        if kept is None:
            kept = make()
            _write(path, kept)
        return kept


@contextmanager
def work_beside(out: Path, key: str) -> Iterator[Work]:
    """Give the work folder of an output; it goes when the work is done, and stays when it is not.

    Args:
        out: the bundle's folder.
        key: hash of what it is made of; parts of another key are removed.

    Raises:
        BundleError: another process works on the same output, or the folder cannot be written.
    """
    folder = work_folder(out)
    try:
        lock = _locked(folder, out)
    except OSError as error:
        raise BundleError(
            f"{folder}: the build's work cannot be kept ({error.strerror}); make room or choose another folder", field="out"
        ) from error  # fmt: skip
    with lock:
        for path in folder.iterdir():
            if path.name != _LOCK and not path.name.endswith(f"-{key}.npz"):
                path.unlink()
        for partial in out.parent.glob(
            f".{out.name}.*.partial"
        ):  # of a writer that was killed; nobody else holds the lock
            shutil.rmtree(partial)
        try:
            yield Work(folder, key)
        except BaseException:
            if [path.name for path in folder.iterdir()] == [_LOCK]:  # nothing was finished, nothing is kept
                shutil.rmtree(folder)
            raise
        shutil.rmtree(folder)


def work_folder(out: Path) -> Path:
    """Where the parts of a build lie."""
    return out.parent / f".{out.name}.building"


def key_of(
    dataset: Dataset, encoder_sha256: str, settings: BuildSettings, *, threads: int, held_out: int = 0, **more: str
) -> str:
    """Hash of all that the parts of a build are made of.

    Args:
        dataset: its description, poses, and its scans' names, sizes and times of change.
        encoder_sha256: of the encoder.
        settings: those that parts depend on.
        threads: of the encoder: sums of another order round otherwise.
        held_out: how many places the site check holds out.
        more: what else there is.
    """
    folder = dataset.folder / "survey" / "scans"
    with reading(folder):
        scans = sorted(
            (scan.name, scan.stat().st_size, scan.stat().st_mtime_ns) for scan in os.scandir(folder)
        ) if folder.is_dir() else []  # fmt: skip
    chosen = {name: value for name, value in asdict(settings).items() if name not in _NOT_IN_PARTS}
    made_of = {
        "dataset": [type(dataset).__qualname__, dataset.description.model_dump(mode="json"), scans],
        "poses": hashlib.sha256(dataset.survey_poses().tobytes()).hexdigest(),
        "encoder": encoder_sha256, "settings": chosen, "threads": threads, "held_out": held_out, "code": _code(), "more": more,
    }  # fmt: skip
    return hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()[:24]


@cache
def _code() -> str:
    found = hashlib.sha256(" ".join(version(name) for name in ("numpy", "onnxruntime", "faiss-cpu")).encode())
    for package, folders in _CODE:
        for folder in folders:
            for path in sorted((Path(package.__path__[0]) / folder).iterdir()):
                if path.suffix in (".py", ".so"):
                    found.update(path.name.encode() + path.read_bytes())
    return found.hexdigest()


_LOCK = "lock"


def _locked(folder: Path, out: Path) -> IO[str]:
    """Take the lock: the system gives it back however its holder ends, so what a killed build left is simply taken over."""
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / _LOCK
        lock = path.open("a+")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            lock.seek(0)
            holder = lock.read().strip() or "?"
            lock.close()
            raise BundleError(
                f"{out}: process {holder} is building it already; wait for it, or end it first", field="out"
            ) from error
        if path.exists() and os.fstat(lock.fileno()).st_ino == path.stat().st_ino:
            lock.truncate(0)
            lock.write(str(os.getpid()))
            lock.flush()
            return lock
        lock.close()  # its holder has just finished and removed the folder


def _read(path: Path) -> Arrays | None:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return dict(arrays)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None  # a machine that lost power: the part is made again, which is all that could be done about it


def _write(path: Path, arrays: Arrays) -> None:
    part = path.with_suffix(".part")
    try:
        with part.open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]  # numpy's stub takes ``allow_pickle`` for one of the arrays
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        raise BundleError(
            f"{path.parent}: the build's work cannot be kept ({error.strerror}); make room or choose another folder", field="out"
        ) from error  # fmt: skip
