"""Compasses: residual against heading with the fitted deviation curve, and two compasses against each other."""

from itertools import combinations

import numpy as np
import pandas as pd

from rovgraph.calibration import TABLE
from rovgraph.geometry import Array
from rovgraph.pages.parts import Item, Missing, Panel, Section, line, packed, points
from rovgraph.pages.source import DiveSource
from rovgraph.pages.thinning import spread

CURVES = {v.sensors[0]: name for name, v in TABLE.items() if name.endswith("_deviation")}  # sensor -> its curve
MOST = 3000
ALL_ROUND = np.linspace(0.0, 360.0, 181)


def compass_section(source: DiveSource) -> Section:
    """Every compass that was compared with the estimate."""
    rows = source.residuals
    title = "Compasses"
    if rows is None:
        return Section("compasses", title, (), [Missing("Deviation", "the folder has no residuals.csv")])
    headings = rows[(rows["component"] == "heading") & (rows["weight"] > 0)]
    items: list[Item] = [_deviation(source, str(s), own) for s, own in headings.groupby("sensor", sort=False)]
    if not items:
        items = [Missing("Deviation", "no compass that measures a heading was used; a magnetometer is in Residuals")]
    measured = {str(s): own for s, own in headings.groupby("sensor", sort=False)} if "measured" in rows else {}
    items += [_pair(source, a, measured[a], b, measured[b]) for a, b in combinations(measured, 2)]
    return Section("compasses", title, ["A wave with one period per turn is deviation."], items)


def _heading(source: DiveSource, time: Array) -> Array:
    """Heading of the main track at some times, in [0, 360) [deg]."""
    yaw = source.main["yaw"]
    known = np.isfinite(yaw)
    if not known.any():
        return np.full(len(time), np.nan)
    return np.asarray(np.rad2deg(np.interp(time, source.main["time"][known], np.unwrap(yaw[known]))) % 360.0)


def _deviation(source: DiveSource, sensor: str, own: pd.DataFrame) -> Item:
    """Residual against the heading of the compass's own axis, with the fitted curve added back."""
    own = own.iloc[spread(len(own), MOST)]
    time = own["time"].to_numpy(float)
    residual = np.rad2deg(own["innovation"].to_numpy(float))
    look = {"size": 3, "t": packed(source.clock(time))}
    title = f"{sensor}: deviation against heading"
    fit = _fit(source, sensor)
    if fit is None or "predicted" not in own:
        drawn = [points("residual", _heading(source, time), residual, "#0072B2", **look)]
        note = "No deviation curve was estimated."
        return Panel(title, "heading [°]", "residual [°]", drawn, kind="xy", note=note, wide=False)
    offset, sine, cosine = fit
    heading = np.rad2deg(own["predicted"].to_numpy(float)) - offset
    for _ in range(5):  # predicted = heading + offset + deviation(heading)
        heading = np.rad2deg(own["predicted"].to_numpy(float)) - offset - _curve(sine, cosine, heading)
    heading %= 360.0
    drawn = [
        points("compass less offset", heading, residual + _curve(sine, cosine, heading), "#0072B2", **look),
        line("fitted deviation", ALL_ROUND, _curve(sine, cosine, ALL_ROUND), "#D55E00", width=2.5),
        points("residual after the fit", heading, residual, "#8A8A8A", visible="legendonly", **look),
    ]
    note = f"Deviation: {sine:.2f}° sin h + {cosine:.2f}° cos h, h the heading of the compass's own axis."
    return Panel(title, "heading of the compass [°]", "deviation [°]", drawn, kind="xy", note=note, wide=False)


def _curve(sine: float, cosine: float, heading: Array) -> Array:
    """Deviation at a heading [deg]."""
    return np.asarray(sine * np.sin(np.deg2rad(heading)) + cosine * np.cos(np.deg2rad(heading)))


def _fit(source: DiveSource, sensor: str) -> tuple[float, float, float] | None:
    """Offset, and coefficients of sine and cosine of the heading [deg], where a curve was estimated."""
    table, name = source.calibration, CURVES.get(sensor)
    if table is None or name is None:
        return None
    value = table.set_index("label")["value"]
    if not {f"{name}_sin", f"{name}_cos"} <= set(value.index):
        return None
    labels = (name.replace("deviation", "offset"), f"{name}_sin", f"{name}_cos")
    offset, sine, cosine = (float(value.get(label, 0.0)) for label in labels)
    return (offset, sine, cosine) if np.isfinite([offset, sine, cosine]).all() and (sine or cosine) else None


def _pair(source: DiveSource, a: str, first: pd.DataFrame, b: str, second: pd.DataFrame) -> Item:
    """The difference of two compasses as recorded, against heading."""
    title = f"{a} minus {b}, as recorded"
    left = first[["time", "measured"]].sort_values("time")
    right = second[["time", "measured"]].sort_values("time")
    both = pd.merge_asof(left, right, on="time", direction="nearest", tolerance=0.5, suffixes=("_a", "_b"))  # type: ignore[arg-type]
    both = both.dropna()
    if both.empty:
        return Missing(title, "they never measured within half a second of each other")
    both = both.iloc[spread(len(both), MOST)]
    angle = (both["measured_a"] - both["measured_b"]).to_numpy(float)
    middle = np.angle(np.mean(np.exp(1j * angle)))
    difference = np.rad2deg(middle + np.angle(np.exp(1j * (angle - middle))))
    time = both["time"].to_numpy(float)
    look = {"size": 3, "t": packed(source.clock(time))}
    drawn = [points("difference", _heading(source, time), difference, "#0072B2", **look)]
    note = f"Mean {np.rad2deg(middle):.1f}°: mountings and offsets together."
    return Panel(title, "heading [°]", "difference [°]", drawn, kind="xy", note=note, wide=False)
