"""NMEA 0183 sentences, live and in files: headings, fixes and times.

A sentence that was not received whole, as its checksum tells, is not read.
"""

import math
import re
from datetime import UTC, date, datetime, timedelta
from datetime import time as clock_time
from typing import Any

from rovgraph.errors import InputError
from rovgraph.interchange.lines import Refused, shown

HEADINGS = ("HDT", "HDG", "HDM")  # best first
FIXES = ("GGA", "RMC", "GLL")
DATES = ("ZDA",)

# GGA's quality -> error of a range [m], a choice; with the dilution of precision it gives the fix's sd
RANGE_SD_M = {1: 3.0, 2: 1.0, 3: 3.0, 4: 0.02, 5: 0.3, 9: 1.0}
GOOD_MODES = frozenset({None, "", "A", "D", "F", "P", "R"})  # not estimated, manual, simulated

_SENTENCE = re.compile(r"[$!][A-Z]{2}([A-Z]{3}),|[$!]([A-Z0-9]{3,}),")


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


def parsed(text: str) -> Any:
    """A sentence's fields, as pynmea2 has them.

    Raises
    ------
    Refused : it is not whole
    """
    pynmea2 = library()
    try:
        return pynmea2.parse(text, check=True)
    except pynmea2.ChecksumError:
        raise Refused("checksum", f"{shown(text)}: checksum missing or wrong; the sentence is skipped") from None
    except Exception:  # whatever a library of others meets in bytes of others
        raise Refused("noise", f"{shown(text)} cannot be read; the sentence is skipped") from None


class Times:
    """Times of sentences, seconds since 1970: with the date that is known, else of the nearest day.

    Attributes
    ----------
    last : of the last sentence with a time, None = none yet
    dated : whether a sentence has told the date
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
            known = datetime.fromtimestamp(self.last if self.dated and self.last is not None else about, UTC)
            near = datetime.combine(known.date(), time, UTC)
            days = round((known - near) / timedelta(days=1))
            self.last = (near + timedelta(days=days)).timestamp()
        return self.last


def heading_of(sentence: Any) -> tuple[float, bool] | None:
    """Heading [deg], and whether it is relative to true north; None where there is none."""
    heading = number(sentence.heading)
    if heading is None or not 0.0 <= heading <= 360.0:
        return None
    if sentence.sentence_type == "HDG":
        return heading + (east(sentence.deviation, sentence.dev_dir) or 0.0), False
    return heading, sentence.sentence_type == "HDT"


def fix_of(sentence: Any) -> tuple[float, float, float] | None:
    """Latitude, longitude [deg] and sd [m] of a fix; None where there is none.

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
    Refused : they are none
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
    """Of a GGA fix, north and east [m]: NaN where it does not tell, None where there is no fix."""
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
