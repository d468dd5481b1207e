"""Sources of the variance of a position: the share of each sensor's noise and of each prior.

The optimum is linear in the whitened errors e of all rows, which are independent with unit variance. With A their
Jacobian and s = (A'A)^-1 u the covariance of all variables with the position along u,

    error along u = s' A' e,   so   variance along u = sum over rows of (A_i s)^2,

and each term is the share of row i. A considered variable (Schmidt) adds the square of its effect times its prior's
variance.

A long dive is processed in pieces, since its conditionals and the Jacobians of its measurements are large.
"""

import numpy as np

from rovgraph.geometry import Array, transpose
from rovgraph.inference.chain import MOTION, Chain, ChainStep
from rovgraph.inference.chain_information import SquareRoot, solve_upper
from rovgraph.inference.chain_optimum import ChainOptimum
from rovgraph.kernels import chain_posterior
from rovgraph.model.calibration import TABLE
from rovgraph.model.state import COLUMNS, State
from rovgraph.problem.measurements import Measurements, pieces
from rovgraph.process import stage

POSITION = slice(3, 6)  # in a keyframe's block
STEP = 1e-2  # of a standard deviation, of central differences
PRIOR = {"attitude": slice(0, 3), "position": POSITION, "velocity": slice(6, 9), "bias": slice(9, 15)}


@stage
def variance_sources(best: ChainOptimum, keyframe: int) -> dict[str, float]:
    """Variance of a keyframe's north plus that of its east, by source, the largest first [m^2].

    Sources are sensors by their names ("imu" for the noise of its samples), ``start attitude``, ``start position``,
    ``start velocity`` and ``start bias`` for the priors of the first keyframe, and calibration variables for their
    priors and walks. Their sum is the variance of the estimate, at the IMU.
    """
    names, wide, point = best.unknowns.considered, best.wide, best.linearised_at
    held = sum(TABLE[name].dim for name in names)
    u = np.zeros((wide.layout.d, 2))
    u[POSITION] = point.R_nb[keyframe].T[:, :2]
    found: dict[str, float] = {}
    x, y, effect = _moves(best.eliminated(), keyframe, u, held)
    for own_x, own_y in zip(np.moveaxis(x, 2, 0), y.T, strict=True):
        step = ChainStep(np.ascontiguousarray(own_x), own_y)
        for source, variance in [*_of_noise(wide, point, step), *_of_measurements(wide, best, step)]:
            found[source] = found.get(source, 0.0) + variance
    if held:
        sd = np.concatenate([np.full(TABLE[name].dim, best.beliefs[name].sd) for name in names])
        brought = np.sum((effect * sd) ** 2, axis=0)
        ends = np.cumsum([TABLE[name].dim for name in names])
        for name, part in zip(names, np.split(brought, ends[:-1]), strict=True):
            found[name] = found.get(name, 0.0) + float(part.sum())
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def _moves(root: SquareRoot, keyframe: int, u: Array, held: int) -> tuple[Array, Array, Array]:
    """As `_covariance_with`, and what u' x of the keyframe is by what is held, shape (m, held)."""
    return *_covariance_with(root, keyframe, u, held), u.T @ _by_held(root, keyframe, held)


def _covariance_with(root: SquareRoot, keyframe: int, u: Array, held: int) -> tuple[Array, Array]:
    """Covariance of all variables with u' x of a keyframe, shapes (n, d, m) and (c, m), for u of shape (d, m).

    R'z = u forwards from the keyframe, then R s = z backwards; the border's last components are held.
    """
    (n, d), c = root.conditionals.shape[:2], len(root.border)
    free, later = c - held, root.conditionals[keyframe:]
    z = np.zeros((n, d, u.shape[1]))
    z[keyframe] = _inverse_transposed(later[:1, :, :d])[0] @ u
    for part in pieces(keyframe + 1, n):
        before = slice(part.start - 1, part.stop - 1)
        S = transpose(root.conditionals[before, :, d : 2 * d])
        onward = -_inverse_transposed(root.conditionals[part, :, :d]) @ S
        for k, carry in enumerate(onward, part.start):
            z[k] = carry @ z[k - 1]
    y = np.zeros((c, u.shape[1]))
    if free:
        rest = -np.einsum("kdc,kdm->cm", later[:, :, 2 * d : 2 * d + free], z[keyframe:])
        R = root.border[:free, :free]
        y[:free] = solve_upper(R, np.linalg.solve(R.T, rest))
    chain_posterior.back_substitute(root.conditionals, y, z)
    return z, y


def _inverse_transposed(R: Array) -> Array:
    return transpose(np.asarray(np.linalg.inv(R), dtype=float))


def _by_held(root: SquareRoot, keyframe: int, held: int) -> Array:
    """Derivative of a keyframe by what is held in the border, shape (d, held)."""
    free, later = len(root.border) - held, root.conditionals[keyframe:]
    y = np.zeros((len(root.border), held))
    y[free:] = np.eye(held)
    if free:
        y[:free] = -solve_upper(root.border[:free, :free], root.border[:free, free:-1])
    x = np.zeros((*later.shape[:2], held))
    chain_posterior.back_substitute(later, y, x)
    return np.asarray(x[0])


def _of_noise(chain: Chain, point: State, step: ChainStep) -> list[tuple[str, float]]:
    """Shares of the IMU's noise, priors and walks: their residuals are differenced along the step."""
    ahead, behind = (chain.moved(point, step, sign * STEP / _size(step)) for sign in (1.0, -1.0))
    scale = (_size(step) / (2 * STEP)) ** 2
    out = [("imu", scale * _squares(chain.problem.motion_residuals(ahead) - chain.problem.motion_residuals(behind)))]
    starts, priors = (a - b for a, b in zip(chain.prior_residuals(ahead), chain.prior_residuals(behind), strict=True))
    out += [(f"start {name}", scale * _squares(starts[part])) for name, part in PRIOR.items()]
    ends = np.cumsum([TABLE[name].dim for name in chain.unknowns.estimated])
    for name, part in zip(chain.unknowns.estimated, np.split(priors, ends[:-1]), strict=False):
        out.append((name, scale * _squares(part)))
    walks, at = chain.walk_residuals(ahead) - chain.walk_residuals(behind), 0
    for name in chain.layout.walking:
        out.append((name, scale * _squares(walks[:, at : at + TABLE[name].dim])))
        at += TABLE[name].dim
    return out


def _of_measurements(chain: Chain, best: ChainOptimum, step: ChainStep) -> list[tuple[str, float]]:
    """What each sensor's noise brings, by its weighted Jacobians."""
    out = []
    for sensor, block in best.chain.blocks.items():
        moved, gate = np.empty(block.z.shape), best.solution.gates[sensor]
        for part in pieces(0, len(block)):
            piece = block.at(part)
            moved[part] = _along(
                chain, piece, piece.weighted(best.linearised_at.at(piece.keyframe), gate[part])[1], step
            )
        out.append((sensor, _squares(moved)))
    return out


def _along(chain: Chain, block: Measurements, H: dict[str, Array], step: ChainStep) -> Array:
    """Derivative of whitened measurements along a step, shape (n, dim)."""
    dx, total = step.x[block.keyframe], np.zeros(block.z.shape)
    for name, by in H.items():
        if name in COLUMNS:
            move = dx[:, :MOTION][:, COLUMNS[name]]
        elif name in chain.layout.places:
            border, part = chain.layout.places[name]
            move = np.broadcast_to(step.y[part], (len(dx), part.stop - part.start)) if border else dx[:, part]
        else:
            continue
        total += np.einsum("nij,nj->ni", by, move)
    return total


def _size(step: ChainStep) -> float:
    """Largest displacement [m]; it makes the steps of differences small."""
    return float(np.abs(step.x[:, POSITION]).max())


def _squares(values: Array) -> float:
    return float(np.vdot(values, values))
