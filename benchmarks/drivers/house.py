"""What house.py counts and times within a process, of any checkout from 07f9a06 on."""

import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any

from driver import run

import rovgraph as rg
from rovgraph.live.clocks import Clocks
from rovgraph.live.message import Message, Reading
from rovgraph.live.navigator import Navigator
from rovgraph.log import Log
from rovgraph.simulate import Choices, simulated
from rovgraph.simulate.named import falcon

try:
    from rovgraph.inference.fixed_lag import FixedLag
    from rovgraph.inference.initialise import initialise
except ImportError:  # until the packages were made anew
    from rovgraph.estimators.eskf.fixed_lag import FixedLag
    from rovgraph.estimators.initialise import initialise

Counts = dict[str, Any]


def dive(seconds: str) -> tuple[Log, Any, int]:
    """A dive of the Falcon, its configuration and the number of its pings."""
    made, config = simulated("lawnmower", 1, falcon(), Choices(duration=float(seconds)))
    log = Log.from_frame(made.log_frame)
    return log, config, len(log["dvl"])


@contextmanager
def counted() -> Iterator[Counter[str]]:
    """Instances of the package's classes that this thread makes meanwhile, by class.

    Every way that Python code of a class, or of `copy`, begins an instance: an ``__init__`` of its own or of a
    dataclass, the ``__new__`` and ``_make`` of a named tuple, the ``__newobj__`` by which `copy` makes a twin. Classes
    with neither are not seen; the package makes none by ``object.__new__``.
    """
    made: Counter[str] = Counter()

    def watch(frame: FrameType, event: str, _: object) -> None:
        if event != "call":
            return
        code = frame.f_code
        if code.co_name == "__init__":
            own = type(frame.f_locals[code.co_varnames[0]]) if code.co_argcount else None
            if own is None or getattr(own.__init__, "__code__", None) is not code:  # of a parent: counted already
                return
        elif code.co_name in ("_make", "__newobj__") or (code.co_name == "<lambda>" and "_cls" in frame.f_locals):
            own = frame.f_locals[code.co_varnames[0]]
        else:
            return
        if own.__module__.startswith("rovgraph"):
            made[f"{own.__module__}.{own.__qualname__}"] += 1

    sys.setprofile(watch)
    try:
        yield made
    finally:
        sys.setprofile(None)


def plain(seconds: str) -> dict[str, int]:
    """Modules that a plain `smooth` enters, its calls from one function of the package to another, and those of them
    that cross a module's border.

    All is imported and cached before. Comprehensions and generator expressions are no functions here.
    """
    made, config = simulated("lawnmower", 1, falcon(), Choices(duration=float(seconds)))
    package = str(Path(rg.__file__).parent)
    entered: set[str] = set()
    calls: Counter[bool] = Counter()

    def watch(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event != "call" or code.co_name.startswith("<") or not code.co_filename.startswith(package):
            return
        entered.add(code.co_filename)
        caller = frame.f_back.f_code.co_filename if frame.f_back else ""
        if caller.startswith(package):
            calls[caller != code.co_filename] += 1
        else:
            calls[False] += 1

    with TemporaryDirectory() as folder:
        log = Path(folder) / "log.csv"
        made.log_frame.to_csv(log, index=False)
        for turn in ("first", "second"):
            sys.setprofile(watch if turn == "second" else None)
            try:
                rg.smooth(rg.read_log(log, config), config).save(Path(folder) / turn, figures=False, page=False)
            finally:
                sys.setprofile(None)
    return {"modules": len(entered), "calls": calls.total(), "crossing": calls[True]}


def write(seconds: str, path: str) -> None:
    """The log of a dive."""
    made, _ = simulated("lawnmower", 1, falcon(), Choices(duration=float(seconds)))
    made.log_frame.to_csv(path, index=False)


def offline(seconds: str) -> Counts:
    """Instances that a whole `smooth` makes."""
    log, config, pings = dive(seconds)
    with counted() as made:
        rg.smooth(log, config)
    return {"pings": pings, "made": made}


def navigator(seconds: str) -> Counts:
    """Instances that the navigator makes of messages, with them; of its own thread."""
    log, config, pings = dive(seconds)
    nav = Navigator(config, patient=True, clocks=Clocks(trust=True))
    with counted() as made:
        for m in log.measurements():
            nav.take(Message("file", m.time, m.time, (Reading(m.sensor, m.values),)))
    nav.close()
    return {"pings": pings, "made": made}


def filter_of(log: Log, config: Any) -> FixedLag:
    """As the navigator makes it."""
    initial = initialise(log, config)
    own = initial.config
    return FixedLag(initial, own.graph.lag_s, own.online.hold_s, learn_noise=True)


def live(seconds: str) -> Counts:
    """Instances that the fixed-lag filter makes of measurements."""
    log, config, pings = dive(seconds)
    engine, measurements = filter_of(log, config), list(log.measurements())
    with counted() as made:
        for m in measurements:
            engine.add(m)
    return {"pings": pings, "made": made}


def timed(seconds: str, times: str) -> list[float]:
    """Time of the fixed-lag filter over a dive, of each of some times [µs a keyframe]."""
    log, config, _ = dive(seconds)
    measurements, took = list(log.measurements()), []
    for _ in range(int(times) + 1):  # the first one warms up
        passed: list[object] = []
        engine = filter_of(log, config)
        engine.passed = passed.append
        began = time.process_time()
        for m in measurements:
            engine.add(m)
        spent = time.process_time() - began
        engine.finish()
        took.append(1e6 * spent / len(passed))
    return took[1:]


if __name__ == "__main__":
    commands: dict[str, Callable[..., Any]] = {"plain": plain, "write": write, "offline": offline}
    run({**commands, "navigator": navigator, "live": live, "timed": timed})
