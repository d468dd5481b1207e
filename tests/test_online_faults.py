"""Faults, late data and foreign clocks on simulated dives: said, honest while they last, and recovered from.

Bounds on errors are in sd of the solution: 4, which one dive in thousands exceeds by chance.
"""

from collections import Counter
from itertools import pairwise

import numpy as np
import pymap3d
import pytest
from dives import Simulated, as_log, changed, falcon, simulated, true_at, without
from live import Flight, flown, message, navigator, turned

from rovgraph.errors import DataWarning, InputError
from rovgraph.inference.fixed_lag import FixedLag
from rovgraph.inference.graph.isam2 import IncrementalEstimator
from rovgraph.live.clocks import Clocks
from rovgraph.live.files import Files
from rovgraph.live.intake import Intake
from rovgraph.live.message import GEODETIC, Reading
from rovgraph.live.navigator import Navigator
from rovgraph.live.session import Session
from rovgraph.live.warnings import Warnings
from rovgraph.log import Log, Measurement, Stream
from rovgraph.model.config import Config
from rovgraph.simulate import simulated as by_name

AT = 20.0  # when something fails
SETTLED_S = 8.0  # from when on solutions are looked at
HONEST_SD, JUMP_SD = 4.0, 3.0
COMPASSES = ("mag", "ahrs", "dvl_heading")


@pytest.fixture(scope="module")
def case() -> Simulated:
    return simulated(falcon(), 48.0, seed=1, dvl_rate=4.0)


def during(m: Measurement, seconds: float, *sensors: str) -> bool:
    return AT <= m.time < AT + seconds and (not sensors or m.sensor in sensors)


def honest(flight: Flight) -> None:
    """Errors within the sd, and no step of the solution that the sd before it did not allow."""
    settled = flight.time > SETTLED_S
    assert (np.abs(flight.errors) / flight.sd)[settled].max() < HONEST_SD
    steps = np.abs(np.diff(flight.errors, axis=0)) / flight.sd[:-1]
    assert steps[settled[1:]].max() < JUMP_SD


def grown(flight: Flight, until: float, times: float) -> None:
    assert flight.sd_at(until) > times * flight.sd_at(AT - 1.0)


def test_a_dvl_that_is_silent_for_20_s(case):
    flight = flown(case, lambda m: [] if during(m, 20.0, "dvl") else [m])
    assert flight.events("dvl") == ["silent", "back"]
    honest(flight)
    grown(flight, AT + 19.0, 3.0)


def test_zeros_of_a_dvl_that_lost_the_bottom_for_10_s(case):
    lost = np.array([0.0, 0.0, 0.0, 1.0, np.nan])
    flight = flown(case, lambda m: [m._replace(values=lost) if during(m, 10.0, "dvl") else m])
    assert flight.events("dvl") == ["no lock", "back"]
    assert flight.navigator.left_out["dvl", "exactly zero"] == 40
    honest(flight)
    grown(flight, AT + 9.0, 1.5)


@pytest.mark.parametrize(("sensor", "columns", "least"), [("dvl", 3, 0.7), ("depth", 1, 1.0)])
def test_single_zeros_are_left_out_and_said_once_where_they_come_often(case, sensor, columns, least):
    count = 0

    def zeroed(m: Measurement) -> list[Measurement]:
        nonlocal count
        if m.sensor != sensor or m.time < AT or (round(4.0 * m.time) % 7):
            return [m]
        values = m.values.copy()
        values[:columns] = 0.0
        count += 1
        return [m._replace(values=values)]

    flight = flown(case, zeroed)
    assert flight.navigator.left_out[sensor, "exactly zero"] >= least * count > 5.0  # it may come to rest in between
    assert len(flight.events(sensor)) <= 2
    honest(flight)


def test_a_ping_that_is_repeated_for_5_s(case):
    last = next(m for m in case.log.measurements() if m.sensor == "dvl" and m.time > AT - 0.3)
    flight = flown(case, lambda m: [m._replace(values=last.values) if during(m, 5.0, "dvl") else m])
    assert flight.events("dvl") == ["frozen", "back"]
    honest(flight)


def test_compasses_beside_steel_for_20_s(case):
    flight = flown(case, lambda m: [turned(m, np.deg2rad(30.0)) if during(m, 20.0, *COMPASSES) else m])
    assert [kind for kind in flight.events("mag") if kind.endswith("ed")] == ["rejected", "readmitted"]
    assert "wrong" in flight.events("mag")
    honest(flight)


def test_a_dvl_that_locks_onto_something_else_for_a_minute_is_left_out_and_the_sd_grows():
    case, rng = simulated(falcon(), 100.0, 1, imu_rate=50.0, dvl_rate=4.0), np.random.default_rng(3)

    def alter(m: Measurement) -> list[Measurement]:
        if m.sensor != "dvl" or not 30.0 <= m.time < 90.0:
            return [m]
        values = m.values.copy()
        values[:3] = np.array([0.9, -0.6, 0.3]) + 0.004 * rng.standard_normal(3)
        return [m._replace(values=values)]

    flight = flown(case, alter)
    assert "incoherent" in flight.events("dvl")
    assert any("dvl: contradicts all other sensors" in e.text for s in flight.solutions for e in s.events)
    left_out = flight.time > 30.0 + 15.0
    assert (np.abs(flight.errors) / flight.sd)[left_out].max() < HONEST_SD
    assert flight.sd_at(80.0) > 10.0 * flight.sd_at(29.0)


def test_a_dvl_that_is_left_out_as_incoherent_stays_so_after_a_crash(case):
    flight = flown(case, lambda m: [m] if m.time < 20.0 else [])
    flight.navigator._incoherence.restore([18.0, 40.0, 40.0])
    after = navigator(case)
    after.restore(flight.navigator.state())
    for m in case.log.measurements():
        if 20.0 < m.time < 30.0:
            after.take(message(m))
    assert after.left_out["dvl", "incoherent"] > 30


def test_a_magnetometer_alone_contradicts_a_heading_that_is_stated_wrongly_and_is_believed_after_a_minute():
    case = simulated(falcon(heading={"sources": ["mag"]}), 80.0, 1, imu_rate=50.0, dvl_rate=4.0)
    heading = float(np.rad2deg(case.truth.rpy[0, 2]))
    config = changed(case.config, start={"heading_deg": heading + 90.0, "heading_sd_deg": 5.0})
    flight = flown(Simulated(config, case.dive, without(case.log, "dvl_heading")))
    assert flight.events("mag") == ["rejected", "wrong", "readmitted"]
    off = flight.solutions[-1].rpy[2] - true_at(case, flight.time[-1:]).rpy[0, 2]
    assert abs(np.rad2deg(off)) < 2.0


def test_an_imu_that_is_silent_for_5_s_while_the_dvl_goes_on(case):
    flight = flown(case, lambda m: [] if during(m, 5.0, "imu") else [m])
    assert flight.events("imu") == ["silent", "back", "gap"]
    honest(flight)
    grown(flight, AT + 4.5, 3.0)


@pytest.mark.parametrize("seconds", [5.0, 12.0])
def test_a_link_over_which_everything_comes_and_that_is_interrupted(case, seconds):
    flight = flown(case, lambda m: [] if during(m, seconds) else [m])
    assert {"silent", "back"} <= set(flight.events("dvl"))
    honest(flight)
    assert flight.sd_at(AT + seconds + 1.0) > 5.0 * flight.sd_at(AT - 1.0)
    after = flight.time > AT + seconds + 5.0
    assert np.linalg.norm(flight.errors[after], axis=1).max() < 0.5 * seconds, "faster than the vehicle"


def test_pings_that_are_outliers_for_less_than_the_dvl_is_kept_out(case):
    rng = np.random.default_rng(3)

    def wrong(m: Measurement) -> list[Measurement]:
        if not during(m, 1.5, "dvl"):
            return [m]
        return [m._replace(values=np.array([*rng.uniform(-2.0, 2.0, 3), 1.0, np.nan]))]

    flight = flown(case, wrong)
    honest(flight)
    assert "rejected" in flight.events("dvl") or flight.navigator.health.rejected["dvl"] >= 5


def test_every_other_ping_an_outlier_for_10_s(case):
    rng = np.random.default_rng(4)

    def wrong(m: Measurement) -> list[Measurement]:
        if not during(m, 10.0, "dvl") or rng.random() < 0.5:
            return [m]
        return [m._replace(values=np.array([*rng.uniform(-2.0, 2.0, 3), 1.0, np.nan]))]

    honest(flown(case, wrong))


def test_a_flood_is_thinned_out_and_the_estimate_is_the_same(case):
    """Each sample a hundred times within its period."""
    nav = navigator(case)
    plain = navigator(case)
    for m in case.log.measurements():
        if m.time > 10.0:
            break
        plain.take(message(m))
        for k in range(100 if m.sensor == "imu" else 1):
            nav.take(message(m._replace(time=m.time + 1e-6 * k)))
    assert nav.left_out["imu", "at the time of another"] == 99 * 1001
    assert nav.updates == plain.updates
    same(nav, plain, 1e-6)


def same(a: Navigator, b: Navigator, atol: float) -> None:
    one, other = a.solution(), b.solution()
    np.testing.assert_allclose(one.position, other.position, atol=atol)
    np.testing.assert_allclose(one.rpy, other.rpy, atol=atol)
    np.testing.assert_allclose(one.position_sd, other.position_sd, rtol=1e-3)


def arriving(case: Simulated, late: dict[str, float], until: float) -> list[tuple[float, Measurement]]:
    """Measurements by their arrival, some sensors' later than the others'."""
    found = [(m.time + late.get(m.sensor, 0.0), m) for m in case.log.measurements() if m.time < until]
    return sorted(found, key=lambda pair: pair[0])


@pytest.mark.parametrize("late", [0.2, 4.0])
def test_a_dvl_whose_pings_arrive_late_is_used_at_their_own_time(case, late):
    in_order, delayed = navigator(case, trust=False), navigator(case, trust=False)
    for nav, pairs in ((in_order, arriving(case, {}, 16.0)), (delayed, arriving(case, {"dvl": late}, 16.0))):
        for arrival, m in pairs:
            nav.take(message(m, arrival=1.7e9 + arrival))
        nav.finish()
        assert {e.source for e in nav.solution().events} == {"start"}, "what comes late is not silent"
    assert not delayed.left_out
    same(delayed, in_order, 1e-6)


def test_a_dvl_with_a_clock_of_its_own_is_put_on_that_of_the_imu(case):
    nav, kinds = navigator(case, trust=False), []
    for arrival, m in arriving(case, {}, 25.0):
        source, ahead = ("dvl", 5e8) if m.sensor == "dvl" else ("imu", 0.0)
        nav.take(message(m, arrival=1.7e9 + arrival + 0.002, stamp=m.time + ahead, source=source))
        if abs(m.time - 15.0) < 0.005:
            kinds += [e.kind for e in nav.solution().events]
    assert kinds.count("clock") == 1
    assert not nav.left_out
    solution = nav.solution()
    error = solution.position - true_at(case, np.array([solution.time])).p_n[0]
    assert (np.abs(error) < HONEST_SD * solution.position_sd)[:2].all()


def test_stamps_of_1970_and_of_the_future_are_left_out(case):
    nav, plain = navigator(case, trust=False), navigator(case, trust=False)
    for k, (arrival, m) in enumerate(arriving(case, {}, 20.0)):
        plain.take(message(m, arrival=1.7e9 + arrival))
        stamp = m.time
        if k % 200 == 150 and m.time > 8.0 and m.sensor == "imu":
            stamp = 0.0 if k % 400 < 200 else 4e9
        nav.take(message(m, arrival=1.7e9 + arrival, stamp=stamp + 1e6 * (stamp == m.time)))
        assert nav.clocks.odd == nav.left_out["sim", "impossible stamp"]
    assert nav.clocks.odd > 3
    a, b = nav.solution(), plain.solution()
    np.testing.assert_allclose(a.position, b.position, atol=3.0 * b.position_sd.max())


def test_events_of_a_dive_without_faults_are_those_of_its_start(case):
    flight = flown(case)
    assert {e.source for s in flight.solutions for e in s.events} == {"start"}
    assert all(b > a for a, b in pairwise(flight.time[:-1]))
    honest(flight)


def test_what_is_read_again_after_a_crash_is_no_event(case):
    before, after = navigator(case), navigator(case)
    pairs = [m for m in case.log.measurements() if m.time < 20.0]
    for m in pairs:
        before.take(message(m))
    after.restore(before.state())
    after.replay(Log("recording", {name: stream_until(s, 20.0) for name, s in case.log.streams.items()}))
    assert [e.kind for e in after.solution().events] == []
    same(after, before, 1e-6)


def stream_until(stream: Stream, time: float) -> Stream:
    keep = stream.time < time
    return Stream(stream.sensor, stream.columns, stream.time[keep], stream.data[keep], stream.row[keep])


def test_what_comes_close_together_is_taken_online_as_from_a_log():
    """Depths at any distance, a tenth of a millisecond among them, in bursts that are longer than that."""
    rng = np.random.default_rng(3)
    time = np.cumsum(rng.choice([0.0, 2e-5, 9.5e-5, 1.05e-4, 1e-3, 0.005, 0.2], 2000))
    depth = np.arange(2000.0)
    with pytest.warns(DataWarning, match="at the time of another"):
        log = Log.from_arrays({"time": time, "depth": depth})
    intake = Intake(Config(), Counter())
    read = [intake.measurement(t, Reading("depth", np.array([d]))) for t, d in zip(time, depth, strict=True)]
    assert log["depth"]["depth"].tolist() == [m.values.item() for m in read if m is not None]
    assert 1e-4 <= np.diff(log["depth"].time).min() < 1.06e-4


@pytest.mark.parametrize(("sensor", "rate"), [("imu", 2000.0), ("dvl", 200.0), ("ahrs", 400.0)])
def test_no_measurement_of_a_fast_sensor_is_left_out(sensor, rate):
    size = {"imu": 6, "dvl": 5, "ahrs": 3}[sensor]
    intake, read = Intake(Config(), Counter()), Reading(sensor, np.zeros(size))
    assert all(intake.measurement(1.7e9 + k / rate, read) is not None for k in range(1000))


def test_a_fix_in_degrees_is_as_late_as_one_in_metres(case):
    config = case.config.model_copy(update={"delay_s": {"fix": 0.5}})
    intake = Intake(config, Counter())
    local, geodetic = Reading("fix", np.zeros(3)), Reading(GEODETIC, np.array([58.0, 14.0, 1.0]))
    assert [time for time, _ in intake.timed(100.0, (local, geodetic))] == [99.5, 99.5]


def sds_taken(sds: list[float]) -> tuple[list[float], list[tuple[str, str]]]:
    """The sds of pings as the estimator takes them, and what is told of them."""
    intake = Intake(Config(), Counter())
    read = [Reading("dvl", np.array([0.4, 0.0, 0.0, 1.0, sd])) for sd in sds]
    taken = [intake.measurement(0.2 * k, reading) for k, reading in enumerate(read)]
    return [float(m.values[4]) for m in taken if m is not None], intake.news


def test_a_figure_of_merit_that_is_a_placeholder_all_the_time_is_unknown_and_told_once():
    sds, news = sds_taken([99.99] * 30)
    np.testing.assert_array_equal(sds, [99.99] * 9 + [np.nan] * 21)
    assert [sensor for sensor, _ in news] == ["dvl"] and "taken as unknown" in news[0][1]


def test_a_figure_of_merit_that_is_large_now_and_then_says_that_the_ping_is_bad():
    assert sds_taken([0.01, 10.0, 0.01] * 10) == ([0.01, 10.0, 0.01] * 10, [])


@pytest.mark.parametrize("latitude", [0.0, 58.4, -78.0])
def test_latitude_and_longitude_are_right_to_a_tenth_of_a_millimetre_wherever_the_vehicle_goes(latitude):
    intake, way = Intake(Config(), Counter()), np.cumsum(np.random.default_rng(0).normal(0.2, 2.0, (2000, 2)), axis=0)
    for origin in ((latitude, 17.0), (latitude, -179.99)):
        intake.origin = origin
        got = np.array([intake.geodetic(np.array([*p, 3.0])) for p in way])
        north, east, _ = pymap3d.geodetic2ned(got[:, 0], got[:, 1], 0.0, *origin, 0.0)
        assert np.hypot(*(np.column_stack([north, east]) - way).T).max() < 1e-4


def test_thruster_lines_that_change_their_count_are_left_out_and_the_estimate_begins(case):
    signals = Measurement(0.0, "thruster", np.array([10.0, 20.0]), 0)
    some = [
        signals._replace(time=t, values=signals.values[: 1 + k % 2]) for k, t in enumerate(np.arange(0.1, 12.0, 0.1))
    ]
    nav = navigator(case)
    measurements = [m for m in case.log.measurements() if m.time < 12.0]
    for m in sorted(measurements + some, key=lambda m: m.time):
        nav.take(message(m))
    assert nav.engine is not None
    assert nav.left_out["thruster", "2 signals, and 1 before"] > 50


@pytest.mark.slow
@pytest.mark.parametrize("late", [False, True])
def test_water_track_is_used_whenever_it_begins_and_carries_the_filter_where_the_bottom_is_lost(late):
    case = simulated(falcon(), 60.0, seed=1, dvl_rate=4.0, water_track=True)

    def alter(m: Measurement) -> list[Measurement]:
        lost = m.sensor == "dvl" and m.time > 35.0
        return [] if lost or (late and m.sensor == "dvl_water" and m.time < AT) else [m]

    flight = flown(case, alter)
    assert flight.events("dvl_water") == (["joined"] if late else [])
    assert flight.navigator.health.used["dvl_water"] > 100
    honest(flight)
    assert flight.sd_at(59.0) < 0.5 * flown(case, lambda m: [] if m.sensor == "dvl_water" else alter(m)).sd_at(59.0)


def test_thruster_signals_are_used_whenever_they_begin():
    dive, config = by_name("docking", 1)
    config = changed(config, graph={"hydrodynamics": True})
    case = Simulated(config, dive, as_log(dive.log_frame[dive.log_frame["time"] < 40.0]))
    flight = flown(case, lambda m: [] if m.sensor == "thruster" and m.time < AT else [m])
    assert flight.events("thruster")[0] == "joined"
    assert flight.navigator.health.used["thruster"] > 50
    honest(flight)


def test_fixes_that_begin_late_say_where_the_vehicle_is():
    config = falcon(fix={"sd_m": 0.5}).model_copy(update={"start": Config().start})
    case = simulated(config, 60.0, seed=1, dvl_rate=4.0, fix_interval=1.0)
    away = np.array([300.0, -200.0, 0.0, 0.0, 0.0, 0.0])

    def alter(m: Measurement) -> list[Measurement]:
        return [m] if m.sensor != "fix" else [m._replace(values=m.values + away)] if m.time > 25.0 else []

    flight = flown(case, alter)
    assert flight.events("fix") == ["joined"]
    assert flight.navigator.health.rejected["fix"] <= 1
    after = flight.time > 26.0
    assert (np.abs(flight.errors - away[:2]) / flight.sd)[after].max() < HONEST_SD
    assert flight.solutions[-1].distance < 60.0
    assert flight.solutions[-1].verdict == "trusted"


@pytest.mark.parametrize("lag", [2.0, 20.0])
def test_the_filter_is_reinitialised_whatever_the_lag(case, lag, monkeypatch):
    done, adopt = [], FixedLag.adopt
    monkeypatch.setattr(FixedLag, "adopt", lambda engine, *known: done.append(adopt(engine, *known)))
    config = case.config.model_copy(update={"graph": case.config.graph.model_copy(update={"lag_s": lag})})
    nav = Navigator(config, patient=True, clocks=Clocks(trust=True))
    for m in case.log.measurements():
        nav.take(message(m))
    nav.finish()
    assert len(done) >= 2 and all(done)
    assert not [e for e in nav._take_events() if e.kind == "lost"]


def test_a_track_that_cannot_be_smoothed_leaves_the_filter_running(case, tmp_path, monkeypatch):
    def fails(self):
        raise InputError("the data do not determine pose of keyframe 3")

    monkeypatch.setattr(IncrementalEstimator, "solve", fails)
    nav = Navigator(case.config, reinitialise=False, smooth=True, clocks=Clocks(trust=True))
    files = Files(tmp_path, case.config, Warnings())
    session = Session(nav, [], Warnings(), 2.0, files)
    session.run(message(m) for m in case.log.measurements() if m.time < 20.0)
    files.close()
    assert nav.isam2 is None
    assert session.solution.time > 19.0
