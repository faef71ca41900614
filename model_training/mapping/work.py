"""Store the finished parts of a build beside its output until the output is complete, so a killed build can continue.

The parts of ``maps/town`` lie in ``maps/.town.building``. A service that mounts ``maps`` ignores names that start with a dot. A part is a
file that exists complete or not at all. Its name contains a hash of all inputs. So a build never uses a part from other scans, another
encoder, other settings or other code.
"""

import fcntl
import hashlib
import json
import os
import shutil
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

import model_training
import service
from model_training.datasets.dataset import Dataset
from model_training.mapping.settings import BuildSettings
from service.errors import BundleError

#: Arrays of a part, by name.
Arrays = dict[str, NDArray[Any]]
#: Number of scans whose results are stored as one part.
CHUNK = 64
#: Settings that no part depends on.
_NOT_IN_PARTS = ("name", "licence", "calibration", "passes_vote")
#: Folders of the code that computes parts.
_CODE = (
    (model_training, ("mapping", "datasets")),
    (service, ("imaging", "geometry", "registration", "retrieval", "scoring", "confidence", "localization", "maps")),
)


class BuildCache:
    """The store for the finished parts of one build.

    Args:
        folder: folder of the parts.
        key: hash of all inputs of the build.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self.folder, self.key = folder, key

    def part(self, name: str, make: Callable[[], Arrays]) -> Arrays:
        """Return a part from the store; if it is missing or damaged, compute and store it.

        Args:
            name: name of the part.
            make: computes the part.

        Raises:
            BundleError: the part cannot be written.
        """
        path = self.folder / f"{name}-{self.key}.npz"
        kept = _read(path)
        if kept is None:
            kept = make()
            _write(path, kept)
        return kept

    def chunks(
        self, name: str, scans: int, make: Callable[[range], Arrays], report: Callable[[int], None] = lambda _: None
    ) -> Iterator[Arrays]:
        """Yield the parts of a stage that goes through the scans, ``CHUNK`` scans in each, in order.

        Args:
            name: name of the stage.
            scans: number of scans.
            make: computes the part of some scans, given by their indices.
            report: called after every part, computed or read, with the number of scans so far.

        Raises:
            BundleError: a part cannot be written.
        """
        for first in range(0, scans, CHUNK):
            span = range(first, min(first + CHUNK, scans))
            found = self.part(f"{name}-{first:07d}", partial(make, span))
            report(span.stop)
            yield found


@contextmanager
def work_beside(
    out: Path, key: str, *, also: Callable[[str], bool] = lambda _: False, wait_s: float = 0.0
) -> Iterator[BuildCache]:
    """Provide the store of an output as a context, locked against other processes.

    The folder is removed at the end of the context. After an exception it stays if it holds a finished part.

    Args:
        out: folder of the bundle.
        key: hash of all inputs of the build. Parts of another key are removed.
        also: returns whether something else with a given name may stay in the folder.
        wait_s: how long to wait for another process that works on the output, seconds.

    Raises:
        BundleError: another process works on the same output, or the folder cannot be written.
    """
    folder = work_folder(out)
    try:
        lock = _locked(folder, out, wait_s)
    except OSError as error:
        raise BundleError(
            f"{folder}: the intermediate results of the build cannot be stored ({error.strerror}); free "
            "disk space or choose another folder",
            field="out",
        ) from error
    with lock:
        for path in folder.iterdir():
            if path.name != _LOCK and not path.name.endswith(f"-{key}.npz") and not also(path.name):
                remove(path)
        # A killed writer left these folders. No other process uses them, because this one holds the lock.
        for partial in out.parent.glob(f".{out.name}.*.partial"):
            shutil.rmtree(partial)
        try:
            yield BuildCache(folder, key)
        except BaseException:
            if [path.name for path in folder.iterdir()] == [_LOCK]:  # no part is finished
                shutil.rmtree(folder)
            raise
        shutil.rmtree(folder)


def remove(path: Path) -> None:
    """Remove a file or a folder with all that it contains.

    Args:
        path: the file or folder.
    """
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def work_folder(out: Path) -> Path:
    """Return the folder of the parts of a build.

    Args:
        out: folder of the bundle.
    """
    return out.parent / f".{out.name}.building"


def key_of(
    dataset: Dataset, encoder_sha256: str, settings: BuildSettings, *, threads: int, held_out: int = 0, **more: str
) -> str:
    """Return a hash of all inputs that the parts of a build depend on, the code included.

    The code counts byte by byte: every ``.py`` and ``.so`` file in the folders of ``_CODE``. So a new comment gives a new hash too. The
    versions of NumPy, ONNX Runtime and Faiss count as well.

    Args:
        dataset: the dataset. Its type, description and poses count, and the names, sizes and modification times of its scans.
        encoder_sha256: SHA-256 of the encoder, hexadecimal.
        settings: settings of the map. Only those count that parts depend on.
        threads: number of threads of the encoder. It changes the order of sums, so it changes their rounding.
        held_out: number of places that the site check holds out.
        more: further inputs, by name.

    Raises:
        DatasetError: the folder of the scans cannot be read.
    """
    chosen = {name: value for name, value in asdict(settings).items() if name not in _NOT_IN_PARTS}
    made_of = {
        "dataset": [
            type(dataset).__qualname__,
            dataset.description.model_dump(mode="json"),
            sorted(dataset.scan_files()),
        ],
        "poses": hashlib.sha256(dataset.survey_poses().tobytes()).hexdigest(),
        "encoder": encoder_sha256,
        "settings": chosen,
        "threads": threads,
        "held_out": held_out,
        "code": _code(),
        "more": more,
    }
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
#: Time between two attempts to take a lock, seconds.
_AGAIN_S = 0.1


def _locked(folder: Path, out: Path, wait_s: float) -> IO[str]:
    """Take the lock of a work folder; wait some seconds for another holder.

    The operating system releases the lock however its holder ends. So a new build can take over the folder of a killed one.
    """
    until = time.monotonic() + wait_s
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / _LOCK
        lock = path.open("a+")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if time.monotonic() < until:
                lock.close()
                time.sleep(_AGAIN_S)
                continue
            lock.seek(0)
            holder = lock.read().strip() or "?"
            lock.close()
            raise BundleError(
                f"{out}: process {holder} already builds this map; wait until it ends, or stop it", field="out"
            ) from error
        if path.exists() and os.fstat(lock.fileno()).st_ino == path.stat().st_ino:
            lock.truncate(0)
            lock.write(str(os.getpid()))
            lock.flush()
            return lock
        lock.close()  # the previous holder has just removed the folder, so the lock is on a deleted file


def _read(path: Path) -> Arrays | None:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return dict(arrays)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None  # damaged, for example by a power failure: compute the part again


def _write(path: Path, arrays: Arrays) -> None:
    part = path.with_suffix(".part")
    try:
        with part.open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]  # numpy's stub confuses ``allow_pickle`` with an array
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        raise BundleError(
            f"{path.parent}: the intermediate results of the build cannot be stored ({error.strerror}); "
            "free disk space or choose another folder",
            field="out",
        ) from error
