"""The sensors of a configuration: measurement models with the configured noise."""

import numpy as np
from numpy.typing import ArrayLike

from rovgraph.model.config import Config
from rovgraph.sensors import DEFAULT_DIP, SENSORS, Instrument, hydrodynamics

__all__ = ["DEFAULT_DIP", "HEADING_STREAMS", "OFFSETS", "Instrument", "heading_sources", "hydrodynamics", "instruments"]

HEADING_STREAMS = tuple(s.name for s in SENSORS.values() if s.heading_source)  # log streams that give heading, in order
OFFSETS = {  # heading stream -> the calibration variable of its constant error
    "mag": "mag_offset",
    "ahrs": "ahrs_offset",
    "dvl_heading": "dvl_compass_offset",
    "vehicle_heading": "vehicle_compass_offset",
}


def heading_sources(config: Config, available: set[str]) -> list[str]:
    """Log streams that give heading, in order: "mag", "ahrs", "vehicle_heading", "dvl_heading".

    Where the configuration names no sources, the magnetometer goes before the IMU's own heading, which is made from it
    and would count it twice, and that before the vehicle's.
    """
    if config.heading.sources is not None:
        wanted = [s for s in HEADING_STREAMS if SENSORS[s].heading_source in config.heading.sources]
    else:
        of_vehicle = [s for s in ("mag", "ahrs", "vehicle_heading") if s in available]
        wanted = [*of_vehicle[:1], "dvl_heading"]
    return [s for s in HEADING_STREAMS if s in wanted and s in available]


def instruments(config: Config, origin_b: ArrayLike = (0.0, 0.0, 0.0)) -> dict[str, Instrument]:
    """Every sensor of a configuration that measures something of the state, by the name of its log stream.

    Parameters
    ----------
    config : Config
    origin_b : array_like, shape (3,), the point of the body that the state's position and
        velocity belong to [m]; lever arms are taken relative to it
    """
    origin = np.asarray(origin_b, float)
    return {s.name: s.instrument(config, origin) for s in SENSORS.values() if s.instrument is not None}
