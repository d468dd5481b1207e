"""A whole log becomes the intervals of a dive: what `rovgraph.engine.assembly.Assembler` makes of its measurements.

What it does interval by interval is done here for all at once, on arrays: of the log, of the IMU's samples, and of
`DiveRows`, which the intervals hold views of. A test holds both equal.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from rovgraph.calibration import Belief
from rovgraph.config import Config, beliefs, mount_matrix
from rovgraph.engine.aiding import Aiding
from rovgraph.engine.dive_rows import DiveRows
from rovgraph.engine.keyframes import KeyframeInterval, measurement_rows, sd_of
from rovgraph.engine.landmarks import STILL_IN_VIEW, Landmarks
from rovgraph.engine.late_stamp_window import beyond_samples, window_around
from rovgraph.engine.measurement_table import Extra, MeasurementsOfInterval, MeasurementTable
from rovgraph.engine.motion import Motion
from rovgraph.engine.preintegration import preintegration_params
from rovgraph.engine.samples import HALF_WINDOW_S, knocked, means, rates, surveyed
from rovgraph.engine.scale import scale_to_bias, wanted
from rovgraph.engine.time_offsets import TimeOffsets
from rovgraph.engine.unknowns import unknowns
from rovgraph.engine.whole_log import Ordered, WholeLog
from rovgraph.geometry import Array
from rovgraph.instruments import Instrument
from rovgraph.kernels import measurement_row as at
from rovgraph.kernels import motion_row
from rovgraph.kernels.coasting import BRIDGE_ACC, BRIDGE_GYR
from rovgraph.kernels.preintegration import SNAPSHOT, preintegrate
from rovgraph.log import Log, Measurement
from rovgraph.sensors import SENSORS, ModelAiding
from rovgraph.sensors.sensor import of_instrument
from rovgraph.state import PLACE

Index = NDArray[np.int64]
Bools = NDArray[np.bool_]
_STILL = np.concatenate([[0.0], np.eye(3).ravel(), np.zeros(6)])  # a snapshot without motion


@dataclass(frozen=True)
class AssembledLog:
    """A dive: its intervals, and the same as arrays."""

    intervals: list[KeyframeInterval]
    rows: DiveRows


class _Taken(NamedTuple):
    """m measurements in the order in which intervals hold them: those between keyframes, then the ping.

    Attributes
    ----------
    found : the measurements
    interval : shape (m,), the keyframe that ends it
    ping : shape (m,), whether it is at that keyframe
    """

    found: Ordered
    interval: Index
    ping: Bools

    @property
    def keyframe(self) -> Index:
        """That each belongs to, shape (m,)."""
        return self.interval - ~self.ping

    def at(self, index: Index | Bools) -> "_Taken":
        return _Taken(self.found.at(index), self.interval[index], self.ping[index])


def assemble_log(
    log: Log,
    config: Config,
    instruments: Mapping[str, Instrument],
    bias: Array,
    time_offsets: TimeOffsets,
    left_out: Counter[tuple[str, str]],
    believed: Mapping[str, Belief] | None = None,
) -> AssembledLog:
    """The intervals of a log.

    Parameters
    ----------
    log : the dive
    config : effective configuration
    instruments : the sensors in use, by stream
    bias : ndarray, shape (6,), for preintegration
    time_offsets : how late stamps are assumed to be
    left_out : (sensor, reason) -> count, of measurements that never reach the graph; is added to
    believed : priors of the calibration; None = the configuration's

    Raises
    ------
    InputError : an IMU gap longer than ``imu.max_gap_s``
    """
    whole = WholeLog(log, instruments, config, time_offsets, HALF_WINDOW_S + time_offsets.span, left_out)
    if not len(whole.imu):
        return AssembledLog([], DiveRows.of([], [*instruments]))
    believed = beliefs(config) if believed is None else believed
    return _LogAssembly(whole, config, instruments, bias, time_offsets, left_out, believed).assembled()


class _LogAssembly:
    """The work of `assemble_log` on n keyframes; samples of interval k are ``first[k]`` to before ``last[k]``."""

    def __init__(
        self,
        whole: WholeLog,
        config: Config,
        instruments: Mapping[str, Instrument],
        bias: Array,
        time_offsets: TimeOffsets,
        left_out: Counter[tuple[str, str]],
        believed: Mapping[str, Belief],
    ) -> None:
        self.whole, self.config, self.instruments, self.bias = whole, config, instruments, bias
        self.time_offsets, self.left_out = time_offsets, left_out
        self.around = HALF_WINDOW_S + time_offsets.span
        self.scaled, self.R_bs = wanted(believed), mount_matrix(config.imu.mount_rpy_deg)
        lasting = unknowns(believed, instruments).time_constants  # which begin a segment at every keyframe
        self.segment_s = 0.0 if lasting else config.graph.segment_s
        noise = config.imu.noise
        self.noise, self.params = (noise.acc, noise.gyr), preintegration_params(config, noise.acc, noise.gyr)
        # the rate reaches these: by a lever arm, or by the motion of a turning body
        self.turned = {sensor for sensor, i in instruments.items() if i.rate_gain.any()} | {"thruster"}

    def assembled(self) -> AssembledLog:
        found = self.whole.ordered()
        keys = self.whole.keyframes(found)
        before = np.concatenate([keys.time[:1], keys.time[:-1]])
        self.keys, self.before, time = keys, before, self.whole.imu[:, 0]
        self.first = self._covering(before, HALF_WINDOW_S)
        self.last = np.minimum(time.searchsorted(keys.time + self.around) + 1, keys.count)
        self.longest_step = self.whole.longest_step(keys.count)
        self.segment = self._segments()
        self.rate_b, self.rate_sd = self._rates(np.arange(len(keys.time)), keys.time)
        gaps = surveyed(self.whole.imu, self.first, self.last, before, keys.time)
        taken = self._taken(found, gaps[:, 0] > self.longest_step)
        stops = taken.found.time[~taken.ping]
        first_stop = taken.interval[~taken.ping].searchsorted(np.arange(1, len(keys.time) + 1))
        motions, snapshots = self._motions(gaps[1:], stops, first_stop)
        moved = np.tile(_STILL, (len(taken.ping), 1))
        moved[~taken.ping] = snapshots
        kept, extras = self._extras(taken)
        taken, moved = taken.at(kept), moved[kept]
        every = self._covering(before, self.around)
        begin = np.where(taken.ping, keys.time[taken.interval], before[taken.interval])
        names, rows = [*self.instruments], self._rows(taken, moved)
        place = np.array([names.index(s.sensor) if s.sensor in names else -1 for s in taken.found.streams])
        dive = DiveRows.from_arrays(
            motions,
            self._scales(np.arange(1, len(keys.time)), before[1:], keys.time[1:], self.first, self.last),
            rows,
            place[taken.found.which],
            self._scales(taken.interval, begin, taken.found.time, every, keys.count),
            taken.keyframe,
            taken.interval,
            keys.time,
            tuple(names),
        )
        return AssembledLog([*self._intervals(dive, rows, taken, extras, stops, first_stop)], dive)

    def _covering(self, time: Array, span: float) -> Index:
        """The first of those samples that cover a time and what is up to ``span`` before it, shape (n,)."""
        return np.asarray(np.maximum(self.whole.imu[:, 0].searchsorted(time - span, side="right") - 1, 0))

    def _segments(self) -> Index:
        """The segment of time of each keyframe, shape (n,)."""
        if not self.segment_s > 0.0:
            return np.arange(len(self.keys.time))
        out, segment, begun = np.empty(len(self.keys.time), np.int64), -1, -np.inf
        for k, time in enumerate(self.keys.time.tolist()):
            if time - begun >= self.segment_s:
                segment, begun = segment + 1, time
            out[k] = segment
        return out

    def _rates(self, interval: Index, time: Array) -> tuple[Array, Array]:
        """Rate at m times, by the samples of their intervals, and its sd; shapes (m, 3), (m,)."""
        parts = self.first[interval], self.last[interval]
        return rates(self.whole.imu, *parts, time, self.longest_step[interval], self.noise[1])

    def _scales(self, interval: Index, begin: Array, end: Array, first: Index, last: Index) -> Array:
        """Bias by the IMU's scales over m times, shape (m, 6, 6), or (0, 6, 6) where these are exact."""
        if not self.scaled:
            return np.zeros((0, 6, 6))
        signal = means(self.whole.imu, first[interval], last[interval], begin, end)
        return scale_to_bias(signal - self.bias, self.R_bs)

    def _taken(self, found: Ordered, gap: Bools) -> _Taken:
        """What the intervals hold, with what thrusters tell; ``gap``, shape (n,), is where samples are missing."""
        keys = self.keys
        made = np.flatnonzero(keys.ping >= 0)
        rest = ~found.of("imu")
        rest[keys.ping[made]] = False
        own = np.flatnonzero(rest)
        interval = keys.upto.searchsorted(own, side="right")
        own, interval = own[interval < len(keys.time)], interval[interval < len(keys.time)]
        once = np.ones(len(own), bool)
        for k, stream in enumerate(found.streams):
            if SENSORS[stream.sensor].once_per_interval:
                same = np.flatnonzero(found.which[own] == k)
                once[same] = np.diff(interval[same], prepend=-1) > 0
        own, interval = own[once], interval[once]
        index, interval = np.concatenate([own, keys.ping[made]]), np.concatenate([interval, made])
        taken = _Taken(found.at(index), interval, np.arange(len(index)) >= len(own))
        if "thruster" in self.instruments:
            taken = self._aided(taken, gap)
        return taken.at(np.lexsort((taken.found.time, taken.ping, taken.interval)))

    def _aided(self, taken: _Taken, gap: Bools) -> _Taken:
        """The same with the measurements that thrusters' signals and the IMU make, after the others."""
        aiding = Aiding(cast(ModelAiding, self.instruments["thruster"].model), self.left_out)
        made: list[tuple[int, Measurement]] = []
        for k in range(1, len(gap)):
            for signal in self.whole.signals(float(self.whole.imu[self.keys.count[k] - 1, 0])):
                aiding.add(signal)
            if not gap[k]:
                samples = self.whole.imu[self.first[k] : self.last[k]]

                def rate(time: float, k: int = k) -> Array:
                    return np.asarray(self._rates(np.array([k]), np.array([time]))[0][0])

                pieces = aiding.between(float(self.before[k]), float(self.keys.time[k]), samples, rate)
                made += [(k, piece) for piece in pieces]
        if not made:
            return taken
        interval, ping = np.array([k for k, _ in made]), np.zeros(len(made), bool)
        return _Taken(
            taken.found.with_stream("thruster", [m for _, m in made]),
            np.concatenate([taken.interval, interval]),
            np.concatenate([taken.ping, ping]),
        )

    def _motions(self, gaps: Array, stops: Array, first_stop: Index) -> tuple[Array, Array]:
        """The motions of n - 1 intervals, shape (n - 1, ROW), and those up to every stop, shape (k, SNAPSHOT)."""
        step, (longest, within), shown = self.longest_step[1:], gaps[:, :2].T, gaps[:, 2:]
        bridged = within > step
        many = self.last[1:] - self.first[1:] >= 3
        knock = ~bridged & many & (longest <= step) & knocked(shown, self.noise)
        rows, snapshots = np.tile(self.params.row(self.bias, 0.0), (len(gaps), 1)), np.empty((len(stops), SNAPSHOT))
        densities = rows[:, motion_row.NOISE : motion_row.NOISE + 2]
        densities[bridged] = BRIDGE_ACC, BRIDGE_GYR
        densities[knock] = np.maximum(shown[knock], self.noise)
        rows[:, motion_row.GAP] = np.where(bridged, within, 0.0)
        parts = self.first[1:], self.last[1:], self.before[1:], self.keys.time[1:]
        preintegrate(self.whole.imu, *parts, stops, first_stop, rows, snapshots)
        return rows, snapshots

    def _extras(self, taken: _Taken) -> tuple[Bools, dict[int, Extra]]:
        """Which measurements are kept, shape (m,), and of those what has no place in a row, by their place then."""
        found, kept, extras = taken.found, np.ones(len(taken.ping), bool), {}
        lags = [self.time_offsets.lag(stream.sensor) for stream in found.streams]
        special = [k for k, stream in enumerate(found.streams) if lags[k] is not None or stream.sensor == PLACE]
        every, landmarks = self._covering(self.before, self.around), Landmarks(self.config.place.every_s)
        for j in np.flatnonzero(np.isin(found.which, special)).tolist():
            k, stream, lag = int(taken.interval[j]), found.streams[found.which[j]], lags[found.which[j]]
            window, landmark = None, None
            if lag is not None:
                imu = self.whole.imu[every[k] : self.keys.count[k]]
                start = float((self.keys.time if taken.ping[j] else self.before)[k])
                integration = self.params, self.bias
                window = window_around(float(found.stamp[j]), lag, imu, start, integration, float(self.longest_step[k]))
                if window is None:
                    self.left_out[stream.sensor, beyond_samples(self.instruments[stream.sensor])] += 1
                    kept[j] = False
                    continue
            if stream.sensor == PLACE:
                landmark = landmarks.observe(float(stream.data[found.index[j], 0]), float(found.time[j]))
                if landmark is None:
                    self.left_out[stream.sensor, STILL_IN_VIEW] += 1
                    kept[j] = False
                    continue
            extras[j] = Extra(window, landmark)
        place = np.cumsum(kept) - 1
        return kept, {int(place[j]): extra for j, extra in extras.items()}

    def _rows(self, taken: _Taken, moved: Array) -> Array:
        """Rows of the measurements, shape (m, ROW) or wider; ``moved`` is the motion from their keyframes."""
        found, dims = taken.found, [i.model.dim for i in self.instruments.values()]
        rows = measurement_rows(found.time, moved, self.bias, max(dims, default=0))
        for k, stream in enumerate(found.streams):
            own = np.flatnonzero(found.which == k)
            if not len(own):
                continue
            instrument, sensor = self.instruments[stream.sensor], SENSORS[stream.sensor]
            dim, values = instrument.model.dim, stream.data[found.index[own]]
            if stream.sensor != PLACE:
                rows[own, at.Z : at.Z + dim] = values[:, :dim]
            sd = instrument.sd
            if sensor.standard_deviation is not of_instrument:
                sd = np.array([sensor.standard_deviation(one, instrument, self.config) for one in values])
            rows[own, sd_of(dim) : sd_of(dim) + dim] = sd
            if stream.sensor in self.turned:
                rate_b, rate_sd = self._rates(taken.interval[own], found.time[own])
                rows[own, at.RATE : at.RATE_SD], rows[own, at.RATE_SD] = rate_b, rate_sd
        here = taken.interval[taken.ping]
        rows[taken.ping, at.RATE : at.RATE_SD], rows[taken.ping, at.RATE_SD] = self.rate_b[here], self.rate_sd[here]
        return rows

    def _intervals(
        self, dive: DiveRows, rows: Array, taken: _Taken, extras: Mapping[int, Extra], stops: Array, first_stop: Index
    ) -> Iterator[KeyframeInterval]:
        """The intervals, whose numbers are views of ``dive`` and of ``rows``."""
        found, streams = taken.found, taken.found.streams
        line = np.empty(len(taken.ping), np.int64)
        for k, stream in enumerate(streams):
            own = found.which == k
            line[own] = stream.row[found.index[own]]
        sensors, scales = [s.sensor for s in streams], dive.row_scales if self.scaled else None
        dims = [self.instruments[s].model.dim if s in self.instruments else 0 for s in sensors]
        columns = found.which, taken.keyframe, self.segment[taken.keyframe], line
        table = MeasurementTable(sensors, dims, *columns, rows, scales, extras)
        stop, begin = first_stop.tolist(), [0, *dive.taken.tolist()]
        times, parts = self.keys.time.tolist(), zip(self.first.tolist(), self.last.tolist(), strict=True)
        rate_sd, segment = self.rate_sd.tolist(), self.segment.tolist()
        for k, (time, (first, last)) in enumerate(zip(times, parts, strict=True)):
            motion, scale = None, None
            if k > 0:
                own = stops[stop[k - 1] : stop[k]]
                motion = Motion(dive.motions[k - 1], self.whole.samples(first, last), times[k - 1], time, own)
                scale = dive.scales[k - 1] if self.scaled else None
            here = MeasurementsOfInterval(table, begin[k], begin[k + 1])
            yield KeyframeInterval(k, time, segment[k], self.rate_b[k], rate_sd[k], motion, here, scale)
