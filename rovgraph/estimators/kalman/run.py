"""A filter of the thesis over a whole log."""

import difflib

from rovgraph.config import Config
from rovgraph.errors import InputError
from rovgraph.estimators.estimate import Estimate
from rovgraph.estimators.kalman.outcome import estimate_of
from rovgraph.estimators.kalman.recursion import Recursion
from rovgraph.estimators.kalman.setup import prepare
from rovgraph.estimators.kalman.truth import TrueMotion
from rovgraph.estimators.kalman.variants import FILTERS, Filter
from rovgraph.log import Log
from rovgraph.trajectory import Trajectory


def run_filter(which: str | Filter, log: Log, config: Config, truth: Trajectory | None = None) -> Estimate:
    """Run one of the thesis's filters.

    Heading sources are the filter's own, whatever ``heading.sources`` says; calibration
    stands at its means but for what the filter has as states; nothing is gated.

    Parameters
    ----------
    which : key of `FILTERS`, or a `Filter`
    log, config : the dive, and what is believed of vehicle and sensors
    truth : for a filter that is ``linearized_at`` it, dense

    Returns
    -------
    Estimate : ``kind`` is the filter's name; trajectory of the body's origin at the first
        epoch, the pings and the last epoch; innovations of every ping and every tenth IMU
        sample, whitened, see `rovgraph.estimators.kalman.outcome`

    Raises
    ------
    InputError : no such filter; the log lacks what it needs; it diverges
    """
    variant = _named(which) if isinstance(which, str) else which
    setup = prepare(variant, log, config)
    at = None
    if variant.linearized_at == "truth":
        if truth is None:
            raise ValueError(f"{variant.name} is linearised at the truth, which was not given")
        at = TrueMotion(setup.places, variant.motion == "body", truth)
    recursion = Recursion(setup, at)
    recursion.run()
    return estimate_of(recursion)


def _named(name: str) -> Filter:
    if name not in FILTERS:
        near = difflib.get_close_matches(name.lower(), FILTERS, 1)
        hint = f", did you mean {near[0]}?" if near else ""
        raise InputError(f"unknown filter {name!r}{hint} (known: {', '.join(FILTERS)})")
    return FILTERS[name]
