"""Observability of the calibration in a dive: the work of ``rovgraph observe``.

From the graph's own information matrix: states are marginalised exactly, by QR, and the spurious
information of noise in the estimate is removed (`rovgraph.inference.observability`).

`directions` finds the directions of the calibration that a dive leaves open; `in_words` describes them. An eigenvector
of the information, in units of the prior's sd, is a combination of components that the data determine independently of
the others; its sd as a part of the prior's is (1 + eigenvalue)^-1/2.

Where no compass shows the heading and the Earth's rotation is modelled, the heading at the start is a component too.
"""

import difflib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.inference.initialise import initialise
from rovgraph.inference.observability import (
    UNOBSERVABLE_ABOVE,
    data_information,
    not_negative,
    relative_covariance,
    verdict,
    without_spurious_information,
)
from rovgraph.inference.optimum import OTHERS, Optimum, joint_prior_sd
from rovgraph.inference.smoother import assemble
from rovgraph.log import Log
from rovgraph.log.frozen import without_frozen
from rovgraph.model.calibration import TABLE, Variable
from rovgraph.model.config import Config
from rovgraph.process import Progress, no_progress
from rovgraph.sensors.instruments import HEADING_STREAMS

TIMES = 30  # at which the sd is calculated
FEWEST_KEYFRAMES = 20
OTHER_LABELS = (
    "acc_bias_x", "acc_bias_y", "acc_bias_z", "gyr_bias_x", "gyr_bias_y", "gyr_bias_z",
    "start_roll", "start_pitch", "start_heading",
)  # fmt: skip
START_HEADING = Variable(
    "start_heading", "", ("",), "rad", np.nan, ("imu",), "heading at the start, by the Earth's rate",
    "minutes on one heading, half a turn, and as long again",
)  # fmt: skip


@dataclass(frozen=True)
class Observability:
    """Observability of the calibration in a dive; c scalar components that are estimated.

    Attributes
    ----------
    labels, variables : c, names of the components, and the rows of the table they belong to
    prior_sd : ndarray, shape (c,), before the dive [unit of each]
    claimed_sd : ndarray, shape (c,), after it as the graph has it, linearised at its noisy estimate
    information : ndarray, shape (c, c), that the data add to the prior, in units of the prior's sd,
        without spurious information
    correlation : ndarray, shape (c, c + 9), of the components with each other, then with the last
        bias (accelerometer, gyro; body axes) and the start's roll, pitch and heading
    time : ndarray, shape (m,), since the start of the dive [s]
    relative : ndarray, shape (m, c), sd given the data up to then, as a part of the prior's
    """

    labels: tuple[str, ...]
    variables: tuple[Variable, ...]
    prior_sd: Array
    claimed_sd: Array
    information: Array
    correlation: Array
    time: Array
    relative: Array

    @property
    def covariance(self) -> Array:
        """Of the calibration after the dive, shape (c, c) [units of the components]."""
        return relative_covariance(self.information) * np.outer(self.prior_sd, self.prior_sd)

    @property
    def ratio(self) -> Array:
        """sd after the dive over sd before, shape (c,)."""
        return np.sqrt(np.diag(relative_covariance(self.information)))

    @property
    def sd(self) -> Array:
        """sd after the dive, shape (c,) [unit of each]."""
        return self.ratio * self.prior_sd

    @property
    def bits(self) -> Array:
        """Information gained on each component, shape (c,)."""
        return np.asarray(-np.log2(self.ratio))

    @property
    def joint_bits(self) -> float:
        """Information gained on all of them together."""
        return joint_bits(self.information)

    @property
    def verdicts(self) -> list[str]:
        """Of each component: observable, weak or unobservable."""
        return [verdict(ratio) for ratio in self.ratio.tolist()]

    def of(self, labels: Sequence[str]) -> "Observability":
        """Some of the components, in that order; the others stay as unknown as they are."""
        kept, count = [self.labels.index(label) for label in labels], len(self.labels)
        here = np.ix_(kept, kept)
        return Observability(
            tuple(labels),
            tuple(self.variables[i] for i in kept),
            self.prior_sd[kept],
            self.claimed_sd[kept],
            data_information(relative_covariance(self.information)[here], np.ones(len(kept))),
            self.correlation[np.ix_(kept, [*kept, *range(count, self.correlation.shape[1])])],
            self.time,
            self.relative[:, kept],
        )

    def correlated(self, beyond: float = 0.5) -> list[tuple[str, str, float]]:
        """Pairs with their correlation, the strongest first."""
        names, c = (*self.labels, *OTHER_LABELS), len(self.labels)
        pairs = [(i, j) for i in range(c) for j in range(i + 1, len(names)) if abs(self.correlation[i, j]) > beyond]
        pairs = [(i, j) for i, j in pairs if names[i] != names[j]]
        pairs.sort(key=lambda p: -abs(self.correlation[p]))
        return [(names[i], names[j], float(self.correlation[i, j])) for i, j in pairs]


def joint_bits(information: Array) -> float:
    """Information gained on all components together; ``information`` in units of the prior's sd."""
    return float(0.5 * np.linalg.slogdet(np.eye(len(information)) + information)[1] / np.log(2.0))


def observe(log: Log, config: Config, also: Sequence[str] = (), progress: Progress = no_progress) -> Observability:
    """Observability of the calibration in a recorded dive.

    Parameters
    ----------
    log, config : the dive, and what is believed of vehicle and sensors
    also : calibration variables to estimate beside those of the configuration
    progress : called now and then

    Raises
    ------
    InputError : an unknown variable, one whose sensor is not in use, none at all; too short a log
    """
    config = estimating(config, also)
    log, _ = without_frozen(log, config)
    dive = solved(log, config, progress)
    missing = set(also) - set(dive.unknowns.estimated)
    if missing:
        name = min(missing)
        needed = " or ".join(TABLE[name].sensors)
        raise InputError(f"{log.source}: {name} cannot be estimated, no {needed} in use; take it out of --estimate")
    return examined(dive, config, progress=progress)


def estimating(config: Config, also: Sequence[str]) -> Config:
    """A configuration that estimates some variables more.

    Raises
    ------
    InputError : an unknown variable
    """
    for name in also:
        if name not in TABLE:
            near = difflib.get_close_matches(name, TABLE, 1)
            hint = f", did you mean {near[0]}?" if near else ""
            raise InputError(f"unknown calibration variable {name!r}{hint} (known: {', '.join(TABLE)})")
    return config.with_values(calibration={name: {"estimate": True} for name in also})


def solved(log: Log, config: Config, progress: Progress = no_progress) -> Optimum:
    """The graph of a dive and its optimum.

    Raises
    ------
    InputError : too short a log, nothing to estimate
    """
    progress("smoothing", 0.1)
    batch = assemble(log, initialise(log, config))
    if len(batch.problem) < FEWEST_KEYFRAMES:
        raise InputError(
            f"{log.source}: {len(batch.problem)} keyframes say nothing about calibration, "
            f"{FEWEST_KEYFRAMES} are the fewest; take a longer log"
        )
    dive = batch.optimum()
    # shows constants that are not estimated because noise would bias them
    moved = [name for name in dive.unknowns.considered if dive.beliefs[name].estimate]
    dive = dive.estimating(moved) if moved else dive
    if not dive.unknowns.estimated and not rests_on_gyro(dive):
        raise InputError(
            f"{log.source}: no calibration variable is estimated; give --estimate, or estimate: true in calibration"
        )
    return dive


def examined(dive: Optimum, config: Config, noisy: bool = True, progress: Progress = no_progress) -> Observability:
    """Observability of the calibration in a solved dive.

    Parameters
    ----------
    dive, config : of `solved`
    noisy : remove spurious information
    progress : called now and then
    """
    progress("information", 0.6)
    ends = np.unique(np.linspace(0, len(dive.problem) - 1, TIMES + 1).round().astype(int)[1:]).tolist()
    known = dive.knowledge(ends)
    before = np.array([np.concatenate([np.empty(0), *joint_prior_sd(dive, end).values()]) for end in ends])
    seen = np.array([data_information(P, sd) for P, sd in zip(known.calibration, before, strict=True)])
    progress("information", 0.7)
    information = (
        without_spurious_information(dive, ends, seen, before) if noisy and before.size else not_negative(seen)
    )
    variables, c = [TABLE[name] for name in dive.unknowns.estimated], before.shape[1]
    calibration = relative_covariance(information) * before[:, :, None] * before[:, None, :]
    joint = np.array([_with_others(P, C) for P, C in zip(known.covariance, calibration, strict=True)])
    claimed, rows = np.sqrt(np.diag(known.calibration[-1])), np.arange(c)
    if rests_on_gyro(dive):
        variables, rows = [*variables, START_HEADING], np.append(rows, c + OTHERS - 1)
        before = np.column_stack([before, np.full(len(ends), dive.initial.prior.rpy_sd[2])])
        claimed = np.append(claimed, np.sqrt(known.covariance[-1, OTHERS - 1, OTHERS - 1]))
        information = np.array(
            [data_information(P[np.ix_(rows, rows)], sd) for P, sd in zip(joint, before, strict=True)]
        )
    sd, columns = np.sqrt(np.diag(joint[-1])), np.concatenate([rows, np.arange(c, c + OTHERS)])
    relative = np.sqrt(np.diagonal(relative_covariance(information), axis1=1, axis2=2))
    return Observability(
        tuple(label for v in variables for label in v.labels),
        tuple(v for v in variables for _ in v.labels),
        before[-1],
        claimed,
        information[-1],
        (joint[-1] / np.outer(sd, sd))[np.ix_(rows, columns)],
        dive.problem.time[ends] - float(dive.problem.time[0]),
        relative * before / before[-1],
    )


def rests_on_gyro(dive: Optimum) -> bool:
    """Whether no compass shows the heading, and the Earth's rotation is modelled."""
    return bool(dive.initial.config.environment.earth_rotation) and not any(s in HEADING_STREAMS for s in dive.blocks)


def _with_others(joint: Array, calibration: Array) -> Array:
    """Covariance of the calibration and others, shape (c + others, c + others).

    Parameters
    ----------
    joint : ndarray, covariance of others and calibration, as the graph has it
    calibration : ndarray, shape (c, c), covariance without spurious information: what the others
        depend on the calibration stays, given that
    """
    of_c, other = slice(OTHERS, None), slice(0, OTHERS)
    slope = np.linalg.solve(joint[of_c, of_c], joint[of_c, other]).T
    spread = joint[other, other] + slope @ (calibration - joint[of_c, of_c]) @ slope.T
    return np.block([[calibration, calibration @ slope.T], [slope @ calibration, spread]])


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
    """Unobservable directions, a sentence each; where all are observable, the weakest one.

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
    of_heard = np.linalg.inv(relative_covariance(information)[np.ix_(heard, heard)]) - np.eye(len(heard))
    found = directions(of_heard)
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

    Axes of nearly one eigenvalue are any mixture of each other, and would repeat each other.
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
    """Components that change along an open direction, and those that stay determined."""
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
