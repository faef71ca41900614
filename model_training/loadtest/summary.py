"""Results of a load test."""

from collections import Counter
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from model_training.loadtest.drive import Load, Shot
from model_training.loadtest.payloads import Payload
from model_training.loadtest.processes import Usage
from model_training.loadtest.targets import Reply
from service.geometry.rigid import SAME_M
from service.maps.calibration import RIGHT_M


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """Figures of the counted seconds.

    Attributes:
        rate: requested rate, per second; None for ``concurrency``.
        concurrency: number of clients that wait for answers.
        offered_per_s: scheduled requests per second.
        answered_per_s: answers per second that came within the counted seconds.
        answered_ms: latency percentiles of answered requests: p50, p90, p95, p99, max; empty without answers.
        refused_ms: latency percentiles of the other requests.
        late_ms: percentiles of the generator's own delay, of all requests; every latency here includes it.
        errors: numbers of the other requests by outcome.
        answers: number of answers.
        localized: share of answers with status LOCALIZED; None without answers.
        right: share of LOCALIZED answers within 1 m of the ground truth; None without ground truth.
        inconsistent: number of answers that differ from another answer to the same request.
        cpu_ms_per_answer: processor time of the service per answer, milliseconds; None if its processes were not
            observed.
        resident_mib: resident memory of the service at the end, MiB; None if its processes were not observed.
    """

    rate: float | None
    concurrency: int
    offered_per_s: float
    answered_per_s: float
    answered_ms: dict[str, float]
    refused_ms: dict[str, float]
    late_ms: dict[str, float]
    errors: dict[str, int]
    answers: int
    localized: float | None
    right: float | None
    inconsistent: int
    cpu_ms_per_answer: float | None
    resident_mib: float | None

    def as_json(self) -> dict[str, Any]:
        """Return the figures as a JSON object."""
        return asdict(self)


def summarise(
    shots: list[Shot], payloads: list[Payload], load: Load, before: Usage | None, after: Usage | None
) -> Summary:
    """Compute the figures of a run.

    Args:
        shots: requests of ``drive``.
        payloads: the requests that were sent.
        load: requested amount of load.
        before: resources of the service at the start of the counted seconds; None if not observed.
        after: resources of the service at their end; None if not observed.
    """
    total_s = load.warm_up_s + load.duration_s
    counted = [shot for shot in shots if shot.due_s >= load.warm_up_s]
    # Answers after the end of the load are late. They do not count as throughput.
    in_time = sum(shot.reply.code == "ok" and load.warm_up_s <= shot.done_s < total_s for shot in shots)
    answered = [shot for shot in counted if shot.reply.code == "ok"]
    refused = [shot for shot in counted if shot.reply.code != "ok"]
    first: dict[int, Reply] = {}
    inconsistent = 0
    for shot in shots:
        if shot.reply.code == "ok":
            inconsistent += not _same(first.setdefault(shot.payload, shot.reply), shot.reply)
    localized = [shot for shot in answered if shot.reply.status == "LOCALIZED"]
    distances = [
        float(np.linalg.norm(np.subtract(at, true)[:2]))
        for shot in localized
        if (at := shot.reply.position_m) is not None and (true := payloads[shot.payload].true_m) is not None
    ]
    used = None if before is None or after is None else after.cpu_s - before.cpu_s
    return Summary(
        rate=load.rate,
        concurrency=load.concurrency,
        offered_per_s=len(counted) / load.duration_s,
        answered_per_s=in_time / load.duration_s,
        answered_ms=_percentiles([shot.done_s - shot.due_s for shot in answered]),
        refused_ms=_percentiles([shot.done_s - shot.due_s for shot in refused]),
        late_ms=_percentiles([shot.sent_s - shot.due_s for shot in counted]),
        errors=dict(Counter(shot.reply.code for shot in refused)),
        answers=len(answered),
        localized=len(localized) / len(answered) if answered else None,
        right=float(np.mean(np.array(distances) <= RIGHT_M)) if distances else None,
        inconsistent=inconsistent,
        cpu_ms_per_answer=None if used is None or not in_time else 1e3 * used / in_time,
        resident_mib=None if after is None else after.resident_mib,
    )


def _same(one: Reply, other: Reply) -> bool:
    if one.status != other.status:
        return False
    pairs = ((one.position_m, other.position_m), (one.spread_mean_m, other.spread_mean_m))
    return all(a is None or b is None or bool(np.linalg.norm(np.subtract(a, b)) <= SAME_M) for a, b in pairs)


def _percentiles(seconds: list[float]) -> dict[str, float]:
    if not seconds:
        return {}
    ms = 1e3 * np.array(seconds)
    found = {f"p{p}": float(np.percentile(ms, p)) for p in (50, 90, 95, 99)}
    return found | {"max": float(ms.max())}
