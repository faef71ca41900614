"""Pairs of pictures that lie ready beside a map: for who has none of their own at hand."""

import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from service.contract.schema import LocalizeRequest, SamplePair, Truth
from service.errors import DatasetError, UnknownSampleError

REQUEST_FILE, TRUTH_FILE = "request.json", "truth.json"
#: Suffixes that a part may have; the formats that ``localize`` reads and that come as files.
PICTURES = {
    "rgb": {".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".png": "image/png", ".webp": "image/webp"},
    "depth": {".png": "image/png", ".tif": "image/tiff", ".tiff": "image/tiff", ".npy": "application/octet-stream"},
}
MOST = 64
_MOST_JSON_BYTES = 65_536
_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}")  # it becomes a part of an address


@dataclass(frozen=True, slots=True)
class Picture:
    """A file and what a browser is told that it is."""

    path: Path
    media_type: str


@dataclass(frozen=True, slots=True)
class Sample:
    """A pair; the truth where it is known."""

    name: str
    pictures: dict[str, Picture]
    request: LocalizeRequest
    truth: Truth | None

    def message(self) -> SamplePair:
        """As the contract says it; addresses are relative to the list's."""
        rgb, depth = (f"samples/{self.name}/{part}" for part in ("rgb", "depth"))
        return SamplePair(name=self.name, rgb=rgb, depth=depth, request=self.request, truth=self.truth)


@dataclass(frozen=True, slots=True)
class Samples:
    """A folder of pairs, looked at once; nothing but what was found then is ever read."""

    by_name: dict[str, Sample] = field(default_factory=dict)

    @classmethod
    def open(cls, folder: Path) -> "Samples":
        """Read ``NAME/rgb.*``, ``depth.*``, ``request.json`` and, where there is one, ``truth.json``.

        Raises:
            DatasetError: the folder or a part of a pair is not there, lies outside the folder, or is no such thing.
        """
        if not folder.is_dir():
            raise DatasetError(
                f"{folder}: there is no such folder of sample pairs; unset STREETFIX_SAMPLES", field="samples"
            )
        inside = sorted(path for path in folder.iterdir() if path.is_dir() and _NAME.fullmatch(path.name))
        return cls({path.name: _sample(path, folder.resolve()) for path in inside[:MOST]})

    def picture(self, name: str, part: str) -> Picture:
        """One picture of one pair.

        Raises:
            UnknownSampleError: there is no such pair.
        """
        sample = self.by_name.get(name)
        if sample is None or part not in sample.pictures:
            known = ", ".join(self.by_name) or "none"
            raise UnknownSampleError(f"there is no sample {name[:100]!r}; there are: {known}", field="sample")
        return sample.pictures[part]


def _sample(path: Path, root: Path) -> Sample:
    pictures = {part: _picture(path, part, root) for part in PICTURES}
    truth = path / TRUTH_FILE
    try:
        return Sample(
            path.name,
            pictures,
            LocalizeRequest.model_validate(_json(path / REQUEST_FILE, root)),
            Truth.model_validate(_json(truth, root)) if truth.exists() else None,
        )
    except ValidationError as error:
        raise DatasetError(
            f"{path}: {error.errors()[0]['msg']} at {error.errors()[0]['loc']}; mend the file", field="samples"
        ) from error


def _picture(path: Path, part: str, root: Path) -> Picture:
    for suffix, media_type in PICTURES[part].items():
        file = path / f"{part}{suffix}"
        if file.is_file():
            return Picture(_confined(file, root), media_type)
    raise DatasetError(f"{path}: there is no {part} picture ({', '.join(PICTURES[part])}) in it", field="samples")


def _json(file: Path, root: Path) -> Any:
    try:
        with _confined(file, root).open("rb") as stream:
            return json.loads(stream.read(_MOST_JSON_BYTES))
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{file}: it cannot be read as JSON ({error}); write it again", field="samples") from error


def _confined(file: Path, root: Path) -> Path:
    """The file itself, which a link may not lead out of the folder."""
    real = file.resolve()
    if not real.is_relative_to(root):
        raise DatasetError(f"{file}: it leads out of the folder of samples; copy it there", field="samples")
    return real
