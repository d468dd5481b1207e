"""Section on the dive itself: depth, attitude, velocities, altitude and sds against time, each with its band."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rovgraph.geometry import Array
from rovgraph.report.colours import BOTTOM, SERIES
from rovgraph.report.folder import CURRENT_FILE
from rovgraph.report.motion import Series, axis_limits, bottom, lower_end, motion, span, unwrapped
from rovgraph.report.pages.page import Item, Panel, Section, Trace, broken, extremes, line, packed, points, spread
from rovgraph.report.pages.source import DiveSource
from rovgraph.report.pages.track import RAMP
from rovgraph.report.pages.uncertainty import sd_panels

CELLS = 3000  # of the current that are drawn
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
    items += [*_altitude(source), *sd_panels(source), *_current(source)]
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
        below = over_bottom(source, "bottom_depth")
        if below is not None:
            drawn.append(bottom_line(source, below, "bottom"))
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


def over_bottom(source: DiveSource, name: str) -> tuple[Array, Array, Array] | None:
    """``altitude`` or ``bottom_depth`` under the vehicle: times, values, sds; of older folders by pings."""
    track, pings = source.main, source.pings
    if name in track.columns:
        time, value, sd = track["time"], track[name], track[f"{name}_sd"]
    elif pings is not None:
        time, value = pings["time"].to_numpy(float), pings["altitude"].to_numpy(float)
        value = value if name == "altitude" else bottom(track["time"], track["down"], time, value)
        sd = np.full(len(time), np.nan)
    else:
        return None
    known = np.isfinite(value)
    return (time[known], value[known], sd[known]) if known.any() else None


def bottom_line(source: DiveSource, found: tuple[Array, Array, Array], label: str) -> Trace:
    """What `over_bottom` found as a line with its band, broken where nothing was measured."""
    time, value = broken(*found[:2])
    sd = broken(found[0], found[2])[1]
    some = extremes(value, stretches=STRETCHES)
    look = {"sd": packed(sd[some]), "band": 1} if np.isfinite(sd).any() else {}
    return line(label, source.clock(time[some]), value[some], BOTTOM, **look)


def _current(source: DiveSource) -> list[Item]:
    """The current by depth and time, as layers of the water show it: north and east in colours."""
    found = source.frame(CURRENT_FILE, "time", "depth", "north", "east", "north_sd", "east_sd")
    if found is None or found.empty:
        return []
    few = found.iloc[spread(len(found), CELLS)]
    fastest = max(float(np.abs(found[["north", "east"]].to_numpy()).max()), 0.01)
    drawn: list[Item] = []
    for axis in ("north", "east"):
        value, sd = few[axis].to_numpy(float), few[f"{axis}_sd"].to_numpy(float)
        step = np.clip(((value / fastest + 1.0) * 0.5 * len(RAMP)).astype(int), 0, len(RAMP) - 1)
        text = [f"{v:+.3f} ± {s:.3f} m/s at {z:.0f} m" for v, s, z in zip(value, sd, few["depth"], strict=True)]
        colours = [RAMP[k] for k in step.tolist()]
        look = {"size": 6, "symbol": "square", "text": text, "hoverinfo": "text", "showlegend": False}
        trace = points("knot at", source.clock(few["time"].to_numpy(float)), few["depth"], colours, **look)
        ramp = RAMP, f"{-fastest:.2f} m/s", f"{fastest:.2f} m/s"
        title, axes = f"Current {axis}", (source.clock.label, "depth [m]")
        drawn.append(Panel(title, *axes, [trace], wide=False, down=True, ramp=ramp))
    return drawn


def _altitude(source: DiveSource) -> list[Item]:
    found = over_bottom(source, "altitude")
    if found is None:
        return []
    limits = axis_limits([(0.0, 0.0), span(*found, 1.0)])
    drawn, labels = [bottom_line(source, found, "altitude")], (source.clock.label, "altitude [m]")
    return [Panel("Altitude over the bottom", *labels, drawn, wide=False, limits=limits)]
