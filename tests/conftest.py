"""A tiny map, a tiny encoder and a pair of pictures that fit together; a factory for each noun."""

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
from numpy.typing import NDArray

from model_training.mapping.voxel_map import VoxelMap
from service.confidence.features import FEATURES
from service.geometry.camera import PinholeCamera
from service.geometry.distortion import rays_of
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from, transform_points
from service.imaging.query_view import query_view
from service.imaging.view_grid import ViewGrid
from service.maps.content import BundleContent
from service.maps.writer import write_bundle
from service.registration.surfel_map import SurfelMap
from service.retrieval.encoder import Encoder

GRID = ViewGrid(rows=8, columns=16)
DESCRIPTOR_SIZE = 16
PLACES, HEADINGS = 12, 4
#: Where the pictures of ``pictures`` were taken: in the middle of the second street.
TRUE_PLACE, TRUE_HEADING = 8, 1


def make_encoder(*, seed: int = 0, size: int = DESCRIPTOR_SIZE) -> bytes:
    """A random projection with the inputs and the output of a real encoder."""
    helper, numpy_helper, floats = onnx.helper, onnx.numpy_helper, onnx.TensorProto.FLOAT
    flat = 6 * GRID.rows * GRID.columns
    weights = np.random.default_rng(seed).normal(size=(flat, size)).astype(np.float32)
    nodes = [
        helper.make_node("Flatten", ["planes"], ["flat"], axis=1),
        helper.make_node("MatMul", ["flat", "weights"], ["projected"]),
        helper.make_node("Unsqueeze", ["side", "one"], ["side_column"]),
        helper.make_node("Mul", ["side_column", "nothing"], ["side_effect"]),
        helper.make_node("Add", ["projected", "side_effect"], ["sum"]),
        helper.make_node("LpNormalization", ["sum"], ["descriptor"], axis=1, p=2),
    ]
    graph = helper.make_graph(
        nodes,
        "tiny",
        [
            helper.make_tensor_value_info("planes", floats, ["B", 6, GRID.rows, GRID.columns]),
            helper.make_tensor_value_info("side", floats, ["B"]),
        ],
        [helper.make_tensor_value_info("descriptor", floats, ["B", size])],
        [
            numpy_helper.from_array(weights, "weights"),
            numpy_helper.from_array(np.array([1], np.int64), "one"),
            numpy_helper.from_array(np.array(0, np.float32), "nothing"),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    data: bytes = model.SerializeToString()
    return data


def make_streets() -> dict[str, Any]:
    """Two streets side by side; the second is cut into beginning and end."""

    def square(x0: float, x1: float, y0: float, y1: float) -> dict[str, Any]:
        return {"type": "Polygon", "coordinates": [[[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]]}

    def feature(number: int, street: str, section: str | None, name: str, geometry: dict[str, Any]) -> dict[str, Any]:
        properties = {"id": f"s{number}", "street": street, "section": section, "name": name, "class_index": number}
        return {"type": "Feature", "properties": properties, "geometry": geometry}

    features = [
        feature(0, "1", None, "Street 1", square(-10, 100, -5, 5)),
        feature(1, "2", "beginning", "Beginning of street 2", square(-10, 20, 95, 105)),
        feature(2, "2", "end", "End of street 2", square(20, 100, 95, 105)),
    ]
    return {"type": "FeatureCollection", "features": features}


def make_pictures(*, seed: int = 3) -> tuple[NDArray[np.uint8], NDArray[np.float32], PinholeCamera]:
    """A flat road 1.5 m below the camera and uneven walls round it."""
    camera = PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5)
    rng = np.random.default_rng(seed)
    walls = np.repeat(rng.uniform(4, 15, 16), 4)[None, :].repeat(48, axis=0)
    down = np.maximum((np.arange(48) - camera.cy) / camera.fy, 1e-6)[:, None]
    depth_m = np.minimum(walls, 1.5 / down).astype(np.float32)
    rgb = rng.integers(0, 256, (48, 64, 3)).astype(np.uint8)
    return rgb, depth_m, camera


def make_pictures_through(camera: PinholeCamera, *, seed: int = 3) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """The scene of ``make_pictures`` through any lens, ray by ray. What that camera does not see is black and unmeasured."""
    rgb, _, plain = make_pictures(seed=seed)
    walls = np.random.default_rng(seed).uniform(4, 15, 16)
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    rays = rays_of(camera, pixels.astype(np.float64)) if camera.is_distorted else camera.rays_of_pixels()
    front = np.isfinite(rays).all(axis=-1) & (rays[..., 2] > 1e-3)
    x, y = (np.where(front, rays[..., axis] / np.where(front, rays[..., 2], 1), 9) for axis in (0, 1))
    u, v = np.rint(plain.fx * x + plain.cx).astype(int), np.rint(plain.fy * y + plain.cy).astype(int)
    seen = front & (u >= 0) & (u < plain.width) & (v >= 0) & (v < plain.height)
    z = np.minimum(walls[np.clip(u // 4, 0, 15)], 1.5 / np.maximum(y, 1e-6))
    colour = rgb[np.clip(v, 0, plain.height - 1), np.clip(u, 0, plain.width - 1)]
    return np.where(seen[..., None], colour, np.uint8(0)), np.where(seen, z, 0).astype(np.float32)


def make_cloud() -> SurfelMap:
    """What ``make_pictures`` sees from the true view, as the survey would have mapped it."""
    _, depth_m, camera = make_pictures()
    points_camera = (camera.rays_of_pixels() * depth_m[..., None]).reshape(-1, 3)
    T_map_camera = true_pose()
    voxels = VoxelMap(0.3, np.round(T_map_camera[:3, 3]))
    for _ in range(3):  # so that every voxel has points enough for a normal
        voxels.add(transform_points(T_map_camera, points_camera))
    return SurfelMap.prepare(voxels.origin, *voxels.surfels())


def true_pose() -> NDArray[np.float64]:
    """T_map_camera of ``make_pictures``: in the true view, 1.5 m above the ground under the true place's LiDAR."""
    heading = TRUE_HEADING * np.pi / 2
    place = np.array([10.0 * (TRUE_PLACE % 6), 100.0 * (TRUE_PLACE // 6), 2.0])
    return transform_from(rotation_z(heading) @ R_BODY_OPTICAL, place + [0.0, 0.0, 1.5 - 1.8])


def make_content(*, name: str = "tiny", seed: int = 0, **changed: Any) -> BundleContent:
    """Twelve places, six in each street, four headings each; one view is that of ``make_pictures``."""
    encoder = make_encoder(seed=seed)
    rgb, depth_m, camera = make_pictures()
    view = query_view(rgb, depth_m, camera, grid=GRID, rows_seen=np.ones(GRID.rows, np.bool_))
    descriptors = np.random.default_rng(seed + 1).normal(size=(PLACES * HEADINGS, DESCRIPTOR_SIZE)).astype(np.float32)
    # Neither the true view nor its neighbours are met by chance.
    true = Encoder.open(encoder).encode(view.planes[None], side="query")[0]
    descriptors -= 1.0 * np.maximum(descriptors @ true, 0)[:, None] * true
    descriptors[TRUE_PLACE * HEADINGS + TRUE_HEADING] = true
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    T_map_place = np.stack(
        [transform_from(rotation_z(0.0), np.array([10.0 * (n % 6), 100.0 * (n // 6), 2.0])) for n in range(PLACES)]
    )
    given: dict[str, Any] = {
        "name": name,
        "grid": GRID,
        "headings": HEADINGS,
        "spacing_m": 10.0,
        "rows_seen": np.ones(GRID.rows, np.bool_),
        "T_map_place": T_map_place,
        "place_street": np.array([0] * 6 + [1, 1, 2, 2, 2, 2], np.int32),
        "view_place": np.repeat(np.arange(PLACES, dtype=np.int32), HEADINGS),
        "view_heading_rad": np.tile(np.arange(HEADINGS) * (np.pi / 2), PLACES),
        "descriptors": descriptors,
        "encoder": encoder,
        "streets": make_streets(),
        "cloud": make_cloud(),
        "calibration": {"calibrated": False, "why": "no cities were asked"},
        "parameters": {"lidar_height_m": 1.8, "voxel_m": 0.2},
        "licence": "CC0-1.0",
        "tool_versions": {"streetfix": "0"},
    }
    return BundleContent(**(given | changed))


def make_constant_calibration(*, right: float, known: float, threshold: float) -> dict[str, Any]:
    """A calibration with one confidence and one probability of being in the map for all answers, and no evidence out of range."""

    def log_odds(probability: float) -> float:
        return float(np.log(probability / (1 - probability)))

    return {
        "calibrated": True,
        "features": [{"name": name, "mean": 0.0, "std": 1e6} for name in FEATURES],
        "right": {"terms": [], "bias": log_odds(right)},
        "known": {"terms": [], "bias": log_odds(known)},
        "thresholds": [{"false_accept_rate": 0.01, "confidence": threshold}],
        "site": None,
        "measured_on": {"cities": "none", "queries": 0},
    }


def jpeg_of(rgb: NDArray[np.uint8]) -> bytes:
    """Lossless, despite the name of the part's usual format: the golden answer must not hang on a codec."""
    return cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes()


def npy_of(depth_m: NDArray[Any]) -> bytes:
    stream = io.BytesIO()
    np.save(stream, depth_m)
    return stream.getvalue()


def make_request_json(**changed: Any) -> dict[str, Any]:
    camera = {
        "model": "PINHOLE",
        "width": 64,
        "height": 48,
        "fx": 32,
        "fy": 32,
        "cx": 31.5,
        "cy": 23.5,
        "distortion": [],
    }
    return {"camera": camera, "depth": {"scale_m": 1, "kind": "z"}} | changed


def make_parts(**changed: Any) -> dict[str, bytes]:
    """The parts of a good request; ``changed`` goes into its JSON."""
    rgb, depth_m, _ = make_pictures()
    return {
        "rgb": jpeg_of(rgb),
        "depth": npy_of(depth_m),
        "request": json.dumps(make_request_json(**changed)).encode(),
    }


@pytest.fixture(scope="session")
def content() -> BundleContent:
    return make_content()


@pytest.fixture(scope="session")
def bundle_path(content: BundleContent, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One good bundle for all tests that only read."""
    path = tmp_path_factory.mktemp("maps") / "tiny"
    write_bundle(path, content)
    return path


@pytest.fixture
def bundle_copy(content: BundleContent, tmp_path: Path) -> Path:
    """A bundle of one's own, to damage."""
    path = tmp_path / "own"
    write_bundle(path, content)
    return path


@pytest.fixture(scope="session")
def content_of() -> Callable[..., BundleContent]:
    """The factory itself: test modules are no package and cannot import this file."""
    return make_content


@pytest.fixture(scope="session")
def constant_calibration() -> Callable[..., dict[str, Any]]:
    return make_constant_calibration


@pytest.fixture(scope="session")
def parts_of() -> Callable[..., dict[str, bytes]]:
    return make_parts


@pytest.fixture(scope="session")
def encoder_of() -> Callable[..., bytes]:
    return make_encoder


@pytest.fixture(scope="session")
def pictures_of() -> Callable[..., tuple[NDArray[np.uint8], NDArray[np.float32], PinholeCamera]]:
    return make_pictures


@pytest.fixture(scope="session")
def pictures_through() -> Callable[..., tuple[NDArray[np.uint8], NDArray[np.float32]]]:
    return make_pictures_through


@pytest.fixture(scope="session")
def png_and_npy() -> Callable[[NDArray[np.uint8], NDArray[Any]], dict[str, bytes]]:
    """Encodes a pair without loss."""
    return lambda rgb, depth_m: {"rgb": jpeg_of(rgb), "depth": npy_of(depth_m)}


@pytest.fixture(scope="session")
def pictures() -> tuple[NDArray[np.uint8], NDArray[np.float32], PinholeCamera]:
    return make_pictures()
