"""The benchmark of intervals: its table counts what is observable, its truth is drawn, dives are run once."""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import calibration_intervals as intervals


def row(seed, error, verdict="observable"):
    fixed = {"cell": "mti, survey", "estimate": "smoothed", "variable": "dvl_yaw", "sd": np.deg2rad(0.5)}
    return {**fixed, "seed": seed, "error": error, "verdict": verdict}


def test_the_table_counts_dives_in_which_the_variable_is_observable():
    rows = [row(0, 1.0), row(1, -3.0), row(2, 1.9), row(3, 9.0, "weak")]
    line = intervals.table(pd.DataFrame(rows)).splitlines()[2]
    assert line.startswith("| mti, survey | dvl_yaw | smoothed | 3 of 4 | 66.7% (")
    assert line.endswith(f"| {(1.0 + 9.0 + 1.9**2) / 3:.2f} | 0.50° |")


def test_dives_that_were_kept_are_not_run_again(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(intervals, "one_dive", lambda cell, seed: asked.append(seed) or [row(seed, 0.0)])
    cells = [intervals.CELLS["mti, survey"]]
    for seeds in (2, 3):
        found = intervals.run(cells, seeds, tmp_path / "dives.jsonl")
    assert asked == [0, 1, 2]
    assert found["seed"].tolist() == [0, 1, 2]


def test_what_is_considered_is_drawn_by_its_prior():
    rng = np.random.default_rng(1)
    arms = []
    for _ in range(200):
        vehicle = intervals.make_vehicle("mti", ("ahrs", "depth"))
        intervals._draw_considered(vehicle, rng)
        arms.append(vehicle.dvl.arm)
    np.testing.assert_allclose(np.std(arms, axis=0), 0.05, rtol=0.2)
    np.testing.assert_allclose(np.mean(arms, axis=0), [0.25, 0.0, 0.3], atol=0.02)
