"""Plot of latency against rate."""

from pathlib import Path

from matplotlib.figure import Figure

from model_training.loadtest.summary import Summary


def draw(found: list[Summary], path: Path) -> None:
    """Plot latency percentiles of answered requests, and the answered rate, over the offered rate.

    Args:
        found: results, one per run.
        path: file to write.
    """
    runs = sorted(found, key=lambda each: each.offered_per_s)
    figure = Figure(figsize=(7, 5), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    for name in ("p50", "p90", "p99"):
        seen = [each for each in runs if each.answered_ms]
        above.plot([each.offered_per_s for each in seen], [each.answered_ms[name] for each in seen], "o-", label=name)
    above.set_yscale("log")
    above.set_ylabel("latency of answers, ms")
    above.grid(visible=True, which="both", alpha=0.3)
    above.legend()
    offered = [each.offered_per_s for each in runs]
    below.plot(offered, [each.answered_per_s for each in runs], "o-", label="answered")
    below.plot(offered, offered, ":", color="gray", label="offered")
    below.set_xlabel("requests sent per second")
    below.set_ylabel("answered/s")
    below.grid(visible=True, alpha=0.3)
    below.legend()
    figure.savefig(path, dpi=130)
