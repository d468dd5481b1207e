"""Native files of instruments, vehicles and robots, as channels of a log, and tracks as files that others open.

`recording` is what a file becomes, `formats` finds and runs its reader; each format is a module of its own.
"""

from rovgraph.interchange.formats import Format, Options, formats, read_recording, recognise
from rovgraph.interchange.recording import Channel, Clock, Left, Recording

__all__ = ["Channel", "Clock", "Format", "Left", "Options", "Recording", "formats", "read_recording", "recognise"]
