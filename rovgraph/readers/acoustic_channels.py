"""Channels of what acoustic positioning systems tell, and of the ship that carries them.

What is measured relative to a ship is read as it is, beside her position and attitude, where both are known; else it is
added to her position, and becomes fixes. Positions that a system gives on Earth are fixes as they are.
"""

import cmath
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log.disk_columns import median_step
from rovgraph.log.streams import LAT_LON, STREAMS, label_number
from rovgraph.readers.acoustic_sentences import AcousticPosition, Reply, ShipAttitude, Told
from rovgraph.readers.nmea_sentences import TRUE
from rovgraph.readers.recording import Channel, Clock, preferred_first
from rovgraph.sensors import SENSORS

FAR_S = 30.0  # between the ship's fixes; in a longer gap it is not known where she was
SLOW_S = 1.5  # between headings, from which on faster ones of another source take precedence
NEAR_M = 20e3  # of the ship, that a position on a grid which is not stated has to be
FILTERED = "is filtered by the acoustic system, so its errors last: calibration.fix_error is estimated"
AXES = {
    "ship": "forward, starboard, down of the ship made level",
    "north": "north, east, down by the ship's compass",
    "transducer": "forward, starboard, down of the head",
}
LAST = ("PTSAH", "PSONALL")  # of attitudes
INERTIAL = ("PTSAX", "PTSAY")  # of a GAPS, whose own filter makes PTSAG of them with what it knows of the ship
BRIDGE = "UGPS"  # the transponder that Water Linked's bridge to Olex names
NAMES = ("PSIM", "PTSA", "PSON", "USRTH", "USBL", "MicronNav", "SeaTrac")  # of acoustic sentences
FIX = *LAT_LON, *STREAMS["fix"][2:]  # columns
TWICE = "beside depth of the same sensor it is one measurement taken twice"
NO_GRID = "on a grid that is not stated, and not UTM of the ship's zone within 20 km of her"
AS_UTM = "is on a grid that it does not state; it is taken as UTM on WGS 84 in the ship's zone"


@dataclass(frozen=True)
class Ship:
    """Where a ship was, and which way she pointed.

    Attributes
    ----------
    time : of her fixes, increasing, shape (n,) [s]
    lat, lon : shape (n,) [deg]
    heading_time, heading : relative to true north, shape (m,), m may be 0 [s], [rad]
    """

    time: Array
    lat: Array
    lon: Array
    heading_time: Array
    heading: Array

    def place(self, time: float) -> tuple[float, float]:
        """Latitude and longitude at a time [deg]."""
        return float(np.interp(time, self.time, self.lat)), float(np.interp(time, self.time, self.lon))

    def knows(self, time: Array, head_up: bool) -> NDArray[np.bool_]:
        """At which times its position is known, and its heading where a position is head up, shape (k,)."""
        known = ~_away(time, self.time)
        return known & ~_away(time, self.heading_time) if head_up else known


def positions(ship: Ship, time: Array, x: Array, y: Array, head_up: bool) -> tuple[Array, Array]:
    """Latitude and longitude [deg] of a vehicle, shape (k,); NaN where the ship's position or heading is not known.

    Parameters
    ----------
    time : shape (k,) [s]
    x, y : forward and starboard of the ship, or north and east of it, shape (k,) [m]
    """
    import pymap3d

    origin = float(np.median(ship.lat)), float(ship.lon[len(ship.lon) // 2]), 0.0
    ship_north, ship_east, _ = pymap3d.geodetic2ned(ship.lat, ship.lon, 0.0, *origin)
    north, east = x, y
    if head_up:
        empty = not len(ship.heading_time)
        heading = 0.0 if empty else np.interp(time, ship.heading_time, np.unwrap(ship.heading))
        north, east = x * np.cos(heading) - y * np.sin(heading), x * np.sin(heading) + y * np.cos(heading)
    north, east = north + np.interp(time, ship.time, ship_north), east + np.interp(time, ship.time, ship_east)
    north = np.where(ship.knows(time, head_up), north, np.nan)
    lat, lon, _ = pymap3d.ned2geodetic(north, east, 0.0, *origin)
    return np.asarray(lat), np.asarray(lon)


def _away(time: Array, known: Array) -> NDArray[np.bool_]:
    """Which times have no known one within `FAR_S` on either side."""
    if not len(known):
        return np.ones(len(time), bool)
    after = np.searchsorted(known, time).clip(1, max(len(known) - 1, 1))
    before = known[(after - 1).clip(0, len(known) - 1)]
    after_time = known[after.clip(0, len(known) - 1)]
    return np.asarray(np.maximum(np.abs(time - before), np.abs(time - after_time)) > FAR_S)


def from_utm(east: float, north: float, zone: int, south: bool) -> tuple[float, float]:
    """Latitude and longitude [deg] of coordinates of UTM on WGS 84, by Krueger's series.

    Source: Karney, Transverse Mercator with an accuracy of a few nanometers, J. Geodesy 85 (2011), (35), (36).
    """
    n = 1.0 / (2.0 * 298.257223563 - 1.0)
    radius = 6_378_137.0 / (1.0 + n) * (1.0 + n**2 / 4.0 + n**4 / 64.0)
    xi, eta = (north - 1e7 * south) / (0.9996 * radius), (east - 5e5) / (0.9996 * radius)
    beta = n / 2.0 - 2.0 * n**2 / 3.0 + 37.0 * n**3 / 96.0, n**2 / 48.0 + n**3 / 15.0, 17.0 * n**3 / 480.0
    z = complex(xi, eta)
    z -= sum(b * cmath.sin(2.0 * (k + 1) * z) for k, b in enumerate(beta))
    conformal = math.asin(math.sin(z.real) / math.cosh(z.imag))
    delta = (
        2.0 * n - 2.0 * n**2 / 3.0 - 2.0 * n**3,
        7.0 * n**2 / 3.0 - 8.0 * n**3 / 5.0,
        56.0 * n**3 / 15.0,
    )
    lat = conformal + sum(d * math.sin(2.0 * (k + 1) * conformal) for k, d in enumerate(delta))
    lon = math.atan2(math.sinh(z.imag), math.cos(z.real))
    return math.degrees(lat), math.degrees(lon) + 6.0 * zone - 183.0


def on_ships_grid(grid: Sequence[float], lat: float, lon: float) -> tuple[float, float] | None:
    """Latitude and longitude [deg] of two coordinates in either order, in the zone of UTM that a ship is in.

    None where neither order is within `NEAR_M` of the ship, or both are.
    """
    zone = int((lon + 180.0) // 6.0) % 60 + 1
    found = []
    for east, north in (grid, grid[::-1]):
        if not (1e5 <= east <= 9e5 and 0.0 <= north <= 1e7):
            continue
        there = from_utm(east, north, zone, lat < 0.0)
        away = math.hypot(there[0] - lat, (there[1] - lon) * math.cos(math.radians(lat))) * 111e3
        if away <= NEAR_M:
            found.append(there)
    return found[0] if len(found) == 1 else None


def places_to_state(source: str, places: Sequence[tuple[str, float, float, float]]) -> str:
    """What a configuration states of beacons that a file places: names, latitudes, longitudes [deg], depths [m]."""
    import pymap3d

    origin = round(places[0][1], 7), round(places[0][2], 7)
    beacons = []
    for name, lat, lon, depth in places:
        north, east, _ = pymap3d.geodetic2ned(lat, lon, 0.0, *origin, 0.0)
        beacons.append(f"{{name: {name}, north_m: {north:.2f}, east_m: {east:.2f}, down_m: {depth:.2f}}}")
    return (
        f"{source}: has the places of its beacons; state environment: {{origin_lat_deg: {origin[0]}, origin_lon_deg: "
        f"{origin[1]}}} and beacons: [{', '.join(beacons)}]"
    )


@dataclass
class Heard:
    """What acoustic systems told, by its time.

    Attributes
    ----------
    replies : (kind, frame) -> time, Reply
    positions : name -> time, AcousticPosition
    attitudes : kind -> time, ShipAttitude
    """

    replies: dict[tuple[str, str], list[tuple[float, Reply]]] = field(default_factory=dict)
    positions: dict[str, list[tuple[float, AcousticPosition]]] = field(default_factory=dict)
    attitudes: dict[str, list[tuple[float, ShipAttitude]]] = field(default_factory=dict)

    def add(self, time: float, told: Told) -> None:
        if isinstance(told, Reply):
            self.replies.setdefault((told.kind, told.frame), []).append((time, told))
        elif isinstance(told, AcousticPosition):
            self.positions.setdefault(told.name, []).append((time, told))
        else:
            self.attitudes.setdefault(told.kind, []).append((time, told))

    @property
    def names(self) -> list[str]:
        """Of transponders that are seen from a head, the most frequent first."""
        return [name for name, _ in Counter(r.name for of in self.replies.values() for _, r in of).most_common()]


class RepliesAlongAxes(NamedTuple):
    """Replies along the same axes.

    Attributes
    ----------
    kind, frame : of sentence, of axes
    used : time, Reply; those that are measured while the ship is known
    left : how many others there are
    """

    kind: str
    frame: str
    used: list[tuple[float, Reply]]
    left: int


class ShipsFile:
    """A file with acoustic sentences, in which other fixes and headings are the ship's.

    Parameters
    ----------
    path : of the file, for messages
    clock : of all times
    choose : sensor -> source, as a person wants it
    left : (name, reason) -> count, to be added to
    others : channels of the other sentences: "fix", "ahrs", "vehicle_tilt"
    heard : what the acoustic systems told
    """

    def __init__(
        self,
        path: Path,
        clock: Clock,
        choose: Mapping[str, str],
        left: Counter[tuple[str, str]],
        others: Sequence[Channel],
        heard: Heard,
    ) -> None:
        self.path, self.clock, self.choose, self.left, self.heard = path, clock, choose, left, heard
        self.said: list[str] = []
        self.compasses = [channel for channel in others if channel.sensor == "ahrs"]
        own = [self._channel("fix", name, _fixes(rows)) for name, rows in heard.positions.items() if rows[0][1].of_ship]
        self.fixes = {c.source: c for c in (*(c for c in others if c.sensor == "fix"), *own)}
        receivers = [name for name in self.fixes if name != choose.get("fix")] or list(self.fixes)
        self.receivers = preferred_first(path, "ship", receivers, choose)
        attitudes = self._attitudes(others)
        self.headings = self._of_attitude("ship_heading", {"ship_heading": "yaw"}, attitudes)
        self.tilts = self._of_attitude("ship_tilt", {"ship_roll": "roll", "ship_pitch": "pitch"}, attitudes)
        self.ship = self._ship()

    def channels(self) -> tuple[list[Channel], dict[str, Any], list[str]]:
        """Channels, settings for them, and what may be wrong.

        Raises
        ------
        InputError : nothing of it can be placed
        """
        kept = self.compasses if "ahrs" in self.choose else []
        if not (self.heard.replies or self.heard.positions or "fix" in self.choose):
            return [*kept, *self._ship_alone()], {}, self.said
        direct = self._direct()
        if raw := self._raw(direct):
            channels, settings = self._as_measured(raw, direct)
        else:
            channels, settings = self._as_fixes(direct)
            if not kept:
                why = "of the ship, as acoustic positions are relative to her; choose ahrs=NAME if it is the vehicle's"
                for channel in self.compasses:
                    self.left[channel.source, why] += len(channel.columns["time"])
        return [*kept, *channels], settings, self.said

    def _channel(self, sensor: str, source: str, columns: Mapping[str, Array], frame: str = "") -> Channel:
        return Channel(sensor, columns, source, frame, self.clock.name)

    # the ship

    def _ship(self) -> Ship | None:
        if not self.receivers:
            return None
        where = self.fixes[self.receivers[0]].columns
        heading_time = heading = np.empty(0)
        if self.headings:
            heading_time, heading = (self.headings[0].columns[name] for name in ("time", "ship_heading"))
        return Ship(where["time"], where["fix_lat"], where["fix_lon"], heading_time, heading)

    def _attitudes(self, others: Sequence[Channel]) -> dict[str, dict[str, Array]]:
        """Yaw, roll and pitch of the ship by source, the best first: those of the pings themselves are."""
        names = "yaw", "roll", "pitch"
        told = {
            kind: _in_time(((t, (a.heading, a.roll, a.pitch)) for t, a in rows), names)
            for kind, rows in self.heard.attitudes.items()
        }
        last = {kind: told.pop(kind) for kind in [*told] if kind in LAST}
        for channel in others:
            if channel.sensor == "ahrs" and channel.source.endswith(TRUE):
                told[channel.source] = {name.removeprefix("ahrs_"): v for name, v in channel.columns.items()}
            elif channel.sensor == "vehicle_tilt":
                last[channel.source] = {"yaw": np.full(len(channel.columns["time"]), np.nan), **channel.columns}
        return told | last

    def _of_attitude(
        self, sensor: str, columns: Mapping[str, str], attitudes: Mapping[str, Mapping[str, Array]]
    ) -> list[Channel]:
        """Channels of some angles, the preferred one first."""
        made = {}
        for name, values in attitudes.items():
            known = np.all([np.isfinite(values[of]) for of in columns.values()], axis=0)
            if known.any():
                cells = {"time": values["time"][known], **{c: values[of][known] for c, of in columns.items()}}
                made[name] = self._channel(sensor, name, cells, "the ship's, from true north")
        order = sorted(made, key=lambda name: _is_slow(made[name].columns["time"]))
        return [made[name] for name in preferred_first(self.path, sensor, order, self.choose)]

    def _ship_alone(self) -> list[Channel]:
        """Channels of the ship, where no transponder was heard."""
        if self.fixes or self.headings:
            receiver = next(iter(self.receivers), "NAME")
            self.said.append(
                f"no transponder was heard ({self._why_not()}): positions and headings are taken as the ship's; "
                f"--choose fix={receiver} if they are the vehicle's"
            )
        return [*self._receivers(), *self.headings, *self.tilts]

    def _receivers(self) -> list[Channel]:
        return [
            self._channel("ship", name, {k.replace("fix", "ship"): v for k, v in self.fixes[name].columns.items()})
            for name in self.receivers
        ]

    def _why_not(self) -> str:
        """Why acoustic sentences, or lines that were none, are left out."""
        return "; ".join(
            f"{n}: {count} {why}" for (n, why), count in self.left.items() if n.startswith((*NAMES, "lines"))
        )

    # positions on Earth

    def _direct(self) -> dict[str, Channel]:
        """Fixes of the positions on Earth that systems give, by name."""
        made, grids = {}, set()
        for name, rows in self.heard.positions.items():
            known = []
            for t, position in rows:
                if position.grid and not position.of_ship:
                    there = None if self.ship is None else on_ships_grid(position.grid, *self.ship.place(t))
                    if there is None:
                        self.left[name, NO_GRID] += 1
                        continue
                    grids.add(position.kind)
                    position = replace(position, lat=there[0], lon=there[1])
                if not position.of_ship:
                    known.append((t, position))
            if known:
                made[name] = self._channel("fix", name, _fixes(known))
        self.said += [f"{kind}: {AS_UTM}" for kind in sorted(grids)]
        return made

    # relative to the ship, as measured

    def _raw(self, direct: Mapping[str, Channel]) -> list[RepliesAlongAxes]:
        """Groups of replies to be read as they were measured, the preferred one first; [] = they are to be fixes."""
        wanted = self.choose.get("usbl")
        if wanted is None and (self.ship is None or "fix" in self.choose):
            return []
        first = preferred_first(self.path, "usbl", self.heard.names, self.choose)[:1]
        groups = []
        for (kind, frame), rows in self.heard.replies.items():
            measured = [row for row in rows if not row[1].filtered or wanted is not None]
            used = measured
            if self.ship is not None:  # else it is in another file
                known = self.ship.knows(np.array([t for t, _ in measured]), frame != "north")
                used = [row for row, k in zip(measured, known.tolist(), strict=True) if k]
            if used and (wanted is not None or 2 * len(measured) >= len(rows)):
                groups.append(RepliesAlongAxes(kind, frame, used, len(rows) - len(used)))

        def rank(group: RepliesAlongAxes) -> tuple[bool, bool, bool, int]:
            unwanted = wanted is not None and first[0] not in {reply.name for _, reply in group.used}
            return unwanted, group.kind in INERTIAL, group.frame == "north", -len(group.used)

        groups.sort(key=rank)
        return [] if direct and wanted is None and groups and groups[0].kind in INERTIAL else groups

    def _as_measured(
        self, groups: Sequence[RepliesAlongAxes], direct: Mapping[str, Channel]
    ) -> tuple[list[Channel], dict[str, Any]]:
        """Channels of replies, of the ship's positions and attitudes."""
        for group in groups:
            self.left[group.kind, "filtered, or while the ship's position or heading is not known"] += group.left
        for name, channel in direct.items():
            self.left[name, "beside replies as they were measured; choose fix=NAME"] += len(channel.columns["time"])
        names = preferred_first(self.path, "usbl", self.heard.names, self.choose)
        raw = [self._usbl(group, names) for group in groups]
        used = [reply for _, reply in groups[0].used]
        settings: dict[str, Any] = {"frame": groups[0].frame}
        if used[0].when.seconds is None and used[0].when.sent is None:
            settings["stamp"] = "arrival"
        if len({reply.beacon for reply in used}) > 1:
            settings["beacon"] = min(used, key=lambda reply: names.index(reply.name)).beacon
        self.said.append(
            f"{raw[0].source} is read as it was measured, relative to the ship: see that it counts from the antenna of "
            f"{self.receivers[0] if self.receivers else 'its receiver'}, or state ship.antenna_m and usbl.lever_arm_m; "
            f'--choose fix="{used[0].name}" reads fixes in its place'
        )
        if any(name.endswith(f" {BRIDGE}") for name in self.heard.names):
            self.said.append(
                f"{BRIDGE} is a bridge that writes x of a Water Linked antenna where starboard belongs: where x is "
                "forward, as of a G2, forward and starboard are exchanged; record the positions of its API instead"
            )
        if any(reply.sensed for reply in used):
            self.said.append(f"{used[0].name} has the depth of the transponder's own sensor: {TWICE}")
        if any(reply.filtered for reply in used):
            self.said.append(
                f"{used[0].name} is filtered by the acoustic system, so its errors last: it follows turns late"
            )
        return [*raw, *self._receivers(), *self.headings, *self.tilts], {"usbl": settings}

    def _usbl(self, group: RepliesAlongAxes, names: Sequence[str]) -> Channel:
        """The channel of replies along the same axes."""
        of_log = [name for name in SENSORS["usbl"].column_names if name != "usbl_beacon"]
        filled = [name for name in of_log if any(name in reply.columns for _, reply in group.used)]
        rows = [[t, *(r.columns.get(n, math.nan) for n in filled), label_of(r.beacon)] for t, r in group.used]
        table = np.array(rows)[np.argsort([row[0] for row in rows], kind="stable")]
        columns = dict(zip(("time", *filled, "usbl_beacon"), table.T, strict=True))
        if np.isnan(columns["usbl_beacon"]).all():
            del columns["usbl_beacon"]
        held = {reply.name for _, reply in group.used}
        return self._channel("usbl", ", ".join(name for name in names if name in held), columns, AXES[group.frame])

    # relative to the ship, as fixes

    def _as_fixes(self, direct: Mapping[str, Channel]) -> tuple[list[Channel], dict[str, Any]]:
        """Channels of fixes, of the transponders before those of the ship."""
        made = {**direct, **self._placed()}
        if not made and self.choose.get("fix") not in self.fixes:
            if self.receivers:
                other = f"--choose fix={self.receivers[0]} if that receiver is the vehicle's"
            else:
                other = (
                    f'--choose usbl="{self.heard.names[0]}" if another file has the ship' if self.heard.names else ""
                )
            raise InputError(
                f"{self.path}: holds acoustic positions, but none that can be placed ({self._why_not()}); record the "
                f"ship's heading (HDT) and position beside them{', or say ' if other else ''}{other}"
            )
        labels = [*sorted(made, key=lambda name: -len(made[name].columns["time"])), *self.fixes]
        order = preferred_first(self.path, "fix", labels, self.choose)
        if order[0] in made and order[0] not in direct:
            receiver = self.receivers[0]
            self.said.append(f"{order[0]} is added to {receiver}: see that it counts from the antenna of that receiver")
        channels = [(made | self.fixes)[name] for name in order]
        if not self._is_filtered(order[0]):
            return channels, {}
        self.said.append(f"{order[0]} {FILTERED}")
        return channels, {"calibration": {"fix_error": {"estimate": True}}}

    def _is_filtered(self, name: str) -> bool:
        replies = any(r.filtered for rows in self.heard.replies.values() for _, r in rows if r.name == name)
        return replies or any(position.filtered for _, position in self.heard.positions.get(name, ()))

    def _placed(self) -> dict[str, Channel]:
        """Fixes of replies that are added to the ship's position, by name."""
        made: dict[str, Channel] = {}
        by_name: dict[tuple[str, str], list[tuple[float, Reply]]] = {}
        for (_, frame), rows in self.heard.replies.items():
            for t, reply in rows:
                by_name.setdefault((reply.name, frame), []).append((t, reply))
        for (name, frame), rows in by_name.items():
            if self.ship is None:
                self.left[name, "relative to a ship whose fixes are not in the file"] += len(rows)
                continue
            if frame == "transducer":
                self.left[name, "along the axes of the head, which are not fixes"] += len(rows)
                continue
            when = np.array([t for t, _ in rows])
            x, y, _ = np.array([reply.xyz for _, reply in rows]).T
            lat, lon = positions(self.ship, when, x, y, frame == "ship")
            known = np.isfinite(lat)
            self.left[name, "the ship's position, or her heading (HDT), is not known"] += int((~known).sum())
            if known.any():
                sd = np.array([reply.sd for _, reply in rows])
                beacon = np.array([label_of(reply.beacon) for _, reply in rows])
                cells = zip(when[known], np.column_stack([lat, lon, sd, beacon])[known], strict=True)
                columns = _in_time(cells, (*FIX[:3], FIX[-1]))
                named = {key: values for key, values in columns.items() if key != FIX[-1] or np.isfinite(values).any()}
                made[name] = self._channel("fix", name, named)
        return made


def _fixes(rows: Iterable[tuple[float, AcousticPosition]]) -> dict[str, Array]:
    of_fix = ((t, (p.lat, p.lon, *p.noise, math.nan if p.of_ship else label_of(p.beacon))) for t, p in rows)
    columns = _in_time(of_fix, FIX)
    return {name: values for name, values in columns.items() if name not in FIX[3:] or not np.isnan(values).all()}


def _in_time(rows: Iterable[tuple[float, Iterable[float]]], names: Sequence[str]) -> dict[str, Array]:
    """Columns of rows, in the order of time and one at a time."""
    table = np.array([(time, *values) for time, values in rows], dtype=float).reshape(-1, 1 + len(names))
    table = table[np.argsort(table[:, 0], kind="stable")]
    table = table[np.diff(table[:, 0], prepend=-np.inf) > 0.0]
    return dict(zip(("time", *names), table.T, strict=True))


def _is_slow(time: Array) -> bool:
    return len(time) < 2 or median_step(time) > SLOW_S


def label_of(beacon: str) -> float:
    """The number that stands for a transponder's name; NaN without one."""
    return label_number(beacon) if beacon else math.nan
