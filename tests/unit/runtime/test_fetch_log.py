"""The log lines of a fetch."""

import logging

import pytest

from service.runtime.fetch_log import FetchLog


def test_a_fetch_is_logged_at_its_begin_every_few_seconds_and_at_its_end(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 100.0
    monkeypatch.setattr("service.runtime.fetch_log.time.monotonic", lambda: now_s)
    with caplog.at_level(logging.INFO, "streetfix.maps"):
        count = FetchLog("tile", "s3://bucket/town/tiles/a", 50_000_000)
        for later_s, size in ((4, 10_000_000), (4, 10_000_000), (4, 10_000_000), (9, 5_000_000), (2, 15_000_000)):
            now_s += later_s
            count(size)
    assert caplog.messages == [
        "tile_fetching url=s3://bucket/town/tiles/a mb=0.0 of=50.0",
        "tile_fetching url=s3://bucket/town/tiles/a mb=30.0 of=50.0",
        "tile_fetched url=s3://bucket/town/tiles/a mb=50.0 s=23.0",
    ]
