"""The table of formats in docs/formats.md: every command in it runs, on a real file where there is one."""

import json
import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import bags
import numpy as np
import pytest
from autopilot_files import as_json, autopilot_messages, mcap, short_dive
from doppler_files import dvl_record, nucleus_ahrs, nucleus_record, nucleus_track, pd4_frame, pd6_ping
from test_api import command
from test_guess_columns import mavlink as mavlink_table
from test_imc_files import recorded as imc_recording
from test_microstrain_files import as_export as microstrain_export
from test_nmea_and_gpx_files import gga, gpx, rmc
from test_stdbin_files import recorded as stdbin_recording
from test_ugps_files import REAL as UGPS
from test_vectornav_files import as_csv as vectornav_csv
from test_vectornav_files import as_sentences as vectornav_sentences
from test_xsens_files import export as xsens_export
from test_xsens_mtb_files import recorded as xsens_recording
from wire import report

import rovgraph as rg
from rovgraph.readers import formats

DATA = Path(__file__).parents[2] / "shared" / "data"
START = 1_750_000_000.0  # Unix time [s]
REAL = {
    path.name: path
    for folder in ("ictineu", "ardusub", "remus600_pd0", "glider_pd0", "adcp_bt")
    for path in sorted((DATA / folder).glob("*"))
}
TEXT = (Path(__file__).parents[1] / "docs" / "formats.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| ([^|]+?) \| `(rovgraph [^`]+)` \| ([^|]+?) \|$", TEXT, re.MULTILINE)


def log() -> rg.Log:
    return rg.Log.from_frame(short_dive(0.0))


def blueos() -> bytes:
    later = short_dive(0.0).assign(time=lambda frame: frame["time"] + 10.0)
    return mcap((START + t, *as_json(message)) for t, message in autopilot_messages(later, 0.0, 101_325.0))


def nucleus() -> bytes:
    one = (
        nucleus_record(0x82, START + 0.01 * k, [0.1, 0.2, -9.8, 0.01, 0.02, 0.03, 20.0])
        + (nucleus_track(START + 0.01 * k, (0.5, 0.0, 0.0)) + nucleus_ahrs(START + 0.01 * k, (0.0, 0.0, 0.1), 2.0))
        for k in range(50)
    )
    return b"".join(one)


MADE: dict[str, Callable[[], bytes]] = {
    "blueos.mcap": blueos,
    "dvl.jsonl": lambda: b"".join(report(time_of_validity=round(1e6 * (START + 0.2 * k))) for k in range(50)),
    "dvl.pd4": lambda: b"".join(pd4_frame(float(k)) for k in range(9)),
    "dvl.pd5": lambda: b"".join(pd4_frame(float(k), rpy=(0.0, 0.1, 0.2)) for k in range(9)),
    "dvl.pd6": lambda: b"".join(pd6_ping(START + k) for k in range(9)),
    "tracker.nmea": lambda: b"".join(
        b"$DVPDL,%d,100000,0,0,0,0.05,0.001,-0.002,95\n" % (k * 100_000) for k in range(9)
    ),
    "dvl.ad2cp": lambda: b"".join(dvl_record(START + k, (0.5, 0.0, 0.0)) for k in range(9)),
    "nucleus.bin": nucleus,
    "ship.nmea": lambda: rmc("120000.00", "020324") + b"".join(gga(f"1200{k:02d}.00", 0.001 * k) for k in range(9)),
    "track.gpx": gpx,
    "Data.lsf": imc_recording,
    "unit.stdbin": stdbin_recording,
    "ugps.csv": lambda: UGPS,
    "mtmanager.txt": xsens_export,
    "xsens.mtb": xsens_recording,
    "microstrain.csv": lambda: microstrain_export(log()),
    "table.csv": lambda: (
        mavlink_table(short_dive(0.0).rename(columns={"ahrs_yaw": "dvl_heading"}))[0].to_csv(index=False).encode()
    ),
    "vectornav.csv": lambda: vectornav_csv(log()),
    "vn100.txt": lambda: vectornav_sentences(log()),
}
ANYONES = "CSV of anyone"
BAGS = {"ros1.bag": "ros1", "ros2_sqlite": "sqlite", "ros2_mcap": "mcap"}


@pytest.mark.parametrize(("title", "line", "tried"), ROWS, ids=[line.split()[2] for _, line, _ in ROWS])
@pytest.mark.filterwarnings("ignore::rovgraph.errors.DataWarning")
def test_a_command_of_the_table_runs(title, line, tried, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    _, *arguments = shlex.split(line)
    name = arguments[1]
    if name in BAGS:
        bags.write(Path(name), BAGS[name], bags.of_dive(short_dive(0.0)))
    elif name in MADE:
        Path(name).write_bytes(MADE[name]())
    elif name in REAL:
        shutil.copy(REAL[name], name)
    else:
        assert tried.startswith("a real"), f"nothing makes {name}"
        pytest.skip(f"{name} does not lie beside the checkout")
    assert command(monkeypatch, *arguments) == 0
    if title == ANYONES:
        config = rg.load_config(arguments[arguments.index("--config-out") + 1])
        assert {"imu", "dvl", "depth"} <= rg.read_log(name, config).streams.keys()
        return
    out = Path(arguments[arguments.index("--out") + 1])
    made = rg.read_log(out)
    assert all(len(stream) and np.isfinite(stream.time).all() for stream in made.streams.values())
    (file,) = json.loads(out.with_suffix(".report.json").read_text(encoding="utf-8"))["files"]
    assert file["format"] == by_title(title)


def by_title(title: str) -> str:
    return {each.title: each.name for each in formats()}[title]


def test_the_table_has_every_format():
    assert {by_title(title) for title, _, _ in ROWS if title != ANYONES} == {each.name for each in formats()}
