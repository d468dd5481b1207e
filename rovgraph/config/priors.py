"""Calibration variables in the configuration, and the priors that come of them."""

import math
from collections.abc import Callable
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, Field, create_model, model_validator
from pydantic_core import PydanticCustomError

from rovgraph.calibration import AUTO, CONSIDERED, MOUNT, TABLE, Variable
from rovgraph.config.error_messages import count
from rovgraph.config.sections import NotNegative, Positive, Section


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
    mounted = variable.name in MOUNT
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
        __base__=Section,
        __module__=__name__,
        __doc__=variable.about,
        __validators__=checks,
        **fields,
    )
    globals()[entry.__name__] = entry  # where pickle looks for it
    return entry


_ENTRIES = {name: calibration_entry(v) for name, v in TABLE.items()}
Calibration: type[BaseModel] = create_model(
    "Calibration",
    __base__=Section,
    __module__=__name__,
    __doc__="Calibration variables: estimated, considered, or exact at their mean.",
    **{name: (entry, entry()) for name, entry in _ENTRIES.items()},  # type: ignore[call-overload]
)
