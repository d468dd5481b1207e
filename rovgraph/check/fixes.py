"""The DVL's velocities, turned by a heading, against position fixes.

In the plane as complex numbers: fixes move by ``d``, the DVL by ``D = sum exp(i psi) v dt``.
``d = c D`` fits with ``arg c`` the error of heading and mounting and ``|c|`` the scale. A DVL
whose y axis is mirrored fits better with the conjugate velocity.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rovgraph.check.findings import Finding
from rovgraph.config import Config, mount_matrix
from rovgraph.geometry import Array, matrix_from_rpy, rotate
from rovgraph.instruments import heading_sources
from rovgraph.log import Log

WINDOW = 10.0  # [s]
MIN_WINDOWS = 20
ENOUGH_DISTANCE = 20.0  # sum of the fixes' movement that is no noise [m]
MISALIGNED = np.deg2rad(15.0)
Complexes = NDArray[np.complex128]


def track(log: Log, config: Config) -> Iterator[Finding]:
    """Handedness, rotation and scale of the DVL's velocities against the fixes."""
    if not {"dvl", "fix"} <= log.sensors:
        return
    psi = _body_heading(log, config)
    if psi is None:
        return
    stream = log["dvl"]
    valid = stream["dvl_valid"] == 1.0
    if valid.sum() < MIN_WINDOWS or len(log["fix"]) < MIN_WINDOWS:
        return
    time = stream.time[valid]
    v_b = rotate(mount_matrix(config.dvl.mount_rpy_deg), stream.data[valid, :3])
    turn = np.exp(1j * np.interp(time, *psi))
    d, D, mirrored = _moves(log, time, turn * (v_b[:, 0] + 1j * v_b[:, 1]), turn * (v_b[:, 0] - 1j * v_b[:, 1]))
    if len(d) < MIN_WINDOWS or np.abs(d).sum() < ENOUGH_DISTANCE:
        yield Finding("fix", "ok", "too few fixes, or too little movement, to compare the DVL with them")
        return
    c, like, unlike = _ratio(d, D), _likeness(d, D), _likeness(d, mirrored)
    if unlike > like + 0.1 and unlike > 0.6:
        yield Finding("dvl", "warning", _mirrored_text(config, like, unlike))
    elif like < 0.6:
        yield Finding("dvl", "warning", f"velocities do not fit the fixes (likeness {like:.2f}); mounting or heading?")
    else:
        angle, scale = float(np.angle(c)), float(abs(c))
        wrong = abs(angle) > MISALIGNED or not 0.8 < scale < 1.25
        tail = "; check dvl.mount_rpy_deg and the compass offset" if wrong else ""
        if wrong and unlike > like - 0.05:
            tail += f". As well it may be mirrored: {_other_way_up(config)}"
        text = f"fits the fixes when turned by {round(np.rad2deg(angle)) + 0:+d} deg and scaled by {scale:.2f}{tail}"
        yield Finding("dvl", "warning" if wrong else "ok", text)


def _mirrored_text(config: Config, like: float, unlike: float) -> str:
    return (
        f"velocities fit the fixes better with y mirrored (likeness {unlike:.2f} against {like:.2f}): "
        f"{_other_way_up(config)}"
    )


def _other_way_up(config: Config) -> str:
    """A hint at a DVL that is mounted the other way up."""
    roll, pitch, yaw = config.dvl.mount_rpy_deg
    turned, z, y = (180, "up", "port") if abs(roll) < 90 else (0, "down", "starboard")
    return (
        f"does the DVL's z axis point {z} and y to {y}? Then dvl.mount_rpy_deg is [{turned}, {pitch:g}, {yaw:g}], "
        "its yaw to be found"
    )


def _body_heading(log: Log, config: Config) -> tuple[Array, Array] | None:
    """Times and headings without jumps of the first source but the magnetometer, in use or not [rad]."""
    for sensor in (*heading_sources(config, log.sensors), "ahrs", "dvl_heading"):
        if sensor == "mag" or sensor not in log or len(log[sensor]) < 2:
            continue
        mount = config.imu.mount_rpy_deg if sensor == "ahrs" else config.dvl.mount_rpy_deg
        axis = matrix_from_rpy(np.deg2rad(mount))[:, 0]
        psi = np.unwrap(log[sensor].data[:, 0]) - np.arctan2(axis[1], axis[0])
        return log[sensor].time, psi + np.deg2rad(config.environment.declination_deg)
    return None


def _moves(log: Log, time: Array, *velocities: Complexes) -> tuple[Complexes, ...]:
    """Movement within windows, by the fixes and by each velocity; each of shape (m,)."""
    fix = log["fix"]
    step = max(WINDOW, 2.0 * float(np.median(np.diff(fix.time))))
    edges = np.arange(max(fix.time[0], time[0]), min(fix.time[-1], time[-1]), step)
    if len(edges) < 2:
        return tuple(np.empty(0, dtype=complex) for _ in range(1 + len(velocities)))
    k = np.searchsorted(fix.time, edges).clip(1, len(fix) - 1)
    near = fix.time[k] - fix.time[k - 1] <= step
    position = np.interp(edges, fix.time, fix.data[:, 0]) + 1j * np.interp(edges, fix.time, fix.data[:, 1])
    out: list[Complexes] = [np.diff(position)]
    usable = near[1:] & near[:-1]
    for v in velocities:
        way = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(time))])
        out.append(np.diff(np.interp(edges, time, way.real) + 1j * np.interp(edges, time, way.imag)))
    return tuple(x[usable] for x in out)


def _ratio(d: Complexes, D: Complexes) -> complex:
    return complex(np.vdot(D, d)) / max(float(np.vdot(D, D).real), 1e-12)


def _likeness(d: Complexes, D: Complexes) -> float:
    """Correlation of the plane's movements, whatever the rotation and scale: 0 to 1."""
    size = float(np.linalg.norm(d) * np.linalg.norm(D))
    return float(abs(np.vdot(D, d))) / max(size, 1e-12)
