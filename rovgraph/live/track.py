"""The filtered trajectory, written while it grows."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rovgraph.errors import InputError
from rovgraph.gps_time import is_unix
from rovgraph.trajectory import Trajectory


class TrackFile:
    """A trajectory CSV that rows are added to.

    Parameters
    ----------
    path : new, or to go on with
    until : keep rows of an older file up to this time [s]; the rest comes again

    Raises
    ------
    InputError : the file cannot be written
    """

    def __init__(self, path: Path, until: float = -np.inf) -> None:
        self.path = path
        kept: list[str] = []
        with _one_line(path):
            if path.exists() and np.isfinite(until):
                lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
                kept = [x for x in lines[1:] if x.endswith("\n") and float(x.split(",", 1)[0]) < until - 5e-5]
                kept = lines[:1] + kept if kept else []
            partial = path.with_name(f".{path.name}.partial")
            partial.write_text("".join(kept), encoding="utf-8")
            partial.replace(path)
        self._begun = bool(kept)
        self._on_earth = bool(kept) and kept[0].rstrip().endswith(",lat,lon")
        self._unix = bool(kept) and ",unix_time" in kept[0]

    def add(self, trajectory: Trajectory, origin: tuple[float, float] | None = None) -> None:
        """Add epochs, later than those before: all of them, or where the disk is full none.

        Parameters
        ----------
        trajectory : the epochs
        origin : of `Trajectory.write_csv`; a file that was begun without one goes on without
        """
        if not self._begun:
            self._on_earth, self._unix = origin is not None, is_unix(trajectory.time)
        with _one_line(self.path):
            size = self.path.stat().st_size
            try:
                trajectory.write_csv(self.path, self._begun, origin if self._on_earth else None, self._unix)
            except OSError:
                os.truncate(self.path, size)
                raise
        self._begun = True


@contextlib.contextmanager
def _one_line(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror}); free some space or choose another --out"
        ) from None
