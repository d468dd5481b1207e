"""A sensor that is defined outside the package, by the code of docs/own-sensor.md, is used by all of it."""

import importlib
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest
from dives import Simulated, altered, batch, falcon, incremental, renewed, simulated, started

from rovgraph.diagnosis.check import examine
from rovgraph.errors import InputError
from rovgraph.geometry import exp_rotation
from rovgraph.inference.estimate import CalibrationEstimate, Estimate
from rovgraph.live.files import Recorder
from rovgraph.live.message import readings
from rovgraph.log import STREAMS, read_log
from rovgraph.model.calibration import TABLE, calibration_size
from rovgraph.model.config import Config, describe, parse_config
from rovgraph.model.state import POSE, State
from rovgraph.sensors import SENSORS, Column, Sensor, register, unregister
from rovgraph.sensors.instruments import instruments
from rovgraph.simulate.files import write_dive

PAGE = (Path(__file__).parents[1] / "docs" / "own-sensor.md").read_text(encoding="utf-8")
MODULE, SCRIPT = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
(SETTINGS,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
TRUE_SCALE = 0.04
SURE = 4.0  # standard deviations


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page's module and script as files."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "depth2.py").write_text(MODULE)
    (folder / "run.py").write_text(SCRIPT)
    return folder


@pytest.fixture(scope="module")
def depth2(folder: Path) -> Iterator[ModuleType]:
    """The page's module, which registers its sensor; forgotten at the end."""
    sys.path.insert(0, str(folder))
    try:
        yield importlib.import_module("depth2")
    finally:
        unregister("depth2")
        sys.path.remove(str(folder))
        del sys.modules["depth2"]


@pytest.fixture(scope="module")
def case(depth2: ModuleType) -> Simulated:
    """A noisy dive with the second depth sensor, its scale off."""
    own = parse_config(SETTINGS).model_dump(exclude_unset=True)
    return simulated(falcon(**own), 90.0, calibration={"depth2_scale": np.array([TRUE_SCALE])})


@pytest.fixture(scope="module")
def estimates(case: Simulated) -> dict[str, Estimate]:
    config = started(case)
    return {
        "smoothed": batch(case.log, config).solve(),
        "filtered": renewed(case.log, config).solve(),
        "isam2": incremental(case.log, config).solve(),
    }


def scale_of(estimate: Estimate) -> CalibrationEstimate:
    (entry,) = (e for e in estimate.calibration if e.label == "depth2_scale")
    return entry


def test_its_derivatives_are_those_of_its_prediction(depth2):
    rng = np.random.default_rng(1)
    R, p, k = exp_rotation(rng.standard_normal((3, 3))), rng.standard_normal((3, 3)), np.array([0.1])
    model, rate, step = depth2.ScaledDepth(np.array([0.3, -0.2, 0.5])), np.zeros((3, 3)), 1e-6

    def predicted(turn: np.ndarray, shift: np.ndarray, scale: float) -> tuple:
        state = State(R @ exp_rotation(turn[None]), p + R @ shift, rate, np.zeros((3, 6)), {"depth2_scale": k + scale})
        return model.predict(state, rate)

    _, H = predicted(np.zeros(3), np.zeros(3), 0.0)
    for i, e in enumerate(step * np.eye(7)):
        ahead, behind = (predicted(s * e[:3], s * e[3:6], s * e[6])[0] for s in (1.0, -1.0))
        by = H[POSE][..., i] if i < 6 else H["depth2_scale"][..., 0]
        np.testing.assert_allclose(by, (ahead - behind) / (2 * step), atol=1e-8)


def test_its_column_is_read_in_any_unit_of_its_quantity(depth2, tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("time,depth2\n0,1200\n1,1300\n")
    log = read_log(path, Config(units={"depth2": "mm"}))
    assert log["depth2"].data.tolist() == [[1.2], [1.3]]


def test_its_keys_are_those_of_a_configuration(depth2):
    assert {"sensors.depth2.sd", "calibration.depth2_scale.estimate"} <= {key for key, _, _ in describe()}
    config = parse_config(SETTINGS + "delay_s: {depth2: 0.1}")
    assert config.sensors.depth2.sd == 0.03
    assert parse_config(config.to_yaml()) == config
    with pytest.raises(InputError, match=r"unknown key sensors\.depth2\.sdd, nearest known key is sensors\.depth2\.sd"):
        parse_config("sensors: {depth2: {sdd: 1}}")


def test_smoother_filter_and_isam2_recover_its_scale(estimates):
    for estimate in estimates.values():
        found = scale_of(estimate)
        assert found.estimated
        assert abs(found.value - TRUE_SCALE) < SURE * found.sd
        assert found.sd < 0.1 * found.prior_sd


def test_its_residuals_are_white_and_of_the_size_that_is_believed(estimates):
    for estimate in estimates.values():
        rows = estimate.residuals[estimate.residuals["sensor"] == "depth2"]
        assert len(rows) > 300
        assert set(rows["component"]) == {"down"}
        assert 0.8 < rows["normalised"].std() < 1.2


def test_its_faults_are_left_out(case):
    wrong = case.log["depth2"].data.copy()
    wrong[100:120] += 3.0
    wrong[200] = 1000.0
    smoother = batch(altered(case.log, "depth2", wrong), started(case))
    estimate = smoother.solve()
    found = scale_of(estimate)
    assert abs(found.value - TRUE_SCALE) < SURE * found.sd
    assert smoother.left_out["depth2", "beyond its range"] == 1
    rows = estimate.residuals[estimate.residuals["sensor"] == "depth2"]
    off, out = rows["normalised"].abs() > 6.0, rows["weight"] == 0.0
    assert off.sum() > 5 and out[off].all()
    assert out.sum() < 2 * off.sum()  # the stretch that is taken out reaches somewhat beyond


def test_it_is_checked(case):
    sound = examine(case.log, case.config)
    assert "depth2" in {timing.sensor for timing in sound.timings}
    assert not [f for f in sound.findings if f.sensor == "depth2" and f.level != "ok"]
    upside_down = examine(altered(case.log, "depth2", -case.log["depth2"].data), case.config)
    assert [f.level for f in upside_down.findings if f.sensor == "depth2" and "mirrored" in f.text] == ["warning"]


def test_it_is_received_and_recorded_online(depth2, tmp_path):
    recorder = Recorder(tmp_path / "recording.csv")
    said = readings({"depth2": 3.5})
    recorder.write(1.0, 1.7e9, said)
    recorder.close()
    assert [(sensor, values.tolist()) for sensor, values in said] == [("depth2", [3.5])]
    assert read_log(tmp_path / "recording.csv")["depth2"].data.tolist() == [[3.5]]


@pytest.mark.slow
def test_a_command_reports_its_calibration(case, folder):
    """By the page's script, in a process of its own."""
    write_dive(folder, case.dive, started(case), {})
    out = folder / "results"
    command = ["run.py", "smooth", "log.csv", "--config", "config.yaml", "--out", "results"]
    subprocess.run([sys.executable, *command], cwd=folder, check=True, capture_output=True, text=True, timeout=600)
    table = pd.read_csv(out / "calibration.csv")
    rows = table[(table["label"] == "depth2_scale") & table["estimated"]]
    assert set(rows["estimate"]) >= {"smoothed", "filtered"}
    assert ((rows["value"] - TRUE_SCALE).abs() < SURE * rows["sd"]).all()
    assert "depth2" in set(pd.read_csv(out / "residuals.csv")["sensor"])
    assert json.loads((folder / "truth.json").read_text())["calibration"]["depth2_scale"] == [TRUE_SCALE]
    assert json.loads((folder / "summary.json").read_text())["measurements"]["depth2"] == len(case.log["depth2"])


def test_a_name_that_is_taken_is_refused_and_nothing_is_changed(depth2):
    known = dict(SENSORS), dict(TABLE)
    for sensor in (
        Sensor("depth2", (Column("depth3", "length"),)),
        Sensor("depth3", (Column("depth2", "length"),)),
        Sensor("depth3", (Column("time"),)),
        Sensor("gyr", (Column("gyr", "rate"),)),
        Sensor("depth3", (Column("depth3"),), calibration=(replace(depth2.SCALE, name="k", letter="Q"), depth2.SCALE)),
    ):
        with pytest.raises(ValueError, match="taken"):
            register(sensor)
    assert known == (dict(SENSORS), dict(TABLE))
    assert "sensors.depth3.sd" not in {key for key, _, _ in describe()}


def test_a_sensor_that_is_unregistered_leaves_nothing_behind():
    before = dict(STREAMS), dict(TABLE), calibration_size(), list(describe()), set(instruments(Config()))
    register(Sensor("sonar", (Column("sonar", "length"),)))
    assert "sonar" in STREAMS
    unregister("sonar")
    assert before == (dict(STREAMS), dict(TABLE), calibration_size(), list(describe()), set(instruments(Config())))


@pytest.mark.parametrize("own", [{"linear_in": "current"}, {"heading_source": "mag"}])
def test_what_only_built_in_sensors_have_is_refused(own):
    with pytest.raises(ValueError, match="built-in"):
        register(Sensor("sonar", (Column("sonar", "length"),), **own))
    assert "sonar" not in SENSORS


def test_a_column_of_an_unknown_quantity_is_refused():
    with pytest.raises(ValueError, match="none of"):
        Column("turbidity", "murk")  # type: ignore[arg-type]


def test_a_log_with_it_is_read_as_any_other_where_nobody_registers_it(tmp_path):
    with pytest.raises(InputError, match="no measurement"):
        path = tmp_path / "log.csv"
        path.write_text("time,turbidity\n0,1\n1,2\n")
        read_log(path)
