"""``rovgraph plan``: what to drive to know the calibration."""

from pathlib import Path
from typing import Annotated

import typer


def plan(
    out: Annotated[Path, typer.Option("--out", "-o", help="results folder", show_default=False)],
    config: Annotated[Path | None, typer.Option("--config", "-c", help="configuration (YAML)")] = None,
    known: Annotated[Path | None, typer.Option(help="observability.json of an earlier dive; default: none")] = None,
    goal: Annotated[
        list[str] | None, typer.Option(help="wanted sd, such as dvl_yaw=1deg; may be repeated", metavar="NAME=SD")
    ] = None,
    duration: Annotated[float, typer.Option(help="duration of each manoeuvre in seconds")] = 120.0,
    manoeuvres: Annotated[
        str | None,
        typer.Option(help="scenarios, such as circle or circle@0.3 (m/s), separated by commas; default: all"),
    ] = None,
    estimate: Annotated[
        str | None, typer.Option(help="further calibration variables to estimate, separated by commas")
    ] = None,
    fix_interval: Annotated[float | None, typer.Option(help="seconds between position fixes; default: none")] = None,
    imu_rate: Annotated[float, typer.Option(help="rate of the IMU, 5 to 1000 Hz")] = 100.0,
    dvl_rate: Annotated[float, typer.Option(help="rate of the DVL's pings, 0.1 to 50 Hz")] = 5.6,
    force: Annotated[bool, typer.Option("--force", help="replace an older results folder")] = False,
) -> None:
    """Rank manoeuvres by how well they would determine the calibration, before the dive.

    Example: rovgraph plan --config vehicle.yaml --goal dvl_yaw=1deg --out plan
    """
    import rovgraph as rg
    from rovgraph.cli.console import console, say
    from rovgraph.cli.progress import progress_bar
    from rovgraph.report.folder import check_writable
    from rovgraph.report.narrow import fitting
    from rovgraph.report.observability import plan_table
    from rovgraph.studies.choices import goals
    from rovgraph.studies.plan import Sensors

    check_writable(out, force)
    sensors, wanted = Sensors(imu_rate, dvl_rate, fix_interval), goals(goal or [])
    settings = rg.load_config(config)
    with progress_bar() as progress:
        result = rg.plan(settings, wanted, known, duration, manoeuvres, estimate or (), sensors, progress)
    result.save(out, force)
    shown = console()
    for part in fitting(plan_table(result.plan, f"manoeuvres of {duration:g} s"), shown):
        shown.print(part)
    say(shown, f"results in {out}")
