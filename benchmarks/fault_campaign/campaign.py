"""Every case over many seeds, on several cores, and the table of it."""

import json
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from fault_campaign.cases import CASES, EVENTS, HEALTHY, Case
from fault_campaign.instruments import sample
from fault_campaign.judge import COMMANDS, Dive, Outcome, Result, Tally, judge, run_dive
from fault_campaign.scenarios import make_motion
from fault_campaign.vehicle import configuration, make_vehicle
from rovgraph.lab.executors import starting, workers

Task = tuple[str, int, bool]  # name of the case, seed, online too


def merge(base: dict[str, Any], more: dict[str, Any]) -> dict[str, Any]:
    """Nested dictionaries, ``more`` over ``base``; what is None there is left out."""
    merged = dict(base)
    for key, value in more.items():
        merged[key] = merge(merged[key], value) if isinstance(value, dict) and key in merged else value
        if value is None:
            del merged[key]
    return merged


def make_dive(case: Case, seed: int) -> Dive:
    """A dive of a case. A seed gives a faulty case and its healthy one the same motion and the same noise."""
    setting = zlib.crc32(repr(case.setting).encode())  # other settings have other draws
    rng = np.random.default_rng([setting, seed])
    motion, vehicle = make_motion(case.scenario, rng), make_vehicle(case.grade, case.aids)
    if case.dvl_rate is not None:
        vehicle.dvl.rate = case.dvl_rate
    if case.fix_rate is not None:
        vehicle.fix.rate = case.fix_rate
    vehicle.dvl.scale_sd = case.config.get("calibration", {}).get("dvl_scale", {}).get("sd", 0.0)
    config = merge(configuration(vehicle), case.config)
    config["start"] |= dict(zip(("north_m", "east_m"), rng.normal(0.0, 0.1, 2).tolist(), strict=True))
    config = merge(config, case.wrong_config)
    if case.on_vehicle is not None:
        case.on_vehicle(vehicle)
    streams, hidden = sample(motion, vehicle, rng)
    if case.on_log is not None:
        case.on_log(streams, motion, np.random.default_rng([setting, seed, 1]))
    if case.event:
        EVENTS[case.event](streams, motion, rng)
    return Dive(streams, config, motion, hidden, case.clock, tuple(case.second_file))


def run_case(case: Case, seed: int, online: bool = False) -> Result:
    """One dive of one case."""
    return run_dive(make_dive(case, seed), online)


def run(
    cases: Sequence[Case], seeds: int, jobs: int, online: bool, progress: Callable[[float], None], kept: Path | None
) -> dict[str, Outcome]:
    """Outcomes by the cases' names; the healthy case of each is run too.

    Parameters
    ----------
    cases, seeds : what to run, and seeds 0 to seeds - 1 of each
    jobs : number of processes
    online : replay through `rovgraph online` too
    progress : called with the share of dives that are done
    kept : a file of dives that were run before; new ones are added as they come
    """
    twins = {case.setting: case for case in HEALTHY}
    wanted = list({case.name: case for c in cases for case in (twins[c.setting], c)}.values())
    done = read_dives(kept)
    tasks = [(case.name, seed, online) for seed in range(seeds) for case in wanted]
    tasks = [task for task in tasks if task not in done]
    if tasks:
        with workers(min(jobs, len(tasks))) as pool:
            with starting():
                futures = {pool.submit(run_named, *task): task for task in tasks}
            for count, future in enumerate(as_completed(futures), 1):
                done[futures[future]] = future.result()
                keep_dive(kept, futures[future], future.result())
                progress(count / len(tasks))
    results = {case.name: [done[case.name, seed, online] for seed in range(seeds)] for case in wanted}
    healthy = {c.name: () if c.healthy else results[twins[c.setting].name] for c in cases}
    return {c.name: judge(results[c.name], c.says, healthy[c.name], c.no_trace) for c in cases}


def run_named(name: str, seed: int, online: bool) -> Result:
    """A task that can be sent to another process: a case's functions cannot."""
    return run_case(CASES[name], seed, online)


def read_dives(path: Path | None) -> dict[Task, Result]:
    """Dives of a file of JSON lines, those that were replayed also without that; none where there is no file."""
    if path is None or not path.exists():
        return {}
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    dives = {(row["case"], row["seed"], row["online"]): Result(**row["result"]) for row in rows}
    alone = {(n, seed, False): r.without_replay() for (n, seed, online), r in dives.items() if online}
    return alone | dives


def keep_dive(path: Path | None, task: Task, result: Result) -> None:
    """Add a dive to a file of JSON lines."""
    if path is not None:
        name, seed, online = task
        row = {"case": name, "seed": seed, "online": online, "result": asdict(result)}
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")


def table(cases: Sequence[Case], outcomes: dict[str, Outcome]) -> str:
    """A table in Markdown."""
    kinds = [kind for kind in ("smoothed", "filtered", "online") if any(kind in o.nees for o in outcomes.values())]
    head = [
        "case",
        "what is wrong",
        *(f"NEES {kind}" for kind in kinds),
        "rms (sd) [m]",
        "named",
        "first line",
        "not trusted",
        "lies",
        "outcome",
        "reported by",
    ]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for case in cases:
        outcome = outcomes[case.name]
        cells = [case.name, case.breaks, *(_nees(outcome, kind) for kind in kinds), _errors(outcome)]
        verdict = f"**{outcome.verdict}**" if outcome.verdict == "lie" else outcome.verdict
        named = f"{outcome.warned:.0%} warned" if case.healthy else _named(outcome)
        source = "" if case.healthy else case.source
        lines.append("| " + " | ".join([*cells, named, *_counts(outcome), verdict, source]) + " |")
    return "\n".join(lines)


def _counts(outcome: Outcome) -> list[str]:
    """First lines that name the cause, dives that are not trusted beside healthy ones, and lies, by command."""
    first, doubted, lies = [], [], []
    for command, tally in outcome.tallies.items():
        healthy = f" ({outcome.doubted_healthy[command]:.0%})" if command in outcome.doubted_healthy else ""
        first.append(share(tally.named_first, tally.off + tally.refused))
        doubted.append(share(tally.doubted, tally.dives) + healthy)
        lies.append(f"**{tally.lies}**" if tally.lies else "0")
    return [" / ".join(cells) or "–" for cells in (first, doubted, lies)]


def share(part: int, whole: int) -> str:
    """Per cent; a dash where there is nothing."""
    return f"{part / whole:.0%}" if whole else "–"


def verdicts(cases: Sequence[Case], outcomes: dict[str, Outcome]) -> list[str]:
    """How good the verdict is, a line for each command."""
    lines = []
    for command in COMMANDS:
        healthy, faulty = (
            sum((outcomes[c.name].tallies.get(command, Tally()) for c in cases if c.healthy == wanted), Tally())
            for wanted in (True, False)
        )
        every, told = healthy + faulty, faulty.off - faulty.lies
        if every.dives:
            lines.append(
                f"`rovgraph {command}`: {faulty.lies} of {faulty.dives} dives with a fault are lies. "
                f"{faulty.off} are off, {share(told, faulty.off)} of them not trusted (recall). "
                f"{every.doubted} dives are not trusted, {share(told, every.doubted)} of them off (precision). "
                f"The first line names the cause in {share(faulty.named_first, faulty.off + faulty.refused)} of those "
                f"that are off or refused. {faulty.hidden} more are off without a trace, {faulty.chance} as without "
                f"the fault. Of {healthy.dives} healthy dives {healthy.doubted} are not trusted, {healthy.off} are off."
            )
    return lines


def _named(outcome: Outcome) -> str:
    return "refused" if outcome.refused == 1.0 else f"{outcome.named:.0%}"


def _nees(outcome: Outcome, kind: str) -> str:
    """Position, and what is worse."""
    values = outcome.nees.get(kind)
    if not values:
        return "–"
    others = {name: value for name, value in values.items() if name != "position"}
    name = max(others, key=lambda other: others[other])
    return f"{number(values['position'])}; {name} {number(others[name])}"


def _errors(outcome: Outcome) -> str:
    kind = next((kind for kind in ("smoothed", "online") if kind in outcome.rms), None)
    return "–" if kind is None else f"{number(outcome.rms[kind])} ({number(outcome.sd[kind])})"


def number(value: float) -> str:
    """Two digits, or whole, or a power of ten."""
    if value >= 1e5:
        return f"{value:.0e}"
    return f"{value:.0f}" if value >= 10.0 else f"{value:.2g}"
