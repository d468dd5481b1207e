"""Reads a results folder for its page, and makes the section on its origin.

That section has configuration, versions, files with checksums, and the command to make the folder again. `table_of`,
`images`, `piece` and `cell` are shared by all pages: tables of CSV files, images, and numbers as text.
"""

import hashlib
import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rovgraph import compatibility
from rovgraph._version import __version__
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log import Stream
from rovgraph.log.companions import beams_of_table
from rovgraph.log.tables import read_table
from rovgraph.model.calibration import BEAM_SENSORS
from rovgraph.model.config import config_or_defaults
from rovgraph.problem.beams import ONE_PING_S, nearest
from rovgraph.report.folder import SOUNDINGS_FILE, STAMP, SUMMARY
from rovgraph.report.pages.page import Image, Item, Missing, PageTable, Section, Text, render
from rovgraph.report.results import BEAMS_FILE, CHI2_99

LACKS_S = 1.0  # that a track may end before its dive
KINDS = ("smoothed", "filtered", "dead_reckoning")


@contextmanager
def damage_named(*folders: Path) -> Iterator[None]:
    """Makes what is missing or of another kind in results folders an `InputError`."""
    try:
        yield
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        where = " or ".join(map(str, folders))
        reason = f"is incomplete or of another version ({error!r})"
        raise InputError(f"{where}: {reason}; make the results again") from None


@dataclass(frozen=True)
class ResultsSource:
    """A results folder of any command.

    Attributes
    ----------
    folder : where it is
    summary : of its summary.json
    """

    folder: Path
    summary: Mapping[str, Any]

    @staticmethod
    def read(folder: Path) -> "ResultsSource":
        """The folder's summary; other files are read when they are asked for.

        Raises
        ------
        InputError : no results folder of rovgraph, or one of a newer version
        """
        if not folder.is_dir():
            what = "a file, not a folder" if folder.exists() else "no such folder"
            raise InputError(f"{folder}: {what}; give a results folder of rovgraph")
        path = folder / SUMMARY
        try:
            summary = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise InputError(f"{folder}: has no {SUMMARY}; give a results folder of rovgraph") from None
        except (OSError, ValueError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise InputError(f"{path}: cannot be read ({reason}); make the results again") from None
        if not isinstance(summary, dict) or summary.get("program") != STAMP["program"]:
            raise InputError(f"{path}: is not a summary of rovgraph; give a results folder of rovgraph")
        compatibility.refuse_newer(summary.get("format"), compatibility.RESULTS, f"{folder}: results folder")
        return ResultsSource(folder, summary)

    @property
    def other_version(self) -> str:
        """A line where another version wrote the folder; else empty."""
        wrote = self.summary.get("version")
        if wrote == __version__:
            return ""
        return f"The results were written by rovgraph {wrote}, this page by {__version__}; what is missing is named."

    def frame(self, name: str, *columns: str) -> pd.DataFrame | None:
        """A CSV file of the folder; None if it is missing.

        Raises
        ------
        InputError : it cannot be read, or lacks one of ``columns``
        """
        path = self.folder / name
        if not path.is_file():
            return None
        try:
            table = pd.read_csv(path, low_memory=False, keep_default_na=True)
        except pd.errors.EmptyDataError:
            raise InputError(f"{path}: is empty; make the results again") from None
        except (OSError, ValueError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise InputError(f"{path}: cannot be read as CSV ({reason}); make the results again") from None
        lacking = [c for c in columns if c not in table]
        if lacking:
            raise InputError(f"{path}: column {lacking[0]} is missing; make the results again")
        return table

    def text(self, name: str) -> str | None:
        """A text file of the folder; None if it is missing."""
        path = self.folder / name
        return path.read_text(encoding="utf-8", errors="replace") if path.is_file() else None

    def json(self, name: str) -> dict[str, Any] | None:
        """A JSON file of the folder; None if it is missing.

        Raises
        ------
        InputError : it cannot be read
        """
        text = self.text(name)
        if text is None:
            return None
        try:
            content: dict[str, Any] = json.loads(text)
        except ValueError as error:
            raise InputError(f"{self.folder / name}: cannot be read ({error}); make the results again") from None
        return content


@dataclass(frozen=True)
class PageTrack:
    """A trajectory of the folder.

    Attributes
    ----------
    kind : smoothed, filtered or dead_reckoning
    columns : name -> ndarray, shape (n,), as in the file
    """

    kind: str
    columns: Mapping[str, Array]

    def __getitem__(self, name: str) -> Array:
        """A column; NaN where the file has none."""
        return self.columns[name] if name in self.columns else np.full(len(self.columns["time"]), np.nan)

    def __len__(self) -> int:
        return len(self.columns["time"])

    @property
    def name(self) -> str:
        return self.kind.replace("_", " ")

    @cached_property
    def horizontal_sd(self) -> Array:
        """sd along the worst direction, shape (n,) [m]."""
        return np.asarray(self.ellipses[0] / np.sqrt(CHI2_99))

    @cached_property
    def ellipses(self) -> tuple[Array, Array, Array]:
        """Semi-axes of the 99 % ellipses [m] and bearing of the major one [rad], shape (n,) each."""
        a, b, c = self["north_sd"] ** 2, self["east_sd"] ** 2, self["cov_north_east"]
        c = np.where(np.isnan(c), 0.0, c)
        half, root = (a + b) / 2, np.hypot((a - b) / 2, c)
        major, minor = (np.sqrt(CHI2_99 * np.clip(half + s * root, 0.0, None)) for s in (1, -1))
        return major, minor, 0.5 * np.arctan2(2 * c, a - b)


@dataclass(frozen=True)
class DiveTime:
    """Time since the dive began, in minutes where it is long; as on the figures.

    Attributes
    ----------
    start, end : [s], of the log
    """

    start: float
    end: float

    @property
    def unit(self) -> str:
        return "min" if self.end - self.start > 1200.0 else "s"

    @property
    def label(self) -> str:
        return f"time since start [{self.unit}]"

    @property
    def scale(self) -> float:
        """Seconds of one unit."""
        return 60.0 if self.unit == "min" else 1.0

    def __call__(self, time: Array) -> Array:
        return (np.asarray(time, float) - self.start) / self.scale


@dataclass(frozen=True)
class DiveSource(ResultsSource):
    """The results folder of ``rovgraph smooth``."""

    @cached_property
    def tracks(self) -> dict[str, PageTrack]:
        """Kind -> trajectory, of the files that are there, the main one first.

        Raises
        ------
        InputError : there is none, or one has no time, north and east
        """
        found = {}
        for kind in KINDS:
            name = f"trajectory_{kind}.csv"
            table = self.frame(name, "time", "north", "east")
            if table is None:
                continue
            numbers = {str(c): pd.to_numeric(table[c], errors="coerce").to_numpy(float) for c in table}
            known = np.isfinite(numbers["time"])
            if not known.any():
                raise InputError(f"{self.folder / name}: has no rows with a time; make the results again")
            found[kind] = PageTrack(kind, {c: values[known] for c, values in numbers.items()})
            self._require_whole(name, float(numbers["time"][known][-1]))
        if not found:
            raise InputError(f"{self.folder}: has no trajectory_smoothed.csv; make the results again")
        return found

    def _require_whole(self, name: str, last: float) -> None:
        """Refuse a track that ends before the dive does.

        Raises
        ------
        InputError : it does
        """
        start, duration = (self.summary.get(key) for key in ("start_time_s", "duration_s"))
        missing = 0.0 if start is None or duration is None else start + duration - last
        if missing > LACKS_S:
            raise InputError(
                f"{self.folder / name}: the last {missing:.0f} s of the dive are missing; make the results again"
            )

    @property
    def main(self) -> PageTrack:
        """The smoothed track, or the best that is there."""
        return next(iter(self.tracks.values()))

    @cached_property
    def clock(self) -> DiveTime:
        return DiveTime(float(self.main["time"][0]), float(self.main["time"][-1]))

    @cached_property
    def residuals(self) -> pd.DataFrame | None:
        return self.frame("residuals.csv", "time", "sensor", "component", "innovation", "normalised", "weight")

    @cached_property
    def calibration(self) -> pd.DataFrame | None:
        """Rows of the main estimate."""
        table = self.frame("calibration.csv", "estimate", "label", "unit", "value", "sd", "prior_mean", "prior_sd")
        return None if table is None else table[table["estimate"] == self.main.kind]

    @cached_property
    def history(self) -> pd.DataFrame | None:
        return self.frame("history.csv", "estimate", "time", "variable", "value", "sd", "unit")

    @cached_property
    def pings(self) -> pd.DataFrame | None:
        """Rows of dvl.csv; one whose beams were used saw the bottom, whatever the instrument made of them."""
        pings = self.frame("dvl.csv", "time", "lock", "altitude", "figure_of_merit", "row")
        if pings is not None and self.residuals is not None:
            by_beams = self.residuals["sensor"].isin(BEAM_SENSORS) & (self.residuals["weight"] > 0)
            used = np.unique(self.residuals.loc[by_beams, "time"].to_numpy(float))
            if len(used):
                time = pings["time"].to_numpy(float)
                near = np.abs(used[nearest(used, time)] - time) < ONE_PING_S
                pings["lock"] = np.maximum(pings["lock"], near)
        return pings

    @cached_property
    def beams(self) -> Stream | None:
        """Measurements of each beam of the DVL; None where the folder has none.

        Raises
        ------
        InputError : a file that cannot be used
        """
        path = self.folder / BEAMS_FILE
        return beams_of_table(read_table(path), config_or_defaults(None)) if path.is_file() else None

    @cached_property
    def error_velocity(self) -> pd.DataFrame | None:
        """Times of pings and what their beams disagree by; None where the folder does not have it."""
        table = self.frame(BEAMS_FILE)
        known = table is not None and {"time", "error_velocity"} <= set(table.columns)
        return table[["time", "error_velocity"]].dropna() if table is not None and known else None

    @cached_property
    def soundings(self) -> pd.DataFrame | None:
        return self.frame(SOUNDINGS_FILE, "time", "beam", "north", "east", "depth", "used")

    @cached_property
    def silences(self) -> list[tuple[float, float]]:
        """Times without bottom lock, longer than three periods: from, to [s of the log]."""
        pings = self.pings
        if pings is None:
            return []
        time = pings.loc[pings["lock"] == 1, "time"].to_numpy(float)
        time = np.concatenate([[self.clock.start], time, [self.clock.end]])
        gap = np.diff(time)
        long = gap > 3.0 * max(float(np.median(gap)), 1e-3)
        return list(zip(time[:-1][long].tolist(), time[1:][long].tolist(), strict=True))


PAGE = "report.html"


def about_section(source: ResultsSource, command: str = "", folded: bool = False) -> Section:
    """Configuration, versions, files and, where it is known, the command."""
    items: list[Item] = []
    if command:
        items.append(
            Text("Command to reproduce it, where the log and the config.yaml of this folder are", command, shown=True)
        )
    versions = {"rovgraph": source.summary.get("version"), **(source.summary.get("versions") or {})}
    items.append(PageTable("Versions", ("", ""), [(name, str(v)) for name, v in versions.items()]))
    items.append(_files(source))
    found = (source.text(name) for name in ("config.yaml", "study.yaml"))
    config = next(filter(None, found), None)
    items.append(
        Text("Configuration in effect", config) if config else Missing("Configuration", "config.yaml is missing")
    )
    finding = f"Made by rovgraph {source.summary.get('version', 'of an unknown version')}; how to make it again."
    return Section("about", "Configuration, versions and files", (), items, finding=finding if folded else "")


def smooth_command(source: ResultsSource) -> str:
    """What makes the same results from the effective configuration."""
    kinds = [k for k in ("smoothed", "filtered") if k in (source.summary.get("estimates") or {})]
    logs = [Path(name).name for name in str(source.summary.get("log", "LOG")).split(" + ")]
    words = ["rovgraph", "smooth", *logs, "--config", "config.yaml", "--out", "again"]
    return shlex.join(words + (["--estimate", kinds[0]] if len(kinds) == 1 else []))


def _files(source: ResultsSource) -> PageTable:
    rows = []
    log = source.summary.get("input")
    if isinstance(log, dict):
        rows.append((f"{log.get('path')} (the log)", f"{log.get('bytes')}", str(log.get("sha256"))))
    for path in sorted(source.folder.iterdir()):
        if path.is_file() and path.name not in (PAGE, SUMMARY):  # which holds the time that the work took
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            rows.append((path.name, str(path.stat().st_size), digest))
    return PageTable("Files", ("file", "bytes", "SHA-256"), rows)


MOST_ROWS = 60


def rendered(source: ResultsSource, title: str, sections: Sequence[Section], clock: DiveTime | None = None) -> str:
    """The page of a folder, with its configuration, versions and files at the end."""
    note = [Section("version", "Version", [source.other_version])] if source.other_version else []
    time = None
    if clock is not None:
        time = {"unit": clock.unit, "end": (clock.end - clock.start) / clock.scale, "label": clock.label}
    return render(title, [*note, *sections, about_section(source)], time)


def table_of(table: pd.DataFrame, title: str, names: dict[str, str], file: str) -> PageTable:
    """Columns with values, under readable names."""
    known = {column: name for column, name in names.items() if column in table and table[column].notna().any()}
    rows = [tuple(cell(v) for v in row) for row in table[[*known]].head(MOST_ROWS).itertuples(index=False)]
    some = f"The first {MOST_ROWS} of {len(table)} rows. " if len(table) > MOST_ROWS else ""
    return PageTable(title, [*known.values()], rows, note=f"{some}{file} has more columns.")


def images(source: ResultsSource) -> list[Item]:
    """The figures of the folder."""
    return [Image(path.stem.replace("_", " "), path.read_bytes()) for path in sorted(source.folder.glob("*.png"))]


def piece(source: ResultsSource, name: str) -> Item:
    """A file that goes into a configuration, as text."""
    text = source.text(name)
    title = "For the configuration"
    return Missing(title, f"{name} is missing") if text is None else Text(title, text, shown=True)


def cell(value: object) -> str:
    """A value as text, "–" without a value."""
    if value is None or value != value:
        return "–"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return "(" + ", ".join(cell(v) for v in value) + ")"
    return str(value)
