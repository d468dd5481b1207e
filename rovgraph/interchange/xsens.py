"""Text exports of Xsens' MT Manager: ``//`` lines of a header, names of columns, a row per packet.

Columns are in m/s2, rad/s, the calibrated field's own unit and degrees, as MT Manager writes them. ``PacketCounter``
and ``SampleTimeFine`` (0.1 ms) wrap.
"""

import re
from collections import Counter
from pathlib import Path

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array, matrix_from_rpy, rpy_from_matrix
from rovgraph.interchange.formats import Options
from rovgraph.interchange.rates import too_slow
from rovgraph.interchange.recording import Channel, Clock, Left, Recording

FINE_S, FINE_WRAP = 1e-4, 2**32
COUNTER_WRAP = 2**16
IMU = {f"{ours}_{a}": f"{theirs}_{a.upper()}" for ours, theirs in (("acc", "Acc"), ("gyr", "Gyr")) for a in "xyz"}
MAG = {f"mag_{a}": f"Mag_{a.upper()}" for a in "xyz"}
ANGLES = ("Roll", "Pitch", "Yaw")
WORLDS = {  # to NED, of the coordinate systems that a header names
    "ENU": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    "NWU": np.diag([1.0, -1.0, -1.0]),
    "NED": np.eye(3),
}
SENSOR = "the IMU's time"
LONGEST = 1 << 14


class Xsens:
    """The format; see `rovgraph.interchange.formats.Format`."""

    name = "xsens"
    title = "Xsens MT Manager text export"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        names = next((line for line in head.split(b"\n")[:60] if line.strip() and not line.startswith(b"//")), b"")
        return 0.9 if {"PacketCounter", "SampleTimeFine"} & set(_cells(names)) else 0.0

    def read(self, path: Path, options: Options) -> Recording:
        header: list[str] = []
        names: list[str] = []
        left: Counter[str] = Counter()
        rows: list[list[float]] = []
        size = path.stat().st_size
        with path.open("rb") as file:
            while line := file.readline(LONGEST):
                options.progress(min(file.tell(), size), size)
                if line.startswith(b"//"):
                    header.append(line.decode("utf-8", "replace"))
                elif not names:
                    names = _cells(line) if line.strip() else []
                elif (row := _row(line, len(names), left)) is not None:
                    rows.append(row)
        if not rows:
            raise InputError(f"{path}: holds no row of measurements; export it again with Acc, Gyr and SampleTimeFine")
        table = dict(zip(names, np.array(rows).T, strict=True))
        return recording_of(path, self.name, table, "".join(header), left)


FORMAT = Xsens()


def _cells(line: bytes) -> list[str]:
    text = line.decode("utf-8-sig", "replace").strip("\r\n")
    return [cell.strip() for cell in re.split(r"[\t;,]", text)]


def _row(line: bytes, count: int, left: Counter[str]) -> list[float] | None:
    cells = _cells(line)
    if len(cells) == count + 1 and not cells[-1]:  # some versions end a line with a tab
        del cells[-1]
    if len(cells) != count:
        left["more or fewer cells than the names"] += bool(line.strip())
        return None
    try:
        return [float(cell) if cell else np.nan for cell in cells]
    except ValueError:
        left["a cell that is no number"] += 1
        return None


def recording_of(path: Path, format_: str, table: dict[str, Array], header: str, left: Counter[str]) -> Recording:
    """What the columns of a file become.

    Parameters
    ----------
    path, format_ : the file, and the name of its format
    table : name of MT Manager -> column, all of one length; m/s^2, rad/s, degrees
    header : names the coordinate system, and the rate where there is no ``SampleTimeFine``
    left : why rows were left out -> how many

    Raises
    ------
    InputError : no acceleration, rate or time
    """
    if not {*IMU.values()} <= table.keys():
        raise InputError(f"{path}: lacks acceleration or rate (Acc_X, Gyr_X, ...); it has: {', '.join(table)[:200]}")
    time, notes = _times(path, table, header)
    keep = np.isfinite(time)
    if not keep.all():
        left["a row without a time"] += int((~keep).sum())
    table, time = {name: values[keep] for name, values in table.items()}, time[keep]
    frame, warnings = "the IMU's", []
    imu = {ours: table[theirs] for ours, theirs in IMU.items()}
    channels = [Channel("imu", {"time": time, **imu}, "Acc, Gyr", frame, SENSOR)]
    if {*MAG.values()} <= table.keys():
        field = {ours: table[theirs] for ours, theirs in MAG.items()}
        channels.append(Channel("mag", {"time": time, **field}, "Mag", frame, SENSOR))
    if {*ANGLES} <= table.keys():
        stated = re.search(r"coordinate system:.*?\b(ENU|NWU|NED)\b", header, re.IGNORECASE)
        world = stated[1].upper() if stated else "ENU"
        if not stated:
            warnings.append("the header names no coordinate system: Roll, Pitch and Yaw are taken relative to ENU")
        angles = np.deg2rad(np.column_stack([table[name] for name in ANGLES]))
        found = rpy_from_matrix(WORLDS[world] @ matrix_from_rpy(angles))
        columns = {f"ahrs_{name.lower()}": found[:, k] for k, name in enumerate(ANGLES)}
        channels.append(Channel("ahrs", {"time": time, **columns}, f"Roll, Pitch, Yaw, {world}", frame, SENSOR))
    up = bool(np.nanmean(imu["acc_z"]) > 0.0)
    axes = "x forward, y left, z up" if up else "x forward, y right, z down"
    warnings.append(f"the IMU's axes are taken as {axes}, as gravity has it: check the mounting")
    warnings += too_slow(time, "Acc, Gyr", "export at 50 Hz or more")
    return Recording(
        str(path),
        format_,
        tuple(channels),
        {SENSOR: Clock(SENSOR)},
        tuple(Left("rows", count, why) for why, count in sorted(left.items()) if count),
        {"imu": {"mount_rpy_deg": [180.0 if up else 0.0, 0.0, 0.0]}},
        tuple(notes),
        tuple(warnings),
    )


def _times(path: Path, table: dict[str, Array], header: str) -> tuple[Array, list[str]]:
    """Stamps [s], of ``SampleTimeFine``, else of ``PacketCounter`` and the rate that the header states."""
    fine = table.get("SampleTimeFine")
    if fine is not None and np.isfinite(fine).any():
        return FINE_S * _unwrapped(fine, FINE_WRAP), []
    rate = re.search(r"(?:sample|update) ?rate:\s*([0-9.]+)", header, re.IGNORECASE)
    if rate is None or float(rate[1].strip(".") or 0.0) <= 0.0:
        raise InputError(f"{path}: has neither SampleTimeFine nor a rate in its header; export it with SampleTimeFine")
    hertz = float(rate[1].strip("."))
    note = f"times are PacketCounter by the header's rate of {hertz:g} Hz"
    return _unwrapped(table["PacketCounter"], COUNTER_WRAP) / hertz, [note]


def _unwrapped(count: Array, wrap: int) -> Array:
    """A counter without its wraps; it wraps where it goes back by more than half its range."""
    out = np.full(len(count), np.nan)
    known = np.isfinite(count)
    values = count[known]
    out[known] = values + wrap * np.concatenate([[0], np.cumsum(np.diff(values) < -0.5 * wrap)])
    return out
