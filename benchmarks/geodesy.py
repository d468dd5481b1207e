"""Dives on WGS 84 against truth: free inertial navigation, transits of 100 km, and dives with noise.

    python benchmarks/geodesy.py                                      every row, 20 seeds
    python benchmarks/geodesy.py --rows "20 km, fog, 60 S" --seeds 3 --online

prints a table in Markdown, a row for each target. Rows of exact data are one dive each, and their judge is pyins
(`pip install python-ins`): its integrator, without altitude, and its simulator. Dives with noise are those of
`fault_campaign`, which has its own ellipsoid, and go through the command line. They begin with a minute of fixes.
"""

import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from fault_campaign import earth
from fault_campaign.campaign import merge
from fault_campaign.earth import Array
from fault_campaign.instruments import sample
from fault_campaign.judge import Dive, Result, horizontal_error, row_options, run_dive, tracks, write_dive
from fault_campaign.motion import Motion, Profile
from fault_campaign.vehicle import Dvl, configuration, make_vehicle
from scipy.stats import chi2

import rovgraph
from rovgraph.geometry import EARTH_RATE, matrix_from_rpy
from rovgraph.kernels.earth import normal_gravity
from rovgraph.kernels.motion import transitions
from rovgraph.kernels.states import States
from rovgraph.lab.executors import cores, starting, workers
from rovgraph.model.origin import EarthOrigin, lat_lon
from rovgraph.problem.motion import PreintegrationParams, preintegrate


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes
    ----------
    target : what it has to reach
    run : a dive by its seed, and whether it is replayed online too
    found : of all dives, in a cell, and whether that is the target
    once : there is but one dive
    dive : what the command gets, by the seed, where it is the command that is judged
    """

    target: str
    run: Callable[[int, bool], Result]
    found: Callable[[Sequence[Result]], tuple[str, bool]]
    once: bool = False
    dive: Callable[[int], Dive] | None = None


def most(limit: float, unit: float, text: str, results: Sequence[Result]) -> tuple[str, bool]:
    """The largest "apart" of some dives [m], in a unit."""
    apart = max(r.found["apart"] for r in results)
    return f"{apart / unit:.2g} {text}", apart <= limit


def metres_apart(lat: Array, lon: Array, true_lat: Array, true_lon: Array) -> Array:
    """Horizontal distances [m] of places [deg] that are close to each other."""
    M, N = earth.radii(np.deg2rad(true_lat))
    east = np.deg2rad((lon - true_lon + 180.0) % 360.0 - 180.0) * N * np.cos(np.deg2rad(true_lat))
    return np.asarray(np.hypot(np.deg2rad(lat - true_lat) * M, east))


# pyins


GYRO, FORCE = ["gyro_x", "gyro_y", "gyro_z"], ["accel_x", "accel_y", "accel_z"]


def free_inertial(latitude: float, _seed: int, _online: bool) -> Result:
    """Ten minutes of the same samples through both mechanisations, from the same state.

    Between samples at 100 Hz both leave out some of the rolling, 5 to 15 mm, and a sixteenth of that at 400 Hz.
    """
    from pyins import sim, strapdown

    t, interval = np.arange(240001) / 400.0, 40
    heading = np.deg2rad(40.0) + 1.2 * np.sin(2.0 * np.pi * t / 170.0)
    speed = 2.0 + 0.5 * np.sin(2.0 * np.pi * t / 60.0)
    v_n = np.column_stack([speed * np.cos(heading), speed * np.sin(heading), 0.0 * t])
    rph = np.column_stack([3.0 * np.sin(t / 6.0), 2.0 * np.sin(t / 8.0 + 1.0), np.rad2deg(heading)])
    way, imu = sim.generate_imu(t, [latitude, 20.0, 0.0], rph, v_n, "rate")
    integrator = strapdown.Integrator(way.iloc[0], with_altitude=False)
    judge = integrator.integrate(strapdown.compute_increments_from_imu(imu, "rate"))

    lat_0, samples = np.deg2rad(latitude), np.ascontiguousarray(np.column_stack([t, imu[FORCE], imu[GYRO]]))
    rate = EARTH_RATE * np.array([np.cos(lat_0), 0.0, -np.sin(lat_0)])
    params = PreintegrationParams((1e-3,) * 5, float(normal_gravity(lat_0)), rate, float(lat_0))
    R = matrix_from_rpy(np.deg2rad(rph[:1]))
    here = States(R, np.zeros((1, 3)), v_n[:1].copy(), np.zeros((1, 6)))
    places = [here.p[0]]
    for begin in range(0, len(t) - 1, interval):
        part = samples[begin : begin + interval + 1].copy()
        row, covariance, _ = preintegrate(params, np.zeros(6), part, part[0, 0], np.empty(0), part[-1, 0])
        there = States(*(np.empty_like(x) for x in here))
        transitions(row[None], covariance[None], here, there, np.empty((1, 15, 15)), np.empty((1, 15, 15)))
        here = there._replace(b=np.zeros((1, 6)))
        places.append(here.p[0])
    lat, lon = lat_lon(*np.array(places)[:, :2].T, EarthOrigin(latitude, 20.0))
    there = judge.iloc[::interval]
    apart = metres_apart(lat, lon, there["lat"].to_numpy(), there["lon"].to_numpy())
    return Result(found={"apart": float(apart.max())})


def exact_transit(latitude: float, longitude: float, _seed: int, _online: bool) -> Result:
    """100 km on course 60 deg at 2 m/s, without noise, with fixes at both ends."""
    from pyins import sim

    t, every = np.arange(250001) * 0.2, 10
    rpy, v_n = np.deg2rad([[0.0, 0.0, 60.0]]), np.array([1.0, np.sqrt(3.0), 0.0])
    level = np.tile(np.rad2deg(rpy), (len(t), 1))
    way, imu = sim.generate_imu(t, [latitude, longitude, 0.0], level, np.tile(v_n, (len(t), 1)), "rate")
    log = pd.DataFrame(np.column_stack([t, imu[FORCE], imu[GYRO]]))
    log.columns = pd.Index(["time", *(f"{name}_{axis}" for name in ("acc", "gyr") for axis in "xyz")])
    log.loc[::every, ["dvl_vx", "dvl_vy", "dvl_vz"]] = v_n @ matrix_from_rpy(rpy)[0]
    log.loc[::every, "depth"] = 0.0
    true = way[["lat", "lon"]].to_numpy().copy()
    true[:, 1] = (true[:, 1] + 180.0) % 360.0 - 180.0
    for k in (0, len(t) - 1):
        log.loc[k, ["fix_lat", "fix_lon"]] = true[k]
    settings = {
        "environment": {"frame": "earth"},
        "imu": {
            "noise": {"acc": 1e-4, "gyr": 1e-6, "acc_walk": 1e-7, "gyr_walk": 1e-10},
            "acc_bias_sd_mps2": 1e-4,
            "gyr_bias_sd_dps": 1e-5,
        },
        "dvl": {"velocity_sd_mps": [0.002, 0.002, 0.002]},
        "start": {"heading_deg": 60.0, "heading_sd_deg": 0.1, "roll_deg": 0.0, "pitch_deg": 0.0},
    }
    config = rovgraph.parse_config(json.dumps(settings))
    with tempfile.TemporaryDirectory() as name:
        log.to_csv(Path(name) / "log.csv", index=False, float_format="%.12g")
        result = rovgraph.smooth(rovgraph.read_log(Path(name) / "log.csv", config), config)
    track = result.smoothed.trajectory
    lat, lon = track.geodetic(result.log.origin)
    at = np.rint(track.time / t[1]).astype(int)
    return Result(found={"apart": float(metres_apart(lat, lon, *true[at].T).max())})


# dives with noise


@dataclass(frozen=True)
class Transit(Motion):
    """A motion with north and east in a frame of rovgraph's, ``flat`` or on the Earth at the scale of the origin."""

    flat: bool = field(default=False, kw_only=True)

    def local(self, t: Array) -> Array:
        """North, east and depth, shape (n, 3) [m]."""
        if self.flat:
            return super().local(t)
        place, (M, N) = self.geodetic(t), earth.radii(np.asarray(self.origin[0]))
        lat, lon = place[:, 0] - self.origin[0], place[:, 1] - self.origin[1]
        return np.column_stack([lat * M, lon * N * np.cos(self.origin[0]), -place[:, 2]])


SPEED, FIXED_S = 2.0, 60.0
TILT_SD, SCALE_SD = 0.2, 0.003  # of the DVL's roll and pitch [deg], and of its scale


def transit(grade: str, place: tuple[float, float], seed: int, flat: bool = False, distance: float = 20e3) -> Dive:
    """A way of some legs, whose net course is drawn, with a compass; seeds have the same noise at all places."""
    rng = np.random.default_rng([31, seed])
    seconds = distance / SPEED
    turns = np.deg2rad(rng.uniform(20.0, 50.0, 4)) * np.array([1.0, -2.0, 2.0, -1.0])
    ramps = [(seconds * (0.1 + 0.2 * k), 30.0, turn) for k, turn in enumerate(turns)]
    heading = Profile(rng.uniform(-np.pi, np.pi), ramps, ((0.02, 45.0, rng.uniform(0.0, 6.0)),))
    tilt = [Profile(0.0, (), ((0.03, period, rng.uniform(0.0, 6.0)),)) for period in (9.0, 8.0)]
    speeds = Profile(0.0, ((5.0, 20.0, SPEED),)), Profile(0.0, (), ((0.03, 13.0, 1.0),)), Profile()
    origin = (np.deg2rad(place[0]), np.deg2rad(place[1]))
    motion = Transit(seconds, heading, speeds, *tilt, 2.0, origin, flat=flat, step=0.1)
    vehicle = make_vehicle(grade, ("ahrs", "depth"))
    vehicle.imu = replace(vehicle.imu, rate=10.0)
    tilted = rng.normal(0.0, TILT_SD, 2).tolist()
    vehicle.dvl = Dvl(rate=0.5, mount_rpy_deg=(*tilted, 0.0), yaw_sd=0.2, scale_sd=SCALE_SD)
    vehicle.ahrs = replace(vehicle.ahrs, rate=0.5, offset_sd=0.5, curve_sd=0.3)
    vehicle.depth = replace(vehicle.depth, rate=0.5)
    streams, hidden = sample(motion, vehicle, rng)
    t = np.arange(1.0, FIXED_S)
    lat, lon, _ = motion.geodetic(t).T
    M, N = earth.radii(lat)
    arm = np.einsum("nij,j->ni", motion.C_nb(t), np.asarray(vehicle.fix.arm)) + rng.normal(0.0, 1.0, (len(t), 3))
    lat, lon = lat + arm[:, 0] / M, lon + arm[:, 1] / (N * np.cos(lat))
    fixes = {"fix_lat": np.rad2deg(lat), "fix_lon": (np.rad2deg(lon) + 180.0) % 360.0 - 180.0}
    streams["fix"] = pd.DataFrame({"time": t, **fixes})
    stated = {"frame": "flat" if flat else "earth", "origin_lat_deg": place[0], "origin_lon_deg": place[1]}
    config: dict[str, Any] = configuration(vehicle)
    for key in ("gravity_mps2", "latitude_deg", "earth_rotation") if not flat else ("gravity_mps2",):
        del config["environment"][key]
    config = merge(config, {"environment": stated, "start": {"position_sd_m": 1.0}, "graph": {"max_gap_s": 2.5}})
    mounting = {f"dvl_{angle}": {"sd_deg": TILT_SD} for angle in ("roll", "pitch")}
    scale = {"estimate": True, "sd": SCALE_SD}
    config = merge(config, {"calibration": {**mounting, "dvl_scale": scale}, "dvl": {"mount_rpy_deg": [0.0, 0.0, 0.0]}})
    if flat:
        config["environment"] |= {"latitude_deg": place[0], "earth_rotation": grade == "fog"}
    return Dive(streams, config, motion, hidden)


def ends(folder: Path, dive: Dive) -> dict[str, float]:
    """Error and NEES of each estimate at the end."""
    found: dict[str, float] = {}
    for kind, track in tracks(folder):
        off, cov = horizontal_error(dive, track.iloc[-1])
        found |= {f"{kind} end": float(np.hypot(*off)), f"{kind} nees": float(off @ np.linalg.solve(cov, off)) / 2}
    return found


def noisy(grade: str, place: tuple[float, float], seed: int, online: bool) -> Result:
    """One dive."""
    return run_dive(transit(grade, place, seed), online, ends)


def honest(results: Sequence[Result]) -> tuple[str, bool]:
    """NEES of positions at the end and of headings, whose band is that of 99 of 100 campaigns."""
    low, high = chi2.ppf([0.005, 0.995], 2 * len(results)) / (2 * len(results))
    cells, met = [], not any(r.refused for r in results)
    for kind in ("smoothed", "filtered", "online"):
        if not (done := [r for r in results if kind in r.nees]):
            continue
        rms = float(np.sqrt(np.mean([r.found[f"{kind} end"] ** 2 for r in done])))
        end = float(np.mean([r.found[f"{kind} nees"] for r in done]))
        heading = float(np.mean([r.nees[kind]["heading"] for r in done]))
        cells.append(f"{kind} {rms:.0f} m at the end, NEES {end:.2f}, heading {heading:.2f}")
        met &= low <= end <= high and heading <= high
    return "; ".join(cells) + f" (band {low:.2f} to {high:.2f})", met


def both_ways(place: tuple[float, float], seed: int, _online: bool) -> Result:
    """The same dive in both frames."""
    found = {}
    for name, flat in (("earth", False), ("flat", True)):
        found[name] = run_dive(transit("fog", place, seed, flat), False, ends).found["smoothed end"]
    return Result(found=found)


def same_drift(results: Sequence[Result]) -> tuple[str, bool]:
    """Drifts in both frames, compared."""
    on_earth, flat = (float(np.sqrt(np.mean([r.found[kind] ** 2 for r in results]))) for kind in ("earth", "flat"))
    return f"{on_earth:.2f} m, flat {flat:.2f} m: {on_earth / flat:.4f} times", abs(on_earth / flat - 1.0) <= 0.02


def cost(_seed: int, _online: bool) -> Result:
    """Processor time of one dive in both frames, the least of some rounds."""
    least = {}
    with tempfile.TemporaryDirectory() as name:
        dives = []
        for flat in (False, True):
            folder = Path(name) / str(flat)
            folder.mkdir()
            write_dive(transit("fog", (45.0, 14.0), 0, flat, 5e3), folder)
            config = rovgraph.load_config(folder / "vehicle.yaml")
            dives.append((flat, rovgraph.read_log(folder / "log.csv", config), config))
        for _ in range(5):
            for flat, log, config in dives:
                begin = time.process_time()
                rovgraph.smooth(log, config)
                least[flat] = min(least.get(flat, np.inf), time.process_time() - begin)
    return Result(found={"ratio": least[False] / least[True]})


def ratio(results: Sequence[Result]) -> tuple[str, bool]:
    """Of processor times."""
    times = results[0].found["ratio"]
    return f"{times:.2f} times", times <= 1.1


PLACES = {
    "equator": (0.0, 14.0),
    "45 N": (45.0, 14.0),
    "70 N": (70.0, 14.0),
    "60 S": (-60.0, 14.0),
    "date line": (58.0, 179.9),
}
ROWS = {
    **{
        f"10 min free inertial, latitude {lat:g}": Row(
            "1 mm from pyins", partial(free_inertial, lat), partial(most, 1e-3, 1e-3, "mm"), once=True
        )
        for lat in (0.0, 45.0, 70.0)
    },
    **{
        f"100 km, exact, {name}": Row(
            "0.1 m at every keyframe", partial(exact_transit, *place), partial(most, 0.1, 1.0, "m"), once=True
        )
        for name, place in (("70 N over the date line", (70.0, 179.0)), ("60 S", (-60.0, 20.0)))
    },
    **{
        f"20 km, {grade}, {name}": Row(
            "NEES in band", partial(noisy, grade, place), honest, dive=partial(transit, grade, place)
        )
        for grade in ("fog", "mti")
        for name, place in PLACES.items()
    },
    "20 km, fog, equator, flat too": Row("drift of flat within 2 %", partial(both_ways, PLACES["equator"]), same_drift),
    "cost of 5 km": Row("1.1 times flat", cost, ratio, once=True),
}


def main() -> None:
    """Run and print."""
    arguments = row_options(__doc__, ROWS, cores()).parse_args()
    print("| dive | target | found | met |\n|---|---|---|---|", flush=True)
    with workers(arguments.jobs) as pool:
        for name in arguments.rows:
            row = ROWS[name]
            with starting():
                futures = [
                    pool.submit(row.run, seed, arguments.online) for seed in range(1 if row.once else arguments.seeds)
                ]
            results = [future.result() for future in futures]
            found, met = row.found(results)
            print(f"| {name} | {row.target} | {found} | {'yes' if met else '**no**'} |", flush=True)
            if arguments.said:
                print("\n".join(results[0].said), flush=True)
            if arguments.keep and row.dive is not None:
                folder = arguments.keep / name.replace(" ", "_").replace(",", "")
                folder.mkdir(parents=True, exist_ok=True)
                write_dive(row.dive(0), folder)


if __name__ == "__main__":
    main()
