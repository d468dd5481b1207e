"""Tables as Excel, loggers and people write them: read, or refused with a remedy that works when it is followed."""

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from test_api import command
from wire import Heard, decoded

import rovgraph as rg
from rovgraph.errors import DataWarning, InputError
from rovgraph.geometry import matrix_from_rpy
from rovgraph.inference.trajectory import Trajectory
from rovgraph.live.sources.json_lines import json_lines
from rovgraph.log import tables as log_tables
from rovgraph.log.units import turn_angles
from rovgraph.report.export import Track
from rovgraph.report.export import tag as tag_table

T0 = 1777627800.0  # 2026-05-01 09:30:00 UTC
N = 40
TRUTH = pd.DataFrame(
    {
        "time": T0 + 0.5 * np.arange(N),
        "depth": np.round(4.0 + 0.013 * np.arange(N), 3),
        "fix_lat": np.round(54.3 + 2e-6 * np.arange(N), 7),
        "fix_lon": np.round(10.15 - 3e-6 * np.arange(N), 7),
    }
)
REMEDY = re.compile(r"(columns|units|angles|times|delay_s): (\{[^}]*\})")


@dataclass(frozen=True)
class Case:
    """A file, what is said of it, and the configuration beside which it is right."""

    content: bytes | str
    said: str = ""
    refused: bool = False
    config: str = ""
    shift: float = 0.0  # of the times that come of it
    origin: str = "environment: {origin_lat_deg: 54.3, origin_lon_deg: 10.15}"


def table(separator: str = ",", **columns: Any) -> str:
    """A table of the truth with other columns in place of some; None leaves one out."""
    frame = TRUTH.assign(**{name: values for name, values in columns.items() if values is not None})
    return frame.drop(columns=[n for n, v in columns.items() if v is None]).to_csv(index=False, sep=separator)


def stamps(form: str, shift: float = 0.0) -> list[str]:
    return [pd.Timestamp(t + shift, unit="s").strftime(form) for t in TRUTH["time"]]


def german(text: str) -> str:
    """Decimal commas; dates keep their points."""
    return re.sub(r"(?<![\d.])(\d+)\.(\d+)(?![\d.])", r"\1,\2", text)


def with_units(text: str) -> str:
    head, _, rows = text.partition("\n")
    return f"{head}\ns,cm,deg,deg\n{rows}"


def wider_from(row: int, text: str) -> str:
    lines = text.split("\n")
    return "\n".join(
        line.replace(",54.3", ",x,--.--,54.3", 1) if k >= row and line else line for k, line in enumerate(lines)
    )


def ddmm(degrees: pd.Series) -> pd.Series:
    return np.floor(degrees) * 100.0 + np.round(60.0 * (degrees % 1.0), 6)


def sometimes(values: pd.Series, placeholder: float) -> pd.Series:
    return values.mask(np.arange(N) % 3 == 1, placeholder)


EXCEL = german(table(";")).replace("time;depth", "Zeit;Tiefe [m]")
DAYS = TRUTH["time"] / 86400.0
FINE = "%Y-%m-%d %H:%M:%S.%f"
CASES = {
    # how cells are written
    "plain": Case(table()),
    "semicolons": Case(table(";"), "separated by semicolons"),
    "tabs": Case(table("\t"), "separated by tabs"),
    "decimal commas": Case(german(table(";")), "separated by semicolons, with decimal commas"),
    "decimal commas and tabs": Case(german(table("\t")), "separated by tabs, with decimal commas"),
    "quoted decimal commas": Case(re.sub(r"(\d+)\.(\d+)", r'"\1,\2"', table()), "with decimal commas"),
    "quoted numbers": Case(re.sub(r"(\d+\.\d+)", r'"\1"', table())),
    "sep= of Excel": Case("sep=;\n" + table(";"), "separated by semicolons"),
    "Windows-1252": Case(
        EXCEL.replace("Tiefe", "Wassertiefe über Grund").encode("cp1252"),
        "in Windows-1252, separated by semicolons, with decimal commas",
        config="columns: {time: Zeit, depth: 'Wassertiefe über Grund [m]'}",
    ),
    "UTF-16": Case(table().encode("utf-16"), "in UTF-16"),
    "UTF-16, big end first": Case(b"\xfe\xff" + table().encode("utf-16-be"), "in UTF-16"),
    "UTF-16 without a mark": Case(table().encode("utf-16-le"), "in UTF-16"),
    "UTF-16 and tabs": Case(german(table("\t")).encode("utf-16"), "in UTF-16, separated by tabs, with decimal commas"),
    "byte order mark": Case("\ufeff" + table()),
    "lines of Windows": Case(table().replace("\n", "\r\n")),
    "units in the header": Case(
        table(depth=100 * TRUTH["depth"]).replace("depth,", "depth [cm],"), r"units by the header \(cm\)"
    ),
    "feet in the header": Case(
        table(depth=TRUTH["depth"] / 0.3048).replace("depth,", "depth [feet],"), r"units by the header \(ft\)"
    ),
    "units in the second line": Case(
        with_units(table(depth=100 * TRUTH["depth"])), r"with units in line 2; units by the header \(s, cm, deg\)"
    ),
    "thousands or decimals": Case(
        german(table(";")).replace(";4,", ";4.", 3), "'4.[0-9]*' may be 4[0-9]* or 4.[0-9]*, as the file has", True
    ),
    "a unit that is not known": Case(
        table().replace("depth,", "depth [fathoms],"), "unknown unit 'fathoms', expected one of m", True
    ),
    "units of the configuration": Case(
        table(depth=100 * TRUTH["depth"]).replace("depth,", "depth [mm],"), config="units: {depth: cm}"
    ),
    "empty columns": Case(table().replace("\n", ",,\n"), "without 2 columns that have no name"),
    "separators at the ends of rows": Case(
        table().replace("\n", ",\n").replace("lon,\n", "lon\n"), "behind the others"
    ),
    "more columns later on": Case(
        wider_from(9, table()), "without 2 columns that no name stands for, before 'fix_lat' from line 10 on"
    ),
    "one row with more cells": Case(table().replace("\n", ",7\n", 3).replace("lon,7", "lon"), "has 5 cells", True),
    # times
    "ISO 8601": Case(table(time=stamps("%Y-%m-%dT%H:%M:%S.%fZ")), "column time as dates"),
    "ISO 8601, compact": Case(table(time=stamps("%Y%m%dT%H%M%S.%f")), "column time as dates"),
    "ISO 8601, another zone": Case(table(time=[f"{t}+02:00" for t in stamps(FINE, 7200.0)]), "column time as dates"),
    "no zone": Case(table(time=stamps(FINE)), "in UTC where they state no zone"),
    "a stated zone": Case(table(time=stamps(FINE, 7200.0)), r"in UTC\+2 h", config="times: {zone_h: 2}"),
    "commas of Python's logging": Case(table(time=[t[:-3].replace(".", ",") for t in stamps(FINE)]), "as dates"),
    "German": Case(german(table(";", time=stamps("%d.%m.%Y %H:%M:%S.%f"))), "as dates, day first"),
    "months in words": Case(table(time=stamps("%d %b %Y %H:%M:%S.%f")), "as dates"),
    "American": Case(
        table(time=stamps("%m/%d/%Y %I:%M:%S.%f %p", 14 * 86400.0)), "as dates, month first", shift=14 * 86400.0
    ),
    "past midnight": Case(
        table(time=stamps("%m/%d/%Y %H:%M:%S.%f", -34205.0)), "as dates, month first", shift=-34205.0
    ),
    "ambiguous": Case(
        table(time=stamps("%m/%d/%Y %H:%M:%S.%f")),
        r"line 2, column time: '05/01/2026 .*' may be 5 January 2026 or 1 May 2026; state times: {order: dmy}",
        True,
    ),
    "ambiguous, stated": Case(table(time=stamps("%d/%m/%Y %H:%M:%S.%f")), "day first", config="times: {order: dmy}"),
    "day and time in two columns": Case(
        table(time=stamps("%H:%M:%S.%f"), date=stamps("%d.%m.%Y")), "as dates, day first"
    ),
    "day and time by other names": Case(
        table(time=None, Datum=stamps("%Y%m%d"), Uhrzeit=stamps("%H:%M:%S.%f")),
        "as dates",
        config="columns: {date: Datum, time: Uhrzeit}",
    ),
    "time of day, the date stated": Case(
        table(time=stamps("%H:%M:%S.%f")), "times of day of 2026-05-01", config="times: {date: 2026-05-01}"
    ),
    "time of day alone": Case(table(time=stamps("%H:%M:%S.%f")), "as seconds since midnight", shift=34200.0 - T0),
    "time of day past midnight": Case(
        table(time=stamps("%H:%M:%S.%f", -34205.0)), "as seconds since midnight", shift=86395.0 - T0
    ),
    "GPS weeks": Case(
        table(time=[(t - 315964800 + 18) % 604800 for t in TRUTH["time"]], date=[2416] * N), "GPS weeks and seconds"
    ),
    "Excel's days": Case(table(time=DAYS + 25569.0), "Excel's day numbers"),
    "MATLAB's days": Case(table(time=DAYS + 719529.0), "MATLAB's day numbers"),
    "LabVIEW": Case(table(time=TRUTH["time"] + 2082844800.0), "LabVIEW's seconds since 1904"),
    "milliseconds": Case(table(time=(1e3 * TRUTH["time"]).astype(np.int64)), "Unix time in ms"),
    "microseconds": Case(table(time=(1e6 * TRUTH["time"]).astype(np.int64)), "Unix time in us"),
    "nanoseconds": Case(table(time=(1e9 * TRUTH["time"]).astype(np.int64)), "Unix time in ns"),
    "stated Excel": Case(table(time=DAYS + 25569.0), config="units: {time: excel}"),
    "seconds of the size of days": Case(table(time=45000.0 + TRUTH["time"] - T0), shift=45000.0 - T0),
    "too few digits": Case(
        table(time=[f"{t:.6g}" for t in TRUTH["time"]]), "all stamps are 1777630000 s: .*too few digits", True
    ),
    "whole ten seconds": Case(table(time=np.floor(TRUTH["time"] / 10) * 10), "40 stamps have 2 .*too few digits", True),
    "no time": Case(table(time=["noon"] * N), "'noon' is neither seconds nor a date", True),
    "no such day": Case(table(time=["31.02.2026 09:30"] * N), "is not a date; write it as", True),
    # latitudes
    "degrees and minutes": Case(
        table(fix_lat=ddmm(TRUTH["fix_lat"]), fix_lon=ddmm(TRUTH["fix_lon"])), "degrees and minutes in one number", True
    ),
    "1e-7 degrees": Case(
        table(fix_lat=(1e7 * TRUTH["fix_lat"]).round(), fix_lon=(1e7 * TRUTH["fix_lon"]).round()), "1e-7 degrees", True
    ),
    "exchanged": Case(
        table(fix_lat=TRUTH["fix_lon"] + 100.0, fix_lon=TRUTH["fix_lat"]),
        "they are exchanged",
        True,
        origin="environment: {origin_lat_deg: 54.3, origin_lon_deg: 110.15}",
    ),
    "radians": Case(
        table(fix_lat=np.deg2rad(TRUTH["fix_lat"]), fix_lon=np.deg2rad(TRUTH["fix_lon"])), config="units: {fix: rad}"
    ),
    **{
        f"{lat:g}, {lon:g} for unknown": Case(
            table(fix_lat=sometimes(TRUTH["fix_lat"], lat), fix_lon=sometimes(TRUTH["fix_lon"], lon)),
            "13 fixes (are no positions|at latitude and longitude 0)",
        )
        for lat, lon in ((999.0, 999.0), (91.0, 181.0), (0.0, 0.0), (214.7483647, 214.7483647), (-9999.0, 10.15))
    },
}


def read(case: Case, tmp_path: Path, *remedies: tuple[str, str]) -> tuple[rg.Log, str]:
    path = tmp_path / "log.csv"
    path.write_bytes(case.content if isinstance(case.content, bytes) else case.content.encode())
    text = f"{case.config}\n{case.origin}"
    for key, value in remedies:
        text += f"\n{key}: {value}"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        log = rg.read_log(path, rg.parse_config(text))
    return log, " | ".join(str(w.message) for w in caught)


def is_true(log: rg.Log, shift: float = 0.0) -> None:
    np.testing.assert_allclose(log["depth"].time, TRUTH["time"] + shift, atol=2e-5)
    np.testing.assert_allclose(log["depth"]["depth"], TRUTH["depth"], atol=1e-9)
    rows = np.rint(2.0 * (log["fix"].time - log["depth"].time[0])).astype(int)
    metres = 111e3 * (TRUTH["fix_lat"].to_numpy()[rows] - 54.3)
    np.testing.assert_allclose(log["fix"]["fix_north"], metres, atol=0.1)


@pytest.mark.parametrize("name", CASES)
def test_a_table_is_read_or_refused_with_a_remedy_that_works(name, tmp_path):
    case = CASES[name]
    if not case.refused:
        log, said = read(case, tmp_path)
        assert re.search(case.said, said) if case.said else not said, said
        is_true(log, case.shift)
        return
    with pytest.raises(InputError, match=case.said) as caught:
        read(case, tmp_path)
    told = str(caught.value)
    assert "\n" not in told and told.startswith(str(tmp_path / "log.csv"))
    remedies = REMEDY.findall(told)
    if remedies:
        is_true(read(case, tmp_path, remedies[-1])[0])  # of two readings of a date, the second is meant here


LIVE = {
    '{"time": "2026-05-01T09:30:00.5Z", "depth": 4}': (T0 + 0.5, {"depth"}),
    '{"time": "2026-05-01 09:30:00,5", "depth": 4}': (T0 + 0.5, {"depth"}),
    '{"time": "01.05.2026 09:30", "depth": 4}': (T0, {"depth"}),
    '{"time": 7.5, "depth": 4, "fix_lat": 999, "fix_lon": 999}': (7.5, {"depth"}),
    '{"time": 7.5, "depth": 4, "fix_lat": 91, "fix_lon": 181}': (7.5, {"depth"}),
    '{"time": "05/01/2026 09:30", "depth": 4}': (None, "may be 5 January 2026 or 1 May 2026"),
    '{"time": "noon", "depth": 4}': (None, "is neither seconds nor a date"),
}


@pytest.mark.parametrize("line", LIVE)
def test_json_lines_read_dates_and_placeholders_as_tables_do(line):
    stamp, found = LIVE[line]
    heard = Heard()
    messages = decoded(json_lines("-", heard, rg.Config()), line.encode() + b"\n")
    if stamp is None:
        assert not messages and str(found) in " ".join(heard.texts)
        return
    (message,) = messages
    assert message.stamp == pytest.approx(stamp) and {r.sensor for r in message.readings} == found


def test_json_lines_turn_angles_and_units_as_tables_do():
    config = rg.Config().changed(angles={"ahrs": "enu"}, units={"fix": "ddmm", "ahrs": "deg"})
    line = b'{"time": 1, "ahrs_roll": 0, "ahrs_pitch": 10, "ahrs_yaw": 30, "fix_lat": 4330, "fix_lon": 1009}\n'
    (message,) = decoded(json_lines("-", Heard(), config), line)
    values = dict(message.readings)
    np.testing.assert_allclose(values["ahrs"], np.deg2rad([60.0, 180.0, -10.0]))


# references, tags


@pytest.mark.parametrize("write", [table, german, str], ids=["dates", "German", "seconds"])
def test_a_reference_is_read_as_a_log_is(write, tmp_path):
    frame = pd.DataFrame({"time": stamps("%d.%m.%Y %H:%M:%S.%f"), "north": np.arange(N) / 8, "east": 1.5})
    frame = frame if write is not str else frame.assign(time=TRUTH["time"])
    text = frame.to_csv(index=False, sep=";" if write is german else ",")
    path = tmp_path / "reference.csv"
    path.write_bytes((german(text) if write is german else text).encode("cp1252"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reference = rg.read_reference(path)
    np.testing.assert_allclose(reference.time, TRUTH["time"], atol=1e-5)
    np.testing.assert_allclose(reference.p_n[:, 0], np.arange(N) / 8)


def test_tag_reads_the_times_of_a_table_as_a_log_does(tmp_path):
    n = 60
    track = Trajectory.certain(
        T0 + np.arange(n),
        np.outer(np.arange(n), [0.5, 0.0, 0.0]),
        np.broadcast_to(np.eye(3), (n, 3, 3)),
        np.zeros((n, 3)),
    )
    for times in (stamps("%d.%m.%Y %H:%M:%S.%f"), stamps("%H:%M:%S.%f"), stamps("%Y-%m-%dT%H:%M:%SZ"), TRUTH["time"]):
        tagged = tag_table(
            pd.DataFrame({"taken": list(times)}), Track("dive", "smoothed", track, (54.3, 10.15)), "taken"
        )
        assert tagged.frame["rov_north"].iloc[10] == pytest.approx(2.5, abs=0.01)


def test_a_reference_or_a_tag_that_may_be_of_two_days_is_refused_with_what_to_write(tmp_path):
    text = "time,north,east\n05/01/2026 09:30:00,0,0\n05/01/2026 09:30:01,1,0\n"
    (tmp_path / "reference.csv").write_text(text)
    with pytest.raises(InputError, match="may be 5 January 2026 or 1 May 2026; write the year first, such as 2026-"):
        rg.read_reference(tmp_path / "reference.csv")


# several tables


def turned(frame: pd.DataFrame, names: tuple[str, str, str], sense: float, zero: float) -> pd.DataFrame:
    """An attitude that counts otherwise, of axes that point to port and up where it counts anticlockwise."""
    roll, pitch, yaw = names
    up = np.pi if sense < 0.0 and roll.startswith("ahrs") else 0.0
    return frame.assign(**{roll: frame[roll] - up, pitch: sense * frame[pitch], yaw: sense * (frame[yaw] - zero)})


@pytest.fixture(scope="module")
def dive() -> pd.DataFrame:
    """Three minutes with an IMU, its attitude, a DVL, depth and a fix each second, at a Unix time."""
    simulated = rg.simulate("lawnmower", seed=5, choices=rg.Choices(duration=180.0))
    frame, truth = simulated.dive.log_frame, simulated.dive.truth
    at = np.arange(truth.time[0] + 1.0, truth.time[-1] - 1.0)
    fixes = pd.DataFrame({"time": at})
    for k, name in enumerate(("fix_north", "fix_east")):
        fixes[name] = np.interp(at, truth.time, truth.p_n[:, k]) + 0.1 * np.sin(97.0 * at + k)
    attitude = pd.DataFrame(truth.rpy[::10], columns=["ahrs_roll", "ahrs_pitch", "ahrs_yaw"]).assign(
        time=truth.time[::10]
    )
    frame = frame.drop(columns=[name for name in frame if name.startswith(("mag", "ahrs", "dvl_heading"))])
    whole = pd.concat([frame, fixes, attitude]).sort_values("time", kind="stable")
    return whole.assign(time=whole["time"] - frame["time"].iloc[0] + T0).reset_index(drop=True)


def test_an_attitude_counts_as_it_is_stated():
    rpy = pd.DataFrame([[0.1, 0.2, 0.3], [0.0, -0.1, 2.9]], columns=["ahrs_roll", "ahrs_pitch", "ahrs_yaw"])
    for kind, sense, zero in (("enu", -1.0, np.pi / 2), ("nwu", -1.0, 0.0), ("east", 1.0, np.pi / 2)):
        cells = dict(turned(rpy, tuple(rpy), sense, zero).items())
        turn_angles(cells, {"ahrs": kind}, "log")
        for name in rpy:
            np.testing.assert_allclose(np.exp(1j * np.asarray(cells[name])), np.exp(1j * rpy[name]), err_msg=kind)
    R_enu, R_nb = matrix_from_rpy([0.1, 0.2, 0.3]), np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    cells = dict(zip(rpy, [0.1, 0.2, 0.3], strict=True))
    turn_angles(cells, {"ahrs": "enu"}, "log")
    np.testing.assert_allclose(matrix_from_rpy([*cells.values()]), R_nb @ R_enu, atol=1e-12)


@pytest.mark.parametrize(("kind", "zero"), [("enu", np.pi / 2), ("nwu", 0.0)])
def test_a_heading_that_counts_anticlockwise_is_named_and_put_right(dive, kind, zero):
    names = ("ahrs_roll", "ahrs_pitch", "ahrs_yaw")
    frame = turned(dive, names, -1.0, zero)
    frame["ahrs_roll"] += np.pi  # its axes are the vehicle's here
    config = rg.Config()

    def wrong(config: rg.Config) -> list[Any]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return [f for f in rg.check(rg.Log.from_frame(frame, config), config).findings if f.level != "ok"]

    (found,) = [f for f in wrong(config) if f.sensor in ("ahrs", "dvl", "fix")]
    assert found.sensor == "ahrs" and found.kind == "sign"
    (remedy,) = REMEDY.findall(found.text)
    assert remedy == ("angles", f"{{ahrs: {kind}}}")
    assert not [f for f in wrong(rg.parse_config(f"angles: {remedy[1]}")) if f.sensor in ("ahrs", "dvl", "fix")]


@pytest.fixture(scope="module")
def tables(dive, tmp_path_factory) -> dict[str, Path]:
    """The dive as five tables of a bag export, each in its own names and clockwork."""
    folder = tmp_path_factory.mktemp("export")
    parts = {
        "imu": {
            "stamp": "time",
            **{f"{g}.{a}": f"{s}_{a}" for s, g in (("acc", "lin"), ("gyr", "ang")) for a in "xyz"},
        },
        "att": {"t": "time", "Roll": "ahrs_roll", "Pitch": "ahrs_pitch", "Yaw": "ahrs_yaw"},
        "dvl": {"time": "time", "u": "dvl_vx", "v": "dvl_vy", "w": "dvl_vz"},
        "depth": {"time": "time", "Tiefe [m]": "depth"},
        "usbl_1": {"when": "time", "n": "fix_north", "e": "fix_east"},
    }
    paths = {}
    for name, columns in parts.items():
        frame = dive[list(columns.values())].dropna().set_axis(list(columns), axis="columns")
        if name == "dvl":
            frame = frame.assign(**{c: 100.0 * frame[c] for c in "uvw"})
        if name == "usbl_1":
            frame = frame.assign(when=pd.to_datetime(frame["when"] + 2.0, unit="s").dt.strftime("%d.%m.%Y %H:%M:%S.%f"))
        text = frame.to_csv(index=False, sep=";" if name in ("depth", "usbl_1") else ",")
        paths[name] = folder / f"{name}.csv"
        paths[name].write_text(german(text) if name in ("depth", "usbl_1") else text)
    return paths


FILES = """
files:
  imu.csv:
    columns: {time: stamp, acc_x: lin.x, acc_y: lin.y, acc_z: lin.z, gyr_x: ang.x, gyr_y: ang.y, gyr_z: ang.z}
  att.csv: {columns: {time: t, ahrs_roll: Roll, ahrs_pitch: Pitch, ahrs_yaw: Yaw}}
  dvl.csv: {columns: {dvl_vx: u, dvl_vy: v, dvl_vz: w}, units: {dvl: cm/s}}
  "usbl*.csv": {columns: {time: when, fix_north: n, fix_east: e}, delay_s: 2}
columns: {depth: "Tiefe [m]"}
"""


def test_five_tables_are_one_log_by_one_configuration(tables, dive):
    config = rg.parse_config(FILES)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        log = rg.read_log(list(tables.values()), config)
        assert not rg.check(log, config).at("error")
    for sensor, column in (
        ("imu", "gyr_z"),
        ("ahrs", "ahrs_yaw"),
        ("dvl", "dvl_vx"),
        ("depth", "depth"),
        ("fix", "fix_north"),
    ):
        known = dive[["time", column]].dropna()
        np.testing.assert_allclose(log[sensor].time, known["time"], atol=2e-6, err_msg=sensor)
        np.testing.assert_allclose(log[sensor][column], known[column], atol=1e-9, err_msg=sensor)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("dvl.csv: {", "adcp.csv: {"), r"files: 'adcp.csv' fits none of the files \(imu.csv, att.csv"),
        (("att.csv: {", '"*.csv": {'), "files: both .* fit it; state one of them"),
        (("ahrs_yaw: Yaw", "ahrs_yaw: yaw"), "columns: ahrs_yaw: no column 'yaw' in att.csv, nearest is 'Yaw'"),
        (
            ('depth: "Tiefe', 'depth: "Teufe'),
            "columns: depth: no column 'Teufe .*' in imu.csv, .* nearest is 'Tiefe",
        ),
        (("delay_s: 2", "delay: 2"), "unknown key files.usbl.*.delay, nearest known key is"),
        (
            ("units: {dvl: cm/s}", "angles: {dvl: enu}"),
            "angles: dvl is not a heading or a group",
        ),
        (("units: {dvl: cm/s}", "angles: {ahrs: neu}"), "files.dvl.csv.angles.ahrs: expected 'ned', 'enu'"),
        (("units: {dvl: cm/s}", "times: {date: soon}"), "files.dvl.csv.times.date: expected a date such as 2026-05-01"),
    ],
)
def test_files_that_do_not_fit_are_refused_in_one_line(tables, tmp_path, monkeypatch, capsys, change, said):
    config = tmp_path / "config.yaml"
    config.write_text(FILES.replace(*change))
    assert command(monkeypatch, "check", *tables.values(), "--config", config) == 2
    (line,) = [text for text in capsys.readouterr().err.splitlines() if text.startswith("error")]
    assert re.search(said, line), line


def test_what_is_guessed_of_several_tables_reads_them(tables, tmp_path, monkeypatch, capsys, dive):
    config = tmp_path / "config.yaml"
    paths = [tables[name] for name in ("att", "depth")]
    assert command(monkeypatch, "convert", *paths, "--guess", "--config-out", config) == 0
    assert "columns of att.csv" in capsys.readouterr().out
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        log = rg.read_log(paths, rg.load_config(config))
    np.testing.assert_allclose(log["depth"]["depth"], dive["depth"].dropna(), atol=1e-9)


def test_a_guess_reads_an_excel_table_as_its_log(tmp_path):
    names = {"time": "Datum Zeit", "depth": "Hoehe [cm]", "fix_lat": "Breite", "fix_lon": "Länge"}
    frame = TRUTH.assign(time=stamps("%d.%m.%Y %H:%M:%S.%f"), depth=-100.0 * TRUTH["depth"]).rename(columns=names)
    path = tmp_path / "usbl.csv"
    path.write_bytes(german(frame.to_csv(index=False, sep=";")).encode("cp1252"))
    with pytest.warns(DataWarning, match="read in Windows-1252, separated by semicolons, with decimal commas"):
        guess = rg.guess_columns(path)
    assert guess.units["depth"] == "-cm"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        log = rg.read_log(path, guess.config.changed(environment={"origin_lat_deg": 54.3, "origin_lon_deg": 10.15}))
    is_true(log)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"a,b\n1,2\n3,4\n", 3),
        (b"a,b\n1,2\n3,4", 3),
        (b"a,b\n,\n", 2),
        (b"a,b\n\n1,2\n", None),
        (b"a,b\n1,2\n\n", None),
        (b"a,b\n1,2,3\n", None),
        (b"a,b\n1\n", None),
        (b'a,b\n"1,0",2\n', None),
    ],
)
@pytest.mark.parametrize("block", [1, 5, 1 << 24])
def test_lines_are_counted_at_once_where_all_have_the_cells_of_the_header(content, expected, block, monkeypatch):
    monkeypatch.setattr(log_tables, "BLOCK", block)
    assert log_tables._even_lines(content, 2, b",") == expected
    if expected is not None:
        slow = [bool(line.strip()) for line in content.splitlines()]
        filled, odd = log_tables._filled(content, 2, b",", 2)
        assert odd is None and filled.tolist() == slow[1:]
