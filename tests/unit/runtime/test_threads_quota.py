import os

import pytest

from service.runtime.threads import cpu_quota, pools, usable_cores


def group(tmp_path, files):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({"cpu.max": "150000 100000\n"}, 1.5),
        ({"cpu.max": "max 100000\n"}, None),
        ({}, None),
        ({"cpu.max": "nonsense"}, None),
        ({"cpu/cpu.cfs_quota_us": "50000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 0.5),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, None),
        ({"cpu.max": "100000 0"}, None),
    ],
)
def test_a_containers_quota_is_read_of_either_version(tmp_path, files, expected):
    assert cpu_quota(group(tmp_path, files)) == expected


def test_no_more_cores_are_used_than_the_quota_pays_for(tmp_path):
    own = len(os.sched_getaffinity(0))
    assert usable_cores(group(tmp_path / "a", {"cpu.max": "10000 100000"})) == 1
    assert usable_cores(group(tmp_path / "b", {"cpu.max": "110000 100000"})) == min(own, 2)
    assert usable_cores(group(tmp_path / "c", {"cpu.max": "9900000 100000"})) == own


def test_the_pools_are_listed_by_name():
    assert set(pools()) == {"opencv", "openmp", "onnxruntime"}
    assert all(count >= 1 for count in pools().values())
