"""Samples of every instrument on a motion, and the log that holds them.

A stream is a table with a column ``time`` and the columns of docs/log-format.md.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from fault_campaign.beams import Beams, log_columns, ping
from fault_campaign.earth import Array
from fault_campaign.motion import Motion, mounting
from fault_campaign.vehicle import Compass, Vehicle

Streams = dict[str, pd.DataFrame]
XYZ = ("x", "y", "z")


@dataclass
class Hidden:
    """What an estimator is to find: the DVL's yaw [deg] and scale, and other components of the calibration by label."""

    dvl_yaw: float
    dvl_scale: float
    others: dict[str, float] = field(default_factory=dict)


def _times(motion: Motion, rate: float, offset: float) -> Array:
    return np.arange(offset, motion.duration, 1.0 / rate)


def _random_walk(rng: np.random.Generator, n: int, density: float, rate: float) -> Array:
    return np.cumsum(rng.normal(0.0, density / np.sqrt(rate), (n, 3)), axis=0)


def imu(motion: Motion, vehicle: Vehicle, rng: np.random.Generator) -> pd.DataFrame:
    """Averages over the sample period, stamped at its middle."""
    unit = vehicle.imu
    period = 1.0 / unit.rate
    t = _times(motion, unit.rate, period)
    force_b, rate_b = motion.averages(t, period, np.asarray(unit.arm))
    C_bs, n = mounting(unit.mount_rpy_deg), len(t)
    samples = {}
    for name, values_b, noise, walk, bias_sd, bias, matrix in (
        ("acc", force_b, unit.acc_noise, unit.acc_walk, unit.acc_bias_sd, unit.acc_bias, unit.acc_matrix),
        ("gyr", rate_b, unit.gyr_noise, unit.gyr_walk, np.deg2rad(unit.gyr_bias_sd), unit.gyr_bias, unit.gyr_matrix),
    ):
        errors = np.eye(3) + rng.normal(0.0, 1.0, (3, 3)) * unit.matrix_sd
        drift = rng.normal(0.0, bias_sd, 3) + bias + _random_walk(rng, n, walk, unit.rate)
        white = rng.normal(0.0, noise * np.sqrt(unit.rate), (n, 3))
        samples[name] = values_b @ C_bs @ (errors @ matrix).T + drift + white
    columns = {f"{name}_{axis}": values[:, k] for name, values in samples.items() for k, axis in enumerate(XYZ)}
    return pd.DataFrame({"time": t, **columns})


def dvl(motion: Motion, vehicle: Vehicle, C_bs: Array, scale: float, rng: np.random.Generator) -> pd.DataFrame:
    """Velocity of the instrument over ground, along its own axes."""
    unit = vehicle.dvl
    t = _times(motion, unit.rate, 0.13)
    v_b = motion.v_b(t) + np.cross(motion.rate_nb_b(t), np.asarray(unit.arm))
    values = (1.0 + scale) * v_b @ C_bs + rng.normal(0.0, 1.0, (len(t), 3)) * np.asarray(unit.sd)
    columns = {f"dvl_v{axis}": values[:, k] for k, axis in enumerate(XYZ)}
    return pd.DataFrame({"time": t, **columns, "dvl_valid": 1.0})


def water_track(motion: Motion, vehicle: Vehicle, C_bs: Array, scale: float, rng: np.random.Generator) -> pd.DataFrame:
    """The same relative to water that moves steadily over ground."""
    unit = vehicle.dvl
    table = dvl(motion, replace(vehicle, dvl=replace(unit, sd=unit.water_sd)), C_bs, scale, rng)
    current_n = np.array([*rng.normal(0.0, vehicle.current_sd, 2), 0.0])
    current_b = np.einsum("nji,j->ni", motion.C_nb(table["time"].to_numpy()), current_n)
    names = [f"dvl_v{axis}" for axis in XYZ]
    values = table[names].to_numpy() - (1.0 + scale) * current_b @ C_bs
    return pd.DataFrame({"time": table["time"], **{f"dvl_water_v{axis}": values[:, k] for k, axis in enumerate(XYZ)}})


def _heading(motion: Motion, t: Array, axis_b: Array) -> Array:
    """True heading of an axis, clockwise from north [rad]."""
    axis_n = motion.C_nb(t) @ axis_b
    return np.arctan2(axis_n[:, 1], axis_n[:, 0])


def compass(motion: Motion, vehicle: Vehicle, unit: Compass, axis_b: Array, rng: np.random.Generator) -> pd.DataFrame:
    """Magnetic heading of an instrument's x axis, with deviation A, B and C."""
    t = _times(motion, unit.rate, 0.05)
    true = _heading(motion, t, axis_b) - np.deg2rad(vehicle.field.declination)
    A = rng.normal(0.0, unit.offset_sd) + unit.offset
    B, C = rng.normal(0.0, unit.curve_sd, 2)
    error = A + B * np.sin(true) + C * np.cos(true) + rng.normal(0.0, unit.sd, len(t))
    return pd.DataFrame({"time": t, "yaw": np.mod(true + np.deg2rad(error), 2.0 * np.pi)})


def magnetometer(motion: Motion, vehicle: Vehicle, rng: np.random.Generator) -> pd.DataFrame:
    """The field in the IMU's axes, with iron."""
    unit, world = vehicle.mag, vehicle.field
    t = _times(motion, unit.rate, 0.05)
    azimuth, dip = np.deg2rad(world.declination - rng.normal(0.0, unit.offset_sd) - unit.offset), np.deg2rad(world.dip)
    field_n = world.magnitude * np.array([np.cos(dip) * np.cos(azimuth), np.cos(dip) * np.sin(azimuth), np.sin(dip)])
    in_sensor = np.einsum("nji,j->ni", motion.C_nb(t), field_n) @ mounting(vehicle.imu.mount_rpy_deg)
    iron = world.magnitude * rng.normal(0.0, world.hard_iron_sd, 3)
    current = world.magnitude * np.linalg.norm(motion.v_b(t), axis=1)[:, None] * world.hard_iron_per_speed
    noise = np.deg2rad(unit.sd) * world.magnitude * np.cos(dip)
    values = in_sensor @ world.soft_iron.T + iron + current + rng.normal(0.0, noise, (len(t), 3))
    return pd.DataFrame({"time": t, **{f"mag_{axis}": values[:, k] for k, axis in enumerate(XYZ)}})


def at_arm(motion: Motion, t: Array, arm: Array) -> Array:
    """North, east and depth of a place in the vehicle, shape (n, 3) [m]."""
    return motion.local(t) + motion.C_nb(t) @ arm


def sample(
    motion: Motion, vehicle: Vehicle, rng: np.random.Generator, beams: Beams | None = None
) -> tuple[Streams, Hidden]:
    """All instruments of a vehicle on a motion; its DVL as one instrument, or beam by beam."""
    roll, pitch, yaw = vehicle.dvl.mount_rpy_deg
    yaw += rng.normal(0.0, vehicle.dvl.yaw_sd)
    scale = vehicle.dvl.scale + (rng.normal(0.0, vehicle.dvl.scale_sd) if vehicle.dvl.scale_sd else 0.0)
    C_dvl, C_imu = mounting((roll, pitch, yaw)), mounting(vehicle.imu.mount_rpy_deg)
    streams = {"imu": imu(motion, vehicle, rng)}
    if beams is None:
        streams["dvl"] = dvl(motion, vehicle, C_dvl, scale, rng)
    else:
        streams["dvl"] = log_columns(ping(motion, vehicle, beams, C_dvl, scale, rng), beams.head)
    if "ahrs" in vehicle.aids:
        streams["ahrs"] = compass(motion, vehicle, vehicle.ahrs, C_imu[:, 0], rng)
        streams["ahrs"].columns = pd.Index(["time", "ahrs_yaw"])
    if "dvl_heading" in vehicle.aids:
        streams["dvl_heading"] = compass(motion, vehicle, vehicle.dvl_heading, C_dvl[:, 0], rng)
        streams["dvl_heading"].columns = pd.Index(["time", "dvl_heading"])
    if "mag" in vehicle.aids:
        streams["mag"] = magnetometer(motion, vehicle, rng)
    if "depth" in vehicle.aids:
        t = _times(motion, vehicle.depth.rate, 0.09)
        water = at_arm(motion, t, np.asarray(vehicle.depth.arm))[:, 2] * (1.0 + vehicle.depth.density)
        depth = water + vehicle.depth.offset + rng.normal(0.0, vehicle.depth.sd, len(t))
        streams["depth"] = pd.DataFrame({"time": t, "depth": depth})
    if "fix" in vehicle.aids:
        t = _times(motion, vehicle.fix.rate, 1.03)
        position = at_arm(motion, t, np.asarray(vehicle.fix.arm))[:, :2]
        position = position + rng.normal(0.0, vehicle.fix.sd, (len(t), 2))
        streams["fix"] = pd.DataFrame({"time": t, "fix_north": position[:, 0], "fix_east": position[:, 1]})
    if "dvl_water" in vehicle.aids:
        streams["dvl_water"] = water_track(motion, vehicle, C_dvl, scale, rng)
    return streams, Hidden(yaw, scale)


def log_table(streams: Streams) -> pd.DataFrame:
    """One row per event, in the order of the stamps."""
    table = pd.concat(list(streams.values()), ignore_index=True)
    return table.sort_values("time", kind="stable", ignore_index=True)
