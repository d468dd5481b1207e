"""What recorded MAVLink messages said, as arrays."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.interchange.mavlink import COLUMNS, READERS, usec
from rovgraph.spilling import FlatTable, computed, taken

OF_PARAMETERS = "PARAM_VALUE", "SENSOR_OFFSETS"
WANTED = {*READERS, *OF_PARAMETERS}
Sender = tuple[int, int]  # system, component


@dataclass(frozen=True)
class Rows:
    """What messages of one sender and name said of one sensor.

    Attributes
    ----------
    sender : system and component
    name : of the message
    place : ndarray of int, shape (n,), numbers of the messages
    received : ndarray, shape (n,), by the receiver's clock [s]
    stamp : ndarray, shape (n,), by the sender's [s]; NaN = none
    columns : column -> ndarray, shape (n,)
    """

    sender: Sender
    name: str
    place: NDArray[np.int64]
    received: Array
    stamp: Array
    columns: dict[str, Array]

    def __len__(self) -> int:
        return len(self.place)

    def take(self, keep: NDArray[np.bool_]) -> "Rows":
        """Some of them, by a mask."""
        columns = {name: taken(values, keep) for name, values in self.columns.items()}
        place, received, stamp = (taken(values, keep) for values in (self.place, self.received, self.stamp))
        return replace(self, place=place, received=received, stamp=stamp, columns=columns)

    def within(self, first: int, end: int) -> "Rows":
        """Those of the messages first, ..., end - 1."""
        return self.take(computed(lambda place: (place >= first) & (place < end), self.place))

    def interleaved(self, names: Sequence[str], other: "Rows") -> "Rows":
        """Columns of one, and all of the other, in the order of messages; what a row does not say is NaN."""
        order = np.argsort(np.concatenate([self.place, other.place]), kind="stable")
        own = {name: np.concatenate([self.columns[name], np.full(len(other), np.nan)]) for name in names}
        others = {name: np.concatenate([np.full(len(self), np.nan), v]) for name, v in other.columns.items()}
        place, received, stamp = (
            np.concatenate([getattr(self, name), getattr(other, name)])[order]
            for name in ("place", "received", "stamp")
        )
        columns = {name: values[order] for name, values in (own | others).items()}
        return Rows(self.sender, f"{self.name} with {other.name}", place, received, stamp, columns)


def _rows(sender: Sender, name: str, sensor: str, flat: FlatTable) -> Rows:
    table = flat.table()
    columns = dict(zip(COLUMNS[sensor], table[:, 3:].T, strict=True))
    place = computed(lambda numbers: numbers.astype(np.int64), table[:, 0])
    return Rows(sender, name, place, table[:, 1], table[:, 2], columns)


class Gatherer:
    """Takes messages one by one.

    Attributes
    ----------
    counts : sender and name of a message -> how many were received, of all
    unreadable : reason -> how many could not be read
    parameters : sender -> its parameters, as they were first
    """

    def __init__(self) -> None:
        self.counts: Counter[tuple[Sender, str]] = Counter()
        self.unreadable: Counter[str] = Counter()
        self.parameters: dict[Sender, dict[str, float]] = {}
        self._flat: dict[tuple[Sender, str, str], FlatTable] = {}
        self._taken = 0

    def take(self, sender: Sender, name: str, message: Any, received: float) -> None:
        """A message of `WANTED`.

        Parameters
        ----------
        message : with its fields as attributes
        received : [s], by the receiver's clock
        """
        self._taken += 1
        if name in OF_PARAMETERS:
            known = self.parameters.setdefault(sender, {})
            parameter = name == "PARAM_VALUE"
            value = float(message.param_value if parameter else message.mag_declination)
            if math.isfinite(value):
                known.setdefault(message.param_id if parameter else "COMPASS_DEC", value)
            return
        stamp = 1e-6 * usec(message) or np.nan
        for said in READERS[name](message):
            row, key = (self._taken, received, stamp, *said.values), (sender, name, said.sensor)
            if (rows := self._flat.get(key)) is None:
                rows = self._flat[key] = FlatTable(len(row))
            rows.append(row)

    def rows(self) -> dict[tuple[Sender, str, str], Rows]:
        """All that was taken: sender, name of the message and sensor -> Rows."""
        return {key: _rows(*key, flat) for key, flat in self._flat.items()}
