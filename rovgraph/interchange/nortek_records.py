"""Records of Nortek's binary files and streams, found by their two checksums.

Source: Nortek AS, Signature Integrator's Guide N3015-007, DVL Integrator's Guide N3015-009, Nucleus Integrator's Guide
N3015-046. dolfyn 1.3 does not import beside NumPy 2 and skips the records of DVLs; nucleus-driver makes a dictionary of
each message of a connection that it opens itself.
"""

import mmap
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

SYNC = b"\xa5"
SEED = 0xB58C  # of the checksums
SHORT, LONG = 10, 12  # bytes of a header
LONGEST = 1 << 20  # bytes of a record

AD2CP_FAMILIES, NUCLEUS_FAMILIES = (0x10, 0x16), (0x20,)


class Header(NamedTuple):
    """Of one record: its kind, family, and first byte and bytes of its data."""

    kind: int
    family: int
    at: int
    size: int


@dataclass
class Records:
    """Where records lie.

    Attributes
    ----------
    at, size : kind -> first byte and bytes of the data of each record
    failed : headers whose data have a wrong checksum, or are cut off
    skipped : bytes that belong to no whole record
    cut : where a record may begin that is cut off; the end where none does
    """

    at: dict[int, list[int]] = field(default_factory=lambda: defaultdict(list))
    size: dict[int, list[int]] = field(default_factory=lambda: defaultdict(list))
    failed: int = 0
    skipped: int = 0
    cut: int = 0


def checksum(data: bytes | memoryview) -> int:
    """Sum of 16-bit words, a last odd byte in the upper half."""
    even = len(data) & ~1
    total = SEED + sum(memoryview(data)[:even].cast("H"))
    return (total + (data[-1] << 8 if len(data) > even else 0)) & 0xFFFF


def header(content: bytes | mmap.mmap, start: int) -> Header | None:
    """The header that begins there; None where none does."""
    length = content[start + 1] if start + 2 <= len(content) else 0
    if length not in (SHORT, LONG) or start + length > len(content):
        return None
    head = content[start : start + length]
    if checksum(head[:-2]) != int.from_bytes(head[-2:], "little"):
        return None
    size = int.from_bytes(head[4 : length - 4], "little")
    return Header(head[2], head[3], start + length, size) if size <= LONGEST else None


def is_whole(content: bytes | mmap.mmap, head: Header) -> bool:
    """Whether the data behind a header are there, and their checksum is right."""
    end = head.at + head.size
    stated = int.from_bytes(content[head.at - 4 : head.at - 2], "little")
    return end <= len(content) and checksum(content[head.at : end]) == stated


def find_records(
    content: bytes | mmap.mmap, families: tuple[int, ...], progress: Callable[[int], None] = lambda done: None
) -> Records:
    """All whole records of some families; behind what is damaged the next one is looked for.

    Parameters
    ----------
    progress : called with the bytes that are done
    """
    found, position, size = Records(), 0, len(content)
    found.cut = size
    while (start := content.find(SYNC, position)) >= 0:
        found.skipped += start - position
        head = header(content, start)
        if head is not None and is_whole(content, head):
            position = head.at + head.size
            found.cut = size  # what seemed to be cut off was none
            if head.family in families:
                found.at[head.kind].append(head.at)
                found.size[head.kind].append(head.size)
            progress(position)
        else:
            found.failed += head is not None
            unfinished = size - start < LONG if head is None else head.at + head.size > size
            found.cut = min(found.cut, start) if unfinished else found.cut
            found.skipped += 1
            position = start + 1
    found.skipped += size - position
    return found
