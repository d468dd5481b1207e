"""The paths of new users: every command of their pages, on files as their instruments write them, reaches a track.

The files are made from a simulated dive, whose truth the track's end is compared with.
"""

import json
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest
from autopilot_files import dataflash_of
from bags import START, of_dive, transform
from bags import write as write_bag
from doppler_files import INSTRUMENT, pd0_ensemble, trdi_values
from test_docs import DOCS, PATHS, ROOT, command_on, commands, needs_an_instrument, run
from wire import report

import rovgraph as rg

UNIX = 1_764_000_000.0  # of the simulated dives' time 0, where a clock knows it
ORIGIN = (58.3, 11.4)
METRES_PER_DEGREE = (111_376.0, 58_650.0)  # of latitude and longitude there, on the WGS 84 ellipsoid
TRACK = "results/dive1/trajectory_smoothed.csv"
ELLIPSIS = "…"  # a line of a page that stands for what it leaves out
CLOCKS = "## When the clocks do not join\n"


# the files


def simulate(folder: Path, scenario: str, duration: float, config: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Log and true track of a dive; ``truth.csv`` is written into the folder."""
    dive = rg.simulate(scenario, rg.parse_config(config), seed=3, choices=rg.Choices(duration=duration))
    dive.save(folder / "simulated")
    shutil.copy(folder / "simulated" / "truth.csv", folder)
    return pd.read_csv(folder / "simulated" / "log.csv"), pd.read_csv(folder / "truth.csv")


def some(frame: pd.DataFrame, *names: str) -> pd.DataFrame:
    """The rows that fill these columns."""
    return frame[["time", *names]].dropna()


def bluerov2(folder: Path, scenario: str = "lawnmower", duration: float = 400.0) -> float:
    """The autopilot's log on its boot time, and the DVL's on Unix time; returns the time 0 of the log's clock."""
    text = (ROOT / "configs" / "bluerov2.yaml").read_text(encoding="utf-8")
    (folder / "bluerov2.yaml").write_text(text, encoding="utf-8")
    sea = "environment: {declination_deg: 5.0, field_norm: 50.0, dip_deg: 70.0}\n"
    log, _ = simulate(folder, scenario, duration, sea + text)
    autopilot = log[[name for name in log.columns if not name.startswith("dvl_")]]
    (folder / "dive.BIN").write_bytes(dataflash_of(autopilot, np.deg2rad(5.0), 101_800.0))
    pings = some(log, "dvl_vx", "dvl_vy", "dvl_vz").itertuples(index=False)
    times = [(time, round(1e6 * (UNIX + time)), velocity) for time, *velocity in pings]
    (folder / "a50.jsonl").write_bytes(
        b"".join(
            report(
                **{"time": ..., "covariance": [], "fom": 0.01, "altitude": 2.0, "time_of_validity": stamp},
                **{"time_of_transmission": stamp + 120_000, **dict(zip(("vx", "vy", "vz"), velocity, strict=True))},
            )
            for _, stamp, velocity in times
        )
    )
    return 0.0


def fixes(truth: pd.DataFrame, every: float, sd: float) -> pd.DataFrame:
    """Positions of a receiver or a transponder, with noise."""
    times = np.arange(truth["time"].iloc[0], truth["time"].iloc[-1], every)
    noise = np.random.default_rng(1).normal(scale=sd, size=(2, len(times)))
    north, east = (np.interp(times, truth["time"], truth[name]) for name in ("north", "east"))
    lat = ORIGIN[0] + (north + noise[0]) / METRES_PER_DEGREE[0]
    lon = ORIGIN[1] + (east + noise[1]) / METRES_PER_DEGREE[1]
    return pd.DataFrame({"time": times, "lat": lat, "lon": lon})


def dates(times: pd.Series) -> pd.Series:
    return pd.to_datetime(UNIX + times, unit="s").dt.strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def inertial_table(log: pd.DataFrame, truth: pd.DataFrame) -> pd.DataFrame:
    """An INS's samples in its own names and units; its heading is true, with a constant error and noise."""
    imu = some(log, *(f"{kind}_{axis}" for kind in ("acc", "gyr") for axis in "xyz"))
    table = pd.DataFrame({"UTC": dates(imu["time"])})
    for axis in "xyz":
        table[f"Acc {axis.upper()} [g]"] = (imu[f"acc_{axis}"] / 9.80665).round(6).to_numpy()
    for axis in "xyz":
        table[f"Gyro {axis.upper()} [deg/s]"] = np.rad2deg(imu[f"gyr_{axis}"]).round(5).to_numpy()
    heading = np.rad2deg(np.interp(imu["time"], truth["time"], np.unwrap(truth["yaw"]))) + 0.1
    heading += np.random.default_rng(2).normal(scale=0.1, size=len(heading))
    table["Heading [deg]"] = (heading % 360.0).round(3)
    return table


def survey(folder: Path) -> float:
    """Three tables in names and units of their own, with Unix time."""
    text = f"""
environment: {{origin_lat_deg: {ORIGIN[0]}, origin_lon_deg: {ORIGIN[1]}, declination_deg: 0}}
imu: {{preset: xsens-mti-300}}
dvl: {{preset: teledyne-workhorse-navigator, lever_arm_m: [0.3, 0.0, 0.2]}}
heading: {{sources: [ahrs], ahrs_sd_deg: 0.5}}
calibration: {{ahrs_offset: {{sd_deg: 1}}, ahrs_deviation: {{sd_deg: 0.5}}, dvl_yaw: {{estimate: true, sd_deg: 2}}}}
"""
    log, truth = simulate(folder, "lawnmower", 240.0, text)
    inertial_table(log, truth).to_csv(folder / "ins.csv", index=False)
    pings, depth = some(log, "dvl_vx", "dvl_vy", "dvl_vz"), some(log, "depth")
    table = pd.DataFrame({"UTC": dates(pings["time"])})
    for axis, name in zip("xyz", ("forward", "starboard", "down"), strict=True):
        table[f"velocity {name} [mm/s]"] = (1e3 * pings[f"dvl_v{axis}"]).round(1)
    table["depth [m]"] = np.interp(pings["time"], depth["time"], depth["depth"]).round(3)
    table.to_csv(folder / "dvl.csv", index=False)
    usbl = fixes(truth, every=2.0, sd=1.0)
    table = pd.DataFrame({"UTC": dates(usbl["time"]), "Latitude": usbl["lat"], "Longitude": usbl["lon"]})
    table.to_csv(folder / "usbl.csv", index=False, float_format="%.8f")
    return UNIX


def auv(folder: Path) -> float:
    """A PD0 file and a FOG's table, whose receiver has fixes before the dive and after it."""
    text = f"""
environment: {{origin_lat_deg: {ORIGIN[0]}, origin_lon_deg: {ORIGIN[1]}, declination_deg: 0}}
imu: {{preset: kvh-1750, gyr_bias_sd_dps: 0.001}}
dvl: {{preset: teledyne-workhorse-navigator, lever_arm_m: [0.5, 0.0, 0.1]}}
heading: {{sources: [ahrs], ahrs_sd_deg: 0.2}}
calibration: {{ahrs_offset: {{sd_deg: 0.5}}, ahrs_deviation: {{sd_deg: 0.2}}, dvl_yaw: {{estimate: true, sd_deg: 2}}}}
"""
    log, truth = simulate(folder, "lawnmower", 240.0, text)
    table = inertial_table(log, truth)
    gps = fixes(truth, every=1.0, sd=1.0)
    gps = gps[(gps["time"] < 20.0) | (gps["time"] > 220.0)]
    gps = pd.DataFrame({"UTC": dates(gps["time"]), "GPS Latitude": gps["lat"], "GPS Longitude": gps["lon"]})
    table = table.merge(gps, on="UTC", how="left")
    table.to_csv(folder / "fog.csv", index=False, float_format="%.8f")
    depth = some(log, "depth")
    (folder / "dvl.pd0").write_bytes(
        b"".join(
            pd0_ensemble(
                UNIX + time,
                -trdi_values(velocity, INSTRUMENT, (0.0, 0.0, 0.0)),
                INSTRUMENT,
                (0.0, 0.0, 0.0),
                float(np.interp(time, depth["time"], depth["depth"])),
                source=1,
            )
            for time, *velocity in some(log, "dvl_vx", "dvl_vy", "dvl_vz").itertuples(index=False)
        )
    )
    return UNIX


def ros_bag(folder: Path) -> float:
    """A bag of ROS 2 whose /tf_static has the mountings."""
    text = "environment: {field_norm: 50.0, dip_deg: 70.0}\ndvl: {lever_arm_m: [0.2, 0.0, 0.1]}\n"
    log, truth = simulate(folder, "lawnmower", 240.0, text)
    down = (1.0, 0.0, 0.0, 0.0)  # of axes forward, starboard, down in base_link, whose z is up
    mountings = [transform("base_link", "imu_link", down), transform("base_link", "dvl_link", down, (0.2, 0.0, -0.1))]
    write_bag(folder / "dive", "mcap", [*mountings, *of_dive(log)])
    truth.assign(time=truth["time"] + START).to_csv(folder / "truth.csv", index=False, float_format="%.4f")
    return START


# the pages


class Step(NamedTuple):
    """A command and the lines that the page quotes of what it prints, or lines of a file."""

    kind: str  # "command", "yaml" or "text"
    text: str


def steps(page: str) -> Iterator[Step]:
    """Commands and fenced blocks of a page, or of a part of it, in order."""
    kind, block = "", list[str]()
    for line in page.splitlines():
        if fence := re.match(r"```(\w*)", line):
            if kind:
                yield Step(kind, "\n".join(block))
            kind, block = fence[1] if not kind else "", []
        elif kind:
            block.append(line)
        elif command := command_on(line):
            yield Step("command", command)


def refuse_unless_printed(quoted: str, printed: str) -> None:
    """Each quoted line is among the printed ones, in their order; numbers may differ by a fifth, or by 0.5."""
    lines = iter(printed.splitlines())
    for quote in filter(lambda line: line.strip() not in ("", ELLIPSIS), quoted.splitlines()):
        words, numbers = alike(quote)
        for line in lines:
            if alike(line)[0] == words and np.allclose(alike(line)[1], numbers, rtol=0.2, atol=0.5):
                break
        else:
            raise AssertionError(f"not printed: {quote}\n{printed}")


def alike(line: str) -> tuple[list[str], list[float]]:
    """The words of a line with a 0 for each number, and the numbers."""
    number = r"(?<![\w.])[+-]?\d+(?:\.\d+)?(?:e[+-]\d+)?"
    return re.sub(number, "0", line).split(), [float(found) for found in re.findall(number, line)]


def follow(page: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Do what a page, or a part of it, says, in the current folder; returns the commands that were run.

    A block of YAML is added to the file that its first line names. A text block that begins with an error belongs to
    a command that refuses.
    """
    done, todo = list[str](), list(steps(page))
    printed = ""
    for step, after in zip(todo, [*todo[1:], Step("", "")], strict=True):
        if step.kind == "command" and not needs_an_instrument(step.text):
            code = run(step.text, monkeypatch)
            output = capsys.readouterr()
            printed = output.err + output.out
            refused = after.kind == "text" and after.text.startswith("error:")
            assert code == (2 if refused else 0), f"{step.text}\n{printed}"
            done.append(step.text)
        elif step.kind == "yaml":
            with Path(step.text.splitlines()[0].removeprefix("# ")).open("a", encoding="utf-8") as file:
                file.write(f"{step.text}\n")
        elif step.kind == "text":
            refuse_unless_printed(step.text, printed)
    return done


def refuse_unless_near(truth: Path, begin: float) -> None:
    """The track's end is within 4 sd, or a metre, of the true one; ``begin`` is the log's time of the truth's 0."""
    end, true = pd.read_csv(TRACK).iloc[-1], pd.read_csv(truth)
    assert end["time"] - begin == pytest.approx(true["time"].iloc[-1], abs=1.0)
    off = [end[name] - np.interp(end["time"] - begin, true["time"], true[name]) for name in ("north", "east")]
    assert np.hypot(*off) < max(1.0, 4.0 * np.hypot(end["north_sd"], end["east_sd"]))


MAKERS: dict[str, Callable[[Path], float]] = {"bluerov2": bluerov2, "survey": survey, "auv": auv, "bag": ros_bag}


def part(name: str, where: str = "") -> str:
    """The path of a page, or its part on clocks that do not join."""
    path, _, rest = (DOCS / f"{name}.md").read_text(encoding="utf-8").partition(CLOCKS)
    return rest if where else path


@pytest.mark.slow
@pytest.mark.parametrize("name", PATHS)
def test_a_path_leads_from_files_to_a_track_on_a_map(name, tmp_path, monkeypatch, capsys):
    begin = MAKERS[name](tmp_path)
    monkeypatch.chdir(tmp_path)
    done = follow(part(name), monkeypatch, capsys)
    assert next(k for k, text in enumerate(done, start=1) if " export " in text) <= 6
    refuse_unless_near(tmp_path / "simulated" / "truth.csv", begin)
    summary = json.loads(Path("results/dive1/summary.json").read_text(encoding="utf-8"))
    assert summary["verdict"] == "trusted"
    assert "<kml" in Path("results/dive1/track_smoothed.kml").read_text(encoding="utf-8")
    assert Path("results/dive1/report.html").exists()


@pytest.mark.slow
def test_clocks_that_do_not_join_are_joined_by_the_remedy_of_the_page(tmp_path, monkeypatch, capsys):
    begin = bluerov2(tmp_path, "square", 300.0)
    monkeypatch.chdir(tmp_path)
    assert len(follow(part("bluerov2", CLOCKS), monkeypatch, capsys)) == 2
    refuse_unless_near(tmp_path / "truth.csv", begin)


def test_every_command_of_a_path_is_run_or_needs_an_instrument():
    for name in PATHS:
        page = DOCS / f"{name}.md"
        assert [step.text for step in steps(page.read_text("utf-8")) if step.kind == "command"] == [*commands(page)]
    left = [text for name in PATHS for text in commands(DOCS / f"{name}.md") if needs_an_instrument(text)]
    assert ["--http" in text for text in left] == [True]


def test_the_start_page_names_each_path():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"^- \[.+\]\(docs/([\w]+)\.md\): ", readme, re.M)[:4] == [*PATHS]


def test_a_quoted_line_that_is_not_printed_is_found():
    printed = "verdict: trusted\n end north  20.3 ± 1.8 m\nresults in a"
    refuse_unless_printed("verdict: trusted\n…\n end north 20.4 ± 1.9 m", printed)
    for wrong in ("verdict: wrong", " end north 30.3 ± 1.8 m", "results in a\nverdict: trusted"):
        with pytest.raises(AssertionError, match="not printed"):
            refuse_unless_printed(wrong, printed)
