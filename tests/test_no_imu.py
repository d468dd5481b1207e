"""A dive without an IMU: the vehicle's own attitude, a DVL, and a constant velocity in between."""

import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from dives import (
    Simulated,
    altered,
    as_log,
    attitude_errors,
    batch,
    changed,
    falcon,
    interrupted,
    kept,
    renewed,
    rms,
    same,
    true_at,
    without,
)
from scipy.stats import chi2

from rovgraph.api.online import Online
from rovgraph.cli.app import main
from rovgraph.dive import smooth
from rovgraph.errors import InputError
from rovgraph.geometry import Array, wrap_angle
from rovgraph.inference import gauss_newton
from rovgraph.inference.attitude_gaps import without_attitude_gaps
from rovgraph.inference.chain_optimum import smooth_chain
from rovgraph.inference.initialise import initialise
from rovgraph.inference.trajectory import Trajectory
from rovgraph.live.intake import Startup
from rovgraph.log import STREAMS, Log, Stream
from rovgraph.log.frozen import frozen_stretches
from rovgraph.model.config import Config
from rovgraph.problem.assembly import assembly_of
from rovgraph.readers.formats import read_recording
from rovgraph.simulate import Truth, scenario, simulate
from rovgraph.simulate.files import known

REMUS = Path(__file__).parents[2] / "shared" / "data" / "remus600_pd0" / "adcp.adc.gz"
CONFIG = Path(__file__).parents[1] / "configs" / "remus600.yaml"
SEEDS = range(1, 25)
SECONDS, PING_RATE = 120.0, 1.0
QUANTITIES = ("position", "velocity", "attitude")
KINDS = ("smoothed", "filtered")
ACC = 0.05  # a Falcon's own, which is calmer than the default
HEADING_SD, TILT_SD = np.deg2rad(1.0), np.deg2rad(0.5)


def drawn(seed: int) -> tuple[Simulated, Config]:
    """A dive whose IMU is silent, and what an estimator is told of it."""
    heading, dvl = {"sources": ["vehicle"], "vehicle_sd_deg": 1.0}, {"velocity_sd_mps": [0.02, 0.02, 0.02]}
    config = changed(falcon(), heading=heading, dvl=dvl, tilt={"sd_deg": 0.5}, motion={"acc": ACC, "rate_sd_dps": 3.0})
    truth = Truth(config, start_error=True, dvl_rate=PING_RATE, depth_rate=0.5)
    dive = simulate(scenario("falcon", SECONDS), truth, np.random.default_rng(seed))
    case = Simulated(config, dive, as_log(dive.log_frame))
    log = without(case.log, "imu", "mag", "ahrs", "dvl_heading")
    case = replace(case, log=with_attitude(log, case, np.random.default_rng(100 + seed)))
    return case, known(dive, config)


def with_attitude(log: Log, case: Simulated, rng: np.random.Generator) -> Log:
    """The log with roll, pitch and the magnetic heading of the body at each ping."""
    time, hidden = log["dvl"].time, case.dive.hidden["calibration"]
    rpy = true_at(case, time).rpy
    magnetic = rpy[:, 2] - np.deg2rad(case.config.environment.declination_deg)
    sine, cosine = hidden["vehicle_compass_deviation"]
    magnetic += hidden["vehicle_compass_offset"][0] + sine * np.sin(magnetic) + cosine * np.cos(magnetic)
    heading = wrap_angle(magnetic + HEADING_SD * rng.standard_normal(len(time)))
    tilt = rpy[:, :2] + TILT_SD * rng.standard_normal((len(time), 2))
    streams, row = dict(log.streams), log["dvl"].row
    for sensor, data in (("vehicle_heading", heading[:, None]), ("vehicle_tilt", tilt)):
        streams[sensor] = Stream(sensor, STREAMS[sensor], time, data, row)
    return replace(log, streams=streams)


def nees(trajectory: Trajectory, case: Simulated, epoch: int) -> Array:
    """Normalised error squared of position, velocity and attitude at one epoch, shape (3,)."""
    truth = true_at(case, trajectory.time)
    error = (trajectory.p_n - truth.p_n, trajectory.v_n - truth.v_n, attitude_errors(trajectory, case))
    covariance = (trajectory.cov_p, trajectory.cov_v, trajectory.cov_theta)
    return np.array([e[epoch] @ np.linalg.solve(P[epoch], e[epoch]) for e, P in zip(error, covariance, strict=True)])


def one_dive(seed: int) -> Array:
    """NEES smoothed at mid-dive and filtered at the end, and smoothed with too little process noise; (3, 3)."""
    case, config = drawn(seed)
    smoothed, filtered = batch(case.log, config).solve().trajectory, renewed(case.log, config).solve().trajectory
    stiff = batch(case.log, changed(config, motion={"acc": 1e-3, "gyr": 1e-2})).solve().trajectory
    middle = len(smoothed) // 2
    return np.array([nees(t, case, k) for t, k in ((smoothed, middle), (filtered, -1), (stiff, middle))])


def all_dives(seeds: range) -> Array:
    """NEES of many dives, shape (dives, 3 kinds, 3 quantities)."""
    with ProcessPoolExecutor(2) as pool:
        return np.array(list(pool.map(one_dive, seeds)))


@pytest.fixture(scope="module")
def mean_nees() -> Array:
    return np.asarray(all_dives(SEEDS).mean(axis=0))


def band(dives: int) -> tuple[float, float]:
    """Within which the mean NEES of 3 components lies with 95 %."""
    low, high = chi2.ppf([0.025, 0.975], 3 * dives) / dives
    return float(low), float(high)


@pytest.mark.slow
@pytest.mark.parametrize("quantity", range(3), ids=QUANTITIES)
@pytest.mark.parametrize("kind", range(2), ids=KINDS)
def test_errors_are_at_most_as_large_as_the_estimate_says(mean_nees, kind, quantity):
    low, high = band(len(SEEDS))
    assert mean_nees[kind, quantity] < high
    if quantity != 1:  # the process allows for accelerations that no Falcon has at all times
        assert mean_nees[kind, quantity] > low


@pytest.mark.slow
def test_too_little_process_noise_is_found_out(mean_nees):
    assert (mean_nees[2] > band(len(SEEDS))[1]).all()


@pytest.fixture(scope="module")
def dive() -> tuple[Simulated, Config]:
    return drawn(1)


def test_of_one_dive_too_little_process_noise_is_found_out(dive):
    smoothed, filtered, stiff = one_dive(1)[:, 0]
    assert max(smoothed, filtered) < chi2.ppf(0.999, 3) < stiff


def test_a_log_without_imu_is_smoothed_and_no_bias_is_reported(dive):
    case, config = dive
    done = smooth(case.log, config)
    assert any("the log has no IMU" in line for line in done.assumptions)
    for estimate in done.estimates:
        assert not {"acc_bias", "gyr_bias"} & set(estimate.history)
        assert not [c.label for c in estimate.calibration if c.label.startswith(("acc_", "gyr_"))]
    smoothed, track = done.estimates[0], true_at(case, done.estimates[0].trajectory.time)
    error = np.linalg.norm((smoothed.trajectory.p_n - track.p_n)[:, :2], axis=1)
    assert error.max() < 5.0 * np.sqrt(smoothed.trajectory.cov_p[:, 0, 0].max())
    deviation = [c for c in smoothed.calibration if c.label.startswith("vehicle_compass_deviation")]
    assert len(deviation) == 2 and not any(c.estimated for c in deviation)


def test_measurements_one_by_one_and_a_whole_log_give_the_same_keyframes(dive):
    case, config = dive
    initial = initialise(case.log, config)
    whole, one_by_one = assembly_of(initial), assembly_of(initial)
    whole.take(case.log)
    for measurement in case.log.measurements():
        one_by_one.insert(measurement)
        one_by_one.extend()
    for assembly in (whole, one_by_one):
        assembly.extend(finish=True)
    assert len(whole) > SECONDS
    same(whole.problem, one_by_one.problem)


@pytest.mark.parametrize("sensor", ["dvl", "vehicle_heading", "vehicle_tilt"])
def test_a_value_held_while_the_vehicle_moves_is_frozen(dive, sensor):
    case, config = dive
    assert frozen_stretches(case.log, config) == []
    stream, data = case.log[sensor], case.log[sensor].data.copy()
    held = (stream.time >= 40.0) & (stream.time < 80.0)
    data[held] = data[held][0]
    (found,) = frozen_stretches(altered(case.log, sensor, data), config)
    assert (found.sensor, found.first, found.last) == (sensor, *stream.time[held][[0, -1]])


def test_a_heading_that_is_held_leaves_a_track_as_certain_as_it_is(dive):
    case, config = dive
    stream, data = case.log["vehicle_heading"], case.log["vehicle_heading"].data.copy()
    held = (stream.time >= 40.0) & (stream.time < 80.0)
    data[held] = data[held][0]
    done = smooth(altered(case.log, "vehicle_heading", data), config)
    assert done.verdict != "trusted"
    assert nees(done.estimates[0].trajectory, case, -1)[0] < chi2.ppf(0.99, 3)


def silent(case: Simulated, *sensors: str) -> Log:
    """The dive without some sensors for 30 s."""
    return interrupted(case.log, 40.0, 30.0, *sensors)


@pytest.mark.parametrize(
    ("sensor", "part"), [("vehicle_heading", "heading"), ("vehicle_tilt", "tilt")], ids=["heading", "tilt"]
)
def test_a_silent_attitude_makes_a_track_that_is_wide_and_an_alarm(dive, sensor, part):
    case, config = dive
    done = smooth(silent(case, sensor), config)
    (alarm,) = [alarm for alarm in done.alarms if alarm.kind == f"no {part}"]
    assert f"no {part} for 31 s, 39 to 70 s" in alarm.text and "30 DVL pings" in alarm.text
    assert done.left_out["dvl", f"no {part} for more than 10 s"] == 30
    for estimate in done.estimates[:2]:
        for time in (55.0, 69.0, 120.0):
            k = int(estimate.trajectory.time.searchsorted(time)) - 1
            assert nees(estimate.trajectory, case, k)[0] < chi2.ppf(0.999, 3)


def test_of_one_heading_alone_comes_a_track_that_is_wide_and_an_alarm(dive):
    case, config = dive
    first = np.arange(len(case.log["vehicle_heading"])) == 0
    done = smooth(kept(case.log, "vehicle_heading", first), config)
    assert next(alarm.kind for alarm in done.alarms) == "no heading" and done.verdict == "doubtful"
    assert nees(done.estimates[0].trajectory, case, -1)[0] < chi2.ppf(0.99, 3)
    assert nees(batch(kept(case.log, "vehicle_heading", first), config).solve().trajectory, case, -1)[0] > 100.0


def test_measurements_in_a_gap_of_the_attitude_leave_silences(dive):
    case, config = dive
    first = np.arange(len(case.log["vehicle_heading"])) == 0
    log, gaps = without_attitude_gaps(kept(case.log, "vehicle_heading", first), config)
    assert [gap.part for gap in gaps] == ["heading"] and len(log["depth"]) > 8
    steps = np.diff(np.unique(np.concatenate([log[s].time for s in ("dvl", "depth", "vehicle_tilt")])))
    assert steps[steps > 2.0].min() > 10.0
    assert without_attitude_gaps(case.log, config) == (case.log, [])


def one_silence(seed: int) -> Array:
    """NEES of position in a silence of the heading, smoothed and filtered, and filtered with the pings in it, (3,)."""
    case, config = drawn(seed)
    log = silent(case, "vehicle_heading")
    fair = without_attitude_gaps(log, config)[0]
    tracks = batch(fair, config).solve(), renewed(fair, config).solve(), renewed(log, config).solve()
    ends = [int(t.trajectory.time.searchsorted(69.0)) for t in tracks]
    return np.array([nees(t.trajectory, case, k)[0] for t, k in zip(tracks, ends, strict=True)])


@pytest.mark.slow
def test_without_heading_position_is_as_wrong_as_it_says_at_most():
    with ProcessPoolExecutor(2) as pool:
        smoothed, filtered, overconfident = np.mean(list(pool.map(one_silence, range(1, 21))), axis=0)
    limit = band(20)[1]
    assert smoothed < limit and filtered < limit
    assert overconfident > 5.0 * limit


def test_without_depth_the_vertical_is_as_uncertain_as_the_start(dive):
    case, config = dive
    track = smooth(without(case.log, "depth"), config, "smoothed").estimates[0].trajectory
    assert (track.p_n - true_at(case, track.time).p_n)[-1, 2] ** 2 < chi2.ppf(0.99, 1) * track.cov_p[-1, 2, 2]
    assert np.sqrt(track.cov_p[-1, 2, 2]) > 50.0


@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["mirrored", "reversed"])
def test_a_wrong_heading_is_loud_where_a_few_fixes_show_the_way(dive, wrong):
    case, config = dive
    stream = case.log["vehicle_heading"]
    log = altered(case.log, "vehicle_heading", wrap_angle(-stream.data if wrong == "mirrored" else stream.data + np.pi))
    time, row = log["dvl"].time[::10], log["dvl"].row[::10]
    fixes = np.zeros((len(time), len(STREAMS["fix"])))
    fixes[:, :2] = true_at(case, time).p_n[:, :2] + np.random.default_rng(7).standard_normal((len(time), 2))
    fixes[:, STREAMS["fix"].index("fix_sd")] = 1.0
    fixed = replace(log, streams={**log.streams, "fix": Stream("fix", STREAMS["fix"], time, fixes, row)})
    dive = smooth(fixed, config, "smoothed")
    assert dive.verdict == "doubtful" and "if the fixes are right" in dive.warnings[0]
    track = dive.estimates[0].trajectory
    assert rms(np.linalg.norm((track.p_n - true_at(case, track.time).p_n)[:, :2], axis=1)) < 2.0  # by its fixes
    assert smooth(log, config, "smoothed").verdict == "trusted"  # nothing else can show it


def test_an_imu_that_is_left_out_changes_nothing(dive):
    case, config = dive
    with_imu = as_log(case.dive.log_frame)["imu"]
    both = replace(case.log, streams={**case.log.streams, "imu": with_imu})
    alone, left_out = (
        batch(log, changed(config, motion={"model": "constant_velocity"})).solve().trajectory
        for log in (case.log, both)
    )
    np.testing.assert_array_equal(alone.p_n, left_out.p_n)


def test_position_is_wide_after_a_silence_and_the_way_it_faces_is_found_again(dive):
    case, config = dive
    log = interrupted(case.log, 40.0, 60.0)
    for track in (batch(log, config).solve().trajectory, renewed(log, config).solve().trajectory):
        truth = true_at(case, track.time)
        after = track.time > 105.0
        sd = np.sqrt(track.cov_p[:, 0, 0])
        assert sd[after].min() > 20.0 and sd[track.time < 39.0].max() < 2.0
        assert (np.linalg.norm(track.p_n - truth.p_n, axis=1)[after] < 3.0 * sd[after]).all()
        assert np.abs(wrap_angle(track.rpy[after, 2] - truth.rpy[after, 2])).max() < np.deg2rad(20.0)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"graph": {"hydrodynamics": True}}, "graph.hydrodynamics needs an IMU"),
        ({"calibration": {"gyr_scale": {"estimate": True}}}, "gyr_scale: {estimate: true} needs an IMU"),
        (
            {"calibration": {"depth_time_offset": {"estimate": True}}},
            "depth_time_offset: {estimate: true} needs an IMU",
        ),
    ],
)
def test_what_needs_an_imu_is_refused(dive, keys, message):
    case, config = dive
    with pytest.raises(InputError, match=message):
        initialise(case.log, changed(config, **keys))


def test_without_imu_roll_and_pitch_are_needed_and_online_refuses(dive):
    case, config = dive
    with pytest.raises(InputError, match=r"no IMU, .* or else roll and pitch"):
        initialise(without(case.log, "vehicle_tilt"), config)
    with pytest.raises(InputError, match="online needs an IMU"):
        Startup(changed(config, motion={"model": "constant_velocity"}))
    startup = Startup(config)
    assert startup.begin(None) is None
    assert startup.waits_for == "online needs an IMU, columns acc_x..acc_z and gyr_x..gyr_z"


def test_online_without_an_imu_says_so_before_it_writes_anything(dive, tmp_path):
    case, config = dive
    case.dive.log_frame.to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(InputError, match="online needs an IMU"):
        Online(changed(config, motion={"model": "constant_velocity"})).run(
            f"file:{tmp_path / 'log.csv'}", out=tmp_path / "out"
        )
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_pd0_file_of_a_real_vehicle_becomes_a_smoothed_track(tmp_path, monkeypatch):
    if not REMUS.exists():
        pytest.skip(f"{REMUS} is not there")
    arguments = ["smooth", REMUS, "--config", CONFIG, "--out", tmp_path / "remus", "--estimate", "smoothed"]
    monkeypatch.setattr(sys, "argv", ["rovgraph", *map(str, arguments), "--no-figures"])
    with pytest.raises(SystemExit) as end:
        main()
    assert not end.value.code
    track = pd.read_csv(tmp_path / "remus" / "trajectory_smoothed.csv")
    recording = read_recording(REMUS)
    columns = {c.sensor: c.columns for c in recording.channels}
    for sensor, column, state in (
        ("vehicle_heading", "heading", "yaw"),
        ("vehicle_tilt", "pitch", "pitch"),
        ("vehicle_tilt", "roll", "roll"),
    ):
        found = np.interp(columns[sensor]["time"], track["time"], np.unwrap(track[state]))
        apart = np.rad2deg(wrap_angle(found - columns[sensor][column]))
        assert np.abs(np.median(apart)) < 1.0 and np.median(np.abs(apart)) < 2.0, sensor
    depth = np.interp(columns["depth"]["time"], track["time"], track["down"])
    assert np.median(np.abs(depth - columns["depth"]["depth"])) < 0.2
    assert len(track) > 4000 and np.isfinite(track[["north", "east", "north_sd", "east_sd"]]).all(axis=None)


def test_gtsam_finds_the_same_optimum(dive, monkeypatch):
    pytest.importorskip("gtsam")
    for tolerance in ("FINE", "FINAL_TOLERANCE"):
        monkeypatch.setattr(gauss_newton, tolerance, 1e-11)
    from rovgraph.inference.graph.places import smooth_graph

    case, config = dive
    smoother = batch(case.log, config)
    problem = smoother.problem, smoother.initial, smoother.optimum().state
    chain, graph = smooth_chain(*problem), smooth_graph(*problem)
    np.testing.assert_allclose(graph.state.p_n, chain.state.p_n, atol=1e-5)


if __name__ == "__main__":  # python tests/test_no_imu.py FIRST LAST: the same by hand, on other dives
    first, last = (int(a) for a in sys.argv[1:3])
    found = all_dives(range(first, last))
    print("band", np.round(band(len(found)), 2), *QUANTITIES)
    for name, row in zip((*KINDS, "stiff"), found.mean(axis=0), strict=True):
        print(f"{name:14}", np.round(row, 2))
