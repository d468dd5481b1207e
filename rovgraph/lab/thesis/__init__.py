"""The extended Kalman filters of the thesis, selectable by name.

May import what `rovgraph.lab` may. Begin with `variants`: `FILTERS` lists the filters by section of the thesis. `run`
takes one (`run_filter`) or many (`run_filters`, those of one kind side by side) over a log. One recursion (`recursion`,
arithmetic in `core`) serves all: a filter is its process model (`processes`), its measurements (`measurements`), its
given attitude (`processes.known_motion`), and its numbers (`variants`). Frames and axes are this package's, the numbers
are converted; the motion is the same.
"""

from rovgraph.lab.thesis.run import FilterJob, run_filter, run_filters
from rovgraph.lab.thesis.variants import FILTERS, Filter, Numbers

__all__ = ["FILTERS", "Filter", "FilterJob", "Numbers", "run_filter", "run_filters"]
