"""From a file to streams: names, units, the order of time, one stream per sensor.

A repaired fault is reported in a `DataWarning`; a fault that cannot be repaired is an `InputError`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rovgraph import compatibility
from rovgraph.errors import InputError, warn
from rovgraph.geometry import Array
from rovgraph.log.latitudes import valid_positions
from rovgraph.log.stamps import STEP_BACK, mend, require_moving
from rovgraph.log.streams import (
    DATE,
    LAT_LON,
    OF_GRID,
    RECEIVED,
    SHIP_LAT_LON,
    SPACING_S,
    STREAMS,
    THRUSTER,
    VERSION_COLUMN,
    Stream,
    all_columns,
    is_column,
    is_optional,
    joined,
    label_number,
    labels,
)
from rovgraph.log.tables import Table
from rovgraph.log.units import (
    UNITS,
    known_unit,
    name_and_bracket,
    near_miss,
    nearest,
    quantities,
    scales,
    turn_angles,
)
from rovgraph.model.config import Config, TableSettings
from rovgraph.model.grids import lat_lon_of_grid
from rovgraph.model.origin import EarthOrigin, Origin, north_east, origin_in
from rovgraph.sensors import MOSTLY, SENSORS, Column, placeholders
from rovgraph.sensors.dvl_beam import BEAMS
from rovgraph.sensors.dvl_sound import CORRECTED, SoundCorrection, WaterState
from rovgraph.sensors.pressure import PRESSURE, complaints, depths
from rovgraph.sensors.water_layer import CELLS

LATE = 600.0  # what comes later than this was not late, the clock was set [s]
FARTHEST = {"flat": 100e3, "auto": 1000e3, "earth": np.inf}  # of fixes from an origin: that far it is a mistake [m]
GRID_NORTHING, GRID_EASTING = 1e5, 5e4  # no dive is that far from its origin both ways [m]
ACC_GAP = 0.5  # accelerations further apart are not interpolated [s]

Bools = NDArray[np.bool_]
Lines = NDArray[np.int64]


def read_streams(
    tables: Iterable[Table],
    config: Config,
    source: str,
    notes: list[str] | None = None,
    as_received: bool = False,
) -> tuple[dict[str, Stream], Origin | None]:
    """The streams of a log, by the columns, units, delays, origin and magnetometer's calibration of a configuration.

    Parameters
    ----------
    tables : whose columns feed different streams
    source : their name, for messages
    notes : to be added to, how it was read
    as_received : pressures are not turned into depths, and fixes of all beacons stay where none is stated

    Returns
    -------
    streams : sensor -> Stream, only those that the tables have
    origin : latitude and longitude [deg] of north = east = 0, or None

    Raises
    ------
    InputError : a table that cannot be worked with

    Warns
    -----
    DataWarning : what was left out or sorted
    """
    found: dict[str, Stream] = {}
    names: dict[str, None] = {}
    parts = [(table, *_cells(table, config)) for table in tables]
    for table, cells, line in parts:
        names |= dict.fromkeys(table.names)
        _check_positions(cells, line, table.source)
    _leave_out_other_beacons(parts, config, source, not as_received)
    origin = _origin(config, [cells for _, cells, _ in parts], source)
    for table, cells, line in parts:
        found |= _streams(table, cells, line, origin)
    if not found:
        raise InputError(f"{source}: no measurement of any sensor in it; {_found(list(names))}")
    if not as_received:
        _add_depth(found, config, origin, source, [] if notes is None else notes, names)
    found = {sensor: found[sensor] for sensor in (*STREAMS, "thruster") if sensor in found}
    if "mag" in found:
        found["mag"] = replace(found["mag"], data=config.imu.mag.calibrated(found["mag"].data))
    for sensor in found:
        if delay := delay_of(config, sensor):
            found[sensor] = replace(found[sensor], time=found[sensor].time - delay)
    return found | with_sound_speed(found, found, config), origin


def _add_depth(
    found: dict[str, Stream], config: Config, origin: Origin | None, source: str, notes: list[str], names: Iterable[str]
) -> None:
    """Turn pressures into depths, or leave them out beside depths; one of the names of columns may state their unit.

    Raises
    ------
    InputError : they are no absolute pressures
    """
    pressure = found.pop("pressure", None)
    if pressure is None:
        return
    if "depth" in found and config.depth.source == "depth":
        warn(f"{source}: pressure is ignored beside depth; depth.source: pressure uses it instead")
        return
    if found.pop("depth", None) is not None:
        warn(f"{source}: depth is ignored beside pressure; depth.source: depth uses it instead")
    pascal = pressure["pressure"]
    below, said = depths(pressure.time, pascal, config, None if origin is None else origin[0])
    known = np.isfinite(below)
    if config.depth.surface_hpa is None or not known.any():
        written = next((name for name in names if name_and_bracket(name)[0] == PRESSURE.name), PRESSURE.name)
        unit = config.units.get(PRESSURE.name) or _units_of_header({PRESSURE.name: written}).get(PRESSURE.name, "Pa")
        factor = UNITS["pressure"][unit]
        for text in complaints(pascal, factor, UNITS["pressure"], source):
            warn(text)
    if not known.all():
        warn(f"{source}: pressure: {(~known).sum()} are less than any air's, left out")
    notes.append(said)
    if known.any():
        depth = replace(pressure, sensor="depth", columns=STREAMS["depth"], data=below[:, None])
        found["depth"] = depth.take(known)


def with_sound_speed(of_dvl: Mapping[str, Stream], streams: Mapping[str, Stream], config: Config) -> dict[str, Stream]:
    """Streams of a DVL, made as if it had known the speed of sound.

    Parameters
    ----------
    of_dvl : those that may be of a DVL
    streams : of the whole log, with depths and temperatures
    """
    correction = SoundCorrection(config)
    if not correction.applies:
        return {}

    out = {}
    for sensor in CORRECTED:
        if (stream := of_dvl.get(sensor)) is not None:
            data = correction.applied(sensor, stream.data, water_at(stream.time, streams))
            out[sensor] = replace(stream, data=data)
    return out


def water_at(time: Array, streams: Mapping[str, Stream]) -> WaterState:
    """What a log has newest of the water at some times, shape (n,), or at first."""

    def newest(sensor: str, column: str) -> Array:
        stream = streams.get(sensor)
        known = np.zeros(0, int) if stream is None else np.flatnonzero(np.isfinite(stream[column]))
        if stream is None or not len(known):
            return np.full(len(time), np.nan)
        at = np.searchsorted(stream.time[known], time, side="right") - 1
        return np.asarray(stream[column][known[np.maximum(at, 0)]])

    return WaterState(
        newest("dvl_sound", "dvl_sound_speed"), newest("dvl_sound", "water_temperature"), newest("depth", "depth")
    )


def delay_of(config: Config, sensor: str) -> float:
    """How much older a sensor's measurements are than their stamps [s]; beams and profiles of a DVL as it is."""
    delays: Mapping[str, float] = config.delay_s
    if sensor == PRESSURE.name:
        return delays.get("depth", 0.0)
    return delays.get(sensor, delays.get("dvl", 0.0) if sensor in (BEAMS, CELLS) else 0.0)


def _cells(table: Table, config: Config) -> tuple[dict[str, Array], Lines]:
    """The columns of one table that are no empty ones, in the order of time, and their lines."""
    cells, _ = read_columns(table, config.table)
    cells = {name: values for name, values in cells.items() if not (_may_lack(name) and np.isnan(values).all())}
    return in_order(cells, table.line, table.source, RECEIVED in table.names)


def _streams(table: Table, cells: dict[str, Array], line: Lines, origin: Origin | None) -> dict[str, Stream]:
    """The streams of one table as they stand in it."""
    _add_local_fixes(cells, origin)
    streams = [_imu(cells, line, table.source)]
    streams += [_stream(sensor, cells, line, table.source) for sensor in STREAMS if sensor != "imu"]
    streams += [_thruster(cells, line, table.source)]
    return {s.sensor: _distinct_times(s, table.source) for s in streams if s is not None and len(s)}


def read_columns(table: Table, settings: TableSettings) -> tuple[dict[str, Array], dict[str, str]]:
    """The columns of a table that a log has, in SI and radians, and their names in the table.

    Returns
    -------
    cells : rovgraph's name -> ndarray, shape (n,)
    names : rovgraph's name -> the table's

    Raises
    ------
    InputError : a newer version; a column or unit that is unknown, a cell that is no number, no time

    Warns
    -----
    DataWarning : infinities; how the table was read, where it is not written as a log of this program
    """
    if VERSION_COLUMN in table.names and len(table.frame):
        version = float(np.nanmax(table.numbers(VERSION_COLUMN), initial=1.0))
        compatibility.refuse_newer(version, compatibility.LOG, f"{table.source}: log")
    names = map_columns(table, settings.columns)
    scale = scales(settings.units, table.source)
    stated = _units_of_header({name: written for name, written in names.items() if name not in scale})
    scale |= scales(stated, table.source)
    day = names.pop(DATE, None)
    times, how = table.times(names["time"], settings.times.rules, day, in_seconds="time" in scale)
    if how:  # of dates, which have no unit
        scale.pop("time", None)
    table.warn_how(how, f"units by the header ({', '.join(dict.fromkeys(stated.values()))})" if stated else "")
    cells = {"time": _finite(table, "time", times)}
    cells |= {name: numbers(table, name, source) for name, source in names.items() if name != "time"}
    for name in scale.keys() & cells.keys():
        cells[name] = scale[name](cells[name])
    turn_angles(cells, settings.angles, table.source)
    cells = {name: cells[name] for name in names}
    for lat_lon, of_grid in OF_GRID.items():
        _on_ellipsoid(cells, names, lat_lon, of_grid, settings.grid, table.source)
    return cells, names


def _on_ellipsoid(
    cells: dict[str, Array],
    names: dict[str, str],
    lat_lon: tuple[str, str],
    of_grid: tuple[str, str],
    grid: str | None,
    source: str,
) -> None:
    """Put northing and easting of a map grid in place of latitude and longitude, in cells and names.

    Raises
    ------
    InputError : the grid is not stated, or has no such places

    Warns
    -----
    DataWarning : north and east are as large as a grid's; latitude and longitude stand beside a grid's places
    """
    local = [name.replace("ing", "") for name in of_grid]
    if all(name in cells and np.isfinite(cells[name]).any() for name in local):
        north, east = (float(np.nanmedian(np.abs(cells[name]))) for name in local)
        if north > GRID_NORTHING and east > GRID_EASTING:
            warn(
                f"{source}: {local[0]} {north:.0f}, {local[1]} {east:.0f} are places of a map grid, whose north is "
                f"not true north: name them {of_grid[0]} and {of_grid[1]}, and state environment.grid, as EPSG:32632"
            )
    if not {*of_grid} <= cells.keys():
        return
    if grid is None:
        raise InputError(
            f"{source}: {of_grid[0]} and {of_grid[1]} are of a map grid, which is not stated; state environment.grid, "
            "such as EPSG:32632 for UTM zone 32 north"
        )
    northing, easting = (cells.pop(name) for name in of_grid)
    written = [names.pop(name) for name in of_grid]
    if {*lat_lon} & cells.keys():
        warn(f"{source}: {of_grid[0]} and {of_grid[1]} are ignored beside {' and '.join(lat_lon)}")
        return
    for name, values, column in zip(lat_lon, lat_lon_of_grid(grid, easting, northing), written, strict=True):
        cells[name], names[name] = values, column


def _units_of_header(names: Mapping[str, str]) -> dict[str, str]:
    """Column of a log -> unit that its name in the file states."""
    kinds = quantities()
    brackets = {name: name_and_bracket(written)[1] for name, written in names.items() if name in kinds}
    units = {name: known_unit(kinds[name], bracket) for name, bracket in brackets.items() if bracket}
    return {name: unit for name, unit in units.items() if unit is not None}


def _found(names: Sequence[str]) -> str:
    shown = ", ".join(names[:12]) + (f", ... ({len(names)} in all)" if len(names) > 12 else "")
    return f"columns found: {shown[:200] or 'none'}"


def map_columns(table: Table, columns: Mapping[str, str]) -> dict[str, str]:
    """rovgraph's name of each column in use -> its name in the file.

    Raises
    ------
    InputError : unknown target, missing source, no time
    """
    for target, source in columns.items():
        if not is_column(target) and target != DATE:
            raise InputError(
                f"{table.source}: columns: {target} is unknown, nearest is {nearest(target, all_columns())}"
            )
        if source not in table.names:
            near = nearest(source, table.names)
            raise InputError(f"{table.source}: columns: {target}: the log has no {source!r}, nearest is {near!r}")
    names = {plain: name for name in table.names for plain, unit in [name_and_bracket(name)] if _is_known(plain, unit)}
    names |= {name: name for name in table.names if is_column(name) or name == DATE} | dict(columns)
    if "time" not in names:
        near = nearest("time", table.names)
        raise InputError(
            f"{table.source}: line 1: no column time; {_found(table.names)}; "
            f"rename one or map it, as in columns: {{time: {near!r}}}; "
            f"rovgraph convert {table.source} --guess proposes a mapping"
        )
    taken = {*names, *names.values()}
    for name in table.names:
        plain, unit = name_and_bracket(name)
        if unit and name not in taken and plain in quantities() and plain not in names:
            known = ", ".join(UNITS[quantities()[plain]])
            raise InputError(
                f"{table.source}: line 1: column {name!r} is in the unknown unit {unit!r}, expected one of {known}; "
                f"convert it, or rename it to {plain} if the unit is wrong"
            )
        meant = None if name in taken else near_miss(name, names)
        if meant:
            warn(f"{table.source}: column {name!r} is ignored; if it is {meant}, rename it or map it under columns")
    return names


def _is_known(name: str, unit: str) -> bool:
    """Whether a column that states a unit in brackets is one of a log, in a unit that is known."""
    return name in quantities() and known_unit(quantities()[name], unit) is not None


def numbers(table: Table, name: str, source: str) -> Array:
    """A column with infinities taken as missing, shape (n,)."""
    return _finite(table, name, _labels(table, source) if name in labels() else table.numbers(source))


def _labels(table: Table, name: str) -> Array:
    """A column of names as the numbers that stand for them, shape (n,); NaN = empty cell."""
    cells = table.frame[name]
    filled = cells.notna() & (cells.astype(str).str.strip() != "")
    out = np.full(len(cells), np.nan)
    out[filled] = [label_number(str(cell)) for cell in cells[filled]]
    return out


def _finite(table: Table, name: str, values: Array) -> Array:
    infinite = np.flatnonzero(np.isinf(values))
    if infinite.size:
        warn(
            f"{table.source}: column {name}: {infinite.size} infinite, taken as missing; "
            f"first in line {table.line[infinite[0]]}"
        )
        values = np.where(np.isinf(values), np.nan, values)
    return values


def _may_lack(name: str) -> bool:
    """Whether a column that stands empty is as good as none: a thruster, one of the two ways to give a fix."""
    places = *LAT_LON, *SHIP_LAT_LON, "fix_north", "fix_east", "ship_north", "ship_east"
    return name in places or THRUSTER.fullmatch(name) is not None


def in_order(cells: dict[str, Array], line: Lines, source: str, by_arrival: bool) -> tuple[dict[str, Array], Lines]:
    """Rows in the order of time, those without a time left out.

    Parameters
    ----------
    by_arrival : rows stand as they arrived, so that being late is no fault

    Raises
    ------
    InputError : stamps of another time than the others, or that stand still; no row has a time
    """
    timeless = np.isnan(cells["time"])
    if timeless.any():
        if timeless.all():
            raise InputError(f"{source}: column time is empty, expected seconds in every row")
        warn(f"{source}: {timeless.sum()} rows without time left out, first in line {line[np.argmax(timeless)]}")
        cells, line = {name: values[~timeless] for name, values in cells.items()}, line[~timeless]
    time, rows = cells["time"], np.arange(len(line))
    if "adcp_range" in cells:  # the cells of a profile are of one time
        rows = np.flatnonzero(np.diff(time, prepend=np.nan) != 0.0)
    time, said = mend(time[rows], source, line[rows], LATE if by_arrival else STEP_BACK)
    time = np.repeat(time, np.diff(rows, append=len(line)))
    for text in said:
        warn(text)
    if not (usable := np.isfinite(time)).all():
        cells, line, time = {name: values[usable] for name, values in cells.items()}, line[usable], time[usable]
    cells = {**cells, "time": time}
    late = np.flatnonzero(time < np.maximum.accumulate(time))
    if not late.size:
        return cells, line
    if not by_arrival:
        warn(f"{source}: {late.size} rows are earlier than a row above them, sorted; first in line {line[late[0]]}")
    order = np.argsort(time, kind="stable")
    return {name: values[order] for name, values in cells.items()}, line[order]


VELOCITY = {"dvl_vx", "dvl_vy", "dvl_vz"}
FASTEST = 10.0  # of any vehicle below water [m/s]
PLACES = "fix", "ship"  # that may come in latitude and longitude


def _check_positions(cells: dict[str, Array], line: Lines, source: str) -> None:
    """Leave out invalid latitudes and longitudes, and those beside which there are north and east.

    Raises
    ------
    InputError : no angles in degrees
    """
    for of in PLACES:
        lat_lon, local = (f"{of}_lat", f"{of}_lon"), (f"{of}_north", f"{of}_east")
        if not all(name in cells for name in lat_lon):
            continue
        if all(name in cells for name in local):
            warn(f"{source}: {lat_lon[0]} and {lat_lon[1]} are ignored beside {local[0]} and {local[1]}")
            del cells[lat_lon[0]], cells[lat_lon[1]]
            continue
        lat, lon = valid_positions(cells[lat_lon[0]], cells[lat_lon[1]], line, source, of)
        known = ~np.isnan(lat) & ~np.isnan(lon)
        cells[lat_lon[0]], cells[lat_lon[1]] = np.where(known, lat, np.nan), np.where(known, lon, np.nan)


BEACON = "fix_beacon"
OF_FIX = tuple(name for name in (*LAT_LON, *STREAMS["fix"]) if name != BEACON)


def _leave_out_other_beacons(
    parts: Sequence[tuple[Table, dict[str, Array], Lines]], config: Config, source: str, refuses: bool
) -> None:
    """Leave out fixes of other beacons than the vehicle's; a fix without a name is the vehicle's.

    Raises
    ------
    InputError : ``refuses``, and it is not known which beacon is the vehicle's, or it has no fix
    """
    seen: dict[float, str] = {}
    for table, cells, _ in parts:
        if BEACON in cells:
            there = np.isfinite([cells[name] for name in OF_FIX if name in cells]).any(axis=0)
            written = table.frame[map_columns(table, config.columns)[BEACON]].dropna().unique()
            texts = {label_number(str(text)): str(text).strip().removesuffix(".0") for text in written}
            known = np.unique(cells[BEACON][there & ~np.isnan(cells[BEACON])])
            seen |= {number: texts[number] for number in known.tolist()}
    stated, names = config.positioned_beacon, sorted(seen.values())
    if not seen or (stated is None and (len(seen) == 1 or not refuses)):
        return
    if refuses and (stated is None or label_number(stated) not in seen):
        why = "" if stated is None else f", and none of {stated}, which is stated"
        raise InputError(
            f"{source}: its fixes are of beacon{'s' * (len(names) > 1)} {', '.join(names[:6])}{why}; state which is "
            f"the vehicle's, as fix_beacon has it: fix: {{beacon: {names[0]}}}"
        )
    for _, cells, _ in parts:
        if BEACON in cells:
            other = ~np.isnan(cells[BEACON]) & (cells[BEACON] != label_number(str(stated)))
            for name in OF_FIX:
                if name in cells:
                    cells[name] = np.where(other, np.nan, cells[name])


def _origin(config: Config, parts: Sequence[dict[str, Array]], source: str) -> Origin | None:
    """The origin as stated or of the first fix, else of the ship's first position, in the frame of the dive.

    Raises
    ------
    InputError : positions are further from it than its frame reaches
    """
    names = [(f"{of}_lat", f"{of}_lon") for of in PLACES]
    seen = [np.column_stack([cells[n] for n in pair]) for pair in names for cells in parts if {*pair} <= {*cells}]
    places, stated = np.vstack([np.empty((0, 2)), *seen]), config.environment.origin
    places = places[~np.isnan(places[:, 0])]
    if stated is None and not len(places):
        return None
    lat, lon = places[0].tolist() if stated is None else stated
    north, east = north_east(places[:, 0], places[:, 1], EarthOrigin(lat, lon))
    away = float(np.median(np.hypot(north, east))) if len(places) else 0.0
    way = 0.0
    for cells in parts:
        if {*cells} >= VELOCITY and "fix_north" not in cells:  # which is of a plane
            way = max(way, length_of_way(cells["time"], np.column_stack([cells[name] for name in sorted(VELOCITY)])))
    frame = config.frame_at(lat, away, way)
    if away > FARTHEST["flat" if frame == "flat" else config.environment.frame]:
        raise InputError(
            f"{source}: fixes lie {away / 1e3:.0f} km from environment.origin_lat_deg, origin_lon_deg = {lat:g}, "
            f"{lon:g}; correct them, remove these keys to use the first fix, or state environment.frame: earth"
        )
    return origin_in(frame, lat, lon)


def length_of_way(time: Array, velocity: Array) -> float:
    """How far a DVL has gone at its mean speed [m], shapes (n,), (n, 3); NaN = no bottom lock, and as fast as between.

    >>> length_of_way(np.arange(101.0), np.tile([2.0, 0.0, 0.0], (101, 1)))
    200.0
    """
    speed = np.linalg.norm(velocity, axis=1)
    known = speed < FASTEST
    return float(np.mean(speed[known]) * np.ptp(time[known])) if known.any() else 0.0


def _add_local_fixes(cells: dict[str, Array], origin: Origin | None) -> None:
    """Turn latitude and longitude of fixes and of the ship into north and east."""
    for of in PLACES:
        if origin is not None and {f"{of}_lat", f"{of}_lon"} <= {*cells}:
            lat_lon = cells.pop(f"{of}_lat"), cells.pop(f"{of}_lon")
            cells[f"{of}_north"], cells[f"{of}_east"] = north_east(*lat_lon, origin)


def _select(
    sensor: str, columns: Sequence[str], cells: dict[str, Array], line: Lines, source: str
) -> tuple[Array, Bools] | None:
    """Columns of a sensor and the rows in which all that are required are filled.

    Returns
    -------
    data : ndarray, shape (n, k)
    complete : ndarray of bool, shape (n,)
    """
    required = [c for c in columns if not is_optional(c)]
    absent = [c for c in required if c not in cells]
    if not any(c in cells for c in columns):
        return None
    if absent:
        if len(absent) < len(required):
            present = [c for c in required if c in cells]
            warn(f"{source}: {sensor} is left out: the log has {', '.join(present)} and no {', '.join(absent)}")
        return None
    data = np.column_stack([cells.get(c, np.full(len(line), np.nan)) for c in columns])
    filled = ~np.isnan(data[:, [columns.index(c) for c in required]])
    complete, partly = filled.all(axis=1), filled.any(axis=1)
    _mend_columns(SENSORS[sensor].columns if sensor in SENSORS else (), data, line, source)
    if sensor == "dvl":
        complete, partly = _pings(data, complete, partly)
    if sensor in SENSORS and (several := SENSORS[sensor].complete) is not None:
        complete, partly = several(data), ~np.isnan(data).all(axis=1)
    if sensor == "place":
        partly = partly | ~np.isnan(data[:, 1])  # an sd that belongs to no place
    partly &= ~complete
    if partly.any():
        expected = f"{', '.join(required)} together" if required else SENSORS[sensor].together
        first = line[np.argmax(partly)]
        left = f"{partly.sum()} rows partly empty and left out"
        warn(f"{source}: {sensor}: {left}, expected {expected}; first in line {first}")
    return data, complete


def _mend_columns(columns: Sequence[Column], data: Array, line: Lines, source: str) -> None:
    """Invalid sds become NaN.

    Raises
    ------
    InputError : a flag that is neither 0 nor 1
    """
    for column, values in zip(columns, data.T, strict=False):
        odd = np.flatnonzero(~np.isnan(values) & (values != 0.0) & (values != 1.0))
        if column.flag and odd.size:
            raise InputError(
                f"{source}: line {line[odd[0]]}, column {column.name}: {values[odd[0]]:g}, expected 0 or 1"
            )
        if column.is_sd:
            _known_sd(column, values, line, source)


def _pings(data: Array, complete: Bools, partly: Bools) -> tuple[Bools, Bools]:
    """Rows that are pings, and rows with anything of a ping; validity becomes 0 or 1.

    A ping without bottom lock needs no velocities.
    """
    valid = data[:, 3]
    lost = valid == 0.0
    partly = partly | (valid == 1.0)
    valid[np.isnan(valid)] = 1.0
    return complete | lost, partly


def _known_sd(column: Column, sd: Array, line: Lines, source: str) -> None:
    """An sd of 0, -1, 9999 and the like, which many instruments write without an estimate, becomes NaN.

    Placeholders among better sds stay: such a measurement is worth little.
    """
    held = placeholders(column, sd)
    usual = bool(held.sum() > MOSTLY * (sd > 0.0).sum())
    for unknown, what in ((sd <= 0.0, "0 or less"), (held & usual, "no sd that such an instrument has")):
        if unknown.any():
            warn(
                f"{source}: {column.name}: {unknown.sum()} times {what}, taken as unknown; "
                f"the configuration's sd is used; first in line {line[np.argmax(unknown)]}"
            )
            sd[unknown] = np.nan


def _stream(sensor: str, cells: dict[str, Array], line: Lines, source: str) -> Stream | None:
    """The stream of any sensor but the IMU and the thrusters."""
    columns = STREAMS[sensor]
    selected = _select(sensor, columns, cells, line, source)
    if selected is None:
        return None
    data, rows = selected
    return Stream(sensor, columns, cells["time"][rows], data[rows], line[rows])


def _thruster(cells: dict[str, Array], line: Lines, source: str) -> Stream | None:
    """Drive signals, as many columns as the log has."""
    columns = tuple(sorted((c for c in cells if THRUSTER.fullmatch(c)), key=lambda c: int(c.split("_")[1])))
    selected = _select("thruster", columns, cells, line, source) if columns else None
    if selected is None:
        return None
    data, rows = selected
    return Stream("thruster", columns, cells["time"][rows], data[rows], line[rows])


def _imu(cells: dict[str, Array], line: Lines, source: str) -> Stream | None:
    """Samples at the gyro's times; where acceleration is on other rows, it is interpolated."""
    columns, time = STREAMS["imu"], cells["time"]
    present = [c for c in columns if c in cells]
    if len(present) < 6:
        if present:
            absent = [c for c in columns if c not in cells]
            warn(f"{source}: imu is left out: the log has {', '.join(present)} and no {', '.join(absent)}")
        return None
    acc_gyr = (_select(name, part, cells, line, source) for name, part in (("acc", columns[:3]), ("gyr", columns[3:])))
    (acc, with_acc), (gyr, with_gyr) = (part for part in acc_gyr if part is not None)
    rows = np.flatnonzero(with_gyr)
    data = np.empty((len(rows), 6))
    data[:, :3], data[:, 3:] = acc[rows], gyr[rows]
    alone = ~with_acc[rows]
    if alone.any() and with_acc.any():
        data[alone, :3], near = _interpolated(time[rows[alone]], time[with_acc], acc[with_acc])
        lost = np.flatnonzero(alone)[~near]
    else:
        lost = np.flatnonzero(alone)
    if lost.size:
        warn(
            f"{source}: imu: {lost.size} rows with a rate and no acceleration near, left out; "
            f"first in line {line[rows[lost[0]]]}"
        )
        rows, data = np.delete(rows, lost), np.delete(data, lost, axis=0)
    return Stream("imu", columns, time[rows], data, line[rows])


def _interpolated(at: Array, time: Array, values: Array) -> tuple[Array, Bools]:
    """Linear interpolation, and whether there are values on both sides, close together.

    Parameters
    ----------
    at : ndarray, shape (m,)
    time, values : ndarray, shape (n,), (n, k)

    Returns
    -------
    ndarray, shape (m, k); ndarray of bool, shape (m,)
    """
    out = np.column_stack([np.interp(at, time, column) for column in values.T])
    after = np.searchsorted(time, at, side="left").clip(0, len(time) - 1)
    before = (np.searchsorted(time, at, side="right") - 1).clip(0, len(time) - 1)
    inside = (time[before] <= at) & (at <= time[after])
    return out, inside & (time[after] - time[before] <= ACC_GAP)


def _distinct_times(stream: Stream, source: str) -> Stream:
    """A stream with one measurement at a time, the first; those within `SPACING_S` are of one time.

    What is measured of several beacons or places at a time is kept, and all cells of a profile of the water.
    """
    if stream.sensor == CELLS:
        return stream
    names = [stream.columns.index(name) for name in stream.columns if name in labels()]
    if names:
        of = np.unique(np.nan_to_num(stream.data[:, names], nan=-1.0), axis=0, return_inverse=True)[1].ravel()
        if of.any():
            return joined([_distinct(stream.take(of == k), source) for k in range(of.max() + 1)])
    return _distinct(stream, source)


def _distinct(stream: Stream, source: str) -> Stream:
    """The same of one beacon or place."""
    require_moving(stream.time, f"{source}: {stream.sensor}")
    close = np.flatnonzero(np.diff(stream.time) < SPACING_S) + 1
    if not len(close):
        return stream
    again, kept = np.zeros(len(stream), bool), -np.inf
    for k in close.tolist():
        kept = kept if again[k - 1] else stream.time[k - 1]
        again[k] = stream.time[k] - kept < SPACING_S
    first = np.flatnonzero(~again)[np.cumsum(~again) - 1]
    same = again & ((stream.data == stream.data[first]) | (np.isnan(stream.data) & np.isnan(stream.data[first]))).all(1)
    for which, what in ((same, "repeated exactly, left out"), (again & ~same, "at the time of another, first kept")):
        if which.any():
            line = stream.row[np.argmax(which)]
            warn(f"{source}: {stream.sensor}: {which.sum()} measurements {what}; first in line {line}")
    return replace(stream.take(~again), same_time=int(np.count_nonzero(again & ~same)))
