"""Prepares the recursion from a filter, a log and a configuration.

`TrueMotion` is the true motion as the point of linearisation, for studies of the cost of linearisation.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rovgraph.errors import InputError
from rovgraph.geometry import Array, log_rotation, rotate, transpose
from rovgraph.inference.initialise import initialise
from rovgraph.inference.trajectory import Trajectory
from rovgraph.lab.thesis.core import from_matrix, rate_matrix, unit
from rovgraph.lab.thesis.measurements import Accelerometer, DvlModel, ImuModel, Mti, Ping, pings, reference_field
from rovgraph.lab.thesis.processes import (
    ConstantAcceleration,
    HydrodynamicModel,
    KnownAttitude,
    KnownMotion,
    Layout,
    Process,
    known_motion,
    length,
)
from rovgraph.lab.thesis.variants import Filter, Numbers
from rovgraph.log import Log
from rovgraph.model.calibration import MOUNT, Belief
from rovgraph.model.config import Config, beliefs, mount_matrix
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.sensors.instruments import hydrodynamics, instruments

_NEEDED = {
    "imu": "an IMU (acc_x .. gyr_z)",
    "dvl": "DVL velocities (dvl_vx, dvl_vy, dvl_vz)",
    "mag": "a magnetometer (mag_x, mag_y, mag_z)",
    "dvl_heading": "the DVL's compass (dvl_heading)",
    "thruster": "thruster signals (thruster_1, thruster_2, ...)",
}


@dataclass(frozen=True)
class Setup:
    """A filter made ready for a dive.

    Attributes
    ----------
    variant, log, config : the filter, the dive, the effective configuration
    beliefs : of the calibration variables
    process, imu, dvl : models; ``imu`` is None where no inertial sample is a measurement
    known : attitude and rate where they are given, else None
    samples : ndarray, shape (n, m), of the inertial unit at its epochs, field as a fraction
        of ``field_length``; NaN in the field where the epoch has none, which is not measured
    R_imu, R_dvl : ndarray, shapes (m, m), (4, 4)
    field_length : mean length of the log's field, its unit; 1 without magnetometer
    pings : list of Ping
    x, P : ndarray, shapes (n,), (n, n), at the first epoch
    assumptions : a line each
    """

    variant: Filter
    log: Log
    config: Config
    beliefs: dict[str, Belief]
    process: Process
    imu: ImuModel | None
    dvl: DvlModel
    known: KnownMotion | None
    samples: Array
    R_imu: Array
    R_dvl: Array
    field_length: float
    pings: list[Ping]
    x: Array
    P: Array
    assumptions: list[str]

    @property
    def places(self) -> Layout:
        return self.process.layout


def prepare(variant: Filter, log: Log, config: Config) -> Setup:
    """Make a filter ready.

    Raises
    ------
    InputError : the log lacks what the filter needs
    """
    _demand(variant, log, config)
    initial = initialise(log, _with_sources(variant, log, config))
    config, priors = initial.config, beliefs(initial.config)
    known = None
    if variant.attitude_given:
        known = known_motion(log, config, priors, initial.prior.state.bias[0, 3:])
    process = _process(variant, log, config, known)
    sensors = instruments(config)
    field_length = float(np.linalg.norm(log["mag"].data, axis=1).mean()) if variant.magnetometer else 1.0
    samples = _samples(variant, log, field_length)
    used = samples.shape[1]
    x, P = _start(process.layout, variant.numbers, initial, priors)
    assumptions = initial.assumptions + ([f"attitude: {known.source}"] if known else [])
    body = variant.motion != "earth"
    return Setup(
        variant=variant,
        log=log,
        config=config,
        beliefs=priors,
        process=process,
        imu=_imu_model(variant, config, process.layout, known, priors),
        dvl=DvlModel(process.layout, body, sensors, priors, known, variant.compass_mount == "estimated"),
        known=known,
        samples=samples,
        R_imu=variant.numbers.R_mti[:used, :used],
        R_dvl=variant.numbers.R_dvl,
        field_length=field_length,
        pings=pings(log, config, variant.compass),
        x=x,
        P=P,
        assumptions=assumptions,
    )


def _demand(variant: Filter, log: Log, config: Config) -> None:
    """Refuse a log or a configuration that the filter cannot take."""
    needed = ["imu", "dvl"]
    needed += ["mag"] if variant.magnetometer else []
    needed += ["dvl_heading"] if variant.compass else []
    needed += ["thruster"] if variant.motion == "hydrodynamic" else []
    for sensor in needed:
        if sensor not in log:
            raise InputError(f"{log.source}: filter {variant.name} needs {_NEEDED[sensor]}, the log has none")
    if variant.magnetometer and beliefs(config)["mag_deviation"].mean.any():
        raise InputError(
            f"calibration.mag_deviation.mean_deg: filter {variant.name} has no deviation curve of the magnetometer; "
            "set it to 0"
        )
    time = log["imu"].time
    gaps = np.diff(time)
    if len(gaps) and gaps.max() > config.imu.max_gap_s:
        raise InputError(
            f"{log.source}: the IMU is silent for {gaps.max():.1f} s after {time[np.argmax(gaps)]:.3f} s, longer than "
            f"imu.max_gap_s = {config.imu.max_gap_s:g}; split the log there or raise that key"
        )


def _with_sources(variant: Filter, log: Log, config: Config) -> Config:
    """The configuration with the heading sources of the filter in place of its own."""
    if variant.attitude_given:
        sources = ["ahrs" if "ahrs" in log else "mag"]
    else:
        sources = ["mag"] * variant.magnetometer + ["dvl"] * variant.compass
    return config.with_values(heading={"sources": tuple(sources)})


def _process(variant: Filter, log: Log, config: Config, known: KnownMotion | None) -> Process:
    if known is None:
        return ConstantAcceleration(variant)
    if variant.motion == "known_attitude":
        return KnownAttitude(variant, known)
    vehicle, stream, time = hydrodynamics(config), log["thruster"], log["imu"].time
    expected = tuple(f"thruster_{i + 1}" for i in range(len(vehicle.thruster_positions)))
    if stream.columns != expected:
        raise InputError(
            f"{log.source}: filter {variant.name} needs the signal of each of the {len(expected)} vehicle.thrusters, "
            f"the log has {', '.join(stream.columns)}"
        )
    last = np.searchsorted(stream.time, time, side="right") - 1
    signals = np.where(last[:, None] >= 0, stream.data[np.maximum(last, 0)], 0.0)  # held; off before the first
    return HydrodynamicModel(variant, known, vehicle, vehicle.force_and_moment(signals)[0])


def _imu_model(
    variant: Filter, config: Config, places: Layout, known: KnownMotion | None, priors: dict[str, Belief]
) -> ImuModel | None:
    R_bs, arm = mount_matrix(config.imu.mount_rpy_deg), np.asarray(config.imu.lever_arm_m, float)
    gravity = config.environment.gravity
    if known is not None:
        return Accelerometer(places, R_bs, arm, gravity, known) if variant.accelerometer else None
    field_n = reference_field(instruments(config)["mag"], priors)
    return Mti(variant.motion == "body", places, R_bs, arm, gravity, field_n)


def _samples(variant: Filter, log: Log, field_length: float) -> Array:
    """What the MTi measures at each IMU epoch, shape (n, m), m = 9, 6, 3 or 0.

    A sample of the field belongs to the nearest epoch.
    """
    imu = log["imu"]
    if variant.attitude_given:
        return imu.data[:, : 3 if variant.accelerometer else 0]
    if not variant.magnetometer:
        return imu.data
    mag, field = log["mag"], np.full((len(imu), 3), np.nan)
    middles = 0.5 * (imu.time[1:] + imu.time[:-1])
    within = (mag.time >= imu.time[0]) & (mag.time <= imu.time[-1])
    field[np.searchsorted(middles, mag.time[within])] = mag.data[within] / field_length
    return np.hstack([imu.data, field])


def _start(
    places: Layout, numbers: Numbers, initial: InitialConditions, priors: dict[str, Belief]
) -> tuple[Array, Array]:
    """State and covariance at the first epoch; biases begin as (3.15)."""
    start, where = initial.prior, initial.config.start
    R_nb, iron = start.state.R_nb[0], priors["hard_iron"]
    q = from_matrix(R_nb)
    by_angle = 0.5 * rate_matrix(q)
    mean: dict[str, ArrayLike] = {
        "p": [where.north_m or 0.0, where.east_m or 0.0, where.down_m or 0.0],
        "q": q,
        "mag_bias": iron.mean,
        "mount": np.concatenate([priors[name].mean for name in MOUNT]),
    }
    variance: dict[str, ArrayLike] = {
        "a": numbers.acceleration_sd**2,
        "v": start.v_sd**2,
        "p": start.p_sd**2,
        "w": numbers.rate_sd**2,
        "acc_bias": start.bias_sd[:3] ** 2,
        "gyr_bias": np.deg2rad(initial.config.imu.gyr_bias_sd_dps) ** 2,
        "mag_bias": iron.sd**2,
        "mount": [priors[name].sd ** 2 for name in MOUNT],
    }
    x, P = np.zeros(length(places)), np.zeros((length(places),) * 2)
    for name, place in places.items():
        x[place] = mean.get(name, 0.0)
        if name == "q":
            root = by_angle @ R_nb.T * start.rpy_sd
            P[place, place] = root @ root.T
        else:
            P[place, place] = np.diag(np.broadcast_to(np.asarray(variance[name]), (3,)))
    return x, P


class TrueMotion:
    """Acceleration, velocity, position, rate and attitude of a dense true trajectory.

    Parameters
    ----------
    places : layout of the filter's state
    body : its acceleration and velocity are in b; False = in n
    truth : Trajectory, at the IMU's epochs or denser
    """

    def __init__(self, places: Layout, body: bool, truth: Trajectory) -> None:
        self._time, self._q = truth.time, places["q"]
        a_n = np.gradient(truth.v_n, truth.time, axis=0)
        turn = log_rotation(transpose(truth.R_nb[:-1]) @ truth.R_nb[1:]) / np.diff(truth.time)[:, None]
        w_b = np.vstack([turn[:1], 0.5 * (turn[1:] + turn[:-1]), turn[-1:]])
        to_own = transpose(truth.R_nb) if body else np.eye(3)
        q = from_matrix(truth.R_nb)
        q = q * np.cumprod(np.sign(np.concatenate([[1.0], (q[1:] * q[:-1]).sum(axis=1)])))[:, None]
        self._states = np.hstack([rotate(to_own, a_n), rotate(to_own, truth.v_n), truth.p_n, w_b, q])

    def state(self, time: float, x: Array) -> Array:
        """The true motion at ``time``, with the rest of the state as in ``x``."""
        k = int(np.clip(np.searchsorted(self._time, time), 1, len(self._time) - 1))
        share = (time - self._time[k - 1]) / (self._time[k] - self._time[k - 1])
        there = x.copy()
        there[: self._states.shape[1]] = self._states[k - 1] + share * (self._states[k] - self._states[k - 1])
        q = unit(there[self._q])
        there[self._q] = q if q @ x[self._q] >= 0.0 else -q
        return there
