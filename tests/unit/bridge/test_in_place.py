from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.bridge.in_place import InPlace
from service.bridge.known import Known
from service.errors import RequestError
from service.geometry.camera import PinholeCamera
from service.imaging.level import GivenHeight
from service.retrieval.prior import Prior
from service.retrieval.query import Query


def queries_of(localize: InPlace, monkeypatch: pytest.MonkeyPatch) -> list[Query]:
    """Return a list that receives each query before it is answered."""
    asked, answered = list[Query](), localize._localizer.localize

    def keep(query: Query) -> Any:
        asked.append(query)
        return answered(query)

    monkeypatch.setattr(localize._localizer, "localize", keep)
    return asked


@pytest.mark.parametrize(
    ("camera", "field"),
    [
        (PinholeCamera(64, 48, 1e-9, 32.0, 31.5, 23.5), "camera.fx"),
        (PinholeCamera(64, 48, 32.0, 32.0, float("nan"), 23.5), "camera.cx"),
    ],
)
def test_a_camera_beyond_the_contracts_bounds_is_refused_without_a_service_too(
    bundle_path: Path, pictures: Any, camera: PinholeCamera, field: str
) -> None:
    rgb, depth_m, good = pictures
    localize = InPlace(bundle_path)
    assert localize(rgb, depth_m, good, Known()).map.name == "tiny"
    with pytest.raises(RequestError) as caught:
        localize(rgb, depth_m, camera, Known())
    assert caught.value.field == field


def test_a_camera_height_that_is_given_counts_without_a_service_too(bundle_path: Path, pictures: Any) -> None:
    for given, origin in ((None, "estimated"), (GivenHeight(1.52, 0.02), "given")):
        answer = InPlace(bundle_path)(*(*pictures, Known(camera_height=given)))
        assert answer.camera_height is not None
        assert (answer.camera_height.origin, round(answer.camera_height.height_m, 1)) == (origin, 1.5)


@pytest.mark.parametrize(("rate", "named"), [(None, (0.01, False)), (0.002, (0.002, True))])
def test_a_false_accept_rate_counts_without_a_service_too(
    bundle_path: Path, pictures: Any, monkeypatch: pytest.MonkeyPatch, rate: float | None, named: tuple[float, bool]
) -> None:
    localize = InPlace(bundle_path, rate)
    asked = queries_of(localize, monkeypatch)
    localize(*(*pictures, Known()))
    (query,) = asked
    assert (query.false_accept_rate, query.rate_is_named) == named


def test_gravity_and_prior_reach_the_query_without_a_service_too(
    bundle_path: Path, pictures: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    localize = InPlace(bundle_path)
    asked = queries_of(localize, monkeypatch)
    known = Known(down_camera=np.array([0.0, 1.0, 0.0]), prior=Prior(position_m=np.array([20.0, 100.0])))
    localize(*(*pictures, known))
    (query,) = asked
    assert (query.down_camera is known.down_camera, query.prior is known.prior) == (True, True)


def test_a_lens_is_rectified_without_a_service_too(bundle_path: Path, pictures: Any, pictures_through: Any) -> None:
    lens = PinholeCamera(128, 96, 80.0, 80.0, 63.5, 47.5, (0.01, 0.0, 0.0, 0.0), "kannala_brandt")
    localize = InPlace(bundle_path)
    rgb, depth_m = pictures_through(lens)
    plain, bent = localize(*(*pictures, Known())), localize(rgb, depth_m, lens, Known())
    assert bent.pose is not None
    assert plain.pose is not None
    for axis in "xyz":
        assert getattr(bent.pose.position, axis) == pytest.approx(getattr(plain.pose.position, axis), abs=0.1)


def test_a_lens_beyond_the_contracts_bounds_is_refused_without_a_service_too(bundle_path: Path, pictures: Any) -> None:
    rgb, depth_m, camera = pictures
    for distortion, why in (
        ((0.1, 0.0), "does not have 2"),
        ((0.0, 0.0, 9.0, 0.0), "p1 = 9"),
        ((-0.3, 0.0, 0.0, 0.0), "stops"),
    ):
        with pytest.raises(RequestError, match=why) as caught:
            InPlace(bundle_path)(rgb, depth_m, replace(camera, distortion=distortion), Known())
        assert caught.value.field == "camera.distortion"


def test_a_baseline_reaches_the_query_without_a_service_too(
    bundle_path: Path, pictures: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    localize = InPlace(bundle_path)
    asked = queries_of(localize, monkeypatch)
    for known in (Known(), Known(baseline_m=0.12)):
        localize(*(*pictures, known))
    assert [query.baseline_m for query in asked] == [None, 0.12]
