"""Which channel feeds each sensor of a log, where several could."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rovgraph.errors import InputError
from rovgraph.interchange.recording import Channel, Recording

# along whose axes, or about whose place, another sensor's values are: both have to be of one instrument
INSTRUMENT = {"mag": "imu", "ahrs": "imu", "dvl_heading": "dvl", "dvl_altitude": "dvl", "dvl_water": "dvl"}


@dataclass(frozen=True)
class Selected:
    """A channel that feeds a sensor.

    Attributes
    ----------
    file : index of its recording
    channel : Channel
    """

    file: int
    channel: Channel


@dataclass(frozen=True)
class Unused:
    """A channel that feeds nothing, and why."""

    file: int
    channel: Channel
    reason: str


def select(recordings: Sequence[Recording], choose: Mapping[str, str]) -> tuple[list[Selected], list[Unused]]:
    """One channel for each sensor: the one that is chosen, else the first of the first file that has one.

    Parameters
    ----------
    choose : sensor -> name of a file, or part of the channel's source

    Raises
    ------
    InputError : a sensor or a choice that is not there
    """
    every: dict[str, list[Selected]] = {}
    for k, recording in enumerate(recordings):
        for channel in recording.channels:
            every.setdefault(channel.sensor, []).append(Selected(k, channel))
    if unknown := choose.keys() - every.keys():
        raise InputError(f"choose {min(unknown)}: no file has this sensor; there are {', '.join(sorted(every))}")
    picked = {s: _chosen(recordings, found, s, choose[s]) if s in choose else found[0] for s, found in every.items()}
    unused = []
    for sensor, instrument in INSTRUMENT.items():
        if sensor in choose or not {sensor, instrument} <= picked.keys():
            continue
        other = picked[instrument].file
        fitting = [
            found for found in every[sensor] if found.file == other or not _has(recordings[found.file], instrument)
        ]
        if fitting:
            picked[sensor] = fitting[0]
            continue
        reason = f"its axes are those of another {instrument} than the chosen one"
        unused += [Unused(found.file, found.channel, reason) for found in every[sensor]]
        del picked[sensor]
    for sensor, selected in picked.items():
        reason = f"{sensor} comes from {file_names(recordings)[selected.file]}, {selected.channel.source}"
        unused += [Unused(f.file, f.channel, reason) for f in every[sensor] if f.channel is not selected.channel]
    return list(picked.values()), unused


def file_names(recordings: Sequence[Recording]) -> list[str]:
    """Names of files for messages, with their folders where they would be the same."""
    short = [Path(recording.path).name for recording in recordings]
    return [name if short.count(name) == 1 else r.path for name, r in zip(short, recordings, strict=True)]


def _has(recording: Recording, sensor: str) -> bool:
    return any(channel.sensor == sensor for channel in recording.channels)


def _chosen(recordings: Sequence[Recording], found: Sequence[Selected], sensor: str, choice: str) -> Selected:
    """The channel that a choice names, by file, by a word of its source, or by a part of it."""
    word = re.compile(rf"(?<!\w){re.escape(choice)}(?!\w)", re.IGNORECASE)
    names = file_names(recordings)
    files = [{recordings[f.file].path, names[f.file], Path(recordings[f.file].path).stem} for f in found]
    by_file = [f for f, called in zip(found, files, strict=True) if choice in called]
    by_word = [f for f in found if word.search(f.channel.source)]
    by_part = [f for f in found if choice.lower() in f.channel.source.lower()]
    if matching := by_file or by_word or by_part:
        return matching[0]
    told = "; ".join(f"{names[f.file]}: {f.channel.source}" for f in found)
    raise InputError(f"choose {sensor}={choice}: no such source of {sensor}; there are: {told}")
