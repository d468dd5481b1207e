"""What limits a track: the split of its variance is whole, and names the cause where it is known."""

import re
from dataclasses import replace

import pytest

import rovgraph as rg
from rovgraph.inference.initialise import initialise
from rovgraph.inference.score_test import score_test
from rovgraph.inference.smoother import assemble
from rovgraph.inference.variance_sources import variance_sources
from rovgraph.model.state import POSE
from rovgraph.report.pages.reporting import page_of
from rovgraph.report.pages.verdict import CAUSES, largest_cause
from rovgraph.sensors import SENSORS


def simulated(**choices):
    return rg.simulate("lawnmower", seed=4, choices=rg.Choices(duration=60, **choices))


def verdict_page(tmp_path, dive, config=None):
    rg.smooth(dive.log, config or dive.config).save(tmp_path / "out", figures=False)
    return re.sub(r"<[^>]+>", "", page_of(tmp_path / "out"))  # as it is read


def with_part(config, part, **keys):
    return config.model_copy(update={part: getattr(config, part).model_copy(update=keys)})


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_the_parts_add_up_to_the_variance_anywhere_in_the_dive(share):
    dive = simulated()
    best = assemble(dive.log, initialise(dive.log, dive.config)).optimum(None)
    k = int(share * (len(best.problem) - 1))
    R = best.state.R_nb[k]
    P = R @ best.covariances()[POSE][k][3:6, 3:6] @ R.T
    assert sum(variance_sources(best, k).values()) == pytest.approx(P[0, 0] + P[1, 1], rel=1e-5)


def test_a_dive_in_pieces_is_a_whole_dive(monkeypatch):
    dive = simulated()
    best = assemble(dive.log, initialise(dive.log, dive.config)).optimum(None)
    released = "gyr_scale", "dvl_time_offset", "mag_time_offset"
    again = replace(best)  # whose score tests are not known yet
    whole = variance_sources(best, 100), score_test(best, released)
    monkeypatch.setattr("rovgraph.problem.measurements.LENGTH", 64)
    assert (variance_sources(again, 100), score_test(again, released)) == whole


def test_a_start_known_to_ten_metres_limits_a_dive_without_fixes(tmp_path):
    dive = simulated()
    vague = with_part(dive.config, "start", position_sd_m=10.0)
    assert "What limits it: the position at the start:" in verdict_page(tmp_path, dive, vague)


def test_poor_compasses_limit_a_dive(tmp_path):
    dive = simulated()
    for name in ("mag_offset", "dvl_compass_offset"):
        own = getattr(dive.config.calibration, name)
        assert own.sd_deg
        poor = with_part(dive.config, "calibration", **{name: own.model_copy(update={"sd_deg": 20.0})})
        dive = replace(dive, config=poor)
    assert "What limits it: the heading (compasses and their calibration):" in verdict_page(tmp_path, dive)


def test_a_long_loss_of_lock_limits_a_dive(tmp_path):
    page = verdict_page(tmp_path, simulated(dropouts=((15.0, 50.0),)))
    assert "What limits it:" in page
    assert "without a velocity from the DVL" in page


def test_every_sensor_but_depth_belongs_to_a_cause():
    vertical = {"depth", "pressure", "dvl_altitude", "vehicle_tilt", "place"}
    for sensor in {*SENSORS} - vertical:
        assert any(sensor.startswith(cause.sources) for cause in CAUSES), sensor


def test_a_dive_without_variance_has_no_cause():
    assert largest_cause({}) is None
    assert largest_cause({"imu": 0.0}) is None
