"""Alarms on constants: estimated ones far from their prior, and held ones that the measurements contradict."""

from collections.abc import Iterator
from statistics import NormalDist

import numpy as np

from rovgraph.diagnosis.alarm import Statistic
from rovgraph.diagnosis.evidence import Evidence
from rovgraph.geometry import EARTH_RATE, Array
from rovgraph.inference.chain_optimum import ChainOptimum
from rovgraph.inference.estimate import CalibrationEstimate
from rovgraph.inference.rate_noise import ARM
from rovgraph.inference.score_test import ScoreTest, as_chain, score_test
from rovgraph.log.units import behind, shown
from rovgraph.model.calibration import TABLE, USBL_MOUNT
from rovgraph.model.config import Config, beliefs
from rovgraph.rules import RULES, START_REMEDY, remedy_of_lag

NARROWED = 0.95  # times its prior sd: what did not narrow is its prior repeated
LINEARISED = 0.2  # of a prior sd, by which linearisation may move what is hardly seen
# errors in variables: what is released follows noise where it is less certain than this part of the default prior sd,
SHOWN = 0.3
SHOWN_OF = {"fix_time_offset": 1.0}  # the velocity that makes a late fix wrong is known well, whatever fixes scatter
MOVING = 20.0  # and what turns or scales the DVL's velocity where that is less than so many sds
FEIGNED = {
    "dvl_scale": 1.5e-3,
    "dvl_lever_arm": 0.01,
    "gyr_scale": 5e-4,
    "ahrs_time_offset": 0.01,
    "mag_time_offset": 5e-3,
}  # by errors in variables, however long the dive is
MATTERS = 0.2  # of the prior sd: a smaller difference of halves
SHARE_OF_SD = 0.3  # of a constant's sd at half the dive, that linearisation may cause
TIME_OFFSETS = tuple(name for name, variable in TABLE.items() if variable.time_offset)
RELEASED = ("dvl_roll", "dvl_pitch", "dvl_yaw", "dvl_scale", "dvl_lever_arm", "gyr_scale", *TIME_OFFSETS)
BIASES = (("acc_bias", slice(0, 3), "imu.acc_bias_sd_mps2"), ("gyr_bias", slice(3, 6), "imu.gyr_bias_sd_dps"))


RETURNED = 0.2  # of a stated alignment, that an estimate without it may keep


def moved_calibration(evidence: Evidence) -> Iterator[Statistic]:
    """Calibration variables, first biases and the start against their priors, in sds of the shift (`sds_moved`)."""
    noise = _sd_of_noise(evidence)
    revealed = {label for name in evidence.initial.revealed.calibration for label in TABLE[name].labels}
    several = [c for c in evidence.main.calibration if c.estimated and c.label not in revealed]  # `found` has those
    for c in several:
        yield from moved_constant(c, evidence.start, evidence.end, noise.get(c.label), len(several))
    yield from _start_moved(evidence)
    prior = evidence.initial.prior
    for name, part, key in BIASES:
        history = evidence.main.history.get(name)
        if history is None or evidence.main.kind != "smoothed":
            continue
        mean, sd = prior.state.bias[0][part], prior.bias_sd[part]
        off = (history.value[0] - mean) / np.hypot(sd, history.sd[0])
        worst = int(np.argmax(np.abs(off)))
        yield _moved(
            evidence.start,
            evidence.end,
            "imu",
            float(np.abs(off[worst])),
            f"{history.labels[worst]} started at {history.value[0, worst]:.3g} {history.unit}, "
            f"{abs(off[worst]):.0f} sd from its prior",
            f"check imu.mount_rpy_deg and the units of the IMU, or raise {key}",
        )


def alignment_entered_twice(evidence: Evidence) -> Iterator[Statistic]:
    """A mounting of the acoustic head that the replies do not have, as the system has applied it already."""
    for c in evidence.main.calibration:
        stated = abs(c.prior_mean)
        if c.label in USBL_MOUNT and c.estimated and stated > 0.0 and abs(c.value) < RETURNED * stated:
            degrees = float(np.rad2deg(c.prior_mean))
            yield _moved(
                evidence.start,
                evidence.end,
                "usbl",
                stated / c.sd,
                f"its replies fit a head without the {degrees:+.2g} deg of {c.label} that usbl.mount_rpy_deg states: "
                "the system has applied its alignment already",
                "leave it out of usbl.mount_rpy_deg",
            )


def _sd_of_noise(evidence: Evidence) -> dict[str, float]:
    """Label of a constant -> its sd, were what is considered known; of a chain's smoothed estimate."""
    best = evidence.optimum
    if not isinstance(best, ChainOptimum) or evidence.main.kind != "smoothed":
        return {}
    pairs = (zip(TABLE[name].labels, sd.tolist(), strict=True) for name, sd in best.sd_of_noise().items())
    return {label: sd for pair in pairs for label, sd in pair}


def _start_moved(evidence: Evidence) -> Iterator[Statistic]:
    """The first position against the start that the configuration states."""
    start, track = evidence.initial.config.start, evidence.main.trajectory
    if not start.located or evidence.main.kind != "smoothed" or "fix" not in evidence.residuals:
        return
    stated = np.array([start.north_m or 0.0, start.east_m or 0.0])
    off, sd = track.p_n[0, :2] - stated, track.p_sd[0, :2]
    figure = sds_moved(off, sd, np.zeros(2), np.full(2, start.position_sd_m))
    worst = int(np.argmax(figure))
    yield _moved(
        evidence.start,
        evidence.end,
        "start",
        float(figure[worst]),
        f"the dive begins {np.linalg.norm(off):.2g} m from where it was believed to begin, {figure[worst]:.0f} sds of "
        f"what start.position_sd_m {start.position_sd_m:.2g} allows",
        START_REMEDY,
    )


def moved_constant(
    c: CalibrationEstimate, begin: float, end: float, sd_of_noise: float | None = None, several: int = 25
) -> Iterator[Statistic]:
    """One of several that are estimated against its prior, where the data of a time [s] have narrowed it.

    ``sd_of_noise`` is its sd, were what is considered known; None = it is not known.
    """
    if c.sd > NARROWED * c.prior_sd and sd_of_noise is None:
        return
    noise = None if sd_of_noise is None else np.array(sd_of_noise)
    off = float(sds_moved(np.array(c.value), np.array(c.sd), np.array(c.prior_mean), np.array(c.prior_sd), noise))
    factor, unit = shown(c.unit)
    name = next((n for n in TABLE if c.label in TABLE[n].labels), c.label)
    yield _moved(
        begin,
        end,
        _sensor_of(name),
        off,
        f"{c.label} was estimated at {factor * c.value:.3g}{behind(unit)}, {off:.0f} sd from its prior "
        f"{factor * c.prior_mean:.3g} ± {factor * c.prior_sd:.2g}{behind(unit)}",
        f"check {_key_of(name)}; if the estimate is right, state it as the mean, or state a larger "
        f"sd, in calibration.{name}",
        several,
    )


def sds_moved(value: Array, sd: Array, prior_mean: Array, prior_sd: Array, sd_of_noise: Array | None = None) -> Array:
    """How far data have moved n constants, in sds of what they do to right ones; 0 where they hardly narrowed them.

    With s the sd were what is considered known, an estimate that ignores what is considered shifts by a variance of
    prior sd^2 - s^2, and what is considered adds sd^2 - s^2 to it. Where s is not known, it is at most
    prior sd^2 + sd^2. Errors of linearisation move what is hardly seen by a part of its prior's sd.
    """
    if sd_of_noise is None:
        by_data = np.where(sd <= NARROWED * prior_sd, np.hypot(prior_sd, sd), np.inf)
    else:
        variance = prior_sd**2 + sd**2 - 2.0 * sd_of_noise**2
        by_data = np.sqrt(np.maximum(variance, (LINEARISED * prior_sd) ** 2))
    return np.asarray(np.abs(value - prior_mean) / by_data)


def _moved(
    begin: float, end: float, sensor: str, figure: float, cause: str, remedy: str, several: int = 25
) -> Statistic:
    """A shift in its sds, the largest of several: the fewer there are, the less of it is chance."""
    rule = RULES["moved"]
    factor = NormalDist().inv_cdf(1.0 - 0.5 * rule.rate / max(several, 1)) / rule.doubtful
    return Statistic("moved", sensor, begin, end, figure, cause, remedy, factor)


def contradicted_constants(evidence: Evidence) -> Iterator[Statistic]:
    """Constants that are held, released one by one: the score test of `rovgraph.inference.score_test`."""
    if evidence.optimum is not None:
        best = as_chain(evidence.optimum, evidence.initial)
        v_sd = np.median(evidence.main.trajectory.v_sd)
        yield from contradicted_constants_in(best, evidence.initial.config, float(v_sd), evidence.start, evidence.end)


def contradicted_constants_in(
    best: ChainOptimum, config: Config, v_sd: float, start: float, end: float
) -> Iterator[Statistic]:
    """The same of an optimum from ``start`` to ``end`` [s], whose velocity is known to ``v_sd`` [m/s]."""
    moving = np.sqrt(np.mean(best.state.v_n**2)) > MOVING * v_sd
    for r in score_test(best, [name for name in RELEASED if moving or not name.startswith("dvl")]):
        variable = TABLE[r.name]
        if r.sd > SHOWN_OF.get(r.name, SHOWN) * variable.sd:
            continue
        factor, unit = shown(variable.unit)
        belief = best.beliefs[r.name]
        considered = r.name in best.unknowns.considered
        mean, allowed = belief.mean[variable.labels.index(r.label)], belief.sd if considered else 0.0
        yield Statistic(
            "held",
            _sensor_of(r.name),
            start,
            end,
            abs(r.step) / float(np.linalg.norm([r.sd, FEIGNED.get(r.name, 0.0), allowed])),
            f"{r.label} is held at {factor * mean:.4g}{behind(unit)}, but the measurements shift it "
            f"by {factor * r.step:+.2g} ± {factor * r.sd:.1g}{behind(unit)}",
            _remedy_of_held(r, config),
            # the prior's sd is all that the track's sd has of it
            certain=RULES["moved"].wrong if considered else np.inf,
        )


def earth_rate(evidence: Evidence) -> Iterator[Statistic]:
    """The Earth's rate, where it is not modelled, against the estimate's sd of the gyro's bias.

    It is a bias that turns with the vehicle. It matters where the gyro's bias is known ten times better than that.
    """
    history = evidence.main.history.get("gyr_bias")
    if history is None or evidence.initial.config.environment.earth_rotation:
        return
    yield earth_rate_of(float(history.sd.min()), evidence.start, evidence.end)


def earth_rate_of(sd: float, begin: float, end: float) -> Statistic:
    """The Earth's rate against a gyro's bias with an sd of ``sd`` [rad/s]."""
    return Statistic(
        "earth rate",
        "imu",
        begin,
        end,
        EARTH_RATE / sd,
        f"the gyro's bias has an sd of {np.rad2deg(sd) * 3600:.2g} deg/h, but the Earth's rotation of 15 deg/h is "
        "not modelled",
        "state environment.latitude_deg and environment.earth_rotation: true",
    )


def split_half_drift(evidence: Evidence) -> Iterator[Statistic]:
    """The calibration of the first half of the dive against that of the whole, which is as much as against the second.

    The filter's estimate at half the dive differs from that of all data by a variance of P(half) - P(all).
    """
    filtered, final = evidence.estimate("filtered"), {c.label: c for c in evidence.main.calibration}
    if filtered is None or evidence.main.kind != "smoothed":
        return
    middle = 0.5 * (evidence.start + evidence.end)
    for name, history in filtered.history.items():
        if name not in TABLE or np.isfinite(TABLE[name].time_constant) or TABLE[name].walk or len(history.time) < 3:
            continue
        k = int(np.searchsorted(history.time, middle))
        for label, value, sd in zip(history.labels, history.value[k], history.sd[k], strict=True):
            last = final.get(label)
            if last is None or not last.estimated or abs(value - last.value) < MATTERS * last.prior_sd:
                continue
            # the smoother may be less certain, where it considers what the filter estimates
            known_later = -(last.sd**2) if last.sd < sd else last.sd**2
            spread = np.sqrt(sd**2 + known_later + (SHARE_OF_SD * sd) ** 2)
            off = abs(float(value) - last.value) / float(spread)
            yield Statistic(
                "halves",
                _sensor_of(name),
                evidence.start,
                evidence.end,
                off,
                f"{label} differs by {off:.0f} sd between the first half of the dive and the second",
                f"it changes during the dive, or another error looks like it: check {_key_of(name)}, "
                f"or let it walk (calibration.{name})",
            )


def _sensor_of(name: str) -> str:
    """The stream that a calibration variable is about."""
    sensors = TABLE[name].sensors if name in TABLE else ()
    return sensors[0] if sensors else "imu"


def _key_of(name: str) -> str:
    """What to look at in the configuration where a calibration variable is far off."""
    if name in ("dvl_roll", "dvl_pitch", "dvl_yaw"):
        return "dvl.mount_rpy_deg and the signs of the DVL's axes (rovgraph check names them)"
    if name == ARM:
        return "dvl.lever_arm_m and imu.lever_arm_m"
    if name in TIME_OFFSETS:
        return f"the clock that stamps {_sensor_of(name)}"
    if name.endswith("_offset") and name != "depth_offset":
        return "environment.declination_deg, the compass's mounting, and the ship's heading if fixes come from a ship"
    if name in ("hard_iron", "soft_iron", "field_scale", "field_dip", "mag_deviation"):
        return "the magnetometer's calibration (rovgraph calibrate magnetometer)"
    return f"calibration.{name}"


def _remedy_of_held(r: ScoreTest, config: Config) -> str:
    """What to do about a constant that is not what it is held at."""
    if r.name in TIME_OFFSETS:
        sensor = _sensor_of(r.name)
        lag = r.step + (float(beliefs(config)[r.name].mean[0]) if sensor == "dvl" else 0.0)
        return f"stamps of {sensor} are late (early if negative): {remedy_of_lag(config, sensor, lag, r.sd)}"
    if r.name == "gyr_scale":
        return "estimate calibration.gyr_scale, or calibrate the gyro"
    if r.name == ARM:
        off = [r.step * (label == r.label) for label in TABLE[ARM].labels]
        mean = ", ".join(f"{value:.2g}" for value in beliefs(config)[ARM].mean + np.array(off))
        return f"check {_key_of(ARM)}, or state calibration.{ARM}: {{mean: [{mean}]}}"
    if r.name == "dvl_yaw":
        return f"check {_key_of(r.name)}, or estimate calibration.dvl_yaw"
    if r.name in ("dvl_roll", "dvl_pitch"):
        return (
            f"DVL and IMU are tilted relative to each other: check imu.mount_rpy_deg, or estimate calibration.{r.name}"
        )
    return f"estimate calibration.{r.name}"
