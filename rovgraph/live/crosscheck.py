"""The motion of the last minutes, as each sensor shows it: whose stamps are late, and whose axes or heading are wrong.

What was received goes through the comparisons of `rovgraph check` again and again: acceleration by DVL and IMU,
turning by compasses and gyro, the DVL's way and fixes, its vertical velocity and depth. What some windows in a row say
is said, and again after half an hour if it lasts, with the figures that it then has.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import chain

from rovgraph.check.agreement import headings, vertical
from rovgraph.check.dvl import dvl_and_imu
from rovgraph.check.findings import Finding
from rovgraph.check.fixes import track
from rovgraph.config import Config
from rovgraph.instruments import HEADING_STREAMS, heading_sources
from rovgraph.live.solution import Event
from rovgraph.log import Log, Measurement, Stream, gathered
from rovgraph.log.streams import joined
from rovgraph.rules import RULES

WINDOW_S = 300.0  # of motion that is compared
EVERY_S = (20.0, 120.0)  # between comparisons: a quarter of the window's motion, within these
AGAIN_S = 1800.0  # after which what lasts is said again
STEP_S = 0.01  # samples of the IMU that come faster are averaged over so long: the comparisons need no more
CHECKS: tuple[Callable[[Log, Config], Iterator[Finding]], ...] = (dvl_and_imu, headings, vertical, track)


@dataclass
class Crosscheck:
    """Compares sensors by the motion that they show.

    Attributes
    ----------
    config : what is believed of mountings and of stamps that are known to be late
    dvl_contradicted : the IMU's acceleration contradicts the DVL's axes or clock in the newest window
    """

    config: Config
    dvl_contradicted: bool = False
    _window: dict[str, Stream] = field(default_factory=dict)
    _newest: list[Measurement] = field(default_factory=list)  # since the last comparison
    _samples: list[Measurement] = field(default_factory=list)  # of the IMU, still to be averaged
    _next: float = math.inf
    _work: Iterator[list[Event]] = field(default_factory=lambda: iter(()))  # left to compare, a part with each sample
    _suspected: dict[tuple[str, str], int] = field(default_factory=dict)  # in how many windows in a row
    _said: dict[tuple[str, str], float] = field(default_factory=dict)  # when [s]

    def add(self, m: Measurement) -> list[Event]:
        """Take a measurement; what is known to be late or wrong from now on, with the configuration that mends it."""
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
        """No more measurements: what `add` has not said yet."""
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
        """Compare the window, one check after the other, and say at last what was found."""
        log = Log("the last minutes", self._window, None)
        now = float(log["imu"].time[-1])
        start = min(float(stream.time[0]) for stream in log.streams.values())
        used, found = heading_sources(self.config, log.sensors), dict[tuple[str, str], Finding]()
        contradicted, events = False, list[Event]()
        for check in CHECKS:
            for f in check(log, self.config):
                contradicted |= check is dvl_and_imu and f.level != "ok"
                # what `vertical` says of scales is for whole dives: in a short window slow pings of waves have another
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
        self._suspected = suspected
        yield events
