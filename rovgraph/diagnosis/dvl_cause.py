"""Why a DVL contradicts the IMU: axes that are swapped or turned round, or a clock that is off.

Over a few seconds the IMU knows how the velocity changes. In body axes, with l the lever arm and T the time between
two pings,

    v_b(t) - R_b(t)b(t-T) v_b(t-T) = R_b(t)n (integral of R_nb f_b + g),  v_b = R_bs H z - w x l

holds for the right signed permutation H of the DVL's axes and the right shift of its stamps. Only turns between the
pings and the vertical enter, so it does not matter how wrong the heading is. But the estimate comes of the wrong DVL.
The check of the log compares without an estimate, so its line is given where it finds something.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rovgraph.check.lags import ORIENTATIONS
from rovgraph.config import mount_matrix
from rovgraph.diagnosis.alarm import Statistic
from rovgraph.diagnosis.evidence import Evidence
from rovgraph.engine.measurements import Measurements
from rovgraph.engine.optimum import Optimum
from rovgraph.geometry import Array, cross, rotate, transpose
from rovgraph.kernels import motion_row
from rovgraph.rules import CLIPPED, CONTRADICTED, remedy_of_lag
from rovgraph.sensors.dvl import DvlVelocity, axes_remedy

OVER_S = 3.0  # T
SHIFTS_S, SHIFT_SD_S = np.arange(-2.0, 2.01, 0.05), 0.1 / 3.0
ENOUGH = 50  # pings
UNTIL_THEN = "until that is mended the track is wrong"


def dvl_cause(evidence: Evidence) -> Iterator[Statistic]:
    """The axes or the clock that would make the DVL agree with the IMU, where many pings were rejected."""
    best, config = evidence.optimum, evidence.initial.config
    if best is None or "dvl" not in best.blocks or np.mean(best.weights["dvl"] <= 0.0) < CONTRADICTED:
        return
    compared = _Compared.of(best, best.blocks["dvl"])
    if compared is None:
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
    """Pings a few seconds apart, and how the IMU says that the velocity changed between them.

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
    def of(best: Optimum, block: Measurements) -> "_Compared | None":
        problem, state = best.problem, best.state
        model = block.instrument.model
        if not isinstance(model, DvlVelocity) or len(block) < ENOUGH or len(problem) < 3:
            return None
        dv, seconds = problem.motions[:, motion_row.VELOCITY], problem.motions[:, motion_row.DURATION]
        gravity = np.array([0.0, 0.0, block.gravity])
        force_n = rotate(state.R_nb[:-1], dv - state.bias[:-1, :3] * seconds[:, None])
        velocity_n = np.vstack([np.zeros(3), np.cumsum(force_n + gravity * seconds[:, None], axis=0)])
        broken = np.cumsum(problem.bridged)
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
        swing_b = cross(rate_b, np.broadcast_to(model.lever_arm_b, rate_b.shape))
        change_b = rotate(R_bn, velocity_n[k[now]] - velocity_n[k[before]])
        return _Compared(block.time, _averaged(block.z), swing_b, (before, now), R_bn @ state.R_nb[k[before]], change_b)

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
