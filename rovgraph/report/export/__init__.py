"""A track as files that others open: maps, bags, tables and subtitles; and the track at other tables' times.

`track` is what is written, `formats` finds the writers, each in a module of its own; `tagging` places photos.
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
from rovgraph.report.export.track import Fixes, Track, fixes_of, read_track

__all__ = [
    "ExportFormat",
    "ExportOptions",
    "Fixes",
    "Tagged",
    "Track",
    "check_exportable",
    "export_formats",
    "fixes_of",
    "known_formats",
    "read_track",
    "tag",
    "write_track",
]
