"""Open a map bundle: check its files, then map them into memory."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int32
from numpy.typing import NDArray

from service.errors import BundleError
from service.geometry.earth import Georeference
from service.imaging.npy_header import NPY_HEADER_ERRORS
from service.imaging.view_grid import ViewGrid
from service.maps import content as parts
from service.maps import index, inverted_file, streets
from service.maps.calibration import Calibration, read_calibration
from service.maps.index import ViewIndex
from service.maps.inverted_file import InvertedFile
from service.maps.manifest import Manifest, read_manifest
from service.maps.streets import Streets
from service.maps.writer import sha256_of
from service.registration.surfel_map import SurfelMap

_NEEDED = (parts.ENCODER_FILE, index.FILE, parts.PLACES_FILE, parts.VIEWS_FILE, parts.CALIBRATION_FILE)
_REMEDY = "copy or build the bundle again"


@dataclass(frozen=True, slots=True, eq=False)
class MapBundle:
    """An open map bundle. Threads may share it: the arrays of its files are read-only and memory-mapped.

    Attributes:
        path: the bundle's folder.
        manifest: the checked manifest.
        grid: the view grid of the map views.
        rows_seen: True for the rows of the view grid that the survey's sensor covers.
        places: (P,) of dtype ``PLACE``.
        views: (V,) of dtype ``VIEW``, sorted by place.
        view_index: index of the descriptors.
        streets: street polygons. None if the map has none.
        streets_document: GeoJSON of the streets. It stays in memory, because the bundle's folder may be removed while the
            service still uses the map.
        calibration: confidence calibration. None if the map is not calibrated.
        cloud: the prepared cloud. None if the map has nothing to register against.
        places_xy: x of all places, then y of all places, map frame, metres. In memory.
    """

    path: Path
    manifest: Manifest
    grid: ViewGrid
    rows_seen: Bool[NDArray[np.bool_], " rows"]
    places: NDArray[Any]
    views: NDArray[Any]
    view_index: ViewIndex
    streets: Streets | None
    streets_document: bytes | None
    calibration: Calibration | None
    cloud: SurfelMap | None
    places_xy: Float64[NDArray[np.float64], "2 P"] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "places_xy", np.ascontiguousarray(self.T_map_place[:, :2, 3].T))

    @classmethod
    def open(cls, path: Path, *, verify: bool = True) -> "MapBundle":
        """Open a bundle that ``write_bundle`` wrote.

        Args:
            path: the bundle's folder.
            verify: compare the hash of every file with the manifest, and check every index of the cloud and of the inverted file.
                Sizes and shapes are always checked.

        Raises:
            BundleError: the bundle is missing, damaged, of another format, or inconsistent. The message names the file and
                the remedy.
        """
        manifest = read_manifest(path)
        _require_files(path, manifest, verify=verify)
        document = _read(path / streets.FILE) if streets.FILE in manifest.files else None
        bundle = cls(
            path=path,
            manifest=manifest,
            grid=manifest.view_grid,
            rows_seen=np.array(manifest.rows_seen, np.bool_),
            places=_load(path / parts.PLACES_FILE, expected=parts.PLACE),
            views=_load(path / parts.VIEWS_FILE, expected=parts.VIEW),
            view_index=_view_index(path, manifest, verify=verify),
            streets=None if document is None else Streets.from_geojson(_json_object(document, path / streets.FILE)),
            streets_document=document,
            calibration=read_calibration(_read(path / parts.CALIBRATION_FILE), path=str(path / parts.CALIBRATION_FILE)),
            cloud=_cloud(path, manifest, verify=verify),
        )
        _require_consistent(bundle)
        return bundle

    @property
    def name(self) -> str:
        """Name of the map in requests."""
        return self.manifest.name

    @property
    def T_map_place(self) -> Float64[NDArray[np.float64], "P 4 4"]:
        """Levelled pose of each place: x forward, z up, the LiDAR at the origin."""
        poses: Float64[NDArray[np.float64], "P 4 4"] = self.places["T_map_place"]
        return poses

    @property
    def place_street(self) -> Int32[NDArray[np.int32], " P"]:
        """Index of each place's street feature; -1 for none."""
        numbers: Int32[NDArray[np.int32], " P"] = self.places["street"]
        return numbers

    @property
    def view_place(self) -> Int32[NDArray[np.int32], " V"]:
        """Index of the place of each view."""
        numbers: Int32[NDArray[np.int32], " V"] = self.views["place"]
        return numbers

    @property
    def view_heading_rad(self) -> Float64[NDArray[np.float64], " V"]:
        """Heading of each view, radians, counter-clockwise from map x."""
        headings: Float64[NDArray[np.float64], " V"] = self.views["heading_rad"]
        return headings

    @property
    def earth(self) -> Georeference | None:
        """WGS-84 position of the map's origin. None if the manifest has no georeference."""
        georeference = self.manifest.georeference
        return None if georeference is None else Georeference(**georeference)

    def encoder_bytes(self) -> bytes:
        """Return the content of the encoder's ONNX file.

        Raises:
            BundleError: the file cannot be read, for example because the bundle was removed after opening.
        """
        return _read(self.path / parts.ENCODER_FILE)

    def streets_geojson(self) -> bytes:
        """Return the streets' GeoJSON as in the file, or an empty collection if the map has none."""
        if self.streets_document is None:
            return b'{"type": "FeatureCollection", "features": []}\n'
        return self.streets_document


def _require_files(path: Path, manifest: Manifest, *, verify: bool) -> None:
    for name in _NEEDED:
        if name not in manifest.files:
            raise _defect(path / name, "not listed in the manifest")
    for name, entry in manifest.files.items():
        file = path / name
        if not file.is_file() or not file.resolve().is_relative_to(path.resolve()):
            raise _defect(file, "missing, or outside the bundle")
        try:
            size = file.stat().st_size
            found = sha256_of(file) if verify and size == entry.size else entry.sha256
        except OSError as error:  # for example, somebody removes the bundle meanwhile
            raise _defect(file, f"cannot be read ({error.strerror})") from error
        if size != entry.size:
            raise _defect(file, f"{size} bytes instead of {entry.size}")
        if found != entry.sha256:
            raise _defect(file, "the hash does not match the manifest")
    if manifest.files[parts.ENCODER_FILE].sha256 != manifest.encoder_sha256:
        raise _defect(path / parts.ENCODER_FILE, "not the encoder that computed the descriptors")


def _view_index(path: Path, manifest: Manifest, *, verify: bool) -> ViewIndex:
    inverted = None
    if inverted_file.FILE in manifest.files:
        inverted = InvertedFile.open(
            path / inverted_file.FILE,
            views=manifest.counts.views,
            dimension=manifest.counts.descriptor_size,
            headings=manifest.headings,
            verify=verify,
        )
    return ViewIndex.open(path / index.FILE, shortlister=inverted)


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:  # for example, somebody removes the bundle meanwhile
        raise _defect(path, f"cannot be read ({error.strerror})") from error


def _load(path: Path, *, expected: np.dtype[Any] | None) -> NDArray[Any]:
    try:
        array = np.load(path, allow_pickle=False, mmap_mode="r")
    except (OSError, *NPY_HEADER_ERRORS) as error:
        raise _defect(path, f"not a valid NPY array ({error})") from error
    if expected is not None and (array.dtype != expected or array.ndim != 1):
        raise _defect(path, f"{array.dtype} in {array.ndim} dimensions instead of {expected} in 1")
    return array  # type: ignore[no-any-return]  # np.load is not typed for one array


def _json_object(content: bytes, path: Path) -> dict[str, Any]:
    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise _defect(path, "not valid JSON") from error
    if not isinstance(document, dict):
        raise _defect(path, "not a JSON object")
    return document


def _cloud(path: Path, manifest: Manifest, *, verify: bool) -> SurfelMap | None:
    prefix, suffix = f"{parts.CLOUD_FOLDER}/", ".npy"
    names = [name for name in manifest.files if name.startswith(prefix) and name.endswith(suffix)]
    if not names:
        return None
    arrays = {name.removeprefix(prefix).removesuffix(suffix): _load(path / name, expected=None) for name in names}
    try:
        return SurfelMap.from_arrays(arrays, verify=verify)
    except BundleError as error:
        raise BundleError(f"{path}/{error}", field=error.field) from error


def _require_consistent(bundle: MapBundle) -> None:
    counts, path = bundle.manifest.counts, bundle.path
    streets_found = 0 if bundle.streets is None else len(bundle.streets)
    found = {
        parts.PLACES_FILE: (len(bundle.places), counts.places, "places"),
        parts.VIEWS_FILE: (len(bundle.views), counts.views, "views"),
        index.FILE: (len(bundle.view_index), counts.views, "descriptors"),
        streets.FILE: (streets_found, counts.streets, "streets"),
        parts.CLOUD_FOLDER: (0 if bundle.cloud is None else len(bundle.cloud.surfels), counts.cloud_points, "points"),
    }
    for name, (has, expected, what) in found.items():
        if has != expected:
            raise _defect(path / name, f"{has} {what} instead of {expected}")
    if bundle.view_index.dimension != counts.descriptor_size:
        raise _defect(
            path / index.FILE,
            f"descriptors of {bundle.view_index.dimension} numbers instead of {counts.descriptor_size}",
        )
    if bundle.view_place.min() < 0 or bundle.view_place.max() >= counts.places:
        raise _defect(path / parts.VIEWS_FILE, "a view refers to a missing place")
    if bundle.place_street.min() < -1 or bundle.place_street.max() >= streets_found:
        raise _defect(path / parts.PLACES_FILE, "a place refers to a missing street")
    if not np.array_equal(bundle.view_place, np.repeat(np.arange(counts.places), bundle.manifest.headings)):
        raise _defect(path / parts.VIEWS_FILE, "the views are not sorted by place, with all headings of each place")
    if not np.isfinite(bundle.view_heading_rad).all():
        raise _defect(path / parts.VIEWS_FILE, "a heading is not finite")
    if not parts.are_poses(bundle.T_map_place):
        raise _defect(path / parts.PLACES_FILE, parts.NO_POSE)


def _defect(path: Path, what: str) -> BundleError:
    return BundleError(f"{path}: {what}; {_REMEDY}", field=path.name)
