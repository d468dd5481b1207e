"""``rovgraph evaluate``: how far a trajectory is from a reference."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rovgraph.evaluate import Metrics


def evaluate(
    trajectory: Annotated[Path, typer.Argument(help="CSV of an estimate", show_default=False)],
    reference: Annotated[Path, typer.Argument(help="CSV with time, north, east, and optionally attitude and velocity")],
    start: Annotated[float, typer.Option("--from", help="skip the first seconds of the trajectory")] = 0.0,
    end: Annotated[
        float | None, typer.Option("--to", help="skip everything after this many seconds", show_default=False)
    ] = None,
    align: Annotated[
        bool, typer.Option("--align", help="first rotate and shift the trajectory onto the reference")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print JSON instead of a table")] = False,
) -> None:
    """Compare a trajectory with a reference.

    Example: rovgraph evaluate results/trajectory_smoothed.csv data/falcon/truth.csv.gz
    """
    import json
    import math

    import rovgraph as rg

    until = math.inf if end is None else end
    metrics = rg.evaluate(rg.read_trajectory(trajectory), rg.read_reference(reference), start, align, until)
    if as_json:
        typer.echo(json.dumps(metrics.as_dict(), indent=2))
    else:
        show_metrics(metrics, f"{trajectory} against {reference}")


def show_metrics(metrics: "Metrics", title: str) -> None:
    """Print the table; unknown metrics have no row."""
    from rich.table import Table

    from rovgraph.cli.console import console

    table = Table("", "", title=title, show_header=False)
    for label, value in rows(metrics):
        table.add_row(label, value)
    console().print(table)


def rows(metrics: "Metrics") -> list[tuple[str, str]]:
    """Label and value with its unit of every metric that is known."""
    m = metrics
    every = [
        ("compared", f"{m.epochs} epochs, {m.duration_s:.1f} s, {m.distance_m:.1f} m"),
        ("reference covered", f"{100 * m.coverage:.1f} %"),
        ("aligned, taken out", _format("{:.2f}° and {:.2f} m north, {:.2f} m east", *_removed(m))),
        ("horizontal error, rms", f"{m.rms_m:.3f} m"),
        ("mean", f"{m.mean_m:.3f} m"),
        ("max", f"{m.max_m:.3f} m at {m.max_at_s:.1f} s"),
        ("end", f"{m.end_m:.3f} m"),
        ("end, of the distance", _format("{:.2f} %", m.drift_percent)),
        ("3D error, rms", _format("{:.3f} m", m.rms_3d_m)),
        ("depth error, rms", _format("{:.3f} m", m.rms_down_m)),
        ("heading error, rms", _format("{:.2f}°", m.heading_rms_deg)),
        ("heading error, mean", _format("{:+.2f}°", m.heading_mean_deg)),
        ("NEES, 2 if consistent", _format("{:.2f}", m.nees)),
        ("inside the 99 % ellipse", _format("{:.1f} %", None if m.inside_ellipse is None else 100 * m.inside_ellipse)),
    ]
    return [(label, value) for label, value in every if value]


def _removed(m: "Metrics") -> tuple[float | None, float | None, float | None]:
    return m.turned_deg, m.shift_north_m, m.shift_east_m


def _format(form: str, *values: float | None) -> str:
    return "" if None in values else form.format(*values)
