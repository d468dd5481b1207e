"""The line that says how a DVL's axes are put right: followed word for word, it does."""

import re

import numpy as np
import pytest

from rovgraph.geometry import signed_permutations
from rovgraph.model.config import mount_matrix
from rovgraph.sensors.dvl import VELOCITIES, axes_remedy

MOUNT_RPY_DEG = (180.0, 0.0, 45.0)


def mended(remedy: str) -> np.ndarray:
    """Body axes from measured velocities, by the signs and the mounting that a remedy names."""
    signs = [-1.0 if f"units: {{{name}: -m/s}}" in remedy else 1.0 for name in VELOCITIES]
    rpy = re.search(r"dvl\.mount_rpy_deg: \[(.*)\]", remedy)
    return mount_matrix([float(a) for a in rpy[1].split(",")] if rpy else MOUNT_RPY_DEG) @ np.diag(signs)


@pytest.mark.parametrize("k", range(1, 48))
def test_every_wrong_orientation_is_mended_by_what_its_remedy_states(k):
    H, R_bs = signed_permutations()[k], mount_matrix(MOUNT_RPY_DEG)
    cause, remedy = axes_remedy(H, R_bs)
    np.testing.assert_allclose(mended(remedy), R_bs @ H, atol=2e-3)
    assert ("left-handed" in cause) == ("units" in remedy) == (np.linalg.det(H) < 0.0)


@pytest.mark.parametrize("axis", range(3))
def test_one_reversed_velocity_leaves_the_mounting_as_it_is(axis):
    H = np.eye(3)
    H[axis, axis] = -1.0
    remedy = axes_remedy(H, mount_matrix(MOUNT_RPY_DEG))[1]
    assert f"units: {{{VELOCITIES[axis]}: -m/s}}" in remedy
    assert "mount_rpy_deg" not in remedy
