"""JSON lines to any number of readers that connect."""

import contextlib
import socket
import time
from collections import deque

from rovgraph.errors import InputError
from rovgraph.live.outputs.lines import json_line
from rovgraph.live.outputs.output import Output
from rovgraph.live.outputs.url import Url
from rovgraph.live.solution import Solution
from rovgraph.live.warnings import Warnings

QUEUED = 100  # lines per reader, beyond what the system holds
SYSTEM_BUFFER = 1 << 16  # small, so that a reader who comes back is not shown the past [bytes]
CLOSE_S = 0.5
LOOPBACK = "127.0.0.1"


class TcpOutput(Output):
    """Listens, on the loopback unless a host is written, and sends every line to every reader.

    A reader that is too slow loses lines, the oldest first, and holds up nobody. Nothing
    waits: readers are let in, and queues emptied as far as they go, when a solution is sent.

    Raises
    ------
    InputError : the address cannot be listened at
    """

    def __init__(self, url: Url, warnings: Warnings | None = None) -> None:
        super().__init__(url, warnings)
        host, port = url.host_port(default_host=LOOPBACK)
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            self._listener = socket.create_server((host, port), family=family, backlog=16)
        except OSError as error:
            raise InputError(
                f"output {url.text!r}: cannot listen at {host}, port {port} ({error.strerror}); choose another"
            ) from None
        self._listener.setblocking(False)
        self._readers: list[_Reader] = []

    def _send(self, solution: Solution) -> None:
        self._let_in()
        line = json_line(solution) if self._readers else b""
        for reader in self._readers:
            if reader.queue(line):
                self._drop(1, "slow reader", f"{reader.name} does not read fast enough")
        self._flush()

    def close(self) -> None:
        self._listener.close()
        end = time.monotonic() + CLOSE_S
        while any(r.behind for r in self._readers) and time.monotonic() < end:
            time.sleep(0.01)
            self._flush()
        for reader in self._readers:
            if reader.behind:
                self._drop(reader.behind, "slow reader", f"{reader.name} does not read")
            reader.close()
        self._readers = []

    def _let_in(self) -> None:
        try:
            while True:
                self._readers.append(_Reader(*self._listener.accept()))
        except BlockingIOError:
            pass
        except OSError as error:
            self._complain("connection", f"a reader could not be let in ({error.strerror})")

    def _flush(self) -> None:
        for reader in list(self._readers):
            try:
                reader.flush()
            except OSError:  # gone, as readers may
                self._readers.remove(reader)
                reader.close()


class _Reader:
    """One connection and the lines that wait for it."""

    def __init__(self, connection: socket.socket, address: tuple[object, ...]) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SYSTEM_BUFFER)
        self.socket = connection
        self.name = f"{address[0]}:{address[1]}"
        self._lines: deque[bytes] = deque(maxlen=QUEUED)
        self._begun = b""  # rest of a line of which a part is out

    @property
    def behind(self) -> int:
        """Lines that wait."""
        return len(self._lines) + bool(self._begun)

    def queue(self, line: bytes) -> bool:
        """Queue a line; whether the oldest was lost for it."""
        full = len(self._lines) == QUEUED
        self._lines.append(line)
        return full

    def flush(self) -> None:
        """Hand over what the system takes.

        Raises
        ------
        OSError : the reader is gone
        """
        with contextlib.suppress(BlockingIOError):
            while self._begun or self._lines:
                self._begun = self._begun or self._lines.popleft()
                self._begun = self._begun[self.socket.send(self._begun) :]

    def close(self) -> None:
        """End the connection; what the reader said is taken first, or the system would cut it off."""
        with contextlib.suppress(OSError):
            self.socket.recv(1 << 16)
            self.socket.shutdown(socket.SHUT_WR)
        self.socket.close()
