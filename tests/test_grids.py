"""Map grids: fixes in northing and easting, and headings relative to grid north."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from dives import Simulated, changed, falcon, simulated
from wire import Heard

import rovgraph as rg
from rovgraph.diagnosis.check.fixes import track
from rovgraph.errors import InputError
from rovgraph.inference.initialise import initialise
from rovgraph.inference.resolve import convergence
from rovgraph.live.message import GEODETIC
from rovgraph.live.sources.json_lines import json_lines
from rovgraph.live.sources.source import Chunk
from rovgraph.log import Log
from rovgraph.model.config import Config
from rovgraph.model.grids import convergence_and_scale, grid_columns, utm_zone
from rovgraph.simulate import Style
from rovgraph.simulate.path import CALM

pyproj = pytest.importorskip("pyproj")

GRID = "EPSG:32631"
ORIGIN = 60.0, 5.5  # 2.5 degrees east of the zone's meridian


@pytest.mark.parametrize(
    ("east", "convergence", "scale"), [(0.5, 0.43, 0.99961), (1.5, 1.30, 0.99969), (3.0, 2.60, 0.99994)]
)
def test_convergence_and_scale_are_those_of_utm(east: float, convergence: float, scale: float) -> None:
    found = convergence_and_scale(GRID, *np.array([60.0, 3.0 + east]))
    assert found[0] == pytest.approx(convergence, abs=0.005)
    assert found[1] == pytest.approx(scale, abs=5e-6)


def test_a_zone_is_that_of_the_place() -> None:
    assert [utm_zone(60.0, 5.5), utm_zone(-33.9, 18.4), utm_zone(0.0, 180.0)] == [
        "EPSG:32631",
        "EPSG:32734",
        "EPSG:32601",
    ]


def table(northing: str = "fix_northing", easting: str = "fix_easting") -> pd.DataFrame:
    lat, lon = 60.0 + 1e-4 * np.arange(20), 5.5 + 2e-4 * np.arange(20)
    x, y = pyproj.Transformer.from_crs("EPSG:4326", GRID, always_xy=True).transform(lon, lat)
    return pd.DataFrame({"time": np.arange(20.0), northing: y, easting: x, "lat": lat, "lon": lon})


def test_fixes_of_a_grid_are_those_of_their_latitude_and_longitude() -> None:
    frame = table()
    log = Log.from_frame(frame, Config().changed(environment={"grid": GRID}))
    same = Log.from_frame(frame[["time", "lat", "lon"]].rename(columns={"lat": "fix_lat", "lon": "fix_lon"}))
    assert log.origin == pytest.approx(same.origin, abs=1e-10)
    np.testing.assert_allclose(log["fix"].data, same["fix"].data, atol=1e-6)
    in_km = frame.assign(fix_northing=1e3 * frame["fix_northing"], fix_easting=1e3 * frame["fix_easting"])
    config = Config().changed(environment={"grid": GRID}, units={"fix": "mm"})
    np.testing.assert_allclose(Log.from_frame(in_km, config)["fix"].data, same["fix"].data, atol=1e-6)


def test_a_grid_that_is_not_stated_or_has_no_such_place_is_refused() -> None:
    with pytest.raises(InputError, match=r"of a map grid, which is not stated; state environment\.grid"):
        Log.from_frame(table())
    swapped = table("fix_easting", "fix_northing")
    for grid, frame, said in (
        ("EPSG:99999", table(), "is not known"),
        ("EPSG:4326", table(), "is in degrees, no grid"),
        ("EPSG:4978", table(), "WGS 84 is no grid"),
        (GRID, swapped, "has no place with easting"),
    ):
        with pytest.raises(InputError, match=said):
            Log.from_frame(frame, Config().changed(environment={"grid": grid}))


def test_a_grids_places_that_are_called_north_and_east_are_told() -> None:
    with pytest.warns(rg.DataWarning, match=r"are places of a map grid.*name them fix_northing and fix_easting"):
        Log.from_frame(table("fix_north", "fix_east"))


@pytest.fixture(scope="module")
def case() -> Simulated:
    known = {"ahrs_offset": {"sd_deg": 0.2}, "dvl_yaw": {"sd_deg": 0.2}}
    config = falcon(heading={"sources": ["ahrs"]}, calibration=known)
    return simulated(
        config,
        200.0,
        2,
        imu_rate=25.0,
        dvl_rate=2.0,
        ahrs_rate=5.0,
        fix_interval=1.0,
        noise=False,
        style=Style(waves=CALM),
    )


def test_a_grid_of_another_zone_is_told_once_and_not_for_each_track(case: Simulated) -> None:
    config = changed(case.config, environment={"origin_lat_deg": 42.0, "origin_lon_deg": 3.0, "grid": "EPSG:32755"})
    log = Log.from_frame(case.dive.log_frame, config)
    with pytest.warns(rg.DataWarning, match="UTM zone 55S is not made for") as told:
        initialise(log, config)
        for _ in range(3):
            grid_columns("EPSG:32755", np.array([42.0]), np.array([3.0]))
    assert len(told) == 1


@pytest.mark.parametrize(
    ("added", "stated", "said"),
    [
        (0.0, None, ""),
        (-1.0, None, "relative to grid north, state heading.ahrs_reference: grid, and environment.grid: EPSG:32631"),
        (0.0, "grid", "was probably taken twice: if ahrs is true already, state heading.ahrs_reference: true"),
        (-1.0, "grid", ""),
    ],
)
def test_a_heading_of_a_grid_is_named_by_its_convergence(
    case: Simulated, added: float, stated: str | None, said: str
) -> None:
    """Headings that are grid ones for added = -1, as the true one is that and the convergence."""
    frame = case.dive.log_frame.copy()
    turned, _ = convergence_and_scale(GRID, *np.array(ORIGIN))
    frame["ahrs_yaw"] += np.deg2rad(added * turned) + np.deg2rad(case.config.environment.declination_deg)
    place = {"origin_lat_deg": ORIGIN[0], "origin_lon_deg": ORIGIN[1], "declination_deg": 0.0, "grid": GRID}
    config = changed(case.config, environment=place, heading={"ahrs_reference": stated}, fix={"sd_m": 0.05})
    log = Log.from_frame(frame, config)
    if (north := convergence(log, config)) is not None:
        config = config.with_values(environment={"convergence_deg": north})
    found = [finding for finding in track(log, config) if "turned by" in finding.text]
    assert len(found) == 1
    assert said in found[0].text if said else "convergence" not in found[0].text
    assert found[0].level == ("warning" if said else "ok")
    mounted = changed(config, calibration={"dvl_yaw": {"sd_deg": 3.0}})  # which may turn the track as well
    assert all(finding.level == "ok" for finding in track(log, mounted))


def test_a_place_of_a_grid_online_is_one_on_earth() -> None:
    row = table().iloc[0]
    line = json.dumps({"time": 1.0, "fix_northing": row["fix_northing"], "fix_easting": row["fix_easting"]}).encode()
    heard = Heard()
    (message,) = json_lines("-", heard, Config().changed(environment={"grid": GRID})).feed(Chunk(line + b"\n", 0.0))
    ((sensor, place),) = message.readings
    assert sensor == GEODETIC
    np.testing.assert_allclose(place[:2], [row["lat"], row["lon"]], atol=1e-9)
    assert [*json_lines("-", heard, Config()).feed(Chunk(line + b"\n", 0.0))] == []
    assert heard.kinds == {"no grid": 1}


def test_results_are_in_the_grid_that_is_stated(case: Simulated, tmp_path: Path) -> None:
    """Places as PROJ has them, and north of the grid and its scale by two points of it."""
    place = {"origin_lat_deg": ORIGIN[0], "origin_lon_deg": ORIGIN[1], "grid": GRID}
    config = changed(case.config, environment=place)
    result = rg.smooth(Log.from_frame(case.dive.log_frame, config), config)
    assert any("results are in EPSG:32631, too: its north is +2.16" in line for line in result.assumptions)
    result.save(tmp_path / "out", figures=False, page=False)
    track = pd.read_csv(tmp_path / "out" / "trajectory_smoothed.csv")
    to_grid = pyproj.Transformer.from_crs("EPSG:4326", GRID, always_xy=True)
    x, y = to_grid.transform(track["lon"].to_numpy(), track["lat"].to_numpy())
    np.testing.assert_allclose(track[["easting", "northing"]], np.column_stack([x, y]), atol=2e-4)
    lat, lon = float(track["lat"][0]), float(track["lon"][0])
    north = np.diff(to_grid.transform([lon, lon], [lat - 1e-4, lat + 1e-4]), axis=1)[:, 0]
    metres = pyproj.Geod(ellps="WGS84").inv(lon, lat - 1e-4, lon, lat + 1e-4)[2]
    assert track["grid_north"][0] == pytest.approx(-np.rad2deg(np.arctan2(*north)), abs=2e-4)
    assert track["grid_scale"][0] == pytest.approx(np.hypot(*north) / metres, abs=1e-7)
    assert len(rg.read_trajectory(tmp_path / "out" / "trajectory_smoothed.csv")) == len(track)


def test_a_grid_that_does_not_reach_to_a_dive_is_refused_before_it(case: Simulated) -> None:
    place = {"origin_lat_deg": ORIGIN[0], "origin_lon_deg": ORIGIN[1], "grid": "EPSG:99999"}
    config = changed(case.config, environment=place)
    with pytest.raises(InputError, match=r"environment\.grid 'EPSG:99999': is not known"):
        rg.smooth(Log.from_frame(case.dive.log_frame, config), config)
