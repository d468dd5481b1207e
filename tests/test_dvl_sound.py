"""A DVL's velocities and ranges are made as if it had known the speed of sound, on reading and live alike."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import rovgraph as rg
from rovgraph.live.intake import Intake
from rovgraph.live.message import Reading
from rovgraph.log import Log
from rovgraph.log.companions import beams_of_table
from rovgraph.log.tables import table_of_arrays
from rovgraph.model.config import Config, beliefs, parse_config
from rovgraph.sensors import SENSORS
from rovgraph.sensors.dvl_beam import PHASED_C0, beam_geometry, beams_of, velocity_by_beams
from rovgraph.sensors.sound import sound_speed

DATA = Path(__file__).parents[2] / "shared" / "data"
HEAD = "beams: {angle_deg: 30, azimuth_deg: [270, 90, 0, 180]"
V = np.array([1.5, -0.2, 0.1])


def test_the_speed_of_sound_is_that_of_the_published_check_values():
    assert sound_speed(40.0, 40.0, 1000.0 / 0.10198) == pytest.approx(1731.995, abs=1e-3)  # UNESCO 44, p. 49
    assert sound_speed(0.0, 20.0, 0.0) == pytest.approx(1482.34, abs=0.01)


def log(config: Config, **more: object) -> Log:
    """Ten pings of one velocity, its ranges 10 m, with depths."""
    time = np.arange(10.0)
    dvl = np.column_stack([np.tile(V, (10, 1))])
    return Log.from_arrays(
        time=time, dvl=dvl, dvl_altitude=np.full(10, 10.0), depth=np.linspace(0.0, 90.0, 10), config=config, **more
    )


def test_pistons_follow_the_ratio_of_the_speeds():
    read = log(parse_config("dvl: {sound_speed_set_mps: 1500, sound_speed_mps: 1470}"))
    np.testing.assert_allclose(read["dvl"].data[:, :3], 0.98 * np.tile(V, (10, 1)), rtol=1e-12)
    np.testing.assert_allclose(read["dvl_altitude"].data[:, 0], 9.8, rtol=1e-12)


@pytest.mark.parametrize("text", ["{sound_speed_mps: 1470}", "{sound_speed_set_mps: 1500}", "{}"])
def test_nothing_is_corrected_where_either_speed_is_unknown(text):
    np.testing.assert_array_equal(log(parse_config(f"dvl: {text}"))["dvl"].data[:, :3], np.tile(V, (10, 1)))


def test_a_phased_array_keeps_its_horizontal_velocity():
    text = f"{{dvl: {{sound_speed_set_mps: 1500, sound_speed_mps: 1450, {HEAD}, phased: true}}}}}}"
    read = log(parse_config(text))
    np.testing.assert_array_equal(read["dvl"].data[:, :2], np.tile(V[:2], (10, 1)))
    np.testing.assert_allclose(read["dvl"].data[:, 2] / V[2], 0.9569, atol=5e-5)  # printed in the Pathfinder Guide
    down = 1450.0 / 1500.0 * 2.0 / np.sqrt(3.0) * np.sqrt(1.0 - (1450.0 / (2.0 * PHASED_C0)) ** 2)
    np.testing.assert_allclose(read["dvl_altitude"].data[:, 0], 10.0 * down, rtol=1e-12)


@pytest.mark.parametrize("phased", [False, True])
def test_beams_give_the_true_velocity_whatever_speed_the_dvl_worked_with(phased):
    """Doppler shifts at 1460 m/s; the instrument divides by 1500 m/s, and a phased array's beams stand steeper."""
    c, c_set = 1460.0, 1500.0
    text = f"{{dvl: {{sound_speed_set_mps: {c_set}, sound_speed_mps: {c}, {HEAD}, phased: {str(phased).lower()}}}}}}}"
    config = parse_config(text)
    angle = np.arcsin(c / (2.0 * PHASED_C0)) if phased else np.pi / 6.0
    around = np.deg2rad([270.0, 90.0, 0.0, 180.0])
    d = np.column_stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.full(4, np.cos(angle))])
    columns = {f"velocity_{k + 1}": np.full(10, c_set / c * (d[k] @ V)) for k in range(4)}
    columns |= {"range_1": np.full(10, 10.0)}
    stream = beams_of_table(table_of_arrays([{"time": np.arange(10.0), **columns}], "time", "beams"), config)
    beams = beams_of(log(config).with_beams(stream)["dvl_beams"].data)
    v, _ = velocity_by_beams(beam_geometry(config.dvl).directions, beams.velocity, beams.valid)
    np.testing.assert_allclose(v, np.tile(V, (10, 1)), rtol=1e-9)
    np.testing.assert_allclose(beams.range[:, 0], 10.0 * c / c_set, rtol=1e-12)


TABLES = {
    "profile": "{dvl: {sound_speed_set_mps: 1500}, sound: {profile: [[0, 1480], [100, 1460]]}}",
    "salinity": "{dvl: {sound_speed_set_mps: logged}, sound: {salinity_psu: 35}}",
}


@pytest.mark.parametrize("text", TABLES.values(), ids=TABLES.keys())
def test_live_measurements_are_corrected_as_those_of_a_log(text):
    config = parse_config(text)
    time = np.arange(10.0)
    sound = {"dvl_sound_speed": np.linspace(1490.0, 1510.0, 10), "water_temperature": np.linspace(14.0, 5.0, 10)}
    whole = Log.from_arrays(
        {"time": time, "depth": np.linspace(0.0, 90.0, 10), **sound}, time=time, dvl=np.tile(V, (10, 1)), config=config
    )
    intake = Intake(config, Counter())
    for k in range(10):
        intake.measurement(time[k], Reading("dvl_sound", np.array([column[k] for column in sound.values()])))
        intake.measurement(time[k], Reading("depth", np.array([10.0 * k])))
        ping = intake.measurement(time[k], Reading("dvl", np.array([*V, 1.0, np.nan])))
        np.testing.assert_allclose(ping.values[:3], whole["dvl"].data[k, :3], rtol=1e-12)
    c = sound_speed(35.0, 5.0, 90.0) / 1510.0 if "logged" in text else 1462.0 / 1500.0
    assert whole["dvl"].data[-1, 0] == pytest.approx(c * V[0], rel=1e-12)


def test_the_prior_of_the_scale_shrinks_where_the_speed_of_sound_is_known_and_none_is_stated():
    known = "sound_speed_set_mps: 1500, sound_speed_mps: 1470"
    assert beliefs(parse_config(f"dvl: {{{known}}}"))["dvl_scale"].sd == 0.003
    assert beliefs(parse_config("dvl: {sound_speed_set_mps: 1500}"))["dvl_scale"].sd == 0.02
    stated = parse_config(f"{{dvl: {{{known}}}, calibration: {{dvl_scale: {{sd: 0.01}}}}}}")
    assert beliefs(stated)["dvl_scale"].sd == 0.01


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("dvl: {sound_speed_set_mps: 4900}", "from 1300 to 1700 m/s; if it is in ft/s, state 1494"),
        ("dvl: {sound_speed_set_mps: measured}", "dvl.sound_speed_set_mps: expected a speed in m/s, or logged"),
        ("dvl: {sound_speed_mps: 150}", "dvl.sound_speed_mps: expected a speed of sound from 1300 to 1700 m/s"),
        ("sound: {salinity_psu: 50}", "sound.salinity_psu"),
    ],
)
def test_a_speed_that_no_water_has_is_refused_in_one_line(text, said):
    with pytest.raises(rg.InputError) as caught:
        parse_config(text)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_remus_is_two_percent_slower_than_its_dvl_believed():
    path = DATA / "remus600_pd0" / "adcp.adc.gz"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    corrected = rg.read_log([path])
    believed = rg.read_log([path], parse_config("dvl: {sound_speed_mps: 1500}"))
    fast = np.abs(believed["dvl"].data[:, :3]) > 0.5
    ratio = corrected["dvl"].data[:, :3][fast] / believed["dvl"].data[:, :3][fast]
    assert ratio.min() == pytest.approx(0.976, abs=5e-4) and ratio.max() == pytest.approx(0.981, abs=5e-4)
    assert 0.976 <= np.median(ratio) <= 0.981


def test_a_logged_speed_in_feet_is_named_and_never_corrects():
    config, time = parse_config("dvl: {sound_speed_set_mps: logged, sound_speed_mps: 1470}"), np.arange(10.0)
    read = Log.from_arrays(
        {"time": time, "dvl_sound_speed": np.full(10, 4921.0)}, time=time, dvl=np.tile(V, (10, 1)), config=config
    )
    np.testing.assert_array_equal(read["dvl"].data[:, :3], np.tile(V, (10, 1)))
    (said,) = SENSORS["dvl_sound"].look(read["dvl_sound"].data, config)
    assert said[0] == "error"
    assert "state units: {dvl_sound_speed: ft/s}" in said[1]
