"""From a row per run and estimator to a row per estimator.

The mean NEES of N independent runs at their ends, 2 components each, is chi-square with
2 N degrees of freedom over N for covariances that are right (Bar-Shalom et al. 2001, 5.4.2). Along a
track errors are correlated, so the mean there has no such band.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import gammaincinv

from rovgraph import thesis
from rovgraph.studies.estimator_chains import EstimatorSpec

BAND = 0.95


def aggregate(runs: pd.DataFrame, estimators: Sequence[EstimatorSpec]) -> pd.DataFrame:
    """One row per estimator, in the order given; numbers are over the runs that did not fail.

    Parameters
    ----------
    runs : a row per run and estimator, columns of runs.csv
    estimators : those compared
    """
    rows = [_row(named, runs[runs["estimator"] == named.name]) for named in estimators]
    return pd.DataFrame(rows)


def _row(named: EstimatorSpec, runs: pd.DataFrame) -> dict[str, Any]:
    good = runs[runs["error"].isna()]
    return {
        "estimator": named.name,
        "family": named.family,
        "about": named.about,
        "headings": named.headings,
        "misalignment_estimated": named.misalignment,
        "runs": len(runs),
        "failed": (len(runs) - len(good)) / len(runs),
        "end_mean_m": good["end_m"].mean(),
        "end_sd_m": good["end_m"].std(),
        "rms_m": _rms(good["rms_m"]),
        "max_m": good["max_m"].max(),
        "heading_rms_deg": _rms(good["heading_rms_deg"]),
        "velocity_rms_mps": _rms(good["velocity_rms_mps"]),
        "nees_mean": good["nees"].mean(),
        **_consistency(good["nees_end"].dropna()),
        "inside_end": good["inside_end"].astype(float).mean(),
        "inside_track": good["inside_track"].mean(),
        **_misalignment(good),
        **{name: good[name].mean() for name in map(str, good) if name.startswith(("nis_", "fit_"))},
        "cpu_per_s": good["cpu_per_s"].mean(),
        "thesis_end_mean_m": thesis.MEAN_END_ERROR_M.get(named.name, np.nan),
    }


def _rms(values: pd.Series) -> float:
    """Root of the mean of the squares, NaN where there are none."""
    return float(np.sqrt(values.pow(2).mean()))


def nees_band(runs: int) -> tuple[float, float]:
    """Within which the mean NEES of two components lies with 95 %, over independent runs."""
    low, high = (2.0 * float(gammaincinv(runs, p)) / runs for p in ((1.0 - BAND) / 2.0, (1.0 + BAND) / 2.0))
    return low, high


def _consistency(nees: pd.Series) -> dict[str, Any]:
    """Mean NEES at the end, its band, and where it lies."""
    if not len(nees):
        return {"nees_end_mean": np.nan, "nees_end_low": np.nan, "nees_end_high": np.nan, "nees_end_band": ""}
    mean, (low, high) = float(nees.mean()), nees_band(len(nees))
    place = "below" if mean < low else "above" if mean > high else "within"
    return {"nees_end_mean": mean, "nees_end_low": low, "nees_end_high": high, "nees_end_band": place}


def _misalignment(good: pd.DataFrame) -> dict[str, float]:
    if "misalignment_deg" not in good:
        return {}
    error = good["misalignment_deg"] - good["misalignment_true_deg"]
    return {
        "misalignment_mean_deg": good["misalignment_deg"].mean(),
        "misalignment_sd_deg": _rms(good["misalignment_sd_deg"]),
        "misalignment_error_mean_deg": error.mean(),
        "misalignment_error_rms_deg": _rms(error),
    }
