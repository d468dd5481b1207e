"""Acoustic exchanges: from what a system says, and where the ship was, to measurements with a context.

A reply tells of three times: the head asks, the transponder answers a one-way time later, the head hears that. The
measurement stands where the vehicle answers; the ship's positions and attitudes are interpolated at its own two times:
at 1000 m a roll of 5 deg/s turns by 6.8 deg between them. Online, a reply waits for the ship's next messages.
"""

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array, matrix_from_rpy, rotate, rpy_axes, transpose, wrap_angle
from rovgraph.kernels import measurement_row as at
from rovgraph.log import Log, Measurement, Stream
from rovgraph.log.streams import label_number
from rovgraph.model.calibration import LAYOUT, USBL_MOUNT, beacon_names
from rovgraph.model.config import Config, mount_matrix
from rovgraph.model.origin import scale_at
from rovgraph.sensors.acoustic import AcousticExchange
from rovgraph.sensors.instruments import Instrument
from rovgraph.sensors.sensor import LARGEST_SD
from rovgraph.sensors.sound import BEYOND_M, profile_of

SHIP = "ship", "ship_heading", "ship_tilt"  # streams
UNKNOWN_TILT_SD = math.radians(3.0)  # where ship_roll and ship_pitch are not known, and the ship is taken as level
EDGE_SINE = math.sin(math.radians(5.0))  # nearer to its horizon no planar head measures
DEPTH_GAP_S = 30.0  # over which the vehicle's depth is interpolated for the speed of sound
TOGETHER_S = 0.02  # within which receivers hear one sound
BASELINE_S = 1.0  # of the slope with which the ship's motion goes on beyond its log's ends
REMEMBERED_S = 600.0  # of the ship's motion, online
Left = Counter[tuple[str, str]]


class Pose(NamedTuple):
    """The ship at k times: where it is, how it stands, and how that changes.

    Attributes
    ----------
    p : its antenna, north and east, shape (k, 2) [m]
    rpy, rates : shape (k, 3), NaN where nothing tells [rad], [rad/s]
    v : shape (k, 2) [m/s]
    sd : of north and of east as it says, NaN where it does not, shape (k,) [m]
    """

    p: Array
    rpy: Array
    v: Array
    rates: Array
    sd: Array


class NewestRange(NamedTuple):
    """The newest range to another end, online.

    Attributes
    ----------
    time : [s]
    beacon : its place in ``beacons``, -1 = the ship
    place : where the ship's head or receiver was, north, east and down [m]
    length : one way [m]
    """

    time: float
    beacon: int
    place: tuple[float, float, float]
    length: float


class ShipSignal:
    """Values of a stream of the ship that grows, interpolated."""

    def __init__(self, width: int, angular: bool) -> None:
        self.width, self.angular = width, angular
        self.time, self.values = np.empty(0), np.empty((0, width))
        self.held: Array | None = None

    def hold(self, value: Array) -> None:
        """Take one value for all times, as a topside on a jetty has it; shape (width,)."""
        self.held = value

    @property
    def known(self) -> bool:
        """Whether anything is known."""
        return self.held is not None or len(self.time) > 0

    @property
    def newest(self) -> Array | None:
        """The last values, shape (width,); None without any."""
        return self.held if self.held is not None or not len(self.time) else self.values[-1]

    def take(self, time: Array, values: Array) -> None:
        """Add values in the order of time, or one that is late."""
        self.time, self.values = np.append(self.time, time), np.vstack([self.values, values[:, : self.width]])
        if len(self.time) > len(time) and self.time[-len(time)] <= self.time[-len(time) - 1]:
            order = np.argsort(self.time, kind="stable")
            self.time, self.values = self.time[order], self.values[order]

    def forget(self, before: float) -> None:
        """Forget what is older than a time [s]."""
        kept = max(int(self.time.searchsorted(before)) - 1, 0)
        self.time, self.values = self.time[kept:], self.values[kept:]

    def at(self, time: Array, longest: float) -> tuple[Array, Array]:
        """Values and slopes at some times, NaN in silence that is longer than ``longest`` [s], shape (k, width)."""
        if self.held is not None:
            return np.tile(self.held, (len(time), 1)), np.zeros((len(time), self.width))
        if len(self.time) < 2:
            values = np.full((len(time), self.width), np.nan)
            if len(self.time):
                values[np.abs(time - self.time[0]) <= longest] = self.values[0]
            return values, np.zeros_like(values)
        k, last = self.time.searchsorted(time).clip(1, len(self.time) - 1), len(self.time) - 1
        before, ends = k - 1, self.time[[0, -1]] + [BASELINE_S, -BASELINE_S]  # two neighbours would show their noise
        after_first, before_last = self.time.searchsorted(ends).clip([1, 0], [last, last - 1])
        k = np.where(time < self.time[0], after_first, k)
        before = np.where(time > self.time[-1], before_last, before)
        step = (self.time[k] - self.time[before])[:, None]
        change = self.values[k] - self.values[before]
        slope = (wrap_angle(change) if self.angular else change) / np.maximum(step, 1e-6)
        since = (time - self.time[before])[:, None]
        reach = np.maximum(0.0, np.maximum(since - step, -since))  # beyond the ends
        known = (reach <= longest) & ((step <= longest) | (since <= 0.0) | (since >= step))
        values = self.values[before] + slope * since
        return np.where(known, values, np.nan), np.where(known, slope, np.nan)


@dataclass(frozen=True)
class Other:
    """The other end of exchanges: a beacon by its place in ``beacons``, a receiver by its arm, or the ship."""

    beacon: int = -1
    arm_s: Array | None = None


class Acoustics:
    """Makes measurements of acoustic exchanges, with what is known of the ship so far.

    Parameters
    ----------
    config : effective configuration
    instruments : the sensors in use
    warns : of a vehicle below the end of the profile

    Attributes
    ----------
    heard : the newest range of each other end, by its place in ``beacons``, online
    """

    def __init__(self, config: Config, instruments: Mapping[str, Instrument], warns: bool = True) -> None:
        self.config = config
        self.instruments = {s: i for s, i in instruments.items() if isinstance(i.model, AcousticExchange)}
        self.signals = {
            "ship": ShipSignal(3, False),
            "ship_heading": ShipSignal(1, True),
            "ship_tilt": ShipSignal(2, True),
        }
        ship = config.ship
        if ship.north_m is not None and ship.east_m is not None:
            self.signals["ship"].hold(np.array([ship.north_m, ship.east_m, math.nan]))
        if ship.heading_deg is not None:
            self.signals["ship_heading"].hold(np.radians([ship.heading_deg]))
        self.waiting: list[Measurement] = []
        self.heard: dict[int, NewestRange] = {}
        self._transponder: float | None = None  # that has answered
        self.since: dict[str, float] = {}  # sensor -> time of its first exchange, from which a clock drifts [s]
        self._profile = profile_of(config.sound.profile)
        if self._profile is not None:
            self.signals["depth"] = ShipSignal(1, False)  # of the vehicle, where ranges are made with the speed between
        self._deepest = -math.inf if warns else math.inf
        self._places = {label_number(str(beacon.name)): k for k, beacon in enumerate(config.beacons)}
        self._receivers = {label_number(name): np.array(arm) for name, arm in config.ship.receivers.items()}

    # what comes

    def take_ship(self, streams: Mapping[str, Stream]) -> None:
        """What a log has of the ship, and of depth where that counts."""
        for sensor in self.signals:
            if sensor in streams and len(streams[sensor]):
                self.signals[sensor].take(streams[sensor].time, streams[sensor].data)

    def take_one(self, m: Measurement) -> None:
        """Take one measurement of the ship, or of depth, and forget what is long ago."""
        self.signals[m.sensor].take(np.array([m.time]), m.values[None])
        self.signals[m.sensor].forget(m.time - REMEMBERED_S)

    def insert(self, m: Measurement, late: Mapping[str, float], left_out: Left) -> list[Measurement]:
        """Take one of the ship's measurements, or an exchange; those that are complete now.

        Parameters
        ----------
        late : sensor -> how late stamps of exchanges are taken to be [s]
        """
        if m.sensor in self.signals:
            self.take_one(m)
        else:
            self.waiting.append(m)
        known, out = self._known_until(late), []
        ready = [one for one in self.waiting if one.time - late[one.sensor] + self._lasts(one.sensor) <= known]
        self.waiting = [one for one in self.waiting if all(one is not other for other in ready)]
        ready.sort(key=lambda one: (one.sensor, one.time))  # receivers that hear one sound may stamp it apart
        for _, group in groupby(ready, lambda one: (one.sensor, one.time if one.sensor == "usbl" else 0.0)):
            some = list(group)
            time, row = (np.array([getattr(one, name) for one in some]) for name in ("time", "row"))
            raw = Stream(some[0].sensor, (), time, np.array([one.values for one in some]), row)
            made = self.exchanges(raw, late[raw.sensor], left_out)
            self._hear(made)
            rows = zip(made.time.tolist(), made.data, made.row.tolist(), strict=True)
            out += [Measurement(t, raw.sensor, values, line) for t, values, line in rows]
        return out

    def beacon_of(self, m: Measurement) -> int | None:
        """The place in ``beacons`` of the other end of an exchange, as the sensor has it; None = another end."""
        if m.sensor == "usbl":
            return None if self.config.usbl.head == "ship" else self._beacon(float(m.values[7]))
        return None if float(m.values[3]) in self._receivers else self._beacon(float(m.values[2]))

    def _beacon(self, label: float) -> int | None:
        """The place in ``beacons`` of a name; a single beacon needs none."""
        return 0 if math.isnan(label) and len(self._places) == 1 else self._places.get(label)

    def _lasts(self, sensor: str) -> float:
        """How long an exchange waits for what the ship says, and for other receivers that hear it [s]."""
        if sensor == "range":
            return TOGETHER_S if self._receivers else -math.inf
        return 0.0 if self.config.usbl.head == "ship" or not self._places else -math.inf

    def _hear(self, stream: Stream) -> None:
        """Keep the newest range of each other end."""
        skipped = 2 * self.instruments[stream.sensor].model.dim
        ends = {LAYOUT[beacon_names(k)[0]].start: k for k in self._places.values()}
        for time, values in zip(stream.time.tolist(), stream.data.tolist(), strict=True):
            context = values[skipped:]
            north, east, down = context[at.HEARD : at.HEARD + 3]
            beacon = ends.get(int(context[at.BEACON_AT]), -1)
            self.heard = {**self.heard, beacon: NewestRange(time, beacon, (north, east, down), values[0])}

    def ship(self) -> tuple[float, float, float] | None:
        """North and east of the ship [m] and its heading [rad], NaN without one, as newest known; None = not known."""
        place, heading = self.signals["ship"].newest, self.signals["ship_heading"].newest
        if place is None:
            return None
        return float(place[0]), float(place[1]), math.nan if heading is None else float(heading[0])

    def _known_until(self, late: Mapping[str, float]) -> float:
        """Up to when all is known of the ship that it has told of so far; what has fallen silent is not waited for."""
        ends = [
            float(self.signals[sensor].time[-1])
            for sensor in SHIP
            if len(self.signals[sensor].time) and self.signals[sensor].held is None
        ]
        newest = max([*ends, *(one.time - late[one.sensor] for one in self.waiting)], default=-math.inf)
        silent = max(self.config.ship.max_gap_s, self.config.graph.lag_s)
        return min((end for end in ends if end >= newest - silent), default=newest)

    # measurements

    def exchanges(self, stream: Stream, late: float, left_out: Left) -> Stream:
        """Measurements of exchanges: components, their sds, context and name of the other end, shape (k, 2 D + W + 1).

        Parameters
        ----------
        stream : as the log has it, what cannot be left out
        late : how late the stamps are taken to be [s]
        left_out : (sensor, reason) -> count, of those that cannot be used

        Raises
        ------
        InputError : it is not known which transponder is the vehicle's, or where the ship is
        """
        sensor, instrument = stream.sensor, self.instruments[stream.sensor]
        n, dim = len(stream), instrument.model.dim
        begin = self.since.setdefault(sensor, float(stream.time[0])) if n else 0.0
        why: list[tuple[str, NDArray[np.bool_]]] = []
        seen = self._direction(stream.data) if sensor == "usbl" else np.zeros((n, 3))
        length, exact = self._length(stream)
        why.append(("no length of its way: 0, or a travel time within the turn-around", ~exact))
        names, others = self._others(stream, why)
        c, settings = self._sound_speed(stream), self._settings(sensor)
        way, wait = length / c, settings.turn_around_s
        heard = stream.time - late
        context = np.zeros((n, at.WIDTH))
        assert isinstance(instrument.model, AcousticExchange)
        context[:, at.ARM : at.ARM + 3] = instrument.model.arm_b
        context[:, at.SEEN : at.SEEN + 3] = seen
        context[:, at.STATED], context[:, at.SINCE] = late, stream.time - begin
        context[:, at.ORIGIN] = self.config.environment.earth_latitude
        context[:, at.WAYS] = 1.0 if settings.one_way else 2.0
        on_vehicle = sensor == "range" or self.config.usbl.head == "vehicle"
        if settings.stamp == "transponder":  # when the transponder heard the question, on the ship's or the vehicle's
            heard = heard + (0.0 if settings.one_way else wait) + way
        asked = heard - (way if settings.one_way else 2.0 * way + wait)
        if not on_vehicle:  # the vehicle answers
            time = heard - way - (0.0 if settings.one_way else 0.5 * wait)
            context[:, at.WAIT : at.WAIT + 2] = (0.0, 0.0) if settings.one_way else (-0.5 * wait, 0.5 * wait)
            ends = asked, heard
        elif sensor == "usbl":  # the vehicle asks, and its attitude counts when it hears
            time, ends = heard, (heard - way - (0.0 if settings.one_way else wait), heard - way)
            context[:, at.WAIT] = asked - heard
        elif settings.one_way:
            of_ship = np.array([other.arm_s is not None for other in others], bool)
            time = np.where(of_ship, heard - way, heard)  # the vehicle sends, or a beacon
            ends = heard, heard
        else:
            time, ends = 0.5 * (asked + heard), (asked + way, heard - way)
            context[:, at.WAIT], context[:, at.WAIT + 1] = asked - time, heard - time
        sd = self._place_ends(sensor, context, ends, others, why)
        self._name_variables(sensor, context, others)
        sds = self._noise(stream, length, exact, seen, sd)
        z = np.zeros((n, dim))
        z[:, 0] = length
        if self._profile is not None:
            self._unbend(sensor, time, z, context, others, c)
        usable = np.ones(n, bool)
        for reason, bad in why:
            if (bad & usable).any():
                left_out[sensor, reason] += int((bad & usable).sum())
                usable &= ~bad
        if self._receivers and sensor == "range":
            received = usable & np.array([other.arm_s is not None for other in others], bool)
            usable[self._difference(stream, np.flatnonzero(received), z, sds, context)] = False
        data = np.column_stack([z, sds[:, :dim], context, names])[usable]
        time = time[usable] + late  # the assembly puts them earlier
        order = np.argsort(time, kind="stable")
        return Stream(sensor, (), time[order], data[order], stream.row[usable][order])

    def _settings(self, sensor: str) -> Any:
        return self.config.usbl if sensor == "usbl" else self.config.range

    def _sound_speed(self, stream: Stream) -> Array:
        """The speed of sound that each was made with, shape (n,) [m/s]."""
        own = stream.data[:, -1]
        return np.where(own > 0.0, own, self._settings(stream.sensor).sound_speed_mps)

    def _length(self, stream: Stream) -> tuple[Array, NDArray[np.bool_]]:
        """One-way length of each [m], 0 where it is unknown; and whether it is known."""
        settings = self._settings(stream.sensor)
        length, travel = stream.data[:, 0].copy(), stream.data[:, 1]
        ways = 1.0 if settings.one_way else 2.0
        by_time = self._sound_speed(stream) * (travel - (0.0 if settings.one_way else settings.turn_around_s)) / ways
        length = np.where(np.isnan(length), by_time, length)
        if stream.sensor == "usbl":
            length = np.where(np.isnan(length), np.linalg.norm(stream.data[:, 4:7], axis=1), length)
        known = np.isfinite(length) & (length > 0.0)
        return np.where(known, length, 0.0), known

    @staticmethod
    def _direction(values: Array) -> Array:
        """Unit vectors in the frame that is stated, shape (n, 3)."""
        bearing, elevation, xyz = values[:, 2], values[:, 3], values[:, 4:7]
        level = np.cos(elevation)
        by_angles = np.column_stack([level * np.cos(bearing), level * np.sin(bearing), np.sin(elevation)])
        length = np.linalg.norm(xyz, axis=1, keepdims=True)
        by_place = xyz / np.where(length > 0.0, length, 1.0)
        return np.where(np.isnan(by_angles), np.nan_to_num(by_place), by_angles)

    def _others(self, stream: Stream, why: list[tuple[str, NDArray[np.bool_]]]) -> tuple[Array, list[Other]]:
        """Names of the other ends, and what they are."""
        if stream.sensor == "usbl":
            label, receiver = stream.data[:, 7], np.full(len(stream), np.nan)
        else:
            label, receiver = stream.data[:, 2], stream.data[:, 3]
        names = np.nan_to_num(label, nan=0.0)
        if stream.sensor == "usbl" and self.config.usbl.head == "ship":
            self._choose_transponder(label, why)
            return names, [Other()] * len(stream)
        others, strange = [], np.zeros(len(stream), bool)
        for k, (named, of) in enumerate(zip(label.tolist(), receiver.tolist(), strict=True)):
            if of in self._receivers:
                others.append(Other(arm_s=self._receivers[of]))
                names[k] = of
            elif (beacon := self._beacon(named)) is not None:
                others.append(Other(beacon))
            else:
                others.append(Other())
                strange[k] = stream.sensor == "range" or bool(self._places)
        why.append(("the configuration names no such beacon under beacons", strange))
        return names, others

    def _choose_transponder(self, label: Array, why: list[tuple[str, NDArray[np.bool_]]]) -> None:
        """Leave out what belongs to other transponders than the vehicle's."""
        stated = self.config.usbl.beacon
        known = np.unique(label[~np.isnan(label)])
        if stated is not None:
            why.append(
                ("another transponder than usbl.beacon", ~np.isnan(label) & (label != label_number(str(stated))))
            )
        elif len(known) > 1 and self._transponder is None:
            numbers = [f"{name:.0f}" for name in known.tolist() if name < 2**32]  # beyond are those of texts
            shown = f" ({', '.join(numbers[:6])})" if len(numbers) == len(known) else ""
            raise InputError(
                f"usbl: {len(known)} transponders answer{shown}; state which is the vehicle's, as usbl_beacon has it: "
                f"usbl: {{beacon: {numbers[0] if shown else 'NAME'}}}"
            )
        elif len(known):
            self._transponder = known[0] if self._transponder is None else self._transponder
            why.append(
                (
                    "another transponder than the first, without usbl.beacon",
                    ~np.isnan(label) & (label != self._transponder),
                )
            )

    def _place_ends(
        self,
        sensor: str,
        context: Array,
        ends: tuple[Array, Array],
        others: Sequence[Other],
        why: list[tuple[str, NDArray[np.bool_]]],
    ) -> Array:
        """Write where the other ends were into contexts; sds that this adds: place [m], heading, tilt [rad]."""
        n, usbl = len(context), self.config.usbl
        sd: Array = np.zeros((n, 3))
        on_ship = np.array([other.beacon < 0 for other in others], bool)
        context[:, at.FRAME : at.FRAME + 9] = np.eye(3).ravel()
        context[:, at.INVERTED] = float(sensor == "usbl" and usbl.head == "vehicle")
        if not on_ship.any():
            return sd
        of_head = usbl.lever_arm_m if usbl.head == "ship" else usbl.beacon_arm_m
        arms = np.array([np.array(of_head) if other.arm_s is None else other.arm_s for other in others])
        frame = usbl.frame if sensor == "usbl" and usbl.head == "ship" else "ship"
        heading = frame != "north" or bool(np.any(arms[:, :2]) or np.any(self.config.ship.antenna_m[:2]))
        asked, heard = (self._pose(time) for time in ends)
        for part, pose in ((at.ASKED, asked), (at.HEARD, heard)):
            R_ns = matrix_from_rpy(np.nan_to_num(pose.rpy))
            place = np.column_stack([pose.p, np.zeros(n)])
            antenna = rotate(R_ns, np.broadcast_to(np.array(self.config.ship.antenna_m), (n, 3)))
            antenna[:, 2] = 0.0  # heights count from the waterline
            metres = scale_at(self.config.environment.earth_latitude, place)
            context[:, part : part + 3] = place + metres * (rotate(R_ns, arms) - antenna)
            why.append(("without a position of the ship", on_ship & np.isnan(pose.p).any(axis=1)))
            if heading:
                why.append(("without a heading of the ship", on_ship & np.isnan(pose.rpy[:, 2])))
        rpy, rates = np.nan_to_num(heard.rpy), np.nan_to_num(heard.rates)
        velocity = np.column_stack([np.nan_to_num(heard.v), np.zeros(n)])
        R_ns = matrix_from_rpy(rpy)
        turn = rotate(transpose(R_ns), rotate(rpy_axes(rpy), rates))  # in the ship's axes
        velocity += rotate(R_ns, np.cross(turn, arms - np.array(self.config.ship.antenna_m)))
        context[:, at.MOVES : at.MOVES + 3] = velocity
        if frame == "transducer":
            context[:, at.FRAME : at.FRAME + 9] = R_ns.reshape(n, 9)
            context[:, at.TURNS : at.TURNS + 3] = turn
        elif frame == "ship":
            headed = np.column_stack([np.zeros((n, 2)), rpy[:, 2]])
            context[:, at.FRAME : at.FRAME + 9] = matrix_from_rpy(headed).reshape(n, 9)
            context[:, at.TURNS + 2] = rates[:, 2]
        for part in (at.ASKED, at.HEARD, at.MOVES, at.TURNS):
            context[~on_ship, part : part + 3] = 0.0
        ship = self.config.ship
        level = (frame == "transducer") & np.isnan(heard.rpy[:, :2]).any(axis=1)  # taken as level
        sd[:, 0] = np.where(heard.sd > 0.0, heard.sd, ship.sd_m)
        sd[:, 1] = math.radians(ship.heading_sd_deg)
        sd[:, 2] = np.where(level, UNKNOWN_TILT_SD, math.radians(ship.tilt_sd_deg))
        return np.asarray(sd * on_ship[:, None])

    def _unbend(
        self, sensor: str, time: Array, z: Array, context: Array, others: Sequence[Other], believed: Array
    ) -> None:
        """Replace ranges and directions, made with believed speeds of sound, by those of straight lines, in place."""
        profile = self._profile
        if profile is None or not len(z):
            return
        heard = context[:, at.HEARD + 2]
        if sensor != "usbl" or self.config.usbl.head == "vehicle":
            lower = np.array([self._depth_of(other) for other in others])
            vehicle = self.signals["depth"].at(time, DEPTH_GAP_S)[0][:, 0]
            vehicle = np.where(np.isnan(vehicle), self.config.start.down_m or 0.0, vehicle)
            z[:, 0] *= profile.mean(vehicle, np.where(np.isnan(lower), profile.depth[-1], lower)) / believed
            return
        R_nf = context[:, at.FRAME : at.FRAME + 9].reshape(-1, 3, 3) @ mount_matrix(self.config.usbl.mount_rpy_deg)
        u_n = rotate(R_nf, context[:, at.SEEN : at.SEEN + 3])
        level = np.hypot(u_n[:, 0], u_n[:, 1])
        across, down = profile.trace(float(np.median(heard)), np.arctan2(u_n[:, 2], level), z[:, 0] / believed)
        straight = np.isnan(across)  # it turns back: the mean speed is all there is
        mean = profile.mean(heard, heard + z[:, 0] * u_n[:, 2]) / believed
        length = np.where(straight, z[:, 0] * mean, np.hypot(across, down))
        turned = np.column_stack([u_n[:, :2] / np.maximum(level, 1e-9)[:, None] * across[:, None], down])
        turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-9)
        u_n = np.where(straight[:, None], u_n, turned)
        z[:, 0], context[:, at.SEEN : at.SEEN + 3] = length, rotate(transpose(R_nf), u_n)
        deepest = float(np.percentile(heard + length * u_n[:, 2], 95))
        if deepest > self._deepest:
            if self._deepest <= profile.depth[-1] + BEYOND_M:
                profile.warn_beyond(deepest)
            self._deepest = deepest

    def _depth_of(self, other: Other) -> float:
        """Depth of a beacon as stated, 0 of the ship, NaN where it is not known [m]."""
        if other.beacon < 0:
            return 0.0
        down = self.config.beacons[other.beacon].down_m
        return math.nan if down is None else down

    def _pose(self, time: Array) -> Pose:
        """The ship at some times."""
        longest = self.config.ship.max_gap_s
        found = {sensor: signal.at(time, longest) for sensor, signal in self.signals.items()}
        rpy = np.column_stack([found["ship_tilt"][0], found["ship_heading"][0]])
        rates = np.column_stack([found["ship_tilt"][1], found["ship_heading"][1]])
        (place, v) = found["ship"]
        return Pose(place[:, :2], rpy, v[:, :2], rates, place[:, 2])

    def _name_variables(self, sensor: str, context: Array, others: Sequence[Other]) -> None:
        """Write where the calibration variables are into contexts."""
        known = self.instruments[sensor].calibration
        lasting = ("usbl_direction_error", "usbl_range_error") if sensor == "usbl" else ("", "range_error")
        names = (
            USBL_MOUNT[0] if sensor == "usbl" else "",
            "usbl_arm" if sensor == "usbl" else "",
            "",
            "",
            "sound_speed_scale",
            "usbl_range_offset" if sensor == "usbl" else "range_offset",
            "range_clock",
            "range_clock_drift",
            *lasting,
            f"{sensor}_time_offset",
        )
        context[:, at.MOUNT_AT : at.WIDTH] = [LAYOUT[name].start if name in known else -1 for name in names]
        for k, other in enumerate(others):
            if other.beacon >= 0:
                place, down = (LAYOUT[name].start for name in beacon_names(other.beacon))
                context[k, at.BEACON_AT], context[k, at.DOWN_AT] = place, down

    def _difference(self, stream: Stream, rows: NDArray[np.intp], z: Array, sds: Array, context: Array) -> list[int]:
        """Of receivers that hear one sound one keeps its range, and others become differences, in place.

        Their clock, and the ship's place, are one error of all of them. Pairs that share no receiver, the farthest
        apart first, have independent noise. Those that are in a difference and have nothing to add are returned.
        """
        used, own = [], np.where(stream.data[:, 4] > 0.0, stream.data[:, 4], self.instruments["range"].sd[0])
        for at_time in np.split(rows, np.flatnonzero(np.diff(stream.time[rows]) > TOGETHER_S) + 1):
            left, pairs = at_time.tolist(), []
            while len(left) > 1:
                places = context[left, at.HEARD : at.HEARD + 3]
                apart = np.linalg.norm(places[:, None] - places[None], axis=2)
                i, j = np.unravel_index(int(np.argmax(apart)), apart.shape)
                pairs.append((left[i], left[j]))
                left = [k for k in left if k not in pairs[-1]]
            one = pairs[0][0] if pairs else left[0]
            pairs += [(one, k) for k in left if k != one]
            for a, b in pairs:
                z[b, 0] -= z[a, 0]
                sds[b, 0] = np.sqrt(own[a] ** 2 + own[b] ** 2 * (2.0 if b in left else 1.0))
                context[b, at.ASKED : at.ASKED + 3] = context[a, at.HEARD : at.HEARD + 3]
                context[b, [at.WAYS, at.OFFSET_AT, at.CLOCK_AT, at.DRIFT_AT, at.RANGE_AT]] = 0.0, -1, -1, -1, -1
            used += [a for a, _ in pairs[1:] if a != one]
            sds[one, 0] = np.hypot(sds[one, 0], self.config.range.common_sd_m)
        return used

    def _noise(self, stream: Stream, length: Array, known: NDArray[np.bool_], seen: Array, ship: Array) -> Array:
        """Sds of range, across and up, shape (n, 3), with what the ship's place and attitude add to them."""
        place, heading, tilt = ship.T
        believed = self.instruments[stream.sensor].sd
        own = stream.data[:, 8 if stream.sensor == "usbl" else 4]
        along = np.where(own > 0.0, own, believed[0])
        out = np.empty((len(stream), 3))
        out[:, 0] = np.where(known, np.hypot(along, place), LARGEST_SD)
        if stream.sensor != "usbl":
            return out
        own = stream.data[:, 9]
        angle = np.where(own > 0.0, own, believed[1])
        down = np.abs(seen[:, 2] if self.config.usbl.head == "ship" else 1.0)
        level = np.sqrt(np.maximum(1.0 - seen[:, 2] ** 2, 0.0))
        up = angle / np.maximum(down, EDGE_SINE) if self.config.usbl.planar else angle
        if self.config.usbl.depth == "given":
            up = np.full(len(stream), LARGEST_SD)
        moved = place / np.maximum(length, 1.0)
        out[:, 1] = np.sqrt(angle**2 + moved**2 + (heading * level) ** 2 + tilt**2)
        out[:, 2] = np.sqrt(up**2 + moved**2 + tilt**2)
        return np.minimum(out, LARGEST_SD)

    # files and twins

    def copy(self) -> "Acoustics":
        """One that goes on by itself from here."""
        twin = copy(self)
        twin.since = dict(self.since)
        twin.signals, twin.waiting = {sensor: copy(signal) for sensor, signal in self.signals.items()}, self.waiting[:]
        return twin

    def state(self) -> dict[str, Any]:
        """What is known of the ship, as plain values."""
        return {
            "since": dict(self.since),
            "transponder": math.nan if self._transponder is None else self._transponder,
            **{f"{sensor}_time": signal.time for sensor, signal in self.signals.items()},
            **{f"{sensor}_values": signal.values for sensor, signal in self.signals.items()},
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from where another stood."""
        self.since = {str(sensor): float(time) for sensor, time in state["since"].items()}
        known = float(state["transponder"])
        self._transponder = None if math.isnan(known) else known
        for sensor, signal in self.signals.items():
            signal.time = np.array(state[f"{sensor}_time"], float)
            signal.values = np.array(state[f"{sensor}_values"], float).reshape(-1, signal.width)


class Sightings(NamedTuple):
    """Where acoustic directions and ranges put the vehicle by themselves, by the head's nominal mounting.

    Attributes
    ----------
    positions : north, east, down and sd [m]
    head : where the head was, shape (n, 3) [m]
    """

    positions: Stream
    head: Array


def sightings(log: Log, config: Config, instruments: Mapping[str, Instrument], late: float = 0.0) -> Sightings | None:
    """To begin with, to search with and to draw: of replies whose stamps are late [s]; None without a head on the ship.

    Raises
    ------
    InputError : it is not known which transponder is the vehicle's
    """
    if "usbl" not in log or config.usbl.head != "ship" or "usbl" not in instruments:
        return None
    acoustics = Acoustics(config, instruments, warns=False)
    acoustics.take_ship(log.streams)
    stream = acoustics.exchanges(log["usbl"], late, Counter())
    z, sd, x = stream.data[:, :3], stream.data[:, 3:6], stream.data[:, 6 : 6 + at.WIDTH]
    R = x[:, at.FRAME : at.FRAME + 9].reshape(-1, 3, 3) @ mount_matrix(config.usbl.mount_rpy_deg)
    head = x[:, at.HEARD : at.HEARD + 3]
    way = rotate(R, z[:, :1] * x[:, at.SEEN : at.SEEN + 3])
    p = head + scale_at(config.environment.earth_latitude, head + 0.5 * way) * way
    across = z[:, 0] * np.max(
        np.where(sd[:, 1:] < LARGEST_SD, sd[:, 1:], 0.0), axis=1
    )  # a depth that is given is known
    columns = "fix_north", "fix_east", "down", "fix_sd"
    data = np.column_stack([p, np.hypot(across, sd[:, 0])])
    positions = Stream("usbl", columns, stream.time - late, data, stream.row)
    return Sightings(positions, head)


def unusable_acoustics(config: Config, sensors: Collection[str]) -> dict[str, str]:
    """Acoustic streams that cannot be used, with what is missing, of a log that has some streams."""
    ship = config.ship
    placed = "ship" in sensors or (ship.north_m is not None and ship.east_m is not None)
    headed = "ship_heading" in sensors or ship.heading_deg is not None
    arms = any((*config.usbl.lever_arm_m[:2], *ship.antenna_m[:2]))
    out = {}
    if "usbl" in sensors and (config.usbl.head == "ship" or not config.beacons):
        if not placed:
            out["usbl"] = "where the ship is is not known; give ship_lat and ship_lon, or ship.north_m and ship.east_m"
        elif not headed and (config.usbl.frame != "north" or arms):
            out["usbl"] = "the ship's heading is not known; give ship_heading, or usbl: {frame: north} if it is so"
    if "range" in sensors:
        if not config.beacons and not ship.receivers:
            out["range"] = "state beacons: [{name: ...}], with a place where it is known, or ship.receivers"
        elif not config.beacons and not (placed and headed):
            out["range"] = "where the ship is and heads is not known; give ship_lat, ship_lon and ship_heading"
    return out
