"""How many rooms the house has, and what a ping costs in it, beside 07f9a06. It prints a table and asserts nothing.

    python benchmarks/house.py
    python benchmarks/house.py --beside DIR     a checkout, instead of one of --commit, which is made and removed
    python benchmarks/house.py --classes        also which classes are made per ping, most often first

Lines are counted with comments and docstrings. Instances are those of the package's classes, per ping of a simulated
dive: what the second minute and a half of it costs more, so that what is made once drops out. Of the live filter they
are those between a measurement and the estimate, of the navigator also those of messages. Times are processor time of
one thread, the median of runs that the two checkouts take in turn.
"""

import argparse
import ast
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import median

from checkouts import ROOT, Checkout, Failed, checkout_of

BASE = "07f9a06"
# assembly, linearisation and what carries a ping, in either checkout; those that are missing have no lines
CARRIES = (
    "engine/admission.py", "engine/aiding.py", "engine/assembly.py", "engine/dive_rows.py", "engine/keyframes.py",
    "engine/landmarks.py", "engine/late_stamp_window.py", "engine/log_assembly.py", "engine/measurement_table.py",
    "engine/measurements.py", "engine/motion.py", "engine/samples.py", "engine/sensor_rows.py",
    "engine/time_offsets.py", "engine/whole_log.py", "kernels/linearization.py",
    # since 07f9a06
    "engine/problem.py", "kernels/assembly.py",
)  # fmt: skip
AMONG = ("engine", "kernels", "problem", "log")  # where a module that is new may carry a ping, too
MOST = 7  # parameters
SHORT, LONG = 90, 180  # dives [s]
SELDOM = 0.05  # instances per ping, of a class that is not listed
TIMED_S, RUNS, IN_A_ROW = 120, 5, 3  # dive [s], turns of each checkout, times in one process


@dataclass(frozen=True)
class House:
    """The package of a checkout."""

    checkout: Checkout

    @property
    def root(self) -> Path:
        return self.checkout.root / "rovgraph"

    @cached_property
    def sources(self) -> dict[str, str]:
        """Text of each module by its path in the package."""
        return {str(path.relative_to(self.root)): path.read_text() for path in sorted(self.root.rglob("*.py"))}

    def lines(self, *globs: str) -> int:
        """Of modules."""
        named = [name for name in self.sources if any(Path(name).match(glob) for glob in globs)]
        return sum(len(self.sources[name].splitlines()) for name in named)

    @cached_property
    def parameters(self) -> list[int]:
        """How many each function has, without self and cls, most first; options of `cli` and `api` are not counted."""
        inside = [text for name, text in self.sources.items() if not name.startswith(("cli/", "api/"))]
        return sorted((count for text in inside for count in _parameters(text)), reverse=True)

    def made(self, how: str) -> dict[str, float]:
        """Instances per ping by class, most first."""
        short, long = (self.checkout.drive(how, seconds) for seconds in (SHORT, LONG))
        pings = long["pings"] - short["pings"]
        each = {name: (count - short["made"].get(name, 0)) / pings for name, count in long["made"].items()}
        return dict(sorted(each.items(), key=lambda one: -one[1]))


def _parameters(text: str) -> Iterator[int]:
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            a = node.args
            names = [one.arg for one in (*a.posonlyargs, *a.args, *a.kwonlyargs)]
            yield len(names) - (names[:1] in (["self"], ["cls"])) + (a.vararg is not None) + (a.kwarg is not None)


def rows(base: House, now: House, classes: bool) -> Iterator[tuple[str, ...]]:
    """What, at the base, now, and the target."""
    both = base, now
    yield "modules", *(str(len(h.sources)) for h in both), ""
    yield "lines", *(str(h.lines("*.py")) for h in both), ""
    carrying = (str(h.lines(*CARRIES)) for h in both)
    yield "lines of assembly, linearisation and what carries a ping", *carrying, "≤ 1700"
    many = (f"{sum(n > MOST for n in h.parameters)}; {h.parameters[0]}" for h in both)
    yield f"functions with more than {MOST} parameters; the most", *many, "≤ 15; 8"
    targets = {"offline": "0", "live": "≤ 5", "navigator": ""}
    what = {"offline": "smooth", "live": "live filter", "navigator": "navigator, messages and all"}
    for how, target in targets.items():
        made = [h.made(how) for h in both]
        yield f"instances made per ping: {what[how]}", *(f"{sum(m.values()):.1f}" for m in made), target
        for name in [*dict.fromkeys(name for m in made for name in m)] if classes else ():
            if max(m.get(name, 0.0) for m in made) >= SELDOM:
                yield f"    {name.removeprefix('rovgraph.')}", *(f"{m.get(name, 0.0):.2f}" for m in made), ""
    took: tuple[list[float], list[float]] = [], []
    for turn in range(2 * RUNS):
        took[turn % 2].extend(both[turn % 2].checkout.drive("timed", TIMED_S, IN_A_ROW))
    before, after = map(median, took)
    yield "live filter, µs a keyframe", f"{before:.0f}", f"{after:.0f}", ""
    yield f"live filter, beside {BASE}", "1", f"{after / before:.2f}", "≤ 0.7"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--beside", type=Path, help="a checkout")
    parser.add_argument("--commit", default=BASE, help="to make one of, where none is given")
    parser.add_argument("--classes", action="store_true", help="the instances by class")
    arguments = parser.parse_args()
    with ExitStack() as stack:
        try:
            path = arguments.beside or stack.enter_context(checkout_of(arguments.commit))
            base, now = (House(Checkout(root.resolve(), "house.py")) for root in (path, ROOT))
            for house in (base, now):
                house.checkout.compile()
            print(f"| what | {arguments.beside or arguments.commit} | now | target |\n|---|---|---|---|")
            for row in rows(base, now, arguments.classes):
                print(f"| {' | '.join(row)} |", flush=True)
        except Failed as failed:
            raise SystemExit(f"house.py: {failed}") from None
    new = [name for name in now.sources if name.startswith(AMONG) and name not in base.sources]
    new = [name for name in new if not any(Path(name).match(glob) for glob in CARRIES)]
    if new:
        print(f"new, and not counted as carrying a ping: {', '.join(new)}")


if __name__ == "__main__":
    main()
