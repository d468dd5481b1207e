"""Sensors compared by motion while data come: late stamps and wrong axes are said once, with what mends them."""

import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from dives import Simulated, campaign_log, falcon, simulated

from rovgraph.live.sensor_faults import Crosscheck
from rovgraph.log import Measurement

RIGHT = {"ahrs_offset": {"estimate": False}, "ahrs_deviation": {"estimate": False}}


@pytest.fixture(scope="module")
def dive() -> Simulated:
    config = falcon(heading={"sources": ["ahrs", "dvl"], "ahrs_sd_deg": 1}, fix={"sd_m": 0.5}, calibration=RIGHT)
    return simulated(config, 240.0, 5, "lawnmower", fix_interval=2.0, ahrs_rate=10.0)


def said(
    dive: Simulated | SimpleNamespace,
    late: Callable[[Measurement], float] = lambda m: 0.0,
    wrong: Callable[[Measurement], Measurement] = lambda m: m,
    kind: str = "clock",
) -> dict[str, str]:
    """Texts by sensor, of wrong measurements that come as late as their stamps are; all events are of one kind."""
    stamped = [wrong(m)._replace(time=m.time + late(m)) for m in dive.log.measurements()]
    crosscheck = Crosscheck(dive.config)
    events = [event for m in sorted(stamped, key=lambda m: m.time) for event in crosscheck.add(m)]
    assert {event.kind for event in events} <= {kind}, events
    found: dict[str, str] = {}
    for event in events:
        found[event.source] = found.get(event.source, "") + event.text
    return found


def test_nothing_is_said_of_healthy_streams(dive):
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


def test_a_heading_that_the_fixes_contradict_is_said_once(dive):
    def turned(m: Measurement) -> Measurement:
        return (
            m._replace(values=m.values + np.array([0.5 * np.pi, 0.0, 0.0]))
            if m.sensor in ("ahrs", "dvl_heading")
            else m
        )

    text = said(dive, wrong=turned, kind="check")["dvl"]
    (angle,) = re.findall(r"turned by (-?\d+) deg", text)
    assert abs(int(angle) + 90) <= 5 and "heading or mounting is off" in text


def test_a_mirrored_axis_is_said_with_the_mounting_that_mends_it(dive):
    def mirrored(m: Measurement) -> Measurement:
        return m._replace(values=m.values * [1.0, -1.0, -1.0, 1.0, 1.0]) if m.sensor == "dvl" else m

    assert "dvl.mount_rpy_deg: [" in said(dive, wrong=mirrored, kind="check")["dvl"]


@pytest.fixture(scope="module")
def below_ship() -> SimpleNamespace:
    """Legs below a ship, with replies of which a tenth is 50 m off."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
    from acoustics import Setting
    from acoustics import below_ship as dive_below

    log, config = campaign_log(dive_below(Setting(seconds=110.0, outliers=0.1, round_ship=True), 3))
    return SimpleNamespace(log=log, config=config)


@pytest.mark.parametrize("seconds", [0.0, 2.0])
def test_acoustic_replies_that_nobody_stated_as_late_are_said_to_be(below_ship, seconds):
    found = said(below_ship, lambda m: seconds * (m.sensor == "usbl"))
    if not seconds:
        assert found == {}
        return
    entry = re.search(
        r"state delay_s: {usbl: ([\d.]+)}, or calibration.usbl_time_offset: {estimate: true", found["usbl"]
    )
    assert entry is not None and abs(float(entry[1]) - seconds) < 0.5
