"""The track of a dive: the work of ``rovgraph smooth``."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rovgraph.api.logs import config_of, prepared
from rovgraph.diagnosis.alarm import Alarm, Verdict
from rovgraph.dive import DiveEstimates
from rovgraph.dive import smooth as smooth_dive
from rovgraph.errors import InputError, as_path, as_texts, collected_warnings
from rovgraph.geometry import Array
from rovgraph.inference.bottom import Bottom, bottom_of
from rovgraph.inference.estimate import CalibrationEstimate, Estimate
from rovgraph.log import Log
from rovgraph.model.config import Config
from rovgraph.model.origin import Frame
from rovgraph.process import Progress, no_progress
from rovgraph.report.export import ExportOptions, Track, acoustics_of, fixes_of, write_track
from rovgraph.report.export.track import ESTIMATES as TRACKS

if TYPE_CHECKING:
    from rovgraph.report.figures import Plot

ENGINES = ("batch", "isam2")
ESTIMATES = ("smoothed", "filtered", "both")


VERDICT_COLOURS = {"trusted": "#00795a", "doubtful": "#b45309", "wrong": "#b91c1c"}
MAP_PX, MAP_POINTS = 200, 400


def _map(p_n: Array) -> str:
    """A track of shape (n, 2), north and east, as an SVG picture with its length of side."""
    known = p_n[np.isfinite(p_n).all(axis=1)]
    if not len(known):
        return ""
    some = known[np.unique(np.linspace(0, len(known) - 1, MAP_POINTS).astype(int))]
    side = max(float(np.ptp(some, axis=0).max()), 1e-3)
    middle, scale = 0.5 * (some.max(axis=0) + some.min(axis=0)), 0.9 * MAP_PX / side
    north, east = ((some - middle) * scale).T
    x, y = 0.5 * MAP_PX + east, 0.5 * MAP_PX - north
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    ends = "".join(
        f'<circle cx="{x[k]:.1f}" cy="{y[k]:.1f}" r="4" fill="{colour}"><title>{name}</title></circle>'
        for k, colour, name in ((0, "#0072b2", "begin"), (-1, "#d55e00", "end"))
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{MAP_PX}" height="{MAP_PX}" role="img" '
        f'aria-label="track, {side:.0f} m wide, north up" style="background:#fff;border:1px solid #ccc">'
        f'<polyline points="{points}" fill="none" stroke="#333" stroke-width="1.5"/>{ends}'
        f'<text x="4" y="{MAP_PX - 4}" font-size="10" fill="#333">{side:.0f} m, north up</text></svg>'
    )


FIGURES = ("png", "pdf", "svg")  # formats


@dataclass(frozen=True, repr=False)
class Result:
    """The estimates of a dive with verdict and alarms.

    Attributes
    ----------
    dive : estimates, assumptions, alarms and verdict
    log : the log that was estimated, with jumps of clocks bridged
    warnings : from reading and checking the log, a line each; also issued as `DataWarning`
    seconds : stage of the work -> wall time [s]; the command adds that of reading
    """

    dive: DiveEstimates
    log: Log
    warnings: tuple[str, ...]
    seconds: dict[str, float]

    def __repr__(self) -> str:
        return f"<Result of {self.log.source}: {self.verdict}, {len(self.alarms)} alarms>"

    def _repr_html_(self) -> str:
        """For notebooks: the verdict, the alarms and a small map of the main track, north up."""
        track, count = self.main.trajectory, len(self.alarms)
        sd = float(np.nanmax(np.hypot(*track.p_sd[:, :2].T), initial=0.0))
        facts = f"{track.time[-1] - track.time[0]:.0f} s, {track.distance:.0f} m, horizontal sd up to {sd:.2f} m"
        alarms = "".join(f"<li>{escape(alarm.text)}</li>" for alarm in self.alarms)
        plural = "" if count == 1 else "s"
        return (
            f'<div style="display:flex;gap:1em;align-items:flex-start">{_map(track.p_n[:, :2])}<div>'
            f'<b style="color:{VERDICT_COLOURS[self.verdict]}">{self.verdict}</b> '
            f"{escape(Path(self.log.source).name)}<br>{escape(self.main.kind)}: {facts}<br>"
            f"{count} alarm{plural}<ul>{alarms}</ul></div></div>"
        )

    @property
    def smoothed(self) -> Estimate:
        """The smoothed estimate: the best for every moment, from the whole dive.

        Raises
        ------
        InputError : it was not requested
        """
        return self._estimate("smoothed")

    @property
    def filtered(self) -> Estimate:
        """The filtered estimate: what could have been known at each moment.

        Raises
        ------
        InputError : it was not requested
        """
        return self._estimate("filtered")

    @property
    def dead_reckoning(self) -> Estimate:
        """Dead reckoning, the baseline."""
        return self._estimate("dead_reckoning")

    @property
    def main(self) -> Estimate:
        """The smoothed estimate, or the filtered one if you requested only that."""
        return self.dive.estimates[0]

    @property
    def calibration(self) -> Mapping[str, CalibrationEstimate]:
        """Label of each scalar component -> its value, sd, prior and verdict in the main estimate; SI."""
        return {entry.label: entry for entry in self.main.calibration}

    @property
    def verdict(self) -> Verdict:
        """trusted, doubtful or wrong."""
        return self.dive.verdict

    @property
    def alarms(self) -> Sequence[Alarm]:
        """Alarms, causes before their consequences; ``.text`` has cause and remedy."""
        return self.dive.alarms

    @property
    def advice(self) -> Sequence[Alarm]:
        """Advice on values that could be stated better: no evidence of error, and no part of the verdict."""
        return self.dive.advice

    @property
    def assumptions(self) -> Sequence[str]:
        """Assumptions beyond log and configuration, and how native files were read, a line each."""
        return (*self.log.notes, *self.dive.assumptions)

    @property
    def config(self) -> Config:
        """The effective configuration."""
        return self.dive.initial.config

    @property
    def bottom(self) -> Bottom | None:
        """The bottom under the main track, by the DVL's ranges: soundings, altitude, slope; None without ranges."""
        return bottom_of(self.log, self.config, self.main)

    @property
    def plot(self) -> "Plot":
        """Depth, heading, track and more on matplotlib axes: ``result.plot.depth(axes)``; see `Plot`."""
        from rovgraph.report.figures import Plot  # loads matplotlib

        return Plot(self.main, self._estimate, self.log, self.config)

    def track(self, estimate: str | None = None) -> Track:
        """An estimate with its origin on Earth and its fixes, ready to be exported; None = the best available.

        Raises
        ------
        InputError : the result has no such estimate
        """
        if estimate not in (None, *TRACKS):
            raise InputError(f"estimate {estimate!r}: expected {', '.join(TRACKS)}")
        chosen = self.main if estimate is None else self._estimate(estimate)
        name = self.config.name or Path(self.log.source).name
        places = {entry.label: (entry.value, entry.sd) for entry in self.main.calibration}
        beacons = [str(beacon.name) for beacon in self.config.beacons]
        acoustics = acoustics_of(self.main.replies, places, beacons) if len(self.main.replies) else None
        fixes = fixes_of(self.main.residuals)
        bottom = bottom_of(self.log, self.config, chosen)
        soundings = None if bottom is None else bottom.soundings
        frame: Frame = "earth" if self.config.environment.frame == "earth" else "flat"
        return Track(
            name,
            chosen.kind,
            chosen.trajectory,
            self.log.origin,
            fixes,
            acoustics=acoustics,
            soundings=soundings,
            frame=frame,
        )

    def save(
        self,
        path: Path | str,
        force: bool = False,
        figures: bool | str = True,
        page: bool = True,
        export: str | Sequence[str] = (),
    ) -> dict[str, Any]:
        """Write the results folder of ``rovgraph smooth`` (docs/results.md), complete or not at all.

        Parameters
        ----------
        path : the folder to create
        force : replace an older results folder
        figures : "png", "pdf" or "svg", the format to draw them in; True = "png", False = none
        page : make report.html
        export : a further format to write the track in, or several

        Returns
        -------
        dict : what ``summary.json`` holds

        Raises
        ------
        InputError : the folder exists or cannot be written; an unknown format of figures; those of `rovgraph.export`
        """
        from rovgraph.live.marks import MARKS, marks_beside, write_marks
        from rovgraph.report.folder import results_folder
        from rovgraph.report.results import Remarks, write_results

        form = "png" if figures is True else figures or None
        if form not in (*FIGURES, None):
            raise InputError(f"figures {figures!r}: expected {', '.join(FIGURES)}, True or False")
        began = time.perf_counter()
        with results_folder(as_path(path, "path"), force, [Path(self.log.source)]) as folder:
            if form:
                from rovgraph.report.figures import draw_figures  # loads matplotlib

                draw_figures(folder, self.dive.estimates, self.log, self.config, form=form)
            if export:
                write_track(self.track(), as_texts(export, "export"), folder, ExportOptions())
            seconds = {**self.seconds, "total": sum(self.seconds.values()) + time.perf_counter() - began}
            summary = write_results(
                folder,
                self.dive.estimates,
                self.log,
                self.config,
                seconds,
                Remarks(self.assumptions, [*self.alarms, *self.advice], self.warnings),
                self.dive.frozen,
            )
            marks = marks_beside(Path(self.log.source), self.main.trajectory, self.log.origin)
            if marks:
                write_marks(folder / MARKS, marks)
            if page:
                from rovgraph.report.pages.reporting import write_page

                write_page(folder)
            return summary

    def report(self, out: Path | str = "report.html", force: bool = False) -> Path:
        """Write only the dive's page, the one that `save` puts into the results folder.

        Parameters
        ----------
        out : the page
        force : replace an older file

        Returns
        -------
        Path : the page

        Raises
        ------
        InputError : the page exists, or cannot be written
        """
        from tempfile import TemporaryDirectory

        from rovgraph.api.reporting import free_page, report

        page = free_page(as_path(out, "out"), force, "out")
        with TemporaryDirectory() as temporary:
            folder = Path(temporary) / page.stem
            self.save(folder, figures=False, page=False)
            return report(folder, out=page, force=True)

    def _estimate(self, kind: str) -> Estimate:
        found = next((estimate for estimate in self.dive.estimates if estimate.kind == kind), None)
        if found is None:
            made = ", ".join(estimate.kind for estimate in self.dive.estimates)
            raise InputError(f"{self.log.source}: the {kind} estimate was not requested; the result has {made}")
        return found


def smooth(
    log: Log,
    config: Config | None = None,
    estimate: str = "both",
    engine: str | None = None,
    progress: Progress = no_progress,
) -> Result:
    """Estimate the track of a dive and the calibration of its instruments, as ``rovgraph smooth`` does.

    Parameters
    ----------
    log : as read with the configuration
    config : of vehicle and sensors; None = all defaults
    estimate : "smoothed", "filtered" or "both"
    engine : "batch", or "isam2" for both from one pass; None = the configuration's ``graph.solver``
    progress : called at times with the current task and its progress from 0 to 1

    Raises
    ------
    InputError : the log cannot be used, was read with other columns, or does not determine some variable

    Warns
    -----
    DataWarning : findings of the check
    """
    if estimate not in ESTIMATES:
        raise InputError(f"estimate {estimate!r}: expected {', '.join(ESTIMATES)}")
    config = with_engine(config_of(log, config), engine)
    began = time.perf_counter()
    with collected_warnings() as texts:
        log, findings = prepared(log, config)
        checked = time.perf_counter()
        dive = smooth_dive(log, config, estimate, progress, findings)
    seconds = {"checking": checked - began, "estimating": time.perf_counter() - checked}
    return Result(dive, log, (*log.warnings, *texts), seconds)


def with_engine(config: Config, engine: str | None) -> Config:
    """A configuration that is solved by an engine; None = its own.

    Raises
    ------
    InputError : no such engine
    """
    if engine is None:
        return config
    if engine not in ENGINES:
        raise InputError(f"engine {engine!r}: expected {', '.join(ENGINES)}")
    return config.with_values(graph={"solver": engine})
