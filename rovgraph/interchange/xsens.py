"""Text exports of Xsens' MT Manager: ``//`` lines of a header, names of columns, a row per packet.

Columns are in m/s2, rad/s, the calibrated field's own unit and degrees, as MT Manager writes them. ``PacketCounter``
and ``SampleTimeFine`` (0.1 ms) wrap.
"""

import re
from collections import Counter
from pathlib import Path

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.interchange.formats import Options
from rovgraph.interchange.inertial import Account, Measured, recording_of_inertial
from rovgraph.interchange.recording import Clock, Recording

FINE_S, FINE_WRAP = 1e-4, 2**32
COUNTER_WRAP = 2**16
IMU = tuple(f"{name}_{axis}" for name in ("Acc", "Gyr") for axis in "XYZ")
MAG = ("Mag_X", "Mag_Y", "Mag_Z")
ANGLES = ("Roll", "Pitch", "Yaw")
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
        return recording_of(path, self.name, table, "".join(header), left, options)


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


def recording_of(
    path: Path, format_: str, table: dict[str, Array], header: str, left: Counter[str], options: Options
) -> Recording:
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
    if not {*IMU} <= table.keys():
        raise InputError(f"{path}: lacks acceleration or rate (Acc_X, Gyr_X, ...); it has: {', '.join(table)[:200]}")
    time, notes = _times(path, table, header)
    account = Account(notes, left=Counter({("rows", why): count for why, count in left.items()}))
    found = [Measured("imu", "Acc, Gyr", time, np.column_stack([table[name] for name in IMU]))]
    if {*MAG} <= table.keys():
        found.append(Measured("mag", "Mag", time, np.column_stack([table[name] for name in MAG])))
    if {*ANGLES} <= table.keys():
        stated = re.search(r"coordinate system:.*?\b(ENU|NWU|NED)\b", header, re.IGNORECASE)
        world = stated[1].upper() if stated else "ENU"
        if not stated:
            account.warnings.append(
                "the header names no coordinate system: Roll, Pitch and Yaw are taken relative to ENU"
            )
        angles = np.deg2rad(np.column_stack([table[name] for name in ANGLES]))
        found.append(Measured("ahrs", f"Roll, Pitch, Yaw, {world}", time, angles, world=world))
    return recording_of_inertial(path, format_, found, Clock(SENSOR), account, options)


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
