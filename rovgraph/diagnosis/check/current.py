"""A current that changes under a water track: water track against bottom track or fixes, one level against two.

The water's velocity over ground is that of the vehicle over ground less that through the water, c = v - v_w, turned
into n by a compass. In means over blocks of some seconds waves hardly show.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rovgraph.diagnosis.check.compasses import body_heading
from rovgraph.diagnosis.check.findings import Finding, since, valid_pings
from rovgraph.diagnosis.check.inertial import in_gap
from rovgraph.geometry import Array, rotate
from rovgraph.log import Log
from rovgraph.model.config import Config, beliefs, mount_matrix
from rovgraph.model.gauss_markov import walked
from rovgraph.rules import BELIEVED_SDS, SURE

BLOCK_S = 20.0
FIX_BLOCK_S = 30.0  # of fixes, whose differences are noisier
LONGEST_GAP = 2.0  # between pings [s]
ENOUGH = 3  # blocks of either level
LEAST_MPS = 0.1  # between two levels, which errors of scale and heading stay below
HALF = 0.5  # of the square about one level, that two may leave
ENOUGH_FIXES = 5  # in a block
Heading = tuple[Array, Array]  # times [s], of the body [rad]
Complexes = NDArray[np.complex128]
NONE = np.empty(0), np.empty(0, dtype=np.complex128)


def current(log: Log, config: Config) -> Iterator[Finding]:
    """Two levels of the water's velocity, where they explain far more than one and than its prior allows."""
    if "dvl_water" not in log or len(log["dvl_water"]) < 2 or not {"dvl", "fix"} & log.sensors:
        return
    found = body_heading(log, config)
    if found is None:
        return
    time, c = _over_bottom(log, config, found[1:])
    if len(c) < 2 * ENOUGH:
        time, c = _over_fixes(log, config, found[1:])
    if len(c) < 2 * ENOUGH:
        return
    left = np.arange(ENOUGH, len(c) - ENOUGH + 1)
    sums = np.cumsum(c)
    before, after = sums[left - 1] / left, (sums[-1] - sums[left - 1]) / (len(c) - left)
    weight = left * (len(c) - left) / len(c)
    k = int(np.argmax(weight * np.abs(after - before) ** 2))
    step, split = float(abs(after[k] - before[k])), int(left[k])
    noise = float(np.median(np.abs(np.diff(c)) ** 2)) / (2.0 * np.log(2.0))  # of a block, both components
    one = float(np.sum(np.abs(c - c.mean()) ** 2))
    two = one - float(weight[k]) * step**2
    prior = beliefs(config)["current"]
    apart = float(time[split:].mean() - time[:split].mean())
    allowed = BELIEVED_SDS * float(walked(prior.walk, prior.time_constant, apart)[1]) if prior.estimate else 0.0
    if step < max(LEAST_MPS, allowed, SURE * np.sqrt(noise / weight[k])) or two > HALF * one:
        yield Finding("dvl_water", "ok", f"the current stays within {np.sqrt(one / len(c)):.2g} m/s of its mean (rms)")
        return
    levels = [f"({v.real:.2f}, {v.imag:.2f})" for v in (before[k], after[k])]
    first, second = (since(log, t) for t in time[split - 1 : split + 1])
    yield Finding(
        "dvl_water",
        "warning",
        f"the current changes from {levels[0]} to {levels[1]} m/s north, east between {first} and {second}, "
        f"more than calibration.current allows: let it change faster, "
        f"calibration: {{current: {{walk: {step / np.sqrt(BLOCK_S):.2g}}}}}",
        "current",
    )


def _over_bottom(log: Log, config: Config, heading: Heading) -> tuple[Array, Complexes]:
    """Middle of each block of water track with bottom track, and the mean current in it [m/s]."""
    water = log["dvl_water"]
    pings = valid_pings(log["dvl"]) if "dvl" in log else None
    if pings is None or len(pings) < 2:
        return NONE
    over_ground = np.column_stack([np.interp(water.time, pings.time, column) for column in pings.data[:, :3].T])
    both = ~in_gap(water.time, pings.time, LONGEST_GAP)
    time, c = water.time[both], _in_n(water.time, over_ground - water.data, config, heading)[both]
    if not len(time):
        return NONE
    n, t, v, _, _ = _sums(((time - time[0]) // BLOCK_S).astype(np.int64), time, c)
    return t / n, v / n


def _over_fixes(log: Log, config: Config, heading: Heading) -> tuple[Array, Complexes]:
    """Middle of each block of fixes with water track, and the slope there of what both differ by [m/s]."""
    water = log["dvl_water"]
    if "fix" not in log:
        return NONE
    v = _in_n(water.time, water.data, config, heading)
    periods = np.diff(water.time)
    way = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * periods)])
    fix = log["fix"].take(~in_gap(log["fix"].time, water.time, LONGEST_GAP))
    if not len(fix):
        return NONE
    arm = complex(*config.fix.lever_arm_m[:2]) * np.exp(1j * np.interp(fix.time, *heading))
    apart = fix.data[:, 0] + 1j * fix.data[:, 1] - arm
    apart -= np.interp(fix.time, water.time, way.real) + 1j * np.interp(fix.time, water.time, way.imag)
    lost = np.append(0, np.cumsum(periods > LONGEST_GAP))[np.searchsorted(water.time, fix.time) - 1]
    block = np.unique(lost * 1_000_000 + (fix.time - fix.time[0]) // FIX_BLOCK_S, return_inverse=True)[1]
    n, t, d, tt, td = _sums(block, fix.time - fix.time[0], apart)
    spread = tt - t**2 / n
    enough = (n >= ENOUGH_FIXES) & (spread > n * (0.2 * FIX_BLOCK_S) ** 2)
    return (t / n + fix.time[0])[enough], ((td - t * d / n) / np.where(enough, spread, 1.0))[enough]


def _in_n(time: Array, v_s: Array, config: Config, heading: Heading) -> Complexes:
    """North and east of velocities along the DVL's axes (n, 3), shape (n,) [m/s]."""
    v_b = rotate(mount_matrix(config.dvl.mount_rpy_deg), v_s)
    return np.asarray((v_b[:, 0] + 1j * v_b[:, 1]) * np.exp(1j * np.interp(time, *heading)))


def _sums(block: NDArray[np.int64], t: Array, v: Complexes) -> tuple[Array, Array, Complexes, Array, Complexes]:
    """Of every block: how many, and the sums of t, v, t^2 and t v."""

    def total(values: Complexes) -> Complexes:
        return np.bincount(block, values.real) + 1j * np.bincount(block, values.imag)

    n = np.bincount(block).astype(float)
    some = n > 0
    t_, tt = (np.asarray(np.bincount(block, values)[some], float) for values in (t, t * t))
    return n[some], t_, total(v)[some], tt, total(t * v)[some]
