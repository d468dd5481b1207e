"""Observability of the calibration: what ``rovgraph observe`` and ``rovgraph plan`` do."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rovgraph.api.logs import given, prepared
from rovgraph.config import Config, config_or_defaults
from rovgraph.errors import as_path, collected_warnings
from rovgraph.log import Log
from rovgraph.progress import Progress, no_progress
from rovgraph.studies.observability import observe as observe_calibration
from rovgraph.studies.choices import goals as read_goals
from rovgraph.studies.choices import listed, read_known
from rovgraph.studies.manoeuvres import manoeuvres as candidates_of
from rovgraph.studies.observability import Observability, estimating
from rovgraph.studies.plan import Known, Plan, Sensors
from rovgraph.studies.plan import plan as ranked

DURATION_S = 120.0  # of a manoeuvre
USUAL = Sensors()


@dataclass(frozen=True)
class ObservabilityResult:
    """The observability of the calibration in a dive.

    Attributes
    ----------
    observability : sd before and after, correlations, and sd against time
    config : of vehicle and sensors, including the variables estimated
    warnings : findings on the log, a line each
    about : its inputs, for ``summary.json``
    """

    observability: Observability
    config: Config
    warnings: tuple[str, ...]
    about: Mapping[str, Any]

    @property
    def verdicts(self) -> Mapping[str, str]:
        """Label of each component -> observable, weak or unobservable."""
        return dict(zip(self.observability.labels, self.observability.verdicts, strict=True))

    def save(self, path: Path | str, force: bool = False) -> None:
        """Write the folder of ``rovgraph observe`` (docs/observability.md), complete or not at all.

        Raises
        ------
        InputError : the folder exists and ``force`` is not given, or cannot be written
        """
        from rovgraph.pages.reporting import write_page
        from rovgraph.report.figure_observability import draw_observability
        from rovgraph.report.folder import results_folder
        from rovgraph.report.observability import write_observability

        with results_folder(as_path(path, "path"), force) as folder:
            draw_observability(folder, self.observability)
            write_observability(folder, self.observability, self.config, self.about)
            write_page(folder)


@dataclass(frozen=True)
class PlanResult:
    """Manoeuvres, ranked by the information they would add.

    Attributes
    ----------
    plan : the manoeuvres, the best first
    config : of vehicle and sensors
    about : its inputs, for ``summary.json``
    """

    plan: Plan
    config: Config
    about: Mapping[str, Any]

    def save(self, path: Path | str, force: bool = False) -> None:
        """Write the folder of ``rovgraph plan`` (docs/observability.md), complete or not at all.

        Raises
        ------
        InputError : the folder exists and ``force`` is not given, or cannot be written
        """
        from rovgraph.pages.reporting import write_page
        from rovgraph.report.figure_plan import draw_plan
        from rovgraph.report.folder import results_folder
        from rovgraph.report.observability import write_plan

        with results_folder(as_path(path, "path"), force) as folder:
            draw_plan(folder, self.plan)
            write_plan(folder, self.plan, self.config, self.about)
            write_page(folder)


def observe(
    log: Log, config: Config | None = None, estimate: str | Sequence[str] = (), progress: Progress = no_progress
) -> ObservabilityResult:
    """Determine how well a dive shows each calibration variable, when it did, and what is missing.

    Parameters
    ----------
    log : as read with the configuration
    config : of vehicle and sensors; None = all defaults
    estimate : calibration variables to estimate beside those of the configuration, a list or "dvl_yaw,dvl_scale"
    progress : called at times with the current task and its progress from 0 to 1

    Raises
    ------
    InputError : an unknown variable, one whose sensor is not used, no variable at all, a log that cannot be used

    Warns
    -----
    DataWarning : findings of the check
    """
    estimate = listed(estimate)
    config = estimating(given(log, config), estimate)
    with collected_warnings() as texts:
        log, _ = prepared(log, config)
        seen = observe_calibration(log, config, estimate, progress)
    about = {"log": log.source, "estimate": [*estimate]}
    return ObservabilityResult(seen, config, (*log.warnings, *texts), about)


def plan(
    config: Config | None = None,
    goals: Mapping[str, float] | Sequence[str] | None = None,
    known: ObservabilityResult | Path | str | None = None,
    duration: float = DURATION_S,
    manoeuvres: str | Sequence[str] | None = None,
    estimate: str | Sequence[str] = (),
    sensors: Sensors = USUAL,
    progress: Progress = no_progress,
) -> PlanResult:
    """Rank manoeuvres by how well they would determine the calibration, before the dive.

    Parameters
    ----------
    config : of vehicle and sensors; None = all defaults
    goals : label of a component -> wanted sd, radians and SI; or texts such as "dvl_yaw=1deg"
    known : result of an earlier dive, or its ``observability.json``; None = none
    duration : of each manoeuvre [s]
    manoeuvres : scenarios, such as "circle" or "circle@0.3" (m/s); None = all
    estimate : calibration variables to estimate beside those of the configuration, a list or "dvl_yaw,dvl_scale"
    sensors : their rates
    progress : called at times with the current task and its progress from 0 to 1

    Raises
    ------
    InputError : an unknown manoeuvre or variable, nothing to estimate, a goal for a variable that is not estimated
    """
    config = estimating(config_or_defaults(config), listed(estimate))
    candidates = candidates_of(listed(manoeuvres) or None, duration)
    wanted = read_goals(goals)
    before: Known | None
    if isinstance(known, ObservabilityResult):
        seen, source = known.observability, known.about["log"]
        before = Known(seen.labels, seen.covariance, seen.prior_sd)
    else:
        before, source = (None, None) if known is None else (read_known(as_path(known, "known")), str(known))
    result = ranked(config, candidates, duration, before, wanted, sensors, lambda done: progress("manoeuvres", done))
    about = {"duration_s": duration, "known": source, "fix_interval_s": sensors.fix_interval}
    return PlanResult(result, config, about)
