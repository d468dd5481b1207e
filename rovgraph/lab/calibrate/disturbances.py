"""Changes of the magnetic field that belong to the vehicle: something magnetic was attached or removed.

Over seconds the gyro gives the vehicle's rotation R(t) from its axes to those of the beginning, so

    y(t) = R(t)^T h + b(t)

with the field h outside, and b constant in the IMU's axes. That is linear in h and b, needs no
heading, and averages of samples obey it exactly with averages of R^T. A step of b is looked for
between two halves of a window that slides over the log; then b of the stretches between steps comes
from all of the log at once, with an h that may drift as the gyro does. Stretches whose b
differs from the one that holds longest are disturbances, and begin and end where the residual
against that one does. After Troni and Whitcomb 2019 (field sensor bias from angular rate), with steps.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import find_peaks  # type: ignore[attr-defined]
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu

from rovgraph.geometry import Array, exp_rotation, transpose

BIN_S = 0.25  # samples are averaged over this
HALF_S = 6.0  # half of the window in which a step is looked for
SIGNIFICANT = 5.0  # sd of a step's size that it has to exceed
TRANSITION_S = 1.0  # around a step, left out when offsets are determined
NODE_S = 10.0  # between nodes of the drifting field
DRIFT = 0.03  # of the field from node to node
MODEL_SD = 0.02  # error of a bin, of the field
SHORTEST_S = 1.0  # of a disturbance
PLAIN = 0.15  # of a disturbance: a residual of this size belongs to it
STILL_S, STILL_SCATTER, STILL_MEAN = 5.0, 0.02, 0.03  # a rest from which the gyro's bias is taken [s, rad/s, rad/s]


@dataclass(frozen=True)
class Disturbance:
    """A stretch of the log with another field in the IMU's axes than the rest.

    Attributes
    ----------
    start, end : [s]
    vector, sd : ndarray, shape (3,), the field that was added, IMU axes [log's unit]
    """

    start: float
    end: float
    vector: Array
    sd: Array

    @property
    def size(self) -> float:
        return float(np.linalg.norm(self.vector))


@dataclass(frozen=True)
class Bins:
    """Averages over `BIN_S`.

    Attributes
    ----------
    time : ndarray, shape (n,) [s]
    R_t : ndarray, shape (n, 3, 3), mean of R(t)^T
    field : ndarray, shape (n, 3)
    """

    time: Array
    R_t: Array
    field: Array

    def __len__(self) -> int:
        return len(self.time)


def turned(time: Array, rate: Array) -> Array:
    """R(t) of integrated rates, identity at the beginning; the bias is taken off where there is a rest.

    Parameters
    ----------
    time : ndarray, shape (n,) [s]
    rate : ndarray, shape (n, 3) [rad/s]

    Returns
    -------
    ndarray, shape (n, 3, 3)
    """
    rate = rate - _bias_at_rest(time, rate)
    step = exp_rotation(0.5 * (rate[1:] + rate[:-1]) * np.diff(time)[:, None])
    R = np.empty((len(time), 3, 3))
    R[0] = np.eye(3)
    for k in range(len(step)):
        R[k + 1] = R[k] @ step[k]
    return R


def _bias_at_rest(time: Array, rate: Array) -> Array:
    """Mean rate of the quietest `STILL_S`, shape (3,); zero where the log never rests."""
    part = np.floor((time - time[0]) / STILL_S).astype(int)
    rests = [rate[part == i] for i in range(part[-1])]
    quietest = min(rests, key=lambda r: r.std(axis=0).max() if len(r) > 1 else np.inf, default=rate)
    mean = quietest.mean(axis=0)
    rests_there = quietest.std(axis=0).max() < STILL_SCATTER and np.abs(mean).max() < STILL_MEAN
    return np.asarray(mean if rests_there else np.zeros(3))


def make_bins(time: Array, field: Array, imu_time: Array, R: Array) -> Bins:
    """Average magnetometer samples and the attitudes at them.

    Parameters
    ----------
    time, field : ndarray, shape (n,), (n, 3), magnetometer
    imu_time, R : ndarray, shape (m,), (m, 3, 3), of `turned`
    """
    inside = (time >= imu_time[0]) & (time <= imu_time[-1])
    time, field = time[inside], field[inside]
    at = np.searchsorted(imu_time, time)
    nearer = (at > 0) & (time - imu_time[at - 1] < imu_time[at] - time)
    R_t = transpose(R[at - nearer])
    first = np.unique(np.floor((time - time[0]) / BIN_S), return_index=True)[1]
    count = np.diff(np.append(first, len(time)))
    return Bins(
        np.add.reduceat(time, first) / count,
        np.add.reduceat(R_t, first) / count[:, None, None],
        np.add.reduceat(field, first) / count[:, None],
    )


def find_disturbances(bins: Bins, length: float, smallest: float) -> list[Disturbance]:
    """Stretches in which a field was added that is constant in the IMU's axes.

    Parameters
    ----------
    bins : of `make_bins`
    length : of the field [log's unit]
    smallest : least size of a disturbance [log's unit]
    """
    steps = _steps(bins, smallest)
    if not steps:
        return []
    edges = np.array([0, *steps, len(bins)])
    stretch = np.repeat(np.arange(len(edges) - 1), np.diff(edges))
    outside, offset, _ = _offsets(bins, stretch, length)
    kind = _kinds(offset, _own_sd(bins, edges, length), np.diff(edges), smallest, 0.2 * length)
    _, joined, sd = _offsets(bins, kind[stretch], length)
    found = []
    for k in range(1, len(joined)):
        part = np.flatnonzero(kind == k)
        vector = joined[k] - joined[0]
        residual = [bins.field - outside - offset[max(i, 0) % len(offset)] for i in (part[0] - 1, part[-1] + 1)]
        seen = max(smallest, PLAIN * float(np.linalg.norm(vector)))
        off = [np.linalg.norm(r, axis=1) > seen for r in residual]
        start = _reach(bins.time, off[0], edges[part[0]], -1)
        end = _reach(bins.time, off[1], edges[part[-1] + 1], 1)
        if np.linalg.norm(vector) >= smallest and end - start >= SHORTEST_S:
            found.append(Disturbance(start, end, vector, np.hypot(sd[k], sd[0])))
    return found


def _steps(bins: Bins, smallest: float) -> list[int]:
    """Bins at which b steps: local maxima of what a step in the middle of a window explains."""
    half = round(HALF_S / BIN_S)
    if len(bins) < 2 * half + 1:
        return []
    gain, size, sd = _step_statistics(bins, half)
    there = (size >= smallest) & (size >= SIGNIFICANT * sd)
    peaks, _ = find_peaks(np.concatenate([[0.0], np.where(there, gain, 0.0), [0.0]]), distance=half)
    return [int(p) - 1 + half for p in peaks]


def _step_statistics(bins: Bins, half: int) -> tuple[Array, Array, Array]:
    """For every window: squares that a step in its middle explains, its size and sd.

    The normal equations of (h, b, step) are sums over bins, so windows are differences of running sums.
    """
    design = np.concatenate([bins.R_t, np.broadcast_to(np.eye(3), bins.R_t.shape)], axis=2)  # of (h, b)
    P = _running(transpose(design) @ design)
    q = _running(np.einsum("nij,ni->nj", design, bins.field))
    squares = _running((bins.field**2).sum(axis=1))
    low, mid, high = (slice(i * half, len(bins) + 1 - (2 - i) * half) for i in range(3))
    N = np.empty((len(P[low]), 9, 9))
    whole, right = P[high] - P[low], P[high] - P[mid]
    N[:, :6, :6], N[:, 6:, :6], N[:, :6, 6:], N[:, 6:, 6:] = whole, right[:, 3:], right[:, :, 3:], right[:, 3:, 3:]
    y = np.concatenate([q[high] - q[low], (q[high] - q[mid])[:, 3:]], axis=1)
    N += 1e-6 * half * np.eye(9)  # at rest h and b cannot be separated; the step is
    inverse = np.linalg.inv(N)
    x, without = np.einsum("nij,nj->ni", inverse, y), np.linalg.solve(N[:, :6, :6], y[:, :6, None])[..., 0]
    left = np.maximum(squares[high] - squares[low] - np.einsum("ni,ni->n", x, y), 0.0)
    gain = np.einsum("ni,ni->n", x, y) - np.einsum("ni,ni->n", without, y[:, :6])
    variance = left / (6 * half - 9) * np.trace(inverse[:, 6:, 6:], axis1=1, axis2=2)
    return gain, np.linalg.norm(x[:, 6:], axis=1), np.sqrt(variance)


def _running(values: Array) -> Array:
    """Running sums along the first axis, zero first."""
    return np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])


def _offsets(bins: Bins, label: NDArray[np.int64], length: float) -> tuple[Array, Array, Array]:
    """b of every label, with an outside field that drifts as a random walk between nodes.

    Returns
    -------
    R^T h : ndarray, shape (n, 3); b : ndarray, shape (labels, 3); sd : the same
    """
    n, count = len(bins), int(label.max()) + 1
    place = (bins.time - bins.time[0]) / NODE_S
    nodes = int(np.ceil(place[-1])) + 1
    before = np.minimum(place.astype(int), nodes - 2)
    share = place - before
    node = [3 * (before + i)[:, None, None] + np.arange(3)[None, None, :] for i in (0, 1)]
    label_columns = 3 * (nodes + label)[:, None, None] + np.arange(3)[None, None, :]
    row = (3 * np.arange(n)[:, None] + np.arange(3))[:, :, None]
    parts = (
        (node[0], bins.R_t * (1.0 - share)[:, None, None]),
        (node[1], bins.R_t * share[:, None, None]),
        (label_columns, np.broadcast_to(np.eye(3), (n, 3, 3))),
    )
    shape = (n, 3, 3)
    value, rows, columns = (
        np.concatenate([np.broadcast_to(x, shape).ravel() for x in some])
        for some in ([v for _, v in parts], [row] * 3, [c for c, _ in parts])
    )
    A = coo_matrix((value, (rows, columns)), shape=(3 * n, 3 * (nodes + count))).tocsr()
    change = np.flatnonzero(np.diff(label)) + 1
    clear = ~np.any(np.abs(bins.time[:, None] - bins.time[change]) < TRANSITION_S, axis=1)
    weight = np.repeat(clear / (MODEL_SD * length) ** 2, 3)
    N = (A.T @ diags(weight) @ A + _drift_prior(nodes, count, length)).tocsc()
    solver = splu(N)
    x = solver.solve(A.T @ (weight * bins.field.ravel()))
    unit = np.eye(N.shape[0])[:, 3 * nodes :]
    sd = np.sqrt(np.diag(solver.solve(unit)[3 * nodes :])).reshape(-1, 3)
    drifting = (A[:, : 3 * nodes] @ x[: 3 * nodes]).reshape(-1, 3)
    return drifting, x[3 * nodes :].reshape(-1, 3), sd


def _drift_prior(nodes: int, count: int, length: float) -> Any:
    """Information of the random walk between nodes, and a loose prior of all offsets."""
    D = diags([-np.ones(3 * nodes), np.ones(3 * nodes)], [0, 3], shape=(3 * nodes - 3, 3 * nodes + 3 * count))
    loose = np.concatenate([np.zeros(3 * nodes), np.full(3 * count, 1.0)])
    return D.T @ D / (DRIFT * length) ** 2 + diags(loose) / length**2


def _own_sd(bins: Bins, edges: NDArray[np.int64], length: float) -> Array:
    """How well each stretch by itself separates h from b, as an sd of b; shape (k,). At rest it does not."""
    out = np.empty(len(edges) - 1)
    for k, (low, high) in enumerate(pairwise(edges)):
        mean = bins.R_t[low:high].mean(axis=0)
        told_apart = (high - low) * np.linalg.eigvalsh(np.eye(3) - mean @ mean.T)[0]
        out[k] = MODEL_SD * length * np.sqrt(3.0 / max(float(told_apart), 1e-9))
    return out


def _kinds(offset: Array, own_sd: Array, lasting: NDArray[np.int64], least: float, most: float) -> NDArray[np.int64]:
    """Which stretches share an offset: 0 the one that holds longest, others counted in the order of time.

    Stretches that hardly determine their own offset (at rest) count as different only when
    they differ by ``most``.
    """
    tolerance = np.clip(3.0 * np.hypot(own_sd[:, None], own_sd[None]), least, most)
    near = np.linalg.norm(offset[:, None] - offset[None], axis=2) < tolerance
    sure = 3.0 * own_sd <= most
    usual = near[int(np.argmax((near @ lasting) * sure))]  # an uncertain stretch is near to all
    kind, count = np.zeros(len(offset), dtype=np.int64), 0
    for i in np.flatnonzero(~usual):
        goes_on = i > 0 and not usual[i - 1] and near[i, i - 1]
        count += not goes_on
        kind[i] = count
    return kind


def _reach(time: Array, off: NDArray[np.bool_], edge: int, side: int) -> float:
    """How far a disturbance reaches across its edge, before it (side -1) or after it (1) [s].

    ``off`` marks where the field is not that of the neighbouring stretch. A transition may
    take as long as half a window; shorter returns in between belong to it.
    """
    if edge in (0, len(time)):
        return float(time[0] if edge == 0 else time[-1])
    now = float(time[edge])
    inner = edge + round(TRANSITION_S / BIN_S) * -side
    order = range(int(np.clip(inner, 0, len(time) - 1)), len(time) if side > 0 else -1, side)
    last = now
    for i in order:
        if abs(time[i] - now) > HALF_S or side * (time[i] - last) > SHORTEST_S:
            break
        if off[i]:
            last = float(time[i])
    return last + 0.5 * side * BIN_S
