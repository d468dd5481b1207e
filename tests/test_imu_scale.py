"""Scale errors of accelerometer and gyro: derivatives, and what a dive shows of them."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from dives import Simulated, batch, falcon, renewed, simulated, started, true_at
from motions import predict
from test_calibration_recovery import PINGS, errors

from rovgraph.geometry import log_rotation, rotate, transpose
from rovgraph.inference import gauss_newton
from rovgraph.inference.filter import FilterEngine
from rovgraph.inference.filter_step import Gaussian
from rovgraph.inference.graph.batch import motion_factor
from rovgraph.inference.graph.places import smooth_graph
from rovgraph.inference.graph.values import insert_calibration, insert_state
from rovgraph.model.config import beliefs
from rovgraph.model.state import VELOCITY, State
from rovgraph.problem.calibration_roles import CalibrationRoles, unknowns
from rovgraph.problem.problem import Problem
from rovgraph.simulate import Style, Waves

SCALES = {"acc_scale": [0.01, -0.008, 0.006], "gyr_scale": [-0.01, 0.008, 0.01]}
WILD = Style(waves=Waves(heave=0.2, roll=0.4, pitch=0.35))


def scaled(noise: bool, seconds: float = 75.0) -> Simulated:
    """A dive that tilts far, with an IMU whose scales are off."""
    config = falcon(calibration={name: {"estimate": True, "sd": 0.01} for name in SCALES})
    truth = {name: np.array(value) for name, value in SCALES.items()}
    return simulated(config, seconds, seed=2, style=WILD, noise=noise, calibration=truth, dvl_rate=PINGS)


@pytest.mark.parametrize("estimator", [batch, renewed], ids=["batch", "filter"])
def test_a_dive_that_tilts_far_shows_the_scales_of_accelerometer_and_gyro(estimator):
    case = scaled(noise=False)
    estimate = estimator(case.log, started(case)).solve()
    for name, true in SCALES.items():
        error, sd = errors(estimate, name, true)
        assert (np.abs(error) < sd).all()
        assert (sd < 0.25 * 0.01).all()


def test_the_chain_knows_of_the_scales_what_gtsams_graph_knows(monkeypatch):
    for tolerance in ("FINE", "FINAL_TOLERANCE"):
        monkeypatch.setattr(gauss_newton, tolerance, 1e-9)
    case = scaled(noise=True, seconds=40.0)
    smoother = batch(case.log, started(case))
    chain = smoother.optimum()
    graph = smooth_graph(smoother.problem, smoother.initial, chain.state)
    assert chain.solution.cost == pytest.approx(graph.solution.cost, rel=1e-6)
    for name in SCALES:
        np.testing.assert_allclose(chain.covariances()[name][-1], graph.covariances()[name][-1], rtol=1e-3, atol=1e-12)


def test_scales_that_are_known_are_held_and_fit():
    case = scaled(noise=False, seconds=45.0)
    known = started(case, calibration={name: {"estimate": False, "mean": value} for name, value in SCALES.items()})
    ignored = started(case, calibration={name: {"estimate": False} for name in SCALES})
    fitted, misfit = (batch(case.log, config).solve() for config in (known, ignored))
    assert fitted.summary["cost"] < 1e-2 * misfit.summary["cost"]


K = 60  # a lively interval


def dive_and_states() -> tuple[Problem, CalibrationRoles, State, State]:
    """A dive, with states around interval `K` that do not quite fit it."""
    case = scaled(noise=True, seconds=40.0)
    smoother = batch(case.log, started(case))
    problem = smoother.problem
    wanted = unknowns(beliefs(smoother.initial.config), smoother.initial.instruments).of(SCALES)
    at = true_at(case, problem.time[[K - 1]])
    means = {**wanted.fixed, **{name: np.array(value) for name, value in SCALES.items()}}
    before = State(at.R_nb, at.p_n, at.v_n, 0.01 * np.ones((1, 6)), means)
    after = across(problem, before).retract(VELOCITY, np.array([0.01, 0.02, -0.01]))
    return problem, wanted, before, after


def across(problem: Problem, before: State) -> State:
    """The state that is predicted after interval `K`."""
    return predict(problem.motions[K - 1], before, problem.scales[K - 1])


def test_factor_of_a_motion_with_scales_is_linearised_as_its_error_moves():
    problem, wanted, before, after = dive_and_states()
    values = gtsam.Values()
    insert_state(values, K - 1, before)
    insert_state(values, K, after)
    insert_calibration(values, before.calibration, wanted)
    factor = motion_factor(problem, K, wanted, K)
    linear = factor.linearize(values)
    A, _ = linear.jacobian()
    numeric, step = [], 1e-6
    for j, dim in zip(linear.keys(), (6, 3, 6, 3, 6, 6, 3, 3), strict=True):
        for c in range(dim):
            ends = []
            for sign in (1, -1):
                delta = gtsam.VectorValues()
                delta.insert(j, sign * step * np.eye(dim)[c])
                ends.append(factor.unwhitenedError(values.retract(delta)))
            numeric.append((ends[0] - ends[1]) / (2 * step))
    numeric_A = np.column_stack(numeric)
    np.testing.assert_allclose(A / np.abs(A).max(), numeric_A / np.abs(A).max(), atol=1e-6)


def test_transition_of_the_filter_holds_the_derivative_by_the_scales():
    problem, _, before, _ = dive_and_states()
    case = scaled(noise=True, seconds=40.0)
    engine = FilterEngine(batch(case.log, started(case)).initial)
    before = replace(before, calibration={**engine.unknowns.fixed, **before.calibration})
    transition = engine.predict(problem, K, Gaussian.of(before, engine.start().P))
    d = 1e-5
    for name in SCALES:
        columns = transition.F[:15, engine.layout.columns[name]]
        for c in range(3):
            ends = [across(problem, before.retract(name, s * d * np.eye(3)[c])) for s in (1, -1)]
            turn = log_rotation(transpose(ends[1].R_nb) @ ends[0].R_nb)[0]
            shift = rotate(transpose(transition.predicted.state.R_nb), ends[0].p_n - ends[1].p_n)[0]
            change = np.concatenate([turn, shift, (ends[0].v_n - ends[1].v_n)[0], np.zeros(6)])
            np.testing.assert_allclose(columns[:, c], change / (2 * d), atol=1e-4)
            assert np.abs(change).max() > 0
