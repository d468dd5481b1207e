"""The DVL against the IMU by their accelerations: axes, mounting, clock, and jumps of a clock.

The check needs neither heading nor depth.
"""

from collections.abc import Iterator

import numpy as np

from rovgraph.diagnosis.check.acceleration import BETTER, AccelerationFit, DvlAgainstImu, Search
from rovgraph.diagnosis.check.agreement import dives_with_depth
from rovgraph.diagnosis.check.clocks import Examined, compare, find_jump
from rovgraph.diagnosis.check.findings import Finding, believed_lag, valid_pings
from rovgraph.diagnosis.check.lags import ORIENTATIONS
from rovgraph.geometry import Array, log_rotation
from rovgraph.log import Log
from rovgraph.log.units import UNITS
from rovgraph.model.config import Config, beliefs, mount_matrix
from rovgraph.problem.beams import ENOUGH, ONE_PING_S, PingsByBeams, beam_sensors, head_against_velocity, nearest
from rovgraph.rules import ACCELERATION, SURE, remedy_of_lag
from rovgraph.sensors import Level
from rovgraph.sensors.dvl import LOCKED, axes_remedy
from rovgraph.sensors.dvl import VELOCITIES as PING
from rovgraph.sensors.dvl_beam import BEAMS, beam_geometry, beams_of
from rovgraph.sensors.instruments import instruments
from rovgraph.sensors.water_layer import CELLS, VELOCITIES

FARTHEST_M = 2000.0  # that a DVL of 38 kHz reaches
CHANGE_S, CHANGE_M, TOGETHER = 5.0, 0.2, 0.7  # over which range and depth change, by how much, and correlation
SIMILAR = 1.1  # times the least error, up to which two orientations are not distinguished
SIMPLER = 1.3  # times larger an error that a simpler explanation may leave
APART = 0.15  # that search and fit may be apart [s]
TURNED = np.deg2rad(30.0)  # a large error of the mounting; steady circles confuse smaller ones with a lag


def dvl_and_imu(log: Log, config: Config, examined: Examined | None = None) -> Iterator[Finding]:
    """Axes, mounting and clock of the DVL, by the IMU's accelerations; ``examined`` is of `bridge_jumps`."""
    compared = compare(log, config) if examined is None else examined.compared
    if compared is None:
        return
    jump = find_jump(log, compared) if examined is None else examined.jump
    if jump is not None:
        yield jump.finding(log)
    else:
        yield from beside_imu(log, config, compared)


def beside_imu(log: Log, config: Config, compared: DvlAgainstImu, sensor: str = "dvl") -> Iterator[Finding]:
    """Axes, mounting and clock of velocities that move as the vehicle does, the log's pings; ``sensor`` has them."""
    found = compared.search()
    if np.isfinite(found.error).sum() == 0:
        return
    if (earth := _earth_axes(compared, found, sensor)) is not None:
        yield earth
        return
    k, m = _explanation(found)
    if found.agreement[k, m] < ACCELERATION.follows:
        yield Finding(sensor, "ok", "too little acceleration to compare its axes and clock with the IMU")
        return
    if k:
        k = _upright(log, config, found, m)
    fit = compared.refine(float(found.lags[m]), ORIENTATIONS[k])
    if fit is None:
        return
    better = found.error[0, found.now] / found.error[k, m]
    better = f"corrected, its acceleration agrees {better:.1f} times better with the IMU's"
    yield _mounting(config, k, fit, better, sensor)
    yield _clock(config, compared, ORIENTATIONS[k], fit, float(found.lags[m]), sensor)


def beams(log: Log, config: Config) -> Iterator[Finding]:
    """The DVL's beams against the velocities of the same pings, which ``dvl.use: auto`` takes where they differ."""
    if BEAMS not in log or beam_geometry(config.dvl) is None or config.dvl.use == "velocity":
        return
    if (found := head_against_velocity(config, log.streams)) is None:
        yield Finding(BEAMS, "ok", "no velocity of a ping contradicts its beams as configured")
    else:
        kind = found.kind if config.dvl.use == "beams" else ""
        yield Finding(BEAMS, "warning", f"{found.text}: {found.remedy}", kind)
    if beam_sensors(config, log.streams)[0]:
        share = _carried(log, config)
        level: Level = "ok" if share >= LOCKED else "warning"
        text = f"{share:.1%} of {len(log[BEAMS])} pings have a velocity or two beams that are used"
        yield Finding(BEAMS, level, text, "bottom lock")


def _carried(log: Log, config: Config) -> float:
    """Share of the pings of beams that are used, by their velocity or by two beams or more."""
    made, _ = PingsByBeams(config, instruments(config)).of_log(log.streams)
    used, count = np.unique(np.concatenate([stream.time for stream in made]), return_counts=True)
    time = log[BEAMS].time
    carried = np.isin(time, used[count >= 2])
    pings = valid_pings(log["dvl"]) if "dvl" in log and config.dvl.use == "auto" else None
    if pings is not None and len(pings):
        carried |= np.abs(pings.time[nearest(pings.time, time)] - time) < ONE_PING_S
    return float(carried.mean())


def ranges(log: Log, config: Config) -> Iterator[Finding]:
    """Ranges of beams against its altitude: unit, and whether they are along the beam or straight down.

    Without altitude, against the depth: over a bottom without steps the one grows as the other shrinks.
    """
    geometry = beam_geometry(config.dvl)
    if geometry is None or BEAMS not in log:
        return
    beams, cosine = beams_of(log[BEAMS].data, geometry.numbers), abs(float(geometry.directions[:, 2].mean()))
    beside = "dvl_altitude" if "dvl_altitude" in log else "depth"
    for name, other, measured, expected in (
        ("range", "distance", beams.range, 1.0 / cosine),
        ("distance", "range", beams.distance, cosine),
    ):
        mean = measured.mean(axis=1)  # of whole pings: in the mean of all beams a slope and a tilt cancel
        known = mean[np.isfinite(mean)]
        ratio = (_to_altitude if beside == "dvl_altitude" else _to_depth)(log, mean)
        if ratio is None:
            if len(known) and np.median(known) > FARTHEST_M:
                text = f"dvl_beam_{name}_K is {np.median(known):.4g} m in the median, farther than a DVL reaches"
                yield Finding(BEAMS, "warning", f"{text}: if it is in millimetres, state units: {{dvl_beam_range: mm}}")
            continue
        text = f"dvl_beam_{name}_K {'is' if beside == 'dvl_altitude' else 'changes by'} {ratio:.3g} times {beside}"
        right = 1.0 / cosine if name == "range" else 1.0
        along = abs(np.log(ratio * expected / right)) < 0.25 * abs(np.log(cosine))
        if along and beside == "dvl_altitude":
            yield Finding(BEAMS, "warning", f"{text}, as {other}s are: name the columns {other}_K")
        elif abs(np.log(ratio / right)) > np.log(2.0):
            unit = next((u for u, factor in UNITS["length"].items() if abs(np.log(ratio * factor / right)) < 0.3), None)
            remedy = "check their columns" if unit is None else f"state units: {{dvl_beam_range: {unit}}}"
            yield Finding(BEAMS, "warning", f"{text}, expected {right:.3g}: {remedy}")


def _to_altitude(log: Log, mean: Array) -> float | None:
    """Ratio of the mean range of each ping, shape (n,), to the altitude; None with too few."""
    time, altitude = log[BEAMS].time, log["dvl_altitude"]
    near = nearest(altitude.time, time)
    high = altitude.data[near, 0]
    usable = (np.abs(altitude.time[near] - time) < ONE_PING_S) & (high > 0.0) & np.isfinite(mean)
    return float(np.median(mean[usable] / high[usable])) if np.count_nonzero(usable) >= ENOUGH else None


def _to_depth(log: Log, mean: Array) -> float | None:
    """Ratio of the changes of the mean range to those of the depth, upwards; None where they do not go together."""
    known = np.isfinite(mean)
    if "depth" not in log or min(int(known.sum()), len(log["depth"])) < ENOUGH:
        return None
    time, far = log[BEAMS].time[known], mean[known]
    later = np.searchsorted(time, time + CHANGE_S)
    first = np.flatnonzero(later < len(time))
    sunk = np.interp(time, log["depth"].time, log["depth"]["depth"])
    deeper, nearer = sunk[later[first]] - sunk[first], far[first] - far[later[first]]
    if len(first) < ENOUGH or deeper.std() < CHANGE_M or np.corrcoef(deeper, nearer)[0, 1] < TOGETHER:
        return None
    return float(deeper @ nearer / (deeper @ deeper))


def _earth_axes(compared: DvlAgainstImu, found: Search, sensor: str) -> Finding | None:
    """Whether the velocities are along Earth's axes."""
    turning, best = compared.turning(), float(found.agreement.max())
    if turning is None or turning.not_at_all < ACCELERATION.follows:
        return None
    best = max(best, turning.with_vehicle)
    if 1.0 - best < BETTER * (1.0 - turning.not_at_all):
        return None
    text = (
        "its velocities are along axes that do not turn with the vehicle, as Earth's: so taken they agree with the "
        f"IMU's acceleration (agreement {turning.not_at_all:.2f}, {best:.2f} along the vehicle's): log the DVL's own "
        "axes (instrument or ship coordinates)"
    )
    return Finding(sensor, "warning", text, "axes")


def _explanation(found: Search) -> tuple[int, int]:
    """Orientation and lag, by their indices: as configured unless another is far better, and one of the two if it does.

    A dive's legs are similar, so shifted or turned they may agree almost as well as when they are right.
    """
    both = np.unravel_index(int(np.argmin(found.error)), found.error.shape)
    axes, lag = int(np.argmin(found.error[:, found.now])), int(np.argmin(found.error[0]))
    least = found.error[both]
    if found.error[0, found.now] < BETTER * least or found.agreement[both] < ACCELERATION.follows:
        near = np.abs(found.lags) <= 1.0  # small lags do not make errors twice as large
        return 0, int(np.flatnonzero(near)[np.argmin(found.error[0, near])])
    if found.error[0, lag] < SIMPLER * least:
        return 0, lag
    if found.error[axes, found.now] < SIMPLER * least:
        return axes, found.now
    return int(both[0]), int(both[1])


def _upright(log: Log, config: Config, found: Search, m: int) -> int:
    """The one to believe of orientations that agree equally well, as both senses of the vertical do on a level dive.

    Depth decides; where it shows nothing, an instrument is rather mounted in another way than left-handed.
    """
    error = found.error[:, m]
    similar = np.flatnonzero(error < SIMILAR * error.min())
    R_bs = mount_matrix(config.dvl.mount_rpy_deg)
    by_depth = [dives_with_depth(log, config, R_bs @ ORIENTATIONS[k]) for k in similar]
    if max(by_depth) > ACCELERATION.follows:
        return int(similar[int(np.argmax(by_depth))])
    handed = np.linalg.det(ORIENTATIONS[similar]) > 0.0
    chosen = similar[handed] if handed.any() else similar
    return int(chosen[int(np.argmin(error[chosen]))])


def _mounting(config: Config, k: int, fit: AccelerationFit, better: str, sensor: str) -> Finding:
    """Whether the mounting of a fit is that of the configuration."""
    R_bs = mount_matrix(config.dvl.mount_rpy_deg)
    turn = log_rotation((fit.R_bs @ (R_bs @ ORIENTATIONS[k]).T)[None])[0]
    yaw = beliefs(config)["dvl_yaw"]
    believed = np.array([0.0, 0.0, yaw.sd if yaw.estimate else 0.0])
    turned = bool((np.abs(turn) > np.maximum(TURNED, SURE * np.hypot(fit.turn_sd, believed))).any())
    if k == 0 and not turned:
        return Finding(
            sensor, "ok", f"its acceleration agrees with the IMU's, axes as configured (agreement {fit.agreement:.2f})"
        )
    names = VELOCITIES if sensor == CELLS else PING
    if turned and np.linalg.det(fit.R_bs) > 0.0:
        cause, remedy = axes_remedy(np.eye(3), fit.R_bs, names)
        better = "its acceleration shows this" if k == 0 else better
    else:
        cause, remedy = axes_remedy(ORIENTATIONS[k], R_bs, names)
    if sensor == CELLS and "mount_rpy_deg" in remedy:
        remedy += ", which holds for the DVL's bottom track too; where that is right, turn the velocities of the table"
    return Finding(sensor, "warning", f"{cause}; {better} (agreement {fit.agreement:.2f}): {remedy}", "axes")


def _clock(
    config: Config, compared: DvlAgainstImu, H: Array, fit: AccelerationFit, coarse: float, sensor: str
) -> Finding:
    """Whether the stamps are late, by the fit and by the search, whose errors are others."""
    believed = believed_lag(config, "dvl")
    late = fit.lag - believed[0]
    sense = "late" if late >= 0.0 else "early"
    text = f"its stamps are {abs(late):.3f} s {sense} relative to the IMU's (sd {fit.lag_sd:.3f} s)"
    if not ACCELERATION.is_late(fit.lag, fit.lag_sd, believed):
        return Finding(sensor, "ok", text)
    if abs(fit.lag - coarse) > max(APART, SURE * fit.lag_sd) or abs(coarse - believed[0]) < 0.5 * abs(late):
        return Finding(sensor, "ok", f"{text}, but the dive shows this poorly")
    as_stamped = compared.refine(believed[0], H, held=True)
    if as_stamped is not None and 3.0 * fit.count * (as_stamped.error / fit.error - 1.0) < ACCELERATION.evidence:
        return Finding(sensor, "ok", f"{text}, but the dive shows this poorly")
    return Finding(sensor, "warning", f"{text}: {remedy_of_lag(config, sensor, fit.lag, fit.lag_sd)}", "lag")
