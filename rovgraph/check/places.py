"""Places seen before: how often each was, since one that is seen once adds no information."""

from collections.abc import Iterator

import numpy as np

from rovgraph.check.findings import Finding, since
from rovgraph.config import Config
from rovgraph.log import Log


def places(log: Log, config: Config) -> Iterator[Finding]:
    """How many places are seen again, and after how long."""
    if "place" not in log:
        return
    stream = log["place"]
    names, which = np.unique(stream["place_id"], return_inverse=True)
    spans = np.array([np.ptp(stream.time[which == k]) for k in range(len(names))])
    again = spans >= config.place.every_s
    if not again.any():
        text = f"{len(names)} places, none of them seen again: they add no information; "
        text += "check that a place keeps its place_id"
        yield Finding("place", "warning", text)
        return
    counted = f"{len(stream)} observations of {len(names)} places, {again.sum()} of them seen again"
    text = f"{counted}, up to {spans.max():.0f} s later"
    if not again.all():
        text += f"; {(~again).sum()} seen only once add no information"
    yield Finding("place", "ok", text)
    last = float(stream.time[again[which]].max())
    yield Finding(
        "place", "ok", f"last seen again at {since(log, last)}; from there on the error grows as without places"
    )
