"""How the sensors are, as the filter finds them."""

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from rovgraph.estimators.eskf.fixed_lag import FilterSnapshot
from rovgraph.live.faults import Watch
from rovgraph.live.solution import Event, SensorHealth

REJECTED_S = 1.0  # a sensor is said to be rejected after as long


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
        """All sensors at a time."""
        return {
            sensor: SensorHealth(
                "rejected" if sensor in self._out and watch.state == "ok" else watch.state,
                time - watch.time,
                self.used[sensor],
                self.rejected[sensor],
                _failed(watch, time),
            )
            for sensor, watch in watches.items()
        }

    def _say(self, time: float, sensor: str, kind: str, text: str) -> None:
        self.events.append(Event(time, sensor, kind, text))


def _failed(watch: Watch, time: float) -> float:
    """How long a sensor has given nothing that can be used [s]."""
    if watch.state == "ok":
        return 0.0
    return time - (watch.time if watch.state == "silent" else watch.entered)
