"""What an estimate would make of a log: heading sources, keyframes, assumptions."""

from collections.abc import Iterator

import numpy as np

from rovgraph.check.findings import Finding
from rovgraph.config import Config
from rovgraph.engine.constant_velocity import motion_model
from rovgraph.instruments import heading_sources
from rovgraph.log import Log
from rovgraph.sensors import SENSORS


def plan(log: Log, config: Config) -> Iterator[Finding]:
    """What would be used, and what is assumed where the configuration says nothing."""
    sources = heading_sources(config, log.sensors)
    yield Finding("configuration", "ok", f"heading from {', '.join(sources) or 'the start only'}")
    wanted = {sensor.heading_source: sensor.name for sensor in SENSORS.values()}
    for source in config.heading.sources or ():
        if wanted[source] not in log:
            yield Finding(
                "configuration", "warning", f"heading.sources names {source}, but the log has none", "missing"
            )
    if "imu" in log:
        yield Finding("configuration", "ok", f"about {keyframes(log, config)} keyframes")
    for text in _assumptions(log, config, sources):
        yield Finding("configuration", "ok", text)


def keyframes(log: Log, config: Config) -> int:
    """Keyframes to expect: valid pings, and those wherever ``graph.max_gap_s`` passes without."""
    first, last = log["imu"].time[[0, -1]]
    times = np.empty(0)
    if "dvl" in log:
        pings = log["dvl"].time[log["dvl"]["dvl_valid"] == 1.0]
        times = pings[(pings > first) & (pings < last)]
    gaps = np.diff(np.concatenate([[first], times, [last]]))
    apart = gaps >= config.graph.min_gap_s
    waited = np.full(len(gaps), config.graph.ping_due_s)
    waited[-1] = 0.0  # no ping is due after the end
    between = np.maximum(np.ceil((gaps - waited) / config.graph.max_gap_s - 1e-9) - 1.0, 0.0)
    return int(1 + apart.sum() + between.sum())


def _assumptions(log: Log, config: Config, sources: list[str]) -> Iterator[str]:
    start, env = config.start, config.environment
    if start.heading_deg is None and sources:
        yield f"start.heading_deg is not given: taken from the first samples of {sources[0]}"
    if start.roll_deg is None or start.pitch_deg is None:
        level = "roll and pitch" if motion_model(config, log.sensors) == "constant_velocity" else "gravity"
        yield f"start.roll_deg or start.pitch_deg is not given: taken from {level}"
    if "depth" in log and start.down_m is None:
        yield "start.down_m is not given: taken from the first depth"
    for section, sensor in ((config.imu, "imu"), (config.dvl, "dvl")):
        if sensor in log and "mount_rpy_deg" not in section.model_fields_set:
            yield f"{sensor}.mount_rpy_deg is not given: its axes are taken as the vehicle's: forward, starboard, down"
        if sensor in log and "lever_arm_m" not in section.model_fields_set:
            yield f"{sensor}.lever_arm_m is not given: taken as zero"
    if sources and "declination_deg" not in env.model_fields_set:
        yield "environment.declination_deg is not given: magnetic north is taken as north"
    if "mag" in sources and (env.field_norm is None or env.dip_deg is None):
        yield "environment.field_norm or dip_deg is not given: taken from the log"
    if env.earth_rotation and env.latitude_deg is None:
        yield "environment.latitude_deg is not given: taken from the first fix_lat"
