"""Links: TCP, UDP, standard input, serial ports and files. All end within `STOP_S` or so.

Files are read as they are; in telemetry logs (.tlog) a time precedes each frame.
"""

import contextlib
import gzip
import os
import select
import socket
import threading
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rovgraph.errors import InputError
from rovgraph.live.sources.source import STOP_S, Chunk, Notify
from rovgraph.readers.mavlink import frames_with_times

BLOCK = 1 << 16  # bytes read at a time
CONNECT_S = 3.0  # longest wait for an answer
RETRY_S = (0.5, 1.0, 2.0, 4.0)  # waits before connecting again; the last one repeats
BUFFER = 1 << 20  # of the system, for datagrams [bytes]

# a peer that has gone without a word is noticed after about 15 s
_KEEPALIVE = {"TCP_KEEPIDLE": 5, "TCP_KEEPINTVL": 3, "TCP_KEEPCNT": 3}


class Retry:
    """Growing waits between attempts."""

    def __init__(self) -> None:
        self._attempts = 0

    def wait(self, stop: threading.Event) -> None:
        wait = RETRY_S[min(self._attempts, len(RETRY_S) - 1)]
        self._attempts += 1
        stop.wait(wait)

    def reset(self) -> None:
        self._attempts = 0


class TcpLink:
    """A client that connects for as long as it takes, and again.

    Parameters
    ----------
    host, port : of the server
    notify : takes warnings
    """

    def __init__(self, host: str, port: int, notify: Notify) -> None:
        self._host = host
        self._port = port
        self._notify = notify

    def chunks(self, stop: threading.Event) -> Iterator[Chunk]:
        retry = Retry()
        while not stop.is_set():
            try:
                with connected(self._host, self._port, stop) as connection:
                    for chunk in _received(connection, stop):
                        retry.reset()
                        yield chunk
                    if not stop.is_set():
                        self._notify("disconnected", "the other side has closed the connection; trying again")
            except (OSError, UnicodeError) as error:  # the latter of a name that cannot be one
                self._notify("unreachable", f"{_reason(error)}; trying again")
            retry.wait(stop)


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


def connected(host: str, port: int, stop: threading.Event) -> socket.socket:
    """A connection to the first address of a host that answers.

    Raises
    ------
    OSError : none does
    """
    failure = OSError("no address")
    for family, kind, protocol, _, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
        connection = socket.socket(family, kind, protocol)
        try:
            connection.setblocking(False)
            connection.connect_ex(address)
            _await_answer(connection, stop)
            connection.settimeout(STOP_S)
            _keep_alive(connection)
            return connection
        except OSError as error:
            connection.close()
            failure = error
    raise failure


def _await_answer(connection: socket.socket, stop: threading.Event) -> None:
    """Wait until a connection stands; OSError where it does not."""
    end = time.monotonic() + CONNECT_S
    while not stop.is_set() and time.monotonic() < end:
        _, writable, failed = select.select([], [connection], [connection], STOP_S)
        if writable or failed:
            error = connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
            if error:
                raise OSError(error, os.strerror(error))
            return
    raise TimeoutError(f"no answer within {CONNECT_S:g} s")


def _keep_alive(connection: socket.socket) -> None:
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _KEEPALIVE.items():
        if hasattr(socket, name):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def _received(connection: socket.socket, stop: threading.Event) -> Iterator[Chunk]:
    """What comes until the other side closes."""
    fresh = True
    while not stop.is_set():
        with contextlib.suppress(TimeoutError):
            data = connection.recv(BLOCK)
            if not data:
                return
            yield Chunk(data, time.time(), fresh)
            fresh = False


class UdpLink:
    """Listens for datagrams, from any sender.

    Parameters
    ----------
    host, port : to listen at
    url : for messages
    end : put behind each datagram, such as the end of a line

    Raises
    ------
    InputError : it cannot be listened there
    """

    def __init__(self, host: str, port: int, url: str, end: bytes = b"") -> None:
        self._end = end
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, kind, protocol)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
            self._socket.bind(address)
        except (OSError, UnicodeError) as error:
            raise InputError(
                f"{url}: cannot listen at {host}:{port} ({_reason(error)}); "
                "does another program, or another source, listen there already?"
            ) from None
        self._socket.settimeout(STOP_S)

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._socket.getsockname()[1])

    def chunks(self, stop: threading.Event) -> Iterator[Chunk]:
        with self._socket:
            while not stop.is_set():
                # Windows reports an undelivered datagram as an error of the next read
                with contextlib.suppress(TimeoutError, ConnectionError):
                    data = self._socket.recv(BLOCK)
                    yield Chunk(data + self._end, time.time(), fresh=True)


class StandardInput:
    """Standard input, or any other file descriptor."""

    def __init__(self, descriptor: int = 0) -> None:
        self._descriptor = descriptor

    def chunks(self, stop: threading.Event) -> Iterator[Chunk]:
        fresh = True
        while not stop.is_set():
            try:
                if not self._ready():
                    continue
                data = os.read(self._descriptor, BLOCK)
            except OSError:
                data = b""
            if not data:
                break
            yield Chunk(data, time.time(), fresh)
            fresh = False
        yield Chunk(b"\n", time.time())  # the last line may lack its end

    def _ready(self) -> bool:
        """Whether there is something to read, or the end; where pipes cannot be asked, reading waits."""
        return os.name == "nt" or bool(select.select([self._descriptor], [], [], STOP_S)[0])


class SerialLink:
    """A serial port, opened for as long as it takes, and again.

    Parameters
    ----------
    device, baud : which, and how fast
    notify : takes warnings

    Raises
    ------
    InputError : pyserial is not installed
    """

    def __init__(self, device: str, baud: int, notify: Notify) -> None:
        self._serial = _serial()
        self._device = device
        self._baud = baud
        self._notify = notify

    def chunks(self, stop: threading.Event) -> Iterator[Chunk]:
        retry = Retry()
        while not stop.is_set():
            try:
                with self._serial.Serial(self._device, self._baud, timeout=STOP_S) as port:
                    for chunk in _read(port, stop):
                        retry.reset()
                        yield chunk
            except Exception as error:  # what a port that is unplugged raises differs between systems
                self._notify("unreachable", f"{error}; trying again")
            retry.wait(stop)


def _read(port: Any, stop: threading.Event) -> Iterator[Chunk]:
    fresh = True
    while not stop.is_set():
        data = port.read(port.in_waiting or 1)
        if data:
            yield Chunk(data, time.time(), fresh)
            fresh = False


def _serial() -> Any:
    try:
        import serial
    except ImportError:
        raise InputError("serial ports need pyserial; install it with: pip install 'rovgraph[online]'") from None
    return serial


def read_file(path: Path) -> bytes:
    """A file, unpacked where it is gzipped.

    Raises
    ------
    InputError : it cannot be read
    """
    try:
        content = path.read_bytes()
        return gzip.decompress(content) if content.startswith(b"\x1f\x8b") else content
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from None


class FileLink:
    """A file from its beginning to its end; it arrives when it was last written."""

    def __init__(self, path: Path) -> None:
        self._content = read_file(path)
        self._arrival = path.stat().st_mtime

    def chunks(self, stop: threading.Event) -> Iterator[Chunk]:
        for start in range(0, len(self._content), BLOCK):
            if stop.is_set():
                return
            yield Chunk(self._content[start : start + BLOCK], self._arrival)
        yield Chunk(b"\n", self._arrival)  # the last line may lack its end


class TelemetryReplay:
    """The messages of a telemetry log, one by one, each arriving when it was received."""

    def __init__(self, path: Path) -> None:
        self._content = read_file(path)

    def chunks(self, stop: threading.Event) -> Iterator[Chunk]:
        for chunk in timed_frames(self._content):
            if stop.is_set():
                return
            yield chunk


def timed_frames(content: bytes) -> Iterator[Chunk]:
    """Frames of a telemetry log; bytes between them come as chunks too."""
    return (Chunk(data, time, fresh=True) for data, time in frames_with_times(content))
