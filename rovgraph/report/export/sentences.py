"""Text in time: NMEA 0183 and subtitles.

NMEA 0183 for programs that replay a ship's log: GGA, HDT and VTG at a rate.

SRT subtitles of position and heading for the dive's video, which begins with the track.
"""

from datetime import timedelta
from pathlib import Path

import numpy as np

from rovgraph.live.outputs.nmea import course_sentence, heading_sentence, position_sentence
from rovgraph.report.export.formats import ExportFormat, ExportOptions
from rovgraph.report.export.track import SHOWN_HZ, Track


def write_nmea(track: Track, path: Path, options: ExportOptions) -> None:
    """Sentences with the time of day, UTC where the dive's time is Unix time."""
    sampled = track.at_rate(options.rate_or(SHOWN_HZ))
    t = sampled.trajectory
    sd = np.hypot(t.p_sd[:, 0], t.p_sd[:, 1])
    rows = np.column_stack([t.time, *sampled.lat_lon, -sampled.height, sd, t.rpy[:, 2], t.v_n[:, :2]]).tolist()
    with path.open("w", encoding="ascii", newline="") as file:
        for time, lat, lon, down, spread, yaw, north, east in rows:
            file.write(position_sentence(time, lat, lon, down, spread))
            file.write(heading_sentence(yaw) + course_sentence(north, east))


_NMEA = (ExportFormat("nmea", "NMEA 0183", ".nmea", write_nmea, needs_place=True),)


def write_srt(track: Track, path: Path, options: ExportOptions) -> None:
    """One subtitle a second, or at the rate asked for."""
    rate = options.rate_or(SHOWN_HZ)
    sampled, start = track.at_rate(rate), track.trajectory.time[0]
    t = sampled.trajectory
    where = _places(sampled)
    sd, heading = np.hypot(t.p_sd[:, 0], t.p_sd[:, 1]), np.rad2deg(t.rpy[:, 2]).round() % 360.0
    blocks = []
    for k, time in enumerate((t.time - start).tolist()):
        lines = [
            f"{where[k]}" + (f" ±{sd[k]:.1f} m" if np.isfinite(sd[k]) else ""),
            f"heading {heading[k]:03.0f}°  depth {t.p_n[k, 2]:.1f} m",
        ]
        if sampled.has_utc:
            lines.append(f"{sampled.utc[k]:%Y-%m-%d %H:%M:%S} UTC")
        blocks.append("\n".join([str(k + 1), f"{_stamp(time)} --> {_stamp(time + 1.0 / rate)}", *lines]))
    path.write_text("\n\n".join(blocks) + "\n", encoding="utf-8")


def _places(track: Track) -> list[str]:
    """Latitude and longitude where known, else north and east."""
    if track.origin is None:
        return [f"N {north:.1f} m  E {east:.1f} m" for north, east in track.trajectory.p_n[:, :2]]
    return [f"{lat:.6f}°, {lon:.6f}°" for lat, lon in zip(*track.lat_lon, strict=True)]


def _stamp(seconds: float) -> str:
    duration = timedelta(milliseconds=round(1000.0 * seconds))
    minutes, rest = divmod(duration // timedelta(milliseconds=1), 60_000)
    return f"{minutes // 60:02d}:{minutes % 60:02d}:{rest // 1000:02d},{rest % 1000:03d}"


_SRT = (ExportFormat("srt", "SRT subtitles", ".srt", write_srt),)

FORMATS = (*_NMEA, *_SRT)
