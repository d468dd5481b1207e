"""Messages of an ArduPilot DataFlash log as arrays, many at a time.

A log is a row of messages: 0xA3 0x95, a type, and as many bytes as the type's format states. Formats are messages
themselves (FMT); units and multipliers of their fields too (UNIT, MULT, FMTU). There are no checksums. Source:
https://ardupilot.org/dev/docs/code-overview-adding-a-new-log-message.html and libraries/AP_Logger of ArduPilot.

Headers are found by NumPy in all bytes of a block; Python walks only from one gap between messages to the next.
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
from rovgraph.log.disk_columns import GrowingColumn, taken

HEAD = b"\xa3\x95"
FMT = 128  # type of the message that defines all others, itself too
INSTANCE = ("I", "Instance")  # fields with the number of the sensor
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

    def stores(self, names: Collection[str], other: "MessageFormat") -> bool:
        """Whether it has these fields, stored as another format of the same name stores them."""
        return all(
            name in self.multipliers
            and self.dtype[name] == other.dtype[name]
            and self.multipliers[name] == other.multipliers[name]
            for name in names
        )


@dataclass
class DataflashMessages:
    """All messages of one name.

    Attributes
    ----------
    fields : field -> ndarray, shape (n,), as stored: without multipliers; integers of 64 bits as floats. Not to be
        changed: long ones are in temporary files (`rovgraph.log.disk_columns`)
    units : field -> its unit's label, such as "m/s/s"; "" where the file does not state it
    multipliers : field -> factor that makes that unit of what is stored
    """

    fields: dict[str, NDArray[Any]]
    units: dict[str, str] = field(default_factory=dict)
    multipliers: dict[str, float] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(next(iter(self.fields.values())))

    def __contains__(self, name: str) -> bool:
        return name in self.fields

    def value(self, name: str) -> Array:
        """A field in its unit, shape (n,)."""
        return np.asarray(self.fields[name] * self.multipliers[name], dtype=float)

    def take(self, index: NDArray[Any]) -> "DataflashMessages":
        """Some of them, by a mask."""
        return DataflashMessages({k: taken(v, index) for k, v in self.fields.items()}, self.units, self.multipliers)


@dataclass(frozen=True)
class Contents:
    """Contents of a log.

    Attributes
    ----------
    messages : name -> Messages, those that were wanted and are there
    places : name -> ndarray of int, shape (n,), bytes of the file where they begin
    counts : name -> how many there are, of all
    instances : name -> instances that there are, of those of which one was wanted
    unlike : name -> how many were wanted, but have other fields or types of them than the first of that name
    damaged : stretches of bytes between messages
    damaged_bytes : bytes in them, without a message that the end of the file cuts off
    cut_off : bytes of that message
    """

    messages: dict[str, DataflashMessages]
    places: dict[str, NDArray[np.integer[Any]]]
    counts: Counter[str]
    instances: Mapping[str, set[int]]
    unlike: Counter[str]
    damaged: int
    damaged_bytes: int
    cut_off: int


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
    total, rest, start = path.stat().st_size, b"", 0
    walk = _Walk({**wanted, **_DEFINING}, only, np.dtype(np.uint32 if total < 2**32 else np.int64))
    with path.open("rb") as file:
        while block := file.read(BLOCK):
            data = rest + block
            used = walk.walk(data, start)
            rest, start = data[used:], start + used
            progress(start, total)
    cut_off = len(rest) - walk.walk(rest, start, last=True)
    return walk.contents(cut_off)


class _Heads:
    """Where messages may begin in a block of bytes.

    Attributes
    ----------
    at : ndarray of int, shape (n,), of the bytes of a header
    kind : ndarray of uint8, shape (n,), the type that follows each
    after : ndarray of int, shape (n,), where the next message begins; a length of 0 is not known
    sound : ndarray of bool, shape (n,), whether one begins there, or the file ends
    """

    def __init__(self, data: bytes, lengths: NDArray[np.int64], last: bool) -> None:
        raw = np.frombuffer(data, np.uint8)
        end = len(raw)
        begins = np.zeros(end + 2, bool)
        begins[: max(end - 1, 0)] = (raw[:-1] == HEAD[0]) & (raw[1:] == HEAD[1])
        self.at = np.flatnonzero(begins[: max(end - 2, 0)])
        self.kind = raw[self.at + 2]
        self.after = self.at + lengths[self.kind]
        if last and end:
            begins[end - 1] = raw[-1] == HEAD[0]
            begins[end] = True
        self.sound = (self.after > self.at) & begins[np.minimum(self.after, end + 1)]
        self.end = end
        followed = self.sound.copy()  # by the next head, without a gap
        followed[:-1] &= self.at[1:] == self.after[:-1]
        followed[-1:] = False
        self._last = np.flatnonzero(~followed)  # of each stretch

    def from_place(self, place: int) -> int:
        """Index of the first head there or behind it."""
        return int(np.searchsorted(self.at, place))

    def stretch(self, index: int) -> int:
        """Index of the last of the messages that follow each other from this one on; it may not be sound itself."""
        return int(self._last[np.searchsorted(self._last, index)])


class _Walk:
    """Goes from message to message, and keeps the fields that are wanted."""

    def __init__(
        self, wanted: Mapping[str, Collection[str]], only: Mapping[str, int | None], place: np.dtype[Any]
    ) -> None:
        self._wanted = wanted
        self._only = dict(only)
        self._place = place
        self._instances: dict[str, set[int]] = {}
        self._formats: dict[int, MessageFormat] = {}
        self._columns: dict[str, dict[str, GrowingColumn]] = {}
        self._counts: Counter[str] = Counter()
        self._unlike: Counter[str] = Counter()
        self._first: dict[str, MessageFormat] = {}  # of those of a name that are kept
        self._damaged = self._damaged_bytes = 0
        self._sane = True
        self._lengths = np.zeros(256, np.int64)
        self._lengths[FMT] = len(HEAD) + 1 + _FMT.size

    def walk(self, data: bytes, start: int, last: bool = False) -> int:
        """Walk the messages that are whole; returns how many bytes they are.

        A message counts if the next one begins where it ends: one that lost bytes, or that only looks like one, does
        not.
        """
        heads = _Heads(data, self._lengths, last)
        defining = heads.at[(heads.kind == FMT) & heads.sound].tolist()
        if any([self._define(data, at) for at in defining]):
            heads = _Heads(data, self._lengths, last)
        place, taken = 0, np.zeros(len(heads.at), bool)
        while place + 3 <= heads.end:
            index = heads.from_place(place)
            if index == len(heads.at) or heads.at[index] != place:
                place = self._skip(heads, index, place)
                continue
            final = heads.stretch(index)
            taken[index:final] = True
            self._sane |= final > index
            place, after = int(heads.at[final]), int(heads.after[final])
            if after > heads.end or (after > place and after + 2 > heads.end and not last):
                break  # continues in the next block, or is cut off by the end of the file
            if heads.sound[final]:
                taken[final] = self._sane = True
                place = after
            else:
                place = self._skip(heads, final + 1, place)
        self._collect(data, heads.at[taken], heads.kind[taken], start)
        return place

    def _skip(self, heads: _Heads, index: int, place: int) -> int:
        """The next place where a message may begin, that of a head; what is skipped counts as damaged."""
        found = int(heads.at[index]) if index < len(heads.at) else max(place + 1, heads.end - len(HEAD))
        self._damaged += self._sane
        self._sane = False
        self._damaged_bytes += found - place
        return found

    def _define(self, data: bytes, at: int) -> bool:
        """Take a format that is new; one whose fields do not fill its length keeps the length alone."""
        kind, length, *texts = _FMT.unpack_from(data, at + 3)
        name, characters, columns = (text.split(b"\0")[0].decode("ascii", "replace") for text in texts)
        if self._lengths[kind] or length < 3:  # repeated, or damaged
            return False
        names = columns.split(",")
        whole = len(names) == len(characters) == len(set(names)) and all(c in _CHARACTERS for c in characters)
        packed = [(n, "<" + _CHARACTERS[c][0]) for n, c in zip(names, characters, strict=True)] if whole else []
        dtype = np.dtype(packed)
        if dtype.itemsize != length - 3:
            packed, dtype = [], np.dtype([])
        multipliers = {n: _CHARACTERS[c][1] for (n, _), c in zip(packed, characters, strict=False)}
        self._formats[kind] = MessageFormat(name, length, dtype, multipliers)
        self._lengths[kind] = length
        return True

    def _collect(self, data: bytes, at: NDArray[np.int64], kinds: NDArray[np.uint8], start: int) -> None:
        """Copy the fields that are wanted out of the block."""
        for kind, count in enumerate(np.bincount(kinds, minlength=256).tolist()):
            if not count:
                continue
            form = self._formats.get(kind)
            self._counts["FMT" if form is None else form.name] += count
            if form is None or not (names := self._fields(form)):
                continue
            index, size = at[kinds == kind], form.dtype.itemsize
            every = np.ndarray(len(data) - size + 1, f"V{size}", data, 0, (1,))  # what begins at each byte
            rows = every[index + 3].view(form.dtype)
            if form.name in self._only and (numbers := instances(rows)) is not None:
                chosen = self._choose(form.name, numbers)
                rows, index = rows[chosen], index[chosen]
            columns = self._columns.setdefault(form.name, {})
            if not columns:
                columns |= {_PLACE: GrowingColumn(self._place)} | {
                    n: GrowingColumn(_dtype_in_memory(form.dtype[n])) for n in names
                }
            if not form.stores(columns.keys() - {_PLACE}, self._first.setdefault(form.name, form)):
                self._unlike[form.name] += len(rows)
                continue
            for name, column in columns.items():
                column.extend(index + start if name == _PLACE else rows[name])

    def _choose(self, name: str, numbers: NDArray[Any]) -> NDArray[np.bool_]:
        """Which rows are of the instance that is wanted."""
        self._instances.setdefault(name, set()).update(np.unique(numbers).tolist())
        if self._only[name] is None:
            self._only[name] = int(numbers[0])
        return np.asarray(numbers == self._only[name])

    def _fields(self, form: MessageFormat) -> list[str]:
        return [n for n in self._wanted.get(form.name, ()) if n in form.multipliers]

    def contents(self, cut_off: int) -> Contents:
        """Contents of the bytes read so far."""
        places = {name: columns.pop(_PLACE).array() for name, columns in self._columns.items()}
        found = {
            name: DataflashMessages({n: column.array() for n, column in c.items()}) for name, c in self._columns.items()
        }
        self._give_units(found)
        damaged = self._damaged, self._damaged_bytes
        return Contents(found, places, self._counts, self._instances, self._unlike, *damaged, cut_off)

    def _give_units(self, found: dict[str, DataflashMessages]) -> None:
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


def _dtype_in_memory(stored: np.dtype[Any]) -> np.dtype[Any]:
    """How a field is kept: integers of 64 bits as floats, so that times become seconds where they are."""
    return np.dtype(float) if stored == np.uint64 else stored


def instances(rows: NDArray[Any]) -> NDArray[Any] | None:
    """Instance of each row of messages, shape (n,); None where their format has no instances."""
    return next((rows[name] for name in INSTANCE if name in (rows.dtype.names or ())), None)


def _declared(of_kind: DataflashMessages) -> dict[int, tuple[bytes, bytes]]:
    """Type -> ids of its fields' units and multipliers."""
    columns = (of_kind.fields[name].tolist() for name in _DEFINING["FMTU"])
    return {kind: (units, scales) for kind, units, scales in zip(*columns, strict=True)}


def texts(raw: NDArray[Any]) -> list[str]:
    return [text.split(b"\0")[0].decode("utf-8", "replace") for text in raw.tolist()]
