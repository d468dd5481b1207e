"""Sentences of acoustic positioning systems: from one line to what it tells, for files and live alike.

A head tells where a transponder is relative to it (`Reply`), a whole system where it is on Earth (`Position`); some
tell how the ship lay at a ping (`ShipAttitude`). Axes are turned to forward, starboard and down, or north, east and
down; what is no reply is refused with its reason. Fields count from 1 after the name of a sentence:

======================  ===============================================================================================
``PSIMSSB``             1 time, UTC or local, 2 transponder, 3 status, 4 error, 5 coordinates, 6 orientation, 7 filter,
                        8 to 10 x, y, depth, 11 expected accuracy, 12 what follows (D: a depth sensor's). x is
                        starboard and y forward (H), north and east (N), east and north (E). Status A may stand
                        without a reply: an error code (NRy) means that there was none, and the position is then zero
                        or extrapolated, as it is with filter P (predicted). M is measured, F filtered, which follows
                        turns late. Coordinates D are latitude, N or S, longitude, E or W in the place of x and y, so
                        that what follows stands two fields later.
``PSIMSNS``             1 time, 2 transponder, 5 roll, 6 pitch, 8 heading of the ship at a ping
``PSIMLBP``             1 time, 2 array, 4 status, 5 coordinates, 6 to 8 x, y, depth, 9, 10 semi-axes
``PTSAG``               1 frame, 2 time, 3 to 5 day, month, year, 6 number (0 the ship), 7 to 10 latitude and longitude,
                        11 hydrophones that heard it, a bit each, 12 depth, 13 its validity, 14 sensor's depth
``PTSAX``, ``PTSAY``    1 to 6 the same, 7, 8 x forward and y starboard, or north and east, 9 hydrophones, 10 depth,
                        11 its validity
``PTSAH``               2 heading
``PSONLLD``             1 UTC, 2 beacon, 3 status, 4, 5 degrees, 6 depth, 7, 8 semi-axes (1 sd), 9 direction of 7
``PSONALL``             1 name, 3 time, 4, 5 easting and northing, 6 depth, 7 heading, 10 pitch, 11 roll, 13 sd
``USRTH``               2 bearing in the receiver's axes, 3 elevation (up), 4 slant range, 6, 7 both relative to north
``USBLLONG``            1 time now, 2 time of measurement, 3 remote, 4 to 6 x, y, z, 13 one-way propagation time [us],
                        16 accuracy [m], negative = not valid
``USBLANGLES``          1 to 3 the same, 4, 5 bearing and elevation, 13 accuracy [rad], negative = not valid
``%D...``               MicronNav: number, x starboard, y forward, z down [mm], quality, receivers, local time
``$`` and hexadecimal   SeaTrac: identifier, acoustic fix, CRC-16, low byte first
======================  ===============================================================================================

Sources: Kongsberg Simrad, HiPAP/HPR 400 NMEA 0183 sentences, 850-160045; iXblue, GAPS user guide, MU-GAPS-AN-005;
Cerulean Sonar, ROVL; Tritech, MicronNav manual, 0656-SOM-00001; Blueprint Subsea, SeaTrac serial interface,
UM-140-D00221; the drivers of LSTS' dune and of EvoLogics for S2C modems; WHOI's ds_sensors for PSONLLD.
"""

import math
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from typing import Literal

from rovgraph.log.stamps import DAY_S
from rovgraph.model.config_sections import FASTEST_MPS, SLOWEST_MPS
from rovgraph.readers.nmea_sentences import has_checksum, number
from rovgraph.readers.records import Refused, shown

HALF_HOUR_S = 1800.0
FARTHEST_M = 20e3  # of a reply: farther, eastings and northings were taken for a relative position
UNKNOWN_ACCURACY_M = 20.0  # that a system states where it knows none
LEAST_HYDROPHONES = 3
WORST_FIT = 3.0  # of a SeaTrac's head, from which on its direction is wrong
NO_REPLY, NO_POSITION = "no reply", "no position"
Frame = Literal["transducer", "ship", "north"]
Noise = tuple[float, float, float]  # sd of north; of east, and covariance, where they are not alike and independent


@dataclass(frozen=True)
class When:
    """What a sentence says about its time.

    Attributes
    ----------
    seconds : of the day; None = nothing [s]
    cycle : whole multiples of this do not count: a day; half an hour where it may be local time [s]
    age : how long before it was sent it was measured [s]
    day : None = not stated
    sent : by the system's own clock; None = not stated [s]
    """

    seconds: float | None = None
    cycle: float = DAY_S
    age: float = 0.0
    day: date | None = None
    sent: float | None = None

    def time(self, arrival: float) -> float:
        """When it was measured, of a sentence that arrived at some time [s]."""
        if self.seconds is None:
            return arrival - self.age
        return arrival + (self.seconds - arrival + 0.5 * self.cycle) % self.cycle - 0.5 * self.cycle


NOW = When()


@dataclass(frozen=True)
class Reply:
    """Where a transponder is, seen from a head.

    Attributes
    ----------
    kind : of sentence
    beacon : name of the transponder; "" = not stated
    when : its time
    frame : of its axes, as ``usbl.frame`` has it
    columns : of a log's `usbl` -> value
    sd : of the position it gives, NaN = not stated [m]
    filtered : by the system
    sensed : its depth is that of the transponder's own sensor
    """

    kind: str
    beacon: str
    when: When
    frame: Frame
    columns: Mapping[str, float]
    sd: float = math.nan
    filtered: bool = False
    sensed: bool = False

    @property
    def name(self) -> str:
        """As options choose it."""
        return f"{self.kind} {self.beacon}".strip()

    @property
    def xyz(self) -> tuple[float, float, float]:
        """Along the axes of its frame, NaN where its range is not known [m]."""
        at = self.columns
        if "usbl_x" in at:
            return at["usbl_x"], at["usbl_y"], at["usbl_z"]
        r, b, e = at.get("usbl_range", math.nan), at["usbl_bearing"], at["usbl_elevation"]
        return r * math.cos(e) * math.cos(b), r * math.cos(e) * math.sin(b), r * math.sin(e)


@dataclass(frozen=True)
class AcousticPosition:
    """Where a transponder, or the ship, is on Earth.

    Attributes
    ----------
    kind, beacon, when, filtered : as of a `Reply`
    lat, lon : NaN where it comes on a grid [deg]
    noise : NaN = not stated [m], [m2]
    grid : its two coordinates, in either order, on a grid that is not stated; () = it has none [m]
    of_ship : it is that of the ship
    """

    kind: str
    beacon: str
    when: When
    lat: float
    lon: float
    noise: Noise = (math.nan, math.nan, math.nan)
    grid: tuple[float, ...] = ()
    of_ship: bool = False
    filtered: bool = False

    @property
    def name(self) -> str:
        """As options choose it."""
        return f"{self.kind} {self.beacon}".strip()


@dataclass(frozen=True)
class ShipAttitude:
    """How the ship lies, as an acoustic system has it: true heading, roll and pitch, NaN = not stated [rad]."""

    kind: str
    when: When
    heading: float
    roll: float = math.nan
    pitch: float = math.nan


Told = Reply | AcousticPosition | ShipAttitude
Cells = Sequence[str]  # the name, then the fields; empty beyond them


def require_whole(text: str, bare: bool = False) -> None:
    """See that a sentence was received as it was sent.

    Parameters
    ----------
    bare : it may lack a checksum

    Raises
    ------
    Refused : its checksum is wrong or missing
    """
    body, star, stated = text.strip().removeprefix("$").rpartition("*")
    total = 0
    for byte in body.encode("ascii", "replace"):
        total ^= byte
    if (star and has_checksum(text) and int(stated[:2], 16) == total) or (bare and not star):
        return
    raise Refused("checksum", f"{shown(text)}: checksum missing or wrong; the sentence is skipped")


def seconds_of_day(clock: str) -> float | None:
    """Seconds of ``hhmmss.ss``."""
    value = number(clock)
    if len(clock) < 6 or not clock[:6].isdigit() or value is None or float(clock[:2]) > 24.0:
        return None
    return 3600.0 * int(clock[:2]) + 60.0 * int(clock[2:4]) + float(clock[4:])


def _when(clock: str, cycle: float = DAY_S, day: date | None = None) -> When:
    seconds = seconds_of_day(clock)
    if seconds is None:
        raise Refused(NO_POSITION, "without a time")
    sent = None if day is None else datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp() + seconds
    return When(seconds, cycle, day=day, sent=sent)


def _numbers(cells: Cells, *fields: int) -> list[float]:
    """Fields that are needed.

    Raises
    ------
    Refused : one of them holds no number
    """
    found = [number(cells[field]) for field in fields]
    if None in found:
        raise Refused(NO_POSITION, "without a coordinate")
    return [value for value in found if value is not None]


def _angle(cell: str) -> float:
    """In rad; NaN where a field holds no number."""
    degrees = number(cell)
    return math.nan if degrees is None else math.radians(degrees)


def _heading(cell: str) -> float:
    """In rad.

    Raises
    ------
    Refused : it is none
    """
    degrees = number(cell)
    if degrees is None or not 0.0 <= degrees <= 360.0:
        raise Refused("no heading", "without the ship's heading")
    return math.radians(degrees)


def _cartesian(x: float, y: float, z: float) -> dict[str, float]:
    """Columns of a relative position.

    Raises
    ------
    Refused : it is farther than any head hears
    """
    if math.hypot(x, y, z) > FARTHEST_M:
        raise Refused(NO_POSITION, f"more than {FARTHEST_M / 1e3:.0f} km away: eastings and northings?")
    return {"usbl_x": x, "usbl_y": y, "usbl_z": z}


def _along_axes(orientation: str, x: float, y: float) -> tuple[Frame, float, float]:
    """Frame, and coordinates forward and starboard, or north and east.

    Raises
    ------
    Refused : an orientation that is not known
    """
    if orientation == "H":
        return "ship", y, x
    if orientation in ("N", "E"):
        return "north", *((x, y) if orientation == "N" else (y, x))
    raise Refused(NO_POSITION, f"orientation {shown(orientation)}: expected H, N or E")


def _with_angle_sd(columns: dict[str, float], sd: float) -> dict[str, float]:
    """The sd of a position, which is mostly that of its direction, as an angle."""
    distance = math.hypot(*(columns[f"usbl_{axis}"] for axis in "xyz"))
    return columns | {"usbl_angle_sd": math.atan2(sd, distance)} if sd > 0.0 and distance > 0.0 else columns


def _accuracy(cell: str) -> float:
    value = number(cell)
    return value if value is not None and 0.0 < value != UNKNOWN_ACCURACY_M else math.nan


def _degrees(cell: str, direction: str, most: float) -> float:
    """Latitude or longitude of ``ddmm.mmmm`` and N, S, E or W [deg].

    Raises
    ------
    Refused : it is none
    """
    value = number(cell)
    if value is None or value < 0.0 or direction not in ("N", "S", "E", "W"):
        raise Refused(NO_POSITION, "without a coordinate")
    degrees = value // 100.0 + value % 100.0 / 60.0
    if degrees > most or value % 100.0 >= 60.0:
        raise Refused(NO_POSITION, "nowhere on Earth")
    return -degrees if direction in ("S", "W") else degrees


def _on_earth(lat: float, lon: float) -> tuple[float, float]:
    if abs(lat) > 90.0 or abs(lon) > 180.0 or lat == lon == 0.0:
        raise Refused(NO_POSITION, "nowhere on Earth")
    return lat, lon


def _alike(sd: float) -> Noise:
    """Noise whose directions are all alike."""
    return sd, math.nan, math.nan


def _ellipse(semi_axis: str, other: str, direction: str = "") -> Noise:
    """Noise of an error ellipse whose axes are known, and the direction of the first from north [m, deg]."""
    a, b, turn = number(semi_axis), number(other), number(direction)
    if a is None or b is None or min(a, b) < 0.0 or a + b <= 0.0:
        return _alike(math.nan)
    mean, half = 0.5 * (a * a + b * b), 0.5 * (a * a - b * b)
    if turn is None or min(a, b) == 0.0:  # no ellipse, but how far it is off
        return _alike(math.sqrt(mean))
    along, across = half * math.cos(math.radians(2.0 * turn)), half * math.sin(math.radians(2.0 * turn))
    return math.sqrt(mean + along), math.sqrt(mean - along), across


# Kongsberg


def _psimssb(cells: Cells) -> Told:
    kind, clock, beacon, status, error, system, orientation, filtered = cells[:8]
    if error.strip():
        raise Refused(NO_REPLY, f"error {error.strip()}: not a reply")
    if status != "A":
        raise Refused(NO_POSITION, "the system marks it as not OK")
    if filtered == "P":
        raise Refused(NO_POSITION, "predicted, not measured")
    when, smoothed = _when(clock, HALF_HOUR_S), filtered == "F"
    if system == "D":
        lat, lon = _degrees(cells[8], cells[9], 90.0), _degrees(cells[10], cells[11], 180.0)
        return AcousticPosition(kind, beacon, when, lat, lon, _alike(_accuracy(cells[13])), filtered=smoothed)
    if system == "U":
        x, y = _numbers(cells, 8, 9)
        noise = _alike(_accuracy(cells[11]))
        return AcousticPosition(kind, beacon, when, math.nan, math.nan, noise, (x, y), filtered=smoothed)
    if system != "C":
        raise Refused(NO_POSITION, "neither in Cartesian coordinates relative to a ship nor in degrees")
    x, y, depth = _numbers(cells, 8, 9, 10)
    frame, ahead, aside = _along_axes(orientation, x, y)
    sd = _accuracy(cells[11])
    columns = _with_angle_sd(_cartesian(ahead, aside, depth), sd)
    return Reply(kind, beacon, when, frame, columns, sd, smoothed, cells[12] == "D")


def _psimsns(cells: Cells) -> Told:
    seconds = seconds_of_day(cells[1])
    when = NOW if seconds is None else When(seconds, HALF_HOUR_S)
    return ShipAttitude(cells[0], when, _heading(cells[8]), _angle(cells[5]), _angle(cells[6]))


def _psimlbp(cells: Cells) -> Told:
    if cells[4] != "A":
        raise Refused(NO_POSITION, "the system marks it as not OK")
    x, y = _numbers(cells, 6, 7)
    noise = _ellipse(cells[9], cells[10])  # whether its direction is in degrees is not known
    return AcousticPosition(cells[0], cells[2], _when(cells[1], HALF_HOUR_S), math.nan, math.nan, noise, (x, y))


# iXblue GAPS


def _gaps(cells: Cells) -> tuple[When, str]:
    """Time and number of a transponder.

    Raises
    ------
    Refused : the old form, which has no time; an unknown transponder
    """
    if not cells[1].startswith("#"):
        raise Refused(NO_POSITION, "the old form, without a time")
    beacon = number(cells[6])
    if beacon is None or beacon < 0.0:
        raise Refused(NO_POSITION, "an unknown transponder")
    try:
        day = date(int(cells[5]), int(cells[4]), int(cells[3]))
    except ValueError:
        raise Refused(NO_POSITION, "without a date") from None
    return _when(cells[2], day=day), f"{beacon:.0f}"


def _require_heard(mask: str) -> None:
    """See that enough hydrophones heard a reply; all that a GAPS sends is valid with three of its four."""
    try:
        heard = int(mask, 16).bit_count()
    except ValueError:
        heard = 0
    if heard < LEAST_HYDROPHONES:
        raise Refused(NO_POSITION, "fewer than three hydrophones heard it")


def _ptsag(cells: Cells) -> Told:
    when, beacon = _gaps(cells)
    if beacon != "0":
        _require_heard(cells[11])
    lat, lon = _degrees(cells[7], cells[8], 90.0), _degrees(cells[9], cells[10], 180.0)
    return AcousticPosition(cells[0], beacon, when, lat, lon, of_ship=beacon == "0")


def _ptsa_relative(cells: Cells) -> Told:
    when, beacon = _gaps(cells)
    _require_heard(cells[9])
    if cells[11] not in ("1", "2"):
        raise Refused(NO_POSITION, "without a depth")
    x, y, depth = _numbers(cells, 7, 8, 10)
    frame: Frame = "ship" if cells[0] == "PTSAX" else "north"
    return Reply(cells[0], beacon, when, frame, _cartesian(x, y, depth), sensed=cells[11] == "2")


def _ptsah(cells: Cells) -> Told:
    return ShipAttitude(cells[0], NOW, _heading(cells[2]))


# Sonardyne Ranger 2


def _of_ship(beacon: str) -> bool:
    return beacon.casefold().startswith("ship")


def _psonlld(cells: Cells) -> Told:
    kind, clock, beacon, status = cells[:4]
    if status != "A":
        raise Refused(NO_POSITION, "the system marks it as not OK")
    lat, lon = _on_earth(*_numbers(cells, 4, 5))
    of_ship = _of_ship(beacon)
    noise = _ellipse(cells[7], cells[8], "" if of_ship else cells[9])
    return AcousticPosition(kind, beacon.strip(), _when(clock), lat, lon, noise, of_ship=of_ship)


def _psonall(cells: Cells) -> Told:
    kind, beacon = cells[0], cells[1].strip()
    when = _when(cells[3])
    if _of_ship(beacon) and cells[7]:
        return ShipAttitude(kind, when, _heading(cells[7]), _angle(cells[11]), _angle(cells[10]))
    east, north = _numbers(cells, 4, 5)
    sd = number(cells[13])
    noise = _alike(math.nan if sd is None else sd)
    return AcousticPosition(kind, beacon, when, math.nan, math.nan, noise, (east, north))


# Cerulean ROVL, EvoLogics S2C, Tritech MicronNav


def _usrth(cells: Cells) -> tuple[Told, ...]:
    """Bearings as a compass has them; what is empty was not heard, or the receiver's IMU was not valid."""
    heard, asked = number(cells[18]), number(cells[19])
    beacon = next((f"{each:.0f}" for each in (heard, asked) if each is not None and each >= 0.0), "")
    found: list[Told] = []
    for bearing, elevation, frame, name in ((2, 3, "transducer", "USRTH"), (6, 7, "north", "USRTH true")):
        if cells[4] and cells[bearing] and cells[elevation]:
            r, b, e = _numbers(cells, 4, bearing, elevation)
            if not 0.0 < r <= FARTHEST_M:
                raise Refused(NO_POSITION, "no slant range")
            columns = {"usbl_range": r, "usbl_bearing": math.radians(b), "usbl_elevation": -math.radians(e)}
            found.append(Reply(name, beacon, NOW, "north" if frame == "north" else "transducer", columns))
    if not found:
        raise Refused(NO_REPLY, "no transmitter heard")
    return tuple(found)


def _evologics_age(cells: Cells) -> When:
    now, measured = _numbers(cells, 1, 2)
    return When(age=max(now - measured, 0.0), sent=now)


def _usbllong(cells: Cells) -> Told:
    x, y, z, propagation = _numbers(cells, 4, 5, 6, 13)
    accuracy = number(cells[16])
    if accuracy is not None and accuracy < 0.0:
        raise Refused(NO_POSITION, "the accuracy is negative: not valid")
    length = math.hypot(x, y, z)
    if propagation <= 0.0 or length == 0.0:
        raise Refused(NO_POSITION, "no propagation time")
    columns = {
        "usbl_travel_time": 2e-6 * propagation,
        "usbl_bearing": math.atan2(-y, x),  # y is to port, z up
        "usbl_elevation": -math.asin(z / length),
    }
    sd = math.nan if accuracy is None or accuracy == 0.0 else accuracy
    if sd > 0.0:
        columns["usbl_angle_sd"] = math.atan2(sd, length)
    return Reply(cells[0], cells[3], _evologics_age(cells), "transducer", columns, sd)


def _usblangles(cells: Cells) -> Told:
    bearing, elevation, accuracy = _numbers(cells, 4, 5, 13)
    if accuracy < 0.0:
        raise Refused(NO_POSITION, "the accuracy is negative: not valid")
    columns = {"usbl_bearing": -bearing, "usbl_elevation": -elevation}
    if accuracy > 0.0:
        columns["usbl_angle_sd"] = accuracy
    return Reply(cells[0], cells[3], _evologics_age(cells), "transducer", columns)


def _micronnav(cells: Cells) -> Told:
    if not cells[0].endswith("31"):
        raise Refused(NO_POSITION, "not raw positions as comma-separated text")
    x, y, z, receivers = _numbers(cells, 2, 3, 4, 6)
    if int(receivers) & 30 != 30:
        raise Refused(NO_REPLY, "not all four receivers heard it")
    when = _when(f"{cells[7][:6]}.{cells[7][6:]}", HALF_HOUR_S)
    return Reply("MicronNav", cells[1], when, "ship", _cartesian(1e-3 * y, 1e-3 * x, 1e-3 * z))


# Blueprint SeaTrac

_PING_ERROR, _FIX_AGAIN, _FIXES = 0x43, 0x39, (0x42, 0x4A, 0x52, 0x61)
_HEAD = struct.Struct("<BBBBhhhHHh")  # to, from, flags, type, yaw, pitch, roll, depth, speed of sound, strength
_RANGE = struct.Struct("<IiH")  # count, time, distance [0.1 m]
_ANGLES = struct.Struct("<hhh")  # azimuth, elevation [0.1 deg], fit error [0.01]


def _crc16_of(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ (0xA001 if byte & 1 else 0)
    return byte


_CRC16 = [_crc16_of(byte) for byte in range(256)]


def crc16(data: bytes) -> int:
    """CRC-16 with the polynomial 0xA001, from 0."""
    crc = 0
    for byte in data:
        crc = crc >> 8 ^ _CRC16[(crc ^ byte) & 0xFF]
    return crc


def _seatrac(text: str) -> Told:
    data = bytes.fromhex(text[1:])
    if len(data) < 4 or crc16(data[:-2]) != int.from_bytes(data[-2:], "little"):
        raise Refused("checksum", f"{shown(text)}: checksum wrong; the message is skipped")
    kind, fix = data[0], data[1:-2]
    if kind == _PING_ERROR:
        raise Refused(NO_REPLY, "no reply to a ping")
    if kind == _FIX_AGAIN:
        raise Refused("again", "the fix that other messages have")
    if kind not in _FIXES:
        raise Refused("other", "no measurement that a log has")
    try:
        _, beacon, flags, *_, speed, _ = _HEAD.unpack_from(fix)
        at = _HEAD.size
        if flags & 3 != 3:
            raise Refused(NO_POSITION, "no range and direction")
        _, _, distance = _RANGE.unpack_from(fix, at)
        at += _RANGE.size
        azimuth, elevation, fit = _ANGLES.unpack_from(fix, at + 1 + 2 * fix[at])
    except (struct.error, IndexError):
        raise Refused("cut off", "messages that are cut off") from None
    if 0.01 * fit > WORST_FIT:
        raise Refused(NO_POSITION, f"a fit error above {WORST_FIT:g}")
    if distance == 0:
        raise Refused(NO_POSITION, "no range")
    columns = {
        "usbl_range": 0.1 * distance,
        "usbl_bearing": math.radians(0.1 * azimuth),
        "usbl_elevation": -math.radians(0.1 * elevation),
    }
    if SLOWEST_MPS < 0.1 * speed < FASTEST_MPS:
        columns["usbl_sound_speed"] = 0.1 * speed
    return Reply("SeaTrac", str(beacon), NOW, "transducer", columns)


# every sentence

_DECODERS: dict[str, Callable[[Cells], Told | tuple[Told, ...]]] = {
    "PSIMSSB": _psimssb,
    "PSIMSNS": _psimsns,
    "PSIMLBP": _psimlbp,
    "PTSAG": _ptsag,
    "PTSAX": _ptsa_relative,
    "PTSAY": _ptsa_relative,
    "PTSAH": _ptsah,
    "PSONLLD": _psonlld,
    "PSONALL": _psonall,
    "USRTH": _usrth,
    "USBLLONG": _usbllong,
    "USBLANGLES": _usblangles,
}
UNKNOWN = {  # sentences of acoustic systems whose fields are not known
    "PSIMSSR": "its layout is not known; record PSIMSSB and PSIMSNS",
    "PSONDEP": "its layout is not known; record PSONLLD or PSIMSSB",
    "PSONUSBL": "its layout is not known; record PSONLLD or PSIMSSB",
    "PUSBA": "its layout is not known",
}
_NMEA = re.compile(rf"\$({'|'.join((*_DECODERS, *UNKNOWN))}),")
_MODEM = re.compile(r"(?:\+\+\+AT(?:\*\w+)?:(\d+):)?((?:USBLLONG|USBLANGLES),.*)")
_MICRONNAV = re.compile(r"%D([0-9A-F]{4})08[0-9A-F]{2}\d\d(?:,|$)")
_HEX = re.compile(r"\$(?:[0-9A-F]{2}){4,}$")
_MOST_FIELDS = 30


def acoustic_sentence(line: bytes) -> tuple[str, str] | None:
    """Kind of the acoustic sentence that a line holds, and its text; None of other lines."""
    text = line.decode("ascii", "replace").strip()
    if "USBL" in text and (modem := _MODEM.search(text)):
        return modem[2].partition(",")[0], modem[0]
    if "%D" in text and (micronnav := _MICRONNAV.search(text)):
        return "MicronNav", text[micronnav.start() :]
    text = text[max(text.rfind("$"), 0) :]
    if _HEX.match(text):
        return "SeaTrac", text
    found = _NMEA.match(text)
    return None if found is None else (found[1], text)


def told_by(kind: str, text: str, bare: bool = False) -> tuple[Told, ...]:
    """What a sentence tells.

    Parameters
    ----------
    kind, text : as `acoustic_sentence` has them
    bare : it may lack a checksum

    Raises
    ------
    Refused : it is not whole (kinds "checksum" and "cut off"), or tells nothing that can be used
    """
    if kind == "SeaTrac":
        return (_seatrac(text),)
    if kind == "MicronNav":
        return (_micronnav(_cells(text)),)
    if kind in ("USBLLONG", "USBLANGLES"):
        modem = _MODEM.match(text)
        assert modem is not None
        if modem[1] and len(modem[2]) < int(modem[1]) - 2:
            raise Refused("cut off", f"{shown(text)}: is shorter than it says; the sentence is skipped")
        text = modem[2]
    else:
        require_whole(text, bare)
        if kind in UNKNOWN:
            raise Refused("unknown layout", UNKNOWN[kind])
        text = text.removeprefix("$")
    found = _DECODERS[kind](_cells(text))
    return found if isinstance(found, tuple) else (found,)


def _cells(text: str) -> list[str]:
    return [*text.partition("*")[0].strip().split(","), *[""] * _MOST_FIELDS]


class HeadDirections:
    """Puts directions (``USBLANGLES``) to the ranges that they were measured with (``USBLLONG``)."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[float, Reply]] = {}  # remote -> time of measurement, direction

    def joined(self, reply: Reply) -> Reply | None:
        """A range with the direction that came before it; None of a direction, which waits for its range."""
        if reply.kind not in ("USBLLONG", "USBLANGLES") or reply.when.sent is None:
            return reply
        measured = reply.when.sent - reply.when.age
        if reply.kind == "USBLANGLES":
            self._last[reply.beacon] = measured, reply
            return None
        at, direction = self._last.get(reply.beacon, (-math.inf, reply))
        if abs(at - measured) > 1e-3:
            return reply
        columns = {**reply.columns, **direction.columns}
        return Reply(reply.kind, reply.beacon, reply.when, reply.frame, columns, reply.sd)
