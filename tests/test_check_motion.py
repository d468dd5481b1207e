"""What a log tells by comparing motions: axes, mountings, clocks and their jumps, and values that cannot be."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from dives import Simulated, altered, changed, falcon, merge, simulated, true_at, without
from ruamel.yaml import YAML

from rovgraph.diagnosis.check import Finding, bridge_jumps, examine
from rovgraph.diagnosis.check.acceleration import ORIENTATIONS
from rovgraph.diagnosis.check.agreement import heading_lag, vertical
from rovgraph.diagnosis.check.inertial import inertial_motion
from rovgraph.errors import DataWarning
from rovgraph.geometry import matrix_from_rpy, rotate, transpose
from rovgraph.log import STREAMS, Log, Stream
from rovgraph.model.config import Config, mount_matrix
from rovgraph.simulate import CALM, Path, Style

LEVEL = Style(waves=CALM)


@pytest.fixture(scope="module", params=["waves", "level"])
def dive(request) -> tuple[Log, Config]:
    more = {"style": LEVEL} if request.param == "level" else {}
    case = simulated(falcon(), 300.0, 3, "lawnmower", **more)
    return case.log, case.config


@pytest.fixture(scope="module")
def turned_dives() -> dict[str, Simulated]:
    """Dives whose only headings are the magnetometer's and the DVL's, which is right."""
    return {
        "waves": simulated(falcon(), 120.0, 3, "lawnmower"),
        "level": simulated(falcon(), 200.0, 3, "lawnmower", style=LEVEL),
    }


@pytest.fixture(scope="module")
def with_fixes() -> tuple[Log, Config]:
    right = {"ahrs_offset": {"estimate": False}, "ahrs_deviation": {"estimate": False}}
    config = falcon(heading={"sources": ["ahrs", "dvl"]}, fix={"sd_m": 0.5}, calibration=right)
    case = simulated(config, 180.0, 5, "lawnmower", fix_interval=2.0, ahrs_rate=10.0)
    return case.log, case.config


def complaints(log: Log, config: Config, sensor: str) -> list[Finding]:
    return [f for f in examine(log, config).findings if f.sensor == sensor and f.level != "ok"]


def said(log: Log, config: Config, sensor: str) -> str:
    return "\n".join(f.text for f in complaints(log, config, sensor))


def later(log: Log, sensor: str, seconds: float, begin: float = -np.inf) -> Log:
    """A log whose sensor is stamped late from some time on."""
    stream = log[sensor]
    time = stream.time + seconds * (stream.time - log["imu"].time[0] >= begin)
    return replace(log, streams={**log.streams, sensor: replace(stream, time=time)})


def renamed(log: Log, H: np.ndarray) -> Log:
    """A log whose DVL measures along other axes: H turns them back."""
    data = log["dvl"].data.copy()
    data[:, :3] = data[:, :3] @ H
    return altered(log, "dvl", data)


def test_a_healthy_dive_has_no_warning(dive, with_fixes):
    for log, config in (dive, with_fixes):
        assert [f for f in examine(log, config).findings if f.level != "ok"] == []


def test_the_imu_alone_shows_level_and_acceleration():
    case = simulated(falcon(), 120.0, 3)
    motion = inertial_motion(case.log, case.config)
    truth = case.dive.path.motion(motion.time - case.log["imu"].time[0])
    R_bn = transpose(truth.R_nb)
    step = motion.step
    acceleration_b = rotate(R_bn, np.gradient(truth.v_n, step, axis=0))
    inside = slice(100, -100)
    error = (motion.acceleration_b - acceleration_b)[inside]
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert np.rad2deg(np.arccos(np.sum(motion.down_b * R_bn[:, :, 2], axis=1)[inside])).max() < 2.0


@pytest.mark.parametrize("k", [3, 9, 18, 20, 47])
def test_other_axes_are_named_with_what_mends_them(dive, k):
    log, config = dive
    H = ORIENTATIONS[k]
    text = said(renamed(log, H), config, "dvl")
    rpy = [float(a) for a in text.split("dvl.mount_rpy_deg: [")[1].split("]")[0].split(",")]
    np.testing.assert_allclose(mount_matrix(rpy), mount_matrix(config.dvl.mount_rpy_deg) @ H, atol=2e-3)
    mended = Config.model_validate(config.model_dump() | {"dvl": config.dvl.model_dump() | {"mount_rpy_deg": rpy}})
    assert said(without(renamed(log, H), "dvl_heading"), mended, "dvl") == ""


@pytest.mark.parametrize("k", [1, 2, 4, 8, 16, 46])
def test_flipped_axes_are_said_to_be_no_mounting(k):
    """In waves: on a level dive one sense of the vertical is as good as the other."""
    case = simulated(falcon(), 240.0, 3, "falcon")
    assert "left-handed" in said(renamed(case.log, ORIENTATIONS[k]), case.config, "dvl")


@pytest.mark.parametrize("sense", ["down", "up"])
@pytest.mark.parametrize("bias", [0.0, 0.03])
def test_earths_axes_are_named_whatever_the_bias_of_the_gyro(dive, sense, bias):
    """North, east and down, or east, north and up; the bias turns the gyro's axes by up to 500 degrees."""
    log, config = dive
    motion = inertial_motion(log, config)
    up_s = transpose(mount_matrix(config.imu.mount_rpy_deg)[None])[0] @ (0.0, 0.0, -1.0)
    imu = log["imu"].data.copy()
    imu[:, 3:] += bias * up_s
    k = np.searchsorted(motion.time, log["dvl"].time).clip(max=len(motion.time) - 1)
    along = rotate(motion.R_gb[k], rotate(mount_matrix(config.dvl.mount_rpy_deg), log["dvl"].data[:, :3]))
    pings = log["dvl"].data.copy()
    pings[:, :3] = along if sense == "down" else along[:, [1, 0, 2]] * (1.0, 1.0, -1.0)
    told = said(altered(altered(log, "dvl", pings), "imu", imu), config, "dvl")
    assert "along axes that do not turn with the vehicle, as Earth's" in told


@pytest.mark.parametrize("scenario", ["straight", "square"])
def test_a_turned_mounting_is_not_taken_for_earths_axes(scenario):
    """Where the vehicle hardly turns, axes that turn with it and axes that do not are alike."""
    case = simulated(falcon(), 120.0, 4, scenario, style=LEVEL)
    H = matrix_from_rpy(np.array([0.0, 0.0, np.deg2rad(45.0)]))
    assert "do not turn" not in said(renamed(case.log, H), case.config, "dvl")


def renamed_columns(case: Simulated, sensor: str, H: np.ndarray) -> pd.DataFrame:
    """A log's table whose magnetometer or gyro measures along other axes: H turns them back."""
    frame = case.dive.log_frame.copy()
    columns = [f"{sensor}_{axis}" for axis in "xyz"]
    frame[columns] = frame[columns].to_numpy() @ H
    return frame


def pasted(config: Config, text: str) -> Config:
    """A configuration with what a finding states."""
    stated: dict[str, Any] = {}
    for key in re.findall(r"imu\.mag\.matrix: \[\[.*?\]\]|columns: \{.*?\}|units: \{.*?\}", text):
        path, value = key.split(": ", 1)
        entry = YAML(typ="safe").load(value)
        for name in reversed(path.split(".")):
            entry = {name: entry}
        merge(stated, entry)
    assert stated
    return changed(config, **stated)


@pytest.mark.parametrize("k", [1, 2, 4, 6, 9, 16, 20, 31, 47])
@pytest.mark.parametrize("style", ["waves", "level"])
def test_axes_of_the_magnetometer_are_named_with_what_mends_them(turned_dives, style, k):
    case = turned_dives[style]
    frame = renamed_columns(case, "mag", ORIENTATIONS[k])
    (found,) = complaints(Log.from_frame(frame), case.config, "mag")
    assert (found.kind, found.wrong) == ("axes", True)
    mended = pasted(case.config, found.text)
    np.testing.assert_array_equal(mended.imu.mag.matrix, ORIENTATIONS[k])
    assert said(Log.from_frame(frame, mended), mended, "mag") == ""


@pytest.mark.parametrize("k", [1, 3, 16, 19])
def test_axes_of_the_gyro_are_named_and_not_blamed_on_the_magnetometer(turned_dives, k):
    case = turned_dives["waves"]
    frame = renamed_columns(case, "gyr", ORIENTATIONS[k])
    assert said(Log.from_frame(frame), case.config, "mag") == ""
    (found,) = [f for f in complaints(Log.from_frame(frame), case.config, "imu") if f.kind == "axes"]
    mended = pasted(case.config, found.text)
    assert said(Log.from_frame(frame, mended), mended, "imu") == ""


def test_axes_are_not_named_where_the_vehicle_hardly_turns():
    case = simulated(falcon(), 120.0, 4, "straight", style=LEVEL)
    flipped = altered(case.log, "mag", case.log["mag"].data * [1.0, -1.0, 1.0])
    assert "axes are" not in said(flipped, case.config, "mag")


@pytest.mark.parametrize("iron", [0.5, 3.0])
def test_iron_is_not_taken_for_other_axes(turned_dives, iron):
    """Hard iron of three times the field, and soft iron."""
    case = turned_dives["waves"]
    soft = np.eye(3) + 0.1 * np.array([[1.0, 0.5, -0.3], [0.5, -1.0, 0.4], [-0.3, 0.4, 0.5]])
    bent = case.log["mag"].data @ soft + iron * np.array([0.6, -0.6, 0.5])
    assert "axes are" not in said(altered(case.log, "mag", bent), case.config, "mag")


@pytest.mark.parametrize(("latitude", "named"), [(58.0, True), (-30.0, False), (10.0, False)])
def test_a_field_that_points_the_wrong_way_is_named_where_the_latitude_tells(turned_dives, latitude, named):
    case = turned_dives["waves"]
    config = changed(case.config, environment={"dip_deg": None, "latitude_deg": latitude})
    assert ("points upwards" in said(altered(case.log, "mag", -case.log["mag"].data), config, "mag")) == named


def with_current(case: Simulated, at: float, change_n: Sequence[float]) -> Log:
    """A log whose water moves otherwise from some seconds on."""
    water, R_bs = case.log["dvl_water"], mount_matrix(case.config.dvl.mount_rpy_deg)
    later_n = np.outer(water.time - case.log["imu"].time[0] > at, [*change_n, 0.0])
    data = water.data - rotate(transpose(true_at(case, water.time).R_nb), later_n) @ R_bs
    return altered(case.log, "dvl_water", data)


@pytest.fixture(scope="module")
def over_water() -> Simulated:
    return simulated(falcon(fix={"sd_m": 1.0}), 300.0, 1, "lawnmower", water_track=True, fix_interval=2.0)


@pytest.mark.parametrize("lost", [(), ("dvl",)])
def test_a_current_that_changes_is_named_with_time_and_what_lets_it(over_water, lost):
    """By bottom track, or by fixes where there is none."""
    log = without(with_current(over_water, 140.0, (-0.3, 0.2)), *lost)
    (found,) = complaints(log, over_water.config, "dvl_water")
    assert (found.kind, found.wrong) == ("current", True)
    first, second = (float(part.split(" s")[0]) for part in found.text.split(" between ")[1].split(" and ")[:2])
    assert first - 15.0 <= 140.0 <= second + 15.0
    walk = float(found.text.split("{walk: ")[1].split("}")[0])
    assert said(log, changed(over_water.config, calibration={"current": {"walk": walk}}), "dvl_water") == ""


@pytest.mark.parametrize("change_n", [(0.0, 0.0), (0.06, 0.06)])
def test_a_small_change_of_the_current_is_none(over_water, change_n):
    for lost in ((), ("dvl",)):
        log = without(with_current(over_water, 140.0, change_n), *lost)
        assert said(log, over_water.config, "dvl_water") == ""


@pytest.mark.parametrize("seconds", [-0.5, 0.3, 3.2, 40.0])
def test_a_dvl_that_is_stamped_late_is_measured_against_the_imu(dive, seconds):
    log, config = dive
    text = said(later(log, "dvl", seconds), config, "dvl")
    assert f"{'late' if seconds > 0 else 'early'} relative to the IMU's" in text
    found = float(text.split("dvl_time_offset: {estimate: true, mean: ")[1].split(",")[0])
    assert found == pytest.approx(seconds, abs=0.04)


def test_a_time_offset_that_is_stated_is_no_fault(dive):
    log, config = dive
    stated = config.model_dump(exclude_unset=True)
    stated["calibration"]["dvl_time_offset"] = {"estimate": False, "mean": 0.3}
    assert "relative to the IMU's" not in said(later(log, "dvl", 0.3), Config.model_validate(stated), "dvl")


@pytest.mark.parametrize("sensor", ["dvl", "imu"])
def test_a_clock_that_jumps_is_named_with_both_times(dive, sensor):
    log, config = dive
    (jump,) = [f.text for f in complaints(later(log, sensor, 2.0, 140.0), config, sensor) if "jumps" in f.text]
    assert float(jump.split(f"the {sensor.upper()}'s clock jumps by ")[1].split(" s")[0]) == pytest.approx(
        2.0, abs=0.15
    )
    before, after = (float(jump.split(word)[1].split(" s")[0]) for word in ("s before ", " s after "))
    assert before == pytest.approx(139.9, abs=0.2)
    assert after == pytest.approx(142.0, abs=0.2)


@pytest.mark.parametrize("sensor", ["dvl", "imu"])
def test_a_clock_that_jumps_is_bridged_and_both_times_are_said(dive, sensor):
    log, config = dive
    late = later(log, sensor, 2.0, 140.0)
    beams = Stream("dvl_beams", (), late["dvl"].time, np.full((len(late["dvl"]), 45), np.nan), late["dvl"].row)
    late = replace(late, streams={**late.streams, "dvl_beams": beams})
    with pytest.warns(DataWarning, match=rf"{sensor.upper()}'s clock jumps by .2\.0. s .* between 1.* and 14.*bridged"):
        bridged, _ = bridge_jumps(late, config)
    assert complaints(bridged, config, sensor) == []
    np.testing.assert_allclose(bridged[sensor].time, log[sensor].time, atol=0.1)
    assert bridged["depth"] is log["depth"]
    np.testing.assert_array_equal(bridged["dvl_beams"].time, bridged["dvl"].time)


def test_a_log_whose_clocks_go_on_is_left_alone(dive):
    log, config = dive
    assert bridge_jumps(log, config)[0] is log


@pytest.mark.parametrize("seconds", [7200.0 + 12.3, -1.7e9])
def test_clocks_of_different_epochs_are_put_together_by_the_motion(dive, seconds):
    log, config = dive
    text = said(later(log, "dvl", seconds), config, "dvl")
    found = float(text.split("delay_s: {dvl: ")[1].split("}")[0])
    assert found == pytest.approx(seconds, abs=0.2)
    assert "no time in common" in text


def test_recordings_of_other_dives_are_not_put_together(dive):
    log, config = dive
    other = later(altered(log, "dvl", log["dvl"].data[::-1]), "dvl", 7200.0)
    assert "delay_s" not in said(other, config, "dvl")


def test_a_compass_that_is_half_a_minute_late_is_measured(dive):
    log, config = dive
    text = said(later(log, "dvl_heading", 27.0), config, "dvl_heading")
    assert any(f"comes {x} s later than the gyro's" in text for x in ("26.98", "26.99", "27.00", "27.01", "27.02"))


@pytest.mark.parametrize("late", [0.0, 0.5])
@pytest.mark.parametrize("seed", [3, 4])
def test_waves_are_no_lag_of_a_compass(seed, late):
    """Rolling and pitching, a heading turns otherwise than the gyro's z axis shows, which seemed 0.15 s."""
    case = simulated(falcon(), 300.0, seed, "figure8")
    found = heading_lag(later(case.log, "dvl_heading", late), case.config, "dvl_heading")
    assert found is not None and found[0] == pytest.approx(late, abs=0.06)


def test_fixes_that_are_late_are_measured(with_fixes):
    log, config = with_fixes
    text = said(later(log, "fix", 4.0), config, "fix")
    found = float(text.split("fixes come ")[1].split(" s late")[0])
    assert found == pytest.approx(4.0, abs=1.0)  # at 0.35 m/s; 1 s is less than a fix's sd


@pytest.mark.parametrize("arm", [(1.5, 0.0, 0.3), (-1.5, 0.0, 0.3), (0.0, 1.5, 0.3)])
def test_the_lag_of_fixes_allows_for_the_arm_of_the_dvl(arm):
    """Along a circle a DVL 1.5 m ahead of the antenna looks as if the fixes came seconds late."""
    right = {"ahrs_offset": {"estimate": False}, "ahrs_deviation": {"estimate": False}}
    placed = {"lever_arm_m": list(arm)}
    config = falcon(heading={"sources": ["ahrs"]}, fix={"sd_m": 0.2}, dvl=placed, calibration=right)
    case = simulated(config, 240.0, 5, "figure8", fix_interval=1.0, ahrs_rate=10.0)
    assert "fixes come" not in said(case.log, config, "fix")
    text = said(later(case.log, "fix", 2.0), config, "fix")
    found = float(text.split("fixes come ")[1].split(" s late")[0])
    assert found == pytest.approx(2.0, abs=0.4)


def test_swapped_fixes_are_named(with_fixes):
    log, config = with_fixes
    data = log["fix"].data.copy()
    data[:, :2] = data[:, 1::-1]
    assert "north and east are swapped" in said(altered(log, "fix", data), config, "fix")


@pytest.fixture(scope="module")
def with_magnetometer_only() -> tuple[Log, Config]:
    """Fixes, and no other heading than a magnetometer's."""
    case = simulated(falcon(heading={"sources": ["mag"]}, fix={"sd_m": 0.5}), 180.0, 5, "lawnmower", fix_interval=2.0)
    return without(case.log, "dvl_heading"), case.config


def moved_fixes(log: Log, change: Callable[[np.ndarray], np.ndarray]) -> Log:
    """A log with other fixes, as complex numbers."""
    data = log["fix"].data.copy()
    fixes = change(data[:, 0] + 1j * data[:, 1])
    data[:, 0], data[:, 1] = fixes.real, fixes.imag
    return altered(log, "fix", data)


def test_fixes_are_compared_where_a_magnetometer_is_the_only_heading(with_magnetometer_only):
    log, config = with_magnetometer_only
    assert [f for f in examine(log, config).findings if f.level != "ok"] == []
    late = said(later(log, "fix", 6.0), config, "fix")
    assert float(late.split("fixes come ")[1].split(" s late")[0]) == pytest.approx(6.0, abs=1.0)
    assert "north and east are swapped" in said(moved_fixes(log, lambda z: 1j * z.conj()), config, "fix")
    turned = said(moved_fixes(log, lambda z: z * np.exp(0.9j)), config, "dvl")
    assert abs(int(turned.split("turned by ")[1].split(" deg")[0]) - 52) < 8
    (found,) = complaints(moved_fixes(log, lambda z: z * np.exp(0.9j)), config, "dvl")
    assert (found.kind, found.wrong) == ("turned", True)


def test_a_magnetometer_whose_axes_are_wrong_does_not_blame_the_dvl_for_the_fixes(with_magnetometer_only):
    log, config = with_magnetometer_only
    (found,) = [f for f in examine(altered(log, "mag", log["mag"].data * [-1, 1, 1]), config).findings if f.wrong]
    assert (found.sensor, found.kind) == ("mag", "axes")


def test_hard_iron_within_its_prior_does_not_turn_the_track(with_magnetometer_only):
    """At a dip of 72 degrees, hard iron of a tenth of the field turns a heading by up to 20 degrees."""
    log, config = with_magnetometer_only
    iron = altered(log, "mag", log["mag"].data + np.array([0.1, -0.08, 0.05]))
    assert said(iron, changed(config, calibration={"hard_iron": {"sd": 0.1}}), "dvl") == ""


@pytest.mark.parametrize("mount_deg", [0.0, 40.0])
def test_fixes_are_compared_with_the_vehicles_own_heading_without_an_imu(with_fixes, mount_deg):
    """Which is that of the body, however the DVL is mounted."""
    log, config = with_fixes
    heading = log["ahrs"].data[:, :1]
    own = Stream("vehicle_heading", STREAMS["vehicle_heading"], log["ahrs"].time, heading, log["ahrs"].row)
    bare = without(log, "imu", "ahrs", "mag", "dvl_heading")
    bare = replace(bare, streams={**bare.streams, "vehicle_heading": own})
    turned = changed(config, heading={"sources": ["vehicle"]}, dvl={"mount_rpy_deg": [180, 0, 45 + mount_deg]})
    text = said(bare, turned, "dvl")
    assert ("turned by -4" in text or "turned by -3" in text) if mount_deg else text == ""
    assert "swapped" in said(moved_fixes(bare, lambda z: 1j * z.conj()), turned, "fix")


@pytest.mark.parametrize("begin", [0.0, 60.0])
def test_fixes_that_repeat_exactly_are_named(with_fixes, begin):
    log, config = with_fixes
    data = log["fix"].data.copy()
    first = int(np.searchsorted(log["fix"].time - log["imu"].time[0], begin))
    data[first:, :2] = data[first, :2]
    text = said(altered(log, "fix", data), config, "fix")
    assert f"the same value for {log['fix'].time[-1] - log['fix'].time[first + 1]:.1f} s" in text
    assert "although the DVL moves by" in text


@pytest.mark.parametrize(
    ("factor", "possible"), [(1.0, True), (50.0, True), (5e4, True), (9134.0, False), (1e-3, False)]
)
def test_a_field_that_is_not_the_earths_is_named(dive, factor, possible):
    log, config = dive
    text = said(altered(log, "mag", factor * log["mag"].data), config, "mag")
    assert ("is not the Earth's" in text) != possible


def test_a_depth_above_the_surface_is_named(dive):
    log, config = dive
    data = log["depth"].data.copy()
    data[: len(data) // 20] -= 8.3 + data.min()
    assert "above the surface" in said(altered(log, "depth", data), config, "depth")


def test_depth_and_dvl_at_both_ends_of_a_vehicle_that_pitches_agree() -> None:
    """A vehicle that climbs along its axis as it pitches; taken for one place, its ends seem to have two clocks."""
    t, pitch = np.arange(0.0, 300.05, 0.1), 0.05 * np.sin(2.0 * np.pi * np.arange(0.0, 300.05, 0.1) / 8.0)
    forward, down = 0.4 * t, 5.0 + np.cumsum(-0.4 * 0.1 * np.sin(pitch)) + 3.0 * np.sin(2.0 * np.pi * t / 150.0)
    path = Path.through(t, np.column_stack([forward, 0.0 * t, down]), np.column_stack([0.0 * t, pitch, 0.0 * t]))
    apart = falcon(dvl={"lever_arm_m": [0.4, 0.0, 0.3]}, depth={"lever_arm_m": [-0.4, 0.0, 0.0]})
    log = simulated(apart, path=path, noise=False, imu_rate=25.0, dvl_rate=1.0, depth_rate=2.0).log
    one_place = changed(apart, dvl={"lever_arm_m": [0.0] * 3}, depth={"lever_arm_m": [0.0] * 3})
    doubts, taken_for_one = ([f.text for f in vertical(log, of) if f.level != "ok"] for of in (apart, one_place))
    assert not doubts
    assert any("the clocks disagree" in text for text in taken_for_one)


@pytest.mark.parametrize("with_imu", [True, False])
def test_a_depth_in_bar_is_named_where_the_dvl_is_away_from_it(with_imu) -> None:
    """Tilts move a depth in metres by the arm; without an IMU they are those that the vehicle states."""
    config = falcon()
    case = simulated(config, 200.0, seed=1)
    log = case.log
    if not with_imu:
        time = np.arange(log.start, log["imu"].time[-1], 0.2)
        rpy = true_at(case, time).rpy
        tilt = Stream("vehicle_tilt", STREAMS["vehicle_tilt"], time, rpy[:, :2], np.arange(len(time)))
        log = without(replace(log, streams={**log.streams, "vehicle_tilt": tilt}), "imu", "mag")
    assert not [f.text for f in vertical(log, config) if f.level != "ok"]
    in_bar = altered(log, "depth", log["depth"].data / 9.945)
    (named,) = (f for f in vertical(in_bar, config) if f.level != "ok")
    assert (named.sensor, named.kind) == ("depth", "unit") and "state units: {pressure: bar}" in named.text


def test_noise_of_the_depth_is_no_other_unit() -> None:
    """It lowers the slope by a tenth before the correlation is too low to tell units, which dbar would be, too."""
    config = falcon(depth={"density_kgm3": 1027.0})
    log = simulated(config, 200.0, seed=1).log
    noise = np.random.default_rng(3).normal(size=log["depth"].data.shape)
    for sd in np.linspace(0.04, 0.055, 40):  # the correlation falls below 0.95
        noisy = altered(log, "depth", log["depth"].data + sd * noise)
        assert not [f.text for f in vertical(noisy, config) if f.kind == "unit"]
