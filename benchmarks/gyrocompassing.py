"""Headings without a compass against truth, by an independent simulator: at a moving dock and under way.

    python benchmarks/gyrocompassing.py                                   every row, 20 seeds
    python benchmarks/gyrocompassing.py --rows "dock, FOG" --seeds 3 --online
    python benchmarks/gyrocompassing.py --figure docs/images/gyrocompassing.png

prints a table in Markdown: heading errors and the sds that are stated, and the least and the largest NEES of the
moments from the end of the coarse alignment on. Dives go through the command line. A seed gives all rows the same
draws.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from fault_campaign.campaign import merge
from fault_campaign.instruments import sample
from fault_campaign.judge import Dive, Result, row_options, run_command, run_dive, tracks, write_dive
from fault_campaign.motion import Motion, Profile
from fault_campaign.vehicle import GRADES, Depth, Dvl, Vehicle, configuration
from scipy.stats import chi2

from rovgraph.lab.executors import cores, starting, workers

FOG = replace(GRADES["fog"], gyr_noise=np.deg2rad(0.015 / 60.0), gyr_bias_sd=0.05 / 3600.0, gyr_walk=1e-10)
UNITS = {
    "FOG": FOG,  # 0.05 deg/h, 0.015 deg/rt h; accelerometers of a KVH 1750
    "FOG, quartz accelerometers": replace(FOG, acc_noise=5e-4, acc_walk=2e-6, acc_bias_sd=1e-3),
    "tactical": replace(GRADES["tactical"], gyr_noise=np.deg2rad(0.05 / 60.0), gyr_bias_sd=1.0 / 3600.0, gyr_walk=1e-9),
}
MOMENTS = np.array([130.0, 180.0, 240.0, 300.0, 360.0, 420.0, 480.0, 540.0, 595.0])
SHOWN = (130.0, 300.0, 595.0)


@dataclass(frozen=True)
class Setting:
    """A dive of ten minutes.

    Attributes
    ----------
    unit : of `UNITS`
    latitude : [deg]
    turns : of 180 deg, one in the middle and one after three quarters
    speed : along the heading from the first sample on [m/s]; else the vehicle is at a dock that moves
    config : beside what a careful crew states
    """

    unit: str
    latitude: float = 60.0
    turns: int = 0
    speed: float = 0.0
    config: dict[str, Any] | None = None


def motion_of(setting: Setting, rng: np.random.Generator) -> Motion:
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


def make_dive(setting: Setting, seed: int) -> Dive:
    """A dive without heading sensor."""
    rng = np.random.default_rng([44, seed])
    unit = replace(UNITS[setting.unit], rate=50.0)
    vehicle = Vehicle(unit, ("depth",), Dvl(rate=2.0, yaw_sd=1.0), depth=Depth(rate=1.0))
    motion = motion_of(setting, rng)
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


def run(setting: Setting, seed: int, online: bool) -> Result:
    """One dive."""
    return run_dive(make_dive(setting, seed), online, headings)


def nees_at(results: Sequence[Result], kind: str, moment: float) -> float:
    """Mean squared error over the variance at a moment."""
    name = f"{kind} {moment:g}"
    return float(np.mean([(r.found[name] / r.found[f"{name} sd"]) ** 2 for r in results]))


def rms(results: Sequence[Result], name: str) -> float:
    """Root of the mean square of something found."""
    return float(np.sqrt(np.mean([r.found[name] ** 2 for r in results])))


def honest(wanted: float, results: Sequence[Result]) -> tuple[str, bool]:
    """Errors and sds after two, five and ten minutes; whether NEES is in the band of 99 of 100 campaigns throughout.

    And whether the last heading is as good as is wanted [deg].
    """
    low, high = chi2.ppf([0.005, 0.995], len(results)) / len(results)
    cells, met = [], not any(r.refused for r in results)
    for kind in ("smoothed", "filtered", "online"):
        if f"{kind} 595" not in results[0].found:
            continue
        nees = [nees_at(results, kind, moment) for moment in MOMENTS]
        shown = (f"{rms(results, f'{kind} {t:g}'):.2f} ({rms(results, f'{kind} {t:g} sd'):.2f})" for t in SHOWN)
        cells.append(f"{kind} {', '.join(shown)} deg, NEES {min(nees):.2f} to {max(nees):.2f}")
        met &= max(nees) <= high and rms(results, f"{kind} 595") <= wanted
    return "; ".join(cells) + f" (band {low:.2f} to {high:.2f})", met


ON_EARTH = {"environment": {"frame": "earth"}}
ROWS: dict[str, tuple[float, Setting]] = {
    "dock, FOG": (0.5, Setting("FOG")),
    "dock, FOG, quartz accelerometers": (0.5, Setting("FOG, quartz accelerometers")),
    "dock, FOG, equator": (0.3, Setting("FOG", 0.0)),
    "dock, FOG, latitude -75": (1.1, Setting("FOG", -75.0)),
    "dock, FOG, half a turn": (0.5, Setting("FOG", turns=1)),
    "under way at 1.5 m/s, FOG, two half turns": (0.5, Setting("FOG", turns=2, speed=1.5, config=ON_EARTH)),
    "dock, tactical": (15.0, Setting("tactical")),
    "dock, tactical, two half turns": (1.5, Setting("tactical", turns=2)),
}


DRAWN = ("dock, FOG", "dock, tactical, two half turns")
SEEDS_DRAWN = 6


def draw(path: Path) -> None:
    """Errors of the filtered heading of some dives against time, with the sd that the first one states."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.4), layout="constrained")
    for axes, name in zip(figure.subplots(1, len(DRAWN)), DRAWN, strict=True):
        for seed in range(SEEDS_DRAWN):
            dive = make_dive(ROWS[name][1], seed)
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


def main() -> None:
    """Run and print."""
    parser = row_options(__doc__, ROWS, cores())
    parser.add_argument("--figure", type=Path, help="draw headings against time, instead of the table")
    arguments = parser.parse_args()
    if arguments.figure:
        draw(arguments.figure)
        return
    print("| dive | target | rms (sd) after 2, 5 and 10 minutes | met |\n|---|---|---|---|", flush=True)
    with workers(arguments.jobs) as pool:
        for name in arguments.rows:
            wanted, setting = ROWS[name]
            with starting():
                futures = [pool.submit(run, setting, seed, arguments.online) for seed in range(arguments.seeds)]
            results = [future.result() for future in futures]
            found, met = honest(wanted, results)
            print(f"| {name} | {wanted:g} deg | {found} | {'yes' if met else '**no**'} |", flush=True)
            if arguments.said:
                print("\n".join(results[0].said), flush=True)


if __name__ == "__main__":
    main()
