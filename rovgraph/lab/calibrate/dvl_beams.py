"""Where the beams of a DVL point, from a dive that has both: velocities along beams, and those of the whole instrument.

    b_k = d_k . v,    d_k = (sin(angle) cos(azimuth_k), sin(angle) sin(azimuth_k), cos(angle))

is solved for the angle, which all beams share, and the azimuths, by robust least squares. The instrument made v of b by
its own matrix, so what beams disagree by is no part of v, and the noise of v brings no bias.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from rovgraph.errors import InputError
from rovgraph.geometry import Array, wrap_angle
from rovgraph.lab.calibrate.piece import Piece, piece_yaml
from rovgraph.log import Log
from rovgraph.model.config import Config, config_or_defaults
from rovgraph.problem.beams import ONE_PING_S, nearest
from rovgraph.sensors.dvl_beam import BEAMS, beams_of

FEWEST = 30  # pings
KNOWN_ANGLE_DEG, KNOWN_AZIMUTH_DEG = 0.5, 2.0  # sds beyond which the dive does not show them
MISFIT = 0.2  # residual, of the velocities along the beams, beyond which they are not of such beams


@dataclass(frozen=True)
class BeamFit:
    """Geometry of k beams.

    Attributes
    ----------
    source : log
    numbers : the instrument's own
    angle_deg, angle_sd_deg : between the beams and the z axis [deg]
    azimuth_deg, azimuth_sd_deg : ndarray, shape (k,), clockwise from the x axis seen from above [deg]
    residual : ndarray, shape (k,), robust sd of what remains along each beam [m/s]
    pings : that were used
    """

    source: str
    numbers: tuple[int, ...]
    angle_deg: float
    angle_sd_deg: float
    azimuth_deg: Array
    azimuth_sd_deg: Array
    residual: Array
    pings: int

    def to_yaml(self) -> str:
        """The geometry as a piece of configuration, under remarks on how well it is known."""
        return piece_yaml(self.piece, self.remarks)

    @property
    def piece(self) -> Piece:
        """The keys of a configuration that hold this geometry."""
        azimuths = [round(float(a), 2) for a in self.azimuth_deg]
        first = {"first_number": 0} if self.numbers[0] == 0 else {}
        return {"dvl": {"beams": {"angle_deg": round(self.angle_deg, 2), "azimuth_deg": azimuths, **first}}}

    @property
    def remarks(self) -> list[str]:
        """How well it is known, a line each."""
        azimuths = ", ".join(f"{sd:.2g}" for sd in self.azimuth_sd_deg)
        residual = ", ".join(f"{1e3 * r:.2g}" for r in self.residual)
        return [
            f"from {self.pings} pings of {self.source}",
            f"sd of the angle {self.angle_sd_deg:.2g} deg, of the azimuths {azimuths} deg",
            f"residual of beams {self.numbers[0]} to {self.numbers[-1]}: {residual} mm/s",
        ]


def calibrate_dvl_beams(log: Log, config: Config | None = None) -> BeamFit:
    """Determine where the beams of a DVL point, from a log with velocities along them and along its axes.

    Raises
    ------
    InputError : no beams or no velocity, or a dive that does not show where they point
    """
    top = config_or_defaults(config).dvl.max_speed_mps
    if BEAMS not in log or "dvl" not in log:
        missing = "velocities along beams (log.dvl_beams.csv)" if "dvl" in log else "DVL"
        raise InputError(f"{log.source}: has no {missing}; take a file with both, in which the vehicle moves")
    beams = beams_of(log[BEAMS].data)
    have = [k for k in range(len(beams.numbers)) if np.isfinite(beams.velocity[:, k]).any()]
    numbers = tuple(beams.numbers[k] for k in have)
    if len(numbers) < 3 or numbers != tuple(range(numbers[0], numbers[0] + len(numbers))) or numbers[0] > 1:
        raise InputError(
            f"{log.source}: velocities along beams {', '.join(map(str, numbers)) or 'none'}; expected three or more "
            "that are numbered from 0 or from 1"
        )
    near = nearest(log["dvl"].time, log[BEAMS].time)
    dvl = log["dvl"].data[near]
    same = (np.abs(log["dvl"].time[near] - log[BEAMS].time) < ONE_PING_S) & (dvl[:, 3] == 1.0)
    same &= (np.abs(dvl[:, :3]) <= top).all(axis=1)
    v, b = dvl[same, :3], np.where(beams.valid, beams.velocity, np.nan)[same][:, have]
    seen = np.isfinite(b)
    if (count := int(seen.sum(axis=0).min())) < FEWEST:
        raise InputError(f"{log.source}: {count} pings have both beams and a velocity, expected {FEWEST} or more")
    return _fit(log.source, numbers, v, b)


def _fit(source: str, numbers: tuple[int, ...], v: Array, b: Array) -> BeamFit:
    seen = np.isfinite(b)
    ping, beam = np.nonzero(seen)
    z, v_of = b[seen], v[ping]
    rough = np.array([np.linalg.lstsq(v[seen[:, k]], b[seen[:, k], k])[0] for k in range(len(numbers))])
    speed = float(np.median(np.abs(v).max(axis=1)))
    across = np.clip(np.hypot(rough[:, 0], rough[:, 1]), 0.05, 0.95)
    start = np.append(np.arcsin(np.median(across)), np.arctan2(rough[:, 1], rough[:, 0]))

    def misfit(p: Array) -> Array:
        around = v_of[:, 0] * np.cos(p[1:][beam]) + v_of[:, 1] * np.sin(p[1:][beam])
        return np.asarray(np.sin(p[0]) * around + np.cos(p[0]) * v_of[:, 2] - z)

    bend = max(3.0 * 1.4826 * float(np.median(np.abs(misfit(start)))), 1e-4)
    fit = least_squares(misfit, start, loss="soft_l1", f_scale=bend)  # type: ignore[operator]
    rest = misfit(fit.x)
    residual = np.array([1.4826 * np.median(np.abs(rest[beam == k])) for k in range(len(numbers))])
    J = least_squares(misfit, fit.x, max_nfev=1).jac  # type: ignore[operator]  # the robust loss bends fit.jac
    information = J.T @ J
    if np.linalg.cond(information) > 1e10:
        raise InputError(f"{source}: does not show where the beams point; drive forward, sideways, up and down")
    noise = float(np.sqrt(np.mean(residual**2)))
    sd = np.rad2deg(max(noise, 1e-4) * np.sqrt(np.diag(np.linalg.inv(information))))
    if noise > MISFIT * float(np.median(np.abs(z))):
        turned = np.abs(rough[:, 2]).min() > 0.5 and (rough[:, 2] < 0.0).all()
        why = "their sign is reversed (units: {dvl_beam_velocity: -m/s})" if turned else "their unit, sign or clock"
        raise InputError(
            f"{source}: velocities along the beams are {noise:.2g} m/s off any beams' at {speed:.2g} m/s; correct {why}"
        )
    if sd[0] > KNOWN_ANGLE_DEG or sd[1:].max() > KNOWN_AZIMUTH_DEG:
        raise InputError(
            f"{source}: shows the beams' angle to {sd[0]:.1g} and their azimuths to {sd[1:].max():.1g} deg, needed are "
            f"{KNOWN_ANGLE_DEG:g} and {KNOWN_AZIMUTH_DEG:g}; drive forward and sideways, and for longer"
        )
    angle = float(np.rad2deg(fit.x[0]))
    azimuth = np.rad2deg(wrap_angle(fit.x[1:])) % 360.0
    return BeamFit(source, numbers, angle, float(sd[0]), azimuth, sd[1:], residual, int(seen.any(axis=1).sum()))
