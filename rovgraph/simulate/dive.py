"""A simulated dive: a path, sampled by the same measurement models that estimators use.

Each sensor is sampled at its own epochs by ``model.predict`` with the true state and the
true calibration; noise and faults come on top. All randomness comes from one generator.

The inertial unit measures specific force and angular rate at its lever arm l, in its own axes. With the Earth's rate
w_ie where it is modelled,

    f_b = R_bn (a_n + 2 w_ie x v_n - g_n) + alpha x l + w x (w x l) + 2 w_ie x (w x l)
    y   = R_sb ([f_b, w + R_bn w_ie] + bias) + noise

which is (3.14) with alpha x l kept and the sign of gravity corrected. Biases are in body
axes, as an estimator states them, and walk from sample to sample.

Errors that last are first-order Gauss-Markov processes (Gelb 1974, 3.8) of calibration variables.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import EARTH_RATE, Array, rotate, rpy_from_matrix, transpose, wrap_angle
from rovgraph.inference.gyrocompassing import relies_on_gyro
from rovgraph.inference.trajectory import Trajectory
from rovgraph.kernels import measurement_row as at
from rovgraph.kernels.earth import GRAVITY_PER_DEPTH, latitude_at, normal_gravity, radii
from rovgraph.model.calibration import ACOUSTICS, BEAM_SENSORS, LAYERS, WATER_LAYER
from rovgraph.model.config import Config, ImuNoise, beliefs, mount_matrix
from rovgraph.model.state import State
from rovgraph.problem.beams import beam_contexts
from rovgraph.sensors import SENSORS, field_direction
from rovgraph.sensors.dvl_beam import beam_columns, beam_geometry, beam_sd, velocity_by_beams
from rovgraph.sensors.instruments import instruments
from rovgraph.sensors.water_layer import VELOCITIES
from rovgraph.simulate.acoustic import AcousticSampler, has_acoustics, lay_beacons, ship_path
from rovgraph.simulate.environment import compass_turn
from rovgraph.simulate.path import Motion, Path
from rovgraph.simulate.truth import Truth, correlated, of_waves, remembered


def in_frame(path: Path, truth: Truth) -> tuple[Path, Truth]:
    """A path and its truth in the frame that is stated, or chosen as for the log of the dive."""
    config, env = truth.config, truth.config.environment
    steps = np.diff(path.motion(np.linspace(0.0, path.duration, 1000)).p_n, axis=0)
    way = float(np.linalg.norm(steps, axis=1).sum()) if truth.fix_interval is None else 0.0
    config = config.with_values(environment={"frame": config.frame_at(env.latitude, way=way)})
    return replace(path, latitude=config.environment.earth_latitude), replace(truth, config=config)


def _turning(motion: Motion, config: Config) -> tuple[Array, Array, Array]:
    """Rate of the Earth and of the axes of n [rad/s], and gravity [m/s^2], in n, shape (n, 3) each.

    Raises
    ------
    InputError : the Earth's rotation or frame is modelled, but the latitude is not known
    """
    env = config.environment
    w_ie, w_in, g_n = (np.zeros((len(motion), 3)) for _ in range(3))
    g_n[:, 2] = env.gravity_at(motion.p_n[:, 2])
    if env.latitude is None and (env.earth_rotation or env.frame == "earth"):
        modelled = "frame: earth" if env.frame == "earth" else "earth_rotation"
        raise InputError(f"environment.{modelled} needs environment.latitude_deg")
    if env.latitude is None:
        return w_ie, w_in, g_n
    latitude = np.full(len(motion), np.deg2rad(env.latitude))
    if env.frame == "earth":
        latitude = latitude_at(env.earth_latitude, motion.p_n[:, 0])
        M, N = radii(latitude)
        north, east = motion.v_n[:, 0] / (M - motion.p_n[:, 2]), motion.v_n[:, 1] / (N - motion.p_n[:, 2])
        w_in = np.column_stack([east, -north, -east * np.tan(latitude)])
        g_n[:, 2] = env.gravity + normal_gravity(latitude) - normal_gravity(env.earth_latitude)
        g_n[:, 2] += GRAVITY_PER_DEPTH * motion.p_n[:, 2]
    if env.frame == "earth" or env.earth_rotation or relies_on_gyro(config):
        w_ie = EARTH_RATE * np.column_stack([np.cos(latitude), np.zeros(len(motion)), -np.sin(latitude)])
    return w_ie, w_ie + w_in, g_n


def specific_force_and_rate(motion: Motion, config: Config) -> Array:
    """Measurements of a perfect unit, in body axes.

    Parameters
    ----------
    motion : Motion of n epochs
    config : Config

    Returns
    -------
    ndarray, shape (n, 6), specific force [m/s^2], angular rate [rad/s]
    """
    arm = np.asarray(config.imu.lever_arm_m, float)
    w_ie_n, w_in_n, g_n = _turning(motion, config)
    R_bn = transpose(motion.R_nb)
    w_in_b = rotate(R_bn, w_in_n)
    swing = np.cross(motion.w_b, arm)
    f_b = rotate(R_bn, motion.a_n + np.cross(w_ie_n + w_in_n, motion.v_n) - g_n)
    f_b += np.cross(motion.alpha_b, arm) + np.cross(motion.w_b, swing) + 2.0 * np.cross(w_in_b, swing)
    return np.hstack([f_b, motion.w_b + w_in_b])


def walk(start: Array, noise: ImuNoise, rate: float, n: int, rng: np.random.Generator) -> Array:
    """Bias of n samples, a random walk from ``start``; shape (n, 6)."""
    sd = np.repeat([noise.acc_walk, noise.gyr_walk], 3) / np.sqrt(rate)
    steps = sd * rng.standard_normal((n, 6))
    steps[0] = start
    return np.cumsum(steps, axis=0)


def white(noise: ImuNoise, rate: float, n: int, rng: np.random.Generator) -> Array:
    """White noise of n samples at ``rate`` [Hz]: density times root rate; shape (n, 6)."""
    sd = np.repeat([noise.acc, noise.gyr], 3) * np.sqrt(rate)
    return np.asarray(sd * rng.standard_normal((n, 6)))


def to_imu_axes(values_b: Array, config: Config) -> Array:
    """Body axes to IMU axes, accelerometer and gyro; shape (n, 6)."""
    R_sb = mount_matrix(config.imu.mount_rpy_deg).T
    return np.hstack([rotate(R_sb, values_b[:, :3]), rotate(R_sb, values_b[:, 3:])])


STEPS = 50  # of a process, in its time constant


@dataclass(frozen=True)
class LastingErrors:
    """Errors that last, of calibration variables.

    Attributes
    ----------
    series : variable -> time, ndarray, shape (k,) [s], and its values, shape (k, dim), linear in between
    """

    series: Mapping[str, tuple[Array, Array]]

    def at(self, time: Array) -> dict[str, Array]:
        """Variable -> ndarray, shape (n, dim), at n epochs [s]."""
        return {
            name: np.column_stack([np.interp(time, times, values) for values in every.T])
            for name, (times, every) in self.series.items()
        }


def draw_lasting(
    truth: Truth, calibration: Mapping[str, Array], seconds: float, rng: np.random.Generator
) -> LastingErrors:
    """A process for each variable that is estimated with a time constant and has no value given.

    Parameters
    ----------
    truth : has their times
    calibration : where they begin
    seconds : how long they go on [s]
    rng : the same seed gives the same errors; its own stream stays as it is
    """
    series: dict[str, tuple[Array, Array]] = {}
    for child, (name, belief) in zip(rng.spawn(len(beliefs(truth.config))), beliefs(truth.config).items(), strict=True):
        lasts = belief.estimate and np.isfinite(belief.time_constant) and not of_waves(belief)
        if truth.noise and lasts and name not in truth.calibration:
            step = belief.time_constant / STEPS
            time = step * np.arange(int(seconds / step) + 2.0)
            white = belief.sd * child.standard_normal((len(time), belief.variable.dim))
            white[0] = calibration[name] - belief.mean
            series[name] = time, belief.mean + remembered(white, STEPS)
    return LastingErrors(series)


IMU_COLUMNS = ["acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z"]
MAG_COLUMNS = ["mag_x", "mag_y", "mag_z"]
DVL_COLUMNS = ["dvl_vx", "dvl_vy", "dvl_vz"]
WATER_COLUMNS = ["dvl_water_vx", "dvl_water_vy", "dvl_water_vz"]
TIME_STEP = 1e-4  # resolution of the log's clock [s]
PASSING_STEP = 0.02  # between epochs at which it is seen whether a place is near [s]
COMPASS_RATE = 10.0  # of compasses that only the configuration names [Hz]
PROFILE_S, PROFILE_M = 2.0, 2.0  # between profiles, and depths that the current is drawn at
BEAM_ANGLE = np.deg2rad(30.0)  # of an ADCP, whose side lobes see the bottom
BOTTOM_BELOW_M = 5.0  # the deepest point of a path, for a DVL's beams
RANGE_SD_M = 0.02  # of a beam
AHRS_TILT_SD = float(np.deg2rad(0.5))  # noise of the unit's own roll and pitch [rad]


@dataclass(frozen=True)
class Dive:
    """A simulated dive and its hidden truth.

    Attributes
    ----------
    log_frame : the log, sparse and wide, columns of the log's contract, sorted by time
    truth : Trajectory at the IMU's epochs, without uncertainty
    hidden : "calibration": name -> ndarray, shape (dim,), of an error that lasts at the end of the dive; "lasting":
        `LastingErrors`, all of these; "bias": ndarray, shape (n, 6), at the epochs of ``truth``; "start_offset":
        ndarray, shape (3,) [m]; "world": name -> ndarray, other true values, hidden from an estimator
    path : the path that was followed
    """

    log_frame: pd.DataFrame
    truth: Trajectory
    hidden: dict[str, Any]
    path: Path

    def between(self, begin: float, end: float) -> "Dive":
        """What it would be if the recorder had run from one time to another [s] only."""
        time = self.log_frame["time"]
        log = self.log_frame[(time >= begin) & (time <= end)].reset_index(drop=True)
        inside = (self.truth.time >= begin) & (self.truth.time <= end)
        hidden = {**self.hidden, "bias": self.hidden["bias"][inside]}
        return replace(self, log_frame=log, truth=self.truth.take(inside), hidden=hidden)


def simulate(path: Path, truth: Truth, rng: np.random.Generator) -> Dive:
    """Sample every sensor along a path.

    Parameters
    ----------
    path : Path
    truth : Truth
    rng : numpy Generator; the same seed gives the same dive
    """
    acoustic = rng.spawn(1)[0] if has_acoustics(truth.config) else None  # the dives of old seeds stay
    single = rng.spawn(1)[0] if beam_geometry(truth.config.dvl) is not None else None
    if acoustic is not None:
        places = lay_beacons(truth.config, path, acoustic if truth.noise else None)
        truth = replace(truth, calibration={**places, **truth.calibration})
    calibration = truth.draw_calibration(rng)
    lasting = draw_lasting(truth, calibration, path.duration, rng)
    bias_start, offset = truth.draw_bias(rng), truth.draw_start(rng)
    path, truth = in_frame(path.shifted(offset), truth)
    time = np.round(np.arange(int(path.duration * truth.imu_rate + 1e-6) + 1) / truth.imu_rate, 4)
    motion = path.motion(time)
    bias = np.broadcast_to(bias_start, (len(time), 6))
    if truth.noise:
        bias = walk(bias_start, truth.config.imu.noise, truth.imu_rate, len(time), rng)
    sample = _Sampler(truth, calibration, lasting, rng)
    frames = [_inertial(sample, path, motion, bias), _pings(sample, path, single)]
    makers = (_depths, _attitudes, _autopilot_headings, _fixes, _signals, _sightings)
    frames += [frame for make in makers if (frame := make(sample, path)) is not None]
    frames += [_regular(sample, path, s.name, 1.0 / s.simulated_hz) for s in SENSORS.values() if s.simulated_hz]
    world = _world(truth)
    if truth.profiles is not None:
        frames.append(_profiles(sample, path, truth.profiles, world))
    if acoustic is not None:
        frames += _acoustics(sample, path, acoustic)
    log = pd.concat(frames, ignore_index=True)
    log = log.sort_values("time", kind="stable", ignore_index=True)
    calibration |= {name: values[-1] for name, values in lasting.at(time).items()}
    geometry = beam_geometry(truth.config.dvl)
    heads = () if geometry is None else tuple(BEAM_SENSORS[k] for k in geometry.numbers)
    missing = {*BEAM_SENSORS} - {*heads} | ({*ACOUSTICS} if acoustic is None else set())
    absent = {
        name
        for name, belief in beliefs(truth.config).items()
        if belief.streams == () or {*belief.variable.sensors} <= missing or name in LAYERS
    }
    calibration = {name: value for name, value in calibration.items() if name not in absent}
    hidden = {"calibration": calibration, "bias": np.array(bias), "start_offset": offset, "world": world}
    hidden["lasting"] = lasting
    return Dive(log, Trajectory.certain(time, motion.p_n, motion.R_nb, motion.v_n), hidden, path)


def _world(truth: Truth) -> dict[str, Any]:
    """What there is around the vehicle beside its calibration: iron, a raw magnetometer, places."""
    iron, distortion = truth.magnetism.iron, truth.magnetism.distortion
    world: dict[str, Any] = {}
    if len(iron.p_n):
        world |= {"iron_p_n": iron.p_n, "iron_moment_n": iron.moment_n}
    if truth.places:
        world["places"] = np.array(truth.places)
    if distortion is not None:
        world |= {"mag_scale": distortion.scale, "mag_offset": distortion.offset}
    return world


class _Sampler:
    """Samples the measurement models at the true state."""

    def __init__(
        self, truth: Truth, calibration: Mapping[str, Array], lasting: LastingErrors, rng: np.random.Generator
    ) -> None:
        self.truth, self.calibration, self.lasting, self.rng = truth, calibration, lasting, rng
        self.instruments = instruments(truth.config)
        self.covariances = truth.covariances if truth.noise else None

    @property
    def heading_sources(self) -> Sequence[str]:
        """Compasses that the configuration names; the log has to have them, or it could not smooth its own dive."""
        return self.truth.config.heading.sources or ()

    def motion(self, sensor: str, path: Path, stamps: Array) -> Motion:
        """The motion that a sensor measured: stamps are late by its time offset."""
        offset = self.instruments[sensor].time_offset
        late = 0.0 if offset is None else float(self.calibration[offset][0])
        return path.motion(np.clip(stamps - late, 0.0, path.duration))

    def state(self, motion: Motion) -> State:
        """The true state; biases are none of the sensors' that have models."""
        calibration = {**self.calibration, **self.lasting.at(motion.time)}
        return State(motion.R_nb, motion.p_n, motion.v_n, np.zeros((len(motion), 6)), calibration)

    def exact(self, sensor: str, motion: Motion) -> Array:
        """The measurement without noise, shape (n, dim)."""
        z = self.instruments[sensor].model.predict(self.state(motion), motion.w_b)[0]
        return self._disturbed(sensor, motion, z) if len(self.truth.magnetism.iron.p_n) else z

    def _disturbed(self, sensor: str, motion: Motion, z: Array) -> Array:
        """The measurement of a magnetic sensor among iron."""
        config = self.truth.config
        arm = config.dvl.lever_arm_m if sensor == "dvl_heading" else config.imu.lever_arm_m
        iron_n = self.truth.magnetism.iron.field(motion.p_n + rotate(motion.R_nb, arm))
        if sensor == "mag":
            R_sb = mount_matrix(config.imu.mount_rpy_deg).T
            return z + self.magnitude * rotate(R_sb, rotate(transpose(motion.R_nb), iron_n))
        if sensor in ("ahrs", "dvl_heading"):
            return wrap_angle(z - compass_turn(self.field_n, iron_n)[:, None])
        return z

    @property
    def magnitude(self) -> float:
        """Magnitude of the field that is believed, the unit of the magnetometer's samples."""
        norm = self.truth.config.environment.field_norm
        return 1.0 if norm is None else norm

    @property
    def field_n(self) -> Array:
        """The Earth's field where the dive is, as a fraction of the one believed; shape (3,)."""
        model: Any = self.instruments["mag"].model
        dip = model.dip + self.calibration["field_dip"][0]
        return np.asarray((1.0 + self.calibration["field_scale"][0]) * field_direction(model.declination, dip))

    def noisy(self, sensor: str, motion: Motion) -> Array:
        """The measurement with the noise of the configuration, shape (n, dim)."""
        z = self.exact(sensor, motion)
        z = z + self.noise(self.instruments[sensor].sd, z.shape)
        return wrap_angle(z) if self.instruments[sensor].model.angular else z

    def noise(self, sd: Array | float, shape: tuple[int, ...]) -> Array:
        """White noise, zero where the truth has none."""
        draw = self.rng.standard_normal(shape)
        return draw * sd if self.truth.noise else np.zeros(shape)

    def epochs(self, path: Path, interval: float, jitter: float = 0.0) -> Array:
        """Epochs of a sensor with its own clock: a random first one, then at intervals."""
        count = int(path.duration / (interval * (1.0 - jitter))) + 2
        steps = interval * (1.0 + jitter * self.rng.uniform(-1.0, 1.0, count))
        steps[0] *= self.rng.uniform()
        time = np.round(np.cumsum(steps) / TIME_STEP) * TIME_STEP
        return np.round(time[time <= path.duration], 4)


def _frame(time: Array, columns: list[str], values: Array) -> pd.DataFrame:
    frame = pd.DataFrame(values, columns=pd.Index(columns))
    frame.insert(0, "time", time)
    return frame


def _inertial(sample: _Sampler, path: Path, motion: Motion, bias: Array) -> pd.DataFrame:
    """Accelerometer, gyro and magnetometer, one row per sample."""
    truth, rng, n = sample.truth, sample.rng, len(motion)
    signal = specific_force_and_rate(motion, truth.config)
    scale = np.concatenate([sample.calibration["acc_scale"], sample.calibration["gyr_scale"]])
    values = to_imu_axes(signal + bias, truth.config) + scale * to_imu_axes(signal, truth.config)
    if truth.vibration is not None:
        values[:, :3] += truth.vibration.at(motion.time, rng)
    seen = sample.motion("mag", path, motion.time) if sample.calibration["mag_time_offset"].any() else motion
    if sample.covariances is None:
        if truth.noise:
            values = values + white(truth.config.imu.noise, truth.imu_rate, n, rng)
        field = sample.noisy("mag", seen)
    else:
        at_this_rate = sample.covariances.imu * (truth.imu_rate / sample.covariances.imu_rate)
        noise = correlated(at_this_rate, n, rng)
        values, field = values + noise[:, :6], sample.exact("mag", seen) + sample.magnitude * noise[:, 6:]
    if truth.magnetism.distortion is not None:
        field = truth.magnetism.distortion.raw(field)
    return _frame(motion.time, IMU_COLUMNS + MAG_COLUMNS, np.hstack([values, field]))


def _pings(sample: _Sampler, path: Path, single: np.random.Generator | None) -> pd.DataFrame:
    """DVL velocity, its validity and its compass, one row per ping; each beam where ``single`` draws its noise."""
    truth, rng = sample.truth, sample.rng
    stamps = sample.epochs(path, 1.0 / truth.dvl_rate, truth.dvl_jitter)
    motion = sample.motion("dvl", path, stamps)
    velocity = sample.exact("dvl", motion)
    if sample.covariances is None:
        noise, speed = None, np.linalg.norm(velocity, axis=1)[:, None]
        sd = np.hypot(sample.instruments["dvl"].sd, truth.config.dvl.scale_sd * speed)
        velocity = velocity + sample.noise(sd, velocity.shape)
    else:
        noise = correlated(sample.covariances.dvl, len(motion), rng)
        velocity = velocity + noise[:, :3]
    wrong = (rng.uniform(size=len(motion)) < truth.outlier_share) & truth.noise
    off = np.zeros_like(velocity)
    off[wrong] = truth.outlier_size * rng.standard_normal((int(wrong.sum()), 3))
    lost = np.zeros(len(motion), bool)
    for begin, end in truth.dropouts:
        lost |= (stamps >= begin) & (stamps <= end)
    beams = None if single is None else _beams(sample, path, motion, off, lost, single)
    frame = _frame(stamps, DVL_COLUMNS, velocity + off if beams is None else beams[0])
    frame.loc[lost, DVL_COLUMNS] = np.nan
    frame["dvl_valid"] = pd.array(np.where(lost, 0, 1), dtype="Int64")
    if noise is None:
        heading = sample.noisy("dvl_heading", motion)
    else:
        heading = wrap_angle(sample.exact("dvl_heading", motion) + noise[:, 3:])
    frame["dvl_heading"] = heading[:, 0]
    if truth.water_track:
        frame[WATER_COLUMNS] = sample.noisy("dvl_water", motion)
    return frame if beams is None else pd.concat([frame, beams[1]], axis=1)


def _beams(
    sample: _Sampler, path: Path, motion: Motion, off: Array, lost: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[Array, pd.DataFrame]:
    """Each beam of n pings over a level bottom, and the velocity that the instrument makes of them, shape (n, 3).

    Parameters
    ----------
    off : ndarray, shape (n, 3), error of wrong pings, DVL axes [m/s]
    lost : ndarray, shape (n,), pings without bottom lock
    """
    config, state = sample.truth.config, sample.state(motion)
    geometry = beam_geometry(config.dvl)
    assert geometry is not None
    arm_b, down = np.array(config.dvl.lever_arm_m), geometry.directions @ mount_matrix(config.dvl.mount_rpy_deg).T
    bottom = float(path.motion(np.linspace(0.0, path.duration, 500)).p_n[:, 2].max()) + BOTTOM_BELOW_M
    slant = np.einsum("ni,ki->nk", motion.R_nb[:, 2], down)  # cosine of the angle to the vertical
    above = bottom - motion.p_n[:, 2] - motion.R_nb[:, 2] @ arm_b
    far = np.where(slant > 0.1, above[:, None] / np.maximum(slant, 0.1), np.nan)
    context = np.repeat(beam_contexts(config, np.zeros(3))[None], len(motion), axis=0)
    context[:, :, at.ALTITUDE] = np.nan_to_num((far * geometry.directions[:, 2]).mean(axis=1))[:, None]
    b = off @ geometry.directions.T
    for k, number in enumerate(geometry.numbers):
        model: Any = sample.instruments[BEAM_SENSORS[number]].model
        exact = model.of(context[:, k]).predict(state, motion.w_b)[0][:, 0]
        sd = np.hypot(beam_sd(config.dvl), config.dvl.scale_sd * exact)
        b[:, k] += exact + (sd * rng.standard_normal(len(motion)) if sample.truth.noise else 0.0)
    if sample.truth.noise:
        far = far + RANGE_SD_M * rng.standard_normal(far.shape)
    columns: dict[str, Any] = {}
    for k, number in enumerate(geometry.numbers):
        valid, velocity, distance, *_ = beam_columns(number)
        columns[valid] = pd.array(np.where(lost, 0, 1), dtype="Int64")
        columns |= {velocity: np.where(lost, np.nan, b[:, k]), distance: np.where(lost, np.nan, far[:, k])}
    return velocity_by_beams(geometry.directions, b, np.ones(b.shape, bool))[0], pd.DataFrame(columns)


def _profiles(sample: _Sampler, path: Path, cells: tuple[float, float], world: dict[str, Any]) -> pd.DataFrame:
    """Velocities relative to the water in cells below the DVL, a row each; they end at the bottom where there is lock.

    The current is the one of the calibration, with a Gauss-Markov process of depth on it, as ``water`` states it:
    ``world`` gets that.
    """
    truth, water = sample.truth, sample.truth.config.water
    motion = sample.motion(WATER_LAYER, path, sample.epochs(path, PROFILE_S))
    far = cells[0] * np.arange(1.0, int(cells[1]) + 1.0)
    dvl = truth.config.dvl
    down = far * np.abs(motion.R_nb @ mount_matrix(dvl.mount_rpy_deg))[:, 2, 2:]
    depth = motion.p_n[:, 2:] + rotate(motion.R_nb, dvl.lever_arm_m)[:, 2:] + down
    grid = np.arange(min(float(depth.min()), 0.0), float(depth.max()) + PROFILE_M, PROFILE_M)
    white = water.current_sd_mps * sample.noise(1.0, (len(grid), 2))
    current = remembered(white, water.correlation_m / PROFILE_M) + sample.calibration["current"]
    world |= {"current_depth": grid, "current_n": current}
    model: Any = sample.instruments[WATER_LAYER].model
    context = np.repeat(model.context, len(motion), axis=0)
    context[:, at.SHARE] = 0.0
    still, by = model.of(context).predict(sample.state(motion), motion.w_b)  # linear in the current
    here = np.stack([np.interp(depth, grid, column) for column in current.T], axis=-1)
    values = still[:, None] + np.einsum("nij,nkj->nki", by[LAYERS[0]], here)
    values = values + sample.noise(np.array(water.cell_sd_mps), values.shape)
    bottom = float(path.motion(np.linspace(0.0, path.duration, 500)).p_n[:, 2].max()) + BOTTOM_BELOW_M
    lost = np.zeros(len(motion), bool)
    for begin, end in truth.dropouts:
        lost |= (motion.time >= begin) & (motion.time <= end)
    seen = lost[:, None] | (depth - depth[:, :1] + far[0] < (bottom - depth[:, :1] + far[0]) * np.cos(BEAM_ANGLE))
    time, ranges = (np.broadcast_to(x, depth.shape)[seen] for x in (motion.time[:, None], far))
    frame = _frame(time, [*VELOCITIES], values[seen])
    return frame.assign(adcp_range=ranges, adcp_cell=cells[0])


def _depths(sample: _Sampler, path: Path) -> pd.DataFrame | None:
    rate = sample.truth.depth_rate
    return None if rate is None else _regular(sample, path, "depth", 1.0 / rate)


def _attitudes(sample: _Sampler, path: Path) -> pd.DataFrame | None:
    """The inertial unit's own fused attitude: roll and pitch of its axes, a compass heading."""
    truth = sample.truth
    rate = truth.ahrs_rate or (COMPASS_RATE if "ahrs" in sample.heading_sources else None)
    if rate is None:
        return None
    stamps = sample.epochs(path, 1.0 / rate)
    motion = sample.motion("ahrs", path, stamps)
    memory = truth.ahrs_memory * rate
    tilt = rpy_from_matrix(motion.R_nb @ mount_matrix(truth.config.imu.mount_rpy_deg))[:, :2]
    tilt = tilt + remembered(sample.noise(AHRS_TILT_SD, tilt.shape), memory)
    yaw = sample.exact("ahrs", motion)
    yaw = yaw + remembered(sample.noise(sample.instruments["ahrs"].sd, yaw.shape), memory)
    return _frame(stamps, ["ahrs_roll", "ahrs_pitch", "ahrs_yaw"], wrap_angle(np.hstack([tilt, yaw])))


def _autopilot_headings(sample: _Sampler, path: Path) -> pd.DataFrame | None:
    """The autopilot's heading, where the configuration names it as a source; it changes no draw of other sensors."""
    if "vehicle" not in sample.heading_sources:
        return None
    apart = copy(sample)
    (apart.rng,) = sample.rng.spawn(1)
    return _regular(apart, path, "vehicle_heading", 1.0 / COMPASS_RATE)


def _fixes(sample: _Sampler, path: Path) -> pd.DataFrame | None:
    interval = sample.truth.fix_interval
    return None if interval is None else _regular(sample, path, "fix", interval)


def _regular(sample: _Sampler, path: Path, sensor: str, interval: float) -> pd.DataFrame:
    """A sensor with a clock of its own and white noise; its first columns are the measurement."""
    stamps = sample.epochs(path, interval)
    z = sample.noisy(sensor, sample.motion(sensor, path, stamps))
    return _frame(stamps, list(SENSORS[sensor].column_names[: z.shape[1]]), z)


def _sightings(sample: _Sampler, path: Path) -> pd.DataFrame | None:
    """Places that are recognised, once whenever one is passed, and some that only look like it.

    A landmark is where the camera comes nearest to the place as it sees it, off by the noise.
    """
    truth, sd = sample.truth, sample.instruments["place"].sd
    if not truth.places:
        return None
    motion = path.motion(np.arange(0.0, path.duration, PASSING_STEP))
    away = np.array([_offset(sample, motion, np.array(place)) for place in truth.places])
    distance = np.linalg.norm(away, axis=2)
    around = distance < 2.0 * truth.place_radius  # until it has left this far behind, it does not pass it again
    seen = []
    for k, offset in enumerate(away):
        for first, last in _stretches(around[k]):
            if distance[k, first : last + 1].min() < truth.place_radius:
                missed = np.linalg.norm(offset[first : last + 1] - sample.noise(sd, (2,)), axis=1)
                seen.append((motion.time[first + int(np.argmin(missed))], k + 1))
    false = round(len(seen) * truth.false_places / (1.0 - truth.false_places)) if truth.noise else 0
    elsewhere = np.argwhere(~around)
    for k, epoch in elsewhere[sample.rng.integers(len(elsewhere), size=false)].tolist():
        seen.append((motion.time[epoch], k + 1))
    frame = pd.DataFrame(seen, columns=pd.Index(["time", "place_id"])).drop_duplicates("time")
    return frame.assign(place_id=frame["place_id"].astype("Int64"))


def _offset(sample: _Sampler, motion: Motion, place: Array) -> Array:
    """Of the camera from a place, north and east, shape (n, 2)."""
    state = State(motion.R_nb, motion.p_n, motion.v_n, np.zeros((len(motion), 6)), sample.calibration).seeing(place)
    return sample.instruments["place"].model.predict(state, motion.w_b)[0]


def _stretches(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of every stretch of True."""
    steps = np.diff(np.concatenate([[0], flags.astype(np.int8), [0]]))
    return list(zip(np.flatnonzero(steps == 1).tolist(), (np.flatnonzero(steps == -1) - 1).tolist(), strict=True))


def _acoustics(sample: _Sampler, path: Path, rng: np.random.Generator) -> list[pd.DataFrame]:
    """The ship, and what its head and ranges measure."""
    truth = sample.truth

    def epochs(time: Array) -> tuple[State, Array]:
        motion = path.motion(np.clip(time, 0.0, path.duration))
        return sample.state(motion), motion.w_b

    ship = ship_path(None, path, rng if truth.noise else None) if truth.ship is None else truth.ship
    late = {sensor: float(sample.calibration[f"{sensor}_time_offset"][0]) for sensor in ("usbl", "range")}
    noise = rng if truth.noise else None
    return AcousticSampler(truth.config, sample.instruments, ship, epochs, late, noise).frames()


def _signals(sample: _Sampler, path: Path) -> pd.DataFrame | None:
    """Drive signals of the thrusters, as they were given."""
    if path.thrusters is None:
        return None
    signals = np.round(path.thrusters.signals, 2)
    return _frame(path.thrusters.time, [f"thruster_{i + 1}" for i in range(signals.shape[1])], signals)
