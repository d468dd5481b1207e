"""What no measurement of a dive can show to be wrong, and what it rests on instead.

A dive that is turned as a whole about the vertical, or shifted along it, obeys the same equations: a constant error of
the heading shows against position fixes only, one of the depth only against a start at a known depth. So does nearly a
dive whose velocities have another scale: the accelerations of a small vehicle hardly show it.
"""

from collections.abc import Collection

from rovgraph.calibration import Belief
from rovgraph.config import Config, beliefs
from rovgraph.estimators.headings import OFFSETS
from rovgraph.units import behind, shown


def unchecked(
    config: Config, sources: Collection[str], present: Collection[str], expected: Collection[str] = ()
) -> list[str]:
    """What heading, distances and depth rest on where nothing checks them, a line each.

    Parameters
    ----------
    config : as stated, before the log fills anything in
    sources : heading sources in use
    present : streams of the log
    expected : streams that may still come
    """
    priors, start = beliefs(config), config.start
    lines: list[str] = []
    if "fix" not in present:
        so_far = " so far" if "fix" in expected else ""
        rests = [_held_by(priors[OFFSETS[source]]) for source in sources]
        if start.heading_deg is not None:
            rests.append(f"start.heading_deg, sd {start.heading_sd_deg:g} deg")
        lines.append(f"no fix{so_far} shows a constant error of the heading, which rests on {'; '.join(rests)}")
        if "dvl" in {*present, *expected}:
            scale = _held_by(priors["dvl_scale"])
            lines.append(f"no fix{so_far} shows a constant error of the DVL's scale, which rests on {scale}")
    if "depth" in present and start.down_m is None:
        lines.append(f"nothing shows a constant error of the depth, which rests on {_held_by(priors['depth_offset'])}")
    return lines


def _held_by(belief: Belief) -> str:
    """A calibration variable and its prior's sd."""
    name = belief.variable.name
    if not (belief.estimate or belief.considered):
        return f"{name}, taken as exact"
    factor, unit = shown(belief.variable.unit)
    return f"{name}, sd {factor * belief.sd:g}{behind(unit)}"
