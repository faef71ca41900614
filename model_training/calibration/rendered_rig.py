"""Labelled frames of a rig without a recording: images are rendered from the map (``streetfix calibrate --map M --rig rig.json``).

A rendered image shows surfels of the map, with the depth errors of the rig. Its pose is known, so its answer has a label. Each image is
localized a second time in the map without the places around its pose (``elsewhere``). There every answer is wrong.

A rendered image is easier than one of a camera: the surfels and the map views come from the same survey. So rendered images can show that
confidence is too high, and never that it is too low (decisions 0030, 0150).
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from model_training.calibration.elsewhere import without_surroundings
from model_training.calibration.labelled_frames import LabelledFrames, blocks_of, frames_of, joined_frames
from model_training.calibration.out_of_map import Box
from model_training.datasets.files import read_bytes
from model_training.evaluation.predict import in_order
from model_training.mapping.rendered_query import grey_image, noisy_depth
from model_training.simulation.conditions import CONDITIONS
from model_training.simulation.depth_noise import DEPTHS, measured_depth
from service.errors import BundleError, DatasetError, NoDepthError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, Transform, rotation_x, rotation_y, rotation_z, transform_from
from service.localization.answer import Answer
from service.localization.localizer import Localizer
from service.maps.calibration import RIGHT_M
from service.maps.manifest import Manifest
from service.maps.rig_key import RigKey
from service.option_limits import LEAST_HEIGHT_M, MOST_HEIGHT_M
from service.registration.points import FOCAL_BASELINE_PX_M
from service.registration.surfel_map import SurfelMap
from service.registration.surfel_tiles import Cloud, Surfels
from service.registration.visibility import DiscSettings, SurfelRaycaster
from service.retrieval.query import Query

#: Largest number of rendered images. Each is localized twice.
IMAGES = 60
#: Largest distance of a camera from the survey's track, metres, and standard deviations of its heading against the track, of pitch and of
#: roll, degrees. Half of the cameras look against the direction of the survey.
ASIDE_M, HEADING_DEG, TILT_DEG = 1.5, 10.0, 1.0
#: Least share of the pixels with depth. An image with fewer, such as one from inside a hedge, is drawn again, up to ``_TRIES`` times.
_SEEN, _TRIES = 0.1, 5
#: Mean number of vehicles and people in an image that the map lacks.
NEW_OBJECTS = 1.5
#: Largest width of a rendered image and of the image whose rays choose the surfels, pixels.
_WIDTH, _CAST_WIDTH = 1280, 320
#: Radius of a surfel's disc, metres. The discs of a closed surface then leave no holes.
_RADIUS_M = 0.25
#: Largest difference of a pixel's depth from that of the centre of its surfel, metres; least cosine at which they may differ.
_OFF_CENTRE_M, _GRAZING = 0.5, 0.05
#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]


class _Frozen(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class RigCamera(_Frozen):
    """Camera of a rig, as in a request, with its height.

    Attributes:
        width: image width, pixels.
        height: image height, pixels.
        fx: horizontal focal length, pixels.
        fy: vertical focal length, pixels.
        cx: column of the principal point, pixels.
        cy: row of the principal point, pixels.
        height_m: height above the ground, metres.
    """

    width: int = Field(ge=48, le=4096)
    height: int = Field(ge=48, le=4096)
    fx: float = Field(gt=0)
    fy: float = Field(gt=0)
    cx: float
    cy: float
    height_m: float = Field(ge=LEAST_HEIGHT_M, le=MOST_HEIGHT_M)


class RigDepth(_Frozen):
    """Depth sensor of a rig. Its errors add up as variances.

    Attributes:
        noise_px: standard deviation of the disparity, pixels; needs ``baseline_m``.
        offset_px: standard deviation of the disparity offset of an image, pixels; an error of rectification. Needs ``baseline_m``.
        noise_m: standard deviation of the depth that does not depend on the depth, metres.
        noise_share: standard deviation of the depth as a share of the depth.
        min_range_m: smallest measured depth, metres.
        max_range_m: largest measured depth, metres.
        baseline_m: baseline of the stereo pair, metres. None if the depth does not come from two images.
    """

    noise_px: float = Field(0.0, ge=0, le=50)
    offset_px: float = Field(0.0, ge=0, le=10)
    noise_m: float = Field(0.0, ge=0, le=1)
    noise_share: float = Field(0.0, ge=0, le=0.5)
    min_range_m: float = Field(ge=0.05)
    max_range_m: float = Field(le=200)
    baseline_m: float | None = Field(None, gt=0, le=10)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.min_range_m >= self.max_range_m:
            raise ValueError(f"min_range_m {self.min_range_m:g} is not below max_range_m {self.max_range_m:g}")
        if self.baseline_m is None and (self.noise_px > 0 or self.offset_px > 0):
            raise ValueError("noise_px and offset_px need baseline_m, because disparity needs a baseline")
        if not any((self.noise_px, self.noise_m, self.noise_share)):
            raise ValueError("give noise_px, noise_m or noise_share; a sensor without errors does not exist")
        return self


class RigFile(_Frozen):
    """Content of ``rig.json``.

    Attributes:
        name: name of the rig for readers.
        camera: the camera.
        depth: the depth sensor.
        rectified: whether the images have no distortion. The renderer knows no other ones.
    """

    name: str = Field("rig", min_length=1, max_length=64)
    camera: RigCamera
    depth: RigDepth
    rectified: Literal[True] = True

    def pinhole(self) -> PinholeCamera:
        """Return the intrinsics of the rendered image: those of the camera, reduced to a width of at most 1280 pixels."""
        c = self.camera
        whole = PinholeCamera(c.width, c.height, c.fx, c.fy, c.cx, c.cy)
        return whole if c.width <= _WIDTH else whole.scaled_to(_WIDTH, max(1, round(_WIDTH * c.height / c.width)))

    def key(self) -> RigKey:
        """Return what tells the rig from others. A rendered image may be smaller, but the queries of the rig are not."""
        c = self.camera
        whole = PinholeCamera(c.width, c.height, c.fx, c.fy, c.cx, c.cy)
        return RigKey.of(whole, baseline_m=self.depth.baseline_m, max_range_m=self.depth.max_range_m)

    def measured(
        self, z_m: NDArray[np.float32], group: NDArray[np.int64], rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """Return the depth image that the sensor measures.

        Errors of disparity, holes and bleeding edges are those of the simulator (``DepthModel``).

        Args:
            z_m: true depth (H, W), metres; 0 where there is no surface.
            group: index of the surface of each pixel. Half of the variance of ``noise_m`` and ``noise_share`` is common to a surface.
            rng: random generator.
        """
        d, zoom = self.depth, 640.0 / self.camera.width
        focal_baseline = FOCAL_BASELINE_PX_M if d.baseline_m is None else self.camera.fx * zoom * d.baseline_m
        model = replace(
            DEPTHS["precise" if d.baseline_m is None else "stereo"],
            focal_baseline_px_m=focal_baseline,
            noise_px=d.noise_px * zoom,
            offset_px=d.offset_px * zoom,
            step_px=0.0,
            scale_error=0.0,
            invented_frames=0.0,
            min_range_m=d.min_range_m,
            max_range_m=d.max_range_m,
        )
        depth_m = measured_depth(z_m, np.zeros(z_m.shape, np.bool_), model, CONDITIONS["clear"], rng)
        z = np.maximum(depth_m, d.min_range_m).astype(np.float64)
        noise = np.sqrt((d.noise_m / z**2) ** 2 + (d.noise_share / z) ** 2)
        return noisy_depth(depth_m, noise, group, int(group.max(initial=0)) + 1, rng, largest_m=d.max_range_m)


#: What to do about fields that a request has, and a rig whose images are rendered cannot have.
_REMEDIES = {
    "rectified": "; rectify the images first",
    "camera.distortion": "; leave it out, and give the rectified camera that `streetfix doctor` prints",
    "gravity": "; leave it out, because the rendered camera is nearly level",
}


def read_rig(path: Path) -> RigFile:
    """Read ``rig.json``.

    Args:
        path: the file.

    Raises:
        DatasetError: the file cannot be read, or a field is missing or invalid. The message names the field.
    """
    try:
        return RigFile.model_validate_json(read_bytes(path))
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"]) or "rig.json"
        remedy = _REMEDIES.get(where, "")
        what = first["msg"].removeprefix("Value error, ")
        raise DatasetError(f"{path}: {where}: {what}{remedy}; docs/formats.md has an example", field=where) from error


def frames_of_rig(
    localizer: Localizer, rig: RigFile, *, workers: int = 2, report: Report = lambda *_: None
) -> LabelledFrames:
    """Render images of a rig along the survey, localize them, and localize them again without the places around.

    The queries do not use the brightness of the map. Their own brightness comes from the map and agrees better than that of any camera.

    Args:
        localizer: localizer of the map.
        rig: the rig.
        workers: number of images that are processed at the same time.
        report: called after every image.

    Raises:
        BundleError: the map has no cloud.
    """
    bundle = localizer.bundle
    if bundle.cloud is None:
        raise BundleError(
            f"{bundle.path}: the map has no cloud to render images from; build the map again", field="cloud"
        )
    whole = bundle.cloud
    dark = Localizer(replace(bundle, cloud=without_brightness(whole)), localizer.encoder)
    count = min(IMAGES, len(bundle.T_map_place))
    places = np.linspace(0, len(bundle.T_map_place) - 1, count).astype(int)

    def ask(number: int) -> _Pair | None:
        T_map_place = bundle.T_map_place[places[number]]
        found = _rendered(whole.at(T_map_place[:3, 3]), bundle.manifest, T_map_place, rig, number)
        if found is None:
            return None
        query, T_map_camera = found
        xy, rest = T_map_camera[:2, 3], without_surroundings(dark, T_map_camera[:2, 3])
        answer = _localized(dark, query)
        off = np.inf if answer is None else float(np.linalg.norm(answer.T_map_camera_guess[:2, 3] - xy))
        other = None if rest is None else _localized(rest, query)
        return _evidence(answer), off <= RIGHT_M, _evidence(other)

    pairs = list[_Pair | None]()
    with ThreadPoolExecutor(workers) as pool:
        for pair in in_order(pool, ask, range(count), ahead=2 * workers):
            pairs.append(pair)
            report("rendered images", len(pairs), count)
    block = blocks_of(count)
    answered = [(None, False, None) if pair is None else pair for pair in pairs]
    none, all_ = np.zeros(count, bool), np.ones(count, bool)
    return joined_frames(
        [
            frames_of([pair[0] for pair in answered], np.array([pair[1] for pair in answered], bool), none, block),
            frames_of([pair[2] for pair in answered], none, all_, block),
        ]
    )


def without_brightness(cloud: Cloud) -> Cloud:
    """Return a cloud without intensities, because rendered images would agree with them too well.

    Args:
        cloud: cloud of a map.
    """
    return replace(cloud, brightness=None) if isinstance(cloud, SurfelMap) else replace(cloud, has_brightness=False)


#: Confidence features in the map (None: not registered), whether the answer is right, and confidence features without the surroundings.
_Pair = tuple[NDArray[np.float64] | None, bool, NDArray[np.float64] | None]


def _localized(localizer: Localizer, query: Query) -> Answer | None:
    try:
        return localizer.localize(query)
    except NoDepthError:
        return None


def _evidence(answer: Answer | None) -> NDArray[np.float64] | None:
    return None if answer is None else answer.evidence


def _rendered(
    cloud: Surfels, manifest: Manifest, T_map_place: Transform, rig: RigFile, number: int
) -> tuple[Query, Transform] | None:
    """Render the image of a camera near a place; return it with its T_map_camera, or None if no drawn pose sees enough."""
    rng = np.random.default_rng([31415, number])
    for _ in range(_TRIES):
        T_map_camera = T_map_place @ _drawn_pose(rig, manifest, rng)
        query = render_query(cloud, T_map_camera, rig, rng)
        if (query.depth_m > 0).mean() >= _SEEN:
            return query, T_map_camera
    return None


def _drawn_pose(rig: RigFile, manifest: Manifest, rng: np.random.Generator) -> Transform:
    """Draw T_place_camera: near the survey's track at the height of the rig, looking along the track or against it."""
    along = max(0.5, manifest.spacing_m / 2)
    position = np.array(
        [rng.uniform(-along, along), rng.uniform(-ASIDE_M, ASIDE_M), rig.camera.height_m - manifest.lidar_height_m]
    )
    heading = np.deg2rad(rng.normal(0, HEADING_DEG)) + (np.pi if rng.random() < 0.5 else 0.0)
    pitch, roll = np.deg2rad(rng.normal(0, TILT_DEG, 2))
    return transform_from(rotation_z(heading) @ rotation_y(pitch) @ rotation_x(roll) @ R_BODY_OPTICAL, position)


def render_query(cloud: Surfels, T_map_camera: Transform, rig: RigFile, rng: np.random.Generator) -> Query:
    """Render the query that a rig would send from a pose.

    Rays of a small image choose the surfels. Each pixel then gets the depth of its ray on the plane of its surfel. Surfels are shifted
    along their normals by their thickness, so rough surfaces stay rough. Vehicles and people that the map lacks hide a part. The errors of
    the depth sensor come last.

    Args:
        cloud: surfels around the pose.
        T_map_camera: pose of the camera, map frame.
        rig: the rig.
        rng: random generator of the objects and the errors.
    """
    camera, index = rig.pinhole(), surfels_in_view(cloud, T_map_camera, rig)
    z, intensity, group = np.zeros(index.shape), np.zeros(index.shape, np.float32), np.zeros(index.shape, np.int64)
    seen = index >= 0
    chosen, group[seen] = np.unique(index[seen], return_inverse=True)
    rays = camera.rays_of_pixels()
    z[seen] = _depth_on_surfels(cloud, chosen, group[seen], rays[seen], T_map_camera, rng)
    brightness = cloud.brightness_of(chosen)
    intensity[seen] = 1.0 if brightness is None else np.nan_to_num(brightness)[group[seen]]
    bright = float(np.median(intensity[intensity > 0])) if (intensity > 0).any() else 1.0
    for box in _new_objects(rig.camera.height_m, rng):
        hit = box.entered(rays)
        hidden = np.isfinite(hit) & ((z == 0) | (hit < z))
        z[hidden], intensity[hidden] = hit[hidden], bright * rng.uniform(0.3, 2.0)
    depth_m = rig.measured(z.astype(np.float32), group, rng)
    return Query(rgb=grey_image(intensity), depth_m=depth_m, camera=camera, baseline_m=rig.depth.baseline_m)


def surfels_in_view(cloud: Surfels, T_map_camera: Transform, rig: RigFile) -> NDArray[np.int64]:
    """Return the index of the surfel that each pixel of a rig's image shows, -1 for none (H, W).

    Args:
        cloud: surfels around the pose.
        T_map_camera: pose of the camera, map frame.
        rig: the rig.
    """
    camera = rig.pinhole()
    small = camera
    if camera.width > _CAST_WIDTH:
        small = camera.scaled_to(_CAST_WIDTH, max(1, round(_CAST_WIDTH * camera.height / camera.width)))
    discs = DiscSettings(radius_m=_RADIUS_M, nearest_m=rig.depth.min_range_m, reach_m=rig.depth.max_range_m)
    T = transform_from(T_map_camera[:3, :3], T_map_camera[:3, 3] - cloud.origin_m)
    cast = SurfelRaycaster(cloud, discs).intersect(T, small).astype(np.int64)
    rows = ((np.arange(camera.height) + 0.5) * small.height / camera.height).astype(int)
    columns = ((np.arange(camera.width) + 0.5) * small.width / camera.width).astype(int)
    return np.asarray(cast[rows[:, None], columns[None]])


def _depth_on_surfels(
    cloud: Surfels,
    chosen: NDArray[np.int64],
    group: NDArray[np.int64],
    rays: NDArray[np.float64],
    T_map_camera: Transform,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Return the depth of rays (n, 3) on the planes of surfels; ``group`` is the row of each ray's surfel in ``chosen`` (n,)."""
    surfels, R = cloud.unpacked(chosen), T_map_camera[:3, :3]
    normal = surfels["normal"].astype(np.float64) @ R
    centre = (surfels["xyz"].astype(np.float64) + cloud.origin_m - T_map_camera[:3, 3]) @ R
    centre += normal * (surfels["thickness_m"] * rng.normal(size=len(chosen)))[:, None]
    facing, middle = (normal[group] * rays).sum(axis=1), centre[group, 2]
    grazing = np.abs(facing) < _GRAZING
    on_plane = (normal * centre).sum(axis=1)[group] / np.where(grazing, 1.0, facing)
    z = np.where(grazing, middle, on_plane)
    return np.asarray(np.clip(z, middle - _OFF_CENTRE_M, middle + _OFF_CENTRE_M))


def _new_objects(height_m: float, rng: np.random.Generator) -> list[Box]:
    """Draw vehicles and people that the map lacks, as boxes in the level frame of a camera above flat ground."""
    found = []
    for _ in range(rng.poisson(NEW_OBJECTS)):
        wide, tall, long = (1.8, 1.5, 4.5) if rng.random() < 0.5 else (0.5, 1.75, 0.4)
        x, z = rng.uniform(-6, 6), rng.uniform(3, 18)
        low, high = (x - wide / 2, height_m - tall, z), (x + wide / 2, height_m, z + long)
        found.append(Box(low, high, yaw_rad=float(np.deg2rad(rng.normal(0, HEADING_DEG)))))
    return found
