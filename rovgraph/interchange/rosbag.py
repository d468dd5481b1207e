"""ROS 1 bags and ROS 2 bags (SQLite, MCAP), without ROS: what sensors say in them.

A message is decoded by the definition that its bag carries, else by that of rosbags, else by one of
`rosbag_messages.DEFINITIONS`. Topics that tell of no sensor, images among them, are counted and never decoded.
"""

import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rovgraph.errors import InputError
from rovgraph.interchange import rosbag_nucleus as nucleus
from rovgraph.interchange.formats import Options
from rovgraph.interchange.recording import Left, Recording
from rovgraph.interchange.rosbag_frames import Frames
from rovgraph.interchange.rosbag_messages import COLUMNS, DEFINITIONS, LATER, READERS, Unusable, latency
from rovgraph.interchange.rosbag_recording import Topic, recording
from rovgraph.spilling import FlatTable

TF = "tf2_msgs/msg/TFMessage"
ROS1 = b"#ROSBAG V2.0"
MCAP = b"\x89MCAP0\r\n"
SQLITE = b"SQLite format 3\0"
METADATA = "metadata.yaml"
STORAGES = (".mcap", ".db3")
ALL_READERS = READERS | nucleus.READERS
ALL_DEFINITIONS = DEFINITIONS | nucleus.DEFINITIONS
OFTEN = 2000  # messages between reports of progress
_REMEDY = "bring it in order with 'rosbag reindex' (ROS 1), 'ros2 bag reindex' (ROS 2) or 'mcap recover' (MCAP)"


class RosBag:
    """The format; see `rovgraph.interchange.formats.Format`."""

    name = "rosbag"
    title = "ROS bag (ROS 1, ROS 2: SQLite or MCAP)"
    extra = "ros"

    def recognise(self, path: Path, head: bytes) -> float:
        if path.is_dir():
            return 0.9 if (path / METADATA).is_file() or _storages(path) else 0.0
        if head.startswith(ROS1):
            return 0.95
        if head.startswith(MCAP):
            return 0.6  # BlueOS records into such files, too
        return 0.9 if head.startswith(SQLITE) and b"serialization_format" in head else 0.0

    def read(self, path: Path, options: Options) -> Recording:
        bag = _Bag()
        with ExitStack() as stack:
            readers = []
            for storage, ros1 in _readers(path):
                try:
                    storage.open()
                except Exception as error:  # whatever libraries of others meet in bytes of others
                    raise InputError(f"{path}: cannot be read as a bag ({_said(error)}); {_REMEDY}") from None
                stack.callback(storage.close)
                readers.append((storage, ros1))
            total = sum(each.msgcount for storage, _ in readers for each in storage.connections)
            for storage, ros1 in readers:
                bag.take(storage, ros1, options, total)
        return recording(path, self.name, bag.topics, bag.frames, bag.left(), options)


FORMAT = RosBag()


def _storages(folder: Path) -> list[Path]:
    return sorted(each for each in folder.iterdir() if each.suffix in STORAGES)


def _readers(path: Path) -> Iterator[tuple[Any, bool]]:
    """Readers of a bag's files, and whether they are ROS 1's."""
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    plugins = Reader2.STORAGE_PLUGINS
    if path.is_dir() and (path / METADATA).is_file():
        yield plugins["dir"](path), False
        return
    for file in _storages(path) if path.is_dir() else [path]:  # a recorder that died leaves no metadata
        with file.open("rb") as opened:
            head = opened.read(16)
        if head.startswith(ROS1):
            yield Reader1(file), True
        else:
            yield plugins[".mcap" if head.startswith(MCAP) else ".db3"](file), False


class _Bag:
    """Takes the messages of a bag's files."""

    def __init__(self) -> None:
        self.topics: dict[str, Topic] = {}
        self.frames = Frames()
        self._left: Counter[tuple[str, str]] = Counter()
        self._done = 0

    def take(self, storage: Any, ros1: bool, options: Options, total: int) -> None:
        wanted = {}
        for each in storage.connections:
            static = each.msgtype == TF and each.topic.endswith("tf_static")
            if not static and each.msgtype not in ALL_READERS:
                self._left[f"{each.topic} ({each.msgtype})", "no measurement of a sensor"] += each.msgcount
            elif (decode := _decoder(each, ros1)) is None:
                self._left[f"{each.topic} ({each.msgtype})", "no definition of its type in the bag"] += each.msgcount
            else:
                wanted[each.id] = each, decode
                if not static:
                    self.topics.setdefault(each.topic, Topic(each.topic, each.msgtype))
        if not wanted:
            return
        try:
            for connection, received, data in storage.messages([each for each, _ in wanted.values()]):
                self._done += 1
                if self._done % OFTEN == 0:
                    options.progress(min(self._done, total), total)
                self._message(connection, wanted[connection.id][1], received, data)
        except Exception:  # as above
            self._left["messages", "the bag is cut off or damaged, and read to there"] += 1

    def _message(self, connection: Any, decode: Any, received: int, data: bytes) -> None:
        name = f"{connection.topic} ({connection.msgtype})"
        try:
            message = decode(data, connection.msgtype)
            if connection.msgtype == TF:
                self.frames.take(message.transforms)
            else:
                _take(self.topics[connection.topic], message, received)
        except Unusable as reason:
            self._left[name, str(reason)] += 1
        except Exception:  # as above
            self._left[name, "damaged messages"] += 1

    def left(self) -> list[Left]:
        """What was not taken."""
        return [Left(name, count, why) for (name, why), count in sorted(self._left.items()) if count]


def _take(topic: Topic, message: Any, received: int) -> None:
    if topic.type in nucleus.READERS:
        stamp, topic.clock = nucleus.stamp(message), nucleus.CLOCK
        topic.declination_deg = topic.declination_deg or nucleus.declination_deg(message)
    else:
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        topic.frame = topic.frame or message.header.frame_id
    if topic.type in LATER and hasattr(message, "time_of_validity") and stamp:
        took = latency(message)
        stamp -= took
        topic.latencies += took > 0.0
    for sensor, values in ALL_READERS[topic.type](message):
        row = (stamp, 1e-9 * received, *values)
        assert len(row) == 2 + len(COLUMNS[sensor])
        if (rows := topic.rows.get(sensor)) is None:
            rows = topic.rows[sensor] = FlatTable(len(row))
        rows.append(row)


def _decoder(connection: Any, ros1: bool) -> Any:
    """Function from bytes and name of a type to a message; None where the type is unknown."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    kind, definition = connection.msgtype, connection.msgdef
    try:
        if definition.format == MessageDefinitionFormat.MSG:
            store = get_typestore(Stores.EMPTY)
            store.register(get_types_from_msg(definition.data, kind))
        else:
            store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
            own = {n: t for n, t in ALL_DEFINITIONS.items() if n.partition("/")[0] == kind.partition("/")[0]}
            for name, text in own.items():
                store.register(get_types_from_msg(text, name))
    except Exception:  # whatever stands in the bag
        return None
    if kind not in store.fielddefs:
        return None
    return store.deserialize_ros1 if ros1 else store.deserialize_cdr


def _said(error: Exception) -> str:
    if isinstance(error, struct.error | AssertionError | EOFError):
        return "cut off or damaged"
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")[:200]
