"""A real browser, the demo's map, the real service; pictures of every flow are kept for people to look at."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.console import browser as chromium
from benchmarks.console.browser import browsing, open_page
from benchmarks.console.served import Demo, demo, serving
from benchmarks.report import ROOT

SHOTS = Path(os.environ.get("CONSOLE_SHOTS", ROOT / "out" / "console"))


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    if why := chromium.why_not():
        pytest.skip(why)
    with browsing() as found:
        yield found


@pytest.fixture(scope="session")
def demo_map(browser: Any) -> Demo:
    return demo()


@pytest.fixture(scope="session")
def url(demo_map: Demo) -> Iterator[str]:
    """A service without keys, for flows that change nothing in it."""
    with serving(demo_map.bundle, "--samples", demo_map.samples) as (address, _):
        yield address


@pytest.fixture
def page_of(browser: Any) -> Iterator[Callable[..., Any]]:
    """Pages that must not have run into errors, nor against their own policy, when the test ends."""
    pages: list[Any] = []

    def opened(**options: Any) -> Any:
        pages.append(open_page(browser, **options))
        return pages[-1]

    yield opened
    mishaps = [mishap for page in pages for mishap in page.mishaps]
    for page in pages:
        page.context.close()
    assert mishaps == []


@pytest.fixture
def shoot() -> Callable[[Any, str], None]:
    """Keep a picture of a page, once its map rests."""

    def shot(page: Any, name: str) -> None:
        SHOTS.mkdir(parents=True, exist_ok=True)
        page.wait_for_timeout(1500)
        page.screenshot(path=SHOTS / f"{name}.png")

    return shot
