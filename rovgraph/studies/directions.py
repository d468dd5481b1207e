"""Directions of the calibration that a dive leaves open, and the same in words.

An eigenvector of the information, in units of the prior's sd, is a combination of components
that the data see by itself; its sd as a part of the prior's is (1 + eigenvalue)^-1/2.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr

from rovgraph.estimators.observability import UNOBSERVABLE_ABOVE, relative_covariance
from rovgraph.geometry import Array

TAKES_PART = 0.25  # a component's share of a direction, of the largest one's
ALIKE = 0.15  # two changes that differ by less than this part are called the same


@dataclass(frozen=True)
class Directions:
    """Eigenvectors of the information, the weakest first.

    Attributes
    ----------
    ratio : ndarray, shape (c,), sd along each, as a part of the prior's
    axes : ndarray, shape (c, c), a row each, in units of the prior's sd
    """

    ratio: Array
    axes: Array


def directions(information: Array) -> Directions:
    """Eigenvectors of an information matrix, shape (c, c), in units of the prior's sd."""
    value, axes = np.linalg.eigh(information)
    return Directions(1.0 / np.sqrt(1.0 + np.maximum(value, 0.0)), axes.T)


def in_words(information: Array, labels: Sequence[str], units: Sequence[str], prior_sd: Array) -> list[str]:
    """What cannot be known, a sentence each; where all can be, the weakest direction.

    Parameters
    ----------
    information : ndarray, shape (c, c), in units of the prior's sd
    labels, units : c
    prior_sd : ndarray, shape (c,)
    """
    alone = 1.0 / np.sqrt(1.0 + np.diag(information))  # with all others known
    silent = np.flatnonzero(alone > UNOBSERVABLE_ABOVE).tolist()
    sentences = [f"nothing is known of {_listed([labels[i] for i in silent])}"] if silent else []
    heard = np.flatnonzero(alone <= UNOBSERVABLE_ABOVE).tolist()
    if not heard:
        return sentences
    own = np.linalg.inv(relative_covariance(information)[np.ix_(heard, heard)]) - np.eye(len(heard))
    found = directions(own)
    names, kinds, sd = [labels[i] for i in heard], [units[i] for i in heard], prior_sd[heard]
    open_ones = found.axes[found.ratio > UNOBSERVABLE_ABOVE]
    sentences += [_combination(axis, names, kinds, sd) for axis in _apart(open_ones)]
    if not sentences:
        parts = [names[i] for i in _parts(found.axes[0])]
        sentences.append(
            f"the weakest direction is {_listed(parts)}, known to {100 * found.ratio[0]:.0f} % of the prior"
        )
    return sentences


def _apart(axes: Array) -> Array:
    """Directions, shape (k, c), that span the same as k given ones, of as few components each as elimination leaves.

    Axes of nearly one eigenvalue are any mixture of each other, and would tell the same twice.
    """
    if len(axes) < 2:
        return axes
    pivots = qr(axes, mode="r", pivoting=True)[1][: len(axes)]
    return np.asarray(np.linalg.solve(axes[:, pivots], axes))


def _parts(axis: Array) -> list[int]:
    """Components that take part in a direction, the largest first."""
    order = np.argsort(-np.abs(axis))
    return [int(i) for i in order if abs(axis[i]) > TAKES_PART * np.abs(axis).max()]


def _combination(axis: Array, labels: Sequence[str], units: Sequence[str], prior_sd: Array) -> str:
    """What may change along an open direction, and what that leaves known."""
    parts = _parts(axis)
    names, change = [labels[i] for i in parts], axis[parts] * prior_sd[parts]
    if len(parts) == 1:
        return f"next to nothing is known of {names[0]}"
    if len(parts) == 2 and units[parts[0]] == units[parts[1]]:
        if abs(change[0] + change[1]) < ALIKE * abs(change[0]):
            return f"only the sum of {names[0]} and {names[1]} is known"
        if abs(change[0] - change[1]) < ALIKE * abs(change[0]):
            return f"only the difference of {names[0]} and {names[1]} is known"
    if len({units[i] for i in parts}) == 1 and (np.abs(np.abs(change / change[0]) - 1.0) < ALIKE).all():
        up = [n for n, c in zip(names, change, strict=True) if c * change[0] > 0]
        down = [n for n, c in zip(names, change, strict=True) if c * change[0] < 0]
        against = f" against {_listed(down)}" if down else ""
        return f"{_listed(up)} may change by the same amount{against}, and the dive would look alike"
    return f"{_listed(names)} can stand in for each other: only combinations of them are known"


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]
