"""A sensor in one place: its stream, model, noise, admission, what it observes, and its checks.

A `Sensor` holds everything about one sensor; `SENSORS` has every sensor by the name of its log stream. Log reader,
assembly, estimators, simulator, checks and the online mode read it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Protocol, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rovgraph.geometry import Array
from rovgraph.model import calibration
from rovgraph.model.calibration import Variable
from rovgraph.model.config import Config, SensorSettings, register_settings, unregister_settings
from rovgraph.sensors.model import SensorModel

RESERVED = (
    "time",
    "received",
    "fix_lat",
    "fix_lon",
    "ship_lat",
    "ship_lon",
)  # columns of a log that belong to no sensor
LARGEST_SD = 1e6  # of a measurement's own: larger ones add no information, and overflow
NINES = tuple(10.0**n - 10.0**-d for n in range(2, 7) for d in range(3))  # 99, 99.9, 99.99, 999 ...
PLACEHOLDERS = (*NINES, 65.535, 655.35)  # these and the largest of 16 bits stand for an sd or a variance of any size
MOSTLY = 0.5  # share of a sensor's sds, from which on they are placeholders; fewer belong to uninformative measurements

Quantity = Literal["acceleration", "rate", "field", "angle", "speed", "length", "area", "pressure", "duration"]
Frame = Literal["position", "velocity", "heading"]
Level = Literal["ok", "warning", "error"]
# what a check may find: data that are wrong, and remain so in an estimate; or not
Fault = Literal[
    "axes", "sign", "unit", "scale", "swapped", "turned", "contradiction", "epoch", "lag", "jump", "bursts",
    "saturated", "stuck", "zero", "start", "current",
]  # fmt: skip
Remark = Literal[
    "", "missing", "frozen", "gap", "rate", "jitter", "repeats", "spikes", "bottom lock", "speed", "iron",
]  # fmt: skip
Kind = Fault | Remark
Said = tuple[Level, str] | tuple[Level, str, Kind]  # a sensor of its own values


@dataclass(frozen=True)
class Column:
    """A column of a log.

    Attributes
    ----------
    name : as the log has it
    quantity : what it measures, which defines the units that a log may use; None = a number without a unit
    optional : a measurement is complete without it
    group : the name under which a log's unit is declared; None = the sensor's
    largest : of a measurement's own sd, the limit of such instruments; None = it has no sd, or one of any size
    label : it holds names, as text or numbers
    flag : it holds 0 and 1
    """

    name: str
    quantity: Quantity | None = None
    optional: bool = False
    group: str | None = None
    largest: float | None = None
    label: bool = False
    flag: bool = False

    def __post_init__(self) -> None:
        if self.quantity is not None and self.quantity not in get_args(Quantity):
            raise ValueError(f"column {self.name}: {self.quantity!r} is none of {', '.join(get_args(Quantity))}")

    @property
    def is_sd(self) -> bool:
        """Whether it is a measurement's own standard deviation."""
        return self.optional and self.name.endswith("_sd")


@dataclass(frozen=True)
class Observed:
    """In which frame, and along which axes, an error of the state shows in a sensor at once.

    Attributes
    ----------
    frame : "position" in n, "velocity" in n, or "heading"
    axes : of 0, 1, 2
    """

    frame: Frame
    axes: tuple[int, ...] = (0, 1, 2)


@dataclass(frozen=True)
class Instrument:
    """A measurement model and the belief about its noise.

    Attributes
    ----------
    model : the measurement model
    sd : ndarray, shape (dim,), standard deviation of a measurement
    loss : "none", "huber" or "cauchy"
    gate_sd : normalised innovation beyond which a measurement is left out, or None
    readmit_s : time of being left out after which a filter doubts itself [s]
    components : names of the components, dim of them
    rate_gain : ndarray, shape (dim, 3), how an error of the measured rate [rad/s] enters:
        through the DVL's lever arm, at the nominal mounting
    time_offset : name of the calibration variable of how late its stamps are, or None
    """

    model: SensorModel
    sd: Array
    loss: str
    gate_sd: float | None
    readmit_s: float
    components: tuple[str, ...]
    rate_gain: Array
    time_offset: str | None = None

    @property
    def calibration(self) -> tuple[str, ...]:
        """Calibration variables that its measurements depend on."""
        of_model = self.model.calibration
        return of_model if self.time_offset in (None, *of_model) else (*of_model, str(self.time_offset))


class Limits(Protocol):
    """A section of the configuration with the noise of a sensor."""

    @property
    def loss(self) -> str: ...
    @property
    def gate_sd(self) -> float | None: ...


def instrument(
    limits: Limits,
    model: SensorModel,
    sd: ArrayLike,
    components: tuple[str, ...],
    rate_gain: Array | None = None,
    time_offset: str | None = None,
) -> Instrument:
    """A model with noise, and with loss, gate and readmission as a section of the configuration has them.

    Parameters
    ----------
    limits : the section; without ``readmit_s`` the sensor is never readmitted
    model, components, time_offset : of `Instrument`
    sd : of each component, or one for all
    rate_gain : of `Instrument`; None = an error of the rate does not enter
    """
    gain = np.zeros((model.dim, 3)) if rate_gain is None else rate_gain
    spread = np.broadcast_to(np.asarray(sd, float), (model.dim,))
    readmit_s = getattr(limits, "readmit_s", np.inf)
    return Instrument(model, spread, limits.loss, limits.gate_sd, readmit_s, components, gain, time_offset)


def none_refused(values: Array, config: Config) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """No reason to leave out any measurement."""
    yield from ()


def of_instrument(values: Array, believed: Instrument, config: Config) -> Array:
    """The instrument's standard deviation, shape (dim,)."""
    return believed.sd


def own_sd(column: int) -> Callable[[Array, Instrument, Config], Array]:
    """A measurement's own standard deviation, in a column of its stream, where it is known."""

    def standard_deviation(values: Array, believed: Instrument, config: Config) -> Array:
        sd = float(values[column])
        return np.full(len(believed.sd), min(sd, LARGEST_SD)) if sd > 0.0 else believed.sd

    return standard_deviation


def placeholders(column: Column, sd: Array) -> NDArray[np.bool_]:
    """Which sds of measurements mark a missing estimate: 9999, 99.99, 65.535, or beyond reason.

    Parameters
    ----------
    column : that holds them
    sd : ndarray, shape (n,), NaN where a measurement has none
    """
    known = np.array(PLACEHOLDERS)
    stands = np.isclose(sd[:, None], known, rtol=1e-6, atol=0.0).any(axis=1)
    stands |= np.isclose(np.square(sd)[:, None], known[known > 900.0], rtol=1e-6, atol=0.0).any(axis=1)  # a variance
    return np.asarray(stands | (sd > (np.inf if column.largest is None else column.largest)))


def nothing_found(values: Array, config: Config) -> Iterator[Said]:
    """A check without findings."""
    yield from ()


@dataclass(frozen=True)
class Sensor:
    """A sensor: its stream, model, noise, admission and checks.

    Attributes
    ----------
    name : of its log stream
    columns : of the stream; the first ``dim`` are the measurement
    instrument : from the configuration, and the point of the body that the state belongs to, shape (3,) [m], to the
        model with its noise; None where it is logged only
    refused : from columns, shape (n, k), and the configuration to reasons to leave measurements out, each with a
        mask, shape (n,); the first that holds counts
    standard_deviation : from the columns of one measurement, shape (k,), the instrument and the configuration to its
        sd, shape (dim,), or of two components to both sds and their covariance, shape (3,)
    once_per_interval : taken once between keyframes, as its errors last longer than that
    observes : what a filter inflates when it readmits the sensor
    linear_in : of built-in sensors, the variable that the model is linear in whatever the others are, which gives
        the filter's error its coordinates
    heading_source : of built-in compasses, the name in ``heading.sources``, which selects it
    may_begin_later : a dive online may begin before its first measurement; a compass's, where ``heading.sources``
        is given
    occasional : it measures only now and then, so gaps are normal
    usual_rates : slowest and fastest that make sense [Hz]
    if_missing : what it means that a log has none
    look : what is wrong or worth knowing of its values, from columns, shape (n, k), and the configuration: level, text
        and kind, "" where that is left out
    simulated_hz : rate at which a simulated dive samples its model with white noise; None = the simulator has a
        sampler of its own for it, or none
    calibration : variables that come with it, beside the built-in ones
    complete : from columns, shape (n, k), to the rows that are measurements, for one that may be written in several
        ways; None = those with all columns that are not optional
    together : the columns that such a row needs, for people
    settings : keys of its section of the configuration, under ``sensors``; None = those of `SensorSettings`
    """

    name: str
    columns: tuple[Column, ...]
    instrument: Callable[[Config, Array], Instrument] | None = None
    refused: Callable[[Array, Config], Iterator[tuple[str, NDArray[np.bool_]]]] = none_refused
    standard_deviation: Callable[[Array, Instrument, Config], Array] = of_instrument
    once_per_interval: bool = False
    observes: Observed = Observed("velocity")
    linear_in: str | None = None
    heading_source: str | None = None
    may_begin_later: bool = False
    occasional: bool = False
    usual_rates: tuple[float, float] = (0.0, np.inf)
    if_missing: tuple[Level, str] | None = None
    look: Callable[[Array, Config], Iterator[Said]] = nothing_found
    simulated_hz: float | None = None
    calibration: tuple[Variable, ...] = ()
    complete: Callable[[Array], NDArray[np.bool_]] | None = None
    together: str = ""
    settings: type[SensorSettings] | None = None

    @cached_property
    def column_names(self) -> tuple[str, ...]:
        """Of all columns."""
        return tuple(column.name for column in self.columns)

    @cached_property
    def required(self) -> tuple[str, ...]:
        """Names of the columns without which a measurement is not complete."""
        return tuple(column.name for column in self.columns if not column.optional)


SENSORS: dict[str, Sensor] = {}  # by name, in the order of a log's columns


def register(sensor: Sensor) -> None:
    """Register a sensor, its calibration variables and its section of the configuration.

    Do so before a configuration is loaded, and in every process that works with the sensor.

    Raises
    ------
    ValueError : its name, a column, or a calibration variable's name or letter is taken; it has what only built-in
        sensors have
    """
    if sensor.linear_in is not None or sensor.heading_source is not None:
        raise ValueError(f"sensor {sensor.name!r}: linear_in and heading_source are for built-in sensors")
    columns = [column for known in SENSORS.values() for column in known.columns]
    groups = {column.group for column in columns}
    taken = {sensor.name} & (set(SENSORS) | groups) or set(sensor.column_names) & {
        *RESERVED,
        *(c.name for c in columns),
    }
    if taken:
        raise ValueError(f"sensor {sensor.name!r}: the name {min(map(str, taken))!r} is taken")
    _register_calibration(sensor.calibration)
    register_settings(sensor.name, sensor.settings or SensorSettings, sensor.calibration)
    SENSORS[sensor.name] = sensor


def _register_calibration(variables: tuple[Variable, ...]) -> None:
    """Register all variables, or none."""
    for k, variable in enumerate(variables):
        try:
            calibration.register(variable)
        except ValueError:
            for before in reversed(variables[:k]):
                calibration.unregister(before.name)
            raise


def unregister(name: str) -> None:
    """Forget the sensor that was registered last, as a test does that registers one of its own.

    Raises
    ------
    ValueError : calibration variables of another one were registered after its own
    """
    sensor = SENSORS[name]
    for variable in reversed(sensor.calibration):
        calibration.unregister(variable.name)
    unregister_settings(name, sensor.calibration)
    del SENSORS[name]


def settings(config: Config, sensor: str) -> SensorSettings:
    """Section of a configuration on a registered sensor."""
    section: SensorSettings = getattr(config.sensors, sensor)
    return section
