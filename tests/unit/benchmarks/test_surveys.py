"""A map of a single scan, and the queries near it."""

import numpy as np
import pytest

from benchmarks.surveys import NEAR_M, OneScan


@pytest.fixture(scope="module")
def single(small_dataset):
    return OneScan(small_dataset.folder, 3)


def test_the_survey_is_the_scan(single, small_dataset):
    np.testing.assert_array_equal(single.survey_poses(), small_dataset.survey_poses()[3:4])
    np.testing.assert_array_equal(single.scan(0), small_dataset.scan(3))


def test_only_queries_near_the_scan_are_asked(single, small_dataset):
    (name, *_) = small_dataset.query_sets(with_truth=True)
    scan = small_dataset.survey_poses()[3, :2, 3]

    def away(frames):
        return [float(np.hypot(*(frame.T_map_camera[:2, 3] - scan))) for frame in frames]

    near, every = away(single.queries(name)), away(small_dataset.queries(name))
    assert sorted(near) == sorted(each for each in every if each <= NEAR_M)
    assert near
    assert max(every) > NEAR_M
