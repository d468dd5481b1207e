"""Keyframes and attached measurements: what goes where, and what is left out."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from dives import Simulated, falcon, interrupted, kept, level_log, same, simulated, started
from hypothesis import given, settings
from hypothesis import strategies as st

from rovgraph.config import Config, beliefs
from rovgraph.engine.assembly import Assembler
from rovgraph.engine.dive_rows import DiveRows
from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.engine.log_assembly import assemble_log
from rovgraph.engine.measurement_table import MeasurementTable
from rovgraph.engine.time_offsets import TimeOffsets
from rovgraph.instruments import instruments
from rovgraph.log import Log

G = np.array([0.0, 0.0, -9.81])


def assembled(log: Log, config: Config | None = None) -> tuple[list[KeyframeInterval], Assembler]:
    config = config or Config()
    assembler, left_out = Assembler(config, instruments(config), np.zeros(6)), Counter()
    done: list[KeyframeInterval] = []
    for measurement in log.measurements():
        done += assembler.add(measurement)
    done += assembler.finish()
    offsets = TimeOffsets.of(beliefs(config), assembler.instruments)
    whole = assemble_log(log, config, assembler.instruments, np.zeros(6), offsets, left_out)
    same(done, whole.intervals)
    same(DiveRows.of(done, [*assembler.instruments]), whole.rows)
    for part in (slice(0, None), slice(len(done) // 2, len(done) - 1)):  # as measurements by themselves, too
        columns, alone = (MeasurementTable.of_dive(some[part]) for some in (whole.intervals, done))
        same([*map(columns.__getitem__, range(len(columns)))], [*map(alone.__getitem__, range(len(alone)))])
        for sensor in alone.used:
            same(columns.of_sensor(sensor).rows, alone.of_sensor(sensor).rows)
    assert left_out == assembler.left_out
    return done, assembler


def log_of(seconds: float = 4.0, pings=(), rate: float = 100.0, **sensors) -> Log:
    """A level IMU at rest with pings and other sensors at given times."""
    pings = np.asarray(pings, float)
    streams = {"dvl": (pings, np.column_stack([np.tile([0.3, 0, 0, 1], (len(pings), 1)), np.full(len(pings), np.nan)]))}
    streams = streams if len(pings) else {}
    return level_log(seconds, G, np.zeros(3), rate, **streams, **sensors)


def scalar(times) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(times, float), np.arange(len(times), dtype=float)[:, None]


def times(intervals: list[KeyframeInterval]) -> list[float]:
    return [round(i.time, 6) for i in intervals]


def found(intervals: list[KeyframeInterval], sensor: str):
    return [(i.index, a) for i in intervals for a in i.measurements if a.sensor == sensor]


def test_a_keyframe_stands_at_every_ping_and_at_both_ends_of_the_imu():
    intervals, _ = assembled(log_of(2.0, [0.213, 0.4, 0.951, 1.7777]))
    assert times(intervals) == [0.0, 0.213, 0.4, 0.951, 1.7777, 2.0]
    assert [i.index for i in intervals] == list(range(6))
    assert intervals[0].motion is None
    assert sum(i.motion.duration for i in intervals[1:]) == pytest.approx(2.0)


def test_a_ping_is_attached_to_its_own_keyframe_without_motion():
    intervals, _ = assembled(log_of(2.0, [0.213, 0.951]))
    for index, a in found(intervals, "dvl"):
        assert a.keyframe == index and a.time == intervals[index].time
        assert a.motion.dt == 0.0
        np.testing.assert_array_equal(a.motion.dR, np.eye(3))


def test_a_silent_dvl_leaves_keyframes_at_the_longest_gap():
    config = Config.model_validate({"graph": {"max_gap_s": 0.5}})
    intervals, _ = assembled(log_of(4.0, [0.3, 3.2]), config)
    assert times(intervals) == [0.0, 0.3, 0.8, 1.3, 1.8, 2.3, 2.8, 3.2, 3.7, 4.0]
    assert max(np.diff(times(intervals))) <= 0.5 + 1e-9


def test_a_log_without_dvl_has_keyframes_all_the_same():
    intervals, _ = assembled(log_of(3.5, fix=(np.array([1.2]), np.array([[1.0, 2.0, np.nan]]))))
    assert times(intervals) == [0.0, 1.0, 2.0, 3.0, 3.5]
    [(index, fix)] = found(intervals, "fix")
    assert (index, fix.keyframe) == (2, 1)
    assert fix.motion.dt == pytest.approx(0.2)


@pytest.mark.parametrize("late", [1e-9, 1e-3, 0.04, 0.2, 0.25 - 1e-9])
def test_a_ping_that_comes_late_makes_the_keyframe_of_the_gap(late):
    intervals, _ = assembled(log_of(4.0, [0.5, 1.5 + late, 2.5 + late]))
    np.testing.assert_allclose([i.time for i in intervals], [0.0, 0.5, 1.5 + late, 2.5 + late, 3.5 + late, 4.0])
    assert all(a.motion.dt == 0.0 for _, a in found(intervals, "dvl"))


def test_a_ping_that_comes_later_still_makes_a_keyframe_beside_that_of_the_gap():
    intervals, _ = assembled(log_of(4.0, [0.5, 1.751, 3.4]))
    assert times(intervals) == [0.0, 0.5, 1.5, 1.751, 2.751, 3.4, 4.0]
    assert all(a.motion.dt == 0.0 for _, a in found(intervals, "dvl"))


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
    np.testing.assert_allclose([i.time for i in rounded], [i.time for i in exact], atol=2e-4)
    assert [a.keyframe for _, a in found(rounded, "dvl")] == [a.keyframe for _, a in found(exact, "dvl")]
    assert all(a.motion.dt == 0.0 for _, a in found(rounded, "dvl"))


def test_what_is_measured_while_a_ping_is_due_belongs_to_the_keyframe_before_it():
    fixes = (np.array([1.4, 1.5, 1.7, 1.9]), np.tile([1.0, 2.0, 0.5], (4, 1)))
    intervals, _ = assembled(log_of(3.0, [0.5], fix=fixes))
    assert times(intervals) == [0.0, 0.5, 1.5, 2.5, 3.0]
    assert [(a.keyframe, round(a.motion.dt, 6)) for _, a in found(intervals, "fix")] == [
        (1, 0.9),
        (1, 1.0),
        (2, 0.2),
        (2, 0.4),
    ]


def test_a_ping_soon_after_another_is_attached_instead_of_making_a_keyframe():
    intervals, _ = assembled(log_of(2.0, [0.5, 0.53, 0.9]))
    assert times(intervals) == [0.0, 0.5, 0.9, 1.9, 2.0]
    close = found(intervals, "dvl")[1][1]
    assert (close.time, close.keyframe) == (0.53, 1)
    assert close.motion.dt == pytest.approx(0.03)


def test_a_measurement_between_keyframes_carries_the_motion_to_its_own_time():
    intervals, _ = assembled(log_of(2.0, [0.5, 0.9], depth=scalar([0.731])))
    [(index, depth)] = found(intervals, "depth")
    assert (index, depth.keyframe, depth.time) == (2, 1, 0.731)
    assert depth.motion.dt == pytest.approx(0.231)
    np.testing.assert_allclose(depth.motion.dv, 0.231 * G, atol=1e-9)


def test_a_measurement_at_the_time_of_a_ping_has_no_motion():
    intervals, _ = assembled(log_of(2.0, [0.5, 0.9], depth=scalar([0.5])))
    [(_, depth)] = found(intervals, "depth")
    assert (depth.keyframe, depth.motion.dt) == (1, 0.0)
    np.testing.assert_array_equal(depth.motion.dR, np.eye(3))


@pytest.mark.parametrize("sensor", ["depth", "dvl_heading"])
def test_headings_and_depths_enter_once_per_interval_the_first_one(sensor):
    intervals, _ = assembled(log_of(2.0, [0.5, 0.9], **{sensor: scalar(np.arange(0.51, 1.0, 0.04))}))
    taken = [a.time for _, a in found(intervals, sensor)]
    np.testing.assert_allclose(taken, [0.51, 0.91])


def test_fixes_enter_every_one():
    fixes = (np.array([0.6, 0.65, 0.7]), np.tile([1.0, 2.0, 0.5], (3, 1)))
    intervals, _ = assembled(log_of(2.0, [0.5, 0.9], fix=fixes))
    assert [a.time for _, a in found(intervals, "fix")] == [0.6, 0.65, 0.7]
    np.testing.assert_array_equal(found(intervals, "fix")[0][1].sd, [0.5, 0.5])  # its own fix_sd


def pings_with(values: dict[int, list[float]]) -> Log:
    """Ten pings, some of them with other values."""
    time = np.round(np.arange(10) * 0.2 + 0.1, 3)
    data = np.tile([0.3, 0.0, 0.0, 1.0, np.nan], (10, 1))
    for k, value in values.items():
        data[k] = value
    return level_log(2.5, G, np.zeros(3), dvl=(time, data))


def test_pings_without_bottom_lock_or_too_fast_are_left_out_and_counted():
    log = pings_with({2: [0.3, 0, 0, 0, np.nan], 3: [0, 0, 0, 0, np.nan], 6: [0.3, -3.1, 0, 1, np.nan]})
    intervals, assembler = assembled(log)
    assert len(found(intervals, "dvl")) == 7
    assert assembler.left_out["dvl", "no bottom lock"] == 2
    assert assembler.left_out["dvl", "faster than dvl.max_speed_mps"] == 1
    assert not {0.5, 0.7, 1.3} & set(times(intervals))


def test_a_pings_own_figure_of_merit_only_widens_its_noise():
    log = pings_with({1: [0.3, 0, 0, 1, 0.05], 2: [0.3, 0, 0, 1, 0.001]})
    sds = [a.sd for _, a in found(assembled(log)[0], "dvl")]
    np.testing.assert_array_equal(sds[1], 0.05)
    np.testing.assert_array_equal(sds[2], Config().dvl.velocity_sd_mps)


def test_noise_that_grows_with_speed_is_added_to_that_of_a_ping():
    config = Config.model_validate({"dvl": {"scale_sd": 0.1}})
    sd = found(assembled(pings_with({}), config)[0], "dvl")[0][1].sd
    np.testing.assert_allclose(sd, np.hypot(0.01, 0.03))


def test_what_lies_outside_the_imus_record_is_left_out_and_counted():
    log = log_of(2.0, [0.5, 1.5, 2.05, 2.2], depth=scalar([1.0, 2.3]))
    imu = log["imu"]
    late = type(imu)("imu", imu.columns, imu.time + 0.3, imu.data, imu.row)
    shifted = Log("dive.csv", {**log.streams, "imu": late, "fix": early()})
    intervals, assembler = assembled(shifted)
    assert times(intervals)[0] == 0.3 and times(intervals)[-1] == 2.3
    assert assembler.left_out["fix", "before the first IMU sample"] == 1
    assert ("dvl", "before the first IMU sample") not in assembler.left_out
    short = Log("dive.csv", {**log.streams})
    intervals, assembler = assembled(short)
    assert times(intervals)[-1] == 2.0
    assert assembler.left_out["dvl", "after the last IMU sample"] == 2
    assert assembler.left_out["depth", "after the last IMU sample"] == 1


def early():
    fix = log_of(1.0, fix=(np.array([0.1]), np.array([[1.0, 2.0, np.nan]])))
    return fix["fix"]


def test_every_measurement_is_attached_thinned_or_counted():
    """None gets lost: what is attached and what is left out add up, where nothing is thinned."""
    rng = np.random.default_rng(0)
    pings = np.sort(rng.uniform(-0.5, 10.5, 60)).round(4)
    fixes = np.sort(rng.uniform(-0.5, 10.5, 40)).round(4)
    log = log_of(10.0, pings, fix=(fixes, np.tile([0.0, 0.0, np.nan], (40, 1))))
    intervals, assembler = assembled(log)
    attached = [(a.sensor, a.time) for i in intervals for a in i.measurements]
    assert len(attached) == len(set(attached))
    assert len(attached) + sum(assembler.left_out.values()) == 100
    assert all(a.time >= intervals[a.keyframe].time for i in intervals for a in i.measurements)


def test_sensors_that_are_not_in_use_are_ignored():
    config = Config()
    assembler = Assembler(config, {"dvl": instruments(config)["dvl"]}, np.zeros(6))
    intervals = [i for m in log_of(2.0, [0.5], depth=scalar([0.7])).measurements() for i in assembler.add(m)]
    assert not assembler.left_out
    assert [a.sensor for i in [*intervals, *assembler.finish()] for a in i.measurements] == ["dvl"]


def test_an_interval_is_given_once_the_imu_is_half_a_window_past_its_ping():
    config = Config()
    assembler = Assembler(config, instruments(config), np.zeros(6))
    done: list[tuple[float, float]] = []
    for m in log_of(1.0, [0.203, 0.6]).measurements():
        done += [(m.time, i.time) for i in assembler.add(m)]
    assert done == [(0.0, 0.0), (0.26, 0.203), (0.65, 0.6)]


def test_the_keyframe_of_a_gap_is_given_once_no_ping_is_due():
    config = Config()
    assembler = Assembler(config, instruments(config), np.zeros(6))
    done: list[tuple[float, float]] = []
    for m in log_of(3.0, [0.5]).measurements():
        done += [(m.time, i.time) for i in assembler.add(m)]
    assert done == [(0.0, 0.0), (0.55, 0.5), (1.81, 1.5), (2.81, 2.5)]


def test_an_imu_of_one_sample_makes_one_keyframe():
    log = log_of(0.0)
    intervals, _ = assembled(log)
    assert times(intervals) == [0.0]


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
    intervals, _ = assembled(log, started(dive, **sections))
    assert len(intervals) > 25


def test_places_of_a_whole_log_count_again_after_a_while_as_those_that_come_one_by_one():
    """`assembled` compares."""
    at = np.array([0.31, 0.32, 0.87, 1.49, 2.6, 2.6, 3.99])
    names = np.array([7.0, 7.0, 3.0, 7.0, 3.0, 7.0, 7.0])
    config = Config.model_validate({"place": {"every_s": 1.0}})
    places = at, np.column_stack([names, np.full(len(at), np.nan)])
    intervals, assembler = assembled(log_of(4.0, [0.5, 1.3, 1.31, 2.6], place=places), config)
    seen = [a.landmark for _, a in found(intervals, "place")]
    assert [(s.name, s.number) for s in seen if s is not None] == [(7, 1), (3, 2), (7, 3), (3, 4), (7, 5), (7, 6)]
    assert assembler.left_out["place", "still in view"] == 1


def test_a_log_at_the_time_of_a_clock_and_one_that_begins_with_pings_are_taken_alike():
    """`assembled` compares."""
    log = log_of(3.0, [-0.4, 0.0, 0.004, 1.1, 3.0, 3.2], depth=scalar([-0.1, 0.0, 1.1, 2.9, 3.0, 3.1]))
    _, assembler = assembled(log)
    assert assembler.left_out["dvl", "before the first IMU sample"] == 1
    later = {name: replace(stream, time=stream.time + 1.7e9) for name, stream in log.streams.items()}
    assembled(replace(log, streams=later))
