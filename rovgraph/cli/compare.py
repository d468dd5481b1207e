"""``rovgraph compare``: estimators against each other, on one log or on many simulated dives."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rovgraph.config import Config
    from rovgraph.studies.runs import Run

WIDE = 120  # columns of a file or a pipe, which has no width of its own
THESIS = "vattern"  # the scenario of the thesis, whose numbers are shown beside ours


def compare(
    out: Annotated[Path, typer.Option("--out", "-o", help="results folder", show_default=False)],
    log: Annotated[Path | None, typer.Argument(help="CSV, CSV.gz or Parquet, see docs/log-format.md")] = None,
    config: Annotated[Path | None, typer.Option("--config", "-c", help="configuration (YAML)")] = None,
    reference: Annotated[Path | None, typer.Option(help="CSV with time, north, east and what else it knows")] = None,
    scenario: Annotated[str | None, typer.Option(help="simulate dives of this scenario instead of a LOG")] = None,
    seeds: Annotated[int, typer.Option(help="number of simulated dives")] = 30,
    first_seed: Annotated[int, typer.Option(min=0, help="seed of the first of them")] = 1,
    duration: Annotated[float | None, typer.Option(help="of a simulated dive [s]; default: the scenario's own")] = None,
    estimators: Annotated[
        str | None,
        typer.Option(help="names or patterns (graph-*), separated by commas; default: all that need no thrusters"),
    ] = None,
    jobs: Annotated[int | None, typer.Option(help="processes; default: one per core")] = None,
    force: Annotated[bool, typer.Option("--force", help="replace an older results folder")] = False,
) -> None:
    """Compare estimators: errors, consistency and cost of each, in a table and figures.

    Example: rovgraph compare --scenario vattern --seeds 30 --out comparison
    """
    import time

    from rich.console import Console

    from rovgraph.cli.progress import progress_bar
    from rovgraph.config import load_config
    from rovgraph.report.comparison import comparison_table, write_comparison
    from rovgraph.report.figure_compare import draw_comparison
    from rovgraph.report.folder import check_writable, results_folder
    from rovgraph.studies.compare import compare as library
    from rovgraph.studies.estimators import select

    names = None if estimators is None else [name.strip() for name in estimators.split(",") if name.strip()]
    select(names)
    check_writable(out, force)
    settings = None if config is None else load_config(config)
    runs, about, title = _runs(log, reference, scenario, settings, range(first_seed, first_seed + seeds), duration)
    began = time.perf_counter()
    with progress_bar() as progress:
        comparison = library(runs, names, jobs, lambda done: progress("comparing", done))
    about["seconds"] = time.perf_counter() - began
    with results_folder(out, force) as folder:
        draw_comparison(folder, comparison, title, scenario == THESIS)
        write_comparison(folder, comparison, about)
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDE)
    console.print(comparison_table(comparison, title, thesis=scenario == THESIS))
    for row in comparison.runs.dropna(subset="error").drop_duplicates("estimator").itertuples():
        console.print(f"{row.estimator} failed on {row.run}: {row.error}", highlight=False, markup=False)
    console.print(f"results in {out}", highlight=False, markup=False)


def _runs(
    log: Path | None,
    reference: Path | None,
    scenario: str | None,
    settings: "Config | None",
    seeds: range,
    duration: float | None,
) -> tuple[list["Run"], dict[str, Any], str]:
    """The runs that were asked for, what summary.json says of them, and a title."""
    from rovgraph.errors import InputError

    if (log is None) == (scenario is None):
        raise InputError("compare wants either a LOG with its --reference, or a --scenario to simulate")
    if scenario is not None:
        return _simulated(scenario, settings, seeds, duration, reference)
    assert log is not None
    if duration is not None:
        raise InputError("--duration goes with --scenario; a LOG has its own")
    if reference is None:
        raise InputError(f"{log}: a --reference (CSV with time, north, east) is needed to compare with")
    return _recorded(log, reference, settings)


def _simulated(
    scenario: str, settings: "Config | None", seeds: range, duration: float | None, reference: Path | None
) -> tuple[list["Run"], dict[str, Any], str]:
    from rovgraph.errors import InputError
    from rovgraph.studies.runs import Simulated

    if reference is not None:
        raise InputError("--reference goes with a LOG; a simulated dive has its own")
    if not seeds:
        raise InputError("--seeds: at least 1 is expected")
    runs: list[Run] = [Simulated(scenario, seed, settings, duration) for seed in seeds]
    about = {"scenario": scenario, "seeds": list(seeds), "duration_s": duration}
    return runs, about, f"{scenario}, {len(seeds)} seeds"


def _recorded(log: Path, reference: Path, settings: "Config | None") -> tuple[list["Run"], dict[str, Any], str]:
    from rovgraph import check
    from rovgraph.config import Config
    from rovgraph.evaluate import read_reference
    from rovgraph.log import read_log
    from rovgraph.studies.runs import Case, Recorded

    settings = settings or Config()
    recorded = read_log(
        log,
        settings.columns,
        settings.units,
        settings.imu.mag.calibrated,
        settings.delay_s,
        settings.environment.origin,
    )
    recorded = check.bridge_jumps(recorded, settings)
    check.warn(recorded, settings)
    case = Case(recorded, settings, read_reference(reference))
    return [Recorded(log.name, case)], {"log": str(log), "reference": str(reference)}, log.name
