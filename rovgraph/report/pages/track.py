"""The track seen from above: in the colours of its sd, with fixes, ellipses and outages, and data for the cursor."""

import html
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pymap3d.rcurve import meridian, transverse

from rovgraph.geometry import Array
from rovgraph.report.colours import BOTTOM, ESTIMATES, REJECTED, USED
from rovgraph.report.pages.acoustics import acoustic_traces
from rovgraph.report.pages.page import Missing, Panel, Trace, extremes, line, packed, points, spread
from rovgraph.report.pages.source import KINDS, DiveSource, PageTrack

ELLIPSES, ELLIPSE = 24, "#8A8A9A"
SOUNDINGS = 1500  # that are drawn
SPACED = np.linspace(0.0, 2 * np.pi, 41)
SILENT, MARK = "#B35900", "#6A3D9A"
# of the sd from low to high, dark to light: readable for the colour-blind and in grey (viridis, its pale end left out)
RAMP = ("#440154", "#472D7B", "#3B528B", "#2C728E", "#21918C", "#28AE80", "#5EC962", "#ADDC30", "#DDE318", "#FDC926")
POLAR_DEG = 89.0  # beyond it a degree of longitude is no length to draw with


def track_chart(source: DiveSource) -> Panel | Missing:
    """The map; the main track in the colours of its sd."""
    if not np.isfinite(source.main["north"]).any():
        return Missing("Track", "the trajectory holds no known position")
    coloured, ramp = _coloured(source)
    traces = [
        *_lines(source, without=source.main.kind if coloured else ""),
        *_ellipses(source.main),
        *_fixes(source.residuals, source),
        *acoustic_traces(source),
        *_soundings(source),
        *_crossings(source),
        *_silent(source),
        *coloured,
        *_ends(source),
        *_marks(source.frame("marks.csv", "name", "north", "east")),
    ]
    title = "Track, coloured by its sd" if ramp else "Track"
    return Panel(title, "east [m]", "north [m]", traces, kind="map", ramp=ramp)


def track_notes(source: DiveSource) -> list[str]:
    """What the map cannot show, a sentence each."""
    notes = []
    if source.summary.get("origin") is None:
        notes.append("Latitude and longitude are not known: the log has no fix_lat, the configuration no origin.")
    notes += [f"The folder has no {kind.replace('_', ' ')} track." for kind in KINDS if kind not in source.tracks]
    if source.residuals is None:
        notes.append("residuals.csv is missing, so fixes cannot be shown.")
    return notes


def _coloured(source: DiveSource) -> tuple[list[Trace], tuple[Sequence[str], str, str] | None]:
    """The main track in a piece for each colour, and the colours with the sd of both ends; none without an sd."""
    track, sd = source.main, source.main.horizontal_sd
    some = extremes(track["north"], track["east"])
    known = sd[some][np.isfinite(sd[some])]
    if len(known) < 2:
        return [], None
    low, high = float(known.min()), float(known.max())
    share = (np.where(np.isnan(sd[some]), low, sd[some]) - low) / max(high - low, 1e-9)
    step = np.clip((share * len(RAMP)).astype(int), 0, len(RAMP) - 1)[:-1]
    digits = int(np.clip(1 - np.floor(np.log10(max(high, 1e-3))), 1, 3))
    drawn = []
    for k, colour in enumerate(RAMP):
        pieces = np.flatnonzero(step == k)
        if not len(pieces):
            continue
        breaks = np.flatnonzero(np.diff(pieces) > 1) + 1
        index = np.concatenate([np.append(part, [part[-1] + 1, -1]) for part in np.split(pieces, breaks)])
        columns = {name: values[some][index] for name, values in _seen(source, track, sd).items()}
        for values in columns.values():
            values[index < 0] = np.nan
        look = {"width": 3.5, "t": packed(columns["t"]), "value": packed(columns["sd"]), "showlegend": False}
        drawn.append(line(f"{track.name} {k}", columns["east"], columns["north"], colour, **look))
    return drawn, (RAMP, f"{low:.{digits}f} m", f"{high:.{digits}f} m")


def _seen(source: DiveSource, track: PageTrack, sd: Array) -> dict[str, Array]:
    return {"t": source.clock(track["time"]), "north": track["north"].copy(), "east": track["east"].copy(), "sd": sd}


def cursor(source: DiveSource) -> dict[str, Any]:
    """The main track at the times that the slider can stand at, for ``page.js``."""
    track, clock = source.main, source.clock
    some = _thinned(track)
    major, minor, bearing = track.ellipses
    found: dict[str, Any] = {
        "time": packed(clock(track["time"][some])),
        "north": packed(track["north"][some]),
        "east": packed(track["east"][some]),
        "down": packed(track["down"][some]),
        "yaw": packed(np.unwrap(track["yaw"][some]) if np.isfinite(track["yaw"][some]).all() else track["yaw"][some]),
        "major": packed(major[some]),
        "minor": packed(minor[some]),
        "bearing": packed(bearing[some]),
    }
    return found


def origin(source: DiveSource) -> dict[str, float] | None:
    """Latitude and longitude of north = east = 0 and metres of a degree of each; None if not known, or polar."""
    place = source.summary.get("origin")
    if not isinstance(place, dict) or not all(isinstance(place.get(k), int | float) for k in ("lat_deg", "lon_deg")):
        return None
    lat = float(place["lat_deg"])
    if not abs(lat) <= POLAR_DEG:
        return None
    degree = np.deg2rad(1.0)
    metres = {
        "lat_m": float(meridian(lat) * degree),
        "lon_m": float(transverse(lat) * np.cos(np.deg2rad(lat)) * degree),
    }
    return {"lat": lat, "lon": float(place["lon_deg"]), **metres}


def _thinned(track: PageTrack) -> NDArray[np.intp]:
    return extremes(track["north"], track["east"])


def _lines(source: DiveSource, without: str) -> list[Trace]:
    dashes = {"smoothed": "solid", "filtered": "dash", "dead_reckoning": "dot"}
    drawn = []
    for kind, track in reversed(source.tracks.items()):
        if kind == without:
            continue
        some = _thinned(track)
        look: dict[str, Any] = {"dash": dashes[kind], "width": 1.3}
        look |= {} if kind == source.main.kind else {"visible": "legendonly"}
        when = packed(source.clock(track["time"][some]))
        drawn.append(line(track.name, track["east"][some], track["north"][some], ESTIMATES[kind], t=when, **look))
    return drawn


def _silent(source: DiveSource) -> list[Trace]:
    track = source.main
    if not source.silences:
        return []
    parts = []
    for begin, end in source.silences:
        inside = np.flatnonzero((track["time"] >= begin) & (track["time"] <= end))
        if len(inside) > 1:
            parts.append(inside[spread(len(inside), 60)])
    if not parts:
        return []
    east, north = (np.concatenate([np.append(track[c][p], np.nan) for p in parts]) for c in ("east", "north"))
    return [line("no bottom lock", east, north, SILENT, width=5, opacity=0.55, hoverinfo="skip")]


def _fixes(rows: pd.DataFrame | None, source: DiveSource) -> list[Trace]:
    if rows is None or "measured" not in rows:
        return []
    fixes = rows[rows["sensor"] == "fix"]
    if fixes.empty:
        return []
    both = fixes.pivot_table(index=["time", "row"], columns="component", values=["measured", "weight"], dropna=False)
    if not {("measured", "north"), ("measured", "east")} <= set(both.columns):
        return []
    north, east = (both["measured"][c].to_numpy(float) for c in ("north", "east"))
    weight = both["weight"].to_numpy(float).min(axis=1)
    time = source.clock(both.index.get_level_values("time").to_numpy(float))
    drawn = []
    for name, mask, colour, symbol in (
        ("fix, used", weight > 0, USED, "cross-thin-open"),
        ("fix, rejected", weight <= 0, REJECTED, "x-thin-open"),
    ):
        some = np.flatnonzero(mask)
        if len(some):
            some = some[spread(len(some), 1500)]
            look = {"size": 6, "symbol": symbol, "t": packed(time[some])}
            drawn.append(points(f"{name} ({int(mask.sum())})", east[some], north[some], colour, **look))
    return drawn


def _soundings(source: DiveSource) -> list[Trace]:
    """Where ranges met the bottom; shown on demand."""
    found = source.soundings
    if found is None or found.empty:
        return []
    used = found[found["used"] == 1]
    few = used.iloc[spread(len(used), SOUNDINGS)]
    text = [f"{depth:.1f} m" for depth in few["depth"]]
    look: dict[str, Any] = {"visible": "legendonly", "text": text, "hoverinfo": "text"}
    when = packed(source.clock(few["time"].to_numpy(float)))
    return [points(f"soundings ({len(used)})", few["east"], few["north"], BOTTOM, size=3, t=when, **look)]


def _crossings(source: DiveSource) -> list[Trace]:
    """Where soundings of lines, or of a line and a chart, were compared."""
    found = ((source.summary.get("estimates") or {}).get(source.main.kind) or {}).get("crossovers")
    if not found:
        return []
    time, matched = np.asarray(found["time_s"], float), np.asarray(found["matched"], bool)
    drawn = []
    for name, some, colour in (("matched", matched, USED), ("not matched", ~matched, REJECTED)):
        if some.any():
            north, east = (np.interp(time[some], source.main["time"], source.main[c]) for c in ("north", "east"))
            look = {"size": 9, "symbol": "circle-open", "t": packed(source.clock(time[some]))}
            drawn.append(points(f"crossings, {name} ({int(some.sum())})", east, north, colour, **look))
    return drawn


def _ellipses(track: PageTrack) -> list[Trace]:
    """99 % ellipses along the track as one line with gaps."""
    major, minor, bearing = track.ellipses
    known = np.flatnonzero(np.isfinite(major) & np.isfinite(track["north"]))
    if not len(known):
        return []
    some = known[spread(len(known), ELLIPSES)]
    a, b = major[some, None] * np.cos(SPACED), minor[some, None] * np.sin(SPACED)
    c, s = np.cos(bearing[some, None]), np.sin(bearing[some, None])
    gap = np.full((len(some), 1), np.nan)
    north = np.hstack([track["north"][some, None] + c * a - s * b, gap]).ravel()
    east = np.hstack([track["east"][some, None] + s * a + c * b, gap]).ravel()
    return [line("99 % ellipses", east, north, ELLIPSE, width=0.9, hoverinfo="skip")]


def _ends(source: DiveSource) -> list[Trace]:
    track = source.main
    ends = (("start", 0, "circle-open"), ("end", -1, "square"))
    look = [(name, track["east"][i], track["north"][i], symbol) for name, i, symbol in ends]
    return [points(name, [e], [n], "#000000", size=9, symbol=symbol, hoverinfo="name") for name, e, n, symbol in look]


def _marks(rows: pd.DataFrame | None) -> list[Trace]:
    """What a person marked during the dive, with the names."""
    if rows is None or rows.empty:
        return []
    north, east = (pd.to_numeric(rows[c], errors="coerce").to_numpy(float) for c in ("north", "east"))
    names = [html.escape(str(name)) for name in rows["name"].fillna("")]  # Plotly reads tags in a text
    look: dict[str, Any] = {"mode": "markers+text", "text": names, "textposition": "top right", "hoverinfo": "text"}
    return [points("mark", east, north, MARK, size=9, symbol="triangle-up", **look)]
