"""Clocks compared by motion while data come: what is late is said once, with what mends it; healthy streams are not."""

from collections.abc import Callable

import pytest
from dives import Simulated, falcon, simulated

from rovgraph.live.lags import Lags
from rovgraph.log import Measurement

RIGHT = {"ahrs_offset": {"estimate": False}, "ahrs_deviation": {"estimate": False}}


@pytest.fixture(scope="module")
def dive() -> Simulated:
    config = falcon(heading={"sources": ["ahrs", "dvl"], "ahrs_sd_deg": 1}, fix={"sd_m": 0.5}, calibration=RIGHT)
    return simulated(config, 240.0, 5, "lawnmower", fix_interval=2.0, ahrs_rate=10.0)


def said(dive: Simulated, late: Callable[[Measurement], float] = lambda m: 0.0) -> dict[str, str]:
    """Texts by sensor, of measurements that come as late as their stamps are."""
    stamped = [m._replace(time=m.time + late(m)) for m in dive.log.measurements()]
    lags = Lags(dive.config)
    texts = [text for m in sorted(stamped, key=lambda m: m.time) for text in lags.add(m)]
    found: dict[str, str] = {}
    for sensor, text in texts:
        found[sensor] = found.get(sensor, "") + text
    return found


def test_healthy_streams_are_not_late(dive):
    assert said(dive) == {}


def test_a_dvl_that_is_stamped_late_is_said_to_be(dive):
    (text,) = said(dive, lambda m: 0.3 * (m.sensor == "dvl")).values()
    mean, sd = text.split("calibration.dvl_time_offset: {estimate: true, mean: ")[1].rstrip("}").split(", sd: ")
    assert abs(float(mean) - 0.3) < 2.0 * float(sd) < 0.2


def test_fixes_and_a_compass_that_are_late_are_said_to_be(dive):
    texts = said(dive, lambda m: {"fix": 4.0, "ahrs": 2.0}.get(m.sensor, 0.0))
    assert "delay_s: {fix: " in texts["fix"]
    assert "state delay_s: {ahrs: 2}" in texts["ahrs"]


def test_a_clock_that_jumps_is_said_with_both_times(dive):
    begin = dive.log["imu"].time[0] + 120.0
    text = said(dive, lambda m: 3.0 * (m.sensor == "dvl" and m.time > begin))["dvl"]
    assert "before 1" in text and "clock jumps by +3.0 s" in text
