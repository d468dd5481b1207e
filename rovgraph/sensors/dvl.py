"""The Doppler velocity log: velocity over ground and through the water."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array, matrix_from_rpy, rpy_from_matrix, skew
from rovgraph.kernels import measurements as kernels
from rovgraph.model.calibration import MOUNT
from rovgraph.model.config import Config, mount_matrix
from rovgraph.model.state import BIAS, POSE, VELOCITY, Jacobians, State
from rovgraph.sensors.model import evaluate
from rovgraph.sensors.sensor import LARGEST_SD, Column, Instrument, Observed, Said, Sensor, instrument

VELOCITIES = ("dvl_vx", "dvl_vy", "dvl_vz")
TIME_OFFSET = "dvl_time_offset"  # of the stamps of all that a ping measures
LOCKED = 0.8  # share of pings with bottom lock that is usual
KNOWN_YAW_SD_DEG = 10.0  # sd of the yaw's prior up to which the mounting determines the direction of the rate's noise


def axes_remedy(H: Array, R_bs: Array, names: Sequence[str] = VELOCITIES) -> tuple[str, str]:
    """Cause and remedy where velocities agree with the IMU once their axes are named otherwise.

    Left-handed axes are a mounting after one sign is reversed: the one that leaves the smallest turn.

    Parameters
    ----------
    H : ndarray, shape (3, 3), signed permutation that turns measured velocities into right ones
    R_bs : ndarray, shape (3, 3), mounting as configured, or as it fits
    names : columns of the velocities
    """
    if np.linalg.det(H) > 0.0:
        return "its mounting is not as configured", f"state dvl.mount_rpy_deg: {_rpy_deg(R_bs @ H)}"
    named = ["-" * int(row.min() < 0.0) + names[int(np.abs(row).argmax())] for row in H]
    wrong = int(np.diagonal(H).argmin())
    turn = H.copy()
    turn[:, wrong] *= -1.0
    remedy = f"reverse the sign of {names[wrong]}, units: {{{names[wrong]}: -m/s}}"
    if not np.array_equal(turn, np.eye(3)):
        remedy += f", and state dvl.mount_rpy_deg: {_rpy_deg(R_bs @ turn)}"
    return f"its axes are left-handed and should be {', '.join(named)}", remedy


def other_way_up(config: Config) -> str:
    """A hint at a DVL that is mounted the other way up."""
    roll, pitch, yaw = config.dvl.mount_rpy_deg
    turned, z, y = (180, "up", "port") if abs(roll) < 90 else (0, "down", "starboard")
    return (
        f"if the DVL's z axis points {z} and y to {y}, state dvl.mount_rpy_deg: [{turned}, {pitch:g}, {yaw:g}] "
        "and determine its yaw again"
    )


def _rpy_deg(R_bs: Array) -> list[float]:
    """Roll, pitch and yaw as dvl.mount_rpy_deg has them."""
    return [round(float(a), 1) + 0.0 for a in np.rad2deg(rpy_from_matrix(R_bs[None])[0])]


def dvl_mounting(state: State) -> Array:
    """R_bs of the DVL for each epoch, shape (n, 3, 3)."""
    rpy = np.empty((len(state), 3))
    for k, name in enumerate(MOUNT):
        rpy[:, k] = state.calibration[name][..., 0]
    return matrix_from_rpy(rpy)


@dataclass(frozen=True)
class DvlVelocity:
    """Velocity of the DVL in its own axes, over ground (3.17) or relative to the water.

    Attributes
    ----------
    lever_arm_b : ndarray, shape (3,) or (n, 3), DVL relative to the state's origin [m]
    sensor : "dvl" over ground, "dvl_water" relative to the water
    """

    lever_arm_b: Array
    sensor: str = "dvl"
    dim = 3
    angular = False
    state = (POSE, VELOCITY, BIAS)

    @property
    def calibration(self) -> tuple[str, ...]:
        return (*DVL_CALIBRATION, *(("current",) if self.sensor == "dvl_water" else ("dvl_error", "bottom_velocity")))

    @property
    def kind(self) -> int:
        return kernels.DVL_WATER if self.sensor == "dvl_water" else kernels.DVL

    @cached_property
    def packed(self) -> Array:
        """The lever arm."""
        return np.array(self.lever_arm_b, dtype=float, ndmin=2)

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        return evaluate(self, self.state, state, rate_b)


DVL_CALIBRATION = ("dvl_roll", "dvl_pitch", "dvl_yaw", "dvl_scale", "dvl_lever_arm")  # that all it measures depends on


def over_ground(config: Config, origin_b: Array) -> Instrument:
    """Bottom track."""
    return _instrument("dvl", config.dvl.velocity_sd_mps, config, origin_b)


def through_water(config: Config, origin_b: Array) -> Instrument:
    """Water track."""
    return _instrument("dvl_water", config.dvl.water_velocity_sd_mps, config, origin_b)


def _instrument(sensor: str, sd: tuple[float, float, float], config: Config, origin_b: Array) -> Instrument:
    dvl = config.dvl
    model = DvlVelocity(np.array(dvl.lever_arm_m) - origin_b, sensor)
    gain = mount_matrix(dvl.mount_rpy_deg).T @ skew(-model.lever_arm_b)
    yaw = config.calibration.dvl_yaw  # type: ignore[attr-defined]
    if yaw.estimate is True and yaw.sd_deg > KNOWN_YAW_SD_DEG:
        gain = _evenly(gain)
    return instrument(dvl, model, sd, ("x", "y", "z"), gain, TIME_OFFSET)


def _evenly(gain: Array) -> Array:
    """A gain that spreads the rate's noise evenly over x and y, for a DVL whose yaw is unknown.

    Noise that is larger along one axis draws the estimated yaw towards the one for which it was calculated.
    """
    variance = np.diag(gain @ gain.T)
    level = 0.5 * (variance[0] + variance[1])
    return np.diag(np.sqrt([level, level, variance[2]]))


def _refused(values: Array, config: Config) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    yield "no bottom lock", values[:, 3] == 0.0
    yield from _too_fast(values, config)


def _too_fast(values: Array, config: Config) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    yield "faster than dvl.max_speed_mps", np.abs(values[:, :3]).max(axis=1) > config.dvl.max_speed_mps


def _standard_deviation(values: Array, believed: Instrument, config: Config) -> Array:
    """The instrument's sd, or the ping's own where that is more, and a part of the speed."""
    sd = believed.sd
    if values[4] > 0.0:
        sd = np.maximum(sd, min(values[4], LARGEST_SD))
    if config.dvl.scale_sd:
        sd = np.hypot(sd, config.dvl.scale_sd * np.linalg.norm(values[:3]))
    return sd


def _bottom_lock(values: Array, config: Config) -> Iterator[Said]:
    """Share of valid pings, and their speed."""
    valid = values[:, 3] == 1.0
    share = float(valid.mean())
    yield "ok" if share >= LOCKED else "warning", f"bottom lock {share:.1%} of {len(values)} pings", "bottom lock"
    if not valid.any():
        return
    velocity = values[valid, :3]
    usual, limit = float(np.median(np.linalg.norm(velocity, axis=1))), config.dvl.max_speed_mps
    lost = int((np.abs(velocity).max(axis=1) > limit).sum())
    if usual > max(limit, 10.0):
        yield "error", f"median speed {usual:.3g} m/s; if it is in mm/s or cm/s, state units: {{dvl: mm/s}}", "unit"
    elif lost > 0.05 * len(velocity):
        yield "warning", f"{lost} pings are faster than dvl.max_speed_mps = {limit:g} and are ignored", "speed"
    else:
        tail = f"; {lost} faster than {limit:g} m/s are ignored" if lost else ""
        yield "ok", f"median speed {usual:.2f} m/s{tail}"


DVL = Sensor(
    "dvl",
    (
        *(Column(name, "speed") for name in VELOCITIES),
        Column("dvl_valid", optional=True, flag=True),
        Column("dvl_sd", "speed", optional=True, largest=5.0),
    ),
    over_ground,
    refused=_refused,
    standard_deviation=_standard_deviation,
    observes=Observed("velocity"),
    linear_in=VELOCITY,
    may_begin_later=True,
    usual_rates=(0.1, 100.0),
    if_missing=("warning", "no DVL: without fixes, position is lost within a minute; give dvl_vx, dvl_vy, dvl_vz"),
    look=_bottom_lock,
)
DVL_WATER = Sensor(
    "dvl_water",
    tuple(Column(name, "speed", group="dvl") for name in ("dvl_water_vx", "dvl_water_vy", "dvl_water_vz")),
    through_water,
    refused=_too_fast,
    observes=Observed("velocity"),
    linear_in="current",
)
DVL_ALTITUDE = Sensor("dvl_altitude", (Column("dvl_altitude", "length"),))
