from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.native import against_numpy
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle
from service.registration.surfel_map import SurfelMap
from service.retrieval.query import Query


def test_numpy_says_what_the_compiled_code_says_and_both_are_timed(
    bundle_path: Path, pictures: Any, parts_of: Callable[..., dict[str, bytes]]
) -> None:
    localizer, (rgb, depth_m, camera) = Localizer.open(MapBundle.open(bundle_path)), pictures
    query, cloud = Query(rgb=rgb, depth_m=depth_m, camera=camera), localizer.bundle.cloud
    assert isinstance(cloud, SurfelMap)
    found = against_numpy._of_imaging(query, localizer.bundle.grid, parts_of()["depth"])
    found |= against_numpy._of_registration(localizer, cloud, query)
    assert {name.partition(":")[0] for name in found} >= {
        "level.py",
        "resample.py",
        "points.py",
        "kernel.py",
        "rays.py",
    }
    assert all(min(seconds) > 0 for seconds in found.values())


def test_results_that_differ_are_an_error() -> None:
    one = np.zeros(100)
    against_numpy._require_same((one,), (one,))
    with pytest.raises(AssertionError, match=r"100\.0 % of the cells differ"):
        against_numpy._require_same((one,), (one + 1,))
