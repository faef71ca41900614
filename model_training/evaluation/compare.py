"""Compare two saved runs over the same queries."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model_training.evaluation.failures import position_errors
from model_training.evaluation.measures import recall_at
from model_training.evaluation.paired import PairedErrors, PairedShares, paired_errors, paired_shares
from model_training.evaluation.predict import RANKED, Predictions, joined
from model_training.evaluation.saved_run import SavedRun
from service.errors import DatasetError
from service.geometry.rigid import SAME_M
from service.maps.calibration import RIGHT_M

#: A difference is significant if its p-value is below this.
_P = 0.05


@dataclass(frozen=True)
class Comparison:
    """The differences between two runs A and B.

    Attributes:
        shares: comparison of each share over all queries, by the name of the measure.
        sets: comparison of the share within 1 m and accepted, by query set.
        errors: comparison of the distances of answers that both runs have, accepted or not. None if there are none.
        gained: rows of the joined sets for which only B is within 1 m and accepted.
        lost: rows for which only A is.
        modes: how the images became queries in A and in B, as text.
        first: answers of A, all sets joined.
        second: answers of B, all sets joined.
    """

    shares: dict[str, PairedShares]
    sets: dict[str, PairedShares]
    errors: PairedErrors | None
    gained: list[int]
    lost: list[int]
    modes: tuple[str, str]
    first: Predictions
    second: Predictions

    @property
    def verdict(self) -> str:
        """Return a sentence that says which run is better.

        B is better in two cases: it has significantly more right answers, and the share of wrong accepted answers does not rise. Or it has
        significantly fewer wrong accepted answers, and not significantly fewer right ones. The same holds for worse, the other way round.
        """
        right, wrong = self.shares["within_1_m"], self.shares["accepted_but_wrong"]
        differences = (
            f"{_difference_text(right, 'accepted and within 1 m')}; {_difference_text(wrong, 'accepted and wrong')}"
        )
        won, lost = _surely_more(right), _surely_less(right)
        safer, riskier = _surely_less(wrong), _surely_more(wrong)
        if (won and wrong.difference <= 0) or (safer and not lost):
            return f"B is significantly better than A: {differences}."
        if (lost and wrong.difference >= 0) or (riskier and not won):
            return f"B is significantly worse than A: {differences}."
        if won or lost:
            more, fewer = ("B", "A") if won else ("A", "B")
            return f"Neither is better: {more} has more right answers, {fewer} accepts fewer wrong ones: {differences}."
        if right.only_first + right.only_second + wrong.only_first + wrong.only_second == 0:
            return (
                f"No difference: A and B are right about the same queries ({right.count}, {right.second:.1%} within 1 m), "
                "and accept the same wrong ones."
            )
        return f"No significant difference: {differences}."

    def as_json(self) -> dict[str, Any]:
        """Return all figures as JSON values."""
        return {
            "verdict": self.verdict,
            "modes": list(self.modes),
            "shares": {name: asdict(each) | {"difference": each.difference} for name, each in self.shares.items()},
            "sets": {name: asdict(each) | {"difference": each.difference} for name, each in self.sets.items()},
            "errors": None if self.errors is None else asdict(self.errors),
            "gained": self.gained,
            "lost": self.lost,
        }


def _surely_more(each: PairedShares) -> bool:
    return each.p < _P and each.difference > 0


def _surely_less(each: PairedShares) -> bool:
    return each.p < _P and each.difference < 0


def _difference_text(each: PairedShares, what: str) -> str:
    low, high = (f"{100 * side:+.1f}" for side in each.interval)
    return (
        f"{what}: {each.first:.1%} of A, {each.second:.1%} of B, {each.only_second} of {each.count} queries by B alone, "
        f"{each.only_first} by A alone, {100 * each.difference:+.1f} points (95 % interval {low} to {high}; McNemar's p {p_text(each.p)})"
    )


def p_text(p: float) -> str:
    """Format a p-value with three decimals, or as ``<0.001``.

    Args:
        p: the p-value.
    """
    return "<0.001" if p < 0.001 else f"{p:.3f}"


def compare(first: SavedRun, second: SavedRun) -> Comparison:
    """Compare run B with run A over the same queries.

    Args:
        first: run A.
        second: run B.

    Raises:
        DatasetError: the runs have different queries. The message names the query set and the difference.
    """
    _require_same_queries(first, second)
    names = list(first.predictions)
    a, b = joined([first.predictions[name] for name in names]), joined([second.predictions[name] for name in names])
    right_a, right_b = _right(a), _right(b)
    return Comparison(
        shares={name: paired_shares(one, other) for name, one, other in _flags(a, b)},
        sets={name: paired_shares(_right(first.predictions[name]), _right(second.predictions[name])) for name in names},
        errors=paired_errors(position_errors(a), position_errors(b)),
        gained=[int(k) for k in np.flatnonzero(right_b & ~right_a)],
        lost=[int(k) for k in np.flatnonzero(right_a & ~right_b)],
        modes=(first.settings.described(), second.settings.described()),
        first=a,
        second=b,
    )


def _right(p: Predictions) -> NDArray[np.bool_]:
    return np.asarray(p.localized & (position_errors(p) <= RIGHT_M))


def _flags(a: Predictions, b: Predictions) -> Iterator[tuple[str, NDArray[np.bool_], NDArray[np.bool_]]]:
    true_xy = a.T_true[:, :2, 3]
    for name, reach in (("within_0_5_m", 0.5), ("within_1_m", RIGHT_M), ("within_5_m", 5.0)):
        yield name, a.localized & (position_errors(a) <= reach), b.localized & (position_errors(b) <= reach)
    for name, reach in (("forced_within_0_5_m", 0.5), ("forced_within_1_m", RIGHT_M)):
        yield name, position_errors(a) <= reach, position_errors(b) <= reach
    for k in (1, 5, RANKED):
        yield f"recall_at_{k}_5m", recall_at(a.ranked_xy, true_xy, k), recall_at(b.ranked_xy, true_xy, k)
    yield "localized", a.localized, b.localized
    yield "accepted_but_wrong", a.localized & ~_right(a), b.localized & ~_right(b)


def _require_same_queries(first: SavedRun, second: SavedRun) -> None:
    if first.settings.mode.frames != second.settings.mode.frames:
        raise DatasetError(
            f"{first.folder} measured {first.settings.mode.described()}, and {second.folder} {second.settings.mode.described()}, so they "
            "have different queries; evaluate both with the same --frames",
            field="frames",
        )
    names, others = set(first.predictions), set(second.predictions)
    if names != others:
        alone = ", ".join(sorted(names ^ others))
        raise DatasetError(
            f"{first.folder} and {second.folder} have different query sets: only one has {alone}; "
            "evaluate both with the same --queries",
            field="queries",
        )
    for name in sorted(names):
        one, other = first.predictions[name].T_true, second.predictions[name].T_true
        if len(one) != len(other) or not np.allclose(one, other, rtol=0, atol=SAME_M):
            raise DatasetError(
                f"query set {name!r}: {first.folder} ({first.settings.dataset.name}, {len(one)} queries) and "
                f"{second.folder} ({second.settings.dataset.name}, {len(other)} queries) have different queries; "
                "evaluate both on the same dataset",
                field="queries",
            )
