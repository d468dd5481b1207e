"""ROS bags of a Nortek Nucleus: the packets of its driver are read as those of its own file."""

from pathlib import Path

import numpy as np
import pytest
from bags import START, Sent, write
from recordings import close

from rovgraph.errors import InputError
from rovgraph.readers.formats import read_recording
from rovgraph.readers.recording import Channel, Recording


def packet(time: float, kind: str, topic: str, boot: float | None = None, **fields: object) -> Sent:
    """A packet, stamped by Unix time, or by the time since the instrument's start ``boot`` seconds ago."""
    stamp = START + time if boot is None else boot + time
    whole, micro = divmod(round(1e6 * stamp), 1_000_000)
    clock = {"posix_time": boot is None, "timestamp": whole, "microseconds": micro}
    return Sent(time, f"/nucleus_node/{topic}", f"interfaces/msg/{kind}", clock | fields)


def packets(boot: float | None = None, bottom: bool = True) -> list[Sent]:
    moved = dict(zip(("velocity_x", "velocity_y", "velocity_z"), (0.5, -0.1, 0.02), strict=True))
    valid = {f"{axis}_{what}_valid": True for axis in "xyz" for what in ("velocity", "fom")}
    ranges = {f"distance_beam_{k}": 2.0 + k for k in (1, 2, 3)} | {f"beam_{k}_distance_valid": k < 3 for k in (1, 2, 3)}
    track = moved | valid | ranges | {f"fom_{axis}": 0.01 for axis in "xyz"} | {"dt_xyz": 0.03}
    sent = []
    for k in range(60):
        imu = {"is_valid": k != 7, "accelerometer_x": 0.1, "accelerometer_z": -9.8, "gyro_y": 0.02}
        sent.append(packet(0.02 * k, "IMU", "imu_packets", boot, **imu))
        sent.append(packet(0.02 * k, "Magnetometer", "magnetometer_packets", boot, magnetometer_x=0.2))
        angles = {"roll": 5.0, "pitch": -3.0, "heading": 350.0, "declination": 4.0, "depth": 7.5}
        sent.append(packet(0.02 * k, "AHRS", "ahrs_packets", boot, **angles))
        if bottom and k % 10 == 0:
            lost = {"y_velocity_valid": False} if k == 20 else {}
            sent.append(packet(0.02 * k, "BottomTrack", "bottom_track_packets", boot, **track | lost))
            sent.append(packet(0.02 * k, "WaterTrack", "water_track_packets", boot, **track | lost))
    return sent


def read(folder: Path, sent: list[Sent], form: str = "sqlite", definitions: bool = True) -> Recording:
    return read_recording(write(folder / ("dive.bag" if form == "ros1" else "dive"), form, sent, definitions))


def columns(recording: Recording, sensor: str) -> dict[str, np.ndarray]:
    return dict(channel(recording, sensor).columns)


def channel(recording: Recording, sensor: str) -> Channel:
    return next(each for each in recording.channels if each.sensor == sensor)


@pytest.mark.parametrize(("form", "definitions"), [("sqlite", True), ("sqlite", False), ("mcap", True), ("ros1", True)])
def test_its_packets_become_all_its_sensors(form, definitions, tmp_path):
    recording = read(tmp_path, packets(), form, definitions)
    imu, dvl, ahrs = (columns(recording, sensor) for sensor in ("imu", "dvl", "ahrs"))
    close(imu["time"], START + 0.02 * np.arange(60))
    close(imu["acc_z"], np.where(np.arange(60) == 7, np.nan, -9.8))
    close(columns(recording, "mag")["mag_x"], 20.0, atol=1e-5)
    close(np.rad2deg([ahrs["ahrs_roll"][0], ahrs["ahrs_pitch"][0], ahrs["ahrs_yaw"][0]]), [5.0, -3.0, -14.0], 1e-4)
    close(columns(recording, "depth")["depth"], 7.5)
    close(dvl["time"], START + 0.2 * np.arange(6) + 0.03)
    close(dvl["dvl_vx"], [0.5, 0.5, np.nan, 0.5, 0.5, 0.5])
    np.testing.assert_array_equal(dvl["dvl_valid"], [1, 1, 0, 1, 1, 1])
    close(dvl["dvl_sd"][0], 0.01)
    assert len(columns(recording, "dvl_water")["time"]) == 5
    close(columns(recording, "dvl_altitude")["dvl_altitude"], 3.5)
    assert recording.settings["imu"]["mount_rpy_deg"] == recording.settings["dvl"]["mount_rpy_deg"] == [0.0, 0.0, 0.0]
    assert recording.settings["environment"] == {"declination_deg": 4.0}


def test_packets_without_unix_time_share_one_clock(tmp_path):
    recording = read(tmp_path, packets(boot=77.0))
    clocks = {each.clock for each in recording.channels}
    assert len(clocks) == 1
    assert recording.clocks[clocks.pop()].unix_offset == pytest.approx(START - 77.0 + 0.004 - 0.03, abs=1e-4)


def test_messages_of_that_name_by_others_are_counted(tmp_path, monkeypatch):
    import bags

    own = {"interfaces/msg/IMU": "std_msgs/Header header\nfloat64 roll\n"}
    monkeypatch.setattr(bags, "ALL_DEFINITIONS", own)
    with pytest.raises(InputError, match=r"holds no measurement of a sensor; topics: .*/imu \(interfaces/msg/IMU\): 3"):
        read(tmp_path, [Sent(0.1 * k, "/imu", "interfaces/msg/IMU", {"roll": 1.0}) for k in range(3)])
