"""JSON lines with a log's columns as keys: one object per row, or per profile of the water.

The configuration's names and units for a log hold for them too, so that the rows of a log, written as JSON lines, give
the same measurements.
"""

import math

import numpy as np
import pandas as pd

from rovgraph.dates import seconds_of_texts
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.live.message import ON_EARTH, Message, Reading, readings
from rovgraph.live.sources.doppler import report_message
from rovgraph.live.sources.source import LineDecoder, Notify
from rovgraph.log.companions import CELL_PREFIX
from rovgraph.log.latitudes import is_placeholder
from rovgraph.log.reading import ACC_GAP
from rovgraph.log.streams import LAT_LON, OF_GRID, SHIP_LAT_LON, STREAMS, THRUSTER, is_column, label_number, labels
from rovgraph.log.units import Scale, near_miss, scales, turn_angles
from rovgraph.model.config import Config
from rovgraph.model.grids import lat_lon_of_grid
from rovgraph.readers.records import Refused, json_number, json_object, shown
from rovgraph.readers.waterlinked import is_report
from rovgraph.sensors import SENSORS
from rovgraph.sensors.water_layer import CELLS

ACC, GYR = STREAMS["imu"][:3], STREAMS["imu"][3:]
PROFILE = '[{"range": 4.0, "vx": 0.1, "vy": 0.0, "vz": 0.0}, ...]'
UNKNOWN = 20  # unknown keys that are counted separately

_AS_IT_IS = Scale()
_OTHERS = {name: of for of, columns in ON_EARTH.items() for name in columns[:2]} | {
    "dvl_valid": "dvl",
    "dvl_sd": "dvl",
    "place_sd": "place",
}


def json_lines(url: str, notify: Notify, config: Config) -> LineDecoder:
    """Decoder of JSON lines.

    Raises
    ------
    InputError : the configuration declares a unit that is unknown
    """
    return LineDecoder(JsonRow(url, notify, config).message, notify)


class JsonRow:
    """From a line to a message; what is wrong with a line leaves the lines after it alone.

    Parameters
    ----------
    url : of the source
    notify : takes warnings
    config : for columns and units

    Raises
    ------
    InputError : the configuration declares a unit that is unknown
    """

    def __init__(self, url: str, notify: Notify, config: Config) -> None:
        self._url = url
        self._notify = notify
        self._names = {theirs: ours for ours, theirs in config.columns.items()}
        self._scale = scales(config.units, url)
        self._angles, self._rules, self._grid = config.angles, config.times.rules, config.environment.grid
        turn_angles({}, config.angles, url)  # an unknown one is reported before the first line
        self._labels = labels()
        self._unknown: set[str] = set()
        self._sensors = {c: sensor.name for sensor in SENSORS.values() for c in sensor.required} | _OTHERS
        self._acc: tuple[Array, float | None, float] | None = None  # the last one, its stamp and arrival

    def message(self, line: bytes, arrival: float) -> Message | None:
        """The readings of a line; None without a measurement.

        Raises
        ------
        Refused : the line is to be skipped
        """
        row = json_object(line)
        if is_report(row):  # of a Water Linked DVL, passed on as it came
            report = report_message(row, self._url, arrival, self._notify)
            return None if report is None else report._replace(clock="DVL")  # not that of the other lines
        profile = self._profile(row.pop(CELLS, ()))
        cells = self._cells(row)
        stamp = cells.pop("time", None)
        _check(cells)
        alone = self._join(cells, stamp, arrival)
        found = readings(cells) + profile
        lost = {sensor for name in cells if (sensor := self._sensor(name))} - {r.sensor for r in found} - alone
        if lost:
            self._notify("incomplete", f"{', '.join(sorted(lost))}: not all of its columns are in the line")
        return Message(self._url, arrival, stamp, found) if found else None

    def _profile(self, given: object) -> tuple[Reading, ...]:
        """The cells of a profile, each an object with the columns of its table.

        Raises
        ------
        Refused : something else
        """
        if not isinstance(given, list | tuple) or not all(isinstance(cell, dict) for cell in given):
            raise Refused("no profile", f"{CELLS}: expected a list of cells, as {PROFILE}; the line is skipped")
        rows = ({CELL_PREFIX + str(name): value for name, value in cell.items()} for cell in given)
        return tuple(reading for row in rows for reading in readings(self._cells(row)))

    def _cells(self, row: dict[str, object]) -> dict[str, float]:
        """Columns of a row that are known and filled, in SI."""
        cells = {}
        for key, value in row.items():
            name = self._names.get(key, key)
            if not is_column(name):
                self._report(key)
            elif value is None:
                continue
            elif name == "time" and isinstance(value, str):
                cells[name] = self._seconds(value)
            elif name in self._labels and (isinstance(value, str) or json_number(key, value) % 1.0):
                cells[name] = label_number(str(value))  # 7.5 is a name, as it is in a log
            else:
                cells[name] = self._scale.get(name, _AS_IT_IS)(json_number(key, value))
                if not math.isfinite(cells[name]):  # a placeholder
                    del cells[name]
        turn_angles(cells, self._angles, self._url)
        for lat_lon, of_grid in OF_GRID.items():
            if {*of_grid} <= cells.keys():
                cells |= dict(zip(lat_lon, self._on_ellipsoid(*(cells.pop(name) for name in of_grid)), strict=True))
        return cells

    def _on_ellipsoid(self, northing: float, easting: float) -> tuple[float, float]:
        """Latitude and longitude [deg] of a place of the map grid.

        Raises
        ------
        Refused : the grid is not stated, or has no such place
        """
        if self._grid is None:
            raise Refused("no grid", "a place of a map grid is left out; state environment.grid, such as EPSG:32632")
        try:
            lat, lon = lat_lon_of_grid(self._grid, np.array([easting]), np.array([northing]))
        except InputError as error:
            raise Refused("no grid", f"{error}; the line is skipped") from None
        return float(lat[0]), float(lon[0])

    def _seconds(self, text: str) -> float:
        """Unix time of a date.

        Raises
        ------
        Refused : not a time, or it may be of two days
        """
        try:
            time, how = seconds_of_texts(pd.Series([text]), self._rules, lambda _: "time")
        except InputError as error:
            raise Refused("no time", f"{error}; the line is skipped") from None
        self._notify("dates", f"time is read as {how}", once=True)
        return float(time[0])

    def _report(self, key: str) -> None:
        if key in self._unknown or len(self._unknown) < UNKNOWN:
            self._unknown.add(key)
            meant = near_miss(key, ())
            hint = f"; if it is {meant}, rename it or map it under columns" if meant else ""
            self._notify(f"unknown key {shown(key)}", f"the key {shown(key)} is ignored{hint}", once=True)
        else:
            self._notify("unknown key", "more keys are ignored", once=True)

    def _sensor(self, column: str) -> str | None:
        """The sensor of a column that means nothing without others."""
        return "thruster" if THRUSTER.fullmatch(column) else self._sensors.get(column)

    def _join(self, cells: dict[str, float], stamp: float | None, arrival: float) -> set[str]:
        """Give a rate the acceleration that came before it, where they come on separate lines.

        Returns
        -------
        {"imu"} where half a sample stays alone, else nothing
        """
        with_acc, with_gyr = (all(name in cells for name in names) for names in (ACC, GYR))
        if with_acc:
            self._acc = np.array([cells[name] for name in ACC]), stamp, arrival
            return set() if with_gyr else {"imu"} - {self._sensors[n] for n in GYR if n in cells}
        if with_gyr and not any(name in cells for name in ACC):
            if self._acc is None or _age(self._acc[1:], stamp, arrival) > ACC_GAP:
                self._notify("no acceleration", f"a rate without an acceleration of the last {ACC_GAP:g} s is left out")
                return {"imu"}
            cells.update(zip(ACC, self._acc[0].tolist(), strict=True))
        return set()


def _age(before: tuple[float | None, float], stamp: float | None, arrival: float) -> float:
    """Time since an earlier line, by the stamps where both have one [s]."""
    earlier, came = before
    return abs(stamp - earlier) if stamp is not None and earlier is not None else abs(arrival - came)


def _check(cells: dict[str, float]) -> None:
    """Raise `Refused` for values that are finite and cannot be."""
    if cells.get("dvl_valid", 1.0) not in (0.0, 1.0):
        raise Refused("out of range", f"dvl_valid: {cells['dvl_valid']:g}, expected 0 or 1; the line is skipped")
    for name in ("dvl_sd", "fix_sd", "fix_east_sd", "ship_sd", "place_sd"):
        if cells.get(name, 1.0) <= 0.0:  # as many instruments mark a missing estimate
            del cells[name]
    for names in (LAT_LON, SHIP_LAT_LON):
        lat, lon = (cells.get(name, 0.0) for name in names)
        beyond = abs(lat) > 90.0 or abs(lon) > 360.0
        if beyond and is_placeholder(np.array([lat, lon])).any():  # of a receiver without a fix
            cells |= dict.fromkeys(names, 0.0)
            lat = lon = 0.0
        if abs(lat) > 90.0 or abs(lon) > 360.0:
            raise Refused("out of range", f"latitude {lat:g}, longitude {lon:g}, expected degrees; the line is skipped")
        if all(cells.get(name) == 0.0 for name in names):  # a receiver without a fix
            for name in names:
                del cells[name]
