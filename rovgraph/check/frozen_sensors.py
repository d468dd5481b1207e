"""Measurements that are none although the vehicle moves: what an estimate leaves out."""

from collections.abc import Iterator, Sequence

from rovgraph.check.findings import Finding, since
from rovgraph.config import Config
from rovgraph.log import Log
from rovgraph.log.frozen import FrozenStretch, frozen_stretches

WHAT = {
    "zero": "exactly zero",
    "half": "half the speed",
    "repeated": "exactly the value before",
    "held": "exactly the same value",
}
REMEDY = {
    "zero": "log what the sensor could not measure as empty cells",
    "half": "check the instrument and its driver",
    "repeated": "log each measurement once",
    "held": "check the instrument and its driver",
}
LOST_BOTTOM = "log pings without bottom lock with dvl_valid 0"


def standstill(log: Log, config: Config, frozen: Sequence[FrozenStretch] | None = None) -> Iterator[Finding]:
    """What of each sensor is none, a line for each kind; ``frozen`` is that of the log, where it is known."""
    kinds: dict[tuple[str, str], list[FrozenStretch]] = {}
    for stretch in frozen_stretches(log, config) if frozen is None else frozen:
        kinds.setdefault((stretch.sensor, stretch.kind), []).append(stretch)
    for (sensor, kind), found in kinds.items():
        count, of = sum(len(s.time) for s in found), len(log[sensor])
        first, last = min(s.first for s in found), max(s.last for s in found)
        longest = max(found, key=lambda s: len(s.time))
        if len(found) == 1 and not longest.single:
            extent = f"for {last - first:.1f} s from {since(log, first)} on"
        else:
            extent = f"now and then from {since(log, first)} to {since(log, last)}"
        remedy = LOST_BOTTOM if (sensor, kind) == ("dvl", "zero") else REMEDY[kind]
        text = (
            f"{WHAT[kind]} {extent}, although {longest.why}; {count} of {of} measurements ({count / of:.1%}) are left "
            f"out: {remedy}"
        )
        yield Finding(sensor, "warning", text, "frozen", count / of)
