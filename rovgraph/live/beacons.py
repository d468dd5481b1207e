"""Beacons that nobody placed, while a dive goes on: their ranges are gathered until the path tells the side.

Until then their ranges do not touch the track; two places are told, with what the less likely one costs more. From
then on the beacon is a part of the estimate, within a tenth of its ranges of where they put it, and its next ranges
count. Those that were gathered count where the dive so far is smoothed, which happens at once and now and then: there
the place is linearised again, too. Of a longer dive, which is not kept, only where to seek the beacon remains of them.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rovgraph.diagnosis.beacons import FEWEST, ambiguous, below, depth_of_bottom, either
from rovgraph.diagnosis.trilateration import RangesAlongTrack, Side, around, sides
from rovgraph.geometry import Array
from rovgraph.inference.filter import ErrorLayout
from rovgraph.inference.filter_step import Gaussian
from rovgraph.inference.fixed_lag import FilterSnapshot, FixedLag
from rovgraph.kernels import measurement_row as at
from rovgraph.live.solution import BeaconPlace
from rovgraph.log import Measurement, Stream
from rovgraph.model.calibration import LAYOUT, beacon_names
from rovgraph.model.config_sections import Beacon
from rovgraph.model.state import POSE
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.rules import BENT

MOST = 48  # ranges that are kept of a beacon; beyond, every second one goes
LOOK_S = 10.0  # between looks for the side
SHOWN_SD_M = 100.0  # beyond it no place is shown
ALTITUDE_S = 10.0  # oldest altitude that goes with a range
TIME, LENGTH, SD, PLACE, ARM, TRAVELLED, ALTITUDE, WIDTH = 0, 1, 2, 3, 6, 9, 10, 11  # of a range that is kept
Say = Callable[[str, str, str], None]  # sensor, kind, text
REMEDY = "rovgraph smooth of the recording finds it; then state north_m, east_m, down_m and sds under beacons"


@dataclass
class Unplaced:
    """A beacon whose place, or depth, is not known yet.

    Attributes
    ----------
    number : of ``beacons``, from 0
    beacon : as the configuration has it
    sensor : that ranges to it
    ranges : ndarray, shape (n, WIDTH): time [s]; length and sd; where the vehicle was, and from there to the
        transducer, n; the distance that it had travelled; its altitude, NaN = unknown [m]
    places : where it may be, the likeliest first, at the newest look
    due : time of the next look [s]
    told : what was said of it, by kind
    """

    number: int
    beacon: Beacon
    sensor: str = "range"
    ranges: Array = field(default_factory=lambda: np.empty((0, WIDTH)))
    places: list[Side] = field(default_factory=list)
    due: float = -math.inf
    told: set[str] = field(default_factory=set)

    @property
    def margin(self) -> float:
        """What the second place costs more."""
        return self.places[1].cost - self.places[0].cost if len(self.places) > 1 else math.inf

    @property
    def likely(self) -> list[Side]:
        """The two likeliest places, or the only one that is not excluded, as far as they are known."""
        some = self.places[: 1 + ambiguous(self.margin)]
        return [side for side in some if side.sd < SHOWN_SD_M]

    def keep(self, row: Array) -> None:
        """Take a range."""
        self.ranges = np.vstack([self.ranges, row])
        if len(self.ranges) > MOST:
            self.ranges = self.ranges[::2]

    def look(self, initial: InitialConditions, travelled: float) -> tuple[Array, float] | None:
        """Where it is by its ranges, north, east and down, and the sd of its depth; None while that is not clear."""
        one, rows = self.beacon, self.ranges
        p_n, altitude = rows[:, PLACE:ARM] + rows[:, ARM:TRAVELLED], rows[:, ALTITUDE]
        height = float(np.median(altitude[known])) if (known := np.isfinite(altitude)).any() else math.nan
        if one.north_m is not None and one.east_m is not None:
            return below(one.north_m, one.east_m, p_n, height)
        down, down_sd = depth_of_bottom(one.down_m, p_n, height)
        ago = travelled - rows[:, TRAVELLED]
        ranges = RangesAlongTrack(p_n, rows[:, LENGTH], rows[:, SD], ago, *_common_sds(initial, self.sensor, rows))
        self.places = sides(ranges, down, down_sd or one.down_sd_m)
        clear = self.places[0].is_clear(ranges) and not ambiguous(self.margin)
        return (self.places[0].place, down_sd or one.down_sd_m) if clear else None


def _common_sds(initial: InitialConditions, sensor: str, rows: Array) -> tuple[float, float]:
    """Of all ranges of a sensor: of their scale, and of their offset [m]."""
    used = initial.instruments[sensor].model.calibration
    sd = {name: belief.sd for name, belief in initial.beliefs.items() if name in used and name in COMMON}
    drift = sd.get("range_clock_drift", 0.0) * float(np.ptp(rows[:, TIME]))
    offsets = (value for name, value in sd.items() if name not in ("sound_speed_scale", "range_clock_drift"))
    return sd.get("sound_speed_scale", 0.0), math.hypot(drift, *offsets)


COMMON = "sound_speed_scale", "range_offset", "usbl_range_offset", "range_clock", "range_clock_drift"


def _beside(known: Gaussian, layout: ErrorLayout, place: Array) -> Array:
    """How a place, north and east, errs with the estimate beside whose track it was found, shape (2, d).

    It moves with the vehicle, and turns about it with the heading.
    """
    R_nb, p_n = known.x[:9].reshape(3, 3), known.x[9:12]
    (north, east), pose = place[:2] - p_n[:2], layout.columns[POSE]
    J = np.zeros((2, len(known.P)))
    J[:, pose.start : pose.start + 3] = np.outer([-east, north], R_nb[2])
    J[:, pose.start + 3 : pose.stop] = R_nb[:2]
    return J


@dataclass(frozen=True)
class PlacedBeacon:
    """A beacon with a place from now on.

    Attributes
    ----------
    number : of ``beacons``
    beacon : with its place
    found : north and east were found; else the depth alone
    """

    number: int
    beacon: Beacon
    found: bool

    def put(self, known: Gaussian, layout: ErrorLayout, sd: float) -> Gaussian:
        """An estimate with the beacon in its place, ``sd`` beside the vehicle [m]."""
        variable, down = beacon_names(self.number)
        c, P, B = known.c.copy(), known.P.copy(), known.B.copy()
        if self.found:
            assert self.beacon.north_m is not None and self.beacon.east_m is not None
            place, columns = np.array([self.beacon.north_m, self.beacon.east_m]), layout.columns[variable]
            J = _beside(known, layout, place)
            c[LAYOUT[variable]] = place
            P[columns] = J @ P
            P[:, columns] = P[columns].T
            P[columns, columns] = J @ known.P @ J.T + sd**2 * np.eye(2)
            if B.size:
                B[columns] = J @ known.B
        if down in layout.columns and (part := layout.columns[down]).stop <= layout.size:
            c[LAYOUT[down]], P[part], P[:, part] = self.beacon.down_m, 0.0, 0.0
            P[part, part] = self.beacon.down_sd_m**2
        return replace(known, c=c, P=P, B=B)


class UnplacedBeacons:
    """Gathers ranges to beacons that nobody placed, and places them.

    Parameters
    ----------
    initial : of the filter
    say : reports an event
    left_out : (sensor, reason) -> count, of ranges that do not touch the track
    gathers : else these beacons stay without a place
    """

    def __init__(
        self, initial: InitialConditions, say: Say, left_out: Counter[tuple[str, str]], gathers: bool = True
    ) -> None:
        beacons = enumerate(initial.config.beacons)
        self.all = {k: Unplaced(k, beacon) for k, beacon in beacons if not beacon.has_place}
        self._say, self._left_out, self._gathers = say, left_out, gathers
        self._heard: list[tuple[int, Array]] = []  # that the track has not passed yet
        self._before: tuple[float, Array] | None = None  # time and place of the keyframe that was passed last
        self._travelled, self._altitude = 0.0, (-math.inf, math.nan)

    def take(self, engine: FixedLag, m: Measurement) -> bool:
        """Whether a measurement is a range to one of them, which is kept."""
        if not self.all:
            return False
        if m.sensor == "dvl_altitude":
            self._altitude = m.time, float(m.values[0])
        acoustics = engine.assembly.acoustics
        if m.sensor not in acoustics.instruments or (number := acoustics.beacon_of(m)) not in self.all:
            return False
        assert number is not None
        one, count = self.all[number], (m.sensor, f"beacon {self.all[number].beacon.name} had no place yet")
        one.sensor = m.sensor
        self._left_out[count] += 1
        if self._gathers:
            self._gather(engine, m, number)
        else:
            self._tell(one, "unused", f"beacon {one.beacon.name} has no place, and its ranges are left out: {REMEDY}")
        return True

    def _gather(self, engine: FixedLag, m: Measurement, number: int) -> None:
        acoustics, sensor = engine.assembly.acoustics, m.sensor
        late, dim = engine.assembly.time_offsets.of_sensor(sensor), engine.initial.instruments[sensor].model.dim
        raw = Stream(sensor, (), np.array([m.time]), m.values[None], np.array([m.row]))
        made = acoustics.exchanges(raw, late, self._left_out)
        for time, values in zip((made.time - late).tolist(), made.data, strict=True):
            row = np.full(WIDTH, math.nan)
            row[[TIME, LENGTH, SD]] = time, values[0], values[dim]
            row[ARM:TRAVELLED] = values[2 * dim + at.ARM : 2 * dim + at.ARM + 3]  # along the body's axes until placed
            if abs(time - self._altitude[0]) < ALTITUDE_S:
                row[ALTITUDE] = self._altitude[1]
            self._heard.append((number, row))

    def passed(self, snapshot: FilterSnapshot) -> None:
        """Put ranges where the vehicle was, by a keyframe that the lag has passed."""
        if not self.all:
            return
        time, R_nb, p_n = snapshot.time, snapshot.known.x[:9].reshape(3, 3), snapshot.known.x[9:12]
        begin, here = self._before or (time, p_n)
        step = float(np.linalg.norm(p_n - here))
        for number, row in [one for one in self._heard if one[1][TIME] <= time]:
            share = (row[TIME] - begin) / (time - begin) if time > begin else 1.0
            row[PLACE:ARM], row[ARM:TRAVELLED] = here + share * (p_n - here), R_nb @ row[ARM:TRAVELLED]
            row[TRAVELLED] = self._travelled + share * step
            if number in self.all:
                self.all[number].keep(row)
        self._heard = [one for one in self._heard if one[1][TIME] > time]
        self._travelled, self._before = self._travelled + step, (time, p_n)

    def reinitialised(self, time: Array, p_n: Array) -> None:
        """Put ranges where the smoothed dive so far has the vehicle, at keyframes, shapes (n,) and (n, 3)."""
        for one in self.all.values():
            one.ranges = one.ranges[one.ranges[:, TIME] <= time[-1]]
            for k in range(3):
                one.ranges[:, PLACE + k] = np.interp(one.ranges[:, TIME], time, p_n[:, k])
        self._before = None

    def place(self, engine: FixedLag, came: Sequence[Measurement]) -> FixedLag | None:
        """A filter that goes on with beacons whose place has become clear; None without any.

        Parameters
        ----------
        came : all exchanges so far, where the whole dive is kept
        """
        if not self.all or self._before is None:
            return None
        now, found = self._before[0], list[tuple[PlacedBeacon, float]]()
        for one in self.all.values():
            if now >= one.due and len(one.ranges) >= FEWEST:
                one.due = now + LOOK_S
                if (clear := one.look(engine.initial, self._travelled)) is not None:
                    found.append(self._placed(engine, one, *clear))
                self._tell_of(one, clear is not None)
        if not found:
            return None
        config, initial = engine.initial.config, engine.initial
        placed = {beacon.number: beacon.beacon for beacon, _ in found}
        beacons = tuple(placed.get(k, beacon) for k, beacon in enumerate(config.beacons))
        initial = replace(initial, config=config.model_copy(update={"beacons": beacons}))
        for number in placed:
            del self.all[number]
        acoustics = engine.assembly.acoustics
        sensors = {m.sensor for m in came if acoustics.beacon_of(m) in placed}
        again = [m for m in came if m.sensor in sensors and acoustics.beacon_of(m) not in self.all]

        def revised(known: Gaussian, layout: ErrorLayout) -> Gaussian:
            for beacon, sd in found:
                known = beacon.put(known, layout, sd)
            return known

        return engine.continued(initial, revised, again)

    def _placed(self, engine: FixedLag, one: Unplaced, place: Array, down_sd: float) -> tuple[PlacedBeacon, float]:
        """A beacon that becomes a part of the estimate, and its sd beside the vehicle [m]."""
        north, east, down = place.tolist()
        depth = {"down_m": down, "down_sd_m": down_sd}
        if one.beacon.north_m is not None:
            return PlacedBeacon(one.number, one.beacon.model_copy(update=depth), False), 0.0
        known, layout, sd = engine.oldest().known, engine.filter.layout, around(one.ranges[:, LENGTH])
        J = _beside(known, layout, place)
        whole = math.sqrt(sd**2 + float(np.trace(J @ known.covariance @ J.T)) / 2.0)
        there = one.beacon.model_copy(update={"north_m": north, "east_m": east, "sd_m": whole, **depth})
        return PlacedBeacon(one.number, there, True), sd

    def _tell_of(self, one: Unplaced, clear: bool) -> None:
        """What a look has shown that is new."""
        name, likely = one.beacon.name, one.likely
        if clear and one.places:
            (north, east, _), other = one.places[0].place.tolist(), one.margin
            than = f"the mirrored place costs {other:.0f} more" if math.isfinite(other) else "no other place fits"
            where = f"north {north:.0f} m, east {east:.0f} m within {around(one.ranges[:, LENGTH]):.0f} m"
            self._tell(one, "placed", f"beacon {name} is placed at {where}; {than}; its ranges count from now on")
        elif clear:
            self._tell(one, "placed", f"beacon {name} lies below the track; its ranges count from now on")
        elif len(one.ranges) > MOST // 2 and one.places[0].outliers >= BENT:
            text = f"beacon {name}: {one.places[0].outliers:.0%} of its ranges fit no place that fits the others"
            self._tell(one, "unclear", f"{text}; check its name, range.sd_m, and that it does not move")
        elif len(likely) > 1 and all(side.sd < around(one.ranges[:, LENGTH]) for side in likely):
            text = either(str(name), likely[0].place, likely[1].place, one.margin)
            until = "its ranges do not touch the track until a turn tells the side; or state its place under beacons"
            self._tell(one, "ambiguous", f"{text}; {until}")

    def _tell(self, one: Unplaced, kind: str, text: str) -> None:
        if kind not in one.told:
            one.told.add(kind)
            self._say(one.sensor, kind, text)

    def shown(self, known: Gaussian, layout: ErrorLayout) -> list[BeaconPlace]:
        """Where they may be: two places of one whose side the path has not told."""
        out = []
        for one in self.all.values():
            for side in one.likely:
                J = _beside(known, layout, side.place)
                cov = side.covariance + J @ known.covariance @ J.T
                (north, east, _), (north_sd, east_sd) = side.place.tolist(), np.sqrt(cov.diagonal()).tolist()
                found = north, east, north_sd, east_sd, float(cov[0, 1]), side.cost - one.places[0].cost
                out.append(BeaconPlace(str(one.beacon.name), *found))
        return out

    def calibration(self, shown: Sequence[BeaconPlace]) -> dict[str, tuple[float, float]]:
        """By label, the likeliest place of each; its sd covers the other, too."""
        out = {}
        for one in self.all.values():
            places = [place for place in shown if place.name == str(one.beacon.name)]
            for axis in ("north", "east") if places else ():
                values, best = [float(getattr(place, axis)) for place in places], places[0]
                sd = math.hypot(getattr(best, f"{axis}_sd"), values[-1] - values[0])
                out[f"{beacon_names(one.number)[0]}_{axis}"] = values[0], sd
        return out

    def state(self) -> dict[str, Any]:
        """What was gathered, as plain values and arrays."""
        ranges, told = {}, {}
        for k, one in self.all.items():
            ranges[str(k)], told[str(k)] = one.ranges, sorted(one.told)
        return {"ranges": ranges, "told": told, "travelled": self._travelled}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from what another had gathered."""
        self._travelled = float(state["travelled"])
        for k, one in self.all.items():
            one.ranges = np.array(state["ranges"][str(k)], float).reshape(-1, WIDTH)
            one.told = set(state["told"][str(k)])
