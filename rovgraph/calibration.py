"""The one table of calibration variables.

The configuration's ``calibration`` section, the graph's keys and priors, the
simulator's hidden truth and the rows of a report all come from `TABLE`.
A variable is added by adding a row here and using its name in a measurement model.

The offset and the deviation of every compass are estimated by default: no compass in a
vehicle is free of them, and holding them at zero pushes them into the DVL's misalignment
and makes the track look far more certain than it is.
"""

from dataclasses import dataclass

import numpy as np

from rovgraph.geometry import Array


@dataclass(frozen=True)
class Variable:
    """One calibration variable.

    Attributes
    ----------
    name : key in the configuration, in models' Jacobians and in reports
    letter : character of the GTSAM key
    components : suffixes of the scalar components; ("",) for a scalar
    unit : unit inside the program
    sd : default standard deviation of the prior, every component [unit]
    sensor : log sensor without which the variable has no meaning
    estimate : estimated unless the configuration says otherwise
    about : one line for people
    walk : default random walk [unit per root second], 0 = constant over the dive
    """

    name: str
    letter: str
    components: tuple[str, ...]
    unit: str
    sd: float
    sensor: str
    about: str
    estimate: bool = False
    walk: float = 0.0

    @property
    def dim(self) -> int:
        return len(self.components)

    @property
    def angular(self) -> bool:
        """Stated in degrees where a person reads or writes it."""
        return self.unit == "rad"

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the scalar components, such as ``hard_iron_x``."""
        return tuple(self.name + c for c in self.components)


_DEG = float(np.deg2rad(1.0))
_XYZ = ("_x", "_y", "_z")
_CURVE = ("_sin", "_cos")

TABLE: dict[str, Variable] = {
    v.name: v
    for v in (
        Variable("dvl_roll", "r", ("",), "rad", 2 * _DEG, "dvl", "roll of the DVL's mounting"),
        Variable("dvl_pitch", "p", ("",), "rad", 2 * _DEG, "dvl", "pitch of the DVL's mounting"),
        Variable(
            "dvl_yaw",
            "y",
            ("",),
            "rad",
            5 * _DEG,
            "dvl",
            "yaw of the DVL's mounting: misalignment",
        ),
        Variable("dvl_scale", "s", ("",), "1", 0.01, "dvl", "scale error of the DVL (sound speed)"),
        Variable(
            "dvl_compass_offset",
            "d",
            ("",),
            "rad",
            5 * _DEG,
            "dvl_heading",
            "offset of the DVL's compass (deviation A)",
            estimate=True,
        ),
        Variable(
            "dvl_compass_deviation",
            "e",
            _CURVE,
            "rad",
            3 * _DEG,
            "dvl_heading",
            "deviation curve of the DVL's compass: sine and cosine of heading (B, C)",
            estimate=True,
        ),
        Variable(
            "ahrs_offset",
            "a",
            ("",),
            "rad",
            5 * _DEG,
            "ahrs",
            "offset of the IMU's own heading (deviation A)",
            estimate=True,
        ),
        Variable(
            "ahrs_deviation",
            "f",
            _CURVE,
            "rad",
            3 * _DEG,
            "ahrs",
            "deviation curve of the IMU's own heading: sine and cosine of heading (B, C)",
            estimate=True,
        ),
        Variable(
            "mag_offset",
            "m",
            ("",),
            "rad",
            5 * _DEG,
            "mag",
            "offset of the magnetometer's heading (deviation A)",
            estimate=True,
        ),
        Variable(
            "mag_deviation",
            "g",
            _CURVE,
            "rad",
            3 * _DEG,
            "mag",
            "deviation curve of the magnetometer beside its hard iron: sine and cosine of heading (B, C)",
        ),
        Variable(
            "hard_iron",
            "h",
            _XYZ,
            "field",
            0.02,
            "mag",
            "hard iron in IMU axes, as a fraction of the field's magnitude",
            estimate=True,
        ),
        Variable(
            "field_dip",
            "i",
            ("",),
            "rad",
            3 * _DEG,
            "mag",
            "difference of the field's dip from environment.dip_deg",
            True,
        ),
        Variable(
            "field_scale",
            "q",
            ("",),
            "1",
            0.05,
            "mag",
            "difference of the field's magnitude from environment.field_norm, as a fraction of it",
            True,
        ),
        Variable(
            "drag_linear",
            "j",
            _XYZ,
            "1",
            0.3,
            "thruster",
            "relative error of vehicle.drag_linear",
            estimate=True,
        ),
        Variable(
            "drag_quadratic",
            "k",
            _XYZ,
            "1",
            0.3,
            "thruster",
            "relative error of vehicle.drag_quadratic",
            estimate=True,
        ),
        Variable(
            "current",
            "c",
            ("_north", "_east"),
            "m/s",
            0.1,
            "thruster",
            "velocity of the water over ground",
            estimate=True,
            walk=5e-4,  # a centimetre a second in seven minutes: none stays as it is to the millimetre
        ),
    )
}


@dataclass(frozen=True)
class Belief:
    """What is believed of a calibration variable before the data speak.

    Attributes
    ----------
    variable : row of `TABLE`
    mean : ndarray, shape (dim,) [unit]
    sd : float, every component [unit]
    estimate : False = held at the mean
    walk : random walk [unit per root second], 0 = constant over the dive
    """

    variable: Variable
    mean: Array
    sd: float
    estimate: bool
    walk: float = 0.0
