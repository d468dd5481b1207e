"""Nortek's binary records, found by their two checksums, and bottom and water tracks as channels of a log.

Velocities are those of the instrument, along its X, Y and Z: forward, starboard and down as it is drawn.

Source: Nortek AS, Signature Integrator's Guide N3015-007, DVL Integrator's Guide N3015-009, Nucleus Integrator's Guide
N3015-046. dolfyn 1.3 does not import beside NumPy 2 and skips the records of DVLs; nucleus-driver makes a dictionary of
each message of a connection that it opens itself.
"""

import mmap
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.readers.recording import Channel

FRAME = "X, Y, Z of the instrument: forward, starboard, down as it is drawn"
LONGEST_DELAY_S = 5.0  # from a stamp to the echo; more is invalid
BAR = 1e5  # [Pa]


@dataclass(frozen=True)
class NortekTrack:
    """A track of n pings.

    Attributes
    ----------
    time : of the records [s]
    delay : from there to the echo [s], ndarray, shape (n,)
    velocity : of the instrument, shape (n, 3); NaN = none [m/s]
    sd : figure of merit of each axis, shape (n, 3); NaN = none [m/s]
    range : to the bottom along each beam, shape (n, beams); NaN = none [m]
    beams : velocity along each beam, positive towards where it points, shape (n, beams); NaN = none [m/s]
    merit : figure of merit of each beam, shape (n, beams) [m/s]
    """

    time: Array
    delay: Array
    velocity: Array
    sd: Array
    range: Array
    beams: Array
    merit: Array

    @property
    def stamp(self) -> Array:
        """When the bottom was heard [s]."""
        known = np.isfinite(self.delay) & (np.abs(self.delay) < LONGEST_DELAY_S)
        return self.time + np.where(known, self.delay, 0.0)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Which pings have a velocity on all axes."""
        return np.asarray(np.isfinite(self.velocity).all(axis=1))


def bottom_channels(track: NortekTrack, name: str, clock: str) -> Iterator[Channel]:
    """Velocity over the bottom, and altitude."""
    valid = track.valid
    vx, vy, vz = np.where(valid[:, None], track.velocity, np.nan).T
    sd = np.sqrt(np.mean(track.sd**2, axis=1))
    columns = {"dvl_vx": vx, "dvl_vy": vy, "dvl_vz": vz, "dvl_valid": valid.astype(float)}
    if np.isfinite(sd).any():
        columns["dvl_sd"] = np.where(valid, sd, np.nan)
    yield Channel("dvl", {"time": track.stamp, **columns}, f"{name}: {', '.join(columns)}", FRAME, clock)
    seen = np.isfinite(track.range)
    if (any_ := seen.any(axis=1)).any():
        mean = np.nansum(track.range[any_], axis=1) / seen[any_].sum(axis=1)
        yield Channel("dvl_altitude", {"time": track.stamp[any_], "dvl_altitude": mean}, f"{name}: distance", "", clock)


def water_channels(track: NortekTrack, name: str, clock: str) -> Iterator[Channel]:
    """Velocity through the water."""
    if (valid := track.valid).any():
        names = "dvl_water_vx", "dvl_water_vy", "dvl_water_vz"
        columns = dict(zip(names, track.velocity[valid].T, strict=True))
        yield Channel("dvl_water", {"time": track.stamp[valid], **columns}, f"{name}: velocity", FRAME, clock)


def beam_table(track: NortekTrack) -> dict[str, Array]:
    """Measurements of each beam, without velocities where they were turned into axes; {} = none."""
    of_beams = {"velocity": track.beams, "range": track.range, "sd": track.merit}
    if not np.isfinite(track.beams).any():
        del of_beams["velocity"], of_beams["sd"]
    count = track.beams.shape[1]
    columns = {f"{name}_{k + 1}": values[:, k] for name, values in of_beams.items() for k in range(count)}
    return {"time": track.stamp, **columns} if any(np.isfinite(c).any() for c in columns.values()) else {}


def where_bits(values: Array, status: NDArray[np.integer], first: int) -> Array:
    """Values, NaN where their bit of the status is not set: the first column has the bit ``first``."""
    bits = (status[:, None] >> (first + np.arange(values.shape[1]))) & 1
    return np.where(bits == 1, values, np.nan).astype(float)


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
