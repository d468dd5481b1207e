"""What is so in a dive that is driven through the thrusters, and that an estimator does not know.

`World` draws from a seed the sea, the vehicle's drag, iron on the seabed and the field in the
lake, has a pilot drive in it, and says what the sensors obey. docs/simulation.md has the
sources of the figures.
"""

from dataclasses import dataclass, replace

import numpy as np

from rovgraph.calibration import TABLE
from rovgraph.config import Config, beliefs
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.instruments import hydrodynamics
from rovgraph.simulate.autopilot import Autopilot, VelocityControl
from rovgraph.simulate.choices import Choices
from rovgraph.simulate.driven import drive
from rovgraph.simulate.magnetism import Magnetism, iron_near
from rovgraph.simulate.noise import THESIS
from rovgraph.simulate.path import Path
from rovgraph.simulate.route import Route, courses
from rovgraph.simulate.sea import Sea
from rovgraph.simulate.truth import Truth
from rovgraph.vehicle import Hydrodynamics

REST_S = 10.0
DRAG_SD = 0.2  # relative error of the believed drag: a choice
AHRS_RATE, AHRS_MEMORY_S = 10.0, 20.0  # the unit's own attitude errs slowly: a choice


@dataclass(frozen=True)
class World:
    """A dive's surroundings and its vehicle.

    Attributes
    ----------
    config : what is believed; mountings and places are taken as exact
    choices : Choices
    seed : of the dive
    rng : numpy Generator of the world, apart from that of the sensors
    drag : relative error of the believed drag, by calibration variable, shape (3,) each
    """

    config: Config
    choices: Choices
    seed: int
    rng: np.random.Generator
    drag: dict[str, Array]

    @staticmethod
    def drawn(config: Config, choices: Choices, seed: int) -> "World":
        """The world of a seed."""
        rng = np.random.default_rng([seed, 1])
        drag = {}
        for name in ("drag_linear", "drag_quadratic"):
            error = DRAG_SD * rng.standard_normal(3).clip(-3.0, 3.0)
            drag[name] = error if choices.noise else np.zeros(3)
        return World(config, choices, seed, rng, drag)

    @property
    def believed(self) -> Hydrodynamics:
        """The vehicle that pilots and estimators believe in."""
        return hydrodynamics(self.config)

    @property
    def vehicle(self) -> Hydrodynamics:
        """The vehicle as it is."""
        vehicle = self.believed
        return replace(
            vehicle,
            drag_linear=vehicle.drag_linear * (1.0 + self.drag["drag_linear"]),
            drag_quadratic=vehicle.drag_quadratic * (1.0 + self.drag["drag_quadratic"]),
        )

    def along(self, route: Route, speed: float, sea: Sea, duration: float, yaw: float | None = None) -> Path:
        """The path of the autopilot along a route.

        Parameters
        ----------
        route : Route
        speed : [m/s]
        sea : Sea
        duration : [s]
        yaw : heading at the beginning [rad], None = along the route

        Raises
        ------
        InputError : the end is not reached in time
        """
        pilot = Autopilot(VelocityControl(self.believed), route, speed, REST_S)
        yaw = float((courses(route.points) + route.crab)[0]) if yaw is None else yaw
        path = drive(self.vehicle, sea, pilot, [*route.points[0], yaw], duration)
        if pilot.arrival is None:
            raise InputError(f"duration of {duration:g} s at {speed:.2f} m/s: the end of the route is not reached")
        return path.shifted(route.points[0] - path.motion([0.0]).p_n[0])

    def truth(self, path: Path, sea: Sea, lake: bool) -> Truth:
        """What the thesis's sensors obey here; in a lake among iron, and in another field than the tank's."""
        belief = beliefs(self.config)
        calibration = {name: belief[name].mean for name in ("dvl_roll", "dvl_pitch", "dvl_yaw")}
        calibration |= self.drag | {"current": sea.current_n[:2]}
        for name in ("field_dip", "field_scale"):
            error = TABLE[name].sd * self.rng.standard_normal(1)
            calibration[name] = error if lake and self.choices.noise else np.zeros(1)
        disturbed = lake if self.choices.disturbances is None else self.choices.disturbances
        return Truth(
            self.config,
            calibration=calibration,
            noise=self.choices.noise,
            start_error=lake and self.choices.noise,
            ahrs_rate=AHRS_RATE,
            ahrs_memory=AHRS_MEMORY_S,
            covariances=THESIS,
            magnetism=Magnetism(iron_near(path, self.config, self.rng)) if disturbed else Magnetism(),
            outlier_share=self.choices.outliers,
            dropouts=self.choices.dropouts,
            places=self.choices.places,
            false_places=self.choices.false_places,
        )
