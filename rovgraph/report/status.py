"""The online mode's display on a terminal: position, and the state of the sensors."""

from collections.abc import Callable
from types import TracebackType

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from rovgraph.live.solution import Event, SensorHealth, Solution
from rovgraph.report.units import duration, plus_minus

REFRESH = 4.0  # [Hz]
NEWEST = 5  # events shown
UNIX = 1e9  # a time beyond this counts from 1970 [s]
VERDICTS = {"trusted": "green", "doubtful": "yellow", "wrong": "red"}
COLOURS = {"ok": "green", "no lock": "yellow", "rejected": "yellow", "frozen": "red", "silent": "red"}


class StatusLine:
    """Shows solutions on standard error, if that is a terminal.

    `show` only keeps the solution; a thread draws it `REFRESH` times a second, so that a
    terminal that is stopped (Ctrl-S) does not hold up the estimate.

    Parameters
    ----------
    console : where to draw
    waiting : returns what the first solution waits for
    """

    def __init__(self, console: Console | None = None, waiting: Callable[[], str] = str) -> None:
        console = Console(stderr=True) if console is None else console
        self._waiting = waiting
        self._solution: Solution | None = None
        self._events: tuple[Event, ...] = ()
        self._live = None
        if console.is_terminal:
            self._live = Live(
                console=console, get_renderable=self._drawn, refresh_per_second=REFRESH, redirect_stdout=False
            )
            self._live.start()

    @property
    def shown(self) -> bool:
        """Whether there is a terminal to draw on."""
        return self._live is not None

    def show(self, solution: Solution) -> None:
        """Keep a solution for the next drawing."""
        self._events = (*self._events, *solution.events)[-NEWEST:]
        self._solution = solution

    def close(self) -> None:
        """Draw for the last time and leave it on the screen."""
        if self._live is not None:
            self._live.stop()

    def __enter__(self) -> "StatusLine":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _drawn(self) -> Table | Text:
        solution = self._solution
        if solution is not None:
            return status(solution, self._events)
        reason = self._waiting()
        return Text("waiting for the first solution" + (f": {reason}" if reason else ""), style="dim")


def status(solution: Solution, events: tuple[Event, ...] = ()) -> Table:
    """A solution in words and numbers, with the newest events below.

    Parameters
    ----------
    solution : angles become degrees, the heading is in [0, 360)
    events : oldest first
    """
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, text in _rows(solution):
        table.add_row(name, text)
    for event in events:
        table.add_row(_clock(event.time), Text(f"{event.source} {event.kind}: {event.text}"))
    return table


def _rows(s: Solution) -> list[tuple[str, Text]]:
    """What each line is called, and the line."""
    position = [
        f"{name} {plus_minus(value, sd, 'm')}"
        for name, value, sd in zip(("north", "east", "down"), s.position.tolist(), s.position_sd.tolist(), strict=True)
    ]
    rows = [("time", _clock(s.time)), ("position", ", ".join(position))]
    if s.latitude is not None and s.longitude is not None:
        rows.append(("", f"latitude {s.latitude:.7f}, longitude {s.longitude:.7f}"))
    rows.append(("heading", _degrees(float(s.rpy[2]) % (2.0 * np.pi), s.rpy_sd[2])))
    rows.append(("distance", f"{s.distance:.1f} m"))
    if "dvl_yaw" in s.calibration:
        rows.append(("misalignment", _degrees(*s.calibration["dvl_yaw"])))
    update = f"{1e3 * s.update_s:.1f} ms, predicted over {s.predicted_s:.2f} s"
    rows.append(("update", update if s.latency_s is None else f"{update}, {1e3 * s.latency_s:.0f} ms after arrival"))
    verdict = (
        "verdict",
        Text(", ".join([s.verdict, *(f"{a.sensor} {a.kind}" for a in s.alarms)]), VERDICTS[s.verdict]),
    )
    return [*((name, Text(text)) for name, text in rows), ("sensors", _sensors(s)), verdict]


def _sensors(solution: Solution) -> Text:
    """State of each sensor in its colour; how long ago and how many rejected, where that is worth a word."""
    parts = [Text(f"{name} {_health(h)}", COLOURS.get(h.state, "red")) for name, h in solution.sensors.items()]
    return Text(", ").join(parts)


def _health(h: SensorHealth) -> str:
    silent = h.state == "silent" and np.isfinite(h.age)
    state = f"{h.state} for {duration(h.age)}" if silent else h.state
    return f"{state} ({h.rejected} of {h.used + h.rejected} rejected)" if h.rejected else state


def _degrees(angle: float, sd: float) -> str:
    return plus_minus(float(np.rad2deg(angle)), float(np.rad2deg(sd)), "deg")


def _clock(seconds: float) -> str:
    """Time of day where a time counts from 1970, else seconds."""
    if not np.isfinite(seconds):
        return "unknown"
    if seconds <= UNIX:
        return f"{seconds:.1f} s"
    minutes, second = divmod(int(seconds) % 86_400, 60)
    return f"{minutes // 60:02d}:{minutes % 60:02d}:{second:02d} UTC"
