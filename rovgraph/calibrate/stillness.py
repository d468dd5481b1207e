"""Does a log stand still? Waves do not count as motion.

Signals are averaged under a Hann window of `WINDOW_S`, which takes an oscillation of waves
(0.34 Hz in the thesis's lake, 3.1.4) down to a thousandth and leaves turning, tilting, driving.
"""

from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.signal import fftconvolve  # type: ignore[attr-defined]

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log import Log

WINDOW_S = 20.0
GRID_S = 0.1


@dataclass(frozen=True)
class _Watch:
    """What may change of a stream, and what it means when it does."""

    sensor: str
    columns: tuple[str, ...]
    most: float
    unit: str
    says: str
    angle: bool = False  # a heading, which wanders at rest too: asked only where there is no gyro


_DEG = float(np.deg2rad(1.0))
# biases drift: the limits are well above that
_WATCHES = (
    _Watch("imu", ("gyr_x", "gyr_y", "gyr_z"), 0.3 * _DEG, "rad/s", "the gyro turns"),
    _Watch("imu", ("acc_x", "acc_y", "acc_z"), 0.2, "m/s2", "the accelerometer tilts or is pushed"),
    _Watch("dvl", ("dvl_vx", "dvl_vy", "dvl_vz"), 0.05, "m/s", "the DVL drives"),
    _Watch("dvl_heading", ("dvl_heading",), 5.0 * _DEG, "rad", "the DVL's compass turns", angle=True),
    _Watch("ahrs", ("ahrs_yaw",), 5.0 * _DEG, "rad", "the IMU's own heading turns", angle=True),
    _Watch("depth", ("depth",), 0.5, "m", "the depth changes"),
)


def require_still(log: Log) -> None:
    """Refuse a log that moves.

    Raises
    ------
    InputError : says which sensor shows it, when and how much
    """
    for watch in _WATCHES:
        if watch.sensor in log and not (watch.angle and "imu" in log):
            stream = log[watch.sensor]
            data = np.column_stack([stream[c] for c in watch.columns])
            whole = np.isfinite(data).all(axis=1)
            if whole.sum() > 1:
                _require(watch, stream.time[whole], data[whole], log.source)


def _require(watch: _Watch, time: Array, data: Array, source: str) -> None:
    data = np.unwrap(data, axis=0) if watch.angle else data
    steps = np.arange(time[0], time[-1], GRID_S)
    integral = cumulative_trapezoid(data, time, axis=0, initial=0.0)
    means = [np.diff(np.interp(steps, time, column)) / GRID_S for column in integral.T]
    smooth = np.column_stack([_smooth(mean) for mean in means])
    off = np.linalg.norm(smooth - np.median(smooth, axis=0), axis=1)
    worst = int(np.argmax(off))
    if off[worst] > watch.most:
        middle = 0.5 * min(WINDOW_S, float(steps[-1] - steps[0]))
        first, at = (float(steps[i] - time[0]) + middle for i in (int(np.argmax(off > watch.most)), worst))
        size, most, unit = off[worst], watch.most, watch.unit
        if unit.startswith("rad"):
            size, most, unit = size / _DEG, most / _DEG, "deg" + unit[3:]
        raise InputError(
            f"{source}: moves: {watch.says}, from about {first:.0f} s after its first sample on, "
            f"by up to {size:.2g} {unit} at {at:.0f} s, expected at most {most:.2g} {unit}; "
            "give a log at rest, or that part of it"
        )


def _smooth(values: Array) -> Array:
    """Means under the window, at every place where it fits in."""
    window = np.hanning(int(min(WINDOW_S / GRID_S, len(values))) + 2)[1:-1]
    return np.asarray(fftconvolve(values, window / window.sum(), mode="valid"))
