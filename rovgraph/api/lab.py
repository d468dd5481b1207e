"""For researchers: the work of ``rovgraph study``, ``compare``, ``observe``, ``plan`` and ``calibrate``.

`study_misalignment` runs many simulated dives, `compare` sets estimators against each other, `observe` and `plan`
examine the observability of the calibration, and `calibrate_magnetometer`, `calibrate_noise` and `calibrate_dvl_beams`
make a piece of configuration from a log of their own.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from rovgraph.api.logs import config_of, prepared
from rovgraph.errors import InputError, as_path, collected_warnings, kind_of
from rovgraph.inference.trajectory import Trajectory
from rovgraph.lab import calibrate as library
from rovgraph.lab import compare as comparisons
from rovgraph.lab import executors
from rovgraph.lab.calibrate import BeamFit, MagnetometerCalibration, NoiseReport
from rovgraph.lab.choices import goals as read_goals
from rovgraph.lab.choices import listed, read_known
from rovgraph.lab.compare import Comparison
from rovgraph.lab.crosslines import CrosslinePlan, plan_crosslines, plan_crosslines_after, stated_relief
from rovgraph.lab.estimators import select
from rovgraph.lab.evaluate import read_reference
from rovgraph.lab.misalignment import Tables, chosen, open_results, read_study
from rovgraph.lab.misalignment import study as study_cells
from rovgraph.lab.misalignment.results import kept_so_far
from rovgraph.lab.observability import START_HEADING, Observability, estimating
from rovgraph.lab.observability import observe as observe_calibration
from rovgraph.lab.plan import CANDIDATES, KnownComponents, Plan, SensorRates, usual
from rovgraph.lab.plan import manoeuvres as candidates_of
from rovgraph.lab.plan import plan as ranked
from rovgraph.lab.runs import Case, Recorded, Run, Simulated
from rovgraph.lab.survey import Survey
from rovgraph.log import Log
from rovgraph.model.config import Config, beliefs, completed, config_or_defaults
from rovgraph.process import Progress, no_progress
from rovgraph.simulate.named import require_known


def study_misalignment(
    study: Path | str,
    out: Path | str,
    resume: bool = False,
    only: str | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: Progress = no_progress,
) -> Tables:
    """Study how well the DVL's misalignment can be estimated; every finished dive is saved at once.

    Parameters
    ----------
    study : YAML file of the study (docs/studies.md)
    out : results folder
    resume : continue with the files in the folder
    only : one cell, by the first characters of its id; None = all
    jobs : processes on this machine; None = one per core
    scheduler : address of a Dask cluster, such as ``tcp://host:8786``; None = this machine
    progress : called at times with the current task and its progress from 0 to 1

    Returns
    -------
    Tables : ``.runs``, ``.cells`` and ``.history``, also written into the folder

    Raises
    ------
    InputError : an invalid study, a folder that exists or holds another study, a cluster that does not answer,
        a full disk (what was written before is kept)
    """
    from rovgraph.report.figures_lab import draw_study
    from rovgraph.report.lab import write_study
    from rovgraph.report.pages.reporting import write_page

    plan = read_study(as_path(study, "study"))
    cells = chosen(plan, only)
    if scheduler is not None and jobs is not None:
        raise InputError("--jobs cannot be combined with --scheduler; the cluster decides the number of workers")
    engine = executors.Local(jobs) if scheduler is None else executors.Cluster(scheduler)
    folder = as_path(out, "out")
    results = open_results(folder, plan, resume)
    began = time.perf_counter()
    tables = study_cells(plan, results, cells, engine, lambda done: progress("making dives", done))
    with kept_so_far(folder):  # its rows are on disk already
        write_study(folder, tables, {"scheduler": scheduler, "seconds": time.perf_counter() - began})
        draw_study(folder, tables)
        write_page(folder)
    return tables


SEEDS = range(1, 31)
THESIS = "vattern"  # the scenario of the thesis, whose numbers are shown beside ours


class LabResult:
    """What a command of the lab found; it can be saved as a results folder."""

    def save(self, path: Path | str, force: bool = False) -> None:
        """Write the folder of the command, with its page, complete or not at all.

        Raises
        ------
        InputError : the folder exists and ``force`` is not given, or cannot be written; it holds an input
        """
        from rovgraph.report.folder import results_folder
        from rovgraph.report.pages.reporting import write_page

        with results_folder(as_path(path, "path"), force, self._inputs) as folder:
            self._write(folder)
            write_page(folder)

    def _write(self, folder: Path) -> None:
        raise NotImplementedError

    @property
    def _inputs(self) -> list[Path]:
        """Files that the folder must not replace."""
        return []


@dataclass(frozen=True)
class ComparisonResult(LabResult):
    """Errors, consistency and cost of each estimator.

    Attributes
    ----------
    comparison : all tables; docs/compare.md describes their columns
    title : log or scenario
    thesis : whether the thesis has numbers for it
    about : its inputs, for ``summary.json``
    """

    comparison: Comparison
    title: str
    thesis: bool
    about: dict[str, Any]

    @property
    def table(self) -> pd.DataFrame:
        """A row per estimator."""
        return self.comparison.table

    def _write(self, folder: Path) -> None:
        """The files of ``rovgraph compare`` (docs/compare.md)."""
        from rovgraph.report.figures_lab import draw_comparison
        from rovgraph.report.lab import write_comparison

        draw_comparison(folder, self.comparison, self.title, self.thesis)
        write_comparison(folder, self.comparison, self.about)


def compare(
    log: Log | None = None,
    config: Config | None = None,
    reference: Trajectory | Path | str | None = None,
    scenario: str | None = None,
    seeds: Sequence[int] = SEEDS,
    duration: float | None = None,
    estimators: str | Sequence[str] | None = None,
    jobs: int | None = None,
    progress: Progress = no_progress,
) -> ComparisonResult:
    """Run estimators on a log with its reference, or on many simulated dives.

    Parameters
    ----------
    log : as read with the configuration
    config : of vehicle and sensors; None = all defaults, or the scenario's
    reference : the track that the log's estimates are compared with, or its file
    scenario : simulate dives of this one instead of a log
    seeds : of the simulated dives
    duration : of a simulated dive [s]; None = the scenario's
    estimators : names or patterns, such as "graph-*", a list or separated by commas; None = all that need no thrusters
    jobs : processes; None = one per core
    progress : called at times with the current task and its progress from 0 to 1

    Raises
    ------
    InputError : neither or both of log and scenario, an unknown estimator, a log that cannot be used

    Warns
    -----
    DataWarning : findings of the check
    """
    names = None if estimators is None else listed(estimators)
    select(names)
    require_one(log, reference, scenario, seeds, duration)
    runs: list[Run]
    about: dict[str, Any]
    if scenario is not None:
        require_known(scenario)
        runs = [Simulated(scenario, seed, config, duration) for seed in seeds]
        about = {"scenario": scenario, "seeds": [*seeds], "duration_s": duration}
        title = f"{scenario}, {len(seeds)} seeds"
    else:
        assert log is not None
        assert reference is not None
        config, title, about = config_of(log, config), Path(log.source).name, {"log": log.source}
        if isinstance(reference, Path | str):
            about["reference"] = str(reference)
            reference = read_reference(reference)
        if not isinstance(reference, Trajectory):
            raise InputError(f"reference: expected a path or a Trajectory, found {kind_of(reference)}")
        runs = [Recorded(title, Case(prepared(log, config)[0], config, reference))]
    began = time.perf_counter()
    comparison = comparisons.compare(runs, names, jobs, lambda done: progress("comparing", done))
    about["seconds"] = time.perf_counter() - began
    return ComparisonResult(comparison, title, scenario == THESIS, about)


def require_one(
    log: object, reference: object, scenario: str | None, seeds: Sequence[int], duration: float | None
) -> None:
    """Either a log with its reference, or a scenario.

    Raises
    ------
    InputError : anything else
    """
    if (log is None) == (scenario is None):
        raise InputError("compare wants either a log with its reference, or a scenario to simulate")
    if scenario is not None:
        if reference is not None:
            raise InputError("a reference goes with a log; a simulated dive has its own")
        if not (isinstance(seeds, Sequence) and len(seeds)):
            raise InputError(f"seeds: expected a list or range of at least one, found {seeds!r}")
        return
    if duration is not None:
        raise InputError("a duration goes with a scenario; a log has its own")
    if reference is None:
        source = log.source if isinstance(log, Log) else log
        raise InputError(f"{source}: a reference (CSV with time, north, east) is needed to compare with")


DURATION_S, SURVEY_S = 120.0, 900.0  # of a manoeuvre, and of one that survey crews do
USUAL = SensorRates()


@dataclass(frozen=True)
class ObservabilityResult(LabResult):
    """The observability of the calibration in a dive.

    Attributes
    ----------
    observability : sd before and after, correlations, and sd against time
    config : of vehicle and sensors, including the variables estimated
    warnings : findings on the log, a line each
    about : its inputs, for ``summary.json``
    crosslines : what they would show of the track's drift, if that was asked
    """

    observability: Observability
    config: Config
    warnings: tuple[str, ...]
    about: Mapping[str, Any]
    crosslines: CrosslinePlan | None = None

    @property
    def verdicts(self) -> Mapping[str, str]:
        """Label of each component -> observable, weak or unobservable."""
        return dict(zip(self.observability.labels, self.observability.verdicts, strict=True))

    def _write(self, folder: Path) -> None:
        """The files of ``rovgraph observe`` (docs/observability.md)."""
        from rovgraph.report.figures_lab import draw_observability
        from rovgraph.report.lab import write_observability

        draw_observability(folder, self.observability)
        write_observability(folder, self.observability, self.config, self.about, self.crosslines)


@dataclass(frozen=True)
class PlanResult(LabResult):
    """Manoeuvres, ranked by the information they would add, and a survey with crosslines.

    Attributes
    ----------
    plan : the manoeuvres, the best first; None where only a survey was asked about
    config : of vehicle and sensors
    about : its inputs, for ``summary.json``
    crosslines : what they would leave of the survey's drift, if that was asked
    """

    plan: Plan | None
    config: Config
    about: Mapping[str, Any]
    crosslines: CrosslinePlan | None = None

    def _write(self, folder: Path) -> None:
        """The files of ``rovgraph plan`` (docs/observability.md)."""
        from rovgraph.report.figures_lab import draw_plan
        from rovgraph.report.lab import write_plan

        if self.plan is not None:
            draw_plan(folder, self.plan)
        write_plan(folder, self.plan, self.config, self.about, self.crosslines)


def observe(
    log: Log,
    config: Config | None = None,
    estimate: str | Sequence[str] = (),
    progress: Progress = no_progress,
    crosslines: bool = False,
    relief: tuple[float, float] | None = None,
) -> ObservabilityResult:
    """Determine how well a dive shows each calibration variable, when it did, and what is missing.

    Parameters
    ----------
    log : as read with the configuration
    config : of vehicle and sensors; None = all defaults
    estimate : calibration variables to estimate beside those of the configuration, a list or "dvl_yaw,dvl_scale"
    progress : called at times with the current task and its progress from 0 to 1
    crosslines : predict what crosslines would show of the track's drift, too
    relief : sd and correlation length of the bottom's relief for that, where the log has no ranges [m]; None =
        0.35 over 4.5

    Raises
    ------
    InputError : an unknown variable, one whose sensor is not used, no variable at all, a log that cannot be used; a
        dive that crosslines cannot be planned for

    Warns
    -----
    DataWarning : findings of the check
    """
    estimate = listed(estimate)
    config = estimating(config_of(log, config), estimate)
    _relief_for(relief, crosslines, "crosslines")
    with collected_warnings() as texts:
        log, _ = prepared(log, config)
        seen = observe_calibration(log, config, estimate, progress)
        crossed = plan_crosslines_after(log, config, relief, progress) if crosslines else None
    about = {"log": log.source, "estimate": [*estimate]}
    return ObservabilityResult(seen, config, (*log.warnings, *texts), about, crossed)


def _relief_for(relief: tuple[float, float] | None, asked: bool, what: str) -> None:
    """Refuse relief that is none, or is not asked for."""
    stated_relief(relief)
    if relief is not None and not asked:
        raise InputError(f"relief {relief[0]:g} {relief[1]:g}: it goes with {what}")


def plan(
    config: Config | None = None,
    goals: Mapping[str, float] | Sequence[str] | None = None,
    known: ObservabilityResult | Path | str | None = None,
    duration: float | None = None,
    manoeuvres: str | Sequence[str] | None = None,
    estimate: str | Sequence[str] = (),
    sensors: SensorRates = USUAL,
    progress: Progress = no_progress,
    survey: str | None = None,
    relief: tuple[float, float] | None = None,
) -> PlanResult:
    """Rank manoeuvres by how well they would determine the calibration, or crosslines by what they leave of the drift.

    A survey by itself asks about crosslines; with goals, known, duration or manoeuvres about these, too.

    Parameters
    ----------
    config : of vehicle and sensors; None = all defaults
    goals : label of a component -> wanted sd, radians and SI; or texts such as "dvl_yaw=1deg"; what the configuration
        considers is estimated where it is a goal
    known : result of an earlier dive, or its ``observability.json``; None = none
    duration : of each manoeuvre [s]; None = 120, or 900 where a goal is acoustic or the heading
    manoeuvres : scenarios, such as "circle" or "circle@0.3" (m/s); None = all that serve the goals
    estimate : calibration variables to estimate beside those of the configuration, a list or "dvl_yaw,dvl_scale"
    sensors : their rates
    progress : called at times with the current task and its progress from 0 to 1
    survey : "8x250x25@1" for 8 lines of 250 m, 25 m apart, at 1 m/s, the first towards `start.heading_deg` or north;
        None = no survey
    relief : sd and correlation length of the bottom's relief under it [m]; None = 0.35 over 4.5

    Raises
    ------
    InputError : an unknown manoeuvre or variable, nothing to estimate, a goal for a variable that is not estimated; no
        such survey, or sensors that show places in it
    """
    wanted = read_goals(goals)
    config = config_or_defaults(config)
    considered = [name for name, b in beliefs(config).items() if b.considered and {*b.variable.labels} & {*wanted}]
    config = estimating(config, [*listed(estimate), *considered])
    _relief_for(relief, survey is not None, "a survey")
    lines = None if survey is None else Survey.planned(survey, config)
    result, about = None, dict[str, Any]()
    if lines is None or wanted or manoeuvres or known is not None or duration is not None:
        result, about = _ranked_manoeuvres(config, wanted, known, duration, manoeuvres, sensors, progress)
    crossed = None if lines is None else plan_crosslines(lines, config, sensors, stated_relief(relief), progress)
    about |= {"fix_interval_s": sensors.fix_interval, **({} if survey is None else {"survey": survey})}
    return PlanResult(result, config, about, crossed)


def _ranked_manoeuvres(
    config: Config,
    wanted: Mapping[str, float],
    known: ObservabilityResult | Path | str | None,
    duration: float | None,
    manoeuvres: str | Sequence[str] | None,
    sensors: SensorRates,
    progress: Progress,
) -> tuple[Plan, dict[str, Any]]:
    """Manoeuvres of `plan`, and what they were ranked with."""
    names = usual(config, wanted)
    short = names == CANDIDATES and START_HEADING.name not in wanted
    duration = duration or (DURATION_S if short else SURVEY_S)
    candidates = candidates_of(listed(manoeuvres) or names, duration)
    before: KnownComponents | None
    if isinstance(known, ObservabilityResult):
        seen, source = known.observability, known.about["log"]
        before = KnownComponents(seen.labels, seen.covariance, seen.prior_sd)
    else:
        before, source = (None, None) if known is None else (read_known(as_path(known, "known")), str(known))
    result = ranked(config, candidates, duration, before, wanted, sensors, lambda done: progress("manoeuvres", done))
    return result, {"duration_s": duration, "known": source}


@dataclass(frozen=True)
class MagnetometerResult(LabResult):
    """Hard and soft iron of a magnetometer.

    Attributes
    ----------
    found : centre, matrix, disturbances, and how well the samples fit
    config : the configuration to which the calibration is added
    """

    found: MagnetometerCalibration
    config: Config

    def _write(self, folder: Path) -> None:
        """The files of ``rovgraph calibrate magnetometer`` (docs/calibration.md)."""
        from rovgraph.report.calibrations import write_magnetometer

        write_magnetometer(folder, self.found, self.config)

    @property
    def _inputs(self) -> list[Path]:
        return [Path(self.found.source)]


@dataclass(frozen=True)
class NoiseResult(LabResult):
    """Noise of the sensors at rest.

    Attributes
    ----------
    found : channels with densities and bias instability, lines in the spectra, remarks
    config : the configuration to which the noise is added
    """

    found: NoiseReport
    config: Config

    def _write(self, folder: Path) -> None:
        """The files of ``rovgraph calibrate noise`` (docs/calibration.md)."""
        from rovgraph.report.calibrations import write_noise

        write_noise(folder, self.found, self.config)

    @property
    def _inputs(self) -> list[Path]:
        return [Path(self.found.source)]


def calibrate_magnetometer(
    log: Log, config: Config | None = None, method: library.Method = "ellipsoid"
) -> MagnetometerResult:
    """Determine hard and soft iron from a log in which the vehicle turns about all its axes.

    Parameters
    ----------
    log : read with the configuration's ``with_raw_magnetometer()``, so that its samples are uncorrected
    config : of vehicle and sensors; None = all defaults
    method : "ellipsoid", or "turns" for a turn about z and one about x

    Raises
    ------
    InputError : no magnetometer, too few samples, samples that are calibrated already, or too little turning
    """
    config = config_or_defaults(config)
    raw = config.with_raw_magnetometer()
    if isinstance(log, Log) and log.config is not None and log.config.imu.mag != raw.imu.mag:
        raise InputError(
            f"{log.source}: its magnetometer was calibrated as it was read; read it with config.with_raw_magnetometer()"
        )
    found = library.calibrate_magnetometer(log, config_of(log, raw), method)
    return MagnetometerResult(found, _completed(config, log))


def calibrate_noise(log: Log, config: Config | None = None) -> NoiseResult:
    """Determine the noise of IMU, DVL and compasses from a log at rest.

    Parameters
    ----------
    log : as read with the configuration; the vehicle is at rest in it, waves are tolerated
    config : of vehicle and sensors; None = all defaults

    Raises
    ------
    InputError : the vehicle moves, the log is too short, or ``rovgraph[calibrate]`` is not installed
    """
    config = config_of(log, config)
    return NoiseResult(library.calibrate_noise(log, config), config)


def calibrate_dvl_beams(log: Log, config: Config | None = None) -> BeamFit:
    """Determine where the beams of a DVL point, from a log with velocities along them and along the DVL's axes.

    Parameters
    ----------
    log : as read with the configuration; the vehicle moves forward and sideways in it
    config : of vehicle and sensors; None = all defaults

    Returns
    -------
    BeamFit : ``angle_deg``, ``azimuth_deg``, their sds and the residual; ``to_yaml()`` for a configuration

    Raises
    ------
    InputError : no beams or no velocity, or a dive that does not show where they point
    """
    return library.calibrate_dvl_beams(log, config_of(log, config))


def _completed(config: Config, log: Log) -> Config:
    return completed(config, log.settings, f"settings in {log.source}")[0]
