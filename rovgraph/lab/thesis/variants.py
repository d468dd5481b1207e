"""The filters of the thesis by name, and the numbers in them that a study may change."""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from rovgraph.geometry import Array
from rovgraph.model import thesis

Motion = Literal["body", "earth", "known_attitude", "hydrodynamic"]


@dataclass(frozen=True, eq=False)
class Numbers:
    """Noise and start of a filter; defaults as printed in the thesis's appendix A.

    Attributes
    ----------
    acceleration, rate : process noise per sample of 10 ms, variance for each axis; in 4.2,
        which has no acceleration, that of velocity
    acc_bias, gyr_bias, mag_bias : walk of the MTi's biases, variance per sample
    mount : walk of the DVL's angles, variance per sample; (4.5) has none
    R_mti : ndarray, shape (9, 9), per sample, MTi axes; field as a fraction of its length
    R_dvl : ndarray, shape (4, 4), per ping, velocity in DVL axes, heading
    acceleration_sd, rate_sd : of the start, not printed: a choice [m/s^2, rad/s]
    """

    acceleration: tuple[float, float, float] = (thesis.Q_ACC,) * 3
    rate: tuple[float, float, float] = (thesis.Q_RATE,) * 3
    acc_bias: float = thesis.Q_ACC_BIAS
    gyr_bias: float = thesis.Q_GYR_BIAS
    mag_bias: float = thesis.Q_MAG_BIAS
    mount: float = 0.0
    R_mti: Array = field(default_factory=thesis.R_MTI.copy)
    R_dvl: Array = field(default_factory=thesis.R_DVL.copy)
    acceleration_sd: float = 0.3
    rate_sd: float = 0.3

    def __post_init__(self) -> None:
        for name, size in (("R_mti", 9), ("R_dvl", 4)):
            R = getattr(self, name)
            if R.shape != (size, size) or not np.allclose(R, R.T):
                raise ValueError(f"{name}: a symmetric matrix of {size} x {size} is expected")


@dataclass(frozen=True)
class Filter:
    """A filter: how the vehicle moves, what is measured, and its numbers.

    Attributes
    ----------
    name, section, about : its key in `FILTERS`, the thesis's section, one line for people
    motion : process model, see `rovgraph.lab.thesis.processes`
    accelerometer, magnetometer, compass : whether these are measured; the gyro is, wherever
        the attitude is not given
    misalignment : the DVL's three angles are states
    numbers : noise and start
    coriolis : "euler" as (2.26), or "exact": velocity and acceleration in b are turned by
        the rotation of a step
    noise_frame : axes that `Numbers.acceleration` belongs to, None = the process's own;
        it matters only where the three differ
    iterations : of a measurement update; 1 = EKF
    linearized_at : "estimate", or "truth": Jacobians at the true motion, available in a study
    compass_mount : the DVL's angles in its compass heading, where they are states:
        "estimated", or "held" at their means, as psi_DVL of (3.17) may be read
    """

    name: str
    section: str
    about: str
    motion: Motion
    accelerometer: bool = True
    magnetometer: bool = True
    compass: bool = True
    misalignment: bool = False
    numbers: Numbers = field(default_factory=Numbers)
    coriolis: Literal["euler", "exact"] = "euler"
    noise_frame: Literal["body", "earth"] | None = None
    iterations: int = 1
    linearized_at: Literal["estimate", "truth"] = "estimate"
    compass_mount: Literal["estimated", "held"] = "estimated"

    def __post_init__(self) -> None:
        if self.attitude_given and (
            self.magnetometer or self.compass or self.misalignment or self.linearized_at == "truth"
        ):
            raise ValueError(f"{self.name}: with the attitude given there is no heading and no angle to estimate")

    @property
    def attitude_given(self) -> bool:
        """Attitude and rate are taken from the inertial unit instead of being estimated."""
        return self.motion in ("known_attitude", "hydrodynamic")

    @property
    def kind(self) -> "Filter":
        """Key shared by filters that can run in lock step: all but name, headings and numbers."""
        return replace(self, name="", section="", about="", magnetometer=False, compass=False, numbers=_ANY)

    def with_numbers(self, **numbers: Any) -> "Filter":
        """The filter with some of its `Numbers` changed."""
        return replace(self, numbers=replace(self.numbers, **numbers))


_ANY = Numbers()
_BODY = "constant acceleration and rate in b (2.9)"
_EARTH = "constant acceleration and rate in n (2.8)"

FILTERS: dict[str, Filter] = {
    f.name: f
    for f in (
        Filter(
            "4.1",
            "4.1",
            "attitude given by the MTi, constant acceleration in b, with accelerometer",
            "known_attitude",
            magnetometer=False,
            compass=False,
        ),
        Filter(
            "4.1-no-accelerometer",
            "4.1",
            "attitude given by the MTi, constant acceleration in b, DVL alone",
            "known_attitude",
            accelerometer=False,
            magnetometer=False,
            compass=False,
        ),
        Filter(
            "4.2",
            "4.2",
            "attitude and rate given by the MTi, hydrodynamic model",
            "hydrodynamic",
            accelerometer=False,
            magnetometer=False,
            compass=False,
        ),
        Filter("4.3a", "4.3", f"{_BODY}, both headings", "body"),
        Filter("4.3b", "4.3", f"{_BODY}, heading from the DVL's compass", "body", magnetometer=False),
        Filter("4.3c", "4.3", f"{_BODY}, heading from the magnetometer", "body", compass=False),
        Filter("4.4a", "4.4", f"{_EARTH}, both headings", "earth"),
        Filter("4.4b", "4.4", f"{_EARTH}, heading from the DVL's compass", "earth", magnetometer=False),
        Filter("4.4c", "4.4", f"{_EARTH}, heading from the magnetometer", "earth", compass=False),
        Filter("4.5", "4.5", f"{_BODY}, both headings, the DVL's angles as states", "body", misalignment=True),
    )
}
