"""Sensors that fail while they go on talking, or fall silent.

What is wrong is told from a sensor's own values and the IMU's: exact zeros although those before
were too far from zero for the vehicle to have come there; values that repeat exactly though they hardly
ever did; a compass that stands still while the vehicle turns. A measurement that is part of
such a failure is kept out, and those before it that were, taken back. What disagrees with the
estimate is the filter's to reject.
"""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rovgraph.config import Config
from rovgraph.geometry import Array
from rovgraph.instruments import HEADING_STREAMS
from rovgraph.live.solution import Event
from rovgraph.log import Measurement
from rovgraph.log.frozen import (
    ENOUGH_VALUES,
    MIN_REPEATS,
    MIN_SECONDS,
    Company,
    companies,
    is_false_zero,
    shows_noise,
)

SILENT_S, SILENT_PERIODS = 3.0, 10.0  # without a measurement, the longer of the two
SILENT_AT_FIRST_S = 10.0  # after a first measurement, as long as the period is not known
SELDOM_AT_FIRST_S = {"fix": 30.0}  # of sensors that speak less often
TELL_S = 2.0  # a ping without bottom lock is not worth an event, nor is a zero
OFTEN, OFTEN_S = 10, 60.0  # so many times zeros in such a time are
FROZEN = {"imu": 20, "dvl": 3}  # equal measurements running that no working sensor gives
NOISY = {"mag", "depth", "dvl_water"}  # sensors whose noise may show, so that values hardly ever repeat
RECENT_VALUES = 100  # different ones, that are looked at for it
TURNED = np.deg2rad(15.0)  # of the vehicle, while its heading stands still
LONGEST_STEP_S = 1.0  # of the gyro, over which a turn is reckoned
OCCASIONAL = {"place"}  # sensors that speak when there is something to be seen


@dataclass(frozen=True)
class Verdict:
    """What to do with a measurement.

    Attributes
    ----------
    use : give it to the estimator
    retract_since : take back the sensor's measurements from then on [s], or None
    reason : why it is not used; empty = the sensor's state says it
    """

    use: bool = True
    retract_since: float | None = None
    reason: str = ""


_GOOD = Verdict()


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
    values: bytes = b""
    since: float = 0.0  # of the first of equal values
    equal: int = 0
    first: float = math.nan  # component of theirs
    recent: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=RECENT_VALUES))  # the same of others
    noisy: bool | None = None  # what `shows_noise` found, as long as values stay equal
    turned: tuple[float, ...] = (0.0, 0.0, 0.0)  # how far the vehicle had by then [rad]
    by_hand: bool = False  # no sensor has measured yet: nothing is late
    known: deque[tuple[float, Array]] = field(default_factory=lambda: deque(maxlen=RECENT_VALUES))  # not zero
    zero: bool = False  # the newest is an exact zero that is none
    zeros: deque[float] = field(default_factory=lambda: deque(maxlen=OFTEN))  # when such began [s]
    told: bool = False  # that they come often

    def count(self, first: float) -> None:
        """Note that other values follow the equal ones so far."""
        if 0 < self.equal < MIN_REPEATS:
            self.recent.append((self.first, self.equal))
        self.first, self.noisy = first, None

    @property
    def shows_noise(self) -> bool:
        """Whether its values lately were other ones each time, as noise makes them."""
        if self.noisy is None:
            self.noisy = len(self.recent) >= ENOUGH_VALUES and shows_noise(*np.array(self.recent).T)
        return self.noisy


@dataclass
class Faults:
    """Looks at every measurement before the estimator does.

    Attributes
    ----------
    watches : by sensor
    events : since it was last emptied
    companies : by sensor, what tells that an exact zero is none
    """

    watches: dict[str, Watch] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)
    companies: Mapping[str, Company] = field(default_factory=lambda: companies(Config()))
    _now: float = -np.inf
    _turned: tuple[float, ...] = (0.0, 0.0, 0.0)  # since the beginning, by the gyro [rad]

    def look(self, m: Measurement) -> Verdict:
        """Whether a measurement is one."""
        watch = self.watches.get(m.sensor)
        if watch is None or watch.by_hand:
            watch = self.watches[m.sensor] = Watch()
        self._note(m, watch)
        if m.sensor == "dvl" and m.values[3] == 0.0:
            return self._verdict(m, watch, "no lock", "no bottom lock")
        company = self.companies.get(m.sensor)
        if company is not None and self._is_false_zero(m, watch, company):
            return self._left_zero(m, watch)
        at_rest = company is not None and company.rests and not m.values[: company.columns].any()
        frozen = (watch.equal > 1 and not at_rest) and (
            watch.equal >= FROZEN.get(m.sensor, math.inf)
            or (
                watch.equal > 2
                and m.sensor in HEADING_STREAMS
                and max(abs(now - then) for now, then in zip(self._turned, watch.turned, strict=True)) > TURNED
            )
            or (m.sensor in NOISY and self._has_lost_its_noise(m, watch))
        )
        if not frozen and watch.state == "ok" and not watch.reported:
            return _GOOD
        return self._verdict(m, watch, "frozen" if frozen else "ok", "the same values again and again")

    def _note(self, m: Measurement, watch: Watch) -> None:
        """Remember when it was measured, and how often these values came in a row."""
        values = m.values.tobytes()
        if values == watch.values:
            watch.equal += 1
        else:
            if m.sensor in NOISY:
                watch.count(m.values.item(0))
            watch.equal, watch.since, watch.turned = 1, m.time, self._turned
        if watch.time > -np.inf:
            step = m.time - watch.time
            if m.sensor == "imu" and 0.0 < step < LONGEST_STEP_S:
                (x, y, z), (a, b, c) = self._turned, m.values[3:6].tolist()
                self._turned = x + a * step, y + b * step, z + c * step
            watch.period = step if not watch.period else watch.period + 0.05 * (step - watch.period)
        if m.time > self._now:
            self._now = m.time
        if m.time > watch.time:
            watch.time = m.time
        watch.heard, watch.values = self._now, values

    def _has_lost_its_noise(self, m: Measurement, watch: Watch) -> bool:
        """Whether a sensor repeats itself that hardly ever did, while the IMU goes on to show its own noise."""
        imu = self.watches.get("imu")
        return (
            watch.equal >= MIN_REPEATS
            and m.time - watch.since >= MIN_SECONDS
            and bool(m.values[:3].any())
            and bool(np.isfinite(m.values[:3]).all())
            and watch.shows_noise
            and imu is not None
            and imu.state == "ok"
        )

    def state(self) -> dict[str, dict[str, Any]]:
        """What is remembered of sensors whose noise shows, as plain values and arrays."""
        return {
            sensor: {
                "time": watch.time,
                "values": np.frombuffer(watch.values),
                "since": watch.since,
                "equal": watch.equal,
                "recent": np.array(watch.recent).reshape(-1, 2),
            }
            for sensor, watch in self.watches.items()
            if sensor in NOISY and watch.values
        }

    def restore(self, state: Mapping[str, Mapping[str, Any]]) -> None:
        """Go on from where another stood."""
        for sensor, known in state.items():
            values = np.asarray(known["values"])
            watch = Watch(values=values.tobytes(), since=known["since"], equal=known["equal"], first=values.item(0))
            watch.time = watch.heard = known["time"]
            watch.recent.extend((first, int(count)) for first, count in known["recent"].tolist())
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
