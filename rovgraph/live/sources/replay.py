"""Replay of a log as if it came in now."""

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.live.message import GEODETIC, Message, Reading
from rovgraph.live.sources.source import paced
from rovgraph.log import Log, read_log
from rovgraph.model.config import Config
from rovgraph.model.origin import lat_lon


@dataclass(frozen=True)
class LogReplay:
    """A log's measurements in the order of time, one per message; stamps are the log's times.

    Attributes
    ----------
    begin : time that the replay begins at, as of logs that are replayed together [s]; None = the log's first
    """

    url: str
    log: Log
    pace: float
    lossy: bool = False
    begin: float | None = None

    @property
    def span(self) -> tuple[float, float]:
        """First and last time of the log [s]."""
        times = [stream.time for stream in self.log.streams.values()]
        return min(float(t[0]) for t in times), max(float(t[-1]) for t in times)

    def messages(self, stop: threading.Event) -> Iterator[Message]:
        return paced(self._recorded(), self.pace, stop, self.begin)

    def _recorded(self) -> Iterator[Message]:
        places = _geodetic(self.log)
        for time, sensor, values, row in self.log.measurements():
            place = places.get(row) if sensor == "fix" else None
            reading = Reading(sensor, values) if place is None else Reading(GEODETIC, place)
            yield Message(self.url, time, time, (reading,))


def refuse_other_epochs(replays: Sequence[LogReplay]) -> None:
    """See that logs that are replayed together are on one clock: only what they share with the IMU's can be used.

    Raises
    ------
    InputError : a log that has no time in common with the one that holds the IMU; both are named
    """
    base = next((replay for replay in replays if "imu" in replay.log), None)
    for other in replays:
        if base is None or other is base:
            continue
        (begin, end), (first, last) = base.span, other.span
        if first > end or last < begin:
            raise InputError(
                f"{other.url}: its times, {first:.1f} to {last:.1f} s, have none in common with those of {base.url}, "
                f"{begin:.1f} to {end:.1f} s; do the clocks have different epochs? Put both files on one clock"
            )


def log_replay(url: str, path: str, config: Config, pace: float) -> LogReplay:
    """Replay of a file, with the configuration's columns and units.

    Samples of the magnetometer and stamps stay raw, as those of other sources: the navigator calibrates them and takes
    off known delays.

    Raises
    ------
    InputError : a file that cannot be worked with
    """
    return LogReplay(url, read_log(path, config.as_recorded()), pace)


def _geodetic(log: Log) -> dict[int, Array]:
    """Line -> latitude, longitude and noise, where the log has its fixes in degrees, as a receiver gives them."""
    if log.origin is None or "fix" not in log:
        return {}
    fix = log["fix"]
    north, east, *noise = fix.data.T
    lat, lon = lat_lon(north, east, log.origin)
    return dict(zip(fix.row.tolist(), np.column_stack([lat, lon, *noise]), strict=True))
