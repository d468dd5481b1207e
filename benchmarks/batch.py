"""The batch solver against GTSAM's Levenberg-Marquardt, on the same graph from the same start.

    python benchmarks/batch.py                         500 s, both solvers; 4000 s, ours
    python benchmarks/batch.py --seconds 35 --long 40  a smoke test

The reference solves `DiveGraph.nonlinear()`: the same native factors, and one Python
`gtsam.CustomFactor` per measurement. Both costs are evaluated by `DiveGraph.cost` with the
gates that our solver came to rest with, so gates are left open on both sides.
Nothing is asserted: it prints a table.
"""

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import gtsam
import numpy as np

from rovgraph.inference.dead_reckoning import dead_reckon
from rovgraph.inference.graph.batch import DiveGraph, make_graph, make_values, solve
from rovgraph.inference.initialise import initialise
from rovgraph.inference.smoother import assemble
from rovgraph.log import read_log
from rovgraph.model.config import Config, beliefs, load_config
from rovgraph.simulate import Truth, scenario, simulate
from rovgraph.simulate.files import write_log

FALCON = Path(__file__).parents[1] / "rovgraph" / "model" / "falcon.yaml"
IMU_RATE, DVL_RATE = 100.0, 5.6


@dataclass(frozen=True)
class Run:
    """One solver on one graph."""

    solver: str
    seconds: float
    keyframes: int
    measurements: int
    time: float
    cost: float


def graph_of(seconds: float, config: Config) -> tuple[DiveGraph, gtsam.Values]:
    """The graph of a simulated dive, and dead reckoning to begin with."""
    truth = Truth(config, imu_rate=IMU_RATE, dvl_rate=DVL_RATE)
    dive = simulate(scenario("falcon", seconds), truth, np.random.default_rng(0))
    with TemporaryDirectory() as folder:
        write_log(dive.log_frame, Path(folder) / "log.csv")
        log = read_log(Path(folder) / "log.csv")
    smoother = assemble(log, initialise(log, config))
    b = smoother.initial
    # gates are open: Levenberg-Marquardt has none
    sensors = {name: replace(instrument, gate_sd=None) for name, instrument in b.instruments.items()}
    graph = make_graph(smoother.problem, b.prior, b.config, beliefs(b.config), sensors)
    return graph, make_values(graph, dead_reckon(smoother.problem, b, graph.unknowns.fixed))


def ours(graph: DiveGraph, values: gtsam.Values, seconds: float, repeats: int = 3) -> Run:
    """Our solver; the shortest of some runs."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        solution = solve(graph, values)
        times.append(time.perf_counter() - begin)
    return _run("rovgraph", graph, seconds, min(times), solution.cost)


def reference(graph: DiveGraph, values: gtsam.Values, seconds: float) -> Run:
    """GTSAM's Levenberg-Marquardt with its default parameters and a tight tolerance."""
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-7)
    nonlinear = graph.nonlinear()
    begin = time.perf_counter()
    result = gtsam.LevenbergMarquardtOptimizer(nonlinear, values, params).optimize()
    took = time.perf_counter() - begin
    return _run("Levenberg-Marquardt", graph, seconds, took, graph.cost(result, graph.initial_gates()))


def _run(solver: str, graph: DiveGraph, seconds: float, took: float, cost: float) -> Run:
    return Run(solver, seconds, graph.count, sum(len(b) for b in graph.blocks.values()), took, cost)


def table(runs: list[Run]) -> str:
    """The runs as a Markdown table."""
    lines = ["| solver | dive | keyframes | measurements | time | cost |", "|---|---|---|---|---|---|"]
    for r in runs:
        sizes = f"{r.seconds:.0f} s | {r.keyframes} | {r.measurements}"
        lines.append(f"| {r.solver} | {sizes} | {r.time:.2f} s | {r.cost:.6f} |")
    return "\n".join(lines)


def main(seconds: float, long: float) -> list[Run]:
    """Run and print; the runs are ours, the reference, ours on the long dive."""
    config = load_config(FALCON)
    graph, values = graph_of(seconds, config)
    mine, gtsams = ours(graph, values, seconds), reference(graph, values, seconds)
    longer = ours(*graph_of(long, config), long, repeats=2)
    runs = [mine, gtsams, longer]
    print(table(runs))
    print()
    print(f"cost, ours relative to the reference's: {(mine.cost - gtsams.cost) / gtsams.cost:+.1e}")
    print(f"speed: {gtsams.time / mine.time:.0f} times that of the reference")
    print(f"{long:.0f} s take {longer.time / mine.time:.1f} times as long as {seconds:.0f} s")
    return runs


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=500.0, help="length of the dive that both solve")
    parser.add_argument("--long", type=float, default=4000.0, help="length of the dive that ours alone solves")
    arguments = parser.parse_args()
    main(arguments.seconds, arguments.long)
