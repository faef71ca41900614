"""``evaluate`` measures what the service answers: the same frames give the same results over HTTP."""

import json
import shutil

import cv2
import numpy as np
import pytest

from model_training.datasets.dataset import Dataset
from model_training.evaluation.evaluate import evaluate
from model_training.loadtest.payloads import payloads
from model_training.mapping.build import build_map
from model_training.mapping.settings import BuildSettings
from service.geometry.rigid import quaternion_xyzw_from
from service.maps.reader import MapBundle
from service.retrieval.encoder import Encoder
from service.runtime.engine import Engine
from service.runtime.settings import Limits, Settings

NAME = "drive1_precise"


@pytest.fixture(scope="module")
def rig_dataset(small_dataset, tmp_path_factory):
    """Return the small dataset like that of a stereo rig: JPEGs of four times the size, and a baseline."""
    folder = shutil.copytree(small_dataset.folder, tmp_path_factory.mktemp("datasets") / "rig")
    for path in (folder / "queries" / NAME / "rgb").iterdir():
        small = cv2.imread(str(path))
        assert small is not None
        picture = cv2.resize(small, None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST)
        path.unlink()
        cv2.imwrite(str(path.with_suffix(".jpg")), picture)
    description = json.loads((folder / "dataset.json").read_text())
    for camera in description["sensors"]["cameras"]:
        camera["depth"]["baseline_m"] = 0.5
    (folder / "dataset.json").write_text(json.dumps(description))
    return Dataset(folder)


@pytest.fixture(scope="module")
def calibrated_map(rig_dataset, encoder_file, calibration_file_of, tmp_path_factory):
    out = tmp_path_factory.mktemp("maps") / "calibrated"
    calibration = calibration_file_of(Encoder.open(encoder_file).sha256)
    settings = BuildSettings(name="rig", headings=6, spacing_m=5.0, align_survey=False, calibration=calibration)
    build_map(rig_dataset, encoder_file, out, settings, threads=1)
    return out


@pytest.fixture(scope="module")
def engine_of(calibrated_map):
    engine = Engine.open(Settings(maps=(calibrated_map,), threads=1, limits=Limits()))
    yield engine
    engine.close()


@pytest.mark.parametrize("refine", [True, False])
def test_evaluate_and_the_service_give_the_same_numbers(rig_dataset, calibrated_map, engine_of, client_of, refine):
    measured = evaluate(MapBundle.open(calibrated_map), rig_dataset, [NAME], refine=refine).predictions[NAME]
    client, statuses = client_of(engine_of), set()
    for k, asked in enumerate(payloads(rig_dataset, NAME, map_name=None, refine=refine, most=100)):
        reply = client.post("/v1/localize", content=asked.body, headers={"Content-Type": asked.content_type})
        assert reply.status_code == 200, reply.text
        answer = reply.json()
        statuses.add(answer["status"])
        assert answer["status"] == measured.status[k]
        assert answer["confidence"] == pytest.approx(measured.confidence[k], rel=1e-9, nan_ok=True) or (
            answer["confidence"] is None and np.isnan(measured.confidence[k])
        )
        ranked = [[each["position"]["x"], each["position"]["y"]] for each in answer["neighbours"]]
        np.testing.assert_allclose(measured.ranked_xy[k, : len(ranked)], ranked)
        assert [each["place"] for each in answer["neighbours"]] == measured.ranked_place[k, : len(ranked)].tolist()
        poses = [answer["pose"]] if answer["pose"] is not None else [each["pose"] for each in answer["hypotheses"]][:1]
        for pose in poses:
            _same_pose(pose, measured.T_answer[k], measured.covariance[k])
        assert bool(poses) or not refine  # without registration an answer has a pose only where it is LOCALIZED
    assert statuses


def _same_pose(pose, T, covariance):
    position, turned = pose["position"], pose["orientation"]
    np.testing.assert_allclose([position[axis] for axis in "xyz"], T[:3, 3], atol=1e-9)
    quaternion = np.array([turned[axis] for axis in "xyzw"])
    np.testing.assert_allclose(abs(quaternion @ quaternion_xyzw_from(T[:3, :3])), 1.0, atol=1e-9)
    if pose["covariance"] is not None:
        np.testing.assert_allclose(np.reshape(pose["covariance"], (6, 6)), covariance, rtol=1e-6)


def test_the_baseline_and_the_reduced_colour_reach_the_query(rig_dataset, calibrated_map):
    """Earlier, ``evaluate`` ignored both, but the service used them."""
    frame = next(iter(rig_dataset.queries(NAME)))
    query = frame.query(MapBundle.open(calibrated_map).grid)
    assert query.baseline_m == 0.5
    assert query.rgb.shape[1] < frame.rgb().shape[1]
