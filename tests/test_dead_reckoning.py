"""Dead reckoning: every ping at its own time, levelled and turned as the noise allows, without what it cannot know."""

import numpy as np
import pytest
from dives import (
    LIVELY,
    Simulated,
    altered,
    as_log,
    attitude_errors,
    batch,
    changed,
    falcon,
    interrupted,
    kept,
    level_log,
    position_errors,
    simulated,
    started,
    true_at,
)

from rovgraph.geometry import exp_rotation, wrap_angle
from rovgraph.inference.dead_reckoning import dead_reckon
from rovgraph.inference.initialise import solve_turn, turn_noise
from rovgraph.inference.trajectory import Trajectory
from rovgraph.kernels.measurement_row import DT
from rovgraph.lab.misalignment.plan import GRADES
from rovgraph.log import Log
from rovgraph.model.config import Config, beliefs
from rovgraph.model.state import State
from rovgraph.sensors.instruments import instruments
from rovgraph.simulate import Style

KNOWN = {
    name: np.zeros(dim) for name, dim in (("dvl_compass_offset", 1), ("dvl_compass_deviation", 2), ("hard_iron", 3))
}
KNOWN["dvl_yaw"] = np.deg2rad([45.0])
CALM = Style()


def reckoned(log: Log, config: Config) -> Trajectory:
    return batch(log, config).dead_reckoning().trajectory


def horizontal_end(track: Trajectory, case: Simulated) -> float:
    return float(np.linalg.norm((track.p_n - true_at(case, track.time).p_n)[-1, :2]))


@pytest.fixture(scope="module")
def exact() -> Simulated:
    """Without noise or biases, in calm water, with starts and stops."""
    return simulated(falcon(), 200.0, path="accelerate-and-stop", style=CALM, noise=False)


@pytest.mark.parametrize("grade", ["fog", pytest.param("mti", marks=pytest.mark.slow)])
@pytest.mark.parametrize("rest", [True, False])
@pytest.mark.parametrize("jitter", [pytest.param(1e-3, marks=pytest.mark.slow), 0.1])
def test_a_dvl_that_pings_once_a_second_is_as_good_as_if_keyframes_might_be_further_apart(grade, rest, jitter):
    config = falcon(imu=GRADES[grade], heading={"sources": ["dvl"]})
    case = simulated(config, 400.0, 2, "lawnmower", dvl_rate=0.999, dvl_jitter=jitter, calibration=KNOWN)
    if not rest:
        dive = case.dive.between(60.0, 400.0)
        case = Simulated(case.config, dive, as_log(dive.log_frame))
    tracks = [reckoned(case.log, started(case, graph={"max_gap_s": gap})) for gap in (1.0, 1.5)]
    ends = [horizontal_end(track, case) for track in tracks]
    assert abs(ends[0] - ends[1]) < 0.05
    assert ends[0] < 0.5


def test_without_noise_it_is_exact_through_starts_stops_and_turns(exact):
    track = reckoned(exact.log, started(exact))
    assert position_errors(track, exact).max() < 0.005
    assert np.rad2deg(np.abs(attitude_errors(track, exact))).max() < 0.001


def test_pings_between_keyframes_count_as_those_at_keyframes(exact):
    far = started(exact, graph={"min_gap_s": 0.9})
    smoother = batch(exact.log, far)
    pings = smoother.problem.of_sensor("dvl")
    assert np.mean(smoother.problem.rows[pings, DT] > 0.0) > 0.7
    assert position_errors(smoother.dead_reckoning().trajectory, exact).max() < 0.01


def test_every_ping_counts(exact):
    config = started(exact, graph={"min_gap_s": 0.9})
    whole = reckoned(exact.log, config)
    pings = exact.log["dvl"].time
    # in the first start, between two keyframes of both logs
    k = int(pings.searchsorted(exact.truth.time[np.argmax(np.linalg.norm(exact.truth.v_n, axis=1) > 0.1)]))
    for gone in range(k, k + 4):
        without_one = reckoned(kept(exact.log, "dvl", np.arange(len(pings)) != gone), config)
        assert np.linalg.norm(whole.p_n[-1] - without_one.p_n[-1]) > 1e-5


def test_velocity_between_pings_turns_with_the_vehicle(exact):
    """Without bottom lock through half a circle the speed ahead is held, not the velocity north and east."""
    case = simulated(falcon(), 120.0, path="circle", style=CALM, noise=False)
    track = reckoned(interrupted(case.log, 60.0, 20.0, "dvl"), started(case))
    assert position_errors(track, case).max() < 0.5


@pytest.mark.parametrize("end", [120.0, 1e9])
def test_where_the_bottom_is_lost_velocity_through_the_water_is_used_with_the_current_before(end):
    case = simulated(
        falcon(),
        160.0,
        noise=False,
        path="lawnmower",
        water_track=True,
        dropouts=((60.0, end),),
        calibration=KNOWN | {"current": np.array([0.1, -0.2])},
    )
    config = started(case)
    ends = [
        horizontal_end(reckoned(log, config), case) for log in (case.log, interrupted(case.log, 0, 1e9, "dvl_water"))
    ]
    assert ends[0] < 0.01
    assert ends[1] > 0.2


def test_water_pings_alone_are_believed_with_the_current_that_is_believed():
    case = simulated(
        falcon(), 80.0, water_track=True, noise=False, fix_interval=20.0, calibration={"current": np.array([0.1, 0.0])}
    )
    log = interrupted(case.log, 0.0, 1e9, "dvl")
    believed = started(case, calibration={"current": {"mean": [0.1, 0.0]}})
    assert position_errors(reckoned(log, believed), case).max() < 0.05
    ignorant = reckoned(log, started(case))
    assert horizontal_end(ignorant, case) == pytest.approx(8.0, abs=0.1)


def turning_gyro(seconds: float, bias, **sensors) -> Log:
    """A level vehicle under way, whose gyro has a bias, so that it does not pass for standing still."""
    pings = np.arange(0.1, seconds, 0.2)
    dvl = pings, np.tile([0.3, 0.0, 0.0, 1.0, np.nan], (len(pings), 1))
    return level_log(seconds, np.array([0.0, 0.0, -9.81]), np.asarray(bias), dvl=dvl, **sensors)


BIAS = np.array([0.002, -0.001, 0.003])


def test_without_a_heading_the_bias_of_the_heading_gyro_stays_as_it_was():
    config = Config.model_validate({"start": {"heading_deg": 0.0}})
    smoother = batch(turning_gyro(120.0, BIAS), config)
    states = dead_reckon(smoother.problem, smoother.initial, means(config))
    np.testing.assert_allclose(states.bias[-1, 3:5], BIAS[:2], atol=2e-4)  # the others are found
    assert np.abs(states.bias[:, 5]).max() < 0.01 * BIAS[2]


def test_with_a_heading_the_bias_of_the_heading_gyro_is_found():
    time = np.arange(0.05, 120.0, 0.1)
    log = turning_gyro(120.0, BIAS, ahrs=(time, np.tile([0.5, np.nan, np.nan], (len(time), 1))))
    smoother = batch(log, Config())
    states = dead_reckon(smoother.problem, smoother.initial, means(smoother.initial.config))
    np.testing.assert_allclose(states.bias[-1, 3:], BIAS, atol=3e-4)


def means(config: Config) -> dict[str, np.ndarray]:
    return {name: belief.mean for name, belief in beliefs(config).items()}


@pytest.mark.parametrize("modelled", [True, False])
def test_the_earths_rotation_is_taken_out_where_it_is_modelled(modelled):
    """In ten minutes the Earth turns by 2.5 degrees, most of it about down."""
    sections = {"imu": GRADES["fog"], "heading": {"sources": []}}
    case = simulated(falcon(**sections, environment={"earth_rotation": True}), 600.0, noise=False, style=CALM)
    track = reckoned(case.log, started(case, environment={"earth_rotation": modelled}))
    error = np.rad2deg(np.abs(attitude_errors(track, case)))
    if modelled:
        assert error.max() < 0.01
    else:
        assert error[-1, 2] > 1.5


def test_a_gyro_at_rest_shows_its_bias_beside_the_earths_rate():
    """Else a bias that is known to some degrees an hour is off by the Earth's fifteen."""
    sections = {"imu": GRADES["tactical"], "heading": {"sources": []}, "environment": {"earth_rotation": True}}
    style = Style(rest=30.0, waves=CALM.waves)
    case = simulated(falcon(**sections), 300.0, noise=False, style=style)
    smoother = batch(case.log, started(case))
    assert any("gyro bias" in line for line in smoother.initial.assumptions)
    assert np.abs(smoother.initial.prior.state.bias[0, 3:]).max() < 1e-6
    track = smoother.dead_reckoning().trajectory
    assert np.rad2deg(np.abs(attitude_errors(track, case))).max() < 0.01


def test_a_better_gyro_follows_a_compass_less():
    case = simulated(
        falcon(imu=GRADES["fog"], heading={"sources": ["dvl"], "dvl_sd_deg": 3.0}), 200.0, calibration=KNOWN
    )
    after = slice(case.log["dvl"].time.searchsorted(60.0), None)
    scatter = []
    for grade in ("fog", "mti"):
        track = reckoned(case.log, started(case, imu=GRADES[grade], start={"heading_sd_deg": 0.5}))
        scatter.append(np.std(np.diff(attitude_errors(track, case)[after, 2])))
    assert scatter[0] < 0.3 * scatter[1]


@pytest.mark.parametrize("grade", ["fog", "mti"])
def test_begun_in_motion_it_is_level_after_some_seconds(grade):
    case = simulated(falcon(imu=GRADES[grade]), 120.0, 4, style=LIVELY, calibration=KNOWN)
    dive = case.dive.between(61.3, 120.0)
    moving = Simulated(case.config, dive, as_log(dive.log_frame))
    track = reckoned(moving.log, changed(case.config))
    late = track.time > 71.0
    assert np.rad2deg(np.abs(attitude_errors(track, moving)[late, :2])).max() < 0.6


def test_after_a_silence_of_the_imu_it_levels_itself_at_once():
    case = simulated(falcon(), 150.0, 3, calibration=KNOWN)
    track = reckoned(interrupted(case.log, 70.0, 9.0, "imu"), started(case))
    tilt = np.rad2deg(np.abs(attitude_errors(track, case)[:, :2]).max(axis=1))
    assert tilt.max() < 15.0  # as far as it rolled and pitched meanwhile
    assert tilt[track.time > 82.0].max() < 1.5
    assert tilt[track.time > 100.0].max() < 0.6


@pytest.mark.parametrize("grade", ["fog", "mti"])
def test_headings_that_are_wrong_now_and_then_turn_it_little(grade):
    """One in fifty says anything; the compass is believed to a quarter of a degree."""
    rng = np.random.default_rng(1)
    case = simulated(falcon(imu=GRADES[grade], heading={"sources": ["dvl"]}), 200.0, calibration=KNOWN)
    headings = case.log["dvl_heading"].data.copy()
    wrong = rng.uniform(size=len(headings)) < 0.02
    headings[wrong, 0] = rng.uniform(-np.pi, np.pi, wrong.sum())
    track = reckoned(altered(case.log, "dvl_heading", headings), started(case))
    assert np.rad2deg(np.abs(attitude_errors(track, case)[:, 2]).max()) < 4.0


@pytest.mark.parametrize("grade", ["fog", "mti"])
@pytest.mark.parametrize("stated", [{"heading_deg": 40.0}, {"roll_deg": 40.0}, {"roll_deg": 120.0}])
def test_it_recovers_from_a_start_that_is_stated_wrong(grade, stated):
    case = simulated(falcon(imu=GRADES[grade], heading={"sources": ["dvl"]}), 120.0, 2, calibration=KNOWN)
    config = started(case)
    for angle, off in stated.items():
        own = getattr(config.start, angle)
        config = changed(config, start={angle: own + off})
    track = reckoned(case.log, config)
    error = np.rad2deg(np.abs(attitude_errors(track, case)))
    assert error[0].max() > 30.0
    assert error[track.time > 40.0, :2].max() < 1.0
    assert error[track.time > 40.0, 2].max() < 5.0


@pytest.mark.parametrize("sensor", ["mag", "ahrs", "dvl_heading"])
def test_a_turn_is_found_from_any_side(sensor):
    rng = np.random.default_rng(5)
    config = falcon(
        calibration={"mag_deviation": {"mean_deg": [4.0, -3.0]}, "ahrs_deviation": {"mean_deg": [6.0, 5.0]}}
    )
    n, model = 40, instruments(config)[sensor]
    true = exp_rotation(np.column_stack([rng.normal(0.0, 0.2, (n, 2)), rng.uniform(-np.pi, np.pi, n)]))
    still = np.zeros((n, 3))
    z, _ = model.model.predict(State(true, still, still, np.zeros((n, 6)), means(config)), still)
    turn = rng.uniform(-np.pi, np.pi, n)
    back = exp_rotation(np.column_stack([np.zeros((n, 2)), -turn])) @ true
    found = solve_turn(model, z, back, means(config))
    np.testing.assert_allclose(wrap_angle(found - turn), 0.0, atol=1e-6)


def test_the_noise_of_a_turn_is_that_of_the_compass_and_what_it_deviates_by():
    config = falcon(
        heading={"dvl_sd_deg": 2.0, "mag_sd_deg": 1.0},
        calibration={"dvl_compass_offset": {"estimate": True, "sd_deg": 9.0}, "hard_iron": {"estimate": False}},
    )
    R_nb = exp_rotation(np.column_stack([np.zeros((36, 2)), np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False)]))
    every, priors = instruments(config), beliefs(config)
    compass = turn_noise(every["dvl_heading"], R_nb, np.zeros(36), means(config), priors)
    np.testing.assert_allclose(np.rad2deg(np.sqrt(compass.variance)), 2.0, rtol=1e-6)
    np.testing.assert_allclose(compass.by_tilt, 0.0, atol=1e-9)
    assert np.rad2deg(np.sqrt(compass.deviation_var)) == pytest.approx(3.0, rel=1e-6)  # of the curve, not the offset
    one_heading = turn_noise(every["dvl_heading"], R_nb[:1].repeat(9, axis=0), np.zeros(9), means(config), priors)
    assert one_heading.deviation_var == pytest.approx(0.0, abs=1e-12)
    field = turn_noise(every["mag"], R_nb, np.zeros(36), means(config), priors)
    np.testing.assert_allclose(np.rad2deg(np.sqrt(field.variance)), 1.0, rtol=1e-6)
    np.testing.assert_allclose(field.by_tilt, np.tan(np.deg2rad(72.0)) ** 2, rtol=1e-6)
    assert field.deviation_var == pytest.approx(0.0, abs=1e-12)
