"""Compiles and runs `estimate.cpp`: what the estimate of data/falcon costs by itself.

    python benchmarks/limit/run.py
    EIGEN_INCLUDE=/usr/include/eigen3 python benchmarks/limit/run.py --beside results-log/trajectory_smoothed.csv

It needs a C++17 compiler and Eigen's headers (``apt install libeigen3-dev``, or ``pip install cmeel-eigen``), which are
looked for in ``EIGEN_INCLUDE`` and in the usual places. The program is kept in a temporary folder, by its text.
``--beside`` says how far a track of rovgraph's lies from its track.
"""

import argparse
import csv
import gzip
import hashlib
import math
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from checkouts import ROOT, Cost, Failed, cost_of  # noqa: E402

SOURCE = HERE / "estimate.cpp"
LOG = ROOT / "data" / "falcon" / "log.csv.gz"
FLAGS = ("-std=c++17", "-O3", "-march=native", "-DNDEBUG")
ITERATIONS = 6  # and one more pass: seven passes of the whole dive, as `smooth` makes


@dataclass(frozen=True)
class Limit:
    """The program, and the log as it reads it."""

    program: Path
    log: Path

    def cost(self, track: Path) -> Cost:
        """Of one estimate; the trajectory is written to ``track``."""
        return cost_of([str(self.program), str(self.log), str(track), str(ITERATIONS)])


def compiler() -> str | None:
    """``CXX``, or the first of the usual ones."""
    names = [os.environ["CXX"]] if "CXX" in os.environ else ["g++", "clang++", "c++"]
    return next(filter(None, map(shutil.which, names)), None)


def eigen() -> Path | None:
    """The folder that has ``Eigen/Dense``."""
    if "EIGEN_INCLUDE" in os.environ:
        places = [Path(os.environ["EIGEN_INCLUDE"])]
    else:
        prefixes = (sys.prefix, os.environ.get("CONDA_PREFIX", sys.prefix), "/usr", "/usr/local", "/opt/homebrew")
        places = [Path(prefix) / "include" / "eigen3" for prefix in prefixes]
        places.append(Path(sysconfig.get_path("purelib")) / "cmeel.prefix" / "include" / "eigen3")
    return next((place for place in places if (place / "Eigen" / "Dense").exists()), None)


def build() -> Limit:
    """Compile where that has not been done.

    Raises
    ------
    Failed : there is no compiler or no Eigen, or it does not compile
    """
    with_what, headers = compiler(), eigen()
    if with_what is None:
        raise Failed("no C++ compiler (g++, clang++ or CXX)")
    if headers is None:
        raise Failed("no Eigen (EIGEN_INCLUDE, libeigen3-dev or cmeel-eigen)")
    asked = (with_what, *FLAGS, SOURCE.read_text(), str(headers))
    folder = Path(tempfile.gettempdir()) / f"rovgraph-limit-{hashlib.sha256(repr(asked).encode()).hexdigest()[:12]}"
    folder.mkdir(exist_ok=True)
    program, log = folder / "estimate", folder / "log.csv"
    if not program.exists():
        made = folder / f"estimate-{os.getpid()}"
        command = [with_what, *FLAGS, "-isystem", str(headers), str(SOURCE), "-o", str(made)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise Failed(f"{with_what}: {(done.stderr.strip() or 'failed').splitlines()[0]}")
        made.replace(program)
    log.write_bytes(gzip.decompress(LOG.read_bytes()))
    return Limit(program, log)


def differences(one: Path, other: Path) -> dict[str, tuple[float, float]]:
    """Of north, east and down: root mean square of the difference of two tracks [m], and the ratio of their sds.

    Raises
    ------
    Failed : their keyframes are not the same
    """
    tracks = []
    for path in (one, other):
        with path.open(newline="") as file:
            tracks.append(
                [{name: float(value) for name, value in row.items() if value} for row in csv.DictReader(file)]
            )
    a, b = tracks
    if len(a) != len(b) or any(abs(p["time"] - q["time"]) > 1e-3 for p, q in zip(a, b, strict=True)):
        raise Failed(f"{len(a)} keyframes and {len(b)}, or at other times")
    out = {}
    for axis in ("north", "east", "down"):
        square = sum((p[axis] - q[axis]) ** 2 for p, q in zip(a, b, strict=True)) / len(a)
        ratios = sorted(p[f"{axis}_sd"] / q[f"{axis}_sd"] for p, q in zip(a, b, strict=True))
        out[axis] = math.sqrt(square), ratios[len(ratios) // 2]
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--beside", type=Path, help="trajectory_smoothed.csv of data/falcon")
    parser.add_argument("--runs", type=int, default=8)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        track = Path(folder) / "track.csv"
        try:
            limit = build()
            costs = [limit.cost(track) for _ in range(given.runs)]
            best = min(costs, key=lambda cost: cost.processor)
            print(f"{best.processor:.3f} s of processor time: {best.said.strip()}")
            for axis, (rms, ratio) in differences(track, given.beside).items() if given.beside else ():
                print(f"{axis}: {1e3 * rms:.1f} mm rms from {given.beside.name}, sd {ratio:.2f} times its")
        except Failed as failed:
            raise SystemExit(f"limit: left out, {failed}") from None


if __name__ == "__main__":
    main()
