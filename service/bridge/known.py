"""What the bridge knows about a query beside its images."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import Transform
from service.imaging.level import GivenHeight
from service.localization.belief import OdometryStd
from service.retrieval.prior import Prior


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Motion of the camera between two queries.

    Attributes:
        T_previous_camera: from the frame of this camera to that of the camera of the last answered query, metres. None: it is unknown,
            and the track begins again.
        std: standard deviations of ``T_previous_camera``; None for the usual ones of the service.
    """

    T_previous_camera: Transform | None = None
    std: OdometryStd | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Known:
    """Facts that go into a query. None of them is required.

    Attributes:
        baseline_m: baseline of the stereo rig that measured the depth, metres; None if no rig is known.
        camera_height: height of the camera above the ground; None: it is found in the depth image.
        down_camera: direction of gravity in the camera frame, (3,); None if it is unknown.
        prior: prior of the camera's pose; None if there is none.
        motion: the query belongs to a track; None: it stands alone, and the track ends.
    """

    baseline_m: float | None = None
    camera_height: GivenHeight | None = None
    down_camera: Float64[NDArray[np.float64], "3"] | None = None
    prior: Prior | None = None
    motion: Motion | None = None
