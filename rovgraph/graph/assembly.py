"""Measurements in the order of time become keyframes and what lies between them.

A keyframe stands at every DVL ping, and wherever `graph.max_gap_s` passes without one. A ping that comes up to
`Graph.ping_due_s` later makes the keyframe itself: where the period of pings is about ``max_gap_s``, rounding would
otherwise decide whether a ping has a keyframe.

Any other measurement belongs to the keyframe before it and carries the IMU's motion
from there to its own time, so nothing is rounded to a keyframe. Batch and incremental
estimators consume the same `Interval` objects.

Headings and depths are taken once per interval, the first one: their errors last
longer than that, and counting each sample would make the estimate too sure of itself.
"""

import math
from bisect import bisect_right, insort
from collections import Counter
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import InitVar, dataclass, field
from typing import Any, NamedTuple, cast

import gtsam
import numpy as np

from rovgraph.config import Config, beliefs, mount_matrix
from rovgraph.geometry import Array
from rovgraph.graph.aiding import Aiding
from rovgraph.graph.preintegration import Snapshot
from rovgraph.graph.samples import HALF_WINDOW_S, Samples, covering
from rovgraph.graph.scale import felt, wanted
from rovgraph.graph.stamps import Placed, Stamps, pack_placed, unpack_placed
from rovgraph.graph.track import Track, track_around
from rovgraph.instruments import Instrument
from rovgraph.log import Measurement
from rovgraph.log.packing import pack, unpack
from rovgraph.model_aiding import ModelAiding
from rovgraph.state import State

DEEPEST_M = 12e3  # no pressure sensor measures more, and a number like that overflows what comes after it
SHORTEST_S = 1e-3  # an interval
LARGEST_SD = 1e6  # of a measurement's own: more says no more, and overflows
ONCE_PER_INTERVAL = {"mag", "ahrs", "dvl_heading", "depth"}
_AT_KEYFRAME = Snapshot(0.0, np.eye(3), np.zeros(3), np.zeros(3))


class Sighting(NamedTuple):
    """Which place a camera or sonar saw.

    Attributes
    ----------
    name : what the log calls it
    number : of the place's variable: that of its first sighting. To begin with each sighting is of a place
        of its own; `rovgraph.graph.places` finds those that are one.
    believed : False = the vehicle cannot have been there; it is not let in unless the optimum says otherwise
    """

    name: float
    number: int
    believed: bool = True


@dataclass(frozen=True)
class Attached:
    """A measurement that belongs to a keyframe.

    Attributes
    ----------
    sensor : name of the log stream
    keyframe, segment : index of the keyframe, and the segment of time it lies in
    time, row : of the measurement, and its line in the log
    z : ndarray, shape (dim,)
    sd : ndarray, shape (dim,), the instrument's, or the measurement's own
    rate_b, rate_sd : ndarray, shape (3,), float: measured rate, bias still in it [rad/s]
    motion : Snapshot from the keyframe to the measurement
    bias : ndarray, shape (6,), that the motion was integrated with
    track : Track of one stamp, where stamps may be late
    felt : ndarray, shape (6, 6), of `rovgraph.graph.scale`, where the IMU's scale may be off
    sighting : of a place, where it is one
    """

    sensor: str
    keyframe: int
    segment: int
    time: float
    row: int
    z: Array
    sd: Array
    rate_b: Array
    rate_sd: float
    motion: Snapshot
    bias: Array
    track: Track | None = None
    felt: Array | None = None
    sighting: Sighting | None = None


@dataclass(frozen=True)
class Interval:
    """From the keyframe before to keyframe ``index``; the first has no motion.

    Attributes
    ----------
    index, time : of the keyframe that ends the interval
    segment : of time that this keyframe lies in, from 0 and by steps of 0 or 1: calibration
        variables that walk have one value in each
    rate_b, rate_sd : ndarray, shape (3,), float: measured rate at the keyframe, bias still
        in it, and its noise [rad/s]
    pim : preintegrated motion, None for the first keyframe
    gap_s : how long the IMU was silent, where that lies in the interval or reaches into it, or 0 [s]
    attached : measurements at the keyframe itself, and between the keyframe before and it
    felt : ndarray, shape (6, 6), of `rovgraph.graph.scale`, where the IMU's scale may be off
    """

    index: int
    time: float
    segment: int
    rate_b: Array
    rate_sd: float
    pim: gtsam.PreintegratedCombinedMeasurements | None
    gap_s: float
    attached: list[Attached]
    felt: Array | None = None

    @property
    def bridged(self) -> bool:
        """Whether samples of the IMU are missing."""
        return self.gap_s > 0.0


@dataclass
class Assembler:
    """Takes measurements one by one, gives back an `Interval` whenever one is complete.

    Attributes
    ----------
    config : effective configuration
    instruments : the sensors in use, by stream
    bias : ndarray, shape (6,), for preintegration; may be renewed between intervals
    left_out : (sensor, reason) -> count of measurements that never reach the graph
    learn_noise : raise the IMU's noise to what its newest samples show, where the log is not known as a whole
    assumed : how late stamps are; None = as the configuration believes
    stamps : the same
    """

    config: Config
    instruments: dict[str, Instrument]
    bias: Array
    left_out: Counter[tuple[str, str]] = field(default_factory=Counter)
    learn_noise: bool = False
    assumed: InitVar[Stamps | None] = None

    def __post_init__(self, assumed: Stamps | None) -> None:
        self._R_bs = mount_matrix(self.config.imu.mount_rpy_deg)
        self._samples = Samples(self.config, self.learn_noise)
        self._waiting: list[Placed] = []
        self._aiding: Aiding | None = None
        if "thruster" in self.instruments:
            self._aiding = Aiding(cast(ModelAiding, self.instruments["thruster"].model), self.left_out)
        self._index, self._start = -1, 0.0
        self._segment, self._segment_start = -1, -np.inf
        self._between: list[Placed] = []
        self._sighted: dict[float, float] = {}  # place -> when it last counted [s]
        self._sightings = 0
        self.stamps = assumed or Stamps.of(self.config, self.instruments)
        self._scaled = wanted(beliefs(self.config))
        self._around = HALF_WINDOW_S + self.stamps.span

    def add(self, measurement: Measurement) -> list[Interval]:
        """Take a measurement; times must not decrease.

        Returns
        -------
        list of Interval : those that this measurement completes, usually none or one

        Raises
        ------
        InputError : an IMU gap longer than ``imu.max_gap_s``
        """
        if measurement.sensor != "imu":
            if measurement.sensor == "thruster":
                if self._aiding is not None:
                    self._aiding.add(measurement)
            elif self._admissible(measurement):
                insort(self._waiting, self.stamps.placed(measurement), key=_time)
            return []
        if self._samples.add(measurement):  # after a gap: a keyframe here, so that nothing is carried through it
            insort(self._waiting, self.stamps.placed(measurement), key=_time)
        done: list[Interval] = []
        if self._index < 0:
            self._before_first(measurement.time)
            done.append(self._close(measurement.time, None))
        return done + self._take_until(measurement.time - self._around)

    def copy(self) -> "Assembler":
        """One that goes on by itself from here."""
        twin = copy(self)
        twin._samples, twin.left_out = self._samples.copy(), self.left_out.copy()
        twin._waiting, twin._between = self._waiting[:], self._between[:]
        twin._sighted = dict(self._sighted)
        twin.stamps = self.stamps.copy()
        if self._aiding is not None:
            twin._aiding = self._aiding.copy(twin.left_out)
        return twin

    def state(self) -> dict[str, Any]:
        """Where it stands, as plain values and arrays."""
        return {
            **self._samples.state(),
            "waiting": pack_placed(self._waiting),
            "between": pack_placed(self._between),
            "assumed": self.stamps.assumed,
            "signals": pack(self._aiding.signals if self._aiding is not None else []),
            "at": [self._index, self._start, self._segment, self._segment_start],
            "sighted": np.array([*self._sighted.items()]).reshape(-1, 2),
            "sightings": self._sightings,
            "bias": self.bias,
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from where another stood."""
        self._samples.restore(state)
        self._waiting, self._between = unpack_placed(state["waiting"]), unpack_placed(state["between"])
        self.stamps.assumed.update(state["assumed"])
        if self._aiding is not None:
            self._aiding.signals = unpack(state["signals"])
        self._index, self._start, self._segment, self._segment_start = state["at"]
        self.bias = state["bias"]
        self._sighted, self._sightings = dict(state["sighted"].tolist()), state["sightings"]

    def ahead(self, samples: Sequence[Measurement], time: float, state: State) -> Interval:
        """From the newest keyframe to a later time, as far as the IMU goes; beyond that, as if it stood still.

        Parameters
        ----------
        samples : of the IMU, those that have not been taken yet
        time : [s]
        state : State of one epoch, of the newest keyframe
        """
        force = state.R_nb[0].T @ np.array([0.0, 0.0, -self.config.environment.gravity_mps2])
        table = self._samples.ahead(samples, time, np.concatenate([force, np.zeros(3)]) + state.bias[0])
        pim, _, gap_s = self._samples.integrated(table, self.bias, self._start, np.empty(0), time, learn=False)
        rate_b, rate_sd = self._samples.rate(table, time)
        return Interval(self._index + 1, time, self._segment, rate_b, rate_sd, pim, gap_s, [])

    def _take_until(self, time: float) -> list[Interval]:
        """Place what has waited for the IMU up to a time."""
        due = self.config.graph.ping_due_s
        done: list[Interval] = []
        while self._waiting and self._waiting[0].time <= time:
            m = self._waiting.pop(0)
            done += self._silence(m.time, due)
            if m.sensor == "imu":
                done += [self._close(m.time, None)] if m.time - self._start > SHORTEST_S else []
            elif m.sensor == "dvl" and m.time - self._start >= self.config.graph.min_gap_s:
                done.append(self._close(m.time, m))
            else:
                self._between.append(m)
        return done + self._silence(time, due)

    def finish(self) -> list[Interval]:
        """Place the rest, and a last keyframe at the last IMU sample."""
        end = self._samples.newest
        if end == -math.inf:
            return []
        done = self._take_until(end)
        done += self._silence(end, 0.0)
        self.left_out.update((m.sensor, "after the last IMU sample") for m in self._waiting)
        if end - self._start < SHORTEST_S:
            self.left_out.update((m.sensor, "after the last keyframe") for m in self._between)
            return done
        return [*done, self._close(end, None)]

    def _admissible(self, m: Measurement) -> bool:
        """Whether a measurement may enter the graph; counts those that may not."""
        reason = None
        if m.sensor not in self.instruments:
            return False
        if m.sensor == "dvl" and m.values[3] == 0:
            reason = "no bottom lock"
        elif m.sensor in ("dvl", "dvl_water") and np.abs(m.values[:3]).max() > self.config.dvl.max_speed_mps:
            reason = "faster than dvl.max_speed_mps"
        elif m.sensor == "mag" and not m.values.any():
            reason = "exactly zero"
        elif m.sensor == "depth" and abs(m.values[0]) > DEEPEST_M:
            reason = "deeper than any sea"
        if reason:
            self.left_out[m.sensor, reason] += 1
        return reason is None

    def _before_first(self, time: float) -> None:
        """Nothing can be placed before the first IMU sample."""
        early = [m for m in self._waiting if m.time < time]
        self.left_out.update((m.sensor, "before the first IMU sample") for m in early)
        self._waiting = [m for m in self._waiting if m.time >= time]

    def _silence(self, time: float, ping_due_s: float) -> list[Interval]:
        """Keyframes for a time without pings; one that is ``ping_due_s`` late may still come."""
        done = []
        gap = self.config.graph.max_gap_s
        while time - self._start > gap + ping_due_s:
            done.append(self._close(self._start + gap, None))
        return done

    def _close(self, time: float, ping: Placed | None) -> Interval:
        """Make a keyframe at ``time`` and the interval that leads to it."""
        every = self._samples.table
        samples = covering(every, self._start)
        samples = samples[: int(samples[:, 0].searchsorted(time + self._around)) + 1]
        pim, gap_s = None, 0.0
        attached: list[Attached] = []
        later = bisect_right(self._between, time, key=_time)
        if self._index >= 0:
            pim, gap_s, attached = self._integrate(samples, every, self._between[:later], time)
        before = self._start
        self._index, self._start, self._between = self._index + 1, time, self._between[later:]
        if time - self._segment_start >= self.config.graph.segment_s:
            self._segment, self._segment_start = self._segment + 1, time
        rate_b, rate_sd = self._samples.rate(samples, time)
        if ping is not None:
            attached += self._attach(ping, _AT_KEYFRAME, rate_b, rate_sd, every)
        scaled = self._felt(samples, before, time) if pim is not None else None
        self._samples.forget(time, self._around)
        return Interval(self._index, time, self._segment, rate_b, rate_sd, pim, gap_s, attached, scaled)

    def _integrate(
        self, samples: Array, every: Array, between: list[Placed], time: float
    ) -> tuple[gtsam.PreintegratedCombinedMeasurements, float, list[Attached]]:
        taken, seen = [], set()
        for m in between:
            if m.sensor not in seen:
                taken.append(m)
            if m.sensor in ONCE_PER_INTERVAL:
                seen.add(m.sensor)
        if self._aiding is not None and not self._samples.gap(samples):
            aiding = self._aiding.between(self._start, time, samples, lambda t: self._samples.rate(samples, t)[0])
            taken = sorted(taken + [Placed(*m, m.time) for m in aiding], key=_time)
        stops = np.array([m.time for m in taken])
        pim, motions, gap_s = self._samples.integrated(samples, self.bias, self._start, stops, time, learn=True)
        attached: list[Attached] = []
        for m, motion in zip(taken, motions, strict=True):
            attached += self._attach(m, motion, *self._rate_for(m, samples), every)
        return pim, gap_s, attached

    def _rate_for(self, m: Placed, samples: Array) -> tuple[Array, float]:
        """The rate, for those instruments that it reaches: by a lever arm, or by the motion of a turning body."""
        reached = m.sensor == "thruster" or self.instruments[m.sensor].rate_gain.any()
        return self._samples.rate(samples, m.time) if reached else (np.zeros(3), 0.0)

    def _attach(self, m: Placed, motion: Snapshot, rate_b: Array, rate_sd: float, every: Array) -> list[Attached]:
        """The measurement, or nothing where its stamp may be too late for the IMU's samples ``every``."""
        instrument = self.instruments[m.sensor]
        lag = self.stamps.lag(m.sensor)
        track, known = None, self._samples
        if lag is not None:
            track = track_around(m.stamp, lag, every, self._start, (known.params, self.bias), known.longest_step)
        if lag is not None and track is None:
            self.left_out[m.sensor, f"calibration.{instrument.lateness} reaches beyond the IMU's samples"] += 1
            return []
        dim, sighting = instrument.model.dim, None
        z, sd = m.values[:dim], instrument.sd
        if m.sensor == "dvl":
            if m.values[4] > 0.0:
                sd = np.maximum(sd, min(m.values[4], LARGEST_SD))
            if self.config.dvl.scale_sd:
                sd = np.hypot(sd, self.config.dvl.scale_sd * np.linalg.norm(z))
        if m.sensor == "thruster":  # a mean over values[3] seconds
            sd = sd / math.sqrt(m.values[3])
        if m.sensor == "fix" and m.values[2] > 0.0:  # 0 is how receivers say that they do not know
            sd = np.full(dim, min(m.values[2], LARGEST_SD))
        if m.sensor == "place":
            sighting = self._sighting(m)
            if sighting is None:
                return []
            z, sd = np.zeros(dim), np.full(dim, min(m.values[1], LARGEST_SD)) if m.values[1] > 0.0 else sd
        place = (m.sensor, self._index, self._segment, m.time, m.row)
        scaled = self._felt(every, self._start, m.time)
        return [Attached(*place, z, sd, rate_b, rate_sd, motion, self.bias, track, scaled, sighting)]

    def _sighting(self, m: Placed) -> Sighting | None:
        """A place that is seen; None where it has been in view just now."""
        name = float(m.values[0])
        if m.time - self._sighted.get(name, -math.inf) < self.config.place.every_s:
            self.left_out["place", "still in view"] += 1
            return None
        self._sighted[name], self._sightings = m.time, self._sightings + 1
        return Sighting(name, self._sightings)

    def _felt(self, samples: Array, begin: float, end: float) -> Array | None:
        """The IMU's mean signal as scale errors feel it, where there may be any."""
        if not self._scaled:
            return None
        time = np.linspace(begin, end, 21)
        signal = np.array([np.interp(time, samples[:, 0], column).mean() for column in samples[:, 1:].T])
        return felt(signal - self.bias, self._R_bs)


def _time(m: Placed) -> float:
    return m.time
