"""Options of a study of the calibration: names, goals, known components."""

import difflib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from rovgraph.errors import InputError
from rovgraph.lab.observability import START_HEADING
from rovgraph.lab.plan import KnownComponents
from rovgraph.model.calibration import TABLE, beacon_names

FIRST_BEACON = beacon_names(0)[0]


def listed(names: str | Iterable[str] | None) -> list[str]:
    """Names, each once, of a list or of a text with commas between them.

    Raises
    ------
    InputError : an entry that is not a name
    """
    each = names.split(",") if isinstance(names, str) else [*(names or ())]
    if wrong := [name for name in each if not isinstance(name, str)]:
        raise InputError(f"{wrong[0]!r}: expected a name, such as 'dvl_yaw'")
    return list(dict.fromkeys(name.strip() for name in each if name.strip()))


def goals(wanted: Mapping[str, float] | Sequence[str] | None) -> dict[str, float]:
    """Label of a component -> wanted sd, radians and SI.

    Parameters
    ----------
    wanted : such a mapping, or texts such as ``dvl_yaw=1deg``, ``dvl_scale=0.002`` and ``usbl_arm=0.1m``; a variable's
        name stands for all its components, and ``beacon`` for the place of the first one

    Raises
    ------
    InputError : no such component, no positive number, degrees for what is no angle or the reverse
    """
    if wanted is not None and not isinstance(wanted, Mapping | Sequence):
        raise InputError(f"goals: {wanted!r}, expected a mapping of components to sds, or texts such as 'dvl_yaw=1deg'")
    if not isinstance(wanted, Mapping):
        return {label: sd for text in wanted or () for label, sd in _goal(text).items()}
    for label, sd in wanted.items():
        if not (isinstance(sd, int | float) and math.isfinite(sd) and sd > 0.0):
            raise InputError(
                f"goal {label}: {sd!r}, expected an sd above 0 in radians or SI, or the text '{label}=1deg'"
            )
    return dict(wanted)


def _goal(text: str) -> dict[str, float]:
    label, _, number = text.partition("=")
    label = label.strip()
    label = {"beacon": FIRST_BEACON, "heading": START_HEADING.name}.get(label, label)
    variable = next((v for v in (*TABLE.values(), START_HEADING) if label in (v.name, *v.labels)), None)
    if variable is None:
        every = [known for v in TABLE.values() for known in v.labels]
        near = difflib.get_close_matches(label, every, 1)
        raise InputError(f"goal {text!r}: unknown component {label!r}" + (f", did you mean {near[0]}?" if near else ""))
    number, degrees = number.strip(), number.strip().endswith("deg")
    unit = "deg" if variable.angular else variable.unit if variable.unit.isalpha() else ""
    try:
        sd = float(number.removesuffix(unit))
    except ValueError:
        sd = math.nan
    if not (math.isfinite(sd) and sd > 0.0 and degrees == variable.angular):
        raise InputError(
            f"goal {text!r}: expected {label}=" + ("1deg" if variable.angular else f"0.01 [{variable.unit}]")
        )
    labels = [label] if label in variable.labels else variable.labels
    return dict.fromkeys(labels, math.radians(sd) if degrees else sd)


def read_known(path: Path) -> KnownComponents:
    """Known components from the ``observability.json`` of a dive.

    Raises
    ------
    InputError : no such file, or not one of ``rovgraph observe``
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        components = content["components"]
        covariance = np.array(content["covariance"], float)
        sd = np.array([components[label]["prior_sd"] for label in components], float)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{path}: no observability.json of rovgraph observe") from None
    square = covariance.shape == (len(sd), len(sd)) and len(sd) > 0
    if not (
        square and np.isfinite(covariance).all() and (np.linalg.eigvalsh(covariance) > 0.0).all() and (sd > 0).all()
    ):
        raise InputError(f"{path}: its covariance is not valid; make the file again with rovgraph observe")
    return KnownComponents(tuple(components), covariance, sd)
