"""A log that is known as a whole, to be assembled as if its measurements came one by one.

IMU samples stay one array. Which of them have come when a keyframe is made is a count: that of those up to the
first by which the keyframe is past, as an `Assembler` waits for it.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rovgraph.config import Config
from rovgraph.engine.admission import admitted
from rovgraph.engine.constant_velocity import has_constant_velocity, ticks
from rovgraph.engine.time_offsets import StampedMeasurement, TimeOffsets
from rovgraph.geometry import Array
from rovgraph.instruments import Instrument
from rovgraph.log import Log, Measurement
from rovgraph.log.streams import arrivals, in_precedence
from rovgraph.sensors import SENSORS

SHORTEST_S = 1e-3  # an interval
SOME = 4096  # measurements of a log that are objects at one time


class WholeLog:
    """The measurements of a log in the order of where they are put.

    Parameters
    ----------
    log : Log
    instruments : the sensors in use, by stream
    config : effective configuration
    time_offsets : how late stamps are assumed to be
    around : how far past a time samples have to be for it to be looked at [s]
    left_out : (sensor, reason) -> count, of measurements that never reach the graph

    Attributes
    ----------
    imu : Stream, or None
    begin, end : of the IMU [s]
    """

    def __init__(
        self,
        log: Log,
        instruments: Mapping[str, Instrument],
        config: Config,
        time_offsets: TimeOffsets,
        around: float,
        left_out: Counter[tuple[str, str]],
    ) -> None:
        self._config, self._time_offsets, self._left_out = config, time_offsets, left_out
        self._ticking = has_constant_velocity(config)
        imu = ticks(log) if self._ticking else log.streams.get("imu")
        self.imu = imu if imu is not None and len(imu) else None
        time = np.empty(0) if self.imu is None else self.imu.time
        self.begin, self.end = (float(time[0]), float(time[-1])) if len(time) else (np.inf, -np.inf)
        self._past = time - around  # what each sample lets be looked at
        self._thruster, self._signalled = log.streams.get("thruster"), 0
        self._streams = []
        for sensor, stream in log.streams.items():
            if sensor in instruments and sensor != "thruster":
                mask = admitted(sensor, stream.data, config, left_out)
                self._streams.append(stream if mask.all() else stream.take(mask))

    def measurements(self, after_gap: NDArray[np.bool_]) -> Iterator[StampedMeasurement]:
        """Those that may enter the graph, and samples after a gap; of one time in the order of arrival.

        Parameters
        ----------
        after_gap : ndarray, shape (n,), whether samples are missing before each of the IMU's
        """
        assert self.imu is not None
        streams = in_precedence([self.imu.take(after_gap), *self._streams])
        names = [stream.sensor for stream in streams]
        late = np.array([self._time_offsets.of_sensor(name) for name in names])
        which, index, stamp = arrivals(streams)
        time = stamp - late[which]
        order = np.argsort(time, kind="stable")
        order = order[self._wanted(names, which[order], time[order])]
        for part in np.array_split(order, max(1, len(order) // SOME)):
            columns = (a[part].tolist() for a in (time, stamp, which, index))
            for t, s, k, i in zip(*columns, strict=True):
                if t < self.begin and s < self.begin:
                    self._left_out[names[k], "before the first IMU sample"] += 1
                else:
                    yield StampedMeasurement(t, names[k], streams[k].data[i], int(streams[k].row[i]), s)

    def count_at(self, time: float) -> int:
        """Samples up to the first by which a time is past."""
        return min(int(self._past.searchsorted(time)) + 1, len(self._past))

    def count_after(self, start: float, gap: float) -> int:
        """Samples up to the first by which more than ``gap`` has passed since a keyframe [s]."""
        k = int(self._past.searchsorted(start + gap, side="right"))
        while k > 0 and self._past[k - 1] - start > gap:  # as the `Assembler` asks, to the last bit
            k -= 1
        while k < len(self._past) and not self._past[k] - start > gap:
            k += 1
        return min(k + 1, len(self._past))

    def signals(self, time: float) -> Iterator[Measurement]:
        """The thrusters' up to a time, each once."""
        stream = self._thruster
        while stream is not None and self._signalled < len(stream) and stream.time[self._signalled] <= time:
            k, self._signalled = self._signalled, self._signalled + 1
            yield Measurement(float(stream.time[k]), "thruster", stream.data[k], int(stream.row[k]))

    def _wanted(self, names: Sequence[str], which: NDArray[np.int64], time: Array) -> NDArray[np.bool_]:
        """Without those of which one an interval is taken, where surely another one is: between near pings.

        Parameters
        ----------
        names : of streams
        which, time : ndarray, shape (n,), stream of each measurement, and where it is put [s], in this order
        """
        graph, wanted = self._config.graph, np.ones(len(time), bool)
        if self._ticking:  # each makes a keyframe
            return wanted
        ends = np.isin(which, [k for k, name in enumerate(names) if name in ("imu", "dvl")])
        part = np.cumsum(ends)
        edges = np.concatenate([[-np.inf], time[ends], [np.inf]])
        # the keyframe before may stand up to `min_gap_s` before a ping that makes none
        whole = np.diff(edges) > graph.max_gap_s - graph.min_gap_s - SHORTEST_S
        whole |= (edges[:-1] < self.begin) | (edges[1:] > self.end - SHORTEST_S)  # what is left out there is counted
        for k, name in enumerate(names):
            if SENSORS[name].once_per_interval:
                own = np.flatnonzero(which == k)
                wanted[own] = whole[part[own]] | (np.diff(part[own], prepend=-1) > 0)
        return wanted
