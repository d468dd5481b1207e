"""Comparison of estimators: through the command line, over processes, and what the numbers mean."""

import math
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from dives import falcon, kept, simulated, without
from scipy.stats import chi2

from rovgraph.cli.app import main
from rovgraph.errors import InputError
from rovgraph.inference.estimate import Estimate, residual_frame
from rovgraph.inference.trajectory import Trajectory
from rovgraph.lab.compare import REFERENCE, RUN_COLUMNS, aggregate, compare, measures, nees_band
from rovgraph.lab.estimators import ESTIMATORS, ChainTask, EstimatorSpec, outcomes, outcomes_of_dives, select
from rovgraph.lab.executors import in_workers, starting
from rovgraph.lab.runs import Case, Recorded
from rovgraph.log import Log
from rovgraph.report.figures_lab import draw_errors, draw_velocity

ROOT = Path(__file__).parents[1]
FALCON = ROOT / "rovgraph" / "model" / "falcon.yaml"
FEW = "graph-smoothed-misalignment,dead-reckoning,graph-smoothed-c"
DIVES = ["--scenario", "circle", "--duration", "40", "--config", str(FALCON)]


def run(*arguments: object) -> int:
    """Run the console script, give its exit code."""
    before, sys.argv = sys.argv, ["rovgraph", "compare", *map(str, arguments)]
    try:
        main()
    except SystemExit as end:
        return int(end.code or 0)
    finally:
        sys.argv = before
    return 0


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short dives in one process."""
    out = tmp_path_factory.mktemp("compared") / "out"
    assert run(*DIVES, "--seeds", 2, "--estimators", FEW, "--jobs", 1, "--out", out) == 0
    return out


def test_the_folder_holds_tables_summary_and_figures(compared):
    tables = {"report.html", "table.csv", "runs.csv", "misalignment.csv", "velocity.csv", "summary.json", "config.yaml"}
    figures = {"errors.png", "end_points.png", "velocity.png", "misalignment.png"}
    assert {p.name for p in compared.iterdir()} == tables | figures


def test_what_the_reference_does_not_know_has_no_panel_and_the_thesis_only_its_own_dives(compared):
    table, runs = (pd.read_csv(compared / f"{name}.csv") for name in ("table", "runs"))
    table["thesis_end_mean_m"] = 1.0
    for thesis in (False, True):
        figure = draw_errors(table, runs.assign(velocity_rms_mps=np.nan), "own log", thesis)
        assert [axes.get_xlabel() for axes in figure.axes] == ["end error [m]", "heading, rms [deg]"]
        said = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
        assert ("as printed there" in said) == thesis
    velocity = pd.read_csv(compared / "velocity.csv")
    velocity.loc[velocity["estimator"] == REFERENCE, ["v_north", "v_east"]] = np.nan
    figure = draw_velocity(velocity, "own log")
    assert figure is not None and figure.get_suptitle().endswith("the reference has none")
    said = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert said == ["north", "east"]


def test_rows_are_in_the_order_of_runs_and_of_the_registry(compared):
    names = [name for name in ESTIMATORS if name in FEW.split(",")]
    rows = pd.read_csv(compared / "runs.csv")
    assert rows[["run", "estimator"]].to_numpy().tolist() == [[f"circle {s}", n] for s in (1, 2) for n in names]
    assert pd.read_csv(compared / "table.csv")["estimator"].tolist() == names


@pytest.mark.slow
def test_the_same_seeds_give_the_same_table_whatever_the_jobs(compared, tmp_path):
    assert run(*DIVES, "--seeds", 2, "--estimators", FEW, "--jobs", 2, "--out", tmp_path / "out") == 0
    for name in ("runs", "table", "misalignment", "velocity"):
        one, two = (pd.read_csv(folder / f"{name}.csv") for folder in (compared, tmp_path / "out"))
        pd.testing.assert_frame_equal(
            one.drop(columns="cpu_per_s", errors="ignore"), two.drop(columns="cpu_per_s", errors="ignore")
        )


def test_every_column_is_documented(compared):
    text = (ROOT / "docs" / "compare.md").read_text(encoding="utf-8")
    known = set(re.findall(r"`([a-z_0-9…, ]+)`", text))
    known = {part.strip() for group in known for part in group.split(",")}
    prefixes = tuple(name.removesuffix("…") for name in known if name.endswith("_…"))
    columns = {
        c for name in ("runs", "table", "misalignment", "velocity") for c in pd.read_csv(compared / f"{name}.csv")
    }
    assert {c for c in columns if c not in known and not c.startswith(prefixes)} == set()


def test_every_estimator_is_documented():
    text = (ROOT / "docs" / "compare.md").read_text(encoding="utf-8")
    rows = [re.findall(r"`([^`]+)`", line.split("|")[1]) for line in text.splitlines() if line.startswith("| `")]
    names = {first.removesuffix("-a") + n if n.startswith("-") else n for first, *more in rows for n in (first, *more)}
    assert set(ESTIMATORS) <= names


def test_the_estimate_of_the_misalignment_is_compared_with_the_simulated_one(compared):
    rows = pd.read_csv(compared / "runs.csv").set_index("estimator")
    estimated = rows.loc["graph-smoothed-misalignment"]
    assert (estimated["misalignment_true_deg"].abs() > 1e-6).all()
    error = estimated["misalignment_deg"] - estimated["misalignment_true_deg"]
    assert (error.abs() < 4.0 * estimated["misalignment_sd_deg"]).all()
    assert rows.drop("graph-smoothed-misalignment")["misalignment_deg"].isna().all()


@pytest.fixture(scope="module")
def recorded() -> Case:
    dive = simulated(falcon(), 40.0, path="circle")
    return Case(dive.log, dive.config, dive.truth.every(10))


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is given to each worker is done one after another here; a worker takes seconds to start."""
    monkeypatch.setattr(
        "rovgraph.lab.compare.in_workers", lambda function, tasks, *_: [function(task) for task in tasks]
    )


def test_an_estimator_that_fails_has_its_row_and_the_others_go_on(recorded, in_this_process):
    case = Case(without(recorded.log, "mag"), recorded.config, recorded.reference)
    result = compare([Recorded("lake", case)], ["graph-smoothed-b", "graph-smoothed-c"], jobs=1)
    errors = result.runs.set_index("estimator")["error"]
    assert pd.isna(errors["graph-smoothed-b"])
    assert "no magnetometer" in errors["graph-smoothed-c"]
    table = result.table.set_index("estimator")
    assert table["failed"].to_dict() == {"graph-smoothed-b": 0.0, "graph-smoothed-c": 1.0}
    assert np.isfinite(table["end_mean_m"]["graph-smoothed-b"])
    assert np.isnan(table["end_mean_m"]["graph-smoothed-c"])


def chain(name: str, *stages: object) -> EstimatorSpec:
    return EstimatorSpec(name, "graph", "of a test", "", False, False, stages)  # type: ignore[arg-type]


def test_estimators_share_the_stages_they_have_in_common(recorded):
    calls: list[str] = []

    def slow(task: ChainTask) -> str:
        calls.append("slow")
        spent = time.process_time()
        while time.process_time() - spent < 0.02:
            pass
        return task.log.source

    def first(source: str) -> str:
        return "first of " + source

    def second(source: str) -> str:
        return "second of " + source

    done = list(outcomes([chain("a", slow, first), chain("b", slow, second)], recorded.log, recorded.config))
    assert calls == ["slow"]
    assert [o.estimate for o in done] == [f"{which} of dive.csv" for which in ("first", "second")]
    assert all(o.seconds >= 0.02 for o in done)


@pytest.mark.slow
def test_filters_of_several_dives_go_side_by_side_and_share_the_time(recorded):
    lacking = ChainTask(without(recorded.log, "mag"), recorded.config)
    short = ChainTask(kept(recorded.log, "imu", recorded.log["imu"].time < 10.0), recorded.config)
    names = ["dead-reckoning", "4.3a", "4.3b"]
    done = list(outcomes_of_dives(select(names), [ChainTask(recorded.log, recorded.config), lacking, short]))
    assert [(k, o.named.name) for k, o in done] == [(k, name) for k in range(3) for name in names]
    by_name = {(k, o.named.name): o for k, o in done}
    assert "no magnetometer" in str(by_name[1, "4.3a"].error)
    for k, dive in ((0, recorded), (1, lacking), (2, short)):
        together = by_name[k, "4.3b"].estimate
        alone = ESTIMATORS["4.3b"](dive.log, dive.config)
        assert together is not None and (together.trajectory.p_n == alone.trajectory.p_n).all()
    seconds = [by_name[k, "4.3b"].seconds for k in range(3)]
    assert seconds[0] == seconds[1] == by_name[0, "4.3a"].seconds
    assert 3.9 < seconds[0] / seconds[2] < 4.1, "a log of 40 s, and 10 s of it"


def test_error_state_filters_of_several_dives_are_each_as_they_are_alone(recorded):
    lacking = ChainTask(without(recorded.log, "dvl_heading"), recorded.config)
    short = ChainTask(kept(recorded.log, "imu", recorded.log["imu"].time < 15.0), recorded.config)
    depth = recorded.config.depth.model_copy(update={"sd_m": 0.5})
    other = ChainTask(recorded.log, recorded.config.model_copy(update={"depth": depth}))
    dives = [ChainTask(recorded.log, recorded.config), lacking, short, other]
    names = ["ekf-b", "rts-b", "graph-filtered-b"]
    done = {(k, o.named.name): o for k, o in outcomes_of_dives(select(names), dives)}
    assert len(done) == 12
    for (k, name), outcome in done.items():
        if k == 1:
            assert "no compass of the DVL" in str(outcome.error)
            continue
        alone = ESTIMATORS[name](dives[k].log, dives[k].config)
        assert outcome.estimate is not None and outcome.seconds > 0.0
        np.testing.assert_array_equal(outcome.estimate.trajectory.p_n, alone.trajectory.p_n)
        np.testing.assert_array_equal(outcome.estimate.trajectory.cov_p, alone.trajectory.cov_p)


def test_a_dive_without_an_imu_does_not_stop_the_others(recorded):
    dives = [ChainTask(without(recorded.log, "imu"), recorded.config), ChainTask(recorded.log, recorded.config)]
    lacking, good = (outcome for _, outcome in outcomes_of_dives(select(["4.3b"]), dives))
    assert "acc_x" in str(lacking.error) and np.isnan(lacking.seconds)
    assert good.error is None and good.seconds > 0.0


def test_dives_in_groups_give_what_they_give_one_by_one(recorded, in_this_process):
    logs = [kept(recorded.log, "imu", recorded.log["imu"].time < end) for end in (6.0, 9.0, 7.0, 8.0)]
    runs = [Recorded(f"dive {k}", Case(log, recorded.config, recorded.reference)) for k, log in enumerate(logs)]
    grouped, alone = (compare(runs, ["4.3a", "4.3b", "4.4c"], jobs=jobs).runs for jobs in (1, 2))
    assert grouped["error"].isna().all() and len(grouped) == 12
    pd.testing.assert_frame_equal(grouped.drop(columns="cpu_per_s"), alone.drop(columns="cpu_per_s"), check_exact=True)


def test_any_exception_is_an_outcome(recorded):
    def broken(task: ChainTask) -> float:
        return 1.0 / 0.0

    def fine(task: ChainTask) -> Log:
        return task.log

    done = list(outcomes([chain("a", broken), chain("b", fine)], recorded.log, recorded.config))
    assert isinstance(done[0].error, ZeroDivisionError)
    assert done[1].estimate is recorded.log
    with pytest.raises(ZeroDivisionError):
        chain("a", broken)(recorded.log, recorded.config)


@pytest.mark.parametrize(
    ("name", "sources", "estimated"),
    [
        ("graph-smoothed-a", ("mag", "dvl"), False),
        ("graph-filtered-b", ("dvl",), False),
        ("graph-smoothed-c", ("mag",), False),
        ("graph-filtered-misalignment", ("mag", "dvl"), True),
    ],
)
def test_a_name_stands_for_headings_and_misalignment(recorded, name, sources, estimated):
    config = ESTIMATORS[name].task(recorded.log, recorded.config).config
    assert config.heading.sources == sources
    assert config.calibration.dvl_yaw.estimate is estimated
    assert config.calibration.dvl_yaw.sd_deg == recorded.config.calibration.dvl_yaw.sd_deg


def constant(p_n: tuple[float, float, float], v_n: tuple[float, float, float], sd: float) -> Trajectory:
    """Eleven epochs in one place, 1 s apart."""
    n, eye = 11, np.eye(3)
    covariance = np.tile(sd**2 * eye, (n, 1, 1))
    return Trajectory(
        np.arange(n, dtype=float),
        np.tile(p_n, (n, 1)),
        np.tile(eye, (n, 1, 1)),
        np.tile(v_n, (n, 1)),
        *[covariance] * 3,
    )


def test_measures_of_a_constant_error_by_hand(recorded):
    truth = constant((0.0, 0.0, 5.0), (0.1, 0.0, 0.0), np.nan)
    estimate = Estimate("x", constant((3.0, 4.0, 9.0), (0.1, 0.2, 7.0), 2.0), [], {}, residual_frame())
    row = measures(estimate, Case(recorded.log, recorded.config, truth), chain("x"))
    assert (row["end_north_m"], row["end_east_m"]) == (3.0, 4.0)
    wanted = {
        "end_m": 5.0,
        "rms_m": 5.0,
        "velocity_rms_mps": 0.2,
        "nees": 6.25,
        "nees_end": 6.25,
        "heading_rms_deg": 0.0,
    }
    assert {name: row[name] for name in wanted} == pytest.approx(wanted)
    assert row["inside_end"] is True
    assert row["inside_track"] == 1.0


def test_an_estimate_that_is_not_finite_is_a_failure(recorded):
    estimate = Estimate("x", constant((np.nan, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0), [], {}, residual_frame())
    with pytest.raises(FloatingPointError, match="diverged"):
        measures(estimate, recorded, chain("x"))


def test_a_reference_on_another_clock_is_a_failure_that_says_so(recorded):
    estimate = Estimate("x", constant((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0), [], {}, residual_frame())
    late = Trajectory(recorded.reference.time + 1e6, *list(vars(recorded.reference).values())[1:])
    with pytest.raises(InputError, match="on the same clock"):
        measures(estimate, Case(recorded.log, recorded.config, late), chain("x"))


def rows(**columns: list[object]) -> pd.DataFrame:
    return pd.DataFrame(columns).reindex(columns=[*RUN_COLUMNS, *(c for c in columns if c not in RUN_COLUMNS)])


def test_a_table_by_hand():
    name = "graph-filtered-misalignment"
    frame = rows(
        estimator=[name] * 4,
        error=[None, None, None, "lost"],
        end_m=[1.0, 2.0, 6.0, np.nan],
        rms_m=[3.0, 4.0, 0.0, np.nan],
        max_m=[3.0, 9.0, 1.0, np.nan],
        nees=[1.0, 2.0, 6.0, np.nan],
        nees_end=[10.0, 20.0, 30.0, np.nan],
        inside_end=[True, False, False, None],
        inside_track=[1.0, 0.5, 0.0, np.nan],
        nis_dvl=[1.0, 1.5, 2.0, np.nan],
        misalignment_deg=[1.0, 2.0, 3.0, np.nan],
        misalignment_sd_deg=[3.0, 4.0, 0.0, np.nan],
        misalignment_true_deg=[0.0, 2.0, 2.0, np.nan],
        cpu_per_s=[0.1, 0.2, 0.3, np.nan],
    )
    row = aggregate(frame, select([name])).iloc[0]
    wanted = {
        "runs": 4,
        "failed": 0.25,
        "end_mean_m": 3.0,
        "end_sd_m": math.sqrt(7.0),  # (4 + 1 + 9) / 2
        "rms_m": math.sqrt(25.0 / 3.0),
        "max_m": 9.0,
        "nees_mean": 3.0,
        "nees_end_mean": 20.0,
        "inside_end": 1.0 / 3.0,
        "inside_track": 0.5,
        "nis_dvl": 1.5,
        "misalignment_mean_deg": 2.0,
        "misalignment_sd_deg": math.sqrt(25.0 / 3.0),
        "misalignment_error_mean_deg": 2.0 / 3.0,
        "misalignment_error_rms_deg": math.sqrt(2.0 / 3.0),
        "cpu_per_s": 0.2,
    }
    assert row[list(wanted)].to_dict() == pytest.approx(wanted)
    assert row["nees_end_band"] == "above"


@pytest.mark.parametrize("count", [1, 3, 30])
def test_the_band_of_the_mean_nees_is_that_of_chi_square(count):
    assert nees_band(count) == pytest.approx(tuple(chi2.ppf([0.025, 0.975], 2 * count) / count))


BAD = {
    "neither log nor scenario": [],
    "both": ["log.csv", "--scenario", "circle"],
    "a log without a reference": ["log.csv"],
    "a reference for a scenario": ["--scenario", "circle", "--reference", "truth.csv"],
    "a duration for a log": ["log.csv", "--reference", "truth.csv", "--duration", 60],
    "no seeds": ["--scenario", "circle", "--seeds", 0],
    "fewer than no seeds": ["--scenario", "circle", "--seeds", -3],
    "an unknown scenario": ["--scenario", "cirle"],
    "an unknown estimator": ["--scenario", "circle", "--estimators", "graph-smothed-a"],
    "no estimator": ["--scenario", "circle", "--estimators", ","],
    "no jobs": ["--scenario", "circle", "--jobs", 0],
    "no such log": ["missing.csv", "--reference", "missing.csv"],
    "an impossible duration": ["--scenario", "vattern", "--duration", 1, "--jobs", 1],
}


@pytest.mark.parametrize("arguments", BAD.values(), ids=BAD)
def test_bad_input_is_one_line_and_makes_no_folder(arguments, tmp_path, capsys):
    assert run(*arguments, "--out", tmp_path / "out") == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_estimator_is_answered_with_the_nearest_and_all_known_ones():
    with pytest.raises(InputError) as caught:
        select(["graph-smothed-a"])
    nearest, _, known = str(caught.value).partition("nearest is ")[2].partition("; there are ")
    assert nearest == "graph-smoothed-a"
    assert known.split(", ") == list(ESTIMATORS)


def test_a_pattern_stands_for_all_estimators_that_match_it():
    assert [n.name for n in select(["4.4?", "4.3a"])] == ["4.3a", "4.4a", "4.4b", "4.4c"]


def test_results_of_workers_come_in_the_order_of_the_tasks():
    done: list[float] = []
    assert in_workers(math.sqrt, [float(k * k) for k in range(9)], 2, done.append) == [float(k) for k in range(9)]
    assert done[-1] == 1.0


def test_a_worker_that_is_killed_is_one_clear_line():
    with pytest.raises(InputError, match="a worker process was killed"):
        in_workers(os._exit, [1, 1], 2, lambda done: None)


def test_a_script_whose_work_is_not_guarded_is_told_so_in_one_line(tmp_path):
    script = tmp_path / "study.py"
    script.write_text(
        "import math\n"
        "from rovgraph.errors import InputError\n"
        "from rovgraph.lab.executors import in_workers\n"
        "try:\n"
        "    print(in_workers(math.sqrt, [1.0, 4.0], 2, lambda done: None))\n"
        "except InputError as error:\n"
        "    print(error)\n"
    )
    ran = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120)
    assert ran.stderr == ""
    assert ran.stdout.strip().endswith("it has to be a file with its work under if __name__ == '__main__'")
    assert ran.stdout.count("\n") == 1


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="interrupts cannot be held back here")
def test_an_interrupt_that_another_thread_takes_waits_until_processes_have_started():
    through, over = False, threading.Event()
    other = threading.Thread(target=over.wait)
    other.start()
    try:
        with pytest.raises(KeyboardInterrupt), starting():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.2)
            through = True
    finally:
        over.set()
        other.join()
    assert through


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds child processes by /proc")
def test_an_interrupt_ends_all_workers_and_leaves_nothing(tmp_path):
    script = "from rovgraph.cli.app import main\nif __name__ == '__main__':\n    main()\n"
    (tmp_path / "run.py").write_text(script)
    command = [sys.executable, str(tmp_path / "run.py"), "compare", "--scenario", "circle", "--seeds", "400"]
    process = subprocess.Popen(
        [*command, "--jobs", "2", "--out", str(tmp_path / "out")], stderr=subprocess.PIPE, text=True
    )
    children: set[int] = set()
    deadline = time.monotonic() + 120.0
    try:
        while len(children) < 3 and time.monotonic() < deadline:  # two workers and what keeps count of them
            time.sleep(0.05)
            children = {int(p) for p in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()}
        assert len(children) >= 3
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()  # of a run that has ended, nothing
    assert process.returncode == 130
    assert "Traceback" not in errors
    assert [p.name for p in tmp_path.iterdir()] == ["run.py"]
    deadline = time.monotonic() + 10.0
    while any(map(runs, children)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(map(runs, children))


def runs(pid: int) -> bool:
    """Whether a process is still there, and not only waiting to be buried."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
