"""A DVL that contradicts the estimate again and again: a false lock, or water for the bottom.

The filter lets a sensor in again that was out for its `readmit_s`, and moves to where that sensor sees it: right after
a knock, wrong where the DVL has locked onto something else. A knock is over after one such return. A DVL that is
rejected time and again is left out from its first rejection on, and again at once if it is rejected soon afterwards:
the filter goes back to the keyframe before and takes all other measurements since once more. Its uncertainty is then
that of the IMU without a DVL. A DVL that was never coherent is wrongly described rather than broken: it stays in use,
and alarms say so.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from rovgraph.engine.gauss_newton import Stretch
from rovgraph.estimators.eskf.fixed_lag import FilterSnapshot, FixedLag
from rovgraph.live.health import REJECTED_S
from rovgraph.live.solution import Event

SENSOR = "dvl"
REJECTIONS, WITHIN_S = 3, 20.0  # so many rejections within that time are no knock
COHERENT_S = 25.0  # without rejections before
KEPT_OUT_S, LONGEST_S = 20.0, 160.0  # how long it is left out, twice as long whenever it goes on


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
        return sensor == SENSOR and self._begin < time < self._end

    def passed(self, snapshot: FilterSnapshot) -> None:
        """Remember a keyframe that the lag has passed, for as long as the filter may go back to it."""
        self._recent.append(snapshot)
        while self._recent[0].time < snapshot.time - WITHIN_S - REJECTED_S:
            self._recent.popleft()

    def forget(self) -> None:
        """Another filter goes on, with another state: keyframes that have passed are none of its own."""
        self._recent.clear()

    def state(self) -> list[float]:
        """From when to when it is left out, and the rejections before [s], as plain values."""
        return [self._begin, self._end, *self._rejections]

    def restore(self, state: Sequence[float]) -> None:
        """Go on from where another stood."""
        self._begin, self._end = state[:2]
        self._rejections.extend(state[2:])

    def step(self, engine: FixedLag) -> Stretch | None:
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
        return Stretch(SENSOR, first, self._end)

    def _has_become_incoherent(self, time: float) -> bool:
        if len(self._rejections) <= REJECTIONS:
            return False
        before, first = self._rejections[0], self._rejections[1]
        return time - first <= WITHIN_S and first - before >= COHERENT_S

    def _go_back(self, engine: FixedLag, since: float) -> None:
        """Have the filter go on from before a time, without the DVL."""
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
