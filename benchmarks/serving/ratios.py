"""Processor time and rate of the service against the bare pipeline, interleaved, each on one core."""

from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.report import Report
from benchmarks.serving.loads import closed, load, opened
from benchmarks.serving.machines import Bare, Server
from model_training.datasets.dataset import Dataset
from model_training.loadtest.payloads import Payload, payloads

CPU_BARS: dict[tuple[str, str], float | None] = {
    ("full", "rest"): 1.05,
    ("full", "grpc"): 1.06,
    ("retrieval", "rest"): 1.12,
    ("retrieval", "grpc"): 1.15,
}
#: Clients of a round that measures processor time, and of a round that saturates.
FEW, MANY = 2, 8


@dataclass(frozen=True)
class Site:
    """Map and queries of a measurement.

    Attributes:
        bundle: the map.
        dataset: dataset of the queries.
        queries: name of the query set.
        pairs: number of different queries.
    """

    bundle: Path
    dataset: Path
    queries: str
    pairs: int

    def payloads(self, *, refine: bool, fast: bool = False) -> list[Payload]:
        """Return the requests.

        Args:
            refine: whether to register.
            fast: whether to use the cheapest depth encoding.
        """
        return payloads(
            Dataset(self.dataset), self.queries, map_name=None, refine=refine, most=self.pairs, cheap_depth=fast
        )


def ratio_rows(report: Report, site: Site, *, seconds: float, rounds: int, core: int | None, suffix: str = "") -> float:
    """Add rows of processor time and throughput; return the saturating rate of full requests, per second.

    Args:
        report: collects the rows.
        site: map and queries.
        seconds: duration of each measurement.
        rounds: number of rounds.
        core: core of the server; None for all.
        suffix: end of the row ids.

    Raises:
        RuntimeError: some requests failed.
    """
    threads: dict[str, Any] = {} if core is None else {"threads": 1}
    cpu: dict[tuple[str, str], list[float]] = {}
    rate: dict[tuple[str, str], list[float]] = {}
    with (
        Bare(site.bundle, site.dataset, site.queries, site.pairs, core=core) as bare,
        Server(site.bundle, core=core, **threads) as server,
    ):
        for _ in range(rounds):
            for what in ("full", "retrieval", "retrieval fast"):
                told = bare.run(what, seconds)
                cpu.setdefault((what, "bare"), []).append(told["cpu_ms"])
                rate.setdefault((what, "bare"), []).append(told["per_s"])
                sent = site.payloads(refine=what == "full", fast="fast" in what)
                for face in ("rest", "grpc"):
                    for clients, name in ((FEW, face), (1, f"{face}.one_client")):
                        found, _ = load(server, face, sent, closed(seconds, clients))
                        if found.cpu_ms_per_answer is None or found.errors:
                            raise RuntimeError(f"{what} over {face}: {found.errors}")
                        cpu.setdefault((what, name), []).append(found.cpu_ms_per_answer)
                found, _ = load(server, "rest", sent, closed(seconds, MANY))
                rate.setdefault((what, "rest"), []).append(found.answered_per_s)
    # With one client the load generator is idle while the service works. On cores that share execution units a busy
    # load generator slows only the service.
    alone: dict[tuple[str, str], float | None] = {(what, f"{face}.one_client"): None for what, face in CPU_BARS}
    for (what, face), bar in (CPU_BARS | alone).items():
        each = [a / b for a, b in zip(cpu[what, face], cpu[what, "bare"], strict=True)]
        report.row(
            f"cpu_over_bare.{what}.{face}{suffix}",
            median(each),
            "ratio",
            bar=None if suffix else bar,
            better="lower",
            n=rounds,
        )
    for what in ("full", "retrieval"):
        each = [a / b for a, b in zip(rate[what, "rest"], rate[what, "bare"], strict=True)]
        name = "throughput_over_bare" + ("" if what == "full" else ".retrieval")
        # On several cores the bare loop still has one thread.
        report.row(f"{name}{suffix}", median(each), "ratio", bar=None if suffix or what != "full" else 0.90, n=rounds)
        report.row(f"{what}.bare_cpu_ms{suffix}", median(cpu[what, "bare"]), "ms", n=rounds)
    if not suffix:
        report.row("retrieval.cpu_ms", median(cpu["retrieval", "rest"]), "ms", bar=18.0, better="lower", n=rounds)
        report.row(
            "retrieval.cpu_ms_fast_depth",
            median(cpu["retrieval fast", "rest"]),
            "ms",
            bar=6.5,
            better="lower",
            n=rounds,
        )
        report.row("full.cpu_ms", median(cpu["full", "rest"]), "ms", n=rounds)
    report.row(f"full.answers_per_s{suffix}", median(rate["full", "rest"]), "1/s", n=rounds)
    report.row(f"retrieval.answers_per_s{suffix}", median(rate["retrieval", "rest"]), "1/s", n=rounds)
    return median(rate["full", "rest"])


def tail_rows(report: Report, site: Site, *, seconds: float, rounds: int, core: int | None) -> None:
    """Add the latency of retrieval at 70 % of the saturating rate, by the median round.

    The median excludes a stall of the machine, which can be 1 % of a round.

    Args:
        report: collects the rows.
        site: map and queries.
        seconds: duration of each saturation; latency takes three times as long.
        rounds: number of rounds.
        core: core of the server; None for all.
    """
    sent = site.payloads(refine=False)
    threads: dict[str, Any] = {} if core is None else {"threads": 1}
    middle, spread = [], []
    with Server(site.bundle, core=core, **threads) as server:
        for _ in range(rounds):
            most, _ = load(server, "rest", sent, closed(seconds, MANY))
            found, _ = load(server, "rest", sent, opened(3 * seconds, 0.7 * most.answered_per_s))
            middle.append(found.answered_ms["p50"])
            spread.append(found.answered_ms["p99"] / found.answered_ms["p50"])
    told = ", ".join(f"{each:.1f}" for each in sorted(spread))
    report.row("retrieval.p50_ms_at_70", median(middle), "ms", n=rounds)
    report.row("retrieval.p99_over_p50", median(spread), "ratio", bar=3, better="lower", n=rounds)
    report.notes["tail"] = f"p99 over p50 of each round: {told}."
