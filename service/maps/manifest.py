"""The manifest of a map bundle: content, build parameters, tool versions and the hash of every file."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, ValidationError

from service.errors import BundleError
from service.geometry.earth import Georeference
from service.imaging.view_grid import ViewGrid

#: Version of the bundle format that this program reads and writes.
FORMAT = 6
FILE = "manifest.json"
#: File of a dataset folder. Users confuse the two kinds of folders.
DATASET_FILE = "dataset.json"
#: Fields that describe when and with which tools the bundle was built. They do not affect the version.
_CIRCUMSTANCES = {"version", "made_at", "tool_versions"}

#: Folder of the tiles of a tiled map.
TILES_FOLDER = "tiles"
#: Limits of the edge of a tile, m, and of the number of a column or row: a map reaches around the Earth.
SMALLEST_TILE_M, LARGEST_TILE_M, MOST_TILES = 50.0, 10_000.0, 1_000_000

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Version = Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]
#: Pattern of a map's name.
NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
Name = Annotated[str, Field(pattern=NAME)]


class _Frozen(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class GridParameters(_Frozen):
    """Parameters of the view grid. Map views and query views use the same grid.

    Attributes:
        rows: number of elevations.
        columns: number of azimuths.
        azimuth_span_deg: horizontal field of view, degrees.
        elevation_top_deg: elevation of the top row, degrees.
        elevation_bottom_deg: elevation of the bottom row, degrees.
        min_range_m: shortest range that a view keeps, metres.
        max_range_m: longest range that a view keeps, metres.
    """

    rows: int = Field(ge=2, le=1024)
    columns: int = Field(ge=2, le=4096)
    azimuth_span_deg: float = Field(gt=0, le=360)
    elevation_top_deg: float = Field(ge=-90, le=90)
    elevation_bottom_deg: float = Field(ge=-90, le=90)
    min_range_m: float = Field(ge=0)
    max_range_m: float = Field(gt=0)


class Counts(_Frozen):
    """Sizes of the bundle's parts.

    Attributes:
        places: number of places.
        views: number of map views.
        descriptor_size: number of components of a descriptor.
        cloud_points: number of surfels; 0 without a cloud.
        streets: number of street features; 0 without streets.
    """

    places: int = Field(ge=1)
    views: int = Field(ge=1)
    descriptor_size: int = Field(ge=1, le=65536)
    cloud_points: int = Field(ge=0)
    streets: int = Field(ge=0)


class FileEntry(_Frozen):
    """Expected hash and size of a file.

    Attributes:
        sha256: SHA-256 of the content, hexadecimal.
        size: size, bytes.
    """

    sha256: Sha256
    size: int = Field(ge=0)


class Tile(_Frozen):
    """One tile of a tiled map: a map bundle in the folder ``tiles/VERSION`` of the map.

    Attributes:
        column: the tile has the places with ``column * tile_m <= x < (column + 1) * tile_m``, map frame, metres.
        row: the same for y.
        version: version of the bundle: the hash of its content, which includes the hashes of its files.
        size: size of all its files without ``manifest.json``, bytes.
        counts: sizes of its parts.
    """

    column: int = Field(ge=-MOST_TILES, le=MOST_TILES)
    row: int = Field(ge=-MOST_TILES, le=MOST_TILES)
    version: Version
    size: int = Field(ge=0)
    counts: Counts

    @property
    def folder(self) -> str:
        """Folder of the bundle, relative to the folder of the map."""
        return f"{TILES_FOLDER}/{self.version}"


class Manifest(_Frozen):
    """Content of ``manifest.json``. The writer writes this file last and the reader reads it first.

    Attributes:
        format: version of the bundle format.
        name: name of the map in requests.
        version: hash of the content (``expected_version``).
        made_at: time of the build, with time zone.
        grid: parameters of the view grid.
        headings: number of map views per place.
        spacing_m: travelled distance between places, metres.
        rows_seen: True for the rows of the view grid that the survey's sensor covers.
        parameters: further numbers that the map was built with. ``lidar_height_m`` is required.
        encoder_sha256: SHA-256 of the encoder that computed the descriptors.
        counts: sizes of the bundle's parts.
        georeference: arguments of ``Georeference`` for the map's origin. None if the position on the Earth is unknown.
        licence: text of the licence. May be empty.
        files: every other file of the bundle, by its path relative to the bundle's folder.
        tool_versions: version of each tool that built the map, by name.
        tile_m: edge of the tiles of a tiled map, metres; None for a map of one bundle.
        tiles: tiles of a tiled map, by column and row. ``counts`` has their sums, and ``files`` what they share.
    """

    format: Literal[6]
    name: Name
    version: Version
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
    tile_m: float | None = Field(default=None, ge=SMALLEST_TILE_M, le=LARGEST_TILE_M)
    tiles: tuple[Tile, ...] = ()

    @property
    def view_grid(self) -> ViewGrid:
        """The view grid as the imaging code uses it."""
        return ViewGrid(**self.grid.model_dump())

    @property
    def lidar_height_m(self) -> float:
        """Nominal height of the survey's LiDAR above the ground, metres. The LiDAR is the origin of a place."""
        return self.parameters["lidar_height_m"]

    @property
    def survey_std(self) -> tuple[float | None, float | None]:
        """Standard deviations of the survey's positions (metres) and angles (degrees); None if the map does not state them."""
        return self.parameters.get("survey_position_std_m"), self.parameters.get("survey_angle_std_deg")

    @property
    def surveyed_height_m(self) -> float | None:
        """Height above the ground up to which the survey saw surfaces, metres; None if the map does not state it."""
        return self.parameters.get("surveyed_height_m")

    def expected_version(self) -> str:
        """Return the version: the first 16 hexadecimal digits of the SHA-256 of the content.

        The build time and the tool versions do not count. So the same content gives the same version.
        """
        content = {name: value for name, value in self._document().items() if name not in _CIRCUMSTANCES}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]

    def stamped(self) -> "Manifest":
        """Return a copy with the version set to ``expected_version``."""
        return Manifest.model_validate({**self.model_dump(), "version": self.expected_version()})

    def to_bytes(self) -> bytes:
        """Return the content of ``manifest.json``."""
        return (json.dumps(self._document(), indent=1, sort_keys=True) + "\n").encode()

    def _document(self) -> dict[str, Any]:
        """Return the content for JSON. A map of one bundle has no fields of tiles."""
        return self.model_dump(mode="json", exclude=set() if self.tiles else {"tile_m", "tiles"})


def read_manifest(directory: Path) -> Manifest:
    """Read and check a bundle's manifest.

    Args:
        directory: the bundle's folder.

    Raises:
        BundleError: the manifest is missing, malformed, of another format version, or inconsistent.
    """
    path = directory / FILE
    try:
        data = path.read_bytes()
    except OSError as error:
        missing = isinstance(error, FileNotFoundError | NotADirectoryError)
        why = "is missing" if missing else f"cannot be read ({error.strerror})"
        raise dataset_error(directory) or BundleError(
            f"{directory}: not a map bundle: {FILE} {why}; give the folder that build-map wrote", field=FILE
        ) from error
    return parsed_manifest(data, str(path))


def parsed_manifest(data: bytes, where: str) -> Manifest:
    """Check the content of a manifest.

    Args:
        data: content of ``manifest.json``.
        where: path or URL of the file, for messages.

    Raises:
        BundleError: the manifest is malformed, of another format version, or inconsistent.
    """
    _require_format(where, data)
    try:
        manifest = Manifest.model_validate_json(data)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        part = ".".join(str(each) for each in first["loc"])
        raise BundleError(f"{where}: {part}: {first['msg']}; copy or build the bundle again", field=FILE) from error
    _require_consistent(where, manifest)
    return manifest


def dataset_error(directory: Path) -> BundleError | None:
    """Return the error for a dataset that was given as a map bundle; None if the folder is no dataset.

    Args:
        directory: a folder without a manifest.
    """
    try:
        if not (directory / DATASET_FILE).is_file():
            return None
    except OSError:  # a folder that nobody may read; the caller reports it
        return None
    return BundleError(
        f"{directory}: a dataset, not a map bundle; run `streetfix build-map {directory} --out BUNDLE`, and give BUNDLE",
        field=FILE,
    )


def _require_format(where: str, data: bytes) -> None:
    try:
        document = json.loads(data)
        found = document["format"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise BundleError(f"{where}: not a valid manifest; copy or build the bundle again", field=FILE) from error
    if found != FORMAT:
        raise BundleError(
            f"{where}: format {found!r}, but this release reads format {FORMAT}; build the map with this release, "
            "or serve it with the release that built it",
            field=FILE,
        )


def _require_consistent(where: str, manifest: Manifest) -> None:
    grid = manifest.grid
    if manifest.version != manifest.expected_version():
        what = f"version {manifest.version} does not match the content ({manifest.expected_version()})"
    elif len(manifest.rows_seen) != grid.rows:
        what = f"rows_seen has {len(manifest.rows_seen)} entries for {grid.rows} rows of the view grid"
    elif grid.elevation_bottom_deg >= grid.elevation_top_deg or grid.min_range_m >= grid.max_range_m:
        what = "the limits of the view grid are reversed"
    elif "lidar_height_m" not in manifest.parameters:
        what = "parameters.lidar_height_m is missing"
    elif wrong := not_on_earth(manifest.georeference):
        what = f"georeference: {wrong}"
    elif bad := [name for name in manifest.files if not is_confined(name)]:
        what = f"the file {bad[0]!r} is outside the bundle"
    elif wrong := _wrong_tiles(manifest):
        what = f"tiles: {wrong}"
    else:
        return
    raise BundleError(f"{where}: {what}; copy or build the bundle again", field=FILE)


def _wrong_tiles(manifest: Manifest) -> str | None:
    """Return what is wrong with the tiles, or None if they are valid or the map has none."""
    tiles, counts = manifest.tiles, manifest.counts
    if (manifest.tile_m is None) != (not tiles):
        return "tile_m and tiles must both be there, or both be missing"
    order = [(tile.column, tile.row) for tile in tiles]
    if order != sorted(set(order)):
        return "a column and row occurs twice, or the order is wrong"
    for part in ("places", "views", "cloud_points") if tiles else ():
        if (total := sum(getattr(tile.counts, part) for tile in tiles)) != getattr(counts, part):
            return f"the counts give {getattr(counts, part)} {part}, but the tiles have {total}"
    return None


def not_on_earth(georeference: Mapping[str, Any] | None) -> str | None:
    """Return what is wrong with a georeference, or None if it is valid.

    Args:
        georeference: arguments of ``Georeference``. None is valid.
    """
    try:
        if georeference is not None:
            Georeference(**georeference)
    except (TypeError, ValueError) as error:
        return str(error)
    return None


def is_confined(name: str) -> bool:
    """Check that a file name is a plain relative path inside the bundle.

    Args:
        name: path with ``/`` between folders. The name of the manifest itself is not allowed.
    """
    parts = name.split("/")
    plain = all(part and part not in (".", "..") and not set(part) & set("\\:\0") for part in parts)
    return plain and name != FILE
