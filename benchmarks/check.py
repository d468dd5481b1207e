"""How often `rovgraph check` warns of a healthy dive, and how often it names a fault. Figures are in README.md.

python benchmarks/check.py --seeds 3
python benchmarks/check.py --seeds 3 --cases "dvl 0.1 s late" "dvl y flipped"
"""

import argparse
import re
from collections.abc import Iterator, Sequence

from alarms import healthy
from fault_campaign.campaign import make_dive
from fault_campaign.cases import CASES, FAULTS, HEALTHY, Case
from fault_campaign.instruments import log_table

from rovgraph.diagnosis.check import Finding, examine
from rovgraph.errors import InputError
from rovgraph.log import Log
from rovgraph.model.config import Config


def log_of_case(case: Case, seed: int) -> tuple[Log, Config]:
    """The dive of a case of the fault campaign, and its configuration."""
    dive = make_dive(case, seed)
    log = Log.from_frame(log_table(dive.streams), source=f"{case.name} {seed}")
    return log, Config.model_validate(dive.configuration)


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
