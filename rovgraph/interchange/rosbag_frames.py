"""Mountings and lever arms from ``/tf_static`` (REP 103: x forward, y left, z up; REP 105: base_link)."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from rovgraph.geometry import Array, matrix_from_quaternion, rpy_from_matrix

FRD_OF_FLU = np.diag([1.0, -1.0, -1.0])
BODIES = ("base_link", "base_link_frd", "base_footprint")


@dataclass(frozen=True)
class Mounting:
    """How a sensor sits in the vehicle.

    Attributes
    ----------
    R_bs : ndarray, shape (3, 3), from the sensor's axes to forward, starboard, down
    lever_arm_b : ndarray, shape (3,) [m], None = not known
    """

    R_bs: Array
    lever_arm_b: Array | None = None

    def settings(self) -> dict[str, list[float]]:
        """As a sensor's configuration."""
        found = {"mount_rpy_deg": _rounded(np.rad2deg(rpy_from_matrix(self.R_bs)), 4)}
        return found if self.lever_arm_b is None else found | {"lever_arm_m": _rounded(self.lever_arm_b, 5)}


class Frames:
    """A tree of frames that do not move."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Array, Array]] = {}  # child -> parent, R_pc, t_pc

    def take(self, transforms: Iterable[Any]) -> None:
        """Transforms of a ``tf2_msgs/TFMessage``; what is no rotation is left out."""
        for each in transforms:
            q, t = each.transform.rotation, each.transform.translation
            R, moved = matrix_from_quaternion((q.x, q.y, q.z, q.w)), np.array([t.x, t.y, t.z])
            if np.isfinite(R).all() and np.isfinite(moved).all():
                self._parents[_name(each.child_frame_id)] = _name(each.header.frame_id), R, moved

    def mounting(self, frame: str) -> Mounting | None:
        """Of a sensor in the body; None where no chain of transforms leads there."""
        at, R, t = _name(frame), np.eye(3), np.zeros(3)
        for _ in range(len(self._parents) + 1):
            if at in BODIES:
                to_frd = np.eye(3) if at.endswith("frd") else FRD_OF_FLU
                return Mounting(to_frd @ R, to_frd @ t)
            if at not in self._parents:
                return None
            at, R_pc, t_pc = self._parents[at]
            R, t = R_pc @ R, R_pc @ t + t_pc
        return None  # a circle


def _name(frame: str) -> str:
    return frame.lstrip("/")


def _rounded(values: Array, digits: int) -> list[float]:
    return [round(float(v), digits) + 0.0 for v in values]
