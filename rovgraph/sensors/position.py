"""Sensors of position: depth, fixes, and places that a camera or a sonar recognises."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels import measurements as kernels
from rovgraph.model.calibration import LAYOUT
from rovgraph.model.config import Config
from rovgraph.model.state import BIAS, PLACE, PLACE_DIM, POSE, VELOCITY, Jacobians, State
from rovgraph.sensors.model import evaluate
from rovgraph.sensors.sensor import LARGEST_SD, Column, Instrument, Observed, Said, Sensor, instrument, own_sd

AIR_HPA, SAME_AIR_HPA = (950.0, 1050.0), 30.0  # of the air's pressure, and how much it changes in a dive
PRESSURES = {"dbar": 100.0, "psi": 68.94757, "kPa": 10.0, "hPa": 1.0}  # [hPa]; in bar, air is as a metre is
HPA_PER_M = 100.5
DIVED_M = 2.0  # more than waves
WAVES_REACH_M = 5.0  # over which the waves' pressure falls by e: g T^2 / (4 pi^2), of a period T of 4.5 s
DEEPEST_M = 12e3  # no pressure sensor measures more, and a number like that overflows what comes after it


@dataclass(frozen=True)
class Position:
    """Some of north, east, down of a point on the vehicle: depth sensor or position fix.

    Attributes
    ----------
    sensor : "depth" or "fix"
    lever_arm_b : ndarray, shape (3,), of the sensor relative to the state's origin [m]
    axes : indices of the components measured, (2,) for depth, (0, 1) for a fix
    offset, scale, error : names of the calibration variable that is added, of the scale's error, and of the error that
        lasts, or None
    latitude : of the origin of frame "earth" [rad]; NaN = n is flat
    """

    sensor: str
    lever_arm_b: Array
    axes: tuple[int, ...]
    offset: str | None = None
    scale: str | None = None
    error: str | None = None
    latitude: float = np.nan
    angular = False
    state = (POSE, VELOCITY, BIAS)
    kind = kernels.POSITION

    @property
    def dim(self) -> int:
        return len(self.axes)

    @property
    def calibration(self) -> tuple[str, ...]:
        return tuple(name for name in (self.offset, self.scale, self.error) if name is not None)

    @cached_property
    def packed(self) -> Array:
        """Lever arm, places of offset, scale and error in the calibration vector or -1, latitude, components."""
        names = self.offset, self.scale, self.error
        places = [-1 if name is None else LAYOUT[name].start for name in names]
        return np.array([[*self.lever_arm_b, *places, self.latitude, *self.axes]], dtype=float)

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        return evaluate(self, (POSE,), state, rate_b)


def pressure_sensor(config: Config, origin_b: Array) -> Instrument:
    """Depth, positive down."""
    depth = config.depth
    arm = np.array(depth.lever_arm_m) - origin_b
    model = Position("depth", arm, (2,), "depth_offset", "depth_scale", "depth_error")
    return instrument(depth, model, depth.sd_m, ("down",), time_offset="depth_time_offset")


def _with_waves(values: Array, believed: Instrument, config: Config) -> Array:
    """Noise of a depth: near the surface the waves' pressure comes to it."""
    waves = config.depth.waves_m
    return np.hypot(believed.sd, waves * np.exp(-max(values[0], 0.0) / WAVES_REACH_M)) if waves else believed.sd


def positioning(config: Config, origin_b: Array) -> Instrument:
    """Fixes, north and east."""
    fix = config.fix
    latitude = config.environment.earth_latitude
    model = Position("fix", np.array(fix.lever_arm_m) - origin_b, (0, 1), error="fix_error", latitude=latitude)
    return instrument(fix, model, fix.sd_m, ("north", "east"), time_offset="fix_time_offset")


def _noise_of_fix(values: Array, believed: Instrument, config: Config) -> Array:
    """Sds of north and of east, and their covariance, shape (3,); what is not known is the instrument's."""
    return np.asarray(_noise_of_fixes(values[None], believed.sd[0])[0])


def _noise_of_fixes(values: Array, sd: float) -> Array:
    """The same of n fixes, shape (n, 3)."""
    own, own_east, covariance = values[:, 2:5].T
    north = np.where(own > 0.0, np.minimum(own, LARGEST_SD), sd)  # receivers without an estimate write 0
    east = np.where(own_east > 0.0, np.minimum(own_east, LARGEST_SD), north)
    return np.column_stack([north, east, np.nan_to_num(covariance)])


def _impossible(values: Array, config: Config) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    north, east, covariance = _noise_of_fixes(values, config.fix.sd_m).T
    why = "|fix_cov_ne| is not below fix_sd times fix_east_sd, as every covariance is; check its unit, m2"
    yield why, np.abs(covariance) >= north * east


def _too_deep(values: Array, config: Config) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    yield "deeper than any sea", np.abs(values[:, 0]) > DEEPEST_M


def _range(values: Array, config: Config) -> Iterator[Said]:
    """Depth positive down, and in metres."""
    depth = values[:, 0]
    if np.median(depth) < -0.5 and np.percentile(depth, 99) < 1.0:
        yield (
            "warning",
            f"median depth {np.median(depth):.2f} m, but depth counts downwards; "
            "if its sign is reversed, state units: {depth: -m}",
            "sign",
        )
    elif np.percentile(depth, 1) < -1.0:
        lowest = -float(np.percentile(depth, 1))
        yield (
            "warning",
            f"it reaches {lowest:.1f} m above the surface; "
            "its zero was probably set under water, at the first pressure or later",
            "zero",
        )
    ends, least = [float(np.median(some)) for some in (depth[:9], depth[-9:])], float(np.percentile(depth, 1))
    for unit, hpa in PRESSURES.items():
        most = min(AIR_HPA[1], least * hpa + SAME_AIR_HPA)
        if np.ptp(depth) * hpa > DIVED_M * HPA_PER_M and all(AIR_HPA[0] < end * hpa < most for end in ends):
            remedy = f"if it is a pressure in {unit}, name it pressure and state units: {{pressure: {unit}}}"
            if config.depth.surface_hpa is not None:
                remedy = f"if it was at the surface, remove depth.surface_hpa: {config.depth.surface_hpa:g}"
            yield "warning", f"it begins and ends at {ends[0]:.4g} m, as much as the air weighs; {remedy}", "unit"
            return
    if np.ptp(depth) > 1000.0:
        yield "warning", f"depth spans {np.ptp(depth):.4g} m; if it is in cm or mm, state units: {{depth: mm}}", "unit"


DEPTH = Sensor(
    "depth",
    (Column("depth", "length"),),
    pressure_sensor,
    refused=_too_deep,
    standard_deviation=_with_waves,
    once_per_interval=True,
    observes=Observed("position", (2,)),
    may_begin_later=True,
    usual_rates=(0.05, 1000.0),
    if_missing=("warning", "no depth: the vertical position drifts; give depth if you have a pressure sensor"),
    look=_range,
)
FIX = Sensor(
    "fix",
    (
        Column("fix_north", "length"),
        Column("fix_east", "length"),
        Column("fix_sd", "length", optional=True, largest=5e3),
        Column("fix_east_sd", "length", optional=True, largest=5e3),
        Column("fix_cov_ne", "area", optional=True),
        Column("fix_beacon", optional=True, label=True),
    ),
    positioning,
    refused=_impossible,
    standard_deviation=_noise_of_fix,
    observes=Observed("position", (0, 1)),
    may_begin_later=True,
    occasional=True,
    if_missing=("ok", "no position fixes: the error of position grows with the distance"),
)


@dataclass(frozen=True)
class PlaceOffset:
    """How far a camera or sonar is from a place that it recognises, north and east; 0 when it is seen again.

    Horizontally only: a pressure sensor measures the altitude better, and looking down from higher
    up shows the same place.

    Attributes
    ----------
    lever_arm_b : ndarray, shape (3,), of the camera relative to the state's origin [m]
    latitude : of the origin of frame "earth" [rad]; NaN = n is flat
    """

    lever_arm_b: Array
    latitude: float
    sensor = "place"
    dim = PLACE_DIM
    angular = False
    state = (POSE, VELOCITY, BIAS, PLACE)
    calibration = ()
    kind = kernels.PLACE_OFFSET

    @cached_property
    def packed(self) -> Array:
        """The lever arm, and the latitude."""
        return np.array([[*self.lever_arm_b, self.latitude]], dtype=float)

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        return evaluate(self, (POSE, PLACE), state, rate_b)


def recognition(config: Config, origin_b: Array) -> Instrument:
    """A place that is not believed is another place, which nothing has to be readmitted to."""
    place = config.place
    model = PlaceOffset(np.array(place.lever_arm_m) - origin_b, config.environment.earth_latitude)
    return instrument(place, model, place.sd_m, ("north", "east"))


SEEN_PLACE = Sensor(
    "place",
    (Column("place_id", label=True), Column("place_sd", "length", optional=True, largest=5e3)),
    recognition,
    standard_deviation=own_sd(1),
    observes=Observed("position", (0, 1)),
    may_begin_later=True,
    occasional=True,
)
