"""The folder of bundles that a service watches: versions that come and go, damaged ones, and half-copied ones."""

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
    """A bundle that is being copied: what it will be, and the files that are missing or incomplete."""

    version: Version
    manifest: Manifest
    left: list[Path]


class Shelf:
    """Bundles in a folder, each a version of the same map: files are hard links of it, the manifest is their own.

    Args:
        disk: folder; the watched one is ``maps`` in it.
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
        """A new version, which appears whole; its folder's name and itself.

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
        """Take a bundle away; it may come back."""
        (self.folder / name).rename(self._stash / name)
        self.stashed[name] = version

    def restore(self, name: str) -> Version:
        """Bring a bundle back."""
        (self._stash / name).rename(self.folder / name)
        return self.stashed.pop(name)

    def delete(self, name: str) -> None:
        """Take a bundle away for good, file by file."""
        shutil.rmtree(self.folder / name)

    def damage(self) -> str:
        """A bundle that must not serve appears; what is wrong with it."""
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
        except OSError:  # a full disk damages it as well
            kind = "what a full disk left of it"
        part.rename(self.folder / name)
        self.damaged.append(name)
        return f"{name}: {kind}"

    def clear_damaged(self) -> str:
        """A damaged bundle goes away."""
        name = self.damaged.pop(self._random.randrange(len(self.damaged)))
        path = self.folder / name
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
        return name

    def begin_copy(self) -> str:
        """Half of a new version appears under its final name, as if copied in place; what was copied."""
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
        """The rest of a copy; None where the disk is full, and it stays what it is."""
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
        """A half-copied bundle goes away."""
        self.delete(name)
        del self.halves[name]

    def _next(self) -> tuple[Version, Manifest]:
        number = next(self._numbers)
        made_at = self._made_at + timedelta(seconds=number)
        changed = {"made_at": made_at, "licence": f"chaos {number}"}
        manifest = read_manifest(self._base).model_copy(update=changed).stamped()
        return Version(number, manifest.version), manifest

    def _copy_next(self, name: str, half: _Half, *, share: float = 1.0) -> None:
        """Copy the next file, or go on with it where it was left; a share of it leaves it incomplete."""
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
        path.unlink()  # a link: the map's own must stay
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
