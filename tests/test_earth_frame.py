"""Frame "earth": dives on WGS 84, kilometres from their origin, against a way over ground that is known."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import rovgraph
from rovgraph import InputError
from rovgraph.geometry import EARTH_RATE, Array, matrix_from_rpy
from rovgraph.kernels.earth import normal_gravity, radii
from rovgraph.model.origin import EarthOrigin, lat_lon, north_east

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


def config(**environment: object) -> dict[str, object]:
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


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ({"latitude_deg": 50.0, "origin_lat_deg": 60.0, "origin_lon_deg": 5.0}, "takes the latitude of the origin"),
        ({"latitude_deg": 86.0}, "reaches to latitude 85"),
        ({"frame": "round"}, "frame"),
    ],
)
def test_contradictions_are_refused(environment, said):
    with pytest.raises(InputError, match=said):
        rovgraph.parse_config(json.dumps(config(**environment)))
