"""Layout of a measurement, and of a sensor, in one row of numbers.

=============  =====  ==========================================================================================
measurement
=============  =====  ==========================================================================================
`TIME`             1  [s]
`RATE`             3  measured angular rate in b, its bias still in it [rad/s]
`RATE_SD`          1  its noise [rad/s]
`SNAPSHOT`        16  motion from the keyframe: time, dR by rows, dv, dp
`ASSUMED`          6  bias that the motion was integrated with
`Z`, `SD`       3, 3  components, and their sds, of two of them the third is their covariance; more of each where there
                      are more, which no kernel takes
`CONTEXT`       0, *  where a sensor in use has it: what was known of the other end, or of a beam, when it measured
=============  =====  ==========================================================================================

=============  =====  ==========================================================================================
context of an acoustic measurement
=============  =====  ==========================================================================================
`ARM`              3  of the point on the vehicle, from the state's origin, b [m]
`ASKED`, `HEARD`  3, 3  where the other end was when it asked and when it heard, n [m]
`FRAME`            9  attitude of the head's frame when it heard, to n, by rows; of a head on the vehicle unused
`MOVES`, `TURNS`  3, 3  velocity of the other end in n [m/s], rate of its frame in its own axes [rad/s]
`SEEN`             3  the direction that was measured, unit vector in the head's axes
`WAIT`             2  time of the vehicle's part from the measurement's own: in asking, in answering [s]
`STATED`           1  how late the stamp was taken to be for all this [s]
`SINCE`            1  since the first of them, for a clock that drifts [s]
`WAYS`             1  1 = one way, 2 = asked and answered, 0 = the range heard by one receiver less that by another
`INVERTED`         1  1 = the head is on the vehicle, and the other end is what it sees
`ORIGIN`           1  latitude of the origin of frame "earth" [rad]; NaN = n is flat
`MOUNT_AT` ...    11  places in the calibration vector, or -1: the head's mounting (3), error of its arm (3), north and
                      east of a beacon (2), its depth, scale and offset of ranges, the clock's offset and drift, lasting
                      errors of direction (2) and of range, how late the stamp is
=============  =====  ==========================================================================================

=============  =====  ==========================================================================================
context of a beam of a DVL
=============  =====  ==========================================================================================
`BEAM_ARM`         3  of the DVL, from the state's origin, b [m]
`BEAM`, `BEAM_TILT`  3, 3  direction in the DVL's axes, and how it goes with its angle from z
`ALTITUDE`         1  over what it sees [m]
`BEAM_AT`          1  place in the calibration vector of what its angle is off, or -1
=============  =====  ==========================================================================================

=============  =====  ==========================================================================================
context of a layer of the water
=============  =====  ==========================================================================================
`LAYER_ARM`        3  of the DVL, from the state's origin, b [m]
`ABOVE_AT`, `BELOW_AT`  1, 1  places in the calibration vector of the water's velocity at the knots about the layer
`SHARE`            1  of the knot below in the layer's velocity
`FIRST_KNOT`       1  number of the uppermost knot that is kept, by its depth, or -1 where there is one for all depths
=============  =====  ==========================================================================================

=============  =====  ==========================================================================================
sensor
=============  =====  ==========================================================================================
`KIND`             1  of `rovgraph.kernels.measurements`, or `PRELINEARISED`: linearised outside the kernels
`DIM`              1  components
`LOSS`, `LOSS_THRESHOLD`  1, 1  of `rovgraph.kernels.weighting`, and where it begins
`GATE`             1  normalised innovation beyond which a measurement is left out, or infinite
`READMIT`          1  time of being left out after which the filter inflates what the sensor sees [s]
`SEES`             3  1 where an error of the `SEEN_FRAME` shows in it
`SEEN_FRAME`       1  `SEES_VELOCITY`, `SEES_HEADING` or `SEES_POSITION`
`GAIN`             9  covariance of the measurement where that of the rate is the unit matrix, by rows
`OFFSET`           1  place in the calibration vector of how late its stamps are; -1 = they have none
`PARAMS`           *  the model's own
=============  =====  ==========================================================================================
"""

from typing import NamedTuple

from rovgraph.kernels.compile import Index, Matrices, Matrix, helper

TIME, RATE, RATE_SD, SNAPSHOT, ASSUMED, Z = 0, 1, 4, 5, 21, 27
MOST = 3  # components of a measurement that a kernel takes
SD = Z + MOST
ROW = SD + MOST
DT, DR, DV, DP = SNAPSHOT, SNAPSHOT + 1, SNAPSHOT + 10, SNAPSHOT + 13

KIND, DIM, LOSS, LOSS_THRESHOLD, GATE, READMIT, SEES, SEEN_FRAME, GAIN, OFFSET, PARAMS = (
    0,
    1,
    2,
    3,
    4,
    5,
    6,
    9,
    10,
    19,
    20,
)
# a knot of a window: a snapshot from the keyframe, the rate [rad/s], how long before the stamp, nan behind the last [s]
KNOT_DT, KNOT_RATE, KNOT_LAG, KNOT = 0, 16, 19, 20
ARM, ASKED, HEARD, FRAME, MOVES, TURNS, SEEN, WAIT, STATED, SINCE, WAYS, INVERTED, ORIGIN = (
    0, 3, 6, 9, 18, 21, 24, 27, 29, 30, 31, 32, 33
)  # fmt: skip
MOUNT_AT, ARM_AT, BEACON_AT, DOWN_AT, SCALE_AT, OFFSET_AT, CLOCK_AT, DRIFT_AT, DIRECTION_AT, RANGE_AT, LATE_AT = range(
    34, 45
)
WIDTH = 45
BEAM_ARM, BEAM, BEAM_TILT, ALTITUDE, BEAM_AT, BEAM_WIDTH = 0, 3, 6, 9, 10, 11
LAYER_ARM, ABOVE_AT, BELOW_AT, SHARE, FIRST_KNOT, LAYER_WIDTH = 0, 3, 4, 5, 6, 7
KNOT_S = 0.02  # at 3 m/s3, the jerk of gravity in a turning body, velocity is interpolated within 0.2 mm/s
PRELINEARISED = -1.0
SEES_VELOCITY, SEES_HEADING, SEES_POSITION = 0, 1, 2


class MeasuredRows(NamedTuple):
    """m measurements.

    Attributes
    ----------
    rows, which : shapes (m, ROW), or wider where a sensor has a context, (m,), the sensor that each is of
    scales : shape (m, 6, 6), bias by the IMU's scales, or (0, 6, 6) where these are exact
    window : shape (m,), of each whose stamp may be late, else -1
    windows : shape (w, K, KNOT), motion around such stamps
    """

    rows: Matrix
    which: Index
    scales: Matrices
    window: Index
    windows: Matrices


@helper
def some_of(measured: MeasuredRows, begin: int, end: int) -> MeasuredRows:
    """Measurements ``begin`` to before ``end``."""
    rows, which, scales = measured.rows[begin:end], measured.which[begin:end], measured.scales[begin:end]
    return MeasuredRows(rows, which, scales, measured.window[begin:end], measured.windows)
