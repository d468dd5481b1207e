"""The fault campaign: its simulator proves itself without rovgraph, its judge tells the outcomes apart."""

import ast
import re
import sys
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import faults  # noqa: E402
from fault_campaign import earth  # noqa: E402
from fault_campaign.campaign import keep_dive, read_dives, run, run_case, table  # noqa: E402
from fault_campaign.cases import CASES, FAULTS, HEALTHY  # noqa: E402
from fault_campaign.instruments import at_arm, dvl, log_table, sample  # noqa: E402
from fault_campaign.judge import QUANTITIES, Dive, NoTrace, Result, honest_nees, judge, nees, run_dive  # noqa: E402
from fault_campaign.motion import Motion, Profile, mounting, strapdown  # noqa: E402
from fault_campaign.scenarios import SCENARIOS, make_motion  # noqa: E402
from fault_campaign.vehicle import configuration, make_vehicle  # noqa: E402

AT_ONCE = np.zeros(1)
REST = Motion(20.0, Profile(0.7), (Profile(), Profile(), Profile()), depth=3.0)


def returned(motion, seconds, arm):
    """Where the strapdown ends from samples at ``arm``, and where the arm is: local coordinates [m]."""
    period = 0.01
    middles = np.arange(0.0, seconds, period) + 0.5 * period
    force, rate = motion.averages(middles, period, arm)
    C_nb, start = motion.C_nb(AT_ONCE)[0], motion.geodetic(AT_ONCE)[0]
    v_n, offset = C_nb @ (motion.v_b(AT_ONCE) + np.cross(motion.rate_nb_b(AT_ONCE), arm))[0], C_nb @ arm
    meridian, transverse = earth.radii(start[0])
    start += np.array([offset[0] / meridian, offset[1] / (transverse * np.cos(start[0])), -offset[2]])
    end = strapdown(force, rate, period, C_nb, v_n, start)[-1:]
    return earth.local(*end.T, motion.origin)[0], at_arm(motion, np.array([seconds]), arm)[0]


@pytest.fixture(scope="module")
def lively():
    return make_motion("survey, waves", np.random.default_rng(5))


def test_normal_gravity_is_the_published_one():
    """WGS-84 (TR8350.2): equator, pole, 45 degrees; the free-air gradient."""
    latitudes = np.deg2rad([0.0, 90.0, 45.0])
    assert earth.gravity(latitudes, np.zeros(3)) == pytest.approx([9.7803253359, 9.8321849379, 9.8061977694], abs=2e-9)
    gradient = earth.gravity(latitudes[2], np.asarray(-50.0)) - earth.gravity(latitudes[2], np.asarray(50.0))
    assert gradient / 100.0 == pytest.approx(3.085e-6, rel=1e-3)


def test_radii_and_coordinates_are_the_published_ones():
    """Semi-minor axis and polar radius of curvature of WGS-84 (TR8350.2, table 3.3)."""
    assert earth.ecef(np.pi / 2, 0.0, 0.0)[2] == pytest.approx(6356752.3142, abs=1e-4)
    assert earth.radii(np.pi / 2) == pytest.approx((6399593.6258, 6399593.6258), abs=1e-4)
    assert earth.radii(0.0) == pytest.approx((6335439.3273, 6378137.0), abs=1e-4)


@pytest.mark.parametrize("latitude", [0.0, 30.0, 58.3, -45.0])
def test_earth_rate_points_north_and_up_as_the_latitude_says(latitude):
    north, east, down = np.rad2deg(earth.earth_rate(np.deg2rad(latitude))) * 3600.0
    expected = 15.0410669 * np.array([np.cos(np.deg2rad(latitude)), 0.0, -np.sin(np.deg2rad(latitude))])
    assert [north, east, down] == pytest.approx(expected, abs=1e-5)


def test_at_rest_the_samples_are_gravity_and_earth_rate():
    force, rate = REST.averages(np.array([5.0]), 0.01, np.array([0.3, -0.2, 0.1]))
    assert force[0] == pytest.approx([0.0, 0.0, -earth.gravity(REST.origin[0], -3.0)], abs=1e-8)
    expected = REST.C_nb(AT_ONCE)[0].T @ earth.earth_rate(np.asarray(REST.origin[0]))
    assert rate[0] == pytest.approx(expected, abs=1e-12)


def test_samples_are_averages_over_their_period(lively):
    arm, period, middle = np.array([0.4, -0.3, 0.2]), 0.1, np.array([37.4])
    dense = middle + (np.arange(2000) + 0.5) / 2000.0 * period - 0.5 * period
    for average, values in zip(lively.averages(middle, period, arm), lively.felt(dense, arm), strict=True):
        assert average[0] == pytest.approx(values.mean(axis=0), abs=1e-6)
        assert np.abs(average[0] - lively.felt(middle, arm)[0][0]).max() > 1e-4


@pytest.mark.parametrize("arm", [(0.0, 0.0, 0.0), (0.5, -0.3, 0.2)])
def test_a_strapdown_with_perfect_samples_returns_to_the_truth(lively, arm):
    end, truth = returned(lively, 40.0, np.array(arm))
    assert np.linalg.norm(truth[:2]) > 5.0
    assert end == pytest.approx(truth, abs=0.01)


def test_a_strapdown_that_forgets_the_earth_does_not_return(lively, monkeypatch):
    exact = earth.earth_rate
    monkeypatch.setattr(earth, "earth_rate", lambda latitude: exact(latitude) if np.ndim(latitude) else np.zeros(3))
    end, truth = returned(lively, 40.0, np.zeros(3))
    assert np.linalg.norm((end - truth)[:2]) > 1.0


def test_position_is_the_integral_of_the_velocity(lively):
    t, h = np.array([20.0, 77.7]), 0.01
    moved = (lively.local(t + h) - lively.local(t - h)) / (2.0 * h)
    assert moved == pytest.approx(lively.v_n(t), abs=2e-4)


def test_a_ping_is_the_motion_of_the_dvl_itself(lively):
    """Velocity at the arm, by differences of its place, in the instrument's axes."""
    vehicle = make_vehicle("mti", ())
    vehicle.dvl.sd = (0.0, 0.0, 0.0)
    C_bs, h = mounting(vehicle.dvl.mount_rpy_deg), 0.005
    pings = dvl(lively, vehicle, C_bs, 0.0, np.random.default_rng(0)).iloc[100:110]
    t, arm = pings["time"].to_numpy(), np.asarray(vehicle.dvl.arm)
    v_n = (at_arm(lively, t + h, arm) - at_arm(lively, t - h, arm)) / (2.0 * h)
    expected = np.einsum("ij,nkj,nk->ni", C_bs.T, lively.C_nb(t), v_n)
    assert pings[["dvl_vx", "dvl_vy", "dvl_vz"]].to_numpy() == pytest.approx(expected, abs=5e-4)


def test_the_simulator_imports_nothing_of_rovgraph():
    """But the command that is judged, and the pool of processes."""
    allowed = {"judge": {"rovgraph.cli.app"}, "campaign": {"rovgraph.workers"}}
    for path in (BENCHMARKS / "fault_campaign").glob("*.py"):
        nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        found = {n.module for n in nodes if isinstance(n, ast.ImportFrom) and (n.module or "").startswith("rovgraph")}
        assert found == allowed.get(path.stem, set()), path.name


def test_every_fault_has_a_healthy_case_and_words_that_name_it():
    settings = {case.setting for case in HEALTHY}
    assert all(case.healthy for case in HEALTHY)
    assert len(settings) == len(HEALTHY)
    assert len(CASES) == len(HEALTHY) + len(FAULTS)
    for case in FAULTS:
        assert case.setting in settings, case.name
        assert case.says, case.name
        assert not re.search(case.says, "assumed: heading from ahrs", re.IGNORECASE) or "heading" in case.says


def test_every_fault_of_a_log_changes_it():
    motion, rng = make_motion("dives", np.random.default_rng(1)), np.random.default_rng(2)
    streams, _ = sample(motion, make_vehicle("mti", ("ahrs", "mag", "depth", "fix")), rng)
    before = log_table(streams)
    for case in FAULTS:
        if case.on_log is not None:
            copies = {name: stream.copy() for name, stream in streams.items()}
            case.on_log(copies, motion, np.random.default_rng(3))
            after = log_table(copies)
            assert np.isfinite(after["time"]).all(), case.name
            assert not after.equals(before), case.name


def test_scenarios_stay_in_the_water_and_differ_by_seed():
    for name in SCENARIOS:
        motion = make_motion(name, np.random.default_rng(1))
        t = np.arange(0.0, motion.duration, 1.0)
        assert motion.local(t)[:, 2].min() > 0.5, name
        assert motion.heading(AT_ONCE) != make_motion(name, np.random.default_rng(2)).heading(AT_ONCE)


@pytest.mark.parametrize(
    ("name", "healthy"),
    [
        ("heading 90 degrees off", {"heading": Profile(0.7 + np.pi / 2.0)}),
        ("depth of a wrong surface", {"depth": 3.0 + 8.3}),
    ],
)
def test_a_fault_without_a_trace_is_the_log_of_another_healthy_dive(name, healthy):
    """Sample by sample, but for what no such IMU sees of the Earth's rate and of gravity's change with depth."""
    case, logs = CASES[name], []
    for motion, faulty in ((REST, True), (replace(REST, **healthy), False)):
        vehicle = make_vehicle(case.grade, case.aids)
        vehicle.ahrs.curve_sd = 0.0  # a deviation changes with the heading
        if faulty and case.on_vehicle is not None:
            case.on_vehicle(vehicle)
        streams, _ = sample(motion, vehicle, np.random.default_rng(4))
        if faulty and case.on_log is not None:
            case.on_log(streams, motion, np.random.default_rng(5))
        logs.append(streams)
    for sensor, stream in logs[0].items():
        difference = stream - logs[1][sensor]
        if sensor == "ahrs":
            difference["ahrs_yaw"] = np.angle(np.exp(1j * difference["ahrs_yaw"]))
        assert difference.abs().max().max() < (2e-4 if sensor == "imu" else 1e-9), sensor


def test_only_a_fault_can_be_without_a_trace_and_its_reason_names_quantities():
    reasons = [case.no_trace for case in HEALTHY + FAULTS if case.no_trace]
    assert not any(case.no_trace for case in HEALTHY)
    assert all(r.why and r.quantities and set(r.quantities) <= set(QUANTITIES) for r in reasons)


# --- the judge -----------------------------------------------------------------------------------


def drawn_track(motion, sd, stated, rng):
    """A trajectory file's rows with errors of ``sd`` that say ``stated``."""
    t = np.arange(10.0, 19.0, 0.01)
    p = motion.local(t) + rng.normal(0.0, sd, (len(t), 3))
    frame = pd.DataFrame(p, columns=["north", "east", "down"]).assign(time=t, cov_north_east=0.0)
    frame["yaw"] = motion.heading(t) + rng.normal(0.0, sd, len(t)) + 2.0 * np.pi
    return frame.assign(**{f"{name}_sd": stated for name in ("north", "east", "down", "yaw")})


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_nees_is_one_for_honest_errors_and_the_square_of_their_excess(factor):
    values, rms, sd = nees(drawn_track(REST, 0.1 * factor, 0.1, np.random.default_rng(0)), REST)
    assert list(values.values()) == pytest.approx([factor**2] * 3, rel=0.15)
    assert (rms, sd) == pytest.approx((0.1414 * factor, 0.1414), rel=0.1)


def test_nees_sees_the_correlation_of_north_and_east():
    track = drawn_track(REST, 0.0, 0.1, np.random.default_rng(0)).assign(cov_north_east=0.008)
    along, across = (track.assign(north=track.north + 0.1, east=track.east + e) for e in (0.1, -0.1))
    assert nees(along, REST)[0]["position"] == pytest.approx(1.0 / 1.8, rel=1e-6)
    assert nees(across, REST)[0]["position"] == pytest.approx(1.0 / 0.2, rel=1e-6)


def dives(value, count=20, sd=1.0, said=(), refused=False):
    if refused:
        return [Result(said=said, refused=True)] * count
    return [Result({"smoothed": {"position": value}}, {"smoothed": 1.0}, {"smoothed": sd}, said)] * count


NAMED = ("warning: dvl: frozen for 60.0 s",)


@pytest.mark.parametrize(
    ("results", "verdict"),
    [
        (dives(1.0), "right"),
        (dives(1.0, sd=2.0), "wide"),
        (dives(9.0), "lie"),
        (dives(9.0, said=NAMED), "loud"),
        (dives(9.0, said=("warning: something else",)), "lie"),
        (dives(9.0, 19, said=NAMED) + dives(9.0, 1), "loud"),
        (dives(9.0, 18, said=NAMED) + dives(9.0, 2), "lie"),
        (dives(9.0, refused=True), "loud"),
        (dives(9.0, 10, refused=True) + dives(9.0, 10), "lie"),
        (dives(9.0, 10, said=NAMED) + dives(1.0, 10), "loud"),  # a dive that is right needs no warning
        (dives(9.0, 10, said=NAMED) + dives(2.1, 10), "lie"),
    ],
)
def test_outcomes(results, verdict):
    assert judge(results, "frozen", dives(1.0)).verdict == verdict


UNSEEN = NoTrace("the same equations", ("position",), "rests on")
RESTS = ("assumed: rests on the prior",)


@pytest.mark.parametrize(
    ("results", "no_trace", "verdict"),
    [
        (dives(9.0, said=RESTS), UNSEEN, "no trace"),
        (dives(9.0, said=RESTS), None, "lie"),
        (dives(9.0), UNSEEN, "lie"),  # it is not said what the position rests on
        (dives(9.0), replace(UNSEEN, rests_on=""), "no trace"),
        (dives(9.0, said=RESTS), replace(UNSEEN, quantities=("depth",)), "lie"),  # depth is no excuse for the position
        (dives(9.0, 19, said=RESTS) + dives(9.0, 1), UNSEEN, "lie"),
        (dives(9.0, said=RESTS + NAMED), UNSEEN, "loud"),
        (dives(1.0, said=RESTS), UNSEEN, "right"),
    ],
)
def test_what_no_log_can_show_is_neither_right_nor_a_lie(results, no_trace, verdict):
    assert judge(results, "frozen", dives(1.0, said=RESTS), no_trace).verdict == verdict


def test_the_page_gives_the_reason_of_a_fault_without_a_trace():
    case = CASES["depth of a wrong surface"]
    outcome = replace(judge(dives(9.0), "frozen"), nees={})
    asked = Namespace(seeds=20, version=None, online=False)
    assert case.no_trace.why not in faults.page([case], {case.name: outcome}, asked)
    told = faults.page([case], {case.name: replace(outcome, verdict="no trace")}, asked)
    assert "1 no trace, 0 lie." in told
    assert f"*{case.name}*: {case.no_trace.why}" in told


@pytest.mark.parametrize(
    ("name", "verdict", "code"),
    [
        ("survey", "right", 0),
        ("survey", "wide", 1),
        ("depth of a wrong surface", "no trace", 0),
        ("depth of a wrong surface", "lie", 1),
    ],
)
def test_the_exit_code_is_1_for_a_lie_and_for_a_healthy_dive_that_is_not_right(name, verdict, code, monkeypatch):
    outcome = replace(judge(dives(1.0), "frozen"), verdict=verdict, nees={})
    monkeypatch.setattr(faults, "run", lambda *_: {name: outcome})
    monkeypatch.setattr(sys, "argv", ["faults.py", "--cases", name])
    assert faults.main() == code


def test_what_one_command_says_is_no_excuse_for_the_other():
    both = {"smoothed": {"position": 9.0}, "online": {"position": 9.0}}
    size = {"smoothed": 1.0, "online": 1.0}
    online_only = Result(both, size, size, ("online: dvl: frozen",))
    assert judge([online_only] * 20, "frozen").verdict == "lie"
    assert judge([replace(online_only, said=(*online_only.said, *NAMED))] * 20, "frozen").verdict == "loud"


def test_what_is_said_of_healthy_dives_too_names_nothing():
    healthy = dives(1.0, said=("warning: dvl: frozen for 1.5 s",))
    assert judge(dives(9.0, said=NAMED), "frozen", healthy).verdict == "lie"


def test_one_bad_quantity_of_one_estimate_is_enough():
    result = Result({"smoothed": {"position": 1.0}, "filtered": {"position": 1.0, "dvl_yaw": 5.0}}, {}, {})
    full = Result(result.nees, {"smoothed": 1.0, "filtered": 1.0}, {"smoothed": 1.0, "filtered": 1.0})
    outcome = judge([full] * 20, "x")
    assert outcome.verdict == "lie"
    assert outcome.worst == ("dvl_yaw, filtered", 5.0)


def test_few_seeds_allow_for_chance():
    assert honest_nees(20) == 2.0
    assert honest_nees(5) == pytest.approx(15.086 / 5, rel=1e-3)  # chi-square, 5 degrees of freedom, 99 %


def test_dives_that_were_kept_are_read_again(tmp_path):
    dive = dives(float("nan"), 1, said=NAMED)[0]
    keep_dive(tmp_path / "dives.jsonl", ("survey", 3, False), dive)
    found = read_dives(tmp_path / "dives.jsonl")
    assert list(found) == [("survey", 3, False)]
    assert list(found["survey", 3, False].said) == list(NAMED)


def test_a_dive_that_was_replayed_too_counts_for_smooth_alone_without_what_the_replay_added(tmp_path):
    both, sizes = {"smoothed": {"position": 1.0}, "online": {"position": 9.0}}, {"smoothed": 1.0, "online": 3.0}
    said = (*NAMED, f"online: {NAMED[0]}")
    keep_dive(tmp_path / "dives.jsonl", ("survey", 3, True), Result(both, sizes, sizes, said))
    alone = Result({"online": {"position": 1.0}}, {"online": 1.0}, {"online": 1.0}, ("online: late",))
    keep_dive(tmp_path / "dives.jsonl", ("two files, online", 0, True), alone)
    found = read_dives(tmp_path / "dives.jsonl")
    assert [found["survey", 3, False]] == dives(1.0, 1, said=NAMED)
    assert found["survey", 3, True].nees == both
    assert found["two files, online", 0, False].nees == alone.nees  # which no other command estimates


# --- through the command ----------------------------------------------------------------------------


def test_perfect_instruments_give_the_true_track():
    """Frames, mountings, arms and signs of simulator and estimator agree to centimetres."""
    motion, vehicle = (
        make_motion("survey, waves", np.random.default_rng(1)),
        make_vehicle("tactical", ("ahrs", "depth")),
    )
    config = configuration(vehicle)
    config["environment"]["earth_rotation"] = True
    for name in ("acc_noise", "gyr_noise", "acc_walk", "gyr_walk", "acc_bias_sd", "gyr_bias_sd", "matrix_sd"):
        setattr(vehicle.imu, name, 0.0)
    vehicle.ahrs.sd = vehicle.ahrs.offset_sd = vehicle.ahrs.curve_sd = vehicle.depth.sd = vehicle.dvl.yaw_sd = 0.0
    vehicle.dvl.sd = (0.0, 0.0, 0.0)
    streams, hidden = sample(motion, vehicle, np.random.default_rng(0))
    result = run_dive(Dive(streams, config, motion, hidden))
    assert not result.refused, result.said
    assert result.rms["smoothed"] < 0.03
    assert result.rms["filtered"] < 0.1


def test_a_dvls_arm_that_is_off_is_named_and_used_not_taken_for_an_error_that_lasts():
    result = run_case(CASES["dvl arm"], 0)
    told = [text for text in result.said if "calibration.dvl" in text]
    assert len(told) == 1 and "(calibration.dvl_lever_arm)" in told[0]
    assert result.rms["smoothed"] < 0.3  # 0.42 m with dvl_error in its place
    assert result.nees["smoothed"]["dvl_yaw"] < 2.0  # 3.3


@pytest.mark.parametrize(
    ("case", "remedy"),
    [
        ("dvl y flipped", "units: {dvl_vy: -m/s}"),  # its wrong estimate has a turn of 90 degrees in its place
        ("dvl y and z flipped", "dvl.mount_rpy_deg: [0.0, 0.0, -45.0]"),
        ("dvl 3.2 s late", "mean: 3.188"),
    ],
)
def test_an_alarm_on_a_dvls_axes_or_clock_gives_the_remedy_of_the_check(case, remedy):
    told = [text for text in run_case(CASES[case], 0).said if text.startswith("alarm: dvl: its ") and "IMU" in text]
    assert len(told) == 1 and remedy in told[0] and "until that is mended the track is wrong" in told[0]


def test_online_a_dvl_whose_clock_is_late_is_not_said_to_be_elsewhere():
    result = run_case(CASES["dvl 3.2 s late"], 0, online=True)
    told = [text for text in result.said if text.startswith("online: ") and "dvl: " in text]
    assert any("its stamps are 3.1" in text for text in told)
    assert not any("elsewhere" in text for text in told)


def test_online_ignores_a_depth_that_is_stuck_while_the_vehicle_dives():
    result = run_case(CASES["depth stuck"], 0, online=True)
    assert max(result.nees["online"].values()) < 2.0  # of the depth 765 where it was used
    assert any(line.startswith("online: ") and "depth: frozen" in line for line in result.said)


def test_online_names_correlated_fixes_with_the_keys_that_state_them():
    result = run_case(CASES["fixes correlated"], 0, online=True)
    assert any("correlated over" in line and "state calibration.fix_error: {" in line for line in result.said)


@pytest.mark.slow
def test_a_campaign_of_two_cases_prints_their_rows():
    """A clock of another epoch is refused with its cause; the dive without the fault is estimated."""
    fault, healthy = CASES["dvl of another epoch"], CASES["survey"]
    outcomes = run([healthy, fault], 1, 1, False, lambda done: None, None)
    assert outcomes["dvl of another epoch"].verdict == "loud"
    assert outcomes["dvl of another epoch"].named == 1.0
    assert outcomes["survey"].refused == 0.0
    assert outcomes["survey"].rms["smoothed"] < 4.0 * outcomes["survey"].sd["smoothed"]
    rows = table([healthy, fault], outcomes).splitlines()
    assert rows[2].startswith("| survey | nothing |")
    assert "| refused | loud |" in rows[3]


@pytest.mark.slow
def test_healthy_dives_are_right():
    cases = [case for case in HEALTHY if "dvl_scale" not in case.name]  # the filter's dvl_scale: docs/faults.md
    outcomes = run(cases, 5, 2, False, lambda done: None, None)
    assert {name: o.verdict for name, o in outcomes.items() if o.verdict != "right"} == {}
