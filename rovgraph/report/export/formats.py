"""Formats that a track is written in: one module each, registered here or by an entry point.

A package of its own adds a format with an entry point of the group ``rovgraph.exports`` that names an `ExportFormat`.
"""

import contextlib
import importlib
import secrets
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

from rovgraph.errors import InputError, in_one_line, warn
from rovgraph.report.export.track import Track, require_place, require_utc

OWN = ("maps", "soundings", "trajectories", "sentences", "ros2")  # modules of this package, each with `FORMATS`
GROUP = "rovgraph.exports"


@dataclass(frozen=True)
class ExportOptions:
    """A user's options for writing a track.

    Attributes
    ----------
    rate : of points that a format has at a rate [Hz]; None = the format's own
    crs : coordinates of a GIS layer or of soundings, such as "EPSG:32633" or "utm"; None = the format's own
    cell : width of the cells of a grid [m]; None = the format's own
    """

    rate: float | None = None
    crs: str | None = None
    cell: float | None = None

    def rate_or(self, usual: float) -> float:
        """The rate asked for, or a format's own [Hz]."""
        return usual if self.rate is None else self.rate


@dataclass(frozen=True)
class ExportFormat:
    """A format.

    Attributes
    ----------
    name : short, as ``--to`` takes it
    title : for people
    suffix : of its file, with the dot; of a format that is a folder, ""
    write : makes the file (or folder) at a path, of a track and options
    extra : the extra of this package that it needs ("" = none)
    needs_place, needs_utc : whether it cannot do without latitude and longitude, or without Unix time
    """

    name: str
    title: str
    suffix: str
    write: Callable[[Track, Path, ExportOptions], None]
    extra: str = ""
    needs_place: bool = False
    needs_utc: bool = False


@cache
def export_formats() -> dict[str, ExportFormat]:
    """Name -> format: this package's own, then those of entry points; one that cannot be loaded is a warning."""
    found: list[ExportFormat] = []
    for name in OWN:
        found += importlib.import_module(f"{__package__}.{name}").FORMATS
    for entry in entry_points(group=GROUP):
        try:
            found.append(entry.load())
        except Exception as error:  # whatever another package does
            warn(f"export {entry.name} of {entry.value} cannot be loaded and is left out ({in_one_line(error)})")
    return {each.name: each for each in found}


def known_formats(names: Sequence[str]) -> list[ExportFormat]:
    """Formats by name.

    Raises
    ------
    InputError : one that is not known, with the nearest
    """
    known = export_formats() if names else {}
    for name in names:
        if name not in known:
            near = get_close_matches(name, known, 1, 0.0)[0]
            raise InputError(f"export {name!r}: is no format, nearest is {near}; there are {', '.join(known)}")
    return [known[name] for name in names]


def check_exportable(names: Sequence[str], name: str, origin: tuple[float, float] | None, start: float) -> None:
    """See that a dive can be written in some formats, before anything is computed or written.

    Parameters
    ----------
    names : of formats
    name, origin, start : of the dive, as `Track` has them; when it begins [s]

    Raises
    ------
    InputError : an unknown format; an origin or a Unix time that one needs and the dive does not have
    """
    for format_ in known_formats(names):
        if format_.needs_place:
            require_place(name, origin)
        if format_.needs_utc:
            require_utc(name, start)


def write_track(
    track: Track, names: Sequence[str], folder: Path, options: ExportOptions, force: bool = False
) -> list[Path]:
    """Write a track as ``track_ESTIMATE`` with each format's suffix, all files or none.

    Parameters
    ----------
    names : of formats
    folder : is made where it is not there
    force : replace files of that name

    Returns
    -------
    list of Path : what was written

    Raises
    ------
    InputError : an unknown format, a library that is not installed, an origin or a time that a format needs, a file
        that is there
    """
    check_exportable(names, track.name, track.origin, float(track.trajectory.time[0]))
    formats = known_formats(list(dict.fromkeys(names)))
    track = replace(track, name=_printable(track.name))
    targets = [folder / f"track_{track.estimate}{format_.suffix or '_' + format_.name}" for format_ in formats]
    for target in targets:
        if target.exists() and not force:
            raise InputError(f"{target} exists; choose another --out or give --force")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as written:
            for format_, target in zip(formats, targets, strict=True):
                _write(format_, track, written.enter_context(_whole(target)), options)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror or error}); choose another --out") from None
    return targets


def _printable(name: str) -> str:
    """A name that XML and UTF-8 can hold: file names may have any bytes."""
    return "".join(letter if letter.isprintable() else " " for letter in name)


def _write(format_: ExportFormat, track: Track, path: Path, options: ExportOptions) -> None:
    try:
        format_.write(track, path, options)
    except ImportError as error:
        missing = (error.name or "").partition(".")[0]
        raise InputError(
            f"writing {format_.title} needs {missing}; install it with: pip install 'rovgraph[{format_.extra}]'"
        ) from None


@contextlib.contextmanager
def _whole(target: Path) -> Iterator[Path]:
    """A temporary place with the target's suffix, which becomes the target when the block ends without an error."""
    partial = target.with_name(f".rovgraph-{secrets.token_hex(4)}{target.suffix}")
    try:
        yield partial
        if target.is_dir():
            shutil.rmtree(target)
        partial.replace(target)
    finally:
        if partial.is_dir():
            shutil.rmtree(partial)
        else:
            partial.unlink(missing_ok=True)
