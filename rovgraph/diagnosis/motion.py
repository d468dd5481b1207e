"""Alarms on the motion: the IMU against everything else, and the smoothed track against the filtered one."""

from collections.abc import Iterator

import numpy as np
from scipy.special import chdtri

from rovgraph.calibration import TABLE
from rovgraph.diagnosis.alarm import Statistic
from rovgraph.diagnosis.evidence import Evidence, windows
from rovgraph.engine.chain_optimum import ChainOptimum
from rovgraph.geometry import Array, wrap_angle
from rovgraph.rules import CHANCE, RULES, SETTLED_S
from rovgraph.trajectory import Trajectory

IMU_S = 20.0  # over which errors of the IMU last that are no noise
# of a motion's residual: what people call it, columns, and the signal behind it
PARTS = (("its rotation about", slice(0, 3), "gyr"), ("its velocity along", slice(6, 9), "acc"))
# a bias's history, columns of a motion's residual, what people call it, its unit, and how many of them make one
BIASES = (("acc_bias", slice(9, 12), "acc", "m/s2", 1.0), ("gyr_bias", slice(12, 15), "gyr", "deg/s", np.rad2deg(1.0)))
COARSE = 300  # epochs at which both are compared
LITTLE_M = 10.0  # an sd of so much may be all that a dive wants [m]


def imu(evidence: Evidence) -> Iterator[Statistic]:
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
    by_chance = float(chdtri(n, CHANCE)) / n
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


def found(evidence: Evidence) -> Iterator[Statistic]:
    """How far what was found in the dive has moved its track: noise that matters to nothing is no evidence of error."""
    track, before = evidence.main.trajectory, evidence.before
    if before is None or len(before) != len(track):
        return
    square = _squares(before, track, track.cov_p, track.cov_theta[:, 2, 2])["position"]
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


def rivals(evidence: Evidence) -> Iterator[Statistic]:
    """How far apart the explanations put the track that are clear each by itself."""
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
            f"{TABLE[rival.error.variable].about} explains the dive as clearly as what was found, and puts the track "
            f"up to {np.linalg.norm(d[k]):.2g} m elsewhere; the stated sd covers both",
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


def estimates(evidence: Evidence) -> Iterator[Statistic]:
    """Smoothed against filtered position, depth and heading, in joint sds.

    Squared, the difference of a healthy pair is below a chi-square variable: its variance is P_f - P_s, and P_f + P_s
    is what it is compared with.
    """
    smoothed, filtered = evidence.estimate("smoothed"), evidence.estimate("filtered")
    if smoothed is None or filtered is None or len(smoothed.trajectory) != len(filtered.trajectory):
        return
    yield from apart(smoothed.trajectory, filtered.trajectory, evidence.start)


def apart(s: Trajectory, f: Trajectory, start: float) -> Iterator[Statistic]:
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
    own = _squares(f.take(at), s.take(at), f.take(at).cov_p, f.cov_theta[at, 2, 2])
    for what, (square, size, unit) in sizes.items():
        k, mean = int(np.argmax(square)), float(np.mean(own[what]))
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
