"""The written files, read by independent readers."""

import numpy as np
import pytest

from model_training.cli.view import command
from model_training.evaluation.saved_run import SavedRun
from model_training.viewing.events import Poses
from model_training.viewing.source import events_of
from service.cli.main import main
from service.geometry.rigid import rotation_from_quaternion_xyzw

SEEN = {"most_scans": 4, "most_points": 500}


@pytest.fixture(scope="module")
def messages(saved_run, tmp_path_factory):
    """Return topic -> (schema, time in ns, decoded message) of the answers in MCAP."""
    pytest.importorskip("foxglove")
    reader_of = pytest.importorskip("mcap.reader")
    decoder = pytest.importorskip("mcap_protobuf.decoder")
    from model_training.viewing.mcap_file import write_mcap

    path = tmp_path_factory.mktemp("mcap") / "answers.mcap"
    write_mcap(events_of(saved_run, **SEEN), path)
    found = {}
    with path.open("rb") as file:
        reader = reader_of.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((schema.name, message.log_time, decoded))
    assert [each.name for each in path.parent.iterdir()] == ["answers.mcap"]
    return found


def test_topics_have_foxgloves_schemas(messages):
    assert {topic: every[0][0].removeprefix("foxglove.") for topic, every in messages.items()} == {
        "/map/cloud": "PointCloud",
        "/map/places": "SceneUpdate",
        "/map/streets": "SceneUpdate",
        "/tf": "FrameTransforms",
        "/query/truth": "PosesInFrame",
        "/query/camera/calibration": "CameraCalibration",
        "/query/camera/colour": "CompressedImage",
        "/query/camera/depth": "RawImage",
        "/query/camera/fused": "CompressedImage",
        "/answer/neighbours": "PosesInFrame",
        "/answer/hypotheses": "PosesInFrame",
        "/answer/registered": "PosesInFrame",
        "/answer/pose": "PosesInFrame",
        "/answer/error": "SceneUpdate",
        "/answer/log": "Log",
    }


def test_every_query_is_there_a_second_after_the_one_before(messages):
    for topic in ("/query/truth", "/answer/pose", "/tf", "/answer/log"):
        assert [at for _, at, _ in messages[topic]] == [k * 10**9 for k in range(5)]


def test_poses_are_those_that_were_answered(messages, saved_run):
    p = SavedRun.open(saved_run).predictions["drive1_precise"]
    for row, (_, _, found) in enumerate(messages["/answer/pose"]):
        assert found.frame_id == "map"
        at, q = found.poses[0].position, found.poses[0].orientation
        np.testing.assert_allclose([at.x, at.y, at.z], p.T_answer[row, :3, 3])
        np.testing.assert_allclose(
            rotation_from_quaternion_xyzw(np.array([q.x, q.y, q.z, q.w])), p.T_answer[row, :3, :3], atol=1e-9
        )


def test_points_of_the_cloud_unpack(messages):
    cloud = messages["/map/cloud"][0][2]
    assert [(field.name, field.offset) for field in cloud.fields] == [("x", 0), ("y", 4), ("z", 8), ("intensity", 12)]
    assert 0 < len(cloud.data) <= 500 * cloud.point_stride
    assert len(cloud.data) % cloud.point_stride == 0
    assert np.isfinite(np.frombuffer(cloud.data, "<f4,<f4,<f4,<u1")["f0"]).all()


def test_depth_is_of_the_cameras_size_in_millimetres(messages, small_dataset):
    depth = messages["/query/camera/depth"][0][2]
    assert (depth.width, depth.height, depth.encoding, depth.step) == (96, 72, "16UC1", 192)
    frame = next(small_dataset.queries("drive1_precise"))
    picture = np.frombuffer(depth.data, "<u2").reshape(72, 96)
    np.testing.assert_allclose(picture / 1000.0, frame.depth_m(), atol=6e-4)


def test_a_rerun_file_holds_every_entity_and_query(saved_run, tmp_path):
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    from model_training.viewing.rerun_file import write_rerun

    path = tmp_path / "answers.rrd"
    write_rerun(events_of(saved_run, **SEEN), path)
    assert path.read_bytes()[:4] == b"RRF2"
    rows = {}
    for chunk in RrdReader(path).stream():
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    assert {"/map/cloud/points", "/map/places", "/query/camera/picture/colour", "/query/camera/picture/depth"} <= set(
        rows
    )
    assert {rows[f"/{name}"] for name in ("query/truth", "answer/pose", "answer/hypotheses", "answer/registered")} == {
        5
    }
    assert [each.name for each in tmp_path.iterdir()] == ["answers.rrd"]


def test_a_stream_that_breaks_leaves_no_file(tmp_path):
    pytest.importorskip("foxglove")
    from model_training.viewing.mcap_file import write_mcap

    def broken():
        yield Poses("query/truth", 0.0, np.eye(4)[None])
        raise RuntimeError("the disk is gone")

    with pytest.raises(RuntimeError, match="the disk is gone"):
        write_mcap(broken(), tmp_path / "x.mcap")
    assert not (tmp_path / "x.mcap").exists()


def test_the_command_writes_what_was_asked_for(bundle_path, tmp_path, capsys):
    pytest.importorskip("foxglove")
    command(bundle_path, save=None, mcap=tmp_path / "new" / "map.mcap", scans=5, points=100)
    assert "3 events: " in capsys.readouterr().out
    assert (tmp_path / "new" / "map.mcap").read_bytes()[:5] == b"\x89MCAP"


@pytest.mark.parametrize(("missing", "option"), [("rerun", "--save"), ("foxglove", "--mcap")])
def test_a_missing_package_names_the_extra(bundle_path, tmp_path, monkeypatch, capsys, missing, option):
    import sys

    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(SystemExit) as end:
        main(["view", str(bundle_path), option, str(tmp_path / "x")])
    assert end.value.code == 1
    assert 'pip install ".[view]"' in capsys.readouterr().err
