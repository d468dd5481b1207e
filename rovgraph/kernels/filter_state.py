"""What the filter carries from keyframe to keyframe, and what it knows of the vehicle, as kernels take both."""

from typing import NamedTuple

from rovgraph.kernels.compile import Index, Matrix, Vector
from rovgraph.kernels.error_coordinates import ErrorLayout


class FilterState(NamedTuple):
    """An estimate with the covariance of its error, which kernels change in place.

    Attributes
    ----------
    x : shape (21,), R_nb by rows, p_n, v_n, bias
    c : shape (C,), calibration vector
    P, B : shapes (n, n), (n, h), of `rovgraph.kernels.robust_update`; places that are remembered come last
    L : shape (h, h), root of the covariance of what is considered
    """

    x: Vector
    c: Vector
    P: Matrix
    B: Matrix
    L: Matrix


class FilterModel(NamedTuple):
    """Sensors, what walks, and where each variable stands in the error.

    Attributes
    ----------
    sensors : shape (s, PARAMS + ...), of `rovgraph.kernels.measurement_row`
    column : shape (15 + C,), place of each component in the error, -1 where it has none; what is considered comes last
    layout : of the error
    walk : shape (3, size), variance that walking adds in a second, one over its time constant [1/s], the mean
    gravity : [m/s^2]
    """

    sensors: Matrix
    column: Index
    layout: ErrorLayout
    walk: Matrix
    gravity: float
