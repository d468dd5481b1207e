"""A solution as a line of JSON, to standard output, to TCP readers, or as UDP datagrams.

docs/online-output.md is the contract.
"""

import contextlib
import json
import math
import os
import select
import socket
import sys
import time
from collections import deque
from collections.abc import Iterator
from typing import Any

from rovgraph.errors import InputError
from rovgraph.inference.trajectory import ATTITUDE, POSITION, VELOCITY
from rovgraph.live.outputs.output import Background, Output, Url
from rovgraph.live.solution import Solution
from rovgraph.live.warnings import Warnings

_ENCODER = json.JSONEncoder(allow_nan=False, separators=(",", ":"))


def json_line(solution: Solution) -> bytes:
    """One line with its end, in ASCII; what is not known or not finite is null."""
    return (_ENCODER.encode(as_dict(solution)) + "\n").encode("ascii")


def as_dict(solution: Solution) -> dict[str, Any]:
    """The values of a solution under the names of the contract, as plain Python."""
    s = solution
    known: dict[str, Any] = {"time": _number(s.time, decimals=6)}
    for names, values in ((POSITION, s.position), (ATTITUDE, s.rpy), (VELOCITY, s.velocity)):
        known |= zip(names, map(_number, values.tolist()), strict=True)
    for names, sds in ((POSITION, s.position_sd), (ATTITUDE, s.rpy_sd), (VELOCITY, s.velocity_sd)):
        known |= zip([f"{name}_sd" for name in names], map(_number, sds.tolist()), strict=True)
    if s.altitude is not None:
        below = {name: getattr(s, name) for name in ("altitude", "altitude_sd", "bottom_depth", "bottom_depth_sd")}
        known |= {name: _number(value) for name, value in below.items() if value is not None}
    if s.current:
        known["current"] = [{name: _number(value) for name, value in at._asdict().items()} for at in s.current]
    return known | {
        "cov_north_east": _number(s.cov_north_east),
        "latitude": _number(s.latitude, decimals=9),
        "longitude": _number(s.longitude, decimals=9),
        "distance": _number(s.distance),
        "predicted_s": _number(s.predicted_s),
        "latency_s": _number(s.latency_s),
        "update_s": _number(s.update_s),
        "calibration": {label: [_number(value), _number(sd)] for label, (value, sd) in s.calibration.items()},
        "sensors": {
            name: {"state": h.state, "age": _number(h.age), "used": int(h.used), "rejected": int(h.rejected)}
            for name, h in s.sensors.items()
        },
        "verdict": s.verdict,
        "alarms": [[a.kind, a.sensor, a.severity] for a in s.alarms],
        "events": [event.as_dict() for event in s.events],
    }


def _number(value: float | None, decimals: int | None = None) -> float | None:
    """With ``decimals``, or nine significant digits: lines that fit into fewer packets."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.9g}") if decimals is None else round(float(value), decimals)


STANDARD_QUEUED = 200  # lines behind a reader that does not read
STANDARD_CLOSE_S = 1.0
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
        self._background = None if patient else Background(self._write, STANDARD_QUEUED, "output: -")

    def _send(self, solution: Solution) -> None:
        line = json_line(solution)
        if self._background is None:
            self._write(line)
            return
        lost = self._background.put(line)
        if lost:
            self._drop(lost, "slow reader", "the reader of standard output does not read fast enough")

    def close(self) -> None:
        left = self._background.close(STANDARD_CLOSE_S) if self._background else 0
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
    """Bytes taken; waits also where another process made the file non-blocking."""
    while True:
        try:
            return os.write(descriptor, data)
        except BlockingIOError:
            select.select([], [descriptor], [])


READER_QUEUED = 100  # lines per reader, beyond what the system holds
SYSTEM_BUFFER = 1 << 16  # small, so that a reader who comes back is not shown the past [bytes]
TCP_CLOSE_S = 0.5
LOOPBACK = "127.0.0.1"


class TcpOutput(Output):
    """Listens, on the loopback unless a host is written, and sends every line to every reader.

    A reader that is too slow loses lines, the oldest first, and does not delay others. Sending never
    waits: readers are accepted, and queues emptied as far as they go, when a solution is sent.

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
        end = time.monotonic() + TCP_CLOSE_S
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
        self._lines: deque[bytes] = deque(maxlen=READER_QUEUED)
        self._begun = b""  # rest of a line of which a part is out

    @property
    def behind(self) -> int:
        """Lines that wait."""
        return len(self._lines) + bool(self._begun)

    def queue(self, line: bytes) -> bool:
        """Queue a line; whether the oldest was lost for it."""
        full = len(self._lines) == READER_QUEUED
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
        """End the connection; the reader's bytes are taken first, or the system would cut it off."""
        with contextlib.suppress(OSError):
            self.socket.recv(1 << 16)
            self.socket.shutdown(socket.SHUT_WR)
        self.socket.close()


class UdpOutput(Output):
    """One JSON line per datagram; without knowing whether a reader listens.

    Raises
    ------
    InputError : a host that cannot be found
    """

    def __init__(self, url: Url, warnings: Warnings | None = None) -> None:
        super().__init__(url, warnings)
        host, port = url.host_port()
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(found[0], socket.SOCK_DGRAM)
        except OSError as error:
            raise InputError(f"output {url.text!r}: {host} cannot be found ({error.strerror})") from None
        self._address = found[4]
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)

    def _send(self, solution: Solution) -> None:
        for datagram in self._datagrams(solution):
            try:
                self._socket.sendto(datagram, self._address)
            except OSError as error:
                self._drop(1, "unreachable", f"cannot be sent ({error.strerror})")

    def _datagrams(self, solution: Solution) -> Iterator[bytes]:
        yield json_line(solution)

    def close(self) -> None:
        self._socket.close()
