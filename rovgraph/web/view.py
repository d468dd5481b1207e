"""The data that pages show of a dive: its newest state, its track, its events. Belongs to the server's thread.

`LiveTrack` holds the track so far in pieces that are encoded once for all pages.
"""

import json
import math
import time as host
from collections import deque
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from rovgraph.live.marks import Marks
from rovgraph.live.outputs.json_lines import as_dict
from rovgraph.live.solution import BeaconPlace, CrossingPlace, RangeCircle, ShipPose, Solution
from rovgraph.log.units import shown
from rovgraph.model.calibration import BEAM_SENSORS, TABLE
from rovgraph.model.origin import Origin, lat_lon
from rovgraph.sensors.instruments import HEADING_STREAMS

COLUMNS = ("time", "north", "east", "down", "sd")  # of a point; sd is that of the longer axis of its ellipse
Point = tuple[float, float, float, float, float]
STEP_M, STEP_S = 0.1, 2.0  # a point is kept after the first, or after the second
PIECE = 500  # points that are encoded at once: under a millisecond
MOST = 40_000  # points; then every second is given up


def point_of(s: Solution) -> Point:
    """Where a solution is on the map, to the millimetre, and how sure that is [s, m]."""
    return (
        round(s.time, 3),
        *(round(x, 3) for x in s.position.tolist()),
        float(f"{ellipse_sd(s):.3g}"),
    )


def ellipse_sd(s: Solution) -> float:
    """sd along the longer axis of the horizontal error ellipse [m]."""
    a, b, c = float(s.position_sd[0]) ** 2, float(s.position_sd[1]) ** 2, s.cov_north_east
    return math.sqrt(0.5 * (a + b) + math.hypot(0.5 * (a - b), c))


class LiveTrack:
    """Points of the track, about a tenth of a metre apart; for one thread.

    Attributes
    ----------
    edition : changes when points are given up, after which a page needs all of it again
    """

    def __init__(self) -> None:
        self.edition = 0
        self._points: list[Point] = []
        self._encoded: list[str] = []  # whole pieces

    def __len__(self) -> int:
        return len(self._points)

    def add(self, solution: Solution) -> None:
        """Keep a solution's point, if it is far enough from the last."""
        point = point_of(solution)
        if not all(map(math.isfinite, point)):
            return
        if self._points:
            last = self._points[-1]
            near = math.hypot(point[1] - last[1], point[2] - last[2]) < STEP_M and abs(point[3] - last[3]) < STEP_M
            if near and point[0] - last[0] < STEP_S:
                return
        self._points.append(point)
        if len(self._points) > MOST:
            self._points = self._points[::2]
            self._encoded = []
            self.edition += 1

    def since(self, index: int) -> list[Point]:
        """Points from a place on."""
        return self._points[index:]

    def pieces(self) -> Iterator[str]:
        """All points as JSON arrays of points, a piece at a time."""
        whole = len(self._points) // PIECE
        for k in range(whole):
            if k == len(self._encoded):
                self._encoded.append(_encoded(self._points[k * PIECE : (k + 1) * PIECE]))
            yield self._encoded[k]
        if rest := self._points[whole * PIECE :]:
            yield _encoded(rest)


def _encoded(points: list[Point]) -> str:
    return json.dumps(points, allow_nan=False, separators=(",", ":"))


EVENTS = 1000  # that are kept
UNITS = {  # of each calibration variable: factor to what a person reads, and its unit
    label: (factor, "" if unit == "1" else unit.replace("deg", "°"))
    for variable in TABLE.values()
    for factor, unit in [shown(variable.unit)]
    for label in variable.labels
}
STALE_S = 2.0  # without a solution, after which a page shows it


@dataclass(frozen=True)
class PageLimits:
    """Beyond these the page raises an alarm.

    Attributes
    ----------
    position_sd_m : of the longer axis of the ellipse
    heading_sd_deg : of the heading
    """

    position_sd_m: float = 5.0
    heading_sd_deg: float = 10.0


@dataclass(frozen=True)
class Cursor:
    """State of a page: points of an edition of the track, events, and an edition of the marks, -1 = none."""

    edition: int
    points: int
    events: int
    marks: int = -1


class View:
    """Takes solutions in the order of time, and returns what is new to a page.

    Parameters
    ----------
    marks : of the run, which another thread changes
    limits : of alarms
    """

    def __init__(self, marks: Marks, limits: PageLimits) -> None:
        self.marks = marks
        self.limits = limits
        self.newest: Solution | None = None
        self.track = LiveTrack()
        self.received = -math.inf  # when the newest came, by the host's monotonic clock
        self._events: deque[dict[str, Any]] = deque(maxlen=EVENTS)
        self._numbered = 0
        self._reasons: dict[str, str] = {}  # sensor -> newest event's text

    def take(self, solution: Solution, received: float) -> None:
        """Take a solution that came at a time of the host's monotonic clock [s]."""
        self.newest, self.received = solution, received
        self.track.add(solution)
        for event in solution.events:
            self._numbered += 1
            self._events.append({"number": self._numbered, **event.as_dict()})
            self._reasons[event.source] = "" if event.kind in ("back", "readmitted", "over") else event.text

    @property
    def cursor(self) -> Cursor:
        """Of a page that has everything."""
        marks = -1 if self.newest is None else self.marks.edition  # before a first solution they are not sent
        return Cursor(self.track.edition, len(self.track), self._numbered, marks)

    def events(self, since: int = 0) -> list[dict[str, Any]]:
        """Events after a number, oldest first."""
        return [event for event in self._events if event["number"] > since]

    def state(self) -> dict[str, Any]:
        """The newest solution under the names of docs/online-output.md, and what a pilot asks beyond it."""
        s = self.newest
        if s is None:
            return {"time": None}
        state = as_dict(s)
        del state["events"]
        for name, health in s.sensors.items():
            reason = "" if health.state == "ok" else self._reasons.get(name, "")
            state["sensors"][name] |= {"failed_s": _rounded(health.failed_s), "reason": reason}
        dvl = s.sensors.get("dvl")
        return state | {
            "age_s": round(host.monotonic() - self.received, 3),
            "sent": round(host.time(), 3),
            "speed": _rounded(float(np.linalg.norm(s.velocity))),
            "ellipse_sd": _rounded(ellipse_sd(s)),
            "altitude": None if s.altitude is None else _rounded(s.altitude),
            "lock_lost_s": None if dvl is None else _rounded(dvl.failed_s),
            "alarms": [{"kind": a.kind, "sensor": a.sensor, "severity": a.severity, "text": a.text} for a in s.alarms],
            "limits": self._beyond(s),
            "marks": [asdict(mark) for mark in self.marks.all],
            "ship": None if s.ship is None else _plain(s.ship),
            "beacons": [_plain(beacon) for beacon in s.beacons],
            "ranges": [_plain(circle) for circle in s.ranges],
            "crossings": [_plain(crossing) for crossing in s.crossings],
        }

    def update(self, cursor: Cursor) -> str | None:
        """News since the last message to a page, as a message; None where it needs the whole track again."""
        if cursor.edition != self.track.edition:
            return None
        new = {"points": self.track.since(cursor.points), "events": self.events(cursor.events)}
        state = self.state()
        if cursor.marks == self.marks.edition:
            state.pop("marks", None)
        return json.dumps({"type": "state", **state, **new}, allow_nan=False, separators=(",", ":"))

    def geojson(self) -> dict[str, Any]:
        """The track as GeoJSON (RFC 7946) where the origin is known; elsewhere a feature without geometry."""
        points = self.track.since(0)
        s = self.newest
        properties: dict[str, Any] = {"columns": list(COLUMNS), "points": points}
        geometry = None
        if s is not None and s.origin is not None and len(points) > 1:
            geometry = {"type": "LineString", "coordinates": _degrees(points, s.origin)}
        return {"type": "Feature", "geometry": geometry, "properties": properties}

    def _beyond(self, s: Solution) -> list[dict[str, str]]:
        """What is beyond the page's own limits, or silent, or disagrees about the heading."""
        found = []
        sd, heading = ellipse_sd(s), math.degrees(float(s.rpy_sd[2]))
        if not sd <= self.limits.position_sd_m:
            found.append({"kind": "position", "text": f"position sd {sd:.1f} m, limit {self.limits.position_sd_m:g} m"})
        if not heading <= self.limits.heading_sd_deg:
            limit = self.limits.heading_sd_deg
            found.append({"kind": "heading", "text": f"heading sd {heading:.1f}°, limit {limit:g}°"})
        by_beams = any(s.sensors[name].state == "ok" for name in BEAM_SENSORS if name in s.sensors)
        for name, health in s.sensors.items():
            if name in BEAM_SENSORS or (by_beams and name == "dvl" and health.state == "no lock"):
                continue  # the other beams carry the track
            if name in HEADING_STREAMS and health.state == "rejected":
                found.append({"kind": "heading", "text": f"{name} disagrees with the heading"})
            elif health.state in ("silent", "no lock"):
                found.append({"kind": "silence", "text": f"{name}: {health.state} for {health.failed_s:.0f} s"})
        return found


def _degrees(points: list[Any], origin: Origin) -> list[list[float]]:
    """Longitude, latitude and height of points."""
    north, east, down = np.array(points)[:, 1:4].T
    latitude, longitude = lat_lon(north, east, origin)
    degrees: list[list[float]] = np.column_stack([np.round(longitude, 8), np.round(latitude, 8), -down]).tolist()
    return degrees


def _plain(values: ShipPose | BeaconPlace | RangeCircle | CrossingPlace) -> dict[str, Any]:
    """By name, null for what is not known."""
    known = values._asdict()
    return {name: _rounded(value) if isinstance(value, float) else value for name, value in known.items()}


def _rounded(value: float) -> float | None:
    return float(f"{value:.5g}") if math.isfinite(value) else None
