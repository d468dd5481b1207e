"""Agreement of sensors that measure the same motion: sign, scale, and clock.

Each comparison takes the changes that two sensors measure within windows of some seconds
(`rovgraph.diagnosis.check.lags`).
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rovgraph.diagnosis.check.compasses import field_axes, magnetic_heading
from rovgraph.diagnosis.check.findings import Finding, believed_lag, valid_pings, without_spikes
from rovgraph.diagnosis.check.fixes import turned_by
from rovgraph.diagnosis.check.inertial import InertialMotion, inertial_motion
from rovgraph.diagnosis.check.lags import MIN_WINDOWS, Lag, LineFit, Signal, coarse_lag, fit, lag
from rovgraph.diagnosis.check.values import GRAVITY_ANGLE, tilt
from rovgraph.geometry import Array, rotate
from rovgraph.log import Log, Stream
from rovgraph.log.frozen import downwards
from rovgraph.log.streams import integral
from rovgraph.log.units import UNITS, turn_angles
from rovgraph.model.config import Config, mount_matrix
from rovgraph.rules import DESCENT, FOLLOWS, TURNING, MotionLimits, remedy_of_lag
from rovgraph.sensors.dvl import other_way_up
from rovgraph.sensors.pressure import BY_PRESSURE, density

ENOUGH_TURNING = 0.05  # sd of the turn within a window [rad]
ENOUGH_DIVING = 0.05  # sd of the change of depth within a window [m]
CLOSELY = 0.95  # correlation beyond which a slope is that of the scales
SAME_UNIT = 0.1  # logarithm of a ratio within which two units are one
LEAST_STEP = 0.3  # of a depth whose zero is set again [m]
STEPS = 10.0  # times its usual change against the DVL's way
MOST_STEPS = 3
NOISE_MARGIN = 2.0  # of turning over a heading's noise, below which the two need not agree
LEAST_LEVEL = 0.1  # cos(pitch)^2 below which a heading turns at any rate
NAMES = {"mag": "the field's direction", "ahrs": "ahrs_yaw", "dvl_heading": "dvl_heading", "vehicle_heading": "heading"}
ZEROS = {"enu": "east", "nwu": "north"}  # of headings that count anticlockwise
FITS = 0.25 * np.pi  # turn of the DVL's track against the fixes, beyond which one of them is reported


def headings(log: Log, config: Config) -> Iterator[Finding]:
    """Every heading turns as the gyro does: direction, unit and clock."""
    if "imu" not in log or len(log["imu"]) < 3:
        return
    sensors = [sensor for sensor in NAMES if sensor in log and len(log[sensor]) >= MIN_WINDOWS]
    gyro, motion = _gyro_yaw(log["imu"], config), inertial_motion(log, config) if sensors else None
    for sensor in sensors:
        if sensor == "mag" and motion is not None and (wrong := [*field_axes(log, config, motion)]):
            yield from wrong
            if wrong[0].sensor == "imu":  # a wrong gyro cannot judge other compasses
                return
            continue
        heading = _heading(log, config, sensor, motion)
        period = float(np.median(np.diff(heading.time)))
        window = max(2.0, 3.0 * period)
        f = fit(gyro, heading, window)
        if abs(f.correlation) < FOLLOWS:
            shifted = Signal(heading.time - coarse_lag(gyro, heading, window), heading.value)
            f = fit(gyro, shifted, window)
        noise = _change_noise(heading, window)
        yield _turning(log, config, sensor, f, noise)
        if sensor != "mag" and abs(f.correlation) > FOLLOWS and max(f.sd_a, f.sd_b) > ENOUGH_TURNING:
            found = _heading_lag(gyro, _heading_by_gyro(log, config, motion), heading)
            remedy = f"if it is late, {remedy_of_lag(config, sensor, found.seconds, found.sd)}"
            turn, believed = f"the turning of {NAMES[sensor]}", believed_lag(config, sensor)
            yield from _clock(sensor, turn, "the gyro's", found, TURNING, believed, remedy)


def heading_lag(log: Log, config: Config, sensor: str) -> tuple[float, float] | None:
    """How much later a compass turns than the gyro, and its sd [s]; None where it does not follow the gyro."""
    if sensor not in NAMES or len(log[sensor]) < MIN_WINDOWS:
        return None
    gyro, motion = _gyro_yaw(log["imu"], config), inertial_motion(log, config)
    found = _heading_lag(gyro, _heading_by_gyro(log, config, motion), _heading(log, config, sensor, motion))
    return None if np.isnan(found.seconds) or np.isnan(found.sd) else (found.seconds, found.sd)


def _heading_lag(gyro: Signal, by_gyro: Signal, heading: Signal) -> Lag:
    """How much later a heading shows a turn than the gyro does, about the body's z axis and as a heading.

    In short windows: in long ones a compass's deviation looks like a lag. Legs of a dive are told apart best by what
    the vehicle's own axis shows beside them.
    """
    window = max(1.0, 1.5 * float(np.median(np.diff(heading.time))))
    return lag(by_gyro, heading, window, coarse_lag(gyro, heading, window))


def _gyro_yaw(imu: Stream, config: Config) -> Signal:
    """Integrated rate about the body's z axis [rad]."""
    rate_b = rotate(mount_matrix(config.imu.mount_rpy_deg), imu.data[:, 3:])
    return Signal(imu.time, integral(imu.time, rate_b[:, 2]))


def _heading_by_gyro(log: Log, config: Config, motion: InertialMotion | None) -> Signal:
    """Change of heading by the gyro, of a vehicle that rolls and pitches, where gravity shows the vertical [rad].

    With d down in b it is h' = (w_y d_y + w_z d_z) / (d_y^2 + d_z^2). Beside the rate about z, waves look like a lag.
    """
    if motion is None or not motion.known.any() or tilt(log, config) > GRAVITY_ANGLE:
        return _gyro_yaw(log["imu"], config)
    (_, w_y, w_z), (_, d_y, d_z) = motion.rate_b.T, motion.down_b.T
    rate = (w_y * d_y + w_z * d_z) / np.maximum(d_y**2 + d_z**2, LEAST_LEVEL)
    edges = np.append(motion.time - 0.5 * motion.step, motion.time[-1] + 0.5 * motion.step)
    known = np.append(motion.known, False) | np.append(False, motion.known)  # a gap stays one
    return Signal(edges[known], np.append(0.0, np.cumsum(motion.step * rate))[known])


def _heading(log: Log, config: Config, sensor: str, motion: InertialMotion | None) -> Signal:
    """A heading without jumps, of whatever circle its numbers suggest."""
    stream = log[sensor]
    values = _magnetic_heading(log, config, motion) if sensor == "mag" else stream.data[:, 0]
    return Signal(stream.time, np.unwrap(values, period=_circle(values)))


def _magnetic_heading(log: Log, config: Config, motion: InertialMotion | None) -> Array:
    """Heading of the field's horizontal part, shape (n,) [rad]."""
    field_b = rotate(mount_matrix(config.imu.mount_rpy_deg), log["mag"].data)
    return magnetic_heading(field_b, None if motion is None else motion.at(log["mag"].time, motion.down_b))


def _circle(values: Array) -> float:
    """The full circle that the numbers of a heading suggest: degrees, radians, or radians converted twice."""
    if _beyond_circle(values):
        return 360.0
    twice = np.deg2rad(2.0 * np.pi)
    return float(twice) if 0.96 * twice < np.ptp(values) < 1.01 * twice else 2.0 * np.pi


def _beyond_circle(values: Array) -> bool:
    return bool(np.abs(values).max() > 2.0 * np.pi + 0.01)


def _change_noise(heading: Signal, window: float) -> float:
    """Noise of a heading's changes, by the second differences at even times, which turns hardly reach [rad]."""
    values = heading.at(np.arange(heading.time[0], heading.time[-1], window), window)
    second = np.abs(np.diff(values, 2))
    second = second[np.isfinite(second)]
    return float(np.median(second)) / 0.6745 / np.sqrt(3.0) if len(second) else 0.0


def _turning(log: Log, config: Config, sensor: str, f: LineFit, noise: float) -> Finding:
    """What a comparison of a heading with the gyro means."""
    name, beyond = NAMES[sensor], sensor != "mag" and _beyond_circle(log[sensor].data[:, 0])
    if f.windows < MIN_WINDOWS or max(f.sd_a, f.sd_b) < ENOUGH_TURNING:
        if beyond:
            largest = np.abs(log[sensor].data[:, 0]).max()
            return Finding(sensor, "warning", f"{name} reaches {largest:.4g} rad; {_if_degrees(sensor)}", "unit")
        return Finding(sensor, "ok", f"too little turning to compare {name} with the gyro")
    numbers = f"slope {f.slope:.3g}, correlation {f.correlation:.2f} over {f.windows} windows"
    if abs(f.correlation) < FOLLOWS and f.sd_a < NOISE_MARGIN * noise:
        return Finding(
            sensor, "ok", f"too little turning, given its noise, to compare {name} with the gyro ({numbers})"
        )
    if abs(f.correlation) < FOLLOWS:
        causes = "hard iron and the mounting" if sensor == "mag" else "its unit, mounting and clock"
        return Finding(
            sensor, "warning", f"{name} does not follow the gyro ({numbers}); check {causes}", "contradiction"
        )
    if 40.0 < abs(f.slope) < 80.0 or 1 / 80.0 < abs(f.slope) < 1 / 40.0:
        cause, remedy = _factor_of_57(log, sensor, f.slope)
        return Finding(sensor, "error", f"{cause} ({numbers}); {remedy}", "unit")
    if f.slope < 0.0:
        cause = "the IMU's z axis points up (imu.mount_rpy_deg)"
        if sensor != "mag":
            cause = f"it counts anticlockwise: {_counting(log, config, sensor)}; or {cause}"
        return Finding(sensor, "warning", f"{name} turns opposite to the gyro ({numbers}): {cause}", "sign")
    if 0.7 < f.slope < 1.4:
        return Finding(sensor, "ok", f"{name} turns with the gyro ({numbers})")
    text = f"{name} turns with the gyro, but not by the same angle ({numbers}); check the units and scales of both"
    return Finding(sensor, "warning", text, "scale")


def _counting(log: Log, config: Config, sensor: str) -> str:
    """What to state of a heading that counts anticlockwise: from east or north, as the fixes show."""
    key = {"vehicle_heading": "attitude" if "vehicle_tilt" in log else "heading"}.get(sensor, sensor)
    stream = log[sensor]
    for kind in ZEROS:
        cells = dict(zip(stream.columns, stream.data.T.copy(), strict=True))
        turn_angles(cells, {key: kind}, log.source)
        turned = replace(stream, data=np.column_stack([cells[name] for name in stream.columns]))
        angle = turned_by(replace(log, streams={**log.streams, sensor: turned}), config, sensor)
        if angle is not None and abs(angle) < FITS:
            return f"state angles: {{{key}: {kind}}}"
    return "state " + " or ".join(f"angles: {{{key}: {kind}}} if its zero is {zero}" for kind, zero in ZEROS.items())


def _factor_of_57(log: Log, sensor: str, slope: float) -> tuple[str, str]:
    """Which of gyro and heading is in the wrong unit, and what to do."""
    fast = float(np.percentile(np.abs(log["imu"].data[:, 3:]), 99))
    name = NAMES[sensor]
    if abs(slope) < 1.0:
        if sensor != "mag" and np.ptp(log[sensor].data[:, 0]) < 2 * np.pi / 50 and fast < 3.0:
            return f"{name} is 57 times too small", "it was probably converted to radians twice: remove it from units:"
        return "the gyro's rates are 57 times too large", "if they are in deg/s, state units: {gyr: deg/s}"
    if sensor != "mag" and _beyond_circle(log[sensor].data[:, 0]):
        return f"{name} is 57 times too large", _if_degrees(sensor)
    return (
        "the gyro's rates are 57 times too small",
        "they were probably converted to rad/s twice: remove gyr from units:",
    )


def _if_degrees(sensor: str) -> str:
    return f"if it is in degrees, state units: {{{sensor.removeprefix('vehicle_')}: deg}}"


def _clock(
    sensor: str, what: str, against: str, found: Lag, limits: MotionLimits, believed: tuple[float, float], remedy: str
) -> Iterator[Finding]:
    """A lag, if there is one that is not believed."""
    if np.isnan(found.seconds):
        return
    later = f"{abs(found.seconds):.2f} s {'later' if found.seconds > 0 else 'earlier'} than {against}"
    sd = f" (sd {found.sd:.2f} s)" if np.isfinite(found.sd) else ""
    if limits.is_late(found.seconds, found.sd, believed) and found.evidence > limits.evidence:
        text = f"{what} comes {later}{sd}: the clocks disagree, or a filter delays it; {remedy}"
        yield Finding(sensor, "warning", text, "lag")
    else:
        yield Finding(sensor, "ok", f"{what} comes {later}{sd}")


def vertical(log: Log, config: Config) -> Iterator[Finding]:
    """The DVL's velocity downwards against the change of depth: unit, sign and clock."""
    if not {"dvl", "depth"} <= log.sensors or not {"imu", "vehicle_tilt"} & log.sensors:
        return
    pings, R_bs = valid_pings(log["dvl"]), mount_matrix(config.dvl.mount_rpy_deg)
    if min(len(pings), len(log["depth"])) < MIN_WINDOWS:
        return
    if (unit := _depth_unit(log, config, pings, R_bs)) is not None:
        yield unit
        return
    depth, dvl, window = _descents(log, config, pings, R_bs)
    f = fit(depth, dvl, window)
    closely = abs(f.correlation) > CLOSELY
    if f.windows < MIN_WINDOWS or max(f.sd_a, f.sd_b if closely else 0.0) < ENOUGH_DIVING:
        yield Finding("dvl", "ok", "depth changes too little to compare the vertical velocity with it")
        return
    numbers = f"slope {f.slope:.2g}, correlation {f.correlation:.2f} over {f.windows} windows"
    if abs(f.correlation) < FOLLOWS:
        if f.sd_a < 2.0 * np.sqrt(2.0) * _depth_noise(depth, config, window):
            yield Finding(
                "dvl", "ok", "depth changes too little, given its noise, to compare the vertical velocity with it"
            )
        elif f.sd_b < 2.0 * f.sd_a:  # noise of the DVL would be larger
            text = f"vertical velocity does not follow depth ({numbers}); check mounting and clock"
            yield Finding("dvl", "warning", text, "contradiction")
        return
    if f.slope < 0.0:
        yield Finding(
            "dvl",
            "warning",
            f"vertical velocity and the change of depth have opposite signs ({numbers}): {other_way_up(config)}; "
            "if depth counts upwards, state units: {depth: -m}",
            "sign",
        )
    else:
        low, high = (0.7, 1.4) if closely else (0.4, 2.5)  # few pings a wave lower the slope
        if low < f.slope < high:
            yield Finding("dvl", "ok", f"vertical velocity agrees with the change of depth ({numbers})")
        else:
            text = f"vertical velocity follows depth, but not by the same amount ({numbers}); check the units of both"
            yield Finding("dvl", "warning", text, "scale")
    found = lag(dvl, depth, window)  # the integral is the less noisy one
    behind = Lag(-found.seconds, found.sd, found.evidence)
    against, believed = "the change of depth", believed_lag(config, "dvl", than="depth")
    yield from _clock("dvl", "vertical velocity", against, behind, DESCENT, believed, "check the clocks of both")


def _depth_unit(log: Log, config: Config, pings: Stream, R_bs: Array) -> Finding | None:
    """That the depth is in another unit, or a pressure, where the DVL sinks as such numbers would; else None."""
    f = fit(*_descents(log, config, pings, R_bs, as_read=True))
    if f.windows < MIN_WINDOWS or f.correlation < CLOSELY or max(f.sd_a, f.sd_b) < ENOUGH_DIVING:
        return None
    ratio = f.sd_b / f.sd_a  # noise of the depth lowers the slope, by a tenth at this correlation
    if not (meant := _other_units(ratio, log, config)):
        return None
    text = f"the DVL sinks {ratio:.3g} times as far: {meant} (correlation {f.correlation:.2f}, {f.windows} windows)"
    return Finding("depth", "warning", text, "unit")


def _other_units(ratio: float, log: Log, config: Config) -> str:
    """Units in which numbers of a depth or a pressure sink as the DVL does, and what to state; "" = none or as read.

    Parameters
    ----------
    ratio : the DVL's way down for a metre of depth
    """

    def fitting(quantity: str, column: str, own: float) -> list[str]:
        units, read_in = UNITS[quantity], config.units.get(column, "").removeprefix("-")
        true = ratio * units.get(read_in, 1.0) / own
        return [unit for unit, factor in units.items() if abs(np.log(factor / true)) < SAME_UNIT]

    if abs(np.log(ratio)) < SAME_UNIT:
        return ""
    if any(note.startswith(BY_PRESSURE) for note in log.notes):
        units = fitting("pressure", "pressure", 1.0)
        return f"if it is in {units[-1]}, state units: {{pressure: {units[-1]}}}" if units else ""
    metres = fitting("length", "depth", 1.0)
    pressures = fitting("pressure", "depth", 1.0 / (density(config) * config.environment.gravity))
    said = [f"if it is in {unit}, state units: {{depth: {unit}}}" for unit in metres[-1:]]
    said += [f"if it is a pressure in {u}, name it pressure and state units: {{pressure: {u}}}" for u in pressures[-1:]]
    return "; ".join(said)


def _descents(
    log: Log, config: Config, pings: Stream, R_bs: Array, as_read: bool = False
) -> tuple[Signal, Signal, float]:
    """Depth of the DVL, its way downwards with a mounting, and the window over which the two are compared [s].

    Or those of the depth sensor, whose depth stays ``as_read``: it may be in another unit than the arm between them.
    """
    way = integral(pings.time, np.sum(rotate(R_bs, pings.data[:, :3]) * _down(log, config, pings.time), axis=1))
    window = max(4.0, 4.0 * float(np.median(np.diff(pings.time))))
    depth, arm_b = without_spikes(log["depth"]), np.subtract(config.dvl.lever_arm_m, config.depth.lever_arm_m)
    if as_read:
        there, way = depth["depth"], way - _down(log, config, pings.time) @ arm_b
    else:
        there = depth["depth"] + _down(log, config, depth.time) @ arm_b
    dvl = Signal(pings.time, way)
    return _without_steps(Signal(depth.time, there), dvl, window), dvl, window


def _down(log: Log, config: Config, time: Array) -> Array:
    """Unit vectors downwards in b, shape (n, 3), by gravity, or without an IMU by roll and pitch."""
    if "imu" in log:
        return downwards(log["imu"], config, time)
    tilt = log["vehicle_tilt"]
    roll, pitch = (np.interp(time, tilt.time, tilt[name]) for name in ("roll", "pitch"))
    return np.column_stack([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])


def _without_steps(depth: Signal, dvl: Signal, window: float) -> Signal:
    """A depth without changes of its zero, which are not motion and do not concern the DVL."""
    change = np.diff(depth.value - dvl.at(depth.time, window))
    usual = float(np.nanmedian(np.abs(change))) if np.isfinite(change).any() else np.inf
    steps = np.where(np.abs(change) > max(LEAST_STEP, STEPS * usual), change, 0.0)  # not where the DVL is lost
    few = np.count_nonzero(steps) <= MOST_STEPS
    return Signal(depth.time, depth.value - np.append(0.0, np.cumsum(steps))) if few else depth


def dives_with_depth(log: Log, config: Config, R_bs: Array) -> float:
    """Correlation of depth with the way downwards by a DVL with a mounting; 0 without depth changes."""
    if "depth" not in log or len(log["depth"]) < MIN_WINDOWS:
        return 0.0
    pings = valid_pings(log["dvl"])
    f = fit(*_descents(log, config, pings, R_bs))
    return f.correlation if f.windows >= MIN_WINDOWS and f.sd_a > ENOUGH_DIVING else 0.0


def _depth_noise(depth: Signal, config: Config, window: float) -> float:
    """Noise of a depth [m]: the configuration's, or what second differences show where that is more."""
    if np.median(np.diff(depth.time)) > window / 4.0:  # they would show the diving
        return config.depth.sd_m
    noise = np.median(np.abs(np.diff(depth.value, 2))) / 0.6745 / np.sqrt(6.0)
    return float(max(config.depth.sd_m, noise))
