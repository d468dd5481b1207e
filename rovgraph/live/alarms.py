"""Alarms while a dive goes on: the statistics of `rovgraph.diagnosis`, of the filter's last minute.

They use keyframes that are older than the lag. Rejections and mean squares of innovations are those of the last
minute. The first innovation of each sensor and keyframe enters the statistic of correlated noise: between keyframes
innovations are independent where the filter is right, within one they share the error of its prediction.
"""

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from rovgraph.diagnosis.alarm import Alarm, Statistic, Verdict, verdict_of
from rovgraph.diagnosis.constants import earth_rate_of, moved_constant, sds_moved
from rovgraph.diagnosis.evidence import MINUTE, SensorResiduals
from rovgraph.diagnosis.motion import excluded_interval, separation_of
from rovgraph.diagnosis.residuals import (
    ENOUGH,
    by_far_knots,
    correlated_residuals_in,
    frozen_for,
    is_one_beam,
    rejected_in,
    rejections,
    scatters,
    share_rejected,
    too_large_in,
    too_small_in,
)
from rovgraph.diagnosis.statistics import find_advice, find_alarms
from rovgraph.geometry import Array
from rovgraph.inference.estimate import CalibrationEstimate
from rovgraph.inference.filter import FilterEngine
from rovgraph.inference.filter_step import Gaussian, Met, states_of
from rovgraph.inference.fixed_lag import FilterSnapshot
from rovgraph.inference.gauss_newton import FaultyInterval
from rovgraph.live.reinitialisations import Adopted
from rovgraph.live.sensor_faults import Watch
from rovgraph.live.solution import Event
from rovgraph.model.calibration import LAYOUT, TABLE
from rovgraph.model.state import BIAS, PLACE
from rovgraph.problem.problem import gathered
from rovgraph.rules import RULES, SETTLED_S

EVERY_S = 5.0  # between looks
LASTING_EVERY_S = 20.0  # between looks at what lasts, which cost more
ALLOWED_SDS = 2.0  # by which what is considered may be off: one constant moves all innovations
OVER_S = 30.0  # within its limits, after which an alarm is over


@dataclass
class _Count:
    """Of one sensor in the time between two looks."""

    share: Array  # of its first innovation's variance, what is considered at `ALLOWED_SDS`, in units of the rest
    used: int = 0
    out: list[bool] = field(default_factory=list)  # of each, whether it was rejected
    nis: float = 0.0  # sum of those that were used
    keyframe: int = -1  # newest


@dataclass
class _Raised:
    """An alarm that has begun, and when it was beyond its limit last [s]."""

    alarm: Alarm
    last: float


@dataclass
class LiveAlarms:
    """Reports once that an alarm begins, or becomes worse, and once that it is over.

    One that comes and goes is in the verdict while it is there, and is reported again only if it is worse than it was.

    Attributes
    ----------
    events : since it was last emptied
    history : every alarm of the run as it was at its worst, those by the smoothed dive as they were last, in the order
        in which they began
    advice : what could be stated better, by kind and sensor, as it was first; no evidence of error
    """

    events: list[Event] = field(default_factory=list)
    history: dict[tuple[str, str, float], Alarm] = field(default_factory=dict)
    advice: dict[tuple[str, str], Alarm] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._start = self._due = self._due_lasting = np.nan
        self._counts: deque[dict[str, _Count]] = deque([{}], maxlen=round(MINUTE / EVERY_S))
        self._samples: dict[str, list[tuple[Met, int, Array]]] = {}  # one of those met, with the share of its count
        self._pieces: deque[dict[str, SensorResiduals]] = deque(maxlen=round(MINUTE / LASTING_EVERY_S))
        self._work: Iterator[list[Statistic]] = iter(())  # looks at the residuals, of one sensor at each keyframe
        self._lasting: list[Statistic] = []
        self._told: list[tuple[float, Statistic]] = []
        self._shown: list[Statistic] = []  # by the smoothed dive, at the newest re-initialisation
        self._raised: dict[tuple[str, str], _Raised] = {}
        self._looks: dict[tuple[str, str], int] = {}  # in a row, in which an alarm was there
        self._said: dict[tuple[str, str], set[str]] = {}  # of each alarm: severities, and that it is over

    @property
    def active(self) -> tuple[Alarm, ...]:
        """Alarms that are not over."""
        return tuple(raised.alarm for raised in self._raised.values())

    @property
    def verdict(self) -> Verdict:
        """Of the estimate now."""
        return verdict_of(self.active)

    def passed(self, snapshot: FilterSnapshot, engine: FilterEngine, watches: Mapping[str, Watch], now: float) -> None:
        """Take a keyframe that the lag has passed.

        Parameters
        ----------
        snapshot : the keyframe
        engine : the filter that made it
        watches : of the sensors, by name
        now : the estimate's time, that of events [s]
        """
        time, index = snapshot.time, snapshot.index
        if np.isnan(self._start):
            self._start = time
            self._due, self._due_lasting = (
                time + SETTLED_S + EVERY_S,
                time + RULES["lasting"].from_s + LASTING_EVERY_S,
            )
        if time < self._start + SETTLED_S:
            return
        counts = self._counts[-1]
        met = snapshot.met
        for k, (sensor, nis, weight) in enumerate(zip(met.sensors, met.nis.tolist(), met.weight.tolist(), strict=True)):
            count = counts.get(sensor)
            if count is None:
                share = ALLOWED_SDS**2 * engine.considered_share(snapshot.known, met.problem, met.begin + k)
                count = counts[sensor] = _Count(share)
            count.out.append(weight <= 0.0)
            if weight > 0.0:
                count.used += 1
                count.nis += nis
            if count.keyframe != index and time >= self._start + RULES["lasting"].from_s:
                count.keyframe = index
                self._samples.setdefault(sensor, []).append((met, k, count.share))
        if time >= self._due_lasting:
            self._due_lasting += LASTING_EVERY_S * np.ceil((time - self._due_lasting + 1e-6) / LASTING_EVERY_S)
            for found in self._work:  # that few keyframes have left
                self._lasting = found
            self._work = self._look_at_lasting(engine, time, self._samples)
            self._samples = {}
        self._lasting = next(self._work, self._lasting)
        if time >= self._due:
            self._due += EVERY_S * np.ceil((time - self._due + 1e-6) / EVERY_S)
            shown, config = self._statistics(snapshot.known, engine, watches, time), engine.initial.config
            self._look([by_far_knots(one, config, {}) for one in shown], now)
            self._counts.append({})

    def reinitialised(self, adopted: Adopted) -> None:
        """The filter continues from the smoothed dive so far."""
        time = float(adopted.smoothed.time[-1])
        if not np.isnan(self._start):
            self._told += [(time, one) for one in separation_of(adopted.smoothed, adopted.filtered, self._start)]
        self._shown = adopted.shown

    def forget_smoothed(self) -> None:
        """Another filter continues: the smoothed dive's findings do not hold for its sensors and priors."""
        self._shown = []

    def taken_out(self, stretch: FaultyInterval) -> None:
        """A sensor is left out for some time."""
        if not np.isnan(self._start):
            self._told.append((stretch.end, excluded_interval(stretch, self._start)))

    def _statistics(
        self, known: Gaussian, engine: FilterEngine, watches: Mapping[str, Watch], time: float
    ) -> Iterator[Statistic]:
        begin = max(self._start, time - MINUTE)
        sensors = dict.fromkeys(name for counts in self._counts for name in counts)
        met = {name: [counts[name] for counts in self._counts if name in counts] for name in sensors}
        outs = {name: np.concatenate([np.array(c.out, bool) for c in of]) for name, of in met.items()}
        shares = {name: float(out.mean()) for name, out in outs.items() if len(out)}
        for sensor, of in met.items():
            used, out = sum(c.used for c in of), outs[sensor]
            if out.any():
                scattering = scatters(sensor, engine.initial.config)
                counted = rejections(out, np.zeros(len(out), np.int64), scattering)
                share = float(share_rejected(counted, np.array([len(out)]))[0])
                yield rejected_in(sensor, begin, time, share, self._start, is_one_beam(sensor, shares))
            if used >= ENOUGH:
                dim = engine.initial.instruments[sensor].model.dim
                square, share = sum(c.nis for c in of) / (used * dim), float(np.mean([c.share for c in of]))
                yield too_large_in(sensor, begin, time, square / (1.0 + share), used * dim, self._start)
                yield too_small_in(sensor, begin, time, square)
        yield from self._constants(known, engine, time)
        for sensor, watch in watches.items():
            if watch.state == "frozen":
                yield frozen_for(sensor, watch.since, watch.time, watch.time - watch.since, 1, self._start)
        yield from self._lasting
        self._told = [(when, one) for when, one in self._told if time - when < MINUTE]
        yield from (one for _, one in self._told)
        yield from self._shown

    def _constants(self, known: Gaussian, engine: FilterEngine, time: float) -> Iterator[Statistic]:
        """Of the calibration that is estimated, and of the gyro's bias."""
        sd, columns = np.sqrt(np.diagonal(known.covariance)), engine.layout.columns
        for name in engine.unknowns.estimated:
            belief, variable = engine.beliefs[name], TABLE[name]
            values, value_sd, prior_sd = known.c[LAYOUT[name]], sd[columns[name]], np.full(variable.dim, belief.sd)
            for k in np.flatnonzero(sds_moved(values, value_sd, belief.mean, prior_sd) > RULES["moved"].doubtful):
                numbers = float(values[k]), float(value_sd[k]), float(belief.mean[k]), belief.sd
                estimate = CalibrationEstimate(variable.labels[k], variable.unit, variable.about, True, *numbers)
                yield from moved_constant(estimate, self._start, time)
        if not engine.initial.config.environment.earth_rotation:
            yield earth_rate_of(float(sd[columns[BIAS]][3:].min()), self._start, time)

    def _look_at_lasting(
        self, engine: FilterEngine, time: float, samples: dict[str, list[tuple[Met, int, Array]]]
    ) -> Iterator[list[Statistic]]:
        """Statistics of the last minute's residuals, one sensor a step: until the last item the previous ones."""
        self._pieces.append({})
        begin, found = self._due_lasting - LASTING_EVERY_S * (1 + len(self._pieces)), list[Statistic]()
        for sensor in [sensor for sensor in samples if sensor != PLACE]:
            self._pieces[-1][sensor] = _innovations(engine, sensor, samples[sensor])
            of_sensor = [piece[sensor] for piece in self._pieces if sensor in piece]
            names = "time", "normalised", "weight", "shared"
            arrays = (np.concatenate([getattr(one, name) for one in of_sensor]) for name in names)
            found += correlated_residuals_in(
                SensorResiduals(sensor, of_sensor[0].components, *arrays), begin, time, self._start
            )
            yield self._lasting
        yield found

    def _look(self, statistics: list[Statistic], time: float) -> None:
        """Begin and end alarms."""
        found = {(alarm.kind, alarm.sensor): alarm for alarm in find_alarms(statistics, self._start)}
        self._looks = {key: self._looks.get(key, 0) + 1 for key in found}
        for key, alarm in found.items():
            raised = self._raised.get(key)
            if raised is None and self._looks[key] < RULES[alarm.kind].looks:
                continue
            if raised is None or (alarm.severity == "wrong" and raised.alarm.severity != "wrong"):
                begin = time if raised is None else raised.alarm.begin
                alarm = replace(alarm, begin=begin, end=time)
                self._raised[key] = _Raised(alarm, time)
                self._say_once(key, time, alarm.severity, alarm.text)
            else:
                raised.last, raised.alarm = time, self._renewed(raised.alarm, alarm, time)
            self.history[(*key, self._raised[key].alarm.begin)] = self._raised[key].alarm
        for one in find_advice(statistics):
            if (one.kind, one.sensor) not in self.advice:
                self.advice[one.kind, one.sensor] = one
                self._say(time, one.sensor, "advice", one.text)
        for key, raised in list(self._raised.items()):
            if time - raised.last >= OVER_S:
                del self._raised[key]
                self._say_once(key, time, "over", f"{key[1]}: {key[0]}: within its limits for {OVER_S:g} s")

    def _renewed(self, before: Alarm, now: Alarm, time: float) -> Alarm:
        """An alarm that lasts: as it was at its worst, or with the figures that the smoothed dive has now."""
        if now.kind in ("held", "unstated"):
            if now.text != before.text:
                self._say(time, now.sensor, now.severity, now.text)
        elif now.figure <= before.figure or now.severity != before.severity:
            now = before
        return replace(now, begin=before.begin, end=time)

    def _say_once(self, key: tuple[str, str], time: float, kind: str, text: str) -> None:
        said = self._said.setdefault(key, set())
        if kind not in said:
            said.add(kind)
            self._say(time, key[1], kind, text)

    def _say(self, time: float, sensor: str, kind: str, text: str) -> None:
        self.events.append(Event(time, sensor, kind, text))


def _innovations(engine: FilterEngine, sensor: str, samples: list[tuple[Met, int, Array]]) -> SensorResiduals:
    """Innovations in units of their sd: along those in units of the noise, and as long as the NIS."""
    problem = gathered([(met.problem, met.begin + k) for met, k, _ in samples])
    block = engine.measurements(problem, np.arange(len(samples)))
    x, c, nis, weight = (
        np.array([getattr(met, name)[k] for met, k, _ in samples]) for name in ("x", "c", "nis", "weight")
    )
    r = block.normalised(states_of(x, c))
    r *= np.sqrt(nis)[:, None] / np.maximum(np.linalg.norm(r, axis=1, keepdims=True), 1e-12)
    shared = np.array([share for _, _, share in samples])
    return SensorResiduals(sensor, tuple(block.instrument.components), block.time, r, weight, shared)
