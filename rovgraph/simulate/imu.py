"""The inertial unit: specific force and angular rate at its own place, in its own axes.

At the lever arm l, with the Earth's rate w_ie where it is modelled,

    f_b = R_bn (a_n + 2 w_ie x v_n - g_n) + alpha x l + w x (w x l) + 2 w_ie x (w x l)
    y   = R_sb ([f_b, w + R_bn w_ie] + bias) + noise

which is (3.14) with alpha x l kept and the sign of gravity corrected. Biases are in body
axes, as an estimator states them, and walk from sample to sample.
"""

import numpy as np

from rovgraph.config import Config, ImuNoise, mount_matrix
from rovgraph.errors import InputError
from rovgraph.geometry import Array, earth_rate_n, rotate, transpose
from rovgraph.simulate.path import Motion


def _earth_rate(config: Config) -> Array:
    """Rate of the Earth in n, shape (3,) [rad/s]; zero where it is not modelled.

    Raises
    ------
    InputError : modelled, but the latitude is not known
    """
    env = config.environment
    if not env.earth_rotation:
        return np.zeros(3)
    if env.latitude_deg is None:
        raise InputError("environment.earth_rotation needs environment.latitude_deg")
    return earth_rate_n(float(np.deg2rad(env.latitude_deg)))


def specific_force_and_rate(motion: Motion, config: Config) -> Array:
    """What a perfect unit senses, in body axes.

    Parameters
    ----------
    motion : Motion of n epochs
    config : Config

    Returns
    -------
    ndarray, shape (n, 6), specific force [m/s^2], angular rate [rad/s]
    """
    arm = np.asarray(config.imu.lever_arm_m, float)
    w_ie_n, g_n = _earth_rate(config), np.array([0.0, 0.0, config.environment.gravity_mps2])
    R_bn = transpose(motion.R_nb)
    w_ie_b = rotate(R_bn, w_ie_n)
    swing = np.cross(motion.w_b, arm)
    f_b = rotate(R_bn, motion.a_n + 2.0 * np.cross(w_ie_n, motion.v_n) - g_n)
    f_b += np.cross(motion.alpha_b, arm) + np.cross(motion.w_b, swing) + 2.0 * np.cross(w_ie_b, swing)
    return np.hstack([f_b, motion.w_b + w_ie_b])


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
