"""A log: one sparse, wide CSV or Parquet file, read into one stream per sensor.

May import `rovgraph.sensors`, `model`, `kernels` and what is below. Begin with `log` (`Log`, which all else takes) and
`streams` (the measurements of one sensor); `reading` makes them from a file that `tables` turns into columns. `units`
has the units that a file may use, `frozen` and `stamps` find invalid values and stamps, `beams` holds a DVL's single
beams. docs/log-format.md is the contract.
"""

from rovgraph.log.log import Log, gathered, read_log
from rovgraph.log.streams import STREAMS, Measurement, Stream

__all__ = ["STREAMS", "Log", "Measurement", "Stream", "gathered", "read_log"]
