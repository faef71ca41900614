"""Sample pairs of a map, for users without images of their own."""

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
_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}")  # the name becomes a part of a URL


@dataclass(frozen=True, slots=True)
class Picture:
    """An image file and its media type."""

    path: Path
    media_type: str


@dataclass(frozen=True, slots=True)
class Sample:
    """A sample pair. ``truth`` is the ground truth, or None."""

    name: str
    pictures: dict[str, Picture]
    request: LocalizeRequest
    truth: Truth | None

    def message(self) -> SamplePair:
        """Return the message of the contract. Addresses are relative to that of the list."""
        rgb, depth = (f"samples/{self.name}/{part}" for part in ("rgb", "depth"))
        return SamplePair(name=self.name, rgb=rgb, depth=depth, request=self.request, truth=self.truth)


@dataclass(frozen=True, slots=True)
class Samples:
    """The sample pairs of a folder. The folder is read once, and no other file is served later."""

    by_name: dict[str, Sample] = field(default_factory=dict)

    @classmethod
    def open(cls, folder: Path) -> "Samples":
        """Read ``NAME/rgb.*``, ``depth.*``, ``request.json`` and, if it exists, ``truth.json``.

        Args:
            folder: folder of the sample pairs.

        Raises:
            DatasetError: the folder or a part of a pair is missing, invalid, or outside the folder.
        """
        if not folder.is_dir():
            raise DatasetError(
                f"{folder}: this folder of sample pairs does not exist; correct or unset STREETFIX_SAMPLES",
                field="samples",
            )
        inside = sorted(path for path in folder.iterdir() if path.is_dir() and _NAME.fullmatch(path.name))
        return cls({path.name: _sample(path, folder.resolve()) for path in inside[:MOST]})

    def picture(self, name: str, part: str) -> Picture:
        """Return one image of a sample pair.

        Args:
            name: name of the pair.
            part: ``rgb`` or ``depth``.

        Raises:
            UnknownSampleError: no pair has this name.
        """
        sample = self.by_name.get(name)
        if sample is None or part not in sample.pictures:
            known = ", ".join(self.by_name) or "none"
            raise UnknownSampleError(f"there is no sample {name[:100]!r}; known samples: {known}", field="sample")
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
            f"{path}: {error.errors()[0]['msg']} at {error.errors()[0]['loc']}; correct the file", field="samples"
        ) from error


def _picture(path: Path, part: str, root: Path) -> Picture:
    for suffix, media_type in PICTURES[part].items():
        file = path / f"{part}{suffix}"
        if file.is_file():
            return Picture(_confined(file, root), media_type)
    raise DatasetError(f"{path}: the folder has no {part} image ({', '.join(PICTURES[part])})", field="samples")


def _json(file: Path, root: Path) -> Any:
    try:
        with _confined(file, root).open("rb") as stream:
            return json.loads(stream.read(_MOST_JSON_BYTES))
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(
            f"{file}: the file is not readable JSON ({error}); write it again", field="samples"
        ) from error


def _confined(file: Path, root: Path) -> Path:
    """Return the resolved path of a file. A link must not lead out of the folder."""
    real = file.resolve()
    if not real.is_relative_to(root):
        raise DatasetError(f"{file}: the link leads out of the folder of samples; copy the file there", field="samples")
    return real
