"""Commands of rovgraph as it is in some checkout, and what they cost.

Only the standard library, since Linux counts the memory of whoever starts a process as the
process's own.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import Any

ROOT = Path(__file__).parents[1]
DRIVERS = Path(__file__).parent / "drivers"
COMMAND = "from rovgraph.cli.app import main; main()"
LOAD_ALL = """
import importlib, pkgutil, rovgraph
for module in pkgutil.walk_packages(rovgraph.__path__, "rovgraph."):
    importlib.import_module(module.name)
"""
# Idle threads of BLAS would count as work
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class Failed(Exception):
    """A command that ended with an error; the message is its last line."""


@dataclass(frozen=True)
class Cost:
    """What a command took.

    Attributes
    ----------
    processor : time of all its processes, user and system [s]
    memory : of the largest of them [GB]
    said : its standard output
    """

    processor: float
    memory: float
    said: str


def cost_of(command: list[str], environment: dict[str, str] | None = None) -> Cost:
    """Run a command in a temporary folder.

    Raises
    ------
    Failed : it ended with an error
    """
    with TemporaryDirectory() as folder, TemporaryFile() as said, TemporaryFile() as errors:
        process = subprocess.Popen(command, stdout=said, stderr=errors, env=environment, cwd=folder)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        errors.seek(0)
        if process.returncode:
            last = errors.read().decode(errors="replace").strip().splitlines()[-1:]
            raise Failed(f"exit code {process.returncode}: {''.join(last)}")
        return Cost(usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e6, said.read().decode())


@dataclass(frozen=True)
class Checkout:
    """A working copy.

    Attributes
    ----------
    root : its folder
    driver : script in `DRIVERS` that knows its interfaces
    """

    root: Path
    driver: str

    @property
    def falcon(self) -> Path:
        """The configuration of the simulated dives."""
        (found,) = self.root.glob("rovgraph/*/falcon.yaml")  # it has been in other packages
        return found

    def rovgraph(self, *arguments: object) -> Cost:
        """Run the command line."""
        return self.python("-c", COMMAND, *arguments)

    def drive(self, *arguments: object) -> Any:
        """What the driver answers."""
        return json.loads(self.python(DRIVERS / self.driver, *arguments).said.splitlines()[-1])

    def compile(self) -> None:
        """Have all modules and kernels compiled, so that no measurement contains it."""
        self.python("-c", LOAD_ALL)

    def python(self, *arguments: object) -> Cost:
        """Run the interpreter on what belongs to this checkout.

        Raises
        ------
        Failed : it ended with an error
        """
        command = [sys.executable, *map(str, arguments)]
        environment = os.environ | ONE_THREAD | {"PYTHONPATH": str(self.root)}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)  # users load from bytecode, too
        return cost_of(command, environment)


@contextmanager
def checkout_of(commit: str) -> Iterator[Path]:
    """A commit in a temporary folder.

    Raises
    ------
    Failed : the repository does not have it
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / commit
        git = ["git", "-C", str(ROOT), "worktree"]
        done = subprocess.run([*git, "add", "--detach", str(path), commit], capture_output=True, text=True)
        if done.returncode:
            raise Failed(f"no checkout of {commit} ({done.stderr.strip().splitlines()[-1]}); give one with --base")
        try:
            yield path
        finally:
            subprocess.run([*git, "remove", "--force", str(path)], capture_output=True)
