"""When the filter is renewed by the second process."""

import time as host
from dataclasses import dataclass, field

from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.errors import InputError
from rovgraph.estimators.filter_step import Gaussian
from rovgraph.estimators.fixed_lag import FixedLag
from rovgraph.estimators.refiner import Refiner, due_times
from rovgraph.log import Measurement


@dataclass
class Reinitialisations:
    """Asks the second process for better estimates, and hands them to the filter.

    Attributes
    ----------
    patient : wait for an answer, so that a replay can be repeated
    lag_s : of the engine; the second process has nothing younger [s]
    news : what went wrong, one line each, since it was last emptied
    waited : for answers, which only a replay does that is faster than the second process [s]
    """

    patient: bool
    lag_s: float
    news: list[str] = field(default_factory=list)
    waited: float = 0.0

    def __post_init__(self) -> None:
        self._refiner: Refiner | None = Refiner(learn_noise=True)
        self._due = due_times(self.lag_s)
        self._start: float | None = None

    def begin(self, beginning: InitialConditions) -> None:
        """The beginning of the dive, before all else."""
        if self._refiner is not None:
            self._refiner.begin(beginning)

    def take(self, measurements: list[Measurement]) -> None:
        """Hand on what is settled."""
        if self._refiner is not None:
            self._refiner.take(measurements)

    def step(self, engine: FixedLag) -> float:
        """After a keyframe of the engine; the time waited for answers, as only a fast replay does [s]."""
        before, refiner = self.waited, self._refiner
        if refiner is None:
            return 0.0
        if self._start is None:
            self._start = engine.marks[0].interval.time
        try:
            if not refiner.asked and engine.marks[-1].interval.time - self._start >= self._due[0]:
                self._ask(refiner, engine)
            if refiner.asked and (answer := self._answer(refiner)) is not None:
                if engine.adopt(*answer):
                    self._due.pop(0)
                    refiner.served()
                else:
                    self._ask(refiner, engine)  # the lag has passed that keyframe; the next answer comes at once
        except InputError as error:
            self.news.append(str(error))
            self.close()
        if not self._due:
            self.close()
        return self.waited - before

    def _answer(self, refiner: Refiner) -> tuple[int, Gaussian] | None:
        began = host.perf_counter()
        answer = refiner.answer(wait=self.patient)
        self.waited += host.perf_counter() - began
        return answer

    def close(self) -> None:
        """End the process."""
        if self._refiner is not None:
            self._refiner.close()
            self._refiner = None

    @staticmethod
    def _ask(refiner: Refiner, engine: FixedLag) -> None:
        """For the oldest keyframe that the filter can go on from."""
        engine.settle()
        refiner.ask(engine.oldest().interval.index)
