"""A log of rows that fill few columns each is the log of the table that they make."""

import numpy as np
import pandas as pd
import pytest

import rovgraph as rg
from rovgraph.errors import InputError
from rovgraph.log.rows import Part, frame_of, in_order, pieces, whole


def parts():
    """An IMU; depth and thrusters, one of them not in order; fixes; depth once more, with a gap and a wrong cell."""
    rng = np.random.default_rng(4)
    axes = [f"{kind}_{axis}" for kind in ("acc", "gyr") for axis in "xyz"]
    imu = {"time": np.arange(0.0, 10.0, 0.01), **{name: rng.standard_normal(1000) for name in axes}}
    late = rng.permutation(np.arange(0.005, 10.0, 0.2))
    depth = {"time": late, "depth": 1.0 + 0.1 * late}
    drive = {"time": np.arange(0.0, 10.0, 0.1), "thruster_1": rng.uniform(size=100), "thruster_2": np.ones(100)}
    fixes = {"time": np.array([2.0, 5.0]), "fix_lat": np.array([58.0, 58.001]), "fix_lon": np.array([15.0, 15.001])}
    more = {"time": np.array([11.0, 12.0, 13.0]), "depth": np.array([2.0, np.nan, np.inf])}
    return [imu, depth, drive, fixes, more]


def test_streams_lines_origin_and_warnings_are_those_of_the_whole_table():
    rows = in_order(parts())
    with pytest.warns(rg.DataWarning):
        ours, theirs = rg.Log.from_rows(rows), rg.Log.from_frame(frame_of(rows))
    assert list(ours.streams) == list(theirs.streams) == ["imu", "depth", "fix", "thruster"]
    for sensor, stream in theirs.streams.items():
        own = ours[sensor]
        assert own.columns == stream.columns
        np.testing.assert_array_equal(own.time, stream.time)
        np.testing.assert_array_equal(own.data, stream.data)
        np.testing.assert_array_equal(own.row, stream.row)
    assert ours.origin == theirs.origin == (58.0, 15.0)
    assert sorted(ours.warnings) == sorted(theirs.warnings) != []


def test_what_a_log_is_made_of_stays_as_it_was():
    given = parts()
    copies = [{name: values.copy() for name, values in part.items()} for part in given]
    with pytest.warns(rg.DataWarning):
        rg.Log.from_rows(in_order(given))
    for part, copy in zip(given, copies, strict=True):
        for name in part:
            np.testing.assert_array_equal(part[name], copy[name])


def test_rows_without_a_measurement_are_refused_by_the_names_that_they_have():
    with pytest.raises(InputError, match="no measurement of any sensor in it; columns found: time, depth, salt"):
        rg.Log.from_rows(
            in_order([{"time": np.zeros(1), "depth": np.full(1, np.nan)}, {"time": np.ones(1), "salt": np.ones(1)}])
        )


@pytest.mark.parametrize("count", [1, 7, 10_000])
def test_pieces_follow_each_other_as_the_rows_of_the_whole_log(count):
    """Stamps of several sensors are equal, too, and one clock drifts."""
    rng = np.random.default_rng(6)
    times = [np.sort(rng.integers(0, 500, size)) * 0.01 for size in (300, 40, 1, 90)]
    clocks = [lambda t: t, lambda t: 5.0 + 1.0001 * t, lambda t: t + 2.0, lambda t: t]
    parts = [
        Part({"time": time, name: rng.standard_normal(len(time))}, clock)
        for time, clock, name in zip(times, clocks, ("depth", "dvl_altitude", "fix_sd", "depth"), strict=True)
    ]
    expected, done = frame_of(whole(parts)), 0
    for rows in pieces(parts, count):
        piece = frame_of(rows).reindex(columns=expected.columns)
        here = expected.iloc[done : done + len(piece)].reset_index(drop=True)
        pd.testing.assert_frame_equal(piece, here)
        done += len(piece)
        assert done == len(expected) or here["time"].iloc[-1] < expected["time"].iloc[done]
    assert done == len(expected) == 431
