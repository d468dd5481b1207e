"""Dives on WGS 84 against truth: free inertial navigation, transits, headings without a compass, and depth by pressure.

    python benchmarks/geodesy.py                                      every row, 20 seeds
    python benchmarks/geodesy.py --rows "20 km, fog, 60 S" --seeds 3 --online
    python benchmarks/geodesy.py --figure docs/images/gyrocompassing.png

prints a table in Markdown, a row for each target. Rows of exact data are one dive each, and their judge is pyins
(`pip install python-ins`): its integrator, without altitude, and its simulator. Dives with noise are those of
`fault_campaign`, which has its own ellipsoid, and go through the command line. A seed gives all rows of a kind the same
draws.
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
from fault_campaign.judge import (
    Dive,
    Result,
    horizontal_error,
    row_options,
    run_command,
    run_dive,
    tracks,
    write_dive,
)
from fault_campaign.motion import Motion, Profile
from fault_campaign.vehicle import GRADES, Depth, Dvl, Vehicle, configuration, make_vehicle
from scipy.stats import chi2

import rovgraph
from rovgraph.geometry import EARTH_RATE, matrix_from_rpy
from rovgraph.kernels.earth import normal_gravity
from rovgraph.kernels.motion import transitions
from rovgraph.kernels.states import States
from rovgraph.lab.executors import cores, starting, workers
from rovgraph.model.calibration import TABLE
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


def rms(results: Sequence[Result], name: str) -> float:
    """Root of the mean square of something found."""
    return float(np.sqrt(np.mean([r.found[name] ** 2 for r in results])))


def band(dives: int, freedom: int = 1) -> tuple[float, float]:
    """Mean NEES of 99 of 100 honest campaigns of some dives, by the errors in each that are not one another's."""
    low, high = chi2.ppf([0.005, 0.995], freedom * dives) / (freedom * dives)
    return float(low), float(high)


def trusted(results: Sequence[Result]) -> str:
    """How many dives are, smoothed."""
    return f"{sum(r.verdicts.get('smooth') == 'trusted' for r in results)} of {len(results)} trusted"


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


# transits


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


KINDS = ("smoothed", "filtered", "online")
SPEED, FIXED_S = 2.0, 60.0
TILT_SD, SCALE_SD = 0.2, 0.003  # of the DVL's roll and pitch [deg], and of its scale
DEFAULTS = {name: TABLE[name].sd for name in ("dvl_lever_arm", "depth_offset", "depth_scale")}  # [m, m, 1]


def transit(grade: str, place: tuple[float, float], seed: int, flat: bool = False, distance: float = 20e3) -> Dive:
    """A way of some legs, whose net course is drawn, with a compass; it begins with a minute of fixes.

    What the estimate takes for unknown is drawn as it is believed, but for the IMU's scale errors, which are stated.
    """
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
    stated_arm = vehicle.dvl.arm
    vehicle.dvl.arm = (stated_arm + rng.normal(0.0, DEFAULTS["dvl_lever_arm"], 3)).tolist()
    vehicle.ahrs = replace(vehicle.ahrs, rate=0.5, offset_sd=0.5, curve_sd=0.3)
    offset, density = rng.normal(0.0, [DEFAULTS["depth_offset"], DEFAULTS["depth_scale"]])
    vehicle.depth = replace(vehicle.depth, rate=0.5, offset=offset, density=density)
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
    known: dict[str, Any] = {f"dvl_{angle}": {"sd_deg": TILT_SD} for angle in ("roll", "pitch")}
    known |= {"dvl_scale": {"estimate": True, "sd": SCALE_SD}, "gyr_scale": {"sd": vehicle.imu.matrix_sd}}
    dvl = {"mount_rpy_deg": [0.0, 0.0, 0.0], "lever_arm_m": list(stated_arm)}
    config = merge(config, {"calibration": known, "dvl": dvl})
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
    low, high = band(len(results), 2)
    cells, met = [], not any(r.refused for r in results)
    for kind in KINDS:
        if not (done := [r for r in results if kind in r.nees]):
            continue
        end = float(np.mean([r.found[f"{kind} nees"] for r in done]))
        heading = float(np.mean([r.nees[kind]["heading"] for r in done]))
        off = rms(done, f"{kind} end")
        cells.append(f"{kind} {off:.0f} m at the end, NEES {end:.2f}, heading {heading:.2f}")
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
    on_earth, flat = rms(results, "earth"), rms(results, "flat")
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


# headings without a compass


FOG = replace(GRADES["fog"], gyr_noise=np.deg2rad(0.015 / 60.0), gyr_bias_sd=0.05 / 3600.0, gyr_walk=1e-10)
UNITS = {
    "FOG": FOG,  # 0.05 deg/h, 0.015 deg/rt h; accelerometers of a KVH 1750
    "FOG, quartz accelerometers": replace(FOG, acc_noise=5e-4, acc_walk=2e-6, acc_bias_sd=1e-3),
    "tactical": replace(GRADES["tactical"], gyr_noise=np.deg2rad(0.05 / 60.0), gyr_bias_sd=1.0 / 3600.0, gyr_walk=1e-9),
}
ON_EARTH = {"environment": {"frame": "earth"}}
MOMENTS = np.array([130.0, 180.0, 240.0, 300.0, 360.0, 420.0, 480.0, 540.0, 595.0])
SHOWN = (130.0, 300.0, 595.0)


@dataclass(frozen=True)
class Alignment:
    """A dive of ten minutes without a compass.

    Attributes
    ----------
    unit : of `UNITS`
    latitude : [deg]
    turns : of 180 deg, one in the middle and one after three quarters
    speed : along the heading from the first sample on [m/s]; else the vehicle is at a dock that moves
    bias : of the gyro's horizontal axes, beyond what is stated [deg/h]
    config : beside what a careful crew states
    """

    unit: str
    latitude: float = 60.0
    turns: int = 0
    speed: float = 0.0
    bias: float = 0.0
    config: dict[str, Any] | None = None


def moving(setting: Alignment, rng: np.random.Generator) -> Motion:
    """Surge, sway and heave of 0.2 to 0.3 m, roll, pitch and yaw of one to four degrees, at periods of 5 to 11 s."""

    def waves(*amplitudes_and_periods: tuple[float, float]) -> list[tuple[float, float, float]]:
        return [(a, period, rng.uniform(0.0, 2.0 * np.pi)) for a, period in amplitudes_and_periods]

    degree, start = np.deg2rad(1.0), rng.uniform(-np.pi, np.pi)
    yaw = waves((degree, 11.3), (0.5 * degree, 7.1))
    roll, pitch = waves((3.0 * degree, 6.7), (degree, 4.9)), waves((2.0 * degree, 7.3), (degree, 5.1))
    velocity = [waves((0.15, period), (0.1, other)) for period, other in ((9.7, 6.1), (8.3, 5.3), (7.7, 5.9))]
    half_turns = [(begin, 20.0, np.pi) for begin in (300.0, 450.0)[: setting.turns]]
    return Motion(
        600.0,
        Profile(start, half_turns, yaw),
        (Profile(setting.speed, (), velocity[0]), Profile(0.0, (), velocity[1]), Profile(0.0, (), velocity[2])),
        Profile(0.0, (), roll),
        Profile(0.0, (), pitch),
        origin=(np.deg2rad(setting.latitude), np.deg2rad(5.0)),
    )


def without_compass(setting: Alignment, seed: int) -> Dive:
    """A dive without heading sensor."""
    rng = np.random.default_rng([44, seed])
    bias = np.deg2rad(np.array([setting.bias, setting.bias, 0.0]) / 3600.0)
    unit = replace(UNITS[setting.unit], rate=50.0, gyr_bias=bias)
    vehicle = Vehicle(unit, ("depth",), Dvl(rate=2.0, yaw_sd=1.0), depth=Depth(rate=1.0))
    motion = moving(setting, rng)
    streams, hidden = sample(motion, vehicle, rng)
    config = configuration(vehicle)
    config["environment"] = {"latitude_deg": setting.latitude}
    config["calibration"]["gyr_scale"] = {"sd": 1e-4}
    return Dive(streams, merge(config, setting.config or {}), motion, hidden)


def headings(folder: Path, dive: Dive) -> dict[str, float]:
    """Error of the heading and its sd at each moment, of each estimate [deg]."""
    found: dict[str, float] = {}
    for kind, track in tracks(folder):
        for moment in MOMENTS:
            row = track.iloc[min(int(track["time"].searchsorted(moment)), len(track) - 1)]
            off = np.rad2deg(row["yaw"] - dive.motion.heading(np.array([row["time"]]))[0])
            found[f"{kind} {moment:g}"] = float((off + 180.0) % 360.0 - 180.0)
            found[f"{kind} {moment:g} sd"] = float(np.rad2deg(row["yaw_sd"]))
    return found


def aligned(setting: Alignment, seed: int, online: bool) -> Result:
    """One dive."""
    return run_dive(without_compass(setting, seed), online, headings)


def nees_at(results: Sequence[Result], kind: str, moment: float) -> float:
    """Mean squared error over the variance at a moment."""
    name = f"{kind} {moment:g}"
    return float(np.mean([(r.found[name] / r.found[f"{name} sd"]) ** 2 for r in results]))


def honest_headings(wanted: float, results: Sequence[Result]) -> tuple[str, bool]:
    """Errors and sds after two, five and ten minutes; whether NEES is in the band of 99 of 100 campaigns throughout.

    And whether the last heading is as good as is wanted [deg].
    """
    low, high = band(len(results))
    cells, met = [], not any(r.refused for r in results)
    for kind in KINDS:
        if f"{kind} 595" not in results[0].found:
            continue
        nees = [nees_at(results, kind, moment) for moment in MOMENTS]
        shown = (f"{rms(results, f'{kind} {t:g}'):.2f} ({rms(results, f'{kind} {t:g} sd'):.2f})" for t in SHOWN)
        cells.append(f"{kind} {', '.join(shown)} deg, NEES {min(nees):.2f} to {max(nees):.2f}")
        met &= max(nees) <= high and rms(results, f"{kind} 595") <= wanted
    return "; ".join(cells) + f"; {trusted(results)} (band {low:.2f} to {high:.2f})", met


ALIGNMENTS: dict[str, tuple[float, Alignment]] = {
    "dock, FOG": (0.5, Alignment("FOG")),
    "dock, FOG, quartz accelerometers": (0.5, Alignment("FOG, quartz accelerometers")),
    "dock, FOG, equator": (0.3, Alignment("FOG", 0.0)),
    "dock, FOG, latitude -75": (1.1, Alignment("FOG", -75.0)),
    "dock, FOG, half a turn": (0.5, Alignment("FOG", turns=1)),
    "under way at 1.5 m/s, FOG, two half turns": (0.5, Alignment("FOG", turns=2, speed=1.5, config=ON_EARTH)),
    "dock, tactical": (15.0, Alignment("tactical")),
    "dock, tactical, two half turns": (1.5, Alignment("tactical", turns=2)),
    "dock, FOG, bias of 10 sd": (0.5, Alignment("FOG", bias=0.5)),
    "dock, FOG, bias of 10 sd, two half turns": (0.5, Alignment("FOG", turns=2, bias=0.5)),
    "dock, FOG, latitude -60 stated": (0.5, Alignment("FOG", config={"environment": {"latitude_deg": -60.0}})),
}
DRAWN = ("dock, FOG", "dock, tactical, two half turns")
SEEDS_DRAWN = 6


def draw(path: Path) -> None:
    """Errors of the filtered heading of some dives against time, with the sd that the first one states."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.4), layout="constrained")
    for axes, name in zip(figure.subplots(1, len(DRAWN)), DRAWN, strict=True):
        for seed in range(SEEDS_DRAWN):
            dive = without_compass(ALIGNMENTS[name][1], seed)
            with tempfile.TemporaryDirectory() as folder:
                write_dive(dive, Path(folder))
                files = [str(Path(folder) / file) for file in ("log.csv", "vehicle.yaml", "out")]
                run_command(["smooth", files[0], "--config", files[1], "--out", files[2], "--no-figures"])
                track = pd.read_csv(Path(folder) / "out" / "trajectory_filtered.csv")
            off = np.rad2deg(track["yaw"].to_numpy() - dive.motion.heading(track["time"].to_numpy()))
            if seed == 0:
                sd = np.rad2deg(track["yaw_sd"])
                axes.fill_between(track["time"], -2.0 * sd, 2.0 * sd, color="#cccccc", lw=0.0, label="2 sd")
            axes.plot(track["time"], (off + 180.0) % 360.0 - 180.0, lw=0.9)
        axes.set_ylim(-5.0, 5.0) if "FOG" in name else axes.set_ylim(-25.0, 25.0)
        axes.set_title(name, fontsize=9)
        axes.set_xlabel("time [s]")
        axes.legend(fontsize=8, frameon=False, loc="upper right")
    figure.axes[0].set_ylabel("error of the filtered heading [°]")
    figure.savefig(path, dpi=110)


# depth by pressure


AIR_PA, AIR_DRIFT, SEA_KGM3 = 100_800.0, 0.05, 1025.0  # pressure of the air [Pa], its change [Pa/s], and the water
SINKS = 0.15  # [m/s]
NEAR_M = 1.0  # the surface
TIDE_S = 21_600.0  # between low waters, twice as fast as off most coasts
KNOWN = {"calibration": {"depth_offset": {"sd": 0.03}, "depth_scale": {"sd": 0.003}}}


@dataclass(frozen=True)
class Sea:
    """A dive by a pressure sensor, in a sea whose surface moves.

    Attributes
    ----------
    seconds : of the dive
    steps : when the vehicle goes down, and by how much [s, m]
    tide : how far the water rises from low to high [m]
    waves : sd of the pressure at the surface, as depth [m]
    draft, density : sds of the sensor's depth at the surface [m], and of the water's relative density
    config : beside what a careful crew states
    """

    seconds: float
    steps: Sequence[tuple[float, float]]
    tide: float = 0.0
    waves: float = 0.0
    draft: float = 0.03
    density: float = 0.003
    config: dict[str, Any] = field(default_factory=lambda: KNOWN)

    def risen(self, t: Array) -> Array:
        """How far the water has risen since the start, shape (n,) [m]."""
        return 0.5 * self.tide * (1.0 - np.cos(2.0 * np.pi * t / TIDE_S))

    def motion(self, rng: np.random.Generator) -> Motion:
        """Legs to and fro, at depths below the surface of the moment."""
        turns = [(begin, 20.0, np.pi * (-1) ** k) for k, begin in enumerate(np.arange(150.0, self.seconds, 150.0))]
        heave: list[tuple[float, float, float]] = []
        for begin, change in self.steps:
            speed = np.sign(change) * SINKS
            heave += [(begin, 10.0, speed), (begin + abs(change) / SINKS, 10.0, -speed)]
        rising = (-np.pi * self.tide / TIDE_S, TIDE_S, 0.0)
        tilt = [Profile(0.0, (), ((0.03, period, rng.uniform(0.0, 6.0)),)) for period in (9.0, 8.0)]
        speeds = Profile(0.4), Profile(), Profile(0.0, heave, (rising,))
        heading = Profile(rng.uniform(-np.pi, np.pi), turns)
        return Motion(self.seconds, heading, speeds, *tilt, rng.normal(0.0, self.draft), step=0.1)


def by_pressure(sea: Sea, seed: int) -> Dive:
    """A dive whose log has pressures in place of depths."""
    rng = np.random.default_rng([61, seed])
    motion = sea.motion(rng)
    vehicle = make_vehicle("mti", ("ahrs", "depth"))
    vehicle.imu, vehicle.ahrs = replace(vehicle.imu, rate=10.0), replace(vehicle.ahrs, rate=1.0)
    vehicle.dvl = replace(vehicle.dvl, rate=1.0)
    vehicle.depth = Depth(rate=2.0, arm=(-0.2, 0.0, 0.0), density=rng.normal(0.0, sea.density))
    streams, hidden = sample(motion, vehicle, rng)
    time, water = streams["depth"].to_numpy().T
    water = water + sea.risen(time) * (1.0 + vehicle.depth.density)
    for period in rng.uniform(3.0, 7.0, 6):
        reach = 9.81 * period**2 / (4.0 * np.pi**2)
        wave = np.sin(2.0 * np.pi * time / period + rng.uniform(0.0, 6.3)) * np.exp(-np.maximum(water, 0.0) / reach)
        water = water + sea.waves / np.sqrt(3.0) * wave
    air = rng.normal(AIR_PA, 300.0)
    gravity = float(earth.gravity(np.asarray(motion.origin[0]), np.asarray(0.0)))
    pressure = air + AIR_DRIFT * time + SEA_KGM3 * gravity * water
    streams["depth"] = pd.DataFrame({"time": time, "pressure": pressure})
    config = configuration(vehicle)
    config["environment"] = {"latitude_deg": float(np.rad2deg(motion.origin[0]))}
    return Dive(streams, merge(config, sea.config), motion, hidden)


def depths(sea: Sea, folder: Path, dive: Dive) -> dict[str, float]:
    """Errors of each estimate against the surface of the moment and the ground, rms [m], and the former's NEES."""
    found: dict[str, float] = {}
    for kind, track in tracks(folder):
        track = track[track["time"] > 10.0]
        t = track["time"].to_numpy()
        of_ground = track["down"].to_numpy() - dive.motion.local(t)[:, 2]
        off, near = of_ground - sea.risen(t), dive.motion.local(t)[:, 2] + sea.risen(t) < NEAR_M
        found |= {kind: float(np.sqrt(np.mean(off**2))), f"{kind} near": float(np.sqrt(np.mean(off[near] ** 2)))}
        found[f"{kind} ground"] = float(np.sqrt(np.mean(of_ground**2)))
        found[f"{kind} nees"] = float(np.mean((off / track["down_sd"].to_numpy()) ** 2))
        found[f"{kind} sd"] = float(np.sqrt(np.mean(track["down_sd"].to_numpy() ** 2)))
    return found


def dived(sea: Sea, seed: int, online: bool) -> Result:
    """One dive."""
    return run_dive(by_pressure(sea, seed), online, partial(depths, sea))


def honest_depths(part: str, results: Sequence[Result]) -> tuple[str, bool]:
    """Errors of the depth, and of a part of the dive; whether NEES is in the band of 99 of 100 campaigns."""
    low, high = band(len(results))
    cells, met = [], not any(r.refused for r in results)
    for kind in KINDS:
        if f"{kind} nees" not in results[0].found:
            continue
        nees = float(np.mean([r.found[f"{kind} nees"] for r in results]))
        there = f", {part} {rms(results, f'{kind} {part}'):.3f}" if part else ""
        cells.append(f"{kind} {rms(results, kind):.3f} ({rms(results, f'{kind} sd'):.3f}) m{there}, NEES {nees:.2f}")
        met &= low <= nees <= high
    return "; ".join(cells) + f"; {trusted(results)} (band {low:.2f} to {high:.2f})", met


LONG = ((120.0, 15.0), (2000.0, 3.0), (3500.0, -6.0), (5190.0, -12.0), (5460.0, 15.0), (8000.0, 3.0), (10_500.0, -18.0))
SHORT = ((240.0, 3.0), (600.0, 2.0), (1000.0, -5.0))
NO_WAVES = merge(KNOWN, {"depth": {"waves_m": 0.0}})
SEAS: dict[str, tuple[str, Sea]] = {
    "3 h, no tide": ("ground", Sea(10_800.0, LONG)),
    "3 h, tide of 1 m": ("ground", Sea(10_800.0, LONG, tide=1.0)),
    "3 h, tide of 10 m": ("ground", Sea(10_800.0, LONG, tide=10.0)),
    "3 h, tide of 1 m, default priors": (
        "ground",
        Sea(10_800.0, LONG, tide=1.0, draft=0.2, density=0.015, config={}),
    ),
    "20 min, waves of 0.1 m": ("near", Sea(1200.0, SHORT, waves=0.1)),
    "20 min, waves of 0.1 m, not in the noise": ("near", Sea(1200.0, SHORT, waves=0.1, config=NO_WAVES)),
    "20 min, waves of 0.3 m": ("near", Sea(1200.0, SHORT, waves=0.3)),
    "20 min, waves of 0.3 m, not in the noise": ("near", Sea(1200.0, SHORT, waves=0.3, config=NO_WAVES)),
}


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
    **{
        name: Row(
            f"{wanted:g} deg", partial(aligned, of), partial(honest_headings, wanted), dive=partial(without_compass, of)
        )
        for name, (wanted, of) in ALIGNMENTS.items()
    },
    **{
        name: Row("NEES in band", partial(dived, sea), partial(honest_depths, part), dive=partial(by_pressure, sea))
        for name, (part, sea) in SEAS.items()
    },
}


def main() -> None:
    """Run and print."""
    parser = row_options(__doc__, ROWS, cores())
    parser.add_argument("--figure", type=Path, help="draw headings against time, instead of the table")
    arguments = parser.parse_args()
    if arguments.figure:
        draw(arguments.figure)
        return
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
