"""Native files of instruments, vehicles and robots, as channels of a log, and tracks as files that others open.

`recording` is what a file becomes, `formats` finds and runs its reader; each format is a module of its own.
"""

from rovgraph.readers.formats import Format, ReadingOptions, formats, read_recording, recognise
from rovgraph.readers.recording import Channel, Clock, Left, Recording

__all__ = [
    "Channel",
    "Clock",
    "Format",
    "Left",
    "ReadingOptions",
    "Recording",
    "formats",
    "read_recording",
    "recognise",
]
