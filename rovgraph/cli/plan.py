"""``rovgraph plan``: what to drive to know the calibration."""

from pathlib import Path
from typing import Annotated

import typer


def plan(
    out: Annotated[Path, typer.Option("--out", "-o", help="results folder", show_default=False)],
    config: Annotated[Path | None, typer.Option("--config", "-c", help="configuration (YAML)")] = None,
    known: Annotated[
        Path | None, typer.Option(help="observability.json of a dive before; default: nothing is known")
    ] = None,
    goal: Annotated[
        list[str] | None, typer.Option(help="sd that is wanted, as dvl_yaw=1deg; may be repeated", metavar="NAME=SD")
    ] = None,
    duration: Annotated[float, typer.Option(help="of each manoeuvre [s]")] = 120.0,
    manoeuvres: Annotated[
        str | None, typer.Option(help="scenarios, as circle or circle@0.3 (m/s), separated by commas; default: all")
    ] = None,
    estimate: Annotated[
        str | None, typer.Option(help="calibration variables to estimate too, separated by commas")
    ] = None,
    fix_interval: Annotated[float | None, typer.Option(help="between position fixes [s]; default: none")] = None,
    imu_rate: Annotated[float, typer.Option(min=5.0, max=1000.0, help="of the IMU [Hz]")] = 100.0,
    dvl_rate: Annotated[float, typer.Option(min=0.1, max=50.0, help="of the DVL's pings [Hz]")] = 5.6,
    force: Annotated[bool, typer.Option("--force", help="replace an older results folder")] = False,
) -> None:
    """Rank manoeuvres by what they would show of the calibration, before any is made.

    Example: rovgraph plan --config vehicle.yaml --goal dvl_yaw=1deg --out plan
    """
    from rich.console import Console

    from rovgraph.cli.progress import progress_bar
    from rovgraph.config import load_config
    from rovgraph.errors import InputError
    from rovgraph.report.figure_plan import draw_plan
    from rovgraph.report.folder import check_writable, results_folder
    from rovgraph.report.observability import plan_table, write_plan
    from rovgraph.studies.choices import goals, listed, read_known
    from rovgraph.studies.manoeuvres import manoeuvres as chosen
    from rovgraph.studies.observability import estimating
    from rovgraph.studies.plan import Sensors
    from rovgraph.studies.plan import plan as library

    check_writable(out, force)
    if fix_interval is not None and not fix_interval > 0.0:
        raise InputError(f"--fix-interval {fix_interval}: more than 0 s is expected")
    wanted, also = goals(goal or []), listed(estimate)
    settings = estimating(load_config(config), also)
    candidates = chosen(listed(manoeuvres) or None, duration)
    before = None if known is None else read_known(known)
    with progress_bar() as progress:
        result = library(
            settings,
            candidates,
            duration,
            before,
            wanted,
            Sensors(imu_rate, dvl_rate, fix_interval),
            lambda done: progress("manoeuvres", done),
        )
    about = {"duration_s": duration, "known": None if known is None else str(known), "fix_interval_s": fix_interval}
    with results_folder(out, force) as folder:
        draw_plan(folder, result)
        write_plan(folder, result, settings, about)
    console = Console()
    console.print(plan_table(result, f"manoeuvres of {duration:g} s"))
    console.print(f"results in {out}", highlight=False, markup=False)
