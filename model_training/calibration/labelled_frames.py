"""Answers to frames of one rig, with their labels: whether each is right, and whether its frame is from outside the map."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.confidence.features import FEATURES

#: Number of blocks of the cross-validation.
BLOCKS = 5


@dataclass(frozen=True, eq=False)
class LabelledFrames:
    """Answers to frames of one rig, with their labels. Frames without confidence features are left out.

    Attributes:
        evidence: confidence features in the order of ``FEATURES`` (n, F).
        right: whether the position of the answer is right (n,). Out-of-map frames are never right.
        outside: whether the frame is an out-of-map frame (n,).
        block: number of the block of consecutive frames for the cross-validation (n,).
    """

    evidence: NDArray[np.float64]
    right: NDArray[np.bool_]
    outside: NDArray[np.bool_]
    block: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.right)

    def where(self, keep: NDArray[np.bool_]) -> "LabelledFrames":
        """Return some of the frames.

        Args:
            keep: whether to keep each frame (n,).
        """
        return LabelledFrames(*(getattr(self, name)[keep] for name in LabelledFrames.__dataclass_fields__))


def blocks_of(count: int) -> NDArray[np.int64]:
    """Return the block of each of some consecutive frames: ``BLOCKS`` blocks of equal length (n,).

    Args:
        count: number of frames.
    """
    return np.arange(count, dtype=np.int64) * BLOCKS // max(1, count)


def joined_frames(parts: list[LabelledFrames]) -> LabelledFrames:
    """Join labelled frames. Frames of different parts share blocks of the same number.

    Args:
        parts: the frames to join.
    """
    names = LabelledFrames.__dataclass_fields__
    return LabelledFrames(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def frames_of(
    evidence: list[NDArray[np.float64] | None],
    right: NDArray[np.bool_],
    outside: NDArray[np.bool_],
    block: NDArray[np.int64],
) -> LabelledFrames:
    """Return the labelled frames of some answers. Answers without confidence features are left out.

    Args:
        evidence: confidence features of each answer; None without registration (n).
        right: labels (n,).
        outside: whether each frame is an out-of-map frame (n,).
        block: block of each frame (n,).
    """
    keep = np.array([each is not None for each in evidence], bool)
    rows = np.array([each for each in evidence if each is not None]).reshape(-1, len(FEATURES))
    found = LabelledFrames(rows, right[keep] & ~outside[keep], outside[keep], block[keep])
    finite = np.isfinite(rows).all(axis=1)
    return found if finite.all() else found.where(finite)
