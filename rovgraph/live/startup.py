"""The first seconds: what an estimator has to know before it can begin."""

from dataclasses import dataclass, field

from rovgraph.check.values import angles, gravity, turn_rates
from rovgraph.config import Config
from rovgraph.engine.constant_velocity import has_constant_velocity
from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.errors import InputError
from rovgraph.estimators.first_seconds import WINDOW_S, WITHIN_S
from rovgraph.estimators.initialise import initialise
from rovgraph.log import Measurement, gathered
from rovgraph.log.streams import precedence
from rovgraph.sensors import SENSORS

MARGIN_S = 0.5  # beyond the window, for data that come late
AGAIN_S = 1.0  # between attempts
NEEDS_IMU = "online needs an IMU, columns acc_x..acc_z and gyr_x..gyr_z"


@dataclass
class Startup:
    """Collects measurements until a dive can begin.

    Attributes
    ----------
    config : as the user gave it
    waits_for : why it has not begun, one line; empty while the first seconds go by
    doubts : what looks wrong with the first seconds, one line each
    """

    config: Config
    waits_for: str = ""
    measurements: list[Measurement] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    _next: float | None = None

    def __post_init__(self) -> None:
        if has_constant_velocity(self.config):
            raise InputError(f"motion.model: constant_velocity is for recorded logs, {NEEDS_IMU}")

    @property
    def expects(self) -> str:
        """What has to come before the dive can begin, or be different."""
        if self.waits_for:
            return self.waits_for
        if self._next is None:
            return "no measurement of an IMU yet"
        return f"the first {WINDOW_S + MARGIN_S:g} s of the IMU go by"

    def add(self, measurement: Measurement, origin: tuple[float, float] | None) -> InitialConditions | None:
        """Take a measurement; the beginning of the dive, once it is known.

        Parameters
        ----------
        measurement : the next one
        origin : latitude and longitude [deg] of north = east = 0, where they are known
        """
        self.measurements.append(measurement)
        if measurement.sensor != "imu":
            return None
        if self._next is None:
            self._next = measurement.time + WINDOW_S + MARGIN_S
        if measurement.time < self._next:
            return None
        self._next = measurement.time + AGAIN_S
        return self.begin(origin)

    def begin(self, origin: tuple[float, float] | None) -> InitialConditions | None:
        """The beginning from what is there, or None; then `waits_for` says why."""
        self.measurements.sort(key=lambda m: (m.time, precedence(m.sensor)))
        imu = [m.time for m in self.measurements if m.sensor == "imu"]
        if not imu:
            self.waits_for = NEEDS_IMU
            return None
        first = imu[-1] - WITHIN_S
        self.measurements = [m for m in self.measurements if m.time >= first]
        named = self.config.heading.sources is not None
        later = [s for s in SENSORS.values() if s.may_begin_later]
        expected = {s.name for s in later if s.heading_source is None or named}
        log = gathered(self.measurements, "so far", origin)
        try:
            initial = initialise(log, self.config, expected)
        except InputError as error:
            self.waits_for = str(error)
            return None
        findings = [finding for check in (gravity, turn_rates, angles) for finding in check(log, self.config)]
        self.doubts = [f"{finding.sensor}: {finding.text}" for finding in findings if finding.level != "ok"]
        return initial
