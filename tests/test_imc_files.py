"""LSTS IMC logs, written here by `struct` as IMC.xml has the messages; two packets are of another writer (imcpy)."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import check_refused_or_whole, close, first, read

from rovgraph.errors import InputError
from rovgraph.readers.acoustic_sentences import crc16
from rovgraph.readers.formats import recognise

START = 1_700_000_000.0
VEHICLE, GATEWAY = 0x15, 0x31
IMU, DVL, DEPTH, GPS, MODEM = 5, 6, 7, 8, 9  # entities
OF_IMCPY = bytes.fromhex(  # UsblFixExtended of "lauv" and LblConfig with beacon "b0"
    "54fe84031f0000002040fc54d941150007ffffff04006c6175769a9999999999e93f9a9999999999b9bf0000000000000020403151"
    "54fecb002000000000000000f0bfffffffffffff000100ca00020062309a9999999999e93f0000000000000000000000000000001a3a"
)


def packet(number: int, second: float, data: bytes, entity: int = IMU, system: int = VEHICLE) -> bytes:
    head = struct.pack("<HHHdHBHB", 0xFE54, number, len(data), START + second, system, entity, 0xFFFF, 0xFF)
    return head + data + struct.pack("<H", crc16(head + data))


def doubles(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}d", *values)


def text(name: str) -> bytes:
    return struct.pack("<H", len(name)) + name.encode()


def entity(number: int, name: str) -> bytes:
    return packet(3, 0.0, bytes([number]) + text(name) + text("task") + bytes(4))


def gps(second: float, valid: int = 0x24, type_: int = 0, system: int = VEHICLE) -> bytes:
    data = struct.pack("<HBHBBfddfB6f", valid, type_, 2023, 11, 14, 0.0, 0.8, -0.1, 0.0, 9, *[0.0] * 4, 3.0, 0.0)
    return packet(253, second, data, GPS, system)


def usbl_fix(second: float, target: str = "lauv", accuracy: float = 2.0) -> bytes:
    return packet(900, second, text(target) + struct.pack("<ddBff", 0.8, -0.1, 1, 30.0, accuracy), MODEM, GATEWAY)


def usbl_position(second: float, system: int = VEHICLE, accuracy: float = 1.0) -> bytes:
    data = struct.pack("<10f", 10.0, 20.0, -30.0, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, accuracy)
    return packet(899, second, text("gw") + data, MODEM, system)


def usbl_angles(second: float, accuracy: float = 0.02) -> bytes:
    data = struct.pack("<8f", 0.5, -0.2, 0.0, 0.0, 0.0, 0.0, 0.0, accuracy)
    return packet(898, second, text("gw") + data, MODEM)


def attitude(second: float, psi: float, magnetic: float, system: int = VEHICLE) -> bytes:
    return packet(254, second, doubles(0.0, 0.01, 0.02, psi, magnetic), system=system)


def beacons() -> bytes:
    places = [
        text(name) + struct.pack("<ddfBBB", lat, -0.1, 30.0, 1, 2, 3) for name, lat in (("a", 0.8), ("b", 0.80001))
    ]
    return packet(203, 0.0, struct.pack("<BH", 1, 2) + b"".join(struct.pack("<H", 202) + place for place in places))


def recorded(count: int = 50) -> bytes:
    parts = [entity(IMU, "AHRS"), entity(DVL, "DVL"), beacons()]
    for k in range(count):
        t = 0.02 * k
        parts += [
            packet(256, t, doubles(0.0, 0.01, 0.02, 0.03)),
            packet(257, t, doubles(0.0, 0.1, 0.2, -9.8)),
            packet(258, t, doubles(0.0, 0.2, 0.0, 0.4)),
            attitude(t, 1.0, 0.95),
        ]
        if k % 10 == 0:
            parts += [
                packet(259, t, b"\7" + doubles(0.5, 0.01, 0.0), DVL),
                packet(265, t, struct.pack("<f", 12.5), DEPTH),
            ]
            parts += [packet(200, t, struct.pack("<Bf", 1, 55.5), MODEM), gps(t), packet(263, t, bytes(4))]
    return b"".join(parts)


def test_a_vehicle_s_log_becomes_the_channels_of_its_sensors(tmp_path):
    recording = read(recorded(), tmp_path)
    assert recording.format == "imc"
    for sensor, name, value, every in (
        ("imu", "acc_z", -9.8, 0.02),
        ("imu", "gyr_z", 0.03, 0.02),
        ("mag", "mag_z", 0.4, 0.02),
        ("ahrs", "ahrs_yaw", 1.0, 0.02),
        ("ahrs", "ahrs_pitch", 0.02, 0.02),
        ("dvl", "dvl_vx", 0.5, 0.2),
        ("dvl", "dvl_valid", 1.0, 0.2),
        ("depth", "depth", 12.5, 0.2),
        ("range", "range", 55.5, 0.2),
        ("range", "range_beacon", 1.0, 0.2),
        ("fix", "fix_lat", np.rad2deg(0.8), 0.2),
        ("fix", "fix_sd", 3.0, 0.2),
    ):
        columns = first(recording, sensor).columns
        close(columns[name], value, atol=1e-6)
        close(columns["time"], START + every * np.arange(round(1.0 / every)), atol=1e-6)
    assert first(recording, "imu").source == "AngularVelocity AHRS"
    assert recording.settings == {"heading": {"ahrs_reference": "true"}}
    assert [(left.name, left.count) for left in recording.left] == [("messages", 5)]
    (said,) = recording.warnings
    assert "{name: 0, north_m: 0.00, east_m: 0.00, down_m: 30.00}, {name: 1, north_m: 63.68," in said


def test_packets_of_another_writer_are_read(tmp_path):
    recording = read(OF_IMCPY, tmp_path)
    (fix,) = recording.channels
    assert fix.source == "UsblFixExtended lauv"
    close(fix.columns["fix_lat"], np.rad2deg(0.8))
    close(fix.columns["fix_sd"], 2.5)
    close(fix.columns["time"], 1_700_000_000.5)


def test_acceleration_that_comes_apart_is_taken_to_the_rate_s_times_but_not_over_a_gap(tmp_path):
    parts = [packet(257, t, doubles(0.0, t, 0.0, -9.8)) for t in (0.0, 0.1, 0.2, 1.5, 1.6)]
    parts += [packet(256, t, doubles(0.0, 0.0, 0.0, 0.0)) for t in (0.05, 0.15, 0.7, 1.55)]
    columns = first(read(b"".join(parts), tmp_path), "imu").columns
    close(columns["time"] - START, [0.05, 0.15, 1.55], atol=1e-6)
    close(columns["acc_x"], [0.05, 0.15, 1.55], atol=1e-6)


def test_a_velocity_that_lacks_an_axis_is_not_valid(tmp_path):
    columns = first(
        read(b"".join(packet(259, k, bytes([7 if k else 5]) + doubles(1, 2, 3)) for k in range(3)), tmp_path), "dvl"
    )
    close(columns.columns["dvl_valid"], [0.0, 1.0, 1.0])
    assert np.isnan(columns.columns["dvl_vx"]).tolist() == [True, False, False]


def test_fixes_by_sound_come_before_satellites_and_replies_they_are_made_of_are_left(tmp_path):
    data = recorded() + b"".join(usbl_fix(k) + usbl_position(k) for k in range(5))
    recording = read(data, tmp_path)
    assert [c.source for c in recording.channels if c.sensor == "fix"] == ["UsblFixExtended lauv", f"GpsFix {GPS}"]
    assert "usbl" not in {channel.sensor for channel in recording.channels}
    assert ("UsblPositionExtended gw", 5) in [(left.name, left.count) for left in recording.left]
    raw = read(data, tmp_path, usbl="gw")
    assert [c.source for c in raw.channels if c.sensor == "fix"] == [f"GpsFix {GPS}"]
    columns = first(raw, "usbl").columns
    close([columns[f"usbl_{axis}"][0] for axis in "xyz"], [10.0, -20.0, 30.0])
    assert raw.settings["usbl"] == {"head": "vehicle", "stamp": "arrival"}


def test_a_gateway_s_log_has_the_ship(tmp_path):
    data = b"".join(
        gps(k, system=GATEWAY) + attitude(k, 1.0, 1.0, GATEWAY) + usbl_position(k, GATEWAY, -1.0 if k == 2 else 1.0)
        for k in range(5)
    )
    recording = read(data, tmp_path)
    assert [c.sensor for c in recording.channels] == ["ship", "ship_heading", "ship_tilt", "usbl"]
    close(first(recording, "ship_heading").columns["ship_heading"], 1.0)
    close(first(recording, "usbl").columns["time"] - START, [0.0, 1.0, 3.0, 4.0])  # a negative accuracy is not valid
    assert recording.settings == {"usbl": {"head": "ship", "stamp": "arrival"}}


def test_directions_alone_are_read_in_the_sense_of_the_log(tmp_path):
    columns = first(read(b"".join(usbl_angles(k) for k in range(3)), tmp_path), "usbl").columns
    close(columns["usbl_bearing"], -0.5)
    close(columns["usbl_elevation"], 0.2)
    close(columns["usbl_angle_sd"], 0.02)


def test_a_heading_that_a_driver_copied_stays_magnetic(tmp_path):
    data = b"".join(attitude(k, 1.0, 1.0) + packet(265, k, struct.pack("<f", 1.0)) for k in range(3))
    recording = read(data, tmp_path)
    assert {c.sensor for c in recording.channels} == {"depth", "vehicle_heading", "vehicle_tilt"}
    assert recording.settings == {}


def test_fixes_without_a_valid_position_and_reckoned_ones_are_left_out(tmp_path):
    data = b"".join(packet(265, k, struct.pack("<f", 1.0)) for k in range(3))
    recording = read(data + gps(0.0) + gps(1.0, valid=0x20) + gps(2.0, type_=2) + gps(3.0, valid=4), tmp_path)
    columns = first(recording, "fix").columns
    close(columns["time"] - START, [0.0, 3.0])
    assert np.isnan(columns["fix_sd"]).tolist() == [False, True]


def test_messages_of_another_size_are_counted(tmp_path):
    recording = read(recorded() + packet(265, 2.0, bytes(8)), tmp_path)
    assert ("of another size than their layout has", 1) in [(left.reason, left.count) for left in recording.left]


def test_messages_of_other_systems_are_left_out_by_name(tmp_path):
    recording = read(recorded() + gps(1.0, system=GATEWAY), tmp_path)
    assert ("of another system than the one that logged", 1) in [(left.reason, left.count) for left in recording.left]


def test_a_wrong_sum_and_a_cut_packet_are_counted(tmp_path):
    good = [packet(265, k, struct.pack("<f", 1.0)) for k in range(5)]
    good[2] = good[2][:-1] + bytes([good[2][-1] ^ 1])
    recording = read(b"".join(good) + good[0][:20] + good[0][:26], tmp_path)
    close(first(recording, "depth").columns["time"] - START, [0.0, 1.0, 3.0, 4.0])
    assert {left.reason: left.count for left in recording.left}["cut off, or with a wrong sum"] >= 2


def test_the_other_order_of_bytes_is_refused_by_name(tmp_path):
    one = struct.pack(">HHHdHBHB", 0xFE54, 265, 4, START, 1, 1, 1, 1) + bytes(6)
    with pytest.raises(InputError, match="high byte first"):
        read(one * 3, tmp_path)


def test_messages_of_no_sensor_are_refused_in_one_line(tmp_path):
    with pytest.raises(InputError, match="hold nothing that a log has"):
        read(packet(263, 0.0, bytes(4)) * 3, tmp_path)


def test_bytes_that_are_no_packets_are_not_recognised(tmp_path):
    path = tmp_path / "x.bin"
    path.write_bytes(b"\x54\xfe" + bytes(range(256)) * 20)
    assert recognise(path) is None


@settings(max_examples=50, deadline=None)
@given(changes=st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=4)), max_size=10))
def test_changed_bytes_raise_nothing_but_a_refusal(changes, tmp_path_factory):
    data = bytearray(recorded(9) + usbl_fix(0.0))
    for place, new in changes:
        data[place % len(data) : place % len(data) + 2] = new
    check_refused_or_whole(read, bytes(data), tmp_path_factory.getbasetemp())


@settings(max_examples=50, deadline=None)
@given(number=st.sampled_from([3, 200, 202, 203, 253, 256, 898, 899, 900]), body=st.binary(max_size=80))
def test_messages_of_any_content_raise_nothing_but_a_refusal(number, body, tmp_path_factory):
    data = recorded(3) + packet(number, 0.0, body) + recorded(3)
    check_refused_or_whole(read, data, tmp_path_factory.getbasetemp())
