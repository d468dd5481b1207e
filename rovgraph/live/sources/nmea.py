"""NMEA 0183: headings and fixes.

Headings become the log's `ahrs_yaw`, which is of a compass: one that is relative to true north is
turned by the configuration's declination. A sentence that was not received whole, as its checksum
tells, is not read.
"""

import math
import re
from collections.abc import Callable
from datetime import UTC, date, datetime, timedelta
from datetime import time as clock_time
from typing import Any

import numpy as np

from rovgraph.config import Config
from rovgraph.errors import InputError
from rovgraph.geometry import wrap_angle
from rovgraph.interchange.lines import Refused, shown
from rovgraph.live.message import GEODETIC, Message, Reading
from rovgraph.live.sources.lines import LineDecoder
from rovgraph.live.sources.preferred import Preferred
from rovgraph.live.sources.source import Notify

HEADINGS = ("HDT", "HDG", "HDM")  # best first
FIXES = ("GGA", "RMC", "GLL")
DATES = ("ZDA",)

# GGA's quality -> error of a range [m], a choice; with the dilution of precision it gives the fix's sd
RANGE_SD_M = {1: 3.0, 2: 1.0, 3: 3.0, 4: 0.02, 5: 0.3, 9: 1.0}
GOOD_MODES = frozenset({None, "", "A", "D", "F", "P", "R"})  # not estimated, manual, simulated

_SENTENCE = re.compile(r"[$!][A-Z]{2}([A-Z]{3}),|[$!][A-Z0-9]{3,},")


def nmea(url: str, notify: Notify, config: Config, recorded: bool = False) -> LineDecoder:
    """Decoder of sentences.

    Parameters
    ----------
    recorded : a file, in which sentences arrive at the time that those before them tell

    Raises
    ------
    InputError : pynmea2 is not installed
    """
    return LineDecoder(Sentences(url, notify, config, recorded).message, notify)


class Sentences:
    """From a sentence to a message; see `nmea`."""

    def __init__(self, url: str, notify: Notify, config: Config, recorded: bool) -> None:
        self._url = url
        self._pynmea2 = _pynmea2()
        self._declination = config.environment.declination_deg
        self._recorded = recorded
        self._time: float | None = None  # seconds since 1970 of the last sentence with a time
        self._dated = False
        self._headings = Preferred(HEADINGS, notify)
        self._fixes = Preferred(FIXES, notify)
        self._read: dict[str, Callable[[Any, float], Reading | None]] = {
            **dict.fromkeys(HEADINGS, self._heading),
            **dict.fromkeys(FIXES, self._fix),
            **dict.fromkeys(DATES, lambda sentence, arrival: None),
        }

    def message(self, line: bytes, arrival: float) -> Message | None:
        """What a sentence says.

        Raises
        ------
        Refused : it is none, or not whole
        """
        text = line.decode("ascii", "replace")
        text = text[max(text.rfind("$"), 0) :]
        match = _SENTENCE.match(text)
        if match is None:
            raise Refused("noise", f"expected NMEA sentences, got {shown(text)}; a wrong baud rate?")
        if match[1] not in self._read:
            return None
        sentence = self._parsed(text)
        stamp = self._stamp(sentence, arrival)
        if self._recorded:
            if self._time is None:
                raise Refused("no time", "sentences before the first one with a time are left out")
            arrival = self._time
        reading = self._read[match[1]](sentence, arrival)
        return None if reading is None else Message(self._url, arrival, stamp, (reading,))

    def _parsed(self, text: str) -> Any:
        try:
            return self._pynmea2.parse(text, check=True)
        except self._pynmea2.ChecksumError:
            raise Refused("checksum", f"{shown(text)}: checksum missing or wrong; the sentence is skipped") from None
        except Exception:  # whatever a library of others meets in bytes of others
            raise Refused("noise", f"{shown(text)} cannot be read; the sentence is skipped") from None

    def _stamp(self, sentence: Any, arrival: float) -> float | None:
        """Time of a sentence that has one, seconds since 1970: with the date that is known, else of the nearest day."""
        time = getattr(sentence, "timestamp", None)
        if not isinstance(time, clock_time):
            return None
        day = _date(sentence)
        if day is not None:
            self._dated = True
            self._time = datetime.combine(day, time, UTC).timestamp()
        elif sentence.sentence_type in FIXES:
            about = datetime.fromtimestamp(self._time if self._dated and self._time is not None else arrival, UTC)
            near = datetime.combine(about.date(), time, UTC)
            days = round((about - near) / timedelta(days=1))
            self._time = (near + timedelta(days=days)).timestamp()
        return self._time

    def _heading(self, sentence: Any, arrival: float) -> Reading | None:
        heading = _number(sentence.heading)
        if heading is None or not 0.0 <= heading <= 360.0:
            return None
        kind = sentence.sentence_type
        if kind == "HDG":
            heading += _east(sentence.deviation, sentence.dev_dir) or 0.0
            variation = _east(sentence.variation, sentence.var_dir)
            if variation is not None:
                heading += variation - self._declination
        elif kind == "HDT":
            heading -= self._declination
        if not self._headings.takes(kind, arrival):
            return None
        return Reading("ahrs", np.array([wrap_angle(np.deg2rad(heading)), np.nan, np.nan]))

    def _fix(self, sentence: Any, arrival: float) -> Reading | None:
        kind = sentence.sentence_type
        sd = _fix_sd(sentence) if kind == "GGA" else math.nan
        if sd is None or (kind != "GGA" and not _active(sentence)) or not self._fixes.takes(kind, arrival):
            return None
        return Reading(GEODETIC, np.array([*_place(sentence), sd]))


def _place(sentence: Any) -> tuple[float, float]:
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


def _fix_sd(sentence: Any) -> float | None:
    """Of a GGA fix, north and east [m]: NaN where it does not tell, None where there is no fix."""
    quality, hdop = sentence.gps_qual, _number(sentence.horizontal_dil)
    if quality not in RANGE_SD_M:
        return None
    return RANGE_SD_M[quality] * hdop if hdop is not None and 0.0 < hdop < 99.0 else math.nan


def _active(sentence: Any) -> bool:
    """Whether an RMC or GLL is of a fix."""
    name = "mode_indicator" if sentence.sentence_type == "RMC" else "faa_mode"
    return sentence.status == "A" and getattr(sentence, name, None) in GOOD_MODES


def _date(sentence: Any) -> date | None:
    """Of a ZDA, or of an RMC that has a fix."""
    if sentence.sentence_type == "RMC" and sentence.status != "A":
        return None
    try:
        day = getattr(sentence, "datestamp", None)
    except (TypeError, ValueError):  # pynmea2 makes a date of whatever stands there
        return None
    return day if isinstance(day, date) else None


def _east(degrees: Any, direction: str) -> float | None:
    value = _number(degrees)
    if value is None or direction not in ("E", "W"):
        return None
    return value if direction == "E" else -value


def _number(value: Any) -> float | None:
    """A finite number, or None."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _pynmea2() -> Any:
    try:
        import pynmea2
    except ImportError:
        raise InputError("nmea: needs pynmea2; install it with: pip install 'rovgraph[online]'") from None
    return pynmea2
