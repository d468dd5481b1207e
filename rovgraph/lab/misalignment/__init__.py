"""Monte Carlo of what can be known of the DVL's misalignment: what ``rovgraph study misalignment`` does.

`read_study` reads what is to be studied, `study` runs it. docs/studies.md describes both.
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
