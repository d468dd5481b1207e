"""Crossovers live: after each line the dive so far is matched, and the filter goes on from what that shows."""

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from crossovers import Relief as Ground
from crossovers import flat, matern, survey_motion
from dives import campaign_log, simulated
from fault_campaign.beams import Beams, Head, stated
from fault_campaign.campaign import merge
from fault_campaign.instruments import sample
from fault_campaign.judge import Dive
from fault_campaign.vehicle import Compass, configuration, make_vehicle
from live import message

import rovgraph as rg
from rovgraph.inference.filter import FilterEngine
from rovgraph.inference.initialise import initialise
from rovgraph.inference.posterior import Posterior
from rovgraph.inference.relief import line_ends
from rovgraph.inference.smoother import assemble
from rovgraph.live.clocks import Clocks
from rovgraph.live.crossovers import LiveCrossovers, LiveMatch, LiveSurvey
from rovgraph.live.files import Files
from rovgraph.live.navigator import Navigator
from rovgraph.live.session import Session
from rovgraph.live.warnings import Warnings
from rovgraph.log import Measurement


def way(legs: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, heading and place along legs, seconds at 1 m/s with a heading each [deg], every half second."""
    heading = np.deg2rad(np.concatenate([np.full(int(2 * seconds), angle) for seconds, angle in legs]))
    place = np.cumsum(0.5 * np.stack([np.cos(heading), np.sin(heading)], axis=-1), axis=0)
    return 0.5 * np.arange(len(heading)), heading, place


def test_a_line_has_ended_once_the_vehicle_has_turned():
    assert line_ends(*way([(60.0, 0.0)])) == []
    assert line_ends(*way([(60.0, 0.0), (4.0, 90.0)])) == []  # it may still be a bend of the compass
    (end,) = line_ends(*way([(60.0, 0.0), (20.0, 90.0)]))
    assert end == pytest.approx(60.0, abs=6.0)
    assert len(line_ends(*way([(60.0, 0.0), (30.0, 90.0), (60.0, 180.0), (20.0, 90.0)]))) == 2


def snapshot(time: float, heading: float, place: np.ndarray, speed: float = 1.0) -> SimpleNamespace:
    c, s = np.cos(heading), np.sin(heading)
    x = np.concatenate([[c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0], place, [0.0, speed * c, speed * s, 0.0], np.zeros(6)])
    return SimpleNamespace(time=time, known=SimpleNamespace(x=x))


def dues(crossovers: LiveCrossovers, legs: list[tuple[float, float]]) -> list[float]:
    """When a match is due, each taken at once."""
    found = []
    for time, heading, place in zip(*way(legs), strict=True):
        crossovers.passed(snapshot(time, heading, place))
        if crossovers.due:
            found.append(time)
            crossovers.survey(None, "trusted")
    return found


def test_a_match_is_due_once_after_each_line_and_over_a_chart_along_it():
    legs = [(900.0, 0.0), (30.0, 90.0), (60.0, 180.0), (30.0, 90.0), (60.0, 0.0), (30.0, 90.0)]
    after = dues(LiveCrossovers(None), legs)
    assert len(after) == 3 and after[0] == pytest.approx(915.0, abs=10.0)
    along = dues(LiveCrossovers(SimpleNamespace()), legs)
    assert len([time for time in along if time < 900.0]) == 4


def test_what_is_not_news_is_not_told_again():
    crossovers = LiveCrossovers(None)
    refused, quiet, matched = (
        LiveMatch("nothing is used: why"),
        LiveMatch("few", quiet=True),
        LiveMatch("3 of 3", object()),
    )
    assert [crossovers.tell(one) for one in (quiet, refused, refused)] == [None, ("unused", refused.text), None]
    assert [crossovers.tell(one)[0] for one in (matched, matched, refused)] == ["matched", "matched", "unused"]
    assert crossovers.tell(refused) is None


@cache
def solved():
    case = simulated(rg.Config().with_values(calibration={"dvl_scale": {"estimate": "considered", "sd": 0.01}}), 60.0)
    initial = initialise(case.log, case.config)
    best = assemble(case.log, initial).optimum()
    return initial, best, Posterior.of(best, initial)


def test_a_dive_that_is_not_trusted_is_not_smoothed_for_a_match():
    initial, best, _ = solved()
    survey = LiveSurvey([], None, None, "doubtful", used=False)
    assert "verdict so far is doubtful" in survey.refused(initial, best.problem, best.state).text
    assert replace(survey, used=True).refused(initial, best.problem, best.state) is None  # what was used is taken back
    assert "doubtful" in survey.match(FilterEngine(initial), best, []).text
    assert "no ranges" in replace(survey, verdict="trusted").refused(initial, best.problem, best.state).text


@pytest.mark.parametrize("on", [False, True])
def test_isam2_matches_nothing_and_says_so(on):
    pytest.importorskip("gtsam")
    case = simulated(rg.Config().with_values(graph={"crossovers": on}), 40.0, 1, "straight")
    nav = Navigator(case.config, patient=True, smooth=True, clocks=Clocks(trust=True))
    for m in case.log.measurements():
        nav.take(message(m))
    assert any("correct no track of --engine isam2" in event.text for event in nav.solution().events) == on


@cache
def survey(ground=matern, seed: int = 4):
    """Three lines of 90 m and two crosslines with a noisy DVL, and a way home: the dive, its log and configuration."""
    rng, vehicle = np.random.default_rng([48, seed]), make_vehicle("mti", ("ahrs", "depth"))
    beams = Beams(Head(sd=0.1, error_limit=5.0), Ground(20.0, terrain=ground(rng)))
    vehicle.dvl = replace(vehicle.dvl, mount_rpy_deg=(0.0, 0.0, -45.0), yaw_sd=0.3, sd=beams.head.velocity_sd)
    vehicle.dvl.rate, vehicle.imu.rate = 2.0, 50.0
    vehicle.ahrs = Compass(offset_sd=0.5, curve_sd=0.5)
    motion = survey_motion(3, 90.0, 25.0, 2, 60.0)
    config = merge(configuration(vehicle), stated(beams.head))
    config = merge(config, {"graph": {"crossovers": True}})
    streams, hidden = sample(motion, vehicle, rng, beams)
    return Dive(streams, config, motion, hidden), *campaign_log(Dive(streams, config, motion, hidden))


def dived(log, config, more=(), late: float = 0.0, until: float = np.inf) -> tuple[Navigator, list]:
    """A navigator after a dive, and its events; ``more`` measurements, which come so late [s]."""
    nav, waiting = Navigator(config, patient=True, clocks=Clocks(trust=True)), [*more]
    for m in log.measurements():
        if m.time > until:
            break
        while waiting and m.time > waiting[0].time + late:
            nav.take(message(waiting.pop(0)))
        nav.take(message(m))
    return nav, [event for event in nav.solution().events if event.source == "crossovers"]


@cache
def over_relief():
    return dived(*survey()[1:])


@cache
def without_crossovers(ground=matern):
    _, log, config = survey(ground)
    return dived(log, config.with_values(graph={"crossovers": False}))[0].solution()


def sd(solution) -> float:
    return float(np.linalg.norm(solution.position_sd[:2]))


@pytest.mark.slow
def test_after_crosslines_the_position_is_where_smoothing_the_recording_has_it():
    dive, log, config = survey()
    nav, events = over_relief()
    assert events and events[-1].kind == "matched" and "its sd goes from" in events[-1].text
    now, drifted = nav.solution(), without_crossovers()
    track = rg.smooth(log, config, estimate="smoothed").smoothed.trajectory
    there = [np.interp(now.time, track.time, axis) for axis in track.p_n.T[:2]]
    assert sd(now) < 0.75 * sd(drifted)
    assert np.linalg.norm(now.position[:2] - there) < 0.3 * sd(now)
    assert np.linalg.norm(now.position[:2] - there) < 0.3 * np.linalg.norm(drifted.position[:2] - there)
    assert sd(now) == pytest.approx(np.linalg.norm(track.p_sd[-1, :2]), rel=0.2)
    assert np.linalg.norm(now.position[:2] - dive.motion.local(np.array([now.time]))[0, :2]) < 2.0 * sd(now)
    assert np.rad2deg(now.rpy_sd[2]) > 0.4  # a compass offset turns the whole survey, which no crossing shows
    assert len(now.crossings) >= 6 and sum(crossing.matched for crossing in now.crossings) >= 6
    assert abs(now.distance - drifted.distance) < 3.0  # where a match puts the vehicle it did not go


@pytest.mark.slow
def test_over_a_flat_bottom_nothing_changes():
    nav, events = dived(*survey(flat)[1:])
    now, without = nav.solution(), without_crossovers(flat)
    assert [event.kind for event in events] == ["unused"] and "no relief" in events[0].text
    assert np.array_equal(now.position, without.position) and np.array_equal(now.position_sd, without.position_sd)


@pytest.mark.slow
def test_a_fix_after_a_match_counts_wherever_it_arrives():
    dive, log, config = survey()
    time = over_relief()[1][-1].time + 20.0
    fix = [Measurement(time, "fix", np.append(dive.motion.local(np.array([time]))[0, :2], 0.5), 0)]
    config = config.with_values(start={"north_m": 0.0, "east_m": 0.0})  # fixes count from there, too
    in_order, late = (dived(log, config, fix, seconds)[0].solution() for seconds in (0.0, 3.0))
    assert np.allclose(in_order.position, late.position, atol=1e-6)
    assert sd(late) < 0.5 * sd(over_relief()[0].solution())
    off = late.position[:2] - dive.motion.local(np.array([late.time]))[0, :2]
    assert np.linalg.norm(off) < 3.0 * sd(late)


@pytest.mark.slow
def test_a_dive_that_is_not_trusted_matches_nothing_and_says_so():
    _, log, config = survey()
    nav, events = dived(log, config.with_values(dvl={"beam_sd_mps": 0.03}), until=over_relief()[1][-1].time)
    assert nav.alarms.verdict != "trusted"
    assert {event.kind for event in events} == {"unused"}
    assert all("the verdict so far is" in event.text for event in events)


@pytest.mark.slow
def test_resumed_it_goes_on_with_what_was_matched(tmp_path):
    _, log, config = survey()
    stop = over_relief()[1][-1].time + 10.0
    for resumed in (False, True):
        files = Files(tmp_path, config, Warnings(), resume=resumed, replayed=resumed)
        nav = Navigator(config, patient=True, clocks=Clocks(trust=True))
        session = Session(nav, [], Warnings(), files=files)
        if resumed:
            session.resume()
        for m in log.measurements():
            if resumed or m.time < stop:
                session._step(message(m))
        if not resumed:
            files.keep(nav, now=True)
        files.close()
    now, whole = nav.solution(), over_relief()[0].solution()
    assert now.time == pytest.approx(whole.time, abs=0.1)
    assert np.linalg.norm(now.position[:2] - whole.position[:2]) < 0.1 * sd(whole)
    assert sd(now) == pytest.approx(sd(whole), rel=0.05)
