"""Reading logs: what is kept, what is put in order, what is refused and how that is said."""

import gzip
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pymap3d
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rovgraph.errors import DataWarning, InputError
from rovgraph.log import STREAMS, Log, Stream, read_log
from rovgraph.model.config import Config

DATA = Path(__file__).parents[2] / "shared" / "data"
IMU = "time,acc_x,acc_y,acc_z,gyr_x,gyr_y,gyr_z"


def write(folder: Path, text: str, name: str = "log.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def read_quietly(path: Path, **mapping) -> Log:
    """Read; any warning is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read_log(path, Config(**mapping))


def test_a_unit_with_a_sign_turns_the_sign_and_leaves_an_sd(tmp_path):
    path = write(tmp_path, "time,depth,dvl_vx,dvl_vy,dvl_vz,dvl_sd\n1,-5,100,200,300,10\n")
    log = read_quietly(path, units={"depth": "-m", "dvl": "cm/s", "dvl_vz": "-cm/s"})
    assert log["depth"].data.tolist() == [[5.0]]
    assert log["dvl"].data[0].tolist() == [1.0, 2.0, -3.0, 1.0, 0.1]
    turned = read_quietly(path, units={"dvl": "-cm/s"})["dvl"].data[0]
    assert turned.tolist() == [-1.0, -2.0, -3.0, 1.0, 0.1]
    for unit in ("--m", "-x", "- m"):
        with pytest.raises(InputError, match=r"units: depth: unknown unit"):
            read_log(path, Config(units={"depth": unit}))
    with pytest.raises(InputError, match="time does not run backwards"):
        read_log(path, Config(units={"time": "-s"}))


def read_sds(tmp_path: Path, column: str, sds: list[float]) -> list[float]:
    rows = "".join(f"{k},1,2,3,{sd!r}\n" for k, sd in enumerate(sds))
    names = "dvl_vx,dvl_vy,dvl_vz" if column == "dvl_sd" else "fix_north,fix_east,depth"
    log = read_log(write(tmp_path, f"time,{names},{column}\n{rows}"))
    return log[column.split("_")[0]][column].tolist()


def test_a_covariance_follows_the_unit_of_its_group_squared(tmp_path):
    text = "time,fix_north,fix_east,fix_sd,fix_cov_ne\n1,500,300,20,100\n2,500,300,20,-100\n"
    for units in ({"fix": "cm"}, {"fix": "-cm"}, {"fix": "cm", "fix_cov_ne": "cm2"}):
        fix = read_quietly(write(tmp_path, text), units=units)["fix"]
        np.testing.assert_allclose(fix["fix_cov_ne"], [0.01, -0.01])
        np.testing.assert_allclose(fix["fix_sd"], 0.2)


@pytest.mark.parametrize("column", ["dvl_sd", "fix_sd"])
@pytest.mark.parametrize("sd", [9999.0, 99.99, 999.9, 65.535, 1e6, 9999.0**0.5, 99999.0**0.5])
def test_an_sd_that_stands_for_an_unknown_one_is_unknown(tmp_path, column, sd):
    with pytest.warns(DataWarning, match=f"{column}: 3 times no sd that such an instrument has, taken as unknown"):
        np.testing.assert_array_equal(read_sds(tmp_path, column, [sd, 0.2, sd, sd]), [np.nan, 0.2, np.nan, np.nan])


@pytest.mark.parametrize(("column", "largest"), [("dvl_sd", 5.0), ("fix_sd", 5e3)])
def test_an_sd_is_unknown_from_what_no_such_instrument_has_on(tmp_path, column, largest):
    assert read_sds(tmp_path, column, [0.99 * largest] * 3) == [0.99 * largest] * 3
    with pytest.warns(DataWarning, match="taken as unknown"):
        assert np.isnan(read_sds(tmp_path, column, [1.01 * largest] * 3)).all()


def test_a_placeholder_among_better_sds_says_that_the_measurement_is_worth_little(tmp_path):
    assert read_sds(tmp_path, "dvl_sd", [0.01, 10.0, 0.01, 9999.0]) == [0.01, 10.0, 0.01, 9999.0]


ORIGIN = {"origin_lat_deg": 58.3, "origin_lon_deg": 14.5}


def test_a_stated_origin_is_where_north_and_east_count_from(tmp_path):
    path = write(tmp_path, "time,fix_lat,fix_lon\n1,58.301,14.5\n2,58.302,14.5\n")
    log = read_quietly(path, environment=ORIGIN)
    assert log.origin == (58.3, 14.5)
    assert log["fix"].data[:, :2] == pytest.approx(np.array([[111.4, 0.0], [222.8, 0.0]]), abs=0.2)
    assert read_quietly(path).origin == (58.301, 14.5)
    bare = write(tmp_path, "time,depth\n1,2\n", "bare.csv")
    assert read_quietly(bare, environment=ORIGIN).origin == (58.3, 14.5) and read_quietly(bare).origin is None
    with pytest.raises(InputError, match=r"fixes lie \d+ km from environment.origin_lat_deg"):
        read_log(path, Config(environment={"origin_lat_deg": 14.5, "origin_lon_deg": 58.3}))  # the two swapped


def test_rows_of_all_sensors_become_streams_with_their_lines(tmp_path):
    path = write(tmp_path, f"{IMU},dvl_vx,dvl_vy,dvl_vz,depth\n1,1,2,-9.8,4,5,6,,,,\n2,,,,,,,.1,.2,.3,7\n")
    log = read_quietly(path)
    assert log.sensors == {"imu", "dvl", "depth"}
    np.testing.assert_array_equal(log["imu"].data, [[1, 2, -9.8, 4, 5, 6]])
    np.testing.assert_array_equal(log["dvl"].data, [[0.1, 0.2, 0.3, 1.0, np.nan]])
    assert [log[s].row.tolist() for s in ("imu", "dvl", "depth")] == [[2], [3], [3]]
    assert log.source == str(path)
    assert log.origin is None


def test_blank_lines_are_passed_over_and_lines_still_count(tmp_path):
    log = read_quietly(write(tmp_path, "time,depth\n1,5\n\n\n2,6\n\n"))
    assert log["depth"].row.tolist() == [2, 5]


def test_blanks_around_names_and_cells_are_no_part_of_them(tmp_path):
    text = " time , depth, fix_north ,fix_east, fix_sd,dvl_altitude\n1, 5,  ,,, 2\n 2 ,\t6 , 7 , 8 ,0.5 , \n"
    log = read_quietly(write(tmp_path, text))
    np.testing.assert_array_equal(log["depth"].data, [[5], [6]])
    np.testing.assert_array_equal(log["fix"].data[:, :3], [[7, 8, 0.5]])
    assert log["dvl_altitude"].time.tolist() == [1]
    with pytest.raises(InputError, match="line 3, column depth: 'deep' is not a number"):
        read_log(write(tmp_path, "time, depth\n1,\t5\n2, deep \n"))


def test_windows_line_ends_and_byte_order_mark_are_read(tmp_path):
    path = tmp_path / "log.csv"
    path.write_bytes(b"\xef\xbb\xbftime,depth\r\n1,5\r\n2,6\r\n")
    np.testing.assert_array_equal(read_quietly(path)["depth"]["depth"], [5, 6])


def test_a_log_with_a_column_received_may_have_its_rows_in_the_order_of_arrival(tmp_path):
    rows = "\n1,5,11\n9,7,12\n2,6,13\n"
    log = read_quietly(write(tmp_path, "time,depth,received" + rows))
    assert log["depth"].time.tolist() == [1, 2, 9]
    assert log["depth"]["depth"].tolist() == [5, 6, 7]
    with pytest.raises(InputError, match="time goes back from 9"):
        read_log(write(tmp_path, "time,depth,other" + rows))


def test_a_clock_that_was_set_is_refused_even_by_the_order_of_arrival(tmp_path):
    with pytest.raises(
        InputError, match=r"line 3: time goes back from 5000.000 to 1.000 s.*Cut the file before that line"
    ):
        read_log(write(tmp_path, "time,depth,received\n5000,1,11\n1,2,12\n"))


def test_thrusters_and_a_kind_of_fix_that_stand_empty_are_as_good_as_absent(tmp_path):
    head = "time,fix_north,fix_east,fix_lat,fix_lon,thruster_1,thruster_2"
    log = read_quietly(write(tmp_path, f"{head}\n1,,,58,8,,\n2,,,58,8,,\n3,,,,,0.5,\n"))
    assert log["thruster"].columns == ("thruster_1",)
    assert log.origin == (58.0, 8.0)
    log = read_quietly(write(tmp_path, f"{head}\n1,1,2,,,,\n"))
    assert log["fix"].data[0, :2].tolist() == [1.0, 2.0]


def test_gzip_is_told_by_content_not_by_name(tmp_path):
    path = tmp_path / "log.csv"
    path.write_bytes(gzip.compress(b"time,depth\n1,5\n"))
    assert len(read_quietly(path)["depth"]) == 1


def test_acceleration_on_other_rows_is_interpolated_at_the_gyros_times(tmp_path):
    rows = [f"{t},{t},0,-9.8,,," for t in np.arange(0.0, 1.01, 0.1)]
    rows += [f"{t:.2f},,,,{t:.2f},0,0" for t in np.arange(0.05, 1.0, 0.1)]
    path = write(tmp_path, IMU + "\n" + "\n".join(sorted(rows, key=lambda r: float(r.split(",")[0]))))
    imu = read_quietly(path)["imu"]
    assert len(imu) == 10
    np.testing.assert_allclose(imu["acc_x"], imu.time, atol=1e-12)
    np.testing.assert_allclose(imu["gyr_x"], imu.time, atol=1e-12)


def test_a_rate_without_acceleration_near_is_left_out(tmp_path):
    path = write(tmp_path, f"{IMU}\n0,0,0,-9,0,0,0\n5,,,,1,1,1\n9,0,0,-9,0,0,0\n")
    with pytest.warns(DataWarning, match=r"imu: 1 rows .* line 3"):
        assert read_log(path)["imu"].time.tolist() == [0, 9]


def test_an_invalid_ping_needs_no_velocity_and_a_valid_one_does(tmp_path):
    path = write(
        tmp_path, "time,dvl_vx,dvl_vy,dvl_vz,dvl_valid\n1,1,1,1,1\n2,,,,0\n3,1,,1,1\n4,,,1,\n5,1,1,1,\n6,,,,\n"
    )
    with pytest.warns(DataWarning, match=r"dvl: 2 rows partly empty .* line 4"):
        dvl = read_log(path)["dvl"]
    assert dvl.time.tolist() == [1, 2, 5]
    assert dvl["dvl_valid"].tolist() == [1, 0, 1]


def test_true_and_false_are_validities(tmp_path):
    path = write(tmp_path, "time,dvl_vx,dvl_vy,dvl_vz,dvl_valid\n1,1,1,1,True\n2,1,1,1,\n3,,,,False\n")
    assert read_quietly(path)["dvl"]["dvl_valid"].tolist() == [1, 1, 0]


def test_geographic_fixes_are_local_to_the_first(tmp_path):
    lat, lon = 42.2, 3.1
    north, east = 120.0, -35.0
    far = pymap3d.ned2geodetic(north, east, 0.0, lat, lon, 0.0)
    path = write(tmp_path, f"time,fix_lat,fix_lon\n0,0,0\n1,{lat},{lon}\n2,{float(far[0])!r},{float(far[1])!r}\n")
    with pytest.warns(DataWarning, match="1 fixes at latitude and longitude 0"):
        log = read_log(path)
    assert log.origin == (lat, lon)
    np.testing.assert_allclose(log["fix"].data[:, :2], [[0, 0], [north, east]], atol=0.01)


def test_thrusters_are_sorted_by_number(tmp_path):
    names = [f"thruster_{k}" for k in (10, 2, 1)]
    thruster = read_quietly(write(tmp_path, "time," + ",".join(names) + "\n0,10,2,1\n"))["thruster"]
    assert thruster.columns == ("thruster_1", "thruster_2", "thruster_10")
    assert thruster.data.tolist() == [[1, 2, 10]]


def test_foreign_names_and_units_become_ours(tmp_path):
    path = write(tmp_path, "t,RAW.x,gyr_y,gyr_z,acc_x,acc_y,acc_z\n2000,180,0,90,0,0,-1\n")
    imu = read_quietly(
        path,
        columns={"time": "t", "gyr_x": "RAW.x"},
        units={"gyr": "deg/s", "gyr_z": "mrad/s", "acc": "g", "time": "ms"},
    )["imu"]
    assert imu.time.tolist() == [2.0]
    np.testing.assert_allclose(imu.data, [[0, 0, -9.80665, np.pi, 0, 0.09]])


@pytest.mark.parametrize(
    ("mapping", "said"),
    [
        ({"units": {"gyr": "deg"}}, "unknown unit 'deg', nearest is 'deg/s'"),
        ({"units": {"gyro": "deg/s"}}, "gyro is not a column or group with a unit, nearest is gyr"),
        ({"units": {"thruster_1": "m"}}, "thruster_1 is not a column"),
        ({"columns": {"gyro_x": "a"}}, "gyro_x is unknown, nearest is gyr_x"),
        ({"columns": {"gyr_x": "dept"}}, "the log has no 'dept', nearest is 'depth'"),
    ],
)
def test_a_wrong_mapping_names_the_nearest_known(tmp_path, mapping, said):
    with pytest.raises(InputError, match=said):
        read_log(write(tmp_path, "time,depth\n0,1\n"), Config(**mapping))


@pytest.mark.parametrize("name", ["acx_x", "gyro_x", "ACC_X"])
def test_a_near_miss_of_a_column_is_named(tmp_path, name):
    with pytest.warns(DataWarning) as caught:
        read_log(write(tmp_path, f"time,depth,{name}\n0,1,2\n"))
    said = str(caught[0].message)
    assert repr(name) in said
    assert ("gyr_x" if "gyr" in name else "acc_x") in said


@pytest.mark.parametrize("name", ["salinity", "fix_alt", "comment"])
def test_other_columns_are_ignored_in_silence(tmp_path, name):
    read_quietly(write(tmp_path, f"time,depth,fix_lat,fix_lon,{name}\n0,1,10,10,x\n"))


HOSTILE = {
    "empty": ("", "is empty"),
    "blank": ("\n \n", "is empty"),
    "header only": ("time,depth\n", "no rows"),
    "ragged, long": ("time,depth\n1,2\n3,4,5\n6,7\n", "line 3 has 3 cells, expected 2"),
    "ragged, short": ("time,depth\n1,2\n3\n6,7\n", "line 3 has 1 cells, expected 2"),
    "word": ("time,depth\n1,2\n3,deep\n", "line 3, column depth: 'deep' is not a number"),
    "word in time": ("time,depth\nnoon,2\n", "line 2, column time: 'noon' is neither seconds nor a date"),
    "no time": ("Time,depth\n1,2\n", "no column time; columns found: Time, depth; .* {time: 'Time'}"),
    "no time at all": ("time,depth\n,2\n", "column time is empty"),
    "clock set back": ("time,depth\n10,2\n11,2\n3,2\n", "line 4: time goes back from 11.000 to 3.000 s"),
    "twice": ("time,depth,depth\n1,2,3\n", "column 'depth' twice"),
    "comment": ("# dive 3, lake\n# calm\ntime,depth,x,y\n1,2,3,4\n", "line 1 begins with #, a comment"),
    "no sensor": ("time,x\n1,2\n", "no measurement of any sensor"),
    "validity": (
        "time,dvl_vx,dvl_vy,dvl_vz,dvl_valid\n1,1,1,1,255\n",
        "line 2, column dvl_valid: 255, expected 0 or 1",
    ),
    "latitude": ("time,fix_lat,fix_lon\n1,421234567,31234567\n", "line 2: latitude .* units: {fix: degE7}"),
    "one line": (b"x" * (1 << 20), "first line is longer than a megabyte"),
    "binary": (b"\x7fELF\x02\x01\xff\xfe\x00\x81", "line 1 is not UTF-8 text"),
    "zeros": (b"time,depth\n1,2\n\0\0\0\0", "line 3 holds binary data"),
    "gzip cut off": (gzip.compress(b"time,depth\n1,2\n" * 50)[:-12], "gzip data are damaged"),
    "parquet cut off": (b"PAR1" + bytes(40), "damaged Parquet file"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_files_are_refused_in_one_line(tmp_path, case):
    content, said = HOSTILE[case]
    path = tmp_path / "log.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(InputError, match=said) as caught:
        read_log(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_no_such_file_and_a_directory_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_log(tmp_path / "absent.csv")
    with pytest.raises(InputError, match="is a directory"):
        read_log(tmp_path)


def test_a_last_line_cut_off_is_left_out_with_a_warning(tmp_path):
    with pytest.warns(DataWarning, match="line 4, the last, is cut off"):
        log = read_log(write(tmp_path, "time,depth,dvl_altitude\n1,2,3\n2,2,3\n3,"))
    assert len(log["depth"]) == 2


def test_infinities_are_missing_and_counted(tmp_path):
    with pytest.warns(DataWarning, match="column depth: 2 infinite, .* line 3"):
        log = read_log(write(tmp_path, "time,depth\n1,2\n2,inf\n3,-inf\n4,5\n"))
    assert log["depth"].time.tolist() == [1, 4]


def test_rows_without_time_are_left_out(tmp_path):
    with pytest.warns(DataWarning, match="1 rows without time left out, first in line 3"):
        assert len(read_log(write(tmp_path, "time,depth\n1,2\n,3\n4,5\n"))["depth"]) == 2


def test_a_small_step_back_is_put_in_order(tmp_path):
    with pytest.warns(DataWarning, match="2 rows are earlier than a row above them, sorted; first in line 4"):
        log = read_log(write(tmp_path, "time,depth\n1,1\n2,2\n1.5,3\n1.6,4\n2.6,5\n"))
    assert log["depth"]["depth"].tolist() == [1, 3, 4, 2, 5]
    assert log["depth"].row.tolist() == [2, 4, 5, 3, 6]


def test_one_measurement_stays_at_a_time(tmp_path):
    with pytest.warns(DataWarning) as caught:
        log = read_log(write(tmp_path, "time,depth\n1,1\n1,1\n2,2\n2,3\n2,2\n"))
    said = " ".join(str(w.message) for w in caught)
    assert "depth: 2 measurements repeated exactly, left out; first in line 3" in said
    assert "depth: 1 measurements at the time of another, first kept; first in line 5" in said
    assert log["depth"]["depth"].tolist() == [1, 2]


def test_a_sensor_without_all_its_columns_is_left_out_with_a_warning(tmp_path):
    with pytest.warns(DataWarning, match="dvl is left out: the log has dvl_vx, dvl_vy and no dvl_vz"):
        assert "dvl" not in read_log(write(tmp_path, "time,depth,dvl_vx,dvl_vy\n1,1,1,1\n"))


def test_parquet_without_pyarrow_names_the_extra(tmp_path, monkeypatch):
    def missing(*_, **__):
        raise ImportError("pyarrow")

    path = tmp_path / "log.parquet"
    pd.DataFrame({"time": [0.0], "depth": [1.0]}).to_parquet(path)
    assert len(read_quietly(path)["depth"]) == 1
    monkeypatch.setattr(pd, "read_parquet", missing)
    with pytest.raises(InputError, match=r"rovgraph\[parquet\]"):
        read_log(path)


NUMBER = st.floats(-1e6, 1e6)


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.sampled_from(["mag", "depth", "ahrs"]), NUMBER, NUMBER, NUMBER), min_size=1), st.randoms())
def test_csv_and_parquet_hold_the_same_whatever_the_order_of_columns(tmp_path, events, random):
    columns = ["time", *STREAMS["mag"], *STREAMS["ahrs"], *STREAMS["depth"]]
    frame = pd.DataFrame(np.nan, index=range(len(events)), columns=columns)
    for k, (sensor, *values) in enumerate(events):
        frame.loc[k, "time"] = 1e9 + 0.1 * k
        frame.loc[k, list(STREAMS[sensor])] = values[: len(STREAMS[sensor])]
    random.shuffle(columns)
    frame[columns].to_csv(tmp_path / "a.csv", index=False)
    frame.to_parquet(tmp_path / "a.parquet")
    a, b = read_quietly(tmp_path / "a.csv"), read_quietly(tmp_path / "a.parquet")
    assert a.sensors == b.sensors == {event[0] for event in events}
    for sensor in a.sensors:
        np.testing.assert_array_equal(a[sensor].time, b[sensor].time)
        np.testing.assert_array_equal(a[sensor].data, b[sensor].data)
        np.testing.assert_array_equal(a[sensor].row, b[sensor].row)
        assert len(a[sensor]) == sum(event[0] == sensor for event in events)


def stream(sensor: str, times: list[float]) -> Stream:
    columns = STREAMS[sensor]
    n = len(times)
    return Stream(
        sensor, columns, np.array(times, float), np.arange(n * len(columns), dtype=float).reshape(n, -1), np.arange(n)
    )


def test_measurements_come_in_order_imu_first_then_the_ping():
    streams = [stream("dvl", [1, 2]), stream("depth", [1, 2.5]), stream("imu", [0, 1, 2, 3])]
    log = Log("x", {s.sensor: s for s in streams})
    got = list(log.measurements())
    assert [(m.time, m.sensor) for m in got] == [
        (0, "imu"), (1, "imu"), (1, "dvl"), (1, "depth"), (2, "imu"), (2, "dvl"), (2.5, "depth"), (3, "imu"),
    ]  # fmt: skip
    np.testing.assert_array_equal(got[5].values, log["dvl"].data[1])
    assert got[5].row == 1
    assert list(Log("x", {}).measurements()) == []


def test_long_logs_are_merged_and_read_whole(tmp_path):
    n = 200_000
    log = Log(
        "x", {"imu": stream("imu", list(np.arange(n) * 0.005)), "depth": stream("depth", list(np.arange(n // 10)))}
    )
    assert sum(1 for _ in log.measurements()) == n + n // 10
    frame = pd.DataFrame(np.random.default_rng(0).normal(size=(50_000, 6)), columns=list(STREAMS["imu"]))
    frame.insert(0, "time", 0.01 * np.arange(50_000))
    frame.to_csv(tmp_path / "log.csv", index=False)
    assert len(read_quietly(tmp_path / "log.csv")["imu"]) == 50_000


def test_the_real_dive_is_read_whole_and_without_warning():
    path = DATA / "ictineu" / "log.csv.gz"
    if not path.exists():
        pytest.skip(f"no real data at {path}")
    log = read_quietly(path)
    assert {s: len(log[s]) for s in log.sensors} == {
        "imu": 33457, "ahrs": 33457, "dvl": 5045, "dvl_heading": 5045, "depth": 5045, "fix": 600,
    }  # fmt: skip
    assert np.mean(log["dvl"]["dvl_valid"] == 1) == pytest.approx(0.983, abs=5e-4)
    assert log.origin == pytest.approx((42.20375, 3.10472), abs=1e-4)
