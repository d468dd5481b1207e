"""What the messages of a DataFlash log say of each sensor, in SI.

Fields and their meaning: https://ardupilot.org/sub/docs/logmessages.html. Vectors are along the vehicle's axes,
forward, starboard, down: ArduPilot turns what its sensors say by their orientation.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array, wrap_angle
from rovgraph.interchange.ardupilot import BODY, CLOCK, EARTH_FIELD_UT, MAGNETIC, declination, depth_of, thrusters
from rovgraph.interchange.dataflash_messages import Messages
from rovgraph.interchange.fixes import NO_DILUTION, ONE_POINT, RANGE_SD_M, new_fixes, one_point
from rovgraph.interchange.recording import Channel
from rovgraph.spilling import computed, every, holds

DOWN, GOOD = 25, 4  # a rangefinder's orientation and status
FIX_3D = 3
LATE_S = 1.0  # a sample's own stamp is at most so much before its message
SOME = 10_000  # values that something is told by

# unit's label -> factor to SI and radians; a field in microtesla, latitude and longitude in degrees
_SI = {
    "s": 1.0,
    "m": 1.0,
    "m/s": 1.0,
    "m/s/s": 1.0,
    "rad": 1.0,
    "rad/s": 1.0,
    "deg/s": np.pi / 180.0,
    "deg": np.pi / 180.0,
    "degheading": np.pi / 180.0,
    "deglatitude": 1.0,
    "deglongitude": 1.0,
    "Gauss": 100.0,
    "Pa": 1.0,
}
_XYZ = "XYZ"


@dataclass
class Findings:
    """What is said beside the channels.

    Attributes
    ----------
    notes, warnings : a sentence each
    undeclared : fields without a unit in the log
    environment : of the configuration
    left : number of messages that were left, by name and reason
    """

    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    undeclared: set[str] = field(default_factory=set)
    environment: dict[str, float] = field(default_factory=dict)
    left: Counter[tuple[str, str]] = field(default_factory=Counter)


@dataclass(frozen=True)
class Source:
    """The messages of a log that are about one sensor.

    Attributes
    ----------
    name : of the message
    messages : of one instance
    parameters : of the autopilot
    findings : takes what is found on the way
    label : name, and instance where there are several
    instance : counts from 0
    """

    name: str
    messages: Messages
    parameters: Mapping[str, float]
    findings: Findings
    label: str
    instance: int = 0

    def __contains__(self, field_: str) -> bool:
        return field_ in self.messages

    def raw(self, field_: str) -> Array:
        """A field as stored, shape (n,)."""
        return np.asarray(self.messages.fields[field_], dtype=float)

    def si(self, field_: str, documented: float = 1.0) -> Array:
        """A field in SI, shape (n,), in single precision where what is stored has no more digits.

        Parameters
        ----------
        documented : factor that ArduPilot's documentation implies, for logs that declare no unit
        """
        factor = _SI.get(self.messages.units[field_])
        if factor is None:
            self.findings.undeclared.add(f"{self.name}.{field_}")
        stored = self.messages.fields[field_]
        scale = self.messages.multipliers[field_] * (documented if factor is None else factor)
        if stored.dtype.kind == "f" and scale == 1.0 and holds(np.isfinite, stored):
            return stored  # as it is: a copy would be as large
        return computed(lambda values: _scaled(values, scale), stored)

    def time(self, own: str = "", documented: float = 1e-6) -> Array:
        """Stamps [s] of messages `in_seconds`, shape (n,): a sample's own, a counter of 32 bits, where there is one."""
        time: Array = self.messages.fields["TimeUS"]
        if own not in self.messages:
            return time
        stamp = self.si(own, documented)
        some = max(len(stamp) // SOME, 1)
        tick = float(np.median(every(stamp, some) / np.maximum(every(self.messages.fields[own], some), 1.0)))
        if not tick > 0.0:
            return time

        def sampled(time: Array, stamp: Array) -> Array:
            late = time - stamp
            np.mod(late, 2.0**32 * tick, out=late)
            late[~(late < LATE_S)] = 0.0
            return time - late

        return computed(sampled, time, stamp)

    def where(self, keep: NDArray[np.bool_], why: str) -> "Source":
        """Some of them; the others are counted."""
        if keep.all():
            return self
        self.findings.left[self.label, why] += int((~keep).sum())
        return replace(self, messages=self.messages.take(keep))

    def quietly(self) -> "Source":
        """The same, of which nothing is said: an alternative that may not be used."""
        return replace(self, findings=Findings())

    def channel(self, sensor: str, columns: Mapping[str, Array], fields: str, frame: str = "") -> Channel:
        return Channel(sensor, columns, f"{self.label}: {fields}", frame, CLOCK)


def in_seconds(name: str, messages: Messages, findings: Findings) -> Messages:
    """Messages whose stamps are made seconds."""
    declared = messages.units["TimeUS"] == "s"
    if not declared:
        findings.undeclared.add(f"{name}.TimeUS")
    scale = messages.multipliers["TimeUS"] * (1.0 if declared else 1e-6)
    messages.fields["TimeUS"] = computed(lambda time: time.astype(float) * scale, messages.fields["TimeUS"])
    return messages


def _scaled(values: Array, scale: float) -> Array:
    with np.errstate(over="ignore", invalid="ignore"):  # damaged values
        values = values.astype(np.result_type(values, np.float32))
        values *= scale
    values[~np.isfinite(values)] = np.nan
    return values


def imu(source: Source) -> Channel | None:
    """IMU: specific force and rate, board orientation applied."""
    if "GH" in source and "AH" in source:
        health = source.messages.fields["GH"], source.messages.fields["AH"]
        healthy = computed(lambda gyr, acc: (gyr > 0) & (acc > 0), *health)
        source = source.where(healthy, "the autopilot took the IMU for failed")
    columns = {"time": source.time()}
    for axis in _XYZ:
        columns[f"acc_{axis.lower()}"] = source.si(f"Acc{axis}")
        columns[f"gyr_{axis.lower()}"] = source.si(f"Gyr{axis}")
    return source.channel("imu", columns, "AccX, AccY, AccZ, GyrX, GyrY, GyrZ", BODY)


def magnetometer(source: Source) -> Channel | None:
    """MAG: the field with the autopilot's offsets, or without them where these cannot be right."""
    if "Health" in source:
        healthy = computed(lambda health: health > 0, source.messages.fields["Health"])
        source = source.where(healthy, "the autopilot took the compass for failed")
    field_ = [source.si(f"Mag{axis}", 0.1) for axis in _XYZ]
    kinds = [kind for kind in ("Ofs", "MO") if all(f"{kind}{axis}" in source for axis in _XYZ)]
    offsets = [[source.si(f"{kind}{axis}", 0.1) for kind in kinds] for axis in _XYZ]
    some = max(len(source.messages) // SOME, 1)
    low, high = EARTH_FIELD_UT
    sampled = [every(values, some) for values in field_]
    as_logged = _magnitude(sampled)
    raw = _magnitude([
        _less(values, *(every(offset, some) for offset in own)) for values, own in zip(sampled, offsets, strict=True)
    ])  # fmt: skip
    said = f"{source.label}: magnitude {as_logged:.0f} uT with the autopilot's offsets, {raw:.0f} uT without"
    if not low <= as_logged <= high and low <= raw <= high:
        field_ = [computed(_less, values, *own) for values, own in zip(field_, offsets, strict=True)]
        source.findings.warnings.append(f"{said}: the offsets are taken off, as no place on Earth has the first")
    elif not low <= as_logged <= high:
        source.findings.warnings.append(f"{said}: no place on Earth has either; calibrate the magnetometer")
    columns = {"time": source.time("S"), **{f"mag_{axis.lower()}": field_[k] for k, axis in enumerate(_XYZ)}}
    return source.channel("mag", columns, "MagX, MagY, MagZ", BODY)


def _magnitude(field_: list[Array]) -> float:
    """Median of vectors."""
    return float(np.median(np.linalg.norm(np.column_stack(field_), axis=1))) if len(field_[0]) else 0.0


def _less(values: Array, *offsets: Array) -> Array:
    return values - sum(offsets, np.zeros(1, np.float32))


def attitude(source: Source) -> Channel | None:
    """ATT, AHR2: the autopilot's attitude; its heading is true, a log's is magnetic."""
    columns = {
        "time": source.time(),
        "ahrs_roll": source.si("Roll", np.pi / 180.0),
        "ahrs_pitch": source.si("Pitch", np.pi / 180.0),
        "ahrs_yaw": computed(
            lambda yaw: wrap_angle(yaw - declination(source.parameters)), source.si("Yaw", np.pi / 180.0)
        ),
    }
    return source.channel("ahrs", columns, "Roll, Pitch, Yaw", MAGNETIC)


def barometer(source: Source) -> Channel | None:
    """BARO: depth from pressure."""
    pressure = np.asarray(source.si("Press"), dtype=float)
    found, said, good, zero = depth_of(source.instance, pressure, source.parameters, source.label)
    (source.findings.notes if good else source.findings.warnings).append(said)
    return replace(source.channel("depth", {"time": source.time("SMS", 1e-3), "depth": found}, "Press"), zero=zero)


def rangefinder(source: Source) -> Channel | None:
    """RFND: altitude of one that looks down."""
    good = source.raw("Orient") == DOWN
    for status in ("Stat", "Status"):
        good &= source.raw(status) == GOOD if status in source else True
    source = source.where(good, "not downwards, or no echo")
    return source.channel("dvl_altitude", {"time": source.time(), "dvl_altitude": source.si("Dist")}, "Dist")


def odometry(source: Source) -> Channel | None:
    """VISO: a DVL's velocity is its way over its own interval, which is that of the interval's middle."""
    time, interval = source.time(), _interval(source)
    delta = np.column_stack([source.si(f"PosD{axis}") for axis in _XYZ])
    valid = (interval > 0.0) & np.isfinite(delta).all(axis=1)
    if "conf" in source:
        valid &= source.raw("conf") > 0.0
    velocity = delta / np.where(valid, interval, np.nan)[:, None]
    columns = _dvl(time - 0.5 * np.where(valid, interval, 0.0), velocity, valid)
    return source.channel("dvl", columns, "PosDX, PosDY, PosDZ over dt", BODY)


def _interval(source: Source) -> Array:
    """The field dt [s]. ArduPilot declares microseconds and writes seconds: the spacing of the messages decides."""
    declared, stored = source.si("dt"), source.raw("dt")
    spacing = np.diff(source.time())
    usual = float(np.median(spacing[spacing > 0.0])) if (spacing > 0.0).any() else 0.1

    def mismatch(interval: Array) -> float:
        return abs(float(np.log(np.median(interval[interval > 0.0]) / usual))) if (interval > 0.0).any() else np.inf

    if mismatch(stored) < mismatch(declared):
        source.findings.notes.append(f"{source.label}: dt is in seconds, by the spacing of the messages")
        return stored
    return declared


def velocity_estimate(source: Source) -> Channel | None:
    """VISV: velocities that a companion sends, of which nothing says along which axes."""
    velocity = np.column_stack([source.si(f"V{axis}") for axis in _XYZ])
    columns = _dvl(source.time(), velocity, np.asarray(np.isfinite(velocity).all(axis=1)))
    return source.channel("dvl", columns, "VX, VY, VZ", BODY)


def _dvl(time: Array, velocity: Array, valid: NDArray[np.bool_]) -> dict[str, Array]:
    named = {f"dvl_v{axis}": np.where(valid, velocity[:, k], np.nan) for k, axis in enumerate("xyz")}
    return {"time": time, **named, "dvl_valid": valid.astype(float)}


def fixes(source: Source) -> Channel | None:
    """GPS: fixes in three dimensions that say something new."""
    source = source.where(source.raw("Status") >= FIX_3D, "no fix in three dimensions")
    lat, lon = source.si("Lat"), source.si("Lng")
    if (point := one_point(lat, lon)) is not None:
        source.findings.warnings.append(f"{source.label}: {ONE_POINT}")
        source.findings.environment |= {"origin_lat_deg": point[0], "origin_lon_deg": point[1]}
        source.where(np.zeros(len(lat), dtype=bool), "one point that repeats")
        return None
    source = source.where(new_fixes(source.raw("GMS"), lat, lon), "nowhere on Earth, or the one before repeated")
    dilution = source.messages.value("HDop")
    sd = np.where(dilution < NO_DILUTION, RANGE_SD_M * dilution, np.nan)
    columns = {"time": source.time(), "fix_lat": source.si("Lat"), "fix_lon": source.si("Lng"), "fix_sd": sd}
    return source.channel("fix", columns, "Lat, Lng; sd 3 m times HDop")


def drive(source: Source) -> Channel | None:
    """RCOU: pulse widths of the outputs."""
    outputs = {int(name[1:]): source.raw(name) for name in source.messages.fields if name[1:].isdecimal()}
    columns = thrusters(outputs, source.parameters)
    if not columns:
        source.where(
            np.zeros(len(source.messages), dtype=bool), "no SERVOn_FUNCTION says which motor each output drives"
        )
        return None
    return source.channel("thruster", {"time": source.time(), **columns}, f"outputs of motors 1 to {len(columns)}")
