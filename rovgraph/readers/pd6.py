"""Teledyne PD6: sentences of text, a few for each ping, as DVLs of several makers send them.

Velocities are those of the vehicle. Source: Teledyne RD Instruments, Navigator Technical Manual, P/N 957-6172-00, PD6
data output format.
"""

import calendar
import math
import re
from collections import Counter
from pathlib import Path

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array, matrix_from_rpy
from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.recording import Channel, Clock, Left, Recording
from rovgraph.readers.trdi import DOWN, FORWARD

TAGS = ("SA", "TS", "WI", "WS", "WE", "WD", "BI", "BS", "BE", "BD")
SENTENCE = re.compile(rb"^:(" + "|".join(TAGS).encode() + rb"),([-+0-9., AV]*)$")
FEW = 2  # sentences that make a file of them
CLOCK = "DVL's clock"
ZONE_SD_S = 6 * 3600.0  # of a clock without a stated time zone
LONGEST = 200  # bytes of a sentence
PREFERRED = {"B": ("BI", "BS", "BE"), "W": ("WI", "WS", "WE")}  # instrument's axes, the ship's, Earth's
COLUMNS = {"B": ("dvl_vx", "dvl_vy", "dvl_vz"), "W": ("dvl_water_vx", "dvl_water_vy", "dvl_water_vz")}
FRAME = "forward (beam 3, or the ship's bow), starboard, down"
Values = dict[str, float]


class Pd6Sentences:
    """Makes columns of a log of one sentence after the other.

    Attributes
    ----------
    time : of the present ping [s since 1970, its calendar taken for UTC]; None = none yet
    """

    def __init__(self) -> None:
        self.time: float | None = None
        self._rpy: Array | None = None
        self._attitude_said: Values = {}
        self._best: dict[str, str] = {}

    def columns(self, line: bytes) -> Values | None:
        """The sensor values of a sentence, in SI; None for other sentences.

        A ping has the same velocity in several axes; only the best ones that were heard are taken.
        """
        found = SENTENCE.match(line.strip())
        if found is None:
            return None
        tag, cells = found[1].decode(), [cell.strip() for cell in found[2].decode().split(",")]
        try:
            if tag == "TS":
                return self._stamped(cells)
            if tag == "SA":
                return self._attitude(cells)
            if tag in ("BD", "WD"):
                distance = float(cells[3])
                return {"dvl_altitude": distance} if tag == "BD" and distance > 0.0 else {}
            return self._velocity(tag, cells)
        except (ValueError, IndexError, OverflowError):
            return None

    def _stamped(self, cells: list[str]) -> Values:
        year, month, day, hour, minute, second, hundredths = (int(cells[0][k : k + 2]) for k in range(0, 14, 2))
        if not (1 <= month <= 12 and 1 <= day <= 31 and hour < 24 and minute < 60 and second < 60):
            raise ValueError
        self.time = calendar.timegm((2000 + year, month, day, hour, minute, second)) + 0.01 * hundredths
        attitude, self._attitude_said = self._attitude_said, {}
        return {"depth": float(cells[3])} | attitude

    def _attitude(self, cells: list[str]) -> Values:
        pitch, roll, heading = (math.radians(float(cell)) for cell in cells[:3])
        self._rpy = np.array([roll, pitch, heading])
        self._attitude_said = {"dvl_heading": heading, "roll": roll, "pitch": pitch}
        return {}  # the time comes next

    def _velocity(self, tag: str, cells: list[str]) -> Values:
        preferred = PREFERRED[tag[0]]
        best = self._best.setdefault(tag[0], tag)
        if preferred.index(tag) > preferred.index(best):
            return {}
        self._best[tag[0]] = tag
        good = cells[-1] == "A"
        x, y, z = (0.001 * float(cell) for cell in cells[:3])
        velocity = np.array([x, y, z])[FORWARD] * DOWN
        if tag[1] == "E":
            if self._rpy is None:
                raise ValueError
            velocity = velocity @ matrix_from_rpy(self._rpy)
        values = velocity if good else np.full(3, np.nan)
        columns = dict(zip(COLUMNS[tag[0]], values.tolist(), strict=True))
        return columns | ({"dvl_valid": float(good)} if tag[0] == "B" else {})


SENSORS = {
    "dvl": (*COLUMNS["B"], "dvl_valid"),
    "dvl_water": COLUMNS["W"],
    "dvl_altitude": ("dvl_altitude",),
    "dvl_heading": ("dvl_heading",),
    "vehicle_tilt": ("roll", "pitch"),
    "depth": ("depth",),
}


class PD6:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "pd6"
    title = "Teledyne PD6 sentences"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        known = sum(SENTENCE.match(line.strip()) is not None for line in head.splitlines()[:50])
        return 0.9 if known >= FEW else 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        sentences, lost, size, done = Pd6Sentences(), Counter[str](), path.stat().st_size, 0
        rows: dict[str, list[tuple[float, ...]]] = {sensor: [] for sensor in SENSORS}
        with path.open("rb") as file:
            while line := file.readline(LONGEST):
                done += len(line)
                options.progress(done, size)
                cells = sentences.columns(line)
                if cells is None:
                    lost["a line that is no whole sentence"] += bool(line.strip())
                elif cells and sentences.time is None:
                    lost["before the first time (:TS)"] += 1
                elif cells and sentences.time is not None:
                    _keep(rows, sentences.time, cells)
        channels = tuple(_channel(sensor, SENSORS[sensor], found) for sensor, found in rows.items() if found)
        if not channels:
            raise InputError(f"{path}: no sentence of a sensor behind a time (:TS); record :TS, :SA and :BI")
        left = tuple(Left("sentence", count, reason) for reason, count in lost.items() if count)
        warnings = tuple(f"{each.count} sentences are left out: {each.reason}" for each in left)
        clock = Clock(CLOCK, 0.0, ZONE_SD_S, "its calendar, taken for UTC")
        return Recording(str(path), self.name, channels, {CLOCK: clock}, left, warnings=warnings)


FORMAT = PD6()


def _keep(rows: dict[str, list[tuple[float, ...]]], time: float, said: Values) -> None:
    for sensor, columns in SENSORS.items():
        if columns[0] in said:
            rows[sensor].append((time, *(said[column] for column in columns)))


def _channel(sensor: str, columns: tuple[str, ...], rows: list[tuple[float, ...]]) -> Channel:
    values = np.array(rows)
    last = np.append(np.diff(values[:, 0]) != 0.0, True)  # of a better sentence for the same ping, that
    named = dict(zip(("time", *columns), values[last].T, strict=True))
    return Channel(sensor, named, f"sentences: {', '.join(columns)}", FRAME if len(columns) > 1 else "", CLOCK)
