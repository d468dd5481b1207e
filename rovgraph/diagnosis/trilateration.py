"""A place by ranges along a track that drifts: of a beacon, on either side of the track until its path tells."""

from dataclasses import dataclass

import numpy as np

from rovgraph.geometry import Array
from rovgraph.rules import BENT

LEAST_AROUND_M, AROUND = 10.0, 0.1  # within which a beacon is sought from there on, part of its ranges
STARTS = 24  # of the search for a place, around the track
STEPS = 60  # of each
DRIFT = 0.02  # of dead reckoning, part of the distance
SAME_M = 3.0  # places that near are one
CANDIDATES = 4  # places that are looked at with the drift of the track, the best without it
LEAPS_M = 20.0  # largest step of them
TUKEY = 3.0  # sds at which a range begins to count less


def around(length: Array) -> float:
    """Within which a beacon with such ranges is sought from where they put it, an sd [m]."""
    return max(LEAST_AROUND_M, AROUND * float(np.median(length)))


def trilaterate(p_n: Array, length: Array, sd: Array, down: float, down_sd: float) -> list[tuple[Array, float]]:
    """Places with the robust cost of ranges from n points, the best first, each once.

    Levenberg's method with Cauchy's loss, from all starts at a time.

    Parameters
    ----------
    p_n : ndarray, shape (n, 3) [m]
    length, sd : ndarray, shape (n,), of the ranges [m]
    down, down_sd : depth of the place as believed [m]
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
    rough = trilaterate(ranges.p_n, ranges.length, drifting, down, down_sd)[:CANDIDATES]
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
