"""The measurements of all sensors as Jacobian factors, one for each keyframe, and one for each place that it sees.

Making a factor costs Python and GTSAM more than the numbers in it, and eliminating many
small ones more than few; a keyframe has one for each of its sensors, or all in one.
"""

from collections.abc import Mapping
from functools import cache
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray

from rovgraph.calibration import TABLE
from rovgraph.engine.measurements import Measurements
from rovgraph.geometry import Array
from rovgraph.graph.keys import key
from rovgraph.state import DIMENSION, PLACE, PLACE_DIM, Jacobians

_unit = cache(gtsam.noiseModel.Unit.Create)


class Rows:
    """Where each measurement's rows lie among those of all, sorted by keyframe and place.

    Parameters
    ----------
    blocks : sensor -> Measurements, at least one; either of places or of none
    value : index of the value that calibration which walks has at each keyframe
    """

    def __init__(self, blocks: Mapping[str, Measurements], value: NDArray[np.int64]) -> None:
        every, self._sensors = list(blocks.values()), list(blocks)
        walks = {name: walk for block in every for name, walk in block.unknowns.walks.items()}
        touched = {variable for block in every for variable in block.variables}
        sizes = DIMENSION | {PLACE: PLACE_DIM} | {name: TABLE[name].dim for name in walks}
        self._sizes = {variable: size for variable, size in sizes.items() if variable in touched}
        keyframe = np.concatenate([block.keyframe for block in every])
        place = np.concatenate([block.place for block in every])
        dims = np.concatenate([np.full(len(block), block.z.shape[1]) for block in every])
        order = np.lexsort((place, keyframe))
        first = np.empty_like(dims)
        first[order] = np.cumsum(dims[order]) - dims[order]
        self._count = int(dims.sum())
        own = np.split(first, np.cumsum([len(block) for block in every])[:-1])
        self._rows = [f[:, None] + np.arange(block.z.shape[1]) for f, block in zip(own, every, strict=True)]
        other = np.diff(keyframe[order], prepend=-1).astype(bool) | np.diff(place[order], prepend=-2).astype(bool)
        begun = order[np.flatnonzero(other)]  # the first measurement of each factor
        index = dict.fromkeys(DIMENSION, keyframe) | {PLACE: place}
        index |= {v: value[keyframe] if walk else 0 * keyframe for v, walk in walks.items()}
        self._keys: list[list[int]] = np.column_stack([key(v) + index[v][begun] for v in self._sizes]).tolist()
        self._of_factor = [slice(a, b) for a, b in pairwise([*first[begun].tolist(), self._count])]

    def push(self, graph: gtsam.GaussianFactorGraph, linear: Mapping[str, tuple[Array, Jacobians]]) -> None:
        """Add the factors of all keyframes that have measurements.

        Parameters
        ----------
        graph : to add to
        linear : sensor -> innovations and Jacobians of its block, as `Measurements.weighted` returns them
        """
        b = np.zeros(self._count)
        A = {v: np.zeros((self._count, size)) for v, size in self._sizes.items()}
        for rows, (r, H) in zip(self._rows, (linear[sensor] for sensor in self._sensors), strict=True):
            b[rows] = r
            for v, h in H.items():
                A[v][rows] = h
        for keys, own in zip(self._keys, self._of_factor, strict=True):
            terms = [(k, a[own]) for k, a in zip(keys, A.values(), strict=True)]
            # a conditional is a Jacobian factor, and the only one the bindings make of more than three keys
            graph.push_back(gtsam.GaussianConditional(terms, 1, b[own], _unit(own.stop - own.start)))
