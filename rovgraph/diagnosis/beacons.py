"""Beacons that nobody placed: found by their ranges along the track, on either side of it until the path tells.

Offline they are sought beside dead reckoning, and the dive is solved with both sides (`rovgraph.dive`). Live the track
is the filter's, and the side is told by the ranges alone, with its drift among what is unknown (`sides`).
"""

from dataclasses import dataclass, replace
from math import exp

import numpy as np

from rovgraph.diagnosis.acoustics import interpolated
from rovgraph.diagnosis.trilateration import DRIFT, around, trilaterate
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.inference.dead_reckoning import dead_reckon
from rovgraph.kernels import measurement_row as at
from rovgraph.log import Log
from rovgraph.model.calibration import LAYOUT, beacon_names
from rovgraph.problem.initial_conditions import Beliefs, InitialConditions
from rovgraph.problem.problem import Problem
from rovgraph.rules import RULES

FEWEST = 6  # ranges to a beacon whose place is unknown
RUNNER_UP = 50.0  # cost beyond the best's, by dead reckoning, up to which the dive is solved with a mirrored place, too
DOWN_SD = 20.0  # of a beacon of which nothing shows the depth [m]


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
        places = trilaterate(there.p_n, length, sd, down, down_sd or beacon.down_sd_m)
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
