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
from fault_campaign.campaign import keep_dive, make_dive, read_dives, run, run_case, table, verdicts  # noqa: E402
from fault_campaign.cases import CASES, DVL, FAULTS, HEALTHY, WATER  # noqa: E402
from fault_campaign.instruments import at_arm, dvl, log_table, sample  # noqa: E402
from fault_campaign.judge import (  # noqa: E402
    LIE_NEES,
    QUANTITIES,
    Dive,
    NoTrace,
    Result,
    Tally,
    honest_nees,
    judge,
    nees,
    run_dive,
)
from fault_campaign.motion import Motion, Profile, mounting, strapdown  # noqa: E402
from fault_campaign.scenarios import SCENARIOS, make_motion  # noqa: E402
from fault_campaign.vehicle import GRADES, configuration, make_vehicle  # noqa: E402

AT_ONCE = np.zeros(1)
AIDS = ("ahrs", "mag", "depth", "fix")
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


@pytest.mark.slow
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
    allowed = {"judge": {"rovgraph.cli.app"}, "campaign": {"rovgraph.lab.executors"}}
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


@pytest.mark.slow
def test_every_fault_of_a_log_changes_it():
    logs = {}
    for scenario in ("dives", "brisk turns"):
        motion, vehicle = make_motion(scenario, np.random.default_rng(1)), make_vehicle("mti", (*AIDS, "dvl_water"))
        logs[scenario] = motion, sample(motion, vehicle, np.random.default_rng(2))[0]
    for case in FAULTS:
        if case.on_log is not None:
            motion, streams = logs.get(case.scenario, logs["dives"])
            copies = {name: stream.copy() for name, stream in streams.items()}
            case.on_log(copies, motion, np.random.default_rng(3))
            after = log_table(copies)
            assert np.isfinite(after["time"]).all(), case.name
            assert not after.equals(log_table(streams)), case.name


def lost(name, *columns):
    """What the fault of a case takes from a stream of its dive: time, and the difference to the healthy one."""
    faulty, healthy = (make_dive(replace(CASES[name], on_log=on_log), 0) for on_log in (CASES[name].on_log, None))
    sensor = "dvl_water" if columns == WATER else columns[0].split("_")[0]
    a, b = (dive.streams[sensor] for dive in (healthy, faulty))
    return faulty, a["time"].to_numpy(), a[list(columns)].to_numpy() - b[list(columns)].to_numpy()


def test_a_dvl_on_a_hull_measures_against_the_hull():
    """0.15 m/s towards north-west by west, of which nothing is left before and after."""
    dive, t, taken = lost("dvl on a hull", *DVL)
    velocity_n = np.einsum("nij,nj->ni", dive.motion.C_nb(t), taken @ mounting((180.0, 0.0, -45.0)).T)
    assert velocity_n[(t > 42.0) & (t < 198.0)] == pytest.approx(np.array([[0.12, -0.09, 0.0]] * 780), abs=1e-9)
    assert np.abs(velocity_n[(t < 40.0) | (t > 200.0)]).max() == 0.0


def test_a_beam_at_half_its_velocity_bends_forward_and_vertical_velocity():
    dive, t, taken = lost("dvl one beam", *DVL)
    wrong = (t >= 80.0) & (t < 140.0)
    along = dive.streams["dvl"][list(DVL)].to_numpy()[wrong] + taken[wrong]
    along = along @ np.array([0.5, 0.0, np.sqrt(0.75)])
    assert np.abs(taken[:, 1]).max() < 1e-12
    assert taken[wrong, 0] == pytest.approx(0.5 * along, abs=1e-12)  # (b1 - b2) / (2 sin 30 degrees)
    assert np.abs(taken[~wrong]).max() == 0.0


def test_water_track_differs_from_bottom_track_by_the_current():
    motion, vehicle = make_motion("survey", np.random.default_rng(1)), make_vehicle("mti", ("dvl_water",))
    vehicle.dvl.sd = vehicle.dvl.water_sd = (0.0, 0.0, 0.0)
    vehicle.dvl.yaw_sd = 0.0
    streams, _ = sample(motion, vehicle, np.random.default_rng(2))
    apart = streams["dvl"][list(DVL)].to_numpy() - streams["dvl_water"][list(WATER)].to_numpy()
    t = streams["dvl"]["time"].to_numpy()
    current_n = np.einsum("nij,nj->ni", motion.C_nb(t), apart @ mounting(vehicle.dvl.mount_rpy_deg).T)
    assert np.ptp(current_n, axis=0).max() < 1e-12
    assert 0.01 < np.linalg.norm(current_n[0, :2]) < 0.3
    assert abs(current_n[0, 2]) < 1e-12


def test_a_stated_start_and_a_key_left_out_are_as_the_case_says():
    start = make_dive(CASES["start 20 m off"], 0).configuration["start"]
    assert (start["north_m"], start["east_m"], start["position_sd_m"]) == (16.0, -12.0, 1.0)
    found = make_dive(CASES["compass not calibrated"], 0).configuration
    assert not {"ahrs_offset", "ahrs_deviation"} & set(found["calibration"])
    assert "ahrs_sd_deg" not in found["heading"]


def test_what_befalls_a_dive_befalls_the_healthy_one_too():
    for name in ("fixes every second, of 100 s", "moving bed, fixes of 100 s"):
        assert 90.0 < make_dive(CASES[name], 0).streams["fix"]["time"].max() < 100.0


def sds_that_show(grade, velocity, dt=0.2):
    """What the best test, which knows how the bottom moves, has to find it by, in sds.

    One axis: error of velocity, tilt, gyro's bias, accelerometer's bias; the DVL measures the error of the velocity.
    """
    imu, dvl_sd = GRADES[grade], 0.005
    A = np.zeros((4, 4))
    A[0, 1], A[0, 3], A[1, 2] = 9.82, 1.0, 1.0
    F = np.eye(4) + A * dt + A @ A * dt**2 / 2.0
    Q = np.diag([imu.acc_noise, imu.gyr_noise, imu.gyr_walk, imu.acc_walk]) ** 2 * dt
    Q = F @ Q @ F.T / 3.0 + 2.0 * Q / 3.0
    P = np.diag([1.0, np.deg2rad(2.0), np.deg2rad(imu.gyr_bias_sd), imu.acc_bias_sd]) ** 2
    x, total = np.zeros(4), 0.0
    for measured in velocity:
        x, P = F @ x, F @ P @ F.T + Q
        innovation, variance = measured - x[0], P[0, 0] + dvl_sd**2
        total += innovation**2 / variance
        x, P = x + P[:, 0] * innovation / variance, P - np.outer(P[:, 0], P[0]) / variance
    return np.sqrt(total)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "grade", "least", "most"),
    [
        ("dvl on a cloud", "mti", 0.0, 2.0),  # without a trace
        ("dvl on a cloud, FOG", "fog", 15.0, np.inf),
        ("dvl on a hull", "mti", 10.0, np.inf),
        ("dvl on a hull, tactical", "tactical", 30.0, np.inf),
    ],
)
def test_a_bottom_that_moves_shows_where_a_case_says_that_it_does(name, grade, least, most):
    dive, t, taken = lost(name, *DVL)
    speed = np.linalg.norm(
        np.einsum("nij,nj->ni", dive.motion.C_nb(t), taken @ mounting((180.0, 0.0, -45.0)).T), axis=1
    )
    assert least < sds_that_show(grade, speed) < most


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


DOUBT = ("alarm: dvl: frozen for 60.0 s; look at it", "alarm: ahrs: its noise is 3 times what is stated")


def dive_of(value, verdict="trusted", said=(), quantity="position", kind="smoothed"):
    values = {kind: {"position": 1.0, "depth": 1.0} for kind in ("smoothed", "filtered")}
    values[kind] = {**values[kind], quantity: value}
    sizes = dict.fromkeys(values, 1.0)
    return Result(values, sizes, sizes, said, verdicts={"smooth": verdict})


@pytest.mark.parametrize(
    ("dive", "tally"),
    [
        (dive_of(LIE_NEES), Tally(dives=1)),
        (dive_of(LIE_NEES + 0.01), Tally(dives=1, off=1, lies=1)),
        (dive_of(9.0, quantity="heading", kind="filtered"), Tally(dives=1, off=1, lies=1)),
        (dive_of(9.0, quantity="depth"), Tally(dives=1, off=1, lies=1)),
        (dive_of(float("nan")), Tally(dives=1, off=1, lies=1)),
        (dive_of(9.0, quantity="dvl_yaw"), Tally(dives=1)),  # a verdict is about the track
        (dive_of(1.0, "doubtful", DOUBT), Tally(dives=1, doubted=1)),
        (dive_of(9.0, "wrong", DOUBT), Tally(dives=1, doubted=1, off=1, named_first=1)),
        (dive_of(9.0, "wrong", DOUBT[::-1]), Tally(dives=1, doubted=1, off=1)),
        (dive_of(9.0, "trusted", ("warning: dvl: frozen",)), Tally(dives=1, off=1, lies=1, named_first=1)),
        (dive_of(9.0, "trusted", ("advice: dvl: frozen",)), Tally(dives=1, off=1, lies=1)),
        (Result(said=("dvl: frozen throughout",), refused=True), Tally(refused=1, named_first=1)),
        (replace(dive_of(9.0), verdicts={}), Tally()),  # of an earlier campaign
    ],
)
def test_a_dive_that_is_trusted_and_off_is_a_lie(dive, tally):
    assert judge([dive], "frozen", [dive_of(1.0)]).tallies.get("smooth", Tally()) == tally


def test_what_a_dive_without_the_fault_has_too_is_no_lie_nor_what_leaves_no_trace():
    twin = dive_of(5.0, quantity="heading")
    assert judge([twin], "frozen", [twin]).tallies["smooth"] == Tally(dives=1, chance=1)
    assert judge([dive_of(5.0)], "frozen", [twin]).tallies["smooth"].lies == 1
    hidden = judge([dive_of(5.0, said=RESTS)], "frozen", [dive_of(1.0, said=RESTS)], UNSEEN)
    assert hidden.tallies["smooth"] == Tally(dives=1, hidden=1)
    assert judge([dive_of(5.0)], "frozen", [dive_of(1.0)], UNSEEN).tallies["smooth"].lies == 1


def test_the_campaign_says_how_good_the_verdict_is():
    """Of 6 dives with a fault 4 are off, 3 of them not trusted; another one, and a healthy one, are not either."""
    told, healthy = dive_of(9.0, "doubtful", DOUBT), [dive_of(1.0)] * 5 + [dive_of(1.0, "doubtful")]
    faulty = [told, told, dive_of(9.0, "wrong"), dive_of(9.0), dive_of(1.0, "doubtful"), dive_of(1.0)]
    cases = [CASES["survey"], CASES["dvl frozen"]]
    outcomes = {"survey": judge(healthy, ""), "dvl frozen": judge(faulty, "frozen", healthy)}
    (line,) = verdicts(cases, outcomes)
    assert "`rovgraph smooth`: 1 of 6 dives with a fault are lies. 4 are off, 75% of them not trusted (recall)." in line
    assert "5 dives are not trusted, 60% of them off (precision)." in line
    assert "names the cause in 50% of those" in line
    assert "Of 6 healthy dives 1 are not trusted, 0 are off." in line
    row = table(cases, outcomes).splitlines()[3].split(" | ")
    assert row[-5:-2] == ["50%", "67% (17%)", "**1**"]


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


def test_the_exit_code_is_1_for_one_dive_that_is_a_lie(monkeypatch):
    outcome = judge([dive_of(1.0)] * 19 + [dive_of(5.0)], "frozen", [dive_of(1.0)] * 20)
    assert outcome.verdict == "right"
    monkeypatch.setattr(faults, "run", lambda *_: {"dvl frozen": outcome})
    monkeypatch.setattr(sys, "argv", ["faults.py", "--cases", "dvl frozen"])
    assert faults.main() == 1


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
    assert [found["survey", 3, False]] == dives(1.0, 1, said=NAMED)  # written before verdicts were
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


@pytest.mark.slow
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
        pytest.param("dvl y and z flipped", "dvl.mount_rpy_deg: [0.0, 0.0, -45.0]", marks=pytest.mark.slow),
        pytest.param("dvl 3.2 s late", "mean: 3.188", marks=pytest.mark.slow),
    ],
)
def test_an_alarm_on_a_dvls_axes_or_clock_gives_the_remedy_of_the_check(case, remedy):
    told = [text for text in run_case(CASES[case], 0).said if text.startswith("alarm: dvl: its ") and "IMU" in text]
    assert len(told) == 1 and remedy in told[0] and "until that is mended the track is wrong" in told[0]


@pytest.mark.slow
def test_online_a_dvl_whose_clock_is_late_is_not_said_to_be_elsewhere():
    result = run_case(CASES["dvl 3.2 s late"], 0, online=True)
    told = [text for text in result.said if text.startswith("online: ") and "dvl: " in text]
    assert any("its stamps are 3.1" in text for text in told)
    assert not any("elsewhere" in text for text in told)


@pytest.mark.slow
def test_online_ignores_a_depth_that_is_stuck_while_the_vehicle_dives():
    result = run_case(CASES["depth stuck"], 0, online=True)
    assert max(result.nees["online"].values()) < 2.0  # of the depth 765 where it was used
    assert any(line.startswith("online: ") and "depth: frozen" in line for line in result.said)
    assert any(line.startswith("online: alarm: depth: ") for line in result.said)
    assert result.verdicts == {"smooth": "doubtful", "online": "doubtful"}


@pytest.mark.slow
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
