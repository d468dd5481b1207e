"""Frame "earth": dives on WGS 84, kilometres from their origin, against a way over ground that is known."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import rovgraph
from rovgraph import InputError
from rovgraph.geometry import EARTH_RATE, Array, exp_rotation, matrix_from_rpy
from rovgraph.inference.initialise import initialise
from rovgraph.kernels import measurement_row as at
from rovgraph.kernels.earth import normal_gravity, radii
from rovgraph.kernels.motion import transitions
from rovgraph.kernels.states import States
from rovgraph.live.clocks import Clocks
from rovgraph.live.files import read_checkpoint, write_checkpoint
from rovgraph.live.message import GEODETIC, Message, Reading
from rovgraph.live.navigator import Navigator
from rovgraph.model.calibration import TABLE
from rovgraph.model.config import Config
from rovgraph.model.origin import EarthOrigin, frame_of, lat_lon, north_east
from rovgraph.model.state import POSE, State
from rovgraph.problem.motion import preintegrate, preintegration_params
from rovgraph.report.export.track import read_track
from rovgraph.sensors.instruments import instruments
from rovgraph.sensors.position import PlaceOffset, Position
from rovgraph.simulate.dive import specific_force_and_rate
from rovgraph.simulate.path import Path as SimulatedPath

V_N = np.array([1.0, np.sqrt(3.0), 0.0])  # 2 m/s on course 60 deg, heading likewise
R_NB = matrix_from_rpy(np.deg2rad([[0.0, 0.0, 60.0]]))[0]


def transit(latitude: float, longitude: float, seconds: float, imu_hz: float = 5.0) -> tuple[pd.DataFrame, Array]:
    """A log without noise along a loxodrome, with fixes at both ends; true latitude and longitude [deg] per IMU row."""
    step = 1.0 / imu_hz
    time = np.arange(int(seconds * imu_hz) + 1) * step
    lat = np.full(len(time), np.deg2rad(latitude))
    for _ in range(4):  # of dlat = v_north / M dt
        rate = V_N[0] / radii(lat)[0]
        lat = np.deg2rad(latitude) + np.append(0.0, np.cumsum(0.5 * (rate[1:] + rate[:-1]) * step))
    M, N = radii(lat)
    rate = V_N[1] / (N * np.cos(lat))
    lon = np.deg2rad(longitude) + np.append(0.0, np.cumsum(0.5 * (rate[1:] + rate[:-1]) * step))
    w_ie = EARTH_RATE * np.column_stack([np.cos(lat), 0.0 * lat, -np.sin(lat)])
    w_en = np.column_stack([V_N[1] / N, -V_N[0] / M, -V_N[1] * np.tan(lat) / N])
    force = np.cross(2.0 * w_ie + w_en, V_N)
    force[:, 2] -= normal_gravity(lat)
    imu = np.hstack([force @ R_NB, (w_ie + w_en) @ R_NB])
    log = pd.DataFrame(imu, columns=["acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z"])
    log.insert(0, "time", time)
    pings = slice(0, None, int(2 * imu_hz))
    log.loc[log.index[pings], ["dvl_vx", "dvl_vy", "dvl_vz"]] = V_N @ R_NB
    log.loc[log.index[pings], ["depth"]] = 0.0
    truth = np.rad2deg(np.column_stack([lat, lon]))
    truth[:, 1] = (truth[:, 1] + 180.0) % 360.0 - 180.0
    for k in (0, len(time) - 1):
        log.loc[log.index[k], ["fix_lat", "fix_lon"]] = truth[k]
    return log, truth


def config(**environment: object) -> dict[str, Any]:
    return {
        "environment": {"frame": "earth", **environment},
        "imu": {"noise": {"acc": 1e-4, "gyr": 1e-6, "acc_walk": 1e-7, "gyr_walk": 1e-10},
                "acc_bias_sd_mps2": 1e-4, "gyr_bias_sd_dps": 1e-5},
        "dvl": {"velocity_sd_mps": [0.002, 0.002, 0.002]},
        "start": {"heading_deg": 60.0, "heading_sd_deg": 0.1, "roll_deg": 0.0, "pitch_deg": 0.0},
    }  # fmt: skip


def smoothed(folder: Path, latitude: float, longitude: float, seconds: float) -> tuple[rovgraph.Result, Array]:
    log, truth = transit(latitude, longitude, seconds)
    log.to_csv(folder / "log.csv", index=False, float_format="%.12g")
    settings = rovgraph.parse_config(json.dumps(config()))
    result = rovgraph.smooth(rovgraph.read_log(folder / "log.csv", settings), settings)
    at = np.interp(result.smoothed.trajectory.time, log["time"], np.arange(len(log))).round().astype(int)
    return result, truth[at]


def apart(result: rovgraph.Result, truth: Array) -> float:
    """Farthest from the truth [m]."""
    lat, lon = result.smoothed.trajectory.geodetic(result.log.origin)
    M, N = radii(np.deg2rad(truth[:, 0]))
    east = np.deg2rad((lon - truth[:, 1] + 180.0) % 360.0 - 180.0) * N * np.cos(np.deg2rad(truth[:, 0]))
    return float(np.hypot(np.deg2rad(lat - truth[:, 0]) * M, east).max())


def test_places_are_the_same_both_ways_across_the_date_line():
    for origin in ((-60.0, 179.9), EarthOrigin(-60.0, 179.9)):
        lat, lon = lat_lon(*north_east([-59.9, -60.2], [-179.95, 179.0], origin), origin)
        np.testing.assert_allclose(lon, [-179.95, 179.0], atol=1e-4 if type(origin) is tuple else 1e-12)
        np.testing.assert_allclose(lat, [-59.9, -60.2], atol=1e-4 if type(origin) is tuple else 1e-12)


def test_a_metre_near_the_origin_is_a_metre():
    for origin in ((42.0, 3.0), EarthOrigin(42.0, 3.0)):
        north, east = north_east(42.0009, 3.0012, origin)
        assert (north, east) == pytest.approx((99.965, 99.419), abs=2e-3)


@pytest.mark.slow
def test_a_transit_across_the_date_line_ends_where_it_did(tmp_path):
    result, truth = smoothed(tmp_path, 70.0, 179.95, 4000.0)
    assert isinstance(result.log.origin, EarthOrigin)
    assert truth[0, 1] > 179.0 and truth[-1, 1] < -179.0
    assert apart(result, truth) < 0.01


AUTO = {
    "a short way": (45.0, 600.0, {}, {}, "flat"),
    "a long way": (45.0, 3300.0, {}, {}, "earth"),
    "a good gyro": (45.0, 60.0, {}, {"gyr_bias_sd_dps": 1e-5}, "earth"),
    "an Earth that is held still": (45.0, 3300.0, {"earth_rotation": False}, {}, "flat"),
    "another latitude stated": (45.0, 3300.0, {"latitude_deg": 44.0}, {}, "flat"),
    "an origin far away": (45.0, 60.0, {"origin_lat_deg": 45.1, "origin_lon_deg": 5.1}, {}, "earth"),
    "far north": (86.0, 60.0, {}, {"gyr_bias_sd_dps": 1e-5}, "flat"),
}


@pytest.mark.parametrize(("latitude", "seconds", "environment", "imu", "frame"), AUTO.values(), ids=AUTO)
def test_auto_is_the_earth_where_a_plane_or_the_gyro_needs_it(tmp_path, latitude, seconds, environment, imu, frame):
    log, _ = transit(latitude, 5.0, seconds, 1.0)
    log.to_csv(tmp_path / "log.csv", index=False)
    settings = rovgraph.parse_config(json.dumps({"environment": environment, "imu": {"gyr_bias_sd_dps": 0.1, **imu}}))
    assert settings.environment.frame == "auto"
    assert frame_of(rovgraph.read_log(tmp_path / "log.csv", settings).origin) == frame
    local = log.drop(columns=["fix_lat", "fix_lon"]).assign(fix_north=np.nan, fix_east=np.nan)
    local.loc[0, ["fix_north", "fix_east"]] = 0.0
    local.to_csv(tmp_path / "log.csv", index=False)
    if "origin_lat_deg" in environment:  # north and east of a log are those of a plane, however long the way
        assert frame_of(rovgraph.read_log(tmp_path / "log.csv", settings).origin) == "flat"


def test_fixes_so_far_from_the_origin_that_it_must_be_wrong_are_refused_unless_the_frame_is_stated(tmp_path):
    log, _ = transit(45.0, 5.0, 60.0, 1.0)
    log.to_csv(tmp_path / "log.csv", index=False)
    for origin, frame, fits in (((45.0, 4.0), "flat", True), ((45.0, 3.0), "flat", False), ((45.0, 3.0), "auto", True),
                                ((5.0, 45.0), "auto", False), ((5.0, 45.0), "earth", True)):  # fmt: skip
        environment = {"origin_lat_deg": origin[0], "origin_lon_deg": origin[1], "frame": frame}
        settings = rovgraph.parse_config(json.dumps({"environment": environment}))
        if fits:
            assert rovgraph.read_log(tmp_path / "log.csv", settings).origin == origin
        else:
            with pytest.raises(InputError, match=r"km from environment.origin_lat_deg.*or state environment.frame"):
                rovgraph.read_log(tmp_path / "log.csv", settings)


def test_a_log_of_the_other_frame_is_refused(tmp_path):
    log, _ = transit(45.0, 5.0, 20.0, 20.0)
    log.to_csv(tmp_path / "log.csv", index=False)
    flat = rovgraph.read_log(tmp_path / "log.csv", rovgraph.parse_config(json.dumps(config(frame="flat"))))
    with pytest.raises(InputError, match=r"another value of environment.frame"):
        rovgraph.smooth(flat, rovgraph.parse_config(json.dumps(config())))
    with pytest.raises(InputError, match="was read in frame flat"):
        rovgraph.smooth(replace(flat, config=None), rovgraph.parse_config(json.dumps(config())))


def messages(log: pd.DataFrame, begin: float, end: float) -> list[Message]:
    """Rows of a log as a vehicle sends them."""
    out = []
    for _, row in log[(log["time"] >= begin) & (log["time"] < end)].iterrows():
        values = {
            "imu": row.iloc[1:7],
            "dvl": [*row[["dvl_vx", "dvl_vy", "dvl_vz"]], 1.0, np.nan],
            "depth": row[["depth"]],
            GEODETIC: [*row[["fix_lat", "fix_lon"]], np.nan],
        }
        arrays = {sensor: np.array(v, float) for sensor, v in values.items()}
        readings = tuple(Reading(sensor, v) for sensor, v in arrays.items() if np.isfinite(v[0]))
        out.append(Message("sim", row["time"], row["time"], readings))
    return out


def test_a_dive_crosses_the_date_line_live_and_goes_on_from_a_checkpoint(tmp_path):
    log, truth = transit(70.0, 179.9998, 20.0, 10.0)
    settings = rovgraph.parse_config(json.dumps(config()))
    first = Navigator(settings, patient=True, reinitialise=False, clocks=Clocks(trust=True))
    for message in messages(log, 0.0, 14.0):
        first.take(message)
    write_checkpoint(tmp_path / "checkpoint", first.state())
    second = Navigator(settings, patient=True, reinitialise=False, clocks=Clocks(trust=True))
    second.restore(read_checkpoint(tmp_path / "checkpoint"))
    assert isinstance(second.origin, EarthOrigin) and second.origin == first.origin
    known = second.time
    for navigator, begin in ((first, 14.0), (second, known + 1e-6)):
        for message in messages(log, begin, 41.0):
            navigator.take(message)
    solutions = first.solution(), second.solution()
    for solution in solutions:
        k = int(np.argmin(np.abs(log["time"] - solution.time)))
        assert truth[0, 1] > 0.0 > solution.longitude
        assert solution.latitude == pytest.approx(truth[k, 0], abs=1e-7)
        assert solution.longitude == pytest.approx(truth[k, 1], abs=3e-7)
    np.testing.assert_allclose(solutions[0].position, solutions[1].position, atol=1e-6)


def test_online_waits_for_the_place_where_the_frame_is_stated():
    log, _ = transit(70.0, 10.0, 8.0, 20.0)
    navigator = Navigator(rovgraph.parse_config(json.dumps(config(latitude_deg=70.0))), reinitialise=False)
    for _, row in log.iterrows():
        navigator.take(Message("sim", row["time"], row["time"], (Reading("imu", np.array(row.iloc[1:7], float)),)))
    assert navigator.engine is None and "origin_lat_deg" in navigator.waits_for


def test_online_tells_once_when_a_plane_that_was_not_stated_is_wrong():
    log, _ = transit(70.0, 10.0, 9.0, 10.0)
    place = {"origin_lat_deg": 70.0, "origin_lon_deg": 9.9}  # 3.8 km away, where 2.3 km is the limit
    for frame, warnings in (("auto", 1), ("flat", 0)):
        stated = config(frame=frame, **place)
        stated["imu"]["gyr_bias_sd_dps"] = 0.01
        settings = rovgraph.parse_config(json.dumps(stated))
        navigator = Navigator(settings, reinitialise=False, clocks=Clocks(trust=True))
        events = []
        for message in messages(log, 0.0, 10.0):
            navigator.take(message)
            events += [] if (solution := navigator.solution()) is None else solution.events
        assert sum("a flat frame is wrong by" in event.text for event in events) == warnings


@pytest.mark.parametrize("latitude", [0.0, 70.0, -60.0])
def test_what_a_simulated_imu_feels_takes_the_vehicle_along_its_path(latitude):
    t = np.arange(0.0, 60.5, 0.5)
    north, east = 20e3 + 1.5 * t + 4.0 * np.sin(t / 8.0), -3e4 + 1.0 * t
    rpy = np.column_stack([0.1 * np.sin(t / 7.0), 0.1 * np.cos(t / 9.0), 0.5 + np.sin(t / 20.0)])
    path = SimulatedPath.through(t, np.column_stack([north, east, 5.0 + np.sin(t / 10.0)]), rpy, rest=False)
    path = replace(path, latitude=np.deg2rad(latitude))
    settings = rovgraph.parse_config(json.dumps(config(latitude_deg=latitude, earth_rotation=True)))
    motion = path.motion(np.arange(0.0, 60.0, 0.005))
    imu = np.column_stack([motion.time, specific_force_and_rate(motion, settings)])
    here = States(motion.R_nb[:1], motion.p_n[:1], motion.v_n[:1], np.zeros((1, 6)))
    for begin in range(0, len(imu) - 101, 100):
        part = imu[begin : begin + 101].copy()
        row, covariance, _ = preintegrate(
            preintegration_params(settings), np.zeros(6), part, part[0, 0], np.empty(0), part[-1, 0]
        )
        there = States(*(np.empty_like(x) for x in here))
        transitions(row[None], covariance[None], here, there, np.empty((1, 15, 15)), np.empty((1, 15, 15)))
        here = there._replace(b=np.zeros((1, 6)))
    end = path.motion([part[-1, 0]])
    np.testing.assert_allclose(here.p, end.p_n, atol=0.01)
    np.testing.assert_allclose(here.v, end.v_n, atol=3e-4)


@pytest.mark.parametrize("latitude", [0.0, 45.0, 70.0, -60.0])
def test_a_range_is_that_between_two_places_on_earth(latitude):
    from pymap3d import geodetic2ecef

    settings = Config().changed(beacons=[{"name": "b"}])
    origin, p = EarthOrigin(latitude, 10.0), np.array([[5e4, -3e4, 400.0]])
    other = p + np.array([[1500.0, 1200.0, -390.0]])
    ends = [geodetic2ecef(*(float(x[0]) for x in lat_lon(q[:, 0], q[:, 1], origin)), -q[0, 2]) for q in (p, other)]
    x = np.zeros((1, at.WIDTH))
    x[:, at.ASKED : at.ASKED + 3], x[:, at.HEARD : at.HEARD + 3], x[:, at.WAYS] = other, other, 2.0
    x[:, at.MOUNT_AT :], x[:, at.ORIGIN] = -1.0, np.deg2rad(latitude)
    x[:, at.FRAME : at.FRAME + 9] = np.eye(3).ravel()
    calibration = {name: np.zeros(variable.dim) for name, variable in TABLE.items()}
    model: Any = instruments(settings)["range"].model
    state = State(R_NB[None], p, np.zeros((1, 3)), np.zeros((1, 6)), calibration)
    found = model.of(x).predict(state, np.zeros((1, 3)))[0][0, 0]
    assert found == pytest.approx(np.linalg.norm(np.subtract(*ends)), abs=0.003)


def seen_from(truth: Array, arm_n: Array) -> tuple[float, float]:
    """Latitude and longitude [deg] of a point that lies an arm [m] from a place."""
    from pymap3d import ned2geodetic

    lat, lon, _ = ned2geodetic(*(float(x) for x in arm_n), *(float(x) for x in truth[:2]), 0.0)
    return lat, lon


@pytest.mark.parametrize("latitude", [45.0, 70.0, -60.0])
def test_a_point_on_the_vehicle_is_where_geodesy_has_it_and_moves_by_its_derivative(latitude):
    origin, p, arm = EarthOrigin(latitude, 10.0), np.array([[9e4, -3e4, 0.0]]), np.array([40.0, -25.0, 3.0])
    known = float(np.deg2rad(latitude))
    fix = Position("fix", arm, (0, 1), error="fix_error", latitude=known)
    calibration = {"fix_error": np.zeros(2), "place": np.zeros(2)}

    def seen(model: Any, d: Array) -> tuple[Array, Array]:
        R_nb, p_n = (R_NB @ exp_rotation(d[:3]))[None], p + R_NB @ d[3:]
        z, H = model.predict(State(R_nb, p_n, np.zeros((1, 3)), np.zeros((1, 6)), calibration), np.zeros((1, 3)))
        return z[0], H[POSE][0]

    here = np.array([float(x[0]) for x in lat_lon(p[:, 0], p[:, 1], origin)])
    expected = np.array(north_east(*seen_from(here, R_NB @ arm), origin))
    for model in (fix, PlaceOffset(arm, known)):
        found, H = seen(model, np.zeros(6))
        np.testing.assert_allclose(found, expected, atol=1e-3)
        steps = 1e-2 * np.eye(6)
        change = [(seen(model, step)[0] - seen(model, -step)[0]) / 2e-2 for step in steps]
        np.testing.assert_allclose(H, np.transpose(change), atol=1e-3)


def test_a_track_a_degree_from_its_origin_is_that_of_the_body_whatever_the_arms(tmp_path):
    log, truth = transit(70.0, 10.0, 60.0)
    antenna, at_imu = [3.0, -2.0, 0.0], [-4.0, 1.0, 0.2]
    for k in (0, len(log) - 1):
        log.loc[log.index[k], ["fix_lat", "fix_lon"]] = seen_from(truth[k], R_NB @ antenna)
    log.to_csv(tmp_path / "log.csv", index=False, float_format="%.12g")
    stated = config(origin_lat_deg=69.0, origin_lon_deg=10.0) | {"fix": {"lever_arm_m": antenna}}
    stated["imu"]["lever_arm_m"] = stated["dvl"]["lever_arm_m"] = at_imu
    settings = rovgraph.parse_config(json.dumps(stated))
    read = rovgraph.read_log(tmp_path / "log.csv", settings)
    result = rovgraph.smooth(read, settings)
    at = np.interp(result.smoothed.trajectory.time, log["time"], np.arange(len(log))).round().astype(int)
    assert apart(result, truth[at]) < 0.01
    start = initialise(read, settings).config.start  # from the first fix, whose arm is in metres
    place = north_east(*truth[0][:2], EarthOrigin(69.0, 10.0))
    np.testing.assert_allclose([start.north_m, start.east_m], np.ravel(place), atol=0.01)


def test_a_fix_with_the_last_ping_counts(tmp_path):
    log, _ = transit(45.0, 5.0, 20.0, 20.0)
    log.to_csv(tmp_path / "log.csv", index=False, float_format="%.12g")
    settings = rovgraph.parse_config(json.dumps(config()))
    result = rovgraph.smooth(rovgraph.read_log(tmp_path / "log.csv", settings), settings)
    fixes = result.smoothed.residuals[result.smoothed.residuals["sensor"] == "fix"]
    assert fixes["time"].unique().tolist() == [0.0, 20.0]


def test_results_keep_their_frame_and_those_of_before_are_flat(tmp_path):
    log, truth = transit(70.0, 179.9999, 10.0, 20.0)
    log.to_csv(tmp_path / "log.csv", index=False, float_format="%.12g")
    settings = rovgraph.parse_config(json.dumps(config()))
    result = rovgraph.smooth(rovgraph.read_log(tmp_path / "log.csv", settings), settings)
    summary = result.save(tmp_path / "out", figures=False, page=False)
    assert summary["frame"] == "earth"
    track = read_track(tmp_path / "out")
    assert isinstance(track.origin, EarthOrigin) and isinstance(result.track().origin, EarthOrigin)
    np.testing.assert_allclose(np.column_stack(track.lat_lon)[-1], truth[-1], atol=1e-7)
    assert isinstance(track.placed((60.0, 5.0), 0.0).origin, EarthOrigin)
    text = (tmp_path / "out" / "summary.json").read_text()
    (tmp_path / "out" / "summary.json").write_text(text.replace('"frame": "earth",', ""))
    assert frame_of(read_track(tmp_path / "out").origin) == "flat"


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ({"latitude_deg": 50.0, "origin_lat_deg": 60.0, "origin_lon_deg": 5.0}, "takes the latitude of the origin"),
        ({"latitude_deg": 86.0}, "reaches to latitude 85"),
        ({"origin_lat_deg": 90.0, "origin_lon_deg": 0.0}, "reaches to latitude 85"),
        ({"frame": "round"}, "frame"),
    ],
)
def test_contradictions_are_refused(environment, said):
    with pytest.raises(InputError, match=said):
        rovgraph.parse_config(json.dumps(config(**environment)))
