"""How often the checks of a magnetometer's field and of a heading's north are wrong about healthy dives, and right.

    python benchmarks/norths.py --seeds 400

prints a table in Markdown, a row for each kind of dive of `fault_campaign`: in how many a warning is given. Dives of
five minutes are between 65 S and 75 N, on any day of the World Magnetic Model, where a compass is of use. A healthy
magnetometer has its calibration's default errors, in a field with rock and storms; healthy headings have the offsets
that are stated.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from fault_campaign import earth
from fault_campaign.campaign import merge
from fault_campaign.instruments import log_table, sample
from fault_campaign.motion import Motion, Profile
from fault_campaign.vehicle import Field, configuration, make_vehicle

from rovgraph.diagnosis.check.compasses import field_of_place
from rovgraph.diagnosis.check.findings import Finding
from rovgraph.diagnosis.check.fixes import track
from rovgraph.inference.initialise import with_convergence
from rovgraph.log import Log
from rovgraph.model.calibration import TABLE
from rovgraph.model.config import Config
from rovgraph.model.grids import convergence_and_scale, utm_zone
from rovgraph.sensors.earth_field import CAUTION_NT, decimal_year, earth_field

BEGIN, END = 1.7358e9, 1.893e9  # of the model [s since 1970]
ROCK_NT, STORM_NT = 200.0, 150.0  # sds, of each component and of the one to the north
SOFT_IRON = TABLE["soft_iron"].sd
USABLE = 0.1  # hard iron up to which its sd is stated
MAGNETOMETERS: dict[str, dict[str, Any]] = {
    "healthy": {},
    "healthy, hard iron of 5 %, stated": {"hard_iron": 0.05},
    "hard iron of 30 %, not calibrated": {"hard_iron": 0.3},
    "hard iron of 60 %, not calibrated": {"hard_iron": 0.6},
    "soft iron of 20 %": {"soft_iron": 0.2},
    "a scale of 0.7": {"gain": (0.7, 0.7, 0.7)},
    "z reversed": {"gain": (1.0, 1.0, -1.0)},
}
COMPASSES = {"sds of offset and mounting 0.1 deg": (0.1, 0.1), "0.3 deg": (0.3, 0.3), "0.3 and 3 deg": (0.3, 3.0)}
NORTHS = {
    "true": (0.0, "true"),
    "relative to the grid, taken for true": (-1.0, "true"),
    "true, taken for the grid's": (0.0, "grid"),
}


def motion(rng: np.random.Generator, place: tuple[float, float]) -> Motion:
    """Legs to and fro at 1 m/s, with waves."""
    turns = [(begin, 15.0, np.pi * (-1) ** k) for k, begin in enumerate((60.0, 120.0, 180.0, 240.0))]
    tilt = [Profile(0.0, (), ((0.05, period, rng.uniform(0.0, 6.0)),)) for period in (7.0, 6.0)]
    heading = Profile(rng.uniform(-np.pi, np.pi), turns)
    origin = (float(np.deg2rad(place[0])), float(np.deg2rad(place[1])))
    return Motion(300.0, heading, (Profile(1.0), Profile(), Profile()), *tilt, origin=origin, step=0.1)


def by_magnetometer(
    seed: int,
    hard_iron: float = TABLE["hard_iron"].sd,
    soft_iron: float = SOFT_IRON,
    gain: tuple[float, ...] = (1, 1, 1),
) -> Iterator[Finding]:
    """What is said of the field of one dive; iron as sds of the field."""
    rng = np.random.default_rng([71, seed])
    while True:
        place, begin = (rng.uniform(-65.0, 75.0), rng.uniform(-180.0, 180.0)), rng.uniform(BEGIN, END)
        field = earth_field(*place, 0.0, decimal_year(begin))
        if field.horizontal_nt > CAUTION_NT:
            break
    north, east, down = np.array([field.north_nt, field.east_nt, field.down_nt]) + rng.normal(0.0, ROCK_NT, 3)
    north -= abs(rng.normal(0.0, STORM_NT))
    horizontal = float(np.hypot(north, east))
    iron = rng.normal(0.0, soft_iron, (3, 3))
    there = Field(
        float(np.rad2deg(np.arctan2(east, north))),
        float(np.rad2deg(np.arctan2(down, horizontal))),
        1e-3 * float(np.hypot(horizontal, down)),
        hard_iron,
        np.diag(gain) @ (np.eye(3) + 0.5 * (iron + iron.T)),
    )
    vehicle = make_vehicle("mti", ("mag",))
    vehicle.field, vehicle.imu, vehicle.mag = there, replace(vehicle.imu, rate=10.0), replace(vehicle.mag, rate=2.0)
    streams, _ = sample(motion(rng, place), vehicle, rng)
    table = log_table(streams)
    table["time"] += begin
    origin = {"origin_lat_deg": place[0], "origin_lon_deg": place[1]}
    stated = {"hard_iron": {"sd": max(hard_iron, TABLE["hard_iron"].sd)}} if hard_iron < USABLE else {}
    config = Config().changed(environment=origin, units={"mag": "uT"}, calibration=stated)
    yield from field_of_place(Log.from_frame(table, config), config)


def by_heading(seed: int, offset_sd: float, mount_sd: float, of_grid: float, stated: str) -> Iterator[Finding]:
    """What is said of the track of one dive; ``of_grid`` convergences are added to its heading."""
    rng = np.random.default_rng([72, seed])
    place = (rng.choice([-1.0, 1.0]) * rng.uniform(35.0, 72.0), rng.uniform(-180.0, 180.0))
    grid = utm_zone(*place)
    convergence = float(convergence_and_scale(grid, *np.array(place))[0])
    vehicle = make_vehicle("mti", ("ahrs",))
    vehicle.field.declination, vehicle.imu = 0.0, replace(vehicle.imu, rate=10.0)
    vehicle.ahrs = replace(vehicle.ahrs, rate=1.0, offset_sd=offset_sd, curve_sd=0.05)
    vehicle.dvl = replace(vehicle.dvl, rate=1.0, yaw_sd=mount_sd)
    way = motion(rng, place)
    streams, _ = sample(way, vehicle, rng)
    streams["ahrs"]["ahrs_yaw"] += np.deg2rad(of_grid * convergence)
    t = np.arange(1.0, 299.0, 2.0)
    lat, lon, _ = way.geodetic(t).T
    M, N = earth.radii(lat)
    off = np.einsum("nij,j->ni", way.C_nb(t), np.asarray(vehicle.fix.arm)) + rng.normal(
        0.0, vehicle.fix.sd, (len(t), 3)
    )
    fixes = {"fix_lat": np.rad2deg(lat + off[:, 0] / M), "fix_lon": np.rad2deg(lon + off[:, 1] / (N * np.cos(lat)))}
    streams["fix"] = pd.DataFrame({"time": t, **fixes})
    stated_too = {"environment": {"grid": grid}, "heading": {"ahrs_reference": stated}}
    given = merge(configuration(vehicle), {**stated_too, "fix": {"sd_m": vehicle.fix.sd}})
    for key in ("declination_deg", "gravity_mps2", "latitude_deg", "earth_rotation"):
        given["environment"].pop(key)
    config = Config().changed(**given)
    log = Log.from_frame(log_table(streams), config)
    yield from (f for f in track(log, with_convergence(log, config, [])) if "convergence" in f.text)


def share(found: list[list[Finding]]) -> str:
    """In how many dives a warning is given."""
    return f"{sum(any(f.level == 'warning' for f in one) for one in found)} of {len(found)}"


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=400)
    seeds = range(parser.parse_args().seeds)
    print("| magnetometer | warned |\n|---|---|", flush=True)
    for name, settings in MAGNETOMETERS.items():
        print(f"| {name} | {share([[*by_magnetometer(seed, **settings)] for seed in seeds])} |", flush=True)
    print("\n| heading | " + " | ".join(COMPASSES) + " |\n|---|" + "---|" * len(COMPASSES), flush=True)
    for name, north in NORTHS.items():
        cells = [share([[*by_heading(seed, *sds, *north)] for seed in seeds]) for sds in COMPASSES.values()]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
