"""Live dives for the tests: measurements through a `Navigator`, and a vehicle that serves its data over TCP."""

import json
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from dives import Simulated, true_at

from rovgraph.geometry import Array
from rovgraph.live.clocks import Clocks
from rovgraph.live.message import Message, Reading
from rovgraph.live.navigator import Navigator
from rovgraph.live.session import QUIET_S
from rovgraph.live.solution import Solution
from rovgraph.log import STREAMS, Measurement

Alter = Callable[[Measurement], Iterable[Measurement]]


@dataclass(frozen=True)
class Flight:
    """What a navigator said of a simulated dive."""

    case: Simulated
    navigator: Navigator
    solutions: list[Solution]

    @property
    def time(self) -> Array:
        return np.array([s.time for s in self.solutions])

    @property
    def errors(self) -> Array:
        """Of the horizontal position, shape (n, 2) [m]."""
        return (np.array([s.position for s in self.solutions]) - true_at(self.case, self.time).p_n)[:, :2]

    @property
    def sd(self) -> Array:
        return np.array([s.position_sd for s in self.solutions])[:, :2]

    def events(self, source: str) -> list[str]:
        return [e.kind for s in self.solutions for e in s.events if e.source == source]

    def sd_at(self, time: float) -> float:
        return float(np.linalg.norm(self.sd[np.searchsorted(self.time, time)]))


def navigator(case: Simulated, trust: bool = True) -> Navigator:
    return Navigator(case.config, patient=True, reinitialise=False, clocks=Clocks(trust=trust))


def flown(case: Simulated, alter: Alter = lambda m: [m], rate: float = 4.0) -> Flight:
    """A dive whose measurements arrive at once, each changed, left out or repeated on its way."""
    nav, solutions, due = navigator(case), [], -np.inf
    for measurement in case.log.measurements():
        for m in alter(measurement):
            while nav.time + QUIET_S < m.time and nav.engine is not None:  # as a session does
                nav.tick(nav.time + QUIET_S)
                solutions += [s for s in [nav.solution()] if s is not None]
            nav.take(message(m))
        solution = nav.solution() if nav.time >= due else None
        if solution is not None:
            solutions.append(solution)
            due = nav.time + 1.0 / rate
    nav.finish()
    return Flight(case, nav, solutions + [s for s in [nav.solution()] if s is not None])


def message(m: Measurement, arrival: float | None = None, stamp: float | None = None, source: str = "sim") -> Message:
    return Message(
        source,
        m.time if arrival is None else arrival,
        m.time if stamp is None else stamp,
        (Reading(m.sensor, m.values),),
    )


def row(m: Measurement) -> bytes:
    """A measurement as a JSON line."""
    cells = dict(zip(STREAMS[m.sensor], m.values.tolist(), strict=True))
    return json.dumps({"time": m.time, **{k: v for k, v in cells.items() if v == v}}).encode() + b"\n"


@dataclass
class Vehicle:
    """Serves lines over TCP, each when its time has come, to whoever is connected then.

    What comes while nobody listens is lost, as it is on board.

    Parameters
    ----------
    lines : (time since the start [s], line), in order
    speed : seconds of the dive per second
    hang_up : when it closes the connection, once [s of the dive]
    unheard_s : how much of the dive passes at most while nobody listens; then it waits, however slow the machine
    """

    lines: list[tuple[float, bytes]]
    speed: float = 1.0
    hang_up: float = np.inf
    unheard_s: float = np.inf
    sent: float = -np.inf  # time of the newest line that a client took
    clients: int = 0  # that have come so far
    told: float = 0.0  # how much of the dive the newest of them was told [s]
    done: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(0.05)
        self.port = self._listener.getsockname()[1]
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    @property
    def url(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def _serve(self) -> None:
        client, until, heard, since, k = None, 0.0, 0.0, 0.0, 0
        while client is None and not self._stop.is_set():
            client = self._accepted()  # again at once: of several vehicles the one that is called first speaks first
        last = time.monotonic()  # the dive begins with the first client
        while not self._stop.is_set():
            if client is None:
                client = self._accepted()
                since = until if client is not None else since
            elapsed, last = time.monotonic() - last, time.monotonic()
            heard = heard if client is None else until
            if until - heard < self.unheard_s:
                until += self.speed * elapsed
            if client is not None and until > self.hang_up:
                client.close()
                client, self.hang_up = None, np.inf
            first = k
            while k < len(self.lines) and self.lines[k][0] <= until:
                k += 1
            if client is not None and k > first and not self._took(client, self.lines[first:k], since):
                client = None
            if k == len(self.lines):
                self.done.set()
            time.sleep(0.01)
        if client is not None:
            client.close()

    def _accepted(self) -> socket.socket | None:
        """Whoever has come."""
        try:
            client = self._listener.accept()[0]
        except TimeoutError:
            return None
        self.told = 0.0
        self.clients += 1
        return client

    def _took(self, client: socket.socket, lines: list[tuple[float, bytes]], since: float) -> bool:
        """Whether a client that came at ``since`` took lines."""
        try:
            client.sendall(b"".join(line for _, line in lines))
        except OSError:
            return False
        self.sent = lines[-1][0]
        self.told = self.sent - since
        return True

    def close(self) -> None:
        self._stop.set()
        self._thread.join(5.0)
        self._listener.close()


@contextmanager
def vehicle(
    lines: list[tuple[float, bytes]], speed: float = 1.0, hang_up: float = np.inf, unheard_s: float = np.inf
) -> Iterator[Vehicle]:
    server = Vehicle(lines, speed, hang_up, unheard_s)
    server._thread.start()
    try:
        yield server
    finally:
        server.close()


def turned(m: Measurement, angle: float) -> Measurement:
    """A compass beside steel: what it says, turned about the vertical [rad]."""
    values = m.values.copy()
    if m.sensor == "mag":
        c, s = np.cos(angle), np.sin(angle)
        values[:2] = c * values[0] - s * values[1], s * values[0] + c * values[1]
    else:
        values[0] += angle
    return m._replace(values=values)


def counted(summary: Mapping[str, list[list[object]]], key: str) -> dict[str, int]:
    """Counts of a summary by kind, over all sources."""
    return {str(kind): int(str(count)) for *_, kind, count in summary[key]}
