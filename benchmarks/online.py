"""The online mode: does it keep up? Figures are in benchmarks/README.md.

python benchmarks/online.py engine fixed-lag --seconds 3600
python benchmarks/online.py engine isam2 --seconds 3600
python benchmarks/online.py agreement
python benchmarks/online.py shuffled
python benchmarks/online.py log LOG --config CONFIG --reference REFERENCE --after 600
"""

import argparse
import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rovgraph.dive import smooth
from rovgraph.geometry import log_rotation, transpose
from rovgraph.lab.evaluate import evaluate, read_reference
from rovgraph.live.clocks import Clocks
from rovgraph.live.message import Message, Reading
from rovgraph.live.navigator import Navigator
from rovgraph.live.session import RATE_HZ, Session
from rovgraph.live.solution import Solution
from rovgraph.live.warnings import Warnings
from rovgraph.log import Log, read_log
from rovgraph.model.config import load_config
from rovgraph.simulate import Choices, simulated
from rovgraph.simulate.named import falcon

SHIPPED = Path(__file__).parents[1] / "data" / "falcon"


def messages(log: Log, order: np.ndarray | None = None) -> Iterator[Message]:
    """What a file says, at once; in another order where one is given."""
    measurements = log.measurements() if order is None else map(list(log.measurements()).__getitem__, order.tolist())
    for m in measurements:
        yield Message("file", m.time, m.time, (Reading(m.sensor, m.values),))


def processor() -> float:
    """Processor time of this process and of its children that have ended [s]."""
    spent = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(s.ru_utime + s.ru_stime for s in spent)


def resident_mb() -> float:
    """Memory of this process now [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


@dataclass(frozen=True)
class Replay:
    """A dive at full speed.

    Attributes
    ----------
    seconds : of the dive
    wall, processor : what it took, processor time of all processes [s]
    update_ms : what each update took, shape (n,)
    waited : for the thread that smooths, as only a replay does [s]
    memory_mb : of this process, in each quarter
    """

    seconds: float
    wall: float
    processor: float
    update_ms: np.ndarray
    waited: float
    memory_mb: dict[int, float]


def replay(kind: str, seconds: float, seed: int, rate: float) -> Replay:
    """Replay a simulated dive through the navigator.

    Parameters
    ----------
    kind : "fixed-lag" or "isam2"
    seconds : of the dive
    rate : solutions a second of the dive
    """
    dive, config = simulated("lawnmower", seed, falcon(), Choices(duration=seconds))
    log = Log.from_frame(dive.log_frame)
    del dive
    navigator = Navigator(config, patient=True, smooth=kind == "isam2", clocks=Clocks(trust=True))
    session = Session(navigator, [], Warnings(), rate)
    begin, memory = float(log["imu"].time[0]), {}

    def watch(solution: Solution) -> None:
        navigator.passed.clear()  # with --out it goes to a file
        if session.solutions % 50 == 0:  # looking costs a tenth of a millisecond
            memory[int(4 * (solution.time - begin) / seconds)] = resident_mb()

    session.receivers.append(watch)
    began, spent = time.perf_counter(), processor()
    session.run(messages(log))
    wall = time.perf_counter() - began
    navigator.close()
    return Replay(seconds, wall, processor() - spent, 1e3 * np.array(session.took), navigator.waited, memory)


def engine(kind: str, seconds: float, seed: int, rate: float) -> None:
    """A dive at full speed: what an update takes, and whether time and memory grow."""
    done = replay(kind, seconds, seed, rate)
    ms, memory = done.update_ms, done.memory_mb
    quarters = [float(part.mean()) for part in np.array_split(ms, 4)]
    print(f"{kind}, {rate:g} solutions a second, {len(ms)} updates")
    print(f"{seconds:.0f} s in {done.wall:.1f} s, {seconds / done.wall:.0f} times real time")
    print(f"processor time of all processes {done.processor:.1f} s, {seconds / done.processor:.0f} times real time")
    print(f"update: mean {ms.mean():.2f} ms, p99 {np.percentile(ms, 99):.1f} ms, max {ms.max():.0f} ms")
    print(f"mean by quarter: {np.round(quarters, 2)} ms; the last is {quarters[3] / quarters[1]:.2f} times the second")
    print(f"waited for the thread that smooths, as only a replay does: {done.waited:.1f} s")
    print(f"longest: {np.sort(ms)[-10:].round()} ms")
    print(f"memory: {memory[1]:.0f} MB at half, {memory[3]:.0f} MB at the end, {memory[3] / memory[1] - 1:+.1%}")


def agreement() -> None:
    """iSAM2's last trajectory against the batch smoother's, on the dive that ships."""
    config = load_config(SHIPPED / "config.yaml")
    log = read_log(SHIPPED / "log.csv.gz", config)
    isam2 = config.model_copy(update={"graph": config.graph.model_copy(update={"solver": "isam2"})})
    a, b = (smooth(log, c, "smoothed").estimates[0].trajectory for c in (config, isam2))
    apart = np.linalg.norm(a.p_n - b.p_n, axis=1).max()
    turned = np.rad2deg(np.linalg.norm(log_rotation(transpose(a.R_nb) @ b.R_nb), axis=1).max())
    print(f"iSAM2 and batch differ by at most {1e3 * apart:.2f} mm and {turned:.4f} deg")


def shuffled(seed: int) -> None:
    """The shipped dive with arrivals shuffled within 300 ms."""
    config = load_config(SHIPPED / "config.yaml")
    log = read_log(SHIPPED / "log.csv.gz", config.as_recorded())
    stamps = np.array([m.time for m in log.measurements()])
    order = np.argsort(stamps + np.random.default_rng(seed).uniform(0.0, 0.3, len(stamps)))
    ends = []
    for o in (None, order):
        navigator = Navigator(config, patient=True, clocks=Clocks(trust=True))
        for message in messages(log, o):
            navigator.take(message)
        navigator.finish()
        known = navigator.passed[-1].known
        ends.append((known.state.p_n[0], known.P[3:6, 3:6]))
    print(f"final position differs by {1e3 * np.linalg.norm(ends[0][0] - ends[1][0]):.6f} mm")


def recorded(path: Path, config_path: Path, reference: Path, after: float) -> None:
    """A recorded dive at full speed."""
    config = load_config(config_path)
    log = read_log(path, config.as_recorded())
    navigator = Navigator(config, patient=True, clocks=Clocks(trust=True))
    session = Session(navigator, [], Warnings(), RATE_HZ)
    began = time.perf_counter()
    session.run(messages(log))
    wall = time.perf_counter() - began
    assert navigator.engine is not None
    marks = navigator.passed
    trajectory = navigator.engine.trajectory([m.interval for m in marks], [m.known for m in marks])
    result = evaluate(trajectory, read_reference(reference), start=after)
    seconds = float(log["imu"].time[-1] - log["imu"].time[0])
    print(f"{seconds:.0f} s in {wall:.1f} s, {seconds / wall:.0f} times real time")
    print(result)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["engine", "agreement", "shuffled", "log"])
    parser.add_argument("which", nargs="?", default="fixed-lag", help="fixed-lag or isam2; or a log")
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--rate", type=float, default=RATE_HZ, help="solutions a second of the dive")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--reference", type=Path)
    parser.add_argument("--after", type=float, default=0.0, help="errors are taken from this long after the start [s]")
    given = parser.parse_args()
    if given.what == "engine":
        engine(given.which, given.seconds, given.seed, given.rate)
    elif given.what == "agreement":
        agreement()
    elif given.what == "shuffled":
        shuffled(given.seed)
    else:
        recorded(Path(given.which), given.config, given.reference, given.after)


if __name__ == "__main__":
    main()
