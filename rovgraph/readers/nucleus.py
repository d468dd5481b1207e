"""Nortek Nucleus recordings: inertial unit, magnetometer, attitude, bottom and water track of one instrument.

All axes are those of the instrument, X forward, Y starboard, Z down as it is drawn. Source: Nortek AS, Nucleus
Integrator's Guide N3015-046.
"""

import mmap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array, wrap_angle
from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.nortek import (
    FRAME,
    NUCLEUS_FAMILIES,
    NortekTrack,
    Records,
    beam_table,
    bottom_channels,
    find_records,
    water_channels,
    where_bits,
)
from rovgraph.readers.recording import Channel, Clock, Left, Recording, sound_of_dvl
from rovgraph.readers.records import gathered, layout
from rovgraph.sensors.dvl_beam import BEAMS

IMU, MAGNETOMETER, BOTTOM, WATER, AHRS, INS = 0x82, 0x87, 0xB4, 0xBE, 0xD2, 0xDC
POSIX, BOOT = "Nucleus's Unix time", "Nucleus's time since its start"
GAUSS = 100.0  # [uT]
KINDS = IMU, MAGNETOMETER, BOTTOM, WATER, AHRS  # with sensor data
OTHERS = {0xAA: "altimeter", 0x8B: "field calibration", 0xA0: "text", 0xC0: "current profile", 0xC1: "current profile",
          0x96: "fast pressure", INS: "navigation solution, computed by the instrument"}  # fmt: skip
COMMON = layout(
    ("version", "u1", 0), ("offset", "u1", 1), ("flags", "u1", 2), ("seconds", "<u4", 4), ("micro", "<u4", 8),
    ("status", "<u4", 12),
)  # fmt: skip
TRACK = layout(
    ("status", "<u4", 12), ("sound", "<f4", 24), ("temperature", "<f4", 28), ("beams", "3<f4", 36),
    ("distance", "3<f4", 48), ("merit", "3<f4", 60),
    ("velocity", "3<f4", 96), ("sd", "3<f4", 108), ("delay", "<f4", 120),
)  # fmt: skip
VALUES = {  # behind the offset that each record states
    IMU: layout(("acc", "3<f4", 0), ("gyr", "3<f4", 12)),
    MAGNETOMETER: layout(("mag", "3<f4", 0)),
    AHRS: layout(("rpy", "3<f4", 0), ("declination", "<f4", 64), ("depth", "<f4", 68)),
}
IMU_VALID = 1


@dataclass(frozen=True)
class NucleusRecords:
    """Records of one kind.

    Attributes
    ----------
    time : shape (n,) [s]
    common, values : what stands before the offset, and behind it, shape (n,)
    """

    time: Array
    common: NDArray[np.void]
    values: NDArray[np.void]

    def only(self, rows: NDArray[np.bool_]) -> "NucleusRecords":
        """Some of them."""
        return NucleusRecords(self.time[rows], self.common[rows], self.values[rows])


class Nucleus:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "nucleus"
    title = "Nortek Nucleus recording"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        return 0.95 if find_records(head, NUCLEUS_FAMILIES).at else 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        with path.open("rb") as file:
            content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        found = find_records(content, NUCLEUS_FAMILIES, lambda done: options.progress(done, len(content)))
        records = {kind: said_of(content, found, kind) for kind in KINDS}
        stamped = [each.common["flags"] & 1 for each in records.values() if len(each.time)]
        unix = bool(stamped) and all(flags.all() for flags in stamped)
        clock = Clock(POSIX, 0.0, 1.0, "its stamps are Unix time") if unix else Clock(BOOT)
        channels = tuple(channels_of(records, clock.name, alone=not len(records[IMU].time)))
        if not channels:
            raise InputError(f"{path}: holds no measurement of a sensor; switch on the IMU, AHRS and bottom track data")
        settings: dict[str, Any] = {}
        if len(records[BOTTOM].time):
            values = records[BOTTOM].values
            sound, temperature = (values[name].astype(float) for name in ("sound", "temperature"))
            water, of_dvl = sound_of_dvl(records[BOTTOM].time, sound, temperature, "bottom track", clock.name)
            channels, settings = (*channels, *water), {"dvl": of_dvl} if of_dvl else {}
        declination = records[AHRS].values["declination"]
        if len(declination) and np.isfinite(declination[0]) and declination[0]:
            settings["environment"] = {"declination_deg": round(float(declination[0]), 3)}
        mixed = stamped and not unix and any(flags.any() for flags in stamped)
        more = ["its clock was set meanwhile: stamps are of two clocks"] if mixed else []
        beams = beam_table(track_of(records[BOTTOM]))
        tables = {BEAMS: beams} if beams else {}
        return Recording(
            str(path), self.name, channels, {clock.name: clock}, tuple(_left(found, records)), settings,
            warnings=(*more, *_warnings(found, channels)), tables=tables,
        )  # fmt: skip


FORMAT = Nucleus()


def said_of(content: bytes | mmap.mmap, found: Records, kind: int) -> NucleusRecords:
    """All records of a kind that are long enough."""
    at = np.array(found.at.get(kind, []), dtype=np.int64)
    size = np.array(found.size.get(kind, []), dtype=np.int64)
    common, there = gathered(content, COMMON, at.tolist(), size.tolist(), COMMON.itemsize)
    offset = np.where(there, common["offset"], 0).astype(np.int64)
    if kind in VALUES:
        fields, start, rest = VALUES[kind], at + offset, size - offset
    else:
        fields, start, rest = TRACK, at, size
    values, whole = gathered(content, fields, start.tolist(), rest.tolist(), fields.itemsize)
    good = there & whole
    return NucleusRecords((common["seconds"] + 1e-6 * common["micro"])[good], common[good], values[good])


def track_of(said: NucleusRecords) -> NortekTrack:
    """A track; its status marks the valid values."""
    values, status = said.values, said.values["status"]
    return NortekTrack(
        time=said.time,
        delay=values["delay"].astype(float),
        velocity=where_bits(values["velocity"], status, 9),
        sd=where_bits(values["sd"], status, 12),
        range=where_bits(values["distance"], status, 3),
        beams=where_bits(values["beams"], status, 0),
        merit=where_bits(values["merit"], status, 6),
    )


def channels_of(said: Mapping[int, NucleusRecords], clock: str, alone: bool = False) -> Iterator[Channel]:
    """Channels of all sensors, by the kinds of records.

    Parameters
    ----------
    alone : there is no IMU, so its attitude is the vehicle's roll, pitch and heading
    """

    def channel(sensor: str, of: NucleusRecords, source: str, frame: str, **columns: Array) -> Iterator[Channel]:
        if len(of.time):
            made = {"time": of.time, **{name: np.asarray(values, dtype=float) for name, values in columns.items()}}
            yield Channel(sensor, made, f"{source}: {', '.join(columns)}", frame, clock)

    imu, mag, ahrs = said[IMU], said[MAGNETOMETER], said[AHRS]
    valid = (imu.common["status"] & IMU_VALID == 1)[:, None]
    acc, gyr = (np.where(valid, imu.values[name], np.nan).T for name in ("acc", "gyr"))
    moved = {f"acc_{axis}": acc[k] for k, axis in enumerate("xyz")} | {f"gyr_{a}": gyr[k] for k, a in enumerate("xyz")}
    yield from channel("imu", imu, "IMU", FRAME, **moved)
    field = GAUSS * mag.values["mag"].astype(float).T
    yield from channel("mag", mag, "magnetometer", FRAME, **{f"mag_{axis}": field[k] for k, axis in enumerate("xyz")})
    roll, pitch, heading = np.deg2rad(ahrs.values["rpy"].astype(float)).T
    declination = np.deg2rad(np.nan_to_num(ahrs.values["declination"].astype(float)))
    yaw = wrap_angle(heading - declination)
    if alone:
        yield from channel("vehicle_heading", ahrs, "AHRS", FRAME, heading=yaw)
        yield from channel("vehicle_tilt", ahrs, "AHRS", FRAME, roll=roll, pitch=pitch)
    else:
        yield from channel("ahrs", ahrs, "AHRS", FRAME, ahrs_roll=roll, ahrs_pitch=pitch, ahrs_yaw=yaw)
    yield from channel("depth", ahrs, "AHRS", "", depth=ahrs.values["depth"])
    if len(said[BOTTOM].time):
        yield from bottom_channels(track_of(said[BOTTOM]), "bottom track", clock)
    if len(said[WATER].time):
        yield from water_channels(track_of(said[WATER]), "water track", clock)


def _left(found: Records, said: Mapping[int, NucleusRecords]) -> Iterator[Left]:
    if len(said[WATER].time) and (invalid := int((~track_of(said[WATER]).valid).sum())):
        yield Left("water track", invalid, "marked as invalid")
    for kind, at in sorted(found.at.items()):
        if kind not in KINDS:
            yield Left(OTHERS.get(kind, f"record {kind:#04x}"), len(at), "no measurement of a sensor")
    if found.failed:
        yield Left("record", found.failed, "a wrong checksum, or cut off")


def _warnings(found: Records, channels: tuple[Channel, ...]) -> Iterator[str]:
    if found.failed:
        yield f"{found.failed} records are damaged or cut off, and left out"
    if found.skipped:
        yield f"{found.skipped} bytes belong to no whole record"
    sensors = {channel.sensor: channel for channel in channels}
    if "imu" not in sensors:
        yield "no IMU in the file; switch on its data. Roll, pitch and heading are those of its AHRS"
    if "dvl" not in sensors or not np.any(sensors["dvl"].columns["dvl_valid"]):
        yield "no bottom track: the instrument did not look for the bottom, or never saw it"
