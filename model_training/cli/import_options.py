"""Which options of ``streetfix import`` a recording uses. The command refuses the others."""

from collections.abc import Mapping
from pathlib import Path

from model_training.importing.kinds import KINDS
from service.errors import DatasetError

#: Frames without poses, each a place of its own, are imported another way than drives.
SINGLE_FRAMES = "kitti-object"
#: Formats whose clouds may come from a spinning LiDAR without times of points. The command adds the times to the opened recording.
_TURNING = frozenset({"rosbag", "clouds"})
_TAKES = {
    **{name: kind.takes | ({"turn-stamp"} if name in _TURNING else set()) for name, kind in KINDS.items()},
    SINGLE_FRAMES: frozenset({"depth"}),
}
#: Options that work only with another one.
_NEEDS = {"hold-out-first": "hold-out", "loops": "odometry", "lidar-height": "odometry"}
#: Options of the images, and formats whose scans come from the images, so that they need a camera without images too.
_OF_IMAGES = frozenset({"depth", "queries", "baseline-m", "rectified", "camera"})
_SCANS_FROM_IMAGES = frozenset({"tum-rgbd", "open3d"})


def kinds() -> list[str]:
    """Return the names of all formats, sorted."""
    return sorted(_TAKES)


def refuse_unused(kind: str, given: Mapping[str, object]) -> None:
    """Refuse an option that the import would not use.

    Args:
        kind: the format.
        given: value of each option by its name without dashes; None if it was not given.

    Raises:
        DatasetError: the format is unknown, or does not use an option, or an option lacks the one that it works with.
    """
    if kind not in _TAKES:
        raise DatasetError(f"kind: {kind!r} is not a known format; choose one of: {', '.join(kinds())}", field="kind")
    told = {option: value for option, value in given.items() if value is not None}
    if "turn-stamp" in told and told.get("deskew") is False:
        raise DatasetError(
            f"--turn-stamp {told['turn-stamp']}: --no-deskew needs no times of points; omit one of the two",
            field="turn-stamp",
        )
    for option, value in told.items():
        if option not in _TAKES[kind]:
            users = [name for name in kinds() if option in _TAKES[name]]
            raise DatasetError(
                f"{_named(option, value)}: {kind} does not use this option; omit it. It is for: {', '.join(users)}",
                field=option,
            )
        if (needed := _NEEDS.get(option)) and needed not in told:
            raise DatasetError(
                f"{_named(option, value)}: it works only with --{needed}; give --{needed} too, or omit it", field=option
            )
        of_images = _OF_IMAGES - {"camera"} if kind in _SCANS_FROM_IMAGES else _OF_IMAGES
        if told.get("pictures") is False and option in of_images:
            raise DatasetError(
                f"{_named(option, value)}: --no-pictures imports no images; omit one of the two", field=option
            )


def refuse_options_of_images(source: Path, given: Mapping[str, object]) -> None:
    """Refuse options of the images for a recording that has none.

    Args:
        source: the recording, for the error.
        given: value of each option by its name without dashes; None if it was not given.

    Raises:
        DatasetError: such an option is given.
    """
    for option, value in given.items():
        if option in _OF_IMAGES and value is not None:
            raise DatasetError(
                f"{_named(option, value)}: {source} has no images, so this option has no effect; omit it", field=option
            )


def _named(option: str, value: object) -> str:
    """Return an option and its value as on the command line."""
    if isinstance(value, bool):
        return f"--{option}" if value else f"--no-{option}"
    if isinstance(value, list):
        return " ".join(f"--{option} {each}" for each in value)
    return f"--{option} {value:g}" if isinstance(value, float) else f"--{option} {value}"
