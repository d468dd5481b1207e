"""Reports of Water Linked's DVLs, live and in files: JSON lines as their TCP port sends them, or rows of a CSV.

The CSV is that of the maker's own script, https://github.com/waterlinked/dvl-python, whose ``log_time`` is of arrival,
in microseconds of the recorder's Unix time.

Source: https://docs.waterlinked.com/dvl/dvl-protocol: ``time_of_validity`` is that of the reflection,
``time_of_transmission`` when the report leaves the DVL, both in microseconds of its clock; ``time`` is the
milliseconds since the last report, and no stamp.
"""

import csv
import json
import math
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.recording import Channel, Clock, Left, Recording
from rovgraph.readers.records import Refused, json_number, json_object, shown
from rovgraph.sensors.dvl_beam import BEAMS, NUMBERS, QUANTITIES

VELOCITIES = ("velocity", "velocity_water")
FORMATS = ("json_v1", "json_v2", "json_v3")  # minor versions, as json_v3.2, only add to them
STAMPED = "json_v3"  # the first with a time of validity
UNTYPED = "json_v1"  # whose reports state no type, and are velocities
_OTHERS = ("position_local", "response")


@dataclass(frozen=True)
class VelocityReport:
    """A velocity report.

    Attributes
    ----------
    water : of the velocity relative to the water, not to the bottom
    velocity : x, y, z of the instrument's axes [m/s]; None = not valid
    sd : of the velocity, per axis [m/s]; NaN = not known
    altitude : [m]; None = not known
    validity, transmission : by the DVL's clock [s]; None = not reported
    fault : the DVL reports one, such as being too hot
    """

    water: bool
    velocity: tuple[float, float, float] | None
    sd: float
    altitude: float | None
    validity: float | None
    transmission: float | None
    fault: bool


def is_report(row: dict[str, Any]) -> bool:
    """Whether a JSON object is one of this protocol."""
    return _type(row) in (*VELOCITIES, *_OTHERS) and "format" in row


def _type(row: dict[str, Any]) -> object:
    untyped = "type" not in row and "velocity_valid" in row and str(row.get("format")).startswith(UNTYPED)
    return "velocity" if untyped else row.get("type")


def velocity_report(row: dict[str, Any]) -> VelocityReport | None:
    """The velocity of a report; None for another kind of report.

    Raises
    ------
    Refused : it is to be skipped
    """
    if _type(row) in _OTHERS:
        return None
    _check(row)
    water = row.get("type") == "velocity_water" or row.get("tracking_mode") == "water"
    velocity = sd = altitude = None
    if row["velocity_valid"]:
        x, y, z = (json_number(name, row.get(name)) for name in ("vx", "vy", "vz"))
        velocity, sd = (x, y, z), _velocity_sd(row)
        altitude = None if water or row.get("altitude") is None else json_number("altitude", row["altitude"])
    return VelocityReport(
        water,
        velocity,
        math.nan if sd is None else sd,
        altitude if altitude is not None and altitude > 0.0 else None,  # -1 = none
        _time(row, "time_of_validity"),
        _time(row, "time_of_transmission"),
        bool(row.get("status")),
    )


def beam_cells(row: dict[str, Any]) -> dict[str, float]:
    """What the beams of a report of bottom track measured, by the columns of a log; NaN = no number."""
    beams = row.get("transducers")
    if not isinstance(beams, list) or row.get("type") == "velocity_water" or row.get("tracking_mode") == "water":
        return {}
    known = [beam for beam in beams if isinstance(beam, dict) and _number(beam.get("id")) in NUMBERS]
    return {
        f"dvl_beam_{quantity}_{int(_number(beam['id']))}": _number(beam.get(name))
        for beam in known
        for name, quantity in _BEAM.items()
        if quantity in QUANTITIES
    }


def _check(row: dict[str, Any]) -> None:
    if _type(row) not in VELOCITIES:
        raise Refused("unknown report", f"a report of type {shown(str(row.get('type')))} is ignored")
    if not str(row.get("format")).startswith(FORMATS):
        text = f"format {shown(str(row.get('format')))}, expected {STAMPED}"
        raise Refused("unknown format", text)
    if not isinstance(row.get("velocity_valid"), bool):
        raise Refused("malformed", "a velocity report without velocity_valid is skipped")


def _time(row: dict[str, Any], name: str) -> float | None:
    time = row.get(name)
    return None if time is None else 1e-6 * json_number(name, time)


def _velocity_sd(row: dict[str, Any]) -> float:
    """Of the covariance's trace, else the figure of merit, else NaN."""
    try:
        variances = [json_number("covariance", row["covariance"][i][i]) for i in range(3)]
        if min(variances) >= 0.0 and sum(variances) > 0.0:
            return math.sqrt(sum(variances) / 3.0)
    except (Refused, LookupError, TypeError):
        pass
    try:
        merit = json_number("fom", row.get("fom"))
    except Refused:
        merit = 0.0
    return merit if merit > 0.0 else math.nan


DVL, RECORDER, ELAPSED = "DVL", "recorder", "DVL's time between reports"
SET = 1e9  # [s] since 1970: a clock that shows less has never been set
SET_SD_S = 0.05  # how well a network sets a clock, a choice
RESET_S = 1.0  # a clock that goes back further was set, or restarted
LONGEST = 1 << 16  # bytes of a line
FRAME = "the DVL's: x forward, y starboard, z down, turned by its own mounting_rotation_offset"
_CSV = {"vx", "vy", "vz", "velocity_valid"}
_NUMBERS = (
    "vx",
    "vy",
    "vz",
    "fom",
    "altitude",
    "time",
    "time_of_validity",
    "time_of_transmission",
    "log_time",
    "status",
)
_BEAM = {  # of a transducer -> quantity of a beam
    "velocity": "velocity",
    "distance": "range",  # along the beam: their mean is the altitude over the cosine of 22.5 deg
    "rssi": "rssi",
    "nsd": "nsd",
    "beam_valid": "valid",
}
_POSITION = ("ts", "x", "y", "z", "std", "roll", "pitch", "yaw")


class WaterLinked:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "waterlinked"
    title = "Water Linked DVL log (JSON lines or CSV)"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        if set(_header(head)) >= _CSV:
            return 0.9
        for line in head.split(b"\n")[:5]:  # the first may be cut off at its beginning
            try:
                if is_report(json_object(line)):
                    return 0.95
            except Refused:
                continue
        return 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        reports = _Reports()
        with path.open("rb") as file:
            rows = _csv_rows if set(_header(file.readline(LONGEST))) >= _CSV else _json_rows
            file.seek(0)
            size = path.stat().st_size
            for row in rows(file, reports.left):
                options.progress(min(file.tell(), size), size)
                reports.take(row)
        return reports.recording(path, self.name)


FORMAT = WaterLinked()


def _header(head: bytes) -> list[str]:
    line = head.partition(b"\n")[0].decode("utf-8-sig", "replace")
    return [name.strip() for name in line.split(",")]


def _json_rows(file: Any, left: Counter[tuple[str, str]]) -> Iterator[dict[str, Any]]:
    while line := file.readline(LONGEST):
        try:
            if line.strip():
                yield json_object(line.strip())
        except Refused as refused:
            left["lines", refused.kind] += 1


def _csv_rows(file: Any, left: Counter[tuple[str, str]]) -> Iterator[dict[str, Any]]:
    """Rows as the reports that they were."""
    names = _header(file.readline(LONGEST))
    while line := file.readline(LONGEST):
        cells = next(csv.reader([line.decode("utf-8", "replace").replace("\0", " ").strip()]), [])
        if len(cells) != len(names):
            left["lines", "more or fewer cells than the header"] += bool(cells)
            continue
        row: dict[str, Any] = {name: cell.strip() for name, cell in zip(names, cells, strict=True)}
        try:
            row |= {name: float(row[name]) if row[name] else None for name in _NUMBERS if name in row}
            covariance = json.loads(row.get("covariance") or "null")
        except (ValueError, RecursionError):
            left["lines", "a cell that is no number"] += 1
            continue
        valid = {"true": True, "1": True, "1.0": True, "false": False, "0": False, "0.0": False}
        row |= {"velocity_valid": valid.get(row["velocity_valid"].lower()), "covariance": covariance}
        yield {"type": "velocity", "format": "json_v3", **{k: v for k, v in row.items() if v != ""}}


class _Reports:
    """Takes reports one by one."""

    def __init__(self) -> None:
        self.left: Counter[tuple[str, str]] = Counter()
        self.notes: list[str] = []
        self.warnings: list[str] = []
        self._rows = array("d")  # of `_ROW`
        self._beams = array("d")  # row, id, `_BEAM`
        self._position = array("d")  # `_POSITION`
        self._speeds: set[float] = set()  # of sound, that it was set to [m/s]
        self._faults = self._taken = 0

    def take(self, row: dict[str, Any]) -> None:
        kind = _type(row)
        try:
            if kind == "response":
                self._response(row)
            elif kind == "position_local":
                self._position.extend(json_number(name, row.get(name)) for name in _POSITION)
                self.left["position_local", "the DVL's own dead reckoning, kept as a table"] += 1
            elif (report := velocity_report(row)) is not None:
                self._take(report, row)
        except Refused as refused:
            whole = len(self._position) // len(_POSITION) * len(_POSITION)
            del self._position[whole:]
            self.left[str(kind) if kind in ("velocity", "velocity_water") else "others", refused.kind] += 1

    def _take(self, report: VelocityReport, row: dict[str, Any]) -> None:
        log_time, since = (_number(row.get(name)) for name in ("log_time", "time"))
        velocity = (math.nan,) * 3 if report.velocity is None else report.velocity
        validity = math.nan if report.validity is None else report.validity
        altitude = math.nan if report.altitude is None else report.altitude
        self._rows.extend((validity, 1e-6 * log_time, 1e-3 * since, report.water, *velocity, report.sd, altitude))
        self._faults += report.fault
        beams = row.get("transducers")
        for beam in beams[: len(NUMBERS)] if isinstance(beams, list) and not report.water else ():
            if isinstance(beam, dict) and _number(beam.get("id")) in NUMBERS:
                self._beams.extend((self._taken, *(_number(beam.get(name)) for name in ("id", *_BEAM))))
        self._taken += 1

    def _response(self, row: dict[str, Any]) -> None:
        self.left["response", "answers to commands"] += 1
        result = row.get("result")
        if isinstance(result, dict):
            said = [
                f"{name} {result[name]}" for name in ("speed_of_sound", "mounting_rotation_offset") if name in result
            ]
            note = f"the DVL's settings: {', '.join(said)}"
            if said and note not in self.notes:
                self.notes.append(note)
            if (speed := _number(result.get("speed_of_sound"))) > 0.0:
                self._speeds.add(speed)

    def recording(self, path: Path, format_: str) -> Recording:
        """All that was taken.

        Raises
        ------
        InputError : no velocity, no time
        """
        if not self._rows:
            found = ", ".join(f"{name}: {count} ({why})" for (name, why), count in self.left.items()) or "nothing"
            raise InputError(f"{path}: holds no velocity report of a Water Linked DVL; found {found}")
        table = np.frombuffer(self._rows).reshape(-1, 9)
        keep, time, clock = self._times(path, table)
        if self._faults:
            self.warnings.append(f"the DVL reported a fault, such as being too hot, {self._faults} times")
        table, arrived = table[keep], np.isfinite(table[keep, 1]).all()
        clocks = {clock.name: clock}
        if arrived:
            clocks[RECORDER] = Clock(RECORDER, 0.0, 0.0, "its stamps are Unix time")
        channels = tuple(self._channels(table, time, clock.name, arrived))
        left = tuple(Left(name, count, why) for (name, why), count in sorted(self.left.items()) if count)
        notes, warnings = tuple(self.notes), tuple(self.warnings)
        settings = {"dvl": {"sound_speed_set_mps": min(self._speeds)}} if len(self._speeds) == 1 else {}
        return Recording(
            str(path), format_, channels, clocks, left, settings, notes, warnings, self._tables(keep, time)
        )

    def _times(self, path: Path, table: Array) -> tuple[Array, Array, Clock]:
        """Which reports can be used, when they were valid [s], and by which clock."""
        validity, log_time, since = table[:, :3].T
        stamped = np.isfinite(validity)
        if stamped.mean() > 0.5:
            if not stamped.all():
                self.left["velocity", "no time_of_validity"] += int((~stamped).sum())
            return self._by_dvl(stamped, validity, since)
        if np.isfinite(log_time).all():
            self.warnings.append("no time_of_validity: stamps are of arrival, 50 to 150 ms late; state delay_s.dvl")
            return np.ones(len(table), bool), log_time, Clock(RECORDER, 0.0, 0.0, "its stamps are Unix time")
        if np.isfinite(since).all():
            self.warnings.append(
                "no time_of_validity: times are sums of the milliseconds since the last report; where reports are "
                "missing from the file, all later ones are too early"
            )
            return np.ones(len(table), bool), np.cumsum(since) - since[0], Clock(ELAPSED)
        raise InputError(f"{path}: has reports without a time; record time_of_validity as the DVL sends it")

    def _by_dvl(self, stamped: Array, validity: Array, since: Array) -> tuple[Array, Array, Clock]:
        """Stamps of a clock that may have been set meanwhile, or have restarted."""
        index = np.flatnonzero(stamped)
        time = validity[index].copy()
        set_at = np.flatnonzero((time[:-1] < SET) & (time[1:] >= SET)) + 1
        for at in set_at.tolist():  # the report itself has the time since the last one
            step = since[index[at]]
            if np.isfinite(step) and 0.0 <= step < 60.0:
                shift = time[at] - step - time[at - 1]
                begin = max([0, *(np.flatnonzero(np.diff(time[:at]) < -RESET_S) + 1).tolist()])
                time[begin:at] += shift
                self.warnings.append(
                    f"the DVL's clock was set by {shift:+.1f} s meanwhile; what came before is put on it"
                )
        new = (np.diff(time) < -RESET_S) | ((time[:-1] < SET) & (time[1:] >= SET))
        bounds = np.concatenate([[0], np.flatnonzero(new) + 1, [len(time)]])
        if len(bounds) > 2:
            longest = int(np.argmax(np.diff(bounds)))
            keep = slice(bounds[longest], bounds[longest + 1])
            lost = len(time) - len(time[keep])
            self.left["velocity", "of another run of the DVL's clock"] += lost
            self.warnings.append(f"the DVL's clock jumped {len(bounds) - 2} times; the longest run is read")
            index, time = index[keep], time[keep]
        known = len(time) > 0 and bool(time[0] >= SET)
        if not known:
            self.notes.append("the DVL's clock was not set: its stamps count from its start")
        clock = Clock(DVL, 0.0, SET_SD_S, "its stamps are Unix time") if known else Clock(DVL)
        mask = np.zeros(len(stamped), bool)
        mask[index] = True
        return mask, time, clock

    def _channels(self, table: Array, time: Array, clock: str, arrived: bool) -> Iterator[Channel]:
        water = table[:, 3] == 1.0

        def channel(sensor: str, rows: Array, columns: dict[str, int], source: str, frame: str = FRAME) -> Channel:
            values = {"time": time[rows], **{name: table[rows, k] for name, k in columns.items()}}
            if sensor == "dvl":
                values["dvl_valid"] = np.isfinite(values["dvl_vx"]).astype(float)
            received = table[rows, 1] if arrived else None
            return Channel(sensor, values, source, frame, clock, received, RECORDER if arrived else "")

        if (~water).any():
            columns = {"dvl_vx": 4, "dvl_vy": 5, "dvl_vz": 6, "dvl_sd": 7}
            yield channel("dvl", ~water, columns, "velocity: vx, vy, vz, covariance or fom")
        if (valid := water & np.isfinite(table[:, 4])).any():
            columns = {"dvl_water_vx": 4, "dvl_water_vy": 5, "dvl_water_vz": 6}
            yield channel("dvl_water", valid, columns, "velocity_water: vx, vy, vz")
        if (high := np.isfinite(table[:, 8])).any():
            yield channel("dvl_altitude", high, {"dvl_altitude": 8}, "velocity: altitude", "")

    def _tables(self, keep: Array, time: Array) -> dict[str, dict[str, Array]]:
        found = {}
        beams = np.frombuffer(self._beams).reshape(-1, 2 + len(_BEAM))
        beams = beams[keep[beams[:, 0].astype(int)]]
        if len(beams):
            reports, row = np.unique(beams[:, 0].astype(int), return_inverse=True)
            numbers, column = np.unique(beams[:, 1].astype(int), return_inverse=True)
            found[BEAMS] = {"time": time[(np.cumsum(keep) - 1)[reports]]}
            for quantity, values in zip(_BEAM.values(), beams[:, 2:].T, strict=True):
                cells = np.full((len(reports), len(numbers)), np.nan)
                cells[row, column] = values
                found[BEAMS] |= {f"{quantity}_{number}": cells[:, k] for k, number in enumerate(numbers.tolist())}
        position = np.frombuffer(self._position).reshape(-1, len(_POSITION))
        if len(position):
            found["dvl_position"] = dict(zip(("time", *_POSITION[1:5]), position[:, :5].T, strict=True)) | {
                name: np.deg2rad(position[:, 5 + k]) for k, name in enumerate(_POSITION[5:])
            }
        return found


def _number(value: object) -> float:
    """A finite number, else NaN."""
    if isinstance(value, int | float) and abs(value) < 1e300:
        return float(value)
    return math.nan
