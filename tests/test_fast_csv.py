"""Tables as CSV: to the byte as pandas writes them."""

import numpy as np
import pandas as pd
import pytest

from rovgraph.fast_csv import write_csv

NUMBERS = np.array([0.0, -0.0, 1.0, -1.5, 1e-12, 123456789.123, 1e300, np.pi, -2.5e-7])


def written(frame, tmp_path, **given):
    write_csv(frame, tmp_path / "ours.csv", **given)
    return (tmp_path / "ours.csv").read_bytes()


@pytest.mark.parametrize(
    "column",
    [
        NUMBERS,
        np.where(NUMBERS < 0.0, np.nan, NUMBERS),
        np.where(NUMBERS < 0.0, np.inf, NUMBERS),
        np.arange(9),
        ["dvl"] * 9,
        ["with, comma"] * 9,
        [None, "x", *"abcdefg"],
        [True, False] * 4 + [True],
    ],
    ids=["floats", "nan", "infinite", "integers", "text", "quoted", "missing text", "bool"],
)
def test_a_table_is_written_as_pandas_writes_it(column, tmp_path):
    frame = pd.DataFrame({"time": np.linspace(0.0, 1.0, 9), "value": column, "sensor": ["mag", "ahrs", "dvl"] * 3})
    frame.to_csv(tmp_path / "pandas.csv", index=False, float_format="%.7g")
    assert written(frame, tmp_path) == (tmp_path / "pandas.csv").read_bytes()


def test_more_rows_than_are_formatted_at_a_time(tmp_path):
    frame = pd.DataFrame(np.random.default_rng(1).standard_normal((9000, 3)), columns=["a", "b", "c"])
    frame.to_csv(tmp_path / "pandas.csv", index=False, float_format="%.5g")
    assert written(frame, tmp_path, digits=5) == (tmp_path / "pandas.csv").read_bytes()


def test_rows_are_appended_without_names_and_no_rows_are_names_alone(tmp_path):
    frame = pd.DataFrame({"a": [1.0, 2.0], "b": ["x", "y"]})
    written(frame[:0], tmp_path)
    assert written(frame, tmp_path, append=True) == b"a,b\n1,x\n2,y\n"


@pytest.mark.parametrize("name", ["ours.csv", "ours.csv.gz"])
def test_a_column_may_have_a_fixed_number_of_decimals(name, tmp_path):
    frame = pd.DataFrame({"time": [1.7e9 + 0.25, 2e9], "value": [0.5, np.nan]})
    write_csv(frame, tmp_path / name, decimals={"time": 4})
    assert (
        pd.read_csv(tmp_path / name, dtype=str).to_csv(index=False)
        == "time,value\n1700000000.2500,0.5\n2000000000.0000,\n"
    )
