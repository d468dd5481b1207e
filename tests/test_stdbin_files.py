"""iXblue STDBIN recordings, written here by `struct` as the maker's decoder reads them."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import check_refused_or_whole, close, first, read

from rovgraph.errors import InputError
from rovgraph.readers.formats import recognise

NOON = 12 * 3600.0
DAY = 1_552_521_600.0  # 14 March 2019 [s since 1970]
TICK = 1e-4

Blocks = dict[tuple[int, int], bytes]  # mask, bit: 0 navigation, 1 extended, 2 external


def floats(*values: float) -> bytes:
    return struct.pack(f">{len(values)}f", *values)


def tag(second: float) -> bytes:
    return struct.pack(">i", round(second / TICK))


def frame(second: float, blocks: Blocks, version: int = 3, **masks: int) -> bytes:
    bits = [sum(1 << bit for mask, bit in blocks if mask == k) for k in range(3)]
    body = b"".join(blocks[key] for key in sorted(blocks))
    if version == 2:
        del bits[1]
    head = b"IX" + bytes([version]) + struct.pack(f">{len(bits)}I", *bits)
    more = struct.pack(">H", 0) if version > 3 else b""
    size = len(head) + len(more) + 10 + len(body) + 4
    whole = head + more + struct.pack(">HII", size, round(second / TICK) % 2**32, 7) + body
    return whole + struct.pack(">I", sum(whole))


def date(day: int = 14, month: int = 3, year: int = 2019) -> Blocks:
    return {(0, 13): struct.pack(">BBH", day, month, year)}


def attitude(heading: float, roll: float, pitch: float, sd: float = 0.1) -> Blocks:
    return {(0, 0): floats(heading, roll, pitch), (0, 1): floats(sd, 0.01, 0.01)}


def usbl(second: float, name: bytes = b"ABC", lat: float = 48.9, lon: float = 289.6, cov: float = 1.5) -> Blocks:
    place = struct.pack(">dd", lat, lon) + floats(-40.0, 2.0, 3.0, cov, 1.0)
    return {(2, 6): tag(second) + b"\0" + name.ljust(8, b"\0") + place}


def lbl(second: float, name: bytes = b"7", lat: float = 48.9, bit: int = 14) -> Blocks:
    return {
        (2, bit): tag(second) + b"\0" + name.ljust(8, b"\0") + struct.pack(">dd", lat, 2.0) + floats(-80.0, 238.5, 0.4)
    }


def dvl(second: float, velocity=(0.5, 0.1, -0.02)) -> Blocks:
    return {(2, 10): tag(second) + b"\0" + floats(*velocity, 1483.0, 20.0, 0.003, 0.003, 0.003)}


def recorded(count: int = 9) -> bytes:
    """As an inertial unit on a vehicle sends, its external sensors 50 ms before."""
    return b"".join(
        frame(t, date() | attitude(90.0, 2.0, -3.0) | dvl(t - 0.05) | usbl(t - 0.05) | lbl(t - 0.05))
        for t in (NOON + 0.2 * k for k in range(count))
    )


def test_external_sensors_come_by_their_own_times_and_attitude_by_the_frame_s(tmp_path):
    recording = read(recorded(), tmp_path)
    assert recording.format == "stdbin"
    (clock,) = recording.clocks.values()
    assert clock.unix_offset == pytest.approx(DAY, abs=1e-6)
    for sensor, name, value, late in (
        ("fix", "fix_lat", 48.9, 0.05),
        ("fix", "fix_lon", -70.4, 0.05),
        ("fix", "fix_sd", 2.0, 0.05),
        ("fix", "fix_east_sd", 3.0, 0.05),
        ("fix", "fix_cov_ne", 1.5, 0.05),
        ("range", "range", 238.5, 0.05),
        ("range", "range_beacon", 7.0, 0.05),
        ("range", "range_sd", 0.4, 0.05),
        ("dvl", "dvl_vy", 0.1, 0.05),
        ("dvl", "dvl_sd", 0.003, 0.05),
        ("dvl_altitude", "dvl_altitude", 20.0, 0.05),
        ("vehicle_heading", "heading", np.pi / 2, 0.0),
        ("vehicle_tilt", "roll", np.deg2rad(2.0), 0.0),  # port up
        ("vehicle_tilt", "pitch", np.deg2rad(3.0), 0.0),  # 3 deg bow up, which the unit counts negative
    ):
        columns = first(recording, sensor).columns
        close(columns[name], value, atol=1e-6)
        close(columns["time"], NOON + 0.2 * np.arange(9) - late, atol=1e-6)
    assert recording.settings == {
        "heading": {"vehicle_reference": "true"},
        "dvl": {"mount_rpy_deg": [180.0, 0.0, 0.0], "sound_speed_set_mps": 1483.0},
    }


@pytest.mark.parametrize("version", [2, 3, 4, 5])
def test_every_version_gives_the_same(version, tmp_path):
    recording = read(b"".join(frame(NOON + k, date() | usbl(NOON + k), version) for k in range(5)), tmp_path)
    close(first(recording, "fix").columns["time"], NOON + np.arange(5.0), atol=1e-6)


def test_blocks_that_a_frame_lacks_or_repeats_are_taken_as_often_as_they_were_measured(tmp_path):
    said = [dvl(NOON), dvl(NOON), {}, dvl(NOON + 0.6, (0.7, 0.0, 0.0)), dvl(NOON + 0.6, (0.7, 0.0, 0.0))]
    recording = read(b"".join(frame(NOON + 0.2 * k, date() | more) for k, more in enumerate(said)), tmp_path)
    columns = first(recording, "dvl").columns
    close(columns["time"], [NOON, NOON + 0.6], atol=1e-6)
    close(columns["dvl_vx"], [0.5, 0.7], atol=1e-6)


def test_midnight_is_crossed_and_a_time_of_the_day_before_stays_there(tmp_path):
    parts = []
    for k in range(10):
        second = 86_399.0 + 0.25 * k
        parts.append(frame(second % 86_400.0, date(14 + (second >= 86_400.0)) | dvl((second - 0.1) % 86_400.0)))
    recording = read(b"".join(parts), tmp_path)
    close(first(recording, "dvl").columns["time"], 86_398.9 + 0.25 * np.arange(10), atol=1e-6)
    (clock,) = recording.clocks.values()
    assert clock.unix_offset == pytest.approx(DAY, abs=1e-6)


def test_frames_before_the_clock_was_set_are_left_out(tmp_path):
    unset = b"".join(frame(k, date(1, 1, 2006) | dvl(k)) for k in range(3))
    recording = read(unset + b"".join(frame(NOON + k, date() | dvl(NOON + k)) for k in range(4)), tmp_path)
    close(first(recording, "dvl").columns["time"], NOON + np.arange(4.0), atol=1e-6)
    assert {left.reason: left.count for left in recording.left} == {"before the unit's clock was set": 3}
    (clock,) = read(unset, tmp_path).clocks.values()
    assert clock.unix_offset is None and clock.cycle == 0.0


def test_an_attitude_that_is_not_aligned_is_left_out(tmp_path):
    parts = [frame(NOON + k, date() | attitude(90.0, 0.0, 0.0, sd=60.0 if k < 2 else 0.2)) for k in range(5)]
    recording = read(b"".join(parts), tmp_path)
    assert len(first(recording, "vehicle_heading").columns["time"]) == 3
    assert [left.count for left in recording.left] == [2]


@pytest.mark.parametrize(("force", "kept"), [((0.1, -0.1, 9.8), True), ((0.0, 0.0, 8.0), False)])
def test_raw_acceleration_is_read_where_the_unit_gives_all_its_digits(force, kept, tmp_path):
    raw = {(0, 28): floats(*force), (1, 2): floats(1.0, -2.0, 3.0)}
    data = b"".join(frame(NOON + 0.02 * k, date() | raw | dvl(NOON)) for k in range(50))
    recording = read(data, tmp_path)
    assert ("imu" in {channel.sensor for channel in recording.channels}) is kept
    if kept:
        columns = first(recording, "imu").columns
        close(np.column_stack([columns[f"gyr_{a}"] for a in "xyz"])[0], np.deg2rad([1.0, -2.0, 3.0]), atol=1e-7)
        assert recording.settings["imu"] == {"mount_rpy_deg": [180.0, 0.0, 0.0]}
    else:
        assert "keeps them back" in recording.left[0].reason


def test_places_of_beacons_are_said_as_a_configuration_has_them(tmp_path):
    parts = [frame(NOON + k, date() | lbl(NOON + k) | lbl(NOON + k, b"B2", 48.901, bit=15)) for k in range(3)]
    recording = read(b"".join(parts), tmp_path)
    assert len(first(recording, "range").columns["time"]) == 6
    (said,) = recording.warnings
    assert "environment: {origin_lat_deg: 48.9, origin_lon_deg: 2.0}" in said
    assert "{name: 7, north_m: 0.00, east_m: 0.00, down_m: 80.00}" in said
    assert "{name: B2, north_m: 111.21, east_m: 0.00, down_m: 80.00}" in said


def test_each_transponder_is_a_source_of_fixes_before_satellites(tmp_path):
    gnss = {(2, 1): tag(NOON) + b"\0\4" + struct.pack(">dd", 48.8, 2.0) + floats(0.0, 0.1, 0.2, 0.3, 0.0, 0.0)}
    parts = [frame(NOON + k, date() | usbl(NOON + k, b"ABC" if k % 3 else b"DEF") | gnss) for k in range(9)]
    recording = read(b"".join(parts), tmp_path)
    assert [channel.source for channel in recording.channels] == ["USBL ABC", "USBL DEF", "GNSS 1"]
    assert "fix_cov_ne" not in recording.channels[2].columns
    chosen = read(b"".join(parts), tmp_path, fix="DEF")
    assert chosen.channels[0].source == "USBL DEF"


def test_blocks_behind_one_of_unknown_size_are_named(tmp_path):
    unknown = {(2, 23): b"\0" * 20}
    data = b"".join(frame(NOON + k, date() | usbl(NOON + k) | unknown) for k in range(3))
    recording = read(data, tmp_path)
    assert first(recording, "fix").columns["time"].size == 3
    assert [(left.name, left.count) for left in recording.left] == [("external block 23", 3)]


def test_a_frame_with_a_wrong_sum_is_counted_and_the_next_is_found(tmp_path):
    good = [frame(NOON + k, date() | usbl(NOON + k)) for k in range(5)]
    good[2] = good[2][:-1] + bytes([good[2][-1] ^ 1])
    recording = read(b"noise IX" + b"".join(good) + good[0][:40], tmp_path)
    close(first(recording, "fix").columns["time"], NOON + np.array([0.0, 1.0, 3.0, 4.0]), atol=1e-6)
    assert {left.reason: left.count for left in recording.left} == {"cut off, or with a wrong sum": 2}


def test_navigation_alone_is_refused_in_one_line(tmp_path):
    with pytest.raises(InputError, match="have the unit send its external sensors"):
        read(frame(NOON, date()), tmp_path)


def test_text_that_begins_like_a_frame_is_not_one(tmp_path):
    path = tmp_path / "x.csv"
    path.write_bytes(b"IX\x03," * 2000)
    found = recognise(path)
    assert found is None or found.name != "stdbin"


@settings(max_examples=50, deadline=None)
@given(changes=st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=4)), max_size=10))
def test_changed_bytes_raise_nothing_but_a_refusal(changes, tmp_path_factory):
    data = bytearray(recorded(9))
    for place, new in changes:
        data[place % len(data) : place % len(data) + 2] = new
    check_refused_or_whole(read, bytes(data), tmp_path_factory.getbasetemp())


@settings(max_examples=50, deadline=None)
@given(masks=st.tuples(*[st.integers(0, 2**32 - 1)] * 3), body=st.binary(max_size=300), version=st.integers(3, 5))
def test_frames_of_any_content_raise_nothing_but_a_refusal(masks, body, version, tmp_path_factory):
    any_ = frame(NOON, {(0, 0): body}, version)
    head = any_[:3] + struct.pack(">3I", *masks) + any_[15:-4]
    check_refused_or_whole(read, recorded(3) + head + struct.pack(">I", sum(head)), tmp_path_factory.getbasetemp())
