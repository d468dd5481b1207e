"""Measurements as GTSAM's nonlinear factors, whose callbacks linearise the same `Block` as the chain does."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import gtsam
import numpy as np

from rovgraph.calibration import LAYOUT
from rovgraph.engine.error_layout import ErrorLayout
from rovgraph.engine.filter_step import calibration_vector
from rovgraph.engine.measurements import Block, loss_threshold
from rovgraph.engine.sensor_rows import KeyframeRows
from rovgraph.engine.unknowns import Unknowns
from rovgraph.geometry import Array
from rovgraph.graph.keys import calibration_key, key
from rovgraph.graph.values import state_at
from rovgraph.instruments import Instrument
from rovgraph.state import DIMENSION, PLACE, State

_unit = cache(gtsam.noiseModel.Unit.Create)


def measurement_keys(block: Block, segment: Array) -> list[list[int]]:
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


def measurement_factor(block: Block, segment: int) -> gtsam.CustomFactor:
    """A block of one measurement as a factor that calls back; ``segment`` as `measurement_keys` takes it."""
    index = int(block.keyframe[0])

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: Any) -> Array:
        r, jacobians = block.linearize(with_places(block, state_at(values, index, segment, block.unknowns), values))
        if H is not None:
            for place, jacobian in enumerate(jacobians.values()):
                H[place] = jacobian[0]
        return np.asarray(-r[0])  # GTSAM's error is predicted minus measured

    return gtsam.CustomFactor(robust_noise(block.instrument), measurement_keys(block, np.array([segment]))[0], error)


def keyframe_factor(
    rows: KeyframeRows, layout: ErrorLayout, unknowns: Unknowns, names: Sequence[str], keyframe: int, segment: int
) -> gtsam.CustomFactor:
    """All that kernels know of a keyframe's measurements as one factor that calls back once.

    Its losses weight the rows that it gives, which is what GTSAM's robust noise models do when they linearise.

    Parameters
    ----------
    rows : the measurements
    layout : of the columns of their Jacobians
    unknowns, names : the calibration variables, and those that the measurements depend on
    keyframe, segment : index of the keyframe, and of the value that calibration which walks has there
    """
    states = [key(variable, keyframe) for variable in DIMENSION]
    pose, velocity, bias = states
    calibration = [(calibration_key(unknowns, name, segment), LAYOUT[name]) for name in names]
    columns = [layout.columns[variable] for variable in (*DIMENSION, *names)]
    x, c = np.empty(21), calibration_vector(unknowns.fixed)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: Any) -> Array:
        there = values.atPose3(pose).matrix()
        x[:9], x[9:12] = there[:3, :3].ravel(), there[:3, 3]
        x[12:15], x[15:] = values.atVector(velocity), values.atConstantBias(bias).vector()
        for own, part in calibration:
            c[part] = values.atVector(own)
        r, J = rows.linearize(x, c, weighted=True)
        if H is not None:
            for place, part in enumerate(columns):
                H[place] = J[:, part]
        return -r  # GTSAM's error is predicted minus measured

    return gtsam.CustomFactor(_unit(rows.count), [*states, *(own for own, _ in calibration)], error)


def with_places(block: Block, state: State, values: gtsam.Values) -> State:
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
