"""What crosslines would show of a survey's drift is predicted as surveys with crosslines then have it."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from crossovers import Relief as Ground
from crossovers import flat, matern, path, survey_motion
from fault_campaign.beams import Beams, stated
from fault_campaign.campaign import merge
from fault_campaign.instruments import sample
from fault_campaign.judge import Dive, run_command, write_dive
from fault_campaign.vehicle import Compass, configuration, make_vehicle

import rovgraph as rg
from rovgraph.inference.crossovers import Field, crossings_of
from rovgraph.inference.drift import Drift
from rovgraph.inference.relief import Relief
from rovgraph.lab.crosslines import (
    USUAL_RELIEF,
    _matched,
    _swath,
    _worth,
    plan_crosslines,
    plan_crosslines_after,
)
from rovgraph.lab.plan import Manoeuvre, SensorRates, predicted
from rovgraph.lab.survey import Survey
from rovgraph.report.lab import crosslines_in_words

RELIEF = Relief(0.35, 4.5, 0.1, np.inf)


def survey(folder: Path, ground=matern, lines: int = 5, crosslines: int = 0, crossovers: bool = True) -> Dive:
    """Lines of 120 m, 25 m apart, of an independent simulator."""
    rng, vehicle = np.random.default_rng([46, 1]), make_vehicle("mti", ("ahrs", "depth"))
    beams = Beams(bottom=Ground(20.0, terrain=ground(rng)))
    vehicle.dvl = replace(
        vehicle.dvl, mount_rpy_deg=(0.0, 0.0, -45.0), yaw_sd=0.3, scale_sd=0.003, sd=beams.head.velocity_sd
    )
    vehicle.dvl.rate, vehicle.imu.rate = 2.0, 50.0
    vehicle.ahrs = Compass(offset_sd=0.5, curve_sd=0.5)
    motion = survey_motion(lines, 120.0, 25.0, crosslines)
    config = merge(configuration(vehicle), stated(beams.head))
    config = merge(config, {"graph": {"crossovers": crossovers}, "calibration": {"dvl_scale": {"sd": 0.003}}})
    streams, hidden = sample(motion, vehicle, rng, beams)
    dive = Dive(streams, config, motion, hidden)
    folder.mkdir(exist_ok=True)
    write_dive(dive, folder)
    return dive


def read(folder: Path):
    config = rg.load_config(folder / "vehicle.yaml")
    return rg.read_log(folder / "log.csv", config), config


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 4])
def test_the_predicted_sd_is_that_of_a_survey_with_these_crosslines(tmp_path, count):
    """Predicted from a log without crosslines, and before there is one from the size of the survey."""
    survey(tmp_path / "without")
    log, config = read(tmp_path / "without")
    after = plan_crosslines_after(log, config)
    size = Survey.planned("5x126x30.6@1", config)
    before = plan_crosslines(size, config, SensorRates(50.0, 2.0), replace(after.relief, gain=np.inf))
    survey(tmp_path / "with", crosslines=count)
    track = rg.smooth(*read(tmp_path / "with")).smoothed
    assert "crossovers" in track.summary
    assert "variance_sources" not in track.summary  # they would be those of the dive before it was matched
    end = survey_motion(5, 120.0, 25.0, 0).duration
    P = track.trajectory.cov_p[track.trajectory.time < end]
    sd = np.sqrt(np.mean(P[:, 0, 0] + P[:, 1, 1]))
    for plan in (after, before):
        with_none, predicted = plan.ranked[0], next(c for c in plan.ranked if len(c.along) == count)
        assert with_none.crossings == 0 and predicted.crossings == 5 * count
        assert predicted.sd == pytest.approx(sd, rel=0.25)
        assert predicted.sd < 0.8 * with_none.sd
        assert with_none.sd == pytest.approx(after.ranked[0].sd, rel=0.25)


@pytest.mark.slow
def test_over_a_flat_bottom_crosslines_show_nothing(tmp_path):
    survey(tmp_path, flat, lines=3)
    plan = plan_crosslines_after(*read(tmp_path))
    assert len(plan.ranked) == 1
    (line,) = crosslines_in_words(plan)
    assert line.startswith("Crosslines would show nothing: the bottom shows no relief")


@pytest.mark.slow
def test_what_cannot_be_planned_is_refused(tmp_path):
    survey(tmp_path, lines=2)
    log, config = read(tmp_path)
    columns = pd.read_csv(tmp_path / "log.csv")
    columns = columns.drop(columns=[name for name in columns if name.startswith(("acc_", "gyr_"))])
    columns.loc[columns["ahrs_yaw"].notna(), ["roll", "pitch"]] = 0.0
    columns.dropna(how="all", subset=columns.columns[1:]).to_csv(tmp_path / "no-imu.csv", index=False)
    with pytest.raises(rg.InputError, match="it has no IMU"):
        plan_crosslines_after(rg.read_log(tmp_path / "no-imu.csv", config), config)
    with pytest.raises(rg.InputError, match="3 parallel lines or more is needed, found 2"):
        plan_crosslines_after(log, config)
    with pytest.raises(rg.InputError, match="its ranges show the relief of the bottom"):
        plan_crosslines_after(log, config, (0.3, 4.0))
    with pytest.raises(rg.InputError, match="it goes with crosslines"):
        rg.observe(log, config, relief=(0.3, 4.0))
    with pytest.raises(rg.InputError, match="more than 0 m are expected"):
        rg.observe(log, config, crosslines=True, relief=(0.3, -4.0))


VEHICLE = {"dvl": {"beams": {"angle_deg": 30.0, "azimuth_deg": (0.0, 90.0, 180.0, 270.0)}}}


@pytest.mark.parametrize(
    "text, said",
    [
        ("8x250x25", "expected LINESxLENGTHxAPART@SPEED, as 8x250x25@1"),
        ("8x250x25@-1", "expected LINESxLENGTHxAPART@SPEED"),
        ("8x250x25@nan", "expected LINESxLENGTHxAPART@SPEED"),
        ("2x250x25@1", "3 lines or more are needed"),
        ("8x20x25@1", "lines of 40 m or more are needed"),
        ("8x250x0@1", "lines 4 m apart or more are needed"),
        ("8x250x25@0", "a speed of more than 0"),
        ("999x9999x25@0.1", "hours, 12 can be planned"),
    ],
)
def test_a_survey_that_cannot_be_planned_is_refused(text, said):
    with pytest.raises(rg.InputError, match=said):
        rg.plan(survey=text)


def test_relief_without_a_survey_and_a_survey_with_fixes_are_refused():
    config = rg.Config().with_values(**VEHICLE)
    with pytest.raises(rg.InputError, match=r"relief 0\.3 4: it goes with a survey"):
        rg.plan(config, relief=(0.3, 4.0))
    with pytest.raises(rg.InputError, match=r"relief 0\.3 inf: sd and length"):
        rg.plan(config, survey="3x60x20@1", relief=(0.3, np.inf))
    with pytest.raises(rg.InputError, match="survey 3x60x20@1: it has fix; crosslines are planned"):
        rg.plan(config, survey="3x60x20@1", sensors=SensorRates(fix_interval=5.0))


@pytest.mark.parametrize("millimetres", [False, True])
def test_soundings_further_off_than_lines_are_long_are_of_another_unit(millimetres):
    p = path(5, 120.0, 25.0, 0)
    way, t = np.gradient(p, axis=0), np.arange(len(p), dtype=float)
    across = np.linspace(-4.0, 4.0, 3) * (1000.0 if millimetres else 1.0)
    lines = _swath(t, np.arctan2(way[:, 1], way[:, 0]), p, across)
    track = SimpleNamespace(time=t, p_n=p)
    if millimetres:
        with pytest.raises(rg.InputError, match="4000 m beside lines of 117 m; check the unit of its ranges"):
            Survey.recorded("log.csv", lines, track)
    else:
        recorded = Survey.recorded("log.csv", lines, track)
        np.testing.assert_allclose(recorded.swath, [-4.0, 0.0, 4.0])
        assert recorded.parallel.sum() == 5 and recorded.speed == pytest.approx(1.0, rel=0.05)


def test_no_manoeuvre_leaves_less_than_is_known_before():
    """Considered arms and tilts of the DVL make an estimate of its yaw worse than its prior on this circle."""
    config = rg.Config.model_validate(configuration(make_vehicle("mti", ("ahrs", "depth"))))
    config = config.with_values(calibration={"dvl_yaw": {"estimate": True, "sd_deg": 0.3}})
    seen = predicted(Manoeuvre("circle", 0.5), config, 120.0, SensorRates())
    assert seen.ratio.max() <= 1.0 + 1e-9


def test_a_planned_survey_has_its_lines_and_crosslines_where_they_are_wanted():
    config = rg.Config().with_values(**VEHICLE, start={"heading_deg": 90.0})
    lines = Survey.planned("4x100x20@0.8", config)
    np.testing.assert_allclose(lines.legs[0], [(0.0, 0.0), (0.0, 100.0)], atol=1e-9)
    np.testing.assert_allclose(lines.legs[-1], [(-60.0, 100.0), (-60.0, 0.0)], atol=1e-9)
    np.testing.assert_allclose(lines.swath, [-6.0, 0.0, 6.0])
    np.testing.assert_allclose(lines.places, [12.5, 37.5, 62.5, 87.5])  # the last line ends where the first began
    first, second = lines.crosslines(lines.places[:2])
    np.testing.assert_allclose(first, [(-70.0, 12.5), (10.0, 12.5)], atol=1e-9)
    np.testing.assert_allclose(second, [(10.0, 37.5), (-70.0, 37.5)], atol=1e-9)


def test_a_survey_is_planned_by_itself_or_beside_manoeuvres(tmp_path, monkeypatch):
    monkeypatch.setattr("rovgraph.lab.plan.cores", lambda: 1)
    config = rg.Config().with_values(**VEHICLE, heading={"sources": ("ahrs",)})
    rates = SensorRates(20.0, 1.0)
    by_itself = rg.plan(config, survey="3x60x20@1", sensors=rates)
    assert by_itself.plan is None
    assert [len(c.along) for c in by_itself.crosslines.ranked] == [0, 1, 2, 4]
    assert [c.crossings for c in by_itself.crosslines.ranked] == [0, 3, 6, 12]
    by_itself.save(tmp_path / "survey")
    kept = json.loads((tmp_path / "survey" / "plan.json").read_text())
    assert kept["survey"] == "3x60x20@1" and len(kept["crosslines"]["lines_m"]) == 3 and "ranking" not in kept
    assert "Lines and crosslines" in (tmp_path / "survey" / "report.html").read_text()
    both = rg.plan(config, manoeuvres="circle@0.5", estimate="dvl_yaw", survey="3x60x20@1", sensors=rates)
    assert both.plan is not None and both.crosslines is not None
    flat = rg.plan(config, survey="3x60x20@1", sensors=rates, relief=(USUAL_RELIEF.noise / 2.0, 4.0))
    assert len(flat.crosslines.ranked) == 1


def test_a_match_is_worth_the_mean_curvature_of_its_field():
    rng = np.random.default_rng(7)
    s = np.arange(-7.0, 8.0, 2.0)
    x, y = (np.array([(a, b) if k else (b, a) for a in s for b in (-2.0, 0.0, 2.0)]) for k in (0, 1))
    both = np.vstack([x, y])
    r = np.linalg.norm(both[:, None] - both, axis=2)
    root = np.linalg.cholesky(RELIEF.covariance(r) + RELIEF.noise**2 * np.eye(len(r)))
    h, curvature = 0.1, np.zeros((2, 2))
    shifts = h * np.array([(1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1), (0, 0)], float)
    for _ in range(200):
        z = root @ rng.standard_normal(len(r))
        L = Field((x, z[: len(x)]), (y, z[len(x) :]), RELIEF).at(shifts) / h**2
        cross = -(L[0] - L[1] - L[2] + L[3]) / 4.0
        curvature += np.array([[2 * L[8] - L[4] - L[5], cross], [cross, 2 * L[8] - L[6] - L[7]]]) / 200.0
    J = Field((x, z[: len(x)]), (y, z[len(x) :]), RELIEF).expected_information()
    assert np.abs(J - curvature).max() < 0.2 * np.trace(J) / 2.0


def test_crossings_show_no_rotation_of_the_survey_however_many():
    p, angle = path(5, 120.0, 25.0, 4), 0.02
    way = np.gradient(p, axis=0)
    t = np.arange(len(p), dtype=float)
    lines = _swath(t, np.arctan2(way[:, 1], way[:, 0]), p, np.arange(-4.0, 5.0, 2.0))
    knots = np.unique(np.round([*t[::10], *(line.centre[0][k] for line in lines for k in (0, -1))]))
    place = np.stack([np.interp(knots, t, axis) for axis in p.T], axis=-1)
    turned = angle * np.stack([-place[:, 1], place[:, 0]], axis=-1).ravel()
    walk = 1e-3 * np.kron(np.minimum.outer(knots, knots) + 1e-2, np.eye(2))
    drift = Drift(knots, np.zeros(2 * len(knots)), np.outer(turned, turned) + walk)
    crossings = [(c, _worth(lines, c, RELIEF)) for k in range(1, len(lines)) for c in crossings_of(lines, k, drift)]
    left = drift.given(_matched(drift, crossings))
    M = np.column_stack([turned / angle, np.tile(np.eye(2), (len(knots), 1))])
    by = np.linalg.pinv(M)[0]
    assert len(crossings) >= 20
    assert np.sqrt(by @ left.P @ by) > 0.85 * angle


@pytest.mark.slow
def test_the_command_prints_and_keeps_what_crosslines_would_show(tmp_path):
    survey(tmp_path, lines=3)
    out = tmp_path / "seen"
    options = ["--config", str(tmp_path / "vehicle.yaml"), "--crosslines", "--out", str(out)]
    code, errors = run_command(["observe", str(tmp_path / "log.csv"), *options])
    assert code == 0, errors
    kept = json.loads((out / "summary.json").read_text())["crosslines"]
    assert [len(row["ends_m"]) for row in kept["ranking"]] == [0, 1, 2, 4]
    assert "Drift of the survey" in (out / "report.html").read_text()
    assert kept["in_words"][-1].startswith("No crossline shows a shift, a rotation or a scale")
