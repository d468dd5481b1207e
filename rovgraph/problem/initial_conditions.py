"""Initial conditions: the estimate and covariance where a dive begins."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from rovgraph.geometry import Array
from rovgraph.model.calibration import Belief
from rovgraph.model.config import Config, beliefs
from rovgraph.model.state import State
from rovgraph.problem.motion import gravity, has_constant_velocity
from rovgraph.sensors.instruments import Instrument, instruments


@dataclass(frozen=True)
class StatePrior:
    """Prior at the first keyframe.

    Attributes
    ----------
    state : State of one epoch, at the IMU
    rpy_sd, p_sd, v_sd : ndarray, shape (3,) [rad, m, m/s]; attitude about n's axes, as
        roll and pitch are small
    bias_sd : ndarray, shape (6,)
    """

    state: State
    rpy_sd: Array
    p_sd: Array
    v_sd: Array
    bias_sd: Array

    def covariance(self) -> Array:
        """Of pose, velocity and bias in the tangent space of `State`, shape (15, 15)."""
        R_nb = self.state.R_nb[0]
        P = np.diag(np.concatenate([self.rpy_sd, self.p_sd, self.v_sd, self.bias_sd]) ** 2)
        for part in (slice(0, 3), slice(3, 6)):
            P[part, part] = R_nb.T @ P[part, part] @ R_nb
        return P


@dataclass(frozen=True)
class Beliefs:
    """Noise and constants found in a dive, in place of the configuration's.

    Attributes
    ----------
    calibration : name -> belief of a calibration variable
    noise : sensor -> factor of its stated white noise
    """

    calibration: Mapping[str, Belief] = field(default_factory=dict)
    noise: Mapping[str, float] = field(default_factory=dict)

    def with_more(self, more: "Beliefs") -> "Beliefs":
        """The findings so far joined with new ones, of the noise by that time."""
        noise = {s: more.noise.get(s, 1.0) * self.noise.get(s, 1.0) for s in {**self.noise, **more.noise}}
        return Beliefs({**self.calibration, **more.calibration}, noise)


@dataclass(frozen=True)
class InitialConditions:
    """The resolved start of a dive.

    Attributes
    ----------
    config : effective configuration: what was null is filled in
    instruments : the sensors in use, lever arms relative to the IMU
    prior : of the first keyframe, at the IMU
    assumptions : what was assumed, one line each
    revealed : by the dive itself, and believed since
    """

    config: Config
    instruments: dict[str, Instrument]
    prior: StatePrior
    assumptions: list[str]
    revealed: Beliefs = Beliefs()

    @cached_property
    def beliefs(self) -> dict[str, Belief]:
        """The prior of every calibration variable, in the order of the table."""
        return {**beliefs(self.config), **self.revealed.calibration}

    def believing(self, more: Beliefs) -> "InitialConditions":
        """The same with what a dive has revealed."""
        noise = more.noise
        instruments = {s: replace(i, sd=noise[s] * i.sd) if s in noise else i for s, i in self.instruments.items()}
        return replace(self, instruments=instruments, revealed=self.revealed.with_more(more))

    @property
    def gravity(self) -> float:
        """Gravity that the motion is integrated with [m/s^2]."""
        return gravity(self.config)

    @property
    def streams(self) -> list[str]:
        """Names of the sensors in use, of the IMU's where the motion is its own."""
        return [*self.instruments, *(() if has_constant_velocity(self.config) else ("imu",))]

    def dump(self) -> dict[str, Any]:
        """Plain values and arrays from which `restored` makes it again."""
        prior = self.prior
        return {
            "config": self.config.model_dump(mode="json"),
            "sensors": list(self.instruments),
            "start": {name: getattr(prior, name) for name in ("rpy_sd", "p_sd", "v_sd", "bias_sd")},
            "at": {name: getattr(prior.state, name) for name in ("R_nb", "p_n", "v_n", "bias")},
            "assumptions": self.assumptions,
        }


def restored(state: Mapping[str, Any]) -> InitialConditions:
    """Initial conditions from their `InitialConditions.dump`."""
    config = Config.model_validate(state["config"])
    sensors = instruments(config, config.imu.lever_arm_m)
    prior = StatePrior(State(**state["at"]), **state["start"])
    return InitialConditions(config, {s: sensors[s] for s in state["sensors"]}, prior, list(state["assumptions"]))
