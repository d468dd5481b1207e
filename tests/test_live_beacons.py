"""Beacons that nobody placed, live: both sides until the path tells, then a part of the estimate."""

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from dives import campaign_log

from rovgraph.diagnosis.beacons import _sd_to_begin, ambiguous
from rovgraph.diagnosis.trilateration import RangesAlongTrack, around, sides
from rovgraph.inference.initialise import initialise
from rovgraph.live.beacons import UnplacedBeacons
from rovgraph.live.clocks import Clocks
from rovgraph.live.message import Message, Reading
from rovgraph.live.navigator import Navigator
from rovgraph.log import Measurement
from rovgraph.model.config import Config, parse_config

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from acoustics import ROUND, below_ship, one_beacon

BEACON = np.array([70.0, 60.0, 80.0])
DOWN = 75.0, 10.0  # where its depth is sought, and the sd


def ranged(p_n: np.ndarray, believed: np.ndarray, outliers: float = 0.0, seed: int = 1) -> RangesAlongTrack:
    """Ranges from where a vehicle was, with where its track had it."""
    rng = np.random.default_rng(seed)
    n, steps = len(p_n), np.linalg.norm(np.diff(p_n, axis=0), axis=1)
    length = np.linalg.norm(BEACON - p_n, axis=1) + rng.normal(0.0, 0.2, n)
    length[rng.uniform(size=n) < outliers] += 40.0
    ago = np.append(steps[::-1].cumsum()[::-1], 0.0)
    return RangesAlongTrack(believed, length, np.full(n, 0.2), ago, 0.005, 0.1)


def leg(n: int = 40, metres: float = 200.0) -> np.ndarray:
    return np.column_stack([np.linspace(0.0, metres, n), np.zeros(n), np.full(n, 60.0)])


def corner(n: int = 40) -> np.ndarray:
    """A leg of 150 m, and 50 m to starboard."""
    way = np.linspace(0.0, 200.0, n)
    return np.column_stack([np.minimum(way, 150.0), np.maximum(way - 150.0, 0.0), np.full(n, 60.0)])


def test_a_straight_leg_leaves_both_sides():
    path = leg()
    best, other = sides(ranged(path, path), *DOWN)[:2]
    assert ambiguous(other.cost - best.cost)
    for side, sign in ((best, np.sign(best.place[1])), (other, np.sign(other.place[1]))):
        off = side.place[:2] - [BEACON[0], sign * BEACON[1]]
        assert off @ np.linalg.solve(side.covariance, off) < 9.0
    assert best.place[1] * other.place[1] < 0.0


@pytest.mark.parametrize("count", [12, 40])
def test_a_bend_that_nobody_saw_tells_no_side_however_many_ranges_there_are(count):
    path = leg(count)
    bent = path + np.column_stack([0 * path[:, 0], 1.5 * np.sin(np.pi * path[:, 0] / 200.0), 0 * path[:, 0]])
    best, other = sides(ranged(bent, path), *DOWN)[:2]
    assert ambiguous(other.cost - best.cost)


@pytest.mark.parametrize("outliers", [0.0, 0.15])
@pytest.mark.parametrize("turned", [0.0, 2.0])
def test_behind_a_corner_one_place_is_left_and_its_sd_holds_its_error(outliers, turned):
    path = corner()
    c, s = np.cos(np.radians(turned)), np.sin(np.radians(turned))
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    believed = (path - path[-1]) @ R.T + path[-1]  # a compass that is off turns the track, and the beacon with it
    ranges = ranged(path, believed, outliers)
    places = sides(ranges, *DOWN)
    assert len(places) == 1 or not ambiguous(places[1].cost - places[0].cost)
    off = (places[0].place - (R @ (BEACON - path[-1]) + path[-1]))[:2]
    assert off @ np.linalg.solve(places[0].covariance, off) < 9.0
    assert places[0].is_clear(ranges)


def test_ranges_that_fit_no_place_are_never_clear():
    ranges = ranged(corner(), corner())
    shuffled = replace(ranges, length=np.random.default_rng(3).uniform(50.0, 300.0, len(ranges.length)))
    assert not sides(shuffled, *DOWN)[0].is_clear(shuffled)


@pytest.mark.parametrize("wander", [0.0, 0.003, 0.01, 0.03])
def test_ranges_from_one_spot_leave_the_whole_circle_and_fit_it(wander):
    rng = np.random.default_rng(2)
    spot = np.cumsum(rng.normal(0.0, wander / np.sqrt(48.0), (48, 3)), axis=0)
    for place in sides(ranged(spot, spot), *DOWN):
        assert place.sd > 50.0 and place.outliers < 0.1 and not place.is_clear(ranged(spot, spot))
        assert np.linalg.norm(place.place - spot[0]) == pytest.approx(np.linalg.norm(BEACON - spot[0]), abs=0.3)


def test_a_beacon_begins_as_wide_as_the_circle_that_one_spot_leaves():
    for path, wide in ((np.zeros((48, 3)), True), (corner(), False)):
        ranges = ranged(path, path)
        sd = _sd_to_begin(BEACON, path, ranges.length, ranges.sd, DOWN[1])
        assert sd == pytest.approx(np.median(ranges.length) if wide else around(ranges.length))


def live(dive, seconds: float, named: float | None = None) -> SimpleNamespace:
    """A replay up to a time: navigator, solutions once a second, events."""
    log, config = campaign_log(dive)
    navigator, solutions = Navigator(config, patient=True, clocks=Clocks(trust=True)), []
    for m in log.measurements():
        if m.time > seconds:
            break
        if named is not None and m.sensor == "range":
            m = m._replace(values=np.where(np.arange(len(m.values)) == 2, named, m.values))
        navigator.take(Message("sim", m.time, m.time, (Reading(m.sensor, m.values),)))
        if navigator.engine is not None and navigator.time > len(solutions):
            solutions += [one for one in [navigator.solution()] if one is not None]
    navigator.close()
    events = [event for one in solutions for event in one.events]
    return SimpleNamespace(navigator=navigator, solutions=solutions, events=events)


@pytest.mark.slow
def test_live_a_beacon_has_two_places_until_a_turn_and_then_one():
    dive = one_beacon(0, seconds=210.0)
    true = np.array([dive.hidden.others[f"beacon_1_{axis}"] for axis in ("north", "east")])
    found = live(dive, 210.0)
    before = [one for one in found.solutions if 60.0 < one.time < 100.0]
    for one in before:
        assert len(one.beacons) == 2 and one.beacons[0].behind == 0.0 and 0.0 <= one.beacons[1].behind < 9.2
        assert min(np.hypot(*(true - [b.north, b.east])) for b in one.beacons) < 20.0
        stated = [one.calibration[f"beacon_1_{axis}"] for axis in ("north", "east")]
        assert all(abs(value - at) < 3.0 * sd for (value, sd), at in zip(stated, true, strict=True))  # covers both
    assert [event.kind for event in found.events if event.source == "range"] == ["ambiguous", "placed"]
    last = found.solutions[-1]
    (beacon,) = last.beacons
    off = true - [beacon.north, beacon.east]
    assert np.isnan(beacon.behind) and np.hypot(*off) < 4.0 and max(beacon.north_sd, beacon.east_sd) < 4.0
    error = last.position[:2] - dive.motion.local(np.array([last.time]))[0, :2]
    assert np.all(np.abs(error) < 3.0 * last.position_sd[:2])
    assert last.sensors["range"].used > 5
    state = found.navigator.state()
    again = Navigator(found.navigator.config, patient=True, clocks=Clocks(trust=True))
    again.restore(state)
    assert again.solution().beacons[0].north == pytest.approx(beacon.north, abs=0.5)
    assert not again.solution().beacons[0].behind >= 0.0


@pytest.mark.slow
def test_live_on_a_straight_leg_a_beacon_stays_ambiguous_and_does_not_touch_the_track():
    with_ranges, without = (live(one_beacon(1, True, 130.0), 130.0, named) for named in (None, 9.0))
    kinds = [event.kind for event in with_ranges.events if event.source == "range"]
    assert kinds == ["ambiguous"]
    last, alone = with_ranges.solutions[-1], without.solutions[-1]
    assert len(last.beacons) == 2 and not alone.beacons
    np.testing.assert_array_equal(last.position, alone.position)
    state = with_ranges.navigator.state()
    kept = UnplacedBeacons(with_ranges.navigator.engine.initial, lambda *_: None, Counter())
    kept.restore(state["beacons"])
    assert len(kept.all[0].ranges) > 15 and kept.all[0].told == {"ambiguous"}
    # a name that the configuration does not have is no beacon
    assert (
        "range",
        "the configuration names no such beacon under beacons",
    ) in without.navigator.engine.assembly.left_out


@pytest.mark.slow
def test_live_a_latency_that_the_replies_show_is_estimated_from_then_on():
    dive = below_ship(replace(ROUND, latency=2.0, seconds=150.0), 0)
    found = live(dive, 150.0)
    assert [event.kind for event in found.events if event.source == "usbl" and event.kind in ("clock", "assumed")] == [
        "clock",
        "assumed",
    ]
    late, sd = found.solutions[-1].calibration["usbl_time_offset"]
    assert abs(late - 2.0) < 3.0 * sd < 0.5
    some = [one for one in found.solutions if one.time > 90.0]
    error = np.array([one.position[:2] - dive.motion.local(np.array([one.time]))[0, :2] for one in some])
    sds = np.array([one.position_sd[:2] for one in some])
    assert np.mean((error / sds) ** 2) < 2.0


def test_with_isam2_ranges_to_a_beacon_without_a_place_are_left_out_and_that_is_said():
    log, config = campaign_log(one_beacon(0, seconds=12.0))
    said: list[tuple[str, str, str]] = []
    beacons = UnplacedBeacons(initialise(log, config), lambda *one: said.append(one), Counter(), gathers=False)
    acoustics = SimpleNamespace(instruments={"range": None}, beacon_of=lambda m: 0)
    engine = SimpleNamespace(assembly=SimpleNamespace(acoustics=acoustics))
    assert beacons.take(engine, Measurement(9.0, "range", np.array([50.0, *[np.nan] * 5]), 0))
    assert said[0][1] == "unused" and "beacon 1 has no place" in said[0][2]


def test_a_beacon_without_a_name_in_the_log_is_the_only_one():
    from rovgraph.problem.acoustics import Acoustics
    from rovgraph.sensors.instruments import instruments

    config: Config = parse_config("beacons: [{name: wreck}]")
    acoustics = Acoustics(config, {"range": instruments(config)["range"]})
    assert acoustics.beacon_of(Measurement(1.0, "range", np.array([9.0, *[np.nan] * 5]), 0)) == 0
    assert acoustics.beacon_of(Measurement(1.0, "range", np.array([9.0, np.nan, 7.0, *[np.nan] * 3]), 0)) is None
