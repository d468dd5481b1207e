"""Columns of anyone's table: the mapping that is proposed is the true one, and what is not known is said."""

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_api import SHIPPED, command

import rovgraph as rg
from rovgraph.log.tables import read_table
from rovgraph.readers.guessing.names import meaning

G, DEG = 9.80665, float(np.rad2deg(1.0))
XYZ = ("x", "y", "z")
ACC, GYR, MAG, DVL = (tuple(f"{g}{axis}" for axis in XYZ) for g in ("acc_", "gyr_", "mag_", "dvl_v"))
UP = np.array([1.0, -1.0, -1.0])  # of the axes of an IMU whose z axis points up


@pytest.fixture(scope="module")
def dive() -> rg.SimulatedDive:
    """A dive of two minutes with an IMU, its AHRS, a DVL, a compass in it, and a depth that changes."""
    return rg.simulate("lawnmower", seed=5, choices=rg.Choices(duration=120.0))


@pytest.fixture(scope="module")
def frame(dive) -> pd.DataFrame:
    """Its log, rounded as a file is."""
    return dive.dive.log_frame.round(6)


def renamed(frame: pd.DataFrame, names: Mapping[str, str], factors: Mapping[str, float]) -> pd.DataFrame:
    """A foreign table: numbers times factors, columns by other names."""
    out = frame.assign(**{name: frame[name] * factor for name, factor in factors.items()})
    return out[list(names)].rename(columns=dict(names))


def triple(fields: tuple[str, ...], *names: str) -> dict[str, str]:
    return dict(zip(fields, names, strict=True))


def ros(frame: pd.DataFrame) -> tuple[pd.DataFrame, dict[str, str], dict[str, str]]:
    names = {
        "time": "%time",
        **{f"acc_{a}": f"imu.linear_acceleration.{a}" for a in XYZ},
        **{f"gyr_{a}": f"imu.angular_velocity.{a}" for a in XYZ},
        **{f"mag_{a}": f"magnetic_field.{a}" for a in XYZ},
        **{f"dvl_v{a}": f"/dvl/velocity.{a}" for a in XYZ},
        "dvl_valid": "/dvl/valid",
        "dvl_heading": "/dvl/yaw",
        "depth": "/depth/data",
    }
    table = renamed(frame.assign(time=frame["time"] + 1.7e9), names, {})
    table["%time"] = np.round(table["%time"] * 1e9).astype(np.int64)
    table = table.assign(**{"imu.angular_velocity_covariance[0]": -1.0, "imu.orientation.w": 1.0})
    units = {"time": "ns", "acc": "m/s2", "gyr": "rad/s", "dvl": "m/s", "dvl_heading": "rad", "depth": "m"}
    return table, names, units


def bracketed(frame: pd.DataFrame) -> tuple[pd.DataFrame, dict[str, str], dict[str, str]]:
    names = {
        "time": "Time (ms)",
        **{f"acc_{a}": f"Accel {a.upper()} [g]" for a in XYZ},
        **{f"gyr_{a}": f"Gyro {a.upper()} [deg/s]" for a in XYZ},
        **{f"mag_{a}": f"Mag {a.upper()} [uT]" for a in XYZ},
        **{f"dvl_v{a}": f"DVL V{a.upper()} [mm/s]" for a in XYZ},
        "dvl_valid": "DVL valid",
        "dvl_heading": "DVL heading [deg]",
        "depth": "Depth [cm]",
    }
    factors = {"time": 1e3, "dvl_heading": DEG, "depth": 100.0, **dict.fromkeys(GYR, DEG)}
    factors |= {**dict.fromkeys(ACC, 1.0 / G), **dict.fromkeys(DVL, 1e3)}
    units = {"time": "ms", "acc": "g", "gyr": "deg/s", "mag": "uT", "dvl": "mm/s", "dvl_heading": "deg", "depth": "cm"}
    return renamed(frame, names, factors), names, units


def mavlink(frame: pd.DataFrame) -> tuple[pd.DataFrame, dict[str, str], dict[str, str]]:
    names = {
        "time": "RAW_IMU.time_usec",
        **{f"acc_{a}": f"RAW_IMU.{a}acc" for a in XYZ},
        **{f"gyr_{a}": f"RAW_IMU.{a}gyro" for a in XYZ},
        **{f"mag_{a}": f"RAW_IMU.{a}mag" for a in XYZ},
        **{f"dvl_v{a}": f"dvl_velocity_{a}" for a in XYZ},
        "dvl_valid": "dvl_velocity_valid",
        "dvl_heading": "dvl_hdg",
        "depth": "depth",
    }
    factors = {"time": 1e6, **dict.fromkeys(ACC, 1e3 / G), **dict.fromkeys(GYR, 1e3)}
    units = {"time": "us", "acc": "mg", "gyr": "mrad/s", "dvl": "m/s", "dvl_heading": "rad", "depth": "m"}
    return renamed(frame, names, factors), names, units


def upwards(frame: pd.DataFrame) -> tuple[pd.DataFrame, dict[str, str], dict[str, str]]:
    """An IMU whose z axis points up, and z of the pressure sensor, which does so too; no unit is stated."""
    names = {
        "time": "t",
        **triple(ACC, "ax", "ay", "az"),
        **triple(GYR, "wx", "wy", "wz"),
        **triple(MAG, "mx", "my", "mz"),
        **triple(DVL, "dvlVelX", "dvlVelY", "dvlVelZ"),
        "dvl_valid": "dvl_valid",
        "dvl_heading": "dvlYaw",
        "depth": "depth_z",
    }
    factors = {"dvl_heading": DEG, "depth": -1.0, **dict.fromkeys(DVL, 100.0)}
    for group in (ACC, GYR, MAG):
        factors |= dict(zip(group, UP, strict=True))
    factors |= {name: factors[name] * DEG for name in GYR}
    units = {"time": "s", "acc": "m/s2", "gyr": "deg/s", "dvl": "cm/s", "dvl_heading": "deg", "depth": "-m"}
    return renamed(frame, names, factors), names, units


FORMS = (ros, bracketed, mavlink, upwards)


def written(table: pd.DataFrame, folder: Path) -> Path:
    path = folder / "table.csv"
    table.to_csv(path, index=False)
    return path


@pytest.mark.parametrize("form", FORMS)
def test_the_guess_of_a_foreign_table_is_the_truth(form: Callable, frame, tmp_path):
    table, names, units = form(frame)
    guess = rg.guess_columns(written(table, tmp_path))
    assert guess.mapping == {field: column for field, column in names.items() if field != column}
    assert guess.units == units
    assert {each.sureness for each in guess.columns if each.field in (*ACC, *GYR, "dvl_heading")} == {"sure"}
    assert {each.sureness for each in guess.columns if each.field in DVL} == {
        "sure" if "mm/s" in units["dvl"] else "likely"
    }
    assert set(guess.left) == set(table.columns) - set(names.values())
    assert guess.settings == ({"imu": {"mount_rpy_deg": [180.0, 0.0, 0.0]}} if form is upwards else {})
    assert rg.parse_config(guess.to_yaml()) == guess.config
    assert guess.config.columns == guess.mapping and guess.config.units == guess.units


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.filterwarnings("ignore::rovgraph.errors.DataWarning")
def test_smoothing_with_the_proposed_configuration_gives_the_track_of_the_log(form: Callable, dive, frame, tmp_path):
    table, _, _ = form(frame)
    guess = rg.guess_columns(written(table, tmp_path))
    frame.to_csv(tmp_path / "log.csv", index=False)
    own = rg.smooth(rg.read_log(tmp_path / "log.csv", dive.config), dive.config, estimate="smoothed")
    proposed = dive.config.changed(columns=guess.mapping, units=guess.units, **guess.settings)
    theirs = rg.smooth(rg.read_log(tmp_path / "table.csv", proposed), proposed, estimate="smoothed")
    a, b = own.smoothed.trajectory, theirs.smoothed.trajectory
    assert len(a.time) == len(b.time) > 100
    np.testing.assert_allclose(b.position, a.position, atol=2e-3)


@pytest.mark.parametrize(("speed", "length"), [("m/s", "m"), ("cm/s", "cm"), ("mm/s", "-m"), ("m/s", "mm")])
def test_a_dvl_and_a_depth_that_change_alike_give_each_others_unit(speed, length, tmp_path):
    names = {n: n for n in ("time", *ACC, *GYR, *DVL, "depth")}
    dive = pd.read_csv(SHIPPED / "log.csv.gz").head(40_000)
    down = {"m": 1.0, "cm": 100.0, "mm": 1000.0, "-m": -1.0}[length]
    factors = {"depth": down, **dict.fromkeys(DVL, {"m/s": 1.0, "cm/s": 100.0, "mm/s": 1000.0}[speed])}
    guess = rg.guess_columns(written(renamed(dive, names, factors), tmp_path))
    assert (guess.units["dvl"], guess.units["depth"]) == (speed, length)
    assert {each.sureness for each in guess.columns if each.field in (*DVL, "depth")} == {"sure"}


def test_large_numbers_of_a_depth_without_a_unit_are_no_metres_for_sure(frame, tmp_path):
    table = renamed(frame, {n: n for n in ("time", *ACC, *GYR, *DVL, "depth")}, {"depth": 100.0})
    (depth,) = [each for each in rg.guess_columns(written(table, tmp_path)).columns if each.field == "depth"]
    assert depth.sureness == "unsure" and "state it" in depth.why


def test_names_that_say_nothing_are_never_proposed(frame, tmp_path):
    table = frame.set_axis([f"column {k}" for k in range(frame.shape[1])], axis="columns")
    guess = rg.guess_columns(written(table, tmp_path))
    assert guess.columns and {each.sureness for each in guess.columns} == {"unsure"}
    assert guess.mapping == {} and guess.units == {} and guess.config == rg.Config()
    assert "# unsure: time: column 0" in guess.to_yaml()


def test_without_a_heading_the_gyro_is_at_most_likely_and_never_wrong(frame, tmp_path):
    for unit, factor in (("rad/s", 1.0), ("deg/s", DEG), ("mrad/s", 1e3)):
        names = {"time": "time", **{n: n for n in (*ACC, *GYR)}}
        guess = rg.guess_columns(written(renamed(frame, names, dict.fromkeys(GYR, factor)), tmp_path))
        gyro = [each for each in guess.columns if each.field in GYR]
        assert len(gyro) == 3 and "sure" not in {each.sureness for each in gyro}
        assert all(each.unit == unit or each.sureness == "unsure" for each in gyro)


def test_a_stated_unit_that_the_heading_contradicts_is_unsure(frame, tmp_path):
    names = {n: n for n in ("time", *ACC, "dvl_heading")} | {n: f"{n} [deg/s]" for n in GYR}
    guess = rg.guess_columns(written(renamed(frame, names, {}), tmp_path))
    assert {each.sureness for each in guess.columns if each.field in GYR} == {"unsure"}


def test_angles_of_one_source_share_a_unit_and_those_of_two_do_not(frame, tmp_path):
    small = frame["dvl_heading"] * 0.0 + np.sin(frame["time"])
    table = frame[["time", *ACC, *GYR]].assign(
        **{"imu.roll": 2.0 * small, "imu.pitch": small, "imu.yaw": frame["dvl_heading"] * DEG},
        **{"ATTITUDE.roll": 0.6 * small, "ATTITUDE.pitch": 0.1 * small, "VFR_HUD.heading": frame["dvl_heading"] * DEG},
    )
    guess = rg.guess_columns(written(table, tmp_path))
    assert (guess.mapping["ahrs_yaw"], guess.mapping["ahrs_roll"]) == ("imu.yaw", "imu.roll")
    assert (guess.mapping["heading"], guess.mapping["roll"]) == ("VFR_HUD.heading", "ATTITUDE.roll")
    assert guess.units["ahrs"] == "deg"
    assert (guess.units["heading"], guess.units["roll"], guess.units["pitch"]) == ("deg", "rad", "rad")


def test_axes_of_one_vector_in_several_units_are_left(frame, tmp_path):
    names = {n: n for n in ("time", *ACC)} | triple(GYR, "gyr_x_deg_s", "gyr_y_deg_s", "gyr_z_rad_s")
    guess = rg.guess_columns(written(renamed(frame, names, {}), tmp_path))
    assert {name for name, why in guess.left.items() if "deg/s and rad/s" in why} == {names[n] for n in GYR}


def test_a_depth_that_contradicts_the_dvl_is_unsure(tmp_path):
    names = {n: n for n in ("time", *ACC, *GYR)} | triple(DVL, "dvl_vx_m_s", "dvl_vy_m_s", "dvl_vz_m_s")
    dive = pd.read_csv(SHIPPED / "log.csv.gz").head(40_000)
    table = renamed(dive, {**names, "depth": "depth [cm]"}, {})
    guess = rg.guess_columns(written(table, tmp_path))
    assert {each.sureness for each in guess.columns if each.field in (*DVL, "depth")} == {"unsure"}


def test_a_heading_that_counts_anticlockwise_is_unsure(frame, tmp_path):
    names = {n: n for n in ("time", *ACC, *GYR)} | {"dvl_heading": "odometer yaw"}
    guess = rg.guess_columns(written(renamed(frame, names, {"dvl_heading": -1.0}), tmp_path))
    (yaw,) = [each for each in guess.columns if each.column == "odometer yaw"]
    assert yaw.sureness == "unsure" and "anticlockwise" in yaw.why
    assert guess.units["gyr"] == "rad/s"


def test_gravity_that_is_in_no_unit_is_unsure(frame, tmp_path):
    names = {n: n for n in ("time", *ACC, *GYR)}
    guess = rg.guess_columns(written(renamed(frame, names, dict.fromkeys(ACC, 0.2)), tmp_path))
    assert {each.sureness for each in guess.columns if each.field in ACC} == {"unsure"}


@pytest.mark.parametrize(
    ("scale", "unit", "sureness"),
    [(1.0, "deg", "sure"), (1e7, "degE7", "sure"), (np.deg2rad(1.0), "deg", "unsure")],
)
def test_positions_are_in_the_unit_of_their_range(scale, unit, sureness, tmp_path):
    time = np.arange(50.0)
    table = pd.DataFrame({"time": time, "latitude": (41.7 + 1e-5 * time) * scale, "longitude": 2.5 * scale})
    guess = rg.guess_columns(written(table, tmp_path))
    assert {(each.unit, each.sureness) for each in guess.columns if each.field != "time"} == {(unit, sureness)}


@pytest.mark.parametrize(
    ("name", "field", "unit"),
    [
        ("AccX", "acc_x", ""),
        ("accel_y_m_s2", "acc_y", "m/s2"),
        ("acc.z (mg)", "acc_z", "mg"),
        ("gyroZ_dps", "gyr_z", "deg/s"),
        ("ATTITUDE.yawspeed", "gyr_z", ""),
        ("angular_velocity.x", "gyr_x", ""),
        ("angular_acceleration.x", "", ""),
        ("xmag", "mag_x", ""),
        ("imu roll [deg]", "ahrs_roll", "deg"),
        ("VFR_HUD.heading", "heading", ""),
        ("dvl_vx_mm_s", "dvl_vx", "mm/s"),
        ("water velocity y", "dvl_water_vy", ""),
        ("LOCAL_POSITION_NED.vx", "", ""),
        ("ekf.vel.x", "", ""),
        ("depth_m", "depth", "m"),
        ("Depth (meters)", "depth", "m"),
        ("depth [ft]", "depth", "ft"),
        ("depth [fathoms]", "", ""),
        ("pressure [Pa]", "pressure", "Pa"),
        ("gps.lat", "fix_lat", ""),
        ("lon_e7", "fix_lon", "degE7"),
        ("usbl_easting", "fix_east", ""),
        ("timestamp_us", "time", "us"),
        ("gyro_bias_x", "", ""),
        ("orientation.x", "", ""),
        ("temperature", "", ""),
        ("", "", ""),
        ("°µ", "", ""),
    ],
)
def test_a_name_means_a_column_of_a_log(name, field, unit):
    assert (meaning(name).field, meaning(name).unit) == (field, unit)


@pytest.mark.parametrize(
    ("name", "factor", "beside", "expected"),
    [
        ("Pressure", 1e5, False, ("bar", "likely")),
        ("Pressure", 6894.757, False, ("psi", "likely")),
        ("press_dbar", 1e4, False, ("dbar", "sure")),
        ("Pressure", 3e4, False, ("Pa", "unsure")),
        ("Pressure", 1e5, True, None),
    ],
)
def test_a_pressure_is_in_the_unit_that_makes_its_least_the_airs(frame, tmp_path, name, factor, beside, expected):
    table = frame[["time", *ACC, *GYR]]
    time = table["time"] - table["time"].iloc[0]
    pascal = 101_000.0 + 40_000.0 * np.clip(time / time.max() - 0.2, 0.0, 1.0)
    table = table.assign(**{name: pascal / factor} | ({"depth": 4.0 * time} if beside else {}))
    guess = rg.guess_columns(written(table, tmp_path))
    found = [(each.unit, each.sureness) for each in guess.columns if each.column == name]
    assert found == ([expected] if expected else []) and (guess.left.get(name) is not None) == beside


def test_of_two_imus_one_is_proposed_and_the_other_named(frame, tmp_path):
    table = frame[["time", *ACC, *GYR]].rename(columns={n: f"imu1.{n}" for n in (*ACC, *GYR)})
    table = table.assign(**{f"imu2.{n}": frame[n] for n in ACC})
    guess = rg.guess_columns(written(table, tmp_path))
    assert guess.mapping["acc_x"] in ("imu1.acc_x", "imu2.acc_x")
    assert {each.sureness for each in guess.columns if each.field in ACC} == {"likely"}
    assert sum("too; the source of" in why for why in guess.left.values()) == 3


# bad input

BAD = {
    "empty": (b"", "is empty"),
    "blank": (b"\n\n", "is empty"),
    "no header": (b"0.0,1.0,2.0\n0.1,1.0,2.0\n", "line 1 holds numbers"),
    "no rows": (b"time,acc_x\n", "no rows below"),
    "no time": (b"acc_x,acc_y,acc_z\n0,0,9.8\n0,0,9.8\n", "no column that can be the time"),
    "binary": (b"\x00\x01\x02\x03" * 50, "binary data"),
    "twice": (b"time,a,a\n0,1,2\n1,1,2\n", "twice"),
    "native": (b"$GPGGA,120000.00,4142.0,N,00230.0,E,4,10,1.0,0.0,M,0.0,M,,*6A\n" * 9, "convert it without a guess"),
    "configuration": (b"columns: {time: t}\n", "configuration"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_no_table_is_refused_in_one_line_with_exit_2(case, tmp_path, monkeypatch, capsys):
    content, said = BAD[case]
    path = tmp_path / ("bad.yaml" if case == "configuration" else "bad.csv")
    path.write_bytes(content)
    out = tmp_path / "vehicle.yaml"
    assert command(monkeypatch, "convert", path, "--guess", "--config-out", out) == 2
    error = capsys.readouterr().err.strip()
    assert said in error and "\n" not in error and not out.exists()


def test_options_that_do_not_go_together_are_refused(frame, tmp_path, monkeypatch, capsys):
    path = written(frame, tmp_path)
    for options, said in (
        ([path, "--guess", "--out", tmp_path / "log.csv"], "writes no log"),
        ([path], "--out"),
        ([tmp_path / "none.csv", "--guess"], "no such file"),
    ):
        assert command(monkeypatch, "convert", *options) == 2
        error = capsys.readouterr().err.strip()
        assert said in error and "\n" not in error


def test_cells_that_are_no_numbers_cost_their_column_alone(frame, tmp_path):
    table, _, units = mavlink(frame)
    table = table.assign(comment="dive 3", **{"empty": np.nan, "gyro_huge_x": 1e308, "=cmd|' /C calc'!A0": 1.0})
    table.iloc[5, table.columns.get_loc("RAW_IMU.xacc")] = np.inf
    guess = rg.guess_columns(written(table, tmp_path))
    assert guess.units == units
    assert {"comment", "empty", "gyro_huge_x"} <= set(guess.left)


# the command


def test_the_command_proposes_what_the_library_does_and_writes_only_what_is_asked_for(
    frame, tmp_path, monkeypatch, capsys
):
    table, _, _ = bracketed(frame)
    path = written(table, tmp_path)
    guess = rg.guess_columns(path)
    assert command(monkeypatch, "convert", path, "--guess") == 0
    said = capsys.readouterr().out
    assert guess.to_yaml() in said and "this is a proposal" in said
    assert all(each.column in said for each in guess.columns)
    assert sorted(tmp_path.iterdir()) == [path]
    out = tmp_path / "vehicle.yaml"
    assert command(monkeypatch, "convert", path, "--guess", "--config-out", out) == 0
    twin = guess.save(tmp_path / "twin.yaml")
    assert out.read_bytes() == twin.read_bytes()
    assert rg.load_config(out) == guess.config
    assert command(monkeypatch, "convert", path, "--guess", "--config-out", out) == 2
    with pytest.raises(rg.InputError, match="is the file that is read"):
        guess.save(path, force=True)


NAMES = st.sampled_from(
    ["time", "t", "stamp_ms", "ax", "ay", "az", "acc_z", "wx", "wy", "wz", "gyr_x", "yaw", "roll", "heading [deg]",
     "dvl_vx", "dvl_vy", "dvl_vz", "dvl_valid", "depth", "lat", "lon", "alt", "depth: x # y", "mag_x", "[", "°"]
)  # fmt: skip
CELLS = st.one_of(st.floats(), st.integers(), st.just(""), st.text(max_size=5), st.floats(-10, 10))


@pytest.mark.slow
@given(data=st.data())
def test_random_tables_are_guessed_or_refused_in_one_line(tmp_path_factory, data):
    names = data.draw(st.lists(st.one_of(NAMES, st.text(max_size=8)), min_size=1, max_size=9, unique=True))
    rows = data.draw(st.integers(0, 60))
    seed = np.random.default_rng(data.draw(st.integers(0, 99)))
    columns = {}
    for name in names:
        kind = data.draw(st.sampled_from(["rising", "constant", "noise", "cells"]))
        made = {
            "rising": lambda: np.cumsum(seed.random(rows)),
            "constant": lambda: np.full(rows, 9.8),
            "noise": lambda: seed.normal(size=rows) * 10.0 ** seed.integers(-300, 300),
            "cells": lambda: [data.draw(CELLS) for _ in range(rows)],
        }
        columns[name] = made[kind]()
    path = tmp_path_factory.mktemp("random") / "table.csv"
    pd.DataFrame(columns, dtype=object).to_csv(path, index=False)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            warnings.simplefilter("ignore", rg.DataWarning)
            guess = rg.guess_columns(path)
    except rg.InputError as error:
        assert "\n" not in str(error)
    else:
        assert rg.parse_config(guess.to_yaml()) == guess.config
        assert sorted([*(each.column for each in guess.columns), *guess.left]) == sorted(read_table(path).names)
