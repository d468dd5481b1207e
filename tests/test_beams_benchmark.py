"""The independent simulator of a DVL's beams: geometry, footprint, and what the instrument makes of them."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from fault_campaign.beams import Beams, Bottom, Head, bias, log_columns, lose, ping, refuse, solve
from fault_campaign.motion import mounting
from fault_campaign.scenarios import make_motion
from fault_campaign.vehicle import make_vehicle

PERFECT = Head(sd=0.0, range_sd=0.0, error_sd=0.0, bias_sd=0.0)


def pings(beams: Beams, scale: float = 0.0):
    motion = replace(make_motion("survey", np.random.default_rng(1)), duration=60.0)
    vehicle = make_vehicle("mti", ())
    made = ping(motion, vehicle, beams, mounting((0.0, 0.0, -45.0)), scale, np.random.default_rng(2))
    arm = np.asarray(vehicle.dvl.arm)
    true = (motion.v_b(made.time) + np.cross(motion.rate_nb_b(made.time), arm)) @ mounting((0.0, 0.0, -45.0))
    return made, true


@pytest.mark.parametrize(
    ("altitude", "flat", "slope"), [(5.0, -0.28, -0.32), (20.0, -0.40, -0.46), (40.0, -0.55, -0.64)]
)
def test_wide_beams_measure_too_little_speed_and_the_less_the_higher_they_are(altitude, flat, slope):
    """In percent of the speed, of beams of 4.4 deg over a level bottom and along one of 20 deg."""
    head = replace(PERFECT, width=4.6)
    axes = head.axes()
    for angle, percent in ((0.0, flat), (20.0, slope)):
        normal = np.array([-np.sin(np.deg2rad(angle)), 0.0, np.cos(np.deg2rad(angle))])
        along = head.echo(axes, np.tile(normal, (4, 1)), altitude * normal[2] / (axes @ normal)) @ [1.0, 0.0, 0.0]
        assert 100.0 * (np.linalg.pinv(axes) @ along - 1.0)[0] == pytest.approx(percent, abs=0.07)


def test_a_perfect_head_measures_the_velocity_and_its_ranges_reach_the_bottom():
    bottom = Bottom(12.0, 3.0, 60.0, 0.4)
    made, true = pings(Beams(PERFECT, bottom), scale=0.02)
    velocity, error, good = solve(made, PERFECT)
    np.testing.assert_allclose(velocity, 1.02 * true, rtol=0.0, atol=1e-12)
    assert good.all() and error.max() < 1e-12
    level, _ = pings(Beams(PERFECT, Bottom(12.0)))
    above = level.range[level.time < 30.0].mean(axis=1) * np.cos(np.deg2rad(22.5))
    np.testing.assert_allclose(above, 9.7, rtol=0.0, atol=0.05)


def test_three_beams_give_a_velocity_two_give_none_and_a_biased_one_is_refused():
    faults = lose((0,), 10.0, 20.0), lose((1,), 15.0, 20.0), bias(2, 0.3, 30.0, 40.0)
    made, true = pings(Beams(PERFECT, faults=faults))
    velocity, _, good = solve(made, PERFECT)
    t = made.time
    np.testing.assert_array_equal(good, ~((t >= 15.0) & (t < 20.0)) & ~((t >= 30.0) & (t < 40.0)))
    np.testing.assert_allclose(velocity[good], true[good], rtol=0.0, atol=1e-12)
    table = log_columns(made, PERFECT)
    two = (t >= 15.0) & (t < 20.0)
    assert table.loc[two, "dvl_vx"].isna().all() and table.loc[two, "dvl_beam_velocity_3"].notna().all()


def test_refused_pings_are_far_off_and_call_their_beams_valid():
    made, true = pings(Beams(PERFECT, faults=(refuse(0.2, PERFECT),)))
    velocity, _, good = solve(made, PERFECT)
    assert made.refused.any() and not good[made.refused].any()
    four = made.refused & made.valid.all(axis=1)
    off = np.linalg.norm((velocity - true)[four], axis=1)
    assert 0.5 < four.sum() / made.refused.sum() < 0.9 and np.median(off) > 0.1
