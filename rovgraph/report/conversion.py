"""A converted log as files, the configuration to begin with, and the tables that a command prints."""

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log.csv_writer import write_csv, write_sparse_csv
from rovgraph.log.rows import Part, column_names, frame_of, pieces, whole
from rovgraph.log.tables import SUFFIXES
from rovgraph.model.config import AS_WRITTEN, Config
from rovgraph.process import Progress, no_progress
from rovgraph.readers.guessing.groups import ColumnGuess

PIECE = 8192  # rows of a sensor that are written at a time
DIGITS = 10  # significant, of a cell: latitudes to a centimetre
DECIMALS = {"time": 6}
MOUNTED = {"imu": "x forward, y starboard, z down", "dvl": "x forward, y starboard, z down"}


def check_suffix(path: Path) -> str:
    """The name of a log without its suffix.

    Raises
    ------
    InputError : an unknown suffix
    """
    suffix = next((s for s in SUFFIXES if path.name.endswith(s)), None)
    if suffix is None or path.name == suffix:
        raise InputError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")
    return path.name.removesuffix(suffix)


def write_parts(parts: Sequence[Part], path: Path, progress: Progress = no_progress) -> None:
    """Write a log in the format of its suffix.

    Parameters
    ----------
    parts : of `rovgraph.readers.merging.Merged`
    progress : called with the current task and how much of it is done

    Raises
    ------
    InputError : Parquet, and pyarrow is not installed
    """
    if path.suffix != ".parquet":
        write_sparse_csv(
            column_names(parts), _with_progress(parts, f"writing {path.name}", progress), path, DIGITS, DECIMALS
        )
        return
    try:
        frame_of(whole(parts)).to_parquet(path, engine="pyarrow", index=False)
    except ImportError:
        raise InputError(
            f"{path.name}: writing Parquet needs pyarrow; install it with: pip install 'rovgraph[parquet]'"
        ) from None


def _with_progress(
    parts: Sequence[Part], what: str, progress: Progress
) -> Iterator[list[tuple[NDArray[np.int64], Mapping[str, Array]]]]:
    """Pieces of a log, with how far they are."""
    total, done = sum(len(part) for part in parts), 0
    for piece in pieces(parts, PIECE):
        yield [(rows.place, rows.columns) for rows in piece]
        done += sum(len(rows.place) for rows in piece)
        progress(what, done / total)


def write_table(table: Mapping[str, Array], path: Path) -> None:
    """Write one of the other tables of a file, its times as those of the log."""
    write_csv(
        pd.DataFrame({name: np.asarray(values) for name, values in table.items()}), path, DIGITS, decimals=DECIMALS
    )


def starter(
    config: Config, counts: Mapping[str, int], origin: tuple[float, float] | None, sources: Mapping[str, str], name: str
) -> str:
    """A configuration to begin with: what is known of the vehicle, each value with where it is from.

    Parameters
    ----------
    config : as stated, completed by the files
    counts : sensor -> number of measurements, of the log that it is for
    origin : latitude and longitude of the first fix [deg], where there is one
    sources : dotted key -> file that it comes from
    name : of the log's file
    """
    settings: dict[str, Any] = config.model_dump(mode="json", exclude_unset=True)
    settings = {key: value for key, value in settings.items() if key not in AS_WRITTEN}
    sources = dict(sources)
    if origin is not None and not config.environment.origin:
        section = settings.setdefault("environment", {})
        section |= {"origin_lat_deg": origin[0], "origin_lon_deg": origin[1]}
        sources |= dict.fromkeys(("environment.origin_lat_deg", "environment.origin_lon_deg"), "the first fix")
    for sensor, axes in MOUNTED.items():
        if sensor not in counts:
            continue
        section = settings.setdefault(sensor, {})
        if "mount_rpy_deg" not in section:
            section["mount_rpy_deg"] = [0, 0, 0]
            sources[f"{sensor}.mount_rpy_deg"] = f"not known: assumed {axes}; state it"
        if "lever_arm_m" not in section:
            section["lever_arm_m"] = [0, 0, 0]
            sources[f"{sensor}.lever_arm_m"] = "not known; state it, forward, starboard, down from the vehicle's origin"
    sensors = ", ".join(f"{sensor} ({count})" for sensor, count in counts.items())
    head = f"# Configuration to begin with, for {' '.join(name.split())}\n# sensors: {sensors}\n"
    return head + commented_yaml(settings, sources)


def commented_yaml(settings: Mapping[str, Any], comments: Mapping[str, str]) -> str:
    """Settings as YAML, with comments by dotted key."""
    stream = io.StringIO()
    yaml = YAML()
    yaml.width = 4096
    yaml.dump(_commented(settings, comments), stream)
    return stream.getvalue()


def _commented(settings: Mapping[str, Any], sources: Mapping[str, str], above: str = "") -> CommentedMap:
    """Settings as YAML that has a comment behind each key with a source; lists stand in one line."""
    out = CommentedMap()
    for name, value in settings.items():
        key = f"{above}{name}"
        if isinstance(value, Mapping):
            out[name] = _commented(value, sources, f"{key}.")
        else:
            out[name] = CommentedSeq(value) if isinstance(value, list | tuple) else value
            if isinstance(out[name], CommentedSeq):
                out[name].fa.set_flow_style()
        if key in sources:
            out.yaml_add_eol_comment(" ".join(sources[key].split()), name)
    return out


def conversion_tables(report: Mapping[str, Any]) -> list[Table]:
    """Tables of each file's contents, the origin of every column, and how clocks were joined."""
    return [_channels(report), *([_clocks(report)] if report["clocks"] else []), *_left(report)]


def _table(title: str, *headings: str) -> Table:
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for heading in headings:
        right = heading in ("count", "Hz", "gap s", "offset s", "sd s", "drift ppm")
        table.add_column(heading, justify="right" if right else "left", no_wrap=right)
    return table


def _channels(report: Mapping[str, Any]) -> Table:
    table = _table("what the files hold", "file", "sensor", "count", "Hz", "gap s", "from", "used")
    for file in report["files"]:
        for k, channel in enumerate(file["channels"]):
            source = channel["source"] + (f" ({channel['frame']})" if channel["frame"] else "")
            used = "yes" if channel["used"] else f"no: {channel['reason']}"
            numbers = (str(channel["count"]), _number(channel["rate_hz"]), _number(channel["gap_s"]))
            table.add_row(
                escape(file["file"]) if k == 0 else "", channel["sensor"], *numbers, escape(source), escape(used)
            )
    return table


def _clocks(report: Mapping[str, Any]) -> Table:
    table = _table("clocks", "file", "clock", "offset s", "sd s", "drift ppm", "how")
    for clock in report["clocks"]:
        drift = f"{1e6 * clock['drift']:+.1f}" if clock["drift"] else ""
        numbers = f"{clock['offset_s']:+.3f}", f"{clock['sd_s']:.3f}" if clock["sd_s"] else "", drift
        table.add_row(escape(clock["file"]), escape(clock["clock"]), *numbers, escape(clock["how"]))
    return table


def _left(report: Mapping[str, Any]) -> Iterator[Table]:
    table = _table("left out", "file", "what", "count", "why")
    for file in report["files"]:
        for each in file["left"]:
            table.add_row(escape(file["file"]), escape(each["name"]), str(each["count"]), escape(each["reason"]))
    if table.row_count:
        yield table


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}" if value < 1000.0 else f"{value:.0f}"


def guess_table(columns: Iterable[ColumnGuess], left: Mapping[str, str], name: str = "") -> Table:
    """Table of the guesses for each column; ``name`` distinguishes its file."""
    table = _table(
        f"columns of {name}" if name else "columns of the file", "column", "field", "unit", "why", "how sure"
    )
    for each in columns:
        table.add_row(_printable(each.column), each.field, each.unit, _printable(each.why), each.sureness)
    for column, why in left.items():
        table.add_row(_printable(column), "", "", _printable(why), "left")
    return table


def _printable(text: str) -> str:
    """A name from a file, without what a terminal would obey."""
    return escape("".join(letter if letter.isprintable() else "?" for letter in text))
