"""Calibrations made from a log of their own: the magnetometer turned by hand, sensors at rest, beams of a DVL.

`calibrate_magnetometer`, `calibrate_noise` and `calibrate_dvl_beams` do the work of ``rovgraph calibrate``. Each
returns its results and the piece of configuration that follows from them. May import what `rovgraph.lab` may. Begin
with `magnetometer`, `noise` and `dvl_beams`, whose docstrings have the equations.
"""

from rovgraph.lab.calibrate.dvl_beams import BeamFit, calibrate_dvl_beams
from rovgraph.lab.calibrate.magnetometer import METHODS, MagnetometerCalibration, Method, calibrate_magnetometer
from rovgraph.lab.calibrate.noise import NoiseReport, calibrate_noise

__all__ = [
    "METHODS",
    "BeamFit",
    "MagnetometerCalibration",
    "Method",
    "NoiseReport",
    "calibrate_dvl_beams",
    "calibrate_magnetometer",
    "calibrate_noise",
]
