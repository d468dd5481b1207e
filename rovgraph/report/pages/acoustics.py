"""Acoustic positioning: replies, the ship and the beacons, for the map, and a section on how well replies fit."""

import html
from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.model.calibration import ACOUSTICS
from rovgraph.report.colours import REJECTED, SERIES, USED
from rovgraph.report.folder import ACOUSTICS_FILE, beacon_names_of
from rovgraph.report.pages.page import Item, PageTable, Panel, Section, Trace, line, packed, points, spread
from rovgraph.report.pages.source import DiveSource
from rovgraph.report.units import plus_minus, words

SHIP, BEACON, CONFIGURED = "#555555", "#8C6D00", "#AAAAAA"
MOST = 1500  # points of a cloud
POSES, APART = 12, 2.5  # of the ship, that are drawn with their heading: most, and how far apart in their lengths
LENGTH = 0.03  # of the ship as drawn, to each side, of the map
HULL = np.array([[1.0, 0.0], [0.4, 0.35], [-0.8, 0.35], [-0.8, -0.35], [0.4, -0.35], [1.0, 0.0]])  # forward, starboard
SECTORS = 12  # of the rose
FEW = 3  # replies of a sector that say nothing
TURN = np.linspace(0.0, 2.0 * np.pi, 73)


class AcousticReplies:
    """The replies of a dive beside its main track.

    Parameters
    ----------
    source : a folder that has acoustics.csv

    Attributes
    ----------
    table : rows of acoustics.csv that were compared with the estimate, and of each reply its `weight` and the
        residuals of its components: `range_residual` [m], `across`, `up` [rad], NaN where it has none
    """

    def __init__(self, source: DiveSource, replies: pd.DataFrame, residuals: pd.DataFrame) -> None:
        self.source = source
        own = residuals[residuals["sensor"].isin(ACOUSTICS)]
        found = own.pivot_table(index=["sensor", "row", "time"], columns="component", values="innovation")
        found = found.rename(columns={"range": "range_residual"}).reindex(columns=["range_residual", "across", "up"])
        found["weight"] = own.groupby(["sensor", "row", "time"])["weight"].min()
        self.table = replies.merge(found.reset_index(), on=["sensor", "row", "time"]).fillna({"beacon": ""})

    def __getitem__(self, name: str) -> Array:
        """A column of numbers."""
        return self.table[name].to_numpy(float)

    @property
    def used(self) -> NDArray[np.bool_]:
        return self["weight"] > 0.0

    @property
    def aimed(self) -> NDArray[np.bool_]:
        """Of a head on the ship, with a direction."""
        return np.isfinite(self["bearing"])

    @cached_property
    def other_end(self) -> Array:
        """North and east of the ship or beacon, shape (n, 2)."""
        places = {beacon.name: beacon.place for beacon in beacons(self.source)}
        of_beacon = np.array([places.get(str(name), (np.nan, np.nan)) for name in self.table["beacon"]])
        ship = np.column_stack([self["ship_north"], self["ship_east"]])
        return np.where(np.isnan(ship), of_beacon.reshape(-1, 2), ship)

    @cached_property
    def estimated(self) -> Array:
        """North and east of the vehicle when it replied, shape (n, 2)."""
        track = self.source.main
        return np.column_stack([np.interp(self["time"], track["time"], track[c]) for c in ("north", "east")])

    @cached_property
    def measured(self) -> Array:
        """Where a head on the ship puts the vehicle, with its mounting as configured, shape (n, 2)."""
        level = self["range"] * np.cos(self["elevation"])
        towards = np.column_stack([np.cos(self["bearing"]), np.sin(self["bearing"])])
        return np.asarray(self.other_end + level[:, None] * towards)

    @property
    def left_over(self) -> Array:
        """What the residuals of a head on the ship are at the vehicle, north and east, shape (n, 2) [m]."""
        s, c, up = np.sin(self["bearing"]), np.cos(self["bearing"]), self["up"] * np.sin(self["elevation"])
        along = self["range_residual"] * np.cos(self["elevation"]) - self["range"] * up
        across = self["range"] * self["across"]
        return np.column_stack([along * c - across * s, along * s + across * c])

    @cached_property
    def heading(self) -> Array:
        """Of the ship; 0 where it is not known or the other end is a beacon: directions count from north [rad]."""
        return np.nan_to_num(self["ship_heading"])

    @property
    def direction(self) -> Array:
        """Of the vehicle from the ship's bow, or from north, by the estimate, in [0, 360) [deg]."""
        north, east = (self.estimated - self.other_end).T
        return np.asarray(np.rad2deg(np.arctan2(east, north) - self.heading) % 360.0)

    def in_axes(self, vector: Array) -> Array:
        """North and east in the ship's axes, forward and starboard, shape (n, 2)."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        return np.column_stack([c * vector[:, 0] + s * vector[:, 1], c * vector[:, 1] - s * vector[:, 0]])


class PageBeacon:
    """A beacon as the dive has it.

    Attributes
    ----------
    name : of the configuration
    place, sd : north and east, and their sds [m]; NaN where they are not known
    correlation : of north and east
    down : depth and its sd [m]
    verdict : what the dive shows of its place
    """

    def __init__(self, k: int, name: str, table: pd.DataFrame, covariance: pd.DataFrame) -> None:
        self.name = name
        labels = [f"beacon_{k + 1}{tail}" for tail in ("_north", "_east", "_down")]
        rows = table.set_index("label").reindex(labels)
        value, sd = rows["value"].to_numpy(float), rows["sd"].to_numpy(float)
        self.place, self.sd, self.down = (value[0], value[1]), (sd[0], sd[1]), (value[2], sd[2])
        verdict = rows["verdict"].iloc[0] if "verdict" in rows else None
        self.verdict = verdict if isinstance(verdict, str) else ""
        P = covariance.reindex(index=labels[:2], columns=labels[:2]).to_numpy(float)
        rho = P[0, 1] / np.sqrt(P[0, 0] * P[1, 1]) if np.isfinite(P).all() and (np.diag(P) > 0).all() else 0.0
        self.correlation = float(rho)

    @property
    def ellipse(self) -> Array:
        """North and east of an ellipse of one sd, shape (k, 2)."""
        a, b = self.sd
        P = np.array([[a * a, self.correlation * a * b], [self.correlation * a * b, b * b]])
        value, axes = np.linalg.eigh(np.nan_to_num(P))
        circle = np.stack([np.cos(TURN), np.sin(TURN)])
        return np.asarray(self.place + (axes @ (np.sqrt(np.maximum(value, 0.0))[:, None] * circle)).T)


def beacons(source: DiveSource) -> list[PageBeacon]:
    """Those that the configuration names and the dive used, with their places after it."""
    table = source.calibration
    if table is None:
        return []
    joint = ((source.summary.get("estimates") or {}).get(source.main.kind) or {}).get("calibration_covariance")
    covariance = pd.DataFrame()
    if isinstance(joint, dict):
        covariance = pd.DataFrame(joint["covariance"], joint["labels"], joint["labels"], dtype=float)
    names = beacon_names_of(source.text("config.yaml") or "")
    found = [PageBeacon(k, name, table, covariance) for k, name in enumerate(names)]
    return [beacon for beacon in found if np.isfinite(beacon.place).all()]


def acoustic_replies(source: DiveSource) -> AcousticReplies | None:
    """Of a dive with an acoustic system; None of others."""
    columns = "time", "sensor", "beacon", "ship_north", "ship_east", "ship_heading", "range", "bearing", "elevation"
    replies = source.frame(ACOUSTICS_FILE, *columns, "row")
    if replies is None or source.residuals is None:
        return None
    replies["beacon"] = replies["beacon"].map(_name)
    found = AcousticReplies(source, replies, source.residuals)
    return found if len(found.table) else None


def _name(beacon: object) -> str:
    """Of a beacon, as the configuration has it: pandas reads 7 in a column with gaps as 7.0."""
    if isinstance(beacon, float):
        return "" if np.isnan(beacon) else f"{beacon:g}"
    return str(beacon)


def acoustic_traces(source: DiveSource) -> list[Trace]:
    """Replies, the ship with its heading, and beacons, for the map."""
    replies = acoustic_replies(source)
    if replies is None:
        return []
    drawn = [] if not replies.aimed.any() else _used_and_rejected(replies, replies.measured, replies.aimed, "reply")
    return [*drawn, *_ship(replies), *_beacons(source)]


def _used_and_rejected(replies: AcousticReplies, place: Array, shown: NDArray[np.bool_], name: str = "") -> list[Trace]:
    """Clouds of places, the first column upwards."""
    drawn = []
    for label, mask, colour, symbol in (
        ("used", replies.used, USED, "cross-thin-open"),
        ("rejected", ~replies.used, REJECTED, "x-thin-open"),
    ):
        some = np.flatnonzero(mask & shown)
        if len(some):
            few = some[spread(len(some), MOST)]
            when = packed(replies.source.clock(replies["time"][few]))
            title = f"{name}, {label} ({len(some)})" if name else f"{label} ({len(some)})"
            drawn.append(points(title, place[few, 1], place[few, 0], colour, size=6, symbol=symbol, t=when))
    return drawn


def _ship(replies: AcousticReplies) -> list[Trace]:
    """Its way, and some of its poses."""
    known = np.flatnonzero(np.isfinite(replies["ship_north"]))
    if not len(known):
        return []
    north, east, heading = (replies[c] for c in ("ship_north", "ship_east", "ship_heading"))
    way = known[spread(len(known), MOST)]
    look = {"t": packed(replies.source.clock(replies["time"][way])), "hovertext": "ship"}
    drawn = [line("ship", east[way], north[way], SHIP, width=1.5, **look)]
    track = replies.source.main
    extent = max(float(np.ptp(v[np.isfinite(v)])) for v in (track["north"], track["east"], north, east) if len(v))
    length = LENGTH * max(extent, 1.0)
    outline, poses = HULL * length, known[np.isfinite(heading[known])]
    moved = max(float(np.ptp(values[known])) for values in (north, east))
    poses = poses[spread(len(poses), int(np.clip(moved / (APART * length), 2, POSES)))]
    if len(poses):
        c, s = np.cos(heading[poses])[:, None], np.sin(heading[poses])[:, None]
        gap = np.full((len(poses), 1), np.nan)
        hull_north = np.hstack([north[poses, None] + c * outline[:, 0] - s * outline[:, 1], gap]).ravel()
        hull_east = np.hstack([east[poses, None] + s * outline[:, 0] + c * outline[:, 1], gap]).ravel()
        shape = {"width": 1.5, "showlegend": False, "hoverinfo": "skip"}
        drawn.append(line("ship's heading", hull_east, hull_north, SHIP, **shape))
    return drawn


def _beacons(source: DiveSource) -> list[Trace]:
    """With names, and ellipses of one sd."""
    found = beacons(source)
    if not found:
        return []
    gap = np.full((1, 2), np.nan)
    rings = np.concatenate([np.vstack([beacon.ellipse, gap]) for beacon in found])
    place = np.array([beacon.place for beacon in found])
    names = [html.escape(beacon.name) for beacon in found]  # Plotly reads tags in a text
    look = {"mode": "markers+text", "text": names, "textposition": "top right", "symbol": "diamond", "size": 9}
    return [
        line("beacon, one sd", rings[:, 1], rings[:, 0], BEACON, width=1.5, hoverinfo="skip"),
        points("beacon", place[:, 1], place[:, 0], BEACON, **look),
    ]


def acoustics_sections(source: DiveSource) -> list[Section]:
    """One of a dive with an acoustic system, none of others."""
    replies = acoustic_replies(source)
    if replies is None:
        return []
    items: list[Item] = []
    if replies.aimed.any():
        items += [_seen_from_ship(replies), _beside_estimate(replies)]
    items += [*_residuals(replies), *([_rose(replies)] if replies.aimed.any() else []), *_beacon_table(replies)]
    finding, well = _in_a_sentence(replies)
    lead = ["Residuals are measured minus predicted by the estimate, its calibration included.", *_calibration(source)]
    return [Section("acoustics", "Acoustics", lead, items, finding=finding, well=well)]


def _in_a_sentence(replies: AcousticReplies) -> tuple[str, bool]:
    """How many replies count, how far they are off, and whether an alarm names them."""
    parts, kinds = [], replies.table["sensor"]
    for sensor in kinds.unique():
        own = (kinds == sensor).to_numpy()
        used = own & replies.used
        off = [f"{_rms(replies['range_residual'][used]):.2g} m in range"]
        if np.isfinite(replies["across"][used]).any():
            across, up = (np.rad2deg(_rms(replies[c][used])) for c in ("across", "up"))
            off = [*off, f"{across:.2g}° across", f"{up:.2g}° in elevation"]
        name = {"usbl": "directions and ranges", "range": "ranges"}[str(sensor)]
        parts.append(f"{used.sum()} of {own.sum()} {name} were used; rms residuals {', '.join(off)}")
    named = [a for a in replies.source.summary.get("alarms") or [] if a.get("sensor") in (*ACOUSTICS, "ship")]
    return ". ".join(parts) + (". An alarm names them." if named else "."), not named


def _rms(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


def _calibration(source: DiveSource) -> list[str]:
    """What the dive showed of the head and of the sound, a sentence."""
    table = source.calibration
    if table is None or not {"label", "verdict"} <= set(table):
        return []
    own = table[table["label"].str.match(r"usbl_|range_|sound_") & (table["estimated"].astype(str) == "True")]
    found = [
        f"{words(str(c['label']))} {plus_minus(c['value'], c['sd'], '' if c['unit'] in ('1', 1) else str(c['unit']))}"
        f" ({c['verdict']})"
        for c in own.to_dict("records")
    ]
    return ["The dive's calibration: " + ", ".join(found).replace(" deg", "°") + "."] if found else []


def _seen_from_ship(replies: AcousticReplies) -> Panel:
    """The vehicle in the ship's axes, as it was measured."""
    seen = replies.in_axes(replies.measured - replies.other_end)
    drawn = _used_and_rejected(replies, seen, replies.aimed)
    drawn.append(points("ship", [0.0], [0.0], SHIP, size=10, symbol="triangle-up", hoverinfo="name"))
    note = "Only directions that are spread round the ship show the head's yaw."
    x, y = ("starboard [m]", "ahead [m]") if np.isfinite(replies["ship_heading"]).any() else ("east [m]", "north [m]")
    return Panel("The vehicle as seen from the ship", x, y, drawn, kind="plan", note=note, wide=False)


def _beside_estimate(replies: AcousticReplies) -> Panel:
    """Where replies put the vehicle, beside where it was: what a misalignment draws."""
    drawn = []
    for name, off, colour in (
        ("mounting as configured", replies.measured - replies.estimated, CONFIGURED),
        ("as calibrated by the dive", replies.left_over, USED),
    ):
        few = np.flatnonzero(replies.aimed & replies.used & np.isfinite(off[:, 0]))
        few = few[spread(len(few), MOST)]
        when = packed(replies.source.clock(replies["time"][few]))
        drawn.append(points(name, off[few, 1], off[few, 0], colour, size=4, t=when))
    drawn.append(points("the estimate", [0.0], [0.0], "#000000", size=9, symbol="cross-thin-open", hoverinfo="name"))
    note = "Of replies that were used. A misaligned head draws a ring (doughnut) where ship or vehicle turn about each "
    note += "other; a cloud off the middle is an error of the ship's position or of an arm."
    title = "Where replies put the vehicle, less the estimate"
    return Panel(title, "east [m]", "north [m]", drawn, kind="plan", note=note, wide=False)


def _rose(replies: AcousticReplies) -> Panel:
    """Rms residual across the line of sight by sectors of direction, a wedge each."""
    used = replies.used & replies.aimed
    edges = np.linspace(0.0, 360.0, SECTORS + 1)
    sector = np.clip(np.searchsorted(edges, replies.direction, side="right") - 1, 0, SECTORS - 1)
    drawn: list[Trace] = []
    for name, column, colour, share in (("across", "across", SERIES[0], 0.0), ("in elevation", "up", SERIES[1], 0.5)):
        east, north = [], []
        for k in range(SECTORS):
            own = used & (sector == k)
            if own.sum() < FEW:
                continue
            begin = edges[k] + share * 360.0 / SECTORS
            angle = np.deg2rad(np.linspace(begin + 1.0, begin + 180.0 / SECTORS - 1.0, 9))
            radius = np.rad2deg(_rms(replies[column][own]))
            east += [0.0, *(radius * np.sin(angle)), 0.0, np.nan]
            north += [0.0, *(radius * np.cos(angle)), 0.0, np.nan]
        shape = {"width": 1, "fill": "toself", "fillcolor": colour + "66", "hoverinfo": "skip"}
        drawn.append(line(name, east, north, colour, **shape))
    headed = np.isfinite(replies["ship_heading"]).any()
    note = f"Rms residual by direction from {'the ship, its bow on top' if headed else 'the head, north on top'}, "
    note += f"in sectors of {360 // SECTORS}° with {FEW} replies or more."
    x, y = ("to starboard [°]", "ahead [°]") if headed else ("to the east [°]", "to the north [°]")
    return Panel("Rose of residuals", x, y, drawn, kind="plan", note=note, wide=False)


def _residuals(replies: AcousticReplies) -> Iterator[Panel]:
    """Of each component against range and against direction."""
    aimed = np.isfinite(replies["across"])
    headed = np.isfinite(replies["ship_heading"]).any()
    far = "range [m]"
    about = "direction from the ship's bow [°]" if headed else "direction from the other end [°]"
    components = [("Range", "range_residual", 1.0, "m")]
    if aimed.any():
        degrees = float(np.rad2deg(1.0))
        components += [("Across", "across", degrees, "°"), ("Elevation", "up", degrees, "°")]
    for name, column, factor, unit in components:
        for what, x, label in (("range", replies["range"], far), ("direction", replies.direction, about)):
            residual = factor * replies[column]
            drawn = _clouds(replies, x, residual)
            reach = 1.2 * float(np.nanmax(np.abs(residual[replies.used]), initial=1e-3))
            beyond = int((np.abs(residual) > reach).sum())
            note = f"{beyond} lie beyond what is shown: a double click shows all." if beyond else ""
            labels, limits = (label, f"residual [{unit}]"), (-reach, reach)
            title = f"{name}: residual against {what}"
            yield Panel(title, *labels, drawn, kind="xy", note=note, levels=(0.0,), limits=limits, wide=False)


def _clouds(replies: AcousticReplies, x: Array, y: Array) -> list[Trace]:
    """Replies that were used, of each other end, and those that were rejected."""
    names = replies.table["beacon"].to_numpy(object)
    ends = sorted(set(names.tolist()))
    alone = len(ends) == 1
    parts = [
        (f"beacon {end}" if end else "ship", replies.used & (names == end), SERIES[k % len(SERIES)])
        for k, end in enumerate(ends)
    ]
    parts = [("used" if alone else name, mask, colour) for name, mask, colour in parts]
    drawn = []
    for name, mask, colour in [*parts, ("rejected", ~replies.used, REJECTED)]:
        some = np.flatnonzero(mask & np.isfinite(x) & np.isfinite(y))
        if len(some):
            few = some[spread(len(some), MOST)]
            when = packed(replies.source.clock(replies["time"][few]))
            drawn.append(points(f"{name} ({len(some)})", x[few], y[few], colour, size=3, t=when))
    return drawn


def _beacon_table(replies: AcousticReplies) -> Sequence[Item]:
    """Where beacons are, and how they were heard."""
    rows = []
    for beacon in beacons(replies.source):
        own = (replies.table["beacon"] == beacon.name).to_numpy()
        used = own & replies.used
        known = [*zip(beacon.place, beacon.sd, strict=True), beacon.down]
        places = [plus_minus(value, sd) for value, sd in known]
        reach = replies["range"][own]
        ranges = f"{reach.min():.0f} to {reach.max():.0f}" if own.any() else "–"
        rms = f"{_rms(replies['range_residual'][used]):.2g}" if used.any() else "–"
        rows.append((beacon.name, *places, beacon.verdict, f"{used.sum()} of {own.sum()}", ranges, rms))
    head = ("beacon", "north [m]", "east [m]", "depth [m]", "verdict", "used", "ranges [m]", "rms residual [m]")
    return [PageTable("Beacons", head, rows, note="± one sd.")] if rows else []
