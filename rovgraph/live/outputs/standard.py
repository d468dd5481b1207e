"""JSON lines on standard output."""

import os
import select
import sys

from rovgraph.live.outputs.background import Background
from rovgraph.live.outputs.lines import json_line
from rovgraph.live.outputs.output import Output
from rovgraph.live.outputs.url import Url
from rovgraph.live.solution import Solution
from rovgraph.live.warnings import Warnings

QUEUED = 200  # lines behind a reader that does not read
CLOSE_S = 1.0
STANDARD_OUTPUT = 1


class StandardOutput(Output):
    """JSON lines to the reader of standard output.

    It writes to the descriptor itself: Python's own stream is locked while a reader makes it
    wait, and would hold up the end of the program.

    Parameters
    ----------
    patient : wait for the reader in `send` instead of dropping lines
    descriptor : the file to write to
    """

    def __init__(
        self, url: Url, warnings: Warnings | None = None, patient: bool = False, descriptor: int = STANDARD_OUTPUT
    ) -> None:
        super().__init__(url, warnings)
        self._descriptor = descriptor
        self._begun = b""  # rest of a line of which a part is out
        if descriptor == STANDARD_OUTPUT:
            sys.stdout.flush()
        self._background = None if patient else Background(self._write, QUEUED, "output: -")

    def _send(self, solution: Solution) -> None:
        line = json_line(solution)
        if self._background is None:
            self._write(line)
            return
        lost = self._background.put(line)
        if lost:
            self._drop(lost, "slow reader", "the reader of standard output does not read fast enough")

    def close(self) -> None:
        left = self._background.close(CLOSE_S) if self._background else 0
        if left:
            self._drop(left, "slow reader", "the reader of standard output does not read")

    def _write(self, line: bytes) -> None:
        rest = self._begun + line
        try:
            while rest:
                rest = rest[_written(self._descriptor, rest) :]
        except OSError as error:
            self._drop(1, "closed", f"standard output cannot be written ({error.strerror})")
        self._begun = rest[: -len(line)] if len(rest) >= len(line) else rest


def _written(descriptor: int, data: bytes) -> int:
    """Bytes taken; waits also where somebody else made the file non-blocking."""
    while True:
        try:
            return os.write(descriptor, data)
        except BlockingIOError:
            select.select([], [descriptor], [])
