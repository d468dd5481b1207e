"""The thesis's filters: their equations, their numbers in our axes, and what a user may do wrong."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from dives import (
    LIVELY,
    Simulated,
    altered,
    attitude_errors,
    changed,
    falcon,
    kept,
    level_log,
    position_errors,
    rms,
    simulated,
    started,
    true_at,
    without,
)
from numpy.testing import assert_allclose
from scipy.linalg import block_diag

from rovgraph.errors import InputError
from rovgraph.geometry import Array, matrix_from_rpy, skew, transpose, wrap_angle
from rovgraph.inference.estimate import RESIDUAL_COLUMNS, Estimate
from rovgraph.inference.trajectory import read_trajectory
from rovgraph.lab.thesis import FILTERS, Filter, FilterJob, run_filter, run_filters
from rovgraph.lab.thesis import core as quat
from rovgraph.lab.thesis.measurements import Accelerometer, DvlModel, Mti, Ping, reference_field
from rovgraph.lab.thesis.processes import (
    ConstantAcceleration,
    HydrodynamicModel,
    KnownAttitude,
    KnownMotion,
    Process,
    length,
)
from rovgraph.lab.thesis.run import Recursion, timetable
from rovgraph.lab.thesis.setup import Setup, prepare
from rovgraph.log import Log, Stream, read_log
from rovgraph.model import thesis
from rovgraph.model.config import Config, beliefs, load_config, mount_matrix
from rovgraph.model.state import POSE, State
from rovgraph.sensors import MagneticField
from rovgraph.sensors.instruments import hydrodynamics, instruments
from rovgraph.simulate import CALM, Motion, Style
from rovgraph.simulate.dive import specific_force_and_rate

FULL = [name for name, f in FILTERS.items() if not f.attitude_given]
WITHOUT_THRUSTERS = [name for name in FILTERS if name != "4.2"]
CONFIG = falcon()
QUICK = Style(rest=2.0, smoothing=1.0, turning=1.0, waves=CALM)


def differences(function, x: Array, step: float = 1e-6) -> Array:
    """Central differences, shape (m, n)."""
    return np.column_stack([(function(x + d) - function(x - d)) / (2.0 * step) for d in step * np.eye(len(x))])


def any_state(places, seed: int = 0) -> Array:
    """A state far from zero, its quaternion of unit length."""
    x = np.random.default_rng(seed).normal(size=length(places))
    if "q" in places:
        x[places["q"]] = quat.unit(x[places["q"]])
    return x


def any_known(n: int = 3) -> KnownMotion:
    rng = np.random.default_rng(5)
    return KnownMotion(matrix_from_rpy(rng.normal(size=(n, 3))), rng.normal(size=(n, 3)), "a draw")


# ---------------------------------------------------------------------------- equations


def test_quaternion_and_its_rate_are_those_of_a_rotation():
    q = quat.unit(np.random.default_rng(1).normal(size=4))
    w, dt = np.array([0.3, -0.2, 0.5]), 1e-6
    R = quat.matrix(q)
    assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    assert_allclose(np.abs(quat.from_matrix(R) @ q), 1.0, atol=1e-14)
    ahead = quat.matrix(q + 0.5 * dt * quat.rate_matrix(q) @ w)
    assert_allclose((ahead - R) / dt, R @ skew(w), atol=1e-5)
    assert_allclose(2.0 * quat.rate_matrix(q).T @ (0.5 * quat.rate_matrix(q)), np.eye(3), atol=1e-14)


@pytest.mark.parametrize("inverse", [False, True])
def test_slope_of_a_turn_is_its_derivative(inverse):
    left = matrix_from_rpy([0.3, -0.8, 2.0])
    turn, q = quat.ConstantTurn(inverse, left), np.array([0.4, -0.3, 0.7, 0.6])
    assert_allclose(turn(q)[1].reshape(9, 4), differences(lambda q: turn(q)[0].ravel(), q), atol=1e-9)
    R = quat.matrix(quat.unit(q))
    assert_allclose(turn(quat.unit(q))[0], left @ (R.T if inverse else R), atol=1e-14)


def a_process(name: str, **switches) -> Process:
    variant, known = replace(FILTERS[name], **switches), any_known()
    if variant.motion == "hydrodynamic":
        return HydrodynamicModel(variant, known, hydrodynamics(CONFIG), np.full((3, 3), 30.0))
    return KnownAttitude(variant, known) if variant.attitude_given else ConstantAcceleration(variant)


PROCESSES = [(name, {}) for name in FILTERS] + [("4.3a", {"coriolis": "exact"}), ("4.5", {"coriolis": "exact"})]


@pytest.mark.parametrize(("name", "switches"), PROCESSES)
@pytest.mark.parametrize("dt", [0.01, 0.3])
def test_process_jacobians_are_derivatives(name, switches, dt):
    process = a_process(name, **switches)
    x = any_state(process.layout)
    _, F = process.step(x, dt, 1)
    assert_allclose(F, differences(lambda x: process.step(x, dt, 1)[0], x), atol=1e-8)


def test_constant_acceleration_in_b_is_2_9_and_in_n_is_2_8():
    dt = 0.01
    for name in ("4.3a", "4.4a"):
        process = a_process(name)
        s, x = process.layout, any_state(process.layout)
        rate = (process.step(x, dt, 0)[0] - x) / dt
        a, v, w, q = (x[s[part]] for part in ("a", "v", "w", "q"))
        body = name == "4.3a"
        assert_allclose(rate[s["a"]], -np.cross(w, a) if body else np.zeros(3), atol=1e-12)
        assert_allclose(rate[s["v"]], a - np.cross(w, v) if body else a, atol=1e-12)
        assert_allclose(rate[s["p"]], quat.matrix(q) @ v if body else v, atol=1e-12)
        assert_allclose(rate[s["q"]], 0.5 * quat.rate_matrix(q) @ w, atol=1e-12)
        assert not rate[s["w"]].any() and not rate[s["mag_bias"]].any()


def test_hydrodynamic_update_is_4_2():
    known, vehicle, force = any_known(), hydrodynamics(CONFIG), np.array([[20.0, -5.0, 9.0]] * 3)
    process = HydrodynamicModel(FILTERS["4.2"], known, vehicle, force)
    v, dt = np.array([0.4, -0.2, 0.1]), 0.01
    M, w = np.diag(vehicle.mass), known.w_b[1]
    drag = -(np.array([42.0, 180.0, 90.0]) + np.array([140.0, 55.0, 400.0]) * np.abs(v)) * v
    expected = v + dt * np.linalg.solve(M, force[1] + drag - np.cross(w, M @ v))
    x, _ = process.step(np.concatenate([v, np.zeros(3)]), dt, 1)
    assert_allclose(np.diag(M), 73.3 + np.array([27.0, 30.0, 110.0]))
    assert_allclose(x, np.concatenate([expected, dt * known.R_nb[1] @ v]), atol=1e-14)


def the_mti(name: str, config: Config = CONFIG) -> tuple[Mti, dict[str, slice]]:
    process = ConstantAcceleration(FILTERS[name])
    field_n = reference_field(instruments(config)["mag"], beliefs(config))
    mount, arm = mount_matrix(config.imu.mount_rpy_deg), np.array(config.imu.lever_arm_m)
    return Mti(FILTERS[name].motion == "body", process.layout, mount, arm, 9.81, field_n), process.layout


@pytest.mark.parametrize("name", ["4.3a", "4.4a", "4.5"])
@pytest.mark.parametrize("mount", [(176.6, 1.2, 0.0), (0.0, 0.0, 0.0)])
def test_mti_jacobian_is_its_derivative(name, mount):
    model, places = the_mti(name, changed(CONFIG, imu={"mount_rpy_deg": mount}))
    model(any_state(places, seed=3), 0)  # what an earlier call leaves behind must not matter
    x = any_state(places)
    assert_allclose(model(x, 0)[1], differences(lambda x: model(x, 0)[0], x), atol=1e-7)


@pytest.mark.parametrize("name", ["4.3a", "4.4a"])
def test_lean_mti_equals_the_shared_sensor_models(name):
    """Prediction and derivative by attitude of the field; specific force and rate as the simulator samples them."""
    config = changed(
        CONFIG,
        calibration={"mag_offset": {"mean_deg": 3.0}, "field_dip": {"mean_deg": -2.0}},
    )
    model, places = the_mti(name, config)
    shared = instruments(config)["mag"].model
    assert isinstance(shared, MagneticField)
    for seed in range(5):
        x = any_state(places, seed)
        q, w = x[places["q"]], x[places["w"]]
        x[places["acc_bias"]] = x[places["gyr_bias"]] = x[places["mag_bias"]] = 0.0
        R = quat.matrix(q)
        means = {n: b.mean for n, b in beliefs(config).items()}
        state = State(R[None], np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 6)), means)
        z, J = shared.predict(state, w[None])
        h, H = model(x, 0)
        assert_allclose(h[6:], z[0], atol=1e-9)
        assert_allclose(H[6:, places["q"]] @ (0.5 * quat.rate_matrix(q)), J[POSE][0, :, :3], atol=1e-9)
        a_n = R @ x[places["a"]] if name == "4.3a" else x[places["a"]]
        none = np.zeros((1, 3))
        motion = Motion(np.zeros(1), R[None], none, none, a_n[None], w[None], none)
        force_rate = specific_force_and_rate(motion, config)[0]
        R_sb = mount_matrix(config.imu.mount_rpy_deg).T
        assert_allclose(h[:6], np.concatenate([R_sb @ force_rate[:3], R_sb @ force_rate[3:]]), atol=1e-9)


def test_accelerometer_of_4_1_is_that_of_the_whole_mti():
    known = any_known()
    process = KnownAttitude(FILTERS["4.1"], known)
    mount, arm = mount_matrix(CONFIG.imu.mount_rpy_deg), np.array(CONFIG.imu.lever_arm_m)
    model = Accelerometer(process.layout, mount, arm, 9.81, known)
    whole, places = the_mti("4.3a")
    x = any_state(process.layout)
    full = np.zeros(length(places))
    for part in ("a", "acc_bias"):
        full[places[part]] = x[process.layout[part]]
    full[places["q"]], full[places["w"]] = quat.from_matrix(known.R_nb[2]), known.w_b[2]
    assert_allclose(model(x, 2)[0], whole(full, 0)[0][:3], atol=1e-12)
    assert_allclose(model(x, 2)[1], differences(lambda x: model(x, 2)[0], x), atol=1e-8)


@pytest.mark.parametrize("mount_in_heading", [True, False])
@pytest.mark.parametrize("name", FILTERS)
def test_dvl_jacobian_is_its_derivative(name, mount_in_heading):
    variant, process = FILTERS[name], a_process(name)
    known = any_known() if variant.attitude_given else None
    config = changed(CONFIG, calibration={"dvl_compass_deviation": {"mean_deg": (2.0, -1.0)}})
    sensors, body = instruments(config), variant.motion != "earth"
    dvl = DvlModel(process.layout, body, sensors, beliefs(config), known, mount_in_heading)
    x = any_state(process.layout)
    h, H = dvl(x, 1, variant.compass)
    numeric = differences(lambda x: h + wrap_angle(dvl(x, 1, variant.compass)[0] - h), x)
    assert_allclose(H, numeric, atol=1e-7)


# ---------------------------------------------------------------- the thesis's own axes


def naive_filter(setup: Setup, steps: int) -> tuple[Array, Array, Array]:
    """(4.3) as printed, forward-port-up body, quaternion to north-west-up; numerical Jacobians.

    Nothing of the package's filters is used but the start and the samples.

    Returns
    -------
    position and velocity in n, R_nb
    """
    flip = thesis.FLIP
    R_sb = {k: matrix_from_rpy(v).T for k, v in (("mti", thesis.THETA_MTI), ("dvl", thesis.THETA_DVL))}
    declination, dip = np.deg2rad([4.5, 72.0])
    H_n = np.array([np.cos(dip) * np.cos(declination), np.cos(dip) * np.sin(declination), np.sin(dip)])
    Q = np.zeros(25)
    Q[:3], Q[9:12], Q[16:19], Q[19:22], Q[22:] = 2.5e-4, 2.5e-5, 2.5e-6, 7.6e-9, 8e-9

    def R_wb(q):
        S = skew(q[1:])
        return np.eye(3) + 2.0 * q[0] * S + 2.0 * S @ S

    def f(x, dt):
        a, v, p, w, q = x[:3], x[3:6], x[6:9], x[9:12], x[12:16]
        T = np.array([-q[1:], *(q[0] * np.eye(3) + skew(q[1:]))])
        dq = 0.5 * dt * T @ w
        parts = a - dt * np.cross(w, a), v + dt * (a - np.cross(w, v)), p + dt * flip @ R_wb(q) @ v, w, q + dq, x[16:]
        return np.concatenate(parts)

    def mti(x):
        a, w, q = x[:3], x[9:12], x[12:16]
        R_bn, r = (flip @ R_wb(q)).T, thesis.LEVER_ARM_MTI
        force = a + np.cross(w, np.cross(w, r)) - R_bn @ np.array([0.0, 0.0, 9.81])
        return np.concatenate([R_sb["mti"] @ force, R_sb["mti"] @ w, R_sb["mti"] @ R_bn @ H_n]) + x[16:]

    def dvl(x):
        v, w, q = x[3:6], x[9:12], x[12:16]
        along = R_wb(q / np.linalg.norm(q)) @ R_sb["dvl"][0]  # no slope along the length of q
        heading = -np.arctan2(along[1], along[0]) - declination
        return np.concatenate([R_sb["dvl"] @ (v + np.cross(w, thesis.LEVER_ARM_DVL)), [heading]])

    def updated(x, P, h, z, R):
        H, nu = differences(h, x), z - h(x)
        nu = np.concatenate([nu[:3], wrap_angle(nu[3:])]) if len(nu) == 4 else nu
        K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
        x, P = x + K @ nu, P - K @ H @ P
        x[12:16] /= np.linalg.norm(x[12:16])
        return x, 0.5 * (P + P.T)

    turn = block_diag(flip, flip, np.eye(3), flip, np.diag([1.0, 1.0, -1.0, -1.0]), np.eye(9))
    x, P = turn @ setup.x, turn @ setup.P @ turn.T
    times, pings = setup.log["imu"].time[:steps], list(setup.pings)
    now = times[0]

    def advanced(x, P, dt):
        F = differences(lambda x: f(x, dt), x)
        return f(x, dt), F @ P @ F.T + np.diag(Q * dt / 0.01)

    for time_of, z in zip(times, setup.samples, strict=False):
        while pings and pings[0].time < time_of:
            ping = pings.pop(0)
            x, P = advanced(x, P, ping.time - now)
            x, P = updated(x, P, dvl, ping.z, thesis.R_DVL)
            now = ping.time
        x, P = advanced(x, P, time_of - now) if time_of > now else (x, P)
        x, P = updated(x, P, mti, z, thesis.R_MTI)
        now = time_of
    R_nb_port_up = flip @ R_wb(x[12:16])
    return x[6:9], R_nb_port_up @ x[3:6], R_nb_port_up @ flip


def test_motion_is_the_same_as_in_the_thesis_own_axes_with_the_printed_numbers():
    """Mountings, lever arms, noise and gravity of rovgraph/model/falcon.yaml are the thesis's, converted."""
    case, begin, steps = lively_dive(), 10.0, 120
    log = case.log
    for sensor in log.streams:
        log = kept(log, sensor, (log[sensor].time >= begin) & (log[sensor].time < begin + steps / 100.0))
    setup = prepare(FILTERS["4.3a"], log, started(case))
    done = Recursion(setup)
    done.run()
    p_n, v_n, R_nb = naive_filter(setup, steps)
    s = setup.places
    R = quat.matrix(done.x[s["q"]])
    assert np.linalg.norm(v_n) > 0.05, "the vehicle moves"
    assert_allclose(done.x[s["p"]], p_n, atol=1e-6)
    assert_allclose(R @ done.x[s["v"]], v_n, atol=1e-6)
    assert_allclose(R, R_nb, atol=1e-6)


# -------------------------------------------------------------------------- behaviour


@cache
def clean_dive(path: str) -> Simulated:
    """No noise, no waves; attitude of the unit itself too."""
    return simulated(falcon(), 40.0, path=path, style=QUICK, noise=False, ahrs_rate=100.0)


@pytest.mark.parametrize("path", ["straight", "circle"])
@pytest.mark.parametrize("name", WITHOUT_THRUSTERS)
def test_clean_dive_is_recovered(name, path):
    """To Euler's half step at that speed, a few times over: 0.3 m/s and 5 ms are 1.5 mm."""
    case = clean_dive(path)
    estimate = run_filter(name, case.log, started(case))
    truth = true_at(case, estimate.trajectory.time)
    assert case.truth.distance > 8.0
    assert position_errors(estimate.trajectory, case).max() < 0.01
    assert np.abs(estimate.trajectory.v_n - truth.v_n).max() < 0.005


def test_what_waves_do_to_a_clean_dive_is_the_angular_acceleration_that_3_1_neglects():
    """Roll at the MTi's lever arm is felt as acceleration, and becomes bias, tilt and heading."""
    worst = {}
    for arm in (CONFIG.imu.lever_arm_m, (0.0, 0.0, 0.0)):
        config = falcon(imu={"lever_arm_m": list(arm)})
        case = simulated(config, 40.0, path="circle", style=replace(QUICK, waves=LIVELY.waves), noise=False)
        trajectory = run_filter("4.3c", case.log, started(case)).trajectory
        worst[arm] = np.abs(attitude_errors(trajectory, case)).max()
    assert worst[CONFIG.imu.lever_arm_m] > 5.0 * worst[0.0, 0.0, 0.0]


@cache
def lively_dive() -> Simulated:
    return simulated(falcon(), 30.0, seed=4, style=replace(QUICK, waves=LIVELY.waves), ahrs_rate=100.0)


@cache
def estimated(name: str) -> Estimate:
    case = lively_dive()
    return run_filter(name, case.log, started(case))


@pytest.mark.parametrize("name", WITHOUT_THRUSTERS)
def test_estimate_is_complete(name):
    estimate, log = estimated(name), lively_dive().log
    assert estimate.kind == name
    assert list(estimate.residuals.columns) == RESIDUAL_COLUMNS
    assert np.isin(np.round(log["dvl"].time, 6), np.round(estimate.trajectory.time, 6)).all()
    assert estimate.trajectory.time[-1] == log["imu"].time[-1]
    assert (np.diff(estimate.trajectory.time) > 0).all()
    t = estimate.trajectory
    for covariance in (t.cov_p, t.cov_v) if FILTERS[name].attitude_given else (t.cov_p, t.cov_v, t.cov_theta):
        assert (np.linalg.eigvalsh(covariance) > 0).all()
    seen = set(zip(estimate.residuals["sensor"], estimate.residuals["component"], strict=True))
    f = FILTERS[name]
    assert (("mag", "x") in seen) == f.magnetometer
    assert (("dvl_heading", "heading") in seen) == f.compass
    assert (("imu", "acc_x") in seen) == f.accelerometer
    assert (("imu", "gyr_x") in seen) == (not f.attitude_given)


@pytest.mark.parametrize("name", FULL)
def test_quaternion_stays_unit_and_covariance_symmetric_and_positive(name):
    case = lively_dive()
    done = Recursion(prepare(FILTERS[name], case.log, started(case)))
    done.run()
    for _, _, x, P in done.kept:
        assert abs(np.linalg.norm(x[done.setup.places["q"]]) - 1.0) < 1e-12
        assert (P == P.T).all()
        scale = np.sqrt(np.diag(P))
        assert (scale > 0).all()
        assert np.linalg.eigvalsh(P / np.outer(scale, scale)).min() > -1e-9  # one direction of q is known exactly


def test_covariances_in_n_are_those_of_differences():
    """cov_v and cov_theta of a body-frame filter, against samples of its state."""
    case = lively_dive()
    done = Recursion(prepare(FILTERS["4.3a"], case.log, started(case)))
    done.run()
    trajectory, s = estimated("4.3a").trajectory, done.setup.places
    _, _, x, P = done.kept[40]
    R = quat.matrix(x[s["q"]])
    J_v = differences(lambda x: quat.matrix(x[s["q"]]) @ x[s["v"]], x)
    pick = ([2, 0, 1], [1, 2, 0])  # of a small rotation R(x + dx) R'
    J_theta = differences(lambda x: (quat.matrix(quat.unit(x[s["q"]])) @ R.T)[pick], x)
    assert_allclose(trajectory.cov_v[40], J_v @ P @ J_v.T, rtol=1e-5, atol=1e-12)
    assert_allclose(trajectory.cov_theta[40], J_theta @ P @ J_theta.T, rtol=1e-5, atol=1e-12)


def own_dive(variant: Filter, seconds: float, rng: np.random.Generator) -> Setup:
    """A setup whose samples and pings come from the filter's own model, noise and start."""
    start = {"heading_deg": 30.0, "roll_deg": 0.0, "pitch_deg": 0.0, "heading_sd_deg": 1.0, "tilt_sd_deg": 0.5}
    config = falcon(start=start, calibration={f"dvl_{angle}": {"sd_deg": 0.1} for angle in ("roll", "pitch", "yaw")})
    time_of_pings = np.arange(0.1234, seconds, 0.18)
    n = len(time_of_pings)
    log = level_log(
        seconds,
        np.array([0.0, 0.0, 9.81]),
        np.zeros(3),
        dvl=(time_of_pings, np.tile([0.0, 0.0, 0.0, 1.0, np.nan], (n, 1))),
        dvl_heading=(time_of_pings, np.zeros((n, 1))),
        mag=(np.array([0.0, 0.01]), np.tile([0.3, 0.0, -0.95], (2, 1))),
    )
    setup = prepare(variant, log, config)
    x = rng.multivariate_normal(setup.x, setup.P, method="eigh")
    if "q" in setup.places:
        x[setup.places["q"]] = quat.unit(x[setup.places["q"]])
    noisy = np.random.default_rng(rng.integers(1 << 30)).multivariate_normal
    samples, pings, now = np.zeros((len(log["imu"]), 9)), list(setup.pings), 0.0
    noise_imu = noisy(np.zeros(9), thesis.R_MTI, len(samples))
    noise_dvl = noisy(np.zeros(4), thesis.R_DVL, len(pings))
    done: list[Ping] = []

    def advance(x: Array, dt: float) -> Array:
        walk = np.sqrt(dt * setup.process.noise(x)) * rng.standard_normal(len(x))
        return setup.process.step(x, dt, 0)[0] + walk

    for k, time_of in enumerate(log["imu"].time):
        while len(done) < len(pings) and pings[len(done)].time < time_of:
            ping = pings[len(done)]
            x, now = advance(x, ping.time - now), ping.time
            z = setup.dvl(x, 0, True)[0] + noise_dvl[len(done)]
            done.append(replace(ping, z=z[list(ping.rows)]))
        x, now = advance(x, time_of - now) if time_of > now else x, time_of
        x[setup.places["q"]] = quat.unit(x[setup.places["q"]])
        samples[k] = setup.imu(x, 0)[0] + noise_imu[k]
    used = setup.R_imu.shape[0]
    return replace(setup, samples=samples[:, :used], pings=done)


def mean_squares(variant: Filter, believed: Filter, seeds: int) -> dict[str, tuple[float, int]]:
    """Mean square of the normalised innovations of IMU and DVL, and how many there are."""
    found: dict[str, list[Array]] = {"imu": [], "dvl": []}
    for seed in range(seeds):
        setup = own_dive(variant, 10.0, np.random.default_rng([seed, 77]))
        used = setup.R_imu.shape[0]
        done = Recursion(replace(setup, R_imu=believed.numbers.R_mti[:used, :used], R_dvl=believed.numbers.R_dvl))
        done.run()
        found["imu"] += done.imu.normalised
        found["dvl"] += done.dvl.normalised
    return {k: (float(np.mean(np.concatenate(v) ** 2)), sum(map(len, v))) for k, v in found.items()}


@pytest.mark.parametrize("name", ["4.3a", "4.3b", "4.3c", "4.4a", "4.5"])
def test_innovations_are_consistent_where_the_thesis_assumptions_hold(name):
    """Mean NIS per dimension within four of its standard deviations, sqrt(2 / count)."""
    for sensor, (mean, count) in mean_squares(FILTERS[name], FILTERS[name], 4).items():
        assert abs(mean - 1.0) < 4.0 * np.sqrt(2.0 / count), sensor


def test_wrong_noise_is_seen_in_the_innovations():
    wrong = FILTERS["4.3a"].with_numbers(R_mti=1.3 * thesis.R_MTI, R_dvl=2.0 * thesis.R_DVL)
    for sensor, (mean, count) in mean_squares(FILTERS["4.3a"], wrong, 4).items():
        assert abs(mean - 1.0) > 4.0 * np.sqrt(2.0 / count), sensor


@pytest.mark.parametrize("noise", [False, True])
@pytest.mark.parametrize("variant", [*(pytest.param(v, marks=pytest.mark.slow) for v in "ab"), "c"])
def test_body_and_earth_frame_agree_when_nothing_turns(variant, noise):
    """Linearised at the true motion; at their own estimates noise sets them apart, where heading is ill known."""
    means = {name: belief.mean for name, belief in beliefs(CONFIG).items()}
    case = simulated(falcon(), 25.0, path="straight", style=QUICK, calibration=means, noise=noise)
    pair = [replace(FILTERS[f"{s}{variant}"], linearized_at="truth" if noise else "estimate") for s in ("4.3", "4.4")]
    body, earth = (run_filter(f, case.log, started(case), truth=case.truth).trajectory for f in pair)
    assert np.abs(body.p_n - earth.p_n).max() < 0.02 * body.p_sd[-1].max()
    assert_allclose(body.cov_p, earth.cov_p, atol=0.02 * body.cov_p.max())


def test_misalignment_moves_and_becomes_better_known():
    case = lively_dive()
    estimate = estimated("4.5")
    nominal = beliefs(case.config)
    for name in ("dvl_roll", "dvl_pitch", "dvl_yaw"):
        history = estimate.history[name]
        assert abs(history.value[0, 0] - nominal[name].mean[0]) < nominal[name].sd
        assert np.ptp(history.value) > history.sd[-1, 0]
        assert history.sd[-1, 0] < 0.5 * nominal[name].sd
    rows = {c.label: c for c in estimate.calibration}
    assert rows["dvl_yaw"].estimated and rows["dvl_yaw"].value == estimate.history["dvl_yaw"].value[-1, 0]
    assert "dvl_yaw" not in estimated("4.3a").history


def test_field_may_be_in_any_unit():
    case = lively_dive()
    scaled = altered(case.log, "mag", 48.0 * case.log["mag"].data)
    other = run_filter("4.3c", scaled, started(case))
    same = estimated("4.3c")
    assert_allclose(other.trajectory.p_n, same.trajectory.p_n, atol=1e-6)
    mag = other.residuals[other.residuals["sensor"] == "mag"]
    assert_allclose(mag["measured"] - mag["predicted"], mag["innovation"], atol=1e-9)
    assert mag["measured"].abs().max() > 10.0


def test_same_motion_at_half_the_rate_of_the_imu():
    """Intervals longer than Euler bears are divided."""
    case = clean_dive("circle")
    half = kept(case.log, "imu", np.arange(len(case.log["imu"])) % 2 == 0)
    estimate = run_filter("4.4a", half, started(case))
    assert position_errors(estimate.trajectory, case).max() < 0.02


# ---------------------------------------------------------------------------- switches


def test_exact_coriolis_keeps_the_speed_that_euler_lets_grow():
    x = np.zeros(25)
    places = ConstantAcceleration(FILTERS["4.3a"]).layout
    x[places["v"]], x[places["w"]], x[places["q"]] = [0.5, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0]
    speeds = {}
    for kind in ("euler", "exact"):
        process, state = a_process("4.3a", coriolis=kind), x.copy()
        for _ in range(1000):
            state, _ = process.step(state, 0.01, 0)
        speeds[kind] = np.linalg.norm(state[places["v"]])
    assert_allclose(speeds["exact"], 0.5, atol=1e-12)
    assert_allclose(speeds["euler"], 0.5 * (1.0 + 0.01**2) ** 500, atol=1e-9)


def test_frame_of_the_noise_matters_only_where_axes_differ():
    case = lively_dive()
    config, isotropic = started(case), FILTERS["4.4a"]
    same = run_filter(replace(isotropic, noise_frame="body"), case.log, config)
    assert_allclose(same.trajectory.p_n, estimated("4.4a").trajectory.p_n, atol=0)
    uneven = isotropic.with_numbers(acceleration=(1e-3, 1e-5, 1e-5))
    Q = ConstantAcceleration(replace(uneven, noise_frame="body")).noise(np.eye(25)[12])[:3, :3]
    assert_allclose(Q, np.diag([0.1, 1e-3, 1e-3]), atol=1e-15)
    yawed = np.zeros(25)
    yawed[12:16] = quat.from_matrix(matrix_from_rpy([0.0, 0.0, 0.5 * np.pi]))
    Q = ConstantAcceleration(replace(uneven, noise_frame="body")).noise(yawed)[:3, :3]
    assert_allclose(Q, np.diag([1e-3, 0.1, 1e-3]), atol=1e-15)
    estimate = run_filter(replace(uneven, noise_frame="body"), case.log, config)
    assert np.abs(estimate.trajectory.p_n - same.trajectory.p_n).max() > 1e-4


@pytest.mark.parametrize("switch", [{"iterations": 3}, {"linearized_at": "truth"}, {"coriolis": "exact"}])
@pytest.mark.parametrize("name", [pytest.param("4.3a", marks=pytest.mark.slow), "4.4a"])
def test_switches_change_little_where_all_is_well_known(name, switch):
    case = lively_dive()
    variant = replace(FILTERS[name], **switch)
    other = run_filter(variant, case.log, started(case), truth=case.truth).trajectory
    same = estimated(name).trajectory
    assert np.abs(other.p_n - same.p_n).max() < same.p_sd[-1].max()
    if name == "4.3a" or "coriolis" not in switch:
        assert (other.p_n != same.p_n).any()


def test_switches_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="attitude given"):
        replace(FILTERS["4.1"], compass=True)
    with pytest.raises(ValueError, match="R_mti"):
        FILTERS["4.3a"].with_numbers(R_mti=np.eye(6))
    case = lively_dive()
    with pytest.raises(ValueError, match="truth"):
        run_filter(replace(FILTERS["4.3a"], linearized_at="truth"), case.log, case.config)


# ------------------------------------------------------------------------------- 4.2


def thruster_dive(seconds: float = 40.0) -> tuple[Log, Array]:
    """A level dive driven by thrusters through (4.2), and its true final position."""
    vehicle, dt = hydrodynamics(CONFIG), 0.01
    n = int(seconds / dt) + 1
    t = np.round(dt * np.arange(n), 4)
    push = np.round(30.0 * np.sin(2.0 * np.pi * t / 20.0))
    signals = np.column_stack([push + 20.0, push + 20.0, push + 20.0, push + 20.0, 10.0 * np.ones(n)])
    force = vehicle.force_and_moment(signals)[0]
    v, p, speeds = np.zeros(3), np.zeros(3), np.zeros((n, 3))
    R = matrix_from_rpy([0.0, 0.0, 0.5])
    for k in range(n):
        speeds[k] = v
        p = p + dt * R @ v if k < n - 1 else p
        v = v + dt * vehicle.acceleration(v, np.zeros(3), force[k])[0]
    R_s = mount_matrix(CONFIG.dvl.mount_rpy_deg)
    every = slice(0, n, 20)
    imu = mount_matrix(CONFIG.imu.mount_rpy_deg).T @ np.array([0.0, 0.0, -9.81])
    rpy = np.zeros((n, 3))
    tilt = matrix_from_rpy([0.0, 0.0, 0.5]) @ mount_matrix(CONFIG.imu.mount_rpy_deg)
    rpy[:] = [
        np.arctan2(tilt[1, 0], tilt[0, 0]) - np.deg2rad(4.5),
        np.arctan2(tilt[2, 1], tilt[2, 2]),
        -np.arcsin(tilt[2, 0]),
    ]
    velocity = np.hstack([speeds @ R_s, np.ones((n, 1)), np.full((n, 1), np.nan)])
    log = level_log(seconds, imu, np.zeros(3), dvl=(t[every], velocity[every]), ahrs=(t, rpy))
    columns = tuple(f"thruster_{i + 1}" for i in range(5))
    thrusters = Stream("thruster", columns, t, signals, np.arange(n) + 2)
    return Log(log.source, {**log.streams, "thruster": thrusters}), p


def test_thrusters_carry_4_2_through_a_silence_of_the_dvl():
    log, p = thruster_dive()
    config = changed(CONFIG, start={"heading_deg": float(np.rad2deg(0.5))})
    early = kept(log, "dvl", log["dvl"].time < 10.0)
    estimate = run_filter("4.2", early, config)
    assert np.linalg.norm(p) > 3.0
    assert_allclose(estimate.trajectory.p_n[-1], p, atol=1e-3)
    still = altered(early, "thruster", np.zeros_like(log["thruster"].data))
    assert np.linalg.norm(run_filter("4.2", still, config).trajectory.p_n[-1] - p) > 1.0


# ------------------------------------------------------------------------ side by side


def test_a_timetable_has_each_sample_and_ping_once_and_in_order():
    rng = np.random.default_rng(3)
    samples = [0.01 * np.arange(n) for n in (300, 150, 40)]
    pings = [np.sort(rng.uniform(0.0, s[-1], n)) for s, n in zip(samples, (17, 3, 0), strict=True)]
    pings[0][4], pings[1][-1] = samples[0][50], samples[1][-1]  # at a sample's time, and at the very end
    pings[0].sort()
    table = timetable(samples, pings, [0.5, 0.1, 10.0])
    for b, (s, p) in enumerate(zip(samples, pings, strict=True)):
        own = np.flatnonzero(table.active[:, b])
        assert table.ends[b] == own[-1] + 1
        seen, is_ping = table.time[own, b], table.ping[own]
        assert_allclose(seen[~is_ping], s, atol=0)
        assert_allclose(seen[is_ping], p, atol=0)
        assert (table.number[own, b][is_ping] == np.arange(len(p))).all()
        order = np.lexsort((is_ping, seen))
        assert (order == np.arange(len(own))).all(), "a sample comes before a ping of its time"
        assert (s[table.epoch[own, b]] <= seen).all() and (table.epoch[own, b][~is_ping] == np.arange(len(s))).all()
        assert (np.diff(table.time[:, b]) >= 0.0).all() and not np.diff(table.time[:, b])[~table.active[1:, b]].any()
        kept_at = seen[table.keeps_state[own, b]]
        assert (np.diff(kept_at) > 0.0).all() and set(p) <= set(kept_at) and {s[0], s[-1]} <= set(kept_at)
        assert np.diff(kept_at).max() <= (0.5, 0.1, 10.0)[b] + 0.011
    samples_alone = timetable(samples[:1], [np.zeros(0)], [0.5])
    assert samples_alone.active.all() and len(samples_alone.ping) == 300


def assert_same(one: Estimate, other: Estimate) -> None:
    """To the last bit: what comes of a filter does not depend on its company."""
    assert one.kind == other.kind and one.summary == other.summary
    for name in ("time", "p_n", "v_n", "R_nb", "cov_p", "cov_v", "cov_theta"):
        assert_allclose(getattr(one.trajectory, name), getattr(other.trajectory, name), rtol=0, atol=0)
    pd.testing.assert_frame_equal(one.residuals, other.residuals, check_exact=True)
    assert one.history.keys() == other.history.keys()


def dives_of_many_kinds() -> list[tuple[Log, Config]]:
    """Of different length and rate; the DVL silent or without lock, the magnetometer slow, other mountings."""
    case = lively_dive()
    config, log = started(case), case.log
    short = kept(log, "imu", log["imu"].time < 12.0)
    dvl = log["dvl"].data.copy()
    dvl[(log["dvl"].time > 4.0) & (log["dvl"].time < 9.0), 3] = 0.0
    silent = kept(kept(log, "dvl", log["dvl"].time > 10.0), "dvl_heading", log["dvl_heading"].time > 10.0)
    half = kept(log, "imu", (np.arange(len(log["imu"])) % 2 == 0) & (log["imu"].time < 9.0))
    slow = kept(short, "mag", np.arange(len(log["mag"])) % 7 == 0)
    other = changed(
        config,
        imu={"lever_arm_m": (0.0, 0.0, 0.0), "mount_rpy_deg": (0.0, 0.0, 0.0)},
        dvl={"lever_arm_m": (0.1, 0.0, 0.2)},
        environment={"declination_deg": 2.0, "gravity_mps2": 9.82},
        vehicle={"mass_kg": 80.0},
        calibration={"dvl_yaw": {"mean_deg": -40.0}, "dvl_scale": {"mean": 0.01}},
    )
    return [(short, config), (altered(short, "dvl", dvl), config), (silent, config), (half, config), (slow, other)]


@pytest.mark.slow
@pytest.mark.parametrize("names", ["4.1", "4.1-no-accelerometer", "4.3a 4.3b 4.3c", "4.4a 4.4b 4.4c", "4.5"])
def test_filters_side_by_side_do_what_each_does_alone(names):
    asked = [FilterJob(FILTERS[name], *dive) for dive in dives_of_many_kinds() for name in names.split()]
    for each, together in zip(asked, run_filters(asked), strict=True):
        assert isinstance(together, Estimate)
        assert_same(together, run_filter(each.variant, each.log, each.config))


@pytest.mark.slow
@pytest.mark.parametrize("switch", [{"iterations": 3}, {"linearized_at": "truth"}, {"coriolis": "exact"}])
def test_filters_with_switches_do_so_too(switch):
    case = lively_dive()
    log = kept(case.log, "imu", case.log["imu"].time < 8.0)
    loud = FILTERS["4.3c"].with_numbers(acceleration=(1e-3, 1e-5, 1e-5))
    variants = [replace(f, noise_frame="earth", **switch) for f in (FILTERS["4.3a"], FILTERS["4.3b"], loud)]
    asked = [FilterJob(f, log, started(case), case.truth) for f in variants]
    for each, together in zip(asked, run_filters(asked), strict=True):
        assert isinstance(together, Estimate)
        alone = run_filter(each.variant, each.log, each.config, each.truth)
        if each.variant.numbers is loud.numbers:
            assert_same(together, alone)
        else:  # noise of equal variances is turned along, which changes its last bit
            assert_allclose(together.trajectory.p_n, alone.trajectory.p_n, atol=1e-9)


def test_vehicles_side_by_side_do_what_each_does_alone():
    log, _ = thruster_dive(20.0)
    config = changed(CONFIG, start={"heading_deg": float(np.rad2deg(0.5))})
    heavy = changed(config, vehicle={"mass_kg": 90.0, "drag_linear": (50.0, 150.0, 80.0)})
    asked = [
        FilterJob(FILTERS["4.2"], kept(log, "imu", log["imu"].time < end), c) for end, c in ((9, heavy), (20, config))
    ]
    asked.append(FilterJob(FILTERS["4.2"], kept(log, "dvl", log["dvl"].time < 5.0), heavy))
    for each, together in zip(asked, run_filters(asked), strict=True):
        assert isinstance(together, Estimate)
        assert_same(together, run_filter("4.2", each.log, each.config))


def test_one_that_fails_does_not_touch_the_others():
    case = lively_dive()
    config, log = started(case), kept(case.log, "imu", case.log["imu"].time < 15.0)
    absurd = altered(log, "imu", np.where(log["imu"].time[:, None] > 10.0, 1e200, 1.0) * log["imu"].data)
    logs = [log, absurd, without(log, "mag"), without(log, "dvl_heading")]
    asked = [FilterJob(FILTERS[name], each, config) for each in logs for name in ("4.3a", "4.3b", "4.3c")]
    done = run_filters(asked)
    words = [None] * 3 + ["diverges at 10."] * 3 + ["mag_x", None, "mag_x"] + ["dvl_heading"] * 2 + [None]
    for each, outcome, word in zip(asked, done, words, strict=True):
        if word is None:
            assert isinstance(outcome, Estimate)
            assert_same(outcome, run_filter(each.variant, each.log, each.config))
        else:
            assert isinstance(outcome, InputError) and word in str(outcome) and each.variant.name in str(outcome)


# --------------------------------------------------------------------------- mistakes


@pytest.mark.parametrize(
    ("name", "missing", "words"),
    [
        ("4.3a", "mag", "mag_x"),
        ("4.3c", "mag", "mag_x"),
        ("4.5", "mag", "mag_x"),
        ("4.4b", "dvl_heading", "dvl_heading"),
        ("4.4a", "dvl", "dvl_vx"),
        ("4.1", "dvl", "dvl_vx"),
        ("4.1", "imu", "acc_x"),
        ("4.2", "none of them", "thruster_1"),
    ],
)
def test_what_the_log_lacks_is_named_in_one_line(name, missing, words):
    case = lively_dive()
    with pytest.raises(InputError, match=words) as caught:
        run_filter(name, without(case.log, missing), case.config)
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_4_1_without_any_attitude_says_what_it_needs():
    case = lively_dive()
    config = changed(case.config, start={"heading_deg": 0.0})
    with pytest.raises(InputError, match="ahrs_yaw"):
        run_filter("4.1", without(case.log, "ahrs", "mag"), config)


def test_4_1_without_the_unit_s_attitude_levels_and_says_so():
    case = clean_dive("circle")
    estimate = run_filter("4.1", without(case.log, "ahrs"), started(case))
    assert any("levelled" in line for line in estimate.summary["assumptions"])
    assert position_errors(estimate.trajectory, case).max() < 0.5


def test_heading_of_the_given_attitude_is_freed_of_declination_and_deviation():
    curve = {"ahrs_offset": np.array([0.05]), "ahrs_deviation": np.array([0.06, -0.04])}
    case = simulated(falcon(), 40.0, path="circle", style=QUICK, noise=False, ahrs_rate=20.0, calibration=curve)
    means = {"ahrs_offset": {"mean_deg": np.rad2deg(0.05)}, "ahrs_deviation": {"mean_deg": (3.4377468, -2.2918312)}}
    config = started(case, calibration=means)
    trajectory = run_filter("4.1", case.log, config).trajectory
    difference = transpose(trajectory.R_nb) @ true_at(case, trajectory.time).R_nb
    assert np.abs(difference - np.eye(3)).max() < 0.01  # the turn of one IMU sample


def test_thrusters_that_do_not_fit_the_vehicle_are_refused():
    log, _ = thruster_dive(15.0)
    stream = log["thruster"]
    few = Stream("thruster", stream.columns[:4], stream.time, stream.data[:, :4], stream.row)
    with pytest.raises(InputError, match=r"4\.2 needs the signal of each of the 5"):
        run_filter("4.2", Log(log.source, {**log.streams, "thruster": few}), CONFIG)


def test_unknown_filter_is_refused_with_a_hint():
    case = lively_dive()
    with pytest.raises(InputError, match=r"did you mean 4\.3a"):
        run_filter("4.3A", case.log, case.config)


def test_deviation_curve_of_the_magnetometer_is_refused():
    case = lively_dive()
    config = changed(case.config, calibration={"mag_deviation": {"mean_deg": 2.0}})
    with pytest.raises(InputError, match="mag_deviation"):
        run_filter("4.3c", case.log, config)
    run_filter("4.3b", kept(case.log, "imu", case.log["imu"].time < 2.0), config)


def test_long_silence_of_the_imu_is_refused():
    case = lively_dive()
    t = case.log["imu"].time
    config = changed(case.config, imu={"max_gap_s": 2.0})
    with pytest.raises(InputError, match=r"imu\.max_gap_s"):
        run_filter("4.4a", kept(case.log, "imu", (t < 10.0) | (t > 15.0)), config)


def test_filter_that_diverges_says_when():
    case = lively_dive()
    late = case.log["imu"].time[:, None] > 10.0
    absurd = altered(case.log, "imu", np.where(late, 1e200, 1.0) * case.log["imu"].data)
    with pytest.raises(InputError, match=r"diverges at 1\d\.\d+ s"):
        run_filter("4.3a", absurd, started(case))


def test_pings_without_bottom_lock_still_give_heading_and_silence_is_bridged():
    case = lively_dive()
    data = case.log["dvl"].data.copy()
    lost = (case.log["dvl"].time > 15.0) & (case.log["dvl"].time < 20.0)
    data[lost, 3] = 0.0
    estimate = run_filter("4.3a", altered(case.log, "dvl", data), started(case))
    rows = estimate.residuals[(estimate.residuals["time"] > 15.0) & (estimate.residuals["time"] < 20.0)]
    assert "dvl_heading" in set(rows["sensor"]) and "dvl" not in set(rows["sensor"])
    variance = estimate.trajectory.p_sd.max(axis=1) ** 2
    before, after = variance[np.searchsorted(estimate.trajectory.time, [15.0, 20.0])]
    assert after - before > before - variance[0]  # more in 5 s of silence than in 15 s of pings
    silent = without(case.log, "dvl_heading")
    silent = altered(silent, "dvl", data)
    times = run_filter("4.3c", silent, started(case)).trajectory.time
    assert np.diff(times).max() < 1.5


def test_mag_slower_than_the_imu_is_taken_where_it_comes():
    case = lively_dive()
    slow = kept(case.log, "mag", np.arange(len(case.log["mag"])) % 5 == 0)
    estimate = run_filter("4.3c", slow, started(case))
    rows = estimate.residuals
    assert 0 < (rows["sensor"] == "mag").sum() < (rows["sensor"] == "imu").sum()
    assert position_errors(estimate.trajectory, case)[-1] < 3.0


ICTINEU = Path(__file__).parents[2] / "shared" / "data" / "ictineu"


@pytest.mark.skipif(not ICTINEU.exists(), reason="no real log beside the checkout (shared/data/ictineu)")
@pytest.mark.parametrize("name", ["4.1", pytest.param("4.1-no-accelerometer", marks=pytest.mark.slow)])
def test_real_log_of_a_slow_mti_is_within_what_its_compass_allows(name):
    """An IMU of 10 Hz; the mounting is wrong by 5.3 degrees and the compass deviates by as much; DGPS of a buoy."""
    config, log = real_log()
    reference = read_trajectory(ICTINEU / "reference.csv.gz")
    trajectory = run_filter(name, log, config).trajectory
    there = reference.time < trajectory.time[-1]
    at = trajectory.at(reference.time[there])
    off = np.linalg.norm((at.p_n - reference.p_n[there])[:, :2], axis=1)
    assert trajectory.distance > 50.0
    assert rms(off) < np.sin(np.deg2rad(5.3 + 5.3)) * trajectory.distance


@cache
def real_log() -> tuple[Config, Log]:
    """The first 400 s."""
    config = load_config(ICTINEU / "ictineu.yaml")
    log = read_log(ICTINEU / "log.csv.gz", config)
    return config, kept(log, "imu", log["imu"].time < log["imu"].time[0] + 400.0)


def test_fifteen_side_by_side_take_as_many_steps_as_one(monkeypatch):
    """Every step is one call for all, on which their speed rests."""
    case = lively_dive()
    log = kept(case.log, "imu", case.log["imu"].time < 8.0)
    asked = [FilterJob(FILTERS[f"4.3{letter}"], log, started(case)) for letter in "abc"]
    step, calls = ConstantAcceleration.step, []
    monkeypatch.setattr(ConstantAcceleration, "step", lambda *given: calls.append(1) or step(*given))
    counts = []
    for many in (5 * asked, asked[:1]):
        calls.clear()
        run_filters(many)
        counts.append(len(calls))
    assert counts[0] == counts[1] > 700
