"""Initial conditions of a dive from its first seconds: attitude, heading, position, biases.

Attitude comes from gravity (specific force averaged in the axes of the first sample), heading from the log's heading
sources in the order of their accuracy, and the gyro's bias from standing still, where the vehicle stands still. Where
no source shows the heading, attitude comes by the Earth's rate (`rovgraph.inference.gyrocompassing`). An explicit
``start`` takes precedence over all of it. No value rests on a single sample: the first of a sensor is as often wrong as
any other, and here no gate would find it.

Each heading source gives the angle about down by which an attitude must be turned, through the instrument's own model,
so one function serves all sources. `with_motion_model` decides whether a dive is estimated without an IMU, and where
it then begins.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from rovgraph.dates import is_unix
from rovgraph.errors import InputError
from rovgraph.geometry import (
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
from rovgraph.inference.assumptions import nothing_checks, unchecked, unchecked_compass
from rovgraph.inference.gyrocompassing import (
    ALIGN_S,
    OPEN_SD,
    bias_factor,
    coarse_attitude,
    with_earth_rate,
    without_turns,
)
from rovgraph.kernels.assembly import NOISIER
from rovgraph.kernels.earth import normal_gravity
from rovgraph.log import Log, Stream
from rovgraph.log.frozen import CLEAR_SPEED
from rovgraph.log.reading import length_of_way, water_at
from rovgraph.model.calibration import ACOUSTICS, AUTO, CONSIDERED, TABLE, Belief
from rovgraph.model.config import GOOD_GYRO_DPS, Config, beliefs, mount_matrix, with_priors_stated
from rovgraph.model.config_sections import HIGHEST_LATITUDE_DEG, Environment
from rovgraph.model.grids import convergence_and_scale
from rovgraph.model.origin import Frame, frame_of
from rovgraph.model.state import POSE, Jacobians, State
from rovgraph.problem.acoustics import sightings, unusable_acoustics
from rovgraph.problem.beams import beam_sensors
from rovgraph.problem.initial_conditions import InitialConditions, StatePrior
from rovgraph.problem.layers import layer_sensors, with_knots
from rovgraph.problem.motion import NO_BIAS_SD, SCALES, has_constant_velocity, motion_model, scatter, ticks
from rovgraph.sensors import SENSORS, innovation
from rovgraph.sensors.compass import reference
from rovgraph.sensors.dvl_beam import BEAMS
from rovgraph.sensors.dvl_sound import SoundCorrection
from rovgraph.sensors.earth_field import (
    BLACKOUT_NT,
    CAUTION_NT,
    EarthField,
    decimal_year,
    declination_per_km,
    earth_field,
)
from rovgraph.sensors.instruments import OFFSETS, Instrument, heading_sources, instruments
from rovgraph.sensors.pressure import waves_at_surface

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
WITHIN_S = 30.0  # from the log's start: first headings and fixes
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
    """

    force_b: Array
    rate_b: Array
    quiet: bool
    seconds: float

    @property
    def shows_bias(self) -> bool:
        """Whether the mean rate is the gyro's bias."""
        return self.quiet and self.seconds >= 1.0


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
    noise = config.imu.noise
    quiet = bool(
        (acc.std(axis=0) < QUIET_ACC + 2.0 * noise.acc * np.sqrt(rate)).all()
        and (gyr.std(axis=0) < QUIET_GYR + 2.0 * noise.gyr * np.sqrt(rate)).all()
        and np.linalg.norm(gyr.mean(axis=0)) < 3.0 * np.deg2rad(config.imu.gyr_bias_sd_dps)
    )
    if quiet and not _moves(log):
        return Level(acc.mean(axis=0), gyr.mean(axis=0), True, seconds)
    return Level(rotate(turned(time, gyr), acc).mean(axis=0), gyr.mean(axis=0), False, seconds)


def _moves(log: Log) -> bool:
    """Whether DVL or compass show motion: a steady turn is as quiet as standing still."""
    if "dvl" in log:
        ping = _opening(log["dvl"], log["imu"].time[0], WINDOW_S)
        speed = np.linalg.norm(ping.data[ping["dvl_valid"] == 1.0, :3], axis=1)
        if len(speed) and np.median(speed) > CLEAR_SPEED:
            return True
    for source in ("ahrs", "dvl_heading"):
        if source in log:
            heading = np.unwrap(_opening(log[source], log["imu"].time[0], WINDOW_S).data[:, 0])
            third = len(heading) // 3
            if third and abs(np.median(heading[-third:]) - np.median(heading[:third])) > STILL_TURN:
                return True
    return False


def _opening(stream: Stream, begin: float, seconds: float) -> Stream:
    """Of a stream what lies within some seconds of a time."""
    return stream.take((stream.time >= begin) & (stream.time <= begin + seconds))


def first_heading(
    log: Log, config: Config, sensors: dict[str, Instrument], sources: list[str], levelled: Array, gyro_bias: Array
) -> tuple[float, str]:
    """Yaw of the first epoch [rad], and the source that shows it.

    Of a source's samples in its first seconds, each brought back to the first epoch by the gyro, the
    one that the others are nearest to: the median on a circle.

    Parameters
    ----------
    log, config : the dive, and what is believed of it
    sensors : instruments by stream
    sources : heading sources of the log, one of which measures in the first `WITHIN_S`
    levelled : ndarray, shape (3, 3), R_nb of the first epoch but for its yaw
    gyro_bias : ndarray, shape (3,), as far as it is known [rad/s]
    """
    begin, means = log["imu"].time[0], {name: b.mean for name, b in beliefs(config).items()}
    source = next(s for s in by_accuracy(config, sources) if len(_opening(log[s], begin, WITHIN_S)))
    stream = _opening(log[source], begin, WITHIN_S)
    stream = _opening(stream, stream.time[0], WINDOW_S)
    stream = stream.take(np.unique(np.linspace(0, len(stream) - 1, HEADINGS).astype(int)))
    imu = _opening(log["imu"], begin, stream.time[-1] - begin)
    turns = turned(imu.time, imu.data[:, 3:] @ mount_matrix(config.imu.mount_rpy_deg).T - gyro_bias)
    there = levelled @ turns[imu.time.searchsorted(stream.time, "right") - 1]
    yaws = solve_turn(sensors[source], stream.data[:, : sensors[source].model.dim], there, means)
    apart = np.abs(wrap_angle(np.subtract.outer(yaws, yaws))).sum(axis=1)
    return float(yaws[int(np.argmin(apart))]), source


def _begins_with_heading(log: Log, sources: Collection[str]) -> bool:
    """Whether a heading source measures early enough for the start."""
    return any(len(_opening(log[source], log["imu"].time[0], WITHIN_S)) for source in sources)


def first_position(log: Log, config: Config, R_nb: Array, assumptions: list[str]) -> tuple[Array, Array]:
    """Position of the body's origin at the first epoch, in n, and its sd, shapes (3,) [m].

    Parameters
    ----------
    log, config : the dive, and what is believed of it; a stated start goes before the log
    R_nb : ndarray, shape (3, 3), of the first epoch
    assumptions : to be added to, one line each
    """
    start, begin = config.start, log["imu"].time[0]
    p_n = np.array([start.north_m or 0.0, start.east_m or 0.0, start.down_m or 0.0])
    sd = np.array([start.position_sd_m, start.position_sd_m, start.down_sd_m or start.position_sd_m])
    fixes, arm, what = _positions(log, config)
    if fixes is not None and not start.located:
        if len(fixes):
            fixes = _opening(fixes, fixes.time[0], WITHIN_S)  # however late they begin: the frame is theirs
            here, own_sd = _first_fix(fixes, config.fix.sd_m)
            p_n[:2] = here - rotate(R_nb, np.asarray(arm))[:2]
            sd[:2] = np.maximum(sd[:2], max(own_sd, FIRST_FIX_SD, MOST_MPS * (fixes.time[0] - begin)))
            assumptions.append(f"start position from the first {what}, north {p_n[0]:.1f} m, east {p_n[1]:.1f} m")
            if start.down_m is None and "depth" not in log and "down" in fixes.columns:
                p_n[2] = _robust_first(fixes.time, fixes["down"]) - rotate(R_nb, np.asarray(arm))[2]
                sd[2] = start.down_sd_m or sd[0]
                assumptions.append(f"start.down_m {p_n[2]:.1f} within {sd[2]:.1f} m, from the first {what}")
                return p_n, sd
    elif log.origin is not None and not start.located:
        where = f"latitude {log.origin[0]:.6f}, longitude {log.origin[1]:.6f}"
        assumptions.append(f"start at the origin, {where}, within {sd[0]:g} m, as the log has no fix")
    if start.down_m is None and "depth" in log:
        depth = log["depth"]
        first = _opening(depth, depth.time[0], WINDOW_S)
        p_n[2] = _robust_first(first.time, first.data[:, 0]) - rotate(R_nb, np.asarray(config.depth.lever_arm_m))[2]
        if start.down_sd_m is None:
            sizes = (beliefs(config)["depth_offset"], 1.0), (beliefs(config)["depth_scale"], float(p_n[2]))
            off = np.linalg.norm([b.sd * size for b, size in sizes if b.considered or b.estimate])
            sd[2] = max(sd[2], TWICE_SD * float(off))
        sd[2] = max(sd[2], MOST_MPS * (depth.time[0] - begin))
    elif start.down_m is None:
        sd[2] = start.down_sd_m or UNKNOWN_DOWN_SD
        assumptions.append(f"start.down_m 0.0 within {sd[2]:g} m, as the log has no depth")
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


TILT = "vehicle_tilt"
BOTTOM = "bottom_velocity"
BOAT_ACC = 0.5  # noise density of a boat's acceleration: less takes its turns for those of the bottom [m/s2/rtHz]


def with_motion_model(log: Log, config: Config, assumptions: list[str]) -> tuple[Log, Config]:
    """The log and the configuration with its motion model resolved; without an IMU, with `ticks` in its place.

    Raises
    ------
    InputError : the log lacks what the motion needs, or the configuration asks for what needs an IMU
    """
    model = motion_model(config, log.sensors)
    config = config.model_copy(update={"motion": config.motion.model_copy(update={"model": model})})
    if not has_constant_velocity(config):
        if "imu" not in log:
            raise InputError(
                f"{log.source}: no IMU, columns acc_x..acc_z and gyr_x..gyr_z are needed, or else roll and pitch"
            )
        return log, config
    if TILT not in log:
        raise InputError(f"{log.source}: motion.model constant_velocity needs columns roll and pitch")
    for asked, key in _needs_imu(log, config, beliefs(config)):
        if asked:
            raise InputError(f"{log.source}: {key} needs an IMU, columns acc_x..acc_z and gyr_x..gyr_z")
    why = "the IMU is left out" if "imu" in log else "the log has no IMU"
    config = _on_a_bed_that_may_move(log, config, assumptions)
    motion = config.motion
    assumptions.append(
        f"{why}: constant velocity between measurements, walking by {motion.acc:g} m/s2/rtHz, "
        f"and attitude by {motion.gyr:g} rad/s/rtHz (motion.acc, motion.gyr)"
    )
    entries = dict.fromkeys(SCALES, False) | {name: CONSIDERED for name in unseen(log.sensors)}
    given = config.calibration
    stated = {name for name in given.model_fields_set if "estimate" in getattr(given, name).model_fields_set}
    calibration = given.model_copy(
        update={
            name: getattr(given, name).model_copy(update={"estimate": estimate})
            for name, estimate in entries.items()
            if name in SCALES or (getattr(given, name).estimate is True and name not in stated)
        }
    )
    environment = config.environment.model_copy(update={"earth_rotation": False})
    config = config.model_copy(update={"calibration": calibration, "environment": environment})
    return replace(log, streams={**log.streams, "imu": ticks(log)}), config


def _on_a_bed_that_may_move(log: Log, config: Config, assumptions: list[str]) -> Config:
    """A vehicle with neither IMU nor depth is a boat, and rivers move their beds: they are surveyed for that.

    Only position fixes would show it, so it is estimated unless the configuration states otherwise.
    """
    if "depth" in log or "dvl" not in log or getattr(config.calibration, BOTTOM).estimate != AUTO:
        return config
    bottom = getattr(config.calibration, BOTTOM).model_copy(update={"estimate": True})
    calibration = config.calibration.model_copy(update={BOTTOM: bottom})
    motion = config.motion
    if "acc" not in motion.model_fields_set:
        motion = motion.model_copy(update={"acc": BOAT_ACC})
    assumptions.append(
        f"no depth either, so it is a boat, under which the bed may move by {bottom.sd:g} m/s; "
        f"calibration.{BOTTOM}: {{estimate: false}} if it rests"
    )
    return config.model_copy(update={"calibration": calibration, "motion": motion})


def unseen(sensors: Collection[str]) -> list[str]:
    """Calibration variables that a dive without an IMU does not show: against no gyro, deviation curves need fixes.

    How a heading walks is a poor gyro: it would take a curve for likely that makes the vehicle turn less.
    """
    return [] if "fix" in sensors else [name for name in TABLE if name.endswith("_deviation")]


def _needs_imu(log: Log, config: Config, priors: dict[str, Belief]) -> list[tuple[bool, str]]:
    """Features that need an IMU: whether each is requested, and by which key."""
    estimated = [
        name for name in (*SCALES, *(n for n in priors if n.endswith("_time_offset"))) if priors[name].estimate
    ]
    return [
        (config.graph.hydrodynamics, "graph.hydrodynamics"),
        (
            "mag" in heading_sources(config, log.sensors) and config.environment.dip_deg is None,
            "environment.dip_deg: null, as the heading is a magnetometer's,",
        ),
        *((True, f"calibration.{name}: {{estimate: true}}") for name in estimated),
    ]


def first_tilt(log: Log) -> tuple[float, float]:
    """Roll and pitch that the vehicle gives in the first seconds, the median [rad]."""
    tilt = log[TILT]
    roll, pitch = np.median(tilt.data[tilt.time <= tilt.time[0] + WINDOW_S], axis=0).tolist()
    return roll, pitch


def no_bias() -> tuple[Array, Array]:
    """Bias of the first keyframe and its sd without an IMU: zeros, shapes (6,)."""
    return np.zeros(6), np.full(6, NO_BIAS_SD)


STILL_GYR_SD = 3e-3  # a vehicle that looks still may turn this much [rad/s]
MOVING_TILT_SD = np.deg2rad(5.0)
UNKNOWN_HEADING_SD = np.deg2rad(20.0)  # the samples themselves enter as factors
START_VELOCITY_SD = 1.0
ENOUGH_SAMPLES = 100


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
    """Resolve everything that the configuration leaves to the log.

    Parameters
    ----------
    log, config : the dive, or its first seconds
    expected : streams that may still come, beside those of the log

    Raises
    ------
    InputError : neither an IMU nor roll and pitch; neither DVL nor fixes; no heading, no ``start.heading_deg``, and no
        gyro that shows it
    """
    assumptions: list[str] = []
    log, config = with_motion_model(log, config, assumptions)
    unusable = unusable_acoustics(config, log.sensors | set(expected))
    beams, why_not = beam_sensors(config, log.streams)
    if not log.sensors - unusable.keys() & {"dvl", "fix", *ACOUSTICS} and not beams:
        raise InputError(
            f"{log.source}: neither DVL (dvl_vx, dvl_vy, dvl_vz) nor position fixes, one of them is needed"
            + "".join(f"; {sensor} is left out: {why}" for sensor, why in unusable.items())
        )
    assumptions += [f"{sensor} is left out: {why}" for sensor, why in unusable.items() if sensor in log]
    if beams:
        assumptions.append(f"pings of the DVL by their {len(beams) - 1} beams, at {config.dvl.beams.angle_deg:g} deg")
    assumptions += [why_not] if why_not else []
    layers, config = _resolve_layers(log, config, expected, assumptions)
    config = _resolve_norths(log, config, assumptions)
    config = _resolve_environment(log, config, assumptions)
    config = _resolve_noise(log, config, assumptions)
    config = _resolve_waves(log, config, assumptions)
    sources, present = heading_sources(config, log.sensors), log.sensors | {*expected, *beams, *layers}
    present -= {"dvl_water"} if layers else set()
    compass = unchecked_compass(config, heading_sources(config, present), log.sensors)
    config = _resolve_sound(log, config, assumptions)
    config = with_priors_stated(config, compass)
    sensors = instruments(config, config.imu.lever_arm_m)
    elsewhere = {"thruster"} if has_constant_velocity(config) else {"thruster", TILT}
    without_heading = [
        s for s in sensors if s in present - elsewhere - unusable.keys() and SENSORS[s].heading_source is None
    ]
    used = without_heading + heading_sources(config, present) + _thrusters(log, config, expected)
    sensors = {s: sensors[s] for s in used}
    if by_gyro := config.start.heading_deg is None and not _begins_with_heading(log, sources):
        config = with_earth_rate(log, config, sources)
        assumptions.append(f"heading from the Earth's rate by the gyro, {without_turns(config, log.origin)}")
    else:
        assumptions.append("heading from " + (", ".join(sources) or "start.heading_deg alone: it will drift"))
    resting = unchecked(config, sources, log.sensors, expected, by_gyro)
    if compass:
        assumptions.insert(0, nothing_checks(resting.pop(0), turns_show=not has_constant_velocity(config)))
    assumptions += resting

    first = level(log, config)
    if by_gyro:  # what it reads at rest is no bias before its heading is known
        first = first._replace(quiet=False)
    bias, bias_sd = no_bias() if has_constant_velocity(config) else _bias(config, first, assumptions)
    if by_gyro:
        R_nb, rpy_sd = _attitude_by_gyro(log, config, assumptions)
        bias_sd[3:5] *= bias_factor(config, config.environment.latitude or 0.0)
    else:
        R_nb, rpy_sd = _attitude(log, config, sensors, sources, first, bias[3:], assumptions)
    if first.shows_bias and config.environment.earth_rotation:  # a gyro that stands still shows the Earth's rate, too
        bias[3:] -= R_nb.T @ earth_rate_n(np.deg2rad(config.environment.latitude_deg or 0.0))
    p_n, p_sd = first_position(log, config, R_nb, assumptions)
    if config.sound.profile is not None and "range" in sensors and "depth" not in {*log.sensors, *expected}:
        assumptions.append(
            f"range: sound.profile is used with the vehicle at {p_n[2]:.0f} m throughout, as the log has no depth"
        )
    rpy, start = np.rad2deg(rpy_from_matrix(R_nb)), config.start
    filled = start.model_copy(
        update={
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
    )
    config = config.model_copy(update={"start": filled})
    at_imu = p_n + R_nb @ np.asarray(config.imu.lever_arm_m)
    state = State(R_nb[None], at_imu[None], np.zeros((1, 3)), bias[None])
    prior = StatePrior(state, rpy_sd, p_sd, np.full(3, START_VELOCITY_SD), bias_sd)
    return InitialConditions(config, sensors, prior, assumptions)


def _thrusters(log: Log, config: Config, expected: Collection[str]) -> list[str]:
    """The stream of thruster signals, where hydrodynamics are asked for and it does not come later."""
    if not config.graph.hydrodynamics or ("thruster" in expected and "thruster" not in log):
        return []
    wanted = len(config.vehicle.thrusters)
    if "thruster" not in log:
        raise InputError(
            f"{log.source}: graph.hydrodynamics needs thruster signals, columns thruster_1, thruster_2, ..."
        )
    if len(log["thruster"].columns) != wanted:
        raise InputError(
            f"{log.source}: {len(log['thruster'].columns)} thruster columns, vehicle.thrusters has {wanted}; "
            "describe every thruster in the configuration"
        )
    return ["thruster"]


def _resolve_layers(
    log: Log, config: Config, expected: Collection[str], assumptions: list[str]
) -> tuple[list[str], Config]:
    """The sensors that profiles of the water become, and the configuration with the knots of the current."""
    layers, why_not = layer_sensors(config, log.streams, expected)
    if layers:
        config = with_knots(config, log.streams, whole=not expected)
        knots, spacing = config.water.knots, config.water.knot_m
        said = (
            "one, that of the cells' depth"
            if knots == 1
            else f"{knots} knots {spacing:.3g} m apart about the vehicle's depth"
        )
        assumptions.append(f"profiles of the water are used; the current: {said}")
        if "dvl_water" in log:
            assumptions.append("dvl_water is left out: it is a mean of the cells of the profiles")
    assumptions += [why_not] if why_not else []
    return layers, config


def _resolve_environment(log: Log, config: Config, assumptions: list[str]) -> Config:
    """Fill in the field's magnitude and dip, the latitude, and gravity."""
    env, changes = config.environment, {}
    if "mag" in log and "mag" in heading_sources(config, log.sensors):
        mag = log["mag"].data
        norm = np.linalg.norm(mag, axis=1)
        if env.field_norm is None:
            changes["field_norm"] = float(np.median(norm))
            assumptions.append(f"environment.field_norm {changes['field_norm']:.4g}, the median of the log")
        if env.dip_deg is None:
            changes["dip_deg"] = dip_of_log(log)
            assumptions.append(f"environment.dip_deg {changes['dip_deg']:.1f}, from the log")
            if not beliefs(config)["field_dip"].estimate:
                hint = "give it, or estimate calibration.field_dip"
                assumptions[-1] += f", and held, with the error of the levelling in it: {hint}"
    frame = _frame(log, config)
    if log.origin is not None and (env.latitude_deg is None or frame == "earth"):
        changes["latitude_deg"] = log.origin[0]
    if frame == "earth":
        changes |= _on_earth(log, config, assumptions)
    if env.earth_rotation and env.latitude_deg is None and log.origin is None:
        raise InputError(
            "environment.earth_rotation needs environment.latitude_deg or origin_lat_deg, as the log has no fix_lat"
        )
    env = env.model_copy(update={**changes, "frame": frame})
    if env.gravity_mps2 is None:
        env = env.model_copy(update={"gravity_mps2": _gravity(log, config, env, assumptions)})
    return config.model_copy(update={"environment": env})


def dip_of_log(log: Log) -> float:
    """Dip of the field by the magnetometer against gravity [deg], the median of the log."""
    imu, mag = log["imu"], log["mag"]
    f = np.column_stack([np.interp(mag.time, imu.time, a) for a in imu.data[:, :3].T])
    sine = -np.sum(f * mag.data, axis=1) / (np.linalg.norm(f, axis=1) * np.linalg.norm(mag.data, axis=1))
    return float(np.rad2deg(np.arcsin(np.clip(np.nanmedian(sine), -1.0, 1.0))))


def field_by_place(log: Log) -> EarthField | None:
    """The Earth's field where a dive begins; None where the log knows no place or date."""
    if log.origin is None or not is_unix(log.start):
        return None
    return earth_field(*log.origin, 0.0, decimal_year(log.start))


def slope_by_place(log: Log) -> tuple[float, float]:
    """Change of the declination by a kilometre north and east where a dive begins [deg/km]; 0 where it is not known."""
    if log.origin is None:
        return 0.0, 0.0
    north, east = declination_per_km(*log.origin, decimal_year(log.start))
    return round(north, 5), round(east, 5)


def declination_by_place(log: Log, config: Config) -> EarthField | None:
    """The field that the declination is taken from: where none is stated, and no compass may have taken it already."""
    norths = [reference(config, source) for source in heading_sources(config, log.sensors)]
    if "declination_deg" in config.environment.model_fields_set or None in norths or "magnetic" not in norths:
        return None
    return field_by_place(log)


def _resolve_norths(log: Log, config: Config, assumptions: list[str]) -> Config:
    """The norths of the compasses in use: declination, dip and blackout by place and date, convergence by the grid.

    Raises
    ------
    InputError : a heading relative to a grid that is not known
    """
    sources = heading_sources(config, log.sensors)
    config = with_convergence(log, config, assumptions)
    magnetic = [source for source in sources if reference(config, source) in ("magnetic", None)]
    field = field_by_place(log) if magnetic else None
    if field is None:
        return config
    weak = f"the horizontal field is {field.horizontal_nt:.0f} nT by WMM2025"
    if field.horizontal_nt < BLACKOUT_NT and config.heading.sources is None:
        kept = tuple(SENSORS[source].heading_source for source in sources if source not in magnetic)
        assumptions.insert(0, f"no heading from {', '.join(magnetic)}: {weak}; name it under heading.sources to use it")
        return config.model_copy(update={"heading": config.heading.model_copy(update={"sources": kept})})
    if field.horizontal_nt < CAUTION_NT:
        assumptions.append(f"compasses show little here: {weak}, and storms turn them by many degrees")
    changes: dict[str, Any] = {}
    expired = ", which ends before that date: use a newer rovgraph, or state it" if field.expired else ""
    if (taken := declination_by_place(log, config)) is not None and field.horizontal_nt >= BLACKOUT_NT:
        changes["declination_deg"] = round(taken.declination_deg, 2)
        slope = config.environment.declination_per_km_deg or slope_by_place(log)
        changes["declination_per_km_deg"] = slope
        config = _with_declination_sd(config, magnetic, taken.declination_sd_deg)
        assumptions.append(
            f"environment.declination_deg {taken.declination_deg:.2f} within {taken.declination_sd_deg:.1f} deg, by "
            f"WMM2025 at the origin and the date of the log, by km north and east "
            f"{slope[0]:+.4f} and {slope[1]:+.4f} deg{expired}"
        )
    if "mag" in sources and config.environment.dip_deg is None:
        changes["dip_deg"] = round(field.dip_deg, 2)
        assumptions.append(f"environment.dip_deg {field.dip_deg:.1f}, by WMM2025{expired}")
    return config.model_copy(update={"environment": config.environment.model_copy(update=changes)})


def _with_declination_sd(config: Config, sources: Sequence[str], sd_deg: float) -> Config:
    """Offsets of compasses that are known better than the declination are known as well as that."""
    entries = {}
    for name in (OFFSETS[source] for source in sources):
        entry = getattr(config.calibration, name)
        own = 0.0 if entry.estimate is False else entry.sd_deg
        if own is not None:  # the sd of one that is not stated is far larger
            entries[name] = entry.model_copy(update={"estimate": True, "sd_deg": float(np.hypot(own, sd_deg))})
    return config.model_copy(update={"calibration": config.calibration.model_copy(update=entries)})


def with_convergence(log: Log, config: Config, assumptions: list[str]) -> Config:
    """Where grid north points, where a compass in use is relative to it and it is not stated.

    Raises
    ------
    InputError : the grid or the place is not known
    """
    of_grid = [source for source in heading_sources(config, log.sensors) if reference(config, source) == "grid"]
    env = config.environment
    if not of_grid or env.convergence_deg is not None:
        return config
    if env.grid is None or log.origin is None:
        lacking = "environment.grid, such as EPSG:32632" if env.grid is None else "the origin or fixes on Earth"
        raise InputError(f"{of_grid[0]} is relative to a grid's north, which needs {lacking}, or convergence_deg")
    found = float(convergence_and_scale(env.grid, *np.array(log.origin))[0])
    assumptions.append(f"environment.convergence_deg {found:.3f}, of {env.grid} at the origin")
    return config.model_copy(update={"environment": env.model_copy(update={"convergence_deg": found})})


def _gravity(log: Log, config: Config, env: Environment, assumptions: list[str]) -> float:
    """Gravity by latitude and by the depth at the start, which holds for the dive [m/s^2]."""
    if env.latitude is None or has_constant_velocity(config):
        return env.gravity
    depth = config.start.down_m
    if depth is None:
        depth = float(np.median(log["depth"].data[:9, 0])) if "depth" in log else 0.0
    gravity = float(env.gravity_at(depth))
    assumptions.append(
        f"environment.gravity_mps2 {gravity:.4f}, normal gravity at latitude {env.latitude:.1f} and a depth of "
        f"{depth:.0f} m"
    )
    return gravity


def _frame(log: Log, config: Config) -> Frame:
    """The frame of a dive: that of its origin, or by its latitude alone.

    Raises
    ------
    InputError : its fixes are in the other one
    """
    if log.origin is None:
        way = length_of_way(log["dvl"].time, log["dvl"].data[:, :3]) if "dvl" in log else 0.0
        return config.frame_at(config.environment.latitude, way=way)
    frame = frame_of(log.origin)
    if config.environment.frame not in ("auto", frame):
        raise InputError(
            f"{log.source}: was read in frame {frame}, and environment.frame is {config.environment.frame}; "
            "read it with this configuration"
        )
    return frame


def _on_earth(log: Log, config: Config, assumptions: list[str]) -> dict[str, float]:
    """What frame "earth" sets: the Earth's rotation, and gravity at the origin where it is not stated.

    Raises
    ------
    InputError : the latitude is unknown, or too high
    """
    env, latitude = config.environment, config.environment.latitude_deg if log.origin is None else log.origin[0]
    if latitude is None:
        raise InputError(
            "environment.frame: earth needs environment.latitude_deg or origin_lat_deg, as the log has no fix_lat"
        )
    if abs(latitude) > HIGHEST_LATITUDE_DEG:
        raise InputError(
            f"environment.frame: earth reaches to latitude {HIGHEST_LATITUDE_DEG:g} deg, and the origin is at "
            f"{latitude:.4g}; state environment.frame: flat"
        )
    if has_constant_velocity(config):
        changes: dict[str, float] = {}
    elif env.earth_rotation is False:
        raise InputError("environment.frame: earth turns with the Earth; remove environment.earth_rotation: false")
    else:
        changes = {"earth_rotation": True}
    text = f"frame earth: WGS 84 at latitude {latitude:.4g} deg, with the Earth's rotation"
    if env.frame == "auto":
        good = config.imu.gyr_bias_sd_dps <= GOOD_GYRO_DPS
        text += f" ({'as the gyro is good' if good else 'as the way is too long for a plane'})"
    if env.gravity_mps2 is None:
        changes["gravity_mps2"] = normal_gravity(float(np.deg2rad(latitude)))
        text += f" and normal gravity, {changes['gravity_mps2']:.5f} m/s2 at the origin"
    assumptions.append(text)
    return changes


def sample_density(time: Array, samples: Array) -> float:
    """Noise density that samples show by themselves, robust against knocks [unit/rtHz].

    Parameters
    ----------
    time : ndarray, shape (n,)
    samples : ndarray, shape (n, 3)
    """
    return float(np.mean(1.4826 * np.median(np.abs(scatter(time, samples)), axis=0)))


def _resolve_noise(log: Log, config: Config, assumptions: list[str]) -> Config:
    """Raise the IMU's noise densities to what its samples scatter in this dive."""
    imu, noise, changes = log["imu"], config.imu.noise, {}
    if len(imu) < ENOUGH_SAMPLES or has_constant_velocity(config):
        return config
    for name, columns in (("acc", slice(0, 3)), ("gyr", slice(3, 6))):
        seen, believed = sample_density(imu.time, imu.data[:, columns]), getattr(noise, name)
        if seen > NOISIER * believed:
            changes[name] = seen
            assumptions.append(f"imu.noise.{name} {seen:.2g} instead of {believed:.2g}: the samples scatter that much")
    if not changes:
        return config
    imu_section = config.imu.model_copy(update={"noise": noise.model_copy(update=changes)})
    return config.model_copy(update={"imu": imu_section})


def _resolve_waves(log: Log, config: Config, assumptions: list[str]) -> Config:
    """State the waves' pressure at the surface, where depths scatter there far more than they should."""
    if "depth" not in log or config.depth.waves_m is not None:
        return config
    seen, believed = waves_at_surface(log["depth"].time, log["depth"]["depth"]), config.depth.sd_m
    waves = 0.0
    if seen > NOISIER * believed:
        waves = round(float(np.sqrt(seen**2 - believed**2)), 3)
        assumptions.append(f"depth.waves_m {waves:g}, as depths scatter at the surface; less further down")
    return config.model_copy(update={"depth": config.depth.model_copy(update={"waves_m": waves})})


def _resolve_sound(log: Log, config: Config, assumptions: list[str]) -> Config:
    """Say how the DVL was corrected for the speed of sound; where it was not, its scale keeps its wide prior."""
    stream = next((log[sensor] for sensor in ("dvl", BEAMS, "dvl_water") if sensor in log), None)
    if not config.knows_sound_speed or stream is None:
        return config
    worked_with, true = SoundCorrection(config).speeds(water_at(stream.time, log.streams))
    ratio = true / worked_with
    if np.isfinite(ratio).all():
        what = "vertical velocities" if config.dvl.beams.phased else "velocities"
        assumptions.append(
            f"speed of sound {_span(true, 0)} m/s, the DVL worked with {_span(worked_with, 0)}: its {what} and ranges "
            f"are multiplied by {_span(ratio, 3)}"
        )
        return config
    lacking = "water_temperature" if np.isfinite(worked_with).all() else "dvl_sound_speed"
    assumptions.append(
        f"the DVL is not corrected for the speed of sound: the log has no {lacking}; state dvl.sound_speed_mps and "
        "dvl.sound_speed_set_mps"
    )
    return config.model_copy(update={"dvl": config.dvl.model_copy(update={"sound_speed_set_mps": None})})


def _span(values: Array, digits: int) -> str:
    low, high = (f"{v:.{digits}f}" for v in (values.min(), values.max()))
    return low if low == high else f"{low} to {high}"


def _attitude(
    log: Log,
    config: Config,
    sensors: dict[str, Instrument],
    sources: list[str],
    first: Level,
    gyro_bias: Array,
    assumptions: list[str],
) -> tuple[Array, Array]:
    """R_nb of the first epoch and the sd of roll, pitch, yaw."""
    start = config.start
    stated = start.roll_deg, start.pitch_deg
    moving = not first.quiet and not has_constant_velocity(config)
    from_log = first_tilt(log) if has_constant_velocity(config) else level_from_force(first.force_b).tolist()
    roll, pitch = (
        tilt if said is None else float(np.deg2rad(said)) for said, tilt in zip(stated, from_log, strict=True)
    )
    tilt_sd = np.deg2rad(start.tilt_sd_deg)
    if moving and (start.roll_deg is None or start.pitch_deg is None):
        tilt_sd = max(tilt_sd, MOVING_TILT_SD)
        assumptions.append(
            "the log begins in motion: roll and pitch at the start are rough until the estimate refines them"
        )
    yaw_sd = np.deg2rad(start.heading_sd_deg)
    if start.heading_deg is None:
        levelled = matrix_from_rpy([roll, pitch, 0.0])
        yaw, source = first_heading(log, config, sensors, sources, levelled, gyro_bias)
        yaw_sd = max(yaw_sd, UNKNOWN_HEADING_SD)
        assumptions.append(f"start.heading_deg {np.rad2deg(yaw) % 360.0:.1f}, from {source}")
    else:
        yaw = np.deg2rad(start.heading_deg)
    return matrix_from_rpy([roll, pitch, yaw]), np.array([tilt_sd, tilt_sd, yaw_sd])


def _attitude_by_gyro(log: Log, config: Config, assumptions: list[str]) -> tuple[Array, Array]:
    """R_nb of the first epoch by the Earth's rate, and the sd of roll, pitch, yaw."""
    start = config.start
    roll, pitch, yaw = rpy_from_matrix(coarse_attitude(log, config)).tolist()
    roll, pitch = (
        tilt if said is None else float(np.deg2rad(said))
        for said, tilt in ((start.roll_deg, roll), (start.pitch_deg, pitch))
    )
    heading, tilt_sd = np.rad2deg(yaw) % 360.0, np.deg2rad(start.tilt_sd_deg)
    assumptions.append(f"start.heading_deg {heading:.1f}, by the Earth's rate in the first {ALIGN_S:.0f} s")
    return matrix_from_rpy([roll, pitch, yaw]), np.array([tilt_sd, tilt_sd, OPEN_SD])


def _bias(config: Config, first: Level, assumptions: list[str]) -> tuple[Array, Array]:
    """Bias of the first keyframe and its sd, shapes (6,)."""
    gyr_sd = np.deg2rad(config.imu.gyr_bias_sd_dps)
    bias, sd = np.zeros(6), np.repeat([config.imu.acc_bias_sd_mps2, gyr_sd], 3)
    if first.shows_bias:
        bias[3:] = first.rate_b
        sd[3:] = min(gyr_sd, float(np.hypot(config.imu.noise.gyr / np.sqrt(first.seconds), STILL_GYR_SD)))
        assumptions.append(
            f"gyro bias from the first {first.seconds:.0f} s, in which the vehicle is assumed to be at rest"
        )
    return bias, sd
