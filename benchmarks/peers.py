"""Beside what people would write: dead reckoning, plain GTSAM as a batch and by iSAM2, and pyins, on the same dives.

    python benchmarks/peers.py                                  falcon, lawnmower, three grades, Ictineu
    python benchmarks/peers.py lawnmower --seeds 5 8            one of them, with its first and last seed
    python benchmarks/peers.py FOG --methods rovgraph pyins     some methods
    python benchmarks/peers.py ictineu --ictineu FOLDER         a folder with log.csv.gz, reference.csv.gz, ictineu.yaml

pyins is `pip install python-ins` (or 'rovgraph[benchmarks]'), and left out where it is absent. All get the same
measurements (`Measured`), prepared as a person would, and the noise that the configuration states. Each method runs in
a process of its own, so that its memory can be told. Nothing is asserted: it prints a table. Figures are in
docs/peers.md.
"""

import argparse
import ast
import inspect
import multiprocessing
import re
import resource
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pandas as pd
from fault_campaign.campaign import make_dive
from fault_campaign.cases import CASES
from fault_campaign.instruments import log_table
from scipy.ndimage import median_filter

from rovgraph.dive import smooth
from rovgraph.geometry import Array, earth_rate_n, matrix_from_rpy, skew, wrap_angle
from rovgraph.inference.trajectory import Trajectory
from rovgraph.lab.evaluate import evaluate, read_reference
from rovgraph.log import Log, read_log
from rovgraph.model.config import Config, beliefs, load_config, mount_matrix
from rovgraph.simulate import Choices
from rovgraph.simulate.named import simulated

ROOT = Path(__file__).parents[1]
GRADES = {"MTi": "survey", "tactical": "tactical", "FOG": "FOG"}  # cases of the fault campaign
SETTLED_S = 10.0
LEVEL_S = 2.0  # over which the accelerometer tells roll and pitch
MEDIAN_OF, FAR_SD, FAR_MPS = 5, 5.0, 0.1  # pings further than this from the median of some are left out
HUBER = 1.345
LEG_S = 30.0  # for which a compass errs in the same way
INTEGRATION = 1e-6  # covariance that GTSAM's preintegration needs
STEPS, ENOUGH = 15, 1e-4  # Gauss-Newton steps at most, and the largest change of the last [rad, m, m/s]
RELINEARISE, RELINEARISE_EVERY = 0.1, 10  # GTSAM's own: threshold [rad, m, m/s], and updates between two looks
COVARIANCE_S = 1.0  # between keyframes whose covariance is taken
FIRST_SD_MPS = 1.0  # of the velocity at the first ping


@dataclass(frozen=True)
class Task:
    """A dive, its configuration, and the truth.

    Attributes
    ----------
    name : of its row in the table
    log, config, truth : as `rovgraph.smooth` and `rovgraph.evaluate` take them
    turning_earth : whether the log's gyro measures the Earth's rate
    after : errors count from this time on [s]
    """

    name: str
    log: Log
    config: Config
    truth: Trajectory
    turning_earth: bool = False
    after: float = SETTLED_S


@dataclass(frozen=True)
class Measured:
    """A log as all peers take it, in body axes, arms relative to the IMU.

    - Tilt is the accelerometer's over 2 s, or the AHRS's roll and pitch where the log has them.
    - A magnetometer is levelled by that tilt. Each compass is turned to the body's heading, with the declination.
    - Pings above `dvl.max_speed_mps`, without bottom lock, or far from the median of five are left out.
    - Headings and depths are interpolated to the pings, one of each a ping.
    - A compass errs in the same way for as long as a leg lasts: the headings of 30 s together weigh as much as one
      with the noise and the sds of offset, deviation and hard iron that are stated. With the noise alone, the plain
      graph's rms is 17 and 33 m instead of 5.1 and 1.1 m (lawnmower, an hour, seeds 5 and 6).

    Attributes
    ----------
    config : mountings, noise, start
    log : the streams
    """

    config: Config
    log: Log

    @cached_property
    def imu(self) -> tuple[Array, Array, Array]:
        """Time, specific force and rate, shape (n,), (n, 3), (n, 3)."""
        stream, R_bs = self.log["imu"], mount_matrix(self.config.imu.mount_rpy_deg)
        return stream.time, stream.data[:, :3] @ R_bs.T, stream.data[:, 3:6] @ R_bs.T

    @cached_property
    def pings(self) -> tuple[Array, Array, Array]:
        """Time, velocity and square root of the information of a ping, shape (n,), (n, 3), (3, 3)."""
        stream, dvl = self.log["dvl"], self.config.dvl
        R_bs, sd = mount_matrix(dvl.mount_rpy_deg), np.asarray(dvl.velocity_sd_mps)
        values = stream.data[:, :3]
        good = (stream["dvl_valid"] != 0.0) & (np.abs(values).max(axis=1) <= dvl.max_speed_mps)
        middle = median_filter(values[good], (MEDIAN_OF, 1), mode="nearest")
        good[good] = (np.abs(values[good] - middle) < FAR_SD * sd + FAR_MPS).all(axis=1)
        return stream.time[good], values[good] @ R_bs.T, np.diag(1.0 / sd) @ R_bs.T

    @cached_property
    def tilt(self) -> tuple[Array, Array]:
        """Roll and pitch at the pings, shape (n,) each [rad]."""
        at = self.pings[0]
        if "ahrs" in self.log and np.isfinite(self.log["ahrs"].data[:, :2]).all():
            ahrs = self.log["ahrs"]
            return np.interp(at, ahrs.time, ahrs["ahrs_roll"]), np.interp(at, ahrs.time, ahrs["ahrs_pitch"])
        t, force, _ = self.imu
        width = max(int(LEVEL_S / np.median(np.diff(t))), 1)
        x, y, z = (np.interp(at, t, np.convolve(f, np.full(width, 1.0 / width), "same")) for f in force.T)
        return np.arctan2(-y, -z), np.arctan2(x, np.hypot(y, z))

    @cached_property
    def headings(self) -> list[tuple[Array, float]]:
        """Of each compass true headings of the body at the pings, shape (n,), and the sd of one [rad]."""
        config = self.config
        R_imu, R_dvl = mount_matrix(config.imu.mount_rpy_deg), mount_matrix(config.dvl.mount_rpy_deg)
        own: dict[str, tuple[str, str, Callable[[], Array]]] = {
            "mag": ("mag", "mag", self._of_field),
            "ahrs": ("ahrs", "ahrs", lambda: self._turned("ahrs", "ahrs_yaw", R_imu)),
            "dvl": ("dvl_heading", "dvl_compass", lambda: self._turned("dvl_heading", "dvl_heading", R_dvl)),
        }
        names = config.heading.sources or ("dvl", next((name for name in ("mag", "ahrs") if name in self.log), "dvl"))
        declination = np.deg2rad(config.environment.declination_deg)
        return [
            (heading() + declination, self._heading_sd(name, variables))
            for name, (stream, variables, heading) in own.items()
            if name in names and stream in self.log
        ]

    def _heading_sd(self, name: str, variables: str) -> float:
        """Of a heading at a ping: its noise and what is stated of offset and deviation, for a leg's pings together."""
        believed = beliefs(self.config)
        parts = [believed[f"{variables}_{error}"] for error in ("offset", "deviation")]
        sds = [np.deg2rad(getattr(self.config.heading, f"{name}_sd_deg"))]
        sds += [part.sd for part in parts if part.estimate or part.considered]
        if name == "mag":
            field = self.log["mag"].data[:, :3]
            sds.append(believed["hard_iron"].sd * np.linalg.norm(field, axis=1).mean() / self._horizontal)
        return float(np.linalg.norm(sds) * np.sqrt(LEG_S / np.median(np.diff(self.pings[0]))))

    @cached_property
    def _horizontal(self) -> float:
        """Magnitude of the horizontal field, in the log's unit."""
        return float(np.linalg.norm(self._levelled[:, :2], axis=1).mean())

    def _turned(self, sensor: str, column: str, R_bs: Array) -> Array:
        """The body's heading by a compass that measures the heading of its own x axis."""
        stream = self.log[sensor]
        own = np.interp(self.pings[0], stream.time, np.unwrap(stream[column]))
        return own - np.arctan2(R_bs[1, 0], R_bs[0, 0])

    def _of_field(self) -> Array:
        """The body's heading by the magnetometer."""
        return np.unwrap(np.arctan2(-self._levelled[:, 1], self._levelled[:, 0]))

    @cached_property
    def _levelled(self) -> Array:
        """Magnetic field, turned by roll and pitch, shape (n, 3)."""
        stream, (roll, pitch) = self.log["mag"], self.tilt
        field_b = stream.data[:, :3] @ mount_matrix(self.config.imu.mount_rpy_deg).T
        at_pings = np.column_stack([np.interp(self.pings[0], stream.time, f) for f in field_b.T])
        return np.einsum("nij,nj->ni", matrix_from_rpy(np.column_stack([roll, pitch, 0.0 * roll])), at_pings)

    @cached_property
    def heading(self) -> Array:
        """Mean of the compasses, weighted by their noise, shape (n,)."""
        first = self.headings[0][0]
        weights = [1.0 / sd**2 for _, sd in self.headings]
        off = [w * wrap_angle(heading - first) for (heading, _), w in zip(self.headings, weights, strict=True)]
        return np.asarray(first + sum(off) / sum(weights))

    @cached_property
    def rate(self) -> Array:
        """Rate at the pings, over 0.1 s, shape (n, 3)."""
        t, _, rate = self.imu
        width = max(int(0.1 / np.median(np.diff(t))), 1)
        return np.column_stack(
            [np.interp(self.pings[0], t, np.convolve(w, np.full(width, 1.0 / width), "same")) for w in rate.T]
        )

    @cached_property
    def depth(self) -> Array | None:
        """At the pings, shape (n,)."""
        if "depth" not in self.log:
            return None
        return np.interp(self.pings[0], self.log["depth"].time, self.log["depth"].data[:, 0])

    @cached_property
    def fixes(self) -> tuple[Array, Array, Array]:
        """Nearest ping, time since it, north and east, shape (n,), (n,), (n, 2)."""
        if "fix" not in self.log:
            return np.empty(0, int), np.empty(0), np.empty((0, 2))
        stream, at = self.log["fix"], self.pings[0]
        nearest = np.abs(stream.time[:, None] - at[None, :]).argmin(axis=1)
        return nearest, stream.time - at[nearest], stream.data[:, :2]

    def arm(self, sensor: str) -> Array:
        """From the IMU to a sensor, shape (3,) [m]."""
        section = getattr(self.config, sensor)
        return np.asarray(section.lever_arm_m) - np.asarray(self.config.imu.lever_arm_m)

    @cached_property
    def start(self) -> Array:
        """Of the IMU, shape (3,) [m]."""
        start, R = self.config.start, self.attitude[0]
        fix = self.fixes[2][0] if len(self.fixes[2]) else np.zeros(2)
        north, east = (given if given is not None else seen for given, seen in zip((start.north_m, start.east_m), fix))  # noqa: B905
        down = start.down_m if start.down_m is not None else 0.0 if self.depth is None else self.depth[0]
        return np.array([north, east, down]) + R @ np.asarray(self.config.imu.lever_arm_m)

    @cached_property
    def attitude(self) -> Array:
        """By tilt and compasses, shape (n, 3, 3)."""
        return np.asarray(matrix_from_rpy(np.column_stack([*self.tilt, self.heading])))

    def of_body(self, time: Array, p_n: Array, R_nb: Array, v_n: Array, cov: Array, cov_theta: Array) -> Trajectory:
        """The trajectory of the body's origin by that of the IMU."""
        p_n = p_n - R_nb @ np.asarray(self.config.imu.lever_arm_m)
        return Trajectory(time, p_n, R_nb, v_n, cov, cov_theta, np.full_like(cov, np.nan))


# ------------------------------------------------------------------ dead reckoning


def dead_reckoning(given: Measured) -> Trajectory:
    """Pings turned by the compasses, and summed."""
    t, velocity_b, _ = given.pings
    R = given.attitude
    v_n = np.einsum("nij,nj->ni", R, velocity_b - np.cross(given.rate, given.arm("dvl")))
    steps = 0.5 * (v_n[1:] + v_n[:-1]) * np.diff(t)[:, None]
    p_n = given.start + np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    unknown = np.full((len(t), 3, 3), np.nan)
    return given.of_body(t, p_n, R, v_n, unknown, unknown)


# ------------------------------------------------------------------ GTSAM


class Graph:
    """A pose, a velocity and a bias at each ping, combined IMU factors between them; one misalignment, or none.

    Measurements are linearised all at once; `CustomFactor` would call back for each of them.
    """

    def __init__(self, given: Measured, misaligned: bool) -> None:
        self.given, self.misaligned = given, misaligned
        self.count = len(given.pings[0])
        self.native = gtsam.NonlinearFactorGraph()
        self.values = gtsam.Values()
        self._begin()
        for k in range(1, self.count):
            self.native.add(gtsam.CombinedImuFactor(X(k - 1), V(k - 1), X(k), V(k), B(k - 1), B(k), self._moved(k)))

    def _begin(self) -> None:
        """Priors, and dead reckoning as the first values."""
        given, config, sigmas = self.given, self.given.config, gtsam.noiseModel.Diagonal.Sigmas
        track = dead_reckoning(given)
        p_n = track.p_n + track.R_nb @ np.asarray(config.imu.lever_arm_m)
        if given.depth is not None:
            p_n[:, 2] = given.depth
        for k in range(self.count):
            self.values.insert(X(k), gtsam.Pose3(gtsam.Rot3(track.R_nb[k]), p_n[k]))
            self.values.insert(V(k), track.v_n[k])
            self.values.insert(B(k), gtsam.imuBias.ConstantBias())
        start, imu = config.start, config.imu
        tilt, heading = np.deg2rad(start.tilt_sd_deg), np.deg2rad(start.heading_sd_deg)
        down = start.position_sd_m if start.down_sd_m is None else start.down_sd_m
        attitude_sd, place_sd = [tilt, tilt, heading], [start.position_sd_m, start.position_sd_m, down]
        bias_sd = np.repeat([imu.acc_bias_sd_mps2, np.deg2rad(imu.gyr_bias_sd_dps)], 3)
        self.native.add(gtsam.PoseRotationPrior3D(X(0), gtsam.Rot3(track.R_nb[0]), sigmas(attitude_sd)))
        self.native.add(gtsam.PoseTranslationPrior3D(X(0), given.start, sigmas(place_sd)))
        self.native.add(gtsam.PriorFactorVector(V(0), track.v_n[0], sigmas(np.full(3, FIRST_SD_MPS))))
        self.native.add(gtsam.PriorFactorConstantBias(B(0), gtsam.imuBias.ConstantBias(), sigmas(bias_sd)))
        if self.misaligned:
            sd = np.deg2rad(config.calibration.dvl_yaw.sd_deg)
            self.values.insert(M, np.zeros(1))
            self.native.add(gtsam.PriorFactorVector(M, np.zeros(1), sigmas([sd])))

    @cached_property
    def _params(self) -> Any:
        environment, noise = self.given.config.environment, self.given.config.imu.noise
        params = gtsam.PreintegrationCombinedParams.MakeSharedD(environment.gravity_mps2)
        params.setAccelerometerCovariance(noise.acc**2 * np.eye(3))
        params.setGyroscopeCovariance(noise.gyr**2 * np.eye(3))
        params.setIntegrationCovariance(INTEGRATION * np.eye(3))
        params.setBiasAccCovariance(noise.acc_walk**2 * np.eye(3))
        params.setBiasOmegaCovariance(noise.gyr_walk**2 * np.eye(3))
        if environment.earth_rotation:
            params.setOmegaCoriolis(earth_rate_n(np.deg2rad(environment.latitude_deg)))
        return params

    @cached_property
    def _edges(self) -> Array:
        """Between which each sample of the IMU holds."""
        t = self.given.imu[0]
        return np.concatenate([[-np.inf], 0.5 * (t[1:] + t[:-1]), [np.inf]])

    def _moved(self, k: int) -> Any:
        """The IMU's motion to a ping from the one before."""
        _, force, rate = self.given.imu
        begin, end = self.given.pings[0][k - 1 : k + 1]
        first, last = np.searchsorted(self._edges, [begin, end], "right") - 1
        moved = gtsam.PreintegratedCombinedMeasurements(self._params, gtsam.imuBias.ConstantBias())
        bounds = np.concatenate([[begin], self._edges[first + 1 : last + 1], [end]])
        for j, dt in zip(range(first, last + 1), np.diff(bounds).tolist(), strict=True):
            if dt > 0.0:
                moved.integrateMeasurement(force[j], rate[j], dt)
        return moved

    def solve(self) -> Trajectory:
        """Gauss-Newton, then covariances about a second apart."""
        for _ in range(STEPS):
            linear = self._linear()
            delta = linear.optimize(gtsam.Ordering.MetisGaussianFactorGraph(linear))
            self.values = self.values.retract(delta)
            if max(np.abs(delta.at(X(k))).max() for k in range(self.count)) < ENOUGH:
                break
        linear = self._linear()
        last = [M] if self.misaligned else []
        ordering = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(linear, last)
        return self._track(linear.eliminateMultifrontal(ordering, gtsam.EliminateQR))

    def _track(self, tree: Any) -> Trajectory:
        """The values, with covariances about a second apart from what has eliminated them."""
        t, taken = self.given.pings[0], [0]
        for k in range(1, self.count):
            if t[k] - t[taken[-1]] >= COVARIANCE_S:
                taken.append(k)
        R, p, v, _ = self._states()
        P = np.array([tree.marginalCovariance(X(k)) for k in taken])
        R, p, v = R[taken], p[taken], v[taken]
        turned = [R @ P[:, part, part] @ np.swapaxes(R, 1, 2) for part in (slice(3, 6), slice(0, 3))]
        return self.given.of_body(t[taken], p, R, v, *turned)

    def _states(self) -> tuple[Array, Array, Array, Array]:
        """Attitude, place, velocity and gyro's bias, shape (n, 3, 3), (n, 3) each."""
        poses = gtsam.utilities.extractPose3(self.values)
        v = gtsam.utilities.extractVectors(self.values, "v")
        bias = np.array([self.values.atConstantBias(B(k)).gyroscope() for k in range(self.count)])
        return poses[:, :9].reshape(-1, 3, 3), poses[:, 9:], v, bias

    def _linear(self) -> gtsam.GaussianFactorGraph:
        """All factors at the values; Huber losses are weights."""
        m = self.values.atVector(M)[0] if self.misaligned else 0.0
        r, H = self._rows(slice(None), *self._states(), m)
        linear, unit = self.native.linearize(self.values), gtsam.noiseModel.Unit.Create(r.shape[1])
        for k in range(self.count):
            terms = [(X(k), H[k, :, :6]), (V(k), H[k, :, 6:9]), (B(k), H[k, :, 9:15])]
            terms += [(M, H[k, :, 15:])] if self.misaligned else []
            # a conditional is a Jacobian factor, and the only one the bindings make of more than three keys
            linear.push_back(gtsam.GaussianConditional(terms, 1, r[k], unit))
        return linear

    def _rows(self, some: slice, R: Array, p: Array, v: Array, bias: Array, m: float) -> tuple[Array, Array]:
        """Residuals and Jacobians, shape (n, rows) and (n, rows, 16), of some pings and what belongs to them."""
        given = self.given
        blocks = [self._pings(some, R, v, bias, m)]
        blocks += [self._headings(R, heading[some], sd) for heading, sd in given.headings]
        if given.depth is not None:
            arm, sd = given.arm("depth"), given.config.depth.sd_m
            H = np.concatenate([-(R @ skew(arm))[:, 2:], R[:, 2:], np.zeros((len(R), 1, 10))], axis=2)
            blocks.append(huber((given.depth[some] - p[:, 2] - (R @ arm)[:, 2])[:, None] / sd, H / sd))
        if len(given.fixes[0]):
            blocks.append(self._fixes(some, R, p, v))
        r, H = (np.concatenate([block[k] for block in blocks], axis=1) for k in (0, 1))
        return r, H

    def _pings(self, some: slice, R: Array, v: Array, bias: Array, m: float) -> tuple[Array, Array]:
        """The velocity at the DVL's arm, turned by the misalignment."""
        measured, root = self.given.pings[1][some], self.given.pings[2]
        arm, rate = self.given.arm("dvl"), self.given.rate[some]
        own = np.einsum("nji,nj->ni", R, v)
        at_arm = own + np.cross(rate - bias, arm)
        turn = matrix_from_rpy([0.0, 0.0, -m])
        expected = at_arm @ turn.T
        by_m = -np.cross([0.0, 0.0, 1.0], expected)[:, :, None]
        by_bias = np.broadcast_to(turn @ skew(arm), (len(v), 3, 3))
        none = np.zeros((len(v), 3, 3))
        H = [turn @ skew(own), none, turn @ np.swapaxes(R, 1, 2), none, by_bias, by_m]
        return huber((measured - expected) @ root.T, root @ np.concatenate(H, axis=2))

    def _headings(self, R: Array, heading: Array, sd: float) -> tuple[Array, Array]:
        cos2 = R[:, 0, 0] ** 2 + R[:, 1, 0] ** 2
        H = np.zeros((len(R), 1, 16))
        H[:, 0, 1], H[:, 0, 2] = R[:, 2, 1] / cos2, R[:, 2, 2] / cos2
        off = wrap_angle(heading - np.arctan2(R[:, 1, 0], R[:, 0, 0]))
        return huber(off[:, None] / sd, H / sd)

    @cached_property
    def _fix_of(self) -> Array:
        """The last fix that is nearest to a ping, -1 = none, shape (n,)."""
        found = np.full(self.count, -1)
        found[self.given.fixes[0]] = np.arange(len(self.given.fixes[0]))
        return found

    def _fixes(self, some: slice, R: Array, p: Array, v: Array) -> tuple[Array, Array]:
        fix = self._fix_of[some]
        k = np.flatnonzero(fix >= 0)
        since, measured = (values[fix[k]] for values in self.given.fixes[1:])
        arm, sd = self.given.arm("fix"), self.given.config.fix.sd_m
        r, H = np.zeros((len(fix), 2)), np.zeros((len(fix), 2, 16))
        expected = p[k] + R[k] @ arm + since[:, None] * v[k]
        r[k] = (measured - expected[:, :2]) / sd
        H[k, :, :3], H[k, :, 3:6] = -(R[k] @ skew(arm))[:, :2] / sd, R[k][:, :2] / sd
        H[k, :, 6:9] = since[:, None, None] * np.eye(3)[:2] / sd
        return huber(r, H)


class Incremental(Graph):
    """The same graph by iSAM2, a ping at a time, each begun where the IMU predicts it; one Python factor a ping."""

    def __init__(self, given: Measured, misaligned: bool) -> None:
        super().__init__(given, misaligned)
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(RELINEARISE)
        params.relinearizeSkip = RELINEARISE_EVERY
        params.setFactorization("QR")
        self.isam = gtsam.ISAM2(params)

    def solve(self) -> Trajectory:
        """The track after the last ping."""
        native = [self.native.at(i) for i in range(self.native.size())]
        priors = len(native) - (self.count - 1)
        for k in range(self.count):
            graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
            if k:
                graph.add(native[priors + k - 1])
                self._predict(k, values)
            else:
                for factor in native[:priors]:
                    graph.add(factor)
                for key, insert in ((X(0), "Pose3"), (V(0), "Vector"), (B(0), "ConstantBias")):
                    values.insert(key, getattr(self.values, f"at{insert}")(key))
                if self.misaligned:
                    values.insert(M, np.zeros(1))
            graph.add(self._factor(k))
            self.isam.update(graph, values)
        self.values = self.isam.calculateBestEstimate()
        return self._track(self.isam)

    def _predict(self, k: int, values: gtsam.Values) -> None:
        pose, v = self.isam.calculateEstimatePose3(X(k - 1)), self.isam.calculateEstimateVector(V(k - 1))
        bias = self.isam.calculateEstimateConstantBias(B(k - 1))
        state = self._moved(k).predict(gtsam.NavState(pose, v), bias)
        values.insert(X(k), state.pose())
        values.insert(V(k), state.velocity())
        values.insert(B(k), bias)

    def _factor(self, k: int) -> gtsam.CustomFactor:
        """All that was measured at a ping."""
        keys, parts = [X(k), V(k), B(k)], [slice(6), slice(6, 9), slice(9, 15)]
        if self.misaligned:
            keys, parts = [*keys, M], [*parts, slice(15, 16)]

        def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
            pose, bias = values.atPose3(keys[0]), values.atConstantBias(keys[2]).gyroscope()
            m = values.atVector(M)[0] if self.misaligned else 0.0
            R, p, v = pose.rotation().matrix()[None], pose.translation()[None], values.atVector(keys[1])[None]
            r, J = self._rows(slice(k, k + 1), R, p, v, bias[None], m)
            for i, part in enumerate(parts if H is not None else ()):
                H[i] = np.asfortranarray(J[0, :, part])
            return -r[0]

        rows = 3 + len(self.given.headings) + (self.given.depth is not None) + 2 * bool(len(self.given.fixes[0]))
        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(rows), keys, error)


X, V, B = (lambda k, letter=letter: gtsam.symbol(letter, k) for letter in "xvb")
M = gtsam.symbol("m", 0)


def huber(r: Array, H: Array) -> tuple[Array, Array]:
    """Whitened residuals and Jacobians, weighted."""
    weight = np.sqrt(np.minimum(1.0, HUBER / np.maximum(np.linalg.norm(r, axis=1), 1e-9)))
    return weight[:, None] * r, weight[:, None, None] * H


# ------------------------------------------------------------------ pyins


@dataclass
class Observation:
    """What pyins takes for a measurement: data by time, and the matrices of an error of 9 states.

    These are of position, velocity and attitude, in n; the last as ``phi`` of the "modified phi-angle" model.
    """

    data: pd.DataFrame

    def __post_init__(self) -> None:
        self._rows = dict(zip(self.data.index.tolist(), self.data.to_numpy(), strict=True))

    def compute_matrices(self, time: float, pva: pd.Series, error_model: Any) -> tuple[Array, Array, Array] | None:
        """Estimate less measurement, its derivative by the error, its noise; None where there is no measurement."""
        measured = self._rows.get(time)
        return None if measured is None else self.matrices(measured, pva)

    def matrices(self, measured: Array, pva: pd.Series) -> tuple[Array, Array, Array]:
        """Of a measurement that there is."""
        raise NotImplementedError


@dataclass
class PingMatrices(Observation):
    """Velocity at the DVL's arm, body axes."""

    arm: Array
    cov: Array

    def matrices(self, measured: Array, pva: pd.Series) -> tuple[Array, Array, Array]:
        R_bn, rate = attitude_of(pva).T, numbers(pva, "rate_x", "rate_y", "rate_z")
        own = R_bn @ numbers(pva, "VN", "VE", "VD") + np.cross(rate, self.arm)
        return own - measured, np.hstack([np.zeros((3, 3)), R_bn, np.zeros((3, 3))]), self.cov


@dataclass
class HeadingMatrices(Observation):
    """A compass's [rad]."""

    sd: float

    def matrices(self, measured: Array, pva: pd.Series) -> tuple[Array, Array, Array]:
        _, pitch, heading = np.deg2rad(numbers(pva, "roll", "pitch", "heading"))
        H = np.zeros((1, 9))
        H[0, 6:] = -np.cos(heading) * np.tan(pitch), -np.sin(heading) * np.tan(pitch), -1.0
        return np.array([wrap_angle(heading - measured[0])]), H, np.array([[self.sd**2]])


@dataclass
class PlaceMatrices(Observation):
    """Depth (axis 2), or north and east (0, 1) about an origin."""

    axes: list[int]
    arm: Array
    sd: float
    origin: Array

    def matrices(self, measured: Array, pva: pd.Series) -> tuple[Array, Array, Array]:
        from pyins.transform import lla_to_ned

        arm_n = attitude_of(pva) @ self.arm
        own = lla_to_ned(numbers(pva, "lat", "lon", "alt")[None], self.origin)[0] + arm_n
        H = np.hstack([np.eye(3), np.zeros((3, 3)), skew(arm_n)])
        return own[self.axes] - measured, H[self.axes], self.sd**2 * np.eye(len(self.axes))


def numbers(pva: pd.Series, *names: str) -> Array:
    """Some of a row, without what pandas takes to select them at once."""
    return np.array([pva[name] for name in names], float)


def attitude_of(pva: pd.Series) -> Array:
    """R_nb of a row of pyins."""
    return np.asarray(matrix_from_rpy(np.deg2rad(numbers(pva, "roll", "pitch", "heading"))))


def pyins_measurements(given: Measured, origin: Array) -> list[Any]:
    """Pings, headings, depths and fixes, each of a class of its own, by whose names pyins sorts them."""
    config, (at, velocity_b, root) = given.config, given.pings
    ping = PingMatrices(
        pd.DataFrame(velocity_b, at, ["VX", "VY", "VZ"]), given.arm("dvl"), np.linalg.inv(root.T @ root)
    )
    found: list[Any] = [ping]
    for heading, sd in given.headings:
        found.append(HeadingMatrices(pd.DataFrame({"heading": heading}, at), sd))
    if given.depth is not None:
        depth = pd.DataFrame({"down": given.depth}, at)
        found.append(PlaceMatrices(depth, [2], given.arm("depth"), config.depth.sd_m, origin))
    if len(given.fixes[0]):
        fixes = pd.DataFrame(given.fixes[2], given.log["fix"].time, ["north", "east"])
        found.append(PlaceMatrices(fixes, [0, 1], given.arm("fix"), config.fix.sd_m, origin))
    for k, one in enumerate(found):
        one.__class__ = type(f"{type(one).__name__}{k}", (type(one),), {})
    return found


def pyins_filter(given: Measured, turning_earth: bool) -> Trajectory:
    """`run_feedback_filter` with measurements of our own, as its documentation says to write them.

    pyins always has a rotating ellipsoid. A log of a flat Earth at rest gets the latitude of its gravity, and the
    Earth's rate added to its gyro's.
    """
    from pyins import earth, strapdown, transform
    from pyins.filters import run_feedback_filter
    from pyins.inertial_sensor import EstimationModel
    from pyins.util import ACCEL_COLS, GYRO_COLS, LLA_COLS, RPH_COLS, VEL_COLS

    config, (t, force, rate), at = given.config, given.imu, given.pings[0]
    latitude = config.environment.latitude_deg
    if not turning_earth:
        latitudes = np.linspace(0.0, 90.0, 9001)
        latitude = latitudes[np.abs(earth.gravity(latitudes, 0.0) - config.environment.gravity_mps2).argmin()]
        R = given.attitude[np.clip(np.searchsorted(at, t), 0, len(at) - 1)]
        rate = rate + np.einsum("nji,j->ni", R, earth.rate_n(latitude))
    origin = np.array([latitude, 0.0, 0.0])
    imu = pd.DataFrame(np.hstack([rate, force]), t, [*GYRO_COLS, *ACCEL_COLS]).loc[at[0] :]
    rpy = np.rad2deg([given.tilt[0][0], given.tilt[1][0], given.heading[0]])
    lla = transform.perturb_lla(origin, given.start)
    columns = [*LLA_COLS, *VEL_COLS, *RPH_COLS]
    pva = pd.Series([*lla, *dead_reckoning(given).v_n[0], *rpy], columns, name=float(imu.index[0]))
    start, noise, unit = config.start, config.imu.noise, config.imu
    found = run_feedback_filter(
        pva,
        *(start.position_sd_m, FIRST_SD_MPS, start.tilt_sd_deg, start.heading_sd_deg),
        strapdown.compute_increments_from_imu(imu, "rate"),
        EstimationModel(np.deg2rad(unit.gyr_bias_sd_dps), noise.gyr, noise.gyr_walk),
        EstimationModel(unit.acc_bias_sd_mps2, noise.acc, noise.acc_walk),
        pyins_measurements(given, origin),
        time_step=COVARIANCE_S,
    )
    sd = found.trajectory_sd
    track = found.trajectory.loc[sd.index]
    cov = np.zeros((len(sd), 3, 3))
    cov[:, [0, 1, 2], [0, 1, 2]] = sd[["north", "east", "down"]].to_numpy() ** 2  # it gives no correlations
    p_n = transform.lla_to_ned(track[LLA_COLS].to_numpy(), origin)
    R_nb = np.asarray(transform.mat_from_rph(track[RPH_COLS]))
    return given.of_body(sd.index.to_numpy(), p_n, R_nb, track[VEL_COLS].to_numpy(), cov, np.full_like(cov, np.nan))


# ------------------------------------------------------------------ the dives


def falcon(seeds: range) -> Iterator[Task]:
    """The dive that ships."""
    folder = ROOT / "data" / "falcon"
    config = load_config(folder / "config.yaml")
    truth = read_reference(folder / "truth.csv.gz")
    yield Task("data/falcon", read_log(folder / "log.csv.gz", config), config, truth)


def lawnmower(seeds: range, minutes: float) -> Iterator[Task]:
    """`rovgraph simulate lawnmower`: every calibration variable is drawn from its default prior."""
    for seed in seeds:
        dive, config = simulated("lawnmower", seed, choices=Choices(duration=60.0 * minutes))
        truth = dive.truth.every(100)
        name = f"lawnmower, {minutes:g} minutes, seeds {span(seeds)}"
        yield Task(name, Log.from_frame(dive.log_frame, config), config, truth)


def campaign(grade: str, seeds: range) -> Iterator[Task]:
    """A healthy dive of the fault campaign."""
    for seed in seeds:
        dive = make_dive(CASES[GRADES[grade]], seed)
        config = Config.model_validate(dive.configuration)
        t = np.arange(0.0, dive.motion.duration, 1.0)
        truth = Trajectory.certain(t, dive.motion.local(t), dive.motion.C_nb(t), dive.motion.v_n(t))
        log = Log.from_frame(log_table(dive.streams), config)
        yield Task(f"campaign, {grade}, seeds {span(seeds)}", log, config, truth, turning_earth=True)


def ictineu(folder: Path) -> Iterator[Task]:
    """The recorded dive; GPS of the first 600 s only, and all of it as the reference."""
    config = load_config(folder / "ictineu.yaml")
    log = read_log(folder / "log.csv.gz", config)
    truth = read_reference(folder / "reference.csv.gz")
    yield Task("Ictineu after 600 s", log, config, truth, turning_earth=True, after=600.0)


def span(seeds: range) -> str:
    return f"{seeds[0]} to {seeds[-1]}"


@dataclass(frozen=True)
class Score:
    """Of one method on one dive.

    Attributes
    ----------
    rms, end : horizontal errors [m]
    nees : per degree of freedom
    seconds : processor time
    megabytes : the most memory beyond what the log takes
    """

    rms: float
    end: float
    nees: float
    seconds: float
    megabytes: float


def ours(task: Task) -> dict[str, Trajectory]:
    """Both estimates of `rovgraph smooth`, which are made together."""
    estimates = smooth(task.log, task.config, "both").estimates
    return {f"rovgraph, {e.kind}": e.trajectory for e in estimates if e.kind in ("smoothed", "filtered")}


PEERS: dict[str, Callable[[Measured, Task], Trajectory]] = {
    "dead reckoning": lambda given, task: dead_reckoning(given),
    "plain GTSAM": lambda given, task: Graph(given, misaligned=False).solve(),
    "plain GTSAM with misalignment": lambda given, task: Graph(given, misaligned=True).solve(),
    "GTSAM's iSAM2 with misalignment": lambda given, task: Incremental(given, misaligned=True).solve(),
    "pyins": lambda given, task: pyins_filter(given, task.turning_earth),
}
OURS = 3  # lines: read the configuration, read the log, smooth
DEAD_RECKONING = (Measured, dead_reckoning)
WRITTEN: dict[str, tuple[Callable[..., Any], ...]] = {  # what somebody who has the log has to write
    "dead reckoning": DEAD_RECKONING,
    "plain GTSAM": (*DEAD_RECKONING, Graph, huber),
    "plain GTSAM with misalignment": (*DEAD_RECKONING, Graph, huber),
    "GTSAM's iSAM2 with misalignment": (*DEAD_RECKONING, Graph, huber, Incremental),
    "pyins": (
        *(*DEAD_RECKONING, Observation, PingMatrices, HeadingMatrices, PlaceMatrices),
        *(numbers, attitude_of, pyins_measurements, pyins_filter),
    ),
}


def lines_of(method: str) -> int:
    """Lines to write for a method, without comments, docstrings and empty lines."""
    if method not in WRITTEN:
        return OURS
    count = 0
    for written in WRITTEN[method]:
        tree = ast.parse(inspect.getsource(written))
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and ast.get_docstring(node) is not None:
                del node.body[0]
        count += sum(bool(line.strip()) for line in ast.unparse(tree).splitlines())
    return count


def by_method(task: Task, method: str) -> dict[str, Score]:
    """A method on a dive, in this process: the scores of its rows."""
    began, before = time.process_time(), resident("VmRSS")
    tracks = ours(task) if method == "rovgraph" else {method: PEERS[method](Measured(task.config, task.log), task)}
    seconds, megabytes = time.process_time() - began, resident("VmHWM") - before
    scores = {}
    for name, track in tracks.items():
        metrics = evaluate(track, task.truth, task.after)
        nees = np.nan if metrics.nees is None else 0.5 * metrics.nees
        scores[name] = Score(metrics.rms_m, metrics.end_m, nees, seconds, megabytes)
    return scores


def resident(key: str) -> float:
    """Memory of this process now (VmRSS) or at most (VmHWM) [MB]."""
    found = re.search(rf"{key}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return float(found[1]) / 1024.0 if found else np.nan


def in_a_process(task: Task, method: str, limit: float) -> dict[str, Score]:
    """`by_method` in a process that begins with the log and with what was compiled; empty where it takes too long."""
    fork = multiprocessing.get_context("fork")
    ours, theirs = fork.Pipe(duplex=False)

    def work() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (int(60.0 * limit), int(60.0 * limit)))
        theirs.send(by_method(task, method))

    process = fork.Process(target=work)
    process.start()
    theirs.close()
    try:
        return ours.recv()
    except EOFError:
        return {}
    finally:
        process.join()


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    dives = ["falcon", "lawnmower", *GRADES, "ictineu"]
    parser.add_argument("dives", nargs="*", metavar="DIVE", help=", ".join(dives))
    parser.add_argument("--seeds", type=int, nargs=2, default=[5, 24], metavar=("FIRST", "LAST"))
    parser.add_argument("--minutes", type=float, default=60.0, help="of lawnmower")
    every = ["rovgraph", *PEERS]
    parser.add_argument("--methods", nargs="+", choices=every, default=every, metavar="METHOD", help=", ".join(every))
    parser.add_argument("--limit", type=float, default=30.0, help="processor time of a method on a dive [min]")
    parser.add_argument("--ictineu", type=Path, default=ROOT.parent / "shared" / "data" / "ictineu", metavar="FOLDER")
    given = parser.parse_args()
    if unknown := set(given.dives) - set(dives):
        parser.error(f"unknown dive {min(unknown)}; known are {', '.join(dives)}")
    warnings.simplefilter("ignore")
    methods = [name for name in given.methods if name != "pyins" or find_spec("pyins") is not None]
    if len(methods) < len(given.methods):
        print("pyins is left out: pip install python-ins\n")
    seeds = range(given.seeds[0], given.seeds[1] + 1)
    print("| dive | method | rms [m] | median | end | NEES | processor time | memory | lines to write |")
    print("|---|---|---|---|---|---|---|---|---|")
    warm_up()
    for dive in given.dives or dives:
        if dive == "ictineu" and not (given.ictineu / "log.csv.gz").is_file():
            print(f"| Ictineu | absent: {given.ictineu}; name it with --ictineu | | | | | | | |")
            continue
        makers = {
            "falcon": falcon,
            "lawnmower": lambda of: lawnmower(of, given.minutes),
            "ictineu": lambda _: ictineu(given.ictineu),
        }
        tasks = makers[dive](seeds) if dive in makers else campaign(dive, seeds)
        name, scores, given_up = dive, dict[str, list[Score]](), set[str]()
        for task in tasks:
            name = task.name
            for method in (method for method in methods if method not in given_up):
                found = in_a_process(task, method, given.limit)
                given_up |= set() if found else {method}
                for shown, one in found.items():
                    scores.setdefault(shown, []).append(one)
        for method, rows in ((m, rows) for m, rows in scores.items() if m not in given_up):
            print(f"| {name} | {method} | {row(rows)} | {lines_of(method)} |", flush=True)
        for method in given_up:
            late = f"given up after {given.limit:g} min"
            print(f"| {name} | {method} | – | – | – | – | {late} | – | {lines_of(method)} |", flush=True)


def warm_up() -> None:
    """Compiles what later processes have from this one."""
    dive, config = simulated("lawnmower", 1, choices=Choices(duration=60.0))
    smooth(Log.from_frame(dive.log_frame, config), config, "both")


def row(scores: list[Score]) -> str:
    """Root of the mean square error, its median, that of the end, mean NEES, time and memory."""
    parts = ("rms", "end", "nees", "seconds", "megabytes")
    rms, end, nees, seconds, megabytes = (np.array([getattr(one, part) for one in scores]) for part in parts)
    honest = "–" if np.isnan(nees).all() else f"{np.nanmean(nees):.2f}"
    errors = f"{np.sqrt(np.mean(rms**2)):.2f} | {np.median(rms):.2f} | {np.sqrt(np.mean(end**2)):.2f}"
    return f"{errors} | {honest} | {seconds.mean():.1f} s | {megabytes.mean():.0f} MB"


if __name__ == "__main__":
    main()
