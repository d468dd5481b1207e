"""CSV exports and ASCII captures of VectorNav: units, times, checksums, and damage."""

import binascii
from functools import reduce

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

WEEK, TOW = 2315, 490_025.0  # 2024-05-24 16:07:05 GPS time, 18 s ahead of UTC
GPS_S = WEEK * 604_800 + int(TOW)
UNIX = 1_716_566_825.0 - 18.0
ACC, GYR, MAG, YPR = (0.1, 0.2, -9.8), (0.01, -0.02, 0.03), (-0.15, 0.18, 0.5), (57.0, -11.0, 6.0)
INERTIAL = "MagX,MagY,MagZ,Temperature,Pressure,AccelX,AccelY,AccelZ,GyroX,GyroY,GyroZ"
VALUES = (*MAG, 21.5, 101.3, *ACC, *GYR)


def export(times: str, cells, count: int = 20, names: str = INERTIAL, values=VALUES, extra: str = "Yaw,Pitch,Roll"):
    rows = [",".join(map(str, [*cells(k), *YPR, *values])) for k in range(count)]
    return "\r\n".join([f"{times},{extra},{names}", *rows, ""]).encode()


def since_start(k: int) -> list[int]:
    return [5_000_000_000 + 10_000_000 * k]


def sentence(text: str, crc: bool = False, before: str = "") -> str:
    data = text.encode()
    check = f"{binascii.crc_hqx(data, 0):04X}" if crc else f"{reduce(lambda a, b: a ^ b, data):02X}"
    return f"{before}${text}*{check}\r\n"


def numbers(values) -> str:
    return ",".join(f"{value:+.6f}" for value in values)


def ymr(crc: bool = False, before: str = "", acc=ACC) -> str:
    return sentence(f"VNYMR,{numbers((*YPR, *MAG, *acc, *GYR))}", crc, before)


def ins(k: int, week: int = WEEK) -> str:
    return sentence(f"VNINS,{TOW + 0.05 * k:013.6f},{week},8206,{numbers(YPR)},+50.1,+8.1,+1,+0,+0,+0,3.9,1.2,0.1")


def capture(count: int = 5, week: int = WEEK, between: int = 4, **given: object) -> bytes:
    return "".join(ins(k, week) + ymr(**given) * between for k in range(count)).encode()


def check_values(recording: Recording) -> None:
    for sensor, prefix, expected in (("imu", "acc", ACC), ("imu", "gyr", GYR), ("mag", "mag", 100.0 * np.array(MAG))):
        columns = first(recording, sensor).columns
        for axis, value in zip("xyz", expected, strict=True):
            close(columns[f"{prefix}_{axis}"], value, atol=1e-6)
    ahrs = first(recording, "ahrs").columns
    close([ahrs[f"ahrs_{name}"][0] for name in ("yaw", "pitch", "roll")], np.deg2rad(YPR), atol=1e-6)


def test_names_give_units_and_time_since_the_start(tmp_path):
    recording = read(export("TimeStartup", since_start), tmp_path)
    assert recording.format == "vectornav"
    check_values(recording)
    close(first(recording, "imu").columns["time"], 5.0 + 0.01 * np.arange(20), atol=1e-9)
    assert [clock.unix_offset for clock in recording.clocks.values()] == [None]
    assert recording.settings == {"imu": {"mount_rpy_deg": [0.0, 0.0, 0.0]}}
    left = {each.name: each.reason for each in recording.left}
    assert left == {"temperature": "temperature of the IMU", "pressure": "pressure of the housing"}


@pytest.mark.parametrize(
    ("names", "cells"),
    [
        ("TimeGps", lambda k: [1_000_000_000 * GPS_S + 10_000_000 * k]),
        ("TimeGpsTow,TimeGpsWeek", lambda k: [int(1e9 * TOW) + 10_000_000 * k, WEEK]),
        ("TimeGpsTow,TimeGpsWeek", lambda k: [f"{TOW + 0.01 * k:.6f}", WEEK]),
    ],
)
def test_gps_time_in_nanoseconds_or_seconds_becomes_unix_time(names, cells, tmp_path):
    recording = read(export(names, cells), tmp_path)
    close(first(recording, "imu").columns["time"], UNIX + 0.01 * np.arange(20), atol=1e-6)
    assert [clock.unix_offset for clock in recording.clocks.values()] == [0.0]


@pytest.mark.parametrize(("status", "known"), [(7, True), (1, False)])
def test_gps_time_beside_that_since_the_start_gives_its_offset_where_the_status_trusts_it(status, known, tmp_path):
    cells = "TimeStartup,TimeGps,TimeStatus"
    data = export(cells, lambda k: [*since_start(k), 1_000_000_000 * GPS_S + 10_000_000 * k, status])
    (clock,) = read(data, tmp_path).clocks.values()
    assert clock.unix_offset == (pytest.approx(UNIX - 5.0, abs=1e-5) if known else None)


def test_increments_are_divided_by_their_interval(tmp_path):
    values = (*(0.01 * np.array(ACC)), *np.rad2deg(0.01 * np.array(GYR)), 0.01, *MAG)
    names = "DeltaVelX,DeltaVelY,DeltaVelZ,DeltaThetaX,DeltaThetaY,DeltaThetaZ,DeltaTime,MagX,MagY,MagZ"
    recording = read(export("TimeStartup", since_start, names=names, values=values), tmp_path)
    check_values(recording)
    close(first(recording, "imu").columns["time"][0], 4.995, atol=1e-9)


def test_units_that_a_header_states_are_those_of_the_values(tmp_path):
    values = (*MAG, 21.5, 101.3, *(np.array(ACC) / 9.80665), *np.rad2deg(GYR))
    names = INERTIAL
    for axis in "XYZ":
        names = names.replace(f"Gyro{axis}", f"Gyro{axis} [deg/s]").replace(f"Accel{axis}", f"Accel{axis} (g)")
    check_values(read(export("TimeStartup", since_start, names=names, values=values), tmp_path))


def test_fixes_of_the_gnss_receiver_are_read_where_it_has_some(tmp_path):
    names = f"{INERTIAL},Gnss1Lat,Gnss1Lon,Gnss1PosUncertaintyN,Gnss1PosUncertaintyE,Gnss1Fix"
    lines = export("TimeStartup", since_start, 6).decode().splitlines()
    fixes = [f",{50.0 + 1e-6 * k},8.1,3.0,4.0,{3 if k > 1 else 0}" for k in range(6)]
    rows = [line + fix for line, fix in zip(lines[1:], fixes, strict=True)]
    fix = first(read("\n".join([f"TimeStartup,Yaw,Pitch,Roll,{names}", *rows]).encode(), tmp_path), "fix").columns
    close(fix["fix_lat"], 50.0 + 1e-6 * np.arange(2, 6), atol=1e-12)
    close(fix["fix_sd"], np.sqrt(12.5))


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (export("ImuStatus,SyncInCnt", lambda k: [0, 0]), "has no time; export it with TimeStartup"),
        (export("TimeStartup", since_start, 0), "no time"),
        (export("TimeStartup", since_start).replace(b"GyroX", b"GyroX [rpm]"), "the unit 'rpm', expected one of"),
        ("".join(ymr() for _ in range(9)).encode(), "its sentences have no time; record VNINS"),
        (capture().replace(b"VNYMR", b"VNQTN").replace(b"VNINS", b"VNGPE"), "no message with inertial values"),
    ],
)
def test_a_file_without_use_is_refused_in_one_line(data, said, tmp_path):
    with pytest.raises(InputError) as refused:
        read(data, tmp_path)
    assert "\n" not in str(refused.value)
    assert said in str(refused.value) or b"VNQTN" in data


def test_damaged_lines_are_counted_and_other_names_refused(tmp_path):
    data = export("TimeStartup", since_start) + b"1,2\r\n" + export("TimeStartup", since_start, 1).splitlines()[1][:-3]
    recording = read(data + b"x7\r\n", tmp_path)
    assert len(first(recording, "imu").columns["time"]) == 20
    assert sum(left.count for left in recording.left if left.name == "rows") == 2
    with pytest.raises(InputError, match="names its columns twice"):
        read(data + export("TimeStartup", since_start).replace(b"GyroX", b"GyroX [deg/s]"), tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        "time,AccX,AccY,AccZ,GyroX,GyroY,GyroZ\n0,1,2,3,4,5,6\n",
        "Yaw,Pitch,Roll,MagX,MagY,MagZ\n1,2,3,4,5,6\n",
        "time,depth\n0,1\n",
    ],
)
def test_tables_of_others_are_not_taken_for_it(text, tmp_path):
    path = tmp_path / "table.csv"
    path.write_text(text)
    found = recognise(path)
    assert found is None or not found.name.startswith("vectornav")


@pytest.mark.parametrize("crc", [False, True])
def test_sentences_lie_between_those_that_have_a_time(crc, tmp_path):
    recording = read(capture(crc=crc), tmp_path)
    assert recording.format == "vectornav-ascii"
    check_values(recording)
    time = first(recording, "imu").columns["time"]
    close(time, UNIX + 0.01 * np.array([k for k in range(1, 20) if k % 5]), atol=1e-5)
    assert [clock.unix_offset for clock in recording.clocks.values()] == [0.0]
    left = {each.reason: each.count for each in recording.left}
    assert left == {"before the first or after the last one with a time": 4}


def test_a_time_without_a_week_counts_from_the_start(tmp_path):
    (clock,) = read(capture(week=0), tmp_path).clocks.values()
    assert clock.unix_offset is None


@pytest.mark.parametrize("before", ["{:.3f}, ", "{:.3f} "])
def test_a_time_that_a_logger_wrote_is_taken(before, tmp_path):
    data = "".join(ymr(before=before.format(UNIX + 0.01 * k)) for k in range(20)).encode()
    recording = read(data, tmp_path)
    close(first(recording, "imu").columns["time"], UNIX + 0.01 * np.arange(20), atol=1e-3)
    assert any("a logger wrote" in text for text in recording.warnings)


def test_a_wrong_checksum_is_counted_and_skipped(tmp_path):
    data = capture()
    lines = data.splitlines(keepends=True)
    lines[2] = lines[2].replace(b"+0.2", b"+0.3")
    recording = read(b"".join(lines), tmp_path)
    assert len(first(recording, "imu").columns["time"]) == 15
    assert {each.reason: each.count for each in recording.left}["a wrong checksum, or no sentence"] == 1


def test_the_sentence_of_a_manual_is_read(tmp_path):
    manual = "$VNYMR,+100.949,-007.330,+000.715,-00.0049,-00.2449,+00.5397,-01.258,-00.100,-09.701,-00.000018,"
    manual += "+00.001122,-00.000551*69\r\n"
    imu = first(read((ins(0) + manual + ins(1)).encode(), tmp_path), "imu").columns
    close([imu[f"acc_{axis}"][0] for axis in "xyz"], [-1.258, -0.1, -9.701])
    close([imu[f"gyr_{axis}"][0] for axis in "xyz"], [-0.000018, 0.001122, -0.000551], atol=1e-9)


def test_an_export_of_a_dive_is_smoothed_as_its_log_is(tmp_path):
    config = rg.Config().changed(heading={"sources": ["mag"]}, start={"heading_deg": 0.0})
    frame = rg.simulate("circle", config, 1, Choices(duration=40.0)).dive.log_frame
    simulated = rg.Log.from_frame(frame, config)
    imu, mag = simulated["imu"], simulated["mag"]
    field = dict(zip(np.round(mag.time, 3), mag.data, strict=True))
    lines = ["TimeStartup,UncompMagX,UncompMagY,UncompMagZ,UncompAccX,UncompAccY,UncompAccZ,"
             "UncompGyroX,UncompGyroY,UncompGyroZ"]  # fmt: skip
    for t, values in zip(imu.time, imu.data, strict=True):
        cells = [f"{v:.8f}" for v in field[round(t, 3)] / 100.0] if round(t, 3) in field else ["", "", ""]
        lines.append(",".join([str(round(1e9 * t)), *cells, *(f"{v:.8f}" for v in values[:6])]))
    path = tmp_path / "dive.csv"
    path.write_text("\n".join(lines))
    rest = [name for name in frame if not name.startswith(("acc_", "gyr_", "mag_"))]
    frame.loc[frame[rest[1:]].notna().any(axis=1), rest].to_csv(tmp_path / "rest.csv", index=False)
    with pytest.warns(rg.DataWarning, match="check the mounting"):
        log = rg.read_log([path, tmp_path / "rest.csv"], config, shift={"rest.csv": 0.0})
    close(log["imu"].data, imu.data, atol=1e-7)
    close(log["mag"].data, mag.data, atol=1e-6)
    tracks = [rg.smooth(each, config, "smoothed").smoothed.trajectory for each in (simulated, log)]
    close(tracks[1].at(tracks[0].time[1:-1]).p_n, tracks[0].p_n[1:-1], atol=0.02)


@settings(max_examples=50, deadline=None)
@given(
    of=st.sampled_from([export("TimeStartup", since_start, 9), capture(3)]),
    changes=st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=4)), max_size=10),
)
def test_changed_bytes_raise_nothing_but_a_refusal(of, changes, tmp_path_factory):
    data = bytearray(of)
    for place, new in changes:
        data[place % len(data) : place % len(data) + 2] = new
    check_refused_or_whole(read, bytes(data), tmp_path_factory.getbasetemp())


@settings(max_examples=50, deadline=None)
@given(
    bodies=st.lists(st.text("0123456789+-.,;eEnNaAfF xX", max_size=80), max_size=5),
    kind=st.sampled_from(["YMR", "IMU", "INS", "GPS", "ISL"]),
)
def test_sentences_of_any_content_raise_nothing_but_a_refusal(bodies, kind, tmp_path_factory):
    odd = "".join(sentence(f"VN{kind},{body}") for body in bodies).encode()
    check_refused_or_whole(read, capture(2) + odd + capture(2), tmp_path_factory.getbasetemp())
