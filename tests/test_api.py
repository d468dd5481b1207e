"""The Python entrance: it does what the commands do, to the byte, and refuses what they refuse."""

import ast
import doctest
import json
import shutil
import socket
import subprocess
import sys
import time
import warnings
from dataclasses import replace
from itertools import count
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from folders import same_files
from typer.main import get_command

import rovgraph as rg
from rovgraph.api.simulation import CHOICES, SCENARIO, SEED
from rovgraph.cli.app import app, main
from rovgraph.lab.plan import SensorRates

SHIPPED = Path(__file__).parents[1] / "data" / "falcon"
IMU = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")


def command(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """Run the console script, give its exit code."""
    monkeypatch.setattr(sys, "argv", ["rovgraph", *map(str, arguments)])
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)  # the command sets its own
    with warnings.catch_warnings():
        try:
            main()
        except SystemExit as end:
            return int(end.code or 0)
    return 0


@pytest.fixture(scope="module")
def short() -> pd.DataFrame:
    """The first 60 s of the dive that ships."""
    frame = pd.read_csv(SHIPPED / "log.csv.gz")
    return frame[frame["time"] <= frame["time"].iloc[0] + 60.0]


@pytest.fixture(scope="module")
def config() -> rg.Config:
    return rg.load_config(SHIPPED / "config.yaml")


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory, short: pd.DataFrame) -> Path:
    """A log with a DVL that hangs for ten seconds, a doubled row and a cell that is infinite."""
    frame = short.copy()
    begin = frame["time"].iloc[0]
    hung = frame["time"].between(begin + 30.0, begin + 40.0) & frame["dvl_vx"].notna()
    frame.loc[hung, ["dvl_vx", "dvl_vy", "dvl_vz"]] = frame.loc[hung, ["dvl_vx", "dvl_vy", "dvl_vz"]].iloc[0].to_numpy()
    frame.loc[frame.index[1000], "gyr_x"] = np.inf
    path = tmp_path_factory.mktemp("faulty") / "log.csv"
    pd.concat([frame, frame.iloc[[-1]]]).to_csv(path, index=False)
    return path


@pytest.fixture(scope="module")
def result(faulty: Path, config: rg.Config) -> rg.Result:
    with pytest.warns(rg.DataWarning):
        return rg.smooth(rg.read_log(faulty, config), config)


# the promise


def test_every_promised_name_is_there_and_the_type_checker_knows_the_same():
    tree = ast.parse(Path(rg.__file__).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    typed = {
        alias.name: statement.module
        for statement in block.body
        if isinstance(statement, ast.ImportFrom)
        for alias in statement.names
    }
    assert typed == {name: f"rovgraph.{home}" for name, home in rg._HOMES.items()}
    assert all(callable(getattr(rg, name)) for name in rg.__all__)
    assert set(rg.__all__) <= set(dir(rg))
    with pytest.raises(AttributeError, match="smoth"):
        _ = rg.smoth


@pytest.mark.slow
def test_a_function_is_not_hidden_by_the_module_of_its_name_whichever_is_imported_first():
    code = """
import rovgraph.report, rovgraph.simulate
import rovgraph as rg
from rovgraph.simulate import Truth
from rovgraph import simulate
assert simulate is rg.simulate and Truth is not simulate
assert all(type(f).__name__ == "function" for f in (rg.report, rg.simulate))
import rovgraph.simulate
assert type(rg.simulate).__name__ == "function"
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_the_package_runs_as_a_module_and_refuses_as_the_script_does():
    command = [sys.executable, "-m", "rovgraph", "smooth", "nothing.csv"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert done.stderr == "error: nothing.csv: no such file; check the name\n"


def test_the_package_says_that_it_is_typed():
    assert (Path(rg.__file__).parent / "py.typed").is_file()


@pytest.mark.slow
def test_the_example_of_the_manual_runs(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    failed, tried = doctest.testfile(str(Path(__file__).parents[1] / "docs" / "api.md"), module_relative=False)
    assert tried > 10 and failed == 0


# twins

TWINS = {  # command -> the test that compares it with its function, in this file unless one is named
    "demo": "test_demo_writes_what_the_command_writes",
    "smooth": "test_smooth_writes_what_the_command_writes",
    "online": "test_a_run_of_sources_gives_sends_and_keeps_what_the_command_does",
    "convert": "test_convert_writes_what_the_command_writes",
    "export": "test_export.test_commands_write_what_the_library_does",
    "tag": "test_export.test_commands_write_what_the_library_does",
    "report": "test_report_and_check_write_the_pages_that_the_commands_write",
    "evaluate": "test_evaluate_measures_what_the_command_measures",
    "compare": "test_compare_writes_what_the_command_writes",
    "observe": "test_observe_writes_what_the_command_writes",
    "plan": "test_plan_writes_what_the_command_writes",
    "check": "test_check_finds_what_the_command_finds",
    "config": "test_config_prints_the_effective_configuration",
    "simulate": "test_simulate_writes_what_the_command_writes",
    "calibrate magnetometer": "test_calibrate_magnetometer.test_the_library_writes_what_the_command_writes_"
    "and_wants_samples_as_measured",
    "calibrate dvl-beams": "test_calibrate_dvl_beams.test_the_command_prints_what_the_library_finds",
    "calibrate noise": "test_calibrate_noise.test_the_library_writes_what_the_command_writes",
    "study misalignment": "test_study.test_the_library_writes_what_the_command_writes",
}


def test_every_command_is_compared_with_its_function():
    def leaves(command: object, words: tuple[str, ...] = ()) -> set[str]:
        inner = getattr(command, "commands", {})
        return {" ".join(words)} if not inner else {x for n, c in inner.items() for x in leaves(c, (*words, n))}

    assert leaves(get_command(app)) == set(TWINS)
    for place in TWINS.values():
        file, _, name = place.rpartition(".")
        text = (Path(__file__).parent / f"{file or Path(__file__).stem}.py").read_text(encoding="utf-8")
        assert f"\ndef {name}(" in text, place


def test_smooth_writes_what_the_command_writes(monkeypatch, capsys, tmp_path, faulty, result):
    assert command(monkeypatch, "smooth", faulty, "-c", SHIPPED / "config.yaml", "-o", tmp_path / "command") == 0
    said = capsys.readouterr()
    summary = result.save(tmp_path / "twin")
    same_files(tmp_path / "command", tmp_path / "twin")
    assert summary["verdict"] == result.verdict
    assert said.out.startswith(f"verdict: {result.verdict}\n")
    assert list(result.warnings) == [
        line.removeprefix("warning: ") for line in said.err.splitlines() if line.startswith("warning: ")
    ]
    assert len(result.warnings) >= 2


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["batch", "isam2"])
def test_one_estimate_of_an_engine_is_that_of_the_command(monkeypatch, tmp_path, short, engine):
    log = tmp_path / "log.csv"
    short[short["time"] < short["time"].iloc[0] + 20.0].to_csv(log, index=False)
    options = ["--engine", engine, "--estimate", "smoothed", "--no-figures"]
    assert command(monkeypatch, "smooth", log, *options, "-o", tmp_path / "command") == 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rg.DataWarning)
        twin = rg.smooth(rg.read_log(log), estimate="smoothed", engine=engine)
    twin.save(tmp_path / "twin", figures=False)
    same_files(tmp_path / "command", tmp_path / "twin")
    with pytest.raises(rg.InputError, match="filtered estimate was not requested"):
        _ = twin.filtered


def test_check_finds_what_the_command_finds(monkeypatch, capsys, faulty, config):
    assert command(monkeypatch, "check", faulty, "-c", SHIPPED / "config.yaml", "--json") == 0
    said = json.loads(capsys.readouterr().out)
    with pytest.warns(rg.DataWarning):
        report = rg.check(rg.read_log(faulty, config), config)
    assert json.loads(json.dumps(report.as_dict())) == said
    assert report.at("warning")


def test_evaluate_measures_what_the_command_measures(monkeypatch, capsys, tmp_path, result):
    result.save(tmp_path / "dive", figures=False)
    track = tmp_path / "dive" / "trajectory_smoothed.csv"
    reference = SHIPPED / "truth.csv.gz"
    assert command(monkeypatch, "evaluate", track, reference, "--from", 10, "--to", 50, "--align", "--json") == 0
    said = json.loads(capsys.readouterr().out)
    twin = rg.evaluate(rg.read_trajectory(track), rg.read_reference(reference), 10.0, True, 50.0)
    assert json.loads(json.dumps(twin.as_dict())) == said
    assert rg.evaluate(result.smoothed.trajectory, rg.read_reference(reference)).rms_m < 0.5


def test_simulate_writes_what_the_command_writes(monkeypatch, tmp_path):
    arguments = ["--seed", 3, "--duration", 60, "--dropout", "20:30", "--place", "10:-5", "--out", tmp_path / "command"]
    assert command(monkeypatch, "simulate", "lawnmower", *arguments) == 0
    choices = rg.Choices(duration=60.0, dropouts=((20.0, 30.0),), places=((10.0, -5.0),))
    dive = rg.simulate("lawnmower", seed=3, choices=choices)
    dive.save(tmp_path / "twin")
    same_files(tmp_path / "command", tmp_path / "twin")
    assert len(dive.log["dvl"]) == len(rg.read_log(tmp_path / "twin" / "log.csv", dive.config)["dvl"])


@pytest.mark.slow
def test_demo_writes_what_the_command_writes(monkeypatch, capsys, tmp_path):
    """A minute of it; the whole dive is smoothed from the installed wheel."""
    monkeypatch.setattr("rovgraph.api.simulation.CHOICES", rg.Choices(duration=60.0, outliers=0.01))
    monkeypatch.chdir(tmp_path)
    assert command(monkeypatch, "demo") == 0
    said = capsys.readouterr().out
    assert "verdict: trusted" in said and f"{Path('demo/results/report.html')}: " in said
    Path("demo").rename("command")
    done = rg.demo("demo")  # in the same place, which the summary names
    same_files(Path("command/results"), Path("demo/results"))
    for name in ("log.csv", "truth.csv", "truth.json", "config.yaml", "summary.json"):
        assert Path("command", name).read_bytes() == Path("demo", name).read_bytes(), name
    assert f"{done.metrics.rms_m:.3f} m" in said and done.metrics.rms_m < 0.1
    assert done.result.verdict == "trusted" and (done.results / "report.html").is_file()
    assert command(monkeypatch, "demo") == 2
    assert "demo exists; choose another --out or give --force" in capsys.readouterr().err


def test_the_demonstration_dive_is_the_one_of_the_repository():
    made = (SHIPPED / "README.md").read_text(encoding="utf-8")
    stated = f"simulate {SCENARIO} --seed {SEED} --outliers {CHOICES.outliers} --config rovgraph/model/falcon.yaml"
    assert stated in made
    assert rg.Choices(outliers=CHOICES.outliers) == CHOICES  # nothing else is chosen


def test_observe_writes_what_the_command_writes(monkeypatch, tmp_path, short, config):
    log = tmp_path / "log.csv"
    short[short["time"] < short["time"].iloc[0] + 20.0].to_csv(log, index=False)
    options = ["-c", SHIPPED / "config.yaml", "--estimate", "dvl_scale", "-o", tmp_path / "command"]
    assert command(monkeypatch, "observe", log, *options) == 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rg.DataWarning)
        seen = rg.observe(rg.read_log(log, config), config, "dvl_scale")
    seen.save(tmp_path / "twin")
    same_files(tmp_path / "command", tmp_path / "twin")
    assert "dvl_scale" in seen.verdicts


def test_online_gives_the_solutions_of_the_command(monkeypatch, capfd, tmp_path, short, config):
    """A late DVL and a magnetometer with hard iron: what a log is corrected by is neither lost nor done twice."""
    corrected = config.model_copy(
        update={
            "delay_s": {"dvl": 0.25},
            "imu": config.imu.model_copy(update={"mag": config.imu.mag.model_copy(update={"centre": (0.1, 0.0, 0.0)})}),
        }
    )
    log, settings = tmp_path / "log.csv", tmp_path / "settings.yaml"
    short[short["time"] < short["time"].iloc[0] + 20.0].to_csv(log, index=False)
    settings.write_text(corrected.to_yaml(), encoding="utf-8")
    assert command(monkeypatch, "online", f"file:{log}", "-c", settings, "--speed", "max", "--output", "-") == 0
    said = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    solutions = list(rg.Online(corrected).replay(rg.read_log(log, corrected)))
    assert [s.time for s in solutions] == pytest.approx([row["time"] for row in said], abs=1e-5)
    assert len(said) > 10
    track = np.array([[row["north"], row["east"], row["down"], row["north_sd"]] for row in said])
    assert np.array([[*s.position, s.position_sd[0]] for s in solutions]) == pytest.approx(track, rel=1e-5, abs=1e-6)


def test_a_run_of_sources_gives_sends_and_keeps_what_the_command_does(monkeypatch, capfd, tmp_path, short):
    log = tmp_path / "log.csv"
    short[short["time"] < short["time"].iloc[0] + 20.0].to_csv(log, index=False)
    options = ["-c", SHIPPED / "config.yaml", "--speed", "max", "--output", "-", "--rate", 2, "--no-refine"]
    assert command(monkeypatch, "online", f"file:{log}", *options, "--out", tmp_path / "command") == 0
    said = capfd.readouterr().out
    online = rg.Online(rg.load_config(SHIPPED / "config.yaml"), rate_hz=2.0)
    run = online.run(f"file:{log}", outputs=["-"], speed="max", out=tmp_path / "twin")
    solutions = list(run)
    assert [{**json.loads(line), "update_s": 0} for line in capfd.readouterr().out.splitlines()] == [
        {**json.loads(line), "update_s": 0} for line in said.splitlines()
    ]
    assert len(solutions) == len(said.splitlines()) > 10
    for name in ("received.csv", "trajectory_filtered.csv", "config.yaml", "config_online.yaml", "events.jsonl"):
        assert (tmp_path / "twin" / name).read_bytes() == (tmp_path / "command" / name).read_bytes(), name
    one, other = (json.loads((tmp_path / folder / "summary.json").read_text()) for folder in ("command", "twin"))
    assert one | {"updates": 0} == other | {"updates": 0}
    assert one["state"] == "finished"


def test_leaving_the_loop_ends_a_run_and_its_folder_is_whole(tmp_path, short):
    log = tmp_path / "log.csv"
    short[short["time"] < short["time"].iloc[0] + 20.0].to_csv(log, index=False)
    run = rg.Online(rg.load_config(SHIPPED / "config.yaml")).run(f"file:{log}", speed="max", out=tmp_path / "dive")
    for solution in run:
        if solution.distance > 1.0:
            break
    summary = json.loads((tmp_path / "dive" / "summary.json").read_text())
    assert summary["state"] == "finished"
    assert summary["time"] == pytest.approx(solution.time, abs=1.0)
    kept = rg.read_trajectory(tmp_path / "dive" / "trajectory_filtered.csv")
    assert kept.time[-1] == pytest.approx(summary["time"], abs=0.5)


def test_a_run_that_cannot_be_is_refused_and_leaves_no_output_open(tmp_path):
    (tmp_path / "kept.txt").write_text("mine")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(rg.InputError, match="choose another --out"):
        rg.Online().run("tcp://127.0.0.1:5", outputs=[f"tcp://:{port}"], out=tmp_path)
    with socket.socket() as again:
        again.bind(("127.0.0.1", port))
    with pytest.raises(rg.InputError, match="at least one source"):
        rg.Online().run()
    with pytest.raises(rg.InputError, match="--resume needs the folder"):
        rg.Online().run("tcp://127.0.0.1:5", resume=True)


@pytest.mark.slow
def test_compare_writes_what_the_command_writes(monkeypatch, tmp_path, short, config):
    short[short["time"] < short["time"].iloc[0] + 20.0].to_csv(tmp_path / "log.csv", index=False)
    for name in ("process_time", "thread_time", "perf_counter"):  # the same work takes the same time
        monkeypatch.setattr(time, name, count(0.0, 0.5).__next__)
    files = [tmp_path / "log.csv", "-c", SHIPPED / "config.yaml", "--reference", SHIPPED / "truth.csv.gz"]
    options = [*files, "--estimators", "dead-reckoning,ekf-a", "--jobs", 1]
    assert command(monkeypatch, "compare", *options, "-o", tmp_path / "command") == 0
    log = rg.read_log(tmp_path / "log.csv", config)
    twin = rg.compare(log, config, SHIPPED / "truth.csv.gz", estimators="dead-reckoning,ekf-a", jobs=1)
    twin.save(tmp_path / "twin")
    same_files(tmp_path / "command", tmp_path / "twin")
    with pytest.raises(rg.InputError, match="a reference goes with a log"):
        rg.compare(reference=SHIPPED / "truth.csv.gz", scenario="circle")


def test_plan_writes_what_the_command_writes(monkeypatch, tmp_path):
    monkeypatch.setattr("rovgraph.lab.plan.cores", lambda: 1)  # each process imports everything again
    options = ["--manoeuvres", "straight", "--duration", 60, "--imu-rate", 20, "--dvl-rate", 2]
    assert command(monkeypatch, "plan", *options, "--estimate", "dvl_yaw", "-o", tmp_path / "command") == 0
    sensors = SensorRates(20.0, 2.0, None)
    twin = rg.plan(rg.Config(), duration=60.0, manoeuvres=["straight"], estimate=["dvl_yaw"], sensors=sensors)
    twin.save(tmp_path / "twin")
    same_files(tmp_path / "command", tmp_path / "twin")


def test_report_and_check_write_the_pages_that_the_commands_write(monkeypatch, tmp_path, faulty, config, result):
    result.save(tmp_path / "dive", figures=False)
    assert command(monkeypatch, "report", tmp_path / "dive", "-o", tmp_path / "command.html") == 0
    rg.report(tmp_path / "dive", out=tmp_path / "twin.html")
    assert (tmp_path / "command.html").read_bytes() == (tmp_path / "twin.html").read_bytes()
    page = ["--page", tmp_path / "check-command.html"]
    assert command(monkeypatch, "check", faulty, "-c", SHIPPED / "config.yaml", *page) == 0
    with pytest.warns(rg.DataWarning):
        rg.report_check(rg.check(rg.read_log(faulty, config), config), tmp_path / "check-twin.html")
    assert (tmp_path / "check-command.html").read_bytes() == (tmp_path / "check-twin.html").read_bytes()


def test_convert_writes_what_the_command_writes(monkeypatch, tmp_path, short):
    for name, columns in (("imu.csv", IMU), ("dvl.csv", ("dvl_vx", "dvl_vy", "dvl_vz"))):
        short[["time", *columns]].dropna().head(2000).to_csv(tmp_path / name, index=False)
    files = [tmp_path / "imu.csv", tmp_path / "dvl.csv"]
    for folder in ("command", "twin"):
        (tmp_path / folder).mkdir()
    out = tmp_path / "command"
    options = ["-o", out / "log.csv", "--config-out", out / "vehicle.yaml", "--shift", "dvl=0"]
    assert command(monkeypatch, "convert", *files, *options) == 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rg.DataWarning)
        rg.convert(files, shift={"dvl": 0.0}).save(tmp_path / "twin" / "log.csv", tmp_path / "twin" / "vehicle.yaml")
    same_files(out, tmp_path / "twin")


def test_config_prints_the_effective_configuration(monkeypatch, capsys, config):
    assert command(monkeypatch, "config", SHIPPED / "config.yaml") == 0
    assert capsys.readouterr().out == config.to_yaml()


# configurations


def test_a_changed_configuration_keeps_what_is_not_named(config):
    changed = config.changed(dvl={"mount_rpy_deg": [180, 0, 10]}, units={"depth": "cm"}, name="other")
    assert changed.dvl.mount_rpy_deg == (180.0, 0.0, 10.0) and changed.name == "other"
    assert changed.dvl.lever_arm_m == config.dvl.lever_arm_m and changed.imu == config.imu
    assert changed.units == {**config.units, "depth": "cm"}
    assert config.changed() == config and config.changed(dvl=None).dvl == rg.Config().dvl
    twice = rg.Config().changed(delay_s={"dvl": 0.1}).changed(delay_s={"fix": 2.0})
    assert twice.delay_s == {"dvl": 0.1, "fix": 2.0}


def test_a_changed_preset_fills_in_its_own_numbers_and_leaves_those_that_were_stated():
    first = rg.parse_config("imu: {preset: xsens-mti-300, noise: {acc: 0.5}}")
    other = first.changed(imu={"preset": "vectornav-vn-100"})
    assert other.imu.noise.gyr == rg.parse_config("imu: {preset: vectornav-vn-100}").imu.noise.gyr
    assert other.imu.noise.acc == 0.5
    assert first.changed(imu={"preset": None}).imu.noise.gyr == rg.Config().imu.noise.gyr


def test_a_change_that_cannot_be_is_one_line_with_the_nearest_key(config):
    with pytest.raises(rg.InputError, match=r"lever_arm_m"):
        config.changed(dvl={"lever_arm": [0, 0, 0]})
    with pytest.raises(rg.InputError, match=r"dvl"):
        config.changed(dvl=3.0)
    with pytest.raises(rg.InputError, match="nearest is vectornav-vn-100"):
        config.changed(imu={"preset": "vectornav-vn-10"})


# results


def test_the_page_alone_is_the_page_of_the_folder(tmp_path, result):
    page = result.report(tmp_path / "dive.html")
    result.save(tmp_path / "dive", figures=False)
    assert page.stat().st_size == pytest.approx((tmp_path / "dive" / "report.html").stat().st_size, rel=0.02)
    with pytest.raises(rg.InputError, match=r"dive\.html exists"):
        result.report(tmp_path / "dive.html")


def test_a_result_has_track_calibration_and_covariance(result):
    track = result.smoothed.trajectory
    n = len(track)
    assert track.position.shape == track.velocity.shape == track.rpy.shape == (n, 3)
    assert track.covariance.shape == (n, 3, 3)
    assert list(track.to_frame().columns[:4]) == ["time", "north", "east", "down"]
    assert track.to_frame()["north"].to_numpy() == pytest.approx(track.position[:, 0])
    yaw = result.calibration["dvl_yaw"]
    assert 0.0 < yaw.sd < yaw.prior_sd and yaw.verdict
    assert abs(yaw.value - yaw.prior_mean) < 5 * yaw.prior_sd
    assert result.config.name and result.dead_reckoning.kind == "dead_reckoning"


def test_what_a_notebook_shows_of_a_dive_is_one_line(result):
    dive = rg.simulate("circle", choices=rg.Choices(duration=40.0))
    for shown in (result, result.smoothed, result.smoothed.trajectory, result.log, dive, dive.log):
        assert len(repr(shown)) < 200 and repr(shown).startswith(f"<{type(shown).__name__}")
    assert "dvl " in repr(result.log) and result.verdict in repr(result)


QUANTITIES = ("track", "depth", "heading", "roll", "pitch", "speed", "sd", "heading_sd")


def test_quantities_are_drawn_on_axes_that_are_given(result):
    from matplotlib.figure import Figure

    track, minutes = result.smoothed.trajectory, {}
    for name, axes in zip(QUANTITIES, Figure().subplots(len(QUANTITIES), 1), strict=True):
        assert getattr(result.plot, name)(axes) is axes
        line = next(line for line in axes.lines if line.get_label() == "smoothed")
        minutes[name] = (line.get_xdata(), line.get_ydata(), axes)
    np.testing.assert_array_equal(minutes["track"][0], track.p_n[:, 1])
    for name, value in (
        ("depth", track.p_n[:, 2]),
        ("roll", np.rad2deg(track.rpy[:, 0])),
        ("pitch", np.rad2deg(track.rpy[:, 1])),
        ("speed", np.hypot(*track.v_n[:, :2].T)),
        ("sd", np.sqrt(np.linalg.eigvalsh(track.cov_p[:, :2, :2])[:, 1])),
        ("heading_sd", np.rad2deg(track.rpy_sd[:, 2])),
    ):
        np.testing.assert_allclose(minutes[name][0], track.time - track.time[0])
        np.testing.assert_allclose(minutes[name][1], value, atol=1e-12)
    assert minutes["depth"][2].yaxis_inverted() and minutes["sd"][2].get_ylim()[0] == 0.0
    assert minutes["heading"][2].get_xlabel() == "time since start [s]"


def test_several_estimates_are_drawn_together_and_new_axes_are_pyplots(result):
    from matplotlib import pyplot

    before = dict(pyplot.rcParams)
    axes = result.plot.speed(None, "smoothed", "filtered")
    try:
        assert [line.get_label() for line in axes.lines] == ["smoothed", "filtered"]
        assert pyplot.fignum_exists(axes.figure.number) and dict(pyplot.rcParams) == before
    finally:
        pyplot.close(axes.figure)


def test_what_cannot_be_drawn_is_one_line(result):
    bare = replace(result, log=replace(result.log, streams={"imu": result.log["imu"]}))
    for use, said in (
        (lambda: result.plot.depth("filtered"), "axes: expected matplotlib's Axes or None, found a str; estimates"),
        (lambda: result.plot.depth(None, "best"), "the best estimate was not requested; the result has smoothed"),
        (lambda: bare.plot.altitude(), "no altitude to draw; the log has no dvl_altitude"),
    ):
        with pytest.raises(rg.InputError, match=said):
            use()


def test_progress_is_told(short, config):
    told: list[tuple[str, float]] = []
    log = rg.Log.from_frame(short[short["time"] < short["time"].iloc[0] + 20.0], config)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rg.DataWarning)
        rg.smooth(log, config, progress=lambda what, done: told.append((what, done)))
    assert {"filtering", "smoothing"} <= {what for what, _ in told}
    assert all(0.0 <= done <= 1.0 for _, done in told)


def test_a_saved_folder_is_kept_unless_forced(tmp_path, result):
    result.save(tmp_path / "dive", figures=False)
    with pytest.raises(rg.InputError, match="exists"):
        result.save(tmp_path / "dive", figures=False)
    result.save(tmp_path / "dive", force=True, figures=False)


def test_a_warning_points_to_the_line_that_asked(faulty, config):
    with pytest.warns(rg.DataWarning) as caught:
        log = rg.read_log(faulty, config)
    assert {warning.filename for warning in caught} == {__file__}
    assert [str(warning.message) for warning in caught] == list(log.warnings)


def test_a_configuration_beside_the_log_that_is_not_given_is_pointed_out(tmp_path, short):
    shutil.copy(SHIPPED / "config.yaml", tmp_path / "config.yaml")
    short.to_csv(tmp_path / "log.csv", index=False)
    with pytest.warns(rg.DataWarning, match="lies beside the log and is not used"):
        rg.read_log(tmp_path / "log.csv")


# logs in memory


def test_a_frame_gives_the_log_that_its_file_gives(tmp_path, short, config):
    short.to_csv(tmp_path / "log.csv", index=False)
    file = rg.read_log(tmp_path / "log.csv", config)
    memory = rg.Log.from_frame(pd.read_csv(tmp_path / "log.csv"), config)
    assert file.sensors == memory.sensors
    for sensor in file.sensors:
        np.testing.assert_array_equal(file[sensor].time, memory[sensor].time)
        np.testing.assert_array_equal(file[sensor].data, memory[sensor].data)
        np.testing.assert_array_equal(file[sensor].row, memory[sensor].row)


def test_arrays_of_several_rates_become_one_log(short, config):
    tables = []
    for columns in (IMU, ("dvl_vx", "dvl_vy", "dvl_vz"), ("mag_x", "mag_y", "mag_z")):
        rows = short.dropna(subset=list(columns))
        tables.append({name: rows[name].to_numpy() for name in ("time", *columns)})
    log, whole = rg.Log.from_arrays(*tables, config=config), rg.Log.from_frame(short, config)
    for sensor in ("imu", "mag"):
        np.testing.assert_array_equal(log[sensor].time, whole[sensor].time)
        np.testing.assert_array_equal(log[sensor].data, whole[sensor].data)


def test_arrays_are_mapped_by_the_configurations_columns_and_units():
    config = rg.parse_config("columns: {time: t, depth: d}\nunits: {time: ms, depth: cm}")
    log = rg.Log.from_arrays({"t": [0, 2000], "d": [100.0, 300.0]}, {"t": [1000], "d": [200.0]}, config=config)
    assert log["depth"].time.tolist() == [0.0, 1.0, 2.0]
    assert log["depth"].data[:, 0].tolist() == [1.0, 2.0, 3.0]


T = np.arange(3.0)
BAD_FRAMES = {
    "no time": (pd.DataFrame({"depth": T}), "no column time"),
    "a time in the index": (pd.DataFrame({"depth": T}, index=pd.Index(T, name="time")), "no column time"),
    "text": (pd.DataFrame({"time": T, "depth": ["1", "deep", "2"]}), "line 3, column depth: 'deep' is not a number"),
    "lists": (pd.DataFrame({"time": T, "depth": [[1], [2], [3]]}), r"column depth: '\[1\]' is not a number"),
    "mixed objects": (pd.DataFrame({"time": T, "depth": [1.0, {}, None]}), "column depth: '{}' is not a number"),
    "durations": (pd.DataFrame({"time": pd.to_timedelta(T, unit="s"), "depth": T}), "time holds durations"),
    "a mix with complex numbers": (
        pd.DataFrame({"time": T, "depth": pd.Series([1j, 2.0, None], dtype=object)}),
        "column depth: '1j' is not a number",
    ),
    "complex numbers": (
        pd.DataFrame({"time": T, "depth": T + 1j}),
        "column depth holds complex numbers, expected numbers; give one real number per row",
    ),
    "an integer too large": (
        pd.DataFrame({"time": T, "depth": pd.Series([1, 10**400, 2], dtype=object)}),
        "column depth holds an integer of hundreds of digits",
    ),
    "a name twice": (pd.DataFrame(np.ones((3, 3)), columns=["time", "depth", "depth"]), "column 'depth' twice"),
    "no rows": (pd.DataFrame({"time": [], "depth": []}), "no rows"),
    "no sensor": (pd.DataFrame({"time": T, "temperature": T}), "no measurement of any sensor"),
    "numbered columns": (pd.DataFrame(np.ones((3, 2))), "no column time"),
    "no frame": ([1.0, 2.0], "is a list, expected a pandas DataFrame"),
}


@pytest.mark.parametrize(("frame", "said"), BAD_FRAMES.values(), ids=BAD_FRAMES)
def test_a_frame_that_is_no_log_is_refused_in_one_line(frame, said):
    with pytest.raises(rg.InputError, match=said) as caught:
        rg.Log.from_frame(frame)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("zone", [None, "Europe/Oslo"])
@pytest.mark.parametrize("kind", [None, object])
@pytest.mark.filterwarnings("ignore::rovgraph.errors.DataWarning")
def test_dates_of_a_frame_are_unix_time(zone, kind):
    dates = pd.Series(
        pd.date_range("2024-01-01 01:00" if zone else "2024-01-01", periods=3, freq="s", tz=zone), dtype=kind
    )
    log = rg.Log.from_frame(pd.DataFrame({"time": dates, "depth": T}))
    assert log["depth"].time.tolist() == [1704067200.0, 1704067201.0, 1704067202.0]


def test_a_column_of_arrows_lists_is_refused():
    arrow = pytest.importorskip("pyarrow")
    depth = pd.Series([[1.0], [2.0], [3.0]], dtype=pd.ArrowDtype(arrow.list_(arrow.float64())))
    with pytest.raises(rg.InputError, match="column depth holds lists, expected numbers; give one real number per row"):
        rg.Log.from_frame(pd.DataFrame({"time": T, "depth": depth}))


def test_what_an_array_masks_is_missing():
    log = rg.Log.from_arrays({"time": T, "depth": np.ma.masked_array([1.0, 9999.0, 3.0], [False, True, False])})
    assert log["depth"].time.tolist() == [0.0, 2.0]
    assert log["depth"].data[:, 0].tolist() == [1.0, 3.0]


@pytest.mark.parametrize("case", ["no time", "text", "a name twice", "no rows", "no sensor"])
def test_a_frame_is_refused_with_the_words_that_the_command_has_for_its_file(monkeypatch, capsys, tmp_path, case):
    frame, path = BAD_FRAMES[case][0], tmp_path / "log.csv"
    frame.to_csv(path, index=False)
    assert command(monkeypatch, "smooth", path, "-o", tmp_path / "out") == 2
    said = capsys.readouterr().err.strip()
    with pytest.raises(rg.InputError) as caught:
        rg.Log.from_frame(frame, source=str(path))
    assert said == f"error: {caught.value}"


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ([{"time": T, "depth": T[:2]}], r"columns of different length \(time 3, depth 2\)"),
        ([{"time": T, "depth": np.ones((3, 1))}], r"column depth has shape \(3, 1\)"),
        ([{"time": T, "depth": [[1, 2], [3], [4]]}], "column depth holds lists, expected one number per row"),
        ([{"time": T, "depth": 1.0}], r"column depth has shape \(\)"),
        ([{"time": T, "depth": T}, {"dvl_vx": T}], "rows without time"),
        ([], "no rows"),
    ],
)
def test_arrays_that_are_no_log_are_refused_or_warned_of(tables, said):
    with pytest.raises((rg.InputError, rg.DataWarning), match=said), warnings.catch_warnings():
        warnings.simplefilter("error", rg.DataWarning)
        rg.Log.from_arrays(*tables)


@pytest.mark.parametrize(
    "text", ["units: {gyr: deg/s}", "columns: {depth: acc_x}", "delay_s: {dvl: 1}", "imu: {mag: {centre: [1, 0, 0]}}"]
)
def test_a_log_is_not_used_with_a_configuration_that_reads_it_otherwise(short, text):
    log, other = rg.Log.from_frame(short), rg.parse_config(text)
    for use in (rg.smooth, rg.check, rg.observe, lambda log, config: next(rg.Online(config).replay(log))):
        with pytest.raises(rg.InputError, match=r"was read with another .*; read it with this configuration"):
            use(log, other)


def test_what_is_no_log_no_configuration_or_no_choice_is_one_line(short):
    log = rg.Log.from_frame(short)
    with pytest.raises(rg.InputError, match="expected a Log"):
        rg.smooth("log.csv")
    with pytest.raises(rg.InputError, match="expected a Config"):
        rg.smooth(log, "vehicle.yaml")
    with pytest.raises(rg.InputError, match="estimate 'best': expected smoothed"):
        rg.smooth(log, estimate="best")
    with pytest.raises(rg.InputError, match="engine 'fast': expected batch"):
        rg.smooth(log, engine="fast")
    with pytest.raises(rg.InputError, match="engine 'batch': expected fixed-lag"):
        rg.Online(engine="batch")
    with pytest.raises(rg.InputError, match="seed -1"):
        rg.simulate("circle", seed=-1)
    with pytest.raises(rg.InputError, match="at most 21600"):
        rg.Choices(duration=1e5)
    with pytest.raises(rg.InputError, match="compare wants either a log"):
        rg.compare()
    with pytest.raises(rg.InputError, match="seeds: expected a list or range of at least one, found 3"):
        rg.compare(scenario="circle", seeds=3)
    with pytest.raises(rg.InputError, match="choices: expected Choices"):
        rg.simulate("circle", choices={"duration": 60})
    with pytest.raises(rg.InputError, match=r"table 2 is a Config, .* config="):
        rg.Log.from_arrays({"time": T, "depth": T}, rg.Config())
    with pytest.raises(rg.InputError, match="goal dvl_yaw: 'wide', expected an sd"):
        rg.plan(goals={"dvl_yaw": "wide"}, estimate="dvl_yaw")
    with pytest.raises(rg.InputError, match="unknown calibration variable 'dvl_yav', did you mean dvl_yaw"):
        rg.observe(log, estimate="dvl_yav,dvl_scale")


def test_an_argument_of_the_wrong_kind_is_one_line(tmp_path, short, result):
    log, path = rg.Log.from_frame(short), tmp_path / "log.csv"
    short.to_csv(path, index=False)
    for use, said in (
        (lambda: rg.Choices(duration="40"), "duration '40': a number is expected"),
        (lambda: rg.Choices(outliers="a"), "outliers 'a': a number is expected"),
        (lambda: rg.Choices(current=3), "current 3: north and east in m/s"),
        (lambda: rg.Choices(current=("a", 1)), r"current \('a', 1\): north and east"),
        (lambda: rg.Choices(dropouts=((5,),)), r"dropouts \(\(5,\),\): pairs of numbers"),
        (lambda: rg.Choices(dropouts=5), "dropouts 5: pairs of numbers"),
        (lambda: rg.Choices(places=((1, 2, 3),)), "places .*: pairs of numbers are expected, as"),
        (lambda: rg.Online(rate_hz="2"), "rate_hz 2: between 0.01 and 200"),
        (lambda: rg.observe(log, estimate=[3]), "3: expected a name"),
        (lambda: rg.plan(goals=3, estimate="dvl_yaw"), "goals: 3, expected a mapping"),
        (lambda: rg.Online().run(f"file:{path}", outputs="jsonl"), "output 'jsonl' is of an unknown form"),
        (lambda: rg.compare(log, reference="a.csv", estimators="graph-smoothd"), "nearest is graph-smoothed-"),
        (lambda: rg.compare(log, reference=5), "reference: expected a path or a Trajectory, found an int"),
        (lambda: rg.simulate(5), "scenario: expected its name, such as lawnmower, found an int"),
        (lambda: rg.report_check(5, "check.html"), "found: expected what rg.check returns, found an int"),
        (lambda: rg.export(result, None, out=tmp_path), "to: expected text, found None"),
        (lambda: rg.Online().run(f"file:{path}", outputs=5), "outputs: expected text, found an int"),
    ):
        with pytest.raises(rg.InputError, match=said):
            use()


def test_a_trajectory_is_written_to_a_path_given_as_text(tmp_path):
    truth = rg.simulate("circle", choices=rg.Choices(duration=40.0)).truth
    truth.write_csv(str(tmp_path / "truth.csv"))
    truth.write_tum(str(tmp_path / "truth.ned.tum"))
    assert len(rg.read_trajectory(tmp_path / "truth.csv")) == len(truth)
    assert (tmp_path / "truth.ned.tum").read_text().startswith("# time [s]")


def test_what_is_no_configuration_no_file_or_no_trajectory_is_one_line(short):
    for use in (
        lambda: rg.read_log(SHIPPED / "log.csv.gz", "vehicle.yaml"),
        lambda: rg.Log.from_frame(short, {}),
        lambda: rg.simulate("circle", "vehicle.yaml"),
        lambda: rg.simulate("vattern", {}),
        lambda: rg.plan("vehicle.yaml"),
        lambda: rg.Online("vehicle.yaml"),
    ):
        with pytest.raises(
            rg.InputError, match=r"config: expected a Config, as load_config gives it, found a (str|di)"
        ):
            use()
    with pytest.raises(rg.InputError, match="configuration: expected YAML text, found a dict"):
        rg.parse_config({"imu": {}})
    with pytest.raises(rg.InputError, match="choose: expected a mapping"):
        rg.convert(SHIPPED / "log.csv.gz", choose="dvl=dvl.csv")
    with pytest.raises(rg.InputError, match="shift dvl: expected seconds"):
        rg.convert(SHIPPED / "log.csv.gz", shift={"dvl": "late"})
    with pytest.raises(rg.InputError, match=r"is a DataFrame, .* use Log\.from_frame"):
        rg.read_log(short)
    with pytest.raises(rg.InputError, match="trajectory: expected a Trajectory, as read_trajectory gives it"):
        rg.evaluate("trajectory.csv", "reference.csv")
    with pytest.raises(rg.InputError, match="reference: expected a Trajectory, as read_reference gives it"):
        rg.evaluate(rg.simulate("circle", choices=rg.Choices(duration=40.0)).truth, short)


def test_what_is_no_path_is_refused_in_one_line(tmp_path, short, result):
    dive, converted = rg.simulate("circle", choices=rg.Choices(duration=40.0)), rg.convert(SHIPPED / "log.csv.gz")
    found = rg.check(rg.Log.from_frame(short))
    uses = {
        "load_config": rg.load_config,
        "read_log": rg.read_log,
        "convert": rg.convert,
        "read_trajectory": rg.read_trajectory,
        "read_reference": rg.read_reference,
        "demo": rg.demo,
        "Result.save": result.save,
        "Result.report": result.report,
        "SimulatedDive.save": dive.save,
        "Conversion.save": converted.save,
        "Trajectory.write_csv": dive.truth.write_csv,
        "export": lambda given: rg.export(given, "kml"),
        "export, out": lambda given: rg.export(result, "kml", out=given),
        "tag": lambda given: rg.tag(given, result, tmp_path / "placed.csv"),
        "report": rg.report,
        "report_check": lambda given: rg.report_check(found, given),
        "study_misalignment": lambda given: rg.study_misalignment(given, tmp_path / "study"),
        "Online.run": lambda given: rg.Online().run(given),
        "Online.run, out": lambda given: rg.Online().run("-", out=given),
    }
    for given in (None, 5, 2.5, b"log.csv", {"log": 1}, [3]):
        for name, use in uses.items():
            if given is None and name in ("load_config", "export, out", "Online.run, out"):
                continue  # where it is the default
            with pytest.raises(rg.InputError, match=r"expected (a path|an address|a results folder).*, found ") as said:
                use(given)
            assert "\n" not in str(said.value), (name, given)


# as researchers expect


def test_arrays_of_three_columns_are_those_of_their_columns(short, config):
    imu = short[short["acc_x"].notna()]
    dvl = short[short["dvl_vx"].notna()]
    depth = short[short["depth"].notna()]
    acc, gyr, v = (
        imu[[f"acc_{a}" for a in "xyz"]].to_numpy(),
        imu[[f"gyr_{a}" for a in "xyz"]].to_numpy(),
        dvl[["dvl_vx", "dvl_vy", "dvl_vz"]].to_numpy(),
    )
    named = rg.Log.from_arrays(
        time=imu["time"], acc=acc, gyr=gyr, dvl=(dvl["time"], v), depth=(depth["time"], depth["depth"]), config=config
    )
    tables = rg.Log.from_arrays(
        {"time": imu["time"], "acc": acc, "gyr": gyr}, {"time": dvl["time"], "dvl": v},
        {"time": depth["time"], "depth": depth["depth"]}, config=config,
    )  # fmt: skip
    whole = rg.Log.from_frame(short, config)
    for log in (named, tables):
        assert set(log) == {"imu", "dvl", "depth"}
        for sensor in log:
            np.testing.assert_array_equal(log[sensor].time, whole[sensor].time)
            np.testing.assert_array_equal(log[sensor].data[:, :3], whole[sensor].data[:, :3])
    assert repr(named).startswith("<Log log: imu ") and repr(named).endswith(" s>")


SECONDS = np.arange(0.0, 10.0, 0.01)
FORCE = np.tile([0.0, 0.0, -9.81], (1000, 1))


@pytest.mark.parametrize(
    ("arrays", "line"),
    [
        ({"time": SECONDS, "acc": FORCE[:, :2], "gyr": FORCE}, r"^log: acc has shape \(1000, 2\), expected \(n, 3\)"),
        ({"time": SECONDS, "acc": FORCE.T, "gyr": FORCE}, r"^log: acc has shape \(3, 1000\), expected \(n, 3\)"),
        ({"time": SECONDS, "acc": FORCE.astype(complex), "gyr": FORCE}, "^log: acc holds complex128, expected"),
        ({"time": SECONDS, "acc": FORCE.astype(str), "gyr": FORCE}, "^log: acc holds <U.*, expected numbers$"),
        ({"time": SECONDS, "acc": FORCE[:-1], "gyr": FORCE}, "^log: columns of different length"),
        ({"acc": FORCE, "gyr": FORCE}, r"^log: acc has no times: give time=\.\.\., or acc=\(times, values\)$"),
        ({"time": SECONDS, "acc": np.full((1000, 3), np.nan)}, "no measurement of any sensor in it"),
    ],
)  # fmt: skip
def test_arrays_that_do_not_fit_are_one_line(arrays, line):
    with pytest.raises(rg.InputError, match=line) as caught:
        rg.Log.from_arrays(**arrays)
    assert "\n" not in str(caught.value)


def test_a_log_becomes_a_frame_and_comes_back(short, config):
    log = rg.Log.from_frame(short, config)
    again = rg.Log.from_frame(log.to_frame())
    assert list(again) == list(log)
    for sensor in log:
        np.testing.assert_array_equal(again[sensor].time, log[sensor].time)
        np.testing.assert_array_equal(again[sensor].data, log[sensor].data)


def test_short_representations(result, config):
    assert len(repr(config)) < 300 and repr(config).startswith("<Config ")
    assert repr(rg.Config()) == "<Config rovgraph: states nothing>"
    for one in (result, result.smoothed, result.smoothed.trajectory, result.log):
        assert len(repr(one)) < 300 and "\n" not in repr(one)


def test_a_notebook_shows_verdict_map_and_alarms_and_no_markup_of_names(result):
    named = replace(result, log=replace(result.log, source="a/<b>dive</b>.csv"))
    text = named._repr_html_()
    assert f">{result.verdict}</b>" in text and "<polyline" in text and "m, north up" in text
    assert text.count("<li>") == len(result.alarms) and len(text) < 20_000
    ElementTree.fromstring(text.replace("<br>", "<br/>"))
    assert "<b>dive" not in text


@pytest.mark.parametrize("sources", [["vehicle"], ["dvl"], ["ahrs"], ["ahrs", "vehicle", "mag"]])
def test_a_simulated_dive_has_the_compasses_of_its_configuration(sources):
    config = rg.Config().changed(heading={"sources": sources})
    dive = rg.simulate("lawnmower", config, seed=2, choices=rg.Choices(duration=40))
    result = rg.smooth(dive.log, dive.config, estimate="smoothed")
    streams = {"vehicle": "vehicle_heading", "dvl": "dvl_heading"}
    assert {streams.get(name, name) for name in sources} <= set(result.smoothed.residuals["sensor"])
    true, found = dive.calibration, result.calibration
    assert set(found) <= set(true)


def test_noise_free_data_are_smoothed():
    dive = rg.simulate("lawnmower", seed=2, choices=rg.Choices(duration=40, noise=False))
    result = rg.smooth(dive.log, dive.config, estimate="smoothed")
    assert abs(result.smoothed.trajectory.at(dive.truth.time[-1]).p_n - dive.truth.p_n[-1]).max() < 0.05


def test_a_steady_motion_without_noise_is_smoothed_with_a_warning_and_a_dead_gyro_is_refused():
    ping, rate = SECONDS[::20], np.tile([0.0, 0.0, 0.05], (1000, 1))
    force = np.tile([0.0, 0.5 * 0.05, -9.80665], (1000, 1))
    velocity = np.tile([0.5, 0.0, 0.0], (50, 1))
    others = {"depth": (ping, np.full(50, 5.0)), "heading": (ping, 0.05 * ping)}
    log = rg.Log.from_arrays(time=SECONDS, acc=force, gyr=rate, dvl=(ping, velocity), **others)
    with pytest.warns(rg.DataWarning, match="IMU and DVL never change, as simulated without noise"):
        result = rg.smooth(log, estimate="smoothed")
    circle = 10.0 * np.array([np.sin(0.05 * ping[-1]), 1.0 - np.cos(0.05 * ping[-1])])
    assert np.abs(result.smoothed.trajectory.p_n[-1, :2] - circle).max() < 0.1  # the compass may be off
    noise = np.random.default_rng(1).normal(0.0, 0.01, (50, 3))
    alive = rg.Log.from_arrays(time=SECONDS, acc=force, gyr=rate, dvl=(ping, velocity + noise), **others)
    with pytest.raises(rg.InputError, match="the gyro's values never change; check its connection"):
        rg.smooth(alive)
