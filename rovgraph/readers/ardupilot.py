"""ArduPilot's parameters and valid satellite fixes, for its own logs and for MAVLink.

Parameters: https://ardupilot.org/sub/docs/parameters.html.
"""

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.sensors.pressure import LEAST, MOST

FRESH = 1000.0  # density of water of specific gravity 1 [kg/m3]
CLOCK = "autopilot's boot time"
BODY = "vehicle: forward, starboard, down"
MAGNETIC = "vehicle relative to magnetic north, east, down"
EARTH_FIELD_UT = 20.0, 70.0  # magnitudes that the Earth's field has anywhere [uT]
MOTOR_1, MOTORS = 33, 8  # SERVOn_FUNCTION of the first thruster, and how many there are
NEUTRAL_US, SPAN_US = 1500.0, 400.0  # pulse widths of rest, and from there to full thrust
SPEED_ESTIMATE_AXES = (
    "the DVL's velocities come as vision speed estimates, by definition along north, east and down; those of the "
    "BlueOS DVL extension are along the vehicle's axes, which is assumed"
)


def declination(parameters: Mapping[str, float]) -> float:
    """Magnetic declination that the autopilot's heading includes [rad]; 0 where it is not known."""
    return parameters.get("COMPASS_DEC", 0.0)


def water_settings(instance: int, parameters: Mapping[str, float]) -> tuple[dict[str, float], list[str]]:
    """Section ``depth`` of a configuration, as an autopilot states surface and density, and warnings.

    Parameters
    ----------
    instance : of the pressure sensor, from 0
    parameters : of the autopilot
    """
    found: dict[str, float] = {}
    warnings = []
    names = [f"BARO{instance + 1}_GND_PRESS", *(["BARO_GND_PRESS"] if instance == 0 else [])]
    name = next((name for name in names if name in parameters), "")
    if name and LEAST <= parameters[name] <= MOST:
        found["surface_hpa"] = round(0.01 * parameters[name], 3)
    elif name:
        warnings.append(f"{name} states {0.01 * parameters[name]:.0f} hPa, which no air has: it is not used")
    if "BARO_SPEC_GRAV" in parameters:
        found["density_kgm3"] = round(FRESH * parameters["BARO_SPEC_GRAV"], 2)
    return found, warnings


def thrusters(outputs: Mapping[int, Array], parameters: Mapping[str, float]) -> dict[str, Array]:
    """Drive signals, -1 to 1, of the outputs that drive motors 1, 2, ...; {} where parameters do not state them.

    Parameters
    ----------
    outputs : number of the output -> ndarray, shape (n,), pulse widths [us]; one without pulses drives nothing
    """
    motors = {}
    for number, width in outputs.items():
        motor = int(parameters.get(f"SERVO{number}_FUNCTION", 0)) - MOTOR_1 + 1
        if 1 <= motor <= MOTORS:
            motors[motor] = np.where(width > 0.0, (width - NEUTRAL_US) / SPAN_US, 0.0)
    if sorted(motors) != list(range(1, len(motors) + 1)):
        return {}
    return {f"thruster_{motor}": motors[motor] for motor in sorted(motors)}


def settings(sensors: Collection[str], parameters: Mapping[str, float]) -> tuple[dict[str, Any], list[str]]:
    """A configuration from parameters, and warnings.

    Parameters
    ----------
    sensors : those that a file has
    """
    found: dict[str, Any] = {}
    for sensor, prefix in (("imu", "INS_POS1"), ("dvl", "VISO_POS")):
        if sensor in sensors:
            lever = [round(parameters.get(f"{prefix}_{axis}", 0.0), 4) for axis in "XYZ"]
            found[sensor] = {"mount_rpy_deg": [0.0, 0.0, 0.0]} | ({"lever_arm_m": lever} if any(lever) else {})
    if "COMPASS_DEC" in parameters:
        found["environment"] = {"declination_deg": round(float(np.rad2deg(declination(parameters))), 3)}
        return found, []
    unknown = "the autopilot's declination is not in the file: ahrs_yaw is from true north, state it for the others"
    return found, [unknown] if "ahrs" in sensors else []


NO_DILUTION = 99.0  # and more: a receiver's mark of an unknown dilution of precision
RANGE_SD_M = 3.0  # of a satellite's range; with the dilution of precision that of a fix
ONE_POINT = "all fixes are of one point, which no receiver does: the origin of the dive, and no fixes"
FEW = 10  # fixes of one point that may be a vehicle at rest


def new_fixes(stamp: Array, lat: Array, lon: Array) -> NDArray[np.bool_]:
    """Which fixes are new: those with a position that do not repeat the one before.

    Parameters
    ----------
    stamp : ndarray, shape (n,), of the receiver
    lat, lon : ndarray, shape (n,) [deg]
    """
    somewhere = (np.abs(lat) <= 90.0) & (np.abs(lon) <= 180.0) & ((lat != 0.0) | (lon != 0.0))
    index = np.flatnonzero(somewhere)
    fresh = np.ones(len(index), dtype=bool)
    stood = (np.diff(lat[index]) == 0.0) & (np.diff(lon[index]) == 0.0)
    fresh[1:] = ~stood & (np.diff(stamp[index]) != 0.0)
    new = np.zeros(len(lat), dtype=bool)
    new[index[fresh]] = True
    return new


def one_point(lat: Array, lon: Array) -> tuple[float, float] | None:
    """The point where all of many fixes lie, which somebody has entered: no receiver repeats one to the centimetre."""
    somewhere = (lat != 0.0) | (lon != 0.0)
    points = np.unique(np.column_stack([lat, lon])[somewhere], axis=0)
    return tuple(points[0].tolist()) if somewhere.sum() >= FEW and len(points) == 1 else None
