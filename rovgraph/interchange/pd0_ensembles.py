"""Ensembles of Teledyne PD0 files, found by their checksums, and their records as structured arrays.

Source: Teledyne RD Instruments, Workhorse Commands and Output Data Format, P/N 957-6156-00, chapter 8. dolfyn 1.3 does
not import beside NumPy 2, and keeps one coordinate system for a file.
"""

import mmap
import struct
from array import array
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rovgraph.interchange.binary_records import gathered, layout

SYNC = b"\x7f\x7f"
FIXED, VARIABLE, BOTTOM, NAVIGATION = 0x0000, 0x0080, 0x0600, 0x2000
SENTENCES, GGA, HEADING = 0x2022, 0x2101, 0x2104  # of receivers: decoded by WinRiver, and as text
SEVERAL = (SENTENCES, GGA, HEADING)

LAYOUTS = {
    FIXED: layout(
        ("system", "<u2", 4),
        ("coordinates", "u1", 25),
        ("alignment", "<i2", 26),  # of beam 3 against the bow [0.01 deg]
        ("bias", "<i2", 28),  # added to the heading [0.01 deg]
        ("source", "u1", 30),  # which values come from its own sensors
        ("beam_angle", "u1", 58),  # [deg]
    ),
    VARIABLE: layout(
        ("date", "7u1", 4),  # year, month, day, hour, minute, second, hundredths
        ("depth", "<u2", 16),  # [dm]
        ("heading", "<u2", 18),  # [0.01 deg]
        ("pitch", "<i2", 20),
        ("roll", "<i2", 22),
        ("century", "u1", 57),
    ),
    BOTTOM: layout(
        ("range", "4<u2", 16),  # of each beam, along the vertical [cm]
        ("velocity", "4<i2", 24),  # of the bottom [mm/s]
        ("correlation", "4u1", 32),
        ("amplitude", "4u1", 36),
        ("percent_good", "4u1", 40),
        ("water", "4<i2", 50),  # velocity of a layer of water [mm/s]
        ("range_high", "4u1", 77),  # [65536 cm]
    ),
    NAVIGATION: layout(("lat", "<i4", 16), ("lon", "<i4", 20)),  # of a REMUS [180 deg / 2**31]
}
LEAST = {FIXED: 42, VARIABLE: 40, BOTTOM: 48, NAVIGATION: 24}  # bytes, as older firmware writes them
OTHERS = {
    0x0001: "fixed leader of another kind",
    0x0100: "velocity profile",
    0x0200: "correlation profile",
    0x0300: "echo intensity profile",
    0x0400: "percent-good profile",
    0x0500: "status profile",
    0x2100: "depth sentences (DBT)",
    0x2102: "course and speed over ground (VTG)",
    0x2103: "sentences of a satellite receiver",
}


@dataclass
class Ensembles:
    """Where the records of whole ensembles lie.

    Attributes
    ----------
    at : kind -> first byte of its record in each ensemble, -1 = it has none
    length : kind -> bytes of it
    several : kind -> number of the ensemble, first byte and bytes of each record, one after the other
    others : kind -> how many records there are of those that `LAYOUTS` does not know
    failed : ensembles with a wrong checksum
    skipped : bytes that belong to no whole ensemble
    """

    at: dict[int, "array[int]"] = field(default_factory=lambda: {kind: array("q") for kind in LAYOUTS})
    length: dict[int, "array[int]"] = field(default_factory=lambda: {kind: array("q") for kind in LAYOUTS})
    several: dict[int, "array[int]"] = field(default_factory=lambda: {kind: array("q") for kind in SEVERAL})
    others: Counter[int] = field(default_factory=Counter)
    failed: int = 0
    skipped: int = 0

    def __len__(self) -> int:
        return len(self.at[FIXED])

    def records(self, content: bytes | mmap.mmap, kind: int) -> tuple[NDArray[np.void], NDArray[np.bool_]]:
        """Records of a kind, shape (n,), with zeros where an ensemble has none or a short one, and which have it."""
        return gathered(content, LAYOUTS[kind], self.at[kind], self.length[kind], LEAST[kind])

    def records_of(
        self, content: bytes | mmap.mmap, kind: int, fields: np.dtype[np.void]
    ) -> tuple[NDArray[np.void], NDArray[np.int64]]:
        """All records of one of `SEVERAL`, shape (m,), and the numbers of their ensembles."""
        ensemble, at, length = np.array(self.several[kind], np.int64).reshape(-1, 3).T
        return gathered(content, fields, at.tolist(), length.tolist(), 1)[0], ensemble


def find_ensembles(content: bytes | mmap.mmap, progress: Callable[[int], None] = lambda done: None) -> Ensembles:
    """All whole ensembles; behind what is damaged the next one is looked for.

    Parameters
    ----------
    progress : called with the bytes that are done
    """
    found = Ensembles()
    position, size = 0, len(content)
    while (start := content.find(SYNC, position)) >= 0:
        found.skipped += start - position
        end = ensemble_end(content, start)
        table = _table(content, start, end - 2) if end else None
        if end is None or table is None:
            found.skipped += 1
            position = start + 1
        elif sum(memoryview(content)[start : end - 2]) & 0xFFFF != int.from_bytes(content[end - 2 : end], "little"):
            found.failed += 1
            found.skipped += 1
            position = start + 1
        else:
            _keep(found, table, end - 2)
            position = end
            progress(position)
    found.skipped += size - position
    return found


def ensemble_end(content: bytes | mmap.mmap, start: int) -> int | None:
    """Byte behind the ensemble that a header announces; None where it cannot be one, or is cut off."""
    if start + 6 > len(content):
        return None
    end = start + 2 + int.from_bytes(content[start + 2 : start + 4], "little")
    return end if end <= len(content) else None


def _table(content: bytes | mmap.mmap, start: int, end: int) -> list[tuple[int, int]] | None:
    """First byte and kind of each record, in their order; None for what cannot be a table of records."""
    count = content[start + 5]
    first = start + 6 + 2 * count
    if not count or first + 2 > end:
        return None
    offsets = struct.unpack_from(f"<{count}H", content, start + 6)
    if any(start + offset + 2 > end or start + offset < first for offset in offsets):
        return None
    table = [(start + o, int.from_bytes(content[start + o : start + o + 2], "little")) for o in sorted(offsets)]
    kinds = {kind for _, kind in table}
    return table if FIXED in kinds and VARIABLE in kinds else None


def _keep(found: Ensembles, table: list[tuple[int, int]], end: int) -> None:
    bounds = [at for at, _ in table[1:]] + [end]
    known = {kind: (at, bound - at) for (at, kind), bound in zip(table, bounds, strict=True)}
    for (at, kind), bound in zip(table, bounds, strict=True):
        if kind in SEVERAL:
            found.several[kind].extend((len(found), at, bound - at))
    for kind in LAYOUTS:
        at, length = known.get(kind, (-1, 0))
        found.at[kind].append(at)
        found.length[kind].append(length)
    found.others.update(kind for _, kind in table if kind not in LAYOUTS and kind not in SEVERAL)
