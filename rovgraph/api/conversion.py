"""Native files as one log: the work of ``rovgraph convert``, and `read_log` of anything but a single log.

`guess_columns` proposes a mapping for the columns of any table: ``rovgraph convert --guess``.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import Any

from rovgraph.errors import InputError, as_path, as_paths, collected_warnings, warn
from rovgraph.log import Log
from rovgraph.log.companions import usable_beams, usable_cells
from rovgraph.log.tables import names_of, read_table, table_beside
from rovgraph.log.units import groups, nearest, quantities
from rovgraph.model.config import (
    AS_WRITTEN,
    Config,
    FileSettings,
    TableSettings,
    completed,
    config_or_defaults,
    fits,
    parse_config,
)
from rovgraph.process import Progress, no_progress
from rovgraph.readers.formats import (
    Format,
    ReadingOptions,
    head_of,
    purpose,
    read_recording,
    recognise,
)
from rovgraph.readers.guessing import guess_table
from rovgraph.readers.guessing.groups import ColumnGuess
from rovgraph.readers.guessing.quantities import POINTS_UP
from rovgraph.readers.merging import ARRIVAL, EVERY, Merged, account, merge, notes
from rovgraph.readers.own_log import FORMAT as OWN_LOG
from rovgraph.readers.own_log import NOTHING, Paths, is_plain_log, once
from rovgraph.readers.recording import Recording, SourceMissing, earlier
from rovgraph.sensors.dvl_beam import BEAMS
from rovgraph.sensors.water_layer import CELLS

REPORT = ".report.json"


@dataclass(frozen=True)
class Conversion:
    """A log that was made of native files.

    Attributes
    ----------
    merged : columns, sources, clocks and what was ignored
    completed : the given configuration, completed by settings of the files
    used : dotted key -> value of the settings that come from the files
    """

    merged: Merged
    completed: Config
    used: Mapping[str, Any]

    @property
    def config(self) -> Config:
        """For the log that `save` writes: completed, without columns and units."""
        return self.completed.model_copy(update=AS_WRITTEN)

    @cached_property
    def log(self) -> Log:
        """Ready for an estimate; made when it is asked for, since it takes as much memory again.

        Raises
        ------
        InputError : no measurement that can be used

        Warns
        -----
        DataWarning : values that are left out or look wrong
        """
        merged, source = self.merged, self.merged.source
        with collected_warnings() as texts:
            beams, cells = (
                usable(merged.tables[name], self.config, f"{what} of {source}") if name in merged.tables else None
                for name, usable, what in ((BEAMS, usable_beams, "beams"), (CELLS, usable_cells, "profiles"))
            )
        log = Log.from_rows(merged.rows, self.config, source).with_beams(beams).with_profiles(cells)
        return replace(
            log,
            config=self.completed,
            warnings=(*merged.warnings, *texts, *log.warnings),
            settings=merged.nested_settings(),
            notes=(*notes(merged), *_describe_settings(merged, self.used)),
        )

    @property
    def notes(self) -> list[str]:
        """Assumptions, and settings that come from the files, a sentence each."""
        of_files = [text for recording in self.merged.recordings for text in recording.notes]
        return [*of_files, *_describe_settings(self.merged, self.used)]

    @property
    def report(self) -> dict[str, Any]:
        """Where each part comes from, for JSON: files, columns, clocks, settings, warnings."""
        return account(self.merged)

    def save(
        self,
        path: Path | str,
        config_out: Path | str | None = None,
        force: bool = False,
        progress: Progress = no_progress,
    ) -> list[Path]:
        """Write the log, its report and other tables beside it, and a configuration to begin with; all or nothing.

        Parameters
        ----------
        path : CSV, gzipped CSV (``.csv.gz``) or Parquet (``.parquet``)
        config_out : YAML; None = none
        force : replace older files
        progress : called at times with the current task and its progress from 0 to 1

        Returns
        -------
        list of Path : the files written

        Raises
        ------
        InputError : a file exists, or cannot be written
        """
        from rovgraph.report.conversion import check_suffix, starter, write_parts, write_table
        from rovgraph.report.folder import results_files

        path = as_path(path, "path")
        stem = check_suffix(path)
        inputs = {
            Path(path).resolve()
            for recording in self.merged.recordings
            for path in (recording.path, *(piece.path for piece in recording.pieces))
        }
        tables = {table_beside(path, name): table for name, table in self.merged.tables.items()}
        report = path.with_name(stem + REPORT)
        config_path = None if config_out is None else as_path(config_out, "config_out")
        paths = [path, report, *tables, *([] if config_path is None else [config_path])]
        if clash := next((p for p in paths if p.resolve() in inputs), None):
            raise InputError(f"{clash} is one of the files that are read; choose another --out")
        with results_files(paths, force) as temporary:
            write_parts(self.merged.parts, temporary[0], progress)
            temporary[1].write_text(json.dumps(self.report, indent=2, default=str) + "\n", encoding="utf-8")
            for place, table in zip(temporary[2:], tables.values(), strict=False):
                write_table(table, place)
            if config_path is not None:
                sources = {key: self.merged.settings[key][1] for key in self.used}
                counts = {s.channel.sensor: len(s.channel.columns["time"]) for s in self.merged.selected}
                text = starter(self.config, counts, self.merged.first_fix, sources, path.name)
                temporary[-1].write_text(text, encoding="utf-8")
        return paths


def convert(
    paths: Paths,
    config: Config | None = None,
    choose: Mapping[str, str] = NOTHING,
    shift: Mapping[str, float] = NOTHING,
    progress: Progress = no_progress,
    times: str | Mapping[str, str] = NOTHING,
) -> Conversion:
    """Convert native files of one dive into one log (docs/formats.md).

    Parameters
    ----------
    paths : files of any format, recognised by their content; rovgraph's own logs among them
    config : gives columns and units of rovgraph's own logs; takes precedence over settings of the files
    choose : sensor -> file, instance, message or topic that feeds it, where there are several
    shift : sensor or file -> seconds to add to its stamps, if known
    progress : called at times with the current task and its progress from 0 to 1
    times : "arrival" for the recorder's times in place of all stamps, or sensor or file -> "arrival" for those of one

    Raises
    ------
    InputError : a file that cannot be read, clocks that cannot be joined

    Warns
    -----
    DataWarning : stamps that were left out or sorted, and what readers warn of; of values, `Conversion.log` warns
    """
    config = config_or_defaults(config)
    _require_mappings(choose, shift)
    times = _times(times)
    files, said = once(as_paths(paths, "paths"))
    if not files:
        raise InputError("no file was given; expected native files or logs of one dive")
    settings_of = settings_of_files(files, config)
    found = [_format(path, config) for path in files]
    names = {name for path in files for name in (str(path), path.name, path.stem)}
    inside = {sensor: source for sensor, source in choose.items() if source not in names}  # of a file's sources
    recordings = []
    for k, (path, format_) in enumerate(zip(files, found, strict=True)):
        progress(f"reading {path.name}", k / len(files))

        def read(done: int, total: int, k: int = k, name: str = path.name) -> None:
            progress(f"reading {name}", (k + done / max(total, 1)) / len(files))

        settings = settings_of[k]
        options = ReadingOptions(inside, read, settings, bool(times))
        recording = _read(path, options, format_, len(files) == 1)
        recordings.append(earlier(recording, settings.delay_s) if settings.delay_s else recording)
    progress("joining clocks", 1.0)
    merged = merge(recordings, choose, shift, times)
    for text in (*said, *merged.warnings):
        warn(text)
    return Conversion(merged, *completed(config, merged.nested_settings(), f"settings in {merged.source}"))


def settings_of_files(files: Sequence[Path], config: Config) -> list[FileSettings]:
    """How each of some files is written; columns that others of them have are left out.

    Raises
    ------
    InputError : a pattern of the configuration that fits no file, a file that two fit, a mapped column that no file has
    """
    for pattern in config.files:
        if not any(fits(path, pattern) for path in files):
            given = ", ".join(path.name for path in files)
            raise InputError(f"files: {pattern!r} fits none of the files ({given}); correct or remove it")
    settings = [config.of_file(path) for path in files]
    if len(files) == 1 and not config.files:
        return settings  # its reader names what it lacks
    names = [None if head.startswith(b"PAR1") else set(names_of(head)) for head in map(head_of, files)]
    stated = [("", config.columns), *((pattern, of_pattern.columns) for pattern, of_pattern in config.files.items())]
    for pattern, columns in stated:
        theirs = {path: header for path, header in zip(files, names, strict=True) if not pattern or fits(path, pattern)}
        for target, source in columns.items():
            if not any(header is None or source in header for header in theirs.values()):
                near = nearest(source, [name for header in theirs.values() for name in header or ()])
                where = ", ".join(path.name for path in theirs)
                raise InputError(f"columns: {target}: no column {source!r} in {where}, nearest is {near!r}")
    return [
        one
        if header is None
        else one.model_copy(update={"columns": {t: s for t, s in one.columns.items() if s in header}})
        for one, header in zip(settings, names, strict=True)
    ]


def _require_mappings(choose: Mapping[str, str], shift: Mapping[str, float]) -> None:
    """Check what feeds a sensor, and the seconds that are added to stamps.

    Raises
    ------
    InputError : no mappings, or a shift that is not a number
    """
    for name, given in (("choose", choose), ("shift", shift)):
        if not isinstance(given, Mapping):
            raise InputError(f"{name}: expected a mapping of sensors or files, found {given!r}")
    for name, seconds in shift.items():
        if not isinstance(seconds, Real):
            raise InputError(f"shift {name}: expected seconds, a number, found {seconds!r}")


def _times(given: str | Mapping[str, str]) -> Mapping[str, str]:
    """Sensor or file, or `EVERY` -> whose times are taken.

    Raises
    ------
    InputError : others than those of arrival
    """
    times = {EVERY: given} if isinstance(given, str) else given
    if not isinstance(times, Mapping) or any(whose != ARRIVAL for whose in times.values()):
        raise InputError(f"times: expected 'arrival', or a mapping of sensors or files to it, found {given!r}")
    return times


def _read(path: Path, options: ReadingOptions, format_: Format | None, alone: bool) -> Recording:
    """A file; where it is one of several, another one may have what was chosen, or else `merge` refuses it."""
    try:
        return read_recording(path, options, format_)
    except SourceMissing as error:
        if alone:
            raise
        others = {sensor: source for sensor, source in options.choose.items() if sensor != error.sensor}
        return _read(path, replace(options, choose=others), format_, alone)


def _describe_settings(merged: Merged, used: Mapping[str, Any]) -> list[str]:
    return [f"{key}: {value} ({merged.settings[key][1]})" for key, value in used.items()]


def _format(path: Path, config: Config) -> Format | None:
    """The format of a file, by its content; None = by the formats' own word."""
    return OWN_LOG if is_plain_log(path, config) else None


REASONS = {
    "imu": POINTS_UP,
    "dvl": "its axes point forward, to port and up by their names",
    "angles": "counts anticlockwise by the gyro, and its name says ENU",
    "times": "day and month may be exchanged: both orders are possible",
}


@dataclass(frozen=True)
class Guess:
    """A mapping of the columns of a table, to be confirmed.

    Attributes
    ----------
    source : the file
    columns : what each column may be, in the order of the file; of these, the unsure ones are not proposed
    left : column -> why it feeds nothing
    settings : of a configuration, that names or numbers show: mountings, how headings count, the order of dates
    notes : a sentence each
    """

    source: str
    columns: tuple[ColumnGuess, ...]
    left: Mapping[str, str]
    settings: Mapping[str, Any]
    notes: tuple[str, ...]

    @property
    def proposed(self) -> tuple[ColumnGuess, ...]:
        """The columns that are sure or likely."""
        return tuple(each for each in self.columns if each.sureness != "unsure")

    @property
    def mapping(self) -> dict[str, str]:
        """Column of a log -> the file's column, as a configuration's ``columns`` has it, but for equal names."""
        return {each.field: each.column for each in self.proposed if each.field != each.column}

    @property
    def units(self) -> dict[str, str]:
        """Group or column -> unit, as a configuration's ``units`` has it."""
        kinds = quantities()
        known = {each.field: each.unit for each in self.proposed if each.unit and each.field in kinds}
        out: dict[str, str] = {}
        for group, members in groups().items():
            units = {field: known[field] for field in members if field in known}
            same = len(set(units.values())) == 1 and len({kinds[field] for field in units}) == 1
            out |= {group: next(iter(units.values()))} if same else units
        return out

    @property
    def config(self) -> Config:
        """The configuration that is proposed."""
        return parse_config(self.to_yaml(), f"guess of {self.source}")

    def to_yaml(self) -> str:
        """``columns`` and ``units`` for a configuration, and settings; unsure columns are comments."""
        return proposal([self])

    def save(self, path: Path | str, force: bool = False) -> Path:
        """Write the configuration.

        Raises
        ------
        InputError : the file exists and ``force`` is not given, or cannot be written
        """
        return save_proposal([self], path, force)


def proposal(guesses: Sequence[Guess]) -> str:
    """The configuration that one table's guess, or those of several, propose, as YAML; several stand under ``files``.

    Mountings hold for all tables; those of the first one take precedence.
    """
    from rovgraph.report.conversion import commented_yaml

    sections: dict[str, Any] = {}
    reasons: dict[str, str] = {}
    for guess in guesses:
        table: dict[str, Any] = {"columns": guess.mapping, "units": guess.units}
        above = f"files.{Path(guess.source).name}." if len(guesses) > 1 else ""
        reasons |= {f"{above}columns.{each.field}": f"{each.sureness}: {each.why}" for each in guess.proposed}
        for section, keys in guess.settings.items():
            of_table = section in TableSettings.model_fields
            (table if of_table else sections).setdefault(section, {}).update(keys)
            reasons |= {f"{above if of_table else ''}{section}.{key}": REASONS[section] for key in keys}
        stated = {name: section for name, section in table.items() if section}
        if len(guesses) > 1:
            sections.setdefault("files", {})[Path(guess.source).name] = stated
        else:
            sections = stated | sections
    text = commented_yaml(sections, reasons) if sections else ""
    unsure = [each for guess in guesses for each in guess.columns if each.sureness == "unsure"]
    lines = [f"# unsure: {each.field}: {_one_line(each.column)}  ({each.why})" for each in unsure]
    return text + "".join(f"{line}\n" for line in lines)


def save_proposal(guesses: Sequence[Guess], path: Path | str, force: bool = False) -> Path:
    """Write the configuration that `proposal` gives.

    Raises
    ------
    InputError : the file exists and ``force`` is not given, or cannot be written
    """
    from rovgraph.report.folder import results_files

    path = as_path(path, "path")
    if any(path.resolve() == Path(guess.source).resolve() for guess in guesses):
        raise InputError(f"{path} is the file that is read; choose another name")
    names = ", ".join(_one_line(Path(guess.source).name) for guess in guesses)
    with results_files([path], force) as (temporary,):
        temporary.write_text(f"# Proposed for {names}: confirm each line\n" + proposal(guesses), encoding="utf-8")
    return path


def guess_columns(path: Path | str) -> Guess:
    """Propose how the columns of anyone's table map to those of a log, by names, ranges and physics.

    Parameters
    ----------
    path : CSV, gzipped CSV or Parquet

    Returns
    -------
    Guess : ``.columns`` with reasons, ``.to_yaml()`` for a configuration; confirm it, and check the log with it

    Raises
    ------
    InputError : no table, no names of columns, no time, or a native file, which needs no mapping

    Warns
    -----
    DataWarning : how the table was read, where it is not written as a log of this program
    """
    path = as_path(path, "path")
    head = head_of(path)
    format_ = recognise(path)
    if format_ is not None and format_ is not OWN_LOG:
        raise InputError(f"{path}: is a {format_.title}, whose columns are known; convert it without a guess")
    if what := purpose(path, head):
        raise InputError(f"{path}: {what}")
    table = read_table(path)
    found = guess_table(table)
    table.warn_how()
    return Guess(str(path), tuple(found.columns), found.left, found.settings, tuple(found.notes))


def _one_line(text: str) -> str:
    """A text as it may stand in a comment."""
    return "".join(letter if letter.isprintable() else "?" for letter in " ".join(text.split()))
