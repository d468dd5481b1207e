"""NMEA 0183, live: headings and fixes; `rovgraph.interchange.nmea_sentences` reads the sentences.

Headings become the log's `ahrs_yaw`, which is of a compass: one that is relative to true north is
turned by the configuration's declination.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from rovgraph.config import Config
from rovgraph.geometry import wrap_angle
from rovgraph.interchange.lines import Refused
from rovgraph.interchange.nmea_sentences import (
    DATES,
    FIXES,
    HEADINGS,
    Times,
    east,
    fix_of,
    heading_of,
    library,
    parsed,
    sentence_of,
)
from rovgraph.live.message import GEODETIC, Message, Reading
from rovgraph.live.sources.lines import LineDecoder
from rovgraph.live.sources.preferred import Preferred
from rovgraph.live.sources.source import Notify


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
        library()
        self._declination = config.environment.declination_deg
        self._recorded = recorded
        self._times = Times()
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
        kind, text = sentence_of(line)
        if kind not in self._read:
            return None
        sentence = parsed(text)
        stamp = self._times.stamp(sentence, arrival)
        if self._recorded:
            if self._times.last is None:
                raise Refused("no time", "sentences before the first one with a time are left out")
            arrival = self._times.last
        reading = self._read[kind](sentence, arrival)
        return None if reading is None else Message(self._url, arrival, stamp, (reading,))

    def _heading(self, sentence: Any, arrival: float) -> Reading | None:
        found = heading_of(sentence)
        if found is None:
            return None
        heading, true = found
        kind = sentence.sentence_type
        if kind == "HDG" and (variation := east(sentence.variation, sentence.var_dir)) is not None:
            heading += variation - self._declination
        elif true:
            heading -= self._declination
        if not self._headings.takes(kind, arrival):
            return None
        return Reading("ahrs", np.array([wrap_angle(np.deg2rad(heading)), np.nan, np.nan]))

    def _fix(self, sentence: Any, arrival: float) -> Reading | None:
        kind = sentence.sentence_type
        fix = fix_of(sentence)
        if fix is None or not self._fixes.takes(kind, arrival):
            return None
        return Reading(GEODETIC, np.array(fix))
