"""Recorded MAVLink messages as a recording: of telemetry logs and of BlueOS."""

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array, wrap_angle
from rovgraph.log.disk_columns import computed, holds, taken
from rovgraph.readers.ardupilot import (
    BODY,
    CLOCK,
    EARTH_FIELD_UT,
    MAGNETIC,
    ONE_POINT,
    SPEED_ESTIMATE_AXES,
    declination,
    new_fixes,
    one_point,
    settings,
    thrusters,
    water_settings,
)
from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.mavlink import OF_PARAMETERS, PRESSURES, SLOW, UNIX_USEC, Gatherer, MavlinkRows, Sender
from rovgraph.readers.recording import (
    SLOWEST_HZ,
    Channel,
    Clock,
    Left,
    Recording,
    in_files,
    preferred_first,
    rate_hz,
    too_slow,
)
from rovgraph.readers.stamps import ReceiverClock, longest_boot, receiver_clock

AUTOPILOT = 1  # component
UNIX = "autopilot's Unix time"
LATENCY_SD_S = 0.05  # of the quickest message of many
IMUS = ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3")  # best first
LATE = {"GPS_RAW_INT", "VISION_POSITION_DELTA", "VISION_SPEED_ESTIMATE"}  # their stamps are not of when they are sent
_REASONS = {
    **dict.fromkeys(IMUS, "zeros: no sensor"),
    "GPS_RAW_INT": "no fix in three dimensions",
    "DISTANCE_SENSOR": "not downwards, or no echo",
    "SERVO_OUTPUT_RAW": "of another port",
    "VISION_POSITION_ESTIMATE": "a position that a companion computed, no measurement",
    "GPS_INPUT": "input of the autopilot; GPS_RAW_INT has its output",
    **dict.fromkeys(OF_PARAMETERS, "parameters, used where they concern a sensor"),
}


def recording(path: Path, format_: str, gatherer: Gatherer, receiver: str, options: ReadingOptions) -> Recording:
    """A recording of all messages that were gathered.

    Parameters
    ----------
    format_ : name of the file's
    receiver : name of the clock of those who received

    Raises
    ------
    InputError : no measurement
    """
    vehicle = _Vehicle(path, gatherer, receiver, options)
    made = [channel for channel in vehicle.channels() if len(channel.columns["time"])]
    if not made:
        total = sum(gatherer.counts.values())
        raise InputError(f"{path}: holds no measurement of a sensor, in {total} messages; record the autopilot's")
    sensors = {channel.sensor: channel for channel in reversed(made)}  # the first of each
    warnings = [*vehicle.warnings, *_imu_warnings(sensors.get("imu"))]
    known, unknown = settings(sensors, vehicle.parameters)
    environment = known.get("environment", {}) | vehicle.environment
    return Recording(
        str(path),
        format_,
        tuple(made),
        vehicle.clocks(made),
        tuple(vehicle.left(gatherer)),
        known | {name: of for name, of in (("environment", environment), ("depth", vehicle.depth)) if of},
        tuple(vehicle.notes),
        (*warnings, *unknown),
    )


def _imu_warnings(imu: Channel | None) -> list[str]:
    if imu is None:
        return ["no IMU in the file; record RAW_IMU, or use the autopilot's own log (.BIN)"]
    measured = computed(np.isfinite, imu.columns["acc_x"])
    return too_slow(taken(imu.columns["time"], measured), imu.source.partition(":")[0], SLOW)


class _Vehicle:
    """One vehicle's messages, and how they become channels."""

    def __init__(self, path: Path, gatherer: Gatherer, receiver: str, options: ReadingOptions) -> None:
        self._rows = gatherer.rows()
        heard: Counter[Sender] = Counter()
        for (sender, *_), rows in self._rows.items():
            heard[sender] += len(rows)
        self.sender = max((s for s in heard if s[1] == AUTOPILOT), key=heard.__getitem__, default=(0, AUTOPILOT))
        self.parameters = gatherer.parameters.get(self.sender, {})
        self.notes: list[str] = []
        self.warnings: list[str] = []
        self.refused: Counter[tuple[str, str]] = Counter()
        self.environment: dict[str, float] = {}
        self.depth: dict[str, float] | None = None  # of the sensor in the water
        self._path, self._receiver, self._choose = path, receiver, options.choose
        self._clock = self._boots()

    def _boots(self) -> ReceiverClock | None:
        """Keep the longest run of the autopilot, and see how the receiver's clock went meanwhile."""
        of_autopilot = [r for (sender, name, _), r in self._rows.items() if sender == self.sender and name not in LATE]
        booted = [r for r in of_autopilot if len(r) and holds(np.isfinite, r.stamp) and r.stamp[-1] < 1e-6 * UNIX_USEC]
        if not booted:
            return None
        dense = max(booted, key=len)
        first, end, resets = longest_boot(dense.place, dense.stamp)
        if resets:
            self.warnings.append(f"the autopilot restarted {resets} times; the longest run is read")
            self._rows = {key: rows.within(first, end) for key, rows in self._rows.items()}
            dense = dense.within(first, end)
        clock = receiver_clock(dense.place, dense.received, dense.stamp)
        if clock.steps:
            steps = ", ".join(f"{step:+.1f} s" for step in clock.steps)
            self.warnings.append(
                f"the clock of the {self._receiver} was set by {steps} meanwhile; what came before is put on the last"
            )
        return clock

    def clocks(self, made: list[Channel]) -> dict[str, Clock]:
        known = {
            self._receiver: Clock(self._receiver, 0.0, 0.0, "its stamps are Unix time"),
            UNIX: Clock(UNIX, 0.0, 0.0, "its stamps are Unix time"),
            CLOCK: Clock(CLOCK),
        }
        if self._clock is not None:
            said = f"least of (received - boot time) by the {self._receiver}"
            known[CLOCK] = Clock(CLOCK, float(self._clock.offset[-1]), LATENCY_SD_S, said)
        used = {c.clock for c in made} | {c.receiver for c in made}
        return {name: clock for name, clock in known.items() if name in used}

    def channels(self) -> Iterator[Channel]:
        """Channels of all sensors, the preferred one of each first."""
        makers = {
            "imu": (self._imus(), self._plain),
            "mag": (self._own("mag"), self._field),
            "ahrs": (self._own("ahrs"), self._attitude),
            "depth": (self._pressures(), self._depth),
            "dvl": (self._anyones("dvl"), self._velocity),
            "dvl_altitude": (self._anyones("dvl_altitude"), self._plain),
            "fix": (self._own("fix"), self._fixes),
            "thruster": (self._own("outputs"), self._thrusters),
        }
        for sensor, (sources, make) in makers.items():
            for place, name in enumerate(preferred_first(self._path, sensor, list(sources), self._choose)):
                counts = len(self.notes), len(self.warnings)
                yield from make(sensor, sources[name])
                if place:  # unused ones get no warning
                    del self.notes[counts[0] :], self.warnings[counts[1] :]

    def _own(self, kind: str) -> dict[str, MavlinkRows]:
        """The autopilot's values of a sensor, by the names of messages, those in `IMUS` in its order."""
        found = {
            name: r for (sender, name, of), r in self._rows.items() if (sender, of) == (self.sender, kind) and len(r)
        }
        return dict(sorted(found.items(), key=lambda each: IMUS.index(each[0]) if each[0] in IMUS else -1))

    def _anyones(self, kind: str) -> dict[str, MavlinkRows]:
        """All senders' values of a sensor, by the names of messages: for each the sender with most of them."""
        found: dict[str, MavlinkRows] = {}
        for (_, name, of), rows in sorted(self._rows.items(), key=lambda each: len(each[1])):
            if of == kind and len(rows):
                found[name] = rows
        return dict(sorted(found.items()))  # a delta goes before an estimate

    def _imus(self) -> dict[str, MavlinkRows]:
        """Inertial units; where the best is too slow, its acceleration with the rates of the attitude, too."""
        found = self._own("imu")
        rates = self._own("rates").get("ATTITUDE")
        best = next(iter(found.values()), None)
        if best is None or rates is None or rate_hz(best.stamp) >= min(SLOWEST_HZ, 0.5 * rate_hz(rates.stamp)):
            return found
        mixed = best.interleaved(("acc_x", "acc_y", "acc_z"), rates)
        self.notes.append(f"{mixed.name}: rates are those of the attitude, with the autopilot's biases taken off")
        return {mixed.name: mixed, **found}

    def _pressures(self) -> dict[str, MavlinkRows]:
        """Pressure sensors, that of the water first."""
        found = self._own("pressure")
        primary = self.parameters.get("BARO_PRIMARY")
        order = ["SCALED_PRESSURE2", "SCALED_PRESSURE3", "SCALED_PRESSURE"]
        if primary is not None and int(primary) in range(len(PRESSURES)):
            order.insert(0, PRESSURES[int(primary)])
        elif len(found) > 1:
            self.notes.append("BARO_PRIMARY is not in the file: an ArduSub's second pressure sensor is in the water")
        return dict(sorted(found.items(), key=lambda each: order.index(each[0])))

    def _timed(self, rows: MavlinkRows) -> tuple[Array, str]:
        """Stamps of rows [s], and the name of their clock; of others than the autopilot: when they were received."""
        stamped = len(rows) and rows.sender == self.sender and holds(np.isfinite, rows.stamp)
        if stamped and rows.stamp[-1] >= 1e-6 * UNIX_USEC:
            return rows.stamp, UNIX
        if stamped and self._clock is not None:
            return rows.stamp, CLOCK
        return self._received(rows), self._receiver

    def _received(self, rows: MavlinkRows) -> Array:
        return rows.received if self._clock is None else computed(self._clock.corrected, rows.place, rows.received)

    def _channel(self, sensor: str, rows: MavlinkRows, columns: Mapping[str, Array], frame: str) -> Channel:
        time, clock = self._timed(rows)
        fields = ", ".join(columns)
        source, received = f"{rows.name}: {fields}", self._received(rows)
        return in_files(Channel(sensor, {"time": time, **columns}, source, frame, clock, received, self._receiver))

    def _plain(self, sensor: str, rows: MavlinkRows) -> Iterator[Channel]:
        yield self._channel(sensor, rows, rows.columns, "" if sensor == "dvl_altitude" else BODY)

    def _field(self, sensor: str, rows: MavlinkRows) -> Iterator[Channel]:
        magnitude = float(np.median(np.linalg.norm(np.column_stack(list(rows.columns.values())), axis=1)))
        low, high = EARTH_FIELD_UT
        if not low <= magnitude <= high:
            self.warnings.append(
                f"{rows.name}: a field of {magnitude:.0f} uT is nowhere on Earth; calibrate the compass"
            )
        yield self._channel(sensor, rows, rows.columns, BODY)

    def _attitude(self, sensor: str, rows: MavlinkRows) -> Iterator[Channel]:
        """The autopilot's heading is true, a log's is magnetic."""
        magnetic = computed(lambda yaw: wrap_angle(yaw - declination(self.parameters)), rows.columns["ahrs_yaw"])
        yield self._channel(sensor, rows, {**rows.columns, "ahrs_yaw": magnetic}, MAGNETIC)

    def _depth(self, sensor: str, rows: MavlinkRows) -> Iterator[Channel]:
        found, warnings = water_settings(PRESSURES.index(rows.name), self.parameters)
        self.depth = found if self.depth is None else self.depth
        self.warnings += warnings
        yield self._channel(sensor, rows, rows.columns, "")

    def _velocity(self, sensor: str, rows: MavlinkRows) -> Iterator[Channel]:
        if rows.name == "VISION_SPEED_ESTIMATE":
            self.warnings.append(SPEED_ESTIMATE_AXES)
        channel = self._channel(sensor, rows, rows.columns, BODY)
        if channel.clock == self._receiver:
            self.notes.append(
                f"{rows.name} comes without a time: its stamps are of its arrival, late by what DVL and network need"
            )
        yield channel

    def _fixes(self, sensor: str, rows: MavlinkRows) -> Iterator[Channel]:
        lat, lon = rows.columns["fix_lat"], rows.columns["fix_lon"]
        if (point := one_point(lat, lon)) is not None:
            self.warnings.append(f"{rows.name}: {ONE_POINT}")
            self.environment |= {"origin_lat_deg": point[0], "origin_lon_deg": point[1]}
            self.refused[rows.name, "one point that repeats"] = len(rows)
            return
        new = new_fixes(rows.stamp, lat, lon)
        if not new.all():
            self.refused[rows.name, "nowhere on Earth, or the one before repeated"] = int((~new).sum())
        fresh = rows.take(new)
        yield self._channel(sensor, fresh, fresh.columns, "")

    def _thrusters(self, sensor: str, rows: MavlinkRows) -> Iterator[Channel]:
        columns = thrusters({k + 1: width for k, width in enumerate(rows.columns.values())}, self.parameters)
        if columns:
            yield self._channel(sensor, rows, columns, "")
        else:
            self.refused[rows.name, "no SERVOn_FUNCTION says which motor each output drives"] = len(rows)

    def left(self, gatherer: Gatherer) -> Iterator[Left]:
        """What is not in the channels, and why."""
        said: Counter[tuple[Sender, str]] = Counter()
        for (sender, name, _), rows in self._rows.items():
            said[sender, name] = max(said[sender, name], len(rows))
        for (sender, name), count in sorted(gatherer.counts.items()):
            system, component = sender
            others = "" if sender == self.sender else f" of {system}/{component}"
            anyones = name.startswith("VISION_") or name == "DISTANCE_SENSOR"
            if others and not anyones:
                yield Left(f"{name}{others}", count, "not said by the vehicle's autopilot")
            elif rest := count - said[sender, name]:
                yield Left(f"{name}{others}", rest, _REASONS.get(name, "no measurement of a sensor"))
        for (name, reason), count in self.refused.items():
            yield Left(name, count, reason)
        for reason, count in gatherer.unreadable.items():
            yield Left("unreadable", count, reason)
