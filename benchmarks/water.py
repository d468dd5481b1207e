"""Layers of the water against truth: descents to 500 m without bottom lock, by an independent simulator.

    python benchmarks/water.py                                     every row, 20 seeds, and what layers cost
    python benchmarks/water.py --rows "300 kHz" --seeds 3 --online
    python benchmarks/water.py --figure docs/images/water.png      a descent with layers, with one cell, and without

prints a table in Markdown: what each row is about, with its target, what was found, and the horizontal rms error and
NEES of the smoothed, filtered and online estimates. A dive lies at the surface with fixes, descends at 1 m/s and goes
on for 30 m with bottom lock. The error of a filter at the bottom is that before lock.

A dive over a cliff descends 60 m with bottom lock, loses it for 5 minutes at 0.3 m/s and finds it again. Its errors are
those of the way over the cliff.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from fault_campaign.campaign import merge
from fault_campaign.instruments import sample
from fault_campaign.judge import (
    Dive,
    Result,
    estimate_cells,
    honest_nees,
    horizontal_error,
    row_options,
    run_command,
    run_dive,
    tracks,
    write_dive,
)
from fault_campaign.motion import Motion, Profile, mounting
from fault_campaign.vehicle import Dvl, configuration, make_vehicle
from fault_campaign.water import Profiler, draw, profiles

from rovgraph.lab.executors import cores, starting, workers

LOCK_M = 30.0  # of bottom track at the end
TILT_SD = 0.2  # of the head's roll and pitch in the vehicle [deg]
SURFACE_M = 5.0  # up to which depth fixes come
CLIFF_S, ALONG_MPS, ALTITUDE_M = 300.0, 0.3, 30.0  # without lock, how fast along it, and above the bottom before


@dataclass
class Setting:
    """A descent, or a cliff.

    Attributes
    ----------
    profiler : None = no ADCP
    surface_s : with fixes before the descent [s]
    depth : that is reached [m]
    fast : sd of what changes in time in the current, at 200 s and 15 m [m/s]; 0 = nothing, and it is stated so
    stated : sd of a cell that is stated over the true one
    water : keys of the section `water` that are stated
    """

    profiler: Profiler | None = field(default_factory=Profiler)
    surface_s: float = 600.0
    depth: float = 500.0
    fix_sd: float = 1.0
    fast: float = 0.0
    stated: float = 1.0
    cliff: bool = False
    water: dict[str, float] = field(default_factory=dict)

    @property
    def lost(self) -> tuple[float, float]:
        """When bottom lock is lost and found over a cliff [s]."""
        begin = self.surface_s + self.depth + 60.0
        return begin, begin + CLIFF_S


def make_dive(setting: Setting, seed: int) -> tuple[Dive, pd.DataFrame | None]:
    """A dive and its profiles. A seed gives every setting the same current."""
    rng = np.random.default_rng([29, seed])
    start, descent = setting.surface_s, setting.depth - 2.0
    lost, again = setting.lost
    seconds = again + 60.0 if setting.cliff else start + descent + 20.0
    current = draw(rng, setting.depth + 150.0, seconds, setting.fast)
    heading = Profile(rng.uniform(-np.pi, np.pi), ((60.0, 20.0, np.pi), (180.0, 20.0, -np.pi)), ((0.05, 45.0, 0.0),))
    drift, small = Profile(0.0, (), ((0.1, 50.0, 1.0),)), Profile(0.0, (), ((0.02, 7.0, 2.0),))
    down = Profile(0.0, ((start, 6.0, 1.0), (start + descent + 3.0, 6.0, -1.0)))
    tilt = Profile(0.0, (), ((0.03, 9.0, 1.0),))
    if setting.cliff:
        drift = replace(drift, ramps=((lost - 20.0, 6.0, ALONG_MPS),))
    motion = Motion(seconds, heading, (drift, small, down), tilt, Profile(0.0, (), ((0.02, 8.0, 0.0),)), 2.0)
    vehicle = make_vehicle("mti", ("ahrs", "depth", "fix"))
    tilted = tuple(rng.normal(0.0, TILT_SD, 2).tolist())
    vehicle.dvl = Dvl(rate=2.0, mount_rpy_deg=(*tilted, 0.0), yaw_sd=0.3, scale_sd=0.003)
    vehicle.ahrs = replace(vehicle.ahrs, offset_sd=0.5, curve_sd=0.3)
    vehicle.fix = replace(vehicle.fix, rate=1.0, sd=setting.fix_sd)
    stated = {"dvl_scale": {"estimate": True, "sd": 0.003}}
    stated |= {f"dvl_{angle}": {"sd_deg": TILT_SD} for angle in ("roll", "pitch")}
    config = merge(configuration(vehicle), {"calibration": stated, "dvl": {"mount_rpy_deg": [0.0, 0.0, 0.0]}})
    config["start"] |= {"north_m": 0.0, "east_m": 0.0, "position_sd_m": 1.0}
    streams, hidden = sample(motion, vehicle, rng)
    pings = streams["dvl"]["time"].to_numpy()
    bottom = motion.local(pings)[:, 2] > setting.depth - LOCK_M
    if setting.cliff:
        bottom = (pings > start) & ((pings < lost) | (pings > again))
    streams["dvl"].loc[~bottom, [f"dvl_v{axis}" for axis in "xyz"]] = np.nan
    streams["dvl"]["dvl_valid"] = bottom.astype(float)
    up = motion.local(streams["fix"]["time"].to_numpy())[:, 2] < SURFACE_M
    streams["fix"] = streams["fix"][up]
    if setting.profiler is None:
        return Dive(streams, config, motion, hidden), None
    unit = setting.profiler
    config["water"] = {"cell_sd_mps": [setting.stated * sd for sd in unit.sd]}
    if not setting.fast:
        config["water"]["walk_mps"] = 5e-4
    config["water"] |= setting.water
    C_bs = mounting((*vehicle.dvl.mount_rpy_deg[:2], hidden.dvl_yaw))
    table = profiles(motion, vehicle, unit, current, C_bs, rng)
    for axis in "xyz":
        table[f"v{axis}"] *= 1.0 + hidden.dvl_scale
    if setting.cliff:
        near = (table["time"] > lost) & (table["time"] < again)
        table = table[near | (table["range"] < ALTITUDE_M * np.cos(np.deg2rad(30.0)))]
    return Dive(streams, config, motion, hidden), table


@dataclass
class Row:
    """A row of the table: settings, the first of which is printed, and limits of the end error, or None."""

    setting: Setting
    live: float | None = None
    smoothed: float | None = None


WORKHORSE_600 = Profiler(20, 2.0, 2.0, (0.02, 0.02, 0.01))
ROWS = {
    "300 kHz": Row(Setting(), 12.0, 5.5),
    "600 kHz": Row(Setting(WORKHORSE_600), 10.0, 4.5),
    "300 kHz, surface for 1 min": Row(Setting(surface_s=60.0)),
    "one cell": Row(Setting(Profiler(1, 4.0, 4.0))),
    "restless": Row(Setting(fast=0.04)),
    "sd of cells stated a fifth": Row(Setting(stated=0.2)),
    "one knot": Row(Setting(water={"knots": 1})),
    "restless, and it is not stated": Row(Setting(fast=0.04, water={"walk_mps": 5e-4})),
    "knots 50 m apart": Row(Setting(water={"knot_m": 50.0})),
    "no layers": Row(Setting(None)),
    "cliff": Row(Setting(surface_s=120.0, depth=60.0, cliff=True), None, 2.0),
    "cliff, 600 kHz": Row(Setting(WORKHORSE_600, surface_s=120.0, depth=60.0, cliff=True), None, 2.0),
    "cliff, restless": Row(Setting(surface_s=120.0, depth=60.0, cliff=True, fast=0.04), None, 2.0),
    "cliff, no layers": Row(Setting(None, surface_s=120.0, depth=60.0, cliff=True)),
}


def inspect(setting: Setting, folder: Path, dive: Dive) -> dict[str, float]:
    """Errors of each estimate at the bottom: of the filters just before lock, of the smoother at the end.

    Over a cliff: what the way over it is off.
    """
    found: dict[str, float] = {}
    depth = dive.motion.local(np.arange(dive.motion.duration))[:, 2]
    lock = setting.lost[1] if setting.cliff else float(np.argmax(depth > depth.max() - LOCK_M))
    for kind, track in tracks(folder):

        def off(time: float, track: pd.DataFrame = track) -> tuple[np.ndarray, np.ndarray]:
            return horizontal_error(dive, track.iloc[np.abs(track["time"] - time).argmin()])

        wrong, cov = off(dive.motion.duration if kind == "smoothed" and not setting.cliff else lock - 1.0)
        if setting.cliff:
            found[f"{kind} way"] = float(np.hypot(*(wrong - off(setting.lost[0])[0])))
        found[f"{kind} end"] = float(np.hypot(*wrong))
        found[f"{kind} sd"] = float(np.sqrt(np.trace(cov)))
        found[f"{kind} nees"] = float(wrong @ np.linalg.solve(cov, wrong)) / 2.0
    return found


def run_row(name: str, seed: int, online: bool) -> Result:
    """One dive."""
    dive, table = make_dive(ROWS[name].setting, seed)
    return run_dive(dive, online, partial(inspect, ROWS[name].setting), {} if table is None else {"adcp": table})


def rms_of(done: Sequence[dict[str, float]], name: str) -> float:
    """Root of the mean square of a figure of some dives."""
    return float(np.sqrt(np.mean([found[name] ** 2 for found in done])))


def figures(name: str, results: Sequence[Result]) -> str:
    """A row of the table."""
    row, cells, met = ROWS[name], [], True
    for kind, limit in (("filtered", row.live), ("smoothed", row.smoothed), ("online", row.live)):
        done = [r.found for r in results if f"{kind} end" in r.found]
        if not done:
            cells.append("–")
            continue
        rms, sd = (rms_of(done, f"{kind} {what}") for what in ("end", "sd"))
        nees = float(np.mean([f[f"{kind} nees"] for f in done]))
        way = f", of the way {rms_of(done, f'{kind} way'):.1f} m" if f"{kind} way" in done[0] else ""
        met &= nees <= honest_nees(len(done)) and (limit is None or rms <= limit)
        cells.append(f"{rms:.1f} m (sd {sd:.1f}; NEES {nees:.2f}){way}" + (f", at most {limit:g}" if limit else ""))
    return "| " + " | ".join([name, *cells, "yes" if met else "**no**", *estimate_cells(results)]) + " |"


def cost(rounds: int) -> tuple[float, float]:
    """Processor time of a descent with and without layers, the least of some rounds [s]."""
    import tempfile

    import rovgraph

    least = [np.inf, np.inf]
    with tempfile.TemporaryDirectory() as name:
        dive, table = make_dive(ROWS["300 kHz"].setting, 0)
        write_dive(dive, Path(name), {"adcp": table})
        config = rovgraph.load_config(Path(name) / "vehicle.yaml")
        log = rovgraph.read_log(Path(name) / "log.csv", config)
    for _ in range(rounds):
        for k, use in enumerate((True, False)):
            begin = time.process_time()
            rovgraph.smooth(log, config.model_copy(update={"water": config.water.model_copy(update={"use": use})}))
            least[k] = min(least[k], time.process_time() - begin)
    return least[0], least[1]


def draw_descent(path: Path) -> None:
    """Errors and sds of the filter on the way down, and the current that layers show, in the first dive of a row."""
    import tempfile

    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    error, current = figure.subplots(1, 2, width_ratios=(3, 2), sharey=True)
    for name, colour in (("no layers", "0.3"), ("one cell", "tab:red"), ("300 kHz", "tab:blue")):
        dive, table = make_dive(ROWS[name].setting, 0)
        with tempfile.TemporaryDirectory() as folder:
            write_dive(dive, Path(folder), {} if table is None else {"adcp": table})
            files = [f"{folder}/{part}" for part in ("log.csv", "vehicle.yaml", "out")]
            run_command(["smooth", files[0], "--config", files[1], "--out", files[2], "--no-figures"])
            track = pd.read_csv(f"{files[2]}/trajectory_filtered.csv")
            found = None if table is None else pd.read_csv(f"{files[2]}/current.csv")
        track = track[(track["time"] > ROWS[name].setting.surface_s) & (track["down"] < 500.0 - LOCK_M)]
        off = track[["north", "east"]].to_numpy() - dive.motion.local(track["time"].to_numpy())[:, :2]
        label = {"300 kHz": "25 cells of 4 m", "one cell": "one cell", "no layers": "IMU alone"}[name]
        error.plot(np.hypot(*off.T), track["down"], color=colour, label=label)
        error.plot(np.hypot(track["north_sd"], track["east_sd"]), track["down"], color=colour, linestyle=":")
    error.set(xscale="log", xlabel="horizontal error, dotted: sd [m]", ylabel="depth [m]", xlim=(0.3, None))
    error.legend(frameon=False, fontsize=8)
    depth = np.arange(500.0)
    true = draw(np.random.default_rng([29, 0]), 650.0).at(depth, depth)  # the one of the first dive
    assert found is not None
    last = found.groupby("depth").last()
    last = last[last.index < depth[-1]]
    for axis, colour in (("north", "tab:green"), ("east", "tab:purple")):
        current.plot(true[:, int(axis == "east")], depth, color=colour, label=f"{axis}: true, estimated")
        bars = {"xerr": 2.0 * last[f"{axis}_sd"], "fmt": ".", "markersize": 3, "linewidth": 0.8}
        current.errorbar(last[axis], last.index, color=colour, **bars)
    current.set(xlabel="current [m/s], bars: 2 sd")
    current.legend(frameon=False, fontsize=8)
    error.invert_yaxis()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Run and print."""
    parser = row_options(__doc__, [*ROWS, "cost"], cores())
    parser.add_argument("--figure", type=Path, help="draw a descent instead of the table")
    arguments = parser.parse_args()
    if arguments.figure:
        draw_descent(arguments.figure)
        return
    rows = [name for name in arguments.rows if name != "cost"]
    if "cost" in arguments.rows:
        layers, without = cost(3)
        print(f"A descent takes {layers:.1f} s with layers, {without:.1f} s without: {layers / without:.2f} times.\n")
    heads = [f"{kind} {what}" for kind in ("smoothed", "filtered", "online") for what in ("rms (sd) [m]", "NEES")]
    ends = ["filtered at the bottom", "smoothed at the end", "online at the bottom"]
    heads = ["descent", *ends, "met", *heads, "verdicts"]
    if not rows:
        return
    print("| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|", flush=True)
    with workers(arguments.jobs) as pool:
        for name in rows:
            with starting():
                futures = [pool.submit(run_row, name, seed, arguments.online) for seed in range(arguments.seeds)]
            results = [future.result() for future in futures]
            print(figures(name, results), flush=True)
            if arguments.said:
                print("\n".join(results[0].said), flush=True)
            if arguments.keep:
                folder = arguments.keep / name.replace(" ", "_").replace(",", "")
                folder.mkdir(parents=True, exist_ok=True)
                dive, table = make_dive(ROWS[name].setting, 0)
                write_dive(dive, folder, {} if table is None else {"adcp": table})


if __name__ == "__main__":
    main()
