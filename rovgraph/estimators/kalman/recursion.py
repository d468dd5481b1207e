"""The recursion: predict to each epoch, update with what was measured there.

Inertial samples come at their own epochs, pings at theirs: a ping between two samples is
reached by a shorter step. At equal times the inertial sample comes first.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from rovgraph.errors import InputError
from rovgraph.estimators.kalman.core import Innovate, Linearized, iterated_update, propagate_covariance
from rovgraph.estimators.kalman.dvl import HEADING, Ping
from rovgraph.estimators.kalman.setup import Setup
from rovgraph.estimators.kalman.truth import TrueMotion
from rovgraph.geometry import Array, wrap_angle
from rovgraph.thesis import SAMPLE_S

LONGEST_STEP_S = 1.5 * SAMPLE_S  # of forward Euler; a longer interval is divided
KEEP_EVERY = 10  # of the inertial samples' innovations


@dataclass
class Innovations:
    """Kept innovations of one sensor, a list entry each.

    Attributes
    ----------
    index : of the sample or ping
    residual, normalised, sd : ndarray, shape (m,); z minus h, whitened, and sd
    """

    index: list[int] = field(default_factory=list)
    residual: list[Array] = field(default_factory=list)
    normalised: list[Array] = field(default_factory=list)
    sd: list[Array] = field(default_factory=list)

    def keep(self, index: int, residual: Array, normalised: Array, sd: Array) -> None:
        self.index.append(index)
        self.residual.append(residual)
        self.normalised.append(normalised)
        self.sd.append(sd)


@dataclass
class Recursion:
    """A filter under way.

    Attributes
    ----------
    setup : Setup
    true_motion : where to linearise, or None for the estimate
    time, epoch : of the state [s], and the last IMU epoch at or before it
    x, P : ndarray, state and covariance
    kept : (time, epoch, x, P) at the first epoch, pings and the last epoch, and every
        ``graph.max_gap_s`` where pings are missing
    imu, dvl : Innovations
    """

    setup: Setup
    true_motion: TrueMotion | None = None

    def __post_init__(self) -> None:
        s = self.setup
        self.x, self.P = s.x, s.P
        self.epoch, self.time = 0, float(s.log["imu"].time[0])
        self.kept: list[tuple[float, int, Array, Array]] = []
        self.imu, self.dvl = Innovations(), Innovations()
        self._quaternion = s.places.get("q")
        self._diagonal = slice(None, None, len(s.x) + 1)
        self._complete = np.asarray(np.isfinite(s.samples).all(axis=1))

    def run(self) -> None:
        """The whole log.

        Raises
        ------
        InputError : the filter diverges
        """
        s = self.setup
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                self._run()
        except FloatingPointError:
            raise InputError(
                f"{s.log.source}: filter {s.variant.name} diverges at {self.time:.2f} s; "
                "check mountings, units and start"
            ) from None

    def _run(self) -> None:
        s = self.setup
        times, longest = s.log["imu"].time.tolist(), s.config.graph.max_gap_s
        waiting = iter(enumerate(s.pings))
        number, ping = next(waiting, (0, None))
        for epoch, time in enumerate(times):
            while ping is not None and ping.time < time:
                self._take_ping(number, ping)
                number, ping = next(waiting, (0, None))
            self._advance(time)
            self.epoch = epoch
            if s.imu is not None:
                self._take_sample(epoch)
            while ping is not None and ping.time == time:
                self._take_ping(number, ping)
                number, ping = next(waiting, (0, None))
            if not self.kept or time - self.kept[-1][0] > longest:
                self._keep()
        if self.kept[-1][0] < self.time:
            self._keep()

    def _advance(self, time: float) -> None:
        """Predict to ``time``, in steps that forward Euler bears."""
        whole = time - self.time
        if whole <= 0.0:
            return
        count = math.ceil(whole / LONGEST_STEP_S)
        dt, process = whole / count, self.setup.process
        for _ in range(count):
            Q = process.noise(self.x)
            x, F = process.step(self.x, dt, self.epoch)
            if self.true_motion is not None:
                F = process.step(self.true_motion.state(self.time, self.x), dt, self.epoch)[1]
            self.x, self.P = x, propagate_covariance(self.P, F)
            if Q.ndim == 1:
                self.P.reshape(-1)[self._diagonal] += dt * Q
            else:
                self.P += dt * Q
        self.time = time

    def _take_sample(self, epoch: int) -> None:
        s = self.setup
        model, z, R = s.imu, s.samples[epoch], s.R_imu
        assert model is not None
        if not self._complete[epoch]:
            z, R = z[:6], R[:6, :6]

        def innovate(x: Array) -> Linearized:
            h, H = model(x, epoch)
            if self.true_motion is not None:
                H = model(self.true_motion.state(self.time, x), epoch)[1]
            return z - h[: len(z)], H[: len(z)]

        result = self._update(innovate, R)
        if epoch % KEEP_EVERY == 0:
            self.imu.keep(epoch, *result)

    def _take_ping(self, number: int, ping: Ping) -> None:
        self._advance(ping.time)
        s, rows = self.setup, list(ping.rows)
        heading = HEADING in ping.rows

        def innovate(x: Array) -> Linearized:
            h, H = s.dvl(x, self.epoch, heading)
            if self.true_motion is not None:
                H = s.dvl(self.true_motion.state(self.time, x), self.epoch, heading)[1]
            residual = ping.z - h[rows]
            if heading:
                residual[-1] = wrap_angle(residual[-1])
            return residual, H[rows]

        self.dvl.keep(number, *self._update(innovate, s.R_dvl[np.ix_(rows, rows)]))
        self._keep()

    def _update(self, innovate: Innovate, R: Array) -> tuple[Array, Array, Array]:
        """Update with a measurement and bring the quaternion back to unit length."""
        residual, self.x, self.P, normalised, sd = iterated_update(
            self.x, self.P, innovate, R, self.setup.variant.iterations
        )
        if not math.isfinite(self.x @ self.x):
            raise FloatingPointError("the state is not finite")
        if self._quaternion is not None:
            q = self.x[self._quaternion]
            q *= 1.0 / math.sqrt(q @ q)
        return residual, normalised, sd

    def _keep(self) -> None:
        self.kept.append((self.time, self.epoch, self.x.copy(), self.P.copy()))
