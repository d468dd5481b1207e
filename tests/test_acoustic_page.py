"""Acoustic replies, ship and beacons: in the results folder, on its page, on maps and on the live page."""

import json
import math
import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from test_live_page import server, solution  # noqa: F401
from test_pages import panels_of, unpacked

import rovgraph as rg
from rovgraph.live.message import Message, Reading
from rovgraph.live.navigator import Navigator
from rovgraph.live.solution import BeaconPlace, RangeCircle, ShipPose
from rovgraph.report.export import read_track
from rovgraph.report.pages.acoustics import acoustic_replies, acoustics_sections, beacons
from rovgraph.report.pages.reporting import page_of
from rovgraph.report.pages.source import DiveSource, ResultsSource

SHIP, HEADING, BEACON = np.array([-10.0, 20.0]), np.radians(30.0), np.array([5.0, 5.0, 8.0])
BAD = 20  # reply that is 50 m too long


@pytest.fixture(scope="module")
def result():
    """A head of 0.2 m and 0.5 deg on a ship at rest, and ranges to a beacon whose name is a number."""
    made = rg.simulate("lawnmower", seed=4, choices=rg.Choices(duration=90))
    truth, rng = made.truth, np.random.default_rng(1)
    time = np.arange(2.0, 88.0, 1.0) + 0.003
    p = np.column_stack([np.interp(time, truth.time, axis) for axis in truth.p_n.T])
    off = np.column_stack([p[:, :2] - SHIP, p[:, 2]])
    length = np.linalg.norm(off, axis=1)
    replies = pd.DataFrame(
        {
            "time": time,
            "usbl_range": length + rng.normal(0.0, 0.2, len(time)) + 50.0 * (np.arange(len(time)) == BAD),
            "usbl_bearing": np.arctan2(off[:, 1], off[:, 0]) - HEADING + rng.normal(0.0, 0.01, len(time)),
            "usbl_elevation": np.arcsin(off[:, 2] / length) + rng.normal(0.0, 0.01, len(time)),
        }
    )
    far = np.linalg.norm(p - BEACON, axis=1) + rng.normal(0.0, 0.1, len(time))
    ranges = pd.DataFrame({"time": time + 0.5, "range": far, "range_beacon": 7})
    frame = pd.concat([made.log.to_frame(), replies, ranges]).sort_values("time", kind="stable")
    said = {
        "ship": {"north_m": -10.0, "east_m": 20.0, "heading_deg": 30.0},
        "usbl": {"frame": "ship", "angle_sd_deg": 0.6, "range_sd_m": 0.2, "planar": False},
        "range": {"sd_m": 0.5},
        "beacons": [{"name": 7, "north_m": 5.0, "east_m": 5.0, "down_m": 8.0, "sd_m": 0.5}],
        "environment": {"origin_lat_deg": 58.0, "origin_lon_deg": 11.0},
    }
    config = replace_in(made.config, said)
    return rg.smooth(rg.Log.from_frame(frame, config), config)


def replace_in(config, said):
    """A configuration with some keys of its sections, or whole sections, changed."""
    known = json.loads(config.model_dump_json())
    return rg.Config.model_validate({**known, **{key: {**known[key], **new} if isinstance(new, dict) else new
                                                 for key, new in said.items()}})  # fmt: skip


@pytest.fixture(scope="module")
def folder(result, tmp_path_factory):
    out = tmp_path_factory.mktemp("acoustic") / "results"
    result.save(out, figures=False)
    return out


def source_of(folder):
    source = ResultsSource.read(folder)
    return DiveSource(source.folder, source.summary)


def test_each_reply_is_written_with_where_the_ship_was_and_what_it_measured(folder, result):
    table = pd.read_csv(folder / "acoustics.csv")
    assert list(table["sensor"].value_counts()) == [86, 86]
    usbl, ranges = (table[table["sensor"] == name] for name in ("usbl", "range"))
    np.testing.assert_allclose(usbl[["ship_north", "ship_east"]], np.tile(SHIP, (86, 1)), atol=1e-6)
    np.testing.assert_allclose(usbl["ship_heading"], HEADING, atol=1e-6)
    assert (ranges["beacon"] == 7).all() and ranges[["ship_north", "ship_heading", "bearing"]].isna().all(axis=None)
    residuals = pd.read_csv(folder / "residuals.csv")
    own = residuals[residuals["sensor"] == "usbl"].drop_duplicates("row")
    assert [*own["row"]] == [*usbl["row"]]


def test_replies_put_the_vehicle_where_it_was(folder):
    replies = acoustic_replies(source_of(folder))
    off = np.linalg.norm(replies.measured - replies.estimated, axis=1)
    assert np.median(off[replies.aimed & replies.used]) < 0.6
    assert (~replies.used).sum() >= 1 and off[~replies.used].max() > 30.0
    ahead, starboard = replies.in_axes(replies.measured - replies.other_end)[replies.aimed & replies.used].T
    bearing = replies.direction[replies.aimed & replies.used]
    apart = (np.degrees(np.arctan2(starboard, ahead)) - bearing + 180.0) % 360.0 - 180.0
    assert np.abs(apart).max() < 10.0  # as measured and as estimated
    left = np.linalg.norm(replies.left_over, axis=1)[replies.aimed & replies.used]
    np.testing.assert_allclose(np.median(left), np.median(off[replies.aimed & replies.used]), rtol=0.5)


def test_the_page_has_ship_beacons_and_replies_on_the_map_and_a_part_on_acoustics(folder):
    html = (folder / "report.html").read_text()
    panels = panels_of(html)
    track = {trace["name"]: trace for trace in panels["Track, coloured by its sd"]["traces"]}
    assert {"ship", "ship's heading", "beacon", "beacon, one sd", "reply, used (85)"} <= set(track)
    assert track["beacon"]["text"] == ["7"]
    ring = unpacked(track["beacon, one sd"]["y"])
    assert 0.0 < np.nanmax(ring) - 5.0 < 1.5
    assert {"The vehicle as seen from the ship", "Rose of residuals", "Across: residual against direction"} <= set(
        panels
    )
    assert 'id="acoustics"' in html
    assert "85 of 86 directions and ranges were used" in html


def test_beacons_are_told_with_the_sds_of_the_dive(folder):
    (beacon,) = beacons(source_of(folder))
    assert beacon.name == "7" and np.linalg.norm(np.array(beacon.place) - BEACON[:2]) < 1.0
    assert 0.0 < max(beacon.sd) <= 0.5 and abs(beacon.correlation) < 1.0
    sizes = np.linalg.norm(beacon.ellipse - beacon.place, axis=1)
    assert min(beacon.sd) * 0.99 <= sizes.max() <= np.hypot(*beacon.sd)


def test_a_folder_without_the_file_has_a_page_without_the_part(folder, tmp_path):
    own = shutil.copytree(folder, tmp_path / "results")
    (own / "acoustics.csv").unlink()
    assert acoustics_sections(source_of(own)) == []
    assert "The vehicle as seen from the ship" not in page_of(own)


def test_maps_hold_the_beacon_and_the_ship_alike_from_a_folder_and_from_a_result(folder, result, tmp_path):
    for track in (read_track(folder), result.track()):
        assert set(track.acoustics.beacons) == {"7"} and len(track.acoustics.ship) == 86
    rg.export(result, ["geojson"], out=tmp_path)
    features = json.loads((tmp_path / "track_smoothed.geojson").read_text())["features"]
    kinds = {feature["properties"]["kind"]: feature for feature in features}
    _, lat = kinds["beacon"]["geometry"]["coordinates"]
    assert (lat - 58.0) * 111.4e3 == pytest.approx(5.0, abs=1.0)
    assert kinds["ship"]["geometry"]["type"] == "LineString"


def test_the_navigator_hands_ship_beacons_and_ranges_over(result):
    navigator = Navigator(result.log.config, patient=True, reinitialise=False)
    last = 40.0
    for m in result.log.measurements():
        if m.time < last:
            navigator.take(Message("log", m.time, m.time, (Reading(m.sensor, m.values),)))
    shown = navigator.solution()
    navigator.close()
    assert shown.ship == ShipPose(-10.0, 20.0, pytest.approx(HEADING))
    (beacon,) = shown.beacons
    assert beacon.name == "7" and math.hypot(beacon.north - 5.0, beacon.east - 5.0) < 1.5
    circles = {circle.name: circle for circle in shown.ranges}
    assert set(circles) == {"", "7"}
    for circle in circles.values():
        away = math.hypot(shown.position[0] - circle.north, shown.position[1] - circle.east)
        assert circle.radius == pytest.approx(away, abs=2.0)


def test_the_live_page_is_told_of_ship_beacons_and_ranges_where_they_are_known(server):  # noqa: F811
    server.show(solution())
    state = server.client.get("/api/state").json()
    assert (state["ship"], state["beacons"], state["ranges"]) == (None, [], [])
    around = {
        "ship": ShipPose(1.0, 2.0, math.nan),
        "beacons": (BeaconPlace("7", 5.0, 5.0, 0.5, 0.4, 0.0),),
        "ranges": (RangeCircle("", 1.0, 2.0, 30.0),),
    }
    server.show(replace(solution(1.0), **around))
    state = server.client.get("/api/state").json()
    assert state["ship"] == {"north": 1.0, "east": 2.0, "heading": None}
    assert state["beacons"][0]["name"] == "7" and state["ranges"][0]["radius"] == 30.0
