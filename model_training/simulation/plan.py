"""Settings of a simulated dataset, frozen and checked."""

import math
from collections.abc import Iterable
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer

from model_training.simulation.conditions import CONDITIONS
from model_training.simulation.depth_noise import DEPTHS
from model_training.simulation.exposure import RGBS, RgbModel
from model_training.simulation.lidar import LIDARS
from model_training.simulation.sensor_parameters import (
    DepthParameters,
    LidarParameters,
    RgbParameters,
    StereoParameters,
    SurveyParameters,
)
from model_training.simulation.stereo_pair import STEREOS
from service.errors import DatasetError
from service.geometry.camera import PinholeCamera

#: Extent of a city along one axis, metres.
CitySide = Annotated[float, Field(ge=30, le=10_000)]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @model_serializer(mode="wrap")
    def without_empty_parameters(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Return all fields without empty sensor parameters, and without unset options of a query traversal.

        A finished dataset is recognised by the text of its plan. So the text must not change when a new option is not used.

        Args:
            handler: default serialiser of pydantic.
        """
        left_out: tuple[object, ...] = ({}, None) if isinstance(self, QueryPlan) else ({},)
        kept = ("max_depth_m",)  # older plans contain it even when it is None
        return {name: value for name, value in handler(self).items() if name in kept or value not in left_out}


class CameraPlan(_Model):
    """The RGB-D camera.

    Attributes:
        width: image width, pixels.
        height: image height, pixels.
        horizontal_deg: horizontal field of view, degrees.
    """

    width: int = Field(640, ge=64, le=4096)
    height: int = Field(480, ge=48, le=4096)
    horizontal_deg: float = Field(90.0, ge=20, le=150)

    def pinhole(self) -> PinholeCamera:
        """Return the intrinsics. The principal point is the image centre."""
        focal = self.width / 2 / math.tan(math.radians(self.horizontal_deg) / 2)
        return PinholeCamera(self.width, self.height, focal, focal, (self.width - 1) / 2, (self.height - 1) / 2)


class QueryPlan(_Model):
    """One query traversal. Each depth preset gives its own query set with the same RGB images.

    Attributes:
        name: name of the traversal.
        traversal: number that selects vehicles and poses; 0 is the survey's own traversal.
        count: number of queries.
        per_class: use the counts of the paper's Table I instead of ``count``.
        on_track: place the queries at the survey's own poses. This is the paper's split, which leaks.
        depths: depth presets, either modelled or stereo-matched.
        condition: weather and light.
        parked_changed: share of the parking slots that are drawn anew instead of kept from the survey.
        aside_m: largest lateral distance from the survey's track, metres.
        heading_deg: largest heading difference from the track, degrees.
        turn_deg: yaw of the camera against the vehicle, degrees, counter-clockwise.
        pitch_deg: pitch of the camera against the vehicle, degrees; positive is downwards.
        blocked: share of the view that a vehicle right in front of the camera covers.
        followed: share of the images with a vehicle that drives ahead; None: no such vehicle.
        max_depth_m: depths beyond this range are removed, metres; None: no limit.
        depth_parameters: numbers that replace those of each modelled preset in ``depths``.
        stereo_parameters: numbers that replace those of each stereo-matched preset in ``depths``.
        rgb: RGB preset; None means ``automatic``.
        rgb_parameters: numbers that replace those of ``rgb``.
        sun_elevation_deg: elevation of the sun, degrees; None: from the condition, different for each traversal.
        sun_azimuth_deg: azimuth of the sun, degrees from east, counter-clockwise; None: random.
        sequence: number of frames in a row, of which the last is at the drawn pose; None: single frames.
        step_m: distance between the frames of a sequence, metres; None: ``drives.DEFAULT_STEP_M``.
        cameras: number of cameras around the vehicle that take a query's frames together, of which the last looks ahead; None: one.
    """

    name: str = Field(pattern=r"^[a-z0-9_]+$")
    traversal: int = Field(ge=0, description="0 is the survey's own drive, with its own vehicles")
    count: int = Field(200, ge=1)
    per_class: bool = False
    on_track: bool = False
    depths: tuple[str, ...] = ("precise",)
    condition: str = "clear"
    parked_changed: float = Field(0.5, ge=0, le=1)
    aside_m: float = Field(2.0, ge=0, le=10)
    heading_deg: float = Field(15.0, ge=0, le=180)
    turn_deg: float = Field(0.0, ge=-180, le=180)
    pitch_deg: float = Field(0.0, ge=-45, le=45)
    blocked: float = Field(0.0, ge=0, le=0.9)
    followed: float | None = Field(None, ge=0, le=1, description="share of images with a vehicle driving ahead")
    max_depth_m: float | None = Field(None, ge=1)
    depth_parameters: DepthParameters = DepthParameters()
    stereo_parameters: StereoParameters = StereoParameters()
    rgb: str | None = None
    rgb_parameters: RgbParameters = RgbParameters()
    sun_elevation_deg: float | None = Field(None, ge=1, le=90)
    sun_azimuth_deg: float | None = Field(None, ge=-360, le=360)
    sequence: int | None = Field(None, ge=2, le=20)
    step_m: float | None = Field(None, ge=0.1, le=10)
    cameras: int | None = Field(None, ge=2, le=8)

    def rgb_model(self) -> RgbModel:
        """Return the RGB camera of this traversal."""
        return self.rgb_parameters.on(self.rgb or "automatic")

    def matched(self) -> bool:
        """Return whether the depth comes from rendered and matched stereo pairs."""
        return any(depth in STEREOS for depth in self.depths)

    def refuse_what_does_nothing(self) -> None:
        """Refuse a changed field that would have no effect on this traversal.

        Raises:
            DatasetError: a field has no effect. The error names the field, its value and the reason.
        """
        poses, vehicles = "which uses the survey's own poses", "which has the survey's own vehicles"
        refused = [("aside_m", poses), ("heading_deg", poses)] if self.on_track else []
        refused += [("parked_changed", vehicles)] if self.traversal == 0 else []
        refused += [("step_m", "which has no sequence")] if self.sequence is None else []
        if self.depth_parameters != DepthParameters() and self.matched():
            raise DatasetError(
                f"depth_parameters: this option has no effect with {self.name!r}, whose depth comes from matched "
                "pairs; set parameters of stereo",
                field="depth_parameters",
            )
        if self.stereo_parameters != StereoParameters() and not self.matched():
            raise DatasetError(
                f"stereo_parameters: this option has no effect with {self.name!r}, which "
                f"matches no pairs; use a depth of {', '.join(STEREOS)}",
                field="stereo_parameters",
            )
        if self.followed is not None and self.blocked > 0:
            raise DatasetError(
                f"followed: --blocked and --followed exclude each other ({self.name!r} has both); omit one",
                field="followed",
            )
        if self.cameras is not None and self.sequence is not None:
            raise DatasetError(
                f"cameras: {self.name!r} has a sequence already, whose frames one camera takes; omit cameras or sequence",
                field="cameras",
            )
        sunless = f"whose condition {self.condition!r} has no sun"
        if CONDITIONS[self.condition].sun_strength == 0:
            refused += [("sun_elevation_deg", sunless), ("sun_azimuth_deg", sunless)]
        for field, why in refused:
            value = getattr(self, field)
            if value != type(self).model_fields[field].default:
                raise DatasetError(f"{field}: {value:g} has no effect with {self.name!r}, {why}; omit it", field=field)


class SimulationPlan(_Model):
    """A city, its survey and its query traversals.

    Attributes:
        name: name of the dataset.
        city: kind of city.
        seed: seed of the city and of all other random numbers.
        size_m: extent of a random city in x and y, metres.
        streets: names of the surveyed streets; empty: all.
        lidar: LiDAR preset.
        lidar_height_m: height of the LiDAR above the ground, metres.
        spacing_m: distance between scans, metres.
        survey_condition: weather and light of the survey.
        survey_error: whether the survey's poses have a smooth error.
        camera: camera of the queries.
        camera_height_m: mean height of the camera above the ground, metres.
        queries: query traversals.
        lidar_parameters: numbers that replace those of ``lidar``.
        survey_parameters: motion and pose error of the survey.
    """

    name: str
    city: Literal["paper", "city", "mixed", "repeating"] = "city"
    seed: int = Field(0, ge=0)
    size_m: tuple[CitySide, CitySide] = (300.0, 400.0)
    streets: tuple[str, ...] = ()
    lidar: str = "paper_32"
    lidar_height_m: float = Field(1.8, gt=0, le=20)
    spacing_m: float = Field(1.0, ge=0.02)
    survey_condition: str = "clear"
    survey_error: bool = True
    camera: CameraPlan = CameraPlan()
    camera_height_m: float = Field(1.5, gt=0, le=20)
    queries: tuple[QueryPlan, ...] = ()
    lidar_parameters: LidarParameters = LidarParameters()
    survey_parameters: SurveyParameters = SurveyParameters()

    def checked(self) -> "SimulationPlan":
        """Return the plan if all its presets exist and all its fields have an effect.

        Raises:
            DatasetError: a preset is unknown or a field is refused. The error names the field, the value, and the presets or the reason.
        """
        named: list[tuple[str, str, Iterable[str]]] = [
            ("lidar", self.lidar, LIDARS),
            ("survey_condition", self.survey_condition, CONDITIONS),
        ]
        for query in self.queries:
            named.append(("condition", query.condition, CONDITIONS))
            named.append(("rgb", query.rgb or "automatic", RGBS))
            named += [("depth", depth, (*DEPTHS, *STEREOS)) for depth in query.depths]
        for field, value, known in named:
            if value not in set(known):
                raise DatasetError(
                    f"{field}: {value!r} is not a valid preset; choose one of: {', '.join(known)}", field=field
                )
        self.lidar_parameters.on(self.lidar)
        survey = self.survey_parameters
        survey.model()
        if not self.survey_error and (survey.position_m, survey.angle_deg) != (None, None):
            raise DatasetError(
                "survey_error: with the error off, survey.position_m and survey.angle_deg have no effect; omit them",
                field="survey_error",
            )
        for query in self.queries:
            query.refuse_what_does_nothing()
            for depth in query.depths:
                query.stereo_parameters.on(depth) if depth in STEREOS else query.depth_parameters.on(depth)
            query.rgb_model()
        self._refuse_two_rigs()
        names = [query.name for query in self.queries]
        if len(set(names)) != len(names):
            raise DatasetError(f"queries: two traversals have the same name: {names}", field="queries")
        if self.city != "paper" and any(query.per_class for query in self.queries):
            raise DatasetError(
                "table1: only the paper's city has the classes of Table I; add --city paper", field="per_class"
            )
        return self

    def focal_baseline_px_m(self) -> float | None:
        """Return focal length times baseline (px m) of the stereo rig; None if all depth is modelled."""
        for query in self.queries:
            if query.matched():
                return query.stereo_parameters.on(query.depths[0]).focal_baseline_px_m
        return None

    def _refuse_two_rigs(self) -> None:
        """Refuse several rigs: a dataset describes one camera with one baseline."""
        if len({depth in STEREOS for query in self.queries for depth in query.depths}) > 1:
            raise DatasetError(
                f"depth: matched pairs ({', '.join(STEREOS)}) and depth drawn by a model "
                f"({', '.join(DEPTHS)}) cannot be in one dataset, because its camera has one baseline "
                "or none; simulate two datasets",
                field="depth",
            )
        if len({query.stereo_parameters for query in self.queries}) > 1:
            raise DatasetError("stereo_parameters: the drives differ; a dataset has one rig", field="stereo_parameters")
