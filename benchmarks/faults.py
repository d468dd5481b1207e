"""Does rovgraph say so when the world is not as configured? A campaign of faults.

    python benchmarks/faults.py                                    all cases, 20 seeds
    python benchmarks/faults.py --cases "dvl bias" "dvl frozen" --seeds 3
    python benchmarks/faults.py --list
    python benchmarks/faults.py --markdown docs/faults.md --json faults.json

Dives of an independent simulator (`fault_campaign`) go through `rovgraph smooth`, with `--online` through
`rovgraph online` too. Exit code 1 if a case or a dive with a fault is a lie, or a healthy case is not right.
"""

import argparse
import json
import sys
from collections import Counter
from dataclasses import asdict
from pathlib import Path

from fault_campaign.campaign import Outcome, run, table, verdicts
from fault_campaign.cases import CASES, Case
from fault_campaign.judge import HONEST_NEES, LIE_NEES, WORST_FIRST, honest_nees

from rovgraph.lab.executors import cores

PAGE, ONLINE_PAGE = "faults.md", "faults-online.md"  # in docs

READING = """# Faults{title}: when the configuration is wrong

`python benchmarks/faults.py --seeds {seeds}{option} --markdown docs/{page}` makes this page{version}.

An independent simulator (`benchmarks/fault_campaign`) makes the dives, with WGS-84, the Earth's rate, IMU samples \
averaged over their period, and its own frames and equations. Each case has one fault that the configuration does \
not state. Every log goes through `rovgraph smooth`{online}, {seeds} seeds a case; cases named *online* go through \
`rovgraph online` alone. NEES is the squared error over the stated variance per degree of freedom, averaged over \
dive and seeds: 1 is consistent. The columns show the NEES of the horizontal position, then the largest one of \
depth, heading, `dvl_yaw` and `dvl_scale`. The rms error and the stated sd are of the smoothed horizontal position. \
*Named* is the share of dives in which a warning names the cause. Warnings that the same dives raise without the \
fault do not count.

| outcome | |
|---|---|
| right | every NEES is at most 2, and the sd is at most 1.5 times that of the healthy dive |
| wide | every NEES is at most 2, and the sd is larger than that |
| loud | some NEES is above 2, and 19 of 20 dives name the cause, are refused, or have no NEES above 2 |
| no trace | as a lie, but nothing in the log can show the fault; the reasons are below the table |
| lie | some NEES is above 2, and the cause is not named |

{limit}A dive is *off* if a NEES of its position, depth or heading, smoothed or filtered, is above {lie}: a position \
is 3 stated sds off. An honest dive is so by chance, its position in 1 of 90, a constant error of its heading in 1 of \
30; a dive whose healthy twin is off in the same does not count. A dive that is off and `trusted` is a *lie*. *First \
line* is the share of dives that are off or refused whose first alarm, or first warning where there is none, names the \
cause. *Not trusted* is the share of dives that are `doubtful` or `wrong`, in brackets that of the same dives without \
the fault. {commands}

*Reported by* gives the source of such a fault: `audit` is an audit of rovgraph with another simulator and \
recorded dives, the others are issue trackers of drivers, autopilots and navigation software.

A fault leaves *no trace* if another dive without a fault has the same log. Only wider priors cover it. Where \
nothing checks heading and depth, `smooth` prints what they rest on, with the prior's sd. The outcome counts only if \
it does so, and only for the quantities of that reason: every other quantity must be right.

Run the campaign whenever the estimator changes. `--cases` selects some of them, `--jobs` sets the number of \
processes, `--json` writes all figures, `--online` also replays each log through `rovgraph online`. `--keep` continues \
an interrupted campaign, or takes this page from the dives of one with `--online`.
"""


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--cases", nargs="+", metavar="CASE", choices=list(CASES), default=list(CASES))
    parser.add_argument("--jobs", type=int, default=cores())
    parser.add_argument("--online", action="store_true", help="replay through rovgraph online too")
    parser.add_argument("--keep", type=Path, help="keep every dive in this file, and run only those that it lacks")
    parser.add_argument("--json", type=Path, help="write all figures")
    parser.add_argument("--markdown", type=Path, help="write the page: docs/faults.md, or docs/faults-online.md")
    parser.add_argument("--version", help="what was measured, for the page")
    parser.add_argument("--list", action="store_true", help="list the cases")
    arguments = parser.parse_args()
    cases = [CASES[name] for name in arguments.cases]
    if arguments.list:
        print("\n".join(f"{case.name}: {case.breaks}" for case in cases))
        return 0
    outcomes = run(cases, arguments.seeds, arguments.jobs, arguments.online, _progress, arguments.keep)
    print("\n".join([table(cases, outcomes), count(cases, outcomes), *verdicts(cases, outcomes)]))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps({n: asdict(o) for n, o in outcomes.items()}, indent=1), encoding="utf-8")
    if arguments.markdown is not None:
        arguments.markdown.write_text(page(cases, outcomes, arguments), encoding="utf-8")
    return int(any(_fails(case, outcomes[case.name]) for case in cases))


def _fails(case: Case, outcome: Outcome) -> bool:
    """Whether a campaign with such an outcome has failed."""
    if case.healthy:
        return outcome.verdict != "right"
    return outcome.verdict == "lie" or any(tally.lies for tally in outcome.tallies.values())


def page(cases: list[Case], outcomes: dict[str, Outcome], arguments: argparse.Namespace) -> str:
    """docs/faults.md."""
    version = f", here at {arguments.version}" if arguments.version else ""
    online = " and `rovgraph online`" if arguments.online else ""
    title, option, name = (" online", " --online", ONLINE_PAGE) if arguments.online else ("", "", PAGE)
    words = {"title": title, "option": option, "page": name, "version": version, "online": online, "lie": LIE_NEES}
    words["commands"] = "Figures of `smooth` come before those of `online`." if arguments.online else ""
    parts = [READING.format(seeds=arguments.seeds, limit=_limit(arguments.seeds), **words)]
    parts += [f"- {line}" for line in verdicts(cases, outcomes)] + [""]
    for title, healthy in (("Healthy dives", True), ("Faults", False)):
        some = [case for case in cases if case.healthy == healthy]
        if some:
            parts += [f"## {title}\n", count(some, outcomes) + "\n", table(some, outcomes) + "\n"]
        hidden = [case for case in some if outcomes[case.name].verdict == "no trace"]
        parts += [f"*{case.name}*: {case.no_trace.why}\n" for case in hidden if case.no_trace]
    return "\n".join(parts)


def _limit(seeds: int) -> str:
    """What takes the place of 2 where seeds are few."""
    limit = honest_nees(seeds)
    if limit <= HONEST_NEES:
        return ""
    return (
        f"With {seeds} seeds the limit is {limit:.1f} instead of 2: chance alone reaches it in 1 of 100 campaigns.\n\n"
    )


def count(cases: list[Case], outcomes: dict[str, Outcome]) -> str:
    """How many of each outcome."""
    verdicts = Counter(outcomes[case.name].verdict for case in cases)
    return ", ".join(f"{verdicts[verdict]} {verdict}" for verdict in reversed(WORST_FIRST)) + "."


def _progress(done: float) -> None:
    if sys.stderr.isatty():
        print(f"\r{done:.0%}", end="" if done < 1.0 else "\n", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
