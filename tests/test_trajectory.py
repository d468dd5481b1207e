"""A trajectory survives its files, its interpolation and its uncertainty."""

import gzip
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pymap3d
import pytest
from scipy.spatial.transform import Rotation

from rovgraph.errors import DataWarning, InputError
from rovgraph.geometry import exp_rotation, matrix_from_rpy, rpy_from_matrix, wrap_angle
from rovgraph.inference.trajectory import Trajectory, read_trajectory
from rovgraph.live.files import TrackFile

N = 40


@pytest.fixture
def trajectory() -> Trajectory:
    rng = np.random.default_rng(1)
    time = np.cumsum(rng.uniform(0.1, 0.3, N))
    rpy = np.column_stack([0.1 * np.sin(time), 0.3 * np.cos(time), wrap_angle(2.0 * time)])
    root = 0.1 * rng.standard_normal((3, N, 3, 3))
    cov_p, cov_theta, cov_v = root @ root.swapaxes(-1, -2)
    p_n, v_n = rng.standard_normal((2, N, 3))
    return Trajectory(time, 10 * p_n, matrix_from_rpy(rpy), v_n, cov_p, cov_theta, cov_v)


def test_a_place_on_earth_adds_latitude_and_longitude_at_the_end(trajectory, tmp_path):
    trajectory.write_csv(tmp_path / "plain.csv")
    trajectory.write_csv(tmp_path / "placed.csv", origin=(58.3, 14.5))
    plain, placed = (pd.read_csv(tmp_path / name) for name in ("plain.csv", "placed.csv"))
    assert placed.columns.tolist() == [*plain.columns, "lat", "lon"]
    pd.testing.assert_frame_equal(placed[plain.columns], plain)
    north, east, _ = pymap3d.geodetic2ned(placed["lat"], placed["lon"], 0.0, 58.3, 14.5, 0.0)
    np.testing.assert_allclose(np.column_stack([north, east]), trajectory.p_n[:, :2], atol=2e-4)
    assert read_trajectory(tmp_path / "placed.csv").p_n == pytest.approx(trajectory.p_n, rel=1e-6)


def test_a_log_on_unix_time_says_so_in_a_column_of_the_track(trajectory, tmp_path):
    trajectory.write_csv(tmp_path / "boot.csv")
    dated = replace(trajectory, time=trajectory.time + 1.75e9)
    dated.write_csv(tmp_path / "dated.csv", origin=(58.3, 14.5))
    boot, found = (pd.read_csv(tmp_path / name) for name in ("boot.csv", "dated.csv"))
    assert found.columns.tolist() == [*boot.columns, "unix_time", "lat", "lon"]
    np.testing.assert_allclose(found["unix_time"], dated.time, rtol=0.0, atol=1e-4)
    growing = TrackFile(tmp_path / "growing.csv")
    growing.add(dated.take(np.arange(20)), (58.3, 14.5))
    again = TrackFile(tmp_path / "growing.csv", until=float(dated.time[20]))
    again.add(dated.take(np.arange(20, N)), (58.3, 14.5))
    assert (tmp_path / "growing.csv").read_text() == (tmp_path / "dated.csv").read_text()


def test_a_growing_track_keeps_the_columns_that_it_began_with(trajectory, tmp_path):
    halves = trajectory.take(np.arange(20)), trajectory.take(np.arange(20, N))
    late, early = TrackFile(tmp_path / "late.csv"), TrackFile(tmp_path / "early.csv")
    for half, origin in zip(halves, (None, (58.3, 14.5)), strict=True):
        late.add(half, origin)  # the first fix comes after the first rows
        early.add(half, (58.3, 14.5))
    assert "lat" not in pd.read_csv(tmp_path / "late.csv") and len(pd.read_csv(tmp_path / "early.csv")) == N
    again = TrackFile(tmp_path / "early.csv", until=float(trajectory.time[20]))
    again.add(halves[1], (58.3, 14.5))
    trajectory.write_csv(tmp_path / "whole.csv", origin=(58.3, 14.5))
    assert (tmp_path / "early.csv").read_text() == (tmp_path / "whole.csv").read_text()


def test_a_growing_track_has_the_grid_of_results(trajectory, tmp_path):
    pytest.importorskip("pyproj")
    origin, grid = (58.3, 14.5), "EPSG:32633"
    trajectory.write_csv(tmp_path / "whole.csv", origin=origin, grid=grid)
    path = tmp_path / "growing.csv"
    TrackFile(path, grid=grid).add(trajectory.take(np.arange(20)), origin)
    TrackFile(path, float(trajectory.time[20]), grid).add(trajectory.take(np.arange(20, N)), origin)
    assert "grid_scale" in pd.read_csv(path) and path.read_text() == (tmp_path / "whole.csv").read_text()
    with pytest.raises(InputError, match=r"begun in a map grid; state the same environment\.grid"):
        TrackFile(path, float(trajectory.time[20]))
    late = tmp_path / "late.csv"
    TrackFile(late).add(trajectory.take(np.arange(20)), origin)  # as an older release began it
    TrackFile(late, float(trajectory.time[20]), grid).add(trajectory.take(np.arange(20, N)), origin)
    assert len({line.count(",") for line in late.read_text().splitlines()}) == 1


def test_a_growing_file_keeps_its_columns_when_its_clock_becomes_unix_time(tmp_path):
    """Also where it was begun by a release that wrote no ``unix_time``."""
    early, late = (
        Trajectory.certain(time, np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)))
        for time in (np.array([5.0, 6.0]), 1.7e9 + np.array([5.0, 6.0]))
    )
    path = tmp_path / "track.csv"
    TrackFile(path).add(early, (54.0, 10.0))
    TrackFile(path, until=10.0).add(late, (54.0, 10.0))
    assert len({line.count(",") for line in path.read_text().splitlines()}) == 1
    TrackFile(path).add(late)
    TrackFile(path, until=2e9).add(early)
    table = pd.read_csv(path)
    assert table["time"].tolist() == [*late.time, *early.time]
    np.testing.assert_array_equal(table["unix_time"], [*late.time, np.nan, np.nan])


def test_csv_round_trip_keeps_values_and_sds(trajectory, tmp_path):
    trajectory.write_csv(tmp_path / "t.csv")
    back = read_trajectory(tmp_path / "t.csv")
    np.testing.assert_allclose(back.time, trajectory.time, atol=1e-4)
    np.testing.assert_allclose(back.p_n, trajectory.p_n, rtol=1e-6)
    np.testing.assert_allclose(back.v_n, trajectory.v_n, rtol=1e-6)
    np.testing.assert_allclose(back.R_nb, trajectory.R_nb, atol=1e-6)
    np.testing.assert_allclose(back.p_sd, trajectory.p_sd, rtol=1e-6)
    np.testing.assert_allclose(back.rpy_sd, trajectory.rpy_sd, rtol=1e-5)
    np.testing.assert_allclose(back.v_sd, trajectory.v_sd, rtol=1e-6)
    np.testing.assert_allclose(back.cov_p[:, 0, 1], trajectory.cov_p[:, 0, 1], rtol=1e-6)


def test_csv_keeps_tenths_of_a_millimetre_in_the_coordinates_of_a_grid(trajectory, tmp_path):
    far = replace(trajectory, p_n=trajectory.p_n + np.array([6_470_000.123456, 540_000.0, 0.0]))
    far.write_csv(tmp_path / "far.csv")
    np.testing.assert_allclose(read_trajectory(tmp_path / "far.csv").p_n, far.p_n, rtol=0, atol=1e-4)


def test_csv_has_the_columns_of_the_contract(trajectory, tmp_path):
    trajectory.write_csv(tmp_path / "t.csv")
    values = ["north", "east", "down", "roll", "pitch", "yaw", "v_north", "v_east", "v_down"]
    columns = pd.read_csv(tmp_path / "t.csv").columns.tolist()
    assert columns == ["time", *values, *(v + "_sd" for v in values), "cov_north_east"]


def test_what_is_not_known_is_neither_written_nor_read_as_zero(trajectory, tmp_path):
    truth = Trajectory.certain(trajectory.time, trajectory.p_n, trajectory.R_nb, trajectory.v_n)
    truth.write_csv(tmp_path / "t.csv.gz")
    with gzip.open(tmp_path / "t.csv.gz", "rt") as file:
        assert file.readline().strip() == "time,north,east,down,roll,pitch,yaw,v_north,v_east,v_down"
    back = read_trajectory(tmp_path / "t.csv.gz")
    assert np.isnan(back.p_sd).all() and np.isnan(back.cov_theta).all()
    (tmp_path / "short.csv").write_text("time,north,east,remark\n0,1,2,a\n1,2,3,b\n")
    short = read_trajectory(tmp_path / "short.csv")
    assert np.isnan(short.R_nb).all() and np.isnan(short.p_n[:, 2]).all() and np.isnan(short.rpy).all()
    assert np.isnan(short.at(np.array([0.5])).R_nb).all()
    np.testing.assert_allclose(short.at(np.array([0.5])).p_n[0, :2], [1.5, 2.5])


def test_a_tum_file_says_its_frame_and_has_position_and_quaternion_in_n(trajectory, tmp_path):
    trajectory.write_tum(tmp_path / "t.tum")
    assert "north, east, down" in (tmp_path / "t.tum").read_text().splitlines()[0]
    rows = np.loadtxt(tmp_path / "t.tum")
    assert rows.shape == (N, 8)
    np.testing.assert_allclose(rows[:, 1:4], trajectory.p_n, atol=1e-6)
    np.testing.assert_allclose(Rotation.from_quat(rows[:, 4:]).as_matrix(), trajectory.R_nb, atol=1e-8)


def test_interpolation_is_exact_at_epochs_and_halves_between(trajectory):
    same = trajectory.at(trajectory.time)
    np.testing.assert_allclose(same.p_n, trajectory.p_n, atol=1e-12)
    np.testing.assert_allclose(same.R_nb, trajectory.R_nb, atol=1e-12)
    np.testing.assert_allclose(same.cov_p, trajectory.cov_p, atol=1e-12)
    middle = trajectory.at(0.5 * (trajectory.time[:1] + trajectory.time[1:2]))
    np.testing.assert_allclose(middle.p_n[0], trajectory.p_n[:2].mean(axis=0))
    turn = Rotation.from_matrix(trajectory.R_nb[0].T @ trajectory.R_nb[1]).as_rotvec()
    np.testing.assert_allclose(middle.R_nb[0], trajectory.R_nb[0] @ exp_rotation(turn / 2), atol=1e-12)


def test_interpolation_goes_the_short_way_across_south():
    R = matrix_from_rpy([[0, 0, np.deg2rad(170)], [0, 0, np.deg2rad(-170)]])
    two = Trajectory.certain(np.array([0.0, 1.0]), np.zeros((2, 3)), R, np.zeros((2, 3)))
    assert abs(wrap_angle(two.at(np.array([0.5])).rpy[0, 2] - np.pi)) < 1e-12


def test_beyond_the_ends_there_is_nothing_and_a_warning_says_so(trajectory):
    begin, end = trajectory.time[[0, -1]]
    with pytest.warns(DataWarning, match="^2 of 3 times lie beyond the track and give NaN; the track has"):
        found = trajectory.at([begin - 5.0, begin, end + 1e6])
    assert np.isnan(found.p_n).all(axis=1).tolist() == [True, False, True]
    assert np.isnan(found.R_nb[0]).all() and np.isnan(found.cov_p[0]).all()
    np.testing.assert_array_equal(found.time, [begin - 5.0, begin, end + 1e6])
    with pytest.warns(DataWarning, match="^1 of 1 times"):
        assert np.isnan(trajectory.at(np.nan).p_n).all()
    np.testing.assert_allclose(trajectory.clamped(np.array([-5.0, 1e6])).p_n, trajectory.p_n[[0, -1]])


def test_a_moment_is_a_number_an_array_or_a_date(trajectory):
    number = trajectory.at(float(trajectory.time[3]))
    np.testing.assert_allclose(number.p_n, trajectory.p_n[3:4])
    dated = replace(trajectory, time=trajectory.time + 1_777_627_800.0)
    at = pd.Timestamp(dated.time[3], unit="s").floor("us")
    naive = at.to_pydatetime()
    for moment in (at, at.tz_localize("UTC"), naive, at.isoformat(), at.to_datetime64(), [at], pd.DatetimeIndex([at])):
        np.testing.assert_allclose(dated.at(moment).p_n, trajectory.p_n[3:4], atol=1e-4)
    zone = at.tz_localize("UTC").tz_convert("Europe/Stockholm")
    np.testing.assert_allclose(dated.at(zone.isoformat()).p_n, trajectory.p_n[3:4], atol=1e-4)
    with pytest.raises(InputError, match="is a date, but the track's clock is not Unix time"):
        trajectory.at(at)
    for wrong in ("noon", None, {}):
        with pytest.raises(InputError, match=r"expected seconds or a date such as 2026-05-01T09:30:00Z$"):
            trajectory.at(wrong)
    with pytest.raises(InputError, match=r"^time: has shape \(2, 2\), expected"):
        trajectory.at(np.zeros((2, 2)))


def test_slices_by_number_and_by_time(trajectory):
    np.testing.assert_array_equal(trajectory[2:5].time, trajectory.time[2:5])
    np.testing.assert_array_equal(trajectory[-1].p_n, trajectory.p_n[-1:])
    np.testing.assert_array_equal(trajectory[trajectory.time > 0.5].time, trajectory.time[trajectory.time > 0.5])
    some = trajectory.between(trajectory.time[2], trajectory.time[5])
    np.testing.assert_array_equal(some.time, trajectory.time[2:6])
    with pytest.raises(InputError, match=r"^no epoch of the track from 1000000\.0 to 2000000\.0 s; the track has"):
        trajectory.between(1e6, 2e6)
    with pytest.raises(IndexError):
        trajectory[len(trajectory)]


def test_a_dataset_has_units_and_axes(trajectory):
    data = pytest.importorskip("xarray") and trajectory.to_xarray()
    np.testing.assert_array_equal(data["position"].sel(n="east"), trajectory.p_n[:, 1])
    assert data["velocity"].attrs["units"] == "m/s" and data.sizes["time"] == len(trajectory)
    assert data["cov_position"].dims == ("time", "n", "n2")


def test_without_xarray_a_line_says_what_to_install(trajectory, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(InputError, match=r"^to_xarray: xarray is not installed: pip install xarray$"):
        trajectory.to_xarray()


def test_interpolation_is_unknown_beside_the_unknown(trajectory):
    trajectory.R_nb[3] = np.nan
    t = trajectory.time
    R = trajectory.at(np.array([t[1], 0.5 * (t[2] + t[3]), t[3], 0.5 * (t[3] + t[4]), t[4]])).R_nb
    assert np.isnan(R).all(axis=(1, 2)).tolist() == [False, True, True, True, False]


def test_angles_may_be_converted_in_place_and_the_trajectory_keeps_its_own(trajectory):
    before = trajectory.to_frame()
    angles = trajectory.rpy
    angles *= 180.0 / np.pi
    pd.testing.assert_frame_equal(trajectory.to_frame(), before)
    np.testing.assert_array_equal(trajectory.rpy, rpy_from_matrix(trajectory.R_nb))


def test_rpy_sd_agrees_with_monte_carlo():
    rpy, root = np.array([0.3, -0.6, 2.0]), np.array([[2, 0, 0], [1, 3, 0], [-1, 1, 2]]) * 1e-3
    R = matrix_from_rpy(rpy)
    draws = exp_rotation(np.random.default_rng(2).standard_normal((40000, 3)) @ root.T) @ R
    spread = wrap_angle(rpy_from_matrix(draws) - rpy).std(axis=0)
    one = Trajectory(np.zeros(1), *(np.zeros((1, 3)), R[None], np.zeros((1, 3))), *[(root @ root.T)[None]] * 3)
    np.testing.assert_allclose(one.rpy_sd[0], spread, rtol=0.02)


def test_every_keeps_the_last_epoch(trajectory):
    thin = trajectory.every(7)
    assert thin.time.tolist() == [*trajectory.time[:-1:7], trajectory.time[-1]]
    assert len(trajectory.every(1)) == N


def test_distance_is_the_length_of_the_track():
    p = np.array([[0, 0, 0], [3, 4, 0], [3, 4, 12]], float)
    track = Trajectory.certain(np.arange(3.0), p, np.broadcast_to(np.eye(3), (3, 3, 3)), p)
    assert track.distance == pytest.approx(17.0)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b"\x1f\x8b\x00garbage", "gzip data are damaged"),
        (b"time,north\n0,1\n1,2\n", "column east is missing"),
        (b"time,north,east\n0,1,2\n", "1 rows"),
        (b"time,north,east\n0,1,2\n1,x,2\n", "line 3, column north: 'x' is not a number"),
        (b"time,north,east\n0,1,2\n2,1,2\n1,1,2\n", "line 4: time does not increase"),
        (b"time,north,east\n0,1,2\n0,1,2\n", "line 3: time does not increase"),
    ],
)
def test_bad_files_are_named_with_their_line(tmp_path, content, words):
    for name in ("t.csv", "t.csv.gz") if content[:1] in (b"", b"\x1f") else ("t.csv",):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=words):
            read_trajectory(tmp_path / name)


def test_missing_file_and_folder_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_trajectory(tmp_path / "none.csv")
    with pytest.raises(InputError, match=r"is a directory, expected a CSV file; give one in it$"):
        read_trajectory(tmp_path)
    for name in ("residuals.csv", "trajectory_filtered.csv", "trajectory_smoothed.csv"):
        (tmp_path / name).write_text("time,north,east\n0,1,2\n1,1,2\n")
    with pytest.raises(InputError, match=r"give one in it, such as .*trajectory_smoothed\.csv$"):
        read_trajectory(tmp_path)


def test_rows_without_position_are_left_out_with_a_warning(tmp_path):
    (tmp_path / "t.csv").write_text("time, north, east\n0,1,2\n1,,2\n2,inf,2\n3,1,2\n")
    with pytest.warns(DataWarning, match="2 rows"):
        assert read_trajectory(tmp_path / "t.csv").time.tolist() == [0.0, 3.0]
