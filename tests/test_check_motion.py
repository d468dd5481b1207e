"""What a log tells by comparing motions: axes, mountings, clocks and their jumps, and values that cannot be."""

from dataclasses import replace

import numpy as np
import pytest
from dives import altered, falcon, simulated, without

from rovgraph.check import Finding, bridge_jumps, examine
from rovgraph.check.acceleration import ORIENTATIONS
from rovgraph.check.agreement import heading_lag
from rovgraph.check.inertial import inertial_motion
from rovgraph.config import Config, mount_matrix
from rovgraph.errors import DataWarning
from rovgraph.geometry import matrix_from_rpy, rotate, transpose
from rovgraph.log import Log
from rovgraph.simulate import CALM, Style

LEVEL = Style(waves=CALM)


@pytest.fixture(scope="module", params=["waves", "level"])
def dive(request) -> tuple[Log, Config]:
    more = {"style": LEVEL} if request.param == "level" else {}
    case = simulated(falcon(), 300.0, 3, "lawnmower", **more)
    return case.log, case.config


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
    late = replace(late, beams=replace(late["dvl"], sensor="dvl_beams"))
    with pytest.warns(DataWarning, match=rf"{sensor.upper()}'s clock jumps by .2\.0. s .* between 1.* and 14.*bridged"):
        bridged, _ = bridge_jumps(late, config)
    assert complaints(bridged, config, sensor) == []
    np.testing.assert_allclose(bridged[sensor].time, log[sensor].time, atol=0.1)
    assert bridged["depth"] is log["depth"]
    np.testing.assert_array_equal(bridged.beams.time, bridged["dvl"].time)


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


def test_swapped_fixes_are_named(with_fixes):
    log, config = with_fixes
    data = log["fix"].data.copy()
    data[:, :2] = data[:, 1::-1]
    assert "north and east are swapped" in said(altered(log, "fix", data), config, "fix")


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
