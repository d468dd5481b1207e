"""What a dive says of constants that its estimate holds.

A constant that is held (the DVL's scale, the tilt of its mounting, the gyro's scale, a time offset) is released
together with what is estimated, in one Gauss-Newton step from the optimum: the Lagrange multiplier or score test
(Rao 1948; Engle 1984). Where the configuration is right, the step over its sd is a standard normal number, so a step
of many sds says that the constant is not what it is held at, and the step says what it is instead. Each is released by
itself: two that move the same measurements would hide each other.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from rovgraph.config import mount_matrix
from rovgraph.engine.chain import Chain
from rovgraph.engine.chain_optimum import ChainOptimum
from rovgraph.engine.gauss_newton import Gates
from rovgraph.engine.measurements import Block
from rovgraph.engine.scale import COLUMNS, SCALES
from rovgraph.engine.unknowns import unknowns
from rovgraph.geometry import Array, rotate
from rovgraph.kernels import motion_row as at
from rovgraph.sensors import innovation
from rovgraph.state import Jacobians, State

SHORT_S = 1e-3  # from its keyframe, a measurement is taken to be at it
WIDE = 100.0  # times the prior sd: what is released is free


@dataclass(frozen=True)
class Released:
    """A constant that was released.

    Attributes
    ----------
    name, label : of the calibration variable, and of its component
    step, sd : from where it is held to where the measurements would have it, and its sd [unit of the variable]
    """

    name: str
    label: str
    step: float
    sd: float

    @property
    def significance(self) -> float:
        """The step in its sds, positive."""
        return abs(self.step) / self.sd


@dataclass(frozen=True)
class _ReleasedChain(Chain):
    """A chain with the measurements of sensors whose stamps may be late, which no kernel knows."""

    timed: Mapping[str, Block]

    @cached_property
    def given(self) -> dict[str, Block]:
        return {sensor: self.timed.get(sensor, block) for sensor, block in super().given.items()}


@dataclass(frozen=True)
class _TimedBlock(Block):
    """A block whose stamps may be late: ``slope``, shape (n, dim), is how a prediction changes with time."""

    slope: Array | None = None

    def predict(self, state: State) -> tuple[Array, Jacobians]:
        predicted, H = super().predict(state)
        assert self.slope is not None and self.instrument.time_offset is not None
        return predicted, H | {self.instrument.time_offset: -self.slope[..., None]}


def release(best: ChainOptimum, names: Iterable[str], gates: Gates | None = None) -> list[Released]:
    """Each component of some constants that are held, released by itself.

    Parameters
    ----------
    best : the optimum
    names : calibration variables; those that are estimated, or whose sensor is not in use, are passed over
    """
    chain, state = best.chain, best.state
    held = [name for name in names if name not in best.unknowns.estimated]
    beliefs = dict(chain.beliefs)
    for name in held:
        own = beliefs[name]
        beliefs[name] = replace(own, estimate=True, sd=WIDE * own.variable.sd, walk=0.0)
    wide, timed, rows = unknowns(beliefs, chain.blocks), {}, chain.rows
    for sensor, block in chain.blocks.items():
        offset = block.instrument.time_offset
        if offset in held and block.window is None:
            scales = SCALES if block.scale_to_bias is not None else ()
            wider = replace(block, unknowns=wide.of([*block.instrument.calibration, *scales]))
            shared = {f.name: getattr(wider, f.name) for f in fields(Block)}
            timed[sensor] = _TimedBlock(**shared, slope=_slope(block, best))
    if not len(rows.scales):
        rows = replace(rows, scales=_mean_signal_to_bias(best))  # reckoned from the motions alone
    released = _ReleasedChain(chain.intervals, chain.initial, beliefs, wide, rows, timed)
    root = released.eliminate(state, best.solution.gates if gates is None else gates)
    R, z = root.border[:, :-1], root.border[:, -1]
    information, score = R.T @ R, R.T @ z
    kept = [released.layout.places[name] for name in best.unknowns.estimated]
    always = np.concatenate([np.empty(0, np.int64), *(np.r_[part] for border, part in kept if border)])
    out = []
    for name in held:
        if name not in released.layout.places:
            continue
        for label, component in zip(beliefs[name].variable.labels, np.r_[released.layout.places[name][1]], strict=True):
            chosen = np.append(always, component)
            P = np.linalg.inv(information[np.ix_(chosen, chosen)])
            out.append(Released(name, label, float(P[-1] @ score[chosen]), float(np.sqrt(P[-1, -1]))))
    return out


def _slope(block: Block, best: ChainOptimum) -> Array:
    """Change of the predicted measurements with time, from the keyframes around each, shape (n, dim) [unit/s]."""
    model, time = block.instrument.model, np.array([i.time for i in best.intervals])
    rate_b = np.array([i.rate_b for i in best.intervals])
    before = np.maximum(block.keyframe - (block.motion.dt < SHORT_S), 0)
    after = np.minimum(block.keyframe + 1, len(time) - 1)
    begin, end = (model.predict(best.state.at(k), rate_b[k])[0] for k in (before, after))
    return np.asarray(innovation(model, end, begin) / np.maximum(time[after] - time[before], 1e-6)[:, None])


def _mean_signal_to_bias(best: ChainOptimum) -> Array:
    """As `rovgraph.engine.scale.scale_to_bias`, from the preintegrated motions, shape (n - 1, 6, 6)."""
    rows, bias = best.chain.rows.motions, best.state.bias[:-1]
    R_bs = mount_matrix(best.chain.initial.config.imu.mount_rpy_deg)
    seconds = np.maximum(rows[:, at.DURATION], 1e-6)[:, None]
    rate_b = rows[:, at.TANGENT : at.TANGENT + 3] / seconds + rows[:, at.BIAS + 3 : at.BIAS + 6] - bias[:, 3:]
    force_b = rows[:, at.TANGENT + 6 : at.TANGENT + 9] / seconds - bias[:, :3]
    S = np.zeros((len(rows), 6, 6))
    for signal_b, part in ((force_b, COLUMNS["acc_scale"]), (rate_b, COLUMNS["gyr_scale"])):
        S[:, part, part] = R_bs * rotate(R_bs.T, signal_b)[:, None, :]
    return S
