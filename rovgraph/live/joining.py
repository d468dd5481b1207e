"""Sensors that begin after the first seconds: the filter goes on with what they need in its state."""

from dataclasses import replace

import numpy as np

from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.estimators.eskf.fixed_lag import FixedLag
from rovgraph.instruments import instruments
from rovgraph.log import Measurement

LATE = ("dvl_water", "thruster")  # who has none shall not pay for a current in the filter's state
ANYWHERE_M = 1e4  # sd of where a dive began that knows no fix


def is_late(m: Measurement, engine: FixedLag) -> bool:
    """Whether a measurement is of a sensor that the configuration has and the filter does not know."""
    if m.sensor not in LATE or m.sensor in engine.initial.instruments:
        return False
    return m.sensor != "thruster" or engine.initial.config.graph.hydrodynamics


def can_join(m: Measurement, engine: FixedLag) -> bool:
    """Whether the filter can go on with its sensor from this measurement on."""
    as_many = m.sensor != "thruster" or len(m.values) == len(engine.initial.config.vehicle.thrusters)
    return as_many and bool(engine.snapshots) and bool(np.isfinite(m.values[:3]).all())


def joined(engine: FixedLag, sensor: str) -> FixedLag:
    """A filter that goes on with one sensor more."""
    initial = engine.initial
    more = instruments(initial.config, initial.config.imu.lever_arm_m)[sensor]
    return engine.continued(replace(initial, instruments={**initial.instruments, sensor: more}))


def unlocated(engine: FixedLag) -> FixedLag:
    """A filter that goes on not knowing where it is, nor where it began: fixes will say."""
    initial = engine.initial
    p_sd = np.append(np.full(2, ANYWHERE_M), initial.prior.p_sd[2])
    wide: InitialConditions = replace(initial, prior=replace(initial.prior, p_sd=p_sd))
    return engine.continued(wide, ANYWHERE_M)
