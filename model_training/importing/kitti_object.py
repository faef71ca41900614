"""Import KITTI's object layout: single frames, each at its own place.

A frame with a scan is a place of the map. A frame with a right image is a query too: in the set ``frames`` if the map has
its place, otherwise in the set ``elsewhere``. Frames of other years have other cameras, so every query names its camera.
"""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import (
    CameraSensor,
    DatasetDescription,
    DepthSpec,
    Sensors,
    query_folder,
    scan_path,
    write_description,
    write_tum,
)
from model_training.datasets.whole_folder import whole_or_not_at_all
from model_training.importing.kitti_calibration import KittiCalibration, read_calibration
from model_training.importing.kitti_files import copy_scan, damaged, read_rgb, read_stored_depth
from model_training.importing.kitti_sequence import HDL64
from model_training.importing.stereo import RECORDED, depth_from_stereo
from service.errors import DatasetError
from service.geometry.rigid import Transform, inverse, transform_from

DepthSource = Literal["stored", "sgbm"]
Progress = Callable[[int, int], None]

#: Distance between the places of frames, metres: larger than any range, so that no place sees another.
PLACE_SPACING_M = 1000.0
#: Step of KITTI's stored depth, metres; 16 bits reach 256 m.
DEPTH_SCALE_M = 1 / 256
_KINDS, _SUFFIXES = ("image_2", "image_3", "velodyne"), (".png", ".jpg", ".bin")


@dataclass(frozen=True, slots=True)
class KittiObjectSummary:
    """What was imported.

    Attributes:
        places: number of map places.
        frames: number of queries whose place is in the map.
        elsewhere: number of out-of-map queries.
        cameras: number of different cameras.
        skipped: every frame that was left out, with the reason.
    """

    places: int
    frames: int
    elsewhere: int
    cameras: int
    skipped: tuple[str, ...]


@dataclass(slots=True)
class _QuerySet:
    """A query set while it is written."""

    names: list[str] = field(default_factory=list)
    cameras: list[str] = field(default_factory=list)
    poses: list[Transform] = field(default_factory=list)


def import_kitti_object(
    source: Path, out: Path, *, depth: DepthSource, progress: Progress | None = None
) -> KittiObjectSummary:
    """Import a folder of KITTI's object layout as a dataset.

    Args:
        source: the folder ``training``, or the folder that holds it.
        out: the dataset to write; it appears only when it is complete.
        depth: ``stored`` takes ``gt_depth`` (16 bits, metres x 256); ``sgbm`` matches the left and right image.
        progress: called with the frames done and all frames.

    Raises:
        DatasetError: there is nothing to import, ``out`` already exists, or a file is missing or damaged.
    """
    training = source / "training" if (source / "training").is_dir() else source
    names = sorted({p.stem for kind in _KINDS for p in (training / kind).glob("*") if p.suffix in _SUFFIXES})
    if not names:
        raise DatasetError(
            f"{source} has no frame of KITTI's object layout; give the folder that contains training/image_2 and "
            "training/velodyne",
            field="source",
        )
    with whole_or_not_at_all(out) as part:
        importer = _Importer(training, part, depth)
        for done, name in enumerate(names, 1):
            importer.add(name)
            if progress is not None:
                progress(done, len(names))
        return importer.finish(out.name)


class _Importer:
    """Add frame after frame to a dataset folder."""

    def __init__(self, training: Path, out: Path, depth: DepthSource) -> None:
        self._training = training
        self._out = out
        self._depth: DepthSource = depth
        self._places: list[str] = []
        self._sets = {"frames": _QuerySet(), "elsewhere": _QuerySet()}
        self._cameras: list[CameraSensor] = []
        self._skipped: list[str] = []

    def add(self, name: str) -> None:
        """Add one frame as a place, a query, or both."""
        scan = self._training / "velodyne" / f"{name}.bin"
        has_scan, right = scan.is_file(), self._picture("image_3", name)
        stored = self._training / "gt_depth" / f"{name}.png"
        T_map_lidar = transform_from(np.eye(3), np.array([PLACE_SPACING_M * len(self._places), 0.0, 0.0]))
        if right is not None and (self._depth == "sgbm" or has_scan or stored.is_file()):
            self._add_query(name, right, stored, T_map_lidar if has_scan else None)
        elif right is not None:
            self._skipped.append(f"{name}: no scan and no stored depth; --depth sgbm can use it")
        elif not has_scan:
            self._skipped.append(f"{name}: neither a scan nor a right image")
        if has_scan:
            copy_scan(scan, scan_path(self._out, len(self._places)))
            self._places.append(name)

    def finish(self, dataset_name: str) -> KittiObjectSummary:
        """Write what needs all frames: poses, cameras and the description."""
        if not self._places:
            raise DatasetError(
                f"{self._training}/velodyne has no scan, so there is nothing to map; add the scans", field="velodyne"
            )
        poses = [transform_from(np.eye(3), np.array([PLACE_SPACING_M * n, 0.0, 0.0])) for n in range(len(self._places))]
        _write_poses(self._out / "survey" / "poses.txt", poses)
        for set_name, queries in self._sets.items():
            folder = query_folder(self._out, set_name)
            if queries.names:
                (folder / "cameras.txt").write_text("\n".join(queries.cameras) + "\n")
            if queries.poses:
                _write_poses(folder / "poses.txt", queries.poses)
        write_description(
            self._out,
            DatasetDescription(
                name=dataset_name,
                source=self._source(),
                sensors=Sensors(lidars=[HDL64], cameras=self._cameras),
            ),
        )
        return KittiObjectSummary(
            places=len(self._places),
            frames=len(self._sets["frames"].names),
            elsewhere=len(self._sets["elsewhere"].names),
            cameras=len(self._cameras),
            skipped=tuple(self._skipped),
        )

    def _source(self) -> dict[str, Any]:
        """Origin of the dataset, for ``dataset.json``."""
        source: dict[str, Any] = {"kind": "kitti-object", "depth": self._depth, "places": self._places}
        source["queries"] = {name: queries.names for name, queries in self._sets.items() if queries.names}
        if self._depth == "sgbm":
            source["matching"] = RECORDED.description()
        return source

    def _add_query(self, name: str, right: Path, stored: Path, T_map_lidar: Transform | None) -> None:
        left = self._picture("image_2", name)
        if left is None:
            raise damaged(self._training / "image_2" / f"{name}.png", "the left image of this frame is missing")
        rgb = read_rgb(left)
        calibration = read_calibration(self._training / "calib" / f"{name}.txt")
        is_stored = self._depth == "stored"
        values = read_stored_depth(stored, rgb.shape[:2]) if is_stored else _match(rgb, right, calibration)
        queries_name = "elsewhere" if T_map_lidar is None else "frames"
        queries, folder = self._sets[queries_name], query_folder(self._out, queries_name)
        number = f"{len(queries.names):06d}"
        rgb_path, depth_path = folder / "rgb" / f"{number}{left.suffix}", folder / "depth" / f"{number}.png"
        for path in (rgb_path, depth_path):
            path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(left, rgb_path)
        depth_path.write_bytes(cv2.imencode(".png", values)[1].tobytes())
        queries.names.append(name)
        queries.cameras.append(self._camera_name(calibration, rgb.shape[0], rgb.shape[1]))
        if T_map_lidar is not None:
            queries.poses.append(T_map_lidar @ inverse(calibration.T_camera_lidar))

    def _camera_name(self, calibration: KittiCalibration, height: int, width: int) -> str:
        """Name of the camera with these intrinsics and this mounting; adds the camera if it is new."""
        camera = CameraSensor(
            name=f"image_2-{len(self._cameras)}",
            width=width,
            height=height,
            fx=calibration.fx,
            fy=calibration.fy,
            cx=calibration.cx,
            cy=calibration.cy,
            depth=DepthSpec(
                scale_m=DEPTH_SCALE_M, kind="z", baseline_m=calibration.baseline_m if self._depth == "sgbm" else None
            ),
            T_vehicle_sensor=inverse(calibration.T_camera_lidar).tolist(),
        )
        for known in self._cameras:
            if known.model_dump(exclude={"name"}) == camera.model_dump(exclude={"name"}):
                return known.name
        self._cameras.append(camera)
        return camera.name

    def _picture(self, kind: str, name: str) -> Path | None:
        paths = (self._training / kind / f"{name}{suffix}" for suffix in (".png", ".jpg"))
        return next((path for path in paths if path.is_file()), None)


def _write_poses(path: Path, poses: list[Transform]) -> None:
    """Write poses. Single frames have no time, so their number serves as seconds."""
    write_tum(path, np.arange(len(poses), dtype=np.float64), np.stack(poses))


def _match(left: NDArray[np.uint8], right_path: Path, calibration: KittiCalibration) -> NDArray[np.uint16]:
    right = read_rgb(right_path)
    if right.shape != left.shape:
        raise damaged(right_path, f"its size is {right.shape[:2]}, but the left image has {left.shape[:2]}")
    assert calibration.focal_baseline_px_m is not None  # noqa: S101  # the object layout always names both cameras
    depth_m = depth_from_stereo(left, right, focal_baseline_px_m=calibration.focal_baseline_px_m)
    values = np.rint(depth_m / DEPTH_SCALE_M)
    return np.where(values <= np.iinfo(np.uint16).max, values, 0).astype(np.uint16)
