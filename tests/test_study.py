"""Studies: what they accept, cells that stand alone, interruptions, processes that die, what the numbers mean."""

import multiprocessing
import sys
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from folders import same_files
from scipy.stats import chi2
from tasks import errand

import rovgraph as rg
from rovgraph.cli.app import main
from rovgraph.errors import DataWarning, InputError
from rovgraph.lab.executors import Cluster, Local
from rovgraph.lab.misalignment import RUN_COLUMNS, Cell, CellTask, Study, chosen, one_run, open_results, read_study
from rovgraph.lab.misalignment import study as run_study
from rovgraph.lab.misalignment.results import cell_table

ROOT = Path(__file__).parents[1]
SHORT = """
seed: 3
runs: 2
common: {duration_s: 36, waves: false, heading_error: none}
grid: {manoeuvre: [circle, straight]}
"""


def written(folder, text):
    path = folder / "study.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture
def short(tmp_path):
    return written(tmp_path, SHORT)


class Here:
    """An engine in this process, which an interrupt may end."""

    def __init__(self, most=1000):
        self.most = most

    def each(self, function, tasks, finished):
        for k, task in enumerate(tasks):
            if k == self.most:
                raise KeyboardInterrupt
            finished(task, function(task))


def quick_run(task):
    """A row that depends on the task alone, without a dive."""
    from rovgraph.lab.misalignment.run import Done

    rng = np.random.default_rng(task.seed)
    error, sd = 2.0 * rng.standard_normal(), 2.0
    numbers = {"error_deg": error, "sd_deg": sd, "inside_95": abs(error) < 1.96 * sd, "nees": (error / sd) ** 2}
    row = {**task.begun, **numbers, "converged": True, "verdict": "weak", "cpu_s": 0.0}
    return Done(row, [{"cell": task.cell.id, "run": task.run, "time_s": 36.0, "error_deg": error, "sd_deg": sd}])


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("grid: {manoeuvres: [circle]}", "unknown key grid.manoeuvres, nearest known key is grid.manoeuvre"),
        ("cells: [{sped_mps: 1}]", "unknown key cells.0.sped_mps, nearest known key is cells.0.speed_mps"),
        ("vehicle: {dvl: {scale: 1}}", "nearest known key is vehicle.dvl.scale_sd"),
        ("grid: {imu: [mti, ring]}", "grid.imu.1: expected 'mti', 'tactical' or 'fog', found 'ring'"),
        ("grid: {speed_mps: [-1]}", "grid.speed_mps.0: expected more than 0, found -1"),
        ("grid: {manoeuvre: [cirlce]}", "manoeuvre cirlce, 600 s at 0.4 m/s: unknown scenario 'cirlce', did you mean"),
        ("grid: {imu: []}", "grid.imu is an empty list"),
        ("runs: 3", "an empty grid"),
        ("", "an empty grid"),
        ("cells: [{estimator: '4.5'}]", "estimator 4.5 works with both compasses; give heading: mag+dvl"),
        ("cells: [{duration_s: 60, cut_s: 30}]", "60 s less 30 s at both ends leaves too little to log"),
        ("vehicle: nowhere.yaml", "nowhere.yaml: cannot be read"),
        ("grid: [", "not valid YAML"),
    ],
)
def test_a_study_that_cannot_be_is_refused_in_one_line(text, complaint, tmp_path):
    with pytest.raises(InputError) as refused:
        read_study(written(tmp_path, text))
    assert complaint in str(refused.value)
    assert "\n" not in str(refused.value)


def test_cells_are_the_product_of_the_lists_and_those_told_beside(tmp_path):
    text = "common: {duration_s: 50}\ngrid: {imu: [mti, fog], heading: [mag, dvl, ahrs]}\n"
    cells = read_study(written(tmp_path, text + "cells: [{imu: fog}, {imu: mti, duration_s: 70}]")).all_cells()
    assert [(c.imu, c.heading, c.duration_s) for c in cells] == [
        *((imu, heading, 50.0) for imu in ("mti", "fog") for heading in ("mag", "dvl", "ahrs")),
        ("mti", "mag", 70.0),  # the other one told is in the product already
    ]


@pytest.mark.parametrize("path", sorted((ROOT / "configs" / "studies").glob("*.yaml")), ids=lambda p: p.stem)
def test_the_studies_that_come_with_rovgraph_are_accepted(path):
    plan = read_study(path)
    assert plan.name == path.stem
    assert len(plan.all_cells()) > 1


def test_what_is_written_beside_the_results_is_the_same_study(short, tmp_path):
    plan = read_study(short)
    again = read_study(written(tmp_path, plan.to_yaml()))
    assert again.same_dives(plan)
    assert again.all_cells() == plan.all_cells()


def test_seeds_depend_on_cell_and_run_alone_and_estimators_share_dives():
    one = Cell(manoeuvre="circle")
    seeds = {one.seed(1, run) for run in range(100)} | {one.seed(2, 0), Cell(manoeuvre="square").seed(1, 0)}
    assert len(seeds) == 102
    filtered = Cell(manoeuvre="circle", estimator="filtered")
    assert filtered.id != one.id
    assert filtered.seed(1, 5) == one.seed(1, 5)


def test_a_run_is_reproducible_alone(short):
    plan = read_study(short)
    rows = [one_run(CellTask(plan, plan.all_cells()[0], 1)).row for _ in range(2)]
    smaller = Study.model_validate({"seed": 3, "cells": [plan.all_cells()[0].model_dump()]})
    rows.append(one_run(CellTask(smaller, smaller.all_cells()[0], 1)).row)
    without_time = [{k: v for k, v in row.items() if k != "cpu_s"} for row in rows]
    assert without_time[0] == without_time[1] == without_time[2]
    assert set(rows[0]) <= set(RUN_COLUMNS)
    assert rows[0]["sd_deg"] < plan.all_cells()[0].prior_sd_deg


def test_a_run_has_what_was_asked_for_beside(short):
    plan = read_study(short).model_copy(update={"history": True, "held_track": True})
    cell = Cell(manoeuvre="circle", duration_s=36.0, misalignment_deg=45.0, fix_sd_m=0.5, prior_sd_deg=10.0)
    done = one_run(CellTask(plan, cell, 0))
    assert done.row["track_rms_held_m"] > 0.0
    assert [h["time_s"] for h in done.history][-1] == 36.0
    assert abs(done.row["estimate_deg"] - 45.0) == pytest.approx(abs(done.row["error_deg"]))
    assert abs(done.row["error_deg"]) < 4.0 * done.row["sd_deg"]


def test_a_dive_can_be_logged_without_its_start_and_its_stop(short):
    whole, cut = (Cell(manoeuvre="straight", duration_s=60, waves=False, cut_s=s) for s in (0, 20))
    sd = [one_run(CellTask(read_study(short), cell, 0)).row["sd_deg"] for cell in (whole, cut)]
    assert sd[0] < 0.8 * sd[1]  # start and stop are what a straight dive shows


def test_an_estimator_that_fails_is_a_row_that_says_why(short, monkeypatch):
    monkeypatch.setattr("rovgraph.lab.misalignment.run._of", lambda outcome: 1 / 0)
    row = one_run(CellTask(read_study(short), Cell(manoeuvre="circle", duration_s=36.0), 0)).row
    assert row["failure"] == "ZeroDivisionError: division by zero"


def finished_study(folder, plan, engine, resume=False):
    return run_study(plan, open_results(folder, plan, resume), engine=engine)


@pytest.fixture
def without_dives(monkeypatch):
    monkeypatch.setattr("rovgraph.lab.misalignment.results.one_run", quick_run)


def test_resuming_after_an_interruption_gives_the_same_tables(short, tmp_path, without_dives):
    plan = read_study(short).model_copy(update={"runs": 7})
    finished_study(tmp_path / "whole", plan, Here())
    with pytest.raises(KeyboardInterrupt):
        finished_study(tmp_path / "parts", plan, Here(most=5))
    runs = tmp_path / "parts" / "runs.csv"
    assert len(pd.read_csv(runs)) == 5
    runs.write_text(runs.read_text() + "1f2adb7fc4,3,77", encoding="utf-8")  # a row that was cut off
    with pytest.raises(KeyboardInterrupt):
        finished_study(tmp_path / "parts", plan, Here(most=4), resume=True)
    tables = finished_study(tmp_path / "parts", plan, Here(), resume=True)
    assert len(tables.runs) == 14
    for name in ("runs.csv", "history.csv"):
        assert (tmp_path / "parts" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_a_study_goes_on_with_more_runs_and_more_cells(short, tmp_path, without_dives):
    plan = read_study(short)
    first = finished_study(tmp_path / "out", plan, Here())
    more = plan.model_copy(update={"runs": 3, "cells": (Cell(manoeuvre="square", duration_s=36.0),)})
    tables = finished_study(tmp_path / "out", more, Here(), resume=True)
    assert len(first.runs) == 4
    assert tables.cells["runs"].tolist() == [3, 3, 3]


@pytest.mark.parametrize(
    ("change", "resume", "complaint"),
    [({}, False, "give --resume"), ({"seed": 4}, True, "another study"), ({"history": True}, True, "another study")],
)
def test_results_of_another_study_are_left_alone(change, resume, complaint, short, tmp_path, without_dives):
    plan = read_study(short)
    finished_study(tmp_path / "out", plan, Here())
    with pytest.raises(InputError, match=complaint):
        open_results(tmp_path / "out", plan.model_copy(update=change), resume)


def test_a_foreign_folder_is_no_study_to_resume(short, tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.png").write_bytes(b"")
    with pytest.raises(InputError, match="no study to resume"):
        open_results(tmp_path / "photos", read_study(short), resume=True)


def test_one_cell_is_chosen_by_the_beginning_of_its_id(short):
    plan = read_study(short)
    cell = plan.all_cells()[1]
    assert chosen(plan, cell.id[:6]) == [cell]
    with pytest.raises(InputError, match="no cell of this study"):
        chosen(plan, "xyz")


def synthetic(runs, claimed):
    """Runs of a cell whose errors have an sd of 1 degree, and an estimator that claims another."""
    cell = Cell()
    error = np.random.default_rng(5).standard_normal(runs)
    frame = pd.DataFrame({"cell": cell.id, "run": range(runs), "error_deg": error, "sd_deg": claimed})
    frame = frame.assign(inside_95=abs(error) < 1.96 * claimed, nees=(error / claimed) ** 2, converged=True)
    frame = frame.assign(verdict="weak", failure=np.nan).reindex(columns=RUN_COLUMNS)
    return cell_table(frame, [cell]).iloc[0]


def test_an_honest_estimator_has_coverage_and_nees_in_their_bands():
    row = synthetic(400, 1.0)
    assert row["coverage_low"] < 0.95 < row["coverage_high"]
    assert row["nees_low"] < row["nees"] < row["nees_high"]
    assert row["nees_high"] == pytest.approx(chi2.ppf(0.975, 400) / 400)
    assert row["sd_ratio"] == pytest.approx(1.0, abs=2.0 / np.sqrt(2 * 400) * 2)
    assert abs(row["bias_deg"]) < 3.0 / np.sqrt(400)


def test_an_estimator_that_claims_half_its_error_is_found_out():
    row = synthetic(400, 0.5)
    assert row["coverage_high"] < 0.95
    assert row["nees"] > row["nees_high"]
    assert row["sd_ratio"] < 0.6


def test_a_process_that_dies_costs_nothing_but_its_own_task(tmp_path):
    came = {}
    tasks = [(k, str(tmp_path)) for k in range(12)]
    with pytest.warns(DataWarning, match="a worker process was killed"):
        Local(2).each(errand, tasks, lambda task, result: came.setdefault(task[0], result))
    assert "killed" in str(came.pop(9))
    assert "busy" in str(came.pop(7))
    assert came == {k: k * k for k in range(12) if k not in (7, 9)}


@pytest.mark.slow
def test_a_worker_killed_in_the_middle_leaves_a_complete_result(short, tmp_path):
    plan = read_study(short).model_copy(update={"runs": 1})
    killed = []

    def kill_one(done):
        if done > 0.0 and not killed:
            killed.append(multiprocessing.active_children()[0])
            killed[0].kill()

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        tables = run_study(plan, open_results(tmp_path / "out", plan, False), engine=Local(1), progress=kill_one)
    assert killed
    assert tables.runs["failure"].isna().all()
    expected = [one_run(CellTask(plan, cell, 0)).row["error_deg"] for cell in plan.all_cells()]
    assert tables.runs["error_deg"].tolist() == expected


@pytest.mark.slow
def test_a_cluster_gives_the_same_and_outlives_a_worker(tmp_path):
    distributed = pytest.importorskip("distributed")
    came = {}
    tasks = [(k, str(tmp_path)) for k in range(6)]
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, silence_logs=50
    ) as cluster:
        Cluster(cluster.scheduler_address).each(errand, tasks, lambda t, result: came.setdefault(t[0], result))
    assert came == {k: k * k for k in range(6)}


@pytest.fixture
def run(monkeypatch, capsys):
    """Run the command line; returns exit code, standard output, standard error."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["rovgraph", "study", "misalignment", *map(str, arguments)])
        try:
            main()
        except SystemExit as stop:
            return stop.code or 0, *capsys.readouterr()
        return 0, *capsys.readouterr()

    return call


def test_the_command_writes_everything_and_shows_coverage_of_each_cell(
    run, short, tmp_path, monkeypatch, without_dives
):
    monkeypatch.setattr("rovgraph.lab.executors.Local", lambda jobs: Here())
    out = tmp_path / "out"
    code, shown, errors = run("--config", short, "--out", out)
    assert (code, errors) == (0, "")
    assert {p.name for p in out.iterdir()} == {
        "report.html", "study.yaml", "runs.csv", "history.csv", "cells.csv", "summary.json", "coverage.png",
        "error.png", "sd.png",
    }  # fmt: skip
    for cell in read_study(short).all_cells():
        line = next(text for text in shown.splitlines() if text.strip().startswith(cell.id))
        assert "100 % (16–100)" in line  # two of two: the lower end is 0.025 ** (1/2)
    code, _, errors = run("--config", short, "--out", out)
    assert (code, errors) == (2, f"error: {out} exists; give --resume to go on with it, or choose another --out\n")
    assert run("--config", short, "--out", out, "--resume")[0] == 0


def test_the_library_writes_what_the_command_writes(run, short, tmp_path, monkeypatch, without_dives):
    monkeypatch.setattr("rovgraph.lab.executors.Local", lambda jobs: Here())
    assert run("--config", short, "--out", tmp_path / "command")[0] == 0
    tables = rg.study_misalignment(short, tmp_path / "twin")
    same_files(tmp_path / "command", tmp_path / "twin")
    assert len(tables.runs) == len(pd.read_csv(tmp_path / "twin" / "runs.csv"))
    with pytest.raises(rg.InputError, match="cannot be combined"):
        rg.study_misalignment(short, tmp_path / "other", jobs=1, scheduler="tcp://127.0.0.1:9")


def test_an_interrupt_says_how_to_go_on(run, short, tmp_path, monkeypatch, without_dives):
    monkeypatch.setattr("rovgraph.lab.executors.Local", lambda jobs: Here(most=1))
    code, shown, _ = run("--config", short, "--out", tmp_path / "out")
    assert code == 130
    assert "--resume" in shown


def test_the_cells_are_listed_without_a_run(run, short):
    code, shown, _ = run("--config", short, "--list")
    assert code == 0
    assert all(cell.id in shown for cell in read_study(short).all_cells())


def test_a_scheduler_that_is_not_there_is_one_line(run, short, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("rovgraph.lab.executors.CONNECT_S", 0.3)
    code, _, errors = run("--config", short, "--out", tmp_path / "out", "--scheduler", "tcp://127.0.0.1:9")
    assert code == 2
    assert errors.startswith("error: tcp://127.0.0.1:9: no Dask scheduler answers there")
    assert errors.count("\n") == 1


def test_without_dask_the_extra_is_named(run, short, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    code, _, errors = run("--config", short, "--out", tmp_path / "out", "--scheduler", "tcp://127.0.0.1:9")
    assert code == 2
    assert "pip install 'rovgraph[studies]'" in errors
