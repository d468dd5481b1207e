"""Chains with more unknowns than a dive's: constants that its estimate holds, or errors that last.

What held constants would do to the estimate follows from one elimination where it stands, without another solution:
their derivatives are those of the measurement equations, of the IMU's mean signals for its scales, and of the
predictions by time for stamps.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from rovgraph.calibration import STEADY, TABLE, Belief
from rovgraph.config import mount_matrix
from rovgraph.engine.chain import Chain
from rovgraph.engine.measurements import Block
from rovgraph.engine.pieces import pieces
from rovgraph.engine.scale import COLUMNS, SCALES
from rovgraph.engine.unknowns import Unknowns
from rovgraph.gauss_markov import stationary_walk
from rovgraph.geometry import Array, rotate
from rovgraph.kernels import motion_row as at
from rovgraph.sensors import innovation
from rovgraph.state import Jacobians, State

SHORT_S = 1e-3  # from its keyframe, a measurement is taken to be at it


def widened(chain: Chain, state: State, names: tuple[str, ...], beliefs: Mapping[str, Belief] | None = None) -> Chain:
    """The chain with some of the constants that it holds in its border, behind those that are there.

    Parameters
    ----------
    chain : of the dive
    state : where it is linearised afterwards
    names : constants that are not estimated, and whose sensors are in use
    beliefs : of all of the calibration; None = the chain's own
    """
    wide, timed, rows = chain.unknowns.estimating(names), {}, chain.problem
    offsets = {i.time_offset for i in chain.initial.instruments.values()}
    for sensor, block in chain.blocks.items() if offsets & set(names) else ():
        if block.instrument.time_offset in names and block.window is None:
            timed[sensor] = _timed(block, wide, chain, state)
    if {*SCALES} & set(names) and not len(rows.scales):
        rows = replace(rows, scales=_mean_signal_to_bias(chain, state))
    return _WidenedChain(rows, chain.initial, beliefs or chain.beliefs, wide, timed)


def begin_at(chain: Chain, point: State) -> State:
    """A point of a chain, from one of a chain with other unknowns."""
    n, calibration = len(chain.problem), dict(point.calibration)
    for name in chain.layout.walking:
        calibration[name] = np.array(np.broadcast_to(calibration[name], (n, TABLE[name].dim)))
    return replace(point, calibration=calibration)


def with_lasting(chain: Chain, name: str, sd: float, time_constant: float, changes: tuple[float, ...] = ()) -> Chain:
    """The chain with an error that lasts among its unknowns; one of infinite time constant is constant, or `changes`.

    Parameters are those of `Belief`.
    """
    believed = lasting_belief(chain.beliefs[name], sd, time_constant, changes)
    return replace(chain, beliefs={**chain.beliefs, name: believed}, unknowns=chain.unknowns.with_lasting(believed))


def lasting_belief(before: Belief, sd: float, time_constant: float, changes: tuple[float, ...] = ()) -> Belief:
    """A belief in an error that lasts; parameters are those of `with_lasting`."""
    walk = STEADY * sd if changes else stationary_walk(sd, time_constant)
    more = replace(before, estimate=True, considered=False, sd=sd, walk=walk, time_constant=time_constant)
    return replace(more, changes=changes)


@dataclass(frozen=True)
class _WidenedChain(Chain):
    """A chain with the measurements of sensors whose stamps may be late, which no kernel knows."""

    timed: Mapping[str, Block]

    @cached_property
    def given(self) -> dict[str, Block]:
        given = self._unknown_to_kernels
        if given <= self.timed.keys():  # in the order in which they measure first, as of all blocks
            return {sensor: block for sensor, block in self.timed.items() if sensor in given}
        return {sensor: self.timed.get(sensor, block) for sensor, block in super().given.items()}


@dataclass(frozen=True)
class _TimedBlock(Block):
    """A block whose stamps may be late: ``slope``, shape (n, dim), is how a prediction changes with time."""

    slope: Array | None = None

    def at(self, index: slice | Array) -> "_TimedBlock":
        some, slope = super().at(index), self.slope
        assert isinstance(some, _TimedBlock) and slope is not None
        return replace(some, slope=slope[index])

    def predict(self, state: State) -> tuple[Array, Jacobians]:
        predicted, H = super().predict(state)
        assert self.slope is not None and self.instrument.time_offset is not None
        return predicted, H | {self.instrument.time_offset: -self.slope[..., None]}


def _timed(block: Block, wide: Unknowns, chain: Chain, state: State) -> _TimedBlock:
    """A block that knows how its predictions change with time [unit/s], from the keyframes around each."""
    scales = SCALES if block.scale_to_bias is not None else ()
    wider = replace(block, unknowns=wide.of([*block.instrument.calibration, *scales]))
    model, time, rate_b = block.instrument.model, chain.problem.time, chain.problem.rate_b
    before = np.maximum(block.keyframe - (block.motion.dt < SHORT_S), 0)
    after, slope = np.minimum(block.keyframe + 1, len(time) - 1), np.empty(block.z.shape)
    for part in pieces(0, len(block)):
        k, j = before[part], after[part]
        here, there = state.at(k), state.at(j)
        there = replace(there, calibration=here.calibration)  # errors that come and go are no motion
        begin, end = model.predict(here, rate_b[k])[0], model.predict(there, rate_b[j])[0]
        slope[part] = innovation(model, end, begin) / np.maximum(time[j] - time[k], 1e-6)[:, None]
    return _TimedBlock(**{f.name: getattr(wider, f.name) for f in fields(Block)}, slope=slope)


def _mean_signal_to_bias(chain: Chain, state: State) -> Array:
    """As `rovgraph.engine.scale.scale_to_bias`, from the preintegrated motions, shape (n - 1, 6, 6)."""
    rows: Array = chain.problem.motions
    bias = state.bias[:-1]
    R_bs = mount_matrix(chain.initial.config.imu.mount_rpy_deg)
    seconds = np.maximum(rows[:, at.DURATION], 1e-6)[:, None]
    rate_b = rows[:, at.TANGENT : at.TANGENT + 3] / seconds + rows[:, at.BIAS + 3 : at.BIAS + 6] - bias[:, 3:]
    force_b = rows[:, at.TANGENT + 6 : at.TANGENT + 9] / seconds - bias[:, :3]
    S = np.zeros((len(rows), 6, 6))
    for signal_b, part in ((force_b, COLUMNS["acc_scale"]), (rate_b, COLUMNS["gyr_scale"])):
        S[:, part, part] = R_bs * rotate(R_bs.T, signal_b)[:, None, :]
    return S
