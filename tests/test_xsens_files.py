"""Text exports of Xsens' MT Manager: counters that wrap, worlds, and damage."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import check_refused_or_whole, close, first, read

from rovgraph.errors import InputError
from rovgraph.geometry import matrix_from_rpy, rpy_from_matrix

VECTORS = [f"{sensor}_{axis}" for sensor in ("Acc", "Gyr", "Mag") for axis in "XYZ"]
NAMES = ["PacketCounter", "SampleTimeFine", *VECTORS, "Roll", "Pitch", "Yaw"]
FLU = np.diag([1.0, -1.0, -1.0])


def export(
    count: int = 20, world: str = "ENU", fine: bool = True, start: int = 0, rpy: tuple = (0.0, 0.0, 0.0)
) -> bytes:
    names = [name for name in NAMES if fine or name != "SampleTimeFine"]
    lines = ["// Start Time: Unknown", "// Update Rate: 100.0Hz", f"// Coordinate system: {world}", "\t".join(names)]
    for k in range(start, start + count):
        counts = [k % 65536, (100 * k) % 2**32] if fine else [k % 65536]
        lines.append("\t".join(map(str, [*counts, 0.1, 0.2, 9.8, 0.01, 0.02, 0.03, 0.5, 0.1, -0.8, *rpy])))
    return "\r\n".join([*lines, ""]).encode()


@pytest.mark.parametrize(("fine", "start"), [(True, 42_949_660), (False, 65_530)])
def test_counters_that_wrap_go_on(fine, start, tmp_path):
    recording = read(export(20, fine=fine, start=start), tmp_path)
    close(np.diff(first(recording, "imu").columns["time"]), 0.01, atol=1e-9)
    assert [clock.unix_offset for clock in recording.clocks.values()] == [None]


@pytest.mark.parametrize("world", ["ENU", "NWU", "NED"])
def test_attitude_is_that_of_the_imus_axes_in_ned(world, tmp_path):
    R_ns = matrix_from_rpy([0.1, -0.2, 1.0]) @ FLU
    to_ned = {"ENU": np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]]), "NWU": FLU, "NED": np.eye(3)}[world]
    angles = np.rad2deg(rpy_from_matrix(to_ned.T @ R_ns))
    recording = read(export(world=world, rpy=tuple(angles)), tmp_path)
    ahrs = first(recording, "ahrs").columns
    R_bs = matrix_from_rpy(np.deg2rad(recording.settings["imu"]["mount_rpy_deg"]))
    said = matrix_from_rpy([ahrs[f"ahrs_{name}"][0] for name in ("roll", "pitch", "yaw")])
    close(rpy_from_matrix(said @ R_bs.T), [0.1, -0.2, 1.0], atol=1e-9)
    assert len(recording.warnings) == 1


def test_damaged_rows_are_counted(tmp_path):
    recording = read(export(20) + b"1\t2\r\n" + export(1).splitlines()[-1].replace(b"9.8", b"9,8x") + b"\n", tmp_path)
    assert len(first(recording, "imu").columns["time"]) == 20
    assert sum(each.count for each in recording.left) == 2


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (export(0), "holds no row of measurements"),
        (export(3).replace(b"Acc_X", b"Vel_X"), "lacks acceleration or rate"),
        (export(3, fine=False).replace(b"Update Rate", b"Nothing"), "neither SampleTimeFine nor a rate"),
    ],
)
def test_a_file_without_use_is_refused(data, said, tmp_path):
    with pytest.raises(InputError, match=said):
        read(data, tmp_path)


@settings(max_examples=50, deadline=None)
@given(changes=st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=4)), max_size=10))
def test_changed_bytes_raise_nothing_but_a_refusal(changes, tmp_path_factory):
    data = bytearray(export(9))
    for place, new in changes:
        data[place % len(data) : place % len(data) + 2] = new
    check_refused_or_whole(read, bytes(data), tmp_path_factory.getbasetemp())
