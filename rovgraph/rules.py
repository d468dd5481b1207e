"""The rule book: limits and remedies of all that can be wrong with a dive, before, in and after its estimate.

`RULES` are the figures of the verdict, with their limits and how often they err (docs/alarms.md prints it),
`COMPARISONS` those of two sensors by their motion, in a log and live (docs/check.md). Where one question has several
numbers, they stand here beside each other, with the reason. `rovgraph.log.frozen.HOLDS` is the table of frozen sensors.

A figure beyond ``doubtful`` or ``wrong`` is an alarm, and the worst alarm is the verdict. A figure better than stated
is advice: it is no evidence of error, and no part of the verdict.
"""

from dataclasses import dataclass
from math import inf, isfinite
from typing import Literal, NamedTuple

from rovgraph.log.frozen import HOLD
from rovgraph.log.frozen import SURE as SURE
from rovgraph.log.reading import delay_of
from rovgraph.model.config import Config

Severity = Literal["advice", "doubtful", "wrong"]

BELIEVED_SDS = 3.0  # of what the configuration believes to be uncertain, within which that explains an error
CLIPPED = 4.0  # times the median residual, which counts no more
CHANCE = 1e-6  # that a figure of a healthy sensor is beyond a limit that is a quantile of its distribution
USUAL_SHARE = 0.01  # of outliers, that every DVL and USBL has
CONTRADICTED = 0.1  # of a sensor's measurements, rejected: its axes, or a mounting that is held, may be the cause
BENT = 0.3  # of the same: what would let it in again, residuals and gates do not show
SETTLED_S = 10.0  # of a dive, before which its filter is not asked
# without a measurement, the longer of the two: an event for a person live; `log.streams.GAP_PERIODS` are a gap of a log
SILENT_S, SILENT_PERIODS = 3.0, 10.0
EPOCH_SD_S = 0.5  # of what motion shows of clocks that are any time apart, to be believed

START_REMEDY = (
    "correct start.north_m and start.east_m, or leave them to the first fix; check the fixes' origin and, of a USBL, "
    "the ship's heading; or raise start.position_sd_m"
)


class MotionLimits(NamedTuple):
    """When two sensors show one motion, in a log or live, and when the stamps of one are late.

    Attributes
    ----------
    compared : what of both
    follows : agreement or correlation of one motion, at most 1
    lag_s, sds : from which on a lag is said: itself [s], and in its own sds
    evidence : in chi-square, that the lag explains
    reach_s : largest lag that is searched for [s]
    """

    compared: str
    follows: float
    lag_s: float
    sds: float
    evidence: float
    reach_s: float

    def is_late(self, lag: float, sd: float, believed: tuple[float, float]) -> bool:
        """Whether a lag is neither what is believed, a mean and its sd, nor chance [s]."""
        off = abs(lag - believed[0])
        return off > max(self.lag_s, BELIEVED_SDS * believed[1]) and off > self.sds * sd


FOLLOWS, REACH_S = 0.7, 300.0  # correlation of changes within windows, and how far these are shifted [s]
# pings are fitted one by one, so a small lag stands out
ACCELERATION = MotionLimits("acceleration by DVL and IMU", 0.65, 0.05, SURE, 30.0, REACH_S)
# windows of seconds show no small lag; their sd comes from leaving out parts of the dive
TURNING = MotionLimits("turning by compass and gyro", FOLLOWS, 0.3, 3.0, 2.0, REACH_S)
DESCENT = TURNING._replace(compared="descent by DVL and depth", evidence=12.0)  # waves are alike after a period
# fixes are seldom, and scatter
TRACK = MotionLimits("track by DVL and fixes", 0.6, 0.5, SURE, 40.0, 60.0)
# a lag moves the ship as well; systems are up to 3 s late, and at most a second early
ACOUSTIC_TRACK = TRACK._replace(compared="track by DVL and acoustic positions", lag_s=0.3, reach_s=5.0)
COMPARISONS = (ACCELERATION, TURNING, DESCENT, TRACK, ACOUSTIC_TRACK)


@dataclass(frozen=True)
class Rule:
    """A figure that healthy dives keep small.

    Attributes
    ----------
    kind : name, as in summary.json
    figure : what the number is
    doubtful, wrong : limits; infinite = never
    rate : share of healthy dives in which chance takes the figure beyond the lower limit, that it was set to
    live : how `rovgraph online` has it; empty = not at all
    advice : the figure says that something is better than stated, which is advice
    looks : live, for how many looks in a row the figure is beyond its limit before it is said
    from_s : of a dive, before which its filter, or the dive so far, is not asked [s]
    """

    kind: str
    figure: str
    doubtful: float
    wrong: float = inf
    rate: float = 1e-6
    live: str = ""
    advice: bool = False
    looks: int = 1
    from_s: float = SETTLED_S

    def __post_init__(self) -> None:
        """Refuse limits by which a rule can never, or must always, speak.

        Raises
        ------
        ValueError : so
        """
        if not isfinite(min(self.doubtful, self.wrong)) or self.doubtful < 0.0 or not self.doubtful <= self.wrong:
            raise ValueError(f"rule {self.kind!r}: limits {self.doubtful:g} and {self.wrong:g} say never, or always")
        if not 0.0 <= self.rate < 0.05:
            raise ValueError(f"rule {self.kind!r}: a rate of false alarms of {self.rate:g}")

    def severity(self, figure: float, doubtful: float | None = None, wrong: float | None = None) -> Severity | None:
        """What a figure means, by the rule's limits or others; None = it is within them."""
        if figure > (self.wrong if wrong is None else wrong):
            return "wrong"
        if figure > (self.doubtful if doubtful is None else doubtful):
            return "advice" if self.advice else "doubtful"
        return None


_ROWS = (
    Rule("axes", "error of the DVL against the IMU, over that with other axes", 1.15, 1.15, live="`check` event"),
    # live, by the motion of the last minutes: looks are windows
    Rule("clock", "the same, over that with shifted stamps", 1.15, 1.15, live="`clock` event", looks=2, from_s=60.0),
    Rule(
        "check", "findings of wrong data that are not mended", 0.0, rate=0.0, live="`check` event", looks=3, from_s=60.0
    ),
    Rule("innovations", "mean square of the filter's innovations, in their stated sds", 4.0, 25.0, live="as too large"),
    Rule(
        "filter alone", "share of a sensor's measurements that the filter alone rejected", 0.05, rate=1e-3, from_s=20.0
    ),
    # what was held wrongly for less than a minute shows little
    Rule("held", "error of a constant that is held, in its sds", SURE, 30.0, live="smoothed dive so far", from_s=60.0),
    Rule(
        "moved", "shift of an estimated variable or a first bias, in sds of that shift", 4.0, 10.0, 1.6e-3, live="now"
    ),
    Rule("earth rate", "the Earth's rate over the sd of the gyro's bias, where it is not modelled", 10.0, live="now"),
    Rule("frozen", "seconds in which a sensor repeats itself", HOLD.seconds, live="as it happens"),
    Rule("no heading", "seconds without heading, without an IMU", 10.0, rate=0.0),
    Rule("no tilt", "seconds without roll and pitch, without an IMU", 10.0, rate=0.0),
    Rule("taken out", "seconds in which a sensor was ignored, since it contradicts all others", 0.0, live="of the DVL"),
    Rule("close", "likelihood of the next best choice of what to ignore", 1e-4),
    Rule("rejected", "largest share of measurements rejected in a minute", 0.05, 0.5, live="last minute", looks=3),
    Rule(
        "one beam",
        "largest share of one beam's measurements rejected in a minute, beside beams that agree",
        0.05,
        live="last minute",
        looks=3,
    ),
    Rule("too large", "mean square of normalised residuals, in the dive", 2.0, 6.0, live="last minute", looks=3),
    Rule(
        "too small",
        "1 over the mean NIS per dimension: noise is smaller than stated",
        1.0 / 0.3,
        advice=True,
        live="last minute",
        looks=3,
    ),
    # live, innovations wander while the calibration settles
    Rule(
        "lasting", "variance of means over 5 or 20 s, 1 for noise", 4.0, 100.0, live="last minute", looks=3, from_s=60.0
    ),
    # healthy simulated dives have up to 1.1, a right recorded one of a MEMS gyro at 10 Hz has 5, faults 6 and more
    Rule("imu", "the same of the IMU's own residuals, over 20 s", 6.0, 50.0),
    Rule("bias drift", "change of a bias from start to end, in sds of its walk", 4.0, 30.0, 4e-4),
    Rule(
        "estimates",
        "largest squared difference of smoothed and filtered position, depth or heading, in joint sds",
        40.0,
        100.0,
        live="at each re-initialisation",
    ),
    Rule(
        "separation",
        "mean square of smoothed less filtered position, depth or heading over the dive, in the filter's sds",
        9.0,
        25.0,
        rate=4e-4,
    ),
    Rule(
        "found",
        "how far what was found in the dive moved the track, rms, in its sds before or after, the larger",
        2.0,
        rate=0.01,
    ),
    # twice the fastest that bottom track has shown of real water
    Rule("current walk", "walk of the current at one depth that was found [m/s per root second]", 0.01),
    Rule("rivals", "how far apart clear explanations put the track, rms, in its sds", 2.0, rate=1e-3),
    Rule("left out", "share of a sensor's measurements that never reached the estimate", 0.1, 0.5, rate=1e-3),
    Rule(
        "uncertain",
        "largest horizontal sd, in quarters of the distance travelled, or 10 m where that is more",
        1.0,
        rate=1e-3,
    ),
    Rule("halves", "difference of a constant between the halves of the dive, in sds", 10.0, 30.0),
    Rule(
        "unstated", "noise, lasting error or other place of the DVL, found but not used", 0.0, live="only", from_s=60.0
    ),
    Rule("contradiction", "the smaller of two sensors' excesses over their limits", 1.0, 1.0, live="of both alarms"),
)
RULES = {rule.kind: rule for rule in _ROWS}


def remedy_of_lag(config: Config, sensor: str, lag: float, sd: float) -> str:
    """What mends stamps that are late [s]: a known delay is stated; a DVL's is estimated, as its pings show it well."""
    if sensor == "dvl":
        entry = f"{{estimate: true, mean: {lag:.3f}, sd: {max(0.02, 3.0 * sd):.2f}}}"
        return f"correct its clock, or state calibration.dvl_time_offset: {entry}"
    late = round(delay_of(config, sensor) + lag, 4) + 0.0
    delay = f"state delay_s: {{{sensor}: {late:.2g}}}"
    if sensor == "usbl":
        entry = f"{{estimate: true, mean: {lag:.2g}, sd: {sd_of_lag(sd):.2g}}}"
        return f"{delay}, or calibration.usbl_time_offset: {entry}"
    return f"{delay}, or correct fix.lever_arm_m" if sensor == "fix" else delay  # under way the two are alike


def sd_of_lag(sd: float) -> float:
    """With which a latency of acoustic stamps is estimated that was found with an sd [s]."""
    return max(0.1, 3.0 * sd)


def rule_table() -> str:
    """`RULES` as a table in Markdown, as docs/alarms.md has it."""
    never, rows = "–", ["| kind | figure | doubtful | wrong | rate | live | from |", "|---|---|---|---|---|---|---|"]
    for r in RULES.values():
        lower = f"{r.doubtful:.3g}" + " (advice)" * r.advice
        settled = "" if r.from_s == SETTLED_S else f"{r.from_s:g} s"
        higher = never if r.wrong == inf else f"{r.wrong:.3g}"
        rows.append(f"| `{r.kind}` | {r.figure} | {lower} | {higher} | {r.rate:g} | {r.live or never} | {settled} |")
    return "\n".join(rows)


def comparison_table() -> str:
    """`COMPARISONS` as a table in Markdown, as docs/check.md has it."""
    head = "| compared | one motion from | lag from [s] | of its sds | chi-square | searched to [s] |"
    rows = (f"| {c.compared} | " + " | ".join(f"{number:g}" for number in c[1:]) + " |" for c in COMPARISONS)
    return "\n".join([head, "|---|---|---|---|---|---|", *rows])
