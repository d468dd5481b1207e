"""The estimators by name, for whoever compares them.

Headings, as the thesis letters them: a = magnetometer and the DVL's compass, b = the
DVL's compass, c = the magnetometer.
"""

import difflib
import fnmatch
from collections.abc import Sequence

from rovgraph.errors import InputError
from rovgraph.estimators.eskf.error_state import ErrorStateFilter
from rovgraph.estimators.smoother import BatchSmoother
from rovgraph.estimators.thesis import FILTERS, Filter
from rovgraph.studies.estimator_chains import (
    EstimatorSpec,
    Stage,
    assembled,
    filtered_by_isam2,
    incremental,
    reinitialised,
    smoothed_by_isam2,
    stepped,
)

_REINITIALISED = "filter reinitialised from the graph of the dive so far"
_LETTERS = {(True, True): "a", (False, True): "b", (True, False): "c"}  # magnetometer, compass
_WITH = {"a": "magnetometer and DVL compass", "b": "DVL compass alone", "c": "magnetometer alone"}


def _of_the_thesis(variant: Filter) -> EstimatorSpec:
    """One of the thesis's filters, which hold calibration at its means but for what are their states."""

    letter = _LETTERS.get((variant.magnetometer, variant.compass), "")
    about = (variant.about, letter, variant.misalignment, False)
    return EstimatorSpec(variant.name, "thesis", *about, stages=(), whitened=True, variant=variant)


def _variants(kind: str, family: str, about: str, smoothing: bool, *stages: Stage) -> list[EstimatorSpec]:
    """An estimator with each set of headings, and with the misalignment estimated."""
    held = [
        EstimatorSpec(f"{kind}-{letter}", family, f"{about}, {words}", letter, False, smoothing, (assembled, *stages))
        for letter, words in _WITH.items()
    ]
    words = f"{about}, misalignment estimated"
    return [*held, EstimatorSpec(f"{kind}-misalignment", family, words, "a", True, smoothing, (assembled, *stages))]


def _driven(kind: str, family: str, about: str, smoothing: bool, *stages: Stage) -> EstimatorSpec:
    """An estimator that knows thrusters and drag, with both headings."""
    name, words = f"{kind}-hydrodynamics", f"{about}, {_WITH['a']}, thrusters and drag"
    return EstimatorSpec(name, family, words, "a", False, smoothing, (assembled, *stages), hydrodynamics=True)


ESTIMATORS: dict[str, EstimatorSpec] = {
    named.name: named
    for named in (
        EstimatorSpec(
            "dead-reckoning",
            "dead reckoning",
            "DVL along the best compass, gyro levelled by gravity",
            "",
            False,
            False,
            (assembled, BatchSmoother.dead_reckoning),
        ),
        *(_of_the_thesis(variant) for variant in FILTERS.values()),
        *_variants("ekf", "error state", "error-state Kalman filter", False, stepped, ErrorStateFilter.solve),
        *_variants("rts", "error state", "its Rauch-Tung-Striebel smoother", True, stepped, ErrorStateFilter.smoothed),
        *_variants(
            "graph-filtered",
            "graph",
            _REINITIALISED,
            False,
            reinitialised,
            ErrorStateFilter.solve,
        ),
        *_variants("graph-smoothed", "graph", "factor graph, whole dive", True, BatchSmoother.solve),
        *_variants("isam2-filtered", "isam2", "iSAM2, each keyframe when new", False, incremental, filtered_by_isam2),
        *_variants("isam2-smoothed", "isam2", "iSAM2, whole dive at its end", True, incremental, smoothed_by_isam2),
        _driven("ekf", "error state", "error-state Kalman filter", False, stepped, ErrorStateFilter.solve),
        _driven("graph-smoothed", "graph", "factor graph, whole dive", True, BatchSmoother.solve),
    )
}


def select(names: Sequence[str] | None = None) -> list[EstimatorSpec]:
    """Estimators by name or pattern (``graph-*``), in the order of `ESTIMATORS`, each once.

    Without names all but those that need thrusters.

    Raises
    ------
    InputError : an unknown name; the message has the nearest and lists all
    """
    chosen = {name for name, named in ESTIMATORS.items() if names is None and not named.hydrodynamics}
    for name in names or ():
        matching = fnmatch.filter(ESTIMATORS, name)
        if not matching:
            near = difflib.get_close_matches(name, ESTIMATORS, 1, cutoff=0.0)
            raise InputError(f"unknown estimator {name!r}, nearest is {near[0]}; there are {', '.join(ESTIMATORS)}")
        chosen.update(matching)
    if not chosen:
        raise InputError(f"no estimator named; there are {', '.join(ESTIMATORS)}")
    return [named for name, named in ESTIMATORS.items() if name in chosen]
