"""Every exported file is opened by another library than the one that wrote it, and shows the same positions."""

import json
import os
import re
import shutil
import sqlite3
import subprocess
import sys
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import rovgraph as rg
from rovgraph.cli.app import main
from rovgraph.geometry import Array, matrix_from_rpy
from rovgraph.inference.trajectory import Trajectory
from rovgraph.report.export import ExportFormat, ExportOptions, Fixes, Track, export_formats, tag, write_track
from rovgraph.report.export import formats as registry

ORIGIN = (42.05, 3.12)
BEGAN = 1_771_000_000.0  # Unix time
WITHIN_M = 0.01
NAME = 'Taucher <1> & "Möwe" </script>'


def circle(start: float = BEGAN, seconds: float = 60.0) -> Trajectory:
    """A turn of 20 m radius in 60 s, heading along it, 2 m deeper at its end, less certain with time."""
    time = np.round(start + np.arange(0.0, seconds + 0.1, 0.2), 4)
    turn = 2.0 * np.pi * (time - start) / 60.0
    p = np.column_stack([20.0 * np.sin(turn), 20.0 * (1.0 - np.cos(turn)), 3.0 + 2.0 * (time - start) / seconds])
    rate = 2.0 * np.pi / 60.0
    v = np.column_stack([20.0 * rate * np.cos(turn), 20.0 * rate * np.sin(turn), np.full(len(time), 2.0 / seconds)])
    R = matrix_from_rpy(np.column_stack([np.full(len(time), 0.05), np.full(len(time), -0.1), turn]))
    grow = (0.1 + 0.01 * (time - start))[:, None, None] ** 2
    P = grow * np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 0.1]])
    return Trajectory(time, p, R, v, P, 1e-4 * grow * np.eye(3), 0.01 * grow * np.eye(3))


def track(origin: tuple[float, float] | None = ORIGIN, start: float = BEGAN) -> Track:
    time = start + np.array([10.0, 20.0, 30.0])
    fixes = Fixes(time, np.array([[17.0, 10.0], [17.0, 30.0], [90.0, 90.0]]), np.array([True, True, False]))
    return Track(NAME, "smoothed", circle(start), origin, fixes)


def written(name: str, folder, options: ExportOptions | None = None, of: Track | None = None):
    (path,) = write_track(of or track(), [name], folder, options or ExportOptions())
    return path


def off(lat: Array, lon: Array, time: Array, of: Track | None = None) -> float:
    """The largest distance of places from the truth at their times [m]."""
    from pymap3d import geodetic2ned

    at = (of or track()).trajectory.at(np.asarray(time, float))
    north, east, _ = geodetic2ned(np.asarray(lat), np.asarray(lon), 0.0, *ORIGIN, 0.0)
    return float(np.hypot(north - at.p_n[:, 0], east - at.p_n[:, 1]).max())


def test_geojson_has_the_track_points_with_sds_ellipses_and_fixes(tmp_path):
    pyogrio = pytest.importorskip("pyogrio.raw")
    path = written("geojson", tmp_path)
    features = json.loads(path.read_text(encoding="utf-8"))["features"]
    kinds = pd.Series([f["properties"]["kind"] for f in features]).value_counts()
    assert (kinds["track"], kinds["point"], kinds["fix"]) == (1, 61, 3) and kinds["ellipse"] > 50
    assert features[0]["properties"]["name"] == NAME
    points = [f for f in features if f["properties"]["kind"] == "point"]
    lon, lat, up = np.array([f["geometry"]["coordinates"] for f in points]).T
    time = np.array([f["properties"]["time"] for f in points])
    assert off(lat, lon, time) < WITHIN_M
    assert np.abs(up + circle().at(time).p_n[:, 2]).max() < WITHIN_M
    assert points[30]["properties"]["heading"] == pytest.approx(180.0, abs=0.1)
    info, *_ = pyogrio.read(path)
    assert "heading_sd" in info["fields"]


def test_an_ellipse_of_geojson_is_the_one_of_95_percent(tmp_path):
    features = json.loads(written("geojson", tmp_path).read_text(encoding="utf-8"))["features"]
    last = [f for f in features if f["properties"]["kind"] == "ellipse"][-1]
    from pymap3d import geodetic2ned

    lon, lat = np.array(last["geometry"]["coordinates"][0]).T
    north, east, _ = geodetic2ned(lat, lon, 0.0, *ORIGIN, 0.0)
    t = circle()
    d = np.column_stack([north, east]) - t.p_n[-1, :2]
    square = np.einsum("ni,ij,nj->n", d, np.linalg.inv(t.cov_p[-1, :2, :2]), d)
    assert square == pytest.approx(5.991, rel=1e-3)


@pytest.mark.parametrize("name", ["kml", "kmz"])
def test_kml_is_well_formed_and_moves_with_time(tmp_path, name):
    etree = pytest.importorskip("lxml.etree")
    pytest.importorskip("simplekml")
    path = written(name, tmp_path)
    text = path.read_bytes() if name == "kml" else zipfile.ZipFile(path).read("doc.kml")
    root = etree.fromstring(text)
    space = {"k": "http://www.opengis.net/kml/2.2", "gx": "http://www.google.com/kml/ext/2.2"}
    when = pd.to_datetime([e.text for e in root.findall(".//k:when", space)])
    place = np.array([e.text.split() for e in root.findall(".//gx:coord", space)], float)
    seconds = (when - pd.Timestamp(0, tz="UTC")).total_seconds().to_numpy()
    assert off(place[:, 1], place[:, 0], seconds) < WITHIN_M
    assert root.find(".//k:Document/k:name", space).text == f"{NAME}, smoothed"
    assert len(root.findall(".//k:Point", space)) == 3 and len(root.findall(".//k:Polygon", space)) > 50


def test_kml_without_unix_time_is_a_plain_line(tmp_path):
    etree = pytest.importorskip("lxml.etree")
    pytest.importorskip("simplekml")
    root = etree.fromstring(written("kml", tmp_path, of=track(start=0.0)).read_bytes())
    assert not root.findall(".//{*}when") and len(root.find(".//{*}LineString/{*}coordinates").text.split()) == 61


def test_gpx_is_read_back_by_gdal(tmp_path):
    pyogrio, shapely = pytest.importorskip("pyogrio.raw"), pytest.importorskip("shapely")
    pytest.importorskip("gpxpy")
    info, _, geometry, fields = pyogrio.read(written("gpx", tmp_path), layer="track_points")
    points = shapely.from_wkb(geometry)
    elapsed = BEGAN + np.arange(61.0)
    assert off(shapely.get_y(points), shapely.get_x(points), elapsed) < WITHIN_M
    stamps = pd.to_datetime(fields[list(info["fields"]).index("time")].astype(str), utc=True)
    assert (stamps[0] - pd.Timestamp(0, tz="UTC")).total_seconds() == pytest.approx(BEGAN)


@pytest.mark.parametrize("name", ["gpkg", "shp"])
@pytest.mark.parametrize("crs", [None, "utm", "EPSG:25831"])
def test_a_gis_layer_is_where_the_track_is_in_any_coordinates(tmp_path, name, crs):
    geopandas, pyproj = pytest.importorskip("geopandas"), pytest.importorskip("pyproj")
    pytest.importorskip("pyogrio")
    path = written(name, tmp_path, ExportOptions(crs=crs))
    layer = geopandas.read_file(path if name == "gpkg" else path / "track.shp")
    assert str(layer.crs.to_epsg()) == {None: "4326", "utm": "32631", "EPSG:25831": "25831"}[crs]
    degrees = layer.to_crs(4326).geometry
    assert off(degrees.y, degrees.x, layer["time"]) < WITHIN_M
    assert layer["heading_sd"].iloc[-1] > 0.0
    assert ("grid_north" in layer) == (crs is not None)
    if crs is not None:  # the turn from the meridian to the grid's lines, by two points of the grid
        point, to_grid = layer.iloc[0], pyproj.Transformer.from_crs(4326, layer.crs, always_xy=True)
        (x0, y0), (x1, y1) = (to_grid.transform(point["lon"], point["lat"] + d) for d in (-1e-3, 1e-3))
        assert point["grid_north"] == pytest.approx(-np.rad2deg(np.arctan2(x1 - x0, y1 - y0)), abs=1e-4)
        ground = pyproj.Geod(ellps="WGS84").inv(point["lon"], point["lat"] - 1e-3, point["lon"], point["lat"] + 1e-3)[2]
        assert point["grid_scale"] == pytest.approx(np.hypot(x1 - x0, y1 - y0) / ground, abs=1e-6)


def test_nmea_is_read_back_and_no_sentence_is_too_long(tmp_path):
    pynmea2 = pytest.importorskip("pynmea2")
    lines = written("nmea", tmp_path, ExportOptions(rate=2.0)).read_text(encoding="ascii").split()
    sentences = [pynmea2.parse(line, check=True) for line in lines]
    gga = [s for s in sentences if s.sentence_type == "GGA"]
    assert len(gga) == 121 and {s.sentence_type for s in sentences} == {"GGA", "HDT", "VTG"}
    elapsed = BEGAN + 0.5 * np.arange(121)
    assert off([s.latitude for s in gga], [s.longitude for s in gga], elapsed) < WITHIN_M
    assert max(map(len, lines)) + len("\r\n") <= 82  # NMEA 0183
    vtg = next(s for s in sentences[180:] if s.sentence_type == "VTG")
    assert float(vtg.spd_over_grnd_kmph) == pytest.approx(3.6 * 20.0 * 2.0 * np.pi / 60.0, abs=0.02)


def test_tum_and_kitti_have_the_same_poses(tmp_path):
    tum = np.loadtxt(written("tum", tmp_path))
    kitti = np.loadtxt(written("kitti", tmp_path)).reshape(-1, 3, 4)
    t = circle()
    assert tum[:, 0] == pytest.approx(t.time, abs=1e-4)
    assert np.abs(tum[:, 1:4] - t.p_n).max() < 1e-6
    assert np.abs(kitti[:, :, 3] - t.p_n).max() < 1e-6
    assert np.abs(kitti[:, :, :3] - t.R_nb).max() < 1e-6


@pytest.mark.parametrize("name", ["tum", "kitti"])
def test_evo_reads_the_same_poses(tmp_path, name):
    """As a program of its own: it is under the GPL."""
    program = shutil.which("evo_traj", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    if program is None:
        pytest.skip("evo is not installed")
    path = written(name, tmp_path)
    command = [program, name, path, "--save_as_kitti", "--no_warnings"]
    subprocess.run(command, cwd=tmp_path, env=os.environ | {"HOME": str(tmp_path)}, check=True, capture_output=True)
    poses = np.loadtxt(next(tmp_path.glob("*.kitti"))).reshape(-1, 3, 4)
    assert np.abs(poses[:, :, 3] - circle().p_n).max() < WITHIN_M
    assert np.abs(poses[:, :, :3] - circle().R_nb).max() < 1e-6


@pytest.mark.parametrize("name", ["rosbag2", "mcap"])
def test_a_ros_bag_has_odometry_by_rep_103(tmp_path, name):
    highlevel = pytest.importorskip("rosbags.highlevel")
    from rosbags.typesys import Stores, get_typestore

    found: dict[str, list] = {}
    with highlevel.AnyReader([written(name, tmp_path)], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
        for connection, stamp, raw in bag.messages():
            found.setdefault(connection.topic, []).append((stamp, bag.deserialize(raw, connection.msgtype)))
    t = circle()
    assert {topic: len(rows) for topic, rows in found.items()} == {
        "/path": 1, "/odometry": len(t), "/tf": len(t), "/fix": len(t),
    }  # fmt: skip
    stamp, message = found["/odometry"][75]  # a quarter of the turn: heading east
    assert stamp == round(t.time[75] * 1e9)
    p, q, v = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist.linear
    assert (p.x, p.y, p.z) == pytest.approx((t.p_n[75, 1], t.p_n[75, 0], -t.p_n[75, 2]))
    yaw = np.arctan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y**2 + q.z**2))
    assert yaw == pytest.approx(0.0, abs=1e-6)  # in ROS east is 0, counted anticlockwise
    assert v.x > 2.0 and abs(v.y) < 0.05
    P = message.pose.covariance.reshape(6, 6)
    assert P[0, 0] == pytest.approx(t.cov_p[75, 1, 1]) and P[0, 1] == pytest.approx(t.cov_p[75, 0, 1])
    fixes = [m for _, m in found["/fix"]]
    assert off([m.latitude for m in fixes], [m.longitude for m in fixes], t.time) < WITHIN_M


def test_netcdf_has_units_and_sds_as_cf_wants_them(tmp_path):
    netcdf = pytest.importorskip("netCDF4")
    pytest.importorskip("xarray")
    with netcdf.Dataset(written("netcdf", tmp_path)) as file:
        assert file.featureType == "trajectory" and str(file["trajectory"][...]) == NAME
        assert off(file["latitude"][:], file["longitude"][:], file["time"][:]) < WITHIN_M
        assert file["time"].units.startswith("seconds since 1970")
        assert file["depth"].ancillary_variables == "depth_sd"
        assert file["yaw_sd"][-1] > 0.0


def test_sbet_has_17_doubles_a_record_and_gps_seconds_of_the_week(tmp_path):
    """No library of PyPI reads it; the order is that of PDAL's reader: time, latitude, longitude, ..., heading."""
    path = written("sbet", tmp_path)
    record = np.fromfile(path / "sbet.out", dtype="<f8").reshape(-1, 17)
    week, ahead = 604_800.0, 18.0 - 315_964_800.0  # GPS time is 18 s ahead of UTC since 2017, and counts from 1980
    time = record[:, 0] + np.floor((BEGAN + ahead) / week) * week - ahead
    assert len(record) == 6001 and 0.0 <= record[0, 0] < week
    assert off(np.rad2deg(record[:, 1]), np.rad2deg(record[:, 2]), time) < WITHIN_M
    moving = track().trajectory.at(time)
    assert np.abs(record[:, 3] + moving.p_n[:, 2]).max() < WITHIN_M
    assert np.abs(record[:, 4:7] - moving.v_n).max() < WITHIN_M
    assert record[3000, 9] == pytest.approx(np.pi, abs=1e-3)
    errors = np.fromfile(path / "smrmsg.out", dtype="<f8").reshape(-1, 10)
    assert errors[-1, 1] == pytest.approx(circle().p_sd[-1, 0])


def test_subtitles_follow_the_video_of_the_dive(tmp_path):
    blocks = written("srt", tmp_path, of=track(None)).read_text(encoding="utf-8").strip().split("\n\n")
    number, stamp, place, attitude, utc = blocks[30].split("\n")
    assert (number, stamp) == ("31", "00:00:30,000 --> 00:00:31,000")
    assert place.startswith("N 0.0 m  E 40.0 m ±") and attitude == "heading 180°  depth 4.0 m"
    assert re.fullmatch(r"2026-02-13 \d\d:\d\d:\d\d UTC", utc)


@pytest.mark.parametrize("place", [True, False])
def test_subtitles_are_read_back_by_another_library(tmp_path, place):
    srt = pytest.importorskip("srt")
    of = track() if place else track(None)
    shown = list(srt.parse(written("srt", tmp_path, of=of).read_text(encoding="utf-8")))
    starts = np.array([each.start.total_seconds() for each in shown])
    assert [each.index for each in shown] == list(range(1, 62)) and starts == pytest.approx(np.arange(61.0))
    numbers = np.array([re.findall(r"-?\d+\.\d+", each.content.splitlines()[0])[:2] for each in shown], dtype=float)
    if place:  # shown to six decimals of a degree, and to 0.1 m
        assert off(*numbers.T, BEGAN + starts) < 0.11
    else:
        expected = np.column_stack([np.interp(BEGAN + starts, circle().time, p) for p in circle().p_n[:, :2].T])
        assert np.abs(numbers - expected).max() < 0.051


def test_a_line_across_the_date_line_stays_whole(tmp_path):
    across = Track("Taveuni", "smoothed", circle(), (-16.8, 180.0), track().fixes)
    features = json.loads(written("geojson", tmp_path, of=across).read_text(encoding="utf-8"))["features"]
    assert {f["geometry"]["type"] for f in features} == {"LineString", "Point", "Polygon"}
    for feature in features:
        size = 2 if feature["properties"]["kind"] in ("ellipse", "fix") else 3
        lon = np.array(feature["geometry"]["coordinates"], float).reshape(-1, size)[:, 0]
        assert np.abs(lon - 180.0).max() < 0.01


@pytest.mark.parametrize("start", [BEGAN, 0.0], ids=["dated", "undated"])
@pytest.mark.parametrize("side", [180.0, -180.0])
def test_kml_across_the_date_line_stays_whole(tmp_path, side, start):
    across = replace(track(start=start), origin=(-16.8, side))
    text = written("kml", tmp_path, of=across).read_text(encoding="utf-8")
    found = re.findall(r"(-?\d+\.\d+)[, ]-16\.\d+", text)
    assert len(found) > 100 and np.abs(np.array(found, float) - side).max() < 0.01


@pytest.mark.parametrize("name", ["kml", "geojson", "gpx", "nmea"])
def test_heights_over_a_lake_are_above_the_sea(tmp_path, name):
    lake = track().placed(None, 395.0)
    text = written(name, tmp_path, of=lake).read_text(encoding="utf-8")
    heights = {
        "kml": r"<gx:coord>\S+ \S+ (\S+)</gx:coord>",
        "geojson": r'"Point", "coordinates": \[[-\d.]+, [-\d.]+, ([-\d.]+)\]',
        "gpx": r"<ele>([^<]+)</ele>",
        "nmea": r"GGA,[^\n]*?,([-\d.]+),M,",
    }
    found = np.array(re.findall(heights[name], text), float)
    np.testing.assert_allclose(found, np.interp(np.arange(len(found)), [0, 60], [392.0, 390.0]), atol=0.06)


def test_an_origin_that_is_given_places_results_that_have_none(tmp_path):
    assert off(*track(None).placed(ORIGIN, 0.0).lat_lon, track().trajectory.time) < WITHIN_M
    with pytest.raises(rg.InputError, match=r"export its results with --origin LAT LON, or"):
        written("kml", tmp_path, of=track(None))
    for wrong in ((91.0, 0.0), (0.0, 200.0)):
        with pytest.raises(rg.InputError, match=r"origin .*: expected latitude and longitude in degrees"):
            track(None).placed(wrong, 0.0)
    with pytest.raises(rg.InputError, match="surface: nan is no height"):
        track().placed(None, float("nan"))


@pytest.mark.parametrize("raw", ["line\nbreak", "bell\x07", "\udce9t\udce9"], ids=repr)
@pytest.mark.parametrize("name", ["geojson", "kml", "gpx", "netcdf", "srt"])
def test_a_dive_may_be_called_anything_that_a_file_may(tmp_path, name, raw):
    path = written(name, tmp_path, of=replace(track(), name=raw))
    if name in ("kml", "gpx"):
        pytest.importorskip("lxml.etree").parse(str(path))


def test_times_that_no_calendar_or_ros_has_are_refused_or_left_out(tmp_path):
    with pytest.raises(rg.InputError, match="unix_offset: nan is no number of seconds"):
        track().shifted(float("nan"))
    microseconds = track().shifted(1e15)
    assert "<time>" not in written("gpx", tmp_path, of=microseconds).read_text(encoding="utf-8")
    for name, of in (("rosbag2", microseconds), ("mcap", microseconds), ("mcap", track(start=-30.0))):
        with pytest.raises(rg.InputError, match="state what to add as --unix-offset"):
            written(name, tmp_path / name, of=of)


def test_coordinates_of_another_place_are_warned_of_and_what_is_no_map_is_refused(tmp_path):
    pytest.importorskip("pyproj")
    with pytest.warns(rg.DataWarning, match="WGS 84 / UTM zone 55S is not made for 42.050, 3.120"):
        written("gpkg", tmp_path / "south", ExportOptions(crs="EPSG:32755"))
    for crs in ("EPSG:4978", "EPSG:5773"):
        with pytest.raises(rg.InputError, match="is no map's coordinates"):
            written("gpkg", tmp_path, ExportOptions(crs=crs))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pacific = replace(track(), origin=(-17.0, 179.9999))
        written("gpkg", tmp_path / "pacific", ExportOptions(crs="EPSG:3832"), pacific)


@pytest.mark.parametrize("name", ["geojson", "kml", "gpx", "gpkg", "nmea", "sbet"])
def test_a_dive_of_unknown_place_is_refused_with_what_to_do_and_nothing_is_written(tmp_path, name):
    with pytest.raises(rg.InputError, match=r"state environment\.origin_lat_deg"):
        written(name, tmp_path, of=track(None))
    assert not list(tmp_path.iterdir())


def test_what_needs_utc_says_so(tmp_path):
    with pytest.raises(rg.InputError, match="not Unix time"):
        written("sbet", tmp_path, of=track(start=5.0))
    assert not list(tmp_path.iterdir())
    assert (written("sbet", tmp_path, of=track(start=5.0).shifted(BEGAN)) / "sbet.out").stat().st_size > 0


def test_bad_names_and_rates_and_files_that_are_there_are_refused(tmp_path):
    with pytest.raises(rg.InputError, match="is no format, nearest is geojson"):
        written("geojsn", tmp_path)
    with pytest.raises(rg.InputError, match="rate 0: expected one above 0"):
        written("gpx", tmp_path, ExportOptions(rate=0.0))
    with pytest.raises(rg.InputError, match="crs 'EPSG:1': is not known"):
        written("gpkg", tmp_path, ExportOptions(crs="EPSG:1"))
    with pytest.raises(rg.InputError, match="crs 32632: expected text, such as EPSG:25832"):
        written("gpkg", tmp_path, ExportOptions(crs=32632))  # type: ignore[arg-type]
    written("tum", tmp_path)
    with pytest.raises(rg.InputError, match="exists; choose another --out or give --force"):
        written("tum", tmp_path)


def test_an_estimate_without_sds_is_exported_all_the_same(tmp_path):
    t = circle()
    met = pd.DataFrame({"time": t.time[:1], "beam": 1, "north": 0.0, "east": 0.0, "depth": 9.0, "used": 1})
    bare = Track("bare", "dead_reckoning", Trajectory.certain(t.time, t.p_n, t.R_nb, t.v_n), ORIGIN, soundings=met)
    for name in export_formats():
        written(name, tmp_path / name, of=bare)
    features = json.loads((tmp_path / "geojson" / "track_dead_reckoning.geojson").read_text(encoding="utf-8"))
    assert {f["properties"]["kind"] for f in features["features"]} == {"track", "point"}


def test_a_format_of_another_package_is_found_by_its_entry_point(tmp_path, monkeypatch):
    class Entry:
        name, value = "toy", "toy:FORMAT"

        def load(self):
            return ExportFormat("toy", "toy", ".toy", lambda track, path, options: path.write_text("toy") and None)

    class Broken(Entry):
        def load(self):
            raise ImportError("no module named nonsense")

    monkeypatch.setattr(registry, "entry_points", lambda group: [Entry(), Broken()])
    registry.export_formats.cache_clear()
    try:
        with pytest.warns(rg.DataWarning, match="cannot be loaded"):
            path = written("toy", tmp_path)
        assert path.read_text() == "toy"
    finally:
        registry.export_formats.cache_clear()


def test_tables_get_the_place_at_each_rows_time():
    table = pd.DataFrame({"file": ["b", "a", "c"], "taken": [BEGAN + 30.0, BEGAN + 15.1, BEGAN + 300.0]})
    tagged = tag(table, track(), "taken")
    assert tagged.inside.tolist() == [True, True, False]
    frame, truth = tagged.frame, circle().at(np.array([BEGAN + 30.0, BEGAN + 15.1]))
    assert list(frame["file"]) == ["b", "a", "c"]
    assert frame[["rov_north", "rov_east"]].iloc[:2].to_numpy() == pytest.approx(truth.p_n[:, :2], abs=1e-3)
    assert frame["rov_heading"].iloc[0] == pytest.approx(180.0, abs=0.01) and np.isnan(frame["rov_lat"].iloc[2])
    later = tag(table.assign(taken=table["taken"] - 7.0), track(), "taken", offset=7.0).frame
    assert later["rov_north"].iloc[0] == frame["rov_north"].iloc[0]


def test_dates_are_times_too_where_the_dive_has_unix_time():
    table = pd.DataFrame({"time": pd.to_datetime([BEGAN + 30.0], unit="s", utc=True).strftime("%Y-%m-%dT%H:%M:%SZ")})
    assert tag(table, track()).frame["rov_east"].iloc[0] == pytest.approx(40.0, abs=1e-3)
    with pytest.raises(rg.InputError, match="holds dates, and the dive's time is not Unix time"):
        tag(table, track(start=0.0))


@pytest.mark.parametrize(
    ("table", "column", "words"),
    [
        ({"t": [1.0]}, "time", "column time is not in the table; it has t"),
        ({"time": ["noon"]}, "time", "row 1: 'noon' is neither seconds nor a date"),
        ({"time": [1.0, 2.0]}, "time", "are all outside the dive"),
    ],
)
def test_tables_that_cannot_be_placed_say_why(table, column, words):
    with pytest.raises(rg.InputError, match=words):
        tag(pd.DataFrame(table), track(), column)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """A results folder of a short dive, exported as it was smoothed."""
    out = tmp_path_factory.mktemp("results")
    config = rg.parse_config(f"environment: {{origin_lat_deg: {ORIGIN[0]}, origin_lon_deg: {ORIGIN[1]}}}")
    dive = rg.simulate("circle", config, 1, rg.Choices(duration=40.0))
    dive.save(out / "dive")
    return out


def test_commands_write_what_the_library_does(results, monkeypatch, capsys):
    monkeypatch.chdir(results)
    smooth = ["smooth", "dive/log.csv", "-c", "dive/config.yaml", "-o", "out", "--no-figures", "--export", "geojson"]
    for arguments in (
        smooth,
        ["export", "out", "--to", "tum", "--to", "geojson", "--out", "maps"],
        ["export", "out", "--to", "kml", "--out", "lake", "--origin", "47.7", "9.3", "--surface", "395"],
        ["tag", "out/trajectory_filtered.csv", "out", "--out", "placed.csv"],
    ):
        monkeypatch.setattr("sys.argv", ["rovgraph", *arguments])
        with pytest.raises(SystemExit) as end:
            main()
        assert end.value.code == 0
    rg.export("out", ["tum", "geojson"], out="library")
    rg.export("out", "kml", out="library", origin=(47.7, 9.3), surface=395.0)
    lake, library = ((results / name / "track_smoothed.kml").read_text() for name in ("lake", "library"))
    heights = [re.findall(r"47\.[67]\d*[ ,](3\d\d)", text) for text in (lake, library)]
    assert heights[0] == heights[1] and len(heights[0]) > 20
    for name in ("track_smoothed.ned.tum", "track_smoothed.geojson"):
        assert (results / "maps" / name).read_bytes() == (results / "library" / name).read_bytes()
    assert (results / "out" / "track_smoothed.geojson").stat().st_size > 0
    rg.tag("out/trajectory_filtered.csv", "out", "library.csv")
    assert Path("placed.csv").read_bytes() == Path("library.csv").read_bytes()
    placed, smoothed = pd.read_csv("placed.csv"), pd.read_csv("out/trajectory_smoothed.csv")
    assert placed["rov_north"].to_numpy() == pytest.approx(smoothed["north"].to_numpy(), abs=1e-3)


def test_an_export_that_cannot_be_is_refused_before_the_dive_is_smoothed(results, monkeypatch, capsys):
    monkeypatch.chdir(results)
    monkeypatch.setattr("rovgraph.smooth", lambda *given: pytest.fail("smoothed"), raising=False)
    monkeypatch.setattr("sys.argv", ["rovgraph", "smooth", "dive/log.csv", "-o", "never", "--export", "kml"])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2 and "state environment.origin_lat_deg" in capsys.readouterr().err
    assert not (results / "never").exists()


def test_photos_get_their_place_in_exif_and_keep_their_pixels(results, tmp_path):
    piexif, image = pytest.importorskip("piexif"), pytest.importorskip("PIL.Image")
    t = rg.read_trajectory(results / "dive" / "truth.csv")
    for name in ("1.jpg", "2.jpg"):
        image.new("RGB", (8, 8), (10, 200, 30)).save(tmp_path / name)
    (tmp_path / "photos.csv").write_text(f"time,file\n{t.time[50]},1.jpg\n{t.time[-1] + 60.0},2.jpg\n")
    folder = _smoothed(results)
    tagged = rg.tag(tmp_path / "photos.csv", folder, tmp_path / "placed.csv", exif="file")
    assert [p.name for p in (tmp_path / "placed_photos").iterdir()] == ["1.jpg"]
    gps = piexif.load(str(tmp_path / "placed_photos" / "1.jpg"))["GPS"]
    lat, lon = (sum(a / b / 60.0**k for k, (a, b) in enumerate(gps[key])) for key in (2, 4))
    assert (lat, lon) == pytest.approx((tagged.frame["rov_lat"][0], tagged.frame["rov_lon"][0]), abs=1e-8)
    assert image.open(tmp_path / "placed_photos" / "1.jpg").getpixel((4, 4)) == image.open(tmp_path / "1.jpg").getpixel(
        (4, 4)
    )


def _smoothed(results):
    log, config = results / "dive" / "log.csv", rg.load_config(results / "dive" / "config.yaml")
    folder = results / "exif"
    if not folder.exists():
        rg.smooth(rg.read_log(log, config), config).save(folder, figures=False)
    return folder


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time,a\n{0},1,\n{1},1,\n", "Expected 2 fields in line 2, saw 3"),
        ("time,rov_north\n{0},1\n", "column rov_north: is in the table already"),
        ("time,a\n", "holds no row below its header"),
        ("time,a\n,1\n", "column time: no row has a time"),
        ("time,time\n{0},5\n", "column time stands in the table 2 times"),
    ],
)
def test_a_table_that_can_be_misread_is_refused(folder, tmp_path, text, words):
    (tmp_path / "table.csv").write_text(text.format(BEGAN + 1.0, BEGAN + 2.0))
    with pytest.raises(rg.InputError, match=words):
        rg.tag(tmp_path / "table.csv", folder, tmp_path / "placed.csv")
    assert [path.name for path in tmp_path.iterdir()] == ["table.csv"]


def test_every_row_of_a_table_is_placed_once_whatever_its_index():
    table = pd.DataFrame({"time": BEGAN + np.array([1.0, 2.0, 3.0])}, index=[0, 0, 1])
    frame = tag(table, track()).frame
    assert frame.index.tolist() == [0, 0, 1]
    assert frame["rov_north"].to_numpy() == pytest.approx(circle().at(BEGAN + np.arange(1.0, 4.0)).p_n[:, 0], abs=1e-3)


def test_stamps_of_pandas_are_dates_and_a_missing_one_is_outside_the_dive():
    for missing in (pd.Series(pd.to_datetime([BEGAN + 30.0, np.nan], unit="s")), pd.Series([BEGAN + 30.0, None])):
        tagged = tag(pd.DataFrame({"time": missing}), track())
        assert tagged.inside.tolist() == [True, False]
        assert tagged.frame["rov_east"].iloc[0] == pytest.approx(40.0, abs=1e-3)


def test_a_heading_just_west_of_north_is_none_of_360_degrees(tmp_path):
    t = circle()
    north = replace(t, R_nb=matrix_from_rpy(np.tile([0.0, 0.0, np.deg2rad(-0.0001)], (len(t), 1))))
    frame = tag(pd.DataFrame({"time": [BEGAN + 1.0]}), Track("north", "smoothed", north, ORIGIN)).frame
    assert frame["rov_heading"].tolist() == [0.0]
    text = written("srt", tmp_path, of=Track("north", "smoothed", north)).read_text(encoding="utf-8")
    assert "heading 000°" in text and "360°" not in text


@pytest.fixture
def folder(tmp_path_factory):
    """A results folder, as far as exports read it."""
    out = tmp_path_factory.mktemp("folder")
    circle().write_csv(out / "trajectory_smoothed.csv")
    origin = {"lat_deg": ORIGIN[0], "lon_deg": ORIGIN[1]}
    (out / "summary.json").write_text(json.dumps({"program": "rovgraph", "name": "circle", "origin": origin}))
    return out


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["a/1.jpg", "b/1.jpg"], "rows 1 and 2 both make a copy 1.jpg"),
        (["a/1.jpg", "cut.jpg"], "cut.jpg: is no JPEG"),
        (["a/1.jpg", "p.png"], "p.png: is no JPEG"),
        (["placed_photos/1.jpg"], "holds the photos that are read"),
    ],
)
def test_photos_are_all_copied_or_none(folder, tmp_path, names, words):
    pytest.importorskip("piexif")
    image = pytest.importorskip("PIL.Image")
    for name in ("a/1.jpg", "b/1.jpg", "placed_photos/1.jpg", "p.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        image.new("RGB", (8, 8)).save(tmp_path / name)
    (tmp_path / "cut.jpg").write_bytes((tmp_path / "a/1.jpg").read_bytes()[:3])
    rows = [f"{BEGAN + k},{name}\n" for k, name in enumerate(names)]
    (tmp_path / "table.csv").write_text("time,f\n" + "".join(rows))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(rg.InputError, match=words):
        rg.tag(tmp_path / "table.csv", folder, tmp_path / "placed.csv", exif="f", force=True)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("name", ["gpkg", "shp", "rosbag2"])
def test_what_a_writers_library_cannot_write_is_refused_in_one_line(tmp_path, monkeypatch, name):
    for library in ("pyogrio.raw", "rosbags.rosbag2"):
        pytest.importorskip(library)
    from pyogrio import errors, raw
    from rosbags.rosbag2 import Writer

    def full(error):
        def refuse(*_, **__):
            raise error("disk is full")

        return refuse

    monkeypatch.setattr(raw, "write", full(errors.FeatureError))
    monkeypatch.setattr(Writer, "write", full(sqlite3.OperationalError))
    with pytest.raises(rg.InputError, match=r"cannot be written \(.*disk is full\); choose another --out"):
        written(name, tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_format_that_fails_leaves_nothing_of_the_others(tmp_path):
    with pytest.raises(rg.InputError, match="crs 'EPSG:bogus'"):
        write_track(track(), ["kml", "gpkg"], tmp_path / "out", ExportOptions(None, "EPSG:bogus"))
    assert not [*tmp_path.glob("out/*")]
