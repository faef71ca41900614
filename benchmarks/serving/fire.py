"""Overload, map swaps and shutdown while clients send requests."""

import itertools
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

import httpx
import numpy as np

from benchmarks.report import Report
from benchmarks.serving.loads import closed, load, opened
from benchmarks.serving.machines import Server
from benchmarks.serving.ratios import MANY, Site
from model_training.loadtest.payloads import Payload
from service.maps.manifest import FILE as MANIFEST_FILE
from service.maps.manifest import read_manifest

SWAPS = 50


def overload_rows(report: Report, site: Site, *, seconds: float, rounds: int, core: int | None) -> None:
    """Add rows of full requests at five times the saturating rate: goodput, speed of refusals, and health checks.

    Args:
        report: collects the rows.
        site: map and queries.
        seconds: duration of each round.
        rounds: number of rounds.
        core: core of the server; None for all.
    """
    sent = site.payloads(refine=True)
    threads: dict[str, Any] = {} if core is None else {"threads": 1}
    peaks, founds, health_ms = [], [], []
    with Server(site.bundle, core=core, **threads) as server:
        for _ in range(rounds):  # each round has its own peak: a machine's speed drifts
            peak, _ = load(server, "rest", sent, closed(10, MANY))
            with _health(server.url) as waited_ms:
                found, _ = load(server, "rest", sent, opened(seconds, 5 * peak.answered_per_s))
            peaks.append(peak.answered_per_s)
            founds.append(found)
            health_ms.append(float(np.percentile(waited_ms, 99)))
    refused = [found.refused_ms["p99"] for found in founds if "p99" in found.refused_ms]
    failed = sum(count for found in founds for code, count in found.errors.items() if code != "503")
    good = [found.answered_per_s / peak for found, peak in zip(founds, peaks, strict=True)]
    told = ", ".join(f"{low:.2f}" for low in sorted(good))
    report.row("overload.peak_per_s", median(peaks), "1/s", n=rounds)
    report.row("overload.offered_per_s", median(found.offered_per_s for found in founds), "1/s", n=rounds)
    report.row("overload.goodput_over_peak", median(good), "ratio", bar=0.95, n=rounds)
    report.notes["overload"] = f"Goodput over peak of each round: {told}."
    report.row(
        "overload.refusal_p99_ms",
        median(refused) if refused else None,
        "ms",
        bar=50,
        better="lower",
        n=rounds,
        why=f"{failed} failed instead of a refusal" if failed else None,
    )
    report.row("overload.generator_late_p99_ms", median(found.late_ms["p99"] for found in founds), "ms", n=rounds)
    report.row("overload.health_p99_ms", median(health_ms), "ms", bar=50, better="lower", n=rounds)


@contextmanager
def _health(url: str) -> Iterator[list[float]]:
    """Poll both health endpoints twenty times a second on separate connections; a failure counts as 10 s."""
    waited_ms: list[float] = []
    over = threading.Event()

    def ask() -> None:
        with httpx.Client(base_url=url, timeout=10) as client:
            for path in itertools.cycle(("/livez", "/readyz")):
                if over.is_set():
                    return
                began = time.perf_counter()
                try:
                    good = client.get(path).status_code == 200
                except httpx.HTTPError:
                    good = False
                waited_ms.append(1e3 * (time.perf_counter() - began) if good else 10_000.0)
                over.wait(0.05)

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        yield waited_ms
    finally:
        over.set()
        thread.join()


def swap_rows(report: Report, site: Site, *, core: int | None) -> None:
    """Add rows of fifty map versions, one after the other, each mounted on SIGHUP while four clients send.

    Args:
        report: collects the rows.
        site: map and queries.
        core: core of the server; None for all.
    """
    sent = site.payloads(refine=True)
    with tempfile.TemporaryDirectory(dir=site.bundle.parent) as name:
        folder = Path(name)
        newest, _ = _version_of(site.bundle, folder, 0)
        with Server(folder, core=core) as server, asking(server.url, sent[:4]) as (answers, failed):
            for number in range(1, SWAPS + 1):
                oldest = newest
                newest, version = _version_of(site.bundle, folder, number)
                server.process.send_signal(signal.SIGHUP)
                _until_served(server.url, version)
                shutil.rmtree(oldest)
    versions = set(answers)
    report.row("swap.versions_that_answered", len(versions), "count")
    report.row(
        "swap.failed_requests",
        len(failed),
        "count",
        bar=0,
        better="lower",
        n=len(answers) + len(failed),
        why=f"first: {failed[0]}" if failed else None,
    )


def _version_of(bundle: Path, folder: Path, number: int) -> tuple[Path, str]:
    """Write the same map as another version by hard links with its own manifest."""
    part, out = folder / f".part-{number}", folder / f"v{number}"
    shutil.copytree(bundle, part, copy_function=lambda a, b: Path(b).hardlink_to(a))
    manifest = (
        read_manifest(part).model_copy(update={"made_at": datetime.now(UTC), "licence": f"bench {number}"}).stamped()
    )
    (part / MANIFEST_FILE).unlink()  # the file is a link: keep the original
    (part / MANIFEST_FILE).write_bytes(manifest.to_bytes())
    part.rename(out)
    return out, manifest.version


def _until_served(url: str, version: str) -> None:
    until = time.monotonic() + 120
    while httpx.get(f"{url}/v1/maps", timeout=60).json()["maps"][0]["version"] != version:
        if time.monotonic() > until:
            raise RuntimeError(f"version {version} is not served")
        time.sleep(0.02)


@contextmanager
def asking(url: str, sent: list[Payload]) -> Iterator[tuple[list[str], list[str]]]:
    """Run one client per request that sends it repeatedly; yield the versions that answered, and the failures.

    Args:
        url: address of the service.
        sent: requests, one per client.
    """
    answers, failed, stop = list[str](), list[str](), threading.Event()

    def ask(payload: Payload) -> None:
        with httpx.Client(base_url=url, timeout=60, headers={"Content-Type": payload.content_type}) as client:
            while not stop.is_set():
                try:
                    found = client.post("/v1/localize", content=payload.body)
                except httpx.HTTPError as error:
                    failed.append(repr(error))
                    continue
                if found.status_code == 200:
                    answers.append(found.json()["map"]["version"])
                else:
                    failed.append(f"{found.status_code} {found.text[:200]}")

    clients = [threading.Thread(target=ask, args=(each,)) for each in sent]
    for client in clients:
        client.start()
    try:
        yield answers, failed
    finally:
        stop.set()
        for client in clients:
            client.join()


def sigterm_rows(report: Report, site: Site, *, core: int | None) -> None:
    """Add rows of a shutdown: clients stop when readiness ends, as behind a load balancer; every earlier request must succeed.

    Args:
        report: collects the rows.
        site: map and queries.
        core: core of the server; None for all.
    """
    with Server(site.bundle, core=core, drain_s=3) as server:
        with asking(server.url, site.payloads(refine=True)[:4]) as (answers, failed):
            time.sleep(3)
            server.process.send_signal(signal.SIGTERM)
            with httpx.Client(base_url=server.url, timeout=10) as watcher:
                while watcher.get("/readyz").status_code == 200:
                    time.sleep(0.05)
        code = server.process.wait(60)
    report.row(
        "sigterm.failed_requests",
        len(failed),
        "count",
        bar=0,
        better="lower",
        n=len(answers) + len(failed),
        why=f"first: {failed[0]}" if failed else None,
    )
    report.row("sigterm.exit_code", code, "count", bar=0, better="lower")
