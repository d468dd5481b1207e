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
from rovgraph.log.stamps import unwrapped
from rovgraph.readers.formats import HEAD, ReadingOptions
from rovgraph.readers.inertial import Account, InertialMeasurement, recording_of_inertial
from rovgraph.readers.recording import Clock, Recording
from rovgraph.readers.text_table import TextLayout, cells_of, read_table

FINE_S, FINE_WRAP = 1e-4, 2**32
COUNTER_WRAP = 2**16
IMU = tuple(f"{name}_{axis}" for name in ("Acc", "Gyr") for axis in "XYZ")
MAG = ("Mag_X", "Mag_Y", "Mag_Z")
ANGLES = ("Roll", "Pitch", "Yaw")
SENSOR = "the IMU's time"
COUNTER, FINE = "PacketCounter", "SampleTimeFine"
KNOWN = {COUNTER, FINE, *IMU, *MAG, *ANGLES}


class Xsens:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "xsens"
    title = "Xsens MT Manager text export"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        layout = _layout(head)
        return 0.9 if layout is not None and {COUNTER, FINE} & set(layout.names) else 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        with path.open("rb") as file:
            head = file.read(HEAD)
        layout = _layout(head)
        if layout is None:
            raise InputError(f"{path}: no line names columns of MT Manager; export it again as text")
        table = read_table(path, layout, lambda name: (name, ""), KNOWN, options.progress)
        columns = {name: table[name] for name in table.columns}
        if not any(len(values) for values in columns.values()):
            raise InputError(f"{path}: holds no row of measurements; export it again with Acc, Gyr and SampleTimeFine")
        header = head[: layout.start].decode("utf-8", "replace")
        return recording_of(path, self.name, columns, header, table.left, options)


FORMAT = Xsens()


def _layout(head: bytes) -> TextLayout | None:
    """The first line that is neither blank nor of the header."""
    at = 0
    for line in head.splitlines(keepends=True):
        at += len(line)
        if line.strip() and not line.startswith(b"//"):
            separator = next((mark for mark in "\t;," if mark.encode() in line), ",")
            names = tuple(name for name in cells_of(line, separator) if name)  # some versions end a line with a tab
            return TextLayout(names, at, separator) if len(names) > 1 else None
    return None


def recording_of(
    path: Path, format_: str, table: dict[str, Array], header: str, left: Counter[str], options: ReadingOptions
) -> Recording:
    """Recording of the columns of a file.

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
    found = [InertialMeasurement("imu", "Acc, Gyr", time, np.column_stack([table[name] for name in IMU]))]
    if {*MAG} <= table.keys():
        found.append(InertialMeasurement("mag", "Mag", time, np.column_stack([table[name] for name in MAG])))
    if {*ANGLES} <= table.keys():
        stated = re.search(r"coordinate system:.*?\b(ENU|NWU|NED)\b", header, re.IGNORECASE)
        world = stated[1].upper() if stated else "ENU"
        if not stated:
            account.warnings.append(
                "the header names no coordinate system: Roll, Pitch and Yaw are taken relative to ENU"
            )
        angles = np.deg2rad(np.column_stack([table[name] for name in ANGLES]))
        found.append(InertialMeasurement("ahrs", f"Roll, Pitch, Yaw, {world}", time, angles, world=world))
    return recording_of_inertial(path, format_, found, Clock(SENSOR), account, options)


def _times(path: Path, table: dict[str, Array], header: str) -> tuple[Array, list[str]]:
    """Stamps [s], of ``SampleTimeFine``, else of ``PacketCounter`` and the rate that the header states."""
    fine = table.get(FINE)
    if fine is not None and np.isfinite(fine).any():
        return FINE_S * unwrapped(fine, FINE_WRAP), []
    rate = re.search(r"(?:sample|update) ?rate:\s*([0-9.]+)", header, re.IGNORECASE)
    if COUNTER not in table or rate is None or float(rate[1].strip(".") or 0.0) <= 0.0:
        raise InputError(f"{path}: has neither SampleTimeFine nor a rate in its header; export it with SampleTimeFine")
    hertz = float(rate[1].strip("."))
    note = f"times are PacketCounter by the header's rate of {hertz:g} Hz"
    return unwrapped(table[COUNTER], COUNTER_WRAP) / hertz, [note]
