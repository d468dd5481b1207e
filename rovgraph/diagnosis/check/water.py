"""Profiles of the water beside what else shows the vehicle's motion: their clock, axes and sense, and the bottom.

The cells of a profile share the vehicle's velocity. Their mean differs from it by a current, which accelerates slowly,
so the IMU shows axes and clock of profiles as it does those of a DVL (`rovgraph.diagnosis.check.acceleration`), and
the depth shows them by the vertical component.

Whether the cells are above the head or below it is what the current itself shows. What two cells of a profile differ by
is a function of their depth, the same for all profiles that pass it: a vehicle that descends sees the same layer in
nearer and nearer cells if it looks down, and in ever farther ones if it looks up. Taken the wrong way round, profiles
of one depth disagree.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pandas as pd

from rovgraph.diagnosis.check.clocks import compare
from rovgraph.diagnosis.check.compasses import body_heading
from rovgraph.diagnosis.check.dvl import beside_imu
from rovgraph.diagnosis.check.findings import Finding, valid_pings
from rovgraph.geometry import Array, matrix_from_rpy, rotate
from rovgraph.log import Log, Stream
from rovgraph.model.config import Config, mount_matrix
from rovgraph.problem.beams import nearest
from rovgraph.problem.layers import cells_axis, in_dvl_axes
from rovgraph.rules import CLIPPED, remedy_of_lag
from rovgraph.sensors.dvl import VELOCITIES
from rovgraph.sensors.water_layer import CELLS

ENOUGH = 20  # profiles
LONGEST_LAG_S, LAG_STEP_S, SLOPE_S = 30.0, 0.5, 1.0  # of profiles against the depth, and over which it changes
BETTER_LAG = 0.6  # of the error as it stands, that another lag or sign leaves
BESIDE_S = 1.0  # between a profile and a ping
AS_BOTTOM_MPS = 0.05  # between cells and bottom track
SAME_WATER_S = 600.0  # in which the current at one depth is taken as one
APART = (1, 2, 4, 8, 16)  # cells that are compared: the current differs more the farther they are, and some reach less
ENOUGH_PAIRS = 750  # of these, so that 5 sds of the ratio of their variances are
OTHER_WAY = 1.05  # times smaller a variance at one depth; without shear it is within 1.01


def profiles(log: Log, config: Config) -> Iterator[Finding]:
    """Cells of the water against depth, IMU and each other, and a bottom that nothing marks."""
    if CELLS not in log or "depth" not in log:
        return
    cells = log[CELLS]
    velocity = in_dvl_axes(cells.data)
    if len(log["depth"]) < ENOUGH:
        return
    contradicted = False
    for finding in (*_beside_depth(log, config, velocity), *_beside_imu(log, config, velocity)):
        if finding.level != "ok" and contradicted:  # by the depth already
            continue
        contradicted |= finding.level != "ok"
        yield finding
    if not contradicted:
        yield from _sense(log, config, velocity)
    yield from _unmarked(log, cells, velocity)


def _beside_depth(log: Log, config: Config, velocity: Array) -> Iterator[Finding]:
    """Sign and clock, by the vertical velocity."""
    cells, depth = log[CELLS], log["depth"]
    tilt = np.nan_to_num(np.column_stack([cells["adcp_roll"], cells["adcp_pitch"], np.zeros(len(cells))]))
    logged = np.isfinite(cells["adcp_pitch"])[:, None]
    down_s = np.where(logged, matrix_from_rpy(tilt)[:, 2], mount_matrix(config.dvl.mount_rpy_deg)[2])
    sinking = pd.Series((velocity * down_s).sum(axis=1)).groupby(cells.time).median().dropna()
    time = sinking.index.to_numpy(float)
    if len(time) < ENOUGH:
        return
    lags = np.arange(-LONGEST_LAG_S, LONGEST_LAG_S + LAG_STEP_S, LAG_STEP_S)
    at = time - lags[:, None]
    above, below = (np.interp(at + h, depth.time, depth["depth"]) for h in (-SLOPE_S, SLOPE_S))
    inside = (at > depth.time[0] + SLOPE_S) & (at < depth.time[-1] - SLOPE_S)
    apart = np.where(inside, (below - above) / (2.0 * SLOPE_S) - sinking.to_numpy(), np.nan)
    error, now = np.sqrt(np.nanmean(apart**2, axis=1)), len(lags) // 2
    best = int(np.nanargmin(error))
    turned = float(np.sqrt(np.nanmean((apart[now] + 2.0 * sinking.to_numpy()) ** 2)))
    if turned < BETTER_LAG * error[now]:
        remedy = "state units: {adcp_velocity: -m/s}"
        yield Finding(CELLS, "warning", f"by its cells it rises where the depth grows: {remedy}", "sign")
    elif error[best] < BETTER_LAG * min(error[now], float(np.sqrt(np.mean(sinking.to_numpy() ** 2)))):
        text = f"its stamps are {lags[best]:+.1f} s late, by the vertical velocity of its cells beside the depth"
        yield Finding(CELLS, "warning", f"{text}: {remedy_of_lag(config, CELLS, lags[best], LAG_STEP_S)}", "lag")


def _beside_imu(log: Log, config: Config, velocity: Array) -> Iterator[Finding]:
    """Axes and clock, by the acceleration of the mean of each profile."""
    mean = pd.DataFrame(velocity, columns=[*VELOCITIES]).groupby(log[CELLS].time).mean().dropna()
    if "imu" not in log or len(mean) < ENOUGH:
        return
    columns = (*VELOCITIES, "dvl_valid")
    pings = Stream(
        "dvl",
        columns,
        mean.index.to_numpy(float),
        np.column_stack([mean.to_numpy(), np.ones(len(mean))]),
        np.arange(len(mean)),
    )
    beside = replace(log, streams={name: log[name] for name in ("imu", "depth") if name in log} | {"dvl": pings})
    compared = compare(beside, config)
    if compared is not None:
        yield from beside_imu(beside, config, compared, CELLS)


def _sense(log: Log, config: Config, velocity: Array) -> Iterator[Finding]:
    """Whether cells are above or below the head, by the current that profiles of one depth have in common."""
    cells, depth, heading = log[CELLS], log["depth"], body_heading(log, config)
    times, profile = np.unique(cells.time, return_inverse=True)
    ranges, cell = np.unique(np.round(cells["adcp_range"], 3), return_inverse=True)
    if heading is None or len(ranges) < 2 or not np.isfinite(ranges).all():
        return
    v = np.full((len(times), len(ranges)), np.nan, complex)
    v[profile, cell] = rotate(mount_matrix(config.dvl.mount_rpy_deg), velocity) @ (1.0, 1.0j, 0.0)
    v *= np.exp(1.0j * np.interp(times, heading[1], heading[2]))[:, None]
    head, layer = np.interp(times, depth.time, depth["depth"])[:, None], float(np.median(np.diff(ranges)))
    hour = np.broadcast_to((times // SAME_WATER_S)[:, None], v.shape)
    below = float(np.sign((mount_matrix(config.dvl.mount_rpy_deg) @ cells_axis(config))[2]))
    best = 1.0
    for apart in APART:
        if apart < len(ranges):
            shear, middle = v[:, apart:] - v[:, :-apart], 0.5 * (ranges[apart:] + ranges[:-apart])
            depths = (np.floor((head + s * middle) / layer) for s in (below, -below))
            as_stated, otherwise = (_variance(shear, hour[:, apart:], at) for at in depths)
            best = max(best, as_stated / otherwise)
    other = "down" if config.water.looks == "up" else "up"
    if best > OTHER_WAY:
        text = f"profiles that reach one depth disagree {np.sqrt(best):.2g} times as much as if it looked {other}"
        yield Finding(CELLS, "warning", f"{text}: state water.looks: {other}", "turned")


def _variance(values: Array, *groups: Array) -> float:
    """Of complex values within groups, those far off clipped; NaN with too few."""
    known = np.isfinite(values)
    of = np.unique(np.column_stack([g[known] for g in groups]), axis=0, return_inverse=True)[1].ravel()
    count, v = np.bincount(of), values[known]
    mean = (np.bincount(of, v.real) + 1.0j * np.bincount(of, v.imag)) / np.maximum(count, 1)
    square = (np.abs(v - mean[of]) ** 2)[count[of] > 1]
    freedom = len(square) - np.count_nonzero(count > 1)
    if freedom < ENOUGH_PAIRS:
        return np.nan
    return float(np.minimum(square, CLIPPED**2 * np.median(square)).sum()) / freedom


def _unmarked(log: Log, cells: Stream, velocity: Array) -> Iterator[Finding]:
    """Whether cells beyond a range move as the bottom does, and neither altitude nor the table marks it."""
    marked = np.isfinite(cells["adcp_bottom"]).any() or "dvl_altitude" in log
    pings = valid_pings(log["dvl"]) if "dvl" in log and not marked else None
    if pings is None or len(pings) < ENOUGH:
        return
    near = nearest(pings.time, cells.time)
    beside = np.abs(pings.time[near] - cells.time) < BESIDE_S
    off = np.hypot(*(velocity - pings.data[near, :3])[:, :2].T)
    table = pd.DataFrame({"range": cells["adcp_range"], "off": off})[beside & np.isfinite(off)].groupby("range")["off"]
    usual = table.median()[table.count() >= ENOUGH]
    if len(usual) < 3 or not usual.max() > AS_BOTTOM_MPS * 4.0:
        return
    with_bottom = usual.to_numpy() < AS_BOTTOM_MPS
    if with_bottom[-1] and not with_bottom[0]:
        first = float(usual.index[len(usual) - int(np.argmin(with_bottom[::-1]))])
        text = f"cells from {first:g} m on move as the bottom does, which is within their range and not marked"
        yield Finding(CELLS, "warning", f"{text}: give the column bottom, or dvl_altitude")
