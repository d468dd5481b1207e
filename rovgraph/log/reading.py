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
from rovgraph.model.config_sections import Environment
from rovgraph.model.origin import EarthOrigin, north_east, origin_in
from rovgraph.sensors import MOSTLY, SENSORS, Column, placeholders
from rovgraph.sensors.dvl_beam import BEAMS
from rovgraph.sensors.dvl_sound import CORRECTED, SoundCorrection, WaterState
from rovgraph.sensors.pressure import PRESSURE, complaints, depths
from rovgraph.sensors.water_layer import CELLS

LATE = 600.0  # what comes later than this was not late, the clock was set [s]
FARTHEST = 100e3  # of fixes from a stated origin: n is flat, and one that far is a mistake [m]
ACC_GAP = 0.5  # accelerations further apart are not interpolated [s]

Bools = NDArray[np.bool_]
Lines = NDArray[np.int64]


Origin = tuple[float, float] | None  # latitude and longitude [deg] of north = east = 0


def read_streams(
    tables: Iterable[Table], config: Config, source: str, notes: list[str] | None = None
) -> tuple[dict[str, Stream], Origin]:
    """The streams of a log, by the columns, units, delays, origin and magnetometer's calibration of a configuration.

    Parameters
    ----------
    tables : whose columns feed different streams
    source : their name, for messages
    notes : to be added to, how it was read

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
    origin = config.environment.origin
    found: dict[str, Stream] = {}
    names: dict[str, None] = {}
    for table in tables:
        names |= dict.fromkeys(table.names)
        streams, origin = _streams(table, config, origin)
        found |= streams
    if not found:
        raise InputError(f"{source}: no measurement of any sensor in it; {_found(list(names))}")
    _add_depth(found, config, origin, source, [] if notes is None else notes)
    found = {sensor: found[sensor] for sensor in (*STREAMS, "thruster") if sensor in found}
    if "mag" in found:
        found["mag"] = replace(found["mag"], data=config.imu.mag.calibrated(found["mag"].data))
    for sensor in found:
        if delay := delay_of(config, sensor):
            found[sensor] = replace(found[sensor], time=found[sensor].time - delay)
    return found | with_sound_speed(found, found, config), origin


def _add_depth(found: dict[str, Stream], config: Config, origin: Origin, source: str, notes: list[str]) -> None:
    """Turn pressures into depths, or leave them out beside depths.

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
    if config.depth.surface_hpa is None:
        factor = UNITS["pressure"].get(config.units.get("pressure", ""), 1.0)
        for text in complaints(pascal, factor, UNITS["pressure"], source):
            warn(text)
    below, said = depths(pressure.time, pascal, config, None if origin is None else origin[0])
    known = np.isfinite(below)
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


def _streams(table: Table, config: Config, origin: Origin) -> tuple[dict[str, Stream], Origin]:
    """The streams of one table as they stand in it, and the origin, which is its first fix where it was not known."""
    cells, _ = read_columns(table, config.table)
    cells = {name: values for name, values in cells.items() if not (_may_lack(name) and np.isnan(values).all())}
    cells, line = in_order(cells, table.line, table.source, RECEIVED in table.names)
    origin = _add_local_fixes(cells, line, table.source, origin, config.environment)
    streams = [_imu(cells, line, table.source)]
    streams += [_stream(sensor, cells, line, table.source) for sensor in STREAMS if sensor != "imu"]
    streams += [_thruster(cells, line, table.source)]
    return {s.sensor: _distinct_times(s, table.source) for s in streams if s is not None and len(s)}, origin


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
    return {name: cells[name] for name in names}, names


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


def _add_local_fixes(
    cells: dict[str, Array], line: Lines, source: str, origin: Origin, environment: Environment
) -> tuple[float, float] | None:
    """Turn latitude and longitude of fixes and of the ship into north and east.

    Returns
    -------
    origin : latitude and longitude [deg], as stated or of the first fix, else of the ship's first position; or None

    Raises
    ------
    InputError : no angles in degrees; further from a stated origin than a flat frame reaches
    """
    for of, what in (("fix", "fixes"), ("ship", "the ship's positions")):
        lat_lon, local = (f"{of}_lat", f"{of}_lon"), (f"{of}_north", f"{of}_east")
        if not all(name in cells for name in lat_lon):
            continue
        if all(name in cells for name in local):
            warn(f"{source}: {lat_lon[0]} and {lat_lon[1]} are ignored beside {local[0]} and {local[1]}")
            continue
        lat, lon = valid_positions(cells.pop(lat_lon[0]), cells.pop(lat_lon[1]), line, source, of)
        valid = np.flatnonzero(~np.isnan(lat) & ~np.isnan(lon))
        cells[local[0]], cells[local[1]] = lat * np.nan, lon * np.nan
        if not valid.size:
            continue
        origin = origin_in(environment.frame, float(lat[valid[0]]), float(lon[valid[0]])) if origin is None else origin
        north, east = north_east(lat[valid], lon[valid], origin)
        away = float(np.median(np.hypot(north, east)))
        if away > FARTHEST and not isinstance(origin, EarthOrigin):
            raise InputError(
                f"{source}: {what} lie {away / 1e3:.0f} km from environment.origin_lat_deg, origin_lon_deg = "
                f"{origin[0]:g}, {origin[1]:g}; correct them, remove these keys to use the first fix, "
                "or state environment.frame: earth"
            )
        cells[local[0]][valid], cells[local[1]][valid] = north, east
    return origin


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
        warn(
            f"{source}: {sensor}: {partly.sum()} rows partly empty and left out, expected "
            f"{', '.join(required)} together; first in line {line[np.argmax(partly)]}"
        )
    return data, complete


def _mend_columns(columns: Sequence[Column], data: Array, line: Lines, source: str) -> None:
    """Sds that are none become NaN.

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
