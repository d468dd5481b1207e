"""Where the vehicle was at the times of another table: photos, sonar pings, samples.

Between keyframes position is interpolated along a line and attitude along the shortest arc (slerp). Keyframes are a
fraction of a second apart; an acceleration of 0.1 m/s2 bends the track by half a millimetre within 0.2 s.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rovgraph.dates import YEAR_FIRST, DateRules, is_text, seconds_of_numbers, seconds_of_texts
from rovgraph.errors import InputError, in_one_line
from rovgraph.geometry import Array
from rovgraph.report.export.track import Track, point_table

PLACED = "rov_"  # begins the names of columns that are added


@dataclass(frozen=True)
class Tagged:
    """A table with the vehicle's position and attitude at each row.

    Attributes
    ----------
    frame : the table, with columns ``rov_north``, ``rov_east``, ``rov_depth`` [m], ``rov_lat``, ``rov_lon`` [deg] where
        known, ``rov_heading``, ``rov_pitch``, ``rov_roll`` [deg], ``rov_speed`` [m/s], and ``_sd`` of them
    inside : ndarray of bool, shape (n,), False = outside the dive, and those columns are empty
    time : ndarray, shape (n,), on the track's clock [s]
    """

    frame: pd.DataFrame
    inside: NDArray[np.bool_]
    time: Array


def tag(table: pd.DataFrame, track: Track, column: str = "time", offset: float = 0.0) -> Tagged:
    """Add the vehicle's place at each row's time.

    Parameters
    ----------
    table : any columns
    column : of times, in seconds of the track's clock, or dates (UTC without a stated zone) if that is Unix time
    offset : what is added to the table's times, to come to the track's [s]

    Raises
    ------
    InputError : no such column or several, columns that it would add, times that cannot be read, no row within the dive
    """
    times = column_of(table, column)
    clash = next((str(name) for name in table.columns if str(name).startswith(PLACED)), None)
    if clash is not None:
        raise InputError(f"column {clash}: is in the table already; give the table without columns {PLACED}...")
    t = track.trajectory
    time = _seconds(times, track) + offset
    if not np.isfinite(time).any():
        raise InputError(f"column {column}: no row has a time (the offset is {offset:g} s)")
    inside = (time >= t.time[0]) & (time <= t.time[-1])
    if not inside.any():
        raise InputError(
            f"column {column}: its times, {np.nanmin(time):.1f} to {np.nanmax(time):.1f} s, are all outside the dive, "
            f"{t.time[0]:.1f} to {t.time[-1]:.1f} s; state the difference of the clocks as an offset"
        )
    at_rows = Track(track.name, track.estimate, t.clamped(np.sort(time[inside])), track.origin)
    order = np.argsort(np.argsort(time[inside], kind="stable"), kind="stable")
    frame = table.copy()
    for name, values in _columns(at_rows).iloc[order].items():
        placed = np.full(len(table), np.nan)
        placed[inside] = values
        frame[f"{PLACED}{name}"] = placed
    return Tagged(frame, inside, time)


def column_of(table: pd.DataFrame, column: str) -> pd.Series:
    """A column by name.

    Raises
    ------
    InputError : no such column, or several
    """
    found = [k for k, name in enumerate(table.columns) if name == column]
    if not found:
        raise InputError(f"column {column} is not in the table; it has {', '.join(map(str, table.columns[:12]))}")
    if len(found) > 1:
        raise InputError(f"column {column} stands in the table {len(found)} times")
    return table.iloc[:, found[0]]


def _columns(track: Track) -> pd.DataFrame:
    t = track.trajectory
    if track.origin is not None:
        table = point_table(track)
    else:
        known = Track(track.name, track.estimate, t, (0.0, 0.0))  # any place: lat and lon are not taken
        table = point_table(known).drop(columns=["lat", "lon"])
    table = table.drop(columns=["time", "utc", "cov_north_east"], errors="ignore")
    table.insert(0, "north", t.p_n[:, 0].round(4))
    table.insert(1, "east", t.p_n[:, 1].round(4))
    return table


def _seconds(times: pd.Series, track: Track) -> Array:
    numbers = times if times.dtype.kind in "biufM" else times.astype("string").str.replace(",", ".", regex=False)
    if numbers.dtype.kind != "M" and not is_text(numbers):  # some with decimal commas
        return seconds_of_numbers(pd.to_numeric(numbers, errors="coerce").to_numpy(float, na_value=np.nan))[0]
    day = pd.Timestamp(float(track.trajectory.time[0]), unit="s") if track.has_utc else None
    rules = DateRules(date=None if day is None else day.strftime("%Y-%m-%d"), remedy=YEAR_FIRST)  # of times of day
    texts = times.map(str, na_action="ignore")
    time, _ = seconds_of_texts(texts, rules, lambda row: f"column {times.name}: row {row + 1}")
    if texts.notna().any() and not track.has_utc:
        raise InputError(
            f"column {times.name}: holds dates, and the dive's time is not Unix time; give seconds of the dive's clock"
        )
    return time


def geotag(tagged: Tagged, track: Track, files: Sequence[Path], folder: Path) -> int:
    """Copy JPEGs with latitude, longitude, depth and heading in their EXIF; the pixels stay as they are.

    Parameters
    ----------
    files : of each row
    folder : to make the copies in; must not hold them yet

    Returns
    -------
    int : how many were written; photos outside the dive are left out

    Raises
    ------
    InputError : no origin, a photo that is not there or is no JPEG, two photos of one name
    """
    import piexif

    at = track.trajectory.clamped(tagged.time)
    lat, lon = Track(track.name, track.estimate, at, track.origin).lat_lon
    chosen = np.flatnonzero(tagged.inside).tolist()
    row_of: dict[str, int] = {}
    for k in chosen:
        if not files[k].is_file():
            raise InputError(f"{files[k]}: no such photo; names in the table are relative to its folder")
        if (other := row_of.setdefault(files[k].name, k)) != k:
            raise InputError(f"{files[k]}: rows {other + 1} and {k + 1} both make a copy {files[k].name}")
    folder.mkdir(parents=True, exist_ok=True)
    for k in chosen:
        gps = _gps(float(lat[k]), float(lon[k]), float(at.p_n[k, 2]), float(np.rad2deg(at.rpy[k, 2])))
        try:
            exif = piexif.load(str(files[k]))
            exif["GPS"] = gps
            content = piexif.dump(exif)
            piexif.insert(content, str(files[k]), str(folder / files[k].name))
        except PermissionError as error:
            raise InputError(f"{files[k]}: cannot be read ({error.strerror})") from None
        except OSError:
            raise
        except Exception as error:  # whatever a library of others meets in bytes of others
            raise InputError(f"{files[k]}: is no JPEG that can be tagged ({in_one_line(error)})") from None
    return len(chosen)


def _gps(lat: float, lon: float, depth: float, heading: float) -> dict[int, object]:
    import piexif

    below = 1 if depth > 0.0 else 0
    return {
        piexif.GPSIFD.GPSVersionID: (2, 3, 0, 0),
        piexif.GPSIFD.GPSLatitudeRef: "N" if lat >= 0.0 else "S",
        piexif.GPSIFD.GPSLatitude: _sexagesimal(abs(lat)),
        piexif.GPSIFD.GPSLongitudeRef: "E" if lon >= 0.0 else "W",
        piexif.GPSIFD.GPSLongitude: _sexagesimal(abs(lon)),
        piexif.GPSIFD.GPSAltitudeRef: below,
        piexif.GPSIFD.GPSAltitude: (round(1000.0 * abs(depth)), 1000),
        piexif.GPSIFD.GPSImgDirectionRef: "T",
        piexif.GPSIFD.GPSImgDirection: (round(100.0 * heading) % 36_000, 100),
        piexif.GPSIFD.GPSMapDatum: "WGS-84",
    }


def _sexagesimal(angle: float) -> tuple[tuple[int, int], ...]:
    """Degrees, minutes and seconds to a thousandth of a millimetre, as EXIF's fractions."""
    parts = round(angle * 3600.0 * 100_000)
    minutes, seconds = divmod(parts, 60 * 100_000)
    return (minutes // 60, 1), (minutes % 60, 1), (seconds, 100_000)
