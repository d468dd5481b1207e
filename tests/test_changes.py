"""Errors that change at once, a bottom that moves, and explanations that are as clear as others."""

import re
from dataclasses import replace

import numpy as np
import pytest
from dives import Simulated, altered, batch, changed, falcon, kept, simulated, true_at, without

from rovgraph.diagnosis.check import examine
from rovgraph.dive import _covering, smooth
from rovgraph.geometry import rotate, transpose
from rovgraph.inference.error_state import replay
from rovgraph.inference.filter import FilterEngine
from rovgraph.inference.initialise import initialise
from rovgraph.inference.smoother import assemble, smoothed
from rovgraph.inference.widened_chain import lasting_belief
from rovgraph.log import STREAMS, Log, Stream
from rovgraph.model.calibration import LAYOUT
from rovgraph.model.config import mount_matrix
from rovgraph.problem.initial_conditions import Beliefs

SHORT = {"dvl_rate": 3.0, "imu_rate": 50.0, "start_error": True}
AT = 70.0
HONEST = 4.5  # mean squared error per component, in sds: an honest dive exceeds it once in a hundred


def stepped(log: Log, sensor: str, step: tuple[float, ...]) -> Log:
    """A log whose sensor is off by so much from `AT` on."""
    stream = log[sensor]
    data = stream.data.copy()
    data[stream.time >= AT, : len(step)] += step
    return altered(log, sensor, data)


def nees(case: Simulated, dive, kind: str, columns: slice) -> float:
    """Mean squared error of position components over the dive, in sds."""
    t = next(e for e in dive.estimates if e.kind == kind).trajectory
    off, P = (t.p_n - true_at(case, t.time).p_n)[:, columns], t.cov_p[:, columns, columns]
    return float(np.mean(np.einsum("ni,ni->n", off, np.linalg.solve(P, off[..., None])[..., 0])) / off.shape[1])


def revealed(dive) -> dict[str, dict]:
    """What was found, by its key in the configuration."""
    return {one["key"].removeprefix("calibration."): one for one in dive.estimates[0].summary.get("noise_found", [])}


@pytest.fixture(scope="module")
def case() -> Simulated:
    config = falcon(fix={"sd_m": 0.3}, heading={"sources": ["ahrs"]})
    return simulated(config, 140.0, 3, "lawnmower", fix_interval=1.0, ahrs_rate=5.0, **SHORT)


@pytest.mark.parametrize(
    ("sensor", "variable", "step", "said"),
    [
        ("depth", "depth_error", (1.5,), r"at 70 s by \+1\.[45]"),
        ("depth", "depth_error", (-0.4,), r"at 70 s by -0\.(39|4)"),
        ("ahrs", "ahrs_error", (np.deg2rad(15.0),), r"at 70 s by \+1[3-7]"),
        ("fix", "fix_error", (6.0, -4.0), r"at 70 s by \+[56].*, -[34]"),
    ],
)
def test_a_change_is_found_with_its_time_and_size_and_bridged(case, sensor, variable, step, said):
    dive = smooth(stepped(case.log, sensor, step), case.config)
    assert set(revealed(dive)) == {variable}
    belief = dive.initial.revealed.calibration[variable]
    assert belief.changes[0] == pytest.approx(AT, abs=2.0)
    for kind in ("smoothed", "filtered"):
        for columns in (slice(0, 2), slice(2, 3)):
            assert nees(case, dive, kind, columns) < HONEST
    assert re.search(said, revealed(dive)[variable]["text"])


def test_a_healthy_dive_has_no_change(case):
    assert revealed(smooth(case.log, case.config)) == {}


@pytest.fixture(scope="module")
def changing(case):
    """Smoother and filter of a dive whose fixes are off by another value from `AT` on."""
    log = stepped(case.log, "fix", (6.0, -4.0))
    initial = initialise(log, case.config)
    belief = lasting_belief(initial.beliefs["fix_error"], 5.0, np.inf, (AT,))
    dive = assemble(log, initial.believing(Beliefs({"fix_error": belief})))
    return dive, dive.optimum()


def test_what_changes_is_constant_before_and_after(case, changing):
    dive, best = changing
    path, late = best.state.calibration["fix_error"], dive.problem.time >= AT
    assert np.ptp(path[~late], axis=0).max() < 0.01 and np.ptp(path[late], axis=0).max() < 0.01
    np.testing.assert_allclose(path[late][0] - path[~late][0], [6.0, -4.0], atol=0.7)
    sd = np.sqrt(best.covariances()["fix_error"][:, 0, 0])
    assert sd[~late].max() < 0.01 < 0.05 < sd[late].min()  # it begins at its mean


def test_the_filter_opens_where_the_smoother_does(changing):
    dive, best = changing
    end = replay(dive.problem, dive.initial).known
    own = FilterEngine(dive.initial).layout.columns["fix_error"]
    sd = np.sqrt(np.diag(best.covariances()["fix_error"][-1]))
    np.testing.assert_allclose(np.sqrt(np.diag(end.P[own, own])), sd, rtol=0.05)
    there = best.state.calibration["fix_error"][-1]
    assert (np.abs(end.c[LAYOUT["fix_error"]] - there) < 0.5 * sd).all()


def over_a_moving_bed(case: Simulated, velocity_n: tuple[float, float]) -> Log:
    """A log whose DVL sees a bottom that moves."""
    dvl, R_bs = case.log["dvl"], mount_matrix(case.config.dvl.mount_rpy_deg)
    data = dvl.data.copy()
    data[:, :3] -= rotate(transpose(true_at(case, dvl.time).R_nb), np.array([*velocity_n, 0.0])) @ R_bs
    return altered(case.log, "dvl", data)


@pytest.mark.slow
@pytest.mark.parametrize("velocity_n", [(0.2, -0.25), (0.05, 0.05)])
def test_a_bed_that_moves_is_found_where_fixes_show_it_and_they_are_believed(case, velocity_n):
    """All the time: before it is found, every fix is rejected."""
    dive = smooth(over_a_moving_bed(case, velocity_n), case.config)
    assert set(revealed(dive)) == {"bottom_velocity"}
    assert (dive.verdict, dive.alarms[0].kind, dive.alarms[0].sensor) == ("doubtful", "found", "dvl")
    for kind in ("smoothed", "filtered"):
        assert nees(case, dive, kind, slice(0, 2)) < HONEST


def as_boat(log: Log) -> Log:
    """The log of a vessel that has neither IMU nor depth, and rolls and pitches by what it says itself."""
    ahrs = log["ahrs"]
    own = {
        name: Stream(name, STREAMS[name], ahrs.time, ahrs.data[:, columns], ahrs.row)
        for name, columns in (("vehicle_heading", slice(0, 1)), ("vehicle_tilt", slice(1, 3)))
    }
    bare = without(log, "imu", "ahrs", "mag", "depth", "dvl_heading")
    return replace(bare, streams={**bare.streams, **own})


def test_a_boat_says_that_its_bed_may_move_unless_the_configuration_holds_it(case):
    config = changed(case.config, heading={"sources": ["vehicle"]})
    log = as_boat(over_a_moving_bed(case, (0.2, -0.25)))
    boat = initialise(log, config)
    assert boat.beliefs["bottom_velocity"].estimate is True and boat.config.motion.acc == 0.5
    assert any("it is a boat, under which the bed may move" in line for line in boat.assumptions)
    held = initialise(log, changed(config, calibration={"bottom_velocity": {"estimate": False}}))
    assert not held.beliefs["bottom_velocity"].estimate and held.config.motion.acc == 0.1
    stated = initialise(log, changed(config, motion={"acc": 0.2}))
    assert stated.config.motion.acc == 0.2


def test_a_boat_over_a_moving_bed_follows_its_fixes_and_is_honest_after_they_end(case):
    config = changed(case.config, heading={"sources": ["vehicle"]})
    log = as_boat(over_a_moving_bed(case, (0.2, -0.25)))
    dive = smooth(log, config)
    assert nees(case, dive, "smoothed", slice(0, 2)) < HONEST
    fix = log["fix"]
    ended = smooth(kept(log, "fix", fix.time < AT), config)
    assert nees(case, ended, "smoothed", slice(0, 2)) < HONEST


def test_the_sd_covers_where_rivals_put_the_track(case):
    dive = batch(case.log, case.config)
    best = dive.optimum()
    estimate = smoothed(best, dive.initial)
    elsewhere = best.state.p_n + np.array([3.0, -4.0, 0.0])
    wide = _covering(estimate, [elsewhere], best)
    more = wide.trajectory.cov_p - estimate.trajectory.cov_p
    np.testing.assert_allclose(more[:, :2, :2], np.broadcast_to([[9.0, -12.0], [-12.0, 16.0]], (len(more), 2, 2)))
    assert not more[:, 2].any() and not more[:, :, 2].any()


def test_a_bed_that_moves_is_no_turned_dvl_to_the_check(case):
    """A turn explains fixes down to their noise, a bottom that moves leaves a multiple of it."""
    moving = examine(over_a_moving_bed(case, (0.2, -0.25)), case.config)
    (found,) = [f for f in moving.at("warning") if f.sensor == "dvl"]
    assert found.kind == "contradiction" and "the bottom moves, or the fixes wander" in found.text
    turned = changed(case.config, dvl={"mount_rpy_deg": [180, 0, 90]})
    (found,) = [f for f in examine(case.log, turned).at("warning") if f.kind == "turned"]
    assert "its track fits the fixes when turned by -" in found.text
