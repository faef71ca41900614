"""A dataset in object storage. Its files are fetched into a folder of this machine when they are needed."""

import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset, ScanFile, Transforms, scan_path
from model_training.datasets.survey_part import FolderSource, PartSource, SurveyPart
from service.errors import BundleError, DatasetError
from service.maps.store.fetch import concurrently
from service.maps.store.remote import Content, Remote, StoredFile, is_url

DATASET = Content("a dataset", "copy the dataset there (docs/maps.md)", "dataset")
_DESCRIPTION, _STREETS, _POSES, _SCANS = "dataset.json", "streets.geojson", "survey/poses.txt", "survey/scans"
_MB = 10**6

#: Progress callback: stage, number done, number of all.
Report = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class _Files:
    """The files of a dataset in object storage, and the folder of this machine that gets them.

    Attributes:
        url: URL of the dataset.
        listed: scans of the survey, as the store lists them, by the names of their files.
        folder: folder for the fetched files.
    """

    url: str
    listed: dict[str, StoredFile]
    folder: Path

    def fetch_small(self, *names: str, required: bool = True) -> None:
        """Fetch files other than scans, unless they are there.

        Args:
            names: paths in the dataset.
            required: whether the dataset must have them.

        Raises:
            DatasetError: a required file is missing, or a file cannot be read or written.
        """
        with _dataset_errors(self.folder):
            remote = Remote.open(self.url, content=DATASET)
            for name in names:
                path = self.folder / name
                if path.exists():
                    continue
                data = remote.read_if_there(name)
                if data is None and required:
                    raise BundleError(
                        f"{self.url}/{name} is missing in the store; check the URL, or {DATASET.remedy}", field=name
                    )
                if data is not None:
                    with _written(path) as part:
                        part.write_bytes(data)

    def fetch_scans(self, numbers: Iterable[int], report: Report = lambda *_: None) -> None:
        """Fetch scans, unless they are there. A scan that the store lacks stays missing.

        Args:
            numbers: numbers of the scans in the whole survey.
            report: called with the fetched MB.

        Raises:
            DatasetError: a scan has changed since it was listed, or cannot be read or written.
        """
        paths = [scan_path(self.folder, number) for number in numbers]
        wanted = {path: self.listed[path.name] for path in paths if path.name in self.listed and not path.exists()}
        if not wanted:
            return
        total, done = sum(file.size for file in wanted.values()), 0

        def count(go_on: Callable[[], None], size: int) -> None:
            nonlocal done
            go_on()
            done += size
            report("fetching scans (MB)", done // _MB, total // _MB)

        def fetch(path: Path, file: StoredFile, go_on: Callable[[], None]) -> None:
            with _written(path) as part, part.open("wb") as stream:
                remote.save_listed(file, stream, on_bytes=partial(count, go_on))

        with _dataset_errors(self.folder):
            remote = Remote.open(self.url, content=DATASET)
            concurrently(partial(fetch, path, file) for path, file in wanted.items())


class _Stored(Dataset):
    """A dataset whose scans and poses are fetched when they are read."""

    _files: _Files

    def survey_trajectory(self) -> tuple[NDArray[np.float64], Transforms]:
        """Return the time (n,) in seconds and T_map_lidar (n, 4, 4) in metres of every scan.

        Raises:
            DatasetError: the pose file is missing or damaged, or cannot be fetched.
        """
        self._files.fetch_small(_POSES)
        return super().survey_trajectory()

    def scan(self, number: int) -> NDArray[np.float32]:
        """Return a scan (n, 4), as ``Dataset.scan``.

        Args:
            number: number of the scan in the whole survey.

        Raises:
            DatasetError: the file is missing, truncated or has changed, or cannot be fetched.
        """
        name = scan_path(self.folder, number).name
        if name not in self._files.listed:
            raise DatasetError(
                f"{self._files.url}/{_SCANS}/{name} is missing, but {_POSES} has a line for it; {DATASET.remedy}",
                field=name,
            )
        self._files.fetch_scans([number])
        return super().scan(number)


class StoredSurvey(_Stored):
    """A dataset in object storage: its description, its streets and its survey. Its queries stay in the store.

    Args:
        url: URL of the dataset, such as ``s3://bucket/surveys/town``.
        beside: the fetched files go into ``.NAME.survey-HASH`` beside this path. A folder of another state of the survey is deleted.

    Raises:
        DatasetError: the dataset is incomplete, or the store cannot be read.
        ExtraMissingError: obstore is not installed.
    """

    def __init__(self, url: str, beside: Path) -> None:
        with _dataset_errors(beside):
            remote = Remote.open(url, content=DATASET)
            listed = {Path(file.name).name: file for file in remote.files(_SCANS)}
            small = [remote.read_if_there(name) for name in (_DESCRIPTION, _STREETS, _POSES)]
        state = sha256(repr((remote.url, sorted(listed.items()), small)).encode()).hexdigest()[:12]
        prefix = f".{beside.name}.survey-"
        folder = beside.parent / f"{prefix}{state}"
        for other in beside.parent.glob(f"{prefix}*"):
            if other != folder:
                shutil.rmtree(other)
        self._files = _Files(remote.url, listed, folder)
        self._files.fetch_small(_DESCRIPTION)
        self._files.fetch_small(_STREETS, required=False)
        super().__init__(folder)

    def scan_files(self) -> Iterator[ScanFile]:
        """Yield the files of the scans, sorted by name."""
        for name, file in sorted(self._files.listed.items()):
            yield name, file.size, file.modified_ns

    def fetch_all(self, report: Report = lambda *_: None) -> None:
        """Fetch all scans, several at a time.

        Args:
            report: called with the fetched MB.

        Raises:
            DatasetError: a scan has changed since the command began, or cannot be read or written.
        """
        self._files.fetch_scans(range(len(self.survey_poses())), report)

    def source_of(self, numbers: NDArray[np.int64]) -> "StoredSource":
        """Return the source of a part of the survey.

        Args:
            numbers: indices of the scans of the part (n,).
        """
        names = [scan_path(self.folder, int(number)).name for number in numbers]
        listed = self._files.listed
        return StoredSource(self._files.url, tuple(listed[name] for name in names if name in listed))

    def remove_fetched(self) -> None:
        """Delete the folder with the fetched files."""
        shutil.rmtree(self._files.folder, ignore_errors=True)


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

    def __init__(self, source: "StoredSource", folder: Path, numbers: NDArray[np.int64], poses: Transforms) -> None:
        self._files = _Files(source.url, {Path(file.name).name: file for file in source.files}, folder)
        self._files.fetch_small(_DESCRIPTION)
        self._files.fetch_small(_STREETS, required=False)
        super().__init__(folder, numbers, poses)

    def scan_files(self) -> Iterator[ScanFile]:
        """Yield the files of the scans of the part that the store has, in their order."""
        for number in self._numbers:
            file = self._files.listed.get(scan_path(self.folder, int(number)).name)
            if file is not None:
                yield Path(file.name).name, file.size, file.modified_ns

    def prepare(self) -> None:
        """Fetch the scans of the part, several at a time.

        Raises:
            DatasetError: a scan has changed since it was listed, or cannot be read or written.
        """
        self._files.fetch_scans(int(number) for number in self._numbers)

    def release(self) -> None:
        """Delete the fetched files."""
        shutil.rmtree(self._files.folder, ignore_errors=True)


@dataclass(frozen=True, slots=True)
class StoredSource:
    """A part of a survey in object storage. It can be pickled.

    Attributes:
        url: URL of the dataset.
        files: the scans of the part that the store has.
    """

    url: str
    files: tuple[StoredFile, ...]

    def part(self, numbers: NDArray[np.int64], poses: Transforms, *, scratch: Path) -> SurveyPart:
        """Open the part, as ``PartSource.part``.

        Args:
            numbers: indices of the scans in the survey, ascending (n,).
            poses: their T_map_lidar (n, 4, 4), metres.
            scratch: folder for the fetched files.

        Raises:
            DatasetError: the dataset cannot be opened.
        """
        return StoredSurveyPart(self, scratch, numbers, poses)


def source_of(dataset: Dataset, numbers: NDArray[np.int64]) -> PartSource:
    """Return the source of a part of a dataset's survey.

    Args:
        dataset: the dataset.
        numbers: indices of the scans of the part (n,).
    """
    return dataset.source_of(numbers) if isinstance(dataset, StoredSurvey) else FolderSource(dataset.folder.resolve())


@contextmanager
def dataset_at(place: str, out: Path) -> Iterator[Dataset]:
    """Open a dataset in a folder or in object storage.

    What was fetched is deleted at the end. After an error it stays, so that the next run continues with it.

    Args:
        place: folder, or URL.
        out: folder of the result. Fetched files go beside it.

    Raises:
        DatasetError: the dataset is incomplete, or the store cannot be read.
        ExtraMissingError: obstore is not installed.
    """
    if not is_url(place):
        yield Dataset(Path(place))
        return
    stored = StoredSurvey(place, out)
    yield stored
    stored.remove_fetched()


@contextmanager
def _written(path: Path) -> Iterator[Path]:
    """Yield a new path in the same folder. It gets its name at the end, or disappears after an error."""
    part = path.with_name(f".{path.name}.{os.getpid()}-{uuid4().hex[:8]}")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield part
        part.rename(path)
    finally:
        with suppress(FileNotFoundError):
            part.unlink()


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
