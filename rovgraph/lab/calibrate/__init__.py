"""Calibrations made from a log of their own: the magnetometer turned by hand, sensors at rest.

`calibrate_magnetometer` and `calibrate_noise` do the work of ``rovgraph calibrate``. Each returns its results and the
piece of configuration that follows from them. May import what `rovgraph.lab` may. Begin with `magnetometer` and
`noise`, whose docstrings have the equations.
"""

from rovgraph.lab.calibrate.magnetometer import METHODS, MagnetometerCalibration, Method, calibrate_magnetometer
from rovgraph.lab.calibrate.noise import NoiseReport, calibrate_noise

__all__ = ["METHODS", "MagnetometerCalibration", "Method", "NoiseReport", "calibrate_magnetometer", "calibrate_noise"]
