import pytest
from hypothesis import given
from hypothesis import strategies as st

from research.baselines.paper_data.table_one import (
    CLASS_NAMES,
    FRAMES_PRINTED,
    PAPER_FRAMES,
    TEST_IMAGES,
    in_proportion,
)


def test_the_printed_frames_do_not_add_up_to_the_text_s_number() -> None:
    assert sum(FRAMES_PRINTED) == 46_332
    assert PAPER_FRAMES == 46_741
    assert sum(TEST_IMAGES) == 626
    assert len(CLASS_NAMES) == len(FRAMES_PRINTED) == 16


def test_the_paper_s_total_is_shared_out_in_its_proportions() -> None:
    counts = in_proportion(PAPER_FRAMES)

    assert sum(counts) == PAPER_FRAMES
    for count, printed in zip(counts, FRAMES_PRINTED, strict=True):
        assert abs(count - printed * PAPER_FRAMES / 46_332) < 1
    assert counts[0] == 127  # 126 x 46,741 / 46,332 = 127.1


@given(st.integers(min_value=16, max_value=100_000))
def test_any_total_is_kept_and_every_class_has_a_frame(total: int) -> None:
    counts = in_proportion(total)

    assert sum(counts) == total
    assert min(counts) >= 1


def test_fewer_frames_than_classes_are_refused() -> None:
    with pytest.raises(ValueError, match="15 frames cannot be distributed over 16 classes"):
        in_proportion(15)
