"""CSV exports of MicroStrain: units, worlds, clocks, damage, and a dive that comes back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import check_dive_comes_back, check_refused_or_whole, close, first, read

import rovgraph as rg
from rovgraph.dates import gps_of_unix, unix_of_gps
from rovgraph.errors import InputError
from rovgraph.geometry import matrix_from_rpy, rpy_from_matrix
from rovgraph.readers.formats import recognise

G = 9.80665
WEEK, TOW = 2300, 490_025.0
MONITOR = [
    "GPS TFlags", "GPS Week", "GPS TOW", "X Accel [x8004]", "Y Accel [x8004]", "Z Accel [x8004]", "X Gyro [x8005]",
    "Y Gyro [x8005]", "Z Gyro [x8005]", "X Mag [x8006]", "Y Mag [x8006]", "Z Mag [x8006]", "Roll [x800C]",
    "Pitch [x800C]", "Yaw [x800C]", "Lat [x8103]", "Long [x8103]", "Height [x8103]", "Horz Acc [x8103]",
    "Flags [x8103]",
]  # fmt: skip
ABOVE = ["FILE_INFO", "ListSeparator=comma", "DecimalSeparator=period", "", "DEVICE_INFO", "ModelName,3DM-GX5-45", ""]
VALUES = ["0.1", "-0.2", "-0.97", "0.01", "0.02", "0.03", "0.2", "0.05", "0.4"]
DEVICE = "inertial-6253.76535:"
CONNECT = [f"{part}{axis}" for part in ("scaledAccel", "scaledGyro", "scaledMag") for axis in "XYZ"]


def monitor(count: int = 20, flags: int = 7, week: int = WEEK, start: float = TOW, rpy=(0.0, 0.0, 1.0)) -> bytes:
    """An export of MIP Monitor; its GNSS has a row of its own."""
    lines = [*ABOVE, "DATA_START", ",".join(MONITOR)]
    for k in range(count):
        tow = (start + 0.01 * k) % 604_800
        lines.append(",".join([str(flags), str(week), f"{tow:.6f}", *VALUES, *map(repr, rpy), *[""] * 5]))
    lines.append(",".join(["3", str(week), f"{start + 0.005:.6f}", *[""] * 12, "54.3", "10.1", "40", "2.5", "31"]))
    return "\r\n".join([*lines, ""]).encode()


def connect(rows: list[list[str]], names: list[str] = CONNECT, clock: str = "timeInfo_referenceTime") -> bytes:
    """An export of SensorConnect."""
    lines = [",".join(["Time", *(DEVICE + name for name in [clock, *names])])]
    lines += [",".join(["5/31/2024 12:00:00.500", *row]) for row in rows]
    return "\n".join([*lines, ""]).encode()


def by_reference(count: int = 20, values: list[str] = VALUES) -> list[list[str]]:
    return [[str(10**9 + 10**7 * k), *values] for k in range(count)]


def test_an_export_of_mip_monitor_is_read_in_si(tmp_path):
    recording = read(monitor(), tmp_path)
    assert recording.format == "microstrain"
    imu, mag, fix = (first(recording, sensor).columns for sensor in ("imu", "mag", "fix"))
    close([imu[f"acc_{a}"][3] for a in "xyz"], np.array([0.1, -0.2, -0.97]) * G)
    close([imu[f"gyr_{a}"][3] for a in "xyz"], [0.01, 0.02, 0.03])
    close([mag[f"mag_{a}"][3] for a in "xyz"], [20.0, 5.0, 40.0])
    close([fix["fix_lat"][0], fix["fix_lon"][0], fix["fix_sd"][0]], [54.3, 10.1, 2.5])
    close(imu["time"][:2], [unix_of_gps(WEEK, TOW), unix_of_gps(WEEK, TOW) + 0.01])
    assert recording.settings["imu"]["mount_rpy_deg"] == [0.0, 0.0, 0.0]
    assert [each.reason for each in recording.left] == ["no measurement that a log has: Height [x8103]"]


def test_an_export_of_sensorconnect_is_read_by_the_instruments_own_time(tmp_path):
    imu = first(read(connect(by_reference()), tmp_path), "imu").columns
    close(imu["time"], 1.0 + 0.01 * np.arange(20), atol=1e-9)
    close(imu["acc_z"], -0.97 * G)


@pytest.mark.parametrize(
    ("cell", "unix"),
    [
        ("5/31/2024 12:00:00.500", 1717156800.5),
        ("5/31/2024 12:00:00.500 PM", 1717156800.5),
        ("2024-05-31 12:00:00.500000000", 1717156800.5),
        ("1717156800500000000", 1717156800.5),
        ("12.5", None),
    ],
)
def test_without_it_the_computers_time_counts_with_a_warning(cell, unix, tmp_path):
    data = connect([[*VALUES] for _ in range(9)], CONNECT[1:], CONNECT[0])
    recording = read(data.replace(b"5/31/2024 12:00:00.500", cell.encode()), tmp_path)
    close(first(recording, "imu").columns["time"], 12.5 if unix is None else unix, atol=1e-3)
    assert [clock.unix_offset for clock in recording.clocks.values()] == [None if unix is None else 0.0]
    assert any("stamps are those of the computer" in text for text in recording.warnings)


def test_a_time_of_week_that_wraps_goes_on(tmp_path):
    recording = read(monitor(flags=1, week=0, start=604_799.9), tmp_path)
    close(np.diff(first(recording, "imu").columns["time"]), 0.01, atol=1e-6)
    assert [clock.unix_offset for clock in recording.clocks.values()] == [None]


def test_rows_from_before_the_clock_was_set_are_counted(tmp_path):
    lines = monitor().split(b"\r\n")
    at = lines.index(b"DATA_START") + 2
    lines[at : at + 2] = [line.replace(b"7,2300,490025", b"3,0,17") for line in lines[at : at + 2]]
    recording = read(b"\r\n".join(lines), tmp_path)
    assert len(first(recording, "imu").columns["time"]) == 18
    assert any("before the instrument's clock was set" in each.reason and each.count == 2 for each in recording.left)


@pytest.mark.parametrize(("unix", "seconds"), [(1483228799, 16.0), (1483228800, 18.0), (1483228801, 19.0)])
def test_gps_time_counts_leap_seconds(unix, seconds):
    assert unix_of_gps(1930, seconds) == unix
    assert gps_of_unix(unix) == (1930, seconds)


@pytest.mark.parametrize("world", ["NED", "ENU"])
def test_gravity_tells_relative_to_what_the_attitude_is(world, tmp_path):
    rpy = [0.1, -0.2, 1.0]
    to_world = {"NED": np.eye(3), "ENU": np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])}[world]
    recording = read(monitor(rpy=tuple(rpy_from_matrix(to_world @ matrix_from_rpy(rpy)).tolist())), tmp_path)
    ahrs = first(recording, "ahrs").columns
    close([ahrs[f"ahrs_{name}"][0] for name in ("roll", "pitch", "yaw")], rpy, atol=1e-9)
    assert any("z of its world points up" in text for text in recording.warnings) == (world == "ENU")


@pytest.mark.parametrize(
    ("values", "gyr", "said"),
    [
        (["0.98", "-2.0", "-9.5", *VALUES[3:]], [0.01, 0.02, 0.03], "taken in m/s2"),
        ([*VALUES[:3], "1", "50", "3", *VALUES[6:]], np.deg2rad([1.0, 50.0, 3.0]), "taken in deg/s"),
    ],
)
def test_values_that_the_documented_unit_makes_impossible_are_in_another_one(values, gyr, said, tmp_path):
    recording = read(connect(by_reference(values=values)), tmp_path)
    imu = first(recording, "imu").columns
    close([imu[f"gyr_{a}"][0] for a in "xyz"], gyr)
    assert 9.0 < np.linalg.norm([imu[f"acc_{a}"][0] for a in "xyz"]) < 10.5
    assert any(said in text for text in recording.warnings)


def test_units_that_names_state_count(tmp_path):
    units = dict.fromkeys(CONNECT[:3], "m/s^2") | dict.fromkeys(CONNECT[3:6], "deg/s")
    names = [f"{name} [{units[name]}]" if name in units else name for name in CONNECT]
    imu = first(read(connect(by_reference(values=["0", "0", "-9.8", *VALUES[3:]]), names), tmp_path), "imu").columns
    close([imu["acc_z"][0], imu["gyr_z"][0]], [-9.8, np.deg2rad(0.03)])


def test_a_second_device_in_the_file_is_left(tmp_path):
    data = connect(by_reference()).replace(b"scaledMag", b"x").split(b"\n")
    data[0] += b"," + b",".join(b"inertial-6284.1:scaledGyro" + axis for axis in (b"X", b"Y", b"Z"))
    rows = [line + b",9,9,9" for line in data[1:-1]]
    recording = read(b"\n".join([data[0], *rows, b""]), tmp_path)
    close(first(recording, "imu").columns["gyr_x"], 0.01)
    assert any("inertial-6284.1" in each.reason for each in recording.left)


def test_damaged_rows_and_names_that_come_again_are_counted(tmp_path):
    data = monitor()
    names = ",".join(MONITOR).encode()
    row = data.splitlines()[-2]
    recording = read(data + names + b"\r\n" + row.replace(b"-0.97", b"x") + b"\r\n1,2\r\n" + row + b"\r\n", tmp_path)
    assert len(first(recording, "imu").columns["time"]) == 21
    reasons = {each.reason: each.count for each in recording.left if each.name == "rows"}
    assert reasons == {
        "the names again": 1, "a cell that is no number": 1, "more or fewer cells than the names": 1,
    }  # fmt: skip


RENAMED = connect(by_reference(5)) + connect(by_reference(5), [f"{name} [deg/s]" if "Gyro" in name else name for name in CONNECT])  # fmt: skip  # noqa: E501


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (monitor(0).rsplit(b"\r\n3,", 1)[0], "no column of time"),
        (connect(by_reference()).replace(b"scaledGyroY", b"scaledGyroY [deg/s]"), "in different units"),
        (connect(by_reference()).replace(b"scaledMagX", b"scaledMagX [furlong]"), "in different units"),
        (
            connect(by_reference(), [f"{name} [furlong]" if "Mag" in name else name for name in CONNECT]),
            "unknown unit 'furlong'; expected one of: uT",
        ),
        (RENAMED, "row 6 names the columns again, in another way"),
        (connect(by_reference()).replace(b"Gyro", b"Temp"), "no row with a time and acceleration"),
    ],
)
def test_a_file_that_would_mislead_is_refused_in_one_line(data, said, tmp_path):
    with pytest.raises(InputError, match=said) as refused:
        read(data, tmp_path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "data",
    [
        b"time,acc_x,acc_y,acc_z,gyr_x,gyr_y,gyr_z\n0,0,0,-9.8,0,0,0\n",
        b"Time,Roll,Pitch,Yaw,Latitude,Longitude\n0,0,0,0,54,10\n",
        b"timestamp,AccelX,AccelY,AccelZ,GyroX,GyroY,GyroZ\n0,0,0,-9.8,0,0,0\n",
        b"PacketCounter\tSampleTimeFine\tAcc_X\tAcc_Y\tAcc_Z\n",
        np.random.default_rng(1).bytes(60_000),
    ],
)
def test_other_files_are_none_of_microstrain(data, tmp_path):
    (tmp_path / "other.csv").write_bytes(data)
    found = recognise(tmp_path / "other.csv")
    assert found is None or found.name != "microstrain"


def as_export(log: rg.Log) -> bytes:
    imu, mag = log["imu"], log["mag"]
    field = {round(t, 3): row for t, row in zip(mag.time, mag.data, strict=True)}
    rows = []
    for t, row in zip(imu.time, imu.data, strict=True):
        there = field.get(round(t, 3))
        magnetic = [""] * 3 if there is None else [repr(float(v) / 100.0) for v in there[:3]]
        inertial = [repr(float(v)) for v in (*(row[:3] / G), *row[3:6])]
        rows.append([str(round(1e9 * t)), *inertial, *magnetic])
    return connect(rows)


def test_an_exported_dive_is_smoothed_as_its_log_is(tmp_path):
    check_dive_comes_back(as_export, tmp_path)


@settings(max_examples=60, deadline=None)
@given(
    changes=st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=4)), max_size=10),
    until=st.integers(1, 4000),
    whole=st.booleans(),
    of=st.sampled_from([monitor(6), connect(by_reference(9))]),
)
def test_changed_and_truncated_bytes_raise_nothing_but_a_refusal(changes, until, whole, of, tmp_path_factory):
    data = bytearray(of)
    for place, new in changes:
        data[place % len(data) : place % len(data) + 2] = new
    check_refused_or_whole(read, bytes(data if whole else data[:until]), tmp_path_factory.getbasetemp())
