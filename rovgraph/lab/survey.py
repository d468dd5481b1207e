"""Lines of a survey, planned or recorded, and the route over them and some crosslines after them."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import cycle

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array, matrix_from_rpy
from rovgraph.inference.crossovers import ENOUGH
from rovgraph.inference.relief import CELL_M, LINE_M, Line
from rovgraph.inference.trajectory import Trajectory
from rovgraph.model.config import Config
from rovgraph.sensors.dvl_beam import beam_geometry
from rovgraph.simulate import CALM, Style
from rovgraph.simulate.path import Route, timetable
from rovgraph.simulate.scenario import FASTEST, lanes

PLACES = 4  # where crosslines are tried
ALTITUDE_M, DEPTH_M = 10.0, 5.0  # of what is planned and simulated
OVER_M = 10.0  # that a crossline begins before the first line and ends behind the last
ALONG = np.cos(np.pi / 6.0)  # of a line's course with that of the survey
MOST_HOURS = 12.0  # of a survey that is planned
STYLE = Style(smoothing=4.0, turning=4.0, waves=CALM)  # of the simulated dive: its turns take some 15 s


@dataclass(frozen=True)
class Survey:
    """Lines of a survey, at one speed.

    Attributes
    ----------
    source : its log, or as it was planned
    legs : ndarray, shape (n, 2, 2), ends of its lines in the order of time, north and east [m]
    speed : of the vehicle [m/s]
    swath : ndarray, shape (s,), places of its soundings to starboard [m]
    """

    source: str
    legs: Array
    speed: float
    swath: Array

    @staticmethod
    def planned(text: str, config: Config) -> "Survey":
        """Lines to and fro, the first one towards `start.heading_deg`, else north.

        Parameters
        ----------
        text : how many, their length, how far they are apart [m], and the speed [m/s], as ``8x250x25@1``
        config : of the vehicle

        Raises
        ------
        InputError : another text; too few lines, too short, too close or too long
        """
        number = r"(\d+\.?\d*|\.\d+)"
        found = re.fullmatch(rf"(\d+)x{number}x{number}@{number}", text.strip())
        if found is None:
            expected = "LINESxLENGTHxAPART@SPEED, as 8x250x25@1 for 8 lines of 250 m, 25 m apart, at 1 m/s"
            raise InputError(f"survey {text!r}: expected {expected}")
        count, length, apart, speed = int(found[1]), *map(float, found.groups()[1:])
        hours = count * (length + apart) / max(speed, 1e-9) / 3600.0
        for wrong, why in (
            (count < ENOUGH, f"{ENOUGH} lines or more are needed"),
            (length < 2.0 * LINE_M, f"lines of {2.0 * LINE_M:g} m or more are needed"),
            (apart < 2.0 * CELL_M, f"lines {2.0 * CELL_M:g} m apart or more are needed"),
            (not 0.0 < speed <= FASTEST, f"a speed of more than 0 and at most {FASTEST:g} m/s is expected"),
            (hours > MOST_HOURS, f"it takes {hours:.3g} hours, {MOST_HOURS:g} can be planned; take fewer lines"),
        ):
            if wrong:
                raise InputError(f"survey {text}: {why}")
        legs = lanes(count, length, apart) @ _axes(np.deg2rad(config.start.heading_deg or 0.0))
        return Survey(f"survey {text}", legs, speed, planned_swath(config))

    @staticmethod
    def recorded(source: str, lines: Sequence[Line], track: Trajectory) -> "Survey":
        """That of some lines of a track.

        Raises
        ------
        InputError : too few of them are parallel, or soundings are further off than these are long
        """
        ends = np.array([(x.time.min(), x.time.max()) for x in lines]).reshape(-1, 2)
        legs = np.stack([np.interp(ends, track.time, x) for x in track.p_n[:, :2].T], axis=-1)
        speeds = np.linalg.norm(legs[:, 1] - legs[:, 0], axis=1) / np.ptp(ends, axis=1)
        speed = float(np.median(speeds)) if lines else 0.0
        wide = float(np.median([x.centre[2] for x in lines])) if lines else 0.0
        survey = Survey(source, legs, speed, _in_cells(wide * np.array([-1.0, 0.0, 1.0])))
        if (found := int(survey.parallel.sum())) < ENOUGH:
            raise InputError(f"{source}: a survey of {ENOUGH} parallel lines or more is needed, found {found}")
        if wide > (long := float(np.ptp(survey.box[:, 0]))):
            off = f"its soundings are {wide:.0f} m beside lines of {long:.0f} m"
            raise InputError(f"{source}: {off}; check the unit of its ranges")
        return survey

    @cached_property
    def course(self) -> float:
        """Of its lines, to and fro alike [rad]."""
        way = (self.legs[:, 1] - self.legs[:, 0]) @ (1.0, 1j)
        return float(np.angle((way**2 / np.maximum(np.abs(way), 1e-9)).sum()) / 2.0)

    @property
    def parallel(self) -> Array:
        """Which of its lines are, shape (n,)."""
        way = (self.legs[:, 1] - self.legs[:, 0]) @ _axes(self.course).T
        return np.asarray(np.abs(way[:, 0]) > ALONG * np.linalg.norm(way, axis=1))

    @property
    def box(self) -> Array:
        """From where to where parallel lines go, along and across them, shape (2, 2) [m]."""
        ends = self.legs[self.parallel].reshape(-1, 2) @ _axes(self.course).T
        return np.array([ends.min(axis=0), ends.max(axis=0)])

    @property
    def corner(self) -> Array:
        """From where distances along the lines count, north and east, shape (2,) [m]."""
        return np.asarray(self.box[0] @ _axes(self.course))

    @property
    def places(self) -> Array:
        """Where crosslines are tried, along the lines from the corner, the one next to the survey's end first [m]."""
        along = (np.arange(PLACES) + 0.5) / PLACES * np.ptp(self.box[:, 0])
        return along[::-1] if self._end[0] > 0.0 else along

    @property
    def _end(self) -> Array:
        """Of its last line, from the middle, along and across."""
        return np.asarray(self.legs[-1, 1] @ _axes(self.course).T - self.box.mean(axis=0))

    def crosslines(self, along: Array) -> Array:
        """Ends of those at some places, each begun on the side where the one before ends, shape (k, 2, 2) [m]."""
        beyond = np.copysign(np.ptp(self.box[:, 1]) / 2.0 + OVER_M, self._end[1])
        (low, _), (_, middle) = self.box[0], self.box.mean(axis=0)
        ends = [[(low + a, middle + s), (low + a, middle - s)] for a, s in zip(along, cycle((beyond, -beyond)))]
        return np.array(ends).reshape(-1, 2, 2) @ _axes(self.course)

    def route(self, along: Array) -> Route:
        """Its lines and crosslines after them, with the ways between."""
        return Route.level(np.vstack([self.legs, self.crosslines(along)]).reshape(-1, 2), DEPTH_M)

    def line_at(self, time: float, along: Array) -> int:
        """Number of the line or crossline that is driven then in the simulated dive, -1 on a way between."""
        ends = timetable(self.route(along), self.speed)[0][1::2] + STYLE.rest + STYLE.lead
        line, way = divmod(int(np.searchsorted(ends, time)), 2)
        return -1 if way else line


def planned_swath(config: Config) -> Array:
    """Places to starboard of the soundings of a DVL, by its beams where these are configured, shape (s,) [m]."""
    beams = beam_geometry(config.dvl)
    down = np.array([[0.0, 0.0, 1.0]]) if beams is None else beams.directions
    down = down @ matrix_from_rpy(np.deg2rad(config.dvl.mount_rpy_deg)).T
    return _in_cells(ALTITUDE_M * down[:, 1] / np.abs(down[:, 2]))


def _in_cells(across: Array) -> Array:
    return np.unique(np.round(across / CELL_M)) * CELL_M


def _axes(course: float) -> Array:
    """North and east of the directions along and across a course, a row each."""
    return np.array([[np.cos(course), np.sin(course)], [-np.sin(course), np.cos(course)]])
