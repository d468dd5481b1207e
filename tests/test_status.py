"""The display: what it says, when it draws, and that standard output stays clean."""

import io
import math
import os
import pty
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from rovgraph.live.solution import Event, SensorHealth, Solution
from rovgraph.report.status import StatusLine, status

SOLUTION = Solution(
    time=1_700_000_000.5,
    position=np.array([10.0, -20.04, 5.5]),
    velocity=np.zeros(3),
    rpy=np.array([0.0, 0.0, -0.5]),
    position_sd=np.array([0.31, 0.42, 0.1]),
    velocity_sd=np.zeros(3),
    rpy_sd=np.array([0.01, 0.01, 0.02]),
    cov_north_east=0.0,
    latitude=58.1234567,
    longitude=8.0,
    calibration={"dvl_yaw": (-0.375, 0.0332)},
    sensors={
        "imu": SensorHealth("ok", 0.01, 1000, 0),
        "dvl": SensorHealth("silent", 12.0, 90, 10),
        "depth": SensorHealth("rejected", 0.1, 5, 0),
    },
    distance=123.44,
    predicted_s=0.15,
    latency_s=0.012,
    update_s=0.0031,
)


def drawn(solution: Solution, *events: Event, **kind) -> str:
    console = Console(file=io.StringIO(), width=110, **kind)
    console.print(status(solution, events))
    return console.file.getvalue()


def test_it_says_where_how_sure_and_how_the_sensors_are():
    lines = [
        " ".join(line.split())
        for line in drawn(SOLUTION, Event(1_700_000_001.0, "dvl", "silent", "no ping")).splitlines()
    ]
    assert lines == [
        "time 22:13:20 UTC",
        "position north 10.00 ± 0.31 m, east -20.04 ± 0.42 m, down 5.50 ± 0.10 m",
        "latitude 58.1234567, longitude 8.0000000",
        "heading 331.4 ± 1.1 deg",
        "distance 123.4 m",
        "misalignment -21.5 ± 1.9 deg",
        "update 3.1 ms, predicted over 0.15 s, 12 ms after arrival",
        "sensors imu ok, dvl silent for 12.0 s (10 of 100 rejected), depth rejected",
        "verdict trusted",
        "22:13:21 UTC dvl silent: no ping",
    ]


def test_a_sensor_has_the_colour_of_its_state():
    text = drawn(SOLUTION, force_terminal=True, color_system="standard")
    for colour, word in (("32", "imu ok"), ("31", "dvl silent"), ("33", "depth rejected")):
        assert f"\x1b[{colour}m{word}" in text


numbers = st.floats(-1e12, 1e12) | st.sampled_from([math.nan, math.inf, -math.inf])
vectors = st.lists(numbers, min_size=3, max_size=3).map(np.array)


@settings(deadline=None, max_examples=60)
@given(numbers, vectors, vectors, vectors, st.none() | numbers, numbers, st.text())
def test_anything_can_be_drawn(at, position, rpy, sd, latitude, other, text):
    drawn(
        replace(
            SOLUTION, time=at, position=position, rpy=rpy, position_sd=sd, rpy_sd=sd, latitude=latitude, distance=other,
            update_s=other, latency_s=latitude, calibration={"dvl_yaw": (other, at)},
            sensors={text: SensorHealth(text, other, 3, 1), "dvl": SensorHealth("silent", other, 0, 0)},
        ),
        Event(other, text, text, text),
    )  # fmt: skip


def test_nothing_is_written_where_standard_error_is_no_terminal():
    console = Console(file=io.StringIO(), force_terminal=False)
    with StatusLine(console) as line:
        line.show(SOLUTION)
    assert console.file.getvalue() == ""


def test_showing_only_keeps_and_a_thread_draws_four_times_a_second(monkeypatch):
    drawings, waits, refreshed = [], set(), threading.Event()

    def drawn(solution, events):
        drawings.append((threading.current_thread() is threading.main_thread(), solution.time))
        if not drawings[-1][0]:
            refreshed.set()
        return ""

    class Done(threading.Event):
        def wait(self, timeout=None):
            waits.add(timeout)
            return super().wait(timeout)

    monkeypatch.setattr(sys.modules["rovgraph.report.status"], "status", drawn)
    monkeypatch.setattr("rich.live.Event", Done)
    with StatusLine(Console(file=io.StringIO(), force_terminal=True)) as line:
        for k in range(1000):
            line.show(replace(SOLUTION, time=float(k)))
        assert not any(main for main, _ in drawings)
        assert refreshed.wait(30.0)
    assert waits == {0.25}
    assert drawings[-1] == (True, 999.0)  # the last by close


def test_nothing_is_cut_off_at_80_columns():
    console = Console(file=io.StringIO(), width=80)
    far = replace(SOLUTION, position=np.array([-12345.678, 12345.678, 1234.5]), position_sd=np.full(3, 0.0123))
    console.print(status(far, (Event(3.0, "dvl", "clock", "its stamps are late " * 6),)))
    text = console.file.getvalue()
    assert "…" not in text and "position" in text and "down 1234.500 ± 0.012 m" in " ".join(text.split())


def test_before_the_first_solution_it_says_what_it_waits_for():
    console = Console(file=io.StringIO(), force_terminal=True, width=80)
    with StatusLine(console, lambda: "no measurement of an IMU yet; tcp://a: dvl; udp://b: nothing yet"):
        pass
    assert "waiting for the first solution: no measurement of an IMU yet; tcp://a: dvl" in console.file.getvalue()


def test_the_newest_events_stay_in_sight():
    console = Console(file=io.StringIO(), force_terminal=True, width=100)
    with StatusLine(console) as line:
        for k in range(9):
            line.show(replace(SOLUTION, events=(Event(float(k), "dvl", "gap", f"number {k}"),)))
        line.show(SOLUTION)
    last = console.file.getvalue().rpartition("position")[2]
    assert [k for k in range(9) if f"number {k}" in last] == [4, 5, 6, 7, 8]


SHOWS = """
import time
from rovgraph.live.outputs import open_output
from rovgraph.report.status import StatusLine
import sys; sys.path.insert(0, sys.argv[1])
from test_status import SOLUTION
out = open_output("-", patient=True)
with StatusLine() as line:
    for _ in range(40):
        line.show(SOLUTION)
        out.send(SOLUTION)
        time.sleep(0.02)
out.close()
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
def test_on_a_real_terminal_it_draws_there_and_standard_output_has_only_json():
    ours, theirs = pty.openpty()
    child = subprocess.Popen(
        [sys.executable, "-c", SHOWS, str(Path(__file__).parent)],
        stdout=subprocess.PIPE, stderr=theirs, env=os.environ | {"TERM": "xterm-256color", "COLUMNS": "110"},
    )  # fmt: skip
    os.close(theirs)
    seen = b""
    try:
        while data := os.read(ours, 4096):
            seen += data
    except OSError:  # the terminal's other end is closed
        pass
    os.close(ours)
    out, _ = child.communicate(timeout=30)
    assert child.returncode == 0
    assert seen.count(b"misalignment") >= 3
    assert [line[:16] for line in out.splitlines()] == [b'{"time":17000000'] * 40
