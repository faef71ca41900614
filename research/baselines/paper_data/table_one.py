"""Table I of the paper: numbers of LiDAR frames and test images of the 16 classes.

The paper's text gives 46,741 frames, but its "approximate" counts add up to 46,332. We keep their proportions and the
total of the text. The test images add up to 626.
"""

import numpy as np

from model_training.simulation.streets import TABLE_I, class_name

PAPER_FRAMES, PAPER_PAIRS = 46_741, 7_600
#: Counts as printed, in the order of ``TABLE_I``.
FRAMES_PRINTED = (126, 2382, 3453, 3332, 3632, 749, 3267, 3824, 4643, 2463, 3267, 3688, 4635, 2377, 3745, 749)
TEST_IMAGES = tuple(count for _, _, count in TABLE_I)
CLASS_NAMES = tuple(class_name(street, section) for street, section, _ in TABLE_I)


def in_proportion(total: int) -> tuple[int, ...]:
    """Divide a total in the proportions of Table I's frames, by largest remainders with at least one each.

    Args:
        total: number to divide.

    Raises:
        ValueError: the total is smaller than the number of classes.
    """
    if total < len(FRAMES_PRINTED):
        raise ValueError(f"{total} frames cannot be distributed over {len(FRAMES_PRINTED)} classes")
    exact = np.array(FRAMES_PRINTED) * (total / sum(FRAMES_PRINTED))
    counts = np.maximum(np.floor(exact).astype(int), 1)
    remainder = np.argsort(-(exact - counts), kind="stable")
    counts[remainder[: total - counts.sum()]] += 1
    while counts.sum() > total:  # the minimum of one per class can exceed the total
        counts[counts.argmax()] -= 1
    return tuple(int(count) for count in counts)
