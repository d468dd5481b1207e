"""Monte Carlo of what can be known of the DVL's misalignment: what ``rovgraph study misalignment`` does.

`read_study` reads what is to be studied, `study` runs it. docs/studies.md describes both.
"""

from rovgraph.studies.misalignment.cells import CELL_COLUMNS
from rovgraph.studies.misalignment.plan import Cell, Study, chosen, read_study
from rovgraph.studies.misalignment.results import Tables, open_results, study
from rovgraph.studies.misalignment.run import HISTORY_COLUMNS, RUN_COLUMNS, Task, one_run

__all__ = [
    "CELL_COLUMNS",
    "HISTORY_COLUMNS",
    "RUN_COLUMNS",
    "Cell",
    "Study",
    "Tables",
    "Task",
    "chosen",
    "one_run",
    "open_results",
    "read_study",
    "study",
]
