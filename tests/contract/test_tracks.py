"""A robot's track over both faces: a client that carries the belief, and a stream that keeps it. Over real sockets."""

import base64
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
import httpx
import numpy as np
import pytest

from service.bridge.asking import AskService
from service.bridge.known import Known, Motion
from service.client import (
    Client,
    GrpcClient,
    OdometryStd,
    PinholeCamera,
    RefusedError,
    RequestError,
    RetryPolicy,
    StreamAnswer,
    StreamFrame,
    Track,
)
from service.contract.schema import MOST_TOKEN
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceStub
from service.grpc.server import GrpcServer
from service.localization.track_bytes import MOST_BYTES
from service.maps.writer import write_bundle
from service.runtime.engine import Engine
from service.runtime.settings import Settings

Parts = Callable[..., dict[str, bytes]]
CAMERA = pb.Camera(width=64, height=48, fx=32, fy=32, cx=31.5, cy=23.5)
DEPTH = pb.DepthFormat(scale_m=1)
#: The tests send one picture again. So the robot must say that it moved, or the picture would be no new evidence. The map is so
#: small that 1 m lies within the uncertainty of a pose.
STEP = {"position": {"x": 0.0, "y": 0.0, "z": 1.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
STAY = STEP | {"position": {"x": 0.0, "y": 0.0, "z": 0.0}}
T_STEP = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 1.0], [0, 0, 0, 1.0]])
#: Confidence and probability of being in the map that the calibration gives to every answer. The threshold is 0.9.
RIGHT, KNOWN, THRESHOLD = 0.8, 0.95, 0.9


@pytest.fixture(scope="module")
def faces(serving_with_confidence: Any) -> Iterator[tuple[httpx.Client, LocalizationServiceStub, str]]:
    """REST, gRPC, and the address of gRPC, on one engine."""
    with serving_with_confidence(right=RIGHT, known=KNOWN, threshold=THRESHOLD) as both:
        yield both


def posted(client: httpx.Client, parts: dict[str, bytes]) -> httpx.Response:
    return client.post("/v1/localize", files={name: (name, data) for name, data in parts.items()})


def message_of(parts: dict[str, bytes], **track: Any) -> pb.LocalizeRequest:
    return pb.LocalizeRequest(
        rgb=parts["rgb"], depth=parts["depth"], camera=CAMERA, depth_format=DEPTH, track=pb.Track(**track)
    )


def test_frames_that_agree_become_localized(faces: Any, parts_of: Parts) -> None:
    """One frame has a confidence of 0.8, below the threshold. Two frames at one place have more."""
    client, _, _ = faces
    alone = posted(client, parts_of()).json()
    assert (alone["status"], alone["belief"]) == ("AMBIGUOUS", None)
    first = posted(client, parts_of(track={})).json()
    assert (first["status"], first["confidence"]) == ("AMBIGUOUS", pytest.approx(RIGHT))
    belief = first["belief"]
    assert belief["epoch"] == 0
    assert belief["modes"][0]["weight"] == pytest.approx(RIGHT)
    assert sum(mode["weight"] for mode in belief["modes"]) + belief["elsewhere"] + belief["outside"] == pytest.approx(1)
    second = posted(client, parts_of(track={"belief": belief["token"], "T_previous_camera": STEP})).json()
    assert second["status"] == "LOCALIZED"
    assert second["confidence"] > THRESHOLD
    assert second["belief"]["modes"][0]["number"] == belief["modes"][0]["number"]
    assert second["pose"]["position"] == second["hypotheses"][0]["pose"]["position"]
    assert (second["spread"], second["hypotheses"][0]["confirmed"]) == (None, True)


def test_the_ros_bridge_carries_the_belief(faces: Any, pictures: Any) -> None:
    client, _, _ = faces
    with Client(str(client.base_url)) as rest:
        ask = AskService(rest)
        first = ask(*(*pictures, Known(motion=Motion())))
        second = ask(*(*pictures, Known(motion=Motion(T_STEP))))
        begun = ask(*(*pictures, Known(motion=Motion())))
        alone = ask(*(*pictures, Known()))
    assert [answer.status for answer in (first, second, begun, alone)] == [
        "AMBIGUOUS",
        "LOCALIZED",
        "AMBIGUOUS",
        "AMBIGUOUS",
    ]
    assert first.belief is not None
    assert begun.belief is not None
    assert (first.belief.epoch, begun.belief.epoch, alone.belief) == (0, 1, None)


def test_a_robot_that_stands_still_is_not_localized_by_repetition(faces: Any, parts_of: Parts) -> None:
    client, _, _ = faces
    answer = posted(client, parts_of(track={})).json()
    for _ in range(5):
        answer = posted(client, parts_of(track={"belief": answer["belief"]["token"], "T_previous_camera": STAY})).json()
        assert answer["status"] == "AMBIGUOUS"
        assert answer["belief"]["modes"][0]["weight"] == pytest.approx(RIGHT, abs=0.01)


def test_unknown_odometry_begins_an_epoch_once_the_robot_was_localized(faces: Any, parts_of: Parts) -> None:
    client, _, _ = faces
    answer = posted(client, parts_of(track={})).json()
    for _ in range(2):
        track = {"belief": answer["belief"]["token"], "T_previous_camera": STEP}
        answer = posted(client, parts_of(track=track)).json()
    assert (answer["status"], answer["belief"]["epoch"]) == ("LOCALIZED", 0)
    lost = posted(client, parts_of(track={"belief": answer["belief"]["token"]})).json()
    assert (lost["status"], lost["belief"]["epoch"]) == ("AMBIGUOUS", 1)


def test_both_faces_continue_each_others_tracks(faces: Any, parts_of: Parts) -> None:
    client, stub, _ = faces
    parts = parts_of()
    first = stub.Localize(message_of(parts)).belief
    second = posted(client, parts_of(track={"belief": first.token, "T_previous_camera": STEP})).json()["belief"]
    again = stub.Localize(message_of(parts, belief=first.token, previous_from_camera=STEP)).belief
    assert [mode["weight"] for mode in second["modes"]] == pytest.approx([mode.weight for mode in again.modes])
    assert (second["elsewhere"], second["outside"]) == pytest.approx((again.elsewhere, again.outside))
    x = second["modes"][0]["pose"]["position"]["x"]
    assert x == pytest.approx(again.modes[0].pose.position.x)
    assert x == pytest.approx(20, abs=0.3)


FAR = STEP | {"position": {"x": 0.0, "y": 0.0, "z": 2.0}}
ROUGH = {"position_m": 2.0, "angle_deg": 3.0}


def test_poor_odometry_leaves_the_mode_where_the_image_says(faces: Any, parts_of: Parts) -> None:
    """Odometry says 2 m and the image none. Accurate odometry makes this another mode. With a deviation of 2 m it is the same one."""
    client, stub, _ = faces
    parts = parts_of()
    first = posted(client, parts_of(track={})).json()["belief"]
    known = {"belief": first["token"], "T_previous_camera": FAR}
    sure = posted(client, parts_of(track=known)).json()["belief"]
    rough = posted(client, parts_of(track=known | {"odometry_std": ROUGH})).json()["belief"]
    assert first["modes"][0]["number"] not in [mode["number"] for mode in sure["modes"] if mode["unseen"] == 0]
    assert first["modes"][0]["number"] in [mode["number"] for mode in rough["modes"] if mode["unseen"] == 0]
    again = stub.Localize(
        message_of(parts, belief=first["token"], previous_from_camera=FAR, odometry_std=pb.OdometryStd(**ROUGH))
    ).belief
    assert [mode.weight for mode in again.modes] == pytest.approx([mode["weight"] for mode in rough["modes"]])
    frame = pb.LocalizeRequest(rgb=parts["rgb"], depth=parts["depth"], camera=CAMERA, depth_format=DEPTH)
    steps = [
        pb.LocalizeStreamRequest(frame=frame),
        pb.LocalizeStreamRequest(frame=frame, previous_from_camera=FAR, odometry_std=pb.OdometryStd(**ROUGH)),
    ]
    *_, last = (each.outcome.answer.belief for each in stub.LocalizeStream(iter(steps)))
    assert [mode.number for mode in last.modes if mode.unseen == 0] == [
        mode["number"] for mode in rough["modes"] if mode["unseen"] == 0
    ]


@pytest.mark.parametrize(
    ("std", "field"),
    [
        ({"position_m": 0.0, "angle_deg": 1.0}, "track.odometry_std.position_m"),
        ({"position_m": 101.0, "angle_deg": 1.0}, "track.odometry_std.position_m"),
        ({"position_m": 0.1, "angle_deg": 181.0}, "track.odometry_std.angle_deg"),
        ({"position_m": 0.1}, "track.odometry_std.angle_deg"),
    ],
)
def test_bad_deviations_of_odometry_are_refused(faces: Any, parts_of: Parts, std: dict[str, float], field: str) -> None:
    client, stub, _ = faces
    refused = posted(client, parts_of(track={"T_previous_camera": STEP, "odometry_std": std}))
    assert (refused.status_code, refused.json()["field"]) == (422, field)
    message = message_of(parts_of(), previous_from_camera=STEP, odometry_std=pb.OdometryStd(**std))
    with pytest.raises(grpc.RpcError, match=field.replace(".", r"\.")):
        stub.Localize(message)


def test_deviations_without_odometry_are_refused(faces: Any, parts_of: Parts) -> None:
    client, stub, _ = faces
    refused = posted(client, parts_of(track={"odometry_std": ROUGH}))
    assert (refused.status_code, refused.json()["field"]) == (422, "track.odometry_std")
    assert "the request has no odometry (T_previous_camera" in refused.json()["detail"]
    assert refused.json()["detail"].endswith("send it, or omit odometry_std")
    parts = parts_of()
    frame = pb.LocalizeRequest(rgb=parts["rgb"], depth=parts["depth"], camera=CAMERA, depth_format=DEPTH)
    (problem,) = stub.LocalizeStream(
        iter([pb.LocalizeStreamRequest(frame=frame, odometry_std=pb.OdometryStd(**ROUGH))])
    )
    assert problem.outcome.problem.field == "frame 0.odometry_std"


def test_the_clients_send_the_deviations_of_odometry(faces: Any, pictures: Any) -> None:
    client, _, address = faces
    rgb, depth_m, camera = pictures
    std, T_far = OdometryStd(**ROUGH), T_STEP.copy()
    T_far[2, 3] = 2.0
    with Client(str(client.base_url)) as rest, GrpcClient(address) as remote:
        for asking in (rest, remote):
            first = asking.localize(rgb, depth_m, camera, track=Track())
            track = Track(before=first, T_previous_camera=T_far, odometry_std=std)
            second = asking.localize(rgb, depth_m, camera, track=track)
            assert first.belief is not None
            assert second.belief is not None
            assert first.belief.modes[0].number in [mode.number for mode in second.belief.modes if mode.unseen == 0]


def test_a_stream_keeps_the_track_itself(faces: Any, parts_of: Parts) -> None:
    _, stub, _ = faces
    parts = parts_of()
    frame = pb.LocalizeRequest(rgb=parts["rgb"], depth=parts["depth"], camera=CAMERA, depth_format=DEPTH)
    steps = [pb.LocalizeStreamRequest(frame=frame, previous_from_camera=STEP if k else None) for k in range(3)]
    answers = [each.outcome.answer for each in stub.LocalizeStream(iter(steps))]
    assert [each.status for each in answers] == [
        pb.LOCALIZATION_STATUS_AMBIGUOUS,
        pb.LOCALIZATION_STATUS_LOCALIZED,
        pb.LOCALIZATION_STATUS_LOCALIZED,
    ]
    assert not any(each.belief.HasField("token") for each in answers)
    carried = stub.Localize(message_of(parts)).belief
    assert answers[0].belief.modes[0].weight == pytest.approx(carried.modes[0].weight)


def test_a_stream_refuses_a_carried_track_and_goes_on(faces: Any, parts_of: Parts) -> None:
    _, stub, _ = faces
    parts = parts_of()
    plain = pb.LocalizeRequest(rgb=parts["rgb"], depth=parts["depth"], camera=CAMERA, depth_format=DEPTH)
    requests = [pb.LocalizeStreamRequest(frame=each) for each in (message_of(parts), plain)]
    refused, answered = list(stub.LocalizeStream(iter(requests)))
    assert refused.outcome.problem.field == "frame 0.track"
    assert "omit track" in refused.outcome.problem.detail
    assert answered.outcome.HasField("answer")


def stream_frame(pictures: Any, T_previous_camera: Any = None) -> StreamFrame:
    rgb, depth_m, camera = pictures
    return StreamFrame(rgb=rgb, depth=depth_m, camera=camera, T_previous_camera=T_previous_camera)


def test_the_client_follows_a_robot_over_a_stream(faces: Any, pictures: Any) -> None:
    """The answers are those of a track that the client carries. A frame without odometry begins the track again."""
    _, _, address = faces
    rgb, depth_m, camera = pictures
    steps = [None, T_STEP, None]
    with GrpcClient(address) as client:
        streamed = list(client.localize_stream(stream_frame(pictures, T) for T in steps))
        carried = [client.localize(rgb, depth_m, camera, track=Track())]
        for T in steps[1:]:
            track = Track(before=carried[-1], T_previous_camera=T)
            carried.append(client.localize(rgb, depth_m, camera, track=track))
    assert [each.status for each in carried] == ["AMBIGUOUS", "LOCALIZED", "AMBIGUOUS"]
    for there, here in zip(streamed, carried, strict=True):
        assert isinstance(there, StreamAnswer)
        assert there.belief is not None
        assert here.belief is not None
        assert (there.status, there.belief.epoch, there.belief.token) == (here.status, here.belief.epoch, None)
        assert there.belief.modes[0].weight == pytest.approx(here.belief.modes[0].weight)
        assert there.frames >= 1


def test_a_stream_of_the_client_goes_on_with_another_service(
    faces: Any, pictures: Any, content_of: Any, constant_calibration: Any, tmp_path: Path
) -> None:
    """The service ends after two frames, and another one answers at the same port. The robot had a pose, so the epoch rises."""
    del faces
    folder = tmp_path / "tiny"
    write_bundle(folder, content_of(calibration=constant_calibration(right=RIGHT, known=KNOWN, threshold=THRESHOLD)))
    engine = Engine.open(Settings(maps=(folder,), threads=1, queue=4))
    first = GrpcServer(engine, host="127.0.0.1", port=0)
    first.start()
    second: list[GrpcServer] = []

    def drive() -> Iterator[StreamFrame]:
        yield stream_frame(pictures)
        yield stream_frame(pictures, T_STEP)
        first.stop(grace_s=0)
        second.append(GrpcServer(engine, host="127.0.0.1", port=first.port))
        second[0].start()
        yield stream_frame(pictures, T_STEP)
        yield stream_frame(pictures, T_STEP)

    policy = RetryPolicy(attempts=20, total_s=60.0, backoff_s=0.2)
    with GrpcClient(f"127.0.0.1:{first.port}", retry=policy) as client:
        answers = [each for each in client.localize_stream(drive()) if isinstance(each, StreamAnswer)]
    assert [each.status for each in answers] == ["AMBIGUOUS", "LOCALIZED", "AMBIGUOUS", "LOCALIZED"]
    assert [each.belief and each.belief.epoch for each in answers] == [0, 0, 1, 1]
    second[0].stop(grace_s=0)
    engine.close()


def changed(token: str) -> str:
    content = bytearray(base64.urlsafe_b64decode(token + "=" * (-len(token) % 4)))
    content[40] ^= 1
    return base64.urlsafe_b64encode(content).rstrip(b"=").decode()


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (changed, "does not come from this service"),
        (lambda token: token[:-8], "does not come from this service"),
        (lambda _: "", "does not come from this service"),
        (lambda token: token + "=", "belief"),
        (lambda token: token + "A" * (1 + (1 - len(token)) % 4), "belief"),
        (lambda _: "A" * (MOST_TOKEN + 1), "belief"),
    ],
    ids=["changed", "cut", "empty", "padding", "no base64", "too long"],
)
def test_a_token_of_another_origin_is_refused(
    faces: Any, parts_of: Parts, spoil: Callable[[str], str], told: str
) -> None:
    client, _, _ = faces
    token = posted(client, parts_of(track={})).json()["belief"]["token"]
    refused = posted(client, parts_of(track={"belief": spoil(token), "T_previous_camera": STEP}))
    problem = refused.json()
    assert (refused.status_code, problem["field"]) == (422, "track.belief")
    assert told in problem["detail"]


def test_the_longest_token_fits() -> None:
    mac = 32
    assert len(base64.urlsafe_b64encode(bytes(mac + MOST_BYTES))) <= MOST_TOKEN


def test_the_clients_carry_a_track(faces: Any, pictures: Any) -> None:
    client, _, address = faces
    rgb, depth_m, camera = pictures
    with Client(str(client.base_url)) as rest, GrpcClient(address) as remote:
        for asking in (rest, remote):
            first = asking.localize(rgb, depth_m, camera, track=Track())
            second = asking.localize(rgb, depth_m, camera, track=Track(before=first, T_previous_camera=T_STEP))
            assert [first.status, second.status] == ["AMBIGUOUS", "LOCALIZED"]
            assert second.belief is not None
            assert second.belief.modes[0].weight > THRESHOLD
        with pytest.raises(RefusedError, match=r"track\.belief"):
            rest.localize(
                rgb, depth_m, camera, track=Track(before=first.model_copy(update={"belief": forged(first.belief)}))
            )
    assert isinstance(camera, PinholeCamera)


def forged(belief: Any) -> Any:
    return belief.model_copy(update={"token": "A" * 100})


def test_a_batch_may_carry_tracks(faces: Any, parts_of: Parts) -> None:
    client, _, _ = faces
    parts = parts_of(track={})
    request = json.loads(parts["request"])
    pictures = {f"{name}0": (name, parts[name]) for name in ("rgb", "depth")}
    batch = client.post("/v1/localize/batch", files=pictures | {"request": ("r", json.dumps({"requests": [request]}))})
    assert batch.json()["outcomes"][0]["answer"]["belief"]["token"]


@pytest.mark.parametrize(
    ("track", "told"),
    [
        (lambda _: Track(T_previous_camera=T_STEP), "pass the previous answer"),
        (lambda alone: Track(before=alone, T_previous_camera=T_STEP), "its request had no track"),
        (lambda alone: alone, "it is no Track"),
    ],
    ids=["no answer", "an answer without a belief", "an answer"],
)
def test_a_client_that_forgets_a_part_of_the_track_is_told(
    faces: Any, pictures: Any, track: Callable[[Any], Any], told: str
) -> None:
    client, _, _ = faces
    rgb, depth_m, camera = pictures
    with Client(str(client.base_url)) as rest:
        alone = rest.localize(rgb, depth_m, camera)
        with pytest.raises(RequestError, match=told):
            rest.localize(rgb, depth_m, camera, track=track(alone))
