"""Sensors that fail while they go on talking, or fall silent.

What is wrong is told by the rules of a log (`rovgraph.log.frozen`) from what came before: exact zeros although
those before were too far from zero for the vehicle to have come there, and values that are held while it moves. Those
are left out once the limits are passed, and what was used of them is taken back. Equal values that no working DVL or
IMU gives wait until then. What disagrees with the estimate is the filter's to reject.
"""

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from operator import attrgetter
from typing import Any

import numpy as np

from rovgraph.config import Config, mount_matrix
from rovgraph.geometry import Array
from rovgraph.live.solution import Event
from rovgraph.log import Measurement
from rovgraph.log.frozen import HOLDS, Company, Hold, Runs, companies, held, is_false_zero
from rovgraph.log.log import gathered
from rovgraph.rules import SILENT_PERIODS, SILENT_S

SILENT_AT_FIRST_S = 10.0  # after a first measurement, as long as the period is not known
SELDOM_AT_FIRST_S = {"fix": 30.0}  # of sensors that speak less often
TELL_S = 2.0  # a ping without bottom lock is not worth an event, nor is a zero
OFTEN, OFTEN_S = 10, 60.0  # so many times zeros in such a time are
WAIT = {"imu": 20, "dvl": 3}  # equal measurements running that no working sensor gives, from which on they wait
RECENT_VALUES = 100  # different ones of a sensor, that tell how it is
AROUND_S = 30.0  # for which the IMU and the DVL are remembered, which tell of motion
ASK_EVERY_S = 1.0  # whether values are held, while they are
TURNS, TURNS_EVERY_S = 1000, 1.0  # rates of turn whose median is the gyro's bias
OCCASIONAL = {"place"}  # sensors that speak when there is something to be seen


@dataclass(frozen=True)
class Verdict:
    """What to do with a measurement.

    Attributes
    ----------
    use : give it to the estimator
    retract_since : take back the sensor's measurements from then on [s], as they wait or are none, or None
    reason : why it is not used; empty = the sensor's state says it
    count : measurements that are left out by this, those taken back too; none while they wait
    late : measurements before it that waited, and are to be used after all
    """

    use: bool = True
    retract_since: float | None = None
    reason: str = ""
    count: int = 1
    late: tuple[Measurement, ...] = ()


_GOOD = Verdict()
_time = attrgetter("time")


@dataclass
class Watch:
    """What is remembered of one sensor.

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
    held: bool = False  # the equal values are none
    asked: float = -np.inf  # when that was looked at, in this run
    waits: bool = False  # the equal values wait until that is known
    same: list[Measurement] = field(default_factory=list)  # those of a sensor that may wait
    by_hand: bool = False  # no sensor has measured yet: nothing is late
    known: deque[tuple[float, Array]] = field(default_factory=lambda: deque(maxlen=RECENT_VALUES))  # not zero
    zero: bool = False  # the newest is an exact zero that is none
    zeros: deque[float] = field(default_factory=lambda: deque(maxlen=OFTEN))  # when such began [s]
    told: bool = False  # that they come often

    def run(self) -> tuple[Array, int, float, float]:
        """The equal values, their count, and the times of the first and the last of them [s]."""
        return np.frombuffer(self.values), self.equal, self.since, self.until

    def release(self) -> tuple[Measurement, ...]:
        """What has waited; it waits no more."""
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

    def __post_init__(self) -> None:
        self._companies: Mapping[str, Company] = companies(self.config)
        self._yaw_axis = mount_matrix(self.config.imu.mount_rpy_deg)[2]

    def look(self, m: Measurement) -> Verdict:
        """Whether a measurement is one."""
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
            return Verdict(late=late) if late else _GOOD
        frozen, waited = self._are_held(m, watch, hold), watch.waits
        if not frozen and self._waits(m, watch):
            return Verdict(False, None if waited else watch.since, count=0)
        late += watch.release() if waited else ()
        verdict = self._verdict(m, watch, "frozen" if frozen else "ok", "the same values again and again")
        if not frozen:
            return replace(verdict, late=late)
        if verdict.retract_since is None:
            return verdict
        since = math.nextafter(watch.since, math.inf) if hold.right else watch.since
        return replace(verdict, retract_since=None if waited else since, count=watch.equal - hold.right)

    def _note(self, m: Measurement, watch: Watch) -> None:
        """Remember when it was measured, and what tells of the vehicle's motion."""
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
        """Whether equal values are none, as a log tells it, from what came before."""
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
        """What is remembered of sensors whose values may be held, as plain values and arrays."""
        return {
            sensor: {
                "held": watch.held,
                "runs": np.array([[count, first, last, *values] for values, count, first, last in runs]),
            }
            for sensor, watch in self.watches.items()
            if (runs := [*watch.runs, watch.run()] if watch.values else [])
        }

    def restore(self, state: Mapping[str, Mapping[str, Any]]) -> None:
        """Go on from where another stood."""
        for sensor, known in state.items():
            runs = [(row[3:], int(row[0]), float(row[1]), float(row[2])) for row in np.asarray(known["runs"])]
            values, equal, since, until = runs.pop()
            watch = Watch(time=until, heard=until, values=values.tobytes(), equal=equal, since=since, until=until)
            watch.held = known["held"]
            watch.runs.extend(runs)
            self.watches[sensor] = watch

    def accept(self, m: Measurement) -> Verdict:
        """Take a measurement that a person gives, as it is; a sensor that gives the like is not said to have spoken."""
        watch = self.watches.setdefault(m.sensor, Watch(by_hand=True))
        if watch.by_hand:
            watch.time = max(m.time, watch.time)
        return _GOOD

    def tick(self, time: float) -> None:
        """Note sensors that have said nothing for too long."""
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
        """Whether a measurement is an exact zero that is none; what is not zero is remembered."""
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

    def _left_zero(self, m: Measurement, watch: Watch) -> Verdict:
        """What to do with such a zero, and an event where they last, or come again and again."""
        state = "no lock" if m.sensor == "dvl" else "frozen"
        self._verdict(m, watch, state, "exactly zero although it moves", at_once=False)
        often = len(watch.zeros) == OFTEN and m.time - watch.zeros[0] < OFTEN_S
        if often and not watch.told and not watch.reported:
            watch.told = True
            text = f"{m.sensor}: exactly zero again and again although it moves; these are left out"
            self.events.append(Event(m.time, m.sensor, state, text))
        return Verdict(False, reason="exactly zero")

    def _verdict(self, m: Measurement, watch: Watch, state: str, text: str, at_once: bool = True) -> Verdict:
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
        return Verdict(False, watch.since if at_once and before != state else None)
