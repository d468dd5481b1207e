"""Do the fast tests notice a fault? Plants those of mutants.toml, one at a time, in a copy of the package.

    make mutants
    python benchmarks/mutants.py --only joseph-without-noise units-milligauss
    python benchmarks/mutants.py --list

Each fault is a small change of one file under rovgraph/, with what it breaks and the tests that should fail with it.
The tests pass without faults, or nothing is planted. A fault survives where all its tests pass all the same, and is
out of date where its old text is not found exactly once: then renew it. Either ends with exit code 1.

Faults in kernels are tested uncompiled, since compiling all that a kernel is part of takes most of a minute.
"""

import argparse
import os
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from checkouts import ROOT

LIST = Path(__file__).with_suffix(".toml")
LONGEST_S = 600.0  # of the tests of one fault
FAILED = 1  # pytest's exit code where a test fails; others say that tests could not be run
Tests = dict[bool, list[str]]  # uncompiled -> names


class Useless(Exception):
    """What keeps a fault from being tested; the message is one line."""


@dataclass(frozen=True)
class Fault:
    """A change of one file.

    Attributes
    ----------
    name : for the command line
    file : under rovgraph/
    old, new : the text that is found exactly once, and what takes its place
    breaks : what is wrong then
    tests : files or tests, under tests/, at least one of which fails
    """

    name: str
    file: str
    old: str
    new: str
    breaks: str
    tests: list[str]

    @property
    def uncompiled(self) -> bool:
        """Whether its tests are run without the compiler."""
        return self.file.startswith("kernels/")

    @contextmanager
    def planted(self, root: Path) -> Iterator[None]:
        """Have the fault in a copy meanwhile.

        Raises
        ------
        Useless : it no longer applies
        """
        path = root / "rovgraph" / self.file
        text = path.read_text(encoding="utf-8") if path.exists() else ""
        if (count := text.count(self.old)) != 1:
            where = f"is there {count} times" if path.exists() else "is not there, nor is the file"
            raise Useless(f"OUT OF DATE: its old text {where}; renew it in {LIST.name}")
        stat = path.stat()
        path.write_text(text.replace(self.old, self.new), encoding="utf-8")
        try:
            yield
        finally:
            path.write_text(text, encoding="utf-8")
            os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))  # the cache of compiled kernels goes by it


def faults() -> list[Fault]:
    """All of the list."""
    return [Fault(**one) for one in tomllib.loads(LIST.read_text(encoding="utf-8"))["fault"]]


def copy_of_tree(into: Path) -> None:
    """The working tree, but for what git ignores."""
    files = ["git", "-C", str(ROOT), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(files, capture_output=True, text=True, check=True).stdout.split("\0"):
        if name and (ROOT / name).is_file():
            (into / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, into / name)


def passed(root: Path, tests: Sequence[str], uncompiled: bool) -> bool:
    """Whether tests pass in a copy.

    Raises
    ------
    Useless : they could not be run
    """
    command = [sys.executable, "-B", "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-p", "no:randomly"]
    environment = os.environ | {"PYTHONPATH": str(root), "ROVGRAPH_CACHE_DIR": str(root / "compiled")}
    if uncompiled:
        environment["NUMBA_DISABLE_JIT"] = "1"
    try:
        done = subprocess.run(
            [*command, *(f"tests/{test}" for test in tests)],
            cwd=root,
            env=environment,
            capture_output=True,
            text=True,
            timeout=LONGEST_S,
        )
    except subprocess.TimeoutExpired:
        raise Useless(f"its tests take more than {LONGEST_S:g} s") from None
    if done.returncode not in (0, FAILED):
        said = [line for line in done.stdout.splitlines() + done.stderr.splitlines() if line.strip()]
        raise Useless(f"its tests cannot be run: {' '.join(said[-3:])[:300]}")
    return done.returncode == 0


def report(fault: Fault, root: Path) -> bool:
    """Plant a fault, print what became of it, and return whether it was caught."""
    began = time.monotonic()
    try:
        with fault.planted(root):
            caught = not passed(root, fault.tests, fault.uncompiled)
        said = "caught" if caught else f"SURVIVED: {fault.breaks} ({', '.join(fault.tests)})"
    except Useless as useless:
        caught, said = False, str(useless)
    print(f"{fault.name:40} {time.monotonic() - began:5.0f} s  {said}", flush=True)
    return caught


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--only", nargs="+", metavar="NAME", help="faults; all unless given")
    parser.add_argument("--list", action="store_true", help="name the faults, and plant none")
    arguments = parser.parse_args()
    known = {fault.name: fault for fault in faults()}
    if unknown := set(arguments.only or ()) - set(known):
        parser.error(f"no fault is named {', '.join(sorted(unknown))}; --list has them")
    chosen = [known[name] for name in arguments.only or known]
    if arguments.list:
        print("\n".join(f"{fault.name:40} {fault.file}: {fault.breaks}" for fault in chosen))
        return
    with TemporaryDirectory() as folder:
        root = Path(folder)
        copy_of_tree(root)
        for uncompiled in (False, True):
            tests = sorted({test for fault in chosen if fault.uncompiled == uncompiled for test in fault.tests})
            try:
                if tests and not passed(root, tests, uncompiled):
                    sys.exit(f"the tests fail without a fault: mend them first ({', '.join(tests)})")
            except Useless as useless:
                sys.exit(f"without a fault: {useless}")
        caught = [report(fault, root) for fault in chosen]
    print(f"{sum(caught)} of {len(caught)} faults are caught")
    sys.exit(0 if all(caught) else 1)


if __name__ == "__main__":
    main()
