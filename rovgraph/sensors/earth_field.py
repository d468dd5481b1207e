"""The Earth's magnetic field by place and date: the World Magnetic Model 2025, and how sure it is.

Source: NOAA/NCEI and BGS, World Magnetic Model 2025, with its error model; computed by pygeomag.
"""

import datetime as dt
import math
from functools import cache
from typing import Any, NamedTuple

BLACKOUT_NT, CAUTION_NT = 2000.0, 6000.0  # horizontal field below which a compass shows nothing, or little
FLOOR_DEG = 0.5  # sd of the declination: rock near shores and magnetic storms are beyond the model's own
SPAN = 2025.0, 2030.0  # years of the model
STEP_KM, KM_PER_DEG = 10.0, 111.2


class EarthField(NamedTuple):
    """The field at a place.

    Attributes
    ----------
    declination_deg, dip_deg : east and down positive [deg]
    declination_sd_deg : at least `FLOOR_DEG` [deg]
    north_nt, east_nt, down_nt : [nT]
    horizontal_nt, total_nt : [nT]
    expired : the date is not one of the model's
    """

    declination_deg: float
    dip_deg: float
    declination_sd_deg: float
    north_nt: float
    east_nt: float
    down_nt: float
    horizontal_nt: float
    total_nt: float
    expired: bool


@cache
def _model() -> Any:
    from pygeomag.geomag import GeoMag  # reads its coefficients

    return GeoMag(coefficients_file="wmm/WMM_2025.COF")


def decimal_year(unix: float) -> float:
    """Year of a Unix time [s], such as 2025.5."""
    day = dt.datetime.fromtimestamp(unix, dt.UTC)
    begin, end = (dt.datetime(day.year + k, 1, 1, tzinfo=dt.UTC) for k in (0, 1))
    return day.year + (day - begin) / (end - begin)


def declination_per_km(latitude: float, longitude: float, year: float) -> tuple[float, float]:
    """Change of the declination by a kilometre north and east [deg/km], over 10 km each way."""
    north = STEP_KM / KM_PER_DEG
    east = north / max(math.cos(math.radians(latitude)), 0.01)
    changes = []
    for by_lat, by_lon in ((north, 0.0), (0.0, east)):
        ends = (earth_field(latitude + s * by_lat, longitude + s * by_lon, 0.0, year).declination_deg for s in (1, -1))
        changes.append(((next(ends) - next(ends) + 180.0) % 360.0 - 180.0) / (2.0 * STEP_KM))
    return changes[0], changes[1]


def earth_field(latitude: float, longitude: float, depth: float, year: float) -> EarthField:
    """The field by WMM2025.

    Parameters
    ----------
    latitude, longitude : [deg]
    depth : below the sea's surface [m]
    year : such as 2025.5
    """
    found = _model().calculate(latitude, longitude, -1e-3 * depth, year, allow_date_outside_lifespan=True)
    sd = max(FLOOR_DEG, (0.26**2 + (5417.0 / max(found.h, 1.0)) ** 2) ** 0.5)
    expired = not SPAN[0] <= year <= SPAN[1]
    return EarthField(found.d, found.i, sd, found.x, found.y, found.z, found.h, found.f, expired)
