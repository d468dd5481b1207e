"""Consecutive files of one source are one recording; a file of which nothing is used is never passed over."""

import json
import shutil
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from autopilot_files import short_dive
from bags import SURFACE, Sent, imu, marine_dvl, of_dive, pressure, transform, write
from doppler_files import UNIX as PD0_START
from doppler_files import pd0_ensemble, pd4_frame
from test_api import command
from test_stamps import nmea

import rovgraph as rg
from rovgraph.errors import InputError
from rovgraph.geometry import quaternion_from_matrix, rpy_from_matrix

START = 1_740_564_858.0
CUT = 20.0  # [s]


@pytest.fixture(scope="module")
def dive() -> pd.DataFrame:
    """Forty seconds of a simulated dive."""
    frame = short_dive(0.0)
    return frame[frame["time"] < 40.0]


def split(frame: pd.DataFrame, count: int) -> list[pd.DataFrame]:
    bounds = np.linspace(0, len(frame), count + 1).astype(int)
    return [frame.iloc[a:b] for a, b in pairwise(bounds)]


def quietly(*files: Path, **more: object) -> rg.Log:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return rg.read_log(list(files), **more)  # type: ignore[arg-type]


def csv(folder: Path, name: str, frame: pd.DataFrame) -> Path:
    path = folder / name
    frame.to_parquet(path) if name.endswith("parquet") else frame.to_csv(path, index=False)
    return path


def of_bag(form: str) -> Callable[[Path, pd.DataFrame, str], Path]:
    def made(folder: Path, frame: pd.DataFrame, name: str) -> Path:
        return write(folder / (f"{name}.bag" if form == "ros1" else name), form, of_dive(frame))

    return made


def pd0(folder: Path, frame: pd.DataFrame, name: str) -> Path:
    path = folder / f"{name}.pd0"
    pings = frame[frame["dvl_vx"].notna()]
    path.write_bytes(b"".join(pd0_ensemble(PD0_START + round(t, 2)) for t in pings["time"]))
    return path


def pd4(folder: Path, frame: pd.DataFrame, name: str, start: float = 0.0) -> Path:
    path = folder / f"{name}.pd4"
    pings = frame[frame["dvl_vx"].notna()]
    path.write_bytes(b"".join(pd4_frame(start + round(t, 2)) for t in pings["time"]))
    return path


def sentences(folder: Path, frame: pd.DataFrame, name: str) -> Path:
    path = folder / f"{name}.nmea"
    path.write_bytes(nmea(START + float(np.floor(frame["time"].iloc[0])), len(frame["time"].astype(int).unique())))
    return path


WRITERS: dict[str, tuple[Callable[[Path, pd.DataFrame, str], Path], str]] = {
    "csv": (lambda folder, frame, name: csv(folder, f"{name}.csv", frame), "imu"),
    "parquet": (lambda folder, frame, name: csv(folder, f"{name}.parquet", frame), "imu"),
    "ros1": (of_bag("ros1"), "imu"),
    "mcap": (of_bag("mcap"), "imu"),
    "pd0": (pd0, "dvl"),
    "pd4": (pd4, "dvl"),
    "nmea": (sentences, "fix"),
}


@pytest.mark.slow
@pytest.mark.parametrize("overlap", [0.0, 1.0], ids=["end to end", "a second twice"])
@pytest.mark.parametrize("form", WRITERS)
def test_pieces_in_any_order_are_what_the_whole_is(dive, tmp_path, form, overlap):
    make, sensor = WRITERS[form]
    whole = quietly(make(tmp_path, dive, "whole"))
    first = make(tmp_path, dive[dive["time"] < CUT + overlap], "b_first")
    second = make(tmp_path, dive[dive["time"] >= CUT], "a_second")
    with pytest.warns(rg.DataWarning, match="2 files are read as pieces of one recording") as said:
        log = rg.read_log([second, first])
    assert any("rows that two of them have are taken once" in str(w.message) for w in said) == bool(overlap)
    assert log.sensors == whole.sensors
    for name in whole.sensors:
        np.testing.assert_allclose(log[name].time, whole[name].time, atol=0.02)
        np.testing.assert_allclose(log[name].data, whole[name].data, atol=1e-6)
    assert len(log[sensor]) == len(whole[sensor])


def test_a_log_of_pieces_is_that_of_the_whole_and_the_account_names_them(dive, tmp_path, monkeypatch):
    whole = csv(tmp_path, "whole.csv", dive)
    pieces = [csv(tmp_path, f"dive_{k}.csv", part) for k, part in enumerate(split(dive, 3))]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert command(monkeypatch, "convert", *pieces[::-1], "--out", tmp_path / "log.csv") == 0
    account = json.loads((tmp_path / "log.report.json").read_text())
    (file,) = account["files"]
    assert [Path(piece["file"]).name for piece in file["pieces"]] == ["dive_0.csv", "dive_1.csv", "dive_2.csv"]
    assert sum(piece["rows"] for piece in file["pieces"]) == sum(c["count"] for c in file["channels"])
    one, other = (
        rg.smooth(quietly(path), estimate="smoothed").main.trajectory for path in (whole, tmp_path / "log.csv")
    )
    np.testing.assert_allclose(one.p_n, other.p_n, atol=1e-3)


def test_what_is_missing_between_pieces_is_a_gap(dive, tmp_path):
    parts = dive[dive["time"] < 15.0], dive[dive["time"] >= 25.0]
    log = quietly(*(csv(tmp_path, f"{k}.csv", part) for k, part in enumerate(parts)))
    assert np.diff(log["imu"].time).max() == pytest.approx(10.0, abs=0.1)


def test_a_column_that_only_one_piece_has_is_empty_in_the_other(dive, tmp_path):
    first = csv(tmp_path, "0.csv", dive[dive["time"] < CUT].assign(dvl_sd=0.01))
    log = quietly(first, csv(tmp_path, "1.csv", dive[dive["time"] >= CUT]))
    sd = log["dvl"]["dvl_sd"]
    assert np.isfinite(sd[log["dvl"].time < CUT]).all() and np.isnan(sd[log["dvl"].time >= CUT]).all()


@pytest.mark.parametrize("copy", ["dive.csv", "./dive.csv", "link.csv", "copy.csv", "copy.csv.gz"])
def test_a_file_that_is_given_twice_is_taken_once(dive, tmp_path, copy):
    path = csv(tmp_path, "dive.csv", dive)
    again = tmp_path / copy
    if copy == "link.csv":
        again.symlink_to(path)
    elif copy.startswith("copy"):
        dive.to_csv(again, index=False)
    with pytest.warns(rg.DataWarning, match=r"taken once"):
        log = rg.read_log([path, again])
    assert len(log["imu"]) == len(quietly(path)["imu"])


def test_two_files_of_a_sensor_at_the_same_time_are_a_choice_that_is_told(dive, tmp_path):
    one, two = csv(tmp_path, "one.csv", dive), csv(tmp_path, "two.csv", dive.assign(depth=dive["depth"] + 1.0))
    with pytest.warns(rg.DataWarning, match=r"one\.csv and two\.csv have depth at the same time") as said:
        log = rg.read_log([one, two])
    remedies = {str(w.message).partition("--choose ")[2].partition(" ")[0] for w in said} - {""}
    assert "depth=two.csv" in remedies
    chosen = quietly(one, two, choose=dict(r.split("=") for r in remedies))
    np.testing.assert_allclose(chosen["depth"]["depth"], log["depth"]["depth"] + 1.0)


def test_a_logger_that_counts_each_file_from_zero_is_joined_by_the_shift_that_is_named(dive, tmp_path):
    second = dive[dive["time"] >= CUT]
    files = (
        csv(tmp_path, "0.csv", dive[dive["time"] < CUT]),
        csv(tmp_path, "1.csv", second.assign(time=second["time"] - CUT)),
    )
    with pytest.warns(rg.DataWarning, match=r"if it continues 0\.csv, state --shift 1\.csv=SECONDS"):
        rg.read_log(files)
    log = quietly(*files, shift={"1.csv": CUT})
    np.testing.assert_allclose(log["imu"].time, quietly(csv(tmp_path, "whole.csv", dive))["imu"].time, atol=1e-6)


UNUSED = {
    "too much in common": (15.0, 0.0, "they share .* s, more than a tenth of the shorter"),
    "another day": (20.0, 2 * 86400.0, "48 h lie between them"),
}


@pytest.mark.parametrize("case", UNUSED)
def test_a_file_of_which_nothing_is_used_is_refused_unless_it_is_left_out(dive, tmp_path, monkeypatch, capsys, case):
    begin, later, why = UNUSED[case]
    first, second = dive[dive["time"] < CUT], dive[dive["time"] >= begin]
    files = csv(tmp_path, "0.csv", first), csv(tmp_path, "1.csv", second.assign(time=second["time"] + later))
    for order in (files, files[::-1]):
        with pytest.raises(
            InputError, match=f"nothing of it is used, although .*{why}; cut off what they share, or leave"
        ):
            rg.read_log(order)
    assert len(rg.read_log(files[1])["imu"])
    if not later:  # what they share is cut off
        cut = csv(tmp_path, "2.csv", second[second["time"] >= CUT])
        assert quietly(files[0], cut).end == pytest.approx(dive["time"].iloc[-1], abs=0.1)
    assert command(monkeypatch, "check", *files) == 2
    assert "nothing of it is used" in capsys.readouterr().err


@pytest.mark.parametrize("order", [1, -1])
def test_times_of_day_of_two_files_go_on_over_midnight(dive, tmp_path, order):
    first, second = dive[dive["time"] < CUT], dive[dive["time"] >= CUT]
    before = pd4(tmp_path, first, "before", 86400.0 - CUT)
    after = pd4(tmp_path, second.assign(time=second["time"] - CUT), "after", 0.0)
    log = quietly(*[before, after][::order])
    assert np.diff(log["dvl"].time).max() < 0.5 and len(log["dvl"]) == dive["dvl_vx"].notna().sum()


def test_a_counter_that_is_full_between_two_files_goes_on(dive, tmp_path):
    full = 4294.967296
    first, second = dive[dive["time"] < CUT], dive[dive["time"] >= CUT]
    files = (
        csv(tmp_path, "b.csv", first.assign(time=first["time"] - CUT + full)),
        csv(tmp_path, "a.csv", second.assign(time=second["time"] - CUT)),
    )
    log = quietly(*files)
    np.testing.assert_allclose(
        np.diff(log["imu"].time), np.diff(quietly(csv(tmp_path, "w.csv", dive))["imu"].time), atol=1e-3
    )


def pieces_of_a_bag(folder: Path, sent: Sequence[Sent]) -> list[Path]:
    earlier = [s for s in sent if s.time < CUT]
    return [
        write(folder / "0.bag", "ros1", earlier),
        write(folder / "1.bag", "ros1", [s for s in sent if s.time >= CUT]),
    ]


def test_the_surface_and_the_mountings_of_a_bag_hold_for_all_its_pieces(tmp_path):
    times = np.arange(0.0, 40.0, 0.05).tolist()
    dived = [pressure(t, SURFACE + 1e3 * min(t, 30.0)) for t in times]
    turned = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    frames = [transform("base_link", "imu_link"), transform("base_link", "dvl_link", quaternion_from_matrix(turned))]
    moving = [imu(t, (0.0, 0.0, 9.8), (0.0, 0.0, 0.01)) for t in times] + [
        marine_dvl(t, (0.5, 0.0, 0.0)) for t in times[::4]
    ]
    sent = sorted([*frames, *dived, *moving], key=lambda s: s.time)
    whole = quietly(write(tmp_path / "whole.bag", "ros1", sent))
    with pytest.warns(rg.DataWarning) as said:
        log = rg.read_log(pieces_of_a_bag(tmp_path, sent)[::-1])
    np.testing.assert_allclose(log["depth"]["depth"], whole["depth"]["depth"], atol=0.05)
    assert log.settings == whole.settings
    assert not any("tf_static" in str(w.message) or "standard atmosphere" in str(w.message) for w in said)
    assert rpy_from_matrix(turned)[2] != 0.0


def test_pieces_that_agree_are_joined_whatever_else_a_file_holds(dive, tmp_path):
    """The second file has a sensor of its own."""
    second = dive[dive["time"] >= CUT].assign(dvl_altitude=2.0)
    log = quietly(csv(tmp_path, "0.csv", dive[dive["time"] < CUT]), csv(tmp_path, "1.csv", second))
    assert log["imu"].time[0] < 1.0 and log["imu"].time[-1] > 39.0 and log["dvl_altitude"].time[0] >= CUT


def test_beams_of_pieces_are_one_table(dive, tmp_path):
    parts = dive[dive["time"] < CUT], dive[dive["time"] >= CUT]
    files = [csv(tmp_path, f"{k}.csv", part) for k, part in enumerate(parts)]
    for path, part in zip(files, parts, strict=True):
        pings = part[part["dvl_vx"].notna()]
        table = pd.DataFrame({"time": pings["time"], "valid_1": 1, "velocity_1": 0.5, "range_1": 3.0})
        csv(tmp_path, f"{path.stem}.dvl_beams.csv", table)
    log = quietly(*files)
    assert len(log["dvl_beams"]) == len(log["dvl"])


def test_results_do_not_take_a_piece_for_an_output(dive, tmp_path, monkeypatch, capsys):
    parts = dive[dive["time"] < CUT], dive[dive["time"] >= CUT]
    files = [csv(tmp_path, f"{k}.csv", part) for k, part in enumerate(parts)]
    shutil.copy(files[1], tmp_path / "kept.csv")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert command(monkeypatch, "convert", *files, "--out", files[1], "--force") == 2
    assert "is one of the files that are read" in capsys.readouterr().err
    assert files[1].read_bytes() == (tmp_path / "kept.csv").read_bytes()


def test_the_pieces_of_a_recording_are_in_the_order_of_time(dive, tmp_path):
    files = [csv(tmp_path, f"{k}.csv", part) for k, part in enumerate(split(dive, 4))]
    (recording,) = rg.convert([files[k] for k in (2, 0, 3, 1)]).merged.recordings
    assert [Path(piece.path).name for piece in recording.pieces] == ["0.csv", "1.csv", "2.csv", "3.csv"]
    assert replace(recording, pieces=()).names < recording.names
