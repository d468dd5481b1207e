"""From readings to measurements for the estimator: preprocessing, the first seconds, and late sensors.

`Intake` applies the calibration that an estimator expects. `Startup` collects the first seconds until the estimator has
its initial conditions. Sensors that begin later join: the filter continues with their calibration in its state.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from rovgraph.diagnosis.check.values import angles, gravity, turn_rates
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.inference.filter import ErrorLayout
from rovgraph.inference.filter_step import Gaussian
from rovgraph.inference.fixed_lag import FixedLag
from rovgraph.inference.gyrocompassing import ALIGN_S, why_not
from rovgraph.inference.initialise import WINDOW_S, initialise
from rovgraph.inference.resolve import WITHIN_S
from rovgraph.live.message import GEODETIC, ON_EARTH, SHIP_GEODETIC, Reading
from rovgraph.log import Measurement, gathered
from rovgraph.log.streams import SPACING_S, STREAMS, label_number, precedence
from rovgraph.log.units import UNITS
from rovgraph.model.calibration import ACOUSTICS, WATER_LAYER
from rovgraph.model.config import Config, Mag
from rovgraph.model.origin import Frame, Origin, lat_lon, north_east, origin_in
from rovgraph.model.state import POSE
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.problem.motion import has_constant_velocity
from rovgraph.sensors import MOSTLY, SENSORS, placeholders
from rovgraph.sensors.dvl_sound import CORRECTED, SoundCorrection, WaterState
from rovgraph.sensors.instruments import instruments
from rovgraph.sensors.pressure import DepthByPressure, units_of_air
from rovgraph.sensors.water_layer import CELLS

TOO_LITTLE = "less than any air's"  # of a pressure
_STREAM = {GEODETIC: "fix", SHIP_GEODETIC: "ship", "pressure": "depth"}  # where a reading goes by another name
ENOUGH_SDS = 10  # of a sensor, that show whether they are placeholders
PATCH_M = 10.0  # so far around a point latitude and longitude are linear, to a tenth of a millimetre up to 80 degrees


class _Patch(NamedTuple):
    """Latitude and longitude around a point: the exact conversion takes a third of the time of a solution.

    Attributes
    ----------
    origin : latitude and longitude of north = east = 0 [deg]
    north, east : of the point [m]
    latitude, longitude : of the point, and by a metre north, and east [deg]
    """

    origin: Origin
    north: float
    east: float
    latitude: tuple[float, float, float]
    longitude: tuple[float, float, float]

    @staticmethod
    def around(north: float, east: float, origin: Origin) -> "_Patch":
        """The patch of a point."""
        ahead, aside = np.array([0.0, PATCH_M, -PATCH_M, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, PATCH_M, -PATCH_M])
        found = np.array(lat_lon(north + ahead, east + aside, origin))
        away = (found - found[:, :1] + 180.0) % 360.0 - 180.0  # longitudes leap at the date line
        by_north, by_east = away[:, 1] - away[:, 2], away[:, 3] - away[:, 4]
        latitude, longitude = np.column_stack([found[:, 0], np.column_stack([by_north, by_east]) / (2.0 * PATCH_M)])
        return _Patch(origin, north, east, tuple(latitude.tolist()), tuple(longitude.tolist()))

    def at(self, north: float, east: float) -> tuple[float, float]:
        """Latitude and longitude [deg] of a place close by."""
        ahead, aside = north - self.north, east - self.east
        latitude, longitude = (at + ahead * by_north + aside * by_east for at, by_north, by_east in self[3:])
        return latitude, longitude if abs(longitude) <= 180.0 else longitude - math.copysign(360.0, longitude)


BEACON = STREAMS["fix"].index("fix_beacon")  # of a fix, in degrees too
SEVERAL = -1.0  # beacons have fixes, and nobody stated which is the vehicle's


class Intake:
    """Calibrates, puts fixes on the map, and takes one measurement of a sensor at a time, as a log does.

    Parameters
    ----------
    config : effective configuration
    left_out : (sensor, reason) -> count, to be added to

    Attributes
    ----------
    origin : latitude and longitude [deg] of north = east = 0; None until the first fix, unless it is configured
    frame : of a dive that has begun
    beacon : number of the name that fixes of the vehicle have; None = not known yet
    news : (sensor, text) to be reported, since they were last taken
    """

    def __init__(self, config: Config, left_out: Counter[tuple[str, str]]) -> None:
        self.config = config
        self.frame: Frame | None = None
        self.origin: Origin | None = None
        if (stated := config.environment.origin) is not None:
            self.origin = origin_in(config.frame_at(stated[0]), *stated)
        self._delays: dict[str, float] = {str(sensor): delay for sensor, delay in config.delay_s.items()}
        self._mag = None if config.imu.mag == Mag() else config.imu.mag
        self._sound, self._water = SoundCorrection(config), np.full(3, np.nan)  # in the order of `WaterState`
        self.pressure = DepthByPressure(config)
        self._depth_source, self._depths_by = config.depth.source, ""  # the column that is used, as far as it came
        self._left_out = left_out
        self._newest: dict[tuple[str | float, ...], float] = {}  # by sensor, and beacon or place
        self._name_columns: dict[str, list[int]] = {}  # of each sensor
        self.news: list[tuple[str, str]] = []
        self._sizes: dict[str, int] = {}
        self._sds: dict[str, tuple[int, int]] = {}  # column -> how many sds it has stated, and placeholders of these
        self._unknown: set[str] = set()  # columns that are reported
        own = config.positioned_beacon
        self.beacon = None if own is None else label_number(own)
        self._local = False  # whether fixes come in north and east
        self._patch: _Patch | None = None

    def timed(self, time: float, readings: tuple[Reading, ...]) -> Sequence[tuple[float, tuple[Reading, ...]]]:
        """Readings with their times, where some sensors are known to be late [s]."""
        if not self._delays:
            return [(time, readings)]
        return [(time - self._delays.get(_STREAM.get(r.sensor, r.sensor), 0.0), (r,)) for r in readings]

    def measurement(self, time: float, reading: Reading) -> Measurement | None:
        """A reading as the engine takes it; None where the sensor has just been heard at that time."""
        sensor, values = reading
        if sensor in ("depth", "pressure"):
            if (below := self._depth(time, sensor, float(values[0]))) is None:
                return None
            sensor, values = "depth", np.array([below])
        if sensor in ("fix", GEODETIC) and len(values) > BEACON and not self._is_vehicles(float(values[BEACON])):
            return None
        if sensor in ON_EARTH:
            if self.origin is None:
                lat, lon = float(values[0]), float(values[1])
                self.origin = origin_in(self.frame or self.config.frame_at(lat), lat, lon)
            north, east = north_east(values[0], values[1], self.origin)
            sensor, values = _STREAM[sensor], np.array([north, east, *values[2:]])
        elif sensor == "fix":
            self._local = True
        elif sensor == "mag":
            values = self.calibrated(values)
        elif self._sound.applies:
            values = self._by_sound_speed(sensor, values)
        if sensor == "fix":  # a receiver knows less of its noise than others
            values = np.append(values, np.full(len(STREAMS["fix"]) - len(values), np.nan))
        return self._new(time, sensor, values)

    def _new(self, time: float, sensor: str, values: Array) -> Measurement | None:
        """A measurement of calibrated values; None where the sensor has just been heard at that time."""
        size = len(values)
        if size != self._sizes.setdefault(sensor, size):
            self._left_out[sensor, f"{size} signals, and {self._sizes[sensor]} before"] += 1
            return None
        of: tuple[str | float, ...] = (sensor, *self._names(sensor, values))
        newest = self._newest.get(of, -np.inf)
        if abs(time - newest) < SPACING_S:
            self._left_out[sensor, "at the time of another"] += 1
            return None
        self._newest[of] = max(time, newest)
        return Measurement(time, sensor, self._with_known_sd(sensor, values), 0)

    def _depth(self, time: float, column: str, value: float) -> float | None:
        """Depth [m] of a depth or a pressure; None where the other column is used, or no water has such a pressure."""
        by = self._depths_by = self._depths_by if self._depths_by == self._depth_source else column
        if column != by:
            self._left_out[column, f"ignored beside {by}"] += 1
            return None
        if column == "depth":
            return value
        before = self.pressure.surface.value
        surface = np.array([self.pressure.take(time, value)])
        if math.isnan(before) and not math.isnan(self.pressure.surface.value):
            self.news.append(("depth", self.pressure.says(surface)))
        latitude = None if self.origin is None else self.origin[0]
        below = float(self.pressure.depth(np.array([value]), surface, latitude)[0])
        if math.isnan(below):
            if not self._left_out["pressure", TOO_LITTLE]:
                self.news.append(("pressure", self._of_too_little(value)))
            self._left_out["pressure", TOO_LITTLE] += 1
            return None
        return below

    def _of_too_little(self, pascal: float) -> str:
        """What to state of a pressure that no air has."""
        units = UNITS["pressure"]
        meant = units_of_air(pascal / units[self.config.units.get("pressure", "Pa")], units)
        remedy = f"state units: {{pressure: {meant[-1]}}}" if meant else "state its unit under units: pressure"
        return f"{pascal:.4g} Pa is {TOO_LITTLE}, left out: {remedy}, or depth.surface_hpa: 0 if the air's is taken off"

    def _is_vehicles(self, beacon: float) -> bool:
        """Whether a fix is of the vehicle: without a name, or of the beacon that is stated, else of the only one."""
        if math.isnan(beacon) or beacon == self.beacon:
            return True
        if self.beacon is None:
            self.beacon = beacon
            return True
        if self.beacon != SEVERAL and self.config.positioned_beacon is None:
            names = " and ".join(f"{one:.0f}" if one < 2**32 else "one with a name" for one in (self.beacon, beacon))
            why = f"fixes are of several beacons, {names}, and none with a name is used any more"
            self.news.append(("fix", f"{why}: state which is the vehicle's, fix: {{beacon: NAME}}"))
            self.beacon = SEVERAL
        self._left_out["fix", "of another beacon than the vehicle's, or of one among several"] += 1
        return False

    def _names(self, sensor: str, values: Array) -> list[float]:
        """Those of its values that tell measurements of one time apart."""
        if sensor not in self._name_columns:
            columns = SENSORS[sensor].columns if sensor in SENSORS else ()
            self._name_columns[sensor] = [k for k, c in enumerate(columns) if c.label or c.name == "adcp_range"]
        return [float(values[k]) for k in self._name_columns[sensor]]

    def _with_known_sd(self, sensor: str, values: Array) -> Array:
        """The values of a measurement; its own sd is NaN where it is a placeholder, as most of that sensor are."""
        for column, sd in zip(SENSORS[sensor].columns, values.tolist(), strict=False) if sensor in SENSORS else ():
            if not (column.is_sd and sd > 0.0):
                continue
            stated, held = self._sds.get(column.name, (0, 0))
            is_held = bool(placeholders(column, np.array([sd]))[0])
            self._sds[column.name] = stated, held = stated + 1, held + is_held
            if is_held and stated >= ENOUGH_SDS and held > MOSTLY * stated:
                if column.name not in self._unknown:
                    self._unknown.add(column.name)
                    text = f"{column.name} is {sd:g}, no sd that such an instrument has, and taken as unknown"
                    self.news.append((sensor, f"{text}; the configuration's sd is used"))
                return np.where(
                    np.arange(len(values)) == SENSORS[sensor].column_names.index(column.name), np.nan, values
                )
        return values

    def fix(self, north: float, east: float, sd: float) -> Reading:
        """A fix at a place [m], in the form in which others come: of a recording with both, one form is ignored."""
        latitude, longitude = self.geodetic(np.array([north, east, 0.0]))
        if self._local or latitude is None or longitude is None:
            return Reading("fix", np.array([north, east, sd]))
        return Reading(GEODETIC, np.array([latitude, longitude, sd]))

    def calibrated(self, field: Array) -> Array:
        """A sample of the magnetometer, shape (3,), as the configuration's calibration has it."""
        return field if self._mag is None else self._mag.calibrated(field[None])[0]

    def _by_sound_speed(self, sensor: str, values: Array) -> Array:
        """Values of a DVL as if it had known the speed of sound; of others, what they tell of the water is kept."""
        if sensor == "depth":
            self._water[2] = values[0]
        elif sensor == "dvl_sound":
            self._water[:2] = np.where(np.isfinite(values), values, self._water[:2])
        elif sensor in CORRECTED:
            water = WaterState(self._water[:1], self._water[1:2], self._water[2:])
            return np.asarray(self._sound.applied(sensor, values[None], water)[0])
        return values

    def geodetic(self, p_n: Array) -> tuple[float | None, float | None]:
        """Latitude and longitude [deg] of a position, shape (3,), where the origin is known."""
        if self.origin is None:
            return None, None
        north, east, patch = float(p_n[0]), float(p_n[1]), self._patch
        if (
            patch is None
            or patch.origin != self.origin
            or not max(abs(north - patch.north), abs(east - patch.east)) <= PATCH_M
        ):
            self._patch = patch = _Patch.around(north, east, self.origin)
        return patch.at(north, east)


def origin_of(state: Mapping[str, Any]) -> Origin | None:
    """The origin in a checkpoint."""
    return None if state["origin"] is None else origin_in(state["frame"], *state["origin"])


MARGIN_S = 0.5  # beyond the window, for data that come late
AGAIN_S = 1.0  # between attempts
NEEDS_ORIGIN = (
    "environment.frame: earth needs a fix in latitude and longitude before the dive begins, or environment."
    "origin_lat_deg and origin_lon_deg"
)
NEEDS_IMU = "online needs an IMU, columns acc_x..acc_z and gyr_x..gyr_z"


@dataclass
class Startup:
    """Collects measurements until a dive can begin.

    Attributes
    ----------
    config : as the user gave it
    waits_for : why it has not begun, one line; empty while the first seconds go by
    doubts : what looks wrong with the first seconds, one line each
    """

    config: Config
    waits_for: str = ""
    measurements: list[Measurement] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    _next: float | None = None

    def __post_init__(self) -> None:
        if has_constant_velocity(self.config):
            raise InputError(f"motion.model: constant_velocity is for recorded logs, {NEEDS_IMU}")

    @property
    def expects(self) -> str:
        """Conditions for the dive to begin."""
        if self.waits_for:
            return self.waits_for
        if self._next is None:
            return "no measurement of an IMU yet"
        return f"the first {WINDOW_S + MARGIN_S:g} s of the IMU go by"

    def add(self, measurement: Measurement, origin: Origin | None) -> InitialConditions | None:
        """Take a measurement; the beginning of the dive, once it is known.

        Parameters
        ----------
        measurement : the next one
        origin : latitude and longitude [deg] of north = east = 0, where they are known
        """
        self.measurements.append(measurement)
        if measurement.sensor != "imu":
            return None
        if self._next is None:
            self._next = measurement.time + WINDOW_S + MARGIN_S
        if measurement.time < self._next:
            return None
        self._next = measurement.time + AGAIN_S
        return self.begin(origin)

    def begin(self, origin: Origin | None) -> InitialConditions | None:
        """The beginning from what is there, or None; then `waits_for` has the reason."""
        self.measurements.sort(key=lambda m: (m.time, precedence(m.sensor)))
        imu = [m.time for m in self.measurements if m.sensor == "imu"]
        if not imu:
            self.waits_for = NEEDS_IMU
            return None
        by_gyro = self.config.start.heading_deg is None and not why_not(self.config, origin)
        first = imu[-1] - (ALIGN_S + MARGIN_S if by_gyro else WITHIN_S)
        self.measurements = [m for m in self.measurements if m.time >= first]
        named = self.config.heading.sources is not None
        later = [s for s in SENSORS.values() if s.may_begin_later]
        sections: dict[str, object] = {name: getattr(self.config, name) for name in ACOUSTICS}
        sections[CELLS] = self.config.water
        unstated = {name for name, section in sections.items() if section == type(section)()}  # as a whole file has it
        later = [s for s in later if s.name not in unstated]
        expected = {s.name for s in later if s.heading_source is None or named}
        log, config = gathered(self.measurements, "so far", origin), self.config
        if origin is None and config.environment.frame == "earth":
            self.waits_for = NEEDS_ORIGIN
            return None
        if origin is None:
            config = config.with_values(environment={"frame": "flat"})
        try:
            initial = initialise(log, config, expected)
        except InputError as error:
            self.waits_for = str(error)
            return None
        findings = [finding for check in (gravity, turn_rates, angles) for finding in check(log, self.config)]
        self.doubts = [f"{finding.sensor}: {finding.text}" for finding in findings if finding.level != "ok"]
        return initial


LATE = ("dvl_water", "thruster")  # without them the filter's state needs no current
ANYWHERE_M = 1e4  # sd of the start of a dive without a fix


def is_late(m: Measurement, engine: FixedLag) -> bool:
    """Whether a measurement is of a sensor that the configuration has and the filter does not."""
    used = engine.initial.instruments
    if m.sensor not in LATE or m.sensor in used or (m.sensor == "dvl_water" and WATER_LAYER in used):
        return False
    return m.sensor != "thruster" or engine.initial.config.graph.hydrodynamics


def can_join(m: Measurement, engine: FixedLag) -> bool:
    """Whether the filter can continue with its sensor from this measurement on."""
    as_many = m.sensor != "thruster" or len(m.values) == len(engine.initial.config.vehicle.thrusters)
    return as_many and bool(engine.snapshots) and bool(np.isfinite(m.values[:3]).all())


def joined(engine: FixedLag, sensor: str) -> FixedLag:
    """A filter that continues with one sensor more."""
    initial = engine.initial
    more = instruments(initial.config, initial.config.imu.lever_arm_m)[sensor]
    return engine.continued(replace(initial, instruments={**initial.instruments, sensor: more}))


def unlocated(engine: FixedLag) -> FixedLag:
    """A filter that continues with unknown position and start, which fixes will determine."""
    initial = engine.initial
    p_sd = np.append(np.full(2, ANYWHERE_M), initial.prior.p_sd[2])
    wide: InitialConditions = replace(initial, prior=replace(initial.prior, p_sd=p_sd))

    def anywhere(known: Gaussian, layout: ErrorLayout) -> Gaussian:
        here, R_nb, P = layout.columns[POSE], known.state.R_nb[0], known.P.copy()
        P[here, here][3:, 3:] += R_nb.T @ np.diag([ANYWHERE_M**2, ANYWHERE_M**2, 0.0]) @ R_nb
        return replace(known, P=P)

    return engine.continued(wide, anywhere)
