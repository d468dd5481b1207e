"""A log: one sparse, wide CSV or Parquet file, read into one stream per sensor.

`log` holds what a log is, `streams` its measurements by sensor, `units` the units that a file may use; `table`
turns a file into columns of numbers, `reading` makes streams of them. `beams` has what each beam of a DVL measured.
docs/log-format.md is the contract.
"""

from rovgraph.log.log import Log, gathered, read_log
from rovgraph.log.streams import STREAMS, Measurement, Stream

__all__ = ["STREAMS", "Log", "Measurement", "Stream", "gathered", "read_log"]
