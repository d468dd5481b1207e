"""A log that is known as a whole: which of its measurements enter, and where the keyframes stand.

The rules are those of `rovgraph.engine.assembly.Assembler`, which takes measurements as they come; a test holds the
intervals of both equal. Which samples of the IMU have come when a keyframe is made is a count: that of those up to the
first by which the keyframe is past, as the assembler waits for it.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rovgraph.config import Config, mount_matrix
from rovgraph.engine.admission import admitted
from rovgraph.engine.motion import SamplesOfLog
from rovgraph.engine.samples import PERIODS, longest_regular, too_long
from rovgraph.engine.time_offsets import TimeOffsets
from rovgraph.geometry import Array
from rovgraph.instruments import Instrument
from rovgraph.log import Log, Measurement, Stream
from rovgraph.log.streams import arrivals, in_precedence
from rovgraph.sensors import SENSORS

Index = NDArray[np.int64]
SHORTEST_S = 1e-3  # an interval


@dataclass(frozen=True)
class Ordered:
    """m measurements in the order of where they are put; of one time in the order of arrival.

    Attributes
    ----------
    streams : of "imu" those samples that come after a gap
    which, index : shape (m,), the stream of each, and its place in it
    time, stamp : shape (m,), where it is put, and the time that it came with [s]
    """

    streams: Sequence[Stream]
    which: Index
    index: Index
    time: Array
    stamp: Array

    def of(self, *sensors: str) -> NDArray[np.bool_]:
        """Which are of some sensors, shape (m,)."""
        return np.isin(self.which, [k for k, stream in enumerate(self.streams) if stream.sensor in sensors])

    def at(self, index: Index | NDArray[np.bool_]) -> "Ordered":
        """Some of them."""
        return Ordered(self.streams, self.which[index], self.index[index], self.time[index], self.stamp[index])

    def with_stream(self, sensor: str, more: Sequence[Measurement]) -> "Ordered":
        """The same with the measurements of another stream, after the others."""
        time, row = np.array([m.time for m in more]), np.array([m.row for m in more], np.int64)
        stream = Stream(sensor, (), time, np.array([m.values for m in more]), row)
        added = np.full(len(more), len(self.streams)), np.arange(len(more)), time, time
        mine = self.which, self.index, self.time, self.stamp
        which, index, time, stamp = (np.concatenate(both) for both in zip(mine, added, strict=True))
        return Ordered([*self.streams, stream], which, index, time, stamp)

    def counted(self, index: Index | NDArray[np.bool_], reason: str) -> Counter[tuple[str, str]]:
        """(sensor, reason) -> how many of some there are."""
        counts = np.bincount(self.which[index], minlength=len(self.streams)).tolist()
        return Counter({(s.sensor, reason): n for s, n in zip(self.streams, counts, strict=True) if n})


@dataclass(frozen=True)
class Keyframes:
    """Where n keyframes stand.

    Attributes
    ----------
    time : shape (n,) [s]
    ping : shape (n,), place of the ping that makes it among what is `Ordered`, or -1
    upto : shape (n,), measurements that have come before it, those at its time included unless they follow its ping
    count : shape (n,), samples of the IMU that are known when it is made
    """

    time: Array
    ping: Index
    upto: Index
    count: Index


class WholeLog:
    """The measurements of a log in the order of where they are put, and its IMU.

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
    imu : ndarray, shape (k, 7), time, specific force, rate in body axes; empty where the log has none
    begin, end : of the IMU [s]

    Raises
    ------
    InputError : an IMU gap longer than ``imu.max_gap_s``
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
        self._R_sb = mount_matrix(config.imu.mount_rpy_deg).T
        self.imu, self._stream = np.empty((0, 7)), log.streams.get("imu")
        if self._stream is not None and len(self._stream):
            self.imu = self.samples(0, len(self._stream)).in_body()
        self._check_gaps()
        self.begin, self.end = np.inf, -np.inf
        if len(self.imu):
            self.begin, self.end = float(self.imu[0, 0]), float(self.imu[-1, 0])
        self._past = self.imu[:, 0] - around  # what each sample lets be looked at
        self._thruster, self._signalled = log.streams.get("thruster"), 0
        self._streams = []
        for sensor, stream in log.streams.items():
            if sensor in instruments and sensor != "thruster":
                mask = admitted(sensor, stream.data, config, left_out)
                self._streams.append(stream if mask.all() else stream.take(mask))

    def samples(self, first: int, last: int) -> SamplesOfLog:
        """Some of the IMU's, as a `Motion` refers to them."""
        assert self._stream is not None
        return SamplesOfLog(self._stream, self._R_sb, first, last)

    def longest_step(self, count: Index) -> Array:
        """Step between two samples that is no gap, as it is known after so many samples [s]."""
        return np.asarray(self._longest_steps[np.clip(count, 1, len(self._longest_steps)) - 1])

    @cached_property
    def _longest_steps(self) -> Array:
        """The same after each of the first samples."""
        periods = np.diff(self.imu[: PERIODS + 1, 0]).tolist()
        return np.array([longest_regular(periods[:k]) for k in range(len(periods) + 1)])

    def ordered(self) -> Ordered:
        """The measurements that may enter the graph, and samples after a gap; counts those before the first sample."""
        assert self._stream is not None
        steps = np.diff(self.imu[:, 0], prepend=np.inf)
        missing = steps > self.longest_step(np.arange(len(steps)))
        missing[0] = False
        streams = in_precedence([self._stream.take(missing), *self._streams])
        late = np.array([self._time_offsets.of_sensor(stream.sensor) for stream in streams])
        which, index, stamp = arrivals(streams)
        time = stamp - late[which]
        order = np.argsort(time, kind="stable")
        found = Ordered(streams, which[order], index[order], time[order], stamp[order])
        found = found.at(self._wanted(found))
        early = (found.time < self.begin) & (found.stamp < self.begin)
        self._left_out += found.counted(early, "before the first IMU sample")
        return found.at(~early)

    def keyframes(self, found: Ordered) -> Keyframes:
        """Where keyframes stand; counts the measurements after the last one."""
        graph, start = self._config.graph, self.begin
        due = graph.max_gap_s + graph.ping_due_s
        made = [(start, -1, 0, 1)]

        def silence(until: float, longest: float, all_known: bool = False) -> None:
            nonlocal start
            while until - start > longest:
                count = len(self.imu) if all_known else self._count_after(start, longest)
                start += graph.max_gap_s
                made.append((start, -1, int(found.time.searchsorted(start, side="right")), count))

        enders = np.flatnonzero(found.of("imu", "dvl") & (found.time <= self.end))
        times, pings = found.time[enders], found.of("dvl")[enders]
        counts = np.minimum(self._past.searchsorted(times) + 1, len(self._past))  # up to the first by which it is past
        each = (column.tolist() for column in (enders, times, pings, counts))
        for k, time, ping, count in zip(*each, strict=True):
            silence(time, due)
            if time - start >= graph.min_gap_s if ping else time - start > SHORTEST_S:
                start = time
                made.append((start, k if ping else -1, k, count))
        silence(self.end, due)
        silence(self.end, graph.max_gap_s, all_known=True)
        within = int(found.time.searchsorted(self.end, side="right"))
        self._left_out += found.counted(np.arange(within, len(found.time)), "after the last IMU sample")
        if self.end - start >= SHORTEST_S:
            made.append((self.end, -1, within, len(self.imu)))
        else:
            rest = np.arange(made[-1][2], within)
            rest = rest[(rest != made[-1][1]) & ~found.of("imu")[rest]]
            self._left_out += found.counted(rest, "after the last keyframe")
        time, *numbers = (np.array(column) for column in zip(*made, strict=True))
        ping, upto, count = (column.astype(np.int64) for column in numbers)
        return Keyframes(time, ping, upto, np.maximum.accumulate(count))

    def signals(self, time: float) -> Iterator[Measurement]:
        """The thrusters' up to a time, each once."""
        stream = self._thruster
        while stream is not None and self._signalled < len(stream) and stream.time[self._signalled] <= time:
            k, self._signalled = self._signalled, self._signalled + 1
            yield Measurement(float(stream.time[k]), "thruster", stream.data[k], int(stream.row[k]))

    def _check_gaps(self) -> None:
        periods = np.diff(self.imu[:, 0])
        long = np.flatnonzero(periods > self._config.imu.max_gap_s)
        if long.size and self._stream is not None:
            k = int(long[0])
            raise too_long(self._config, float(periods[k]), float(self.imu[k + 1, 0]), int(self._stream.row[k + 1]))

    def _count_after(self, start: float, gap: float) -> int:
        """Samples up to the first by which more than ``gap`` has passed since a keyframe [s]."""
        k = int(self._past.searchsorted(start + gap, side="right"))
        while k > 0 and self._past[k - 1] - start > gap:  # as the `Assembler` asks, to the last bit
            k -= 1
        while k < len(self._past) and not self._past[k] - start > gap:
            k += 1
        return min(k + 1, len(self._past))

    def _wanted(self, found: Ordered) -> NDArray[np.bool_]:
        """Without those of which one an interval is taken, where surely another one is: between near pings."""
        graph, wanted = self._config.graph, np.ones(len(found.time), bool)
        ends = found.of("imu", "dvl")
        part = np.cumsum(ends)
        edges = np.concatenate([[-np.inf], found.time[ends], [np.inf]])
        # the keyframe before may stand up to `min_gap_s` before a ping that makes none
        whole = np.diff(edges) > graph.max_gap_s - graph.min_gap_s - SHORTEST_S
        whole |= (edges[:-1] < self.begin) | (edges[1:] > self.end - SHORTEST_S)  # what is left out there is counted
        for k, stream in enumerate(found.streams):
            if SENSORS[stream.sensor].once_per_interval:
                own = np.flatnonzero(found.which == k)
                wanted[own] = whole[part[own]] | (np.diff(part[own], prepend=-1) > 0)
        return wanted
