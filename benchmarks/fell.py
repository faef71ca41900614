"""Rows of ``reports/accuracy.json`` that fell since the commit that issue 36 names: "none falls by more than its interval".

``make reports`` writes their table below the accuracy rows, each with its reason (``benchmarks/why_fell.py``). The values of then are kept
in ``reports/checks``, so no Git history is needed. ``python -m benchmarks.fell`` reads them from Git again.
"""

import argparse
import json
import math
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.coverage import COVERAGE_BAR
from benchmarks.provenance import ROOT, git
from benchmarks.why_fell import WHY_FELL
from benchmarks.why_missed import TOLERANCE
from model_training.evaluation.error_measures import wilson_interval

#: Commit with which the rows are compared.
BEFORE = "d8391ab64e391c7a0c974bac8a22c875f96b51c2"
REPORT = ROOT / "reports" / "accuracy.json"
#: Values of the rows at that commit.
KEPT = ROOT / "reports" / "checks" / "accuracy_d8391ab.json"
#: Rows of other methods, which do not measure our code.
_OTHERS = ("raw.", "real.kitti_stereo.registration.gicp_")
#: Rows without a bar do not say which values are better. Lower ones are for these units and for these parts of an id. Otherwise higher.
_LOWER_UNITS = ("m", "deg", "ms", "ratio")
_LOWER = re.compile(
    r"wrong_and_accepted|accepted_by_default|false_accepts|gross_errors|brier_score|calibration_error|sigma_coverage_gap"
)
#: Rows whose bar is a range.
_INSIDE = "doubt.covariance_95_coverage"
NO_REASON = "no reason written"
#: Text above the table.
_COMPARED = (
    f"Issue 36 asks that no row of this report falls by more than its interval, compared with commit `{BEFORE[:10]}`. These rows did: the "
    "old value is better than the whole 95 % interval of the new one. Rows without an interval are here if the new value is worse. Rows of "
    "other methods are left out."
)
_MOST = (
    "Most rows fell because an accepted answer needs a confidence of 0.9 now, so that few accepted answers are wrong (decisions 0149 and "
    "0165). This refuses more right answers. The forced figures ignore the status and show whether the poses got worse. People wrote the "
    "reasons (`benchmarks/why_fell.py`)."
)
_VALUE = re.compile(r"\{(now|then) ([^ }]+)(?: else ([^}]+))?\}")


@dataclass(frozen=True, slots=True)
class Fallen:
    """A row that fell.

    Attributes:
        row_id: id of the row.
        then: its value at ``BEFORE``.
        now: its value now; None if it has none.
        interval: 95 % interval of ``now``; None if the row has none.
        reason: why it fell; ``NO_REASON`` if nobody wrote it.
    """

    row_id: str
    then: float
    now: float | None
    interval: tuple[float, float] | None
    reason: str


def kept_values(path: Path = KEPT) -> dict[str, float]:
    """Return the values at ``BEFORE`` by row id. Rows without a value are left out.

    Args:
        path: file that ``main`` wrote.
    """
    rows = json.loads(path.read_text())["rows"]
    return {row_id: value for row_id, value in rows.items() if value is not None}


def fallen(
    then: Mapping[str, float], rows: Iterable[Mapping[str, Any]], reasons: Mapping[str, str] | None = None
) -> list[Fallen]:
    """Return the rows that fell, in the order of the report.

    A row fell if its old value is better than the whole 95 % interval of its new value. A row without an interval fell if its new value
    is worse by more than ``TOLERANCE`` of the old one. A row that has no value any more fell too.

    Args:
        then: values of then by row id.
        rows: rows of the present report.
        reasons: reasons by row id; None for ``WHY_FELL``.

    Raises:
        ValueError: a reason names a row that has no value.
    """
    reasons = WHY_FELL if reasons is None else reasons
    by_id = {row["id"]: row for row in rows}
    now = {row_id: row["value"] for row_id, row in by_id.items() if row["value"] is not None}
    order = [*(row_id for row_id in by_id if row_id in then), *(row_id for row_id in then if row_id not in by_id)]
    found = []
    for row_id in order:
        if row_id.startswith(_OTHERS):
            continue
        row = by_id.get(row_id, {"id": row_id, "value": None})
        interval = interval_of(row)
        if _fell(row, then[row_id], interval):
            reason = _with_values(reasons.get(row_id, NO_REASON), then, now)
            found.append(Fallen(row_id, then[row_id], row["value"], interval, reason))
    return found


def interval_of(row: Mapping[str, Any]) -> tuple[float, float] | None:
    """Return the 95 % interval of a row: its own, or the Wilson interval if its value is a share of counted queries.

    Args:
        row: row of a report.
    """
    if row["value"] is None:
        return None
    if "ci95" in row:
        low, high = row["ci95"]
        return low, high
    count = row.get("n") or 0
    counted = row["value"] * count
    if row.get("unit") != "share" or not count or abs(counted - round(counted)) > 1e-6:
        return None
    low, high = wilson_interval(round(counted), count)
    return low, high


def lines(found: Sequence[Fallen]) -> list[str]:
    """Return the part of the page: how rows are compared, and the table.

    Args:
        found: rows that fell.
    """
    told = [f"### Rows that fell since {BEFORE[:7]}", "", _COMPARED, "", _MOST, ""]
    if not found:
        return [*told, "No row fell.", ""]
    told += ["| row | then | now | 95 % interval | reason |", "|---|---|---|---|---|"]
    for each in found:
        now = "-" if each.now is None else f"{each.now:.4g}"
        interval = "none" if each.interval is None else "{:.4f} - {:.4f}".format(*each.interval)
        told.append(f"| `{each.row_id}` | {each.then:.4g} | {now} | {interval} | {each.reason} |")
    return [*told, ""]


def main(arguments: Sequence[str] | None = None) -> int:
    """Read the values of then from Git, write them, and print the table; return 1 without that commit.

    Args:
        arguments: arguments of the command; None takes those of the process.
    """
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args(
        arguments
    )
    text = git("show", f"{BEFORE}:reports/accuracy.json")
    if text is None:
        print(f"commit {BEFORE} not found: fetch the whole history, or keep {KEPT.relative_to(ROOT)} as it is")
        return 1
    KEPT.parent.mkdir(parents=True, exist_ok=True)
    rows = {row["id"]: row["value"] for row in json.loads(text)["rows"]}
    KEPT.write_text(json.dumps({"commit": BEFORE, "rows": rows}, indent=1) + "\n")
    print("\n".join(lines(fallen(kept_values(), json.loads(REPORT.read_text())["rows"]))))
    return 0


def _fell(row: Mapping[str, Any], then: float, interval: tuple[float, float] | None) -> bool:
    now = row["value"]
    if now is None:
        return True
    if math.isclose(now, then, rel_tol=TOLERANCE):
        return False
    if row["id"].startswith(_INSIDE):
        return _outside(now) > max(_outside(then), 0.0)
    lower = _lower_is_better(row)
    if interval is not None:
        return bool(then < interval[0] if lower else then > interval[1])
    return bool(now > then if lower else now < then)


def _outside(share: float) -> float:
    """Return how far a coverage is outside of its bar; negative inside."""
    return max(COVERAGE_BAR[0] - share, share - COVERAGE_BAR[1])


def _lower_is_better(row: Mapping[str, Any]) -> bool:
    if "better" in row:
        return bool(row["better"] == "lower")
    return row.get("unit") in _LOWER_UNITS or _LOWER.search(row["id"]) is not None


def _with_values(reason: str, then: Mapping[str, float], now: Mapping[str, float]) -> str:
    """Replace ``{now ROW}`` and ``{then ROW}`` by values, so that a reason stays true after the next run.

    ``{now ROW else TEXT}`` is the text if the report lacks the row.
    """

    def value(found: re.Match[str]) -> str:
        values = {"now": now, "then": then}[found[1]]
        if found[2] not in values and found[3]:
            return found[3]
        if found[2] not in values:
            raise ValueError(f"benchmarks/why_fell.py: {found[0]}: the report has no value of this row")
        return f"{values[found[2]]:.3f}"

    return _VALUE.sub(value, reason)


if __name__ == "__main__":
    sys.exit(main())
