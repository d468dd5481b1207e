"""The thesis's filters over whole logs."""

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from rovgraph.config import Config
from rovgraph.errors import InputError
from rovgraph.estimators.estimate import Estimate
from rovgraph.estimators.thesis.outcome import estimate_of
from rovgraph.estimators.thesis.recursion import Recursion, run_together
from rovgraph.estimators.thesis.setup import prepare
from rovgraph.estimators.thesis.truth import TrueMotion
from rovgraph.estimators.thesis.variants import FILTERS, Filter
from rovgraph.log import Log
from rovgraph.trajectory import Trajectory

Made = TypeVar("Made")


@dataclass(frozen=True)
class FilterJob:
    """A filter on a dive.

    Attributes
    ----------
    variant, log, config : the filter, the dive, and what is believed of vehicle and sensors
    truth : for a filter that is ``linearized_at`` it, dense
    """

    variant: Filter
    log: Log
    config: Config
    truth: Trajectory | None = None


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
        sample, whitened, see `rovgraph.estimators.thesis.outcome`

    Raises
    ------
    InputError : no such filter; the log lacks what it needs; it diverges
    """
    variant = _named(which) if isinstance(which, str) else which
    (done,) = run_filters([FilterJob(variant, log, config, truth)])
    if isinstance(done, Exception):
        raise done
    return done


def run_filters(asked: Sequence[FilterJob]) -> list[Estimate | Exception]:
    """Run filters on dives, those of one kind (`Filter.kind`) side by side, at a fraction of the time.

    Returns
    -------
    list : as `run_filter` would have it of each, or what that would raise
    """
    begun = [_attempted(_begun, each) for each in asked]
    kinds: dict[Filter, list[Recursion]] = {}
    for each, recursion in zip(asked, begun, strict=True):
        if isinstance(recursion, Recursion):
            kinds.setdefault(each.variant.kind, []).append(recursion)
    for members in kinds.values():
        run_together(members)
    return [_attempted(_done, each) if isinstance(each, Recursion) else each for each in begun]


def _begun(asked: FilterJob) -> Recursion:
    variant, at = asked.variant, None
    setup = prepare(variant, asked.log, asked.config)
    if variant.linearized_at == "truth":
        if asked.truth is None:
            raise ValueError(f"{variant.name} is linearised at the truth, which was not given")
        at = TrueMotion(setup.places, variant.motion == "body", asked.truth)
    return Recursion(setup, at)


def _done(recursion: Recursion) -> Estimate:
    if recursion.error is not None:
        raise recursion.error
    return estimate_of(recursion)


def _attempted(function: Callable[[Any], Made], argument: Any) -> Made | Exception:
    try:
        return function(argument)
    except Exception as error:  # one that fails does not stop the others
        return error


def _named(name: str) -> Filter:
    if name not in FILTERS:
        near = difflib.get_close_matches(name.lower(), FILTERS, 1)
        hint = f", did you mean {near[0]}?" if near else ""
        raise InputError(f"unknown filter {name!r}{hint} (known: {', '.join(FILTERS)})")
    return FILTERS[name]
