"""The checks of a log: silent on a sound dive, and each fault is named where it was put in."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from rovgraph.diagnosis.check import examine, keyframes, warn
from rovgraph.diagnosis.check.clocks import timing
from rovgraph.diagnosis.check.values import UPRIGHT
from rovgraph.errors import DataWarning, InputError
from rovgraph.geometry import wrap_angle
from rovgraph.log import STREAMS, Log, Stream, read_log
from rovgraph.log.frozen import frozen_stretches
from rovgraph.model.config import Config, load_config, mount_matrix

DATA = Path(__file__).parents[2] / "shared" / "data"
FLIPPED = {"dvl": {"mount_rpy_deg": [180, 0, 0]}}


def stream(sensor: str, time, *columns) -> Stream:
    data = np.full((len(time), len(STREAMS[sensor])), np.nan)
    data[:, : len(columns)] = np.column_stack(columns)
    return Stream(sensor, STREAMS[sensor], np.asarray(time), data, np.arange(len(time)) + 2)


def dive(duration: float = 400.0, turning: float = 0.15, sway: float = 0.15) -> Log:
    """A dive with turns and changes of depth, all sensors sound; DVL and IMU in body axes."""
    rng = np.random.default_rng(1)
    t = np.arange(0.0, duration, 0.02)
    rate = turning * (np.sin(2 * np.pi * t / 47) + 0.6 * np.sin(2 * np.pi * t / 13 + 1))
    heading = 1.0 + np.cumsum(rate) * 0.02
    surge, across = 0.4 + 0.1 * np.sin(t / 9), sway * np.sin(2 * np.pi * t / 31)
    down = 5.0 + 2.0 * np.sin(2 * np.pi * t / 60)
    v_down = np.gradient(down, t)
    v_n = surge * np.cos(heading) - across * np.sin(heading), surge * np.sin(heading) + across * np.cos(heading)
    north, east = (np.cumsum(v) * 0.02 for v in v_n)

    def noise(n: int, sd: float):
        return rng.normal(0, sd, n)

    n, p, d, f = len(t), slice(7, None, 10), slice(3, None, 10), slice(1, None, 50)
    m = len(t[p])
    imu = stream(
        "imu", t, *(noise(n, 0.02) for _ in range(2)), -9.81 + noise(n, 0.02),
        *(noise(n, 2e-3) for _ in range(2)), rate + 0.01 + noise(n, 2e-3),
    )  # fmt: skip
    dvl = stream("dvl", t[p], *(x[p] + noise(m, 0.005) for x in (surge, across, v_down)), np.ones(m))
    compass = wrap_angle(heading[p] + noise(m, 0.01))
    streams = (
        imu,
        dvl,
        stream("dvl_heading", t[p], compass),
        stream("ahrs", t, wrap_angle(heading + noise(n, 0.005)), noise(n, 0.01), noise(n, 0.01)),
        stream("mag", t, np.cos(heading) + noise(n, 0.01), -np.sin(heading) + noise(n, 0.01), np.full(n, 2.0)),
        stream("depth", t[d], down[d] + noise(len(t[d]), 0.01)),
        stream("fix", t[f], north[f] + noise(len(t[f]), 0.3), east[f] + noise(len(t[f]), 0.3)),
    )
    return Log("dive.csv", {s.sensor: s for s in streams})


def changed(log: Log, sensor: str, change) -> Log:
    """The log with one stream's data changed in place by ``change(data, time)``."""
    data = log[sensor].data.copy()
    change(data, log[sensor].time)
    return replace(log, streams={**log.streams, sensor: replace(log[sensor], data=data)})


def scaled(log: Log, sensor: str, columns: slice, factor: float) -> Log:
    def change(data, _):
        data[:, columns] *= factor

    return changed(log, sensor, change)


def without(log: Log, *sensors: str) -> Log:
    return replace(log, streams={k: s for k, s in log.streams.items() if k not in sensors})


def messages(log: Log, config: Config | None = None, level: str = "warning", sensor: str | None = None) -> str:
    return "\n".join(f.text for f in examine(log, config).at(level) if sensor in (None, f.sensor))


@pytest.fixture(scope="module")
def sound() -> Log:
    return dive()


def test_a_sound_dive_has_no_complaint(sound):
    report = examine(sound)
    assert [f for f in report.findings if f.level != "ok"] == []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn(sound)


def test_what_sensors_agree_on_is_said_with_numbers(sound):
    said = messages(sound, level="ok")
    for sensor in ("ahrs_yaw", "dvl_heading", "the field's direction"):
        assert f"{sensor} turns with the gyro (slope 1" in said
    assert "vertical velocity agrees with the change of depth (slope 1" in said
    assert "fits the fixes when turned by +0 deg and scaled by 1.0" in said


def test_timing_counts_rate_gap_and_repeats():
    time = np.concatenate([np.arange(0, 10, 0.1), np.arange(15, 20, 0.1)])
    depth = np.arange(len(time), dtype=float)
    depth[5:8] = depth[5]
    t = timing(stream("depth", time, depth))
    assert (t.count, t.repeats) == (150, 2)
    assert (t.rate, t.gap, t.gap_at, t.last) == pytest.approx((10.0, 5.1, 9.9, 19.9))
    assert np.isnan(timing(stream("depth", [1.0], [2.0])).rate)


@pytest.mark.parametrize(
    ("absent", "level", "said"),
    [
        (["imu"], "error", "no IMU"),
        (["dvl"], "warning", "no DVL: without fixes, position is lost"),
        (
            ["mag", "ahrs", "dvl_heading"],
            "warning",
            "no heading source in use: give mag, ahrs_yaw, heading or dvl_heading",
        ),
        (["depth"], "warning", "no depth"),
        (["fix"], "ok", "no position fixes"),
    ],
)
def test_a_missing_sensor_is_named_with_its_consequence(sound, absent, level, said):
    assert said in messages(without(sound, *absent), level=level)


def test_a_gap_is_found_where_it_is_and_a_long_one_of_the_imu_is_refused(sound):
    def cut(log, sensor, a, b):
        s = log[sensor]
        k = (s.time < a) | (s.time > b)
        return replace(log, streams={**log.streams, sensor: replace(s, time=s.time[k], data=s.data[k], row=s.row[k])})

    assert "the longest 20.2 s from 99.9 s on" in messages(cut(sound, "dvl", 100, 120), sensor="dvl")
    assert "1 gap longer" in messages(cut(sound, "imu", 100, 120), sensor="imu")
    assert "imu.max_gap_s = 30" in messages(cut(sound, "imu", 100, 140), level="error")


@pytest.mark.slow
def test_milliseconds_taken_for_seconds_are_noticed(sound):
    slow = {k: replace(s, time=s.time * 1000) for k, s in sound.streams.items()}
    assert "units: {time: ms}" in messages(replace(sound, streams=slow), sensor="imu")


def test_clocks_of_different_epochs_are_refused(sound):
    late = replace(sound["dvl"], time=sound["dvl"].time + 1e6)
    log = replace(sound, streams={**sound.streams, "dvl": late})
    assert "no time in common" in messages(log, level="error", sensor="dvl")


@pytest.mark.parametrize(("factor", "unit"), [(1 / 9.80665, "g"), (1000 / 9.80665, "mg")])
def test_acceleration_in_g_is_refused_with_the_unit(sound, factor, unit):
    log = scaled(sound, "imu", slice(0, 3), factor)
    assert f"units: {{acc: {unit}}}" in messages(log, level="error", sensor="imu")
    with pytest.raises(InputError, match=r"^dive.csv: imu: "):
        warn(log)


@pytest.mark.parametrize("axis", UPRIGHT)
def test_the_mounting_that_is_suggested_turns_gravity_upright(sound, axis):
    f = (1 if axis[0] == "+" else -1) * 9.81 * np.eye(3)["xyz".index(axis[1])]
    np.testing.assert_allclose(mount_matrix(UPRIGHT[axis]) @ f, [0, 0, -9.81], atol=1e-9)

    def turn(data, _):
        data[:] = data @ np.kron(np.eye(2), mount_matrix(UPRIGHT[axis]))

    turned = messages(changed(sound, "imu", turn), sensor="imu")
    assert (f"IMU's {axis} axis" in turned) == (axis != "-z")
    mounted = Config.model_validate({"imu": {"mount_rpy_deg": UPRIGHT[axis]}})
    assert messages(without(changed(sound, "imu", turn), "mag"), mounted) == ""


@pytest.mark.parametrize("with_heading", [True, False])
def test_a_gyro_in_degrees_is_refused(sound, with_heading):
    log = scaled(sound, "imu", slice(3, 6), np.rad2deg(1.0))
    log = log if with_heading else without(log, "mag", "ahrs", "dvl_heading")
    assert "units: {gyr: deg/s}" in messages(log, level="error")


def test_a_slow_gyro_in_degrees_is_refused_by_its_heading():
    log = scaled(dive(turning=0.03), "imu", slice(3, 6), np.rad2deg(1.0))
    assert "the gyro's rates are 57 times too large" in messages(log, level="error", sensor="ahrs")


def test_a_gyro_converted_twice_is_refused(sound):
    log = scaled(sound, "imu", slice(3, 6), np.deg2rad(1.0))
    assert "the gyro's rates are 57 times too small" in messages(log, level="error", sensor="dvl_heading")


@pytest.mark.parametrize("sensor", ["ahrs", "dvl_heading"])
def test_a_heading_in_degrees_is_refused(sound, sensor):
    log = scaled(sound, sensor, slice(0, 1), np.rad2deg(1.0))
    assert f"units: {{{sensor}: deg}}" in messages(log, level="error", sensor=sensor)


def test_a_heading_converted_twice_is_refused(sound):
    log = scaled(sound, "dvl_heading", slice(0, 1), np.deg2rad(1.0))
    assert "dvl_heading is 57 times too small" in messages(log, level="error", sensor="dvl_heading")


def test_a_heading_that_counts_on_past_a_circle_is_fine(sound):
    def unwrap(data, _):
        data[:, 0] = np.unwrap(data[:, 0]) + 20.0

    assert messages(changed(sound, "ahrs", unwrap)) == messages(changed(sound, "ahrs", unwrap), level="error") == ""


def test_tilt_in_degrees_is_refused(sound):
    def tilt(data, time):
        data[:, 1] = 8.0 * np.sin(time)

    assert "roll or pitch reaches 8 rad" in messages(changed(sound, "ahrs", tilt), level="error")


def test_a_heading_that_counts_anticlockwise_is_named(sound):
    log = scaled(sound, "dvl_heading", slice(0, 1), -1.0)
    assert "dvl_heading turns opposite to the gyro (slope -1" in messages(log, sensor="dvl_heading")
    assert messages(log, sensor="ahrs") == ""


def test_a_late_compass_is_measured(sound):
    late = replace(sound["dvl_heading"], time=sound["dvl_heading"].time + 0.8)
    said = messages(replace(sound, streams={**sound.streams, "dvl_heading": late}), sensor="dvl_heading")
    assert any(f"comes {x} s later than the gyro's" in said for x in ("0.79", "0.80", "0.81"))


def gentle_dive(seed: int, late: float = 0.0) -> Log:
    """Two minutes or less of gentle turning: gyro and AHRS, a degree of white noise, the latter stamped late."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 60.0 + 20.0 * (seed % 4), 0.02)
    rate = 0.12 * (0.5 + np.sin(0.11 * t + rng.uniform(0, 2 * np.pi)))
    heading = np.cumsum(rate) * 0.02
    imu = np.column_stack([*np.zeros((2, len(t))), np.full(len(t), -9.81), *np.zeros((2, len(t))), rate])
    imu[:, 3:] += rng.normal(0, 5e-3, (len(t), 3))
    compass = wrap_angle(heading[::5] + rng.normal(0, np.deg2rad(1.0), len(t[::5])))
    streams = stream("imu", t, *imu.T), stream("ahrs", t[::5] + late, compass)
    return Log("gentle.csv", {s.sensor: s for s in streams})


def test_noise_of_a_heading_is_not_taken_for_a_clock_that_is_late():
    warned = [seed for seed in range(30) if "the clocks disagree" in messages(gentle_dive(seed), sensor="ahrs")]
    assert len(warned) <= 1
    late = [seed for seed in range(30) if "the clocks disagree" in messages(gentle_dive(seed, 0.6), sensor="ahrs")]
    assert len(late) > 20


def test_a_lag_of_a_compass_that_is_stated_is_no_fault(sound):
    late = replace(sound["ahrs"], time=sound["ahrs"].time + 0.8)
    log = replace(sound, streams={**sound.streams, "ahrs": late})
    stated = {"calibration": {"ahrs_time_offset": {"estimate": True, "mean": 0.8, "sd": 0.05}}}
    assert "comes 0." in messages(log, sensor="ahrs")
    assert messages(log, Config.model_validate(stated), sensor="ahrs") == ""
    stated["calibration"]["ahrs_time_offset"]["mean"] = 0.3  # another one
    assert "comes 0." in messages(log, Config.model_validate(stated), sensor="ahrs")


def test_half_a_second_between_clocks_is_found_on_a_dive_that_turns(sound):
    for sensor in ("ahrs", "dvl_heading"):
        late = replace(sound[sensor], time=sound[sensor].time - 0.5)
        said = messages(replace(sound, streams={**sound.streams, sensor: late}), sensor=sensor)
        assert "s earlier than the gyro's (sd 0.0" in said


def test_a_late_dvl_is_measured_against_depth(sound):
    late = replace(sound["dvl"], time=sound["dvl"].time + 1.5)
    said = messages(replace(sound, streams={**sound.streams, "dvl": late}), sensor="dvl")
    assert any(f"vertical velocity comes {x} s later" in said for x in ("1.48", "1.49", "1.50", "1.51", "1.52"))


@pytest.mark.parametrize("sd", [0.08, 0.2])
def test_noise_of_depth_on_a_level_dive_is_not_taken_for_a_mounting(sound, sd):
    def level(data, time):
        data[:, 0] = 5.0 + np.random.default_rng(3).normal(0, sd, len(time))

    flat = changed(sound, "dvl", lambda data, _: data.__setitem__((slice(None), 2), 0.0))
    assert messages(changed(flat, "depth", level), sensor="dvl") == ""
    assert "does not follow depth" in messages(flat, sensor="dvl")


def test_a_dvl_that_looks_up_is_named_by_depth_and_by_fixes(sound):
    log = scaled(sound, "dvl", slice(1, 3), -1.0)
    assert "state dvl.mount_rpy_deg: [180, 0, 0]" in messages(without(log, "fix"), sensor="dvl")
    assert "better with y mirrored" in messages(without(log, "depth"), sensor="dvl")
    assert messages(log, Config.model_validate(FLIPPED)) == ""
    assert "state dvl.mount_rpy_deg: [0, 0, 0]" in messages(sound, Config.model_validate(FLIPPED), sensor="dvl")


def test_a_dvl_turned_by_40_degrees_is_measured_against_fixes(sound):
    turned = Config.model_validate({"dvl": {"mount_rpy_deg": [0, 0, 40]}})
    said = messages(without(sound, "dvl_heading"), turned, sensor="dvl")
    assert "turned by -40 deg and scaled by 1.0" in said


def started(**start: float) -> Config:
    return Config.model_validate({"start": start, "fix": {"sd_m": 0.3}})


def test_fixes_that_begin_elsewhere_than_the_stated_start_are_named(sound):
    away = changed(sound, "fix", lambda data, _: data.__setitem__((slice(None), 0), data[:, 0] + 8.0))
    said = messages(away, started(north_m=0.0, east_m=0.0), sensor="fix")
    assert "from start.north_m and start.east_m, of which the vehicle moved at most 0." in said
    assert "the ship's heading" in said


def test_fixes_that_begin_at_the_stated_start_or_without_one_are_not_named(sound):
    away = changed(sound, "fix", lambda data, _: data.__setitem__((slice(None), 0), data[:, 0] + 8.0))
    assert messages(sound, started(north_m=0.0, east_m=0.0), sensor="fix") == ""
    assert messages(away, started(north_m=8.0, east_m=0.0), sensor="fix") == ""
    assert messages(away, started(), sensor="fix") == ""
    assert messages(away, started(north_m=0.0, position_sd_m=5.0), sensor="fix") == ""
    far = changed(sound, "fix", lambda data, _: data.__setitem__((slice(None), 2), 3.0))
    far = changed(far, "fix", lambda data, _: data.__setitem__((slice(None), 0), data[:, 0] + 8.0))
    assert messages(far, started(north_m=0.0), sensor="fix") == ""


def test_the_way_since_the_start_is_no_contradiction(sound):
    later = sound["fix"].take(sound["fix"].time > 20.0)
    assert messages(replace(sound, streams={**sound.streams, "fix": later}), started(north_m=0.0), sensor="fix") == ""


def test_velocities_in_millimetres_are_refused(sound):
    assert "units: {dvl: mm/s}" in messages(scaled(sound, "dvl", slice(0, 3), 1e3), level="error", sensor="dvl")


def test_little_bottom_lock_is_counted(sound):
    def lose(data, time):
        data[time < 100, 3] = 0.0

    assert "bottom lock 75.0%" in messages(changed(sound, "dvl", lose), sensor="dvl")


def test_depth_upwards_is_named(sound):
    assert "depth counts downwards" in messages(scaled(sound, "depth", slice(0, 1), -1.0), sensor="depth")


def test_hard_iron_larger_than_the_field_is_named(sound):
    def magnetise(data, _):
        data[:, 0] += 3.0

    assert "hard iron" in messages(changed(sound, "mag", magnetise), sensor="mag")


def test_an_imu_that_repeats_itself_is_named(sound):
    def hold(data, time):
        data[(time > 50) & (time < 70)] = data[0]

    said = messages(changed(sound, "imu", hold), sensor="imu")
    assert "acc repeats one value exactly for 20.0 s from 50.0 s on" in said
    assert "gyr repeats" in said


def test_samples_written_twice_are_named(sound):
    def twice(data, _):
        data[1::2] = data[::2]

    assert "50% of the measurements repeat" in messages(changed(sound, "imu", twice), sensor="imu")


@pytest.mark.parametrize(("axis", "column", "limit"), [("acc_x", 0, 0.03), ("gyr_z", 5, 0.15)])
@pytest.mark.parametrize("end", [1.0, -1.0])
def test_a_clipped_signal_is_named_with_axis_limit_count_and_time(sound, axis, column, limit, end):
    values = end * sound["imu"].data[:, column]
    clipped = changed(
        sound, "imu", lambda data, _: data.__setitem__((slice(None), column), end * values.clip(max=limit))
    )
    (found,) = examine(clipped).at("warning")
    assert (found.sensor, found.kind, found.wrong) == ("imu", "saturated", True)
    assert f"{axis} at {end * limit:.4g} " in found.text
    assert f"in {np.count_nonzero(values >= limit)} samples" in found.text
    first = sound["imu"].time[np.argmax(values >= limit)] - sound["imu"].time[0]
    assert f"first at {first:.1f} s" in found.text


@pytest.mark.parametrize(("count", "named"), [(9, False), (10, True)])
def test_a_few_samples_at_one_extreme_are_chance(sound, count, named):
    limit = np.sort(sound["imu"].data[:, 1])[-count]
    cut = changed(sound, "imu", lambda data, _: data.__setitem__((slice(None), 1), data[:, 1].clip(max=limit)))
    assert ("is clipped" in messages(cut, sensor="imu")) == named


def test_a_range_of_2_g_is_named_in_g(sound):
    def shake(data, time):
        data[:, 0] = (30.0 * np.sin(40.0 * time) + data[:, 0]).clip(-19.6, 19.6)

    assert "acc is clipped (2 g): acc_x at " in messages(changed(sound, "imu", shake), sensor="imu")


@pytest.mark.parametrize("resolution", [1e-4, 1e-3, 0.02, 0.1])
def test_a_coarse_resolution_is_no_clipping(sound, resolution):
    def coarse(data, _):
        data[:, 3:] = np.round(data[:, 3:] / resolution) * resolution

    assert "clipped" not in messages(changed(sound, "imu", coarse), sensor="imu")


def test_findings_tell_what_is_wrong_from_remarks(sound):
    """What smooth counts as evidence of an error."""
    mirrored = scaled(sound, "dvl_heading", slice(0, 1), -1.0)
    lost = changed(without(mirrored, "depth", "fix"), "dvl", lambda data, time: data.__setitem__((time < 100, 3), 0.0))
    report = examine(lost)
    assert {(f.sensor, f.kind, f.wrong) for f in report.at("warning")} == {
        ("dvl_heading", "sign", True), ("depth", "missing", False), ("dvl", "bottom lock", False),
    }  # fmt: skip
    assert [f.kind for f in report.faults(Config())] == ["sign"]
    assert report.faults(Config.model_validate({"heading": {"sources": ["mag"]}})) == []  # which does not use it
    assert [f["wrong"] for f in report.as_dict()["findings"]] == [f.wrong for f in report.findings]


def test_a_heading_that_stands_still_in_a_turn_is_named(sound):
    def hold(data, time):
        data[(time > 50) & (time < 70), 0] = 1.0

    assert "although the gyro turns by" in messages(changed(sound, "dvl_heading", hold), sensor="dvl_heading")


def zeroed(log: Log, first: float, last: float) -> Log:
    def stop(data, time):
        data[(time >= first) & (time <= last), :3] = 0.0

    return changed(log, "dvl", stop)


def dvl_frozen_intervals(log: Log) -> list[tuple[float, float]]:
    return [(s.first, s.last) for s in frozen_stretches(log, Config()) if s.kind == "zero"]


def test_zeros_that_begin_at_speed_are_a_frozen_dvl(sound):
    ((first, last),) = dvl_frozen_intervals(zeroed(sound, 100.0, 120.0))
    assert (first, last) == pytest.approx((100.14, 119.94))
    assert "exactly zero for 19.8 s from 100.1 s on, although it moves at" in messages(zeroed(sound, 100.0, 120.0))


def test_zeros_all_along_are_frozen_when_others_see_motion(sound):
    assert len(dvl_frozen_intervals(zeroed(sound, -1, 1e9))) == 1
    still = changed(zeroed(sound, -1, 1e9), "imu", lambda data, _: data.__setitem__((slice(None), 5), 1e-3))
    assert "fixes move" in messages(still, sensor="dvl")
    assert dvl_frozen_intervals(without(still, "fix")) == []


def test_zeros_that_the_vehicle_comes_to_slowly_are_a_standstill(sound):
    assert dvl_frozen_intervals(sound) == []
    assert len(dvl_frozen_intervals(zeroed(sound, 100.0, 102.0))) == 1

    def ease(data, time):  # comes to rest, stays, and sets off again
        speed = np.clip((np.abs(time - 100.0) - 20.0) / 60.0, 0.0, 0.4)
        data[:, :3] = np.column_stack([speed, 0 * speed, 0 * speed])

    resting = changed(without(sound, "fix"), "dvl", ease)
    resting = changed(resting, "imu", lambda data, _: data.__setitem__((slice(None), 5), 1e-3))
    assert dvl_frozen_intervals(resting) == []


@pytest.mark.parametrize("sensor", ["ahrs", "dvl", "dvl_heading"])
def test_a_sensor_that_freezes_is_only_said_to_be_frozen(sensor):
    """Neither that it disagrees with others, nor that it is logged faster than it measures."""

    def freeze(data, time):
        held = (time >= 40) & (time <= 140)
        data[held] = data[held][0]

    (said,) = messages(changed(dive(180.0, turning=0.3), sensor, freeze), sensor=sensor).split("\n")
    assert said.startswith("exactly the same value for ")


@pytest.mark.parametrize(("times", "share"), [(2, 50), (20, 95)])
def test_a_dvl_that_repeats_each_ping_is_logged_too_fast(sound, times, share):
    """Also one that pings every 4 s in a table of 5 Hz: its values last, but as long as usual."""

    def repeat(data, time):
        data[:] = data[np.arange(len(data)) // times * times]

    assert f"{share}% of the measurements repeat the previous one exactly" in messages(changed(sound, "dvl", repeat))


@pytest.mark.parametrize("apart", [0.001, 0.016])
def test_bursts_are_said_to_be_bursts_and_have_no_gaps_in_between(sound, apart):
    """A serial buffer that is read once a second: five pings at a time."""
    s = sound["dvl"]
    late = np.ceil(s.time) + apart * (np.arange(len(s)) % 5)
    log = replace(sound, streams={**sound.streams, "dvl": replace(s, time=np.sort(late))})
    said = messages(log, sensor="dvl").split("\n")
    assert sum("in bursts, most 0.0" in line and "they may be times of arrival" in line for line in said) == 1
    assert not any("gap" in line or "time is not in seconds" in line for line in said)


@pytest.mark.parametrize(("every", "sensor"), [(0.1, "imu"), (0.5, "imu"), (2.0, "dvl")])
def test_batches_of_any_size_are_bursts_and_no_lag_is_said_beside_them(sound, every, sensor):
    s = sound[sensor]
    batch = np.ceil(s.time / every)
    late = batch * every + 1e-4 * (np.arange(len(s)) - np.searchsorted(batch, batch))
    log = replace(sound, streams={**sound.streams, sensor: replace(s, time=late)})
    (found,) = examine(log).at("warning")
    assert (found.sensor, found.kind, found.wrong) == (sensor, "bursts", True)


def test_pings_now_and_then_are_gaps_and_no_bursts(sound):
    """A DVL that pings for one second of four."""
    s = sound["dvl"]
    log = replace(sound, streams={**sound.streams, "dvl": s.take(s.time % 4.0 < 1.0)})
    assert {f.kind for f in examine(log).at("warning")} == {"gap"}


@pytest.mark.parametrize(("size", "named"), [(1, False), (2, False), (3, True), (10, True)])
def test_samples_that_share_stamps_are_named_where_most_of_them_are_lost(size, named):
    """Two with one stamp are a coarse clock."""
    t = np.arange(0.0, 60.0, 0.01)
    rng = np.random.default_rng(1)
    signals = rng.normal(0.0, 0.01, (len(t), 6)) - 9.81 * np.eye(6)[2]
    names = [f"{kind}_{axis}" for kind in ("acc", "gyr") for axis in "xyz"]
    frame = pd.DataFrame({"time": t[np.arange(len(t)) // size * size], **dict(zip(names, signals.T, strict=True))})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        log = Log.from_frame(frame)
    assert ("have the stamp of another" in messages(log, sensor="imu")) == named


def test_spikes_of_the_depth_say_nothing_of_the_dvl(sound):
    spikes = changed(sound, "depth", lambda data, _: data.__setitem__((slice(7, None, 13), 0), 65.536))
    assert messages(spikes, sensor="dvl") == ""
    assert "vertical velocity agrees with the change of depth (slope 1" in messages(spikes, level="ok")


@pytest.mark.slow
@pytest.mark.parametrize("by", [1.0, -8.0])
def test_a_depth_that_is_zeroed_under_way_does_not_blame_the_dvl(sound, by):
    def zero(data, time):
        data[time > 150, 0] += by

    zeroed = changed(sound, "depth", zero)
    assert messages(zeroed, sensor="dvl") == ""
    assert "reversed" not in messages(zeroed, sensor="depth")
    assert ("its zero was probably set under water" in messages(zeroed, sensor="depth")) == (by < 0.0)


@pytest.mark.parametrize(
    ("factor", "unit"), [(1.0 / 9.945, "bar"), (1.4585, "psi"), (10.055, "kPa"), (10_055.0, "Pa"), (1e3, "mm")]
)
def test_a_depth_that_is_a_pressure_or_in_another_unit_is_named_by_the_dvls_way(sound, factor, unit):
    said = messages(scaled(sound, "depth", slice(0, 1), factor), sensor="depth")
    column = "depth" if unit == "mm" else "pressure"
    assert f"state units: {{{column}: {unit}}}" in said
    assert ("name it pressure" in said) == (column == "pressure")


def test_a_pressure_in_the_wrong_unit_is_named_by_the_dvls_way(sound):
    """Gauge, so that no air shows it: bar that was taken for dbar."""
    config = Config().changed(units={"pressure": "dbar"}, depth={"surface_hpa": 0})
    log = replace(scaled(sound, "depth", slice(0, 1), 0.1), notes=("depth by pressure: ...",))
    assert "if it is in bar, state units: {pressure: bar}" in messages(log, config, sensor="depth")


@pytest.mark.parametrize(("unit", "hpa"), [("dbar", 100.0), ("psi", 68.94757), ("kPa", 10.0), ("hPa", 1.0)])
def test_a_depth_that_begins_and_ends_with_the_airs_weight_is_named_without_a_dvl_too(sound, unit, hpa):
    def dive_from_the_surface(data, time):
        data[:, 0] = (1013.0 + 200.0 * np.clip(np.minimum(time - 20.0, 380.0 - time) / 20.0, 0.0, 2.0)) / hpa

    absolute = changed(without(sound, "dvl"), "depth", dive_from_the_surface)
    assert f"state units: {{pressure: {unit}}}" in messages(absolute, sensor="depth")
    stated = Config().changed(depth={"surface_hpa": 0})
    assert "remove depth.surface_hpa: 0" in messages(absolute, stated, sensor="depth")


def test_invalid_zeros_are_not_frozen(sound):
    def lose(data, time):
        data[(time >= 100) & (time <= 120), :4] = 0.0

    assert dvl_frozen_intervals(changed(sound, "dvl", lose)) == []


@pytest.mark.parametrize("held", [np.nan, 0.0, -32.768])
def test_pings_without_bottom_lock_may_hold_anything_and_do_not_count_as_repeated(sound, held):
    def lose(data, time):
        lost = (time >= 100) & (time <= 200)
        data[lost, :3], data[lost, 3] = held, 0.0

    log = changed(sound, "dvl", lose)
    (said,) = messages(log, sensor="dvl").split("\n")
    assert said.startswith("bottom lock 75")
    assert timing(log["dvl"]).repeats == 0


def test_keyframes_are_pings_and_what_fills_gaps():
    imu = stream("imu", np.arange(0, 10.001, 0.01), *np.zeros((6, 1001)))
    dvl = stream("dvl", [1.0, 1.5, 1.51, 4.0, 9.0], *np.ones((4, 5)))
    log = Log("x", {"imu": imu, "dvl": dvl})
    # start; 1.0; 1.5; (1.51 is attached); 2.5 or so, 3.5 or so, 4.0; 5, 6, 7, 8, 9; 10
    assert keyframes(log, Config()) == 1 + 2 + 3 + 5 + 1


def test_assumptions_and_absent_heading_sources_are_said(sound):
    said = messages(sound, level="ok", sensor="configuration")
    assert "heading from mag, dvl_heading" in said
    assert "start.heading_deg is not given: taken from the first samples of mag" in said
    assert "dvl.mount_rpy_deg is not given" in said
    given = Config.model_validate({"heading": {"sources": ["dvl", "mag"]}, "dvl": {"mount_rpy_deg": [0, 0, 0]}})
    assert "dvl.mount_rpy_deg" not in messages(sound, given, level="ok")
    assert "heading.sources names dvl" in messages(without(sound, "dvl_heading"), given)


def test_warn_issues_what_examine_finds(sound):
    with pytest.warns(DataWarning, match=r"^dive.csv: depth: median depth -"):
        warn(scaled(sound, "depth", slice(0, 1), -1.0))


@pytest.mark.slow
def test_sparse_streams_do_not_break_any_check(sound):
    for sensor in sound.sensors:
        for n in (1, 2, 20):
            s = sound[sensor]
            few = replace(s, time=s.time[:n], data=s.data[:n], row=s.row[:n])
            examine(replace(sound, streams={**sound.streams, sensor: few}))
            examine(Log("x", {sensor: few}))


def test_the_real_dive_raises_no_false_alarm():
    folder = DATA / "ictineu"
    if not (folder / "log.csv.gz").exists():
        pytest.skip(f"no real data in {folder}")
    log = read_log(folder / "log.csv.gz")
    report = examine(log, load_config(folder / "ictineu.yaml"))
    assert report.at("error") == []
    # its DVL's compass does come late: at the same lag for windows of 1 to 8 s
    (only,) = report.at("warning")
    assert only.sensor == "dvl_heading"
    assert "s later than the gyro's" in only.text
    assert "bottom lock 98.3% of 5045 pings" in messages(log, level="ok")
    assert dvl_frozen_intervals(log) == []
    assert "y to port, state dvl.mount_rpy_deg: [180, 0, 0]" in messages(log, sensor="dvl")
