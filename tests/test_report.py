"""The results folder: what is in it, and that it appears whole or not at all."""

import csv
import errno
import io
import json
import os
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

import rovgraph as rg
from rovgraph.errors import InputError
from rovgraph.geometry import matrix_from_rpy
from rovgraph.inference.estimate import RESIDUAL_COLUMNS, CalibrationEstimate, Estimate, History
from rovgraph.inference.trajectory import Trajectory, read_trajectory
from rovgraph.log import STREAMS, Log, Stream
from rovgraph.model.config import Config, load_config
from rovgraph.report.folder import check_writable, results_folder
from rovgraph.report.results import Remarks, ellipse_axes, sensor_counts, summarise, to_plain, write_results
from rovgraph.report.tables import calibration_table, fitting, summary_table
from rovgraph.report.units import plus_minus

DEG = np.deg2rad(1.0)
START = 1.6e9  # an epoch of today's clocks, where float digits begin to matter


def curved_track(duration, n):
    """A vehicle that mows a lawn: true time, position, attitude, velocity."""
    t = np.linspace(0.0, duration, n)
    heading = 1.9 * np.sin(2 * np.pi * t / 311.0) + 2 * np.pi * t / 900.0 + 0.3
    v_n = 0.4 * np.stack([np.cos(heading), np.sin(heading), 0.1 * np.sin(t / 20)], axis=-1)
    p_n = np.cumsum(v_n * np.gradient(t)[:, None], axis=0)
    rpy = np.stack([4 * DEG * np.sin(t / 3), 3 * DEG * np.cos(t / 5), heading], axis=-1)
    return t + START, p_n, rpy, v_n


def make_trajectory(truth, growth, rng):
    """The truth with errors of a covariance that grows (filter) or stays (smoother)."""
    time, p_n, rpy, v_n = truth
    t = time - time[0]
    shape = np.array([[1.0, 0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 0.02]])
    variance = 0.01 + growth * t if growth > 0.002 else 0.01 + growth * np.minimum(t, t[-1] - t + 20)
    cov_p = variance[:, None, None] * shape
    drift = np.linalg.cholesky(shape) @ rng.normal(size=3) * 0.7

    def smooth(sd):
        return sd * np.sin(t / 40 + rng.uniform(0, 6))[:, None] * rng.normal(size=3)

    return Trajectory(
        time,
        p_n + np.sqrt(variance)[:, None] * drift,
        matrix_from_rpy(rpy + smooth(0.01)),
        v_n + smooth(0.01),
        cov_p,
        np.broadcast_to(np.diag([0.006, 0.006, 0.02 + 10 * growth]) ** 2, (len(t), 3, 3)),
        np.broadcast_to(np.diag([0.01, 0.012, 0.005]) ** 2, (len(t), 3, 3)),
    )


def make_residuals(time, rng, fixes):
    """Standard normal residuals of the usual sensors, a few of them rejected."""
    frames = []
    sensors = {"dvl": "xyz", "dvl_heading": ["heading"], "ahrs": ["heading"], "depth": ["down"]}
    if fixes:
        sensors["fix"] = ["north", "east"]
    for sensor, components in sensors.items():
        when = time[::20] if sensor == "fix" else time
        outlier = rng.random(len(when)) < 0.01
        for component in components:
            z = rng.normal(size=len(when)) + outlier * rng.normal(0, 20, len(when))
            row = np.arange(len(when)) * 3 + 2
            columns = (when, sensor, component, 1.0, 1.0, 0.1 * z, 0.1, z, np.where(outlier, 0.0, 1.0), row)
            frames.append(pd.DataFrame(dict(zip(RESIDUAL_COLUMNS, columns, strict=True))))
    return pd.concat(frames, ignore_index=True)


CALIBRATION = [
    CalibrationEstimate(
        "dvl_yaw", "rad", "yaw of the DVL's mounting", True, -21.5 * DEG, 1.9 * DEG, -26 * DEG, 5 * DEG
    ),
    CalibrationEstimate("dvl_compass_deviation_sin", "rad", "deviation B", True, 2 * DEG, 0.4 * DEG, 0.0, 3 * DEG),
    CalibrationEstimate("dvl_compass_deviation_cos", "rad", "deviation C", True, -1 * DEG, 2.9 * DEG, 0.0, 3 * DEG),
    CalibrationEstimate("dvl_scale", "1", "scale error of the DVL", False, 0.0, 0.0, 0.0, 0.01),
]


def make_history(time, kind, rng):
    """Biases and calibration: settling for the filter, constant for the smoother."""
    if kind == "smoothed":
        time = time[[0, -1]]
    t = time - time[0]

    def settle(first, last, width):
        sd = np.sqrt(last**2 + (first**2 - last**2) * np.exp(-t / 120)) if kind == "filtered" else np.full(len(t), last)
        sd = np.repeat(sd[:, None], width, axis=1)
        return (
            0.8 * sd * np.sin(t / 300 + 1)[:, None] * np.linspace(1, -1, width) if kind == "filtered" else 0 * sd
        ), sd

    out = {}
    for name, unit, first, last in (("acc_bias", "m/s^2", 0.05, 0.01), ("gyr_bias", "rad/s", 0.01, 2e-4)):
        value, sd = settle(first, last, 3)
        out[name] = History(tuple(f"{name}_{a}" for a in "xyz"), unit, time, value, sd)
    value, sd = settle(5 * DEG, 1.9 * DEG, 1)
    out["dvl_yaw"] = History(("dvl_yaw",), "rad", time, value - 21.5 * DEG, sd)
    value, sd = settle(3 * DEG, 0.4 * DEG, 2)
    labels = ("dvl_compass_deviation_sin", "dvl_compass_deviation_cos")
    out["dvl_compass_deviation"] = History(labels, "rad", time, value + np.array([2.0, -1.0]) * DEG, sd)
    return out


def make_log(truth, rng, fixes):
    time, p_n, rpy, _ = truth
    streams = {}

    def add(sensor, when, data):
        columns = STREAMS[sensor]
        padded = np.full((len(when), len(columns)), np.nan)
        padded[:, : data.shape[1]] = data
        streams[sensor] = Stream(sensor, columns, when, padded, np.arange(len(when)) * 3 + 2)

    heading = rpy[:, 2] + 5 * DEG * np.sin(rpy[:, 2]) + rng.normal(0, 2 * DEG, len(time))
    add("imu", time, np.zeros((len(time), 6)))
    add("ahrs", time, ((heading + np.pi) % (2 * np.pi) - np.pi)[:, None])
    add("dvl_heading", time, ((heading - 26 * DEG) % (2 * np.pi))[:, None])
    field = np.einsum("nji,j->ni", matrix_from_rpy(rpy), [0.4, 0.0, 0.9])
    add("mag", time, field + rng.normal(0, 0.01, field.shape))
    if fixes:
        points = p_n[::20, :2] + rng.normal(0, 1.5, (len(p_n[::20]), 2))
        points[3] += 500.0
        add("fix", time[::20], points)
    return Log("dive.csv", streams)


def make_dive(duration=300.0, n=600, fixes=True, seed=3):
    rng = np.random.default_rng(seed)
    truth = curved_track(duration, n)
    estimates = []
    for kind, growth in (("filtered", 4e-3), ("smoothed", 1.5e-3)):
        track = make_trajectory(truth, growth, rng)
        residuals = make_residuals(truth[0], rng, fixes)
        summary = {"iterations": 4, "cost": np.float64(12.5), "converged": np.True_}
        estimates.append(Estimate(kind, track, CALIBRATION, make_history(truth[0], kind, rng), residuals, summary))
    config = Config.model_validate({"name": "test", "dvl": {"mount_rpy_deg": [180, 0, -26]}})
    reference = Trajectory.certain(truth[0], truth[1], matrix_from_rpy(truth[2]), truth[3])
    return estimates, make_log(truth, rng, fixes), config, reference


@pytest.fixture(scope="module")
def dive():
    return make_dive()


@pytest.fixture(scope="module")
def written(dive, tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    estimates, log, config, _ = dive
    summary = write_results(folder, estimates, log, config, {"smooth": 1.5}, Remarks(["heading from the AHRS"]))
    return folder, summary


# ---- the folder -----------------------------------------------------------------------


def ours(folder, content="old"):
    """A results folder as an earlier run left it."""
    folder.mkdir(parents=True)
    (folder / "summary.json").write_text(json.dumps({"program": "rovgraph"}))
    (folder / "old.txt").write_text(content)
    return folder


def test_folder_appears_when_complete(tmp_path):
    out = tmp_path / "deep" / "er" / "out"
    with results_folder(out) as folder:
        assert folder.is_dir() and not out.exists()
        (folder / "a.txt").write_text("a")
    assert [p.name for p in out.iterdir()] == ["a.txt"]
    assert [p.name for p in out.parent.iterdir()] == ["out"]


def test_folder_has_ordinary_permissions(tmp_path):
    (tmp_path / "plain").mkdir()
    with results_folder(tmp_path / "out"):
        pass
    assert (tmp_path / "out").stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_an_exception_leaves_nothing(tmp_path, error):
    with pytest.raises(error), results_folder(tmp_path / "deep" / "out") as folder:
        (folder / "half.csv").write_text("half")
        raise error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_exception_keeps_the_old_results(tmp_path, error):
    out = ours(tmp_path / "out")
    with pytest.raises(error), results_folder(out, force=True) as folder:
        (folder / "half.csv").write_text("half")
        raise error
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
    assert (out / "old.txt").read_text() == "old"


def test_a_failed_rename_keeps_the_old_results(tmp_path, monkeypatch):
    out, rename = ours(tmp_path / "out"), Path.rename

    def fail(self, target):
        if self.suffix == ".partial":
            raise OSError(errno.EIO, "Input/output error", str(self))
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fail)
    with pytest.raises(InputError, match="Input/output error"), results_folder(out, force=True):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
    assert (out / "old.txt").read_text() == "old"


def test_full_disk_is_one_line_and_leaves_nothing(dive, tmp_path, monkeypatch):
    estimates, log, config, _ = dive

    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(pd.DataFrame, "to_csv", full)
    with pytest.raises(InputError) as caught, results_folder(tmp_path / "out") as folder:
        write_results(folder, estimates, log, config, {}, Remarks())
    message = str(caught.value)
    assert "No space left on device" in message and "out" in message and "\n" not in message
    assert list(tmp_path.iterdir()) == []


def test_errors_about_other_files_pass(tmp_path):
    with pytest.raises(FileNotFoundError), results_folder(tmp_path / "out"):
        (tmp_path / "no such log.csv").read_text()
    assert list(tmp_path.iterdir()) == []


def test_existing_results_need_force(tmp_path):
    out = ours(tmp_path / "out")
    with pytest.raises(InputError, match=r"exists; choose another --out or give --force"):
        check_writable(out, force=False)
    check_writable(out, force=True)
    with results_folder(out, force=True) as folder:
        (folder / "new.txt").write_text("new")
        assert (out / "old.txt").exists()
    assert [p.name for p in out.iterdir()] == ["new.txt"]
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("summary", [None, "{}", "[1]", "no json", '{"program": "other"}'])
def test_force_spares_what_is_not_ours(tmp_path, summary):
    home = tmp_path / "home"
    home.mkdir()
    (home / "thesis.tex").write_text("years of work")
    if summary is not None:
        (home / "summary.json").write_text(summary)
    with pytest.raises(InputError, match="not a results folder"), results_folder(home, force=True):
        pytest.fail("work was begun")
    assert (home / "thesis.tex").exists()


def test_results_that_appear_during_the_work_are_spared(tmp_path):
    out = tmp_path / "out"
    with pytest.raises(InputError, match="--force"), results_folder(out):
        ours(out)
    assert (out / "old.txt").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_an_empty_folder_is_used(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    with results_folder(out) as folder:
        (folder / "a.txt").write_text("a")
    assert (out / "a.txt").exists()


def test_a_link_to_a_folder_stays_a_link(tmp_path):
    real, link = ours(tmp_path / "real"), tmp_path / "link"
    link.symlink_to(real)
    with results_folder(link, force=True) as folder:
        (folder / "new.txt").write_text("new")
    assert link.is_symlink() and (real / "new.txt").exists() and not (real / "old.txt").exists()


@pytest.mark.parametrize("place", ["file", "file/out", "x" * 300])
def test_impossible_places_are_one_line(tmp_path, place):
    (tmp_path / "file").write_text("a file")
    with pytest.raises(InputError) as caught:
        check_writable(tmp_path / place, force=True)
    assert "\n" not in str(caught.value) and "--out" in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_read_only_parent_is_one_line(tmp_path, monkeypatch):
    def refuse(self, *_, **__):
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    monkeypatch.setattr(Path, "mkdir", refuse)  # an administrator may write anywhere
    with pytest.raises(InputError, match=r"cannot be written \(Permission denied\)"):
        check_writable(tmp_path / "out", force=False)


# ---- the files ------------------------------------------------------------------------


def test_every_file_is_written(written):
    folder, _ = written
    names = {p.name for p in folder.iterdir()}
    tracks = {f"trajectory_{kind}.{ending}" for kind in ("smoothed", "filtered") for ending in ("csv", "ned.tum")}
    tables = {"calibration.csv", "residuals.csv", "history.csv", "left_out.csv"}
    assert names == tracks | tables | {"config.yaml", "summary.json"}


def test_trajectory_comes_back(written, dive):
    back = read_trajectory(written[0] / "trajectory_smoothed.csv")
    track = next(e for e in dive[0] if e.kind == "smoothed").trajectory
    np.testing.assert_allclose(back.time, track.time, atol=1e-4)
    np.testing.assert_allclose(back.p_n, track.p_n, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(back.cov_p[:, :2, :2], track.cov_p[:, :2, :2], rtol=1e-5)


def test_calibration_rows(written):
    frame = pd.read_csv(written[0] / "calibration.csv")
    assert list(frame["estimate"].unique()) == ["smoothed", "filtered"]
    yaw = frame[(frame["label"] == "dvl_yaw") & (frame["estimate"] == "smoothed")].iloc[0]
    assert yaw["unit"] == "deg"
    numbers = yaw[["value", "sd", "prior_mean", "prior_sd", "moved", "moved_in_prior_sd", "narrowing"]]
    np.testing.assert_allclose(numbers.to_numpy(float), [-21.5, 1.9, -26.0, 5.0, 4.5, 0.9, 0.38], rtol=1e-6)
    held = frame[frame["label"] == "dvl_scale"].iloc[0]
    assert not held["estimated"] and np.isnan(held["narrowing"])


def test_residual_rows(written, dive):
    frame = pd.read_csv(written[0] / "residuals.csv")
    smoothed = next(e for e in dive[0] if e.kind == "smoothed")
    assert list(frame.columns) == RESIDUAL_COLUMNS
    np.testing.assert_allclose(frame["time"], smoothed.residuals["time"], atol=1e-4)
    np.testing.assert_allclose(frame["normalised"], smoothed.residuals["normalised"], rtol=1e-6)


def test_history_rows(written, dive):
    frame = pd.read_csv(written[0] / "history.csv")
    assert list(frame.columns) == ["estimate", "time", "variable", "value", "sd", "unit"]
    filtered = next(e for e in dive[0] if e.kind == "filtered")
    yaw = frame[(frame["estimate"] == "filtered") & (frame["variable"] == "dvl_yaw")]
    np.testing.assert_allclose(yaw["value"], filtered.history["dvl_yaw"].value[:, 0], rtol=1e-6)
    assert set(yaw["unit"]) == {"rad"}


def test_configuration_comes_back(written, dive):
    assert load_config(written[0] / "config.yaml") == dive[2]


def test_summary_is_json_with_units(written):
    folder, returned = written
    summary = json.loads((folder / "summary.json").read_text(), parse_constant=pytest.fail)
    assert summary == returned
    assert summary["program"] == "rovgraph" and summary["main_estimate"] == "smoothed"
    assert summary["duration_s"] == pytest.approx(300.0)
    assert summary["calibration"]["dvl_yaw"]["value_deg"] == pytest.approx(-21.5)
    assert summary["estimates"]["smoothed"]["converged"] is True
    imu = summary["sensors"]["imu"]
    assert imu["recorded"] == 600 and imu["rate_hz"] == pytest.approx(599 / 300.0, rel=1e-3)
    assert summary["assumptions"] == ["heading from the AHRS"] and summary["seconds"] == {"smooth": 1.5}


def test_summary_of_unknown_numbers_is_null(dive):
    estimates, log, config, reference = dive
    bare = Estimate("dead_reckoning", reference, [], {}, estimates[0].residuals.iloc[:0], {"rms_m": np.nan})
    summary = summarise([bare], log, config, [], {})
    json.dumps(summary, allow_nan=False)
    assert summary["estimates"]["dead_reckoning"]["rms_m"] is None
    assert summary["end"]["north_sd_m"] is None and summary["end"]["ellipse99_major_m"] is None


def test_plain_values():
    plain = to_plain({"a": np.array([1.0, np.inf]), 2: (np.int64(3), np.bool_(False)), "p": Path("x"), "n": None})
    assert plain == {"a": [1.0, None], "2": [3, False], "p": "x", "n": None}
    with pytest.raises(TypeError, match="object"):
        to_plain(object())


def test_sensor_counts_count_measurements_not_components():
    rows = [
        (0.0, "dvl", c, 0, 0, 0, 1, z, w, r)
        for r, w, z in ((2, 1.0, 1.0), (3, 0.5, 2.0), (4, 0.0, 50.0))
        for c in "xyz"
    ]
    counts = sensor_counts(pd.DataFrame(rows, columns=RESIDUAL_COLUMNS))
    assert counts == {"dvl": {"used": 2, "weighted_down": 1, "rejected": 1, "mean_square_normalised": 2.5}}


def test_summary_and_trajectories_have_a_place_on_earth_where_the_log_has(dive, written, tmp_path):
    estimates, log, config, _ = dive
    summary = write_results(tmp_path, estimates, replace(log, origin=(58.3, 14.5)), config, {}, Remarks())
    assert summary["origin"] == {"lat_deg": 58.3, "lon_deg": 14.5} and written[1]["origin"] is None
    header = (tmp_path / "trajectory_smoothed.csv").read_text().partition("\n")[0]
    assert header.endswith(",cov_north_east,unix_time,lat,lon")  # the dive counts from 1970
    assert "lat" not in (written[0] / "trajectory_smoothed.csv").read_text().partition("\n")[0]


def test_the_longest_calibration_fits_into_80_columns(dive):
    entries = [
        CalibrationEstimate(label, unit, "", True, -0.02433, 0.00011, 0.0, 0.02, verdict)
        for label, unit in (("dvl_compass_deviation_cos", "rad"), ("current_north", "m/s"))
        for verdict in ("observable", "unobservable")
    ]
    console = Console(width=80, record=True, file=open(os.devnull, "w"))  # noqa: SIM115, PTH123
    console.print(calibration_table([replace(dive[0][0], calibration=entries)]))
    text = console.export_text()
    assert "…" not in text and "dvl_compass_deviation_cos °" in text and "unobservable" in text
    assert all(len(line) <= 80 for line in text.splitlines())


def test_tables_say_value_spread_and_prior(written, dive):
    console = Console(width=100, record=True, file=open(os.devnull, "w"))  # noqa: SIM115, PTH123
    console.print(summary_table(dive[0], written[1]))
    console.print(calibration_table(dive[0]))
    text = console.export_text()
    assert "5 min 00 s" in text and "dvl_yaw °" in text
    for part in ("-21.5 ± 1.9", "-26.0 ± 5.0", "38 %", "97 %", "held"):
        assert part in text


def test_constants_held_at_0_are_counted_and_named_where_that_is_asked_for(dive):
    entries = [
        CalibrationEstimate(name, "1", "", False, 0.0, 0.0, 0.0, 0.0, "") for name in ("acc_scale_x", "dvl_scale")
    ]
    console = Console(width=100, record=True, file=open(os.devnull, "w"))  # noqa: SIM115, PTH123
    estimates = [replace(dive[0][0], calibration=[*dive[0][0].calibration, *entries])]
    console.print(calibration_table(estimates))
    text = console.export_text()
    assert "constants are held at 0 (--verbose lists them)" in text and "acc_scale_x" not in text
    console.print(calibration_table(estimates, verbose=True))
    assert "acc_scale_x, dvl_scale" in " ".join(console.export_text().split())


def test_the_assumptions_that_could_move_the_track_come_first_and_are_three():
    from rovgraph.report.assumptions import leading

    lines = [
        "heading from ahrs",
        "left out 3 of dvl: no bottom lock",
        "nothing shows a constant error of the depth, which rests on depth_offset, sd 0.2 m",
        "no fix shows a constant error of the DVL's scale, which rests on dvl_scale, sd 0.02",
        "nothing checks the compass, and no calibration of it is stated: x",
    ]
    first, others = leading(lines)
    assert first == [lines[4], lines[3], lines[2]]
    assert others == [lines[0], lines[1]]
    assert leading([]) == ([], [])


def test_the_words_by_which_assumptions_are_ranked_are_those_that_estimates_write():
    from rovgraph.report.assumptions import MATTERING

    package = Path(rg.__file__).parent
    source = "".join(
        path.read_text(encoding="utf-8") for path in (*package.glob("inference/*.py"), *package.glob("problem/*.py"))
    )
    assert [words for words in MATTERING if words not in source] == []


@pytest.mark.parametrize(
    ("value", "sd", "text"),
    [
        (-21.5312, 1.912, "-21.5 ± 1.9 m"),
        (637.2, 0.0951, "637.200 ± 0.095 m"),
        (3.0, 0.0996, "3.00 ± 0.10 m"),
        (1234.5, 56.0, "1234 ± 56 m"),
        (1.0, float("nan"), "1 m"),
        (float("nan"), 1.0, "unknown"),
    ],
)
def test_plus_minus_has_two_digits_of_the_spread(value, sd, text):
    assert plus_minus(value, sd, "m") == text


# ---- the figures ----------------------------------------------------------------------


def test_ellipse_axes_are_those_of_the_covariance():
    bearing, sds = 0.4, np.array([3.0, 1.0])
    along = np.array([np.cos(bearing), np.sin(bearing)])  # north, east
    across = np.array([-along[1], along[0]])
    covariance = sds[0] ** 2 * np.outer(along, along) + sds[1] ** 2 * np.outer(across, across)
    major, minor, found = ellipse_axes(covariance[None])
    np.testing.assert_allclose([major[0], minor[0]], sds * np.sqrt(9.21))
    assert np.tan(found[0]) == pytest.approx(np.tan(bearing))


def test_ellipse_holds_99_percent():
    covariance = np.array([[2.0, 0.9], [0.9, 0.7]])
    points = np.random.default_rng(1).multivariate_normal([0, 0], covariance, 200_000)
    (major,), (minor,), (bearing,) = ellipse_axes(covariance[None])
    along = points @ [np.cos(bearing), np.sin(bearing)]
    across = points @ [-np.sin(bearing), np.cos(bearing)]
    inside = np.mean((along / major) ** 2 + (across / minor) ** 2 <= 1.0)
    assert inside == pytest.approx(0.99, abs=1e-3)


def test_drawn_ellipse_lies_along_the_covariance(dive):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import EllipseCollection

    from rovgraph.report.figures import draw_track
    from rovgraph.report.style import style

    estimates, log, config, _ = dive
    with style():
        figure = draw_track([estimates[1]], log, config)
        FigureCanvasAgg(figure).draw()
    drawn = next(c for c in figure.axes[0].collections if isinstance(c, EllipseCollection))
    outline = drawn.get_paths()[0].to_polygons()[0]
    covariance = estimates[1].trajectory.cov_p[-1, :2, :2][::-1, ::-1]  # east first
    east_north = outline @ drawn.get_transforms()[-1][:2, :2].T
    squares = np.einsum("ni,ij,nj->n", east_north, np.linalg.inv(covariance), east_north)
    assert squares.min() == pytest.approx(9.21) and squares.max() < 9.21 * 1.06  # corners of a polygon around it
    aspect = figure.axes[0].transData.transform([[0, 0], [1, 1]])
    assert np.ptp(aspect[:, 0]) == pytest.approx(np.ptp(aspect[:, 1]))


def png_size(path):
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")


FIGURES = ["track.png", "velocity.png", "attitude.png", "depth.png", "residuals.png", "calibration.png"]


@pytest.mark.slow
def test_figures_exist_with_sane_sizes(dive, tmp_path):
    from rovgraph.report.figures import draw_figures

    estimates, log, config, reference = dive
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        paths = draw_figures(tmp_path, estimates, log, config, reference)
    assert [p.name for p in paths] == FIGURES
    for path in paths:
        width, height = png_size(path)
        assert width == 1080 and 500 < height < 2500


@pytest.mark.slow
@pytest.mark.parametrize(("form", "begin"), [("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_figures_as_vectors_are_equal_files_in_each_run(form, begin, dive, tmp_path):
    from rovgraph.report.figures import draw_figures

    estimates, log, config, _ = dive
    drawn = []
    for name in ("once", "again"):
        (tmp_path / name).mkdir()
        drawn.append(draw_figures(tmp_path / name, estimates[:1], log, config, form=form))
    assert {path.suffix for path in drawn[0]} == {f".{form}"} and len(drawn[0]) >= 5
    for one, other in zip(*drawn, strict=True):
        assert one.read_bytes().startswith(begin) and one.read_bytes() == other.read_bytes()


def test_figures_of_bare_estimates(dive, tmp_path):
    """No fixes, no compass, no uncertainty, no history, no residuals, no motion."""
    from rovgraph.report.figures import draw_figures

    estimates, log, config, reference = dive
    still = Trajectory.certain(reference.time, 0 * reference.p_n, reference.R_nb, 0 * reference.v_n)
    bare = Estimate("dead_reckoning", still, [], {}, estimates[0].residuals.iloc[:0])
    only_imu = Log("bare.csv", {"imu": log["imu"]})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        paths = draw_figures(tmp_path, [bare], only_imu, config)
    assert [p.name for p in paths] == ["track.png", "velocity.png", "attitude.png", "depth.png"]


def test_a_poorly_known_start_does_not_flatten_the_axes_of_velocity(dive):
    from rovgraph.report.figures import draw_velocity

    track = dive[0][1].trajectory
    cov_v = track.cov_v.copy()
    cov_v[:3] = 100.0 * np.eye(3)
    figure = draw_velocity([replace(dive[0][1], trajectory=replace(track, cov_v=cov_v))])
    sd = np.sqrt(np.diagonal(cov_v[3:], axis1=1, axis2=2)).max(axis=0)
    for i in range(3):
        low, high = figure.axes[i].get_ylim()
        assert low <= track.v_n[:, i].min() and high >= track.v_n[:, i].max()
        assert high - low < 1.2 * (np.ptp(track.v_n[:, i]) + 4.0 * sd[i])


def test_depth_grows_downwards_and_the_bottom_lies_below_it_by_the_altitude(dive):
    from rovgraph.report.figures import draw_depth

    estimates, log, config, _ = dive
    time = log["imu"].time[::5]
    columns, three = ("dvl_altitude",), np.full((len(time), 1), 3.0)
    stream = Stream("dvl_altitude", columns, time, three, np.arange(len(time)))
    sounded = replace(log, streams={**log.streams, "dvl_altitude": stream})
    upper, lower = draw_depth(estimates, sounded, config).axes
    below = next(line for line in upper.lines if line.get_label() == "bottom").get_ydata()
    altitude = lower.lines[0].get_ydata()
    known = np.isfinite(altitude)  # positions of this track jump, which makes spikes
    drawn = estimates[0].trajectory.at(lower.lines[0].get_xdata() + estimates[0].trajectory.time[0])
    assert known.sum() > 20
    np.testing.assert_allclose(below[known], (drawn.p_n[:, 2] + altitude)[known])
    assert upper.get_ylim()[0] > below[known].max() and upper.yaxis_inverted()
    arm = config.dvl.lever_arm_m[2]  # the DVL is that much below the body's origin
    np.testing.assert_allclose(altitude[known], 3.0 + arm, atol=0.05)
    assert len(draw_depth(estimates, log, config).axes) == 1


@pytest.mark.slow
def test_figures_leave_matplotlib_as_it_was(dive, tmp_path):
    import matplotlib

    from rovgraph.report.figures import draw_figures

    before = dict(matplotlib.rcParams)
    draw_figures(tmp_path, dive[0][:1], *dive[1:3])
    assert dict(matplotlib.rcParams) == before


def test_wrapped_heading_is_broken():
    from rovgraph.report.motion import unwrapped

    time, angle, sd = unwrapped(np.arange(4.0), np.array([350.0, 359.0, 2.0, 5.0]), np.ones(4))
    np.testing.assert_array_equal(angle, [350, 359, np.nan, 2, 5])
    assert len(time) == len(sd) == 5 and np.isnan(time[2])


def test_thinning_keeps_both_ends():
    from rovgraph.report.style import thin

    some = thin(123_457)
    assert len(some) == 5000 and some[0] == 0 and some[-1] == 123_456
    np.testing.assert_array_equal(thin(3), [0, 1, 2])


def test_compass_headings_are_brought_to_the_body(dive):
    """Mountings and declination are taken off; what remains is the compass's own error."""
    from rovgraph.report.figures import heading_samples

    _, log, config, reference = dive
    samples = heading_samples(reference, log, config)
    assert set(samples) == {"ahrs", "dvl_heading", "mag"}
    for time, heading in samples.values():
        error = heading - reference.at(time).rpy[:, 2]
        assert np.abs(np.rad2deg((error + np.pi) % (2 * np.pi) - np.pi)).max() < 15.0


def test_residual_file_reads_as_plain_csv(written):
    with (written[0] / "residuals.csv").open(newline="") as file:
        assert next(csv.reader(file)) == RESIDUAL_COLUMNS


def wide_table() -> Table:
    table = Table(title="errors", caption="in m", box=SIMPLE_HEAD, padding=0)
    for k in range(9):
        table.add_column(f"column {k}", no_wrap=True)
    for name in ("dead-reckoning", "graph-smoothed-misalignment"):
        table.add_row(name, *(f"{name[:4]}{k} ± 0.01" for k in range(8)), end_section=True)
    return table


@pytest.mark.parametrize("width", [80, 120, 30])
def test_a_table_wider_than_the_terminal_is_printed_in_parts_that_fit(width):
    console = Console(width=width, record=True, file=io.StringIO())
    parts = list(fitting(wide_table(), console))
    for part in parts:
        console.print(part)
    lines = console.export_text().splitlines()
    assert len(parts) > 1 and all(len(part.columns) > 1 for part in parts)
    assert [part.title for part in parts] == ["errors", *[None] * (len(parts) - 1)]
    assert [part.caption for part in parts] == [*[None] * (len(parts) - 1), "in m"]
    if width >= 80:  # wide enough for two columns
        assert all(len(part.columns) >= 3 for part in parts[:-1])
        for name in ("dead-reckoning", "graph-smoothed-misalignment"):
            cells = " ".join(line for line in lines if name in line)
            assert cells.count(name) == len(parts)
            assert all(f"{name[:4]}{k} ± 0.01" in cells for k in range(8))


def test_a_table_that_fits_stays_one():
    (part,) = fitting(wide_table(), Console(width=200, file=io.StringIO()))
    assert len(part.columns) == 9 and part.title == "errors" and part.caption == "in m"
