"""Nortek AD2CP files: bottom tracks of Signature instruments (record 0x17), tracks of DVLs (0x1B, 0x1D), profiles.

Velocities of a profile (records 0x15, 0x16) are those of the water away from the instrument; cell n, from 1, is at the
blanking distance and n cells along its axis.
"""

import mmap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array, wrap_angle
from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.nortek import (
    AD2CP_FAMILIES,
    BAR,
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
from rovgraph.readers.stamps import unix_of_calendar
from rovgraph.sensors.dvl_beam import BEAMS
from rovgraph.sensors.water_layer import CELLS

BURST, AVERAGE = 0x15, 0x16
SIGNATURE, DVL_BOTTOM, DVL_WATER = 0x17, 0x1B, 0x1D
CLOCK = "instrument's clock"
ZONE_SD_S = 6 * 3600.0  # of a clock without a stated time zone
ENU, XYZ, BEAM = range(3)  # coordinates of a Signature's velocities
BEAM_ANGLE_DEG = 25.0  # of a Signature, as its own transformation matrix has it
AZIMUTHS_DEG = [0.0, 270.0, 180.0, 90.0]  # of its beams
BEAM_ANGLE = np.deg2rad(BEAM_ANGLE_DEG)
BAD = -32768
NO_MERIT = 65535  # figure of merit of a beam that heard nothing
PROFILE_VERSION = 3
BLANKING_IN_CM = 1 << 1  # of the status, else mm
HAS_VELOCITY, HAS_DISTANCE, HAS_MERIT = 1 << 5, 1 << 8, 1 << 9
OTHERS = {
    BURST: "burst of a profile", AVERAGE: "average of a profile", 0x18: "burst of the fifth beam",
    0x1A: "raw altimeter", 0x1C: "echo sounder", 0x1E: "altimeter", 0x1F: "average altimeter", 0xA0: "text",
}  # fmt: skip
_HEAD = [("version", "u1", 0), ("offset", "u1", 1)]
_DATE = "6u1"  # years since 1900, months since January, day, hour, minute, second
SIGNATURE_FIELDS = layout(
    *_HEAD, ("config", "<u2", 2), ("date", _DATE, 8), ("fraction", "<u2", 14), ("sound", "<u2", 16),
    ("temperature", "<i2", 18), ("pressure", "<u4", 20),
    ("heading", "<u2", 24), ("pitch", "<i2", 26), ("roll", "<i2", 28), ("beams", "<u2", 30), ("scale", "i1", 60),
)  # fmt: skip
PROFILE_FIELDS = layout(
    *_HEAD, ("config", "<u2", 2), ("date", _DATE, 8), ("fraction", "<u2", 14),
    ("heading", "<u2", 24), ("pitch", "<i2", 26), ("roll", "<i2", 28), ("beams", "<u2", 30),
    ("cell", "<u2", 32), ("blank", "<u2", 34), ("scale", "i1", 58), ("status", "<u4", 68),
)  # fmt: skip
DVL_FIELDS = layout(
    *_HEAD, ("date", _DATE, 6), ("fraction", "<u2", 12), ("status", "<u4", 20), ("sound", "<f4", 24),
    ("temperature", "<f4", 28), ("pressure", "<f4", 32),
    ("beams", "4<f4", 36), ("distance", "4<f4", 52), ("merit", "4<f4", 68), ("velocity", "4<f4", 132),
    ("sd", "4<f4", 148), ("delay", "4<f4", 164),
)  # fmt: skip


class AD2CP:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "ad2cp"
    title = "Nortek AD2CP or DVL file (.ad2cp)"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        return 0.95 if find_records(head, AD2CP_FAMILIES).at else 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        with path.open("rb") as file:
            content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        found = find_records(content, AD2CP_FAMILIES, lambda done: options.progress(done, len(content)))
        channels: list[Channel] = []
        tables: dict[str, dict[str, Array]] = {}
        notes: list[str] = []
        signature, refused = decoded_signature(content, found)
        tracks = {SIGNATURE: signature} | {k: decoded_dvl(content, found, k) for k in (DVL_BOTTOM, DVL_WATER)}
        for kind, track in tracks.items():
            if not len(track.time):
                continue
            if kind == DVL_WATER:
                channels += water_channels(track, f"water track {kind:#x}", CLOCK)
            else:
                channels += bottom_channels(track, f"bottom track {kind:#x}", CLOCK)
                if table := beam_table(track):
                    tables[BEAMS if not tables else f"{BEAMS}_{kind:x}"] = table
        profile = AVERAGE if found.at.get(AVERAGE) else BURST
        cells, apart = profiles(content, found, profile)
        if cells:
            tables[CELLS] = cells
        header = SIGNATURE if found.at.keys() & {SIGNATURE, DVL_BOTTOM} else profile  # whose head is the same
        channels += _attitude(content, found, header)
        channels += _pressure(content, found, header)
        water, of_dvl = _sound(content, found, header)
        channels += water
        if np.isfinite(signature.beams).any() or "beam_1" in cells:
            of_dvl["beams"] = {"angle_deg": BEAM_ANGLE_DEG, "azimuth_deg": AZIMUTHS_DEG}
        elif any("velocity_1" in table for table in tables.values()):
            notes.append("where the beams of a Nortek DVL point is not stated: rovgraph calibrate dvl-beams fits it")
        settings: dict[str, Any] = {"dvl": of_dvl} if of_dvl else {}
        if not channels:
            raise InputError(f"{path}: holds no bottom track (records 0x17, 0x1B); the instrument has to record it")
        if any(channel.sensor == "depth" for channel in channels):
            settings["depth"] = {"surface_hpa": 0.0}
            notes.append("pressure is above the offset that the instrument has, the air's as it was set")
        return Recording(
            str(path), self.name, tuple(channels), {CLOCK: Clock(CLOCK, 0.0, ZONE_SD_S, "its calendar, taken for UTC")},
            tuple(_left(found, refused, profile, apart)), settings, tuple(notes),
            tuple(_warnings(found, refused, channels)),
            tables=tables,
        )  # fmt: skip


FORMAT = AD2CP()


def decoded_signature(content: bytes | mmap.mmap, found: Records) -> tuple[NortekTrack, int]:
    """Bottom track of a Signature, and how many pings have axes that are not turned back.

    It is the bottom that moves here, away from the instrument where positive.
    """
    at, size = found.at.get(SIGNATURE, []), found.size.get(SIGNATURE, [])
    records, _ = gathered(content, SIGNATURE_FIELDS, at, size, SIGNATURE_FIELDS.itemsize)
    count = len(records)
    empty = np.full((count, 4), np.nan)
    whole = (records["beams"] >> 12 == 4) & (records["config"] & HAS_VELOCITY != 0)
    parts = {}
    start = np.array(at, dtype=np.int64) + records["offset"]
    end = np.array(at, dtype=np.int64) + np.array(size, dtype=np.int64)
    for name, bit, kind in (
        ("velocity", HAS_VELOCITY, "<i4"),
        ("distance", HAS_DISTANCE, "<i4"),
        ("merit", HAS_MERIT, "<u2"),
    ):
        there = whole & (records["config"] & bit != 0)
        fields = layout(("value", f"4{kind}", 0))
        values, read = gathered(
            content, fields, np.where(there, start, -1).tolist(), (end - start).tolist(), fields.itemsize
        )
        parts[name] = np.where(read[:, None], values["value"], np.nan).astype(float)
        start = start + np.where(there, fields.itemsize, 0)
    heard = (parts["merit"] != NO_MERIT) & (parts["distance"] > 0.0)
    raw = np.where(heard, parts["velocity"] * 10.0 ** records["scale"][:, None].astype(float), np.nan)
    system = (records["beams"] >> 10) & 3
    velocity = np.where((system == BEAM)[:, None], _of_beams(raw), np.column_stack([raw[:, :2], _either(raw[:, 2:])]))
    turned = system == ENU
    rpy = np.deg2rad(0.01 * np.column_stack([records[name].astype(float) for name in ("roll", "pitch", "heading")]))
    velocity[turned] = _of_enu(velocity[turned], rpy[turned])
    known = system <= BEAM
    velocity[~known] = np.nan
    beams = np.where((system == BEAM)[:, None], -raw, np.nan)
    time = _time(records["date"], records["fraction"])
    merit = np.where(heard, 1e-3 * parts["merit"], np.nan)
    distance = np.where(heard, 1e-3 * parts["distance"], np.nan)
    track = NortekTrack(time, np.zeros(count), -velocity, empty[:, :3], distance, beams, merit)
    return track, int(np.count_nonzero(~known))


def profiles(content: bytes | mmap.mmap, found: Records, kind: int) -> tuple[dict[str, Array], int]:
    """The cells of a kind of profile: column -> ndarray, shape (n,), as `rovgraph.log.companions` has them; {} = none.

    With them, how many profiles are left out: of another version of the record, or not of four beams.
    """
    at, size = np.array(found.at.get(kind, []), np.int64), np.array(found.size.get(kind, []), np.int64)
    records, there = gathered(content, PROFILE_FIELDS, at.tolist(), size.tolist(), PROFILE_FIELDS.itemsize)
    count, system = (records["beams"] & 0x3FF).astype(np.int64), (records["beams"] >> 10) & 3
    good = there & (records["version"] == PROFILE_VERSION) & (records["beams"] >> 12 == 4) & (system <= BEAM)
    good &= (records["config"] & HAS_VELOCITY != 0) & (size >= records["offset"] + 8 * count)
    raw = np.full((len(records), int(count[good].max(initial=0)), 4), np.nan)
    for n in np.unique(count[good]).tolist():
        of = np.flatnonzero(good & (count == n))
        fields, first = layout(("value", f"(4,{n})<i2", 0)), at[of] + records["offset"][of]
        values, _ = gathered(content, fields, first.tolist(), [fields.itemsize] * len(of), fields.itemsize)
        raw[of, :n] = values["value"].swapaxes(1, 2)
    raw[raw == BAD] = np.nan
    raw *= 10.0 ** records["scale"][:, None, None].astype(float)
    time = _time(records["date"], records["fraction"])
    of, cell = np.nonzero(np.isfinite(raw).any(axis=2) & np.isfinite(time)[:, None])
    if not len(of):
        return {}, int(np.count_nonzero(~good))
    away, by_beams = raw[of, cell], system[of] == BEAM
    rpy = np.deg2rad(0.01 * np.column_stack([records[name].astype(float) for name in ("roll", "pitch", "heading")]))
    velocity = np.column_stack([away[:, :2], _either(away[:, 2:])])
    turned = system[of] == ENU
    velocity[turned] = _of_enu(velocity[turned], rpy[of][turned])
    velocity[by_beams] = np.nan
    away[~by_beams] = np.nan
    blank = np.where(records["status"] & BLANKING_IN_CM, 0.01, 0.001) * records["blank"]
    table = {
        "time": time[of],
        "range": blank[of] + 1e-3 * records["cell"][of] * (cell + 1.0),
        "cell": 1e-3 * records["cell"][of],
        **dict(zip(("vx", "vy", "vz"), -velocity.T, strict=True)),
        **{f"beam_{k + 1}": -away[:, k] for k in range(4)},
    }
    return {n: v for n, v in table.items() if np.isfinite(v).any()}, int(np.count_nonzero(~good))


def _of_enu(velocity: Array, rpy: Array) -> Array:
    """X, Y and Z, shape (n, 3), of east, north and up, by roll, pitch and heading of the record.

    Pitch lifts X. Source: Nortek, Coordinate transformations, support FAQ.
    """
    (sr, sp, sh), (cr, cp, ch) = np.sin(rpy.T), np.cos(rpy.T)
    zero = np.zeros(len(rpy))
    heading = np.array([[sh, -ch, zero], [ch, sh, zero], [zero, zero, zero + 1.0]])
    tilt = np.array([[cp, -sp * sr, -cr * sp], [zero, cr, -sr], [sp, sr * cp, cp * cr]])
    return np.asarray(np.einsum("ikn,kjn,ni->nj", heading, tilt, velocity))


def _of_beams(beams: Array) -> Array:
    """X, Y and Z, shape (n, 3), of beams that point to X, -Y, -X and Y."""
    b1, b2, b3, b4 = beams.T
    across, along = 1.0 / (2.0 * np.sin(BEAM_ANGLE)), 1.0 / (2.0 * np.cos(BEAM_ANGLE))
    return np.column_stack([across * (b1 - b3), across * (b4 - b2), 0.5 * along * (b1 + b2 + b3 + b4)])


def _either(pair: Array) -> Array:
    """Mean of two measurements of one axis, shape (n,); either one where the other is missing."""
    count = np.isfinite(pair).sum(axis=1)
    return np.where(count > 0, np.nansum(pair, axis=1) / np.maximum(count, 1), np.nan)


def decoded_dvl(content: bytes | mmap.mmap, found: Records, kind: int) -> NortekTrack:
    """Bottom or water track of a DVL: by the status for validity, two estimates of Z are averaged."""
    records, there = gathered(
        content, DVL_FIELDS, found.at.get(kind, []), found.size.get(kind, []), DVL_FIELDS.itemsize
    )
    records = records[there]
    status = records["status"]
    velocity = where_bits(records["velocity"], status, 12)
    sd = where_bits(records["sd"], status, 16)
    return NortekTrack(
        time=_time(records["date"], records["fraction"]),
        delay=records["delay"][:, 0].astype(float),
        velocity=np.column_stack([velocity[:, :2], _either(velocity[:, 2:])]),
        sd=np.column_stack([sd[:, :2], _either(sd[:, 2:])]),
        range=where_bits(records["distance"], status, 4),
        beams=where_bits(records["beams"], status, 0),
        merit=where_bits(records["merit"], status, 8),
    )


def _time(date: NDArray[np.uint8], fraction: NDArray[np.uint16]) -> Array:
    """Seconds since 1970 of calendar dates, shape (n,), NaN for invalid ones; ``fraction`` is in 0.1 ms."""
    year, month, day, hour, minute, second = date.astype(np.int64).T
    return unix_of_calendar(year + 1900, month + 1, day, hour, minute, second) + 1e-4 * fraction


def _attitude(content: bytes | mmap.mmap, found: Records, header: int) -> Iterator[Channel]:
    at, size = found.at.get(header, []), found.size.get(header, [])
    records, there = gathered(content, SIGNATURE_FIELDS, at, size, SIGNATURE_FIELDS.itemsize)
    if not there.any():
        return
    time = _time(records["date"], records["fraction"])
    heading, pitch, roll = (np.deg2rad(0.01 * records[name].astype(float)) for name in ("heading", "pitch", "roll"))
    source = f"record {header:#x}"
    yield Channel("dvl_heading", {"time": time, "dvl_heading": wrap_angle(heading)}, f"{source}: heading", "", CLOCK)
    yield Channel("vehicle_tilt", {"time": time, "roll": roll, "pitch": pitch}, f"{source}: roll, pitch", "", CLOCK)


def _pressure(content: bytes | mmap.mmap, found: Records, header: int) -> Iterator[Channel]:
    for kind, fields, to_pascal in (
        (DVL_BOTTOM, DVL_FIELDS, BAR),
        (header, SIGNATURE_FIELDS, 1e-3 * 0.1 * BAR),
    ):
        records, there = gathered(content, fields, found.at.get(kind, []), found.size.get(kind, []), fields.itemsize)
        if there.any():
            pascal = to_pascal * records["pressure"].astype(float)
            time = _time(records["date"], records["fraction"])
            yield Channel("depth", {"time": time, "pressure": pascal}, f"record {kind:#x}: pressure", "", CLOCK)


def _sound(content: bytes | mmap.mmap, found: Records, header: int) -> tuple[list[Channel], dict[str, Any]]:
    """Speed of sound and temperature, as `sound_of_dvl` has them."""
    for kind, fields, speed, degree in ((DVL_BOTTOM, DVL_FIELDS, 1.0, 1.0), (header, SIGNATURE_FIELDS, 0.1, 0.01)):
        records, there = gathered(content, fields, found.at.get(kind, []), found.size.get(kind, []), fields.itemsize)
        if (records := records[there]).size:
            sound, temperature = speed * records["sound"].astype(float), degree * records["temperature"].astype(float)
            time = _time(records["date"], records["fraction"])
            return sound_of_dvl(time, sound, temperature, f"record {kind:#x}", CLOCK)
    return [], {}


def _left(found: Records, refused: int, profile: int, apart: int) -> Iterator[Left]:
    for kind, at in sorted(found.at.items()):
        if kind not in (SIGNATURE, DVL_BOTTOM, DVL_WATER, profile):
            yield Left(OTHERS.get(kind, f"record {kind:#04x}"), len(at), "no measurement of a sensor")
    if apart:
        yield Left(OTHERS[profile], apart, "not of four beams, or of another version than 3")
    if found.failed:
        yield Left("record", found.failed, "a wrong checksum, or cut off")
    if refused:
        yield Left("velocity", refused, "unknown coordinates; record beams or XYZ")


def _warnings(found: Records, refused: int, channels: list[Channel]) -> Iterator[str]:
    if found.failed:
        yield f"{found.failed} records are damaged or cut off, and left out"
    if found.skipped:
        yield f"{found.skipped} bytes belong to no whole record"
    if refused:
        yield f"{refused} velocities are in unknown coordinates and left out; record beams or XYZ"
        return
    dvl = [channel for channel in channels if channel.sensor == "dvl"]
    if not any(np.any(channel.columns["dvl_valid"]) for channel in dvl):
        yield "no bottom track: the instrument did not look for the bottom, or never saw it"
