"""ROS 1 bags and ROS 2 bags (SQLite, MCAP) as recordings, without ROS.

A message is decoded by the definition that its bag carries, else by that of rosbags, else by one of
`rosbag_messages.DEFINITIONS`. Topics without sensor data, images among them, are counted and never decoded.

`recording` chooses which topic feeds a sensor, by which clock, in which axes. Mountings and lever arms come from
``/tf_static`` (REP 103: x forward, y left, z up; REP 105: base_link).
"""

import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array, matrix_from_quaternion, rpy_from_matrix
from rovgraph.log.disk_columns import FlatTable, computed, every, taken
from rovgraph.model.config_sections import FASTEST_MPS, SLOWEST_MPS
from rovgraph.readers import rosbag_messages as nucleus
from rovgraph.readers.ardupilot import ONE_POINT, new_fixes, one_point
from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.recording import Channel, Clock, Left, Recording, in_files, preferred_first, too_slow
from rovgraph.readers.rosbag_messages import CLOCK as NUCLEUS
from rovgraph.readers.rosbag_messages import (
    COLUMNS,
    DEFINITIONS,
    DOWN,
    GENERAL,
    LATER,
    READERS,
    Unusable,
    beam_settings,
    latency,
)
from rovgraph.readers.stamps import APART_S, by_arrivals
from rovgraph.sensors.dvl_beam import BEAMS

FRD_OF_FLU = np.diag([1.0, -1.0, -1.0])
BODIES = ("base_link", "base_link_frd", "base_footprint")


@dataclass(frozen=True)
class Mounting:
    """How a sensor sits in the vehicle.

    Attributes
    ----------
    R_bs : ndarray, shape (3, 3), from the sensor's axes to forward, starboard, down
    lever_arm_b : ndarray, shape (3,) [m], None = not known
    """

    R_bs: Array
    lever_arm_b: Array | None = None

    def settings(self) -> dict[str, list[float]]:
        """As a sensor's configuration."""
        found = {"mount_rpy_deg": _rounded(np.rad2deg(rpy_from_matrix(self.R_bs)), 4)}
        return found if self.lever_arm_b is None else found | {"lever_arm_m": _rounded(self.lever_arm_b, 5)}


class FrameTree:
    """A tree of frames that do not move."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Array, Array]] = {}  # child -> parent, R_pc, t_pc

    def take(self, transforms: Iterable[Any]) -> None:
        """Transforms of a ``tf2_msgs/TFMessage``; what is no rotation is left out."""
        for each in transforms:
            q, t = each.transform.rotation, each.transform.translation
            R, moved = matrix_from_quaternion((q.x, q.y, q.z, q.w)), np.array([t.x, t.y, t.z])
            if np.isfinite(R).all() and np.isfinite(moved).all():
                self._parents[_name(each.child_frame_id)] = _name(each.header.frame_id), R, moved

    def mounting(self, frame: str) -> Mounting | None:
        """Of a sensor in the body; None where no chain of transforms leads there."""
        at, R, t = _name(frame), np.eye(3), np.zeros(3)
        for _ in range(len(self._parents) + 1):
            if at in BODIES:
                to_frd = np.eye(3) if at.endswith("frd") else FRD_OF_FLU
                return Mounting(to_frd @ R, to_frd @ t)
            if at not in self._parents:
                return None
            at, R_pc, t_pc = self._parents[at]
            R, t = R_pc @ R, R_pc @ t + t_pc
        return None  # a circle


def _name(frame: str) -> str:
    return frame.lstrip("/")


def _rounded(values: Array, digits: int) -> list[float]:
    return [round(float(v), digits) + 0.0 for v in values]


HEADERS, RECORDER = "headers of messages", "recorder"
LATENCY_SD_S = 0.05
SOME = 10_000  # messages enough for a judgement
NED_OF_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass
class Topic:
    """The messages of a topic.

    Attributes
    ----------
    name, type : of the topic
    frame : that its messages name
    rows : sensor -> stamp [s], arrival [s] and `COLUMNS`, row after row
    latencies : messages whose stamp is of arrival, less the delay that they state
    clock : that its stamps share with other topics ("" = that of headers)
    declination_deg : that an instrument has added to its heading
    beams : where the beams of a DVL point, as ``dvl.beams``
    sound_speeds : that it worked with [m/s]
    """

    name: str
    type: str
    frame: str = ""
    rows: dict[str, FlatTable] = field(default_factory=dict)
    latencies: int = 0
    clock: str = ""
    declination_deg: float = 0.0
    beams: dict[str, Any] = field(default_factory=dict)
    sound_speeds: set[float] = field(default_factory=set)

    def table(self, sensor: str) -> Array:
        """Rows of a sensor, shape (n, 2 + columns), not to be changed."""
        return self.rows[sensor].table()

    def some(self, sensor: str) -> Array:
        """Some thousands of them, spread evenly."""
        return every(self.table(sensor), max(len(self.rows[sensor]) // SOME, 1))


def recording(
    path: Path, format_: str, topics: Mapping[str, Topic], frames: FrameTree, left: list[Left], options: ReadingOptions
) -> Recording:
    """A recording of all topics.

    Raises
    ------
    InputError : no measurement of a sensor
    """
    made = _Made(path, frames, left, options)
    channels = tuple(c for sensor in COLUMNS for c in made.of(sensor, topics) if len(c.columns["time"]))
    if not channels:
        found = ", ".join(f"{each.name}: {each.count}" for each in left) or "none"
        raise InputError(f"{path}: holds no measurement of a sensor; topics: {found}")
    made.look(channels, topics)
    used = {c.clock for c in channels} | {c.receiver for c in channels}
    clocks = {name: clock for name, clock in made.clocks.items() if name in used}
    notes, warnings = tuple(dict.fromkeys(made.notes)), tuple(dict.fromkeys(made.warnings))
    return Recording(
        str(path), format_, channels, clocks, tuple(made.left), made.settings, notes, warnings, assumed=made.assumed
    )


class _Made:
    """Channels, and their warnings."""

    def __init__(self, path: Path, frames: FrameTree, left: list[Left], options: ReadingOptions) -> None:
        self.left = left
        self.settings: dict[str, Any] = {}
        self.notes: list[str] = []
        self.warnings: list[str] = []
        self.clocks = {name: Clock(name, 0.0, 0.0, "its stamps are Unix time") for name in (HEADERS, RECORDER)}
        self._path, self._frames, self._choose = path, frames, options.choose
        self._mountings: dict[str, Mounting | None] = {}  # of the preferred topic of a sensor
        self.assumed: dict[str, str] = {}

    def of(self, sensor: str, topics: Mapping[str, Topic]) -> Iterator[Channel]:
        """All topics with sensor data, the preferred one first."""
        chosen = self._choose.get(sensor, "")
        telling = {}
        for topic in topics.values():
            if sensor not in topic.rows:
                continue
            if topic.type in GENERAL and "dvl" not in topic.name.casefold() and topic.name != chosen:
                reason = "a velocity, by its name not of a DVL; choose dvl=TOPIC if it is"
                self.left.append(Left(f"{topic.name} ({topic.type})", len(topic.table(sensor)), reason))
            else:
                telling[topic.name] = topic
        order = sorted(telling, key=lambda n: (_rank(telling[n]), -len(telling[n].rows[sensor])))
        for place, name in enumerate(preferred_first(self._path, sensor, order, self._choose)):
            counts = len(self.notes), len(self.warnings)
            channel = self._channel(sensor, telling[name], place == 0)
            if place:  # unused ones get no warning
                del self.notes[counts[0] :], self.warnings[counts[1] :]
            yield channel

    def _channel(self, sensor: str, topic: Topic, first: bool) -> Channel:
        table = topic.table(sensor)
        keep, time, clock = self._times(topic, table)
        table = table if keep.all() else taken(table, keep)
        received, values = table[:, 1], table[:, 2:]
        frame = f"{topic.frame or 'no frame'} of the messages" if sensor not in ("depth", "fix", "dvl_altitude") else ""
        if sensor == "fix":
            new = self._new_fixes(topic, time, values)
            time, received, values = time[new], received[new], values[new]
        columns = {"time": time, **self._columns(sensor, topic, values)}
        if first:
            self._mountings[sensor] = self._frames.mounting(topic.frame)
        source = f"{topic.name} ({topic.type})"
        return in_files(Channel(sensor, columns, source, frame, clock, received, RECORDER))

    def _columns(self, sensor: str, topic: Topic, values: Array) -> dict[str, Array]:
        if sensor == "depth":
            told = topic.clock == NUCLEUS  # others have pressure
            return {"depth": values[:, 0]} if told else {"pressure": self._pascal(topic, values[:, 0])}
        if sensor == "ahrs":
            return self._attitude(topic, values)
        return dict(zip(COLUMNS[sensor], values.T, strict=True))

    def _times(self, topic: Topic, table: Array) -> tuple[NDArray[np.bool_], Array, str]:
        """Which rows can be used, their stamps [s], and the clock of these."""
        received = table[:, 1]
        if topic.latencies:
            self.notes.append(f"{topic.name}: stamped by arrival, less the time that each report says it took")
        stamp, said = by_arrivals(table[:, 0], received)
        self.warnings += [f"{topic.name}: {text}" for text in said]
        if stamp is None:
            return np.ones(len(table), bool), received, RECORDER
        keep = np.isfinite(stamp)
        if not keep.all():
            why = "no stamp in the header, or one of another clock"
            self.left.append(Left(f"{topic.name} ({topic.type})", int((~keep).sum()), why))
        apart = float(np.median((received - stamp)[keep]))
        if abs(apart) <= APART_S:
            return keep, stamp[keep], HEADERS
        name = topic.clock or f"{HEADERS} of {topic.name}"
        offset = float((received - stamp)[keep].min())
        if name in self.clocks:
            offset = min(offset, self.clocks[name].unix_offset or offset)
        self.clocks[name] = Clock(name, offset, LATENCY_SD_S, "least of (received - stamp) by the recorder")
        self.warnings.append(f"{topic.name}: headers are {apart:+.1f} s apart from the recorder's clock, so of another")
        return keep, stamp[keep], name

    def _new_fixes(self, topic: Topic, time: Array, values: Array) -> NDArray[np.bool_]:
        lat, lon = values[:, 0], values[:, 1]
        name = f"{topic.name} ({topic.type})"
        if (point := one_point(lat, lon)) is not None:
            self.warnings.append(f"{topic.name}: {ONE_POINT}")
            self.settings["environment"] = {"origin_lat_deg": point[0], "origin_lon_deg": point[1]}
            self.left.append(Left(name, len(values), "one point that repeats"))
            return np.zeros(len(values), bool)
        new = new_fixes(time, lat, lon)
        if not new.all():
            self.left.append(Left(name, int((~new).sum()), "nowhere on Earth, or the one before repeated"))
        return new

    def _pascal(self, topic: Topic, pressure: Array) -> Array:
        typical = float(np.nanmedian(pressure))
        for factor, unit, high in ((1e3, "kPa", 850.0), (1e2, "hPa", 50_000.0)):
            if 90.0 < typical < high:
                self.warnings.append(f"{topic.name}: pressures of {typical:.0f} are taken for {unit}, not Pa")
                return factor * pressure
        return pressure

    def _attitude(self, topic: Topic, xyzw: Array) -> dict[str, Array]:
        """The IMU's axes relative to NED; gravity shows whether the messages' world has z up or down."""
        up = -1.0
        if topic.clock == NUCLEUS:
            self.notes.append(f"{topic.name}: heading less the declination that the instrument has added")
        else:
            acc = np.nanmedian(topic.some("imu")[:, 2:5], axis=0)
            R_ws = matrix_from_quaternion(topic.some("ahrs")[:, 2:])
            whole = np.isfinite(R_ws[:, 2, 2])
            up = float(np.median(R_ws[whole, 2, :] @ acc)) if whole.any() else 1.0
            if up < 0.0:
                self.notes.append(f"{topic.name}: gravity says that its orientation is relative to NED, not to ENU")
        R_nw = np.eye(3) if up < 0.0 else NED_OF_ENU
        angles = computed(lambda q: rpy_from_matrix(R_nw @ matrix_from_quaternion(q)), xyzw)
        self.notes.append(f"{topic.name}: its yaw is taken relative to magnetic north")
        return {f"ahrs_{name}": angles[:, k] for k, name in enumerate(("roll", "pitch", "yaw"))}

    def look(self, channels: tuple[Channel, ...], topics: Mapping[str, Topic]) -> None:
        """State mountings, and warn of what is missing or contradicts."""
        first = {channel.sensor: channel for channel in reversed(channels)}
        at = {sensor: topics[channel.source.partition(" (")[0]] for sensor, channel in first.items()}
        names = ", ".join(
            dict.fromkeys([*(f"{t.name} ({t.type})" for t in topics.values()), *(x.name for x in self.left)])
        )
        if "imu" in first:
            columns = first["imu"].columns
            self.settings["imu"] = self._imu_mounting(at["imu"], columns)
            self.warnings += too_slow(columns["time"], at["imu"].name, "record the IMU at 50 Hz or more")
        else:
            self.warnings.append(f"no IMU (sensor_msgs/Imu) in the bag; its topics: {names}")
        dvl = next((sensor for sensor in ("dvl", "dvl_water") if sensor in first), None)
        if dvl is None:
            self.warnings.append(f"no DVL in the bag; its topics: {names}")
        else:
            self.settings["dvl"] = self._dvl_mounting(at[dvl], self._mountings[dvl])
            if BEAMS in first and at[BEAMS] is at[dvl] and at[dvl].beams:
                self.settings["dvl"]["beams"] = at[dvl].beams
            if len(at[dvl].sound_speeds) == 1:
                self.settings["dvl"]["sound_speed_set_mps"] = min(at[dvl].sound_speeds)
        if "ahrs" in first and (declination := at["ahrs"].declination_deg):
            self.settings.setdefault("environment", {})["declination_deg"] = round(declination, 3)
        if (mounting := self._mountings.get("depth")) is not None:
            self.settings["depth"] = {"lever_arm_m": mounting.settings()["lever_arm_m"]}
        if "mag" in first and "imu" in first and at["mag"].frame != at["imu"].frame:
            frames = f"{at['mag'].name} has the frame {at['mag'].frame!r}, the IMU {at['imu'].frame!r}"
            self.warnings.append(
                f"{frames}: a log has the field along the IMU's axes; use it only if theirs are parallel"
            )

    def _imu_mounting(self, topic: Topic, columns: Mapping[str, Array]) -> dict[str, Any]:
        some = max(len(columns["time"]) // SOME, 1)
        axes_s = [every(columns[name], some) for name in ("acc_x", "acc_y", "acc_z")]
        acc = np.array([np.nanmean(values) if np.isfinite(values).any() else np.nan for values in axes_s])
        mounting = self._mountings["imu"]
        if mounting is None:
            upwards = bool(acc[2] > 0.0)
            mounting = Mounting(FRD_OF_FLU if upwards else np.eye(3))
            axes = "x forward, y left, z up" if upwards else "x forward, y right, z down"
            self._unmounted("imu", topic, f"{axes}, as gravity has it")
        elif (mounting.R_bs @ acc)[2] > 0.0:
            self.warnings.append(f"{topic.name}: gravity is upside down with the mounting of /tf_static; check both")
        return mounting.settings()

    def _dvl_mounting(self, topic: Topic, mounting: Mounting | None) -> dict[str, Any]:
        if mounting is None:
            down = topic.type.startswith(DOWN)
            mounting = Mounting(np.eye(3) if down else FRD_OF_FLU)
            self._unmounted("dvl", topic, "x forward, y right, z down" if down else "x forward, y left, z up")
        return mounting.settings()

    def _unmounted(self, section: str, topic: Topic, axes: str) -> None:
        way = f"/tf_static does not lead from {topic.frame!r} to base_link"
        self.warnings.append(f"{topic.name}: {way}; its axes are taken as {axes}: check the mounting")
        self.assumed[section] = self.warnings[-1]


def _rank(topic: Topic) -> int:
    """Messages of a DVL before velocities of anything, and these before an odometry, which may be an estimate."""
    return 1 + GENERAL.index(topic.type) if topic.type in GENERAL else 0


TF = "tf2_msgs/msg/TFMessage"
ROS1 = b"#ROSBAG V2.0"
MCAP = b"\x89MCAP0\r\n"
SQLITE = b"SQLite format 3\0"
METADATA = "metadata.yaml"
STORAGES = (".mcap", ".db3")
ALL_READERS = READERS | nucleus.NUCLEUS_READERS
ALL_DEFINITIONS = DEFINITIONS | nucleus.NUCLEUS_DEFINITIONS
OFTEN = 2000  # messages between reports of progress
_REMEDY = "bring it in order with 'rosbag reindex' (ROS 1), 'ros2 bag reindex' (ROS 2) or 'mcap recover' (MCAP)"


class RosBag:
    """The format; see `rovgraph.readers.formats.Format`."""

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

    def read(self, path: Path, options: ReadingOptions) -> Recording:
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
        self.frames = FrameTree()
        self._left: Counter[tuple[str, str]] = Counter()
        self._done = 0

    def take(self, storage: Any, ros1: bool, options: ReadingOptions, total: int) -> None:
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
        """Topics that were not taken."""
        return [Left(name, count, why) for (name, why), count in sorted(self._left.items()) if count]


def _take(topic: Topic, message: Any, received: int) -> None:
    if topic.type in nucleus.NUCLEUS_READERS:
        stamp, topic.clock = nucleus.stamp(message), nucleus.CLOCK
        topic.declination_deg = topic.declination_deg or nucleus.declination_deg(message)
    else:
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        topic.frame = topic.frame or message.header.frame_id
        topic.beams = topic.beams or beam_settings(message)
        if SLOWEST_MPS < (speed := getattr(message, "sound_speed", 0.0)) < FASTEST_MPS and len(topic.sound_speeds) < 2:
            topic.sound_speeds.add(round(float(speed), 2))
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
            of_package = {n: t for n, t in ALL_DEFINITIONS.items() if n.partition("/")[0] == kind.partition("/")[0]}
            for name, text in of_package.items():
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
