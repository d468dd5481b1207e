"""Measurements as GTSAM's nonlinear factors, whose callbacks linearise the same `Measurements` as the chain does."""

from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from rovgraph.engine.measurements import Measurements, loss_threshold
from rovgraph.geometry import Array
from rovgraph.graph.keys import key
from rovgraph.graph.values import state_at
from rovgraph.instruments import Instrument
from rovgraph.state import PLACE, State


def measurement_keys(block: Measurements, segment: NDArray[np.int64]) -> list[list[int]]:
    """Keys of every measurement, in the order of ``block.variables``.

    Parameters
    ----------
    block : n measurements
    segment : ndarray of int, shape (n,), index of the value that calibration which walks has at each
    """
    columns = [key(v) + (block.place if v == PLACE else block.keyframe) for v in block.instrument.model.state]
    columns += [key(v) + (segment if walk else 0 * segment) for v, walk in block.unknowns.walks.items()]
    rows: list[list[int]] = np.column_stack(columns).tolist()
    return rows


def measurement_factor(block: Measurements, segment: int) -> gtsam.CustomFactor:
    """A block of one measurement as a factor that calls back; ``segment`` as `measurement_keys` takes it."""
    index = int(block.keyframe[0])

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: Any) -> Array:
        r, jacobians = block.linearize(with_places(block, state_at(values, index, segment, block.unknowns), values))
        if H is not None:
            for place, jacobian in enumerate(jacobians.values()):
                H[place] = jacobian[0]
        return np.asarray(-r[0])  # GTSAM's error is predicted minus measured

    return gtsam.CustomFactor(robust_noise(block.instrument), measurement_keys(block, np.array([segment]))[0], error)


def with_places(block: Measurements, state: State, values: gtsam.Values) -> State:
    """The state of each measurement's keyframe together with the place that is seen, where one is."""
    return block.with_places(state, {n: values.atVector(key(PLACE, n)) for n in set(block.place.tolist()) if n >= 0})


def robust_noise(instrument: Instrument) -> gtsam.noiseModel.Base:
    """The configuration's losses as GTSAM's noise models, for factors that are already whitened."""
    dim, loss = instrument.model.dim, instrument.loss
    unit, k = gtsam.noiseModel.Unit.Create(dim), loss_threshold(loss, dim)
    if loss == "none":
        return unit
    kinds = gtsam.noiseModel.mEstimator
    robust = kinds.Huber.Create(k) if loss == "huber" else kinds.Cauchy.Create(k)
    return gtsam.noiseModel.Robust.Create(robust, unit)
