"""What an acoustic system hides, found beside dead reckoning before the dive is solved: late stamps, unknown beacons.

Stamps: each lag puts ship and vehicle elsewhere. For each the replies are compared with dead reckoning, robustly, with
what is linear fitted: the head's mounting, and where dead reckoning begins, how it turns, stretches and drifts.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import exp

import numpy as np

from rovgraph.diagnosis.unstated_noise import UnstatedNoise
from rovgraph.errors import InputError
from rovgraph.geometry import Array, slerp
from rovgraph.inference.dead_reckoning import dead_reckon
from rovgraph.kernels import measurement_row as at
from rovgraph.log import Log, Stream
from rovgraph.model.calibration import LAYOUT, USBL_MOUNT, Belief, beacon_names
from rovgraph.model.state import POSE, State
from rovgraph.problem.acoustics import Acoustics
from rovgraph.problem.initial_conditions import Beliefs, InitialConditions
from rovgraph.problem.problem import Problem
from rovgraph.rules import RULES
from rovgraph.sensors import AcousticExchange

LATENCY = "usbl_time_offset"
EARLIEST_S, LATEST_S, STEP_S = -1.0, 5.0, 0.1  # lags that are tried; systems are up to 3 s late
ENOUGH = 20  # replies
MOST = 1500  # of them that are compared, evenly
CLEARER = 30.0  # gain of the robust cost that a lag must bring
LEAST_S, LEAST_SD_S = 0.04, 0.1  # lags below stay in the noise; sd of the prior that a found one gets
DRIFTS_BY = np.deg2rad(1.0)  # over a dive, that a yaw must turn to be said
FOLLOWED_S = 60.0  # within which a walk follows a drift
UNIT, YAW = np.deg2rad(10.0), 2  # of the mounting's columns in a fit, and that of yaw
TUKEY = 3.0  # sds at which a reply begins to count less
PASSES = 6  # of reweighting


def find_head_errors(log: Log, problem: Problem, initial: InitialConditions) -> list[UnstatedNoise]:
    """What the head's replies show beside dead reckoning: stamps that are late, a yaw that drifts.

    Parameters
    ----------
    log, problem, initial : the dive, assembled as it is believed to be
    """
    if "usbl" not in initial.instruments or not {"dvl", "dvl_water"} & log.sensors:
        return []
    if initial.config.usbl.head == "vehicle" and any(beacon.north_m is None for beacon in initial.config.beacons):
        return []  # directions to where nobody knows
    states = dead_reckon(problem, initial, {name: b.mean for name, b in initial.beliefs.items()})
    replies = log["usbl"]
    if len(replies) > MOST:
        replies = replies.take(np.unique(np.linspace(0, len(replies) - 1, MOST).astype(int)))
    search = _LagSearch(log, replies, problem.time, states, initial)
    late = None if initial.beliefs[LATENCY].estimate else _find_latency(search, initial.beliefs[LATENCY])
    lag = float((initial.beliefs[LATENCY] if late is None else late.beliefs.calibration[LATENCY]).mean[0])
    drift = _find_drift(search, lag, initial.beliefs[USBL_MOUNT[2]], float(np.ptp(problem.time)))
    return [found for found in (late, drift) if found is not None]


def _find_latency(search: "_LagSearch", belief: Belief) -> UnstatedNoise | None:
    stated = float(belief.mean[0])
    lags = stated + np.arange(EARLIEST_S, LATEST_S + STEP_S / 2, STEP_S)
    cost = np.array([search.cost(lag) for lag in lags])
    if not np.isfinite(cost).any():
        return None
    step = STEP_S / 5.0
    fine = lags[int(np.nanargmin(cost))] + step * np.arange(-5, 6)
    costs = np.array([search.cost(lag) for lag in fine])
    j = int(np.clip(np.nanargmin(costs), 1, len(fine) - 2))
    bend = costs[j + 1] - 2.0 * costs[j] + costs[j - 1]
    lag = float(fine[j] - 0.5 * step * (costs[j + 1] - costs[j - 1]) / bend) if bend > 0.0 else float(fine[j])
    sd = float(step / np.sqrt(bend)) if bend > 0.0 else STEP_S
    if abs(lag - stated) < max(LEAST_S, 3.0 * sd) or not search.cost(stated) - costs[j] > CLEARER:
        return None
    sd = max(LEAST_SD_S, 3.0 * sd)
    return UnstatedNoise(
        "usbl",
        f"calibration.{LATENCY}",
        {"estimate": True, "mean": round(lag, 2), "sd": round(sd, 2)},
        f"its stamps are {lag:.2f} s late beside the vehicle's own motion and the ship's",
        "it is estimated from there",
        Beliefs({LATENCY: replace(belief, mean=np.array([lag]), sd=sd, estimate=True)}),
    )


def _find_drift(search: "_LagSearch", lag: float, belief: Belief, seconds: float) -> UnstatedNoise | None:
    if belief.walk or not belief.estimate:
        return None
    drift, sd = search.drift(lag)
    per_minute = np.rad2deg(drift) * 60.0 / seconds
    if abs(drift) < max(DRIFTS_BY, 6.0 * sd):
        return None
    walk = float(abs(drift) / seconds * np.sqrt(FOLLOWED_S))
    return UnstatedNoise(
        "usbl",
        f"calibration.{belief.variable.name}",
        {"estimate": True, "walk_deg": round(float(np.rad2deg(walk)), 4)},
        f"its bearings turn by {per_minute:+.2g} deg/min beside the vehicle's own heading: the compass of the ship or "
        "topside drifts",
        "the head's yaw is estimated as one that walks",
        Beliefs({belief.variable.name: replace(belief, walk=walk)}),
    )


class _LagSearch:
    """Replies beside dead reckoning, at lags."""

    def __init__(self, log: Log, replies: Stream, time: Array, states: State, initial: InitialConditions) -> None:
        self.log, self.replies, self.time, self.states, self.initial = log, replies, time, states, initial
        self.acoustics = Acoustics(initial.config, initial.instruments, warns=False)
        self.acoustics.take_ship(log.streams)
        self.calibration = {name: b.mean for name, b in initial.beliefs.items()}

    def cost(self, lag: float) -> float:
        """Robust cost of the replies with a lag; infinite where too few can be compared."""
        stream = self._at(lag)
        if len(stream) < ENOUGH:
            return np.inf
        return self._fit(*self._linearized(stream, lag))[0] * len(self.replies) / len(stream)

    def drift(self, lag: float) -> tuple[float, float]:
        """By how much the head's yaw turns over the dive beside dead reckoning, and its sd [rad]."""
        stream = self._at(lag)
        if len(stream) < ENOUGH:
            return 0.0, np.inf
        r, H = self._linearized(stream, lag)
        share = ((stream.time - self.time[0]) / (self.time[-1] - self.time[0]))[:, None, None]
        _, x, sd = self._fit(r, np.concatenate([H, H[..., YAW : YAW + 1] * share], axis=2))
        return float(x[-1]) * UNIT, float(sd[-1]) * UNIT

    @staticmethod
    def _fit(r: Array, H: Array) -> tuple[float, Array, Array]:
        """Robust cost of residuals, what is fitted and its sds."""
        weight: Array = np.ones(len(r))
        for _ in range(PASSES):
            root = np.sqrt(weight)[:, None]
            A, b = (H * root[..., None]).reshape(-1, H.shape[2]), (r * root).ravel()
            x = np.linalg.lstsq(A, b, rcond=None)[0]
            d2 = np.sum((r - H @ x) ** 2, axis=1)
            weight = 1.0 / (1.0 + d2 / TUKEY**2)
        cost = float(0.5 * TUKEY**2 * np.sum(np.log1p(d2 / TUKEY**2)))
        spread = np.maximum(1.0, np.sum(weight * d2) / max(np.sum(weight) * r.shape[1], 1.0))
        sd = np.sqrt(spread * np.diag(np.linalg.pinv(A.T @ A)))
        return cost, np.asarray(x, float), np.asarray(sd, float)

    def _at(self, lag: float) -> Stream:
        """The replies where the vehicle answered, with a lag."""
        stream = self.acoustics.exchanges(self.replies, lag, Counter())
        stream = replace(stream, time=stream.time - lag)
        return stream.take((stream.time > self.time[0]) & (stream.time < self.time[-1]))

    def _linearized(self, stream: Stream, lag: float) -> tuple[Array, Array]:
        """Whitened innovations, shape (n, 3), and Jacobians by what is fitted, shape (n, 3, 11)."""
        model = self.initial.instruments["usbl"].model
        assert isinstance(model, AcousticExchange)
        z, sd, context = np.split(stream.data[:, : 6 + at.WIDTH], [3, 6], axis=1)
        state = _interpolated(self.states, self.time, stream.time, {**self.calibration, LATENCY: np.array([lag])})
        predicted, H = model.of(context).predict(state, np.zeros((len(z), 3)))
        by_place = H[POSE][..., 3:] @ np.swapaxes(state.R_nb, 1, 2)  # along north, east, down
        p = state.p_n - self.states.p_n[0]
        turned = np.stack([-p[:, 1], p[:, 0], np.zeros(len(p))], axis=1)
        level = p * [1.0, 1.0, 0.0]
        share = ((stream.time - self.time[0]) / (self.time[-1] - self.time[0]))[:, None, None]
        columns = [
            *(H[name] * UNIT for name in USBL_MOUNT),
            by_place * 5.0,
            (by_place @ turned[..., None]) * 0.1,
            (by_place @ level[..., None]) * 0.1,
            by_place[..., :2] * share * 5.0,
            H["sound_speed_scale"] * 0.01,
        ]
        return (z - predicted) / sd, np.concatenate(columns, axis=2) / sd[..., None]


def _interpolated(states: State, time: Array, wanted: Array, calibration: Mapping[str, Array]) -> State:
    """States between keyframes: attitude by the turn between two, position and velocity along a line."""
    k = time.searchsorted(wanted).clip(1, len(time) - 1)
    share = ((wanted - time[k - 1]) / (time[k] - time[k - 1]))[:, None]
    p, v = ((1.0 - share) * a[k - 1] + share * a[k] for a in (states.p_n, states.v_n))
    return State(slerp(time, states.R_nb, wanted), p, v, states.bias[k], calibration)


LEAST_AROUND_M, AROUND = 10.0, 0.1  # within which a beacon is sought from there on, part of its ranges
FEWEST = 6  # ranges to a beacon whose place is unknown
STARTS = 24  # of the search for a beacon, around the track
DRIFT = 0.02  # of dead reckoning, part of the distance
SAME_M = 3.0  # places that near are one
RUNNER_UP = 50.0  # cost beyond the best's, by dead reckoning, up to which the dive is solved with a mirrored place, too
DOWN_SD = 20.0  # of a beacon of which nothing shows the depth [m]


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
        return exp(-self.margin) > RULES["close"].doubtful

    @property
    def cause(self) -> str:
        """Both places, in words."""
        here, there = self.place + self.apart, self.place
        return (
            f"beacon {self.name} may lie at north {here[0]:.0f} m, east {here[1]:.0f} m or, mirrored, at north "
            f"{there[0]:.0f} m, east {there[1]:.0f} m: a cost difference of only {self.margin:.1f} tells; "
            "the stated sd covers both"
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
    for k, beacon in enumerate(initial.config.beacons):
        if beacon.has_place:
            continue
        if beacon.north_m is not None and beacon.east_m is not None:
            down, down_sd = _depth_of_bottom(log, None, states.p_n)
            down += 0.5 * down_sd  # from its own depth none tells a side
            place = np.array([beacon.north_m, beacon.east_m, down])
            out.append(BeaconPlaces(str(beacon.name), k, place, None, beacon.sd_m, down_sd, True))
            continue
        rows = every[problem.contexts(every)[:, at.BEACON_AT] == LAYOUT[beacon_names(k)[0]].start]
        if len(rows) < FEWEST:
            raise InputError(
                f"{log.source}: {len(rows)} ranges to beacon {beacon.name}, whose place is unknown; {FEWEST} are "
                f"needed: state beacons: [{{name: {beacon.name}, north_m: .., east_m: ..}}], or leave it out"
            )
        time, length = problem.rows[rows, at.TIME], problem.z(rows, 1)[:, 0]
        there = _interpolated(states, problem.time, time, {})
        sd = np.hypot(problem.sd(rows, 1)[:, 0], DRIFT * np.interp(time, problem.time, np.append(0.0, steps.cumsum())))
        down, down_sd = _depth_of_bottom(log, beacon.down_m, there.p_n)
        places = _trilaterate(there.p_n, length, sd, down, down_sd or beacon.down_sd_m)
        other = next((p for p, cost in places[1:] if cost - places[0][1] < RUNNER_UP), None)
        around = max(LEAST_AROUND_M, AROUND * float(np.median(length)))
        out.append(BeaconPlaces(str(beacon.name), k, places[0][0], other, around, down_sd))
    return out


def _depth_of_bottom(log: Log, stated: float | None, p_n: Array) -> tuple[float, float]:
    """Depth of a beacon to begin with and its sd, 0 where it is stated [m]."""
    if stated is not None:
        return stated, 0.0
    if "dvl_altitude" in log:
        altitude = log["dvl_altitude"]
        bottom = np.median(p_n[:, 2]) + np.median(altitude.data[:, 0])
        return float(bottom), 5.0
    return float(p_n[:, 2].max()), DOWN_SD


def _trilaterate(p_n: Array, length: Array, sd: Array, down: float, down_sd: float) -> list[tuple[Array, float]]:
    """Places with the robust cost of ranges from n points, the best first, each once."""
    middle, radius = p_n.mean(axis=0), float(np.median(length))
    found: list[tuple[Array, float]] = []
    for angle in np.linspace(0.0, 2.0 * np.pi, STARTS, endpoint=False):
        place = np.array([middle[0] + radius * np.cos(angle), middle[1] + radius * np.sin(angle), down])
        place, cost = _descend(place, p_n, length, sd, down, down_sd)
        if all(np.linalg.norm(place[:2] - p[:2]) > SAME_M for p, _ in found):
            found.append((place, cost))
    return sorted(found, key=lambda one: one[1])


def _descend(place: Array, p_n: Array, length: Array, sd: Array, down: float, down_sd: float) -> tuple[Array, float]:
    """Levenberg's method with Cauchy's loss."""

    def rated(at_place: Array) -> tuple[Array, Array, float]:
        away = at_place - p_n
        d = np.maximum(np.linalg.norm(away, axis=1), 1e-3)
        r = (length - d) / sd
        cost = 0.5 * TUKEY**2 * float(np.sum(np.log1p((r / TUKEY) ** 2)))
        return r, away / (d * sd)[:, None], cost + 0.5 * float((at_place[2] - down) / down_sd) ** 2

    r, J, cost = rated(place)
    damping = 1e-3
    for _ in range(60):
        weight = 1.0 / (1.0 + (r / TUKEY) ** 2)
        N = (J * weight[:, None]).T @ J + np.diag([0.0, 0.0, down_sd**-2])
        g = (J * weight[:, None]).T @ r - np.array([0.0, 0.0, (place[2] - down) / down_sd**2])
        step = np.linalg.solve(N + damping * np.diag(np.diag(N) + 1e-9), g)
        new = rated(place + step)
        if new[2] < cost:
            small = np.linalg.norm(step) < 1e-3
            place, (r, J, cost), damping = place + step, new, damping / 5.0
            if small:
                break
        else:
            damping *= 10.0
            if damping > 1e9:
                break
    return place, cost
