"""Acoustic positioning of a simulated dive: the ship, its log, beacons, and what a head and ranges measure.

What is measured leaves no residual: bearings, elevations and ranges are changed until the estimator's own equation
(`rovgraph.kernels.measurements.acoustic`) predicts them at the true state, with the ship where it truly was; their
noise comes on top. So every key of ``usbl``, ``range``, ``ship``, ``beacons`` and ``sound`` counts as it does there.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array, matrix_from_rpy, rotate, rpy_from_matrix
from rovgraph.kernels import measurement_row as at
from rovgraph.log import Stream
from rovgraph.log.streams import label_number
from rovgraph.model.calibration import beacon_names
from rovgraph.model.config import Config
from rovgraph.model.config_sections import Usbl
from rovgraph.model.state import State
from rovgraph.problem.acoustics import Acoustics
from rovgraph.sensors import SENSORS, AcousticExchange
from rovgraph.sensors.instruments import Instrument
from rovgraph.simulate.path import CALM, GRID_S, Path, Style, Waves
from rovgraph.simulate.scenario import MANOEUVRE_DEPTH_M, MANOEUVRES, SCENARIOS
from rovgraph.simulate.truth import remembered

REPLY_S, RECEIVER_S, RANGE_S = 1.0, 1.0, 5.0  # between replies of a head, ranges to receivers and to a beacon
APART_S = 0.02  # between receivers or beacons of one turn
SHIP_S, SHIP_ATTITUDE_S = 1.0, 0.2  # between the ship's positions, and its attitudes
SHIP_MEMORY_S = 1.0  # of the errors of its position and attitude
TRACK_S = 0.05  # between the epochs that the true ship is interpolated from
SHIP_WAVES = Waves(heave=0.0, roll=float(np.deg2rad(3.0)), pitch=float(np.deg2rad(1.5)), frequency=0.12)
DRIFT = ((4.0, 137.0), (3.0, 101.0), (float(np.deg2rad(20.0)), 173.0))  # north, east [m], heading: amplitude, period
BEACON_AWAY_M, BEACON_BELOW_M = (10.0, 40.0), (1.0, 8.0)  # from the dive's middle, below its deepest point
FIRST_GUESS = 10.0, 0.0, 1.0  # range [m], bearing, elevation [rad]
ROUNDS = 4  # a residual shrinks by speed over speed of sound in each, some 1000 times

Epochs = Callable[[Array], tuple[State, Array]]  # times, shape (n,), to states and angular rates


def has_acoustics(config: Config) -> bool:
    """Whether a configuration states an acoustic system: a key of ``usbl``, beacons or receivers."""
    return config.usbl != Usbl() or bool(config.beacons) or bool(config.ship.receivers)


def middle(path: Path) -> Array:
    """Of the box around a path, shape (3,) [m]."""
    p_n = path.motion(np.linspace(0.0, path.duration, 500)).p_n
    return np.asarray(0.5 * (p_n.min(axis=0) + p_n.max(axis=0)))


def ship_path(name: str | None, path: Path, rng: np.random.Generator | None) -> Path:
    """What the ship does above a vehicle's path.

    Parameters
    ----------
    name : of `MANOEUVRES`, around the middle of the vehicle's path; None = stay there, drift and turn slowly
    path : of the vehicle
    rng : draws the heading that it stays on, and its drift; None = it neither drifts nor rolls

    Raises
    ------
    InputError : no such manoeuvre
    """
    if name is not None and name not in MANOEUVRES:
        raise InputError(f"ship {name!r}: expected one of {', '.join(MANOEUVRES)}")
    north, east, _ = middle(path)
    if name is not None or rng is None:
        style = Style(waves=CALM if rng is None else SHIP_WAVES)
        return SCENARIOS[name or "hold"](path.duration, None, style).shifted([north, east, -MANOEUVRE_DEPTH_M])
    time = np.linspace(0.0, path.duration, int(np.ceil(path.duration / GRID_S)) + 1)
    size, period = np.array(DRIFT).T
    drift = size * np.sin(2.0 * np.pi * time[:, None] / period + rng.uniform(0.0, 2.0 * np.pi, 3))
    _, roll, pitch = SHIP_WAVES.at(time, np.ones(len(time))).T
    p_n = np.column_stack([drift[:, :2] + [north, east], np.zeros(len(time))])
    rpy = np.column_stack([roll, pitch, drift[:, 2] + rng.uniform(-np.pi, np.pi)])
    return Path.through(time, p_n, rpy, rest=False)


def lay_beacons(config: Config, path: Path, rng: np.random.Generator | None) -> dict[str, Array]:
    """Where the beacons are that the configuration gives no place: variable -> its true value [m].

    Parameters
    ----------
    config : with the beacons
    path : of the vehicle
    rng : draws places around its middle; None = in the middle
    """
    out, centre = {}, middle(path)
    deepest = float(path.motion(np.linspace(0.0, path.duration, 500)).p_n[:, 2].max())
    for k, beacon in enumerate(config.beacons):
        place, down = beacon_names(k)
        angle, away, below = (
            (0.0, 0.0, BEACON_BELOW_M[1])
            if rng is None
            else (rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*BEACON_AWAY_M), rng.uniform(*BEACON_BELOW_M))
        )
        if beacon.north_m is None:
            out[place] = centre[:2] + away * np.array([np.cos(angle), np.sin(angle)])
        if beacon.down_m is None:
            out[down] = np.array([deepest + below])
    return out


@dataclass(frozen=True)
class AcousticSampler:
    """Samples a head, ranges and the ship's own instruments.

    Attributes
    ----------
    config : the truth's
    instruments : its sensors
    ship : what the ship does
    epochs : true states of the vehicle
    late : sensor -> how late its stamps are [s]
    rng : draws the noise; None = there is none
    """

    config: Config
    instruments: Mapping[str, Instrument]
    ship: Path
    epochs: Epochs
    late: Mapping[str, float]
    rng: np.random.Generator | None

    def frames(self) -> list[pd.DataFrame]:
        """Tables of the log."""
        config, on_ship, out = self.config, self.config.usbl.head == "ship", []
        beacons = [beacon.name for beacon in config.beacons]
        first = RANGE_S if self.rng is None else RANGE_S * self.rng.uniform(0.3, 1.0)
        if on_ship or config.ship.receivers:
            out += self._ship_log()
        if config.usbl != Usbl():
            out.append(self._table("usbl", "usbl_beacon", [config.usbl.beacon] if on_ship else beacons, first, REPLY_S))
        if beacons and (on_ship or config.usbl == Usbl()):
            out.append(self._table("range", "range_beacon", beacons, first, RANGE_S))
        if config.ship.receivers:
            out.append(self._table("range", "range_receiver", [*config.ship.receivers], first, RECEIVER_S))
        return out

    def _ship_log(self) -> list[pd.DataFrame]:
        """Position and attitude of the ship as its instruments say them; nothing of what the configuration states."""
        settings, end, out = self.config.ship, self.ship.duration, []
        slow, fast = np.arange(0.5, end, SHIP_S), np.round(np.arange(0.1, end, SHIP_ATTITUDE_S), 4)
        if settings.north_m is None:
            north, east = self._noisy(self._antenna(slow), settings.sd_m, SHIP_S).T
            out.append(pd.DataFrame({"time": slow, "ship_north": north, "ship_east": east}))
        if settings.heading_deg is None:
            sd = np.deg2rad([settings.tilt_sd_deg, settings.tilt_sd_deg, settings.heading_sd_deg])
            roll, pitch, heading = self._noisy(self._attitude(fast), sd, SHIP_ATTITUDE_S).T
            heading = np.mod(heading, 2.0 * np.pi)
            out.append(pd.DataFrame({"time": fast, "ship_heading": heading, "ship_roll": roll, "ship_pitch": pitch}))
        return out

    def _noisy(self, values: Array, sd: Array | float, step: float) -> Array:
        if self.rng is None:
            return values
        return values + sd * remembered(self.rng.standard_normal(values.shape), SHIP_MEMORY_S / step)

    def _antenna(self, time: Array) -> Array:
        """The ship's antenna, north and east, shape (n, 2) [m]."""
        motion, arm = self.ship.motion(time), np.array(self.config.ship.antenna_m)
        return (motion.p_n + rotate(motion.R_nb, np.broadcast_to(arm, motion.p_n.shape)))[:, :2]

    def _attitude(self, time: Array) -> Array:
        """The ship's roll, pitch and heading, shape (n, 3) [rad]."""
        return rpy_from_matrix(self.ship.motion(time).R_nb)

    def _with_true_ship(self) -> Acoustics:
        """Exchanges with a ship that is known exactly, and with the system's own noise alone."""
        config, ship = self.config, self.config.ship
        sure = {"sd_m": 0.0, "heading_sd_deg": 0.0, "tilt_sd_deg": 0.0}
        out = Acoustics(config.with_values(ship=sure, usbl={"depth": "measured"}), self.instruments)
        time = np.arange(0.0, self.ship.duration + TRACK_S, TRACK_S).clip(max=self.ship.duration)
        if ship.north_m is None:
            out.signals["ship"].take(time, np.column_stack([self._antenna(time), np.full(len(time), np.nan)]))
        if ship.heading_deg is None:
            out.signals["ship_heading"].take(time, self._attitude(time)[:, 2:])
            out.signals["ship_tilt"].take(time, self._attitude(time)[:, :2])
        if "depth" in out.signals:
            out.signals["depth"].take(time, self.epochs(time)[0].p_n[:, 2:])
        return out

    def _table(
        self, sensor: str, label: str, names: Sequence[str | int | None], first: float, interval: float
    ) -> pd.DataFrame:
        """What is measured of ends with names, in turn."""
        turns = np.arange(first, self.ship.duration, interval)
        stamps = np.round((turns[:, None] + APART_S * np.arange(len(names))).ravel(), 4)
        who = pd.Series([*names] * len(turns), dtype=object)
        columns = SENSORS[sensor].column_names
        values = np.full((len(stamps), len(columns)), np.nan)
        values[:, columns.index(label)] = [math.nan if name is None else label_number(str(name)) for name in who]
        kept = self._measure(Stream(sensor, columns, np.asarray(stamps, float), values, np.arange(len(stamps))))
        measured = ["usbl_range", "usbl_bearing", "usbl_elevation"] if sensor == "usbl" else ["range"]
        out = pd.DataFrame(values, columns=pd.Index(columns))[measured]
        out.insert(0, "time", stamps)
        if who.notna().all():
            out[label] = who.astype("Int64" if all(isinstance(name, int) for name in names) else str)
        return out.iloc[kept]

    def _measure(self, stream: Stream) -> NDArray[np.int64]:
        """Fill in measurements that leave no residual, and noise, in place; rows of those that there are."""
        model, acoustics, late = self.instruments[stream.sensor].model, self._with_true_ship(), self.late[stream.sensor]
        assert isinstance(model, AcousticExchange)
        stream.data[:, 0] = FIRST_GUESS[0]
        if stream.sensor == "usbl":
            stream.data[:, 2:4] = FIRST_GUESS[1:]
        for _ in range(ROUNDS):
            found = acoustics.exchanges(stream, late, Counter())
            context = found.data[:, 2 * model.dim : 2 * model.dim + at.WIDTH]
            z = model.of(context).predict(*self.epochs(found.time - late))[0]
            z[:, 0] -= found.data[:, 0]
            _move(stream.data, found.row, z)
        if self.rng is not None:
            sd = found.data[:, model.dim : 2 * model.dim]
            _move(stream.data, found.row, sd * self.rng.standard_normal(z.shape))
        return np.sort(found.row)


def _move(data: Array, rows: NDArray[np.int64], change: Array) -> None:
    """Change ranges [m], and directions across and up [rad], in place; ``change`` has shape (k, 1) or (k, 3)."""
    data[rows, 0] += change[:, 0]
    if change.shape[1] == 1:
        return
    angles = np.column_stack([np.zeros(len(rows)), -data[rows, 3], data[rows, 2]])
    R = matrix_from_rpy(angles)  # its axes: along the direction, across, and down from it
    angle = np.hypot(change[:, 1], change[:, 2])
    part = np.sinc(angle / np.pi)
    u = rotate(R, np.column_stack([np.cos(angle), part * change[:, 1], part * change[:, 2]]))
    data[rows, 2], data[rows, 3] = np.arctan2(u[:, 1], u[:, 0]), np.arcsin(np.clip(u[:, 2], -1.0, 1.0))
