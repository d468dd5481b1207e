"""An attitude that is hardly known is found before anything is linearised at it."""

from dataclasses import replace

import numpy as np
import pytest
from dives import RecordingFilter, attitude_errors, falcon, fed, interrupted, position_errors, simulated

from rovgraph.geometry import Array, exp_rotation, log_rotation, rpy_from_matrix
from rovgraph.inference import filter
from rovgraph.inference import filter as alignment
from rovgraph.inference.error_state import ErrorStateFilter
from rovgraph.inference.filter import aligned, poorly_known, with_attitude
from rovgraph.inference.filter_step import Gaussian
from rovgraph.inference.initialise import initialise

GRAVITY = 9.81


@pytest.fixture(scope="module")
def met():
    """A filter in the middle of a dive, what `aligned` takes of the next interval, and the true attitude there."""
    case = simulated(falcon(), 45.0, seed=6, dvl_rate=4.0)
    estimator = fed(RecordingFilter(initialise(case.log, case.config)), case.log)
    index, problem = 80, estimator.problem
    true = case.truth.R_nb[np.searchsorted(case.truth.time, problem.time[index])]
    between = slice(problem.measured_in(index + 1)[0], int(problem.first[index + 1]))
    assert between.stop > between.start
    return estimator.engine, estimator.filtered[index], (problem, index + 1, between), true


def doubted(known, turn_n: Array, sd: Array):
    """With an attitude that is off by a rotation about n's axes, of which nothing is known but its sd."""
    R_nb = exp_rotation(np.asarray(turn_n)) @ known.state.R_nb[0]
    P = known.P.copy()
    P[:3, :], P[:, :3] = 0.0, 0.0
    P[:3, :3] = R_nb.T @ np.diag(np.asarray(sd) ** 2) @ R_nb
    return Gaussian.of(replace(known.state, R_nb=R_nb[None]), P)


def without_measurements(interval):
    problem, k, between = interval
    return problem, k, slice(between.start, between.start)


def test_an_attitude_is_vague_from_a_tilt_of_four_degrees_or_a_heading_of_ten(met):
    _, known, *_ = met
    assert not poorly_known(known)
    assert not poorly_known(doubted(known, np.zeros(3), np.deg2rad([3.9, 3.9, 9.9])))
    assert poorly_known(doubted(known, np.zeros(3), np.deg2rad([0.1, 4.1, 0.1])))
    assert poorly_known(doubted(known, np.zeros(3), np.deg2rad([0.1, 0.1, 10.1])))


@pytest.mark.parametrize("off", [-130.0, -60.0, 25.0, 90.0, 170.0])
def test_a_heading_that_is_far_off_is_found_from_one_sample_of_the_compasses(met, off):
    engine, known, interval, true = met
    lost = doubted(known, np.deg2rad([0.0, 0.0, off]), np.deg2rad([0.5, 0.5, 70.0]))
    found = aligned(lost, *interval, engine.linearize, GRAVITY)
    error = np.rad2deg(log_rotation(true @ found.state.R_nb[0].T))
    assert abs(error[2]) < 6.0  # a step of those that are tried, and what compasses are off by


def test_without_a_compass_nothing_is_turned(met):
    engine, known, interval, _ = met
    lost = doubted(known, np.deg2rad([0.0, 0.0, 90.0]), np.deg2rad([0.5, 0.5, 70.0]))
    assert aligned(lost, *without_measurements(interval), engine.linearize, GRAVITY) is lost


def test_a_tilt_that_is_far_off_is_levelled_by_the_specific_force(met):
    engine, known, interval, true = met
    lost = doubted(known, np.deg2rad([9.0, -12.0, 0.0]), np.deg2rad([10.0, 10.0, 1.0]))
    found = aligned(lost, *without_measurements(interval), engine.linearize, GRAVITY)
    assert np.abs(rpy_from_matrix(found.state.R_nb[0]) - rpy_from_matrix(true))[:2].max() < np.deg2rad(2.0)


def test_what_cannot_be_gravity_levels_nothing(met):
    engine, known, interval, _ = met
    lost = doubted(known, np.deg2rad([9.0, -12.0, 0.0]), np.deg2rad([10.0, 10.0, 1.0]))
    same = aligned(lost, *without_measurements(interval), engine.linearize, 2.0 * GRAVITY)
    np.testing.assert_array_equal(same.state.R_nb, lost.state.R_nb)


def test_facing_elsewhere_knows_no_more_and_no_less(met):
    """The body's attitude, position along n, and a velocity that a DVL sees are as sure as before."""
    _, known, *_ = met
    R_nb = exp_rotation(np.array([0.0, 0.0, 1.2])) @ known.state.R_nb[0]
    turned = with_attitude(known, R_nb)
    np.testing.assert_array_equal(turned.state.R_nb[0], R_nb)
    np.testing.assert_allclose(turned.P[:3, :3], known.P[:3, :3])
    here, there = known.state.R_nb[0], R_nb
    np.testing.assert_allclose(there @ turned.P[3:6, 3:6] @ there.T, here @ known.P[3:6, 3:6] @ here.T, atol=1e-12)
    np.testing.assert_allclose(there.T @ turned.state.v_n[0], here.T @ known.state.v_n[0], atol=1e-12)
    np.testing.assert_allclose(turned.P[9:, 9:], known.P[9:, 9:])


def test_a_velocity_that_is_known_in_n_alone_does_not_turn(met):
    _, known, *_ = met
    moving = Gaussian.of(replace(known.state, v_n=np.array([[0.5, 0.1, 0.0]])), known.P)
    lost = doubted(moving, np.zeros(3), [1, 1, 1])
    turned = with_attitude(lost, exp_rotation(np.array([0.0, 0.0, 1.2])) @ lost.state.R_nb[0])
    np.testing.assert_array_equal(turned.state.v_n, lost.state.v_n)
    np.testing.assert_array_equal(turned.P[6:9, 6:9], lost.P[6:9, 6:9])


EVERY = ("imu", "dvl", "mag", "dvl_heading", "depth")
SILENCES = [(8.0, 5.0, EVERY), (14.2, 6.6, EVERY), (15.0, 9.0, EVERY), (12.0, 8.0, ("imu",)), (15.0, 4.0, EVERY[:2])]


def after_silences(seeds: range) -> tuple[int, Array, Array]:
    """Of dives with a silence: measurements kept out; largest errors of tilt and heading 10 s later, in their sd."""
    kept_out, tilt, heading = 0, [], []
    for seed in seeds:
        case = simulated(falcon(imu={"max_gap_s": 60.0}), 40.0, seed=seed, dvl_rate=4.0)
        for begin, seconds, sensors in SILENCES:
            log = interrupted(case.log, begin, seconds, *sensors)
            estimator = fed(ErrorStateFilter(initialise(log, case.config)), log)
            track = estimator.solve().trajectory
            residuals = estimator.solve().residuals
            kept_out += int((residuals["sensor"].isin(["dvl", "mag"]) & (residuals["weight"] == 0.0)).sum())
            late = track.time > begin + seconds + 10.0
            sd = np.sqrt(np.diagonal(track.cov_theta, axis1=1, axis2=2))
            off = np.abs(attitude_errors(track, case) / sd)[late].max(axis=0)
            tilt.append(max(off[0], off[1]))
            heading.append(off[2])
            sd_p = np.sqrt(np.trace(track.cov_p, axis1=1, axis2=2))
            assert (position_errors(track, case) < 3.0 * sd_p)[late].all()
    return kept_out, np.array(tilt), np.array(heading)


@pytest.mark.slow
def test_after_a_silence_no_sensor_is_kept_out_for_long_and_attitude_is_as_sure_as_it_says():
    kept_out, tilt, heading = after_silences(range(2, 6))
    assert kept_out < 20  # of some 9000; a sensor that is not let in again makes a hundred in one dive
    assert np.median(tilt) < 3.0 and np.median(heading) < 2.0  # the largest of some 60 epochs
    assert np.mean(heading > 5.0) < 0.1


@pytest.mark.slow
def test_linearised_where_it_stands_a_vague_attitude_would_be_believed_and_sensors_kept_out(monkeypatch):
    for module in (alignment, filter):
        monkeypatch.setattr(module, "POORLY_KNOWN", np.full(2, np.inf))
    kept_out, _, heading = after_silences(range(2, 4))
    assert kept_out > 40 and np.mean(heading > 5.0) > 0.3


def test_facing_elsewhere_and_back_is_where_it_was(met):
    _, known, *_ = met
    R_nb = exp_rotation(np.array([0.1, -0.2, 2.0])) @ known.state.R_nb[0]
    back = with_attitude(with_attitude(known, R_nb), known.state.R_nb[0])
    np.testing.assert_allclose(back.P, known.P, atol=1e-12)
    np.testing.assert_allclose(back.state.v_n, known.state.v_n, atol=1e-12)
