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
from rovgraph.log.units import UNITS
from rovgraph.model.config import Config, mount_matrix
from rovgraph.problem.beams import nearest
from rovgraph.problem.layers import cells_axis, in_dvl_axes
from rovgraph.rules import CLIPPED, SURE, remedy_of_lag
from rovgraph.sensors import Kind
from rovgraph.sensors.dvl import VELOCITIES
from rovgraph.sensors.water_layer import CELLS, EARTH
from rovgraph.sensors.water_layer import VELOCITIES as CELL_AXES

ENOUGH = 20  # profiles
LONGEST_LAG_S, LAG_STEP_S, SLOPE_S = 30.0, 0.5, 1.0  # of profiles against the depth, and over which it changes
BETTER_LAG = 0.6  # of the error as it stands, that another lag or sign leaves
BESIDE_S = 1.0  # between a profile and a ping
AS_BOTTOM_MPS = 0.05  # between cells and bottom track
SAME_WATER_S = 600.0  # in which the current at one depth is taken as one
TOGETHER = 0.9  # correlation of both vertical velocities, from which on their ratio is that of the units
OTHER_UNIT, SAME_UNIT = 0.25, 0.1  # logarithm of that ratio from which on it is another one, and within which it is one
APART = (1, 2, 4, 8, 16)  # cells that are compared: the current differs more the farther they are, and some reach less
MOST_RANGES = 512  # of the cells of profiles
LAYERS = 1e6  # more than there are at a time
ALIKE = 1.02  # times the least variance, up to which two explanations are not distinguished
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
        yield from _places(log, config, velocity)
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
        own_z = CELL_AXES[2] if np.isfinite(cells[CELL_AXES[2]]).any() else EARTH[2]
        remedy = f"state units: {{adcp_velocity: -m/s}}, or if only the vertical one is wrong, {{{own_z}: -m/s}}"
        yield Finding(CELLS, "warning", f"by its cells it rises where the depth grows: {remedy}", "sign")
    elif error[best] < BETTER_LAG * min(error[now], float(np.sqrt(np.mean(sinking.to_numpy() ** 2)))):
        text = f"its stamps are {lags[best]:+.1f} s late, by the vertical velocity of its cells beside the depth"
        yield Finding(CELLS, "warning", f"{text}: {remedy_of_lag(config, CELLS, lags[best], LAG_STEP_S)}", "lag")
    else:
        yield from _speeds(config, (apart[now] + sinking.to_numpy())[inside[now]], sinking.to_numpy()[inside[now]])


def _speeds(config: Config, by_depth: Array, sinking: Array) -> Iterator[Finding]:
    """The unit, by the vertical velocity of n profiles and that of the depth, shape (n,)."""
    square, both = float(sinking @ sinking), float(sinking @ by_depth)
    if both <= TOGETHER * np.sqrt(square * float(by_depth @ by_depth)) or abs(np.log(both / square)) < OTHER_UNIT:
        return
    read_in = UNITS["speed"].get(config.units.get("adcp_velocity", "m/s"), 1.0)
    fits = [u for u, f in UNITS["speed"].items() if abs(np.log(f / read_in / (both / square))) < SAME_UNIT]
    remedy = f"state units: {{adcp_velocity: {fits[0]}}}" if fits else "correct their unit"
    yield Finding(
        CELLS, "warning", f"its cells sink {square / both:.3g} times as fast as the depth grows: {remedy}", "unit"
    )


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


def _places(log: Log, config: Config, velocity: Array) -> Iterator[Finding]:
    """Whether cells are where they are taken to be, by the current that profiles which reach one depth have in common.

    They may be above the head instead of below it, and their ranges in another unit.
    """
    cells, depth, heading = log[CELLS], log["depth"], body_heading(log, config)
    times, profile = np.unique(cells.time, return_inverse=True)
    ranges, cell = np.unique(np.round(cells["adcp_range"], 3), return_inverse=True)
    if heading is None or not 1 < len(ranges) <= MOST_RANGES or not np.isfinite(ranges).all():
        return
    R_bs, turned = mount_matrix(config.dvl.mount_rpy_deg), "down" if config.water.looks == "up" else "up"
    v = np.full((len(times), len(ranges)), np.nan, complex)
    v[profile, cell] = rotate(R_bs, velocity) @ (1.0, 1.0j, 0.0)
    v *= np.exp(1.0j * np.interp(times, heading[1], heading[2]))[:, None]
    block = (times // SAME_WATER_S)[:, None]
    head, layer = np.interp(times, depth.time, depth["depth"])[:, None], float(np.median(np.diff(ranges)))
    as_stated = float(np.sign((R_bs @ cells_axis(config))[2]))
    read_in = config.units.get("adcp_range", "m")
    remedies = {"state units: {adcp_range: -m}" if ranges[0] < 0.0 else f"state water.looks: {turned}": -1.0}
    if read_in in UNITS["length"]:
        remedies |= {
            f"state units: {{adcp_range: {u}}}": f / UNITS["length"][read_in] for u, f in UNITS["length"].items()
        }
    worse = dict.fromkeys(remedies, 1.0)
    for apart in (k for k in APART if k < len(ranges)):
        shear, middle = v[:, apart:] - v[:, :-apart], 0.5 * (ranges[apart:] + ranges[:-apart])

        def variance(times_as_far: float, shear: Array = shear, middle: Array = middle) -> tuple[float, int]:
            at = np.floor((head + as_stated * times_as_far * middle) / (layer * abs(times_as_far)))
            return _variance(shear, at + LAYERS * block)

        stated, freedom = variance(1.0)
        for remedy, times_as_far in remedies.items():
            other, fewer = variance(times_as_far)
            if min(freedom, fewer) > ENOUGH and stated > other * np.exp(SURE * np.sqrt(2.0 / min(freedom, fewer))):
                worse[remedy] = max(worse[remedy], stated / other)
    worst = max(worse.values())
    if worst > OTHER_WAY:
        remedy = next(one for one in remedies if worse[one] > worst / ALIKE)
        text = (
            f"{1.0 - 1.0 / worst:.0%} of the variance among profiles that reach one depth comes from where their cells"
        )
        kind: Kind = "unit" if "units" in remedy else "turned"
        yield Finding(CELLS, "warning", f"{text} are taken to be: {remedy}", kind)


def _variance(values: Array, group: Array) -> tuple[float, int]:
    """Of complex values within groups, those far off clipped, and its degrees of freedom."""
    known = np.isfinite(values)
    of = np.unique(group[known], return_inverse=True)[1]
    count, v = np.bincount(of), values[known]
    mean = (np.bincount(of, v.real) + 1.0j * np.bincount(of, v.imag)) / np.maximum(count, 1)
    square = (np.abs(v - mean[of]) ** 2)[count[of] > 1]
    freedom = int(len(square) - np.count_nonzero(count > 1))
    if not freedom:
        return np.nan, 0
    return float(np.minimum(square, CLIPPED**2 * np.median(square)).sum()) / freedom, freedom


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
