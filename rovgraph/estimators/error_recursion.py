"""One interval of the error-state Kalman filter: update, predict, update.

Of one filter, or of several of the same configuration side by side, which takes NumPy hardly
longer than one.

The error has 15 components (attitude, position, velocity, biases) and those of the
calibration that is estimated. Motion, measurement models, noise, losses, gates and start
are the graph's own. What differs: every measurement is linearised once, where it comes.

Per interval, the measurements between two keyframes update the earlier one, as they do in
the graph; the state goes on to the next keyframe with the IMU; what was measured there
updates it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, groupby, pairwise

import numpy as np

from rovgraph.config import beliefs
from rovgraph.estimators.error_vector import ErrorVector
from rovgraph.estimators.initialise import Beginning
from rovgraph.estimators.innovations import Innovations
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
from rovgraph.geometry import Array, identities, rotate, transpose
from rovgraph.graph.assembly import Attached, Interval
from rovgraph.graph.coasting import BLIND_S, coasted, coasting
from rovgraph.graph.factors import predict
from rovgraph.graph.keys import unknowns
from rovgraph.graph.measurements import Block, make_block, motions, whitening
from rovgraph.graph.places import ORIGIN
from rovgraph.graph.scale import COLUMNS, SCALES
from rovgraph.graph.transition import transitions
from rovgraph.sensors import Position, SensorModel, innovation
from rovgraph.state import PLACE, POSE, VELOCITY, State, propagate_with_jacobian, stack_states
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


@dataclass(frozen=True)
class _Together:
    """The estimates of n filters; only a filter that is alone remembers places.

    Attributes
    ----------
    state : State of n epochs; calibration that is estimated has shape (n, dim)
    P : ndarray, shape (n, d, d)
    places : of the one filter
    """

    state: State
    P: Array
    places: tuple[Place, ...] = ()

    def apart(self) -> list[Gaussian]:
        """Each by itself."""
        whole, calibration = self.state, self.state.calibration
        own = [name for name, value in calibration.items() if value.ndim == 2]
        out = []
        for k, P in enumerate(self.P):
            one = slice(k, k + 1)
            known = {**calibration, **{name: calibration[name][k] for name in own}}
            state = State(whole.R_nb[one], whole.p_n[one], whole.v_n[one], whole.bias[one], known)
            out.append(Gaussian(state, P, self.places))
        return out


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

    def through(self, interval: Interval, before: Gaussian, gates: Gates) -> Passage:
        """Take one interval.

        Parameters
        ----------
        interval : the next one
        before : the keyframe before, or at the first `start`
        gates : renewed in place
        """
        return self.through_together([interval], [before], [gates])[0]

    def through_together(
        self, intervals: Sequence[Interval], before: Sequence[Gaussian], gates: Sequence[Gates]
    ) -> list[Passage]:
        """Take one interval of each of some filters; `through` says of what.

        All of them are at their first keyframe, or none is; where there are several, none has seen a place.
        """
        used: list[list[Used]] = [[] for _ in intervals]
        departed: Sequence[Gaussian | None] = [None] * len(intervals)
        steps: Sequence[Step | None] = [None] * len(intervals)
        predicted = before
        if intervals[0].pim is not None:
            between = [[a for a in i.attached if a.keyframe < i.index] for i in intervals]
            departed = left = self._update(before, between, gates, used)
            steps = made = self.predict_together(intervals, left)
            predicted = [step.predicted for step in made]
        here = [[a for a in i.attached if a.keyframe == i.index] for i in intervals]
        filtered = self._update(predicted, here, gates, used)
        return [Passage(*one) for one in zip(departed, steps, filtered, used, strict=True)]

    def predict(self, interval: Interval, before: Gaussian) -> Step:
        """The next keyframe, from the IMU alone; calibration walks."""
        return self.predict_together([interval], [before])[0]

    def predict_together(self, intervals: Sequence[Interval], before: Sequence[Gaussian]) -> list[Step]:
        """The next keyframes of some filters; as `predict`."""
        size, P = self.error.size, np.array([known.P for known in before])
        states = [predict(interval, known.state) for interval, known in zip(intervals, before, strict=True)]
        F, Q = identities(*P.shape[:2]), np.zeros_like(P)
        F[:, :15, :15], own_Q = transitions(intervals, [known.state for known in before], states)
        for k, (interval, known) in enumerate(zip(intervals, before, strict=True)):
            assert interval.pim is not None
            duration = interval.pim.deltaTij()
            Q[k, :size, :size] = self._walk * duration
            if interval.bridged and duration > BLIND_S:
                states[k] = coasted(known.state, states[k], duration)
                F[k, :15, :15], own_Q[k] = coasting(known.state, states[k], duration, known.P)
            if interval.felt is not None:
                for name in set(SCALES) & set(self.error.columns):  # they move as the bias does, but for itself
                    F[k, :9, self.error.columns[name]] = F[k, :9, 9:15] @ interval.felt[:, COLUMNS[name]]
        Q[:, :15, :15] = own_Q
        P = F @ P @ transpose(F) + Q
        P = 0.5 * (P + transpose(P))
        predicted = [Gaussian(*one) for one in zip(states, P, (known.places for known in before), strict=True)]
        return [Step(*one) for one in zip(F, Q, predicted, strict=True)]

    def block(self, attached: Sequence[Attached]) -> Block:
        """Measurements of one sensor."""
        b = self.beginning
        instrument, gravity = b.instruments[attached[0].sensor], b.config.environment.gravity_mps2
        return make_block(attached, instrument, gravity, self.unknowns)

    def linearize(
        self, state: State, attached: Sequence[Sequence[Attached]]
    ) -> tuple[list[Array], list[Array], list[list[slice]]]:
        """Whitened innovations and Jacobians of the measurements of a keyframe of each of n filters.

        A place is taken to be at the origin, and to be known.

        What `Block.linearize` says of many keyframes and one sensor, for one keyframe and many sensors.

        Parameters
        ----------
        state : State of n epochs
        attached : measurements of each; at least one of them all

        Returns
        -------
        r, H : of each filter an ndarray, shapes (m,) and (m, size)
        parts : for each its measurements' rows
        """
        parts, flat = self._rows(attached)
        rows = [own[-1].stop if own else 0 for own in parts]
        r, H = [np.empty(m) for m in rows], [np.empty((m, self.error.size)) for m in rows]
        filters, those = [k for k, _, _ in flat], [a for _, _, a in flat]
        there, F = State(state.R_nb[filters], state.p_n[filters], state.v_n[filters], state.bias[filters]), None
        if any(a.motion.dt for a in those):
            gravity = self.beginning.config.environment.gravity_mps2
            there, F = propagate_with_jacobian(there, motions(those), gravity)
        ends = list(accumulate(len(list(group)) for _, group in groupby(those, _kind)))
        for begin, end in pairwise([0, *ends]):
            which, own = slice(begin, end), those[begin:end]
            if own[0].track is not None or own[0].felt is not None:
                own_r, own_H = self._of_block(state.at(filters[which]), own)
            else:
                calibration = self._calibration(state, own[0], filters[which])
                known = State(there.R_nb[which], there.p_n[which], there.v_n[which], there.bias[which], calibration)
                own_r, own_H = self._of_sensor(known, None if F is None else F[which], own)
            for (k, part, _), one_r, one_H in zip(flat[which], own_r, own_H, strict=True):
                r[k][part], H[k][part] = one_r, one_H
        return r, H, parts

    def _calibration(self, state: State, a: Attached, filters: list[int]) -> dict[str, Array]:
        """What a measurement's model reads, of some filters."""
        if a.sighting is not None:
            return {PLACE: ORIGIN}
        values = {name: state.calibration[name] for name in self.beginning.instruments[a.sensor].model.calibration}
        return {name: value if value.ndim == 1 else value[filters] for name, value in values.items()}

    def _rows(
        self, attached: Sequence[Sequence[Attached]]
    ) -> tuple[list[list[slice]], list[tuple[int, slice, Attached]]]:
        """Rows of each filter's measurements; and all of them with filter and rows, those of one kind together."""
        parts, flat = [], []
        for k, own in enumerate(attached):
            ends = accumulate((self.beginning.instruments[a.sensor].model.dim for a in own), initial=0)
            parts.append([slice(*pair) for pair in pairwise(ends)])
            flat += [(k, part, a) for part, a in zip(parts[-1], own, strict=True)]
        return parts, sorted(flat, key=lambda one: _kind(one[2]))

    def _of_block(self, state: State, attached: Sequence[Attached]) -> tuple[Array, Array]:
        """Whitened innovations, shape (m, dim), and Jacobians, shape (m, dim, size), of m measurements of a sensor."""
        if attached[0].sighting is not None:
            state = state.seeing(ORIGIN)
        r, jacobians = self.block(attached).linearize(state)
        return r, self.error.matrix(jacobians)

    def _of_sensor(self, state: State, F: Array | None, attached: Sequence[Attached]) -> tuple[Array, Array]:
        """The same at less cost, of measurements that are where their stamps say, with an IMU of exact scale.

        Parameters
        ----------
        state : State where the measurements are
        F : ndarray, shape (m, 15, 15), its derivative by that of the keyframe, where it is another
        """
        instrument = self.beginning.instruments[attached[0].sensor]
        predicted, jacobians = instrument.model.predict(state, np.array([a.rate_b for a in attached]))
        H = self.error.matrix(jacobians)
        if F is not None:
            H[..., :15] = H[..., :15] @ F
        r = innovation(instrument.model, np.array([a.z for a in attached]), predicted)
        sd = np.array([a.sd for a in attached])
        if not instrument.rate_gain.any():
            return r / sd, H / sd[..., None]
        W = whitening(instrument, sd, np.array([a.rate_sd for a in attached]))
        return rotate(W, r), W @ H

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

    def corrected(self, before: Sequence[Gaussian], delta: Array, P: Array) -> list[Gaussian]:
        """n estimates moved by corrections, shape (n, d); ``P``, shape (n, d, d), are the covariances after them."""
        return self._corrected(self._together(before), delta, P)

    def _corrected(self, before: _Together, delta: Array, P: Array) -> list[Gaussian]:
        size = self.error.size
        state, basis = self.error.retract(before.state, delta[:, :size])
        basis = extended(basis, P.shape[1])
        return _Together(state, basis @ P @ transpose(basis), moved(before.places, delta[0, size:])).apart()

    def local(self, some: Sequence[Gaussian], others: Sequence[Gaussian]) -> tuple[Array, Array]:
        """`ErrorVector.local` from n estimates to n others."""
        return self.error.local(self._together(some).state, self._together(others).state)

    def _together(self, known: Sequence[Gaussian]) -> _Together:
        states = [one.state for one in known]
        state, names = states[0], self.unknowns.estimated
        if len(states) == 1:
            own = {name: state.calibration[name][None] for name in names}
            R_nb, p_n, v_n, bias = state.R_nb, state.p_n, state.v_n, state.bias
        else:
            own = {name: np.array([s.calibration[name] for s in states]) for name in names}
            R_nb, p_n, v_n, bias = (
                np.concatenate([getattr(s, name) for s in states]) for name in ("R_nb", "p_n", "v_n", "bias")
            )
        state = State(R_nb, p_n, v_n, bias, {**state.calibration, **own})
        return _Together(state, np.array([one.P for one in known]), known[0].places)

    def _update(
        self,
        before: Sequence[Gaussian],
        attached: Sequence[Sequence[Attached]],
        gates: Sequence[Gates],
        used: Sequence[list[Used]],
    ) -> Sequence[Gaussian]:
        """The estimates corrected by what belongs to their keyframes, places last."""
        known = self._measured(before, [[a for a in own if a.sighting is None] for own in attached], gates, used)
        sighted = [a for own in attached for a in own if a.sighting is not None]
        assert not sighted or len(known) == 1
        for a in sighted:
            known = [self._sighted(known[0], a, used[0])]
        return known

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

    def _measured(
        self,
        before: Sequence[Gaussian],
        attached: Sequence[Sequence[Attached]],
        gates: Sequence[Gates],
        used: Sequence[list[Used]],
    ) -> Sequence[Gaussian]:
        """The estimates corrected by measurements that belong to their keyframes, of no places."""
        if not any(attached):
            return before
        known = self._together(before)
        r, H, parts = self.linearize(known.state, attached)
        losses = [[self.beginning.instruments[a.sensor].loss for a in own] for own in attached]
        said = Innovations(known.P, r, [padded(own, known.P.shape[1]) for own in H], parts, losses)
        admitted: dict[int, list[tuple[int, Attached, float]]] = {}
        for k, (one, own) in enumerate(zip(before, attached, strict=True)):
            for j, (a, part) in enumerate(zip(own, parts[k], strict=True)):
                nis = said.nis(k, part)
                if self._admit(a, nis, gates[k]):
                    admitted.setdefault(k, []).append((j, a, nis))
                    continue
                used[k].append(Used(a, one.state, nis, 0.0))
                instrument = self.beginning.instruments[a.sensor]
                if a.time - gates[k][a.sensor] > instrument.readmit_s:
                    said.doubt(k, part, padded(self._seen(instrument.model, one.state).T, known.P.shape[1]).T)
                said.leave_out(k, part)
        after = [one if k in admitted else replace(one, P=said.P(k)) for k, one in enumerate(before)]
        if not admitted:
            return after
        updates = said.update()
        for k, own_admitted in admitted.items():
            used[k].extend(Used(a, before[k].state, nis, updates[k][2][j]) for j, a, nis in own_admitted)
        if len(admitted) < len(before):
            known = self._together([before[k] for k in admitted])
        delta, P, _ = zip(*(updates[k] for k in admitted), strict=True)
        corrected = self._corrected(known, np.array(delta), np.array(P))
        for k, one in zip(admitted, corrected, strict=True):
            after[k] = one
        return after

    def _sighted(self, before: Gaussian, a: Attached, used: list[Used]) -> Gaussian:
        """The state corrected by a place that is seen again, or with one place more."""
        assert a.sighting is not None
        instrument, size, sighting = self.beginning.instruments[a.sensor], self.error.size, a.sighting
        together = self._together([before])
        (r,), (H,), [[part]] = self.linearize(together.state, [[a]])
        match = nearest(before.P, r, H, a.sd, size, before.places, sighting.name)
        gate = instrument.gate_sd or np.inf
        if match is not None and match.nis <= gate**2:
            [(delta, P, [weight])] = Innovations(
                together.P, [match.r], [match.H], [[part]], [[instrument.loss]]
            ).update()
            place = before.places[match.index]
            seen = replace(a, sighting=sighting._replace(number=place.number))
            used.append(Used(seen, before.state.seeing(place.position), match.nis, weight))
            [after] = self.corrected([before], delta[None], P[None])
            return replace(after, places=seen_at(after.places, match.index, a.time))
        place = Place(sighting.name, sighting.number, -a.sd * r, a.time)
        other, nis = (place, 0.0) if match is None else (before.places[match.index], match.nis)
        used.append(Used(a, before.state.seeing(other.position), nis, 1.0 if match is None else 0.0))
        P, places = with_another(before.P, before.places, place, a.sd[:, None] * H, a.sd)
        return Gaussian(before.state, *without_oldest(P, places, size, self.beginning.config.place.remembered))


def _kind(a: Attached) -> tuple[str, bool, bool]:
    """Of which measurements can be linearised together."""
    return a.sensor, a.track is None, a.felt is None
