"""Teledyne PD0 files (.pd0, .000, .ENR, .adc): bottom and water track, profiles, attitude, depth of each ensemble.

Bottom track is the velocity of the bottom against the instrument; a log has the instrument's over the bottom, and
relative to the water in the cells of a profile. Axes are forward (beam 3, or the ship's bow), starboard, down, whatever
the file's are (`rovgraph.readers.trdi`).

WinRiver and VmDas write a receiver's fixes beside the pings, with their time of day (UTC) and how long before the ping
they came, which gives the error of the instrument's clock. Sources: Teledyne RD Instruments, WinRiver II User's
Guide, General NMEA data; VmDas User's Guide, navigation data.

Ensembles are found by their checksums, and their records become structured arrays. Source: Teledyne RD Instruments,
Workhorse Commands and Output Data Format, P/N 957-6156-00, chapter 8. dolfyn 1.3 does not import beside NumPy 2, and
keeps one coordinate system for a file.
"""

import mmap
import struct
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.nmea_sentences import RANGE_SD_M, day_time, number
from rovgraph.readers.recording import Channel, Clock, Left, Recording
from rovgraph.readers.records import gathered, layout
from rovgraph.readers.stamps import unix_of_calendar
from rovgraph.readers.trdi import (
    BEAM,
    CLOCK,
    EARTH,
    SHIP,
    Attitude,
    BeamHead,
    Pings,
    beams_setting,
    forward_starboard_down,
    recording,
)
from rovgraph.sensors.water_layer import CELLS

SYNC = b"\x7f\x7f"
FIXED, VARIABLE, PROFILE, CORRELATION, BOTTOM, NAVIGATION = 0x0000, 0x0080, 0x0100, 0x0200, 0x0600, 0x2000
SENTENCES, GGA, HEADING = 0x2022, 0x2101, 0x2104  # of receivers: decoded by WinRiver, and as text
SEVERAL = (PROFILE, CORRELATION, SENTENCES, GGA, HEADING)

LAYOUTS = {
    FIXED: layout(
        ("system", "<u2", 4),
        ("cells", "u1", 9),  # of a profile
        ("length", "<u2", 12),  # of one [cm]
        ("coordinates", "u1", 25),
        ("alignment", "<i2", 26),  # of beam 3 against the bow [0.01 deg]
        ("bias", "<i2", 28),  # added to the heading [0.01 deg]
        ("source", "u1", 30),  # which values come from its own sensors
        ("first", "<u2", 32),  # distance to the middle of the first cell, along the vertical [cm]
        ("beam_angle", "u1", 58),  # [deg]
    ),
    VARIABLE: layout(
        ("date", "7u1", 4),  # year, month, day, hour, minute, second, hundredths
        ("sound", "<u2", 14),  # speed that it worked with [m/s]
        ("depth", "<u2", 16),  # [dm]
        ("heading", "<u2", 18),  # [0.01 deg]
        ("pitch", "<i2", 20),
        ("roll", "<i2", 22),
        ("salinity", "<u2", 24),  # as it was told [psu]
        ("temperature", "<i2", 26),  # [0.01 deg C]
        ("century", "u1", 57),
    ),
    BOTTOM: layout(
        ("range", "4<u2", 16),  # of each beam, along the vertical [cm]
        ("velocity", "4<i2", 24),  # of the bottom [mm/s]
        ("correlation", "4u1", 32),
        ("amplitude", "4u1", 36),
        ("percent_good", "4u1", 40),
        ("water", "4<i2", 50),  # velocity of a layer of water [mm/s]
        ("range_high", "4u1", 77),  # [65536 cm]
    ),
    NAVIGATION: layout(("lat", "<i4", 16), ("lon", "<i4", 20)),  # of a REMUS [180 deg / 2**31]
}
LEAST = {FIXED: 42, VARIABLE: 40, BOTTOM: 48, NAVIGATION: 24}  # bytes, as older firmware writes them
OTHERS = {
    0x0001: "fixed leader of another kind",
    0x0300: "echo intensity profile",
    0x0400: "percent-good profile",
    0x0500: "status profile",
    0x2100: "depth sentences (DBT)",
    0x2102: "course and speed over ground (VTG)",
    0x2103: "sentences of a satellite receiver",
}


@dataclass
class Ensembles:
    """Where the records of whole ensembles lie.

    Attributes
    ----------
    at : kind -> first byte of its record in each ensemble, -1 = it has none
    length : kind -> bytes of it
    several : kind -> number of the ensemble, first byte and bytes of each record, one after the other
    others : kind -> number of records that are not in `LAYOUTS`
    failed : ensembles with a wrong checksum
    skipped : bytes that belong to no whole ensemble
    """

    at: dict[int, "array[int]"] = field(default_factory=lambda: {kind: array("q") for kind in LAYOUTS})
    length: dict[int, "array[int]"] = field(default_factory=lambda: {kind: array("q") for kind in LAYOUTS})
    several: dict[int, "array[int]"] = field(default_factory=lambda: {kind: array("q") for kind in SEVERAL})
    others: Counter[int] = field(default_factory=Counter)
    failed: int = 0
    skipped: int = 0

    def __len__(self) -> int:
        return len(self.at[FIXED])

    def records(self, content: bytes | mmap.mmap, kind: int) -> tuple[NDArray[np.void], NDArray[np.bool_]]:
        """Records of a kind, shape (n,), with zeros where an ensemble has none or a short one, and which have it."""
        return gathered(content, LAYOUTS[kind], self.at[kind], self.length[kind], LEAST[kind])

    def records_of(
        self, content: bytes | mmap.mmap, kind: int, fields: np.dtype[np.void]
    ) -> tuple[NDArray[np.void], NDArray[np.int64]]:
        """All records of one of `SEVERAL`, shape (m,), and the numbers of their ensembles."""
        ensemble, at, length = np.array(self.several[kind], np.int64).reshape(-1, 3).T
        return gathered(content, fields, at.tolist(), length.tolist(), 1)[0], ensemble


def find_ensembles(content: bytes | mmap.mmap, progress: Callable[[int], None] = lambda done: None) -> Ensembles:
    """All whole ensembles; behind what is damaged the next one is looked for.

    Parameters
    ----------
    progress : called with the bytes that are done
    """
    found = Ensembles()
    position, size = 0, len(content)
    while (start := content.find(SYNC, position)) >= 0:
        found.skipped += start - position
        end = ensemble_end(content, start)
        table = _table(content, start, end - 2) if end else None
        if end is None or table is None:
            found.skipped += 1
            position = start + 1
        elif sum(memoryview(content)[start : end - 2]) & 0xFFFF != int.from_bytes(content[end - 2 : end], "little"):
            found.failed += 1
            found.skipped += 1
            position = start + 1
        else:
            _keep(found, table, end - 2)
            position = end
            progress(position)
    found.skipped += size - position
    return found


def ensemble_end(content: bytes | mmap.mmap, start: int) -> int | None:
    """Byte behind the ensemble that a header announces; None where it cannot be one, or is cut off."""
    if start + 6 > len(content):
        return None
    end = start + 2 + int.from_bytes(content[start + 2 : start + 4], "little")
    return end if end <= len(content) else None


def _table(content: bytes | mmap.mmap, start: int, end: int) -> list[tuple[int, int]] | None:
    """First byte and kind of each record, in their order; None for what cannot be a table of records."""
    count = content[start + 5]
    first = start + 6 + 2 * count
    if not count or first + 2 > end:
        return None
    offsets = struct.unpack_from(f"<{count}H", content, start + 6)
    if any(start + offset + 2 > end or start + offset < first for offset in offsets):
        return None
    table = [(start + o, int.from_bytes(content[start + o : start + o + 2], "little")) for o in sorted(offsets)]
    kinds = {kind for _, kind in table}
    return table if FIXED in kinds and VARIABLE in kinds else None


def _keep(found: Ensembles, table: list[tuple[int, int]], end: int) -> None:
    bounds = [at for at, _ in table[1:]] + [end]
    known = {kind: (at, bound - at) for (at, kind), bound in zip(table, bounds, strict=True)}
    for (at, kind), bound in zip(table, bounds, strict=True):
        if kind in SEVERAL:
            found.several[kind].extend((len(found), at, bound - at))
    for kind in LAYOUTS:
        at, length = known.get(kind, (-1, 0))
        found.at[kind].append(at)
        found.length[kind].append(length)
    found.others.update(kind for _, kind in table if kind not in LAYOUTS and kind not in SEVERAL)


ZONE_SD_S = 6 * 3600.0  # of a clock without a stated time zone
BAD = -32768
MAPPED = 0b1  # cells by their depths
FAINT = 64  # correlation that Teledyne's instruments want at least, of 128 [counts]
FEWEST, MOST_GROUPS = 30, 10  # error velocities that show the noise of cells, and groups of them
ANGLES = 15.0, 20.0, 30.0, 25.0  # of beams, by the system's configuration [deg]
LEVEL_SENSORS = 0b1100  # pitch and roll come from sensors of its own
THERMOMETER, COMPUTED_SOUND = 0b1, 0b100_0000  # the temperature does; the speed of sound follows from what is measured
SEMICIRCLE = 180.0 / 2**31  # [deg]
DAY_S = 86_400.0
UTC = "UTC of the receiver"
RECORDED_SD_S = 0.05  # of the recording computer's arrival time of a sentence
POLE_DEG = 89.5
FASTEST = 60.0  # median speed between positions, that no vehicle has and wrong numbers easily have [m/s]
DEG_M = 111_195.0
BY_WINRIVER = layout(
    ("kind", "<u2", 2),
    ("before", "<f8", 6),  # the ping [s]
    ("name", "S7", 14),
    ("time", "S10", 21),
    ("lat", "<f8", 31),
    ("north", "S1", 39),
    ("lon", "<f8", 40),
    ("east", "S1", 48),
    ("quality", "u1", 49),
    ("hdop", "<f4", 51),
)
HEADING_BY_WINRIVER = layout(("kind", "<u2", 2), ("before", "<f8", 6), ("name", "S7", 14), ("heading", "<f8", 21))
TEXT = layout(("text", "S120", 4))
BY_VMDAS = layout(
    ("day", "u1", 2),
    ("month", "u1", 3),
    ("year", "<u2", 4),
    ("first", "<u4", 6),  # [1e-4 s]
    ("last", "<u4", 22),
    ("lat", "<i4", 26),  # at the last time
    ("lon", "<i4", 30),
)
OF_VMDAS = 78  # bytes of a navigation record and more; a REMUS writes 54


class PD0:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "pd0"
    title = "Teledyne PD0 file (.pd0, .000, .ENR, .adc)"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        if len(find_ensembles(head)):
            return 0.95
        cut = head.startswith(SYNC) and len(head) > 6 and ensemble_end(head, 0) is None
        return 0.6 if cut else 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        with path.open("rb") as file:
            content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        found = find_ensembles(content, lambda done: options.progress(done, len(content)))
        if not len(found):
            raise InputError(
                f"{path}: holds no whole PD0 ensemble ({found.failed} with a wrong checksum); copy it again"
            )
        pings = decoded(content, found)
        clock = Clock(CLOCK, 0.0, ZONE_SD_S, "its calendar, taken for UTC")
        receiver, warnings = _receiver(content, found, pings.time), [*_warnings(found)]
        if receiver is not None and _jumps(receiver.time, receiver.lat, receiver.lon):
            warnings.append(f"{len(receiver.time)} fixes of {receiver.source} jump about, and are left out")
            receiver = None
        if _jumps(pings.time, *pings.position.T):
            warnings.append("positions of record 0x2000 jump about, and are left out")
            pings = replace(pings, position=np.full_like(pings.position, np.nan))
        if receiver is not None:
            clock = Clock(CLOCK, receiver.offset, receiver.offset_sd, f"{receiver.source}, written with the pings")
        made = recording(path, self.name, pings, clock, tuple(_left(found)), tuple(warnings))
        made = _with_profiles(made, content, found, pings)
        return made if receiver is None else _with(made, receiver)


FORMAT = PD0()


class _Told(NamedTuple):
    """Fixes as ensembles hold them, some of them more than once, m in all.

    Attributes
    ----------
    source : in words
    time : shape (m,), Unix time of the receiver, on the day nearest to the instrument's clock [s]
    before : shape (m,), how long before the ping it came [s]
    ensemble : shape (m,), number of the ping
    lat, lon, sd : shape (m,) [deg], [m]; an sd may be NaN
    """

    source: str
    time: Array
    before: Array
    ensemble: NDArray[np.int64]
    lat: Array
    lon: Array
    sd: Array


@dataclass(frozen=True)
class _Receiver:
    """Fixes that were written beside the pings, and headings.

    Attributes
    ----------
    source : in words
    time, lat, lon, sd : shape (n,), Unix time [s], [deg], [m]; an sd may be NaN
    offset, offset_sd : what the instrument's clock lacks of Unix time [s]
    heading_time, heading : shape (m,), relative to true north [s], [rad]
    """

    source: str
    time: Array
    lat: Array
    lon: Array
    sd: Array
    offset: float
    offset_sd: float
    heading_time: Array
    heading: Array


def _receiver(content: bytes | mmap.mmap, found: Ensembles, stamps: Array) -> _Receiver | None:
    """What the file holds of a receiver, of its most telling records; None = nothing that lies somewhere."""
    told = _by_winriver(content, found, stamps) or _by_text(content, found, stamps) or _by_vmdas(content, found, stamps)
    if told is None:
        return None
    source, time, before, ensemble, lat, lon, sd = told
    ok = np.isfinite(time + stamps[ensemble]) & (np.abs(lat) <= POLE_DEG) & (np.abs(lon) <= 180.0)
    ok &= (lat != 0.0) | (lon != 0.0)
    if not ok.any():
        return None
    late = (time + before - stamps[ensemble])[ok]
    offset = float(np.median(late))
    spread = 1.4826 * float(np.median(np.abs(late - offset)))
    first = np.unique(time[ok], return_index=True)[1]  # the newest sentence is in several ensembles
    time, lat, lon, sd = (values[ok][first] for values in (time, lat, lon, sd))
    offset_sd = max(spread, RECORDED_SD_S)
    return _Receiver(source, time, lat, lon, sd, offset, offset_sd, *_headings(content, found, stamps + offset))


def _by_winriver(content: bytes | mmap.mmap, found: Ensembles, stamps: Array) -> _Told | None:
    """Of sentences that WinRiver has decoded."""
    rows, ensemble = found.records_of(content, SENTENCES, BY_WINRIVER)
    gga = (rows["kind"] >= 100) & np.char.endswith(rows["name"], b"GGA")
    rows, ensemble = rows[gga], ensemble[gga]
    if not len(rows):
        return None
    time = _of_day([cell.decode("ascii", "replace") for cell in rows["time"]], stamps[ensemble])
    lat = np.where(rows["north"] == b"S", -rows["lat"], rows["lat"])
    lon = np.where(rows["east"] == b"W", -rows["lon"], rows["lon"])
    sd = np.array([RANGE_SD_M.get(int(quality), np.nan) for quality in rows["quality"]]) * rows["hdop"]
    lat[~np.isin(rows["quality"], [*RANGE_SD_M])] = np.nan
    return _Told("record 0x2022 (GGA)", time, rows["before"], ensemble, lat, lon, np.where(sd > 0.0, sd, np.nan))


def _by_text(content: bytes | mmap.mmap, found: Ensembles, stamps: Array) -> _Told | None:
    """The same of sentences as they came, without a stated delay."""
    rows, ensemble = found.records_of(content, GGA, TEXT)
    cells = [[*text.decode("ascii", "replace").split(","), *[""] * 9] for text in rows["text"]]
    if not cells:
        return None
    time = _of_day([row[1] for row in cells], stamps[ensemble])
    lat, lon = (
        np.array([_degrees(row[k], digits) * (-1.0 if row[k + 1] == away else 1.0) for row in cells])
        for k, digits, away in ((2, 2, "S"), (4, 3, "W"))
    )
    range_sd = [RANGE_SD_M.get(int(row[6]) if row[6].isdigit() else 0, np.nan) for row in cells]
    sd = np.array([of_range * (number(row[8]) or np.nan) for of_range, row in zip(range_sd, cells, strict=True)])
    lat[np.isnan(range_sd)] = np.nan
    return _Told("record 0x2101 (GGA)", time, np.zeros(len(time)), ensemble, lat, lon, sd)


def _by_vmdas(content: bytes | mmap.mmap, found: Ensembles, stamps: Array) -> _Told | None:
    at, length = found.at[NAVIGATION], found.length[NAVIGATION]
    rows, there = gathered(content, BY_VMDAS, at, length, OF_VMDAS)
    ensemble = np.flatnonzero(there)
    rows = rows[there]
    if not len(rows):
        return None
    date = (rows[name].astype(np.int64) for name in ("year", "month", "day"))
    day = unix_of_calendar(*date, *np.zeros((3, len(rows)), np.int64))
    time = day + 1e-4 * rows["last"] + DAY_S * (rows["last"] < rows["first"])
    lat, lon = SEMICIRCLE * rows["lat"], SEMICIRCLE * rows["lon"]
    nothing = np.full(len(rows), np.nan)
    return _Told("record 0x2000 of VmDas", time, np.zeros(len(rows)), ensemble, lat, lon, nothing)


def _headings(content: bytes | mmap.mmap, found: Ensembles, pinged: Array) -> tuple[Array, Array]:
    """Times and headings [rad] of HDT sentences; ``pinged`` is the Unix time of each ensemble [s]."""
    rows, ensemble = found.records_of(content, SENTENCES, HEADING_BY_WINRIVER)
    hdt = (rows["kind"] >= 100) & np.char.endswith(rows["name"], b"HDT")
    time, degrees = (pinged[ensemble] - rows["before"])[hdt], rows["heading"][hdt]
    if not hdt.any():
        rows, ensemble = found.records_of(content, HEADING, TEXT)
        cells = [text.decode("ascii", "replace").split(",") for text in rows["text"]]
        told = [number(row[1]) if len(row) > 2 and row[0].endswith("HDT") else None for row in cells]
        degrees = np.array(told, float)
        time = pinged[ensemble]
    ok = np.isfinite(time) & (degrees >= 0.0) & (degrees <= 360.0)
    return time[ok], np.deg2rad(degrees[ok])


def _of_day(clocks: list[str], about: Array) -> Array:
    """Unix time of times of day as ``hhmmss.ss``, on the day nearest to the instrument's clock."""
    days = [day_time(clock) for clock in clocks]
    seconds = [
        np.nan if t is None else 3600.0 * t.hour + 60.0 * t.minute + t.second + 1e-6 * t.microsecond for t in days
    ]
    time = np.array(seconds)
    return np.asarray(time + DAY_S * np.round((about - time) / DAY_S))


def _degrees(cell: str, digits: int) -> float:
    """Of degrees and minutes as a sentence has them; NaN for invalid ones."""
    degrees, minutes = number(cell[:digits]), number(cell[digits:])
    return np.nan if degrees is None or minutes is None else degrees + minutes / 60.0


def _jumps(time: Array, lat: Array, lon: Array) -> bool:
    """Whether positions are further apart than any vehicle goes."""
    ok = np.isfinite(time + lat + lon)
    if ok.sum() < 3:
        return False
    way = np.hypot(np.diff(lat[ok]), np.diff(lon[ok]) * np.cos(np.deg2rad(lat[ok][1:]))) * DEG_M
    seconds = np.maximum(np.abs(np.diff(time[ok])), 0.1)
    return bool(np.median(way / seconds) > FASTEST)


def _with(made: Recording, receiver: _Receiver) -> Recording:
    """A recording with what it holds of a receiver."""
    columns = {"time": receiver.time, "fix_lat": receiver.lat, "fix_lon": receiver.lon, "fix_sd": receiver.sd}
    more = [Channel("fix", columns, receiver.source, "", UTC)]
    settings = {**made.settings}
    warnings = [f"fixes are those of {receiver.source}: see that it is the vehicle's, and state fix.lever_arm_m"]
    if len(receiver.heading):
        pointing = {"time": receiver.heading_time, "ahrs_yaw": receiver.heading}
        more.append(Channel("ahrs", pointing, "HDT sentences", "the vessel's, true north", UTC))
        settings["heading"] = {"ahrs_reference": "true"}
    clocks = {**made.clocks, UTC: Clock(UTC, 0.0, 0.0, "its stamps are Unix time")}
    return replace(
        made,
        channels=(*made.channels, *more),
        clocks=clocks,
        settings=settings,
        warnings=(*made.warnings, *warnings),
    )


def decoded(content: bytes | mmap.mmap, found: Ensembles) -> Pings:
    """The values of the ensembles of a file, or of a part of one."""
    fixed, _ = found.records(content, FIXED)
    variable, _ = found.records(content, VARIABLE)
    bottom, tracked = found.records(content, BOTTOM)
    navigation, navigated = found.records(content, NAVIGATION)
    rpy = np.deg2rad(0.01 * np.column_stack([variable[name].astype(float) for name in ("roll", "pitch", "heading")]))
    system = (fixed["coordinates"] >> 3) & 3
    attitude = _attitude(fixed, system, rpy)
    values, water = _velocities(bottom, "velocity"), _velocities(bottom, "water")
    silent = ~np.any(bottom["correlation"], axis=1) & ~np.any(bottom["range"], axis=1)
    values[silent | ~tracked] = np.nan
    water[~tracked | ~np.any(np.nan_to_num(water), axis=1)] = np.nan  # zeros throughout: it tracks no water
    velocity, error = forward_starboard_down(values, system, attitude)
    through, _ = forward_starboard_down(water, system, attitude)
    ranges = 0.01 * (bottom["range"] + 65536.0 * bottom["range_high"])
    position = SEMICIRCLE * np.column_stack([navigation["lat"], navigation["lon"]])
    navigated &= np.array(found.length[NAVIGATION]) < OF_VMDAS
    nowhere = ~navigated | (np.abs(position[:, 0]) > POLE_DEG) | ~np.any(position, axis=1)
    position[nowhere] = np.nan
    return Pings(
        time=_time(variable["date"], variable["century"]),
        system=system,
        velocity=-velocity,
        water=-through,
        error=error,
        rpy=rpy,
        bias=np.deg2rad(0.01 * fixed["bias"]),
        alignment=np.deg2rad(0.01 * fixed["alignment"]),
        tilted=attitude.tilted,
        depth=0.1 * variable["depth"],
        range=np.where(ranges > 0.0, ranges, np.nan),
        beams=np.where((system == BEAM)[:, None], values, np.nan),
        quality={name: bottom[name].astype(float) for name in ("correlation", "amplitude")},
        percent_good=np.where(tracked[:, None], bottom["percent_good"], 0).astype(float),
        sound=variable["sound"].astype(float),
        temperature=np.where(fixed["source"] & THERMOMETER, 0.01 * variable["temperature"], np.nan),
        salinity=np.where(fixed["source"] & COMPUTED_SOUND, np.nan, variable["salinity"]),
        head=_head(attitude),
        position=position,
        tracked=tracked,
    )


def _with_profiles(made: Recording, content: bytes | mmap.mmap, found: Ensembles, pings: Pings) -> Recording:
    """A recording with the cells of the profiles that look down, or up where none does, as a table."""
    fixed, _ = found.records(content, FIXED)
    most = int(fixed["cells"].max(initial=0))
    rows, ensemble = found.records_of(content, PROFILE, layout(("velocity", f"({most},4)<i2", 2)))
    size = np.array(found.several[PROFILE], np.int64).reshape(-1, 3)[:, 2]
    attitude, raw = _attitude(fixed, pings.system, pings.rpy), rows["velocity"]
    heard = np.arange(most) < np.minimum(fixed["cells"][ensemble], (size - 2) // 8)[:, None]
    heard = heard[:, :, None] & (raw != BAD) & raw.any(axis=2, keepdims=True)  # zeros throughout: not measured
    heard &= (np.isfinite(pings.time) & (fixed["first"] > 0))[ensemble, None, None]
    up = attitude.upward[ensemble] & heard.any(axis=(1, 2))
    away = up & bool((heard.any(axis=(1, 2)) & ~up).any())
    row, cell = np.nonzero(heard.any(axis=2) & ~away[:, None])
    if not len(row):
        return made
    of = ensemble[row]
    system, rpy = pings.system[of], attitude.rpy[of]
    values = np.where(heard[row, cell], 0.001 * raw[row, cell], np.nan)
    by_cell = Attitude(rpy, attitude.tilted[of], attitude.upward[of], attitude.beam_angle[of], attitude.convex[of])
    velocity, error = forward_starboard_down(values, system, by_cell)
    along = (system == BEAM) & (pings.head is not None)
    alike, number = found.records_of(content, CORRELATION, layout(("value", f"({most},4)u1", 2)))
    third = np.zeros((len(found), most))
    third[number] = np.sort(alike["value"], axis=2)[:, :, 1]
    sd = _noise(error, third[of, cell], cell)
    of_three = np.isnan(error) & ~along & (np.isfinite(error).sum() > 0.5 * len(of))
    faint = ~of_three & (third[of, cell] < FAINT) & third.any()
    mapped = (system >= SHIP) & by_cell.tilted & (fixed["coordinates"][of] & MAPPED != 0)
    level = np.where(mapped, np.cos(rpy[:, 0]) * np.cos(rpy[:, 1]), 1.0)  # by it, ranges of these are depths
    tilted = bool(np.ptp(pings.rpy[:, :2], axis=0).any())
    cells = {
        "time": pings.time[of],
        "range": 0.01 * (fixed["first"][of] + cell * fixed["length"][of].astype(float)) / level,
        "cell": 0.01 * fixed["length"][of] / level,
        **dict(zip(("vx", "vy", "vz"), np.where(along, np.nan, -velocity.T), strict=True)),
        **{f"beam_{k + 1}": np.where(along, values[:, k], np.nan) for k in range(4)},
        "sd": sd,
        "bottom": np.fmin.reduce(pings.range, axis=1)[of],
        **({"roll": rpy[:, 0], "pitch": rpy[:, 1]} if tilted else {}),
    }
    unused = [("cell", of_three, "of three beams"), ("cell", faint, "low correlation")]
    unused.append(("profile", away, "looks the other way"))
    settings = {**made.settings, "water": {"beam_angle_deg": round(float(np.rad2deg(by_cell.beam_angle.max())), 3)}}
    if up.any() and not away.any():
        settings["water"]["looks"] = "up"
    if along.any() and pings.head is not None:
        settings["dvl"] = {"beams": beams_setting(pings.head)} | settings.get("dvl", {})
    return replace(
        made,
        left=(*made.left, *(Left(what, int(bad.sum()), why) for what, bad, why in unused if bad.any())),
        settings=settings,
        tables={**made.tables, CELLS: {n: v[~(of_three | faint)] for n, v in cells.items() if np.isfinite(v).any()}},
    )


def _noise(error: Array, correlation: Array, cell: NDArray[np.int64]) -> Array:
    """Noise of a horizontal axis, by the error velocities of cells of like correlation, shape (n,); NaN = not known.

    The error velocity has the variance of X and of Y. Without correlations, cells of like number stand together.
    """
    out, known = np.full(len(error), np.nan), np.flatnonzero(np.isfinite(error))
    order = known[np.lexsort((cell[known], correlation[known]))]
    if len(order) >= FEWEST:
        for group in np.array_split(order, min(MOST_GROUPS, len(order) // FEWEST)):
            out[group] = 1.4826 * np.median(np.abs(error[group]))
    return np.where(out > 0.0, out, np.nan)


def _attitude(fixed: NDArray[np.void], system: NDArray[np.integer], rpy: Array) -> Attitude:
    """How the velocities of ensembles came to their axes.

    Roll and pitch in ship axes that no sensor of its own measures were written in by the vehicle afterwards, as a REMUS
    does, and are not in the velocities: the depth in its files changes with its pitch, not with its vertical velocity.
    """
    measured = (fixed["source"] & LEVEL_SENSORS) == LEVEL_SENSORS
    angle = np.where(fixed["beam_angle"] <= 45, fixed["beam_angle"], 0).astype(float)
    angle = np.where(angle > 0.0, angle, np.array(ANGLES)[(fixed["system"] >> 8) & 3])
    gimballed = rpy.copy()
    gimballed[:, 1] = np.where(measured, np.arctan(np.tan(rpy[:, 1]) * np.cos(rpy[:, 0])), rpy[:, 1])
    return Attitude(
        rpy=gimballed,
        tilted=(measured | (system == EARTH)) & (fixed["coordinates"] & 0b100 != 0),
        upward=fixed["system"] & 0x80 != 0,
        beam_angle=np.deg2rad(angle),
        convex=fixed["system"] & 0x08 != 0,
    )


def _head(attitude: Attitude) -> BeamHead | None:
    """The beams of all ensembles, which look down."""
    heads = np.unique(np.column_stack([attitude.beam_angle, attitude.convex, attitude.upward]), axis=0)
    one = len(heads) == 1 and not heads[0, 2]
    return BeamHead(round(float(np.rad2deg(heads[0, 0])), 3), bool(heads[0, 1])) if one else None


def _velocities(bottom: NDArray[np.void], name: str) -> Array:
    raw = bottom[name]
    return np.where(raw == BAD, np.nan, 0.001 * raw)


def _time(date: NDArray[np.uint8], century: NDArray[np.uint8]) -> Array:
    """Seconds since 1970 of calendar dates, of which years may have two digits; NaN for invalid ones."""
    year, month, day, hour, minute, second, hundredths = date.astype(np.int64).T
    full = np.where((century == 19) | (century == 20), 100 * century.astype(np.int64), 2000) + year
    seconds = unix_of_calendar(full, month, day, hour, minute, second)
    return np.where((year < 100) & (hundredths < 100), seconds + 0.01 * hundredths, np.nan)


def _left(found: Ensembles) -> Iterator[Left]:
    for kind, count in sorted(found.others.items()):
        yield Left(OTHERS.get(kind, f"record {kind:#06x}"), count, "no measurement of a sensor")
    if found.failed:
        yield Left("ensemble", found.failed, "a wrong checksum")


def _warnings(found: Ensembles) -> Iterator[str]:
    if found.failed:
        yield f"{found.failed} ensembles with a wrong checksum are left out"
    if found.skipped:
        yield f"{found.skipped} bytes belong to no whole ensemble"
