"""Write RVL, as ROS' compressedDepth may hold it (Wilson, Fast lossless depth image compression, ISS 2017).

The service itself only reads RVL.
"""

import struct

import numpy as np
from numpy.typing import NDArray

#: Bits of a nibble, the flag of a continued nibble, and nibbles of a word.
_BITS, _MORE, _NIBBLES = 3, 8, 8


def write_rvl(values: NDArray[np.uint16]) -> bytes:
    """Encode a depth image: width, height, then words of nibbles.

    Args:
        values: depth (H, W).
    """
    height, width = values.shape
    return struct.pack("<ii", width, height) + _packed(_numbers(values.ravel().astype(np.int64)))


def _numbers(flat: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return alternating counts of empty and measured pixels; the differences of measured pixels follow, signs folded in."""
    there = flat > 0
    changes = np.flatnonzero(there[1:] != there[:-1]) + 1
    bounds = np.r_[0, changes, len(flat)]
    if there[0]:
        bounds = np.r_[0, bounds]  # the image begins with a measured pixel
    if len(bounds) % 2 == 0:
        bounds = np.r_[bounds, len(flat)]
    measured = flat[there]
    step = np.diff(measured, prepend=0)
    folded = (step << 1) ^ (step >> 63)
    parts, done = [], 0
    for begin, middle, end in zip(bounds[:-2:2], bounds[1:-1:2], bounds[2::2], strict=True):
        count = int(end - middle)
        parts += [np.array([middle - begin, count]), folded[done : done + count]]
        done += count
    return np.concatenate(parts)


def _packed(numbers: NDArray[np.int64]) -> bytes:
    lengths = np.maximum(1, -(-_bits(numbers) // _BITS))
    which = np.repeat(np.arange(len(numbers)), lengths)
    place = np.arange(len(which)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    nibbles = (numbers[which] >> (_BITS * place)) & (_MORE - 1)
    nibbles |= np.where(place < lengths[which] - 1, _MORE, 0)
    padded = np.r_[nibbles, np.zeros(-len(nibbles) % _NIBBLES, np.int64)].reshape(-1, _NIBBLES)
    words = (padded << (4 * np.arange(_NIBBLES)[::-1])).sum(axis=1)
    data: bytes = words.astype("<u4").tobytes()
    return data


def _bits(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the number of bits of every number, 0 for 0."""
    bits: NDArray[np.int64] = np.ceil(np.log2(numbers + 1.0)).astype(np.int64)
    return bits
