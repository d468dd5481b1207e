"""How often a healthy dive is called doubtful or wrong. Figures are in benchmarks/README.md.

python benchmarks/alarms.py --seeds 2
python benchmarks/alarms.py --margins
python benchmarks/alarms.py --online --seeds 1
"""

import argparse
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
from online import messages

from rovgraph.diagnosis.alarm import verdict_of
from rovgraph.dive import smooth
from rovgraph.lab.misalignment.plan import GRADES
from rovgraph.live.clocks import Clocks
from rovgraph.live.navigator import Navigator
from rovgraph.log import Log
from rovgraph.model.config import Config
from rovgraph.simulate import NAMES, Choices, Style, Truth, Waves, scenario, simulate, simulated
from rovgraph.simulate.named import falcon

LIVELY = Style(waves=Waves(heave=0.05, roll=0.1, pitch=0.08))
SENSORS: dict[str, dict[str, Any]] = {
    "": {},
    "fixes": {"fix_interval": 5.0},
    "ahrs": {"ahrs_rate": 10.0, "imu_rate": 50.0},
    "pings at 1 Hz": {"dvl_rate": 1.0},
    "outliers": {"outlier_share": 0.01},
}


def healthy(seeds: int) -> Iterator[tuple[str, Log, Config]]:
    """Every scenario by its name, and three of them with every grade of inertial unit and set of sensors.

    Scenarios with iron on the seabed and raw magnetometers are left out: there the compass is not healthy.
    """
    for seed in range(1, seeds + 1):
        for name in NAMES:
            choices = Choices(disturbances=False, variant={"tank": "calibrated", "stationary": "water"}.get(name))
            dive, config = simulated(name, seed, None, choices)
            yield f"{name} {seed}", Log.from_frame(dive.log_frame), config
        for grade, imu in GRADES.items():
            for k, (sensors, truth) in enumerate(SENSORS.items()):
                path = ("falcon", "lawnmower", "figure8")[(k + seed) % 3]
                data = falcon().model_dump(exclude_unset=True)
                data["imu"] = {**data.get("imu", {}), **imu}
                if grade != "mti":  # such a gyro feels the Earth turn
                    data["environment"] = {**data.get("environment", {}), "earth_rotation": True}
                if sensors == "ahrs":
                    data["heading"] = {"sources": ["ahrs", "dvl"]}
                config = Config.model_validate(data)
                rng = np.random.default_rng([seed, k, len(grade)])
                dive = simulate(scenario(path, 240.0, None, LIVELY), Truth(config, **truth), rng)
                yield f"{path} {grade} {sensors} {seed}", Log.from_frame(dive.log_frame), config


def online(log: Log, config: Config) -> tuple[str, list[str]]:
    """The worst verdict while a dive goes on, and what is said of it beside its start."""
    navigator = Navigator(config, patient=True, clocks=Clocks(trust=True))
    for message in messages(log):
        navigator.take(message)
    navigator.finish()
    last = navigator.solution()
    events = () if last is None else last.events
    said = [f"{e.time:.0f} s: {e.source} {e.kind}: {e.text}" for e in events if e.source != "start"]
    return verdict_of(navigator.alarms.history.values()), said


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--margins", action="store_true", help="how near its limit each kind of alarm came, smoothed")
    parser.add_argument("--online", action="store_true", help="while the dives go on, instead of smoothed")
    given = parser.parse_args()
    verdicts: Counter[str] = Counter()
    nearest: dict[tuple[str, str], tuple[float, str]] = {}
    for name, log, config in healthy(given.seeds):
        if given.online:
            verdict, said = online(log, config)
            verdicts[verdict] += 1
            print("\n".join(f"{name}: {verdict}: {line}" for line in said), end="\n" if said else "", flush=True)
            continue
        dive = smooth(log, config)
        verdict = dive.verdict
        verdicts[verdict] += 1
        for alarm in dive.alarms:
            print(f"{name}: {verdict}: {alarm.kind}: {alarm.text}", flush=True)
        for one in dive.statistics:
            share = (one.figure / one.doubtful, name)
            key = (one.kind, one.sensor)
            nearest[key] = max(nearest.get(key, share), share)
    total = sum(verdicts.values())
    print(f"{total} healthy dives: " + ", ".join(f"{verdicts[v]} {v}" for v in ("trusted", "doubtful", "wrong")))
    if given.margins:
        for (kind, sensor), (most, name) in sorted(nearest.items()):
            print(f"{kind:10} {sensor:12} {most:5.2f} of its limit at most, {name}")


if __name__ == "__main__":
    main()
