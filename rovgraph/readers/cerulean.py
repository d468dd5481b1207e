"""Cerulean's Tracker 650: sentences with the displacement since the last one.

``$DVPDL,time us,interval us,d roll,d pitch,d yaw,dx,dy,dz,confidence`` and ``$DVPDX``, which has more fields. A
displacement over its interval is a mean velocity, at the middle of it. With zero confidence it is a lost ping, whatever
its values. The turns are always zero. Source: Cerulean Sonar, Tracker 650 Communication Protocol.
"""

import re
from collections import Counter
from pathlib import Path

import numpy as np

from rovgraph.errors import InputError
from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.recording import Channel, Clock, Left, Recording

KINDS = ("DVPDL", "DVPDX")
SENTENCE = re.compile(rb"\$(DV[A-Z]{3}),([^*\r\n]*)(?:\*([0-9A-Fa-f]{2}))?\s*$")
FEW = 2  # sentences that make a file of them
CLOCK = "DVL's time since it was switched on"
COLUMNS = ("dvl_vx", "dvl_vy", "dvl_vz", "dvl_valid")
LONGEST = 400  # bytes of a sentence


def ping(line: bytes) -> tuple[float, dict[str, float]] | None:
    """When the DVL was on for so long [s], and columns of a log; None where a line is no whole sentence of a way."""
    found = SENTENCE.search(line)
    if found is None or found[1].decode() not in KINDS or not _is_whole(found[0]):
        return None
    try:
        time, interval, *_, dx, dy, dz, confidence = (float(cell) for cell in found[2].split(b",")[:9])
    except ValueError:
        return None
    good = confidence > 0.0 and interval > 0.0
    way = np.array([dx, dy, dz]) if good else np.full(3, np.nan)
    velocity = way / (1e-6 * interval or 1.0)
    middle = 1e-6 * (time - 0.5 * max(interval, 0.0))
    return middle, dict(zip(COLUMNS, (*velocity.tolist(), float(good)), strict=True))


def _is_whole(sentence: bytes) -> bool:
    """Whether its checksum is right, where it has one."""
    body, star, told = sentence.strip().removeprefix(b"$").partition(b"*")
    return not star or int(np.bitwise_xor.reduce(np.frombuffer(body, np.uint8))) == int(told[:2], 16)


class Cerulean:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "cerulean"
    title = "Cerulean Tracker 650 sentences"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        known = sum(ping(line) is not None for line in head.splitlines()[:200])
        return 0.9 if known >= FEW else 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        rows: list[tuple[float, ...]] = []
        lost, size = Counter[str](), path.stat().st_size
        with path.open("rb") as file:
            while line := file.readline(LONGEST):
                options.progress(min(file.tell(), size), size)
                report = ping(line)
                if report is not None:
                    rows.append((report[0], *report[1].values()))
                elif line.strip():
                    found = SENTENCE.search(line)
                    lost[found[1].decode() if found else "a line that is no whole sentence"] += 1
        if not rows:
            raise InputError(f"{path}: no whole sentence DVPDL or DVPDX")
        columns = dict(zip(("time", *COLUMNS), np.array(rows).T, strict=True))
        left = tuple(Left(name, count, "no way of the vehicle, or damaged") for name, count in sorted(lost.items()))
        channel = Channel("dvl", columns, "DVPDL, DVPDX: way over its interval", "forward, starboard, down", CLOCK)
        return Recording(str(path), self.name, (channel,), {CLOCK: Clock(CLOCK)}, left)


FORMAT = Cerulean()
