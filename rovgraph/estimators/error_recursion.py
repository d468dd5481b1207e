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

import numpy as np

from rovgraph.config import beliefs
from rovgraph.engine.keyframes import KeyframeInterval, KeyframeMeasurement
from rovgraph.engine.scale import COLUMNS, SCALES
from rovgraph.engine.transition import transitions
from rovgraph.engine.unknowns import unknowns
from rovgraph.estimators.alignment import aligned, attitude_poorly_known, with_attitude
from rovgraph.estimators.error_vector import ErrorVector
from rovgraph.estimators.filter_step import FilterStep, Gates, Gaussian, ProcessedMeasurement, Step
from rovgraph.estimators.initialise import InitialConditions
from rovgraph.estimators.innovations import Innovations
from rovgraph.estimators.linearization import Linearization
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
from rovgraph.geometry import Array, identities, transpose
from rovgraph.sensors import Position, SensorModel
from rovgraph.state import POSE, VELOCITY, State, stack_states
from rovgraph.trajectory import Trajectory

RETURN_SD = 3.0  # a sensor that was kept out for long returns with an innovation within this many sd


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
    measurements : as they are linearised
    """

    def __init__(self, beginning: InitialConditions) -> None:
        self.beginning = beginning
        self.beliefs = beliefs(beginning.config)
        self.unknowns = unknowns(self.beliefs, beginning.instruments)
        self.error = ErrorVector(self.unknowns.estimated, beginning.instruments)
        self.measurements = Linearization(beginning, self.error, self.unknowns)
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

    def through(self, interval: KeyframeInterval, before: Gaussian, gates: Gates) -> FilterStep:
        """Take one interval.

        Parameters
        ----------
        interval : the next one
        before : the keyframe before, or at the first `start`
        gates : renewed in place
        """
        return self.through_together([interval], [before], [gates])[0]

    def through_together(
        self, intervals: Sequence[KeyframeInterval], before: Sequence[Gaussian], gates: Sequence[Gates]
    ) -> list[FilterStep]:
        """Take one interval of each of some filters; `through` says of what.

        All of them are at their first keyframe, or none is; where there are several, none has seen a place.
        """
        used: list[list[ProcessedMeasurement]] = [[] for _ in intervals]
        departed: Sequence[Gaussian | None] = [None] * len(intervals)
        steps: Sequence[Step | None] = [None] * len(intervals)
        predicted = before
        if intervals[0].motion is not None:
            between = [i.between for i in intervals]
            near = [self._aligned(*own) for own in zip(before, intervals, between, strict=True)]
            departed = left = self._update(near, between, gates, used)
            steps = made = self.predict_together(intervals, left)
            predicted = [step.predicted for step in made]
        filtered = self._update(predicted, [i.here for i in intervals], gates, used)
        return [FilterStep(*one) for one in zip(departed, steps, filtered, used, strict=True)]

    def predict(self, interval: KeyframeInterval, before: Gaussian) -> Step:
        """The next keyframe, from the IMU alone; calibration walks."""
        return self.predict_together([interval], [before])[0]

    def predict_together(self, intervals: Sequence[KeyframeInterval], before: Sequence[Gaussian]) -> list[Step]:
        """The next keyframes of some filters; as `predict`."""
        size, P = self.error.size, np.array([known.P for known in before])
        F, Q = identities(*P.shape[:2]), np.zeros_like(P)
        states, F[:, :15, :15], own_Q = transitions(intervals, [known.state for known in before])
        for k, interval in enumerate(intervals):
            assert interval.motion is not None
            Q[k, :size, :size] = self._walk * interval.motion.duration
            if interval.scale_to_bias is not None:
                for name in set(SCALES) & set(self.error.columns):  # they move as the bias does, but for itself
                    F[k, :9, self.error.columns[name]] = F[k, :9, 9:15] @ interval.scale_to_bias[:, COLUMNS[name]]
        Q[:, :15, :15] = own_Q
        P = F @ P @ transpose(F) + Q
        P = 0.5 * (P + transpose(P))
        predicted = [Gaussian(*one) for one in zip(states, P, (known.places for known in before), strict=True)]
        return [Step(*one) for one in zip(F, Q, predicted, strict=True)]

    def trajectory(self, intervals: Sequence[KeyframeInterval], known: Sequence[Gaussian]) -> Trajectory:
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
        attached: Sequence[Sequence[KeyframeMeasurement]],
        gates: Sequence[Gates | None],
        used: Sequence[list[ProcessedMeasurement]],
    ) -> Sequence[Gaussian]:
        """The estimates corrected by what belongs to their keyframes, places last; without gates all of it counts."""
        known = self._measured(before, [[a for a in own if a.landmark is None] for own in attached], gates, used)
        sighted = [a for own in attached for a in own if a.landmark is not None]
        assert not sighted or len(known) == 1
        for a in sighted:
            known = [self._sighted(known[0], a, used[0])]
        return known

    def _aligned(self, known: Gaussian, interval: KeyframeInterval, between: Sequence[KeyframeMeasurement]) -> Gaussian:
        """The keyframe before an interval; with a new attitude where it is poorly known."""
        if not attitude_poorly_known(known):
            return known
        near = aligned(known, interval, between, self.measurements, self.beginning.config.environment.gravity_mps2)
        [after] = self._update([near], [between], [None], [[]])
        return with_attitude(known, after.state.R_nb[0])

    def _admit(self, a: KeyframeMeasurement, nis: float, gates: Gates) -> bool:
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
        attached: Sequence[Sequence[KeyframeMeasurement]],
        gates: Sequence[Gates | None],
        used: Sequence[list[ProcessedMeasurement]],
    ) -> Sequence[Gaussian]:
        """The estimates corrected by measurements that belong to their keyframes, of no places."""
        if not any(attached):
            return before
        known = self._together(before)
        r, H, parts = self.measurements.linearize(known.state, attached)
        losses = [[self.beginning.instruments[a.sensor].loss for a in own] for own in attached]
        said = Innovations(known.P, r, [padded(own, known.P.shape[1]) for own in H], parts, losses)
        admitted: dict[int, list[tuple[int, KeyframeMeasurement, float]]] = {}
        for k, (one, own) in enumerate(zip(before, attached, strict=True)):
            for j, (a, part) in enumerate(zip(own, parts[k], strict=True)):
                nis = said.nis(k, part)
                shut = gates[k]
                if shut is None or self._admit(a, nis, shut):
                    admitted.setdefault(k, []).append((j, a, nis))
                    continue
                used[k].append(ProcessedMeasurement(a, one.state, nis, 0.0))
                instrument = self.beginning.instruments[a.sensor]
                if a.time - shut[a.sensor] > instrument.readmit_s:
                    said.doubt(k, part, padded(self._seen(instrument.model, one.state).T, known.P.shape[1]).T)
                said.leave_out(k, part)
        after = [one if k in admitted else replace(one, P=said.P(k)) for k, one in enumerate(before)]
        if not admitted:
            return after
        updates = said.update()
        for k, own_admitted in admitted.items():
            used[k].extend(
                ProcessedMeasurement(a, before[k].state, nis, updates[k][2][j]) for j, a, nis in own_admitted
            )
        if len(admitted) < len(before):
            known = self._together([before[k] for k in admitted])
        delta, P, _ = zip(*(updates[k] for k in admitted), strict=True)
        corrected = self._corrected(known, np.array(delta), np.array(P))
        for k, one in zip(admitted, corrected, strict=True):
            after[k] = one
        return after

    def _sighted(self, before: Gaussian, a: KeyframeMeasurement, used: list[ProcessedMeasurement]) -> Gaussian:
        """The state corrected by a place that is seen again, or with one place more."""
        assert a.landmark is not None
        instrument, size, landmark = self.beginning.instruments[a.sensor], self.error.size, a.landmark
        together = self._together([before])
        (r,), (H,), [[part]] = self.measurements.linearize(together.state, [[a]])
        match = nearest(before.P, r, H, a.sd, size, before.places, landmark.name)
        gate = instrument.gate_sd or np.inf
        if match is not None and match.nis <= gate**2:
            [(delta, P, [weight])] = Innovations(
                together.P, [match.r], [match.H], [[part]], [[instrument.loss]]
            ).update()
            place = before.places[match.index]
            seen = replace(a, landmark=landmark._replace(number=place.number))
            used.append(ProcessedMeasurement(seen, before.state.seeing(place.position), match.nis, weight))
            [after] = self.corrected([before], delta[None], P[None])
            return replace(after, places=seen_at(after.places, match.index, a.time))
        place = Place(landmark.name, landmark.number, -a.sd * r, a.time)
        other, nis = (place, 0.0) if match is None else (before.places[match.index], match.nis)
        used.append(ProcessedMeasurement(a, before.state.seeing(other.position), nis, 1.0 if match is None else 0.0))
        P, places = with_another(before.P, before.places, place, a.sd[:, None] * H, a.sd)
        return Gaussian(before.state, *without_oldest(P, places, size, self.beginning.config.place.remembered))
