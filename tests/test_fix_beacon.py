"""Fixes with the name of a beacon: those of others are never the vehicle's."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from rovgraph.errors import InputError
from rovgraph.live.intake import Intake
from rovgraph.live.message import GEODETIC, Reading
from rovgraph.log import read_log
from rovgraph.model.config import parse_config


def log_of(path: Path, names: tuple[str, str], columns: str = "fix_north,fix_east") -> Path:
    """Fixes in turn of two beacons, the first near 0, the second 500 or half a degree away."""
    far = (500.0, 0.0) if "north" in columns else (58.5, 15.0)
    near = (1.0, 0.0) if "north" in columns else (58.0, 15.0)
    rows = [f"{t},{near[0]},{near[1]},{names[0]}\n{t},{far[0]},{far[1]},{names[1]}" for t in range(1, 9)]
    path.write_text("\n".join([f"time,{columns},fix_beacon", *rows, ""]))
    return path


@pytest.mark.parametrize(("names", "stated"), [(("7", "2"), "7"), (("ROV", "wreck"), "ROV"), (("", "2"), None)])
def test_fixes_of_other_beacons_are_not_the_vehicles(tmp_path, names, stated):
    path = log_of(tmp_path / "log.csv", names)
    config = parse_config("{}" if stated is None else f"fix: {{beacon: {stated}}}")
    fix = read_log(path, config)["fix"]
    if stated is None:  # the only name, and fixes without one
        assert len(fix) == 16
    else:
        np.testing.assert_array_equal(fix["fix_north"], np.ones(8))


def test_the_origin_is_the_vehicles_first_fix(tmp_path):
    path = log_of(tmp_path / "log.csv", ("wreck", "ROV"), "fix_lat,fix_lon")
    log = read_log(path, parse_config("usbl: {beacon: ROV}"))
    assert log.origin is not None and log.origin[0] == 58.5
    np.testing.assert_allclose(log["fix"]["fix_north"], np.zeros(8), atol=1e-6)


def test_fixes_of_several_beacons_are_refused_with_their_names(tmp_path):
    path = log_of(tmp_path / "log.csv", ("ROV", "12"))
    with pytest.raises(InputError, match=r"fixes are of beacons 12, ROV; state which .* fix: {beacon: 12}"):
        read_log(path, parse_config("{}"))


def test_a_beacon_that_has_no_fix_is_refused(tmp_path):
    path = log_of(tmp_path / "log.csv", ("1", "2"))
    with pytest.raises(InputError, match="beacons 1, 2, and none of 3, which is stated"):
        read_log(path, parse_config("fix: {beacon: 3}"))


def fix(beacon: float, north: float = 1.0) -> Reading:
    return Reading("fix", np.array([north, 0.0, np.nan, np.nan, np.nan, beacon]))


@pytest.mark.parametrize("key", ["fix", "usbl"])
def test_live_only_the_stated_beacon_is_the_vehicle(key):
    left_out: Counter[tuple[str, str]] = Counter()
    intake = Intake(parse_config(f"{key}: {{beacon: 7}}"), left_out)
    taken = [intake.measurement(float(t), fix(beacon)) for t, beacon in enumerate([2.0, 7.0, np.nan, 2.0])]
    assert [m is not None for m in taken] == [False, True, True, False]
    assert sum(left_out.values()) == 2 and not intake.news


def test_live_named_fixes_are_used_no_more_once_a_second_name_comes_and_that_is_said():
    intake = Intake(parse_config("{}"), Counter())
    taken = [intake.measurement(float(t), fix(beacon)) for t, beacon in enumerate([2.0, 2.0, 3.0, 2.0, np.nan])]
    assert [m is not None for m in taken] == [True, True, False, False, True]
    assert [text for _, text in intake.news] == [
        "fixes are of several beacons, 2 and 3, and none with a name is used any more: state which is the vehicle's, "
        "fix: {beacon: NAME}"
    ]


def test_live_another_beacons_fix_sets_no_origin():
    intake = Intake(parse_config("fix: {beacon: 7}"), Counter())
    assert intake.measurement(1.0, Reading(GEODETIC, np.array([58.5, 15.0, 1.0, np.nan, np.nan, 2.0]))) is None
    assert intake.origin is None
    assert intake.measurement(2.0, Reading(GEODETIC, np.array([58.0, 15.0, 1.0, np.nan, np.nan, 7.0]))) is not None
    assert intake.origin is not None and intake.origin[0] == 58.0


@pytest.mark.parametrize(("stated", "fixes"), [("{}", 16), ("fix: {beacon: 2}", 8), ("fix: {beacon: 3}", 0)])
def test_a_recording_that_is_resumed_is_not_refused(tmp_path, stated, fixes):
    path = log_of(tmp_path / "log.csv", ("1", "2"))
    imu = "time,acc_x,acc_y,acc_z,gyr_x,gyr_y,gyr_z,fix_north,fix_east,fix_beacon\n"
    rows = [line.split(",") for line in path.read_text().splitlines()[1:]]
    path.write_text(imu + "".join(f"{t},0,0,-9.8,0,0,0,{north},{east},{of}\n" for t, north, east, of in rows))
    log = read_log(path, parse_config(stated), as_received=True)
    assert (len(log["fix"]) if "fix" in log else 0) == fixes
