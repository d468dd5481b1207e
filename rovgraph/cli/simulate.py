"""``rovgraph simulate``: a dive whose truth is known."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rovgraph.simulate import Dive

LIMIT_S = 6 * 3600.0  # of a dive's duration: beyond it the log outgrows the memory


def simulate(
    scenario: Annotated[
        str, typer.Argument(help="falcon, lawnmower, square, circle, figure8, straight or vattern.", show_default=False)
    ],
    out: Annotated[Path, typer.Option(help="Folder to make.", show_default=False)],
    seed: Annotated[int, typer.Option(min=0, help="Seed: the same one gives the same dive.")] = 1,
    duration: Annotated[float | None, typer.Option(help="Duration in seconds; default: the scenario's own.")] = None,
    speed: Annotated[float | None, typer.Option(help="Speed in m/s; default: the scenario's own.")] = None,
    config: Annotated[Path | None, typer.Option(help="Configuration (YAML) of vehicle and sensors.")] = None,
    outliers: Annotated[float, typer.Option(help="Share of DVL pings that are wrong, 0 to 1.")] = 0.0,
    noise: Annotated[bool, typer.Option("--noise/--no-noise", help="Noise, biases and drawn calibration.")] = True,
    force: Annotated[bool, typer.Option("--force", help="Replace an older folder.")] = False,
) -> None:
    """Simulate a dive: log.csv, the truth, and the configuration an estimator may know.

    What the configuration says to estimate (calibration, biases) is drawn from its priors.

    Example: rovgraph simulate falcon --seed 7 --out dive
    """
    import numpy as np

    from rovgraph import simulate as library
    from rovgraph.config import load_config
    from rovgraph.errors import InputError
    from rovgraph.report.folder import STAMP, check_writable, results_folder
    from rovgraph.simulate.files import figures, write_dive

    check_writable(out, force)
    if duration is not None and duration > LIMIT_S:
        raise InputError(f"duration of {duration} s: at most {LIMIT_S:.0f} s")
    effective = load_config(config)
    path = library.scenario(scenario, duration, speed)
    truth = library.Truth(effective, noise=noise, outlier_share=outliers)
    dive = library.simulate(path, truth, np.random.default_rng(seed))
    origin = {"scenario": scenario, "seed": seed, "speed_mps": speed, "outlier_share": outliers, "noise": noise}
    with results_folder(out, force) as folder:
        write_dive(folder, dive, effective, {**STAMP, **origin})
    _show(out, scenario, seed, figures(dive), dive)


def _show(out: Path, scenario: str, seed: int, figures: dict[str, Any], dive: "Dive") -> None:
    """The table that the command prints."""
    from rich.console import Console
    from rich.table import Table

    table = Table("", "", title=f"Simulated dive in {out}", show_header=False)
    table.add_row("scenario, seed", f"{scenario}, {seed}")
    table.add_row("duration, distance", f"{figures['duration_s']:.1f} s, {figures['distance_m']:.1f} m")
    table.add_row("extent", "{:.1f} m north, {:.1f} m east, {:.1f} m depth".format(*figures["extent_m"]))
    for sensor, count in figures["measurements"].items():
        table.add_row(sensor, f"{count} measurements")
    table.add_row("log", f"{len(dive.log_frame)} rows in log.csv")
    Console().print(table)
