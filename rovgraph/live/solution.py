"""A navigation solution: position, velocity and attitude with their uncertainty, and the state of the sensors."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from rovgraph.diagnosis.alarm import Alarm, Verdict
from rovgraph.geometry import Array
from rovgraph.model.origin import Origin


@dataclass(frozen=True)
class Event:
    """An event that a person should know.

    Attributes
    ----------
    time : [s], the estimate's time
    source : sensor or source that it is about
    kind : short and fixed, as "rejected", "readmitted", "silent", "frozen", "gap", "clock", "check",
        "doubtful", "wrong", "over"
    text : one line for a person
    """

    time: float
    source: str
    kind: str
    text: str

    def as_dict(self) -> dict[str, object]:
        """For JSON; no time before there is any."""
        return {**vars(self), "time": round(self.time, 6) if math.isfinite(self.time) else None}


@dataclass(frozen=True)
class SensorHealth:
    """How a sensor is.

    Attributes
    ----------
    state : "ok", "silent", "rejected", "frozen", "no lock"
    age : since its last measurement [s]
    used, rejected : counts since the start
    failed_s : how long it has been silent, frozen or without lock; 0 where it is not [s]
    """

    state: str
    age: float
    used: int
    rejected: int
    failed_s: float = 0.0


class ShipPose(NamedTuple):
    """The ship that carries an acoustic system: north and east of its antenna [m], heading [rad], NaN = not known."""

    north: float
    east: float
    heading: float


class BeaconPlace(NamedTuple):
    """An acoustic beacon, where the estimate has it, or one of two places where it may be [m, m^2].

    ``behind`` is the cost beyond that of the likeliest place while the path has not told which; NaN once it has.
    """

    name: str
    north: float
    east: float
    north_sd: float
    east_sd: float
    cov_north_east: float
    behind: float = math.nan


class RangeCircle(NamedTuple):
    """Where a range puts the vehicle, at its depth: about a beacon, or about the ship, which has no name [m]."""

    name: str
    north: float
    east: float
    radius: float


class CrossingPlace(NamedTuple):
    """Where the survey crosses its own lines, or a piece of a line on a chart [m], and whether its soundings match."""

    north: float
    east: float
    matched: bool
    on_chart: bool


class CurrentAt(NamedTuple):
    """The current at a depth, by profiles of the water [m, m/s]."""

    depth: float
    north: float
    east: float
    north_sd: float
    east_sd: float


@dataclass(frozen=True)
class Solution:
    """The navigation solution of one moment, of the body's origin.

    Attributes
    ----------
    time : [s], of the estimator's clock
    position, velocity : ndarray, shape (3,), n [m, m/s]
    position_sd, velocity_sd : ndarray, shape (3,)
    cov_north_east : [m^2]
    rpy, rpy_sd : ndarray, shape (3,), roll, pitch, yaw [rad]
    latitude, longitude : [deg], None without an origin
    origin : of north and east
    calibration : label -> (value, sd), radians and SI
    sensors : name of the stream -> SensorHealth
    events : since the last solution
    verdict, alarms : of the estimate now, and the alarms behind the verdict
    distance : travelled [m]
    altitude, altitude_sd : straight down to the bottom by the DVL's newest ranges [m], None if older than 3 s
    bottom_depth, bottom_depth_sd : of the bottom there [m], None likewise
    predicted_s : time since the newest keyframe, bridged by the IMU alone [s]
    latency_s : from the arrival of the newest measurement to this solution [s], None in a replay
    update_s : duration of the newest update [s]
    current : by profiles of the water, at depths about the vehicle's, the shallowest first
    ship, beacons, ranges : of an acoustic system: the ship, beacons in their place or in one of two, the newest ranges
    crossings : that the newest match of the survey's lines looked at
    """

    time: float
    position: Array
    velocity: Array
    rpy: Array
    position_sd: Array
    velocity_sd: Array
    rpy_sd: Array
    cov_north_east: float
    latitude: float | None = None
    longitude: float | None = None
    origin: Origin | None = None
    calibration: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    sensors: Mapping[str, SensorHealth] = field(default_factory=dict)
    events: tuple[Event, ...] = ()
    verdict: Verdict = "trusted"
    alarms: tuple[Alarm, ...] = ()
    distance: float = 0.0
    altitude: float | None = None
    altitude_sd: float | None = None
    bottom_depth: float | None = None
    bottom_depth_sd: float | None = None
    predicted_s: float = 0.0
    latency_s: float | None = None
    update_s: float = 0.0
    current: tuple[CurrentAt, ...] = ()
    ship: ShipPose | None = None
    beacons: tuple[BeaconPlace, ...] = ()
    ranges: tuple[RangeCircle, ...] = ()
    crossings: tuple[CrossingPlace, ...] = ()
