"""The peers of benchmarks/peers.py: frames, arms and signs of what a person would write."""

import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import peers
from fault_campaign.instruments import log_table, sample
from fault_campaign.scenarios import make_motion
from fault_campaign.vehicle import configuration, make_vehicle

from rovgraph.inference.trajectory import Trajectory
from rovgraph.lab.evaluate import evaluate
from rovgraph.log import Log
from rovgraph.model.config import Config

TURNED_DEG, SECONDS = 3.0, 60.0


def perfect(aids, turned_deg):
    """A minute of a survey with instruments without errors, but a DVL that is turned by as much."""
    rng = np.random.default_rng(1)
    vehicle = make_vehicle("tactical", aids)
    config = Config.model_validate(configuration(vehicle))
    for name in ("acc_noise", "gyr_noise", "acc_walk", "gyr_walk", "acc_bias_sd", "gyr_bias_sd", "matrix_sd"):
        setattr(vehicle.imu, name, 0.0)
    for compass in (vehicle.ahrs, vehicle.mag, vehicle.dvl_heading):
        compass.sd = compass.offset_sd = compass.curve_sd = 0.0
    vehicle.field.hard_iron_sd = vehicle.depth.sd = vehicle.dvl.yaw_sd = vehicle.fix.sd = 0.0
    vehicle.dvl.sd = (0.0, 0.0, 0.0)
    roll, pitch, yaw = vehicle.dvl.mount_rpy_deg
    vehicle.dvl.mount_rpy_deg = (roll, pitch, yaw + turned_deg)
    motion = replace(make_motion("survey", rng), duration=SECONDS)
    streams, _ = sample(motion, vehicle, rng)
    t = np.arange(0.0, motion.duration, 1.0)
    truth = Trajectory.certain(t, motion.local(t), motion.C_nb(t), motion.v_n(t))
    return peers.Measured(config, Log.from_frame(log_table(streams), config)), truth


@pytest.mark.parametrize(("compass", "heading_deg"), [("ahrs", 1.0), ("dvl_heading", 1.0), ("mag", 2.5)])
def test_perfect_instruments_give_the_true_track(compass, heading_deg):
    """By a magnetometer where the field is steep, the heading errs three times as much as the tilt."""
    given, truth = perfect((compass, "depth"), 0.0)
    for track in (peers.dead_reckoning(given), peers.Graph(given, misaligned=True).solve()):
        metrics = evaluate(track, truth, 5.0)
        assert metrics.distance_m > 8.0
        assert metrics.rms_m < 0.1
        assert metrics.heading_rms_deg < heading_deg


def test_the_misalignment_is_found_with_fixes():
    given, truth = perfect(("ahrs", "depth", "fix"), TURNED_DEG)
    graph = peers.Graph(given, misaligned=True)
    found = graph.solve()
    assert np.rad2deg(graph.values.atVector(peers.M))[0] == pytest.approx(TURNED_DEG, abs=0.3)
    plain = peers.Graph(given, misaligned=False).solve()
    assert evaluate(found, truth, 5.0).rms_m < 0.1 < evaluate(plain, truth, 5.0).rms_m
    as_it_goes = peers.Incremental(given, misaligned=True).solve()
    assert evaluate(as_it_goes, truth, 5.0).rms_m < 0.1
    np.testing.assert_allclose(as_it_goes.p_sd[-1, :2], found.p_sd[-1, :2], rtol=0.1)  # linearised elsewhere


def test_lines_are_counted_without_comments_and_docstrings():
    assert peers.lines_of("rovgraph") == 3
    assert 70 < peers.lines_of("dead reckoning") < peers.lines_of("plain GTSAM") < 300


@pytest.mark.slow
@pytest.mark.skipif(find_spec("pyins") is None, reason="pip install python-ins")
def test_pyins_gets_the_true_track_of_perfect_instruments():
    given, truth = perfect(("ahrs", "depth"), 0.0)
    assert evaluate(peers.pyins_filter(given, turning_earth=True), truth, 5.0).rms_m < 0.1
