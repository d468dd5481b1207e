"""Measurements in the order of time become keyframes and what lies between them.

A keyframe stands at every DVL ping, and wherever `graph.max_gap_s` passes without one.
Any other measurement belongs to the keyframe before it and carries the IMU's motion
from there to its own time, so nothing is rounded to a keyframe. Batch and incremental
estimators consume the same `KeyframeInterval` objects.

Headings and depths are taken once per interval, the first one: their errors last
longer than that, and counting each sample would make the estimate too sure of itself.
"""

import math
from bisect import insort
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
from rovgraph.graph.late_stamp_window import LateStampWindow, window_around
from rovgraph.graph.preintegration import Snapshot
from rovgraph.graph.samples import HALF_WINDOW_S, Samples, covering
from rovgraph.graph.scale import scale_to_bias, wanted
from rovgraph.graph.time_offsets import StampedMeasurement, TimeOffsets, pack_stamped, unpack_stamped
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


class LandmarkObservation(NamedTuple):
    """Which place a camera or sonar saw.

    Attributes
    ----------
    name : what the log calls it
    number : of the place's variable: that of its first landmark. To begin with each landmark is of a place
        of its own; `rovgraph.graph.places` finds those that are one.
    believed : False = the vehicle cannot have been there; it is not let in unless the optimum says otherwise
    """

    name: float
    number: int
    believed: bool = True


@dataclass(frozen=True)
class KeyframeMeasurement:
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
    window : LateStampWindow of one stamp, where stamps may be late
    scale_to_bias : ndarray, shape (6, 6), of `rovgraph.graph.scale`, where the IMU's scale may be off
    landmark : of a place, where it is one
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
    window: LateStampWindow | None = None
    scale_to_bias: Array | None = None
    landmark: LandmarkObservation | None = None


@dataclass(frozen=True)
class KeyframeInterval:
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
    measurements : at the keyframe itself, and between the keyframe before and it
    scale_to_bias : ndarray, shape (6, 6), of `rovgraph.graph.scale`, where the IMU's scale may be off
    """

    index: int
    time: float
    segment: int
    rate_b: Array
    rate_sd: float
    pim: gtsam.PreintegratedCombinedMeasurements | None
    gap_s: float
    measurements: list[KeyframeMeasurement]
    scale_to_bias: Array | None = None

    @property
    def bridged(self) -> bool:
        """Whether samples of the IMU are missing."""
        return self.gap_s > 0.0


@dataclass
class Assembler:
    """Takes measurements one by one, gives back an `KeyframeInterval` whenever one is complete.

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
    assumed: InitVar[TimeOffsets | None] = None

    def __post_init__(self, assumed: TimeOffsets | None) -> None:
        self._R_bs = mount_matrix(self.config.imu.mount_rpy_deg)
        self._samples = Samples(self.config, self.learn_noise)
        self._waiting: list[StampedMeasurement] = []
        self._aiding: Aiding | None = None
        if "thruster" in self.instruments:
            self._aiding = Aiding(cast(ModelAiding, self.instruments["thruster"].model), self.left_out)
        self._index, self._start = -1, 0.0
        self._segment, self._segment_start = -1, -np.inf
        self._between: list[StampedMeasurement] = []
        self._sighted: dict[float, float] = {}  # place -> when it last counted [s]
        self._sightings = 0
        self.time_offsets = assumed or TimeOffsets.of(self.config, self.instruments)
        self._scaled = wanted(beliefs(self.config))
        self._around = HALF_WINDOW_S + self.time_offsets.span

    def add(self, measurement: Measurement) -> list[KeyframeInterval]:
        """Take a measurement; times must not decrease.

        Returns
        -------
        list of KeyframeInterval : those that this measurement completes, usually none or one

        Raises
        ------
        InputError : an IMU gap longer than ``imu.max_gap_s``
        """
        if measurement.sensor != "imu":
            if measurement.sensor == "thruster":
                if self._aiding is not None:
                    self._aiding.add(measurement)
            elif self._admissible(measurement):
                insort(self._waiting, self.time_offsets.placed(measurement), key=_time)
            return []
        if self._samples.add(measurement):  # after a gap: a keyframe here, so that nothing is carried through it
            insort(self._waiting, self.time_offsets.placed(measurement), key=_time)
        done: list[KeyframeInterval] = []
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
        twin.time_offsets = self.time_offsets.copy()
        if self._aiding is not None:
            twin._aiding = self._aiding.copy(twin.left_out)
        return twin

    def state(self) -> dict[str, Any]:
        """Where it stands, as plain values and arrays."""
        return {
            **self._samples.state(),
            "waiting": pack_stamped(self._waiting),
            "between": pack_stamped(self._between),
            "assumed": self.time_offsets.assumed,
            "signals": pack(self._aiding.signals if self._aiding is not None else []),
            "at": [self._index, self._start, self._segment, self._segment_start],
            "sighted": np.array([*self._sighted.items()]).reshape(-1, 2),
            "landmarks": self._sightings,
            "bias": self.bias,
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from where another stood."""
        self._samples.restore(state)
        self._waiting, self._between = unpack_stamped(state["waiting"]), unpack_stamped(state["between"])
        self.time_offsets.assumed.update(state["assumed"])
        if self._aiding is not None:
            self._aiding.signals = unpack(state["signals"])
        self._index, self._start, self._segment, self._segment_start = state["at"]
        self.bias = state["bias"]
        self._sighted, self._sightings = dict(state["sighted"].tolist()), state["landmarks"]

    def ahead(self, samples: Sequence[Measurement], time: float, state: State) -> KeyframeInterval:
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
        return KeyframeInterval(self._index + 1, time, self._segment, rate_b, rate_sd, pim, gap_s, [])

    def _take_until(self, time: float) -> list[KeyframeInterval]:
        """Place what has waited for the IMU up to a time."""
        done: list[KeyframeInterval] = []
        while self._waiting and self._waiting[0].time <= time:
            m = self._waiting.pop(0)
            done += self._silence(m.time)
            if m.sensor == "imu":
                done += [self._close(m.time, None)] if m.time - self._start > SHORTEST_S else []
            elif m.sensor == "dvl" and m.time - self._start >= self.config.graph.min_gap_s:
                done.append(self._close(m.time, m))
            else:
                self._between.append(m)
        return done + self._silence(time)

    def finish(self) -> list[KeyframeInterval]:
        """Place the rest, and a last keyframe at the last IMU sample."""
        end = self._samples.newest
        if end == -math.inf:
            return []
        done = self._take_until(end)
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

    def _silence(self, time: float) -> list[KeyframeInterval]:
        """Keyframes for a time without pings."""
        done = []
        gap = self.config.graph.max_gap_s
        while time - self._start > gap:
            done.append(self._close(self._start + gap, None))
        return done

    def _close(self, time: float, ping: StampedMeasurement | None) -> KeyframeInterval:
        """Make a keyframe at ``time`` and the interval that leads to it."""
        every = self._samples.table
        samples = covering(every, self._start)
        pim, gap_s = None, 0.0
        attached: list[KeyframeMeasurement] = []
        if self._index >= 0:
            pim, gap_s, attached = self._integrate(samples, every, time)
        before = self._start
        self._index, self._start, self._between = self._index + 1, time, []
        if time - self._segment_start >= self.config.graph.segment_s:
            self._segment, self._segment_start = self._segment + 1, time
        rate_b, rate_sd = self._samples.rate(samples, time)
        if ping is not None:
            attached += self._attach(ping, _AT_KEYFRAME, rate_b, rate_sd, every)
        scaled = self._felt(samples, before, time) if pim is not None else None
        self._samples.forget(time, self._around)
        return KeyframeInterval(self._index, time, self._segment, rate_b, rate_sd, pim, gap_s, attached, scaled)

    def _integrate(
        self, samples: Array, every: Array, time: float
    ) -> tuple[gtsam.PreintegratedCombinedMeasurements, float, list[KeyframeMeasurement]]:
        taken, seen = [], set()
        for m in self._between:
            if m.sensor not in seen:
                taken.append(m)
            if m.sensor in ONCE_PER_INTERVAL:
                seen.add(m.sensor)
        if self._aiding is not None and not self._samples.gap(samples):
            aiding = self._aiding.between(self._start, time, samples, lambda t: self._samples.rate(samples, t)[0])
            taken = sorted(taken + [StampedMeasurement(*m, m.time) for m in aiding], key=_time)
        stops = np.array([m.time for m in taken])
        pim, motions, gap_s = self._samples.integrated(samples, self.bias, self._start, stops, time, learn=True)
        attached: list[KeyframeMeasurement] = []
        for m, motion in zip(taken, motions, strict=True):
            attached += self._attach(m, motion, *self._rate_for(m, samples), every)
        return pim, gap_s, attached

    def _rate_for(self, m: StampedMeasurement, samples: Array) -> tuple[Array, float]:
        """The rate, for those instruments that it reaches: by a lever arm, or by the motion of a turning body."""
        reached = m.sensor == "thruster" or self.instruments[m.sensor].rate_gain.any()
        return self._samples.rate(samples, m.time) if reached else (np.zeros(3), 0.0)

    def _attach(
        self, m: StampedMeasurement, motion: Snapshot, rate_b: Array, rate_sd: float, every: Array
    ) -> list[KeyframeMeasurement]:
        """The measurement, or nothing where its stamp may be too late for the IMU's samples ``every``."""
        instrument = self.instruments[m.sensor]
        lag = self.time_offsets.lag(m.sensor)
        window, known = None, self._samples
        if lag is not None:
            window = window_around(m.stamp, lag, every, self._start, (known.params, self.bias), known.longest_step)
        if lag is not None and window is None:
            self.left_out[m.sensor, f"calibration.{instrument.time_offset} reaches beyond the IMU's samples"] += 1
            return []
        dim, landmark = instrument.model.dim, None
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
            landmark = self._sighting(m)
            if landmark is None:
                return []
            z, sd = np.zeros(dim), np.full(dim, min(m.values[1], LARGEST_SD)) if m.values[1] > 0.0 else sd
        place = (m.sensor, self._index, self._segment, m.time, m.row)
        scaled = self._felt(every, self._start, m.time)
        return [KeyframeMeasurement(*place, z, sd, rate_b, rate_sd, motion, self.bias, window, scaled, landmark)]

    def _sighting(self, m: StampedMeasurement) -> LandmarkObservation | None:
        """A place that is seen; None where it has been in view just now."""
        name = float(m.values[0])
        if m.time - self._sighted.get(name, -math.inf) < self.config.place.every_s:
            self.left_out["place", "still in view"] += 1
            return None
        self._sighted[name], self._sightings = m.time, self._sightings + 1
        return LandmarkObservation(name, self._sightings)

    def _felt(self, samples: Array, begin: float, end: float) -> Array | None:
        """The IMU's mean signal as scale errors feel it, where there may be any."""
        if not self._scaled:
            return None
        time = np.linspace(begin, end, 21)
        signal = np.array([np.interp(time, samples[:, 0], column).mean() for column in samples[:, 1:].T])
        return scale_to_bias(signal - self.bias, self._R_bs)


def _time(m: StampedMeasurement) -> float:
    return m.time
