"""The comparison with navlib: it is fed rightly, what is cut and merged is a log, a table has what it should."""

import importlib.util
import sys
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest

from rovgraph.log import Log, read_log


@cache
def benchmark() -> ModuleType:
    """``benchmarks/misalignment.py``, which is a script and no part of the package."""
    path = Path(__file__).parents[1] / "benchmarks" / "misalignment.py"
    spec = importlib.util.spec_from_file_location("misalignment_benchmark", path)
    assert spec is not None and spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def navlib():
    return pytest.importorskip("navlib", reason="navlib is not installed: pip install 'rovgraph[benchmarks]'")


@pytest.mark.parametrize("yaw", [30.0, -20.0])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_navlib_recovers_a_known_mounting_from_exact_signals(navlib, yaw):
    """Both methods, in our convention: from the DVL's axes to the body's."""
    turned = (3.0, -2.0, yaw)
    dive, config, true = benchmark().make_dive("figure8", 2.0, "mti", turned, 1, noise=False)
    signals = benchmark().signals(Log.from_frame(dive.log_frame), config, dive.truth, np.zeros(6))
    for R_bs in (signals.without_fixes(), signals.with_fixes()):
        error = benchmark().error_deg(R_bs, true)
        assert max(map(abs, error.values())) < 0.3, error


def test_an_error_in_yaw_is_told_from_a_roll_that_nobody_sees():
    true = benchmark().mount_matrix((180.0, 0.0, 45.0))
    turned = benchmark().mount_matrix((50.0, 0.0, 7.0)) @ true
    assert benchmark().error_deg(turned, true)["yaw"] == pytest.approx(7.0)


def test_a_log_gets_the_positions_of_a_reference(tmp_path):
    dive, _, _ = benchmark().make_dive("figure8", 1.0, "mti", (0.0, 0.0, 10.0), 1)
    log, reference, out = (tmp_path / name for name in ("log.csv", "reference.csv", "merged.csv"))
    dive.log_frame.to_csv(log, index=False)
    dive.truth.every(100).write_csv(reference)
    assert "61 fixes" in benchmark().main(["fixes", str(log), str(reference), str(out)])
    merged = read_log(out)
    at = dive.truth.at(merged["fix"].time)
    assert len(merged["fix"]) == 61
    np.testing.assert_allclose(merged["fix"].data[:, :2], at.p_n[:, :2], atol=1e-5)
    assert len(merged["imu"]) == len(Log.from_frame(dive.log_frame)["imu"])


def test_a_recorded_dive_that_is_absent_is_left_out(tmp_path):
    assert "left out" in benchmark().main(["recorded", str(tmp_path / "nowhere")])


def test_the_table_has_a_line_per_kind_of_dive():
    rows = [
        {"manoeuvre": "figure8", "minutes": 5.0, "imu": "mti", "fixes": fixes, "seed": seed, "method": method}
        | {"roll": 0.0, "pitch": 0.0, "yaw": yaw, "yaw_sd": 2.0 if method == "rovgraph" else None}
        for fixes in (False, True)
        for seed, yaw in ((1, 3.0), (2, -4.0))
        for method in ("rovgraph", "navlib, AHRS")
    ]
    lines = benchmark().table(pd.DataFrame(rows)).splitlines()
    assert len(lines) == 4
    assert lines[2].startswith("| figure8, 5 min | mti | no | 2 | **3.54** (0.0, 0.0) | **3.54**")
    assert lines[2].endswith("| 2.00 |")
