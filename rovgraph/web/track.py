"""The track so far, in pieces that are encoded once for all pages."""

import json
import math
from collections.abc import Iterator

from rovgraph.live.solution import Solution

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


class Track:
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
