"""Commands on results: ``evaluate``, ``report``, ``export`` and ``tag``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rovgraph.lab.evaluate import Metrics


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


def report(
    results: Annotated[list[Path], typer.Argument(help="results folders", metavar="RESULTS...")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="page to write; default: report.html in RESULTS, campaign.html for several"),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="replace an older file at --out")] = False,
    pdf: Annotated[
        bool, typer.Option("--pdf", help="print the page to a PDF, too, by Chromium, Chrome or Edge")
    ] = False,
) -> None:
    """Make the page of a results folder again, or a page that compares several dives.

    Example: rovgraph report results/monday results/tuesday --out campaign.html
    """
    import rovgraph as rg

    typer.echo(f"{'printed to' if pdf else 'page in'} {rg.report(*results, out=out, force=force, pdf=pdf)}")


def export(
    results: Annotated[Path, typer.Argument(help="results folder of smooth or online", metavar="RESULTS")],
    to: Annotated[
        list[str] | None, typer.Option(help="format, such as kml; may be repeated; default: list the formats")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="folder; default: the results folder")] = None,
    estimate: Annotated[
        str | None, typer.Option(help="smoothed, filtered or dead_reckoning; default: the best available")
    ] = None,
    rate: Annotated[float | None, typer.Option(help="points a second; default: the format's")] = None,
    crs: Annotated[
        str | None, typer.Option(help="coordinates of gpkg, shp, xyz and geotiff, such as EPSG:25832, or utm")
    ] = None,
    unix_offset: Annotated[
        float, typer.Option(help="Unix time of the log's time 0 in seconds, for formats that need it")
    ] = 0.0,
    origin: Annotated[
        tuple[float, float] | None,
        typer.Option(help="latitude and longitude of north = east = 0, where results have none", metavar="LAT LON"),
    ] = None,
    surface: Annotated[
        float, typer.Option(help="height of the water's surface above sea level in metres, of a lake")
    ] = 0.0,
    cell: Annotated[float | None, typer.Option(help="width of the cells of geotiff in metres; default: 1")] = None,
    force: Annotated[bool, typer.Option("--force", help="replace older files")] = False,
) -> None:
    """Write a track as KML, GeoJSON, GPX, GeoPackage, NMEA, ROS 2 bag, NetCDF, SBET, soundings and more.

    Example: rovgraph export results --to kml --to geojson
    """
    from rich.table import Table

    import rovgraph as rg
    from rovgraph.cli.console import console, say
    from rovgraph.report.export import export_formats

    shown = console()
    if not to:
        table = Table("--to", "format", "needs")
        for each in export_formats().values():
            table.add_row(each.name, each.title, f"rovgraph\\[{each.extra}]" if each.extra else "")
        shown.print(table)
        return
    for path in rg.export(results, to, out, estimate, rate, crs, unix_offset, force, origin, surface, cell):
        say(shown, f"written: {path}")


def tag(
    table: Annotated[Path, typer.Argument(help="CSV with a column of times", metavar="TABLE")],
    results: Annotated[Path, typer.Argument(help="results folder of smooth or online", metavar="RESULTS")],
    out: Annotated[Path, typer.Option("--out", "-o", help="CSV to write", show_default=False)],
    time: Annotated[str, typer.Option(help="column of times: seconds of the log's clock, or dates")] = "time",
    offset: Annotated[float, typer.Option(help="seconds to add to the table's times")] = 0.0,
    estimate: Annotated[
        str | None, typer.Option(help="smoothed, filtered or dead_reckoning; default: the best available")
    ] = None,
    exif: Annotated[
        str | None, typer.Option(help="column of JPEG files; write copies with the position in EXIF", metavar="COLUMN")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="replace older files")] = False,
) -> None:
    """Add position, attitude and their sd to photos, sonar pings or samples.

    Example: rovgraph tag photos.csv results --time taken --out placed.csv
    """
    import rovgraph as rg
    from rovgraph.cli.console import console, say

    tagged = rg.tag(table, results, out, time, offset, estimate, exif, force)
    inside, rows = int(tagged.inside.sum()), len(tagged.inside)
    outside = f", {rows - inside} outside the dive" if inside < rows else ""
    say(console(), f"{inside} of {rows} rows placed{outside}: {out}")
