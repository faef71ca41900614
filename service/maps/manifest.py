"""The manifest of a map bundle: what was built, how, from what, and the hash of every file."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, ValidationError

from service.errors import BundleError
from service.geometry.earth import Georeference
from service.imaging.view_grid import ViewGrid

FORMAT = 3
FILE = "manifest.json"
#: Parts of the manifest that say when and with what a bundle was made, not what is in it.
_CIRCUMSTANCES = {"version", "made_at", "tool_versions"}

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
Name = Annotated[str, Field(pattern=NAME)]


class _Frozen(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class GridParameters(_Frozen):
    """The view grid of the descriptors; a query is resampled to the same."""

    rows: int = Field(ge=2, le=1024)
    columns: int = Field(ge=2, le=4096)
    azimuth_span_deg: float = Field(gt=0, le=360)
    elevation_top_deg: float = Field(ge=-90, le=90)
    elevation_bottom_deg: float = Field(ge=-90, le=90)
    min_range_m: float = Field(ge=0)
    max_range_m: float = Field(gt=0)


class Counts(_Frozen):
    """How much is in the bundle."""

    places: int = Field(ge=1)
    views: int = Field(ge=1)
    descriptor_size: int = Field(ge=1, le=65536)
    cloud_points: int = Field(ge=0)
    streets: int = Field(ge=0)


class FileEntry(_Frozen):
    """What a file must be."""

    sha256: Sha256
    size: int = Field(ge=0)


class Manifest(_Frozen):
    """The first file that is read and the last that is written."""

    format: Literal[3]
    name: Name
    version: Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]
    made_at: AwareDatetime
    grid: GridParameters
    headings: int = Field(ge=1)
    spacing_m: float = Field(ge=0)
    rows_seen: tuple[bool, ...]
    parameters: dict[str, float]
    encoder_sha256: Sha256
    counts: Counts
    georeference: dict[str, float] | None
    licence: str
    files: dict[str, FileEntry]
    tool_versions: dict[str, str]

    @property
    def view_grid(self) -> ViewGrid:
        """The grid as the imaging code takes it."""
        return ViewGrid(**self.grid.model_dump())

    @property
    def lidar_height_m(self) -> float:
        """Nominal height of the survey's LiDAR, the origin of a place, above the ground."""
        return self.parameters["lidar_height_m"]

    def expected_version(self) -> str:
        """Hash of the content: the same places, views and files give the same version, whenever they were made."""
        content = self.model_dump(mode="json", exclude=_CIRCUMSTANCES)
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]

    def stamped(self) -> "Manifest":
        """The same manifest with its version filled in."""
        return Manifest.model_validate({**self.model_dump(), "version": self.expected_version()})

    def to_bytes(self) -> bytes:
        """The file's text."""
        return (json.dumps(self.model_dump(mode="json"), indent=1, sort_keys=True) + "\n").encode()


def read_manifest(directory: Path) -> Manifest:
    """Read and check a bundle's manifest.

    Raises:
        BundleError: it is missing, not a manifest, of another format version, or contradicts itself.
    """
    path = directory / FILE
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BundleError(
            f"{path}: there is no readable manifest ({error.strerror}): give the folder that build-map wrote",
            field=FILE,
        ) from error
    _require_format(path, data)
    try:
        manifest = Manifest.model_validate_json(data)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise BundleError(f"{path}: {where}: {first['msg']}; copy or build the bundle again", field=FILE) from error
    _require_consistent(path, manifest)
    return manifest


def _require_format(path: Path, data: bytes) -> None:
    try:
        document = json.loads(data)
        found = document["format"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise BundleError(f"{path}: this is not a manifest; copy or build the bundle again", field=FILE) from error
    if found != FORMAT:
        raise BundleError(
            f"{path}: format {found!r}, but this program reads format {FORMAT}: build the map with this release, "
            "or serve it with the one that made it",
            field=FILE,
        )


def _require_consistent(path: Path, manifest: Manifest) -> None:
    grid = manifest.grid
    if manifest.version != manifest.expected_version():
        what = f"version {manifest.version} is not that of its content ({manifest.expected_version()})"
    elif len(manifest.rows_seen) != grid.rows:
        what = f"rows_seen has {len(manifest.rows_seen)} entries for {grid.rows} rows of the view grid"
    elif grid.elevation_bottom_deg >= grid.elevation_top_deg or grid.min_range_m >= grid.max_range_m:
        what = "the limits of the view grid are the wrong way round"
    elif "lidar_height_m" not in manifest.parameters:
        what = "parameters lacks lidar_height_m"
    elif wrong := not_on_earth(manifest.georeference):
        what = f"georeference: {wrong}"
    elif bad := [name for name in manifest.files if not is_confined(name)]:
        what = f"the file {bad[0]!r} would lie outside the bundle"
    else:
        return
    raise BundleError(f"{path}: {what}; copy or build the bundle again", field=FILE)


def not_on_earth(georeference: Mapping[str, Any] | None) -> str | None:
    """What is wrong with a georeference, if anything."""
    try:
        if georeference is not None:
            Georeference(**georeference)
    except (TypeError, ValueError) as error:
        return str(error)
    return None


def is_confined(name: str) -> bool:
    """Whether a file's name is a plain relative path that stays inside the bundle."""
    parts = name.split("/")
    plain = all(part and part not in (".", "..") and not set(part) & set("\\:\0") for part in parts)
    return plain and name != FILE
