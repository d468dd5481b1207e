"""The measurements of a keyframe of several filters side by side, linearised."""

from collections.abc import Sequence
from itertools import accumulate, groupby, pairwise

import numpy as np

from rovgraph.engine.keyframes import KeyframeMeasurement
from rovgraph.engine.unknowns import Unknowns
from rovgraph.estimators.error_vector import ErrorVector
from rovgraph.estimators.initialise import InitialConditions
from rovgraph.geometry import Array, rotate
from rovgraph.graph.measurements import Block, make_block, motions, whitening
from rovgraph.graph.places import ORIGIN
from rovgraph.sensors import innovation
from rovgraph.state import PLACE, State, propagate_with_jacobian


class Linearization:
    """What measurements say of the error of a state.

    Parameters
    ----------
    beginning : instruments and configuration
    error : layout of the error
    unknowns : what of the calibration is estimated

    Attributes
    ----------
    size : length of the error
    """

    def __init__(self, beginning: InitialConditions, error: ErrorVector, unknowns: Unknowns) -> None:
        self._beginning, self._error, self._unknowns = beginning, error, unknowns
        self.size = error.size

    def block(self, attached: Sequence[KeyframeMeasurement]) -> Block:
        """Measurements of one sensor."""
        b = self._beginning
        instrument, gravity = b.instruments[attached[0].sensor], b.config.environment.gravity_mps2
        return make_block(attached, instrument, gravity, self._unknowns)

    def linearize(
        self, state: State, attached: Sequence[Sequence[KeyframeMeasurement]]
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
        r, H = [np.empty(m) for m in rows], [np.empty((m, self._error.size)) for m in rows]
        filters, those = [k for k, _, _ in flat], [a for _, _, a in flat]
        there, F = State(state.R_nb[filters], state.p_n[filters], state.v_n[filters], state.bias[filters]), None
        if any(a.motion.dt for a in those):
            gravity = self._beginning.config.environment.gravity_mps2
            there, F = propagate_with_jacobian(there, motions(those), gravity)
        ends = list(accumulate(len(list(group)) for _, group in groupby(those, _kind)))
        for begin, end in pairwise([0, *ends]):
            which, own = slice(begin, end), those[begin:end]
            if own[0].window is not None or own[0].scale_to_bias is not None:
                own_r, own_H = self._of_block(state.at(filters[which]), own)
            else:
                calibration = self._calibration(state, own[0], filters[which])
                known = State(there.R_nb[which], there.p_n[which], there.v_n[which], there.bias[which], calibration)
                own_r, own_H = self._of_sensor(known, None if F is None else F[which], own)
            for (k, part, _), one_r, one_H in zip(flat[which], own_r, own_H, strict=True):
                r[k][part], H[k][part] = one_r, one_H
        return r, H, parts

    def _calibration(self, state: State, a: KeyframeMeasurement, filters: list[int]) -> dict[str, Array]:
        """What a measurement's model reads, of some filters."""
        if a.landmark is not None:
            return {PLACE: ORIGIN}
        values = {name: state.calibration[name] for name in self._beginning.instruments[a.sensor].model.calibration}
        return {name: value if value.ndim == 1 else value[filters] for name, value in values.items()}

    def _rows(
        self, attached: Sequence[Sequence[KeyframeMeasurement]]
    ) -> tuple[list[list[slice]], list[tuple[int, slice, KeyframeMeasurement]]]:
        """Rows of each filter's measurements; and all of them with filter and rows, those of one kind together."""
        parts, flat = [], []
        for k, own in enumerate(attached):
            ends = accumulate((self._beginning.instruments[a.sensor].model.dim for a in own), initial=0)
            parts.append([slice(*pair) for pair in pairwise(ends)])
            flat += [(k, part, a) for part, a in zip(parts[-1], own, strict=True)]
        return parts, sorted(flat, key=lambda one: _kind(one[2]))

    def _of_block(self, state: State, attached: Sequence[KeyframeMeasurement]) -> tuple[Array, Array]:
        """Whitened innovations, shape (m, dim), and Jacobians, shape (m, dim, size), of m measurements of a sensor."""
        if attached[0].landmark is not None:
            state = state.seeing(ORIGIN)
        r, jacobians = self.block(attached).linearize(state)
        return r, self._error.matrix(jacobians)

    def _of_sensor(self, state: State, F: Array | None, attached: Sequence[KeyframeMeasurement]) -> tuple[Array, Array]:
        """The same at less cost, of measurements that are where their stamps say, with an IMU of exact scale.

        Parameters
        ----------
        state : State where the measurements are
        F : ndarray, shape (m, 15, 15), its derivative by that of the keyframe, where it is another
        """
        instrument = self._beginning.instruments[attached[0].sensor]
        predicted, jacobians = instrument.model.predict(state, np.array([a.rate_b for a in attached]))
        H = self._error.matrix(jacobians)
        if F is not None:
            H[..., :15] = H[..., :15] @ F
        r = innovation(instrument.model, np.array([a.z for a in attached]), predicted)
        sd = np.array([a.sd for a in attached])
        if not instrument.rate_gain.any():
            return r / sd, H / sd[..., None]
        W = whitening(instrument, sd, np.array([a.rate_sd for a in attached]))
        return rotate(W, r), W @ H


def _kind(a: KeyframeMeasurement) -> tuple[str, bool, bool]:
    """Of which measurements can be linearised together."""
    return a.sensor, a.window is None, a.scale_to_bias is None
