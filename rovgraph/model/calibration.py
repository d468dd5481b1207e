"""The one table of calibration variables.

The configuration's ``calibration`` section, the graph's keys and priors, the
simulator's hidden truth and the rows of a report all come from `TABLE`.
A variable is added by adding a row here and using its name in a measurement model.

Compiled measurement equations take all of the calibration as one vector, the variables of `TABLE` one after
the other: `LAYOUT` has the index of each.

Constants that every instrument has and that are seldom known exactly (mounting, lever arm and scale of the DVL, the
gyro's scale, the depth sensor's offset) are considered by default: held at their mean, with their uncertainty in that
of all else.

The offset and the deviation of every compass are estimated by default, of a magnetometer its
hard iron instead of the deviation: no compass in a vehicle is free of them, and holding them
at zero pushes them into the DVL's misalignment and makes the track look far more certain than
it is. They have a second, wider sd, for a compass without a stated calibration that no other sensor checks; which of
the two holds depends on the log (`rovgraph.inference.assumptions`), unless the configuration states one.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from rovgraph.geometry import Array

Follows = Callable[[Any, Any], Mapping[str, Any]]


@dataclass(frozen=True)
class Variable:
    """One calibration variable.

    Attributes
    ----------
    name : key in the configuration, in models' Jacobians and in reports
    letter : character of the GTSAM key
    components : suffixes of the scalar components; ("",) for a scalar
    unit : unit inside the program
    sd : default standard deviation of the prior, every component [unit]
    sensors : log streams of which one must be in use, or the variable has no meaning
    about : one line for people
    excited_by : what a dive must have for the data to show it
    estimate : estimated unless the configuration says otherwise
    walk : default random walk [unit per root second], 0 = constant over the dive
    considered : where it is not estimated, its prior's uncertainty is in that of all else, unless the configuration
        says otherwise
    time_constant : default time constant of an error that lasts, first-order Gauss-Markov with the prior's sd [s];
        infinite = no such error
    unchecked_sd : standard deviation of the prior where the heading rests on this compass alone, without a stated
        calibration or a second sensor [unit]; None = not for this variable
    follows : what the rest of a `Config` says of its prior, as fields of `Belief`; of the configuration and of its
        entry in ``calibration``, if it has one
    """

    name: str
    letter: str
    components: tuple[str, ...]
    unit: str
    sd: float
    sensors: tuple[str, ...]
    about: str
    excited_by: str
    estimate: bool = False
    walk: float = 0.0
    considered: bool = False
    time_constant: float = np.inf
    unchecked_sd: float | None = None
    follows: Follows | None = field(default=None, repr=False, compare=False)

    @property
    def dim(self) -> int:
        """Number of components."""
        return len(self.components)

    @property
    def angular(self) -> bool:
        """Stated in degrees where a person reads or writes it."""
        return self.unit == "rad"

    @property
    def time_offset(self) -> bool:
        """How late a sensor's stamps are."""
        return self.name.endswith(_TIME_OFFSET)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the scalar components, such as ``hard_iron_x``."""
        return tuple(self.name + c for c in self.components)


STEADY = 1e-4  # walk of what changes at known times, in its sd: next to none between them [1/rts]
CONSIDERED = "considered"  # neither estimated nor exact
AUTO = "auto"  # an error that lasts: estimated where a smoothed dive shows it, else exact

_TIME_OFFSET = "_time_offset"
_DEG = float(np.deg2rad(1.0))
_ONE = ("",)
_XYZ = ("_x", "_y", "_z")
_CURVE = ("_sin", "_cos")
_OF_THE_FIELD = "rolling and pitching: on a level vehicle it cannot be told from hard_iron_z"
_SYMMETRIC = ("_xx", "_yy", "_zz", "_xy", "_xz", "_yz")
BEAM_SENSORS = tuple(f"dvl_beam_{k}" for k in range(9))  # a DVL's beams by the instrument's own numbers, 0 or 1 first
_OVER_GROUND = ("dvl", *BEAM_SENSORS)
_DVL = (*_OVER_GROUND, "dvl_water")


def _compass(prefix: str, letters: str, sensor: str, whose: str, beside: str = "") -> tuple[Variable, Variable]:
    """Offset and deviation curve of a compass; one that has another correction ``beside`` holds its curve fixed."""
    offset = Variable(
        prefix + "_offset",
        letters[0],
        _ONE,
        "rad",
        5 * _DEG,
        (sensor,),
        f"offset of {whose} (deviation A)",
        "position fixes, or a second compass whose offset is known better",
        estimate=True,
        unchecked_sd=10 * _DEG,
    )
    deviation = Variable(
        prefix + "_deviation",
        letters[1],
        _CURVE,
        "rad",
        3 * _DEG,
        (sensor,),
        f"deviation curve of {whose}{beside}: sine and cosine of heading (B, C)",
        "turning through all headings, against the gyro",
        estimate=not beside,
        unchecked_sd=5 * _DEG,
    )
    return offset, deviation


def _compass_error(prefix: str, letter: str, sensor: str, whose: str) -> Variable:
    """Error of a compass that lasts for a while."""
    return Variable(
        prefix + "_error",
        letter,
        _ONE,
        "rad",
        2 * _DEG,
        (sensor,),
        f"error of {whose} that lasts (fusion, steel near by)",
        "the gyro, over its time constant",
        time_constant=60.0,
    )


def _time_offset(
    prefix: str, letter: str, sd: float, sensors: tuple[str, ...], whose: str, excited_by: str
) -> Variable:
    """How late the stamps of a sensor are."""
    about = f"how late {whose}: what it measured was valid that long before its stamp"
    return Variable(prefix + _TIME_OFFSET, letter, _ONE, "s", sd, sensors, about, excited_by)


KNOWN_SOUND_SD = 0.003  # scale error of a DVL whose speed of sound follows from temperature and salinity
ALIGNED = 1.0 / 3.0  # of a mounting's sd, where the replies are in the ship's axes or north-aligned


def _mounted(section: str, axis: int, config: Any, entry: Any) -> dict[str, Any]:
    """The angle of a mounting, where no other mean is stated."""
    return {} if entry.mean_deg is not None else {"mean": _DEG * getattr(config, section).mount_rpy_deg[axis]}


def _acoustic_head(axis: int, config: Any, entry: Any) -> dict[str, Any]:
    """The same; a system that states its replies in other axes than the head's has applied its alignment."""
    aligned = config.usbl.frame != "transducer" and "sd_deg" not in entry.model_fields_set
    return _mounted("usbl", axis, config, entry) | ({"sd": ALIGNED * (_DEG * entry.sd_deg)} if aligned else {})


def _sound(config: Any, entry: Any) -> dict[str, Any]:
    """A scale that is known as well as the sound in the water."""
    return {"sd": KNOWN_SOUND_SD} if config.knows_sound_speed and "sd" not in entry.model_fields_set else {}


def _of_ranges(one_way: bool, config: Any, entry: Any) -> dict[str, Any]:
    """Nothing shows what ranges do not have, which are measured one way, or both."""
    return {} if config.range.one_way == one_way else {"streams": ()}


ACOUSTICS = "usbl", "range"  # log streams
BEACONS = 8  # that a dive may have
_CONTROL = "".join(
    map(chr, range(1, 12))
)  # letters of what beams of a DVL need; printable ones are for sensors outside
_MARKS = "!#$%&()*+,-./:;<"  # letters of their variables
WATER_LAYER = "water_layer"  # sensor: the water's velocity as profiles of cells show it
CHART, CHART_PLACE = "chart", "chart_place"  # of the bottom, and the error of its place
LAYERS = tuple(f"water_layer_{k + 1}" for k in range(14))  # knots of the current's profile that are kept at a time


def beacon_names(k: int) -> tuple[str, str]:
    """Variables of the k-th beacon: its north and east, and its depth."""
    return f"beacon_{k + 1}", f"beacon_{k + 1}_down"


def _place_of_beacon(k: int, config: Any, entry: Any) -> dict[str, Any]:
    """That which ``beacons`` states, and the streams that show it."""
    if k >= len(config.beacons):
        return {"streams": ()}
    beacon, shown = config.beacons[k], {"streams": ACOUSTICS if config.usbl.head == "vehicle" else ("range",)}
    if beacon.north_m is None or beacon.east_m is None:
        return shown
    return shown | {"mean": np.array([beacon.north_m, beacon.east_m]), "sd": beacon.sd_m}


def _depth_of_beacon(k: int, config: Any, entry: Any) -> dict[str, Any]:
    """The same; directions from the vehicle show the depth as well as the place."""
    in_plan = getattr(config.calibration, beacon_names(k)[0])
    place = {"sd": in_plan.sd, **_place_of_beacon(k, config, in_plan)}
    shown = {"streams": place["streams"]}
    if not place["streams"]:
        return shown
    if config.beacons[k].down_m is not None:
        return shown | {"mean": config.beacons[k].down_m, "sd": config.beacons[k].down_sd_m}
    return shown | ({"sd": place["sd"]} if config.usbl.head == "vehicle" else {})


def _beacon(k: int) -> tuple[Variable, Variable]:
    """North and east of an acoustic beacon, and its depth."""
    shown = "a path about it, with turns; ranges alone leave a mirrored place on a straight leg"
    about = f"beacon {k + 1} of beacons"
    names = beacon_names(k)
    place = names[0], _MARKS[2 * k], ("_north", "_east"), "m", 1000.0, ACOUSTICS
    down = names[1], _MARKS[2 * k + 1], _ONE, "m", 10.0, ACOUSTICS
    return (
        Variable(
            *place, f"place of {about}, north and east", shown, estimate=True, follows=partial(_place_of_beacon, k)
        ),
        Variable(
            *down,
            f"depth of {about}",
            "passing near it; the depth that a chart or a sounder shows",
            estimate=True,
            follows=partial(_depth_of_beacon, k),
        ),
    )


def _current(config: Any, entry: Any) -> dict[str, Any]:
    """That of the cells' depth is shown by profiles of the water, and believed as the current at a knot is."""
    if config.water.knots != 1:
        return {}
    prior = {} if entry is not None and "sd" in entry.model_fields_set else {"sd": config.water.current_sd_mps}
    return prior | {"streams": (WATER_LAYER, "thruster", "dvl_water")}


def _knot(k: int, config: Any, entry: Any) -> dict[str, Any]:
    """A knot of the current, of those that are kept."""
    water, knots = config.water, config.water.knots or len(LAYERS)
    unused = {} if knots > 1 and k < knots else {"streams": ()}
    return {"sd": water.current_sd_mps, "walk": water.walk_mps, **unused}


STATE_LETTERS = frozenset("xvbn")  # of the graph's other variables
MOUNT = ("dvl_roll", "dvl_pitch", "dvl_yaw")  # of the DVL's axes in the body's
USBL_MOUNT = ("usbl_roll", "usbl_pitch", "usbl_yaw")  # of the acoustic head's axes in its frame's

TABLE: dict[str, Variable] = {
    v.name: v
    for v in (
        Variable(
            "dvl_roll",
            "r",
            _ONE,
            "rad",
            2 * _DEG,
            _DVL,
            "roll of the DVL's mounting",
            "moving sideways and up and down, with a depth sensor",
            considered=True,
            follows=partial(_mounted, "dvl", 0),
        ),
        Variable(
            "dvl_pitch",
            "p",
            _ONE,
            "rad",
            2 * _DEG,
            _DVL,
            "pitch of the DVL's mounting",
            "moving forwards and up and down, with a depth sensor",
            considered=True,
            follows=partial(_mounted, "dvl", 1),
        ),
        Variable(
            "dvl_yaw",
            "y",
            _ONE,
            "rad",
            5 * _DEG,
            _DVL,
            "yaw of the DVL's mounting: misalignment",
            "starts, stops and turns, against the accelerometer; position fixes beside a compass that is known",
            considered=True,
            follows=partial(_mounted, "dvl", 2),
        ),
        Variable(
            "dvl_scale",
            "s",
            _ONE,
            "1",
            0.02,
            _DVL,
            "scale error of the DVL (sound speed)",
            "position fixes far apart; large changes of depth; starts and stops, against the accelerometer",
            considered=True,
            follows=_sound,
        ),
        Variable(
            "dvl_lever_arm",
            "l",
            _XYZ,
            "m",
            0.05,
            _DVL,
            "error of the DVL's place, dvl.lever_arm_m less imu.lever_arm_m, body axes",
            "turning: yaw for forward and starboard, roll and pitch for down",
            considered=True,
        ),
        _time_offset("dvl", "t", 0.1, (*_DVL, "dvl_heading"), "the DVL's stamps are", "starts, stops and turns; waves"),
        *_compass("dvl_compass", "de", "dvl_heading", "the DVL's compass"),
        *_compass("ahrs", "af", "ahrs", "the IMU's own heading"),
        _time_offset(
            "ahrs",
            "A",
            0.05,  # what a fusing filter and one period of a message at 10 Hz add to a compass
            ("ahrs",),
            "the stamps of the IMU's own heading are",
            "turning in both senses, against the gyro",
        ),
        *_compass("mag", "mg", "mag", "the magnetometer's heading", " beside its hard iron"),
        _time_offset(
            "mag", "M", 0.05, ("mag",), "the magnetometer's stamps are", "turning in both senses, against the gyro"
        ),  # a period at 20 Hz
        Variable(
            "hard_iron",
            "h",
            _XYZ,
            "field",
            0.02,
            ("mag",),
            "hard iron in IMU axes, as a fraction of the field's magnitude",
            "turning through all headings; roll and pitch for the vertical axis",
            estimate=True,
            unchecked_sd=0.033,  # in the ratio of a deviation curve's
        ),
        Variable(
            "soft_iron",
            "o",
            _SYMMETRIC,
            "1",
            0.02,
            ("mag",),
            "soft iron in IMU axes beyond imu.mag.matrix: what a symmetric matrix has beyond the unit matrix",
            "turning through all headings with much roll and pitch; hold field_scale fixed, which is its mean diagonal",
        ),
        Variable(
            "field_dip",
            "i",
            _ONE,
            "rad",
            3 * _DEG,
            ("mag",),
            "difference of the field's dip from environment.dip_deg",
            _OF_THE_FIELD,
            estimate=True,
        ),
        Variable(
            "field_scale",
            "q",
            _ONE,
            "1",
            0.05,
            ("mag",),
            "difference of the field's magnitude from environment.field_norm, as a fraction of it",
            _OF_THE_FIELD,
            estimate=True,
        ),
        Variable(
            "acc_scale",
            "u",
            _XYZ,
            "1",
            0.005,
            ("imu",),
            "scale error of the accelerometer, IMU axes",
            "tilting far on every axis, and accelerating against a DVL; of a level vehicle it is part of the bias",
        ),
        Variable(
            "gyr_scale",
            "w",
            _XYZ,
            "1",
            0.005,
            ("imu",),
            "scale error of the gyro, IMU axes",
            "turning far about every axis, against compasses and gravity",
            considered=True,
        ),
        Variable(
            "depth_offset",
            "z",
            _ONE,
            "m",
            0.2,
            ("depth",),
            "offset of the depth sensor",
            "a start at a known depth (start.down_m), and a precise vertical velocity afterwards",
            considered=True,
        ),
        Variable(
            "depth_scale",
            "D",
            _ONE,
            "1",
            0.015,
            ("depth",),
            "scale error of the depth (density of the water, as fresh is to salt)",
            "large changes of depth, against a DVL whose scale is known",
            considered=True,
        ),
        _time_offset(
            "depth",
            "Z",
            0.1,  # a pressure sensor's averaging and one period of a message at 10 Hz
            ("depth",),
            "the depth sensor's stamps are",
            "diving and waves, against the vertical velocity of a DVL",
        ),
        _time_offset(
            "fix",
            "F",
            0.3,  # 200 m of sound through water both ways; a receiver of GPS at 5 Hz has less
            ("fix",),
            "the stamps of fixes are",
            "legs in several directions, against a DVL and a heading",
        ),
        Variable(
            "drag_linear",
            "j",
            _XYZ,
            "1",
            0.3,
            ("thruster",),
            "relative error of vehicle.drag_linear",
            "slow motion along each axis with a DVL",
            estimate=True,
        ),
        Variable(
            "drag_quadratic",
            "k",
            _XYZ,
            "1",
            0.3,
            ("thruster",),
            "relative error of vehicle.drag_quadratic",
            "fast motion along each axis with a DVL",
            estimate=True,
        ),
        Variable(
            "current",
            "c",
            ("_north", "_east"),
            "m/s",
            0.1,
            ("thruster", "dvl_water"),
            "velocity of the water over ground",
            "bottom track beside water track or thrusters; with thrusters, turning",
            estimate=True,
            walk=5e-4,  # a centimetre a second in seven minutes: none stays as it is to the millimetre
            follows=_current,
        ),
        Variable(
            "fix_error",
            "1",
            ("_north", "_east"),
            "m",
            1.0,
            ("fix",),
            "error of the fixes that lasts (multipath, a ship's heading, satellites)",
            "motion that the IMU and the DVL measure better over its time constant",
            time_constant=60.0,
        ),
        _compass_error("ahrs", "2", "ahrs", "the IMU's own heading"),
        _compass_error("dvl_compass", "3", "dvl_heading", "the DVL's compass"),
        Variable(
            "dvl_error",
            "4",
            _ONE,
            "1",
            0.01,
            _OVER_GROUND,
            "error of bottom track that lasts, as a fraction of the velocity (slope and roughness of the bottom)",
            "position fixes; starts and stops, against the accelerometer",
            time_constant=30.0,
        ),
        *_compass("vehicle_compass", "VW", "vehicle_heading", "the vehicle's own heading"),
        _compass_error("vehicle_compass", "5", "vehicle_heading", "the vehicle's own heading"),
        Variable(
            "water_oscillation",
            "6",
            ("_north", "_east", "_down"),
            "m/s",
            0.03,
            ("thruster",),
            "velocity of the water that waves move to and fro, and the vehicle with it, without drag",
            "nothing, as it is another one within a second",
            estimate=True,
            time_constant=0.5,
        ),
        Variable(
            "bottom_velocity",
            "7",
            ("_north", "_east"),
            "m/s",
            0.1,
            _OVER_GROUND,
            "velocity of what bottom track sees (a bed that moves, a cloud, a hull, ice, water)",
            "position fixes; the IMU, where it changes",
            time_constant=60.0,
        ),
        Variable(
            "depth_error",
            "8",
            _ONE,
            "m",
            0.1,
            ("depth",),
            "error of the depth that lasts (air pressure, tide, a zero that was set under way)",
            "motion up and down that the DVL measures better over its time constant",
            time_constant=60.0,
        ),
        *(
            Variable(
                f"usbl_{name}",
                letter,
                _ONE,
                "rad",
                sd * _DEG,
                ("usbl",),
                f"{name} of the acoustic head's axes in the frame that it states{more}",
                shown,
                estimate=True,
                follows=partial(_acoustic_head, axis),
            )
            for axis, (name, letter, sd, more, shown) in enumerate(
                (
                    ("roll", '"', 1.0, "", "depths from a pressure sensor, with the vehicle to port and to starboard"),
                    ("pitch", "'", 1.0, "", "depths from a pressure sensor, with the vehicle ahead and astern"),
                    (
                        "yaw",
                        "=",
                        3.0,
                        ", and the ship's compass with it",
                        "a track beside the ship that a compass or position fixes orient; far from below it",
                    ),
                )
            )
        ),
        Variable(
            "usbl_arm",
            ">",
            _XYZ,
            "m",
            0.3,
            ("usbl",),
            "error of the acoustic head's place, usbl.lever_arm_m less ship.antenna_m, axes of its carrier",
            "the ship on several headings; the vehicle below it",
            considered=True,
        ),
        Variable(
            "sound_speed_scale",
            "?",
            _ONE,
            "1",
            0.01,
            ACOUSTICS,
            "scale error of acoustic ranges (sound speed)",
            "ranges of different lengths beside positions or depths that are known; a DVL over far changes of range",
            estimate=True,
        ),
        Variable(
            "usbl_range_offset",
            "@",
            _ONE,
            "m",
            0.1,
            ("usbl",),
            "offset of the head's ranges (turn-around time: 1 ms both ways is 0.75 m)",
            "ranges of different lengths",
            considered=True,
        ),
        _time_offset(
            "usbl",
            "[",
            0.5,
            ("usbl",),
            "the stamps of acoustic positions are",
            "the ship turning, or legs beside a DVL",
        ),
        Variable(
            "usbl_direction_error",
            "\\",
            ("_across", "_up"),
            "rad",
            0.3 * _DEG,
            ("usbl",),
            "error of the acoustic direction that lasts (the ship's compass, ray bending)",
            "motion that the IMU and the DVL measure better over its time constant",
            time_constant=600.0,
        ),
        Variable(
            "usbl_range_error",
            "]",
            _ONE,
            "m",
            0.5,
            ("usbl",),
            "error of the head's ranges that lasts (multipath, a filter in the instrument)",
            "motion that the IMU and the DVL measure better over its time constant",
            time_constant=60.0,
        ),
        Variable(
            "range_offset",
            "^",
            _ONE,
            "m",
            0.1,
            ("range",),
            "offset of ranges to beacons (turn-around time: 1 ms both ways is 0.75 m)",
            "ranges of different lengths",
            considered=True,
            follows=partial(_of_ranges, False),
        ),
        Variable(
            "range_clock",
            "_",
            _ONE,
            "m",
            1e4,  # 7 s of sound
            ("range",),
            "offset of the clocks of one-way ranges, as a length",
            "several beacons, or a path about one whose place is known",
            estimate=True,
            follows=partial(_of_ranges, True),
        ),
        Variable(
            "range_clock_drift",
            "`",
            _ONE,
            "m/s",
            0.02,  # 13 ppm of a quartz, at 1500 m/s
            ("range",),
            "drift of the clocks of one-way ranges, as a speed",
            "a dive of an hour with several beacons",
            estimate=True,
            follows=partial(_of_ranges, True),
        ),
        Variable(
            "range_error",
            "{",
            _ONE,
            "m",
            0.5,
            ("range",),
            "error of ranges to beacons that lasts (multipath, a clock)",
            "motion that the IMU and the DVL measure better over its time constant",
            time_constant=60.0,
        ),
        _time_offset(
            "range", "|", 0.3, ("range",), "the stamps of ranges are", "legs in several directions, with a DVL"
        ),
        *(variable for k in range(BEACONS) for variable in _beacon(k)),
        *(
            Variable(
                f"{beam}_angle",
                letter,
                _ONE,
                "rad",
                0.1 * _DEG,  # which a pair of a REMUS's beams is off
                (beam,),
                f"error of the angle between beam {k} of the DVL and its z axis",
                "the error velocity of four beams, and position fixes for their mean",
                considered=True,
            )
            for k, (beam, letter) in enumerate(zip(BEAM_SENSORS, _CONTROL, strict=False))
        ),
        Variable(
            "dvl_bias",
            _CONTROL[9],
            _XYZ,
            "m/s",
            0.001,
            BEAM_SENSORS,
            "velocity that a DVL at rest shows, its own axes",
            "resting on the bottom; position fixes far apart in time",
            considered=True,
        ),
        Variable(
            "dvl_altitude_scale",
            _CONTROL[10],
            _ONE,
            "1/m",
            3e-5,
            BEAM_SENSORS,
            "scale error of the DVL by its altitude, as wide beams have it (absorption and slant over the footprint)",
            "position fixes at different altitudes",
            considered=True,
        ),
        *(
            Variable(
                name,
                chr(12 + k),
                ("_north", "_east"),
                "m/s",
                0.3,
                (WATER_LAYER,),
                f"velocity of the water over ground at knot {k + 1} of those about the vehicle's depth",
                "bottom track or position fixes beside a profile of the water, and profiles that overlap",
                estimate=True,
                walk=5e-4,
                follows=partial(_knot, k),
            )
            for k, name in enumerate(LAYERS)
        ),
        Variable(
            CHART_PLACE,
            chr(26),
            ("_north", "_east"),
            "m",
            1.0,
            (CHART,),
            "how far north and east of where the chart has it the bottom lies",
            "soundings over relief, while the track is known by fixes or by its start",
            estimate=True,
        ),
    )
}


LAYOUT: dict[str, slice] = {}  # of the calibration vector, a slice for each variable of `TABLE`, in its order


def _lay_out(variable: Variable) -> None:
    begin = calibration_size()
    LAYOUT[variable.name] = slice(begin, begin + variable.dim)


def calibration_size() -> int:
    """Length of the calibration vector, with the variables that have been registered."""
    return LAYOUT[next(reversed(LAYOUT))].stop if LAYOUT else 0


for _variable in TABLE.values():
    _lay_out(_variable)
SIZE = calibration_size()  # of the built-in variables


def register(variable: Variable) -> None:
    """Append a variable to `TABLE`; in the calibration vector it follows all others.

    Raises
    ------
    ValueError : its name or letter is taken
    """
    letters = {other.letter for other in TABLE.values()} | STATE_LETTERS
    if variable.name in TABLE or variable.letter in letters or len(variable.letter) != 1:
        raise ValueError(f"calibration variable {variable.name!r}: its name or its letter {variable.letter!r} is taken")
    TABLE[variable.name] = variable
    _lay_out(variable)


def unregister(name: str) -> None:
    """Take out the variable that was registered last.

    Raises
    ------
    ValueError : another one is last, or it is built in
    """
    last = next(reversed(TABLE))
    if name != last or LAYOUT[name].stop <= SIZE:
        raise ValueError(f"calibration variable {name!r} is not the one that was registered last, {last!r}")
    del TABLE[name], LAYOUT[name]


@dataclass(frozen=True)
class Belief:
    """Prior of a calibration variable.

    Attributes
    ----------
    variable : row of `TABLE`
    mean : ndarray, shape (dim,) [unit]
    sd : float, every component [unit]
    estimate : False = held at the mean
    walk : random walk [unit per root second], 0 = constant over the dive
    considered : held at the mean, but its uncertainty is in that of all else (Schmidt); False where it is estimated
    time_constant : time in which what has walked returns to the mean [s]; infinite = it does not
    score : ndarray, shape (dim,), derivative of the log likelihood that noise has taken from the measurements
        (`rovgraph.inference.rate_noise`) [1/unit]
    changes : times at which it takes another value, by its sd, from its mean on; it is constant otherwise [s]
    streams : log streams that show it as it is configured; None = the variable's
    """

    variable: Variable
    mean: Array
    sd: float
    estimate: bool
    walk: float = 0.0
    considered: bool = False
    time_constant: float = np.inf
    score: Array | float = 0.0
    changes: tuple[float, ...] = ()
    streams: tuple[str, ...] | None = None

    def is_shown_by(self, sensors: Iterable[str]) -> bool:
        """Whether one of the sensors in use depends on it."""
        of_it = self.variable.sensors if self.streams is None else self.streams
        return not set(of_it).isdisjoint(sensors)

    @property
    def first_sd(self) -> float:
        """Where the dive begins: what changes later is at its mean [unit]."""
        return STEADY * self.sd if self.changes else self.sd
