"""Instruments that fail or are not as the configuration says: simulated logs, broken."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from dives import altered

from rovgraph.geometry import Array, matrix_from_rpy
from rovgraph.log import Log

FROM = 60.0  # seconds since the start at which a failure begins


@dataclass(frozen=True)
class Broken:
    """A way to break a log.

    Attributes
    ----------
    breaks : a log to a broken one
    truth : what the simulated dive has beside the usual
    """

    breaks: Callable[[Log], Log]
    truth: Mapping[str, Any] = field(default_factory=dict)


def changed_data(sensor: str, change: Callable[[Array, Array], None]) -> Callable[[Log], Log]:
    """Breaks the data of one sensor in place; ``change`` takes them and the seconds since the start."""

    def breaks(log: Log) -> Log:
        data = log[sensor].data.copy()
        change(data, log[sensor].time - log["imu"].time[0])
        return altered(log, sensor, data)

    return breaks


def _flipped(data: Array, _: Array) -> None:
    data[:, 1] *= -1.0


def _turned(data: Array, _: Array) -> None:
    R = matrix_from_rpy(np.deg2rad([2.0, 1.0, 3.0]))
    for part in range(0, data.shape[1], 3):
        data[:, part : part + 3] = data[:, part : part + 3] @ R


def _offset(column: int, by: float, seconds: float) -> Callable[[Array, Array], None]:
    def change(data: Array, time: Array) -> None:
        data[(time > FROM) & (time < FROM + seconds), column] += by

    return change


def _held(seconds: float) -> Callable[[Array, Array], None]:
    def change(data: Array, time: Array) -> None:
        now = np.flatnonzero((time > FROM) & (time < FROM + seconds))
        data[now, :3] = data[now[0] - 1, :3]

    return change


def _noisier(data: Array, _: Array) -> None:
    """Three times the noise that `falcon.yaml` states."""
    more = np.sqrt(8.0) * np.array([0.00374, 0.00353, 0.00155])
    data[:, :3] += more * np.random.default_rng(7).standard_normal((len(data), 3))


def _scaled(data: Array, _: Array) -> None:
    data[:, 3:] *= 1.005


def _warmed_up(data: Array, time: Array) -> None:
    data[:, 3:] += np.deg2rad([0.2, -0.3, 0.4]) * (1.0 - np.exp(-time / 90.0))[:, None]


def late(sensor: str, seconds: float) -> Callable[[Log], Log]:
    def breaks(log: Log) -> Log:
        stream = log[sensor]
        return replace(log, streams={**log.streams, sensor: replace(stream, time=stream.time + seconds)})

    return breaks


def _mounted(log: Log) -> Log:
    log = changed_data("imu", _turned)(log)
    return changed_data("mag", _turned)(log)  # which sits in the same housing


BROKEN: dict[str, Broken] = {
    "DVL y sign flipped": Broken(changed_data("dvl", _flipped)),
    "IMU mounted 2, 1, 3 degrees off": Broken(_mounted),
    "DVL biased by 0.3 m/s for 20 s": Broken(changed_data("dvl", _offset(0, 0.3, 20.0))),
    "DVL frozen for a minute": Broken(changed_data("dvl", _held(60.0))),
    "depth stuck": Broken(changed_data("depth", _held(1e9))),
    "DVL 0.3 s late": Broken(late("dvl", 0.3)),
    "DVL noise three times as stated": Broken(changed_data("dvl", _noisier)),
    "fixes 8 m off for a minute": Broken(changed_data("fix", _offset(0, 8.0, 60.0)), {"fix_interval": 2.0}),
    "gyro scale 0.5 %": Broken(changed_data("imu", _scaled)),
    "gyro warms up": Broken(changed_data("imu", _warmed_up)),
}
