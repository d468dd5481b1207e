"""One interval of the error-state Kalman filter: update, predict, update.

The error has 15 components (attitude, position, velocity, biases) and those of the
calibration that is estimated. Motion, measurement models, noise, losses, gates and start
are the graph's own. What differs: every measurement is linearised once, where it comes.

Per interval, the measurements between two keyframes update the earlier one, as they do in
the graph; the state goes on to the next keyframe with the IMU; what was measured there
updates it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rovgraph.config import beliefs
from rovgraph.estimators.error_vector import ErrorVector
from rovgraph.estimators.incremental import READMIT_AFTER
from rovgraph.estimators.initialise import Beginning
from rovgraph.estimators.robust_update import normalised_squared, robust_update
from rovgraph.geometry import Array, transpose
from rovgraph.graph.assembly import Attached, Interval
from rovgraph.graph.factors import predict
from rovgraph.graph.keys import unknowns
from rovgraph.graph.measurements import Block, make_block
from rovgraph.graph.transition import transition
from rovgraph.state import State

Gates = dict[str, int]  # sensor -> rejections running, since the last that was consistent


@dataclass(frozen=True)
class Gaussian:
    """A state with the covariance of its error, in the order of `ErrorVector`.

    Attributes
    ----------
    state : State of one epoch
    P : ndarray, shape (size, size)
    """

    state: State
    P: Array


@dataclass(frozen=True)
class Step:
    """What a smoother needs of a keyframe.

    Attributes
    ----------
    F, Q : ndarray, shape (size, size), transition from the keyframe before, and its noise
    predicted : before anything that was measured at the keyframe
    """

    F: Array
    Q: Array
    predicted: Gaussian


@dataclass(frozen=True)
class Used:
    """A measurement as the filter met it.

    Attributes
    ----------
    attached : the measurement
    state : of its keyframe, before it entered
    nis : normalised innovation squared
    weight : 1 for a full measurement, less by its loss, 0 for a rejected one
    """

    attached: Attached
    state: State
    nis: float
    weight: float


@dataclass(frozen=True)
class Passage:
    """Through one interval, from one keyframe to the next.

    Attributes
    ----------
    departed : the keyframe before, with what was measured after it; None at the first keyframe
    step : the way from there; None at the first keyframe
    filtered : the keyframe that ends the interval
    used : the measurements
    """

    departed: Gaussian | None
    step: Step | None
    filtered: Gaussian
    used: list[Used]


class ErrorStateRecursion:
    """Extended Kalman filter that keeps nothing: the state goes in and comes out.

    Parameters
    ----------
    beginning : of `rovgraph.estimators.initialise.initialise`

    Attributes
    ----------
    beliefs, unknowns : priors of the calibration, and what of it is estimated
    error : layout and geometry of the error
    """

    def __init__(self, beginning: Beginning) -> None:
        self.beginning = beginning
        self.beliefs = beliefs(beginning.config)
        self.unknowns = unknowns(self.beliefs, beginning.instruments)
        self.error = ErrorVector(self.unknowns.estimated, beginning.instruments)

    def start(self) -> Gaussian:
        """The prior: the graph's."""
        start = self.beginning.start
        R_nb = start.state.R_nb[0]
        sd = [start.rpy_sd, start.p_sd, start.v_sd, start.bias_sd]
        sd += [np.full(self.beliefs[name].variable.dim, self.beliefs[name].sd) for name in self.unknowns.estimated]
        P = np.diag(np.concatenate(sd) ** 2)
        P[:3, :3], P[3:6, 3:6] = (transpose(R_nb) @ P[i : i + 3, i : i + 3] @ R_nb for i in (0, 3))
        return Gaussian(replace(start.state, calibration=self.unknowns.fixed), P)

    def through(self, interval: Interval, before: Gaussian | None, gates: Gates) -> Passage:
        """Take one interval.

        Parameters
        ----------
        interval : the next one
        before : the keyframe before; None at the first
        gates : renewed in place
        """
        used: list[Used] = []
        departed = step = None
        if before is None:
            predicted = self.start()
        else:
            between = [a for a in interval.attached if a.keyframe < interval.index]
            departed = self._update(before, between, gates, used)
            step = self.predict(interval, departed)
            predicted = step.predicted
        here = [a for a in interval.attached if a.keyframe == interval.index]
        return Passage(departed, step, self._update(predicted, here, gates, used), used)

    def predict(self, interval: Interval, before: Gaussian) -> Step:
        """The next keyframe, from the IMU alone; calibration walks."""
        assert interval.pim is not None
        state = predict(interval, before.state)
        F, Q = np.eye(self.error.size), np.zeros_like(before.P)
        F[:15, :15], Q[:15, :15] = transition(interval, before.state, state)
        for name, walk in self.unknowns.walks.items():
            columns = self.error.columns[name]
            Q[columns, columns] = np.eye(self.beliefs[name].variable.dim) * walk**2 * interval.pim.deltaTij()
        P = F @ before.P @ F.T + Q
        return Step(F, Q, Gaussian(state, 0.5 * (P + P.T)))

    def block(self, attached: Sequence[Attached]) -> Block:
        """Measurements of one sensor."""
        b = self.beginning
        instrument, gravity = b.instruments[attached[0].sensor], b.config.environment.gravity_mps2
        return make_block(attached, instrument, gravity, self.unknowns)

    def _update(self, before: Gaussian, attached: Sequence[Attached], gates: Gates, used: list[Used]) -> Gaussian:
        """The state corrected by measurements that belong to its keyframe."""
        r, H, losses, admitted = [], [], [], []
        for a in attached:
            block = self.block([a])
            own_r, jacobians = block.linearize(before.state)
            own_H = self.error.matrix(jacobians)
            nis = normalised_squared(before.P, own_r[0], own_H[0])
            if _admit(a.sensor, nis, block.instrument.gate_sd, gates):
                r.append(own_r[0])
                H.append(own_H[0])
                losses.append(block.instrument.loss)
                admitted.append((a, nis))
            else:
                used.append(Used(a, before.state, nis, 0.0))
        if not admitted:
            return before
        delta, P, weights = robust_update(before.P, r, H, losses)
        used += [Used(a, before.state, nis, weight) for (a, nis), weight in zip(admitted, weights, strict=True)]
        state, basis = self.error.retract(before.state, delta)
        return Gaussian(state, basis @ P @ basis.T)


def _admit(sensor: str, nis: float, gate_sd: float | None, gates: Gates) -> bool:
    """Whether a measurement lies within its gate, or its sensor has been kept out for too long."""
    consistent = gate_sd is None or nis <= gate_sd**2
    gates[sensor] = 0 if consistent else gates.get(sensor, 0) + 1
    return consistent or gates[sensor] > READMIT_AFTER
