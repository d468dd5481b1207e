"""The bottom under a track: soundings by the DVL's ranges, and by them its depth, its slope and the altitude over it.

A range meets the bottom at ``p_n + s a``, s what a metre changes n by, with the arm from the body's origin

    a = R_nb (l_b + R_bs d rho)

d is the unit vector of the beam and rho the range along it, less the scale error of the DVL where that is one of sound
speed. ``distance`` and ``dvl_altitude`` are along the DVL's own z axis, as makers state them: rho = distance / |d_z|.

The bottom about the vehicle is a plane, ``a_down = h + g (a_north, a_east)``, with the altitude h straight down from
the body's origin and the slope g. It is fitted to the ranges of each ping, with a prior of the slope, so that one range
gives an altitude, two a slope along their line, and the sd says what remains unknown. What the errors of attitude,
mounting and scale do to all ranges of a ping together is part of it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from rovgraph.geometry import Array, cross, matrix_from_rpy, rotate, skew, transpose
from rovgraph.inference.estimate import Estimate
from rovgraph.inference.trajectory import Trajectory
from rovgraph.log import Log, Stream
from rovgraph.model.calibration import BEAM_SENSORS, MOUNT
from rovgraph.model.config import Config, mount_matrix
from rovgraph.model.origin import scale_at
from rovgraph.problem.beams import nearest
from rovgraph.sensors.dvl import TIME_OFFSET
from rovgraph.sensors.dvl_beam import BEAMS, beam_geometry, beams_of

RANGE_SD = 0.01, 0.02  # of a range: a part of it, and what is added [m]; where a dive does not show its own
SLOPE_SD = 0.3  # of the bottom before it is measured, along any direction: 17 degrees
NEAREST_S = 1.0  # longest time between a moment and the ping that shows the bottom under it
SPIKE, SPIKE_M = 0.1, 0.3  # of the range, or that far, from the beam's median: fish, weeds, side lobes
SPIKE_PINGS = 5  # of the median
ENOUGH = 20  # pings with a range to spare, which show the noise of ranges
MEDIAN_CHI2 = 0.455  # of one degree of freedom
LEAST_NOISE = 0.1  # of what is stated, which a dive may show
WHOLE_HEAD = -1  # "beam" of a DVL's one altitude

COLUMNS = ("altitude", "bottom_depth", "slope_north", "slope_east")


@dataclass(frozen=True, repr=False)
class Bottom:
    """The bottom as n pings of k ranges show it.

    Attributes
    ----------
    time : ndarray, shape (n,) [s]
    numbers : of the beams, -1 = the DVL's one altitude
    arm_n : ndarray, shape (n, k, 3), from the body's origin to the bottom, NaN where a ping has no such range [m]
    used : ndarray of bool, shape (n, k), False where there is none, and of spikes
    place, metre : ndarrays, shape (n, 3), of the body's origin, and what a metre changes n by there [m]
    cov_arm : ndarray, shape (n, k, 3, 3), of a sounding by itself, that of the body's origin included [m^2]
    plane : ndarray, shape (n, 3), altitude of the body's origin [m], slope towards north and east: how much deeper the
        bottom becomes in a metre
    cov_plane : ndarray, shape (n, 3, 3)
    noise : sd of the ranges as the dive shows it, over `RANGE_SD`; 1 where it shows none
    """

    time: Array
    numbers: tuple[int, ...]
    arm_n: Array
    used: NDArray[np.bool_]
    place: Array
    metre: Array
    cov_arm: Array
    plane: Array
    cov_plane: Array
    noise: float = 1.0

    def __repr__(self) -> str:
        return f"<Bottom of {len(self.time)} pings, {int(np.isfinite(self.arm_n[..., 2]).sum())} soundings>"

    @cached_property
    def soundings(self) -> pd.DataFrame:
        """A row for each range, by time and beam: time [s], north, east, depth, their sds [m], used (1, or 0 of a
        spike) and beam, -1 = the DVL's one altitude."""
        ping, k = np.nonzero(np.isfinite(self.arm_n[..., 2]))
        position = self.place[ping] + self.metre[ping] * self.arm_n[ping, k]
        sd = np.sqrt(np.diagonal(self.cov_arm[ping, k], axis1=1, axis2=2))
        names = ("north", "east", "depth")
        columns = {
            "time": self.time[ping],
            "beam": np.array(self.numbers)[k],
            **dict(zip(names, position.T, strict=True)),
            **dict(zip((f"{name}_sd" for name in names), sd.T, strict=True)),
            "used": self.used[ping, k].astype(int),
        }
        return pd.DataFrame(columns)

    def under(self, track: Trajectory) -> dict[str, Array]:
        """Altitude and depth of the bottom under each epoch of a track, and its slope, by the nearest ping.

        Returns
        -------
        dict : `COLUMNS`, each with its ``_sd``, ndarray, shape (len(track),), NaN where no ping is within a second;
            no slope where the ping has one range
        """
        near = nearest(self.time, track.time)
        known = np.abs(self.time[near] - track.time) <= NEAREST_S
        moved = track.p_n - self.place[near]
        h = np.column_stack([np.ones(len(track)), moved[:, :2]])
        plane, cov = self.plane[near], self.cov_plane[near]
        altitude = np.einsum("ni,ni->n", h, plane) - moved[:, 2]
        variance = np.einsum("ni,nij,nj->n", h, cov, h)
        sloped = self.used[near].sum(axis=1) > 1
        slope = np.where(sloped[:, None], plane[:, 1:], np.nan)
        values = [altitude, track.p_n[:, 2] + altitude, *slope.T]
        variances = [variance, variance + track.cov_p[:, 2, 2], cov[:, 1, 1], cov[:, 2, 2]]
        found = dict(zip(COLUMNS, values, strict=True))
        found |= {
            f"{name}_sd": np.where(np.isnan(found[name]), np.nan, np.sqrt(v))
            for name, v in zip(COLUMNS, variances, strict=True)
        }
        return {name: np.where(known, values, np.nan) for name, values in found.items()}


class _Ranges:
    """Ranges of a log in the vehicle's axes, by a configuration and what a dive has revealed of it."""

    def __init__(self, config: Config, calibration: Mapping[str, tuple[float, float]]) -> None:
        self._config, self._known = config, calibration

    def value(self, label: str, otherwise: float = 0.0) -> float:
        """Of a component of the calibration."""
        return self._known.get(label, (otherwise, 0.0))[0]

    def sd(self, label: str) -> float:
        return self._known.get(label, (0.0, 0.0))[1]

    @property
    def R_bs(self) -> Array:
        if not all(name in self._known for name in MOUNT):
            return mount_matrix(self._config.dvl.mount_rpy_deg)
        return matrix_from_rpy(np.array([self.value(name) for name in MOUNT]))

    @property
    def arm_b(self) -> Array:
        """Of the DVL, from the body's origin [m]."""
        moved = [self.value(f"dvl_lever_arm{axis}") for axis in ("_x", "_y", "_z")]
        return np.array(self._config.dvl.lever_arm_m) + moved

    def metre(self, p_n: Array) -> Array:
        """What a metre changes n by at some places, shape (n, 3)."""
        return scale_at(self._config.environment.earth_latitude, p_n)

    @property
    def scale(self) -> float:
        """Of ranges: that of a piston's velocities is one of sound speed."""
        return 1.0 if self._config.dvl.beams.phased else 1.0 + self.value("dvl_scale")

    def of(self, streams: Mapping[str, Stream]) -> tuple[tuple[int, ...], Array, Array, Array] | None:
        """Numbers, times (n,), unit vectors (k, 3) in the DVL's axes and ranges along them (n, k); None without any."""
        geometry = beam_geometry(self._config.dvl)
        if geometry is not None and BEAMS in streams:
            beams = beams_of(streams[BEAMS].data, geometry.numbers)
            angle = np.array([[self.value(f"{BEAM_SENSORS[k]}_angle")] for k in geometry.numbers])
            d = geometry.directions + angle * geometry.tilts
            rho = np.where(np.isfinite(beams.range), beams.range, beams.distance / np.abs(d[:, 2]))
            if np.isfinite(rho).any():
                return geometry.numbers, streams[BEAMS].time, d, rho
        if "dvl_altitude" not in streams:
            return None
        far = streams["dvl_altitude"].data[:, 0]
        rho = np.where(far > 0.0, far, np.nan)[:, None]
        axis = [0.0, 0.0, np.copysign(1.0, self.R_bs[2, 2])]  # of a DVL whose z axis is up it is down, too
        return ((WHOLE_HEAD,), streams["dvl_altitude"].time, np.array([axis]), rho)


def bottom_of(log: Log, config: Config, estimate: Estimate) -> Bottom | None:
    """The bottom under an estimate of a dive, by the ranges of the DVL's beams, or by its one altitude without those.

    Parameters
    ----------
    log, config : of the dive
    estimate : its track, and the calibration that places the DVL

    Returns
    -------
    Bottom, of the pings within the track; None where the log has no range
    """
    calibration = {entry.label: (entry.value, entry.sd) for entry in estimate.calibration}
    offset = calibration.get(TIME_OFFSET, (0.0, 0.0))[0]
    return bottom_under(estimate.trajectory, log.streams, config, calibration, offset)


def bottom_under(
    track: Trajectory,
    streams: Mapping[str, Stream],
    config: Config,
    calibration: Mapping[str, tuple[float, float]],
    late: float = 0.0,
) -> Bottom | None:
    """As `bottom_of`, of measurements and a track that need not be a whole dive's.

    Parameters
    ----------
    streams : "dvl_beams" or "dvl_altitude"
    calibration : label of a component -> value and sd
    late : how late the DVL's stamps are [s]
    """
    ranges = _Ranges(config, calibration)
    found = ranges.of(streams)
    if found is None:
        return None
    numbers, time, d, rho = found
    time = time - late
    some = np.isfinite(rho).any(axis=1) & (time >= track.time[0]) & (time <= track.time[-1])
    if not some.any():
        return None
    time, rho = time[some], rho[some] / ranges.scale
    here = track if np.array_equal(time, track.time) else track.clamped(time)  # of one ping, live
    bottom = _fitted(numbers, time, rotate(ranges.R_bs, d), rho, here, ranges)
    return bottom if bottom.used.any() else None


def _fitted(numbers: tuple[int, ...], time: Array, u_b: Array, rho: Array, here: Trajectory, ranges: _Ranges) -> Bottom:
    """Soundings and planes of pings, where the track is ``here``."""
    u_n = rotate(here.R_nb[:, None], u_b[None])
    rho = np.where(u_n[..., 2] > 0.0, rho, np.nan)  # what looks up sees the surface
    along = u_n * rho[..., None]
    arm = rotate(here.R_nb, ranges.arm_b)[:, None] + along
    mount = np.diag([ranges.sd(name) ** 2 for name in MOUNT])
    cov_theta = here.cov_theta + here.R_nb @ mount @ transpose(here.R_nb)
    used = np.isfinite(rho) & ~_spikes(here.p_n[:, None, 2] + arm[..., 2], rho)
    sd = RANGE_SD[0] * rho + RANGE_SD[1]
    plane, G, inverse, chi2 = _planes(arm, sd, used)
    spare = used.sum(axis=1) > 3
    noise = 1.0
    if spare.sum() >= ENOUGH:
        noise = float(np.sqrt(np.median(chi2[spare] / (used[spare].sum(axis=1) - 3)) / MEDIAN_CHI2))
        noise = max(noise, LEAST_NOISE)
        plane, G, inverse, _ = _planes(arm, noise * sd, used)
    normal = np.column_stack([-plane[:, 1:], np.ones(len(plane))])[:, None]
    J_theta = G @ np.where(used[..., None], cross(arm, np.broadcast_to(normal, arm.shape)), 0.0)
    J_scale = G @ np.where(used, (along * normal).sum(axis=-1), 0.0)[..., None]
    scale_sd = ranges.sd("dvl_scale")
    cov_plane = inverse + J_theta @ cov_theta @ transpose(J_theta) + scale_sd**2 * J_scale @ transpose(J_scale)
    own = (noise * sd) ** 2 + (scale_sd * rho) ** 2
    S = skew(arm)
    cov_arm = here.cov_p[:, None] + S @ cov_theta[:, None] @ transpose(S)
    cov_arm = cov_arm + own[..., None, None] * u_n[..., :, None] * u_n[..., None, :]
    return Bottom(time, numbers, arm, used, here.p_n, ranges.metre(here.p_n), cov_arm, plane, cov_plane, noise)


def _planes(arm: Array, sd: Array, used: NDArray[np.bool_]) -> tuple[Array, Array, Array, Array]:
    """A plane for each ping.

    Returns
    -------
    plane : ndarray, shape (n, 3), altitude and slopes
    G : ndarray, shape (n, 3, k), its derivative by how far down each range reaches
    inverse : ndarray, shape (n, 3, 3), its covariance by the noise of the ranges and the prior of the slope
    chi2 : ndarray, shape (n,), of what the ranges disagree by
    """
    H = np.where(used[..., None], np.concatenate([np.ones((*used.shape, 1)), arm[..., :2]], axis=-1), 0.0)
    z = np.where(used, arm[..., 2], 0.0)
    weight = np.where(used, 1.0 / sd**2, 0.0)
    flat = np.diag([0.0, SLOPE_SD**-2, SLOPE_SD**-2])
    known = used.any(axis=1)
    N = transpose(H) @ (weight[..., None] * H) + flat
    N[~known] = np.eye(3)
    inverse = np.linalg.inv(N)
    G = inverse @ transpose(H * weight[..., None])
    plane = rotate(G, z)
    chi2 = (weight * (z - rotate(H, plane)) ** 2).sum(axis=1)
    plane[~known], inverse[~known] = np.nan, np.nan
    return plane, G, inverse, chi2


def _spikes(depth: Array, rho: Array) -> NDArray[np.bool_]:
    """Which soundings stand alone: far from the median of their beam's neighbours, shape (n, k)."""
    spikes = np.zeros(depth.shape, bool)
    for k in range(depth.shape[1]):
        own = np.flatnonzero(np.isfinite(depth[:, k]))
        if len(own) < SPIKE_PINGS:
            continue
        ends = SPIKE_PINGS // 2
        median = np.median(sliding_window_view(np.pad(depth[own, k], ends, mode="reflect"), SPIKE_PINGS), axis=1)
        spikes[own, k] = np.abs(depth[own, k] - median) > np.maximum(SPIKE * rho[own, k], SPIKE_M)
    return spikes
