"""A dive over a chart, from its files to its track: the chart shows where the vehicle was, or one line says why not."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from crossovers import Relief, Terrain, matern, survey_motion
from fault_campaign.beams import Beams, stated
from fault_campaign.campaign import merge
from fault_campaign.instruments import sample
from fault_campaign.judge import Dive, run_command, write_dive
from fault_campaign.vehicle import configuration, make_vehicle

import rovgraph as rg
from rovgraph.inference.bottom import bottom_of
from rovgraph.inference.chart import read_chart
from rovgraph.inference.crossovers import with_crossovers
from rovgraph.model.config import beliefs

rasterio = pytest.importorskip("rasterio")
ORIGIN = 58.3, 14.6
OFF = 14.0, -9.0  # how far the dive begins from where it is said to


def write_chart(path: Path, terrain: Terrain, change=lambda z: z, wider: float = 0.0) -> None:
    """Depths of every metre with a noise of 0.3 m, in a projection about the origin; its first row is the north."""
    north, east = np.arange(330.0 + wider, -60.0 - wider, -1.0), np.arange(-60.0 - wider, 120.0 + wider)
    place = np.stack(np.meshgrid(north, east, indexing="ij"), axis=-1)
    depth = terrain(place) + np.random.default_rng(5).normal(0.0, 0.3, place.shape[:2])
    values = change(depth).astype("float32")
    about = f"+proj=aeqd +lat_0={ORIGIN[0]} +lon_0={ORIGIN[1]} +ellps=WGS84 +units=m"
    corner = rasterio.Affine(1.0, 0.0, east[0] - 0.5, 0.0, -1.0, north[0] + 0.5)
    shape = {"height": values.shape[0], "width": values.shape[1], "count": 1, "dtype": "float32"}
    with rasterio.open(path, "w", driver="GTiff", crs=about, transform=corner, **shape) as file:
        file.write(values, 1)


@pytest.fixture(scope="module")
def dived(tmp_path_factory):
    """Folder with log.csv and vehicle.yaml of two lines of 250 m, its terrain, and the dive."""
    rng, folder = np.random.default_rng([45, 1]), tmp_path_factory.mktemp("dive")
    terrain, vehicle = matern(rng), make_vehicle("mti", ("ahrs", "depth"))
    beams = Beams(bottom=Relief(20.0, terrain=terrain))
    vehicle.dvl = replace(vehicle.dvl, mount_rpy_deg=(0.0, 0.0, -45.0), yaw_sd=0.3, sd=beams.head.velocity_sd)
    vehicle.dvl.rate, vehicle.imu.rate = 2.0, 50.0
    motion = survey_motion(2, 250.0, 25.0, 0)
    config = merge(configuration(vehicle), stated(beams.head))
    start = {"north_m": OFF[0], "east_m": OFF[1], "position_sd_m": 15.0}
    config = merge(config, {"start": start, "environment": {"origin_lat_deg": ORIGIN[0], "origin_lon_deg": ORIGIN[1]}})
    streams, hidden = sample(motion, vehicle, rng, beams)
    dive = Dive(streams, config, motion, hidden)
    write_dive(dive, folder)
    return folder, terrain, dive


def off(dive: Dive, time, place) -> float:
    return float(np.sqrt(np.mean(np.sum((place - dive.motion.local(time)[:, :2]) ** 2, axis=1))))


@pytest.mark.slow
def test_a_dive_that_begins_elsewhere_than_it_says_is_placed_by_a_chart(dived):
    folder, terrain, dive = dived
    write_chart(folder / "chart.tif", terrain)
    config = merge(dive.configuration, {"chart": {"file": str(folder / "chart.tif"), "sd_m": 0.3}})
    (folder / "charted.yaml").write_text(json.dumps(config))
    out = folder / "out"
    arguments = [folder / "log.csv", "--config", folder / "charted.yaml", "--out", out, "--no-figures"]
    code, errors = run_command(["smooth", *map(str, arguments)])
    assert code == 0, errors
    track = pd.read_csv(out / "trajectory_smoothed.csv")
    assert off(dive, track["time"].to_numpy(), track[["north", "east"]].to_numpy()) < 2.0
    calibration = pd.read_csv(out / "calibration.csv").set_index("label")
    place = calibration.loc[["chart_place_north", "chart_place_east"]]
    assert (place["sd"] <= 1.0).all() and (place["value"].abs() < 3.0 * place["sd"] + 0.1).all()
    said = json.loads((out / "summary.json").read_text())["assumptions"]
    assert sum("pieces on the chart matched" in line for line in said) == 1


@pytest.mark.slow
def test_live_a_chart_shows_within_500_m_where_a_vehicle_is_that_may_be_anywhere_within_50_m(dived):
    folder, terrain, dive = dived
    write_chart(folder / "wide.tif", terrain, wider=35.0)
    start = {"north_m": 32.0, "east_m": -39.0, "position_sd_m": 50.0}
    config = merge(dive.configuration, {"start": start, "chart": {"file": str(folder / "wide.tif"), "sd_m": 0.3}})
    (folder / "live.yaml").write_text(json.dumps(config))
    arguments = [f"file:{folder / 'log.csv'}", "--config", folder / "live.yaml", "--out", folder / "live"]
    code, errors = run_command(["online", *map(str, arguments), "--speed", "max", "--no-refine"])
    assert code == 0, errors
    track = pd.read_csv(folder / "live" / "trajectory_filtered.csv")
    time, place = track["time"].to_numpy(), track[["north", "east"]].to_numpy()
    early, after = time < 60.0, time > 400.0  # the second is within 400 m of the start
    assert off(dive, time[early], place[early]) > 40.0
    assert off(dive, time[after], place[after]) < 3.0
    assert track["north_sd"][after].max() < 10.0 and "pieces on the chart matched" in errors


@pytest.mark.slow
def test_a_chart_that_is_missing_is_refused_in_a_line_before_the_dive_is_solved(dived):
    folder, _, dive = dived
    (folder / "missing.yaml").write_text(json.dumps(merge(dive.configuration, {"chart": {"file": "none.tif"}})))
    arguments = [folder / "log.csv", "--config", folder / "missing.yaml", "--out", folder / "missing"]
    code, errors = run_command(["smooth", *map(str, arguments)])
    assert code == 2 and errors.count("\n") == 1 and "there is no such file" in errors
    assert not (folder / "missing").exists()


def holed(z):
    z = z.copy()
    z[:, ::40], z[100:140, 60:90] = np.nan, np.nan
    return z


@pytest.mark.slow
def test_charts_with_faults_are_understood_or_not_used(dived):
    folder, terrain, dive = dived
    config = rg.load_config(folder / "vehicle.yaml")
    log = rg.read_log(folder / "log.csv", config)
    estimate = rg.smooth(log, config, estimate="smoothed").smoothed
    bottom, track = bottom_of(log, config, estimate), estimate.trajectory
    assert off(dive, track.time, track.p_n[:, :2]) > 10.0

    def charted(change):
        path = folder / "faulty.tif"
        write_chart(path, terrain, change)
        settings = config.chart.model_copy(update={"file": str(path), "sd_m": 0.3})
        found, seen = with_crossovers(estimate, bottom, beliefs(config), read_chart(settings, ORIGIN), ORIGIN)
        return off(dive, found.trajectory.time, found.trajectory.p_n[:, :2]), seen.text

    for right in (lambda z: -z, holed, lambda z: z + 3.0):
        error, said = charted(right)
        assert error < 2.0, said
    for wrong, why in (
        (lambda z: z[::-1], ""),
        (lambda z: np.roll(z, (150, 60), (0, 1)), ""),
        (lambda z: z / 0.3048, "look like feet"),
        (lambda z: z + 12.0, "another place or datum"),
        (lambda z: np.nan * z, "no depths where the track is"),
    ):
        error, said = charted(wrong)
        assert error > 10.0 and "nothing is used" in said and why in said
