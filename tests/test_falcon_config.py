"""rovgraph/model/falcon.yaml says what the thesis says, and data/falcon is what its README says."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from rovgraph.geometry import exp_rotation
from rovgraph.model.calibration import TABLE
from rovgraph.model.config import Config, load_config, mount_matrix, with_priors_stated
from rovgraph.model.state import State
from rovgraph.model.thesis import FLIP, R_DVL, R_MTI, THETA_DVL, THETA_MTI
from rovgraph.sensors.instruments import instruments
from rovgraph.simulate import Truth, scenario, simulate
from rovgraph.simulate.files import secrets, write_log

ROOT = Path(__file__).parents[1]
SHIPPED = ROOT / "data" / "falcon"
MTI, DVL = np.diag(R_MTI), np.diag(R_DVL)


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(ROOT / "rovgraph" / "model" / "falcon.yaml")


def sensor_to_thesis_body(theta: np.ndarray) -> np.ndarray:
    """Rz Ry Rx of the thesis's angles, built from rotation vectors."""
    roll, pitch, yaw = (exp_rotation(np.eye(3)[i] * theta[i]) for i in range(3))
    return yaw @ pitch @ roll


def test_mountings_turn_vectors_as_the_thesis_does(config):
    for theta, mount in ((THETA_MTI, config.imu.mount_rpy_deg), (THETA_DVL, config.dvl.mount_rpy_deg)):
        for x_s in np.eye(3):
            thesis = sensor_to_thesis_body(theta) @ x_s  # forward, port, up
            np.testing.assert_allclose(mount_matrix(mount) @ x_s, FLIP @ thesis, atol=1e-12)


def test_resting_mti_reads_gravity_as_in_the_thesis(config):
    """(3.12) with the sign of gravity corrected: +9.81 up in the thesis's body axes."""
    y_thesis = sensor_to_thesis_body(THETA_MTI).T @ [0, 0, 9.81]
    y = mount_matrix(config.imu.mount_rpy_deg).T @ [0, 0, -9.81]
    np.testing.assert_allclose(y, y_thesis, atol=1e-12)
    assert y[2] == pytest.approx(9.81, abs=0.02)


def test_dvl_measures_what_3_17_says(config):
    v_thesis, w_thesis, r_thesis = np.array([0.3, -0.1, 0.05]), np.array([0.02, -0.01, 0.3]), np.array([0.24, 0, -0.33])
    expected = sensor_to_thesis_body(THETA_DVL).T @ (v_thesis + np.cross(w_thesis, r_thesis))
    angles = np.deg2rad(config.dvl.mount_rpy_deg)
    calibration = {f"dvl_{n}": angles[[i]] for i, n in enumerate(("roll", "pitch", "yaw"))}
    calibration = {name: np.zeros(v.dim) for name, v in TABLE.items()} | calibration
    state = State(np.eye(3)[None], np.zeros((1, 3)), (FLIP @ v_thesis)[None], np.zeros((1, 6)), calibration)
    z, _ = instruments(config)["dvl"].model.predict(state, (FLIP @ w_thesis)[None])
    np.testing.assert_allclose(z[0], expected, atol=1e-12)


def test_lever_arms_are_the_thesiss(config):
    np.testing.assert_allclose(FLIP @ config.imu.lever_arm_m, [-0.11, -0.22, 0.10])
    np.testing.assert_allclose(FLIP @ config.dvl.lever_arm_m, [0.24, 0.0, -0.33])


def test_noise_is_appendix_a(config):
    noise, rate = config.imu.noise, 100.0
    assert noise.acc == pytest.approx(np.sqrt(MTI[:3].mean() / rate), rel=2e-3)
    assert noise.gyr == pytest.approx(np.sqrt(MTI[3:6].mean() / rate), rel=2e-3)
    np.testing.assert_allclose(config.dvl.velocity_sd_mps, np.sqrt(DVL[:3]), rtol=2e-3)
    assert config.heading.dvl_sd_deg == pytest.approx(np.rad2deg(np.sqrt(DVL[3])), rel=1e-2)
    assert instruments(config)["mag"].sd[0] == pytest.approx(np.sqrt(MTI[6:].mean()), rel=2e-2)


def test_dvl_misalignment_is_believed_to_be_its_mounting(config):
    calibration = config.calibration.dvl_yaw
    assert calibration.estimate and calibration.mean_deg is None and config.dvl.mount_rpy_deg[2] == 45.0


def test_shipped_dive_is_what_its_readme_says(config, tmp_path):
    """The command of the README, seed and all; one unit of the last digit is left to the platform."""
    summary = json.loads((SHIPPED / "summary.json").read_text())
    command = f"rovgraph simulate falcon --seed {summary['seed']} --outliers {summary['outlier_share']}"
    assert command in (SHIPPED / "README.md").read_text()
    truth = Truth(config, outlier_share=summary["outlier_share"])
    dive = simulate(scenario("falcon"), truth, np.random.default_rng(summary["seed"]))
    write_log(dive.log_frame, tmp_path / "log.csv")
    shipped, again = pd.read_csv(SHIPPED / "log.csv.gz"), pd.read_csv(tmp_path / "log.csv")
    pd.testing.assert_frame_equal(shipped, again, rtol=0, atol=1.001e-4)
    told = json.loads((SHIPPED / "truth.json").read_text())
    for name, value in secrets(dive)["calibration"].items():  # variables that came later are zero in the shipped dive
        shipped_value = told["calibration"].get(name, np.zeros(TABLE[name].dim))
        np.testing.assert_allclose(shipped_value, value, atol=1e-12)
    reference = pd.read_csv(SHIPPED / "truth.csv.gz")
    np.testing.assert_allclose(reference["east"], dive.truth.at(reference["time"].to_numpy()).p_n[:, 1], atol=1e-5)


def test_shipped_configuration_is_the_falcons(config):
    shipped, own = map(with_priors_stated, (load_config(SHIPPED / "config.yaml"), config))
    assert shipped.model_dump(exclude={"start"}) == own.model_dump(exclude={"start"})


def test_shipped_dive_is_small():
    assert sum(p.stat().st_size for p in SHIPPED.iterdir()) < 4e6
