"""Whether a dive is reckoned without an IMU, and where it then begins."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from rovgraph.calibration import AUTO, CONSIDERED, TABLE, Belief
from rovgraph.config import Config, beliefs
from rovgraph.engine.constant_velocity import NO_BIAS_SD, has_constant_velocity, motion_model, ticks
from rovgraph.engine.scale import SCALES
from rovgraph.errors import InputError
from rovgraph.estimators.first_seconds import WINDOW_S
from rovgraph.geometry import Array
from rovgraph.instruments import heading_sources
from rovgraph.log import Log

TILT = "vehicle_tilt"
BOTTOM = "bottom_velocity"
BOAT_ACC = 0.5  # noise density of a boat's acceleration: less takes its turns for those of the bottom [m/s2/rtHz]


def with_motion_model(log: Log, config: Config, assumptions: list[str]) -> tuple[Log, Config]:
    """The log and the configuration with the motion that is reckoned with; without an IMU, with `ticks` in its place.

    Raises
    ------
    InputError : the log lacks what the motion needs, or the configuration asks for what needs an IMU
    """
    model = motion_model(config, log.sensors)
    config = config.model_copy(update={"motion": config.motion.model_copy(update={"model": model})})
    if not has_constant_velocity(config):
        if "imu" not in log:
            raise InputError(
                f"{log.source}: no IMU, columns acc_x..acc_z and gyr_x..gyr_z are needed, or else roll and pitch"
            )
        return log, config
    if TILT not in log:
        raise InputError(f"{log.source}: motion.model constant_velocity needs columns roll and pitch")
    for asked, key in _needs_imu(log, config, beliefs(config)):
        if asked:
            raise InputError(f"{log.source}: {key} needs an IMU, columns acc_x..acc_z and gyr_x..gyr_z")
    why = "the IMU is left out" if "imu" in log else "the log has no IMU"
    config = _on_a_bed_that_may_move(log, config, assumptions)
    motion = config.motion
    assumptions.append(
        f"{why}: constant velocity between measurements, walking by {motion.acc:g} m/s2/rtHz, "
        f"and attitude by {motion.gyr:g} rad/s/rtHz (motion.acc, motion.gyr)"
    )
    entries = dict.fromkeys(SCALES, False) | {name: CONSIDERED for name in unseen(log.sensors)}
    given = config.calibration
    stated = {name for name in given.model_fields_set if "estimate" in getattr(given, name).model_fields_set}
    calibration = given.model_copy(
        update={
            name: getattr(given, name).model_copy(update={"estimate": estimate})
            for name, estimate in entries.items()
            if name in SCALES or (getattr(given, name).estimate is True and name not in stated)
        }
    )
    environment = config.environment.model_copy(update={"earth_rotation": False})
    config = config.model_copy(update={"calibration": calibration, "environment": environment})
    return replace(log, streams={**log.streams, "imu": ticks(log)}), config


def _on_a_bed_that_may_move(log: Log, config: Config, assumptions: list[str]) -> Config:
    """A vehicle with neither IMU nor depth is a boat, and rivers move their beds: they are surveyed for that.

    Nothing but position fixes would show it, so it is estimated unless the configuration says otherwise.
    """
    if "depth" in log or "dvl" not in log or getattr(config.calibration, BOTTOM).estimate != AUTO:
        return config
    bottom = getattr(config.calibration, BOTTOM).model_copy(update={"estimate": True})
    calibration = config.calibration.model_copy(update={BOTTOM: bottom})
    motion = config.motion
    if "acc" not in motion.model_fields_set:
        motion = motion.model_copy(update={"acc": BOAT_ACC})
    assumptions.append(
        f"no depth either, so it is a boat, under which the bed may move by {bottom.sd:g} m/s; "
        f"calibration.{BOTTOM}: {{estimate: false}} if it rests"
    )
    return config.model_copy(update={"calibration": calibration, "motion": motion})


def unseen(sensors: Collection[str]) -> list[str]:
    """Calibration variables that a dive without an IMU does not show: against no gyro, deviation curves need fixes.

    How a heading walks is a poor gyro: it would take a curve for likely that makes the vehicle turn less.
    """
    return [] if "fix" in sensors else [name for name in TABLE if name.endswith("_deviation")]


def _needs_imu(log: Log, config: Config, priors: dict[str, Belief]) -> list[tuple[bool, str]]:
    """What needs an IMU: whether it is asked for, and the key that asks."""
    estimated = [
        name for name in (*SCALES, *(n for n in priors if n.endswith("_time_offset"))) if priors[name].estimate
    ]
    return [
        (config.graph.hydrodynamics, "graph.hydrodynamics"),
        (
            "mag" in heading_sources(config, log.sensors) and config.environment.dip_deg is None,
            "environment.dip_deg: null, as the heading is a magnetometer's,",
        ),
        *((True, f"calibration.{name}: {{estimate: true}}") for name in estimated),
    ]


def first_tilt(log: Log) -> tuple[float, float]:
    """Roll and pitch that the vehicle gives in the first seconds, the median [rad]."""
    tilt = log[TILT]
    roll, pitch = np.median(tilt.data[tilt.time <= tilt.time[0] + WINDOW_S], axis=0).tolist()
    return roll, pitch


def no_bias() -> tuple[Array, Array]:
    """Bias of the first keyframe and its sd, shapes (6,): there is none."""
    return np.zeros(6), np.full(6, NO_BIAS_SD)
