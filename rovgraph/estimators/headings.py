"""What heading sources say of an attitude: by which angle about down it is to be turned.

All of it through the instruments' own models, so it serves every source alike.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rovgraph.calibration import Belief
from rovgraph.config import Config, beliefs
from rovgraph.geometry import Array, exp_rotation, transpose, wrap_angle
from rovgraph.instruments import OFFSETS, Instrument
from rovgraph.sensors import innovation
from rovgraph.state import POSE, Jacobians, State

MOST_STEPS, FOUND_WITHIN = 10, 1e-6  # of the search for a turn [-, rad]


class TurnNoise(NamedTuple):
    """How a turn that a source asks for errs.

    Attributes
    ----------
    variance : ndarray, shape (n,), by the noise of each measurement [rad^2]
    by_tilt : ndarray, shape (n,), its square by that of a tilt, either axis
    deviation_var : by what is believed of the source's calibration, as far as that changes with the heading [rad^2]
    """

    variance: Array
    by_tilt: Array
    deviation_var: float


def trusted_first(config: Config, sources: list[str]) -> list[str]:
    """Heading sources with those first whose offset is held fixed, or known best.

    Parameters
    ----------
    config : priors of the offsets
    sources : of `rovgraph.instruments.HEADING_STREAMS`
    """
    priors = beliefs(config)
    return sorted(sources, key=lambda s: priors[OFFSETS[s]].sd if priors[OFFSETS[s]].estimate else 0.0)


def solve_turn(instrument: Instrument, z: Array, R_nb: Array, calibration: Mapping[str, Array]) -> Array:
    """Angles about down by which attitudes are turned to predict measurements best, shape (n,) [rad].

    By Gauss-Newton. A heading is about linear in the turn, so any beginning will do; a vector goes round in a
    circle, which is known from four points of it.

    Parameters
    ----------
    instrument : a heading source
    z : ndarray, shape (n, dim)
    R_nb : ndarray, shape (n, 3, 3), attitudes, of which roll and pitch count
    calibration : name -> ndarray, shape (dim of variable,), all that the instrument depends on
    """
    model, still, turn = instrument.model, np.zeros((len(z), 3)), np.zeros(len(z))
    if not model.angular:
        a, b, c, d = (
            model.predict(_turn_about_down(R_nb, np.full(len(z), side), calibration), still)[0]
            for side in np.arange(4) * 0.5 * np.pi
        )
        beyond = z - 0.25 * (a + b + c + d)
        turn = np.arctan2(np.sum((b - d) * beyond, axis=1), np.sum((a - c) * beyond, axis=1))
    for _ in range(MOST_STEPS):
        there = _turn_about_down(R_nb, turn, calibration)
        predicted, H = model.predict(there, still)
        step = np.sum(_weigh_components(there, H) * innovation(model, z, predicted), axis=1)
        turn = turn + step
        if np.abs(step).max(initial=0.0) < FOUND_WITHIN:
            break
    return wrap_angle(turn)


def turn_noise(
    instrument: Instrument, R_nb: Array, turn: Array, calibration: Mapping[str, Array], priors: Mapping[str, Belief]
) -> TurnNoise:
    """How turns err that are found by `solve_turn`.

    Parameters
    ----------
    instrument, R_nb, calibration : as of `solve_turn`
    turn : ndarray, shape (n,) [rad]
    priors : of all calibration variables
    """
    there = _turn_about_down(R_nb, turn, calibration)
    _, H = instrument.model.predict(there, np.zeros((len(turn), 3)))
    by_z = _weigh_components(there, H)
    tilts_n = H[POSE][..., :3] @ transpose(there.R_nb)[..., :2]
    estimated = [belief for name, belief in priors.items() if belief.estimate and name in H]
    by_calibration = [belief.sd * np.einsum("nd,ndk->nk", by_z, H[belief.variable.name]) for belief in estimated]
    return TurnNoise(
        np.sum((by_z * instrument.sd) ** 2, axis=1),
        np.sum(np.einsum("nd,ndk->nk", by_z, tilts_n) ** 2, axis=1),
        float(sum(turns.var(axis=0).sum() for turns in by_calibration)),
    )


def _turn_about_down(R_nb: Array, turn: Array, calibration: Mapping[str, Array]) -> State:
    nowhere, down = np.zeros((len(turn), 3)), np.zeros((len(turn), 3))
    down[:, 2] = turn
    return State(exp_rotation(down) @ R_nb, nowhere, nowhere, np.zeros((len(turn), 6)), calibration)


def _weigh_components(there: State, H: Jacobians) -> Array:
    """The turn that best explains a measurement by its components, shape (n, dim)."""
    slope = np.einsum("ndk,nk->nd", H[POSE][..., :3], there.R_nb[:, 2, :])  # a turn about down is R_bn e_z in b
    return np.asarray(slope / np.maximum(np.sum(slope**2, axis=1), 1e-12)[:, None])
