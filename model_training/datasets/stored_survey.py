"""A dataset in object storage. Its files are fetched into a folder of this machine when they are needed."""

import fcntl
import os
import shutil
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, BinaryIO, Self
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset, Report, ScanFile, Transforms, scan_path
from model_training.datasets.frames import MovedFrame
from model_training.datasets.survey_part import FolderSource, PartSource, SurveyPart
from service.errors import BundleError, DatasetError
from service.maps.store.fetch import concurrently
from service.maps.store.remote import Content, Remote, StoredFile, is_url

DATASET = Content("a dataset", "copy the dataset there (docs/maps.md)", "dataset")
_DESCRIPTION, _STREETS, _POSES, _SCANS = "dataset.json", "streets.geojson", "survey/poses.txt", "survey/scans"
_LOCK, _STATE = "lock", "state"
_MB = 10**6


@dataclass(frozen=True, slots=True)
class StoredSource:
    """A survey in object storage, or a part of it. It can be pickled.

    Attributes:
        url: URL of the dataset.
        files: description, streets and poses of the dataset as the store lists them, by their paths in the dataset.
        scans: scans of the part as the store lists them, by the names of their files.
        frame: map frame of the part; None: that of the dataset.
    """

    url: str
    files: Mapping[str, StoredFile]
    scans: Mapping[str, StoredFile]
    frame: MovedFrame | None = None

    @classmethod
    def found(cls, url: str) -> "StoredSource":
        """Look at a dataset in a store.

        Args:
            url: URL of the dataset.

        Raises:
            BundleError: the dataset has no description or no poses, or the store cannot be read.
            ExtraMissingError: obstore is not installed.
        """
        remote = Remote.open(url, content=DATASET)
        found = {name: remote.look(name) for name in (_DESCRIPTION, _STREETS, _POSES)}
        for name in (_DESCRIPTION, _POSES):
            if found[name] is None:
                raise BundleError(
                    f"{remote.url}/{name} is missing in the store; check the URL, or {DATASET.remedy}", field=name
                )
        scans = {file.name.rpartition("/")[2]: file for file in remote.files(_SCANS)}
        return cls(remote.url, {name: file for name, file in found.items() if file is not None}, scans)

    @property
    def state(self) -> str:
        """Hash of the names, sizes, times and ETags of all files."""
        digest = sha256(self.url.encode())
        for file in (*self.files.values(), *self.scans.values()):
            digest.update(repr(file).encode())
        return digest.hexdigest()

    def of(self, numbers: NDArray[np.int64], frame: MovedFrame | None) -> "StoredSource":
        """Return a part of the survey.

        Args:
            numbers: indices of the scans of the part (n,).
            frame: map frame of the part; None: that of the dataset.
        """
        names = (scan_path(Path(), int(number)).name for number in numbers)
        return StoredSource(
            self.url, self.files, {name: self.scans[name] for name in names if name in self.scans}, frame
        )

    def part(self, numbers: NDArray[np.int64], poses: Transforms, *, scratch: Path) -> SurveyPart:
        """Open the part, as ``PartSource.part``.

        Args:
            numbers: indices of the scans in the survey, ascending (n,).
            poses: their T_map_lidar (n, 4, 4), metres.
            scratch: folder for the fetched files.

        Raises:
            DatasetError: the dataset cannot be opened.
        """
        return StoredSurveyPart(self, scratch, numbers, poses).moved(self.frame)

    def fetch_small(self, folder: Path, name: str) -> None:
        """Fetch a file other than a scan, unless it is there or the dataset has none.

        Args:
            folder: folder for the fetched files.
            name: path in the dataset.

        Raises:
            DatasetError: the file has changed since it was listed, or cannot be read or written.
        """
        path = folder / name
        if name in self.files and not path.exists():
            with _dataset_errors(folder):
                remote = Remote.open(self.url, content=DATASET)
                with _written(path) as stream:
                    remote.save_listed(self.files[name], stream, on_bytes=lambda _: None)

    def fetch_scans(self, folder: Path, numbers: Iterable[int], report: Report = lambda *_: None) -> None:
        """Fetch scans, several at a time, unless they are there. A scan that the store lacks stays missing.

        Args:
            folder: folder for the fetched files.
            numbers: numbers of the scans in the whole survey.
            report: called with the fetched MB.

        Raises:
            DatasetError: a scan has changed since it was listed, or cannot be read or written.
        """
        paths = [scan_path(folder, number) for number in numbers]
        listed = {path: self.scans[path.name] for path in paths if path.name in self.scans}
        wanted = {path: file for path, file in listed.items() if not _has_size(path, file.size)}
        if not wanted:
            return
        progress = _Progress(sum(file.size for file in wanted.values()), report)

        def fetch(path: Path, file: StoredFile, go_on: Callable[[], None]) -> None:
            def count(size: int) -> None:
                go_on()
                progress.add(size)

            with _written(path) as stream:
                remote.save_listed(file, stream, on_bytes=count)

        with _dataset_errors(folder):
            remote = Remote.open(self.url, content=DATASET)
            concurrently(partial(fetch, path, file) for path, file in wanted.items())


class _Progress:
    """Add up the fetched bytes of several threads."""

    def __init__(self, total: int, report: Report) -> None:
        self._total, self._report, self._done, self._lock = total, report, 0, threading.Lock()

    def add(self, size: int) -> None:
        with self._lock:
            self._done += size
            self._report("fetching scans (MB)", self._done // _MB, self._total // _MB)


class _Stored(Dataset):
    """A dataset whose files are fetched when they are read. Errors name the URL and not the fetched copy."""

    source: StoredSource

    @property
    def place(self) -> str:
        """URL of the dataset, for error messages."""
        return self.source.url

    def _has_survey(self) -> bool:
        return True  # StoredSource.found requires it, and the file may not have been fetched yet

    def in_frame(self, georeference: Mapping[str, Any] | None) -> Self:
        """Return this dataset in another map frame, as ``Dataset.in_frame``.

        Args:
            georeference: of the other frame, as in ``dataset.json``. None: unknown.

        Raises:
            DatasetError: as ``Dataset.in_frame``, or the poses cannot be fetched.
        """
        with self._naming_url():
            return super().in_frame(georeference)

    def streets(self) -> dict[str, Any] | None:
        """Return the GeoJSON of the streets, or None if the dataset has none.

        Raises:
            DatasetError: the file is not JSON, or cannot be fetched.
        """
        self.source.fetch_small(self.folder, _STREETS)
        with self._naming_url():
            return super().streets()

    def survey_trajectory(self) -> tuple[NDArray[np.float64], Transforms]:
        """Return the time (n,) in seconds and T_map_lidar (n, 4, 4) in metres of every scan.

        Raises:
            DatasetError: the pose file is damaged, or cannot be fetched.
        """
        self.source.fetch_small(self.folder, _POSES)
        with self._naming_url():
            return super().survey_trajectory()

    def scan(self, number: int) -> NDArray[np.float32]:
        """Return a scan (n, 4), as ``Dataset.scan``.

        Args:
            number: number of the scan in the whole survey.

        Raises:
            DatasetError: the file is missing, truncated or has changed, or cannot be fetched.
        """
        name = scan_path(self.folder, number).name
        if name not in self.source.scans:
            raise DatasetError(
                f"{self.source.url}/{_SCANS}/{name} is missing, but {_POSES} has a line for it; {DATASET.remedy}",
                field=name,
            )
        self.source.fetch_scans(self.folder, [number])
        with self._naming_url():
            return super().scan(number)

    @contextmanager
    def _naming_url(self) -> Iterator[None]:
        with _naming(self.source.url, self.folder):
            yield


class StoredSurvey(_Stored):
    """A dataset in object storage: its description, its streets and its survey. Its queries stay in the store.

    Args:
        source: the dataset.
        folder: folder for the fetched files.

    Raises:
        DatasetError: the dataset cannot be opened.
    """

    def __init__(self, source: StoredSource, folder: Path) -> None:
        self.source = source
        source.fetch_small(folder, _DESCRIPTION)
        with _naming(source.url, folder):
            super().__init__(folder)

    def scan_files(self) -> Iterator[ScanFile]:
        """Yield the files of the scans, sorted by name."""
        return _scan_files(self.source, sorted(self.source.scans))

    def fetch(self, numbers: NDArray[np.int64], report: Report = lambda *_: None) -> None:
        """Fetch scans, several at a time.

        Args:
            numbers: numbers of the scans (n,).
            report: called with the fetched MB.

        Raises:
            DatasetError: a scan has changed since the command began, or cannot be read or written.
        """
        self.source.fetch_scans(self.folder, numbers.tolist(), report)


class StoredSurveyPart(SurveyPart, _Stored):
    """A part of a survey in object storage.

    Args:
        source: the dataset and the scans of the part.
        folder: folder for the fetched files.
        numbers: indices of the scans of the part in the survey, ascending (n,).
        poses: their T_map_lidar (n, 4, 4), metres.

    Raises:
        DatasetError: the dataset cannot be opened.
    """

    def __init__(self, source: StoredSource, folder: Path, numbers: NDArray[np.int64], poses: Transforms) -> None:
        self.source = source
        source.fetch_small(folder, _DESCRIPTION)
        with _naming(source.url, folder):
            super().__init__(folder, numbers, poses)

    def scan_files(self) -> Iterator[ScanFile]:
        """Yield the files of the scans of the part that the store has, in their order."""
        return _scan_files(self.source, (scan_path(self.folder, int(number)).name for number in self._numbers))

    def prepare(self) -> None:
        """Fetch the scans of the part, several at a time.

        Raises:
            DatasetError: a scan has changed since it was listed, or cannot be read or written.
        """
        self.source.fetch_scans(self.folder, self._numbers.tolist())

    def release(self) -> None:
        """Delete the fetched files."""
        shutil.rmtree(self.folder, ignore_errors=True)


def source_of(dataset: Dataset, numbers: NDArray[np.int64]) -> PartSource:
    """Return the source of a part of a dataset's survey.

    Args:
        dataset: the dataset.
        numbers: indices of the scans of the part (n,).
    """
    if isinstance(dataset, StoredSurvey):
        return dataset.source.of(numbers, dataset.frame)
    return FolderSource(dataset.folder.resolve(), dataset.frame)


@contextmanager
def dataset_at(place: str, out: Path) -> Iterator[Dataset]:
    """Open a dataset in a folder or in object storage.

    Files from a store go into ``.NAME.survey`` beside ``out``, and are deleted at the end. After an error, the scans stay, so that the next
    run continues with them. Scans of another state of the dataset are deleted first.

    Args:
        place: folder, or URL.
        out: folder of the result.

    Raises:
        DatasetError: the dataset is incomplete, another process uses the folder, or the store cannot be read.
        ExtraMissingError: obstore is not installed.
    """
    if not is_url(place):
        yield Dataset(Path(place))
        return
    folder = out.parent / f".{out.name}.survey"
    with _dataset_errors(folder):
        source = StoredSource.found(place)
    with _held(folder, source.state):
        yield StoredSurvey(source, folder)


@contextmanager
def _held(folder: Path, state: str) -> Iterator[None]:
    """Hold a folder for fetched files. The system releases it however the process ends.

    Args:
        folder: the folder; created if it is missing. Files of another state are deleted.
        state: hash of what will be fetched.

    Raises:
        DatasetError: another process holds the folder, or it cannot be written.
    """
    with _dataset_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise DatasetError(
                f"{folder} is used by another process that builds this map; wait for it, or choose another --out",
                field="out",
            ) from error
        with _dataset_errors(folder):
            kept = folder / _STATE
            if not (kept.is_file() and kept.read_text() == state):
                _empty(folder)
                kept.write_text(state)
        try:
            yield
        except BaseException:
            if not any((folder / _SCANS).glob("*")):  # nothing is worth keeping
                shutil.rmtree(folder, ignore_errors=True)
            raise
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(lock)


def _empty(folder: Path) -> None:
    """Delete everything in a folder but its lock."""
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != _LOCK:
            path.unlink()


def _scan_files(source: StoredSource, names: Iterable[str]) -> Iterator[ScanFile]:
    for name in names:
        file = source.scans.get(name)
        if file is not None:
            yield name, file.size, file.modified_ns


def _has_size(path: Path, size: int) -> bool:
    """Return whether a file is there as a whole. After a crash of the machine it may be shorter."""
    try:
        return path.stat().st_size == size
    except FileNotFoundError:
        return False


@contextmanager
def _written(path: Path) -> Iterator[BinaryIO]:
    """Open a new file in the same folder. It gets its name at the end, or disappears after an error."""
    part = path.with_name(f".{path.name}.{os.getpid()}-{uuid4().hex[:8]}")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with part.open("wb") as stream:
            yield stream
        part.rename(path)
    finally:
        with suppress(FileNotFoundError):
            part.unlink()


@contextmanager
def _naming(url: str, folder: Path) -> Iterator[None]:
    """Let errors of the dataset name its URL and not the folder of the fetched files."""
    try:
        yield
    except DatasetError as error:
        if str(folder) not in error.message:
            raise
        raise DatasetError(f"{error.message.replace(str(folder), url)}; {DATASET.remedy}", field=error.field) from error


@contextmanager
def _dataset_errors(folder: Path) -> Iterator[None]:
    """Turn errors of the store and of the disk into errors of the dataset."""
    try:
        yield
    except BundleError as error:
        raise DatasetError(error.message, field=error.field) from error
    except OSError as error:
        raise DatasetError(
            f"{error.filename or folder} cannot be written ({error.strerror}); free disk space or choose another --out",
            field="out",
        ) from error
