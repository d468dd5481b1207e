"""SBET (Applanix), for survey software: binary records of 17 doubles, and the errors beside it as SMRMSG."""

from pathlib import Path

import numpy as np

from rovgraph.export.formats import ExportFormat, Options
from rovgraph.export.track import Track
from rovgraph.gps_time import WEEK_S, gps_of_unix

RATE = 100.0  # of records, unless told otherwise [Hz]
NAMES = (
    "time", "latitude", "longitude", "altitude", "x_velocity", "y_velocity", "z_velocity", "roll", "pitch",
    "heading", "wander_angle", "x_acceleration", "y_acceleration", "z_acceleration", "x_rate", "y_rate", "z_rate",
)  # fmt: skip
ERRORS = (
    "time", "north_rms", "east_rms", "down_rms", "north_velocity_rms", "east_velocity_rms", "down_velocity_rms",
    "roll_rms", "pitch_rms", "heading_rms",
)  # fmt: skip


def week_seconds(unix: np.ndarray) -> np.ndarray:
    """GPS seconds of the week in which the first time lies, going on beyond its end; shape as given."""
    week, seconds = gps_of_unix(unix)
    return np.asarray(seconds + WEEK_S * (week - week[0]))


def write(track: Track, path: Path, options: Options) -> None:
    """A folder with sbet.out, records at 100 Hz or the rate asked for, and smrmsg.out.

    Radians, metres, m/s; the wander angle is 0, so x is north and y east.
    Accelerations and angular rates are 0: a trajectory does not hold them. RMS errors of angles are arc minutes.

    Raises
    ------
    InputError : no origin, no Unix time
    """
    shown = track.at_rate(options.rate_or(RATE))
    t = shown.trajectory
    lat, lon = shown.lat_lon
    record = np.zeros((len(t), len(NAMES)), dtype="<f8")
    record[:, 0] = week_seconds(t.time)
    record[:, 1:4] = np.column_stack([np.deg2rad(lat), np.deg2rad(lon), shown.height])
    record[:, 4:7], record[:, 7:10] = t.v_n, t.rpy
    path.mkdir()
    (path / "sbet.out").write_bytes(record.tobytes())
    errors = np.column_stack([record[:, 0], t.p_sd, t.v_sd, np.rad2deg(t.rpy_sd) * 60.0]).astype("<f8")
    (path / "smrmsg.out").write_bytes(errors.tobytes())


FORMATS = (ExportFormat("sbet", "SBET", "", write, needs_place=True, needs_utc=True),)
