"""The configuration: `Config`, and how it is read, completed, checked, written and described.

A configuration is YAML; every key is optional, an unknown key is an error. `Config` holds what an estimator assumes
about the vehicle, its sensors and the sea. `load_config` reads a file, `Config.to_yaml` writes the effective one,
`describe` lists all keys, `beliefs` gives the calibration variables of `rovgraph.model.calibration` their priors.
Native files complete a configuration only where it states no value itself.

Sections that depend on registered sensors and variables get their keys when their class is made; `add_key` and
`remove_key` change them afterwards, and the sections that contain them.

Noise and bias of an inertial unit are checked against each other. A sensor of density d, averaged at rest for a time T,
shows its bias to d / sqrt(T). A prior sharper than ten minutes of that is hardly ever justified. A prior that is far
wider belongs to a worse instrument: of the instruments whose data sheets state both (`rovgraph.model.presets`) the
widest offset is 250 sqrt(Hz) d.
"""

import io
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_origin

import numpy as np
from pydantic import BaseModel, BeforeValidator, Field, ValidationError, create_model, field_validator, model_validator
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from rovgraph import compatibility
from rovgraph.errors import InputError, as_path, kind_of, warn
from rovgraph.geometry import Array, matrix_from_rpy
from rovgraph.model.calibration import (
    AUTO,
    BEACONS,
    CONSIDERED,
    LAYERS,
    MOUNT,
    TABLE,
    USBL_MOUNT,
    Belief,
    Variable,
)
from rovgraph.model.config_errors import complaint, count
from rovgraph.model.config_sections import (
    ANGLES_TEXT,
    AS_WRITTEN,
    COLUMNS_TEXT,
    UNITS_TEXT,
    Angles,
    Beacon,
    ChartSettings,
    ConfigSection,
    DateSettings,
    Delays,
    Depth,
    Dvl,
    Environment,
    FileSettings,
    Fix,
    Graph,
    Heading,
    Imu,
    ImuNoise,
    Mag,
    MotionSettings,
    NotNegative,
    OnlineSettings,
    Place,
    Positive,
    RangeSettings,
    RegisteredSensors,
    SensorSettings,
    ShipSettings,
    Sound,
    StartSettings,
    TableSettings,
    TiltSettings,
    Triple,
    Usbl,
    Vehicle,
    Water,
)
from rovgraph.model.gauss_markov import stationary_walk
from rovgraph.model.origin import Frame, outgrows_plane
from rovgraph.model.presets import with_presets, without_presets

SHARPEST = 1.0 / np.sqrt(600.0)  # of the prior over the density [sqrt(Hz)]
WIDEST = 1000.0  # a fibre-optic gyro beside the bias of a MEMS gyro has 3000


def warn_of_mixed_grades(imu: Imu, source: str) -> None:
    """Warn where density and bias prior of gyro or accelerometer are not of one instrument.

    Parameters
    ----------
    imu : stated, filled in and default values
    source : of the configuration, for the message
    """
    gyr_sd = float(np.deg2rad(imu.gyr_bias_sd_dps))
    rows = (
        ("imu.noise.gyr", imu.noise.gyr, "imu.gyr_bias_sd_dps", imu.gyr_bias_sd_dps, gyr_sd),
        ("imu.noise.acc", imu.noise.acc, "imu.acc_bias_sd_mps2", imu.acc_bias_sd_mps2, imu.acc_bias_sd_mps2),
    )
    for noise, density, bias, shown, sd in rows:
        if sd > WIDEST * density:
            verdict = "is that of a much coarser instrument"
        elif sd < SHARPEST * density:
            verdict = "is that of a much finer instrument"
        else:
            continue
        text = f"{source}: {bias} = {shown:g} {verdict} than {noise} = {density:.3g}; state both of one data sheet"
        warn(text)


def considerable(variable: Variable) -> bool:
    """Whether it can be considered: what walks, lasts for a while, or moves stamps, is estimated or exact."""
    constant = variable.walk == 0.0 and not np.isfinite(variable.time_constant)
    return constant and not variable.time_offset


def looked_for(variable: Variable) -> bool:
    """Whether it can be left to the dive: what comes and goes, and is not estimated in any case, is looked for."""
    return bool(np.isfinite(variable.time_constant)) and not variable.estimate


def _components(dim: int) -> Callable[[Any], Any]:
    """Refuses what is neither one number for all components nor one for each; null passes."""
    expected = "expected a number" if dim == 1 else f"expected one number or {count(dim)}"

    def check(value: Any) -> Any:
        several = value if isinstance(value, list | tuple) else [value]
        if value is not None and not (len(several) in (1, dim) and all(map(_is_number, several))):
            raise PydanticCustomError("components", expected)
        return value

    return check


def _estimate(word: str) -> Callable[[Any], Any]:
    """Refuses what is neither true nor false nor a word."""

    def check(value: Any) -> Any:
        if not isinstance(value, bool) and value != word:
            raise PydanticCustomError("estimate", f"expected true, false or {word}")
        return value

    return check


def _estimate_of(variable: Variable) -> tuple[Any, Any, str]:
    """Type, default and choices of what is done with a variable."""
    if considerable(variable):
        kind = Annotated[bool | Literal["considered"], BeforeValidator(_estimate(CONSIDERED))]
        return kind, CONSIDERED if variable.considered else variable.estimate, "true, considered or false"
    if looked_for(variable):
        return Annotated[bool | Literal["auto"], BeforeValidator(_estimate(AUTO))], AUTO, "true, auto or false"
    return bool, variable.estimate, "estimate it"


def _sd_of(variable: Variable, scale: float, unit: str) -> tuple[Any, Any]:
    """Type and field of a prior's sd; null where it depends on the log."""
    sd, about = round(variable.sd * scale, 12), f"prior sd [{unit}]"
    if variable.unchecked_sd is None:
        return Positive, Field(sd, description=about)
    wide = round(variable.unchecked_sd * scale, 12)
    about += f"; null = {sd:g}, or {wide:g} where nothing checks the compass"
    return Positive | None, Field(None, description=about)


def _constant(entry: Any) -> Any:
    """Refuses what is considered and changes."""
    if entry.estimate == CONSIDERED:
        for key, value in ((key, getattr(entry, key)) for key in type(entry).model_fields):
            if key.startswith(("walk", "time_constant")) and value:
                raise PydanticCustomError("constant", f"expected estimate: true or false beside {key}")
    return entry


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < math.inf


def calibration_entry(variable: Variable) -> type[BaseModel]:
    """The configuration of one row of the calibration table, as a section."""
    tail = "_deg" if variable.angular else ""
    scale = float(np.rad2deg(1.0)) if variable.angular else 1.0
    unit = "degrees" if variable.angular else variable.unit
    mounted = variable.name in (*MOUNT, *USBL_MOUNT)
    kind, default, choices = _estimate_of(variable)
    fields: dict[str, Any] = {
        "estimate": (
            kind,
            Field(default, description=f"{choices}: {variable.about}. Shown by: {variable.excited_by}"),
        ),
        "mean" + tail: (
            Annotated[float | tuple[float, ...] | None, BeforeValidator(_components(variable.dim))],
            Field(None, description=f"prior mean [{unit}]; null = " + ("the mounting" if mounted else "0")),
        ),
        "sd" + tail: _sd_of(variable, scale, unit),
        "walk" + tail: (
            NotNegative,
            Field(round(variable.walk * scale, 12), description=f"random walk [{unit}/rts]; 0 = constant"),
        ),
        "time_constant_s": (
            Positive | None,
            Field(
                variable.time_constant if np.isfinite(variable.time_constant) else None,
                description="time constant of an error with that sd, in place of the walk; null = none",
            ),
        ),
    }
    checks: dict[str, Any] = {"constant": model_validator(mode="after")(_constant)}
    entry = create_model(
        f"Calibration_{variable.name}",
        __base__=ConfigSection,
        __module__=__name__,
        __doc__=variable.about,
        __validators__=checks,
        **fields,
    )
    globals()[entry.__name__] = entry  # where pickle looks for it
    return entry


_ENTRIES = {name: calibration_entry(v) for name, v in TABLE.items() if name not in LAYERS}  # which `Water` is about
Calibration: type[BaseModel] = create_model(
    "Calibration",
    __base__=ConfigSection,
    __module__=__name__,
    __doc__="Calibration variables: estimated, considered, or exact at their mean.",
    **{name: (entry, entry()) for name, entry in _ENTRIES.items()},  # type: ignore[call-overload]
)


def add_key(section: type[BaseModel], key: str, entry: type[BaseModel]) -> None:
    """Let a section have one key more, a section of its own that is all defaults.

    Raises
    ------
    ValueError : the section has that key already
    """
    if key in section.model_fields:
        raise ValueError(f"{section.__name__} has the key {key!r} already")
    section.model_fields[key] = FieldInfo(annotation=entry, default_factory=entry)
    _rebuild(section)


def remove_key(section: type[BaseModel], key: str) -> None:
    """Take a key out again."""
    del section.model_fields[key]
    _rebuild(section)


def _rebuild(section: type[BaseModel]) -> None:
    """Validate a section by the keys that it has now, wherever it stands."""
    section.model_rebuild(force=True)
    changed: list[object] = [section]
    for model in ConfigSection.__subclasses__():  # in the order of their making: what is inside another comes first
        if any(field.annotation is one for field in model.model_fields.values() for one in changed):
            model.model_rebuild(force=True)
            changed.append(model)


Model = TypeVar("Model", bound=BaseModel)


GOOD_GYRO_DPS = 0.1 / 3600.0  # sd of a bias beside which the transport rate counts


class Config(ConfigSection):
    """What an estimator believes; see docs/configuration.md for all keys."""

    version: Literal[1] = Field(1, description="of the keys and their meaning; a newer one is refused")
    name: str = Field("rovgraph", description="name, printed on figures")
    start: StartSettings = StartSettings()
    environment: Environment = Environment()
    imu: Imu = Imu()
    motion: MotionSettings = MotionSettings()
    dvl: Dvl = Dvl()
    heading: Heading = Heading()
    tilt: TiltSettings = TiltSettings()
    depth: Depth = Depth()
    fix: Fix = Fix()
    place: Place = Place()
    water: Water = Water()
    usbl: Usbl = Usbl()
    range: RangeSettings = RangeSettings()
    ship: ShipSettings = ShipSettings()
    sound: Sound = Sound()
    beacons: tuple[Beacon, ...] = Field(
        (),
        max_length=BEACONS,
        description="acoustic beacons on the bottom: name, and north_m, east_m, down_m where known",
    )
    sensors: RegisteredSensors = Field(default_factory=RegisteredSensors)
    calibration: Calibration = Field(default_factory=Calibration)
    vehicle: Vehicle = Vehicle()
    graph: Graph = Graph()
    chart: ChartSettings = ChartSettings()
    online: OnlineSettings = OnlineSettings()
    columns: dict[str, str] = Field(default_factory=dict, description=COLUMNS_TEXT)
    units: dict[str, str] = Field(default_factory=dict, description=UNITS_TEXT)
    angles: Angles = Field(default_factory=dict, description=ANGLES_TEXT)
    times: DateSettings = DateSettings()
    files: dict[str, FileSettings] = Field(
        default_factory=dict,
        description="name or pattern of a file: its own columns, units, angles, times, grid, delay_s",
    )
    delay_s: Delays = Field(
        {},
        description="sensor: how much older its measurements are than their stamps, in a log and online; e.g. fix: 2",
    )

    @field_validator("beacons")
    @classmethod
    def _of_different_names(cls, beacons: tuple[Beacon, ...]) -> tuple[Beacon, ...]:
        names = [str(beacon.name).strip().removesuffix(".0") for beacon in beacons]  # as logs write numbers
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise PydanticCustomError("named_twice", f"expected different names, two beacons are named {twice}")
        return beacons

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
        rest, former, delays = dict(online), online["delay_s"] or {}, data.get("delay_s") or {}
        del rest["delay_s"]
        if not isinstance(former, dict) or not isinstance(delays, dict):
            return data | {"online": rest, "delay_s": former if isinstance(delays, dict) else delays}
        if twice := sorted(map(str, former.keys() & delays.keys())):
            raise PydanticCustomError("stated_twice", f"delay_s and online.delay_s both name {twice[0]}; state it once")
        return data | {"online": rest, "delay_s": {**former, **delays}}

    def __repr__(self) -> str:
        stated = sorted(self.model_fields_set - {"version", "name"})
        return f"<Config {self.name}: states {', '.join(stated) or 'nothing'}>"

    @property
    def table(self) -> TableSettings:
        """How tables are written that `files` does not name."""
        return TableSettings(
            columns=self.columns, units=self.units, angles=self.angles, times=self.times, grid=self.environment.grid
        )

    def of_file(self, path: Path) -> FileSettings:
        """How a file is written: by the pattern of `files` that it fits, then by what holds for all.

        Raises
        ------
        InputError : two patterns fit it
        """
        fitting = [pattern for pattern in self.files if fits(path, pattern)]
        if len(fitting) > 1:
            raise InputError(f"{path}: files: both {fitting[0]!r} and {fitting[1]!r} fit it; state one of them")
        of_pattern = self.files[fitting[0]].model_dump(exclude_unset=True) if fitting else {}
        return FileSettings.model_validate(merged(self.table.model_dump(), of_pattern))

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

    def frame_at(self, latitude: float | None, away: float = 0.0, way: float = 0.0) -> Frame:
        """The frame of a dive, as stated or chosen.

        Parameters
        ----------
        latitude : of its origin, None where it is not known [deg]
        away, way : how far from the origin it is seen, and how far it goes [m]
        """
        env = self.environment
        if env.frame != "auto":
            return env.frame
        if latitude is None or env.earth_rotation is False or not env.has_latitude(latitude):
            return "flat"
        good = self.imu.gyr_bias_sd_dps <= GOOD_GYRO_DPS
        return "earth" if good or outgrows_plane(latitude, away, way) else "flat"

    def with_raw_magnetometer(self) -> "Config":
        """The same without a calibration of the magnetometer: its samples are what they are."""
        return self.with_values(imu={"mag": Mag()})

    def as_recorded(self) -> "Config":
        """The same for a log whose samples and stamps are taken as they are: without delays and speed of sound, too."""
        return self.with_raw_magnetometer().with_values(delay_s={}, dvl={"sound_speed_set_mps": None})

    @property
    def positioned_beacon(self) -> str | None:
        """Name of the vehicle among beacons whose positions are fixes; None = not stated."""
        stated = self.usbl.beacon if self.fix.beacon is None else self.fix.beacon
        return None if stated is None else str(stated)

    @property
    def matches_bottom(self) -> bool:
        """Whether soundings are to correct the track, by earlier lines or by a chart."""
        return self.graph.crossovers or self.chart.file is not None

    @property
    def knows_sound_speed(self) -> bool:
        """Whether the DVL's velocities are made by the speed of sound in the water."""
        true = self.dvl.sound_speed_mps, self.sound.profile, self.sound.salinity_psu
        return self.dvl.sound_speed_set_mps is not None and any(known is not None for known in true)


def register_settings(sensor: str, settings: type[SensorSettings], calibration: Sequence[Variable]) -> None:
    """Let a configuration have the keys of a sensor and of its calibration variables, which stand in `TABLE`."""
    add_key(RegisteredSensors, sensor, settings)
    for variable in calibration:
        add_key(Calibration, variable.name, calibration_entry(variable))


def unregister_settings(sensor: str, calibration: Sequence[Variable]) -> None:
    """Take the keys of a sensor and of its calibration variables out again."""
    remove_key(RegisteredSensors, sensor)
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

    An entry of ``calibration`` states it, and what `Variable.follows` from the rest of the configuration.
    """
    out = {}
    for name, variable in TABLE.items():
        entry, tail, unit = getattr(config.calibration, name, None), "", 1.0
        if variable.angular:
            tail, unit = "_deg", float(np.deg2rad(1.0))
        stated: dict[str, Any] = {"estimate": variable.estimate, "walk": variable.walk, "sd": variable.sd, "mean": 0.0}
        if entry is not None:
            mean, sd = getattr(entry, "mean" + tail), getattr(entry, "sd" + tail)
            stated |= {"estimate": entry.estimate, "walk": unit * getattr(entry, "walk" + tail)}
            stated |= {} if mean is None else {"mean": unit * np.atleast_1d(np.asarray(mean, dtype=float))}
            stated |= {} if sd is None else {"sd": unit * sd}
        stated |= {} if variable.follows is None else variable.follows(config, entry)
        lasts, done = None if entry is None else entry.time_constant_s, stated["estimate"]
        out[name] = Belief(
            variable,
            np.array(np.broadcast_to(stated["mean"], (variable.dim,)), dtype=float),
            stated["sd"],
            done is True,
            stated["walk"] if lasts is None else stationary_walk(stated["sd"], lasts),
            done == CONSIDERED,
            np.inf if lasts is None else lasts,
            streams=stated.get("streams"),
        )
    return out


def with_priors_stated(config: Config, unchecked: Collection[str] = (), names: Collection[str] | None = None) -> Config:
    """The configuration with the sds of priors that it leaves to the log or to other keys.

    Parameters
    ----------
    config : as stated
    unchecked : calibration variables of a compass without stated calibration that no sensor checks
    names : calibration variables that are stated; None = all
    """
    entries = {}
    for name, belief in beliefs(config).items():
        variable, entry = belief.variable, getattr(config.calibration, name, None)
        if entry is None or (names is not None and name not in names):
            continue
        key, unit = ("sd_deg", float(np.deg2rad(1.0))) if variable.angular else ("sd", 1.0)
        stated = getattr(entry, key)
        if stated is None or unit * stated != belief.sd:
            sd = (name in unchecked and variable.unchecked_sd) or belief.sd
            entries[name] = {key: round(float(np.rad2deg(sd)), 12) if variable.angular else sd}
    return config.with_values(calibration=entries)


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
    config = parse_model(Config, compatibility.with_keys_of_today(data), source)
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
    except (YAMLError, ValueError) as error:  # ValueError: an invalid date or number
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
    """Keys and values as an instance of a model; ``source`` names them in messages.

    Raises
    ------
    InputError : an unknown key (with the nearest known one), a value of the wrong kind
    """
    try:
        return model.model_validate(_without_empty(model, data))
    except ValidationError as error:
        said = dict.fromkeys(complaint(e, model) for e in error.errors())  # once for all items of a list
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


def completed(config: Config, settings: Mapping[str, Any], source: str) -> tuple[Config, dict[str, Any]]:
    """The configuration with the settings that it does not state itself.

    Parameters
    ----------
    settings : keys and values, nested as in YAML
    source : of the settings, for messages

    Returns
    -------
    config : Config
    used : dotted key -> value, of the settings that hold now

    Raises
    ------
    InputError : settings that no configuration may have
    """
    stated = config.model_dump(exclude_unset=True)
    used: dict[str, Any] = {}
    for path, value in leaves(settings):
        section = stated
        for name in path[:-1]:
            section = section.setdefault(name, {})
        if path[-1] not in section:
            section[path[-1]] = value
            used[".".join(path)] = value
    return (parse_model(Config, stated, source), used) if used else (config, {})


def leaves(settings: Mapping[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every path of names with its value.

    >>> list(leaves({"dvl": {"mount_rpy_deg": [180, 0, 0]}, "name": "dive"}))
    [(('dvl', 'mount_rpy_deg'), [180, 0, 0]), (('name',), 'dive')]
    """
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from leaves(value, (*above, str(name)))
        else:
            yield (*above, str(name)), value


__all__ = [
    "AS_WRITTEN",
    "Config",
    "FileSettings",
    "ImuNoise",
    "Mag",
    "SensorSettings",
    "TableSettings",
    "beliefs",
    "completed",
    "config_or_defaults",
    "describe",
    "load_config",
    "mount_matrix",
    "parse_config",
    "parse_model",
    "read_yaml",
    "register_settings",
    "unregister_settings",
    "with_priors_stated",
    "yaml_text",
]
