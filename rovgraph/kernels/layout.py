"""Where everything stands in the vectors that kernels share: compile-time constants.

The error of a state, and so the columns of every Jacobian, is in this order:

    0   rotation          R_nb <- R_nb Exp(d)
    3   translation       p_n <- p_n + R_nb d, axes of b
    6   velocity          in n
    9   accelerometer     bias, in b
    12  gyro              bias, in b
    15  calibration       the calibration vector, in the order below

The calibration vector has the rows of `rovgraph.model.calibration.TABLE` in their order, built-in ones first; those
that are registered later follow. Its indices are constants here, because kernels need them when they are compiled;
`rovgraph.model.calibration.LAYOUT` gives them by name, and a test holds both equal.
"""

ROTATION, TRANSLATION, VELOCITY, ACC_BIAS, GYR_BIAS = 0, 3, 6, 9, 12
MOTION = 15  # components of the error before the calibration

DVL_ROLL, DVL_PITCH, DVL_YAW, DVL_SCALE, DVL_LEVER_ARM, DVL_TIME_OFFSET = 0, 1, 2, 3, 4, 7
DVL_COMPASS_OFFSET, DVL_COMPASS_DEVIATION = 8, 9
AHRS_OFFSET, AHRS_DEVIATION, AHRS_TIME_OFFSET = 11, 12, 14
MAG_OFFSET, MAG_DEVIATION, MAG_TIME_OFFSET, HARD_IRON, SOFT_IRON, FIELD_DIP, FIELD_SCALE = 15, 16, 18, 19, 22, 28, 29
ACC_SCALE, GYR_SCALE = 30, 33
DEPTH_OFFSET, DEPTH_SCALE, DEPTH_TIME_OFFSET, FIX_TIME_OFFSET = 36, 37, 38, 39
DRAG_LINEAR, DRAG_QUADRATIC, CURRENT = 40, 43, 46
FIX_ERROR, AHRS_ERROR, DVL_COMPASS_ERROR, DVL_ERROR = 48, 50, 51, 52
VEHICLE_COMPASS_OFFSET, VEHICLE_COMPASS_DEVIATION, VEHICLE_COMPASS_ERROR = 53, 54, 56
WATER_OSCILLATION, BOTTOM_VELOCITY, DEPTH_ERROR = 57, 60, 62
USBL_ROLL, USBL_PITCH, USBL_YAW, USBL_ARM, SOUND_SPEED_SCALE, USBL_RANGE_OFFSET, USBL_TIME_OFFSET = (
    63, 64, 65, 66, 69, 70, 71
)  # fmt: skip
USBL_DIRECTION_ERROR, USBL_RANGE_ERROR = 72, 74
RANGE_OFFSET, RANGE_CLOCK, RANGE_CLOCK_DRIFT, RANGE_ERROR, RANGE_TIME_OFFSET = 75, 76, 77, 78, 79
BEACON_1, BEACON_1_DOWN, BEACON_2, BEACON_2_DOWN, BEACON_3, BEACON_3_DOWN, BEACON_4, BEACON_4_DOWN = (
    80, 82, 83, 85, 86, 88, 89, 91
)  # fmt: skip
BEACON_5, BEACON_5_DOWN, BEACON_6, BEACON_6_DOWN, BEACON_7, BEACON_7_DOWN, BEACON_8, BEACON_8_DOWN = (
    92, 94, 95, 97, 98, 100, 101, 103
)  # fmt: skip
DVL_BEAM_0_ANGLE, DVL_BEAM_1_ANGLE, DVL_BEAM_2_ANGLE, DVL_BEAM_3_ANGLE, DVL_BEAM_4_ANGLE = 104, 105, 106, 107, 108
DVL_BEAM_5_ANGLE, DVL_BEAM_6_ANGLE, DVL_BEAM_7_ANGLE, DVL_BEAM_8_ANGLE = 109, 110, 111, 112
DVL_BIAS, DVL_ALTITUDE_SCALE = 113, 116
WATER_LAYER_1, WATER_LAYER_2, WATER_LAYER_3, WATER_LAYER_4, WATER_LAYER_5 = 117, 119, 121, 123, 125
WATER_LAYER_6, WATER_LAYER_7, WATER_LAYER_8, WATER_LAYER_9, WATER_LAYER_10 = 127, 129, 131, 133, 135
WATER_LAYER_11, WATER_LAYER_12, WATER_LAYER_13, WATER_LAYER_14 = 137, 139, 141, 143
CHART_PLACE = 145
SIZE = 147  # components of the built-in calibration
