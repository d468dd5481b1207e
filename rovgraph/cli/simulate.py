"""``rovgraph simulate``: a dive whose truth is known."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rovgraph import SimulatedDive


def simulate(
    scenario: Annotated[
        str,
        typer.Argument(
            help="driven by thrusters: vattern, docking, excited, tank, stationary; "
            "prescribed motions: falcon, lawnmower, square, circle, figure8, straight, accelerate-and-stop, spiral",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option(help="folder to create", show_default=False)],
    seed: Annotated[int, typer.Option(min=0, help="seed: the same one gives the same dive")] = 1,
    duration: Annotated[float | None, typer.Option(help="duration in seconds; default: the scenario's")] = None,
    speed: Annotated[float | None, typer.Option(help="speed in m/s; default: the scenario's")] = None,
    variant: Annotated[
        str | None,
        typer.Option(
            help="vattern: run 1, 2 or 3, default by the seed; tank: raw or calibrated; stationary: land or water"
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(help="configuration (YAML); default: the thesis's Falcon if driven by thrusters, else defaults"),
    ] = None,
    current: Annotated[
        tuple[float, float] | None,
        typer.Option(help="current, north and east in m/s; default: drawn", metavar="NORTH EAST", show_default=False),
    ] = None,
    disturbances: Annotated[
        bool | None,
        typer.Option(
            "--disturbances/--no-disturbances", help="iron on the seabed; default: in a lake", show_default=False
        ),
    ] = None,
    outliers: Annotated[float, typer.Option(help="share of DVL pings that are wrong, 0 to 1")] = 0.0,
    dropout: Annotated[
        list[str] | None,
        typer.Option(help="seconds without bottom lock, such as 100:130; may be repeated", metavar="FROM:TO"),
    ] = None,
    place: Annotated[
        list[str] | None,
        typer.Option(
            help="a place that a camera recognises, in m, such as 10:-5; may be repeated", metavar="NORTH:EAST"
        ),
    ] = None,
    false_places: Annotated[float, typer.Option(help="share of the camera's matches that are false, below 1")] = 0.0,
    noise: Annotated[bool, typer.Option("--noise/--no-noise", help="noise, biases and drawn calibration")] = True,
    force: Annotated[bool, typer.Option("--force", help="replace an older folder")] = False,
) -> None:
    """Simulate a dive: log.csv, the truth, and the configuration for an estimator.

    For a prescribed motion, the truth of what the configuration estimates is drawn from its priors.
    A driven scenario has a world of its own (docs/simulation.md).

    Example: rovgraph simulate vattern --seed 7 --out dive
    """
    import rovgraph as rg
    from rovgraph.report.folder import check_writable

    check_writable(out, force)
    given = None if config is None else rg.load_config(config)
    choices = rg.Choices(
        duration=duration,
        speed=speed,
        variant=variant,
        current=current,
        disturbances=disturbances,
        outliers=outliers,
        dropouts=tuple(_pair(text) for text in dropout or ()),
        places=tuple(_pair(text) for text in place or ()),
        false_places=false_places,
        noise=noise,
    )
    dive = rg.simulate(scenario, given, seed, choices)
    dive.save(out, force)
    _show(out, dive)


def _pair(text: str) -> tuple[float, float]:
    """Two numbers with a colon between them; not a number where they are none."""
    first, _, second = text.partition(":")
    try:
        return float(first), float(second)
    except ValueError:
        return float("nan"), float("nan")


def _show(out: Path, dive: "SimulatedDive") -> None:
    """The table that the command prints."""
    from rich.table import Table

    from rovgraph.cli.console import console

    figures = dive.figures
    table = Table("", "", title=f"Simulated dive in {out}", show_header=False)
    table.add_row("scenario, seed", f"{dive.scenario}, {dive.seed}")
    table.add_row("duration, distance", f"{figures['duration_s']:.1f} s, {figures['distance_m']:.1f} m")
    table.add_row("extent", "{:.1f} m north, {:.1f} m east, {:.1f} m depth".format(*figures["extent_m"]))
    for sensor, count in figures["measurements"].items():
        table.add_row(sensor, f"{count} measurements")
    table.add_row("log", f"{len(dive.dive.log_frame)} rows in log.csv")
    console().print(table)
