"""Write the query set of a dataset, pair by pair."""

import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import (
    PICTURES,
    CameraSensor,
    DepthSpec,
    query_folder,
    write_tum,
)
from model_training.datasets.png import write_png
from model_training.importing.recording import Depth, RecordedPicture
from service.geometry.rigid import Transform
from service.imaging.depth_unit_hint import MILLIMETRE_FACTOR, unit_factor

#: Step for depth recorded in metres: 16 bits reach 65 m, and the step is finer than the resolution of our sensors.
METRES_SCALE_M = 0.001


class QueryWriter:
    """Number and write pairs as they come. Poses and cameras are written at the end.

    Args:
        out: folder of the dataset.
        name: of the query set.
    """

    def __init__(self, out: Path, name: str) -> None:
        self._folder = query_folder(out, name)
        self._stamps: list[float] = []
        self._poses: list[Transform] = []
        self._cameras: list[CameraSensor] = []
        self._camera_names: list[str] = []

    @property
    def count(self) -> int:
        """Number of pairs so far."""
        return len(self._stamps)

    def add(self, picture: RecordedPicture, T_map_camera: Transform) -> str | None:
        """Write a rectified image pair.

        Args:
            picture: rectified, with depth.
            T_map_camera: pose of the optical frame (4, 4).

        Returns:
            None, or the reason why the pair was left out.
        """
        size = (picture.camera.height, picture.camera.width)
        if picture.depth is None or picture.rgb.shape[:2] != size or picture.depth.shape != size:
            depth = None if picture.depth is None else picture.depth.shape
            return f"sizes differ: colour {picture.rgb.shape[:2]}, depth {depth}, camera {size}"
        values, scale_m = whole_steps(picture.depth, picture.depth_scale_m)
        if picture.depth.dtype != np.uint16 and unit_factor(picture.depth) == MILLIMETRE_FACTOR:
            return (
                "its floating-point depth looks like millimetres, but metres are expected: divide it by 1000, or "
                "record 16-bit integers"
            )
        if not values.any():
            return "its depth is empty"
        number = f"{self.count:06d}"
        self._write_rgb(picture, number)
        write_png(self._folder / "depth" / f"{number}.png", values)
        self._stamps.append(picture.stamp_s)
        self._poses.append(T_map_camera)
        self._camera_names.append(self._camera_name(picture, scale_m))
        return None

    def finish(self) -> list[CameraSensor]:
        """Write poses and cameras, and return the cameras for ``dataset.json``."""
        if self.count:
            write_tum(self._folder / "poses.txt", np.array(self._stamps), np.stack(self._poses))
            if len(self._cameras) > 1:
                (self._folder / "cameras.txt").write_text("\n".join(self._camera_names) + "\n")
        return self._cameras

    def _write_rgb(self, picture: RecordedPicture, number: str) -> None:
        if picture.file is not None and picture.file.suffix.lower() in PICTURES:
            target = self._folder / "rgb" / f"{number}{picture.file.suffix.lower()}"
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(picture.file, target)
        else:
            write_png(self._folder / "rgb" / f"{number}.png", np.ascontiguousarray(picture.rgb[:, :, ::-1]))

    def _camera_name(self, picture: RecordedPicture, scale_m: float) -> str:
        pinhole = picture.camera
        camera = CameraSensor(
            name=f"camera-{len(self._cameras)}",
            width=pinhole.width,
            height=pinhole.height,
            fx=pinhole.fx,
            fy=pinhole.fy,
            cx=pinhole.cx,
            cy=pinhole.cy,
            depth=DepthSpec(scale_m=scale_m, baseline_m=picture.baseline_m),
            T_vehicle_sensor=picture.T_vehicle_camera.tolist(),
        )
        for known in self._cameras:
            if known.model_dump(exclude={"name"}) == camera.model_dump(exclude={"name"}):
                return known.name
        self._cameras.append(camera)
        return camera.name


def whole_steps(depth: Depth, scale_m: float) -> tuple[NDArray[np.uint16], float]:
    """Convert depth to 16 bits, and return the metres per step too.

    A value that is invalid, or too large for 16 bits, becomes 0.

    Args:
        depth: integer steps or metres (H, W).
        scale_m: metres per step of an integer depth.
    """
    if depth.dtype == np.uint16:
        return np.asarray(depth, np.uint16), scale_m
    metres = np.nan_to_num(np.asarray(depth, np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    steps = np.rint(metres / METRES_SCALE_M)
    return np.where((steps > 0) & (steps <= np.iinfo(np.uint16).max), steps, 0).astype(np.uint16), METRES_SCALE_M
