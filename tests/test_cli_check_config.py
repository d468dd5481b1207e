"""The commands check and config as a user meets them: exit code, one line, no traceback."""

import gzip
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from rovgraph import __version__
from rovgraph.cli import app
from rovgraph.cli.logs import key_tables
from rovgraph.model.config import describe, load_config, parse_config

DOCS = Path(__file__).parents[1] / "docs"


@pytest.fixture
def run(monkeypatch, capsys):
    """Call the console script; returns exit code, stdout, stderr."""

    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["rovgraph", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            app.main()
        out, err = capsys.readouterr()
        return stop.value.code or 0, out, err

    return call


@pytest.fixture
def log(tmp_path):
    """A minute of a vehicle that turns, with a DVL in front of it."""
    rng = np.random.default_rng(0)
    rows, heading = ["time,acc_x,acc_y,acc_z,gyr_x,gyr_y,gyr_z,ahrs_yaw,dvl_vx,dvl_vy,dvl_vz,depth"], 0.0
    for k in range(3000):
        t, rate = 0.02 * k, 0.2 * np.sin(0.01 * k)
        heading += 0.02 * rate
        a, w = rng.normal(0, 0.01, 3), rng.normal(0, 0.001, 3)
        rows.append(f"{t:.3f},{a[0]},{a[1]},{a[2] - 9.81},{w[0]},{w[1]},{w[2] + rate},{heading},,,,")
        if k % 10 == 0:
            v = rng.normal(0, 0.01, 3)
            rows.append(f"{t:.3f},,,,,,,,{0.4 + v[0]},{v[1]},{v[2]},5.0")
    path = tmp_path / "dive.csv"
    path.write_text("\n".join(rows) + "\n")
    return path


def test_a_sound_log_exits_with_0_and_shows_every_sensor(run, log):
    code, out, err = run("check", log)
    assert (code, err) == (0, "")
    for text in ("dive.csv", "imu", "dvl", "ahrs", "depth", "ahrs_yaw turns with the gyro", "no errors, no warnings"):
        assert text in out.replace("\n", "")  # a long path is folded


def test_warnings_are_counted_and_exit_with_0(run, log, tmp_path):
    (tmp_path / "c.yaml").write_text("imu: {mount_rpy_deg: [180, 0, 0]}\n")
    code, out, _ = run("check", log, "--config", tmp_path / "c.yaml")
    assert code == 0
    assert "no errors, 1 warning" in out
    assert "180 deg away from upwards" in out
    assert "opposite to the gyro" not in out  # which follows


def test_errors_exit_with_2_after_the_report(run, log, tmp_path):
    (tmp_path / "c.yaml").write_text("units: {acc: mg}\n")
    code, out, err = run("check", log, "-c", tmp_path / "c.yaml")
    assert code == 2
    assert "1 error" in out
    assert err.startswith("error: ") and err.count("\n") == 1


def test_what_smooth_would_refuse_is_an_error_of_check(run, log, tmp_path):
    lame = tmp_path / "lame.csv"
    lame.write_text("\n".join(",".join(row.split(",")[:8]) for row in log.read_text().splitlines()) + "\n")
    code, out, err = run("check", lame)
    assert code == 2 and "1 error" in out and err.count("\n") == 1
    assert "smooth: neither DVL (dvl_vx, dvl_vy, dvl_vz) nor position fixes" in " ".join(err.split())
    refused = run("smooth", lame, "--out", tmp_path / "results")[2]
    assert refused.splitlines()[-1].removeprefix(f"error: {lame}: ") in err


def test_the_table_of_check_holds_its_numbers_at_80_columns(run, log, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    rows = log.read_text().splitlines()
    rows += [f"{4720 + float(row.split(',')[0]):.3f},{row.partition(',')[2]}" for row in rows[1:]]
    log.write_text("\n".join(rows) + "\n")
    table = run("check", log)[1].split("ok  ")[0]
    assert "…" not in table and " 4660 " in table  # the gap, in seconds


def test_the_version_is_told(run):
    assert run("--version") == (0, f"rovgraph {__version__}\n", "")


def test_json_is_the_whole_report(run, log):
    code, out, _ = run("check", log, "--json")
    report = json.loads(out)
    assert code == 0
    assert {t["sensor"]: t["count"] for t in report["timings"]} == {"imu": 3000, "ahrs": 3000, "dvl": 300, "depth": 300}
    assert {f["level"] for f in report["findings"]} == {"ok"}


HEADER = b"time,acc_x,acc_y,acc_z,gyr_x,gyr_y,gyr_z,depth\n"
ROW = b"1,0,0,-9.8,0,0,0,2\n"
HOSTILE = {
    "empty": (b"", "is empty"),
    "header only": (HEADER, "no rows"),
    "binary": (bytes(range(256)), "binary|UTF-8"),
    "ragged, long": (HEADER + ROW + b"2,0,0,-9.8,0,0,0,2,7\n" + ROW, "line 3 has 9 cells, expected 8"),
    "ragged, short": (HEADER + ROW + b"2,0\n" + ROW, "line 3 has 2 cells, expected 8"),
    "not a number": (HEADER + ROW + b"2,0,0,down,0,0,0,2\n", "line 3, column acc_z: 'down'"),
    "no time": (HEADER.replace(b"time", b"Time") + ROW, "no column time"),
    "empty time": (HEADER + b",0,0,-9.8,0,0,0,2\n", "column time is empty"),
    "time set back": (HEADER + b"9" + ROW + ROW, "line 3: time goes back from 91.000 to 1.000 s"),
    "nothing known": (b"time,a,b\n1,2,3\n", "no measurement of any sensor"),
    "everything empty": (HEADER + b"1,,,,,,,\n", "no measurement of any sensor"),
    "gzip cut off": (gzip.compress(HEADER + ROW * 99)[:-9], "gzip"),
    "parquet cut off": (b"PAR1" + bytes(50), "damaged Parquet"),
    "gyro in deg/s": (
        HEADER + b"".join(b"%d,0,0,-9.8,0,0,%d,2\n" % (k, 20 + k % 9) for k in range(99)),
        "units: {gyr: deg/s}",
    ),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_log_is_one_line_and_code_2(run, tmp_path, case):
    content, said = HOSTILE[case]
    path = tmp_path / "bad.csv"
    path.write_bytes(content)
    code, _, err = run("check", path)
    last = err.splitlines()[-1]
    assert code == 2
    assert last.startswith(f"error: {path}: ")
    assert any(part in last for part in said.split("|"))
    assert sum(line.startswith("error: ") for line in err.splitlines()) == 1
    assert "Traceback" not in err


@pytest.mark.parametrize("name", ["absent.csv", "."])
def test_what_is_no_file_is_one_line_and_code_2(run, tmp_path, name):
    code, out, err = run("check", tmp_path / name)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "no such file" in err or "is a directory" in err


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("units: {gyr: degrees}", "nearest is 'deg/s'"),
        ("columns: {gyro_x: a}", "nearest is gyr_x"),
        ("columns: {gyr_x: nothing}", "the log has no 'nothing'"),
        ("unit: {gyr: deg/s}", "nearest known key is units"),
        ("units: [", "not valid YAML"),
    ],
)
def test_a_wrong_configuration_is_one_line_and_code_2(run, log, tmp_path, text, said):
    (tmp_path / "c.yaml").write_text(text)
    code, out, err = run("check", log, "--config", tmp_path / "c.yaml")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err


def test_config_prints_a_configuration_that_reads_back_the_same(run, tmp_path):
    (tmp_path / "c.yaml").write_text("dvl: {mount_rpy_deg: [180, 0, -45]}\nunits: {gyr: deg/s}\n")
    code, out, _ = run("config", tmp_path / "c.yaml")
    assert code == 0
    assert parse_config(out) == load_config(tmp_path / "c.yaml")
    assert YAML(typ="safe").load(out)["graph"]["solver"] == "batch"


def test_config_names_a_wrong_key(run, tmp_path):
    (tmp_path / "c.yaml").write_text("dvl: {mount_rpy: [180, 0, -45]}\n")
    code, out, err = run("config", tmp_path / "c.yaml")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "dvl.mount_rpy_deg" in err


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("dvl: {velocity_sd_mps: 0.01}", "dvl.velocity_sd_mps: expected three numbers, found 0.01"),
        ("dvl: {mount_rpy_deg: [180, 0]}", "dvl.mount_rpy_deg: expected three numbers, found two"),
        ("dvl: {mount_rpy_deg: []}", "dvl.mount_rpy_deg: expected three numbers, found none"),
        ("dvl: {mount_rpy_deg: [180, 0, 0, 1]}", "dvl.mount_rpy_deg: expected three numbers, found four"),
        ("dvl: {mount_rpy_deg: [180, 0, x]}", "dvl.mount_rpy_deg.2: expected a number, found 'x'"),
        ("dvl: {gate_sd: 0}", "dvl.gate_sd: expected more than 0, found 0"),
        ("dvl: {loss: hubr}", "dvl.loss: expected 'none', 'huber' or 'cauchy', found 'hubr'"),
        ("dvl: 3", "dvl: expected keys and values, found 3"),
        ("name:", "name: expected text, found nothing"),
        ("imu: {mag: {matrix: [1]}}", "imu.mag.matrix.0: expected three numbers, found 1"),
        ("vehicle: {thrusters: [{}]}", "vehicle.thrusters.0.position_m: expected three numbers, found nothing"),
        ("vehicle: {thrusters: 4}", "vehicle.thrusters: expected a list of entries, found 4"),
        ("environment: {latitude_deg: 99}", "environment.latitude_deg: expected 90 or less, found 99"),
        ("environment: {earth_rotation: maybe}", "environment.earth_rotation: expected true or false, found 'maybe'"),
        ("place: {remembered: 1.5}", "place.remembered: expected a whole number, found 1.5"),
        ("delay_s: {dv: 1}", "delay_s: expected one of 'imu', 'mag'"),
        ("online: {delay_s: {dv: 1}}", "delay_s: expected one of 'imu', 'mag'"),
        ("delay_s: {fix: 1}\nonline: {delay_s: {fix: 2}}", "delay_s and online.delay_s both name fix"),
        ("null: 3", "expected text as a key, found nothing"),
        ("dvl: {2: 3}", "dvl: expected text as a key, found 2"),
        ("fix: {beacon: 7.5}", "fix.beacon: expected text or a whole number, found 7.5"),
        ("beacons: [{name: [1]}]", "beacons.0.name: expected text or a whole number, found [1]"),
        ("dvl: {sound_speed_set_mps: []}", "dvl.sound_speed_set_mps: expected a number or text, found []"),
        ("sound: {profile: 1500}", "sound.profile: expected a list of rows of two numbers or text, found 1500"),
        ("calibration: {dvl_yaw: {mean_deg: [1, 2]}}", "dvl_yaw.mean_deg: expected a number, found [1, 2]"),
        ("calibration: {hard_iron: {mean: [1, 2]}}", "hard_iron.mean: expected one number or three, found [1, 2]"),
        ("calibration: {hard_iron: {mean: [1, 2, x]}}", "expected one number or three, found [1, 2, 'x']"),
    ],
)
def test_a_wrong_value_is_said_with_file_key_and_what_was_expected(run, tmp_path, text, said):
    (tmp_path / "c.yaml").write_text(text)
    code, out, err = run("config", tmp_path / "c.yaml")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"error: {tmp_path / 'c.yaml'}: ")
    assert said in err


@pytest.mark.parametrize(
    "text", ["dvl:\n", "dvl:\n  # scale_sd: 0.1\ncolumns:\n", "imu:\n  noise:\n", "calibration:\n  dvl_yaw:\n"]
)
def test_a_section_with_nothing_below_it_is_all_defaults(text):
    assert parse_config(text) == parse_config("")


def test_config_lists_every_key(run):
    code, out, _ = run("config", "--keys")
    assert code == 0
    assert [key for key, _, _ in describe() if key not in out] == []


def test_the_manual_holds_every_key_as_it_is(run):
    _, out, _ = run("config", "--keys", "--markdown")
    assert out.rstrip("\n") == key_tables()
    manual = (DOCS / "configuration.md").read_text(encoding="utf-8")
    assert key_tables() in manual, "renew the tables with: rovgraph config --keys --markdown"


def test_the_manual_names_every_column_and_unit():
    from rovgraph.log.streams import all_columns
    from rovgraph.log.units import UNITS, groups

    manual = (DOCS / "log-format.md").read_text(encoding="utf-8")
    of_others = re.compile(r"dvl_beam_\w+_[02-8]|adcp_beam_[02-8]")  # of beams the manual names the first one's
    columns = [name for name in all_columns() if not of_others.fullmatch(name)]
    columns = [name.removeprefix("adcp_") for name in columns]  # which a table beside the log has without it
    names = [*columns, *groups(), *(unit for known in UNITS.values() for unit in known)]
    assert [name for name in names if f"`{name}`" not in manual] == []


def test_the_example_of_the_manual_is_a_log(tmp_path):
    from rovgraph.log import read_log

    manual = (DOCS / "log-format.md").read_text(encoding="utf-8")
    path = tmp_path / "example.csv"
    path.write_text(manual.split("```csv\n")[1].split("```")[0])
    example = read_log(path)
    assert {s: len(example[s]) for s in example.sensors} == {"imu": 3, "dvl": 2, "ahrs": 3, "depth": 2}


def test_every_sensor_may_be_given_a_delay():
    from rovgraph.model.config_sections import STAMPED
    from rovgraph.sensors import SENSORS

    of_beams = {name for name in SENSORS if name.startswith("dvl_beam_")}  # theirs is that of dvl_beams
    of_others = {"pressure", "water_layer"}  # of depth, and of adcp
    assert set(STAMPED) == set(SENSORS) - of_beams - of_others
