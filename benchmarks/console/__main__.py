"""``make test-console``: the console in Debian's Chromium -> reports/console.json.

Run it on an idle machine: WebGL is drawn by the processor here, which the service works on, too.
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
    """What axe finds serious or critical, on a desk and on a phone, light and dark, before and after an answer."""
    if not AXE.exists():
        report.row("console.axe_serious", None, "findings", bar=0, better="lower", why="axe-core is not there: npm ci")
        return
    found: list[str] = []
    for size in (DESKTOP, PHONE):
        for dark in (False, True):
            page = open_page(browser, size=size, dark=dark)  # type: ignore[arg-type]
            open_console(page, url)
            found += serious(page)
            click_sample(page, "01")
            found += serious(page)
            page.context.close()
    report.row("console.axe_serious", float(len(found)), "findings", bar=0, better="lower", n=8)
    if found:
        report.notes["axe"] = found


def main() -> int:
    """Measure, and write the report."""
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
                report.write()  # what was measured stays, whatever comes after
    report.write()
    return 0


if __name__ == "__main__":
    sys.exit(main())
