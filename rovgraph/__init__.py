"""rovgraph: navigation of small underwater vehicles, after a dive and during it.

This docstring is the contract for frames, units and names in the whole package.

Frames
------
n : navigation frame, north-east-down (NED). With ``environment.frame: flat`` it is the plane
    that touches WGS 84 at the origin, taken as inertial unless ``environment.earth_rotation``
    is set. With ``earth`` its axes are those of the meridian where the vehicle is, and
    positions are latitude and longitude, as metres at the scale of the origin
    (``rovgraph.kernels.earth``); velocities are metres a second over ground in both.
    ``auto`` is one of them by latitude, way and gyro (docs/geodesy.md).
b : body frame, forward-right-down (FRD): x forward, y starboard, z down.
s : sensor frame. A sensor's mounting is ``R_bs`` (sensor to body, written
    ``mount_rpy_deg`` in a configuration) and ``lever_arm_b`` (metres, body axes).
    An instrument whose z axis points up is a mounting of 180 degrees about x, never
    a sign flipped in code.

Notation
--------
``R_nb`` takes vectors from b to n: ``v_n = R_nb @ v_b``. ``p_n`` is position,
``v_n`` velocity over ground, both in n. Angles are radians, everything else SI.
Degrees occur only in configuration keys that end in ``_deg`` and in what a person reads.
Roll, pitch, yaw are the ZYX convention, ``R_nb = Rz(yaw) Ry(pitch) Rx(roll)``.
Heading is clockwise from north; depth is positive down, from the water's surface of the moment.
``*_sd`` is one standard deviation.

Tangent space
-------------
As in GTSAM: a pose is perturbed on the right, rotation first,
``R_nb <- R_nb Exp(dtheta)``, ``p_n <- p_n + R_nb dp``; velocity is perturbed in n;
a bias is accelerometer first, gyro second, in body axes.

Arrays
------
Quantities of many epochs carry the epochs on the leading axis: positions are
``(n, 3)``, rotations ``(n, 3, 3)``, Jacobians ``(n, dim of measurement, dim of variable)``.

Layers (imports go downwards only)
----------------------------------
cli / rovgraph / api, extend / report, web / live, lab / dive, readers / diagnosis / simulate / inference / problem /
rules / log / sensors / model / kernels / dates / compatibility, distributions, geometry /
errors, process, _version.
"""

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING

from rovgraph._version import __version__ as __version__

if TYPE_CHECKING:
    from rovgraph.api.conversion import Conversion as Conversion
    from rovgraph.api.conversion import Guess as Guess
    from rovgraph.api.conversion import convert as convert
    from rovgraph.api.conversion import guess_columns as guess_columns
    from rovgraph.api.exporting import export as export
    from rovgraph.api.exporting import tag as tag
    from rovgraph.api.lab import ComparisonResult as ComparisonResult
    from rovgraph.api.lab import MagnetometerResult as MagnetometerResult
    from rovgraph.api.lab import NoiseResult as NoiseResult
    from rovgraph.api.lab import ObservabilityResult as ObservabilityResult
    from rovgraph.api.lab import PlanResult as PlanResult
    from rovgraph.api.lab import calibrate_dvl_beams as calibrate_dvl_beams
    from rovgraph.api.lab import calibrate_magnetometer as calibrate_magnetometer
    from rovgraph.api.lab import calibrate_noise as calibrate_noise
    from rovgraph.api.lab import compare as compare
    from rovgraph.api.lab import observe as observe
    from rovgraph.api.lab import plan as plan
    from rovgraph.api.lab import study_misalignment as study_misalignment
    from rovgraph.api.logs import check as check
    from rovgraph.api.logs import read_log as read_log
    from rovgraph.api.online import Online as Online
    from rovgraph.api.online import live_page as live_page
    from rovgraph.api.reporting import report as report
    from rovgraph.api.reporting import report_check as report_check
    from rovgraph.api.simulation import Demo as Demo
    from rovgraph.api.simulation import SimulatedDive as SimulatedDive
    from rovgraph.api.simulation import demo as demo
    from rovgraph.api.simulation import simulate as simulate
    from rovgraph.api.smoothing import Result as Result
    from rovgraph.api.smoothing import smooth as smooth
    from rovgraph.errors import DataWarning as DataWarning
    from rovgraph.errors import InputError as InputError
    from rovgraph.inference.trajectory import Trajectory as Trajectory
    from rovgraph.inference.trajectory import read_trajectory as read_trajectory
    from rovgraph.lab.evaluate import Metrics as Metrics
    from rovgraph.lab.evaluate import evaluate as evaluate
    from rovgraph.lab.evaluate import read_reference as read_reference
    from rovgraph.log import Log as Log
    from rovgraph.model.config import Config as Config
    from rovgraph.model.config import load_config as load_config
    from rovgraph.model.config import parse_config as parse_config
    from rovgraph.simulate import Choices as Choices

# name -> the module it is imported from when it is first used, so that importing the package costs nothing
_HOMES = {
    "Choices": "simulate",
    "ComparisonResult": "api.lab",
    "Config": "model.config",
    "Conversion": "api.conversion",
    "DataWarning": "errors",
    "Demo": "api.simulation",
    "Guess": "api.conversion",
    "InputError": "errors",
    "Log": "log",
    "MagnetometerResult": "api.lab",
    "Metrics": "lab.evaluate",
    "NoiseResult": "api.lab",
    "ObservabilityResult": "api.lab",
    "Online": "api.online",
    "PlanResult": "api.lab",
    "Result": "api.smoothing",
    "SimulatedDive": "api.simulation",
    "Trajectory": "inference.trajectory",
    "calibrate_dvl_beams": "api.lab",
    "calibrate_magnetometer": "api.lab",
    "calibrate_noise": "api.lab",
    "check": "api.logs",
    "compare": "api.lab",
    "convert": "api.conversion",
    "demo": "api.simulation",
    "evaluate": "lab.evaluate",
    "export": "api.exporting",
    "guess_columns": "api.conversion",
    "live_page": "api.online",
    "load_config": "model.config",
    "observe": "api.lab",
    "parse_config": "model.config",
    "plan": "api.lab",
    "read_log": "api.logs",
    "read_reference": "lab.evaluate",
    "read_trajectory": "inference.trajectory",
    "report": "api.reporting",
    "report_check": "api.reporting",
    "simulate": "api.simulation",
    "smooth": "api.smoothing",
    "study_misalignment": "api.lab",
    "tag": "api.exporting",
}
__all__ = list(_HOMES)


class _Package(ModuleType):
    """This package, whose functions (`check`, `evaluate`, `report`, …) are not hidden by modules of the same name."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _HOMES and isinstance(value, ModuleType)):  # which the import of a submodule would set
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


if not TYPE_CHECKING:  # or a type checker would believe in every name

    def __getattr__(name: str) -> object:
        """What `__all__` promises, imported when it is first used."""
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        found = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
        globals()[name] = found
        return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
