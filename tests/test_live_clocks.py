"""Clocks of sources: synchronised, differing, drifting, set, and stamps that cannot be."""

import numpy as np
import pytest

from rovgraph.errors import InputError
from rovgraph.live.clocks import Clocks
from rovgraph.live.message import Message, Reading

IMU, DVL = (Reading("imu", np.zeros(6)),), (Reading("dvl", np.zeros(5)),)


def imu(arrival: float, delay: float = 0.01, epoch: float = 0.0) -> Message:
    return Message("tcp://imu", arrival, arrival - delay - epoch, IMU)


def dvl(arrival: float, stamp: float | None) -> Message:
    return Message("tcp://dvl", arrival, stamp, DVL)


def begun(epoch: float = 0.0) -> Clocks:
    """The IMU's clock is known, with transports of 10 to 30 ms."""
    clocks, rng = Clocks(), np.random.default_rng(1)
    for k in range(500):
        clocks.time(imu(1000.0 + 0.01 * k, 0.01 + 0.02 * rng.random(), epoch))
    return clocks


def test_the_imus_stamps_are_the_time_of_the_estimator():
    assert begun(epoch=900.0).time(imu(1005.0, 0.02, 900.0)) == pytest.approx(104.98)


def test_a_late_ping_of_a_synchronised_clock_keeps_its_time_of_validity():
    clocks = begun()
    times = [clocks.time(dvl(1005.0 + 0.2 * k, 1005.0 + 0.2 * k - 0.2)) for k in range(100)]
    np.testing.assert_allclose(times, 1004.8 + 0.2 * np.arange(100), atol=1e-9)


def test_a_clock_that_counts_from_switching_on_is_shifted_to_the_imus_and_said():
    clocks, rng = begun(), np.random.default_rng(2)
    for k in range(100):
        true = 1005.0 + 0.2 * k
        time = clocks.time(dvl(true + 0.01 + 0.02 * rng.random(), true - 970.0))
    assert time == pytest.approx(true, abs=0.02)
    assert len(clocks.news) == 1 and "shifted" in clocks.news[0][1]


def test_a_source_without_a_clock_is_as_old_as_the_imus_newest():
    assert begun(epoch=900.0).time(dvl(1005.0, None)) == pytest.approx(104.99, abs=2e-3)


def test_clocks_that_drift_apart_over_a_day_are_kept_together():
    clocks, rate = begun(), 50e-6
    for k in range(0, 86400):
        clocks.time(imu(1005.0 + k, 0.01))
        true = 1005.0 + k
        time = clocks.time(dvl(true + 0.2, true + rate * k))
    assert rate * 86400 > 4.0
    assert time == pytest.approx(true, abs=0.01)


@pytest.mark.parametrize("stamp", [0.0, 4e9])
def test_a_single_stamp_from_1970_or_the_future_is_left_out(stamp):
    clocks = begun()
    assert clocks.time(dvl(1005.0, 1004.9)) is not None
    assert clocks.time(dvl(1005.2, stamp)) is None
    assert clocks.time(dvl(1005.4, 1005.3)) == pytest.approx(1005.3)
    assert clocks.odd == 1


@pytest.mark.parametrize("by", [-3600.0, 40.0])
def test_a_clock_that_was_set_goes_on_after_two_seconds(by):
    clocks = begun()
    for k in range(50):
        clocks.time(dvl(1005.0 + 0.2 * k, 1004.9 + 0.2 * k))
    times = [clocks.time(dvl(1015.0 + 0.2 * k, 1014.9 + 0.2 * k + by)) for k in range(50)]
    assert times[:10] == [None] * 10
    np.testing.assert_allclose([t for t in times if t is not None][-20:], 1014.9 + 0.2 * np.arange(30, 50), atol=1e-6)
    assert any("was set" in text for _, text in clocks.news)


def test_the_imus_own_clock_that_was_set_goes_on_too():
    clocks = begun()
    for k in range(400):
        time = clocks.time(Message("tcp://imu", 1005.0 + 0.01 * k, 1004.99 + 0.01 * k - 500.0, IMU))
    assert time == pytest.approx(1008.98, abs=1e-3)


def test_recorded_stamps_are_trusted():
    clocks = Clocks(trust=True)
    assert clocks.time(dvl(5.0, 123.0)) == 123.0


@pytest.mark.parametrize("boot", [0.3, 970.0])
def test_processing_that_an_instrument_states_never_becomes_a_stamp(boot):
    clocks, rng = begun(), np.random.default_rng(2)
    for k in range(100):
        true, processing = 1005.0 + 0.2 * k, 0.087 + 0.05 * rng.random()
        clocks.time(imu(true, 0.01))
        arrival = true + processing + 0.01 + 0.002 * rng.random()
        time = clocks.time(Message("waterlinked://dvl", arrival, true - boot, DVL, latency=processing))
    assert time == pytest.approx(true, abs=0.003)  # by the stamps alone it would be 0.09 s late


def test_recordings_of_different_epochs_are_put_together_by_their_arrivals_or_refused_with_both_named():
    clocks = Clocks(trust=True)
    assert clocks.time(Message("mavlink:a.tlog", 1.7e9, 100.0, IMU, "boot")) == 100.0
    assert clocks.time(Message("mavlink:a.tlog", 1.7e9 + 1.0, 1.7e9 + 1.0, DVL, "unix")) == pytest.approx(101.0)
    with pytest.raises(InputError, match=r"b\.csv: its clock reads 1900000000\.0 s where that of mavlink:a\.tlog boot"):
        clocks.time(Message("file:b.csv", 1.9e9, 1.9e9, DVL))


def depth(arrival: float, stamp: float) -> Message:
    return Message("tcp://dvl", arrival, stamp, (Reading("depth", np.zeros(1)),))


STUCK = {  # stamps of the DVL by its arrivals
    "one stamp": lambda arrival: 1004.0,
    "no clock": lambda arrival: 1.0,
    "the second stands still": lambda arrival: 1004.0 + arrival % 1.0,
}


@pytest.mark.parametrize("trust", [False, True], ids=["live", "replayed"])
@pytest.mark.parametrize("case", STUCK)
def test_stamps_that_stand_still_are_told_within_three_seconds_and_arrivals_take_over(case, trust):
    clocks, told, times = begun(), np.inf, {}
    clocks.trust = trust
    for arrival in np.arange(1005.0, 1015.0, 0.01).round(2).tolist():
        clocks.time(imu(arrival, 0.01))
        if round(100 * arrival) % 20 == 0:
            times[arrival] = clocks.time(dvl(arrival, STUCK[case](arrival)))
        if any("the stamps of dvl stand still" in text for _, text in clocks.news):
            told = min(told, arrival)
    assert told - 1005.0 < 3.0
    late = np.array([arrival - time for arrival, time in times.items() if arrival > told])
    np.testing.assert_allclose(late, 0.01, atol=0.005)
    assert sum("stand still" in text for _, text in clocks.news) == 1


def test_one_sensor_of_a_source_may_stand_still_beside_others():
    clocks = begun()
    for k in range(50):
        clocks.time(imu(1005.0 + 0.2 * k))
        assert clocks.time(depth(1005.0 + 0.2 * k, 1004.9 + 0.2 * k)) == pytest.approx(1004.9 + 0.2 * k)
        clocks.time(dvl(1005.0 + 0.2 * k, 1004.0))
    assert [text for _, text in clocks.news] == ["the stamps of dvl stand still at 1004 s; times of arrival are used"]


def test_stamps_that_move_on_are_used_again():
    clocks = begun()
    for k in range(50):
        clocks.time(dvl(1005.0 + 0.2 * k, 1004.9))
    times = [clocks.time(dvl(1015.0 + 0.2 * k, 1014.9 + 0.2 * k)) for k in range(50)]
    assert any("move on, and are used again" in text for _, text in clocks.news)
    assert times[-1] == pytest.approx(1014.9 + 0.2 * 49)


@pytest.mark.parametrize("sensor", ["imu", "dvl"])
@pytest.mark.parametrize("wrap", [65.536, 4294.967296, 86400.0, 604800.0])
def test_a_counter_that_wraps_goes_on_at_once_and_a_late_message_stays_before_it(sensor, wrap):
    clocks, make = Clocks(), imu if sensor == "imu" else dvl
    epoch = 1010.0 - wrap  # the counter is full at 1010 s
    times = []
    for k in range(200):
        arrival, true = 1005.0 + 0.1 * k, 1004.99 + 0.1 * k - (0.3 if k == 51 else 0.0)
        stamp = (true - epoch) % wrap
        if sensor == "dvl":
            clocks.time(imu(arrival))
            times.append(clocks.time(dvl(arrival, stamp)))
        else:
            times.append(clocks.time(make(arrival)._replace(stamp=stamp)))
    steps = np.diff(np.delete(np.array(times, dtype=float), 51))
    np.testing.assert_allclose(np.delete(steps, 50), 0.1, atol=0.02)
    assert times[51] == pytest.approx(times[50] - 0.2, abs=0.02)
    assert sum("wrap; time goes on" in text for _, text in clocks.news) == 1
