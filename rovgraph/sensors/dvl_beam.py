"""The beams of a Doppler velocity log: velocity along each, and which pings are taken by their beams.

One stream, "dvl_beams", has a row for each ping, with all beams by the instrument's own numbers. Each beam is a sensor
of its own for the estimate, "dvl_beam_3", with its noise, gate and loss. A velocity is positive when the instrument
moves in the direction in which the beam points (docs/beams.md).
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array, skew
from rovgraph.kernels import measurements as kernels
from rovgraph.kernels.measurement_row import BEAM_WIDTH
from rovgraph.model.calibration import BEAM_SENSORS
from rovgraph.model.config import Config, mount_matrix
from rovgraph.model.config_sections import Dvl
from rovgraph.model.state import BIAS, POSE, VELOCITY, Jacobians, State
from rovgraph.sensors.dvl import DVL_CALIBRATION, TIME_OFFSET
from rovgraph.sensors.model import evaluate
from rovgraph.sensors.sensor import Column, Instrument, Observed, Sensor, instrument

BEAMS = "dvl_beams"  # stream of pings, and name of the table beside a log
NUMBERS = range(len(BEAM_SENSORS))  # of beams
QUANTITIES = "valid", "velocity", "range", "distance", "sd"  # of each beam, in the order of the stream's columns
PHASED_C0 = 1536.0  # speed of sound for which a phased array is spaced, with beams of 30 deg [m/s]
USUAL_C = 1500.0  # of a phased array where none is stated [m/s]
ERROR_GATE = 3.0  # sds of the error velocity, up to which four beams that the instrument refused are taken
MOSTLY = 3  # so many more refused pings agree than disagree, where they are taken
RATE_SHARE = 2.0**0.5  # beams of a ping share the noise of the rate, each row has it by itself


class BeamGeometry(NamedTuple):
    """Where k beams point, in the DVL's axes.

    Attributes
    ----------
    numbers : the instrument's own
    directions : ndarray, shape (k, 3), unit vectors
    tilts : ndarray, shape (k, 3), their derivative by the angle from z
    """

    numbers: tuple[int, ...]
    directions: Array
    tilts: Array


@lru_cache(maxsize=8)  # asked for at each ping
def beam_geometry(dvl: Dvl) -> BeamGeometry | None:
    """Where the beams of a DVL point; None where the configuration does not say so."""
    beams = dvl.beams
    if beams.angle_deg is None or not beams.azimuth_deg:
        return None
    angle = np.deg2rad(beams.angle_deg)
    if beams.phased:
        steered = np.arcsin(min(np.sin(angle) * beam_sound_speed(dvl) / PHASED_C0, 1.0 - 1e-9))
        angle = steered if beams.angle_deg < 90.0 else np.pi - steered
    azimuth = np.deg2rad(np.array(beams.azimuth_deg) + (0.0 if beams.convex else 180.0))
    around = np.column_stack([np.cos(azimuth), np.sin(azimuth)])
    down = np.ones((len(azimuth), 1))
    directions = np.hstack([np.sin(angle) * around, np.cos(angle) * down])
    tilts = np.hstack([np.cos(angle) * around, -np.sin(angle) * down])
    numbers = tuple(range(beams.first_number, beams.first_number + len(azimuth)))
    return BeamGeometry(numbers, directions, tilts)


def beam_sound_speed(dvl: Dvl) -> float:
    """Speed of sound that the directions of a phased array's beams, and velocities along them, are given for [m/s]."""
    return dvl.sound_speed_mps or USUAL_C


@lru_cache(maxsize=8)
def beam_sd(dvl: Dvl) -> float:
    """Noise of the velocity along a beam: as stated, or by that of the velocity of the whole head [m/s]."""
    geometry = beam_geometry(dvl)
    if dvl.beam_sd_mps is not None or geometry is None:
        return dvl.beam_sd_mps or dvl.velocity_sd_mps[0]
    shared = np.linalg.inv(geometry.directions.T @ geometry.directions)
    return float(np.sqrt(np.mean(np.square(dvl.velocity_sd_mps[:2]) / np.diag(shared)[:2])))


@dataclass(frozen=True)
class DvlBeam:
    """Velocity of the DVL along one of its beams, over ground.

    Attributes
    ----------
    sensor : "dvl_beam_" and its number
    context : ndarray, shape (1 or n, BEAM_WIDTH or more), of each measurement, `rovgraph.kernels.measurement_row`
    """

    sensor: str
    context: Array = field(default_factory=lambda: np.zeros((1, BEAM_WIDTH)))
    dim = 1
    angular = False
    state = (POSE, VELOCITY, BIAS)
    kind = kernels.DVL_BEAM

    @property
    def calibration(self) -> tuple[str, ...]:
        return (
            *DVL_CALIBRATION,
            "dvl_error",
            "bottom_velocity",
            "dvl_bias",
            "dvl_altitude_scale",
            f"{self.sensor}_angle",
        )

    @property
    def packed(self) -> Array:
        """The contexts."""
        return self.context

    def of(self, context: Array) -> "DvlBeam":
        """The model of measurements with these contexts, shape (n, BEAM_WIDTH or more)."""
        return replace(self, context=np.ascontiguousarray(context))

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        return evaluate(self, self.state, state, rate_b)


def _along_beam(number: int, config: Config, origin_b: Array) -> Instrument:
    """A beam by its number."""
    dvl, geometry = config.dvl, beam_geometry(config.dvl)
    gain = np.zeros((1, 3))
    if geometry is not None and number in geometry.numbers:
        direction = geometry.directions[geometry.numbers.index(number)]
        arm_b = np.array(dvl.lever_arm_m) - origin_b
        gain = RATE_SHARE * (direction @ mount_matrix(dvl.mount_rpy_deg).T @ skew(-arm_b))[None]
    return instrument(dvl, DvlBeam(BEAM_SENSORS[number]), beam_sd(dvl), ("along",), gain, TIME_OFFSET)


def beam_columns(number: int) -> tuple[str, ...]:
    """Columns of a beam in the stream, by `QUANTITIES`."""
    return tuple(f"dvl_beam_{quantity}_{number}" for quantity in QUANTITIES)


class Beams(NamedTuple):
    """What k beams measured in n pings, by their numbers.

    Attributes
    ----------
    numbers : the instrument's own
    valid : ndarray of bool, shape (n, k)
    velocity : ndarray, shape (n, k), positive towards where the beam points [m/s]
    range, distance : ndarray, shape (n, k), to the bottom along the beam, and straight down; NaN where it is not
        valid or has none [m]
    sd : ndarray, shape (n, k), of the velocity; NaN = not known [m/s]
    """

    numbers: tuple[int, ...]
    valid: NDArray[np.bool_]
    velocity: Array
    range: Array
    distance: Array
    sd: Array


def beams_of(data: Array, numbers: Iterable[int] | None = None) -> Beams:
    """The beams of n pings.

    Parameters
    ----------
    data : ndarray, shape (n, 45), rows of the stream. A beam is valid where that is said, else where its velocity is
        known, else where its range is
    numbers : of the beams; None = those that have measured anything
    """
    cells = data.reshape(len(data), len(NUMBERS), len(QUANTITIES))
    if numbers is None:
        numbers = np.flatnonzero(np.isfinite(cells).any(axis=(0, 2))).tolist()
    chosen = tuple(numbers)
    valid, velocity, far, down, sd = np.moveaxis(cells[:, list(chosen)], 2, 0)
    said, moves = np.isfinite(valid).any(axis=0), np.isfinite(velocity).any(axis=0)
    known = np.where(moves, np.isfinite(velocity), np.isfinite(far) | np.isfinite(down))
    good = np.where(said, valid == 1.0, known)
    far, down = (np.where(good & (a > 0.0), a, np.nan) for a in (far, down))  # 0 and -1 are invalid
    return Beams(chosen, good, velocity, far, down, np.where(sd > 0.0, sd, np.nan))


def velocity_by_beams(directions: Array, velocity: Array, valid: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Velocity of the DVL by least squares over the beams that are valid, and the length of what they disagree by.

    Parameters
    ----------
    directions : ndarray, shape (k, 3)
    velocity, valid : ndarray, shape (n, k)

    Returns
    -------
    velocity : ndarray, shape (n, 3) [m/s]; NaN where the beams do not span
    error : ndarray, shape (n,), as noisy as one beam [m/s]; NaN where there are not more than three
    """
    out, error = np.full((len(velocity), 3), np.nan), np.full(len(velocity), np.nan)
    for pattern in np.unique(valid, axis=0) if len(valid) else ():
        D, rows = directions[pattern], (valid == pattern).all(axis=1)
        if pattern.sum() < 3 or np.linalg.svd(D, compute_uv=False)[-1] < 0.05:
            continue
        b = velocity[np.ix_(rows, pattern)]
        out[rows] = b @ np.linalg.pinv(D).T
        if pattern.sum() > 3:
            error[rows] = np.linalg.norm(b - out[rows] @ D.T, axis=1) / np.sqrt(pattern.sum() - 3.0)
    return out, error


def error_velocity(data: Array, dvl: Dvl) -> Array:
    """What the valid beams of n pings disagree by, as `velocity_by_beams` has it, shape (n,) [m/s].

    Parameters
    ----------
    data : as of `beams_of`
    """
    geometry = beam_geometry(dvl)
    if geometry is None:
        return np.full(len(data), np.nan)
    beams = beams_of(data, geometry.numbers)
    moving = beams.valid & np.isfinite(beams.velocity)
    return velocity_by_beams(geometry.directions, beams.velocity, moving)[1]


class Refusals(NamedTuple):
    """What has been seen of the pings that a DVL refuses.

    Attributes
    ----------
    chooses : it refuses by more than the number of beams: it has made a velocity of three, or refused one of four
    agreeing, disagreeing : how many pings of four beams and more it has refused, by what their beams say of each other
    """

    chooses: bool = False
    agreeing: int = 0
    disagreeing: int = 0


def taken_by_beams(beams: Beams, accepted: Array, dvl: Dvl, seen: Refusals) -> tuple[NDArray[np.bool_], Refusals]:
    """Which beams of n pings enter the estimate; a ping with any of them is not taken by its velocity.

    What the instrument itself refused with three beams or more is not readmitted because its beams call themselves
    valid: of 57 such pings of an A50, 40 had four valid beams and were 0.1 to 0.4 m/s off. Four beams of such a ping
    agree by chance once in ten, so that agreement counts where most of the refused pings so far have it.

    Parameters
    ----------
    beams : those that the geometry knows
    accepted : ndarray, shape (n,), the instrument's own word: 1 = it gives a velocity, 0 = it refuses one, NaN = it
        says nothing
    dvl : section of the configuration
    seen : before these pings

    Returns
    -------
    taken : ndarray of bool, shape (n, k)
    seen : with these pings
    """
    geometry = beam_geometry(dvl)
    if geometry is None or dvl.use == "velocity":
        return np.zeros(beams.valid.shape, bool), seen
    good = beams.valid & np.isfinite(beams.velocity) & (np.abs(beams.velocity) <= dvl.max_speed_mps)
    if dvl.use == "beams":
        return np.asarray(good), seen
    places = [geometry.numbers.index(k) for k in beams.numbers]
    _, error = velocity_by_beams(geometry.directions[places], beams.velocity, good)
    count = good.sum(axis=1)
    four, agree = (accepted == 0.0) & (count > 3), error <= ERROR_GATE * beam_sd(dvl)
    chooses = seen.chooses | np.logical_or.accumulate(four | ((accepted == 1.0) & (count == 3)))
    more = seen.agreeing - seen.disagreeing + np.cumsum(np.where(agree, 1, -1) * four)
    kinds = int((four & agree).sum()), int((four & ~agree).sum())
    after = Refusals(bool(seen.chooses or chooses.any()), seen.agreeing + kinds[0], seen.disagreeing + kinds[1])
    agree = np.where(count > 3, agree & (more >= MOSTLY), count < np.where(chooses, 3, 4))
    made = (accepted == 1.0) & (count > 2)  # of fewer it is not made: others of the table are missing
    return np.asarray(good & (made | np.isnan(accepted) | ((accepted == 0.0) & agree))[:, None]), after


def _has_any(values: Array) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(values).any(axis=1))


def _beam_stream_columns(number: int) -> tuple[Column, ...]:
    valid, velocity, far, down, sd = beam_columns(number)
    return (
        Column(valid, optional=True, flag=True),
        Column(velocity, "speed", optional=True, group="dvl_beam_velocity"),
        Column(far, "length", optional=True, group="dvl_beam_range"),
        Column(down, "length", optional=True, group="dvl_beam_range"),
        Column(sd, "speed", optional=True, group="dvl_beam_velocity"),
    )


DVL_BEAMS = Sensor(
    BEAMS,
    tuple(column for number in NUMBERS for column in _beam_stream_columns(number)),
    complete=_has_any,
)
SINGLE_BEAMS = tuple(
    Sensor(name, (), partial(_along_beam, number), observes=Observed("velocity"))
    for number, name in enumerate(BEAM_SENSORS)
)
