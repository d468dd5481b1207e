"""How much likelier a dive is with constants of another sd, as it is linearised: of any of them by one elimination.

With all of them in its border, what is left of the elimination is the information and the score of the border from all
measurements. Priors are added to it, what is held is left out, and with S, s of the rest

    -2 log L = sum of the priors' squares - s' S^-1 s + log |S| + sum of log of the priors' variances

up to what is the same for all (`rovgraph.engine.lasting`).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from rovgraph.calibration import TABLE
from rovgraph.engine.chain import Chain
from rovgraph.engine.gauss_newton import Solution
from rovgraph.engine.widened_chain import begin_at, with_lasting
from rovgraph.geometry import Array
from rovgraph.state import State

WIDE = 10.0  # times the sd that a constant is believed to have, for the elimination: the measurements outweigh it


@dataclass(frozen=True)
class LinearConstants:
    """The border of a dive.

    Attributes
    ----------
    places : constant -> its components
    stated : sds of those that are estimated anyway [unit of the variable]
    off : ndarray, shape (c,), from where the dive is linearised to the means of their priors
    information, score : ndarray, shapes (c, c), (c,), by all but their priors
    """

    places: Mapping[str, slice]
    stated: Mapping[str, float]
    off: Array
    information: Array
    score: Array

    @staticmethod
    def of(chain: Chain, solution: Solution[State], names: Iterable[str]) -> "LinearConstants":
        """Of a dive at its optimum, with some more constants than it estimates."""
        wide = chain
        for name in names:
            if name not in chain.unknowns.walks:
                wide = with_lasting(wide, name, WIDE * chain.beliefs[name].sd, np.inf)
        point = begin_at(wide, solution.point)
        R = wide.eliminate(point, solution.gates, kept=1).border
        information, score = R[:, :-1].T @ R[:, :-1], R[:, :-1].T @ R[:, -1]
        places = {name: part for name, (border, part) in wide.layout.places.items() if border}
        off, weight = np.zeros((2, len(R)))
        for name, part in places.items():
            off[part] = wide.beliefs[name].mean - point.calibration[name]
            weight[part] = wide.beliefs[name].sd ** -2.0
        stated = {name: chain.beliefs[name].sd for name in places if name in chain.unknowns.walks}
        return LinearConstants(places, stated, off, information - np.diag(weight), score - weight * off)

    def gain(self, sds: Mapping[str, float]) -> float:
        """Of log likelihood, by constants of some sds."""
        return self._minus_log_likelihood(self.stated) - self._minus_log_likelihood({**self.stated, **sds})

    def _minus_log_likelihood(self, sds: Mapping[str, float]) -> float:
        chosen = np.concatenate([np.empty(0, np.int64), *(np.r_[self.places[name]] for name in sds)])
        sd = np.concatenate([np.empty(0), *(np.full(TABLE[name].dim, value) for name, value in sds.items())])
        off, scaled = self.off[chosen] / sd, np.outer(sd, sd)
        S = self.information[np.ix_(chosen, chosen)] * scaled + np.eye(len(sd))  # in units of the sds
        s = self.score[chosen] * sd + off
        return 0.5 * float(off @ off - s @ np.linalg.solve(S, s) + np.linalg.slogdet(S)[1])
