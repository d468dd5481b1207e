"""ArduPilot's parameters, depth from pressure, and valid satellite fixes, for its own logs and for MAVLink.

`surface_pressure` finds which pressure is that of the surface. Parameters:
https://ardupilot.org/sub/docs/parameters.html.
"""

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.readers.recording import Zero

STANDARD = 101325.0  # of the atmosphere at sea level [Pa]
GRAVITY = 9.80665  # [m/s2]
FRESH = 1000.0  # density of water [kg/m3]
PLAUSIBLE = 50_000.0, 110_000.0  # of air where people dive, mountain lakes included [Pa]


def surface_pressure(stated: float | None, pressure: Array) -> tuple[float, str, bool]:
    """The pressure at depth 0.

    Parameters
    ----------
    stated : the file's own value [Pa], None = without one
    pressure : ndarray, shape (n,), all that were measured [Pa]

    Returns
    -------
    pressure [Pa], where it comes from, whether that is as good as what a file states
    """
    low, high = PLAUSIBLE
    if stated is not None and low <= stated <= high:
        return stated, "as the file states", True
    said = "not stated" if stated is None else f"stated as {stated / 100.0:.0f} hPa, which no air has"
    sane = pressure[np.isfinite(pressure) & (pressure >= low)]
    least = float(np.quantile(sane, 0.01)) if len(sane) else np.inf  # of outliers none
    if least <= high:
        return least, f"{said}; the least that was measured", False
    return STANDARD, f"{said}, and never measured; the standard atmosphere", False


def zero_of(surface: float, density: float, said: str) -> Zero:
    """The surface as a depth, where it is guessed by the measured pressures."""
    return Zero(surface / (density * GRAVITY), said, surface != STANDARD)


def depth(pressure: Array, surface: float, density: float) -> Array:
    """Depth below the surface [m], shape (n,); impossible pressures are NaN."""
    possible = np.isfinite(pressure) & (pressure >= PLAUSIBLE[0])
    return np.where(possible, (pressure - surface) / (density * GRAVITY), np.nan)


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


def depth_of(
    instance: int, pressure: Array, parameters: Mapping[str, float], label: str
) -> tuple[Array, str, bool, Zero | None]:
    """Depth of a pressure sensor.

    Parameters
    ----------
    instance : of the barometer, from 0
    pressure : ndarray, shape (n,) [Pa]
    parameters : of the autopilot
    label : of the sensor, for people

    Returns
    -------
    depth, ndarray, shape (n,) [m]; what it rests on, for people; whether that is the autopilot's own word; the surface
    where it is guessed
    """
    surface, found, good = surface_of(instance, pressure, parameters)
    density = density_of(parameters)
    water = f"water of {density:.0f} kg/m3" + ("" if "BARO_SPEC_GRAV" in parameters else " for want of BARO_SPEC_GRAV")
    said = f"{label}: surface pressure {surface / 100.0:.1f} hPa ({found}), {water}"
    zero = None if good else zero_of(surface, density, said)
    return depth(pressure, surface, density), said, good and "BARO_SPEC_GRAV" in parameters, zero


def surface_of(instance: int, pressure: Array, parameters: Mapping[str, float]) -> tuple[float, str, bool]:
    """Pressure at the surface [Pa], by `surface_pressure`; arguments of `depth_of`."""
    names = [f"BARO{instance + 1}_GND_PRESS", *(["BARO_GND_PRESS"] if instance == 0 else [])]
    return surface_pressure(next((parameters[name] for name in names if name in parameters), None), pressure)


def density_of(parameters: Mapping[str, float]) -> float:
    """Of the water, as an autopilot's parameters state it; else fresh [kg/m3]."""
    return FRESH * parameters.get("BARO_SPEC_GRAV", 1.0)


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
