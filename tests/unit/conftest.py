"""Shared fixtures: a simulated drive and its map, made once and on demand, and factories."""

import json
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import settings

from benchmarks.scale.s3_server import s3_server
from model_training.mapping.voxel_map import VoxelMap
from service.confidence.features import FEATURES
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from, transform_points
from service.imaging.query_view import QueryViews
from service.imaging.view_grid import ViewGrid
from service.maps.calibration import Calibration
from service.maps.content import BundleContent
from service.maps.reader import MapBundle
from service.maps.writer import write_bundle
from service.registration.surfel_map import SurfelMap
from service.retrieval.knn import ViewMatches
from service.retrieval.query import Query
from service.retrieval.retrieve import EncodedFrame
from tests.unit.ray_nodes import ray_cluster  # noqa: F401  # a fixture for the tests of two packages
from tests.unit.street_scene import (  # noqa: F401  # fixtures for the tests of several packages
    candidate,
    points_at,
    pose,
    scene_of,
    seen,
    settle,
    start_at,
    street,
    street_map,
    streets_at,
)

# The same examples on every machine, and no clock: a busy one is no defect of the code.
settings.register_profile("steady", deadline=None, derandomize=True)
settings.load_profile("steady")


@pytest.fixture(scope="session")
def s3() -> Iterator[dict[str, str]]:
    """Run an S3 server; return the environment variables with which obstore finds it."""
    with s3_server() as environment:
        yield environment


BERLIN = {"latitude_deg": 52.52, "longitude_deg": 13.405, "height_m": 70.0}


def matches_of(xyz: Any, heading_deg: Any, similarity: Any, *, R_map_place: Any = None) -> ViewMatches:
    """Return one view for each place."""
    n, R = len(xyz), np.eye(3) if R_map_place is None else R_map_place
    poses = [transform_from(R, np.array(each, np.float64)) for each in xyz]
    return ViewMatches(
        np.arange(n),
        np.array(similarity, np.float64),
        np.arange(n, dtype=np.int32),
        np.zeros(n, np.int32),
        np.deg2rad(np.array(heading_deg, np.float64)),
        np.stack(poses),
    )


def frame_of(
    matches: ViewMatches,
    *,
    depth_m: Any = None,
    camera: PinholeCamera | None = None,
    R_level_camera: Any = R_BODY_OPTICAL,
    height_m: float = 1.4,
    T_reference_camera: Any = None,
    descriptors: Any = ((1.0, 0.0),),
    noise: float = 1e-4,
) -> EncodedFrame:
    """Return an image pair with these retrieval matches. The images are black and empty unless given."""
    camera = camera or PinholeCamera(6, 4, 3.0, 3.0, 2.5, 1.5)
    depth_m = np.zeros((camera.height, camera.width), np.float32) if depth_m is None else depth_m
    query = Query(rgb=np.zeros((*depth_m.shape, 3), np.uint8), depth_m=depth_m, camera=camera)
    turned = np.array(descriptors, np.float32)
    planes = np.zeros((len(turned), 6, ViewGrid().rows, ViewGrid().columns), np.float32)
    views = QueryViews(planes, (0.0,) * len(turned), np.array(R_level_camera), height_m, 0.75)
    T = np.eye(4) if T_reference_camera is None else T_reference_camera
    return EncodedFrame(query, T, views, turned, matches, noise=noise, independent_noise=noise)


def calibration_document(**changed: Any) -> dict[str, Any]:
    """Return a valid ``calibration.json``: for all features, 0.5 for a right pose and 0.75 for a place in the map."""
    flat: dict[str, Any] = {"terms": []}
    document = {
        "calibrated": True,
        "features": [{"name": name, "mean": 0.0, "std": 1.0} for name in FEATURES],
        "right": flat | {"bias": 0.0},
        "known": flat | {"bias": float(np.log(3.0))},
        "thresholds": [{"false_accept_rate": 0.001, "confidence": 0.9}, {"false_accept_rate": 0.01, "confidence": 0.5}],
        "site": None,
        "rig": None,
        "measured_on": {"cities": "none", "queries": 0},
    }
    return document | changed


@pytest.fixture(scope="session")
def matches_at() -> Callable[..., ViewMatches]:
    return matches_of


@pytest.fixture(scope="session")
def frame_with() -> Callable[..., EncodedFrame]:
    return frame_of


@pytest.fixture(scope="session")
def calibration_json() -> Callable[..., dict[str, Any]]:
    return calibration_document


@pytest.fixture(scope="session")
def calibration_of() -> Callable[..., Calibration]:
    return lambda **changed: Calibration.model_validate(calibration_document(**changed))


def refused_answer(answer: dict[str, Any], status: str = "AMBIGUOUS", **changed: Any) -> dict[str, Any]:
    """Return a LOCALIZED answer of the contract, changed to a refused one: its pose is one of two hypotheses, 60 m apart."""
    guess = answer["pose"]
    elsewhere = guess | {"position": guess["position"] | {"y": guess["position"]["y"] + 60.0}}
    hypotheses = [
        {"confirmed": False, "pose": each, "share": 0.5, "inliers": 0.5, "similarity": 0.25}
        for each in (guess, elsewhere)
    ]
    spread = {
        "mean": guess["position"] | {"y": guess["position"]["y"] + 30.0},
        "covariance": [1.0, 0, 0, 0, 900.0, 0, 0, 0, 1.0],
        "heading_std_deg": 20.0,
        "hypotheses_weight": 0.75,
    }
    reasons = [{"check": "baseline", "evidence": {"log_noise": 4.0, "points": -3.5}, "remedy": "check the baseline"}]
    gone = {"pose": None, "vehicle_pose": None, "geopose": None, "street": None}
    return answer | gone | {"status": status, "hypotheses": hypotheses, "spread": spread, "reasons": reasons} | changed


@pytest.fixture(scope="session")
def refused_of() -> Callable[..., dict[str, Any]]:
    return refused_answer


@pytest.fixture(scope="session")
def bundle_at(
    content_of: Callable[..., BundleContent], tmp_path_factory: pytest.TempPathFactory
) -> Callable[..., MapBundle]:
    """Return a map of places at given positions, with the same headings (degrees) at each; one descriptor per view."""

    def bundle(xyz: Any, heading_deg: Any, descriptors: Any, **changed: Any) -> MapBundle:
        places, headings = len(xyz), np.deg2rad(np.array(heading_deg, np.float64))
        content = content_of(
            T_map_place=np.stack([transform_from(np.eye(3), np.array(each, np.float64)) for each in xyz]),
            place_street=np.full(places, -1, np.int32),
            streets=None,
            headings=len(headings),
            view_place=np.repeat(np.arange(places, dtype=np.int32), len(headings)),
            view_heading_rad=np.tile(headings, places),
            descriptors=np.array(descriptors, np.float32),
            **{"cloud": None} | changed,
        )
        folder = tmp_path_factory.mktemp("bundles") / "m"
        write_bundle(folder, content)
        return MapBundle.open(folder)

    return bundle


def answers_with(true_xy: Any, answer_xy: Any, **changed: Any) -> Any:
    """Return predictions for queries at ground positions. NaN means no answer. Answers are accepted by default."""
    from model_training.evaluation.predict import RANKED, Predictions

    true_xy, answer_xy = np.array(true_xy, np.float64), np.array(answer_xy, np.float64)
    count, none = len(true_xy), np.isnan(answer_xy[:, 0])
    T_true, T_answer = (
        np.stack([transform_from(R_BODY_OPTICAL, np.array([*xy, 1.5])) for xy in each]) for each in (true_xy, answer_xy)
    )
    T_answer[none] = np.nan
    ranked = np.full((count, RANKED, 2), np.nan)
    ranked[:, 0] = answer_xy
    given = {
        "T_true": T_true,
        "T_answer": T_answer,
        "street_true": np.zeros(count, int),
        "street_answer": np.where(none, -1, 0),
        "ranked_xy": ranked,
        "ranked_place": np.full((count, RANKED), -1),
        "status": np.where(none, "", "LOCALIZED"),
        "confidence": np.full(count, np.nan),
        "evidence": np.full((count, len(FEATURES)), np.nan),
        "covariance": np.full((count, 6, 6), np.nan),
        "ms": np.full(count, 20.0),
        "stamp_s": np.arange(float(count)),
    }
    return Predictions(**given | {name: np.array(value) for name, value in changed.items()})


@pytest.fixture(scope="session")
def answers_of() -> Callable[..., Any]:
    return answers_with


@pytest.fixture(scope="session")
def saved_run(small_map: Path, small_dataset: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the report folder that ``evaluate --report`` writes for ``small_map`` and the queries of ``small_dataset``."""
    from model_training.evaluation.evaluate import evaluate
    from model_training.evaluation.saved_run import save_run
    from model_training.reporting.run_page import write_run_page

    folder, bundle = tmp_path_factory.mktemp("runs") / "small", MapBundle.open(small_map)
    found = evaluate(bundle, small_dataset, workers=1)
    write_run_page(save_run(folder, bundle, small_dataset, found), bundle, small_dataset, found.figures)
    return folder


@pytest.fixture(scope="session")
def small_dataset(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return a dozen scans of a LiDAR that looks down (2 to -24.8 degrees) and five image pairs of another drive."""
    from model_training.datasets.dataset import Dataset
    from model_training.simulation.plan import CameraPlan, QueryPlan, SimulationPlan
    from model_training.simulation.sensor_parameters import LidarParameters
    from model_training.simulation.simulate import simulate

    out = tmp_path_factory.mktemp("datasets") / "small"
    plan = SimulationPlan(
        name="small",
        seed=3,
        size_m=(60.0, 60.0),
        spacing_m=5.0,
        streets=("1",),
        lidar="hdl_64",
        lidar_parameters=LidarParameters(bottom_deg=-24.8),  # evenly spaced beams
        camera=CameraPlan(width=96, height=72),
        queries=(QueryPlan(name="drive1", traversal=1, count=5),),
    )
    simulate(plan, out, workers=1)
    return Dataset(out)


@pytest.fixture(scope="session")
def encoder_file(encoder_of: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a random projection for views of 8 x 16 cells."""
    path: Path = tmp_path_factory.mktemp("encoders") / "encoder.onnx"
    path.write_bytes(encoder_of())
    return path


@pytest.fixture(scope="session")
def small_map(small_dataset: Any, encoder_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the bundle of ``small_dataset`` with six headings per place."""
    from model_training.mapping.build import build_map
    from model_training.mapping.settings import BuildSettings

    out: Path = tmp_path_factory.mktemp("maps") / "small"
    settings = BuildSettings(
        name="small", headings=6, spacing_m=5.0, between_m=0.0, calibration=None, align_survey=False, traffic_vote=False
    )
    build_map(small_dataset, encoder_file, out, settings, threads=1)
    return out


@pytest.fixture(scope="session")
def calibration_file_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Return a calibration file that names the encoder it was measured on."""

    def made(encoder_sha256: str, **changed: Any) -> Path:
        path = tmp_path_factory.mktemp("calibrations") / "calibration.json"
        path.write_text(json.dumps(calibration_document(measured_on={"encoder_sha256": encoder_sha256}, **changed)))
        return path

    return made


@pytest.fixture(scope="session")
def stock_map(small_dataset: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return ``small_map`` built with the stock encoder, with its calibration."""
    from model_training.mapping.build import build_map
    from model_training.mapping.settings import BuildSettings
    from model_training.stock import CALIBRATION, ENCODER

    out: Path = tmp_path_factory.mktemp("maps") / "stock"
    settings = BuildSettings(
        name="stock", headings=6, spacing_m=5.0, calibration=CALIBRATION, align_survey=False, traffic_vote=False
    )
    build_map(small_dataset, ENCODER, out, settings, threads=1)
    return out


@pytest.fixture(scope="session")
def streets_alike(
    content_of: Callable[..., BundleContent], pictures_of: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory
) -> Callable[..., Path]:
    """Return a bundle of two streets with equal descriptors. Both were measured from (20, 0) or (20, 90), looking north.
    The walls of the first street are those of an image with another seed. The map origin is in Berlin.
    """

    def made(*, seed_of_first: int = 3) -> Path:
        voxels = VoxelMap(0.3, np.array([20.0, 0.0, 2.0]))
        for y, seed in ((0.0, seed_of_first), (90.0, 3)):
            _, depth_m, camera = pictures_of(seed=seed)
            T_map_camera = transform_from(rotation_z(np.pi / 2) @ R_BODY_OPTICAL, np.array([20.0, y, 1.7]))
            points_camera = (camera.rays_of_pixels() * depth_m[..., None]).reshape(-1, 3)
            for _ in range(3):  # so that every voxel has points enough for a normal
                voxels.add(transform_points(T_map_camera, points_camera))
        content = content_of(
            name="alike",
            streets=None,
            place_street=np.full(12, -1, np.int32),
            georeference=BERLIN,
            cloud=SurfelMap.prepare(voxels.origin, *voxels.surfels()),
        )
        content.T_map_place[6:, 1, 3] = 90.0
        content.descriptors[:24] = content.descriptors[24:]
        folder = tmp_path_factory.mktemp("maps") / "alike"
        write_bundle(folder, content)
        return folder

    return made


@pytest.fixture(scope="session")
def twin_map(streets_alike: Callable[..., Path]) -> Path:
    """Return a map of two identical streets."""
    return streets_alike()


#: Elements of HTML that nothing closes.
_VOID = {"meta", "img", "br", "link", "input", "hr"}


class Page(HTMLParser):
    """Parses elements with their attributes, and checks that all are closed."""

    def __init__(self, document: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self._open: list[str] = []
        self.feed(document)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in _VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        if self._open and self._open[-1] != "style":
            self.words.append(data)

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]

    @property
    def text(self) -> str:
        return " ".join("".join(self.words).split())


@pytest.fixture(scope="session")
def page_of() -> Callable[[str], Page]:
    return Page
