"""Acoustic positioning: the exchange's equation, its context, and dives whose truth is known."""

import re
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from dives import below_a_ship, campaign_log, falcon, same, simulated
from live import flown

from rovgraph.dive import smooth
from rovgraph.errors import InputError
from rovgraph.geometry import exp_rotation, matrix_from_rpy
from rovgraph.inference import correlated_noise
from rovgraph.inference.initialise import initialise
from rovgraph.kernels import measurement_row as at
from rovgraph.log import Log, Measurement, Stream
from rovgraph.model.calibration import LAYOUT, TABLE, USBL_MOUNT
from rovgraph.model.config import Config, parse_config
from rovgraph.model.state import State
from rovgraph.problem.acoustics import Acoustics
from rovgraph.problem.assembly import assembly_of
from rovgraph.sensors import SENSORS, AcousticExchange
from rovgraph.sensors.instruments import instruments
from rovgraph.sensors.sound import SoundSpeedProfile, _read, profile_of

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import acoustics
from acoustics import Setting, below_ship
from fault_campaign.judge import Dive

VARIABLES = (
    *USBL_MOUNT, "usbl_arm", "sound_speed_scale", "usbl_range_offset", "usbl_direction_error", "usbl_range_error",
    "range_clock", "range_clock_drift", "beacon_1", "beacon_1_down", "usbl_time_offset",
)  # fmt: skip


def context(rng: np.random.Generator, n: int, inverted: bool, ways: float, beacon: bool) -> np.ndarray:
    x = np.zeros((n, at.WIDTH))
    x[:, at.ARM : at.ARM + 3] = rng.normal(0, 0.3, (n, 3))
    x[:, at.ASKED : at.ASKED + 3] = rng.normal(0, 20, (n, 3))
    x[:, at.HEARD : at.HEARD + 3] = x[:, at.ASKED : at.ASKED + 3] + rng.normal(0, 1, (n, 3))
    x[:, at.FRAME : at.FRAME + 9] = matrix_from_rpy(rng.normal(0, 0.5, (n, 3))).reshape(n, 9)
    x[:, at.MOVES : at.MOVES + 3] = rng.normal(0, 1, (n, 3))
    x[:, at.TURNS : at.TURNS + 3] = rng.normal(0, 0.1, (n, 3))
    seen = rng.normal(0, 1, (n, 3))
    seen[0] = 0, 0, 1  # below the ship
    x[:, at.SEEN : at.SEEN + 3] = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    x[:, at.WAIT : at.WAIT + 2] = rng.normal(0, 0.1, (n, 2))
    x[:, at.STATED], x[:, at.SINCE], x[:, at.WAYS], x[:, at.INVERTED] = 0.1, 7.0, ways, inverted
    x[:, at.ORIGIN] = np.nan
    x[:, at.MOUNT_AT : at.WIDTH] = [
        LAYOUT[name].start
        for name in (
            "usbl_roll", "usbl_arm", "beacon_1", "beacon_1_down", "sound_speed_scale", "usbl_range_offset",
            "range_clock", "range_clock_drift", "usbl_direction_error", "usbl_range_error", "usbl_time_offset",
        )
    ]  # fmt: skip
    if not beacon:
        x[:, [at.BEACON_AT, at.DOWN_AT]] = -1
    return x


def state(rng: np.random.Generator, n: int) -> State:
    return State(
        matrix_from_rpy(rng.normal(0, 0.5, (n, 3))), rng.normal((0, 0, 60), 30, (n, 3)), rng.normal(0, 1, (n, 3)),
        np.zeros((n, 6)), {name: rng.normal(0, 0.1, TABLE[name].dim) for name in VARIABLES},
    )  # fmt: skip


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("ways", [1.0, 2.0])
@pytest.mark.parametrize("dim", [1, 3])
@pytest.mark.parametrize("latitude", [np.nan, 0.8], ids=["flat", "earth"])
def test_derivatives_of_an_exchange_are_those_of_finite_differences(
    inverted: bool, ways: float, dim: int, latitude: float
) -> None:
    rng, n, step = np.random.default_rng(3), 20, 1e-6
    x = context(rng, n, inverted, ways, dim == 1)
    x[:, at.ORIGIN] = latitude
    model = AcousticExchange("usbl", dim, np.zeros(3), VARIABLES, x)
    at_state, still = state(rng, n), np.zeros((n, 3))
    _, H = model.predict(at_state, still)
    for variable, jacobian in H.items():
        for k in range(jacobian.shape[2]):
            d = np.zeros(jacobian.shape[2])
            d[k] = step
            moved = [_moved(at_state, variable, sign * d) for sign in (1.0, -1.0)]
            slope = (model.predict(moved[0], still)[0] - model.predict(moved[1], still)[0]) / (2 * step)
            np.testing.assert_allclose(jacobian[:, :, k], slope, atol=2e-5 * max(1.0, np.abs(slope).max()))


def _moved(s: State, variable: str, d: np.ndarray) -> State:
    if variable == "pose":
        R = s.R_nb @ exp_rotation(np.tile(d[:3], (len(s), 1)))
        return State(R, s.p_n + s.R_nb @ d[3:], s.v_n, s.bias, s.calibration)
    if variable == "velocity":
        return State(s.R_nb, s.p_n, s.v_n + d, s.bias, s.calibration)
    return State(s.R_nb, s.p_n, s.v_n, s.bias, {**s.calibration, variable: s.calibration[variable] + d})


# what a reply is made of


def acoustics_of(config: Config, **ship: float) -> Acoustics:
    """With a ship that goes north at 2 m/s and turns at 0.1 rad/s, rolling."""
    found = Acoustics(config, {s: i for s, i in instruments(config).items() if s in ("usbl", "range")})
    t = np.arange(0.0, 20.0, 0.5)
    tables = {
        "ship": np.column_stack([2.0 * t, np.zeros_like(t), np.full_like(t, np.nan)]),
        "ship_heading": 0.1 * t[:, None],
        "ship_tilt": np.column_stack([0.02 * t, np.zeros_like(t)]),
    }
    found.take_ship({name: Stream(name, (), t, data, np.arange(len(t))) for name, data in tables.items()})
    return found


def reply(time: float, length: float, bearing: float, elevation: float) -> Stream:
    row = np.full((1, 11), np.nan)
    row[0, [0, 2, 3]] = length, bearing, elevation
    return Stream("usbl", (), np.array([time]), row, np.array([2]))


@pytest.mark.parametrize(
    ("stamp", "answered", "heard"),
    [("reply", 10.0 - 0.5 - 0.1, 10.0), ("transponder", 10.0 + 0.1, 10.7), ("arrival", 10.0 - 0.5 - 0.1, 10.0)],
)
def test_a_reply_stands_where_the_vehicle_answered_and_the_ship_where_it_heard(stamp, answered, heard):
    config = parse_config(f"usbl: {{stamp: {stamp}, turn_around_s: 0.2, sound_speed_mps: 1500}}")
    one = acoustics_of(config).exchanges(reply(10.0, 750.0, 0.3, 0.8), 0.0, Counter())
    x = one.data[0, 6:]
    np.testing.assert_allclose(one.time, answered)
    np.testing.assert_allclose(x[at.HEARD : at.HEARD + 3], [2.0 * heard, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(x[at.ASKED : at.ASKED + 3], [2.0 * (heard - 1.2), 0.0, 0.0], atol=1e-9)
    R = matrix_from_rpy([0.02 * heard, 0.0, 0.1 * heard])
    np.testing.assert_allclose(x[at.FRAME : at.FRAME + 9].reshape(3, 3), R, atol=1e-9)
    np.testing.assert_allclose(
        x[at.SEEN : at.SEEN + 3], [np.cos(0.3) * np.cos(0.8), np.sin(0.3) * np.cos(0.8), np.sin(0.8)]
    )


def test_lever_arms_turn_with_the_ship_and_heights_count_from_the_waterline():
    config = parse_config("{usbl: {lever_arm_m: [8, 0, 3]}, ship: {antenna_m: [-5, 0, -12]}}")
    x = acoustics_of(config).exchanges(reply(10.0, 750.0, 0.3, 0.8), 0.0, Counter()).data[0, 6:]
    R = matrix_from_rpy([0.2, 0.0, 1.0])
    head, antenna = R @ [8.0, 0.0, 3.0], R @ [-5.0, 0.0, -12.0]
    np.testing.assert_allclose(x[at.HEARD : at.HEARD + 3], [20.0 + (head - antenna)[0], (head - antenna)[1], head[2]])


def test_replies_without_a_ship_near_are_counted_and_left_out():
    left_out: Counter[tuple[str, str]] = Counter()
    assert not len(acoustics_of(parse_config("")).exchanges(reply(40.0, 700.0, 0.3, 0.8), 0.0, left_out))
    assert left_out == {("usbl", "without a position of the ship"): 1}


def test_a_ship_that_says_no_tilt_any_more_makes_directions_less_precise():
    found = acoustics_of(parse_config(""))
    found.signals["ship_tilt"].time, found.signals["ship_tilt"].values = np.arange(2.0), np.zeros((2, 2))
    near, far = (found.exchanges(reply(t, 150.0, 0.3, 0.8), 0.0, Counter()).data[0, 4] for t in (3.0, 15.0))
    assert far**2 - near**2 == pytest.approx(np.radians(3.0) ** 2 - np.radians(0.1) ** 2)


def test_the_ships_own_sd_takes_precedence():
    found = acoustics_of(parse_config("{ship: {sd_m: 0.1}, usbl: {range_sd_m: 0.3}}"))
    found.signals["ship"].values[10:, 2] = 5.0
    sds = [found.exchanges(reply(t, 15.0, 0.3, 0.8), 0.0, Counter()).data[0, 3] for t in (3.0, 15.0)]
    np.testing.assert_allclose(sds, np.hypot(0.3, [0.1, 5.0]))


def test_beyond_the_end_of_its_log_the_ship_goes_on_smoothly():
    found, t = Acoustics(Config(), {}), np.arange(0.0, 20.0, 0.1)
    noise = 0.1 * np.where(np.arange(len(t)) % 2, 1.0, -1.0)
    found.signals["ship"].take(t, np.column_stack([2.0 * t + noise, noise, noise]))
    for end in (-2.0, 22.0):
        assert found.signals["ship"].at(np.array([end]), 3.0)[0][0, 0] == pytest.approx(2.0 * end, abs=0.8)


def test_replies_without_a_length_are_left_out():
    no_reply, soon = np.full((2, 1, 11), np.nan)
    no_reply[0, 4:7], soon[0, 1:4] = 0.0, (0.1, 0.3, 0.8)
    for row, config in ((no_reply, ""), (soon, "usbl: {turn_around_s: 0.3}")):
        left_out: Counter[tuple[str, str]] = Counter()
        stream = Stream("usbl", (), np.array([10.0]), row, np.array([2]))
        assert not len(acoustics_of(parse_config(config)).exchanges(stream, 0.0, left_out))
        assert left_out == {("usbl", "no length of its way: 0, or a travel time within the turn-around"): 1}


def test_replies_do_not_wait_for_a_part_of_the_ship_that_has_fallen_silent():
    found, late = Acoustics(Config(), {"usbl": instruments(Config())["usbl"]}), {"usbl": 0.0}
    for t in np.arange(0.0, 40.0, 0.5):
        says = {"ship": [2.0 * t, 0.0, np.nan], "ship_heading": [0.1 * t], "ship_tilt": [0.0, 0.0]}
        for sensor, values in says.items() if t < 10.0 else list(says.items())[:2]:
            found.insert(Measurement(t, sensor, np.array(values), 0), late, Counter())
        made = found.insert(Measurement(t, "usbl", reply(t, 150.0, 0.3, 0.8).data[0], 0), late, Counter())
    assert len(made) == 1 and not found.waiting


@pytest.mark.parametrize("apart", [0.0, 0.004])
def test_receivers_at_a_jetty_are_paired_live_too(apart):
    arms = {"0": (0.5, 0.5, 1.0), "1": (0.5, -0.5, 1.0), "2": (-0.5, -0.5, 1.0)}
    ship = {"receivers": arms, "north_m": 0.0, "east_m": 0.0, "heading_deg": 0.0}
    config = Config().changed(range={"one_way": True}, ship=ship)
    found, made = Acoustics(config, {"range": instruments(config)["range"]}), []
    for t in range(5):
        for k in range(3):
            values = np.array([15.0 + 0.1 * k, np.nan, np.nan, k, np.nan, np.nan])
            made += found.insert(Measurement(t + apart * k, "range", values, 0), {"range": 0.0}, Counter())
    assert Counter(m.values[2 + at.WAYS] for m in made) == {0.0: 8, 1.0: 4}  # the last wait


def test_another_transponder_at_the_same_time_ends_no_dive():
    found, left_out = acoustics_of(parse_config("")), Counter()
    for t, names in ((5.0, [1.0]), (6.0, [1.0, 2.0])):
        rows = np.repeat(reply(t, 150.0, 0.3, 0.8).data, len(names), axis=0)
        rows[:, 7] = names
        stream = Stream("usbl", (), np.full(len(names), t), rows, np.arange(len(names)))
        assert len(found.exchanges(stream, 0.0, left_out)) == 1
    assert left_out == {("usbl", "another transponder than the first, without usbl.beacon"): 1}


def test_elevations_that_stand_at_90_degrees_are_named():
    values = reply(5.0, 150.0, 0.3, 0.8).data.repeat(50, axis=0)
    assert not list(SENSORS["usbl"].look(values, Config()))
    values[:11, 3] = 0.5 * np.pi
    ((_, text, _),) = SENSORS["usbl"].look(values, Config())
    assert text.startswith("its elevation is 90 degrees in 11 of 50 replies")


def test_a_ship_on_a_grid_is_named_where_the_start_is_not():
    ship = np.array([[5540000.0, 447995.0, np.nan]])
    ((_, text, _),) = SENSORS["ship"].look(ship, parse_config("start: {north_m: 0, east_m: 0}"))
    assert "eastings and northings of a grid" in text
    for start in ("start: {}", "start: {north_m: 5540100, east_m: 448000}"):
        assert not list(SENSORS["ship"].look(ship, parse_config(start)))


def test_depth_that_is_given_is_not_used_again():
    config = parse_config("usbl: {depth: given}")
    sd = acoustics_of(config).exchanges(reply(10.0, 750.0, 0.3, 0.8), 0.0, Counter()).data[0, 3:6]
    assert sd[2] > 1e5 > 1.0 > sd[0]


def test_a_start_from_a_system_that_is_given_the_depth_is_as_near_as_its_bearings_are():
    log, config = below_a_ship()
    measured, given = (initialise(log, config.changed(usbl={"depth": of})).prior.p_sd for of in ("measured", "given"))
    np.testing.assert_allclose(given[:2], measured[:2])
    assert given[:2].max() <= 5.0


# sound


@pytest.mark.parametrize("angle", [0.2, 0.8, 1.5])
@pytest.mark.parametrize("seconds", [0.05, 0.6])
def test_rays_and_means_are_those_of_the_closed_form_in_a_constant_gradient(angle, seconds):
    g, begin = -0.05, 3.0
    water = SoundSpeedProfile(np.array([0.0, 2000.0]), np.array([1540.0, 1540.0 + 2000.0 * g]))
    (across,), (down,) = water.trace(begin, np.array([angle]), np.array([seconds]))
    c1, c2 = 1540.0 + g * begin, 1540.0 + g * (begin + down)
    assert np.arccosh(1.0 + g**2 * (across**2 + down**2) / (2.0 * c1 * c2)) / abs(g) == pytest.approx(seconds, abs=2e-8)
    (mean,) = water.mean(np.array([begin]), np.array([begin + down]))
    assert mean == pytest.approx(g * down / np.log(c2 / c1), abs=1e-3)


def test_a_speed_of_sound_of_each_measurement_takes_precedence():
    raw = reply(5.0, np.nan, 0.3, 0.8)
    row = np.repeat(raw.data, 3, axis=0)
    row[:, 1], row[:, -1] = 0.05 + 0.1, [np.nan, 1450.0, 1550.0]
    stream = replace(raw, time=5.0 + np.arange(3.0), data=row, row=np.arange(3))
    made = acoustics_of(parse_config("usbl: {turn_around_s: 0.05}")).exchanges(stream, 0.0, Counter())
    np.testing.assert_allclose(made.data[:, 0], [75.0, 72.5, 77.5])
    row[:, -1] = [4900.0, 0.0, 1800.0]  # of 0 or less is not known
    refused = {why: bad.tolist() for why, bad in SENSORS["usbl"].refused(row, Config()) if why.startswith("a speed")}
    assert refused == {
        "a speed of sound in ft/s, by its size": [True, False, False],
        "a speed of sound beyond 1300 to 1700 m/s": [False, False, True],
    }


def test_a_profile_is_read_from_rows_and_files_and_what_is_none_is_refused(tmp_path):
    rows = profile_of(((0.0, 1510.0), (50.0, 1490.0)))
    (tmp_path / "cast.csv").write_text("Depth,Sound_Speed\n0,1510\n50,1490\n")
    read = profile_of(str(tmp_path / "cast.csv"))
    assert rows is not None and read is not None and profile_of(None) is None
    ends = np.array([0.0]), np.array([40.0])
    assert rows.mean(*ends) == read.mean(*ends) == pytest.approx(1502.0, abs=0.1)
    for bad in (((50.0, 1490.0), (0.0, 1510.0)), ((0.0, 4954.0), (50.0, 4888.0)), ((0.0, 1500.0),)):
        with pytest.raises(InputError, match=r"sound\.profile: "):
            profile_of(bad)
    (tmp_path / "cast.csv").write_text("depth,sound_speed\nm,m/s\n0,1510\n")
    with pytest.raises(InputError, match="are no numbers"):
        _read.__wrapped__(tmp_path / "cast.csv")
    (tmp_path / "cast.csv").write_text("depth,c\n0,1510\n")
    with pytest.raises(InputError, match="expected columns depth and sound_speed"):
        _read.__wrapped__(tmp_path / "cast.csv")


def test_a_bent_ray_is_made_straight():
    """In a thermocline the head hears the vehicle from where it is not."""
    water = ((0.0, 1510.0), (20.0, 1510.0), (40.0, 1480.0), (200.0, 1480.0))
    config = parse_config("{}").changed(
        sound={"profile": water}, ship={"north_m": 0.0, "east_m": 0.0, "heading_deg": 0}
    )
    profile = profile_of(water)
    assert profile is not None
    angle, seconds = 0.5, 0.1
    (across,), (down,) = profile.trace(0.0, np.array([angle]), np.array([seconds]))
    found = Acoustics(config, {"usbl": instruments(config)["usbl"]})
    one = found.exchanges(reply(10.0, 1500.0 * seconds, 0.0, angle), 0.0, Counter()).data[0]
    seen = one[6 + at.SEEN : 6 + at.SEEN + 3]
    np.testing.assert_allclose(one[0] * seen, [across, 0.0, down], atol=1e-6)
    assert abs(np.arctan2(down, across) - angle) > 0.02


def test_without_a_depth_a_profile_is_used_from_where_the_dive_begins_and_that_is_said():
    water = ((0.0, 1520.0), (100.0, 1480.0))
    log, config = below_a_ship()
    log = replace(log, streams={name: stream for name, stream in log.streams.items() if name not in ("depth", "usbl")})
    config = config.changed(sound={"profile": water}, start={"north_m": 0.0, "east_m": 0.0, "down_m": 60.0})
    initial = initialise(log, config)
    assert sum("sound.profile is used with the vehicle at 60 m" in line for line in initial.assumptions) == 1
    found = Acoustics(initial.config, {"range": initial.instruments["range"]})
    found.take_ship(log.streams)
    stream = log["range"].take(np.arange(4))
    made, profile = found.exchanges(stream, 0.0, Counter()), profile_of(water)
    assert profile is not None
    shares = made.data[:, 0] / stream.data[np.argsort(made.row), 0]
    speeds = [profile.mean(np.array([60.0]), np.array([b.down_m]))[0] for b in config.beacons]
    np.testing.assert_allclose(sorted(shares), sorted(np.array(speeds) / 1500.0), rtol=1e-9)


def test_receivers_that_share_a_clock_become_one_range_and_differences():
    arms = {"0": (0.5, 0.5, 1.0), "1": (0.5, -0.5, 1.0), "2": (-0.5, -0.5, 1.0), "3": (-0.5, 0.5, 1.0)}
    ship = {"receivers": arms, "north_m": 0.0, "east_m": 0.0, "heading_deg": 0.0}
    config = Config().changed(range={"one_way": True, "sd_m": 0.03, "common_sd_m": 0.2}, ship=ship)
    found = Acoustics(config, {"range": instruments(config)["range"]})
    point, rows = np.array([12.0, 7.0, 9.0]), np.full((4, 5), np.nan)
    for k, arm in enumerate(arms.values()):
        rows[k, [0, 3]] = np.linalg.norm(point - arm) + 5.0, k  # a clock that is 5 m off
    stream = Stream("range", (), np.full(4, 10.0), rows, np.arange(4))
    made = found.exchanges(stream, 0.0, Counter())
    x, z = made.data[:, 2 : 2 + at.WIDTH], made.data[:, 0]
    state = State(np.eye(3)[None], point[None], np.zeros((1, 3)), np.zeros((1, 6)), _zero())
    model = found.instruments["range"].model
    assert isinstance(model, AcousticExchange)
    predicted = np.array([model.of(row[None]).predict(state, np.zeros((1, 3)))[0][0, 0] for row in x])
    ways = x[:, at.WAYS]
    np.testing.assert_allclose(z - predicted, np.where(ways == 1.0, 5.0, 0.0), atol=1e-9)
    assert sorted(ways) == [0.0, 0.0, 1.0]
    np.testing.assert_allclose(made.data[ways == 0.0, 1], 0.03 * np.sqrt(2.0))


def _zero() -> dict[str, np.ndarray]:
    return {name: np.zeros(variable.dim) for name, variable in TABLE.items()}


# dives


def test_a_log_taken_as_a_whole_gives_what_its_measurements_give_one_by_one():
    log, config = below_a_ship()
    initial = initialise(log, config)
    whole, some = assembly_of(initial), assembly_of(initial)
    whole.take(log)
    for m in log.measurements():
        some.insert(m)
        some.extend()
    for assembly in (whole, some):
        assembly.extend(finish=True)
    a, b = whole.problem, some.problem
    assert np.count_nonzero(a.which == a.sensors.index("usbl")) > 40
    same(a.of, b.of)
    same(a.rows, b.rows)


def test_restored_from_its_state_an_assembly_goes_on_with_the_ship():
    log, config = below_a_ship()
    initial, measurements, cut = initialise(log, config), [*log.measurements()], 4000
    before, after = assembly_of(initial), assembly_of(initial)
    for m in measurements[:cut]:
        before.insert(m)
        before.extend()
    after.restore(before.state(len(before)))
    for assembly in (before, after):
        for m in measurements[cut:]:
            assembly.insert(m)
            assembly.extend()
        assembly.extend(finish=True)
    same(before.problem.rows[-100:], after.problem.rows[-100:])


@pytest.mark.parametrize("sensor", ["range", "usbl"])
def test_exchanges_that_are_taken_again_give_what_they_gave_in_their_time(sensor):
    log, config = below_a_ship()
    initial, measurements = initialise(log, config), [*log.measurements()]
    usual, again = assembly_of(initial), assembly_of(initial)
    first = next(m for m in measurements if m.sensor == sensor)  # from which clocks drift
    for m in measurements:
        usual.insert(m)
        if m.sensor != sensor or m is first or m.time > 30.0:  # half of them are kept out
            again.insert(m)
    for assembly in (usual, again):
        assembly.extend()
    n = len(again)
    again.take_again([m for m in measurements if m.sensor == sensor], n)
    assert len(again) == n
    same(usual.problem.rows, again.problem.rows)
    same(usual.problem.of, again.problem.of)


def rms(log_config: tuple[Log, Config], dive: Dive, **keys: object) -> tuple[float, object]:
    found = smooth(*log_config, "smoothed", **keys)
    track = found.estimates[0].trajectory
    error = track.p_n - dive.motion.local(track.time)
    return float(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))), found


def test_late_stamps_that_nobody_states_are_found_among_outliers_and_the_track_is_right():
    dive = below_ship(Setting(seconds=200.0, round_ship=True, latency=1.5, yaw=2.0, crew=False, outliers=0.1), 4)
    error, found = rms(campaign_log(dive), dive)
    late = next(e for e in found.estimates[0].calibration if e.label == "usbl_time_offset")
    assert error < 0.6 and late.estimated and abs(late.value - 1.5) < max(0.1, 3.0 * late.sd)
    assert any(re.search(r"its stamps are 1\.[45]\d s late", line) for line in found.assumptions)
    assert found.verdict == "trusted"  # single outliers are what the gate is for


def test_a_healthy_dive_is_trusted_and_has_no_late_stamps():
    dive = below_ship(Setting(seconds=120.0), 5)
    error, found = rms(campaign_log(dive), dive)
    assert error < 0.6 and found.verdict == "trusted"
    assert not any("late" in line or "turn by" in line for line in found.assumptions)


@pytest.mark.slow
def test_a_beacon_is_found_from_ranges_alone_and_on_one_leg_both_sides_are_told():
    dive = acoustics.one_beacon(1, straight=False, seconds=700.0)
    _, found = rms(campaign_log(dive), dive)
    beacon = {e.label: e for e in found.estimates[0].calibration}
    assert found.verdict == "trusted" and beacon["beacon_1_north"].sd < 12.0
    dive = acoustics.one_beacon(0, straight=True, seconds=250.0)
    _, found = rms(campaign_log(dive), dive)
    beacon = {e.label: e for e in found.estimates[0].calibration}
    assert found.verdict == "doubtful" and "mirrored" in found.warnings[0]
    assert np.hypot(beacon["beacon_1_north"].sd, beacon["beacon_1_east"].sd) > 100.0
    filtered = smooth(*campaign_log(dive), "filtered")
    beacon = {e.label: e for e in filtered.estimates[0].calibration}
    assert filtered.estimates[0].kind == "filtered" and filtered.verdict == "doubtful"
    assert np.hypot(beacon["beacon_1_north"].sd, beacon["beacon_1_east"].sd) > 100.0


@pytest.mark.slow
def test_the_scales_of_dvl_and_ranges_do_not_grow_together_about_a_beacon_that_nobody_placed():
    """A gyro's scale is off by 2.6 of its sds; 4 % of the DVL and as much of the speed of sound fit better."""
    dive = acoustics.one_beacon(6)
    error, found = rms(campaign_log(dive), dive)
    scale = next(e for e in found.estimates[0].calibration if e.label == "sound_speed_scale")
    assert error < 2.0 and abs(scale.value) < 0.02


@pytest.mark.parametrize(
    ("present", "settings", "hidden"),
    [
        (["dvl", "range"], "beacons: [{name: 1}]", True),
        (["dvl", "range", "fix"], "beacons: [{name: 1}]", False),
        (["dvl", "range"], "beacons: [{name: 1}, {name: 2, north_m: 0, east_m: 0}]", False),
        (["dvl", "range"], "ship: {receivers: {'0': [0, 0, 1]}}", False),
        (["dvl", "depth"], "", False),
    ],
)
def test_only_ranges_to_beacons_that_nobody_placed_hide_the_scale_of_the_dvl(present, settings, hidden):
    chain = SimpleNamespace(blocks=dict.fromkeys(present), initial=SimpleNamespace(config=parse_config(settings)))
    assert correlated_noise._hidden_by_ranges(chain) == (("dvl_error",) if hidden else ())


def test_a_dive_with_a_usbl_alone_begins_where_it_puts_the_vehicle():
    dive = below_ship(Setting(seconds=60.0), 1)
    dive = replace(dive, streams={s: x for s, x in dive.streams.items() if s not in ("dvl", "depth")})
    error, found = rms(campaign_log(dive), dive)
    assert error < 1.5 and found.verdict == "trusted"


def test_beacons_without_a_depth_are_sought_below_the_track():
    dive = acoustics.among_beacons(0, 4, 0.5, 1.0, 0.0, seconds=120.0)
    placed = [{key: b[key] for key in ("name", "north_m", "east_m", "sd_m")} for b in dive.configuration["beacons"]]
    truth = [b["down_m"] for b in dive.configuration["beacons"]]
    error, found = rms(campaign_log(replace(dive, configuration={**dive.configuration, "beacons": placed})), dive)
    entries = {e.label: e for e in found.estimates[0].calibration}
    off = [
        (entries[f"beacon_{k + 1}_down"].value - z) / entries[f"beacon_{k + 1}_down"].sd for k, z in enumerate(truth)
    ]
    assert error < 0.5 and found.verdict == "trusted" and np.abs(off).max() < 3.0


@pytest.mark.slow
def test_dives_below_a_ship_are_consistent_and_a_wrong_sd_fails():
    nees = {1.0: [], 0.2: []}
    for seed in range(20):
        dive = below_ship(Setting(seconds=120.0, dvl=False), seed)
        for factor in nees:
            scaled = {"range_sd_m": 0.2 * factor, "angle_sd_deg": 0.5 * factor}
            log, config = campaign_log(dive)
            config = config.changed(usbl=scaled, graph={"find_noise": False})
            track = smooth(log, config, "smoothed").estimates[0].trajectory
            d = (track.p_n - dive.motion.local(track.time))[::10, :2]
            P = track.cov_p[::10, :2, :2]
            nees[factor].append(float(np.einsum("ni,nij,nj->n", d, np.linalg.inv(P), d).mean() / 2.0))
    assert 0.3 < np.mean(nees[1.0]) < 1.6 < np.mean(nees[0.2])


@pytest.mark.slow
def test_isam2_ends_where_the_chain_does():
    log, config = below_a_ship()
    isam2 = config.changed(graph={"solver": "isam2"})
    a, b = (smooth(log, one, "smoothed").estimates[0].trajectory for one in (config, isam2))
    np.testing.assert_allclose(a.p_n[-1], b.p_n[-1], atol=1e-3)
    np.testing.assert_allclose(a.cov_p[-1], b.cov_p[-1], rtol=1e-2)


def test_a_configuration_that_is_written_in_full_expects_no_acoustics_live():
    case = simulated(falcon(), 45.0, imu_rate=50.0)
    whole = parse_config(case.config.to_yaml())
    assert "usbl" in whole.model_fields_set
    known = flown(replace(case, config=whole)).navigator.engine.initial.instruments
    assert "dvl" in known and not {"usbl", "range"} & known.keys()
