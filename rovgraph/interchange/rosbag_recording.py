"""From what a bag's topics say to a recording: which topic feeds a sensor, by which clock, in which axes."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array, matrix_from_quaternion, rpy_from_matrix
from rovgraph.interchange.alternatives import preferred_first
from rovgraph.interchange.fixes import ONE_POINT, new_fixes, one_point
from rovgraph.interchange.formats import Options
from rovgraph.interchange.pressure import depth, surface_pressure, zero_of
from rovgraph.interchange.rates import too_slow
from rovgraph.interchange.recording import Channel, Clock, Left, Recording, Zero, in_files
from rovgraph.interchange.rosbag_frames import FRD_OF_FLU, Frames, Mounting
from rovgraph.interchange.rosbag_messages import COLUMNS, DOWN, GENERAL
from rovgraph.interchange.rosbag_nucleus import CLOCK as NUCLEUS
from rovgraph.interchange.stamps import APART_S, by_arrivals
from rovgraph.spilling import FlatTable, computed, every, taken

HEADERS, RECORDER = "headers of messages", "recorder"
LATENCY_SD_S = 0.05
SOME = 10_000  # messages that something is told by
SEA = 1025.0  # density of water [kg/m3]
NED_OF_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass
class Topic:
    """What a topic said.

    Attributes
    ----------
    name, type : of the topic
    frame : that its messages name
    rows : sensor -> stamp [s], arrival [s] and `COLUMNS`, row after row
    latencies : messages whose stamp is of arrival, less the time that they say they took
    clock : that its stamps share with other topics ("" = that of headers)
    declination_deg : that an instrument has added to its heading
    """

    name: str
    type: str
    frame: str = ""
    rows: dict[str, FlatTable] = field(default_factory=dict)
    latencies: int = 0
    clock: str = ""
    declination_deg: float = 0.0

    def table(self, sensor: str) -> Array:
        """Rows of a sensor, shape (n, 2 + columns), not to be changed."""
        return self.rows[sensor].table()

    def some(self, sensor: str) -> Array:
        """Some thousands of them, spread evenly."""
        return every(self.table(sensor), max(len(self.rows[sensor]) // SOME, 1))


def recording(
    path: Path, format_: str, topics: Mapping[str, Topic], frames: Frames, left: list[Left], options: Options
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
    """Channels, and what is said of them."""

    def __init__(self, path: Path, frames: Frames, left: list[Left], options: Options) -> None:
        self.left = left
        self.settings: dict[str, Any] = {}
        self.notes: list[str] = []
        self.warnings: list[str] = []
        self.clocks = {name: Clock(name, 0.0, 0.0, "its stamps are Unix time") for name in (HEADERS, RECORDER)}
        self._path, self._frames, self._choose = path, frames, options.choose
        self._mountings: dict[str, Mounting | None] = {}  # of the preferred topic of a sensor
        self.assumed: dict[str, str] = {}
        self._zeros: dict[str, Zero] = {}  # by topic

    def of(self, sensor: str, topics: Mapping[str, Topic]) -> Iterator[Channel]:
        """All topics that tell of a sensor, the preferred one first."""
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
            said = len(self.notes), len(self.warnings)
            channel = self._channel(sensor, telling[name], place == 0)
            if place:  # nothing is said of what may not be used
                del self.notes[said[0] :], self.warnings[said[1] :]
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
        zero = self._zeros.get(topic.name) if sensor == "depth" else None
        return in_files(Channel(sensor, columns, source, frame, clock, received, RECORDER, zero))

    def _columns(self, sensor: str, topic: Topic, values: Array) -> dict[str, Array]:
        if sensor == "depth":
            told = topic.clock == NUCLEUS  # others tell pressure
            return {"depth": values[:, 0] if told else self._depth(topic, values[:, 0])}
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

    def _depth(self, topic: Topic, pressure: Array) -> Array:
        typical = float(np.nanmedian(pressure))
        for factor, unit, high in ((1e3, "kPa", 850.0), (1e2, "hPa", 50_000.0)):
            if 90.0 < typical < high:
                self.warnings.append(f"{topic.name}: pressures of {typical:.0f} are taken for {unit}, not Pa")
                pressure = factor * pressure
                break
        surface, said, _ = surface_pressure(None, pressure)
        at = f"{surface / 100.0:.0f} hPa at the surface ({said})"
        self.warnings.append(f"{topic.name}: depth against {at}, in water of {SEA:.0f} kg/m3")
        self._zeros[topic.name] = zero_of(surface, SEA, self.warnings[-1])
        return depth(pressure, surface, SEA)

    def _attitude(self, topic: Topic, xyzw: Array) -> dict[str, Array]:
        """The IMU's axes relative to NED; gravity tells whether the messages' world has z up or down."""
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
