"""Messages of an ArduPilot DataFlash log as arrays, many at a time.

A log is a row of messages: 0xA3 0x95, a type, and as many bytes as the type's format says. Formats are messages
themselves (FMT); units and multipliers of their fields too (UNIT, MULT, FMTU). There are no checksums. Source:
https://ardupilot.org/dev/docs/code-overview-adding-a-new-log-message.html and libraries/AP_Logger of ArduPilot.

Only the headers are walked in Python; the rows of the messages that are wanted are copied out by NumPy.
"""

import struct
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array

HEAD = b"\xa3\x95"
FMT = 128  # type of the message that defines all others, itself too
ENDINGS = (HEAD, HEAD[:1], b"")  # what may follow a message: the next one, or the end of the file
INSTANCE = ("I", "Instance")  # fields that say which of several sensors it is
BLOCK = 1 << 22  # bytes walked at a time
_PLACE = " place"  # no field has a blank in its name

_FMT = struct.Struct("<BB4s16s64s")
# format character -> dtype, multiplier that it implies
_CHARACTERS: dict[str, tuple[str, float]] = {
    "b": ("i1", 1.0),
    "B": ("u1", 1.0),
    "h": ("i2", 1.0),
    "H": ("u2", 1.0),
    "i": ("i4", 1.0),
    "I": ("u4", 1.0),
    "q": ("i8", 1.0),
    "Q": ("u8", 1.0),
    "g": ("f2", 1.0),
    "f": ("f4", 1.0),
    "d": ("f8", 1.0),
    "M": ("u1", 1.0),
    "c": ("i2", 1e-2),
    "C": ("u2", 1e-2),
    "e": ("i4", 1e-2),
    "E": ("u4", 1e-2),
    "L": ("i4", 1e-7),
    "a": ("S64", 1.0),  # 32 numbers in a row, which nothing here needs
    "n": ("S4", 1.0),
    "N": ("S16", 1.0),
    "Z": ("S64", 1.0),
}
_DEFINING = {"UNIT": ("Id", "Label"), "MULT": ("Id", "Mult"), "FMTU": ("FmtType", "UnitIds", "MultIds")}


@dataclass(frozen=True)
class MessageFormat:
    """How the messages of one type are packed.

    Attributes
    ----------
    name : such as "IMU"
    length : bytes of a message with its header
    dtype : of what follows the header
    multipliers : field -> what its format character multiplies it by
    """

    name: str
    length: int
    dtype: np.dtype[Any]
    multipliers: Mapping[str, float]


@dataclass
class Messages:
    """All messages of one name.

    Attributes
    ----------
    fields : field -> ndarray, shape (n,), as stored: without multipliers
    place : ndarray of int, shape (n,), byte of the file where each begins
    units : field -> its unit's label, such as "m/s/s"; "" where the file does not say
    multipliers : field -> factor that makes that unit of what is stored
    """

    fields: dict[str, NDArray[Any]]
    place: NDArray[np.int64]
    units: dict[str, str] = field(default_factory=dict)
    multipliers: dict[str, float] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.place)

    def __contains__(self, name: str) -> bool:
        return name in self.fields

    def value(self, name: str) -> Array:
        """A field in its unit, shape (n,)."""
        return np.asarray(self.fields[name] * self.multipliers[name], dtype=float)

    def take(self, index: NDArray[Any]) -> "Messages":
        """Some of them, by a mask."""
        return Messages({k: v[index] for k, v in self.fields.items()}, self.place[index], self.units, self.multipliers)


@dataclass(frozen=True)
class Contents:
    """What a log holds.

    Attributes
    ----------
    messages : name -> Messages, those that were wanted and are there
    counts : name -> how many there are, of all
    instances : name -> instances that there are, of those of which one was wanted
    damaged : stretches of bytes that are no message
    damaged_bytes : bytes in them, without a message that the end of the file cuts off
    """

    messages: dict[str, Messages]
    counts: Counter[str]
    instances: Mapping[str, set[int]]
    damaged: int
    damaged_bytes: int


def read_messages(
    path: Path,
    wanted: Mapping[str, Collection[str]],
    only: Mapping[str, int | None] = MappingProxyType({}),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Contents:
    """Read a log.

    Parameters
    ----------
    path : of the log, not compressed
    wanted : name of a message -> its fields that are wanted; those that its format lacks are not in the answer
    only : name of a message -> the one instance that is wanted, None = the first; without it all are
    progress : called with the bytes read and those of the file
    """
    walk = _Walk({**wanted, **_DEFINING}, only)
    total, rest, start = path.stat().st_size, b"", 0
    with path.open("rb") as file:
        while block := file.read(BLOCK):
            data = rest + block
            used = walk.walk(data, start)
            rest, start = data[used:], start + used
            progress(start, total)
    walk.walk(rest, start, last=True)
    return walk.contents()


class _Growing:
    """Rows that come in blocks, in one piece of memory that grows where it is: a copy would be as large as they are."""

    def __init__(self, dtype: np.dtype[Any]) -> None:
        self._held = np.zeros(0, dtype)
        self._count = 0

    def more(self, count: int) -> NDArray[Any]:
        """So many new rows, to be filled before more are asked for."""
        first, self._count = self._count, self._count + count
        if self._count > len(self._held):
            self._held.resize(max(self._count, len(self._held) * 4 // 3), refcheck=False)
        return self._held[first : self._count]

    def whole(self) -> NDArray[Any]:
        """All rows."""
        self._held.resize(self._count, refcheck=False)
        return self._held


class _Walk:
    """Goes from header to header, and keeps the rows that are wanted.

    Attributes
    ----------
    lengths : of the messages of each type; 0 = no format known
    places : of those of each type, within the block
    """

    def __init__(self, wanted: Mapping[str, Collection[str]], only: Mapping[str, int | None]) -> None:
        self._wanted = wanted
        self._only = dict(only)
        self._instances: dict[str, set[int]] = {}
        self._formats: dict[int, MessageFormat] = {}
        self._rows: dict[str, _Growing] = {}
        self._counts: Counter[str] = Counter()
        self._damaged = self._damaged_bytes = 0
        self._sane = True
        self._lengths = [0] * 256
        self._lengths[FMT] = len(HEAD) + 1 + _FMT.size
        self._places: list[list[int]] = [[] for _ in range(256)]

    def walk(self, data: bytes, start: int, last: bool = False) -> int:
        """Walk the messages that are whole; returns how many bytes they are.

        A message counts if the next one begins where it ends: one that lost bytes, or that only looks like one, does
        not.
        """
        lengths, places = self._lengths, self._places
        at, end = 0, len(data)
        while at + 3 <= end:
            kind = data[at + 2]
            length = lengths[kind]
            after = at + length
            if after + 2 > end and length and not last:
                break
            if after > end and data[at : at + 2] == HEAD:
                break  # cut off by the end of the file
            if not length or data[at] != 0xA3 or data[at + 1] != 0x95 or data[after : after + 2] not in ENDINGS:
                at = self._resume(data, at)
                continue
            if kind == FMT:
                self._define(data, at)
            places[kind].append(at)
            self._sane = True
            at = after
        self._collect(data, start)
        return at

    def _resume(self, data: bytes, at: int) -> int:
        """The next place where a message may begin; what is skipped counts as damaged."""
        found = data.find(HEAD, at + 1)
        after = found if found >= 0 else max(at + 1, len(data) - len(HEAD))  # a header may be cut in two
        self._damaged += self._sane
        self._sane = False
        self._damaged_bytes += after - at
        return after

    def _define(self, data: bytes, at: int) -> None:
        """Take a format; one whose fields do not fill its length keeps the length alone."""
        kind, length, *texts = _FMT.unpack_from(data, at + 3)
        name, characters, columns = (text.split(b"\0")[0].decode("ascii", "replace") for text in texts)
        if self._lengths[kind] or length < 3:  # repeated, or damaged
            return
        names = columns.split(",")
        whole = len(names) == len(characters) == len(set(names)) and all(c in _CHARACTERS for c in characters)
        packed = [(n, "<" + _CHARACTERS[c][0]) for n, c in zip(names, characters, strict=True)] if whole else []
        dtype = np.dtype(packed)
        if dtype.itemsize != length - 3:
            packed, dtype = [], np.dtype([])
        multipliers = {n: _CHARACTERS[c][1] for (n, _), c in zip(packed, characters, strict=False)}
        self._formats[kind] = MessageFormat(name, length, dtype, multipliers)
        self._lengths[kind] = length

    def _collect(self, data: bytes, start: int) -> None:
        """Copy the rows that are wanted out of the block, and forget their places."""
        raw = np.frombuffer(data, dtype=np.uint8)
        for kind, places in enumerate(self._places):
            if not places:
                continue
            form = self._formats.get(kind)
            self._counts["FMT" if form is None else form.name] += len(places)
            if form is not None and (names := self._fields(form)):
                index = np.array(places)
                rows = raw[index[:, None] + np.arange(3, form.length)].view(form.dtype)[:, 0]
                if form.name in self._only and (numbers := instances(rows)) is not None:
                    chosen = self._choose(form.name, numbers)
                    rows, index = rows[chosen], index[chosen]
                if form.name not in self._rows:
                    self._rows[form.name] = _Growing(np.dtype([(_PLACE, "i8"), *((n, form.dtype[n]) for n in names)]))
                kept = self._rows[form.name].more(len(rows))
                kept[_PLACE] = index + start
                for name in names:
                    kept[name] = rows[name]
            places.clear()

    def _choose(self, name: str, numbers: NDArray[Any]) -> NDArray[np.bool_]:
        """Which rows are of the instance that is wanted."""
        self._instances.setdefault(name, set()).update(np.unique(numbers).tolist())
        if self._only[name] is None:
            self._only[name] = int(numbers[0])
        return np.asarray(numbers == self._only[name])

    def _fields(self, form: MessageFormat) -> list[str]:
        return [n for n in self._wanted.get(form.name, ()) if n in form.multipliers]

    def contents(self) -> Contents:
        """All that was walked."""
        found = {}
        for name, growing in self._rows.items():
            rows = growing.whole()
            fields = {n: rows[n] for n in rows.dtype.names or () if n != _PLACE}
            found[name] = Messages(fields, rows[_PLACE])
        self._give_units(found)
        return Contents(found, self._counts, self._instances, self._damaged, self._damaged_bytes)

    def _give_units(self, found: dict[str, Messages]) -> None:
        """Units and multipliers by the log's own tables; a format character's multiplier goes before them."""
        tables = {name: found.pop(name, None) for name in _DEFINING}
        units, factors, of_kind = (
            table if table is not None and all(name in table for name in _DEFINING[of]) else None
            for of, table in tables.items()
        )
        labels = {} if units is None else dict(zip(units.fields["Id"], texts(units.fields["Label"]), strict=True))
        scales = {} if factors is None else dict(zip(factors.fields["Id"], factors.fields["Mult"], strict=True))
        declared = {} if of_kind is None else _declared(of_kind)
        for kind, form in self._formats.items():
            if (messages := found.get(form.name)) is None:
                continue
            unit_ids, scale_ids = declared.get(kind, (b"", b""))
            for place, (name, implied) in enumerate(form.multipliers.items()):
                unit, scale = unit_ids[place : place + 1], scale_ids[place : place + 1]
                label = labels.get(ord(unit), "") if unit else ""
                known = scales.get(ord(scale), 0.0) if label and scale not in (b"", b"?") else 0.0
                messages.units[name] = label
                messages.multipliers[name] = implied if implied != 1.0 or not known else float(known)


def instances(rows: NDArray[Any]) -> NDArray[Any] | None:
    """Of which instance rows of messages are, shape (n,); None where their format knows none."""
    return next((rows[name] for name in INSTANCE if name in (rows.dtype.names or ())), None)


def _declared(of_kind: Messages) -> dict[int, tuple[bytes, bytes]]:
    """Type -> ids of its fields' units and multipliers."""
    columns = (of_kind.fields[name].tolist() for name in _DEFINING["FMTU"])
    return {kind: (units, scales) for kind, units, scales in zip(*columns, strict=True)}


def texts(raw: NDArray[Any]) -> list[str]:
    return [text.split(b"\0")[0].decode("utf-8", "replace") for text in raw.tolist()]
