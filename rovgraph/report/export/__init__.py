"""Exports of a track: maps, bags, tables and subtitles; and the track at the times of another table.

May import what `rovgraph.report` may. Begin with `track` (the data to export) and `formats` (finds the writers, a
module for each kind); `tagging` places photos. docs/export.md describes the use.
"""

from rovgraph.report.export.formats import (
    ExportFormat,
    ExportOptions,
    check_exportable,
    export_formats,
    known_formats,
    write_track,
)
from rovgraph.report.export.tagging import Tagged, tag
from rovgraph.report.export.track import Fixes, ShipAndBeacons, Track, acoustics_of, fixes_of, read_track

__all__ = [
    "ExportFormat",
    "ExportOptions",
    "Fixes",
    "ShipAndBeacons",
    "Tagged",
    "Track",
    "acoustics_of",
    "check_exportable",
    "export_formats",
    "fixes_of",
    "known_formats",
    "read_track",
    "tag",
    "write_track",
]
