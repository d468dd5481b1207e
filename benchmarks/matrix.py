"""Goldens and kernels with the oldest and the newest libraries that pyproject.toml admits.

    python benchmarks/matrix.py [oldest] [newest] [--python python3.12 ...] [--tests tests/test_kernel_motion.py ...]

Each column is a virtual environment in a temporary folder, with kernels compiled anew. It needs an index of packages
and some minutes a column.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
LIBRARIES = ("numba", "numpy", "gtsam", "pandas")
# what tests import beside the package
TOOLS = ("pytest>=8", "pytest-timeout>=2.3", "hypothesis>=6.100", "pint>=0.24")
TESTS = (
    "tests/test_golden.py",
    "tests/test_kernel_chain.py",
    "tests/test_kernel_dead_reckoning.py",
    "tests/test_kernel_error_coordinates.py",
    "tests/test_kernel_measurements.py",
    "tests/test_kernel_motion.py",
    "tests/test_kernel_thesis_filters.py",
    "tests/test_batch.py",
)


def constraints(column: str) -> list[str]:
    """Requirements of pip that pin the libraries to the oldest versions, or leave the newest."""
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    bounds = {re.split(r"[<>=; ]", entry)[0]: entry.split(";")[0].strip() for entry in wanted}
    if column == "newest":
        return [bounds[name] for name in LIBRARIES]
    # ~=: its newest bug fix, since the first of a minor version may have no wheel
    return [f"{name}~={padded(bounds[name])}" for name in LIBRARIES]


def padded(bound: str) -> str:
    """The lowest version of a requirement, with three numbers."""
    parts = re.search(r">=([\d.]+)", bound)[1].split(".")  # type: ignore[index]
    return ".".join([*parts, "0", "0"][:3])


def passes(column: str, python: str, tests: list[str]) -> bool:
    """Install and test one column; prints versions and outcome."""
    with tempfile.TemporaryDirectory(prefix=f"rovgraph-{column}-") as folder:
        own = Path(folder) / "venv" / "bin" / "python"
        subprocess.run([python, "-m", "venv", own.parents[1]], check=True)
        pip = [own, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        installed = subprocess.run([*pip, *constraints(column), *TOOLS, ROOT], text=True, capture_output=True)
        if installed.returncode:
            print(f"{column}, {python}: cannot be installed: {installed.stderr.strip().splitlines()[-1]}", flush=True)
            return False
        code = f"import importlib.metadata as m; print(*(f'{{n}} {{m.version(n)}}' for n in {LIBRARIES!r}), sep=', ')"
        versions = subprocess.run([own, "-c", code], check=True, text=True, capture_output=True).stdout.strip()
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "ROVGRAPH_CACHE_DIR": str(Path(folder) / "kernels")}
        command = [own, "-m", "pytest", "-p", "no:cacheprovider", *tests]
        done = subprocess.run(command, cwd=ROOT, env=environment, text=True, capture_output=True)
        said = (done.stdout.strip().splitlines() or [done.stderr.strip()])[-1]
        print(f"{column}, {python}: {versions}: {said}", flush=True)
        for line in done.stdout.splitlines():
            if line.startswith(("FAILED", "ERROR ", "E  ")):
                print(f"  {line}", flush=True)
        return done.returncode == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # type: ignore[union-attr]
    parser.add_argument("columns", nargs="*", default=["oldest", "newest"])
    parser.add_argument("--python", nargs="+", default=[sys.executable])
    parser.add_argument("--tests", nargs="+", default=list(TESTS))
    given = parser.parse_args()
    outcomes = [passes(column, python, given.tests) for python in given.python for column in given.columns]
    return int(not all(outcomes))


if __name__ == "__main__":
    sys.exit(main())
