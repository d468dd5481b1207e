"""Marks, way-points and a person's commands while a dive goes on.

Commands arrive through the feed, between messages of the sources.
"""

import csv
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np

from rovgraph.inference.trajectory import Trajectory
from rovgraph.live.solution import Solution
from rovgraph.live.warnings import Warnings
from rovgraph.model.origin import Origin

MARKS = "marks.csv"
MOST_MARKS = 500  # that pages may drop: the whole file is written at each


@dataclass(frozen=True)
class Mark:
    """A place with a name.

    Attributes
    ----------
    number : from 1 on, never used again
    kind : "mark", where the vehicle was, or "waypoint", a place that was pointed at
    name : any text
    time : when it was dropped [s], the estimate's time
    north, east : [m]
    down : [m], of a mark
    north_sd, east_sd : of the estimate at that time, of a mark [m]
    latitude, longitude : [deg], of a mark, where the origin is known
    """

    number: int
    kind: str
    name: str
    time: float
    north: float
    east: float
    down: float | None = None
    north_sd: float | None = None
    east_sd: float | None = None
    latitude: float | None = None
    longitude: float | None = None


class Marks:
    """The marks of a dive, and their file.

    Parameters
    ----------
    folder : of the results; None = they are kept in memory
    warnings : where trouble with the disk goes
    resume : keep the marks that are there

    Attributes
    ----------
    all : tuple of Mark, oldest first; replaced, never changed, so that any thread may read it
    edition : counts the changes of `all`; read it first
    """

    def __init__(self, folder: Path | None = None, warnings: Warnings | None = None, resume: bool = False) -> None:
        self._path = None if folder is None else folder / MARKS
        self._warnings = warnings or Warnings()
        self.all = _read(self._path, self._warnings) if self._path is not None and resume else ()
        self.edition = 0
        self._newest = max((mark.number for mark in self.all), default=0)

    def drop(self, name: str, at: Solution, north: float | None = None, east: float | None = None) -> Mark:
        """Add a way-point at a place [m], or a mark at the position of a solution."""
        self._newest += 1
        if north is not None and east is not None:
            mark = Mark(self._newest, "waypoint", name, at.time, north, east)
        else:
            north, east, down = at.position.tolist()
            north_sd, east_sd, _ = at.position_sd.tolist()
            place = north, east, down, north_sd, east_sd, at.latitude, at.longitude
            mark = Mark(self._newest, "mark", name, at.time, *place)
        self._change((*self.all, mark))
        return mark

    def remove(self, number: int) -> Mark | None:
        """Forget a mark; the one that was there."""
        found = next((mark for mark in self.all if mark.number == number), None)
        if found is not None:
            self._change(tuple(mark for mark in self.all if mark is not found))
        return found

    def _change(self, marks: tuple[Mark, ...]) -> None:
        self.all = marks
        self.edition += 1
        self._write()

    def _write(self) -> None:
        if self._path is None:
            return
        partial = self._path.with_name(f".{MARKS}.partial")
        try:
            write_marks(partial, self.all)
            partial.replace(self._path)
        except OSError as error:
            self._warnings.complain(str(self._path), "disk", f"cannot be written ({error.strerror}); free some space")


def write_marks(path: Path, marks: Sequence[Mark]) -> None:
    """A row for each, with names above."""
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, [f.name for f in fields(Mark)])
        table.writeheader()
        table.writerows(asdict(mark) for mark in marks)


def marks_beside(recording: Path, track: Trajectory, origin: Origin | None = None) -> tuple[Mark, ...]:
    """The marks that were dropped while a recording was made, those of the vehicle where a better track has it then.

    Parameters
    ----------
    recording : of the online mode
    track : of the recording, such as the smoothed one
    origin : latitude and longitude of north = east = 0 [deg]
    """
    marks = _read(recording.with_name(MARKS), Warnings())
    inside = [m for m in marks if m.kind != "mark" or track.time[0] <= m.time <= track.time[-1]]
    of_vehicle = [k for k, mark in enumerate(inside) if mark.kind == "mark"]
    if of_vehicle:
        there = track.clamped(np.array([inside[k].time for k in of_vehicle]))
        places = there.geodetic(origin) if origin is not None else ([None] * len(of_vehicle),) * 2
        for k, p, sd, latitude, longitude in zip(of_vehicle, there.p_n, there.p_sd, *places, strict=True):
            north, east, down = p.tolist()
            place = {"latitude": latitude, "longitude": longitude}
            inside[k] = replace(
                inside[k], north=north, east=east, down=down, north_sd=float(sd[0]), east_sd=float(sd[1]), **place
            )
    return tuple(inside)


def _read(path: Path, warnings: Warnings) -> tuple[Mark, ...]:
    """The marks of a run that is resumed; a line that was torn is left out."""
    if not path.exists():
        return ()
    marks = []
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
        for row in csv.DictReader(file):
            try:
                numbers = [float(row[f.name]) if row[f.name] else None for f in fields(Mark)[3:]]
                mark = Mark(int(row["number"]), row["kind"], row["name"], *numbers)  # type: ignore[arg-type]
                if not all(isinstance(v, float) and math.isfinite(v) for v in (mark.time, mark.north, mark.east)):
                    raise ValueError
                marks.append(mark)
            except (ValueError, TypeError, KeyError):
                warnings.complain(str(path), "marks", "an invalid line is left out")
    return tuple(marks)


@dataclass(frozen=True)
class Command:
    """A person's command."""


@dataclass(frozen=True)
class DropMark(Command):
    """Keep a place.

    Attributes
    ----------
    name : any text
    north, east : of a way-point [m]; None = a mark where the vehicle is
    """

    name: str
    north: float | None = None
    east: float | None = None


@dataclass(frozen=True)
class RemoveMark(Command):
    """Forget a mark by its number."""

    number: int


@dataclass(frozen=True)
class SetPosition(Command):
    """Where the vehicle is now: becomes a position fix, which is weighed and gated as any other.

    Attributes
    ----------
    north, east : [m]
    sd : of each [m]
    """

    north: float
    east: float
    sd: float
