"""Acoustic positioning: directions and ranges of a head (USBL), ranges to beacons, and the ship that carries them.

An exchange of sound is one equation (`rovgraph.kernels.measurements`); its numbers come with each measurement: where
the other end was, and the direction that was measured. `rovgraph.problem.acoustics` puts them together.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels import measurements as kernels
from rovgraph.kernels.measurement_row import WIDTH
from rovgraph.model.calibration import USBL_MOUNT, beacon_names
from rovgraph.model.config import Config
from rovgraph.model.config_sections import FASTEST_MPS, SLOWEST_MPS
from rovgraph.model.state import BIAS, POSE, VELOCITY, Jacobians, State
from rovgraph.sensors.model import evaluate
from rovgraph.sensors.sensor import Column, Instrument, Observed, Said, Sensor, instrument
from rovgraph.sensors.sound import is_in_feet, is_of_water, look_at_sound_speed

FARTHEST_M = 12e3  # that the sound of a positioning system reaches
NEAREST_M = 1.0  # that it is used at, in the median
MOST_ELEVATION = 0.5 * np.pi + 1e-6


@dataclass(frozen=True)
class AcousticExchange:
    """Range, and direction where a head measures it.

    Attributes
    ----------
    sensor : "usbl" or "range"
    dim : 3 = range [m], and across and up from the direction that was measured [rad]; 1 = range
    arm_b : ndarray, shape (3,), of the point on the vehicle, relative to the state's origin [m]
    calibration : variables that it depends on, those of the beacons in use among them
    context : ndarray, shape (n, WIDTH), of each measurement, `rovgraph.kernels.measurement_row`
    """

    sensor: str
    dim: int
    arm_b: Array
    calibration: tuple[str, ...]
    context: Array = field(default_factory=lambda: np.zeros((1, WIDTH)))
    angular = False
    state = (POSE, VELOCITY, BIAS)
    kind = kernels.ACOUSTIC

    @property
    def packed(self) -> Array:
        """The contexts."""
        return self.context

    def of(self, context: Array) -> "AcousticExchange":
        """The model of measurements with these contexts, shape (n, WIDTH)."""
        return replace(self, context=np.ascontiguousarray(context))

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        return evaluate(self, (POSE, VELOCITY), state, rate_b)


def beacon_variables(config: Config) -> tuple[str, ...]:
    """Calibration variables of the places of the beacons that a configuration names."""
    return tuple(variable for k in range(len(config.beacons)) for variable in beacon_names(k))


def positioning_head(config: Config, origin_b: Array) -> Instrument:
    """Range and direction of an acoustic head, on the ship or on the vehicle."""
    usbl = config.usbl
    inverted = usbl.head == "vehicle"
    of_head = *USBL_MOUNT, "usbl_arm", "sound_speed_scale", "usbl_range_offset"
    lasting = "usbl_direction_error", "usbl_range_error"
    variables = *of_head, *lasting, *(beacon_variables(config) if inverted else ()), "usbl_time_offset"
    arm = np.array(usbl.lever_arm_m if inverted else usbl.beacon_arm_m) - origin_b
    angle = float(np.deg2rad(usbl.angle_sd_deg))
    sd, components = (usbl.range_sd_m, angle, angle), ("range", "across", "up")
    model = AcousticExchange("usbl", 3, arm, variables)
    return instrument(usbl, model, sd, components, time_offset="usbl_time_offset")


def ranging(config: Config, origin_b: Array) -> Instrument:
    """Ranges to beacons, or to receivers on the ship."""
    clock = ("range_clock", "range_clock_drift") if config.range.one_way else ("range_offset",)
    variables = "sound_speed_scale", *clock, "range_error", *beacon_variables(config), "range_time_offset"
    model = AcousticExchange("range", 1, np.array(config.range.lever_arm_m) - origin_b, variables)
    return instrument(config.range, model, config.range.sd_m, ("range",), time_offset="range_time_offset")


Masks = Iterator[tuple[str, NDArray[np.bool_]]]


def _impossible(values: Array, config: Config) -> Masks:
    """What is no way of sound: range and travel time are the first columns, and the speed of sound is the last."""
    r, t, c = values[:, 0], values[:, 1], values[:, -1]
    yield "range of 0 or less", (r <= 0.0) | (t <= 0.0)
    yield "farther than sound reaches", (r > FARTHEST_M) | (t > 2.0 * FARTHEST_M / SLOWEST_MPS)
    yield (
        f"a speed of sound beyond {SLOWEST_MPS:.0f} to {FASTEST_MPS:.0f} m/s",
        (c > 0.0) & ~is_of_water(c) & ~is_in_feet(c),
    )
    yield "a speed of sound in ft/s, by its size", is_in_feet(c)


def _impossible_direction(values: Array, config: Config) -> Masks:
    yield from _impossible(values, config)
    yield "elevation beyond 90 degrees", np.abs(values[:, 3]) > MOST_ELEVATION


def _is_reply(values: Array) -> NDArray[np.bool_]:
    """Rows of `USBL` that have a direction, and a range or travel time."""
    known = ~np.isnan(values)
    direction = known[:, 2] & known[:, 3] & (known[:, 0] | known[:, 1])
    return np.asarray(direction | known[:, 4:7].all(axis=1))


def _is_range(values: Array) -> NDArray[np.bool_]:
    return np.asarray(~np.isnan(values[:, :2]).all(axis=1))


DEGREES = 0.1  # share of angles beyond a full circle, which only degrees have
PLUMB, OFTEN = 1e-4, 0.2  # from 90 degrees [rad], in a share of replies that no vehicle below the head has
LARGEST_TILT = 0.35  # rms of a ship's roll or pitch [rad]


def in_degrees(angles: Array) -> NDArray[np.bool_]:
    """Which columns of (n, k) angles are in degrees by their numbers, bearing or heading and elevation, shape (k,)."""
    beyond = np.abs(angles) > np.array([2.0 * np.pi + 0.01, MOST_ELEVATION])[: angles.shape[1]]
    return np.asarray(beyond.sum(axis=0) > DEGREES * np.maximum(np.isfinite(angles).sum(axis=0), 1))


def is_plumb(elevation: Array) -> NDArray[np.bool_]:
    """Which elevations [rad] are 90 degrees, as systems write that have none, of the shape of ``elevation``."""
    return np.asarray(np.abs(np.abs(elevation) - 0.5 * np.pi) < PLUMB)


def _look_at_reach(values: Array, prefix: str) -> Iterator[Said]:
    """Ranges and travel times beyond reach, with every unit in which they are within it: there may be two."""
    for k, what, column, own, others, metre in (
        (0, "ranges", "range", "m", {"cm": 1e-2, "mm": 1e-3}, 1.0),
        (1, "travel times", "travel_time", "s", {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}, 2.0 / SLOWEST_MPS),
    ):
        known = values[np.isfinite(values[:, k]), k]
        if len(known) and (median := float(np.median(known))) > FARTHEST_M * metre:
            fits = [unit for unit, factor in others.items() if NEAREST_M < median * factor / metre <= FARTHEST_M]
            remedy = "; ".join(f"if they are in {u}, state units: {{{prefix}{column}: {u}}}" for u in fits)
            text = f"its {what} are {median:.4g} {own} in the median, farther than sound reaches"
            yield "error", f"{text}; {remedy or 'correct their unit'}", "unit"


def _look_at_directions(values: Array, config: Config) -> Iterator[Said]:
    bearing, elevation = in_degrees(values[:, 2:4])
    if bearing or elevation:
        key = "usbl_direction" if bearing and elevation else "usbl_bearing" if bearing else "usbl_elevation"
        largest = float(np.nanmax(np.abs(values[:, 2:4])))
        yield (
            "error",
            f"its angles reach {largest:.4g} rad; if they are in degrees, state units: {{{key}: deg}}",
            "unit",
        )
    plumb = int(is_plumb(values[:, 3]).sum())
    if config.usbl.depth == "measured" and plumb > max(OFTEN * len(values), 1):
        text = f"its elevation is 90 degrees in {plumb} of {len(values)} replies, which stands for none"
        yield "warning", f"{text}: if the system has no elevation, state usbl: {{depth: given}}", "stuck"


def _look_at_replies(values: Array, config: Config) -> Iterator[Said]:
    yield from _look_at_reach(values, "usbl_")
    yield from _look_at_directions(values, config)
    yield from look_at_sound_speed("usbl_sound_speed", values[:, -1])


def _look_at_ranges(values: Array, config: Config) -> Iterator[Said]:
    yield from _look_at_reach(values, "")
    yield from look_at_sound_speed("range_sound_speed", values[:, -1])


def _look_at_place(values: Array, config: Config) -> Iterator[Said]:
    start = config.start
    begin = np.array([start.north_m or 0.0, start.east_m or 0.0])
    away = float(np.hypot(*(np.median(values[:, :2], axis=0) - begin)))
    if start.located and away > FARTHEST_M:
        yield (
            "warning",
            f"the ship is {away / 1e3:.0f} km from where the dive begins, start.north_m {begin[0]:g}, "
            f"start.east_m {begin[1]:g}: if these are eastings and northings of a grid, state the start on it, or null",
            "start",
        )


def _look_at_heading(values: Array, config: Config) -> Iterator[Said]:
    if in_degrees(values).any():
        text = f"it reaches {np.abs(values).max():.4g} rad; if it is in degrees, state units: {{ship_heading: deg}}"
        yield "error", text, "unit"


def _look_at_tilt(values: Array, config: Config) -> Iterator[Said]:
    if (rms := float(np.sqrt(np.mean(values**2, axis=0)).max())) > LARGEST_TILT:
        text = f"roll or pitch is {rms:.2g} rad rms; if they are in degrees, state units: {{ship_tilt: deg}}"
        yield "error", text, "unit"


USBL = Sensor(
    "usbl",
    (
        Column("usbl_range", "length", optional=True),
        Column("usbl_travel_time", "duration", optional=True),
        Column("usbl_bearing", "angle", optional=True, group="usbl_direction"),
        Column("usbl_elevation", "angle", optional=True, group="usbl_direction"),
        *(Column(f"usbl_{axis}", "length", optional=True) for axis in "xyz"),
        Column("usbl_beacon", optional=True, label=True),
        Column("usbl_range_sd", "length", optional=True, largest=1e3),
        Column("usbl_angle_sd", "angle", optional=True, group="usbl_direction", largest=1.6),
        Column("usbl_sound_speed", "speed", optional=True),
    ),
    positioning_head,
    refused=_impossible_direction,
    observes=Observed("position"),
    may_begin_later=True,
    occasional=True,
    complete=_is_reply,
    together="usbl_bearing, usbl_elevation and usbl_range or usbl_travel_time, or usbl_x, usbl_y and usbl_z; "
    "ranges alone are range or travel_time",
    look=_look_at_replies,
)
RANGE = Sensor(
    "range",
    (
        Column("range", "length", optional=True),
        Column("travel_time", "duration", optional=True),
        Column("range_beacon", optional=True, label=True),
        Column("range_receiver", optional=True, label=True),
        Column("range_sd", "length", optional=True, largest=1e3),
        Column("range_sound_speed", "speed", optional=True),
    ),
    ranging,
    refused=_impossible,
    observes=Observed("position"),
    may_begin_later=True,
    occasional=True,
    complete=_is_range,
    together="range or travel_time",
    look=_look_at_ranges,
)
SHIP = Sensor(
    "ship",
    (
        Column("ship_north", "length"),
        Column("ship_east", "length"),
        Column("ship_sd", "length", optional=True, largest=5e3),
    ),
    may_begin_later=True,
    occasional=True,
    look=_look_at_place,
)
SHIP_HEADING = Sensor(
    "ship_heading",
    (Column("ship_heading", "angle"),),
    may_begin_later=True,
    usual_rates=(0.2, 1000.0),
    look=_look_at_heading,
)
SHIP_TILT = Sensor(
    "ship_tilt",
    (Column("ship_roll", "angle"), Column("ship_pitch", "angle")),
    may_begin_later=True,
    usual_rates=(0.2, 1000.0),
    look=_look_at_tilt,
)
