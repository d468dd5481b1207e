"""Noise that the configuration does not state: it is found, said and applied, and healthy dives have none."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from dives import altered, batch, changed, falcon, simulated, true_at

from rovgraph.diagnosis.statistics import find_alarms
from rovgraph.diagnosis.unstated_noise import find_errors, find_noise, noise_factor, unstated
from rovgraph.dive import smooth
from rovgraph.inference.chain import Chain
from rovgraph.inference.correlated_noise import LASTING, LinearConstants, _Baseline, find_correlated_noise, window_chi2
from rovgraph.model.calibration import TABLE
from rovgraph.model.config import beliefs, parse_config
from rovgraph.model.gauss_markov import stationary_walk
from rovgraph.simulate.files import known

SHORT = {"dvl_rate": 3.0, "imu_rate": 50.0, "start_error": True}
ERROR = {"estimate": True, "sd": 1.0, "time_constant_s": 20.0}
WHITE = {"fix": {"sd_m": 0.3}}


def with_fixes(seed=1, **calibration):
    """A dive, and what an estimator is told, to whom all noise is white."""
    case = simulated(falcon(**WHITE, calibration=calibration), 120.0, seed=seed, fix_interval=1.0, **SHORT)
    return case, changed(known(case.dive, case.config), calibration={name: {"estimate": False} for name in calibration})


def unsaid(config):
    """A configuration that leaves the errors that last to the log."""
    data = config.model_dump(exclude_unset=True)
    for name in LASTING:
        data.get("calibration", {}).pop(name, None)
    return type(config).model_validate(data)


def nees(case, dive, kind):
    """Normalised error squared of the horizontal position per component, mean over the second half."""
    t = next(e for e in dive.estimates if e.kind == kind).trajectory
    half = slice(len(t) // 2, None)
    off, P = (t.p_n - true_at(case, t.time).p_n)[half, :2], t.cov_p[half, :2, :2]
    return float(np.mean(np.einsum("ni,ni->n", off, np.linalg.solve(P, off[..., None])[..., 0])) / 2)


@pytest.fixture(scope="module")
def correlated():
    return with_fixes(fix_error=ERROR)


@pytest.fixture(scope="module")
def found(correlated):
    return smooth(correlated[0].log, unsaid(correlated[1]))


def test_every_sensor_has_an_error_that_lasts():
    assert LASTING == {
        "fix_error": "fix",
        "ahrs_error": "ahrs",
        "dvl_compass_error": "dvl_heading",
        "dvl_error": "dvl",
        "vehicle_compass_error": "vehicle_heading",
        "bottom_velocity": "dvl",
        "depth_error": "depth",
        "usbl_direction_error": "usbl",
        "usbl_range_error": "usbl",
        "range_error": "range",
    }
    assert all(np.isfinite(TABLE[name].time_constant) for name in LASTING)


def test_fixes_whose_errors_last_are_found_and_believed_so(correlated, found):
    (one,) = found.estimates[0].summary["noise_found"]
    assert one["key"] == "calibration.fix_error" and one["values"]["estimate"]
    assert 0.4 < one["values"]["sd"] < 1.2 and 8.0 < one["values"]["time_constant_s"] < 50.0
    believed = found.initial.revealed.calibration["fix_error"]
    assert (believed.sd, believed.time_constant) == (one["values"]["sd"], one["values"]["time_constant_s"])
    assert "fix: its errors are correlated over" in found.assumptions[0]
    for kind in ("smoothed", "filtered"):
        assert nees(correlated[0], found, kind) < 2.0, kind


@pytest.mark.slow
@pytest.mark.parametrize("lasts", [True, False])
def test_an_estimate_that_goes_on_without_it_raises_an_alarm_with_the_keys_that_state_it(correlated, lasts):
    case, config = correlated if lasts else with_fixes(seed=3)
    config = unsaid(config) if lasts else changed(config, fix={"sd_m": 0.1})
    best = batch(case.log, config).optimum()
    (alarm,) = find_alarms([*unstated(best, config, [])], 0.0)
    key, _, value = alarm.text.split("; state ")[1].partition(": ")
    section, _, name = key.partition(".")
    stated = parse_config(f"{section}: {{{name}: {value}}}")
    (one,) = (find_errors if lasts else find_noise)(best, config, [])[0]
    assert (alarm.kind, alarm.sensor, key) == ("unstated", "fix", "calibration.fix_error" if lasts else "fix.sd_m")
    if lasts:
        own, theirs = beliefs(stated)["fix_error"], one.beliefs.calibration["fix_error"]
        assert (own.estimate, own.sd) == (theirs.estimate, pytest.approx(theirs.sd, rel=0.05))
        assert own.time_constant == pytest.approx(theirs.time_constant, rel=0.05)
    else:
        assert stated.fix.sd_m == pytest.approx(one.beliefs.noise["fix"] * config.fix.sd_m, rel=0.05)


@pytest.mark.slow
def test_what_the_configuration_says_of_an_error_stands(correlated):
    """And without the search the track is a lie, so the test above can fail."""
    case, config = correlated
    for told in (config, changed(unsaid(config), graph={"find_noise": False})):
        dive = smooth(case.log, told, "smoothed")
        found = [one["key"] for one in dive.estimates[0].summary.get("noise_found", [])]
        assert "calibration.fix_error" not in found
        assert nees(case, dive, "smoothed") > 4.0
        assert not found or dive.verdict != "trusted"  # another cause was taken for it, which the verdict says


@pytest.mark.slow
def test_a_default_that_is_written_out_means_the_same():
    """The start from the first fix, and errors that last from the dive: to the last bit."""
    case, config = with_fixes(seed=5, fix_error=ERROR)
    start = {key: value for key, value in config.model_dump()["start"].items() if key not in ("north_m", "east_m")}
    sparse = unsaid(config).model_copy(update={"start": type(config.start)(**start)})
    written = parse_config(sparse.to_yaml())
    assert not sparse.start.located and not written.start.located
    one, other = (smooth(case.log, c, "smoothed").estimates[0] for c in (sparse, written))
    assert one.summary["noise_found"] == other.summary["noise_found"] != []
    np.testing.assert_array_equal(one.trajectory.p_n, other.trajectory.p_n)
    np.testing.assert_array_equal(one.trajectory.cov_p, other.trajectory.cov_p)


def test_a_healthy_dive_is_solved_as_before():
    case, config = with_fixes(seed=2)
    dive, plain = (smooth(case.log, c, "smoothed") for c in (config, changed(config, graph={"find_noise": False})))
    assert "noise_found" not in dive.estimates[0].summary
    np.testing.assert_array_equal(dive.estimates[0].trajectory.p_n, plain.estimates[0].trajectory.p_n)


def test_search_costs_three_eliminations_of_a_healthy_dive_and_few_of_others(correlated, monkeypatch):
    calls, eliminate = [], Chain.eliminate
    monkeypatch.setattr(Chain, "eliminate", lambda *a, **b: (calls.append(1), eliminate(*a, **b))[1])
    for (case, config), errors, most in ((with_fixes(seed=2), 0, 3), (correlated, 1, 120)):
        best = batch(case.log, config).optimum()
        best.covariances()
        calls.clear()
        assert len(find_correlated_noise(best)[0]) == errors
        assert 0 < len(calls) <= most


def test_an_error_of_next_to_nothing_explains_nothing_where_the_dive_has_shown_what_was_considered():
    """A considered constant that is estimated stays so in the dive with the error, and is no part of its gain."""
    considered = {name: {"estimate": "considered"} for name, v in TABLE.items() if v.considered}
    case = simulated(falcon(calibration=considered), 60.0, seed=1, **SHORT)
    best = batch(case.log, case.config).optimum()
    assert {*best.unknowns.estimated} & {*considered}
    known = best.beliefs["dvl_error"]
    with_error = best.unknowns.with_lasting(replace(known, estimate=True, walk=stationary_walk(1e-5, 30.0)))
    assert {*best.unknowns.estimated} < {*with_error.estimated} and with_error.considered == best.unknowns.considered
    assert find_correlated_noise(best) == ([], [])
    root = best.chain.eliminate(best.linearised_at, best.solution.gates)
    assert best.linear == pytest.approx((root.log_determinant(), root.left), rel=1e-9)


def test_noise_three_times_what_is_stated_is_found_and_believed():
    case, config = with_fixes(seed=3)
    stated = changed(config, fix={"sd_m": 0.1})
    dive = smooth(case.log, stated, "smoothed")
    (one,) = dive.estimates[0].summary["noise_found"]
    assert one["key"] == "fix.sd_m" and one["values"] == pytest.approx(0.3, rel=0.2)
    assert dive.initial.revealed.noise["fix"] * stated.fix.sd_m == pytest.approx(one["values"])
    assert dive.initial.instruments["fix"].sd == pytest.approx(np.full(2, one["values"]))
    assert dive.assumptions[0].startswith("fix: its noise is ")


def test_outliers_and_gaps_are_no_noise():
    rng = np.random.default_rng(0)
    r = rng.standard_normal((600, 2))
    assert noise_factor(r) == pytest.approx(1.0, abs=0.08)
    r[::7] += 30.0
    assert noise_factor(r) < 1.35
    assert noise_factor(3.0 * r[:40]) is None


def test_an_error_that_lasts_is_not_taken_for_noise():
    """Differences leave it alone."""
    time = np.arange(1000.0)
    r = np.random.default_rng(1).standard_normal((1000, 1)) + 20.0 * np.sin(time / 60.0)[:, None]
    assert noise_factor(r) == pytest.approx(1.0, abs=0.1)


def test_fixes_that_jump_for_a_minute_do_not_spoil_the_search():
    """A dive that is broken in another way: the sd covers the track, or the line of the stretch says why not."""
    case, config = with_fixes(seed=4)
    data = case.log["fix"].data.copy()
    data[40:80, :2] += 4.0
    dive = smooth(altered(case.log, "fix", data), config, "smoothed")
    summary = dive.estimates[0].summary
    assert nees(case, dive, "smoothed") < 3.0
    assert summary["stretches_taken_out"] or "noise_found" in summary


def test_times_in_which_everything_was_rejected_do_not_count_as_agreement():
    time, r = np.arange(400.0), np.random.default_rng(1).standard_normal((400, 1))
    H = np.ones((400, 1, 1))
    part = SimpleNamespace(time=time[:120], normalised=lambda _: r[:120])
    whole = SimpleNamespace(time=time, normalised=lambda _: r)
    alone = window_chi2(part, None, H[:120], np.full(120, True))
    assert window_chi2(whole, None, H, time < 120.0) == pytest.approx(alone)
    assert window_chi2(whole, None, H, np.full(400, False)) == 1.0


def test_gains_of_constants_by_one_elimination_are_those_of_each_by_itself(correlated):
    best = batch(correlated[0].log, correlated[1]).optimum()
    chain, now = best.chain, _Baseline.of(best)
    names = ["dvl_scale", "gyr_scale", *(n for n, walk in chain.unknowns.walks.items() if walk == 0.0)]
    constants = LinearConstants.of(chain, now.solution, names)
    for name in names:
        for sd in (0.5 * chain.beliefs[name].sd, 10.0 * chain.beliefs[name].sd):
            assert constants.gain({name: sd}) == pytest.approx(now.linear_gain(name, sd, np.inf), abs=1e-6)
