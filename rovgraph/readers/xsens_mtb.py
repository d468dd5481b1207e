"""Xsens' binary recordings (MTB): XBus messages, of which MTData2 holds the measurements.

A message is ``FA``, bus, kind, length, data and a sum; bus to sum add up to 0 modulo 256. MTData2 is a sequence of
items: an identifier of two bytes, a size and big-endian numbers, whose last nibble names their precision (float, fixed
point 12.20 or 16.32, double) and the world of an attitude (ENU, NED, NWU). Its items feed the same columns as the text
export (`rovgraph.readers.xsens`).
"""

import mmap
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array, log_rotation, matrix_from_quaternion, rpy_from_matrix
from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.recording import Clock, Recording
from rovgraph.readers.records import ROWS
from rovgraph.readers.stamps import unix_of_calendar
from rovgraph.readers.xsens import FINE_S, SENSOR, recording_of

PREAMBLE, EXTENDED, MTDATA2, LEGACY = 0xFA, 0xFF, 0x36, 0x32
SURE = 3  # messages, each after the other, that nothing else has
PROGRESS = 1 << 20  # bytes
KIND, WORLD, PRECISION = 0xFFF0, 0xC, 0x3  # masks of an identifier
UTC_TIME, COUNTER, FINE, QUATERNION, EULER = 0x1010, 0x1020, 0x1060, 0x2010, 0x2030
DELTA_V, ACCELERATION, RATE, DELTA_Q, FIELD = 0x4010, 0x4020, 0x8020, 0x8030, 0xC020
COUNT = {QUATERNION: 4, EULER: 3, DELTA_V: 3, ACCELERATION: 3, RATE: 3, DELTA_Q: 4, FIELD: 3}  # numbers of each
WORLDS = {0x0: "ENU", 0x4: "NED", 0x8: "NWU"}
LEFT = {
    0x0810: "temperature of the IMU",
    0x3010: "pressure of the housing",
    0x4030: "acceleration without gravity, by the instrument's own filter",
    0x4040: "acceleration before calibration",
    0x5020: "height, by the instrument's own filter",
    0x5040: "position, by the instrument's own filter",
    0x7010: "GNSS",
    0x8040: "rate before calibration",
    0xD010: "velocity, by the instrument's own filter",
    0xE010: "status",
    0xE020: "status",
}
CALENDAR = ("year", "month", "day", "h", "min", "s")
UTC_FIELDS = np.dtype([("ns", ">u4"), ("year", ">u2"), *((name, "u1") for name in (*CALENDAR[1:], "flags"))])
UTC_VALID = 0x7  # date, time of day, and leap seconds known
UTC_SD_S = 0.01

Layout = tuple[tuple[int, int, int], ...]  # identifier, first byte, size of each item


class Mtb:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "mtb"
    title = "Xsens binary recording (MTB)"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        run, end = 0, -1
        for begin, at, length, _ in _messages(head, Counter()):
            run = run + 1 if begin == end else 1
            if run == SURE:
                return 0.9
            end = at + length + 1
        return 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        size, left = path.stat().st_size, Counter[str]()
        if not size:
            raise InputError(f"{path}: is empty")
        with path.open("rb") as file:
            content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        at: list[int] = []
        length: list[int] = []
        told = 0
        for begin, data, count, kind in _messages(content, left):
            if begin - told > PROGRESS:
                options.progress(told := begin, size)
            if kind == MTDATA2:
                at.append(data)
                length.append(count)
            else:
                left[_other(kind)] += 1
        options.progress(size, size)
        values, worlds = _values(np.frombuffer(content, np.uint8), np.array(at), np.array(length), left)
        table = _table(values)
        if not table:
            raise InputError(f"{path}: holds no acceleration with a rate of turn; record it with both")
        if len(worlds) > 1:
            raise InputError(f"{path}: gives attitude relative to {', '.join(sorted(worlds))}; split it there")
        header = f"Coordinate system: {worlds.pop() if worlds else 'ENU'}"
        recording = recording_of(path, self.name, table, header, left, options)
        return replace(recording, clocks={SENSOR: _clock(values, table)})


FORMAT = Mtb()


def _messages(content: bytes | mmap.mmap, left: Counter[str]) -> Iterator[tuple[int, int, int, int]]:
    """Every message whose sum is right: its first byte, the first byte and length of its data, and its kind."""
    at, size = content.find(bytes([PREAMBLE])), len(content)
    while 0 <= at < size - 4:
        length, data = content[at + 3], at + 4
        if length == EXTENDED and at + 6 < size:
            length, data = 256 * content[at + 4] + content[at + 5], at + 6
        end = data + length
        if end < size and sum(content[at + 1 : end + 1]) % 256 == 0:
            yield at, data, length, content[at + 2]
            after = end + 1
        else:
            left["a message that is cut off or whose sum is wrong"] += 1
            after = at + 1
        at = content.find(bytes([PREAMBLE]), after)


def _other(kind: int) -> str:
    return "legacy MTData, which MT Manager exports as text" if kind == LEGACY else f"message 0x{kind:02X}"


def _values(
    raw: NDArray[np.uint8], at: NDArray[np.int64], length: NDArray[np.int64], left: Counter[str]
) -> tuple[dict[int, Array], set[str]]:
    """Kind of item -> its numbers in every packet, NaN in packets without it; and the worlds of attitudes.

    Packets are alike, so those of one layout are read at once.
    """
    values: dict[int, Array] = {}
    worlds: set[str] = set()
    for size in np.unique(length):
        rows = np.flatnonzero(length == size)
        while len(rows):
            parts = np.array_split(rows, 1 + len(rows) // ROWS)
            packets = np.concatenate([raw[at[part, None] + np.arange(size)] for part in parts])
            layout = _layout(packets[0])
            headers = np.array([first - 3 + k for _, first, _ in layout for k in range(3)], np.int64)
            alike = (packets[:, headers] == packets[0, headers]).all(axis=1)
            for identifier, first, count in layout:
                kind = identifier & KIND
                numbers = _numbers(identifier, packets[alike, first : first + count])
                if numbers is None:
                    left[LEFT.get(kind, f"item 0x{kind:04X}")] += int(alike.sum())
                    continue
                column = values.setdefault(kind, np.full((len(at), numbers.shape[1]), np.nan))
                column[rows[alike]] = numbers
                if kind in (QUATERNION, EULER):
                    worlds.add(WORLDS.get(identifier & WORLD, "ENU"))
            rows = rows[~alike]
    return values, worlds


def _layout(packet: NDArray[np.uint8]) -> Layout:
    """Items of a packet; one that reaches beyond its end is left out."""
    items, at = [], 0
    while at + 3 <= len(packet):
        identifier, size = 256 * int(packet[at]) + int(packet[at + 1]), int(packet[at + 2])
        if at + 3 + size > len(packet):
            break
        items.append((identifier, at + 3, size))
        at += 3 + size
    return tuple(items)


def _numbers(identifier: int, data: NDArray[np.uint8]) -> Array | None:
    """What an item holds in each of m packets (m, k); None for one that a log has no place for."""
    kind, rows = identifier & KIND, np.ascontiguousarray(data)
    if kind in (COUNTER, FINE):
        type_ = {2: ">u2", 4: ">u4"}.get(rows.shape[1])
        return None if type_ is None else rows.view(type_).astype(float)
    if kind == UTC_TIME and rows.shape[1] == UTC_FIELDS.itemsize:
        return _unix(rows.view(UTC_FIELDS)[:, 0])[:, None]
    if kind not in COUNT:
        return None
    width = (4, 4, 6, 8)[identifier & PRECISION]
    if rows.shape[1] != width * COUNT[kind]:
        return None
    if width == 6:  # the fraction comes first
        parts = rows.reshape(len(rows), -1, 6)
        fraction = np.ascontiguousarray(parts[:, :, :4]).view(">u4")[:, :, 0] / 2.0**32
        return np.asarray(np.ascontiguousarray(parts[:, :, 4:]).view(">i2")[:, :, 0] + fraction)
    fixed = identifier & PRECISION == 1
    numbers = rows.view(">i4" if fixed else f">f{width}").astype(float)
    return np.asarray(numbers / 2.0**20 if fixed else numbers)


def _unix(time: NDArray[np.void]) -> Array:
    """Unix time of UTC items, shape (n,) [s]; NaN while the instrument has none."""
    known = (time["flags"] & UTC_VALID) == UTC_VALID
    seconds = unix_of_calendar(*(time[name].astype(np.int64) for name in CALENDAR))
    return np.where(known, seconds + 1e-9 * time["ns"], np.nan)


def _table(values: dict[int, Array]) -> dict[str, Array]:
    """The columns that the text export has; {} without acceleration and rate, which increments may stand for."""
    acceleration, rate = values.get(ACCELERATION), values.get(RATE)
    if acceleration is None and DELTA_V in values:
        acceleration = values[DELTA_V] / _period(values, DELTA_V)
    if rate is None and DELTA_Q in values:
        rate = log_rotation(_matrices(values[DELTA_Q])) / _period(values, DELTA_Q)
    if acceleration is None or rate is None:
        return {}
    table = {"PacketCounter": values[COUNTER][:, 0]} if COUNTER in values else {}
    if FINE in values:
        table["SampleTimeFine"] = values[FINE][:, 0]
    for name, vectors in (("Acc", acceleration), ("Gyr", rate), ("Mag", values.get(FIELD))):
        if vectors is not None:
            table |= {f"{name}_{axis}": vectors[:, k] for k, axis in enumerate("XYZ")}
    angles = values.get(EULER)
    if angles is None and QUATERNION in values:
        angles = np.rad2deg(rpy_from_matrix(_matrices(values[QUATERNION])))
    if angles is not None:
        table |= {name: angles[:, k] for k, name in enumerate(("Roll", "Pitch", "Yaw"))}
    return table


def _matrices(wxyz: Array) -> Array:
    return matrix_from_quaternion(np.roll(wxyz, -1, axis=1))


def _period(values: dict[int, Array], increment: int) -> float:
    """Over which an increment is summed [s]; NaN without times."""
    if FINE not in values:
        return np.nan
    ticks = values[FINE][np.isfinite(values[increment][:, 0]), 0]
    return FINE_S * float(np.nanmedian(np.diff(ticks))) if len(ticks) > 1 else np.nan


def _clock(values: dict[int, Array], table: dict[str, Array]) -> Clock:
    """The instrument's clock, and what it lacks of Unix time where it knew UTC."""
    fine = table.get("SampleTimeFine")
    if UTC_TIME not in values or fine is None:
        return Clock(SENSOR)
    known = np.isfinite(values[UTC_TIME][:, 0]) & np.isfinite(fine)
    if not known.any() or (np.diff(fine[np.isfinite(fine)]) < 0.0).any():
        return Clock(SENSOR)
    offset = float(np.median(values[UTC_TIME][known, 0] - FINE_S * fine[known]))
    return Clock(SENSOR, offset, UTC_SD_S, "UTC of the instrument's GNSS")
