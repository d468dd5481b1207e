"""Where pilots already look: what BlueOS and Cockpit ask of an extension.

BlueOS looks for ``/register_service`` on every port, Cockpit for the widgets that ``extras`` names. Cockpit's data lake
takes ``name=value`` from a WebSocket, one value per message.
"""

import math
from typing import Any

from rovgraph import __version__
from rovgraph.web.track import ellipse_sd
from rovgraph.web.view import View

PREFIX = "rovgraph-"  # of names in the data lake


def service() -> dict[str, Any]:
    """Answer to ``GET /register_service``."""
    return {
        "name": "rovgraph",
        "description": "Where the vehicle is, and how sure that is",
        "icon": "mdi-map-marker-path",
        "company": "rovgraph",
        "version": __version__,
        "webpage": "",
        "api": "",
        "new_page": False,
        "works_in_relative_paths": True,
        "extras": {"cockpit": "/cockpit_extras.json"},
    }


def extras() -> dict[str, Any]:
    """The widget that Cockpit offers: the page itself, without its panels. Cockpit refuses one without an icon."""
    widget = {
        "name": "rovgraph",
        "config_iframe_url": None,
        "iframe_url": "/#widget",
        "iframe_icon": "/assets/icon.svg",
        "use_extension_path_as_base_url": True,
        "version": __version__,
    }
    return {
        "target_system": "Cockpit",
        "target_cockpit_api_version": "1.0.0",
        "widgets": [widget],
        "actions": [],
    }


def data_lake_values(view: View) -> list[str]:
    """The newest solution for Cockpit's data lake; what is not known is left out."""
    s = view.newest
    if s is None:
        return []
    north, east, down = s.position.tolist()
    dvl = s.sensors.get("dvl")
    values: dict[str, float | str | None] = {
        "north-m": north,
        "east-m": east,
        "depth-m": down,
        "position-sd-m": ellipse_sd(s),
        "heading-deg": math.degrees(float(s.rpy[2])) % 360.0,
        "heading-sd-deg": math.degrees(float(s.rpy_sd[2])),
        "speed-mps": math.sqrt(float(s.velocity @ s.velocity)),
        "altitude-m": s.altitude,
        "distance-m": s.distance,
        "latitude-deg": s.latitude,
        "longitude-deg": s.longitude,
        "lock-lost-s": None if dvl is None else dvl.failed_s,
        "verdict": s.verdict,
    }
    return [f"{PREFIX}{name}={_text(value)}" for name, value in values.items() if _known(value)]


def _known(value: float | str | None) -> bool:
    return isinstance(value, str) or (value is not None and math.isfinite(value))


def _text(value: float | str | None) -> str:
    return value if isinstance(value, str) else f"{value:.9g}"
