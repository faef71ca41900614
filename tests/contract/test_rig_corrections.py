"""A map has corrections for two rigs. Through both faces, each rig gets its own, and a third rig gets none."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
import httpx
import numpy as np
import pytest

from service.client import Client, GrpcClient
from service.client.grpc_messages import answer_of
from service.confidence.features import FEATURES
from service.contract.schema import LocalizeAnswer
from service.geometry.camera import PinholeCamera
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceStub
from service.maps.content import BundleContent
from service.maps.writer import write_bundle

Faces = tuple[httpx.Client, LocalizationServiceStub, str]
Parts = Callable[..., dict[str, bytes]]
#: Horizontal and vertical focal length of the rigs. The images have 64 x 48 pixels.
MULE, WAGON, OTHER = 32.0, 40.0, 36.0
#: Log odds of all answers without a correction, and with that of each rig.
ODDS, OF_MULE, OF_WAGON = 2.0, 1.0, 3.0
#: The rates that the recording of the wagon supports, the rate of the service, and the least rate of the map.
SUPPORTED, SETTING, LEAST = 0.05, 0.01, 0.001


def camera(focal: float) -> dict[str, Any]:
    return {"width": 64, "height": 48, "fx": focal, "fy": focal, "cx": 31.5, "cy": 23.5}


def correction(name: str, focal: float, offset: float, **more: Any) -> dict[str, Any]:
    counts = dict.fromkeys(("frames", "right", "outside", "accepted", "accepted_wrong", "outside_accepted"), 60)
    shares = dict.fromkeys(("error_before", "error_after", "wrong_share_upper", "outside_share_upper"), 0.1)
    described = {"name": name, "made_for": camera(focal), "measured_on": f"a recording of {name}", "source": "drive"}
    return described | {"scale": 1.0, "offset": offset, "lower_only": False} | counts | shares | more


@pytest.fixture(scope="module")
def faces(
    content_of: Callable[..., BundleContent], tmp_path_factory: pytest.TempPathFactory, serving: Any
) -> Iterator[Faces]:
    thresholds = [{"false_accept_rate": rate, "confidence": 0.5} for rate in (LEAST, SETTING)]
    of_wagon = [{"false_accept_rate": SUPPORTED, "confidence": 0.7}]
    document = {
        "calibrated": True,
        "features": [{"name": name, "mean": 0.0, "std": 1.0} for name in FEATURES],
        "right": {"terms": [], "bias": ODDS},
        "known": {"terms": [], "bias": 4.0},
        "thresholds": thresholds,
        "rigs": [
            correction("mule", MULE, OF_MULE - ODDS),
            correction("wagon", WAGON, OF_WAGON - ODDS, thresholds=of_wagon),
        ],
        "measured_on": {},
    }
    folder: Path = tmp_path_factory.mktemp("rigs") / "tiny"
    write_bundle(folder, content_of(calibration=document))
    with serving(folder, false_accept_rate=SETTING) as found:
        yield found


def posted(client: httpx.Client, parts: dict[str, bytes]) -> httpx.Response:
    return client.post("/v1/localize", files={name: (name, data) for name, data in parts.items()})


def asked(parts: dict[str, bytes], focal: float, rate: float | None = None) -> pb.LocalizeRequest:
    return pb.LocalizeRequest(
        rgb=parts["rgb"],
        depth=parts["depth"],
        camera=pb.Camera(**camera(focal)),
        depth_format=pb.DepthFormat(scale_m=1),
        options=pb.Options(false_accept_rate=rate),
    )


@pytest.mark.parametrize(
    ("focal", "name", "odds", "threshold"),
    [
        (MULE, "mule", OF_MULE, (0.5, SETTING)),
        (WAGON, "wagon", OF_WAGON, (0.7, SUPPORTED)),  # the stricter threshold, with its rate
        (OTHER, None, ODDS, (0.5, SETTING)),
    ],
)
def test_each_rig_gets_its_correction_through_both_faces_and_clients(
    faces: Faces, parts_of: Parts, pictures: Any, focal: float, name: str | None, odds: float, threshold: Any
) -> None:
    client, stub, address = faces
    parts = parts_of(camera=camera(focal))
    rgb, depth_m, _ = pictures
    pinhole = PinholeCamera(**camera(focal))
    with Client(str(client.base_url)) as rest, GrpcClient(address) as messages:
        answers = [
            LocalizeAnswer.model_validate(posted(client, parts).json()),
            answer_of(stub.Localize(asked(parts, focal))),
            *(each.localize(rgb, depth_m, pinhole) for each in (rest, messages)),
        ]
    for answer in answers:
        assert answer.rig_correction == name
        assert answer.confidence == pytest.approx(1 / (1 + np.exp(-odds)))
        assert answer.threshold is not None
        assert (answer.threshold.confidence, answer.threshold.false_accept_rate) == threshold


def test_a_rate_that_the_recording_of_the_rig_does_not_support_is_refused(faces: Faces, parts_of: Parts) -> None:
    client, stub, _ = faces
    what = "is below what the recording of this rig supports (wagon, 60 out-of-map frames); send 0.05 or more"
    refused = posted(client, parts_of(camera=camera(WAGON), options={"false_accept_rate": SETTING}))
    assert refused.status_code == 422
    assert what in refused.json()["detail"]
    assert refused.json()["field"] == "options.false_accept_rate"
    with pytest.raises(grpc.RpcError) as error:
        stub.Localize(asked(parts_of(), WAGON, SETTING))
    assert error.value.code() is grpc.StatusCode.INVALID_ARGUMENT
    assert what in (error.value.details() or "")
    # Other rigs, and the rate that the recording supports.
    for focal, rate in ((MULE, SETTING), (OTHER, SETTING), (OTHER, LEAST), (WAGON, SUPPORTED)):
        parts = parts_of(camera=camera(focal), options={"false_accept_rate": rate})
        answer = posted(client, parts).json()
        assert answer["threshold"]["false_accept_rate"] == rate
        assert stub.Localize(asked(parts, focal, rate)).threshold.false_accept_rate == rate
