"""Small simulated dives for the tests, as `Log` objects that never touch a file."""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pandas as pd
import pytest

from rovgraph.geometry import Array, log_rotation, rotate, transpose
from rovgraph.inference.error_state import REINITIALISE_AT_S, ErrorStateFilter
from rovgraph.inference.estimate import Estimate
from rovgraph.inference.filter_step import FilterStep, Gaussian
from rovgraph.inference.graph.isam2 import IncrementalEstimator
from rovgraph.inference.initialise import initialise
from rovgraph.inference.smoother import BatchSmoother, assemble
from rovgraph.inference.trajectory import Trajectory
from rovgraph.log import STREAMS, Log, Stream
from rovgraph.model.config import Config, beliefs, load_config
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.sensors.dvl_beam import BEAMS, beam_geometry, beam_sd, velocity_by_beams
from rovgraph.simulate import Dive, Path, Style, Truth, Waves, scenario, simulate

FALCON = FilePath(__file__).parents[1] / "rovgraph" / "model" / "falcon.yaml"
LIVELY = Style(waves=Waves(heave=0.05, roll=0.1, pitch=0.08))


def falcon(**sections: Mapping[str, Any]) -> Config:
    """The Falcon's configuration with some keys changed, as ``falcon(dvl={"loss": "none"})``."""
    return changed(load_config(FALCON), **sections)


def changed(config: Config, **sections: Mapping[str, Any]) -> Config:
    """A configuration with some keys changed, ``start={"heading_deg": 3}``."""
    data = config.model_dump(exclude_unset=True)
    merge(data, sections)
    return Config.model_validate(data)


def exact(config: Config) -> Config:
    """A configuration that considers nothing."""
    considered = {name for name, belief in beliefs(config).items() if belief.considered}
    return changed(config, calibration={name: {"estimate": False} for name in considered})


def merge(into: dict[str, Any], new: Mapping[str, Any]) -> None:
    for key, value in new.items():
        if isinstance(value, Mapping):
            merge(into.setdefault(key, {}), value)
        else:
            into[key] = value


def as_log(frame: pd.DataFrame) -> Log:
    """The streams of a simulated log."""
    return Log.from_frame(frame, source="dive.csv")


def without(log: Log, *sensors: str) -> Log:
    """A log that lacks some sensors."""
    return Log(log.source, {s: stream for s, stream in log.streams.items() if s not in sensors}, log.origin)


def altered(log: Log, sensor: str, data: Array) -> Log:
    """A log with other data for one sensor."""
    old = log[sensor]
    return Log(log.source, {**log.streams, sensor: Stream(sensor, old.columns, old.time, data, old.row)}, log.origin)


def kept(log: Log, sensor: str, keep: Array) -> Log:
    """A log with some measurements of one sensor."""
    s = log[sensor]
    stream = s.take(keep)
    return Log(log.source, {**log.streams, sensor: stream}, log.origin)


def interrupted(log: Log, begin: float, seconds: float, *sensors: str) -> Log:
    """A log in which some sensors, or all, are silent for a while."""
    for sensor in sensors or tuple(log.sensors):
        time = log[sensor].time
        log = kept(log, sensor, (time < begin) | (time >= begin + seconds))
    return log


def level_log(seconds: float, acc: Array, gyr: Array, rate: float = 100.0, **sensors: tuple[Array, Array]) -> Log:
    """A log of an IMU with constant signals, and other sensors as ``name=(time, data)``; last columns may lack."""
    time = np.round(np.arange(int(seconds * rate) + 1) / rate, 4)
    data = np.tile(np.concatenate([acc, gyr]), (len(time), 1))
    streams = {"imu": Stream("imu", STREAMS["imu"], time, data, np.arange(len(time)) + 2)}
    for name, (at, values) in sensors.items():
        rows = np.arange(len(at)) + 10_000
        data = np.full((len(at), len(STREAMS[name])), np.nan)
        data[:, : np.shape(values)[1]] = values
        streams[name] = Stream(name, STREAMS[name], np.asarray(at, float), data, rows)
    return Log("dive.csv", streams)


class RecordingFilter(ErrorStateFilter):
    """An error-state filter that keeps what is known of each keyframe so far, in ``filtered``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.filtered: list[Gaussian] = []

    def step(self) -> FilterStep:
        done = super().step()
        self.filtered.append(self.known)
        return done


@dataclass(frozen=True)
class Simulated:
    """A simulated dive with the configuration that an estimator is given."""

    config: Config
    dive: Dive
    log: Log

    @property
    def truth(self) -> Trajectory:
        return self.dive.truth


def simulated(
    config: Config,
    seconds: float = 120.0,
    seed: int = 1,
    path: Path | str = "falcon",
    style: Style = LIVELY,
    **truth: Any,
) -> Simulated:
    """A dive, simulated by the configuration that is returned with it."""
    path = scenario(path, seconds, None, style) if isinstance(path, str) else path
    dive = simulate(path, Truth(config, **truth), np.random.default_rng(seed))
    return Simulated(config, dive, as_log(dive.log_frame))


def started(case: Simulated, **sections: Mapping[str, Any]) -> Config:
    """The configuration with the dive's exact start, and other changes."""
    rpy = np.rad2deg(case.truth.rpy[0])
    north, east, down = case.truth.p_n[0]
    start = {"north_m": north, "east_m": east, "down_m": down}
    start |= {"roll_deg": rpy[0], "pitch_deg": rpy[1], "heading_deg": rpy[2]}
    return changed(changed(case.config, start=start), **sections)


def campaign_log(dive: Any) -> tuple[Log, Config]:
    """A dive of the fault campaign's simulator."""
    from fault_campaign.instruments import log_table

    config = Config().changed(**dive.configuration)
    return Log.from_frame(log_table(dive.streams), config), config


@cache
def below_a_ship() -> tuple[Log, Config]:
    """A minute with a USBL, and ranges to four beacons that were surveyed."""
    sys.path.insert(0, str(FilePath(__file__).parents[1] / "benchmarks"))
    from acoustics import Setting, below_ship
    from fault_campaign.acoustic import Acoustic, Ship, System, ranges
    from fault_campaign.campaign import merge

    dive, system, rng = below_ship(Setting(seconds=60.0, depth=60.0), 3), System(rate=1.0), np.random.default_rng(3)
    places = {
        "1": (40.0, 10.0, 80.0),
        "2": (-30.0, 50.0, 82.0),
        "3": (-20.0, -60.0, 79.0),
        "wreck": (70.0, -20.0, 81.0),
    }
    config = merge(dive.configuration, Acoustic(Ship(), system).ranges(places, 0.5))
    streams = dive.streams | {"range": ranges(dive.motion, places, system, rng)}
    return campaign_log(replace(dive, streams=streams, configuration=config))


JANUS = {"angle_deg": 22.5, "azimuth_deg": [135.0, 225.0, 315.0, 45.0], "first_number": 0}


def by_beams(
    log: Log, config: Config, alter: Callable[[Array, Array], None] | None = None, **dvl: Any
) -> tuple[Log, Config]:
    """A dive whose DVL has four beams: its velocity along each, with noise, and the velocity that they make.

    Parameters
    ----------
    alter : changes (times, shape (n,), velocities along the beams, shape (n, 4)) in place; NaN = not valid
    dvl : keys of the configuration
    """
    config = changed(config, dvl={"beams": JANUS, **dvl})
    geometry, pings = beam_geometry(config.dvl), log["dvl"]
    assert geometry is not None
    noise = np.random.default_rng(7).normal(0.0, beam_sd(config.dvl), (len(pings), 4))
    along = pings.data[:, :3] @ geometry.directions.T + noise
    along[pings["dvl_valid"] != 1.0] = np.nan
    if alter is not None:
        alter(pings.time, along)
    valid, data, velocity = np.isfinite(along), np.full((len(pings), 9, 5), np.nan), pings.data.copy()
    data[:, :4, 0], data[:, :4, 1] = valid, along
    velocity[:, :3], _ = velocity_by_beams(geometry.directions, np.nan_to_num(along), valid)
    velocity[:, 3] = np.isfinite(velocity[:, 0])
    beams = Stream(BEAMS, STREAMS[BEAMS], pings.time, data.reshape(len(pings), -1), pings.row)
    return replace(log, streams={**log.streams, "dvl": replace(pings, data=velocity), BEAMS: beams}), config


def batch(log: Log, config: Config) -> BatchSmoother:
    """A batch smoother that has taken a whole log."""
    return assemble(log, initialise(log, config))


def incremental(log: Log, config: Config) -> IncrementalEstimator:
    """iSAM2 that has taken a whole log."""
    return fed(IncrementalEstimator(initialise(log, config)), log)


def renewed(log: Log, config: Config) -> ErrorStateFilter:
    """The filter of `rovgraph smooth` that has taken a whole log."""
    return fed(ErrorStateFilter(initialise(log, config), REINITIALISE_AT_S), log)


def fed(estimator: Any, log: Log) -> Any:
    for measurement in log.measurements():
        estimator.add(measurement)
    estimator.finish()
    return estimator


def smoothed(log: Log, config: Config) -> Estimate:
    return batch(log, config).solve()


def initial_conditions(log: Log, config: Config) -> InitialConditions:
    return initialise(log, config)


def true_at(case: Simulated, time: Array) -> Trajectory:
    """The truth, from the path itself, at any epochs."""
    motion = case.dive.path.motion(np.minimum(time, case.dive.path.duration))
    return Trajectory.certain(time, motion.p_n, motion.R_nb, motion.v_n)


def position_errors(trajectory: Trajectory, case: Simulated) -> Array:
    """Length of the position's error at every epoch, shape (n,) [m]."""
    return np.asarray(np.linalg.norm(trajectory.p_n - true_at(case, trajectory.time).p_n, axis=1))


def attitude_errors(trajectory: Trajectory, case: Simulated) -> Array:
    """Rotation vector of the attitude's error in n, shape (n, 3) [rad]."""
    R = true_at(case, trajectory.time).R_nb
    return rotate(R, log_rotation(transpose(R) @ trajectory.R_nb))


def rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def same(a: object, b: object) -> None:
    """Two values, objects of attributes or arrays, are the same to rounding."""
    if is_dataclass(a) and not isinstance(a, type):
        assert type(a) is type(b)
        for f in fields(a):
            if not callable(getattr(a, f.name)):
                same(getattr(a, f.name), getattr(b, f.name))
    elif isinstance(a, Mapping):
        assert isinstance(b, Mapping) and [*a] == [*b]
        same([*a.values()], [*b.values()])
    elif isinstance(a, Sequence) and not isinstance(a, str):
        assert isinstance(b, Sequence) and len(a) == len(b)
        for one, other in zip(a, b, strict=True):
            same(one, other)
    elif isinstance(a, np.ndarray):
        np.testing.assert_allclose(b, a, rtol=1e-12, atol=1e-15)
    elif isinstance(a, float):
        assert b == pytest.approx(a, rel=1e-12)
    else:
        assert a == b
