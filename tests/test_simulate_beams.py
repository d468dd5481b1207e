"""A simulated DVL whose beams are stated measures beam by beam, and its velocity is theirs."""

import numpy as np
import pytest

import rovgraph as rg
from rovgraph.model.config import parse_config
from rovgraph.sensors.dvl_beam import BEAMS, beam_geometry, beam_sd, beams_of, velocity_by_beams
from rovgraph.simulate import Truth, scenario, simulate

HEAD = "beams: {angle_deg: 22.5, azimuth_deg: [135, 225, 315, 45], first_number: 0}"
STATED = parse_config(f"dvl: {{mount_rpy_deg: [0, 0, 45], lever_arm_m: [0.24, 0.0, 0.33], {HEAD}}}")
PLAIN = parse_config("dvl: {mount_rpy_deg: [0, 0, 45], lever_arm_m: [0.24, 0.0, 0.33]}")
DVL = ["dvl_vx", "dvl_vy", "dvl_vz"]


def dive_of(config, **keys):
    return simulate(scenario("falcon", 60.0, 0.4), Truth(config, **keys), np.random.default_rng(3))


def pings(dive):
    """Velocities of the instrument, shape (n, 3), and its beams."""
    log = rg.Log.from_frame(dive.log_frame)
    return log["dvl"].data[:, :3], beams_of(log.streams[BEAMS].data)


def test_nothing_but_the_velocity_changes_where_beams_are_stated():
    stated, plain = dive_of(STATED).log_frame, dive_of(PLAIN).log_frame
    single = [c for c in stated if c.startswith("dvl_beam_")]
    assert single and not [c for c in plain if c.startswith("dvl_beam_")]
    others = [c for c in plain if c not in DVL]
    np.testing.assert_array_equal(stated[others].to_numpy(float), plain[others].to_numpy(float))


def test_without_noise_beams_and_velocity_agree_with_a_dvl_that_has_no_beams():
    velocity, beams = pings(dive_of(STATED, noise=False))
    np.testing.assert_allclose(velocity, pings_of_plain(), rtol=0.0, atol=1e-9)
    directions = beam_geometry(STATED.dvl).directions
    np.testing.assert_allclose(beams.velocity, velocity @ directions.T, rtol=0.0, atol=1e-9)


def pings_of_plain():
    return rg.Log.from_frame(dive_of(PLAIN, noise=False).log_frame)["dvl"].data[:, :3]


def test_beams_have_the_noise_that_is_stated_and_the_velocity_is_of_the_same_ping():
    velocity, beams = pings(dive_of(STATED))
    again, error = velocity_by_beams(beam_geometry(STATED.dvl).directions, beams.velocity, beams.valid)
    np.testing.assert_allclose(again, velocity, rtol=0.0, atol=1e-9)
    hidden = 0.1 * np.deg2rad(1.0) * 0.6  # angles are off by their priors, too
    assert np.sqrt(np.mean(error**2)) == pytest.approx(np.hypot(beam_sd(STATED.dvl), hidden), rel=0.12)


def test_a_beam_whose_angle_is_off_measures_along_where_it_points():
    off = np.deg2rad(1.0)
    dive = dive_of(STATED, noise=False, calibration={"dvl_beam_2_angle": np.array([off])})
    _, beams = pings(dive)
    true, geometry = pings_of_plain(), beam_geometry(STATED.dvl)
    expected = true @ (geometry.directions + off * np.eye(4)[2][:, None] * geometry.tilts).T
    np.testing.assert_allclose(beams.velocity, expected, rtol=0.0, atol=1e-9)
    assert dive.hidden["calibration"]["dvl_beam_2_angle"] == off
    assert "dvl_beam_4_angle" not in dive.hidden["calibration"]  # of a head of four, 0 to 3


def test_ranges_reach_a_level_bottom():
    dive = dive_of(STATED, noise=False)
    _, beams = pings(dive)
    motion = dive.path.motion(rg.Log.from_frame(dive.log_frame)["dvl"].time)
    R_bs = np.array([[1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 2.0**0.5]]) / 2.0**0.5
    down = np.einsum("ni,ki->nk", motion.R_nb[:, 2], beam_geometry(STATED.dvl).directions @ R_bs.T)
    place = motion.p_n[:, 2] + motion.R_nb[:, 2] @ np.array([0.24, 0.0, 0.33])
    depth = place[:, None] + beams.range * down
    np.testing.assert_allclose(depth, depth[0, 0], rtol=0.0, atol=1e-6)


def test_lost_pings_have_no_beams():
    dive = dive_of(STATED, dropouts=((20.0, 30.0),))
    log = rg.Log.from_frame(dive.log_frame)
    stream = log.streams[BEAMS]
    lost = (stream.time >= 20.0) & (stream.time <= 30.0)
    beams = beams_of(stream.data)
    assert lost.any() and not beams.valid[lost].any() and beams.valid[~lost].all()
    assert np.isnan(beams.velocity[lost]).all()


def test_the_files_of_a_dive_have_its_beams_beside_the_log(tmp_path):
    made = rg.simulate("straight", STATED, 1, rg.Choices(duration=40.0))
    made.save(tmp_path / "dive")
    log = rg.read_log(tmp_path / "dive" / "log.csv", rg.load_config(tmp_path / "dive" / "config.yaml"))
    assert "dvl_beam_velocity_0" not in (tmp_path / "dive" / "log.csv").read_text(encoding="utf-8").splitlines()[0]
    np.testing.assert_allclose(log.streams[BEAMS].data, made.log.streams[BEAMS].data, rtol=0.0, atol=6e-5)
