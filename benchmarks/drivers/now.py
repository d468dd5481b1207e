"""What is measured within a process of this checkout; `at_27325b3.py` does the same at that commit."""

import math
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
from driver import processor, run

sys.path.insert(0, str(Path(__file__).parents[1]))
from online import falcon, replay

from rovgraph.dive import smooth
from rovgraph.inference.error_state import REINITIALISE_AT_S
from rovgraph.inference.error_state import replay as replay_filter
from rovgraph.inference.initialise import initialise
from rovgraph.inference.smoother import assemble
from rovgraph.log import Log, read_log
from rovgraph.model.config import Config, load_config
from rovgraph.process import limit_threads_and_gc
from rovgraph.simulate import Choices, choices, simulated
from rovgraph.simulate.files import write_log


def read(log: str, config: str) -> tuple[Log, Config]:
    settings = load_config(Path(config))
    return read_log(Path(log), settings), settings


def filtered(*files: str) -> float:
    """Processor time of the error-state filter over what is assembled [s]."""
    log, config = read(*files)
    batch = assemble(log, initialise(log, config))
    began = processor()
    replay_filter(batch.problem, batch.initial, REINITIALISE_AT_S).solve()
    return processor() - began


def smoothed(*files: str) -> float:
    """Processor time of assembling, the optimum and its marginal covariances [s]."""
    log, config = read(*files)
    initial = initialise(log, config)
    began = processor()
    assemble(log, initial).solve()
    return processor() - began


def isam2(*files: str) -> float:
    """Processor time of both estimates, the smoothed one by iSAM2 [s]."""
    log, config = read(*files)
    config = config.model_copy(update={"graph": config.graph.model_copy(update={"solver": "isam2"})})
    import_module("rovgraph.inference.graph.isam2")  # and GTSAM, which 27325b3 imports with all else
    began = processor()
    smooth(log, config, "both")
    return processor() - began


def online(kind: str, seconds: str, rate: str) -> dict[str, float]:
    """A dive at full speed; see benchmarks/online.py."""
    done = replay(kind, float(seconds), 1, float(rate))
    return {
        "times_real_time": done.seconds / done.processor,
        "times_real_time_wall": done.seconds / done.wall,
        "p99_ms": float(np.percentile(done.update_ms, 99)),
        "longest_ms": float(done.update_ms.max()),
    }


def simulate(seconds: str, path: str) -> int:
    """Write the log of a simulated dive; returns the number of its rows."""
    choices.DURATION_MAX = math.inf
    dive, _ = simulated("lawnmower", 1, falcon(), Choices(duration=float(seconds)))
    write_log(dive.log_frame, Path(path))
    return len(dive.log_frame)


def chain(keyframes: str) -> dict[str, float]:
    """Processor time a keyframe of ours, LAPACK's, and the fastest that GTSAM has of rovgraph's graph [µs]."""
    from chain import speed

    spent = speed(int(keyframes), border=False)
    gtsam = min(time for name, time in spent.items() if name.startswith("GTSAM, three keys"))
    return {"rovgraph": spent["chain"], "solveh_banded": spent["solveh_banded"], "gtsam": gtsam}


if __name__ == "__main__":
    limit_threads_and_gc()  # as the command does
    measures = {"filter": filtered, "smoother": smoothed, "isam2": isam2, "online": online}
    run({**measures, "simulate": simulate, "chain": chain})
