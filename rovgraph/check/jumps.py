"""Clocks that jump within a dive: where the DVL's lag against the IMU is another before and after a gap of one of them.

A clock that is set leaves a gap in the stamps of the instrument that it belongs to. Where the lag before and after is
known, and the gap says whose clock it is, the later stamps are put back by the difference (`bridge_jumps`).
"""

from dataclasses import dataclass, replace

import numpy as np

from rovgraph.check.acceleration import BETTER, Comparison, Search
from rovgraph.check.findings import Finding, since, valid_pings
from rovgraph.check.inertial import GAP, GAP_PERIODS, inertial_motion
from rovgraph.check.lags import ORIENTATIONS
from rovgraph.check.values import GRAVITY_ANGLE, tilt
from rovgraph.config import Config
from rovgraph.errors import warn
from rovgraph.log import Log, Stream
from rovgraph.log.beams import BEAMS
from rovgraph.log.frozen import false_values, without
from rovgraph.rules import ACCELERATION

ENOUGH_PINGS = 50
JUMP_REACH = 10.0  # largest jump that is looked for where there is no gap [s]
LARGEST_JUMP = 120.0  # [s]
PIECE = 30.0  # shortest part of a dive that shows a lag [s]
GAPS = 2  # the largest, of IMU and DVL each, at which a clock may have been set
MOST_JUMPS = 5  # of one dive, that are bridged
SURE_S = 0.1  # sd of a jump that is bridged [s]
SURE = 3.0  # standard deviations
SMALL_S = 0.05  # between the gap and the jump, that tells of nothing missing [s]
CLOCKED = {  # by one clock
    "imu": ("imu", "mag", "ahrs"),
    "dvl": ("dvl", "dvl_water", "dvl_heading", "dvl_altitude", BEAMS),
}
NAMES = {"imu": "IMU", "dvl": "DVL"}


@dataclass(frozen=True)
class Jump:
    """A clock that is set between two times.

    Attributes
    ----------
    sensor : whose clock it is, "imu" or "dvl"; "" where no gap tells
    before, after : stamps around it, equal where no gap tells [s]
    period : of the sensor [s]
    lags : how late the DVL's stamps are against the IMU's before and after [s]
    sd : of the difference of both [s]
    """

    sensor: str
    before: float
    after: float
    period: float = 0.0
    lags: tuple[float, float] = (np.nan, np.nan)
    sd: float = np.inf

    @property
    def by(self) -> float:
        """How far the clock is set forward [s]: the gap less a period, where nothing need be missing in it."""
        by = self.lags[1] - self.lags[0]
        by, gap = -by if self.sensor == "imu" else by, self.after - self.before - self.period
        return gap if np.isfinite(self.sd) and abs(by - gap) < max(SURE * self.sd, SMALL_S) else by

    @property
    def bridgeable(self) -> bool:
        """Whose clock it is and by how much it is set is known, and stamps that are put back stay in order."""
        return bool(self.sensor) and self.sd < SURE_S and 0.0 < self.by < self.after - self.before

    def finding(self, log: Log) -> Finding:
        """What to say of it."""
        first, second = (round(lag, 1) + 0.0 for lag in self.lags)  # no minus before a zero
        told = (
            f"the DVL's stamps are {first:.1f} s late relative to the IMU's before {since(log, self.before)} "
            f"and {second:.1f} s after {since(log, self.after)}"
        )
        if not self.sensor:
            return Finding(
                "log", "warning", f"{told}: a clock drifts or jumps; put both instruments on one clock", "jump"
            )
        text = (
            f"{told}: the {NAMES[self.sensor]}'s clock jumps by {self.by:+.1f} s in the gap between; correct its stamps"
        )
        return Finding(self.sensor, "warning", f"{text} from there on, or split the log", "jump")


@dataclass(frozen=True)
class Examined:
    """The DVL beside the IMU, and the jump of one of their clocks, where there is one."""

    compared: Comparison
    jump: Jump | None


def compare(log: Log, config: Config) -> Comparison | None:
    """The DVL beside the IMU; None where there is too little of them, or gravity is not where it should be."""
    if not {"dvl", "imu"} <= log.sensors or tilt(log, config) > GRAVITY_ANGLE:
        return None
    pings = valid_pings(without(log["dvl"], false_values(log, config)))
    motion = inertial_motion(log, config)
    return None if motion is None or len(pings) < ENOUGH_PINGS else Comparison(motion, pings, config)


def find_jump(log: Log, compared: Comparison) -> Jump | None:
    """A lag that is another before and after some time."""
    time = compared.motion.time
    middle = float(0.5 * (time[0] + time[-1]))
    splits = [*_gaps(compared.pings), *_gaps(log["imu"]), Jump("", middle, middle)]
    for split in sorted(splits, key=lambda s: s.before - s.after):
        reach = min(1.5 * (split.after - split.before) + JUMP_REACH, LARGEST_JUMP)
        if split.before - time[0] < PIECE or time[-1] - split.after < PIECE:
            continue
        spans = (time[0], split.before), (split.after, time[-1])
        sides = [compared.search(reach, span) for span in spans]
        best = [int(np.argmin(side.error[0])) for side in sides]
        lags = [float(side.lags[k]) for side, k in zip(sides, best, strict=True)]
        if not all(side.agreement[0, k] > ACCELERATION.follows for side, k in zip(sides, best, strict=True)):
            continue
        worse = [
            side.error[0, _index(side, lag)] / side.error[0, k]
            for side, k, lag in zip(sides, best, lags[::-1], strict=True)
        ]
        if min(worse) > BETTER:
            return _refined(compared, split, lags)
    return None


def _refined(compared: Comparison, split: Jump, lags: list[float]) -> Jump:
    """The lags by least squares, where that settles on both sides."""
    spans = (-np.inf, split.before), (split.after, np.inf)
    # a ping belongs to the side that its stamp is on, by the clock that is not set
    moved = lags if split.sensor == "imu" else (0.0, 0.0)
    fits = [
        compared.refine(lag, ORIENTATIONS[0], (begin + by, end + by))
        for lag, (begin, end), by in zip(lags, spans, moved, strict=True)
    ]
    if fits[0] is None or fits[1] is None:
        return replace(split, lags=(lags[0], lags[1]))
    return replace(split, lags=(fits[0].lag, fits[1].lag), sd=float(np.hypot(fits[0].lag_sd, fits[1].lag_sd)))


def bridge_jumps(log: Log, config: Config) -> tuple[Log, Examined | None]:
    """A log whose clocks go on: where a gap tells whose clock was set, its later stamps are put back by as much.

    Returns
    -------
    Log : the log, or one that is bridged
    Examined : of that log, as far as it is known by now, so that a check need not look again

    Warns
    -----
    DataWarning : a jump that is bridged, with both times
    """
    for _ in range(MOST_JUMPS):
        compared = compare(log, config)
        if compared is None:
            return log, None
        jump = find_jump(log, compared)
        if jump is None or not jump.bridgeable:
            return log, Examined(compared, jump)
        streams = {name: _put_back(stream, jump) for name, stream in log.streams.items()}
        shifted = [name for name, stream in streams.items() if stream is not log[name]]
        warn(
            f"{log.source}: the {NAMES[jump.sensor]}'s clock jumps by {jump.by:+.2f} s (sd {jump.sd:.2f} s) between "
            f"{since(log, jump.before)} and {since(log, jump.after)}: bridged; the later stamps of "
            f"{', '.join(shifted)} are moved back by as much"
        )
        beams = None if log.beams is None else _put_back(log.beams, jump)
        log = replace(log, streams=streams, beams=beams)
    return log, None


def _put_back(stream: Stream, jump: Jump) -> Stream:
    """A stream with its stamps after a jump put back, where it is of that clock: it has the gap, too."""
    if stream.sensor not in CLOCKED[jump.sensor] or len(stream) < 2:
        return stream
    middle = 0.5 * (jump.before + jump.after)
    k = int(np.searchsorted(stream.time, middle))
    if not 0 < k < len(stream) or stream.time[k] - stream.time[k - 1] < jump.by:
        return stream
    return replace(stream, time=np.where(stream.time >= middle, stream.time - jump.by, stream.time))


def _index(side: Search, lag: float) -> int:
    return int(np.argmin(np.abs(side.lags - lag)))


def _gaps(stream: Stream) -> list[Jump]:
    """The largest gaps of a stream, after which its clock may be another."""
    periods = np.diff(stream.time)
    widest = np.argsort(periods)[-GAPS:]
    period = float(np.median(periods))
    wide = widest[periods[widest] > max(GAP, GAP_PERIODS * period)]
    return [Jump(stream.sensor, float(stream.time[k]), float(stream.time[k + 1]), period) for k in wide]
