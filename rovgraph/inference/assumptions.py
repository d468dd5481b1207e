"""Assumptions that this dive's data cannot test.

A dive that is turned as a whole about the vertical, or shifted along it, obeys the same equations: a constant error of
the heading shows against position fixes only, one of the depth only against a start at a known depth. The same nearly
holds for a dive whose velocities have another scale: the accelerations of a small vehicle hardly show it.

Where the heading rests on one compass without a stated calibration, its prior is wide (`Variable.unchecked_sd`).
"""

from collections.abc import Collection

import numpy as np

from rovgraph.log.units import behind, shown
from rovgraph.model.calibration import TABLE, Belief
from rovgraph.model.config import Config, Mag, beliefs
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.sensors.instruments import OFFSETS

PRESETS = {"mag": "imu", "ahrs": "imu", "dvl_heading": "dvl"}  # section of the instrument that a compass is part of


def unchecked_compass(config: Config, sources: Collection[str], present: Collection[str]) -> list[str]:
    """Calibration variables of the compass that the heading rests on, if it is neither calibrated nor checked.

    A calibration is an sd or a mean that is stated of one of them, an offset that is taken as exact, ``imu.mag``, or a
    preset of its instrument. It is checked by another compass, by position fixes, and by a stated heading at the start
    that is known better. Fixes may still come online.

    Parameters
    ----------
    config : as stated, before the log fills anything in
    sources : heading sources that are in use, or may still be
    present : streams of the log
    """
    if len(sources) != 1 or "fix" in present:
        return []
    (source,), start = sources, config.start
    names = [name for name, v in TABLE.items() if v.unchecked_sd is not None and source in v.sensors]
    section = getattr(config, PRESETS[source]) if source in PRESETS else None
    calibrated = (
        any(_is_stated(config, name) for name in names)
        or (source == "mag" and config.imu.mag != Mag())
        or (section is not None and section.preset is not None)
    )
    unchecked_deg = np.rad2deg(TABLE[OFFSETS[source]].unchecked_sd or 0.0)
    checked = start.heading_deg is not None and start.heading_sd_deg < unchecked_deg
    return [] if calibrated or checked else names


def _is_stated(config: Config, name: str) -> bool:
    """Whether the configuration states a prior for a calibration variable."""
    variable, entry = TABLE[name], getattr(config.calibration, name)
    tail = "_deg" if variable.angular else ""
    known = getattr(entry, "sd" + tail) is not None or getattr(entry, "mean" + tail) is not None
    return known or (variable.estimate and entry.estimate is False)


def rests_on_doubtful_compass(initial: InitialConditions) -> bool:
    """Whether the offset of every compass in use is known worse than that of a calibrated one."""
    names = [OFFSETS[source] for source in initial.instruments if source in OFFSETS]
    entries = [(TABLE[name].sd, getattr(initial.config.calibration, name)) for name in names]
    return bool(entries) and all(
        entry.estimate is not False and np.deg2rad(entry.sd_deg or 0.0) > 1.001 * sd for sd, entry in entries
    )


def unchecked(
    config: Config,
    sources: Collection[str],
    present: Collection[str],
    expected: Collection[str] = (),
    by_gyro: bool = False,
) -> list[str]:
    """Assumptions behind heading, distances and depth that no sensor checks, a line each.

    Parameters
    ----------
    config : as stated, before the log fills anything in
    sources : heading sources in use
    present : streams of the log
    expected : streams that may still come
    by_gyro : whether the gyro shows the heading at the start, by the Earth's rate
    """
    priors, start = beliefs(config), config.start
    lines: list[str] = []
    if "fix" not in present:
        so_far = " so far" if "fix" in expected else ""
        rests = [_held_by(priors[OFFSETS[source]]) for source in sources]
        if start.heading_deg is not None:
            rests.append(f"start.heading_deg, sd {start.heading_sd_deg:g} deg")
        if by_gyro:
            rests.append(f"the gyro's bias, sd {config.imu.gyr_bias_sd_dps:.2g} deg/s")
        lines.append(f"no fix{so_far} shows a constant error of the heading, which rests on {'; '.join(rests)}")
        if "dvl" in {*present, *expected}:
            scale = _held_by(priors["dvl_scale"])
            lines.append(f"no fix{so_far} shows a constant error of the DVL's scale, which rests on {scale}")
            if not priors["bottom_velocity"].estimate:
                lines.append(f"no fix{so_far} shows a bottom that moves slowly: it is taken to be at rest")
    if "depth" in present and start.down_m is None:
        lines.append(f"nothing shows a constant error of the depth, which rests on {_held_by(priors['depth_offset'])}")
    return lines


def nothing_checks(heading: str, turns_show: bool) -> str:
    """The first of the lines of `unchecked`, on a heading that rests on an unchecked compass, with what would help.

    Parameters
    ----------
    heading : the line
    turns_show : whether turns show the compass's deviation, as they do against a gyro
    """
    turns = ", two full turns show its deviation" if turns_show else ""
    remedy = f"a fix at the end of the dive, or a second compass, checks it{turns}"
    return f"nothing checks the compass, and no calibration of it is stated: {heading}; {remedy}"


def _held_by(belief: Belief) -> str:
    """A calibration variable and its prior's sd."""
    name = belief.variable.name
    if not (belief.estimate or belief.considered):
        return f"{name}, taken as exact"
    factor, unit = shown(belief.variable.unit)
    return f"{name}, sd {factor * belief.sd:g}{behind(unit)}"
