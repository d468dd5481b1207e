"""ArduPilot's own logs, DataFlash ``.BIN``, which a vehicle with ArduSub records on board: each sensor's values in SI.

Fields and their meaning: https://ardupilot.org/sub/docs/logmessages.html. Vectors are along the vehicle's axes,
forward, starboard, down: ArduPilot turns its sensors' values by their orientation.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rovgraph.dates import unix_of_gps
from rovgraph.errors import InputError
from rovgraph.geometry import Array, wrap_angle
from rovgraph.log.disk_columns import computed, every, holds, in_pieces, steps
from rovgraph.readers.ardupilot import (
    BODY,
    CLOCK,
    EARTH_FIELD_UT,
    MAGNETIC,
    NO_DILUTION,
    ONE_POINT,
    RANGE_SD_M,
    SPEED_ESTIMATE_AXES,
    declination,
    new_fixes,
    one_point,
    settings,
    thrusters,
    water_settings,
)
from rovgraph.readers.dataflash_messages import FMT, HEAD, INSTANCE, Contents, DataflashMessages, read_messages, texts
from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.recording import (
    Channel,
    Clock,
    Left,
    Recording,
    SourceMissing,
    in_files,
    preferred_first,
    too_slow,
)
from rovgraph.readers.stamps import longest_boot

DOWN, GOOD = 25, 4  # a rangefinder's orientation and status
FIX_3D = 3
LATE_S = 1.0  # a sample's own stamp is at most so much before its message
SOME = 10_000  # values enough for a judgement

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
    """Warnings and settings beside the channels.

    Attributes
    ----------
    notes, warnings : a sentence each
    undeclared : fields without a unit in the log
    environment, depth : of the configuration
    left : number of messages that were left, by name and reason
    """

    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    undeclared: set[str] = field(default_factory=set)
    environment: dict[str, float] = field(default_factory=dict)
    depth: dict[str, float] = field(default_factory=dict)
    left: Counter[tuple[str, str]] = field(default_factory=Counter)


@dataclass(frozen=True)
class DataflashSource:
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
    messages: DataflashMessages
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

    def time(self, counter: str = "", documented: float = 1e-6) -> Array:
        """Stamps [s] of messages `in_seconds`, shape (n,): a sample's own, a counter of 32 bits, where there is one."""
        time: Array = self.messages.fields["TimeUS"]
        if counter not in self.messages:
            return time
        stamp = self.si(counter, documented)
        some = max(len(stamp) // SOME, 1)
        tick = float(np.median(every(stamp, some) / np.maximum(every(self.messages.fields[counter], some), 1.0)))
        if not tick > 0.0:
            return time

        def sampled(time: Array, stamp: Array) -> Array:
            late = time - stamp
            np.mod(late, 2.0**32 * tick, out=late)
            late[~(late < LATE_S)] = 0.0
            return time - late

        return computed(sampled, time, stamp)

    def where(self, keep: NDArray[np.bool_], why: str) -> "DataflashSource":
        """Some of them; the others are counted."""
        if keep.all():
            return self
        self.findings.left[self.label, why] += int((~keep).sum())
        return replace(self, messages=self.messages.take(keep))

    def quietly(self) -> "DataflashSource":
        """The same without warnings: an alternative that may not be used."""
        return replace(self, findings=Findings())

    def channel(self, sensor: str, columns: Mapping[str, Array], fields: str, frame: str = "") -> Channel:
        return Channel(sensor, columns, f"{self.label}: {fields}", frame, CLOCK)


def in_seconds(name: str, messages: DataflashMessages, findings: Findings) -> DataflashMessages:
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


def imu(source: DataflashSource) -> Channel | None:
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


def magnetometer(source: DataflashSource) -> Channel | None:
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
        _less(values, *(every(offset, some) for offset in of_axis))
        for values, of_axis in zip(sampled, offsets, strict=True)
    ])  # fmt: skip
    said = f"{source.label}: magnitude {as_logged:.0f} uT with the autopilot's offsets, {raw:.0f} uT without"
    if not low <= as_logged <= high and low <= raw <= high:
        field_ = [computed(_less, values, *of_axis) for values, of_axis in zip(field_, offsets, strict=True)]
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


def attitude(source: DataflashSource) -> Channel | None:
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


def barometer(source: DataflashSource) -> Channel | None:
    """BARO: pressure; what the autopilot states of surface and water goes into the configuration."""
    found, warnings = water_settings(source.instance, source.parameters)
    source.findings.depth |= found
    source.findings.warnings += warnings
    return source.channel("depth", {"time": source.time("SMS", 1e-3), "pressure": source.si("Press")}, "Press")


def rangefinder(source: DataflashSource) -> Channel | None:
    """RFND: altitude of one that looks down."""
    good = source.raw("Orient") == DOWN
    for status in ("Stat", "Status"):
        good &= source.raw(status) == GOOD if status in source else True
    source = source.where(good, "not downwards, or no echo")
    return source.channel("dvl_altitude", {"time": source.time(), "dvl_altitude": source.si("Dist")}, "Dist")


def odometry(source: DataflashSource) -> Channel | None:
    """VISO: a DVL's velocity is its way over its own interval, which is that of the interval's middle."""
    time, interval = source.time(), _interval(source)
    delta = np.column_stack([source.si(f"PosD{axis}") for axis in _XYZ])
    valid = (interval > 0.0) & np.isfinite(delta).all(axis=1)
    if "conf" in source:
        valid &= source.raw("conf") > 0.0
    velocity = delta / np.where(valid, interval, np.nan)[:, None]
    columns = _dvl(time - 0.5 * np.where(valid, interval, 0.0), velocity, valid)
    return source.channel("dvl", columns, "PosDX, PosDY, PosDZ over dt", BODY)


def _interval(source: DataflashSource) -> Array:
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


def velocity_estimate(source: DataflashSource) -> Channel | None:
    """VISV: velocities that a companion sends, along axes that the log does not state."""
    velocity = np.column_stack([source.si(f"V{axis}") for axis in _XYZ])
    columns = _dvl(source.time(), velocity, np.asarray(np.isfinite(velocity).all(axis=1)))
    return source.channel("dvl", columns, "VX, VY, VZ", BODY)


def _dvl(time: Array, velocity: Array, valid: NDArray[np.bool_]) -> dict[str, Array]:
    named = {f"dvl_v{axis}": np.where(valid, velocity[:, k], np.nan) for k, axis in enumerate("xyz")}
    return {"time": time, **named, "dvl_valid": valid.astype(float)}


def fixes(source: DataflashSource) -> Channel | None:
    """GPS: new fixes in three dimensions."""
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


def drive(source: DataflashSource) -> Channel | None:
    """RCOU: pulse widths of the outputs."""
    outputs = {int(name[1:]): source.raw(name) for name in source.messages.fields if name[1:].isdecimal()}
    columns = thrusters(outputs, source.parameters)
    if not columns:
        source.where(
            np.zeros(len(source.messages), dtype=bool), "no SERVOn_FUNCTION says which motor each output drives"
        )
        return None
    return source.channel("thruster", {"time": source.time(), **columns}, f"outputs of motors 1 to {len(columns)}")


RTC_SD_S = {0: 0.2, 1: 1.0, 2: 2.0}  # by where the clock was set from: GPS, a ground station, a battery
GPS_SD_S = 0.2  # a fix reaches the autopilot so late


@dataclass(frozen=True)
class Kind:
    """Messages that a sensor's measurements come from.

    Attributes
    ----------
    sensor : name of its stream in a log
    names : of the messages; where a log has one message per instance, in the order of instances
    channel : makes a channel of one instance
    required, optional : fields
    """

    sensor: str
    names: tuple[str, ...]
    channel: Callable[[DataflashSource], Channel | None]
    required: tuple[str, ...]
    optional: tuple[str, ...] = ()


_IMU = ("AccX", "AccY", "AccZ", "GyrX", "GyrY", "GyrZ")
_OFFSETS = ("OfsX", "OfsY", "OfsZ", "MOX", "MOY", "MOZ")
KINDS = (
    Kind("imu", ("IMU", "IMU2", "IMU3"), imu, _IMU, ("GH", "AH")),
    Kind("mag", ("MAG", "MAG2", "MAG3"), magnetometer, ("MagX", "MagY", "MagZ"), ("Health", "S", *_OFFSETS)),
    Kind("ahrs", ("ATT",), attitude, ("Roll", "Pitch", "Yaw")),
    Kind("ahrs", ("AHR2",), attitude, ("Roll", "Pitch", "Yaw")),
    Kind("depth", ("BARO", "BAR2", "BAR3"), barometer, ("Press",), ("SMS",)),
    Kind("dvl", ("VISO",), odometry, ("dt", "PosDX", "PosDY", "PosDZ"), ("conf",)),
    Kind("dvl", ("VISV",), velocity_estimate, ("VX", "VY", "VZ")),
    Kind("dvl_altitude", ("RFND",), rangefinder, ("Dist", "Orient"), ("Stat", "Status")),
    Kind("fix", ("GPS", "GPS2"), fixes, ("Status", "GMS", "GWk", "HDop", "Lat", "Lng")),
    Kind("thruster", ("RCOU",), drive, (), tuple(f"C{k}" for k in range(1, 15))),
)
_WANTED = {name: ("TimeUS", *kind.required, *kind.optional, *INSTANCE) for kind in KINDS for name in kind.names} | {
    "PARM": ("Name", "Value"),
    "MSG": ("TimeUS", "Message"),
    "RTC": ("TimeUS", "Epoch", "SourceType"),
}


class DataFlash:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "dataflash"
    title = "ArduPilot DataFlash log (.BIN)"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        first = HEAD + bytes([FMT])
        return 1.0 if head.startswith(first) else 0.7 if head.count(first) >= 3 else 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        contents = read_messages(path, _WANTED, {"IMU": _imu_instance(options.choose)}, options.progress)
        findings = Findings()
        _count_other_imus(path, contents, findings)
        findings.left |= {(name, "of another format of that name"): n for name, n in contents.unlike.items()}
        messages = _one_boot(contents, findings)
        parameters = _parameters(messages.pop("PARM", None), findings)
        clock = _clock(messages)
        firmware = _firmware(messages.pop("MSG", None))
        made = _channels(path, messages, parameters, findings, options.choose)
        if not made:
            raise InputError(f"{path}: holds no measurement of a sensor ({_summary(contents)}); copy the file again")
        findings.notes[:0] = firmware
        _describe(contents, made, findings)
        known, unknown = settings({channel.sensor for channel in made}, parameters)
        environment = known.get("environment", {}) | findings.environment
        return Recording(
            str(path),
            self.name,
            tuple(made),
            {CLOCK: clock},
            _left(contents, findings),
            known | {name: of for name, of in (("environment", environment), ("depth", findings.depth)) if of},
            tuple(findings.notes),
            (*findings.warnings, *unknown),
        )


FORMAT = DataFlash()


def _imu_instance(choose: Mapping[str, str]) -> int | None:
    """The IMU that is read, None = the first: one alone, since they may fill most of a log."""
    wanted = choose.get("imu", "").rpartition(" ")[2]
    return int(wanted) if wanted.isdecimal() else None


def _count_other_imus(path: Path, contents: Contents, findings: Findings) -> None:
    """Report the other IMUs.

    Raises
    ------
    SourceMissing : that which was chosen is not there
    """
    known = ", ".join(f"IMU {k}" for k in sorted(contents.instances.get("IMU", ())))
    kept = len(contents.messages.get("IMU", ()))
    if known and not kept:
        raise SourceMissing(f"{path}: the imu that was chosen is not there; choose one of: {known}", "imu")
    if others := contents.counts["IMU"] - kept - contents.unlike["IMU"]:
        findings.left["IMU", f"of another instance; choose one of: {known}"] = others


def _one_boot(contents: Contents, findings: Findings) -> dict[str, DataflashMessages]:
    """The longest part of the log in which time increases, by the messages that are most frequent.

    Places are forgotten, which nothing else needs.
    """
    messages, places = contents.messages, dict(contents.places)
    contents.places.clear()
    timed = [name for name, m in messages.items() if "TimeUS" in m]
    if not timed:
        return messages
    densest = max(timed, key=lambda name: len(messages[name]))
    place, time = places[densest], messages[densest].fields["TimeUS"]
    if len(steps(place, lambda step: step < 0)):  # several types of messages of that name
        order = np.argsort(place, kind="stable")
        place, time = place[order], time[order]
    if not len(steps(time, lambda step: ~(step >= 0.0))):
        return messages
    scale = messages[densest].multipliers["TimeUS"] if messages[densest].units["TimeUS"] else 1e-6
    first, end, resets = longest_boot(place, time * scale)
    if not resets:
        return messages
    findings.warnings.append(f"the autopilot restarted {resets} times in the log; the longest run is read")
    kept = {"PARM": messages["PARM"]} if "PARM" in messages else {}
    for name, m in messages.items():
        within = computed(lambda place: (place >= first) & (place < end), places[name])
        if name not in kept and within.any():
            kept[name] = m.take(within)
    return kept


def _parameters(messages: DataflashMessages | None, findings: Findings) -> dict[str, float]:
    """The autopilot's parameters as they were first; a calibration during the dive repeats some."""
    if messages is None or "Name" not in messages or "Value" not in messages:
        findings.warnings.append("the log holds no parameters: declination, surface pressure and motors are not known")
        return {}
    first: dict[str, float] = {}
    changed = {}
    for name, value in zip(texts(messages.fields["Name"]), messages.fields["Value"].tolist(), strict=True):
        if np.isfinite(value) and first.setdefault(name, value) != value:
            changed[name] = value
    primary = int(first.get("BARO_PRIMARY", 0)) + 1
    used = {"COMPASS_DEC", "BARO_PRIMARY", "BARO_SPEC_GRAV", "BARO_GND_PRESS", f"BARO{primary}_GND_PRESS"}
    for name, value in ((name, value) for name, value in changed.items() if name in used):
        findings.notes.append(f"{name} changes from {first[name]:.6g} to {value:.6g} in the log; the first is used")
    return first


def _channels(
    path: Path,
    messages: dict[str, DataflashMessages],
    parameters: Mapping[str, float],
    findings: Findings,
    choose: Mapping[str, str],
) -> list[Channel]:
    """Channels of all sensors, the preferred one of each first; warnings on the others are left out.

    Messages are forgotten where they have become channels, so that a long log is in memory once.
    """
    made = []
    for sensor in dict.fromkeys(kind.sensor for kind in KINDS):
        sources: dict[str, tuple[Kind, DataflashSource]] = {}
        for kind in KINDS:
            if kind.sensor == sensor:
                sources |= {s.label: (kind, s) for s in _sources(kind, messages, parameters, findings)}
        labels = _sea_first(sources, parameters, findings) if sensor == "depth" else list(sources)
        for place, label in enumerate(preferred_first(path, sensor, labels, choose)):
            channel = _channel(*sources.pop(label), quietly=place > 0)
            if channel is not None and len(channel.columns["time"]):
                made.append(in_files(channel))
    return made


def _channel(kind: Kind, source: DataflashSource, quietly: bool) -> Channel | None:
    return kind.channel(source.quietly() if quietly else source)


def _sources(
    kind: Kind, messages: dict[str, DataflashMessages], parameters: Mapping[str, float], findings: Findings
) -> list[DataflashSource]:
    """Instances of a kind of messages, in their order."""
    found = []
    for number, name in enumerate(kind.names):
        if (all_ := messages.pop(name, None)) is None:
            continue
        if lacking := [f for f in ("TimeUS", *kind.required) if f not in all_]:
            findings.left[name, f"its format has no field {', '.join(lacking)}"] = len(all_)
            continue
        all_ = in_seconds(name, all_, findings)
        field = next((f for f in INSTANCE if f in all_), None)
        if field is None:
            found.append(DataflashSource(name, all_, parameters, findings, name, number))
            continue
        numbers = all_.fields[field]
        for instance in sorted({each for (piece,) in in_pieces(numbers) for each in np.unique(piece).tolist()}):
            of_instance = computed(lambda each, instance=instance: each == instance, numbers)
            part = all_ if of_instance.all() else all_.take(of_instance)
            found.append(DataflashSource(name, part, parameters, findings, f"{name} {instance}", instance))
    return found


def _sea_first(
    sources: Mapping[str, tuple[Kind, DataflashSource]], parameters: Mapping[str, float], findings: Findings
) -> list[str]:
    """Barometers, that of the sea first: the primary one, or the one whose pressure varies most."""
    labels = list(sources)
    primary = parameters.get("BARO_PRIMARY")
    named = [label for label in labels if sources[label][1].instance == primary]
    if named or len(labels) < 2:
        return sorted(labels, key=lambda label: label not in named)
    spread = {label: float(np.nan_to_num(sources[label][1].si("Press")).std()) for label in labels}
    best = max(labels, key=spread.__getitem__)
    findings.warnings.append(
        f"no parameter says which of {', '.join(labels)} is in the water: {best} is taken, whose pressure varies most"
    )
    return sorted(labels, key=lambda label: label != best)


def _firmware(messages: DataflashMessages | None) -> list[str]:
    """A note of what wrote the log."""
    said = [] if messages is None or "Message" not in messages else texts(messages.fields["Message"])
    return [f"firmware: {text}" for text in said if text.startswith("Ardu")][:1]


def _describe(contents: Contents, made: list[Channel], findings: Findings) -> None:
    """Warn of what looks wrong with the log."""
    if contents.damaged:
        findings.warnings.append(
            f"{contents.damaged_bytes} bytes in {contents.damaged} places are no messages and are skipped"
        )
    if contents.cut_off:
        text = f"the file ends within a message, of which it has {contents.cut_off} bytes"
        findings.warnings.append(f"{text}: the recording was cut off")
    if findings.undeclared:
        fields = ", ".join(sorted(findings.undeclared))
        findings.notes.append(f"the log declares no unit of {fields}; those of ArduPilot's documentation are taken")
    imu = next((c for c in made if c.sensor == "imu"), None)
    if imu is None:
        findings.warnings.append("no IMU in the log; set the autopilot's LOG_BITMASK to record it")
    else:
        remedy = "set the autopilot's LOG_BITMASK to fast IMU"
        findings.warnings += too_slow(imu.columns["time"], imu.source.partition(":")[0], remedy)
    dvl = next((c for c in made if c.sensor == "dvl"), None)
    if dvl is not None and dvl.source.startswith("VISV"):
        findings.warnings.append(SPEED_ESTIMATE_AXES)


def _clock(messages: Mapping[str, DataflashMessages]) -> Clock:
    """Boot time against UTC, by the autopilot's own clock or by its satellite receiver."""
    rtc, gps = messages.get("RTC"), messages.get("GPS")
    if rtc is not None and all(name in rtc for name in ("TimeUS", "Epoch", "SourceType")):
        rtc = rtc.take(np.isin(rtc.fields["SourceType"], list(RTC_SD_S)))
        if len(rtc):
            boot, unix = (rtc.fields[name][-1] * 1e-6 for name in ("TimeUS", "Epoch"))
            kind = int(rtc.fields["SourceType"][-1])
            return Clock(CLOCK, float(unix - boot), RTC_SD_S[kind], f"RTC, source {kind}")
    if gps is not None and all(name in gps for name in ("TimeUS", "Status", "GMS", "GWk")):
        gps = gps.take(np.logical_and(gps.fields["Status"] >= FIX_3D, gps.fields["GWk"] > 0))
        if len(gps):
            unix = unix_of_gps(gps.fields["GWk"], 1e-3 * gps.fields["GMS"])
            offset = float(np.median(unix - gps.fields["TimeUS"] * 1e-6))
            return Clock(CLOCK, offset, GPS_SD_S, "GPS week and milliseconds")
    return Clock(CLOCK)


_DESCRIBING = {"FMT", "FMTU", "UNIT", "MULT", "PARM", "MSG"}
_REASONS = {
    "VISP": "a position that a companion computed, no measurement",
    "GPA": "of the accuracy of fixes, HDop is used",
    "ACC": "raw samples, IMU is used",
    "GYR": "raw samples, IMU is used",
}


def _left(contents: Contents, findings: Findings) -> tuple[Left, ...]:
    """What the log holds beside measurements, and measurements that were refused."""
    used = {name for kind in KINDS for name in kind.names} | _DESCRIBING | {"RTC"}
    others = [
        Left(n, k, _REASONS.get(n, "no measurement")) for n, k in sorted(contents.counts.items()) if n not in used
    ]
    return (*(Left(name, count, why) for (name, why), count in findings.left.items()), *others)


def _summary(contents: Contents) -> str:
    total = sum(contents.counts.values())
    return f"{total} messages of {len(contents.counts)} kinds, {contents.damaged_bytes} bytes damaged"
