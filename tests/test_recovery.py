"""The filter over a long silence of the DVL, and what it does when the DVL is back."""

import numpy as np
import pytest
from dives import Simulated, altered, falcon, initial_conditions, interrupted, renewed, simulated, true_at

from rovgraph.geometry import Array
from rovgraph.inference.error_state import REINITIALISE_AT_S, ErrorStateFilter, replay
from rovgraph.inference.filter import FilterEngine
from rovgraph.inference.filter_step import Gaussian
from rovgraph.inference.smoother import assemble
from rovgraph.kernels.error_coordinates import ErrorColumns
from rovgraph.kernels.filter_state import FilterState, local_coordinates, move_estimate
from rovgraph.model.state import VELOCITY
from rovgraph.problem.problem import Problem

SILENT_FROM = 40.0


@pytest.fixture(scope="module")
def case() -> Simulated:
    return simulated(falcon(), 240.0, seed=4, dvl_rate=4.0)


@pytest.fixture(scope="module")
def silent(case: Simulated) -> ErrorStateFilter:
    """A dive whose DVL is silent for 160 s."""
    return renewed(interrupted(case.log, SILENT_FROM, 160.0, "dvl"), case.config)


def horizontal_nees(estimator: ErrorStateFilter, case: Simulated) -> Array:
    """Squared error of north and east over its covariance, per degree of freedom, shape (n,)."""
    track = estimator.solve().trajectory
    error = (track.p_n - true_at(case, track.time).p_n)[:, :2, None]
    return (error.transpose(0, 2, 1) @ np.linalg.solve(track.cov_p[:, :2, :2], error))[:, 0, 0] / 2.0


def test_without_a_dvl_depth_alone_teaches_nothing_about_horizontal_velocity(silent):
    """The sd of a velocity that nobody measures grows from keyframe to keyframe, but for what noise of the IMU does."""
    track = silent.solve().trajectory
    alone = (track.time > SILENT_FROM + 2.0) & (track.time < SILENT_FROM + 159.0)
    sd = np.linalg.norm(track.v_sd[alone, :2], axis=1)
    assert sd[-1] > 2.0
    assert (np.diff(sd) > -0.02 * sd[:-1]).all()


def test_a_dvl_that_is_back_after_a_long_silence_is_taken_at_once_and_moves_nothing_by_more_than_three_sd(silent, case):
    nis = silent.solve().summary["nis"]["dvl"]
    assert nis["rejected"] == 0
    assert horizontal_nees(silent, case)[10:].max() < 9.0 / 2.0
    track = silent.solve().trajectory
    step = np.diff(track.p_n - true_at(case, track.time).p_n, axis=0)[:, :2, None]
    jump = (step.transpose(0, 2, 1) @ np.linalg.solve(track.cov_p[:-1, :2, :2], step))[:, 0, 0]
    assert jump[10:].max() < 9.0


@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["one point", "swapped"])
def test_fixes_that_are_wrong_for_minutes_do_not_draw_the_filter(wrong):
    case = simulated(falcon(), 200.0, seed=4, dvl_rate=4.0, fix_interval=2.0)
    data, late = case.log["fix"].data.copy(), case.log["fix"].time > SILENT_FROM
    data[late, :2] = data[late, 1::-1] if wrong == "swapped" else data[late.argmax() - 1, :2]
    estimator = renewed(altered(case.log, "fix", data), case.config)
    assert horizontal_nees(estimator, case)[10:].max() < 9.0 / 2.0


@pytest.mark.parametrize("seed", [1, 2])
def test_a_correction_of_a_wide_prediction_is_at_the_optimum_of_its_cost(case, seed):
    """Where H' r + P^-1 e = 0, e back to the prediction. Linearised once, it is many sds away."""
    engine, known, problem, ping = about_to_return(case, np.random.default_rng(seed))
    after = engine.correct(known, problem, slice(ping, ping + 1), {})
    r, H = engine.linearize(known, problem, np.array([ping]))
    delta = known.P @ H.T @ np.linalg.solve(H @ known.P @ H.T + np.eye(3), r)
    x, c, P = known.x.copy(), known.c.copy(), after.P.copy()
    move_estimate(FilterState(x, c, P, np.zeros((len(P), 0)), np.zeros((0, 0))), delta, along_n(engine))
    assert from_optimum(engine, known, after, problem, ping) < 0.1
    assert from_optimum(engine, known, Gaussian(x, c, after.P), problem, ping) > 2.0


def about_to_return(case: Simulated, rng: np.random.Generator) -> tuple[FilterEngine, Gaussian, Problem, int]:
    """A prediction after a long silence, off by an error of its covariance, and the first ping of the dive after it."""
    config = falcon(dvl={"loss": "none"})
    dive = assemble(interrupted(case.log, SILENT_FROM, 160.0, "dvl"), initial_conditions(case.log, config))
    problem = dive.problem
    back = int(problem.time.searchsorted(SILENT_FROM + 159.9, side="right"))
    estimator = replay(problem.upto(back), dive.initial, REINITIALISE_AT_S)
    engine = estimator.engine
    (begin, end), here = problem.measured_in(back), int(problem.first[back])
    before = engine.correct(estimator.known, problem, slice(begin, here), {})
    known = engine.predict(problem, back, before).predicted
    error = np.linalg.cholesky(known.P) @ rng.standard_normal(len(known.P))
    off = engine.retract(known, error, known.P)
    [ping] = [row for row in problem.of_sensor("dvl").tolist() if here <= row < end]
    return engine, Gaussian(off.x, off.c, known.P), problem, ping


def along_n(engine: FilterEngine) -> ErrorColumns:
    """The error's coordinates with the velocity along n."""
    columns, seen, params, rows = engine.layout.coordinates
    others = seen[:, 2] != engine.layout.columns[VELOCITY].start
    return ErrorColumns(columns, seen[others], params[others], rows)


def from_optimum(engine: FilterEngine, known: Gaussian, there: Gaussian, problem: Problem, ping: int) -> float:
    """The largest component of a Newton step from an estimate, in its sds."""
    back, basis = np.empty(engine.layout.size), np.eye(engine.layout.size)
    local_coordinates(there.x, there.c, known.x, known.c, along_n(engine), back, basis)
    r, H = engine.linearize(there, problem, np.array([ping]))
    P = basis @ known.P @ basis.T
    step = P @ H.T @ np.linalg.solve(H @ P @ H.T + np.eye(len(r)), r - H @ back) + back
    return float((np.abs(step) / np.sqrt(np.diag(there.P))).max())
