"""Tables as CSV: to the byte as pandas writes them."""

import gzip

import numpy as np
import pandas as pd
import pytest

from rovgraph.log.csv_writer import ROWS, write_csv, write_sparse_csv

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


def sparse(count):
    """Three sensors' rows in turn at random, some cells of them empty, in pieces, and the same as a table."""
    rng = np.random.default_rng(2)
    which = rng.integers(3, size=count)
    which[:ROWS] = which[:ROWS] % 2  # one has no rows among the first that are formatted
    time = np.sort(rng.uniform(1.7e9, 1.7e9 + 1e3, count))
    parts, frame = [], pd.DataFrame({"time": time})
    for k, names in enumerate((("acc", "gyr"), ("depth",), ("gyr", "speed"))):
        place = np.flatnonzero(which == k)
        own = {name: rng.standard_normal(len(place)) * 10.0 ** rng.integers(-9, 12, len(place)) for name in names}
        own[names[-1]][rng.uniform(size=len(place)) < 0.2] = np.nan
        for name, values in own.items():
            frame.loc[place, name] = values
        parts.append((place, {"time": time[place], **own}))
    frame["empty"] = np.nan
    pieces = []
    for begin in range(0, count, ROWS):
        inside = [(place, (begin <= place) & (place < begin + ROWS), own) for place, own in parts]
        pieces.append([(place[own] - begin, {n: v[own] for n, v in columns.items()}) for place, own, columns in inside])
    return pieces, frame


@pytest.mark.parametrize("count", [1, 7, 3 * ROWS + 5])
def test_rows_that_fill_few_columns_are_written_as_the_table_with_its_empty_cells(count, tmp_path):
    pieces, frame = sparse(count)
    frame = frame.reindex(columns=["time", "speed", "acc", "gyr", "empty", "depth"])
    expected = written(frame, tmp_path, digits=10, decimals={"time": 6})
    for name, opened in (("sparse.csv", open), ("sparse.csv.gz", gzip.open)):
        write_sparse_csv(list(frame), pieces, tmp_path / name, 10, {"time": 6})
        with opened(tmp_path / name, "rb") as file:
            assert file.read() == expected


def test_a_compressed_table_is_the_same_file_each_time(tmp_path, monkeypatch):
    pieces, frame = sparse(50)
    for name, now in (("one", 1e9), ("two", 1.1e9)):
        (tmp_path / name).mkdir()
        monkeypatch.setattr("time.time", lambda now=now: now)
        write_sparse_csv(list(frame), pieces, tmp_path / name / "log.csv.gz")
    assert (tmp_path / "one/log.csv.gz").read_bytes() == (tmp_path / "two/log.csv.gz").read_bytes()
