"""Where city archives lie: in a folder, or in object storage. Each archive appears there complete or not at all."""

import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from glob import escape
from pathlib import Path
from typing import Protocol

from service.errors import DatasetError
from service.maps.store.remote import Content, Remote, is_url

ARCHIVES = Content("the training cities", "simulate them there (streetfix simulate-training, docs/train.md)", "out")


class ArchivePlace(Protocol):
    """A place of city archives. It can be pickled."""

    def create(self) -> None:
        """Create the place if it is missing."""

    def full_name(self, name: str) -> str:
        """Return the name of an archive with the place, for messages.

        Args:
            name: its file name.
        """

    def has(self, name: str) -> bool:
        """Return whether an archive is there.

        Args:
            name: its file name.
        """

    def scratch(self, name: str, run: str) -> AbstractContextManager[Path]:
        """Provide a new folder in which an archive is made. It is removed afterwards.

        Args:
            name: file name of the archive.
            run: name of the command that makes it.
        """

    def put(self, name: str, made: Path) -> None:
        """Publish an archive in one step.

        Args:
            name: its file name.
            made: the complete file, in ``scratch``.
        """

    def clear(self, name: str, run: str = "") -> None:
        """Remove what killed processes of a command left of an archive.

        Args:
            name: file name of the archive.
            run: name of the command; empty for all commands, if the archive is there.
        """

    def fetched(self, name: str, scratch: Path) -> Path:
        """Return a file of this machine with the content of an archive.

        Args:
            name: file name of the archive.
            scratch: folder for a copy.
        """


def archives_at(place: str) -> ArchivePlace:
    """Return the place of a folder or URL.

    Args:
        place: of the command line.
    """
    return StoredArchives(place) if is_url(place) else FolderOfArchives(Path(place).resolve())


@dataclass(frozen=True, slots=True)
class FolderOfArchives:
    """City archives in a folder. On several machines, all see it under this path.

    Attributes:
        folder: absolute path.
    """

    folder: Path

    def create(self) -> None:
        """Create the folder if it is missing."""
        self.folder.mkdir(parents=True, exist_ok=True)

    def full_name(self, name: str) -> str:
        """Return the path of an archive, as ``ArchivePlace.full_name``.

        Args:
            name: its file name.
        """
        return str(self.folder / name)

    def has(self, name: str) -> bool:
        """Return whether an archive is there, as ``ArchivePlace.has``.

        Args:
            name: its file name.
        """
        return (self.folder / name).is_file()

    def scratch(self, name: str, run: str) -> AbstractContextManager[Path]:
        """Provide a hidden folder beside the archive, as ``ArchivePlace.scratch``.

        Args:
            name: file name of the archive.
            run: name of the command that makes it.
        """
        return scratch_beside(self.folder / name, run)

    def put(self, name: str, made: Path) -> None:
        """Rename a file to its final name. Remains of other processes are then useless and removed.

        Args:
            name: its file name.
            made: the complete file.
        """
        made.replace(self.folder / name)
        clear_beside(self.folder / name)

    def clear(self, name: str, run: str = "") -> None:
        """Remove what killed processes of a command left, as ``ArchivePlace.clear``.

        Args:
            name: file name of the archive.
            run: name of the command; empty for all commands.
        """
        clear_beside(self.folder / name, run)

    def fetched(self, name: str, scratch: Path) -> Path:  # noqa: ARG002  # nothing is copied
        """Return the path of an archive, as ``ArchivePlace.fetched``.

        Args:
            name: file name of the archive.
            scratch: not used.
        """
        return self.folder / name


@dataclass(frozen=True, slots=True)
class StoredArchives:
    """City archives in object storage.

    Attributes:
        url: such as ``s3://bucket/cities``.
    """

    url: str

    def create(self) -> None:
        """Create the folder of a ``file://`` URL.

        Raises:
            BundleError: the URL is not valid, or the folder cannot be created.
            ExtraMissingError: obstore is not installed.
        """
        Remote.open(self.url, create=True, content=ARCHIVES)

    def full_name(self, name: str) -> str:
        """Return the URL of an archive, as ``ArchivePlace.full_name``.

        Args:
            name: its file name.
        """
        return f"{self.url.rstrip('/')}/{name}"

    def has(self, name: str) -> bool:
        """Return whether an archive is there, as ``ArchivePlace.has``.

        Args:
            name: its file name.

        Raises:
            BundleError: the store cannot be read.
            ExtraMissingError: obstore is not installed.
        """
        return self._remote().look(name) is not None

    def scratch(self, name: str, run: str) -> AbstractContextManager[Path]:
        """Provide a temporary folder of this machine, as ``ArchivePlace.scratch``.

        Args:
            name: file name of the archive.
            run: name of the command that makes it.
        """
        return scratch_beside(_temporary(name), run)

    def put(self, name: str, made: Path) -> None:
        """Upload an archive. The store shows it when it is complete.

        Args:
            name: its file name.
            made: the complete file.

        Raises:
            BundleError: it cannot be stored.
            ExtraMissingError: obstore is not installed.
        """
        self._remote().put(name, made)

    def clear(self, name: str, run: str = "") -> None:
        """Remove what killed processes of a command left on this machine. The store has no incomplete archive.

        Args:
            name: file name of the archive.
            run: name of the command. If it is empty, nothing is removed: a command that writes elsewhere may make the same city.
        """
        if run:
            clear_beside(_temporary(name), run)

    def fetched(self, name: str, scratch: Path) -> Path:
        """Fetch an archive into a file, as ``ArchivePlace.fetched``.

        Args:
            name: file name of the archive.
            scratch: folder for the copy.

        Raises:
            BundleError: the archive cannot be read.
            DatasetError: it is missing.
            ExtraMissingError: obstore is not installed.
        """
        remote = self._remote()
        listed = remote.look(name)
        if listed is None:
            raise DatasetError(
                f"{self.full_name(name)} is missing in the store; {ARCHIVES.remedy}", field="cities_from"
            )
        target = scratch / name
        with target.open("xb") as file:
            remote.save_listed(listed, file, on_bytes=lambda _: None)
        return target

    def _remote(self) -> Remote:
        return Remote.open(self.url, content=ARCHIVES)


def _temporary(name: str) -> Path:
    return Path(tempfile.gettempdir()) / f"streetfix-{name}"


@contextmanager
def scratch_beside(target: Path, run: str) -> Iterator[Path]:
    """Provide a new hidden folder beside a file or folder that is being made. It is removed afterwards.

    Several processes may make the same target: each call has a folder of its own.

    Args:
        target: what is being made.
        run: name of the command that makes it.
    """
    folder = target.with_name(f".{target.name}.{run}-{secrets.token_hex(4)}.part")
    folder.mkdir(parents=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def clear_beside(target: Path, run: str = "") -> None:
    """Remove the folders of ``scratch_beside`` that killed processes left.

    Args:
        target: what they made.
        run: name of the command whose folders are removed; empty for all commands.
    """
    for folder in target.parent.glob(f".{escape(target.name)}.{escape(run)}*.part"):
        shutil.rmtree(folder, ignore_errors=True)
