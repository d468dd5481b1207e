"""A track as files that others open: maps, bags, tables and subtitles; and the track at other tables' times.

`track` is what is written, `formats` finds the writers, each in a module of its own; `tagging` places photos.
"""

from rovgraph.export.formats import ExportFormat, Options, check_exportable, export_formats, known_formats, write_track
from rovgraph.export.tagging import Tagged, tag
from rovgraph.export.track import Fixes, Track, fixes_of, read_track

__all__ = [
    "ExportFormat",
    "Fixes",
    "Options",
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
