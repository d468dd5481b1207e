"""For packages of your own: the names to import to add a sensor, a format to read, or a format to write.

docs/compatibility.md says how long the names below stay, as those of ``import rovgraph`` do; every other module is
internal and may change with any release. docs/own-sensor.md, docs/formats.md and docs/export.md show their use.
"""

from rovgraph.geometry import Array, rotate, skew
from rovgraph.model.calibration import Variable
from rovgraph.model.config import Config, SensorSettings
from rovgraph.model.state import BIAS, POSE, VELOCITY, Jacobians, State
from rovgraph.readers.formats import Format, ReadingOptions
from rovgraph.readers.recording import Channel, Clock, Left, Recording
from rovgraph.report.export.formats import ExportFormat, ExportOptions
from rovgraph.report.export.track import Track
from rovgraph.sensors import (
    Column,
    Instrument,
    Level,
    Observed,
    Sensor,
    SensorModel,
    instrument,
    register,
    settings,
    unregister,
)

__all__ = [
    "BIAS",
    "POSE",
    "VELOCITY",
    "Array",
    "Channel",
    "Clock",
    "Column",
    "Config",
    "ExportFormat",
    "ExportOptions",
    "Format",
    "Instrument",
    "Jacobians",
    "Left",
    "Level",
    "Observed",
    "ReadingOptions",
    "Recording",
    "Sensor",
    "SensorModel",
    "SensorSettings",
    "State",
    "Track",
    "Variable",
    "instrument",
    "register",
    "rotate",
    "settings",
    "skew",
    "unregister",
]
