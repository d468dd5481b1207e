"""Findings of a check, and helpers that the checks share."""

import math
from dataclasses import asdict, dataclass
from typing import Any, get_args

import numpy as np

from rovgraph.geometry import Array
from rovgraph.log import Log, Stream
from rovgraph.model.config import Config, beliefs
from rovgraph.sensors import Fault, Kind, Level
from rovgraph.sensors.instruments import HEADING_STREAMS, heading_sources, instruments

FAULTS: tuple[Fault, ...] = get_args(Fault)
CLOCKS: tuple[Kind, ...] = ("epoch", "lag", "jump")
SPIKE = 6.0  # times the usual distance from the median of five
LEAST_SPIKE = 0.1  # [m/s, m]


@dataclass(frozen=True)
class Finding:
    """One statement about a log.

    Attributes
    ----------
    sensor : name of the stream, or "log", "configuration"
    level : "error": cannot be worked with as it is
    text : one sentence, with the numbers it rests on
    kind : in a word, which docs/check.md explains
    share : of the sensor's measurements, that an estimate leaves out for it; None where it is about something else
    lag : how late stamps are, and its sd [s]; None where it is about something else
    """

    sensor: str
    level: Level
    text: str
    kind: Kind = ""
    share: float | None = None
    lag: tuple[float, float] | None = None

    @property
    def wrong(self) -> bool:
        """The data are wrong, and an estimate is made of them all the same."""
        return self.level != "ok" and self.kind in FAULTS

    @property
    def of_clock(self) -> bool:
        """Whether it reports that a clock is late, early or set."""
        return self.kind in CLOCKS


@dataclass(frozen=True)
class Timing:
    """When the measurements of one sensor came.

    Attributes
    ----------
    sensor : name of the stream
    count : measurements
    rate : one over the median period [Hz], NaN for a single one
    first, last : times [s]
    gap, gap_at : largest time between two, and when it begins [s]
    jitter : half the width of the middle 90 % of the periods [s]
    repeats : measurements that repeat the one before exactly
    """

    sensor: str
    count: int
    rate: float
    first: float
    last: float
    gap: float
    gap_at: float
    jitter: float
    repeats: int


@dataclass(frozen=True)
class Report:
    """All findings in a log.

    Attributes
    ----------
    source : file name
    timings : one per sensor
    findings : in the order of the checks
    """

    source: str
    timings: list[Timing]
    findings: list[Finding]

    def at(self, level: Level) -> list[Finding]:
        """Findings of one level."""
        return [f for f in self.findings if f.level == level]

    def faults(self, config: Config) -> list[Finding]:
        """Errors in the data of sensors that an estimate uses."""
        used = heading_sources(config, {t.sensor for t in self.timings})
        return [f for f in self.findings if f.wrong and (f.sensor in used or f.sensor not in HEADING_STREAMS)]

    def as_dict(self) -> dict[str, Any]:
        """For JSON; unknown values are None."""
        known: dict[str, Any] = _without_nan(asdict(self))
        for finding, written in zip(self.findings, known["findings"], strict=True):
            written["wrong"] = finding.wrong
            del written["lag"]  # which the text has
        return known


def _without_nan(value: object) -> Any:
    """NaN as None, which JSON has."""
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_without_nan(v) for v in value]
    return None if isinstance(value, float) and value != value else value


def believed_lag(config: Config, late: str, than: str | None = None) -> tuple[float, float]:
    """How much later the stamps of a sensor are believed to be than another's or the IMU's, and its sd [s]."""
    priors, every = beliefs(config), instruments(config)
    offsets = [(sign, every[name].time_offset) for sign, name in ((1.0, late), (-1.0, than)) if name is not None]
    known = [(sign, priors[name]) for sign, name in offsets if name is not None]
    sd = math.hypot(*(prior.sd for _, prior in known if prior.estimate))
    return sum(sign * float(prior.mean[0]) for sign, prior in known), sd


def told(stream: Stream) -> Array:
    """Measurements of a sensor, shape (n, k): NaN in pings without bottom lock, which are empty or hold a sentinel."""
    if stream.sensor != "dvl":
        return stream.data
    return np.where((stream["dvl_valid"] == 1.0)[:, None], stream.data, np.nan)


def valid_pings(stream: Stream) -> Stream:
    """Pings with bottom lock."""
    return stream.take(stream["dvl_valid"] == 1.0)


def without_spikes(stream: Stream) -> Stream:
    """Measurements near the median of the five around each, in each of the first three columns."""
    if len(stream) < 5:
        return stream
    padded = np.pad(stream.data[:, :3], ((2, 2), (0, 0)), mode="edge")
    five = np.lib.stride_tricks.sliding_window_view(padded, 5, axis=0)
    off = np.abs(stream.data[:, :3] - np.median(five, axis=-1))
    limit = np.maximum(LEAST_SPIKE, SPIKE * np.median(off, axis=0))
    return stream.take(np.asarray((off <= limit).all(axis=1)))


def since(log: Log, time: float) -> str:
    """A time as a person looks for it: seconds from the start of the log.

    >>> from rovgraph.log import Log
    >>> since(Log("dive.csv", {}), 3.0)
    '3.0 s'
    """
    start = min((float(s.time[0]) for s in log.streams.values()), default=0.0)
    return f"{time - start:.1f} s"
