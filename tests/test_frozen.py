"""Measurements that a sensor repeats although the vehicle moves are found and left out."""

import numpy as np
import pytest
from dives import Simulated, altered, falcon, kept, position_errors, rms, simulated

from rovgraph.diagnosis.check import examine
from rovgraph.dive import smooth
from rovgraph.geometry import Array
from rovgraph.live.sensor_faults import Faults
from rovgraph.log import STREAMS, Log, Stream
from rovgraph.log.frozen import (
    BRAKING,
    CLEAR_SPEED,
    HOLDS,
    STOPPING,
    are_in,
    companies,
    equal_runs,
    false_values,
    frozen_stretches,
    without_frozen,
)
from rovgraph.model.config import Config
from rovgraph.simulate import CALM, Style

FROM, TO = 60.0, 120.0
STEADY = Style(waves=CALM)


@pytest.fixture(scope="module")
def case() -> Simulated:
    return simulated(falcon(), 200.0, seed=3, ahrs_rate=10.0)


def during(log: Log, sensor: str) -> Array:
    time = log[sensor].time
    return (time >= FROM) & (time <= TO)


def held(log: Log, sensor: str) -> Log:
    """A log in which a sensor repeats its last value for a minute."""
    data, now = log[sensor].data.copy(), during(log, sensor)
    data[now, :3] = data[np.flatnonzero(now)[0] - 1, :3]
    return altered(log, sensor, data)


@pytest.mark.parametrize("sensor", ["dvl", "mag", "dvl_heading", "ahrs", "depth"])
def test_a_value_held_for_a_minute_is_frozen_and_no_other_is(case, sensor):
    (found,) = frozen_stretches(held(case.log, sensor), case.config)
    assert (found.sensor, found.kind) == (sensor, "held")
    assert found.first == pytest.approx(FROM, abs=0.5)
    assert found.last == pytest.approx(TO, abs=0.5)
    assert frozen_stretches(case.log, case.config) == []


@pytest.mark.parametrize("sensor", ["dvl", "mag"])
@pytest.mark.parametrize("beyond", [False, True])
def test_values_are_held_from_the_limit_of_seconds_on(case, sensor, beyond):
    time, data = case.log[sensor].time, case.log[sensor].data.copy()
    first, half = int(np.searchsorted(time, FROM)), 0.5 * float(np.median(np.diff(time)))
    limit = time[first] + HOLDS[sensor].seconds
    last = np.searchsorted(time, limit + half) if beyond else np.searchsorted(time, limit - half) - 1
    data[first : last + 1, :3] = data[first, :3]
    found = [f for f in frozen_stretches(altered(case.log, sensor, data), case.config) if f.kind == "held"]
    assert [len(f.time) for f in found] == [last + 1 - first] * beyond


def left_out_live(log: Log, config: Config) -> dict[str, list[float]]:
    """Times of what is left out, or taken back, as the measurements of a log come."""
    faults, out = Faults(config), {}
    for m in log.measurements():
        verdict, own = faults.look(m), out.setdefault(m.sensor, {})
        own.update({late.time: True for late in verdict.late})
        own[m.time] = verdict.use
        if verdict.retract_since is not None:
            own.update({time: False for time in own if time >= verdict.retract_since})
    return {sensor: [time for time, use in own.items() if not use] for sensor, own in out.items()}


@pytest.mark.parametrize("sensor", ["dvl", "mag", "dvl_heading", "ahrs", "depth"])
def test_what_is_frozen_in_a_log_is_left_out_as_it_comes_and_no_more(case, sensor):
    log = held(case.log, sensor)
    left_out = left_out_live(log, case.config)
    (found,) = frozen_stretches(log, case.config)
    assert left_out.pop(sensor) == found.time.tolist()
    assert not any(left_out.values())


def test_without_frozen_leaves_out_the_stretch_alone(case):
    log, (found,) = without_frozen(held(case.log, "dvl"), case.config)
    assert len(log["dvl"]) == len(case.log["dvl"]) - len(found.time)
    assert not ((log["dvl"].time >= found.first) & (log["dvl"].time <= found.last)).any()
    assert without_frozen(case.log, case.config)[0] is case.log


def test_values_that_a_recorder_writes_several_times_are_not_frozen(case):
    data = case.log["dvl"].data.copy()
    data[:, :3] = np.repeat(data[::25, :3], 25, axis=0)[: len(data)]
    assert frozen_stretches(altered(case.log, "dvl", data), case.config) == []


def test_a_depth_of_coarse_resolution_is_frozen_only_where_the_dvl_moves_up_or_down(case):
    coarse = altered(case.log, "depth", np.round(case.log["depth"].data))
    assert max(equal_runs(coarse["depth"].data) @ [-1, 1]) > 100
    assert frozen_stretches(coarse, case.config) == []


def test_a_vehicle_whose_imu_never_changes_holds_its_values():
    """A simulation without noise, on a straight course."""
    case = simulated(falcon(), 100.0, path="straight", noise=False, style=STEADY)
    assert frozen_stretches(case.log, Config()) == []


def test_a_frozen_dvl_costs_no_more_than_one_that_is_silent(case):
    """Its last value, believed for a minute, took the track 18 m away at an sd of 0.3 m."""
    frozen, silent = held(case.log, "dvl"), kept(case.log, "dvl", ~during(case.log, "dvl"))
    dive, best = smooth(frozen, case.config), smooth(silent, case.config)
    assert dive.left_out["dvl", "frozen"] == (~during(frozen, "dvl")).size - len(silent["dvl"]) + 1
    for estimate, other in zip(dive.estimates[:2], best.estimates[:2], strict=True):
        error, least = position_errors(estimate.trajectory, case), position_errors(other.trajectory, case)
        assert rms(error) < 1.5 * rms(least) + 0.02
        assert (error < 4.0 * np.linalg.norm(estimate.trajectory.p_sd, axis=1) + 0.05).all()


# --- single ones, by the company they keep ------------------------------------------------------------


def spoilt(log: Log, share: float, factor: float | None, sensor: str = "dvl", seed: int = 2) -> tuple[Log, Array]:
    """A log in which some measurements are a part of what they were, or (None) the one before; and which."""
    data = log[sensor].data.copy()
    bad = np.random.default_rng(seed).random(len(data)) < share
    bad[0] = False
    for k in np.flatnonzero(bad):
        data[k, :3] = data[k - 1, :3] if factor is None else factor * data[k, :3]
    return altered(log, sensor, data), bad


def no_imu(log: Log) -> Log:
    """The same without an IMU: none of this needs another sensor."""
    return Log(log.source, {"dvl": log["dvl"]}, log.origin)


@pytest.mark.parametrize("share", [0.01, 0.15, 0.3, 0.5])
@pytest.mark.parametrize("prepare", [lambda log: log, no_imu], ids=["with an IMU", "without"])
def test_single_zeros_between_pings_at_speed_are_none(case, share, prepare):
    log, bad = spoilt(prepare(case.log), share, 0.0)
    found = false_values(log, case.config)
    assert {(f.sensor, f.kind) for f in found} == {("dvl", "zero")}
    none, speed = are_in(log["dvl"], found), np.linalg.norm(case.log["dvl"].data[:, :3], axis=1)
    assert not none[~bad].any()
    assert none[bad & (speed > 0.2)].mean() > 0.97
    assert {f.reason for f in found} == {"exactly zero"}


@pytest.mark.parametrize(
    "share",
    [pytest.param(0.02, marks=pytest.mark.xfail(strict=True, reason="so few are taken for manoeuvres")), 0.2, 0.3],
)
def test_pings_at_half_the_speed_of_those_around_them_are_none(case, share):
    log, bad = spoilt(case.log, share, 0.5)
    (found,) = frozen_stretches(log, case.config)
    none, speed = are_in(log["dvl"], [found]), np.linalg.norm(case.log["dvl"].data[:, :3], axis=1)
    assert (found.kind, found.single, found.reason) == ("half", True, "half the speed")
    assert not none[~bad].any()
    assert none[bad & (speed > 0.3)].mean() > 0.8


def test_pings_that_repeat_the_one_before_are_none(case):
    log, bad = spoilt(case.log, 0.2, None)
    (found,) = frozen_stretches(log, case.config)
    assert (found.kind, found.single) == ("repeated", True)
    np.testing.assert_array_equal(are_in(log["dvl"], [found]), bad)


def test_what_is_none_is_left_out_and_counted_and_costs_no_more_than_silence(case):
    log, bad = spoilt(case.log, 0.3, 0.0)
    dive = smooth(log, case.config, "smoothed")
    count = dive.left_out["dvl", "exactly zero"]
    assert count == are_in(log["dvl"], dive.frozen).sum()
    (said,) = [f for f in examine(log, case.config).at("warning") if f.sensor == "dvl"]
    assert said.text.startswith("exactly zero now and then from ") and "dvl_valid 0" in said.text
    assert f"{count} of {len(bad)} measurements" in said.text
    assert said.share == pytest.approx(count / len(bad))
    best = smooth(kept(case.log, "dvl", ~bad), case.config, "smoothed")
    error, least = (position_errors(one.estimates[0].trajectory, case) for one in (dive, best))
    assert rms(error) < 1.5 * rms(least) + 0.02
    assert [(alarm.kind, alarm.sensor) for alarm in dive.alarms] == [("left out", "dvl")]


def pings(velocity: Array, rate: float) -> Log:
    """A log of a DVL alone; ``velocity`` of shape (n, 3)."""
    time = np.arange(len(velocity)) / rate
    data = np.column_stack([velocity, np.ones(len(time)), np.full(len(time), np.nan)])
    return Log("dive.csv", {"dvl": Stream("dvl", STREAMS["dvl"], time, data, np.arange(len(time)) + 2)})


def ahead(speed: Array, noise: float = 0.0, step: float = 0.0) -> Array:
    """Velocities forward with white noise, rounded to some resolution, shape (n, 3)."""
    v = speed[:, None] * [1.0, 0.0, 0.0] + noise * np.random.default_rng(5).standard_normal((len(speed), 3))
    return np.round(v / step) * step if step else v


def zeros_found(velocity: Array, rate: float) -> int:
    return sum(len(f.time) for f in false_values(pings(velocity, rate), Config()) if f.kind == "zero")


def paused(speed: float, rate: float, seconds: float, noise: float, step: float = 0.0) -> Array:
    """At a speed, but for exact zeros in the middle."""
    v = ahead(np.full(round(100 * rate), speed), noise, step)
    v[round(50 * rate) : round((50 + seconds) * rate)] = 0.0
    return v


@pytest.mark.parametrize("rate", [1.0, 4.0])
def test_zeros_for_seconds_need_a_step_that_vehicles_seldom_make(rate):
    """Beside pings at rest that show noise, so that zeros are no rest."""
    limit = max(CLEAR_SPEED, STOPPING / rate)
    for speed, expected in ((0.9 * limit, 0), (1.1 * limit, 10 * rate)):
        v = np.vstack([ahead(np.zeros(100), 0.001), paused(speed, rate, 10.0, 0.001)])
        assert zeros_found(v, rate) == expected


@pytest.mark.parametrize("rate", [1.0, 4.0])
def test_zeros_of_a_sensor_that_may_read_them_at_rest_need_a_step_that_hardly_any_vehicle_makes(rate):
    for speed, expected in ((0.9 * BRAKING / rate, 0), (1.1 * BRAKING / rate, 10 * rate)):
        assert zeros_found(paused(speed, rate, 10.0, 0.001), rate) == expected


@pytest.mark.parametrize(("speed", "expected"), [(0.09, 0), (0.11, 1)])
def test_a_moment_of_zeros_needs_pings_on_both_sides_that_move(speed, expected):
    assert zeros_found(paused(speed, 1.0, 1.0, 0.001), 1.0) == expected


def coming_to_rest(rate: float, braking: float) -> Array:
    """Speed of a vehicle that stops, stays and goes on, again and again."""
    knots = np.cumsum([0.0, *[0.5 / braking, 10.0, 0.5 / braking, 10.0] * 10])
    speed = np.array([0.0, *[0.5, 0.5, 0.0, 0.0] * 10])
    return np.interp(np.arange(0.0, knots[-1], 1.0 / rate), knots, speed)


@pytest.mark.parametrize("rate", [1.0, 5.0])
@pytest.mark.parametrize("braking", [0.1, 0.3])
@pytest.mark.parametrize(("noise", "step", "clamp"), [(0.002, 0.01, 0.0), (0.005, 0.001, 0.02), (0.0, 0.05, 0.0)])
def test_a_vehicle_that_comes_to_rest_may_read_exact_zeros(rate, braking, noise, step, clamp):
    v = ahead(coming_to_rest(rate, braking), noise, step)
    v[np.linalg.norm(v, axis=1) < clamp] = 0.0
    assert (v == 0.0).all(axis=1).sum() > 50
    assert false_values(pings(v, rate), Config()) == []


def test_a_vehicle_that_an_obstacle_stops_may_read_zeros_if_its_noise_is_hidden():
    stopped = np.concatenate([np.full(250, 0.4), np.zeros(100), np.linspace(0.0, 0.4, 10), np.full(250, 0.4)])
    assert zeros_found(ahead(stopped, 0.002, 0.01), 5.0) == 0
    assert zeros_found(paused(0.4, 5.0, 20.0, 0.002, 0.01), 5.0) == 100


def test_noise_around_zero_and_a_change_of_direction_are_no_false_zeros():
    swaying = ahead(0.3 * np.sin(np.arange(2000) / 10.0), 0.001, 0.001)
    swaying[np.abs(swaying).max(axis=1) < 0.02] = 0.0
    assert (swaying == 0.0).all(axis=1).sum() > 5
    assert false_values(pings(swaying, 5.0), Config()) == []


@pytest.mark.parametrize(("part", "count"), [(0.5, 2), (0.3, 20), (0.7, 20)])
def test_few_halves_and_other_parts_may_be_manoeuvres(part, count):
    v = ahead(np.full(400, 0.5), 0.005)
    v[10 : 10 + 15 * count : 15] *= part
    assert false_values(pings(v, 2.0), Config()) == []
    v[10:55:15] = 0.5 * ahead(np.full(3, 0.5), 0.005)
    assert [f.kind for f in false_values(pings(v, 2.0), Config())] == (["half"] if count == 2 else [])


def test_swell_that_halves_the_speed_is_no_half_speed():
    swell = 0.4 + 0.2 * np.sin(np.pi / 2.0 * np.arange(400))  # one ping in four is half as fast
    assert false_values(pings(ahead(swell, 0.005), 1.0), Config()) == []


def test_pings_of_coarse_resolution_may_repeat():
    assert false_values(pings(ahead(np.full(600, 0.5), 0.002, 0.001), 2.0), Config()) == []


def alone(sensor: str, values: Array, rate: float = 2.0) -> Log:
    data = np.full((len(values), len(STREAMS[sensor])), np.nan)
    data[:, : values.shape[1]] = values
    rows = np.arange(len(values)) + 2
    return Log("dive.csv", {sensor: Stream(sensor, STREAMS[sensor], np.arange(len(values)) / rate, data, rows)})


@pytest.mark.parametrize(
    ("sensor", "columns", "inside", "outside", "noise"),
    [
        ("depth", 1, 0.9, 1.1, 0.01),  # 2 m/s over half a second
        ("ahrs", 1, np.deg2rad(9.0), np.deg2rad(12.0), 0.002),
        ("dvl_heading", 1, np.deg2rad(9.0), np.deg2rad(12.0), 0.002),
        ("vehicle_heading", 1, np.deg2rad(9.0), np.deg2rad(12.0), 0.002),
        ("vehicle_tilt", 2, np.deg2rad(6.0), np.deg2rad(9.0), 0.002),
        ("fix", 2, 6.0, 9.0, 0.1),
        ("dvl_water", 3, 0.05, 0.07, 0.001),
    ],
)
def test_zeros_of_other_sensors_are_none_where_the_vehicle_cannot_have_been_there(
    sensor, columns, inside, outside, noise
):
    if sensor == "depth":  # also where its resolution hides the noise
        inside, outside, step = 0.9, 1.1, 0.1
    else:
        step = 1e-6
    for away, expected in ((inside, 0), (outside, 10)):
        values = away + noise * np.random.default_rng(1).standard_normal((200, columns))
        values = np.round(values / step) * step
        values[15::20] = 0.0
        found = false_values(alone(sensor, values), Config())
        assert sum(len(f.time) for f in found) == expected
        assert all((f.sensor, f.kind) == (sensor, "zero") for f in found)


def test_a_heading_that_turns_through_north_and_fixes_that_start_at_the_origin_are_right():
    turning = np.deg2rad(np.arange(-180.0, 900.0, 3.0))[:, None] % (2.0 * np.pi)
    assert (turning == 0.0).any()
    assert false_values(alone("ahrs", turning), Config()) == []
    leaving = np.cumsum(np.full((100, 2), 0.7), axis=0) - 0.7
    assert false_values(alone("fix", leaving, 1.0), Config()) == []


def test_limits_that_depend_on_the_configuration():
    fix = companies(Config(fix={"sd_m": 4.0}, dvl={"max_speed_mps": 2.0}))["fix"]
    assert (fix.least, fix.never) == (20.0, 2.0)
