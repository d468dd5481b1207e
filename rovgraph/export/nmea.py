"""NMEA 0183 for whatever replays a ship's log: GGA, HDT and VTG at a rate."""

from pathlib import Path

import numpy as np

from rovgraph.export.formats import ExportFormat, Options
from rovgraph.export.points import SHOWN_HZ
from rovgraph.export.track import Track
from rovgraph.live.outputs.nmea import course_sentence, heading_sentence, position_sentence


def write(track: Track, path: Path, options: Options) -> None:
    """Sentences with the time of day, UTC where the dive's time is Unix time."""
    shown = track.at_rate(options.rate_or(SHOWN_HZ))
    t = shown.trajectory
    sd = np.hypot(t.p_sd[:, 0], t.p_sd[:, 1])
    rows = np.column_stack([t.time, *shown.lat_lon, -shown.height, sd, t.rpy[:, 2], t.v_n[:, :2]]).tolist()
    with path.open("w", encoding="ascii", newline="") as file:
        for time, lat, lon, down, spread, yaw, north, east in rows:
            file.write(position_sentence(time, lat, lon, down, spread))
            file.write(heading_sentence(yaw) + course_sentence(north, east))


FORMATS = (ExportFormat("nmea", "NMEA 0183", ".nmea", write, needs_place=True),)
