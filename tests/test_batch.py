"""The batch smoother: exact on perfect logs, robust on bad ones, and the same optimum as GTSAM's own."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from dives import (
    altered,
    attitude_errors,
    batch,
    changed,
    falcon,
    kept,
    position_errors,
    rms,
    simulated,
    smoothed,
    started,
    true_at,
)

from rovgraph.dive import smooth
from rovgraph.errors import InputError
from rovgraph.geometry import matrix_from_rpy, rotate
from rovgraph.inference import gauss_newton
from rovgraph.inference.dead_reckoning import dead_reckon
from rovgraph.inference.graph.batch import DiveGraph, indeterminate, make_graph, make_values, solve
from rovgraph.inference.graph.optimum import covariances, marginals
from rovgraph.inference.graph.values import key
from rovgraph.log import Log
from rovgraph.model.calibration import LAYERS, TABLE
from rovgraph.model.config import Config, beliefs
from rovgraph.problem.measurements import loss_and_weight
from rovgraph.simulate import CALM, Style, scenario

DEG = np.deg2rad(1.0)
BENCHMARK = Path(__file__).parents[1] / "benchmarks" / "batch.py"
HELD = {name: {"estimate": False} for name in TABLE if name not in LAYERS}


def problem_of(log, config) -> tuple[DiveGraph, gtsam.Values]:
    """The graph of a log, and dead reckoning to begin with."""
    smoother = batch(log, config)
    b = smoother.initial
    graph = make_graph(smoother.problem, b.prior, b.config, beliefs(b.config), b.instruments)
    return graph, make_values(graph, dead_reckon(smoother.problem, b, graph.unknowns.fixed))


# perfect logs

VEHICLES = {
    "as configured": ({}, {}),
    "no lever arms": (
        {
            "imu": {"mount_rpy_deg": [0, 0, 0], "lever_arm_m": [0, 0, 0]},
            "dvl": {"mount_rpy_deg": [0, 0, 0], "lever_arm_m": [0, 0, 0]},
        },
        {},
    ),
    "IMU on its side, far off": ({"imu": {"mount_rpy_deg": [90, 20, -130], "lever_arm_m": [-0.5, 0.4, 0.3]}}, {}),
    "DVL looking up": ({"dvl": {"mount_rpy_deg": [0, 0, -45], "lever_arm_m": [0.5, -0.3, -0.4]}}, {}),
    "compasses held": ({"calibration": HELD}, {}),
    "heading of the IMU, fixes": ({"heading": {"sources": ["ahrs"]}}, {"ahrs_rate": 10.0, "fix_interval": 2.0}),
    "on a turning Earth": ({"environment": {"earth_rotation": True}}, {}),
    "no depth sensor": ({}, {"depth_rate": None}),
}


@pytest.mark.parametrize("name", VEHICLES)
def test_a_perfect_log_is_recovered(name):
    sections, sensors = VEHICLES[name]
    case = simulated(falcon(**sections), 60.0, noise=False, style=Style(), **sensors)
    estimate = smoothed(case.log, started(case))
    assert position_errors(estimate.trajectory, case).max() < 0.01
    assert np.linalg.norm(attitude_errors(estimate.trajectory, case), axis=1).max() < 0.01 * DEG
    assert estimate.summary["converged"]


def test_fixes_with_ellipses_are_worth_more_than_with_the_sds_of_their_components():
    """6 m along a direction that changes from fix to fix, 0.3 m across it."""
    square = np.zeros(2)  # of the errors, with ellipses and without
    for seed in range(3):
        config, rng = falcon(start={"position_sd_m": 20.0}), np.random.default_rng(seed)
        case = simulated(config, 120.0, seed=seed, fix_interval=10.0, imu_rate=50.0, dvl_rate=3.0)
        fixes = case.log["fix"]
        turn = rng.uniform(0.0, np.pi, len(fixes))
        axes = matrix_from_rpy(np.column_stack([0.0 * turn, 0.0 * turn, turn]))[:, :2, :2]
        S = axes @ np.diag([6.0**2, 0.3**2]) @ axes.transpose(0, 2, 1)
        z = true_at(case, fixes.time).p_n[:, :2] + rotate(axes, rng.normal(0.0, [6.0, 0.3], (len(fixes), 2)))
        for k, covariance in enumerate((S[:, 0, 1], np.nan * turn)):
            data = np.column_stack([z, np.sqrt(S[:, 0, 0]), np.sqrt(S[:, 1, 1]), covariance])
            log = replace(case.log, streams={**case.log.streams, "fix": replace(fixes, data=data)})
            square[k] += np.mean(
                position_errors(smooth(log, case.config, "smoothed").estimates[0].trajectory, case) ** 2
            )
    assert np.sqrt(square[0] / 3) < 0.2 and square[0] < 0.25 * square[1]


def test_a_perfect_log_is_recovered_without_being_told_its_start():
    case = simulated(falcon(), 120.0, noise=False, style=Style())
    down = float(case.truth.p_n[0, 2])
    estimate = smoothed(case.log, changed(case.config, start={"down_m": down}))
    assert position_errors(estimate.trajectory, case).max() < 0.01
    assert np.linalg.norm(attitude_errors(estimate.trajectory, case), axis=1).max() < 0.01 * DEG


TRUE_CALIBRATION = {
    "dvl_roll": [np.pi - 1 * DEG],
    "dvl_pitch": [1.5 * DEG],
    "dvl_yaw": [47 * DEG],
    "dvl_scale": [0.01],
    "dvl_compass_offset": [3 * DEG],
    "dvl_compass_deviation": [2 * DEG, -1 * DEG],
    "ahrs_offset": [1 * DEG],
    "ahrs_deviation": [1 * DEG, 2 * DEG],
    "mag_offset": [-2 * DEG],
    "hard_iron": [0.01, -0.015, 0.02],
}


@pytest.fixture(scope="module")
def calibrated():
    """A perfect log of a vehicle whose calibration is far from its prior means, with precise fixes."""
    config = falcon(
        calibration={name: {"estimate": True} for name in TRUE_CALIBRATION}
        | {"dvl_scale": {"estimate": True, "sd": 0.01}},
        fix={"sd_m": 0.02},
        heading={"sources": ["mag", "dvl", "ahrs"]},
        start={"position_sd_m": 0.01},
        imu={"noise": {"gyr": 1e-4}},  # what more would take from the scale is added back, and a perfect log lacks none
    )
    sensors = {"fix_interval": 0.5, "ahrs_rate": 10.0}
    route = {"path": "figure8", "style": Style()}
    case = simulated(config, 120.0, noise=False, calibration=TRUE_CALIBRATION, **route, **sensors)
    return case, smoothed(case.log, started(case))


@pytest.mark.parametrize("name", TRUE_CALIBRATION)
def test_calibration_is_found_from_a_perfect_log(calibrated, name):
    """To a hundredth of the way, and what the prior pulls back: the data weigh as much as their noise allows."""
    estimate = {c.label: c for c in calibrated[1].calibration}
    for label, true in zip(TABLE[name].labels, TRUE_CALIBRATION[name], strict=True):
        c = estimate[label]
        pull = (c.sd / c.prior_sd) ** 2
        assert abs(c.value - true) < (0.01 + 3.0 * pull) * abs(true - c.prior_mean)
        assert c.sd < 0.4 * c.prior_sd


def test_track_does_not_suffer_from_a_calibration_that_is_found(calibrated):
    case, estimate = calibrated
    assert position_errors(estimate.trajectory, case).max() < 0.01
    assert np.linalg.norm(attitude_errors(estimate.trajectory, case), axis=1).max() < 0.01 * DEG


def test_without_fixes_on_a_straight_line_the_misalignment_keeps_its_prior():
    # without the DVL's own compass, which knows it as well as its own offset is known, and without
    # its lever arm: a DVL off the origin sees a known direction in every roll
    falcon_still = falcon(
        dvl={"lever_arm_m": [-0.11, 0.22, -0.10]}, heading={"sources": ["mag"]}, start={"heading_deg": 0.0}
    )
    case = simulated(falcon_still, 120.0, path=scenario("straight", 120.0, 0.02, Style(waves=CALM)), seed=2)
    found = {c.label: c for c in smoothed(case.log, case.config).calibration}["dvl_yaw"]
    assert found.prior_sd == pytest.approx(5 * DEG)
    # noise in the estimated velocity passes for motion; this spurious information is removed
    assert found.verdict == "unobservable"
    assert (found.value, found.sd) == (found.prior_mean, pytest.approx(found.prior_sd))


# noisy logs


@pytest.fixture(scope="module")
def noisy():
    return simulated(falcon(), 100.0, seed=11)


def test_cost_never_rises(noisy, monkeypatch):
    """Within one set of gates every step lowers the robust cost."""
    graph, values = problem_of(noisy.log, noisy.config)
    searched = []
    search = gauss_newton._search

    def recorded(graph, values, gates, cost, tolerance):
        there = search(graph, values, gates, cost, tolerance)
        searched.append((cost, there[1], graph.cost(there[0], gates)))
        return there

    monkeypatch.setattr(gauss_newton, "_search", recorded)
    solution = solve(graph, values)
    assert solution.converged and len(searched) == solution.iterations > 2
    for before, after, true in searched:
        assert after <= before
        assert after == pytest.approx(true)


def test_from_a_bad_guess_the_same_optimum_is_found(noisy):
    graph, values = problem_of(noisy.log, noisy.config)
    rng, delta = np.random.default_rng(0), gtsam.VectorValues()
    for i in range(graph.count):
        delta.insert(key("pose", i), rng.normal(0.0, [0.02, 0.02, 0.1, 1.0, 1.0, 1.0]))
        delta.insert(key("velocity", i), rng.normal(0.0, 0.2, 3))
    good, bad = solve(graph, values), solve(graph, values.retract(delta))
    assert graph.cost(values.retract(delta), graph.initial_gates()) > 10 * good.cost
    assert bad.cost == pytest.approx(good.cost, rel=1e-5)


def test_gradient_vanishes_at_the_optimum(noisy):
    graph, values = problem_of(noisy.log, noisy.config)
    solution = solve(graph, values)
    step = graph.linearize(solution.point, solution.gates).optimize()
    moved = graph.states(solution.point.retract(step)).p_n - graph.states(solution.point).p_n
    assert np.abs(moved).max() < 2e-3


def with_outliers(log: Log, share: float, seed: int) -> Log:
    """Some pings with an error of half a metre a second in every component."""
    rng, data = np.random.default_rng(1000 + seed), log["dvl"].data.copy()
    wrong = rng.uniform(size=len(data)) < share
    data[wrong, :3] += 0.5 * rng.standard_normal((int(wrong.sum()), 3))
    return altered(log, "dvl", data)


@pytest.mark.slow
@pytest.mark.parametrize("calibration", [{}, HELD], ids=["estimated", "held"])
def test_a_fifth_of_gross_outliers_costs_at_most_half_of_the_accuracy(calibration):
    """Over ten dives: in a few, an error that is small by chance would be the measure."""
    clean, spoilt = [], []
    for seed in range(1, 11):
        case = simulated(falcon(calibration=calibration), 60.0, seed=seed)
        for errors, log in ((clean, case.log), (spoilt, with_outliers(case.log, 0.2, seed))):
            errors.append(rms(position_errors(smoothed(log, case.config).trajectory, case)))
    assert rms(np.array(spoilt)) < 1.5 * rms(np.array(clean))


@pytest.mark.slow
def test_without_loss_and_gate_outliers_ruin_the_track():
    """What the test above guards against does happen."""
    case = simulated(falcon(calibration=HELD), 80.0, seed=1)
    trusting, log = changed(case.config, dvl={"loss": "none", "gate_sd": None}), with_outliers(case.log, 0.2, 1)
    good, bad = (rms(position_errors(smoothed(log, c).trajectory, case)) for c in (case.config, trusting))
    assert bad > 3.0 * good


def test_gross_outliers_are_gated_and_said_to_be(noisy):
    data, wrong = noisy.log["dvl"].data.copy(), np.arange(100, 500, 40)
    data[wrong, 0] += 1.0
    estimate = smoothed(altered(noisy.log, "dvl", data), noisy.config)
    dvl = estimate.residuals[estimate.residuals["sensor"] == "dvl"]
    gated = set(dvl.loc[dvl["weight"] == 0.0, "time"])
    assert gated == set(noisy.log["dvl"].time[wrong])


def test_a_gate_of_null_lets_everything_in(noisy):
    data = noisy.log["dvl"].data.copy()
    data[100, 0] += 1.0
    open_gate = changed(noisy.config, dvl={"gate_sd": None})
    estimate = smoothed(altered(noisy.log, "dvl", data), open_gate)
    dvl = estimate.residuals[estimate.residuals["sensor"] == "dvl"]
    assert dvl["weight"].min() > 0.0
    assert dvl.loc[dvl["time"] == noisy.log["dvl"].time[100], "weight"].max() < 0.1  # but hardly counts


# the linear systems


@pytest.fixture(scope="module")
def small():
    """A short graph with every sensor, at a point that is not its optimum."""
    config = falcon(
        calibration={name: {"estimate": True} for name in TABLE if name not in LAYERS},
        heading={"sources": ["mag", "dvl", "ahrs"]},
        start={"position_sd_m": 1.0},
    )
    case = simulated(config, 45.0, seed=3, ahrs_rate=5.0, fix_interval=3.0)
    log = kept(case.log, "imu", case.log["imu"].time < 33.0)
    log = kept(log, "dvl", np.arange(len(log["dvl"])) % 4 == 0)
    return problem_of(log, config)


def test_bulk_linearisation_is_that_of_gtsam_factor_by_factor(small):
    graph, values = small
    mine = graph.linearize(values, graph.initial_gates())
    gtsams = graph.nonlinear().linearize(values)
    assert mine.size() < gtsams.size()  # one factor a keyframe
    ordering = gtsam.Ordering.ColamdGaussianFactorGraph(gtsams)
    for a, b in zip(mine.hessian(ordering), gtsams.hessian(ordering), strict=True):
        scale = np.sqrt(np.outer(np.diag(b), np.diag(b))) if b.ndim == 2 else np.abs(b).max()
        np.testing.assert_allclose(a / scale, b / scale, atol=1e-8)


def test_cost_is_that_of_gtsam(small):
    graph, values = small
    assert graph.cost(values, graph.initial_gates()) == pytest.approx(graph.nonlinear().error(values), rel=1e-9)


def test_gated_measurements_add_neither_cost_nor_information(small):
    graph, values = small
    gates = graph.initial_gates()
    gates["dvl"][3] = False
    alone = graph.blocks["dvl"].at([3])
    rho = loss_and_weight(alone.normalised(graph.states(values).at(alone.keyframe)), "huber")[0][0]
    assert graph.cost(values, gates) == pytest.approx(graph.cost(values, graph.initial_gates()) - rho)
    zeros = [
        np.sum(~graph.linearize(values, g).augmentedJacobian().any(axis=1)) for g in (gates, graph.initial_gates())
    ]
    assert zeros[0] - zeros[1] == 3


def test_marginals_are_those_of_gtsam(small):
    graph, values = small
    solution = solve(graph, values)
    known = covariances(marginals(graph, solution.point, solution.gates))
    linear = graph.linearize(solution.point, solution.gates)
    gtsams = gtsam.Marginals(linear, solution.point)
    for variable in ("pose", "velocity", "bias"):
        mine = np.array([known[key(variable, i)] for i in range(graph.count)])
        for i in range(0, graph.count, 7):
            expected = gtsams.marginalCovariance(key(variable, i))
            np.testing.assert_allclose(mine[i], expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())
    for name in graph.unknowns.estimated:
        np.testing.assert_allclose(known[key(name)], gtsams.marginalCovariance(key(name)), rtol=1e-4)


def test_the_step_does_not_depend_on_the_order_of_elimination(small):
    graph, values = small
    linear = graph.linearize(values, graph.initial_gates())
    kinds = (gtsam.Ordering.MetisGaussianFactorGraph, gtsam.Ordering.ColamdGaussianFactorGraph)
    steps = [linear.optimize(kind(linear)) for kind in kinds]
    for i in range(0, graph.count, 10):
        np.testing.assert_allclose(steps[0].at(key("pose", i)), steps[1].at(key("pose", i)), atol=1e-6)


# what cannot be determined


def without_priors(graph: DiveGraph, of: set[int]) -> DiveGraph:
    native = gtsam.NonlinearFactorGraph()
    for k in range(graph.native.size()):
        factor = graph.native.at(k)
        if not (len(factor.keys()) == 1 and factor.keys()[0] in of):
            native.add(factor)
    return DiveGraph(native, graph.blocks, graph.unknowns, graph.index)


def complaint(graph: DiveGraph, values: gtsam.Values, of: set[int]) -> str:
    with pytest.raises(InputError) as caught:
        solve(without_priors(graph, of), values)
    return str(caught.value)


def test_an_error_of_gtsam_becomes_one_line_that_names_the_variable(noisy):
    graph, values = problem_of(noisy.log, noisy.config)
    linear = without_priors(graph, {key("pose", 0)}).linearize(values, graph.initial_gates())
    with pytest.raises(RuntimeError) as caught:
        linear.optimize(gtsam.Ordering.MetisGaussianFactorGraph(linear))
    said = indeterminate(caught.value)
    assert re.match(r"the data do not determine (\w+ of keyframe \d+|\w+): check", said)
    assert "some variable" not in said and "\n" not in said and len(said) < 200


def test_a_start_that_nothing_determines_is_refused_in_one_line(noisy):
    graph, values = problem_of(noisy.log, noisy.config)
    said = complaint(graph, values, {key("pose", 0)})
    assert said.startswith("the data do not determine ") and "\n" not in said and len(said) < 300


def test_default_configuration_needs_no_tuning_for_a_dive_it_knows_nothing_of():
    """No configuration but the mounting: noise and calibration at their defaults."""
    case = simulated(falcon(), 100.0, seed=5)
    bare = Config.model_validate(
        {
            "imu": {k: getattr(case.config.imu, k) for k in ("mount_rpy_deg", "lever_arm_m")},
            "dvl": {k: getattr(case.config.dvl, k) for k in ("mount_rpy_deg", "lever_arm_m")},
            "environment": {"declination_deg": 4.5},
        }
    )
    smoother = batch(case.log, bare)
    estimate = smoother.solve()
    assert rms(position_errors(estimate.trajectory, case)) < 0.1 * case.truth.distance


@pytest.mark.slow
def test_benchmark_runs_and_both_solvers_find_the_same_cost():
    done = subprocess.run(
        [sys.executable, BENCHMARK, "--seconds", "35", "--long", "40"], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr[-500:]
    rows = [line.split("|") for line in done.stdout.splitlines() if " s | " in line]
    assert [row[1].strip() for row in rows] == ["rovgraph", "Levenberg-Marquardt", "rovgraph"]
    ours, gtsams = (float(row[6]) for row in rows[:2])
    assert ours == pytest.approx(gtsams, rel=1e-6)


@pytest.mark.slow
def test_a_sensor_that_its_gate_keeps_out_altogether_does_no_harm(noisy):
    """Nothing is then left that ties its calibration variables to the rest of the graph."""
    far = noisy.log["mag"].data + np.where(np.arange(len(noisy.log["mag"]))[:, None] % 2, 0.5, -0.5)
    config = changed(noisy.config, heading={"mag_sd_deg": 0.01, "loss": "none"})
    estimate = smoothed(altered(noisy.log, "mag", far), config)
    residuals = estimate.residuals
    assert (residuals.loc[residuals["sensor"] == "mag", "weight"] == 0.0).all()
    assert np.isfinite(estimate.trajectory.p_n).all()


def test_gates_that_flip_for_ever_come_to_rest(noisy, monkeypatch):
    graph, values = problem_of(noisy.log, noisy.config)
    asked = []

    def flipping(self, values):
        asked.append(1)
        assert len(asked) < 100
        gates = self.initial_gates()
        return {s: g & ((np.arange(len(g)) + len(asked)) % 2 == 0) for s, g in gates.items()}

    monkeypatch.setattr(DiveGraph, "gates", flipping)
    assert np.isfinite(solve(graph, values).cost)


def test_dead_reckoning_has_the_depth_of_the_body_not_of_the_sensor():
    sections = {
        "depth": {"lever_arm_m": [0.0, 0.0, -1.0]},
        "imu": {"lever_arm_m": [0.0, 0.0, 0.3]},
        "calibration": {"depth_offset": {"mean": 0.5}},
    }
    case = simulated(falcon(**sections), 60.0, noise=False, calibration={"depth_offset": np.array([0.5])})
    track = batch(case.log, started(case)).dead_reckoning().trajectory
    assert np.abs(track.p_n[:, 2] - true_at(case, track.time).p_n[:, 2]).max() < 0.05


def test_a_dive_shorter_than_a_second_is_solved_by_both_solvers():
    case = simulated(falcon(), 40.0)
    log = case.log
    for sensor, stream in log.streams.items():
        log = kept(log, sensor, stream.time < 0.9)
    for name in ("batch", "isam2"):
        (estimate, *_) = smooth(log, changed(case.config, graph={"solver": name}), "smoothed").estimates
        assert np.isfinite(estimate.trajectory.p_n).all()


def test_what_walks_does_so_by_the_time_between_its_values_however_short_a_segment_is_said_to_be():
    """Without pings keyframes are a second apart, whatever `graph.segment_s`."""
    case, walk = simulated(falcon(), 40.0, noise=False), 0.01
    config = started(case, graph={"segment_s": 0.2}, calibration={"field_scale": {"walk": walk}})
    log = kept(case.log, "dvl", case.log["dvl"].time < 1.0)
    graph, _ = problem_of(log, config)
    time = batch(log, config).problem.time
    factors = [graph.native.at(k) for k in range(graph.native.size())]
    steps = [f.noiseModel().sigmas()[0] for f in factors if isinstance(f, gtsam.BetweenFactorVector)]
    seconds = time[-1] - time[0]
    assert np.sum(np.square(steps)) == pytest.approx(walk**2 * seconds)
    assert seconds > 39.0
