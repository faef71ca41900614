"""A short fuzz run over every parser of untrusted input. ``make fuzz`` is the long run with coverage guidance."""

import random
from pathlib import Path

import pytest

from benchmarks.fuzz.targets import survives, targets

INPUTS = 4000
NAMES = (
    "http",
    "multipart",
    "request_json",
    "sequence_json",
    "oscp_json",
    "grpc",
    "depth",
    "depth_png_rows",
    "colour",
    "bundle",
    "pictures",
)


@pytest.fixture(scope="module")
def known(bundle_path: Path, tmp_path_factory: pytest.TempPathFactory):
    return targets(bundle_path, tmp_path_factory.mktemp("fuzz"))


def changed(data: bytes, chance: random.Random) -> bytes:
    """Return bytes with flips, cuts, duplications and overwrites at some positions."""
    found = bytearray(data)
    for _ in range(chance.randint(1, 6)):
        at, length = chance.randrange(len(found) + 1), chance.randint(1, 16)
        match chance.randrange(5):
            case 0 if found:
                found[at % len(found)] ^= 1 << chance.randrange(8)
            case 1:
                del found[at : at + length]
            case 2:
                found[at:at] = found[at : at + length] * chance.randint(1, 40)
            case 3:
                found[at : at + length] = chance.randbytes(length)
            case _:
                found[at : at + length] = bytes([chance.choice((0, 255, 48, 123, 91, 34))]) * length
    return bytes(found)


def test_there_is_a_run_of_every_target(known):
    assert set(known) == set(NAMES)
    assert sum(each.share for each in known.values()) == pytest.approx(1)


@pytest.mark.parametrize("name", NAMES)
def test_good_bytes_are_taken(known, name):
    for seed in known[name].seeds:
        known[name].take(seed)


@pytest.mark.parametrize("name", NAMES)
def test_any_bytes_are_taken_or_refused_with_an_error_of_ours(known, name):
    target, chance = known[name], random.Random(name)  # noqa: S311  # the same run every time
    for number in range(max(20, int(INPUTS * target.share))):
        data = changed(chance.choice(target.seeds), chance)
        try:
            survives(target.take, data)
        except Exception as error:
            pytest.fail(f"{name}, input {number}: {error!r} of {data!r}")
