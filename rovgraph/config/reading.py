"""`Config`, and how it is read, written and described."""

import io
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, get_origin

import numpy as np
from pydantic import BaseModel, Field, ValidationError, model_validator
from pydantic_core import PydanticCustomError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from rovgraph import compatibility
from rovgraph.calibration import CONSIDERED, MOUNT, TABLE, Belief, Variable
from rovgraph.config.error_messages import complaint
from rovgraph.config.grades import warn_of_mixed_grades
from rovgraph.config.presets import with_presets, without_presets
from rovgraph.config.priors import Calibration, calibration_entry
from rovgraph.config.registered import add_key, remove_key
from rovgraph.config.sections import (
    ANGLES_TEXT,
    COLUMNS_TEXT,
    UNITS_TEXT,
    Angles,
    Delays,
    Depth,
    Dvl,
    Environment,
    FileSettings,
    Fix,
    Graph,
    Heading,
    Imu,
    Mag,
    Motion,
    Online,
    Place,
    Section,
    Sensors,
    SensorSettings,
    Start,
    TableSettings,
    Tilt,
    Times,
    Triple,
    Vehicle,
)
from rovgraph.errors import InputError, as_path, kind_of
from rovgraph.gauss_markov import stationary_walk
from rovgraph.geometry import Array, matrix_from_rpy

Model = TypeVar("Model", bound=BaseModel)


class Config(Section):
    """What an estimator believes; see docs/configuration.md for all keys."""

    version: Literal[1] = Field(1, description="of the keys and their meaning; a newer one is refused")
    name: str = Field("rovgraph", description="name, printed on figures")
    start: Start = Start()
    environment: Environment = Environment()
    imu: Imu = Imu()
    motion: Motion = Motion()
    dvl: Dvl = Dvl()
    heading: Heading = Heading()
    tilt: Tilt = Tilt()
    depth: Depth = Depth()
    fix: Fix = Fix()
    place: Place = Place()
    sensors: Sensors = Field(default_factory=Sensors)
    calibration: Calibration = Field(default_factory=Calibration)
    vehicle: Vehicle = Vehicle()
    graph: Graph = Graph()
    online: Online = Online()
    columns: dict[str, str] = Field(default_factory=dict, description=COLUMNS_TEXT)
    units: dict[str, str] = Field(default_factory=dict, description=UNITS_TEXT)
    angles: Angles = Field(default_factory=dict, description=ANGLES_TEXT)
    times: Times = Times()
    files: dict[str, FileSettings] = Field(
        default_factory=dict,
        description="name or pattern of a file: its own columns, units, angles, times, delay_s",
    )
    delay_s: Delays = Field(
        {},
        description="sensor: how much older its measurements are than their stamps, in a log and online; e.g. fix: 2",
    )

    @model_validator(mode="before")
    @classmethod
    def _with_presets(cls, data: Any) -> Any:
        """What the presets of IMU and DVL state and the configuration does not."""
        return with_presets(data) if isinstance(data, dict) else data

    @model_validator(mode="before")
    @classmethod
    def _with_delays_of_online(cls, data: Any) -> Any:
        """``online.delay_s``, the key's former place, still holds, unless both name the same sensor."""
        online = data.get("online") if isinstance(data, dict) else None
        if not isinstance(online, dict) or "delay_s" not in online:
            return data
        rest, former, own = dict(online), online["delay_s"] or {}, data.get("delay_s") or {}
        del rest["delay_s"]
        if not isinstance(former, dict) or not isinstance(own, dict):
            return data | {"online": rest, "delay_s": former if isinstance(own, dict) else own}
        if twice := sorted(map(str, former.keys() & own.keys())):
            raise PydanticCustomError("stated_twice", f"delay_s and online.delay_s both name {twice[0]}; state it once")
        return data | {"online": rest, "delay_s": {**former, **own}}

    @property
    def table(self) -> TableSettings:
        """How tables are written that `files` does not name."""
        return TableSettings(columns=self.columns, units=self.units, angles=self.angles, times=self.times)

    def of_file(self, path: Path) -> FileSettings:
        """How a file is written: by the pattern of `files` that it fits, then by what holds for all.

        Raises
        ------
        InputError : two patterns fit it
        """
        fitting = [pattern for pattern in self.files if fits(path, pattern)]
        if len(fitting) > 1:
            raise InputError(f"{path}: files: both {fitting[0]!r} and {fitting[1]!r} fit it; state one of them")
        own = self.files[fitting[0]].model_dump(exclude_unset=True) if fitting else {}
        return FileSettings.model_validate(merged(self.table.model_dump(), own))

    def to_yaml(self) -> str:
        """The effective configuration, every key written out."""
        return yaml_text(self.model_dump(mode="json"))

    def changed(self, **keys: Any) -> "Config":
        """The same configuration with other values of some keys; the keys that are not named stay.

        >>> config = Config().changed(dvl={"mount_rpy_deg": [180, 0, -45]}, units={"gyr": "deg/s"})
        >>> config.dvl.mount_rpy_deg
        (180.0, 0.0, -45.0)

        Parameters
        ----------
        keys : keys and values as in YAML, sections as dicts; a section given as None gets its defaults

        Raises
        ------
        InputError : an unknown key (with the nearest known one), a value of the wrong kind

        Warns
        -----
        DataWarning : noise of one grade beside a bias prior of another
        """
        stated = without_presets(self.model_dump(exclude_unset=True), keys)
        return _parse_config(merged(stated, keys), "changed")

    def with_raw_magnetometer(self) -> "Config":
        """The same without a calibration of the magnetometer: its samples are what they are."""
        return self.model_copy(update={"imu": self.imu.model_copy(update={"mag": Mag()})})

    def as_recorded(self) -> "Config":
        """The same for a log whose samples and stamps are taken as they are: without delays, too."""
        return self.with_raw_magnetometer().model_copy(update={"delay_s": {}})


def register_settings(sensor: str, settings: type[SensorSettings], calibration: Sequence[Variable]) -> None:
    """Let a configuration have the keys of a sensor and of its calibration variables, which stand in `TABLE`."""
    add_key(Sensors, sensor, settings)
    for variable in calibration:
        add_key(Calibration, variable.name, calibration_entry(variable))


def unregister_settings(sensor: str, calibration: Sequence[Variable]) -> None:
    """Take the keys of a sensor and of its calibration variables out again."""
    remove_key(Sensors, sensor)
    for variable in calibration:
        remove_key(Calibration, variable.name)


def yaml_text(data: dict[str, Any]) -> str:
    """Keys and values as YAML."""
    stream = io.StringIO()
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style, yaml.width = None, 4096
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.dump(data, stream)
    return stream.getvalue()


def fits(path: Path, pattern: str) -> bool:
    """Whether a pattern of `Config.files` names a file, by its name or by the end of its path."""
    return path.name == pattern or path.match(pattern)


def mount_matrix(rpy_deg: Triple) -> Array:
    """R_bs of a mounting given as roll, pitch, yaw in degrees; shape (3, 3)."""
    return matrix_from_rpy(np.deg2rad(rpy_deg))


def beliefs(config: Config) -> dict[str, Belief]:
    """The prior of every calibration variable, in the order of the table.

    The mean of the DVL's angles is its mounting where the configuration gives none.
    """
    mount = dict(zip(MOUNT, config.dvl.mount_rpy_deg, strict=True))
    out = {}
    for name, variable in TABLE.items():
        entry, tail = getattr(config.calibration, name), "_deg" if variable.angular else ""
        unit = float(np.deg2rad(1.0)) if variable.angular else 1.0
        mean = getattr(entry, "mean" + tail)
        mean = mount.get(name, 0.0) if mean is None else mean
        values = np.atleast_1d(np.asarray(mean, dtype=float))
        stated, walk = getattr(entry, "sd" + tail), unit * getattr(entry, "walk" + tail)
        sd = variable.sd if stated is None else unit * stated
        lasts = entry.time_constant_s
        out[name] = Belief(
            variable,
            unit * np.broadcast_to(values, (variable.dim,)),
            sd,
            entry.estimate is True,
            walk if lasts is None else stationary_walk(sd, lasts),
            entry.estimate == CONSIDERED,
            np.inf if lasts is None else lasts,
        )
    return out


def with_priors_stated(config: Config, unchecked: Collection[str] = (), names: Collection[str] | None = None) -> Config:
    """The configuration with the sds of priors that it leaves to the log.

    Parameters
    ----------
    config : as stated
    unchecked : calibration variables of a compass that nobody calibrated and nothing checks
    names : calibration variables that are stated; None = all
    """
    given, entries = config.calibration, {}
    for name in TABLE if names is None else names:
        variable, entry = TABLE[name], getattr(given, name)
        key = "sd_deg" if variable.angular else "sd"
        if getattr(entry, key) is None:
            sd = (name in unchecked and variable.unchecked_sd) or variable.sd
            sd = round(float(np.rad2deg(sd)), 12) if variable.angular else sd
            entries[name] = entry.model_copy(update={key: sd})
    return config.model_copy(update={"calibration": given.model_copy(update=entries)})


def load_config(path: Path | str | None = None) -> Config:
    """Read a YAML configuration; without a path, all defaults.

    Raises
    ------
    InputError : no such file, no YAML, an unknown key (with the nearest known one), a
        value of the wrong kind
    """
    return Config() if path is None else _parse_config(read_yaml(as_path(path, "configuration")), str(path))


def config_or_defaults(config: Config | None) -> Config:
    """A configuration as a caller gave it; None = all defaults.

    Raises
    ------
    InputError : it is something else, such as the name of a file
    """
    if config is None:
        return Config()
    if not isinstance(config, Config):
        raise InputError(f"config: expected a Config, as load_config gives it, found {kind_of(config)}")
    return config


def parse_config(text: str, source: str = "configuration") -> Config:
    """Parse YAML text; ``source`` names it in messages.

    Raises
    ------
    InputError : no text, no valid YAML, or a key or value that a configuration does not have
    """
    if not isinstance(text, str):
        raise InputError(f"{source}: expected YAML text, found {kind_of(text)}")
    return _parse_config(_parse_yaml(text, source), source)


def merged(stated: Mapping[str, Any], keys: Mapping[str, Any]) -> dict[str, Any]:
    """Nested keys and values with others in their place; dicts are merged, whatever else is replaced.

    >>> merged({"dvl": {"preset": "a", "ping_due_s": 1}}, {"dvl": {"preset": "b"}, "name": "dive"})
    {'dvl': {'preset': 'b', 'ping_due_s': 1}, 'name': 'dive'}
    """
    out = dict(stated)
    for key, value in keys.items():
        before = out.get(key)
        nested = isinstance(value, Mapping)
        out[key] = merged(before if isinstance(before, Mapping) else {}, value) if nested else value
    return out


def _parse_config(data: dict[str, Any], source: str) -> Config:
    compatibility.refuse_newer(data.get("version"), compatibility.CONFIGURATION, f"{source}: configuration")
    config = parse_model(Config, data, source)
    warn_of_mixed_grades(config.imu, source)
    return config


def read_yaml(path: Path) -> dict[str, Any]:
    """Keys and values of a YAML file.

    Raises
    ------
    InputError : no such file, no YAML, no keys and values
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as a configuration ({_reason(error)})") from None
    return _parse_yaml(text, str(path))


def _parse_yaml(text: str, source: str) -> dict[str, Any]:
    try:
        data = YAML(typ="safe", pure=True).load(text)
    except (YAMLError, ValueError) as error:  # ValueError: a date or a number that is none
        mark = getattr(error, "problem_mark", None)
        where = f" line {mark.line + 1}" if mark else ""
        problem = str(getattr(error, "problem", None) or error or "cannot be parsed").splitlines()[0]
        raise InputError(f"{source}{where}: not valid YAML ({problem})") from None
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise InputError(f"{source}: expected keys and values at the top, found {kind_of(data)}")
    return data


def parse_model(model: type[Model], data: dict[str, Any], source: str) -> Model:
    """What keys and values say, by a model that knows all of its keys; ``source`` names them in messages.

    Raises
    ------
    InputError : an unknown key (with the nearest known one), a value of the wrong kind
    """
    try:
        return model.model_validate(_without_empty(model, data))
    except ValidationError as error:
        said = dict.fromkeys(complaint(e, model) for e in error.errors())  # each item that a list lacks says the same
        raise InputError(f"{source}: " + "; ".join(said)) from None


def _reason(error: OSError | UnicodeDecodeError) -> str:
    return error.strerror or str(error) if isinstance(error, OSError) else "not UTF-8 text"


def _without_empty(model: type[BaseModel], data: dict[str, Any]) -> dict[str, Any]:
    """Keys and values without sections that have nothing below them, so that their defaults hold."""
    out = {}
    for key, value in data.items():
        kind = model.model_fields[key].annotation if key in model.model_fields else None
        section = isinstance(kind, type) and issubclass(kind, BaseModel)
        if value is None and (section or get_origin(kind) is dict):
            continue
        out[key] = _without_empty(kind, value) if section and isinstance(value, dict) else value  # type: ignore[arg-type]
    return out


def describe(model: type[BaseModel] = Config, prefix: str = "") -> Iterator[tuple[str, str, str]]:
    """Every key with its default and meaning.

    Yields
    ------
    key, default, meaning : str
    """
    for name, info in model.model_fields.items():
        kind = info.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from describe(kind, f"{prefix}{name}.")
        else:
            default = model.model_construct().model_dump(mode="json")[name]
            yield prefix + name, "null" if default is None else str(default), info.description or ""
