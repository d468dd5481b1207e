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
from rovgraph.estimators.initialise import Beginning
from rovgraph.estimators.remembered_places import (
    Place,
    extended,
    moved,
    nearest,
    padded,
    seen_at,
    with_another,
    without_oldest,
)
from rovgraph.estimators.results import body_trajectory
from rovgraph.estimators.robust_update import normalised_squared, robust_update
from rovgraph.geometry import Array, transpose
from rovgraph.graph.assembly import Attached, Interval, Sighting
from rovgraph.graph.coasting import BLIND_S, coasted, coasting
from rovgraph.graph.factors import predict
from rovgraph.graph.keys import unknowns
from rovgraph.graph.measurements import Block, make_block, motions, whitening
from rovgraph.graph.places import ORIGIN
from rovgraph.graph.scale import COLUMNS, SCALES
from rovgraph.graph.transition import transition
from rovgraph.sensors import Position, SensorModel, innovation
from rovgraph.state import POSE, VELOCITY, State, propagate_with_jacobian, stack_states
from rovgraph.trajectory import Trajectory

RETURN_SD = 3.0  # a sensor that was kept out for long returns with an innovation within this many sd

Gates = dict[str, float]  # sensor that is being kept out -> since when [s]


@dataclass(frozen=True)
class Gaussian:
    """A state with the covariance of its error, in the order of `ErrorVector`.

    Attributes
    ----------
    state : State of one epoch
    P : ndarray, shape (size + 2 m, size + 2 m), the places at the end
    places : m places that are remembered
    """

    state: State
    P: Array
    places: tuple[Place, ...] = ()


@dataclass(frozen=True)
class Step:
    """What a smoother needs of a keyframe.

    Attributes
    ----------
    F, Q : ndarray, shapes as that of P, transition from the keyframe before, and its noise
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
    weight : 1 for a full measurement, less by its loss, 0 for a rejected one; a place that fits none of its
        name counts as rejected, and is remembered as another
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
        self._walk = np.zeros((self.error.size, self.error.size))  # what walking adds to Q in a second
        for name, walk in self.unknowns.walks.items():
            columns = self.error.columns[name]
            self._walk[columns, columns] = np.eye(self.beliefs[name].variable.dim) * walk**2

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

    def _update(self, before: Gaussian, attached: Sequence[Attached], gates: Gates, used: list[Used]) -> Gaussian:
        """The state corrected by what belongs to its keyframe, places last."""
        known = self._measured(before, [a for a in attached if a.sighting is None], gates, used)
        for a in attached:
            if a.sighting is not None:
                known = self._sighted(known, a, a.sighting, used)
        return known

    def predict(self, interval: Interval, before: Gaussian) -> Step:
        """The next keyframe, from the IMU alone; calibration walks."""
        assert interval.pim is not None
        duration = interval.pim.deltaTij()
        state = predict(interval, before.state)
        F, Q = np.eye(len(before.P)), np.zeros_like(before.P)
        Q[: self.error.size, : self.error.size] = self._walk * duration
        if interval.bridged and duration > BLIND_S:
            state = coasted(before.state, state, duration)
            F[:15, :15], Q[:15, :15] = coasting(before.state, state, duration, before.P)
        else:
            F[:15, :15], Q[:15, :15] = transition(interval, before.state, state)
        if interval.felt is not None:
            for name in set(SCALES) & set(self.error.columns):  # they move as the bias does, but for itself
                F[:9, self.error.columns[name]] = F[:9, 9:15] @ interval.felt[:, COLUMNS[name]]
        P = F @ before.P @ F.T + Q
        return Step(F, Q, Gaussian(state, 0.5 * (P + P.T), before.places))

    def block(self, attached: Sequence[Attached]) -> Block:
        """Measurements of one sensor."""
        b = self.beginning
        instrument, gravity = b.instruments[attached[0].sensor], b.config.environment.gravity_mps2
        return make_block(attached, instrument, gravity, self.unknowns)

    def linearize(self, state: State, attached: Sequence[Attached]) -> list[tuple[Array, Array]]:
        """Whitened innovation, shape (dim,), and Jacobian, shape (dim, size), of each measurement of a keyframe.

        A place is taken to be at the origin, and to be known.

        What `Block.linearize` says of many keyframes and one sensor, for one keyframe and many sensors.
        """
        state = state.seeing(ORIGIN)
        there, F, linear = state.at([0] * len(attached)), None, []
        if any(a.motion.dt for a in attached):
            there, F = propagate_with_jacobian(there, motions(attached), self.beginning.config.environment.gravity_mps2)
        for k, a in enumerate(attached):
            if a.track is not None or a.felt is not None:  # by a motion of its own, or more than the model knows
                own, jacobians = self.block([a]).linearize(state)
                linear.append((own[0], self.error.matrix(jacobians)[0]))
                continue
            instrument = self.beginning.instruments[a.sensor]
            predicted, jacobians = instrument.model.predict(there.at(slice(k, k + 1)), a.rate_b[None])
            H = self.error.matrix(jacobians)[0]
            if F is not None:
                H[:, :15] = H[:, :15] @ F[k]
            W = whitening(instrument, a.sd[None], np.array([a.rate_sd]))[0]
            linear.append((W @ innovation(instrument.model, a.z, predicted[0]), W @ H))
        return linear

    def trajectory(self, intervals: Sequence[Interval], known: Sequence[Gaussian]) -> Trajectory:
        """The body's origin at keyframes, at least one, in n, with its covariance.

        Parameters
        ----------
        intervals, known : the keyframes and what is known of them, n each
        """
        P, columns = self.covariances(known), self.error.columns
        pose, velocity = (P[:, columns[v], columns[v]] for v in (POSE, VELOCITY))
        arm = self.beginning.config.imu.lever_arm_m
        return body_trajectory(intervals, stack_states([k.state for k in known]), arm, pose, velocity)

    def covariances(self, known: Sequence[Gaussian]) -> Array:
        """Covariances of n estimates without their places, shape (n, size, size)."""
        return np.array([k.P[: self.error.size, : self.error.size] for k in known])

    def _admit(self, a: Attached, nis: float, gates: Gates) -> bool:
        """Whether a measurement lies within its gate."""
        instrument = self.beginning.instruments[a.sensor]
        gate, since = instrument.gate_sd, gates.get(a.sensor)
        if since is not None and a.time - since > instrument.readmit_s:
            gate = RETURN_SD
        if gate is not None and nis > gate**2:
            gates.setdefault(a.sensor, a.time)
            return False
        gates.pop(a.sensor, None)
        return True

    def _seen(self, model: SensorModel, state: State) -> Array:
        """Directions of the error that a sensor sees, shape (size, k): velocity, or turn and shift along n's axes."""
        R_bn, seen = transpose(state.R_nb[0]), np.zeros((self.error.size, 3))
        if isinstance(model, Position):
            seen[3:6] = R_bn
            return seen[:, list(model.axes)]
        if VELOCITY in model.state:
            seen[self.error.columns[VELOCITY]] = np.eye(3)
            return seen
        seen[:3] = R_bn
        return seen[:, 2:]

    def _measured(self, before: Gaussian, attached: Sequence[Attached], gates: Gates, used: list[Used]) -> Gaussian:
        """The state corrected by measurements that belong to its keyframe, of no places."""
        r, H, losses, admitted = [], [], [], []
        for a, (own_r, own_H) in zip(attached, self.linearize(before.state, attached), strict=True):
            instrument, own_H = self.beginning.instruments[a.sensor], padded(own_H, len(before.P))
            nis = normalised_squared(before.P, own_r, own_H)
            if self._admit(a, nis, gates):
                r.append(own_r)
                H.append(own_H)
                losses.append(instrument.loss)
                admitted.append((a, nis))
            else:
                used.append(Used(a, before.state, nis, 0.0))
                if a.time - gates[a.sensor] > instrument.readmit_s:
                    seen = self._seen(instrument.model, before.state)
                    before = replace(before, P=doubted(before.P, own_r, own_H, padded(seen.T, len(before.P)).T))
        if not admitted:
            return before
        delta, P, weights = robust_update(before.P, r, H, losses)
        used += [Used(a, before.state, nis, weight) for (a, nis), weight in zip(admitted, weights, strict=True)]
        return self.corrected(before, delta, P)

    def _sighted(self, before: Gaussian, a: Attached, sighting: Sighting, used: list[Used]) -> Gaussian:
        """The state corrected by a place that is seen again, or with one place more."""
        instrument, size = self.beginning.instruments[a.sensor], self.error.size
        [(r, H)] = self.linearize(before.state, [a])
        match = nearest(before.P, r, H, a.sd, size, before.places, sighting.name)
        gate = instrument.gate_sd or np.inf
        if match is not None and match.nis <= gate**2:
            delta, P, [weight] = robust_update(before.P, [match.r], [match.H], [instrument.loss])
            place = before.places[match.index]
            seen = replace(a, sighting=sighting._replace(number=place.number))
            used.append(Used(seen, before.state.seeing(place.position), match.nis, weight))
            after = self.corrected(before, delta, P)
            return replace(after, places=seen_at(after.places, match.index, a.time))
        place = Place(sighting.name, sighting.number, -a.sd * r, a.time)
        other, nis = (place, 0.0) if match is None else (before.places[match.index], match.nis)
        used.append(Used(a, before.state.seeing(other.position), nis, 1.0 if match is None else 0.0))
        P, places = with_another(before.P, before.places, place, a.sd[:, None] * H, a.sd)
        return Gaussian(before.state, *without_oldest(P, places, size, self.beginning.config.place.remembered))

    def corrected(self, before: Gaussian, delta: Array, P: Array) -> Gaussian:
        """The estimate moved by a correction, shape (size + 2 m,); ``P`` is the covariance after it."""
        size = self.error.size
        state, basis = self.error.retract(before.state, delta[:size])
        basis = extended(basis, len(P))
        return Gaussian(state, basis @ P @ basis.T, moved(before.places, delta[size:]))


def doubted(P: Array, r: Array, H: Array, seen: Array) -> Array:
    """The covariance after something that no model knows has moved what a sensor sees, by as much as it shows.

    As a knock does to the velocity, without doubt about anything else.

    Parameters
    ----------
    P : ndarray, shape (size, size)
    r, H : whitened innovation and Jacobian of a rejected measurement, shapes (dim,) and (dim, size)
    seen : ndarray, shape (size, k), directions of the error that the sensor sees
    """
    moved = np.linalg.lstsq(H @ seen, r)[0]
    return np.asarray(P + float(moved @ moved) * seen @ seen.T)
