"""A track as a table of points with everything that a map can show of them."""

import numpy as np
import pandas as pd

from rovgraph.export.track import Track

SHOWN_HZ = 1.0  # of points on a map, unless told otherwise


def point_table(track: Track) -> pd.DataFrame:
    """One row per epoch, in the units that people read; sds that are not known are left out.

    Columns: time [s], utc where known, lat, lon [deg], depth [m], heading, pitch, roll [deg], speed [m/s], and
    ``_sd`` of north, east, depth [m] and heading [deg], ``cov_north_east`` [m^2].

    Raises
    ------
    InputError : it is not known where on Earth the dive was
    """
    t = track.trajectory
    lat, lon = track.lat_lon
    rpy, rpy_sd, p_sd = np.rad2deg(t.rpy), np.rad2deg(t.rpy_sd), t.p_sd
    table = pd.DataFrame(
        {
            "time": t.time.round(4),
            "lat": lat.round(9),
            "lon": lon.round(9),
            "depth": t.p_n[:, 2].round(4),
            "heading": rpy[:, 2].round(3) % 360.0,
            "pitch": rpy[:, 1].round(3),
            "roll": rpy[:, 0].round(3),
            "speed": np.linalg.norm(t.v_n[:, :2], axis=1).round(4),
            "north_sd": p_sd[:, 0].round(4),
            "east_sd": p_sd[:, 1].round(4),
            "depth_sd": p_sd[:, 2].round(4),
            "heading_sd": rpy_sd[:, 2].round(4),
            "cov_north_east": t.cov_p[:, 0, 1].round(6),
        }
    ).dropna(axis="columns", how="all")
    if track.has_utc:
        table.insert(1, "utc", [stamp.isoformat(timespec="milliseconds") for stamp in track.utc])
    return table
