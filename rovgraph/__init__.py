"""rovgraph: where a small underwater vehicle was, and where it is.

This docstring is the contract for frames, units and names in the whole package.

Frames
------
n : navigation frame, north-east-down (NED), flat, local origin, taken as inertial
    unless ``environment.earth_rotation`` is set.
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
Heading is clockwise from north; depth is positive down.
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
cli / api, extend / pages / report, export, web / studies, live / dive, interchange / diagnosis /
estimators, simulate, evaluate, calibrate / check / graph / engine /
instruments, rules / log / sensors / config, trajectory / vehicle /
state, calibration, thesis / kernels / tables / dates / gauss_markov, units, gps_time, stamps /
compatibility, geometry, workers, fast_csv, spilling / errors, process, progress.
"""

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING

__version__ = "0.1.0"

if TYPE_CHECKING:
    from rovgraph.api.calibration import MagnetometerResult as MagnetometerResult
    from rovgraph.api.calibration import NoiseResult as NoiseResult
    from rovgraph.api.calibration import calibrate_magnetometer as calibrate_magnetometer
    from rovgraph.api.calibration import calibrate_noise as calibrate_noise
    from rovgraph.api.comparison import ComparisonResult as ComparisonResult
    from rovgraph.api.comparison import compare as compare
    from rovgraph.api.conversion import Conversion as Conversion
    from rovgraph.api.conversion import convert as convert
    from rovgraph.api.demo import Demo as Demo
    from rovgraph.api.demo import demo as demo
    from rovgraph.api.exporting import export as export
    from rovgraph.api.exporting import tag as tag
    from rovgraph.api.guessing import Guess as Guess
    from rovgraph.api.guessing import guess_columns as guess_columns
    from rovgraph.api.live_page import live_page as live_page
    from rovgraph.api.logs import check as check
    from rovgraph.api.logs import read_log as read_log
    from rovgraph.api.observability import ObservabilityResult as ObservabilityResult
    from rovgraph.api.observability import PlanResult as PlanResult
    from rovgraph.api.observability import observe as observe
    from rovgraph.api.observability import plan as plan
    from rovgraph.api.online import Online as Online
    from rovgraph.api.reporting import report as report
    from rovgraph.api.reporting import report_check as report_check
    from rovgraph.api.simulation import SimulatedDive as SimulatedDive
    from rovgraph.api.simulation import simulate as simulate
    from rovgraph.api.smoothing import Result as Result
    from rovgraph.api.smoothing import smooth as smooth
    from rovgraph.api.studies import study_misalignment as study_misalignment
    from rovgraph.config import Config as Config
    from rovgraph.config import load_config as load_config
    from rovgraph.config import parse_config as parse_config
    from rovgraph.errors import DataWarning as DataWarning
    from rovgraph.errors import InputError as InputError
    from rovgraph.evaluate import Metrics as Metrics
    from rovgraph.evaluate import evaluate as evaluate
    from rovgraph.evaluate import read_reference as read_reference
    from rovgraph.log import Log as Log
    from rovgraph.simulate import Choices as Choices
    from rovgraph.trajectory import Trajectory as Trajectory
    from rovgraph.trajectory import read_trajectory as read_trajectory

# name -> the module it is imported from when it is first used, so that importing the package costs nothing
_HOMES = {
    "Choices": "simulate",
    "ComparisonResult": "api.comparison",
    "Config": "config",
    "Conversion": "api.conversion",
    "DataWarning": "errors",
    "Demo": "api.demo",
    "Guess": "api.guessing",
    "InputError": "errors",
    "Log": "log",
    "MagnetometerResult": "api.calibration",
    "Metrics": "evaluate",
    "NoiseResult": "api.calibration",
    "ObservabilityResult": "api.observability",
    "Online": "api.online",
    "PlanResult": "api.observability",
    "Result": "api.smoothing",
    "SimulatedDive": "api.simulation",
    "Trajectory": "trajectory",
    "calibrate_magnetometer": "api.calibration",
    "calibrate_noise": "api.calibration",
    "check": "api.logs",
    "compare": "api.comparison",
    "convert": "api.conversion",
    "demo": "api.demo",
    "evaluate": "evaluate",
    "export": "api.exporting",
    "guess_columns": "api.guessing",
    "live_page": "api.live_page",
    "load_config": "config",
    "observe": "api.observability",
    "parse_config": "config",
    "plan": "api.observability",
    "read_log": "api.logs",
    "read_reference": "evaluate",
    "read_trajectory": "trajectory",
    "report": "api.reporting",
    "report_check": "api.reporting",
    "simulate": "api.simulation",
    "smooth": "api.smoothing",
    "study_misalignment": "api.studies",
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
