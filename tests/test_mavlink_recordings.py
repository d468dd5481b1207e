"""Telemetry logs and BlueOS recordings: what is read of MAVLink that somebody else has recorded."""

import math
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from autopilot_files import as_json, autopilot_messages, mcap, packed, short_dive, tlog
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from recordings import close, first, read

from rovgraph.errors import InputError
from rovgraph.log import Log
from rovgraph.model.config import Config
from rovgraph.readers.formats import read_recording, recognise

DATA = Path(__file__).parents[2] / "shared" / "data" / "ardusub"
UNIX = 1_700_000_000.0  # of the autopilot's start
SURFACE, DECLINATION_DEG = 101_800.0, 5.0
RESOLUTION = {"imu": 2e-6, "ahrs": 1e-6, "depth": 0.001, "dvl": 1e-6}
FORMS = ("tlog", "each", "together", "both")  # a telemetry log; BlueOS with topics of messages, of all, of both
Sent = tuple[float, Any, tuple[int, int]]  # boot time [s], message, sender


def written(sent: Iterable[Sent], form: str = "tlog", clock: Any = lambda boot: UNIX + boot) -> bytes:
    """A file of messages.

    Parameters
    ----------
    clock : from boot time to the receiver's
    """
    if form == "tlog":
        return tlog(*((clock(time), packed(message, *sender)) for time, message, sender in sent))
    out = []
    for time, message, sender in sent:
        topic, data = as_json(message, *sender)
        for name in {"each": [topic], "together": ["mavlink/out"], "both": ["mavlink/out", topic]}[form]:
            out.append((clock(time), name, data))
    return mcap(out)


@cache
def dive() -> list[Sent]:
    said = autopilot_messages(short_dive(DECLINATION_DEG), np.deg2rad(DECLINATION_DEG), SURFACE)
    sent = [(10.0 + time, message, (1, 1)) for time, message in said]
    for _, message, _ in sent:  # a boot time of 0 means that there is none
        if hasattr(message, "time_usec"):
            message.time_usec += 10_000_000
        elif hasattr(message, "time_boot_ms"):
            message.time_boot_ms += 10_000
    return sent


def attitudes(count: int = 100, start: float = 10.0, rate: float = 20.0) -> list[Sent]:
    times = start + np.arange(count) / rate
    return [
        (t, mavlink.MAVLink_attitude_message(round(1e3 * t), 0.1, 0.2, 0.3, 0.01, 0.02, 0.03), (1, 1)) for t in times
    ]


def raw_imus(count: int, start: float = 10.0, rate: float = 50.0, zeros: bool = False) -> list[Sent]:
    acc = (0, 0, 0) if zeros else (10, -20, -1000)
    times = start + np.arange(count) / rate
    message = mavlink.MAVLink_raw_imu_message
    return [(t, message(round(1e6 * t), *acc, 1, 2, 3, 200, 0, -400), (1, 1)) for t in times]


def in_time(*parts: list[Sent]) -> list[Sent]:
    return sorted((each for part in parts for each in part), key=lambda each: each[0])


@pytest.mark.parametrize("form", FORMS)
def test_a_simulated_dive_comes_back_within_the_messages_resolution(form, tmp_path):
    recording = read(written(dive(), form), tmp_path)
    assert recording.format == ("tlog" if form == "tlog" else "blueos")
    before = Log.from_frame(short_dive(DECLINATION_DEG))
    after = Log.from_arrays(
        *(first(recording, sensor).columns for sensor in RESOLUTION),
        config=Config().changed(depth=recording.settings["depth"]),
    )
    for sensor, resolution in RESOLUTION.items():
        was, now = before[sensor], after[sensor]
        assert len(was) == len(now) > 10
        close(now.time - 10.0, was.time, atol=5.1e-4)  # some stamps are whole milliseconds
        for column in ("acc_x", "gyr_z", "ahrs_yaw", "ahrs_roll", "depth", "dvl_vx", "dvl_vz"):
            if column in now.columns:
                np.testing.assert_allclose(now[column], was[column], atol=resolution, err_msg=column)
    assert recording.settings["environment"]["declination_deg"] == pytest.approx(DECLINATION_DEG)
    assert recording.warnings == ()
    assert recording.clocks[first(recording, "imu").clock].unix_offset == pytest.approx(UNIX, abs=1e-3)


@pytest.mark.parametrize("form", FORMS[:3])
def test_a_position_delta_without_a_time_is_stamped_by_its_arrival_and_never_summed(form, tmp_path):
    delta = mavlink.MAVLink_vision_position_delta_message
    times = 10.0 + np.array([0.0, 0.2, 0.4, 2.0, 2.2])  # pings were dropped in between
    pings = [(t, delta(0, 200_000, [0.0] * 3, [0.1, -0.02, 0.0], 90.0), (255, 0)) for t in times]
    lost = [(12.4, delta(0, 200_000, [0.0] * 3, [9.0, 9.0, 9.0], 0.0), (255, 0))]
    recording = read(written(in_time(attitudes(), pings, lost), form), tmp_path)
    dvl = first(recording, "dvl")
    np.testing.assert_allclose(dvl.columns["dvl_vx"], [0.5] * 5 + [np.nan], rtol=1e-6)
    np.testing.assert_array_equal(dvl.columns["dvl_valid"], [1, 1, 1, 1, 1, 0])
    close(dvl.columns["time"], UNIX + np.append(times, 12.4), atol=1e-5)
    assert recording.clocks[dvl.clock].unix_offset == 0.0
    assert any("without a time" in note for note in recording.notes)


@pytest.mark.parametrize("form", FORMS[:3])
@pytest.mark.parametrize("step", [40_000_000.0, -3.0, 2.5])
def test_a_receivers_clock_that_jumps_moves_no_stamp(step, form, tmp_path):
    delta = mavlink.MAVLink_vision_position_delta_message
    pings = [(t, delta(0, 200_000, [0.0] * 3, [0.1, 0.0, 0.0], 90.0), (255, 0)) for t in 10.0 + 0.2 * np.arange(50)]
    sent = in_time(attitudes(200), pings)
    late = written(sent, form, lambda boot: UNIX + boot - (step if boot < 15.0 else 0.0))
    recording = read(late, tmp_path)
    close(first(recording, "dvl").columns["time"], UNIX + 10.0 + 0.2 * np.arange(50), atol=1e-3)
    assert recording.clocks[first(recording, "ahrs").clock].unix_offset == pytest.approx(UNIX, abs=1e-3)
    assert any(f"was set by {step:+.1f} s" in warning for warning in recording.warnings)


def test_a_link_that_stalls_is_no_clock_that_jumps(tmp_path):
    def stalled(boot: float) -> float:
        return UNIX + (14.0 + 0.01 * (boot - 11.0) if 11.0 < boot < 14.0 else boot)

    recording = read(written(attitudes(200), clock=stalled), tmp_path)
    assert not any("was set" in warning for warning in recording.warnings)
    assert recording.clocks[first(recording, "ahrs").clock].unix_offset == pytest.approx(UNIX, abs=1e-3)


def test_an_autopilot_that_restarts_leaves_its_longest_run(tmp_path):
    times = iter(np.arange(1000) / 20.0)  # of the receiver, which goes on
    sent = [(next(times), message, sender) for _, message, sender in attitudes(60, 500.0) + attitudes(150, 1.0)]
    recording = read(written(sent), tmp_path)
    assert len(first(recording, "ahrs").columns["time"]) == 150
    assert any("restarted 1 times" in warning for warning in recording.warnings)


def test_a_slow_imu_is_said_and_its_rates_are_those_of_the_attitude(tmp_path):
    sent = in_time(attitudes(200), raw_imus(20, rate=2.0))
    recording = read(written(sent), tmp_path)
    imu = first(recording, "imu")
    assert imu.source.startswith("RAW_IMU with ATTITUDE")
    assert np.isfinite(imu.columns["gyr_x"]).sum() == 200 and np.isfinite(imu.columns["acc_x"]).sum() == 20
    assert any("2 samples a second are too few" in w and "SRn_RAW_SENS" in w for w in recording.warnings)
    log = Log.from_arrays(imu.columns)
    np.testing.assert_allclose(log["imu"]["acc_z"], -9.80665)
    np.testing.assert_allclose(log["imu"]["gyr_x"], 0.01, rtol=1e-6)


def test_a_fast_imu_is_taken_as_it_is(tmp_path):
    recording = read(written(in_time(attitudes(50), raw_imus(200))), tmp_path)
    assert first(recording, "imu").source.startswith("RAW_IMU:")
    np.testing.assert_allclose(first(recording, "mag").columns["mag_x"], 20.0)
    assert recording.warnings == (  # the file knows no more
        "the autopilot's declination is not in the file: ahrs_yaw is from true north, state it for the others",
    )


def test_a_field_that_no_place_has_is_warned_of(tmp_path):
    strong = mavlink.MAVLink_raw_imu_message(10_000_000, 0, 0, -1000, 0, 0, 0, 2000, 0, 0)
    recording = read(written(in_time(attitudes(), [(10.0, strong, (1, 1))])), tmp_path)
    assert any("200 uT is nowhere on Earth" in warning for warning in recording.warnings)


def test_an_imu_of_zeros_is_none(tmp_path):
    recording = read(written(in_time(attitudes(), raw_imus(50, zeros=True))), tmp_path)
    assert all(channel.sensor != "imu" for channel in recording.channels)
    assert any("no IMU" in warning for warning in recording.warnings)


def pressures(hpa: Iterable[float], parameters: dict[str, float]) -> list[Sent]:
    sent: list[Sent] = [
        (9.0, mavlink.MAVLink_param_value_message(n.encode(), v, 9, 1, 0), (1, 1)) for n, v in parameters.items()
    ]
    for k, value in enumerate(hpa):
        ms = 10_000 + 500 * k
        sent.append((1e-3 * ms, mavlink.MAVLink_scaled_pressure2_message(ms, value, 0.0, 1000), (1, 1)))
    return sent


def test_pressure_comes_with_what_the_autopilot_states_of_the_water_but_no_surface_that_no_air_has(tmp_path):
    hpa = 1010.0 + 98.0665 * np.minimum(np.arange(60) / 6.0, 5.0)
    for stated in (1818e2, 0.0, 1010e2):
        known = {"BARO_PRIMARY": 1, "BARO1_GND_PRESS": 990e2, "BARO2_GND_PRESS": stated, "BARO_SPEC_GRAV": 1.0}
        recording = read(written(in_time(attitudes(), pressures(hpa, known))), tmp_path)
        np.testing.assert_allclose(first(recording, "depth").columns["pressure"], 100.0 * hpa, rtol=1e-6)
        surface = {"surface_hpa": 1010.0} if stated == 1010e2 else {}
        assert recording.settings["depth"] == {"density_kgm3": 1000.0, **surface}
        assert any(f"{stated / 100:.0f} hPa" in warning for warning in recording.warnings) == (not surface)


def fixes(points: Iterable[tuple[float, float]], fix_type: int = 3, step: int = 1) -> list[Sent]:
    make = mavlink.MAVLink_gps_raw_int_message
    return [
        (
            10.0 + k,
            make((10 + k // step) * 1_000_000, fix_type, round(1e7 * a), round(1e7 * b), 0, 150, 65535, 0, 0, 9),
            (1, 1),
        )
        for k, (a, b) in enumerate(points)
    ]


@pytest.mark.parametrize("form", FORMS[:3])
def test_fixes_count_once(form, tmp_path):
    points = [(58.3 + 1e-5 * (k // 2), 15.1) for k in range(20)]
    fix = first(read(written(in_time(attitudes(), fixes(points, step=2)), form), tmp_path), "fix").columns
    np.testing.assert_allclose(fix["fix_lat"], [58.3 + 1e-5 * k for k in range(10)], atol=1e-7)
    np.testing.assert_allclose(fix["fix_sd"], 4.5)


def test_one_point_that_repeats_is_an_origin_and_no_fix(tmp_path):
    recording = read(written(in_time(attitudes(), fixes([(48.4, -124.6)] * 30))), tmp_path)
    assert all(channel.sensor != "fix" for channel in recording.channels)
    assert recording.settings["environment"]["origin_lon_deg"] == pytest.approx(-124.6)


def test_other_systems_are_not_the_vehicle(tmp_path):
    other = [(t, message, (7, 1)) for t, message, _ in attitudes(20)]
    station = [(t, message, (255, 190)) for t, message, _ in raw_imus(20)]
    recording = read(written(in_time(attitudes(100), other, station)), tmp_path)
    assert len(first(recording, "ahrs").columns["time"]) == 100
    left = {each.name: each.count for each in recording.left}
    assert left["ATTITUDE of 7/1"] == 20 and left["RAW_IMU of 255/190"] == 20


@pytest.mark.parametrize("form", FORMS[:3])
def test_altitude_is_of_a_sonar_that_looks_down(form, tmp_path):
    make = mavlink.MAVLink_distance_sensor_message
    sonar = [
        (10.0 + k, make(10_000, 5, 5000, 150 + k, 4, 0, where, 255), (255, 0)) for k, where in enumerate((25, 0, 25))
    ]
    found = first(read(written(in_time(attitudes(), sonar), form), tmp_path), "dvl_altitude").columns
    np.testing.assert_allclose(found["dvl_altitude"], [1.5, 1.52])


def test_a_speed_estimate_is_a_velocity_of_unsure_axes(tmp_path):
    make = mavlink.MAVLink_vision_speed_estimate_message
    sent = [(10.0 + 0.2 * k, make(1 + k, 0.5, 0.0, 0.1), (255, 0)) for k in range(10)]
    recording = read(written(in_time(attitudes(), sent)), tmp_path)
    assert first(recording, "dvl").columns["dvl_vx"][0] == pytest.approx(0.5)
    assert any("axes" in warning for warning in recording.warnings)


# Damage


@pytest.mark.parametrize("form", ["tlog", "each"])
def test_a_file_that_is_cut_off_is_read_to_there(form, tmp_path):
    data = written(dive(), form)
    whole = first(read(data, tmp_path), "imu").columns["time"]
    time = first(read(data[: len(data) // 2 + 5], tmp_path), "imu").columns["time"]
    assert 0.3 < len(time) / len(whole) < 0.7
    np.testing.assert_array_equal(time, whole[: len(time)])


def test_wrong_checksums_are_counted_and_the_rest_is_read(tmp_path):
    data = bytearray(written(attitudes(200)))
    frame = len(data) // 200
    for k in (50, 51, 120):
        data[k * frame + 8 + 15] ^= 0xFF  # within the payload
    recording = read(bytes(data), tmp_path)
    assert len(first(recording, "ahrs").columns["time"]) == 197
    assert any(left.count == 3 and "checksum" in left.reason for left in recording.left)


def test_a_damaged_chunk_costs_its_own_messages(tmp_path):
    sent = [(t, *as_json(message)) for t, message, _ in attitudes(1000)]
    data = bytearray(mcap([(UNIX + t, *rest) for t, *rest in sent], CompressionType.NONE))
    data[data.index(b'"roll"', len(data) // 2)] ^= 0xFF
    recording = read(bytes(data), tmp_path)
    assert 600 < len(first(recording, "ahrs").columns["time"]) < 1000
    assert any("damaged chunk" in left.reason for left in recording.left)


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_recording_of_blueos_is_recognised_through_its_compression(compression, tmp_path):
    path = tmp_path / "recording"
    path.write_bytes(mcap([(UNIX + t, *as_json(message)) for t, message, _ in attitudes()], compression))
    assert recognise(path).name == "blueos"
    path.write_bytes(mcap([(UNIX, "/imu/data", b"{}")] * 100, compression))
    assert recognise(path) is None or recognise(path).name != "blueos"


def test_topics_that_are_no_mavlink_are_counted_and_fields_of_messages_are_not(tmp_path):
    sent = [(UNIX + t, *as_json(message)) for t, message, _ in attitudes()]
    others = [(UNIX, "services/beacon/log", b"{}")] * 3 + [(UNIX, "mavlink/1/1/GPS_RAW_INT/fix_type", b'{"type": "A"}')]
    left = {each.name: each.count for each in read(mcap(sent + others), tmp_path).left}
    assert left == {"services/beacon/log": 3}


@pytest.mark.parametrize(
    "text", [b"", b"[]", b"{}", b"\xff", b'{"header": {"system_id": 1, "component_id": 1}, "message": 5}']
)
def test_a_message_in_json_that_is_none_is_counted(text, tmp_path):
    sent = [(UNIX + t, *as_json(message)) for t, message, _ in attitudes()]
    recording = read(mcap([*sent, (UNIX + 20, "mavlink/1/1/ATTITUDE", text)]), tmp_path)
    assert len(first(recording, "ahrs").columns["time"]) == 100
    assert any("mavlink2rest" in left.reason and left.count == 1 for left in recording.left)


def test_null_is_no_number(tmp_path):
    broken = mavlink.MAVLink_attitude_message(15_500, 0.1, math.nan, 0.3, 0, 0, 0)
    sent = [*attitudes(), (15.5, broken, (1, 1))]
    for form in ("tlog", "each"):
        pitch = first(read(written(sent, form), tmp_path), "ahrs").columns["ahrs_pitch"]
        assert np.isnan(pitch[-1]) and np.isfinite(pitch[:-1]).all()


@pytest.mark.parametrize(
    "data", [tlog((UNIX, b"\xfd\x00\x00")) * 5, b"\x89MCAP0\r\n", mcap([]), mcap([(UNIX, "mavlink/out", b"{}")])]
)
def test_what_holds_no_measurement_is_refused_in_one_line(data, tmp_path):
    with pytest.raises(InputError) as refused:
        read(data, tmp_path)
    assert "dive.bin" in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(("form", "library"), [("tlog", "pymavlink.dialects.v20"), ("each", "mcap.records")])
def test_a_library_that_is_missing_is_named(form, library, tmp_path, monkeypatch):
    data = written(attitudes(), form)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(InputError, match=r"pip install 'rovgraph\[(online|blueos)\]'"):
        read(data, tmp_path)


@cache
def base(form: str) -> bytes:
    return written(in_time(attitudes(100), raw_imus(100)), form)


@settings(max_examples=30, deadline=None)
@given(
    form=st.sampled_from(("tlog", "each")),
    changes=st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), min_size=1, max_size=20),
)
def test_changed_bytes_raise_nothing_but_a_refusal(form, changes, tmp_path_factory):
    data = bytearray(base(form))
    for place, value in changes:
        data[place % len(data)] = value
    try:
        recording = read(bytes(data), tmp_path_factory.getbasetemp())
    except InputError as refused:
        assert "\n" not in str(refused)
        return
    assert all(len({len(v) for v in channel.columns.values()}) == 1 for channel in recording.channels)


# A real log


def test_a_real_telemetry_log_becomes_a_recording():
    path = DATA / "ardusub_small.tlog.gz"
    if not path.exists():
        pytest.skip("data/ardusub does not lie beside the checkout")
    recording = read_recording(path)
    chosen = {channel.sensor: channel for channel in reversed(recording.channels)}
    # as counted with pymavlink's own reader
    assert len(chosen["ahrs"].columns["time"]) == 5245
    assert len(chosen["depth"].columns["time"]) == 635
    assert np.isfinite(chosen["imu"].columns["acc_x"]).sum() == 528
    assert "fix" not in chosen  # one point that GPS_INPUT repeats
    assert recording.settings["environment"]["declination_deg"] == pytest.approx(15.73, abs=0.01)
    assert recording.clocks["autopilot's boot time"].unix_offset == pytest.approx(1_683_219_851.59, abs=0.01)
    assert any("2 samples a second are too few" in warning for warning in recording.warnings)
    assert {left.name for left in recording.left} >= {"GPS_RAW_INT", "GPS_INPUT of 1/220"}
