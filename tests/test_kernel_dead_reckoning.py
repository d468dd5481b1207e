"""Attitude of dead reckoning by its kernel: motion, levelling, compass, the Earth's rate, silence."""

import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rovgraph.geometry import earth_rate_n, exp_rotation, log_rotation, matrix_from_rpy, rpy_from_matrix, transpose
from rovgraph.kernels.dead_reckoning import Aiding, LevelStart, Motions, Surroundings, reckon_attitude

G, DT = 9.81, 0.2
DENSITY = np.array([0.05**2, 1e-3**2, 1e-5**2])
SD = np.array([[1.0, 0.05, 0.01], [0.05, 0.3, 0.01]])  # velocity, tilt, drift; deviation, heading, drift


def reckoned(
    R_nb, rate_b=(0.0, 0.0, 0.0), n=100, *, start=None, bias=(0.0, 0.0, 0.0), w_ie_n=(0.0, 0.0, 0.0), held=1.0, **rows
):
    """Attitudes and biases of a vehicle that turns at a constant rate and does not move, seen with a gyro's bias."""
    rate_b, bias = np.asarray(rate_b, float), np.asarray(bias, float)
    true = R_nb @ exp_rotation(rate_b * DT * np.arange(n)[:, None])
    turned = transpose(true[:-1]) @ true[1:] @ exp_rotation(DT * bias)
    dt = np.append(0.0, np.full(n - 1, DT))
    dR, dv = np.concatenate([np.eye(3)[None], turned]), np.zeros((n, 3))
    dv[1:] = -DT * G * true[:-1, 2]
    tables = {
        "outage": np.zeros(n, bool),
        "dvl": np.tile([0.0, 0.0, 0.0, math.inf], (n, 1)),
        "compass": np.tile([0.0, math.inf, 0.0], (n, 1)),
        "reference": np.tile(np.eye(3), (n, 1, 1)),
    } | rows
    around = Surroundings(G, 2.0, held, SD[1, 0] ** 2, np.array(w_ie_n, float), np.nan, np.zeros(3))
    R, b = np.empty((n, 3, 3)), np.empty((n, 3))
    start = R_nb if start is None else start
    P = np.array([np.diag(sd**2) for sd in SD])
    motions = Motions(tables["outage"], dt, dR, dv, np.zeros((n, 3)), np.tile(DENSITY, (n, 1)))
    aiding = Aiding(tables["dvl"], tables["compass"], tables["reference"])
    reckon_attitude(motions, aiding, LevelStart(np.ascontiguousarray(start), np.zeros(3), P), around, R, b)
    return R, b, true


def at_rest(n: int, sd: float = 0.01) -> np.ndarray:
    return np.tile([0.0, 0.0, 0.0, sd**2], (n, 1))


def test_without_measurements_the_gyro_is_integrated():
    R, b, true = reckoned(matrix_from_rpy([0.1, -0.2, 1.0]), [0.1, -0.2, 0.3], 10, held=math.inf)
    assert_allclose(R, true, atol=1e-12)
    assert not b.any()


def test_pings_at_rest_level_it_and_show_the_horizontal_bias_of_the_gyro():
    bias = np.array([0.004, -0.003, 0.002])
    tilted = matrix_from_rpy([0.05, -0.04, 1.0])
    R, b, _ = reckoned(np.eye(3), n=1500, start=tilted, bias=bias, dvl=at_rest(1500))
    assert_allclose(rpy_from_matrix(R[-1])[:2], 0.0, atol=1e-3)
    assert_allclose(b[-1, :2], bias[:2], atol=1e-4)


def test_pings_do_not_touch_the_bias_of_the_heading_gyro():
    bias = np.array([0.004, -0.003, 0.002])
    R, b, _ = reckoned(np.eye(3), n=500, bias=bias, dvl=at_rest(500))
    turned = np.sum(R[:, 2] * b, axis=1)  # about down
    assert np.abs(turned).max() < 0.01 * np.abs(b[:, :2]).max()
    assert rpy_from_matrix(R[-1])[2] == pytest.approx(bias[2] * DT * 499, rel=0.02)


def test_the_velocity_of_pings_is_told_from_tilt():
    """A vehicle that gains speed stays level: the DVL shows the same acceleration as the accelerometer."""
    n, acceleration = 200, 0.3
    speed = acceleration * DT * np.arange(n)
    dvl = np.column_stack([speed, 0.0 * speed, 0.0 * speed, np.full(n, 1e-4)])

    def tilt(gained: float) -> float:
        R, b = np.empty((n, 3, 3)), np.empty((n, 3))
        dt = np.append(0.0, np.full(n - 1, DT))
        dv = dt[:, None] * np.array([gained, 0.0, -G])
        around = Surroundings(G, 2.0, 1.0, 0.0, np.zeros(3), np.nan, np.zeros(3))
        nothing, same = np.tile([0.0, math.inf, 0.0], (n, 1)), np.tile(np.eye(3), (n, 1, 1))
        P = np.array([np.diag(sd**2) for sd in SD])
        motions = Motions(np.zeros(n, bool), dt, same, dv, np.zeros((n, 3)), np.tile(DENSITY, (n, 1)))
        start = LevelStart(np.eye(3), np.zeros(3), P)
        reckon_attitude(motions, Aiding(dvl, nothing, same), start, around, R, b)
        return float(np.abs(rpy_from_matrix(R)[:, 1]).max())

    assert tilt(acceleration) < 1e-9
    assert tilt(0.0) > 0.5 * acceleration / G  # and is felt where the accelerometer does not show it


def test_a_compass_is_followed_as_the_textbooks_filter_does():
    """Deviation, heading and drift in a Kalman filter of dense matrices, at rest."""
    rng = np.random.default_rng(0)
    n, r = 200, 0.02**2
    seen = 0.2 + 0.02 * rng.standard_normal(n)
    R, b, _ = reckoned(np.eye(3), n=n, held=math.inf, compass=np.column_stack([seen, np.full(n, r), np.zeros(n)]))
    F, H = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, DT], [0.0, 0.0, 1.0]]), np.array([1.0, 1.0, 0.0])
    Q, P, x = np.diag([0.0, *DENSITY[1:]]) * DT, np.diag(SD[1] ** 2), np.zeros(3)
    for k in range(n):
        if k:
            F[0, 0] = np.exp(-abs(DT * x[2]))
            x, P = F @ x, F @ (P + 0.5 * Q) @ F.T + 0.5 * Q
            P[0, 0] += (1.0 - F[0, 0] ** 2) * SD[1, 0] ** 2
        K = P @ H / (H @ P @ H + r)
        x, P = x + K * (seen[k] - H @ x), P - np.outer(K, H @ P)
        assert_allclose(rpy_from_matrix(R[k])[2], x[1], atol=1e-9)
        assert_allclose(b[k], [0.0, 0.0, -x[2]], atol=1e-9)


def test_what_a_compass_deviates_by_is_not_taken_for_heading_where_the_vehicle_turns():
    """After a full turn the gyro's heading is believed, and the compass's error at each heading is not followed."""
    n, rate = 2000, 0.1
    heading = rate * DT * np.arange(n)
    compass = np.column_stack([0.05 * np.sin(heading), np.full(n, 0.005**2), np.zeros(n)])
    _, _, true = reckoned(np.eye(3), [0.0, 0.0, rate], n)
    R, _, _ = reckoned(np.eye(3), [0.0, 0.0, rate], n, held=math.inf, compass=compass, reference=true)
    error = log_rotation(transpose(true) @ R)[n // 2 :, 2]
    assert np.abs(error).max() < 0.025  # half of the deviation


def test_a_heading_far_off_is_turned_to_the_short_way():
    for turn in (3.0, -3.0):
        seen = np.column_stack([np.full(50, turn), np.full(50, 1e-4), np.zeros(50)])
        R, _, _ = reckoned(np.eye(3), n=50, held=math.inf, compass=seen)
        yaw = np.unwrap(rpy_from_matrix(R)[:, 2])
        assert yaw[-1] == pytest.approx(turn, abs=0.1)


def test_the_variance_of_tilt_makes_a_compass_that_needs_it_less_sure():
    first = np.tile([0.0, math.inf, 0.0], (1, 1))
    headings = []
    for by_tilt in (0.0, 9.0):
        first[0] = 0.1, 1e-4, by_tilt
        R, _, _ = reckoned(np.eye(3), n=1, compass=first)
        headings.append(rpy_from_matrix(R[0])[2])
    assert headings[1] < 0.9 * headings[0]


def test_the_earths_rate_is_no_turn_of_the_vehicle():
    w_ie_n = earth_rate_n(1.0)
    R_nb = matrix_from_rpy([0.1, 0.2, 0.5])
    R, _, _ = reckoned(R_nb, n=3000, bias=R_nb.T @ w_ie_n, w_ie_n=w_ie_n, held=math.inf)
    assert np.abs(log_rotation(R_nb.T @ R)).max() < 1e-6
    unaware, _, _ = reckoned(R_nb, n=3000, bias=R_nb.T @ w_ie_n, held=math.inf)
    assert np.abs(log_rotation(R_nb.T @ unaware[-1])).max() > 0.02


def test_during_an_outage_of_the_imu_heading_is_followed_and_tilt_is_kept():
    n = 20
    R, _, _ = reckoned(np.eye(3), [0.3, -0.4, 0.2], n, outage=np.arange(n) > 0, held=math.inf)
    rpy = rpy_from_matrix(R[-1])
    assert_allclose(rpy[:2], 0.0, atol=1e-12)
    step = rpy_from_matrix(exp_rotation(DT * np.array([0.3, -0.4, 0.2])))[2]
    assert rpy[2] == pytest.approx((n - 1) * step)


def test_one_wrong_ping_does_not_tilt_it_by_more_than_a_degree():
    dvl = at_rest(300)
    dvl[200, 0] = 5.0
    R, _, _ = reckoned(np.eye(3), n=300, dvl=dvl)
    assert np.rad2deg(np.abs(rpy_from_matrix(R)[:, :2])).max() < 1.0


def test_without_pings_it_stays_level_by_the_speed_that_it_had():
    bias = np.array([0.001, 0.0, 0.0])
    dvl = at_rest(3000)
    dvl[100:, 3] = math.inf
    R, _, _ = reckoned(np.eye(3), n=3000, bias=bias, dvl=dvl, held=3.6)
    assert np.rad2deg(np.abs(rpy_from_matrix(R)[:, 0])).max() < 5.0  # the gyro by itself is 34 degrees off


@pytest.mark.slow
@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="it is what this test starts")
def test_these_tests_pass_in_plain_python():
    subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-x", str(Path(__file__))],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        check=True,
        capture_output=True,
    )
