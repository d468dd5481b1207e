"""NetCDF with the CF conventions for trajectories: everything that is known, with units and sds."""

from pathlib import Path

import numpy as np

from rovgraph import __version__
from rovgraph.export.formats import ExportFormat, Options
from rovgraph.export.track import Track

ANGLES = {
    "roll": "platform_roll_starboard_down",
    "pitch": "platform_pitch_fore_up",
    "yaw": "platform_yaw_fore_starboard",
}
SPEEDS = {"v_north": "platform velocity northwards", "v_east": "eastwards", "v_down": "downwards"}


def write(track: Track, path: Path, options: Options) -> None:
    """Every keyframe, or at a rate. Latitude and longitude are there where they are known."""
    import xarray as xr

    shown = track.at_rate(options.rate)
    t = shown.trajectory
    variables: dict[str, tuple[str, np.ndarray, dict[str, str]]] = {
        "depth": ("time", t.p_n[:, 2], {"standard_name": "depth", "units": "m", "positive": "down", "axis": "Z"}),
        "north": ("time", t.p_n[:, 0], {"long_name": "north of the origin", "units": "m"}),
        "east": ("time", t.p_n[:, 1], {"long_name": "east of the origin", "units": "m"}),
    }
    if track.origin is not None:
        for name, degrees, axis in zip(("latitude", "longitude"), shown.lat_lon, ("north", "east"), strict=True):
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


FORMATS = (ExportFormat("netcdf", "NetCDF (CF)", ".nc", write, "netcdf"),)
