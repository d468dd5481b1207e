"""What a question for the joint covariance of two times costs, after an hour's dive and after one of eight hours.

    python benchmarks/joint_covariance.py --hours 1 8

The Falcon's sensors at their rates (IMU 100 Hz, DVL 5.6 Hz), simulated. Each dive is smoothed in a process of its own.
It prints the processor time of the first question, which eliminates the dive once more, and those of later ones at two
random times, and the most memory before and after. Targets: 50 ms a question for an hour, 3 s for eight hours.
"""

import argparse
import math
import multiprocessing
import re
import time
import warnings
from pathlib import Path

import numpy as np

import rovgraph as rg
from rovgraph.process import limit_threads_and_gc
from rovgraph.simulate import choices

FALCON = Path(__file__).parents[1] / "data" / "falcon" / "config.yaml"
QUESTIONS, LONG_QUESTIONS = 200, 5


def peak_gb() -> float:
    """The most memory of this process so far."""
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return float(found[1]) / 1e6 if found else math.nan


def measure(hours: float) -> None:
    """Simulate, smooth, ask and print."""
    limit_threads_and_gc()  # as the command does
    choices.DURATION_MAX = math.inf
    dive = rg.simulate("lawnmower", rg.load_config(FALCON), seed=1, choices=rg.Choices(duration=3600.0 * hours))
    log, config = dive.log, dive.config
    del dive
    began, cpu = time.perf_counter(), time.process_time()
    estimate = rg.smooth(log, config, estimate="smoothed").smoothed
    solved, solved_cpu, before = time.perf_counter() - began, time.process_time() - cpu, peak_gb()
    t = estimate.trajectory.time
    rng, spent = np.random.default_rng(1), []
    for _ in range(1 + (QUESTIONS if hours <= 1.0 else LONG_QUESTIONS)):
        first, second = rng.uniform(t[0], t[-1], 2)
        began = time.process_time()
        estimate.joint(first, second)
        spent.append(time.process_time() - began)
    later = 1e3 * np.array(spent[1:])
    median, most = np.median(later), np.percentile(later, 95)
    solving = f"{solved:.1f} s, {solved_cpu:.1f} s"
    asking = f"{spent[0]:.2f} s | {median:.1f} ms | {most:.1f} ms | {later.max():.1f} ms"
    memory = f"{before:.2f} GB | {peak_gb():.2f} GB"
    print(f"| {hours:g} h | {len(t)} | {solving} | {asking} | {memory} |", flush=True)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, nargs="+", default=[1.0, 8.0])
    warnings.simplefilter("ignore")
    print("| dive | keyframes | smooth: wall, processor | first | median | 95 % | longest | memory before | after |")
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    for hours in parser.parse_args().hours:
        process = multiprocessing.get_context("spawn").Process(target=measure, args=(hours,))
        process.start()
        process.join()


if __name__ == "__main__":
    main()
