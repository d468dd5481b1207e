"""Checks of a log before an estimate: units, signs, axes, clocks, contradictions.

`examine` runs every check of `CHECKS` and collects the findings; `warn` is for commands that then work with the log. A
check takes a log and a configuration and yields findings, independently of other checks. May import what
`rovgraph.diagnosis` may. Begin with `values` (one sensor by itself) and `agreement` (two sensors of one motion).

`plan` is a preview of the estimate: heading sources, keyframes, assumptions. `places` counts the sightings of each
place, since a place seen once adds no information.
"""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from rovgraph.diagnosis.check import acoustics
from rovgraph.diagnosis.check.agreement import headings, vertical
from rovgraph.diagnosis.check.clocks import Examined, bridge_jumps, overlap, presence, regularity, timing
from rovgraph.diagnosis.check.compasses import body_heading, field_of_place
from rovgraph.diagnosis.check.dvl import beams, dvl_and_imu, ranges
from rovgraph.diagnosis.check.findings import Finding, Report, Timing, since
from rovgraph.diagnosis.check.fixes import current, start, track
from rovgraph.diagnosis.check.values import angles, frozen_imu, gravity, own, saturated, standstill, turn_rates
from rovgraph.diagnosis.check.water import profiles
from rovgraph.errors import InputError
from rovgraph.errors import warn as issue_warning
from rovgraph.inference.resolve import convergence, declination_by_place
from rovgraph.log import Log
from rovgraph.log.frozen import frozen_stretches, log_without
from rovgraph.model.config import Config
from rovgraph.problem.motion import motion_model
from rovgraph.sensors import SENSORS, Level
from rovgraph.sensors.compass import reference
from rovgraph.sensors.earth_field import BLACKOUT_NT
from rovgraph.sensors.instruments import heading_sources


def plan(log: Log, config: Config) -> Iterator[Finding]:
    """Sensors that would be used, and assumptions where the configuration states no value."""
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
        yield f"environment.declination_deg is not given: {_north(log, config)}"
    if "mag" in sources and (env.field_norm is None or env.dip_deg is None):
        yield "environment.field_norm or dip_deg is not given: taken from the log"
    if env.earth_rotation and env.latitude_deg is None:
        yield "environment.latitude_deg is not given: taken from the first fix_lat"


def _north(log: Log, config: Config) -> str:
    """What is taken for north where no declination is stated."""
    field = declination_by_place(log, config)
    if field is None or field.horizontal_nt <= BLACKOUT_NT:
        unstated = [source for source in heading_sources(config, log.sensors) if reference(config, source) is None]
        key = f"heading.{unstated[0].partition('_')[0]}_reference" if unstated else ""
        why = f"{key} is not given" if unstated else "the log has no place or no date"
        return f"magnetic north is taken as north, as {why}"
    return f"{field.declination_deg:.2f} by WMM2025 at the origin and the date of the log"


def places(log: Log, config: Config) -> Iterator[Finding]:
    """How many places are seen again, and after how long."""
    if "place" not in log:
        return
    stream = log["place"]
    names, which = np.unique(stream["place_id"], return_inverse=True)
    spans = np.array([np.ptp(stream.time[which == k]) for k in range(len(names))])
    again = spans >= config.place.every_s
    if not again.any():
        text = f"{len(names)} places, none of them seen again: they add no information; "
        text += "check that a place keeps its place_id"
        yield Finding("place", "warning", text)
        return
    counted = f"{len(stream)} observations of {len(names)} places, {again.sum()} of them seen again"
    text = f"{counted}, up to {spans.max():.0f} s later"
    if not again.all():
        text += f"; {(~again).sum()} seen only once add no information"
    yield Finding("place", "ok", text)
    last = float(stream.time[again[which]].max())
    yield Finding(
        "place", "ok", f"last seen again at {since(log, last)}; from there on the error grows as without places"
    )


__all__ = ["Finding", "Level", "Report", "Timing", "bridge_jumps", "examine", "warn"]

Check = Callable[[Log, Config], Iterator[Finding]]
CHECKS: tuple[Check, ...] = (
    presence,
    overlap,
    regularity,
    gravity,
    turn_rates,
    angles,
    headings,
    field_of_place,
    own,
    standstill,
    frozen_imu,
    saturated,
    dvl_and_imu,
    beams,
    ranges,
    profiles,
    vertical,
    start,
    track,
    current,
    places,
    acoustics.replies,
    acoustics.ships,
    acoustics.ship,
    acoustics.depths,
    acoustics.lengths,
    acoustics.positions,
    plan,
)
MOTION_CHECKS = (headings, vertical, track, current, acoustics.depths, acoustics.positions)


def examine(log: Log, config: Config | None = None, examined: Examined | None = None) -> Report:
    """Run every check.

    Parameters
    ----------
    log : as read
    config : what is believed of the vehicle; defaults where it is not given
    examined : result of `bridge_jumps` for the log with this configuration
    """
    config = Config() if config is None else config
    if (north := convergence(log, config)) is not None:
        config = config.with_values(environment={"convergence_deg": north})
    frozen = frozen_stretches(log, config)
    unfrozen = log_without(log, frozen)
    known: dict[Check, Check] = {
        dvl_and_imu: partial(dvl_and_imu, examined=examined),
        regularity: partial(regularity, frozen=frozen),
        standstill: partial(standstill, frozen=frozen),
        **{check: partial(_of_motion, check, unfrozen) for check in MOTION_CHECKS if frozen},
    }
    found = {check: [*known.get(check, check)(log, config)] for check in CHECKS}
    findings = [finding for of_check in _without_consequences(found, log, config).values() for finding in of_check]
    bursts = {f.sensor for f in findings if f.kind == "bursts"}  # whose stamps are late, too
    findings = [f for f in findings if f.kind != "lag" or not bursts & {"imu", f.sensor}]
    return Report(log.source, [timing(stream) for stream in log.streams.values()], findings)


def _without_consequences(found: dict[Check, list[Finding]], log: Log, config: Config) -> dict[Check, list[Finding]]:
    """Findings without those that follow from others: headings from the gyro's axes, tracks from a heading, units,
    profiles of the water from the DVL whose head, clock and axes they share.

    Nor is bottom lock missed where the beams carry the dive.
    """
    out = dict(found)
    if any(f.kind == "bottom lock" and f.level == "ok" for f in found[beams]):
        out[own] = [f for f in found[own] if f.kind != "bottom lock"]
    if any(f.kind in ("axes", "lag", "jump") and f.level != "ok" for f in found[dvl_and_imu]):
        out[profiles] = [f for f in found[profiles] if f.kind not in ("axes", "lag")]
    if any(f.kind == "axes" and f.level != "ok" for f in found[gravity]):
        out[headings] = [f for f in found[headings] if f.kind != "sign" or f.sensor == "mag"]
    if any(f.kind == "unit" for f in found[acoustics.depths]):
        out[acoustics.lengths] = [f for f in found[acoustics.lengths] if f.sensor != "usbl"]
    wrong = {f.sensor for f in out[headings] if f.kind in ("sign", "unit") and f.level != "ok"}
    heading = body_heading(log, config) if wrong else None
    if heading is not None and heading[0] in wrong:
        for check in (track, current):
            if any(f.level != "ok" for f in found[check]):
                text = f"what it shows beside other sensors is looked at when {heading[0]} is right"
                out[check] = [Finding(f.sensor, "ok", text) for f in found[check][:1]]
    return out


def _of_motion(check: Check, unfrozen: Log, log: Log, config: Config) -> Iterator[Finding]:
    """What a comparison of motions finds without the values that are frozen: a late clock makes values seem so."""
    found = [*check(log, config)]
    yield from found if any(f.of_clock and f.level != "ok" for f in found) else check(unfrozen, config)


def warn(log: Log, config: Config | None = None, examined: Examined | None = None) -> Report:
    """Issue a `DataWarning` for whatever looks wrong, and return all of it.

    Raises
    ------
    InputError : what the log cannot be worked with for; the first of these findings
    """
    report = examine(log, config, examined)
    for finding in report.at("warning"):
        issue_warning(f"{report.source}: {finding.sensor}: {finding.text}")
    refuse(report)
    return report


def refuse(report: Report) -> None:
    """Raise an `InputError` if a report holds an error."""
    errors = report.at("error")
    if errors:
        more = f" (and {len(errors) - 1} more; see rovgraph check)" if len(errors) > 1 else ""
        raise InputError(f"{report.source}: {errors[0].sensor}: {errors[0].text}{more}")
