"""Follow simulated robots that carry their track themselves, as clients of REST do: sealed bytes from answer to answer."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model_training.evaluation.tracks import Step, Tracks
from service.errors import NoDepthError
from service.geometry.rigid import Transform
from service.localization.localizer import Localizer
from service.localization.track_bytes import packed, unpacked
from service.localization.tracker import Track, follow
from service.runtime.seal import Seal

#: Two answers with the same status and epoch are equal if their errors differ by at most this distance, metres.
EQUAL_M = 0.001


@dataclass(frozen=True, slots=True)
class CarriedTracks:
    """Answers of R robots with K frames each, and what the robots carry.

    Attributes:
        tracks: the answers.
        sizes: number of sealed bytes after each frame (R, K); 0 if the answer has no belief.
    """

    tracks: Tracks
    sizes: NDArray[np.int64]


def carried(
    localizer: Localizer, drives: list[list[Step]], report: Callable[[str, int, int], None] = lambda *_: None
) -> CarriedTracks:
    """Follow robots as ``followed`` does, but keep nothing between two frames except the sealed bytes of the belief.

    The bytes take the way of a token: packed, sealed, opened and unpacked, as in ``service.runtime.engine``. If a frame has no depth, the
    service refuses it. The robot then keeps its bytes, and its next odometry refers to the last answered frame.

    Args:
        localizer: of the map.
        drives: steps of each robot, equally many.
        report: called after each robot.
    """
    shape, seal, manifest = (len(drives), len(drives[0])), Seal(), localizer.bundle.manifest
    version = f"{localizer.bundle.name}@{manifest.version}"
    accepted, error_m = np.zeros(shape, np.bool_), np.full(shape, np.inf)
    epoch, frames, sizes = (np.zeros(shape, np.int64) for _ in range(3))
    for row, drive in enumerate(drives):
        sealed, since = b"", None
        for column, step in enumerate(drive):
            since = _composed(since, step.T_previous_camera)
            query = replace(step.frame.query(localizer.bundle.grid), ranked=0)
            try:
                frame = localizer.encode_and_search(query)
            except NoDepthError:
                epoch[row, column] = epoch[row, column - 1] if column else 0
                continue
            track = unpacked(_opened(seal, sealed), map_version=version) if sealed else Track()
            answer, following = follow(localizer, frame, track, since)
            sealed = b"" if answer.belief is None else seal.sealed(packed(following, map_version=version))
            since, T_map_camera = np.eye(4), step.frame.T_map_camera
            if T_map_camera is None:
                raise ValueError("the frame has no true pose")
            accepted[row, column] = answer.status == "LOCALIZED"
            error_m[row, column] = float(np.hypot(*(answer.T_map_camera_guess[:2, 3] - T_map_camera[:2, 3])))
            epoch[row, column], frames[row, column] = answer.epoch, answer.frames
            sizes[row, column] = len(sealed)
        report("carried tracks", row + 1, len(drives))
    return CarriedTracks(Tracks(accepted, error_m, epoch, frames), sizes)


def equal(one: Tracks, other: Tracks) -> NDArray[np.bool_]:
    """Return which answers of the same robots have the same status and epoch, and errors within ``EQUAL_M`` (R, K).

    Args:
        one: answers of R robots with K frames each.
        other: other answers to the same frames.
    """
    is_near = np.isclose(one.error_m, other.error_m, rtol=0.0, atol=EQUAL_M)  # also two frames without an answer
    same: NDArray[np.bool_] = (one.accepted == other.accepted) & (one.epoch == other.epoch) & is_near
    return same


def _composed(since: Transform | None, step: Transform | None) -> Transform | None:
    """Return the odometry since the last answered frame; None if a part of it is unknown."""
    return None if since is None or step is None else since @ step


def _opened(seal: Seal, sealed: bytes) -> bytes:
    content = seal.opened(sealed)
    if content is None:
        raise ValueError("the seal does not open what it sealed")
    return content
