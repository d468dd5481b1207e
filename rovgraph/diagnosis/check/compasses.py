"""The vehicle's heading by each compass, and which axes of the magnetometer agree with the gyro.

In the IMU's axes the Earth's field turns as m' = -w x m. With y the measured field, c its hard iron and m = H (y - c)
for a signed permutation H,

    y' = -A w x (y - c),  A = det(H) H',

so H and -H fit equally, which the field's dip decides, and A is a rotation. If A is not a rotation, or turns gravity as
well, the gyro's axes are wrong. Changes over some seconds are compared, with c and the gyro's bias free. In a dive that
turns about one axis only, several A fit equally.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rovgraph.diagnosis.check.findings import Finding
from rovgraph.diagnosis.check.inertial import (
    BIAS_SD,
    GAP,
    GAP_OF_PERIODS,
    InertialMotion,
    in_gap,
    inertial_motion,
    means,
    smoothed,
)
from rovgraph.diagnosis.check.lags import MIN_WINDOWS, ORIENTATIONS, Signal, fit
from rovgraph.diagnosis.check.values import GRAVITY_ANGLE, tilt
from rovgraph.geometry import Array, cross, rotate, skew
from rovgraph.inference.resolve import dip_of_log, field_by_place
from rovgraph.log import Log, Stream
from rovgraph.model.config import Config, beliefs, mount_matrix
from rovgraph.rules import CLIPPED, FOLLOWS
from rovgraph.sensors.compass import declination
from rovgraph.sensors.instruments import OFFSETS, heading_sources
from rovgraph.sensors.magnetometer import EARTH_FIELD

COMPASSES = ("ahrs", "vehicle_heading", "dvl_heading")  # that give a heading themselves
FOLLOWS_GYRO = 10.0  # before and after, over which a magnetometer's heading is averaged against the gyro's [s]
WINDOW = 2.0  # over which the field's change is compared [s]
ENOUGH_WINDOWS = 30
TELLING = 0.3  # of the largest changes, from which on a window distinguishes two axes
EXPLAINED = 0.5  # of the changes' square, that a rotation may leave at most
BETTER = 3.0  # times smaller a square than as configured, which neither noise nor iron makes
SIMILAR = 1.3  # times the least square, up to which two rotations are not distinguished
EVIDENCE = 60.0  # in chi-square
LEVEL = 0.1  # of the field along the vertical, whose sense shows nothing
UPSIDE_DOWN = 0.5  # of the field along the vertical in the wrong sense, which no iron makes
FIELD_SDS, ROCK_NT = 5.0, 250.0  # of what iron does to magnitude and dip, with rock and storms beyond the model
NORMALISED = 0.7, 1.4  # magnitudes of a field without a unit
TROPIC_DEG = 20.0  # of latitude, beyond which the dip has its sign
SAME_HEADING = np.deg2rad(40.0)  # of two compasses, which no offset and no iron exceeds

AS_NAMED = ORIENTATIONS[0]
HANDED = np.linalg.det(ORIENTATIONS) > 0.0


def magnetic_heading(field_b: Array, down_b: Array | None) -> Array:
    """Heading of the field's horizontal part, shape (n,) [rad], from field and vertical (n, 3); None = level."""
    if down_b is None:
        return np.asarray(np.arctan2(-field_b[:, 1], field_b[:, 0]))
    starboard_b = cross(down_b, np.broadcast_to(np.eye(3)[0], down_b.shape))
    forward_b = cross(starboard_b, down_b)
    return np.asarray(np.arctan2(-np.sum(starboard_b * field_b, axis=1), np.sum(forward_b * field_b, axis=1)))


def compass_heading(log: Log, config: Config, sensor: str) -> Array:
    """The body's magnetic heading by one of `COMPASSES`, without jumps, shape (n,) [rad]."""
    mounts = {"ahrs": config.imu.mount_rpy_deg, "dvl_heading": config.dvl.mount_rpy_deg}
    axis = mount_matrix(mounts.get(sensor, (0.0, 0.0, 0.0)))[:, 0]
    return np.asarray(np.unwrap(log[sensor].data[:, 0]) - np.arctan2(axis[1], axis[0]))


def field_of_place(log: Log, config: Config) -> Iterator[Finding]:
    """Magnitude and dip of the measured field against those of the place and the date."""
    field = field_by_place(log) if "mag" in log else None
    if field is None:
        return
    middle, total = float(np.median(np.linalg.norm(log["mag"].data, axis=1))), 1e-3 * field.total_nt
    stated = any(name.startswith("mag") for name in config.units)
    if not middle > 0.0 or (not stated and NORMALISED[0] < middle < NORMALISED[1]):
        return
    in_unit = [middle] if stated else [middle / size * EARTH_FIELD["uT"] for u, size in EARTH_FIELD.items() if u != "1"]
    seen, wrong = min(in_unit, key=lambda size: abs(np.log(size / total))), []
    iron = (beliefs(config)[name].sd for name in ("hard_iron", "soft_iron"))
    limit = FIELD_SDS * math.hypot(*iron, ROCK_NT / field.total_nt)
    if not stated and abs(np.log(seen / total)) > np.log(2.0):
        return  # its unit is not known, which is told already
    said = f"magnitude {seen:.1f} uT where the field is {total:.1f} uT there"
    if abs(seen / total - 1.0) > limit:
        wrong.append(said)
    if "imu" in log and len(log["imu"]) > 1:
        dip = dip_of_log(log)
        said += f", dip {dip:.1f} deg where it is {field.dip_deg:.1f}"
        if abs(dip - field.dip_deg) > np.rad2deg(limit):
            wrong.append(f"dip {dip:.0f} deg where the field's is {field.dip_deg:.0f} deg there")
    if wrong:
        cause = "hard or soft iron, or the scale: calibrate it (rovgraph calibrate magnetometer)"
        yield Finding("mag", "warning", f"{' and '.join(wrong)}, by WMM2025: {cause}", "iron")
    else:
        yield Finding("mag", "ok", f"{said}, by WMM2025")


def body_heading(log: Log, config: Config) -> tuple[str, Array, Array] | None:
    """The compass that gives the body's true heading best, its times and headings without jumps [rad].

    One that is in use goes first, and of these one that gives a heading itself. That of a magnetometer is levelled by
    the IMU, freed of hard iron within its prior, and follows the gyro from moment to moment.
    """
    used = heading_sources(config, log.sensors)
    for sensor in sorted((*COMPASSES, "mag"), key=lambda sensor: (sensor not in used, sensor == "mag")):
        if sensor not in log or len(log[sensor]) < 2:
            continue
        if sensor != "mag":
            found: tuple[Array, Array] | None = log[sensor].time, compass_heading(log, config, sensor)
        else:
            found = _by_field(log, config)
        if found is not None:
            offset = float(beliefs(config)[OFFSETS[sensor]].mean[0])
            return sensor, found[0], found[1] - offset + declination(config, sensor)
    return None


def _by_field(log: Log, config: Config) -> tuple[Array, Array] | None:
    """Times and magnetic headings of the body by the magnetometer [rad]; None where its axes are wrong."""
    stream, R_bs = log["mag"], mount_matrix(config.imu.mount_rpy_deg)
    motion, iron = inertial_motion(log, config), beliefs(config)["hard_iron"]
    if motion is None:
        return stream.time, np.unwrap(magnetic_heading(rotate(R_bs, stream.data), None))
    sd = iron.sd if iron.estimate else 0.0
    found = turning(motion, stream, stream.data, R_bs.T, sd, ORIENTATIONS[:1])
    if found is not None and found.square[0] > EXPLAINED:
        every = turning(motion, stream, stream.data, R_bs.T, offset_sd=1.0)
        if every is not None and every.contradicted:
            return None
    down_b = motion.at(stream.time, motion.down_b)
    field_b = field_in_body(log, config, down_b, np.zeros(3) if found is None else found.offset[0])
    by_gyro = np.cumsum(motion.turning) * motion.step
    apart = np.unwrap(magnetic_heading(field_b, down_b) - np.interp(stream.time, motion.time, by_gyro))
    known = ~in_gap(motion.time, stream.time, 2.0 * FOLLOWS_GYRO)
    slow = smoothed(np.interp(motion.time, stream.time, apart)[:, None], known, FOLLOWS_GYRO, motion.step)
    return motion.time[known], (by_gyro + slow[:, 0])[known]


@dataclass(frozen=True)
class TurningFit:
    """How well a vector that is constant in n turns with the gyro, for each of m orientations as A, `ORIENTATIONS`.

    Attributes
    ----------
    square : ndarray, shape (m,), mean squared residual, relative to that without any turn
    offset : ndarray, shape (m, 3), constant part of the measured vector that does not turn
    windows : how many change enough to be used
    """

    square: Array
    offset: Array
    windows: int

    @property
    def alike(self) -> NDArray[np.int64]:
        """The best of `ORIENTATIONS`, and those that fit equally; empty where it explains too little."""
        best = float(self.square.min())
        return np.flatnonzero((self.square <= SIMILAR * best) & (best < EXPLAINED))

    @property
    def contradicted(self) -> bool:
        """Whether the rates as they are, the first of `ORIENTATIONS`, are clearly not the right ones."""
        better = float(self.square[0] / self.square.min())
        return bool(len(self.alike) and better > BETTER and 3.0 * self.windows * np.log(better) > EVIDENCE)


def turning(
    motion: InertialMotion, stream: Stream, values: Array, R_sb: Array, offset_sd: float, every: Array = ORIENTATIONS
) -> TurningFit | None:
    """Compare the changes of a vector with its rates; None where there is too little.

    Parameters
    ----------
    values : ndarray, shape (n, 3), of a stream, IMU axes
    R_sb : ndarray, shape (3, 3), body axes to IMU axes
    offset_sd : how large a part of it may be that does not turn, as a fraction of its length; 0 = none
    every : ndarray, shape (m, 3, 3), what is tried as A
    """
    edges = np.append(motion.time - 0.5 * motion.step, motion.time[-1] + 0.5 * motion.step)
    y, w = means(stream, values, edges), rotate(R_sb, motion.rate_b)
    period = float(np.median(np.diff(stream.time)))
    known = motion.known & ~in_gap(motion.time, stream.time, max(GAP, GAP_OF_PERIODS * period))
    steps = max(1, round(max(WINDOW, 3.0 * period) / motion.step))
    count = len(y) // steps
    begin = np.arange(count) * steps
    whole = np.logical_and.reduceat(known, begin) if count else np.zeros(0, bool)
    pair = np.flatnonzero(whole[1:] & whole[:-1])
    if len(pair) < ENOUGH_WINDOWS:
        return None
    rates = np.column_stack([(w[:, :, None] * y[:, None, :]).reshape(-1, 9), w, y])
    sums = np.vstack([np.zeros(15), np.cumsum(0.5 * motion.step * (rates[1:] + rates[:-1]), axis=0)])
    middle = np.column_stack([sums, y])[: count * steps].reshape(count, steps, 18).mean(axis=1)
    over = middle[pair + 1] - middle[pair]
    wy, turn, total, change = over[:, :9].reshape(-1, 3, 3), over[:, 9:12], over[:, 12:15], over[:, 15:]
    seconds = np.broadcast_to(steps * motion.step * np.eye(3), (len(pair), 3, 3))
    moved = np.linalg.norm(change, axis=1)
    telling = moved > TELLING * np.percentile(moved, 98)
    size = float(np.linalg.norm(y, axis=1).mean())
    still, _ = _fit(change, seconds * BIAS_SD * size, telling)
    square, offset = np.empty(len(every)), np.zeros((len(every), 3))
    for k, A in enumerate(every):
        of_rate = A @ wy
        crossed = np.stack([of_rate[:, i, j] - of_rate[:, j, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1)
        # free are, in sds of a prior, the gyro's bias, the offset, and the product of both
        J = [skew(total) * BIAS_SD]
        if offset_sd > 0.0:
            J += [skew(rotate(A, turn)) * offset_sd * size, seconds * BIAS_SD * offset_sd * size]
        square[k], free = _fit(change + crossed, np.concatenate(J, axis=2), telling)
        offset[k] = offset_sd * size * free[3:6] if offset_sd > 0.0 else 0.0
    return TurningFit(square / max(still, 1e-12), offset, int(telling.sum()))


def _fit(left: Array, J: Array, telling: NDArray[np.bool_]) -> tuple[float, Array]:
    """Mean square residual of a fit, (m, 3), where it changes enough, large ones clipped; and its result [sds]."""
    keep, variance = np.ones(len(left), dtype=bool), 0.0
    for _ in range(2):
        rows = J[keep].reshape(-1, J.shape[2])
        H = rows.T @ rows
        prior = np.eye(len(H)) * max(variance, 1e-9 * float(np.trace(H)))
        found = np.linalg.solve(H + prior, rows.T @ left[keep].ravel())
        squares = np.sum((left - J @ found) ** 2, axis=1)
        limit = CLIPPED**2 * float(np.median(squares[telling]))
        keep, variance = squares <= limit, limit / CLIPPED**2 / 3.0
    return float(np.minimum(squares, limit)[telling].mean()), np.asarray(found, float)


def field_axes(log: Log, config: Config, motion: InertialMotion) -> Iterator[Finding]:
    """Axes of magnetometer or gyro that contradict the field's turning or its dip, with what mends them."""
    R_sb = mount_matrix(config.imu.mount_rpy_deg).T
    field = turning(motion, log["mag"], log["mag"].data, R_sb, offset_sd=1.0)
    if field is None or not len(field.alike):
        return
    if not field.contradicted:
        down_b = motion.at(log["mag"].time, motion.down_b)
        field_b = field_in_body(log, config, down_b, field.offset[0])
        freed_b = rotate(R_sb.T, log["mag"].data - field.offset[0])  # of all iron, as far as tilts show it
        right = _dip_sense(log, config)
        if field.alike[0] == 0 and max(right * _dips(b, down_b) for b in (field_b, freed_b)) < -UPSIDE_DOWN:
            sense = "upwards" if right > 0.0 else "downwards"
            wrong = f"the field points {sense}, which it does not at this latitude, and turns with the gyro as well"
            yield _of_magnetometer(log, config, motion, field, wrong)
        return
    gravity = turning(motion, log["imu"], log["imu"].data[:, :3], R_sb, offset_sd=0.0)
    better = f"{_times(float(field.square[0] / field.square.min()))} better"
    if gravity is not None and gravity.contradicted and np.isin(gravity.alike, field.alike).all():
        yield _of_gyro(config, gravity.alike, f"gravity and the field turn with the rates {better}")
    elif not HANDED[field.alike].any():
        yield _of_gyro(config, field.alike, f"the field turns with the rates {better}")
    elif compass := _opposite_compass(log, config, motion):
        yield _of_gyro(config, field.alike, f"{compass} and the field turn with the rates {better}")
    else:
        yield _of_magnetometer(log, config, motion, field, f"the field turns with the gyro {better}")


def _opposite_compass(log: Log, config: Config, motion: InertialMotion) -> str:
    """A compass that turns opposite to the gyro, too; "" without one."""
    by_gyro = Signal(motion.time, np.cumsum(motion.turning) * motion.step)
    for sensor in COMPASSES:
        if sensor in log and len(log[sensor]) >= MIN_WINDOWS:
            heading = Signal(log[sensor].time, compass_heading(log, config, sensor))
            if fit(by_gyro, heading, max(WINDOW, 3.0 * float(np.median(np.diff(heading.time))))).correlation < -FOLLOWS:
                return sensor
    return ""


def _of_gyro(config: Config, alike: NDArray[np.int64], better: str) -> Finding:
    """Rates that are named otherwise, with the columns and signs that mend them: those that change least."""
    A = max(ORIENTATIONS[alike], key=np.trace)
    columns, units = {}, {}
    for name, row in zip(("gyr_x", "gyr_y", "gyr_z"), A, strict=True):
        other = f"gyr_{'xyz'[int(np.abs(row).argmax())]}"
        unit = config.units.get(other, config.units.get("gyr", "rad/s"))
        if other != name:
            columns[name] = config.columns.get(other, other)
        if row.min() < 0.0:
            units[name] = unit.removeprefix("-") if unit.startswith("-") else f"-{unit}"
        elif other != name:
            units[name] = unit
    entries = {"columns": columns, "units": units}
    stated = [f"{key}: {{{', '.join(f'{a}: {b}' for a, b in new.items())}}}" for key, new in entries.items() if new]
    text = f"{better} if its rates are {_named('gyr', A)}: state {' and '.join(stated)}"
    if len(alike) > 1:
        text += ". As the vehicle turns about one axis only, the signs of the other rates may be wrong, too"
    return Finding("imu", "warning", text, "axes")


def _times(ratio: float) -> str:
    return f"{ratio:.1f} times" if ratio < 100.0 else "more than 100 times"


def _named(sensor: str, H: Array) -> str:
    """What a signed permutation makes of three columns."""
    return ", ".join("-" * int(row.min() < 0.0) + f"{sensor}_{'xyz'[int(np.abs(row).argmax())]}" for row in H)


def _of_magnetometer(log: Log, config: Config, motion: InertialMotion, field: TurningFit, better: str) -> Finding:
    """Axes of the magnetometer that are named otherwise, with the matrix that mends them."""
    H, sure = _orientation(log, config, motion, field)
    matrix = (H @ np.array(config.imu.mag.matrix) + 0.0).round(6).tolist()
    text = f"{better} if its axes are {_named('mag', H)}: state imu.mag.matrix: {matrix}"
    if not sure:
        text += (
            ". As the vehicle turns about one axis only, other axes fit as well, whose heading differs by 90 or 180 "
            "deg, and so do rates of the gyro that are reversed: compare with a known heading"
        )
    return Finding("mag", "warning", text, "axes")


def _orientation(log: Log, config: Config, motion: InertialMotion, field: TurningFit) -> tuple[Array, bool]:
    """H of the field, and whether turning, dip and other compasses leave no other.

    Several are left where the vehicle turns about one axis: then it is the one that changes least.
    """
    down_b, sense = motion.at(log["mag"].time, motion.down_b), _dip_sense(log, config) or 1.0
    found = []
    for k in field.alike[HANDED[field.alike]]:
        for H in (ORIENTATIONS[k].T, -ORIENTATIONS[k].T):
            field_b = field_in_body(log, config, down_b, field.offset[k], H)
            right = sense * _dips(field_b, down_b) > -LEVEL
            same = _same_heading(log, config, magnetic_heading(field_b, down_b))
            found.append((right, same, float(np.trace(H)), H))
    left = sum(right and same for right, same, *_ in found)
    return max(found, key=lambda one: one[:3])[3], left == 1 and bool(HANDED[field.alike].all())


def field_in_body(log: Log, config: Config, down_b: Array, offset: Array, H: Array = AS_NAMED) -> Array:
    """The field in body axes, its own axes renamed by H, without the level part of its hard iron; shape (n, 3).

    Of the other part, turns about the vertical show only the gyro's noise.

    Parameters
    ----------
    down_b : ndarray, shape (n, 3)
    offset : ndarray, shape (3,), hard iron along its own axes
    """
    R = mount_matrix(config.imu.mount_rpy_deg) @ H
    vertical_b = down_b.mean(axis=0) / np.linalg.norm(down_b.mean(axis=0))
    iron_b = R @ offset
    return np.asarray(rotate(R, log["mag"].data) - iron_b + (iron_b @ vertical_b) * vertical_b)


def _dips(field_b: Array, down_b: Array) -> float:
    """How much of a field points downwards, -1 to 1."""
    return float(np.sum(field_b * down_b) / max(float(np.linalg.norm(field_b, axis=1).sum()), 1e-12))


def _dip_sense(log: Log, config: Config) -> float:
    """1 where the Earth's field is known to point downwards, -1 where upwards, else 0, as where down is not known."""
    env = config.environment
    if tilt(log, config) > GRAVITY_ANGLE:
        return 0.0
    if env.dip_deg is not None:
        return float(np.sign(env.dip_deg))
    places = (env.latitude_deg, env.origin_lat_deg, None if log.origin is None else log.origin[0])
    latitude = next((place for place in places if place is not None), 0.0)
    return float(np.sign(latitude)) if abs(latitude) > TROPIC_DEG else 0.0


def _same_heading(log: Log, config: Config, psi: Array) -> bool:
    """Whether headings of the magnetometer are those of the other compasses, about; True without one."""
    for sensor in COMPASSES:
        if sensor in log and len(log[sensor]) > 1:
            other = np.interp(log["mag"].time, log[sensor].time, compass_heading(log, config, sensor))
            return bool(abs(np.angle(np.exp(1j * (psi - other)).mean())) < SAME_HEADING)
    return True
