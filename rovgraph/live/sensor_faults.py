"""Detects sensors that freeze, lose lock, contradict each other or stop sending, while a dive goes on.

`Faults` screens readings by the rules of a log (`rovgraph.log.frozen`), against earlier ones: exact zeros although
those before were too far from zero for the vehicle to have come there, and values that are held while it moves. They
are left out once the limits are passed, and the ones that were used are removed. Equal values that a working DVL or IMU
never gives are held back until then. Readings that disagree with the estimate are left to the filter's gates.

`Crosscheck` compares the motion of the last minutes between sensors: which stamps are late, and which axes or heading
are wrong. It repeats the comparisons of `rovgraph check`: acceleration by DVL and IMU, turning by compasses and gyro,
the DVL's displacement and fixes, its vertical velocity and depth; of acoustic positions the lag alone. A finding of
some windows in a row is reported, and again after half an hour if it lasts, with its figures at that time.

`Health` is the state of each sensor, by the filter's innovations.

`Incoherence` finds a DVL that contradicts the estimate again and again: a false lock, or water for the bottom. The
filter readmits a sensor after its `readmit_s`, and moves to the sensor's value: right after a knock, wrong where the
DVL has locked onto something else. A knock is over after one such return. A DVL that is rejected repeatedly is left out
from its first rejection on, and again at once if it is rejected soon afterwards: the filter goes back to the keyframe
before and processes all other measurements since again. Its uncertainty is then that of the IMU without a DVL. A DVL
that was never coherent is probably misconfigured, not broken: it stays in use, and alarms report it.
"""

import math
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from operator import attrgetter
from typing import Any

import numpy as np

from rovgraph.diagnosis.check.acoustics import latency
from rovgraph.diagnosis.check.agreement import headings, vertical
from rovgraph.diagnosis.check.dvl import dvl_and_imu
from rovgraph.diagnosis.check.findings import Finding
from rovgraph.diagnosis.check.fixes import track
from rovgraph.diagnosis.check.water import profiles
from rovgraph.geometry import Array
from rovgraph.inference.fixed_lag import FilterSnapshot, FixedLag
from rovgraph.inference.gauss_newton import FaultyInterval
from rovgraph.live.solution import Event, SensorHealth
from rovgraph.log import Log, Measurement, Stream, gathered
from rovgraph.log.frozen import HOLDS, Company, Hold, Runs, companies, held, is_false_zero
from rovgraph.log.streams import joined
from rovgraph.model.calibration import WATER_LAYER
from rovgraph.model.config import Config, mount_matrix
from rovgraph.rules import RULES, SILENT_PERIODS, SILENT_S
from rovgraph.sensors.dvl_beam import BEAMS
from rovgraph.sensors.instruments import HEADING_STREAMS, heading_sources
from rovgraph.sensors.water_layer import CELLS

SILENT_AT_FIRST_S = 10.0  # after a first measurement, as long as the period is not known
SELDOM_AT_FIRST_S = {"fix": 30.0}  # of sensors that measure less often
TELL_S = 2.0  # a ping without bottom lock is not worth an event, nor is a zero
OFTEN, OFTEN_S = 10, 60.0  # so many times zeros in such a time are
WAIT = {"imu": 20, "dvl": 3}  # equal measurements running that no working sensor gives, from which on they wait
RECENT_VALUES = 100  # different ones of a sensor, for its state
AROUND_S = 30.0  # for which the IMU and the DVL are kept, which show motion
ASK_EVERY_S = 1.0  # whether values are held, while they are
TURNS, TURNS_EVERY_S = 1000, 1.0  # rates of turn whose median is the gyro's bias
OCCASIONAL = {"place"}  # sensors that measure only when there is something to see


@dataclass(frozen=True)
class Screening:
    """Decision on a measurement.

    Attributes
    ----------
    use : give it to the estimator
    retract_since : take back the sensor's measurements from then on [s], as they wait or are invalid, or None
    reason : why it is not used; empty = the sensor's state shows it
    count : measurements that are left out by this, those taken back too; none while they wait
    late : measurements before it that waited, and are to be used after all
    """

    use: bool = True
    retract_since: float | None = None
    reason: str = ""
    count: int = 1
    late: tuple[Measurement, ...] = ()


_GOOD = Screening()
_time = attrgetter("time")


@dataclass
class Watch:
    """Recent measurements and state of one sensor.

    Attributes
    ----------
    state : "ok", "silent", "frozen", "no lock"
    entered : when it came into that state [s]
    reported : the state that an event has reported, if it is not "ok"
    time, heard : of its newest measurement, and what time it was when it came [s]
    """

    state: str = "ok"
    entered: float = 0.0
    reported: str = ""
    time: float = -np.inf
    heard: float = -np.inf
    period: float = 0.0
    values: bytes = b""  # those that may be held
    since: float = 0.0  # of the first of equal values,
    until: float = 0.0  # and of the last [s]
    equal: int = 0
    runs: deque[tuple[Array, int, float, float]] = field(default_factory=lambda: deque(maxlen=RECENT_VALUES))  # before
    held: bool = False  # the equal values are invalid
    asked: float = -np.inf  # when that was looked at, in this run
    waits: bool = False  # the equal values wait until that is known
    same: list[Measurement] = field(default_factory=list)  # those of a sensor that may wait
    by_hand: bool = False  # no sensor has measured yet: nothing is late
    known: deque[tuple[float, Array]] = field(default_factory=lambda: deque(maxlen=RECENT_VALUES))  # not zero
    zero: bool = False  # the newest is an invalid exact zero
    zeros: deque[float] = field(default_factory=lambda: deque(maxlen=OFTEN))  # when such began [s]
    told: bool = False  # that they come often

    def run(self) -> tuple[Array, int, float, float]:
        """The equal values, their count, and the times of the first and the last of them [s]."""
        return np.frombuffer(self.values), self.equal, self.since, self.until

    def release(self) -> tuple[Measurement, ...]:
        """The waiting measurements, which no longer wait."""
        waiting = tuple(self.same) if self.waits else ()
        self.waits, self.same = False, []
        return waiting


def runs_of(several: Iterable[tuple[Array, int, float, float]]) -> Runs:
    """Runs of equal values of a sensor."""
    values, count, first, last = zip(*several, strict=True)
    return Runs(np.array(values), np.array(count), np.array(first), np.array(last))


@dataclass
class Faults:
    """Looks at every measurement before the estimator does.

    Attributes
    ----------
    config : for mountings and sds
    watches : by sensor
    events : since it was last emptied
    """

    config: Config = field(default_factory=Config)
    watches: dict[str, Watch] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)
    _now: float = -np.inf
    _around: dict[str, deque[Measurement]] = field(default_factory=lambda: {"imu": deque(), "dvl": deque()})
    _turns: deque[tuple[float, Array]] = field(default_factory=lambda: deque(maxlen=TURNS))  # time, rates
    _invalid_ping: float = -np.inf  # time of the newest one [s]

    def __post_init__(self) -> None:
        self._companies: Mapping[str, Company] = companies(self.config)
        self._yaw_axis = mount_matrix(self.config.imu.mount_rpy_deg)[2]

    def look(self, m: Measurement) -> Screening:
        """Whether a measurement is valid; the beams of an invalid ping are not."""
        if m.sensor == BEAMS and m.time == self._invalid_ping:
            return Screening(False, count=0)
        verdict = self._look(m)
        if m.sensor == "dvl" and not verdict.use and m.values[3] != 0.0:  # one without lock may have beams
            self._invalid_ping = m.time
        return verdict

    def _look(self, m: Measurement) -> Screening:
        """Whether a measurement is one, by itself."""
        watch = self.watches.get(m.sensor)
        if watch is None or watch.by_hand:
            watch = self.watches[m.sensor] = Watch()
        self._note(m, watch)
        if m.sensor == "dvl" and m.values[3] == 0.0:
            return self._verdict(m, watch, "no lock", "no bottom lock")
        company = self._companies.get(m.sensor)
        if company is not None and self._is_false_zero(m, watch, company):
            return self._left_zero(m, watch)
        if (hold := HOLDS.get(m.sensor)) is None:
            return self._verdict(m, watch, "ok", "")
        late = self._note_values(m, watch, hold)
        if watch.equal == 1 and watch.state == "ok" and not watch.reported:
            return Screening(late=late) if late else _GOOD
        frozen, waited = self._are_held(m, watch, hold), watch.waits
        if not frozen and self._waits(m, watch):
            return Screening(False, None if waited else watch.since, count=0)
        late += watch.release() if waited else ()
        verdict = self._verdict(m, watch, "frozen" if frozen else "ok", "the same values again and again")
        if not frozen:
            return replace(verdict, late=late)
        if verdict.retract_since is None:
            return verdict
        since = math.nextafter(watch.since, math.inf) if hold.right else watch.since
        return replace(verdict, retract_since=None if waited else since, count=watch.equal - hold.right)

    def _note(self, m: Measurement, watch: Watch) -> None:
        """Store when it was measured, and the values that show the vehicle's motion."""
        if watch.time > -np.inf:
            step = m.time - watch.time
            watch.period = step if not watch.period else watch.period + 0.05 * (step - watch.period)
        if m.time > self._now:
            self._now = m.time
        if m.time > watch.time:
            watch.time = m.time
        watch.heard = self._now
        around = self._around.get(m.sensor)
        if around is None:
            return
        around.append(m)
        while around[0].time < m.time - AROUND_S:
            around.popleft()
        if m.sensor == "imu" and (not self._turns or m.time > self._turns[-1][0] + TURNS_EVERY_S):
            self._turns.append((m.time, m.values[3:6]))

    def _note_values(self, m: Measurement, watch: Watch, hold: Hold) -> tuple[Measurement, ...]:
        """Remember how often its values came in a row; others of its sensor that have waited for that to end."""
        values = m.values[: hold.columns].tobytes()
        if values == watch.values:
            watch.equal += 1
            watch.until = m.time
            if watch.waits or watch.equal <= WAIT.get(m.sensor, 0):
                watch.same.append(m)
            return ()
        if watch.equal and m.sensor != "imu":
            watch.runs.append(watch.run())
        watch.values, watch.equal, watch.since, watch.until = values, 1, m.time, m.time
        watch.held, watch.asked, late = False, -np.inf, watch.release()
        if m.sensor in WAIT:
            watch.same.append(m)
        return late

    def _are_held(self, m: Measurement, watch: Watch, hold: Hold) -> bool:
        """Whether equal values are invalid by the rules of a log, from earlier values."""
        if watch.held or watch.equal < hold.repeats or m.time - watch.since < hold.seconds:
            return watch.held
        if m.sensor == "imu":
            watch.held = True
        elif m.time > watch.asked + ASK_EVERY_S:
            watch.asked = m.time
            runs = runs_of([*watch.runs, watch.run()])
            if runs.are_long(hold)[-1]:
                turning = float(np.median([rates @ self._yaw_axis for _, rates in self._turns] or [0.0]))
                around = gathered(sorted(chain(*self._around.values()), key=_time), "live")
                found = held(m.sensor, runs, around, self.config, turning)
                watch.held = any(k == len(runs.count) - 1 for k, _ in found)
        return watch.held

    def _waits(self, m: Measurement, watch: Watch) -> bool:
        """Whether it waits until it is known whether its values are held."""
        if not watch.waits and watch.equal == WAIT.get(m.sensor) and watch.state == "ok":
            usual = float(np.median([run[1] for run in watch.runs])) if watch.runs else 1.0
            watch.waits = usual <= 1.0 and (m.sensor == "imu" or bool(m.values[:3].any()))
        return watch.waits and watch.asked == -np.inf

    def state(self) -> dict[str, dict[str, Any]]:
        """State of sensors whose values may be held, as plain values and arrays."""
        return {
            sensor: {
                "held": watch.held,
                "runs": np.array([[count, first, last, *values] for values, count, first, last in runs]),
            }
            for sensor, watch in self.watches.items()
            if (runs := [*watch.runs, watch.run()] if watch.values else [])
        }

    def restore(self, state: Mapping[str, Mapping[str, Any]]) -> None:
        """Continue from the state of another."""
        for sensor, known in state.items():
            runs = [(row[3:], int(row[0]), float(row[1]), float(row[2])) for row in np.asarray(known["runs"])]
            values, equal, since, until = runs.pop()
            watch = Watch(time=until, heard=until, values=values.tobytes(), equal=equal, since=since, until=until)
            watch.held = known["held"]
            watch.runs.extend(runs)
            self.watches[sensor] = watch

    def accept(self, m: Measurement) -> Screening:
        """Take a measurement that a person gives, as it is; it does not count for a sensor of the same kind."""
        watch = self.watches.setdefault(m.sensor, Watch(by_hand=True))
        if watch.by_hand:
            watch.time = max(m.time, watch.time)
        return _GOOD

    def tick(self, time: float) -> None:
        """Note sensors that have been silent for too long."""
        for sensor, watch in self.watches.items():
            if sensor in OCCASIONAL or watch.by_hand:
                continue
            quiet = time - watch.heard  # what comes late all the time is not silent
            at_first = SELDOM_AT_FIRST_S.get(sensor, SILENT_AT_FIRST_S)
            longest = max(SILENT_S, SILENT_PERIODS * watch.period) if watch.period else at_first
            if watch.state != "silent" and quiet > longest:
                watch.state = watch.reported = "silent"
                self.events.append(Event(time, sensor, "silent", f"{sensor}: nothing for {quiet:.1f} s"))

    def _is_false_zero(self, m: Measurement, watch: Watch, company: Company) -> bool:
        """Whether a measurement is an invalid exact zero; other values are stored."""
        values = m.values[: company.columns]
        if values.any():
            watch.zero = False
            if np.isfinite(values).all():
                watch.known.append((m.time, values))
        elif not watch.zero and watch.known:
            time, known = zip(*watch.known, strict=True)
            watch.zero = is_false_zero(company, m.time, np.array(time), np.array(known))
            if watch.zero:
                watch.zeros.append(m.time)
        return watch.zero

    def _left_zero(self, m: Measurement, watch: Watch) -> Screening:
        """What to do with such a zero, and an event where they last, or come again and again."""
        state = "no lock" if m.sensor == "dvl" else "frozen"
        self._verdict(m, watch, state, "exactly zero although it moves", at_once=False)
        often = len(watch.zeros) == OFTEN and m.time - watch.zeros[0] < OFTEN_S
        if often and not watch.told and not watch.reported:
            watch.told = True
            text = f"{m.sensor}: exactly zero again and again although it moves; these are left out"
            self.events.append(Event(m.time, m.sensor, state, text))
        return Screening(False, reason="exactly zero")

    def _verdict(self, m: Measurement, watch: Watch, state: str, text: str, at_once: bool = True) -> Screening:
        before, watch.state = watch.state, state
        if before != state:
            watch.entered = m.time
        if state == "ok":
            if watch.reported:
                self.events.append(Event(m.time, m.sensor, "back", f"{m.sensor}: measures again"))
            watch.reported = ""
            return _GOOD
        at_once &= state == "frozen"
        if watch.reported != state and (at_once or m.time - watch.entered >= TELL_S):
            watch.reported = state
            self.events.append(Event(m.time, m.sensor, state, f"{m.sensor}: {text}; left out"))
        return Screening(False, watch.since if at_once and before != state else None)


WINDOW_S = 300.0  # of motion that is compared
EVERY_S = (20.0, 120.0)  # between comparisons: a quarter of the window's motion, within these
AGAIN_S = 1800.0  # after which a lasting finding is reported again
STEP_S = 0.01  # samples of the IMU that come faster are averaged over so long: the comparisons need no more
CHECKS: tuple[Callable[[Log, Config], Iterator[Finding]], ...] = (
    dvl_and_imu,
    headings,
    vertical,
    profiles,
    track,
    latency,
)


@dataclass
class Crosscheck:
    """Compares sensors by the motion that they show.

    Attributes
    ----------
    config : what is believed of mountings and of stamps that are known to be late
    late : how late stamps of a sensor are, and the sd [s], where it was said
    dvl_contradicted : the IMU's acceleration contradicts the DVL's axes or clock in the newest window
    """

    config: Config
    dvl_contradicted: bool = False
    late: dict[str, tuple[float, float]] = field(default_factory=dict)
    _window: dict[str, Stream] = field(default_factory=dict)
    _newest: list[Measurement] = field(default_factory=list)  # since the last comparison
    _samples: list[Measurement] = field(default_factory=list)  # of the IMU, still to be averaged
    _next: float = math.inf
    _work: Iterator[list[Event]] = field(default_factory=lambda: iter(()))  # left to compare, a part with each sample
    _suspected: dict[tuple[str, str], int] = field(default_factory=dict)  # in how many windows in a row
    _said: dict[tuple[str, str], float] = field(default_factory=dict)  # when [s]

    def add(self, m: Measurement) -> list[Event]:
        """Take a measurement; returns new findings of late or wrong sensors, with the correcting configuration."""
        if m.sensor != "imu":
            self._newest.append(m)
            return []
        self._samples.append(m)
        if m.time - self._samples[0].time < STEP_S:
            return []
        self._average()
        if self._next == math.inf:
            self._next = m.time + RULES["check"].from_s
        if m.time >= self._next:
            left = [*chain.from_iterable(self._work)]  # where the IMU was silent
            self._take_newest(m.time - WINDOW_S)
            span = m.time - min(float(stream.time[0]) for stream in self._window.values())
            self._next, self._work = m.time + min(max(0.25 * span, EVERY_S[0]), EVERY_S[1]), self._compared()
            return left
        return next(self._work, [])

    def finish(self) -> list[Event]:
        """No more measurements: the findings that `add` has not reported yet."""
        events = [*chain.from_iterable(self._work)]
        self._take_newest(-math.inf)
        return events + ([*chain.from_iterable(self._compared())] if self._suspected else [])

    def _average(self) -> None:
        """One sample of the IMU instead of some."""
        some, self._samples = self._samples, []
        first, *rest = some
        time = sum((m.time for m in rest), first.time) / len(some)
        values = sum((m.values for m in rest), first.values) / len(some)
        self._newest.append(Measurement(time, "imu", values, first.row))

    def _take_newest(self, since: float) -> None:
        """Put the newest measurements into the window, in order, and forget those before a time [s]."""
        newest, self._newest = gathered(self._newest, "the newest").streams, []
        for sensor in {**self._window, **newest}:
            both = joined([streams[sensor] for streams in (self._window, newest) if sensor in streams])
            if len(recent := both.take(both.time >= since)):
                self._window[sensor] = recent
            else:
                self._window.pop(sensor, None)

    def _compared(self) -> Iterator[list[Event]]:
        """Compare the window, one check after the other, and report the findings at the end."""
        log = Log("the last minutes", self._window, None)
        now = float(log["imu"].time[-1])
        start = min(float(stream.time[0]) for stream in log.streams.values())
        used, found = heading_sources(self.config, log.sensors), dict[tuple[str, str], Finding]()
        contradicted, events = False, list[Event]()
        for check in CHECKS:
            for f in check(log, self.config):
                contradicted |= check is dvl_and_imu and f.level != "ok"
                # scales by `vertical` hold for whole dives: in a short window slow pings of waves have another
                whole = check is not vertical and (f.sensor in used or f.sensor not in HEADING_STREAMS)
                if f.level != "ok" and (f.of_clock or whole):
                    found.setdefault((f.sensor, f.kind if f.of_clock else check.__name__), f)
            yield []
        self.dvl_contradicted = contradicted
        if any(f.kind == "jump" for f in found.values()):  # a lag before and after is the mean of two
            found = {key: f for key, f in found.items() if f.kind == "jump"}
        late = {f.sensor for f in found.values() if f.of_clock}  # which explains what else disagrees
        found = {key: f for key, f in found.items() if f.of_clock or f.sensor not in late}
        suspected = {key: self._suspected.get(key, 0) + 1 for key in found}
        for key, finding in found.items():
            kind = "clock" if finding.of_clock else "check"
            if suspected[key] >= RULES[kind].looks and now - self._said.get(key, -math.inf) > AGAIN_S:
                self._said[key] = now
                zero = f"; 0 s is {start:.1f} s" if finding.kind == "jump" else ""
                events.append(Event(now, finding.sensor, kind, f"{finding.text}{zero}"))
                self.late |= {} if finding.lag is None else {finding.sensor: finding.lag}
        self._suspected = suspected
        yield events


REJECTED_S = 1.0  # after which a sensor is reported as rejected


@dataclass
class Health:
    """Counts and events of what was used and what was kept out.

    Attributes
    ----------
    events : since it was last emptied
    used, rejected : counts of measurements, by sensor, of keyframes that the lag has passed
    """

    events: list[Event] = field(default_factory=list)
    used: Counter[str] = field(default_factory=Counter)
    rejected: Counter[str] = field(default_factory=Counter)
    _out: set[str] = field(default_factory=set)
    _gap_until: float = -float("inf")

    def passed(self, snapshot: FilterSnapshot) -> None:
        """Count a keyframe's measurements."""
        for sensor, weight in zip(snapshot.met.sensors, snapshot.met.weight.tolist(), strict=True):
            (self.used if weight > 0.0 else self.rejected)[sensor] += 1

    def step(self, snapshots: deque[FilterSnapshot]) -> None:
        """After a keyframe."""
        newest = snapshots[-1]
        time, gates = newest.time, newest.gates
        for sensor, since in gates.items():
            if time - since > REJECTED_S and sensor not in self._out:
                self._out.add(sensor)
                self._say(time, sensor, "rejected", f"{sensor}: disagrees with the estimate for {time - since:.1f} s")
        for sensor in self._out - gates.keys():
            self._out.remove(sensor)
            self._say(time, sensor, "readmitted", f"{sensor}: used again")
        if newest.bridged and time > self._gap_until:
            self._say(time, "imu", "gap", "imu: samples are missing and are bridged")
        if newest.bridged:
            self._gap_until = max(self._gap_until, time + 1.0)

    def of(self, watches: Mapping[str, Watch], time: float) -> dict[str, SensorHealth]:
        """All sensors at a time, but for single beams of a DVL."""
        return {
            sensor: SensorHealth(
                "rejected" if counted in self._out and watch.state == "ok" else watch.state,
                time - watch.time,
                self.used[counted],
                self.rejected[counted],
                _failed(watch, time),
            )
            for sensor, watch in watches.items()
            for counted in [WATER_LAYER if sensor == CELLS else sensor]
        }

    def of_beams(self, seen: Mapping[str, float], time: float) -> dict[str, SensorHealth]:
        """Single beams of the DVL; ``seen`` has when each was valid last [s]."""
        found = {}
        for sensor, last in seen.items():
            lost = time - last if time - last > BEAM_LOST_S else 0.0
            state = "no lock" if lost else "rejected" if sensor in self._out else "ok"
            found[sensor] = SensorHealth(state, time - last, self.used[sensor], self.rejected[sensor], lost)
        return found

    def _say(self, time: float, sensor: str, kind: str, text: str) -> None:
        self.events.append(Event(time, sensor, kind, text))


def _failed(watch: Watch, time: float) -> float:
    """How long a sensor has given nothing that can be used [s]."""
    if watch.state == "ok":
        return 0.0
    return time - (watch.time if watch.state == "silent" else watch.entered)


BEAM_LOST_S = 2.0  # without a valid velocity along it
SENSOR = "dvl"
REJECTIONS, WITHIN_S = 3, 20.0  # so many rejections within that time are no knock
COHERENT_S = 25.0  # without rejections before
KEPT_OUT_S, LONGEST_S = 20.0, 160.0  # how long it is left out, twice as long each time


@dataclass
class Incoherence:
    """Watches the rejections of the DVL.

    Attributes
    ----------
    events : since it was last emptied
    """

    events: list[Event] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._rejections: deque[float] = deque(maxlen=REJECTIONS + 1)  # when they began, or all did, or it ended [s]
        self._recent: deque[FilterSnapshot] = deque()  # keyframes that the lag has passed
        self._begin = self._end = -float("inf")  # of the time in which it is left out [s]

    def keeps_out(self, sensor: str, time: float) -> bool:
        """Whether a measurement is left out."""
        return sensor in (SENSOR, BEAMS) and self._begin < time < self._end

    def passed(self, snapshot: FilterSnapshot) -> None:
        """Remember a keyframe that the lag has passed, for as long as the filter may go back to it."""
        self._recent.append(snapshot)
        while self._recent[0].time < snapshot.time - WITHIN_S - REJECTED_S:
            self._recent.popleft()

    def forget(self) -> None:
        """Another filter continues: forget keyframes of the previous filter."""
        self._recent.clear()

    def state(self) -> list[float]:
        """From when to when it is left out, and the rejections before [s], as plain values."""
        return [self._begin, self._end, *self._rejections]

    def restore(self, state: Sequence[float]) -> None:
        """Continue from the state of another."""
        self._begin, self._end = state[:2]
        self._rejections.extend(state[2:])

    def step(self, engine: FixedLag) -> FaultyInterval | None:
        """After a keyframe: leave the DVL out where it is rejected too often, and return that time if it is new."""
        newest = engine.snapshots[-1]
        time, since = newest.time, newest.gates.get(SENSOR)
        if not self._rejections:
            self._rejections.append(time)
        if since is None or since <= self._end or time - since <= REJECTED_S or since in self._rejections:
            return None
        self._rejections.append(since)
        goes_on = time - self._end < WITHIN_S
        if not goes_on and not self._has_become_incoherent(time):
            return None
        first = self._end if goes_on else self._rejections[1]
        seconds = min(2.0 * (self._end - self._begin), LONGEST_S) if goes_on else KEPT_OUT_S
        self._go_back(engine, first)
        self._begin, self._end = time, time + seconds
        self._rejections.clear()
        self._rejections.append(self._end)
        left_out = f"left out from {first:.1f} s on, for {seconds:.0f} s more"
        text = f"{SENSOR}: contradicts the estimate again and again; {left_out}"
        self.events.append(Event(time, SENSOR, "incoherent", text))
        return FaultyInterval(SENSOR, first, self._end)

    def _has_become_incoherent(self, time: float) -> bool:
        if len(self._rejections) <= REJECTIONS:
            return False
        before, first = self._rejections[0], self._rejections[1]
        return time - first <= WITHIN_S and first - before >= COHERENT_S

    def _go_back(self, engine: FixedLag, since: float) -> None:
        """Have the filter continue from before a time, without the DVL."""
        engine.retract(SENSOR, since)
        oldest = engine.oldest()
        before = [snapshot for snapshot in self._recent if snapshot.time < since]
        if not before or oldest.time < since:
            return
        known, gates = before[-1].known, dict(before[-1].gates)
        others = engine.assembly.problem.without(SENSOR)
        for k in range(engine.place(before[-1]) + 1, engine.place(oldest) + 1):
            known = engine.filter.step(others, k, known, gates).filtered
        engine.adopt(oldest.index, known)
