"""Standard deviations against time, what reduced them, and the section that compares filter and smoother."""

from collections.abc import Callable

import numpy as np
import pandas as pd

from rovgraph.geometry import Array
from rovgraph.report.colours import ESTIMATES, USED
from rovgraph.report.motion import axis_limits, span
from rovgraph.report.pages.page import Item, Missing, Panel, Section, Trace, extremes, line, points
from rovgraph.report.pages.source import DiveSource, PageTrack

HELPED = 0.85  # an sd that falls to this part of itself within `WITHIN_S` was helped by something
WITHIN_S = 10.0
TURN = np.deg2rad(45.0)  # of the heading around that time: a manoeuvre
SAME = 0.05  # P_filtered - P_smoothed below this part of P_filtered: as good as the same, no separation to expect
SURER, OFTEN = 1.1, 0.1  # smoothed over filtered sd, and the share of epochs, from which that is explained
MOST_BEYOND = 0.02  # of the separation, beyond three sd: a few times what chance brings, as it is correlated in time
SHOWN: tuple[tuple[str, str, Callable[[PageTrack], Array]], ...] = (
    ("Position sd, along the worst direction", "m", lambda t: t.horizontal_sd),
    ("Heading sd", "°", lambda t: np.rad2deg(t["yaw_sd"])),
)
CAUSES = {"fix": USED, "place": "#7B3294", "bottom lock again": "#B35900", "turn": "#000000", "other": "#888888"}


def sd_panels(source: DiveSource) -> list[Item]:
    """sd of position and heading with marks of what helped."""
    items: list[Item] = []
    for title, unit, of in SHOWN:
        lines = _sd_lines(source, of)
        if not lines:
            items.append(Missing(title, "no estimate of the folder states a standard deviation"))
            continue
        followed = source.tracks.get("filtered", source.main)
        marks = _marks(source, followed, of(followed))
        zero = [span(t["time"], of(t), np.zeros(len(t)), 0.0) for t in source.tracks.values()]
        limits = axis_limits([(0.0, 0.0), *(s for s in zero if s[1] >= s[0])])
        labels = (source.clock.label, f"sd [{unit}]")
        note = f"Marks: what made the {followed.name} sd fall." if marks else ""
        items.append(Panel(title, *labels, [*lines, *marks], note=note, wide=False, limits=limits))
    return items


def sd_notes(source: DiveSource) -> list[str]:
    """How to read the sds of two estimates, a sentence each."""
    if not {"filtered", "smoothed"} <= set(source.tracks):
        return []
    notes = ["The filtered sd uses the measurements so far, the smoothed one those of the whole dive."]
    sds = ([of(source.tracks[kind]) for kind in ("filtered", "smoothed")] for _, _, of in SHOWN)
    if any(np.mean(smoothed > SURER * filtered) > OFTEN for filtered, smoothed in sds):
        notes.append(
            "Where the filtered sd is the smaller one, believe the smoothed: over a long time the filter takes "
            "noise for knowledge of what nothing shows, such as a heading without position fixes."
        )
    return notes


def _sd_lines(source: DiveSource, of: Callable[[PageTrack], Array]) -> list[Trace]:
    drawn = []
    for kind, track in source.tracks.items():
        sd = of(track)
        if np.isfinite(sd).any():
            some = extremes(sd)
            dash = "solid" if kind == "smoothed" else "dash"
            drawn.append(line(track.name, source.clock(track["time"][some]), sd[some], ESTIMATES[kind], dash=dash))
    return drawn


def _marks(source: DiveSource, track: PageTrack, sd: Array) -> list[Trace]:
    """A mark at each time at which the sd fell, named by what happened then."""
    found: dict[str, list[int]] = {}
    for i in falls(track["time"], sd):
        found.setdefault(_cause(source, track, i), []).append(i)
    return [
        points(
            f"{cause} ({len(at)})",
            source.clock(track["time"][at]),
            sd[at],
            CAUSES[cause],
            size=8,
            symbol="triangle-down",
            hoverinfo="name",
            quiet=True,
        )
        for cause, at in found.items()
    ]


def falls(time: Array, sd: Array) -> list[int]:
    """Epochs at which an sd that falls to `HELPED` of itself within `WITHIN_S` falls most; one for each fall.

    Parameters
    ----------
    time : ndarray, shape (n,), increasing [s]
    sd : ndarray, shape (n,)
    """
    later = np.minimum(np.searchsorted(time, time + WITHIN_S), len(time) - 1)
    falling = np.flatnonzero((sd[later] < HELPED * sd) & (sd > 0))
    if not len(falling):
        return []
    begins = falling[np.append(True, np.diff(time[falling]) > WITHIN_S)]
    steepest = [i + int(np.argmin(np.diff(sd[i : later[i] + 1]) / sd[i : later[i]])) for i in begins.tolist()]
    return list(dict.fromkeys(steepest))


def _cause(source: DiveSource, track: PageTrack, i: int) -> str:
    begin, end = track["time"][i] - 1.0, track["time"][i] + WITHIN_S
    rows: pd.DataFrame | None = source.residuals
    if rows is not None:
        inside = rows.loc[(rows["time"] >= begin) & (rows["time"] <= end) & (rows["weight"] > 0), "sensor"]
        for sensor in ("fix", "place"):
            if (inside == sensor).any():
                return sensor
    if any(begin <= back <= end for _, back in source.silences):
        return "bottom lock again"
    around = (track["time"] >= end - 3 * WITHIN_S) & (track["time"] <= end)
    yaw = track["yaw"][around]
    if np.isfinite(yaw).all() and len(yaw) and np.ptp(np.unwrap(yaw)) > TURN:
        return "turn"
    return "other"


def separation_section(source: DiveSource) -> Section:
    """Filtered less smoothed over the sd that this difference should have.

    The smoother contains what the filter knew, so that the variance of their difference is P_f - P_s.
    """
    lead = [
        *sd_notes(source),
        "Filtered minus smoothed, over its expected standard deviation. Nearly all of it should stay within ±3; "
        "an excursion shows when the filter was surer than it should have been.",
    ]
    title = "Separation of filtered and smoothed"
    if not {"filtered", "smoothed"} <= set(source.tracks):
        return _not_compared(lead, "it takes both estimates; run rovgraph smooth with --estimate both")
    filtered, smoothed = source.tracks["filtered"], source.tracks["smoothed"]
    colours = {"north": "#0072B2", "east": "#D55E00", "down": "#009E73", "yaw": "#7B3294"}
    drawn, unknown, beyond, known = [], 0.0, 0, 0
    for name, colour in colours.items():
        time, values = separation(filtered, smoothed, name)
        unknown = max(unknown, float(np.isnan(values).mean()))
        if np.isfinite(values).any():
            beyond, known = beyond + int((np.abs(values) > 3.0).sum()), known + int(np.isfinite(values).sum())
            some = extremes(values)
            drawn.append(line("heading" if name == "yaw" else name, source.clock(time[some]), values[some], colour))
    if not drawn:
        return _not_compared(lead, "the standard deviations of the estimates are not known, or the same")
    note = (
        f"Left out, up to {100 * unknown:.0f} % of a line: where smoothing made the sd no smaller."
        if unknown > 0.01
        else ""
    )
    chart = Panel(title, source.clock.label, "difference / its sd", drawn, levels=(-3.0, 0.0, 3.0), note=note)
    well = beyond <= MOST_BEYOND * known
    agree = "The filter agrees with the smoother" if well else "The filter was surer than it should have been"
    finding = f"{agree}: {100.0 * (1.0 - beyond / known):.1f} % of their separation within 3 sd."
    return Section("separation", "Filter against smoother", lead, [chart], finding=finding, well=well)


def _not_compared(lead: list[str], missing: str) -> Section:
    items = [Missing("Separation of filtered and smoothed", missing)]
    return Section("separation", "Filter against smoother", lead, items, finding=f"Not compared: {missing}.")


def separation(filtered: PageTrack, smoothed: PageTrack, name: str) -> tuple[Array, Array]:
    """Times [s] and (filtered - smoothed) / sqrt(P_f - P_s) of a component; NaN where the sd are the same."""
    time, of_filtered, of_smoothed = np.intersect1d(filtered["time"], smoothed["time"], return_indices=True)
    difference = filtered[name][of_filtered] - smoothed[name][of_smoothed]
    if name == "yaw":
        difference = (difference + np.pi) % (2 * np.pi) - np.pi
    before, after = filtered[f"{name}_sd"][of_filtered] ** 2, smoothed[f"{name}_sd"][of_smoothed] ** 2
    variance = np.where(before - after > SAME * before, before - after, np.nan)
    return time, difference / np.sqrt(variance)
