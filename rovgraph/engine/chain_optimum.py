"""The optimum of a dive that closes no loop, as `rovgraph.engine.optimum` asks of any solver."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rovgraph.calibration import TABLE, Belief
from rovgraph.config import beliefs as beliefs_of
from rovgraph.engine.chain import Chain, ChainStep
from rovgraph.engine.chain_information import SquareRoot
from rovgraph.engine.chain_layout import COLUMNS, MOTION
from rovgraph.engine.dive_rows import DiveRows
from rovgraph.engine.gauss_newton import Solution
from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.engine.measurements import Block, weights_of
from rovgraph.engine.optimum import Knowledge
from rovgraph.engine.stretches import resume, solve
from rovgraph.engine.unknowns import Unknowns, unknowns
from rovgraph.geometry import Array
from rovgraph.state import State


@dataclass(frozen=True)
class ChainOptimum:
    """A chain and where its robust cost is least."""

    chain: Chain
    solution: Solution[State]

    @property
    def intervals(self) -> Sequence[KeyframeInterval]:
        return self.chain.intervals

    @property
    def beliefs(self) -> Mapping[str, Belief]:
        return self.chain.beliefs

    @property
    def unknowns(self) -> Unknowns:
        return self.chain.unknowns

    @property
    def blocks(self) -> Mapping[str, Block]:
        return self.chain.blocks

    @property
    def state(self) -> State:
        return self.solution.point

    @cached_property
    def weights(self) -> Mapping[str, Array]:
        return weights_of(self.chain.seen(self.state, self.blocks), self.solution.gates)

    @property
    def places(self) -> Mapping[int, Array]:
        return {}

    @cached_property
    def information(self) -> SquareRoot:
        """All factors linearised at the optimum and eliminated."""
        return self.chain.eliminate(self.state, self.solution.gates)

    @cached_property
    def _border_covariance(self) -> Array:
        return self.information.border_covariance()

    @cached_property
    def _covariances(self) -> Array:
        return self.information.covariances(self._border_covariance)

    def covariances(self, variable: str) -> Array:
        """As `rovgraph.engine.optimum.Optimum`."""
        if variable in COLUMNS:
            return np.asarray(self._covariances[:, COLUMNS[variable], COLUMNS[variable]])
        border, part = self.chain.layout.places[variable]
        if not border:
            return self._covariances[:, part, part]
        P = self._border_covariance[part, part]
        return np.broadcast_to(P, (len(self.intervals), *P.shape))

    def newest_covariance(self, places: Sequence[int] = ()) -> Array:
        """As `rovgraph.engine.optimum.Optimum`."""
        chosen = np.concatenate([np.arange(MOTION), *(self.chain.layout.target(n) for n in self.unknowns.estimated)])
        return np.asarray(self.information.newest_covariance()[np.ix_(chosen, chosen)])

    def knowledge(self, keyframes: Sequence[int]) -> Knowledge:
        """As `rovgraph.engine.optimum.Optimum`."""
        return self._knowledge_at(self.state, keyframes)

    def noisier(self, keyframes: Sequence[int], seed: int = 1) -> tuple[Knowledge, Knowledge]:
        """As `rovgraph.engine.optimum.Optimum`."""
        held = replace(self.chain, unknowns=self.unknowns.of(()))
        white = np.random.default_rng(seed).standard_normal((len(self.intervals), MOTION))
        noise = held.eliminate(self.state, self.solution.gates).draw(white)
        more, less = (
            self._knowledge_at(held.moved(self.state, ChainStep(sign * noise, np.empty(0)), 1.0), keyframes)
            for sign in (1.0, -1.0)
        )
        return more, less

    def holding(self, names: Sequence[str]) -> tuple["ChainOptimum", Mapping[str, Array]]:
        """As `rovgraph.engine.optimum.Optimum`."""
        kept = self.unknowns.of(set(self.unknowns.estimated) - set(names))
        without = replace(self.chain, unknowns=kept)
        begin = replace(self.state, calibration={**self.state.calibration, **{n: self.beliefs[n].mean for n in names}})
        solution = resume(without, begin, self.solution)
        full = self.chain.eliminate(solution.point, solution.gates)
        given = np.concatenate([np.r_[self.chain.layout.places[n][1]] for n in names])
        by_given = full.border_by(given)
        x, parts = full.x_by_y @ by_given, self.chain.layout.places
        out = {v: x[:, columns] for v, columns in COLUMNS.items()}
        for name, (border, part) in parts.items():
            out[name] = np.broadcast_to(by_given[part], (len(x), TABLE[name].dim, len(given))) if border else x[:, part]
        return ChainOptimum(without, solution), out

    def _knowledge_at(self, point: State, keyframes: Sequence[int]) -> Knowledge:
        P = self.chain.eliminate(point, self.solution.gates, keyframes).filtered_covariances()
        attitude = self.chain.layout.d + self.chain.layout.c + np.arange(3)
        calibration = [self.chain.layout.target(name) for name in self.unknowns.estimated]
        chosen = np.concatenate([np.arange(9, MOTION), attitude, *calibration])
        return Knowledge(np.array(keyframes), P[:, chosen[:, None], chosen])


def smooth_chain(
    intervals: Sequence[KeyframeInterval],
    initial: InitialConditions,
    states: State,
    calibration: Mapping[str, Array] | None = None,
    rows: DiveRows | None = None,
) -> ChainOptimum:
    """Solve a dive that closes no loop.

    Parameters
    ----------
    intervals, initial : the dive
    states : State of its keyframes to begin with
    calibration : to begin with, its prior means where it is None
    rows : the dive as arrays, where they are at hand

    Raises
    ------
    InputError : the data do not determine some variable, which is named
    """
    beliefs, rows = beliefs_of(initial.config), rows or DiveRows.of(intervals, [*initial.instruments])
    wanted = unknowns(beliefs, rows.used)
    chain = Chain(intervals, initial, beliefs, wanted, rows)
    return ChainOptimum(chain, solve(chain, chain.start(states, calibration)))
