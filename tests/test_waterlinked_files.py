"""Files of Water Linked's DVLs: reports come back as they were sent, and what is damaged is counted."""

import json

import numpy as np
import pytest
from autopilot_files import short_dive
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import check_refused_or_whole, close, first, read
from wire import report

from rovgraph.errors import InputError
from rovgraph.log import Log
from rovgraph.model.config import parse_config
from rovgraph.readers.formats import recognise
from rovgraph.readers.recording import Recording
from rovgraph.readers.waterlinked import velocity_report
from rovgraph.sensors.dvl_beam import beam_geometry, velocity_by_beams

START = 1_638_191_471.0


def pings(count: int, start: float = START, **changes: object) -> list[bytes]:
    """Reports, 0.1 s apart."""
    return [
        report(
            **{"time": 100.0, "vx": 0.01 * k, "time_of_validity": round(1e6 * (start + 0.1 * k))}
            | {"time_of_transmission": round(1e6 * (start + 0.1 * k + 0.1))}
            | changes
        )
        for k in range(count)
    ]


def left(recording: Recording) -> dict[str, int]:
    return {f"{one.name}: {one.reason}": one.count for one in recording.left}


def test_a_simulated_dive_comes_back_as_it_was_sent(tmp_path):
    before = Log.from_frame(short_dive(0.0))["dvl"]
    lines = []
    for time, row in zip(before.time, before.data, strict=True):
        vx, vy, vz = np.nan_to_num(row[:3]).tolist()
        stamp = round(1e6 * (START + time))
        lines.append(report(vx=vx, vy=vy, vz=vz, velocity_valid=bool(row[3]), time_of_validity=stamp))
    recording = read(b"".join(lines), tmp_path)
    after = Log.from_arrays(*(c.columns for c in recording.channels))["dvl"]
    assert len(after) == len(before) > 100
    close(after.time - START, before.time, atol=1e-6)
    np.testing.assert_array_equal(after.data[:, :4], before.data[:, :4])
    assert recording.clocks["DVL"].unix_offset == 0.0
    assert recording.left == recording.warnings == ()


def test_the_sd_of_a_ping_is_that_of_one_axis_or_its_figure_of_merit():
    def sd(**changes: object) -> float:
        found = velocity_report(json.loads(report(**changes)))
        assert found is not None
        return found.sd

    assert sd() == pytest.approx(0.002)  # variances of 1, 2 and 9 mm^2/s^2
    assert sd(covariance=...) == 0.004
    assert np.isnan(sd(covariance=..., fom=...))


def test_water_track_is_no_bottom_track(tmp_path):
    other = {"altitude": 3.0, "format": "json_v3.2"}
    water = pings(5, START + 1.0, type="velocity_water", tracking_mode="water", **other)
    lost = pings(2, START + 2.0, type="velocity_water", velocity_valid=False, vx=0.0, **other)
    recording = read(b"".join([*pings(4), *water, *lost]), tmp_path)
    assert len(first(recording, "dvl").columns["time"]) == len(first(recording, "dvl_altitude").columns["time"]) == 4
    close(first(recording, "dvl_water").columns["dvl_water_vx"], 0.01 * np.arange(5))
    close(first(recording, "dvl_water").columns["time"], START + 1.0 + 0.1 * np.arange(5))


def test_pings_without_lock_beams_and_the_dvls_own_position_are_kept_as_what_they_are(tmp_path):
    own = dict.fromkeys(("x", "y", "z", "std", "roll", "pitch"), 1.0) | {"ts": START, "yaw": 90.0}
    position = json.dumps(own | {"type": "position_local", "format": "json_v3.1"}).encode() + b"\r\n"
    answer = {"type": "response", "format": "json_v3.1", "result": {"mounting_rotation_offset": 45.0}}
    lost = pings(1, START + 1.0, velocity_valid=False, vx=0, vy=0, vz=0, altitude=-1)
    recording = read(b"".join([*pings(2), *lost, position, json.dumps(answer).encode()]), tmp_path)
    dvl = first(recording, "dvl").columns
    np.testing.assert_array_equal(dvl["dvl_valid"], [1, 1, 0])
    assert np.isnan([dvl["dvl_vx"][2], dvl["dvl_sd"][2]]).all()
    assert len(first(recording, "dvl_altitude").columns["time"]) == 2
    beams = recording.tables["dvl_beams"]
    close(beams["time"], dvl["time"])
    for number in range(4):
        close(beams[f"range_{number}"], [1.6] * 3)  # along the beam, although the report calls it a distance
        np.testing.assert_array_equal(beams[f"valid_{number}"], [1, 1, 1])
    close(recording.tables["dvl_position"]["yaw"], np.pi / 2)
    assert recording.notes == ("the DVL's settings: mounting_rotation_offset 45.0",)
    assert sum(left(recording).values()) == 2


def test_a_beam_that_a_report_lacks_or_misnames_is_not_known(tmp_path):
    whole = [{"id": k, "beam_valid": k != 2, "distance": 2.0} for k in (3, 0, 2)]
    odd = [
        {"id": "1", "beam_valid": True},
        {"id": 0.5},
        {"id": 99},
        None,
        {"id": 3, "beam_valid": "yes", "distance": "far"},
    ]
    water = pings(1, START + 2.0, type="velocity_water", transducers=whole)
    reports = [*pings(1, transducers=whole), *pings(1, START + 1.0, transducers=odd), *water]
    beams = read(b"".join(reports), tmp_path).tables["dvl_beams"]
    close(beams["time"], [START, START + 1.0])
    for number, valid in ((0, [1, np.nan]), (2, [0, np.nan]), (3, [1, np.nan])):
        np.testing.assert_array_equal(beams[f"valid_{number}"], valid)
    assert "valid_1" not in beams


def test_rows_of_the_makers_script_are_stamped_by_arrival_with_a_warning(tmp_path):
    rows = [f"{round(1e6 * (START + 0.1 * k))},100.0,{0.01 * k},0,0,0.004,1.5,True,0\n" for k in range(20)]
    rows += [f"{round(1e6 * (START + 2.0))},100.0,0,0,0,0.0,-1.0,False,0\n", "7,8\n"]
    header = "log_time,time,vx,vy,vz,fom,altitude,velocity_valid,status\n"
    recording = read((header + "".join(rows)).encode(), tmp_path)
    dvl = first(recording, "dvl").columns
    close(dvl["time"], START + 0.1 * np.arange(21), atol=1e-5)
    np.testing.assert_array_equal(dvl["dvl_valid"], [1.0] * 20 + [0.0])
    close(dvl["dvl_sd"][:20], 0.004)
    assert "stamps are of arrival" in recording.warnings[0]
    assert left(recording) == {"lines: more or fewer cells than the header": 1}


def test_milliseconds_since_the_last_report_are_summed_where_there_is_nothing_else_and_never_taken_for_stamps(tmp_path):
    old = {"format": "json_v2", "covariance": ..., "time_of_validity": ..., "time_of_transmission": ...}
    recording = read(b"".join(pings(30, **old)), tmp_path)
    close(first(recording, "dvl").columns["time"], 0.1 * np.arange(30), atol=1e-9)
    assert "sums of the milliseconds" in recording.warnings[0]
    assert [clock.unix_offset for clock in recording.clocks.values()] == [None]


def test_a_clock_that_is_set_during_the_dive_moves_no_spacing(tmp_path):
    recording = read(b"".join([*pings(20, 50.0), *pings(30, START + 2.0)]), tmp_path)
    close(first(recording, "dvl").columns["time"], START + 0.1 * np.arange(50), atol=1e-5)
    assert "clock was set by" in recording.warnings[0]
    assert recording.clocks["DVL"].unix_offset == 0.0


@pytest.mark.parametrize("begin", [{"time": ...}, {}])
def test_of_a_clock_that_jumps_the_longest_run_is_read_and_said(begin, tmp_path):
    jump = START if begin else 3.0  # without the time between reports, or back
    recording = read(b"".join([*pings(20, 50.0), *pings(30, jump, **begin)]), tmp_path)
    close(first(recording, "dvl").columns["time"], jump + 0.1 * np.arange(30), atol=1e-5)
    assert "the longest run is read" in recording.warnings[0]
    assert left(recording) == {"velocity: of another run of the DVL's clock": 20}


def test_a_clock_that_was_never_set_is_not_unix_time(tmp_path):
    recording = read(b"".join(pings(5, 50.0)), tmp_path)
    assert recording.clocks["DVL"].unix_offset is None


def test_damaged_lines_are_counted_and_the_rest_is_read(tmp_path):
    data = b"".join([pings(1)[0][40:], *pings(10), b"\xff\xfe\n", report(vx="fast"), pings(1)[0][:50]])
    recording = read(data, tmp_path)
    assert len(first(recording, "dvl").columns["time"]) == 10
    assert left(recording) == {"lines: not JSON": 2, "lines: not UTF-8": 1, "velocity: string": 1}


def test_a_file_without_a_velocity_is_refused_by_what_it_holds(tmp_path):
    answer = b'{"type": "response", "format": "json_v3.1"}\n'
    with pytest.raises(InputError, match=r"dive.bin: holds no velocity report.*response: 1"):
        read(answer + report(format="json_v9"), tmp_path)


def test_a_log_of_ours_is_none_of_these(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("time,dvl_vx,dvl_vy,dvl_vz,dvl_valid\n1,0,0,0,1\n")
    assert recognise(path).name == "log"
    path.write_text('{"time": 1, "dvl_vx": 0, "dvl_vy": 0, "dvl_vz": 0}\n')
    assert recognise(path) is None


BASES = (
    b"".join([*pings(8), *pings(3, 5.0, type="velocity_water")]),
    b"log_time,time,vx,vy,vz,fom,altitude,velocity_valid,status\n" + b"1e15,100,0.1,0,0,0.1,1.5,True,0\n" * 9,
)


@settings(max_examples=60, deadline=None)
@given(
    base=st.sampled_from(BASES),
    changes=st.lists(st.tuples(st.integers(0, 10**6), st.binary(min_size=0, max_size=6)), max_size=12),
)
def test_changed_bytes_raise_nothing_but_a_refusal(base, changes, tmp_path_factory):
    data = bytearray(base)
    for place, new in changes:
        data[place % len(data) : place % len(data) + 3] = new
    check_refused_or_whole(read, bytes(data), tmp_path_factory.getbasetemp())


def test_the_makers_example_without_a_type_gives_its_velocity_by_its_beams(tmp_path):
    """The protocol's json_v1: its velocities along four beams, and the velocity that it prints."""
    along, printed = (-0.002349231, -0.003452149, 0.001837982, 0.002901435), (0.009757, 0.002016, -0.000286)
    beams = [{"id": k, "velocity": b, "distance": 2.04, "beam_valid": True} for k, b in enumerate(along)]
    one = dict(zip(("vx", "vy", "vz"), printed, strict=True)) | {"time": 106.4, "fom": 1e-4, "altitude": 1.871}
    row = one | {"transducers": beams, "velocity_valid": True, "status": 0, "format": "json_v1"}
    recording = read(5 * (json.dumps(row).encode() + b"\r\n"), tmp_path)
    table = recording.tables["dvl_beams"]
    found = np.array([[table[f"velocity_{k}"][0] for k in range(4)]])
    geometry = beam_geometry(parse_config("dvl: {preset: waterlinked-a50}").dvl)
    velocity, _ = velocity_by_beams(geometry.directions, found, np.isfinite(found))
    np.testing.assert_allclose(velocity[0], [0.00974, 0.00200, -0.00029], rtol=0.0, atol=6e-6)
    np.testing.assert_allclose(velocity[0], printed, rtol=0.0, atol=2e-5)
