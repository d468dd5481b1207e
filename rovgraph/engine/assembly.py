"""Measurements in the order of time become keyframes and what lies between them.

A keyframe stands at every DVL ping, and wherever `graph.max_gap_s` passes without one. A ping that comes up to
`Graph.ping_due_s` later makes the keyframe itself: where the period of pings is about ``max_gap_s``, rounding would
otherwise decide whether a ping has a keyframe.

Any other measurement belongs to the keyframe before it and carries the IMU's motion
from there to its own time, so nothing is rounded to a keyframe. Batch and incremental
estimators consume the same `KeyframeInterval` objects.

Headings and depths are taken once per interval, the first one: their errors last
longer than that, and counting each sample would make the estimate too sure of itself.
"""

import math
from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import InitVar, dataclass, field
from typing import Any, cast

import numpy as np

from rovgraph.calibration import Belief
from rovgraph.config import Config, beliefs, mount_matrix
from rovgraph.engine.admission import admitted
from rovgraph.engine.aiding import Aiding
from rovgraph.engine.constant_velocity import LONGEST_CRUISED_S, Ticks, has_constant_velocity, tick
from rovgraph.engine.keyframes import (
    KeyframeInterval,
    KeyframeMeasurement,
    measurement_rows,
    sd_of,
)
from rovgraph.engine.landmarks import STILL_IN_VIEW, Landmarks
from rovgraph.engine.late_stamp_window import beyond_samples, window_around
from rovgraph.engine.motion import Motion
from rovgraph.engine.samples import HALF_WINDOW_S, Samples, covering
from rovgraph.engine.scale import scale_to_bias, wanted
from rovgraph.engine.time_offsets import StampedMeasurement, TimeOffsets, pack_stamped, unpack_stamped
from rovgraph.engine.unknowns import unknowns
from rovgraph.engine.whole_log import SHORTEST_S
from rovgraph.geometry import Array
from rovgraph.instruments import Instrument
from rovgraph.kernels import measurement_row as at
from rovgraph.log import Measurement
from rovgraph.log.packing import pack, unpack
from rovgraph.sensors import SENSORS, ModelAiding
from rovgraph.sensors.sensor import none_refused
from rovgraph.state import PLACE

_AT_KEYFRAME = np.concatenate([[0.0], np.eye(3).ravel(), np.zeros(6)])[None]  # a snapshot without motion


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
    believed : priors of the calibration; None = the configuration's
    assumed : how late stamps are; None = as these have it
    stamps : the same
    """

    config: Config
    instruments: dict[str, Instrument]
    bias: Array
    left_out: Counter[tuple[str, str]] = field(default_factory=Counter)
    learn_noise: bool = False
    believed: InitVar[Mapping[str, Belief] | None] = None
    assumed: InitVar[TimeOffsets | None] = None

    def __post_init__(self, believed: Mapping[str, Belief] | None, assumed: TimeOffsets | None) -> None:
        believed = beliefs(self.config) if believed is None else believed
        self._R_bs = mount_matrix(self.config.imu.mount_rpy_deg)
        self._ticking = has_constant_velocity(self.config)
        self._samples = Ticks(self.config) if self._ticking else Samples(self.config, self.learn_noise)
        self._closing = {*self.instruments} if self._ticking else {"dvl"}  # sensors that make keyframes
        self._arrived: list[StampedMeasurement] = []  # since `_take_until` looked last
        self._waiting: deque[StampedMeasurement] = deque()  # in order, admitted
        self._refusing = {sensor for sensor in self.instruments if SENSORS[sensor].refused is not none_refused}
        self._due = math.inf  # time of the first that waits or has arrived, and closes an interval [s]
        self._aiding: Aiding | None = None
        if "thruster" in self.instruments:
            self._aiding = Aiding(cast(ModelAiding, self.instruments["thruster"].model), self.left_out)
        self._index, self._start = -1, 0.0
        self._heard = np.inf  # when anything was measured last, without an IMU
        self._segment, self._segment_start = -1, -np.inf
        self._between: list[StampedMeasurement] = []
        self._landmarks = Landmarks(self.config.place.every_s)
        self.time_offsets = assumed or TimeOffsets.of(believed, self.instruments)
        self._scaled = wanted(believed)
        lasting = unknowns(believed, self.instruments).time_constants  # which begin a segment at every keyframe
        self._segment_s = 0.0 if lasting else self.config.graph.segment_s
        graph = self.config.graph
        self._longest_gap = graph.max_gap_s + graph.ping_due_s  # a ping that is late may still come
        self._around = HALF_WINDOW_S + self.time_offsets.span
        self._dim = max(i.model.dim for i in self.instruments.values()) if self.instruments else 0
        # the rate reaches these: by a lever arm, or by the motion of a turning body
        self._turned = {sensor for sensor, i in self.instruments.items() if i.rate_gain.any()} | {"thruster"}

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
            elif measurement.sensor in self.instruments:
                self._put(measurement)
            if not self._ticking:
                return []
            measurement = tick(measurement)
        elif self._ticking:
            return []
        if self._samples.add(measurement):  # after a gap: a keyframe here, so that nothing is carried through it
            self._put(measurement)
        until = measurement.time - self._around
        if self._index < 0:
            return [self._begin(measurement.time), *self._take_until(until)]
        if until < self._due and until - self._start <= self._longest_gap:
            return []
        return self._take_until(until)

    def copy(self) -> "Assembler":
        """One that goes on by itself from here."""
        twin = copy(self)
        twin._samples, twin.left_out = self._samples.copy(), self.left_out.copy()
        twin._arrived, twin._waiting, twin._between = self._arrived[:], self._waiting.copy(), self._between[:]
        twin._landmarks = self._landmarks.copy()
        twin.time_offsets = self.time_offsets.copy()
        if self._aiding is not None:
            twin._aiding = self._aiding.copy(twin.left_out)
        return twin

    def state(self) -> dict[str, Any]:
        """Where it stands, as plain values and arrays."""
        self._admit()
        return {
            **self._samples.state(),
            "waiting": pack_stamped(self._waiting),
            "between": pack_stamped(self._between),
            "assumed": self.time_offsets.assumed,
            "signals": pack(self._aiding.signals if self._aiding is not None else []),
            "at": [self._index, self._start, self._segment, self._segment_start],
            "sighted": np.array([*self._landmarks.seen.items()]).reshape(-1, 2),
            "landmarks": self._landmarks.count,
            "bias": self.bias,
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from where another stood."""
        self._samples.restore(state)
        self._waiting, self._between = deque(unpack_stamped(state["waiting"])), unpack_stamped(state["between"])
        self._arrived, self._due = [], self._first_closing()
        self.time_offsets.assumed.update(state["assumed"])
        if self._aiding is not None:
            self._aiding.signals = unpack(state["signals"])
        self._index, self._start, self._segment, self._segment_start = state["at"]
        self.bias = state["bias"]
        self._landmarks.seen, self._landmarks.count = dict(state["sighted"].tolist()), state["landmarks"]

    def ahead(self, samples: Sequence[Measurement], time: float, x: Array) -> KeyframeInterval:
        """From the newest keyframe to a later time, as far as the IMU goes; beyond that, as if it stood still.

        Parameters
        ----------
        samples : of the IMU, those that have not been taken yet
        time : [s]
        x : ndarray, shape (21,), state vector of the newest keyframe, as of `rovgraph.engine.filter_step.Gaussian`
        """
        at_rest = x[15:].copy()
        at_rest[:3] -= self.config.environment.gravity_mps2 * x[6:9]
        table = self._samples.ahead(samples, time, at_rest)
        motion, _ = self._samples.integrated(table, self.bias, self._start, np.empty(0), time, learn=False)
        rate_b, rate_sd = self._samples.rate(table, time)
        return KeyframeInterval(self._index + 1, time, self._segment, rate_b, rate_sd, motion, [])

    def _take_until(self, time: float) -> list[KeyframeInterval]:
        """Place what has waited for the IMU up to a time."""
        self._admit()
        done: list[KeyframeInterval] = []
        while self._waiting and self._waiting[0].time <= time:
            m = self._waiting.popleft()
            done += self._silence(m.time, self._longest_gap)
            if m.sensor == "imu" and m.time - self._start > SHORTEST_S:
                done.append(self._close(m.time))
            elif self._ticking and m.time - self._heard > LONGEST_CRUISED_S:
                done.append(self._close(m.time))  # a keyframe that what is measured at it can align
                self._between.append(m)
            elif m.sensor in self._closing and m.time - self._start >= self.config.graph.min_gap_s:
                done.append(self._close(m.time, m, *self._together_with(m)))
            elif m.sensor != "imu":
                self._between.append(m)
            self._heard = m.time
        done += self._silence(time, self._longest_gap)
        self._due = self._first_closing()
        return done

    def finish(self) -> list[KeyframeInterval]:
        """Place the rest, and a last keyframe at the last IMU sample."""
        end = self._samples.newest
        if end == -math.inf:
            return []
        done = self._take_until(end)
        done += self._silence(end, self.config.graph.max_gap_s)
        self.left_out.update((m.sensor, "after the last IMU sample") for m in self._waiting)
        if end - self._start < SHORTEST_S:
            self.left_out.update((m.sensor, "after the last keyframe") for m in self._between)
            return done
        return [*done, self._close(end)]

    def _put(self, m: Measurement) -> None:
        """Keep a measurement until `_take_until` looks; one of the IMU marks a gap before it."""
        placed = self.time_offsets.placed(m)
        self._arrived.append(placed)
        if m.sensor in self._closing or m.sensor == "imu":
            self._due = min(self._due, placed.time)

    def _admit(self) -> None:
        """Put those that have arrived, and may enter the graph, in order; count those that may not."""
        if not self._arrived:
            return
        arrived, self._arrived = self._arrived, []
        values: dict[str, list[Array]] = {}
        for m in arrived:
            if m.sensor in self._refusing:
                values.setdefault(m.sensor, []).append(m.values)
        may = {s: iter(admitted(s, np.array(own), self.config, self.left_out).tolist()) for s, own in values.items()}
        admissible = [m for m in arrived if m.sensor not in may or next(may[m.sensor])]
        self._waiting = deque(sorted([*self._waiting, *admissible], key=_time))

    def _first_closing(self) -> float:
        """Time of the first that waits and closes an interval [s]."""
        return min((m.time for m in self._waiting if m.sensor in self._closing or m.sensor == "imu"), default=math.inf)

    def _begin(self, time: float) -> KeyframeInterval:
        """The first keyframe, at the first IMU sample, before which nothing can be placed."""
        self._admit()
        early = [m for m in self._waiting if m.time < time]
        self.left_out.update((m.sensor, "before the first IMU sample") for m in early)
        self._waiting = deque(m for m in self._waiting if m.time >= time)
        return self._close(time)

    def _silence(self, time: float, longest: float) -> list[KeyframeInterval]:
        """Keyframes for a time without pings, wherever it is longer than ``longest`` [s]."""
        done = []
        while time - self._start > longest:
            done.append(self._close(self._start + self.config.graph.max_gap_s))
        return done

    def _together_with(self, m: StampedMeasurement) -> Iterator[StampedMeasurement]:
        """Without an IMU, all else that was measured at the same time: it belongs to the same keyframe."""
        while self._ticking and self._waiting and self._waiting[0].time == m.time:
            yield self._waiting.popleft()

    def _close(self, time: float, *here: StampedMeasurement) -> KeyframeInterval:
        """Make a keyframe at ``time``, with what is measured ``here``, and the interval that leads to it."""
        every = self._samples.table
        samples = covering(every, self._start)
        samples = samples[: int(samples[:, 0].searchsorted(time + self._around)) + 1]
        later = bisect_right(self._between, time, key=_time)
        motion: Motion | None = None
        attached: list[KeyframeMeasurement] = []
        if self._index >= 0:
            motion, attached = self._integrate(samples, every, self._between[:later], time)
        before = self._start
        self._index, self._start, self._between = self._index + 1, time, self._between[later:]
        if time - self._segment_start >= self._segment_s:
            self._segment, self._segment_start = self._segment + 1, time
        rate_b, rate_sd = self._samples.rate(samples, time)
        for m in here:
            row = measurement_rows(time, _AT_KEYFRAME, self.bias, self._dim)[0]
            attached += self._attach(m, row, (rate_b, rate_sd), every)
        scaled = self._scale_to_bias(samples, before, time) if motion is not None else None
        self._samples.forget(time, self._around)
        return KeyframeInterval(self._index, time, self._segment, rate_b, rate_sd, motion, attached, scaled)

    def _integrate(
        self, samples: Array, every: Array, between: list[StampedMeasurement], time: float
    ) -> tuple[Motion, list[KeyframeMeasurement]]:
        taken, seen = [], set()
        for m in between:
            if m.sensor not in seen:
                taken.append(m)
            if SENSORS[m.sensor].once_per_interval:
                seen.add(m.sensor)
        if self._aiding is not None and not self._samples.gap(samples):
            aiding = self._aiding.between(self._start, time, samples, lambda t: self._samples.rate(samples, t)[0])
            taken = sorted(taken + [StampedMeasurement(*m, m.time) for m in aiding], key=_time)
        stops = np.array([m.time for m in taken])
        motion, snapshots = self._samples.integrated(samples, self.bias, self._start, stops, time, learn=True)
        attached: list[KeyframeMeasurement] = []
        for m, row in zip(taken, measurement_rows(stops, snapshots, self.bias, self._dim), strict=True):
            rate = self._samples.rate(samples, m.time) if m.sensor in self._turned else None
            attached += self._attach(m, row, rate, every)
        return motion, attached

    def _attach(
        self, m: StampedMeasurement, row: Array, rate: tuple[Array, float] | None, every: Array
    ) -> list[KeyframeMeasurement]:
        """The measurement, or nothing where its stamp may be too late for the IMU's samples ``every``.

        Its motion stands in ``row``; ``rate`` is what is measured there, and its noise, where it matters.
        """
        instrument = self.instruments[m.sensor]
        dim = instrument.model.dim
        lag = self.time_offsets.lag(m.sensor)
        window, known, landmark = None, self._samples, None
        if lag is not None:
            window = window_around(m.stamp, lag, every, self._start, (known.params, self.bias), known.longest_step)
            if window is None:
                self.left_out[m.sensor, beyond_samples(instrument)] += 1
                return []
        if m.sensor == PLACE:
            landmark = self._landmarks.observe(float(m.values[0]), m.time)
            if landmark is None:
                self.left_out[m.sensor, STILL_IN_VIEW] += 1
                return []
        else:
            row[at.Z : at.Z + dim] = m.values[:dim]
        sd = sd_of(dim)
        row[sd : sd + dim] = SENSORS[m.sensor].standard_deviation(m.values, instrument, self.config)
        if rate is not None:
            row[at.RATE : at.RATE_SD], row[at.RATE_SD] = rate
        scaled = self._scale_to_bias(every, self._start, m.time)
        place = (m.sensor, self._index, self._segment, m.row)
        return [KeyframeMeasurement(*place, dim, row, window, scaled, landmark)]

    def _scale_to_bias(self, samples: Array, begin: float, end: float) -> Array | None:
        """The IMU's mean signal as scale errors make a bias of it, where there may be any."""
        if not self._scaled:
            return None
        return scale_to_bias(self._samples.mean(samples, begin, end) - self.bias, self._R_bs)


def _time(m: StampedMeasurement) -> float:
    return m.time
