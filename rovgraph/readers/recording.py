"""The contents of one native file, before clocks are joined: channels of a log, and an account of the rest.

A reader (`rovgraph.readers.formats.Format`) turns a file into a `Recording`. Times stay on the file's own
clocks, units become SI and radians, vectors stay in the instrument's axes: these are stated in words
(`Channel.frame`) and as a piece of configuration (`Recording.settings`), never changed by a sign in code.

`too_slow` tells whether an inertial unit was recorded often enough; `preferred_first` orders several sources of one
sensor's measurements.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log.disk_columns import every, spilled
from rovgraph.model.config_sections import FASTEST_MPS, SLOWEST_MPS


@dataclass(frozen=True)
class Clock:
    """A clock that stamps some of a file's channels.

    Attributes
    ----------
    name : such as "autopilot's boot time", for the report
    unix_offset : what its stamps lack of Unix time [s]; 0 = they are Unix time; None = not known
    offset_sd : how well that is known [s]
    source : how it was found, such as "GPS week and milliseconds"; "" where it is not known
    cycle : where ``unix_offset`` is None, its stamps are Unix time but for whole multiples of this, such as times of
        day [s]; 0 = nothing is known of them
    """

    name: str
    unix_offset: float | None = None
    offset_sd: float = 0.0
    source: str = ""
    cycle: float = 0.0


@dataclass(frozen=True)
class Channel:
    """Measurements of one sensor, as columns of a log (docs/log-format.md).

    Attributes
    ----------
    sensor : name of its stream in a log ("imu", "dvl", "depth", ...); one of "depth" may have the column ``pressure``
    columns : column -> ndarray, shape (n,), SI and radians, ``time`` [s] among them; NaN = not valid. Not to be
        changed: long ones are in temporary files (`rovgraph.log.disk_columns`)
    source : where in the file it comes from, such as "IMU instance 0: AccX, AccY, AccZ, GyrX, GyrY, GyrZ"
    frame : the axes of its values, in words; "" for scalars
    clock : name of the `Clock` that stamps it
    received : when each row arrived, on the clock ``receiver``, ndarray, shape (n,); None = not recorded
    receiver : name of the `Clock` of ``received``
    """

    sensor: str
    columns: Mapping[str, Array]
    source: str
    frame: str = ""
    clock: str = ""
    received: Array | None = None
    receiver: str = ""


def in_files(channel: Channel) -> Channel:
    """The same, its long columns in temporary files."""
    columns = {name: spilled(values) for name, values in channel.columns.items()}
    return replace(channel, columns=columns, received=None if channel.received is None else spilled(channel.received))


def earlier(recording: "Recording", delay: float) -> "Recording":
    """The same, all of its stamps earlier by a delay [s]."""

    def shifted(columns: Mapping[str, Array]) -> dict[str, Array]:
        return {name: values - delay if name == "time" else values for name, values in columns.items()}

    channels = tuple(replace(channel, columns=shifted(channel.columns)) for channel in recording.channels)
    return replace(recording, channels=channels, tables={n: shifted(table) for n, table in recording.tables.items()})


@dataclass(frozen=True)
class Left:
    """Messages, records or topics of a file that are not in the log.

    Attributes
    ----------
    name : as the file calls them
    count : how many there are
    reason : why they were left
    """

    name: str
    count: int
    reason: str


@dataclass(frozen=True)
class Piece:
    """One of several consecutive files that are read as one recording.

    Attributes
    ----------
    path : the file, as given
    first, last : of its stamps, by the clocks of the recording [s]
    rows : of all its channels
    again : of these, that the piece before has as well
    """

    path: str
    first: float
    last: float
    rows: int
    again: int


@dataclass(frozen=True)
class Recording:
    """A native file as channels of a log.

    Attributes
    ----------
    path : the file, as given; of several pieces, the first
    format : name of the format that it is in
    channels : what goes into the log; several of one sensor are alternatives, the preferred one first
    clocks : name -> Clock, of every channel's clock
    left : what the file holds beside that
    settings : configuration from the file (mountings, lever arms, declination, ...), nested as in YAML
    notes : assumptions and what was found on the way, a sentence each
    warnings : what looks wrong, a sentence each
    tables : other tables that are worth keeping (name -> column -> ndarray, shape (n,)), with a column ``time`` [s] by
        the clock of the DVL's channels, or of the first channel without one. ``dvl_beams`` has what each beam
        of the DVL measured, its columns as `rovgraph.log.companions` names them
    pieces : the files that it was joined of, in the order of time; () = it is one file
    assumed : section of ``settings`` that is assumed -> its sentence in ``warnings``
    """

    path: str
    format: str
    channels: tuple[Channel, ...]
    clocks: Mapping[str, Clock]
    left: tuple[Left, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    tables: Mapping[str, Mapping[str, Array]] = field(default_factory=dict)
    pieces: tuple[Piece, ...] = ()
    assumed: Mapping[str, str] = field(default_factory=dict)

    @property
    def names(self) -> set[str]:
        """What its files may be called in options: path, name, and name without suffix."""
        paths = [Path(path) for path in (self.path, *(piece.path for piece in self.pieces))]
        return {text for path in paths for text in (str(path), path.name, path.stem)}

    def unix_offset(self, clock: str) -> float | None:
        """What the stamps of one of its clocks lack of Unix time [s]; None = not known."""
        return self.clocks[clock].unix_offset if clock in self.clocks else None


def sound_of_dvl(time: Array, speed: Array, temperature: Array, source: str, clock: str) -> tuple[list[Channel], Any]:
    """The speed of sound that a DVL worked with, where its file states it, and the temperature at its head.

    Parameters
    ----------
    time, speed, temperature : ndarray, shape (n,) [s, m/s, deg C]; NaN = not known

    Returns
    -------
    channels : of the stream "dvl_sound"; none where nothing was measured
    settings : ``sound_speed_set_mps`` of the section ``dvl``: the speed, or "logged" where it changes
    """
    known = np.isfinite(time) & (speed > SLOWEST_MPS) & (speed < FASTEST_MPS)
    if not known.any():
        return [], {}
    fixed = bool(np.ptp(speed[known]) == 0.0)
    columns = {} if fixed else {"dvl_sound_speed": speed[known]}
    if np.isfinite(warm := temperature[known]).any() and np.nanmax(warm) > np.nanmin(warm):
        columns["water_temperature"] = warm
    channel = Channel("dvl_sound", {"time": time[known], **columns}, f"{source}: {', '.join(columns)}", "", clock)
    return [channel] if columns else [], {"sound_speed_set_mps": float(speed[known][0]) if fixed else "logged"}


SOME = 10_000  # stamps that a rate is taken from
SLOWEST_HZ = 8.0  # of an inertial unit; in between, the vehicle moves as it likes


def rate_hz(time: Array) -> float:
    """The usual rate of stamps that increase, of some thousands of them; 0 where none do."""
    some = max(len(time) // SOME, 1)
    step = every(time[1:], some) - every(time[:-1], some)
    return float(1.0 / np.median(step[step > 0.0])) if (step > 0.0).any() else 0.0


def too_slow(time: Array, source: str, remedy: str) -> list[str]:
    """A warning where an inertial unit's samples are too few to navigate by, else nothing."""
    rate = rate_hz(time)
    if rate >= SLOWEST_HZ:
        return []
    return [f"{source}: {rate:.2g} samples a second are too few to navigate by; {remedy}"]


class SourceMissing(InputError):
    """A file has a sensor, and not the source of it that was chosen; another file may.

    Attributes
    ----------
    sensor : name of its stream in a log
    """

    def __init__(self, text: str, sensor: str) -> None:
        super().__init__(text)
        self.sensor = sensor


def preferred_first(path: Path, sensor: str, labels: Sequence[str], choose: Mapping[str, str]) -> list[str]:
    """Sources of a sensor with what a user chose in front.

    Parameters
    ----------
    path : of the file, for messages
    sensor : name of its stream in a log
    labels : a message and, where there are several, its instance, such as "IMU 1"; the best first
    choose : sensor -> a label, or its instance alone

    Raises
    ------
    SourceMissing : none is called so
    """
    wanted = choose.get(sensor)
    if wanted is None or not labels:
        return list(labels)
    if not any(_means(wanted, label) for label in labels):
        text = f"{path}: {sensor} cannot come from {wanted!r}; choose one of: {', '.join(labels)}"
        raise SourceMissing(text, sensor)
    return sorted(labels, key=lambda label: not _means(wanted, label))


def _means(wanted: str, label: str) -> bool:
    return wanted.casefold() in (label.casefold(), label.rpartition(" ")[2].casefold())
