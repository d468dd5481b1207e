"""Score tests for calibration constants that are held fixed.

A constant that is held (the DVL's scale, the tilt of its mounting, the gyro's scale, a time offset) is released
together with what is estimated, in one Gauss-Newton step from the optimum: the Lagrange multiplier or score test
(Rao 1948; Engle 1984). Where the configuration is right, the step over its sd is a standard normal number, so a step
of many sds means that the constant has another value, which the step gives. Each is released by itself: two that affect
the same measurements would hide each other. What is considered may be off by its prior's sd, which moves the step: its
variance becomes P + P G D G' P, with G the information between what is released and what is considered, D the priors'
variances. The rate's noise is taken off the steps of the DVL's arm and scale (`rovgraph.inference.rate_noise`).
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np

from rovgraph.inference.chain import Chain
from rovgraph.inference.chain_optimum import ChainOptimum
from rovgraph.inference.optimum import Optimum
from rovgraph.inference.rate_noise import ARM, SCALE, RateNoiseScore, score_of_rate_noise
from rovgraph.inference.widened_chain import widened
from rovgraph.model.state import PLACE
from rovgraph.problem.initial_conditions import InitialConditions

WIDE = 100.0  # times the prior sd: what is released is free


@dataclass(frozen=True)
class ScoreTest:
    """A constant that was released.

    Attributes
    ----------
    name, label : of the calibration variable, and of its component
    step, sd : from where it is held to where the measurements would have it, and its sd [unit of the variable]
    """

    name: str
    label: str
    step: float
    sd: float

    @property
    def significance(self) -> float:
        """The step in its sds, positive."""
        return abs(self.step) / self.sd


def as_chain(best: Optimum, initial: InitialConditions) -> ChainOptimum:
    """A dive as `score_test` takes it: itself, or where places were seen, its chain without them about the same point.

    The step of a constant is then determined by all other measurements.
    """
    if isinstance(best, ChainOptimum):
        return best
    gates = {sensor: gate for sensor, gate in best.solution.gates.items() if sensor != PLACE}
    chain = Chain(best.problem.without(PLACE), initial, best.beliefs, best.unknowns)
    return ChainOptimum(chain, replace(best.solution, point=best.state, gates=gates))


_known: WeakKeyDictionary[ChainOptimum, dict[tuple[str, ...], list[ScoreTest]]] = WeakKeyDictionary()


def score_test(best: ChainOptimum, names: Iterable[str]) -> list[ScoreTest]:
    """Each component of some constants that are held, released by itself; an optimum is tested once.

    Parameters
    ----------
    best : the optimum
    names : calibration variables; those that are estimated, or whose sensor is not in use, are passed over
    """
    known, chosen = _known.setdefault(best, {}), tuple(names)
    if chosen not in known:
        known[chosen] = _released(best, chosen)
    return known[chosen]


def _released(best: ChainOptimum, names: tuple[str, ...]) -> list[ScoreTest]:
    used, beliefs = {*best.chain.blocks, "imu"}, dict(best.beliefs)
    held = [n for n in names if n not in best.unknowns.estimated and beliefs[n].is_shown_by(used)]
    considered = [n for n in best.unknowns.considered if beliefs[n].is_shown_by(used)]
    free = tuple(dict.fromkeys([*held, *considered]))
    for name in free:
        belief = beliefs[name]
        beliefs[name] = replace(belief, estimate=True, sd=WIDE * belief.variable.sd, walk=0.0)
    released = widened(best.chain, best.state, free, beliefs)
    root = released.eliminate(best.state, best.solution.gates, kept=1)
    R, z = root.border[:, :-1], root.border[:, -1]
    information, score = R.T @ R, R.T @ z
    kept = [released.layout.places[name] for name in best.unknowns.estimated]
    always = np.concatenate([np.empty(0, np.int64), *(np.r_[part] for border, part in kept if border)])
    by_noise = score_of_rate_noise(best)
    prior = {c: best.beliefs[name].sd for name in considered for c in np.r_[released.layout.places[name][1]].tolist()}
    out = []
    for name in held:
        for label, component in zip(beliefs[name].variable.labels, np.r_[released.layout.places[name][1]], strict=True):
            chosen = np.append(always, component)
            P = np.linalg.inv(information[np.ix_(chosen, chosen)])
            others = [c for c in prior if c != component]
            by_others = P[-1] @ information[np.ix_(chosen, others)] * [prior[c] for c in others]
            sd = float(np.sqrt(P[-1, -1] + np.sum(by_others**2)))
            step = float(P[-1] @ score[chosen] + P[-1, -1] * (by_noise.scale_score if name == SCALE else 0.0))
            out.append(ScoreTest(name, label, step, sd))
    return _arm_without_rate_noise(by_noise, out)


def _arm_without_rate_noise(by_noise: RateNoiseScore, released: list[ScoreTest]) -> list[ScoreTest]:
    """The DVL's arm without spurious information; left out where little else is known of it."""
    arm = [one for one in released if one.name == ARM]
    if not arm:
        return released
    step, sd = np.array([(one.step, one.sd) for one in arm]).T
    steps, sds = by_noise.step(step, sd), by_noise.sd(sd)
    of_arm = [replace(one, step=float(a), sd=float(b)) for one, a, b in zip(arm, steps, sds, strict=True) if b < np.inf]
    return [one for one in released if one.name != ARM] + of_arm
