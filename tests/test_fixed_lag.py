"""The live filter: one estimate whatever the order of arrival, late data where they belong, re-initialisation."""

import threading
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from dives import RecordingFilter, Simulated, falcon, fed, simulated

from rovgraph.errors import InputError
from rovgraph.inference.filter_step import Gaussian
from rovgraph.inference.fixed_lag import FilterSnapshot, FixedLag
from rovgraph.inference.initialise import initialise
from rovgraph.live import reinitialisations
from rovgraph.live.files import read_checkpoint, write_checkpoint
from rovgraph.live.reinitialisations import Reinitialisations
from rovgraph.log import Measurement
from rovgraph.problem.assembly import InsertResult
from rovgraph.problem.initial_conditions import InitialConditions

LAG, HOLD = 5.0, 0.3


@pytest.fixture(scope="module")
def case() -> Simulated:
    return simulated(falcon(), 40.0, seed=6, dvl_rate=3.0)


@pytest.fixture(scope="module")
def initial(case) -> InitialConditions:
    return initialise(case.log, case.config)


@pytest.fixture(scope="module")
def measurements(case) -> list[Measurement]:
    return list(case.log.measurements())


@pytest.fixture(scope="module")
def reference(case, initial) -> RecordingFilter:
    return fed(RecordingFilter(initial), case.log)


def live(
    initial: InitialConditions, measurements: list[Measurement], hold: float = HOLD
) -> tuple[FixedLag, list[Gaussian]]:
    """The filter after all measurements, and its estimate of every keyframe."""
    known: list[Gaussian] = []
    engine = FixedLag(initial, LAG, hold, passed=lambda snapshot: known.append(snapshot.known))
    for measurement in measurements:
        engine.add(measurement)
    engine.finish()
    return engine, known


def same(known: list[Gaussian], others: list[Gaussian], atol: float, rtol: float = 1e-6) -> None:
    assert len(known) == len(others)
    for a, b in zip(known, others, strict=True):
        np.testing.assert_allclose(a.state.p_n, b.state.p_n, atol=atol)
        np.testing.assert_allclose(a.state.R_nb, b.state.R_nb, atol=atol)
        np.testing.assert_allclose(a.P, b.P, rtol=rtol, atol=1e-9)


def shuffled(measurements: list[Measurement], within: float, seed: int = 3) -> list[Measurement]:
    rng = np.random.default_rng(seed)
    arrival = [m.time + rng.uniform(0.0, within) for m in measurements]
    return [measurements[k] for k in np.argsort(arrival)]


def test_in_order_it_is_the_filter_of_a_recorded_dive(initial, measurements, reference):
    same(live(initial, measurements)[1], reference.filtered, 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("hold", [HOLD, 0.0])
def test_the_order_of_arrival_within_300_ms_changes_nothing(initial, measurements, reference, hold):
    first, rest = measurements[:50], measurements[50:]
    same(live(initial, first + shuffled(rest, 0.3), hold)[1], reference.filtered, 1e-9)


@pytest.mark.slow
def test_pings_about_as_far_apart_as_keyframes_may_be_make_the_same_keyframes_in_any_order():
    case = simulated(falcon(), 40.0, seed=6, dvl_rate=1.0, dvl_jitter=0.4)
    measurements, initial = list(case.log.measurements()), initialise(case.log, case.config)
    reference = fed(RecordingFilter(initial), case.log)
    first, rest = measurements[:50], measurements[50:]
    same(live(initial, first + shuffled(rest, 2.0), 0.1)[1], reference.filtered, 1e-9)


def test_a_ping_three_seconds_late_is_used_at_its_own_time(initial, measurements, reference):
    k = next(k for k, m in enumerate(measurements) if m.sensor == "dvl" and m.time > 20.0)
    late = next(j for j, m in enumerate(measurements) if m.time > measurements[k].time + 3.0)
    order = measurements[:k] + measurements[k + 1 : late] + [measurements[k]] + measurements[late:]
    same(live(initial, order)[1], reference.filtered, 1e-9)


def test_pings_that_are_found_to_be_late_are_put_where_they_belong_from_then_on():
    """As the filter of a recorded dive does it, so nothing but the IMU's last tenth of a second lies between."""
    offset = {"dvl_time_offset": np.array([0.1])}
    config = falcon(calibration={"dvl_time_offset": {"estimate": True, "sd": 0.1}})
    case = simulated(config, 40.0, seed=6, dvl_rate=3.0, calibration=offset)
    initial = initialise(case.log, case.config)
    engine, known = live(initial, list(case.log.measurements()))
    recorded = fed(RecordingFilter(initial), case.log)
    same(known, recorded.filtered, 1e-12)
    assert engine.assembly.time_offsets.off(known[-1].state.calibration) < 0.02
    assert abs(known[-1].state.calibration["dvl_time_offset"][0] - 0.1) < 0.02


def test_what_is_later_than_the_lag_or_repeated_is_left_out_and_said(initial, measurements):
    engine = FixedLag(initial, LAG, HOLD)
    cut = next(k for k, m in enumerate(measurements) if m.time > 15.0)
    assert {engine.add(m) for m in measurements[:cut]} == {InsertResult.IN}
    ping = next(m for m in measurements if m.sensor == "dvl" and m.time > 5.0)
    recent = next(m for m in measurements if m.sensor == "dvl" and m.time > 13.0)
    assert engine.add(ping) == InsertResult.LATE
    assert engine.add(recent) == InsertResult.AGAIN


def test_retracted_pings_leave_no_trace(case, initial, measurements):
    gone = [m for m in measurements if m.sensor == "dvl" and 28.0 < m.time < 30.0]
    engine = FixedLag(initial, LAG, HOLD)
    cut = next(k for k, m in enumerate(measurements) if m.time > 30.0)
    for m in measurements[:cut]:
        engine.add(m)
    engine.retract("dvl", 28.0)
    never = FixedLag(initial, LAG, HOLD)
    for m in measurements[:cut]:
        if not any(m is g for g in gone):
            never.add(m)
    same([engine.snapshots[-1].known], [never.snapshots[-1].known], 1e-9)


def test_prediction_ahead_grows_uncertain_and_beyond_the_imu_more_so(initial, measurements):
    engine = FixedLag(initial, LAG, HOLD)
    for m in measurements[:2500]:
        engine.add(m)
    newest_keyframe = engine.snapshots[-1]
    newest = max(m.time for m in measurements[:2500] if m.sensor == "imu")
    sd = [np.sqrt(np.diag(engine.ahead(t)[1].P)[6:9]).max() for t in (newest_keyframe.time, newest, newest + 3.0)]
    assert sd[0] < sd[1] < 0.1 * sd[2]


def test_restored_from_its_state_it_goes_on_as_if_nothing_had_happened(tmp_path, initial, measurements, reference):
    cut = 2500
    before = FixedLag(initial, LAG, HOLD)
    for m in measurements[:cut]:
        before.add(m)
    write_checkpoint(tmp_path / "state", before.state())
    known: list[Gaussian] = []
    after = FixedLag(initial, LAG, HOLD, passed=lambda snapshot: known.append(snapshot.known))
    after.restore(read_checkpoint(tmp_path / "state"))
    for t in (before.snapshots[-1].time, measurements[cut - 1].time):
        np.testing.assert_allclose(after.ahead(t)[1].P, before.ahead(t)[1].P, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(after.ahead(t)[1].state.p_n, before.ahead(t)[1].state.p_n, atol=1e-9)
    for m in measurements[cut:]:
        after.add(m)
    after.finish()
    same(known[-20:], reference.filtered[-20:], 1e-9)


def test_memory_does_not_grow(initial, measurements):
    engine, sizes = FixedLag(initial, LAG, HOLD), []
    for k, m in enumerate(measurements):
        engine.add(m)
        if k in (len(measurements) // 2, len(measurements) - 1):
            sizes.append((len(engine.snapshots), len(engine.assembly)))
    assert sizes[1][0] <= sizes[0][0] + 2
    assert sizes[1][1] <= 2 * sizes[0][1] + 100


DUE = 15.0  # for a re-initialisation [s]


@pytest.fixture
def once(monkeypatch) -> None:
    monkeypatch.setattr(reinitialisations, "REINITIALISE_AT_S", (DUE,))


def reinitialised(
    initial: InitialConditions,
    measurements: list[Measurement],
    thread: Reinitialisations,
    lag: float = LAG,
    at: Callable[[float], None] = lambda time: None,
) -> list[Gaussian]:
    """Every keyframe; ``at`` is called with the time since the start at each of them."""
    known: list[Gaussian] = []

    def passed(snapshot: FilterSnapshot) -> None:
        known.append(snapshot.known)
        thread.take(snapshot)

    engine, newest = FixedLag(initial, lag, HOLD, passed=passed, keeps_all=True), -1
    for measurement in measurements:
        engine.add(measurement)
        if engine.snapshots and engine.snapshots[-1].index > newest:
            newest = engine.snapshots[-1].index
            at(engine.snapshots[-1].time - measurements[0].time)
            thread.step(engine, False, None, "trusted")
    engine.finish()
    thread.close()
    return known


@pytest.mark.parametrize("lag", [LAG, 20.0])
def test_a_reinitialisation_in_the_thread_makes_it_the_reinitialised_filter(once, case, initial, measurements, lag):
    """From the keyframe at which it was due, with those since taken again."""
    recorded = fed(RecordingFilter(initial, (DUE,)), case.log)
    thread = Reinitialisations(patient=True)
    known = reinitialised(initial, measurements, thread, lag)
    assert not thread.news
    same(known[-20:], recorded.filtered[-20:], 1e-5, rtol=1e-2)  # of two optima, each within its tolerance


def test_keyframes_that_no_reinitialisation_needs_are_freed(once, initial, measurements):
    """A few at a time."""
    thread, kept = Reinitialisations(patient=True), list[int]()
    reinitialised(initial, measurements, thread, at=lambda time: kept.append(len(thread._passed)))
    assert max(kept) > reinitialisations.FREED and kept[-1] == 0
    assert max(before - after for before, after in pairwise(kept)) == reinitialisations.FREED


def test_nothing_is_kept_of_a_dive_that_ends_before_its_last_reinitialisation(initial, measurements):
    thread = Reinitialisations(patient=True)
    reinitialised(initial, measurements, thread)
    assert not thread._passed


def test_a_reinitialisation_that_takes_longer_than_the_lag_makes_it_the_same(
    once, monkeypatch, case, initial, measurements
):
    recorded = fed(RecordingFilter(initial, (DUE,)), case.log)
    thread, smooth, released = Reinitialisations(patient=False), reinitialisations._smoothed, threading.Event()

    def slow(*arguments):
        released.wait()
        return smooth(*arguments)

    def release(time: float) -> None:
        if time > DUE + 2.0 * LAG:
            released.set()
            thread.patient = True

    monkeypatch.setattr(reinitialisations, "_smoothed", slow)
    known = reinitialised(initial, measurements, thread, at=release)
    assert not thread.news
    same(known[-20:], recorded.filtered[-20:], 1e-5, rtol=1e-2)


def test_a_reinitialisation_that_fails_is_said_once_and_leaves_the_filter_as_it_is(
    once, monkeypatch, initial, measurements, reference
):
    def fails(*arguments):
        raise InputError("the data do not determine pose of keyframe 3")

    monkeypatch.setattr(reinitialisations, "_smoothed", fails)
    thread = Reinitialisations(patient=True)
    same(reinitialised(initial, measurements, thread), reference.filtered, 1e-12)
    [text] = thread.news
    assert "pose of keyframe 3" in text
