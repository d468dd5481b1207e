"""Beams of a DVL as measurements: what two and three of them give, and every way of taking a ping gives the same."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from dives import JANUS, by_beams, changed, falcon, incremental, simulated, started
from live import flown
from test_assembly import assembled

from rovgraph.diagnosis.check import examine
from rovgraph.diagnosis.check.dvl import ranges
from rovgraph.dive import smooth
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log import Stream
from rovgraph.model.config import Config, parse_config
from rovgraph.problem.beams import PingsByBeams, beam_sensors, head_against_velocity
from rovgraph.sensors.dvl_beam import (
    BEAMS,
    Refusals,
    beam_geometry,
    beam_sd,
    beams_of,
    taken_by_beams,
    velocity_by_beams,
)
from rovgraph.sensors.instruments import instruments

# of velocity by four beams at 22.5 deg with 5.4 mm/s [m/s]
SD = (0.0054 / np.sqrt([2.0 * np.sin(np.deg2rad(22.5)) ** 2] * 2 + [4.0 * np.cos(np.deg2rad(22.5)) ** 2])).tolist()
QUIET = {
    "calibration": {f"dvl_beam_{k}_angle": {"estimate": False} for k in range(4)} | {"dvl_bias": {"estimate": False}}
}


@pytest.fixture(scope="module")
def case():
    """A dive with a DVL that has hardly any noise of its own."""
    return simulated(falcon(dvl={"velocity_sd_mps": [1e-5] * 3}), 60.0, seed=3, dvl_rate=4.0, imu_rate=50.0)


EXACT = {name: {"estimate": False} for name in ("dvl_bias", *(f"dvl_beam_{k}_angle" for k in range(4)))}


def dive(case, alter: Callable[[Array, Array], None] | None = None, **dvl):
    config = changed(started(case), dvl={"velocity_sd_mps": SD})
    return by_beams(case.log, config, alter, **dvl)


def test_directions_follow_azimuth_and_angle_and_a_concave_head_is_turned():
    head = beam_geometry(parse_config("dvl: {beams: {angle_deg: 30, azimuth_deg: [0, 90, 180, 270]}}").dvl)
    s, c = 0.5, math.sqrt(0.75)
    np.testing.assert_allclose(head.directions, [[s, 0, c], [0, s, c], [-s, 0, c], [0, -s, c]], atol=1e-15)
    assert head.numbers == (1, 2, 3, 4)
    step = 1e-6
    more = parse_config(f"dvl: {{beams: {{angle_deg: {30 + np.rad2deg(step)}, azimuth_deg: [0, 90, 180, 270]}}}}")
    np.testing.assert_allclose((beam_geometry(more.dvl).directions - head.directions) / step, head.tilts, atol=1e-6)
    concave = parse_config("dvl: {beams: {angle_deg: 30, azimuth_deg: [0, 90, 180, 270], convex: false}}")
    np.testing.assert_allclose(beam_geometry(concave.dvl).directions[:, :2], -head.directions[:, :2], atol=1e-15)


@pytest.mark.parametrize(
    ("beams", "said"),
    [
        ("{angle_deg: 0, azimuth_deg: [0, 120, 240]}", "angle_deg"),
        ("{angle_deg: 90, azimuth_deg: [0, 120, 240]}", "angle_deg: the beams are at right angles"),
        ("{angle_deg: 180, azimuth_deg: [0, 120, 240]}", "angle_deg"),
        ("{angle_deg: 30, azimuth_deg: [0, 180]}", "do not span"),
        ("{angle_deg: 30, azimuth_deg: [0, 180, 0, 180]}", "do not span"),
        ("{angle_deg: 30, azimuth_deg: [0, 1, 2, 3, 4, 5, 6, 7, 8]}", "azimuth_deg"),
    ],
)
def test_a_head_whose_beams_do_not_span_is_refused_in_one_line(beams, said):
    with pytest.raises(InputError, match=said) as refused:
        parse_config(f"dvl: {{beams: {beams}}}")
    assert "\n" not in str(refused.value)


def test_noise_of_a_beam_is_what_the_noise_of_the_velocity_stands_for():
    config = parse_config(f"dvl: {{velocity_sd_mps: [0.0185, 0.0185, 0.0054], beams: {JANUS}}}")
    assert beam_sd(config.dvl) == pytest.approx(0.01, rel=2e-3)  # four beams at 22.5 deg: 1.85 times that of one
    assert beam_sd(parse_config(f"dvl: {{beam_sd_mps: 0.004, beams: {JANUS}}}").dvl) == 0.004


def test_the_velocity_of_a_printed_example_is_that_of_its_beams():
    """Water Linked's protocol page; its own velocity differs by its calibration."""
    head = beam_geometry(parse_config(f"dvl: {{beams: {JANUS}}}").dvl)
    along = np.array([[-0.002349231, -0.003452149, 0.001837982, 0.002901435]])
    velocity, error = velocity_by_beams(head.directions, along, np.ones((1, 4), bool))
    np.testing.assert_allclose(velocity[0], [0.00974, 0.00200, -0.00029], atol=5e-6)
    assert error[0] < 5e-5


def test_three_beams_have_a_velocity_without_error_and_two_have_none():
    head = beam_geometry(parse_config(f"dvl: {{beams: {JANUS}}}").dvl)
    v = np.array([[0.5, -0.2, 0.1]])
    valid = np.array([[1, 1, 1, 0], [0, 1, 1, 0]], bool)
    velocity, error = velocity_by_beams(head.directions, np.repeat(v @ head.directions.T, 2, axis=0), valid)
    np.testing.assert_allclose(velocity[0], v[0], atol=1e-12)
    assert np.isnan(velocity[1]).all() and np.isnan(error).all()


AGREES, CHOOSES = Refusals(True, 2, 0), Refusals(True, 5, 5)  # most of the refused pings so far agree, and half


@pytest.mark.parametrize(
    ("accepted", "off", "valid", "seen", "taken"),
    [
        (1.0, 0.1, 4, CHOOSES, 4),  # it has made a velocity: gates judge its beams
        (1.0, 0.0, 2, CHOOSES, 0),  # of more beams than the log has, so that its velocity knows more
        (0.0, 0.0, 4, AGREES, 4),  # refused, and yet its beams agree as those of most do
        (0.0, 0.0, 4, CHOOSES, 0),  # refused, and agrees by chance
        (0.0, 0.05, 4, AGREES, 0),  # refused, and they do not
        (0.0, 0.0, 3, CHOOSES, 0),  # it makes velocities of three or refuses four: it has its reasons
        (0.0, 0.0, 3, Refusals(), 3),  # it never does
        (0.0, 0.0, 2, CHOOSES, 2),  # which it cannot make one of
        (np.nan, 0.1, 4, CHOOSES, 4),  # it says nothing
    ],
)
def test_what_the_instrument_refused_is_not_readmitted_as_its_beams_call_themselves_valid(
    accepted, off, valid, seen, taken
):
    config = parse_config(f"dvl: {{velocity_sd_mps: [0.01, 0.01, 0.01], beams: {JANUS}}}")
    cells = np.full((1, 9, 5), np.nan)
    cells[0, :4, 0], cells[0, :4, 1] = np.arange(4) < valid, [0.1 + off, 0.1, 0.1, 0.1]
    beams = beams_of(cells.reshape(1, -1), range(4))

    def count(use: str) -> int:
        dvl = changed(config, dvl={"use": use}).dvl
        return int(taken_by_beams(beams, np.array([accepted]), dvl, seen)[0].sum())

    assert (count("auto"), count("beams"), count("velocity")) == (taken, valid, 0)


def test_what_is_seen_of_refused_pings_is_the_same_one_by_one():
    config = parse_config(f"dvl: {{velocity_sd_mps: [0.01, 0.01, 0.01], beams: {JANUS}}}")
    rng = np.random.default_rng(1)
    cells = np.full((200, 9, 5), np.nan)
    cells[:, :4, 0], cells[:, :4, 1] = rng.uniform(size=(200, 4)) < 0.9, 0.1
    cells[:, 0, 1] += np.where(rng.uniform(size=200) < 0.3, 0.05, 0.0)
    beams, accepted = beams_of(cells.reshape(200, -1), range(4)), (rng.uniform(size=200) < 0.5).astype(float)
    taken, whole = taken_by_beams(beams, accepted, config.dvl, Refusals())
    single = Refusals()
    for k, row in enumerate(cells):
        ping = beams_of(row.reshape(1, -1), range(4))
        one, single = taken_by_beams(ping, accepted[k : k + 1], config.dvl, single)
        np.testing.assert_array_equal(one[0], taken[k])
    assert whole == single and taken[accepted == 0.0].any()


def without_fore(begin: float, end: float) -> Callable[[Array, Array], None]:
    def alter(time: Array, along: Array) -> None:
        along[(time > begin) & (time < end), 2:] = np.nan

    return alter


def test_a_log_is_assembled_the_same_whole_and_one_by_one(case):
    log, config = dive(case, without_fore(10.0, 20.0))
    problem, _ = assembled(log, config)
    lost = int(((log[BEAMS].time > 10.0) & (log[BEAMS].time < 20.0)).sum())
    every = len(log[BEAMS])
    assert [len(problem.of_sensor(f"dvl_beam_{k}")) for k in range(4)] == [every, every, every - lost, every - lost]
    assert not len(problem.of_sensor("dvl"))
    here = problem.of_sensor("dvl_beam_1")
    np.testing.assert_array_equal(problem.keyframe[here], problem.interval[here])  # its pings make keyframes


def test_pings_without_beams_are_taken_by_their_velocity_and_none_twice(case):
    log, config = dive(case)
    log = replace(log, streams={**log.streams, BEAMS: log[BEAMS].take(np.arange(len(log[BEAMS])) % 2 == 0)})
    problem, left_out = assembled(log, config)
    beams, pings = problem.of_sensor("dvl_beam_0"), problem.of_sensor("dvl")
    assert len(beams) + len(pings) == len(log["dvl"]) and not left_out
    assert not np.isin(problem.rows[beams, 0], problem.rows[pings, 0]).any()


def end(log, config: Config) -> tuple[Array, Array]:
    """Position at the end, and its sd."""
    trajectory = smooth(log, config, "both").estimates[0].trajectory
    return trajectory.p_n[-1], np.sqrt(np.diag(trajectory.cov_p[-1]))


def test_beams_of_a_healthy_dive_are_worth_its_velocities(case):
    log, config = dive(case)
    config = changed(changed(config, calibration=EXACT), dvl={"loss": "none"})
    by_velocity, sd_v = end(log, changed(config, dvl={"use": "velocity"}))
    beams, sd_b = end(log, config)
    np.testing.assert_allclose(beams[:2], by_velocity[:2], atol=0.1 * sd_v[:2].max())
    np.testing.assert_allclose(sd_b, sd_v, rtol=0.03)


def test_two_adjacent_beams_carry_a_dive_whose_velocities_are_lost(case):
    log, config = dive(case, without_fore(15.0, 45.0))
    whole_log, _ = dive(case)
    _, whole = end(whole_log, config)
    p, sd = end(log, config)
    _, lost = end(log, changed(config, dvl={"use": "velocity"}))
    assert sd[:2].max() < 1.5 * whole[:2].max() and 1.5 * sd[:2].max() < lost[:2].max()
    truth = case.truth.p_n[-1]
    assert (np.abs(p - truth)[:2] < 3.0 * sd[:2]).all()


@pytest.mark.slow
def test_filter_smoother_and_isam2_take_beams_alike(case):
    log, config = dive(case, without_fore(15.0, 30.0))
    estimates = {e.kind: e.trajectory.p_n[-1] for e in smooth(log, config, "both").estimates}
    newest = incremental(log, config).solve().trajectory.p_n[-1]
    np.testing.assert_allclose(newest, estimates["smoothed"], atol=0.02)
    np.testing.assert_allclose(estimates["filtered"], estimates["smoothed"], atol=0.2)


def test_live_takes_pings_by_beams_as_a_log_does(case):
    log, config = dive(case, without_fore(15.0, 30.0))
    flight = flown(replace(case, log=log, config=config))
    filtered = next(e for e in smooth(log, config, "both").estimates if e.kind == "filtered").trajectory
    known = flight.solutions[-1]
    k = int(np.abs(filtered.time - known.time).argmin())
    np.testing.assert_allclose(known.position, filtered.p_n[k], atol=0.3 * known.position_sd[0])
    np.testing.assert_allclose(known.position_sd, np.sqrt(np.diag(filtered.cov_p[k])), rtol=0.05)
    assert flight.events("dvl") == ["no lock", "back"]
    assert not [e for k in range(4) for e in flight.events(f"dvl_beam_{k}")]
    assert known.sensors["dvl_beam_0"].used == len(log[BEAMS])


def test_beams_of_a_ping_that_hangs_are_none(case):
    """Live and in a log; the velocity is the same again and again, and its beams are."""
    log, config = dive(case)
    data, beams = log["dvl"].data.copy(), log[BEAMS].data.copy()
    stuck = (log["dvl"].time > 20.0) & (log["dvl"].time < 30.0)
    data[stuck], beams[stuck] = data[stuck.argmax()], beams[stuck.argmax()]
    streams = {**log.streams, "dvl": replace(log["dvl"], data=data), BEAMS: replace(log[BEAMS], data=beams)}
    log = replace(log, streams=streams)
    used = {
        r for e in smooth(log, config, "both").estimates[:1] for r in e.residuals.query("sensor=='dvl_beam_1'").time
    }
    assert not [t for t in used if 20.5 < t < 29.5]
    flight = flown(replace(case, log=log, config=config))
    assert "frozen" in flight.events("dvl")
    assert flight.solutions[-1].sensors["dvl_beam_0"].used <= len(log[BEAMS]) - stuck.sum() + 5


def reordered(time: Array, along: Array) -> None:
    along[:] = along[:, [3, 2, 1, 0]]


def seen_by(*signs: float) -> Callable[[Array, Array], None]:
    """Beams that agree, of a head whose axes are of other signs."""
    d = beam_geometry(parse_config(f"dvl: {{beams: {JANUS}}}").dvl).directions

    def alter(time: Array, along: Array) -> None:
        along[:] = along @ np.linalg.pinv(d).T * signs @ d.T

    return alter


mirrored = seen_by(1.0, -1.0, -1.0)  # z up, and y to port


def test_a_head_whose_z_axis_points_away_from_the_bottom_is_as_good(case):
    log, config = dive(case)
    altered, _ = dive(case, mirrored)
    log = replace(log, streams={**log.streams, BEAMS: altered[BEAMS]})
    turned = {"beams": {**JANUS, "angle_deg": 157.5, "azimuth_deg": [225.0, 135.0, 45.0, 315.0]}}
    p, _ = end(log, changed(config, dvl=turned))
    expected, _ = end(*dive(case, seen_by(1.0, 1.0, 1.0)))
    np.testing.assert_allclose(p, expected, atol=1e-6)


WRONG = {
    "reversed": (lambda t, b: np.negative(b, out=b), "units: {dvl_beam_velocity: -m/s}"),
    "mm/s": (lambda t, b: np.multiply(b, 1000.0, out=b), "units: {dvl_beam_velocity: mm/s}"),
    "another order": (reordered, "azimuth_deg: [45, 315, 225, 135], which fits"),
    "z away from the bottom": (mirrored, "angle_deg: 157.5, azimuth_deg: [225, 135, 45, 315]"),
    "no geometry of theirs": (lambda t, b: np.copyto(b, b + 0.5), "check dvl.beams"),
}


@pytest.mark.parametrize(("wrong", "said"), WRONG.values(), ids=WRONG)
def test_beams_that_are_wrong_are_named_and_their_velocities_used(case, wrong, said):
    log, config = dive(case)
    right, velocity = log[BEAMS], log["dvl"]
    altered, _ = dive(case, wrong, max_speed_mps=1e4)
    log = replace(log, streams={**log.streams, BEAMS: altered[BEAMS]})
    found = [f for f in examine(log, config).findings if f.sensor == BEAMS]
    assert [f.level for f in found] == ["warning"] and said in found[0].text
    used, why = beam_sensors(config, log.streams)
    assert not used and said in why
    used, why = beam_sensors(config, {**log.streams, BEAMS: right, "dvl": velocity})
    assert used and not why


def test_of_orders_that_nearly_fit_a_level_straight_dive_the_right_one_is_named(case):
    """A wrong order of the fore beams misses only sway; azimuths turned about miss only the vertical."""
    log, config = dive(case)
    azimuths = config.dvl.beams.azimuth_deg
    velocity, pings = log["dvl"].data.copy(), log[BEAMS].data.copy()
    velocity[:, :3] = [0.5, 0.01, 0.01]
    velocity[:, 3] = 1.0
    pings[:, 1 : 5 * len(azimuths) : 5] = velocity[:, :3] @ beam_geometry(config.dvl).directions.T
    pings[:, 0 : 5 * len(azimuths) : 5] = 1.0
    streams = {"dvl": replace(log["dvl"], data=velocity), BEAMS: replace(log[BEAMS], time=log["dvl"].time, data=pings)}
    turned = [azimuths[-1], *azimuths[:-1]]
    named = "azimuth_deg: [" + ", ".join(f"{azimuth:g}" for azimuth in azimuths) + "]"
    assert named in head_against_velocity(changed(config, dvl={"beams": {"azimuth_deg": turned}}), streams).remedy
    about = [(azimuth + 180.0) % 360.0 for azimuth in azimuths]
    assert named in head_against_velocity(changed(config, dvl={"beams": {"azimuth_deg": about}}), streams).remedy


def test_beams_by_another_clock_or_of_another_head_are_named(case):
    log, config = dive(case)
    later = replace(log[BEAMS], time=log[BEAMS].time + 0.1)
    why = beam_sensors(config, {**log.streams, BEAMS: later})[1]
    assert "stamps" in why and "state delay_s: {dvl_beams: 0.1}" in why
    shifted = replace(log[BEAMS], data=np.roll(log[BEAMS].data, 5, axis=1))
    why = beam_sensors(config, {**log.streams, BEAMS: shifted})[1]
    assert "of beams 4" in why and "state dvl.beams.first_number: 1" in why


def test_beams_whose_geometry_is_not_known_are_said_to_need_it(case):
    log, config = dive(case)
    used, why = beam_sensors(changed(config, dvl={"beams": {"angle_deg": None}}), log.streams)
    assert not used and "state dvl.beams" in why


def test_beams_alone_carry_a_dive_without_velocities(case):
    log, config = dive(case)
    alone = replace(log, streams={s: x for s, x in log.streams.items() if s != "dvl"})
    p, sd = end(alone, config)
    by_both, _ = end(log, config)
    np.testing.assert_allclose(p, by_both, atol=0.05)
    assert (np.abs(p - case.truth.p_n[-1])[:2] < 3.0 * sd[:2]).all()


@pytest.mark.parametrize(
    ("quantity", "factor", "said"),
    [
        (2, 1.0 / math.cos(np.deg2rad(22.5)), ""),
        (2, 1.0, "name the columns distance_K"),
        (3, 1.0, ""),
        (3, 1.0 / math.cos(np.deg2rad(22.5)), "name the columns range_K"),
        (2, 1000.0 / math.cos(np.deg2rad(22.5)), "units: {dvl_beam_range: mm}"),
    ],
)
def test_ranges_in_a_wrong_unit_or_straight_down_for_slant_are_named(case, quantity, factor, said):
    log, config = dive(case)
    pings, cells = log[BEAMS], log[BEAMS].data.reshape(-1, 9, 5).copy()
    cells[:, :4, quantity] = 3.0 * factor * np.array([0.9, 1.1, 1.0, 1.0])  # a bottom that slopes
    flat = np.full((len(pings), 1), 3.0)
    altitude = Stream("dvl_altitude", ("dvl_altitude",), pings.time, flat, pings.row)
    streams = {**log.streams, BEAMS: replace(pings, data=cells.reshape(len(pings), -1)), "dvl_altitude": altitude}
    found = [f.text for f in ranges(replace(log, streams=streams), config)]
    assert len(found) == bool(said) and all(said in text for text in found)


def test_velocities_are_left_out_where_their_pings_come_as_beams_by_another_clock(case):
    log, config = dive(case, use="beams")
    later = replace(log, streams={**log.streams, BEAMS: replace(log[BEAMS], time=log[BEAMS].time + 0.1)})
    made, by_beams = PingsByBeams(config, instruments(config)).of_log(later.streams)
    assert by_beams.all() and [len(stream) for stream in made] == [len(log[BEAMS])] * 4


def test_axes_and_clock_that_make_beams_agree_with_the_imu_are_named(case):
    log, config = dive(case, use="beams")
    turned = changed(config, dvl={"mount_rpy_deg": [0.0, 0.0, 90.0]})
    (found,) = [s for s in smooth(log, turned, "smoothed").statistics if s.kind == "axes"]
    assert found.sensor == "dvl" and "state dvl.mount_rpy_deg" in found.remedy


@pytest.mark.parametrize(("factor", "said"), [(1.0, ""), (100.0, "units: {dvl_beam_range: cm}")])
def test_ranges_are_compared_with_the_depth_where_the_log_has_no_altitude(case, factor, said):
    """Over a bottom of waves of half a metre, 8 m deep."""
    log, config = dive(case)
    pings, cells = log[BEAMS], log[BEAMS].data.reshape(-1, 9, 5).copy()
    depth = Stream("depth", ("depth",), pings.time, 2.0 + np.sin(0.3 * pings.time)[:, None], pings.row)
    bottom = 8.0 + 0.25 * np.sin(0.05 * pings.time)[:, None]
    cells[:, :4, 2] = factor * (bottom - depth.data) / math.cos(np.deg2rad(22.5))
    streams = {s: x for s, x in log.streams.items() if s != "dvl_altitude"}
    streams |= {BEAMS: replace(pings, data=cells.reshape(len(pings), -1)), "depth": depth}
    found = [f.text for f in ranges(replace(log, streams=streams), config)]
    assert len(found) == bool(said) and all(said in text for text in found)


def test_ranges_that_no_dvl_reaches_are_named_without_altitude_and_depth(case):
    log, config = dive(case)
    pings, cells = log[BEAMS], log[BEAMS].data.reshape(-1, 9, 5).copy()
    cells[:, :4, 2] = 5000.0
    far = replace(pings, data=cells.reshape(len(pings), -1))
    (found,) = ranges(replace(log, streams={"imu": log["imu"], "dvl": log["dvl"], BEAMS: far}), config)
    assert "units: {dvl_beam_range: mm}" in found.text


@pytest.mark.parametrize(("use", "missed"), [("auto", False), ("beams", False), ("velocity", True)])
def test_bottom_lock_is_not_missed_where_beams_carry_the_dive(case, use, missed):
    """The instrument makes no velocity of half of the pings, in which two beams are left."""

    def lose(time: Array, along: Array) -> None:
        along[::2, 2:] = np.nan

    log, config = dive(case, lose, use=use)
    said = [f for f in examine(log, config).findings if f.kind == "bottom lock" and f.level == "warning"]
    assert bool(said) is missed
