"""Section on the dive itself: depth, attitude, velocities, altitude and sds against time, each with its band."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rovgraph.geometry import Array
from rovgraph.report.colours import SERIES
from rovgraph.report.motion import Series, axis_limits, bottom, lower_end, motion, span, unwrapped
from rovgraph.report.pages.page import Item, Panel, Section, Trace, broken, extremes, line, packed
from rovgraph.report.pages.source import DiveSource
from rovgraph.report.pages.uncertainty import sd_panels

BOTTOM = "#8C6D46"
STRETCHES = 500  # of a series; two panels stand side by side
SHOWN = (
    ("Depth", "depth [m]", ("depth",)),
    ("Heading", "heading [°]", ("heading",)),
    ("Roll and pitch", "angle [°]", ("roll", "pitch")),
    ("Speed over ground", "speed [m/s]", ("speed",)),
    ("Velocity north, east and down", "velocity [m/s]", ("north", "east", "down")),
)


def dive_section(source: DiveSource) -> Section:
    """A panel for each quantity that the track has."""
    track = source.main
    yaw = track["yaw"]
    found = motion(track.__getitem__, lower_end(yaw[np.isfinite(yaw)]))
    items: list[Item] = []
    for title, label, names in SHOWN:
        known = [found[name] for name in names if np.isfinite(found[name].value).any()]
        if known:
            items.append(_panel(source, title, label, known))
    items += [*_altitude(source), *sd_panels(source)]
    if len(items) % 2 and isinstance(items[-1], Panel):
        items[-1] = replace(items[-1], wide=True)
    lead = ["Bands hold one standard deviation (sd) to each side. Zooming one plot zooms all of them."]
    return Section("dive", "The dive", lead, items)


def _panel(source: DiveSource, title: str, label: str, shown: Sequence[Series]) -> Panel:
    time, drawn, spans = source.main["time"], [], []
    for one, colour in zip(shown, SERIES, strict=False):
        drawn.append(_band(source, one, colour))
        spans.append(span(time, one.value, one.sd, 1.0))
    if shown[0].name == "depth":
        below = _bottom(source)
        if below is not None:
            ping, depth = broken(*below)
            some = extremes(depth, stretches=STRETCHES)
            drawn.append(line("bottom", source.clock(ping[some]), depth[some], BOTTOM))
            spans.append(span(below[0], below[1], np.zeros_like(below[1]), 0.0))
    limits = axis_limits(spans)
    if limits is not None and shown[0].name == "speed":
        limits = 0.0, limits[1]
    return Panel(title, source.clock.label, label, drawn, wide=False, limits=limits, down=shown[0].name == "depth")


def _band(source: DiveSource, one: Series, colour: str) -> Trace:
    """A line and one sd to each side; a heading breaks where it passes north."""
    some = extremes(one.value, one.sd, stretches=STRETCHES)
    lines = source.main["time"][some], one.value[some], one.sd[some]
    time, value, sd = unwrapped(*lines) if one.name == "heading" else lines
    band = {"sd": packed(sd), "band": 1} if np.isfinite(sd).any() else {}
    return line(one.name, source.clock(time), value, colour, **band)


def _pings(source: DiveSource) -> tuple[Array, Array] | None:
    """Times and altitudes of pings that have one."""
    pings = source.pings
    if pings is None:
        return None
    time, altitude = pings["time"].to_numpy(float), pings["altitude"].to_numpy(float)
    known = np.isfinite(altitude)
    return (time[known], altitude[known]) if known.any() else None


def _bottom(source: DiveSource) -> tuple[Array, Array] | None:
    """Times of pings and the depth of the bottom under them."""
    pings = _pings(source)
    return None if pings is None else (pings[0], bottom(source.main["time"], source.main["down"], *pings))


def _altitude(source: DiveSource) -> list[Item]:
    pings = _pings(source)
    if pings is None:
        return []
    time, altitude = broken(*pings)
    some = extremes(altitude, stretches=STRETCHES)
    limits = axis_limits([(0.0, 0.0), span(pings[0], pings[1], np.zeros_like(pings[1]), 0.0)])
    drawn = [line("altitude", source.clock(time[some]), altitude[some], BOTTOM)]
    labels = (source.clock.label, "altitude [m]")
    return [Panel("Altitude over the bottom", *labels, drawn, wide=False, limits=limits)]
