"""ArduPilot's own logs, DataFlash ``.BIN``: what a vehicle with ArduSub records on board."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rovgraph.errors import InputError
from rovgraph.gps_time import unix_of_gps
from rovgraph.interchange import dataflash_channels as channels
from rovgraph.interchange.alternatives import SourceMissing, preferred_first
from rovgraph.interchange.ardupilot import CLOCK, SPEED_ESTIMATE_AXES, settings
from rovgraph.interchange.dataflash_channels import Findings, Source
from rovgraph.interchange.dataflash_messages import FMT, HEAD, INSTANCE, Contents, Messages, read_messages, texts
from rovgraph.interchange.formats import Options
from rovgraph.interchange.rates import too_slow
from rovgraph.interchange.receiver import longest_boot
from rovgraph.interchange.recording import Channel, Clock, Left, Recording, in_files
from rovgraph.spilling import computed, in_pieces, steps

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
    channel: Callable[[Source], Channel | None]
    required: tuple[str, ...]
    optional: tuple[str, ...] = ()


_IMU = ("AccX", "AccY", "AccZ", "GyrX", "GyrY", "GyrZ")
_OFFSETS = ("OfsX", "OfsY", "OfsZ", "MOX", "MOY", "MOZ")
KINDS = (
    Kind("imu", ("IMU", "IMU2", "IMU3"), channels.imu, _IMU, ("GH", "AH")),
    Kind("mag", ("MAG", "MAG2", "MAG3"), channels.magnetometer, ("MagX", "MagY", "MagZ"), ("Health", "S", *_OFFSETS)),
    Kind("ahrs", ("ATT",), channels.attitude, ("Roll", "Pitch", "Yaw")),
    Kind("ahrs", ("AHR2",), channels.attitude, ("Roll", "Pitch", "Yaw")),
    Kind("depth", ("BARO", "BAR2", "BAR3"), channels.barometer, ("Press",), ("SMS",)),
    Kind("dvl", ("VISO",), channels.odometry, ("dt", "PosDX", "PosDY", "PosDZ"), ("conf",)),
    Kind("dvl", ("VISV",), channels.velocity_estimate, ("VX", "VY", "VZ")),
    Kind("dvl_altitude", ("RFND",), channels.rangefinder, ("Dist", "Orient"), ("Stat", "Status")),
    Kind("fix", ("GPS", "GPS2"), channels.fixes, ("Status", "GMS", "GWk", "HDop", "Lat", "Lng")),
    Kind("thruster", ("RCOU",), channels.drive, (), tuple(f"C{k}" for k in range(1, 15))),
)
_WANTED = {name: ("TimeUS", *kind.required, *kind.optional, *INSTANCE) for kind in KINDS for name in kind.names} | {
    "PARM": ("Name", "Value"),
    "MSG": ("TimeUS", "Message"),
    "RTC": ("TimeUS", "Epoch", "SourceType"),
}


class DataFlash:
    """The format; see `rovgraph.interchange.formats.Format`."""

    name = "dataflash"
    title = "ArduPilot DataFlash log (.BIN)"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        first = HEAD + bytes([FMT])
        return 1.0 if head.startswith(first) else 0.7 if head.count(first) >= 3 else 0.0

    def read(self, path: Path, options: Options) -> Recording:
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
            known | ({"environment": environment} if environment else {}),
            tuple(findings.notes),
            (*findings.warnings, *unknown),
        )


FORMAT = DataFlash()


def _imu_instance(choose: Mapping[str, str]) -> int | None:
    """The IMU that is read, None = the first: one alone, since they may fill most of a log."""
    wanted = choose.get("imu", "").rpartition(" ")[2]
    return int(wanted) if wanted.isdecimal() else None


def _count_other_imus(path: Path, contents: Contents, findings: Findings) -> None:
    """Say which other IMUs there are.

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


def _one_boot(contents: Contents, findings: Findings) -> dict[str, Messages]:
    """The longest part of the log in which time goes on, by the messages that are most frequent.

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


def _parameters(messages: Messages | None, findings: Findings) -> dict[str, float]:
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
    messages: dict[str, Messages],
    parameters: Mapping[str, float],
    findings: Findings,
    choose: Mapping[str, str],
) -> list[Channel]:
    """Channels of all sensors, the preferred one of each first; what is said of the others is left out.

    Messages are forgotten where they have become channels, so that a long log is in memory once.
    """
    made = []
    for sensor in dict.fromkeys(kind.sensor for kind in KINDS):
        sources: dict[str, tuple[Kind, Source]] = {}
        for kind in KINDS:
            if kind.sensor == sensor:
                sources |= {s.label: (kind, s) for s in _sources(kind, messages, parameters, findings)}
        labels = _sea_first(sources, parameters, findings) if sensor == "depth" else list(sources)
        for place, label in enumerate(preferred_first(path, sensor, labels, choose)):
            channel = _channel(*sources.pop(label), quietly=place > 0)
            if channel is not None and len(channel.columns["time"]):
                made.append(in_files(channel))
    return made


def _channel(kind: Kind, source: Source, quietly: bool) -> Channel | None:
    return kind.channel(source.quietly() if quietly else source)


def _sources(
    kind: Kind, messages: dict[str, Messages], parameters: Mapping[str, float], findings: Findings
) -> list[Source]:
    """Instances of a kind of messages, in their order."""
    found = []
    for number, name in enumerate(kind.names):
        if (all_ := messages.pop(name, None)) is None:
            continue
        if lacking := [f for f in ("TimeUS", *kind.required) if f not in all_]:
            findings.left[name, f"its format has no field {', '.join(lacking)}"] = len(all_)
            continue
        all_ = channels.in_seconds(name, all_, findings)
        field = next((f for f in INSTANCE if f in all_), None)
        if field is None:
            found.append(Source(name, all_, parameters, findings, name, number))
            continue
        numbers = all_.fields[field]
        for instance in sorted({each for (piece,) in in_pieces(numbers) for each in np.unique(piece).tolist()}):
            own = computed(lambda each, instance=instance: each == instance, numbers)
            part = all_ if own.all() else all_.take(own)
            found.append(Source(name, part, parameters, findings, f"{name} {instance}", instance))
    return found


def _sea_first(
    sources: Mapping[str, tuple[Kind, Source]], parameters: Mapping[str, float], findings: Findings
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


def _firmware(messages: Messages | None) -> list[str]:
    """A note of what wrote the log."""
    said = [] if messages is None or "Message" not in messages else texts(messages.fields["Message"])
    return [f"firmware: {text}" for text in said if text.startswith("Ardu")][:1]


def _describe(contents: Contents, made: list[Channel], findings: Findings) -> None:
    """Say what looks wrong with the log."""
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


def _clock(messages: Mapping[str, Messages]) -> Clock:
    """Boot time against UTC, by the autopilot's own clock or by its satellite receiver."""
    rtc, gps = messages.get("RTC"), messages.get("GPS")
    if rtc is not None and all(name in rtc for name in ("TimeUS", "Epoch", "SourceType")):
        rtc = rtc.take(np.isin(rtc.fields["SourceType"], list(RTC_SD_S)))
        if len(rtc):
            boot, unix = (rtc.fields[name][-1] * 1e-6 for name in ("TimeUS", "Epoch"))
            kind = int(rtc.fields["SourceType"][-1])
            return Clock(CLOCK, float(unix - boot), RTC_SD_S[kind], f"RTC, source {kind}")
    if gps is not None and all(name in gps for name in ("TimeUS", "Status", "GMS", "GWk")):
        gps = gps.take(np.logical_and(gps.fields["Status"] >= channels.FIX_3D, gps.fields["GWk"] > 0))
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
