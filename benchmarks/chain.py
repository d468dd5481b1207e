"""The chain solver against LAPACK's banded Cholesky and GTSAM's elimination, on the same linear system.

    python benchmarks/chain.py                         processor time a keyframe, 3000 keyframes
    python benchmarks/chain.py --accuracy 3000 160000  errors of the last keyframe's sds and of the solution

The system is a linearised dive: a vehicle that surveys at 0.4 m/s, its IMU's motion between keyframes at 5.6 Hz,
a DVL, a compass and depth, with pose, velocity and bias at each keyframe. It is solved alone, and with a border of
calibration: the DVL's yaw and scale, the compass's offset and deviation. GTSAM gets it as rovgraph's own graph has
it (three keys a keyframe, one factor for the measurements of each), and without a border with one key a keyframe too.
`solveh_banded` begins with the normal equations, whose making is not charged to it; the others with whitened rows.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from scipy.linalg import solveh_banded

from rovgraph.geometry import Array, exp_rotation, log_rotation, matrix_from_rpy, skew, transpose
from rovgraph.inference.chain_information import MeasurementRows, MotionRows, eliminate
from rovgraph.inference.graph.optimum import covariances

RATE = 5.6  # keyframes a second
SAMPLES = 18  # of the IMU between two
ACC, GYR, ACC_WALK, GYR_WALK, INTEGRATION = 8e-4, 6.9e-4, 1.6e-3, 8.7e-5, 1e-3  # noise densities, SI
DVL_SD, DEPTH_SD, HEADING_SD = np.array([0.004, 0.004, 0.002]), 0.05, np.deg2rad(2.0)
LEVER_B = np.array([0.24, 0.0, 0.33])
GRAVITY_N = np.array([0.0, 0.0, 9.81])
CALIBRATION = {"dvl_yaw": 0.1, "dvl_scale": 0.01, "compass_offset": 0.1, "deviation_sin": 0.05, "deviation_cos": 0.05}
D, CHUNK = 15, 4000


@dataclass(frozen=True)
class Dive:
    """Whitened rows of a linearised dive.

    Attributes
    ----------
    A_i, A_j, r : ndarray, shapes (n - 1, 15, 15) and (n - 1, 15), of motions
    J, C, z : ndarray, shapes (n, 5, 15), (n, 5, c) and (n, 5), of measurements
    prior : ndarray, shape (15, 15), of the first keyframe
    border_prior : ndarray, shape (c, c)
    """

    A_i: Array
    A_j: Array
    r: Array
    J: Array
    C: Array
    z: Array
    prior: Array
    border_prior: Array

    def __len__(self) -> int:
        return len(self.J)


def make_dive(n: int, position_sd: float = 0.1, border: bool = False, seed: int = 0) -> Dive:
    """Rows of a dive of n keyframes, right-hand sides white; the border is empty, or has `CALIBRATION`."""
    rng, t = np.random.default_rng(seed), np.arange(n) / RATE
    turns = np.pad(0.5 * np.pi * np.floor(t / 60.0), 20, "edge")  # a leg a minute, and some seconds to turn
    yaw = np.convolve(turns, np.full(41, 1.0 / 41.0), "valid") + 0.3 * np.sin(t / 7.0)
    R = matrix_from_rpy(np.column_stack([0.05 * np.sin(t / 2.3), 0.05 * np.sin(t / 3.1), yaw]))
    v_b = np.column_stack([0.4 + 0.1 * np.sin(t / 11.0), 0.05 * np.sin(t / 5.0), 0.02 * np.sin(t / 13.0)])
    J = np.zeros((n, 5, D))
    J[:, :3, :3], J[:, :3, 6:9], J[:, :3, 12:] = skew(v_b), transpose(R), skew(LEVER_B)
    J[:, :3] /= DVL_SD[:, None]
    J[:, 3, 3:6], J[:, 4, :3] = R[:, 2] / DEPTH_SD, R[:, 2] / HEADING_SD
    C = np.zeros((n, 5, len(CALIBRATION)))
    C[:, 0, 0], C[:, 1, 0], C[:, :3, 1] = v_b[:, 1], -v_b[:, 0], v_b
    C[:, :3] /= DVL_SD[:, None]
    C[:, 4, 2:] = np.column_stack([np.ones(n), np.sin(yaw), np.cos(yaw)]) / HEADING_SD
    count = len(CALIBRATION) if border else 0
    prior_sd = np.repeat([np.deg2rad(2.0), position_sd, 0.1, 0.05, 2e-3], 3)
    A_i, A_j = _motions(R, np.einsum("kij,kj->ki", R, v_b))
    r, z = rng.standard_normal((n - 1, D)), rng.standard_normal((n, 5))
    border_prior = np.diag(1.0 / np.array([*CALIBRATION.values()][:count]))
    return Dive(A_i, A_j, r, J, C[..., :count].copy(), z, np.diag(1.0 / prior_sd), border_prior)


def _motions(R: Array, v_n: Array) -> tuple[Array, Array]:
    """Whitened Jacobians of the motions, error states and noise propagated from sample to sample."""
    step, count = 1.0 / RATE / SAMPLES, len(R) - 1
    rate = log_rotation(transpose(R[:-1]) @ R[1:]) * RATE
    force = np.einsum("kji,kj->ki", R[:-1], np.diff(v_n, axis=0) * RATE - GRAVITY_N)
    noise = np.repeat([GYR, INTEGRATION, ACC, ACC_WALK, GYR_WALK], 3) ** 2 * step
    A_i, A_j = np.empty((count, D, D)), np.empty((count, D, D))
    for begin in range(0, count, CHUNK):
        own = slice(begin, begin + CHUNK)
        R_now, turn = R[:-1][own].copy(), exp_rotation(rate[own] * step)
        F, Q = np.zeros((len(R_now), D, D)) + np.eye(D), np.zeros((len(R_now), D, D))
        for _ in range(SAMPLES):
            G = np.zeros_like(F) + np.eye(D)
            G[:, :3, :3] = G[:, 3:6, 3:6] = transpose(turn)
            G[:, :3, 12:] = -step * np.eye(3)
            G[:, 3:6, 6:9] = step * transpose(R_now)
            G[:, 6:9, :3], G[:, 6:9, 9:12] = -step * R_now @ skew(force[own]), -step * R_now
            F, Q = G @ F, G @ Q @ transpose(G) + np.diag(noise)
            R_now = R_now @ turn
        # upper triangular, as GTSAM whitens, so that a walk's rows know of nothing but the bias
        A_j[own] = np.linalg.inv(np.linalg.cholesky(Q[:, ::-1, ::-1]))[:, ::-1, ::-1]
        A_i[own] = -A_j[own] @ F
    return A_i, A_j


def rows(dive: Dive) -> tuple[MotionRows, MeasurementRows, Array]:
    """The dive as the chain solver takes it."""
    n, m, c = dive.C.shape
    start, targets = np.zeros(1, dtype=np.int64), D + np.arange(c)
    measurements = MeasurementRows(n, D, [start, np.arange(n)], [D, m], c)
    measurements.put(0, np.zeros((1, D)), dive.prior[None], np.zeros((1, D, 0)), targets[:0], np.ones(1))
    measurements.put(1, dive.z, dive.J, dive.C, targets, np.ones(n))
    border_rows = np.column_stack([dive.border_prior, np.zeros(c)])
    return MotionRows.of_states(dive.A_i, dive.A_j, dive.r), measurements, border_rows


def normal_equations(dive: Dive) -> tuple[Array, Array]:
    """Information matrix in LAPACK's lower banded form, shape (30, 15 n), and its right-hand side, shape (15 n,)."""
    n = len(dive)
    diagonal, b = transpose(dive.J) @ dive.J, np.einsum("kri,kr->ki", dive.J, dive.z)
    diagonal[0] += dive.prior.T @ dive.prior
    diagonal[:-1] += transpose(dive.A_i) @ dive.A_i
    diagonal[1:] += transpose(dive.A_j) @ dive.A_j
    b[:-1] += np.einsum("kri,kr->ki", dive.A_i, dive.r)
    b[1:] += np.einsum("kri,kr->ki", dive.A_j, dive.r)
    below, band = transpose(dive.A_j) @ dive.A_i, np.zeros((2 * D, n * D))
    for j in range(D):
        band[: D - j, j::D] = diagonal[:, j:, j].T
        band[D - j : 2 * D - j, j : (n - 1) * D : D] = below[:, :, j].T
    return band, b.ravel()


PARTS = {"x": slice(0, 6), "v": slice(6, 9), "b": slice(9, 15)}


def gtsam_graph(dive: Dive, whole: bool = False) -> gtsam.GaussianFactorGraph:
    """The dive for GTSAM, with one key a keyframe, or with three as rovgraph has them."""
    parts = {"x": slice(0, D)} if whole else PARTS
    unit = {m: gtsam.noiseModel.Unit.Create(m) for m in (1, dive.J.shape[1], D)}
    graph, border = gtsam.GaussianFactorGraph(), [gtsam.symbol("c", i) for i in range(dive.C.shape[2])]

    def add(r: Array, *jacobians: tuple[int, Array], others: Sequence[tuple[int, Array]] = ()) -> None:
        terms = [(gtsam.symbol(c, k), A[:, own]) for k, A in jacobians for c, own in parts.items()]
        graph.push_back(gtsam.GaussianConditional([*terms, *others], 1, r, unit[len(r)]))

    add(np.zeros(D), (0, dive.prior))
    for i, key in enumerate(border):
        add(np.zeros(1), others=[(key, dive.border_prior[i : i + 1, i : i + 1])])
    for k, (r, A_i, A_j) in enumerate(zip(dive.r, dive.A_i, dive.A_j, strict=True)):
        add(r, (k, A_i), (k + 1, A_j))
    for k, (z, J, C) in enumerate(zip(dive.z, dive.J, dive.C, strict=True)):
        add(z, (k, J), others=[(key, C[:, i : i + 1]) for i, key in enumerate(border)])
    return graph


def processor_time(function: Callable[[], Any], repeats: int) -> float:
    """The shortest of some runs [s]."""
    spent = []
    for _ in range(repeats):
        began = time.process_time()
        function()
        spent.append(time.process_time() - began)
    return min(spent)


def speed(n: int, border: bool, repeats: int = 5) -> dict[str, float]:
    """Processor time a keyframe of each solver [us]."""
    dive = make_dive(n, border=border)
    own = rows(dive)
    root = eliminate(*own)
    P_y = root.border_covariance()
    out = {
        "chain": processor_time(lambda: eliminate(*own).solve(), repeats),
        "chain's covariances of all keyframes": processor_time(lambda: root.covariances(P_y), repeats),
    }
    if not border:
        band, b = normal_equations(dive)
        out["solveh_banded"] = processor_time(lambda: solveh_banded(band, b, lower=True, check_finite=False), repeats)
    for keys in ("three keys",) if border else ("three keys", "one key"):
        graph = gtsam_graph(dive, whole=keys == "one key")
        for name, order in (
            ("COLAMD", gtsam.Ordering.ColamdGaussianFactorGraph(graph)),
            ("METIS", gtsam.Ordering.MetisGaussianFactorGraph(graph)),
        ):
            label = f"GTSAM, {keys}, {name}"
            out[f"{label}, Cholesky"] = processor_time(lambda g=graph, o=order: g.optimize(o), repeats)
            out[f"{label}, QR"] = processor_time(lambda g=graph, o=order: g.optimize(o, gtsam.EliminateQR), repeats)
    return {name: seconds / n * 1e6 for name, seconds in out.items()}


@dataclass(frozen=True)
class Accuracy:
    """How far a solver is from GTSAM's QR.

    Attributes
    ----------
    solution : largest difference of the solution, in sds
    sd, last_sd : largest relative difference of the sds of all keyframes and of the last one
    """

    solution: float
    sd: float
    last_sd: float


def accuracy(n: int, position_sd: float) -> dict[str, Accuracy]:
    """Chain solver and banded Cholesky against GTSAM's elimination by QR; nan where there is no result."""
    dive = make_dive(n, position_sd)
    x, sd = _by_gtsam(dive)
    root = eliminate(*rows(dive))
    P = root.covariances(np.zeros((0, 0)))
    own = np.sqrt(np.einsum("kii->ki", P))
    out = {
        "chain": Accuracy(_largest((root.solve()[0] - x) / sd), _largest(own / sd - 1), _largest(own[-1] / sd[-1] - 1))
    }
    band, b = normal_equations(dive)
    rhs = np.column_stack([b, np.zeros((len(b), D))])
    rhs[-D:, 1:] = np.eye(D)
    try:
        solved = solveh_banded(band, rhs, lower=True, overwrite_ab=True, overwrite_b=True, check_finite=False)
    except np.linalg.LinAlgError:  # not positive definite
        solved = np.full_like(rhs, np.nan)
    last_sd = np.sqrt(np.diag(solved[-D:, 1:]))
    of_solution = _largest((solved[:, 0].reshape(n, D) - x) / sd)
    return out | {"solveh_banded": Accuracy(of_solution, np.nan, _largest(last_sd / sd[-1] - 1))}


def _largest(differences: Array) -> float:
    return float(np.abs(differences).max())


def _by_gtsam(dive: Dive) -> tuple[Array, Array]:
    """Solution and sds of all keyframes, shape (n, 15)."""
    graph = gtsam_graph(dive)
    tree = graph.eliminateMultifrontal(gtsam.Ordering.MetisGaussianFactorGraph(graph), gtsam.EliminateQR)
    solution, P = tree.optimize(), covariances(tree)
    keys = [[gtsam.symbol(c, k) for c in PARTS] for k in range(len(dive))]
    x = [np.concatenate([solution.at(key) for key in own]) for own in keys]
    return np.array(x), np.sqrt([np.concatenate([np.diag(P[key]) for key in own]) for own in keys])


def main(n: int, lengths: list[int]) -> None:
    """Measure and print."""
    if not lengths:
        print(f"| {n} keyframes | border | us a keyframe | times the chain's |\n|---|---|---|---|")
        for border in (False, True):
            times = speed(n, border)
            for name, spent in times.items():
                print(
                    f"| {name} | {len(CALIBRATION) * border} | {spent:.1f} | {spent / times['chain']:.1f} |", flush=True
                )
    else:
        print("| keyframes | position prior | solver | solution [sd] | sds | last sds |\n|---|---|---|---|---|---|")
    for length in lengths:
        for position_sd in (0.1, 1000.0):
            for name, a in accuracy(length, position_sd).items():
                errors = f"{a.solution:.0e} | {a.sd:.0e} | {a.last_sd:.0e}"
                print(f"| {length} | {position_sd:g} m | {name} | {errors} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keyframes", type=int, default=3000, help="of the system that is timed")
    parser.add_argument("--accuracy", type=int, nargs="+", default=[], help="keyframes of the systems to compare on")
    arguments = parser.parse_args()
    main(arguments.keyframes, arguments.accuracy)
