"""Open a ROS bag with the package ``rosbags``, and read its messages up to where it is damaged."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from model_training.importing.ros_topics import Topic
from service.errors import DatasetError

_MEND = (
    "if it is truncated, repair it with `rosbag reindex` (.bag), `mcap recover` (.mcap) or `sqlite3 FILE .recover` "
    "(.db3), then `ros2 bag reindex` its folder"
)

#: Description of a ROS 2 bag, in its folder.
_METADATA = "metadata.yaml"
_BAG_FILES = (".bag", ".mcap", ".db3")


@dataclass(frozen=True, slots=True)
class Message:
    """A message and its topic.

    Attributes:
        topic: name of the topic.
        msgtype: type of the message.
        content: the decoded message.
    """

    topic: str
    msgtype: str
    content: Any


@dataclass(frozen=True, slots=True)
class Damage:
    """A part of a bag that could not be read.

    Attributes:
        topic: name of the topic; empty if it is unknown.
        why: the reason.
        is_end: everything from here on is unreadable, not only one message.
    """

    topic: str
    why: str
    is_end: bool


@dataclass(frozen=True, slots=True)
class BagReader:
    """An open bag.

    Attributes:
        name: of the bag.
        reader: reader of the package ``rosbags``.
    """

    name: str
    reader: Any

    def topics(self) -> list[Topic]:
        """Return all topics that have exactly one type."""
        topics = self.reader.topics.items()
        return [Topic(name, info.msgtype, info.msgcount) for name, info in topics if info.msgtype is not None]

    @property
    def span_ns(self) -> tuple[int, int]:
        """Times of the first and of the last message, nanoseconds."""
        return int(self.reader.start_time), int(self.reader.end_time)

    def messages(self, topics: Collection[str], *, from_ns: int | None = None) -> Iterator[Message | Damage]:
        """Yield the messages of some topics in the bag's order, and the damage between them.

        Args:
            topics: names of the topics.
            from_ns: leave out messages that were recorded before this time, nanoseconds; None yields all.
        """
        connections = [c for c in self.reader.connections if c.topic in topics]
        if not connections:
            return
        raw = self.reader.messages(connections=connections, start=from_ns)
        while True:
            # On damaged data the package, its codecs and SQLite raise errors without a common base class.
            try:
                connection, _, data = next(raw)
            except StopIteration:
                return
            except Exception as error:
                yield Damage("", f"reading stopped here ({_message_of(error)}); {_MEND}", is_end=True)
                return
            try:
                content = self.reader.deserialize(data, connection.msgtype)
            except Exception as error:
                why = f"its bytes are not a valid {connection.msgtype} ({type(error).__name__})"
                yield Damage(connection.topic, why, is_end=False)
                continue
            yield Message(connection.topic, connection.msgtype, content)

    def first(self, topic: str) -> Any:
        """Return the first readable message of a topic.

        Args:
            topic: name of the topic.

        Raises:
            DatasetError: there is none.
        """
        why = "has no message"
        for found in self.messages([topic]):
            if isinstance(found, Message):
                return found.content
            why = f"has no readable message: {found.why}"
        raise DatasetError(f"{self.name}: topic {topic} {why}", field="topic")


@contextmanager
def opened(path: Path) -> Iterator[BagReader]:
    """Open a ``.bag`` file, the folder of a ROS 2 bag, or one of its files.

    Args:
        path: of the file or folder.

    Raises:
        DatasetError: it cannot be opened.
    """
    _require_bag(path)
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    try:
        reader = AnyReader([path], default_typestore=store)
        reader.open()
    except Exception as error:  # as above: no common base class
        raise DatasetError(
            f"{path}: cannot be opened as a ROS bag ({_message_of(error)}); {_MEND}", field="source"
        ) from error
    try:
        yield BagReader(path.name, reader)
    finally:
        reader.close()


def _require_bag(path: Path) -> None:
    """Refuse a folder that is not a ROS 2 bag. Name the bags in it, if there are any.

    Raises:
        DatasetError: the folder has no ``metadata.yaml``.
    """
    if not path.is_dir() or (path / _METADATA).is_file():
        return
    files = sorted(each for each in path.iterdir() if each.suffix in _BAG_FILES)
    bags = files or sorted(each.parent for each in path.glob(f"*/{_METADATA}"))
    found = f": {', '.join(map(str, bags[:3]))}" if bags else f", or a file that ends in {', '.join(_BAG_FILES)}"
    raise DatasetError(
        f"{path} has no {_METADATA}; give the {'file' if files else 'folder'} of the bag{found}", field="source"
    )


def _message_of(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
