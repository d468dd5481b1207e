"""``rovgraph online``: replays, live sources, crashes, bad input, readers that are gone, disks that are full."""

import errno
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from dives import Simulated, falcon, simulated, true_at
from live import counted, message, row, vehicle
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from wire import packed, report

from rovgraph.cli.app import main
from rovgraph.errors import InputError
from rovgraph.inference.trajectory import Trajectory
from rovgraph.live.clocks import Clocks
from rovgraph.live.files import Files
from rovgraph.live.navigator import Navigator
from rovgraph.live.session import Session
from rovgraph.live.warnings import Warnings
from rovgraph.log import Measurement, read_log
from rovgraph.simulate.files import write_dive

ONLINE = [sys.executable, "-c", "from rovgraph.cli.app import main; main()", "online"]
START_S = 60.0  # longest wait for the program, on a busy machine
HONEST_SD = 4.0


@pytest.fixture(scope="module")
def case() -> Simulated:
    return simulated(falcon(), 40.0, seed=1, dvl_rate=4.0)


@pytest.fixture(scope="module")
def dive(case, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("dive")
    write_dive(folder, case.dive, case.config, {})
    return folder


@pytest.fixture(scope="module")
def lines(case) -> list[tuple[float, bytes]]:
    return [(m.time, row(m)) for m in case.log.measurements()]


@contextmanager
def running(*arguments: object, **options: object) -> Iterator[subprocess.Popen[bytes]]:
    """The command in a process of its own, which does not outlive the test."""
    command = [*ONLINE, *map(str, arguments)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, **({"stdout": subprocess.DEVNULL} | options))
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def until(true: Callable[[], bool], within: float = START_S) -> None:
    end = time.monotonic() + within
    while not true():
        assert time.monotonic() < end, "it did not come to that"
        time.sleep(0.02)


def summary(out: Path) -> dict:
    return json.loads((out / "summary.json").read_text())


def refused(capsys, *arguments: object) -> str:
    """The one line with which the command refuses its arguments, exit code 2."""
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as stop:
        patch.setattr(sys, "argv", ["rovgraph", *map(str, arguments)])
        main()
    assert stop.value.code == 2
    (line,) = (x for x in capsys.readouterr().err.splitlines() if not x.startswith("warning: "))
    return line


def honest(solutions: pd.DataFrame, case: Simulated) -> None:
    """Positions within `HONEST_SD` of the truth."""
    p = true_at(case, solutions["time"].to_numpy()).p_n
    for k, name in enumerate(("north", "east")):
        error = np.abs(solutions[name].to_numpy() - p[:, k])
        assert (error < HONEST_SD * solutions[f"{name}_sd"].to_numpy()).all()


def test_a_replay_leaves_a_track_that_is_scored_and_a_recording_that_is_smoothed(dive, case, tmp_path, monkeypatch):
    out = tmp_path / "out"
    options = ["--config", dive / "config.yaml", "--speed", "max", "--rate", "2", "--out", out]
    done = subprocess.run([*ONLINE, f"file:{dive / 'log.csv'}", *map(str, options)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    solutions = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(solutions) == summary(out)["solutions"]
    assert summary(out)["state"] == "finished"
    assert "start: assumed: heading from mag" in done.stderr
    honest(pd.DataFrame(solutions), case)
    monkeypatch.setattr(
        sys, "argv", ["rovgraph", "evaluate", str(out / "trajectory_filtered.csv"), str(dive / "truth.csv")]
    )
    with pytest.raises(SystemExit) as stop:
        main()
    assert not stop.value.code
    smoothed = pd.read_csv(out / "smoothed" / "trajectory_smoothed.csv")
    assert smoothed["time"].iloc[-1] == pytest.approx(case.log["imu"].time[-1], abs=1e-3)
    assert events_of(out, "assumed") > 0


def received(out: Path, text: bytes) -> bool:
    recording = out / "received.csv"
    return recording.exists() and text in recording.read_bytes()


def events_of(out: Path, kind: str) -> int:
    return sum(json.loads(line)["kind"] == kind for line in (out / "events.jsonl").read_text().splitlines())


@pytest.mark.slow
def test_killed_twice_and_resumed_it_goes_on_where_it_was(tmp_path):
    case = simulated(falcon(), 35.0, seed=2, dvl_rate=4.0)
    lines = [(m.time, row(m)) for m in case.log.measurements()]
    out, speed, solutions = tmp_path / "out", 4.0, b""
    config = tmp_path / "config.yaml"
    config.write_text(case.config.to_yaml())
    with vehicle(lines, speed, unheard_s=4.0) as server:  # while a process starts
        for run, seconds in enumerate((3.0, 8.0, np.inf)):  # the first before there is a keyframe
            given = ["--config", config] if run == 0 else ["--resume"]
            with running(
                server.url, *given, "--rate", 5, "--no-refine", "--out", out, stdout=subprocess.PIPE
            ) as process:
                reader = Reader(process)
                if seconds < np.inf:
                    until(lambda run=run, seconds=seconds: server.clients > run and server.told > seconds)
                    process.send_signal(signal.SIGKILL)
                    process.wait()
                    received = pd.read_csv(out / "received.csv")["time"]
                    assert received.iloc[-1] > server.sent - 1.0 * speed
                else:
                    until(lambda run=run: server.clients > run and server.done.is_set())
                    process.send_signal(signal.SIGINT)
                    assert process.wait(START_S) == 0
                solutions += reader.all()
    text = (out / "received.csv").read_text()
    assert text.endswith("\n")
    assert {line.count(",") for line in text.splitlines()} == {text.splitlines()[0].count(",")}
    imu = pd.read_csv(out / "received.csv").dropna(subset="gyr_x")["time"].to_numpy()
    assert (np.diff(imu) > 0.0).all()
    track = pd.read_csv(out / "trajectory_filtered.csv")
    assert (np.diff(track["time"]) > 0.0).all()
    assert np.diff(track["time"]).max() < 1.26, "a keyframe is missing"  # graph.max_gap_s and what a ping may be late
    honest(track, case)
    honest(pd.DataFrame([json.loads(line) for line in solutions.splitlines() if line.endswith(b"}")]), case)
    assert events_of(out, "resumed") >= 1
    assert summary(out)["state"] == "finished"


class Reader:
    """Reads all that a process says, while it runs."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._said: list[bytes] = []
        self._thread = threading.Thread(target=lambda: self._said.append(process.stdout.read()), daemon=True)
        self._thread.start()

    def all(self) -> bytes:
        self._thread.join(START_S)
        return b"".join(self._said)


@pytest.mark.slow
def test_a_dvl_an_imu_and_an_autopilot_with_clocks_of_their_own(case, tmp_path):
    pings, samples, autopilot = [], [], []
    for m in case.log.measurements():
        if m.sensor == "dvl":
            vx, vy, vz = m[2][:3].tolist()
            at = int(1e6 * (1.7e9 + m.time))
            pings.append((m.time, report(vx=vx, vy=vy, vz=vz, covariance=..., fom=0.004, time_of_validity=at)))
        elif m.sensor == "imu":
            samples.append((m.time, row(m)))
        elif m.sensor == "depth":
            hpa = 1013.25 + 1025.0 * 9.81 * m[2][0] / 100.0
            boot = int(1e3 * m.time) + 60_000
            yaw = float(true_at(case, np.array([m.time])).rpy[0, 2])
            autopilot.append((m.time, packed(mavlink.MAVLink_scaled_pressure2_message(boot, hpa, 0.0, 1000))))
            autopilot.append((m.time, packed(mavlink.MAVLink_attitude_message(boot, 0.0, 0.0, yaw, 0.0, 0.0, 0.0))))
    config = tmp_path / "config.yaml"
    config.write_text(case.config.model_copy(update={"heading": type(case.config.heading)()}).to_yaml())
    with vehicle(samples, 2.0) as imu, vehicle(pings, 2.0) as dvl, vehicle(autopilot, 2.0) as mav:
        sources = [imu.url, dvl.url.replace("tcp", "waterlinked"), mav.url.replace("tcp:", "mavlink:tcp:")]
        sources[2] = sources[2].replace("//", "")
        with running(*sources, "-c", config, "--output", "-", "--rate", 2, stdout=subprocess.PIPE) as process:
            solutions = []
            for line in process.stdout:
                solutions.append(json.loads(line))
                if solutions[-1]["time"] > solutions[0]["time"] + 10.0:  # by whichever clock spoke first
                    break
            process.send_signal(signal.SIGTERM)
            process.stdout.read()
            assert process.wait(START_S) == 0
            said = process.stderr.read().decode()
    used = {name: health["used"] for name, health in solutions[-1]["sensors"].items()}
    assert min(used[sensor] for sensor in ("dvl", "ahrs", "depth")) > 5, (used, said)
    assert said.count("clock: its clock differs") == 2
    assert solutions[-1]["latency_s"] is not None


@pytest.mark.slow
def test_bad_input_is_counted_and_said_once_and_the_estimate_goes_on(lines, case, tmp_path):
    out, config = tmp_path / "out", tmp_path / "config.yaml"
    config.write_text(case.config.to_yaml())
    bad = [b"no json\n", b"\xff\xfe\x00\x81\n", b'{"time": 1, "depth": NaN}\n', b'{"depth": "deep"}\n', b"[1]\n"]
    bad += [b'{"time": 3e9, "depth": 1.0}\n', b'{"time": -1e9, "depth": 1.0}\n']
    spoiled = [(t, line + (bad[k // 50 % len(bad)] if k % 50 == 0 else b"")) for k, (t, line) in enumerate(lines)]
    closed = socket.create_server(("127.0.0.1", 0))
    nobody = f"tcp://127.0.0.1:{closed.getsockname()[1]}"
    closed.close()
    with vehicle(spoiled, 4.0, hang_up=20.0) as server:
        options = ["-c", config, "--no-refine", "--rate", 20, "--output", "-", "--out", out]
        with running(server.url, nobody, "tcp://no.such.host.invalid:5", *options, stdout=subprocess.PIPE) as process:
            until(lambda: received(out, b"\n39.9"))  # and nobody reads what it says
            process.send_signal(signal.SIGTERM)
            _, said = process.communicate(timeout=START_S)
            assert process.returncode == 0
    counts = counted(summary(out), "warnings")
    for kind in ("not JSON", "not UTF-8", "NaN or Infinity", "string", "no object", "stamp", "unreachable"):
        assert counts[kind] > 1
        assert said.decode().count(f": {kind}: ") <= 2, "one for each source"
    assert counts["disconnected"] == 1
    assert server.clients == 2
    assert counts["slow reader"] >= 1
    assert b"Traceback" not in said
    honest(pd.read_csv(out / "trajectory_filtered.csv"), case)
    assert summary(out)["time"] > 38.0


@pytest.mark.slow
def test_a_reader_that_goes_away_does_not_end_the_estimate(dive, tmp_path):
    out = tmp_path / "out"
    options = ["-c", dive / "config.yaml", "--speed", "max", "--no-refine", "--out", out]
    with running(f"file:{dive / 'log.csv'}", *options, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        process.stdout.close()
        said = process.stderr.read().decode()
        assert process.wait(START_S) == 0
    assert said.count("standard output cannot be written") == 1
    assert "Traceback" not in said
    assert summary(out)["time"] == pytest.approx(40.0, abs=0.1)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["tpc://h:1"], "did you mean tcp://host:port?"),
        (["file:nowhere.csv"], "nowhere.csv"),
        (["-", "-"], "given twice"),
        (["-", "--resume"], "--out"),
        (["-", "--speed", "fast"], "expected a number above 0, or max"),
        (["-", "--output", "pigeon"], "known are"),
        (["-", "--config", "nowhere.yaml"], "nowhere.yaml"),
        (["-", "--resume", "--out", "nowhere"], "nothing to resume"),
    ],
)
def test_what_can_never_work_is_refused_in_one_line(capsys, arguments, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert expected in refused(capsys, "online", *arguments)


def test_a_port_in_use_is_refused_at_the_start(capsys):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        assert "cannot listen" in refused(capsys, "online", f"udp://:{taken.getsockname()[1]}")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert "cannot listen" in refused(capsys, "online", "-", "--output", f"tcp://:{taken.getsockname()[1]}")


def test_folders_that_hold_something_else_are_not_replaced(capsys, dive, tmp_path):
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.tex").write_text("years of work")
    log = f"file:{dive / 'log.csv'}"
    assert "exists" in refused(capsys, "online", log, "--out", foreign)
    assert "not a results folder" in refused(capsys, "online", log, "--out", foreign, "--force")
    assert "nothing to resume" in refused(capsys, "online", log, "--speed", "max", "--out", foreign, "--resume")
    assert "would be replaced" in refused(capsys, "online", log, "--out", dive, "--force")
    assert [p.name for p in foreign.iterdir()] == ["thesis.tex"]


def test_a_run_without_an_imu_says_what_is_missing(capsys, tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("time,depth\n0,1\n1,1\n")
    refusal = refused(capsys, "online", f"file:{log}", "--speed", "max", "--out", tmp_path / "out")
    assert "no estimate was made: online needs an IMU" in refusal and f"file:{log}: depth" in refusal


class Full:
    """A disk that is full from one time of the dive to another."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, navigator: Navigator, begin: float, end: float) -> None:
        self._write, self._csv, self._navigator, self._span = os.write, Trajectory.write_csv, navigator, (begin, end)
        self.refused = 0
        monkeypatch.setattr("rovgraph.live.files.os.write", self.write)
        monkeypatch.setattr(Trajectory, "write_csv", lambda t, path, more=False, *_: self.csv(t, path, more))

    def _check(self) -> None:
        if self._span[0] < self._navigator.time < self._span[1]:
            self.refused += 1
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def write(self, file: int, data: bytes) -> int:
        self._check()
        return self._write(file, data)

    def csv(self, trajectory: Trajectory, path: Path, more: bool) -> None:
        if self._span[0] < self._navigator.time < self._span[1]:
            with path.open("a") as file:
                file.write("12.3,torn")
        self._check()
        self._csv(trajectory, path, more)


@pytest.mark.slow
def test_a_disk_that_is_full_for_a_while_costs_nothing(case, tmp_path, monkeypatch):
    monkeypatch.setattr("rovgraph.live.files.KEEP_S", 0.0)
    said: list[str] = []
    warnings = Warnings(lambda source, kind, text: said.append(text))
    nav = Navigator(case.config, reinitialise=False, clocks=Clocks(trust=True))
    files = Files(tmp_path, case.config, warnings)
    full = Full(monkeypatch, nav, 15.0, 25.0)
    Session(nav, [], warnings, 2.0, files).run(message(m) for m in case.log.measurements())
    files.close()
    assert full.refused > 1
    assert any("No space left" in text for text in said)
    assert files.recorder.lost == 0
    assert len(read_log(tmp_path / "received.csv")["imu"].time) == len(case.log["imu"].time)
    track = pd.read_csv(tmp_path / "trajectory_filtered.csv")
    assert (np.diff(track["time"]) > 0.0).all()
    assert np.diff(track["time"]).max() < 1.1
    honest(track, case)


def test_a_checkpoint_that_is_damaged_is_said_in_one_line(case, tmp_path):
    files = Files(tmp_path, case.config, Warnings())
    files.close()
    (tmp_path / "checkpoint").write_bytes(b"rovgraph checkpoint 10 0000\nx")
    with pytest.raises(InputError, match="damaged"):
        Files(tmp_path, case.config, Warnings(), resume=True)


def recorded(folder: Path, case: Simulated, until: float) -> None:
    """A run that was ended at some time."""
    warnings = Warnings()
    nav = Navigator(case.config, reinitialise=False, clocks=Clocks(trust=True))
    folder.mkdir(exist_ok=True)
    files = Files(folder, case.config, warnings)
    Session(nav, [], warnings, 2.0, files).run(message(m) for m in case.log.measurements() if m.time < until)
    files.close()


def test_a_recording_that_cannot_be_read_is_said_and_the_track_before_stands(case, tmp_path):
    recorded(tmp_path, case, 20.0)
    track = (tmp_path / "trajectory_filtered.csv").read_bytes()
    recording = (tmp_path / "received.csv").read_bytes().split(b"\n")
    recording[500] = b"\0" * 80
    (tmp_path / "received.csv").write_bytes(b"\n".join(recording))
    with pytest.raises(InputError, match="line 501 holds binary data"):
        Files(tmp_path, case.config, Warnings(), resume=True)
    assert (tmp_path / "trajectory_filtered.csv").read_bytes() == track


def test_resuming_what_received_nothing_begins_again_and_writes_what_is_json(case, tmp_path):
    recorded(tmp_path, case, 0.0)
    nav = Navigator(case.config, reinitialise=False, clocks=Clocks(trust=True))
    files = Files(tmp_path, case.config, Warnings(), resume=True)
    session = Session(nav, [], Warnings(), 2.0, files)
    session.resume()
    session.run(message(m) for m in case.log.measurements() if m.time < 20.0)
    files.close()
    first = json.loads((tmp_path / "events.jsonl").read_text().splitlines()[0], parse_constant=lambda name: 1 / 0)
    assert first["time"] is None and "starts again" in first["text"]


@pytest.mark.parametrize("replayed_s", [0.0, 1e3])
def test_events_that_were_written_before_a_crash_are_not_written_again(case, tmp_path, monkeypatch, replayed_s):
    """From the checkpoint, whose last seconds are read again, and from a short recording that all is."""
    monkeypatch.setattr("rovgraph.live.files.REPLAYED_S", replayed_s)
    monkeypatch.setattr("rovgraph.live.files.KEEP_S", 0.0)
    begin = case.log.start
    log = [m for m in case.log.measurements() if m.sensor != "dvl" or not 27.0 < m.time - begin < 31.0]
    without_break = replace(case, log=SimpleNamespace(measurements=lambda: log))
    recorded(tmp_path / "whole", without_break, begin + 40.0)
    recorded(tmp_path / "torn", without_break, begin + 35.0)
    events = tmp_path / "torn" / "events.jsonl"
    with events.open("a") as file:
        file.write('{"time": 34.9, "sour')
    nav = Navigator(case.config, reinitialise=False, clocks=Clocks(trust=True))
    files = Files(tmp_path / "torn", case.config, Warnings(), resume=True)
    session = Session(nav, [], Warnings(), 2.0, files)
    session.resume()
    session.run(message(m) for m in log if begin + 35.0 <= m.time < begin + 40.0)
    files.close()
    whole, torn = (
        [json.loads(line) for line in (tmp_path / name / "events.jsonl").read_text().splitlines()]
        for name in ("whole", "torn")
    )
    assert {"silent", "back"} <= {event["kind"] for event in whole}
    assert [event for event in torn if event["kind"] != "resumed"] == whole


def test_a_summary_that_cannot_be_written_is_one_line_and_leaves_no_rest(capsys, dive, tmp_path, monkeypatch):
    def full(self, *args, **kwargs):
        if self.name == ".summary.json.partial":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write_text(self, *args, **kwargs)

    write_text = Path.write_text
    monkeypatch.setattr(Path, "write_text", full)
    line = refused(capsys, "online", f"file:{dive / 'log.csv'}", "--speed", "max", "--out", tmp_path / "out")
    assert "summary.json: cannot be written (No space left on device)" in line
    assert not list(tmp_path.rglob("*.partial"))


@pytest.mark.parametrize("replayed_s", [0.0, 1e3])
def test_the_surface_is_kept_over_a_resumption_under_water(case, tmp_path, monkeypatch, replayed_s):
    """From the checkpoint, and from a short recording that is read again."""
    monkeypatch.setattr("rovgraph.live.files.REPLAYED_S", replayed_s)
    monkeypatch.setattr("rovgraph.live.files.KEEP_S", 0.0)
    air, begin = 99_000.0, case.log.start

    def dived(m: Measurement) -> Measurement:
        if m.sensor != "depth":
            return m
        pascal = air + 1025.0 * 9.81 * np.clip(0.2 * (m.time - begin - 10.0), 0.0, 2.0)
        return m._replace(sensor="pressure", values=np.array([pascal]))

    log = [dived(m) for m in case.log.measurements()]
    recorded(tmp_path, replace(case, log=SimpleNamespace(measurements=lambda: log)), begin + 30.0)
    nav = Navigator(case.config, reinitialise=False, clocks=Clocks(trust=True))
    files = Files(tmp_path, case.config, Warnings(), resume=True)
    session = Session(nav, [], Warnings(), 2.0, files)
    session.resume()
    session.run(message(m) for m in log if begin + 30.0 <= m.time < begin + 35.0)
    files.close()
    assert files.replayed == (replayed_s > 0.0)
    assert nav._intake.pressure.surface.value == pytest.approx(air)
