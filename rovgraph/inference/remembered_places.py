"""Places that a filter remembers: stochastic cloning (Roumeliotis and Burdick 2002).

A filter keeps no old positions, so each place that is seen becomes a part of its state: its position, with covariance
and with correlation to the rest of the state. When it is seen again, it corrects the drift since, consistently by these
correlations. Places come after all other components of the error, two each, north and east. They do not move, and their
errors are in n, so a correction does not change their coordinates.

A landmark that fits no place of its name begins another place, as in `rovgraph.inference.graph.places`; so a false one
does no harm. Beyond `place.remembered` places, the one that was not seen for longest is forgotten.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rovgraph.geometry import Array
from rovgraph.model.state import PLACE_DIM


@dataclass(frozen=True)
class RememberedPlace:
    """A place that is remembered.

    Attributes
    ----------
    name, number : of the sightings
    position : ndarray, shape (2,), north and east [m]
    time : when it was last seen [s]
    """

    name: float
    number: int
    position: Array
    time: float


def rows(size: int, index: int) -> slice:
    """Components of a place in an error whose first ``size`` are no places."""
    return slice(size + PLACE_DIM * index, size + PLACE_DIM * (index + 1))


def columns(size: int, chosen: Sequence[int]) -> Array:
    """Components of the state without its places, and of some places."""
    return np.concatenate([np.arange(size), *(np.r_[rows(size, k)] for k in chosen)])


def padded(H: Array, size: int) -> Array:
    """Jacobian of what depends on no place, shape (..., size)."""
    missing = size - H.shape[-1]
    return np.concatenate([H, np.zeros((*H.shape[:-1], missing))], axis=-1) if missing else H


def extended(basis: Array, size: int) -> Array:
    """A change of basis that leaves places alone, shape (size, size)."""
    out = np.eye(size)
    out[: len(basis), : len(basis)] = basis
    return out


def moved(places: Sequence[RememberedPlace], delta: Array) -> tuple[RememberedPlace, ...]:
    """Places corrected by the end of an error, shape (2 len(places),)."""
    return tuple(replace(p, position=p.position + d) for p, d in zip(places, delta.reshape(-1, PLACE_DIM), strict=True))


def common(some: Sequence[RememberedPlace], others: Sequence[RememberedPlace]) -> tuple[list[int], list[int], Array]:
    """Places in both of two estimates.

    Returns
    -------
    list of int, list of int : their indices among the ones and the others
    ndarray, shape (2 k,) : from where the ones have them to where the others do [m]
    """
    there = {place.number: k for k, place in enumerate(others)}
    pairs = [(k, there[place.number]) for k, place in enumerate(some) if place.number in there]
    shift = [others[j].position - some[i].position for i, j in pairs]
    return [i for i, _ in pairs], [j for _, j in pairs], np.concatenate([np.zeros(0), *shift])


def seen_at(places: Sequence[RememberedPlace], index: int, time: float) -> tuple[RememberedPlace, ...]:
    """Places of which one has just been seen."""
    return tuple(replace(p, time=time) if k == index else p for k, p in enumerate(places))


@dataclass(frozen=True)
class Match:
    """A landmark compared with a place that is remembered.

    Attributes
    ----------
    index : of the place
    r, H : whitened innovation, shape (2,), and Jacobian, shape (2, d)
    nis : normalised innovation squared
    """

    index: int
    r: Array
    H: Array
    nis: float


def nearest(
    P: Array, r: Array, H: Array, sd: Array, size: int, places: Sequence[RememberedPlace], name: float
) -> Match | None:
    """The place of a name that a landmark fits best; None if it fits no place.

    Parameters
    ----------
    P : ndarray, shape (d, d), of the estimate and its places
    r, H : whitened innovation and Jacobian, shapes (2,) and (2, size), of a place at the origin
    sd : ndarray, shape (2,), of the landmark [m]
    size : of the error without places
    places, name : those that are remembered, and the one that is seen
    """
    matches = []
    for k, place in enumerate(places):
        if place.name == name:
            own_H = padded(H, len(P))
            own_H[:, rows(size, k)] = -np.diag(1.0 / sd)
            own_r = r + place.position / sd
            S = own_H @ P @ own_H.T + np.eye(PLACE_DIM)
            matches.append(Match(k, own_r, own_H, float(own_r @ np.linalg.solve(S, own_r))))
    return min(matches, key=lambda match: match.nis, default=None)


def with_another(
    P: Array, B: Array, places: tuple[RememberedPlace, ...], place: RememberedPlace, J: Array, J_y: Array, sd: Array
) -> tuple[Array, Array, tuple[RememberedPlace, ...]]:
    """The covariance with a place more, which lies where the estimate and its landmark put it.

    Parameters
    ----------
    P, B : ndarray, shapes (d, d), (d, h), of `rovgraph.inference.filter_step.Gaussian`
    places, place : the others, and the one more
    J, J_y : ndarray, shapes (2, size), (2, h), derivatives of where it lies by the error, and by what is considered
    sd : ndarray, shape (2,), of the landmark [m]
    """
    clone = np.vstack([np.eye(len(P)), padded(J, len(P))])
    P = clone @ P @ clone.T
    P[-PLACE_DIM:, -PLACE_DIM:] += np.diag(sd**2)
    if B.size:
        B = np.vstack([B, J @ B[: J.shape[1]] + J_y])
    return P, B, (*places, place)


def without_oldest(
    P: Array, B: Array, places: tuple[RememberedPlace, ...], size: int, most: int
) -> tuple[Array, Array, tuple[RememberedPlace, ...]]:
    """Without the place that was not seen for longest, where there are more than ``most``."""
    if len(places) <= most:
        return P, B, places
    oldest = min(range(len(places)), key=lambda k: places[k].time)
    kept = [k for k in range(len(places)) if k != oldest]
    chosen = columns(size, kept)
    return P[np.ix_(chosen, chosen)], B[chosen] if B.size else B, tuple(places[k] for k in kept)
