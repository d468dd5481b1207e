"""Is this log sane? And what would an estimate make of it?

`examine` runs every check of `CHECKS` and collects what they find; `warn` is for commands
that go on to work with the log. A check takes a log and a configuration and yields
findings; it knows nothing of other checks.
"""

from collections.abc import Callable, Iterator
from functools import partial

from rovgraph.check.agreement import headings, vertical
from rovgraph.check.compasses import body_heading
from rovgraph.check.current import current
from rovgraph.check.dvl import dvl_and_imu
from rovgraph.check.findings import Finding, Report, Timing
from rovgraph.check.fixes import track
from rovgraph.check.frozen_sensors import standstill
from rovgraph.check.jumps import Examined, bridge_jumps
from rovgraph.check.outlook import plan
from rovgraph.check.places import places
from rovgraph.check.start import start
from rovgraph.check.times import overlap, presence, regularity, timing
from rovgraph.check.values import angles, frozen_imu, gravity, own, saturated, turn_rates
from rovgraph.config import Config
from rovgraph.errors import InputError
from rovgraph.errors import warn as issue_warning
from rovgraph.log import Log
from rovgraph.log.frozen import frozen_stretches, log_without
from rovgraph.sensors import Level

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
    own,
    standstill,
    frozen_imu,
    saturated,
    dvl_and_imu,
    vertical,
    start,
    track,
    current,
    places,
    plan,
)
MOTION_CHECKS = (headings, vertical, track, current)


def examine(log: Log, config: Config | None = None, examined: Examined | None = None) -> Report:
    """Run every check.

    Parameters
    ----------
    log : as read
    config : what is believed of the vehicle; defaults where it is not given
    examined : what `bridge_jumps` knows of the log with this configuration
    """
    config = Config() if config is None else config
    frozen = frozen_stretches(log, config)
    unfrozen = log_without(log, frozen)
    known: dict[Check, Check] = {
        dvl_and_imu: partial(dvl_and_imu, examined=examined),
        regularity: partial(regularity, frozen=frozen),
        standstill: partial(standstill, frozen=frozen),
        **{check: partial(_of_motion, check, unfrozen) for check in MOTION_CHECKS if frozen},
    }
    found = {check: [*known.get(check, check)(log, config)] for check in CHECKS}
    findings = [finding for own in _without_consequences(found, log, config).values() for finding in own]
    bursts = {f.sensor for f in findings if f.kind == "bursts"}  # whose stamps are late, too
    findings = [f for f in findings if f.kind != "lag" or not bursts & {"imu", f.sensor}]
    return Report(log.source, [timing(stream) for stream in log.streams.values()], findings)


def _without_consequences(found: dict[Check, list[Finding]], log: Log, config: Config) -> dict[Check, list[Finding]]:
    """Findings without those that follow from others: headings from the gyro's axes, tracks from a heading."""
    out = dict(found)
    if any(f.kind == "axes" and f.level != "ok" for f in found[gravity]):
        out[headings] = [f for f in found[headings] if f.kind != "sign" or f.sensor == "mag"]
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
