"""Assembly of a dive: all that has arrived, and the keyframes made of it, as arrays that grow.

`Assembly.extend` is the only rule of assembly, compiled in `rovgraph.kernels.assembly`: called once for a log, and for
each ping online. Each keyframe stores how much had arrived when it was made, so that a late measurement is inserted and
the keyframes since are made again. A renewed assumption of an estimated time offset holds for measurements that arrive
from then on. Learnt noise, and the number of sightings of places, are stored with the keyframes.
"""

import math
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import InitVar, dataclass, replace
from enum import StrEnum
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.kernels import assembly as at
from rovgraph.kernels import motion_row
from rovgraph.kernels.layout import MOTION
from rovgraph.kernels.measurement_row import BEAM_WIDTH, FIRST_KNOT, KNOT, LAYER_WIDTH, MOST, WIDTH, Z
from rovgraph.kernels.preintegration import HALF_WINDOW_S
from rovgraph.log import Log, Measurement, Stream
from rovgraph.log.streams import GAP_PERIODS, arrivals, in_precedence, precedence
from rovgraph.model.calibration import ACOUSTICS, WATER_LAYER, Belief
from rovgraph.model.config import Config, beliefs, mount_matrix
from rovgraph.model.state import PLACE
from rovgraph.problem.acoustics import SHIP, Acoustics
from rovgraph.problem.admission import TimeOffsets, admitted, pack, thruster_pieces, unpack
from rovgraph.problem.beams import BY_BEAMS, ONE_PING_S, PingsByBeams
from rovgraph.problem.calibration_roles import unknowns
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.problem.layers import WaterLayers, put_windows
from rovgraph.problem.motion import has_constant_velocity, preintegration_params, ticks, wanted
from rovgraph.problem.problem import Problem, in_body
from rovgraph.sensors import SENSORS, ModelAiding
from rovgraph.sensors.dvl_beam import BEAMS, Refusals
from rovgraph.sensors.instruments import Instrument
from rovgraph.sensors.sensor import of_instrument
from rovgraph.sensors.water_layer import CELLS

KEPT = 256  # keyframes that are never forgotten, for the noise that they have shown
BUFFER = 64  # rows of an array to begin with
Place = tuple[float, int, int, float]  # time, precedence and number of the sensor, name of what is seen
NEVER: Place = (-math.inf, 0, 0, 0.0)
_BETWEEN = ("motions", "covariances", "weights", "scales", "rows", "row_scales", "windows")  # the keyframes
_FATES = {
    at.EARLY: "before the first IMU sample",
    at.LATE: "after the last IMU sample",
    at.UNFINISHED: "after the last keyframe",
    at.IN_VIEW: "still in view",
}


def assembly_of(
    initial: InitialConditions, time_offsets: TimeOffsets | None = None, learn_noise: bool = False
) -> "Assembly":
    """An empty one for a dive that begins so; attributes as of `Assembly`."""
    bias = initial.prior.state.bias[0]
    return Assembly(initial.config, initial.instruments, bias, initial.beliefs, time_offsets, learn_noise)


class InsertResult(StrEnum):
    """Result of inserting a measurement."""

    IN = "taken"
    LATE = "later than the lag"
    AGAIN = "repeated"


@dataclass
class Assembly:
    """A dive that grows.

    Attributes
    ----------
    config : effective configuration
    instruments : the sensors in use, by stream
    bias : ndarray, shape (6,), for preintegration
    believed : priors of the calibration; None = the configuration's
    assumed : how late stamps are; None = as these have it
    learn_noise : raise the IMU's noise to what its newest samples show, where the whole log is not yet available
    """

    config: Config
    instruments: Mapping[str, Instrument]
    bias: Array
    believed: InitVar[Mapping[str, Belief] | None] = None
    assumed: InitVar[TimeOffsets | None] = None
    learn_noise: bool = False

    def __post_init__(self, believed: Mapping[str, Belief] | None, assumed: TimeOffsets | None) -> None:
        believed = beliefs(self.config) if believed is None else believed
        self.time_offsets = assumed or TimeOffsets.of(believed, self.instruments)
        self.names = tuple(self.instruments)
        self._which = {sensor: k for k, sensor in enumerate(self.names)}
        self._no_imu = has_constant_velocity(self.config)
        dims = [i.model.dim for i in self.instruments.values()]
        self._most = max([MOST, *dims])
        self._acoustics = Acoustics(self.config, self.instruments)
        self._beams = PingsByBeams(self.config, self.instruments)
        self._layers = WaterLayers(self.config, WATER_LAYER in self.instruments)
        # sensors whose measurements are made before they are events, with components, sds, context and name
        self._made = {*self._acoustics.instruments, *self._beams.instruments, WATER_LAYER}
        self._sensors = np.array([self._about(s) for s in self.names], np.int64).reshape(-1, at.ABOUT)
        beside = max(BEAM_WIDTH * bool(self._beams.instruments), LAYER_WIDTH * self._layers.used)
        self._context = WIDTH if self._acoustics.instruments else beside
        self._wide = 2 * self._most + self._context  # components, sds and context of a measurement
        self._rule = self._make_rule(believed)
        self._integration = self._make_integration()
        self._R_sb = mount_matrix(self.config.imu.mount_rpy_deg).T
        self._imu, self._samples = np.empty((BUFFER, 7)), 0
        self._fresh: list[tuple[float, Array]] = []  # samples that have no row yet
        self._listed, self._come = np.empty((BUFFER, at.VALUES + self._wide)), 0
        self._waiting: list[Measurement] = []  # that have no row yet, in their order after all that have
        self._last = NEVER  # place of the last of all
        self._rank = {s: (precedence(s), k) for s, k in self._which.items()}
        self._signals: list[Measurement] = []  # of thrusters
        self._reasons: list[str] = []  # why measurements are refused
        self._steps = np.full(at.PERIODS + 1, math.inf)
        self._periods: list[float] = []
        self._gaps: list[float] = []  # times of samples after gaps, since the newest keyframe
        self._left_out: Counter[tuple[str, str]] = Counter()  # what has been forgotten
        self._no_pieces: list[tuple[int, str]] = []  # keyframe, and why a piece before it has no measurement
        self._order = np.empty(BUFFER, np.int64)
        self._dive = self._room(BUFFER, BUFFER, BUFFER)
        self._ahead = self._room(2, 0, 0)
        self._due = -math.inf  # a keyframe may be past from here on [s]
        self.forgotten = 0  # keyframes
        self.newest = -math.inf  # time of the newest sample [s]

    # what comes

    def take(self, log: Log) -> None:
        """Take a whole log, before anything else.

        Raises
        ------
        InputError : an IMU gap longer than ``imu.max_gap_s``
        """
        streams = {s: x for s, x in log.streams.items() if s in self.instruments and s != "thruster"}
        self._acoustics.take_ship(log.streams)
        imu = log.streams.get("imu")
        if self._no_imu:
            time = ticks(log).time
            self._imu = np.column_stack([time, np.zeros((len(time), 6))])
        elif imu is not None and len(imu):
            self._imu = np.column_stack([imu.time, in_body(imu.data[:, :6], self._R_sb)])
            self._check_gaps(np.diff(imu.time), imu)
        self._samples = len(self._imu) if imu is not None or self._no_imu else 0
        if not self._samples:
            return
        time = self._imu[:, 0]
        self.newest = float(time[-1])
        for period in np.diff(time[: at.PERIODS + 1]).tolist():
            self._take_period(period)
        if "thruster" in self.instruments and "thruster" in log.streams:
            signals = log.streams["thruster"]
            rows = zip(signals.time.tolist(), signals.data, signals.row.tolist(), strict=True)
            self._signals = [Measurement(t, "thruster", values, row) for t, values, row in rows]
        admissible, by_beams = self._beams.of_log(log.streams)
        admissible += self._layers.of_log(log.streams, self._imu[:0] if self._no_imu else self._imu, self._left_out)
        for sensor, stream in streams.items():
            mask = admitted(sensor, stream.data, self.config, self._left_out)
            if sensor == "dvl":
                mask &= ~by_beams
            stream = stream if mask.all() else stream.take(mask)
            if sensor in self._acoustics.instruments:
                stream = self._acoustics.exchanges(stream, self.time_offsets.of_sensor(sensor), self._left_out)
            admissible.append(stream)
        if admissible:
            admissible.sort(key=lambda stream: self._which[stream.sensor])
            self._listed = self._wanted(in_precedence(admissible))
            self._come = len(self._listed)
            self._order, self._last = np.empty(self._come, np.int64), self._place_of(self._come - 1)

    def insert(self, m: Measurement, settled: float = -math.inf) -> InsertResult:
        """Take a measurement, whenever it comes; keyframes that it comes before are unmade.

        Parameters
        ----------
        settled : nothing before that time is taken any more [s]

        Raises
        ------
        InputError : an IMU gap longer than ``imu.max_gap_s``
        """
        if m.time < settled:
            return InsertResult.LATE
        if m.sensor == "imu":
            return InsertResult.IN if self._no_imu else self._insert_sample(m.time, m.values[:6], m.row)
        if m.sensor in SHIP or m.sensor in self._acoustics.instruments:
            return self._insert_acoustic(m, settled)
        if m.sensor in self._acoustics.signals:
            self._acoustics.take_one(m)
        if self._layers.used:
            self._insert_cells(m)
            if m.sensor == CELLS:
                return InsertResult.IN
        if self._beams.instruments and m.sensor in (BEAMS, "dvl"):
            return self._insert_ping(m)
        return self._insert(m)

    def _insert_cells(self, m: Measurement) -> None:
        """Keep a cell of a profile, or what is needed for one; take the profile when something later comes."""
        layers = self._layers
        if layers.waiting and m.time != layers.waiting[0].time:
            cells, layers.waiting = layers.waiting, []
            time, data, row = (np.array([c[k] for c in cells]) for k in (0, 2, 3))
            events = self._events
            upto = int(events[:, at.STAMP].searchsorted(time[0], side="right"))
            back = max(upto - BUFFER, 0)
            while back and not (events[back:upto, at.SENSOR] == self._which[WATER_LAYER]).any():
                back = max(back - (upto - back), 0)
            before = back + np.flatnonzero(events[back:upto, at.SENSOR] == self._which[WATER_LAYER])
            first = float(events[before[-1], -self._context + FIRST_KNOT]) if len(before) else None
            imu = self._table[:0] if self._no_imu else self._table
            made = layers.of(Stream(CELLS, (), time, data, row), imu, first, self._left_out)
            for t, values, line in zip(made.time.tolist(), made.data, made.row.tolist(), strict=True):
                self._insert(Measurement(t, WATER_LAYER, values, line))
        if m.sensor == CELLS:
            layers.waiting.append(m)
        elif m.sensor in layers.signals:
            layers.take_one(m)

    def _insert_ping(self, m: Measurement) -> InsertResult:
        """Take a ping by its beams or by its velocity, never by both."""
        events = self._events
        first, last = events[:, at.STAMP].searchsorted([m.time - ONE_PING_S, m.time + ONE_PING_S])
        here = events[first:last]
        if m.sensor == "dvl":
            self._beams.velocities = True
            if np.isin(here[:, at.SENSOR], [self._which[sensor] for sensor in self._beams.instruments]).any():
                return InsertResult.IN
            return self._insert(m)
        velocity = first + np.flatnonzero(here[:, at.SENSOR] == self._which.get("dvl", -1))
        accepted = bool(len(velocity)) and events[velocity[0], at.FATE] < at.REFUSED
        measured = self._beams.of_one(m, accepted)
        if measured and accepted:
            self._undo(m.time)
            events[velocity[0], at.FATE] = self._refusal(BY_BEAMS)
        results = [self._insert(one) for one in measured]
        return next((result for result in results if result != InsertResult.IN), InsertResult.IN)

    def _insert_acoustic(self, m: Measurement, settled: float) -> InsertResult:
        """Take what the ship or an acoustic system says, and exchanges that it completes."""
        reply = m.sensor in self._acoustics.instruments
        if reply and not admitted(m.sensor, m.values[None], self.config, self._left_out).all():
            return InsertResult.IN
        late = {sensor: self.time_offsets.of_sensor(sensor) for sensor in self._acoustics.instruments}
        results = [
            self._insert(one) if one.time >= settled else InsertResult.LATE
            for one in self._acoustics.insert(m, late, self._left_out)
        ]
        return next((result for result in results if result != InsertResult.IN), InsertResult.IN)

    def _insert(self, m: Measurement) -> InsertResult:
        known = m.sensor in self._which
        if m.sensor == "thruster" and known:
            k = bisect_left(self._signals, m.time, key=_time)
            if k < len(self._signals) and self._signals[k].time == m.time:
                return InsertResult.AGAIN
            self._undo(m.time)
            self._signals.insert(k, m)
        elif known:
            place = m.time, *self._rank[m.sensor], _name(m)
            if place > self._last:
                self._undo(m.time)
                self._waiting.append(m)
                self._last = place
            elif not self._insert_before_others(m, place):
                return InsertResult.AGAIN
            if self._closes(m.sensor):
                self._due = min(self._due, m.time - self.time_offsets.of_sensor(m.sensor))
        if self._no_imu:  # its time advances to it
            self._insert_sample(m.time, np.zeros(6), m.row)
        return InsertResult.IN

    def remove(self, sensor: str, since: float, settled: float) -> None:
        """Take back a sensor's measurements from a time on, but for what is before ``settled`` [s]."""
        events = self._events
        of = [sensor, *self._beams.instruments] if sensor == "dvl" else [sensor]
        wrong = np.isin(events[:, at.SENSOR], [self._which.get(name, -1) for name in of])
        wrong &= events[:, at.STAMP] >= max(since, settled)
        if wrong.any():
            self._undo(float(events[wrong.argmax(), at.STAMP]))
            kept = events[~wrong]
            self._come = len(kept)
            self._listed[: self._come] = kept
            self._last = self._place_of(self._come - 1)
            self._due = -math.inf

    def take_again(self, some: Sequence[Measurement], n: int) -> None:
        """Take all measurements so far of some sensors anew, which make no keyframes; ``n`` are made again."""
        for sensor in {m.sensor for m in some}:
            self.remove(sensor, -math.inf, -math.inf)
        for m in some:
            self.insert(m)
        while len(self) < n and self.extend(one=True):
            pass

    @property
    def acoustics(self) -> Acoustics:
        """What is known of the ship, and of acoustic replies."""
        return self._acoustics

    @property
    def span(self) -> tuple[float, float]:
        """Times of the first and of the newest sample [s]."""
        return float(self._table[0, 0]) if len(self._table) else math.nan, self.newest

    # the keyframes

    def is_due(self, until: float) -> bool:
        """Whether a keyframe may be past by the samples up to a time [s], or some have been unmade."""
        return min(until, self.newest) - self._rule.around >= self._due

    def extend(self, until: float = math.inf, one: bool = False, finish: bool = False) -> int:
        """Make the keyframes that are past by the samples up to a time; how many.

        Parameters
        ----------
        until : the newest sample that may be looked at [s]
        one : those of the first sample by which any is past
        finish : nothing else comes: place what is left, and a last keyframe at the last sample
        """
        if not finish and not self.is_due(until):
            return 0
        table = self._table
        count = len(table) if until >= self.newest else int(table[:, 0].searchsorted(until, side="right"))
        if not len(table):
            return 0
        begin, dive = len(self), self._dive
        start, upto = dive.keyframes[begin - 1, [at.TIME, at.UPTO]].tolist() if begin else (float(table[0, 0]), 0)
        most = begin + len(self._gaps) + int((table[-1, 0] - start) / self._rule.max_gap) + 3
        most += int(dive.counts[at.ORDERED] - upto) + self._count_closing(int(dive.counts[at.READ]))
        if most > len(dive.keyframes):
            self._dive = dive._replace(keyframes=_grown(dive.keyframes, begin, most))
        late = np.array([self.time_offsets.of_sensor(sensor) for sensor in self.names] or [0.0])
        streams = self._streams
        due = at.place_keyframes(streams, late, self._rule, self._dive, count, one, finish)
        made = len(self) - begin
        if made:
            self._assemble(begin, streams)
            start = float(self._dive.keyframes[len(self) - 1, at.TIME])
            self._gaps = [time for time in self._gaps if time > start + at.SHORTEST_S]
        self._due = min(due, *self._gaps, math.inf) - 1e-9
        return made

    def _assemble(self, begin: int, streams: at.Streams) -> None:
        """Fill what lies between the keyframes from ``begin`` on."""
        dive, n = self._dive, len(self)
        pieces = self._pieces(max(begin, 1)) if "thruster" in self.instruments else self._listed[:0]
        first = int(dive.keyframes[begin - 1, at.UPTO]) if begin else 0
        sensors = streams.events[streams.order[first : int(dive.keyframes[n - 1, at.UPTO])], at.SENSOR].astype(np.int64)
        late = int(np.count_nonzero(self._sensors[sensors, at.LAG] >= 0)) if len(self._sensors) else 0
        rows, windows = int(dive.counts[at.ROWS]), int(dive.counts[at.WINDOWS])
        more, scaled = rows + len(sensors) + len(pieces), int(self._rule.scaled)
        if n > len(dive.motions) or more > len(dive.rows) or windows + late >= len(dive.windows):
            self._dive = dive._replace(
                motions=_grown(dive.motions, begin, n),
                covariances=_grown(dive.covariances, begin, n),
                weights=_grown(dive.weights, begin, n),
                scales=_grown(dive.scales, begin * scaled, n * scaled),
                rows=_grown(dive.rows, rows, more),
                row_scales=_grown(dive.row_scales, rows * scaled, more * scaled),
                of=_grown(dive.of, rows, more, axis=1),
                windows=_grown(dive.windows, windows, windows + late + 1),
                names=_grown(dive.names, rows, more),
            )
        at.assemble(streams, pieces, self._rule, self._integration, self._dive, begin)
        if self._layers.used:
            dive, m = self._dive, int(self._dive.counts[at.ROWS])
            layer = self._which[WATER_LAYER]
            put_windows(dive.keyframes[:n], dive.rows[:m], dive.of[:, :m], layer, begin, self._context)

    def truncate(self, n: int) -> None:
        """Unmake the keyframes from ``n`` on; what they were made of is looked at again."""
        dive = self._dive
        counts, last = dive.counts, dive.keyframes[n - 1] if n else np.zeros(at.KEYFRAME)
        upto, streams = int(last[at.UPTO]), self._streams
        again = streams.events[:, at.FATE] < at.REFUSED
        again[self._order[:upto]] = False
        streams.events[again, at.FATE] = at.IN
        counts[at.SAMPLES] = int(last[at.COUNT]) - counts[at.FORGOTTEN] if n else 0
        read = streams.events[:, at.STAMP].searchsorted(self._table[counts[at.SAMPLES] - 1, 0]) if n else 0
        order = self._order[: counts[at.ORDERED]]
        order = order[order < read]
        self._order[: len(order)] = order
        if 0 < n < len(self) and dive.keyframes[n, at.COUNT] == last[at.COUNT]:
            counts[at.SAMPLES] -= 1  # by that sample others are past, too
        counts[at.READ], counts[at.ORDERED], counts[at.KEYFRAMES] = read, len(order), n
        counts[at.ROWS] = int(last[at.TAKEN])
        counts[at.WINDOWS] = dive.of[at.WINDOW_OF, : counts[at.ROWS]].max(initial=-1) + 1
        self._no_pieces = [(k, why) for k, why in self._no_pieces if k < n]
        self._due = -math.inf

    def forget(self, n: int) -> None:
        """Forget the keyframes before ``n``, now and then and but for some, and what they were made of."""
        if min(n, len(self) - KEPT) >= KEPT:
            self._drop(min(n, len(self) - KEPT))

    def _drop(self, n: int) -> None:
        """Forget the keyframes before ``n``."""
        if n == 0:
            return
        dive, counts = self._dive, self._dive.counts
        time = float(dive.keyframes[n, at.TIME]) - self._rule.around - self._rule.every_s
        samples, rows = int(self._table[:, 0].searchsorted(time)), int(dive.keyframes[n - 1, at.TAKEN])
        upto, windows = int(dive.keyframes[n - 1, at.UPTO]), int(dive.of[at.WINDOW_OF, :rows].max(initial=-1)) + 1
        events = self._events
        gone = np.zeros(len(events), bool)
        gone[self._order[:upto]] = True
        gone |= (events[:, at.FATE] >= at.REFUSED) & (events[:, at.STAMP] < time)
        self._left_out += self._counted(gone)
        moved = np.cumsum(~gone) - 1
        order = moved[self._order[upto : counts[at.ORDERED]]]
        counts[at.READ] -= np.count_nonzero(gone[: counts[at.READ]])
        self._listed, self._come = events[~gone], int((~gone).sum())
        self._order = np.append(order, np.empty(self._come - len(order), np.int64))
        self._imu, self._samples = self._table[samples:].copy(), self._samples - samples
        self._left_out += Counter(("thruster", why) for k, why in self._no_pieces if k < n)
        self._no_pieces = [(k - n, why) for k, why in self._no_pieces if k >= n]
        memory = bisect_right(self._signals, time - 10.0, key=_time)
        del self._signals[: max(memory - 1, 0)]
        counts -= [samples, 0, upto, n, rows, windows, -samples]
        scaled = int(self._rule.scaled)
        self._dive = at.DiveArrays(
            dive.keyframes[n:].copy(),
            dive.motions[n:].copy(),
            dive.covariances[n:].copy(),
            dive.weights[n:].copy(),
            dive.scales[n * scaled :].copy(),
            dive.rows[rows:].copy(),
            dive.row_scales[rows * scaled :].copy(),
            dive.of[:, rows:].copy(),
            dive.windows[windows:].copy(),
            dive.names[rows:].copy(),
            counts,
        )
        self._dive.keyframes[:, at.UPTO] -= upto
        self._dive.keyframes[:, at.TAKEN] -= rows
        self._dive.of[[at.KEYFRAME_OF, at.INTERVAL_OF]] -= n
        window_of = self._dive.of[at.WINDOW_OF]
        window_of[window_of >= 0] -= windows
        self.forgotten += n

    def __len__(self) -> int:
        """Count of keyframes."""
        return int(self._dive.counts[at.KEYFRAMES])

    def closed_at(self, k: int) -> float:
        """Time of the sample by which keyframe k was past [s]."""
        return float(self._table[int(self._dive.keyframes[k, at.COUNT] - self._dive.counts[at.FORGOTTEN]) - 1, 0])

    @property
    def problem(self) -> Problem:
        """The keyframes so far; only `truncate` changes what has been written."""
        d, n, m, w = self._dive, len(self), int(self._dive.counts[at.ROWS]), int(self._dive.counts[at.WINDOWS])
        scaled = int(self._rule.scaled)
        return Problem(
            self.names,
            tuple(i.model.dim for i in self.instruments.values()),
            d.keyframes[:n],
            d.motions[1:n],
            d.covariances[1:n],
            d.weights[1:n],
            d.scales[scaled : n * scaled],
            d.rows[:m],
            d.row_scales[: m * scaled],
            d.of[:, :m],
            d.windows[:w],
            d.names[:m],
            {s: lag for s in self.names if (lag := self.time_offsets.lag(s)) is not None},
            self._integration.row[motion_row.BIAS : motion_row.BIAS + 6],
            self._table,
            int(d.counts[at.FORGOTTEN]),
            context=self._context,
        )

    def ahead(self, time: float, x: Array) -> Problem:
        """The newest keyframe and one at a later time, as far as the IMU goes; beyond that, as if it stood still.

        Parameters
        ----------
        time : [s]
        x : ndarray, shape (21,), state vector of the newest keyframe, as of `rovgraph.inference.filter_step.Gaussian`
        """
        table, dive, newest = self._table, self._ahead, self._dive.keyframes[len(self) - 1]
        first = max(int(table[:, 0].searchsorted(newest[at.TIME] - self._rule.around, side="right")) - 1, 0)
        table = table[first : int(table[:, 0].searchsorted(time, side="right"))]
        known = first + int(self._dive.counts[at.FORGOTTEN])
        if time - table[-1, 0] > self._steps[min(known + len(table), len(self._steps)) - 1]:
            at_rest = x[15:].copy()
            at_rest[:3] -= self.config.environment.gravity * x[6:9]
            table = np.vstack([table, np.append(time, at_rest)])
        dive.keyframes[:] = newest
        dive.keyframes[1, [at.TIME, at.COUNT, at.HERE]] = time, known + len(table), 0
        dive.counts[:] = 0
        dive.counts[[at.KEYFRAMES, at.FORGOTTEN]] = 2, known
        streams, rule = self._streams._replace(imu=table), self._rule._replace(learns=0.0)
        at.assemble(streams, self._listed[:0], rule, self._integration, dive, 1)
        motions, covariances, scales = dive.motions[1:], dive.covariances[1:], dive.scales[1:]
        return replace(self.problem, keyframes=dive.keyframes, motions=motions, covariances=covariances, scales=scales)

    # files and twins

    def state(self, n: int, whole: bool = False) -> dict[str, Any]:
        """Where it stood when its first ``n`` keyframes were made, with all that has come since, as plain values.

        What lies between the keyframes is in it only where it is asked for as a ``whole``.
        """
        twin = self._twin()
        twin.truncate(n)
        if not whole:
            twin._drop(max(n - KEPT, 0))
        counts, dive = twin._dive.counts, twin._dive
        return {
            **({name: getattr(dive, name) for name in _BETWEEN} if whole else {}),
            "imu": twin._table,
            "events": twin._events,
            "order": twin._order[: counts[at.ORDERED]],
            "keyframes": twin._dive.keyframes[: len(twin)],
            "times": twin._dive.rows[: counts[at.ROWS], 0],
            "of": twin._dive.of[:, : counts[at.ROWS]],
            "names": twin._dive.names[: counts[at.ROWS]],
            "counts": counts,
            "forgotten": twin.forgotten,
            "sensors": list(self.names),
            "reasons": list(self._reasons),
            "periods": list(self._periods),
            "gaps": list(self._gaps),
            "signals": pack(twin._signals),
            "ship": self._acoustics.state(),
            "waiting": pack(self._acoustics.waiting),
            "beams": [self._beams.velocities, *self._beams.refusals],
            "context": self._context,
            "assumed": self.time_offsets.assumed,
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from where another stood, which may have had fewer sensors."""
        counts, events = np.array(state["counts"], np.int64), np.array(state["events"], float)
        number = np.array([self._which[sensor] for sensor in state["sensors"]], np.int64)
        self._imu, self._samples, self._fresh = np.array(state["imu"], float), len(state["imu"]), []
        self.newest = float(self._imu[-1, 0])
        context = int(state.get("context", 0))
        self._come, most = len(events), (events.shape[1] - at.VALUES - context) // 2
        self._listed, self._waiting = np.zeros((self._come, at.VALUES + self._wide)), []
        ends = at.VALUES + most, at.VALUES + 2 * most
        self._listed[:, : ends[0]] = events[:, : ends[0]]
        self._listed[:, at.VALUES + self._most : at.VALUES + self._most + most] = events[:, ends[0] : ends[1]]
        if context:
            self._listed[:, -context:] = events[:, ends[1] :]
        self._listed[:, at.SENSOR] = number[events[:, at.SENSOR].astype(np.int64)]
        self._last = self._place_of(self._come - 1)
        self._order = np.append(np.array(state["order"], np.int64), np.empty(self._come, np.int64))
        n, m = int(counts[at.KEYFRAMES]), int(counts[at.ROWS])
        self._dive = self._room(n, m, int(counts[at.WINDOWS]))._replace(counts=counts)
        self._dive.keyframes[:], self._dive.names[:] = state["keyframes"], state["names"]
        self._dive.rows[:, 0] = state["times"]
        for name in _BETWEEN if "motions" in state else ():
            here, there = getattr(self._dive, name), state[name]
            part = tuple(slice(min(sizes)) for sizes in zip(here.shape, there.shape, strict=True))
            here[part] = there[part]
        self._dive.of[:] = state["of"]
        self._dive.of[at.WHICH] = number[self._dive.of[at.WHICH]]
        self.forgotten, self._reasons = int(state["forgotten"]), list(state["reasons"])
        self._gaps, self._signals = list(state["gaps"]), unpack(state["signals"])
        if "ship" in state:
            self._acoustics.restore(state["ship"])
            self._acoustics.waiting = unpack(state["waiting"])
        self._beams.velocities, *seen = state.get("beams", (False,))
        self._beams.refusals = Refusals(*seen)
        self._periods, self._steps[:] = [], math.inf
        for period in state["periods"]:
            self._take_period(period)
        self.time_offsets.assumed.update(state["assumed"])
        self._due = -math.inf

    def _twin(self) -> "Assembly":
        """One that goes on by itself from here."""
        table, events, twin = self._table, self._events, copy(self)
        twin._imu, twin._listed, twin._order = table.copy(), events.copy(), self._order.copy()
        twin._fresh, twin._waiting, twin._signals, twin._no_pieces = [], [], self._signals[:], self._no_pieces[:]
        twin._acoustics, twin._beams, twin._layers = self._acoustics.copy(), copy(self._beams), self._layers.copy()
        twin._left_out, twin._dive = self._left_out.copy(), at.DiveArrays._make(array.copy() for array in self._dive)
        return twin

    @property
    def left_out(self) -> Counter[tuple[str, str]]:
        """(sensor, reason) -> count of measurements that never reach the graph; pings by beams do."""
        pieces = Counter(("thruster", why) for _, why in self._no_pieces)
        every = self._left_out + self._counted(np.ones(len(self._events), bool)) + pieces
        return Counter({(sensor, why): count for (sensor, why), count in every.items() if why != BY_BEAMS})

    def _counted(self, some: NDArray[np.bool_]) -> Counter[tuple[str, str]]:
        """Of some of the events, those that are left out."""
        events = self._events[some]
        events = events[events[:, at.FATE] != at.IN][:, [at.SENSOR, at.FATE]].astype(np.int64)
        kinds, counts = np.unique(events, axis=0, return_counts=True) if len(events) else (events, events[:, 0])
        each = zip(kinds.tolist(), counts.tolist(), strict=True)
        return Counter({(self.names[k], self._why(k, fate)): n for (k, fate), n in each})

    def _why(self, sensor: int, fate: int) -> str:
        """Why a measurement of a sensor is left out."""
        if fate == at.BEYOND:
            offset = self.instruments[self.names[sensor]].time_offset
            return f"calibration.{offset} reaches beyond the IMU's samples"
        return _FATES.get(fate) or self._reasons[fate - at.REFUSED]

    # arrays

    @property
    def _table(self) -> Array:
        """The samples, shape (m, 7)."""
        if self._fresh:
            rows = np.empty((len(self._fresh), 7))
            rows[:, 0] = [time for time, _ in self._fresh]
            rows[:, 1:] = in_body(np.array([values for _, values in self._fresh]), self._R_sb)
            self._imu = _grown(self._imu, self._samples, self._samples + len(rows))
            self._imu[self._samples : self._samples + len(rows)] = rows
            self._samples, self._fresh = self._samples + len(rows), []
        return self._imu[: self._samples]

    @property
    def _events(self) -> Array:
        """Events so far, in the order of time, shape (e, VALUES + 2 D + context)."""
        if self._waiting:
            new, begin = self._waiting, self._come
            self._waiting, self._come = [], begin + len(new)
            self._listed = _grown(self._listed, begin, self._come)
            places: dict[str, list[int]] = {}
            for k, m in enumerate(new):
                places.setdefault(m.sensor, []).append(k)
            for sensor, of_sensor in places.items():
                self._listed[begin + np.array(of_sensor)] = self._judged(sensor, [new[k] for k in of_sensor])
        return self._listed[: self._come]

    @property
    def _streams(self) -> at.Streams:
        """What has come, as kernels take it."""
        events = self._events
        self._order = _grown(self._order, int(self._dive.counts[at.ORDERED]), len(events))
        return at.Streams(self._table, events, self._order, self._sensors, self._steps)

    def _room(self, keyframes: int, rows: int, windows: int) -> at.DiveArrays:
        """Room for so many of each, nothing of which is there."""
        scaled, knots = int(self._rule.scaled), self._integration.lags.shape[1]
        return at.DiveArrays(
            np.zeros((keyframes, at.KEYFRAME)),
            np.zeros((keyframes, motion_row.ROW)),
            np.zeros((keyframes, MOTION, MOTION)),
            np.zeros((keyframes, MOTION, MOTION)),
            np.zeros((keyframes * scaled, 6, 6)),
            np.zeros((rows, Z + self._wide)),
            np.zeros((rows * scaled, 6, 6)),
            np.zeros((at.OF, rows), np.int64),
            np.zeros((windows, knots, KNOT)),
            np.zeros(rows),
            np.zeros(7, np.int64),
        )

    def _make_rule(self, believed: Mapping[str, Belief]) -> at.KeyframeRule:
        graph, config = self.config.graph, self.config
        lasting = unknowns(believed, self.instruments).time_constants  # which begin a segment at every keyframe
        return at.KeyframeRule(
            around=HALF_WINDOW_S + self.time_offsets.span,
            max_gap=graph.max_gap_s,
            longest=graph.max_gap_s + graph.ping_due_s,
            min_gap=graph.min_gap_s,
            segment_s=0.0 if lasting else graph.segment_s,
            every_s=config.place.every_s,
            without_imu=float(self._no_imu),
            learns=float(self.learn_noise and not self._no_imu),
            scaled=float(wanted(believed)),
            rate_sd=math.radians(config.motion.rate_sd_dps),
            context=float(self._context),
        )

    def _make_integration(self) -> at.Integration:
        lags = [lag for s in self.names if (lag := self.time_offsets.lag(s)) is not None]
        padded = np.full((len(lags), max(map(len, lags), default=0)), np.nan)
        for row, lag in zip(padded, lags, strict=True):
            row[: len(lag)] = lag
        params = preintegration_params(self.config)
        return at.Integration(params.row(self.bias, 0.0), mount_matrix(self.config.imu.mount_rpy_deg), padded)

    def _closes(self, sensor: str) -> bool:
        """Whether a keyframe stands where a sensor measures."""
        return self._no_imu or sensor in ("dvl", WATER_LAYER) or sensor in self._beams.instruments

    def _about(self, sensor: str) -> list[int]:
        """Parameters of a sensor for the kernels."""
        late = [s for s in self.names if self.time_offsets.lag(s) is not None]
        # the rate reaches these: by a lever arm, or by the motion of a turning body
        turned = self.instruments[sensor].rate_gain.any() or sensor == "thruster"
        numbers = self.instruments[sensor].model.dim, sensor == PLACE, late.index(sensor) if sensor in late else -1
        return [int(self._closes(sensor)), int(SENSORS[sensor].once_per_interval), int(turned), *map(int, numbers)]

    # measurements and samples

    def _insert_before_others(self, m: Measurement, place: Place) -> bool:
        """Insert a measurement in the order of time; False = it is there already."""
        k = len(self._events)
        while k > 0 and self._place_of(k - 1) > place:
            k -= 1
        if k > 0 and self._place_of(k - 1) == place:
            return False
        self._undo(m.time)
        self._listed = events = _grown(self._listed, self._come, self._come + 1)
        events[k + 1 : self._come + 1] = events[k : self._come]
        events[k] = self._judged(m.sensor, [m])[0]
        self._come += 1
        return True

    def _judged(self, sensor: str, some: Sequence[Measurement]) -> Array:
        """Events of a sensor's measurements, with why they are refused, if they are."""
        values = np.array([m.values for m in some])
        out = self._rows_of(sensor, np.array([m.time for m in some]), values, np.array([m.row for m in some]))
        for why, bad in () if sensor in self._made else SENSORS[sensor].refused(values, self.config):  # judged before
            if bad.any():
                out[bad & (out[:, at.FATE] == at.IN), at.FATE] = self._refusal(why)
        return out

    def _refusal(self, why: str) -> int:
        """The fate of what is refused for a reason."""
        if why not in self._reasons:
            self._reasons.append(why)
        return at.REFUSED + self._reasons.index(why)

    def _rows_of(self, sensor: str, time: Array, values: Array, line: NDArray[np.int64]) -> Array:
        """Events of n measurements of a sensor, shape (n, VALUES + 2 D + context)."""
        instrument, registered, D = self.instruments[sensor], SENSORS[sensor], self._most
        out, dim = np.zeros((len(time), at.VALUES + self._wide)), instrument.model.dim
        out[:, at.STAMP], out[:, at.SENSOR], out[:, at.LINE] = time, self._which[sensor], line
        if sensor in self._made:
            out[:, at.VALUES : at.VALUES + dim] = values[:, :dim]
            out[:, at.VALUES + D : at.VALUES + D + dim] = values[:, dim : 2 * dim]
            begin = at.VALUES + 2 * D
            out[:, begin : begin + values.shape[1] - 2 * dim - 1] = values[:, 2 * dim : -1]
            out[:, at.NAME] = values[:, -1]
            return out
        if sensor == PLACE:
            out[:, at.NAME] = values[:, 0]
        else:
            out[:, at.VALUES : at.VALUES + dim] = values[:, :dim]
        sd = instrument.sd
        if registered.standard_deviation is not of_instrument and len(values):
            sd = np.array([registered.standard_deviation(one, instrument, self.config) for one in values])
        out[:, at.VALUES + D : at.VALUES + D + sd.shape[-1]] = sd
        return out

    def _place_of(self, k: int) -> Place:
        """Order of events: by time, and the DVL's before others."""
        if k < 0:
            return NEVER
        stamp, sensor, name = self._listed[k, [at.STAMP, at.SENSOR, at.NAME]].tolist()
        return stamp, precedence(self.names[int(sensor)]), int(sensor), name

    def _insert_sample(self, time: float, values: Array, line: int) -> InsertResult:
        if time > self.newest:
            period = time - self.newest
            if self.newest > -math.inf and not self._no_imu:
                if period > self._steps[len(self._periods)]:  # nothing is carried through a gap
                    self._gaps.append(time)
                    self._due = min(self._due, time)
                if period > self.config.imu.max_gap_s:
                    raise too_long(self.config, period, time, line)
                self._take_period(period)
            self._fresh.append((time, values))
            self.newest = time
            return InsertResult.IN
        k = int(self._table[:, 0].searchsorted(time))
        if self._imu[k, 0] == time:
            return InsertResult.AGAIN
        self._undo(time)
        row = np.append(time, in_body(values, self._R_sb))
        self._imu = np.insert(self._table, k, row, axis=0)
        self._samples += 1
        return InsertResult.IN

    def _undo(self, time: float) -> None:
        """Unmake what has been made of what comes after a time [s]."""
        counts = self._dive.counts
        if counts[at.SAMPLES] and time < self._imu[counts[at.SAMPLES] - 1, 0]:
            n = len(self)
            while n > 0 and self.closed_at(n - 1) > time:
                n -= 1
            self.truncate(n)

    def _take_period(self, period: float) -> None:
        """Find the regular sample interval, beyond which there is a gap, from the first samples."""
        if len(self._periods) < at.PERIODS and not self._no_imu:
            self._periods.append(period)
            self._steps[len(self._periods) :] = GAP_PERIODS * float(np.median(self._periods))

    def _count_closing(self, begin: int) -> int:
        """Events from one on that may make a keyframe."""
        sensors = self._events[begin:, at.SENSOR].astype(np.int64)
        return int(np.count_nonzero(self._sensors[sensors, at.CLOSES])) if len(sensors) else 0

    def _wanted(self, streams: Sequence[Stream]) -> Array:
        """Events of streams in the order of their stamps, without those of which one an interval is taken, where
        surely another one is: between near pings."""
        which, index, stamp = arrivals(streams)
        late = np.array([self.time_offsets.of_sensor(stream.sensor) for stream in streams])
        placed, wanted = stamp - late[which], np.ones(len(stamp), bool)
        graph, time = self.config.graph, self._imu[:, 0]
        if not self._no_imu:
            known = np.minimum(np.arange(1, len(time)), at.PERIODS + 1) - 1
            ends = time[1:][np.diff(time) > self._steps[known]]
            pings = np.isin(which, [k for k, stream in enumerate(streams) if self._closes(stream.sensor)])
            self._gaps = ends.tolist()
            ends = np.sort(np.concatenate([ends, placed[pings]]))
            edges = np.concatenate([[-np.inf], ends, [np.inf]])
            # the keyframe before may stand up to `min_gap_s` before a ping that makes none
            whole = np.diff(edges) > graph.max_gap_s - graph.min_gap_s - at.SHORTEST_S
            whole |= (edges[:-1] < time[0]) | (edges[1:] > time[-1] - at.SHORTEST_S)  # what is left out is counted
            for k, stream in enumerate(streams):
                if SENSORS[stream.sensor].once_per_interval:
                    rows = np.flatnonzero(which == k)
                    before, after = ends.searchsorted(placed[rows]), ends.searchsorted(placed[rows], side="right")
                    first = (np.diff(before, prepend=-1) > 0) | (np.diff(after, prepend=-1) > 0)
                    wanted[rows] = whole[after] | whole[before] | first
        which, index = which[wanted], index[wanted]
        events = np.empty((len(which), at.VALUES + self._wide))
        for k, stream in enumerate(streams):
            rows = which == k
            some = index[rows]
            events[rows] = self._rows_of(stream.sensor, stream.time[some], stream.data[some], stream.row[some])
        return events

    def _pieces(self, begin: int) -> Array:
        """Thruster measurements of the intervals that end with keyframes from ``begin`` on, as events."""
        model = cast(ModelAiding, self.instruments["thruster"].model)
        table, gone, out = self._table, int(self._dive.counts[at.FORGOTTEN]), [self._listed[:0]]
        for k in range(begin, len(self)):
            (start, _), (end, count) = self._dive.keyframes[k - 1 : k + 1, [at.TIME, at.COUNT]].tolist()
            first = max(int(table[:, 0].searchsorted(start - HALF_WINDOW_S, side="right")) - 1, 0)
            last = min(int(table[:, 0].searchsorted(end + self._rule.around)) + 1, int(count) - gone)
            samples = table[first:last]
            if np.diff(samples[:, 0]).max(initial=0.0) > self._steps[min(int(count), len(self._steps)) - 1]:
                continue
            since = bisect_right(self._signals, start - model.memory, key=_time)
            signals = self._signals[max(since - 1, 0) : bisect_right(self._signals, end, key=_time)]
            for piece in thruster_pieces(model, signals, start, end, samples):
                if isinstance(piece, str):
                    self._no_pieces.append((k, piece))
                else:
                    event = self._rows_of("thruster", np.array([piece.time]), piece.values[None], np.array([piece.row]))
                    event[0, [at.PLACED, at.NAME]] = piece.time, k
                    out.append(event)
        return np.vstack(out)

    def _check_gaps(self, periods: Array, imu: Stream) -> None:
        long = np.flatnonzero(periods > self.config.imu.max_gap_s)
        if long.size:
            k = int(long[0])
            raise too_long(self.config, float(periods[k]), float(imu.time[k + 1]), int(imu.row[k + 1]))


def too_long(config: Config, period: float, time: float, row: int) -> InputError:
    """A gap before a sample that cannot be bridged."""
    return InputError(
        f"row {row}: the IMU is silent for {period:.1f} s before {time:.3f} s, longer than "
        f"imu.max_gap_s = {config.imu.max_gap_s:g}; split the log there or raise that key"
    )


def _grown(array: NDArray[Any], used: int, need: int, axis: int = 0) -> Any:
    """An array with room for so many, of which ``used`` are kept."""
    if array.shape[axis] >= need:
        return array
    shape = [*array.shape]
    shape[axis] = max(need, 2 * shape[axis])
    out, kept = np.zeros(shape, array.dtype), (slice(None),) * axis + (slice(used),)
    out[kept] = array[kept]
    return out


def _time(m: Measurement) -> float:
    return m.time


def _name(m: Measurement) -> float:
    """Of a place that is seen, of the other end of an acoustic exchange or of a layer of a profile, else 0."""
    if m.sensor in ACOUSTICS or m.sensor == WATER_LAYER:
        return float(m.values[-1])
    return float(m.values[0]) if m.sensor == PLACE else 0.0
