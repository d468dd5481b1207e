"""Many simulated dives, to see what can be known: what ``rovgraph study`` does."""

import time
from pathlib import Path

from rovgraph.errors import InputError, as_path
from rovgraph.progress import Progress, no_progress
from rovgraph.studies import engines
from rovgraph.studies.misalignment import Tables, chosen, open_results, read_study
from rovgraph.studies.misalignment import study as study_cells
from rovgraph.studies.misalignment.ledger import kept_so_far


def study_misalignment(
    study: Path | str,
    out: Path | str,
    resume: bool = False,
    only: str | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: Progress = no_progress,
) -> Tables:
    """Study how well the DVL's misalignment can be estimated; every finished dive is saved at once.

    Parameters
    ----------
    study : YAML file of the study (docs/studies.md)
    out : results folder
    resume : continue with the files in the folder
    only : one cell, by the first characters of its id; None = all
    jobs : processes on this machine; None = one per core
    scheduler : address of a Dask cluster, such as ``tcp://host:8786``; None = this machine
    progress : called at times with the current task and its progress from 0 to 1

    Returns
    -------
    Tables : ``.runs``, ``.cells`` and ``.history``, also written into the folder

    Raises
    ------
    InputError : an invalid study, a folder that exists or holds another study, a cluster that does not answer,
        a full disk (what was written before is kept)
    """
    from rovgraph.pages.reporting import write_page
    from rovgraph.report.figure_study import draw_study
    from rovgraph.report.study import write_study

    plan = read_study(as_path(study, "study"))
    cells = chosen(plan, only)
    if scheduler is not None and jobs is not None:
        raise InputError("--jobs cannot be combined with --scheduler; the cluster decides the number of workers")
    engine = engines.Local(jobs) if scheduler is None else engines.Cluster(scheduler)
    folder = as_path(out, "out")
    results = open_results(folder, plan, resume)
    began = time.perf_counter()
    tables = study_cells(plan, results, cells, engine, lambda done: progress("making dives", done))
    with kept_so_far(folder):  # its rows are on disk already
        write_study(folder, tables, {"scheduler": scheduler, "seconds": time.perf_counter() - began})
        draw_study(folder, tables)
        write_page(folder)
    return tables
