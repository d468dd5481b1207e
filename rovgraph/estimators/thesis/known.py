"""Attitude and rate as the inertial unit gives them, for 4.1 and 4.2.

The thesis takes the MTi's own fused attitude and rate. A log that has it (``ahrs_*``) is
taken at its word, calibration of its heading at the means. Without it the accelerometer
levels each sample, as if the vehicle did not accelerate, and the magnetometer gives the
heading; such an attitude is far noisier than a fused one.
"""

from dataclasses import dataclass

import numpy as np

from rovgraph.calibration import Belief
from rovgraph.config import Config, mount_matrix
from rovgraph.errors import InputError
from rovgraph.geometry import Array, level_from_force, matrix_from_rpy
from rovgraph.log import Log
from rovgraph.trajectory import Trajectory


@dataclass(frozen=True)
class KnownMotion:
    """Attitude and rate at the IMU's epochs.

    Attributes
    ----------
    R_nb : ndarray, shape (n, 3, 3)
    w_b : ndarray, shape (n, 3) [rad/s]
    source : where the attitude is from, for people
    """

    R_nb: Array
    w_b: Array
    source: str


def known_motion(log: Log, config: Config, beliefs: dict[str, Belief], gyr_bias_b: Array) -> KnownMotion:
    """Attitude and rate that 4.1 and 4.2 take as given.

    Parameters
    ----------
    log, config : of the dive
    beliefs : of the calibration variables; the compass stands at its means
    gyr_bias_b : ndarray, shape (3,), taken off the rate [rad/s]

    Raises
    ------
    InputError : the log has neither the IMU's attitude nor a magnetometer
    """
    imu, R_bs = log["imu"], mount_matrix(config.imu.mount_rpy_deg)
    level = level_from_force(imu.data[:, :3] @ R_bs.T)
    if "ahrs" in log:
        R_nb, source = _fused(log, config, beliefs, level), "the IMU's own attitude"
    elif "mag" in log:
        R_nb = _magnetic(log, config, beliefs, level)
        source = "levelled by the accelerometer, heading from the magnetometer: the log has no ahrs_*"
    else:
        raise InputError(
            f"{log.source}: this filter takes the attitude as given, which needs ahrs_yaw (with ahrs_roll, ahrs_pitch) "
            "or the magnetometer mag_x, mag_y, mag_z"
        )
    return KnownMotion(R_nb, imu.data[:, 3:] @ R_bs.T - gyr_bias_b, source)


def _undeviated(magnetic: Array, offset: Array, curve: Array) -> Array:
    """Heading h with ``h + A + B sin h + C cos h = magnetic``, by fixed-point iteration; shape (n,)."""
    heading = magnetic
    for _ in range(5):
        heading = magnetic - offset[0] - curve[0] * np.sin(heading) - curve[1] * np.cos(heading)
    return heading


def _fused(log: Log, config: Config, beliefs: dict[str, Belief], level: Array) -> Array:
    """The IMU's own attitude turned to b, at the IMU's epochs; tilt from ``level`` where it has none."""
    ahrs, imu, R_bs = log["ahrs"], log["imu"], mount_matrix(config.imu.mount_rpy_deg)
    yaw = _undeviated(ahrs["ahrs_yaw"], beliefs["ahrs_offset"].mean, beliefs["ahrs_deviation"].mean)
    yaw = yaw + np.deg2rad(config.environment.declination_deg)
    tilt = np.column_stack([ahrs["ahrs_roll"], ahrs["ahrs_pitch"]])
    if np.isfinite(tilt).all():
        R_nb = matrix_from_rpy(np.column_stack([tilt, yaw])) @ R_bs.T
        nowhere = np.zeros((len(ahrs), 3))
        return Trajectory.certain(ahrs.time, nowhere, R_nb, nowhere).at(imu.time).R_nb
    at = np.interp(imu.time, ahrs.time, np.unwrap(yaw))
    return matrix_from_rpy(np.column_stack([level, at]))


def _magnetic(log: Log, config: Config, beliefs: dict[str, Belief], level: Array) -> Array:
    """Levelled attitude with the heading of the levelled field; the field is interpolated."""
    mag, imu, R_bs = log["mag"], log["imu"], mount_matrix(config.imu.mount_rpy_deg)
    length = np.linalg.norm(mag.data, axis=1).mean()
    field_b = (mag.data / length - beliefs["hard_iron"].mean) @ R_bs.T
    field_b = np.column_stack([np.interp(imu.time, mag.time, column) for column in field_b.T])
    flat = matrix_from_rpy(np.column_stack([level, np.zeros(len(level))]))
    field = np.einsum("nij,nj->ni", flat, field_b)
    magnetic = np.arctan2(-field[:, 1], field[:, 0])
    yaw = _undeviated(magnetic, beliefs["mag_offset"].mean, beliefs["mag_deviation"].mean)
    return matrix_from_rpy(np.column_stack([level, yaw + np.deg2rad(config.environment.declination_deg)]))
