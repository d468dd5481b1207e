"""The sections of the configuration, with the keys and limits of each."""

import datetime as dt
from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any, Literal, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, field_validator, model_validator
from pydantic_core import PydanticCustomError

from rovgraph.dates import DateRules
from rovgraph.kernels.earth import GRAVITY_PER_DEPTH, normal_gravity
from rovgraph.model.calibration import LAYERS
from rovgraph.model.origin import origin_in
from rovgraph.model.presets import known_preset

Positive = Annotated[float, Field(gt=0)]
Readmission = Annotated[
    float,
    Field(gt=0, description="after this long a rejected sensor is used again; a filter first inflates its covariance"),
]
Latitude = Annotated[float, Field(ge=-90, le=90)]
HIGHEST_LATITUDE_DEG = 85.0  # of an origin in frame "earth"
SAME_LATITUDE_DEG = 0.1  # by which two statements of it may differ
NotNegative = Annotated[float, Field(ge=0)]
Triple = tuple[float, float, float]
PositiveTriple = tuple[Positive, Positive, Positive]
NotNegativeTriple = tuple[NotNegative, NotNegative, NotNegative]
Loss = Literal["none", "huber", "cauchy"]
STAMPED = (
    *(
        "imu",
        "mag",
        "ahrs",
        "vehicle_heading",
        "vehicle_tilt",
        "dvl",
        "dvl_heading",
        "dvl_altitude",
        "dvl_water",
        "dvl_sound",
    ),
    *("dvl_beams", "adcp", "depth", "fix", "place", "thruster", "usbl", "range", "ship", "ship_heading", "ship_tilt"),
)
HeadingSource = Literal["mag", "dvl", "ahrs", "vehicle"]
ImuPreset = Annotated[str, AfterValidator(partial(known_preset, "imu"))]
DvlPreset = Annotated[str, AfterValidator(partial(known_preset, "dvl"))]


class ConfigSection(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, validate_default=True)

    def with_values(self, **values: Any) -> Self:
        """The same with other values, which are not checked; of a section a mapping of the keys that change."""
        inside = {key: getattr(self, key) for key in values}
        return self.model_copy(
            update={
                key: section.with_values(**values[key])
                if isinstance(section, ConfigSection) and isinstance(values[key], Mapping)
                else values[key]
                for key, section in inside.items()
            }
        )


Section = TypeVar("Section", bound=ConfigSection)


def _with_both(section: Section, one: str, other: str) -> Section:
    """Refuses a section that states one of two keys alone."""
    if (getattr(section, one) is None) != (getattr(section, other) is None):
        text = "expected both {one} and {other}, or neither"
        raise PydanticCustomError("half", text, {"one": one, "other": other})
    return section


class StartSettings(ConfigSection):
    """Where the dive starts; null = from the log."""

    north_m: float | None = Field(None, description="north of the first epoch; null = 0 beside east_m, else first fix")
    east_m: float | None = Field(None, description="east of the first epoch; null = 0 beside north_m, else first fix")
    down_m: float | None = Field(None, description="depth of the first epoch; null = first depth sample, else 0")
    heading_deg: float | None = Field(
        None, description="heading; null = first heading samples, without any the Earth's rate by a gyro"
    )
    roll_deg: float | None = Field(None, description="roll; null = gravity")
    pitch_deg: float | None = Field(None, description="pitch; null = gravity")
    position_sd_m: Positive = Field(0.1, description="sd of the start's north and east")
    down_sd_m: Positive | None = Field(None, description="sd of the start's down; null = position_sd_m")
    heading_sd_deg: Positive = Field(5.0, description="sd of the start's heading")
    tilt_sd_deg: Positive = Field(2.0, description="sd of the start's roll and pitch, for a start at rest")

    @property
    def located(self) -> bool:
        """Whether north or east is stated."""
        return self.north_m is not None or self.east_m is not None


class Environment(ConfigSection):
    """Gravity, magnetic field and Earth rate."""

    gravity_mps2: Annotated[float, Field(ge=9.7, le=9.9)] | None = Field(
        None, description="gravity; null = normal gravity of the latitude and depth, 9.81 without a latitude"
    )
    origin_lat_deg: Latitude | None = Field(
        None, description="latitude of north = east = 0; null = of the first fix_lat, where there is one"
    )
    origin_lon_deg: Annotated[float, Field(ge=-180, le=360)] | None = Field(
        None, description="longitude of north = east = 0, east positive"
    )
    latitude_deg: Latitude | None = Field(
        None, description="latitude, for gravity and Earth rotation; null = of the origin"
    )
    frame: Literal["flat", "earth", "auto"] = Field(
        "auto",
        description="north and east on a plane (flat), or as latitude and longitude on WGS 84 at the origin's scale "
        "(earth); auto = earth where the latitude is known and the way is too long for a plane, or the gyro is good",
    )
    declination_deg: float = Field(
        0.0,
        description="magnetic declination, east positive; not given = by place and date where all compasses in use are "
        "magnetic, as a magnetometer is and others by heading.*_reference, else 0",
    )
    declination_per_km_deg: tuple[float, float] | None = Field(
        None, description="its change by a kilometre north and east; null = as the declination, by place and date, or 0"
    )
    grid: str | None = Field(
        None, description="map grid of fix_northing, fix_easting, grid headings and results, such as EPSG:32632"
    )
    convergence_deg: Annotated[float, Field(gt=-180, lt=180)] | None = Field(
        None, description="grid north from true north, east positive; null = of the grid at the origin"
    )
    field_norm: Positive | None = Field(
        None, description="magnitude of the field, log's unit; null = median of the log"
    )
    dip_deg: Annotated[float, Field(ge=-90, le=90)] | None = Field(
        None, description="dip of the field, down positive; null = from the log, against gravity"
    )
    earth_rotation: bool | None = Field(
        None, description="model the Earth's rotation, which good gyros measure; null = in frame earth only"
    )

    @model_validator(mode="after")
    def _whole_origin(self) -> Self:
        return _with_both(self, "origin_lat_deg", "origin_lon_deg")

    @model_validator(mode="after")
    def _whole_earth(self) -> Self:
        if self.frame != "earth":
            return self
        latitude, origin = self.latitude_deg, self.origin_lat_deg
        if latitude is not None and origin is not None and abs(latitude - origin) > SAME_LATITUDE_DEG:
            text = "frame: earth takes the latitude of the origin, {o} deg; remove latitude_deg = {l}, or correct it"
            raise PydanticCustomError("two", text, {"o": f"{origin:g}", "l": f"{latitude:g}"})
        for stated in (latitude, origin):
            if stated is not None and abs(stated) > HIGHEST_LATITUDE_DEG:
                text = "frame: earth reaches to latitude {h} deg, and {l} is beyond; state frame: flat"
                raise PydanticCustomError("pole", text, {"h": f"{HIGHEST_LATITUDE_DEG:g}", "l": f"{stated:g}"})
        return self

    @property
    def origin(self) -> tuple[float, float] | None:
        """Latitude and longitude [deg] of north = east = 0, where they are stated."""
        lat, lon = self.origin_lat_deg, self.origin_lon_deg
        return None if lat is None or lon is None else origin_in(self.frame, lat, lon)

    def has_latitude(self, latitude: float) -> bool:
        """Whether an origin at a latitude [deg] can be that of frame "earth", beside what is stated."""
        stated = latitude if self.latitude_deg is None else self.latitude_deg
        return abs(latitude) <= HIGHEST_LATITUDE_DEG and abs(stated - latitude) <= SAME_LATITUDE_DEG

    @property
    def latitude(self) -> float | None:
        """Latitude [deg], as stated or of a stated origin; once the environment of a dive is resolved, the origin's."""
        return self.origin_lat_deg if self.latitude_deg is None else self.latitude_deg

    @property
    def earth_latitude(self) -> float:
        """Latitude of the origin of frame "earth" [rad]; NaN in a flat one."""
        return np.nan if self.frame != "earth" or self.latitude is None else float(np.deg2rad(self.latitude))

    @property
    def gravity(self) -> float:
        """Gravity [m/s^2], as stated or at the surface of the latitude."""
        return float(self.gravity_at(0.0))

    def gravity_at(self, depth: ArrayLike) -> NDArray[np.float64]:
        """Gravity [m/s^2] at depths [m], shape of these: one that is stated holds at all of them."""
        if self.gravity_mps2 is not None or self.latitude is None:
            return np.broadcast_to(UNKNOWN_GRAVITY if self.gravity_mps2 is None else self.gravity_mps2, np.shape(depth))
        return np.asarray(normal_gravity(np.deg2rad(self.latitude)) + GRAVITY_PER_DEPTH * np.asarray(depth))


UNKNOWN_GRAVITY = 9.81  # where no latitude is known [m/s^2]


class ImuNoise(ConfigSection):
    """Noise densities, per root hertz."""

    acc: Positive = Field(8.0e-4, description="accelerometer [m/s2/rtHz]")
    gyr: Positive = Field(6.9e-4, description="gyro [rad/s/rtHz]")
    acc_walk: Positive = Field(3.0e-4, description="random walk of the accelerometer's bias [m/s2/rts]")
    gyr_walk: Positive = Field(1.0e-5, description="random walk of the gyro's bias [rad/s/rts]")


class Mag(ConfigSection):
    """The magnetometer's calibration, (3.2) with a full matrix: field = matrix (sample - centre)."""

    centre: Triple = Field((0.0, 0.0, 0.0), description="hard iron, IMU axes, log's unit; subtracted from every sample")
    matrix: tuple[Triple, Triple, Triple] = Field(
        ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        description="soft iron and scale: factor of (sample - centre)",
    )

    @field_validator("matrix")
    @classmethod
    def _not_flat(cls, matrix: tuple[Triple, Triple, Triple]) -> tuple[Triple, Triple, Triple]:
        values = np.linalg.svd(np.array(matrix), compute_uv=False)
        if values[-1] < 0.01 * values[0]:
            raise PydanticCustomError("singular", "expected a multiple of the unit matrix, or near it; it is singular")
        return matrix

    def calibrated(self, samples: NDArray[np.float64]) -> NDArray[np.float64]:
        """The field of magnetometer samples, shape (n, 3), IMU axes."""
        return np.asarray((samples - np.array(self.centre)) @ np.array(self.matrix).T)


class Imu(ConfigSection):
    """Inertial unit: mounting and noise."""

    preset: ImuPreset | None = Field(
        None, description="instrument whose data sheet fills in missing keys, see docs/presets.md"
    )
    mount_rpy_deg: Triple = Field((0.0, 0.0, 0.0), description="IMU axes to body axes: roll, pitch, yaw")
    lever_arm_m: Triple = Field((0.0, 0.0, 0.0), description="position of the IMU in body axes")
    noise: ImuNoise = ImuNoise()
    mag: Mag = Mag()
    acc_bias_sd_mps2: Positive = Field(0.05, description="sd of the accelerometer's bias at the start")
    gyr_bias_sd_dps: Positive = Field(0.6, description="sd of the gyro's bias at the start, deg/s")
    max_gap_s: Positive = Field(30.0, description="a log with a longer IMU outage is refused")


class MotionSettings(ConfigSection):
    """What carries the state from one keyframe to the next."""

    model: Literal["imu", "constant_velocity"] | None = Field(
        None, description="the IMU, or a constant velocity without it; null = the IMU where the log has one"
    )
    acc: Positive = Field(0.1, description="constant velocity: noise density of the acceleration [m/s2/rtHz]")
    gyr: Positive = Field(0.3, description="constant velocity: noise density of the rate of turn [rad/s/rtHz]")
    rate_sd_dps: Positive = Field(
        5.0, description="constant velocity: sd of the rate of turn, which a DVL on a lever arm sees"
    )


FOOT_M = 0.3048
SLOWEST_MPS, FASTEST_MPS = 1300.0, 1700.0  # of sound in water


def _in_water(mps: float) -> float:
    """Refuses what is no speed of sound in water in m/s."""
    if not SLOWEST_MPS <= mps <= FASTEST_MPS:
        feet = SLOWEST_MPS <= mps * FOOT_M <= FASTEST_MPS
        remedy = f"; if it is in ft/s, state {mps * FOOT_M:.0f}" if feet else ""
        text = f"expected a speed of sound from {SLOWEST_MPS:g} to {FASTEST_MPS:g} m/s{remedy}"
        raise PydanticCustomError("in_water", text)
    return mps


InWater = Annotated[float, AfterValidator(_in_water)]
LOGGED = "logged"  # the log has it, column dvl_sound_speed


def _set_or_logged(mps: float | str) -> float | str:
    if isinstance(mps, str) and mps != LOGGED:
        raise PydanticCustomError("logged", "expected a speed in m/s, or logged")
    return mps if isinstance(mps, str) else _in_water(mps)


class DvlBeams(ConfigSection):
    """Where the beams of a DVL point, in its own axes (docs/beams.md)."""

    angle_deg: Annotated[float, Field(gt=0, lt=180)] | None = Field(
        None,
        description="angle between each beam and the z axis, beyond 90 where z points away from the bottom; "
        "null = not known, so that velocities are used",
    )
    azimuth_deg: Annotated[tuple[float, ...], Field(max_length=8)] = Field(
        (), description="of each beam in the order of its numbers, clockwise from the x axis seen from above"
    )
    first_number: Annotated[int, Field(ge=0, le=1)] = Field(1, description="the instrument's number of the first beam")
    convex: bool = Field(True, description="false = a concave head, whose beams cross below it")
    phased: bool = Field(
        False, description="true = a phased array, whose angle follows the sound speed; angle_deg is that at 1536 m/s"
    )

    @model_validator(mode="after")
    def _span(self) -> Self:
        if not self.azimuth_deg or self.angle_deg is None:
            return self
        around = np.deg2rad(self.azimuth_deg)
        directions = np.column_stack([np.cos(around), np.sin(around), np.ones(len(around))])
        if abs(self.angle_deg - 90.0) < 1.0:
            raise PydanticCustomError("beams_level", "angle_deg: the beams are at right angles to z, and see no bottom")
        if len(around) < 3 or np.linalg.svd(directions, compute_uv=False)[-1] < 0.1:
            raise PydanticCustomError(
                "beams_span", "azimuth_deg: the beams do not span three axes, expected three or more different azimuths"
            )
        return self


class Dvl(ConfigSection):
    """Doppler velocity log: mounting and noise."""

    preset: DvlPreset | None = Field(
        None, description="instrument whose data sheet fills in missing keys, see docs/presets.md"
    )
    mount_rpy_deg: Triple = Field((0.0, 0.0, 0.0), description="DVL axes to body axes: roll, pitch, yaw")
    lever_arm_m: Triple = Field((0.0, 0.0, 0.0), description="position of the DVL in body axes")
    velocity_sd_mps: PositiveTriple = Field((0.01, 0.01, 0.01), description="noise of a ping, DVL axes")
    water_velocity_sd_mps: PositiveTriple = Field((0.03, 0.03, 0.03), description="noise of a water-track ping")
    scale_sd: NotNegative = Field(0.0, description="part of the speed added to the noise of a ping")
    beams: DvlBeams = DvlBeams()
    beam_sd_mps: Positive | None = Field(
        None, description="noise of the velocity along a beam; null = what velocity_sd_mps stands for"
    )
    use: Literal["auto", "beams", "velocity"] = Field(
        "auto",
        description="auto = a ping's beams where their geometry is known, but for what the instrument refused; "
        "beams = whatever is valid; velocity = as the instrument makes it of them",
    )
    sound_speed_set_mps: Annotated[float | str, AfterValidator(_set_or_logged)] | None = Field(
        None,
        description="speed of sound that the DVL worked with; logged = column dvl_sound_speed of the log; null = "
        "unknown, so that nothing is corrected",
    )
    sound_speed_mps: InWater | None = Field(
        None,
        description="speed of sound at the DVL; null = by sound.profile, or by water_temperature of the log and "
        "sound.salinity_psu",
    )
    loss: Loss = Field("huber", description="robust loss")
    gate_sd: Positive | None = Field(6.0, description="a ping further off than this many sd is rejected; null = never")
    readmit_s: Readmission = 2.0
    max_speed_mps: Positive = Field(3.0, description="faster pings are ignored")


class Water(ConfigSection):
    """Profiles of the water that the DVL measures, and the current as a function of depth (docs/water.md)."""

    use: bool = Field(True, description="false = profiles are left out")
    looks: Literal["down", "up"] = Field("down", description="whether its cells are below or above the DVL")
    knots: Annotated[int, Field(ge=1, le=len(LAYERS))] | None = Field(
        None,
        description="knots of the current that are kept about the vehicle's depth; null = as many as the log's cells "
        "reach over; 1 = calibration.current alone, which changes as the depth does",
    )
    knot_m: Positive = Field(10.0, description="depth from one knot to the next, at least")
    current_sd_mps: Positive = Field(0.3, description="sd of the current at any depth, north and east")
    correlation_m: Positive = Field(60.0, description="depth over which the correlation of the current falls to 1/e")
    walk_mps: Positive = Field(6e-3, description="random walk of the current at a knot [m/s/rts]")
    cell_sd_mps: PositiveTriple = Field(
        (0.05, 0.05, 0.02), description="noise of a cell's velocity, DVL axes; sd of the table takes precedence"
    )
    vertical_sd_mps: NotNegative = Field(
        0.05, description="motion of the water up and down, which is not estimated; to the noise of the DVL's z axis"
    )
    cell_correlation: Annotated[float, Field(ge=0, lt=0.5)] = Field(
        0.15, description="correlation of neighbouring cells, by which their noise is widened"
    )
    beam_angle_deg: Annotated[float, Field(gt=0, lt=60)] | None = Field(
        None,
        description="of the beams from the DVL's axis: the last cells before the bottom or the surface see it by their "
        "side lobes; null = by dvl.beams, else 30",
    )


North = Annotated[  # YAML reads true as a truth value
    Literal["magnetic", "true", "grid"], BeforeValidator(lambda given: "true" if given is True else given)
]
_NORTH = "north that {} is relative to: magnetic, true or grid; null = magnetic, by environment.declination_deg or 0"


class Heading(ConfigSection):
    """Heading sources, the north that they are relative to, and their noise."""

    sources: tuple[HeadingSource, ...] | None = Field(
        None,
        description="any of mag, dvl, ahrs, vehicle; null = dvl, and the first of mag, ahrs and vehicle in the log",
    )
    ahrs_reference: North | None = Field(None, description=_NORTH.format("the IMU's own heading"))
    dvl_reference: North | None = Field(None, description=_NORTH.format("the DVL's compass"))
    vehicle_reference: North | None = Field(None, description=_NORTH.format("the vehicle's own heading"))
    mag_sd_deg: Positive = Field(2.0, description="noise of a magnetometer heading")
    dvl_sd_deg: Positive = Field(3.0, description="noise of the DVL's compass")
    ahrs_sd_deg: Positive = Field(3.0, description="noise of the IMU's own heading")
    vehicle_sd_deg: Positive = Field(3.0, description="noise of the vehicle's own heading")
    loss: Loss = Field("huber", description="robust loss")
    gate_sd: Positive | None = Field(6.0, description="a heading further off than this many sd is rejected")
    readmit_s: Readmission = 60.0


class TiltSettings(ConfigSection):
    """The vehicle's own roll and pitch, which are used where there is no IMU."""

    sd_deg: Positive = Field(1.0, description="noise of roll and of pitch")
    loss: Loss = Field("huber", description="robust loss")
    gate_sd: Positive | None = Field(6.0, description="roll and pitch further off than this many sd are rejected")
    readmit_s: Readmission = 10.0


class Depth(ConfigSection):
    """Pressure sensor."""

    source: Literal["depth", "pressure"] = Field(
        "depth", description="column that depths come from where a log has both; else the one that it has"
    )
    surface_hpa: NotNegative | None = Field(
        None, description="air pressure at the surface [hPa], 0 = taken off already; null = found at the surface"
    )
    density_kgm3: Annotated[float, Field(ge=900, le=1300)] | None = Field(
        None, description="density of the water [kg/m3], for depth by pressure; null = by sound.salinity_psu, else 1025"
    )
    sd_m: Positive = Field(0.05, description="noise of a depth sample")
    waves_m: NotNegative | None = Field(
        None, description="sd of the waves' pressure at the surface, as depth; null = as depths scatter there"
    )
    lever_arm_m: Triple = Field((0.0, 0.0, 0.0), description="position of the pressure sensor in body axes")
    loss: Loss = Field("huber", description="robust loss")
    gate_sd: Positive | None = Field(6.0, description="a depth further off than this many sd is rejected")
    readmit_s: Readmission = 10.0


class Fix(ConfigSection):
    """Position fixes."""

    sd_m: Positive = Field(2.0, description="noise of a fix, north and east; fix_sd and fix_east_sd take precedence")
    lever_arm_m: Triple = Field((0.0, 0.0, 0.0), description="position of the antenna or transponder in body axes")
    loss: Loss = Field("huber", description="robust loss")
    gate_sd: Positive | None = Field(6.0, description="a fix further off than this many sd is rejected")
    readmit_s: Readmission = 300.0
    beacon: str | int | None = Field(None, description="fix_beacon of the vehicle; null = usbl.beacon, or the only one")


class Place(ConfigSection):
    """Places seen before, as a camera or a sonar recognises them."""

    sd_m: Positive = Field(
        0.3, description="sd of the camera's distance from a place, north and east; place_sd takes precedence"
    )
    lever_arm_m: Triple = Field((0.0, 0.0, 0.0), description="position of the camera or sonar in body axes")
    every_s: NotNegative = Field(5.0, description="a place that stays in view is used once in this time")
    remembered: Annotated[int, Field(ge=1)] = Field(
        20, description="places that a filter remembers; it then forgets the one not seen for longest"
    )
    loss: Loss = Field("cauchy", description="robust loss")
    gate_sd: Positive | None = Field(4.0, description="an observation further off than this many sd is a false match")


class ShipSettings(ConfigSection):
    """The vessel that carries acoustic heads and receivers; its arms start at a point of it on the waterline."""

    antenna_m: Triple = Field((0.0, 0.0, 0.0), description="position of its antenna in ship axes, from the waterline")
    sd_m: NotNegative = Field(0.5, description="noise of its position, north and east; ship_sd takes precedence")
    heading_sd_deg: NotNegative = Field(0.3, description="noise of its heading")
    tilt_sd_deg: NotNegative = Field(0.1, description="noise of its roll and pitch")
    north_m: float | None = Field(None, description="north of an antenna that does not move; null = ship_north")
    east_m: float | None = Field(None, description="east of it; null = ship_east")
    heading_deg: float | None = Field(None, description="heading of what does not turn; null = ship_heading")
    max_gap_s: Positive = Field(3.0, description="its position and attitude are interpolated over no longer silence")
    receivers: dict[str, Triple] = Field(
        default_factory=dict, description="name of a receiver of ranges: its position in ship axes, from the waterline"
    )

    @model_validator(mode="after")
    def _whole_place(self) -> Self:
        return _with_both(self, "north_m", "east_m")


class AcousticSettings(ConfigSection):
    """Keys that directions and ranges share."""

    sound_speed_mps: InWater = Field(1500.0, description="speed of sound that ranges were made with, and travel times")
    stamp: Literal["reply", "transponder", "arrival"] = Field(
        "reply",
        description="what a stamp is the time of: the reply at the head, the question at the transponder, "
        "or the message's arrival",
    )
    turn_around_s: NotNegative = Field(0.0, description="time between hearing and answering, taken out of ranges")
    one_way: bool = Field(False, description="the other end sends by its clock and is not asked")
    loss: Loss = Field("huber", description="robust loss")
    gate_sd: Positive | None = Field(6.0, description="a measurement further off than this many sd is rejected")
    readmit_s: Readmission = 300.0


class Usbl(AcousticSettings):
    """Acoustic positions by direction and range (USBL), the head on the ship or on the vehicle."""

    head: Literal["ship", "vehicle"] = Field("ship", description="what carries the head")
    frame: Literal["transducer", "ship", "north"] = Field(
        "transducer",
        description="axes of direction: the head's; the ship's, made level; north, east, down with the ship's compass",
    )
    lever_arm_m: Triple = Field((0.0, 0.0, 0.0), description="position of the head in axes of what carries it")
    beacon_arm_m: Triple = Field((0.0, 0.0, 0.0), description="position of the transponder in axes of what carries it")
    mount_rpy_deg: Triple = Field((0.0, 0.0, 0.0), description="roll, pitch, yaw of the head's axes in the frame's")
    beacon: str | int | None = Field(None, description="usbl_beacon of the vehicle's transponder; null = the only one")
    range_sd_m: Positive = Field(0.3, description="noise of a range; usbl_range_sd takes precedence")
    angle_sd_deg: Positive = Field(1.0, description="noise of a direction; usbl_angle_sd takes precedence")
    depth: Literal["measured", "given"] = Field(
        "measured",
        description="given: elevation or z come from the vehicle's own depth sensor, and are not used again",
    )
    planar: bool = Field(True, description="a head that looks down: less precise towards its horizon")


class RangeSettings(AcousticSettings):
    """Ranges to beacons, or to receivers on the ship."""

    lever_arm_m: Triple = Field((0.0, 0.0, 0.0), description="position of the transducer in body axes")
    sd_m: Positive = Field(0.5, description="noise of a range; range_sd takes precedence")
    common_sd_m: NotNegative = Field(
        0.3, description="error that receivers on the ship share at one time (clock); their differences are free of it"
    )


class Sound(ConfigSection):
    """Sound in the water."""

    profile: tuple[tuple[float, float], ...] | str | None = Field(
        None,
        description="its speed by depth: rows of depth [m] and speed [m/s], or a CSV file with depth and sound_speed, "
        "or with depth, temperature and salinity",
    )
    salinity_psu: Annotated[float, Field(ge=0, le=42)] | None = Field(
        None, description="salinity of the water, for the DVL's speed of sound by the water_temperature of a log"
    )


class Beacon(ConfigSection):
    """An acoustic beacon on the bottom; without a place it is found."""

    name: str | int = Field(description="as range_beacon or usbl_beacon have it")
    north_m: float | None = Field(None, description="north; null = unknown")
    east_m: float | None = Field(None, description="east; null = unknown")
    down_m: float | None = Field(None, description="depth; null = unknown")
    sd_m: Positive = Field(1.0, description="sd of north and of east, where they are stated")
    down_sd_m: Positive = Field(1.0, description="sd of the depth, where it is stated")

    @model_validator(mode="after")
    def _whole_place(self) -> Self:
        return _with_both(self, "north_m", "east_m")

    @property
    def has_place(self) -> bool:
        """Whether north, east and depth are stated."""
        return self.north_m is not None and self.down_m is not None


class SensorSettings(ConfigSection):
    """Keys of a registered sensor; derive a class for other defaults or more keys."""

    sd: Positive = Field(1.0, description="noise of a measurement, every component")
    lever_arm_m: Triple = Field((0.0, 0.0, 0.0), description="position of the sensor in body axes")
    loss: Loss = Field("huber", description="robust loss")
    gate_sd: Positive | None = Field(6.0, description="a measurement further off than this many sd is rejected")
    readmit_s: Readmission = 10.0


class RegisteredSensors(ConfigSection):
    """Sensors that were registered, each with the keys of its own `SensorSettings`."""


class Thruster(ConfigSection):
    """One thruster: where it is and which way it pushes for a positive signal."""

    position_m: Triple = Field(description="position in body axes")
    direction: Triple = Field(description="direction of the force for a positive signal, body axes; any length")


# The thesis gives none. Four vectored horizontal thrusters at the corners of the frame, 45 degrees
# to the keel, and a vertical one in the middle, as on a Saab Seaeye Falcon: a choice.
FALCON_THRUSTERS = (
    Thruster(position_m=(0.35, 0.22, 0.0), direction=(1.0, -1.0, 0.0)),
    Thruster(position_m=(0.35, -0.22, 0.0), direction=(1.0, 1.0, 0.0)),
    Thruster(position_m=(-0.35, 0.22, 0.0), direction=(1.0, 1.0, 0.0)),
    Thruster(position_m=(-0.35, -0.22, 0.0), direction=(1.0, -1.0, 0.0)),
    Thruster(position_m=(0.0, 0.0, 0.0), direction=(0.0, 0.0, 1.0)),
)


class Vehicle(ConfigSection):
    """Hydrodynamics (2.16)-(2.24); the defaults are the thesis's Falcon, along forward, starboard, down."""

    mass_kg: Positive = Field(73.3, description="mass; buoyancy is assumed equal to the weight")
    added_mass_kg: NotNegativeTriple = Field((27.0, 30.0, 110.0), description="added mass")
    inertia_kgm2: PositiveTriple = Field((3.7, 7.6, 8.3), description="moments of inertia")
    added_inertia_kgm2: NotNegativeTriple = Field((9.0, 15.0, 11.47), description="added moments of inertia")
    drag_linear: NotNegativeTriple = Field((42.0, 180.0, 90.0), description="linear drag [N s/m]")
    drag_quadratic: NotNegativeTriple = Field((140.0, 55.0, 400.0), description="quadratic drag [N s2/m2]")
    turning_drag_linear: NotNegativeTriple = Field((42.0, 55.0, 90.0), description="linear drag of turning [N m s]")
    turning_drag_quadratic: NotNegativeTriple = Field((42.0, 55.0, 90.0), description="quadratic drag of turning")
    centre_of_buoyancy_m: Triple = Field((0.0, 0.0, -0.2), description="centre of buoyancy, from the centre of mass")
    thrust: Triple = Field(
        (0.32, -0.016, 2.98e-4), description="thrust [N] of a signal u: a u + b |u| u + c u^3 (2.21)"
    )
    thrust_rise_s: NotNegative = Field(
        0.12, description="time from 10 to 90 percent of a change of thrust, below (2.22); 0 = at once"
    )
    thrusters: tuple[Thruster, ...] = Field(FALCON_THRUSTERS, description="thruster_1, thruster_2, ... of the log")
    acceleration_sd_mps2: Positive = Field(0.02, description="error of the model's acceleration, mean of a second")
    loss: Loss = Field("huber", description="robust loss")
    gate_sd: Positive | None = Field(6.0, description="an interval further off than this many sd is rejected")
    readmit_s: Readmission = 10.0


class Graph(ConfigSection):
    """How the graph is built and solved."""

    keyframe: Literal["dvl"] = Field("dvl", description="what makes a keyframe")
    max_gap_s: Positive = Field(
        1.0, description="longest time between keyframes; a ping up to a quarter of it later makes the keyframe itself"
    )
    min_gap_s: NotNegative = Field(
        0.05, description="shortest time between keyframes; closer pings belong to the keyframe before"
    )
    solver: Literal["batch", "isam2"] = Field(
        "batch", description="solver of the smoothed estimate; isam2 is incremental"
    )
    segment_s: Positive = Field(10.0, description="isam2: calibration has a new value this often")
    lag_s: Positive = Field(5.0, description="online: how late a measurement may come; no effect on a recorded log")
    hydrodynamics: bool = Field(False, description="use thruster signals and drag (vehicle) as a source of velocity")
    find_noise: bool = Field(
        True, description="look for noise that is larger than stated or lasts, and solve the dive again with it"
    )
    crossovers: bool = Field(
        False, description="correct the track where soundings of lines that cross or run again must agree"
    )

    @property
    def ping_due_s(self) -> float:
        """How much later than `max_gap_s` a ping still makes the keyframe [s].

        A quarter of it, more than the periods of DVLs vary by; and at least `min_gap_s`, so that one which comes
        later still is far enough from the keyframe before it to make its own.
        """
        return max(0.25 * self.max_gap_s, self.min_gap_s)


class ChartSettings(ConfigSection):
    """A chart of the bottom."""

    file: str | None = Field(
        None,
        description="GeoTIFF of depths or heights in metres; soundings are compared with it, as with earlier lines",
    )
    sd_m: Positive = Field(0.5, description="error of a cell's depth, beside an offset of all")


def _stamped(sensor: str) -> str:
    """Refuses what is no sensor, among them those that are registered."""
    known = (*STAMPED, *RegisteredSensors.model_fields)
    if sensor not in known:
        expected = ", ".join(map(repr, known[:-1])) + f" or {known[-1]!r}"
        raise PydanticCustomError("literal_error", "expected {expected}", {"expected": expected})
    return sensor


Delays = dict[Annotated[str, AfterValidator(_stamped)], float]  # sensor -> how late its stamps are known to be [s]


class DateSettings(ConfigSection):
    """What dates as text leave open."""

    order: Literal["dmy", "mdy"] | None = Field(
        None, description="order of day and month in dates such as 05/01/2026; null = as the dates themselves show"
    )
    zone_h: float = Field(0.0, ge=-14, le=14, description="hours ahead of UTC of dates that state no zone [h]")
    date: dt.date | None = Field(None, description="day of times of day without a date, e.g. 2026-05-01")

    @property
    def rules(self) -> DateRules:
        """The same, for those who read dates."""
        return DateRules(self.order, self.zone_h, None if self.date is None else self.date.isoformat())


COLUMNS_TEXT = "rovgraph's column: the log's own name for it"
UNITS_TEXT = "column or sensor: unit it is in, e.g. gyr: deg/s"
ANGLES_TEXT = (
    "ahrs, attitude, dvl_heading, ship_heading, or a column: how its heading counts; ned, enu or nwu (axes forward, "
    "port, up), east"
)
Angles = dict[str, Literal["ned", "enu", "nwu", "east"]]


class TableSettings(ConfigSection):
    """How a table is written: names, units, senses of angles and times."""

    columns: dict[str, str] = Field(default_factory=dict, description=COLUMNS_TEXT)
    units: dict[str, str] = Field(default_factory=dict, description=UNITS_TEXT)
    angles: Angles = Field(default_factory=dict, description=ANGLES_TEXT)
    times: DateSettings = DateSettings()
    grid: str | None = Field(None, description="map grid of fix_northing and fix_easting; null = environment.grid")


AS_WRITTEN: dict[str, object] = {
    "columns": {},
    "units": {},
    "angles": {},
    "times": DateSettings(),
    "files": {},
}  # by rovgraph


class FileSettings(TableSettings):
    """How one of several files is written, where it differs from the others."""

    delay_s: float = Field(0.0, description="how much older its measurements are than their stamps")


class OnlineSettings(ConfigSection):
    """The online mode."""

    hold_s: NotNegative = Field(0.3, description="measurements wait this long for late ones; later ones cost more time")
