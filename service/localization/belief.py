"""Belief of a moving robot: a Bayes filter over a few modes, with the odometry between the frames.

Each frame is registered alone. Its candidates, their shares of the support and the calibrated confidence give a probability to each
candidate, to the other places of the map, and to the outside. The odometry moves the belief. The filter multiplies it with these
probabilities. It is a Gaussian mixture filter with several hypotheses and an explicit probability for everything outside the modes.
Source: Thrun, Burgard and Fox, Probabilistic Robotics, 2005, section 7.4.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import Transform, heading_of_camera, nearest_rigid
from service.geometry.uncertainty import covariance_at

#: Largest number of modes. The weakest ones return to the rest of the map.
MOST_MODES = 8
#: Modes with less weight return to the rest of the map.
LEAST_WEIGHT = 1e-4
#: Probability that the odometry misses a displacement: for each frame, and in addition for a motion of ``NEW_M`` or ``NEW_RAD``.
KIDNAPPED, KIDNAPPED_ON_THE_WAY = 0.0005, 0.01
#: Standard deviation of odometry: share of the distance, plus metres; share of the angle, plus radians. A robot that stands still has none.
ODOMETRY_STD = (0.03, 0.02, 0.03, float(np.deg2rad(0.2)))
#: Number of places that wrong candidates of consecutive frames are spread over. Errors repeat, because a perceptual alias moves along
#: with the robot. So it is far below the number of places of the map.
ALTERNATIVES = 2.0
#: Motion (metres, or radians) after which a frame is independent evidence for a mode. Images of a robot that stands still have the same
#: error.
NEW_M, NEW_RAD = 2.0, float(np.deg2rad(20.0))
#: Least probability, as a share of being in the map, that no candidate of a frame is right.
MISSED = 0.02
#: Least probability of a frame that the camera is in the map, and that it is outside. No single frame is surer.
LEAST_PROBABILITY = 1e-4
#: A candidate agrees with a mode within this distance and angle. Three standard deviations of the mode are added to the distance, up to a
#: limit: after a long way without images, a mode covers many places, and a candidate in it confirms nothing.
AGREES_M, AGREES_RAD, MOST_AGREES_M = 1.0, float(np.deg2rad(15.0)), 10.0


@dataclass(frozen=True, slots=True)
class OdometryStd:
    """Standard deviations of one odometry step, equal in all directions.

    Attributes:
        position_m: of the translation along each axis, m.
        angle_rad: of the rotation about each axis, rad.
    """

    position_m: float
    angle_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class FrameCandidate:
    """A candidate of one frame.

    Attributes:
        T_map_camera: registered pose.
        covariance: of it: translation (m), then rotation (rad), in map axes, about the camera.
        probability: that the camera is there, from this frame alone, 0 to 1.
        inliers: share of the depth weight that lies on the map, 0 to 1.
        similarity: cosine similarity of the query to the places around.
    """

    T_map_camera: Transform
    covariance: Float64[NDArray[np.float64], "6 6"]
    probability: float
    inliers: float
    similarity: float


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """Probabilities after one frame alone.

    Attributes:
        candidates: poses that exclude each other.
        elsewhere: probability that the camera is at another place of the map.
        outside: probability that the camera is outside the map.
    """

    candidates: tuple[FrameCandidate, ...]
    elsewhere: float
    outside: float


@dataclass(frozen=True, slots=True, eq=False)
class Mode:
    """A pose that the camera may have.

    Attributes:
        T_map_camera: pose.
        covariance: of it, if the mode is right.
        weight: probability that the camera is within 1 m of it, 0 to 1. A mode that is ``unseen`` may have drifted farther.
        number: identity of the mode; odometry does not change it.
        inliers: inlier share of the last frame that agreed.
        similarity: similarity of the last frame that agreed.
        unseen: number of frames since one agreed.
        news: how new a frame is for this mode: motion since one agreed, relative to ``NEW_M`` and ``NEW_RAD``, 0 to 1.
    """

    T_map_camera: Transform
    covariance: Float64[NDArray[np.float64], "6 6"]
    weight: float
    number: int
    inliers: float
    similarity: float
    unseen: int = 0
    news: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """Where a robot may be. The weights of the modes, ``elsewhere`` and ``outside`` sum to 1.

    Attributes:
        modes: the heaviest first.
        elsewhere: probability of all other places of the map.
        outside: probability of a place outside the map.
        born: number of modes so far.
    """

    modes: tuple[Mode, ...] = ()
    elsewhere: float = 0.5
    outside: float = 0.5
    born: int = 0

    def moved(
        self, T_previous_camera: Transform, *, std: OdometryStd | None = None, kidnapped: float | None = None
    ) -> "Belief":
        """Return the belief after a motion.

        Args:
            T_previous_camera: odometry, from this camera's frame to the previous camera's frame, metres.
            std: standard deviations of the odometry. None: they follow from the size of the motion (``ODOMETRY_STD``).
            kidnapped: probability that the odometry missed a displacement. Then the robot is in the map or outside, equally likely.
                None: it follows from the size of the motion.
        """
        if kidnapped is None:
            kidnapped = KIDNAPPED + KIDNAPPED_ON_THE_WAY * _news_of(T_previous_camera)
        stays = 1.0 - kidnapped
        modes = tuple(replace(moved(mode, T_previous_camera, std), weight=stays * mode.weight) for mode in self.modes)
        elsewhere, outside = (stays * each + kidnapped / 2 for each in (self.elsewhere, self.outside))
        return replace(self, modes=modes, elsewhere=elsewhere, outside=outside)

    def seen(self, sighting: Sighting, *, alternatives: float = ALTERNATIVES) -> "Belief":
        """Return the belief after a frame.

        Args:
            sighting: probabilities after the frame alone.
            alternatives: number of places that wrong candidates of consecutive frames are spread over.
        """
        partner = _pairs(self.modes, sighting.candidates)
        first = next((self.modes[k] for k, j in partner.items() if j == 0), None)
        # A frame whose best candidate is at a new place is independent of the frames before.
        news = 1.0 if first is None else first.news
        new = sum(each.probability for j, each in enumerate(sighting.candidates) if j not in partner.values())
        rest, outside = sighting.elsewhere**news, sighting.outside**news
        modes, born = [], self.born
        for k, mode in enumerate(self.modes):
            found = sighting.candidates[partner[k]] if k in partner else None
            if found is None or alternatives * found.probability < sighting.elsewhere:
                modes.append(replace(mode, weight=mode.weight * rest, unseen=mode.unseen + 1))
                continue
            modes.append(
                replace(
                    mode,
                    T_map_camera=found.T_map_camera,
                    covariance=found.covariance,
                    weight=mode.weight * (alternatives * found.probability) ** news,
                    inliers=found.inliers,
                    similarity=found.similarity,
                    unseen=0,
                    news=0.0,
                )
            )
        elsewhere = self.elsewhere * (sighting.elsewhere + new) ** news
        taken = news / (sighting.elsewhere + new)  # share of it, per probability, that goes to new modes
        for j, found in enumerate(sighting.candidates):
            if j in partner.values():
                continue
            modes.append(
                Mode(
                    found.T_map_camera,
                    found.covariance,
                    elsewhere * taken * found.probability,
                    born,
                    found.inliers,
                    found.similarity,
                )
            )
            born += 1
        return _normalised(modes, elsewhere * (1.0 - taken * new), self.outside * outside, born)

    def raised(self, seen: FrameCandidate) -> "Belief":
        """Return the belief after an answer of several frames together: its pose has at least the probability of the answer.

        The answer uses frames that the belief knows already, so it is no further evidence.

        Args:
            seen: pose and probability of the answer.
        """
        here = next((k for k, mode in enumerate(self.modes) if agrees(mode, seen.T_map_camera)), None)
        weight = 0.0 if here is None else self.modes[here].weight
        if seen.probability <= weight:
            return self
        number, born = (self.born, self.born + 1) if here is None else (self.modes[here].number, self.born)
        raised = Mode(seen.T_map_camera, seen.covariance, seen.probability, number, seen.inliers, seen.similarity)
        scale = (1.0 - seen.probability) / (1.0 - weight)
        others = [replace(mode, weight=scale * mode.weight) for k, mode in enumerate(self.modes) if k != here]
        return _normalised([raised, *others], scale * self.elsewhere, scale * self.outside, born)

    def unseen(self) -> "Belief":
        """Return the belief after a frame without evidence, for example because a vehicle covers the view."""
        return replace(self, modes=tuple(replace(mode, unseen=mode.unseen + 1) for mode in self.modes))


def sighting_of(
    candidates: Sequence[FrameCandidate], shares: Float64[NDArray[np.float64], " C"], confidence: float, known: float
) -> Sighting:
    """Distribute the probability of one frame over its candidates, the rest of the map, and the outside.

    The first candidate has the calibrated confidence. If it does not hold the majority of the support, it has at most its share, because
    then perceptual aliases compete with it. The others have the rest in proportion to their shares (as ``confidence.spread.spread_of``).

    Args:
        candidates: poses that exclude each other, the best supported first; their ``probability`` is not read.
        shares: share of each in the support, 0 to 1.
        confidence: probability that the first one is within 1 m.
        known: probability that the camera is in the map.
    """
    known = min(max(known, LEAST_PROBABILITY), 1.0 - LEAST_PROBABILITY)
    if not candidates:
        return Sighting((), known, 1.0 - known)
    most = (1.0 - MISSED) * known
    first = min(confidence, most if shares[0] > 0.5 else float(shares[0]) * most)
    total = min(most, max(first, confidence / float(shares[0])))
    rest = float(shares[1:].sum())
    each = np.array([first, *((total - first) * shares[1:] / rest if rest > 0 else shares[1:] * 0.0)])
    seen = tuple(replace(one, probability=float(p)) for one, p in zip(candidates, each, strict=True))
    return Sighting(seen, known - float(each.sum()), 1.0 - known)


def std_of_motion(T_previous_camera: Transform, share: float | None = None) -> OdometryStd:
    """Return the standard deviations of an odometry step of this size.

    Args:
        T_previous_camera: odometry, from this camera's frame to the previous camera's frame, metres.
        share: standard deviation as a share of the distance and of the angle; None takes those of ``ODOMETRY_STD``.
    """
    of_distance, least_m, of_angle, least_rad = ODOMETRY_STD
    if share is not None:
        of_distance = of_angle = share
    distance_m, angle = size_of(T_previous_camera)
    moving = min(1.0, distance_m / least_m + angle / least_rad)
    return OdometryStd(moving * least_m + of_distance * distance_m, moving * least_rad + of_angle * angle)


def moved(mode: Mode, T_previous_camera: Transform, std: OdometryStd | None = None) -> Mode:
    """Return a mode after a motion, with the same weight.

    Args:
        mode: the mode.
        T_previous_camera: odometry, from this camera's frame to the previous camera's frame, metres.
        std: standard deviations of the odometry. None: they follow from the size of the motion (``ODOMETRY_STD``).
    """
    T = nearest_rigid(mode.T_map_camera @ T_previous_camera)
    carried = covariance_at(mode.covariance, mode.T_map_camera[:3, 3], T[:3, 3])
    news = min(1.0, mode.news + _news_of(T_previous_camera))
    std = std or std_of_motion(T_previous_camera)
    motion = np.diag([std.position_m**2] * 3 + [std.angle_rad**2] * 3)
    return replace(mode, T_map_camera=T, covariance=carried + motion, news=news)


def _news_of(T_previous_camera: Transform) -> float:
    """Return how new the picture after a motion is, 0 to 1."""
    way_m, angle = size_of(T_previous_camera)
    return min(1.0, way_m / NEW_M + angle / NEW_RAD)


def size_of(T: Transform) -> tuple[float, float]:
    """Return length (m) and angle (rad) of a motion.

    Args:
        T: the motion (4, 4).
    """
    angle = float(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
    return float(np.linalg.norm(T[:3, 3])), angle


def agrees(mode: Mode, T_map_camera: Transform) -> bool:
    """Return whether a pose may be that of a mode.

    Args:
        mode: the mode.
        T_map_camera: pose.
    """
    away_m = float(np.hypot(*(T_map_camera[:2, 3] - mode.T_map_camera[:2, 3])))
    turned = heading_of_camera(T_map_camera) - heading_of_camera(mode.T_map_camera)
    deviation_m = float(np.sqrt(np.linalg.eigvalsh(mode.covariance[:2, :2])[-1]))
    return away_m <= min(AGREES_M + 3.0 * deviation_m, MOST_AGREES_M) and bool(np.cos(turned) >= np.cos(AGREES_RAD))


def _pairs(modes: Sequence[Mode], candidates: Sequence[FrameCandidate]) -> dict[int, int]:
    """Assign candidates to modes that they agree with, the nearest first."""
    near = [
        (float(np.hypot(*(one.T_map_camera[:2, 3] - mode.T_map_camera[:2, 3]))), k, j)
        for k, mode in enumerate(modes)
        for j, one in enumerate(candidates)
        if agrees(mode, one.T_map_camera)
    ]
    taken: dict[int, int] = {}
    for _, k, j in sorted(near):
        if k not in taken and j not in taken.values():
            taken[k] = j
    return taken


def _normalised(modes: list[Mode], elsewhere: float, outside: float, born: int) -> Belief:
    total = sum(mode.weight for mode in modes) + elsewhere + outside
    modes = sorted((replace(mode, weight=mode.weight / total) for mode in modes), key=lambda mode: -mode.weight)
    kept = tuple(mode for mode in modes[:MOST_MODES] if mode.weight >= LEAST_WEIGHT)
    outside = outside / total
    return Belief(kept, max(0.0, 1.0 - outside - sum(mode.weight for mode in kept)), outside, born)
