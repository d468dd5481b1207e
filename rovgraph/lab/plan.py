"""Ranks manoeuvres by how well they determine the calibration: the work of ``rovgraph plan``.

The manoeuvres are scenarios of the simulator, each at some speeds; of an acoustic system those that survey crews do,
the vehicle around a beacon or below the ship, or the ship around the vehicle. The information of a dive depends on
where it is linearised, not on the noise. So a manoeuvre is simulated without noise for a vehicle with the configured
sensors, the graph is linearised there, and the information that you already have is added.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array, rpy_from_matrix
from rovgraph.inference.gyrocompassing import relies_on_gyro
from rovgraph.lab.executors import cores, in_workers
from rovgraph.lab.observability import START_HEADING, Observability, examined, joint_bits, solved
from rovgraph.log import Log
from rovgraph.model.calibration import ACOUSTICS, TABLE, beacon_names
from rovgraph.model.config import AS_WRITTEN, Config, beliefs
from rovgraph.model.config_sections import Usbl
from rovgraph.simulate import CALM, Path, Style, Truth, scenario, simulate
from rovgraph.simulate.scenario import MANOEUVRE_DEPTH_M, MANOEUVRES

CANDIDATES = ("straight", "lawnmower", "square", "circle", "figure8", "accelerate-and-stop", "spiral")
SPEEDS = (0.25, 0.5)  # [m/s]
OF_SHIP = "ship-"  # of a manoeuvre that the ship does, while the vehicle stays on the bottom
ABOVE_BEACON_M = 15.0  # of the vehicle


@dataclass(frozen=True)
class Manoeuvre:
    """A scenario at a speed [m/s]; None = at the one that takes the time given."""

    name: str
    speed: float | None

    def __str__(self) -> str:
        return self.name if self.speed is None else f"{self.name}@{self.speed:g}"

    @property
    def scenario(self) -> str:
        """The scenario's name."""
        return self.name.removeprefix(OF_SHIP)

    @property
    def of_ship(self) -> bool:
        """Whether the ship does it."""
        return self.name.startswith(OF_SHIP)


def usual(config: Config, goals: Collection[str]) -> tuple[str, ...]:
    """Names of the manoeuvres that serve some goals.

    Parameters
    ----------
    config : with the acoustic system
    goals : labels; where one is acoustic, what survey crews do
    """
    acoustic = {label for v in TABLE.values() if set(v.sensors) <= set(ACOUSTICS) for label in v.labels}
    if not acoustic & set(goals):
        return CANDIDATES
    ship = tuple(OF_SHIP + name for name in MANOEUVRES) if config.usbl != Usbl() and config.usbl.head == "ship" else ()
    return (*MANOEUVRES, *ship)


def manoeuvres(names: Sequence[str] | None, duration: float) -> list[Manoeuvre]:
    """Those of some names, as ``circle`` at all speeds or ``circle@0.3`` at one.

    Parameters
    ----------
    names : None = all candidates
    duration : that they have to fit into [s]

    Raises
    ------
    InputError : no such scenario, no such speed, too short a duration
    """
    chosen: dict[Manoeuvre, None] = {}
    for text in names or CANDIDATES:
        name, at, speed = text.partition("@")
        survey = name.removeprefix(OF_SHIP) in MANOEUVRES
        for one in (_number(speed, text),) if at else (None,) if survey else SPEEDS:
            scenario(name.removeprefix(OF_SHIP) if survey else name, duration, one)  # refuses what cannot be
            chosen[Manoeuvre(name, one)] = None
    return list(chosen)


def _number(speed: str, text: str) -> float:
    try:
        return float(speed)
    except ValueError:
        raise InputError(f"manoeuvre {text!r}: a speed in m/s is expected behind the @, as circle@0.3") from None


IMU_HZ, DVL_HZ = (5.0, 1000.0), (0.1, 50.0)  # rates that can be planned with
MOST_COLUMNS = 6  # of a table, without goals


@dataclass(frozen=True)
class SensorRates:
    """How often the sensors will measure.

    Attributes
    ----------
    imu_rate, dvl_rate : [Hz]
    fix_interval : [s], None = no position fixes
    """

    imu_rate: float = 100.0
    dvl_rate: float = 5.6
    fix_interval: float | None = None

    def __post_init__(self) -> None:
        """Refuse what no sensor does.

        Raises
        ------
        InputError : a rate or an interval out of bounds
        """
        for name, rate, (least, most) in (("IMU", self.imu_rate, IMU_HZ), ("DVL", self.dvl_rate, DVL_HZ)):
            if not least <= rate <= most:
                raise InputError(f"{name} rate of {rate:g} Hz: between {least:g} and {most:g} Hz are expected")
        if self.fix_interval is not None and not self.fix_interval > 0.0:
            raise InputError(f"fix interval of {self.fix_interval} s: more than 0 s is expected")


@dataclass(frozen=True)
class KnownComponents:
    """Prior information on some components.

    Attributes
    ----------
    labels : c
    covariance : ndarray, shape (c, c), data and prior together [units of the components]
    prior_sd : ndarray, shape (c,), of the prior in it
    """

    labels: tuple[str, ...]
    covariance: Array
    prior_sd: Array

    @staticmethod
    def nothing() -> "KnownComponents":
        """No component."""
        return KnownComponents((), np.zeros((0, 0)), np.zeros(0))

    def information(self, labels: Sequence[str], sd: Array) -> Array:
        """Information of its data on some components, shape (c, c), in units of ``sd``; the others are marginalised."""
        shared = {*labels} - {START_HEADING.name}  # that of another dive
        both = [(labels.index(name), k) for k, name in enumerate(self.labels) if name in shared]
        out = np.zeros((len(labels), len(labels)))
        if both:
            there, here = (np.array(column) for column in zip(*both, strict=True))
            from_data = np.linalg.inv(self.covariance[np.ix_(here, here)]) - np.diag(self.prior_sd[here] ** -2)
            out[np.ix_(there, there)] = from_data * np.outer(sd[there], sd[there])
        return out


@dataclass(frozen=True)
class Prediction:
    """Predicted observability of a manoeuvre.

    Attributes
    ----------
    manoeuvre : which
    sd : ndarray, shape (c,), after it, with what is known before [unit of each]
    bits : information it adds
    """

    manoeuvre: Manoeuvre
    sd: Array
    bits: float


@dataclass(frozen=True)
class Plan:
    """Manoeuvres, the best first.

    Attributes
    ----------
    labels, units : c, of the calibration
    before : ndarray, shape (c,), sd as known before [unit of each]
    goals : label -> sd that is wanted [its unit]
    ranked : predictions
    scores : of each, largest sd over its goal; without goals minus the bits
    duration : of each manoeuvre [s]
    """

    labels: tuple[str, ...]
    units: tuple[str, ...]
    before: Array
    goals: dict[str, float]
    ranked: list[Prediction]
    scores: list[float]
    duration: float

    @property
    def selected(self) -> list[int]:
        """Components worth a column: those of the goals, else those that the best manoeuvre shows most of."""
        if self.goals:
            return [self.labels.index(name) for name in self.goals]
        return sorted(np.argsort(self.ranked[0].sd / self.before)[:MOST_COLUMNS].tolist())

    def path(self) -> Path:
        """That of the best manoeuvre, of who does it."""
        best = self.ranked[0].manoeuvre
        path = path_of(best, self.duration)
        return path.shifted([0.0, 0.0, -MANOEUVRE_DEPTH_M]) if best.of_ship else path


def plan(
    config: Config,
    candidates: Sequence[Manoeuvre],
    duration: float,
    known: KnownComponents | None = None,
    goals: Mapping[str, float] | None = None,
    sensors: SensorRates | None = None,
    progress: Callable[[float], None] = lambda done: None,
) -> Plan:
    """Rank manoeuvres by what they would show of the calibration.

    Parameters
    ----------
    config : vehicle and sensors as configured, and what to estimate
    candidates : the manoeuvres
    duration : of each [s]
    known : from dives before
    goals : label -> sd that is wanted [its unit]
    sensors : how often they measure
    progress : called with the share that is done

    Raises
    ------
    InputError : no manoeuvre, nothing to estimate, a goal for what is not estimated
    """
    if not candidates:
        raise InputError("no manoeuvres to choose from; give --manoeuvres")
    goals, known = dict(goals or {}), known or KnownComponents.nothing()
    by_gyro = [START_HEADING.name] if relies_on_gyro(config) or config.environment.earth_rotation else []
    _check(goals, [label for b in beliefs(config).values() if b.estimate for label in b.variable.labels] + by_gyro)
    work = partial(predicted, config=config, duration=duration, sensors=sensors or SensorRates())
    each = in_workers(work, candidates, min(cores(), len(candidates)), progress)
    # what is considered is estimated where a manoeuvre shows it, which others may not do
    labels = tuple(label for label in each[0].labels if all(label in one.labels for one in each))
    seen = [one.of(labels) for one in each]
    _check(goals, labels)
    already = known.information(labels, seen[0].prior_sd)
    predictions = [_with(already, one, candidate) for one, candidate in zip(seen, candidates, strict=True)]
    wanted = {labels.index(name): sd for name, sd in goals.items()}
    score = [max(p.sd[i] / sd for i, sd in wanted.items()) if wanted else -p.bits for p in predictions]
    order = np.argsort(score, kind="stable").tolist()
    return Plan(
        labels,
        tuple(v.unit for v in seen[0].variables),
        _sd(already, seen[0].prior_sd),
        goals,
        [predictions[i] for i in order],
        [float(score[i]) for i in order],
        duration,
    )


def _check(goals: Mapping[str, float], estimated: Sequence[str]) -> None:
    """Refuse a goal for what is not estimated."""
    for name in goals:
        if name not in estimated:
            raise InputError(f"goal {name}: it is not estimated (estimated: {', '.join(estimated)}); give --estimate")


def path_of(manoeuvre: Manoeuvre, duration: float) -> Path:
    """A manoeuvre in calm water: the information from waves cannot be planned."""
    return scenario(manoeuvre.scenario, duration, manoeuvre.speed, Style(waves=CALM))


def predicted(manoeuvre: Manoeuvre, config: Config, duration: float, sensors: SensorRates) -> Observability:
    """Predicted observability of a manoeuvre by itself."""
    path, ship = path_of(manoeuvre, duration), None
    if manoeuvre.of_ship:
        ship, path = path, scenario("hold", duration, None, Style(waves=CALM))
        ship = ship.shifted([0.0, 0.0, -MANOEUVRE_DEPTH_M])
    elif manoeuvre.scenario in MANOEUVRES:
        path, config = _above_beacons(path, config)
    log, config = simulated(path, config, sensors, str(manoeuvre), ship)
    return examined(solved(log, config), config, noisy=False)


def simulated(
    path: Path, config: Config, sensors: SensorRates, source: str, ship: Path | None = None
) -> tuple[Log, Config]:
    """Log of a dive without noise, and the configuration for it: as written, with the start that the path has."""
    here = path.motion([0.0])
    start = (*here.p_n[0], *np.rad2deg(rpy_from_matrix(here.R_nb[0])))
    keys = ("north_m", "east_m", "down_m", "roll_deg", "pitch_deg", "heading_deg")
    stated = {key: float(x) for key, x in zip(keys, start, strict=True) if getattr(config.start, key) is not None}
    config = config.model_copy(update={**AS_WRITTEN, "delay_s": {}}).with_values(start=stated)
    truth = Truth(
        config, noise=False, imu_rate=sensors.imu_rate, dvl_rate=sensors.dvl_rate, fix_interval=sensors.fix_interval,
        ship=ship,
    )  # fmt: skip
    return Log.from_frame(simulate(path, truth, np.random.default_rng(0)).log_frame, source=source), config


def _above_beacons(path: Path, config: Config) -> tuple[Path, Config]:
    """A path above the first beacon, or where it is not known above the origin; beacons are linearised in their places.

    Their priors keep the uncertainty of the configuration.
    """
    if not config.beacons:
        return path, config
    believed, placed = beliefs(config), []
    start = path.motion([0.0]).p_n[0]
    for k, beacon in enumerate(config.beacons):
        place, down = (believed[name] for name in beacon_names(k))
        depth = float(start[2]) + ABOVE_BEACON_M if beacon.down_m is None else beacon.down_m
        known = {"north_m": place.mean[0], "east_m": place.mean[1], "sd_m": place.sd}
        placed.append(beacon.model_copy(update={**known, "down_m": depth, "down_sd_m": down.sd}))
    first = placed[0]
    above = np.array([first.north_m, first.east_m, max(float(first.down_m or 0.0) - ABOVE_BEACON_M, 1.0)])
    first_place = {"north_m": float(above[0]), "east_m": float(above[1])}
    shifted = path.shifted(above - [*np.zeros(2), start[2]])
    return shifted, config.with_values(beacons=tuple(placed), start=first_place)


def _with(already: Array, seen: Observability, manoeuvre: Manoeuvre) -> Prediction:
    together = already + seen.information
    return Prediction(manoeuvre, _sd(together, seen.prior_sd), joint_bits(together) - joint_bits(already))


def _sd(information: Array, prior_sd: Array) -> Array:
    """sd after information in units of the prior's sd."""
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(np.eye(len(prior_sd)) + information))) * prior_sd)
