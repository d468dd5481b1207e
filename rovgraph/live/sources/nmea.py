"""NMEA 0183, live: headings, attitudes and fixes; `rovgraph.readers.nmea_sentences` reads the sentences.

Headings become the log's `ahrs_yaw`, which is a compass's: a heading from true north is turned by the configuration's
declination.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rovgraph.geometry import wrap_angle
from rovgraph.live.message import GEODETIC, Message, Reading
from rovgraph.live.sources.source import LineDecoder, Notify, Preferred
from rovgraph.model.config import Config
from rovgraph.readers.nmea_sentences import (
    ATTITUDES,
    DATES,
    FIXES,
    HEADINGS,
    TRUE,
    WITHOUT_CHECKSUM,
    SentenceTimes,
    attitude_of,
    east,
    fix_of,
    has_checksum,
    heading_of,
    library,
    parsed,
    sentence_of,
)
from rovgraph.readers.records import Refused


def nmea(url: str, notify: Notify, config: Config, recorded: bool = False) -> LineDecoder:
    """Decoder of sentences.

    Parameters
    ----------
    recorded : a file, in which sentences arrive at the time of those before them

    Raises
    ------
    InputError : pynmea2 is not installed
    """
    return LineDecoder(NmeaDecoder(url, notify, config, recorded).message, notify)


class NmeaDecoder:
    """From a sentence to a message; see `nmea`."""

    def __init__(self, url: str, notify: Notify, config: Config, recorded: bool) -> None:
        self._url = url
        library()
        self._declination = config.environment.declination_deg
        self._recorded = recorded
        self._times = SentenceTimes()
        self._notify = notify
        self._bare: int | None = 0  # sentences so far, as long as none has a checksum
        self._headings = Preferred((*ATTITUDES, *HEADINGS), notify)
        self._fixes = Preferred(FIXES, notify)
        self._read: dict[str, Callable[[Any, float], Reading | None]] = {
            **dict.fromkeys(HEADINGS, self._heading),
            **dict.fromkeys(FIXES, self._fix),
            **dict.fromkeys(DATES, lambda sentence, arrival: None),
        }

    def message(self, line: bytes, arrival: float) -> Message | None:
        """The readings of a sentence.

        Raises
        ------
        Refused : not a sentence, or not whole
        """
        kind, text = sentence_of(line)
        if kind not in self._read and kind not in ATTITUDES:
            return None
        sentence = parsed(text, self._takes_without_checksum(text))
        attitude = attitude_of(text) if kind in ATTITUDES else None
        if attitude is not None and attitude[0] is not None:
            stamp: float | None = self._times.near(attitude[0], arrival)
        else:
            stamp = self._times.stamp(sentence, arrival)
        if self._recorded:
            if self._times.last is None:
                raise Refused("no time", "sentences before the first one with a time are left out")
            arrival = self._times.last
        if kind in ATTITUDES:
            reading = None if attitude is None else self._attitude(kind, attitude[1:], arrival)
        else:
            reading = self._read[kind](sentence, arrival)
        return None if reading is None else Message(self._url, arrival, stamp, (reading,))

    def _takes_without_checksum(self, text: str) -> bool:
        """Whether sentences are taken without a checksum: many came, and none had one."""
        if has_checksum(text):
            self._bare = None
        elif self._bare is not None:
            self._bare += 1
            if self._bare == WITHOUT_CHECKSUM:
                self._notify(
                    "no checksum", "no sentence has a checksum: all are taken as they stand from here on", True
                )
        return self._bare is not None and self._bare >= WITHOUT_CHECKSUM

    def _attitude(self, kind: str, angles: Sequence[float | None], arrival: float) -> Reading | None:
        if not self._headings.takes(kind, arrival):
            return None
        heading, pitch, roll = np.deg2rad([np.nan if angle is None else angle for angle in angles])
        heading -= np.deg2rad(self._declination) if kind in TRUE else 0.0
        return Reading("ahrs", np.array([wrap_angle(heading), roll, pitch]))

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
