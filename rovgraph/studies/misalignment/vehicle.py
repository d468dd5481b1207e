"""The vehicle of a cell: what an estimator believes, and what is so.

Grades of inertial units, noise densities per root hertz:

- mti: Xsens MTi, the figures of ``rovgraph/config/falcon.yaml`` (thesis, appendix A; data sheet for the biases).
- tactical: Sensonor STIM300 by its data sheet: 0.15 deg/rt(h), 0.06 m/s/rt(h), on-off bias of the
  accelerometer 0.75 mg, of the gyro 10 deg/h over temperature. Walks are a choice: the bias
  instability (0.5 deg/h, 0.05 mg) gained in ten minutes.
- fog: a choice, of the class of a fibre-optic unit with MEMS accelerometers: 0.012 deg/rt(h), 0.12 mg
  per root hertz, biases 1 deg/h and 0.5 mg; walks that gain 0.05 deg/h and 0.05 mg in ten minutes.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from rovgraph.config import Config
from rovgraph.geometry import wrap_angle

Grade = Literal["mti", "tactical", "fog"]
HeadingSources = Literal["mag", "dvl", "ahrs", "mag+dvl"]
HeadingError = Literal["none", "offset", "deviation", "both"]

_MILLI_G, _DEG_PER_H, _TEN_MINUTES = 9.81e-3, float(np.deg2rad(1.0)) / 3600.0, 600.0


def _imu(acc: float, gyr: float, acc_walk: float, gyr_walk: float, acc_bias: float, gyr_bias_dps: float) -> Any:
    noise = {"acc": acc, "gyr": gyr, "acc_walk": acc_walk, "gyr_walk": gyr_walk}
    return {"noise": noise, "acc_bias_sd_mps2": acc_bias, "gyr_bias_sd_dps": gyr_bias_dps}


def _gained(bias: float) -> float:
    """Random walk that gains a bias in ten minutes."""
    return float(bias / np.sqrt(_TEN_MINUTES))


GRADES: Mapping[str, dict[str, Any]] = MappingProxyType(
    {
        "mti": _imu(7.82e-4, 6.37e-4, 3.0e-4, 1.0e-5, 0.02, 0.5),
        "tactical": _imu(
            0.06 / 60.0, float(np.deg2rad(0.15)) / 60.0, _gained(0.05 * _MILLI_G), _gained(0.5 * _DEG_PER_H),
            0.75 * _MILLI_G, 10.0 / 3600.0,
        ),
        "fog": _imu(
            0.12 * _MILLI_G, float(np.deg2rad(0.012)) / 60.0, _gained(0.05 * _MILLI_G), _gained(0.05 * _DEG_PER_H),
            0.5 * _MILLI_G, 1.0 / 3600.0,
        ),
    }
)  # fmt: skip

COMPASS = MappingProxyType({"mag": "mag", "dvl": "dvl_compass", "ahrs": "ahrs"})  # source: prefix of its variables
IRON = ("hard_iron", "soft_iron")  # a study's compasses err as said, and not otherwise


def believed(
    vehicle: Config,
    grade: Grade,
    headings: HeadingSources,
    heading_error: HeadingError,
    heading_error_sd_deg: float,
    fix_sd_m: float | None,
    prior_deg: tuple[float, float],
) -> Config:
    """What the estimator of a run is given; the simulator draws the errors of its compasses from it.

    Parameters
    ----------
    vehicle : of the study
    grade : key of `GRADES`
    headings : sources of heading
    heading_error, heading_error_sd_deg : what is unknown of each, and sd of every component
    fix_sd_m : noise of a position fix, None = there are none
    prior_deg : mean, beyond the mounting, and sd of the DVL's yaw
    """
    sources = tuple(headings.split("+"))
    entries: dict[str, dict[str, Any]] = {name: {"estimate": False} for name in IRON}
    for source, prefix in COMPASS.items():
        for kind in ("offset", "deviation"):
            estimate = source in sources and heading_error in (kind, "both")
            entries[f"{prefix}_{kind}"] = {"estimate": estimate, "sd_deg": heading_error_sd_deg}
    mean = float(np.rad2deg(wrap_angle(np.deg2rad(vehicle.dvl.mount_rpy_deg[2] + prior_deg[0]))))
    entries["dvl_yaw"] = {"estimate": True, "mean_deg": mean, "sd_deg": prior_deg[1]}
    data = vehicle.model_dump()
    for name, entry in entries.items():
        data["calibration"][name] |= entry
    data["imu"] |= GRADES[grade]
    data["heading"]["sources"] = sources
    data["fix"] |= {} if fix_sd_m is None else {"sd_m": fix_sd_m}
    return Config.model_validate(data)
