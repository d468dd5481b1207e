"""How often `rovgraph check` warns of a healthy dive, and how often it names a fault. Figures are in README.md.

python benchmarks/check.py --seeds 3
python benchmarks/check.py --seeds 3 --cases "dvl 0.1 s late" "dvl y flipped"
"""

import argparse
import re
import zlib
from collections.abc import Iterator, Sequence

import numpy as np
from alarms import healthy
from fault_campaign.campaign import merge
from fault_campaign.cases import CASES, FAULTS, HEALTHY, Case
from fault_campaign.instruments import log_table, sample
from fault_campaign.scenarios import make_motion
from fault_campaign.vehicle import configuration, make_vehicle

from rovgraph.check import Finding, examine
from rovgraph.config import Config
from rovgraph.errors import InputError
from rovgraph.log import Log


def log_of_case(case: Case, seed: int) -> tuple[Log, Config]:
    """The dive of a case of the fault campaign, as its `run_case` makes it, and its configuration."""
    setting = zlib.crc32(repr(case.setting).encode())
    rng = np.random.default_rng([setting, seed])
    motion, vehicle = make_motion(case.scenario, rng), make_vehicle(case.grade, case.aids)
    if case.dvl_rate is not None:
        vehicle.dvl.rate = case.dvl_rate
    vehicle.dvl.scale_sd = case.config.get("calibration", {}).get("dvl_scale", {}).get("sd", 0.0)
    config = merge(merge(configuration(vehicle), case.config), case.wrong_config)
    rng.normal(0.0, 0.1, 2)  # the campaign draws a start here
    if case.on_vehicle is not None:
        case.on_vehicle(vehicle)
    streams, _ = sample(motion, vehicle, rng)
    if case.on_log is not None:
        case.on_log(streams, motion, np.random.default_rng([setting, seed, 1]))
    return Log.from_frame(log_table(streams), source=f"{case.name} {seed}"), Config.model_validate(config)


def complaints(log: Log, config: Config) -> list[Finding]:
    """Warnings and errors."""
    return [finding for finding in examine(log, config).findings if finding.level != "ok"]


def cases(chosen: Sequence[Case], seeds: int) -> Iterator[tuple[Case, int, list[Finding]]]:
    """What is found in every dive of some cases; a log that cannot be read has an error."""
    for case in chosen:
        for seed in range(seeds):
            try:
                yield case, seed, complaints(*log_of_case(case, seed))
            except InputError as error:
                yield case, seed, [Finding("log", "error", str(error))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--cases", nargs="+", choices=list(CASES), help="of the fault campaign; all and the scenarios")
    parser.add_argument("--healthy", action="store_true", help="healthy dives only")
    given = parser.parse_args()
    if given.cases is None:
        _healthy(given.seeds)
    if not given.healthy:
        chosen = FAULTS if given.cases is None else [CASES[name] for name in given.cases]
        for case in chosen:
            found = [lines for _, _, lines in cases([case], given.seeds)]
            named = [any(re.search(case.says, f"{f.sensor}: {f.text}", re.I) for f in lines) for lines in found]
            print(f"{case.name}: named in {sum(named)} of {len(named)}")
            for line in dict.fromkeys(f"{f.sensor}: {f.text}" for lines in found for f in lines):
                print(f"    {line}")


def _healthy(seeds: int) -> None:
    """Dives of the project's simulator and of the fault campaign's, with all that is said of them."""
    dives = [(name, complaints(log, config)) for name, log, config in healthy(seeds)]
    dives += [(f"{case.name} {seed}", lines) for case, seed, lines in cases(HEALTHY, seeds)]
    for name, lines in dives:
        for line in lines:
            print(f"{name}: {line.sensor}: {line.text}", flush=True)
    lock = "bottom lock"  # the simulator's tank does lose it
    wrong = sum(any(not line.text.startswith(lock) for line in lines) for _, lines in dives)
    print(f"{wrong} of {len(dives)} healthy dives with a false warning")


if __name__ == "__main__":
    main()
