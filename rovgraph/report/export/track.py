"""The data of an export: a trajectory with its place on Earth, its time and its fixes, as a table of points."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rovgraph import compatibility
from rovgraph.dates import is_unix
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.inference.trajectory import Trajectory, read_trajectory
from rovgraph.model.origin import Frame, Origin, lat_lon, origin_in
from rovgraph.report.folder import ACOUSTICS_FILE, SOUNDINGS_FILE, beacon_names_of

CHI2_95 = 5.991  # of two degrees of freedom
ESTIMATES = ("smoothed", "filtered", "dead_reckoning")


@dataclass(frozen=True)
class Fixes:
    """Position fixes of a dive.

    Attributes
    ----------
    time : ndarray, shape (n,) [s]
    position : ndarray, shape (n, 2), north and east [m]
    used : ndarray of bool, shape (n,), False = rejected
    """

    time: Array
    position: Array
    used: NDArray[np.bool_]


@dataclass(frozen=True)
class ShipAndBeacons:
    """What carried an acoustic system.

    Attributes
    ----------
    ship : ndarray, shape (n, 2), north and east of its head when it heard replies [m]
    beacons : name -> north, east and their sds [m]
    """

    ship: Array
    beacons: Mapping[str, tuple[float, float, float, float]]


@dataclass(frozen=True)
class Track:
    """An estimate of a dive, ready to be written.

    Attributes
    ----------
    name : of the dive
    estimate : "smoothed", "filtered" or "dead_reckoning"
    trajectory : of the body's origin
    origin : latitude and longitude [deg] of north = east = 0; None = not known
    fixes : None where the dive has none
    surface : height of the water's surface above sea level [m]
    acoustics : None where the dive has no acoustic system
    soundings : rows of soundings.csv (docs/results.md), None where the DVL measured no ranges
    frame : of north and east, for an origin that is given later
    """

    name: str
    estimate: str
    trajectory: Trajectory
    origin: Origin | None = None
    fixes: Fixes | None = None
    surface: float = 0.0
    acoustics: ShipAndBeacons | None = None
    soundings: pd.DataFrame | None = field(default=None, compare=False)
    frame: Frame = "flat"

    @cached_property
    def lat_lon(self) -> tuple[Array, Array]:
        """Latitude and longitude [deg], each of shape (n,).

        Raises
        ------
        InputError : it is not known where on Earth the dive was
        """
        return self.trajectory.geodetic(require_place(self.name, self.origin))

    def place(self, north: Array, east: Array) -> tuple[Array, Array]:
        """Latitude and longitude [deg] of other points, shape as given.

        Raises
        ------
        InputError : as `lat_lon`
        """
        lat, lon = lat_lon(north, east, require_place(self.name, self.origin))
        return np.asarray(lat), np.asarray(lon)

    @property
    def height(self) -> Array:
        """Height above sea level [m], shape (n,), NaN where the depth is not known."""
        return np.asarray(self.surface - self.trajectory.p_n[:, 2])

    def continuous(self, lon: Array) -> Array:
        """Longitudes [deg] that go on beyond 180 where a dive crosses the date line: lines and rings stay whole."""
        start = self.lat_lon[1][0]
        return np.asarray(start + (lon - start + 180.0) % 360.0 - 180.0)

    def placed(self, origin: tuple[float, float] | None, surface: float) -> "Track":
        """The same elsewhere on Earth.

        Parameters
        ----------
        origin : latitude and longitude of north = east = 0 [deg]; None = as it is known
        surface : height of the water's surface above sea level [m]

        Raises
        ------
        InputError : they are no degrees, or no height
        """
        if not np.isfinite(surface):
            raise InputError(f"surface: {surface:g} is no height in metres")
        if origin is None:
            return replace(self, surface=surface)
        if not (len(origin) == 2 and abs(origin[0]) <= 90.0 and abs(origin[1]) <= 180.0):
            given = ", ".join(f"{angle:g}" for angle in origin)
            raise InputError(f"origin {given}: expected latitude and longitude in degrees, such as 43.1 3.2")
        return replace(self, origin=origin_in(self.frame, float(origin[0]), float(origin[1])), surface=surface)

    @property
    def has_utc(self) -> bool:
        """Whether time counts from 1970."""
        return is_unix(self.trajectory.time[[0, -1]])

    @property
    def utc(self) -> pd.DatetimeIndex:
        """Time of every epoch.

        Raises
        ------
        InputError : time counts from something else
        """
        require_utc(self.name, self.trajectory.time[0])
        return pd.to_datetime(np.round(self.trajectory.time * 1e6).astype(np.int64), unit="us", utc=True)

    def shifted(self, seconds: float) -> "Track":
        """The same with another zero of time.

        Raises
        ------
        InputError : no number of seconds
        """
        if not np.isfinite(seconds):
            raise InputError(f"unix_offset: {seconds:g} is no number of seconds")
        fixes = None if self.fixes is None else replace(self.fixes, time=self.fixes.time + seconds)
        trajectory = replace(self.trajectory, time=self.trajectory.time + seconds)
        found = self.soundings
        soundings = None if found is None else found.assign(time=found["time"] + seconds)
        return replace(self, trajectory=trajectory, fixes=fixes, soundings=soundings)

    def at_rate(self, rate: float | None) -> "Track":
        """At whole multiples of a period, interpolated; None = at every keyframe.

        Parameters
        ----------
        rate : [Hz]

        Raises
        ------
        InputError : a rate that is not positive, or the dive is shorter than its period
        """
        if rate is None:
            return self
        if not 0.0 < rate <= 1000.0:
            raise InputError(f"rate {rate:g}: expected one above 0 and up to 1000 Hz")
        time = self.trajectory.time
        wanted = np.arange(np.ceil(time[0] * rate), np.floor(time[-1] * rate) + 1.0) / rate
        if not len(wanted):
            raise InputError(f"{self.name}: is shorter than {1.0 / rate:g} s; give a higher rate")
        return replace(self, trajectory=self.trajectory.clamped(wanted))


def require_place(name: str, origin: Origin | None) -> Origin:
    """The origin of a dive.

    Raises
    ------
    InputError : it is not known where on Earth the dive was
    """
    if origin is None:
        raise InputError(
            f"{name}: the dive's place on Earth is unknown; export its results with --origin LAT LON, or state "
            "environment.origin_lat_deg and origin_lon_deg, or log fixes as fix_lat and fix_lon, and smooth again"
        )
    return origin


def require_utc(name: str, start: float) -> None:
    """See that time is Unix time.

    Parameters
    ----------
    start : when the dive began [s]

    Raises
    ------
    InputError : it counts from something else
    """
    if not is_unix(start):
        raise InputError(
            f"{name}: its time begins at {start:g} s, which is not Unix time, and this format needs one; "
            "add the Unix time of 0 s to the log's times (or give it as --unix-offset)"
        )


def ellipse(covariance: Array, corners: int = 36) -> Array:
    """The 95 % ellipse around 0, ndarray, shape (corners + 1, 2), closed; ``covariance`` has shape (2, 2)."""
    value, axes = np.linalg.eigh(covariance)
    turn = np.linspace(0.0, 2.0 * np.pi, corners + 1)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    return np.asarray((axes @ (np.sqrt(CHI2_95 * np.maximum(value, 0.0))[:, None] * circle)).T)


def read_track(folder: Path | str, estimate: str | None = None) -> Track:
    """A track of a results folder.

    Parameters
    ----------
    folder : of ``rovgraph smooth`` or ``rovgraph online``
    estimate : None = the best that is there

    Raises
    ------
    InputError : no results folder, one of a newer version, or not that estimate
    """
    folder = Path(folder)
    try:
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{folder}: no summary.json in it, expected a results folder of rovgraph") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{folder}/summary.json: cannot be read ({str(error).splitlines()[0]})") from None
    if not isinstance(summary, dict) or summary.get("program") != "rovgraph":
        raise InputError(f"{folder}/summary.json: is not of rovgraph, expected a results folder of it")
    compatibility.refuse_newer(summary.get("format"), compatibility.RESULTS, f"{folder}: results folder")
    kinds = [kind for kind in ESTIMATES if (folder / f"trajectory_{kind}.csv").is_file()]
    if not kinds or estimate not in (None, *kinds):
        found = ", ".join(kinds) or "no trajectory"
        raise InputError(f"{folder}: the {estimate or 'smoothed'} estimate is not in it; there is {found}")
    chosen = kinds[0] if estimate is None else estimate
    place, frame = summary.get("origin"), summary.get("frame", "flat")  # of earlier versions
    origin = None if place is None else origin_in(frame, float(place["lat_deg"]), float(place["lon_deg"]))
    trajectory = read_trajectory(folder / f"trajectory_{chosen}.csv")
    name = str(summary.get("name") or folder.name)
    fixes, acoustics = _read_fixes(folder), _read_acoustics(folder, summary)
    path = folder / SOUNDINGS_FILE  # of the main estimate, which is the first
    soundings = pd.read_csv(path) if path.is_file() and chosen == kinds[0] else None
    return Track(name, chosen, trajectory, origin, fixes, acoustics=acoustics, soundings=soundings, frame=frame)


def _read_fixes(folder: Path) -> Fixes | None:
    path = folder / "residuals.csv"
    if not path.is_file():
        return None
    columns = ["time", "sensor", "component", "measured", "weight"]
    return fixes_of(pd.read_csv(path, usecols=columns))


def _read_acoustics(folder: Path, summary: Mapping[str, object]) -> ShipAndBeacons | None:
    if not (folder / ACOUSTICS_FILE).is_file():
        return None
    table = pd.read_csv(folder / "calibration.csv")
    table = table[table["estimate"] == summary.get("main_estimate")]
    places = {str(label): (value, sd) for label, value, sd in table[["label", "value", "sd"]].itertuples(index=False)}
    names = beacon_names_of((folder / "config.yaml").read_text(encoding="utf-8"))
    return acoustics_of(pd.read_csv(folder / ACOUSTICS_FILE), places, names)


def acoustics_of(
    replies: pd.DataFrame, calibration: Mapping[str, tuple[float, float]], names: Sequence[str]
) -> ShipAndBeacons | None:
    """Ship and beacons among replies (docs/results.md), None without any.

    Parameters
    ----------
    calibration : label -> value and sd
    names : of the beacons, in the configuration's order
    """
    ship = replies[["ship_north", "ship_east"]].dropna().to_numpy(float)
    beacons = {}
    for k, name in enumerate(names):
        north, east = (calibration.get(f"beacon_{k + 1}_{axis}") for axis in ("north", "east"))
        if north is not None and east is not None:
            beacons[name] = (float(north[0]), float(east[0]), float(north[1]), float(east[1]))
    return ShipAndBeacons(ship, beacons) if len(ship) or beacons else None


def fixes_of(residuals: pd.DataFrame) -> Fixes | None:
    """The fixes among residuals (docs/results.md), None without any."""
    fixes = residuals[residuals["sensor"] == "fix"]
    north, east = (fixes[fixes["component"] == name] for name in ("north", "east"))
    if not len(north) or len(north) != len(east):
        return None
    position = np.column_stack([north["measured"], east["measured"]]).astype(float)
    return Fixes(north["time"].to_numpy(float), position, north["weight"].to_numpy(float) > 0.0)


SHOWN_HZ = 1.0  # of points on a map, by default


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
