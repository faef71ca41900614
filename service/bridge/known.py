"""What the bridge knows about a query beside its images."""

from dataclasses import dataclass

from service.imaging.level import GivenHeight


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Known:
    """Facts that go into a query. None of them is required.

    Attributes:
        baseline_m: baseline of the stereo rig that measured the depth, metres; None if no rig is known.
        camera_height: height of the camera above the ground; None: it is found in the depth image.
    """

    baseline_m: float | None = None
    camera_height: GivenHeight | None = None
