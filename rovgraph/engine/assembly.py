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
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import InitVar, dataclass, field
from itertools import islice
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from rovgraph.config import Config, beliefs, mount_matrix
from rovgraph.engine.admission import refused, standard_deviation
from rovgraph.engine.aiding import Aiding
from rovgraph.engine.late_stamp_window import LateStampWindow, window_around
from rovgraph.engine.motion import Motion, Snapshot
from rovgraph.engine.samples import HALF_WINDOW_S, Samples, covering
from rovgraph.engine.scale import scale_to_bias, wanted
from rovgraph.engine.time_offsets import StampedMeasurement, TimeOffsets, pack_stamped, unpack_stamped
from rovgraph.geometry import Array
from rovgraph.instruments import Instrument
from rovgraph.log import Log, Measurement, Stream
from rovgraph.log.packing import pack, unpack
from rovgraph.log.streams import arrivals, in_precedence
from rovgraph.model_aiding import ModelAiding
from rovgraph.state import State

SHORTEST_S = 1e-3  # an interval
SOME = 4096  # measurements of a log that are objects at one time
ONCE_PER_INTERVAL = {"mag", "ahrs", "dvl_heading", "depth"}
_AT_KEYFRAME = Snapshot(0.0, np.eye(3), np.zeros(3), np.zeros(3))
_NO_RATE = np.zeros(3), 0.0


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


@dataclass(frozen=True, slots=True)
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
    scale_to_bias : ndarray, shape (6, 6), of `rovgraph.engine.scale`, where the IMU's scale may be off
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


@dataclass(frozen=True, slots=True)
class KeyframeInterval:
    """From the keyframe before to keyframe ``index``; the first has no motion.

    Attributes
    ----------
    index, time : of the keyframe that ends the interval
    segment : of time that this keyframe lies in, from 0 and by steps of 0 or 1: calibration
        variables that walk have one value in each
    rate_b, rate_sd : ndarray, shape (3,), float: measured rate at the keyframe, bias still
        in it, and its noise [rad/s]
    motion : from the keyframe before, None for the first
    measurements : at the keyframe itself, and between the keyframe before and it
    scale_to_bias : ndarray, shape (6, 6), of `rovgraph.engine.scale`, where the IMU's scale may be off
    """

    index: int
    time: float
    segment: int
    rate_b: Array
    rate_sd: float
    motion: Motion | None
    measurements: list[KeyframeMeasurement]
    scale_to_bias: Array | None = None

    @property
    def bridged(self) -> bool:
        """Whether samples of the IMU are missing."""
        return self.motion is not None and self.motion.gap_s > 0.0

    @property
    def between(self) -> list[KeyframeMeasurement]:
        """Measurements that belong to the keyframe before."""
        return [m for m in self.measurements if m.keyframe < self.index]

    @property
    def here(self) -> list[KeyframeMeasurement]:
        """Measurements at the keyframe that ends the interval."""
        return [m for m in self.measurements if m.keyframe == self.index]


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
        self._ready: Array | None = None  # where the log is known as a whole: times up to which each sample lets see
        self._waiting: deque[StampedMeasurement] = deque()
        self._aiding: Aiding | None = None
        self._signals: deque[Measurement] = deque()  # of thrusters, of a log that is known as a whole
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
            elif self._admissible(measurement):
                insort(self._waiting, self.time_offsets.placed(measurement), key=_time)
            return []
        if self._samples.add(measurement):  # after a gap: a keyframe here, so that nothing is carried through it
            insort(self._waiting, self.time_offsets.placed(measurement), key=_time)
        done: list[KeyframeInterval] = []
        if self._index < 0:
            done.append(self._begin(measurement.time))
        return done + self._take_until(measurement.time - self._around)

    def take(self, log: Log) -> list[KeyframeInterval]:
        """Take a whole log, before anything else: what `add` of each of its measurements and `finish` give.

        Raises
        ------
        InputError : an IMU gap longer than ``imu.max_gap_s``
        """
        if "imu" not in log or not len(log["imu"]):
            deque(self._stamped(log, None), maxlen=0)  # counts what is left out
            return []
        imu = log["imu"]
        after_gap = imu.take(self._samples.take(imu))
        self._ready, begin = imu.time - self._around, float(imu.time[0])
        if self._aiding is not None and "thruster" in log:
            stream = log["thruster"]
            own = zip(stream.time.tolist(), stream.data, stream.row.tolist(), strict=True)
            self._signals.extend(Measurement(time, "thruster", values, row) for time, values, row in own)
        measurements = self._not_before(begin, self._stamped(log, after_gap))
        self._samples.reach(1)
        done = [self._begin(begin)]
        while some := list(islice(measurements, SOME)):
            self._waiting.extend(some)
            done += self._take_until(min(some[-1].time, float(self._ready[-1])))
        self._samples.reach(len(imu))
        return done + self.finish()

    def copy(self) -> "Assembler":
        """One that goes on by itself from here."""
        twin = copy(self)
        twin._samples, twin.left_out = self._samples.copy(), self.left_out.copy()
        twin._waiting, twin._between = self._waiting.copy(), self._between[:]
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
        self._waiting, self._between = deque(unpack_stamped(state["waiting"])), unpack_stamped(state["between"])
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
        motion, _ = self._samples.integrated(table, self.bias, self._start, np.empty(0), time, learn=False)
        rate_b, rate_sd = self._samples.rate(table, time)
        return KeyframeInterval(self._index + 1, time, self._segment, rate_b, rate_sd, motion, [])

    def _take_until(self, time: float) -> list[KeyframeInterval]:
        """Place what has waited for the IMU up to a time."""
        done: list[KeyframeInterval] = []
        while self._waiting and self._waiting[0].time <= time:
            m = self._waiting.popleft()
            done += self._silence(m.time)
            if m.sensor == "imu" and m.time - self._start > SHORTEST_S:
                self._see(m.time)
                done.append(self._close(m.time, None))
            elif m.sensor == "dvl" and m.time - self._start >= self.config.graph.min_gap_s:
                self._see(m.time)
                done.append(self._close(m.time, m))
            elif m.sensor != "imu":
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
        if m.sensor not in self.instruments:
            return False
        for reason, mask in refused(m.sensor, m.values[None], self.config):
            if mask[0]:
                self.left_out[m.sensor, reason] += 1
                return False
        return True

    def _stamped(self, log: Log, after_gap: Stream | None) -> Iterator[StampedMeasurement]:
        """Measurements of a log that may enter the graph, and samples after a gap, in the order of where they are put.

        Of one place in the order of arrival.
        """
        streams = [] if after_gap is None else [after_gap]
        for stream in log.streams.values():
            if stream.sensor in self.instruments and stream.sensor != "thruster":
                streams.append(self._admitted(stream))
        streams = in_precedence(streams)
        if not streams:
            return
        names = [stream.sensor for stream in streams]
        late = np.array([self.time_offsets.of_sensor(name) for name in names])
        which, index, stamp = arrivals(streams)
        time = stamp - late[which]
        order = np.argsort(time, kind="stable")
        order = order[self._wanted(names, which[order], time[order])]
        for part in np.array_split(order, max(1, len(order) // SOME)):
            columns = (a[part].tolist() for a in (time, stamp, which, index))
            for t, s, k, i in zip(*columns, strict=True):
                stream = streams[k]
                yield StampedMeasurement(t, names[k], stream.data[i], int(stream.row[i]), s)

    def _wanted(self, names: Sequence[str], which: NDArray[np.int64], time: Array) -> NDArray[np.bool_]:
        """Without those of which one an interval is taken, where surely another one is: between near pings.

        Parameters
        ----------
        names : of streams
        which, time : ndarray, shape (n,), stream of each measurement, and where it is put [s], in this order
        """
        graph, wanted = self.config.graph, np.ones(len(time), bool)
        ends = np.isin(which, [k for k, name in enumerate(names) if name in ("imu", "dvl")])
        part = np.cumsum(ends)
        edges = np.concatenate([[-np.inf], time[ends], [np.inf]])
        # the keyframe before may stand up to `min_gap_s` before a ping that makes none
        whole = np.diff(edges) > graph.max_gap_s - graph.min_gap_s - SHORTEST_S
        begin, end = (np.inf, -np.inf) if self._ready is None else self._ready[[0, -1]] + self._around
        whole |= (edges[:-1] < begin) | (edges[1:] > end - SHORTEST_S)  # what is left out there is counted
        for k, name in enumerate(names):
            if name in ONCE_PER_INTERVAL:
                own = np.flatnonzero(which == k)
                wanted[own] = whole[part[own]] | (np.diff(part[own], prepend=-1) > 0)
        return wanted

    def _admitted(self, stream: Stream) -> Stream:
        """The measurements of a stream that may enter the graph; counts the others."""
        out = np.zeros(len(stream), bool)
        for reason, mask in refused(stream.sensor, stream.data, self.config):
            if (mask & ~out).any():
                self.left_out[stream.sensor, reason] += int((mask & ~out).sum())
            out |= mask
        return stream.take(~out) if out.any() else stream

    def _not_before(self, begin: float, measurements: Iterator[StampedMeasurement]) -> Iterator[StampedMeasurement]:
        """Without those that came and are put before the first IMU sample."""
        for m in measurements:
            if m.time < begin and m.stamp < begin:
                self.left_out[m.sensor, "before the first IMU sample"] += 1
            else:
                yield m

    def _begin(self, time: float) -> KeyframeInterval:
        """The first keyframe, at the first IMU sample, before which nothing can be placed."""
        early = [m for m in self._waiting if m.time < time]
        self.left_out.update((m.sensor, "before the first IMU sample") for m in early)
        self._waiting = deque(m for m in self._waiting if m.time >= time)
        return self._close(time, None)

    def _silence(self, time: float) -> list[KeyframeInterval]:
        """Keyframes for a time without pings."""
        done = []
        gap = self.config.graph.max_gap_s
        while time - self._start > gap:
            self._see_after(gap)
            done.append(self._close(self._start + gap, None))
        return done

    def _see(self, time: float) -> None:
        """Look at the samples of a log that is known as a whole up to the first that lets a time be seen."""
        if self._ready is not None:
            self._look(int(self._ready.searchsorted(time)))

    def _see_after(self, gap: float) -> None:
        """The same up to the first that lets more than a gap be seen since the newest keyframe."""
        if self._ready is None:
            return
        k = int(self._ready.searchsorted(self._start + gap, side="right"))
        while k > 0 and self._ready[k - 1] - self._start > gap:  # what `_silence` asks, to the last bit
            k -= 1
        while k < len(self._ready) and not self._ready[k] - self._start > gap:
            k += 1
        self._look(k)

    def _look(self, sample: int) -> None:
        assert self._ready is not None
        count = min(sample + 1, len(self._ready))
        self._samples.reach(count)
        while self._signals and self._signals[0].time <= self._samples.newest:
            assert self._aiding is not None
            self._aiding.add(self._signals.popleft())

    def _close(self, time: float, ping: StampedMeasurement | None) -> KeyframeInterval:
        """Make a keyframe at ``time`` and the interval that leads to it."""
        every = self._samples.table
        samples = covering(every, self._start)
        motion: Motion | None = None
        attached: list[KeyframeMeasurement] = []
        if self._index >= 0:
            motion, attached = self._integrate(samples, every, time)
        before = self._start
        self._index, self._start, self._between = self._index + 1, time, []
        if time - self._segment_start >= self.config.graph.segment_s:
            self._segment, self._segment_start = self._segment + 1, time
        rate_b, rate_sd = self._samples.rate(samples, time)
        if ping is not None:
            attached += self._attach(ping, _AT_KEYFRAME, rate_b, rate_sd, every)
        scaled = self._scale_to_bias(samples, before, time) if motion is not None else None
        self._samples.forget(time, self._around)
        return KeyframeInterval(self._index, time, self._segment, rate_b, rate_sd, motion, attached, scaled)

    def _integrate(self, samples: Array, every: Array, time: float) -> tuple[Motion, list[KeyframeMeasurement]]:
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
        motion, snapshots = self._samples.integrated(samples, self.bias, self._start, stops, time, learn=True)
        attached: list[KeyframeMeasurement] = []
        for m, snapshot in zip(taken, snapshots, strict=True):
            rate_b, rate_sd = self._samples.rate(samples, m.time) if m.sensor in self._turned else _NO_RATE
            attached += self._attach(m, Snapshot.of(snapshot), rate_b, rate_sd, every)
        return motion, attached

    def _attach(
        self, m: StampedMeasurement, motion: Snapshot, rate_b: Array, rate_sd: float, every: Array
    ) -> list[KeyframeMeasurement]:
        """The measurement, or nothing where its stamp may be too late for the IMU's samples ``every``."""
        instrument = self.instruments[m.sensor]
        lag = self.time_offsets.lag(m.sensor)
        window, known, landmark = None, self._samples, None
        if lag is not None:
            window = window_around(m.stamp, lag, every, self._start, (known.params, self.bias), known.longest_step)
            if window is None:
                self.left_out[m.sensor, f"calibration.{instrument.time_offset} reaches beyond the IMU's samples"] += 1
                return []
        z = m.values[: instrument.model.dim]
        if m.sensor == "place":
            landmark, z = self._sighting(m), np.zeros(instrument.model.dim)
            if landmark is None:
                return []
        sd = standard_deviation(m.sensor, m.values, instrument, self.config)
        place = (m.sensor, self._index, self._segment, m.time, m.row)
        scaled = self._scale_to_bias(every, self._start, m.time)
        return [KeyframeMeasurement(*place, z, sd, rate_b, rate_sd, motion, self.bias, window, scaled, landmark)]

    def _sighting(self, m: StampedMeasurement) -> LandmarkObservation | None:
        """A place that is seen; None where it has been in view just now."""
        name = float(m.values[0])
        if m.time - self._sighted.get(name, -math.inf) < self.config.place.every_s:
            self.left_out["place", "still in view"] += 1
            return None
        self._sighted[name], self._sightings = m.time, self._sightings + 1
        return LandmarkObservation(name, self._sightings)

    def _scale_to_bias(self, samples: Array, begin: float, end: float) -> Array | None:
        """The IMU's mean signal as scale errors make a bias of it, where there may be any."""
        if not self._scaled:
            return None
        return scale_to_bias(self._samples.mean(samples, begin, end) - self.bias, self._R_bs)


def _time(m: StampedMeasurement) -> float:
    return m.time
