"""Pack a track into bytes, for clients that carry it between their requests.

The format is fixed, so an unpacked track has at most ``MOST_MODES`` modes and no more than ``MOST_BYTES`` bytes. Only a service
that trusts the bytes may unpack them (``service.runtime.seal``).
"""

import hashlib
import struct

import numpy as np

from service.geometry.rigid import quaternion_xyzw_from, rotation_from_quaternion_xyzw, transform_from
from service.localization.belief import MOST_MODES, Belief, Mode
from service.localization.tracker import Track

#: Format, map version, epoch, modes so far, probability of other places, of the outside; number of modes, of last answers (0 or 1).
_HEAD = struct.Struct("<4s8sIIddBB")
#: Position (m), quaternion, upper triangle of the covariance, weight, number, inliers, similarity, news, frames since one agreed.
_MODE = struct.Struct("<3d4f21fdI3fH")
_FORMAT, _UPPER = b"SFB1", np.triu_indices(6)
MOST_BYTES = _HEAD.size + (MOST_MODES + 1) * _MODE.size
_MOST_UNSEEN, _MOST_COUNT = 2**16 - 1, 2**32 - 1


def packed(track: Track, *, map_version: str) -> bytes:
    """Return a track without its frames as bytes.

    Args:
        track: the track.
        map_version: name and version of the map, whose frame the poses use.
    """
    belief, last = track.belief, () if track.last is None else (track.last,)
    head = _HEAD.pack(
        _FORMAT,
        _digest(map_version),
        min(track.epoch, _MOST_COUNT),
        min(belief.born, _MOST_COUNT),
        belief.elsewhere,
        belief.outside,
        len(belief.modes),
        len(last),
    )
    return head + b"".join(_packed_mode(mode) for mode in (*belief.modes, *last))


def unpacked(content: bytes, *, map_version: str) -> Track:
    """Return the track of ``packed`` bytes. In another map version it begins again.

    Args:
        content: bytes of a trusted origin.
        map_version: name and version of the map.
    """
    _, digest, epoch, born, elsewhere, outside, count, has_last = _HEAD.unpack_from(content)
    modes = [_mode(content, _HEAD.size + k * _MODE.size) for k in range(count + has_last)]
    track = Track(Belief(tuple(modes[:count]), elsewhere, outside, born), epoch, modes[count] if has_last else None)
    return track if digest == _digest(map_version) else track.broken()


def _digest(map_version: str) -> bytes:
    return hashlib.sha256(map_version.encode()).digest()[:8]


def _packed_mode(mode: Mode) -> bytes:
    T = mode.T_map_camera
    return _MODE.pack(
        *T[:3, 3],
        *quaternion_xyzw_from(T[:3, :3]),
        *mode.covariance[_UPPER],
        mode.weight,
        mode.number,
        mode.inliers,
        mode.similarity,
        mode.news,
        min(mode.unseen, _MOST_UNSEEN),
    )


def _mode(content: bytes, at: int) -> Mode:
    numbers = _MODE.unpack_from(content, at)
    T = transform_from(rotation_from_quaternion_xyzw(np.array(numbers[3:7])), np.array(numbers[:3]))
    covariance = np.zeros((6, 6))
    covariance[_UPPER] = numbers[7:28]
    covariance = np.triu(covariance) + np.triu(covariance, 1).T
    weight, number, inliers, similarity, news, unseen = numbers[28:]
    return Mode(T, covariance, weight, number, inliers, similarity, unseen, news)
