"""A track of a rig of several cameras, whose images of one moment are a sequence, over both faces and real sockets."""

import asyncio
import json
from collections.abc import Callable, Iterator
from typing import Any

import grpc
import httpx
import numpy as np
import pytest

from service.client import AsyncClient, Client, Frame, GrpcClient, RequestError, Track
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb

Parts = Callable[..., dict[str, bytes]]
CAMERA: dict[str, Any] = {"width": 64, "height": 48, "fx": 32, "fy": 32, "cx": 31.5, "cy": 23.5}
DEPTH: dict[str, Any] = {"scale_m": 1}
HERE = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
#: The tests send the same images again. The map is so small that 1 m lies within the uncertainty of a pose.
STEP = HERE | {"position": {"x": 0.0, "y": 0.0, "z": 1.0}}
T_STEP = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 1.0], [0, 0, 0, 1.0]])
#: Confidence and probability of being in the map that the calibration gives to every answer.
RIGHT, KNOWN, THRESHOLD = 0.8, 0.95, 0.9


@pytest.fixture(scope="module")
def faces(serving_with_confidence: Any) -> Iterator[Any]:
    """REST, gRPC, and the address of gRPC, on one engine."""
    with serving_with_confidence(right=RIGHT, known=KNOWN, threshold=THRESHOLD) as both:
        yield both


def posted(client: httpx.Client, parts: dict[str, bytes], **more: Any) -> httpx.Response:
    frames = [{"camera": CAMERA, "depth": DEPTH}, {"camera": CAMERA, "depth": DEPTH, "T_reference_camera": HERE}]
    pictures = {f"{name}{k}": parts[name] for k in range(2) for name in ("rgb", "depth")}
    body = pictures | {"request": json.dumps({"frames": frames} | more).encode()}
    return client.post("/v1/localize/sequence", files={name: (name, data) for name, data in body.items()})


def message_of(parts: dict[str, bytes], **track: Any) -> pb.LocalizeSequenceRequest:
    pair = {"rgb": parts["rgb"], "depth": parts["depth"]}
    about: dict[str, Any] = pair | {"camera": pb.Camera(**CAMERA), "depth_format": pb.DepthFormat(**DEPTH)}
    frames = [pb.SequenceFrame(**about), pb.SequenceFrame(**about, reference_from_camera=HERE)]
    return pb.LocalizeSequenceRequest(frames=frames, track=pb.Track(**track))


def weights_of(belief: Any) -> list[float]:
    modes = belief["modes"] if isinstance(belief, dict) else belief.modes
    return [each["weight"] if isinstance(each, dict) else each.weight for each in modes]


def test_the_images_of_one_moment_are_one_observation(faces: Any, parts_of: Parts) -> None:
    """Each moment has a confidence of 0.8, below the threshold. Two moments at one place have more."""
    client, stub, _ = faces
    first = posted(client, parts_of(), track={}).json()
    assert (first["status"], first["confidence"]) == ("AMBIGUOUS", pytest.approx(RIGHT))
    assert weights_of(first["belief"])[0] == pytest.approx(RIGHT)
    track = {"belief": first["belief"]["token"], "T_previous_camera": STEP}
    second = posted(client, parts_of(), track=track).json()
    assert second["status"] == "LOCALIZED"
    assert second["confidence"] > THRESHOLD
    assert second["belief"]["modes"][0]["number"] == first["belief"]["modes"][0]["number"]
    begun = stub.LocalizeSequence(message_of(parts_of())).answer
    assert (begun.status, weights_of(begun.belief)) == (
        pb.LOCALIZATION_STATUS_AMBIGUOUS,
        pytest.approx(weights_of(first["belief"])),
    )
    following = message_of(parts_of(), belief=begun.belief.token, previous_from_camera=STEP)
    answer = stub.LocalizeSequence(following).answer
    assert answer.status == pb.LOCALIZATION_STATUS_LOCALIZED
    assert weights_of(answer.belief) == pytest.approx(weights_of(second["belief"]))


def test_a_track_may_continue_with_one_camera_and_with_several(faces: Any, parts_of: Parts) -> None:
    client, stub, _ = faces
    first = posted(client, parts_of(), track={}).json()["belief"]
    parts = parts_of(track={"belief": first["token"], "T_previous_camera": STEP})
    second = client.post("/v1/localize", files={name: (name, data) for name, data in parts.items()}).json()
    assert second["status"] == "LOCALIZED"
    third = message_of(parts_of(), belief=second["belief"]["token"], previous_from_camera=STEP)
    belief = stub.LocalizeSequence(third).answer.belief
    assert (belief.epoch, belief.modes[0].number) == (0, first["modes"][0]["number"])


def test_without_a_track_a_sequence_has_no_belief(faces: Any, parts_of: Parts) -> None:
    client, stub, _ = faces
    assert posted(client, parts_of()).json()["belief"] is None
    plain = pb.LocalizeSequenceRequest(frames=message_of(parts_of()).frames)
    assert not stub.LocalizeSequence(plain).answer.HasField("belief")


def test_an_error_of_the_track_names_the_track_and_one_of_a_frame_names_the_frame(faces: Any, parts_of: Parts) -> None:
    client, stub, _ = faces
    unknown: dict[str, Any] = {"belief": "YWJj"}
    without_odometry: dict[str, Any] = {"odometry_std": {"position_m": 1.0, "angle_deg": 1.0}}
    for track, field in ((unknown, "track.belief"), (without_odometry, "track.odometry_std")):
        refused = posted(client, parts_of(), track=track)
        assert (refused.status_code, refused.json()["field"]) == (422, field)
    with pytest.raises(grpc.RpcError, match="it does not come from this service"):
        stub.LocalizeSequence(message_of(parts_of(), belief="YWJj"))
    refused = posted(client, parts_of() | {"depth": b"no image"}, track={})
    assert (refused.status_code, refused.json()["field"]) == (415, "frames.0.depth")


def test_every_client_carries_the_track_of_a_rig(faces: Any, pictures: Any) -> None:
    client, _, address = faces
    rgb, depth_m, camera = pictures
    rig = [
        Frame(rgb=rgb, depth=depth_m, camera=camera),
        Frame(rgb=rgb, depth=depth_m, camera=camera, T_reference_camera=np.eye(4)),
    ]
    url = str(client.base_url)

    async def asked_in_turn() -> list[str]:
        async with AsyncClient(url) as remote:
            before = await remote.localize_sequence(rig, track=Track())
            after = await remote.localize_sequence(rig, track=Track(before=before, T_previous_camera=T_STEP))
            return [before.status, after.status]

    assert asyncio.run(asked_in_turn()) == ["AMBIGUOUS", "LOCALIZED"]
    with Client(url) as rest, GrpcClient(address) as remote:
        for asking in (rest, remote):
            first = asking.localize_sequence(rig, track=Track())
            second = asking.localize_sequence(rig, track=Track(before=first, T_previous_camera=T_STEP))
            assert [first.status, second.status] == ["AMBIGUOUS", "LOCALIZED"]
            with pytest.raises(TypeError, match="unknown argument 'track'"):
                asking.localize_batch(rig[:1], track=Track())  # type: ignore[call-arg]
            with pytest.raises(RequestError, match=r"track\.before: it is missing"):
                asking.localize_sequence(rig, track=Track(T_previous_camera=T_STEP))
