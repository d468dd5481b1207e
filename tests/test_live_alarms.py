"""Alarms while a dive goes on: said once when they begin, once when they are over, and silent on healthy dives."""

import io
import json

import numpy as np
import pytest
from broken import BROKEN, changed_data
from dives import Simulated, falcon, simulated
from live import message
from rich.console import Console

from rovgraph.diagnosis.alarm import Statistic
from rovgraph.live.alarms import OVER_S, LiveAlarms
from rovgraph.live.clocks import Clocks
from rovgraph.live.navigator import Navigator
from rovgraph.live.outputs.json_lines import json_line
from rovgraph.live.solution import Event, Solution
from rovgraph.log import Log
from rovgraph.report.status import status
from rovgraph.rules import RULES
from rovgraph.simulate import Choices
from rovgraph.simulate import simulated as named

SECONDS = 120.0
LASTS = "depth: residuals of down do not average out"


@pytest.fixture(scope="module")
def case() -> Simulated:
    return simulated(falcon(), SECONDS, 1, imu_rate=50.0, dvl_rate=4.0, fix_interval=2.0)


def dived(case: Simulated, log: Log) -> tuple[Navigator, list[Event], Solution]:
    """What a navigator says of a log: all its events, and its last solution."""
    nav, events = Navigator(case.config, patient=True, clocks=Clocks(trust=True)), []
    for k, m in enumerate(log.measurements()):
        nav.take(message(m))
        if k % 500 == 0 and (solution := nav.solution()) is not None:
            events += solution.events
    nav.finish()
    last = nav.solution()
    return nav, events + list(last.events), last


def test_a_healthy_dive_is_trusted_from_beginning_to_end(case):
    nav, events, last = dived(case, case.log)
    assert {e.source for e in events} == {"start"}
    assert (last.verdict, last.alarms, nav.alarms.history) == ("trusted", (), {})


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("DVL y sign flipped", "dvl: up to"),
        pytest.param("IMU mounted 2, 1, 3 degrees off", LASTS, marks=pytest.mark.slow),
        ("DVL biased by 0.3 m/s for 20 s", "dvl: contradicts all other sensors"),
        ("depth stuck", "depth: repeats its values"),
        ("gyro scale 0.5 %", "estimate calibration.gyr_scale"),
        pytest.param("DVL 0.3 s late", "dvl: up to", marks=pytest.mark.slow),
        ("DVL noise three times as stated", "raise dvl.velocity_sd_mps"),
        ("fixes 8 m off for a minute", "fix: residuals of north do not average out"),
    ],
)
def test_what_is_broken_is_named_while_the_dive_goes_on(name, words):
    broken = BROKEN[name]
    case = simulated(falcon(), SECONDS, 1, imu_rate=50.0, **broken.truth)
    _, events, last = dived(case, broken.breaks(case.log))
    assert any(e.kind in ("doubtful", "wrong") and words in e.text for e in events), events
    assert last.verdict != "trusted"


def test_an_alarm_is_said_once_when_it_begins_and_once_when_it_is_over(case):
    def held(data, seconds):
        now = np.flatnonzero((seconds > 30.0) & (seconds < 45.0))
        data[now, :3] = data[now[0] - 1, :3]

    nav, events, last = dived(case, changed_data("dvl", held)(case.log))
    said = [(e.kind, e.text.split(" ", 2)[1]) for e in events if e.source == "dvl"]
    assert said == [("frozen", "the"), ("doubtful", "repeats"), ("back", "measures"), ("over", "frozen:")]
    over = next(e.time for e in events if e.kind == "over")
    assert 45.0 + OVER_S < over < 45.0 + OVER_S + 15.0
    assert last.verdict == "trusted"
    assert [a.kind for a in nav.alarms.history.values()] == ["frozen"]


def test_an_alarm_needs_its_looks_in_a_row_and_is_over_after_half_a_minute():
    alarms, odd = LiveAlarms(), Statistic("too large", "dvl", 0.0, 60.0, 2.5, "so", "do")
    alarms._start = 0.0
    beyond = [1, 1, 0, 1, 1, 1, 0, 1, 1, 0]  # at looks 5 s apart, then never again
    said = []
    for k in range(20):
        alarms._look([odd] if k < len(beyond) and beyond[k] else [], 5.0 * k)
        said += [(event.time, event.kind) for event in alarms.events]
        alarms.events.clear()
    assert RULES["too large"].looks == 3
    assert said == [(25.0, "doubtful"), (40.0 + OVER_S, "over")] and OVER_S == 30.0
    assert alarms.verdict == "trusted"


@pytest.mark.slow
def test_what_the_smoothed_dive_shows_is_said_with_its_newest_figures_and_unless_nobody_asks():
    noisy = BROKEN["DVL noise three times as stated"]
    for find in (True, False):
        case = simulated(falcon(graph={"find_noise": find}), 180.0, 1, imu_rate=50.0, dvl_rate=4.0)
        nav, events, _ = dived(case, noisy.breaks(case.log))
        said = [e.text.split("; state ")[1] for e in events if "its noise is" in e.text]
        assert bool(said) == find and all(text.startswith("dvl.velocity_sd_mps: [") for text in said)
        newest = [a.text.split("; state ")[1] for a in nav.alarms.history.values() if a.kind == "unstated"]
        assert newest == said[-1:]


@pytest.mark.slow
def test_a_dive_whose_constants_are_off_by_what_is_believed_of_them_is_trusted():
    dive, config = named("falcon", 1, None, Choices(disturbances=False))
    log = Log.from_frame(dive.between(0.0, dive.log_frame["time"].iloc[0] + 250.0).log_frame)
    nav = Navigator(config, patient=True, clocks=Clocks(trust=True))
    for m in log.measurements():
        nav.take(message(m))
    nav.finish()
    assert nav.alarms.history == {}


def test_line_and_status_carry_the_verdict_and_what_it_comes_of(case):
    _, _, last = dived(case, BROKEN["DVL noise three times as stated"].breaks(case.log))
    line = json.loads(json_line(last))
    assert line["verdict"] == "doubtful"
    assert ["too large", "dvl", "doubtful"] in line["alarms"]
    console = Console(file=io.StringIO(), width=200)
    console.print(status(last))
    shown = " ".join(console.file.getvalue().split())
    assert "verdict doubtful, " in shown
    assert "dvl too large" in shown
