"""Chains with additional unknowns: constants that the estimate holds, or errors that last.

The effect of held constants on the estimate follows from one elimination at the optimum, without another solution:
their derivatives are those of the measurement equations, of the IMU's mean signals for its scales, and of the
predictions by time for stamps.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rovgraph.geometry import Array, rotate
from rovgraph.inference.chain import Chain
from rovgraph.kernels import motion_row as at
from rovgraph.model.calibration import STEADY, TABLE, Belief
from rovgraph.model.config import mount_matrix
from rovgraph.model.gauss_markov import stationary_walk
from rovgraph.model.state import Jacobians, State
from rovgraph.problem.calibration_roles import CalibrationRoles
from rovgraph.problem.measurements import Measurements, pieces
from rovgraph.problem.motion import COLUMNS, SCALES
from rovgraph.problem.problem import Index
from rovgraph.sensors import innovation

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
        if block.instrument.time_offset in names and not block.may_be_late:
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
    """A chain with the measurements of sensors whose stamps may be late and that have no kernel."""

    timed: Mapping[str, Measurements]

    @cached_property
    def _unknown_to_kernels(self) -> set[str]:
        return super()._unknown_to_kernels | self.timed.keys()

    @cached_property
    def given(self) -> dict[str, Measurements]:
        given = self._unknown_to_kernels
        if given <= self.timed.keys():  # in the order in which they measure first, as of all blocks
            return {sensor: block for sensor, block in self.timed.items() if sensor in given}
        return {sensor: self.timed.get(sensor, block) for sensor, block in super().given.items()}


@dataclass(frozen=True)
class _TimedMeasurements(Measurements):
    """Measurements whose stamps may be late: ``slope``, shape (n, dim), is how a prediction changes with time."""

    slope: Array

    def at(self, index: slice | Index) -> "_TimedMeasurements":
        return replace(self, index=self.index[index], slope=self.slope[index])

    def linearize(self, state: State) -> tuple[Array, Jacobians]:
        r, H = super().linearize(state)
        assert self.instrument.time_offset is not None
        return r, H | {self.instrument.time_offset: self.W @ -self.slope[..., None]}


def _timed(one: Measurements, wide: CalibrationRoles, chain: Chain, state: State) -> _TimedMeasurements:
    """Measurements with the rate of their predictions [unit/s], from the keyframes around each."""
    model, time, rate_b = one.instrument.model, chain.problem.time, chain.problem.rate_b
    before = np.maximum(one.keyframe - (one.dt < SHORT_S), 0)
    after, slope = np.minimum(one.keyframe + 1, len(time) - 1), np.empty(one.z.shape)
    for part in pieces(0, len(one)):
        k, j = before[part], after[part]
        here, there = state.at(k), state.at(j)
        there = replace(there, calibration=here.calibration)  # errors that come and go are no motion
        begin, end = model.predict(here, rate_b[k])[0], model.predict(there, rate_b[j])[0]
        slope[part] = innovation(model, end, begin) / np.maximum(time[j] - time[k], 1e-6)[:, None]
    return _TimedMeasurements(one.problem, one.index, one.instrument, one.gravity, wide, slope)


def _mean_signal_to_bias(chain: Chain, state: State) -> Array:
    """As `rovgraph.problem.motion.scale_to_bias`, from the preintegrated motions, shape (n - 1, 6, 6)."""
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
