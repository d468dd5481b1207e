"""Alarms, advice, and the verdict that follows from them."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from rovgraph.rules import RULES, Severity

Verdict = Literal["trusted", "doubtful", "wrong"]


@dataclass(frozen=True)
class Statistic:
    """A number that is small in healthy dives, and its limits by the rule of its kind.

    Attributes
    ----------
    kind : of `RULES`
    sensor : what it is about: a stream of the log, "imu", or "dive"
    begin, end : the time that it is about [s]
    figure : the number
    cause : what is wrong, with its figures
    remedy : what to do, naming a configuration key or a command
    factor : times the rule's limits
    chance : quantile of the figure's distribution in healthy dives, beyond which both limits lie
    certain : what is "wrong" from here on, where that is less than by the rule
    """

    kind: str
    sensor: str
    begin: float
    end: float
    figure: float
    cause: str
    remedy: str
    factor: float = 1.0
    chance: float = 0.0
    certain: float = float("inf")

    @property
    def doubtful(self) -> float:
        """Beyond it the dive is doubtful, or the line is advice."""
        return max(self.factor * RULES[self.kind].doubtful, self.chance)

    @property
    def wrong(self) -> float:
        """Beyond it the dive is wrong."""
        return max(min(self.factor * RULES[self.kind].wrong, self.certain), self.chance)

    @property
    def severity(self) -> Severity | None:
        """None = within its limits."""
        return RULES[self.kind].severity(self.figure, self.doubtful, self.wrong)


@dataclass(frozen=True)
class Alarm:
    """A statistic beyond its limit.

    Attributes
    ----------
    kind, sensor, begin, end, figure : of the `Statistic`
    limit : that it is beyond
    severity : "doubtful" or "wrong"; "advice" is no evidence of error
    text : one line with cause and remedy
    """

    kind: str
    sensor: str
    begin: float
    end: float
    figure: float
    limit: float
    severity: Severity
    text: str


def alarm_of(statistic: Statistic) -> Alarm | None:
    """The alarm or the advice that a statistic raises, if it does."""
    s, severity = statistic, statistic.severity
    if severity is None:
        return None
    limit = s.wrong if severity == "wrong" else s.doubtful
    return Alarm(s.kind, s.sensor, s.begin, s.end, s.figure, limit, severity, f"{s.sensor}: {s.cause}; {s.remedy}")


def verdict_of(alarms: Iterable[Alarm]) -> Verdict:
    """The worst of their severities; "trusted" where none is evidence of error."""
    severities = {alarm.severity for alarm in alarms}
    return "wrong" if "wrong" in severities else "doubtful" if "doubtful" in severities else "trusted"
