"""Native files of instruments, vehicles and robots become a log.

May import `rovgraph.diagnosis`, `log`, `sensors`, `model` and what is below. Begin with `formats`, which recognises a
file and runs its reader (each format is a module of its own), and `recording`, which holds what was read. Then
`selection` chooses channels, `clocks` joins their clocks, and `merging` makes one log.
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
