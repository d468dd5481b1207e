"""Keyframes and attached measurements: what goes where, and what is left out."""

from collections import Counter
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from dives import Simulated, falcon, interrupted, kept, level_log, same, simulated, started
from hypothesis import given, settings
from hypothesis import strategies as st

from rovgraph.kernels import measurement_row as at
from rovgraph.kernels.assembly import UPTO
from rovgraph.kernels.motion_row import DURATION
from rovgraph.log import Log
from rovgraph.model.config import Config
from rovgraph.problem.assembly import Assembly, InsertResult
from rovgraph.problem.problem import Problem
from rovgraph.sensors.instruments import instruments

G = np.array([0.0, 0.0, -9.81])


Whole = tuple[Problem, Counter[tuple[str, str]]]


def empty(config: Config | None = None, sensors: tuple[str, ...] = ()) -> Assembly:
    every = instruments(config or Config())
    return Assembly(config or Config(), {s: every[s] for s in sensors or every}, np.zeros(6))


def assembled(log: Log, config: Config | None = None) -> Whole:
    """The keyframes of a log, which are the same however they come.

    As a whole at once; as a whole, sample by sample; measurement by measurement; and so with keyframes that are unmade
    again and again.
    """
    rng, found = np.random.default_rng(1), []
    for way in ("whole", "sample by sample", "one by one", "unmade"):
        assembly = empty(config)
        if way in ("whole", "sample by sample"):
            assembly.take(log)
            while way == "sample by sample" and assembly.extend(one=True):
                pass
        else:
            for measurement in log.measurements():
                assembly.insert(measurement)
                assembly.extend()
                if way == "unmade" and rng.random() < 0.02:
                    assembly.truncate(int(rng.integers(max(len(assembly) - 5, 0), len(assembly) + 1)))
        assembly.extend(finish=True)
        assembly.problem.keyframes[:, UPTO] = 0.0  # counts what never enters, which a whole log leaves out at once
        found.append((assembly.problem, +assembly.left_out))
    for problem, left_out in found[1:]:
        same(found[0][0], problem)
        assert left_out == found[0][1]
    return found[0]


def log_of(seconds: float = 4.0, pings=(), rate: float = 100.0, **sensors) -> Log:
    """A level IMU at rest with pings and other sensors at given times."""
    pings = np.asarray(pings, float)
    streams = {"dvl": (pings, np.column_stack([np.tile([0.3, 0, 0, 1], (len(pings), 1)), np.full(len(pings), np.nan)]))}
    streams = streams if len(pings) else {}
    return level_log(seconds, G, np.zeros(3), rate, **streams, **sensors)


def scalar(times) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(times, float), np.arange(len(times), dtype=float)[:, None]


def times(problem: Problem) -> list[float]:
    return problem.time.round(6).tolist()


class Found(NamedTuple):
    """A measurement: the interval that it lies in, its keyframe, and its numbers."""

    interval: int
    keyframe: int
    time: float
    dt: float
    dR: np.ndarray
    dv: np.ndarray
    sd: np.ndarray


def found(problem: Problem, sensor: str) -> list[Found]:
    index, rows = problem.of_sensor(sensor), problem.rows
    dim = problem.dims[problem.sensors.index(sensor)]
    return [
        Found(
            int(problem.interval[j]),
            int(problem.keyframe[j]),
            float(rows[j, at.TIME]),
            float(rows[j, at.DT]),
            rows[j, at.DR : at.DV].reshape(3, 3),
            rows[j, at.DV : at.DP],
            problem.sd(np.array([j]), dim)[0],
        )
        for j in index.tolist()
    ]


def test_a_keyframe_stands_at_every_ping_and_at_both_ends_of_the_imu():
    problem, _ = assembled(log_of(2.0, [0.213, 0.4, 0.951, 1.7777]))
    assert times(problem) == [0.0, 0.213, 0.4, 0.951, 1.7777, 2.0]
    assert len(problem) == 6 and len(problem.motions) == 5
    assert problem.motions[:, DURATION].sum() == pytest.approx(2.0)


def test_a_motion_has_its_covariance_until_that_is_dropped_which_copies_nothing():
    problem, _ = assembled(log_of(2.0, [0.213, 0.4, 0.951, 1.7777]))
    for covariance, W in zip(problem.covariances, problem.weights, strict=True):
        np.testing.assert_allclose(W @ covariance @ W.T, np.eye(15), atol=1e-6)
    part, bare = problem.part(1, 4, 0, 0), problem.without_covariances()
    np.testing.assert_array_equal(part.covariances, problem.covariances[1:3])
    assert bare.covariances.shape == (0, 15, 15) and bare.part(1, 4, 0, 0).covariances.shape == (0, 15, 15)
    assert bare.motions is problem.motions and bare.weights is problem.weights


def test_a_ping_is_attached_to_its_own_keyframe_without_motion():
    problem, _ = assembled(log_of(2.0, [0.213, 0.951]))
    for a in found(problem, "dvl"):
        assert a.keyframe == a.interval and a.time == problem.time[a.keyframe]
        assert a.dt == 0.0
        np.testing.assert_array_equal(a.dR, np.eye(3))


def test_a_silent_dvl_leaves_keyframes_at_the_longest_gap():
    config = Config.model_validate({"graph": {"max_gap_s": 0.5}})
    problem, _ = assembled(log_of(4.0, [0.3, 3.2]), config)
    assert times(problem) == [0.0, 0.3, 0.8, 1.3, 1.8, 2.3, 2.8, 3.2, 3.7, 4.0]
    assert max(np.diff(times(problem))) <= 0.5 + 1e-9


def test_a_log_without_dvl_has_keyframes_all_the_same():
    problem, _ = assembled(log_of(3.5, fix=(np.array([1.2]), np.array([[1.0, 2.0, np.nan]]))))
    assert times(problem) == [0.0, 1.0, 2.0, 3.0, 3.5]
    [fix] = found(problem, "fix")
    assert (fix.interval, fix.keyframe) == (2, 1)
    assert fix.dt == pytest.approx(0.2)


@pytest.mark.parametrize("late", [1e-9, 1e-3, 0.04, 0.2, 0.25 - 1e-9])
def test_a_ping_that_comes_late_makes_the_keyframe_of_the_gap(late):
    problem, _ = assembled(log_of(4.0, [0.5, 1.5 + late, 2.5 + late]))
    np.testing.assert_allclose(problem.time, [0.0, 0.5, 1.5 + late, 2.5 + late, 3.5 + late, 4.0])
    assert all(a.dt == 0.0 for a in found(problem, "dvl"))


def test_a_ping_that_comes_later_still_makes_a_keyframe_beside_that_of_the_gap():
    problem, _ = assembled(log_of(4.0, [0.5, 1.751, 3.4]))
    assert times(problem) == [0.0, 0.5, 1.5, 1.751, 2.751, 3.4, 4.0]
    assert all(a.dt == 0.0 for a in found(problem, "dvl"))


@pytest.mark.slow
@given(
    period=st.sampled_from([0.5, 1.0, 2.0, 3.0]),
    rounding=st.lists(st.floats(-1e-4, 1e-4), min_size=6, max_size=6),
    min_gap=st.sampled_from([0.05, 0.3]),
)
@settings(deadline=None, max_examples=50)
def test_keyframes_do_not_depend_on_the_rounding_of_the_pings_period(period, rounding, min_gap):
    config = Config.model_validate({"graph": {"min_gap_s": min_gap}})
    pings = period * np.arange(1, 7)
    exact, _ = assembled(log_of(6.5 * period, pings), config)
    rounded, _ = assembled(log_of(6.5 * period, pings + rounding), config)
    np.testing.assert_allclose(rounded.time, exact.time, atol=2e-4)
    assert [a.keyframe for a in found(rounded, "dvl")] == [a.keyframe for a in found(exact, "dvl")]
    assert all(a.dt == 0.0 for a in found(rounded, "dvl"))


def test_what_is_measured_while_a_ping_is_due_belongs_to_the_keyframe_before_it():
    fixes = (np.array([1.4, 1.5, 1.7, 1.9]), np.tile([1.0, 2.0, 0.5], (4, 1)))
    problem, _ = assembled(log_of(3.0, [0.5], fix=fixes))
    assert times(problem) == [0.0, 0.5, 1.5, 2.5, 3.0]
    assert [(a.keyframe, round(a.dt, 6)) for a in found(problem, "fix")] == [
        (1, 0.9),
        (1, 1.0),
        (2, 0.2),
        (2, 0.4),
    ]


def test_a_ping_soon_after_another_is_attached_instead_of_making_a_keyframe():
    problem, _ = assembled(log_of(2.0, [0.5, 0.53, 0.9]))
    assert times(problem) == [0.0, 0.5, 0.9, 1.9, 2.0]
    close = found(problem, "dvl")[1]
    assert (close.time, close.keyframe) == (0.53, 1)
    assert close.dt == pytest.approx(0.03)


def test_a_measurement_between_keyframes_carries_the_motion_to_its_own_time():
    problem, _ = assembled(log_of(2.0, [0.5, 0.9], depth=scalar([0.731])))
    [depth] = found(problem, "depth")
    assert (depth.interval, depth.keyframe, depth.time) == (2, 1, 0.731)
    assert depth.dt == pytest.approx(0.231)
    np.testing.assert_allclose(depth.dv, 0.231 * G, atol=1e-9)


def test_a_measurement_at_the_time_of_a_ping_has_no_motion():
    problem, _ = assembled(log_of(2.0, [0.5, 0.9], depth=scalar([0.5])))
    [depth] = found(problem, "depth")
    assert (depth.keyframe, depth.dt) == (1, 0.0)
    np.testing.assert_array_equal(depth.dR, np.eye(3))


@pytest.mark.parametrize("sensor", ["depth", "dvl_heading"])
def test_headings_and_depths_enter_once_per_interval_the_first_one(sensor):
    problem, _ = assembled(log_of(2.0, [0.5, 0.9], **{sensor: scalar(np.arange(0.51, 1.0, 0.04))}))
    taken = [a.time for a in found(problem, sensor)]
    np.testing.assert_allclose(taken, [0.51, 0.91])


def test_fixes_enter_every_one():
    fixes = (np.array([0.6, 0.65, 0.7]), np.tile([1.0, 2.0, 0.5], (3, 1)))
    problem, _ = assembled(log_of(2.0, [0.5, 0.9], fix=fixes))
    assert [a.time for a in found(problem, "fix")] == [0.6, 0.65, 0.7]
    np.testing.assert_array_equal(found(problem, "fix")[0].sd, [0.5, 0.5])  # its own fix_sd


def test_an_ellipse_of_a_fix_is_its_noise_and_an_impossible_one_is_left_out():
    noise = np.array([[0.5, 0.8, 0.3], [0.5, np.nan, -0.1], [0.5, 0.8, np.nan], [0.5, 0.8, -0.4]])
    fixes = (np.array([0.6, 0.65, 0.7, 0.75]), np.column_stack([np.tile([1.0, 2.0], (4, 1)), noise]))
    problem, left_out = assembled(log_of(2.0, [0.5, 0.9], fix=fixes))
    taken = problem.noise(problem.of_sensor("fix"), 2)
    np.testing.assert_array_equal(taken, [[0.5, 0.8, 0.3], [0.5, 0.5, -0.1], [0.5, 0.8, 0.0]])
    ((sensor, why),) = left_out
    assert sensor == "fix" and why.startswith("|fix_cov_ne| is not below fix_sd times fix_east_sd")


def pings_with(values: dict[int, list[float]]) -> Log:
    """Ten pings, some of them with other values."""
    time = np.round(np.arange(10) * 0.2 + 0.1, 3)
    data = np.tile([0.3, 0.0, 0.0, 1.0, np.nan], (10, 1))
    for k, value in values.items():
        data[k] = value
    return level_log(2.5, G, np.zeros(3), dvl=(time, data))


def test_pings_without_bottom_lock_or_too_fast_are_left_out_and_counted():
    log = pings_with({2: [0.3, 0, 0, 0, np.nan], 3: [0, 0, 0, 0, np.nan], 6: [0.3, -3.1, 0, 1, np.nan]})
    problem, left_out = assembled(log)
    assert len(found(problem, "dvl")) == 7
    assert left_out["dvl", "no bottom lock"] == 2
    assert left_out["dvl", "faster than dvl.max_speed_mps"] == 1
    assert not {0.5, 0.7, 1.3} & set(times(problem))


def test_a_pings_own_figure_of_merit_only_widens_its_noise():
    log = pings_with({1: [0.3, 0, 0, 1, 0.05], 2: [0.3, 0, 0, 1, 0.001]})
    sds = [a.sd for a in found(assembled(log)[0], "dvl")]
    np.testing.assert_array_equal(sds[1], 0.05)
    np.testing.assert_array_equal(sds[2], Config().dvl.velocity_sd_mps)


def test_noise_that_grows_with_speed_is_added_to_that_of_a_ping():
    config = Config.model_validate({"dvl": {"scale_sd": 0.1}})
    sd = found(assembled(pings_with({}), config)[0], "dvl")[0].sd
    np.testing.assert_allclose(sd, np.hypot(0.01, 0.03))


def test_what_lies_outside_the_imus_record_is_left_out_and_counted():
    log = log_of(2.0, [0.5, 1.5, 2.05, 2.2], depth=scalar([1.0, 2.3]))
    imu = log["imu"]
    late = type(imu)("imu", imu.columns, imu.time + 0.3, imu.data, imu.row)
    shifted = Log("dive.csv", {**log.streams, "imu": late, "fix": early()})
    problem, left_out = assembled(shifted)
    assert times(problem)[0] == 0.3 and times(problem)[-1] == 2.3
    assert left_out["fix", "before the first IMU sample"] == 1
    assert ("dvl", "before the first IMU sample") not in left_out
    short = Log("dive.csv", {**log.streams})
    problem, left_out = assembled(short)
    assert times(problem)[-1] == 2.0
    assert left_out["dvl", "after the last IMU sample"] == 2
    assert left_out["depth", "after the last IMU sample"] == 1


def early():
    fix = log_of(1.0, fix=(np.array([0.1]), np.array([[1.0, 2.0, np.nan]])))
    return fix["fix"]


def test_every_measurement_is_attached_thinned_or_counted():
    """None gets lost: what is attached and what is left out add up, where nothing is thinned."""
    rng = np.random.default_rng(0)
    pings = np.sort(rng.uniform(-0.5, 10.5, 60)).round(4)
    fixes = np.sort(rng.uniform(-0.5, 10.5, 40)).round(4)
    log = log_of(10.0, pings, fix=(fixes, np.tile([0.0, 0.0, np.nan], (40, 1))))
    problem, left_out = assembled(log)
    attached = [*zip(problem.which.tolist(), problem.rows[:, at.TIME].tolist(), strict=True)]
    assert len(attached) == len(set(attached))
    assert len(attached) + sum(left_out.values()) == 100
    assert (problem.rows[:, at.TIME] >= problem.time[problem.keyframe]).all()


def test_sensors_that_are_not_in_use_are_ignored():
    assembly = empty(sensors=("dvl",))
    for m in log_of(2.0, [0.5], depth=scalar([0.7])).measurements():
        assembly.insert(m)
    assembly.extend(finish=True)
    assert not assembly.left_out
    assert assembly.problem.used == ["dvl"]


def made_at(log: Log) -> list[tuple[float, float]]:
    """Time of the measurement by which each keyframe is made, and of the keyframe."""
    assembly, done = empty(), []
    for m in log.measurements():
        assembly.insert(m)
        count = assembly.extend()
        done += [(m.time, time) for time in assembly.problem.time[len(assembly) - count :].tolist()]
    return done


def test_an_interval_is_given_once_the_imu_is_half_a_window_past_its_ping():
    done = made_at(log_of(1.0, [0.203, 0.6]))
    assert done == [(0.0, 0.0), (0.26, 0.203), (0.65, 0.6)]


def test_the_keyframe_of_a_gap_is_given_once_no_ping_is_due():
    done = made_at(log_of(3.0, [0.5]))
    assert done == [(0.0, 0.0), (0.55, 0.5), (1.81, 1.5), (2.81, 2.5)]


def test_an_imu_of_one_sample_makes_one_keyframe():
    log = log_of(0.0)
    problem, _ = assembled(log)
    assert times(problem) == [0.0]


@pytest.fixture(scope="module")
def dive() -> Simulated:
    return simulated(falcon(imu={"max_gap_s": 60.0}), 40.0, seed=5, dvl_rate=4.7)


LATE = {"dvl_time_offset": {"estimate": True, "sd": 0.05, "mean": 0.03}}
SCALED = {"acc_scale": {"estimate": True}, "gyr_scale": {"estimate": True}}


@pytest.mark.parametrize(
    "sections",
    [
        {},
        {"calibration": LATE},
        {"calibration": SCALED},
        {"graph": {"max_gap_s": 0.1}},
        {"graph": {"min_gap_s": 0.3}},
        {"graph": {"max_gap_s": 0.35, "min_gap_s": 0.25, "segment_s": 3.0}},
        {"imu": {"mount_rpy_deg": [176.6, 1.2, 30]}},
    ],
    ids=["plain", "late", "scaled", "short gaps", "sparse keyframes", "segments", "mounted"],
)
@pytest.mark.parametrize("silence", ["none", "imu", "dvl", "everything", "beginning", "end"])
def test_a_log_taken_as_a_whole_gives_what_its_measurements_give_one_by_one(dive, sections, silence):
    """`assembled` compares."""
    log = dive.log
    if silence in ("imu", "dvl"):
        log = interrupted(log, 34.0, 1.7, silence)
    elif silence == "everything":
        log = interrupted(log, 34.0, 1.7)
    elif silence == "beginning":
        log = kept(log, "imu", log["imu"].time > 28.234)
    elif silence == "end":
        log = kept(log, "imu", log["imu"].time < 38.765)
    problem, _ = assembled(log, started(dive, **sections))
    assert len(problem) > 25


def test_places_of_a_whole_log_count_again_after_a_while_as_those_that_come_one_by_one():
    """`assembled` compares."""
    at = np.array([0.31, 0.32, 0.87, 1.49, 2.6, 2.6, 3.99])
    names = np.array([7.0, 7.0, 3.0, 7.0, 3.0, 7.0, 7.0])
    config = Config.model_validate({"place": {"every_s": 1.0}})
    places = at, np.column_stack([names, np.full(len(at), np.nan)])
    problem, left_out = assembled(log_of(4.0, [0.5, 1.3, 1.31, 2.6], place=places), config)
    seen = problem.of_sensor("place")
    assert [*zip(problem.names[seen].tolist(), problem.number[seen].tolist(), strict=True)] == [
        (7, 1),
        (3, 2),
        (7, 3),
        (3, 4),
        (7, 5),
        (7, 6),
    ]
    assert left_out["place", "still in view"] == 1


def test_a_log_at_the_time_of_a_clock_and_one_that_begins_with_pings_are_taken_alike():
    """`assembled` compares."""
    log = log_of(3.0, [-0.4, 0.0, 0.004, 1.1, 3.0, 3.2], depth=scalar([-0.1, 0.0, 1.1, 2.9, 3.0, 3.1]))
    _, left_out = assembled(log)
    assert left_out["dvl", "before the first IMU sample"] == 1
    later = {name: replace(stream, time=stream.time + 1.7e9) for name, stream in log.streams.items()}
    assembled(replace(log, streams=later))


@pytest.mark.slow
def test_what_comes_late_is_as_if_it_had_come_in_time(dive):
    measurements = [m for m in dive.log.measurements() if m.time < 32.0]
    in_time, late, rng = empty(started(dive)), empty(started(dive)), np.random.default_rng(4)
    arrival = np.array([m.time for m in measurements]) + rng.uniform(0.0, 0.7, len(measurements))
    arrival[:60] = -np.arange(60, 0, -1)  # the first samples tell what a gap is
    for assembly, order in ((in_time, range(len(measurements))), (late, np.argsort(arrival).tolist())):
        for k in order:
            assert assembly.insert(measurements[k]) == InsertResult.IN
            assembly.extend()
        assembly.extend(finish=True)
    same(in_time.problem, late.problem)


def test_a_measurement_that_comes_again_or_before_what_is_settled_is_not_taken(dive):
    measurements, assembly = [m for m in dive.log.measurements() if m.time < 5.0], empty(started(dive))
    for m in measurements:
        assembly.insert(m)
        assembly.extend()
    problem = assembly.problem
    for sensor in ("imu", "dvl", "depth"):
        early, recent = ([m for m in measurements if m.sensor == sensor][k] for k in (3, -3))
        assert assembly.insert(recent, 4.0) == InsertResult.AGAIN
        assert assembly.insert(early, 4.0) == InsertResult.LATE
    same(problem, assembly.problem)


def test_what_is_forgotten_changes_nothing_of_what_follows(dive):
    """Of a dive with more keyframes than are ever kept."""
    config = started(dive, graph={"max_gap_s": 0.05})
    whole, some = empty(config), empty(config)
    for m in dive.log.measurements():
        for assembly in (whole, some):
            assembly.insert(m)
            assembly.extend()
        some.forget(len(some))
    for assembly in (whole, some):
        assembly.extend(finish=True)
    gone = some.forgotten
    assert gone > 200 and len(some) == len(whole) - gone
    a, b = whole.problem, some.problem
    np.testing.assert_array_equal(a.keyframes[gone:, at.TIME], b.keyframes[:, at.TIME])
    first = len(b.motions) - (len(a.motions) - gone)
    np.testing.assert_allclose(a.motions[gone:], b.motions[first:])
    np.testing.assert_allclose(a.covariances[gone:], b.covariances[first:])
    rows = len(a.rows) - len(b.rows)
    np.testing.assert_allclose(a.rows[rows:], b.rows)
    assert whole.left_out == some.left_out


def test_restored_from_its_state_an_assembly_goes_on_as_if_nothing_had_happened(dive):
    measurements, cut = [*dive.log.measurements()], 3000
    before, after = empty(started(dive)), empty(started(dive))
    for m in measurements[:cut]:
        before.insert(m)
        before.extend()
    after.restore(before.state(len(before) - 3))
    for assembly in (before, after):
        for m in measurements[cut:]:
            assembly.insert(m)
            assembly.extend()
        assembly.extend(finish=True)
    first = len(before) - 3 - 40
    same(before.problem.keyframes[first:, :12], after.problem.keyframes[first:, :12])
    same(before.problem.motions[-40:], after.problem.motions[-40:])
    same(before.problem.covariances[-40:], after.problem.covariances[-40:])
    same(before.problem.rows[-100:], after.problem.rows[-100:])


@pytest.mark.parametrize("estimate", [False, True])
def test_what_is_stamped_late_stands_as_much_earlier(estimate):
    late = {"depth_time_offset": {"estimate": estimate, "mean": 0.1, "sd": 0.01}}
    config = Config.model_validate({"calibration": late})
    problem, _ = assembled(log_of(2.0, [0.5, 0.9], depth=scalar([0.731])), config)
    [depth] = found(problem, "depth")
    assert depth.time == pytest.approx(0.631) and depth.dt == pytest.approx(0.131)
