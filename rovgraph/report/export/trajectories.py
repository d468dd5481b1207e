"""Trajectories for other programs: TUM, KITTI, SBET and NetCDF.

TUM, for `evo_ape` and others: ``time x y z qx qy qz qw``, north, east, down.

KITTI odometry poses, for `evo` and others: the first three rows of each pose's matrix, without time.

SBET (Applanix), for survey software: binary records of 17 doubles, and the errors beside it as SMRMSG.

NetCDF with the CF conventions for trajectories: all values, with units and sds.
"""

from pathlib import Path

import numpy as np

from rovgraph._version import __version__
from rovgraph.dates import WEEK_S, gps_of_unix
from rovgraph.inference.trajectory import TUM
from rovgraph.report.export.formats import ExportFormat, ExportOptions
from rovgraph.report.export.track import Track


def write_tum(track: Track, path: Path, options: ExportOptions) -> None:
    """Every keyframe, or at a rate."""
    track.at_rate(options.rate).trajectory.write_tum(path)


_TUM = (ExportFormat("tum", "TUM", TUM, write_tum),)


def write_kitti(track: Track, path: Path, options: ExportOptions) -> None:
    """Every keyframe, or at a rate; axes north, east, down."""
    t = track.at_rate(options.rate).trajectory
    poses = np.concatenate([t.R_nb, t.p_n[:, :, None]], axis=2)
    np.savetxt(path, poses.reshape(len(t), 12), fmt="%.9f")


_KITTI = (ExportFormat("kitti", "KITTI poses", ".kitti.txt", write_kitti),)


RATE = 100.0  # of records, by default [Hz]
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


def write_sbet(track: Track, path: Path, options: ExportOptions) -> None:
    """A folder with sbet.out, records at 100 Hz or the rate asked for, and smrmsg.out.

    Radians, metres, m/s; the wander angle is 0, so x is north and y east.
    Accelerations and angular rates are 0: a trajectory does not hold them. RMS errors of angles are arc minutes.

    Raises
    ------
    InputError : no origin, no Unix time
    """
    sampled = track.at_rate(options.rate_or(RATE))
    t = sampled.trajectory
    lat, lon = sampled.lat_lon
    record = np.zeros((len(t), len(NAMES)), dtype="<f8")
    record[:, 0] = week_seconds(t.time)
    record[:, 1:4] = np.column_stack([np.deg2rad(lat), np.deg2rad(lon), sampled.height])
    record[:, 4:7], record[:, 7:10] = t.v_n, t.rpy
    path.mkdir()
    (path / "sbet.out").write_bytes(record.tobytes())
    errors = np.column_stack([record[:, 0], t.p_sd, t.v_sd, np.rad2deg(t.rpy_sd) * 60.0]).astype("<f8")
    (path / "smrmsg.out").write_bytes(errors.tobytes())


_SBET = (ExportFormat("sbet", "SBET", "", write_sbet, needs_place=True, needs_utc=True),)


ANGLES = {
    "roll": "platform_roll_starboard_down",
    "pitch": "platform_pitch_fore_up",
    "yaw": "platform_yaw_fore_starboard",
}
SPEEDS = {"v_north": "platform velocity northwards", "v_east": "eastwards", "v_down": "downwards"}


def write_netcdf(track: Track, path: Path, options: ExportOptions) -> None:
    """Every keyframe, or at a rate. Latitude and longitude are there where they are known."""
    import xarray as xr

    sampled = track.at_rate(options.rate)
    t = sampled.trajectory
    variables: dict[str, tuple[str, np.ndarray, dict[str, str]]] = {
        "depth": ("time", t.p_n[:, 2], {"standard_name": "depth", "units": "m", "positive": "down", "axis": "Z"}),
        "north": ("time", t.p_n[:, 0], {"long_name": "north of the origin", "units": "m"}),
        "east": ("time", t.p_n[:, 1], {"long_name": "east of the origin", "units": "m"}),
    }
    if track.origin is not None:
        for name, degrees, axis in zip(("latitude", "longitude"), sampled.lat_lon, ("north", "east"), strict=True):
            variables[name] = ("time", degrees, {"standard_name": name, "units": f"degrees_{axis}"})
    for k, (name, standard) in enumerate(ANGLES.items()):
        variables[name] = ("time", np.rad2deg(t.rpy[:, k]), {"standard_name": standard, "units": "degree"})
    for k, (name, long_name) in enumerate(SPEEDS.items()):
        variables[name] = ("time", t.v_n[:, k], {"long_name": long_name, "units": "m s-1"})
    sds = {
        **dict(zip(("north", "east", "depth"), t.p_sd.T, strict=True)),
        **dict(zip(ANGLES, np.rad2deg(t.rpy_sd).T, strict=True)),
        **dict(zip(SPEEDS, t.v_sd.T, strict=True)),
    }
    for name, sd in sds.items():
        if np.isfinite(sd).any():
            words = {"long_name": f"standard deviation of {name}", "units": variables[name][2]["units"]}
            variables[f"{name}_sd"] = ("time", sd, words)
            variables[name][2]["ancillary_variables"] = f"{name}_sd"
    since = "seconds since 1970-01-01 00:00:00" if track.has_utc else "s"
    time = ("time", t.time, {"standard_name": "time", "units": since, "axis": "T"})
    title = {"Conventions": "CF-1.11", "featureType": "trajectory", "title": f"{track.name}, {track.estimate}"}
    title["source"] = f"rovgraph {__version__}"
    dataset = xr.Dataset(variables, {"time": time}, title)
    dataset["trajectory"] = ((), track.name, {"cf_role": "trajectory_id"})
    dataset.to_netcdf(path, engine="scipy", format="NETCDF3_64BIT", encoding={"time": {"_FillValue": None}})


_NETCDF = (ExportFormat("netcdf", "NetCDF (CF)", ".nc", write_netcdf, "netcdf"),)

FORMATS = (*_TUM, *_KITTI, *_SBET, *_NETCDF)
