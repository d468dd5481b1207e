"""LSTS IMC logs (``Data.lsf``): the messages that dune exchanges on a vehicle, or on a ship's gateway.

A packet is ``FE54``, number, size, time [s since 1970], source system and entity, destination, the message and a
CRC-16, all low byte first. Only messages whose layout has stayed the same since IMC 5.3 are read. Directions and places
in the device's axes are those that an EvoLogics modem gives (`rovgraph.readers.acoustic_sentences`), stamped when dune
sent them on.

Source: IMC.xml and the drivers of dune, https://github.com/LSTS.
"""

import mmap
import struct
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log.streams import STREAMS, label_number
from rovgraph.readers.acoustic_channels import AXES, places_to_state
from rovgraph.readers.acoustic_sentences import crc16
from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.recording import Channel, Clock, Left, Recording, preferred_first, too_slow
from rovgraph.readers.records import gathered

SYNC, BIG_ENDIAN = b"\x54\xfe", b"\xfe\x54"
HEAD = struct.Struct("<HHHdHBHB")  # sync, number, size, time, source, its entity, destination, its entity
SUM = 2  # bytes
SURE = 2  # packets, each after the other, that nothing else has
PROGRESS = 1 << 20  # bytes
CLOCK, CLOCK_SD_S = "the clock of the computer that logged", 0.01
LONGEST_S = 0.5  # between two samples of acceleration, that is interpolated to a rate's time
POSITION_VALID, ACCURACY_VALID = 0x0004, 0x0020  # bits of a GPS fix
RECKONED = (2, 3)  # types of GPS fixes: by dead reckoning, typed
XYZ_VALID = 0x07
ANOTHER_SIZE = "of another size than their layout has"
USBL_FIX = "UsblFixExtended"
TWICE = "of the same replies as what is used; choose usbl=NAME or fix=NAME"
EVOLOGICS = (
    "taken as x forward, y port, z up of the head, as an EvoLogics modem has them; state usbl.mount_rpy_deg: "
    "[180, 0, 0] if its z is down"
)
ENTITY_INFO, LBL_CONFIG, LBL_BEACON = 3, 203, 202


def _layout(fields: str) -> np.dtype[np.void]:
    return np.dtype([(name, f"<{kind}") for name, kind in (field.split(":") for field in fields.split())])


VECTOR = _layout("device_time:f8 x:f8 y:f8 z:f8")
VELOCITY = _layout("valid:u1 x:f8 y:f8 z:f8")
PLAIN = {  # messages of one size
    200: ("LblRange", _layout("id:u1 range:f4")),
    253: (
        "GpsFix",
        _layout(
            "valid:u2 type:u1 year:u2 month:u1 day:u1 second:f4 lat:f8 lon:f8 height:f4 satellites:u1 course:f4 "
            "speed:f4 hdop:f4 vdop:f4 accuracy:f4 vertical:f4"
        ),
    ),
    254: ("EulerAngles", _layout("device_time:f8 phi:f8 theta:f8 psi:f8 psi_magnetic:f8")),
    256: ("AngularVelocity", VECTOR),
    257: ("Acceleration", VECTOR),
    258: ("MagneticField", VECTOR),
    259: ("GroundVelocity", VELOCITY),
    260: ("WaterVelocity", VELOCITY),
    265: ("Depth", _layout("depth:f4")),
}
NAMED = {  # messages that begin with the name of a target
    898: (
        "UsblAnglesExtended",
        _layout("bearing:f4 elevation:f4 north_bearing:f4 north_elevation:f4 phi:f4 theta:f4 psi:f4 accuracy:f4"),
    ),
    899: (
        "UsblPositionExtended",
        _layout("x:f4 y:f4 z:f4 n:f4 e:f4 d:f4 phi:f4 theta:f4 psi:f4 accuracy:f4"),
    ),
    900: (USBL_FIX, _layout("lat:f8 lon:f8 z_units:u1 z:f4 accuracy:f4")),
}
ACOUSTIC = {kind for kind, _ in NAMED.values()}
WANTED = {*PLAIN, *NAMED, ENTITY_INFO, LBL_CONFIG}


class Sender(NamedTuple):
    """Where messages come from: kind, system, entity, target; "" without one."""

    kind: str
    system: int
    entity: int
    target: str = ""


class MessageSeries(NamedTuple):
    """Messages of one source: their times, increasing, shape (n,), and fields, shape (n,)."""

    time: Array
    values: NDArray[np.void]

    def xyz(self) -> Array:
        """Shape (n, 3)."""
        return np.column_stack([self.values[axis].astype(float) for axis in "xyz"])


class Packet(NamedTuple):
    """A packet whose sum is right: number, time, system, entity, first byte and size of its message."""

    number: int
    time: float
    system: int
    entity: int
    at: int
    size: int


class Imc:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "imc"
    title = "LSTS IMC log (Data.lsf)"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        at = 0
        for _ in range(SURE):
            if head[at : at + len(SYNC)] not in (SYNC, BIG_ENDIAN) or len(head) < at + HEAD.size:
                return 0.0
            order = "<" if head[at : at + len(SYNC)] == SYNC else ">"
            at += HEAD.size + struct.unpack_from(f"{order}H", head, at + 4)[0] + SUM
        return 0.9

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        size, left = path.stat().st_size, Counter[tuple[str, str]]()
        with path.open("rb") as file:
            content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        if content[: len(SYNC)] == BIG_ENDIAN:
            raise InputError(f"{path}: is an IMC log with the high byte first, which is not read; log it again by dune")
        messages = Messages(content, left)
        told = 0
        for packet in _packets(content, left):
            messages.add(packet)
            if packet.at - told > PROGRESS:
                options.progress(told := packet.at, size)
        options.progress(size, size)
        channels, settings, said = _Reader(path, options.choose, messages, left).channels()
        if not channels:
            raise InputError(f"{path}: its messages hold nothing that a log has; log the sensors too")
        lost = tuple(Left(name, count, why) for (name, why), count in sorted(left.items()) if count)
        clocks = {CLOCK: Clock(CLOCK, 0.0, CLOCK_SD_S, "its stamps are Unix time")}
        return Recording(str(path), self.name, tuple(channels), clocks, lost, settings, warnings=tuple(said))


FORMAT = Imc()


def _packets(content: mmap.mmap, left: Counter[tuple[str, str]]) -> Iterator[Packet]:
    """Every packet that is read and whose sum is right."""
    at, end = 0, len(content)
    while (at := content.find(SYNC, at)) >= 0 and at + HEAD.size + SUM <= end:
        _, number, size, time, system, entity, _, _ = HEAD.unpack_from(content, at)
        after = at + HEAD.size + size + SUM
        chained = after == end or content[after : after + len(SYNC)] == SYNC
        if number not in WANTED and chained:
            left["messages", "of other kinds"] += 1
        elif number in WANTED and after <= end and crc16(content[at : after - SUM]) == _sum(content, after):
            yield Packet(number, time, system, entity, at + HEAD.size, size)
        else:
            left["messages", "cut off, or with a wrong sum"] += 1
            after = at + len(SYNC)
        at = after


def _sum(content: mmap.mmap, after: int) -> int:
    return int.from_bytes(content[after - SUM : after], "little")


def _text(content: mmap.mmap | bytes, at: int) -> tuple[str, int]:
    """A text, and the byte behind it."""
    (size,) = struct.unpack_from("<H", content, at)
    return content[at + 2 : at + 2 + size].decode("utf-8", "replace"), at + 2 + size


class Messages:
    """What is read of a file, by its sources.

    Attributes
    ----------
    entities : (system, entity) -> name
    beacons : name, latitude, longitude [rad], depth [m] of each, in the order in which ranges number them
    """

    def __init__(self, content: mmap.mmap, left: Counter[tuple[str, str]]) -> None:
        self._content, self._left = content, left
        self._found: dict[Sender, tuple[array[float], array[int]]] = {}
        self.entities: dict[tuple[int, int], str] = {}
        self.beacons: list[tuple[str, float, float, float]] = []

    def add(self, packet: Packet) -> None:
        """Take a message; one whose size is not that of its layout is counted."""
        end = packet.at + packet.size
        try:
            if packet.number == ENTITY_INFO:
                name, _ = _text(self._content, packet.at + 1)
                self.entities[packet.system, self._content[packet.at]] = name
            elif packet.number == LBL_CONFIG:
                self._take_beacons(self._content[packet.at : end])
            else:
                self._take(packet, end)
        except struct.error:
            self._left["messages", ANOTHER_SIZE] += 1

    def _take(self, packet: Packet, end: int) -> None:
        kind, layout = (PLAIN | NAMED)[packet.number]
        target, at = _text(self._content, packet.at) if packet.number in NAMED else ("", packet.at)
        if end - at == layout.itemsize and np.isfinite(packet.time):
            source = Sender(kind, packet.system, packet.entity, target)
            times, places = self._found.setdefault(source, (array("d"), array("q")))
            times.append(packet.time)
            places.append(at)
        else:
            self._left["messages", ANOTHER_SIZE] += 1

    def _take_beacons(self, data: bytes) -> None:
        found, at = [], 3  # behind what it is for, and how many there are
        for _ in range(struct.unpack_from("<H", data, 1)[0]):
            if struct.unpack_from("<H", data, at)[0] != LBL_BEACON:
                return
            name, at = _text(data, at + 2)
            found.append((name, *struct.unpack_from("<ddf", data, at)))
            at += struct.calcsize("<ddfBBB")
        self.beacons = found or self.beacons

    def count(self, source: Sender) -> int:
        return len(self._found[source][0])

    @property
    def sources(self) -> list[Sender]:
        """The most frequent first."""
        return sorted(self._found, key=lambda source: -self.count(source))

    def rows(self, source: Sender) -> MessageSeries:
        """The messages of a source, one at a time."""
        times, places = self._found[source]
        layout = next(layout for kind, layout in (PLAIN | NAMED).values() if kind == source.kind)
        values, _ = gathered(self._content, layout, places, [layout.itemsize] * len(places), layout.itemsize)
        time, first = np.unique(np.array(times), return_index=True)
        return MessageSeries(time, values[first])

    def of(self, kind: str) -> list[Sender]:
        """Sources of a kind, the most frequent first."""
        return [source for source in self.sources if source.kind == kind]

    def label(self, source: Sender) -> str:
        """A name of a source, as options choose it."""
        if source.target:
            return f"{source.kind} {source.target}"
        return f"{source.kind} {self.entities.get((source.system, source.entity), source.entity)}"


class _Reader:
    """Makes the channels of one system, and of what is known of it by sound."""

    def __init__(
        self, path: Path, choose: Mapping[str, str], messages: Messages, left: Counter[tuple[str, str]]
    ) -> None:
        self.path, self.choose, self.messages, self.left = path, choose, messages, left
        counts = Counter[int]()
        for source in messages.sources:
            counts[source.system] += messages.count(source) * (source.kind not in ACOUSTIC)
        self.own = counts.most_common(1)[0][0] if counts else -1
        for source in messages.sources:
            if source.kind not in ACOUSTIC and source.system != self.own:
                left[messages.label(source), "of another system than the one that logged"] += messages.count(source)
        self.on_vehicle = any(self._own(kind) for kind in ("Depth", "GroundVelocity", "AngularVelocity"))

    def channels(self) -> tuple[list[Channel], dict[str, Any], list[str]]:
        """Channels, settings for them, and what may be wrong."""
        out = self._vehicle() if self.on_vehicle else self._ship()
        settings: dict[str, Any] = {}
        said: list[str] = []
        for channel in out:
            if channel.sensor == "imu":
                said += too_slow(channel.columns["time"], channel.source, "have dune log every sample of its IMU")
        fixes, replies = self._fixes(), self._usbl()
        by_sound = [channel for channel in fixes if channel.source.startswith(USBL_FIX)]
        if replies and by_sound:
            unused = by_sound if "usbl" in self.choose else replies
            for channel in unused:
                self.left[channel.source, TWICE] += len(channel.columns["time"])
            if "usbl" in self.choose:
                fixes = [channel for channel in fixes if not channel.source.startswith(USBL_FIX)]
            else:
                replies = []
        if replies:
            settings["usbl"] = {"head": "vehicle" if self.on_vehicle else "ship", "stamp": "arrival"}
            said.append(f"{replies[0].source}: {EVOLOGICS}")
        ranges = [self._channel("range", source, self._range(source)) for source in self._own("LblRange")]
        if ranges and self.messages.beacons:
            degrees = [(str(k), *np.rad2deg(at[1:3]).tolist(), at[3]) for k, at in enumerate(self.messages.beacons)]
            said.append(places_to_state("LblConfig", degrees))
        if self._is_true_north():
            settings["heading"] = {"ahrs_reference" if self._own("AngularVelocity") else "vehicle_reference": "true"}
        return [*out, *replies, *ranges, *fixes], settings, said

    def _own(self, kind: str) -> list[Sender]:
        return [source for source in self.messages.of(kind) if source.system == self.own]

    def _chosen(self, sensor: str, kind: str) -> list[Sender]:
        """Own sources of a kind, the preferred one first."""
        by_label = {self.messages.label(source): source for source in self._own(kind)}
        return [by_label[label] for label in preferred_first(self.path, sensor, list(by_label), self.choose)]

    def _channel(self, sensor: str, source: Sender, columns: Mapping[str, Array], frame: str = "") -> Channel:
        return Channel(sensor, columns, self.messages.label(source), frame, CLOCK)

    # of the vehicle

    def _vehicle(self) -> list[Channel]:
        out = []
        frame = "as dune has turned them into the vehicle's"
        for source in self._chosen("imu", "AngularVelocity"):
            if columns := self._inertial(source):
                out.append(self._channel("imu", source, columns, frame))
        for sensor, kind in (("mag", "MagneticField"), ("dvl", "GroundVelocity"), ("dvl_water", "WaterVelocity")):
            for source in self._chosen(sensor, kind):
                rows = self.messages.rows(source)
                valid = True if sensor == "mag" else rows.values["valid"] & XYZ_VALID == XYZ_VALID
                xyz = np.where(np.broadcast_to(valid, len(rows.time))[:, None], rows.xyz(), np.nan)
                columns = {"time": rows.time, **dict(zip(STREAMS[sensor][:3], xyz.T, strict=True))}
                if sensor == "dvl":
                    columns["dvl_valid"] = np.asarray(valid, float)
                out.append(self._channel(sensor, source, columns, frame))
        for source in self._chosen("depth", "Depth"):
            rows = self.messages.rows(source)
            out.append(self._channel("depth", source, {"time": rows.time, "depth": rows.values["depth"].astype(float)}))
        return out + self._attitude("ahrs" if any(channel.sensor == "imu" for channel in out) else "vehicle_heading")

    def _inertial(self, source: Sender) -> dict[str, Array]:
        """Rates, and acceleration of the same entity at their times; {} without."""
        force = next((s for s in self._own("Acceleration") if s.entity == source.entity), None)
        if force is None:
            return {}
        rate, acc = self.messages.rows(source), self.messages.rows(force)
        after = np.searchsorted(acc.time, rate.time).clip(1, max(len(acc.time) - 1, 1))
        inside = (rate.time >= acc.time[0]) & (rate.time <= acc.time[-1])
        if len(acc.time) > 1:
            inside &= acc.time[after] - acc.time[after - 1] <= LONGEST_S
        at = rate.time[inside]
        columns = {f"acc_{axis}": np.interp(at, acc.time, acc.values[axis].astype(float)) for axis in "xyz"}
        columns |= {f"gyr_{axis}": rate.values[axis][inside].astype(float) for axis in "xyz"}
        return {"time": at, **columns} if inside.any() else {}

    def _attitude(self, sensor: str) -> list[Channel]:
        out = []
        for source in self._chosen(sensor, "EulerAngles"):
            rows = self.messages.rows(source)
            roll, pitch, yaw = (rows.values[name].astype(float) for name in ("phi", "theta", "psi"))
            if sensor == "ahrs":
                columns = {"time": rows.time, "ahrs_yaw": yaw, "ahrs_roll": roll, "ahrs_pitch": pitch}
                out.append(self._channel("ahrs", source, columns))
                continue
            tilt, turn = ("vehicle_tilt", "heading") if self.on_vehicle else ("ship_tilt", "ship_heading")
            names = ("roll", "pitch") if self.on_vehicle else ("ship_roll", "ship_pitch")
            out.append(self._channel(sensor, source, {"time": rows.time, turn: yaw}))
            out.append(self._channel(tilt, source, {"time": rows.time, names[0]: roll, names[1]: pitch}))
        return out

    def _is_true_north(self) -> bool:
        """Whether the vehicle's first attitude tells both norths apart: drivers copy one into the other."""
        for source in self._own("EulerAngles")[:1]:
            values = self.messages.rows(source).values
            return self.on_vehicle and bool((values["psi"] != values["psi_magnetic"]).any())
        return False

    # of a ship

    def _ship(self) -> list[Channel]:
        out = [
            self._channel("ship", source, {k.replace("fix", "ship"): v for k, v in self._gps(source).items()})
            for source in self._own("GpsFix")
        ]
        return out + self._attitude("ship_heading")

    # by sound, and by satellites

    def _usbl(self) -> list[Channel]:
        sources = [*self.messages.of("UsblPositionExtended"), *self.messages.of("UsblAnglesExtended")]
        by_label = {self.messages.label(source): source for source in sources}
        made = []
        for label in preferred_first(self.path, "usbl", list(by_label), self.choose):
            source = by_label[label]
            rows = self.messages.rows(source)
            sd, beacon = rows.values["accuracy"].astype(float), label_number(source.target or "0")
            valid = np.isfinite(sd) & (sd >= 0.0)
            columns = {"time": rows.time[valid], "usbl_beacon": np.full(int(valid.sum()), beacon)}
            if source.kind == "UsblPositionExtended":
                x, y, z = rows.xyz()[valid].T
                columns |= {"usbl_x": x, "usbl_y": -y, "usbl_z": -z}
            else:
                columns |= {f"usbl_{of}": -rows.values[of][valid].astype(float) for of in ("bearing", "elevation")}
                columns["usbl_angle_sd"] = np.where(sd[valid] > 0.0, sd[valid], np.nan)
            if valid.any():
                made.append(self._channel("usbl", source, columns, AXES["transducer"]))
        return made

    def _range(self, source: Sender) -> dict[str, Array]:
        rows = self.messages.rows(source)
        beacon, distance = (rows.values[name].astype(float) for name in ("id", "range"))
        return {"time": rows.time, "range": distance, "range_beacon": beacon}

    def _gps(self, source: Sender) -> dict[str, Array]:
        rows = self.messages.rows(source)
        valid = (rows.values["valid"] & POSITION_VALID > 0) & ~np.isin(rows.values["type"], RECKONED)
        values = rows.values[valid]
        sd = np.where(values["valid"] & ACCURACY_VALID > 0, values["accuracy"].astype(float), np.nan)
        lat, lon = (np.rad2deg(values[name].astype(float)) for name in ("lat", "lon"))
        return {"time": rows.time[valid], "fix_lat": lat, "fix_lon": lon, "fix_sd": np.where(sd > 0.0, sd, np.nan)}

    def _fixes(self) -> list[Channel]:
        """Fixes by sound, then by satellites."""
        made = {}
        for source in self.messages.of(USBL_FIX):
            rows = self.messages.rows(source)
            lat, lon = (np.rad2deg(rows.values[name].astype(float)) for name in ("lat", "lon"))
            sd = rows.values["accuracy"].astype(float)
            columns = {"time": rows.time, "fix_lat": lat, "fix_lon": lon, "fix_sd": np.where(sd > 0.0, sd, np.nan)}
            made[self.messages.label(source)] = self._channel("fix", source, columns)
        for source in self._own("GpsFix") if self.on_vehicle else ():
            columns = self._gps(source)
            if len(columns["time"]):
                made[self.messages.label(source)] = self._channel("fix", source, columns)
        return [made[label] for label in preferred_first(self.path, "fix", list(made), self.choose)]
