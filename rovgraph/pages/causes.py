"""Sources of variance in groups that a person can do something about."""

from collections.abc import Mapping
from dataclasses import dataclass

HEADING = (
    *("mag", "ahrs", "dvl_heading", "vehicle_heading", "hard_iron", "soft_iron", "field_"),
    *("dvl_compass", "vehicle_compass", "start attitude"),
)


@dataclass(frozen=True)
class Cause:
    """A group of sources.

    Attributes
    ----------
    sources : how their names in summary.json begin; a source belongs to the first group that has it
    text : what limits, in words
    advice : what to do next time
    known : whether no way travelled adds to it: it stands whatever the DVL sees
    """

    sources: tuple[str, ...]
    text: str
    advice: str
    known: bool = False


CAUSES = (
    Cause(
        ("start position",),
        "the position at the start",
        "take a position fix at the start, or state start.position_sd_m where it is known better",
        known=True,
    ),
    Cause(("fix",), "the position fixes", "take better fixes, or state fix.sd_m where they are better", known=True),
    Cause(
        HEADING,
        "the heading (compasses and their calibration)",
        "turn two full circles in calm water to show the compasses, and calibrate the magnetometer",
    ),
    Cause(
        ("dvl_yaw", "dvl_roll", "dvl_pitch"),
        "the mounting of the DVL",
        "take position fixes at both ends of a long straight line, or measure the mounting and state its sd",
    ),
    Cause(
        ("dvl_scale",),
        "the scale of the DVL",
        "take position fixes at both ends of a long straight line, and state the sound speed",
    ),
    Cause(
        ("dvl",),
        "the small errors of the DVL's velocity, which add up over the way",
        "take a position fix now and then, or pass a place twice that a camera or a sonar recognises",
    ),
    Cause(
        ("imu", "gyr", "acc", "start bias", "start velocity"),
        "the noise and biases of the inertial unit",
        "use a DVL throughout or take position fixes more often, and state the unit's noise (rovgraph calibrate noise)",
    ),
    Cause(
        ("thruster", "drag", "current"),
        "the current and the model of the thrusters",
        "keep a DVL's bottom lock, or take position fixes more often",
    ),
)


def largest_cause(sources: Mapping[str, float]) -> tuple[Cause, float] | None:
    """The group that brings the most, and its share; None where the sources have no variance or no group."""
    total, found = sum(sources.values()), dict.fromkeys(CAUSES, 0.0)
    for name, variance in sources.items():
        cause = next((c for c in CAUSES if name.startswith(c.sources)), None)
        if cause is not None:
            found[cause] += variance
    cause = max(CAUSES, key=found.__getitem__)
    return (cause, found[cause] / total) if found[cause] > 0 else None
