"""NMEA 0183 sentences, live and in files: headings, attitudes, fixes and times.

A sentence that was not received whole, as its checksum tells, is not read. Where no sentence has a checksum, as loggers
and terminals write them, they are taken as they stand.

Sources of the proprietary ones: OxTS, NMEA 0183 description (PASHR); True North, Revolution (PTNTHPR, PTNTHTM);
Kongsberg Seapath (PSXN,23); Teledyne TSS (PRDID).
"""

import math
import re
from datetime import UTC, date, datetime, timedelta
from datetime import time as clock_time
from typing import Any

from rovgraph.errors import InputError
from rovgraph.readers.records import Refused, shown

HEADINGS = ("HDT", "HDG", "HDM")  # best first
FIXES = ("GGA", "RMC", "GLL")
ATTITUDES = ("PASHR", "PTNTHPR", "PTNTHTM", "PSXN", "PRDID")  # heading, pitch and roll, best first
TILT = "XDR"  # pitch and roll alone
PITCH, ROLL = ("PTCH", "PITCH"), ("ROLL", "HEEL")  # how names of angles in an XDR begin
TRUE = ("HDT", "PASHR", "PSXN")  # relative to true north
WITHOUT_CHECKSUM = 10  # sentences in a row, with none that has one, from which on they are taken
DATES = ("ZDA",)

# GGA's quality -> error of a range [m], a choice; with the dilution of precision it gives the fix's sd
RANGE_SD_M = {1: 3.0, 2: 1.0, 3: 3.0, 4: 0.02, 5: 0.3, 9: 1.0}
GOOD_MODES = frozenset({None, "", "A", "D", "F", "P", "R"})  # not estimated, manual, simulated

_SENTENCE = re.compile(r"[$!](?!P)[A-Z]{2}([A-Z]{3}),|[$!]([A-Z0-9]{3,}),")  # a talker P is a maker
_CHECKSUM = re.compile(r"\*[0-9A-Fa-f]{2}\s*$")


def sentence_of(line: bytes) -> tuple[str, str]:
    """Kind of the sentence that a line holds, as "GGA" or "PTNTHPR", and its text.

    Raises
    ------
    Refused : it holds none
    """
    text = line.decode("ascii", "replace")
    text = text[max(text.rfind("$"), 0) :]
    match = _SENTENCE.match(text)
    if match is None:
        raise Refused("noise", f"expected NMEA sentences, got {shown(text)}; a wrong baud rate?")
    return match[1] or match[2], text


def has_checksum(text: str) -> bool:
    """Whether a sentence ends with a checksum, right or wrong."""
    return _CHECKSUM.search(text) is not None


def parsed(text: str, bare: bool = False) -> Any:
    """A sentence's fields, as pynmea2 has them.

    Parameters
    ----------
    bare : it may lack a checksum

    Raises
    ------
    Refused : it is not whole
    """
    pynmea2 = library()
    try:
        return pynmea2.parse(text, check=not bare)
    except pynmea2.ChecksumError:
        raise Refused("checksum", f"{shown(text)}: checksum missing or wrong; the sentence is skipped") from None
    except Exception:  # whatever a library of others meets in bytes of others
        raise Refused("noise", f"{shown(text)} cannot be read; the sentence is skipped") from None


class SentenceTimes:
    """Times of sentences, seconds since 1970: with the date that is known, else of the nearest day.

    Attributes
    ----------
    last : of the last sentence with a time, None = none yet
    dated : whether a sentence had the date
    """

    def __init__(self) -> None:
        self.last: float | None = None
        self.dated = False

    def stamp(self, sentence: Any, about: float) -> float | None:
        """Time of a sentence that has one.

        Parameters
        ----------
        about : time near it, as long as no date is known
        """
        time = getattr(sentence, "timestamp", None)
        if not isinstance(time, clock_time):
            return None
        day = sentence_date(sentence)
        if day is not None:
            self.dated = True
            self.last = datetime.combine(day, time, UTC).timestamp()
        elif sentence.sentence_type in FIXES:
            self.near(time, about)
        return self.last

    def near(self, time: clock_time, about: float) -> float:
        """The time of a time of day that is nearest to what is known; ``about`` as of `stamp`."""
        known = datetime.fromtimestamp(self.last if self.dated and self.last is not None else about, UTC)
        there = datetime.combine(known.date(), time, UTC)
        days = round((known - there) / timedelta(days=1))
        self.last = (there + timedelta(days=days)).timestamp()
        return self.last


def heading_of(sentence: Any) -> tuple[float, bool] | None:
    """Heading [deg], and whether it is relative to true north; None without a heading."""
    heading = number(sentence.heading)
    if heading is None or not 0.0 <= heading <= 360.0:
        return None
    if sentence.sentence_type == "HDG":
        return heading + (east(sentence.deviation, sentence.dev_dir) or 0.0), False
    return heading, sentence.sentence_type == "HDT"


def attitude_of(text: str) -> tuple[clock_time | None, float | None, float | None, float | None] | None:
    """Of a sentence of `ATTITUDES` or `TILT`: its time of day, heading, pitch and roll [deg]; None where it has none.

    Pitch is positive with the bow up, roll with starboard down. The True North's may be set to mils, as it then states
    nowhere.

    Parameters
    ----------
    text : of the sentence, whose checksum is right
    """
    name, *cells = text.partition("*")[0].strip().split(",")
    kind, cells = name[1:], [*cells, *[""] * 10]
    time: clock_time | None = None
    if kind == "PASHR":
        time = day_time(cells[0])
        heading, roll, pitch = (number(cells[k]) for k in (1, 3, 4))
        if time is None or cells[2] != "T":  # another maker's, or not aligned yet
            return None
    elif kind in ("PTNTHPR", "PTNTHTM"):
        heading, pitch, roll = (number(cells[k]) for k in (0, 2, 4))
    elif kind == "PSXN":
        if cells[0] != "23":
            return None
        roll, pitch, heading = (number(cells[k]) for k in (1, 2, 3))
    elif kind == "PRDID":
        pitch, roll, heading = (number(cells[k]) for k in (0, 1, 2))
    else:
        named = {cells[k + 3].upper(): number(cells[k + 1]) for k in range(0, len(cells) - 9, 4) if cells[k] == "A"}
        pitch, roll = (next((v for n, v in named.items() if n.startswith(names)), None) for names in (PITCH, ROLL))
        heading = None
    heading = heading if heading is not None and 0.0 <= heading <= 360.0 else None
    known = (heading is not None) if kind in ATTITUDES else None not in (pitch, roll)
    return (time, heading, pitch, roll) if known else None


def day_time(cell: str) -> clock_time | None:
    """The time of day of ``hhmmss.sss``; None if it is invalid."""
    if len(cell) < 6 or not cell[:6].isdigit() or number(cell) is None:
        return None
    try:
        microsecond = round(1e6 * (float(cell) % 1.0))
        return clock_time(int(cell[:2]), int(cell[2:4]), int(cell[4:6]), min(microsecond, 999_999))
    except ValueError:
        return None


def fix_of(sentence: Any) -> tuple[float, float, float] | None:
    """Latitude, longitude [deg] and sd [m]; None without a fix.

    Raises
    ------
    Refused : it is nowhere on Earth
    """
    kind = sentence.sentence_type
    sd = fix_sd(sentence) if kind == "GGA" else math.nan
    if sd is None or (kind != "GGA" and not active(sentence)):
        return None
    return *place(sentence), sd


def place(sentence: Any) -> tuple[float, float]:
    """Latitude and longitude [deg].

    Raises
    ------
    Refused : they are invalid
    """
    try:
        lat, lon = float(sentence.latitude), float(sentence.longitude)
    except ValueError:
        lat = lon = math.nan
    whole = sentence.lat and sentence.lon and sentence.lat_dir in ("N", "S") and sentence.lon_dir in ("E", "W")
    if not (whole and abs(lat) <= 90.0 and abs(lon) <= 180.0):
        raise Refused("out of range", "a fix that is nowhere on Earth is left out")
    return lat, lon


def fix_sd(sentence: Any) -> float | None:
    """Of a GGA fix, north and east [m]: NaN where it is not stated, None without a fix."""
    quality, hdop = sentence.gps_qual, number(sentence.horizontal_dil)
    if quality not in RANGE_SD_M:
        return None
    return RANGE_SD_M[quality] * hdop if hdop is not None and 0.0 < hdop < 99.0 else math.nan


def active(sentence: Any) -> bool:
    """Whether an RMC or GLL is of a fix."""
    name = "mode_indicator" if sentence.sentence_type == "RMC" else "faa_mode"
    return sentence.status == "A" and getattr(sentence, name, None) in GOOD_MODES


def sentence_date(sentence: Any) -> date | None:
    """Of a ZDA, or of an RMC that has a fix."""
    if sentence.sentence_type == "RMC" and sentence.status != "A":
        return None
    try:
        day = getattr(sentence, "datestamp", None)
    except (TypeError, ValueError):  # pynmea2 makes a date of whatever stands there
        return None
    return day if isinstance(day, date) else None


def east(degrees: Any, direction: str) -> float | None:
    value = number(degrees)
    if value is None or direction not in ("E", "W"):
        return None
    return value if direction == "E" else -value


def number(value: Any) -> float | None:
    """A finite number, or None."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def library() -> Any:
    """The library pynmea2.

    Raises
    ------
    InputError : it is not installed
    """
    try:
        import pynmea2
    except ImportError:
        raise InputError("nmea: needs pynmea2; install it with: pip install 'rovgraph[online]'") from None
    return pynmea2
