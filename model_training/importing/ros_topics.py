"""Choose the topics of a bag by role: as given, or guessed from types and names."""

from collections.abc import Mapping
from dataclasses import dataclass

from service.errors import DatasetError

#: Roles that a topic can have.
ROLES = ("scan", "color", "depth", "right", "info", "right_info", "poses")
#: Roles that are guessed only if the caller wants the pairs of a stereo rig matched. For other depth, only the user knows whether a stereo
#: rig measured it.
_OF_STEREO = frozenset({"right", "right_info"})
#: Words for the left and the right camera in the names of topics. RealSense calls them infra1 and infra2.
SIDES = (("left", "right"), ("infra1", "infra2"), ("cam0", "cam1"))
#: Types of messages with poses, the preferred one first.
POSE_TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "tf2_msgs/msg/TFMessage",
)
_IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_TYPES: dict[str, tuple[str, ...]] = {
    "scan": ("sensor_msgs/msg/PointCloud2",),
    "color": _IMAGE_TYPES,
    "depth": _IMAGE_TYPES,
    "right": _IMAGE_TYPES,
    "info": ("sensor_msgs/msg/CameraInfo",),
    "right_info": ("sensor_msgs/msg/CameraInfo",),
    "poses": POSE_TYPES,
}


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name: of the topic.
        msgtype: type of its messages.
        count: number of its messages.
    """

    name: str
    msgtype: str
    count: int


@dataclass(frozen=True, slots=True)
class Topics:
    """The topic of each role; None if the bag has none.

    Attributes:
        scan: point clouds.
        color: colour images; those of the left camera if pairs are matched.
        depth: depth images.
        right: images of the right camera.
        info: intrinsics.
        right_info: calibration of the right camera of the stereo rig that measured the depth, or whose pairs are matched.
        poses: poses.
        guessed: roles whose topic was not given.
    """

    scan: Topic
    color: Topic | None
    depth: Topic | None
    right: Topic | None
    info: Topic | None
    right_info: Topic | None
    poses: Topic | None
    guessed: tuple[str, ...]

    def lines(self) -> tuple[str, ...]:
        """Return one line per role. It says whether the topic was guessed. Right images have a line only if they are chosen."""
        lines = []
        for role in ROLES:
            topic: Topic | None = getattr(self, role)
            if role == "right" and topic is None:  # most bags have no pairs to match
                continue
            guess = " (guessed)" if role in self.guessed and topic is not None else ""
            what = (
                "none" if topic is None else f"{topic.name}, {topic.count} x {topic.msgtype.rsplit('/', 1)[-1]}{guess}"
            )
            lines.append(f"{role}: {what}")
        return tuple(lines)


def topics_of(available: list[Topic], given: Mapping[str, str], *, source: str, stereo: bool = False) -> Topics:
    """Choose the topics of a bag.

    Args:
        available: all topics of the bag.
        given: topics of the caller by role; the others are guessed, except ``right`` and ``right_info`` without ``stereo``.
        source: name of the bag, for errors.
        stereo: the pairs of a stereo rig will be matched. Then no topic of depth is chosen.

    Raises:
        DatasetError: a role or topic is unknown or of another type, a topic has two roles, or there is no point cloud.
    """
    by_name = {topic.name: topic for topic in available}
    for role, name in given.items():
        if role not in ROLES:
            raise DatasetError(f"topic: {role!r} is not a valid role; choose one of: {', '.join(ROLES)}", field="topic")
        if name not in by_name:
            raise DatasetError(
                f"{source} has no topic {name!r}; it has: {', '.join(sorted(by_name)) or 'none'}", field="topic"
            )
        if by_name[name].msgtype not in _TYPES[role]:
            raise DatasetError(
                f"topic {name!r} is {by_name[name].msgtype}; for {role} the type must be one of: "
                f"{', '.join(_TYPES[role])}",
                field="topic",
            )
    for name in given.values():
        if len(roles := [role for role in ROLES if given.get(role) == name]) > 1:
            raise DatasetError(
                f"topic {name!r} is given for {' and for '.join(roles)}; give each role a topic of its own",
                field="topic",
            )
    chosen = {role: by_name[name] for role, name in given.items()}
    unused = frozenset({"depth"}) if stereo else _OF_STEREO
    for role in ROLES:
        if role in chosen or role in unused:
            continue
        guess = _guess_of_stereo if stereo and role in ("color", *_OF_STEREO) else _guess
        if (topic := guess(role, available, chosen)) is not None:
            chosen[role] = topic
    if "scan" not in chosen:
        have = ", ".join(f"{topic.name} ({topic.msgtype})" for topic in available) or "nothing"
        raise DatasetError(
            f"{source} has no sensor_msgs/PointCloud2, so there is no survey in it; it has: {have}", field="scan"
        )
    return Topics(
        scan=chosen["scan"],
        color=chosen.get("color"),
        depth=chosen.get("depth"),
        right=chosen.get("right"),
        info=chosen.get("info"),
        right_info=chosen.get("right_info"),
        poses=chosen.get("poses"),
        guessed=tuple(role for role in ROLES if role not in given),
    )


def _guess(role: str, available: list[Topic], chosen: Mapping[str, Topic]) -> Topic | None:
    fitting = [
        topic for topic in available if topic.msgtype in _TYPES[role] and topic.count and topic not in chosen.values()
    ]
    if role == "poses":
        known = [topic for topic in fitting if topic.msgtype != POSE_TYPES[-1] or topic.name.rstrip("/").endswith("tf")]
        return min(known, key=lambda topic: (POSE_TYPES.index(topic.msgtype), -topic.count), default=None)
    if role in ("color", "depth"):
        fitting = [topic for topic in fitting if ("depth" in topic.name.lower()) == (role == "depth")]
        fitting = [
            topic for topic in fitting if not any(word in topic.name.lower() for word in ("infra", "mask", "label"))
        ]
    color = chosen.get("color")
    near = "" if color is None or role not in ("depth", "info") else color.name

    def rank(topic: Topic) -> tuple[int, int, int]:
        aligned = role == "depth" and any(word in topic.name for word in ("aligned", "registered"))
        return (-int(aligned), -_shared(topic.name, near), -topic.count)

    return min(fitting, key=rank, default=None)


def _guess_of_stereo(role: str, available: list[Topic], chosen: Mapping[str, Topic]) -> Topic | None:
    """Left images by the word for their side. The topics of the right camera have the other word at the same place."""
    fitting = [
        topic for topic in available if topic.msgtype in _TYPES[role] and topic.count and topic not in chosen.values()
    ]
    if role == "color":
        return max((t for t in fitting if _other_side(t.name)), key=lambda t: ("rect" in t.name, t.count), default=None)
    left = chosen.get("color" if role == "right" else "info")
    wanted = None if left is None else _other_side(left.name)
    return next((topic for topic in fitting if topic.name == wanted), None)


def _other_side(name: str) -> str | None:
    """Return the name of the right camera's topic for that of a left one; None if the name has no word for the left side."""
    return next((name.replace(left, right) for left, right in SIDES if left in name), None)


def _shared(one: str, other: str) -> int:
    """Count the first parts that two names share: the topics of one camera lie in one namespace."""
    count = 0
    for a, b in zip(one.split("/"), other.split("/"), strict=False):
        if a != b:
            break
        count += 1
    return count
