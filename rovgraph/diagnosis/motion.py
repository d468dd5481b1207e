"""Alarms on the motion: IMU against all other sensors, smoother against filter, and ambiguous optima.

An optimum is ambiguous where a sensor is excluded for some time, or where another optimum is nearly as likely.

`dvl_cause` finds why a DVL contradicts the IMU: axes that are swapped or turned round, or a clock that is off. Over a
few seconds the IMU measures the change of velocity. In body axes, with l the lever arm and T the time between two
pings,

    v_b(t) - R_b(t)b(t-T) v_b(t-T) = R_b(t)n (integral of R_nb f_b + g),  v_b = R_bs H z - w x l

holds for the right signed permutation H of the DVL's axes and the right shift of its stamps. Only turns between the
pings and the vertical enter, so an error of the heading has no effect. But the estimate itself used the wrong DVL. The
check of the log compares without an estimate, so its finding takes precedence.
"""

from collections.abc import Iterator
from dataclasses import replace
from math import exp, isfinite, sqrt

import numpy as np

from rovgraph.diagnosis.alarm import Statistic
from rovgraph.diagnosis.check.lags import ORIENTATIONS
from rovgraph.diagnosis.evidence import MINUTE, Evidence, span, windows
from rovgraph.diagnosis.unstated_noise import FAST_CURRENT
from rovgraph.distributions import chi_square_quantile
from rovgraph.geometry import Array, cross, rotate, transpose, wrap_angle
from rovgraph.inference.chain_optimum import ChainOptimum
from rovgraph.inference.gauss_newton import FaultyInterval
from rovgraph.inference.optimum import Optimum
from rovgraph.inference.trajectory import Trajectory
from rovgraph.kernels import motion_row
from rovgraph.model.calibration import BEAM_SENSORS, LAYERS, TABLE, WATER_LAYER
from rovgraph.model.config import Config, mount_matrix
from rovgraph.problem.beams import solved_pings
from rovgraph.rules import CHANCE, CLIPPED, CONTRADICTED, RULES, SETTLED_S, remedy_of_lag
from rovgraph.sensors.dvl import axes_remedy

IMU_S = 20.0  # over which errors of the IMU last, unlike noise
# of a motion's residual: what people call it, columns, and the signal behind it
PARTS = (("its rotation about", slice(0, 3), "gyr"), ("its velocity along", slice(6, 9), "acc"))
# a bias's history, columns of a motion's residual, what people call it, its unit, and how many of them make one
BIASES = (("acc_bias", slice(9, 12), "acc", "m/s2", 1.0), ("gyr_bias", slice(12, 15), "gyr", "deg/s", np.rad2deg(1.0)))
COARSE = 300  # epochs at which both are compared
LITTLE_M = 10.0  # an sd of so much may be all that a dive wants [m]


def imu_disagreement(evidence: Evidence) -> Iterator[Statistic]:
    """Residuals of the IMU's factors: the mean of each axis over a time, squared, against that of noise.

    What is left between two keyframes is next to nothing, since the keyframes follow the IMU. What lasts is not.
    """
    if evidence.optimum is None or len(evidence.problem) < 3:
        return
    r = _motion_residuals(evidence)
    kept = ~evidence.problem.bridged[1:]
    time = evidence.problem.time[1:][kept]
    window = windows(time, evidence.start, IMU_S)
    count = np.bincount(window) if len(window) else np.zeros(1)
    full = count >= max(3.0, 0.3 * np.median(count))
    if not full.any():
        return

    def means(residuals: Array) -> Array:
        """Squared means of each axis over windows, in units of their noise, shape (windows, 15)."""
        sums = np.column_stack([np.bincount(window, column) for column in residuals[kept].T])
        return np.asarray((sums**2 / np.maximum(count, 1)[:, None])[full])

    squares, n = means(r), int(full.sum())
    by_chance = chi_square_quantile(n, CHANCE) / n
    if squares.mean(axis=0).max() > max(RULES["imu"].doubtful, by_chance):
        squares = squares / (1.0 + sum(map(means, _moved_motions(evidence, r))))
    for part, columns, key in PARTS:
        for axis, square in zip("xyz", squares[:, columns].T, strict=True):
            ratio = float(square.mean())
            begin = evidence.start + float(np.flatnonzero(full)[int(np.argmax(square))]) * IMU_S
            yield Statistic(
                "imu",
                "imu",
                begin,
                min(begin + IMU_S, evidence.end),
                ratio,
                f"{part} {axis} contradicts the other sensors: means over {IMU_S:g} s vary {ratio:.0f} times as much "
                f"as its noise allows, most at {evidence.since(begin):.0f} s",
                f"check imu.mount_rpy_deg and the compasses, estimate calibration.{key}_scale or raise imu.noise.{key}",
                chance=by_chance,
            )


def bias_drift(evidence: Evidence) -> Iterator[Statistic]:
    """How far the IMU's biases went from start to end, in sds of their walks: a gyro that warms up goes too far."""
    if evidence.optimum is None or len(evidence.problem) < 3:
        return
    r, time = _motion_residuals(evidence), evidence.problem.time
    share = np.sqrt(np.diff(time) / (time[-1] - time[0]))  # whitened steps become parts of the way
    for name, columns, key, unit, factor in BIASES:
        gone = np.abs(share @ r[:, columns])
        axis, history = int(np.argmax(gone)), evidence.main.history.get(name)
        if history is None:
            continue
        first, last = factor * history.value[0, axis], factor * history.value[-1, axis]
        yield Statistic(
            "bias drift",
            "imu",
            evidence.start,
            evidence.end,
            float(gone[axis]),
            f"{history.labels[axis]} drifts from {first:.2g} to {last:.2g} {unit} during the dive, {gone[axis]:.0f} sd "
            f"of what imu.noise.{key}_walk allows",
            f"let the IMU warm up before the dive, or raise imu.noise.{key}_walk",
        )


def _moved_motions(evidence: Evidence, here: Array) -> Iterator[Array]:
    """By how much what is considered, each component one sd away, moves the residuals, shape (n - 1, 15)."""
    best = evidence.optimum
    if isinstance(best, ChainOptimum):
        for state in best.moved_by_considered():
            yield best.wide.problem.motion_residuals(state) - here


def _motion_residuals(evidence: Evidence) -> Array:
    """Whitened residuals of the n - 1 motions between the smoothed keyframes, shape (n - 1, 15)."""
    assert evidence.optimum is not None
    return evidence.optimum.problem.motion_residuals(evidence.optimum.state)


def _squares(a: Trajectory, b: Trajectory, P: Array, heading_variance: Array) -> dict[str, Array]:
    """Squared differences of two tracks per degree of freedom, in units of a covariance, shape (n,) each."""
    d, turned = a.p_n - b.p_n, wrap_angle(a.rpy[:, 2] - b.rpy[:, 2])
    level = np.einsum("ni,nij,nj->n", d[:, :2], np.linalg.inv(P[:, :2, :2]), d[:, :2]) / 2.0
    return {"position": level, "depth": d[:, 2] ** 2 / P[:, 2, 2], "heading": turned**2 / heading_variance}


def rms_of(values: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def found_noise(evidence: Evidence) -> Iterator[Statistic]:
    """How far what was found in the dive has moved its track: noise that matters to nothing is no evidence of error.

    Nor is a move that the sd before had room for, as it has for a considered constant that the dive shows.
    """
    track, before = evidence.main.trajectory, evidence.before
    if before is None or len(before) != len(track):
        return
    squares = [_squares(before, track, t.cov_p, t.cov_theta[:, 2, 2])["position"] for t in (track, before)]
    square = min(squares, key=np.mean)
    apart = np.linalg.norm((before.p_n - track.p_n)[:, :2], axis=1)
    k, moved = int(np.argmax(apart)), rms_of(np.sqrt(square))
    for sensor, cause in evidence.revealed:
        yield Statistic(
            "found",
            sensor,
            float(track.time[k]),
            float(track.time[k]),
            moved,
            f"{cause}; to believe so moved the track by up to {apart[k]:.2g} m, {moved:.1f} of its sds (rms)",
            "check the instrument, and state what you know of it",
        )


def fast_current(evidence: Evidence) -> Iterator[Statistic]:
    """How fast the current changes at one depth, where that was found: wrong profiles look like a restless current."""
    knot = evidence.initial.beliefs.get(LAYERS[0])
    if WATER_LAYER not in evidence.initial.instruments or knot is None:
        return
    if knot.walk > evidence.initial.config.water.walk_mps:
        yield Statistic(
            "current walk",
            WATER_LAYER,
            evidence.start,
            evidence.end,
            float(knot.walk),
            f"by its profiles the current changes by {knot.walk * sqrt(MINUTE):.2g} m/s in a minute at one depth, "
            "faster than water does",
            FAST_CURRENT,
        )


def rivals(evidence: Evidence) -> Iterator[Statistic]:
    """How far apart the explanations put the track that are clear each by itself."""
    as_clearly = "as clearly as what was found" if evidence.revealed else "better than noise does"
    track = evidence.main.trajectory
    for rival in evidence.rivals:
        if len(rival.p_n) != len(track) or evidence.optimum is None:
            continue
        d = (rival.p_n - evidence.optimum.state.p_n)[:, :2]
        P = track.cov_p[:, :2, :2]
        square = np.einsum("ni,nij,nj->n", d, np.linalg.inv(P), d) / 2.0
        k = int(np.argmax(np.linalg.norm(d, axis=1)))
        yield Statistic(
            "rivals",
            rival.error.sensor,
            float(track.time[k]),
            float(track.time[k]),
            rms_of(np.sqrt(square)),
            f"{TABLE[rival.error.variable].about} explains the dive {as_clearly}, and puts the track up to "
            f"{np.linalg.norm(d[k]):.2g} m elsewhere; the stated sd covers both",
            f"find out which is so, and state the other as exact: calibration.{rival.error.variable}: "
            "{estimate: false}",
        )


def uncertain(evidence: Evidence) -> Iterator[Statistic]:
    """The sd itself: a track that is known to no better than a part of its length is of little use."""
    track = evidence.main.trajectory
    sd = np.sqrt(track.cov_p[:, 0, 0] + track.cov_p[:, 1, 1])
    if not np.isfinite(sd).any():
        return
    k = int(np.nanargmax(sd))
    yield Statistic(
        "uncertain",
        "dive",
        float(track.time[k]),
        float(track.time[k]),
        float(sd[k]) / max(LITTLE_M, 0.25 * track.distance),
        f"the position is known to {sd[k]:.0f} m only, after {track.distance:.0f} m, "
        f"at {evidence.since(float(track.time[k])):.0f} s",
        "see which measurements are missing there (rovgraph check), and what was left out",
    )


def filter_smoother_separation(evidence: Evidence) -> Iterator[Statistic]:
    """Smoothed against filtered position, depth and heading, in joint sds.

    Squared, the difference of a healthy pair is below a chi-square variable: its variance is P_f - P_s, and P_f + P_s
    is what it is compared with.
    """
    smoothed, filtered = evidence.estimate("smoothed"), evidence.estimate("filtered")
    if smoothed is None or filtered is None or len(smoothed.trajectory) != len(filtered.trajectory):
        return
    yield from separation_of(smoothed.trajectory, filtered.trajectory, evidence.start)


def separation_of(s: Trajectory, f: Trajectory, start: float) -> Iterator[Statistic]:
    """A smoothed and a filtered track of the same epochs, of a dive that began at ``start`` [s]."""
    at = np.flatnonzero(s.time >= start + SETTLED_S)
    at = at[:: max(len(at) // COARSE, 1)]
    if not len(at):
        return
    d, turned = (f.p_n - s.p_n)[at], wrap_angle(f.take(at).rpy[:, 2] - s.take(at).rpy[:, 2])
    joint = _squares(f.take(at), s.take(at), (f.cov_p + s.cov_p)[at], (f.cov_theta + s.cov_theta)[at, 2, 2])
    sizes = {
        "position": (2.0 * joint["position"], np.linalg.norm(d[:, :2], axis=1), "m"),
        "depth": (joint["depth"], np.abs(d[:, 2]), "m"),
        "heading": (joint["heading"], np.rad2deg(np.abs(turned)), "deg"),
    }
    # iSAM2's filtered sds lack what is considered, which the smoothed ones have
    cov_p, yaw = f.cov_p[at], np.maximum(f.cov_theta[at, 2, 2], s.cov_theta[at, 2, 2])
    lacking = np.maximum(np.diagonal(s.cov_p[at] - cov_p, axis1=1, axis2=2), 0.0)
    by_filter = _squares(f.take(at), s.take(at), cov_p + lacking[:, None] * np.eye(3), yaw)
    for what, (square, size, unit) in sizes.items():
        k, mean = int(np.argmax(square)), float(np.mean(by_filter[what]))
        yield Statistic(
            "separation",
            "dive",
            start,
            float(s.time[-1]),
            mean,
            f"smoothed and filtered {what} differ by {rms_of(size):.2g} {unit} (rms), {np.sqrt(mean):.1f} of "
            "the filter's sds",
            "later measurements contradict the filter all along: look at the calibration and at the residuals",
        )
        yield Statistic(
            "estimates",
            "dive",
            float(s.time[at[k]]),
            float(s.time[at[k]]),
            float(square[k]),
            f"smoothed and filtered {what} differ by {size[k]:.2g} {unit}, {np.sqrt(square[k]):.0f} joint sds, "
            f"at {float(s.time[at[k]]) - start:.0f} s",
            "later measurements contradict the filter: look at the residuals before that time",
        )


def excluded_intervals(evidence: Evidence) -> Iterator[Statistic]:
    """Intervals in which a sensor contradicts all others, of `rovgraph.inference.faulty_intervals`."""
    for stretch in () if evidence.optimum is None else evidence.optimum.solution.stretches:
        yield excluded_interval(stretch, evidence.start)


def excluded_interval(stretch: FaultyInterval, start: float) -> Statistic:
    """One such interval; ``start`` is when the dive started [s]."""
    return Statistic(
        "taken out",
        stretch.sensor,
        stretch.begin,
        stretch.end,
        stretch.end - stretch.begin,
        f"contradicts all other sensors, {span(stretch.begin, stretch.end, start)}, and was ignored there",
        "check the instrument at that time: a bias, a false lock, water instead of the bottom; an error that grew "
        "slowly may have started earlier",
    )


def ambiguous_optimum(evidence: Evidence) -> Iterator[Statistic]:
    """Likelihood of the next best optimum against the one that was chosen."""
    for sensor, cause, cost in evidence.ambiguities:
        remedy = "turn, or pass the beacon on its other side; or state its place under beacons"
        yield Statistic("close", sensor, evidence.start, evidence.end, exp(-cost), cause, remedy)
    if evidence.optimum is None or not isfinite(evidence.optimum.solution.runner_up):
        return
    margin = evidence.optimum.solution.runner_up
    yield Statistic(
        "close",
        "dive",
        evidence.start,
        evidence.end,
        exp(-margin),
        f"sensors contradict each other, and a cost difference of only {margin:.1f} decided which one to ignore",
        "check the rejected sensors, and remove the wrong one from the log",
    )


OVER_S = 3.0  # T
SHIFTS_S, SHIFT_SD_S = np.arange(-2.0, 2.01, 0.05), 0.1 / 3.0
ENOUGH = 50  # pings
UNTIL_THEN = "until that is mended the track is wrong"


def dvl_cause(evidence: Evidence) -> Iterator[Statistic]:
    """The axes or the clock that would make the DVL agree with the IMU, where many pings were rejected."""
    best, config = evidence.optimum, evidence.initial.config
    if best is None or (compared := _Compared.of(best, config)) is None:
        return
    R_bs = mount_matrix(config.dvl.mount_rpy_deg)
    as_configured = compared.error(np.eye(3), R_bs, 0.0)
    turned = [compared.error(H, R_bs, 0.0) for H in ORIENTATIONS]
    shifted = {float(s): compared.error(np.eye(3), R_bs, float(s)) for s in SHIFTS_S}
    shift = min(shifted, key=lambda s: shifted[s])
    if min(turned) < shifted[shift]:
        cause, remedy = axes_remedy(ORIENTATIONS[int(np.argmin(turned))], R_bs)
        figure, kind = as_configured / min(turned), "axes"
    else:
        late = "late" if shift > 0 else "early"
        cause = f"its stamps are about {abs(shift):.2g} s {late} relative to the IMU's"
        remedy = remedy_of_lag(config, "dvl", shift, SHIFT_SD_S)
        figure, kind = as_configured / shifted[shift], "clock"
    text = f"{cause}; corrected, it agrees {figure:.1f} times better with the IMU"
    found = Statistic(kind, "dvl", evidence.start, evidence.end, figure, text, remedy)
    of_dvl = [f for f in evidence.findings if f.wrong and (f.sensor == "dvl" or f.kind == "jump")]
    named = [f for f in of_dvl if f.kind == "axes" or f.of_clock]
    if found.severity and named:
        kind, text = "clock" if named[0].of_clock else "axes", "; ".join(finding.text for finding in named)
        found = replace(found, kind=kind, cause=text, remedy=UNTIL_THEN)
    yield found


class _Compared:
    """Pings a few seconds apart, and the change of velocity between them by the IMU.

    Parameters
    ----------
    time : ndarray, shape (n,), of the pings [s]
    z, swing_b : ndarray, shape (n, 3), what they measured, averaged, and the velocity of the lever arm [m/s]
    before : ndarray of int, shape (m,), for each of the last m pings the one some seconds before
    turn : ndarray, shape (m, 3, 3), from body axes then to those now
    change_b : ndarray, shape (m, 3), of the velocity, by the IMU, in the body axes now [m/s]
    """

    def __init__(self, time: Array, z: Array, swing_b: Array, pairs: tuple[Array, Array], turn: Array, change_b: Array):
        self.time, self.z, self.swing_b, self.turn, self.change_b = time, z, swing_b, turn, change_b
        self.before, self.now = pairs

    @staticmethod
    def of(best: Optimum, config: Config) -> "_Compared | None":
        """None = few pings were rejected, or there is nothing to compare them with."""
        problem, state = best.problem, best.state
        heads = [sensor for sensor in ("dvl", *BEAM_SENSORS) if sensor in best.blocks]
        if not heads or np.mean(np.concatenate([best.weights[s] for s in heads]) <= 0.0) < CONTRADICTED:
            return None
        block, solved = best.blocks[heads[0]], solved_pings(problem)
        z, arm_b = block.z, np.array(config.dvl.lever_arm_m) - np.array(config.imu.lever_arm_m)
        if len(solved.row):  # most pings are taken by their beams
            block, z = replace(block, index=solved.row), solved.velocity
        if len(block) < ENOUGH or len(problem) < 3:
            return None
        dv, seconds = problem.motions[:, motion_row.VELOCITY], problem.motions[:, motion_row.DURATION]
        gravity = np.array([0.0, 0.0, block.gravity])
        force_n = rotate(state.R_nb[:-1], dv - state.bias[:-1, :3] * seconds[:, None])
        velocity_n = np.vstack([np.zeros(3), np.cumsum(force_n + gravity * seconds[:, None], axis=0)])
        broken = np.cumsum(problem.bridged | problem.coasted)
        k = block.keyframe.astype(np.int64)
        now = np.arange(len(block))
        before = np.searchsorted(block.time, block.time - OVER_S)
        apart = block.time - block.time[before]
        chosen = (apart > 0.5 * OVER_S) & (apart < 1.5 * OVER_S) & (broken[k] == broken[k[before]])
        now, before = now[chosen], before[chosen]
        if len(now) < ENOUGH:
            return None
        R_bn = transpose(state.R_nb[k[now]])
        rate_b = block.rate_b - state.bias[k, 3:]
        swing_b = cross(rate_b, np.broadcast_to(arm_b, rate_b.shape))
        change_b = rotate(R_bn, velocity_n[k[now]] - velocity_n[k[before]])
        return _Compared(block.time, _averaged(z), swing_b, (before, now), R_bn @ state.R_nb[k[before]], change_b)

    def error(self, H: Array, R_bs: Array, shift: float) -> float:
        """Mean square of the differences, for axes H and stamps that are late by ``shift`` [m^2/s^2]."""
        z = self.z if shift == 0.0 else _at(self.time + shift, self.time, self.z)
        v_b = rotate(R_bs @ H, z) - self.swing_b
        off = np.sum((v_b[self.now] - rotate(self.turn, v_b[self.before]) - self.change_b) ** 2, axis=1)
        return float(np.minimum(off, CLIPPED**2 * max(float(np.median(off)), 1e-12)).mean())


def _averaged(z: Array) -> Array:
    """Means of five pings around each: a shift interpolates, which would lower the noise of single pings, too."""
    padded = np.pad(z, ((2, 2), (0, 0)), mode="edge")
    return np.asarray(sum(padded[k : k + len(z)] for k in range(5)) / 5.0)


def _at(when: Array, time: Array, values: Array) -> Array:
    return np.column_stack([np.interp(when, time, column) for column in values.T])
