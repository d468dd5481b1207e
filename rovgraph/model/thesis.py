"""Numbers of the thesis rovgraph grew from, as printed there.

K. Jönsson, *Position Estimation of Remotely Operated Underwater Vehicle*,
LiTH-ISY-EX--10/4361--SE, Linköping University 2010. Its body axes are forward, port, up;
`FLIP` turns them into forward, starboard, down. Numbers that are needed and not printed there
(inertia, thruster layout) are in `rovgraph.model.config.Vehicle`, marked as choices.
"""

import numpy as np

from rovgraph.geometry import Array

FLIP = np.diag([1.0, -1.0, -1.0])  # forward, port, up <-> forward, starboard, down; also w <-> n
SAMPLE_S = 0.01  # Ts of (2.26)


def _symmetric(rows: list[list[float]]) -> Array:
    """A printed covariance matrix with its rounding made symmetric."""
    matrix = np.array(rows)
    return np.asarray(0.5 * (matrix + matrix.T))


# per 100 Hz sample: specific force [(m/s^2)^2], rate [(rad/s)^2], field [1], MTi axes (appendix A)
R_MTI = _symmetric(
    [
        [4.58e-5, -1.67e-5, 4.67e-6, -4.54e-8, -1.60e-8, -9.39e-8, -2.13e-9, -1.55e-7, -6.67e-7],
        [-1.67e-5, 6.00e-5, 2.12e-5, 3.92e-7, -7.56e-8, 3.49e-7, -6.58e-8, -1.36e-8, 1.72e-7],
        [4.67e-6, 2.12e-5, 7.77e-5, -3.73e-7, -8.93e-7, 1.50e-7, -1.32e-7, 9.68e-8, 3.22e-7],
        [-4.53e-8, 3.92e-7, -3.73e-7, 4.81e-5, 1.16e-7, -4.49e-7, 1.22e-7, 1.48e-8, 6.32e-8],
        [-1.60e-8, -7.56e-8, -8.93e-7, 1.16e-7, 3.58e-5, -8.27e-7, -1.29e-8, 6.83e-8, 1.46e-7],
        [-9.39e-8, 3.49e-7, 1.50e-7, -4.49e-7, -8.27e-7, 3.80e-5, -2.01e-7, -2.10e-8, 2.63e-7],
        [-2.13e-9, -6.58e-8, -1.32e-7, 1.22e-7, -1.29e-8, -2.01e-7, 5.08e-7, -3.12e-8, -1.03e-7],
        [-1.55e-7, -1.36e-8, 9.68e-8, 1.48e-8, 6.83e-8, -2.10e-8, -3.12e-8, 8.40e-7, 5.33e-7],
        [-6.67e-7, 1.72e-7, 3.22e-7, 6.32e-8, 1.46e-7, 2.63e-7, -1.03e-7, 5.33e-7, 3.01e-6],
    ]
)
# per ping: velocity [(m/s)^2], DVL axes, and heading, read as degrees squared and converted here
_DEGREES = np.diag([1.0, 1.0, 1.0, float(np.deg2rad(1.0))])
R_DVL = _DEGREES @ _symmetric(
    [
        [1.400e-5, 1.233e-6, 3.223e-7, 1.372e-4],
        [1.233e-6, 1.247e-5, -1.376e-6, 2.550e-5],
        [3.223e-7, -1.376e-6, 2.409e-6, -1.463e-5],
        [1.372e-4, 2.550e-5, -1.463e-5, 6.182e-2],
    ]
) @ _DEGREES  # fmt: skip

# process noise per sample (appendix A); each times a unit matrix of three
Q_ACC = SAMPLE_S * 0.025
Q_RATE = SAMPLE_S * 0.0025
Q_ACC_BIAS = SAMPLE_S * 2.5e-4
Q_GYR_BIAS = SAMPLE_S * 7.6e-7
Q_MAG_BIAS = SAMPLE_S * 8.0e-7

# mounting: angles [rad] of (2.7)'s kind, lever arms [m], forward, port, up (appendix B)
THETA_MTI = np.deg2rad([-3.4, -1.2, 0.0])
THETA_DVL = np.deg2rad([0.0, 0.0, -45.0])
LEVER_ARM_MTI = np.array([-0.11, -0.22, 0.10])
LEVER_ARM_DVL = np.array([0.24, 0.0, -0.33])

END_N = (39.9, -33.7)  # north, east [m]: end of the reference path in lake Vättern (4.3)
WAVE_HZ = 0.34  # of the waves (3.1.4)
FAN_RAD_PER_SAMPLE = 1.45  # of the fan's line on land (3.1.4)
MEAN_END_ERROR_M = {"4.3a": 0.98, "4.3b": 3.44, "4.3c": 5.91, "4.4a": 0.79, "4.4b": 1.65, "4.4c": 8.15, "4.5": 17.73}
