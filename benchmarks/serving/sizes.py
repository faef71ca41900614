"""Start time and memory of the service."""

from statistics import median

from benchmarks.report import Report
from benchmarks.serving.loads import closed, load
from benchmarks.serving.machines import Server, proportional_mib
from benchmarks.serving.ratios import Site
from model_training.loadtest.processes import descendants

STARTS = 5


def size_rows(report: Report, site: Site, *, core: int | None) -> None:
    """Add the start time and memory of one process, and the memory of a second one beside it.

    Args:
        report: collects the rows.
        site: map and queries.
        core: core of the server; None for all.
    """
    sent = site.payloads(refine=True)
    starts = []
    for _ in range(STARTS):
        with Server(site.bundle, core=core) as server:
            starts.append(server.ready_s)
    report.row("start.ready_s", median(starts), "s", bar=3, better="lower", n=STARTS)
    with Server(site.bundle, core=core) as server:
        found, _ = load(server, "rest", sent, closed(15, 4))
        report.row("memory.resident_mib", server.used.resident_mib, "MiB", bar=500, better="lower", n=found.answers)
        one = sum(map(proportional_mib, descendants(server.process.pid)))
    with Server(site.bundle, core=None, workers=2) as server:
        found, _ = load(server, "rest", sent, closed(20, 8))
        two = sum(map(proportional_mib, descendants(server.process.pid)))
    report.row("memory.second_worker_mib", two - one, "MiB", bar=200, better="lower", n=found.answers)
