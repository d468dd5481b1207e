"""What is considered: constants that keep their means, and whose uncertainty is in that of smoother and filter."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from dives import Simulated, batch, changed, falcon, fed, interrupted, renewed, simulated, started
from test_consistency import band, nees

from rovgraph.errors import InputError
from rovgraph.geometry import Array, log_rotation, transpose
from rovgraph.inference import smoother as optimum_module
from rovgraph.inference.chain_optimum import ChainOptimum, smooth_chain
from rovgraph.inference.correlated_noise import LASTING
from rovgraph.inference.dead_reckoning import dead_reckon
from rovgraph.inference.error_state import ErrorStateFilter
from rovgraph.inference.initialise import initialise
from rovgraph.model.calibration import AUTO, TABLE
from rovgraph.model.config import Config, beliefs, parse_config
from rovgraph.model.state import POSE, VELOCITY, State
from rovgraph.simulate import scenario
from rovgraph.simulate.path import Style

# sds that an instrument in its mounting may have, small enough for one linearisation
SD = {"dvl_pitch": 0.3, "dvl_scale": 0.005, "dvl_lever_arm": 0.02, "gyr_scale": 0.005, "depth_offset": 0.1}
CALM = Style()
STEP = 1e-2  # of the prior sd
COMPONENTS = [(name, k) for name in SD for k in range(TABLE[name].dim)]


def believing(estimate: bool | str = "considered", shifted: tuple[str, int] | None = None) -> dict[str, Any]:
    """The calibration section that says so of each, one component's mean `STEP` sds further."""
    out: dict[str, Any] = {}
    for name, sd in SD.items():
        tail, dim = "_deg" if TABLE[name].angular else "", TABLE[name].dim
        mean = [STEP * sd * ((name, k) == shifted) for k in range(dim)]
        out[name] = {"estimate": estimate, "sd" + tail: sd, "mean" + tail: mean[0] if dim == 1 else mean}
    return out


@pytest.fixture(scope="module")
def case() -> Simulated:
    config = falcon(calibration=believing(), dvl={"loss": "none", "gate_sd": None})
    return simulated(config, 40.0, seed=3, style=CALM, dvl_rate=2.0)


def optimum(case: Simulated, config: Config) -> ChainOptimum:
    dive = batch(case.log, config)
    means = {name: belief.mean for name, belief in beliefs(config).items()}
    return smooth_chain(dive.problem, dive.initial, dead_reckon(dive.problem, dive.initial, means))


def plain_filter(case: Simulated, config: Config) -> ErrorStateFilter:
    return fed(ErrorStateFilter(initialise(case.log, config)), case.log)


def apart(one: State, other: State) -> Array:
    """From one to the other along pose and velocity, shape (n, 9), pose in axes of b."""
    turn = log_rotation(transpose(one.R_nb) @ other.R_nb)
    shift = np.einsum("nji,nj->ni", one.R_nb, other.p_n - one.p_n)
    return np.concatenate([turn, shift, other.v_n - one.v_n], axis=1)


@pytest.mark.slow
def test_the_smoothers_covariance_has_what_the_optimum_would_move_by(case):
    """By finite differences: each constant believed elsewhere, and the dive solved again."""
    config = started(case)
    exact = optimum(case, changed(config, calibration=believing(False)))
    best = optimum(case, config)
    np.testing.assert_allclose(best.state.p_n, exact.state.p_n, atol=1e-6)
    moved = [
        apart(best.state, optimum(case, changed(config, calibration=believing(shifted=one))).state) / STEP
        for one in COMPONENTS
    ]
    K = np.stack(moved, axis=2)
    for variable, part in ((POSE, slice(0, 6)), (VELOCITY, slice(6, 9))):
        expected = exact.covariances()[variable] + K[:, part] @ transpose(K[:, part])
        found, sd = best.covariances()[variable], np.sqrt(np.diagonal(expected, axis1=1, axis2=2))
        scale = sd[:, :, None] * sd[:, None, :]
        np.testing.assert_allclose(found / scale, expected / scale, atol=0.02)
        assert (sd**2 > 1.5 * np.diagonal(exact.covariances()[variable], axis1=1, axis2=2)).any()


@pytest.mark.slow
def test_the_filters_covariance_has_what_its_estimate_would_move_by(case):
    config = started(case)
    exact = plain_filter(case, changed(config, calibration=believing(False)))
    filtered = plain_filter(case, config)
    known, engine = filtered.known, filtered.engine
    np.testing.assert_allclose(known.x, exact.known.x, atol=1e-12)
    np.testing.assert_allclose(known.P, exact.known.P, rtol=1e-6, atol=1e-12)
    moved, sd = [], np.sqrt(np.diag(known.covariance))[:, None]
    for one in COMPONENTS:
        other = plain_filter(case, changed(config, calibration=believing(shifted=one))).known
        c = np.where(
            engine.layout.column[15:] < engine.layout.size, other.c, known.c
        )  # the constants' own step is none
        moved.append(engine.local(known, replace(other, c=c))[0] / STEP)
    np.testing.assert_allclose(known.B / sd, np.column_stack(moved) / sd, atol=0.05)
    assert (np.abs(known.B / sd) > 0.5).any(axis=0).sum() >= 2
    np.testing.assert_allclose(np.diag(known.L), np.concatenate([s[1] for s in sds()]), rtol=1e-12)


def sds() -> list[tuple[str, Array]]:
    """Prior sds in the order of the table [unit]."""
    unit = {name: np.deg2rad(1.0) if TABLE[name].angular else 1.0 for name in SD}
    return [(name, np.full(TABLE[name].dim, unit[name] * SD[name])) for name in TABLE if name in SD]


def test_filter_and_smoother_agree_on_the_newest_keyframe(case):
    """Where attitude and calibration are known well, so that it hardly matters where they were linearised."""
    config = started(case, start={"heading_sd_deg": 0.5}, calibration={"dvl_yaw": {"sd_deg": 0.5}})
    P, known = optimum(case, config).newest_covariance(), plain_filter(case, config).known
    sd = np.sqrt(np.diag(P))[:9]
    np.testing.assert_allclose(np.sqrt(np.diag(known.covariance))[:9], sd, rtol=0.1)


def test_a_filter_goes_on_from_the_smoothers_covariance_with_what_is_considered(case):
    config = started(case)
    again = renewed(case.log, config)
    k = int(np.flatnonzero(again.problem.time - again.problem.time[0] >= 20.0)[0])
    n, columns = len(again.engine.start().L), again.engine.layout.columns
    assert again.known.B.shape == (again.engine.layout.size, n) and 0 < k < len(again.problem)
    for name, sd in sds():
        own = np.r_[columns[name]] - again.engine.layout.size
        assert (np.sqrt(np.diag(again.known.L @ again.known.L.T))[own] <= 1.001 * sd).all()
    assert np.isfinite(again.known.covariance).all()


def test_what_a_dive_shows_is_estimated_and_the_rest_is_considered():
    """In waves, a DVL whose place is 15 cm off turns with the vehicle: that shows it to a gyro of little noise."""
    considered = {"dvl_lever_arm": {"estimate": "considered"}, "dvl_scale": {"estimate": "considered"}}
    config = falcon(calibration=considered, imu={"noise": {"gyr": 5e-5}})
    case = simulated(config, 60.0, seed=2, calibration={"dvl_lever_arm": [0.15, 0.0, 0.0], "dvl_scale": 0.0})
    estimate = batch(case.log, started(case)).solve()
    rows = {c.label: c for c in estimate.calibration}
    arm, scale = rows["dvl_lever_arm_x"], rows["dvl_scale"]
    assert arm.estimated and abs(arm.value - 0.15) < 4.0 * arm.sd + 0.02
    assert not scale.estimated and (scale.verdict, scale.sd) == ("considered", scale.prior_sd)
    assert estimate.summary["considered"] == ["dvl_scale"]


TILTED = 5.0  # deg, 2.5 sds


def tilted(pitch_deg: float) -> tuple[Simulated, Config]:
    """A fast dive with a good gyro whose DVL is tilted by more than its gate allows for."""
    considered = {"dvl_pitch": {"estimate": "considered", "sd_deg": 2.0}}
    config, path = falcon(calibration=considered, imu={"noise": {"gyr": 2e-5}}), scenario("lawnmower", 60.0, 1.5)
    case = simulated(config, 60.0, 1, path, dvl_rate=2.0, calibration={"dvl_pitch": np.deg2rad(pitch_deg)})
    return case, started(case)


def test_a_tilt_within_its_prior_is_estimated_though_it_has_all_pings_rejected_where_it_is_held():
    case, config = tilted(TILTED)
    best = batch(case.log, config).optimum()
    assert best.solution.gates["dvl"].mean() > 0.98 and "dvl_pitch" in best.unknowns.estimated
    sd = np.sqrt(best.covariances()["dvl_pitch"][-1, 0, 0])
    assert abs(best.state.calibration["dvl_pitch"][0] - np.deg2rad(TILTED)) < 4.0 * sd
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(optimum_module, "_contradicted", lambda best: False)
        assert batch(case.log, config).optimum().solution.gates["dvl"].mean() < 0.8


def test_a_tilt_far_beyond_its_prior_is_not():
    """A mounting that is named wrongly is no mounting that is known badly: alarms say so."""
    case, config = tilted(12.0)
    assert "dvl_pitch" in batch(case.log, config).optimum().unknowns.considered


def test_a_silent_dvl_leaves_its_constants_out_of_what_follows():
    """What no ping carries cannot make the track uncertain: without a DVL, depth alone is."""
    config = falcon(calibration=believing())
    case = simulated(config, 31.0, seed=1)
    silent = interrupted(case.log, 0.0, 32.0, "dvl", "dvl_heading")
    dive = batch(silent, started(case))
    assert set(dive.optimum().unknowns.considered) == {"gyr_scale", "depth_offset"}


def dive_nees(seed: int, estimate: bool | str) -> Array:
    """NEES of position, velocity, attitude: smoothed at mid-dive, and filtered at the end; shape (2, 3)."""
    truth = falcon(calibration=believing())
    case = simulated(truth, 60.0, seed=seed, style=CALM, dvl_rate=2.0)
    config = started(case, calibration=believing(estimate))
    smooth, filtered = batch(case.log, config).solve().trajectory, renewed(case.log, config).solve().trajectory
    return np.array([nees(smooth, case, len(smooth) // 2), nees(filtered, case, -1)])


@pytest.mark.slow
def test_errors_are_as_large_as_stated_where_instruments_are_not_exact_and_larger_where_they_are_taken_as_exact():
    seeds = range(24)
    honest = np.mean([dive_nees(seed, "considered") for seed in seeds], axis=0)
    boastful = np.mean([dive_nees(seed, False) for seed in seeds], axis=0)
    low, high = band(len(seeds))
    assert (honest < high).all() and (honest > 0.5 * low).all()
    assert (boastful[:, 0] > high).all()


@pytest.mark.parametrize("name", ["dvl_time_offset", "current", "fix_error"])
def test_what_moves_stamps_or_walks_cannot_be_considered(name):
    with pytest.raises(InputError, match=rf"calibration\.{name}\.estimate"):
        parse_config(f"calibration: {{{name}: {{estimate: considered}}}}")


@pytest.mark.parametrize("changes", ["walk_deg: 0.1", "time_constant_s: 20"])
def test_a_walk_of_what_is_considered_is_refused_and_not_passed_over(changes):
    for stated in ("estimate: considered, ", ""):
        with pytest.raises(InputError, match=rf"calibration\.dvl_yaw.*{changes.split(':')[0]}"):
            parse_config(f"calibration: {{dvl_yaw: {{{stated}{changes}}}}}")
    assert parse_config(f"calibration: {{dvl_yaw: {{estimate: true, {changes}}}}}")


def test_what_is_estimated_in_any_case_cannot_be_left_to_a_search_that_does_not_look_for_it():
    with pytest.raises(InputError, match=r"calibration\.water_oscillation\.estimate"):
        parse_config("calibration: {water_oscillation: {estimate: auto}}")
    automatic = [n for n, e in parse_config("").calibration if e.estimate == AUTO]
    assert sorted(automatic) == sorted(LASTING)


def test_a_word_that_is_none_is_refused():
    with pytest.raises(InputError, match=r"calibration\.dvl_scale\.estimate"):
        parse_config("calibration: {dvl_scale: {estimate: maybe}}")


def test_the_effective_configuration_comes_back():
    config = parse_config("calibration: {dvl_scale: {estimate: considered}, dvl_roll: {estimate: false}}")
    again = parse_config(config.to_yaml())
    assert again == config
    assert beliefs(again)["dvl_scale"].considered and not beliefs(again)["dvl_roll"].considered
    assert beliefs(parse_config("{}"))["dvl_roll"].considered, "the default"
