"""ArduPilot's DataFlash logs: what is read of them, and that damage costs only what is damaged."""

import struct
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from autopilot_files import FORMATS, DataFlashWriter, dataflash_of, short_dive
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink import DFReader
from recordings import close, first

from rovgraph.errors import InputError
from rovgraph.log import Log
from rovgraph.readers.dataflash_messages import read_messages
from rovgraph.readers.formats import ReadingOptions, read_recording, recognise
from rovgraph.readers.recording import Recording

REAL = Path(__file__).parents[2] / "shared" / "data" / "ardusub" / "ardusub_small.BIN.gz"
SURFACE = 101_800.0
DECLINATION_DEG = 5.0


@pytest.fixture(scope="module")
def dive() -> Log:
    return Log.from_frame(short_dive(DECLINATION_DEG))


@cache
def dive_as_dataflash() -> bytes:
    return dataflash_of(short_dive(DECLINATION_DEG), np.deg2rad(DECLINATION_DEG), SURFACE)


@pytest.fixture(scope="module")
def written() -> bytes:
    return dive_as_dataflash()


def read(data: bytes, folder: Path, **choose: str) -> Recording:
    path = folder / "dive.BIN"
    path.write_bytes(data)
    return read_recording(path, ReadingOptions(choose=choose))


def imus(count: int, start: float = 0.0, instances: int = 1, rate: float = 25.0) -> DataFlashWriter:
    writer = DataFlashWriter()
    for k in range(count):
        for instance in range(instances):
            writer.add("IMU", 1e6 * (start + k / rate), instance, 0.1, 0.2, 0.3, 0.0, 0.0, -9.8 - instance, 1, 1)
    return writer


RESOLUTION = {  # of what the log stores
    "imu": 1e-6 * 20.0,
    "mag": 0.051,  # integer mGauss
    "ahrs": np.deg2rad(0.0051),
    "depth": 0.0004 + 0.0005,  # single precision pascals
    "dvl": 1e-5,
}


def test_a_simulated_dive_comes_back_within_the_formats_resolution(dive, written, tmp_path):
    recording = read(written, tmp_path)
    before = dive
    tables = [first(recording, sensor).columns for sensor in RESOLUTION]
    after = Log.from_arrays(*tables)
    for sensor, resolution in RESOLUTION.items():
        was, now = before[sensor], after[sensor]
        assert len(was) == len(now) > 10
        close(now.time, was.time, atol=2e-3 if sensor == "depth" else 2e-5)
        for column in first(recording, sensor).columns:
            if column in now.columns and column not in ("time", "dvl_valid"):
                np.testing.assert_allclose(now[column], was[column], atol=resolution, err_msg=column)
    assert recording.settings["environment"] == {"declination_deg": DECLINATION_DEG}
    assert recording.settings["dvl"] == {"mount_rpy_deg": [0.0, 0.0, 0.0]}
    assert recording.warnings == ()


def test_units_are_those_that_the_log_declares(tmp_path):
    kind, form, columns, _, _ = FORMATS["IMU"]
    degrees = FORMATS | {"IMU": (kind, form, columns, "s#kkkooo--", "F-000CCC--")}
    writer = DataFlashWriter(formats=degrees).add("UNIT", 0, ord("k"), b"deg/s")
    for k in range(20):
        writer.add("IMU", 40_000 * k, 0, 90.0, 0.0, 0.0, 0.0, 0.0, -9800.0, 1, 1)
    columns = first(read(writer.bytes(), tmp_path), "imu").columns
    np.testing.assert_allclose(columns["gyr_x"], np.pi / 2)
    np.testing.assert_allclose(columns["acc_z"], -9.8)


@pytest.mark.parametrize("stored", ["q", "I", "d"])
def test_stamps_of_any_type_become_seconds(stored, tmp_path):
    kind, form, *rest = FORMATS["IMU"]
    writer = DataFlashWriter(formats=FORMATS | {"IMU": (kind, stored + form[1:], *rest)})
    for k in range(20):
        writer.add("IMU", 40_000 * k, 0, 0.1, 0.2, 0.3, 0.0, 0.0, -9.8, 1, 1)
    columns = first(read(writer.bytes(), tmp_path), "imu").columns
    np.testing.assert_allclose(columns["time"], 0.04 * np.arange(20))


def test_a_log_that_declares_no_units_has_those_of_the_documentation_and_says_so(dive, tmp_path):
    data = dataflash_of(short_dive(DECLINATION_DEG), 0.0, SURFACE, units=False)
    recording = read(data, tmp_path)
    for sensor in ("imu", "mag", "ahrs", "dvl"):
        column = {"imu": "gyr_z", "mag": "mag_x", "ahrs": "ahrs_roll", "dvl": "dvl_vx"}[sensor]
        np.testing.assert_allclose(first(recording, sensor).columns[column], dive[sensor][column], atol=0.06)
    assert any("declares no unit of" in note and "MAG.MagX" in note for note in recording.notes)


@pytest.mark.parametrize("unit", [1.0, 1e6])
def test_the_interval_of_a_position_delta_is_read_right_in_seconds_and_in_microseconds(unit, tmp_path):
    """ArduPilot declares microseconds and writes seconds."""
    writer = imus(30)
    for k in range(10):
        writer.add("VISO", 1e6 * (1.0 + 0.2 * k), 0.2 * unit, 0, 0, 0, 0.1, -0.02, 0.0, 50.0)
    dvl = first(read(writer.bytes(), tmp_path), "dvl").columns
    np.testing.assert_allclose(dvl["dvl_vx"], 0.5, rtol=1e-6)
    np.testing.assert_allclose(dvl["time"], 0.9 + 0.2 * np.arange(10), atol=1e-6)


def test_a_dropped_ping_makes_no_long_delta_and_a_lost_one_no_velocity(tmp_path):
    writer = imus(30)
    for k in (0, 1, 2, 6, 7):  # each delta covers its own interval alone
        writer.add("VISO", 1e6 * (1.0 + 0.2 * k), 0.2, 0, 0, 0, 0.1, 0.0, 0.0, 0.0 if k == 7 else 50.0)
    writer.add("VISO", 3e6, 0.0, 0, 0, 0, 0.1, 0.0, 0.0, 50.0)
    dvl = first(read(writer.bytes(), tmp_path), "dvl").columns
    np.testing.assert_allclose(dvl["dvl_vx"], [0.5, 0.5, 0.5, 0.5, np.nan, np.nan], rtol=1e-6)
    np.testing.assert_array_equal(dvl["dvl_valid"], [1, 1, 1, 1, 0, 0])


def test_speed_estimates_are_a_velocity_of_unsure_axes(tmp_path):
    writer = imus(30)
    for k in range(10):
        writer.add("VISV", 1e6 * k, 0, 0, 0.5, 0.0, 0.1, 0.0, 0, 0)
    recording = read(writer.bytes(), tmp_path)
    assert first(recording, "dvl").columns["dvl_vx"][3] == 0.5
    assert any("axes" in warning for warning in recording.warnings)


def test_depth_is_of_the_primary_barometer_and_its_own_surface(tmp_path):
    writer = imus(30).parameters(
        BARO_PRIMARY=1, BARO1_GND_PRESS=99_000.0, BARO2_GND_PRESS=100_000.0, BARO_SPEC_GRAV=1.0
    )
    for k in range(10):
        writer.add("BARO", 1e6 * k, 0, 0, 150_000.0, 0, 1000 * k)
        writer.add("BARO", 1e6 * k, 1, 0, 100_000.0 + 9806.65 * k, 0, 1000 * k)
    recording = read(writer.bytes(), tmp_path)
    depth = first(recording, "depth")
    assert depth.source.startswith("BARO 1")
    np.testing.assert_allclose(depth.columns["pressure"], 100_000.0 + 9806.65 * np.arange(10), rtol=1e-7)
    assert recording.settings["depth"] == {"surface_hpa": 1000.0, "density_kgm3": 1000.0}
    other = read(writer.bytes(), tmp_path, depth="0")
    assert first(other, "depth").source.startswith("BARO 0") and other.settings["depth"]["surface_hpa"] == 990.0
    with pytest.raises(InputError, match="choose one of: BARO 1, BARO 0"):
        read(writer.bytes(), tmp_path, depth="7")


def test_a_surface_pressure_that_no_air_has_is_not_stated(tmp_path):
    writer = imus(30).parameters(BARO_PRIMARY=0, BARO1_GND_PRESS=181_800.0, BARO_SPEC_GRAV=1.0)
    for k in range(100):
        writer.add("BARO", 1e5 * k, 0, 0, 101_000.0 + 9806.65 * 8.0 * min(k / 50, 1), 0, 100 * k)
    recording = read(writer.bytes(), tmp_path)
    assert recording.settings["depth"] == {"density_kgm3": 1000.0}
    assert any("1818 hPa" in warning for warning in recording.warnings)


def test_without_parameters_the_barometer_in_the_water_is_the_one_that_moves(tmp_path):
    writer = imus(30)
    for k in range(50):
        writer.add("BARO", 1e5 * k, 0, 0, 99_000.0 + k, 0, 100 * k)
        writer.add("BARO", 1e5 * k, 1, 0, 101_000.0 + 1000.0 * k, 0, 100 * k)
    recording = read(writer.bytes(), tmp_path)
    assert first(recording, "depth").source.startswith("BARO 1")
    assert any("BARO 1 is taken" in warning for warning in recording.warnings)


def test_parameters_that_change_count_as_they_were_first(tmp_path):
    writer = imus(30).parameters(BARO_PRIMARY=0, BARO_SPEC_GRAV=1.0, BARO1_GND_PRESS=100_000.0, COMPASS_DEC=0.1)
    writer.parameters(BARO1_GND_PRESS=109_806.65, COMPASS_DEC=0.2)
    writer.add("BARO", 1e6, 0, 0, 109_806.65, 0, 1000).add("ATT", 1e6, 0, 0, 0)
    recording = read(writer.bytes(), tmp_path)
    assert recording.settings["depth"]["surface_hpa"] == 1000.0
    assert first(recording, "ahrs").columns["ahrs_yaw"][0] == pytest.approx(-0.1)
    assert sum("changes from" in note for note in recording.notes) == 2


@pytest.mark.parametrize(("logged", "offset", "expected"), [(450, 100, 45.0), (910, 400, 51.0), (1500, 100, 150.0)])
def test_a_compass_keeps_its_offsets_unless_they_make_a_field_that_no_place_has(logged, offset, expected, tmp_path):
    writer = imus(30)
    for k in range(5):
        writer.add("MAG", 1e5 * k, 0, logged, 0, 0, offset, 0, 0, 1, 100_000 * k)
    recording = read(writer.bytes(), tmp_path)
    np.testing.assert_allclose(first(recording, "mag").columns["mag_x"], expected)
    assert any("MAG 0" in warning for warning in recording.warnings) == (expected != 45.0)


def test_a_samples_own_stamp_goes_before_that_of_its_message_even_as_its_counter_wraps(tmp_path):
    writer = imus(30)
    sampled = 2**32 + 1000 * np.arange(-5, 5)  # microseconds, of a counter of 32 bits
    for us in sampled:
        writer.add("MAG", us + 300, 0, 450, 0, 0, 0, 0, 0, 1, int(us) % 2**32)
    np.testing.assert_allclose(first(read(writer.bytes(), tmp_path), "mag").columns["time"], 1e-6 * sampled, atol=1e-7)


def gps(writer: DataFlashWriter, points: np.ndarray, weeks: int = 2260, status: int = 3) -> DataFlashWriter:
    for k, (lat, lon) in enumerate(points):
        writer.add("GPS", 1e6 * (10 + k), 0, status, 1000 * k, weeks, 9, 150, round(1e7 * lat), round(1e7 * lon))
    return writer


def test_fixes_and_utc_come_from_the_receiver(tmp_path):
    points = np.column_stack([58.3 + 1e-5 * np.arange(20), 15.1 + 1e-5 * np.arange(20)])
    recording = read(gps(imus(30), points).bytes(), tmp_path)
    fix = first(recording, "fix").columns
    np.testing.assert_allclose(np.column_stack([fix["fix_lat"], fix["fix_lon"]]), points, atol=1e-7)
    np.testing.assert_allclose(fix["fix_sd"], 4.5)
    (clock,) = recording.clocks.values()
    assert clock.unix_offset == pytest.approx(315_964_800 + 2260 * 604_800 - 18 - 10)


@pytest.mark.parametrize(("status", "point"), [(1, (58.3, 15.1)), (3, (0.0, 0.0))])
def test_no_fix_is_none(status, point, tmp_path):
    recording = read(gps(imus(30), np.array([point] * 5), status=status).bytes(), tmp_path)
    assert all(channel.sensor != "fix" for channel in recording.channels)
    assert sum(left.count for left in recording.left if left.name.startswith("GPS")) == 5


def test_one_point_that_repeats_is_an_origin_and_no_fix(tmp_path):
    recording = read(gps(imus(30), np.array([(48.4, -124.6)] * 30), weeks=0).bytes(), tmp_path)
    assert all(channel.sensor != "fix" for channel in recording.channels)
    assert recording.settings["environment"]["origin_lat_deg"] == pytest.approx(48.4)
    assert any("one point" in warning for warning in recording.warnings)
    (clock,) = recording.clocks.values()
    assert clock.unix_offset is None  # week 0 is no time


def test_utc_comes_from_the_autopilots_clock_where_it_is_logged(tmp_path):
    recording = read(imus(30).add("RTC", 5e6, 1_700_000_000_000_000, 1).bytes(), tmp_path)
    (clock,) = recording.clocks.values()
    assert clock.unix_offset == pytest.approx(1_699_999_995.0)


def test_only_a_rangefinder_that_looks_down_and_has_an_echo_is_an_altitude(tmp_path):
    writer = imus(30)
    for k, (status, orientation) in enumerate([(4, 25), (1, 25), (4, 0), (4, 25)]):
        writer.add("RFND", 1e6 * k, 0, 150 + k, status, orientation)
    altitude = first(read(writer.bytes(), tmp_path), "dvl_altitude").columns
    np.testing.assert_allclose(altitude["dvl_altitude"], [1.5, 1.53])


def test_thrusters_are_by_the_numbers_of_motors(tmp_path):
    writer = imus(30).parameters(SERVO1_FUNCTION=34, SERVO2_FUNCTION=33, SERVO3_FUNCTION=59)
    writer.add("RCOU", 1e6, 1700, 1300, 1900, 0, 0, 0, 0, 0).add("RCOU", 2e6, 0, 1500, 1900, 0, 0, 0, 0, 0)
    columns = first(read(writer.bytes(), tmp_path), "thruster").columns
    np.testing.assert_allclose(columns["thruster_1"], [-0.5, 0.0])
    np.testing.assert_allclose(columns["thruster_2"], [0.5, 0.0])
    assert "thruster_3" not in columns


def test_of_several_imus_one_is_read_and_the_others_are_counted(tmp_path):
    data = imus(30, instances=3).bytes()
    recording = read(data, tmp_path)
    assert [c.source.partition(":")[0] for c in recording.channels] == ["IMU 0"]
    assert [left.count for left in recording.left if left.name == "IMU"] == [60]
    chosen = first(read(data, tmp_path, imu="2"), "imu").columns
    np.testing.assert_allclose(chosen["acc_z"], -11.8, rtol=1e-6)
    with pytest.raises(InputError, match="choose one of: IMU 0, IMU 1, IMU 2"):
        read(data, tmp_path, imu="3")


@pytest.mark.parametrize("form", ["QBfffffBB", "QBffffffB", "QBdddfffBB"])
def test_messages_of_another_format_of_a_name_are_left_and_counted_as_such(form, tmp_path):
    """Of other fields, and of fields that are stored otherwise."""
    columns = ["TimeUS", "I", "GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ", "GH", "AH"][: len(form)]
    writer = imus(30).raw(DataFlashWriter.format(200, 3 + struct.calcsize(f"<{form}"), "IMU", form, ",".join(columns)))
    for k in range(5):
        values = [0.0 if letter in "fd" else 0 for letter in form[1:]]
        writer.raw(b"\xa3\x95\xc8" + struct.pack(f"<{form}", 40_000 * k, *values))
    recording = read(writer.bytes(), tmp_path)
    assert len(first(recording, "imu").columns["time"]) == 30
    assert [(left.count, left.reason) for left in recording.left if left.name == "IMU"] == [
        (5, "of another format of that name")
    ]


def test_an_imu_that_is_too_slow_or_missing_is_warned_of(tmp_path):
    slow = read(imus(30, rate=2.0).bytes(), tmp_path)
    assert any("too few" in warning and "LOG_BITMASK" in warning for warning in slow.warnings)
    without = DataFlashWriter().parameters(COMPASS_DEC=0.1).add("ATT", 1e6, 0, 0, 0)
    assert any("no IMU" in warning for warning in read(without.bytes(), tmp_path).warnings)


def test_lever_arms_that_the_autopilot_knows_are_settings(tmp_path):
    writer = imus(30).parameters(INS_POS1_X=0.1, INS_POS1_Z=-0.05)
    assert read(writer.bytes(), tmp_path).settings["imu"]["lever_arm_m"] == [0.1, 0.0, -0.05]


def test_a_clock_that_goes_back_leaves_the_longest_run(tmp_path):
    writer = imus(20, start=500.0)
    writer.raw(imus(50, start=1.0).add("ATT", 2e6, 100, 0, 0).bytes())
    recording = read(writer.bytes(), tmp_path)
    assert len(first(recording, "imu").columns["time"]) == 50
    assert len(first(recording, "ahrs").columns["time"]) == 1
    assert any("restarted 1 times" in warning for warning in recording.warnings)


# Damage


def test_a_log_that_is_cut_off_is_read_to_there(written, tmp_path):
    whole = first(read(written, tmp_path), "imu").columns["time"]
    for cut in range(1, 60, 7):
        recording = read(written[: len(written) // 2 + cut], tmp_path)
        time = first(recording, "imu").columns["time"]
        assert 0.4 < len(time) / len(whole) < 0.6
        np.testing.assert_array_equal(time, whole[: len(time)])


def test_damage_costs_what_is_damaged_and_is_counted(written, tmp_path):
    whole = first(read(written, tmp_path), "imu").columns["time"]
    middle = len(written) // 2
    for broken in (
        written[:middle] + b"\xa3\x95\x8c noise \xa3\x95\x80" * 5 + written[middle:],
        written[:middle] + written[middle + 1000 :],
        written[:middle] + bytes(500) + written[middle + 500 :],
    ):
        recording = read(broken, tmp_path)
        time = first(recording, "imu").columns["time"]
        assert np.isin(time, whole).all()
        assert len(whole) - 25 <= len(time) <= len(whole)
        assert any("are no messages" in warning for warning in recording.warnings)


def test_an_end_that_was_cut_off_is_said(written, tmp_path):
    said = "the recording was cut off"
    assert not any(said in warning for warning in read(written, tmp_path).warnings)
    for cut in (1, 7):
        (warning,) = [text for text in read(written[:-cut], tmp_path).warnings if said in text]
        assert "within a message" in warning


def test_the_beginning_of_a_log_may_be_damaged(written, tmp_path):
    assert len(read(b"\x00" * 100 + written, tmp_path).channels) > 4


@pytest.mark.parametrize("data", [b"", b"a,b\n1,2\n", b"\xa3\x95", DataFlashWriter.format(128, 89, "FMT", "B", "A")])
def test_what_is_no_log_is_refused_in_one_line(data, tmp_path):
    with pytest.raises(InputError) as refused:
        read(data, tmp_path)
    assert "dive.BIN" in str(refused.value) and "\n" not in str(refused.value)


def test_a_log_without_a_measurement_is_refused(tmp_path):
    with pytest.raises(InputError, match="holds no measurement of a sensor"):
        read(DataFlashWriter().add("XKF1", 1e6, 0, 0.1).bytes(), tmp_path)


def test_formats_that_contradict_themselves_cost_their_messages_alone(tmp_path):
    writer = imus(30)
    for form, columns in (("Qf", "TimeUS"), ("Q?", "TimeUS,A"), ("QQQQ", "TimeUS,A,B,C"), ("QQ", "A,A")):
        writer.raw(DataFlashWriter.format(200, 20, "ATT", form, columns))
    writer.raw(b"\xa3\x95\xc8" + bytes(17))
    assert len(first(read(writer.bytes(), tmp_path), "imu").columns["time"]) == 30


@settings(max_examples=40, deadline=None)
@given(data=st.binary(max_size=2000), head=st.booleans())
def test_no_bytes_raise_anything_but_a_refusal(data, head, tmp_path_factory):
    folder = tmp_path_factory.getbasetemp()
    with_formats = (DataFlashWriter().bytes() if head else b"\xa3\x95\x80") + data
    try:
        read(with_formats, folder)
    except InputError as refused:
        assert "\n" not in str(refused)


@settings(max_examples=40, deadline=None)
@given(changes=st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), min_size=1, max_size=30))
def test_changed_bytes_raise_nothing(changes, tmp_path_factory):
    data = bytearray(dive_as_dataflash()[:60_000])
    for place, value in changes:
        data[place % len(data)] = value
    try:
        recording = read(bytes(data), tmp_path_factory.getbasetemp())
    except InputError:
        return
    assert all(len({len(v) for v in channel.columns.values()}) == 1 for channel in recording.channels)


# A real log


@pytest.fixture(scope="module")
def real(tmp_path_factory) -> Path:
    if not REAL.exists():
        pytest.skip("data/ardusub does not lie beside the checkout")
    import gzip

    path = tmp_path_factory.mktemp("real") / "real.BIN"
    path.write_bytes(gzip.decompress(REAL.read_bytes()))
    return path


def test_a_real_log_is_read_as_pymavlink_reads_it(real):
    wanted = {
        "IMU": ("TimeUS", "GyrZ", "AccZ"),
        "ATT": ("TimeUS", "Yaw"),
        "MAG": ("TimeUS", "MagX"),
        "BARO": ("Press",),
    }
    ours = read_messages(real, wanted)
    theirs, counts = {name: [] for name in wanted}, Counter()
    log = DFReader.DFReader_binary(str(real))
    while (message := log.recv_msg()) is not None:
        counts[message.get_type()] += 1
        if message.get_type() in wanted:
            theirs[message.get_type()].append([getattr(message, f) for f in wanted[message.get_type()]])
    assert ours.counts == counts and ours.damaged == 0
    for name, fields in wanted.items():
        expected = np.array(theirs[name])
        for column, field in enumerate(fields):
            in_unit = ours.messages[name].value(field)
            scale = {"TimeUS": 1e6, "MagX": 1e3}.get(field, 1.0)  # pymavlink leaves multipliers of units alone
            np.testing.assert_allclose(scale * in_unit, expected[:, column], rtol=1e-6)


def test_a_real_log_becomes_a_log(real):
    recording = read_recording(real)
    assert recognise(real).name == "dataflash"
    chosen = {channel.sensor: channel for channel in reversed(recording.channels)}
    assert {s: len(c.columns["time"]) for s, c in chosen.items()} == {
        "imu": 594,
        "mag": 237,
        "ahrs": 237,
        "depth": 237,
        "thruster": 237,
    }
    assert np.median(chosen["imu"].columns["acc_z"]) == pytest.approx(-9.8, abs=0.05)
    assert np.ptp(chosen["depth"].columns["pressure"]) < 200.0  # on a bench
    assert recording.settings["environment"]["declination_deg"] == pytest.approx(15.0)
    assert any("MAG 0: magnitude 91 uT" in warning for warning in recording.warnings)
    log = Log.from_arrays(*(channel.columns for channel in chosen.values()))
    assert {"imu", "mag", "ahrs", "depth", "thruster"} <= log.sensors
