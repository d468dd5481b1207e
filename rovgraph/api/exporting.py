"""A track as files that others open, and at the times of other tables: ``rovgraph export`` and ``rovgraph tag``."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rovgraph.errors import InputError, as_path, as_texts, kind_of
from rovgraph.log.tables import read_cells
from rovgraph.report.export import ExportOptions, Tagged, Track, read_track, write_track
from rovgraph.report.export import tag as tag_table
from rovgraph.report.export.tagging import column_of, geotag

if TYPE_CHECKING:
    from rovgraph.api.smoothing import Result


def export(
    results: "Result | Path | str",
    to: str | Sequence[str],
    out: Path | str | None = None,
    estimate: str | None = None,
    rate: float | None = None,
    crs: str | None = None,
    unix_offset: float = 0.0,
    force: bool = False,
    origin: tuple[float, float] | None = None,
    surface: float = 0.0,
    cell: float | None = None,
) -> list[Path]:
    """Write the track of a dive in formats that others open (docs/export.md).

    Parameters
    ----------
    results : of `smooth`, or a results folder
    to : name of a format, or several
    out : folder to write into; None = the results folder
    estimate : "smoothed", "filtered" or "dead_reckoning"; None = the best available
    rate : of points [Hz]; None = each format's default
    crs : coordinates of GeoPackage, shapefile and soundings, such as "EPSG:25832" or "utm"
    unix_offset : Unix time of the log's time 0 [s]
    force : replace older files
    origin : latitude and longitude of north = east = 0 [deg]; None = that of the results
    surface : height of the water's surface above sea level [m], for heights in a lake
    cell : width of the cells of a grid of soundings [m]; None = 1 m

    Returns
    -------
    list of Path : what was written

    Raises
    ------
    InputError : an unknown format, a missing library, a missing origin or Unix time that a format needs, a file that
        exists
    """
    track = track_of(results, estimate).shifted(unix_offset).placed(origin, surface)
    if out is None:
        if not isinstance(results, str | Path):
            raise InputError("out: expected a folder to write into, because these results have none")
        out = results
    return write_track(track, as_texts(to, "to"), as_path(out, "out"), ExportOptions(rate, crs, cell), force)


def tag(
    table: Path | str,
    results: "Result | Path | str",
    out: Path | str,
    time: str = "time",
    offset: float = 0.0,
    estimate: str | None = None,
    exif: str | None = None,
    force: bool = False,
) -> Tagged:
    """Add the vehicle's place at each row of a table: photos, sonar pings, samples.

    Parameters
    ----------
    table : CSV with a column of times
    results : of `smooth`, or a results folder
    out : CSV to write
    time : name of that column
    offset : to add to the table's times [s]
    estimate : as of `export`
    exif : name of a column of JPEG files, relative to the table; copies with the position in EXIF go into a folder
        beside ``out``, named after it with ``_photos``
    force : replace older files

    Raises
    ------
    InputError : a table that cannot be used, no row within the dive, no origin for EXIF
    """
    from rovgraph.report.folder import results_files

    table, out = as_path(table, "table"), as_path(out, "out")
    photos = out.with_name(f"{out.stem}_photos")
    if exif is not None and photos.exists() and not force:
        raise InputError(f"{photos} exists; choose another --out or give --force")
    cells = read_cells(table)
    cells.warn_how()
    frame = cells.frame
    track = track_of(results, estimate)
    try:
        files = None if exif is None else [table.parent / name for name in column_of(frame, exif)]
        tagged = tag_table(frame, track, time, offset)
    except InputError as error:
        raise InputError(f"{table}: {error}") from None
    with results_files([out], force) as [partial]:
        tagged.frame.to_csv(partial, index=False)
        if files is not None:
            _copy_photos(tagged, track, files, photos, partial.parent)
    return tagged


def _copy_photos(tagged: Tagged, track: Track, files: Sequence[Path], folder: Path, temporary: Path) -> None:
    """All photos with their place, in ``folder``, or none; other files in it stay."""
    if any(file.parent.resolve() == folder.resolve() for file in files):
        raise InputError(f"{folder}: holds the photos that are read; choose another --out")
    copies = temporary / folder.name
    try:
        geotag(tagged, track, files, copies)
    except ImportError:
        raise InputError("tagging photos needs piexif; install it with: pip install 'rovgraph[maps]'") from None
    folder.mkdir(exist_ok=True)
    for copy in copies.iterdir():
        copy.replace(folder / copy.name)


def track_of(results: "Result | Path | str", estimate: str | None = None) -> Track:
    """A track to be exported.

    Raises
    ------
    InputError : not that estimate, no results folder
    """
    if isinstance(results, str | Path):
        return read_track(results, estimate)
    if not hasattr(results, "track"):
        raise InputError(f"results: expected a results folder or what rg.smooth returns, found {kind_of(results)}")
    return results.track(estimate)
