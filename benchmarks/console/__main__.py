"""``make test-console``: test the console in Debian's Chromium -> reports/console.json.

Use an idle machine. The processor draws WebGL here, and the service needs the processor too.
"""

import argparse
import sys
from collections.abc import Callable

from benchmarks.console.browser import (
    AXE,
    DESKTOP,
    PHONE,
    browsing,
    bundle_kb,
    click_sample,
    open_console,
    open_page,
    serious,
    why_not,
)
from benchmarks.console.flows import flow_rows
from benchmarks.console.served import demo, serving
from benchmarks.console.times import answer_rows, frame_rows
from benchmarks.report import Report
from service.console.page import STATIC

MOST_KB = 1000.0
PARTS = ("flows", "size", "axe", "answer", "frames")


def axe_rows(report: Report, browser: object, url: str) -> None:
    """Add the number of serious or critical findings of axe: desktop and phone, light and dark, before and after an answer.

    Args:
        report: collects the rows.
        browser: browser of Playwright.
        url: address of the service.
    """
    if not AXE.exists():
        report.row("console.axe_serious", None, "findings", bar=0, better="lower", why="axe-core not found: npm ci")
        return
    found: list[str] = []
    for size in (DESKTOP, PHONE):
        for dark in (False, True):
            page = open_page(browser, size=size, dark=dark)
            open_console(page, url)
            found += serious(page)
            click_sample(page, "01")
            found += serious(page)
            page.context.close()
    report.row("console.axe_serious", float(len(found)), "findings", bar=0, better="lower", n=8)
    if found:
        report.notes["axe"] = found


def main() -> int:
    """Measure and write the report; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="parts")
    only = parser.parse_args().only
    if why := why_not():
        sys.stderr.write(f"the console cannot be tested: {why}\n")
        return 1
    report = Report(
        "console", "make test-console" if only == PARTS else f"make test-console ARGS='--only {' '.join(only)}'"
    )
    report.keep_others()
    if "flows" in only:
        flow_rows(report)
    if "size" in only:
        report.row("console.bundle_kb_compressed", bundle_kb(STATIC), "kB", bar=MOST_KB, better="lower")
    in_browser: dict[str, Callable[..., None]] = {"axe": axe_rows, "answer": answer_rows, "frames": frame_rows}
    made = demo()
    with serving(made.bundle, "--samples", made.samples) as (url, _), browsing() as browser:
        for name, rows in in_browser.items():
            if name in only:
                rows(report, browser, url)
                report.write()  # write now: a later failure keeps these rows
    report.write()
    return 0


if __name__ == "__main__":
    sys.exit(main())
