"""What an acoustic head hides, found beside dead reckoning before the dive is solved: late stamps, a yaw that drifts.

Stamps: each lag puts ship and vehicle elsewhere. For each the replies are compared with dead reckoning, robustly, with
what is linear fitted: the head's mounting, and where dead reckoning begins, how it turns, stretches and drifts.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rovgraph.diagnosis.unstated_noise import UnstatedNoise
from rovgraph.geometry import Array, slerp
from rovgraph.inference.dead_reckoning import dead_reckon
from rovgraph.kernels import measurement_row as at
from rovgraph.log import Log, Stream
from rovgraph.model.calibration import USBL_MOUNT, Belief
from rovgraph.model.state import POSE, State
from rovgraph.problem.acoustics import Acoustics
from rovgraph.problem.initial_conditions import Beliefs, InitialConditions
from rovgraph.problem.problem import Problem
from rovgraph.sensors import AcousticExchange

LATENCY = "usbl_time_offset"
EARLIEST_S, LATEST_S, STEP_S = -1.0, 5.0, 0.1  # lags that are tried; systems are up to 3 s late, by their own stamps
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
    taken_off = max(initial.config.delay_s.get("usbl", 0.0), 0.0)  # which may be wrong
    latency = initial.beliefs[LATENCY]
    late = None if latency.estimate else _find_latency(search, latency, EARLIEST_S - taken_off)
    lag = float((initial.beliefs[LATENCY] if late is None else late.beliefs.calibration[LATENCY]).mean[0])
    drift = _find_drift(search, lag, initial.beliefs[USBL_MOUNT[2]], float(np.ptp(problem.time)))
    return [found for found in (late, drift) if found is not None]


def _find_latency(search: "_LagSearch", belief: Belief, earliest: float) -> UnstatedNoise | None:
    stated = float(belief.mean[0])
    lags = stated + np.arange(earliest, LATEST_S + STEP_S / 2, STEP_S)
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
        f"its stamps are {abs(lag):.2f} s {'late' if lag > 0.0 else 'early'} beside the vehicle's own motion and the "
        f"ship's{' with delay_s.usbl taken off' if search.initial.config.delay_s.get('usbl') else ''}",
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
        state = interpolated(self.states, self.time, stream.time, {**self.calibration, LATENCY: np.array([lag])})
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


def interpolated(states: State, time: Array, wanted: Array, calibration: Mapping[str, Array]) -> State:
    """States between keyframes: attitude by the turn between two, position and velocity along a line."""
    k = time.searchsorted(wanted).clip(1, len(time) - 1)
    share = ((wanted - time[k - 1]) / (time[k] - time[k - 1]))[:, None]
    p, v = ((1.0 - share) * a[k - 1] + share * a[k] for a in (states.p_n, states.v_n))
    return State(slerp(time, states.R_nb, wanted), p, v, states.bias[k], calibration)
