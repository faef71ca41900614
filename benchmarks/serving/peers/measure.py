"""Rows of the same pipeline in other servers, each in turn on the same core under the same load, against Streetfix's REST."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from statistics import median
from typing import Any

import numpy as np

from benchmarks.report import Report
from benchmarks.serving.loads import closed, load, opened
from benchmarks.serving.machines import Server
from benchmarks.serving.peers.hosts import Host, ask
from benchmarks.serving.peers.venvs import REQUIREMENTS, PeerError, python_of
from benchmarks.serving.ratios import MANY, Site
from model_training.loadtest.payloads import Payload
from service.geometry.rigid import SAME_M

PEERS = tuple(REQUIREMENTS)
OWN = "streetfix"
TITLES = {"litserve": "LitServe", "bentoml": "BentoML", "mlserver": "MLServer", "ray": "Ray Serve", OWN: "Streetfix"}
KINDS = ("retrieval", "full")
BARS = {"retrieval": 1.2, "full": 1.02}
#: Share of the slowest server's saturating rate. At this rate all servers are still on the flat part of their latency
#: curve.
SHARE = 0.7
COMPARED = 5


@dataclass
class Figures:
    """Figures of one server.

    Attributes:
        per_s: saturated answers per second, of each round.
        cpu_ms: processor time of an answer at saturation, milliseconds, of each round.
        p99_ms: 99th percentile of the latency at the common rate, of each round. A stall of the machine spoils only one
            round.
        asked: number of requests behind ``p99_ms``.
    """

    per_s: dict[str, list[float]] = field(default_factory=lambda: {kind: [] for kind in KINDS})
    cpu_ms: dict[str, list[float]] = field(default_factory=lambda: {kind: [] for kind in KINDS})
    p99_ms: list[float] = field(default_factory=list)
    asked: int = 0


Start = Callable[[str], Server | Host]


def peer_rows(
    report: Report, site: Site, *, seconds: float, rounds: int, core: int | None, names: Sequence[str] = PEERS
) -> None:
    """Install, start, check and measure the peers; the rows of a peer that fails give the reason.

    Args:
        report: collects the rows.
        site: map and queries.
        seconds: duration of each saturation; latency takes three times as long.
        rounds: number of rounds. Each round starts, measures and stops every server, so that no two run at the same
            time.
        core: core of the server; None for all.
        names: names of the peers.
    """
    sent = {kind: site.payloads(refine=kind == "full") for kind in KINDS}
    failed: dict[str, str] = {}
    pythons = {}
    for name in names:
        try:
            pythons[name] = python_of(name)
        except PeerError as error:
            failed[name] = str(error)

    def start(name: str) -> Server | Host:
        if name == OWN:
            return Server(site.bundle, core=core) if core is None else Server(site.bundle, core=core, threads=1)
        command = [str(pythons[name]), "-m", f"benchmarks.serving.peers.{name}_app", str(site.bundle)]
        return Host(command, sent["retrieval"][0], core=core)

    found, rate = measured([OWN, *pythons], start, sent, failed, seconds=seconds, rounds=rounds)
    report.notes["peers"] = _note(rate, [name for name in names if name not in failed])
    write_rows(report, found, failed, rounds=rounds)


def measured(
    names: Sequence[str],
    start: Start,
    sent: dict[str, list[Payload]],
    failed: dict[str, str],
    *,
    seconds: float,
    rounds: int,
) -> tuple[dict[str, Figures], float]:
    """Measure the servers; return their figures by name and the common request rate.

    Args:
        names: names of the servers; Streetfix comes first.
        start: starts a server by its name.
        sent: requests by kind.
        failed: receives the reasons of servers that fail, by name.
        seconds: duration of each saturation.
        rounds: number of rounds.

    Raises:
        PeerError: Streetfix itself failed.
    """
    found = {name: Figures() for name in names}
    answers: dict[str, list[dict[str, Any]]] = {}

    def each(turn: int, work: Callable[[str, Server | Host], None]) -> None:
        for name in (
            names if turn % 2 == 0 else names[::-1]
        ):  # alternate the order, so that slow drifts affect all servers alike
            if name in failed:
                continue
            try:
                with start(name) as server:
                    work(name, server)
            except (PeerError, ExceptionGroup) as error:  # a group, if the server ended under load
                if name == OWN:
                    raise
                failed[name] = str(error if isinstance(error, PeerError) else error.exceptions[0])

    def saturate(name: str, server: Server | Host) -> None:
        for kind in KINDS:
            told = [ask(server.url, payload) for payload in sent[kind][:COMPARED]]
            require_same(answers.setdefault(kind, told), told)  # Streetfix is the first
        for kind in KINDS:
            summary, _ = load(server, "rest", sent[kind], closed(seconds, MANY))
            if summary.errors or summary.inconsistent or summary.cpu_ms_per_answer is None:
                raise PeerError(f"{kind}, saturated: {summary.errors}, {summary.inconsistent} inconsistent answers")
            found[name].per_s[kind].append(summary.answered_per_s)
            found[name].cpu_ms[kind].append(summary.cpu_ms_per_answer)

    def arrive(name: str, server: Server | Host, seed: int, rate: float) -> None:
        how = replace(opened(3 * seconds, rate), seed=seed)
        summary, shots = load(server, "rest", sent["full"], how)
        if summary.errors or summary.inconsistent:
            raise PeerError(f"at {rate:.1f} per second: {summary.errors}, {summary.inconsistent} inconsistent answers")
        ms = [1e3 * (shot.done_s - shot.due_s) for shot in shots if shot.due_s >= how.warm_up_s]
        found[name].p99_ms.append(float(np.percentile(ms, 99)))
        found[name].asked += len(ms)

    for turn in range(rounds):
        each(turn, saturate)
    rate = SHARE * min(median(found[name].per_s["full"]) for name in names if name not in failed)
    for turn in range(rounds):
        each(turn, partial(arrive, seed=turn, rate=rate))  # the same arrivals for all
    return found, rate


def require_same(own: list[dict[str, Any]], told: list[dict[str, Any]]) -> None:
    """Require equal answers to the same requests.

    Args:
        own: answers of Streetfix.
        told: answers of the peer.

    Raises:
        PeerError: a street, a status or a position differs.
    """
    for number, (a, b) in enumerate(zip(own, told, strict=True)):
        for name in ("status", "street"):
            if (_without_vote(a[name]), name) != (_without_vote(b[name]), name):
                raise PeerError(f"request {number}: it answers {name} {b[name]}, Streetfix {a[name]}")
        at, other = (each["pose"]["position"] if each["pose"] else each["spread"]["mean"] for each in (a, b))
        apart_m = np.linalg.norm([at[axis] - other[axis] for axis in "xyz"])
        if not apart_m <= SAME_M:
            raise PeerError(f"request {number}: its position is {apart_m:.3g} m from Streetfix's")


def write_rows(report: Report, found: dict[str, Figures], failed: dict[str, str], *, rounds: int) -> None:
    """Add the rows of each server, and of Streetfix against the best other server.

    Args:
        report: collects the rows.
        found: figures by name.
        failed: reasons of servers that failed, by name.
        rounds: number of rounds.
    """
    own, peers = found[OWN], {name: figures for name, figures in found.items() if name != OWN}
    for kind, bar in BARS.items():
        ran = {name: figures.per_s[kind] for name, figures in peers.items() if len(figures.per_s[kind]) == rounds}
        best = max(ran, key=lambda name: median(ran[name]), default=None)
        ratio = None if best is None else median(a / b for a, b in zip(own.per_s[kind], ran[best], strict=True))
        report.row(f"peers.throughput_over_best.{kind}", ratio, "ratio", bar=bar, n=rounds, why=_against(best, failed))
    p99_ms = {name: figures.p99_ms for name, figures in peers.items() if name not in failed}
    best = min(p99_ms, key=lambda name: median(p99_ms[name]), default=None)
    ratio = None if best is None else median(a / b for a, b in zip(own.p99_ms, p99_ms[best], strict=True))
    report.row("peers.p99_under_best", ratio, "ratio", bar=1.0, better="lower", n=own.asked, why=_against(best, failed))
    for name, figures in ({name: Figures() for name in failed} | found).items():
        for kind in KINDS:
            for row, unit, values in (
                ("answers_per_s", "1/s", figures.per_s[kind]),
                ("cpu_ms", "ms", figures.cpu_ms[kind]),
            ):
                report.row(
                    f"peers.{name}.{row}.{kind}",
                    median(values) if values else None,
                    unit,
                    n=len(values),
                    why=failed.get(name),
                )
        p99 = None if name in failed else median(figures.p99_ms)
        report.row(f"peers.{name}.p99_ms", p99, "ms", n=figures.asked, why=failed.get(name))


def _against(best: str | None, failed: dict[str, str]) -> str:
    """Name the best peer, and the peers that did not run."""
    absent = [f"{TITLES[name]} did not run: {why}" for name, why in failed.items()]
    return "; ".join(([] if best is None else [f"the best is {TITLES[best]}"]) + absent)


def _without_vote(value: Any) -> Any:
    """Return a street without its vote, which is a figure."""
    return {name: each for name, each in value.items() if name != "vote"} if isinstance(value, dict) else value


def _note(rate: float, names: Sequence[str]) -> str:
    versions = ", ".join(f"{TITLES[name]} {REQUIREMENTS[name][0].partition('==')[2]}" for name in names)
    return (
        f"{versions}; each alone on the core, one worker, one thread in every pool; saturated by {MANY} clients; p99 "
        f"of full requests, {rate:.1f} per second, {SHARE:.0%} of what saturates the slowest, the same arrivals for "
        "all; medians over rounds."
    )
