"""The example's ROS 2 node, as far as it can be tried without ROS: what its messages say, and who is followed."""

import importlib.util
import json
import threading
from pathlib import Path

import numpy as np
import pytest
from live import vehicle
from scipy.spatial.transform import Rotation

from rovgraph.geometry import matrix_from_rpy

PATH = Path(__file__).parents[1] / "examples" / "ros2" / "rovgraph_bridge.py"
NED_TO_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU_TO_FRD = np.diag([1.0, -1.0, -1.0])
SOLUTION = {
    "time": 4.0, "north": 1.0, "east": 2.0, "down": 3.0, "roll": 0.3, "pitch": -0.2, "yaw": 2.5,
    "v_north": 0.4, "v_east": -0.1, "v_down": 0.05, "north_sd": 0.1, "east_sd": 0.2, "down_sd": 0.3,
    "roll_sd": 0.01, "pitch_sd": 0.02, "yaw_sd": 0.03, "v_north_sd": 0.001, "v_east_sd": 0.004, "v_down_sd": 0.002,
    "cov_north_east": -0.003, "latitude": None, "longitude": None,
}  # fmt: skip


@pytest.fixture(scope="module")
def bridge():
    spec = importlib.util.spec_from_file_location("rovgraph_bridge", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("rpy", [(0.3, -0.2, 2.5), (0.0, 0.0, 0.0), (-1.2, 0.7, -3.0), (3.0, 1.4, 0.4)])
def test_attitude_and_velocity_are_turned_as_ros_wants_them(bridge, rpy):
    s = SOLUTION | dict(zip(("roll", "pitch", "yaw"), rpy, strict=True))
    R_nb = matrix_from_rpy(np.array(rpy))
    _, quaternion, velocity, _, _ = bridge.odometry_of(s)
    np.testing.assert_allclose(Rotation.from_quat(quaternion).as_matrix(), NED_TO_ENU @ R_nb @ FLU_TO_FRD, atol=1e-12)
    v_n = np.array([s["v_north"], s["v_east"], s["v_down"]])
    np.testing.assert_allclose(velocity, FLU_TO_FRD @ R_nb.T @ v_n, atol=1e-12)


def test_covariances_stand_where_ros_reads_them(bridge):
    position, _, _, pose, twist = bridge.odometry_of(SOLUTION)
    pose, twist = np.reshape(pose, (6, 6)), np.reshape(twist, (6, 6))
    assert position == (2.0, 1.0, -3.0)
    np.testing.assert_allclose(np.sqrt(np.diag(pose)), [0.2, 0.1, 0.3, 0.01, 0.02, 0.03])
    assert pose[0, 1] == pose[1, 0] == -0.003
    np.testing.assert_allclose(np.diag(twist), [0.004**2] * 3 + [-1.0] * 3)


def test_it_follows_a_rovgraph_that_hangs_up_once(bridge, monkeypatch):
    monkeypatch.setattr(bridge, "RETRY_S", 0.05)
    lines = [(0.05 * k, json.dumps({"time": k}).encode() + b"\n") for k in range(40)]
    stop = threading.Event()
    with vehicle(lines, hang_up=0.5) as server:
        times = []
        for solution in bridge.solutions("127.0.0.1", server.port, stop):
            times.append(solution["time"])
            if times[-1] == 39:
                break
    assert server.clients == 2
    assert times == sorted(times) and times[0] < 5
