"""Initial conditions of a dive from its first seconds: attitude, heading, position, biases.

Attitude comes from gravity (specific force averaged in the axes of the first sample), heading from the log's heading
sources in the order of their accuracy, and the gyro's bias from standing still, where the vehicle stands still. Where
no source shows the heading, attitude comes by the Earth's rate (`rovgraph.inference.gyrocompassing`). An explicit
``start`` takes precedence over all of it. No value rests on a single sample: the first of a sensor is as often wrong as
any other, and here no gate would find it.

Each heading source gives the angle about down by which an attitude must be turned, through the instrument's own model,
so one function serves all sources. `rovgraph.inference.resolve` completes the configuration first.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import (
    EARTH_RATE,
    Array,
    earth_rate_n,
    exp_rotation,
    level_from_force,
    matrix_from_rpy,
    rotate,
    rpy_from_matrix,
    transpose,
    turned,
    wrap_angle,
)
from rovgraph.inference.gyrocompassing import ALIGN_S, OPEN_SD, bias_factor, coarse_attitude
from rovgraph.inference.resolve import TILT, WITHIN_S, Resolution, resolve
from rovgraph.log import Log, Stream
from rovgraph.log.frozen import CLEAR_SPEED
from rovgraph.model.calibration import Belief
from rovgraph.model.config import Config, beliefs, mount_matrix
from rovgraph.model.origin import scale_at
from rovgraph.model.state import POSE, Jacobians, State
from rovgraph.problem.acoustics import sightings, unusable_acoustics
from rovgraph.problem.initial_conditions import InitialConditions, StatePrior
from rovgraph.problem.motion import NO_BIAS_SD, has_constant_velocity
from rovgraph.sensors import SENSORS, innovation
from rovgraph.sensors.instruments import OFFSETS, Instrument, heading_sources, instruments

MOST_STEPS, FOUND_WITHIN = 10, 1e-6  # of the search for a turn [-, rad]


class TurnNoise(NamedTuple):
    """How a turn that a source asks for errs.

    Attributes
    ----------
    variance : ndarray, shape (n,), by the noise of each measurement [rad^2]
    by_tilt : ndarray, shape (n,), its square by that of a tilt, either axis
    deviation_var : by what is believed of the source's calibration, as far as that changes with the heading [rad^2]
    """

    variance: Array
    by_tilt: Array
    deviation_var: float


def by_accuracy(config: Config, sources: list[str]) -> list[str]:
    """Heading sources with those first whose offset is held fixed, or known best.

    Parameters
    ----------
    config : priors of the offsets
    sources : of `rovgraph.sensors.instruments.HEADING_STREAMS`
    """
    priors = beliefs(config)
    return sorted(sources, key=lambda s: priors[OFFSETS[s]].sd if priors[OFFSETS[s]].estimate else 0.0)


def solve_turn(instrument: Instrument, z: Array, R_nb: Array, calibration: Mapping[str, Array]) -> Array:
    """Angles about down by which attitudes are turned to predict measurements best, shape (n,) [rad].

    By Gauss-Newton. A heading is about linear in the turn, so any beginning will do; a vector goes round in a
    circle, which is known from four points of it.

    Parameters
    ----------
    instrument : a heading source
    z : ndarray, shape (n, dim)
    R_nb : ndarray, shape (n, 3, 3), attitudes, of which roll and pitch count
    calibration : name -> ndarray, shape (dim of variable,), all that the instrument depends on
    """
    model, still, turn = instrument.model, np.zeros((len(z), 3)), np.zeros(len(z))
    if not model.angular:
        a, b, c, d = (
            model.predict(_turn_about_down(R_nb, np.full(len(z), side), calibration), still)[0]
            for side in np.arange(4) * 0.5 * np.pi
        )
        beyond = z - 0.25 * (a + b + c + d)
        turn = np.arctan2(np.sum((b - d) * beyond, axis=1), np.sum((a - c) * beyond, axis=1))
    for _ in range(MOST_STEPS):
        there = _turn_about_down(R_nb, turn, calibration)
        predicted, H = model.predict(there, still)
        step = np.sum(_weigh_components(there, H) * innovation(model, z, predicted), axis=1)
        turn = turn + step
        if np.abs(step).max(initial=0.0) < FOUND_WITHIN:
            break
    return wrap_angle(turn)


def turn_noise(
    instrument: Instrument, R_nb: Array, turn: Array, calibration: Mapping[str, Array], priors: Mapping[str, Belief]
) -> TurnNoise:
    """How turns err that are found by `solve_turn`.

    Parameters
    ----------
    instrument, R_nb, calibration : as of `solve_turn`
    turn : ndarray, shape (n,) [rad]
    priors : of all calibration variables
    """
    there = _turn_about_down(R_nb, turn, calibration)
    _, H = instrument.model.predict(there, np.zeros((len(turn), 3)))
    by_z = _weigh_components(there, H)
    tilts_n = H[POSE][..., :3] @ transpose(there.R_nb)[..., :2]
    estimated = [belief for name, belief in priors.items() if belief.estimate and name in H]
    by_calibration = [belief.sd * np.einsum("nd,ndk->nk", by_z, H[belief.variable.name]) for belief in estimated]
    return TurnNoise(
        np.sum((by_z * instrument.sd) ** 2, axis=1),
        np.sum(np.einsum("nd,ndk->nk", by_z, tilts_n) ** 2, axis=1),
        float(sum(turns.var(axis=0).sum() for turns in by_calibration)),
    )


def _turn_about_down(R_nb: Array, turn: Array, calibration: Mapping[str, Array]) -> State:
    nowhere, down = np.zeros((len(turn), 3)), np.zeros((len(turn), 3))
    down[:, 2] = turn
    return State(exp_rotation(down) @ R_nb, nowhere, nowhere, np.zeros((len(turn), 6)), calibration)


def _weigh_components(there: State, H: Jacobians) -> Array:
    """The turn that best explains a measurement by its components, shape (n, dim)."""
    slope = np.einsum("ndk,nk->nd", H[POSE][..., :3], there.R_nb[:, 2, :])  # a turn about down is R_bn e_z in b
    return np.asarray(slope / np.maximum(np.sum(slope**2, axis=1), 1e-12)[:, None])


WINDOW_S = 5.0  # over which a log is levelled, and a sensor's first value taken
QUIET_ACC, QUIET_GYR = 0.15, 0.03  # scatter above the sensor's own noise that counts as quiet [SI]
STILL_TURN = np.deg2rad(3.0)  # its heading at the window's ends, at most [rad]
HEADINGS = 50  # samples of a source that are looked at
UNKNOWN_DOWN_SD = 100.0  # of a start whose depth nothing shows [m]
TWICE_SD = 3.0  # of the depth sensor's own error: its first value enters by itself, too
FIRST_FIX_SD = 5.0  # the fix enters by itself, too [m]
AGREE_SD = 3.0  # of a fix with the line through those around it
MOST_MPS = 1.0  # speed of a vehicle before its first position


class Level(NamedTuple):
    """The IMU's first seconds.

    Attributes
    ----------
    force_b, rate_b : ndarray, shape (3,), mean specific force in the axes of the first sample, mean rate
    quiet : whether it stands still
    seconds : that there are
    shows_bias : whether the mean rate, less the Earth's where it is modelled, shows the bias better than it is known
    """

    force_b: Array
    rate_b: Array
    quiet: bool
    seconds: float
    shows_bias: bool = False


def level(log: Log, config: Config) -> Level:
    """The first seconds by the IMU.

    Parameters
    ----------
    log : with an IMU
    config : its mounting and noise
    """
    imu, R_bs = log["imu"], mount_matrix(config.imu.mount_rpy_deg)
    first = imu.time <= imu.time[0] + WINDOW_S
    time, acc, gyr = imu.time[first], imu.data[first, :3] @ R_bs.T, imu.data[first, 3:] @ R_bs.T
    seconds = float(time[-1] - time[0])
    if len(time) < 3:
        return Level(acc.mean(axis=0), gyr.mean(axis=0), False, seconds)
    rate = (len(time) - 1) / seconds
    noise, bias_sd = config.imu.noise, np.deg2rad(config.imu.gyr_bias_sd_dps)
    quiet = bool(
        (acc.std(axis=0) < QUIET_ACC + 2.0 * noise.acc * np.sqrt(rate)).all()
        and (gyr.std(axis=0) < QUIET_GYR + 2.0 * noise.gyr * np.sqrt(rate)).all()
        and np.linalg.norm(gyr.mean(axis=0)) < 3.0 * bias_sd + EARTH_RATE
    )
    if quiet and not _moves(log):
        turns = EARTH_RATE * (np.deg2rad(config.start.heading_sd_deg) if config.environment.earth_rotation else 1.0)
        return Level(acc.mean(axis=0), gyr.mean(axis=0), True, seconds, seconds >= 1.0 and bool(bias_sd > turns))
    return Level(rotate(turned(time, gyr), acc).mean(axis=0), gyr.mean(axis=0), False, seconds)


def _moves(log: Log) -> bool:
    """Whether DVL or compass show motion: a steady turn is as quiet as standing still."""
    begin = log["imu"].time[0]
    if "dvl" in log:
        ping = log["dvl"].between(begin, begin + WINDOW_S)
        speed = np.linalg.norm(ping.data[ping["dvl_valid"] == 1.0, :3], axis=1)
        if len(speed) and np.median(speed) > CLEAR_SPEED:
            return True
    for source in ("ahrs", "dvl_heading"):
        if source in log:
            heading = np.unwrap(log[source].between(begin, begin + WINDOW_S).data[:, 0])
            third = len(heading) // 3
            if third and abs(np.median(heading[-third:]) - np.median(heading[:third])) > STILL_TURN:
                return True
    return False


def first_heading(dive: Resolution, levelled: Array, gyro_bias: Array) -> tuple[float, str]:
    """Yaw of the first epoch [rad], and the source that shows it.

    Of a source's samples in its first seconds, each brought back to the first epoch by the gyro, the
    one that the others are nearest to: the median on a circle.

    Parameters
    ----------
    dive : with a heading source that measures in the first `WITHIN_S`
    levelled : ndarray, shape (3, 3), R_nb of the first epoch but for its yaw
    gyro_bias : ndarray, shape (3,), as far as it is known [rad/s]
    """
    log, config, begin = dive.log, dive.config, dive.log["imu"].time[0]
    first = {source: log[source].between(begin, begin + WITHIN_S) for source in by_accuracy(config, dive.sources)}
    source, stream = next((source, stream) for source, stream in first.items() if len(stream))
    stream = stream.between(begin, stream.time[0] + WINDOW_S)
    stream = stream.take(np.unique(np.linspace(0, len(stream) - 1, HEADINGS).astype(int)))
    imu = log["imu"].between(begin, stream.time[-1])
    turns = turned(imu.time, imu.data[:, 3:] @ mount_matrix(config.imu.mount_rpy_deg).T - gyro_bias)
    there = levelled @ turns[imu.time.searchsorted(stream.time, "right") - 1]
    instrument, means = instruments(config)[source], {name: b.mean for name, b in beliefs(config).items()}
    yaws = solve_turn(instrument, stream.data[:, : instrument.model.dim], there, means)
    apart = np.abs(wrap_angle(np.subtract.outer(yaws, yaws))).sum(axis=1)
    return float(yaws[int(np.argmin(apart))]), source


def first_position(dive: Resolution, R_nb: Array) -> tuple[Array, Array]:
    """Position of the body's origin at the first epoch, in n, and its sd, shapes (3,) [m].

    Parameters
    ----------
    dive : its log, and what is believed of it; a stated start goes before the log
    R_nb : ndarray, shape (3, 3), of the first epoch
    """
    log, config, start, begin = dive.log, dive.config, dive.config.start, dive.log["imu"].time[0]
    p_n = np.array([start.north_m or 0.0, start.east_m or 0.0, start.down_m or 0.0])
    sd = np.array([start.position_sd_m, start.position_sd_m, start.down_sd_m or start.position_sd_m])
    fixes, arm, what = _positions(log, config)
    if fixes is not None and not start.located:
        if len(fixes):
            opening = fixes.time[0]  # however late they begin: the frame is theirs
            fixes = fixes.between(opening, opening + WITHIN_S)
            here, own_sd = _first_fix(fixes, config.fix.sd_m)
            metres = scale_at(config.environment.earth_latitude, np.array([[*here, 0.0]]))[0]
            p_n[:2] = here - (metres * rotate(R_nb, np.asarray(arm)))[:2]
            sd[:2] = np.maximum(sd[:2], max(own_sd, FIRST_FIX_SD, MOST_MPS * (fixes.time[0] - begin)))
            dive.assume(f"start position from the first {what}, north {p_n[0]:.1f} m, east {p_n[1]:.1f} m")
            if start.down_m is None and "depth" not in log and "down" in fixes.columns:
                p_n[2] = _robust_first(fixes.time, fixes["down"]) - rotate(R_nb, np.asarray(arm))[2]
                sd[2] = start.down_sd_m or sd[0]
                dive.assume(f"start.down_m {p_n[2]:.1f} within {sd[2]:.1f} m, from the first {what}")
                return p_n, sd
    elif log.origin is not None and not start.located:
        where = f"latitude {log.origin[0]:.6f}, longitude {log.origin[1]:.6f}"
        dive.assume(f"start at the origin, {where}, within {sd[0]:g} m, as the log has no fix")
    if start.down_m is None and "depth" in log:
        depth = log["depth"]
        first = depth.between(depth.time[0], depth.time[0] + WINDOW_S)
        p_n[2] = _robust_first(first.time, first.data[:, 0]) - rotate(R_nb, np.asarray(config.depth.lever_arm_m))[2]
        if start.down_sd_m is None:
            sizes = (beliefs(config)["depth_offset"], 1.0), (beliefs(config)["depth_scale"], float(p_n[2]))
            off = np.linalg.norm([b.sd * size for b, size in sizes if b.considered or b.estimate])
            sd[2] = max(sd[2], TWICE_SD * float(off))
        sd[2] = max(sd[2], MOST_MPS * (depth.time[0] - begin))
    elif start.down_m is None:
        sd[2] = start.down_sd_m or UNKNOWN_DOWN_SD
        dive.assume(f"start.down_m 0.0 within {sd[2]:g} m, as the log has no depth")
    return p_n, sd


def _positions(log: Log, config: Config) -> tuple[Stream | None, Sequence[float], str]:
    """What the log has of positions, the arm of what is positioned, and what it is."""
    if "fix" in log:
        return log["fix"], config.fix.lever_arm_m, "fix"
    acoustic = None
    if "usbl" in log and "usbl" not in unusable_acoustics(config, log.sensors):
        found = sightings(log, config, instruments(config))
        acoustic = None if found is None else found.positions
    return acoustic, config.usbl.beacon_arm_m, "acoustic position"


def _first_fix(fixes: Stream, sd: float) -> tuple[Array, float]:
    """The first fix, shape (2,), and its sd [m]; the line through the first ones instead of one that is far off it."""
    logged = [float(fixes[name][0]) for name in ("fix_sd", "fix_east_sd") if name in fixes.columns]
    sd = max((value for value in logged if value > 0.0), default=sd)
    line = np.array([_robust_first(fixes.time, fixes.data[:, k]) for k in (0, 1)])
    off = float(np.linalg.norm(fixes.data[0, :2] - line))
    return (line if off > AGREE_SD * (sd + FIRST_FIX_SD) else fixes.data[0, :2]), sd


def _robust_first(time: Array, values: Array) -> float:
    """The first of some values, by the line that half of them cannot turn; of two the first (Siegel 1982)."""
    if len(time) < 3:
        return float(values[0])
    apart = np.subtract.outer(time, time)
    rise = np.subtract.outer(values, values)
    slopes = np.divide(rise, apart, out=np.full_like(apart, np.nan), where=apart != 0.0)  # two may share a stamp
    slope = np.median(np.nanmedian(slopes, axis=1))
    return float(np.median(values - slope * time) + slope * time[0])


STILL_GYR_SD = 3e-3  # a vehicle that looks still may turn this much [rad/s]
MOVING_TILT_SD = np.deg2rad(5.0)
UNKNOWN_HEADING_SD = np.deg2rad(20.0)  # the samples themselves enter as factors
START_VELOCITY_SD = 1.0


def refusal(log: Log, config: Config) -> str:
    """Why no estimate can begin, one line; empty where one can.

    Parameters
    ----------
    log, config : of `initialise`
    """
    try:
        initialise(log, config)
    except InputError as error:
        return str(error).removeprefix(f"{log.source}: ")
    return ""


def initialise(log: Log, config: Config, expected: Collection[str] = ()) -> InitialConditions:
    """Complete the configuration by the log, and find where the dive begins.

    Parameters
    ----------
    log, config : the dive, or its first seconds
    expected : streams that may still come, beside those of the log

    Raises
    ------
    InputError : neither an IMU nor roll and pitch; neither DVL nor fixes; no heading, no ``start.heading_deg``, and no
        gyro that shows it
    """
    dive = resolve(log, config, expected)
    bias, bias_sd, R_nb, rpy_sd = _by_gyro(dive) if dive.by_gyro else _by_gravity(dive)
    p_n, p_sd = first_position(dive, R_nb)
    log, config = dive.log, dive.config
    every = instruments(config, config.imu.lever_arm_m)
    aiding = [s for s in every if s in dive.in_use - {"thruster"} and SENSORS[s].heading_source is None]
    used = [*aiding, *heading_sources(config, dive.in_use), *({"thruster"} & dive.in_use)]
    if config.sound.profile is not None and "range" in used and "depth" not in {*log.sensors, *expected}:
        dive.assume(
            f"range: sound.profile is used with the vehicle at {p_n[2]:.0f} m throughout, as the log has no depth"
        )
    rpy = np.rad2deg(rpy_from_matrix(R_nb))
    filled = {
        "roll_deg": float(rpy[0]),
        "pitch_deg": float(rpy[1]),
        "heading_deg": float(rpy[2] % 360.0),
        "north_m": float(p_n[0]),
        "east_m": float(p_n[1]),
        "down_m": float(p_n[2]),
        "position_sd_m": float(p_sd[0]),
        "down_sd_m": float(p_sd[2]),
        "tilt_sd_deg": float(np.rad2deg(rpy_sd[0])),
        "heading_sd_deg": float(np.rad2deg(rpy_sd[2])),
    }
    config = config.with_values(start=filled)
    arm_n = R_nb @ np.asarray(config.imu.lever_arm_m)
    at_imu = p_n[None] + scale_at(config.environment.earth_latitude, p_n[None]) * arm_n
    state = State(R_nb[None], at_imu, np.zeros((1, 3)), bias[None])
    prior = StatePrior(state, rpy_sd, p_sd, np.full(3, START_VELOCITY_SD), bias_sd)
    return InitialConditions(config, {s: every[s] for s in used}, prior, dive.assumptions)


def _by_gravity(dive: Resolution) -> tuple[Array, Array, Array, Array]:
    """Bias of the first keyframe and its sd, R_nb of the first epoch and the sd of roll, pitch, yaw."""
    first, config, start = level(dive.log, dive.config), dive.config, dive.config.start
    if has_constant_velocity(config):
        bias, bias_sd = np.zeros(6), np.full(6, NO_BIAS_SD)
        tilt = dive.log[TILT]
        from_log = np.median(tilt.data[tilt.time <= tilt.time[0] + WINDOW_S], axis=0)
    else:
        bias, bias_sd = _bias(dive, first)
        from_log = level_from_force(first.force_b)
    roll, pitch = _tilt(dive, from_log)
    tilt_sd, yaw_sd = np.deg2rad(start.tilt_sd_deg), np.deg2rad(start.heading_sd_deg)
    moving = not first.quiet and not has_constant_velocity(config)
    if moving and (start.roll_deg is None or start.pitch_deg is None):
        tilt_sd = max(tilt_sd, MOVING_TILT_SD)
        dive.assume("the log begins in motion: roll and pitch at the start are rough until the estimate refines them")
    if start.heading_deg is None:
        yaw, source = first_heading(dive, matrix_from_rpy([roll, pitch, 0.0]), bias[3:])
        yaw_sd = max(yaw_sd, UNKNOWN_HEADING_SD)
        dive.assume(f"start.heading_deg {np.rad2deg(yaw) % 360.0:.1f}, from {source}")
    else:
        yaw = np.deg2rad(start.heading_deg)
    R_nb = matrix_from_rpy([roll, pitch, yaw])
    if first.shows_bias and config.environment.earth_rotation:  # a gyro that stands still shows the Earth's rate, too
        bias[3:] -= R_nb.T @ earth_rate_n(np.deg2rad(config.environment.latitude_deg or 0.0))
    return bias, bias_sd, R_nb, np.array([tilt_sd, tilt_sd, yaw_sd])


def _by_gyro(dive: Resolution) -> tuple[Array, Array, Array, Array]:
    """The same by the Earth's rate; what the gyro reads at rest is no bias before its heading is known."""
    bias, bias_sd = _bias(dive, None)
    bias_sd[3:5] *= bias_factor(dive.config, dive.config.environment.latitude or 0.0)
    rpy = rpy_from_matrix(coarse_attitude(dive.log, dive.config))
    heading, tilt_sd = np.rad2deg(rpy[2]) % 360.0, np.deg2rad(dive.config.start.tilt_sd_deg)
    dive.assume(f"start.heading_deg {heading:.1f}, by the Earth's rate in the first {ALIGN_S:.0f} s")
    return bias, bias_sd, matrix_from_rpy([*_tilt(dive, rpy[:2]), rpy[2]]), np.array([tilt_sd, tilt_sd, OPEN_SD])


def _tilt(dive: Resolution, from_log: Array) -> list[float]:
    """Roll and pitch of the first epoch, those of the log where none are stated [rad]."""
    stated = dive.config.start.roll_deg, dive.config.start.pitch_deg
    return [
        tilt if said is None else float(np.deg2rad(said)) for said, tilt in zip(stated, from_log.tolist(), strict=True)
    ]


def _bias(dive: Resolution, first: Level | None) -> tuple[Array, Array]:
    """Bias of the first keyframe and its sd, shapes (6,); by the first seconds, if the vehicle stands still."""
    imu = dive.config.imu
    gyr_sd = np.deg2rad(imu.gyr_bias_sd_dps)
    bias, sd = np.zeros(6), np.repeat([imu.acc_bias_sd_mps2, gyr_sd], 3)
    if first is not None and first.shows_bias:
        bias[3:] = first.rate_b
        sd[3:] = min(gyr_sd, float(np.hypot(imu.noise.gyr / np.sqrt(first.seconds), STILL_GYR_SD)))
        dive.assume(f"gyro bias from the first {first.seconds:.0f} s, in which the vehicle is assumed to be at rest")
    return bias, sd
