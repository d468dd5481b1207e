"""Beacons that nobody placed: found by their ranges along the track, on either side of it until the path tells.

Offline they are sought beside dead reckoning, and the dive is solved with both sides (`rovgraph.dive`). Live the track
is the filter's, and the side is told by the ranges alone, with its drift among what is unknown (`sides`).
"""

from dataclasses import dataclass, replace
from math import exp

import numpy as np

from rovgraph.diagnosis.acoustics import TUKEY, interpolated
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.inference.dead_reckoning import dead_reckon
from rovgraph.kernels import measurement_row as at
from rovgraph.log import Log
from rovgraph.model.calibration import LAYOUT, beacon_names
from rovgraph.problem.initial_conditions import Beliefs, InitialConditions
from rovgraph.problem.problem import Problem
from rovgraph.rules import BENT, RULES

LEAST_AROUND_M, AROUND = 10.0, 0.1  # within which a beacon is sought from there on, part of its ranges
FEWEST = 6  # ranges to a beacon whose place is unknown
STARTS = 24  # of the search for a beacon, around the track
STEPS = 60  # of each
DRIFT = 0.02  # of dead reckoning, part of the distance
SAME_M = 3.0  # places that near are one
RUNNER_UP = 50.0  # cost beyond the best's, by dead reckoning, up to which the dive is solved with a mirrored place, too
DOWN_SD = 20.0  # of a beacon of which nothing shows the depth [m]
CANDIDATES = 4  # places that are looked at with the drift of the track, the best without it
LEAPS_M = 20.0  # largest step of them


def ambiguous(margin: float) -> bool:
    """Whether a place is not excluded that costs so much more than the best."""
    return exp(-margin) > RULES["close"].doubtful


@dataclass(frozen=True)
class MirroredBeacon:
    """A second place of a beacon, with which the dive was solved, too.

    Attributes
    ----------
    name, variable : as the configuration and the calibration name it
    place, apart : ndarray, shape (2,), north and east, and from there to the better place [m]
    margin : cost beyond the better place's
    p_n : ndarray, shape (n, 3), where the keyframes are with it [m]
    """

    name: str
    variable: str
    place: Array
    apart: Array
    margin: float
    p_n: Array

    @property
    def ambiguous(self) -> bool:
        """Whether the dive does not tell the two apart."""
        return ambiguous(self.margin)

    @property
    def cause(self) -> str:
        """Both places, in words."""
        return f"{either(self.name, self.place + self.apart, self.place, self.margin)}; the stated sd covers both"


def either(name: str, here: Array, there: Array, margin: float) -> str:
    """Both places of a beacon, north and east, in words."""
    return (
        f"beacon {name} may lie at north {here[0]:.0f} m, east {here[1]:.0f} m or, mirrored, at north {there[0]:.0f} "
        f"m, east {there[1]:.0f} m: a cost difference of only {margin:.1f} tells"
    )


@dataclass(frozen=True)
class BeaconPlaces:
    """Where a beacon whose place nobody stated may be.

    Attributes
    ----------
    name, number : as the configuration names it, and which of ``beacons`` it is, from 0
    best, other : ndarray, shape (3,), north, east, down; ``other`` is a mirrored place that explains as much, or None
    sd, down_sd : with which the estimate begins there, far wider than where it ends; 0 = of a depth as stated [m]
    placed : north and east are stated, and the depth alone is not
    """

    name: str
    number: int
    best: Array
    other: Array | None
    sd: float
    down_sd: float
    placed: bool = False

    @property
    def text(self) -> str:
        """What is assumed, in a line."""
        north, east, down = self.best
        if self.placed:
            return f"beacon {self.name} begins at a depth of {down:.0f} m within {self.down_sd:.0f} m, below the track"
        return (
            f"beacon {self.name} begins where its ranges along dead reckoning put it, north {north:.0f} m, east "
            f"{east:.0f} m, within {self.sd:.0f} m"
        )

    @property
    def variable(self) -> str:
        """Of the calibration, that has its north and east."""
        return beacon_names(self.number)[0]

    def beliefs(self, initial: InitialConditions, place: Array) -> Beliefs:
        """The beacon at a place."""
        variable, down = beacon_names(self.number)
        found = {variable: replace(initial.beliefs[variable], mean=place[:2].copy(), sd=self.sd)}
        if self.down_sd:
            found[down] = replace(initial.beliefs[down], mean=place[2:].copy(), sd=self.down_sd)
        return Beliefs(found)


def find_beacons(log: Log, problem: Problem, initial: InitialConditions) -> list[BeaconPlaces]:
    """Places of beacons that the configuration names without one, or without a depth, by ranges along dead reckoning.

    Raises
    ------
    InputError : too few ranges to one of them
    """
    if "range" not in initial.instruments or all(one.has_place for one in initial.config.beacons):
        return []
    out, every = [], problem.of_sensor("range")
    states = dead_reckon(problem, initial, {name: b.mean for name, b in initial.beliefs.items()})
    steps = np.linalg.norm(np.diff(states.p_n, axis=0), axis=1)
    altitude = float(np.median(log["dvl_altitude"].data[:, 0])) if "dvl_altitude" in log else np.nan
    for k, beacon in enumerate(initial.config.beacons):
        if beacon.has_place:
            continue
        if beacon.north_m is not None and beacon.east_m is not None:
            place, down_sd = below(beacon.north_m, beacon.east_m, states.p_n, altitude)
            out.append(BeaconPlaces(str(beacon.name), k, place, None, beacon.sd_m, down_sd, True))
            continue
        rows = every[problem.contexts(every)[:, at.BEACON_AT] == LAYOUT[beacon_names(k)[0]].start]
        if len(rows) < FEWEST:
            raise InputError(
                f"{log.source}: {len(rows)} ranges to beacon {beacon.name}, whose place is unknown; {FEWEST} are "
                f"needed: state beacons: [{{name: {beacon.name}, north_m: .., east_m: ..}}], or leave it out"
            )
        time, length = problem.rows[rows, at.TIME], problem.z(rows, 1)[:, 0]
        there = interpolated(states, problem.time, time, {})
        sd = np.hypot(problem.sd(rows, 1)[:, 0], DRIFT * np.interp(time, problem.time, np.append(0.0, steps.cumsum())))
        down, down_sd = depth_of_bottom(beacon.down_m, there.p_n, altitude)
        places = _trilaterate(there.p_n, length, sd, down, down_sd or beacon.down_sd_m)
        other = next((p for p, cost in places[1:] if cost - places[0][1] < RUNNER_UP), None)
        begin_sd = _sd_to_begin(places[0][0], there.p_n, length, sd, down_sd or beacon.down_sd_m)
        out.append(BeaconPlaces(str(beacon.name), k, places[0][0], other, begin_sd, down_sd))
    return out


def _sd_to_begin(place: Array, p_n: Array, length: Array, sd: Array, down_sd: float) -> float:
    """An sd that holds a beacon about a place: where ranges from one spot leave a circle, as wide as that [m]."""
    away = (place - p_n) / (np.linalg.norm(place - p_n, axis=1) * sd)[:, None]
    known = np.linalg.inv(away.T @ away + np.diag([1e-9, 1e-9, down_sd**-2]))[:2, :2]
    along = float(np.sqrt(np.linalg.eigvalsh(known)[-1]))
    return max(around(length), min(along, float(np.median(length))))


def around(length: Array) -> float:
    """Within which a beacon with such ranges is sought from where they put it, an sd [m]."""
    return max(LEAST_AROUND_M, AROUND * float(np.median(length)))


def below(north: float, east: float, p_n: Array, altitude: float) -> tuple[Array, float]:
    """The place of a beacon whose depth alone is not stated, shape (3,), and the sd of its depth [m]."""
    down, down_sd = depth_of_bottom(None, p_n, altitude)
    return np.array([north, east, down + 0.5 * down_sd]), down_sd  # from its own depth none tells a side


def depth_of_bottom(stated: float | None, p_n: Array, altitude: float) -> tuple[float, float]:
    """Depth of a beacon to begin with and its sd, 0 where it is stated [m].

    Parameters
    ----------
    stated : by the configuration [m]
    p_n : ndarray, shape (n, 3), of the vehicle [m]
    altitude : over the bottom, NaN = unknown [m]
    """
    if stated is not None:
        return stated, 0.0
    if np.isfinite(altitude):
        return float(np.median(p_n[:, 2]) + altitude), 5.0
    return float(p_n[:, 2].max()), DOWN_SD


def _trilaterate(p_n: Array, length: Array, sd: Array, down: float, down_sd: float) -> list[tuple[Array, float]]:
    """Places with the robust cost of ranges from n points, the best first, each once.

    Levenberg's method with Cauchy's loss, from all starts at a time.
    """
    middle, radius = p_n.mean(axis=0), float(np.median(length))
    angle = np.linspace(0.0, 2.0 * np.pi, STARTS, endpoint=False)
    level = middle[:2] + radius * np.column_stack([np.cos(angle), np.sin(angle)])
    place = np.column_stack([level, np.full(STARTS, down)])

    def rated(at_place: Array) -> tuple[Array, Array, Array]:
        away = at_place[:, None] - p_n
        d = np.maximum(np.linalg.norm(away, axis=2), 1e-3)
        r = (length - d) / sd
        cost = 0.5 * TUKEY**2 * np.log1p((r / TUKEY) ** 2).sum(axis=1)
        return r, away / (d * sd)[..., None], cost + 0.5 * ((at_place[:, 2] - down) / down_sd) ** 2

    r, J, cost = rated(place)
    damping, goes_on = np.full(STARTS, 1e-3), np.ones(STARTS, bool)
    for _ in range(STEPS):
        weighted = J / (1.0 + (r / TUKEY) ** 2)[..., None]
        N, g = np.swapaxes(weighted, 1, 2) @ J, (weighted * r[..., None]).sum(axis=1)
        N[:, 2, 2] += down_sd**-2
        g[:, 2] -= (place[:, 2] - down) / down_sd**2
        damped = N + np.eye(3) * (damping[:, None] * (np.einsum("sii->si", N) + 1e-9))[:, None]
        step = np.linalg.solve(damped, g[..., None])[..., 0]
        new_r, new_J, new_cost = rated(place + step)
        better = goes_on & (new_cost < cost)
        place, cost = np.where(better[:, None], place + step, place), np.where(better, new_cost, cost)
        r, J = np.where(better[:, None], new_r, r), np.where(better[:, None, None], new_J, J)
        damping = np.where(better, damping / 5.0, damping * 10.0)
        goes_on &= np.where(better, np.linalg.norm(step, axis=1) >= 1e-3, damping <= 1e9)
        if not goes_on.any():
            break
    return _distinct(list(zip(place, cost.tolist(), strict=True)))


def _distinct(places: list[tuple[Array, float]]) -> list[tuple[Array, float]]:
    """Places with their costs, the best first, without those that are near to a better one."""
    found: list[tuple[Array, float]] = []
    for place, cost in sorted(places, key=lambda one: one[1]):
        if all(np.linalg.norm(place[:2] - p[:2]) > SAME_M for p, _ in found):
            found.append((place, cost))
    return found


@dataclass(frozen=True)
class RangesAlongTrack:
    """Ranges to one beacon, from where a track that drifts had the vehicle.

    Attributes
    ----------
    p_n : ndarray, shape (n, 3), of the point on the vehicle [m]
    length, sd : ndarray, shape (n,) [m]
    ago : ndarray, shape (n,), distance travelled since [m]
    scale_sd, offset_sd : of all of the ranges, of one and [m]
    """

    p_n: Array
    length: Array
    sd: Array
    ago: Array
    scale_sd: float
    offset_sd: float


@dataclass(frozen=True)
class Side:
    """Where a beacon may be.

    Attributes
    ----------
    place : ndarray, shape (3,), north, east, down, in the track's frame where it ends [m]
    cost : of the ranges with it, and of the drift that it asks for
    covariance : ndarray, shape (2, 2), of north and east beside the track's end [m^2]
    outliers : share of the ranges that it does not explain
    """

    place: Array
    cost: float
    covariance: Array
    outliers: float

    @property
    def sd(self) -> float:
        """Along the direction in which it is known worst [m]."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))

    def is_clear(self, ranges: RangesAlongTrack) -> bool:
        """Whether it is known well enough to go on from there, if no other place is as likely."""
        return self.sd < around(ranges.length) and self.outliers < BENT


def sides(ranges: RangesAlongTrack, down: float, down_sd: float) -> list[Side]:
    """Places of a beacon, the likeliest first, by ranges from a track that drifts.

    The drift is a random walk back from the track's end, as large over all of it as dead reckoning's: a bend of the
    track that nobody saw would else tell a side, the clearer the more ranges there are. A turn of the whole is left
    out: it turns the beacon with it.
    """
    drifting = np.hypot(ranges.sd, DRIFT * ranges.ago)
    rough = _trilaterate(ranges.p_n, ranges.length, drifting, down, down_sd)[:CANDIDATES]
    fine = [_with_drift(place, ranges, down, down_sd) for place, _ in rough]
    kept = [place for place, _ in _distinct([(side.place, side.cost) for side in fine])]
    return sorted((side for side in fine if any(side.place is p for p in kept)), key=lambda side: side.cost)


def _with_drift(place: Array, ranges: RangesAlongTrack, down: float, down_sd: float) -> Side:
    """A place from where it is known roughly, by Gauss and Newton's method with Cauchy's loss of each range's noise."""
    ago, sd = ranges.ago, ranges.sd
    walk = DRIFT**2 * max(float(ago.max()), 1.0) * np.minimum.outer(ago, ago)
    common = ranges.scale_sd**2 * np.outer(ranges.length, ranges.length) + ranges.offset_sd**2
    common += 0.5 * down_sd**4 / np.outer(ranges.length, ranges.length)  # of a beacon as deep as the vehicle
    weight, prior = np.ones(len(sd)), np.diag([0.0, 0.0, down_sd**-2])
    near = np.eye(3) / around(ranges.length) ** 2  # on the spot a step along the circle about it would leave it
    for k in range(STEPS + 1):
        away = place - ranges.p_n
        d = np.maximum(np.linalg.norm(away, axis=1), 1e-3)
        u, r = away / d[:, None], ranges.length - d
        shared = walk * (u[:, :2] @ u[:, :2].T) + common
        S = shared + np.diag(sd**2 / weight)
        by_r, by_u = np.split(np.linalg.solve(S, np.column_stack([r, u])), [1], axis=1)
        noise = sd * by_r[:, 0] / weight  # of each range, in its sds
        weight = np.maximum(1.0 / (1.0 + (noise / TUKEY) ** 2), 1e-6)
        N = u.T @ by_u + prior
        gradient = u.T @ by_r[:, 0] - prior @ (place - [0.0, 0.0, down])
        step = np.linalg.solve(N + near, gradient)
        length = float(np.linalg.norm(step))
        if k == STEPS or length < 1e-2:
            break
        place = place + step * min(1.0, LEAPS_M / length)
    cost = 0.5 * TUKEY**2 * float(np.log1p((noise / TUKEY) ** 2).sum()) + 0.5 * float(by_r[:, 0] @ shared @ by_r[:, 0])
    cost += 0.5 * float((place[2] - down) / down_sd) ** 2
    return Side(place, cost, np.linalg.inv(N + 1e-9 * np.eye(3))[:2, :2], float(np.mean(weight < 0.5)))
