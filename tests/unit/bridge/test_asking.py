"""What the bridge sends to a service: optional data, and the belief of the answer before."""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.bridge.asking import AskService
from service.bridge.known import Known, Motion
from service.client.prepare import Track
from service.contract.schema import LocalizeAnswer, Options, Prior, PriorPosition
from service.errors import RefusedError, UnreachableError
from service.geometry.camera import PinholeCamera
from service.imaging.level import GivenHeight
from service.localization.belief import OdometryStd
from service.option_limits import LEAST_ODOMETRY_STD_DEG, LEAST_ODOMETRY_STD_M
from service.retrieval import prior as core

PICTURES = (np.zeros((4, 6, 3), np.uint8), np.ones((4, 6), np.float32), PinholeCamera(6, 4, 3.0, 3.0, 2.5, 1.5))
AHEAD = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2.0], [0, 0, 0, 1]])


class Asked:
    """A service: it keeps the requests, and gives the answers in turn."""

    def __init__(self, *answers: Any) -> None:
        self.about: list[dict[str, Any]] = []
        self._answers = iter(answers)

    def localize(self, *_: Any, **about: Any) -> Any:
        self.about.append(about)
        answer = next(self._answers)
        if isinstance(answer, Exception):
            raise answer
        return answer

    @property
    def tracks(self) -> list[tuple[Any, Any]]:
        """Answer before and motion of each request with a track."""
        tracks: list[Track] = [about["track"] for about in self.about]
        return [(track.before, track.T_previous_camera) for track in tracks]


def ask_of(service: Asked) -> AskService:
    client: Any = SimpleNamespace(localize=service.localize)
    return AskService(client, "site")


def test_only_what_is_known_is_sent(answer_of: Callable[..., LocalizeAnswer]) -> None:
    service = Asked(answer_of())
    ask_of(service)(*PICTURES, Known())
    assert service.about == [{"map": "site"}]


def test_what_is_known_is_sent_as_the_contract_has_it(answer_of: Callable[..., LocalizeAnswer]) -> None:
    service = Asked(answer_of())
    prior = core.Prior(
        position_m=np.array([3.0, 4.0]), position_std_m=2.5, heading_rad=math.pi / 2, heading_std_rad=math.pi / 6
    )
    down = np.array([0.0, 0.8, 0.6])
    known = Known(baseline_m=0.12, camera_height=GivenHeight(0.3, 0.05), down_camera=down, prior=prior)
    ask_of(service)(*PICTURES, known)
    (about,) = service.about
    sent = about.pop("prior")
    assert (about.pop("gravity") == down).all()
    assert about == {"map": "site", "baseline_m": 0.12, "camera_height_m": 0.3, "camera_height_std_m": 0.05}
    assert isinstance(sent, Prior)
    assert sent.position == PriorPosition(x=3.0, y=4.0, std_m=2.5)
    assert (sent.heading_deg, sent.heading_std_deg) == (pytest.approx(90.0), pytest.approx(30.0))


def test_a_track_carries_the_last_answer(answer_of: Callable[..., LocalizeAnswer]) -> None:
    first, second = answer_of(confidence=0.91), answer_of(confidence=0.92)
    service = Asked(first, second, UnreachableError("nobody"), second)
    ask = ask_of(service)
    ask(*PICTURES, Known(motion=Motion()))
    ask(*PICTURES, Known(motion=Motion(AHEAD)))
    with pytest.raises(UnreachableError):
        ask(*PICTURES, Known(motion=Motion(AHEAD)))
    ask(*PICTURES, Known(motion=Motion()))
    befores, motions = zip(*service.tracks, strict=True)
    assert befores == (None, first, second, second)
    assert [T is not None for T in motions] == [False, True, True, False]


@pytest.mark.parametrize(
    ("std", "sent"),
    [
        (None, None),
        (OdometryStd(0.22, math.radians(0.5)), (0.22, 0.5)),
        (OdometryStd(0.0, 0.0), (LEAST_ODOMETRY_STD_M, LEAST_ODOMETRY_STD_DEG)),  # the robot stands still
    ],
)
def test_the_noise_of_the_odometry_is_sent_within_the_contracts_bounds(
    answer_of: Callable[..., LocalizeAnswer], std: OdometryStd | None, sent: tuple[float, float] | None
) -> None:
    service = Asked(answer_of(), answer_of())
    ask = ask_of(service)
    ask(*PICTURES, Known(motion=Motion()))
    ask(*PICTURES, Known(motion=Motion(AHEAD, std)))
    found = service.about[-1]["track"].odometry_std
    assert (found is None) == (sent is None)
    if sent is not None:
        assert (found.position_m, found.angle_deg) == pytest.approx(sent)


def test_a_false_accept_rate_is_sent_if_it_is_given(answer_of: Callable[..., LocalizeAnswer]) -> None:
    service = Asked(answer_of())
    client: Any = SimpleNamespace(localize=service.localize)
    AskService(client, "site", 0.002)(*PICTURES, Known())
    assert service.about == [{"map": "site", "options": Options(false_accept_rate=0.002)}]


def test_a_query_that_stands_alone_ends_the_track(answer_of: Callable[..., LocalizeAnswer]) -> None:
    service = Asked(answer_of(), answer_of(), answer_of())
    ask = ask_of(service)
    for motion in (Motion(), None, Motion(AHEAD)):
        ask(*PICTURES, Known(motion=motion))
    assert "track" not in service.about.pop(1)
    assert service.tracks == [(None, None), (None, None)]


@pytest.mark.parametrize(("field", "kept"), [("track.belief", False), ("camera.fx", True)])
def test_a_refused_track_is_given_up(answer_of: Callable[..., LocalizeAnswer], field: str, kept: bool) -> None:
    """As after a restart of the service: its key is another one."""
    first = answer_of()
    service = Asked(first, RefusedError("no", field=field), answer_of())
    ask = ask_of(service)
    ask(*PICTURES, Known(motion=Motion()))
    with pytest.raises(RefusedError):
        ask(*PICTURES, Known(motion=Motion(AHEAD)))
    ask(*PICTURES, Known(motion=Motion(AHEAD)))
    before, T = service.tracks[-1]
    assert (before is first, T is not None) == (kept, kept)
