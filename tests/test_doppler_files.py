"""Native files of Doppler instruments: Teledyne PD0, PD4, PD5, PD6, Nortek AD2CP, DVL and Nucleus."""

import gzip
import struct
import warnings
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from autopilot_files import short_dive
from doppler_files import (
    BEAM,
    EARTH,
    INSTRUMENT,
    SHIP,
    UNIX,
    dvl_record,
    nucleus_ahrs,
    nucleus_record,
    nucleus_track,
    pd0_ensemble,
    pd4_frame,
    pd6_ping,
    profile_record,
    signature_record,
    trdi_values,
    vmdas_navigation,
    winriver_gga,
    winriver_hdt,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import close, first, read
from ruamel.yaml import YAML
from scipy.io import loadmat
from scipy.spatial.transform import Rotation
from wire import sentence

from rovgraph import read_log
from rovgraph.api.conversion import convert
from rovgraph.errors import DataWarning, InputError
from rovgraph.geometry import matrix_from_rpy
from rovgraph.log import Log
from rovgraph.model.config import parse_config
from rovgraph.readers.formats import read_recording
from rovgraph.readers.recording import Recording
from rovgraph.sensors.dvl_beam import beam_geometry, beams_of, velocity_by_beams

DATA = Path(__file__).parents[2] / "shared" / "data"
RNG = np.random.default_rng(5)
WAYS = [(BEAM, False), (BEAM, True), (INSTRUMENT, False), (INSTRUMENT, True), (SHIP, False), (EARTH, False)]


def real(name: str) -> Recording:
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path} is not there")
    return read_recording(path)


def velocity(recording: Recording, prefix: str = "dvl_v") -> np.ndarray:
    columns = first(recording, prefix.removesuffix("_v")).columns
    return np.column_stack([columns[f"{prefix}{axis}"] for axis in "xyz"])


def sensors(recording: Recording) -> set[str]:
    return {channel.sensor for channel in recording.channels}


def pinged() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time since 1970, velocity, roll-pitch-heading and depth of a simulated dive at its pings."""
    frame = short_dive(0.0)
    pings = frame[frame["dvl_vx"].notna()]
    depth = frame.dropna(subset=["depth"])
    moved = pings[["dvl_vx", "dvl_vy", "dvl_vz"]].to_numpy()
    time = pings["time"].to_numpy()
    heading = 0.3 + 0.2 * np.sin(0.1 * time)
    rpy = np.column_stack([0.1 * np.sin(time), 0.2 * np.cos(time), heading])
    return UNIX + time, moved, rpy, np.interp(time, depth["time"], depth["depth"])


@pytest.mark.parametrize(("system", "up"), WAYS)
def test_a_simulated_dive_comes_back_of_pd0_from_all_coordinates_within_its_resolution(system, up, tmp_path):
    time, moved, rpy, depth = pinged()
    gimballed = rpy.copy()  # the file has the pitch of a tilt sensor that rolls with the instrument
    gimballed[:, 1] = np.arctan(np.tan(rpy[:, 1]) * np.cos(rpy[:, 0]))
    data = b"".join(
        pd0_ensemble(t, -trdi_values(v, system, turned, up), system, printed, d, up=up)
        for t, v, turned, printed, d in zip(time, moved, gimballed, rpy, depth, strict=True)
    )
    recording = read(data, tmp_path)
    assert recording.format == "pd0"
    assert recording.warnings == ()
    columns = first(recording, "dvl").columns
    np.testing.assert_allclose(columns["time"], time, atol=0.0051)
    resolution = 0.0012 if system == BEAM else 0.0009  # of 1 mm/s, and of 0.01 degrees at 2 m/s
    np.testing.assert_allclose(velocity(recording), moved, atol=resolution)
    assert np.all(columns["dvl_valid"] == 1.0)
    np.testing.assert_allclose(first(recording, "depth").columns["depth"], depth, atol=0.051)
    tilt = first(recording, "vehicle_tilt").columns
    np.testing.assert_allclose(tilt["roll"], rpy[:, 0], atol=1e-4)
    np.testing.assert_allclose(tilt["pitch"], rpy[:, 1], atol=1e-4)
    heading = first(recording, "vehicle_heading" if system == SHIP else "dvl_heading").columns
    np.testing.assert_allclose(heading["heading" if system == SHIP else "dvl_heading"], rpy[:, 2], atol=1e-4)
    np.testing.assert_allclose(first(recording, "dvl_altitude").columns["dvl_altitude"], 3.0)


@pytest.mark.parametrize(("system", "up"), WAYS)
def test_cells_of_a_profile_are_velocities_relative_to_the_water_at_their_own_depths(system, up, tmp_path):
    rpy, printed = np.array([0.1, 0.2, 0.7]), np.array([0.1, 0.2, 0.7])
    rpy[1] = np.arctan(np.tan(rpy[1]) * np.cos(rpy[0]))
    relative = np.column_stack([0.5 - 0.02 * np.arange(6), 0.03 * np.arange(6), np.full(6, 0.2)])
    cells = [-trdi_values(v, system, rpy, up) for v in relative]
    cells[2], cells[4] = [np.nan] * 4, [0.0] * 4  # the instrument marks the one so, an older one the other
    data = b"".join(
        pd0_ensemble(UNIX + k, system=system, rpy=printed + k * 1e-3, up=up, profile=cells, ranges=(70, 60, 80, 0))
        for k in range(2)
    )
    recording = read(data, tmp_path)
    table = recording.tables["adcp"]
    beams = system == BEAM and not up
    level = np.cos(rpy[0]) * np.cos(rpy[1]) if system >= SHIP else 1.0  # depths of bins that it has mapped
    here = table["time"] < UNIX + 0.5
    close(table["range"][here] * level, 6.5 + 4.0 * np.array([0, 1, 3, 5]), 5e-4)
    close(table["cell"][here] * level, np.full(4, 4.0), 5e-4)
    close(table["bottom"], np.full(8, 60.0))
    close(np.column_stack([table["roll"], table["pitch"]])[here], np.tile(rpy[:2], (4, 1)), 1e-4)
    assert recording.settings["water"] == {"beam_angle_deg": 30.0} | ({"looks": "up"} if up else {})
    if beams:
        assert recording.settings["dvl"]["beams"] == {"angle_deg": 30.0, "azimuth_deg": [270.0, 90.0, 0.0, 180.0]}
        head = beam_geometry(parse_config("dvl: {beams: {angle_deg: 30, azimuth_deg: [270, 90, 0, 180]}}").dvl)
        along = np.column_stack([table[f"beam_{k}"] for k in range(1, 5)])
        found = velocity_by_beams(head.directions, along, np.isfinite(along))[0]
    else:
        found = np.column_stack([table[f"v{axis}"] for axis in "xyz"])
    close(found[here], relative[[0, 1, 3, 5]], 0.0012)


def test_profiles_stay_beside_a_log_that_is_converted_again(tmp_path):
    cells = [(0.1, 0.2, 0.03, 0.0), (0.1, 0.25, 0.03, 0.0)]
    pd0, log, again = (tmp_path / name for name in ("dive.pd0", "log.csv", "again.csv"))
    pd0.write_bytes(b"".join(pd0_ensemble(UNIX + k, source=1, profile=cells) for k in range(5)))
    with pytest.warns(DataWarning, match="nothing measured it"):
        made = convert([pd0])
    made.save(log)
    convert([log]).save(again)
    for read_back in (made.log["adcp"], read_log(log)["adcp"], read_log(again)["adcp"]):
        close(read_back["adcp_vx"], np.tile([-0.2, -0.25], 5))
        close(read_back["adcp_range"], np.tile([6.5, 10.5], 5))
        close(read_back.time - read_back.time[0], np.repeat(np.arange(5.0), 2), 0.006)


def test_of_two_profilers_in_one_file_the_one_that_looks_down_is_kept(tmp_path):
    cells = [(0.1, 0.2, 0.3, 0.0)] * 3
    data = b"".join(pd0_ensemble(UNIX + k, up=k % 2 == 0, profile=cells) for k in range(5))
    recording = read(data, tmp_path)
    close(np.unique(recording.tables["adcp"]["time"]), UNIX + np.array([1.0, 3.0]), 0.006)
    assert [(each.name, each.count) for each in recording.left if each.reason == "looks the other way"] == [
        ("profile", 3)
    ]


def test_the_error_velocity_shows_the_noise_of_a_cell(tmp_path):
    rng = np.random.default_rng(4)
    noise = rng.normal(0.0, [[0.02], [0.06]], (800, 2, 4))
    data = b"".join(pd0_ensemble(UNIX + k, profile=profile) for k, profile in enumerate(noise))
    sd = read(data, tmp_path).tables["adcp"]["sd"]  # of ten groups
    np.testing.assert_allclose([np.mean(sd[::2]), np.mean(sd[1::2])], [0.02, 0.06], rtol=0.1)
    of_beams = struct.pack("<H", 0x0200) + bytes([120] * 4 + [75, 60, 110, 110])
    data = b"".join(pd0_ensemble(UNIX + k, profile=profile[::-1], more=[of_beams]) for k, profile in enumerate(noise))
    sd = read(data, tmp_path).tables["adcp"]["sd"]  # by the third best correlation, whatever the cell's number
    np.testing.assert_allclose([np.mean(sd[::2]), np.mean(sd[1::2])], [0.06, 0.02], rtol=0.1)


def test_cells_of_three_beams_or_low_correlation_are_left_out_where_others_are_better(tmp_path):
    four, three = (0.1, 0.2, 0.03, 0.01), (0.1, 0.2, 0.03, np.nan)
    recording = read(b"".join(pd0_ensemble(UNIX + k, profile=[four, four, three]) for k in range(4)), tmp_path)
    assert np.all(recording.tables["adcp"]["range"] < 11.0)
    assert any(each.name == "cell" and each.count == 4 for each in recording.left)
    of_beams = struct.pack("<H", 0x0200) + bytes([120] * 4 + [63, 60, 110, 110])
    faint = read(b"".join(pd0_ensemble(UNIX + k, profile=[four, four], more=[of_beams]) for k in range(4)), tmp_path)
    assert len(faint.tables["adcp"]["time"]) == 4
    assert any(each.reason == "low correlation" and each.count == 4 for each in faint.left)
    every = read(b"".join(pd0_ensemble(UNIX + k, profile=[three]) for k in range(4)), tmp_path)
    assert len(every.tables["adcp"]["time"]) == 4


def test_ensembles_of_two_coordinate_systems_in_one_file_agree(tmp_path):
    moved, rpy = (0.5, 0.1, -0.05), (0.0, 0.3, 2.0)
    data = [pd0_ensemble(UNIX + k, -trdi_values(moved, k % 4, rpy), k % 4, (0.0, 0.3, 2.0)) for k in range(8)]
    recording = read(b"".join(data), tmp_path)
    np.testing.assert_allclose(velocity(recording), [moved] * 8, atol=0.002)
    assert any("beam 2, instrument 2, ship 2, earth 2" in note for note in recording.notes)


def test_three_beams_are_enough_and_two_are_not(tmp_path):
    moved = (0.5, 0.1, -0.05)
    beams = -trdi_values(moved, BEAM, (0.0, 0.0, 0.0))
    for k in range(4):
        three = np.where(np.arange(4) == k, np.nan, beams)
        np.testing.assert_allclose(
            velocity(read(pd0_ensemble(values=three, system=BEAM), tmp_path))[0], moved, atol=0.003
        )
    two = [*beams[:2], np.nan, np.nan]
    assert first(read(pd0_ensemble(values=two, system=BEAM), tmp_path), "dvl").columns["dvl_valid"][0] == 0.0


def test_attitude_that_no_own_sensor_measured_is_not_taken_out_of_ship_axes(tmp_path):
    level = read(pd0_ensemble(values=(0.0, -1.0, 0.0, 0.0), rpy=(0.0, 0.3, 1.0)), tmp_path)
    body = read(pd0_ensemble(values=(0.0, -1.0, 0.0, 0.0), rpy=(0.0, 0.3, 1.0), source=1), tmp_path)
    np.testing.assert_allclose(velocity(level)[0], [np.cos(0.3), 0.0, np.sin(0.3)], atol=1e-3)
    np.testing.assert_allclose(velocity(body)[0], [1.0, 0.0, 0.0], atol=1e-9)
    rpy = (0.1, 0.3, 1.0)  # in earth axes it was used, whoever measured it
    earth = read(
        pd0_ensemble(values=-trdi_values((1.0, 0.0, 0.0), EARTH, rpy), system=EARTH, rpy=rpy, source=1), tmp_path
    )
    np.testing.assert_allclose(velocity(earth)[0], [1.0, 0.0, 0.0], atol=1e-3)


def test_a_water_layer_is_the_velocity_through_water(tmp_path):
    recording = read(pd0_ensemble(water=(0.1, -0.4, 0.05, 0.0), source=1), tmp_path)
    np.testing.assert_allclose(velocity(recording, "dvl_water_v")[0], [0.4, -0.1, 0.05])
    assert "dvl_water" not in sensors(read(pd0_ensemble(), tmp_path))


def test_what_is_not_measured_becomes_no_measurement(tmp_path):
    lost = pd0_ensemble(UNIX + 1, values=(np.nan,) * 4, ranges=(0, 0, 0, 0))
    silent = pd0_ensemble(UNIX + 2, values=(0, 0, 0, 0), ranges=(0, 0, 0, 0))  # zeros, and no beam heard
    recording = read(pd0_ensemble() + lost + silent, tmp_path)
    assert first(recording, "dvl").columns["dvl_valid"].tolist() == [1.0, 0.0, 0.0]
    assert np.isnan(velocity(recording)[1:]).all()
    assert len(first(recording, "dvl_altitude").columns["time"]) == 1
    assert not {"depth", "vehicle_heading", "vehicle_tilt"} & sensors(recording)  # constants
    assert any("heading is 57.30 deg throughout" in text for text in recording.warnings)
    nothing = read(pd0_ensemble(bottom=False, depth=1.0) + pd0_ensemble(UNIX + 1, bottom=False, depth=2.0), tmp_path)
    assert sensors(nothing) == {"depth"}
    assert any("no bottom track" in text for text in nothing.warnings)


def test_far_ranges_use_their_high_byte(tmp_path):
    recording = read(pd0_ensemble(ranges=(700.0, 700.0, 700.0, 700.0)), tmp_path)
    assert first(recording, "dvl_altitude").columns["dvl_altitude"][0] == pytest.approx(700.0)


def test_a_heading_bias_becomes_the_declination_and_an_alignment_the_mounting(tmp_path):
    pings = [pd0_ensemble(UNIX + k, rpy=(0, 0, 1.0 + 0.1 * k), system=BEAM, bias=4.5, alignment=45.0) for k in range(3)]
    recording = read(b"".join(pings), tmp_path)
    assert recording.settings["environment"] == {"declination_deg": 4.5}
    assert recording.settings["dvl"] == {
        "sound_speed_set_mps": 1500.0,
        "beams": {"angle_deg": 30.0, "azimuth_deg": [270.0, 90.0, 0.0, 180.0]},
        "mount_rpy_deg": [0.0, 0.0, 45.0],
    }
    heading = first(recording, "dvl_heading").columns["dvl_heading"]
    np.testing.assert_allclose(heading, 1.0 + 0.1 * np.arange(3) - np.deg2rad(4.5), atol=1e-4)


def test_corrupt_ensembles_and_bad_dates_are_counted_and_the_rest_is_read(tmp_path):
    good = [pd0_ensemble(UNIX + k, depth=k) for k in range(5)]
    spoilt = bytearray(good[1])
    spoilt[100] ^= 0xFF
    undated = pd0_ensemble(date=(15, 13, 1, 0, 0, 0, 0))
    cut = good[4][:200]
    recording = read(b"noise" + good[0] + bytes(spoilt) + good[2] + undated + good[3] + cut, tmp_path)
    np.testing.assert_allclose(first(recording, "dvl").columns["time"] - UNIX, [0, 2, 3])
    counted = {(left.name, left.reason): left.count for left in recording.left}
    assert counted["ensemble", "a wrong checksum"] == 1
    assert counted["ensemble", "no valid time"] == 1
    assert f"{5 + len(spoilt) + len(cut)} bytes belong to no whole ensemble" in recording.warnings


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "is empty"),
        (b"nothing that anyone has seen\n" * 50, "in an unknown format"),
        (pd0_ensemble()[:200], "no whole PD0 ensemble"),
        (pd0_ensemble(date=(0,) * 7), "valid time"),
        (pd6_ping()[:30] * 3, "record :TS, :SA and :BI"),
        (nucleus_record(0xA0, UNIX, [0.0]), "no measurement of a sensor"),
    ],
)
def test_a_file_that_cannot_be_used_is_one_clear_line(data, words, tmp_path):
    with pytest.raises(InputError, match=words) as error:
        read(data, tmp_path)
    assert "dive.bin" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("five", [False, True])
def test_a_dive_comes_back_of_pd4_and_pd5(five, tmp_path):
    time, moved, rpy, depth = pinged()
    time = time - time[0] + 86395.0  # over midnight
    system = EARTH if five else INSTRUMENT
    turned = rpy * [0.0, 0.0, 1.0]
    data = [
        pd4_frame(t % 86400.0, trdi_values(v, system, r), system, rpy=r if five else None, depth=d)
        for t, v, r, d in zip(time, moved, turned, depth, strict=True)
    ]
    recording = read(b"\x7d" + b"".join(data), tmp_path)
    assert recording.format == "pd4"
    np.testing.assert_allclose(first(recording, "dvl").columns["time"], time, atol=0.0051)
    np.testing.assert_allclose(velocity(recording), moved, atol=0.0009)
    assert recording.clocks[first(recording, "dvl").clock].unix_offset is None
    assert ("depth" in sensors(recording)) == five
    if five:
        np.testing.assert_allclose(first(recording, "dvl_heading").columns["dvl_heading"], rpy[:, 2], atol=1e-4)


@pytest.mark.parametrize(
    ("system", "tilted", "reason"), [(BEAM, False, "beam"), (EARTH, True, "heading"), (SHIP, True, "levelled")]
)
def test_pd4_velocities_that_cannot_be_turned_back_are_refused_with_the_reason(system, tilted, reason, tmp_path):
    recording = read(pd4_frame() * 2 + pd4_frame(system=system, tilted=tilted), tmp_path)
    assert first(recording, "dvl").columns["dvl_valid"].tolist() == [1.0, 1.0, 0.0]
    assert any(reason in text and text.startswith("1 velocities") for text in recording.warnings)


@pytest.mark.parametrize("axes", [("BI", "BS", "BE"), ("BS",), ("BE",)])
def test_a_dive_comes_back_of_pd6(axes, tmp_path):
    time, moved, rpy, depth = pinged()
    pings = [pd6_ping(t, v, r, d, axes=axes) for t, v, r, d in zip(time, moved, rpy, depth, strict=True)]
    recording = read(b"".join(pings), tmp_path)
    assert recording.format == "pd6"
    np.testing.assert_allclose(first(recording, "dvl").columns["time"], time, atol=0.0051)
    np.testing.assert_allclose(velocity(recording), moved, atol=0.0009)
    np.testing.assert_allclose(first(recording, "dvl_heading").columns["dvl_heading"], rpy[:, 2], atol=1e-4)
    np.testing.assert_allclose(first(recording, "vehicle_tilt").columns["pitch"], rpy[:, 1], atol=1e-4)
    np.testing.assert_allclose(first(recording, "depth").columns["depth"], depth, atol=0.051)
    np.testing.assert_allclose(first(recording, "dvl_altitude").columns["dvl_altitude"], 3.0)


def test_pd6_without_lock_and_broken_lines_are_counted(tmp_path):
    data = pd6_ping() + pd6_ping(UNIX + 1, good=False) + b":BI,garbage\r\n\xff\xfe\r\n"
    recording = read(data, tmp_path)
    assert first(recording, "dvl").columns["dvl_valid"].tolist() == [1.0, 0.0]
    assert [left.count for left in recording.left] == [2]


def test_a_dive_comes_back_of_a_nortek_dvl(tmp_path):
    time, moved, _, _ = pinged()
    data = [dvl_record(t, v) + dvl_record(t, v * 0.5, kind=0x1D) for t, v in zip(time, moved, strict=True)]
    recording = read(b"".join(data) + dvl_record(UNIX + 99.0, (0, 0, 0), valid=False), tmp_path)
    assert recording.format == "ad2cp"
    columns = first(recording, "dvl").columns
    np.testing.assert_allclose(columns["time"][:-1], time + 0.016, atol=1e-4)  # when the echo came
    np.testing.assert_allclose(velocity(recording)[:-1], moved, atol=1e-6)
    np.testing.assert_allclose(columns["dvl_sd"][:-1], 0.003, rtol=1e-5)
    assert columns["dvl_valid"].tolist() == [1.0] * len(time) + [0.0]
    np.testing.assert_allclose(velocity(recording, "dvl_water_v"), 0.5 * moved, atol=1e-6)


def test_a_signatures_bottom_track_is_the_bottoms_velocity_along_its_beams(tmp_path):
    sine, cosine = np.sin(np.deg2rad(25.0)), np.cos(np.deg2rad(25.0))
    forward, starboard, down = 0.5, 0.1, -0.05
    toward = np.array([forward, -starboard, -forward, starboard]) * sine + down * cosine
    beams = [round(-1e4 * v) for v in toward]  # the bottom comes nearer
    own = [round(-1e4 * v) for v in (forward, starboard, down, down)]
    data = signature_record(UNIX, beams) + signature_record(UNIX + 1, own, system=1)
    # X is turned by heading 90, lifted by pitch 1 and rolled by -2 deg: those of the record
    enu = Rotation.from_euler("ZYX", [0.0, -1.0, -2.0], degrees=True).apply([forward, starboard, down])
    east = [round(-1e4 * v) for v in (*enu, enu[2])]
    lost = signature_record(UNIX + 2, beams, heard=False) + signature_record(UNIX + 3, own, system=3)
    recording = read(data + lost + signature_record(UNIX + 4, east, system=0), tmp_path)
    np.testing.assert_allclose(velocity(recording)[[0, 1, 4]], [[forward, starboard, down]] * 3, atol=2e-4)
    assert first(recording, "dvl").columns["dvl_valid"].tolist() == [1.0, 1.0, 0.0, 0.0, 1.0]
    assert [text for text in recording.warnings if "velocities" in text] == [
        "1 velocities are in unknown coordinates and left out; record beams or XYZ"
    ]


def test_a_nucleus_gives_all_its_sensors(tmp_path):
    time, moved, rpy, depth = pinged()
    parts = []
    for t, v, r, d in zip(time, moved, rpy, depth, strict=True):
        parts.append(nucleus_record(0x82, t, [0.1, 0.2, -9.8, 0.01, 0.02, 0.03, 20.0]))
        parts.append(nucleus_record(0x87, t, [0.2, 0.0, 0.4]))
        parts.append(nucleus_ahrs(t, r, d, declination=3.0))
        parts.append(nucleus_track(t, v) + nucleus_track(t, v * 0.5, kind=0xBE))
    parts.append(nucleus_track(UNIX + 99.0, (-32.768,) * 3, status=0))
    recording = read(b"".join(parts), tmp_path)
    assert recording.format == "nucleus"
    assert sensors(recording) == {"imu", "mag", "ahrs", "depth", "dvl", "dvl_altitude", "dvl_water"}
    imu = first(recording, "imu").columns
    np.testing.assert_allclose([imu["acc_z"][0], imu["gyr_z"][0]], [-9.8, 0.03], rtol=1e-6)
    np.testing.assert_allclose(first(recording, "mag").columns["mag_z"], 40.0, rtol=1e-6)
    yaw = first(recording, "ahrs").columns["ahrs_yaw"]
    np.testing.assert_allclose(yaw, rpy[:, 2] - np.deg2rad(3.0), atol=1e-6)
    assert recording.settings == {"environment": {"declination_deg": 3.0}}
    np.testing.assert_allclose(velocity(recording)[:-1], moved, atol=1e-6)
    np.testing.assert_allclose(first(recording, "dvl").columns["dvl_sd"][:-1], 0.004, rtol=1e-5)
    assert np.isnan(velocity(recording)[-1]).all()


WHOLE = {
    "pd0": b"".join(pd0_ensemble(UNIX + k, system=k % 4) for k in range(4)),
    "pd4": b"".join(pd4_frame(k, rpy=(0, 0, 0) if k % 2 else None) for k in range(4)),
    "pd6": b"".join(pd6_ping(UNIX + k) for k in range(4)),
    "ad2cp": b"".join(dvl_record(UNIX + k, (1, 2, 3)) + signature_record(UNIX, (1, 2, 3, 4)) for k in range(3)),
    "nucleus": nucleus_ahrs(UNIX, (0, 0, 0), 1.0) + nucleus_track(UNIX, (1, 2, 3)),
}


@pytest.mark.parametrize("name", WHOLE)
@settings(max_examples=40)
@given(
    changes=st.lists(st.tuples(st.integers(0, 5000), st.binary(max_size=9)), max_size=6),
    cut=st.integers(0, 5000),
    tail=st.binary(max_size=60),
)
def test_mutated_bytes_are_read_or_refused_in_one_line(name, changes, cut, tail, tmp_path_factory):
    data = bytearray(WHOLE[name][: 1 + cut])
    for at, new in changes:
        data[at % len(data) : at % len(data) + len(new)] = new
    try:
        recording = read(bytes(data) + tail, tmp_path_factory.getbasetemp())
    except InputError as error:
        assert "\n" not in str(error)
        return
    for channel in recording.channels:
        assert len({len(values) for values in channel.columns.values()}) == 1
        assert np.isfinite(channel.columns["time"]).all() or channel.sensor == "dvl"


def digits(recording: Recording, sensor: str, column: str, unit: float) -> np.ndarray:
    return np.round(first(recording, sensor).columns[column] / unit).astype(int)


def test_a_remus_file_agrees_with_an_independent_decoding():
    recording = real("remus600_pd0/adcp_auv_51.pd0")
    expected = YAML(typ="safe").load((DATA / "remus600_pd0" / "adcp_auv_51.expected.yml").read_text())["data"]
    ensembles = [e for e in expected if e["particle_object"] == "VelocityInst"]
    tracks = [e for e in expected if e["particle_object"] == "InstBottom"]
    assert len(tracks) == 51
    degrees = np.deg2rad(0.01)

    def of(name: str, items: Sequence[dict] = tracks) -> np.ndarray:
        return np.array([item[name] for item in items])

    for column, name, sign in (
        ("dvl_vx", "bt_starboard_velocity", -1),  # of the independent decoding: X and Y of the file in this order
        ("dvl_vy", "bt_forward_velocity", -1),
        ("dvl_vz", "bt_vertical_velocity", 1),
    ):
        np.testing.assert_array_equal(digits(recording, "dvl", column, 0.001), sign * of(name))
    heading = digits(recording, "vehicle_heading", "heading", degrees)
    np.testing.assert_array_equal(heading % 36000, of("heading", ensembles))
    np.testing.assert_array_equal(digits(recording, "vehicle_tilt", "pitch", degrees), of("pitch", ensembles))
    np.testing.assert_array_equal(digits(recording, "vehicle_tilt", "roll", degrees), of("roll", ensembles))
    beams = recording.tables["dvl_beams"]
    for k in range(1, 5):
        ranges = of(f"bt_beam{k}_range")
        np.testing.assert_allclose(beams[f"distance_{k}"], np.where(ranges > 0, 0.01 * ranges, np.nan))
        np.testing.assert_array_equal(beams[f"correlation_{k}"], of(f"bt_beam{k}_correlation"))
        assert f"percent_good_{k}" in beams and f"velocity_{k}" not in beams  # per beam; in ship axes
    ntp = 2_208_988_800.0  # its times count from 1900
    np.testing.assert_allclose(beams["time"], of("internal_timestamp") - ntp, atol=1e-3)


def test_a_remus_dive_keeps_its_attitude_in_its_own_axes():
    recording = real("remus600_pd0/adcp.adc.gz")
    assert len(first(recording, "dvl").columns["time"]) == 4132
    depth, tilt = first(recording, "depth").columns, first(recording, "vehicle_tilt").columns
    moved = velocity(recording)
    descent = np.gradient(depth["depth"], depth["time"])
    rpy = np.column_stack([tilt["roll"], tilt["pitch"], 0.0 * tilt["roll"]])
    below = (matrix_from_rpy(rpy) @ moved[:, :, None])[:, 2, 0]  # if the axes are the vehicle's
    steep = np.isfinite(below) & (np.abs(tilt["pitch"]) > 0.15) & (np.abs(descent) < 1.0)
    assert np.count_nonzero(steep) > 100
    assert np.std((descent - below)[steep]) < 0.5 * np.std((descent - moved[:, 2])[steep])  # if they were level


def test_a_remus_profile_agrees_with_an_independent_decoding():
    table = real("remus600_pd0/adcp_auv_51.pd0").tables["adcp"]
    expected = YAML(typ="safe").load((DATA / "remus600_pd0" / "adcp_auv_51.expected.yml").read_text())["data"]
    profiles = [one for one in expected if one["particle_type"] == "adcp_velocity_earth"]
    down = [one for one in profiles if one["sysconfig_vertical_orientation"] == 0]
    names = "water_velocity_north", "water_velocity_east", "water_velocity_up"  # in this file ahead, right, up
    ahead, right, up = (np.concatenate([one[name] for one in down]).astype(float) for name in names)
    heard = np.concatenate([one["error_velocity"] for one in down]) != -32768  # of four beams
    close(table["vx"], -1e-3 * ahead[heard], 1e-9)
    close(table["vy"], -1e-3 * right[heard], 1e-9)
    close(table["vz"], 1e-3 * up[heard], 1e-9)
    first = np.concatenate([0.01 * (one["bin_1_distance"] + one["cell_length"] * np.arange(8)) for one in down])
    close(table["range"], first[heard], 1e-9)


@pytest.mark.parametrize(
    ("name", "fastest", "scatter"),
    [("remus600_pd0/adcp.adc.gz", 1.0, 0.12), ("glider_pd0/ooi_glider_NE051400.PD0", 0.05, 0.12)],
)
def test_the_water_stands_still_beside_the_bottom_whichever_way_a_vehicle_goes(name, fastest, scatter):
    """Current = velocity over the bottom less that relative to the cells, in Earth axes."""
    recording = real(name)
    table, heading = recording.tables["adcp"], next(c for c in recording.channels if c.sensor.endswith("heading"))
    over, pings = velocity(recording), first(recording, "dvl").columns["time"]
    ping = np.searchsorted(pings, table["time"])
    azimuth = np.unwrap(heading.columns[heading.sensor.replace("vehicle_", "")])
    rpy = np.column_stack([table["roll"], table["pitch"], np.interp(table["time"], heading.columns["time"], azimuth)])
    R_ns = matrix_from_rpy(rpy)
    relative = np.column_stack([table[f"v{axis}"] for axis in "xyz"])
    known = np.isfinite(over[ping]).all(axis=1) & (table["range"] < 0.8 * np.nan_to_num(table["bottom"]))
    moved, current = (np.einsum("nij,nj->ni", R_ns, v)[known, :2] for v in (over[ping], over[ping] - relative))
    assert len(current) > 700 and np.median(np.abs(moved)) > fastest
    assert 1.48 * np.median(np.abs(current - np.median(current, axis=0))) < scatter
    assert np.all(np.abs(np.median(current, axis=0)) < 0.2)


def test_a_gliders_corrupt_file_gives_its_good_ensembles():
    recording = real("glider_pd0/ooi_glider_LB180210_3_corrupted.PD0")
    assert len(first(recording, "depth").columns["time"]) == 2
    assert ("ensemble", 1) in {(left.name, left.count) for left in recording.left}


@pytest.mark.parametrize(
    ("name", "tracked", "speed"),
    [
        ("adcp_bt/RDI_withBT.000.gz", 901, (0.0, 0.3)),
        ("adcp_bt/winriver02.PD0.gz", 75, (0.5, 3.5)),
        ("glider_pd0/dolfyn_vmdas02_os.ENR.gz", None, (4.5, 5.6)),  # a ship, in beam axes
    ],
)
def test_other_pd0_files_move_as_their_vehicles_do(name, tracked, speed):
    recording = real(name)
    dvl = first(recording, "dvl").columns
    if tracked is not None:
        assert np.count_nonzero(dvl["dvl_valid"]) == tracked
    low, high = speed
    assert low <= np.nanmedian(np.linalg.norm(velocity(recording), axis=1)) <= high


def test_an_ad2cp_file_agrees_with_its_makers_own_decoding():
    recording = real("adcp_bt/VelEchoBT01.ad2cp.gz")
    with gzip.open(DATA / "adcp_bt" / "VelEchoBT01.mat.gz") as file:
        made = loadmat(file, simplify_cells=True)["Data"]
    heading = first(recording, "dvl_heading").columns
    np.testing.assert_allclose(np.rad2deg(heading["dvl_heading"]) % 360.0, made["BottomTrack_Heading"], atol=1e-3)
    tilt = first(recording, "vehicle_tilt").columns
    np.testing.assert_allclose(np.rad2deg(tilt["pitch"]), made["BottomTrack_Pitch"], atol=1e-3)
    np.testing.assert_allclose(np.rad2deg(tilt["roll"]), made["BottomTrack_Roll"], atol=1e-3)
    days = made["BottomTrack_Time"] - 719529.0  # MATLAB's days
    np.testing.assert_allclose(heading["time"], 86400.0 * days, atol=1e-3)
    pascal = first(recording, "depth").columns["pressure"]
    np.testing.assert_allclose(pascal, 1e4 * made["BottomTrack_Pressure"], rtol=1e-5)
    assert recording.settings["depth"] == {"surface_hpa": 0.0}
    assert not first(recording, "dvl").columns["dvl_valid"].any()  # on a bench: figures of merit are none
    assert (made["BottomTrack_VelZ1"] < -11.0).all()  # stale, and refused
    assert "dvl_beams" not in recording.tables
    sound = first(recording, "dvl_sound").columns
    np.testing.assert_allclose(sound["dvl_sound_speed"], made["BottomTrack_Soundspeed"], atol=1e-3)
    np.testing.assert_allclose(sound["water_temperature"], made["BottomTrack_Temperature"], atol=1e-3)


def test_a_signatures_profile_is_that_of_its_beams_by_the_makers_own_matrix():
    path = DATA / "adcp_bt" / "VelEchoBT01.mat.gz"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    with gzip.open(path) as file:
        made = loadmat(file, simplify_cells=True)
    x, y, z1, z2 = made["Config"]["Burst_Beam2xyz"]
    directions = np.linalg.pinv(np.array([x, y, 0.5 * (z1 + z2)]))
    away = np.stack([made["Data"][f"Burst_VelBeam{k}"] for k in (1, 2, 3, 4)], axis=-1).reshape(-1, 4).astype(float)
    of_maker = [made["Data"][f"Burst_Vel{axis}"].astype(float) for axis in ("X", "Y", "Z1", "Z2")]
    expected = np.column_stack([v.ravel() for v in (*of_maker[:2], 0.5 * (of_maker[2] + of_maker[3]))])
    found, _ = velocity_by_beams(directions, away, np.isfinite(away))
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-6)
    preset = parse_config("dvl: {preset: nortek-signature}").dvl
    found, _ = velocity_by_beams(beam_geometry(preset).directions, away, np.isfinite(away))
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=1e-4)  # the matrix has five digits


def test_an_ad2cp_profile_agrees_with_its_makers_own_decoding():
    table = real("adcp_bt/VelEchoBT01.ad2cp.gz").tables["adcp"]
    with gzip.open(DATA / "adcp_bt" / "VelEchoBT01.mat.gz") as file:
        made = loadmat(file, simplify_cells=True)
    for k in (1, 2, 3, 4):
        close(table[f"beam_{k}"], -made["Data"][f"Burst_VelBeam{k}"].ravel().astype(float), 1e-6)
    blank, cell = made["Config"]["Burst_BlankingDistance"], made["Config"]["Burst_CellSize"]
    close(table["range"], np.tile(blank + cell * np.arange(1, 31), 160), 1e-6)
    assert "vx" not in table and np.all(table["cell"] == cell)


@pytest.mark.parametrize("system", [0, 1, 2])
def test_cells_of_a_nortek_profile_are_relative_to_the_water_in_all_coordinates(system, tmp_path):
    rpy = np.deg2rad([3.0, -2.0, 90.0])  # of `profile_record`, which looks up: X forward, Y to port, Z up
    relative = np.column_stack([0.5 - 0.1 * np.arange(3), 0.1 * np.arange(3), np.full(3, -0.05)])
    R = Rotation.from_euler("ZYX", [np.pi / 2 - rpy[2], -rpy[1], rpy[0]])  # from there to east, north, up
    cells = -R.apply(relative) if system == 0 else -relative
    if system == 2:
        head = beam_geometry(parse_config("dvl: {preset: nortek-signature}").dvl)
        values = cells @ head.directions.T
    else:
        values = np.column_stack([cells, cells[:, 2]])
    values[1] = np.nan
    data = b"".join(profile_record(UNIX + k, values, system) for k in range(3))
    recording = read(data, tmp_path)
    table = recording.tables["adcp"]
    close(table["range"], np.tile([0.5 + 2.0, 0.5 + 6.0], 3))
    if system == 2:
        along = np.column_stack([table[f"beam_{k}"] for k in range(1, 5)])
        found = velocity_by_beams(head.directions, along, np.isfinite(along))[0]
        assert recording.settings["dvl"]["beams"]["angle_deg"] == 25.0
    else:
        found = np.column_stack([table[f"v{axis}"] for axis in "xyz"])
    close(found, np.tile(relative[[0, 2]], (3, 1)), 0.002)
    assert sensors(recording) >= {"depth", "dvl_heading", "vehicle_tilt"}  # without bottom track, of its records


def test_a_nortek_profile_of_other_beams_is_counted_and_left_out(tmp_path):
    track, odd = signature_record(UNIX, [100] * 4), profile_record(UNIX, np.zeros((3, 4)), 2, beams=3)
    recording = read(track + odd, tmp_path)
    assert "adcp" not in recording.tables
    assert any(each.count == 1 and "four beams" in each.reason for each in recording.left)


def solved(name: str) -> tuple[Log, np.ndarray]:
    """A file's log, and velocities by its beams and the geometry that it states."""
    if not (DATA / name).exists():
        pytest.skip(f"{DATA / name} is not there")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        made = convert([DATA / name])
    geometry = beam_geometry(made.completed.dvl)
    beams = beams_of(made.log["dvl_beams"].data, geometry.numbers)
    return made.log, velocity_by_beams(geometry.directions, beams.velocity, beams.valid)[0]


def test_beams_of_a_ship_give_the_velocity_that_the_formula_does():
    log, found = solved("glider_pd0/dolfyn_vmdas02_os.ENR.gz")
    own = log["dvl"].data
    # of the first ping by hand: 1 / (2 sin 30 deg), 1 / (4 cos 30 deg)
    b1, b2, b3, b4 = -0.049, 0.052, 0.037, -0.031
    first_ping = [b3 - b4, b2 - b1, (b1 + b2 + b3 + b4) / (4.0 * np.cos(np.deg2rad(30.0)))]
    np.testing.assert_allclose(own[0, :3], first_ping, rtol=0.0, atol=1e-12)
    whole = (own[:, 3] == 1.0) & np.isfinite(found).all(axis=1)
    assert whole.sum() > 200
    np.testing.assert_allclose(found[whole], own[whole, :3], rtol=0.0, atol=1e-12)


def test_a_river_boats_beams_agree_with_its_satellite_receiver():
    log, found = solved("adcp_bt/RiverPro_test01.PD0.gz")
    fix, pings = log["fix"], log["dvl_beams"]
    span = 2.0  # seconds on both sides
    over = [
        [np.interp(pings.time + s, fix.time, fix[f"fix_{axis}"]) for s in (-span, span)] for axis in ("north", "east")
    ]
    speed = np.hypot(*(after - before for before, after in over)) / (2.0 * span)
    ratio = (np.linalg.norm(found[:, :2], axis=1) / speed)[speed > 0.3]
    assert len(ratio) > 100
    assert np.nanmedian(ratio) == pytest.approx(1.005, abs=0.02)


def test_percentages_of_kinds_of_solution_are_not_called_those_of_beams():
    beams = real("adcp_bt/winriver02.PD0.gz").tables["dvl_beams"]
    names = "percent_three_beam", "percent_rejected", "percent_beams_bad", "percent_four_beam"
    np.testing.assert_array_equal(sum(beams[name] for name in names), 100.0)
    assert "percent_good_1" not in beams


def test_a_tracker_650_is_read_with_and_without_checksums(tmp_path):
    lines = [f"DVPDL,{k * 100_000},100000,0,0,0,0.05,0.001,-0.002,{95 if k % 10 else 0}" for k in range(1, 51)]
    recording = read(b"".join(b"$" + line.encode() + b"\n" for line in lines[:25]) + b"$DVKFC,1,2\n", tmp_path)
    assert recording.format == "cerulean"
    dvl = first(recording, "dvl").columns
    close(np.diff(dvl["time"]), 0.1)
    valid = dvl["dvl_valid"] == 1.0
    assert (~valid).sum() == 2 and np.isnan(dvl["dvl_vx"][~valid]).all()
    close(dvl["dvl_vx"][valid], 0.5)
    assert [(each.name, each.count) for each in recording.left] == [("DVKFC", 1)]
    with_checksums = read(b"".join(map(sentence, lines)), tmp_path)
    assert len(first(with_checksums, "dvl").columns["time"]) == 50


CASES = Path(__file__).parents[2] / "shared" / "cases" / "pd0-navigation"
LATE = 28801.5  # s: an instrument's clock on the time of its zone, and off


def with_receiver(k: int, *more: bytes, lat: float = 64.5) -> bytes:
    """The ping of a second, k s after UNIX, by a clock that is late, with a fix half a second before it."""
    clock = f"{datetime.fromtimestamp(UNIX + k - 0.5, UTC):%H%M%S.%f}"[:9]
    gga = winriver_gga(clock, 0.5, lat + 1e-5 * k, -149.0)
    return pd0_ensemble(UNIX + k - LATE, more=(gga, gga, *more))


def test_fixes_beside_the_pings_have_their_own_time_and_tell_how_late_the_instruments_clock_is(tmp_path):
    recording = read(b"".join(with_receiver(k, winriver_hdt(0.25, 120.0)) for k in range(20)), tmp_path)
    fix = first(recording, "fix")
    close(fix.columns["time"], UNIX + np.arange(20) - 0.5, atol=0.01)
    close(fix.columns["fix_lat"], 64.5 + 1e-5 * np.arange(20))
    close(fix.columns["fix_lon"], -149.0)
    close(fix.columns["fix_sd"], 0.9, atol=1e-6)
    dvl = recording.clocks[first(recording, "dvl").clock]
    assert dvl.unix_offset == pytest.approx(LATE, abs=0.02) and dvl.offset_sd < 0.1
    heading = first(recording, "ahrs")
    close(np.rad2deg(heading.columns["ahrs_yaw"]), 120.0)
    close(heading.columns["time"], UNIX + np.arange(20) - 0.25, atol=0.02)
    assert recording.settings["heading"] == {"ahrs_reference": "true"}


def test_fixes_of_vmdas_are_read_and_those_that_jump_or_lie_at_a_pole_refused(tmp_path):
    def file(*places: tuple[float, float]) -> bytes:
        return b"".join(
            pd0_ensemble(UNIX + k - LATE, more=(vmdas_navigation(UNIX + k - 0.2, *place),))
            for k, place in enumerate(places)
        )

    fix = first(read(file(*((48.08 + 1e-5 * k, -123.04) for k in range(9))), tmp_path), "fix")
    close(fix.columns["fix_lat"], 48.08 + 1e-5 * np.arange(9), atol=1e-7)
    close(fix.columns["time"], UNIX + np.arange(9) - 0.2, atol=1e-3)
    jumping = read(file(*((48.0 + 7.0 * (k % 3), 10.0 * k) for k in range(9))), tmp_path)
    assert not [c for c in jumping.channels if c.sensor == "fix"] and any("jump about" in w for w in jumping.warnings)
    assert "origin_lat_deg" not in jumping.settings.get("environment", {})
    assert not [c for c in read(file(*[(-89.9, 5.0)] * 9), tmp_path).channels if c.sensor == "fix"]


@pytest.mark.skipif(not CASES.is_dir(), reason=f"no {CASES}")
def test_fixes_of_a_river_survey_are_those_of_its_sentences(tmp_path):
    """What WinRiver has decoded (0x2022) equals the text that it keeps beside it (0x2101), to the text's last digit."""
    recording = read_recording(CASES / "tanana_002_head.PD0.gz")
    fix = first(recording, "fix").columns
    assert len(fix["time"]) == 838
    of_day = 22 * 3600.0 + 28 * 60.0 + 17.2  # 222817.20: 6433.654203 N, 14904.007018 W
    k = int(np.argmin(np.abs(fix["time"] % 86400.0 - of_day)))
    close([fix["fix_lat"][k], fix["fix_lon"][k]], [64 + 33.654203 / 60, -(149 + 4.007018 / 60)], atol=0.5e-6 / 60)
    assert recording.clocks["DVL's clock"].unix_offset == pytest.approx(28801.46, abs=0.1)
    of_vmdas = first(read_recording(CASES / "vmdas01_part.ENX.gz"), "fix").columns
    close([of_vmdas["fix_lat"][0], of_vmdas["fix_lon"][0]], [48.0805, -123.0440], atol=2e-3)


def test_the_ahrs_of_a_nucleus_without_imu_data_is_the_vehicles_attitude(tmp_path):
    parts = [
        nucleus_ahrs(UNIX + k, (0.1, -0.05, 1.0), 5.0, declination=3.0)
        + nucleus_track(UNIX + k, (0.5, 0.0, 0.0))
        + nucleus_track(UNIX + k, (0.4, 0.0, 0.0), status=0x7FFF if k % 2 else 0, kind=0xBE)
        for k in range(6)
    ]
    recording = read(b"".join(parts), tmp_path)
    assert sensors(recording) == {"vehicle_heading", "vehicle_tilt", "depth", "dvl", "dvl_altitude", "dvl_water"}
    close(first(recording, "vehicle_heading").columns["heading"], 1.0 - np.deg2rad(3.0), atol=1e-6)
    tilt = first(recording, "vehicle_tilt").columns
    close([tilt["roll"][0], tilt["pitch"][0]], [0.1, -0.05], atol=1e-6)
    assert [(each.name, each.count) for each in recording.left] == [("water track", 3)]
