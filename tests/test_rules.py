"""Each rule's limits, just below and just above, and the time that is said; no dive is estimated here."""

from dataclasses import replace
from math import hypot, inf, isfinite, nan, sqrt
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pandas as pd
import pytest
from dives import falcon, level_log
from scipy.stats import chi2, norm

from rovgraph.diagnosis import constants, motion, residuals
from rovgraph.diagnosis import motion as stretches
from rovgraph.diagnosis import residuals as sensors
from rovgraph.diagnosis.alarm import Alarm, Statistic, alarm_of, verdict_of
from rovgraph.diagnosis.evidence import Evidence, SensorResiduals
from rovgraph.diagnosis.statistics import find_advice, find_alarms
from rovgraph.geometry import EARTH_RATE, Array, matrix_from_rpy
from rovgraph.inference.estimate import CalibrationEstimate, Estimate, History
from rovgraph.inference.gauss_newton import FaultyInterval
from rovgraph.inference.score_test import ScoreTest
from rovgraph.inference.trajectory import Trajectory
from rovgraph.model.calibration import TABLE
from rovgraph.model.config import Config
from rovgraph.rules import (
    BELIEVED_SDS,
    CHANCE,
    COMPARISONS,
    RULES,
    Rule,
    Severity,
    comparison_table,
    remedy_of_lag,
    rule_table,
)

ALARMS = Path(__file__).parents[1] / "docs" / "alarms.md"
START, SECONDS, RATE = 1000.0, 300, 10  # of the dives here [s, s, Hz]
END = START + SECONDS
N = SECONDS * RATE
TIME = START + (np.arange(N) + 0.5) / RATE
BELOW, ABOVE = 0.999, 1.001
LEVELS = [("doubtful", BELOW, None), ("doubtful", ABOVE, "doubtful"), ("wrong", BELOW, "doubtful")]
LEVELS += [("wrong", ABOVE, "wrong")]
LOWER = LEVELS[:2]
levels = pytest.mark.parametrize(("limit", "times", "severity"), LEVELS)
lower = pytest.mark.parametrize(("limit", "times", "severity"), LOWER)


def figure_of(kind: str, limit: str, times: float) -> float:
    return float(getattr(RULES[kind], limit) * times)


def in_minute(k: int) -> Array:
    return np.asarray(k == (TIME - START) // 60.0)


def track(speed: float = 1.0, sd: float = 1.0) -> Trajectory:
    """North, an epoch a second; every sd is the same [m, rad]."""
    time = START + np.arange(SECONDS + 1.0)
    n = len(time)
    p_n = np.column_stack([speed * (time - START), np.zeros(n), np.zeros(n)])
    cov = np.tile(sd**2 * np.eye(3), (n, 1, 1))
    return Trajectory(time, p_n, np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), cov, cov.copy(), cov.copy())


def moved_by(t: Trajectory, axis: int, off: Array) -> Trajectory:
    p_n = t.p_n.copy()
    p_n[:, axis] += off
    return replace(t, p_n=p_n)


def frame(sensor: str, time: Array, normalised: Array, weight: Array) -> pd.DataFrame:
    columns = {"time": time, "sensor": sensor, "component": "x", "normalised": normalised, "weight": weight}
    return pd.DataFrame(columns)


def evidence(
    smoothed: pd.DataFrame | None = None,
    filtered: pd.DataFrame | None = None,
    nis: dict[str, Any] | None = None,
    t: Trajectory | None = None,
    **more: Any,
) -> Evidence:
    nothing = frame("dvl", np.zeros(0), np.zeros(0), np.zeros(0))
    t = track() if t is None else t
    both = [
        Estimate("smoothed", t, [], {}, nothing if smoothed is None else smoothed),
        Estimate("filtered", t, [], {}, nothing if filtered is None else filtered, {"nis": nis or {}}),
    ]
    given: dict[str, Any] = {
        "initial": SimpleNamespace(config=Config()),
        "optimum": None,
        "frozen": (),
        "log": {},
        **more,
    }
    return Evidence(estimates=both, problem=(), **given)


def span_of(one: Statistic | Alarm) -> tuple[float, float]:
    """From, to, since the dive began."""
    return pytest.approx(one.begin - START), pytest.approx(one.end - START)


@pytest.mark.parametrize("kind", RULES)
def test_each_limit_speaks_just_above_it(kind):
    rule = RULES[kind]

    def says(figure: float) -> Severity | None:
        return Statistic(kind, "dvl", 0.0, 1.0, figure, "so", "do").severity

    first = "advice" if rule.advice else "wrong" if rule.doubtful == rule.wrong else "doubtful"
    assert says(rule.doubtful) is None
    assert says(rule.doubtful * (1.0 - 1e-9)) is None
    assert says(rule.doubtful * (1.0 + 1e-9) + 1e-12) == first
    if isfinite(rule.wrong):
        assert says(rule.wrong * (1.0 + 1e-9)) == "wrong"
        if rule.doubtful < rule.wrong:
            assert says(rule.wrong) == "doubtful"
    else:
        assert says(1e300) == first


@pytest.mark.parametrize("kind", RULES)
def test_what_is_beyond_its_limit_is_the_verdict_and_advice_is_no_part_of_it(kind):
    rule = RULES[kind]
    beyond = Statistic(kind, "dvl", 10.0, 20.0, 1.01 * rule.doubtful + 1e-6, "so", "do")
    alarms, advice = find_alarms([beyond], 0.0), find_advice([beyond])
    (one,) = advice if rule.advice else alarms
    assert (one.kind, one.begin, one.end, one.limit) == (kind, 10.0, 20.0, rule.doubtful)
    assert verdict_of(alarms) == ("trusted" if rule.advice else one.severity)
    assert (alarms if rule.advice else advice) == []


def test_a_statistic_may_raise_its_limits_and_chance_raises_both():
    one = Statistic("too large", "dvl", 0.0, 1.0, 1.0, "so", "do", factor=1.5)
    assert (one.doubtful, one.wrong) == (3.0, 9.0)
    assert (replace(one, chance=4.0).doubtful, replace(one, chance=4.0).wrong) == (4.0, 9.0)
    assert (replace(one, chance=10.0).doubtful, replace(one, chance=10.0).wrong) == (10.0, 10.0)
    assert replace(one, certain=5.0).wrong == 5.0
    assert [replace(one, chance=4.0, figure=f).severity for f in (3.9, 4.1, 9.1)] == [None, "doubtful", "wrong"]


@pytest.mark.parametrize(
    ("doubtful", "wrong", "rate"),
    [(inf, inf, 0.0), (-1.0, 1.0, 0.0), (2.0, 1.0, 0.0), (inf, 1.0, 0.0), (nan, 1.0, 0.0), (1.0, nan, 0.0)]
    + [(1.0, 2.0, rate) for rate in (-1e-6, 0.05, 1.0, nan)],
)
def test_limits_that_say_never_or_always_and_rates_that_are_none_are_refused(doubtful, wrong, rate):
    with pytest.raises(ValueError, match="rule 'new'"):
        Rule("new", "a number", doubtful, wrong, rate)


def test_the_manual_has_the_table_of_the_rules():
    page = ALARMS.read_text(encoding="utf-8")
    assert f"<!-- rules -->\n{rule_table()}\n<!-- /rules -->" in page
    meanings = page[page.index("<!-- /rules -->") :]
    assert [kind for kind in RULES if f"\n- `{kind}`: " not in meanings] == []
    for kind, rule in RULES.items():
        (row,) = [line for line in rule_table().splitlines() if line.startswith(f"| `{kind}` |")]
        assert f"{rule.doubtful:.3g}" in row
        assert f"{rule.wrong:.3g}" in row or rule.wrong == inf


def test_the_manual_has_the_table_of_the_comparisons():
    page = ALARMS.with_name("check.md").read_text(encoding="utf-8")
    assert f"<!-- comparisons -->\n{comparison_table()}\n<!-- /comparisons -->" in page


@pytest.mark.parametrize("limits", COMPARISONS, ids=lambda limits: limits.compared)
@pytest.mark.parametrize(("times", "late"), [(BELOW, False), (ABOVE, True)])
def test_a_lag_is_neither_chance_nor_what_is_believed(limits, times, late):
    for mean in (0.0, -2.0):
        for sd, believed_sd, least in ((0.0, 0.0, limits.lag_s), (1.0, 0.0, limits.sds), (0.0, 1.0, BELIEVED_SDS)):
            for sign in (-1.0, 1.0):
                assert limits.is_late(mean + sign * times * least, sd, (mean, believed_sd)) == late
    assert not limits.is_late(99.0, nan, (0.0, 0.0))


def test_late_stamps_are_mended_by_what_is_known_already_and_what_is_left():
    config = falcon(delay_s={"fix": 0.5})
    assert remedy_of_lag(config, "fix", 1.0, 0.1) == "state delay_s: {fix: 1.5}, or correct fix.lever_arm_m"
    assert remedy_of_lag(config, "ahrs", 0.4, 0.1) == "state delay_s: {ahrs: 0.4}"
    assert remedy_of_lag(config, "dvl", 0.3, 0.01).endswith("{estimate: true, mean: 0.300, sd: 0.03}")


# residuals


@pytest.mark.parametrize(("out", "severity"), [(30, None), (31, "doubtful"), (300, "doubtful"), (301, "wrong")])
def test_rejected_is_the_share_of_the_worst_minute(out, severity):
    weight = np.ones(N)
    weight[np.flatnonzero(in_minute(2))[:out]] = 0.0
    (one,) = residuals.rejected(evidence(frame("dvl", TIME, np.zeros(N), weight)))
    assert (one.figure, one.severity) == (pytest.approx(out / 600), severity)
    assert span_of(one) == (120.0, 180.0)


def test_rejected_tells_from_the_first_bad_minute_to_the_last():
    weight = np.ones(N)
    weight[np.flatnonzero(in_minute(1))[:31]] = weight[np.flatnonzero(in_minute(3))[:40]] = 0.0
    (one,) = residuals.rejected(evidence(frame("dvl", TIME, np.zeros(N), weight)))
    assert (one.figure, span_of(one)) == (pytest.approx(40 / 600), (60.0, 240.0))


SINGLY, IN_PAIRS = np.arange(0, 60, 5), np.array([4, 5, 14, 15, 24, 25, 34, 35])
IN_A_ROW, TOO_MANY = np.arange(10, 18), np.arange(0, 60, 3)[:16]


@pytest.mark.parametrize(
    ("sensor", "out", "share"),
    [
        ("usbl", SINGLY, 0.0),
        ("usbl", IN_PAIRS, 0.0),
        ("usbl", TOO_MANY[:15], 0.0),
        ("usbl", TOO_MANY, 16 / 60),
        ("usbl", IN_A_ROW, 8 / 60),
        ("usbl", np.append(IN_A_ROW, 40), 8 / 60),
        ("range", SINGLY, 12 / 60),
        ("fix", IN_PAIRS, 8 / 60),
    ],
)
def test_of_a_usbl_single_outliers_are_no_evidence_and_those_that_follow_each_other_are(sensor, out, share):
    weight = np.ones(60)
    weight[out] = 0.0
    time = START + 0.5 + np.arange(60.0)
    (one,) = residuals.rejected(evidence(frame(sensor, time, np.zeros(60), weight)))
    assert one.figure == pytest.approx(share)


@pytest.mark.parametrize(("out", "share"), [(7, 0.0), (8, 8 / 60)])
def test_what_chance_rejects_of_few_is_no_share(out, share):
    assert residuals.share_rejected(np.array([out]), np.array([60]))[0] == pytest.approx(share)


@pytest.mark.parametrize(("out", "severity"), [(15, None), (16, "doubtful"), (30, "doubtful"), (31, "wrong")])
def test_rejected_is_of_the_dive_where_a_minute_has_too_few(out, severity):
    time, weight = START + 2.5 + 5.0 * np.arange(60), np.ones(60)
    weight[:out] = 0.0
    (one,) = residuals.rejected(evidence(frame("fix", time, np.zeros(60), weight)))
    assert one.severity == severity
    if severity:
        assert (one.figure, span_of(one)) == (pytest.approx(out / 60), (0.0, SECONDS))


@levels
def test_too_large_of_the_dive(limit, times, severity):
    square = figure_of("too large", limit, times)
    dive, _ = residuals.too_large(evidence(frame("dvl", TIME, np.full(N, sqrt(square)), np.ones(N))))
    assert (dive.figure, dive.severity, span_of(dive)) == (pytest.approx(square), severity, (0.0, SECONDS))


@levels
def test_too_large_of_the_worst_minute(limit, times, severity):
    square = 1.5 * figure_of("too large", limit, times)
    normalised = np.where(in_minute(3), sqrt(square), 0.0)
    dive, minute = residuals.too_large(evidence(frame("dvl", TIME, normalised, np.ones(N))))
    assert dive.severity is None
    assert (minute.figure, minute.severity, span_of(minute)) == (pytest.approx(square), severity, (180.0, 240.0))


def test_too_large_of_few_measurements_allows_for_chance():
    by_chance = float(chi2.isf(CHANCE, 20)) / 20
    assert by_chance > RULES["too large"].doubtful
    for times, severity in ((BELOW, None), (ABOVE, "doubtful")):
        assert residuals.too_large_in("dvl", 0.0, 1.0, times * by_chance, 20, 0.0).severity == severity


@levels
def test_innovations_by_the_mean_nis_per_dimension(limit, times, severity):
    square = figure_of("innovations", limit, times)
    nis = {"dvl": {"mean": 3.0 * square, "dim": 3, "count": 1000}, "fix": {"mean": 1e3, "dim": 2, "count": 19}}
    (one,) = residuals.innovations(evidence(nis=nis))
    assert (one.figure, one.severity, span_of(one)) == (pytest.approx(square), severity, (0.0, SECONDS))


def test_too_small_is_advice_by_the_same_mean():
    limit = 1.0 / RULES["too small"].doubtful
    said = [residuals.too_small_in("dvl", START, END, limit * times).severity for times in (ABOVE, BELOW)]
    assert said == [None, "advice"]


@pytest.mark.parametrize(("apart", "severity"), [(140, None), (141, "doubtful")])
def test_filter_alone_counts_what_it_rejected_and_the_smoother_took(apart, severity):
    met, taken = np.ones(N), np.ones(N)
    met[:200] = 0.0  # while it settles: no matter
    met[1000 : 1000 + apart] = 0.0
    met[2000:2100] = taken[2000:2100] = 0.0  # that both rejected
    both = [frame("dvl", TIME, np.zeros(N), weight) for weight in (taken, met)]
    (one,) = residuals.filter_alone(evidence(*both))
    assert (one.figure, one.severity) == (pytest.approx(apart / 2800), severity)
    assert (one.begin, one.end) == (TIME[1000], TIME[1000 + apart - 1])


@pytest.mark.parametrize(
    ("count", "severity"), [(100, None), (101, "doubtful"), (500, "doubtful"), (501, "wrong"), (1000, "wrong")]
)
def test_left_out_is_the_share_of_the_log(count, severity):
    depth = (np.arange(1000) / 10.0, np.zeros((1000, 1)))
    left_out = {("depth", "beyond depth.max_m"): count, ("depth", "frozen"): 1000, ("fix", "beyond"): 9}
    log = level_log(100.0, np.zeros(3), np.zeros(3), depth=depth)
    (one,) = residuals.left_out(evidence(left_out=left_out, log=log))
    assert (one.figure, one.severity, span_of(one)) == (pytest.approx(count / 1000), severity, (0.0, SECONDS))


def test_fixes_that_a_ship_recorded_for_longer_than_the_dive_are_no_fault_and_pings_are():
    row = (np.arange(100.0), np.zeros((100, 5)))
    log = level_log(100.0, np.zeros(3), np.zeros(3), fix=(row[0], row[1][:, :3]), dvl=row)
    reason = "after the last IMU sample"
    (one,) = residuals.left_out(evidence(left_out={("fix", reason): 80, ("dvl", reason): 80}, log=log))
    assert (one.sensor, one.severity) == ("dvl", "wrong")


@levels
def test_lasting_of_one_window_is_said_of_that_window(limit, times, severity):
    ratio = figure_of("lasting", limit, times)
    here = (TIME > START + 150.0) & (TIME < START + 155.0)
    normalised = np.where(here, sqrt(residuals.OF_ONE * ratio / here.sum()), 0.0)
    (one,) = residuals.correlated_residuals(evidence(frame("depth", TIME, normalised, np.ones(N))))
    assert (one.figure, one.severity, span_of(one)) == (pytest.approx(ratio), severity, (150.0, 155.0))


@levels
@pytest.mark.parametrize("seconds", residuals.LASTING_S)
def test_lasting_of_all_windows_of_a_length(limit, times, severity, seconds):
    ratio, count = figure_of("lasting", limit, times), seconds * RATE
    sign = (-1.0) ** ((TIME - START) // seconds)
    normalised = sign * sqrt(ratio / count)  # of the shorter length it cancels in the longer one
    one = next(residuals.correlated_residuals(evidence(frame("depth", TIME, normalised, np.ones(N)))))
    assert f"means over {seconds:g} s" in one.cause
    assert (one.figure, one.severity) == (pytest.approx(ratio), severity)
    assert one.end - one.begin == seconds


def test_lasting_allows_for_what_measurements_share():
    here = (TIME > START + 150.0) & (TIME < START + 155.0)
    normalised = np.where(here, sqrt(residuals.OF_ONE * 8.0 / here.sum()), 0.0)[:, None]
    r = SensorResiduals("depth", ("down",), TIME, normalised, np.ones(N), np.full((N, 1), 1.0 / here.sum()))
    (one,) = residuals.correlated_residuals_in(r, START, END)
    assert one.figure == pytest.approx(8.0 / 2.0)


# motion


@levels
@pytest.mark.parametrize("what", ["position", "depth", "heading"])
def test_estimates_are_compared_where_they_differ_most(what, limit, times, severity):
    square, s = figure_of("estimates", limit, times), track(sd=0.02)
    off = np.where(s.time == START + 200.0, sqrt(square * 2.0) * 0.02, 0.0)  # of two tracks as uncertain
    f = differing(s, what, off)
    said = [one for one in motion.separation_of(s, f, START) if one.kind == "estimates" and what in one.cause]
    assert [(one.figure, one.severity) for one in said] == [(pytest.approx(square), severity)]
    assert span_of(said[0]) == (200.0, 200.0)
    assert all(one.severity is None for one in motion.separation_of(s, f, START) if one.kind == "separation")


@levels
@pytest.mark.parametrize("what", ["position", "depth", "heading"])
def test_separation_is_of_the_whole_dive(what, limit, times, severity):
    square, s = figure_of("separation", limit, times), track(sd=0.02)
    axes = 2.0 if what == "position" else 1.0
    f = differing(s, what, np.full(len(s), sqrt(square * axes) * 0.02))
    said = [one for one in motion.separation_of(s, f, START) if one.kind == "separation" and what in one.cause]
    assert [(one.figure, one.severity) for one in said] == [(pytest.approx(square), severity)]
    assert span_of(said[0]) == (0.0, SECONDS)


@pytest.mark.parametrize("what", ["position", "depth", "heading"])
def test_a_filter_that_lacks_what_the_smoother_considers_is_not_contradicted_by_that(what):
    s = track(sd=0.2)
    f = differing(track(sd=0.01), what, np.full(len(s), 0.1))
    said = [one for one in motion.separation_of(s, f, START) if one.kind == "separation" and what in one.cause]
    axes = 2.0 if what == "position" else 1.0
    assert [(one.figure, one.severity) for one in said] == [(pytest.approx(0.25 / axes), None)]
    (sure,) = (one for one in motion.separation_of(f, s, START) if one.kind == "separation" and what in one.cause)
    assert sure.figure == pytest.approx(0.25 / axes)


def differing(s: Trajectory, what: str, off: Array) -> Trajectory:
    if what == "heading":
        return replace(s, R_nb=matrix_from_rpy(np.column_stack([0.0 * off, 0.0 * off, off])))
    return moved_by(s, 2 if what == "depth" else 1, off)


def test_a_filter_that_settles_is_not_compared():
    s = track(sd=0.02)
    f = moved_by(s, 0, np.where(s.time < START + motion.SETTLED_S, 100.0, 0.0))
    assert all(one.figure == 0.0 for one in motion.separation_of(s, f, START))


@lower
def test_found_is_the_rms_by_which_the_track_moved_in_its_sds(limit, times, severity):
    figure, t = figure_of("found", limit, times), track(sd=2.0)
    off = np.full(len(t), sqrt(2.0) * 2.0 * figure)
    off[200] *= 1.0 + 1e-5
    (one,) = motion.found_noise(evidence(t=t, before=moved_by(t, 1, off), revealed=[("fix", "its errors last")]))
    assert (one.sensor, one.figure, one.severity) == ("fix", pytest.approx(figure, rel=1e-4), severity)
    assert span_of(one) == (200.0, 200.0)


def test_a_move_for_which_the_sd_had_room_before_is_no_evidence_of_error():
    t, wide = track(sd=1.0), track(sd=4.0)
    off = np.full(len(t), 4.0 * sqrt(2.0))
    for before, figure in ((wide, 1.0), (t, 4.0)):
        (one,) = motion.found_noise(evidence(t=t, before=moved_by(before, 1, off), revealed=[("dvl", "its scale")]))
        assert one.figure == pytest.approx(figure)


@lower
def test_rivals_are_as_far_apart_as_their_tracks_rms(limit, times, severity):
    figure, t = figure_of("rivals", limit, times), track(sd=2.0)
    off = np.full(len(t), sqrt(2.0) * 2.0 * figure)
    off[100] *= 1.0 + 1e-5
    rival = SimpleNamespace(error=SimpleNamespace(sensor="fix", variable="fix_error"), p_n=moved_by(t, 0, off).p_n)
    optimum = SimpleNamespace(state=SimpleNamespace(p_n=t.p_n))
    (one,) = motion.rivals(evidence(t=t, rivals=[rival], optimum=optimum))
    assert (one.sensor, one.figure, one.severity) == ("fix", pytest.approx(figure, rel=1e-4), severity)
    assert span_of(one) == (100.0, 100.0)


@lower
@pytest.mark.parametrize(("speed", "allowed"), [(1.0, 75.0), (0.1, motion.LITTLE_M)])
def test_uncertain_is_an_sd_against_the_way_or_ten_metres(speed, allowed, limit, times, severity):
    t = track(speed)
    t.cov_p[220] = np.diag([0.5, 0.5, 0.0]) * (figure_of("uncertain", limit, times) * allowed) ** 2
    (one,) = motion.uncertain(evidence(t=t))
    assert (one.figure, one.severity) == (pytest.approx(times), severity)
    assert span_of(one) == (220.0, 220.0)


def of_motions(residuals_: Array, monkeypatch: pytest.MonkeyPatch) -> Evidence:
    """A dive with these whitened residuals of its motions, shape (n, 15), evenly over its time."""
    monkeypatch.setattr(motion, "_motion_residuals", lambda _: residuals_)
    times = START + (np.arange(len(residuals_) + 1) - 0.5) * SECONDS / len(residuals_)  # none ends where a window does
    bias = History(("x", "y", "z"), "", times, np.zeros((len(times), 3)), np.ones((len(times), 3)))
    seen = evidence(optimum=SimpleNamespace())
    smoothed = replace(seen.estimates[0], history={"acc_bias": bias, "gyr_bias": bias})
    problem = MagicMock(time=times, bridged=np.zeros(len(times), bool), __len__=lambda _: len(times))
    return replace(seen, estimates=[smoothed, seen.estimates[1]], problem=problem)


@levels
@pytest.mark.parametrize(("column", "said"), [(2, "its rotation about z"), (6, "its velocity along x")])
def test_imu_by_the_variance_of_its_means(column, said, limit, times, severity, monkeypatch):
    ratio, r = figure_of("imu", limit, times), np.zeros((600, 15))
    r[:, column] = sqrt(ratio / 40.0)  # 40 motions in 20 s
    r[280:320, column] *= 1.0 + 1e-5
    (one,) = [one for one in motion.imu_disagreement(of_motions(r, monkeypatch)) if one.figure > 0.0]
    assert one.cause.startswith(f"{said} contradicts")
    assert (one.figure, one.severity, span_of(one)) == (pytest.approx(ratio, rel=1e-5), severity, (140.0, 160.0))


@levels
@pytest.mark.parametrize(("column", "key"), [(10, "acc"), (12, "gyr")])
def test_bias_drift_by_the_sum_of_its_steps(column, key, limit, times, severity, monkeypatch):
    gone, r = figure_of("bias drift", limit, times), np.zeros((600, 15))
    r[:, column] = -gone / sqrt(600.0)  # of a walk whose every step has an sd of 1
    (one,) = [one for one in motion.bias_drift(of_motions(r, monkeypatch)) if one.figure > 0.0]
    assert f"imu.noise.{key}_walk" in one.remedy
    assert (one.figure, one.severity, span_of(one)) == (pytest.approx(gone), severity, (0.0, SECONDS))


# constants


def constant(value: float, sd: float = 0.2, prior_sd: float = 1.0) -> CalibrationEstimate:
    return CalibrationEstimate("dvl_scale", "", "DVL scale", True, value, sd, 0.5, prior_sd)


@pytest.mark.parametrize("several", [1, 5, 25, 60])
def test_the_limit_of_moved_is_chance_among_as_many_constants(several):
    (one,) = constants.moved_constant(constant(1.0), START, END, None, several)
    assert several * 2.0 * norm.sf(one.doubtful) == pytest.approx(RULES["moved"].rate)
    assert one.wrong / one.doubtful == pytest.approx(RULES["moved"].wrong / RULES["moved"].doubtful)
    if several == 25:
        assert one.doubtful == pytest.approx(RULES["moved"].doubtful, rel=1e-3)


@levels
@pytest.mark.parametrize("noise", [None, 0.2, 0.1])
def test_moved_by_the_variance_of_its_shift(noise, limit, times, severity):
    sd_of_shift = sqrt(1.0 + 0.2**2) if noise is None else sqrt(1.0 + 0.2**2 - 2.0 * noise**2)
    (unmoved,) = constants.moved_constant(constant(0.5), START, END, noise)
    figure = times * getattr(unmoved, limit)
    (one,) = constants.moved_constant(constant(0.5 - figure * sd_of_shift), START, END, noise)
    assert (one.figure, one.severity, span_of(one)) == (pytest.approx(figure), severity, (0.0, SECONDS))


def test_what_the_data_hardly_narrowed_has_not_moved():
    assert list(constants.moved_constant(constant(99.0, sd=0.96), START, END)) == []
    assert constants.sds_moved(*map(np.array, (99.0, 0.96, 0.5, 1.0))) == 0.0
    assert constants.sds_moved(*map(np.array, (99.0, 0.94, 0.5, 1.0))) > 50.0
    # linearisation may move what is hardly seen by a fifth of its prior's sd
    assert constants.sds_moved(*map(np.array, (1.5, 1.0, 0.5, 1.0, 1.0))) == pytest.approx(5.0)


@levels
def test_the_start_is_compared_with_where_it_is_stated(limit, times, severity):
    config = falcon(start={"north_m": 3.0, "east_m": -2.0, "position_sd_m": 2.0})
    fixes = frame("fix", TIME, np.zeros(N), np.ones(N))

    def said(off: float) -> Statistic:
        t = track(sd=0.5)
        t.p_n[:, :2] += np.array([3.0, -2.0 + off])
        (one,) = constants._start_moved(evidence(fixes, t=t, initial=SimpleNamespace(config=config)))
        return one

    figure = times * getattr(said(0.0), limit)
    one = said(figure * hypot(2.0, 0.5))  # how much of its sd is considered is not known
    assert (one.sensor, one.figure, one.severity) == ("start", pytest.approx(figure), severity)


@lower
def test_the_earth_rate_against_the_sd_of_the_gyros_bias(limit, times, severity):
    one = constants.earth_rate_of(EARTH_RATE / figure_of("earth rate", limit, times), START, END)
    assert (one.severity, span_of(one)) == (severity, (0.0, SECONDS))


@levels
@pytest.mark.parametrize("considered", [False, True])
def test_held_by_the_step_of_a_released_constant(considered, limit, times, severity, monkeypatch):
    """What is feigned and what is considered are part of its sd; a considered one is wrong from ten sds on."""
    sd, feigned, prior_sd = 0.002, constants.FEIGNED["dvl_scale"], 0.004
    allowed = hypot(sd, feigned, prior_sd if considered else 0.0)
    figure = times * (RULES["moved"].wrong if considered and limit == "wrong" else getattr(RULES["held"], limit))
    step = -figure * allowed
    hardly_seen = ScoreTest("dvl_roll", "dvl_roll", 99.0, 1.01 * constants.SHOWN * TABLE["dvl_roll"].sd)
    monkeypatch.setattr(
        constants, "score_test", lambda *_: [ScoreTest("dvl_scale", "dvl_scale", step, sd), hardly_seen]
    )
    belief = SimpleNamespace(mean=np.zeros(1), sd=prior_sd)
    unknowns = SimpleNamespace(considered=("dvl_scale",) if considered else ())
    best: Any = SimpleNamespace(state=track(), beliefs={"dvl_scale": belief}, unknowns=unknowns)
    (one,) = constants.contradicted_constants_in(best, falcon(), 0.01, START, END)
    assert (one.sensor, one.figure, one.severity) == ("dvl", pytest.approx(figure), severity)
    assert span_of(one) == (0.0, SECONDS)


@levels
def test_halves_by_the_filter_at_half_the_dive(limit, times, severity):
    sd = 0.4
    spread = sqrt(sd**2 - 0.1**2 + (constants.SHARE_OF_SD * sd) ** 2)
    off = figure_of("halves", limit, times) * spread
    time = START + np.array([0.0, 150.0, 300.0])
    history = History(("dvl_scale",), "", time, np.array([[0.0], [0.5 + off], [0.5]]), np.full((3, 1), sd))
    seen = evidence()
    smoothed = replace(seen.estimates[0], calibration=[constant(0.5, sd=0.1)])
    seen = replace(seen, estimates=[smoothed, replace(seen.estimates[1], history={"dvl_scale": history})])
    (one,) = constants.split_half_drift(seen)
    assert (one.figure, one.severity, span_of(one)) == (pytest.approx(off / spread), severity, (0.0, SECONDS))


# sensors


@lower
def test_frozen_by_its_seconds_in_all(limit, times, severity):
    seconds = figure_of("frozen", limit, times)
    one = sensors.frozen_for("dvl", START + 60.0, START + 60.0 + seconds, seconds, 1, START)
    assert (one.severity, span_of(one)) == (severity, (60.0, 60.0 + seconds))
    stretches_ = [(100.0, 100.0 + 0.5 * seconds, False), (150.0, 190.0, True), (200.0, 200.0 + 0.5 * seconds, False)]
    frozen = [SimpleNamespace(sensor="dvl", first=START + a, last=START + b, single=c) for a, b, c in stretches_]
    (one,) = sensors.frozen_sensors(evidence(frozen=frozen))
    assert (one.severity, span_of(one)) == (severity, (100.0, 200.0 + 0.5 * seconds))


@lower
@pytest.mark.parametrize("part", ["heading", "tilt"])
def test_no_attitude_by_the_longest_time_without(part, limit, times, severity):
    seconds = figure_of(f"no {part}", limit, times)
    lengths = [(30.0, 40.0 - 1.0, 3), (100.0, 100.0 + seconds, 5), (150.0, 200.0, 0)]
    gaps = [SimpleNamespace(part=part, begin=START + a, end=START + b, pings=n) for a, b, n in lengths]
    (one,) = sensors.no_attitude(evidence(attitude_gaps=gaps))
    assert (one.kind, one.severity, span_of(one)) == (f"no {part}", severity, (100.0, 100.0 + seconds))


def test_findings_that_the_data_are_wrong_count_unless_they_are_mended():
    late = SimpleNamespace(estimate=True)
    initial = SimpleNamespace(beliefs={"fix_time_offset": late, "dvl_time_offset": SimpleNamespace(estimate=False)})
    findings = [
        finding("dvl", "axes", True, "its axes are swapped; state dvl.mount_rpy_deg"),
        finding("fix", "axes", False, "may be off; look"),
        finding("fix", "lag", True, "is late; state delay_s"),
        finding("depth", "jump", True, "its clock was set"),
        finding("dvl", "lag", True, "is late"),
    ]
    said = list(sensors.findings_of_check(evidence(findings=findings, initial=initial)))
    assert [(one.sensor, one.cause, one.severity) for one in said] == [
        ("dvl", "its axes are swapped", "doubtful"),
        ("dvl", "is late", "doubtful"),
    ]
    assert [one.remedy for one in said] == ["state dvl.mount_rpy_deg", "rovgraph check has all findings"]
    assert span_of(said[0]) == (0.0, SECONDS)


def finding(sensor: str, kind: str, wrong: bool, text: str) -> Any:
    return SimpleNamespace(sensor=sensor, kind=kind, wrong=wrong, text=text)


def odd(sensor: str, begin: float, end: float, figure: float, kind: str = "lasting") -> Statistic:
    return Statistic(kind, sensor, START + begin, START + end, figure, "so", "do")


@pytest.mark.parametrize(
    ("figures", "severity"),
    [((3.99, 101.0), None), ((4.01, 4.1), "doubtful"), ((4.01, 101.0), "doubtful"), ((101.0, 102.0), "wrong")],
)
def test_two_alarms_at_a_time_are_a_contradiction_as_severe_as_the_milder(figures, severity):
    numbers = [odd("dvl", 0.0, 90.0, figures[0]), odd("depth", 60.0, 120.0, figures[1])]
    said = [one for one in find_alarms(numbers, START) if one.kind == "contradiction"]
    assert [one.severity for one in said] == ([severity] if severity else [])
    for one in said:
        assert span_of(one) == (60.0, 90.0)
        assert one.figure > one.limit


@pytest.mark.parametrize(("one", "other"), [("mag", "dvl_heading"), ("vehicle_heading", "dvl_heading")])
def test_every_two_compasses_may_contradict_each_other(one, other):
    numbers = [odd(sensor, 0.0, 90.0, 9.0) for sensor in (one, other)]
    assert f"{one}, {other}" in {alarm.sensor for alarm in find_alarms(numbers, START) if alarm.kind == "contradiction"}


@pytest.mark.parametrize(
    "other",
    [odd("depth", 90.1, 120.0, 9.0), odd("mag", 0.0, 90.0, 9.0), odd("depth", 0.0, 90.0, 99.0, "held")],
    ids=["at another time", "something else", "no residuals"],
)
def test_what_does_not_measure_the_same_at_the_same_time_is_no_contradiction(other):
    assert "contradiction" not in {one.kind for one in find_alarms([odd("dvl", 0.0, 90.0, 9.0), other], START)}


# stretches


@pytest.mark.parametrize(("seconds", "severity"), [(0.0, None), (0.1, "doubtful"), (250.0, "doubtful")])
def test_any_time_that_was_taken_out_is_doubtful(seconds, severity):
    one = stretches.excluded_interval(FaultyInterval("dvl", START + 40.0, START + 40.0 + seconds), START)
    assert (one.severity, span_of(one)) == (severity, (40.0, 40.0 + seconds))


@pytest.mark.parametrize(("more", "severity"), [(0.01, None), (-0.01, "doubtful")])
def test_a_choice_is_close_by_its_likelihood(more, severity):
    margin = -np.log(RULES["close"].doubtful) + more
    (one,) = stretches.ambiguous_optimum(evidence(optimum=SimpleNamespace(solution=SimpleNamespace(runner_up=margin))))
    assert (one.severity, span_of(one)) == (severity, (0.0, SECONDS))
    assert not list(
        stretches.ambiguous_optimum(evidence(optimum=SimpleNamespace(solution=SimpleNamespace(runner_up=inf))))
    )


def test_the_worst_of_a_kind_and_sensor_is_said_with_its_own_time():
    numbers = [odd("dvl", 0.0, 5.0, 20.0), odd("dvl", 60.0, 65.0, 50.0), odd("dvl", 80.0, 85.0, 3.0)]
    (one,) = find_alarms(numbers, START)
    assert (one.figure, span_of(one)) == (50.0, (60.0, 65.0))
    assert alarm_of(numbers[2]) is None
