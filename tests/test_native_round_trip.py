"""A simulated dive, written as native files, comes back to the track of the log that it was written from."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from autopilot_files import as_json, autopilot_messages, dataflash_of, mcap, packed, tlog
from bags import START, of_dive, transform, write
from dives import rms
from doppler_files import BEAM, EARTH, pd0_ensemble, trdi_values
from test_api import command
from wire import report

import rovgraph as rg
from rovgraph.simulate import Choices

SURFACE = 101_325.0  # [Pa]
ROS_FORMS = {"ROS 1": ("ros1", "dive.bag"), "ROS 2, SQLite": ("sqlite", "dive"), "ROS 2, MCAP": ("mcap", "dive")}
PD0_AXES = {"beam": BEAM, "earth": EARTH}


def config() -> rg.Config:
    """What files know is stated, so that a log of ours has it, too."""
    return rg.parse_config(
        "{graph: {find_noise: false}, environment: {field_norm: 50.0, declination_deg: 0.0},"
        " imu: {mount_rpy_deg: [0, 0, 0]}, dvl: {mount_rpy_deg: [0, 0, 0]}}"
    )


@cache
def dive() -> pd.DataFrame:
    """A minute along lanes, with IMU, magnetometer, depth, DVL, and the attitude that an autopilot has."""
    simulated = rg.simulate("lawnmower", config(), 5, Choices(duration=60.0, speed=0.5)).dive
    frame, truth = simulated.log_frame, simulated.truth
    known = frame["dvl_heading"].notna()
    tilts = {
        f"ahrs_{name}": np.interp(frame["time"], truth.time, truth.rpy[:, k])
        for k, name in enumerate(("roll", "pitch"))
    }
    frame = frame.rename(columns={"dvl_heading": "ahrs_yaw"})
    return frame.assign(**{name: np.where(known, values, np.nan) for name, values in tilts.items()})


def sensors(*names: str) -> pd.DataFrame:
    """Rows of the dive with the columns of some sensors."""
    kept = [name for name in dive() if name.startswith(names)]
    return dive().loc[dive()[kept].notna().any(axis=1), ["time", *kept]]


def tracks_apart(files: list[Path], frame: pd.DataFrame, shift: dict[str, float], begin: float) -> np.ndarray:
    """Position from native files less that from the log itself, at the keyframes of the latter, shape (n, 3) [m]."""
    expected = rg.smooth(rg.Log.from_frame(frame, config()), config(), "smoothed").smoothed.trajectory
    got = rg.smooth(rg.read_log(files, config(), shift=shift), config(), "smoothed").smoothed.trajectory
    assert got.time[-1] - got.time[0] == pytest.approx(60.0, abs=0.3)
    assert np.ptp(expected.p_n[:, 0]) > 10.0
    return np.column_stack([np.interp(expected.time, got.time - begin, got.p_n[:, k]) for k in range(3)]) - expected.p_n


def as_dataflash(folder: Path, frame: pd.DataFrame) -> Path:
    path = folder / "dive.BIN"
    path.write_bytes(dataflash_of(frame, 0.0, SURFACE))
    return path


def test_a_dataflash_log(tmp_path):
    frame = sensors("acc", "gyr", "ahrs", "depth", "dvl")
    apart = tracks_apart([as_dataflash(tmp_path, frame)], frame, {}, 0.0)
    assert rms(np.linalg.norm(apart, axis=1)) < 0.001


def telemetry(sent: list[tuple[float, object]]) -> bytes:
    return tlog(*((time, packed(message)) for time, message in sent))


def blueos(sent: list[tuple[float, object]]) -> bytes:
    return mcap((time, *as_json(message)) for time, message in sent)


@pytest.mark.parametrize("written", [telemetry, blueos])
def test_a_telemetry_log_and_a_recording_of_blueos(written: Callable[..., bytes], tmp_path):
    frame = sensors("acc", "gyr", "ahrs", "depth", "dvl")
    late = frame.assign(time=frame["time"] + 10.0)  # a boot time of 0 means that there is none
    path = tmp_path / "dive.log"
    path.write_bytes(written([(START + t, message) for t, message in autopilot_messages(late, 0.0, SURFACE)]))
    apart = tracks_apart([path], frame, {}, START + 10.0)
    assert rms(np.linalg.norm(apart, axis=1)) < 0.02  # attitude is stamped in whole milliseconds


@pytest.mark.slow
@pytest.mark.parametrize("form", ROS_FORMS)
def test_a_ros_bag(form, tmp_path):
    frame = sensors("acc", "gyr", "mag", "depth", "dvl")
    kind, name = ROS_FORMS[form]
    apart = tracks_apart([write(tmp_path / name, kind, of_dive(frame))], frame, {}, START)
    assert rms(np.linalg.norm(apart, axis=1)) < 0.001


@pytest.mark.slow
def test_a_ros_bag_is_converted_with_the_mountings_of_its_transforms_and_smoothed(tmp_path, monkeypatch):
    """By commands: the bag to a log and a configuration, and these to results."""
    frame = sensors("acc", "gyr", "mag", "depth", "dvl")
    half = np.sqrt(0.5)
    frames = [
        transform("base_link", "imu_link", (1, 0, 0, 0), (0.1, 0.0, 0.05)),  # x forward, y starboard, z down
        transform("base_link", "dvl_link", (half, half, 0, 0), (0.2, 0.1, -0.3)),  # x to port, y forward, z down
        transform("base_link", "pressure_link", at=(-0.3, 0.0, 0.1)),
    ]
    turned = frame.assign(dvl_vx=-frame["dvl_vy"], dvl_vy=frame["dvl_vx"])
    bag = write(tmp_path / "dive", "sqlite", [*frames, *of_dive(turned)])
    log, vehicle, out = tmp_path / "log.csv", tmp_path / "vehicle.yaml", tmp_path / "results"
    assert command(monkeypatch, "convert", bag, "--out", log, "--config-out", vehicle) == 0
    known = rg.load_config(vehicle)
    assert known.imu.lever_arm_m == (0.1, 0.0, -0.05)
    assert known.dvl.lever_arm_m == (0.2, -0.1, 0.3)
    assert known.depth.lever_arm_m == (-0.3, 0.0, -0.1)
    assert known.imu.mount_rpy_deg == (0.0, 0.0, 0.0)
    assert known.dvl.mount_rpy_deg == pytest.approx((0.0, 0.0, -90.0))
    assert command(monkeypatch, "smooth", log, "--config", vehicle, "--out", out, "--no-page", "--no-figures") == 0
    expected = rg.smooth(rg.Log.from_frame(turned, known), known, "smoothed").smoothed.trajectory
    got = pd.read_csv(out / "trajectory_smoothed.csv")
    columns = ("north", "east", "down")
    apart = [np.interp(expected.time, got["time"] - START, got[c]) - expected.p_n[:, k] for k, c in enumerate(columns)]
    assert rms(np.array(apart)) < 0.001, rms(np.array(apart))


def test_water_linked_json_beside_an_autopilot(tmp_path):
    frame = sensors("acc", "gyr", "ahrs", "depth")
    pings = sensors("dvl")
    velocities = pings.rename(columns={f"dvl_v{axis}": f"v{axis}" for axis in "xyz"})[["vx", "vy", "vz"]]
    lines = [
        report(**row, time_of_validity=round(1e6 * (START + time)), covariance=[], fom=0.01)
        for time, row in zip(pings["time"], velocities.to_dict("records"), strict=True)
    ]
    (tmp_path / "dvl.jsonl").write_bytes(b"".join(lines))
    files = [as_dataflash(tmp_path, frame), tmp_path / "dvl.jsonl"]
    apart = tracks_apart(files, sensors("acc", "gyr", "ahrs", "depth", "dvl"), {"dvl.jsonl": -START}, 0.0)
    assert rms(np.linalg.norm(apart, axis=1)) < 0.001


@pytest.mark.parametrize("axes", PD0_AXES)
def test_pd0_beside_an_autopilot(axes, tmp_path):
    frame = sensors("acc", "gyr", "ahrs", "depth")
    truth = sensors("ahrs").interpolate().set_index("time")
    ensembles = []
    for time, *v in sensors("dvl_v")[["time", "dvl_vx", "dvl_vy", "dvl_vz"]].to_numpy():
        rpy = [np.interp(time, truth.index, truth[f"ahrs_{name}"]) for name in ("roll", "pitch", "yaw")]
        gimballed = [rpy[0], np.arctan(np.tan(rpy[1]) * np.cos(rpy[0])), rpy[2]]
        ensembles.append(pd0_ensemble(START + time, -trdi_values(v, PD0_AXES[axes], rpy), PD0_AXES[axes], gimballed))
    (tmp_path / "dive.pd0").write_bytes(b"".join(ensembles))
    files = [as_dataflash(tmp_path, frame), tmp_path / "dive.pd0"]
    apart = tracks_apart(files, sensors("acc", "gyr", "ahrs", "depth", "dvl"), {"dive.pd0": -START}, 0.0)
    assert rms(np.linalg.norm(apart, axis=1)) < 0.03  # stamps are of 10 ms, velocities of 1 mm/s
