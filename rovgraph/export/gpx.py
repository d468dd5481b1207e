"""GPX 1.1 for chart plotters and phones: a track; elevation is above sea level."""

from pathlib import Path

from rovgraph.export.formats import ExportFormat, Options
from rovgraph.export.points import SHOWN_HZ
from rovgraph.export.track import Track


def write(track: Track, path: Path, options: Options) -> None:
    """A track; with time where that is known."""
    import gpxpy.gpx

    shown = track.at_rate(options.rate_or(SHOWN_HZ))
    gpx = gpxpy.gpx.GPX()
    gpx.creator = "rovgraph"
    line = gpxpy.gpx.GPXTrack(name=f"{track.name}, {track.estimate}")
    segment = gpxpy.gpx.GPXTrackSegment()
    times = shown.utc.to_pydatetime() if shown.has_utc else [None] * len(shown.trajectory)
    for lat, lon, high, time in zip(*shown.lat_lon, shown.height, times, strict=True):
        height = None if high != high else round(float(high), 4)
        segment.points.append(gpxpy.gpx.GPXTrackPoint(round(float(lat), 9), round(float(lon), 9), height, time))
    line.segments.append(segment)
    gpx.tracks.append(line)
    path.write_text(gpx.to_xml("1.1"), encoding="utf-8")


FORMATS = (ExportFormat("gpx", "GPX", ".gpx", write, "maps", needs_place=True),)
