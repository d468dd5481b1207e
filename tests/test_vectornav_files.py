"""CSV exports and ASCII messages of VectorNav: times, worlds, counters that wrap, damage, and a dive."""

from functools import reduce
from operator import xor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import check_dive_comes_back, check_refused_or_whole, close, first, read

import rovgraph as rg
from rovgraph.dates import unix_of_gps
from rovgraph.errors import InputError
from rovgraph.geometry import matrix_from_rpy, quaternion_from_matrix
from rovgraph.readers.formats import recognise
from rovgraph.simulate import Choices

ACC, GYR, MAG = (0.1, -0.2, -9.8), (0.01, 0.02, 0.03), (0.2, 0.05, 0.4)
RPY = (0.1, -0.2, 1.0)
CSV = ["TimeStartup", "TimeGpsTow", "TimeGpsWeek", "TimeStatus"] + [
    f"{part}{axis}" for part in ("UncompMag", "UncompAcc", "UncompGyro", "Mag") for axis in "XYZ"
]
WEEK, TOW_NS = 2300, 490_025 * 10**9


def csv(count: int = 20, names: list[str] = CSV, status: int = 7, **more: object) -> bytes:
    """A CSV export at 100 Hz; ``more`` are columns of one value."""
    lines = [",".join([*names, *more])]
    for k in range(count):
        stamps = [10**9 + 10**7 * k, TOW_NS + 10**7 * k, WEEK, status]
        lines.append(",".join(map(str, [*stamps, 9, 9, 9, *ACC, *GYR, *MAG, *more.values()])))
    return "\n".join([*lines, ""]).encode()


def sentence(kind: str, *cells: object, before: str = "") -> bytes:
    body = ",".join([f"VN{kind}", *(f"{c:+.6f}" if isinstance(c, float) else str(c) for c in cells)])
    return f"{before}${body}*{reduce(xor, body.encode()):02X}\r\n".encode()


DEGREES = np.rad2deg(RPY[::-1]).tolist()
YMR, IMU = [*DEGREES, *MAG, *ACC, *GYR], [*MAG, *ACC, *GYR, 20.5, 101.3]


def ins(tow: float, week: int = WEEK) -> bytes:
    return sentence("INS", tow, week, "0004", *DEGREES, 54.3, 10.1, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.1)


def test_a_csv_is_read_in_si_on_the_time_since_the_start(tmp_path):
    recording = read(csv(), tmp_path)
    assert recording.format == "vectornav"
    imu, mag = first(recording, "imu"), first(recording, "mag")
    close([imu.columns[f"{part}_{a}"][3] for part in ("acc", "gyr") for a in "xyz"], [*ACC, *GYR])
    close([mag.columns[f"mag_{a}"][3] for a in "xyz"], 100.0 * np.array(MAG))
    close(imu.columns["time"][:2], [1.0, 1.01])
    (clock,) = recording.clocks.values()
    assert clock.unix_offset == pytest.approx(float(unix_of_gps(WEEK, TOW_NS * 1e-9)) - 1.0, abs=1e-3)
    assert recording.settings == {"imu": {"mount_rpy_deg": [0.0, 0.0, 0.0]}}


def test_gps_time_that_was_not_set_is_none(tmp_path):
    (clock,) = read(csv(status=1), tmp_path).clocks.values()
    assert clock.unix_offset is None


def test_another_of_two_sources_can_be_chosen(tmp_path):
    chosen = first(read(csv(), tmp_path, mag="UncompMag"), "mag")
    close(chosen.columns["mag_x"], 900.0)


def test_increments_stand_for_acceleration_and_rate(tmp_path):
    names = [name.replace("UncompAcc", "DeltaVel").replace("UncompGyro", "DeltaTheta") for name in CSV]
    imu = first(read(csv(20, names, DeltaTime=0.02), tmp_path), "imu").columns
    close([imu[f"acc_{a}"][0] for a in "xyz"], np.array(ACC) / 0.02)
    close([imu[f"gyr_{a}"][0] for a in "xyz"], np.deg2rad(GYR) / 0.02)


def test_angles_and_quaternions_are_the_same_attitude(tmp_path):
    q = dict(zip(["QuatX", "QuatY", "QuatZ", "QuatS"], quaternion_from_matrix(matrix_from_rpy(RPY)), strict=True))
    recording = read(csv(**dict(zip(["Yaw", "Pitch", "Roll"], DEGREES, strict=True)), **q), tmp_path)
    found = [channel.columns for channel in recording.channels if channel.sensor == "ahrs"]
    assert len(found) == 2
    for columns in found:
        close([columns[f"ahrs_{name}"][0] for name in ("roll", "pitch", "yaw")], RPY, atol=1e-9)


def test_angles_in_enu_are_turned_to_ned_as_gravity_has_it(tmp_path):
    recording = read(csv(Yaw=30.0, Pitch=0.0, Roll=180.0), tmp_path)  # z down in a world whose z is up
    ahrs = first(recording, "ahrs").columns
    close([ahrs["ahrs_roll"][0], ahrs["ahrs_yaw"][0]], [0.0, np.deg2rad(60.0)], atol=1e-9)
    assert any("z of its world points up" in text for text in recording.warnings)


@pytest.mark.parametrize(
    ("kind", "cells"),
    [
        ("YMR", YMR),
        ("IMU", IMU),
        ("QMR", [*map(float, quaternion_from_matrix(matrix_from_rpy(RPY))), *MAG, *ACC, *GYR]),
        ("MAR", [*MAG, *ACC, *GYR]),
        ("DTV", [0.02, *(np.rad2deg(0.02 * np.array(GYR))).tolist(), *(0.02 * np.array(ACC)).tolist()]),
    ],
)
def test_every_kind_of_message_gives_the_same_values(kind, cells, tmp_path):
    data = b"".join(sentence(kind, *cells, before=f"{1.7e9 + 0.02 * k:.2f}, ") for k in range(9))
    recording = read(data, tmp_path)
    assert recording.format == "vectornav-ascii"
    imu = first(recording, "imu").columns
    close([imu[f"{part}_{a}"][0] for part in ("acc", "gyr") for a in "xyz"], [*ACC, *GYR], atol=1e-4)
    close(imu["time"], 1.7e9 + 0.02 * np.arange(9), atol=1e-3)
    for channel in recording.channels:
        if channel.sensor == "mag":
            close(channel.columns["mag_z"], 40.0)
        if channel.sensor == "ahrs":
            close([channel.columns[f"ahrs_{name}"][0] for name in ("roll", "pitch", "yaw")], RPY, atol=1e-5)


@pytest.mark.parametrize(
    ("before", "times"),
    [
        ("[23:59:59.9] ", 86_399.9),
        ("2024-05-31T12:00:00.5 ", 1717156800.5),
        ("1717156800500: ", 1717156800.5),
        ("1717156800500000000,", 1717156800.5),
        ("12.5\t", 12.5),
    ],
)
def test_what_a_logger_wrote_before_a_sentence_is_its_time(before, times, tmp_path):
    recording = read(b"".join(sentence("YMR", *YMR, before=before) for _ in range(4)), tmp_path)
    close(first(recording, "imu").columns["time"], times, atol=1e-3)
    assert [clock.unix_offset for clock in recording.clocks.values()] == [0.0 if times > 1e9 else None]


def test_times_of_the_day_go_on_at_midnight(tmp_path):
    data = sentence("YMR", *YMR, before="23:59:59.95 ") + sentence("YMR", *YMR, before="00:00:00.05 ") * 3
    close(first(read(data, tmp_path), "imu").columns["time"][:2], [86_399.95, 86_400.05])


def test_a_counter_of_microseconds_that_wraps_goes_on(tmp_path):
    counts = [(2**32 - 70_000 + 25_000 * k) % 2**32 for k in range(9)]
    data = b"".join(sentence("QMR", 0.0, 0.0, 0.0, 1.0, *MAG, *ACC, *GYR, "S0000", f"T{c:010}") for c in counts)
    close(np.diff(first(read(data, tmp_path), "imu").columns["time"]), 0.025, atol=1e-9)


@pytest.mark.parametrize(("week", "unix"), [(WEEK, 0.0), (0, None)])
def test_sentences_lie_between_those_with_a_time(week, unix, tmp_path):
    start = 604_799.9 if unix is None else 333_811.9
    data = b"".join(ins((start + 0.1 * k) % 604_800, week) + sentence("IMU", *IMU) for k in range(9)) + ins(1.0, week)
    data = data[: data.rindex(b"$VNINS")]
    recording = read(data, tmp_path)
    close(np.diff(first(recording, "imu").columns["time"]), 0.1, atol=1e-6)
    assert [clock.unix_offset for clock in recording.clocks.values()] == [unix]
    assert recording.settings["heading"] == {"ahrs_reference": "true"}  # VNINS is relative to true north
    assert any("relative to true north" in text for text in recording.warnings)


def test_the_rate_that_the_instrument_states_stamps_sentences_broken_ones_included(tmp_path):
    good = sentence("YMR", *YMR)
    recording = read(sentence("RRG", "07", 40) + good * 3 + good.replace(b"+9", b"+8").replace(b"-9.8", b"-8.8") + good * 3, tmp_path)  # fmt: skip  # noqa: E501
    times = first(recording, "imu").columns["time"]
    close(np.diff(times), [0.025, 0.025, 0.05, 0.025, 0.025])
    assert any("at 40 Hz" in text for text in recording.warnings)
    assert {each.reason: each.count for each in recording.left} == {
        "a wrong checksum, or no sentence": 1, "answer to a command": 1,
    }  # fmt: skip


GYROS = {f"UncompGyro{axis}": f"UncompGyro{axis} [deg/s]" for axis in "XYZ"}


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (sentence("YMR", *YMR) * 9, "its sentences have no time"),
        ((sentence("YMR", *YMR) + sentence("IMU", *IMU)) * 9 + sentence("RRG", "07", 40), "have no time"),
        (sentence("GPE", 1.0, 2.0) * 9, "no message with inertial values or attitude .* it has: VNGPE"),
        (csv(9, ["GpsTag" if "Time" in name and name != "TimeStatus" else name for name in CSV], TimeGps=0), "no time"),
        (csv(9).replace(b"UncompGyroZ", b"UncompGyroZ [deg/s]"), "in different units: UncompGyroX in no stated unit"),
        (
            csv(9) + csv(9, [GYROS.get(name, name) for name in CSV]),
            "names the columns again, in another way",
        ),
        (csv(9, [GYROS.get(n, n).replace("deg/s", "rpm") for n in CSV]), "unknown unit 'rpm'; expected one of: rad/s"),
    ],
)
def test_a_file_that_would_mislead_is_refused_in_one_line(data, said, tmp_path):
    with pytest.raises(InputError, match=said) as refused:
        read(data, tmp_path)
    assert "\n" not in str(refused.value)


def test_units_that_names_state_count(tmp_path):
    imu = first(read(csv(9, [GYROS.get(name, name) for name in CSV]), tmp_path), "imu").columns
    close([imu[f"gyr_{a}"][0] for a in "xyz"], np.deg2rad(GYR))


@pytest.mark.parametrize(
    "data",
    [
        b"time,acc_x,acc_y,acc_z,gyr_x,gyr_y,gyr_z\n0,0,0,-9.8,0,0,0\n",
        b"Time,Yaw,Pitch,Roll,AccelX,AccelY,AccelZ,GyroX,GyroY,GyroZ\n0,0,0,0,0,0,-9.8,0,0,0\n",
        b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n" * 9,
        b"$VNYMR,1,2,3*00\r\n" * 9,
        np.random.default_rng(1).bytes(60_000),
    ],
)
def test_other_files_are_none_of_vectornav(data, tmp_path):
    (tmp_path / "other.csv").write_bytes(data)
    found = recognise(tmp_path / "other.csv")
    assert found is None or not found.name.startswith("vectornav")


def as_csv(log: rg.Log) -> bytes:
    imu, mag = log["imu"], log["mag"]
    field = {round(t, 3): row for t, row in zip(mag.time, mag.data, strict=True)}
    names = ["TimeStartup", *CSV[7:13], *CSV[13:], "SyncInCnt"]
    lines = [",".join(names)]
    for t, row in zip(imu.time, imu.data, strict=True):
        there = field.get(round(t, 3))
        magnetic = [""] * 3 if there is None else [repr(float(v) / 100.0) for v in there[:3]]
        lines.append(",".join([str(round(1e9 * t)), *(repr(float(v)) for v in row[:6]), *magnetic, "0"]))
    return "\n".join([*lines, ""]).encode()


def as_sentences(log: rg.Log) -> bytes:
    """With more digits than the instrument writes, so that the values are the same."""
    field = np.column_stack([np.interp(log["imu"].time, log["mag"].time, column) for column in log["mag"].data.T[:3]])
    data = b""
    for t, row, mag in zip(log["imu"].time, log["imu"].data, field, strict=True):
        cells = [repr(float(v)) for v in (*(mag / 100.0), *row[:6], 20.0, 100.0)]
        data += sentence("IMU", *cells, before=f"{t:.6f} ")
    return data


def test_an_exported_dive_is_smoothed_as_its_log_is(tmp_path):
    check_dive_comes_back(as_csv, tmp_path)


def test_captured_sentences_hold_the_dive(tmp_path):
    log = rg.Log.from_frame(rg.simulate("circle", rg.Config(), 1, Choices(duration=40.0)).dive.log_frame, rg.Config())
    imu = first(read(as_sentences(log), tmp_path), "imu").columns
    close(imu["time"], log["imu"].time)
    close(
        np.column_stack([imu[f"{part}_{a}"] for part in ("acc", "gyr") for a in "xyz"]), log["imu"].data[:, :6], 1e-12
    )


@settings(max_examples=80, deadline=None)
@given(
    changes=st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=4)), max_size=10),
    until=st.integers(1, 4000),
    whole=st.booleans(),
    of=st.sampled_from(
        [csv(9), b"".join(ins(1.0 + k) + sentence("YMR", *YMR, "S0000", f"T{k}") for k in range(9))],
    ),
)
def test_changed_and_truncated_bytes_raise_nothing_but_a_refusal(changes, until, whole, of, tmp_path_factory):
    data = bytearray(of)
    for place, new in changes:
        data[place % len(data) : place % len(data) + 2] = new
    check_refused_or_whole(read, bytes(data if whole else data[:until]), tmp_path_factory.getbasetemp())


@settings(max_examples=80, deadline=None)
@given(
    cells=st.lists(
        st.lists(st.one_of(st.floats(), st.integers(), st.text("0123456789+-.eEnaTSV;", max_size=6)), max_size=16),
        max_size=6,
    ),
    kind=st.sampled_from(["IMU", "YMR", "QMR", "INS", "GPS", "RRG", "DTV"]),
)
def test_sentences_of_any_content_raise_nothing_but_a_refusal(cells, kind, tmp_path_factory):
    data = b"".join(ins(float(k)) for k in range(4)) + b"".join(sentence(kind, *row) for row in cells)
    check_refused_or_whole(read, data, tmp_path_factory.getbasetemp())
