"""Calibrations made from a log of their own: the magnetometer turned by hand, sensors at rest.

`calibrate_magnetometer` and `calibrate_noise` are the library twins of ``rovgraph calibrate``.
Each returns what was found, and the piece of configuration that follows from it.
"""

from rovgraph.calibrate.magnetometer import METHODS, MagnetometerCalibration, calibrate_magnetometer
from rovgraph.calibrate.noise import NoiseReport, calibrate_noise

__all__ = ["METHODS", "MagnetometerCalibration", "NoiseReport", "calibrate_magnetometer", "calibrate_noise"]
