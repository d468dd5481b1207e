"""KML and KMZ for Google Earth and chart plotters: a track that moves with time, 95 % ellipses and fixes."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rovgraph.export.formats import ExportFormat, Options
from rovgraph.export.points import SHOWN_HZ
from rovgraph.export.track import Track, ellipse

if TYPE_CHECKING:
    import simplekml

ELLIPSES = 60  # along a track
LINE, USED, REJECTED, SHADE = "ff00a5ff", "ff00c000", "ff0000ff", "4000a5ff"  # aabbggrr


def document(track: Track, options: Options) -> "simplekml.Kml":
    """The track; with time where that is known, as a plain line elsewhere."""
    import simplekml

    kml = simplekml.Kml(name=f"{track.name}, {track.estimate}")
    shown = track.at_rate(options.rate_or(SHOWN_HZ))
    lat, lon = shown.lat_lon
    lon = track.continuous(lon)
    height = np.nan_to_num(shown.height)
    coordinates = np.column_stack([lon.round(9), lat.round(9), height.round(4)]).tolist()
    if track.has_utc:
        line = kml.newgxtrack(name=track.name, altitudemode="absolute")
        line.newwhen([stamp.strftime("%Y-%m-%dT%H:%M:%S.%fZ") for stamp in shown.utc])
        line.newgxcoord(coordinates)
        line.newgxangle([(float(yaw), 0.0, 0.0) for yaw in np.rad2deg(shown.trajectory.rpy[:, 2]).round(3) % 360.0])
    else:
        line = kml.newlinestring(name=track.name, altitudemode="absolute", coords=coordinates)
    line.style.linestyle.color, line.style.linestyle.width = LINE, 3
    _add_ellipses(kml, shown)
    _add_fixes(kml, track)
    return kml


def _add_ellipses(kml: "simplekml.Kml", track: Track) -> None:
    t, folder = track.trajectory, kml.newfolder(name="95 % ellipses")
    for k in np.unique(np.linspace(0, len(t) - 1, ELLIPSES).astype(int)):
        if not np.isfinite(P := t.cov_p[k, :2, :2]).all():
            continue
        lat, lon = track.place(*(t.p_n[k, :2] + ellipse(P)).T)
        ring = np.column_stack([track.continuous(lon), lat]).round(9).tolist()
        polygon = folder.newpolygon(name=f"{t.time[k] - t.time[0]:.0f} s", outerboundaryis=ring)
        polygon.style.polystyle.color, polygon.style.linestyle.width = SHADE, 0


def _add_fixes(kml: "simplekml.Kml", track: Track) -> None:
    if track.fixes is None:
        return
    folder, start = kml.newfolder(name="fixes"), track.trajectory.time[0]
    lat, lon = track.place(*track.fixes.position.T)
    lon = track.continuous(lon)
    for k, (time, used) in enumerate(zip(track.fixes.time, track.fixes.used, strict=True)):
        point = folder.newpoint(coords=[(round(float(lon[k]), 9), round(float(lat[k]), 9))])
        point.description = f"{time - start:.1f} s, {'used' if used else 'rejected'}"
        point.style.iconstyle.color = USED if used else REJECTED
        point.style.iconstyle.scale = 0.4


def write_kml(track: Track, path: Path, options: Options) -> None:
    """Plain XML."""
    document(track, options).save(str(path), format=False)


def write_kmz(track: Track, path: Path, options: Options) -> None:
    """The same, compressed."""
    document(track, options).savekmz(str(path), format=False)


FORMATS = (
    ExportFormat("kml", "KML", ".kml", write_kml, "maps", needs_place=True),
    ExportFormat("kmz", "KMZ", ".kmz", write_kmz, "maps", needs_place=True),
)
