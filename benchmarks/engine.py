"""What estimation costs, beside what it cost at 27325b3. Figures are in benchmarks/README.md.

    python benchmarks/engine.py                      everything: hours at 27325b3, minutes now
    python benchmarks/engine.py --rows falcon online only these
    python benchmarks/engine.py --base DIR           a checkout of 27325b3; else one is made, and removed
    python benchmarks/engine.py --quick --no-base    a smoke test

Processor time, user and system, of all processes, each with one thread for BLAS. Modules and
kernels have been compiled before. Both columns come from one run on one machine, so ratios may be compared
with those of another; seconds may not. Nothing is asserted: it prints a table.
"""

import argparse
import gzip
import os
import platform
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

from checkouts import ROOT, Checkout, Failed, checkout_of

T = TypeVar("T")
BASE = "27325b3"
SHIPPED = ROOT / "data" / "falcon"
# all but iSAM2's, and those with thrusters
IN_BOTH = ["--estimators", "dead-reckoning,4.*,ekf-[abcm]*,rts-*,graph-filtered-*,graph-smoothed-[abcm]*"]
ICTINEU = ROOT.parent / "shared" / "data" / "ictineu"


@dataclass(frozen=True)
class Target:
    """What is wanted of a line.

    Attributes
    ----------
    text : for the table
    met : by the value at 27325b3, or None, and the value now; None = cannot be told
    better : "less" or "more"
    """

    text: str
    met: Callable[[float | None, float], bool | None]
    better: str = "less"


def times_less(factor: float) -> Target:
    """At most a part of what it was."""
    return Target(f"{factor:g} times less", lambda base, now: None if base is None else factor * now <= base)


def at_most(limit: float, unit: str = "") -> Target:
    return Target(f"at most {limit:g} {unit}".strip(), lambda base, now: now <= limit)


def at_least(limit: float) -> Target:
    return Target(f"at least {limit:g}", lambda base, now: now >= limit, "more")


ANY = Target("", lambda base, now: None)
TRIPLE = Target("at most 3 times it", lambda base, now: None if base is None else now <= 3.0 * base)


@dataclass(frozen=True)
class Line:
    """A line of the table; None = not measured."""

    what: str
    unit: str
    base: float | None
    now: float
    target: Target

    def row(self, judged: bool) -> str:
        """A row of the table, with or without whether the target is met."""
        ratio = ""
        if self.base and self.now:
            ratio = f"{self.base / self.now if self.target.better == 'less' else self.now / self.base:.3g}"
        met = {True: "met", False: "not met", None: ""}[self.target.met(self.base, self.now) if judged else None]
        values = ["" if v is None else f"{v:.3g} {self.unit}".strip() for v in (self.base, self.now)]
        return f"| {' | '.join([self.what, *values, ratio, self.target.text, met])} |"


@dataclass
class Bench:
    """The two checkouts, and how much is measured.

    Attributes
    ----------
    now, base : base None = not measured
    folder : for logs that are made on the way
    ictineu : folder with the log of that dive
    quick, long : a smoke test; eight hours at 27325b3, too
    seeds, runs : dives of ``compare``, and of each cell of the study
    """

    now: Checkout
    base: Checkout | None
    folder: Path
    ictineu: Path
    quick: bool
    long: bool
    seeds: int
    runs: int

    def falcon(self, checkout: Checkout) -> tuple[Path, Path]:
        """Log of the dive that ships, and its configuration with the keys that a checkout knows."""
        return self._falcon_log, checkout.root / "data" / "falcon" / "config.yaml"

    @cached_property
    def _falcon_log(self) -> Path:
        """All of it, or its first 30 s."""
        if not self.quick:
            return SHIPPED / "log.csv.gz"
        path = self.folder / "falcon.csv"
        with gzip.open(SHIPPED / "log.csv.gz", "rt") as log:
            header = next(log)
            place = header.strip().split(",").index("time")
            path.write_text(header + "".join(line for line in log if float(line.split(",")[place]) < 30.0))
        return path

    @property
    def hour(self) -> int:
        """[s]"""
        return 60 if self.quick else 3600

    def both(self, measure: Callable[[Checkout], T], base: bool = True) -> tuple[T | None, T]:
        """A measurement at 27325b3 and now."""
        return (measure(self.base) if base and self.base is not None else None), measure(self.now)

    def smooth(self, checkout: Checkout, log: Path, config: Path, *options: str) -> tuple[float, float]:
        """Processor time [s] and memory [GB] of the whole command."""
        files = [log, "--config", config, "--out", self.results(checkout)]
        cost = checkout.rovgraph("smooth", *files, "--force", *options)
        return cost.processor, cost.memory

    def results(self, checkout: Checkout) -> Path:
        """A folder that the next command may replace."""
        return self.folder / f"results-{checkout.driver}"


def filter_falcon(bench: Bench) -> Iterator[Line]:
    base, now = bench.both(lambda checkout: checkout.drive("filter", *bench.falcon(checkout)))
    yield Line("filter of data/falcon", "s", base, now, times_less(40))


def smoother_falcon(bench: Bench) -> Iterator[Line]:
    base, now = bench.both(lambda checkout: checkout.drive("smoother", *bench.falcon(checkout)))
    yield Line("assemble, optimum and marginals of data/falcon", "s", base, now, times_less(12))


def isam2_falcon(bench: Bench) -> Iterator[Line]:
    base, now = bench.both(lambda checkout: checkout.drive("isam2", *bench.falcon(checkout)))
    yield Line("data/falcon with iSAM2, estimating", "s", base, now, times_less(10))


def chain(bench: Bench) -> Iterator[Line]:
    """The column of 27325b3 is what stands beside it in the same process."""
    micros = bench.now.drive("chain", 300 if bench.quick else 3000)
    what = "chain solver, a keyframe, beside"
    yield Line(f"{what} GTSAM's fastest elimination", "µs", micros["gtsam"], micros["rovgraph"], times_less(5))
    yield Line(f"{what} LAPACK's solveh_banded", "µs", micros["solveh_banded"], micros["rovgraph"], TRIPLE)


def falcon(bench: Bench) -> Iterator[Line]:
    base, now = bench.both(lambda checkout: bench.smooth(checkout, *bench.falcon(checkout), "--no-figures")[0])
    yield Line("data/falcon, whole command without figures", "s", base, now, times_less(5))


def ictineu(bench: Bench) -> Iterator[Line]:
    files = log_of_ictineu(bench)
    base, now = bench.both(lambda checkout: bench.smooth(checkout, *files)[0])
    yield Line("Ictineu, whole command with figures", "s", base, now, times_less(4))


def ictineu_online(bench: Bench) -> Iterator[Line]:
    log, config = log_of_ictineu(bench)
    options = ["--config", config, "--speed", "max", "--no-refine", "--force", "--out"]
    base, now = bench.both(lambda c: c.rovgraph("online", f"file:{log}", *options, bench.results(c)).processor)
    yield Line("Ictineu through online --speed max, recorded", "s", base, now, times_less(4))


def log_of_ictineu(bench: Bench) -> tuple[Path, Path]:
    """Log and configuration.

    Raises
    ------
    Failed : they are not there
    """
    files = bench.ictineu / "log.csv.gz", bench.ictineu / "ictineu.yaml"
    if not all(file.exists() for file in files):
        raise Failed("left out, the log is not there; name its folder with --ictineu")
    return files


def hours(bench: Bench) -> Iterator[Line]:
    """The Falcon's sensors at their rates; the configuration is each checkout's own."""
    spent = {}
    for count in (1, 8):
        log = bench.folder / f"{count}.csv"
        bench.now.drive("simulate", count * bench.hour, log)

        def measure(checkout: Checkout, log: Path = log) -> tuple[float, float]:
            return bench.smooth(checkout, log, checkout.falcon, "--no-figures")

        spent[count] = bench.both(measure, base=count == 1 or bench.long)
        log.unlink()
    (base_1, now_1), (base, now) = spent[1], spent[8]
    one = "one hour at 100 Hz and 5.6 Hz, whole command without figures"
    yield Line(one, "s", base_1 and base_1[0], now_1[0], ANY)
    yield Line(f"{one}, memory", "GB", base_1 and base_1[1], now_1[1], ANY)
    yield Line("eight hours of it", "s", base and base[0], now[0], at_most(120, "s"))
    yield Line("eight hours of it, memory", "GB", base and base[1], now[1], at_most(3, "GB"))
    ratio = base[0] / base_1[0] if base and base_1 else None
    yield Line("eight hours over one hour", "", ratio, now[0] / now_1[0], at_most(9))


def online(bench: Bench) -> Iterator[Line]:
    yield from replays(bench, "fixed-lag", 5.0, 120, 2, 20)


def online_isam2(bench: Bench) -> Iterator[Line]:
    yield from replays(bench, "isam2", 1.0, 60, 20, 300)


def replays(bench: Bench, kind: str, rate: float, times: float, p99: float, longest: float) -> Iterator[Line]:
    """One hour; updates in the time of the wall, so that nothing else should run."""
    base, now = bench.both(lambda checkout: checkout.drive("online", kind, bench.hour, rate))
    for name, of, unit, target in (
        ("times_real_time", "times real time", "", at_least(times)),
        ("p99_ms", "update, p99", "ms", at_most(p99, "ms")),
        ("longest_ms", "longest update", "ms", at_most(longest, "ms")),
    ):
        yield Line(f"one hour online, {kind}, {of}", unit, base and base[name], now[name], target)


def compare(bench: Bench) -> Iterator[Line]:
    """As it stands, and with the estimators of 27325b3, which has none of iSAM2's."""
    few = ["--estimators", "dead-reckoning"]
    for words, options in ("", few if bench.quick else []), (", without iSAM2", few if bench.quick else IN_BOTH):
        base, now = bench.both(lambda c, o=options: scaled(c, partial(_comparison, bench, o), bench.seeds, 30))
        yield Line(f"compare --scenario vattern{words}, 30 dives by {bench.seeds}", "s", base, now, times_less(5))


def _comparison(bench: Bench, options: list[str], checkout: Checkout, seeds: int) -> float:
    # in one process: several would share out the estimators of one dive, and each simulate it
    scenario = ["--scenario", "vattern", "--seeds", seeds, "--jobs", 1, *options]
    return checkout.rovgraph("compare", *scenario, "--out", bench.results(checkout), "--force").processor


def study(bench: Bench) -> Iterator[Line]:
    """The study of configs/studies/scale.yaml has ten cells of 50 dives."""

    def measure(checkout: Checkout, runs: int) -> float:
        plan = (checkout.root / "configs" / "studies" / "scale.yaml").read_text()
        plan = re.sub(r"(?m)^runs: .*", f"runs: {runs}", plan)
        plan = re.sub(r"(?m)^vehicle: .*", f"vehicle: {checkout.falcon}", plan)
        if bench.quick:
            plan = plan.replace("duration_s: 300", "duration_s: 40")
        path, out = bench.folder / "scale.yaml", bench.folder / f"study-{checkout.driver}-{runs}"
        path.write_text(plan)
        return checkout.rovgraph("study", "misalignment", "-c", path, "-o", out).processor

    base, now = bench.both(lambda checkout: scaled(checkout, measure, bench.runs, 50))
    yield Line(f"study of 500 dives of five minutes by {10 * bench.runs}", "s", base, now, times_less(5))


def scaled(checkout: Checkout, measure: Callable[[Checkout, int], float], part: int, whole: int) -> float:
    """What the whole costs, by what one and a part of it cost: what a process costs once is not multiplied."""
    one, some = measure(checkout, 1), measure(checkout, part)
    return one + (whole - 1) * (some - one) / (part - 1)


ROWS: dict[str, Callable[[Bench], Iterator[Line]]] = {
    "filter": filter_falcon,
    "smoother": smoother_falcon,
    "isam2": isam2_falcon,
    "chain": chain,
    "falcon": falcon,
    "ictineu": ictineu,
    "hours": hours,
    "ictineu-online": ictineu_online,
    "online": online,
    "online-isam2": online_isam2,
    "compare": compare,
    "study": study,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--base", type=Path, metavar="DIR", help=f"a checkout of {BASE}")
    parser.add_argument("--no-base", action="store_true", help="measure this checkout only")
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS), metavar="ROW", help=", ".join(ROWS))
    parser.add_argument("--quick", action="store_true", help="little of each; the figures say nothing")
    parser.add_argument("--long", action="store_true", help=f"eight hours at {BASE}, too: 25 minutes and 10 GB")
    parser.add_argument("--seeds", type=int, default=3, help="dives of compare, 2 or more; their cost is scaled to 30")
    parser.add_argument("--runs", type=int, default=3, help="dives of a cell of the study, 2 or more, scaled to 50")
    parser.add_argument("--ictineu", type=Path, default=ICTINEU, metavar="DIR", help="log.csv.gz and ictineu.yaml")
    given = parser.parse_args()
    if min(given.seeds, given.runs) < 2:
        parser.error("--seeds and --runs: 2 or more")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        base = None
        if not given.no_base:
            root = given.base.resolve() if given.base else stack.enter_context(checkout_of(BASE))
            base = Checkout(root, "at_27325b3.py")
            base.compile()
        now = Checkout(ROOT, "now.py")
        now.compile()
        options = [getattr(given, name) for name in ("quick", "long", "seeds", "runs")]
        table(Bench(now, base, folder, given.ictineu, *options), given.rows)


def table(bench: Bench, rows: list[str]) -> None:
    """Measure and print, a line as soon as it is known."""
    machine = f"{os.cpu_count()} cores, {os.getloadavg()[0]:.1f} busy before"
    print(f"{machine}; {platform.platform()}, Python {platform.python_version()}")
    print("30 s of data/falcon, a minute for an hour: the figures say nothing\n" if bench.quick else "")
    print(f"| what | {BASE} | now | ratio | target | |")
    print("|---|---|---|---|---|---|")
    for name in rows:
        try:
            for line in ROWS[name](bench):
                print(line.row(judged=not bench.quick), flush=True)
        except Failed as failure:
            print(f"| {name} | | | | | {failure} |", flush=True)


if __name__ == "__main__":
    main()
