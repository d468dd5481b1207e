"""``rovgraph export``: a track as files that others open."""

from pathlib import Path
from typing import Annotated

import typer


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
        str | None, typer.Option(help="coordinates of gpkg and shp, such as EPSG:25832, or utm; default: lat, lon")
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
    force: Annotated[bool, typer.Option("--force", help="replace older files")] = False,
) -> None:
    """Write a track as KML, GeoJSON, GPX, GeoPackage, NMEA, ROS 2 bag, NetCDF, SBET, subtitles and more.

    Example: rovgraph export results --to kml --to geojson
    """
    from rich.table import Table

    import rovgraph as rg
    from rovgraph.cli.console import console, say
    from rovgraph.export import export_formats

    shown = console()
    if not to:
        table = Table("--to", "format", "needs")
        for each in export_formats().values():
            table.add_row(each.name, each.title, f"rovgraph\\[{each.extra}]" if each.extra else "")
        shown.print(table)
        return
    for path in rg.export(results, to, out, estimate, rate, crs, unix_offset, force, origin, surface):
        say(shown, f"written: {path}")
