"""Baseline of the stereo rig that measures the depth: as given, or from the calibration of its right camera."""

from service.bridge.pictures import CameraInfoLike
from service.errors import RequestError
from service.option_limits import LEAST_BASELINE_M, MOST_BASELINE_M


class StereoRig:
    """The stereo rig of a robot.

    Args:
        baseline_m: as measured, metres. It goes before the calibration. 0 if nobody measured it.
        topic: of the right camera's calibration; empty if there is none.

    Attributes:
        topic: to subscribe to; empty if the baseline needs no calibration.

    Raises:
        RequestError: the baseline is out of bounds.
    """

    def __init__(self, baseline_m: float = 0.0, topic: str = "") -> None:
        if baseline_m and not LEAST_BASELINE_M <= baseline_m <= MOST_BASELINE_M:
            raise RequestError(
                f"--baseline-m: {baseline_m:g} m is not a valid baseline; give {LEAST_BASELINE_M:g} to {MOST_BASELINE_M:g} m, or 0 if no "
                "stereo rig measures the depth",
                field="baseline_m",
            )
        self._given_m = baseline_m or None
        self._info: CameraInfoLike | None = None
        self.topic = "" if baseline_m else topic

    def info(self, message: CameraInfoLike) -> None:
        """Take the calibration of the right camera.

        Args:
            message: the calibration; the newest one counts.
        """
        self._info = message

    @property
    def is_missing(self) -> bool:
        """Whether the calibration is needed and has not come yet."""
        return bool(self.topic) and self._info is None

    def baseline_m(self) -> float | None:
        """Return the baseline, metres; None if no stereo rig is known.

        Raises:
            RequestError: the calibration is not that of a right camera.
        """
        return self._given_m if self._info is None else baseline_from(self._info, self.topic)


def baseline_from(message: CameraInfoLike, topic: str) -> float:
    """Return the baseline from the calibration of a right camera, metres. Its P[0, 3] is -fx times the baseline (sensor_msgs/CameraInfo).

    Args:
        message: calibration of the rectified right camera.
        topic: of the message; named in errors.

    Raises:
        RequestError: the calibration gives no valid baseline; ``field`` is the topic.
    """
    fx, shift = float(message.p[0]), float(message.p[3])
    baseline_m = (0.0 - shift) / fx if fx > 0 else 0.0  # a shift of 0 gives no -0
    if not LEAST_BASELINE_M <= baseline_m <= MOST_BASELINE_M:
        raise RequestError(
            f"{topic}: its P[0, 3] of {shift:g} and fx of {fx:g} px mean a baseline of {baseline_m:g} m, outside {LEAST_BASELINE_M:g} to "
            f"{MOST_BASELINE_M:g} m; name the CameraInfo of the rectified right camera, or give --baseline-m",
            field=topic,
        )
    return baseline_m
