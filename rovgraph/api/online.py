"""An estimate while data arrive, from a log that is replayed: what ``rovgraph online file:LOG --speed max`` does."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from rovgraph.api.logs import given
from rovgraph.config import Config
from rovgraph.errors import InputError
from rovgraph.live.clocks import Clocks
from rovgraph.live.feed import Feed
from rovgraph.live.navigator import Navigator
from rovgraph.live.session import RATE_HZ, Session
from rovgraph.live.solution import Solution
from rovgraph.live.sources.replay import LogReplay
from rovgraph.live.warnings import Warnings
from rovgraph.log import Log

AS_FAST_AS_POSSIBLE = float("inf")
ENGINES = ("fixed-lag", "isam2")


@dataclass(frozen=True)
class Online:
    """The online estimator of a vehicle.

    Attributes
    ----------
    config : of vehicle and sensors
    rate_hz : of solutions, by the log's time
    engine : "fixed-lag", or "isam2", which smooths the whole dive as it goes
    """

    config: Config | None = None
    rate_hz: float = RATE_HZ
    engine: str = "fixed-lag"

    def __post_init__(self) -> None:
        if not 0.01 <= self.rate_hz <= 200.0:
            raise InputError(f"rate_hz {self.rate_hz:g}: between 0.01 and 200 solutions per second are expected")
        if self.engine not in ENGINES:
            raise InputError(f"engine {self.engine!r}: expected {', '.join(ENGINES)}")

    def replay(self, log: Log) -> Iterator[Solution]:
        """The solutions of a log, as if its measurements arrived now; each call starts again.

        Nothing in it is checked beforehand: sensors that fail are noticed as they fail, and solutions have the events.

        Parameters
        ----------
        log : as read with the configuration

        Raises
        ------
        InputError : a log that was read with other columns, or that allows no estimate
        """
        config = given(log, self.config)
        delays = {} if log.config is None else log.config.delay_s
        config = config.with_raw_magnetometer().model_copy(update={"delay_s": delays})  # the log holds the field
        navigator = Navigator(config, True, smooth=self.engine == "isam2", clocks=Clocks(trust=True))
        solutions: list[Solution] = []
        session = Session(navigator, [solutions.append], Warnings(), self.rate_hz)
        try:
            for message in Feed([LogReplay(log.source, _as_it_arrived(log, delays), AS_FAST_AS_POSSIBLE)]):
                session.step(message)
                yield from solutions
                solutions.clear()
            session.end()
            yield from solutions
        finally:
            navigator.close()
        if session.solution is None:
            raise InputError(f"no estimate was made: {navigator.waits_for or 'no measurement of an IMU came'}")


def _as_it_arrived(log: Log, delays: Mapping[Any, float]) -> Log:
    """A log with the stamps that its measurements came with: later than their times by what is known of it."""
    late = {name: replace(log[name], time=log[name].time + delays[name]) for name in delays if name in log}
    return replace(log, streams={**log.streams, **late})
