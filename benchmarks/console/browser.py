"""Debian's Chromium through Playwright, with the console's page."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.report import ROOT

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

WEB = ROOT / "service" / "console" / "web"
AXE = WEB / "node_modules" / "axe-core" / "axe.min.js"
#: WebGL in software, and no background requests to the browser's vendor.
FLAGS = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-background-networking"]
READY_MS, ANSWER_MS = 120_000, 60_000
DESKTOP, LAPTOP, PHONE = (1440, 900), (1024, 768), (390, 844)


def chromium() -> str | None:
    """Return the path of Chromium, or None."""
    return shutil.which("chromium") or shutil.which("chromium-browser")


def why_not() -> str:
    """Return why no browser is available; empty if one is."""
    if chromium() is None:
        return "chromium not found: apt-get install chromium"
    try:
        import playwright.sync_api  # noqa: F401
    except ImportError:
        return "playwright not found: make test-console installs it"
    return ""


@contextmanager
def browsing() -> Iterator["Browser"]:
    """Provide a browser for as long as the block lasts."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=FLAGS)
        try:
            yield browser
        finally:
            browser.close()


def open_page(browser: "Browser", *, size: tuple[int, int] = DESKTOP, dark: bool = False, **context: Any) -> "Page":
    """Open an empty page in its own context; keep its errors in ``page.mishaps``.

    Args:
        browser: browser of Playwright.
        size: width and height, CSS pixels.
        dark: whether to request the dark colour scheme.
        **context: further options of the browser context.
    """
    page = browser.new_page(
        viewport={"width": size[0], "height": size[1]}, color_scheme="dark" if dark else "light", **context
    )
    mishaps: list[str] = []
    page.on("pageerror", lambda error: mishaps.append(f"error: {error}"))
    page.on(
        "console", lambda message: mishaps.append(message.text) if "Content Security Policy" in message.text else None
    )
    page.mishaps = mishaps
    return page


def open_console(page: "Page", url: str) -> None:
    """Open the console and wait until the map is drawn.

    Args:
        page: page to use.
        url: address of the service.
    """
    page.goto(f"{url}/console/")
    page.wait_for_selector("[data-ready]", timeout=READY_MS)


def click_sample(page: "Page", name: str) -> None:
    """Click a sample and wait for its answer.

    Args:
        page: page with the console.
        name: name of the sample.
    """
    page.evaluate("document.querySelector('.verdict')?.remove()")
    page.click(f"[data-sample='{name}']")
    page.wait_for_selector(".verdict", timeout=ANSWER_MS)


def serious(page: "Page") -> list[str]:
    """Return the serious or critical findings of axe.

    Args:
        page: page with the console.
    """
    page.evaluate(AXE.read_text())  # the page's content security policy forbids a script element
    found = page.evaluate("axe.run(document, {resultTypes: ['violations']})")
    return [
        f"{each['id']}: {node['target']} {node['failureSummary']}"
        for each in found["violations"]
        if each["impact"] in ("serious", "critical")
        for node in each["nodes"]
    ]


def bundle_kb(static: Path) -> float:
    """Return the compressed size of all files of the page, in kB of 1000 bytes.

    Args:
        static: folder of the built page.
    """
    from service.console.page import built_files

    return sum(len(file.compressed) for file in built_files(static).values()) / 1000
