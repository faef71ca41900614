"""What other topics than the images say about the robot, and what the settings say."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from service.bridge.known import Known
from service.bridge.rig import StereoRig
from service.imaging.level import GivenHeight


@dataclass(slots=True, kw_only=True)
class Robot:
    """Collects facts that go into queries beside the images.

    Attributes:
        rig: stereo rig that measures the depth.
        camera_height: height of the camera above the ground; None: it is found in the depth image.
    """

    rig: StereoRig = field(default_factory=StereoRig)
    camera_height: GivenHeight | None = None

    def handlers(self) -> dict[str, Callable[[Any], None]]:
        """Return the functions that take messages, by the attribute of ``Topics`` that names their topic."""
        return {"right_info": self.rig.info}

    def missing(self) -> tuple[str, ...]:
        """Return the topics (attributes of ``Topics``) without which no query can be sent, and that brought nothing yet."""
        return ("right_info",) if self.rig.is_missing else ()

    def known(self) -> Known:
        """Return the facts for the next query.

        Raises:
            RequestError: a topic brought a message that cannot be used.
        """
        return Known(baseline_m=self.rig.baseline_m(), camera_height=self.camera_height)
