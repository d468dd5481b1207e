"""Beams of a DVL stay beside the log: on its clock, in a file of their own, and never in the way of an estimate."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from autopilot_files import short_dive
from test_interchange_merging import DVL, IMU, recording, times
from wire import report

import rovgraph as rg
from rovgraph.errors import InputError
from rovgraph.log.companions import beams_of_table, usable_beams
from rovgraph.log.tables import table_of_arrays
from rovgraph.model.config import Config
from rovgraph.readers.merging import merge
from rovgraph.readers.recording import Clock, Recording
from rovgraph.sensors.dvl_beam import beams_of

START = 1_750_000_000.0  # Unix time of the dive's start [s]
UNIX, BOOT = Clock("Unix", 0.0, 0.0, "GPS"), Clock("boot")


@pytest.fixture(scope="module")
def dive() -> pd.DataFrame:
    """The simulated dive of the native files, at rest and turning."""
    return short_dive(0.0)


def doppler(dive: pd.DataFrame, clock: Clock, offset: float, drift: float = 0.0, path: str = "dvl.log") -> Recording:
    """The DVL of a dive, and two of its beams at the times of its pings, by a clock of its own."""
    made = recording(path, dive, clock, {"dvl": DVL}, offset, drift)
    time = made.channels[0].columns["time"]
    beams = {"time": time, "range_1": 2.0 + 0.0 * time, "range_2": 3.0 + 0.0 * time}
    return replace(made, tables={"dvl_beams": beams})


@pytest.mark.parametrize("stated", [{"dvl.log": -3.2}, {"dvl": -3.2}, {}], ids=["file", "sensor", "Unix time"])
def test_beams_move_with_the_pings_of_their_file(dive, stated):
    imu = recording("auto.bin", dive, BOOT if stated else Clock("boot", START), {"imu": IMU})
    dvl = doppler(dive, Clock("own") if stated else UNIX, 3.2 if stated else START)
    merged = merge([imu, dvl], {}, stated)
    np.testing.assert_array_equal(merged.tables["dvl_beams"]["time"], times(merged, "dvl_vx"))
    true = dive.loc[dive["dvl_vx"].notna(), "time"].to_numpy() + (0.0 if stated else START)
    np.testing.assert_allclose(merged.tables["dvl_beams"]["time"], true, rtol=0.0, atol=2e-6)


def test_beams_follow_the_drift_that_arrivals_show(dive):
    """A clock that loses 0.1 s in 100 s."""
    seconds = np.arange(0.0, 600.0, 0.2)
    frame = pd.DataFrame({"time": seconds, **dict.fromkeys(DVL, 1.0)})
    made = doppler(frame, Clock("own"), 0.0, -1e-3)
    channel = replace(made.channels[0], received=START + seconds, receiver="host")
    clocks = {"own": Clock("own"), "host": Clock("host", 0.0, 0.0, "its stamps are Unix time")}
    merged = merge([replace(made, channels=(channel,), clocks=clocks)], {}, {})
    np.testing.assert_allclose(merged.tables["dvl_beams"]["time"], START + seconds, rtol=0.0, atol=1e-5)


def test_a_shift_of_the_dvl_beside_its_imu_moves_its_beams(dive):
    made = doppler(dive, BOOT, 0.0)
    both = recording("nucleus", dive, BOOT, {"imu": IMU, "dvl": DVL}, tables=made.tables)
    merged = merge([both], {}, {"dvl": -0.5})
    np.testing.assert_array_equal(merged.tables["dvl_beams"]["time"], times(merged, "dvl_vx"))


def test_the_beams_are_those_of_the_dvl_that_feeds_the_log(dive):
    imu = recording("auto.bin", dive, Clock("boot", START), {"imu": IMU})
    first, second = doppler(dive, UNIX, START, path="a.log"), doppler(dive, UNIX, START, path="b.log")
    with_depth = recording("b.log", dive, UNIX, {"dvl": DVL, "depth": ("depth",)}, START, tables=second.tables)
    assert set(merge([imu, first, second], {}, {}).tables) == {"dvl_beams"}
    assert set(merge([imu, first, with_depth], {}, {}).tables) == {"dvl_beams", "dvl_beams_3"}
    assert set(merge([imu, first, with_depth], {"dvl": "b.log"}, {}).tables) == {"dvl_beams"}


@pytest.fixture
def files(dive, tmp_path) -> list[Path]:
    """A log without its DVL, in Unix time, and the DVL's reports with four beams, the last weak."""
    rest = [name for name in dive if not name.startswith(("dvl", "thruster"))]
    log = dive[rest].dropna(how="all", subset=rest[1:])
    log.assign(time=log["time"] + START).to_csv(tmp_path / "auto.csv", index=False)
    lines = []
    for n, (time, *v, valid) in enumerate(dive.loc[dive["dvl_valid"].notna(), ["time", *DVL]].to_numpy().tolist()):
        vx, vy, vz = np.nan_to_num(v).tolist()
        beams = [{"id": k, "distance": 2.0 + k, "beam_valid": k < 3 or n % 3 == 0} for k in range(4)]
        stamp = round(1e6 * (START + time))
        made = {"vx": vx, "vy": vy, "vz": vz, "velocity_valid": valid == 1, "time_of_validity": stamp}
        lines.append(report(**made, transducers=beams))
    (tmp_path / "dvl.jsonl").write_bytes(b"".join(lines))
    return [tmp_path / "auto.csv", tmp_path / "dvl.jsonl"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["log.csv", "log.csv.gz", "log.parquet"])
def test_converted_beams_lie_beside_the_log_and_are_read_with_it(files, tmp_path, name):
    out = tmp_path / "out"
    out.mkdir()
    converted = rg.convert(files)
    assert out / "log.dvl_beams.csv" in converted.save(out / name)
    direct, written = rg.read_log(files)["dvl_beams"], rg.read_log(out / name)["dvl_beams"]
    assert direct.columns == written.columns
    assert direct.columns[:3] == ("dvl_beam_valid_0", "dvl_beam_velocity_0", "dvl_beam_range_0")
    np.testing.assert_array_equal(written.data, direct.data)
    np.testing.assert_allclose(written.time, direct.time, rtol=0.0, atol=1e-6)
    np.testing.assert_array_equal(written.time, rg.read_log(out / name)["dvl"].time)
    beams = beams_of(written.data)
    assert beams.numbers == (0, 1, 2, 3)
    assert beams.valid[:, 3].mean() == pytest.approx(1 / 3, abs=0.01)
    np.testing.assert_array_equal(np.isnan(beams.range[:, 3]), ~beams.valid[:, 3])


def test_beams_beside_a_log_stay_with_it_among_native_files(files, tmp_path):
    converted = rg.convert(files)
    converted.save(tmp_path / "whole.csv")
    (tmp_path / "track.gpx").write_text(
        f'<gpx version="1.1"><trk><trkseg>{_points(converted.log.start)}</trkseg></trk></gpx>', encoding="utf-8"
    )
    beams = rg.read_log([tmp_path / "whole.csv", tmp_path / "track.gpx"])["dvl_beams"]
    np.testing.assert_array_equal(beams.data, converted.log["dvl_beams"].data)


def _points(start: float) -> str:
    stamps = pd.to_datetime(start + np.arange(12.0), unit="s").strftime("%Y-%m-%dT%H:%M:%SZ")
    return "".join(f'<trkpt lat="{50 + 1e-5 * k}" lon="8"><time>{t}</time></trkpt>' for k, t in enumerate(stamps))


@pytest.mark.slow
def test_a_known_latency_of_the_dvl_is_that_of_its_beams(files, tmp_path):
    config = rg.parse_config("{delay_s: {dvl: 0.25}}")
    log = rg.read_log(files, config)
    np.testing.assert_array_equal(log["dvl_beams"].time, log["dvl"].time)
    before = rg.read_log(files)["dvl_beams"].time
    np.testing.assert_allclose(log["dvl_beams"].time, before - 0.25, rtol=0.0, atol=1e-6)
    of_their_own = rg.read_log(files, rg.parse_config("{delay_s: {dvl: 0.25, dvl_beams: 0.1}}"))
    np.testing.assert_allclose(of_their_own["dvl_beams"].time, before - 0.1, rtol=0.0, atol=1e-6)


HOSTILE = {
    "no time": ("valid_1\n1\n", "no column time"),
    "no beam": ("time,depth\n1,2\n", "no column valid_1, velocity_1, range_1 or distance_1"),
    "text": ("time,valid_1,range_1\n1,1,near\n", "column range_1: 'near' is not a number"),
    "text as time": ("time,valid_1\nnoon,1\n", "line 2, column time: 'noon' is neither seconds nor a date"),
    "a validity that is none": ("time,valid_1\n1,1\n2,0.5\n", "line 3, column dvl_beam_valid_1: 0.5, expected 0 or 1"),
    "a number beyond the last": ("time,valid_1,valid_9\n1,1,1\n", "column valid_9: beams are numbered 0 to 8"),
    "twice": ("time,valid_1,valid_1\n1,1,1\n", "has the column 'valid_1' twice"),
    "no row": ("time,valid_1\n", "no rows below it"),
    "no row with a time": ("time,valid_1\n,1\n", "column time is empty"),
    "empty": ("", "is empty"),
    "binary": ("time,valid_1\n\0,1\n", "holds binary data"),
    "more cells": ("time,valid_1\n1,1,1\n", "line 2 has 3 cells, expected 2"),
    "another clock": ("time,valid_1\n5,1\n6,1\n", "times from 5.0 to 6.0 s, the log from"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("content", "said"), HOSTILE.values(), ids=HOSTILE.keys())
def test_beams_that_cannot_be_used_are_left_out_with_one_warning(files, tmp_path, content, said):
    rg.convert(files).save(tmp_path / "log.csv")
    (tmp_path / "log.dvl_beams.csv").write_text(content, encoding="utf-8")
    with pytest.warns(rg.DataWarning, match="beams are left out") as warned:
        log = rg.read_log(tmp_path / "log.csv")
    texts = [str(each.message) for each in warned if "beams are left out" in str(each.message)]
    assert len(texts) == 1 and said in texts[0] and "\n" not in texts[0]
    assert "dvl_beams" not in log and texts[0] in log.warnings and "dvl" in log


def test_rows_of_beams_without_a_time_are_left_out_and_the_others_put_in_order():
    time = START + np.arange(20.0)
    time[[3, 4, 7]] = time[4], time[3], np.nan
    table = {"time": time, "valid_1": (np.arange(20) != 4).astype(float), "distance_1": np.full(20, 2.0)}
    with pytest.warns(rg.DataWarning, match=r"rows without time left out|rows are earlier"):
        stream = usable_beams(table, Config(), "beams")
    beams = beams_of(stream.data)
    np.testing.assert_array_equal(stream.time, np.delete(START + np.arange(20.0), 7))
    np.testing.assert_array_equal(beams.valid[:, 0], np.arange(19) != 3)
    np.testing.assert_array_equal(beams.distance[:4, 0], [2.0, 2.0, 2.0, np.nan])


@pytest.mark.parametrize(
    ("columns", "valid"),
    [
        ({"valid_1": [1, 0, np.nan], "velocity_1": [np.nan, 1, 1], "range_1": [2, 2, 2]}, [1, 0, 0]),
        ({"velocity_1": [np.nan, 0, 1], "range_1": [2, 2, np.nan]}, [0, 1, 1]),
        (
            {"range_1": [2, np.nan, 2], "correlation_1": [9, 9, 9], "error_velocity": [0, 0, 0]},
            [1, 1],
        ),  # a row of nothing is left out
    ],
)
def test_a_beam_is_valid_where_it_is_said_else_by_its_velocity_else_by_its_range(columns, valid):
    table = table_of_arrays([{"time": [1.0, 2.0, 3.0], **columns}], "time", "beams")
    beams = beams_of(beams_of_table(table, Config()).data)
    np.testing.assert_array_equal(beams.valid[:, 0], valid)


def test_arrays_of_different_length_are_no_table():
    with pytest.raises(InputError, match="columns of different length"):
        beams_of_table(table_of_arrays([{"time": [1.0, 2.0], "valid_1": [1.0]}], "time", "beams"), Config())
