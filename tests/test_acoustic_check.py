"""What a check finds in acoustic logs, that following its remedies mends them, and input that cannot be used."""

import json
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from ruamel.yaml import YAML

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from dives import below_a_ship, without
from fault_campaign.acoustic import Acoustic, Ship, System, usbl
from fault_campaign.campaign import merge
from fault_campaign.instruments import log_table, sample
from fault_campaign.motion import Profile
from fault_campaign.scenarios import make_motion
from fault_campaign.vehicle import configuration, make_vehicle

from rovgraph.api.logs import read_log
from rovgraph.diagnosis.check import Finding, acoustics, examine
from rovgraph.diagnosis.check.clocks import overlap
from rovgraph.errors import InputError
from rovgraph.log import STREAMS, Log, Stream
from rovgraph.log.frozen import without_frozen
from rovgraph.model.config import Config, parse_config

CHECKS = acoustics.replies, acoustics.ships, acoustics.ship, acoustics.depths, acoustics.positions
Table = pd.DataFrame


def believed(configuration: dict[str, Any]) -> Config:
    return parse_config(json.dumps(configuration))  # JSON is YAML


@dataclass(frozen=True)
class Dive:
    """A simulated dive of two minutes beside a ship that turns: its tables by sensor, and its configuration."""

    streams: dict[str, Table]
    configuration: dict[str, Any]
    folder: Path

    def read(self, configuration: dict[str, Any], without: tuple[str, ...] = ("imu",), **altered: Table) -> Log:
        """A log with some tables altered, as a configuration has it read."""
        streams = {sensor: table for sensor, table in (self.streams | altered).items() if sensor not in without}
        log_table(streams).to_csv(self.folder / "log.csv", index=False, float_format="%.12g")
        return read_log(self.folder / "log.csv", believed(configuration))


@pytest.fixture(scope="module")
def dive(tmp_path_factory) -> Dive:
    rng, seconds = np.random.default_rng(3), 120.0
    motion = replace(make_motion("survey of 20 minutes", rng), duration=seconds, depth=40.0)
    north, east, _ = motion.local(np.arange(0.0, seconds)).mean(axis=0)
    ship = Ship(
        Profile(north + 60.0, (), ((8.0, 110.0, 0.3),)),
        Profile(east - 40.0, (), ((6.0, 90.0, 1.3),)),
        Profile(0.4, ((20.0, 25.0, 0.8), (65.0, 25.0, -1.1))),
    )
    vehicle, system = make_vehicle("mti", ("ahrs", "depth")), System(angle_sd=0.3)
    streams, _ = sample(motion, vehicle, rng)
    streams |= {"usbl": usbl(motion, ship, system, rng)} | ship.says(seconds, rng)
    config = merge(configuration(vehicle), Acoustic(ship, system).usbl()) | {"start": {}}
    return Dive(streams, config, tmp_path_factory.mktemp("acoustic"))


def found(log: Log, configuration: dict[str, Any], checks=CHECKS) -> list[Finding]:
    """What the acoustic checks warn of."""
    config = believed(configuration)
    return [f for check in checks for f in check(log, config) if f.level != "ok"]


def followed(configuration: dict[str, Any], text: str, choice: int = 0) -> dict[str, Any]:
    """A configuration with what a line says to state, of alternatives one."""
    remedy = re.search(r"(?:state |waterline, )(.*)", text)
    assert remedy is not None, text
    entries = re.findall(r"([a-z_]+(?:\.[a-z_]+)*): (\{[^{}]*\}|\[[^]]*\])", remedy[1].split(", or ")[choice])
    assert entries, text
    for key, value in entries:
        stated = YAML(typ="safe").load(value)
        for name in reversed(key.split(".")):
            stated = {name: stated}
        configuration = merge(configuration, stated)
    return configuration


def altered(table: Table, **columns: Callable[[Table], Any]) -> Table:
    return table.assign(**columns)


def by_place(table: Table) -> Table:
    """The same replies as x, y, z."""
    r, b, e = (table[f"usbl_{name}"] for name in ("range", "bearing", "elevation"))
    x, y, z = r * np.cos(e) * np.cos(b), r * np.cos(e) * np.sin(b), r * np.sin(e)
    return pd.DataFrame({"time": table["time"], "usbl_x": x, "usbl_y": y, "usbl_z": z})


def level(dive: Dive, heading: bool = True) -> Table:
    """The same replies along the ship's level axes, or along north and east."""
    table, attitude = by_place(dive.streams["usbl"]), dive.streams["ship_heading"]
    h, roll, pitch = (
        np.interp(table["time"], attitude["time"], np.unwrap(attitude[f"ship_{a}"]))
        for a in ("heading", "roll", "pitch")
    )
    x, y, z = (table[f"usbl_{axis}"] for axis in "xyz")
    y, z = np.cos(roll) * y - np.sin(roll) * z, np.sin(roll) * y + np.cos(roll) * z
    x, z = np.cos(pitch) * x + np.sin(pitch) * z, -np.sin(pitch) * x + np.cos(pitch) * z
    if not heading:
        x, y = np.cos(h) * x - np.sin(h) * y, np.sin(h) * x + np.cos(h) * y
    return table.assign(usbl_x=x, usbl_y=y, usbl_z=z)


def turned(degrees: float) -> Callable[[Dive], Table]:
    return lambda dive: altered(dive.streams["usbl"], usbl_bearing=lambda t: t["usbl_bearing"] + np.deg2rad(degrees))


def late(seconds: float) -> Callable[[Dive], Table]:
    return lambda dive: altered(dive.streams["usbl"], time=lambda t: t["time"] + seconds)


def own_depth(dive: Dive) -> Table:
    """Along the ship's level axes, z by the vehicle's own sensor below a head at 3 m."""
    depth, table = dive.streams["depth"], level(dive)
    return table.assign(usbl_z=np.round(np.interp(table["time"], depth["time"], depth["depth"]) - 0.3 - 3.0, 1))


# what is wrong, the replies, what the configuration says more, the kind of the finding, and words of it
FAULTS: dict[str, tuple[Callable[[Dive], Table], dict[str, Any], str, str]] = {
    "late": (late(1.5), {}, "lag", "1.5 s late"),
    "early": (late(-0.7), {}, "lag", "0.7 s early"),
    "a delay that is none": (lambda d: d.streams["usbl"], {"delay_s": {"usbl": 1.0}}, "lag", "1.0 s early"),
    "a longer one": (lambda d: d.streams["usbl"], {"delay_s": {"usbl": 2.0}}, "lag", "2.0 s early"),
    "yaw": (turned(30.0), {}, "turned", "head's yaw or the ship's heading is off"),
    "astern": (turned(180.0), {}, "turned", "head's yaw or the ship's heading is off"),
    "applied twice": (turned(0.0), {"usbl": {"mount_rpy_deg": [0, 0, 30]}}, "turned", "applied twice"),
    "anticlockwise": (
        lambda d: altered(d.streams["usbl"], usbl_bearing=lambda t: -t["usbl_bearing"]), {}, "axes", "anticlockwise",
    ),
    "another axis": (
        lambda d: altered(d.streams["usbl"], usbl_bearing=lambda t: 0.5 * np.pi - t["usbl_bearing"]), {}, "axes",
        "x and y are transposed",
    ),
    "transposed": (
        lambda d: by_place(d.streams["usbl"]).rename(columns={"usbl_x": "usbl_y", "usbl_y": "usbl_x"}), {}, "axes",
        "x and y are transposed",
    ),
    "to port": (
        lambda d: altered(by_place(d.streams["usbl"]), usbl_y=lambda t: -t["usbl_y"]), {}, "axes", "y points to port",
    ),
    "levelled by the system": (level, {}, "axes", "axes of the frame ship"),
    "turned north by the system": (lambda d: level(d, False), {}, "axes", "axes of the frame north"),
    "not levelled": (lambda d: d.streams["usbl"], {"usbl": {"frame": "ship"}}, "axes", "the frame transducer"),
    "not turned": (lambda d: d.streams["usbl"], {"usbl": {"frame": "north"}}, "axes", "the frame transducer"),
    "upwards": (
        lambda d: altered(d.streams["usbl"], usbl_elevation=lambda t: -t["usbl_elevation"]), {}, "sign",
        "usbl_elevation counts upwards",
    ),
    "head's depth": (lambda d: d.streams["usbl"], {"usbl": {"lever_arm_m": [8, -2, 13]}}, "zero", "+10.00 m off"),
    "range in feet": (
        lambda d: altered(d.streams["usbl"], usbl_range=lambda t: t["usbl_range"] / 0.3048), {}, "unit",
        "usbl_range is in ft",
    ),
    "place in feet": (
        lambda d: by_place(d.streams["usbl"]).apply(lambda c: c if c.name == "time" else c / 0.3048), {}, "unit",
        "usbl is in ft",
    ),
    "own depth": (own_depth, {"usbl": {"frame": "ship"}}, "repeats", "that sensor's own"),
    "degrees": (
        lambda d: altered(
            d.streams["usbl"], usbl_bearing=lambda t: np.rad2deg(t["usbl_bearing"]),
            usbl_elevation=lambda t: np.rad2deg(t["usbl_elevation"]),
        ), {}, "unit", "in degrees",
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_and_its_remedy_mends_it(dive, fault):
    table, more, kind, words = FAULTS[fault]
    configuration, replies = merge(dive.configuration, more), table(dive)
    checks = (*CHECKS, acoustics_own)
    said = found(dive.read(configuration, usbl=replies), configuration, checks)
    assert [f.kind for f in said] == [kind], [f.text for f in said]
    assert words in said[0].text
    for choice in range(1 + (kind == "lag")):
        mended = followed(configuration, said[0].text, choice)
        assert found(dive.read(mended, usbl=replies), mended, checks) == []


def test_ranges_in_centimetres_are_named_by_the_depth(dive):
    replies = altered(dive.streams["usbl"], usbl_range=lambda t: 100.0 * t["usbl_range"])
    said = found(dive.read(dive.configuration, usbl=replies), dive.configuration, (acoustics.depths,))
    assert [f.kind for f in said] == ["unit"]
    mended = followed(dive.configuration, said[0].text)
    assert mended["units"]["usbl_range"] == "cm"
    assert found(dive.read(mended, usbl=replies), mended, (acoustics.depths,)) == []


@pytest.mark.parametrize("metre", [100.0, 1000.0])
def test_ranges_beyond_reach_name_both_units_that_they_may_be_in(metre):
    """What refuses the log named millimetres only, though centimetres are as likely."""
    log, config = below_a_ship()
    frame = without(log, "usbl").to_frame()
    frame["range"] *= 2.0 * metre
    (text,) = [f.text for f in acoustics_own(Log.from_frame(frame, config), config) if f.level == "error"]
    assert "state units: {range: cm}" in text and "state units: {range: mm}" in text


IN_MS = 2e3 / 1500.0  # travel time there and back of a metre [ms]


@pytest.mark.parametrize(("unit", "metre"), [("ft", 0.3048), ("cm", 0.01)])
def test_ranges_to_beacons_in_another_unit_are_named_by_the_dvls_way(unit, metre):
    log, config = below_a_ship()
    frame = without(log, "usbl").to_frame()
    frame["range"] /= metre
    said = [f for f in acoustics.lengths(Log.from_frame(frame, config), config) if f.level != "ok"]
    assert [f.kind for f in said] == ["unit"] and f"state units: {{range: {unit}}}" in said[0].text
    mended = config.changed(units={"range": unit})
    assert [*acoustics.lengths(Log.from_frame(frame, mended), mended)] == []


@pytest.mark.parametrize(("unit", "metre"), [("ms", IN_MS), ("us", 1e3 * IN_MS)])
def test_travel_times_may_be_stated_in_another_unit(unit, metre):
    log, config = below_a_ship()
    frame = without(log, "usbl").to_frame()
    lengths = frame.pop("range")
    frame["travel_time"] = metre * lengths
    named = [f.text for f in acoustics_own(Log.from_frame(frame, config), config) if f.level == "error"]
    assert len(named) == 1 and f"state units: {{travel_time: {unit}}}" in named[0]
    seconds = Log.from_frame(frame, config.changed(units={"travel_time": unit}))["range"]["travel_time"]
    np.testing.assert_allclose(seconds, lengths[lengths.notna()] / 750.0, rtol=1e-6)


@pytest.mark.parametrize("factor", [1.0, 1.0 / 0.3048])
def test_ranges_of_a_head_in_feet_are_named_without_a_depth_sensor(dive, factor):
    replies = altered(dive.streams["usbl"], usbl_range=lambda t: factor * t["usbl_range"])
    checks, absent = (acoustics.lengths,), ("imu", "depth")
    said = found(dive.read(dive.configuration, absent, usbl=replies), dive.configuration, checks)
    assert [f.kind for f in said] == ["unit"] * (factor > 1.0)
    for finding in said:
        mended = followed(dive.configuration, finding.text)
        assert found(dive.read(mended, absent, usbl=replies), mended, checks) == []


def acoustics_own(log: Log, config: Config) -> Iterator[Finding]:
    from rovgraph.diagnosis.check.values import own

    yield from (f for f in own(log, config) if f.sensor.startswith(("usbl", "ship", "range")))


def test_a_healthy_dive_gets_no_warning(dive):
    report = examine(dive.read(dive.configuration, without=()), believed(dive.configuration))
    assert [f for f in report.findings if f.level != "ok"] == []
    said = [f.text for f in report.findings if f.sensor == "usbl"]
    assert any("depths by range and direction" in text for text in said)
    assert any("fit the DVL's track when its directions are turned by" in text for text in said)


@pytest.mark.parametrize(("error", "warned"), [(7.0, False), (20.0, True)])
def test_a_small_error_of_the_head_s_yaw_is_left_to_the_estimate(dive, error, warned):
    log = dive.read(dive.configuration, usbl=turned(error)(dive))
    assert [f.kind for f in found(log, dive.configuration)] == ["turned"] * warned


@pytest.mark.parametrize(("seconds", "warned"), [(0.2, False), (0.5, True)])
def test_a_lag_within_the_limit_is_not_said(dive, seconds, warned):
    log = dive.read(dive.configuration, usbl=late(seconds)(dive))
    assert [f.kind for f in found(log, dive.configuration)] == ["lag"] * warned


def test_outliers_do_not_hide_a_lag_nor_make_one(dive):
    rng = np.random.default_rng(1)
    for seconds, kinds in ((0.0, []), (2.0, ["lag"])):
        replies = late(seconds)(dive)
        bad = rng.uniform(size=len(replies)) < 0.1
        replies.loc[bad, "usbl_range"] += rng.choice([-50.0, 50.0], bad.sum())
        replies.loc[bad, "usbl_bearing"] += rng.normal(0.0, 0.5, bad.sum())
        log = dive.read(dive.configuration, usbl=replies)
        assert [f.kind for f in found(log, dive.configuration)] == kinds


@pytest.mark.slow
def test_answers_that_repeat_are_counted_once(dive):
    replies = dive.streams["usbl"]
    again = pd.concat([replies.assign(time=replies["time"] + k * 0.19) for k in range(4)]).sort_values("time")
    log = dive.read(dive.configuration, usbl=again)
    left, frozen = without_frozen(log, believed(dive.configuration))
    np.testing.assert_allclose(left["usbl"].time, replies["time"], atol=1e-9)
    assert [(s.sensor, s.kind, s.single) for s in frozen] == [("usbl", "repeated", True)]
    report = examine(log, believed(dive.configuration))
    assert [f.share for f in report.findings if f.kind == "frozen"] == [pytest.approx(0.75)]


# the ship


def sailing(heading: Callable[[np.ndarray], np.ndarray]) -> Log:
    """A ship that sails three legs at 2 m/s, with a heading made from its course."""
    time, slow = np.arange(0.0, 300.0, 0.2), np.arange(0.0, 300.0)
    course = np.select([slow < 100.0, slow < 200.0], [0.3, 1.9], 3.4)
    place = np.cumsum(2.0 * np.exp(1j * course)) + np.random.default_rng(0).normal(0.0, 0.3, (300, 2)) @ [1.0, 1j]
    psi = np.mod(heading(np.interp(time, slow, course)), 2.0 * np.pi)
    values = {"ship": np.column_stack([place.real, place.imag, np.full(300, np.nan)]), "ship_heading": psi[:, None]}
    times = {"ship": slow, "ship_heading": time}
    streams = {s: Stream(s, STREAMS[s], times[s], v, np.arange(len(v))) for s, v in values.items()}
    return Log("ship.csv", streams)


@pytest.mark.parametrize(
    ("heading", "words"),
    [
        (lambda c: c, ""),
        (lambda c: c + np.deg2rad(25.0), ""),  # a current
        (lambda c: c + np.deg2rad(40.0), "+40 deg off the ship's course"),
        (lambda c: c + np.pi, "180 deg off"),
        (lambda c: -c, "angles: {ship_heading: nwu}"),
        (lambda c: 0.5 * np.pi - c, "angles: {ship_heading: enu}"),
    ],
)
def test_the_ship_s_heading_is_compared_with_its_course(heading, words):
    said = [f for f in acoustics.ship(sailing(heading), Config()) if f.level != "ok"]
    assert len(said) == bool(words)
    assert all(words in f.text for f in said)


def test_a_ship_that_drifts_is_not_compared():
    log = sailing(lambda c: c + 2.0)
    slow = replace(log["ship"], data=log["ship"].data * 0.3)
    assert [*acoustics.ship(replace(log, streams={**log.streams, "ship": slow}), Config())] == []


@pytest.mark.parametrize(
    ("sensor", "kept", "count", "words"),
    [
        ("ship", (0.0, 60.0), 57, "ends at 59.0 s"),
        ("ship", (50.0, 200.0), 46, "begins at 50.0 s"),
        ("ship_heading", (0.0, 90.0), 26, "ship_heading begins at 0.0 s and ends at 89.9 s"),
    ],
)
def test_replies_without_the_ship_are_counted(dive, sensor, kept, count, words):
    table = dive.streams[sensor]
    some = table[(table["time"] >= kept[0]) & (table["time"] < kept[1])]
    said = found(dive.read(dive.configuration, **{sensor: some}), dive.configuration, CHECKS[:1])
    assert len(said) == 1
    assert words in said[0].text
    assert abs(int(said[0].text.split()[0]) - count) <= 1


def test_silence_of_the_ship_is_named_where_it_is_too_long(dive):
    table = dive.streams["ship"]
    some = table[(table["time"] <= 40.0) | (table["time"] >= 60.0)]
    said = found(dive.read(dive.configuration, ship=some), dive.configuration, CHECKS[:1])
    assert "is silent for 20.0 s from 40.0 s on" in said[0].text
    bridged = merge(dive.configuration, {"ship": {"max_gap_s": 20.0}})
    assert found(dive.read(bridged, ship=some), bridged, CHECKS[:1]) == []


# input that cannot be used, through the command


@pytest.fixture
def command(monkeypatch, capsys, tmp_path) -> Callable[..., tuple[int, str]]:
    """`rovgraph check` of a log and a configuration; exit code and what it printed, in one line."""
    from rovgraph.cli import app

    def call(dive: Dive, configuration: dict[str, Any], *more: Path, **altered: Table) -> tuple[int, str]:
        streams = {sensor: table[table["time"] < 30.0] for sensor, table in (dive.streams | altered).items()}
        log_table(streams).to_csv(tmp_path / "log.csv", index=False, float_format="%.12g")
        (tmp_path / "c.yaml").write_text(json.dumps(configuration))
        files = [tmp_path / "log.csv", *more]
        monkeypatch.setattr(sys, "argv", ["rovgraph", "check", *map(str, files), "--config", str(tmp_path / "c.yaml")])
        with pytest.raises(SystemExit) as stop:
            app.main()
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return int(stop.value.code or 0), " ".join((out + err).split())

    return call


def beacons(*names: str) -> dict[str, Any]:
    return {"beacons": [{"name": name, "north_m": 0.0, "east_m": 10.0 * k} for k, name in enumerate(names)]}


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        (beacons("A", "B", "A"), "two beacons are named A"),
        (beacons(*"ABCDEFGHI"), "beacons: expected"),
        ({"usbl": {"sound_speed_mps": 0.0}}, "usbl.sound_speed_mps: expected a speed of sound from 1300 to 1700 m/s"),
        ({"usbl": {"sound_speed_mps": 4921.0}}, "if it is in ft/s, state 1500"),
        ({"range": {"sound_speed_mps": 1299.0}}, "range.sound_speed_mps: expected a speed of sound"),
        ({"sound": {"profile": [[0, 4921], [90, 4930]]}}, "in ft/s, multiply them by 0.3048"),
        ({"sound": {"profile": [[60, 1490], [0, 1500]]}}, "positive down; sort it by depth"),
        ({"sound": {"profile": [[0, 1490], [-60, 1500]]}}, "change the sign of its depths, and sort it by them"),
        ({"sound": {"profile": [[0, 1500], [30, 1490], [0, 1500]]}}, "keep one row of each depth"),
        ({"usbl": {"frame": "head"}}, "usbl.frame: expected"),
        ({"ship": {"north_m": 5.0}}, "ship: expected both north_m and east_m, or neither"),
    ],
)
def test_a_configuration_that_cannot_be_is_refused(command, dive, stated, words):
    code, said = command(dive, merge(dive.configuration, stated))
    assert code == 2
    assert words in said


@pytest.mark.parametrize("speed", [1300.0, 1700.0])
def test_speeds_of_sound_in_water_are_taken(speed):
    assert believed({"usbl": {"sound_speed_mps": speed}}).usbl.sound_speed_mps == speed


def test_a_depth_sensor_in_feet_is_named(dive):
    depth = altered(dive.streams["depth"], depth=lambda t: t["depth"] / 0.3048)
    (finding,) = [f for f in found(dive.read(dive.configuration, depth=depth), dive.configuration) if f.kind == "unit"]
    assert (finding.sensor, finding.text.endswith("state units: {depth: ft}")) == ("depth", True)


def several(t: Table) -> Any:
    return np.where(np.arange(len(t)) % 2, 3, 4)


def degrees(column: str) -> Callable[[Table], Any]:
    return lambda t: np.rad2deg(t[column])


@pytest.mark.parametrize(
    ("sensor", "columns", "words"),
    [
        ("usbl", {"usbl_range": lambda t: 1000.0 * t["usbl_range"]}, "state units: {usbl_range: mm}"),
        (
            "usbl",
            {"usbl_travel_time": lambda t: IN_MS * t["usbl_range"], "usbl_range": lambda t: np.nan},
            "state units: {usbl_travel_time: ms}",
        ),
        ("usbl", {"usbl_beacon": several}, "2 transponders answer (3, 4); state which is the vehicle's"),
        ("usbl", {"usbl_bearing": degrees("usbl_bearing")}, "state units: {usbl_bearing: deg}"),
        ("usbl", {"usbl_elevation": degrees("usbl_elevation")}, "state units: {usbl_elevation: deg}"),
        ("usbl", {"usbl_sound_speed": lambda t: 4921.0}, "state units: {usbl_sound_speed: ft/s}"),
        ("ship_heading", {"ship_heading": degrees("ship_heading")}, "state units: {ship_heading: deg}"),
        ("ship_heading", {"ship_roll": degrees("ship_roll"), "ship_pitch": degrees("ship_pitch")}, "{ship_tilt: deg}"),
    ],
)
def test_a_log_that_cannot_be_used_is_refused(command, dive, sensor, columns, words):
    code, said = command(dive, dive.configuration, **{sensor: altered(dive.streams[sensor], **columns)})
    assert code == 2
    assert words in said


def first_ten(column: str, value: float) -> dict[str, Callable[[Table], Any]]:
    return {column: lambda t: np.where(np.arange(len(t)) < 10, value, t.get(column, 1500.0))}


@pytest.mark.parametrize(
    ("columns", "stated", "words"),
    [
        (first_ten("usbl_range", 0.0), {}, "10 of 29 replies (34.5%) are left out: range of 0 or less"),
        (first_ten("usbl_range", -1.0), {}, "10 of 29 replies (34.5%) are left out: range of 0 or less"),
        (first_ten("usbl_sound_speed", 4921.0), {}, "10 of 29 replies (34.5%) are left out: a speed of sound in ft/s"),
        ({"usbl_beacon": several}, {"usbl": {"beacon": 9}}, "usbl.beacon is 9, the log has 3, 4"),
        (first_ten("usbl_elevation", 0.5 * np.pi), {}, "depths by range and direction"),  # right below is no fault
    ],
)
def test_replies_that_cannot_be_used_are_counted_and_the_others_used(command, dive, columns, stated, words):
    replies = altered(dive.streams["usbl"], **columns)
    code, said = command(dive, merge(dive.configuration, stated), usbl=replies)
    assert code == 0
    assert words in said


def test_replies_without_directions_say_what_a_reply_needs(command, dive):
    ranges = dive.streams["usbl"].drop(columns=["usbl_bearing", "usbl_elevation"])
    code, said = command(dive, dive.configuration, usbl=ranges)
    assert code == 0
    assert "left out, expected usbl_bearing, usbl_elevation and usbl_range or usbl_travel_time" in said


def test_ranges_without_beacons_and_to_unknown_ones(command, dive):
    ranges = pd.DataFrame({"time": np.arange(2.0, 28.0), "range": 50.0 + np.arange(26) ** 0.5, "range_beacon": "A"})
    code, said = command(dive, dive.configuration, range=ranges)
    assert (code, "range: it is left out: state beacons" in said) == (0, True)
    code, said = command(dive, merge(dive.configuration, beacons("B", "7")), range=ranges)
    assert (code, "names no such beacon under beacons; it names B, 7, the log has 1 names in words" in said) == (
        0,
        True,
    )


def test_a_ship_without_heading_and_without_place(command, dive):
    attitude = dive.streams["ship_heading"].drop(columns="ship_heading")
    code, said = command(dive, dive.configuration, ship_heading=attitude)
    assert (code, "usbl: it is left out: the ship's heading is not known" in said) == (0, True)
    nothing = pd.DataFrame({"time": np.empty(0)})
    code, said = command(dive, dive.configuration, ship_heading=attitude, dvl=nothing)
    assert code == 2  # nothing else shows where the vehicle is


def test_places_of_the_ship_in_another_unit_are_refused(dive):
    ship = dive.streams["ship"]
    for lat in (4330.5, 433.05e6):
        odd = pd.DataFrame({"time": ship["time"], "ship_lat": lat + 1e-3 * ship.index, "ship_lon": 2 * lat})
        with pytest.raises(InputError, match="expected degrees"):
            dive.read(dive.configuration, ship=odd)


def test_two_ships_in_one_log_are_named(command, dive):
    ship = dive.streams["ship"]
    other = np.where(np.arange(len(ship)) % 2, 500.0, 0.0)
    code, said = command(dive, dive.configuration, ship=ship.assign(ship_north=ship["ship_north"] + other))
    assert (code, "its positions go to and fro by 500 m in" in said) == (0, True)


def test_a_ship_with_one_position_and_replies_in_no_form_are_counted(command, dive):
    code, said = command(dive, dive.configuration, ship=dive.streams["ship"].iloc[10:11])
    assert (code, "left out: without a position of the ship" in said) == (0, True)
    code, said = command(dive, dive.configuration, usbl=dive.streams["usbl"].drop(columns="usbl_range"))
    assert (code, "usbl_x, usbl_y and usbl_z" in said) == (0, True)


@pytest.mark.parametrize("hours", [1.0, -5.5])
def test_a_ship_in_local_time_is_told_by_how_much_and_the_remedy_works(command, dive, hours):
    def local(table: Table) -> Table:
        return table.assign(time=lambda t: t["time"] + 3600.0 * hours)

    ship = {sensor: local(dive.streams[sensor]) for sensor in ("ship", "ship_heading")}
    log = dive.read(dive.configuration, without=(), **ship)
    said = {f.sensor: f.text for f in overlap(log, believed(dive.configuration)) if f.level == "error"}
    assert {*said} == {"ship", "ship_heading", "ship_tilt"}
    stated = dive.configuration
    for text in said.values():
        assert f"its stamps fit {hours:+g} h" in text
        stated = followed(stated, text)
    log = dive.read(stated, without=(), **ship)
    assert not [f for f in overlap(log, believed(stated)) if f.level == "error"]


def test_of_two_ships_in_two_files_one_is_taken_and_said(command, dive, tmp_path):
    other = dive.streams["ship"].assign(ship_north=lambda t: t["ship_north"] + 500.0)
    other[other["time"] < 30.0].to_csv(tmp_path / "other.csv", index=False)
    code, said = command(dive, dive.configuration, tmp_path / "other.csv")
    assert code == 0
    assert "other.csv" in said
    assert "ship" in said
