"""Noise and DVL lever arm that the configuration does not state, found in the residuals.

Noise may be larger than stated, errors may last, and a current may change faster. All are returned as `Beliefs`, with
which filter and smoother solve the dive again. A wrong constant makes residuals that look like these, so no noise is
reported where alarms name a constant. Late stamps of the same sensor are a rival: an error that lasts must make the
dive likelier than these do.

The factor of white noise comes from differences of successive residuals, which errors that last do not change:

    factor^2 = median |r_k+1 - r_k|^2 / (2 m)

with m the median of chi-square. A smoother's residuals vary less than the noise, so the factor is a little low.

`estimate_lever_arm` finds the DVL's lever arm from the vehicle's own rates. Where the gyro's noise would bias the arm
if it were estimated, the arm is considered and stays at its mean, however wrong (`rovgraph.inference.rate_noise`).
The score test without that noise gives the right one.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rovgraph.diagnosis.alarm import Alarm, Statistic
from rovgraph.diagnosis.constants import FEIGNED, RELEASED
from rovgraph.diagnosis.residuals import SD_KEY
from rovgraph.distributions import chi_square_quantile
from rovgraph.geometry import Array
from rovgraph.inference.chain_optimum import ChainOptimum
from rovgraph.inference.correlated_noise import LASTING, GaussMarkovError, Rival, find_correlated_noise, freedom
from rovgraph.inference.gauss_newton import rejects
from rovgraph.inference.rate_noise import ARM
from rovgraph.inference.score_test import score_test
from rovgraph.inference.widened_chain import lasting_belief
from rovgraph.log.units import behind, shown
from rovgraph.model.calibration import AUTO, LAYERS, MOUNT, TABLE, WATER_LAYER, Belief
from rovgraph.model.config import Config
from rovgraph.problem.initial_conditions import Beliefs
from rovgraph.problem.motion import has_constant_velocity
from rovgraph.rules import BENT, RULES


@dataclass(frozen=True)
class DvlPlace:
    """Where the DVL is.

    Attributes
    ----------
    offset : ndarray, shape (3,), from where the configuration has it, along b; 0 where nothing shows [m]
    mean : ndarray, shape (3,), of `ARM`, that puts it there [m]
    sd : of each component, at least the prior's [m]
    size : of the largest offset, in sds of the prior
    """

    offset: Array
    mean: Array
    sd: float
    size: float

    @property
    def cause(self) -> str:
        """The finding, in words."""
        named = zip(TABLE[ARM].labels, self.offset.tolist(), strict=True)
        where = ", ".join(f"{label[-1]} {off:+.2g} m" for label, off in named if off)
        return (
            f"the vehicle's rates show it elsewhere, {where} from where dvl.lever_arm_m, imu.lever_arm_m and "
            f"calibration.{ARM}.mean have it"
        )


def estimate_lever_arm(best: ChainOptimum) -> DvlPlace | None:
    """The place of a DVL whose arm is considered, where it is wrong and no held constant is further off."""
    if ARM not in best.unknowns.considered or _is_turned(best):
        return None
    belief, released = best.beliefs[ARM], score_test(best, RELEASED)
    spread = {r.label: float(np.hypot(r.sd, FEIGNED.get(r.name, 0.0))) for r in released}
    arm = [r for r in released if r.name == ARM and abs(r.step) > RULES["held"].doubtful * spread[r.label]]
    # a place that is off makes stamps seem late: the arm is compared without what errors in variables allow for
    others = [abs(r.step) / spread[r.label] for r in released if r.name != ARM]
    if not arm or max(r.significance for r in arm) < max(others, default=0.0):
        return None
    steps = {r.label: r.step for r in arm}
    offset = np.array([steps.get(label, 0.0) for label in belief.variable.labels])
    sd = max(belief.sd, *(spread[r.label] for r in arm))
    return DvlPlace(offset, belief.mean + offset, sd, float(np.abs(offset).max() / belief.sd))


def _is_turned(best: ChainOptimum) -> bool:
    """Whether the DVL's mounting is estimated far from its prior, as it is where axes are named wrongly."""
    mounting = [best.beliefs[name] for name in MOUNT if best.unknowns.walks.get(name) == 0.0]
    return any(
        abs(float(best.state.calibration[b.variable.name][0] - b.mean[0])) > RULES["moved"].doubtful * b.sd
        for b in mounting
    )


NAMED = ("axes", "clock", "held", "earth rate")  # alarms that name another cause
ALONE = ("fix", "ahrs")  # sensors of which only a time offset can be held at a wrong value
LARGER = 1.5  # factor of the noise that is not as stated
WALK_STEP, WALKS = 1.5, 16  # from one walk of the current that is tried to the next, and how many at most
CLEARLY = 10.0  # gain of log likelihood over the first walk, which is slower than believed
TOGETHER = 1.5  # times the likeliest walk that is believed: knots walk by themselves, water over several at once
FASTER = 1.25  # times the walk that is believed, from which on it is taken
FAST_CURRENT = "check water.looks, and the axes and the clock of the profiles (rovgraph check)"
ENOUGH = 50  # differences
LIKELY, UNLIKELY = 1.0, 2.0  # sds of what is believed of its place: what is used by itself, and what is worth an alarm
OWN_SD = 0.05  # relative difference to the configuration's that makes it the log's own


@dataclass(frozen=True)
class UnstatedNoise:
    """Noise that was found, or the DVL's place.

    Attributes
    ----------
    sensor : log stream
    key : of the configuration, that holds it
    values : what stands there with it; numbers, or keys of the section and theirs
    cause, done : the finding, and what is done about it
    beliefs : the same, for the dive to be solved again
    instead : what to do where such a value means that something else is wrong
    """

    sensor: str
    key: str
    values: Any
    cause: str
    done: str
    beliefs: Beliefs
    instead: str = ""

    @property
    def text(self) -> str:
        """One line."""
        return f"{self.sensor}: {self.cause}; {self.done}"

    @property
    def remedy(self) -> str:
        """The keys that state it in a configuration."""
        return self.instead or f"state {self.key}: {_as_yaml(self.values)}"

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"sensor": self.sensor, "key": self.key, "values": self.values, "text": self.text}


def find_noise(
    best: ChainOptimum, config: Config, alarms: Sequence[Alarm], likely: float = LIKELY
) -> tuple[list[UnstatedNoise], list[Rival]]:
    """White noise that is larger than stated, a faster current, and a DVL that is elsewhere; these have no rivals.

    Parameters
    ----------
    best : the optimum
    config : of the dive
    alarms : of the same dive
    likely : sds of what is believed of the DVL's place, up to which another is left to chance
    """
    place = _place(best, alarms)
    found = [_placed(best, place)] if place is not None and place.size > likely else []
    if found or _named_elsewhere(alarms, best):
        return found, []
    larger = [_larger(best, sensor, config) for sensor in best.blocks]
    return [one for one in (*larger, _restless(best)) if one is not None], []


def find_errors(best: ChainOptimum, config: Config, alarms: Sequence[Alarm]) -> tuple[list[UnstatedNoise], list[Rival]]:
    """Errors that last, which exceed white noise where that is known; and equally clear explanations.

    Parameters are those of `find_noise`.
    """
    if _named_elsewhere(alarms, best):
        return [], []
    late = {alarm.sensor: alarm.figure for alarm in alarms if alarm.kind == "held" and alarm.sensor in ALONE}
    stated = [name for name in LASTING if getattr(config.calibration, name).estimate != AUTO]
    errors, rivals = find_correlated_noise(best, stated)
    place = _place(best, alarms)
    if place is not None and any(error.sensor == "dvl" for error in errors):
        return [_placed(best, place)], []
    # a score test's figure z is worth z^2 / 2 of log likelihood
    clear = [error for error in errors if error.gain > 0.5 * late.get(error.sensor, 0.0) ** 2]
    return [_lasting(best, error) for error in clear], rivals if clear or not errors else []


def _named_elsewhere(alarms: Sequence[Alarm], best: ChainOptimum) -> bool:
    """Whether alarms name another cause, of which late stamps of a sensor that stands alone are a rival only.

    Where much is rejected the estimate is bent, and what it holds seems to be off.
    """
    bent = rejects(best.solution.gates, BENT)
    for alarm in alarms:
        if alarm.kind == "held":
            if alarm.sensor not in ALONE and not (bent and alarm.severity == "doubtful"):
                return True
        elif alarm.kind in NAMED or (alarm.kind == "bias drift" and alarm.severity == "wrong"):
            return True
    return False


def _place(best: ChainOptimum, alarms: Sequence[Alarm]) -> DvlPlace | None:
    return None if any(alarm.kind in ("axes", "clock") for alarm in alarms) else estimate_lever_arm(best)


def _placed(best: ChainOptimum, place: DvlPlace) -> UnstatedNoise:
    key = f"calibration.{ARM}"
    values = {"mean": tuple(place.mean.tolist()), "sd": place.sd}
    beliefs = Beliefs({ARM: replace(best.beliefs[ARM], mean=place.mean, sd=place.sd)})
    return UnstatedNoise("dvl", key, values, place.cause, f"that is used ({key})", beliefs)


def unstated(best: ChainOptimum, config: Config, alarms: Sequence[Alarm]) -> Iterator[Statistic]:
    """The same as alarms, of an estimate that does not use it; parameters are those of `find_noise`."""
    begin, end = float(best.problem.time[0]), float(best.problem.time[-1])
    for one in find_noise(best, config, alarms, UNLIKELY)[0] or find_errors(best, config, alarms)[0]:
        if not _is_allowed_for(one, best):
            yield Statistic("unstated", one.sensor, begin, end, 1.0, one.cause, one.remedy)


def _is_allowed_for(one: UnstatedNoise, best: ChainOptimum) -> bool:
    """Whether it is a considered constant within its prior."""
    name = one.key.removeprefix("calibration.")
    if name not in best.unknowns.considered or "time_constant_s" in one.values or "mean" in one.values:
        return False
    factor, _ = shown(TABLE[name].unit)
    sd: float = max(one.values.get("sd", 0.0), one.values.get("sd_deg", 0.0))
    return sd <= 1.01 * factor * best.beliefs[name].sd


def _as_yaml(values: Any) -> str:
    """Numbers or keys on one line."""
    if isinstance(values, Mapping):
        return "{" + ", ".join(f"{key}: {_as_yaml(value)}" for key, value in values.items()) + "}"
    if isinstance(values, tuple):
        return "[" + ", ".join(map(_as_yaml, values)) + "]"
    return str(values).lower() if isinstance(values, bool) else f"{float(f'{values:.2g}'):g}"


def _larger(best: ChainOptimum, sensor: str, config: Config) -> UnstatedNoise | None:
    """White noise of a sensor that is larger than the configuration states."""
    key, block = SD_KEY.get(sensor), best.blocks[sensor]
    if key is None:
        return None
    section, name = key.split(".")
    stated = getattr(getattr(config, section), name)
    used = best.weights[sensor] > 0.0
    factor = noise_factor(block.normalised(best.state.at(block.keyframe))[used])
    if factor is None or factor < LARGER or not _is_stated(best, sensor):
        return None
    value = tuple(factor * s for s in stated) if isinstance(stated, tuple) else factor * stated
    cause = f"its noise is {factor:.2g} times what {key} states, by its residuals"
    return UnstatedNoise(sensor, key, value, cause, "the larger noise is used", Beliefs(noise={sensor: factor}))


def _restless(best: ChainOptimum) -> UnstatedNoise | None:
    """A current that changes faster than the configuration states; without an IMU errors of heading look like it."""
    knots = {} if has_constant_velocity(best.initial.config) else knots_walking_faster(best)
    if not knots:
        return None
    walk = next(iter(knots.values())).walk
    cause = (
        f"the current changes {walk / best.beliefs[next(iter(knots))].walk:.2g} times as fast as water.walk_mps has it"
    )
    instead = FAST_CURRENT if walk > RULES["current walk"].doubtful else ""
    return UnstatedNoise(WATER_LAYER, "water.walk_mps", walk, cause, "the faster walk is used", Beliefs(knots), instead)


def knots_walking_faster(best: ChainOptimum) -> dict[str, Belief]:
    """Knots of the current with the walk that makes a dive the likeliest, where that is clearly larger than believed.

    Where water changes faster than `water.walk_mps` has it, the estimate follows it and residuals look well; the track
    is wrong all the same, and too sure. The likelihood of the dive, linear about its optimum, is that of
    `rovgraph.inference.correlated_noise`, and needs one elimination for each walk that is tried.
    """
    names = [name for name in LAYERS if name in best.chain.layout.walking]
    if not names:
        return {}
    log_determinant, least = best.linear
    believed = freedom(best.chain, log_determinant) + 0.5 * least
    losses = [_loss(best, _walking(best, names, 1.0 / WALK_STEP)), believed]
    while losses[-1] < losses[-2] and len(losses) < WALKS:
        losses.append(_loss(best, _walking(best, names, WALK_STEP ** (len(losses) - 1))))
    if losses[0] - losses[-2] < CLEARLY:
        return {}
    slower, likeliest, faster = losses[-3:]
    beyond = 1.0  # where the fastest that was tried is the likeliest; else of a parabola through the three
    if faster >= likeliest:
        beyond = 0.5 * (slower - faster) / (slower - 2.0 * likeliest + faster)
    factor = TOGETHER * WALK_STEP ** (len(losses) - 3 + beyond)
    return _walking(best, names, factor) if factor > FASTER else {}


def _walking(best: ChainOptimum, names: list[str], factor: float) -> dict[str, Belief]:
    return {name: replace(best.beliefs[name], walk=factor * best.beliefs[name].walk) for name in names}


def _loss(best: ChainOptimum, knots: dict[str, Belief]) -> float:
    """Minus log likelihood with other walks, up to what does not change with them."""
    walks = {**best.unknowns.walks, **{name: belief.walk for name, belief in knots.items()}}
    chain = replace(best.chain, beliefs={**best.beliefs, **knots}, unknowns=replace(best.unknowns, walks=walks))
    root = chain.eliminate(best.linearised_at, best.solution.gates, diagonal=True)
    return freedom(chain, root.log_determinant()) + 0.5 * root.left


def noise_factor(r: Array) -> float | None:
    """How many times larger the white noise of n normalised residuals is, shape (n, dim); None = too few."""
    if len(r) <= ENOUGH:
        return None
    squares = np.sum(np.diff(r, axis=0) ** 2, axis=1)
    return float(np.sqrt(np.median(squares) / (2.0 * chi_square_quantile(r.shape[1], 0.5))))


def _is_stated(best: ChainOptimum, sensor: str) -> bool:
    """Whether a sensor's noise is the configuration's, and not the log's own of most measurements."""
    believed = best.chain.initial.instruments[sensor].sd
    dim = best.blocks[sensor].instrument.model.dim
    sd = best.problem.sd(best.problem.of_sensor(sensor), dim)
    return bool(np.median(np.abs(sd / believed - 1.0)) < OWN_SD)


def _lasting(best: ChainOptimum, error: GaussMarkovError) -> UnstatedNoise:
    variable = TABLE[error.variable]
    factor, unit = shown(variable.unit)
    sd, seconds = factor * error.sd, float(error.time_constant)
    key = f"calibration.{error.variable}"
    believed = lasting_belief(best.beliefs[error.variable], error.sd, seconds, tuple(time for time, _ in error.steps))
    beliefs = Beliefs({error.variable: believed})
    moves = error.variable == "bottom_velocity"
    bottom = f"{'if the fixes are right, ' if 'fix' in best.blocks else ''}the bottom that it sees"
    values = {"estimate": True, "sd_deg" if variable.angular else "sd": sd}
    if error.steps:
        begin = float(best.problem.time[0])
        sizes = ((time - begin, ", ".join(f"{factor * by:+.2g}" for by in step.tolist())) for time, step in error.steps)
        when = " and ".join(f"at {since:.0f} s by {size}{behind(unit)}" for since, size in sizes)
        what = f"{bottom} changes its velocity" if moves else "its error changes at once"
        done = f"another value is taken from there on ({key})"
        return UnstatedNoise(error.sensor, key, values, f"{what}, {when}", done, beliefs)
    if np.isinf(seconds):
        cause = f"{variable.about}: the dive determines it better than its sd"
        return UnstatedNoise(error.sensor, key, values, cause, f"it is estimated ({key})", beliefs)
    size = f"{100.0 * sd:.2g} % of the velocity" if unit == "1" else f"{sd:.2g}{behind(unit)}"
    what = f"{bottom} moves; its velocity is" if moves else "its errors are"
    cause = f"{what} correlated over {seconds:.0f} s with an sd of {size}"
    values |= {"time_constant_s": seconds}
    done = f"{'it is' if moves else 'they are'} estimated ({key})"
    return UnstatedNoise(error.sensor, key, values, cause, done, beliefs)
