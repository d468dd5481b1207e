"""What is measured within a process at 27325b3; `now.py` does the same of this checkout."""

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from driver import processor, run
from rovgraph.config import Config, load_config
from rovgraph.estimators.dive import assemble, smooth
from rovgraph.estimators.error_state import RENEW_AT_S, replay
from rovgraph.estimators.initialise import initialise
from rovgraph.live.complaints import Complaints

from rovgraph.live.clocks import Clocks
from rovgraph.live.message import Message, Reading
from rovgraph.live.navigator import Navigator
from rovgraph.live.session import Session
from rovgraph.log import Log, log_from_frame, read_log
from rovgraph.simulate import Choices, simulated
from rovgraph.simulate.named import falcon


def read(log: str, config: str) -> tuple[Log, Config]:
    settings = load_config(Path(config))
    return read_log(Path(log), settings.columns, settings.units, settings.imu.mag.calibrated), settings


def filtered(*files: str) -> float:
    """Processor time of the error-state filter over what is assembled [s]."""
    log, config = read(*files)
    batch = assemble(log, initialise(log, config))
    began = processor()
    replay(batch.intervals, batch.beginning, RENEW_AT_S).solve()
    return processor() - began


def smoothed(*files: str) -> float:
    """Processor time of assembling, the optimum and its marginal covariances [s]."""
    log, config = read(*files)
    beginning = initialise(log, config)
    began = processor()
    assemble(log, beginning).solve()
    return processor() - began


def isam2(*files: str) -> float:
    """Processor time of both estimates, the smoothed one by iSAM2 [s]."""
    log, config = read(*files)
    config = config.model_copy(update={"graph": config.graph.model_copy(update={"solver": "isam2"})})
    began = processor()
    smooth(log, config, "both")
    return processor() - began


def online(kind: str, seconds: str, rate: str) -> dict[str, float]:
    """A dive at full speed; see benchmarks/online.py."""
    dive, config = simulated("lawnmower", 1, falcon(), Choices(duration=float(seconds)))
    log = log_from_frame(dive.log_frame)
    del dive
    navigator = Navigator(config, patient=True, smooth=kind == "isam2", clocks=Clocks(trust=True))
    session = Session(navigator, [], Complaints(), float(rate))
    session.receivers.append(lambda solution: navigator.passed.clear())
    began, spent = time.perf_counter(), processor()
    session.run(messages(log))
    wall = time.perf_counter() - began
    navigator.close()
    ms = 1e3 * np.array(session.took)
    return {
        "times_real_time": float(seconds) / (processor() - spent),
        "times_real_time_wall": float(seconds) / wall,
        "p99_ms": float(np.percentile(ms, 99)),
        "longest_ms": float(ms.max()),
    }


def messages(log: Log) -> Iterator[Message]:
    for m in log.measurements():
        yield Message("file", m.time, m.time, (Reading(m.sensor, m.values),))


if __name__ == "__main__":
    run({"filter": filtered, "smoother": smoothed, "isam2": isam2, "online": online})
