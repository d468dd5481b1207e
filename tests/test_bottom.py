"""The bottom under a track: soundings, altitude and slope by a DVL's ranges, in results, exports and live."""

import json
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from dives import by_beams, changed, falcon, simulated, started
from test_export import circle

import rovgraph as rg
from rovgraph.cli.app import main
from rovgraph.geometry import matrix_from_rpy, rotate
from rovgraph.inference.bottom import RANGE_SD, SLOPE_SD, Bottom, bottom_under
from rovgraph.inference.trajectory import Trajectory, read_trajectory
from rovgraph.kernels.earth import radii
from rovgraph.live.navigator import Navigator
from rovgraph.live.outputs.json_lines import as_dict
from rovgraph.log import STREAMS, Stream
from rovgraph.model.config import Config, parse_config
from rovgraph.model.grids import PLACE_DECIMALS
from rovgraph.model.origin import north_east
from rovgraph.report.export import ExportOptions, Track, write_track
from rovgraph.report.results import Remarks, write_results
from rovgraph.sensors.dvl_beam import BEAMS, beam_geometry

SLOPE, DEPTH = np.array([0.2, -0.1]), 14.0
HEAD = "beams: {angle_deg: 22.5, azimuth_deg: [135, 225, 315, 45], first_number: 0}"
MOUNTED = f"dvl: {{mount_rpy_deg: [0, 0, 30], lever_arm_m: [0.3, 0.1, 0.2], {HEAD}}}"
ORIGIN = (42.05, 3.12)


def slant(track: Trajectory, config: Config, R_bs: np.ndarray, arm_b: np.ndarray) -> np.ndarray:
    """True ranges along the beams from each epoch to a bottom that is a slope, shape (n, 4)."""
    geometry = beam_geometry(config.dvl)
    assert geometry is not None
    u = rotate((track.R_nb @ R_bs)[:, None], geometry.directions[None])
    head = track.p_n + rotate(track.R_nb, arm_b)
    return (DEPTH + head[:, :2] @ SLOPE - head[:, 2])[:, None] / (u @ [*-SLOPE, 1.0])


def beam_stream(time: np.ndarray, ranges: np.ndarray, quantity: str = "range") -> Stream:
    data = np.full((len(time), 9, 5), np.nan)
    data[:, : ranges.shape[1], 0] = np.isfinite(ranges)
    data[:, : ranges.shape[1], 2 + (quantity == "distance")] = ranges
    return Stream(BEAMS, STREAMS[BEAMS], time, data.reshape(len(time), -1), np.arange(len(time)))


@pytest.fixture(scope="module")
def track() -> Trajectory:
    """A turn with roll and pitch, whose attitude is known to a milliradian, and its depth to 5 cm."""
    known = circle(0.0)
    cov = np.tile(np.eye(3), (len(known), 1, 1))
    return replace(known, cov_p=cov * 0.05**2, cov_theta=cov * 1e-3**2, cov_v=cov * 0.01**2)


@pytest.fixture(scope="module")
def config() -> Config:
    return parse_config(MOUNTED)


@pytest.fixture(scope="module")
def ranges(track, config) -> np.ndarray:
    dvl = config.dvl
    return slant(track, config, matrix_from_rpy(np.deg2rad(dvl.mount_rpy_deg)), np.array(dvl.lever_arm_m))


def found(track, config, ranges, calibration=None, quantity="range") -> Bottom:
    bottom = bottom_under(track, {BEAMS: beam_stream(track.time, ranges, quantity)}, config, calibration or {})
    assert bottom is not None
    return bottom


def true_altitude(track: Trajectory) -> np.ndarray:
    return DEPTH + track.p_n[:, :2] @ SLOPE - track.p_n[:, 2]


@pytest.mark.parametrize("quantity", ["range", "distance"])
def test_four_ranges_give_altitude_depth_and_slope_of_the_bottom(track, config, ranges, quantity):
    measured = ranges * (np.cos(np.deg2rad(22.5)) if quantity == "distance" else 1.0)
    bottom = found(track, config, measured, quantity=quantity)
    under = bottom.under(track)
    np.testing.assert_allclose(under["altitude"], true_altitude(track), atol=2e-3)
    np.testing.assert_allclose(under["bottom_depth"], track.p_n[:, 2] + true_altitude(track), atol=2e-3)
    np.testing.assert_allclose(
        np.column_stack([under["slope_north"], under["slope_east"]]), SLOPE[None] + 0 * track.p_n[:, :2], atol=2e-3
    )
    soundings = bottom.soundings
    np.testing.assert_allclose(soundings["depth"], DEPTH + soundings[["north", "east"]] @ SLOPE, atol=1e-9)
    assert len(soundings) == 4 * len(track) and set(soundings["beam"]) == {0, 1, 2, 3}


def test_soundings_far_from_the_origin_are_metres_from_the_vehicle(track, config, ranges):
    latitude, away = 70.0, np.array([1e5, 0.0, 0.0])
    on_earth = config.with_values(environment={"frame": "earth", "origin_lat_deg": latitude, "origin_lon_deg": 5.0})
    near, far = found(track, config, ranges), found(replace(track, p_n=track.p_n + away), on_earth, ranges)
    metres = [(b.soundings[["north", "east"]].to_numpy() - np.repeat(b.place[:, :2], 4, axis=0)) for b in (near, far)]
    M, N = radii(np.deg2rad(np.array([latitude, latitude + np.rad2deg(1e5 / radii(np.deg2rad(latitude))[0])])))
    east = N[0] * np.cos(np.deg2rad(latitude)) / (N[1] * np.cos(np.deg2rad(latitude) + 1e5 / M[0]))
    assert east > 1.04
    np.testing.assert_allclose(metres[1], metres[0] * [M[0] / M[1], east], rtol=1e-5)


@pytest.mark.parametrize("share", [0.003, 0.03])
def test_sds_are_those_of_the_errors_whatever_the_noise_of_ranges(track, config, ranges, share):
    """The noise is found where four beams show it."""
    noisy = ranges * (1.0 + np.random.default_rng(2).normal(0.0, share, ranges.shape))
    under = found(track, config, noisy).under(track)
    for name, true in (("altitude", true_altitude(track)), ("slope_north", SLOPE[0]), ("slope_east", SLOPE[1])):
        z = (under[name] - true) / under[f"{name}_sd"]
        assert 0.8 < np.sqrt(np.mean(z**2)) < 1.15, name
    np.testing.assert_allclose(under["bottom_depth_sd"], np.hypot(under["altitude_sd"], 0.05), rtol=1e-9)


def test_two_ranges_show_the_slope_along_their_line_and_one_shows_none(track, config, ranges):
    two = ranges.copy()
    two[:, [1, 3]] = np.nan  # an opposite pair remains, 135 and 315 degrees from a head turned by 30
    bottom = found(track, config, two)
    yaw = track.rpy[:, 2] + np.deg2rad(135.0 + 30.0)
    along = np.column_stack([np.cos(yaw), np.sin(yaw)])
    across = np.column_stack([-along[:, 1], along[:, 0]])
    g, C = bottom.plane[:, 1:], bottom.cov_plane[:, 1:, 1:]
    sd = [np.sqrt(np.einsum("ni,nij,nj->n", v, C, v)) for v in (along, across)]
    assert sd[0].max() < 0.04 and sd[1].min() > 0.9 * SLOPE_SD
    assert (np.abs(((g - SLOPE) * along).sum(axis=1)) < 3.0 * sd[0]).all()
    under = bottom.under(track)
    assert (np.abs(under["altitude"] - true_altitude(track)) < 3.0 * under["altitude_sd"]).all()
    two[:, 0] = np.nan
    one = found(track, config, two).under(track)
    assert np.isnan(one["slope_north"]).all() and np.isfinite(one["altitude"]).all()
    assert (one["altitude_sd"] > 2.0 * under["altitude_sd"]).all()
    assert (np.abs(one["altitude"] - true_altitude(track)) < 3.0 * one["altitude_sd"]).all()


def test_a_spike_is_left_out_and_a_step_is_not(track, config, ranges):
    changed = ranges.copy()
    changed[50, 2] *= 0.5
    changed[150:] *= 0.8  # the edge of a wreck
    bottom = found(track, config, changed)
    assert not bottom.used[50, 2] and bottom.used.sum() == bottom.used.size - 1
    assert bottom.soundings["used"].eq(0).sum() == 1


def test_nothing_is_known_far_from_a_ping_or_without_ranges(track, config, ranges):
    gap = ranges.copy()
    gap[100:200] = np.nan
    under = found(track, config, gap).under(track)
    lost = (track.time > track.time[99] + 1.01) & (track.time < track.time[200] - 1.01)
    assert np.isnan(under["altitude"][lost]).all() and np.isfinite(under["altitude"][~lost]).all()
    assert bottom_under(track, {BEAMS: beam_stream(track.time, ranges * np.nan)}, config, {}) is None
    assert bottom_under(track, {}, config, {}) is None


def test_the_scale_of_a_piston_is_that_of_its_ranges_and_of_a_phased_array_not(track, config, ranges):
    known = {"dvl_scale": (0.02, 0.01)}
    long = found(track, config, 1.02 * ranges, known)
    np.testing.assert_allclose(long.plane[:, 0], true_altitude(track), atol=3e-3)
    exact = found(track, config, 1.02 * ranges, {"dvl_scale": (0.02, 0.0)})
    more = np.sqrt(long.cov_plane[:, 0, 0] - exact.cov_plane[:, 0, 0])
    np.testing.assert_allclose(more, 0.01 * true_altitude(track), rtol=0.0, atol=0.003)  # but for the lever arm
    phased = parse_config(MOUNTED.replace("first_number: 0", "first_number: 0, phased: true"))
    phased = changed(phased, dvl={"sound_speed_mps": 1536.0})  # at which its beams point as stated
    np.testing.assert_allclose(found(track, phased, ranges, known).plane[:, 0], true_altitude(track), atol=3e-3)


def test_one_altitude_is_along_the_axis_of_the_dvl(track):
    config = parse_config("dvl: {lever_arm_m: [0, 0, 0.2]}")
    far = (10.0 - track.p_n[:, 2]) / track.R_nb[:, 2, 2] - 0.2  # over a flat bottom
    stream = Stream("dvl_altitude", ("dvl_altitude",), track.time, far[:, None], np.arange(len(track)))
    bottom = bottom_under(track, {"dvl_altitude": stream}, config, {})
    assert bottom is not None and bottom.numbers == (-1,)
    under = bottom.under(track)
    np.testing.assert_allclose(under["bottom_depth"], 10.0, atol=1e-9)
    assert "slope_north" in under and np.isnan(under["slope_north"]).all()
    offset = np.linalg.norm(bottom.arm_n[:, 0, :2], axis=1) * SLOPE_SD
    least = np.hypot(offset, RANGE_SD[0] * far)
    assert (under["altitude_sd"] > least).all() and (under["altitude_sd"] < 1.3 * least + 0.02).all()


# a dive from log to page


@pytest.fixture(scope="module")
def smoothed(tmp_path_factory):
    """A dive of 40 s by beams, whose beam 2 is lost in its second half, with ranges; its results in a folder."""
    case = simulated(
        falcon(dvl={"velocity_sd_mps": [1e-5] * 3, "mount_rpy_deg": [0.0, 0.0, -45.0]}),
        40.0,
        seed=3,
        dvl_rate=4.0,
        imu_rate=50.0,
    )

    def lost(time, along):
        along[time > 20.0, 2] = np.nan

    log, config = by_beams(case.log, started(case), lost)
    log = replace(log, origin=ORIGIN)
    c = case.dive.hidden["calibration"]
    R_bs = matrix_from_rpy(np.array([[float(c[name][0]) for name in ("dvl_roll", "dvl_pitch", "dvl_yaw")]]))[0]
    here = case.truth.clamped(log[BEAMS].time)
    far = slant(here, config, R_bs, np.array(config.dvl.lever_arm_m) + c["dvl_lever_arm"]) * (1.0 + c["dvl_scale"][0])
    data = log[BEAMS].data.reshape(-1, 9, 5).copy()
    noise = np.random.default_rng(1).normal(0.0, 0.01, far.shape)
    data[:, :4, 2] = np.where(data[:, :4, 0] == 1.0, far * (1.0 + noise), np.nan)
    log = replace(log, streams={**log.streams, BEAMS: replace(log[BEAMS], data=data.reshape(len(data), -1))})
    result = rg.smooth(log, config)
    folder = tmp_path_factory.mktemp("bottom") / "results"
    result.save(folder, figures=False)
    return case, log, config, result, folder


def test_results_hold_altitude_bottom_and_soundings(smoothed):
    case, _, _, result, folder = smoothed
    table = pd.read_csv(folder / "trajectory_smoothed.csv")
    true = true_altitude(case.truth.clamped(table["time"].to_numpy()))
    assert (np.abs(table["altitude"] - true) < 4.0 * table["altitude_sd"]).mean() > 0.99
    assert (np.abs(table["slope_north"] - SLOPE[0]) < 4.0 * table["slope_north_sd"]).mean() > 0.99
    np.testing.assert_allclose(table["bottom_depth"], table["down"] + table["altitude"], atol=1e-5)
    assert {"lat", "altitude", "altitude_sd"} <= set(table)
    assert len(read_trajectory(folder / "trajectory_smoothed.csv")) == len(table)
    assert "altitude" in pd.read_csv(folder / "trajectory_filtered.csv", nrows=1)
    assert "altitude_sd" not in pd.read_csv(folder / "trajectory_dead_reckoning.csv", nrows=1)
    soundings = pd.read_csv(folder / "soundings.csv")
    own = result.bottom.soundings
    pd.testing.assert_frame_equal(soundings[own.columns], own, rtol=1e-5, atol=1e-4)
    there = north_east(soundings["lat"], soundings["lon"], ORIGIN)
    np.testing.assert_allclose(np.column_stack(there), own[["north", "east"]], atol=1e-3)
    assert soundings.groupby("beam").size()[2] < 0.6 * soundings.groupby("beam").size()[1]


def test_soundings_are_in_the_grid_that_is_stated(smoothed, tmp_path):
    pyproj = pytest.importorskip("pyproj")
    _, log, config, result, _ = smoothed
    write_results(tmp_path, [result.smoothed], log, changed(config, environment={"grid": "EPSG:32631"}), {}, Remarks())
    table = pd.read_csv(tmp_path / "soundings.csv")
    x, y = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32631", always_xy=True).transform(table["lon"], table["lat"])
    np.testing.assert_allclose(table[["easting", "northing"]], np.column_stack([x, y]), atol=2e-4)
    track = pd.read_csv(tmp_path / "trajectory_smoothed.csv", nrows=1)
    assert [name for name in table if name not in result.bottom.soundings] == [
        name for name in track if name in PLACE_DECIMALS
    ]


def test_the_page_shows_every_beam_and_the_bottom(smoothed):
    folder = smoothed[-1]
    html = (folder / "report.html").read_text(encoding="utf-8")
    for said in ("Velocities along the beams", "Error velocity", "Velocity along beam 3", "Bottom under the track"):
        assert said in html
    assert "100.0 % of" in html and "it never fell silent" in html  # three beams saw the bottom
    error = pd.read_csv(folder / "dvl_beams.csv")["error_velocity"]
    assert error.notna().sum() > 50 and error.tail(10).isna().all()


def test_soundings_are_exported_by_the_command(smoothed, tmp_path, monkeypatch):
    folder = smoothed[-1]
    options = ["--to", "xyz", "--to", "geotiff", "--cell", "0.5", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["rovgraph", "export", str(folder), *options])
    with pytest.raises(SystemExit) as stop:
        main()
    assert not stop.value.code
    xyz = np.loadtxt(tmp_path / "track_smoothed.xyz")
    table = pd.read_csv(folder / "soundings.csv")
    np.testing.assert_allclose(xyz, np.column_stack([table["east"], table["north"], -table["depth"]]), atol=1e-3)
    rasterio = pytest.importorskip("rasterio")
    with rasterio.open(tmp_path / "track_smoothed.tif") as grid:
        assert grid.crs.to_epsg() == 32631 and grid.res == (0.5, 0.5)
        assert grid.descriptions == ("height [m]", "sd [m]", "soundings")
        assert np.nansum(grid.read(3)) == len(table)


def test_live_solutions_tell_altitude_and_every_beam(smoothed):
    case, log, config, *_ = smoothed
    navigator = Navigator(config, patient=True)
    before = replace(log, streams={name: s for name, s in log.streams.items() if name != BEAMS})
    navigator.replay(log)
    solution = navigator.solution()
    assert solution is not None and solution.altitude is not None and solution.altitude_sd is not None
    true = true_altitude(case.truth.clamped(np.array([solution.time])))[0]
    assert abs(solution.altitude - true) < 4.0 * solution.altitude_sd < 0.2 * true
    assert solution.bottom_depth == pytest.approx(float(solution.position[2]) + solution.altitude, abs=0.05)
    assert {name: solution.sensors[f"dvl_beam_{name}"].state for name in (1, 2)} == {1: "ok", 2: "no lock"}
    assert solution.sensors["dvl_beam_2"].failed_s == pytest.approx(20.0, abs=1.0)
    line = json.loads(json.dumps(as_dict(solution)))
    assert line["altitude"] == pytest.approx(solution.altitude) and "bottom_depth_sd" in line
    plain = Navigator(config, patient=True)
    plain.replay(before)
    bare = plain.solution()
    assert bare is not None and not {"altitude", "bottom_depth", "dvl_beam_1"} & {*as_dict(bare), *bare.sensors}


# exports by themselves


def sounded(**change) -> Track:
    """A track with four soundings in two cells of a metre, and a spike."""
    north, east = np.array([0.2, 0.4, 0.3, 5.2, 0.3]), np.array([0.2, 0.3, 0.4, 0.3, 0.3])
    depth, used = np.array([10.0, 11.0, 12.0, 20.0, 3.0]), np.array([1, 1, 1, 1, 0])
    columns = {"time": np.arange(5.0), "beam": 1, "north": north, "east": east, "depth": depth, "used": used}
    return replace(Track("dive", "smoothed", circle(), ORIGIN, soundings=pd.DataFrame(columns)), **change)


def test_a_grid_has_mean_sd_and_count_where_the_soundings_are(tmp_path):
    rasterio, pyproj = pytest.importorskip("rasterio"), pytest.importorskip("pyproj")
    (path,) = write_track(sounded(surface=2.0), ["geotiff"], tmp_path, ExportOptions(crs="EPSG:32631", cell=2.0))
    to_grid = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32631", always_xy=True)
    x, y = to_grid.transform(*ORIGIN[::-1])
    with rasterio.open(path) as grid:
        count = grid.read(3)
        assert count.sum() == 4 and grid.bounds.left <= x and grid.bounds.bottom <= y <= grid.bounds.top
        height = grid.read(1)
        assert np.nansum(height * count) == pytest.approx(4 * 2.0 - 53.0)
        assert np.isnan(height[count == 0]).all()
        far = next(grid.sample([(x, y + 5.2)]))
        assert far[0] == pytest.approx(-18.0) and np.isnan(far[1]) and far[2] == 1.0


def test_xyz_has_metres_of_the_dive_or_coordinates_of_a_map(tmp_path):
    (path,) = write_track(sounded(origin=None), ["xyz"], tmp_path, ExportOptions())
    np.testing.assert_allclose(np.loadtxt(path)[3], [0.3, 5.2, -20.0])
    pyproj = pytest.importorskip("pyproj")
    (path,) = write_track(sounded(), ["xyz"], tmp_path / "map", ExportOptions(crs="utm"))
    x, y = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32631", always_xy=True).transform(*ORIGIN[::-1])
    np.testing.assert_allclose(np.loadtxt(path)[0], [x + 0.2, y + 0.2, -10.0], atol=0.02)


@pytest.mark.parametrize(
    ("change", "name", "options", "said"),
    [
        ({"soundings": None}, "xyz", ExportOptions(), "there are no soundings of the smoothed track"),
        ({"origin": None}, "geotiff", ExportOptions(), "place on Earth is unknown"),
        ({}, "geotiff", ExportOptions(crs="EPSG:4326"), "is in degrees, a grid needs metres"),
        ({}, "geotiff", ExportOptions(cell=0.0), "cell 0: makes no grid"),
        ({}, "geotiff", ExportOptions(cell=1e-5), "makes no grid"),
    ],
)
def test_what_makes_no_soundings_is_one_line(tmp_path, change, name, options, said):
    with pytest.raises(rg.InputError, match=said):
        write_track(sounded(**change), [name], tmp_path, options)
    assert not list(tmp_path.iterdir())
