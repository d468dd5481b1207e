"""The configuration: YAML, every key optional, an unknown key is an error.

`Config` holds what an estimator believes about the vehicle, its sensors and the sea.
`load_config` reads a file, `Config.to_yaml` writes the effective one, `describe` lists
all keys, `beliefs` gives the calibration variables of `rovgraph.calibration` their priors.
"""

import difflib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from rovgraph.calibration import TABLE, Belief, Variable
from rovgraph.errors import InputError
from rovgraph.geometry import Array, matrix_from_rpy

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Triple = tuple[float, float, float]
PositiveTriple = tuple[Positive, Positive, Positive]
Loss = Literal["none", "huber", "cauchy"]
HeadingSource = Literal["mag", "dvl", "ahrs"]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, validate_default=True)


class Start(_Section):
    """Where the dive begins; null = from the log."""

    north_m: float = Field(0.0, description="north of the first epoch")
    east_m: float = Field(0.0, description="east of the first epoch")
    down_m: float | None = Field(None, description="depth of the first epoch; null = first depth sample, else 0")
    heading_deg: float | None = Field(None, description="heading; null = first heading samples")
    roll_deg: float | None = Field(None, description="roll; null = gravity")
    pitch_deg: float | None = Field(None, description="pitch; null = gravity")
    position_sd_m: Positive = Field(0.1, description="sd of the start's north, east and down")
    heading_sd_deg: Positive = Field(5.0, description="sd of the start's heading")
    tilt_sd_deg: Positive = Field(2.0, description="sd of the start's roll and pitch, where it begins at rest")


class Environment(_Section):
    """Gravity, magnetic field and Earth rate."""

    gravity_mps2: Positive = Field(9.81, description="gravity")
    latitude_deg: Annotated[float, Field(ge=-90, le=90)] | None = Field(
        None, description="latitude, for Earth rotation; null = of the first fix_lat"
    )
    declination_deg: float = Field(0.0, description="magnetic declination, east positive")
    field_norm: Positive | None = Field(
        None, description="magnitude of the field, log's unit; null = median of the log"
    )
    dip_deg: Annotated[float, Field(ge=-90, le=90)] | None = Field(
        None, description="dip of the field, down positive; null = from the log, against gravity"
    )
    earth_rotation: bool = Field(False, description="model the Earth's rotation (worth it for a FOG)")


class ImuNoise(_Section):
    """Noise densities, per root hertz."""

    acc: Positive = Field(8.0e-4, description="accelerometer [m/s2/rtHz]")
    gyr: Positive = Field(6.9e-4, description="gyro [rad/s/rtHz]")
    acc_walk: Positive = Field(3.0e-4, description="random walk of the accelerometer's bias [m/s2/rts]")
    gyr_walk: Positive = Field(1.0e-5, description="random walk of the gyro's bias [rad/s/rts]")


class Imu(_Section):
    """Inertial unit: mounting and noise."""

    mount_rpy_deg: Triple = Field((0.0, 0.0, 0.0), description="IMU axes to body axes: roll, pitch, yaw")
    lever_arm_m: Triple = Field((0.0, 0.0, 0.0), description="position of the IMU in body axes")
    noise: ImuNoise = ImuNoise()
    acc_bias_sd_mps2: Positive = Field(0.05, description="sd of the accelerometer's bias at the start")
    gyr_bias_sd_dps: Positive = Field(0.6, description="sd of the gyro's bias at the start, deg/s")
    max_gap_s: Positive = Field(30.0, description="a longer silence of the IMU is refused")


class Dvl(_Section):
    """Doppler velocity log: mounting and noise."""

    mount_rpy_deg: Triple = Field((0.0, 0.0, 0.0), description="DVL axes to body axes: roll, pitch, yaw")
    lever_arm_m: Triple = Field((0.0, 0.0, 0.0), description="position of the DVL in body axes")
    velocity_sd_mps: PositiveTriple = Field((0.01, 0.01, 0.01), description="noise of a ping, DVL axes")
    scale_sd: NotNegative = Field(0.0, description="part of the speed added to the noise of a ping")
    loss: Loss = Field("huber", description="robust loss")
    gate_sd: Positive | None = Field(6.0, description="a ping further off than this many sd is left out; null = never")
    max_speed_mps: Positive = Field(3.0, description="faster pings are left out")


class Heading(_Section):
    """Heading sources and their noise."""

    sources: tuple[HeadingSource, ...] | None = Field(
        None, description="of mag, dvl, ahrs; null = dvl, and mag or else ahrs, as far as the log has them"
    )
    mag_sd_deg: Positive = Field(2.0, description="noise of a magnetometer heading")
    dvl_sd_deg: Positive = Field(3.0, description="noise of the DVL's compass")
    ahrs_sd_deg: Positive = Field(3.0, description="noise of the IMU's own heading")
    loss: Loss = Field("huber", description="robust loss")
    gate_sd: Positive | None = Field(6.0, description="a heading further off than this many sd is left out")


class Depth(_Section):
    """Pressure sensor."""

    sd_m: Positive = Field(0.05, description="noise of a depth")
    lever_arm_m: Triple = Field((0.0, 0.0, 0.0), description="position of the pressure sensor in body axes")
    loss: Loss = Field("huber", description="robust loss")
    gate_sd: Positive | None = Field(6.0, description="a depth further off than this many sd is left out")


class Fix(_Section):
    """Position fixes."""

    sd_m: Positive = Field(2.0, description="noise of a fix, north and east; a fix's own fix_sd goes before it")
    lever_arm_m: Triple = Field((0.0, 0.0, 0.0), description="position of the antenna or transponder in body axes")
    loss: Loss = Field("huber", description="robust loss")
    gate_sd: Positive | None = Field(6.0, description="a fix further off than this many sd is left out")


class Graph(_Section):
    """How the graph is built and solved."""

    keyframe: Literal["dvl"] = Field("dvl", description="what makes a keyframe")
    max_gap_s: Positive = Field(1.0, description="longest time between keyframes")
    min_gap_s: NotNegative = Field(0.05, description="shortest time between keyframes; closer pings are attached")
    solver: Literal["batch", "isam2"] = Field("batch", description="of the smoothed estimate; isam2 is incremental")
    lag_s: Positive = Field(5.0, description="lag of the fixed-lag smoother, which gives the filtered estimate")


_MOUNT = ("dvl_roll", "dvl_pitch", "dvl_yaw")


def _calibration_entry(variable: Variable) -> type[BaseModel]:
    """The configuration of one row of the calibration table."""
    tail = "_deg" if variable.angular else ""
    scale = float(np.rad2deg(1.0)) if variable.angular else 1.0
    unit = "degrees" if variable.angular else variable.unit
    mounted = variable.name in _MOUNT
    fields: dict[str, Any] = {
        "estimate": (bool, Field(variable.estimate, description=f"estimate it: {variable.about}")),
        "mean" + tail: (
            float | tuple[float, ...] | None,
            Field(None, description=f"prior mean [{unit}]; null = " + ("the mounting" if mounted else "0")),
        ),
        "sd" + tail: (Positive, Field(round(variable.sd * scale, 12), description=f"prior sd [{unit}]")),
    }
    return create_model(
        f"Calibration_{variable.name}", __base__=_Section, __module__=__name__, __doc__=variable.about, **fields
    )


_ENTRIES = {name: _calibration_entry(v) for name, v in TABLE.items()}
globals().update({entry.__name__: entry for entry in _ENTRIES.values()})  # where pickle looks for them
Calibration: type[BaseModel] = create_model(
    "Calibration",
    __base__=_Section,
    __module__=__name__,
    __doc__="Calibration variables: fixed at their mean, or estimated.",
    **{name: (entry, entry()) for name, entry in _ENTRIES.items()},  # type: ignore[call-overload]
)


class Config(_Section):
    """What an estimator believes; see docs/configuration.md for all keys."""

    name: str = Field("rovgraph", description="name, printed on figures")
    start: Start = Start()
    environment: Environment = Environment()
    imu: Imu = Imu()
    dvl: Dvl = Dvl()
    heading: Heading = Heading()
    depth: Depth = Depth()
    fix: Fix = Fix()
    calibration: Calibration = Calibration()
    graph: Graph = Graph()
    columns: dict[str, str] = Field(default_factory=dict, description="rovgraph's column: the log's own name for it")
    units: dict[str, str] = Field(default_factory=dict, description="column or sensor: unit it is in, e.g. gyr: deg/s")

    def to_yaml(self) -> str:
        """The effective configuration, every key written out."""
        stream = io.StringIO()
        yaml = YAML(typ="safe", pure=True)
        yaml.default_flow_style, yaml.width = None, 4096
        yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
        yaml.dump(self.model_dump(mode="json"), stream)
        return stream.getvalue()


def mount_matrix(rpy_deg: Triple) -> Array:
    """R_bs of a mounting given as roll, pitch, yaw in degrees; shape (3, 3)."""
    return matrix_from_rpy(np.deg2rad(rpy_deg))


def beliefs(config: Config) -> dict[str, Belief]:
    """The prior of every calibration variable, in the order of the table.

    The mean of the DVL's angles is its mounting where the configuration gives none.

    Raises
    ------
    InputError : a mean with the wrong number of components
    """
    mount = dict(zip(_MOUNT, config.dvl.mount_rpy_deg, strict=True))
    out = {}
    for name, variable in TABLE.items():
        entry, tail = getattr(config.calibration, name), "_deg" if variable.angular else ""
        unit = float(np.deg2rad(1.0)) if variable.angular else 1.0
        mean = getattr(entry, "mean" + tail)
        mean = mount.get(name, 0.0) if mean is None else mean
        values = np.atleast_1d(np.asarray(mean, dtype=float))
        if values.size not in (1, variable.dim):
            raise InputError(f"calibration.{name}.mean{tail}: {values.size} numbers, expected {variable.dim}")
        out[name] = Belief(
            variable,
            unit * np.broadcast_to(values, (variable.dim,)),
            unit * getattr(entry, "sd" + tail),
            entry.estimate,
        )
    return out


def load_config(path: Path | str | None = None) -> Config:
    """Read a YAML configuration; without a path, all defaults.

    Raises
    ------
    InputError : no such file, no YAML, an unknown key (with the nearest known one), a
        value of the wrong kind
    """
    if path is None:
        return Config()
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as a configuration ({_reason(error)})") from None
    return parse_config(text, str(path))


def parse_config(text: str, source: str = "configuration") -> Config:
    """Parse YAML text; ``source`` names it in messages."""
    try:
        data = YAML(typ="safe", pure=True).load(text)
    except YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" line {mark.line + 1}" if mark else ""
        problem = str(getattr(error, "problem", None) or "cannot be parsed").splitlines()[0]
        raise InputError(f"{source}{where}: no valid YAML ({problem})") from None
    if data is None:
        data = {}
    if not isinstance(data, dict):
        raise InputError(f"{source}: expected keys and values at the top, found a {type(data).__name__}")
    try:
        return Config.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{source}: " + "; ".join(_complaint(e) for e in error.errors())) from None


def _reason(error: OSError | UnicodeDecodeError) -> str:
    return error.strerror or str(error) if isinstance(error, OSError) else "not UTF-8 text"


def _known_keys(location: tuple[int | str, ...]) -> list[str]:
    """Keys that are known beside the one at ``location``."""
    model: Any = Config
    for part in location[:-1]:
        annotation = model.model_fields[str(part)].annotation
        model = annotation
    return list(model.model_fields)


def _complaint(error: Any) -> str:
    """One validation error as a phrase that names key, problem and remedy."""
    location = error["loc"]
    key = ".".join(str(part) for part in location)
    if error["type"] == "extra_forbidden":
        known = _known_keys(location)
        near = difflib.get_close_matches(str(location[-1]), known, 1, cutoff=0.0)
        return f"unknown key {key}, nearest known key is {'.'.join([*map(str, location[:-1]), near[0]])}"
    return f"{key}: {error['msg'][0].lower()}{error['msg'][1:]} (found {error['input']!r})"


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
            default = info.get_default(call_default_factory=True)
            shown = "null" if default is None else str(list(default) if isinstance(default, tuple) else default)
            yield prefix + name, shown, info.description or ""
