import numpy as np
import pytest

from service.geometry.lengths import lengths


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_lengths_by_hand(dtype):
    found = lengths(np.array([[3, 4, 0], [0, 0, 0], [-2, 3, 6]], dtype))
    assert found.tolist() == [5, 0, 7]
    assert found.dtype == dtype
