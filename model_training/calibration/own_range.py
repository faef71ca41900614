"""Widen the range of the calibration data for one rig, from a recording of this rig (decision 0205).

An answer outside the range of the calibration data is never LOCALIZED at the default false-accept rate. So a rig with other noise or
another field of view than all rig families is refused, even if its answers are right. A long enough recording shows that they are.
"""

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from model_training.calibration.bounds import WRONG_RATE, trials_needed
from model_training.calibration.labelled_frames import LabelledFrames
from service.confidence.decision import is_acceptable
from service.confidence.fitted_range import extrapolated
from service.maps.calibration import Calibration, FeatureRange, RigCorrection
from service.option_limits import FALSE_ACCEPT_RATE


def acceptable(calibration: Calibration, frames: LabelledFrames) -> NDArray[np.bool_]:
    """Return whether each frame may be LOCALIZED at the default false-accept rate, whatever its confidence (n,).

    Args:
        calibration: calibration with the correction for the rig.
        frames: the labelled frames.
    """
    return np.array([is_acceptable(calibration, row, FALSE_ACCEPT_RATE) for row in frames.evidence], bool)


def ranges_of(calibration: Calibration, frames: LabelledFrames) -> tuple[FeatureRange, ...]:
    """Return the ranges of the right answers, for each feature in which one of them lies outside the range of the calibration data.

    Args:
        calibration: calibration of the map, without a correction.
        frames: the labelled frames.
    """
    right = frames.evidence[frames.right]
    names = sorted({name for row in right for name, _ in extrapolated(calibration, row)})
    columns = [right[:, calibration.names.index(name)] for name in names]
    return tuple(
        FeatureRange(feature=name, least=float(column.min()), most=float(column.max()))
        for name, column in zip(names, columns, strict=True)
    )


def is_supported(before: RigCorrection, after: RigCorrection) -> bool:
    """Return whether a recording supports that its rig has a wider range.

    With 95 % certainty, the accepted answers of the rig must keep both rates: that of wrong answers, and that of out-of-map frames. The
    answers that only the wider range accepts must keep the first rate as well. Else many answers in range could hide wrong ones.

    Args:
        before: correction with the counts of the range of the calibration data.
        after: correction with the counts of the wider range.
    """
    gained, wrong = after.accepted - before.accepted, after.accepted_wrong - before.accepted_wrong
    return (
        gained > 0
        and wrong <= WRONG_RATE * gained
        and after.wrong_share_upper <= WRONG_RATE
        and after.outside_share_upper <= FALSE_ACCEPT_RATE
    )


def range_lines(calibration: Calibration, correction: RigCorrection, frames: LabelledFrames) -> list[str]:
    """Return lines of text: how many frames in the map lie outside the range of the calibration data, and what follows.

    Args:
        calibration: calibration of the map, without a correction for the rig.
        correction: the correction that was learned from the frames.
        frames: the labelled frames.
    """
    outside = [extrapolated(calibration, row) for row in frames.evidence[~frames.outside]]
    count = sum(1 for each in outside if each)
    if not count:
        return []
    names = Counter(name for each in outside for name, _ in each)
    told = ", ".join(f"{name} in {number}" for name, number in names.most_common(3))
    lines = [f"outside the range of the calibration data: {count} of {len(outside)} frames in the map ({told})"]
    if correction.ranges:
        widened = ", ".join(f"{each.feature} {each.least:.3g} to {each.most:.3g}" for each in correction.ranges)
        return [*lines, f"range widened for this rig: {widened}"]
    never = f"such an answer is never LOCALIZED at a false-accept rate of {FALSE_ACCEPT_RATE:g} or below"
    if correction.source == "rendered":
        return [*lines, f"{never}; images that are rendered from the map cannot change this, a recording can (--drive)"]
    needs = (
        f"a recording widens the range if it supports a rate of {WRONG_RATE:g} of wrong answers and one of {FALSE_ACCEPT_RATE:g} of "
        f"accepted out-of-map frames; without an error, each needs {trials_needed(WRONG_RATE)} frames"
    )
    return [*lines, f"{never}; {needs}"]
