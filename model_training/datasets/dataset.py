"""The dataset folder: ``simulate`` and ``import`` write it, ``build-map`` and ``evaluate`` read it.

Frames are read one at a time. No function loads a whole traversal.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)

from model_training.datasets.files import ROW_BYTES, read_bytes, read_rows, reading, size_of
from model_training.datasets.frames import MovedFrame, georeference_of, require_near
from service.errors import DatasetError, StreetfixError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import quaternion_xyzw_from, rotation_from_quaternion_xyzw, transform_from
from service.imaging.decode import ImageLimits, decode_depth, decode_rgb
from service.imaging.level import GivenHeight
from service.imaging.view_grid import ViewGrid
from service.maps import manifest
from service.option_limits import (
    HEIGHT_STD_M,
    LEAST_HEIGHT_M,
    LEAST_HEIGHT_STD_M,
    MOST_HEIGHT_M,
    MOST_HEIGHT_STD_M,
)
from service.retrieval.query import DepthFormat, Query, decoded_query

#: Version of the folder's format.
FORMAT = 1
#: File of a query set with the poses of the camera by odometry, TUM format, a line per image.
ODOMETRY_FILE = "odometry.txt"
#: Homogeneous transforms (n, 4, 4), metres.
Transforms = NDArray[np.float64]
#: File endings of colour images.
PICTURES = (".jpg", ".jpeg", ".png", ".webp")
#: Form of a pose in TUM format, for messages.
TUM_LINE = "`timestamp x y z qx qy qz qw` (seconds, metres, unit quaternion)"

#: Name, size in bytes and modification time in nanoseconds of a scan's file.
ScanFile = tuple[str, int, int]
#: Progress callback: stage, number done, number of all.
Report = Callable[[str, int, int], None]

#: Upper limits of ``SurveyAccuracy``.
MOST_SURVEY_STD_M, MOST_SURVEY_STD_DEG = 5.0, 5.0


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class LidarSensor(_Model):
    """A LiDAR of the survey.

    Attributes:
        name: name of the sensor.
        channels: number of beams; None: unknown.
        top_deg: elevation of the highest beam, degrees; None: unknown.
        bottom_deg: elevation of the lowest beam, degrees; None: unknown.
        max_range_m: largest range, metres; None: unknown.
        T_vehicle_sensor: pose (4, 4) in the vehicle frame, metres; None: unknown.
    """

    name: str
    channels: int | None = None
    top_deg: float | None = None
    bottom_deg: float | None = None
    max_range_m: float | None = None
    T_vehicle_sensor: list[list[float]] | None = None


class DepthSpec(_Model):
    """How the numbers of a depth image become metres: value * ``scale_m`` is z, range or disparity.

    Attributes:
        scale_m: metres per stored unit; for disparity, pixels per stored unit.
        kind: stored quantity.
        max_range_m: larger depths count as not measured, metres; None: no limit.
        baseline_m: baseline of the stereo rig, metres; None: unknown or no stereo.
    """

    scale_m: float = 0.001
    kind: Literal["z", "range", "disparity"] = "z"
    max_range_m: float | None = None
    baseline_m: float | None = None


class CameraSensor(_Model):
    """A rectified camera and its depth.

    Attributes:
        name: name of the sensor.
        width: image width, pixels.
        height: image height, pixels.
        fx: focal length along the rows, pixels.
        fy: focal length along the columns, pixels.
        cx: column of the principal point, pixels.
        cy: row of the principal point, pixels.
        depth: format of its depth images.
        T_vehicle_sensor: pose (4, 4) in the vehicle frame, metres; None: unknown.
        height_m: height above the ground, metres; None: the localizer finds it in each depth image.
        height_std_m: standard deviation of ``height_m``, metres; None: the default of a request.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    depth: DepthSpec = DepthSpec()
    T_vehicle_sensor: list[list[float]] | None = None
    height_m: float | None = Field(None, ge=LEAST_HEIGHT_M, le=MOST_HEIGHT_M)
    height_std_m: float | None = Field(None, ge=LEAST_HEIGHT_STD_M, le=MOST_HEIGHT_STD_M)

    @model_validator(mode="after")
    def _deviation_of_a_height(self) -> Self:
        if self.height_m is None and self.height_std_m is not None:
            raise ValueError(f"camera {self.name!r} has height_std_m, but no height_m; give both or neither")
        return self

    @model_serializer(mode="wrap")
    def _without_unknown_height(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave an unknown height out, so that a release that does not know the fields can read the dataset."""
        content: dict[str, Any] = serialize(self)
        return {name: value for name, value in content.items() if value is not None or not name.startswith("height_")}

    def given_height(self) -> GivenHeight | None:
        """Return the height above the ground with its standard deviation; None if it is unknown."""
        if self.height_m is None:
            return None
        return GivenHeight(self.height_m, HEIGHT_STD_M if self.height_std_m is None else self.height_std_m)

    def pinhole(self) -> PinholeCamera:
        """Return the intrinsics."""
        return PinholeCamera(self.width, self.height, self.fx, self.fy, self.cx, self.cy)


class Sensors(_Model):
    """All sensors of a dataset.

    Attributes:
        lidars: LiDARs of the survey.
        cameras: cameras of the queries. The first is the default.
    """

    lidars: list[LidarSensor] = []
    cameras: list[CameraSensor] = []


class SurveyAccuracy(_Model):
    """Accuracy of the survey's poses against the Earth or the world of a simulation.

    Attributes:
        position_std_m: standard deviation of the position per axis, metres.
        angle_std_deg: standard deviation of each angle, degrees.
    """

    position_std_m: float = Field(ge=0, le=MOST_SURVEY_STD_M)
    angle_std_deg: float = Field(ge=0, le=MOST_SURVEY_STD_DEG)


class DatasetDescription(_Model):
    """Content of ``dataset.json``.

    Attributes:
        format: version of the folder's format.
        name: name of the dataset.
        source: origin of the data.
        sensors: all sensors.
        georeference: position of the map frame on the Earth; None: unknown.
        conditions: weather and light of the survey and the queries.
        seed: seed of a simulation; None: not simulated.
        survey_accuracy: accuracy of the survey's poses; None: unknown.
    """

    format: int = FORMAT
    name: str
    source: dict[str, Any]
    sensors: Sensors
    georeference: dict[str, Any] | None = None
    conditions: dict[str, Any] = {}
    seed: int | None = None
    survey_accuracy: SurveyAccuracy | None = None

    @model_serializer(mode="wrap")
    def _without_unknown_accuracy(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave an unknown accuracy out, so that a release that does not know the field can read the dataset."""
        content: dict[str, Any] = serialize(self)
        return {name: value for name, value in content.items() if value is not None or name != "survey_accuracy"}


@dataclass(frozen=True, slots=True)
class QueryFrame:
    """One query of a query set.

    Attributes:
        number: number in the query set.
        rgb_path: colour image.
        depth_path: depth image.
        camera: camera of both images.
        T_map_camera: ground truth (4, 4), optical frame to map frame, metres; None: unknown.
        stamp_s: timestamp of the ground truth, seconds; None: unknown.
    """

    number: int
    rgb_path: Path
    depth_path: Path
    camera: CameraSensor
    T_map_camera: NDArray[np.float64] | None
    stamp_s: float | None

    def rgb(self) -> NDArray[np.uint8]:
        """Return the colour image (H, W, 3).

        Raises:
            DatasetError: the file vanished or is damaged.
        """
        data = read_bytes(self.rgb_path)
        with _decoding(self.rgb_path):
            return decode_rgb(data, limits=ImageLimits())

    def depth_m(self) -> NDArray[np.float32]:
        """Return the depth (H, W), z in metres; 0 where nothing was measured.

        Raises:
            DatasetError: the file vanished or is damaged.
        """
        spec, data = self.camera.depth, read_bytes(self.depth_path)
        with _decoding(self.depth_path):
            return decode_depth(
                data,
                encoding=None,
                scale_m=spec.scale_m,
                kind=spec.kind,
                camera=self.camera.pinhole(),
                baseline_m=spec.baseline_m,
                max_range_m=spec.max_range_m,
                limits=ImageLimits(),
            )

    def query(self, grid: ViewGrid) -> Query:
        """Return the query that the service makes of these images, with default options.

        Args:
            grid: view grid of the map.

        Raises:
            DatasetError: an image vanished or is damaged.
        """
        spec = self.camera.depth
        how = DepthFormat(
            kind=spec.kind, scale_m=spec.scale_m, baseline_m=spec.baseline_m, max_range_m=spec.max_range_m
        )
        rgb, depth = read_bytes(self.rgb_path), read_bytes(self.depth_path)
        with _decoding(self.rgb_path, self.depth_path):
            query = decoded_query(rgb, depth, self.camera.pinhole(), how, grid=grid)
        return replace(query, camera_height=self.camera.given_height())

    def request(self) -> dict[str, Any]:
        """Return the camera and depth parts of a request to the service, as ``streetfix localize --camera`` takes them."""
        return {
            "camera": self.camera.model_dump(
                include={"width", "height", "fx", "fy", "cx", "cy", "height_m", "height_std_m"}
            ),
            "depth": self.camera.depth.model_dump(exclude_none=True),
        }


class Dataset:
    """An opened dataset folder.

    Args:
        folder: folder that contains ``dataset.json``.

    Attributes:
        folder: the dataset folder.
        description: content of ``dataset.json``. Its georeference is that of ``frame``, if the dataset has been moved.
        frame: map frame that replaces that of the folder. None: the dataset keeps its own.

    Raises:
        DatasetError: ``dataset.json`` is missing, damaged or of another format, or the folder is a map bundle.
    """

    frame: MovedFrame | None = None

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        path = folder / "dataset.json"
        if not path.is_file():
            if (folder / manifest.FILE).is_file():
                raise DatasetError(
                    f"{folder} is a map bundle, not a dataset: give the folder that `streetfix simulate` or `streetfix import` wrote",
                    field="dataset.json",
                )
            raise DatasetError(
                f"{folder} is not a complete dataset: dataset.json is missing; run `streetfix simulate` or `streetfix "
                "import` (again)",
                field="dataset.json",
            )
        try:
            self.description = DatasetDescription.model_validate_json(read_bytes(path))
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise DatasetError(f"{path}: {where}: {first['msg']}", field=where) from error
        if self.description.format != FORMAT:
            raise DatasetError(
                f"{path}: format {self.description.format} is not {FORMAT}; create the dataset again", field="format"
            )

    @property
    def name(self) -> str:
        """Return the name of the dataset."""
        return self.description.name

    @property
    def place(self) -> str:
        """Where the dataset is, for error messages: the folder, or the URL in object storage."""
        return str(self.folder)

    def in_frame(self, georeference: Mapping[str, Any] | None) -> Self:
        """Return this dataset with poses, ground truth and streets in another map frame.

        A dataset whose position on the Earth is unknown stays as it is, and so does every dataset if the other frame's is unknown.

        Args:
            georeference: of the other frame, as in ``dataset.json``. None: unknown.

        Raises:
            DatasetError: a georeference is no place on the Earth, the poses of the survey are damaged, or the survey is too far from the
                origin of the other frame (``FARTHEST_M``). Without a survey, the origin of the dataset's own frame counts.
        """
        own = self.description.georeference
        if own is None or georeference is None or own == georeference:
            return self
        moved_to = georeference_of(georeference, "the map")
        if self.frame is not None:
            frame = replace(self.frame, moved_to=moved_to)
        else:
            heights_m = self.survey_poses()[:, 2, 3] if self._has_survey() else np.zeros(0)
            ground_m = float(heights_m.mean()) if len(heights_m) else 0.0
            frame = MovedFrame(georeference_of(own, f"{self.folder}/dataset.json"), moved_to, ground_m)
        found = self.moved(frame)
        # Queries without a survey lie near the origin of their own frame.
        at = found.survey_poses() if self._has_survey() else frame.poses(np.eye(4)[None])
        require_near(at[:, :3, 3], str(self.folder))
        return found

    def moved(self, frame: MovedFrame | None) -> Self:
        """Return this dataset with a frame that replaces that of its folder.

        Args:
            frame: the frame; None changes nothing.
        """
        if frame is None:
            return self
        found = copy(self)
        found.frame = frame
        found.description = self.description.model_copy(update={"georeference": frame.georeference})
        return found

    def _has_survey(self) -> bool:
        return (self.folder / "survey" / "poses.txt").is_file()

    def streets(self) -> dict[str, Any] | None:
        """Return the GeoJSON of the streets, or None if the dataset has none.

        Raises:
            DatasetError: the file vanished, is not JSON, or has a feature without a geometry.
        """
        path = self.folder / "streets.geojson"
        if not path.exists():
            return None
        try:
            loaded: dict[str, Any] = json.loads(read_bytes(path))
        except (ValueError, RecursionError) as error:
            raise DatasetError(f"{path}: not valid JSON: {error}", field="streets.geojson") from error
        return loaded if self.frame is None else self.frame.streets(loaded)

    def survey_poses(self) -> Transforms:
        """Return T_map_lidar of every scan (n, 4, 4), metres.

        Raises:
            DatasetError: the pose file is missing or damaged.
        """
        return self.survey_trajectory()[1]

    def survey_trajectory(self) -> tuple[NDArray[np.float64], Transforms]:
        """Return the time (n,) in seconds and T_map_lidar (n, 4, 4) in metres of every scan.

        Raises:
            DatasetError: the pose file is missing or damaged.
        """
        stamps, poses = read_tum(self.folder / "survey" / "poses.txt")
        return stamps, poses if self.frame is None else self.frame.poses(poses)

    def fetch(self, numbers: NDArray[np.int64], report: Report = lambda *_: None) -> None:
        """Bring scans to this machine before several stages read them. Those of a folder are there.

        Args:
            numbers: numbers of the scans (n,).
            report: called with the fetched MB.

        Raises:
            DatasetError: a scan cannot be fetched.
        """

    def scan(self, number: int) -> NDArray[np.float32]:
        """Return a scan (n, 4): x, y, z in the LiDAR frame (m) and intensity.

        Points that are not finite are left out. An intensity that is negative or not finite becomes 0.

        Args:
            number: number of the scan.

        Raises:
            DatasetError: the file is missing, truncated or cannot be read.
        """
        path = scan_path(self.folder, number)
        if not path.is_file():
            raise DatasetError(f"{path} is missing, but survey/poses.txt has a line for it", field=str(path.name))
        size = size_of(path)
        if size == 0 or size % ROW_BYTES:
            raise DatasetError(
                f"{path}: {size} bytes are not a multiple of 16 (rows of four float32); the file is truncated",
                field=str(path.name),
            )
        points = read_rows(path, size)
        if not np.isfinite(points).all():  # rarely
            points = points[np.isfinite(points[:, :3]).all(axis=1)]
            points[:, 3] = np.nan_to_num(points[:, 3], posinf=0.0)
        np.maximum(points[:, 3], 0.0, out=points[:, 3])
        return points

    def number_in_survey(self, number: int) -> int:
        """Return the index of a scan in the whole survey. It differs from ``number`` if this dataset is a part of a survey.

        Args:
            number: number of the scan.
        """
        return number

    def scan_files(self) -> Iterator[ScanFile]:
        """Yield the files of the scans, sorted by name.

        Raises:
            DatasetError: the folder cannot be read.
        """
        folder = self.folder / "survey" / "scans"
        with reading(folder):
            found = sorted(folder.iterdir()) if folder.is_dir() else []
        return self._files_at(found)

    def _files_at(self, paths: Iterable[Path]) -> Iterator[ScanFile]:
        for path in paths:
            with reading(path), suppress(FileNotFoundError):  # a scan that is missing is reported when it is read
                state = path.stat()
                yield path.name, state.st_size, state.st_mtime_ns

    def query_sets(self, *, with_truth: bool = False) -> list[str]:
        """Return the names of the query sets, sorted.

        Args:
            with_truth: only query sets with ground truth.

        Raises:
            DatasetError: the folder cannot be read.
        """
        root = self.folder / "queries"
        with reading(root):
            names = sorted(p.name for p in root.iterdir() if (p / "rgb").is_dir()) if root.is_dir() else []
        return [n for n in names if not with_truth or (root / n / "poses.txt").exists()]

    def odometry(self, name: str) -> Transforms | None:
        """Return T_odom_camera of every image of a query set (n, 4, 4), metres; None if the set has no odometry.

        The frame ``odom`` is fixed, and the poses drift in it. ``streetfix calibrate --drive`` labels answers with them.

        Args:
            name: name of the query set.

        Raises:
            DatasetError: the file is damaged.
        """
        path = query_folder(self.folder, name) / ODOMETRY_FILE
        return read_tum(path)[1] if path.exists() else None

    def queries(self, name: str) -> Iterator[QueryFrame]:
        """Yield the frames of a query set, one at a time.

        Args:
            name: name of the query set.

        Raises:
            DatasetError: the query set or the camera is unknown, or a file is missing, damaged or contradicts another file.
        """
        folder = query_folder(self.folder, name)
        if not (folder / "rgb").is_dir():
            known = ", ".join(self.query_sets()) or "none"
            raise DatasetError(f"{self.folder} has no query set {name!r}; it has: {known}", field="queries")
        poses_path = folder / "poses.txt"
        stamps, truth = read_tum(poses_path) if poses_path.exists() else (None, None)
        if self.frame is not None and truth is not None:
            truth = self.frame.poses(truth)
        with reading(folder / "rgb"):
            pictures = sorted(p for p in (folder / "rgb").iterdir() if p.suffix in PICTURES and p.stem.isdigit())
        names = _camera_names(folder, len(pictures))
        cameras = {camera.name: camera for camera in self.description.sensors.cameras}
        if not cameras:
            raise DatasetError(
                f"{self.folder}/dataset.json has no camera; add the camera of the queries to sensors.cameras",
                field="sensors.cameras",
            )
        first = next(iter(cameras))
        for rgb_path in pictures:
            number = int(rgb_path.stem)
            depth_path = next((p for p in (folder / "depth").glob(f"{rgb_path.stem}.*")), None)
            if depth_path is None:
                raise DatasetError(
                    f"{folder}/depth has no image {rgb_path.stem}; add it, or remove {rgb_path.name} from rgb",
                    field="depth",
                )
            if truth is not None and number >= len(truth):
                raise DatasetError(
                    f"{poses_path} has {len(truth)} poses, none for {rgb_path.name}; add one line per image, "
                    "or remove the file if the ground truth is unknown",
                    field="poses.txt",
                )
            camera_name = names[number] if names else first
            if camera_name not in cameras:
                raise DatasetError(
                    f"{folder}/cameras.txt names {camera_name!r}, but dataset.json has {', '.join(cameras)}; "
                    "use one of these names, or add the camera to sensors.cameras",
                    field="cameras.txt",
                )
            yield QueryFrame(
                number,
                rgb_path,
                depth_path,
                cameras[camera_name],
                T_map_camera=None if truth is None else truth[number],
                stamp_s=None if stamps is None else float(stamps[number]),
            )


@contextmanager
def _decoding(*paths: Path) -> Iterator[None]:
    """Name the files in errors of decoding. The decoder itself names a field of a request, which does not apply here."""
    try:
        yield
    except StreetfixError as error:
        raise DatasetError(f"{', '.join(map(str, paths))}: {error.message}", field=paths[0].name) from error


def _camera_names(folder: Path, count: int) -> list[str] | None:
    """Return the names in ``cameras.txt`` (one line per query), or None if all frames are of the first camera."""
    path = folder / "cameras.txt"
    if not path.exists():
        return None
    names = read_bytes(path).decode(errors="replace").split()
    if len(names) != count:
        raise DatasetError(
            f"{path} has {len(names)} names for {count} images; write one camera name per image, "
            "or remove the file if all images are of the first camera",
            field="cameras.txt",
        )
    return names


def require_map_first(bundle: Path, dataset: Path, command: str) -> None:
    """Refuse a dataset and a map bundle that a user gave in the wrong order.

    Args:
        bundle: folder given as the map bundle.
        dataset: folder given as the dataset.
        command: command of `streetfix` that takes both, for the message.

    Raises:
        DatasetError: the first folder is a dataset and the second one a map bundle.
    """
    if (bundle / manifest.DATASET_FILE).is_file() and (dataset / manifest.FILE).is_file():
        raise DatasetError(
            f"{bundle} is a dataset and {dataset} is a map bundle: give the map bundle first: streetfix {command} {dataset} {bundle}",
            field="dataset.json",
        )


def scan_path(folder: Path, number: int) -> Path:
    """Return the path of a scan.

    Args:
        folder: dataset folder.
        number: number of the scan.
    """
    return folder / "survey" / "scans" / f"{number:06d}.bin"


def query_folder(folder: Path, name: str) -> Path:
    """Return the folder of a query set.

    Args:
        folder: dataset folder.
        name: name of the query set.
    """
    return folder / "queries" / name


def write_description(folder: Path, description: DatasetDescription) -> None:
    """Write ``dataset.json``. Call this last: the file marks the dataset as complete.

    Args:
        folder: dataset folder.
        description: content of the file.
    """
    part = folder / "dataset.json.part"
    part.write_text(description.model_dump_json(indent=2) + "\n")
    part.rename(folder / "dataset.json")


def write_tum(path: Path, timestamps: NDArray[np.float64], transforms: Transforms) -> None:
    """Write poses in TUM format (timestamp x y z qx qy qz qw). The file gets its name when it is complete.

    Args:
        path: file to write. Missing parent folders are created.
        timestamps: times (n,), seconds.
        transforms: poses (n, 4, 4), metres.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    with part.open("w") as file:
        for stamp, T in zip(timestamps, transforms, strict=True):
            numbers = [*T[:3, 3], *quaternion_xyzw_from(T[:3, :3])]
            file.write(f"{stamp:.6f} " + " ".join(f"{x:.9f}" for x in numbers) + "\n")
    part.rename(path)


def read_tum(path: Path) -> tuple[NDArray[np.float64], Transforms]:
    """Return the timestamps (n,) in seconds and the transforms (n, 4, 4) in metres of a TUM file.

    Args:
        path: file to read.

    Raises:
        DatasetError: the file is missing, or a line is not a pose.
    """
    if not path.is_file():
        raise DatasetError(f"{path} is missing; write one pose per line: {TUM_LINE}", field=path.name)
    stamps, transforms = [], []
    for number, line in enumerate(read_bytes(path).decode(errors="replace").splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            values = np.array(line.split(), np.float64)
        except ValueError as error:
            raise DatasetError(
                f"{path}, line {number}: not numbers: {line[:60]!r}; write {TUM_LINE}", field=path.name
            ) from error
        if len(values) != 8 or not np.isfinite(values).all() or np.linalg.norm(values[4:]) < 1e-6:
            raise DatasetError(
                f"{path}, line {number}: not a pose: {line[:60]!r}; write {TUM_LINE}, all finite, with a quaternion that is not zero",
                field=path.name,
            )
        stamps.append(values[0])
        transforms.append(transform_from(rotation_from_quaternion_xyzw(values[4:]), values[1:4]))
    return np.array(stamps), np.array(transforms).reshape(-1, 4, 4)
