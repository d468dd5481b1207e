"""Marks and positions that a person gives while a dive goes on: recorded, kept, and the same in a replay."""

import csv
import json
from contextlib import closing

import numpy as np
import pandas as pd
import pytest
from dives import Simulated, falcon, simulated

import rovgraph as rg
from rovgraph.live.clocks import Clocks
from rovgraph.live.files import RECORDING, Files
from rovgraph.live.marks import MARKS, DropMark, Marks, RemoveMark, SetPosition
from rovgraph.live.navigator import Navigator
from rovgraph.live.session import Feed, Session
from rovgraph.live.sources.replay import LogReplay
from rovgraph.live.warnings import Warnings
from rovgraph.log import read_log

NASTY = '</script>, "δύτης"; 潜水'


@pytest.fixture(scope="module")
def case() -> Simulated:
    return simulated(falcon(), 36.0, seed=3, dvl_rate=4.0)


def run(log, config, folder, commands=()):
    """A dive at full speed; each command is offered once the estimate has come to its time."""
    warnings, due = Warnings(), list(commands)
    folder.mkdir()
    files, marks = Files(folder, config, warnings), Marks(folder, warnings)
    navigator = Navigator(config, patient=True, clocks=Clocks(trust=True))
    feed, solutions = Feed([LogReplay("log", log, np.inf)]), []

    def receive(solution):
        solutions.append(solution)
        while due and solution.time >= due[0][0]:
            assert feed.offer(due.pop(0)[1])

    with closing(files), closing(navigator):
        Session(navigator, [receive], warnings, files=files, marks=marks).run(feed)
    return solutions


@pytest.fixture(scope="module")
def told(case, tmp_path_factory):
    folder = tmp_path_factory.mktemp("told") / "out"
    begin = case.log["imu"].time[0]
    here = SetPosition(0.3, -0.2, 0.05)
    commands = [
        (begin + 12.0, DropMark(NASTY)),
        (begin + 13.0, DropMark("way-point", 7.0, 8.0)),
        (begin + 15.0, here),
        (begin + 16.0, RemoveMark(2)),
        (begin + 17.0, DropMark("")),
        (begin + 18.0, RemoveMark(3)),
    ]
    return folder, run(case.log, case.config, folder, commands)


def test_a_position_becomes_a_fix_that_moves_the_estimate(case, told, tmp_path):
    without = run(case.log, case.config, tmp_path / "without")
    first, last = told[1], without
    assert np.linalg.norm(first[-1].position - last[-1].position) > 0.1
    (said,) = [e for s in first for e in s.events if e.source == "pilot" and e.kind == "position"]
    assert said.text == "a fix at north 0.30 m, east -0.20 m, sd 0.05 m"
    assert not first[-1].sensors["fix"].failed_s and first[-1].sensors["fix"].used == 1


def test_a_position_that_contradicts_the_estimate_is_refused_aloud(case, tmp_path):
    begin = case.log["imu"].time[0]
    solutions = run(case.log, case.config, tmp_path / "far", [(begin + 15.0, SetPosition(30.0, 0.0, 0.1))])
    (said,) = [e for s in solutions for e in s.events if e.source == "pilot"]
    assert "which rejects it (fix.gate_sd 6)" in said.text
    assert solutions[-1].sensors["fix"].rejected == 1


def test_the_recording_has_it_and_a_replay_gives_the_same_track(case, told, tmp_path):
    folder, solutions = told
    fixes = pd.read_csv(folder / RECORDING)[["fix_north", "fix_east", "fix_sd"]].dropna()
    assert fixes.to_numpy().tolist() == [[0.3, -0.2, 0.05]]
    config = case.config.model_copy(update={"columns": {}, "units": {}})
    again = run(read_log(folder / RECORDING, config), config, tmp_path / "again")
    assert len(again) == len(solutions)
    apart = [np.abs(a.position - b.position).max() for a, b in zip(solutions, again, strict=True)]
    assert max(apart[-20:]) < 1e-6


def test_marks_are_kept_with_where_the_vehicle_was_and_come_back(told):
    folder, solutions = told
    (row,) = list(csv.DictReader((folder / MARKS).open(encoding="utf-8", newline="")))
    at = next(s for s in solutions if s.time == float(row["time"]))
    assert (row["name"], row["kind"]) == (NASTY, "mark")
    assert float(row["north"]) == at.position[0] and float(row["north_sd"]) == at.position_sd[0]
    (mark,) = Marks(folder, resume=True).all
    assert mark.name == NASTY and mark.north == at.position[0]
    assert Marks(folder).all == ()
    kinds = [e.kind for s in solutions for e in s.events if e.source == "pilot"]
    assert kinds == ["mark", "waypoint", "position", "removed", "mark", "removed"]
    nameless = [e.text for s in solutions for e in s.events if e.source == "pilot"][-2:]
    assert nameless[0].startswith("number 3: north ") and nameless[1] == "number 3"
    assert all(json.dumps(e.as_dict()) for s in solutions for e in s.events)


def test_results_of_the_recording_have_the_marks_where_the_smoothed_track_was(told, case, tmp_path):
    config = rg.load_config(told[0] / "config.yaml")
    result = rg.smooth(rg.read_log(told[0] / RECORDING, config), config, "smoothed")
    result.save(tmp_path / "out", figures=False)
    kept, placed = (pd.read_csv(folder / MARKS) for folder in (told[0], tmp_path / "out"))
    assert list(placed["name"]) == list(kept["name"]) == [NASTY]
    track = result.smoothed.trajectory.at(placed["time"].to_numpy())
    np.testing.assert_allclose(placed[["north", "east", "down"]], track.p_n, atol=1e-9)
    np.testing.assert_allclose(placed[["north_sd", "east_sd"]], track.p_sd[:, :2], atol=1e-9)
    assert (placed["north"] != kept["north"]).all()
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "δύτης" in page or "\\u03b4\\u03cd" in page
    assert NASTY not in page


def test_a_torn_file_of_marks_loses_its_last_line_only(told, tmp_path):
    text = (told[0] / MARKS).read_text(encoding="utf-8")
    (tmp_path / MARKS).write_text(text + "3,mark,x,no", encoding="utf-8")
    assert len(Marks(tmp_path, resume=True).all) == 1


def test_a_command_before_the_first_solution_does_nothing(case):
    navigator = Navigator(case.config, clocks=Clocks(trust=True))
    session = Session(navigator, [], Warnings())
    with closing(navigator):
        assert not list(session.solve([SetPosition(1.0, 2.0, 3.0), DropMark("x")]))
        assert session.marks.all == () and not navigator.left_out
