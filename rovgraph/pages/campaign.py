"""Several dives side by side: a table, a map of all, and how fast each lost its way."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pymap3d import geodetic2ned

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.pages.page import render
from rovgraph.pages.parts import Item, Missing, Panel, Section, Table, Trace, line, points
from rovgraph.pages.source import DiveSource, Source, damage_named
from rovgraph.pages.thinning import extremes
from rovgraph.pages.track import origin
from rovgraph.pages.verdict import limits
from rovgraph.report.colours import SERIES
from rovgraph.report.units import plus_minus

CAMPAIGN = "campaign.html"
DASHES = ("solid", "dash", "dot", "dashdot")


def campaign_page(folders: Sequence[Path]) -> str:
    """HTML of several dives.

    Parameters
    ----------
    folders : results folders of ``smooth``

    Raises
    ------
    InputError : one of them is none, or cannot be read
    """
    with damage_named(*folders):
        dives = {name: _dive(folder) for name, folder in zip(_names(folders), folders, strict=True)}
        sections = [
            Section("dives", "Dives", (), [_table(dives)], {"What limited each": _limited(dives)}),
            Section("map", "Map of all", *_map(dives)),
            Section("drift", "Uncertainty and drift", (), [*_growth(dives)]),
            Section("calibration", "Calibration of each", (), [_calibrations(dives)]),
        ]
    return render(f"{len(dives)} dives side by side", sections)


def _dive(folder: Path) -> DiveSource:
    source = Source.read(folder)
    if "main_estimate" not in source.summary:
        raise InputError(f"{folder}: holds no results of rovgraph smooth; only dives are set side by side")
    dive = DiveSource(source.folder, source.summary)
    _ = dive.main  # read it now, to say which folder cannot be read
    return dive


def _names(folders: Sequence[Path]) -> list[str]:
    """What tells the folders apart: their own names, or their whole paths where these are the same."""
    short = [folder.resolve().name for folder in folders]
    return [
        s if short.count(s) == 1 else f"{folder} ({k + 1})"
        for k, (s, folder) in enumerate(zip(short, folders, strict=True))
    ]


def _table(dives: dict[str, DiveSource]) -> Table:
    rows = []
    for name, dive in dives.items():
        s, track = dive.summary, dive.main
        reach = track.ellipses[0]
        known = np.isfinite(reach).any()
        rejected = sum(int(c.get("rejected") or 0) for c in (s.get("sensors") or {}).values())
        rows.append(
            (
                name,
                str(s.get("name", "")),
                str(s.get("verdict", "unknown")),
                f"{(dive.clock.end - dive.clock.start) / 60:.1f}",
                _number(s.get("distance_m"), ".0f"),
                f"{np.nanmax(reach):.2g}" if known else "unknown",
                _number(100 * np.nanmax(reach) / s["distance_m"], ".2g") if known and s.get("distance_m") else "–",
                str(rejected),
                str(len(s.get("alarms") or [])),
            )
        )
    head = ("folder", "name", "verdict", "minutes", "distance [m]", "worst 99 % [m]", "of the distance [%]", "rejected",
            "alarms")  # fmt: skip
    return Table("Dives", head, rows, note="worst 99 %: semi-axis of the largest ellipse along the track.")


def _number(value: object, form: str) -> str:
    return format(value, form) if isinstance(value, int | float) else "unknown"


def _limited(dives: dict[str, DiveSource]) -> list[str]:
    return [f"{name}: {' '.join(limits(dive)) or 'not known'}" for name, dive in dives.items()]


def _look(k: int) -> tuple[str, str]:
    return SERIES[k % len(SERIES)], DASHES[k // len(SERIES) % len(DASHES)]


def _map(dives: dict[str, DiveSource]) -> tuple[list[str], list[Item]]:
    """Tracks about the first dive's origin where all origins are known, else each about its own."""
    origins = [origin(dive) for dive in dives.values()]
    common = origins[0] if all(origins) else None
    lead = (
        ["All tracks stand where they were, in metres from the origin of the first dive."]
        if common
        else ["Some dives have no latitude and longitude: each track begins at its own origin."]
    )
    traces: list[Trace] = []
    for k, (name, dive) in enumerate(dives.items()):
        own, track = origins[k], dive.main
        shift = np.zeros(3)
        if common and own:
            shift = np.array(geodetic2ned(own["lat"], own["lon"], 0.0, common["lat"], common["lon"], 0.0))
        some = extremes(track["north"], track["east"])
        north, east = track["north"][some] + shift[0], track["east"][some] + shift[1]
        colour, dash = _look(k)
        traces.append(line(name, east, north, colour, dash=dash, width=2))
        look = {"size": 8, "symbol": "circle-open", "showlegend": False, "hoverinfo": "skip"}
        traces.append(points(f"start of {name}", east[:1], north[:1], colour, **look))
    return lead, [Panel("Tracks", "east [m]", "north [m]", traces, kind="map", note="Circles: where each began.")]


def _growth(dives: dict[str, DiveSource]) -> list[Item]:
    """99 % radius against the way travelled, and how far dead reckoning went astray."""
    radius: list[Trace] = []
    drift: list[Trace] = []
    for k, (name, dive) in enumerate(dives.items()):
        colour, dash = _look(k)
        track = dive.main
        way, reach = _way(track["north"], track["east"]), track.ellipses[0]
        if np.isfinite(reach).any():
            some = extremes(reach)
            radius.append(line(name, way[some], reach[some], colour, dash=dash))
        reckoned = dive.tracks.get("dead_reckoning")
        if reckoned is not None and reckoned is not track:
            north, east = (np.interp(track["time"], reckoned["time"], reckoned[c]) for c in ("north", "east"))
            off = np.hypot(north - track["north"], east - track["east"])
            some = extremes(off)
            drift.append(line(name, way[some], off[some], colour, dash=dash))
    x = "way travelled [m]"
    titles = "99 % radius", "Dead reckoning from the best track"
    charts = ((titles[0], "semi-axis [m]", radius), (titles[1], "distance [m]", drift))
    return [
        Panel(title, x, y, drawn, kind="xy") if drawn else Missing(title, "no dive of these has what it takes")
        for title, y, drawn in charts
    ]


def _way(north: Array, east: Array) -> Array:
    steps = np.hypot(np.diff(north, prepend=north[:1]), np.diff(east, prepend=east[:1]))
    return np.asarray(np.cumsum(np.nan_to_num(steps)))


def _calibrations(dives: dict[str, DiveSource]) -> Item:
    """Estimated variables of every dive; what is mounted once should come out the same."""
    cells: dict[str, dict[str, str]] = {}
    for name, dive in dives.items():
        table = dive.calibration
        if table is None or "estimated" not in table:
            continue
        for c in table[table["estimated"].astype(str) == "True"].to_dict("records"):
            label = str(c["label"]) + ("" if str(c["unit"]) == "1" else f" [{c['unit']}]")
            cells.setdefault(label, {})[name] = plus_minus(c["value"], c["sd"])
    title = "What was estimated, ± one standard deviation"
    if not cells:
        return Missing(title, "no dive of these estimated a calibration variable")
    rows = [(label, *(own.get(name, "–") for name in dives)) for label, own in cells.items()]
    note = "What is mounted once should come out the same within its sd."
    return Table(title, ("variable", *dives), rows, note=note)
