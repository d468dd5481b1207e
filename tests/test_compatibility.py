"""What rovgraph reads back states the version of its form: this one is read, a newer one is refused in one line."""

import json
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import rovgraph as rg
from rovgraph.cli.app import main
from rovgraph.compatibility import CONFIGURATION, LOG, RESULTS
from rovgraph.live.files import VERSION, Recorder, read_checkpoint, write_checkpoint
from rovgraph.live.message import Reading
from rovgraph.report.folder import STAMP, SUMMARY

DOCS = Path(__file__).parents[1] / "docs"

Command = Callable[..., str]


@pytest.fixture
def refused(monkeypatch, capsys) -> Command:
    """Call a command that exits with code 2 and one line; returns the line."""

    def call(*words: object) -> str:
        monkeypatch.setattr(sys, "argv", ["rovgraph", *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            main()
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert stop.value.code == 2, line
        return line

    return call


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of a simulated dive."""
    folder = tmp_path_factory.mktemp("compatibility") / "made"
    rg.simulate("circle", seed=1, choices=rg.Choices(duration=32)).save(folder)
    return folder


# configuration


def test_a_configuration_of_this_version_or_without_one_is_read_and_written_with_it():
    assert rg.parse_config("name: a").version == CONFIGURATION
    written = rg.parse_config(f"{{version: {CONFIGURATION}, name: a}}").to_yaml()
    assert written.startswith(f"version: {CONFIGURATION}\n") and rg.parse_config(written).name == "a"


@pytest.mark.parametrize(
    ("text", "sd", "estimate"),
    [
        ("chart: {sd_m: 0.3, position_sd_m: 2.5}", 2.5, True),
        ("chart: {position_sd_m: 0}", 1.0, False),
        ("{chart: {position_sd_m: 2.5}, calibration: {chart_place: {sd: 4}}}", 4.0, True),
    ],
)
def test_the_place_of_a_chart_is_read_under_its_former_key(text, sd, estimate):
    config = rg.parse_config(text)
    assert (config.calibration.chart_place.sd, config.calibration.chart_place.estimate) == (sd, estimate)
    assert "position_sd_m" not in config.to_yaml().partition("\nchart:")[2].partition("\n")[0]


def test_a_newer_configuration_is_refused_by_its_version_and_not_by_its_keys(tmp_path, refused):
    path = tmp_path / "vehicle.yaml"
    path.write_text(f"version: {CONFIGURATION + 1}\nsonar: {{range_m: 30}}\n")
    assert f"vehicle.yaml: configuration of version {CONFIGURATION + 1}" in refused("config", path)


@pytest.mark.parametrize("version", ["0", "-1", "one", "1.5", "[1]"])
def test_what_is_no_version_of_a_configuration_is_refused(version):
    with pytest.raises(rg.InputError, match=r"version"):
        rg.parse_config(f"version: {version}")


# log and recording


def recording(path: Path) -> pd.DataFrame:
    recorder = Recorder(path)
    for k in range(20):
        recorder.write(0.1 * k, 1.7e9 + 0.1 * k, [Reading("imu", np.array([0.0, 0.0, -9.8, 0.0, 0.0, 0.01 * k]))])
    recorder.close()
    return pd.read_csv(path)


def test_a_recording_states_this_version_in_every_row_and_is_read(tmp_path):
    assert (recording(tmp_path / "received.csv")["rovgraph_log"] == LOG).all()
    assert len(rg.read_log(tmp_path / "received.csv")["imu"]) == 20


@pytest.mark.parametrize("row", [0, 19])
def test_a_newer_recording_is_refused_by_its_version(tmp_path, row, refused):
    path = tmp_path / "received.csv"
    table = recording(path)
    table.loc[row, "rovgraph_log"] = LOG + 1
    table.to_csv(path, index=False)
    said = f"received.csv: log of version {LOG + 1}, this rovgraph reads up to {LOG}; update rovgraph"
    assert said in refused("check", path)
    shutil.copy(path, tmp_path / "other.csv")
    assert said in refused("convert", path, tmp_path / "other.csv", "--out", tmp_path / "log.csv")  # beside other files


def test_a_log_without_a_version_or_with_empty_cells_is_of_the_first(made):
    frame = pd.read_csv(made / "log.csv")
    config = rg.load_config(made / "config.yaml")
    assert "rovgraph_log" not in frame
    plain, empty = (rg.Log.from_frame(f, config) for f in (frame, frame.assign(rovgraph_log=np.nan)))
    np.testing.assert_array_equal(plain["imu"].data, empty["imu"].data)
    with pytest.raises(rg.InputError, match="of version 7"):
        rg.Log.from_frame(frame.assign(rovgraph_log=7), config)


# results folder


@pytest.fixture
def results(tmp_path, made) -> Path:
    """A results folder with a track."""
    folder = tmp_path / "results"
    folder.mkdir()
    shutil.copy(made / "truth.csv", folder / "trajectory_smoothed.csv")
    return folder


def test_a_simulated_dive_states_the_version_of_results(made):
    assert json.loads((made / SUMMARY).read_text())["format"] == RESULTS


@pytest.mark.parametrize("version", [{"format": RESULTS}, {}, {"format": None}])
def test_results_of_this_version_or_without_one_are_read(results, version):
    (results / SUMMARY).write_text(json.dumps({k: v for k, v in STAMP.items() if k != "format"} | version))
    assert [path.is_file() for path in rg.export(results, "tum")] == [True]


def test_newer_results_are_refused_by_their_version(results, refused):
    (results / SUMMARY).write_text(json.dumps(STAMP | {"format": RESULTS + 1}))
    said = f"results: results folder of version {RESULTS + 1}, this rovgraph reads up to {RESULTS}; update rovgraph"
    assert said in refused("report", results)
    assert said in refused("export", results, "--to", "tum")


# checkpoint


def test_a_checkpoint_of_another_version_is_refused_and_one_of_this_is_read(tmp_path, made, refused):
    run = tmp_path / "run"
    run.mkdir()
    recording(run / "received.csv")
    checkpoint = run / "checkpoint"
    write_checkpoint(checkpoint, {"a": 1})
    assert read_checkpoint(checkpoint) == {"a": 1}
    this = b"checkpoint %d " % VERSION
    for other in (VERSION - 1, VERSION + 1):
        write_checkpoint(checkpoint, {"a": 1})
        checkpoint.write_bytes(checkpoint.read_bytes().replace(this, b"checkpoint %d " % other))
        said = refused("online", f"file:{made / 'log.csv'}", "--speed", "max", "--out", run, "--resume")
        assert f"checkpoint of version {other}, expected {VERSION}" in said


def test_the_manual_states_these_versions():
    text = (DOCS / "compatibility.md").read_text(encoding="utf-8")
    rows = [row for row in text.splitlines() if re.search(r"\| is refused \|$", row)]
    assert [int(row.split("|")[3]) for row in rows] == [CONFIGURATION, LOG, RESULTS, VERSION]
