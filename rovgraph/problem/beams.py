"""From pings to measurements along single beams.

`PingsByBeams` decides which pings are taken by their beams, and gives each beam what its equation needs
(`rovgraph.kernels.measurement_row`). Beams and velocity of one ping are never both used.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from itertools import permutations
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rovgraph.geometry import Array
from rovgraph.kernels import measurement_row as at
from rovgraph.log import Measurement, Stream
from rovgraph.log.units import UNITS
from rovgraph.model.calibration import BEAM_SENSORS, LAYOUT
from rovgraph.model.config import Config
from rovgraph.model.config_sections import Dvl
from rovgraph.problem.admission import admitted
from rovgraph.problem.problem import Problem
from rovgraph.rules import remedy_of_lag
from rovgraph.sensors.dvl_beam import (
    BEAMS,
    BeamGeometry,
    Beams,
    Refusals,
    beam_geometry,
    beam_sd,
    beams_of,
    taken_by_beams,
)
from rovgraph.sensors.instruments import Instrument
from rovgraph.sensors.sensor import LARGEST_SD, Kind

MOVING, SDS = 0.1, 5.0  # speed at which beams and velocity are compared [m/s], and times the noise of a beam
AGREES, ENOUGH = 0.06, 20  # part of the speed, and pings
SAME_STAMPS = 0.5  # share of pings whose beams and velocity have one stamp
MOST_ORDERED = 5  # beams whose orders are tried
LAGS_S = np.arange(-3.0, 3.005, 0.01)  # that are tried
ONE_PING_S = 0.01  # stamps of beams and velocity of one ping differ by less
BY_BEAMS = "taken by its beams"


def beam_sensors(config: Config, streams: Mapping[str, Stream]) -> tuple[list[str], str]:
    """The sensors that a log's pings of beams become, each beam and the velocity that all show; and why not, if not so.

    ``dvl.use: auto`` takes velocities where beams do not give them.
    """
    geometry = beam_geometry(config.dvl)
    if BEAMS not in streams or config.dvl.use == "velocity":
        return [], ""
    beams = beams_of(streams[BEAMS].data)
    if not np.isfinite(beams.velocity).any():
        return [], ""
    if geometry is None:
        remedy = "state dvl.beams: {angle_deg, azimuth_deg} (docs/beams.md), and pings with two beams count"
        return [], f"it is not known where the beams of the DVL point, so its velocities are used; {remedy}"
    if config.dvl.use == "auto" and (found := head_against_velocity(config, streams)) is not None:
        return [], f"{found.text}, so velocities are used; {found.remedy}"
    return ["dvl", *(BEAM_SENSORS[k] for k in geometry.numbers)], ""


class WrongHead(NamedTuple):
    """What is wrong with beams by the velocities of the same pings, its kind in a check, and what to do."""

    kind: Kind
    text: str
    remedy: str


def head_against_velocity(config: Config, streams: Mapping[str, Stream]) -> WrongHead | None:
    """What is wrong with a log's beams, by the velocities that the instrument makes of them; None = nothing is seen.

    Parameters
    ----------
    streams : of a log, "dvl_beams" among them, velocities in the DVL's axes [m/s]
    """
    geometry = beam_geometry(config.dvl)
    if geometry is None or "dvl" not in streams or not len(streams["dvl"]):
        return None
    pings, dvl = streams[BEAMS], streams["dvl"]
    every, near = beams_of(pings.data), nearest(dvl.time, pings.time)
    moving: NDArray[np.bool_] = np.asarray(np.isfinite(every.velocity).any(axis=0))
    measured = [k for k, moves in zip(every.numbers, moving, strict=True) if moves]
    if unknown := sorted({*measured} - {*geometry.numbers}):
        numbers, known = ", ".join(map(str, unknown)), ", ".join(map(str, geometry.numbers))
        text = f"the log has velocities of beams {numbers}, and dvl.beams those of {known}"
        shifted = len(measured) == len(geometry.numbers) and measured[0] in (0, 1)
        remedy = f"state dvl.beams.first_number: {measured[0]}" if shifted else "correct dvl.beams.azimuth_deg"
        return WrongHead("axes", text, remedy)
    same = np.abs(dvl.time[near] - pings.time) < ONE_PING_S
    if same.mean() < SAME_STAMPS and len(same) >= ENOUGH:
        text = f"{same.mean():.0%} of the beams' stamps are those of a velocity"
        late = _late(geometry, pings, dvl)
        remedy = "state delay_s.dvl_beams" if late is None else remedy_of_lag(config, BEAMS, late, 0.0)
        return WrongHead("clock", text, f"{remedy}, or convert the native files again")
    beams = beams_of(pings.data, geometry.numbers)
    return _of_velocities(config.dvl, geometry, beams, dvl.data[near], same)


def _late(geometry: BeamGeometry, pings: Stream, dvl: Stream) -> float | None:
    """How much later than the velocities' the stamps of beams are [s]; None = no lag stands out."""
    beams, good = beams_of(pings.data, geometry.numbers), dvl.data[:, 3] == 1.0
    whole = beams.valid.all(axis=1)
    if min(np.count_nonzero(whole), np.count_nonzero(good)) < ENOUGH:
        return None
    v = beams.velocity[whole] @ np.linalg.pinv(geometry.directions).T
    time, of_dvl, known = pings.time[whole], dvl.data[good, :3], dvl.time[good]

    def off(lag: float) -> float:
        at = np.column_stack([np.interp(time - lag, known, column) for column in of_dvl.T])
        return float(np.median(np.linalg.norm(v - at, axis=1)))

    least, lag = min((off(lag), float(lag)) for lag in LAGS_S)
    return lag if least < 0.5 * off(0.0) else None


def _of_velocities(
    dvl: Dvl, geometry: BeamGeometry, beams: Beams, data: Array, same: NDArray[np.bool_]
) -> WrongHead | None:
    """The same by the numbers: ``data``, rows of the stream "dvl", which belong to pings of beams where ``same``."""
    v = data[:, :3]
    good = same & (data[:, 3] == 1.0) & (np.linalg.norm(v, axis=1) > max(MOVING, SDS * beam_sd(dvl)))
    good &= beams.valid.all(axis=1) & (np.abs(beams.velocity) < LARGEST_SD).all(axis=1)
    if np.count_nonzero(good) < ENOUGH:
        return None
    along, v = beams.velocity[good], v[good]
    inverse: Array = np.asarray(np.linalg.pinv(geometry.directions).T, dtype=np.float64)

    def off(along: Array, of: Array = inverse) -> float:
        return float(np.median(np.linalg.norm(along @ of - v, axis=1) / np.linalg.norm(v, axis=1)))

    now = off(along)
    if now < AGREES:
        return None
    differs = f"the velocity of the DVL's beams differs from its own by {now:.0%}"
    explained: list[tuple[float, Kind, str]] = []
    for unit, factor in UNITS["speed"].items():
        for sign in ("", "-"):
            kind: Kind = "sign" if sign else "unit"
            fits = off((-factor if sign else factor) * along)
            explained.append((fits, kind, f"state units: {{dvl_beam_velocity: {sign}{unit}}}"))
    azimuths, angle = dvl.beams.azimuth_deg, dvl.beams.angle_deg or 0.0
    remedy = f"state dvl.beams: {{angle_deg: {180.0 - angle:g}, azimuth_deg: "
    remedy += f"{_listed(-azimuth % 360.0 for azimuth in azimuths)}}}, as z points the other way"
    explained.append((off(along, inverse * [1.0, -1.0, -1.0]), "axes", remedy))
    for order in permutations(range(len(azimuths))) if len(azimuths) <= MOST_ORDERED else ():
        text = _listed(azimuths[order.index(k)] for k in range(len(order)))
        explained.append((off(along[:, list(order)]), "axes", f"state dvl.beams.azimuth_deg: {text}, which fits"))
    best, why, remedy = min(explained)  # several fit a dive that is level and straight, the right one best
    if best < AGREES:
        return WrongHead(why, differs, remedy)
    return WrongHead("contradiction", differs, "check dvl.beams and the axes of the velocity (rovgraph check)")


def _listed(values: Iterable[float]) -> str:
    """Numbers as YAML has them."""
    return f"[{', '.join(f'{value:g}' for value in values)}]"


def beam_contexts(config: Config, origin_b: ArrayLike) -> Array:
    """Context of each beam of the configuration, at no altitude, shape (k, BEAM_WIDTH).

    Parameters
    ----------
    origin_b : array_like, shape (3,), the point of the body that the state belongs to [m]
    """
    geometry = beam_geometry(config.dvl)
    if geometry is None:
        return np.zeros((0, at.BEAM_WIDTH))
    context = np.zeros((len(geometry.numbers), at.BEAM_WIDTH))
    context[:, at.BEAM_ARM : at.BEAM_ARM + 3] = np.array(config.dvl.lever_arm_m) - np.asarray(origin_b)
    context[:, at.BEAM : at.BEAM + 3] = geometry.directions
    context[:, at.BEAM_TILT : at.BEAM_TILT + 3] = geometry.tilts
    context[:, at.BEAM_AT] = [LAYOUT[f"{BEAM_SENSORS[k]}_angle"].start for k in geometry.numbers]
    return context


class PingsByBeams:
    """Makes measurements along beams.

    Parameters
    ----------
    config : effective configuration
    instruments : the sensors in use
    """

    def __init__(self, config: Config, instruments: Mapping[str, Instrument]) -> None:
        self.config = config
        geometry = beam_geometry(config.dvl)
        self._numbers = () if geometry is None else geometry.numbers
        usable = {BEAM_SENSORS[k] for k in self._numbers}
        self.instruments = {s: i for s, i in instruments.items() if s in usable}
        self._context = beam_contexts(config, config.imu.lever_arm_m)
        self.velocities = False  # whether the instrument gives velocities
        self.refusals = Refusals()

    def of(self, pings: Stream, accepted: Array) -> list[Stream]:
        """Measurements of each beam: component, its sd, context and no name, shape (k, 3 + BEAM_WIDTH).

        Parameters
        ----------
        pings : the stream "dvl_beams", of n pings
        accepted : ndarray, shape (n,), of `rovgraph.sensors.dvl_beam.taken_by_beams`: where the instrument has
            velocities, a ping without one is refused
        """
        beams = beams_of(pings.data, self._numbers)
        taken, self.refusals = taken_by_beams(beams, accepted, self.config.dvl, self.refusals)
        down = np.where(
            np.isfinite(beams.distance), beams.distance, beams.range * np.abs(self._context[:, at.BEAM + 2])
        )
        seen = np.isfinite(down)
        altitude = np.where(seen, down, 0.0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
        sd = np.fmin(np.fmax(beams.sd, beam_sd(self.config.dvl)), LARGEST_SD)
        if self.config.dvl.scale_sd:
            sd = np.hypot(sd, self.config.dvl.scale_sd * beams.velocity)
        out = []
        for k, number in enumerate(self._numbers):
            some = np.flatnonzero(taken[:, k])
            context = np.repeat(self._context[k : k + 1], len(some), axis=0)
            context[:, at.ALTITUDE] = altitude[some]
            data = np.column_stack([beams.velocity[some, k], sd[some, k], context, np.zeros(len(some))])
            out.append(Stream(BEAM_SENSORS[number], (), pings.time[some], data, pings.row[some]))
        return out

    def of_log(self, streams: Mapping[str, Stream]) -> tuple[list[Stream], NDArray[np.bool_]]:
        """Measurements of a log's beams, as `of` has them, and which of its m pings of velocity they stand for."""
        beams, dvl = streams.get(BEAMS), streams.get("dvl")
        by_beams = np.zeros(0 if dvl is None else len(dvl), bool)
        if beams is None or not self.instruments:
            return [], by_beams
        accepted, near = np.full(len(beams), np.nan), np.zeros(len(beams), np.intp)
        if dvl is not None and len(dvl):
            good = admitted("dvl", dvl.data, self.config, Counter())
            near = nearest(dvl.time, beams.time)
            same = np.abs(dvl.time[near] - beams.time) < ONE_PING_S
            if self.config.dvl.use == "beams" and same.mean() < SAME_STAMPS:  # the same pings, by another clock
                return self.of(beams, accepted), ~by_beams
            accepted = np.where(same & good[near], 1.0, 0.0)
        made = self.of(beams, accepted)
        taken = np.isin(beams.time, np.concatenate([stream.time for stream in made]))
        by_beams[near[taken & (accepted == 1.0)]] = True
        return made, by_beams

    def of_one(self, m: Measurement, accepted: bool) -> list[Measurement]:
        """Measurements of one ping, which the instrument has made a velocity of, or refused to."""
        ping = Stream(BEAMS, (), np.array([m.time]), m.values[None], np.array([m.row]))
        made = self.of(ping, np.array([float(accepted) if self.velocities else np.nan]))
        return [Measurement(m.time, stream.sensor, stream.data[0], m.row) for stream in made if len(stream)]


class SolvedPings(NamedTuple):
    """Velocities of n pings that were taken by their beams, three or more of them.

    Attributes
    ----------
    row : ndarray of int, shape (n,), a measurement of each, in the order of time
    velocity, variance : ndarray, shape (n, 3), in the DVL's axes [m/s, (m/s)^2]
    """

    row: NDArray[np.int64]
    velocity: Array
    variance: Array


def solved_pings(problem: Problem) -> SolvedPings:
    """Velocities by least squares of the pings of a dive that are taken by their beams."""
    of_beam = [k for k, sensor in enumerate(problem.sensors) if sensor in BEAM_SENSORS]
    rows = np.flatnonzero(np.isin(problem.which, of_beam))
    if not len(rows):
        return SolvedPings(rows, np.zeros((0, 3)), np.zeros((0, 3)))
    _, first, ping = np.unique(problem.rows[rows, at.TIME], return_index=True, return_inverse=True)
    d = problem.contexts(rows)[:, at.BEAM : at.BEAM + 3] / problem.sd(rows, 1)
    information, seen = np.zeros((len(first), 3, 3)), np.zeros((len(first), 3))
    np.add.at(information, ping, d[:, :, None] * d[:, None, :])
    np.add.at(seen, ping, d * problem.z(rows, 1) / problem.sd(rows, 1))
    span = np.linalg.eigvalsh(information)
    whole = span[:, 0] > 1e-3 * span[:, 2]
    covariance = np.linalg.inv(information[whole])
    velocity = np.einsum("nij,nj->ni", covariance, seen[whole])
    return SolvedPings(rows[first[whole]], velocity, np.diagonal(covariance, axis1=1, axis2=2))


def nearest(time: Array, to: Array) -> NDArray[np.intp]:
    """Places of the times, ascending, at least one, that lie nearest to others."""
    after = np.searchsorted(time, to).clip(0, len(time) - 1)
    before = (after - 1).clip(0)
    return np.where(to - time[before] <= time[after] - to, before, after)
