"""Teledyne PD4 and PD5: one frame of 47 or 88 bytes a ping, as DVLs of several makers send it.

Velocities are those of the vehicle, unlike in PD0. Source: Teledyne RD Instruments, Navigator Technical Manual,
P/N 957-6172-00, PD4 and PD5 data output formats.
"""

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log.stamps import DAY_S, unwrapped
from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.recording import Clock, Left, Recording
from rovgraph.readers.trdi import (
    BEAM,
    CLOCK,
    EARTH,
    INSTRUMENT,
    SHIP,
    Attitude,
    Pings,
    forward_starboard_down,
    recording,
)

MARK = 0x7D
SIZES = {0: 47, 1: 88}  # bytes of a frame, by its kind: PD4, PD5
BAD = -32768
HEADS = [struct.pack("<BBH", MARK, kind, size - 2) for kind, size in SIZES.items()]
FIELDS = [
    ("mark", "u1"), ("kind", "u1"), ("bytes", "<u2"), ("system", "u1"), ("velocity", "4<i2"), ("range", "4<u2"),
    ("status", "u1"), ("water", "4<i2"), ("layer", "2<u2"), ("layer_status", "u1"), ("clock", "4u1"), ("test", "<u2"),
    ("sound_speed", "<u2"), ("temperature", "<i2"), ("salinity", "u1"), ("depth", "<u2"), ("pitch", "<i2"),
    ("roll", "<i2"), ("heading", "<u2"),
]  # fmt: skip
FRAME = np.dtype(FIELDS)  # those behind the temperature in PD5 alone


class PD4:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "pd4"
    title = "Teledyne PD4 or PD5 frames"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        return 0.9 if next(FrameCutter().feed(head), None) is not None else 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        frames, found, size = FrameCutter(), bytearray(), path.stat().st_size
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                found += b"".join(frame.ljust(SIZES[1], b"\0") for frame in frames.feed(block))
                options.progress(file.tell(), size)
        if not found:
            raise InputError(f"{path}: holds no whole PD4 or PD5 frame; copy it again")
        pings, refused = decoded(np.frombuffer(bytes(found), np.uint8).reshape(-1, SIZES[1]))
        skipped = frames.skipped + len(frames.rest)
        left = tuple(Left("velocity", count, reason) for reason, count in refused.items())
        warnings = [f"{count} velocities are left out: {reason}" for reason, count in refused.items()]
        if skipped:
            warnings.append(f"{skipped} bytes belong to no whole frame, or to one with a wrong checksum")
        return recording(path, self.name, pings, Clock(CLOCK, cycle=DAY_S), left, tuple(warnings))


FORMAT = PD4()


class FrameCutter:
    """Cuts bytes that come in pieces into whole frames with right checksums.

    Attributes
    ----------
    skipped : bytes that belong to none
    rest : bytes that may be the beginning of one
    """

    def __init__(self) -> None:
        self.rest = b""
        self.skipped = 0

    def feed(self, data: bytes) -> Iterator[bytes]:
        content, position = self.rest + data, 0
        self.rest = b""
        while position < len(content):
            start = content.find(MARK, position)
            start = len(content) if start < 0 else start
            self.skipped += start - position
            head = content[start : start + len(HEADS[0])]
            if len(head) < len(HEADS[0]):
                self.rest = head
                return
            if head not in HEADS:
                self.skipped += 1
                position = start + 1
                continue
            end = start + SIZES[content[start + 1]]
            if end > len(content):
                self.rest = content[start:]
                return
            frame = content[start:end]
            if sum(frame[:-2]) & 0xFFFF == int.from_bytes(frame[-2:], "little"):
                yield frame
                position = end
            else:
                self.skipped += 1
                position = start + 1


def decoded(frames: NDArray[np.uint8]) -> tuple[Pings, dict[str, int]]:
    """The values of frames, and how many velocities have axes that cannot be turned back, by the reason.

    Parameters
    ----------
    frames : ndarray, shape (n, 88); PD4 is filled up with zeros
    """
    records = np.ascontiguousarray(frames[:, : FRAME.itemsize]).view(FRAME)[:, 0]
    of_five = records["kind"] == 1
    rpy = np.deg2rad(0.01 * np.column_stack([records[name].astype(float) for name in ("roll", "pitch", "heading")]))
    rpy[~of_five] = np.nan
    system = records["system"] >> 6
    tilted = (records["system"] & 0x20 != 0) & (system >= SHIP)
    values, water = (_velocities(records[name]) for name in ("velocity", "water"))
    refused = {}
    for reason, rows in (
        ("beam coordinates of PD4 and PD5 have no defined sign; set EX to instrument or ship", system == BEAM),
        ("earth coordinates of PD4 cannot be turned back without a heading; set EX", (system == EARTH) & ~of_five),
        ("levelled ship coordinates of PD4 cannot be turned back; set EX", (system == SHIP) & tilted & ~of_five),
    ):
        if rows.any():
            refused[reason] = int(np.count_nonzero(rows))
            values[rows] = water[rows] = np.nan
    usual = np.full(len(records), False)
    attitude = Attitude(np.nan_to_num(rpy), tilted, usual, np.full(len(records), np.pi / 6.0), ~usual)
    system = np.where(system == BEAM, INSTRUMENT, system)
    velocity, error = forward_starboard_down(values, system, attitude)
    through, _ = forward_starboard_down(water, system, attitude)
    return Pings(
        time=_time(records["clock"]),
        system=system,
        velocity=velocity,
        water=through,
        error=error,
        rpy=rpy,
        bias=np.zeros(len(records)),
        alignment=np.zeros(len(records)),
        tilted=tilted,
        depth=np.where(of_five, 0.1 * records["depth"], np.nan),
        range=np.where(records["range"] > 0, 0.01 * records["range"], np.nan),
        beams=np.full((len(records), 4), np.nan),
        quality={},
        percent_good=np.zeros((len(records), 4)),
        sound=np.where(of_five, records["sound_speed"], np.nan),
        temperature=np.where(of_five, 0.01 * records["temperature"], np.nan),
        salinity=np.full(len(records), np.nan),
        head=None,
        position=np.full((len(records), 2), np.nan),
        tracked=np.full(len(records), True),
    ), refused


def _velocities(raw: NDArray[np.int16]) -> Array:
    """Velocities [m/s], shape (n, 4); none where one is missing or all are zero, as without a track."""
    values = np.where(raw == BAD, np.nan, 0.001 * raw)
    values[~np.any(raw, axis=1)] = np.nan
    return values


def _time(clock: NDArray[np.uint8]) -> Array:
    """Seconds since the midnight before the first ping; NaN where the clock cannot give them."""
    hour, minute, second, hundredths = clock.astype(float).T
    time = 3600.0 * hour + 60.0 * minute + second + 0.01 * hundredths
    time[(hour > 23) | (minute > 59) | (second > 59) | (hundredths > 99)] = np.nan
    return unwrapped(time, DAY_S)
