"""Table I of the paper: how many LiDAR frames and test images each of the 16 classes has.

The paper speaks of 46,741 frames; its "approximate" counts add up to 46,332. Their proportions are kept and the total is
the text's. The test images add up to 626.
"""

import numpy as np

from model_training.simulation.streets import TABLE_I, class_name

PAPER_FRAMES, PAPER_PAIRS = 46_741, 7_600
#: As printed, in the order of ``TABLE_I``.
FRAMES_PRINTED = (126, 2382, 3453, 3332, 3632, 749, 3267, 3824, 4643, 2463, 3267, 3688, 4635, 2377, 3745, 749)
TEST_IMAGES = tuple(count for _, _, count in TABLE_I)
CLASS_NAMES = tuple(class_name(street, section) for street, section, _ in TABLE_I)


def in_proportion(total: int) -> tuple[int, ...]:
    """``total`` shared out as Table I shares out its frames: largest remainders, at least one each.

    Raises:
        ValueError: fewer than one a class.
    """
    if total < len(FRAMES_PRINTED):
        raise ValueError(f"{total} frames cannot be shared out over {len(FRAMES_PRINTED)} classes")
    exact = np.array(FRAMES_PRINTED) * (total / sum(FRAMES_PRINTED))
    counts = np.maximum(np.floor(exact).astype(int), 1)
    remainder = np.argsort(-(exact - counts), kind="stable")
    counts[remainder[: total - counts.sum()]] += 1
    while counts.sum() > total:  # where the least of one each took too many
        counts[counts.argmax()] -= 1
    return tuple(int(count) for count in counts)
