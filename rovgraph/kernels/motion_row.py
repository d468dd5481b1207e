"""How a preintegrated motion is laid out in one row of numbers, so that the motions of a dive are one array.

===============  =====  ========================================================================================
`DURATION`           1  [s]
`GAP`                1  longest time without samples that lies in the interval or reaches into it, or 0; `NO_IMU` [s]
`TANGENT`            9  zeta: rotation vector, change of position, change of velocity in the keyframe's axes
`BIAS`               6  that the integration assumed: accelerometer, gyro; body axes
`NOISE`              5  densities of accelerometer, gyro, their biases' walks, and of the integration [SI/rtHz]
`GRAVITY`            1  [m/s^2]
`EARTH_RATE`         3  of the Earth in n, zeros where n is taken as inertial [rad/s]
`LATITUDE`           1  of the origin of frame "earth" (`rovgraph.kernels.earth`) [rad]; NaN = n is flat
`BY_BIAS`           54  derivative of zeta by the bias, shape (9, 6)
===============  =====  ========================================================================================

The covariance of its residual (rotation, position, velocity, biases), shape (15, 15), is kept apart: a smoother has the
square-root information instead.

The linearised factor between the states at its ends is an array of shape (15, `WIDTH`): columns of the state before it,
the residual in column `RESIDUAL`, columns of the state after it from `AFTER` on, and one that stays zero.
"""

import numpy as np

DURATION, GAP, TANGENT, BIAS, NOISE, GRAVITY, EARTH_RATE, LATITUDE, BY_BIAS, ROW = 0, 1, 2, 11, 17, 22, 23, 26, 27, 81
VELOCITY = slice(TANGENT + 6, TANGENT + 9)
NO_IMU = np.inf  # instead of a gap

RESIDUAL, AFTER, WIDTH = 15, 16, 32
