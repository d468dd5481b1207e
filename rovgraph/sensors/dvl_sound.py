"""The speed of sound that a DVL worked with, and that of the water: velocities and ranges are made as if it had known.

A piston's velocities and ranges are proportional to the speed of sound. Beams of a phased array point to
sin(angle) = c / (2 c0), so that horizontal velocities do not depend on it; vertical velocities do by

    sqrt(1/c_set^2 - 1/(4 c0^2)) / sqrt(1/c^2 - 1/(4 c0^2))

and distances straight down by (c / c_set) (2 / sqrt(3)) sqrt(1 - (c / (2 c0))^2). Velocities along its beams are given
as at one speed of sound, `beam_sound_speed`, which is that of the beams' directions. Source: Teledyne RD Instruments,
Pathfinder DVL Guide, speed of sound corrections.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from rovgraph.geometry import Array
from rovgraph.model.config import Config
from rovgraph.model.config_sections import LOGGED, Dvl
from rovgraph.sensors.dvl import DVL, DVL_ALTITUDE, DVL_WATER
from rovgraph.sensors.dvl_beam import BEAMS, DVL_BEAMS, PHASED_C0, QUANTITIES, beam_sound_speed
from rovgraph.sensors.sensor import Column, Said, Sensor
from rovgraph.sensors.sound import is_of_water, look_at_sound_speed, profile_of, sound_speed
from rovgraph.sensors.water_layer import ADCP, ALONG, CELLS, EARTH, VELOCITIES


def _look(values: Array, config: Config) -> Iterator[Said]:
    yield from look_at_sound_speed("dvl_sound_speed", values[:, 0])


DVL_SOUND = Sensor(
    "dvl_sound",
    (Column("dvl_sound_speed", "speed", optional=True), Column("water_temperature", optional=True)),
    may_begin_later=True,
    occasional=True,
    complete=lambda data: np.asarray(np.isfinite(data).any(axis=1)),
    look=_look,
)
CORRECTED = tuple(sensor.name for sensor in (DVL, DVL_WATER, DVL_ALTITUDE, DVL_BEAMS, ADCP))


class WaterState(NamedTuple):
    """What is known of the water at n pings, shape (n,) each; NaN = nothing.

    Attributes
    ----------
    set_speed : that the DVL worked with [m/s]
    temperature : at the DVL [deg C]
    depth : of the vehicle [m]
    """

    set_speed: Array
    temperature: Array
    depth: Array


class SoundCorrection:
    """Makes velocities and ranges of a DVL as if it had known the speed of sound.

    Parameters
    ----------
    config : states ``dvl.sound_speed_set_mps`` and ``dvl.sound_speed_mps``, ``sound.profile`` or
        ``sound.salinity_psu``; without the first nothing is corrected

    Raises
    ------
    InputError : a profile that cannot be used
    """

    def __init__(self, config: Config) -> None:
        self.dvl: Dvl = config.dvl
        self.applies = config.dvl.sound_speed_set_mps is not None
        self._salinity = config.sound.salinity_psu
        stated = self.applies and config.dvl.sound_speed_mps is None
        self._profile = profile_of(config.sound.profile) if stated else None

    def speeds(self, water: WaterState) -> tuple[Array, Array]:
        """Speeds of sound that the DVL worked with, and of the water, shape (n,) each; NaN = not known [m/s]."""
        stated = self.dvl.sound_speed_set_mps
        logged = stated is None or stated == LOGGED
        heard = np.where(is_of_water(water.set_speed), water.set_speed, np.nan)
        worked_with = heard if logged else np.full(len(water.depth), float(stated or np.nan))
        depth = np.nan_to_num(water.depth)
        if self.dvl.sound_speed_mps is not None:
            true = np.full(len(depth), self.dvl.sound_speed_mps)
        elif self._profile is not None:
            true = np.interp(depth, self._profile.depth, self._profile.speed)
        elif self._salinity is not None:
            true = sound_speed(self._salinity, water.temperature, depth)
        else:
            true = np.full(len(depth), np.nan)
        return worked_with, true

    def applied(self, sensor: str, data: Array, water: WaterState) -> Array:
        """Measurements as they would be, shape (n, k) as they are.

        Parameters
        ----------
        sensor : one of `CORRECTED`
        data : ndarray, shape (n, k), columns of its stream
        """
        c_set, c = self.speeds(water)
        known = np.isfinite(c_set)
        c_set = np.where(known, c_set, 1.0)
        c = np.where(known & np.isfinite(c), c, c_set)
        ratio, phased = c / c_set, self.dvl.beams.phased
        steep = np.sqrt(np.maximum(1.0 - (c / (2.0 * PHASED_C0)) ** 2, 0.0))  # cosine of the beams' angle
        down = ratio * (np.where(known, 2.0 / np.sqrt(3.0) * steep, 1.0) if phased else 1.0)
        set_steep = np.sqrt(np.maximum(1.0 - (c_set / (2.0 * PHASED_C0)) ** 2, 0.0))
        horizontal, vertical = (np.ones(len(c)), ratio * set_steep / steep) if phased else (ratio, ratio)
        along = np.where(known, beam_sound_speed(self.dvl) / c_set, 1.0) if phased else ratio
        out = data.copy()
        if sensor == BEAMS:
            factor = {"velocity": along, "range": ratio, "distance": down, "sd": along}
            for k, quantity in enumerate(QUANTITIES):
                if quantity in factor:
                    out[:, k :: len(QUANTITIES)] *= factor[quantity][:, None]
        elif sensor == DVL_ALTITUDE.name:
            out[:, 0] *= down
        elif sensor == CELLS:
            of_axes = dict(zip((*VELOCITIES, *EARTH), (horizontal, horizontal, vertical) * 2, strict=True))
            of_cells = dict.fromkeys(("adcp_range", "adcp_cell", "adcp_bottom"), down) | {"adcp_sd": horizontal}
            for name, factor_of_column in (of_axes | of_cells | dict.fromkeys(ALONG, along)).items():
                out[:, ADCP.column_names.index(name)] *= factor_of_column
        else:
            out[:, :3] *= np.column_stack([horizontal, horizontal, vertical])
        return out
