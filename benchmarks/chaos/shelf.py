"""The folder of bundles that a service watches: complete, damaged and half-copied versions."""

import errno
import itertools
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from random import Random

from benchmarks.chaos.oracle import Version
from service.maps.manifest import FILE as MANIFEST_FILE
from service.maps.manifest import Manifest, read_manifest


@dataclass
class _Half:
    """A bundle during its copy: version, manifest, and the files that are missing or incomplete."""

    version: Version
    manifest: Manifest
    left: list[Path]


class Shelf:
    """Bundles in a folder, each a version of the same map: files are hard links, the manifest differs.

    Args:
        disk: folder on the disk; the watched folder is ``maps`` in it.
        bundle: the map.
        random: source of all choices.
    """

    def __init__(self, disk: Path, bundle: Path, random: Random) -> None:
        self._base, self._stash = disk / "base", disk / "stash"
        self.folder = disk / "maps"
        shutil.copytree(bundle, self._base)
        self._stash.mkdir()
        self.folder.mkdir()
        self._random = random
        self._numbers = itertools.count(1)
        self._made_at = datetime.now(UTC) - timedelta(days=1)
        self.name = read_manifest(self._base).name
        self.known: dict[str, Version] = {}
        self.stashed: dict[str, Version] = {}
        self.damaged: list[str] = []
        self.halves: dict[str, _Half] = {}

    def add(self) -> tuple[str, Version]:
        """Add a new version that appears complete; return its folder name and the version.

        Raises:
            OSError: the disk is full; nothing has appeared.
        """
        version, manifest = self._next()
        name, part = f"v{version.number:04}", self.folder / f".part-{version.number}"
        try:
            _link_tree(self._base, part)
            (part / MANIFEST_FILE).unlink()
            (part / MANIFEST_FILE).write_bytes(manifest.to_bytes())
            part.rename(self.folder / name)
        except OSError:
            shutil.rmtree(part, ignore_errors=True)
            raise
        self.known[version.id] = version
        return name, version

    def stash(self, name: str, version: Version) -> None:
        """Take a bundle away for now.

        Args:
            name: name of its folder.
            version: its version.
        """
        (self.folder / name).rename(self._stash / name)
        self.stashed[name] = version

    def restore(self, name: str) -> Version:
        """Bring a bundle back and return its version.

        Args:
            name: name of its folder.
        """
        (self._stash / name).rename(self.folder / name)
        return self.stashed.pop(name)

    def delete(self, name: str) -> None:
        """Delete a bundle, file by file.

        Args:
            name: name of its folder.
        """
        shutil.rmtree(self.folder / name)

    def damage(self) -> str:
        """Add a bundle that must not serve; return its name and defect."""
        version, manifest = self._next()
        name = f"v{version.number:04}"
        part = self.folder / f".part-{version.number}"
        _link_tree(self._base, part)
        (part / MANIFEST_FILE).unlink()
        kinds: dict[str, Callable[[Path], object]] = {
            "a flipped byte": self._flip,
            "a short file": self._shorten,
            "a missing file": self._lose,
            "an empty manifest": lambda path: (path / MANIFEST_FILE).write_bytes(b""),
            "a manifest of noise": lambda path: (path / MANIFEST_FILE).write_bytes(self._random.randbytes(2000)),
            "a manifest of a later format": lambda path: (path / MANIFEST_FILE).write_bytes(b'{"format": 99}'),
            "a manifest that is a folder": _manifest_to_folder,
            "no manifest": lambda path: (path / MANIFEST_FILE).unlink(),
            "a link to itself": _link_to_itself,
        }
        kind = self._random.choice(list(kinds))
        try:
            (part / MANIFEST_FILE).write_bytes(manifest.to_bytes())
            kinds[kind](part)
        except OSError:  # a full disk damages the bundle as well
            kind = "incomplete because of a full disk"
        part.rename(self.folder / name)
        self.damaged.append(name)
        return f"{name}: {kind}"

    def clear_damaged(self) -> str:
        """Delete a damaged bundle and return its name."""
        name = self.damaged.pop(self._random.randrange(len(self.damaged)))
        path = self.folder / name
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
        return name

    def begin_copy(self) -> str:
        """Copy a part of a new version in place, under its final name; return what is missing."""
        version, manifest = self._next()
        name = f"v{version.number:04}"
        files = [path.relative_to(self._base) for path in sorted(self._base.rglob("*")) if path.is_file()]
        self._random.shuffle(files)
        half = self.halves[name] = _Half(version, manifest, files)
        (self.folder / name).mkdir()
        count = self._random.randrange(len(files))
        try:
            for _ in range(count):
                self._copy_next(name, half)
            self._copy_next(name, half, share=0.5)
        except OSError:
            return f"{name}: {len(half.left)} files are missing, since the disk is full"
        return f"{name}: {len(half.left)} files are missing or incomplete"

    def finish_copy(self, name: str) -> Version | None:
        """Finish a copy; return None, and keep it incomplete, if the disk is full.

        Args:
            name: name of its folder.
        """
        half = self.halves[name]
        try:
            while half.left:
                self._copy_next(name, half)
        except OSError:
            return None
        del self.halves[name]
        self.known[half.version.id] = half.version
        return half.version

    def drop_copy(self, name: str) -> None:
        """Delete a half-copied bundle.

        Args:
            name: name of its folder.
        """
        self.delete(name)
        del self.halves[name]

    def _next(self) -> tuple[Version, Manifest]:
        number = next(self._numbers)
        made_at = self._made_at + timedelta(seconds=number)
        changed = {"made_at": made_at, "licence": f"chaos {number}"}
        manifest = read_manifest(self._base).model_copy(update=changed).stamped()
        return Version(number, manifest.version), manifest

    def _copy_next(self, name: str, half: _Half, *, share: float = 1.0) -> None:
        """Copy the next file, or continue with it; a share below 1 leaves it incomplete."""
        file = half.left[0]
        source, out = self._base / file, self.folder / name / file
        out.parent.mkdir(parents=True, exist_ok=True)
        if file.name != MANIFEST_FILE and share == 1.0 and not out.exists():
            out.hardlink_to(source)
        else:
            content = half.manifest.to_bytes() if file.name == MANIFEST_FILE else source.read_bytes()
            with out.open("ab", buffering=0) as target:
                rest = content[target.tell() : int(share * len(content))]
                if target.write(rest) < len(rest):
                    raise OSError(errno.ENOSPC, "the disk is full")
        if share == 1.0:
            half.left.pop(0)

    def _some_file(self, bundle: Path) -> Path:
        files = [path for path in sorted(bundle.rglob("*")) if path.is_file() and path.name != MANIFEST_FILE]
        return self._random.choice([path for path in files if path.stat().st_size > 1])

    def _flip(self, bundle: Path) -> None:
        path = self._some_file(bundle)
        content = bytearray(path.read_bytes())
        content[self._random.randrange(len(content))] ^= 1 << self._random.randrange(8)
        path.unlink()  # the file is a link: keep the original
        path.write_bytes(content)

    def _shorten(self, bundle: Path) -> None:
        path = self._some_file(bundle)
        content = path.read_bytes()
        path.unlink()
        path.write_bytes(content[: self._random.randrange(len(content))])

    def _lose(self, bundle: Path) -> None:
        self._some_file(bundle).unlink()


def _link_tree(source: Path, target: Path) -> None:
    shutil.copytree(source, target, copy_function=lambda a, b: Path(b).hardlink_to(a))


def _link_to_itself(bundle: Path) -> None:
    shutil.rmtree(bundle)
    bundle.symlink_to(bundle.name)


def _manifest_to_folder(bundle: Path) -> None:
    (bundle / MANIFEST_FILE).unlink()
    (bundle / MANIFEST_FILE).mkdir()
