"""The log lines of a fetch."""

import logging

import pytest

from service.errors import BundleError
from service.runtime.fetch_log import FetchLog
from service.runtime.settings import Settings

URL = "s3://bucket/town"


def test_a_fetch_is_logged_at_its_begin_every_few_seconds_and_at_its_end(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 100.0
    monkeypatch.setattr("service.runtime.fetch_log.time.monotonic", lambda: now_s)
    with caplog.at_level(logging.INFO, "streetfix.maps"), FetchLog("tile", URL, 50_000_000) as count:
        for later_s, size in ((4, 10_000_000), (4, 10_000_000), (4, 10_000_000), (9, 5_000_000), (2, 15_000_000)):
            now_s += later_s
            count(size)
    assert caplog.messages == [
        f"tile_fetching url={URL} mb=0.0 of=50.0",
        f"tile_fetching url={URL} mb=30.0 of=50.0",
        f"tile_fetched url={URL} mb=50.0 s=23.0",
    ]


def test_a_map_is_seen_at_the_default_level(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.runtime.fetch_log.time.monotonic", lambda: 100.0)
    level = Settings.model_fields["log_level"].default.upper()
    with caplog.at_level(level, "streetfix.maps"), FetchLog("map", URL, 0):
        pass
    assert caplog.messages == [f"map_fetching url={URL} mb=0.0 of=0.0", f"map_fetched url={URL} mb=0.0 s=0.0"]


def test_a_failed_fetch_has_no_line_about_its_end(caplog: pytest.LogCaptureFixture) -> None:
    def fail() -> None:
        with FetchLog("map", URL, 5_000_000) as count:
            count(5_000_000)
            raise BundleError("the hash does not match the manifest")

    with pytest.raises(BundleError):
        fail()
    assert caplog.messages == [f"map_fetching url={URL} mb=0.0 of=5.0"]


def test_a_finished_fetch_is_told_with_its_bytes_and_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, told = 100.0, list[tuple[str, int, float]]()
    monkeypatch.setattr("service.runtime.fetch_log.time.monotonic", lambda: now_s)
    with FetchLog("tile", URL, 5_000, on_fetched=lambda *each: told.append(each)) as count:
        now_s += 3.0
        count(2_000)
        count(3_000)
    assert told == [("tile", 5_000, 3.0)]
    with pytest.raises(BundleError), FetchLog("tile", URL, 5_000, on_fetched=lambda *each: told.append(each)):
        raise BundleError("damaged")
    assert len(told) == 1
