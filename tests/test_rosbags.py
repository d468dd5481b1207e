"""ROS bags: what sensors say in them comes back, and what is not read is counted."""

import shutil
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from autopilot_files import short_dive
from bags import FORMS, START, Maker, Sent, imu, marine_dvl, of_dive, transform, write, xyz
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import close, first

from rovgraph.errors import InputError
from rovgraph.geometry import matrix_from_rpy, quaternion_from_matrix, rpy_from_matrix
from rovgraph.log import Log
from rovgraph.readers.formats import ReadingOptions, read_recording, recognise
from rovgraph.readers.recording import Recording

FLU = np.diag([1.0, -1.0, -1.0])
NED_OF_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def bag(folder: Path, *sent: Any, form: str = "ros1", **more: Any) -> Path:
    flat = [one for each in sent for one in (each if isinstance(each, list) else [each])]
    return write(folder / ("dive.bag" if form == "ros1" else "dive"), form, sorted(flat, key=lambda s: s.time), **more)


def read(folder: Path, *sent: Any, form: str = "ros1", choose: Any = None, **more: Any) -> Recording:
    return read_recording(bag(folder, *sent, form=form, **more), ReadingOptions(choose=choose or {}))


def left(recording: Recording) -> dict[str, int]:
    return {f"{one.name}: {one.reason}": one.count for one in recording.left}


def imus(count: int = 40, up: float = 9.8, **changes: Any) -> list[Sent]:
    return [imu(0.02 * k, (0.1, 0.2, up), (0.01, 0.02, 0.03), **changes) for k in range(count)]


@cache
def dive() -> Any:
    return short_dive(0.0)


@pytest.mark.parametrize("form", FORMS)
def test_a_simulated_dive_comes_back_within_the_messages_resolution(form, tmp_path):
    recording = read(tmp_path, of_dive(dive()), form=form)
    before = Log.from_frame(dive())
    after = Log.from_arrays(*(first(recording, sensor).columns for sensor in ("imu", "dvl", "depth")))
    for sensor in ("imu", "dvl", "depth"):
        was, now = before[sensor], after[sensor]
        kept = np.isfinite(was.data[:, :1]).all(axis=1)
        close(now.time - START, was.time[kept], atol=1e-6)
        for column in ("acc_x", "gyr_z", "dvl_vx", "dvl_vz"):
            if column in was.columns:
                np.testing.assert_array_equal(now[column], was[column][kept])
    close(after["depth"]["depth"], before["depth"]["depth"], atol=1e-6)  # by the standard atmosphere
    assert recording.clocks["headers of messages"].unix_offset == 0.0
    close(first(recording, "imu").received - first(recording, "imu").columns["time"], 0.004, atol=1e-5)
    assert recording.settings["imu"]["mount_rpy_deg"] == [0.0, 0.0, 0.0]
    assert sum("check the mounting" in warning for warning in recording.warnings) == 2


def test_mcap_of_another_library_is_read(tmp_path):
    from mcap_ros2.writer import Writer

    header = "std_msgs/Header header\n"
    vector = "=" * 80 + "\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
    rest = "=" * 80 + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    rest += "=" * 80 + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    text = header + "geometry_msgs/Vector3 magnetic_field\nfloat64[9] magnetic_field_covariance\n" + vector + rest
    path = tmp_path / "dive.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef("sensor_msgs/msg/MagneticField", text)
        for k in range(20):
            stamp = {"sec": 1_700_000_000 + k, "nanosec": 500_000_000}
            message = {
                "header": {"stamp": stamp, "frame_id": "imu"},
                "magnetic_field": {"x": 2e-5, "y": 1e-6 * k, "z": -4e-5},
                "magnetic_field_covariance": [0.0] * 9,
            }
            writer.write_message("/mag", schema, message, log_time=10**9 * (1_700_000_001 + k), publish_time=0)
        writer.finish()
    mag = first(read_recording(path), "mag").columns
    close(mag["time"], START + 0.5 + np.arange(20), atol=1e-6)
    close(mag["mag_y"], np.arange(20.0))
    close(mag["mag_x"], 20.0)


@pytest.mark.parametrize("world", ["ENU", "NED"])
def test_orientation_becomes_the_imus_axes_in_ned_whichever_way_the_world_is_up(world, tmp_path):
    R_nb = matrix_from_rpy([0.1, -0.2, 1.0])
    R_ns = R_nb @ (FLU if world == "ENU" else np.eye(3))
    q = quaternion_from_matrix(NED_OF_ENU.T @ R_ns if world == "ENU" else R_ns)
    acc = R_ns.T @ [0.0, 0.0, -9.8]
    recording = read(tmp_path, [imu(0.02 * k, acc, (0, 0, 0), q) for k in range(20)])
    ahrs = first(recording, "ahrs").columns
    R_bs = matrix_from_rpy(np.deg2rad(recording.settings["imu"]["mount_rpy_deg"]))
    said = matrix_from_rpy(np.column_stack([ahrs[f"ahrs_{name}"] for name in ("roll", "pitch", "yaw")]))
    close(rpy_from_matrix(said @ R_bs.T), [[0.1, -0.2, 1.0]] * 20, atol=1e-6)


def test_an_orientation_that_is_not_known_is_none(tmp_path):
    unknown = imu(0.5, (0, 0, 9.8), (0, 0, 0), (0, 0, 0, 1))
    unknown.fields["orientation_covariance"] = np.full(9, -1.0)
    recording = read(tmp_path, imus(20), unknown)
    assert {channel.sensor for channel in recording.channels} == {"imu"}
    assert recording.settings["imu"]["mount_rpy_deg"] == [180.0, 0.0, 0.0]


def test_mountings_and_lever_arms_come_from_a_chain_of_static_transforms(tmp_path):
    half = np.sqrt(0.5)
    frames = [
        transform("base_link", "frame", at=(0.1, 0.2, 0.3)),
        transform("frame", "dvl_link", (1, 0, 0, 0), at=(0.0, 0.0, -0.5)),  # z down, y starboard
        transform("/base_link", "imu_link", (0, 0, half, half), at=(0.05, 0, 0)),  # x to port
    ]
    recording = read(tmp_path, imus(), [marine_dvl(0.1 * k, (0.5, 0, 0)) for k in range(8)], frames)
    mounting = {"mount_rpy_deg": [0.0, 0.0, 0.0], "lever_arm_m": [0.1, -0.2, 0.2]}
    assert recording.settings["dvl"] == mounting | {"sound_speed_set_mps": 1500.0}
    assert recording.settings["imu"]["lever_arm_m"] == [0.05, 0.0, 0.0]
    R_bs = matrix_from_rpy(np.deg2rad(recording.settings["imu"]["mount_rpy_deg"]))
    close(R_bs @ [1, 0, 0], [0, -1, 0], atol=1e-6)
    close(R_bs @ [0, 0, 1], [0, 0, -1], atol=1e-6)
    assert recording.warnings == ()


def test_gravity_that_contradicts_the_transforms_is_said(tmp_path):
    recording = read(tmp_path, imus(up=-9.8), transform("base_link", "imu_link"))
    assert any("gravity is upside down" in warning for warning in recording.warnings)


@pytest.mark.parametrize("form", FORMS)
def test_pings_without_lock_and_of_the_water_are_what_they_are(form, tmp_path):
    water = marine_dvl(0.3, (0.2, 0, 0))
    water.fields["velocity_mode"] = 2
    sent = [
        marine_dvl(0.1, (0.5, 0, 0)),
        marine_dvl(0.2, (0, 0, 0), valid=False),
        water,
        marine_dvl(0.4, (1, 0, 0), sd=-1),
    ]
    recording = read(tmp_path, imus(), sent, form=form)
    dvl = first(recording, "dvl").columns
    np.testing.assert_array_equal(dvl["dvl_valid"], [1, 0, 1])
    close(dvl["dvl_sd"], [0.01, np.nan, np.nan])
    np.testing.assert_array_equal(first(recording, "dvl_water").columns["dvl_water_vx"], [0.2])
    assert len(first(recording, "dvl_altitude").columns["time"]) == 2


def a50(time: float, took: float = 0.1, of_validity: bool = False) -> Sent:
    fields = {"velocity": xyz(0.5, 0, 0), "fom": 0.003, "covariance": np.zeros(0), "altitude": 1.5, "beams": []}
    fields |= {"velocity_valid": True, "time": 50.0, "form": "json_v3", "status": 0}
    sent = START + time
    fields |= {"time_of_validity": round(1e6 * (sent - took)), "time_of_transmission": round(1e6 * sent)}
    stamp = sent - took if of_validity else sent + 0.002
    return Sent(time, "/dvl/data", "dvl_msgs/msg/DVL", fields, "dvl_link", stamp)


@pytest.mark.parametrize("form", ["ros1", "sqlite"])
def test_the_time_that_a_report_took_is_taken_off_its_arrival_and_the_interval_is_no_stamp(form, tmp_path):
    recording = read(tmp_path, imus(), [a50(0.1 * k) for k in range(5)], form=form)
    dvl = first(recording, "dvl").columns
    close(dvl["time"], START + 0.1 * np.arange(5) - 0.098, atol=1e-5)
    close(dvl["dvl_sd"], 0.003)
    assert recording.settings["dvl"]["mount_rpy_deg"] == [0.0, 0.0, 0.0]


def test_a_header_of_validity_stays(tmp_path):
    recording = read(tmp_path, imus(), [a50(0.1 * k, of_validity=True) for k in range(5)])
    close(first(recording, "dvl").columns["time"], START + 0.1 * np.arange(5) - 0.1, atol=1e-5)


def test_a_bag_without_definitions_is_read_by_those_that_are_known(tmp_path):
    recording = read(
        tmp_path, imus(), [a50(0.1 * k) for k in range(5)], [marine_dvl(0.1 * k, (1, 0, 0)) for k in range(9)],
        form="sqlite", definitions=False,
    )  # fmt: skip
    assert [c.source for c in recording.channels if c.sensor == "dvl"] == [
        "/dvl (marine_acoustic_msgs/msg/Dvl)",
        "/dvl/data (dvl_msgs/msg/DVL)",
    ]


def twist(time: float, topic: str) -> Sent:
    body = {"twist": {"linear": xyz(0.4, 0, 0), "angular": xyz(0, 0, 0)}, "covariance": np.full(36, 1e-4)}
    return Sent(time, topic, "geometry_msgs/msg/TwistWithCovarianceStamped", {"twist": body}, "dvl_link")


def test_a_velocity_of_no_dvl_is_one_only_if_it_is_chosen(tmp_path):
    path = bag(tmp_path, imus(), [twist(0.1 * k, "/velocity") for k in range(5)])
    recording = read_recording(path)
    assert not any(channel.sensor == "dvl" for channel in recording.channels)
    (told,) = [w for w in recording.warnings if w.startswith("no DVL in the bag; its topics: ")]
    assert "/imu/data (sensor_msgs/msg/Imu), /velocity (geometry_msgs/msg/TwistWithCovarianceStamped)" in told
    chosen = read_recording(path, ReadingOptions(choose={"dvl": "/velocity"}))
    close(first(chosen, "dvl").columns["dvl_sd"], 0.01)
    assert chosen.settings["dvl"]["mount_rpy_deg"] == [180.0, 0.0, 0.0]


def test_what_is_chosen_and_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"dvl cannot come from '/x'; choose one of: /a/dvl, /b/dvl"):
        read(tmp_path, twist(0.0, "/a/dvl"), twist(0.1, "/b/dvl"), choose={"dvl": "/x"})


def test_topics_of_other_types_are_counted_and_never_decoded(tmp_path):
    image = {"height": 1, "width": 4, "encoding": "mono8", "is_bigendian": 0, "step": 4, "data": np.zeros(4, np.uint8)}
    recording = read(tmp_path, imus(), [Sent(0.1 * k, "/camera", "sensor_msgs/msg/Image", image) for k in range(7)])
    assert left(recording) == {"/camera (sensor_msgs/msg/Image): no measurement of a sensor": 7}


def test_a_bag_without_a_sensor_is_refused_by_its_topics(tmp_path):
    fields = {"data": "hello"}
    with pytest.raises(InputError, match=r"holds no measurement of a sensor; topics: /chat \(std_msgs/msg/String\): 3"):
        read(tmp_path, [Sent(0.1 * k, "/chat", "std_msgs/msg/String", fields) for k in range(3)])


def test_fixes_are_those_of_a_receiver_that_has_one(tmp_path):
    def fix(k: int, status: int, kind: int = 2) -> Sent:
        fields = {"status": {"status": status, "service": 1}, "latitude": 50.0 + 1e-5 * k, "longitude": 8.0}
        fields |= {"altitude": 0.0, "position_covariance": np.array([9.0, 2.0, 0.0, 2.0, 4.0, 0.0, 0.0, 0.0, 9.0])}
        return Sent(0.1 * k, "/fix", "sensor_msgs/msg/NavSatFix", fields | {"position_covariance_type": kind}, "gps")

    recording = read(tmp_path, imus(), [fix(0, 0), fix(1, -1), fix(2, 0), fix(3, 0, 0)])
    fixes = first(recording, "fix").columns
    close(fixes["fix_sd"], [2.0, 2.0, np.nan])  # its covariance counts from east
    close(fixes["fix_east_sd"], [3.0, 3.0, np.nan])
    close(fixes["fix_cov_ne"], [2.0, 2.0, np.nan])
    close(fixes["fix_lat"], 50.0 + 1e-5 * np.array([0, 2, 3]))
    assert left(recording) == {"/fix (sensor_msgs/msg/NavSatFix): no fix": 1}


# Clocks


def test_stamps_of_a_clock_that_was_never_set_have_their_own_clock(tmp_path):
    recording = read(tmp_path, [one._replace(stamp=77.0 + one.time) for one in imus()])
    channel = first(recording, "imu")
    close(channel.columns["time"], 77.0 + 0.02 * np.arange(40), atol=1e-6)
    assert recording.clocks[channel.clock].unix_offset == pytest.approx(START - 77.0 + 0.004, abs=1e-4)
    assert "apart from the recorder's clock" in " ".join(recording.warnings)


def test_headers_without_a_stamp_are_taken_by_arrival_and_said(tmp_path):
    recording = read(tmp_path, [one._replace(stamp=0.0) for one in imus()])
    close(first(recording, "imu").columns["time"], START + 0.02 * np.arange(40) + 0.004, atol=1e-5)
    assert "stamps are empty; those of arrival are taken" in " ".join(recording.warnings)


@pytest.mark.parametrize("step", [-20.0, -1.6e9])
@pytest.mark.parametrize("before", [5, 40])
def test_a_clock_that_jumps_is_put_right_or_left_out(step, before, tmp_path):
    late = step < -1e6  # set from 1970
    sent = [
        one._replace(stamp=START + one.time + (step if (k < before) == late else 0.0))
        for k, one in enumerate(imus(100))
    ]
    recording = read(tmp_path, sent)
    time = first(recording, "imu").columns["time"]
    assert (np.diff(time) > 0.0).all()
    close(np.diff(time), 0.02, atol=1e-5)
    assert len(time) == 100 or (before == 5 and sum(left(recording).values()) == 5)
    assert "was set by" in " ".join(recording.warnings)


# Damage


@pytest.mark.parametrize("form", FORMS)
def test_a_bag_that_is_cut_off_is_refused_in_one_line_or_read_in_part(form, tmp_path):
    path = bag(tmp_path, imus(400), form=form)
    file = path if form == "ros1" else next(each for each in path.iterdir() if each.suffix != ".yaml")
    data = file.read_bytes()
    for part in (0.3, 0.7, 0.99):
        file.write_bytes(data[: int(part * len(data))])
        try:
            recording = read_recording(path)
        except InputError as refused:
            assert "\n" not in str(refused)
            assert str(path) in str(refused)
        else:
            assert 0 < len(first(recording, "imu").columns["time"]) <= 400
            assert "messages: the bag is cut off or damaged, and read to there" in left(recording)


def test_a_folder_whose_recorder_left_no_metadata_is_read(tmp_path):
    path = bag(tmp_path, imus(), form="sqlite")
    (path / "metadata.yaml").unlink()
    assert len(first(read_recording(path), "imu").columns["time"]) == 40


def test_a_text_of_that_name_and_an_empty_file_are_no_bags(tmp_path):
    path = tmp_path / "dive.bag"
    path.write_text("not a bag\n" * 9)
    assert recognise(path) is None
    path.write_bytes(b"")
    with pytest.raises(InputError, match=r"dive.bag: is (empty|in an unknown format)"):
        read_recording(path)
    (tmp_path / "folder").mkdir()
    assert recognise(tmp_path / "folder") is None


@cache
def base(form: str, folder: Path) -> tuple[Path, bytes]:
    path = bag(folder, imus(20), [marine_dvl(0.1 * k, (1, 0, 0)) for k in range(4)], form=form)
    file = path if form == "ros1" else next(each for each in path.iterdir() if each.suffix != ".yaml")
    return file, file.read_bytes()


@settings(max_examples=40, deadline=None)
@given(
    form=st.sampled_from(FORMS),
    changes=st.lists(st.tuples(st.integers(0, 10**6), st.sampled_from([0, 1, 127, 255])), min_size=1, max_size=12),
)
def test_changed_bytes_raise_nothing_but_a_refusal(form, changes, tmp_path_factory):
    folder = tmp_path_factory.getbasetemp() / f"changed {form}"
    folder.mkdir(exist_ok=True)
    file, whole = base(form, folder)
    data = bytearray(whole)
    for place, value in changes:
        data[place % len(data)] = value
    changed = folder / f"changed{file.suffix}"
    changed.write_bytes(bytes(data))
    try:
        recording = read_recording(changed)
    except InputError as refused:
        assert "\n" not in str(refused)
        return
    for channel in recording.channels:
        assert len({len(v) for v in channel.columns.values()}) == 1


def test_a_message_that_claims_four_gigabytes_is_counted(tmp_path):
    maker = Maker("mcap")
    whole = maker.message(imus(1)[0])
    path = bag(tmp_path, imus(40), form="mcap")
    (file,) = path.glob("*.mcap")
    data = file.read_bytes()
    at = data.find(whole)
    assert at > 0  # not compressed
    length = at + 4 + 8  # of the frame's name, behind the encoding and the stamp
    file.write_bytes(data[:length] + b"\xff\xff\xff\xff" + data[length + 4 :])
    recording = read_recording(path)
    assert len(first(recording, "imu").columns["time"]) >= 39
    assert sum(left(recording).values()) <= 1
    shutil.rmtree(path)


def test_beams_of_a_dvl_point_where_its_messages_say(tmp_path):
    """Velocities along four beams of 25 deg; where none is valid, only ranges are known."""
    around = np.deg2rad([45.0, 135.0, 225.0, 315.0])
    d = np.column_stack([np.sin(np.deg2rad(25.0)) * np.cos(around), np.sin(np.deg2rad(25.0)) * np.sin(around)])
    d = np.column_stack([d, np.full(4, np.cos(np.deg2rad(25.0)))])
    v = np.array([0.5, -0.1, 0.02])
    said = {"beam_unit_vec": [xyz(*each) for each in d], "beam_velocity_covar": np.full(4, 1e-4, np.float32)}
    sent = []
    for k in range(50):
        one = marine_dvl(0.2 * k, v)
        moves = {"beam_velocities_valid": k != 3, "beam_velocity": (d @ v).astype(np.float32)}
        sent.append(one._replace(fields={**one.fields, **said, **moves}))
    recording = read(tmp_path, sent)
    beams = recording.settings["dvl"]["beams"]
    assert beams["angle_deg"] == pytest.approx(25.0)
    assert beams["azimuth_deg"] == pytest.approx([45.0, 135.0, 225.0, 315.0])
    assert recording.settings["dvl"]["sound_speed_set_mps"] == 1500.0
    (channel,) = (c for c in recording.channels if c.sensor == "dvl_beams")
    np.testing.assert_allclose(channel.columns["dvl_beam_velocity_2"][0], d[1] @ v, atol=1e-7)
    np.testing.assert_allclose(channel.columns["dvl_beam_sd_2"][0], 0.01, rtol=1e-6)
    assert np.isnan(channel.columns["dvl_beam_velocity_2"][3]) and channel.columns["dvl_beam_range_2"][3] == 2.6
    assert channel.columns["dvl_beam_valid_1"][3] == 1.0
