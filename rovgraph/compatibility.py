"""Versions of the forms in which rovgraph keeps what it reads back, see docs/compatibility.md.

A file that states no version is of version 1. A checkpoint has its own number (`rovgraph.live.checkpoint.VERSION`),
since only the version that wrote it can go on with it.
"""

from collections.abc import Mapping
from typing import Any

from rovgraph.errors import InputError

CONFIGURATION = 1  # key `version` of a configuration
LOG = 1  # column `rovgraph_log` of a log, recordings included
RESULTS = 1  # key `format` of a results folder's summary.json


def refuse_newer(stated: object, known: int, what: str) -> None:
    """Refuse what a later rovgraph wrote in a form that this one does not know.

    Parameters
    ----------
    stated : version that the file states; None = none, which is version 1
    known : the newest version that can be read
    what : the file and its kind, for the message

    Raises
    ------
    InputError : the stated version is newer
    """
    if isinstance(stated, int | float) and stated > known:
        raise InputError(f"{what} of version {stated:g}, this rovgraph reads up to {known}; update rovgraph")


def with_keys_of_today(data: Mapping[str, Any]) -> dict[str, Any]:
    """Keys and values of a configuration, with those that have gone under their present names."""
    out, chart = dict(data), data.get("chart")
    if isinstance(chart, Mapping) and "position_sd_m" in chart:
        out["chart"] = {key: value for key, value in chart.items() if key != "position_sd_m"}
        sd, stated = chart["position_sd_m"], data.get("calibration") or {}
        place = {"sd": sd} if sd else {"estimate": False}
        if isinstance(stated, Mapping):
            out["calibration"] = {"chart_place": place, **stated}
    return out
