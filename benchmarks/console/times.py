"""Rows of time: from the click on a sample to its answer, and the frame rate of a large cloud."""

import struct
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks.console.browser import ANSWER_MS, READY_MS, WEB, open_console, open_page
from benchmarks.report import ROOT, Report

CLICKS, MOST_ANSWER_S = 20, 1.5
SIZE, POINTS, LEAST_RATIO = (1280, 800), 2_000_000, 0.8
_WARM_MS, _ROUNDS = 3000, 3
#: Number of frames to count, and the time limit in milliseconds. In software, a frame of two million points takes
#: seconds.
_FRAMES, _MOST_MS = 30, 30_000
BARE = ROOT / "tests" / "console" / "bare"
_HALF_M = 200.0

#: Time from the click's time stamp until two frames after the new answer is in the page. The browser has painted it by
#: then.
_WATCH = """() => {
  window.timed = {};
  document.addEventListener('click', event => { window.timed = {clicked: event.timeStamp}; }, true);
  new MutationObserver(changes => {
    const isNew = changes.some(change => [...change.addedNodes].some(node => node.classList?.contains('verdict')));
    if (!isNew || window.timed.clicked === undefined) return;
    const {clicked} = window.timed;
    requestAnimationFrame(() => requestAnimationFrame(() => { window.timed = {seconds: (performance.now() - clicked) / 1000}; }));
  }).observe(document.body, {subtree: true, childList: true});
}"""
#: Move the map by keys as fast as it draws.
_MOVE = """() => {
  const map = document.querySelector('.map-surface');
  let turn = 0;
  const move = () => {
    map.dispatchEvent(new KeyboardEvent('keydown', {key: turn++ % 8 < 4 ? 'ArrowLeft' : 'ArrowRight', cancelable: true}));
    requestAnimationFrame(move);
  };
  move();
}"""

#: Time between drawn frames. The first frame is warm-up.
_COUNT = """([most, mostMs]) => new Promise(resolve => {
  const began = performance.now();
  let last = null, first = null, changes = 0, changed = 0;
  const look = () => {
    const now = performance.now(), drawn = %s;
    if (last !== null && drawn > last) {
      if (first === null) first = now; else { changes += drawn - last; changed = now; }
    }
    last = drawn;
    if (changes > 0 && (changes >= most || now - began > mostMs)) resolve([changes, (changed - first) / 1000]);
    else requestAnimationFrame(look);
  };
  look();
})"""


def answer_rows(report: Report, browser: Any, url: str) -> None:
    """Add the time from click to answer; the map rests before each click.

    Args:
        report: collects the rows.
        browser: browser of Playwright.
        url: address of the service.
    """
    page = open_page(browser, size=SIZE)
    open_console(page, url)
    samples = page.eval_on_selector_all("[data-sample]", "cards => cards.map(card => card.dataset.sample)")
    page.wait_for_timeout(_WARM_MS)
    page.evaluate(_WATCH)
    taken = []
    for k in range(CLICKS):
        page.click(f"[data-sample='{samples[k % len(samples)]}']")
        page.wait_for_function("() => window.timed.seconds !== undefined", timeout=ANSWER_MS)
        taken.append(float(page.evaluate("window.timed.seconds")))
        page.wait_for_timeout(_WARM_MS / 2)
    page.context.close()
    report.row("console.click_to_answer_s", median(taken), "s", bar=MOST_ANSWER_S, better="lower", n=CLICKS)
    report.notes["click_to_answer_s"] = [round(each, 3) for each in taken]


def frame_rows(report: Report, browser: Any, url: str) -> None:
    """Add frame rates: the console with every point and the bare library in turns, then the console with its defaults.

    Args:
        report: collects the rows.
        browser: browser of Playwright.
        url: address of the service.
    """
    cloud = cloud_of(POINTS)

    def console(*, every_point: bool) -> float:
        page = open_page(browser, size=SIZE)
        _serve_cloud(page, cloud)
        open_console(page, url)
        if every_point:
            page.click("[aria-label^='Draw every point']")
        page.evaluate(_MOVE)
        return _rate(page, "Number(document.querySelector('.map-surface').dataset.frames)")

    def bare() -> float:
        page = open_page(browser, size=SIZE)
        _serve_cloud(page, cloud)
        page.route("**/bare/**", lambda route: route.fulfill(path=_bare_file(route.request.url)))
        page.goto(f"{url}/bare/?size={width}x{height}&half={_HALF_M:g}")
        page.wait_for_function("() => window.framesDrawn?.() > 0", timeout=READY_MS)
        return _rate(page, "window.framesDrawn()")

    width, height = _map_size(browser, url)
    pairs = [(console(every_point=True), bare()) for _ in range(_ROUNDS)]
    ours, theirs = (median(each) for each in zip(*pairs, strict=True))
    ratio = median(ours / theirs for ours, theirs in pairs)
    report.row("console.frames_per_s_2m_points", ours, "1/s", bar=LEAST_RATIO * theirs, n=_ROUNDS)
    report.row("console.frames_per_s_2m_points.bare_library", theirs, "1/s", n=_ROUNDS)
    report.row("console.frames_per_s_2m_points.over_bare", ratio, "ratio", bar=LEAST_RATIO, n=_ROUNDS)
    report.row("console.frames_per_s_2m_points.while_moving", console(every_point=False), "1/s", n=1)


def cloud_of(points: int) -> bytes:
    """Make a cloud of the size of a city in the cloud's format: blocks of walls on flat ground.

    Args:
        points: number of points.
    """
    rng = np.random.default_rng(0)
    records = np.zeros(points, np.dtype([("xyz", "<u2", (3,)), ("upright", "<u2")]))
    records["xyz"] = rng.integers(0, 65536, (points, 3))
    on_ground = rng.random(points) < 0.5
    records["xyz"][on_ground, 2] = 0
    walls = np.flatnonzero(~on_ground)
    records["xyz"][walls, 0] = (records["xyz"][walls, 0] // 4096) * 4096
    records["upright"][walls] = 65535
    step = 2 * _HALF_M / 65535
    return b"SFC1" + struct.pack("<I6d", points, -_HALF_M, -_HALF_M, 0, step, step, 30 / 65535) + records.tobytes()


def _serve_cloud(page: Any, cloud: bytes) -> None:
    page.route("**/v1/maps/*/cloud*", lambda route: route.fulfill(body=cloud, content_type="application/octet-stream"))


def _map_size(browser: Any, url: str) -> tuple[int, int]:
    page = open_page(browser, size=SIZE)
    open_console(page, url)
    width, height = page.evaluate(
        "(map => [map.clientWidth, map.clientHeight])(document.querySelector('.map-surface'))"
    )
    page.context.close()
    return width, height


def _bare_file(url: str) -> Path:
    name = url.split("/bare/", 1)[1].split("?")[0]
    return WEB / "node_modules" / name if name.startswith("three/") else BARE / (name or "index.html")


def _rate(page: Any, frames: str) -> float:
    """Return frames per second between the first and the last counted frame, and close the page."""
    counted, seconds = page.evaluate(_COUNT % frames, [_FRAMES, _MOST_MS])
    page.context.close()
    return float(counted / seconds)
