"""``rovgraph smooth`` from the command line, on good and on hostile input."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from dives import falcon, simulated

import rovgraph as rg
from rovgraph.cli.app import main

SHIPPED = Path(__file__).parents[1] / "data" / "falcon"
REAL = Path(__file__).parents[2] / "shared" / "data" / "ictineu"
FAST = ["--no-figures", "--estimate", "smoothed"]


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """Run the console script, give its exit code."""
    monkeypatch.setattr(sys, "argv", ["rovgraph", *map(str, arguments)])
    try:
        main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    """What stands on standard error, which must be one line and no traceback."""
    text = capsys.readouterr().err.strip()
    lines = [line for line in text.splitlines() if not line.startswith("warning:")]
    assert len(lines) == 1, text
    assert "Traceback" not in text
    assert lines[0].startswith("error: ")
    return lines[0]


@pytest.fixture(scope="session")
def short() -> pd.DataFrame:
    """The first 60 s of the dive that ships."""
    frame = pd.read_csv(SHIPPED / "log.csv.gz")
    return frame[frame["time"] <= frame["time"].iloc[0] + 60.0]


@pytest.fixture
def config() -> Path:
    return SHIPPED / "config.yaml"


def save(frame: pd.DataFrame, path: Path) -> Path:
    frame.to_csv(path, index=False)
    return path


def rms(out: Path, which: str = "smoothed") -> float:
    """Horizontal rms error against the shipped truth [m]."""
    from rovgraph.inference.trajectory import read_trajectory
    from rovgraph.lab.evaluate import evaluate, read_reference

    return evaluate(read_trajectory(out / f"trajectory_{which}.csv"), read_reference(SHIPPED / "truth.csv.gz")).rms_m


@pytest.fixture(scope="session")
def shipped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of the shipped dive, all of them."""
    out = tmp_path_factory.mktemp("shipped") / "out"
    arguments = ["rovgraph", "smooth", str(SHIPPED / "log.csv.gz"), "--config", str(SHIPPED / "config.yaml")]
    before, sys.argv = sys.argv, [*arguments, "--out", str(out)]
    try:
        main()
    except SystemExit as end:
        assert not end.code
    finally:
        sys.argv = before
    return out


def test_force_does_not_replace_a_folder_that_holds_the_log_or_the_configuration(tmp_path, monkeypatch, capsys):
    dive = rg.simulate("circle", rg.Config(), 1, rg.Choices(duration=40.0))
    dive.save(tmp_path / "dive")
    (tmp_path / "log.csv").write_bytes((tmp_path / "dive" / "log.csv").read_bytes())
    before = sorted((tmp_path / "dive").iterdir())
    for log in ("dive/log.csv", "log.csv"):
        given = ["--config", tmp_path / "dive" / "config.yaml", "--out", tmp_path / "dive", "--force"]
        assert run(monkeypatch, "smooth", tmp_path / log, *given) == 2
        assert "which would be replaced; choose another --out" in one_line(capsys)
    result = rg.smooth(rg.read_log(tmp_path / "dive" / "log.csv", rg.Config()), rg.Config(), "smoothed")
    with pytest.raises(rg.InputError, match="which would be replaced"):
        result.save(tmp_path / "dive", force=True)
    assert sorted((tmp_path / "dive").iterdir()) == before


def test_the_results_folder_holds_everything_that_is_promised(shipped):
    names = {p.name for p in shipped.iterdir()}
    tables = {"trajectory_smoothed.csv", "trajectory_filtered.csv", "trajectory_smoothed.ned.tum"}
    tables |= {"trajectory_filtered.ned.tum", "calibration.csv", "residuals.csv", "summary.json", "config.yaml"}
    assert (
        tables | {"track.png", "velocity.png", "attitude.png", "depth.png", "residuals.png", "calibration.png"} <= names
    )
    json.loads((shipped / "summary.json").read_text())


def test_smoothed_beats_filtered_beats_dead_reckoning_on_the_shipped_dive(shipped):
    smoothed, filtered, reckoned = (rms(shipped, w) for w in ("smoothed", "filtered", "dead_reckoning"))
    assert smoothed < filtered < reckoned


def test_the_shipped_dives_hidden_misalignment_lies_within_three_sd(shipped):
    table = pd.read_csv(shipped / "calibration.csv")
    row = table[(table["label"] == "dvl_yaw") & (table["estimate"] == "smoothed")].iloc[0]
    hidden = json.loads((SHIPPED / "truth.json").read_text())
    true_deg = float(np.rad2deg(hidden["calibration"]["dvl_yaw"][0]))
    assert abs(row["value"] - true_deg) < 3.0 * row["sd"]
    assert row["sd"] < 0.2 * row["prior_sd"]


def test_the_effective_configuration_gives_the_same_result_again(shipped, tmp_path, monkeypatch, short):
    log = save(short, tmp_path / "log.csv")
    for name in ("a", "b"):
        source = SHIPPED / "config.yaml" if name == "a" else tmp_path / "a" / "config.yaml"
        assert run(monkeypatch, "smooth", log, "-c", source, "-o", tmp_path / name, *FAST) == 0
    a, b = (pd.read_csv(tmp_path / n / "trajectory_smoothed.csv") for n in ("a", "b"))
    np.testing.assert_allclose(a[["north", "east", "yaw"]], b[["north", "east", "yaw"]], atol=0.03)


def test_a_log_without_configuration_is_smoothed_and_says_what_it_assumed(tmp_path, monkeypatch, capsys, short):
    columns = [c for c in short if not c.startswith("mag_")]
    log = save(short[columns], tmp_path / "log.csv")
    assert run(monkeypatch, "smooth", log, "-o", tmp_path / "out", *FAST) == 0
    said = capsys.readouterr().out
    assert "error of the heading, which rests on dvl_compass_offset" in said and "more (--verbose lists them)" in said
    assert 2 <= said.count("assumed: ") <= 4
    assert run(monkeypatch, "smooth", log, "-o", tmp_path / "all", "--verbose", *FAST) == 0
    said = capsys.readouterr().out
    assert "assumed: heading from dvl_heading" in said and "(--verbose" not in said


@pytest.mark.parametrize("which", ["smoothed", "filtered"])
def test_only_the_estimate_asked_for_is_written(tmp_path, monkeypatch, short, config, which):
    log = save(short, tmp_path / "log.csv")
    assert run(monkeypatch, "smooth", log, "-c", config, "-o", tmp_path / "o", "--no-figures", "--estimate", which) == 0
    written = {p.name for p in (tmp_path / "o").glob("trajectory_*.csv")}
    assert written == {f"trajectory_{which}.csv", "trajectory_dead_reckoning.csv"}


def test_a_configuration_beside_the_log_that_is_not_given_is_pointed_out(monkeypatch, capsys, tmp_path, short):
    shutil.copy(SHIPPED / "config.yaml", tmp_path / "config.yaml")
    log = save(short, tmp_path / "log.csv")
    assert run(monkeypatch, "smooth", log, "-o", tmp_path / "out", *FAST) == 0
    assert "config.yaml lies beside the log and is not used" in capsys.readouterr().err
    assert run(monkeypatch, "smooth", log, "-c", tmp_path / "config.yaml", "-o", tmp_path / "again", *FAST) == 0
    assert "beside the log" not in capsys.readouterr().err


def test_a_missing_file_is_one_line(monkeypatch, capsys, tmp_path):
    assert run(monkeypatch, "smooth", tmp_path / "none.csv", "-o", tmp_path / "out") == 2
    assert "none.csv" in one_line(capsys)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("content", [b"", b"\x00\x01\x02\xff\xfe" * 400, b"time,acc_x\n", b"a,b\n1,2\n3,4\n"])
def test_no_csv_empty_or_without_time_is_one_line(monkeypatch, capsys, tmp_path, content):
    (tmp_path / "log.csv").write_bytes(content)
    assert run(monkeypatch, "smooth", tmp_path / "log.csv", "-o", tmp_path / "out") == 2
    assert "log.csv" in one_line(capsys)


@pytest.mark.parametrize(
    ("drop", "says"),
    [(("acc", "gyr"), "IMU"), (("dvl_v",), "DVL"), (("mag", "dvl_heading"), "start.heading_deg")],
)
def test_without_imu_dvl_or_heading_it_says_what_to_give(monkeypatch, capsys, tmp_path, short, drop, says):
    kept = [c for c in short if not c.startswith(drop)]
    log = save(short[kept], tmp_path / "log.csv")
    assert run(monkeypatch, "smooth", log, "-o", tmp_path / "out") == 2
    assert says.lower() in one_line(capsys).lower()


def test_time_far_backwards_is_one_line_that_names_the_row(monkeypatch, capsys, tmp_path, short):
    frame = short.copy()
    frame.iloc[3000:, 0] -= 20.0
    assert run(monkeypatch, "smooth", save(frame, tmp_path / "log.csv"), "-o", tmp_path / "out") == 2
    assert "3002" in one_line(capsys)


def test_duplicated_rows_warn_and_change_nothing(monkeypatch, capsys, tmp_path, short, config):
    twice = pd.concat([short, short.iloc[2000:2500]]).sort_values("time", kind="stable")
    logs = save(short, tmp_path / "a.csv"), save(twice, tmp_path / "b.csv")
    for log in logs:
        assert run(monkeypatch, "smooth", log, "-c", config, "-o", tmp_path / log.stem, *FAST) == 0
    assert "duplicate" in capsys.readouterr().err
    a, b = (pd.read_csv(tmp_path / n / "trajectory_smoothed.csv") for n in ("a", "b"))
    np.testing.assert_allclose(a["north"], b["north"], atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("column", ["acc_x", "gyr_z", "mag_y", "dvl_vx", "dvl_heading", "depth"])
def test_nan_and_inf_in_any_column_warn_and_the_track_stays(monkeypatch, capsys, tmp_path, short, config, column):
    frame = short.copy()
    rows = frame.index[frame[column].notna()]
    frame.loc[rows[100:110], column] = np.inf
    frame.loc[rows[150:155], column] = np.nan
    log = save(frame, tmp_path / "log.csv")
    assert run(monkeypatch, "smooth", log, "-c", config, "-o", tmp_path / "out", *FAST) == 0
    assert "warning:" in capsys.readouterr().err
    assert rms(tmp_path / "out") < 0.15


def test_a_dvl_frozen_at_zero_for_a_minute_warns_and_is_left_out(monkeypatch, capsys, tmp_path, config):
    frame = pd.read_csv(SHIPPED / "log.csv.gz")
    since = frame["time"] - frame["time"].iloc[0]
    frozen = frame["dvl_vx"].notna() & since.between(100.0, 160.0)
    frame.loc[frozen, ["dvl_vx", "dvl_vy", "dvl_vz"]] = 0.0
    log = save(frame[since < 220.0], tmp_path / "log.csv")
    assert run(monkeypatch, "smooth", log, "-c", config, "-o", tmp_path / "out", *FAST) == 0
    assert "exactly zero" in capsys.readouterr().err
    out = pd.read_csv(tmp_path / "out" / "trajectory_smoothed.csv")
    truth = pd.read_csv(SHIPPED / "truth.csv.gz")
    error = np.hypot(*(out[c] - np.interp(out["time"], truth["time"], truth[c]) for c in ("north", "east")))
    sd = np.hypot(out["north_sd"], out["east_sd"])
    assert error.max() < 5.0  # believing the zeros for a minute at 0.3 m/s would cost 18 m
    assert (error < 4.0 * sd).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_twenty_percent_gross_outliers_cost_less_than_half_as_much_again(monkeypatch, tmp_path, config, seed):
    clean = pd.read_csv(SHIPPED / "log.csv.gz", nrows=25_000)
    rng, frame = np.random.default_rng(seed), clean.copy()
    pings = frame.index[frame["dvl_vx"].notna()]
    bad = rng.choice(pings, len(pings) // 5, replace=False)
    frame.loc[bad, ["dvl_vx", "dvl_vy", "dvl_vz"]] += rng.uniform(-1.0, 1.0, (len(bad), 3))
    errors = {}
    for name, log in (("clean", clean), ("bad", frame)):
        path = save(log, tmp_path / f"{name}.csv")
        assert run(monkeypatch, "smooth", path, "-c", config, "-o", tmp_path / name, *FAST) == 0
        errors[name] = rms(tmp_path / name)
    assert errors["bad"] < 1.5 * errors["clean"]


def test_gyro_in_degrees_declared_as_radians_is_one_line(monkeypatch, capsys, tmp_path, short):
    frame = short.copy()
    frame[["gyr_x", "gyr_y", "gyr_z"]] = np.rad2deg(frame[["gyr_x", "gyr_y", "gyr_z"]])
    assert run(monkeypatch, "smooth", save(frame, tmp_path / "log.csv"), "-o", tmp_path / "out") == 2
    assert "deg" in one_line(capsys)


@pytest.mark.parametrize(
    ("text", "near"),
    [
        ("dvll: {}", "dvl"),
        ("dvl: {velocty_sd_mps: [1, 1, 1]}", "dvl.velocity_sd_mps"),
        ("imu: {noise: {gyro: 1}}", "imu.noise.gyr"),
        ("calibration: {dvl_yaw: {estmate: true}}", "calibration.dvl_yaw.estimate"),
    ],
)
def test_a_misspelled_key_at_any_depth_names_the_nearest(monkeypatch, capsys, tmp_path, short, text, near):
    (tmp_path / "c.yaml").write_text(text)
    log = save(short, tmp_path / "log.csv")
    assert run(monkeypatch, "smooth", log, "-c", tmp_path / "c.yaml", "-o", tmp_path / "out") == 2
    assert f"nearest known key is {near}" in one_line(capsys)


def test_an_older_results_folder_is_kept_unless_forced(monkeypatch, capsys, tmp_path, short, config):
    log, out = save(short, tmp_path / "log.csv"), tmp_path / "out"
    arguments = ("smooth", log, "-c", config, "-o", out, *FAST)
    assert run(monkeypatch, *arguments) == 0
    before = (out / "summary.json").read_bytes()
    capsys.readouterr()
    assert run(monkeypatch, *arguments) == 2
    assert "--force" in one_line(capsys)
    assert (out / "summary.json").read_bytes() == before
    assert run(monkeypatch, *arguments, "--force") == 0


def test_a_full_disk_leaves_nothing_and_is_one_line(monkeypatch, capsys, tmp_path, short, config):
    from rovgraph.inference.trajectory import Trajectory

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Trajectory, "write_csv", full)
    log = save(short, tmp_path / "log.csv")
    assert run(monkeypatch, "smooth", log, "-c", config, "-o", tmp_path / "out", *FAST) == 2
    assert "space" in one_line(capsys).lower()
    assert [p.name for p in tmp_path.iterdir()] == ["log.csv"]


@pytest.mark.skipif(os.name != "posix" or (shutil.which("chattr") is None and os.geteuid() == 0),
                    reason="root writes into read-only folders")  # fmt: skip
def test_a_read_only_place_is_refused_before_the_work(monkeypatch, capsys, tmp_path, short):
    log, place = save(short, tmp_path / "log.csv"), tmp_path / "locked"
    place.mkdir(mode=0o500)
    if os.access(place, os.W_OK):
        pytest.skip("this user may write into a read-only folder")
    assert run(monkeypatch, "smooth", log, "-o", place / "out") == 2
    assert "locked" in one_line(capsys)


HELD = """
import contextlib, sys, time
import rovgraph.cli.console
from rovgraph.report import results
import rovgraph as rg
from rovgraph.cli.app import main

def hold(*given):
    print("there", flush=True)
    time.sleep(120)

@contextlib.contextmanager
def progress_bar():
    yield hold

if sys.argv.pop(1) == "estimating":
    rovgraph.cli.console.progress_bar = progress_bar
else:
    results.write_results = hold
main()
"""


@pytest.mark.parametrize("stage", ["estimating", pytest.param("writing", marks=pytest.mark.slow)])
def test_ctrl_c_in_the_middle_leaves_nothing_and_exits_130(tmp_path, config, short, stage):
    """At the first sign of progress, and before the first file is written."""
    arguments = [
        stage,
        "smooth",
        str(save(short, tmp_path / "log.csv")),
        "-c",
        str(config),
        "-o",
        str(tmp_path / "out"),
    ]
    process = subprocess.Popen(
        [sys.executable, "-c", HELD, *arguments], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "there\n"
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=100)
    assert process.returncode == 130
    assert "Traceback" not in errors
    assert [path.name for path in tmp_path.iterdir()] == ["log.csv"]


@pytest.mark.slow
@pytest.mark.skipif(not REAL.exists(), reason="the Ictineu log is not beside the checkout")
def test_the_real_dive_meets_its_targets(tmp_path, monkeypatch):
    from rovgraph.inference.trajectory import read_trajectory
    from rovgraph.lab.evaluate import evaluate, read_reference

    out = tmp_path / "out"
    assert run(monkeypatch, "smooth", REAL / "log.csv.gz", "-c", REAL / "ictineu.yaml", "-o", out) == 0
    reference = read_reference(REAL / "reference.csv.gz")
    smoothed = evaluate(read_trajectory(out / "trajectory_smoothed.csv"), reference, start=600.0)
    assert smoothed.rms_m <= 5.0
    assert smoothed.inside_ellipse is not None and smoothed.inside_ellipse > 0.95
    table = pd.read_csv(out / "calibration.csv")
    yaw = table[(table["label"] == "dvl_yaw") & (table["estimate"] == "smoothed")].iloc[0]
    assert -24.0 <= yaw["value"] <= -19.5
    assert abs(yaw["value"] + 21.8) <= 2.0 * yaw["sd"]


@pytest.mark.slow
@pytest.mark.parametrize("stated", [{"delay_s": {"fix": 2}}, {"online": {"delay_s": {"fix": 2}}}])
def test_fixes_that_are_late_by_a_known_time_give_the_track_of_punctual_ones(monkeypatch, tmp_path, stated):
    case = simulated(falcon(), 45.0, seed=2, fix_interval=2.0)
    late, tracks = case.dive.log_frame.copy(), []
    late.loc[late["fix_north"].notna(), "time"] += 2.0
    for name, frame, more in (("punctual", case.dive.log_frame, {}), ("late", late, stated)):
        config = tmp_path / f"{name}.yaml"
        config.write_text(json.dumps(case.config.model_dump(mode="json") | more))  # JSON is YAML
        log = save(frame.sort_values("time", kind="stable"), tmp_path / f"{name}.csv")
        assert run(monkeypatch, "smooth", log, "-c", config, "-o", tmp_path / name, *FAST) == 0
        tracks.append(pd.read_csv(tmp_path / name / "trajectory_smoothed.csv"))
    pd.testing.assert_frame_equal(*tracks)
