"""Depth by pressure: the air's pressure at the surface, the water's density and gravity, in one place.

    depth = x / (1 + k x / 2 g),  x = (pressure - surface) / (density g)

where g is gravity at the surface and k its growth with depth (`rovgraph.kernels.earth`); the density is constant.
Where ``sound.profile`` has temperature and salinity, depths are those of TEOS-10 (`OceanProfile`).
Reading a log and the online mode take pressures one by one through the same `DepthByPressure`, so their depths agree.
"""

import math
from collections.abc import Iterator, Mapping
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.kernels.earth import GRAVITY_PER_DEPTH, normal_gravity
from rovgraph.model.config import Config
from rovgraph.sensors.sensor import Column, Sensor
from rovgraph.sensors.sound import SoundSpeedProfile, profile_of

PRESSURE = Sensor("pressure", (Column("pressure", "pressure"),), may_begin_later=True)  # becomes the stream "depth"
BY_PRESSURE = "depth by pressure"  # begins what a log notes of it
STANDARD = 101325.0  # of the atmosphere at sea level [Pa]
LEAST, MOST = 50_000.0, 108_500.0  # of air where people dive, mountain lakes included [Pa]
AT_SEA = 87_000.0  # least that was ever measured at sea level [Pa]
SHALLOW = 3.0 * STANDARD  # at 20 m
SEA = 1025.0  # density [kg/m^3]
PER_PSU = 35.16504 / 35.0  # of absolute salinity [g/kg]
DEEPER_DBAR = 1000.0  # beyond a profile, whose water stays
FRESH, BY_SALT = 999.7, 0.778  # at 10 deg C [kg/m^3], and by a psu
BLOCK_S = 5.0  # of pressures that are looked at together
CALM_PA = 1500.0  # spread of a block in which the vehicle keeps its depth
STEADY, HIGHEST_PA = 0.25, 1e4  # of a spread by waves, by which two blocks differ from the two before; the most spread
SAME_PA = 1000.0  # change of the air's pressure between two stays at the surface: 10 cm of water
WAVES_S, ENOUGH, BLOCKS = 20.0, 15, 3  # of depths at the surface: length, least samples, least number
AT_SURFACE_M = 0.5
GAUGE_PA = 5000.0  # least of a pressure from which the air's was taken off


def density(config: Config) -> float:
    """Of the water, as stated, or by its salinity, else of the sea [kg/m^3]."""
    stated, salinity = config.depth.density_kgm3, config.sound.salinity_psu
    if stated is not None:
        return stated
    return SEA if salinity is None else FRESH + BY_SALT * salinity


class SurfacePressure:
    """Pressure of the air, by what was measured so far: of the newest stay at the surface.

    It begins with the least pressure of the first block. A stay begins with a lower one, or where two calm blocks in a
    row come back to that of the stay before, within `SAME_PA`. It is a mean of medians, so that waves hardly move it. A
    block with waves is calm where two in a row have the level of the two before; at the start, it is above the least.

    Parameters
    ----------
    stated : as the configuration has it [Pa], None = to be found

    Attributes
    ----------
    value : [Pa], NaN while unknown
    """

    def __init__(self, stated: float | None) -> None:
        self.value = math.nan if stated is None else stated
        self._finds = stated is None
        self._block: list[float] = []
        self._begin, self._mean, self._count = 0.0, 0.0, 0
        self._levels, self._above = [math.nan] * 4, 0.0
        self._first = True

    def take(self, time: float, pascal: float) -> float:
        """Take a pressure; the surface's at that time [Pa], NaN = not known yet."""
        if not self._finds:
            return self.value
        if self._block and not 0.0 <= time - self._begin < BLOCK_S:
            self._close()
        if not self._block:
            self._begin = time
        self._block.append(pascal)
        if self._first and LEAST <= (least := min(self._block)) <= MOST:
            return least
        return self.value

    def _close(self) -> None:
        low, level, high = np.quantile(self._block, [0.05, 0.5, 0.95]).tolist()
        self._block = []
        moves, possible = high - low > CALM_PA, LEAST <= level <= MOST
        if self._first and moves and LEAST <= low <= MOST:
            self.value, self._above = low, level - low
        self._first, self._levels = False, [*self._levels[1:], level]
        a, b, c, d = self._levels
        waves = moves and high - low <= HIGHEST_PA and abs(c + d - a - b) <= 2.0 * STEADY * (high - low)
        level = 0.25 * (a + b + c + d) if waves else level
        if (moves and not waves) or not possible or level > self.value + SAME_PA + waves * self._above:
            self._count = 0
            return
        if not level >= self.value - SAME_PA:  # the first, or nearer to the surface than all before
            self.value, self._mean, self._count, self._above = level, level, 1, 0.0
            return
        self._mean = (self._count * self._mean + level) / (self._count + 1)
        self._count += 1
        if self._count > 1:
            self.value, self._above = self._mean, 0.0

    def state(self) -> list[Any]:
        """Plain values from which `restore` goes on."""
        settled = self.value, self._begin, self._mean, self._count, self._first, self._above
        return [*settled, *self._levels, *self._block]

    def restore(self, state: list[Any]) -> None:
        """Go on from the state of another."""
        self.value, self._begin, self._mean, self._count, first, self._above, *rest = state
        self._first, self._levels, self._block = bool(first), rest[:4], rest[4:]


class OceanProfile:
    """Depth by pressure in water whose temperature and salinity are known by depth: TEOS-10, by GSW.

    IOC, SCOR and IAPSO, The international thermodynamic equation of seawater - 2010. Absolute salinity is practical
    salinity times 35.16504 / 35, without its regional anomaly.

    Parameters
    ----------
    depth, temperature, salinity : ndarray, shape (n,) [m, deg C, psu]; beyond them they stay
    latitude : [deg]
    """

    def __init__(self, depth: Array, temperature: Array, salinity: Array, latitude: float) -> None:
        import gsw

        self._z_from_p, self._latitude = gsw.z_from_p, latitude
        measured = gsw.p_from_z(-np.maximum(depth, 0.0), latitude)
        self._pressure = np.arange(0.0, measured[-1] + DEEPER_DBAR, 1.0)
        absolute = PER_PSU * np.interp(self._pressure, measured, salinity)
        conservative = gsw.CT_from_t(absolute, np.interp(self._pressure, measured, temperature), self._pressure)
        self._anomaly = gsw.geo_strf_dyn_height(absolute, conservative, self._pressure, 0.0)

    def depth(self, pascal: Array) -> Array:
        """Depths [m] by pressures above the surface's, shape (n,)."""
        dbar = 1e-4 * pascal
        anomaly = np.interp(dbar, self._pressure, self._anomaly)
        return np.asarray(-self._z_from_p(dbar, self._latitude, anomaly))


@cache
def _ocean(profile: SoundSpeedProfile, latitude: float) -> OceanProfile | None:
    """Of a profile; None where it has no temperature and salinity, or GSW is not installed."""
    if profile.water is None:
        return None
    try:
        return OceanProfile(profile.depth, profile.water[0], profile.water[1], latitude)
    except ImportError:
        return None


class DepthByPressure:
    """Turns pressures into depths, one by one.

    Parameters
    ----------
    config : has ``depth.surface_hpa``, ``depth.density_kgm3``, ``sound`` and ``environment``
    """

    def __init__(self, config: Config) -> None:
        stated = config.depth.surface_hpa
        self.surface = SurfacePressure(None if stated is None else 100.0 * stated)
        self._environment, self._density = config.environment, density(config)
        profile = profile_of(config.sound.profile) if config.depth.density_kgm3 is None else None
        self._profile = profile if profile is not None and profile.water is not None else None

    def take(self, time: float, pascal: float) -> float:
        """Pressure at the surface, after a pressure [Pa]; NaN = not known yet."""
        return self.surface.take(time, pascal)

    def depth(self, pascal: Array, surface: Array, latitude: float | None) -> Array:
        """Depths [m], shape (n,); NaN where no water has such a pressure.

        Parameters
        ----------
        pascal : shape (n,)
        surface : shape (n,), of `take`; where it is not known, the standard atmosphere's
        latitude : of the first fix [deg], None = not known
        """
        env = self._environment
        latitude = env.latitude if env.latitude is not None else latitude
        normal = env.gravity_mps2 is None and latitude is not None
        gravity = float(normal_gravity(np.deg2rad(latitude))) if normal else env.gravity  # type: ignore[arg-type]
        surface = np.where(np.isnan(surface), STANDARD, surface)
        possible = np.isfinite(pascal) & (pascal >= np.minimum(surface - GAUGE_PA, LEAST))
        ocean = None if self._profile is None else _ocean(self._profile, 45.0 if latitude is None else latitude)
        if ocean is not None:
            return np.where(possible, ocean.depth(np.where(possible, pascal - surface, 0.0)), np.nan)
        x = (pascal - surface) / (self._density * gravity)
        return np.where(possible, x / (1.0 + (GRAVITY_PER_DEPTH if normal else 0.0) * x / (2.0 * gravity)), np.nan)

    def says(self, surface: Array) -> str:
        """What the depths rest on, by the pressures of the surface, shape (n,)."""
        known = surface[np.isfinite(surface)]
        how = "as stated" if not self.surface._finds else "found where the vehicle was there"
        what = f"{known.min() / 100.0:.1f} to {known.max() / 100.0:.1f} hPa, {how}" if len(known) else ""
        what = what or f"{STANDARD / 100.0:.1f} hPa, the standard atmosphere, as the vehicle was never there"
        water = f"water of {self._density:.0f} kg/m3"
        if self._profile is not None and _ocean(self._profile, 45.0) is not None:
            water = "water of sound.profile, by TEOS-10"
        elif self._profile is not None:
            water += ", as its profile needs GSW; install it with: pip install 'rovgraph[teos10]'"
        return f"{BY_PRESSURE}: at the surface {what}; {water}"


def depths(time: Array, pascal: Array, config: Config, latitude: float | None) -> tuple[Array, str]:
    """Depths of a log's pressures, shape (n,) each, and what they rest on.

    Before the vehicle is at the surface for the first time, the pressure there is that of the first time.
    """
    by = DepthByPressure(config)
    surface = np.array([by.take(t, p) for t, p in zip(time.tolist(), pascal.tolist(), strict=True)])
    known = np.flatnonzero(np.isfinite(surface))
    if len(known):
        surface[: known[0]] = surface[known[0]]
    return by.depth(pascal, surface, latitude), by.says(surface)


def waves_at_surface(time: Array, depth: Array) -> float:
    """Scatter of depths while the vehicle is at the surface, about their line in each block, sd [m]; 0 = too few.

    Parameters
    ----------
    time, depth : shape (n,)
    """
    found = []
    bounds = np.searchsorted(time, np.arange(time[0], time[-1], WAVES_S))
    for begin, end in pairwise(bounds.tolist()):
        t, z = time[begin:end], depth[begin:end]
        if len(t) >= ENOUGH and abs(np.median(z)) < AT_SURFACE_M:
            line = np.column_stack([np.ones(len(t)), t - t[0]])
            found.append(float(np.std(z - line @ np.linalg.lstsq(line, z)[0])))
    return float(np.median(found)) if len(found) >= BLOCKS else 0.0


def units_of_air(number: float, units: Mapping[str, float]) -> list[str]:
    """Units, of those with their factors to pascals, in which a number is the air's pressure at sea level."""
    return [unit for unit, factor in units.items() if AT_SEA <= number * factor <= MOST]


def complaints(pascal: Array, factor: float, units: Mapping[str, float], source: str) -> Iterator[str]:
    """Doubts about pressures in a log, where ``depth.surface_hpa`` is not stated or leaves none, a line each.

    Parameters
    ----------
    pascal : ndarray, shape (n,), as converted
    factor : of the unit that they were converted from
    units : unit -> its factor

    Raises
    ------
    InputError : they are no absolute pressures
    """
    least, most = (float(np.nanquantile(pascal, q)) for q in (0.01, 0.99))
    meant = units_of_air(least / factor, units)
    better = f"state units: {{pressure: {meant[-1]}}}" if meant else ""
    if least > MOST:
        hint = f"if it was at the surface, the unit is {meant[-1]}: {better}" if meant else "state depth.surface_hpa"
        yield (
            f"{source}: pressure: at least {least / 100.0:.0f} hPa, so never at the surface, where the standard "
            f"atmosphere's {STANDARD / 100.0:.0f} hPa are taken; {hint}"
        )
    elif least < LEAST:
        said = f"{source}: pressure: {least:.4g} to {most:.4g} Pa, and no air has so little"
        below = [unit for unit, f in units.items() if MOST < least / factor * f <= SHALLOW]
        deeper = f"if it was never at the surface, state units: {{pressure: {below[-1]}}}" if below else ""
        if meant:
            raise InputError(f"{said}; {better}" + (f", or {deeper}" if below else ""))
        if most - least < GAUGE_PA:
            other = deeper or "else state its unit under units"
            raise InputError(f"{said}; if these are metres, name the column depth; {other}")
        raise InputError(f"{said}; if the air's is taken off, state depth.surface_hpa: 0; else state units: pressure")
