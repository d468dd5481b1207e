"""What an alarm is, and the verdict that alarms come to."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Severity = Literal["doubtful", "wrong"]
Verdict = Literal["trusted", "doubtful", "wrong"]


@dataclass(frozen=True)
class Statistic:
    """A number that healthy dives keep small.

    Attributes
    ----------
    kind : row of the table in docs/alarms.md, as "rejected"
    sensor : what it is about: a stream of the log, "imu", or "dive"
    begin, end : the time that it is about [s]
    figure : the number
    doubtful, wrong : limits; beyond them the dive is doubtful, or wrong
    cause : what is so, with its figures
    remedy : what to do, naming a configuration key or a command
    """

    kind: str
    sensor: str
    begin: float
    end: float
    figure: float
    doubtful: float
    wrong: float
    cause: str
    remedy: str

    @property
    def severity(self) -> Severity | None:
        """None = within its limits."""
        if self.figure > self.wrong:
            return "wrong"
        return "doubtful" if self.figure > self.doubtful else None


@dataclass(frozen=True)
class Alarm:
    """A statistic beyond its limit.

    Attributes
    ----------
    kind, sensor, begin, end, figure : of the `Statistic`
    limit : that it is beyond
    severity : "doubtful" or "wrong"
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
    """The alarm that a statistic raises, if it does."""
    s = statistic
    if s.severity is None:
        return None
    limit = s.wrong if s.severity == "wrong" else s.doubtful
    return Alarm(s.kind, s.sensor, s.begin, s.end, s.figure, limit, s.severity, f"{s.sensor}: {s.cause}; {s.remedy}")


def verdict_of(alarms: Iterable[Alarm]) -> Verdict:
    """The worst of their severities; "trusted" where there is none."""
    severities = {alarm.severity for alarm in alarms}
    return "wrong" if "wrong" in severities else "doubtful" if severities else "trusted"
