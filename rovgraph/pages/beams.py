"""The beams of the DVL against time: how many of their pings were valid, and how far they reached."""

from collections.abc import Sequence

import numpy as np

from rovgraph.geometry import Array
from rovgraph.log import Stream
from rovgraph.log.beams import beam_numbers
from rovgraph.pages.parts import Item, Missing, Panel, Trace, bars, line, packed
from rovgraph.pages.source import Clock, DiveSource
from rovgraph.pages.thinning import extremes
from rovgraph.report.colours import SERIES

BINS = 240  # of the dive; on a narrow screen a bin is hardly wider than a pixel
PINGS = 4  # of a bin, at least, on the average
HEIGHT = 0.8  # of a row, of the place that it has
VALID, INVALID = "#0072B2", "#EDB48F"


def beam_items(source: DiveSource, spans: Sequence[tuple[float, float, str]]) -> list[Item]:
    """Valid pings and range of every beam.

    Parameters
    ----------
    spans : from, to, colour: times that are shaded
    """
    title, beams, clock = "Valid pings of each beam", source.beams, source.clock
    if beams is None:
        return [Missing(title, "the folder has no dvl_beams.csv: the log's files do not tell beams apart")]
    beams = beams.take((beams.time >= clock.start) & (beams.time <= clock.end))
    if not len(beams):
        return [Missing(title, "no ping of the beams lies within the track")]
    return [_validity(title, beams, clock), *_ranges(beams, clock, spans)]


def valid_share(beams: Stream, start: float, end: float) -> tuple[Array, Array]:
    """How many pings of each beam were valid, over stretches of equal length.

    Parameters
    ----------
    beams : of n pings and k beams, all of them between ``start`` and ``end``
    start, end : of all stretches [s]

    Returns
    -------
    edges : ndarray, shape (m + 1,), of the stretches [s]
    share : ndarray, shape (m, k) [%]; NaN where there is no ping
    """
    valid = np.column_stack([beams[f"valid_{k}"] for k in beam_numbers(beams)])
    edges = np.linspace(start, max(end, start + 1e-3), 1 + int(np.clip(len(beams) // PINGS, 1, BINS)))
    place = np.clip(np.searchsorted(edges, beams.time, side="right") - 1, 0, len(edges) - 2)
    count = np.bincount(place, minlength=len(edges) - 1)
    sums = np.column_stack([np.bincount(place, own, len(edges) - 1) for own in valid.T])
    share = np.full(sums.shape, np.nan)
    share[count > 0] = 100.0 * sums[count > 0] / count[count > 0, None]
    return edges, share


def _validity(title: str, beams: Stream, clock: Clock) -> Panel:
    """A row for each beam, filled as high as its pings were valid."""
    numbers = beam_numbers(beams)
    names = [f"beam {number}" for number in numbers]
    edges, share = valid_share(beams, clock.start, clock.end)
    middle, width = clock(0.5 * (edges[1:] + edges[:-1])), float(edges[1] - edges[0]) / clock.scale
    drawn: list[Trace] = []
    for place, (name, own) in enumerate(zip(names, share.T, strict=True), 1):
        foot, top = place + HEIGHT / 2, place - HEIGHT / 2  # places count downwards
        up, down = -HEIGHT * own / 100.0, HEIGHT * (1.0 - own / 100.0)
        drawn.append(bars(name, middle, up, VALID, width, base=foot, value=packed(own), showlegend=False))
        look = {"base": top, "value": packed(100.0 - own), "showlegend": False, "hoverinfo": "skip", "quiet": True}
        drawn.append(bars(f"{name}, not valid", middle, down, INVALID, width, **look))
    means = ", ".join(
        f"{name} {100.0 * beams[f'valid_{k}'].mean():.1f} %" for name, k in zip(names, numbers, strict=True)
    )
    note = (
        f"Blue: valid, orange: not valid, white: no ping, in every {edges[1] - edges[0]:.2g} s. Valid of all: {means}."
    )
    return Panel(title, clock.label, "beam: valid pings [%]", drawn, note=note, names=numbers)


def _ranges(beams: Stream, clock: Clock, spans: Sequence[tuple[float, float, str]]) -> list[Item]:
    """Lines of all beams that have a range."""
    drawn = []
    for number, colour in zip(beam_numbers(beams), SERIES, strict=False):
        far = beams[f"range_{number}"]
        if np.isfinite(far).any():
            some = extremes(far)
            drawn.append(line(f"beam {number}", clock(beams.time[some]), far[some], colour))
    note = "As the DVL states it: along the beam or straight down, by its maker."
    return [Panel("Range of each beam", clock.label, "range [m]", drawn, note=note, spans=spans)] if drawn else []
