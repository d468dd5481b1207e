"""What often repeated work costs, beside a reference that does the like in the same process.

    python benchmarks/overheads.py
    python benchmarks/overheads.py --rows recorder replay

Processor time, the least of some runs that alternate with the reference's. Nothing is asserted:
it prints a table with the most that a ratio should be.
"""

import argparse
import hashlib
import io
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import repeat
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd

from rovgraph.diagnosis.evidence import Evidence
from rovgraph.diagnosis.statistics import statistics
from rovgraph.inference.chain_optimum import ChainOptimum
from rovgraph.inference.initialise import initialise
from rovgraph.inference.smoother import assemble, smoothed
from rovgraph.lab.thesis import FILTERS, FilterJob, run_filters
from rovgraph.lab.thesis.processes import length
from rovgraph.lab.thesis.setup import prepare
from rovgraph.live.alarms import LiveAlarms
from rovgraph.live.clocks import Clocks
from rovgraph.live.files import Recorder, write_checkpoint
from rovgraph.live.message import Message, Reading
from rovgraph.live.navigator import Navigator
from rovgraph.live.session import Feed
from rovgraph.live.sources import open_source
from rovgraph.log import STREAMS, Log, Stream, read_log
from rovgraph.simulate import Choices, simulated
from rovgraph.simulate.named import falcon

RUNS = 5
Work = Callable[[], object]


@dataclass(frozen=True)
class Pair:
    """Ours and the reference.

    Attributes
    ----------
    what, beside : what each does
    ours, reference : run once, both
    most : ratio of processor times that should not be exceeded
    share : parts that ours is made of, where the reference is one of them
    """

    what: str
    beside: str
    ours: Work
    reference: Work
    most: float
    share: int = 1

    def measure(self) -> str:
        """A row of the table."""
        spent: list[list[float]] = [[], []]
        for _ in range(RUNS):
            for times, work in zip(spent, (self.ours, self.reference), strict=True):
                began = time.process_time()
                work()
                times.append(time.process_time() - began)
        ours, reference = min(spent[0]) / self.share, min(spent[1])
        cells = [self.what, f"{1e3 * ours:.3g} ms", self.beside, f"{1e3 * reference:.3g} ms"]
        return f"| {' | '.join(cells)} | {ours / reference:.2g} | {self.most:g} |"


def imu_log(n: int) -> Log:
    """Samples at 200 Hz and a depth each tenth."""
    streams = {}
    for name, rows, dt in (("imu", n, 0.005), ("depth", n // 10, 0.05)):
        data = np.random.default_rng(0).normal(size=(rows, len(STREAMS[name])))
        streams[name] = Stream(name, STREAMS[name], dt * np.arange(rows), data, np.arange(rows))
    return Log("x", streams)


def drain(items: object) -> None:
    for _ in items:  # type: ignore[attr-defined]
        pass


def thesis_filter(folder: Path) -> list[Pair]:
    """Twelve seconds of a dive; and fifteen filters in one pass."""
    dive, config = simulated("lawnmower", 1, falcon(), Choices(duration=120.0))
    frame = dive.log_frame
    log = Log.from_frame(frame[frame["time"] < frame["time"].iloc[0] + 12.0])
    pairs = []
    for name in ("4.3a", "4.4a", "4.5"):
        n = length(prepare(FILTERS[name], log, config).places)
        asked = [FilterJob(FILTERS[name], log, config)]
        pairs.append(
            Pair(
                f"filter {name}, 12 s", f"textbook Kalman filter of {n} states in NumPy",
                lambda asked=asked: run_filters(asked), lambda n=n: textbook(n, len(log["imu"])), 5.5,
            )
        )  # fmt: skip
    one, many = ([FilterJob(FILTERS["4.3a"], log, config)] * count for count in (1, 15))
    side_by_side = Pair(
        "fifteen filters side by side, each", "one alone",
        lambda: run_filters(many), lambda: run_filters(one), 2.0 / 3.0, share=15,
    )  # fmt: skip
    return [*pairs, side_by_side]


def textbook(n: int, steps: int, measured: int = 9) -> None:
    """Predict and update, a sample at a time."""
    F, H, Q, R = np.eye(n) + 1e-3, np.eye(n)[:measured], 1e-6 * np.eye(n), np.eye(measured)
    x, P = np.zeros(n), np.eye(n)
    for _ in range(steps):
        x, P = F @ x / (n + 1), F @ P @ F.T / n + Q
        S = H @ P @ H.T + R
        K = np.linalg.solve(S, H @ P).T
        x = x + K @ (np.ones(measured) - H @ x)
        P = (np.eye(n) - K @ H) @ P
        P = 0.5 * (P + P.T)


def log_reading(folder: Path) -> list[Pair]:
    """Measurements in the order of time, and a file."""
    log = imu_log(200_000)
    path = folder / "log.csv"
    frame = pd.DataFrame(log["imu"].data[:50_000], columns=list(STREAMS["imu"]))
    frame.insert(0, "time", log["imu"].time[:50_000])
    frame.to_csv(path, index=False)
    return [
        Pair("220 000 measurements in order", "tuples in a sorted list",
             lambda: drain(log.measurements()), lambda: sorted(tuples(log), key=itemgetter(0)), 3.0),
        Pair("a log of 50 000 rows", "pandas.read_csv", lambda: read_log(path), lambda: pd.read_csv(path), 4.0),
    ]  # fmt: skip


def tuples(log: Log) -> Iterator[tuple[object, ...]]:
    for name in log.sensors:
        stream = log[name]
        yield from zip(stream.time.tolist(), repeat(name), stream.data, stream.row.tolist(), strict=False)


def recorder(folder: Path) -> list[Pair]:
    """A row of the recording."""
    recording = Recorder(folder / "recording.csv")
    values = np.random.default_rng(0).normal(size=(1000, 6))
    times = (1.7e9 + 0.01 * np.arange(1000)).tolist()
    rows = [(t, [Reading("imu", v)]) for t, v in zip(times, values, strict=True)]
    return [
        Pair("1000 rows recorded", "as JSON",
             lambda: [recording.write(t, t, readings) for t, readings in rows],
             lambda: [json.dumps([t, t, *v.tolist()]) for t, v in zip(times, values, strict=True)], 1.3),
    ]  # fmt: skip


def checkpoint(folder: Path) -> list[Pair]:
    """300 kB; the disk is waited for, which takes no processor time."""
    state = {"blocks": [{"k": k, "cov": np.random.default_rng(k).normal(size=(30, 25))} for k in range(50)]}

    def reference() -> None:
        file = io.BytesIO()
        np.savez(file, *(block["cov"] for block in state["blocks"]))
        hashlib.sha256(file.getvalue()).hexdigest()

    return [Pair("a checkpoint of 50 arrays", "numpy.savez and SHA-256",
                 lambda: write_checkpoint(folder / "checkpoint", state), reference, 1.7)]  # fmt: skip


def replay(folder: Path) -> list[Pair]:
    """Messages of a file as fast as it goes."""
    frame = pd.DataFrame(imu_log(20_000)["imu"].data, columns=list(STREAMS["imu"]))
    frame.insert(0, "time", 0.005 * np.arange(20_000))
    path = folder / "replay.csv"
    frame.to_csv(path, index=False)
    return [
        Pair("20 000 messages replayed", "rows of the frame as tuples",
             lambda: drain(Feed([open_source(f"file:{path}?speed=max")])),
             lambda: drain(pd.read_csv(path).itertuples()), 6.0),
    ]  # fmt: skip


def alarms(folder: Path) -> list[Pair]:
    """The verdict on a dive, and its alarms while it goes on."""
    dive, config = simulated("lawnmower", 1, falcon(), Choices(duration=120.0))
    log = Log.from_frame(dive.log_frame)
    smoother = assemble(log, initialise(log, config))
    best = smoother.optimum()
    assert isinstance(best, ChainOptimum)
    evidence = Evidence(smoother.initial, [smoothed(best, smoother.initial)], best.problem, best, [], log)
    messages = [Message("log", m.time, m.time, (Reading(m.sensor, m.values),)) for m in log.measurements()]
    keyframes: list[tuple[Any, ...]] = []

    class Kept(LiveAlarms):
        """Keeps what it is given."""

        def passed(self, *given: Any) -> None:
            keyframes.append(given)
            super().passed(*given)

    def estimate(alarms: LiveAlarms) -> None:
        navigator = Navigator(config, patient=True, clocks=Clocks(trust=True), alarms=alarms)
        drain(map(navigator.take, messages))

    def look(alarms: LiveAlarms) -> None:
        for given in keyframes:
            alarms.passed(*given)

    estimate(Kept())
    return [
        Pair("statistics of 120 s", "one elimination of the chain", lambda: statistics(evidence),
             lambda: best.chain.eliminate(best.state, best.solution.gates), 8.0),
        Pair("live alarms of 120 s", "the live estimate with them", lambda: look(LiveAlarms()),
             lambda: estimate(LiveAlarms()), 0.05),
    ]  # fmt: skip


ROWS = {
    "alarms": alarms,
    "filter": thesis_filter,
    "log": log_reading,
    "recorder": recorder,
    "checkpoint": checkpoint,
    "replay": replay,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS), metavar="ROW", help=", ".join(ROWS))
    given = parser.parse_args()
    print("| what | takes | beside | takes | ratio | at most |")
    print("|---|---|---|---|---|---|")
    with TemporaryDirectory() as folder:
        for name in given.rows:
            for pair in ROWS[name](Path(folder)):
                print(pair.measure(), flush=True)


if __name__ == "__main__":
    main()
