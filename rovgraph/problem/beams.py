"""From pings to measurements along single beams.

`PingsByBeams` decides which pings are taken by their beams, and gives each beam what its equation needs
(`rovgraph.kernels.measurement_row`). Beams and velocity of one ping are never both used.
"""

from collections import Counter
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels import measurement_row as at
from rovgraph.log import Measurement, Stream
from rovgraph.model.calibration import BEAM_SENSORS, LAYOUT
from rovgraph.model.config import Config
from rovgraph.problem.admission import admitted
from rovgraph.sensors import DvlBeam
from rovgraph.sensors.dvl_beam import BEAMS, beam_geometry, beam_sd, beams_of, taken_by_beams
from rovgraph.sensors.instruments import Instrument
from rovgraph.sensors.sensor import LARGEST_SD

ONE_PING_S = 0.01  # stamps of beams and velocity of one ping differ by less
BY_BEAMS = "taken by its beams"


def beam_sensors(config: Config) -> list[str]:
    """The beams that pings can be taken by, as sensors; none where their geometry is not known, or velocities are used."""
    geometry = beam_geometry(config.dvl)
    return [] if geometry is None or config.dvl.use == "velocity" else [BEAM_SENSORS[k] for k in geometry.numbers]


class PingsByBeams:
    """Makes measurements along beams.

    Parameters
    ----------
    config : effective configuration
    instruments : the sensors in use
    """

    def __init__(self, config: Config, instruments: Mapping[str, Instrument]) -> None:
        self.config = config
        self.instruments = {s: i for s, i in instruments.items() if isinstance(i.model, DvlBeam)}
        geometry = beam_geometry(config.dvl) if self.instruments else None
        self._numbers = () if geometry is None else geometry.numbers
        self._context = np.zeros((len(self._numbers), at.BEAM_WIDTH))
        if geometry is not None:
            origin_b = np.array(config.imu.lever_arm_m)
            self._context[:, at.BEAM_ARM : at.BEAM_ARM + 3] = np.array(config.dvl.lever_arm_m) - origin_b
            self._context[:, at.BEAM : at.BEAM + 3] = geometry.directions
            self._context[:, at.BEAM_TILT : at.BEAM_TILT + 3] = geometry.tilts
            self._context[:, at.BEAM_AT] = [LAYOUT[f"{BEAM_SENSORS[k]}_angle"].start for k in self._numbers]
        self.velocities = False  # whether the instrument gives velocities
        self.three = False  # whether it has made one of three beams

    def of(self, pings: Stream, accepted: Array) -> list[Stream]:
        """Measurements of each beam: component, its sd, context and no name, shape (k, 3 + BEAM_WIDTH).

        Parameters
        ----------
        pings : the stream "dvl_beams", of n pings
        accepted : ndarray, shape (n,), of `rovgraph.sensors.dvl_beam.taken_by_beams`: where the instrument has
            velocities, a ping without one is refused
        """
        beams = beams_of(pings.data, self._numbers)
        self.three |= bool(((beams.valid.sum(axis=1) == 3) & (accepted == 1.0)).any())
        taken = taken_by_beams(beams, accepted, self.config.dvl, self.three)
        down = np.where(np.isfinite(beams.distance), beams.distance, beams.range * self._context[:, at.BEAM + 2])
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


def nearest(time: Array, to: Array) -> NDArray[np.intp]:
    """Places of the times, ascending, at least one, that lie nearest to others."""
    after = np.searchsorted(time, to).clip(0, len(time) - 1)
    before = (after - 1).clip(0)
    return np.where(to - time[before] <= time[after] - to, before, after)
