"""One dive through the command, its errors in standard deviations, and the outcome of many dives.

NEES: the squared error over the variance per degree of freedom, its mean over epochs 1 s apart, from
10 s after the start. 1 is honest.
"""

import argparse
import contextlib
import io
import json
import re
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import chi2

from fault_campaign.earth import Array
from fault_campaign.instruments import Hidden, log_table
from fault_campaign.motion import Motion

HONEST_NEES = 2.0
LIE_NEES = 4.5  # of a dive that must not be trusted: a position is 3 of its stated sds off
WIDER = 1.5  # times the sd of the healthy dive
NAMED_IN = 0.95  # of the seeds, for a fault to count as named
SETTLED_S = 10.0
COMMANDS = {"smooth": ("smoothed", "filtered"), "online": ("online",)}  # and their estimates
WORST_FIRST = ("lie", "no trace", "loud", "wide", "right")
ONLINE = "online: "  # begins a line that the replay said
QUANTITIES = ("position", "depth", "heading", "dvl_yaw", "dvl_scale")
TRACK = QUANTITIES[:3]  # what a verdict is about
ALARM, ADVICE = "alarm: ", "advice: "  # begin lines of a summary
SEVERITIES = ("trusted", "doubtful", "wrong")

Clock = Callable[[Array], Array]


def on_time(stamps: Array) -> Array:
    """A clock that is not late."""
    return np.zeros_like(stamps)


@dataclass(frozen=True)
class Result:
    """One dive.

    Attributes
    ----------
    nees : estimate ("smoothed", "filtered", "online") -> quantity -> NEES per degree of freedom
    rms, sd : estimate -> horizontal error, and the sd that is stated of it [m]
    said : warnings, assumptions, alarms and advice in the order of the command, a line each
    refused : no estimate was made
    verdicts : command ("smooth", "online") -> the worst verdict that it gave
    found : whatever else a benchmark has read from the results
    """

    nees: dict[str, dict[str, float]] = field(default_factory=dict)
    rms: dict[str, float] = field(default_factory=dict)
    sd: dict[str, float] = field(default_factory=dict)
    said: tuple[str, ...] = ()
    refused: bool = False
    verdicts: dict[str, str] = field(default_factory=dict)
    found: dict[str, float] = field(default_factory=dict)

    def without_replay(self) -> "Result":
        """What `rovgraph smooth` made of the same dive; all of one that goes through `rovgraph online` alone."""
        if "smoothed" not in self.nees:
            return self
        nees, rms, sd, verdicts = (
            {k: v for k, v in of.items() if k != "online"} for of in (self.nees, self.rms, self.sd, self.verdicts)
        )
        said = tuple(s for s in self.said if not s.startswith(ONLINE))
        return replace(self, nees=nees, rms=rms, sd=sd, said=said, verdicts=verdicts)

    def off(self, command: str) -> set[str]:
        """Of position, depth and heading what is too far off in an estimate of a command for it to be trusted."""
        found = [(q, v) for kind in COMMANDS[command] for q, v in self.nees.get(kind, {}).items() if q in TRACK]
        return {q for q, value in found if not value <= LIE_NEES}


@dataclass(frozen=True)
class NoTrace:
    """Why nothing in a log can show a fault: it is, word for word, the log of another dive without one.

    Attributes
    ----------
    why : the physical reason
    quantities : of `QUANTITIES`, that are wrong by it; the others must be right
    rests_on : regular expression; a line of every dive that matches it says what those quantities rest on
    """

    why: str
    quantities: tuple[str, ...]
    rests_on: str = ""

    def excuses(self, wrong: set[str], messages: Sequence[Sequence[str]]) -> bool:
        """Whether ``wrong`` quantities are those that cannot be right, and each dive's messages say what they rest on.

        A dive that rests on nothing else than what is stated about it (``rests_on`` empty) need not repeat that.
        """
        said = not self.rests_on or all(any(re.search(self.rests_on, line) for line in lines) for lines in messages)
        return said and wrong <= set(self.quantities)


def run_command(arguments: Sequence[str]) -> tuple[int, str]:
    """A command of rovgraph in this process: exit code and what it wrote to standard error."""
    from rovgraph.cli.app import main

    before, errors = sys.argv, io.StringIO()
    sys.argv = ["rovgraph", *arguments]
    code = 0
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(errors):
            main()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except Exception as error:  # a traceback is what a user would see, and the campaign goes on
        code = 1
        print(f"traceback: {type(error).__name__}: {error}", file=errors)
    finally:
        sys.argv = before
    return code, errors.getvalue()


@dataclass(frozen=True)
class Dive:
    """What the command gets, and the truth.

    Attributes
    ----------
    streams, configuration : the log by sensors, and the configuration
    motion, hidden : the truth
    clock : how late the clock is that stamps the estimates, as a function of the stamp [s]
    second_file : sensors in a file of their own; such a dive goes through `rovgraph online` alone
    """

    streams: dict[str, pd.DataFrame]
    configuration: dict[str, Any]
    motion: Motion
    hidden: Hidden
    clock: Clock = on_time
    second_file: tuple[str, ...] = ()


Inspection = Callable[[Path, Dive], dict[str, float]]
NO_TABLES: Mapping[str, pd.DataFrame] = {}


def run_dive(
    dive: Dive, online: bool = False, inspect: Inspection | None = None, beside: Mapping[str, pd.DataFrame] = NO_TABLES
) -> Result:
    """Estimate a dive with `rovgraph smooth`, with ``online`` as a replay too, and compare it with the truth.

    ``inspect`` reads more from the folder, in which out/ and live/ are the results of these commands; ``beside`` are
    tables that lie beside the log, by name.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_dive(dive, folder, beside)
        result = Result(refused=True) if dive.second_file else _smooth(folder, dive)
        if dive.second_file or (online and not result.refused):
            result = _online(folder, dive, result)
        if inspect is not None and not result.refused:
            result = replace(result, found=inspect(folder, dive))
        return replace(result, said=tuple(line.replace(name, "") for line in result.said))


def write_dive(dive: Dive, folder: Path, beside: Mapping[str, pd.DataFrame] = NO_TABLES) -> None:
    """Write log.csv and vehicle.yaml, tables beside it, and second.csv where some sensors have a file of their own."""
    for name, table in beside.items():
        table.to_csv(folder / f"log.{name}.csv", index=False, float_format="%.10g")
    (folder / "vehicle.yaml").write_text(json.dumps(dive.configuration), encoding="utf-8")  # JSON is YAML
    first = {sensor: table for sensor, table in dive.streams.items() if sensor not in dive.second_file}
    _write(first, folder / "log.csv")
    if dive.second_file:
        _write({sensor: dive.streams[sensor] for sensor in dive.second_file}, folder / "second.csv")


def _write(streams: dict[str, pd.DataFrame], path: Path) -> None:
    log_table(streams).to_csv(path, index=False, float_format="%.14g")


def _smooth(folder: Path, dive: Dive) -> Result:
    paths = [str(folder / part) for part in ("log.csv", "vehicle.yaml", "out")]
    _, errors = run_command(["smooth", paths[0], "--config", paths[1], "--out", paths[2], "--no-figures"])
    said = [line for line in errors.splitlines() if line.strip()]
    if not (folder / "out" / "summary.json").exists():
        return Result(said=tuple(said), refused=True)
    summary = json.loads((folder / "out" / "summary.json").read_text(encoding="utf-8"))
    said += [*(f"assumed: {line}" for line in summary["assumptions"]), *_alarms(summary)]
    result = Result(said=tuple(said), verdicts={"smooth": summary["verdict"]})
    calibration = pd.read_csv(folder / "out" / "calibration.csv")
    for kind in ("smoothed", "filtered"):
        track = pd.read_csv(folder / "out" / f"trajectory_{kind}.csv")
        _compare(result, kind, track, calibration[calibration["estimate"] == kind], dive)
    return result


def tracks(folder: Path) -> Iterator[tuple[str, pd.DataFrame]]:
    """The tracks of a dive that was run in a folder, by estimate; "online" where it was replayed."""
    for kind in ("smoothed", "filtered", "online"):
        path = folder / ("live/trajectory_filtered.csv" if kind == "online" else f"out/trajectory_{kind}.csv")
        if path.exists():
            yield kind, pd.read_csv(path)


def horizontal_error(dive: Dive, epoch: pd.Series) -> tuple[Array, Array]:
    """Error north and east of an epoch of a track, shape (2,) [m], and its stated covariance, shape (2, 2) [m^2]."""
    off = epoch[["north", "east"]].to_numpy(float) - dive.motion.local(np.array([epoch["time"]]))[0, :2]
    both = epoch["cov_north_east"]
    return off, np.array([[epoch["north_sd"] ** 2, both], [both, epoch["east_sd"] ** 2]])


def _online(folder: Path, dive: Dive, result: Result) -> Result:
    """A replay at full speed; what it says is added, and its estimate."""
    files = [f"file:{folder / part}" for part in ("log.csv", "second.csv") if (folder / part).exists()]
    options = ["--config", str(folder / "vehicle.yaml"), "--out", str(folder / "live")]
    options += ["--speed", "max", "--no-refine", "--output", "udp://127.0.0.1:9"]  # port 9 is for what nobody reads
    code, errors = run_command(["online", *files, *options])
    said = (*result.said, *(f"{ONLINE}{line}" for line in errors.splitlines()))
    track = folder / "live" / "trajectory_filtered.csv"
    if code != 0 or not track.exists():
        return replace(result, said=said)
    summary = json.loads((folder / "live" / "summary.json").read_text(encoding="utf-8"))
    said = (*said, *(f"{ONLINE}{line}" for line in _alarms(summary)))
    every = [summary["verdict"], *(alarm["severity"] for alarm in summary["alarms"])]
    verdicts = result.verdicts | {"online": max(every, key=SEVERITIES.index)}
    result = replace(result, said=said, refused=False, verdicts=verdicts)
    _compare(result, "online", pd.read_csv(track), _live_calibration(summary["calibration"]), dive)
    return result


def _live_calibration(last: dict[str, list[float]]) -> pd.DataFrame:
    """The last solution's calibration with the columns of calibration.csv; its angles are radians."""
    rows = []
    for name, (value, sd) in last.items():
        unit = 180.0 / np.pi if name == "dvl_yaw" else 1.0
        rows.append({"label": name, "estimated": True, "value": unit * value, "sd": unit * sd})
    return pd.DataFrame(rows, columns=["label", "estimated", "value", "sd"])


def _alarms(summary: dict[str, Any]) -> list[str]:
    """Alarms of a summary, then what it advises."""
    kinds = ((ALARM, summary["alarms"]), (ADVICE, summary.get("advice", [])))
    return [begin + entry["text"] for begin, entries in kinds for entry in entries]


def _compare(
    result: Result,
    kind: str,
    track: pd.DataFrame,
    calibration: pd.DataFrame,
    dive: Dive,
) -> None:
    """Add the errors of one estimate to a result; ``calibration`` are its rows of calibration.csv."""
    result.nees[kind], result.rms[kind], result.sd[kind] = nees(settled_rows(track, dive), dive.motion, dive.clock)
    estimated = calibration[calibration["estimated"].astype(bool)].set_index("label")
    for name, true, turn in (("dvl_yaw", dive.hidden.dvl_yaw, 360.0), ("dvl_scale", dive.hidden.dvl_scale, np.inf)):
        if name in estimated.index:
            value, sd = estimated.loc[name, ["value", "sd"]].to_numpy(dtype=float)
            error = value - true
            error -= 0.0 if np.isinf(turn) else turn * round(error / turn)
            result.nees[kind][name] = float((error / sd) ** 2)


def settled_rows(track: pd.DataFrame, dive: Dive) -> pd.DataFrame:
    """Rows of a trajectory file 1 s apart, without the first ones."""
    times = track["time"].to_numpy()
    wanted = np.arange(SETTLED_S, dive.motion.duration, 1.0)
    wanted += dive.clock(wanted)
    return track.iloc[np.unique(np.clip(np.searchsorted(times, wanted), 0, len(times) - 1))]


def nees(track: pd.DataFrame, motion: Motion, clock: Clock = on_time) -> tuple[dict[str, float], float, float]:
    """NEES per degree of freedom of position (north and east), depth and heading; horizontal rms error and sd [m].

    Parameters
    ----------
    track : rows of a trajectory file
    motion, clock : the truth, and how late the track's stamps are
    """
    stamps = track["time"].to_numpy()
    t = stamps - clock(stamps)
    error = track[["north", "east", "down"]].to_numpy() - motion.local(t)
    e, n = error[:, 1], error[:, 0]
    nn, ee, ne = track["north_sd"] ** 2, track["east_sd"] ** 2, track["cov_north_east"]
    horizontal = ((ee * n**2 - 2.0 * ne * n * e + nn * e**2) / (nn * ee - ne**2)).to_numpy()
    heading = np.asarray(track["yaw"].to_numpy() - motion.heading(t))
    heading = np.mod(heading + np.pi, 2.0 * np.pi) - np.pi
    values = {
        "position": _mean(horizontal) / 2.0,
        "depth": _mean((error[:, 2] / track["down_sd"].to_numpy()) ** 2),
        "heading": _mean((heading / track["yaw_sd"].to_numpy()) ** 2),
    }
    return values, float(np.sqrt(np.mean(n**2 + e**2))), float(np.sqrt(np.mean(nn + ee)))


def _mean(values: Array) -> float:
    return float(np.mean(values))


@dataclass(frozen=True)
class Tally:
    """Dives of one command, counted.

    A dive is off if its position, depth or heading is (`Result.off`); it does not count as such if the same dive
    without the fault is off in as much, nor if nothing in its log can show it.

    Attributes
    ----------
    dives, refused : with a verdict; without an estimate
    doubted : not trusted
    off, lies : off; off and trusted
    named_first : off or refused, and the first line names the cause
    hidden, chance : off, but without a trace; as without the fault
    """

    dives: int = 0
    refused: int = 0
    doubted: int = 0
    off: int = 0
    lies: int = 0
    named_first: int = 0
    hidden: int = 0
    chance: int = 0

    def __add__(self, other: "Tally") -> "Tally":
        return Tally(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))


@dataclass(frozen=True)
class Outcome:
    """Many dives of one case.

    Attributes
    ----------
    verdict : right, wide, loud, no trace, or a lie
    nees : estimate -> quantity -> mean over the seeds
    rms, sd : estimate -> root of the mean square over the seeds [m]
    named : part of the seeds in which the cause was named, by the command that names it less often
    warned : part of the seeds with any warning or alarm that the healthy dive does not have
    refused : part of the seeds that were refused
    seeds : how many
    tallies : command -> its dives, counted
    doubted_healthy : command -> part of the dives without the fault that are not trusted; none for a healthy case
    """

    verdict: str
    nees: dict[str, dict[str, float]]
    rms: dict[str, float]
    sd: dict[str, float]
    named: float
    warned: float
    refused: float
    seeds: int
    tallies: dict[str, Tally] = field(default_factory=dict)
    doubted_healthy: dict[str, float] = field(default_factory=dict)

    @property
    def worst(self) -> tuple[str, float]:
        """The quantity and estimate of the largest NEES; not a number where every dive was refused."""
        found = [(f"{q}, {kind}", v) for kind, values in self.nees.items() for q, v in values.items()]
        return max(found, key=lambda entry: entry[1], default=("", float("nan")))


def row_options(doc: str | None, rows: Iterable[str], jobs: int) -> argparse.ArgumentParser:
    """Options of a benchmark that prints a row for some dives each."""
    names = list(rows)
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", nargs="+", choices=names, default=names, metavar="ROW")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=jobs)
    parser.add_argument("--online", action="store_true", help="replay through rovgraph online too")
    parser.add_argument("--said", action="store_true", help="print what the first dive of each row says")
    parser.add_argument("--keep", type=Path, help="write the first dive of each row into a folder here")
    return parser


def estimate_cells(results: Sequence[Result]) -> list[str]:
    """Cells of a table row: rms (sd) [m] and NEES of each estimate over some dives, and the verdicts."""
    cells = []
    for kind in ("smoothed", "filtered", "online"):
        done = [r for r in results if kind in r.rms]
        if not done:
            cells += ["–", "–"]
            continue
        rms, sd = (float(np.sqrt(np.mean([getattr(r, what)[kind] ** 2 for r in done]))) for what in ("rms", "sd"))
        nees = [float(np.mean([r.nees[kind][q] for r in done])) for q in ("position", "depth", "heading")]
        cells += [f"{rms:.2f} ({sd:.2f})", "; ".join(f"{value:.2g}" for value in nees)]
    verdicts = [r.verdicts.get("smooth", "refused") for r in results]
    return [*cells, ", ".join(f"{verdicts.count(v)} {v}" for v in dict.fromkeys(verdicts))]


def honest_nees(seeds: int) -> float:
    """What the mean NEES of an honest estimate exceeds in fewer than 1 of 100 campaigns; 2 for 20 seeds or more.

    An error that is constant over a dive, as a compass's offset, is one degree of freedom a dive.
    """
    return max(HONEST_NEES, float(chi2.ppf(0.99, seeds)) / seeds)


def template(line: str) -> str:
    """A message without its numbers."""
    return re.sub(r"[-+]?\d[\d.,e+-]*", "#", line)


def judge(
    results: Sequence[Result], says: str, healthy: Sequence[Result] = (), no_trace: NoTrace | None = None
) -> Outcome:
    """The outcome of a case: the worse one of the two commands', each with its own estimates and messages.

    Parameters
    ----------
    results : one per seed
    says : regular expression; a message that matches it names the cause
    healthy : the same dives without the fault; what is said of them is no warning, and their sd is what is possible
    no_trace : why nothing in the logs can show the fault; None where something can
    """
    usual = {template(line) for result in healthy for line in result.said}
    new = [[line for line in r.said if template(line) not in usual] for r in results]
    averages = _average([r.nees for r in results])
    rms, sd = ({kind: _rms_of(results, what, kind) for kind in averages} for what in ("rms", "sd"))
    wider = {kind for kind in sd if healthy and sd[kind] > WIDER * _rms_of(healthy, "sd", kind)}
    refused = float(np.mean([r.refused for r in results]))
    named, verdicts = [], []
    if refused == 1.0:
        named, verdicts = [float(np.mean(_naming(says, new)))], ["loud"]
    for command, kinds in COMMANDS.items():
        if not any(kind in averages for kind in kinds):
            continue
        share = _naming(says, _lines_of(command, new))
        named.append(float(np.mean(share)))
        limit = honest_nees(sum(not r.refused for r in results))
        wrong = {q for kind in kinds for q, value in averages.get(kind, {}).items() if value > limit}
        if not wrong:
            verdicts.append("wide" if wider.intersection(kinds) else "right")
        else:
            told = np.mean([a or r.refused or _right(r, kinds) for a, r in zip(share, results, strict=True)])
            said = _lines_of(command, [r.said for r in results if not r.refused])
            hidden = no_trace is not None and no_trace.excuses(wrong, said)
            verdicts.append("loud" if told >= NAMED_IN else "no trace" if hidden else "lie")
    warned = float(np.mean([any(line.startswith(("warning", "alarm: ")) for line in lines) for lines in new]))
    verdict = min(verdicts, key=WORST_FIRST.index)
    tallies = {command: _tally(command, results, new, says, healthy, no_trace) for command in COMMANDS}
    tallies = {command: tally for command, tally in tallies.items() if tally.dives + tally.refused}
    doubted = {command: _doubted(command, healthy) for command in tallies if healthy}
    return Outcome(verdict, averages, rms, sd, min(named), warned, refused, len(results), tallies, doubted)


def _tally(
    command: str,
    results: Sequence[Result],
    new: Sequence[Sequence[str]],
    says: str,
    healthy: Sequence[Result],
    no_trace: NoTrace | None,
) -> Tally:
    """Count the dives of one command; ``new`` are the lines that no healthy dive has."""
    total = Tally()
    own = zip(_lines_of(command, [r.said for r in results]), _lines_of(command, new), strict=True)
    for result, twin, (said, fresh) in zip_longest(results, healthy[: len(results)], own):
        if result.refused and fresh:
            total += Tally(refused=1, named_first=int(_names(says, fresh[0])))
        if command not in result.verdicts:
            continue
        trusted, off = result.verdicts[command] == "trusted", result.off(command)
        total += Tally(dives=1, doubted=int(not trusted))
        if off and twin is not None and off <= twin.off(command):
            total += Tally(chance=1)
        elif off and no_trace is not None and no_trace.excuses(off, [said]):
            total += Tally(hidden=1)
        elif off:
            total += Tally(off=1, lies=int(trusted), named_first=int(_names(says, _first_line(said, fresh))))
    return total


def _first_line(said: Sequence[str], new: Sequence[str]) -> str:
    """The first alarm; where there is none, the first new line that is a warning."""
    alarms = [line for line in said if line.removeprefix(ONLINE).startswith(ALARM)]
    warnings = [line for line in new if not line.removeprefix(ONLINE).startswith(("assumed: ", ADVICE))]
    return next(iter([*alarms, *warnings]), "")


def _names(says: str, line: str) -> bool:
    return bool(says) and re.search(says, line, re.IGNORECASE) is not None


def _doubted(command: str, results: Sequence[Result]) -> float:
    """Part of those with a verdict that are not trusted."""
    verdicts = [r.verdicts[command] for r in results if command in r.verdicts]
    return float(np.mean([verdict != "trusted" for verdict in verdicts])) if verdicts else 0.0


def _right(result: Result, kinds: Sequence[str]) -> bool:
    """Whether a dive by itself needs no warning."""
    values = [value for kind in kinds for value in result.nees.get(kind, {}).values()]
    return bool(values) and max(values) <= HONEST_NEES


def _lines_of(command: str, messages: Sequence[Sequence[str]]) -> list[list[str]]:
    """Of each dive's messages those of one command."""
    return [[line for line in lines if line.startswith(ONLINE) == (command == "online")] for lines in messages]


def _naming(says: str, messages: Sequence[Sequence[str]]) -> list[bool]:
    """Whether the messages of each dive name the cause."""
    return [any(_names(says, line) for line in lines) for lines in messages]


def _average(every: Sequence[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    kinds = {kind for nees in every for kind in nees}
    result: dict[str, dict[str, float]] = {}
    for kind in sorted(kinds, reverse=True):
        rows = [nees[kind] for nees in every if kind in nees]
        names = [q for q in QUANTITIES if any(q in row for row in rows)]
        result[kind] = {q: float(np.mean([row[q] for row in rows if q in row])) for q in names}
    return result


def _rms_of(results: Sequence[Result], what: str, kind: str) -> float:
    """Root of the mean square of "rms" or "sd" of one estimate over the dives that have it."""
    values = [getattr(r, what)[kind] for r in results if kind in getattr(r, what)]
    return float(np.sqrt(np.mean(np.square(values))))
