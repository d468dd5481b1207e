"""Xsens' binary recordings, written here by `struct`: precisions, worlds, increments, a time that wraps, and damage."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import check_dive_comes_back, check_refused_or_whole, close, first, read

import rovgraph as rg
from rovgraph.errors import InputError
from rovgraph.geometry import matrix_from_rpy, quaternion_from_matrix, rpy_from_matrix
from rovgraph.readers.formats import recognise

ACC, GYR, MAG = (0.1, 0.2, 9.8), (0.01, 0.02, 0.03), (0.5, 0.1, -0.8)
FLU = np.diag([1.0, -1.0, -1.0])
TO_NED = {0x0: np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]]), 0x4: np.eye(3), 0x8: FLU}


def message(data: bytes, kind: int = 0x36) -> bytes:
    length = bytes([len(data)]) if len(data) < 0xFF else b"\xff" + struct.pack(">H", len(data))
    body = b"\xff" + bytes([kind]) + length + data
    return b"\xfa" + body + bytes([-sum(body) % 256])


def item(identifier: int, data: bytes) -> bytes:
    return struct.pack(">HB", identifier, len(data)) + data


def numbers(precision: int, values) -> bytes:
    if precision == 1:
        return b"".join(struct.pack(">i", round(2**20 * v)) for v in values)
    if precision == 2:
        whole = [round(2**32 * v) for v in values]
        return b"".join(struct.pack(">Ih", w & 0xFFFFFFFF, w >> 32) for w in whole)
    return struct.pack(f">{len(values)}{'d' if precision else 'f'}", *values)


def packet(k: int, precision: int = 0, world: int = 0, q=None, *, more: bytes = b"", acc=ACC, gyr=GYR) -> bytes:
    data = item(0x1020, struct.pack(">H", k % 65536)) + item(0x1060, struct.pack(">I", (100 * k) % 2**32)) + more
    if q is not None:
        data += item(0x2010 | world | precision, numbers(precision, q))
    for kind, values in ((0x4020, acc), (0x8020, gyr), (0xC020, MAG)):
        data += item(kind | precision, numbers(precision, values))
    return message(data + item(0x0810 | precision, numbers(precision, [21.5])))


def recorded(count: int = 20, start: int = 0, **given: object) -> bytes:
    return message(b"\x01\x02\x03", 0x01) + b"".join(packet(start + k, **given) for k in range(count))


@pytest.mark.parametrize(("precision", "within"), [(0, 1e-6), (1, 1e-6), (2, 1e-9), (3, 1e-15)])
def test_every_precision_gives_the_same_values(precision, within, tmp_path):
    recording = read(recorded(precision=precision), tmp_path)
    assert recording.format == "mtb"
    for sensor, prefix, expected in (("imu", "acc", ACC), ("imu", "gyr", GYR), ("mag", "mag", MAG)):
        for axis, value in zip("xyz", expected, strict=True):
            close(first(recording, sensor).columns[f"{prefix}_{axis}"], value, atol=within)
    assert {left.reason: left.count for left in recording.left} == {"temperature of the IMU": 20, "message 0x01": 1}


def test_a_time_that_wraps_goes_on(tmp_path):
    close(np.diff(first(read(recorded(start=42_949_660), tmp_path), "imu").columns["time"]), 0.01, atol=1e-9)


@pytest.mark.parametrize("world", TO_NED)
def test_attitude_is_that_of_the_imus_axes_in_ned(world, tmp_path):
    x, y, z, w = quaternion_from_matrix(TO_NED[world].T @ matrix_from_rpy([0.1, -0.2, 1.0]) @ FLU)
    recording = read(recorded(precision=3, world=world, q=(w, x, y, z)), tmp_path)
    ahrs = first(recording, "ahrs").columns
    R_bs = matrix_from_rpy(np.deg2rad(recording.settings["imu"]["mount_rpy_deg"]))
    said = matrix_from_rpy([ahrs[f"ahrs_{name}"][0] for name in ("roll", "pitch", "yaw")])
    close(rpy_from_matrix(said @ R_bs.T), [0.1, -0.2, 1.0], atol=1e-9)


def test_increments_stand_for_acceleration_and_rate(tmp_path):
    data = b""
    for k in range(20):
        half = 0.005 * np.array(GYR)
        q = np.concatenate([[np.sqrt(1.0 - half @ half)], half])
        data += message(
            item(0x1060, struct.pack(">I", 100 * k))
            + item(0x8033, struct.pack(">4d", *q))
            + item(0x4013, struct.pack(">3d", *(0.01 * np.array(ACC))))
        )
    imu = first(read(data, tmp_path), "imu").columns
    close([imu[f"acc_{axis}"][3] for axis in "xyz"], ACC, atol=1e-9)
    close([imu[f"gyr_{axis}"][3] for axis in "xyz"], GYR, atol=1e-8)


@pytest.mark.parametrize(("flags", "known"), [(7, True), (3, False)])
def test_utc_counts_where_the_instrument_knew_it(flags, known, tmp_path):
    time = struct.pack(">IHBBBBBB", 500_000_000, 2023, 11, 14, 22, 13, 20, flags)  # Unix time 1.7e9 and a half
    data = packet(0, more=item(0x1010, time)) + recorded(start=1)
    (clock,) = read(data, tmp_path).clocks.values()
    assert clock.unix_offset == (pytest.approx(1.7e9 + 0.5) if known else None)


def test_damage_is_counted_and_the_rest_is_read(tmp_path):
    broken = bytearray(packet(7))
    broken[20] ^= 1
    recording = read(recorded(20) + bytes(broken) + recorded(3, start=20) + packet(30)[:-9], tmp_path)
    assert len(first(recording, "imu").columns["time"]) == 23
    assert any("sum is wrong" in left.reason and left.count >= 2 for left in recording.left)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (message(b"\x00" * 8, 0x32) * 5, "no acceleration with a rate"),
        (b"".join(message(item(0x4020, numbers(0, ACC))) for _ in range(5)), "no acceleration with a rate"),
        (packet(0, q=(1, 0, 0, 0)) + packet(1, world=4, q=(1, 0, 0, 0)) * 3, "relative to ENU, NED"),
        (
            b"".join(message(item(0x4020, numbers(0, ACC)) + item(0x8020, numbers(0, GYR))) for _ in range(5)),
            "SampleTimeFine",
        ),
    ],
)
def test_a_file_without_use_is_refused_in_one_line(data, said, tmp_path):
    with pytest.raises(InputError, match=said) as refused:
        read(data, tmp_path)
    assert "\n" not in str(refused.value)


def test_text_and_noise_are_no_recording(tmp_path):
    path = tmp_path / "file"
    for data in (b"time,depth\n0,1\n", *(np.random.default_rng(seed).bytes(60_000) for seed in range(20))):
        path.write_bytes(data)
        found = recognise(path)
        assert found is None or found.name != "mtb"


def test_a_recording_that_begins_within_a_message_is_recognised(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(recorded()[90:])
    assert recognise(path).name == "mtb"


def test_increments_without_a_time_are_refused(tmp_path):
    with pytest.raises(InputError, match="SampleTimeFine"):
        read(
            message(item(0x8033, struct.pack(">4d", 1, 0, 0, 0)) + item(0x4013, struct.pack(">3d", *ACC))) * 9, tmp_path
        )


def test_an_attitude_that_is_no_unit_quaternion_is_left_out(tmp_path):
    data = packet(0, q=(0, 0, 0, 0)) + packet(1, q=(np.nan, 0, 0, 1)) + recorded(9, start=2, q=(1, 0, 0, 0))
    recording = read(data, tmp_path)
    close(first(recording, "ahrs").columns["time"], 0.01 * np.arange(2, 11), atol=1e-9)
    assert len(first(recording, "imu").columns["time"]) == 11


def as_recording(log: rg.Log) -> bytes:
    imu, mag = log["imu"], log["mag"]
    field = {round(t, 3): row for t, row in zip(mag.time, mag.data, strict=True)}
    data = b""
    for k, (t, row) in enumerate(zip(imu.time, imu.data, strict=True)):
        body = item(0x1020, struct.pack(">H", k % 65536)) + item(0x1060, struct.pack(">I", round(1e4 * t)))
        body += item(0x4023, struct.pack(">3d", *row[:3])) + item(0x8023, struct.pack(">3d", *row[3:6]))
        if round(t, 3) in field:
            body += item(0xC023, struct.pack(">3d", *field[round(t, 3)]))
        data += message(body)
    return data


def test_a_recorded_dive_is_smoothed_as_its_log_is(tmp_path):
    check_dive_comes_back(as_recording, tmp_path)


@settings(max_examples=50, deadline=None)
@given(changes=st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=4)), max_size=10))
def test_changed_bytes_raise_nothing_but_a_refusal(changes, tmp_path_factory):
    data = bytearray(recorded(9))
    for place, new in changes:
        data[place % len(data) : place % len(data) + 2] = new
    check_refused_or_whole(read, bytes(data), tmp_path_factory.getbasetemp())


@settings(max_examples=50, deadline=None)
@given(bodies=st.lists(st.binary(max_size=300), max_size=6))
def test_packets_of_any_content_raise_nothing_but_a_refusal(bodies, tmp_path_factory):
    data = recorded(4) + b"".join(map(message, bodies)) + recorded(4, start=9)
    check_refused_or_whole(read, data, tmp_path_factory.getbasetemp())
