"""From a row per run to a row per cell: is what an estimator says of its error true?

The error of N independent runs with the right sd has a mean NEES (error / sd squared, one component)
that is chi-square with N degrees of freedom over N (Bar-Shalom et al. 2001, 5.4.2), and the
number of runs within their 95 % interval is binomial.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from rovgraph.studies.misalignment.plan import Cell

BAND = 0.95
CELL_COLUMNS = [
    "cell", *Cell.model_fields, "runs", "failed", "bias_deg", "sd_deg", "rms_deg", "predicted_sd_deg", "sd_ratio",
    "coverage", "coverage_low", "coverage_high", "nees", "nees_low", "nees_high", "converged", "verdict",
    "reached_1deg", "time_to_1deg_s", "track_rms_m", "track_rms_held_m", "cpu_s",
]  # fmt: skip


def cell_table(runs: pd.DataFrame, cells: Sequence[Cell]) -> pd.DataFrame:
    """One row per cell that has runs, in the order given; docs/studies.md describes the columns.

    Parameters
    ----------
    runs : a row per run, columns of runs.csv
    cells : of the study
    """
    by_cell = dict(list(runs.groupby("cell", sort=False)))
    rows = [_row(cell, by_cell[cell.id]) for cell in cells if cell.id in by_cell]
    return pd.DataFrame(rows, columns=pd.Index(CELL_COLUMNS))


def _row(cell: Cell, runs: pd.DataFrame) -> dict[str, Any]:
    from scipy.stats import binomtest, chi2  # type: ignore[attr-defined]  # a second to load, which no worker needs

    good = runs[runs["failure"].isna()]
    row = {"cell": cell.id, **cell.model_dump(), "runs": len(runs), "failed": len(runs) - len(good)}
    if not len(good):
        return row
    error, sd = good["error_deg"].to_numpy(float), good["sd_deg"].to_numpy(float)
    rms = float(np.sqrt(np.mean(error**2)))
    inside = int(good["inside_95"].astype(bool).sum())
    covered = binomtest(inside, len(good)).proportion_ci(BAND)
    nees_low, nees_high = chi2.interval(BAND, len(good)) / np.float64(len(good))
    return row | {
        "bias_deg": error.mean(),
        "sd_deg": error.std(ddof=1) if len(good) > 1 else np.nan,
        "rms_deg": rms,
        "predicted_sd_deg": float(np.median(sd)),
        "sd_ratio": float(np.sqrt(np.mean(sd**2))) / rms,
        "coverage": inside / len(good),
        "coverage_low": covered.low,
        "coverage_high": covered.high,
        "nees": good["nees"].mean(),
        "nees_low": nees_low,
        "nees_high": nees_high,
        "converged": good["converged"].astype(float).mean(),
        "verdict": good["verdict"].mode().iloc[0],
        **_time(good["time_to_1deg_s"].astype(float).dropna()),
        "track_rms_m": _rms(good["track_rms_m"]),
        "track_rms_held_m": _rms(good["track_rms_held_m"]),
        "cpu_s": good["cpu_s"].mean(),
    }


def _time(reached: pd.Series) -> dict[str, float]:
    """Share of the runs that got there, and the median time over all of them, infinite where less than half did."""
    if not len(reached):
        return {}
    return {"reached_1deg": float(np.isfinite(reached).mean()), "time_to_1deg_s": float(reached.median())}


def _rms(values: pd.Series) -> float:
    return float(np.sqrt(values.astype(float).pow(2).mean()))
