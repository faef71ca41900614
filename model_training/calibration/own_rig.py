"""Learn the correction of the confidence for one rig from labelled frames of this rig (decision 0150).

The correction has two numbers, so a few dozen frames are enough. A prior holds it near no correction. Cross-validation over blocks of
consecutive frames says what it brings.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from model_training.calibration.bounds import WRONG_RATE, bounded_thresholds, trials_needed, upper_bound
from model_training.calibration.fit import RATES
from model_training.calibration.labelled_frames import LabelledFrames
from model_training.calibration.own_range import acceptable, is_supported, ranges_of
from service.errors import DatasetError
from service.maps.calibration import UNNAMED, Calibration, RigCorrection, corrected_log_odds, probability
from service.maps.rig_key import RigKey
from service.option_limits import FALSE_ACCEPT_RATE

#: Standard deviations of the prior: of the offset in nats of log odds, and of the scale. The prior of the offset is that of a site
#: (decision 0030). One standard deviation of the scale changes log odds of 4 by one nat.
PRIOR_OFFSET_NATS, PRIOR_SCALE = 1.0, 0.25
#: Smallest scale. With a smaller one, all answers would get nearly the same confidence.
LEAST_SCALE = 0.2
#: Scales and offsets from which the search for the best correction starts.
_SCALES, _OFFSETS = (0.2, 0.35, 0.5, 0.75, 1.0, 1.5), (-4.0, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0)
#: Frames in a bin of the calibration error, at least, and the largest number of bins.
_BIN_FRAMES, _BINS = 20, 15


def learn_correction(
    calibration: Calibration,
    frames: LabelledFrames,
    *,
    source: Literal["drive", "rendered"],
    measured_on: str,
    name: str = UNNAMED,
    made_for: RigKey | None = None,
    label_noise: float = 0.0,
    false_accept_rate: float | None = None,
) -> RigCorrection:
    """Fit the correction, measure it by cross-validation, and bound the share of wrong answers.

    The correction may only lower the confidence (``lower_only``) in three cases: the images are rendered, there is no out-of-map frame, or
    a threshold would accept more out-of-map frames than its rate. If the correction does not improve the cross-validated log loss,
    there is none: scale 1 and offset 0.

    Thresholds come from all out-of-map frames and their confidence with the correction. The correction was fitted on the same frames, but
    it keeps the order of answers. So the thresholds accept the same answers as thresholds of the confidence without it, which has not seen
    the frames. The bound holds.

    If the frames of a recording support it, the correction widens the range of the calibration data for its rig (``own_range``).

    Args:
        calibration: calibration of the map. Its corrections for rigs do not count.
        frames: the labelled frames.
        source: origin of the frames.
        measured_on: description of the frames.
        name: name of the correction.
        made_for: the rig of the frames; None for a correction that is not stored in a map.
        label_noise: share of wrong labels.
        false_accept_rate: rate that the out-of-map frames must support. The correction then has thresholds for this rate, and for all
            rates of a calibration that the frames support. None: the thresholds of the map stay.

    Raises:
        DatasetError: no frame in the map has confidence features, or the out-of-map frames do not support the rate.
    """
    inside = ~frames.outside
    if not inside.any():
        raise DatasetError(
            f"{measured_on}: no frame in the map could be registered and labelled; give images from the map, with poses in its frame",
            field="queries",
        )
    if false_accept_rate is not None:
        require_support(int(frames.outside.sum()), false_accept_rate, "out-of-map frames")
    stock, weight = _without_corrections(calibration), weights_of(frames.outside)
    found = validated(calibration, frames, source=source, label_noise=label_noise)
    lower_only, before, after = found.lower_only, found.before, found.after
    scale, offset = 1.0, 0.0
    if found.improves:
        scale, offset = fit_correction(
            log_odds_of(before), frames.right, weight, lower_only=lower_only, label_noise=label_noise
        )
    correction = RigCorrection(
        name=name,
        made_for=made_for,
        scale=scale,
        offset=offset,
        lower_only=lower_only,
        source=source,
        measured_on=measured_on,
        frames=len(frames),
        right=int(frames.right.sum()),
        outside=int(frames.outside.sum()),
        error_before=calibration_error(before, frames.right, weight),
        error_after=calibration_error(after, frames.right, weight),
        accepted=0,
        accepted_wrong=0,
        wrong_share_upper=1.0,
        outside_accepted=0,
        outside_share_upper=1.0,
    )
    if false_accept_rate is not None:
        count = int(frames.outside.sum())
        confidence = stock.model_copy(update={"rig": correction}).confidence(frames.evidence[frames.outside])
        rates = sorted({*RATES, false_accept_rate})
        thresholds = bounded_thresholds(np.asarray(confidence), np.full(count, 1.0 / count), rates)
        correction = correction.model_copy(update={"thresholds": thresholds})
    in_range = _with_counts(stock, correction, frames, after)
    if source == "rendered" or not (ranges := ranges_of(stock, frames)):
        return in_range
    widened = _with_counts(stock, correction.model_copy(update={"ranges": ranges}), frames, after)
    return widened if is_supported(in_range, widened) else in_range


def _with_counts(
    stock: Calibration, correction: RigCorrection, frames: LabelledFrames, confidence: NDArray[np.float64]
) -> RigCorrection:
    """Return the correction with the numbers of frames that are accepted at the default rate, and the bounds of their shares.

    Args:
        stock: calibration without corrections for rigs.
        correction: the correction; its thresholds and ranges count.
        frames: the labelled frames.
        confidence: confidence of each frame, by corrections that were fitted on other frames (n,).
    """
    corrected, inside = stock.model_copy(update={"rig": correction}), ~frames.outside
    accepted = (confidence >= corrected.threshold(FALSE_ACCEPT_RATE)) & acceptable(corrected, frames)
    counts = [int(each.sum()) for each in (accepted & inside, accepted & inside & ~frames.right, accepted & ~inside)]
    return correction.model_copy(
        update={
            "accepted": counts[0],
            "accepted_wrong": counts[1],
            "wrong_share_upper": upper_bound(counts[1], counts[0]),
            "outside_accepted": counts[2],
            "outside_share_upper": upper_bound(counts[2], int(frames.outside.sum())),
        }
    )


@dataclass(frozen=True, slots=True, eq=False)
class Validated:
    """Confidence of labelled frames, without a correction and with one that was fitted on other blocks.

    Attributes:
        before: confidence by the calibration of the map (n,).
        after: confidence by corrections that were fitted on the other blocks (n,). It equals ``before`` if they do not improve it.
        lower_only: whether the corrections may only lower the confidence.
        improves: whether the corrections improve the log loss.
    """

    before: NDArray[np.float64]
    after: NDArray[np.float64]
    lower_only: bool
    improves: bool


def validated(
    calibration: Calibration,
    frames: LabelledFrames,
    *,
    source: Literal["drive", "rendered"],
    label_noise: float = 0.0,
) -> Validated:
    """Cross-validate the correction over blocks of consecutive frames.

    Args:
        calibration: calibration of the map. Its corrections for rigs do not count.
        frames: the labelled frames, some of them in the map.
        source: origin of the frames.
        label_noise: share of wrong labels.
    """
    stock = _without_corrections(calibration)
    before = np.asarray(stock.confidence(frames.evidence))
    odds, weight = log_odds_of(before), weights_of(frames.outside)
    lower_only = source == "rendered" or not frames.outside.any()
    after = _cross_validated(odds, frames, lower_only, label_noise)
    if not lower_only and not _keeps_rates(stock, before[frames.outside], after[frames.outside]):
        lower_only = True
        after = _cross_validated(odds, frames, lower_only, label_noise)
    improves = _log_loss(after, frames.right, weight, label_noise) < _log_loss(
        before, frames.right, weight, label_noise
    )
    return Validated(before, after if improves else before, lower_only, improves)


def _without_corrections(calibration: Calibration) -> Calibration:
    return calibration.model_copy(update={"rig": None, "rigs": ()})


def log_odds_of(confidence: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the log odds of a calibrated confidence (n,).

    Args:
        confidence: probabilities between 0 and 1, both excluded (n,).
    """
    return np.asarray(np.log(confidence) - np.log1p(-confidence))


def weights_of(outside: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the weight of each frame (n,).

    The frames in the map and the out-of-map frames have the same total weight, as in the calibration. The sum of the weights is the
    effective number of frames (Kish, Survey Sampling, 1965), so a few frames with large weights do not overrule the prior.

    Args:
        outside: whether each frame is an out-of-map frame (n,).
    """
    if outside.all() or not outside.any():
        return np.ones(len(outside))
    share = np.where(outside, 0.5 / outside.sum(), 0.5 / (~outside).sum())
    return np.asarray(share / (share**2).sum())


def fit_correction(
    log_odds: NDArray[np.float64],
    right: NDArray[np.bool_],
    weight: NDArray[np.float64],
    *,
    lower_only: bool = False,
    label_noise: float = 0.0,
) -> tuple[float, float]:
    """Return the scale and the offset with the largest posterior probability under the prior.

    Args:
        log_odds: log odds of the calibration (n,).
        right: labels (n,).
        weight: weight of each frame (n,).
        lower_only: the corrected log odds are never larger than the log odds.
        label_noise: share of wrong labels, 0 to 0.5.
    """

    def cost(parameters: NDArray[np.float64]) -> float:
        scale, offset = parameters
        p = probability(corrected_log_odds(log_odds, float(scale), float(offset), lower_only=lower_only))
        prior = ((scale - 1) / PRIOR_SCALE) ** 2 + (offset / PRIOR_OFFSET_NATS) ** 2
        return float((weight * _loss(p, right, label_noise)).sum() + 0.5 * prior)

    # The cost has kinks if it may only lower, and one minimum without label noise otherwise. So the search needs no derivatives.
    starts = sorted(((scale, offset) for scale in _SCALES for offset in _OFFSETS), key=lambda at: cost(np.array(at)))
    found = [
        minimize(
            cost,
            np.array(start),
            method="Nelder-Mead",
            bounds=[(LEAST_SCALE, None), (None, None)],
            options={"xatol": 1e-7, "fatol": 1e-10, "maxiter": 2000},
        )
        for start in [(1.0, 0.0), *starts[:2]]
    ]
    best = min(found, key=lambda each: float(each.fun)).x
    if cost(best) >= cost(np.array([1.0, 0.0])):
        return 1.0, 0.0
    return float(best[0]), float(best[1])


def calibration_error(
    confidence: NDArray[np.float64], right: NDArray[np.bool_], weight: NDArray[np.float64], *, bins: int | None = None
) -> float:
    """Compute the weighted expected calibration error with bins of equal weight.

    With equal weights and bins of equal size it is that of ``model_training.calibration.fit``.

    Args:
        confidence: confidence of each frame (n,).
        right: labels (n,).
        weight: weight of each frame (n,).
        bins: number of bins; None takes one bin for ``_BIN_FRAMES`` frames, at most ``_BINS``.
    """
    bins = min(_BINS, max(1, len(right) // _BIN_FRAMES)) if bins is None else bins
    order = np.argsort(confidence, kind="stable")
    share = weight[order] / weight.sum()
    middle = np.cumsum(share) - share / 2
    number = np.minimum((middle * bins).astype(int), bins - 1)
    gap = share * (confidence[order] - right[order])
    return float(np.abs(np.bincount(number, gap, minlength=bins)).sum())


def support_of(frames: int, rate: float, what: str) -> str | None:
    """Return a sentence if some frames cannot support a rate, even if no event occurs among them; else None.

    Args:
        frames: number of frames.
        rate: the rate to support, 0 to 1.
        what: name of the frames in the plural.
    """
    if frames == 0:
        return f"there are no {what}, so no rate is supported"
    least = upper_bound(0, frames)
    if least <= rate:
        return None
    return f"{frames} {what} cannot support a rate of {rate:g}: the least rate they support is {least:.2g}"


def require_support(frames: int, rate: float, what: str) -> None:
    """Refuse a false-accept rate that some frames cannot support, even if none of them is accepted.

    Args:
        frames: number of frames.
        rate: the rate to support, 0 to 1.
        what: name of the frames in the plural.

    Raises:
        DatasetError: the frames are too few. The message says how many the rate needs, and which rate they support.
    """
    least = upper_bound(0, frames)
    if least <= rate:
        return
    supported = "no rate" if frames == 0 else f"a rate of {_rounded_up(least):.2g} or more"
    raise DatasetError(
        f"--false-accept-rate {rate:g}: it needs {trials_needed(rate)} {what}, and the recording has {frames}; record more images, or give "
        f"a rate that they support ({supported})",
        field="false_accept_rate",
    )


def _rounded_up(share: float) -> float:
    """Return a share rounded up to two digits, so that the frames support the stated rate."""
    unit = 10.0 ** (np.floor(np.log10(share)) - 1)
    return float(np.ceil(share / unit) * unit)


def report_lines(correction: RigCorrection) -> list[str]:
    """Return lines of text about a correction and about the claims that its frames support.

    Args:
        correction: the correction.
    """
    c = correction
    is_none = (c.scale, c.offset) == (1.0, 0.0)
    formula = f"log odds' = {c.scale:.3f} x log odds {'+' if c.offset >= 0 else '-'} {abs(c.offset):.3f}"
    may = ", where this lowers the confidence" if c.lower_only and not is_none else ""
    rig = [] if c.made_for is None else [f"rig: {c.name}, {c.made_for.described()}"]
    lines = [
        *rig,
        f"frames: {c.frames} labelled, {c.right} with a right answer, {c.outside} out-of-map",
        f"correction: {'none, because none predicts held-out frames better' if is_none else formula}{may}",
        f"calibration error: {c.error_before:.3f} before, {c.error_after:.3f} after (cross-validated)",
        f"accepted in the map: {c.accepted}, {c.accepted_wrong} of them wrong; upper bound of the share {c.wrong_share_upper:.2g} (95 %)",
        f"accepted out-of-map: {c.outside_accepted} of {c.outside}; upper bound of the share {c.outside_share_upper:.2g} (95 %)",
    ]
    lines += [
        f"threshold for a false-accept rate of {each.false_accept_rate:g}: confidence {each.confidence:.3f} ({c.outside} out-of-map "
        "frames, 95 %)"
        for each in c.thresholds
    ]
    claims = (
        support_of(c.accepted, WRONG_RATE, "accepted frames"),
        support_of(c.outside, FALSE_ACCEPT_RATE, "out-of-map frames"),
    )
    return lines + [f"not supported: {claim}" for claim in claims if claim is not None]


def with_correction(calibration: Calibration, correction: RigCorrection) -> Calibration:
    """Return the calibration with a correction for a rig. It replaces that of the same rig. Those of other rigs stay.

    Args:
        calibration: calibration of the map.
        correction: the correction, with its rig.

    Raises:
        ValueError: the correction does not say which rig it is for.
    """
    if correction.made_for is None:
        raise ValueError("correction: made_for is missing; learn the correction with the key of its rig")
    replaced = replaced_by(calibration, correction)
    kept = tuple(each for each in calibration.rigs if each not in replaced)
    return calibration.model_copy(update={"rigs": (*kept, correction)})


def replaced_by(calibration: Calibration, correction: RigCorrection) -> tuple[RigCorrection, ...]:
    """Return the corrections of a map that a new one replaces: those for the same rig (``RigKey.is_same``).

    Args:
        calibration: calibration of the map.
        correction: the new correction.
    """
    key = correction.made_for
    return tuple(
        each
        for each in calibration.rigs
        if key is not None and each.made_for is not None and key.is_same(each.made_for)
    )


def _cross_validated(
    log_odds: NDArray[np.float64], frames: LabelledFrames, lower_only: bool, label_noise: float
) -> NDArray[np.float64]:
    """Return the confidence of each frame by a correction that was fitted on the other blocks (n,)."""
    found = np.empty(len(frames))
    for block in np.unique(frames.block):
        held = frames.block == block
        rest = frames.where(~held)
        weight = weights_of(rest.outside)
        scale, offset = fit_correction(
            log_odds[~held], rest.right, weight, lower_only=lower_only, label_noise=label_noise
        )
        found[held] = probability(corrected_log_odds(log_odds[held], scale, offset, lower_only=lower_only))
    return found


def _keeps_rates(calibration: Calibration, before: NDArray[np.float64], after: NDArray[np.float64]) -> bool:
    """Return whether no threshold accepts more out-of-map frames than its rate, or no more than before the correction."""
    for each in calibration.thresholds:
        passed, earlier = (float(np.mean(confidence >= each.confidence)) for confidence in (after, before))
        if passed > max(each.false_accept_rate, earlier):
            return False
    return True


def _loss(p: NDArray[np.float64], right: NDArray[np.bool_], label_noise: float) -> NDArray[np.float64]:
    """Return the negative log likelihood of each label, some of which are wrong."""
    said = label_noise + (1 - 2 * label_noise) * p
    return -np.log(np.where(right, said, 1 - said))


def _log_loss(
    p: NDArray[np.float64], right: NDArray[np.bool_], weight: NDArray[np.float64], label_noise: float
) -> float:
    return float((weight * _loss(p, right, label_noise)).sum())
