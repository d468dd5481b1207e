"""The plan of a study: a YAML file of cells, mostly as the product of lists, and the vehicle of each cell.

A cell has the estimator's configuration and the true values. Grades of inertial units, noise densities per root hertz:

- mti: Xsens MTi, the figures of ``rovgraph/config/falcon.yaml`` (thesis, appendix A; data sheet for the biases).
- tactical: Sensonor STIM300 by its data sheet: 0.15 deg/rt(h), 0.06 m/s/rt(h), on-off bias of the
  accelerometer 0.75 mg, of the gyro 10 deg/h over temperature. Walks are a choice: the bias
  instability (0.5 deg/h, 0.05 mg) gained in ten minutes.
- fog: a choice, of the class of a fibre-optic unit with MEMS accelerometers: 0.012 deg/rt(h), 0.12 mg
  per root hertz, biases 1 deg/h and 0.5 mg; walks that gain 0.05 deg/h and 0.05 mg in ten minutes.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, Field, create_model
from pydantic.fields import FieldInfo

from rovgraph.errors import InputError
from rovgraph.geometry import wrap_angle
from rovgraph.model.config import Config, load_config, parse_model, read_yaml, yaml_text
from rovgraph.model.config_sections import ConfigSection, Positive
from rovgraph.simulate import scenario

Grade = Literal["mti", "tactical", "fog"]
HeadingSources = Literal["mag", "dvl", "ahrs", "mag+dvl"]
HeadingError = Literal["none", "offset", "deviation", "both"]

_MILLI_G, _DEG_PER_H, _TEN_MINUTES = 9.81e-3, float(np.deg2rad(1.0)) / 3600.0, 600.0


def _imu(acc: float, gyr: float, acc_walk: float, gyr_walk: float, acc_bias: float, gyr_bias_dps: float) -> Any:
    noise = {"acc": acc, "gyr": gyr, "acc_walk": acc_walk, "gyr_walk": gyr_walk}
    return {"noise": noise, "acc_bias_sd_mps2": acc_bias, "gyr_bias_sd_dps": gyr_bias_dps}


def _gained(bias: float) -> float:
    """Random walk that gains a bias in ten minutes."""
    return float(bias / np.sqrt(_TEN_MINUTES))


GRADES: Mapping[str, dict[str, Any]] = MappingProxyType(
    {
        "mti": _imu(7.82e-4, 6.37e-4, 3.0e-4, 1.0e-5, 0.02, 0.5),
        "tactical": _imu(
            0.06 / 60.0, float(np.deg2rad(0.15)) / 60.0, _gained(0.05 * _MILLI_G), _gained(0.5 * _DEG_PER_H),
            0.75 * _MILLI_G, 10.0 / 3600.0,
        ),
        "fog": _imu(
            0.12 * _MILLI_G, float(np.deg2rad(0.012)) / 60.0, _gained(0.05 * _MILLI_G), _gained(0.05 * _DEG_PER_H),
            0.5 * _MILLI_G, 1.0 / 3600.0,
        ),
    }
)  # fmt: skip

COMPASS = MappingProxyType({"mag": "mag", "dvl": "dvl_compass", "ahrs": "ahrs"})  # source: prefix of its variables
IRON = ("hard_iron", "soft_iron")  # a study's compasses err only as stated


def believed(
    vehicle: Config,
    grade: Grade,
    headings: HeadingSources,
    heading_error: HeadingError,
    heading_error_sd_deg: float,
    fix_sd_m: float | None,
    prior_deg: tuple[float, float],
) -> Config:
    """The configuration for the estimator of a run; the simulator draws the errors of its compasses from it.

    Parameters
    ----------
    vehicle : of the study
    grade : key of `GRADES`
    headings : sources of heading
    heading_error, heading_error_sd_deg : what is unknown of each, and sd of every component
    fix_sd_m : noise of a position fix, None = no fixes
    prior_deg : mean, beyond the mounting, and sd of the DVL's yaw
    """
    sources = tuple(headings.split("+"))
    entries: dict[str, dict[str, Any]] = {name: {"estimate": False} for name in IRON}
    for source, prefix in COMPASS.items():
        for kind in ("offset", "deviation"):
            estimate = source in sources and heading_error in (kind, "both")
            entries[f"{prefix}_{kind}"] = {"estimate": estimate, "sd_deg": heading_error_sd_deg}
    mean = float(np.rad2deg(wrap_angle(np.deg2rad(vehicle.dvl.mount_rpy_deg[2] + prior_deg[0]))))
    entries["dvl_yaw"] = {"estimate": True, "mean_deg": mean, "sd_deg": prior_deg[1]}
    data = vehicle.model_dump()
    for name, entry in entries.items():
        data["calibration"][name] |= entry
    data["imu"] |= GRADES[grade]
    data["heading"]["sources"] = sources
    data["fix"] |= {} if fix_sd_m is None else {"sd_m": fix_sd_m}
    return Config.model_validate(data)


EstimatorName = Literal["smoothed", "filtered", "ekf", "rts", "4.5"]
DIVE_IGNORES = ("estimator",)  # parameters that do not change the dive: estimators are compared on the same dives
ID_DIGITS = 10
SHORTEST_S = 10.0  # of a log


class Cell(ConfigSection):
    """One combination of parameters, of which a study makes many runs."""

    manoeuvre: str = Field("lawnmower", description="scenario of rovgraph simulate: a motion as such")
    speed_mps: Positive = Field(0.4, description="speed")
    duration_s: Positive = Field(600.0, description="of the dive")
    cut_s: Annotated[float, Field(ge=0)] = Field(
        0.0, description="left out of the log at both ends; without start and stop a dive can be steady"
    )
    waves: bool = Field(True, description="those of a lake; false = calm")
    imu: Grade = Field("mti", description="grade of the inertial unit")
    heading: HeadingSources = Field("mag", description="sources of heading")
    heading_error: HeadingError = Field("offset", description="what is unknown of every heading source, and drawn")
    heading_error_sd_deg: Positive = Field(5.0, description="its sd, of offset and of sine and cosine")
    fix_sd_m: Positive | None = Field(None, description="noise of position fixes; null = there are none")
    fix_interval_s: Positive = Field(5.0, description="time between fixes")
    misalignment_deg: Annotated[float, Field(ge=-180, le=180)] = Field(
        0.0, description="true yaw of the DVL beyond its mounting"
    )
    prior: Literal["honest", "zero"] = Field(
        "honest", description="mean of the prior: off the truth by a draw from prior_sd_deg, or zero whatever is true"
    )
    prior_sd_deg: Positive = Field(5.0, description="sd of the prior")
    estimator: EstimatorName = Field("smoothed", description="which")

    @property
    def id(self) -> str:
        """Of its parameters, whatever else the study has."""
        return _digest(self.model_dump(mode="json"))[:ID_DIGITS]

    def seed(self, study_seed: int, run: int) -> int:
        """Of one run: of the study's seed, what the dive depends on, and the run's number."""
        dive = self.model_dump(mode="json", exclude=set(DIVE_IGNORES))
        return int(_digest([study_seed, dive, run])[:15], 16)


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _listed(info: FieldInfo) -> Any:
    """A list of values, each as a field has it."""
    value: Any = info.annotation
    for bound in info.metadata:
        value = Annotated[value, bound]
    return tuple[value, ...]


Grid: type[BaseModel] = create_model(
    "Grid",
    __base__=ConfigSection,
    __module__=__name__,
    **{name: (_listed(info), ()) for name, info in Cell.model_fields.items()},  # type: ignore[call-overload]
)


class Study(ConfigSection):
    """A study of the misalignment; the cells are the product of the grid's lists, and those listed one by one."""

    name: str = Field("study", description="of tables and figures")
    seed: Annotated[int, Field(ge=0)] = Field(1, description="of the study; another one makes other dives")
    runs: Annotated[int, Field(ge=1)] = Field(20, description="dives of a cell")
    history: bool = Field(False, description="a filter beside a smoother, for the error against time")
    held_track: bool = Field(False, description="the track without estimating the misalignment, too")
    vehicle: Config = Field(default_factory=Config)
    common: Cell = Cell()
    grid: Grid = Grid()
    cells: tuple[Cell, ...] = ()

    def all_cells(self) -> list[Cell]:
        """Every cell once: those of the grid, then the others."""
        return list({cell.id: cell for cell in self._selected()}.values())

    def _selected(self) -> Iterator[Cell]:
        common, lists = self.common.model_dump(exclude_unset=True), self.grid.model_dump(exclude_unset=True)
        if lists:
            for values in product(*lists.values()):
                yield Cell.model_validate(common | dict(zip(lists, values, strict=True)))
        for cell in self.cells:
            yield Cell.model_validate(common | cell.model_dump(exclude_unset=True))

    def varied(self) -> list[str]:
        """Names of the parameters that are not the same in all cells."""
        cells = self.all_cells()
        return [name for name in Cell.model_fields if len({getattr(cell, name) for cell in cells}) > 1]

    def to_yaml(self) -> str:
        """As it was given, with the effective vehicle."""
        head = {"name": self.name, "seed": self.seed, "runs": self.runs}
        told = self.model_dump(mode="json", exclude_unset=True)
        return yaml_text(head | told | {"vehicle": self.vehicle.model_dump(mode="json")})

    def same_dives(self, other: "Study") -> bool:
        """Whether what it makes of a cell is the same, however many cells and runs either has."""
        free = {"name", "runs", "common", "grid", "cells"}
        return self.model_dump(exclude=free) == other.model_dump(exclude=free)


def read_study(path: Path) -> Study:
    """Read a study; ``vehicle`` is a configuration, or the name of its file beside the study's.

    Raises
    ------
    InputError : no such file, an unknown key, no cells, a manoeuvre that cannot be
    """
    data = read_yaml(path)
    if isinstance(data.get("vehicle"), str):
        data["vehicle"] = load_config(path.parent / data["vehicle"]).model_dump(mode="json")
    study = parse_model(Study, data, str(path))
    _check(study, path)
    return study


def _check(study: Study, path: Path) -> None:
    """Refuse what has no cells, and cells that cannot be."""
    for name in study.grid.model_fields_set:
        if not getattr(study.grid, name):
            raise InputError(f"{path}: grid.{name} is an empty list; give it values, or leave it out")
    cells = study.all_cells()
    if not cells:
        raise InputError(f"{path}: an empty grid: give grid lists, such as manoeuvre: [circle, square], or cells")
    for name, duration, speed in dict.fromkeys((c.manoeuvre, c.duration_s, c.speed_mps) for c in cells):
        try:
            scenario(name, duration, speed)
        except InputError as error:
            raise InputError(f"{path}: manoeuvre {name}, {duration:g} s at {speed:g} m/s: {error}") from None
    if short := next((c for c in cells if c.duration_s < 2.0 * c.cut_s + SHORTEST_S), None):
        raise InputError(f"{path}: {short.duration_s:g} s less {short.cut_s:g} s at both ends leaves too little to log")
    if any(cell.estimator == "4.5" and cell.heading != "mag+dvl" for cell in cells):
        raise InputError(f"{path}: estimator 4.5 works with both compasses; give heading: mag+dvl")


def chosen(study: Study, only: str | None) -> Sequence[Cell]:
    """All cells, or the one whose id begins as given.

    Raises
    ------
    InputError : no such cell, or several
    """
    cells = study.all_cells()
    if only is None:
        return cells
    found = [cell for cell in cells if only and cell.id.startswith(only)]
    if len(found) != 1:
        problem = f"begins {len(found)} cells" if found else "is no cell of this study"
        raise InputError(f"--only {only}: {problem}; --list shows them")
    return found
