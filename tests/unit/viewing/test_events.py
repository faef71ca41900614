"""The visual form of datasets, maps and answers."""

import json
import shutil
from typing import Any

import numpy as np
import pytest

from model_training.evaluation.saved_run import SavedRun
from model_training.viewing.events import Cloud, Note, Outlines, Poses, Track, View, millimetres
from model_training.viewing.of_answers import upright
from model_training.viewing.source import events_of
from service.errors import DatasetError
from service.geometry.rigid import heading_of_camera
from service.maps.reader import MapBundle

SEEN = {"most_scans": 4, "most_points": 500}


def test_a_dataset_shows_scans_in_the_map_frame_then_queries(small_dataset):
    events: list[Any] = list(events_of(small_dataset.folder, **SEEN))
    scans: list[Any] = [event for event in events if isinstance(event, Cloud)]
    assert len(scans) == 4
    assert max(len(scan.points_m) for scan in scans) <= 500
    T = small_dataset.survey_poses()[0]
    first = small_dataset.scan(0)[0, :3]
    np.testing.assert_allclose(scans[0].origin_m + scans[0].points_m[0], (T @ [*first, 1])[:3], atol=1e-4)
    views: list[Any] = [event for event in events if isinstance(event, View)]
    assert len(views) == 5
    assert all(view.colour_jpeg[:2] == view.fused_jpeg[:2] == b"\xff\xd8" for view in views)
    assert min(view.stamp_s for view in views) > max(scan.stamp_s for scan in scans)


def test_a_map_shows_cloud_places_and_streets_all_the_time(bundle_path):
    cloud, places, streets = events_of(bundle_path, **SEEN)
    bundle = MapBundle.open(bundle_path)
    assert bundle.cloud is not None
    assert isinstance(cloud, Cloud)
    np.testing.assert_allclose(cloud.points_m[0], bundle.cloud.unpacked(np.s_[:1])["xyz"][0], atol=1e-5)
    assert isinstance(places, Track)
    assert len(places.positions_m) == 12
    assert isinstance(streets, Outlines)
    assert streets.names == ("Street 1", "Beginning of street 2", "End of street 2")
    assert {event.stamp_s for event in (cloud, places, streets)} == {None}


def test_answers_show_each_querys_truth_hypotheses_registration_and_answer(saved_run):
    p = SavedRun.open(saved_run).predictions["drive1_precise"]
    events: list[Any] = list(events_of(saved_run, **SEEN))
    for row in range(len(p.T_true)):
        now = {event.topic: event for event in events if event.stamp_s == float(row)}
        np.testing.assert_allclose(now["query/truth"].T_map_camera[0], p.T_true[row])
        np.testing.assert_allclose(now["answer/pose"].T_map_camera[0], p.T_answer[row])
        np.testing.assert_allclose(now["answer/registered"].T_map_camera[0, :2, 3], p.candidates[row, 0, :2])
        assert len(now["answer/hypotheses"].T_map_camera) == np.isfinite(p.hypotheses[row, :, 0]).sum() > 0
        assert isinstance(now["query/camera"], View)
        assert isinstance(now["answer/log"], Note)
    assert [event for event in events if event.topic == "map/cloud"]


def test_answers_are_shown_without_missing_maps_and_images(saved_run, tmp_path):
    own = shutil.copytree(saved_run, tmp_path / "own")
    settings = json.loads((own / "run.json").read_text())
    settings["map"]["path"] = settings["dataset"]["path"] = str(tmp_path / "gone")
    (own / "run.json").write_text(json.dumps(settings))
    kinds = {type(event) for event in events_of(own, **SEEN)}
    assert kinds == {Poses, Track, Note}


def test_another_folder_is_refused_with_what_it_lacks(tmp_path):
    with pytest.raises(DatasetError, match=r"it has none of dataset\.json, manifest\.json, run\.json"):
        list(events_of(tmp_path, **SEEN))


def test_upright_poses_look_along_their_heading_and_leave_out_what_is_none():
    (pose,) = upright(np.array([[3.0, 4.0, 0.7], [np.nan] * 3]), 1.5)
    assert pose[:3, 3].tolist() == [3.0, 4.0, 1.5]
    assert heading_of_camera(pose) == pytest.approx(0.7)


def test_depth_in_millimetres_stays_within_sixteen_bits():
    assert millimetres(np.array([[0.0, 1.2345, np.nan, 99.0]], np.float32)).tolist() == [[0, 1234, 0, 65535]]
