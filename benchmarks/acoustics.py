"""Acoustic positioning against truth: a ship, its head, receivers and beacons, by an independent simulator.

    python benchmarks/acoustics.py                         every row, 20 seeds
    python benchmarks/acoustics.py --rows "one beacon" --seeds 3 --online

prints a table in Markdown: horizontal rms error and stated sd, and NEES of position, depth and heading, of the
smoothed, filtered and online estimates, and how far constants are found from what they are. Dives go through the
command line. Each dive draws its constants from the priors that its configuration states (`PRIORS`), but for what a
row's name says.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from fault_campaign.acoustic import Acoustic, Ship, System, heard_by_receivers, ranges, usbl
from fault_campaign.campaign import merge
from fault_campaign.instruments import Streams, sample
from fault_campaign.judge import Dive, Result, estimate_cells, row_options, run_dive
from fault_campaign.motion import Motion, Profile
from fault_campaign.scenarios import make_motion
from fault_campaign.vehicle import Vehicle, configuration, make_vehicle

from rovgraph.lab.executors import cores, starting, workers

AIDS = ("ahrs", "depth")
CREW = {  # what a crew that has calibrated its system states
    "usbl_roll": {"estimate": True, "sd_deg": 0.3},
    "usbl_pitch": {"estimate": True, "sd_deg": 0.3},
    "usbl_yaw": {"estimate": True, "sd_deg": 0.5},
}
RAW = {"usbl_roll": {"sd_deg": 1.0}, "usbl_pitch": {"sd_deg": 1.0}, "usbl_yaw": {"sd_deg": 3.0}}
PRIORS: dict[str, dict[str, float]] = {  # of a calibrated DVL, gyro and system; each dive draws from them
    "dvl_roll": {"sd_deg": 0.3},
    "dvl_pitch": {"sd_deg": 0.3},
    "dvl_scale": {"sd": 0.005},
    "dvl_lever_arm": {"sd": 0.02},
    "gyr_scale": {"sd": 0.002},
    "depth_offset": {"sd": 0.05},
    "depth_scale": {"sd": 0.003},
    "usbl_arm": {"sd": 0.1},
    "usbl_range_offset": {"sd": 0.1},
    "range_offset": {"sd": 0.1},
    "sound_speed_scale": {"sd": 0.01},
}
GYRO_DEG = 0.3  # error of a ship's gyro, that lasts
SUMMER = ((0.0, 1521.0), (12.0, 1520.0), (35.0, 1492.0), (80.0, 1485.0), (300.0, 1488.0))  # over a shelf


def draw(vehicle: Vehicle, system: System, rng: np.random.Generator) -> tuple[Vehicle, System]:
    """What vehicle and system are, of those that a configuration states."""

    def off(name: str, *size: int) -> Any:
        return rng.normal(0.0, next(iter(PRIORS[name].values())), size or None)

    dvl, turn = vehicle.dvl, np.array([off("dvl_roll"), off("dvl_pitch"), 0.0])
    arm = np.array(dvl.arm) + off("dvl_lever_arm", 3)
    dvl = replace(dvl, mount_rpy_deg=(np.array(dvl.mount_rpy_deg) + turn).tolist(), arm=arm, scale=off("dvl_scale"))
    imu = replace(vehicle.imu, gyr_matrix=np.diag(1.0 + off("gyr_scale", 3)))
    depth = replace(vehicle.depth, offset=off("depth_offset"), density=off("depth_scale"))
    factor = 1.0 + off("sound_speed_scale")
    layers = [(z, c * factor) for z, c in system.layers]
    water = replace(system, sound_speed=system.sound_speed * factor, layers=layers, range_offset=off("range_offset"))
    return replace(vehicle, dvl=dvl, imu=imu, depth=depth), water


@dataclass
class Setting:
    """A dive with a USBL.

    Attributes
    ----------
    seconds, depth : [s], [m]
    round_ship : the vehicle goes once round the ship; else legs below it
    dvl : there is one
    yaw, latency : of the head [deg], of its stamps [s], that the configuration does not state
    outliers : share of replies that are off by 50 m
    crew : the configuration states what a careful crew knows
    speed : of sound [m/s]; 0 = drawn around the 1500 m/s that are believed
    profile, stated : depth and speed of layered water, and whether the configuration has it
    changed : on the replies
    config : beside all that
    drawn : constants are drawn from `PRIORS`; else what the configuration states is right, but for the head's mounting
    """

    seconds: float = 600.0
    depth: float = 100.0
    round_ship: bool = False
    dvl: bool = True
    yaw: float = 0.0
    latency: float = 0.0
    outliers: float = 0.0
    crew: bool = True
    speed: float = 0.0
    profile: Sequence[tuple[float, float]] = ()
    stated: bool = False
    changed: Callable[[pd.DataFrame, np.random.Generator], pd.DataFrame] | None = None
    config: dict[str, Any] = field(default_factory=dict)
    drawn: bool = False


def below_ship(setting: Setting, seed: int) -> Dive:
    """A vehicle below a ship that moves and turns, with a head of 0.2 m and 0.5 deg at 1 Hz."""
    rng = np.random.default_rng([7, seed])
    motion = replace(make_motion("survey of 20 minutes", rng), duration=setting.seconds, depth=setting.depth)
    if setting.round_ship:
        heading = replace(motion.heading, ramps=((20.0, setting.seconds - 40.0, 2 * np.pi),))
        velocity = Profile(0.0, ((8.0, 4.0, 0.5),), motion.velocity_b[0].waves), *motion.velocity_b[1:]
        motion = replace(motion, heading=heading, velocity_b=velocity)
    middle = motion.local(np.arange(0.0, setting.seconds, 1.0)).mean(axis=0)
    spin = rng.uniform(-np.pi, np.pi)
    lever = np.append(rng.normal(0.0, 0.3, 2) if setting.crew else [0.0, 0.0], setting.yaw)
    constants, priors = np.random.default_rng([8, seed]), CREW if setting.crew else RAW
    if setting.drawn:  # the yaw that counts is the head's and the gyro's
        roll, pitch, yaw = (sd["sd_deg"] * constants.normal() for sd in priors.values())
        share = np.sqrt(1.0 - (GYRO_DEG / priors["usbl_yaw"]["sd_deg"]) ** 2)
        lever = np.array([roll, pitch, setting.yaw or share * yaw])
    ship = Ship(
        north=Profile(middle[0], (), ((8.0, 310.0, spin),)),
        east=Profile(middle[1], (), ((6.0, 270.0, spin + 1.0),)),
        heading=Profile(spin, ((150.0, 60.0, 0.6), (350.0, 60.0, -0.9))),
        mount_rpy_deg=lever.tolist(),
        heading_error=rng.normal(0.0, GYRO_DEG),
    )
    system = System(latency=setting.latency, layers=setting.profile)
    vehicle = make_vehicle("mti", AIDS)
    config = merge(configuration(vehicle), Acoustic(ship, system).usbl())
    config["start"] = {}
    if setting.crew:
        config = merge(config, {"calibration": CREW})
    if setting.stated:
        config["sound"] = {"profile": [list(row) for row in setting.profile]}
    if setting.drawn:
        config = merge(config, {"calibration": priors | PRIORS})
        vehicle, system = draw(vehicle, system, constants)
        arm = PRIORS["usbl_arm"]["sd"] * constants.normal(size=3)
        ship = replace(ship, head=(np.array(ship.head) + arm).tolist())
    layers = system.layers if setting.stated else setting.profile
    system = replace(system, layers=layers, sound_speed=setting.speed or system.sound_speed)
    streams, hidden = sample(motion, vehicle, rng)
    if not setting.dvl:
        del streams["dvl"]
    replies = usbl(motion, ship, system, rng)
    if setting.outliers:
        spoil(replies, setting.outliers, rng)
    if setting.changed is not None:
        replies = setting.changed(replies, rng)
    streams |= {"usbl": replies} | ship.says(setting.seconds, rng)
    others = {
        "usbl_yaw": lever[2] - ship.heading_error,
        "usbl_time_offset": setting.latency or np.nan,
        "sound_speed_scale": np.nan if setting.profile else system.believed_speed / system.sound_speed - 1.0,
    }
    return Dive(streams, merge(config, setting.config), motion, replace(hidden, others=others))


def spoil(replies: pd.DataFrame, share: float, rng: np.random.Generator) -> None:
    """Put some replies 50 m off, in place."""
    bad = rng.uniform(size=len(replies)) < share
    replies.loc[bad, "usbl_range"] += rng.choice([-50.0, 50.0], bad.sum())
    replies.loc[bad, "usbl_bearing"] += rng.normal(0.0, 0.5, bad.sum())


def cluster(replies: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """460 s of silence, 20 s of replies that agree with each other 700 m away, and right ones again."""
    replies = replies[(replies["time"] < 60.0) | (replies["time"] > 520.0)].copy()
    wrong = replies["time"].between(520.0, 540.0)
    far = np.hypot(700.0, 100.0)
    replies.loc[wrong, "usbl_range"] = far + rng.normal(0.0, 0.2, wrong.sum())
    replies.loc[wrong, "usbl_bearing"] = 1.0 + rng.normal(0.0, 0.005, wrong.sum())
    replies.loc[wrong, "usbl_elevation"] = np.arcsin(97.0 / far)
    return replies


def square(seed: int, side: float = 200.0, straight: bool = False, seconds: float = 1200.0) -> tuple[Motion, Any]:
    """A square at 1 m/s in 60 m of water, or one leg."""
    rng = np.random.default_rng([9, seed])
    motion = make_motion("survey of 20 minutes", rng)
    every = side + 10.0
    turns = [] if straight else [(0.6 * side + k * every, 10.0, np.pi / 2) for k in range(int(seconds / every))]
    velocity = Profile(0.0, ((8.0, 4.0, 1.0),), motion.velocity_b[0].waves), *motion.velocity_b[1:]
    heading = replace(motion.heading, ramps=tuple(turns))
    return replace(motion, duration=seconds, depth=60.0, heading=heading, velocity_b=velocity), rng


def one_beacon(seed: int, straight: bool = False, seconds: float = 1200.0) -> Dive:
    """A beacon on the bottom whose place nobody knows, ranges at 0.2 Hz."""
    return among_beacons(seed, 1, None, 0.2, 0.0, straight, seconds)


def among_beacons(
    seed: int,
    count: int,
    surveyed: float | None,
    rate: float,
    lost: float,
    straight: bool = False,
    seconds: float = 1200.0,
) -> Dive:
    """Beacons on the bottom, surveyed to some sd, and for some time no DVL."""
    motion, rng = square(seed, straight=straight, seconds=seconds)
    vehicle, system = make_vehicle("mti", AIDS), System(rate=rate)
    middle = motion.local(np.arange(0.0, seconds, 1.0)).mean(axis=0)
    places = {str(k + 1): tuple(middle + np.append(rng.uniform(-150.0, 150.0, 2), 20.0)) for k in range(count)}
    known = {
        name: None if surveyed is None else tuple(np.array(place) + rng.normal(0.0, surveyed, 3))
        for name, place in places.items()
    }
    config = merge(configuration(vehicle), Acoustic(Ship(), system).ranges(known, surveyed or 1.0))
    config = merge(config, {"calibration": PRIORS})
    vehicle, system = draw(vehicle, system, rng)
    streams, hidden = sample(motion, vehicle, rng)
    streams["range"] = ranges(motion, places, system, rng)
    if surveyed is None:
        others = {f"beacon_1_{axis}": float(at) for axis, at in zip(("north", "east"), places["1"], strict=False)}
        hidden = replace(hidden, others=others)
    if lost:
        pings = streams["dvl"]
        streams["dvl"] = pings[(pings["time"] < 300.0) | (pings["time"] > 300.0 + lost)]
    return Dive(streams, config, motion, hidden)


def boat_beside(motion: Motion) -> Ship:
    """A boat with a topside 15 m from the middle of a dive, that swings a little."""
    middle = motion.local(np.arange(0.0, motion.duration, 1.0)).mean(axis=0)
    return Ship(
        north=Profile(middle[0] + 12.0, (), ((1.0, 90.0, 0.0),)),
        east=Profile(middle[1] - 9.0, (), ((1.0, 70.0, 1.0),)),
        heading=Profile(0.7, (), ((0.1, 40.0, 0.2),)),
        antenna=(0.0, 0.0, -1.0),
        head=(0.0, 0.0, 1.0),
        position_sd=0.3,
    )


def ugps(seed: int, drift: float = 1.0) -> Dive:
    """A vehicle below a boat's topside: x and y by sound, z by the locator's pressure sensor, a yaw that drifts."""
    rng = np.random.default_rng([11, seed])
    motion = replace(make_motion("survey of 20 minutes", rng), duration=600.0, depth=8.0)
    boat = boat_beside(motion)
    system = System(rate=2.4, range_sd=0.06, angle_sd=0.4, turn_around=0.0, arm=(0.0, 0.0, -0.2))
    vehicle = make_vehicle("mti", AIDS)
    config = merge(configuration(vehicle), Acoustic(boat, system).usbl())
    config = merge(
        config, {"start": None, "usbl": {"frame": "ship", "depth": "given", "one_way": True, "planar": False}}
    )
    config = merge(config, {"calibration": PRIORS | {"usbl_yaw": {"estimate": True, "sd_deg": 1.0}}})
    vehicle, system = draw(vehicle, system, rng)
    arm = PRIORS["usbl_arm"]["sd"] * rng.normal(size=3)
    boat = replace(boat, head=(np.array(boat.head) + arm).tolist(), heading_error=rng.normal())
    one = usbl(motion, boat, system, rng)
    level = one["usbl_range"] * np.cos(one["usbl_elevation"])
    z = motion.local(one["time"].to_numpy())[:, 2] - 1.0 + rng.normal(0.0, 0.02, len(one))
    x, y = level * np.cos(one["usbl_bearing"]), level * np.sin(one["usbl_bearing"])
    replies = pd.DataFrame({"time": one["time"], "usbl_x": x, "usbl_y": y, "usbl_z": z})
    replies = replies[rng.uniform(size=len(replies)) > 0.3]
    says = boat.says(600.0, rng)
    says["ship_heading"]["ship_heading"] += np.deg2rad(drift) * says["ship_heading"]["time"] / 60.0
    streams: Streams
    streams, hidden = sample(motion, vehicle, rng)
    del says["ship_heading"]["ship_roll"], says["ship_heading"]["ship_pitch"]
    return Dive(streams | {"usbl": replies} | says, config, motion, hidden)


CLOCK_M, CLOCK_MPS = 0.5, 0.02  # of a locator that is not synchronised any more


def four_receivers(seed: int) -> Dive:
    """Four receivers about a boat, 1 m apart, one clock for all; a third of their ranges are missing."""
    rng = np.random.default_rng([13, seed])
    motion = replace(make_motion("survey of 20 minutes", rng), duration=600.0, depth=8.0)
    boat = boat_beside(motion)
    places = {str(k): (0.5 * (-1) ** (k // 2), 0.5 * (-1) ** ((k + 1) // 2), 1.0 + 0.2 * (k % 2)) for k in range(4)}
    system = System(rate=2.4, range_sd=0.03, arm=(0.0, 0.0, -0.2), turn_around=0.0)
    vehicle = make_vehicle("mti", AIDS)
    config = merge(configuration(vehicle), Acoustic(boat, system).ranges({}, 1.0))
    vehicle, system = draw(vehicle, system, rng)
    heard = heard_by_receivers(motion, boat, places, system, 0.2, rng)
    heard["range"] += rng.normal(0.0, CLOCK_M) + rng.normal(0.0, CLOCK_MPS) * heard["time"]
    heard = heard[rng.uniform(size=len(heard)) > 0.3]
    stated = {"one_way": True, "common_sd_m": 0.2}
    ship = {
        "antenna_m": list(boat.antenna),
        "sd_m": boat.position_sd,
        "receivers": {k: list(p) for k, p in places.items()},
    }
    clock = {"range_clock": {"estimate": True, "sd": CLOCK_M}, "range_clock_drift": {"estimate": True, "sd": CLOCK_MPS}}
    start = {"position_sd_m": 5.0}
    config = merge(config, {"start": start, "range": stated, "ship": ship, "calibration": PRIORS | clock})
    streams, hidden = sample(motion, vehicle, rng)
    return Dive(streams | {"range": heard} | boat.says(600.0, rng), config, motion, hidden)


DRAWN = Setting(drawn=True)
ROUND = replace(DRAWN, round_ship=True, crew=False)
ROWS: dict[str, Callable[[int], Dive]] = {
    "USBL": lambda seed: below_ship(DRAWN, seed),
    "round the ship": lambda seed: below_ship(ROUND, seed),
    "the same, 2 s late, 3 deg off, 10 % outliers": lambda seed: below_ship(
        replace(ROUND, yaw=3.0, latency=2.0, outliers=0.1), seed
    ),
    "no DVL": lambda seed: below_ship(replace(DRAWN, dvl=False), seed),
    "one unknown beacon": one_beacon,
    "one unknown beacon, straight leg": lambda seed: one_beacon(seed, True, 300.0),
    "four beacons, no DVL for 5 min": lambda seed: among_beacons(seed, 4, 0.5, 0.5, 300.0),
    "cluster after silence": lambda seed: below_ship(replace(DRAWN, seconds=700.0, changed=cluster), seed),
    "sound speed 1 % off, 1000 m": lambda seed: below_ship(replace(DRAWN, depth=1000.0, speed=1515.0), seed),
    "summer shelf, profile stated": lambda seed: below_ship(replace(DRAWN, profile=SUMMER, stated=True), seed),
    "summer shelf, not stated": lambda seed: below_ship(replace(DRAWN, profile=SUMMER), seed),
    "topside drifts 1 deg/min": ugps,
    "four receivers, one clock": four_receivers,
    "topside does not drift": lambda seed: ugps(seed, 0.0),
}


def run_row(name: str, seed: int, online: bool) -> Result:
    """One dive."""
    return run_dive(ROWS[name](seed), online, inspect)


def inspect(folder: Path, dive: Dive) -> dict[str, float]:
    """How far constants are found from what they are, and their sd, as calibration.csv has them."""
    table = pd.read_csv(folder / "out/calibration.csv")
    smoothed = table[table["estimate"] == "smoothed"].set_index("label")
    found = {}
    for label, true in dive.hidden.others.items():
        if label in smoothed.index and np.isfinite(true):
            found |= {f"{label} off": smoothed.loc[label, "value"] - true, f"{label} sd": smoothed.loc[label, "sd"]}
    return found


def figures(name: str, results: Sequence[Result]) -> str:
    """A row of the table."""
    labels = dict.fromkeys(key.removesuffix(" off") for r in results for key in r.found if key.endswith(" off"))
    found = []
    for label in labels:
        off, sd = (
            np.sqrt(np.mean([r.found[f"{label} {what}"] ** 2 for r in results if f"{label} {what}" in r.found]))
            for what in ("off", "sd")
        )
        found.append(f"{label} {off:.2g} ({sd:.2g})")
    return "| " + " | ".join([name, *estimate_cells(results), ", ".join(found) or "–"]) + " |"


def main() -> None:
    """Run and print."""
    parser = row_options(__doc__, ROWS, cores())
    arguments = parser.parse_args()
    heads = [f"{kind} {what}" for kind in ("smoothed", "filtered", "online") for what in ("rms (sd) [m]", "NEES")]
    print("| dive | " + " | ".join(heads) + " | verdicts | constants off (sd) |")
    print("|---" * (len(heads) + 3) + "|", flush=True)
    with workers(arguments.jobs) as pool:
        for name in arguments.rows:
            with starting():
                futures = [pool.submit(run_row, name, seed, arguments.online) for seed in range(arguments.seeds)]
            results = [future.result() for future in futures]
            print(figures(name, results), flush=True)
            if arguments.said:
                print("\n".join(results[0].said), flush=True)
            if arguments.keep:
                from fault_campaign.judge import write_dive

                folder = arguments.keep / name.replace(" ", "_").replace("%", "").replace(",", "")
                folder.mkdir(parents=True, exist_ok=True)
                write_dive(ROWS[name](0), folder)


if __name__ == "__main__":
    main()
