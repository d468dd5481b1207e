"""Names of columns in any table: the column of a log that each may be, its source and its unit.

A name is read as words: split at signs, blanks and capitals, and where an axis is glued to a known word (``xacc``,
``wx``). Only words are used here, not the numbers.
"""

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

from rovgraph.log.streams import DATE, is_column
from rovgraph.log.units import known_unit, name_and_bracket, quantities

OWN_NAME = "rovgraph's own name"
_PIECES = re.compile(r"[A-ZÄÖÜ]+(?![a-zäöüß])|[A-ZÄÖÜ]?[a-zäöüß]+|\d+")
_AXES = {
    **dict.fromkeys(("x", "forward", "fwd", "surge", "vorne", "voraus"), "x"),
    **dict.fromkeys(("y", "starboard", "stbd", "sway", "right", "rechts", "port", "left", "links"), "y"),
    **dict.fromkeys(("z", "down", "heave", "unten", "up", "oben"), "z"),
}
_BACKWARDS = {"port", "left", "links", "up", "oben"}  # of axes to starboard and down
_ACC = {"acc", "accel", "accelerometer", "acceleration", "a"}
_GYR = {"gyr", "gyro", "gyroscope", "omega", "w"}
_MAG = {"mag", "magn", "magnetic", "magnetometer", "magfield"}
_VELOCITY = {"vel", "velocity", "v", "speed", "twist"}
_GLUED = _ACC | _GYR | _MAG | _VELOCITY | {"g", "m"}  # words that an axis may be glued to: "accx", "gx"
_SINGLE = {"g": "gyro", "m": "mag"}
_ANGLES = {"roll": "roll", "pitch": "pitch"} | dict.fromkeys(
    ("yaw", "heading", "hdg", "hdt", "hdm", "azimuth", "kurs"), "yaw"
)
_ABOUT = {"roll": "x", "pitch": "y", "yaw": "z"}
_RATES = {"rate", "speed"}
_SCALARS = {
    "depth": {"depth", "tiefe"},
    "pressure": {"pressure", "press", "druck"},
    "dvl_altitude": {"altitude", "altimeter", "alt", "range", "height", "hoehe", "höhe"},
    "fix_lat": {"lat", "latitude", "breite", "breitengrad"},
    "fix_lon": {"lon", "lng", "longitude", "länge", "laenge", "längengrad"},
    "fix_north": {"north", "northing"},
    "fix_east": {"east", "easting"},
}
_TIME = {"time", "timestamp", "stamp", "t", "utc", "clock", "epoch", "zeit", "uhrzeit", "tow", "itow", "sow"}
_DAY = {"date", "datum", "week"}  # of times beside it
_IMU = {"imu", "ahrs", "ins", "xsens", "vn", "vectornav", "microstrain", "mti"}
_DVL = {"dvl", "bt", "btm", "bottom"}
_WATER = {"water", "wt"}
_FIX = {"fix", "usbl", "gps", "gnss", "position", "pos", "horizontal"}
_SD = {"sd", "std", "sigma", "fom", "accuracy"}
_VALID = {"valid", "lock"}
_NOT_DVL = {"gps", "gnss", "local", "ned", "enu", "global", "north", "east", "wind", "ground", "sound", "air"}
_DERIVED = {
    **dict.fromkeys(("bias", "offset", "scale", "noise", "temperature", "temp", "cov", "covariance", "variance", "var"),
                    "describes an instrument or its errors"),
    **dict.fromkeys(("setpoint", "desired", "target", "cmd", "command", "reference", "ref"), "a command"),
    **dict.fromkeys(("truth", "groundtruth", "ekf", "kf", "filter", "filtered", "estimate", "estimated", "odom",
                     "odometry"), "an estimate"),
    **dict.fromkeys(("delta", "increment", "error", "err"), "not a measurement that a log has"),
    **dict.fromkeys(("orientation", "quaternion", "quat", "q"), "a quaternion; write roll, pitch and yaw"),
}  # fmt: skip


@dataclass(frozen=True)
class Meaning:
    """The meaning of a name.

    Attributes
    ----------
    field : column of a log, "" = none
    source : the other words, which distinguish instruments
    unit : that the name states, a key of `UNITS`; "" = none
    why : what the field follows from, or why there is no field
    assumed : what the name leaves open, "" = nothing
    backwards : it is of an axis to port or upwards
    enu : its axes are east, north, up
    """

    field: str
    source: str
    unit: str
    why: str
    assumed: str = ""
    backwards: bool = False
    enu: bool = False


def meaning(written: str) -> Meaning:
    """The meaning of a column's name.

    >>> meaning("RAW_IMU.xacc").field, meaning("Gyro X [deg/s]").unit, meaning("depth_mm").unit
    ('acc_x', 'deg/s', 'mm')
    """
    plain, bracket = name_and_bracket(written)
    if is_column(plain):
        return _with_unit(plain, "", bracket, OWN_NAME)
    words = _words(plain)
    whole = (_field(words), words, bracket)
    for count in (3, 2, 1) if not bracket else ():  # a unit that ends the name: acc_x_m_s2
        field = _field(words[:-count])
        unit = _unit_of_words(field, words[-count:])
        if unit:
            whole = field, words[:-count], unit
            break
    field, words, unit = whole
    if not field:
        return Meaning("", "", "", _refusal(words))
    said = set(words)
    return replace(
        _with_unit(field, _source(words), unit, "by name"),
        assumed=_assumption(field, said),
        backwards=bool(said & _BACKWARDS),
        enu="enu" in said,
    )


def _with_unit(field: str, source: str, unit: str, why: str) -> Meaning:
    if not unit:
        return Meaning(field, source, "", why)
    quantity = quantities().get(field)
    known = None if quantity is None else known_unit(quantity, unit)
    if quantity is not None and known is None:
        return Meaning("", "", "", f"looks like {field}, in the unknown unit {unit!r}")
    return Meaning(field, source, known or "", why)


def _unit_of_words(field: str, words: Sequence[str]) -> str:
    """The unit that words mean beside a column of a log, "" = none."""
    quantity = quantities().get(field)
    if quantity is None:
        return ""
    return next((unit for sign in ("", "/") if (unit := known_unit(quantity, sign.join(words)))), "")


def _assumption(field: str, words: set[str]) -> str:
    """What is assumed of a column beside its name, "" = nothing."""
    if field.startswith("dvl_v") and not words & _DVL:
        return "taken for a DVL's, along its own axes"
    if field == "dvl_altitude" and not words & _DVL:
        return "taken for the height above the bottom"
    if field in ("fix_north", "fix_east") and not words & _FIX:
        return "taken for a position fix"
    if field in ("heading", "ahrs_yaw", "dvl_heading") and words & {"true", "hdt"}:
        compass = {"heading": "vehicle", "ahrs_yaw": "ahrs", "dvl_heading": "dvl"}[field]
        return f"relative to true north by its name: state heading.{compass}_reference: true"
    return ""


def _words(name: str) -> list[str]:
    """Words in small letters, glued axes apart."""
    out: list[str] = []
    for piece in (found.lower() for found in _PIECES.findall(name)):
        if len(piece) > 1 and piece[-1] in "xyz" and piece[:-1] in _GLUED:
            out += [_SINGLE.get(piece[:-1], piece[:-1]), piece[-1]]
        elif len(piece) > 2 and piece[0] in "xyz" and piece[1:] in _GLUED:
            out += [piece[1:], piece[0]]
        elif piece[-5:] == "speed" and piece[:-5] in _ABOUT:  # MAVLink's rollspeed
            out += [piece[:-5], "speed"]
        else:
            out.append(piece)
    return out


def _field(words: Collection[str]) -> str:
    """The column of a log that words mean, "" = none."""
    has = set(words).intersection
    if has(_SD) and not has(_AXES):
        return "dvl_sd" if has(_DVL) else "fix_sd" if has(_FIX) else ""
    if has(_DERIVED) or has(_SD):
        return ""
    if has(_VALID):
        return "dvl_valid" if has(_DVL | _VELOCITY) else ""
    if has(_TIME):
        return "time"
    if has(_DAY):
        return DATE
    angle = next((_ANGLES[word] for word in words if word in _ANGLES), "")
    axis = next((_AXES[word] for word in reversed(list(words)) if word in _AXES), "")
    if angle and has(_RATES):
        return f"gyr_{_ABOUT[angle]}"
    if angle:
        return _attitude(angle, set(words))
    return (_vector(axis, set(words)) if axis else "") or _scalar(set(words))


def _attitude(angle: str, words: set[str]) -> str:
    if words & _IMU:
        return f"ahrs_{angle}"
    if words & _DVL:
        return "dvl_heading" if angle == "yaw" else ""
    return "heading" if angle == "yaw" else angle


def _vector(axis: str, words: set[str]) -> str:
    if "angular" in words:
        return "" if words & _ACC else f"gyr_{axis}"
    for group, known in (("mag", _MAG), ("gyr", _GYR), ("acc", _ACC)):
        if words & known:
            return f"{group}_{axis}"
    if words & (_VELOCITY | _DVL) and not words & _NOT_DVL:
        return f"dvl_water_v{axis}" if words & _WATER else f"dvl_v{axis}"
    return ""


def _scalar(words: set[str]) -> str:
    if words & _VELOCITY or words & _ACC:
        return ""
    return next((field for field, known in _SCALARS.items() if words & known), "")


def _source(words: Collection[str]) -> str:
    """The words of a name beside quantity and axis."""
    spoken = {
        "enu",
        *_AXES,
        *_ACC,
        *_GYR,
        *_MAG,
        *_VELOCITY,
        *_ANGLES,
        *_RATES,
        *_SD,
        *_VALID,
        "angular",
        "linear",
        "field",
    }
    spoken = spoken.union({"g", "m"}, *_SCALARS.values())
    return " ".join(word for word in words if word not in spoken)


def _refusal(words: Collection[str]) -> str:
    return next((_DERIVED[word] for word in words if word in _DERIVED), "its name says nothing that a log has")
