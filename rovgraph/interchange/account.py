"""An account of what was made of files: what each held, where every column came from, and how clocks were joined."""

from typing import Any

import numpy as np

from rovgraph.interchange.clocks import JoinedClock
from rovgraph.interchange.merging import Merged
from rovgraph.interchange.recording import Channel
from rovgraph.spilling import in_pieces, median_step


def account(merged: Merged) -> dict[str, Any]:
    """For JSON, in seconds, hertz and SI; what is not known is None."""
    names = merged.names
    selected = {id(each.channel) for each in merged.selected}
    reasons = {id(each.channel): each.reason for each in merged.unused}
    files = []
    for recording, name in zip(merged.recordings, names, strict=True):
        channels = [
            {
                "sensor": channel.sensor,
                "columns": [column for column in channel.columns if column != "time"],
                "source": channel.source,
                "frame": channel.frame,
                "clock": channel.clock,
                **timing(channel),
                "used": id(channel) in selected,
                "reason": reasons.get(id(channel), ""),
            }
            for channel in recording.channels
        ]
        left = [{"name": each.name, "count": each.count, "reason": each.reason} for each in recording.left]
        file = {"file": name, "path": recording.path, "format": recording.format, "channels": channels, "left": left}
        if recording.pieces:
            file["pieces"] = [
                {"file": p.path, "first_s": p.first, "last_s": p.last, "rows": p.rows, "rows_again": p.again}
                for p in recording.pieces
            ]
        files.append({**file, "notes": list(recording.notes), "warnings": list(recording.warnings)})
    clocks = [
        {
            "file": names[clock.file],
            "clock": clock.name,
            "offset_s": _added(merged, clock),
            "drift": clock.drift,
            "sd_s": clock.sd,
            "drift_sd": clock.drift_sd,
            "how": clock.how,
        }
        for clock in merged.clocks
    ]
    return {
        "files": files,
        "columns": columns(merged),
        "clocks": clocks,
        "time": "Unix time" if merged.unix else "the clock of the first sensor's file",
        "settings": {key: {"value": value, "source": source} for key, (value, source) in merged.settings.items()},
        "warnings": list(merged.warnings),
    }


def _added(merged: Merged, clock: JoinedClock) -> float:
    """What is added to the first stamp of a clock [s]."""
    channels = merged.recordings[clock.file].channels
    first = np.array([min(float(c.columns["time"][0]) for c in channels if c.clock == clock.name)])
    return float((clock(first) - first)[0])


def columns(merged: Merged) -> dict[str, str]:
    """Column of the log -> the file and the channel that it came from."""
    names = merged.names
    return {
        column: f"{names[each.file]}: {each.channel.source}"
        for each in merged.selected
        for column in each.channel.columns
        if column != "time"
    }


def timing(channel: Channel) -> dict[str, Any]:
    """Count, rate and largest gap of a channel, by its own clock."""
    time = channel.columns["time"]
    gaps = [float(np.diff(piece).max(initial=0.0)) for (piece,) in in_pieces(time, beyond=1)]
    usual = median_step(time) if len(time) > 1 else 0.0
    return {
        "count": len(time),
        "rate_hz": 1.0 / usual if usual > 0.0 else None,
        "first_s": float(time[0]),
        "last_s": float(time[-1]),
        "gap_s": max(gaps) if len(time) > 1 else None,
    }


def notes(merged: Merged) -> list[str]:
    """What a reader of the log should know, a sentence each."""
    names, said = merged.names, []
    for each in merged.selected:
        frame = f", {each.channel.frame}" if each.channel.frame else ""
        said.append(f"{each.channel.sensor} from {names[each.file]}: {each.channel.source}{frame}")
    said += [f"{names[u.file]}: {u.channel.source} is not used: {u.reason}" for u in merged.unused]
    said += [text for recording in merged.recordings for text in recording.notes]
    if len(merged.clocks) > 1:
        said += [
            f"{names[clock.file]}: clock {clock.name} joined by {clock.how}"
            + (f", sd {clock.sd:.3f} s" if clock.sd else "")
            for clock in merged.clocks
        ]
    return said
