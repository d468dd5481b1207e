"""iXblue STDBIN, versions 2 to 5: what an inertial unit (PHINS, ROVINS...) sends of itself and of its aiding sensors.

A frame is ``IX``, a version, masks of its blocks (of navigation; from version 3 on of extended navigation; of external
sensors), its size, the time of day in steps of 100 us, a counter, the blocks in the order of their bits, and the sum of
all bytes before. All is big-endian. A block of an external sensor has a time of its own. Axes of the vehicle are
forward, port, up. Roll is positive with port up, pitch with the bow down.

Sources: the decoder that the maker publishes (ixblue_stdbin_decoder, MIT) and WHOI's ds_sensors for the layout; frames
of real units in the tests of the former for the sign of pitch (speeds along the vehicle's axes and to north, east, up).
"""

import mmap
from array import array
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log.stamps import DAY_S, unwrapped
from rovgraph.log.streams import STREAMS, label_number
from rovgraph.readers.acoustic_channels import places_to_state
from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.recording import Channel, Clock, Left, Recording, preferred_first, sound_of_dvl, too_slow
from rovgraph.readers.records import gathered
from rovgraph.readers.stamps import unix_of_calendar

MARK, SUM = b"IX", 4  # bytes of the sum
HEADS = {  # of each version: its masks, and where size and time are, behind which the counter is
    2: np.dtype([("mark", "S3"), ("masks", "2>u4"), ("size", ">u2"), ("time", ">u4"), ("count", ">u4")]),
    3: np.dtype([("mark", "S3"), ("masks", "3>u4"), ("size", ">u2"), ("time", ">u4"), ("count", ">u4")]),
    4: np.dtype([
        ("mark", "S3"), ("masks", "3>u4"), ("navigation", ">u2"), ("size", ">u2"), ("time", ">u4"), ("count", ">u4"),
    ]),
}  # fmt: skip
HEADS[5] = HEADS[4]
TICK_S = 1e-4
PROGRESS = 1 << 20  # bytes
CLOCK = "the unit's clock"
CLOCK_SD_S = 0.01
UNSET_YEAR = 2006  # of a clock that nothing has set
ALIGNED_DEG = 10.0  # sd of a heading, beyond which the unit has not found north
GRAVITY_MPS2 = 9.4, 10.2  # of a specific force that is given with all its digits
FRAME = "forward, port, up of the vehicle"


def _block(fields: str) -> np.dtype[np.void]:
    return np.dtype([(name, f">{kind}") for name, kind in (field.split(":") for field in fields.split())])


def _opaque(*sizes: int) -> list[np.dtype[np.void]]:
    return [np.dtype(f"V{size}") for size in sizes]


VECTOR = _block("x:f4 y:f4 z:f4")
FIX = "lat:f8 lon:f8 altitude:f4"
GNSS = _block(f"time:i4 id:u1 quality:u1 {FIX} north_sd:f4 east_sd:f4 altitude_sd:f4 covariance:f4 geoid:f4")
USBL = _block(f"time:i4 id:u1 name:S8 {FIX} north_sd:f4 east_sd:f4 covariance:f4 altitude_sd:f4")
LBL = _block(f"time:i4 id:u1 name:S8 {FIX} range:f4 sd:f4")
BOTTOM = _block("time:i4 id:u1 x:f4 y:f4 z:f4 sound:f4 altitude:f4 x_sd:f4 y_sd:f4 z_sd:f4")
WATER = _block("time:i4 id:u1 x:f4 y:f4 z:f4 sound:f4 x_sd:f4 y_sd:f4 z_sd:f4")
ATTITUDE = _block("heading:f4 roll:f4 pitch:f4")
NAVIGATION = dict(enumerate(_opaque(
    12, 12, 16, 8, 12, 12, 12, 21, 16, 12, 12, 8, 8, 4, 8, 16, 12, 4, 4, 12, 4, 12, 12, 12, 8, 12, 16, 12, 12, 12, 12
)))  # fmt: skip
NAVIGATION |= {0: ATTITUDE, 1: ATTITUDE, 13: _block("day:u1 month:u1 year:u2"), 28: VECTOR}
EXTENDED = dict(enumerate(_opaque(12, 12, 12, 12, 12, 21, 16))) | {2: VECTOR}
EXTERNAL = dict(zip((0, 4, 5, 12, 13, 18, 19, 20, 24, 25, 26, 27),
                    _opaque(5, 13, 13, 8, 8, 9, 9, 9, 16, 17, 17, 12), strict=True))  # fmt: skip
EXTERNAL |= dict.fromkeys((1, 2, 3), GNSS) | dict.fromkeys((6, 7, 8), USBL) | dict.fromkeys((14, 15, 16, 17), LBL)
EXTERNAL |= {9: _block("time:i4 depth:f4 sd:f4"), 10: BOTTOM, 21: BOTTOM, 11: WATER, 22: WATER}
TABLES = {"navigation": NAVIGATION, "extended": EXTENDED, "external": EXTERNAL}
LEFT = {
    ("navigation", 7): "the unit's own position",
    ("navigation", 9): "the unit's own velocity",
    ("navigation", 6): "acceleration without gravity, by the unit's own filter",
    ("external", 3): "positions that a person typed",
    ("external", 4): "electromagnetic log",
    ("external", 5): "electromagnetic log",
    ("external", 12): "speed of sound beside the DVL's",
}

Block = tuple[str, int]  # its table and bit
DATE: Block = "navigation", 13


Kind = tuple[int, tuple[int, int, int]]  # version, and masks of navigation, extended, external: frames alike


class Frame(NamedTuple):
    """A frame whose sum is right: its first byte, its time [ticks], its kind."""

    at: int
    time: int
    kind: Kind


@dataclass(frozen=True)
class BlockSeries:
    """What all frames hold in one block.

    Attributes
    ----------
    time : of the frame, without its wraps at midnight, shape (n,) [s]
    values : shape (n,)
    """

    time: Array
    values: NDArray[np.void]

    def vector(self) -> Array:
        """Along the axes forward, port, up, shape (n, 3)."""
        return np.column_stack([self.values[axis].astype(float) for axis in "xyz"])

    def fresh(self) -> "BlockSeries":
        """By the times of its own, in their order, each time once."""
        own = TICK_S * self.values["time"].astype(float)
        time = self.time + (own - self.time + 0.5 * DAY_S) % DAY_S - 0.5 * DAY_S
        time, first = np.unique(time.round(5), return_index=True)
        return BlockSeries(time, self.values[first])


class Stdbin:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "stdbin"
    title = "iXblue STDBIN recording"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        return 0.9 if next(_frames(head, Counter()), None) is not None else 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        left, size = Counter[tuple[str, str]](), path.stat().st_size
        with path.open("rb") as file:
            content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        at, time, told = array("q"), array("q"), 0
        kinds: dict[Kind, array[int]] = {}
        for frame in _frames(content, left):
            kinds.setdefault(frame.kind, array("q")).append(len(at))
            at.append(frame.at)
            time.append(frame.time)
            if frame.at - told > PROGRESS:
                options.progress(told := frame.at, size)
        options.progress(size, size)
        if not at:
            raise InputError(f"{path}: holds no whole STDBIN frame; copy it again")
        found = _found(content, np.array(at), {kind: np.array(rows) for kind, rows in kinds.items()}, left)
        steady, clock = _clock(TICK_S * np.array(time, float), found, left)
        blocks = {}
        for block, (row, values) in found.items():
            set_ = np.isfinite(steady[row])
            blocks[block] = BlockSeries(steady[row][set_], values[set_])
        channels, settings, said = _channels(path, options, blocks, left)
        if not channels:
            raise InputError(f"{path}: its frames hold nothing that a log has; have the unit send its external sensors")
        lost = tuple(Left(name, count, why) for (name, why), count in sorted(left.items()) if count)
        clocks = {CLOCK: clock}
        return Recording(str(path), self.name, tuple(channels), clocks, lost, settings, warnings=tuple(said))


FORMAT = Stdbin()


def _frames(content: bytes | mmap.mmap, left: Counter[tuple[str, str]]) -> Iterator[Frame]:
    """Every frame whose sum is right."""
    at = content.find(MARK)
    while 0 <= at < len(content) - 3:
        version = content[at + 2]
        head = HEADS.get(version)
        if head is not None and at + head.itemsize <= len(content):
            fields = np.frombuffer(content[at : at + head.itemsize], head)[0]
            end = at + int(fields["size"])
            body = content[at : end - SUM]
            stated = int.from_bytes(content[end - SUM : end], "big")
            if head.itemsize + SUM <= end - at and end <= len(content) and sum(body) == stated:
                navigation, *extended, external = map(int, fields["masks"])
                yield Frame(at, int(fields["time"]), (version, (navigation, sum(extended), external)))
                at = content.find(MARK, end)
                continue
            left["frames", "cut off, or with a wrong sum"] += 1
        at = content.find(MARK, at + 1)


def _layout(masks: Sequence[int], left: Counter[tuple[str, str]], frames: int) -> np.dtype[np.void]:
    """Blocks of a frame, behind its head; those behind one whose size is not known are not among them."""
    fields: list[tuple[str, np.dtype[np.void]]] = []
    for (table, blocks), mask in zip(TABLES.items(), masks, strict=True):
        for bit in (bit for bit in range(32) if mask >> bit & 1):
            if bit not in blocks:
                left[f"{table} block {bit}", "of unknown size, with all blocks behind it"] += frames
                return np.dtype(fields)
            fields.append((f"{table} {bit}", blocks[bit]))
    return np.dtype(fields)


def _found(
    content: mmap.mmap, at: NDArray[np.int64], kinds: Mapping[Kind, NDArray[np.int64]], left: Counter[tuple[str, str]]
) -> dict[Block, tuple[NDArray[np.int64], NDArray[np.void]]]:
    """In which frames each block is, increasing, and what it holds there."""
    parts: dict[Block, list[tuple[NDArray[np.int64], NDArray[np.void]]]] = defaultdict(list)
    for (version, masks), rows in kinds.items():
        layout = _layout(masks, left, len(rows))
        first = (at[rows] + HEADS[version].itemsize).tolist()
        values, there = gathered(content, layout, first, [layout.itemsize] * len(rows), layout.itemsize)
        for name in layout.names or ():
            table, bit = name.split()
            parts[table, int(bit)].append((rows[there], values[name][there]))
    out = {}
    for block, found in parts.items():
        row = np.concatenate([rows for rows, _ in found])
        order = np.argsort(row)
        out[block] = row[order], np.concatenate([values for _, values in found])[order]
    return out


def _clock(
    time: Array, found: Mapping[Block, tuple[NDArray[np.int64], NDArray[np.void]]], left: Counter[tuple[str, str]]
) -> tuple[Array, Clock]:
    """Times of day without their wraps, shape (n,), NaN before the clock was set [s]; what they lack of Unix time."""
    if DATE not in found:
        return unwrapped(time, DAY_S), Clock(CLOCK, cycle=DAY_S if ("external", 0) in found else 0.0)
    row, values = found[DATE]
    year, month, day = (values[name].astype(np.int64) for name in ("year", "month", "day"))
    zero, date = np.zeros_like(year), np.full(len(time), np.nan)
    date[row] = np.where(year > UNSET_YEAR, unix_of_calendar(year, month, day, zero, zero, zero), np.nan)
    if not np.isfinite(date).any():
        return unwrapped(time, DAY_S), Clock(CLOCK)
    left["frames", "before the unit's clock was set"] += int(np.isnan(date).sum())
    steady = unwrapped(np.where(np.isfinite(date), time, np.nan), DAY_S)
    offset = float(np.nanmedian(date + time - steady))
    return steady, Clock(CLOCK, offset, CLOCK_SD_S, "the unit's date and time of day, taken for UTC")


def _channels(
    path: Path, options: ReadingOptions, blocks: Mapping[Block, BlockSeries], left: Counter[tuple[str, str]]
) -> tuple[list[Channel], dict[str, Any], list[str]]:
    """Channels, settings for them, and what may be wrong."""
    for block, why in LEFT.items():
        if block in blocks:
            left[f"{block[0]} block {block[1]}", why] += len(blocks[block].time)
    out: list[Channel] = []
    settings: dict[str, Any] = {}
    for channels, stated in (_inertial(blocks, left), _attitude(blocks, left), _doppler(blocks)):
        out += channels
        settings |= stated
    if ("external", 9) in blocks:
        rows = blocks["external", 9].fresh()
        out.append(_channel("depth", "depth sensor", {"time": rows.time, "depth": rows.values["depth"].astype(float)}))
    ranges, said = _ranges(blocks)
    out += [*ranges, *_fixes(path, options, blocks)]
    if "dvl" in settings:
        said.append("DVL: its velocities are taken along forward, port, up of the vehicle, as the unit names its axes")
    for channel in out:
        if channel.sensor == "imu":
            said += too_slow(channel.columns["time"], channel.source, "have the unit send at 50 Hz or more")
    return out, settings, said


def _channel(sensor: str, source: str, columns: Mapping[str, Array], frame: str = "") -> Channel:
    return Channel(sensor, columns, source, frame, CLOCK)


Found = tuple[list[Channel], dict[str, Any]]  # channels, and settings for them


def _inertial(blocks: Mapping[Block, BlockSeries], left: Counter[tuple[str, str]]) -> Found:
    """Specific force and rate, where the unit gives them with all their digits."""
    force, rate = blocks.get(("navigation", 28)), blocks.get(("extended", 2))
    if force is None or rate is None or not np.array_equal(force.time, rate.time):
        return [], {}
    low, high = GRAVITY_MPS2
    if not low < np.median(np.linalg.norm(force.vector(), axis=1)) < high or not rate.vector().any():
        left["acceleration and rate", "without the digits that navigation needs: the unit keeps them back"] += len(
            force.time
        )
        return [], {}
    columns = dict(zip(STREAMS["imu"], [*force.vector().T, *np.deg2rad(rate.vector()).T], strict=True))
    channel = _channel("imu", "raw acceleration and rate", {"time": force.time, **columns}, FRAME)
    return [channel], {"imu": {"mount_rpy_deg": [180.0, 0.0, 0.0]}}


def _attitude(blocks: Mapping[Block, BlockSeries], left: Counter[tuple[str, str]]) -> Found:
    """The unit's heading, roll and pitch, once it has found north."""
    if ("navigation", 0) not in blocks:
        return [], {}
    rows, known = blocks["navigation", 0], np.ones(len(blocks["navigation", 0].time), bool)
    sd = blocks.get(("navigation", 1))
    if sd is not None and np.array_equal(sd.time, rows.time):
        known = sd.values["heading"] < ALIGNED_DEG
        left["attitude", f"while the unit states an sd of its heading of more than {ALIGNED_DEG:.0f} deg"] += int(
            (~known).sum()
        )
    if not known.any():
        return [], {}
    heading, roll, pitch = (np.deg2rad(rows.values[name][known].astype(float)) for name in ("heading", "roll", "pitch"))
    time, frame = rows.time[known], "forward, starboard, down of the vehicle"
    tilt = _channel("vehicle_tilt", "attitude", {"time": time, "roll": roll, "pitch": -pitch}, frame)
    turn = _channel("vehicle_heading", "attitude", {"time": time, "heading": heading}, "from true north")
    return [turn, tilt], {"heading": {"vehicle_reference": "true"}}


def _doppler(blocks: Mapping[Block, BlockSeries]) -> Found:
    """Bottom and water track of the first DVL that has them."""
    out: list[Channel] = []
    settings: dict[str, Any] = {}
    bottom = next((blocks["external", bit] for bit in (10, 21) if ("external", bit) in blocks), None)
    water = next((blocks["external", bit] for bit in (11, 22) if ("external", bit) in blocks), None)
    if bottom is not None:
        rows = bottom.fresh()
        sd = np.sqrt(np.mean([rows.values[f"{axis}_sd"].astype(float) ** 2 for axis in "xyz"], axis=0))
        columns = dict(zip(STREAMS["dvl"][:3], rows.vector().T, strict=True))
        out.append(_channel("dvl", "DVL bottom track", {"time": rows.time, **columns, "dvl_sd": sd}, FRAME))
        altitude = rows.values["altitude"].astype(float)
        high = altitude > 0.0
        if high.any():
            at = {"time": rows.time[high], "dvl_altitude": altitude[high]}
            out.append(_channel("dvl_altitude", "DVL bottom track", at))
        sound = rows.values["sound"].astype(float)
        channels, set_speed = sound_of_dvl(rows.time, sound, np.full(len(sound), np.nan), "DVL bottom track", CLOCK)
        out, settings = out + channels, {"dvl": {"mount_rpy_deg": [180.0, 0.0, 0.0], **set_speed}}
    if water is not None:
        rows = water.fresh()
        columns = dict(zip(STREAMS["dvl_water"], rows.vector().T, strict=True))
        out.append(_channel("dvl_water", "DVL water track", {"time": rows.time, **columns}, FRAME))
        settings.setdefault("dvl", {"mount_rpy_deg": [180.0, 0.0, 0.0]})
    return out, settings


def _name(text: bytes) -> str:
    return text.partition(b"\0")[0].decode("ascii", "replace").strip()


def _ranges(blocks: Mapping[Block, BlockSeries]) -> tuple[list[Channel], list[str]]:
    """Ranges to beacons, and what states where these are."""
    parts = [blocks["external", bit].fresh() for bit in (14, 15, 16, 17) if ("external", bit) in blocks]
    if not parts:
        return [], []
    time, values = (np.concatenate([getattr(rows, of) for rows in parts]) for of in ("time", "values"))
    order = np.argsort(time, kind="stable")
    time, values = time[order], values[order]
    names = np.array([_name(text) for text in values["name"]])
    sd = values["sd"].astype(float)
    columns = {
        "time": time,
        "range": values["range"].astype(float),
        "range_beacon": np.array([label_number(name) if name else np.nan for name in names]),
        "range_sd": np.where(sd > 0.0, sd, np.nan),
    }
    places = {
        name: (name, float(at["lat"]), _signed(float(at["lon"])), -float(at["altitude"]))
        for name, at in zip(names.tolist(), values, strict=True)
        if name
    }
    said = [places_to_state("LBL", list(places.values()))] if places else []
    return [_channel("range", "LBL", columns)], said


def _signed(longitude: float) -> float:
    return (longitude + 180.0) % 360.0 - 180.0


def _fixes(path: Path, options: ReadingOptions, blocks: Mapping[Block, BlockSeries]) -> list[Channel]:
    """Fixes by transponder and receiver, those of transponders before those of satellites, the most first."""
    made: dict[str, tuple[bool, Channel]] = {}
    for bit in (6, 7, 8, 1, 2):
        if ("external", bit) not in blocks:
            continue
        acoustic = bit > 2
        rows = blocks["external", bit].fresh()
        labels = np.array([f"USBL {_name(text)}" for text in rows.values["name"]] if acoustic else [f"GNSS {bit}"])
        for label in dict.fromkeys(labels.tolist()):
            of = np.broadcast_to(labels == label, len(rows.time))
            name = label if label not in made else f"{label} of system {bit - 5}"
            made[name] = acoustic, _fix(name, rows.time[of], rows.values[of])
    order = sorted(made, key=lambda name: (not made[name][0], -len(made[name][1].columns["time"])))
    return [made[name][1] for name in preferred_first(path, "fix", order, options.choose)]


def _fix(name: str, time: Array, values: NDArray[np.void]) -> Channel:
    north, east, covariance = (values[field].astype(float) for field in ("north_sd", "east_sd", "covariance"))
    columns = {
        "time": time,
        "fix_lat": values["lat"].astype(float),
        "fix_lon": np.array([_signed(value) for value in values["lon"].astype(float)]),
        "fix_sd": np.where(north > 0.0, north, np.nan),
        "fix_east_sd": np.where(east > 0.0, east, np.nan),
    }
    return _channel("fix", name, columns | ({"fix_cov_ne": covariance} if covariance.any() else {}))
