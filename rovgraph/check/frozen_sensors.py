"""Sensors that repeat themselves although the vehicle moves: what an estimate leaves out."""

from collections.abc import Iterator, Sequence

from rovgraph.check.findings import Finding, since
from rovgraph.config import Config
from rovgraph.log import Log
from rovgraph.log.frozen import FrozenStretch, frozen_stretches

SHOWN = 5  # of one sensor, one by one


def standstill(log: Log, config: Config, frozen: Sequence[FrozenStretch] | None = None) -> Iterator[Finding]:
    """Times in which a sensor repeats itself; ``frozen`` are those of the log, where they are known."""
    by_sensor: dict[str, list[FrozenStretch]] = {}
    for stretch in frozen_stretches(log, config) if frozen is None else frozen:
        by_sensor.setdefault(stretch.sensor, []).append(stretch)
    for sensor, found in by_sensor.items():
        for s in found[:SHOWN]:
            what = "exactly zero" if s.zero else "exactly the same value"
            yield Finding(
                sensor,
                "warning",
                f"{what} for {s.last - s.first:.1f} s from {since(log, s.first)} on, although {s.why}",
                "frozen",
            )
        if len(found) > SHOWN:
            total = sum(s.last - s.first for s in found)
            text = f"frozen {len(found)} times, {total:.0f} s in all, although the vehicle moves"
            yield Finding(sensor, "warning", text, "frozen")
