"""What commands print fits into a terminal of 80 columns."""

import io
import re
import shlex
import sys
import warnings
from pathlib import Path

import pytest

import rovgraph as rg
from rovgraph.cli.app import main
from rovgraph.cli.console import folded

COMMANDS = {
    "check": "check log.csv",
    "check with a configuration": "check log.csv --config vehicle.yaml",
    "smooth": "smooth log.csv --estimate filtered --no-figures --no-page --out results",
    "evaluate": "evaluate reference.csv reference.csv",
    "observe": "observe log.csv --config vehicle.yaml --out observed",
    "compare": "compare log.csv --config vehicle.yaml --reference reference.csv --jobs 1 --out compared"
    " --estimators dead-reckoning,graph-filtered-misalignment",
    "plan": "plan --config vehicle.yaml --manoeuvres straight --duration 60 --imu-rate 20 --dvl-rate 2 --out planned",
    "simulate": "simulate circle --duration 40 --out simulated",
    "online": "online file:log.csv --speed max --output udp://127.0.0.1:9",
    "config": "config --keys",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dive whose IMU and DVL have z up, which log.csv alone does not say: there is a lot to warn of."""
    folder = tmp_path_factory.mktemp("narrow")
    mounted = "imu: {mount_rpy_deg: [180, 0, 0]}\ndvl: {mount_rpy_deg: [180, 0, 45]}"
    text = f"{mounted}\ncalibration: {{dvl_yaw: {{estimate: true}}}}"
    rg.simulate("square", rg.parse_config(text), choices=rg.Choices(duration=40)).save(folder / "dive")
    for name, here in (("log.csv", "log.csv"), ("config.yaml", "vehicle.yaml"), ("truth.csv", "reference.csv")):
        (folder / "dive" / name).rename(folder / here)
    return folder


@pytest.mark.parametrize("text", COMMANDS.values(), ids=COMMANDS)
def test_no_line_is_longer_than_80_columns_and_no_cell_is_cut(text, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("rovgraph.lab.plan.cores", lambda: 1)  # each process imports everything anew
    monkeypatch.setattr(sys, "argv", ["rovgraph", *shlex.split(text)])
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)  # the command sets its own
    with warnings.catch_warnings(), pytest.raises(SystemExit) as end:
        main()
    said = capsys.readouterr()
    assert end.value.code == 0, said.err
    lines = [*said.out.splitlines(), *said.err.splitlines()]
    assert len(lines) > 2
    assert [line for line in lines if len(line) > 80] == []
    assert [line for line in lines if "…" in line or re.search(r"\d\.\de[+-]\d", line)] == []


def test_a_sentence_breaks_between_words_and_a_path_stays_whole(monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")
    lines = folded(f"warning a sensor: see {'/long' * 6} there", io.StringIO(), indent=8).splitlines()
    assert lines == ["warning a sensor:", "        see", "        " + "/long" * 6, "        there"]


def test_a_file_or_a_pipe_gets_a_sentence_in_one_line():
    assert folded("word " * 100, io.StringIO()) == "word " * 100
