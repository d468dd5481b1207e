"""The extended Kalman filters of the thesis, selectable by name.

`FILTERS` lists them by section; `run_filter` runs one over a log, `run_filters` many, those
of one kind side by side. One recursion (`recursion`, arithmetic in `core`) serves all: a filter is its process model
(`processes`), what it measures (`mti`, `dvl`), what it takes as given (`known`), and its
numbers (`variants`). Frames and axes are this package's, the numbers are converted; the
motion is the same.
"""

from rovgraph.lab.thesis.run import FilterJob, run_filter, run_filters
from rovgraph.lab.thesis.variants import FILTERS, Filter, Numbers

__all__ = ["FILTERS", "Filter", "FilterJob", "Numbers", "run_filter", "run_filters"]
