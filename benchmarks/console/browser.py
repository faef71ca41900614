"""Debian's Chromium through Playwright, and the console's page in it."""

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
#: WebGL in software, and nothing that a browser asks its maker for.
FLAGS = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-background-networking"]
READY_MS, ANSWER_MS = 120_000, 60_000
DESKTOP, LAPTOP, PHONE = (1440, 900), (1024, 768), (390, 844)


def chromium() -> str | None:
    """Where it is installed."""
    return shutil.which("chromium") or shutil.which("chromium-browser")


def why_not() -> str:
    """Why there is no browser to test in; empty where there is one."""
    if chromium() is None:
        return "there is no chromium: apt-get install chromium"
    try:
        import playwright.sync_api  # noqa: F401
    except ImportError:
        return "there is no playwright: make test-console installs it"
    return ""


@contextmanager
def browsing() -> Iterator["Browser"]:
    """A browser for as long as the block lasts."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=FLAGS)
        try:
            yield browser
        finally:
            browser.close()


def open_page(browser: "Browser", *, size: tuple[int, int] = DESKTOP, dark: bool = False, **context: Any) -> "Page":
    """An empty page, of a context of its own; what goes wrong in it is kept in ``page.mishaps``."""
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
    """Until the map is drawn."""
    page.goto(f"{url}/console/")
    page.wait_for_selector("[data-ready]", timeout=READY_MS)


def click_sample(page: "Page", name: str) -> None:
    """Until its answer stands on the page."""
    page.evaluate("document.querySelector('.verdict')?.remove()")
    page.click(f"[data-sample='{name}']")
    page.wait_for_selector(".verdict", timeout=ANSWER_MS)


def serious(page: "Page") -> list[str]:
    """What axe finds serious or critical."""
    page.evaluate(AXE.read_text())  # a script element of it would be against the page's own policy
    found = page.evaluate("axe.run(document, {resultTypes: ['violations']})")
    return [
        f"{each['id']}: {node['target']} {node['failureSummary']}"
        for each in found["violations"] if each["impact"] in ("serious", "critical") for node in each["nodes"]
    ]  # fmt: skip


def bundle_kb(static: Path) -> float:
    """Of all files of the page, compressed, 1000 bytes each."""
    from service.console.page import built_files

    return sum(len(file.compressed) for file in built_files(static).values()) / 1000
