"""A log: one sparse, wide CSV or Parquet file, read into one stream per sensor.

`streams` holds what a log is, `units` the units that a file may use, `table` turns a file
into columns of numbers, `reading` makes streams of them. docs/log-format.md is the contract.
"""

from rovgraph.log.reading import log_from_frame, read_log
from rovgraph.log.streams import STREAMS, Log, Measurement, Stream

__all__ = ["STREAMS", "Log", "Measurement", "Stream", "log_from_frame", "read_log"]
