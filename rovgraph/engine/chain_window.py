"""A part of a chain that is solved by itself, with what was known before it as its prior.

The keyframes before the part are eliminated at the point where the chain stands; what they say of the part's first
keyframe and of the border stays as rows. What comes after the part is left out.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from rovgraph.engine.chain import CLONED, Chain
from rovgraph.engine.chain_information import MeasurementRows
from rovgraph.engine.chain_layout import MOTION
from rovgraph.engine.gauss_newton import Gates, Solution
from rovgraph.geometry import Array, log_rotation, right_jacobian
from rovgraph.state import State

_ONE = np.ones(1)


@dataclass(frozen=True)
class ChainWindow:
    """Some keyframes of a chain, as `rovgraph.engine.stretches.Part`.

    Attributes
    ----------
    problem : they as a chain
    keyframes : which of the dive's
    within : sensor -> which of its measurements lie in the window
    """

    problem: Chain
    keyframes: slice
    within: dict[str, slice]

    def point(self, whole: State) -> State:
        """As `rovgraph.engine.stretches.Part`."""
        return whole.at(self.keyframes)

    def gates(self, whole: Gates) -> Gates:
        """As `rovgraph.engine.stretches.Part`."""
        return {sensor: whole[sensor][part] for sensor, part in self.within.items()}

    def with_gates(self, whole: Gates, own: Gates) -> Gates:
        """As `rovgraph.engine.stretches.Part`."""
        out = {sensor: gate.copy() for sensor, gate in whole.items()}
        for sensor, part in self.within.items():
            out[sensor][part] = own[sensor]
        return out


def window(chain: Chain, solution: Solution[State], begin: float, end: float) -> ChainWindow | None:
    """The keyframes between two times; None = they are half of the dive, or there are measurements no kernel knows.

    Parameters
    ----------
    chain, solution : the dive, and where what lies before the window is linearised
    begin, end : [s]
    """
    rows = chain.problem
    first, last = (int(k) for k in np.searchsorted(rows.time, (begin, end)))
    if 2 * (last - first) > len(rows) or chain.given:
        return None
    m = int(rows.first[first + (first > 0)]), int(rows.first[last])  # the head has those of the first keyframe
    here = replace(chain, problem=rows.part(first, last, *m))
    if first > 0:
        own = {f.name: getattr(here, f.name) for f in fields(Chain)}
        head = _known_before(chain, solution, first)
        here = _HeadedChain(**own, head=head, at=solution.point.at(slice(first, first + 1)))
    places = {sensor: rows.of_sensor(sensor).searchsorted(m).tolist() for sensor in rows.sensors}
    within = {sensor: slice(*place) for sensor, place in places.items() if place[0] < place[1]}
    return ChainWindow(here, slice(first, last), within)


def _known_before(chain: Chain, solution: Solution[State], keyframe: int) -> Array:
    """Rows of a keyframe and the border with their right-hand sides, of the data up to it, shape (d + c, d + c + 1)."""
    (rows,) = chain.eliminate(solution.point, solution.gates, [keyframe], kept=1).filtered
    known = len(rows) - CLONED  # the clone of the first attitude stands last, and is eliminated first here
    order = np.r_[known : known + CLONED, :known, known + CLONED]
    R: Array = np.asarray(np.linalg.qr(rows[:, order], mode="r"))
    return R[CLONED:, CLONED:]


@dataclass(frozen=True)
class _HeadedChain(Chain):
    """A chain that begins with rows of its first keyframe and the border.

    Attributes
    ----------
    head : ndarray, shape (d + c, d + c + 1), with their right-hand sides, linearised at ``at``
    at : State of one epoch
    """

    head: Array
    at: State

    def prior_residuals(self, point: State) -> tuple[Array, Array]:
        """Whitened residuals of the head, shape (d + c,), and of nothing else."""
        return self.head[:, :-1] @ self._moved_from(point) - self.head[:, -1], np.empty(0)

    def _moved_from(self, point: State) -> Array:
        """The step that leads to a point, shape (d + c,)."""
        R_nb, layout = self.at.R_nb[0], self.layout
        step = np.empty(layout.d + layout.c)
        step[:3] = log_rotation(R_nb.T @ point.R_nb[0])
        step[3:6] = R_nb.T @ (point.p_n[0] - self.at.p_n[0])
        step[6:9] = point.v_n[0] - self.at.v_n[0]
        step[9:MOTION] = point.bias[0] - self.at.bias[0]
        for name in layout.places:
            now, then = (np.atleast_2d(s.calibration[name])[0] for s in (point, self.at))
            step[layout.target(name)] = now - then
        return step

    def _room(self, clones: int) -> MeasurementRows:
        size = len(self.head)
        return MeasurementRows(len(self.problem), MOTION, [np.zeros(1, np.int64)], [size], size - MOTION)

    def _put_priors(self, rows: MeasurementRows, point: State, clones: int) -> None:
        r, _ = self.prior_residuals(point)
        R = self.at.R_nb[0].T @ point.R_nb[0]
        J = self.head[:, :MOTION].copy()
        J[:, :3] = J[:, :3] @ np.linalg.inv(right_jacobian(log_rotation(R)))
        J[:, 3:6] = J[:, 3:6] @ R
        rest = np.arange(MOTION, len(self.head))
        rows.put(0, -r[None], J[None], self.head[None, :, MOTION:-1], rest, _ONE)

    def _border_rows(self, point: State, clones: int) -> Array:
        return np.zeros((0, self.layout.c + clones + 1))
