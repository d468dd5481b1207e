"""How many rooms the house has, what a ping costs in it, and its door, beside 07f9a06. It asserts nothing.

    python benchmarks/house.py
    python benchmarks/house.py --beside DIR     a checkout, instead of one of --commit, which is made and removed
    python benchmarks/house.py --classes        also which classes are made per ping, most often first
    python benchmarks/house.py --only rooms door

prints a table. `rooms` are counted in the text (`rooms.py`), lines with comments and docstrings, and in a plain
`smooth` of a simulated dive. Instances are those of the package's classes, per ping of a simulated dive: what the
second minute and a half of it costs more, so that what is made once drops out. Of the live filter they are those
between a measurement and the estimate, of the navigator also those of messages; its time is processor time of one
thread, the median of runs that the two checkouts take in turn. The `door` is whole commands: processor time, user and
system, the least of runs taken in turn. Its unit is what a C++ program needs for the same estimate (`limit/run.py`).
"""

import argparse
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

from checkouts import ROOT, Checkout, Failed, checkout_of
from limit.run import build
from rooms import Rooms

BASE = "07f9a06"
# assembly, linearisation and what carries a ping, in either checkout; those that are missing have no lines
CARRIES = (
    "engine/admission.py", "engine/aiding.py", "engine/assembly.py", "engine/dive_rows.py", "engine/keyframes.py",
    "engine/landmarks.py", "engine/late_stamp_window.py", "engine/log_assembly.py", "engine/measurement_table.py",
    "engine/measurements.py", "engine/motion.py", "engine/samples.py", "engine/sensor_rows.py",
    "engine/time_offsets.py", "engine/whole_log.py", "kernels/linearization.py",
    # since 07f9a06
    "kernels/assembly.py", "problem/admission.py", "problem/assembly.py", "problem/measurements.py",
    "problem/problem.py",
)  # fmt: skip
AMONG = ("engine", "kernels", "problem", "log")  # where a module that is new may carry a ping, too
MOST = 7  # parameters
SHORT, LONG = 90, 180  # dives [s]
SELDOM = 0.05  # instances per ping, of a class that is not listed
TIMED_S, RUNS, IN_A_ROW = 120, 5, 3  # dive [s], turns of each checkout, times in one process
SMALL_S, DOOR_RUNS = 60, 8  # dive whose log is checked [s], turns of each checkout


@dataclass(frozen=True)
class House:
    """The package of a checkout."""

    checkout: Checkout

    @cached_property
    def rooms(self) -> Rooms:
        return Rooms(self.checkout.root)

    def made(self, how: str) -> dict[str, float]:
        """Instances per ping by class, most first."""
        short, long = (self.checkout.drive(how, seconds) for seconds in (SHORT, LONG))
        pings = long["pings"] - short["pings"]
        each = {name: (count - short["made"].get(name, 0)) / pings for name, count in long["made"].items()}
        return dict(sorted(each.items(), key=lambda one: -one[1]))

    def command(self, *arguments: object) -> float:
        """Processor time of a command, called as by the script that pip makes [s]."""
        scripts = tomllib.loads((self.checkout.root / "pyproject.toml").read_text())["project"]["scripts"]
        module, _, function = scripts["rovgraph"].partition(":")
        entry = f"import sys; from {module} import {function}; sys.exit({function}())"
        return self.checkout.python("-c", entry, *arguments).processor


Row = tuple[str, ...]  # what, at the base, now, and the target
Both = tuple[House, House]


def count_rooms(both: Both) -> Iterator[Row]:
    """Modules, lines, imports, names, and how many modules a plain `smooth` goes through."""
    base, now = (house.rooms for house in both)
    walks = [house.checkout.drive("plain", SHORT) for house in both]
    yield f"modules entered by a plain smooth of {SHORT} s", *(str(w["modules"]) for w in walks), "≤ 75"
    shares = (f"{w['crossing'] / w['calls']:.0%} of {w['calls']}" for w in walks)
    yield "share of its calls that cross a module's border", *shares, "≤ 40 %"
    counts = (f"{len(r.sources)}; {r.with_one_importer}; {r.longest} lines" for r in (base, now))
    yield "modules; with one importer; the longest", *counts, "≤ 320; ≤ 50; ≤ 800"
    yield "lines", *(str(r.lines("*.py")) for r in (base, now)), ""
    cycles = (f"{r.in_cycles}; {'–' if r.upwards is None else r.upwards}" for r in (base, now))
    yield "modules in import cycles; imports upwards", *cycles, "0; 0"
    names = ("{}; {}".format(*r.shared_class_names) for r in (base, now))
    yield "names of more than one class; of public ones", *names, "; 0"
    carrying = (str(r.lines(*CARRIES)) for r in (base, now))
    yield "lines of assembly, linearisation and what carries a ping", *carrying, "≤ 1700"
    many = (f"{sum(n > MOST for n in r.parameters)}; {r.parameters[0]}" for r in (base, now))
    yield f"functions with more than {MOST} parameters; the most", *many, "≤ 15; 8"


def count_instances(both: Both, classes: bool) -> Iterator[Row]:
    """What is made per ping."""
    targets = {"offline": "0", "live": "≤ 5", "navigator": ""}
    what = {"offline": "smooth", "live": "live filter", "navigator": "navigator, messages and all"}
    for how, target in targets.items():
        made = [h.made(how) for h in both]
        yield f"instances made per ping: {what[how]}", *(f"{sum(m.values()):.1f}" for m in made), target
        for name in [*dict.fromkeys(name for m in made for name in m)] if classes else ():
            if max(m.get(name, 0.0) for m in made) >= SELDOM:
                yield f"    {name.removeprefix('rovgraph.')}", *(f"{m.get(name, 0.0):.2f}" for m in made), ""


def time_live_filter(both: Both) -> Iterator[Row]:
    """A keyframe of the live filter."""
    took: tuple[list[float], list[float]] = [], []
    for turn in range(2 * RUNS):
        took[turn % 2].extend(both[turn % 2].checkout.drive("timed", TIMED_S, IN_A_ROW))
    before, after = map(median, took)
    yield "live filter, µs a keyframe", f"{before:.0f}", f"{after:.0f}", ""
    yield f"live filter, beside {BASE}", "1", f"{after / before:.2f}", "≤ 0.7"


def time_door(both: Both) -> Iterator[Row]:
    """Whole commands."""
    _, now = both
    with TemporaryDirectory() as folder:
        falcon, small, out = ROOT / "data" / "falcon", Path(folder) / "small.csv", Path(folder) / "results"
        now.checkout.drive("write", SMALL_S, small)
        smooth = "smooth", falcon / "log.csv.gz", "--config", falcon / "config.yaml", "--no-figures"
        works: dict[str, Callable[[House], float]] = {
            "smooth data/falcon, whole, no figures": lambda h: h.command(*smooth, "--out", out, "--force"),
            "rovgraph --help": lambda h: h.command("--help"),
            f"check of a log of {SMALL_S} s": lambda h: h.command("check", small, "-c", h.checkout.falcon),
            "import rovgraph": lambda h: h.checkout.python("-c", "import rovgraph").processor,
            "the interpreter alone": lambda h: h.checkout.python("-c", "").processor,
        }
        for name, work in works.items():
            first = name.startswith("smooth")
            limit, unit = None, []
            try:
                limit = build() if first else None
            except Failed as failed:
                yield "the C++ estimate of data/falcon", "", f"left out: {failed}", ""
            took: tuple[list[float], list[float]] = [], []
            for _ in range(DOOR_RUNS):
                for times, house in zip(took, both, strict=True):
                    times.append(work(house))
                if limit is not None:
                    unit.append(limit.cost(Path(folder) / "track.csv").processor)
            before, after = map(min, took)
            yield f"{name}, s", f"{before:.3f}", f"{after:.3f}", ""
            yield f"{name}, beside {BASE}", "1", f"{after / before:.2f}", "" if "alone" in name else "≤ 0.6"
            if unit:
                yield "the C++ estimate of data/falcon, s", "", f"{min(unit):.3f}", ""
                yield f"{name}, C++ estimates", f"{before / min(unit):.1f}", f"{after / min(unit):.1f}", "≤ 8"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--beside", type=Path, help="a checkout")
    parser.add_argument("--commit", default=BASE, help="to make one of, where none is given")
    parser.add_argument("--classes", action="store_true", help="the instances by class")
    parts: dict[str, Callable[[Both], Iterator[Row]]] = {
        "rooms": count_rooms,
        "instances": lambda both: count_instances(both, arguments.classes),
        "live": time_live_filter,
        "door": time_door,
    }
    parser.add_argument("--only", nargs="+", choices=parts, default=list(parts), metavar="PART", help=", ".join(parts))
    arguments = parser.parse_args()
    with ExitStack() as stack:
        try:
            path = arguments.beside or stack.enter_context(checkout_of(arguments.commit))
            base, now = (House(Checkout(root.resolve(), "house.py")) for root in (path, ROOT))
            for house in (base, now):
                house.checkout.compile()
            print(f"| what | {arguments.beside or arguments.commit} | now | target |\n|---|---|---|---|")
            for part in arguments.only:
                for row in parts[part]((base, now)):
                    print(f"| {' | '.join(row)} |", flush=True)
        except Failed as failed:
            raise SystemExit(f"house.py: {failed}") from None
        texts = base.rooms.sources, now.rooms.sources
    new = [name for name in texts[1] if name.startswith(AMONG) and name not in texts[0]]
    new = [name for name in new if not any(Path(name).match(glob) for glob in CARRIES)]
    if new:
        print(f"new, and not counted as carrying a ping: {', '.join(new)}")


if __name__ == "__main__":
    main()
