"""One table of calibration variables serves configuration, models, keys and simulator."""

import re
from pathlib import Path

import numpy as np
import pytest

from rovgraph.errors import InputError
from rovgraph.inference.graph.values import key, key_name
from rovgraph.model.calibration import BEACONS, CHART, CHART_PLACE, TABLE
from rovgraph.model.config import Config, beliefs, parse_config, with_priors_stated
from rovgraph.model.state import DIMENSION
from rovgraph.problem.calibration_roles import unknowns
from rovgraph.problem.motion import SCALES
from rovgraph.sensors.instruments import Instrument, instruments


def every_instrument(one_way: bool) -> dict[str, Instrument]:
    """With as many beacons as a dive may have, on a vehicle that sees them."""
    beacons = [{"name": k} for k in range(BEACONS)]
    return instruments(Config().changed(beacons=beacons, usbl={"head": "vehicle"}, range={"one_way": one_way}))


def test_every_variable_is_named_by_a_measurement_model():
    every = [i for one_way in (False, True) for i in every_instrument(one_way).values()]
    named = {name for i in every for name in i.calibration}
    assert named | {*SCALES, CHART_PLACE} == set(TABLE)  # soundings show the place of a chart (inference.crossovers)


def test_every_variable_belongs_to_a_sensor_that_names_it():
    clocks = every_instrument(True)
    sensors = every_instrument(False)
    for name, variable in TABLE.items():
        assert variable.sensors
        for sensor in set(variable.sensors) - {"imu", CHART}:
            assert name in (*sensors[sensor].calibration, *clocks[sensor].calibration)


def test_the_manual_says_of_every_variable_what_it_is_and_what_shows_it():
    manual = (Path(__file__).parents[1] / "docs" / "calibration-variables.md").read_text(encoding="utf-8")
    for v in TABLE.values():
        assert f"| `{v.name}` |" in manual and v.about in manual and v.excited_by in manual, v.name


def test_a_variable_is_estimated_only_where_a_sensor_that_shows_it_is_in_use():
    believed = beliefs(parse_config("calibration: {dvl_yaw: {estimate: true}, depth_offset: {estimate: true}}"))
    assert "depth_offset" not in unknowns(believed, {"dvl"}).estimated
    assert {"dvl_yaw", "current"} <= set(unknowns(believed, {"dvl_water"}).estimated)
    assert "current" not in unknowns(believed, {"dvl", "depth"}).estimated


def test_letters_are_unique_and_none_is_a_state_variables():
    letters = [v.letter for v in TABLE.values()]
    assert len(set(letters)) == len(letters)
    assert not {"x", "v", "b", "n"} & set(letters)
    assert all(len(letter) == 1 for letter in letters)


def test_labels_of_all_components_are_unique():
    labels = [label for v in TABLE.values() for label in v.labels]
    assert len(set(labels)) == len(labels) == sum(v.dim for v in TABLE.values())


@pytest.mark.parametrize("variable", [*DIMENSION, *TABLE])
def test_keys_are_told_apart_in_words(variable):
    index = 12 if variable in DIMENSION else 0
    said = key_name(key(variable, index))
    assert said == (f"{variable} of keyframe 12" if variable in DIMENSION else variable)


def test_defaults_of_the_table_are_the_beliefs_of_an_empty_configuration():
    for name, belief in beliefs(Config()).items():
        assert belief.variable is TABLE[name]
        assert belief.estimate == TABLE[name].estimate
        np.testing.assert_allclose(belief.sd, TABLE[name].sd, rtol=1e-9)
        np.testing.assert_array_equal(belief.mean, np.zeros(TABLE[name].dim))


def test_mean_of_the_mounting_angles_is_the_mounting_unless_it_is_given():
    config = parse_config(
        "dvl: {mount_rpy_deg: [180, -2, 45]}\n"
        "calibration: {dvl_pitch: {mean_deg: 3}, hard_iron: {mean: [0.1, 0.2, 0.3]}, ahrs_deviation: {mean_deg: 2}}"
    )
    b = beliefs(config)
    means = [float(np.rad2deg(b[name].mean[0])) for name in ("dvl_roll", "dvl_pitch", "dvl_yaw")]
    np.testing.assert_allclose(means, [180, 3, 45])
    np.testing.assert_allclose(b["hard_iron"].mean, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(b["ahrs_deviation"].mean, np.deg2rad([2, 2]))


def test_a_mean_with_the_wrong_number_of_components_names_its_key():
    with pytest.raises(InputError, match=re.escape("own.yaml: calibration.hard_iron.mean: expected one number or thr")):
        parse_config("calibration: {hard_iron: {mean: [0.1, 0.2]}}", "own.yaml")


@pytest.mark.parametrize(
    "stated",
    [
        "usbl: {frame: ship}",
        "dvl: {sound_speed_set_mps: 1500, sound_speed_mps: 1480}",
        "beacons: [{name: a, north_m: 1, east_m: 2, sd_m: 3, down_m: 40, down_sd_m: 0.5}]",
    ],
)
def test_priors_that_follow_from_other_keys_are_those_of_the_effective_configuration(stated):
    config = parse_config(stated)
    usual, again = beliefs(Config()), beliefs(parse_config(with_priors_stated(config).to_yaml()))
    moved = {name: b.sd for name, b in beliefs(config).items() if b.sd != usual[name].sd}
    assert len(moved) > 0
    assert {name: again[name].sd for name in moved} == pytest.approx(moved, rel=1e-9)
