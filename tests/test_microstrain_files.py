"""Text exports of MicroStrain: both programs' names, units, clocks, rows of several kinds, and damage."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import check_refused_or_whole, close, first, read

import rovgraph as rg
from rovgraph.errors import InputError
from rovgraph.interchange.formats import recognise
from rovgraph.interchange.recording import Recording
from rovgraph.simulate import Choices

G = 9.80665
WEEK, TOW = 2315, 490_025.0  # 2024-05-24 16:07:05 GPS time, 18 s ahead of UTC
UNIX = 1_716_566_825.0 - 18.0
ACC, GYR, MAG, RPY = (0.05, 0.04, -0.995), (0.01, -0.02, 0.03), (-0.15, -0.18, -0.07), (0.1, -0.2, 1.0)
INFO = (
    "FILE_INFO\r\nListSeparator={}\r\nDecimalSeparator={}\r\n\r\n"
    "DEVICE_INFO\r\nModelName,3DM-GX5-45\r\n\r\nDATA_START\r\n"
)
MONITOR = (
    "GPS TFlags,GPS Week,GPS TOW,X Accel [x8004],Y Accel [x8004],Z Accel [x8004],X Gyro [x8005],Y Gyro [x8005],"
    "Z Gyro [x8005],X Mag [x8006],Y Mag [x8006],Z Mag [x8006],Roll [x800C],Pitch [x800C],Yaw [x800C],Lat [x8103],"
    "Long [x8103],Horz Acc [x8103],Flags [x8103],Pressure [x8017],Flags [x8105]"
)
PARTS = ("scaledAccel", "scaledGyro", "scaledMag")


def row(k: int, flags: int = 5, week: int = WEEK, values=(*ACC, *GYR, *MAG, *RPY)) -> str:
    return ",".join(map(str, [flags, week, f"{TOW + 0.01 * k:.6f}", *values, "", "", "", "", 1013.2, ""]))


def fix_row(k: int, flags: int = 31) -> str:
    place = [50.0 + 1e-6 * k, 8.1, 1.5]
    return ",".join(map(str, [3, WEEK, f"{TOW + 0.01 * k:.6f}", *[""] * 12, *place, flags, "", 7]))


def monitor(count: int = 20, head: str = INFO.format("comma", "period"), **given: object) -> bytes:
    return (head + "\r\n".join([MONITOR, *(row(k, **given) for k in range(count)), ""])).encode()


def connect(time: list[str], extra: str = "", cells: str = "", values=(*ACC, *GYR, *MAG)) -> bytes:
    names = ",".join(f"inertial-6253.76535:{part}{axis}" for part in PARTS for axis in "XYZ")
    rows = [f"{t}{cells.format(k)},{','.join(map(str, values))}" for k, t in enumerate(time)]
    return "\n".join([f"Time{extra},{names}", *rows, ""]).encode()


def check_values(recording: Recording) -> None:
    for sensor, prefix, expected in (
        ("imu", "acc", G * np.array(ACC)),
        ("imu", "gyr", GYR),
        ("mag", "mag", 100.0 * np.array(MAG)),
    ):
        columns = first(recording, sensor).columns
        for axis, value in zip("xyz", expected, strict=True):
            close(columns[f"{prefix}_{axis}"], value, atol=1e-9)


def test_descriptors_give_units_and_gps_time_becomes_unix_time(tmp_path):
    recording = read(monitor(), tmp_path)
    assert recording.format == "microstrain"
    check_values(recording)
    imu, ahrs = first(recording, "imu").columns, first(recording, "ahrs").columns
    close(imu["time"], UNIX + 0.01 * np.arange(20), atol=1e-6)
    close([ahrs[f"ahrs_{name}"][0] for name in ("roll", "pitch", "yaw")], RPY)
    assert [clock.unix_offset for clock in recording.clocks.values()] == [0.0]
    assert recording.settings == {"imu": {"mount_rpy_deg": [0.0, 0.0, 0.0]}}
    assert any("z down, as gravity has it" in text for text in recording.warnings)


def test_every_column_is_read_or_named_with_a_reason(tmp_path):
    recording = read(monitor(), tmp_path)
    left = {each.name: (each.count, each.reason) for each in recording.left}
    assert left == {"pressure x8017": (20, "pressure of the housing")}


def test_rows_of_the_gnss_lie_between_those_of_the_imu(tmp_path):
    lines = monitor(12).decode().splitlines()
    lines[-6:-6] = [fix_row(5), fix_row(6), fix_row(6, flags=30)]
    recording = read("\n".join(lines).encode(), tmp_path)
    assert len(first(recording, "imu").columns["time"]) == 12
    fix = first(recording, "fix").columns
    close(fix["fix_lat"], [50.000005, 50.000006], atol=1e-12)
    close(fix["fix_sd"], 1.5)
    close(fix["time"], UNIX + np.array([0.05, 0.06]), atol=1e-6)


def test_a_clock_that_was_never_set_is_the_instruments_own(tmp_path):
    recording = read(monitor(flags=1), tmp_path)
    assert [clock.unix_offset for clock in recording.clocks.values()] == [None]
    assert "counts from its start" in recording.notes[0]
    close(np.diff(first(recording, "imu").columns["time"]), 0.01, atol=1e-6)


def test_rows_from_before_the_clock_was_set_are_left_and_counted(tmp_path):
    data = monitor(20).decode().replace(row(0), row(0, flags=1)).replace(row(1), row(1, flags=1)).encode()
    recording = read(data, tmp_path)
    assert len(first(recording, "imu").columns["time"]) == 18
    assert {left.reason: left.count for left in recording.left}["from before the instrument's clock was set"] == 2


def test_time_of_week_goes_on_over_the_end_of_the_week(tmp_path):
    end = [row(0).replace(f"{TOW:.6f}", f"{604_799.99 + 0.01 * k:.6f}") for k in range(1)]
    begin = [row(0, week=WEEK + 1).replace(f"{TOW:.6f}", f"{0.01 * k:.6f}") for k in range(5)]
    data = "\n".join(["DATA_START", MONITOR, *end, *begin, ""]).encode()
    close(np.diff(first(read(data, tmp_path), "imu").columns["time"]), 0.01, atol=1e-6)


def test_separators_are_those_that_the_file_states(tmp_path):
    table = monitor(head="").decode().replace(",", ";").replace(".", ",")
    check_values(read((INFO.format("semicolon", "comma") + table).encode(), tmp_path))


@pytest.mark.parametrize(
    ("time", "begin", "step"),
    [
        ([f"2024-05-24 16:07:{5 + 0.01 * k:09.6f}" for k in range(20)], UNIX + 18.0, 0.01),
        ([f"5/24/2024 16:07:{5 + 0.01 * k:09.6f}" for k in range(20)], UNIX + 18.0, 0.01),
        ([str(1_716_566_825_000_000_000 + 10_000_000 * k) for k in range(20)], UNIX + 18.0, 0.01),
        ([f"{0.01 * k:.3f}" for k in range(20)], 0.0, 0.01),
    ],
)
def test_the_computers_time_is_taken_with_a_warning_where_there_is_no_other(time, begin, step, tmp_path):
    recording = read(connect(time), tmp_path)
    check_values(recording)
    close(first(recording, "imu").columns["time"], begin + step * np.arange(20), atol=1e-5)
    assert any("those of the computer" in text for text in recording.warnings)


def test_the_instruments_time_goes_before_the_computers(tmp_path):
    data = connect(["2024-05-24 16:07:05"] * 20, ",inertial-6253.76535:referenceTimestamp_referenceTime", ",{}0000000")
    recording = read(data, tmp_path)
    close(first(recording, "imu").columns["time"], 0.01 * np.arange(20), atol=1e-9)
    assert "nanoseconds since the instrument's start" in recording.notes[0]


def test_increments_are_divided_by_the_interval_and_stamped_in_its_middle(tmp_path):
    data = connect([f"{0.01 * k:.3f}" for k in range(20)], values=(*[0.01 * v for v in (*ACC, *GYR)], *MAG))
    recording = read(data.replace(b"scaledAccel", b"deltaVel").replace(b"scaledGyro", b"deltaTheta"), tmp_path)
    check_values(recording)
    close(first(recording, "imu").columns["time"][0], -0.005, atol=1e-6)


def test_units_that_a_header_states_are_those_of_the_values(tmp_path):
    data = connect([f"{0.01 * k:.3f}" for k in range(20)], values=(*[G * v for v in ACC], *np.rad2deg(GYR), *MAG))
    for axis in b"XYZ":
        for part, unit in ((b"scaledAccel", b"[m/s^2]"), (b"scaledGyro", b"[deg/s]")):
            data = data.replace(part + bytes([axis]), part + bytes([axis]) + b" " + unit)
    check_values(read(data, tmp_path))


def test_columns_that_state_different_units_are_converted_each_with_a_warning(tmp_path):
    values = (*ACC, np.rad2deg(GYR[0]), *GYR[1:], *MAG)
    data = connect([f"{0.01 * k:.3f}" for k in range(20)], values=values).replace(b"GyroX", b"GyroX [deg/s]")
    recording = read(data, tmp_path)
    check_values(recording)
    assert any("different units (deg/s, rad/s, rad/s)" in text for text in recording.warnings)


def test_damaged_lines_are_counted_and_the_rest_is_read(tmp_path):
    data = (
        monitor(20) + b"1,2,3\r\n" + row(30).replace("-0.995", "-0.9x5").encode() + b"\r\n\r\n" + row(31)[:-40].encode()
    )
    recording = read(data, tmp_path)
    assert len(first(recording, "imu").columns["time"]) == 20
    counts = {left.reason: left.count for left in recording.left if left.name == "rows"}
    assert counts == {"more or fewer cells than the names": 2, "a cell that is no number": 1}


def test_names_that_come_again_are_left_and_others_refused(tmp_path):
    again = monitor(5) + monitor(5, head="")
    recording = read(again, tmp_path)
    assert len(first(recording, "imu").columns["time"]) == 10
    for other in (b"X Gyro [deg/s]", b"X Gyro [x8005],more"):
        with pytest.raises(InputError, match="names its columns twice, and not alike") as refused:
            read(monitor(5) + monitor(5, head="").replace(b"X Gyro [x8005]", other), tmp_path)
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (monitor(0), "no value of acceleration, rate or attitude"),
        (connect(["yesterday"] * 5), "Time is 'yesterday', expected 2024-05-31"),
        (connect(["1.0"] * 5).replace(b"Time,", b"When,"), "no column of time"),
        (connect(["1.0"] * 5).replace(b"GyroX", b"GyroX [rpm]"), "states the unit 'rpm', expected one of: rad/s"),
    ],
)
def test_a_file_without_use_is_refused_in_one_line(data, said, tmp_path):
    with pytest.raises(InputError, match=said) as refused:
        read(data, tmp_path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "text",
    [
        "time,roll,pitch,yaw\n0,1,2,3\n",
        "Time,AccelX,AccelY,AccelZ,GyroX,GyroY,GyroZ\n0,1,2,3,4,5,6\n",
        "DATA_START\n",
        "DATA_START\nChannel 1,Channel 2\n",
    ],
)
def test_tables_of_others_are_not_taken_for_it(text, tmp_path):
    path = tmp_path / "table.csv"
    path.write_text(text)
    found = recognise(path)
    assert found is None or found.name != "microstrain"


def test_a_file_larger_than_a_block_is_read_whole(tmp_path, monkeypatch):
    whole = read(monitor(50), tmp_path)
    monkeypatch.setattr("rovgraph.interchange.text_table.BLOCK", 700)
    parts = read(monitor(50), tmp_path)
    close(first(parts, "imu").columns["acc_z"], first(whole, "imu").columns["acc_z"])
    assert parts.left == whole.left


def test_an_export_of_a_dive_is_smoothed_as_its_log_is(tmp_path):
    config = rg.Config().changed(heading={"sources": ["mag"]}, start={"heading_deg": 0.0})
    frame = rg.simulate("circle", config, 1, Choices(duration=40.0)).dive.log_frame
    simulated = rg.Log.from_frame(frame, config)
    imu, mag = simulated["imu"], simulated["mag"]
    field = dict(zip(np.round(mag.time, 3), mag.data, strict=True))
    lines = ["DATA_START", MONITOR]
    for t, values in zip(imu.time, imu.data, strict=True):
        cells = [f"{v:.8f}" for v in (*values[:3] / G, *values[3:6])]
        cells += [f"{v:.8f}" for v in field[round(t, 3)] / 100.0] if round(t, 3) in field else ["", "", ""]
        lines.append(",".join(["5", str(WEEK), f"{TOW + t:.9f}", *cells, *[""] * 9]))
    path = tmp_path / "dive.csv"
    path.write_text("\n".join(lines))
    rest = [name for name in frame if not name.startswith(("acc_", "gyr_", "mag_"))]
    frame.loc[frame[rest[1:]].notna().any(axis=1), rest].to_csv(tmp_path / "rest.csv", index=False)
    with pytest.warns(rg.DataWarning, match="check the mounting"):
        log = rg.read_log([path, tmp_path / "rest.csv"], config, shift={"rest.csv": UNIX})
    close(log["imu"].data, imu.data, atol=1e-7)
    close(log["mag"].data, mag.data, atol=1e-6)
    close(log["imu"].time - UNIX, imu.time, atol=1e-6)
    tracks = [rg.smooth(each, config, "smoothed").smoothed.trajectory for each in (simulated, log)]
    close(tracks[1].at(tracks[0].time[1:-1] + UNIX).p_n, tracks[0].p_n[1:-1], atol=0.02)


@settings(max_examples=50, deadline=None)
@given(changes=st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=4)), max_size=10))
def test_changed_bytes_raise_nothing_but_a_refusal(changes, tmp_path_factory):
    data = bytearray(monitor(9))
    for place, new in changes:
        data[place % len(data) : place % len(data) + 2] = new
    check_refused_or_whole(read, bytes(data), tmp_path_factory.getbasetemp())


@settings(max_examples=50, deadline=None)
@given(body=st.binary(max_size=300))
def test_rows_of_any_content_raise_nothing_but_a_refusal(body, tmp_path_factory):
    check_refused_or_whole(read, monitor(4) + body, tmp_path_factory.getbasetemp())
