"""Monte Carlo study of the DVL's misalignment: the work of ``rovgraph study misalignment``.

May import what `rovgraph.lab` may. Begin with `plan` (`read_study`: the cells of a study), then `run` (one run of a
cell) and `results` (`study` runs all). docs/studies.md describes the use.
"""

from rovgraph.lab.misalignment.plan import Cell, Study, chosen, read_study
from rovgraph.lab.misalignment.results import CELL_COLUMNS, Tables, open_results, study
from rovgraph.lab.misalignment.run import HISTORY_COLUMNS, RUN_COLUMNS, CellTask, one_run

__all__ = [
    "CELL_COLUMNS",
    "HISTORY_COLUMNS",
    "RUN_COLUMNS",
    "Cell",
    "CellTask",
    "Study",
    "Tables",
    "chosen",
    "one_run",
    "open_results",
    "read_study",
    "study",
]
