"""Logs for an estimate: reading with a configuration, checking, correcting clock jumps."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from rovgraph import log as library
from rovgraph.diagnosis.check import Finding, Report, bridge_jumps, examine
from rovgraph.diagnosis.check import warn as warn_of_findings
from rovgraph.errors import InputError, as_paths, kind_of, warn
from rovgraph.inference.initialise import refusal
from rovgraph.log import Log
from rovgraph.model.config import Config, completed, config_or_defaults
from rovgraph.process import Progress, no_progress
from rovgraph.readers.own_log import NOTHING, Paths, is_plain_log, once


def read_log(
    path: Paths,
    config: Config | None = None,
    choose: Mapping[str, str] = NOTHING,
    shift: Mapping[str, float] = NOTHING,
    progress: Progress = no_progress,
    times: str | Mapping[str, str] = NOTHING,
) -> Log:
    """Read a log (docs/log-format.md) with the columns, units and delays of a configuration, or native files as one.

    Parameters
    ----------
    path : CSV, gzipped CSV or Parquet; or native files of one dive, one or several (docs/formats.md)
    config : None = rovgraph's own columns, in SI
    choose, shift, progress, times : of `rovgraph.convert`, for native files

    Returns
    -------
    Log : ``.settings`` holds what native files state, such as mountings; the configuration takes precedence

    Raises
    ------
    InputError : a file that cannot be used

    Warns
    -----
    DataWarning : what was ignored or sorted; a configuration that lies beside the log but was not given
    """
    if isinstance(path, pd.DataFrame):
        raise InputError("log: is a DataFrame, expected a file's name; use Log.from_frame")
    files, said = once(as_paths(path, "log"))
    for text in said:
        warn(text)
    if config is None:
        warn_of_unused(*files)
    stated = choose or shift or times or config_or_defaults(config).files
    alone = len(files) == 1 and not stated
    if alone and is_plain_log(files[0], config_or_defaults(config)):
        return library.read_log(files[0], config)
    from rovgraph.api.conversion import convert  # and what joins recordings, which a single log does not need

    return convert(files, config, choose, shift, progress, times).log


def warn_of_unused(*logs: Path | str) -> None:
    """Warn of a configuration beside a log: without it the track is wrong, and its sd does not show it."""
    for beside in (Path(log).parent / "config.yaml" for log in logs):
        if beside.is_file():
            warn(f"{beside} lies beside the log and is not used; give it as the configuration if it is the vehicle's")


def check(log: Log, config: Config | None = None) -> Report:
    """Check a log, and list the assumptions of an estimate (docs/check.md).

    Parameters
    ----------
    log : as read with the configuration
    config : of vehicle and sensors; None = all defaults

    Returns
    -------
    Report : ``.findings`` with ``level`` "ok", "warning" or "error", ``.timings`` of each sensor, ``.as_dict()``

    Raises
    ------
    InputError : the log was read with other columns
    """
    config = config_of(log, config)
    report = examine(log, config)
    if not report.at("error") and refusal(log, config):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the report has it
            bridged, _ = bridge_jumps(log, config)
        if reason := refusal(bridged, config):
            report.findings.append(Finding("smooth", "error", reason))
    return report


def prepared(log: Log, config: Config) -> tuple[Log, Sequence[Finding]]:
    """A log for an estimate: checked, with jumps of clocks bridged; and what the check found.

    Raises
    ------
    InputError : the log was read with other columns, or that an estimate cannot work with

    Warns
    -----
    DataWarning : findings of the check
    """
    config = config_of(log, config)
    log, examined = bridge_jumps(log, config)
    return log, warn_of_findings(log, config, examined).findings


def config_of(log: Log, config: Config | None) -> Config:
    """The configuration that belongs to a log, all defaults where none is given, completed by what its files know.

    Raises
    ------
    InputError : these are not a log and a configuration, or the log was read with another one's columns
    """
    if not isinstance(log, Log):
        raise InputError(f"log: expected a Log, as read_log or Log.from_frame gives it, found {kind_of(log)}")
    config = config_or_defaults(config)
    config, _ = completed(config, log.settings, f"settings in {log.source}")
    log.require_read_with(config)
    return config
