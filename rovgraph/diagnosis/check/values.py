"""Values of each sensor by itself: gravity, units, ranges, bottom lock, and invalid measurements."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rovgraph.diagnosis.check.findings import Finding, since
from rovgraph.geometry import Array
from rovgraph.log import Log, Stream
from rovgraph.log.frozen import HOLDS, FrozenStretch, Runs, frozen_stretches, repeats
from rovgraph.model.config import Config, mount_matrix
from rovgraph.sensors import SENSORS, Level

GRAVITY_RANGE = (9.3, 10.3)  # plausible mean specific force [m/s2]
GRAVITY_ANGLE = np.deg2rad(25.0)  # of mean specific force from upwards
EXACT = 1e-9  # spread of velocities without noise [m/s]
FAST_TURN = 3.0  # no vehicle of this kind turns faster for long [rad/s]
FAST_SPIKE = 10.0  # nor for a moment [rad/s]
CLIPPED = 10  # samples at one extreme, which noise does not make
PILED = 3.0  # times as many as at any of the values next to it
NEAR = 5  # values
STEPS = 3.0  # of the resolution, by which the samples around them are away
RANGES = {"acc": (2.0, 4.0, 8.0, 16.0, 32.0), "gyr": (125.0, 250.0, 500.0, 1000.0, 2000.0)}  # of usual IMUs [g, deg/s]
LIKE_A_RANGE = 0.03  # of it
STANDARD_GRAVITY = 9.80665  # [m/s2]
# specific force along this IMU axis, at rest -> mounting that turns it upwards
UPRIGHT = {
    "+x": (0, 90, 0),
    "-x": (0, -90, 0),
    "+y": (-90, 0, 0),
    "-y": (90, 0, 0),
    "+z": (180, 0, 0),
    "-z": (0, 0, 0),
}


def gravity(log: Log, config: Config) -> Iterator[Finding]:
    """Mean specific force: about 9.8 m/s2, upwards in body axes."""
    if "imu" not in log:
        return
    f_s = log["imu"].data[:, :3].mean(axis=0)
    size = _usual_force(log["imu"])
    low, high = GRAVITY_RANGE
    if not low <= size <= high:
        level: Level = "warning" if 5.0 < size < 15.0 else "error"
        text = f"mean specific force is {size:.4g} m/s2, expected about 9.8; {_acc_unit(size)}"
        yield Finding("imu", level, text, "unit")
    if size < 1e-6:
        return
    angle = tilt(log, config)
    k = int(np.argmax(np.abs(f_s)))
    axis = ("-" if f_s[k] < 0 else "+") + "xyz"[k]
    if angle > GRAVITY_ANGLE:
        yield Finding(
            "imu",
            "warning",
            f"mean specific force points {np.rad2deg(angle):.0f} deg away from upwards (-z of the body): it is on the "
            f"IMU's {axis} axis; check imu.mount_rpy_deg, probably {list(UPRIGHT[axis])} with the yaw of your IMU",
            "axes",
        )
    elif low <= size <= high:
        yield Finding("imu", "ok", f"mean specific force {size:.2f} m/s2, {np.rad2deg(angle):.1f} deg from upwards")


def _usual_force(imu: Stream) -> float:
    """Size of the specific force of a second, the median: a vehicle that rolls over has a smaller mean vector."""
    count = max(1, round(1.0 / max(float(np.median(np.diff(imu.time))), 1e-6))) if len(imu) > 1 else 1
    begins = np.arange(0, max(len(imu) - count + 1, 1), count)
    sums = np.add.reduceat(imu.data[: begins[-1] + count, :3], begins)
    return float(np.median(np.linalg.norm(sums, axis=1))) / min(count, len(imu))


def tilt(log: Log, config: Config) -> float:
    """Angle of the mean specific force from upwards [rad]."""
    f_s = log["imu"].data[:, :3].mean(axis=0)
    f_b = mount_matrix(config.imu.mount_rpy_deg) @ f_s
    return float(np.arccos(np.clip(-f_b[2] / max(float(np.linalg.norm(f_s)), 1e-9), -1.0, 1.0)))


def _acc_unit(size: float) -> str:
    for unit, g in (("g", 1.0), ("mg", 1000.0)):
        if 0.9 < size / g < 1.1:
            return f"if acc is in {unit}, state units: {{acc: {unit}}}"
    return "gravity seems to be removed: give specific force" if size < 1.0 else "check the unit of acc"


def turn_rates(log: Log, config: Config) -> Iterator[Finding]:
    """Rates that no small vehicle reaches."""
    if "imu" not in log:
        return
    rate = np.linalg.norm(log["imu"].data[:, 3:], axis=1)
    usual, fast = float(np.percentile(rate, 90)), int((rate > FAST_SPIKE).sum())
    if usual > FAST_TURN:
        yield Finding(
            "imu",
            "error",
            f"a tenth of the rates is above {usual:.3g} rad/s ({np.rad2deg(usual):.0f} deg/s); "
            "if they are in deg/s, state units: {gyr: deg/s}",
            "unit",
        )
    elif fast:
        when = since(log, log["imu"].time[np.argmax(rate > FAST_SPIKE)])
        text = f"{fast} rates above {FAST_SPIKE:g} rad/s, first at {when}: spikes, or a wrong unit"
        yield Finding("imu", "warning", text, "spikes")
    if not np.ptp(log["imu"].data[:, 3:], axis=0).any():
        if _without_noise(log):
            text = "IMU and DVL never change, as simulated without noise; if they are real, check their connection"
            yield Finding("imu", "warning", text, "frozen")
        else:
            yield Finding("imu", "error", "the gyro's values never change; check its connection", "stuck")


def _without_noise(log: Log) -> bool:
    """Whether the signals of IMU and DVL are those of a steady motion without noise."""
    constant = not np.ptp(log["imu"].data, axis=0).any()
    velocity = log["dvl"].data[:, :3] if "dvl" in log else np.empty((0, 3))
    return bool(constant and len(velocity) > 2 and velocity.any() and np.ptp(velocity, axis=0).max() < EXACT)


def angles(log: Log, config: Config) -> Iterator[Finding]:
    """Roll and pitch that are not in radians; headings are compared with the gyro elsewhere."""
    if "ahrs" not in log:
        return
    tilt = np.abs(log["ahrs"].data[:, 1:])
    largest = float(np.max(tilt, initial=0.0, where=np.isfinite(tilt)))
    if largest > np.pi + 0.01:
        yield Finding(
            "ahrs",
            "error",
            f"roll or pitch reaches {largest:.4g} rad; if they are in degrees, state units: {{ahrs: deg}}",
            "unit",
        )


def own(log: Log, config: Config) -> Iterator[Finding]:
    """What each sensor finds in its own values."""
    for sensor, stream in log.streams.items():
        for finding in SENSORS[sensor].look(stream.data, config):
            yield Finding(sensor, *finding)


def frozen_imu(log: Log, config: Config) -> Iterator[Finding]:
    """An accelerometer or gyro that repeats one value; other sensors are looked at together with the motion."""
    if "imu" not in log:
        return
    for name, first in (("acc", 0), ("gyr", 3)):
        runs = Runs.of(log["imu"].time, log["imu"].data[:, first : first + 3])
        stuck = runs.take(runs.are_long(HOLDS["imu"]))
        if not len(stuck.count):
            continue
        k = int(np.argmax(stuck.last - stuck.first))
        text = f"{name} repeats one value exactly for {stuck.last[k] - stuck.first[k]:.1f} s from "
        text += f"{since(log, stuck.first[k])} on ({len(stuck.count)} such intervals); a working sensor always shows "
        yield Finding("imu", "warning", f"{text}noise: check its connection and driver", "stuck")


def saturated(log: Log, config: Config) -> Iterator[Finding]:
    """Accelerometer or gyro whose samples pile up at one extreme: what is beyond its range is cut off."""
    if "imu" not in log:
        return
    imu = log["imu"]
    for name, first, unit in (("acc", 0, "m/s2"), ("gyr", 3, "rad/s")):
        data = imu.data[:, first : first + 3]
        ends = [
            (f"{name}_{axis} at {data[at[0], k]:.4g} {unit} in {len(at)} samples", at)
            for k, axis in enumerate("xyz")
            for values in (data[:, k], -data[:, k])
            if len(at := _piled_up(values, data))
        ]
        if not ends:
            continue
        ends.sort(key=lambda end: -len(end[1]))
        begin = min(int(at[0]) for _, at in ends)
        limit = max(float(np.abs(data[at[0]]).max()) for _, at in ends)
        text = f"{name} is clipped{_like_a_range(name, limit)}: {', '.join(said for said, _ in ends)}, first at "
        text += f"{since(log, imu.time[begin])}; the rest is lost: set a larger range, or damp what shakes the IMU"
        yield Finding("imu", "warning", text, "saturated")


def _piled_up(values: Array, data: Array) -> NDArray[np.int64]:
    """Which of n values are the largest and pile up there, as those of a clipped signal do; else none.

    Of equal values that a coarse resolution makes, the neighbours in time are within a few of its steps.
    """
    largest = values == values.max()
    none = np.empty(0, dtype=np.int64)
    if np.count_nonzero(largest) < CLIPPED:
        return none
    fresh = ~repeats(data)  # a sample that is held is one
    at = np.flatnonzero(largest & fresh)
    levels, counts = np.unique(values[~largest & fresh], return_counts=True)
    if len(at) < CLIPPED or len(levels) < NEAR or len(at) < PILED * counts[-NEAR:].max():
        return none
    around = np.concatenate([at[at > 0] - 1, at[at < len(values) - 1] + 1])
    away = values[at[0]] - values[around[~largest[around]]]
    return at if np.median(away) > STEPS * np.median(np.diff(levels)) else none


def _like_a_range(name: str, limit: float) -> str:
    """The usual range with this limit, in brackets; "" without one."""
    unit, size = ("g", STANDARD_GRAVITY) if name == "acc" else ("deg/s", float(np.deg2rad(1.0)))
    near = [a for a in RANGES[name] if abs(limit / size - a) < LIKE_A_RANGE * a]
    return f" ({near[0]:g} {unit})" if near else ""


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
    """Invalid measurements of each sensor, a line for each kind; ``frozen`` is that of the log, where it is known."""
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
