"""The environment of a simulated vehicle: magnetic fields of iron, and water in motion.

An object of iron on the ground is a dipole of moment m at the distance r,

    B = mu0 / (4 pi |r|^3) (3 (m . u) u - m),  u = r / |r|

A magnetometer measures B where it is. A compass turns with the horizontal part of the whole field where *it* is. The
vehicle's own iron moves with the vehicle.

The water has a current and the orbits of small waves. Linear waves in deep water: a wave of amplitude A and angular
frequency s moves the water at depth z on circles with the speed A s exp(-k z), k = s^2 / g, along its direction and, a
quarter of a period apart, vertically. All water around the vehicle moves as one.
"""

from dataclasses import dataclass

import numpy as np

from rovgraph.geometry import Array
from rovgraph.model.config import Config
from rovgraph.model.thesis import WAVE_HZ
from rovgraph.sensors import field_direction
from rovgraph.sensors.instruments import DEFAULT_DIP
from rovgraph.simulate.path import Path

EARTH_FIELD_T = 50.5e-6  # magnitude in southern Sweden, the unit of the thesis's normalised field [T]
# Moment of iron by its mass: 1000 kg give 1 nT at 30 m (a rule of Geometrics'), which is
# 2e-7 m / 30^3 = 1 nT for an induced 0.135 A m^2/kg; what iron keeps of its past is a few times
# as much (Breiner 1973, Applications manual for portable magnetometers: 0.1 to 1 A m^2/kg).
INDUCED_PER_KG = 0.135
REMANENT_PER_KG = 3.0 * INDUCED_PER_KG

# What lies along the thesis's cable and its landmarks (1.6), a choice
OBJECTS = 8
MASS_KG = (20.0, 200.0)
ASIDE_M = 3.0
BELOW_M = (1.5, 3.0)  # below the deepest point of the track


@dataclass(frozen=True)
class Iron:
    """Objects of iron, k of them.

    Attributes
    ----------
    p_n : ndarray, shape (k, 3) [m]
    moment_n : ndarray, shape (k, 3) [A m^2]
    """

    p_n: Array
    moment_n: Array

    def field(self, p_n: Array) -> Array:
        """Field of all objects at n points, shape (n, 3), as a fraction of the Earth's."""
        out = np.zeros_like(p_n)
        for place, moment in zip(self.p_n, self.moment_n, strict=True):
            r = p_n - place
            distance = np.linalg.norm(r, axis=1, keepdims=True)
            u = r / distance
            out += 1e-7 / distance**3 * (3.0 * (u @ moment)[:, None] * u - moment)
        return out / EARTH_FIELD_T


NO_IRON = Iron(np.zeros((0, 3)), np.zeros((0, 3)))


@dataclass(frozen=True)
class Distortion:
    """Raw samples of an uncalibrated magnetometer, y = (H - offset) / scale, the inverse of (3.2).

    Attributes
    ----------
    scale, offset : ndarray, shape (3,), gamma and kappa of (3.2), IMU axes; kappa in the log's unit
    """

    scale: Array
    offset: Array

    def raw(self, field: Array) -> Array:
        """The magnetometer's reading of a field, both of shape (n, 3)."""
        return np.asarray((field - self.offset) / self.scale)


@dataclass(frozen=True)
class Magnetism:
    """Magnetic disturbances beside the calibration variables.

    Attributes
    ----------
    iron : objects around the vehicle
    distortion : None = the magnetometer is calibrated
    """

    iron: Iron = NO_IRON
    distortion: Distortion | None = None


UNDISTURBED = Magnetism()


def iron_near(path: Path, config: Config, rng: np.random.Generator) -> Iron:
    """Iron on the seabed near a path: masses, places and what the objects keep of their past are drawn.

    Parameters
    ----------
    path : Path
    config : Config, the Earth's field in it induces a part of the moments
    rng : numpy Generator
    """
    track = path.motion(np.linspace(0.0, path.duration, 1000)).p_n
    p_n = track[rng.integers(0, len(track), OBJECTS)]
    p_n[:, :2] += rng.uniform(-ASIDE_M, ASIDE_M, (OBJECTS, 2))
    p_n[:, 2] = track[:, 2].max() + rng.uniform(*BELOW_M, OBJECTS)
    lightest, heaviest = np.log(MASS_KG)
    mass = np.exp(rng.uniform(lightest, heaviest, OBJECTS))[:, None]
    kept = rng.standard_normal((OBJECTS, 3))
    kept /= np.linalg.norm(kept, axis=1, keepdims=True)
    env = config.environment
    dip = DEFAULT_DIP if env.dip_deg is None else np.deg2rad(env.dip_deg)
    earth = field_direction(np.deg2rad(env.declination_deg), dip)
    return Iron(p_n, mass * (INDUCED_PER_KG * earth + REMANENT_PER_KG * kept))


def drawn_distortion(rng: np.random.Generator) -> Distortion:
    """An uncalibrated magnetometer, of about the size of the thesis's figure 3.1: a choice."""
    return Distortion(1.0 + 0.08 * rng.standard_normal(3).clip(-2.0, 2.0), 0.12 * rng.standard_normal(3))


def compass_turn(field_n: Array, disturbance_n: Array) -> Array:
    """Angle from magnetic north to where a compass points in a disturbed field, shape (n,) [rad].

    Parameters
    ----------
    field_n : ndarray, shape (3,), the Earth's field
    disturbance_n : ndarray, shape (n, 3), in the same unit
    """
    total = field_n + disturbance_n
    across = field_n[0] * total[:, 1] - field_n[1] * total[:, 0]
    return np.asarray(np.arctan2(across, total[:, :2] @ field_n[:2]))


GRAVITY = 9.81
SURFACE_AMPLITUDE = 0.1  # of all waves together: "small waves" (3.1.4); the figure is a choice [m]
BANDWIDTH_HZ = 0.02  # sd of the waves' frequencies about the thesis's line: a choice
COMPONENTS = 7
CURRENT_MAX = 0.1  # of a current that is drawn; a lake without a river: a choice [m/s]


@dataclass(frozen=True)
class Sea:
    """Motion of the water, the same everywhere.

    Attributes
    ----------
    current_n : ndarray, shape (3,) [m/s]
    amplitude_n : ndarray, shape (k, 3), amplitudes of the waves' velocity [m/s]
    frequency : ndarray, shape (k,) [Hz]
    phase : ndarray, shape (k, 3) [rad]
    """

    current_n: Array
    amplitude_n: Array
    frequency: Array
    phase: Array

    def velocity(self, time: Array) -> Array:
        """Velocity of the water at n epochs, shape (n, 3) [m/s]."""
        waves = [a * np.sin(angle) for a, angle in self._waves(time)]
        return np.asarray(sum(waves, np.tile(self.current_n, (len(time), 1))))

    def acceleration(self, time: Array) -> Array:
        """Acceleration of the water at n epochs, shape (n, 3) [m/s^2]."""
        rates = 2.0 * np.pi * self.frequency
        waves = [s * a * np.cos(angle) for s, (a, angle) in zip(rates, self._waves(time), strict=True)]
        return np.asarray(sum(waves, np.zeros((len(time), 3))))

    def _waves(self, time: Array) -> list[tuple[Array, Array]]:
        """Amplitude (3,) and angle (n, 3) of each wave."""
        turns = 2.0 * np.pi * time[:, None]
        return [(a, turns * f + p) for a, f, p in zip(self.amplitude_n, self.frequency, self.phase, strict=True)]


STILL = Sea(np.zeros(3), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))


def drawn_sea(
    rng: np.random.Generator,
    depth: float,
    current: tuple[float, float] | None = None,
    amplitude: float = SURFACE_AMPLITUDE,
) -> Sea:
    """Waves about the thesis's frequency from one direction, and a current.

    Parameters
    ----------
    rng : numpy Generator
    depth : of the dive [m], positive
    current : north, east [m/s]; None = drawn, of at most `CURRENT_MAX`
    amplitude : of all waves together at the surface [m]
    """
    course, toward = rng.uniform(0.0, 2.0 * np.pi, 2)
    drift = rng.uniform(0.0, CURRENT_MAX) * np.array([np.cos(course), np.sin(course)])
    frequency = WAVE_HZ + BANDWIDTH_HZ * rng.standard_normal(COMPONENTS).clip(-3.0, 3.0)
    start = rng.uniform(0.0, 2.0 * np.pi, COMPONENTS)
    rate = 2.0 * np.pi * frequency
    speed = amplitude / np.sqrt(COMPONENTS) * rate * np.exp(-(rate**2) / GRAVITY * depth)
    orbit = np.array([np.cos(toward), np.sin(toward), 1.0])
    phase = start[:, None] + np.array([0.0, 0.0, 0.5 * np.pi])
    current_n = np.append(drift if current is None else current, 0.0)
    return Sea(current_n, speed[:, None] * orbit, frequency, phase)
