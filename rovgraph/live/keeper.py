"""Checkpoints once a second, without holding up the estimate."""

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rovgraph.errors import InputError
from rovgraph.live.checkpoint import write_checkpoint
from rovgraph.live.warnings import Warnings


class Keeper:
    """Writes the newest state that it was given, in a thread of its own.

    Parameters
    ----------
    path : of the checkpoint
    warnings : told from that thread where it cannot be written; it goes on trying
    """

    def __init__(self, path: Path, warnings: Warnings) -> None:
        self._path, self._complain = path, warnings.complain
        self._state: Mapping[str, Any] | None = None
        self._given, self._stop = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._work, name="checkpoints", daemon=True)
        self._thread.start()

    def keep(self, state: Mapping[str, Any]) -> None:
        """Have a state written, instead of an older one that has not been yet."""
        self._state = state
        self._given.set()

    def close(self) -> None:
        """Write what was given last, and end."""
        self._stop.set()
        self._given.set()
        self._thread.join(5.0)

    def _work(self) -> None:
        while not self._stop.is_set():
            self._given.wait()
            self._given.clear()
            self._write()
        self._write()

    def _write(self) -> None:
        state, self._state = self._state, None
        if state is not None:
            try:
                write_checkpoint(self._path, state)
            except InputError as error:
                self._complain(str(self._path), "disk", str(error).removeprefix(f"{self._path}: "))
