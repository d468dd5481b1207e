"""Sensors that fail while they go on talking, or fall silent: found, said once, and their return too."""

import numpy as np
import pytest

from rovgraph.live.sensor_faults import WAIT, Faults, Screening
from rovgraph.log import Measurement
from rovgraph.log.frozen import HOLDS, TURNED

RNG = np.random.default_rng(5)


def ping(time: float, *velocity: float, valid: float = 1.0) -> Measurement:
    return Measurement(time, "dvl", np.array([*velocity, valid, np.nan]), 0)


def moving(time: float) -> Measurement:
    return ping(time, *(np.array([0.4, 0.05, 0.0]) + 0.01 * RNG.standard_normal(3)))


def sample(time: float, rate: float = 0.0) -> Measurement:
    return Measurement(time, "imu", np.array([0, 0, -9.8, 0, 0, rate]) + 0.01 * RNG.standard_normal(6), 0)


def heading(time: float, yaw: float) -> Measurement:
    return Measurement(time, "ahrs", np.array([yaw, np.nan, np.nan]), 0)


def kinds(faults: Faults) -> list[str]:
    return [event.kind for event in faults.events]


def test_zeros_of_a_dvl_that_moved_a_moment_ago_are_left_out_until_it_measures_again():
    faults = Faults()
    assert all(faults.look(moving(0.2 * k)).use for k in range(20))
    assert not any(faults.look(ping(4.0 + 0.2 * k, 0.0, 0.0, 0.0)).use for k in range(100))
    assert faults.look(moving(24.0)).use
    assert kinds(faults) == ["no lock", "back"]


def test_zeros_of_a_vehicle_that_stands_still_are_used():
    faults = Faults()
    assert all(faults.look(ping(0.2 * k, 0.0, 0.0, 0.0)).use for k in range(50))
    assert faults.events == []


def test_single_zeros_among_pings_at_speed_are_left_out_and_told_once():
    faults = Faults()
    for k in range(300):
        verdict = faults.look(ping(0.2 * k, 0.0, 0.0, 0.0) if k % 7 == 6 else moving(0.2 * k))
        assert verdict.use == (k % 7 != 6)
        assert verdict.reason == ("" if verdict.use else "exactly zero")
    assert kinds(faults) == ["no lock"]
    assert "again and again" in faults.events[0].text


@pytest.mark.parametrize(("apart", "used"), [(0.37, False), (1.2, False), (1.4, True)])
def test_a_zero_is_used_where_the_vehicle_can_have_stopped(apart, used):
    """A DVL whose pings show noise measures exact zeros at rest seldom, so 0.3 m/s^2 counts, as in a log."""
    faults = Faults()
    for k in range(40):
        faults.look(moving(0.2 * k))  # 0.4 m/s
    assert faults.look(ping(7.8 + apart, 0.0, 0.0, 0.0)).use == used


def test_a_vehicle_that_slows_down_may_come_to_rest_at_zero():
    faults = Faults()
    speeds = [*[0.4] * 30, *np.linspace(0.4, 0.0, 9).tolist(), *[0.0] * 50]
    for k, speed in enumerate(speeds):
        v = [speed, 0.002 * (-1) ** k, 0.0] if speed else [0.0, 0.0, 0.0]
        assert faults.look(ping(0.2 * k, *v)).use
    assert faults.events == []


def test_zeros_of_a_dvl_whose_resolution_hides_its_noise_are_left_to_the_filter():
    faults = Faults()
    for k in range(40):
        assert faults.look(ping(0.2 * k, 0.4, 0.01 * (k % 2), 0.0)).use
    assert faults.look(ping(8.0, 0.0, 0.0, 0.0)).use


@pytest.mark.parametrize("sensor", ["depth", "ahrs", "fix"])
def test_exact_zeros_far_from_what_was_measured_are_left_out(sensor):
    faults, values = Faults(), {"depth": 1, "ahrs": 3, "fix": 3}[sensor]
    for k in range(60):
        away = (2.0 if sensor != "fix" else 40.0) + 0.01 * RNG.standard_normal()
        zero = k in (30, 40) or 50 <= k < 58
        m = Measurement(0.5 * k, sensor, np.full(values, 0.0 if zero else away), 0)
        assert faults.look(m).use != zero
    assert kinds(faults) == ["frozen", "back"]  # of those that last


def test_a_lost_bottom_lock_is_said_once():
    faults = Faults()
    faults.look(moving(0.0))
    assert not any(faults.look(ping(0.2 * k, np.nan, np.nan, np.nan, valid=0.0)).use for k in range(1, 20))
    assert kinds(faults) == ["no lock"]


def looked(faults: Faults, m: Measurement) -> Screening:
    """A measurement after the samples of an IMU that works, until then."""
    for k in range(10):
        faults.look(sample(m.time - 0.2 + 0.02 * k))
    return faults.look(m)


def equal_pings(count: int, before: int = 20) -> tuple[list[Screening], Faults]:
    """What is done with equal pings, one every 0.2 s, after others."""
    faults = Faults()
    for k in range(before):
        looked(faults, moving(0.2 * (k - before)))
    return [looked(faults, ping(0.2 * k, 0.41, 0.05, 0.01)) for k in range(count)], faults


def test_equal_pings_wait_and_are_taken_back_from_the_first_when_they_last_as_long_as_in_a_log():
    longest = round(HOLDS["dvl"].seconds / 0.2)
    verdicts, faults = equal_pings(longest + 5)
    assert [v.use for v in verdicts] == [True] * (WAIT["dvl"] - 1) + [False] * (longest + 6 - WAIT["dvl"])
    assert [(k, v.retract_since) for k, v in enumerate(verdicts) if v.retract_since is not None] == [(2, 0.0)]
    assert sum(v.count for v in verdicts if not v.use) == longest + 5
    assert looked(faults, moving(4.0)) == Screening()
    assert kinds(faults) == ["frozen", "back"]


def test_equal_pings_that_do_not_last_as_long_are_used_after_all():
    verdicts, faults = equal_pings(10)
    after = looked(faults, moving(2.0))
    assert after.use and [m.time for m in after.late] == pytest.approx([0.2 * k for k in range(10)])
    assert not any(v.count for v in verdicts if not v.use) and faults.events == []


def test_a_dvl_whose_values_a_driver_repeats_is_used():
    faults = Faults()
    for k in range(200):
        if k % 5 == 0:
            newest = moving(0.0)
        assert looked(faults, newest._replace(time=0.2 * k)).use or k < 10
    assert faults.events == []


def depth(time: float, metres: float) -> Measurement:
    return Measurement(time, "depth", np.array([metres]), 0)


def depths_used(values: list[float], rate: float = 5.0) -> tuple[list[bool], Faults]:
    """Which depths are used, beside an IMU that works."""
    faults, used = Faults(), []
    for k, metres in enumerate(values):
        faults.look(sample(k / rate))
        verdict = faults.look(depth(k / rate, metres))
        used.append(verdict.use)
        if verdict.retract_since is not None:
            first = round(verdict.retract_since * rate)
            used[first:] = [False] * (k + 1 - first)
    return used, faults


def test_a_depth_that_loses_its_noise_is_left_out_from_its_first_repetition():
    live = (5.0 + 0.02 * RNG.standard_normal(50)).tolist()
    used, faults = depths_used([*live, *[5.0] * 50, *live])
    assert used == [True] * 50 + [False] * 50 + [True] * 50
    assert kinds(faults) == ["frozen", "back"]


def test_a_coarse_depth_may_stand_still():
    coarse = np.round(np.linspace(5.0, 6.0, 60), 1)  # each value is held for a second
    used, faults = depths_used([*coarse.tolist(), *[6.0] * 100])
    assert all(used) and faults.events == []


@pytest.mark.parametrize(("step", "rate", "speed"), [(0.1, 1.0, 0.5), (0.05, 4.0, 0.4), (0.01, 5.0, 0.3)])
def test_a_coarse_depth_may_stand_still_after_a_dive_in_which_it_never_repeated(step, rate, speed):
    at = np.arange(0.0, 145.0, 1.0 / rate)
    true = speed * np.minimum(at, 25.0) + 0.003 * RNG.standard_normal(len(at))
    used, faults = depths_used((step * np.round(true / step)).tolist(), rate)
    assert all(used) and faults.events == []


def test_a_depth_that_was_stuck_before_a_crash_is_left_out_after_it():
    _, before = depths_used([*(5.0 + 0.02 * RNG.standard_normal(50)).tolist(), *[5.0] * 50])
    after = Faults()
    after.restore(before.state())
    after.look(sample(20.0))
    assert not after.look(depth(20.0, 5.0)).use and after.look(depth(20.2, 5.01)).use
    assert kinds(after) == ["frozen", "back"]


def test_a_depth_that_says_nothing_is_not_frozen():
    used, faults = depths_used([*(5.0 + 0.02 * RNG.standard_normal(50)).tolist(), *[np.nan] * 50])
    assert all(used) and faults.events == []


@pytest.mark.parametrize(("part", "frozen"), [(0.95, False), (1.05, True)])
@pytest.mark.parametrize("bias", [0.0, 0.05])
def test_a_compass_that_stands_still_while_the_vehicle_turns_is_frozen_by_the_limit_of_a_log(part, frozen, bias):
    faults, used = Faults(), []
    for k in range(2800):  # it stands still for 8 s, and the vehicle turns in the first two of them
        turns, still = 2000 <= k < 2200, k >= 2000
        faults.look(sample(0.01 * k, bias + 0.5 * part * TURNED * turns))
        if k % 10 == 0:
            used.append(faults.look(heading(0.01 * k, 1.0 + 0.01 * RNG.standard_normal() * (not still))).use)
    assert all(used[:230]) and used[-1] != frozen
    assert kinds(faults) == ["frozen"] * frozen


def test_a_coarse_compass_of_a_vehicle_that_does_not_turn_is_not_frozen():
    faults = Faults()
    for k in range(1000):
        faults.look(sample(0.01 * k))
        assert faults.look(heading(0.01 * k, 1.0)).use


def test_a_fix_that_is_repeated_while_the_dvl_moves_is_used_once():
    faults, verdicts = Faults(), []
    for k in range(150):
        looked(faults, moving(0.2 * k))
        if k % 5 == 0:
            verdicts.append(faults.look(Measurement(0.2 * k, "fix", np.array([1.0, 2.0, np.nan]), 0)))
    assert not verdicts[-1].use
    (since,) = [v.retract_since for v in verdicts if v.retract_since is not None]
    assert 0.0 < since < 1.0
    assert kinds(faults) == ["frozen"]


def test_a_frozen_imu_waits_and_is_taken_back_after_a_second():
    faults = Faults()
    faults.look(sample(0.0))
    stuck = sample(0.01)
    verdicts = [faults.look(stuck._replace(time=0.01 * k)) for k in range(1, 150)]
    assert [v.use for v in verdicts] == [True] * (WAIT["imu"] - 1) + [False] * (150 - WAIT["imu"])
    (known,) = [k for k, v in enumerate(verdicts) if v.count > 1]
    assert known * 0.01 == pytest.approx(HOLDS["imu"].seconds) and verdicts[known].count == known + 1


@pytest.mark.parametrize(("period", "longest"), [(0.2, 3.0), (1.0, 10.0)])
def test_a_sensor_is_silent_after_three_seconds_or_ten_of_its_periods(period, longest):
    faults = Faults()
    for k in range(20):
        faults.look(moving(period * k))
    newest = 19 * period
    faults.tick(newest + longest - 0.1)
    assert kinds(faults) == []
    faults.tick(newest + longest + 0.1)
    assert kinds(faults) == ["silent"]


def test_silence_is_said_once_and_so_is_the_return():
    faults = Faults()
    for k in range(20):
        faults.look(moving(0.2 * k))
    for time in (5.0, 6.0, 8.0, 9.0):
        faults.tick(time)
    assert kinds(faults) == ["silent"]
    faults.look(moving(9.5))
    assert kinds(faults) == ["silent", "back"]


def fix(time: float) -> Measurement:
    return Measurement(time, "fix", np.array([1.0, 2.0, 0.5]), 0)


def test_fixes_given_by_hand_are_not_missed():
    faults = Faults()
    for time in (0.0, 2.0, 4.0):
        assert faults.accept(fix(time)).use
    faults.tick(100.0)
    assert faults.watches["fix"].time == 4.0 and faults.watches["fix"].state == "ok" and faults.events == []
    for time in (100.0, 101.0):
        faults.look(fix(time))
    faults.accept(fix(110.0))
    faults.tick(112.0)
    assert kinds(faults) == ["silent"]


@pytest.mark.parametrize(("measurement", "longest"), [(moving, 10.0), (fix, 30.0)])
def test_a_sensor_that_spoke_once_is_silent_after_ten_seconds_and_a_position_after_thirty(measurement, longest):
    faults = Faults()
    faults.look(measurement(0.0))
    faults.tick(longest - 0.1)
    assert kinds(faults) == []
    faults.tick(longest + 0.1)
    assert kinds(faults) == ["silent"]
