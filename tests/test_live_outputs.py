"""Outputs: every form through a real socket or pipe, and readers that misbehave."""

import json
import math
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rovgraph.errors import InputError
from rovgraph.live.outputs import FORMS, open_output
from rovgraph.live.outputs.json_lines import StandardOutput, json_line
from rovgraph.live.outputs.mavlink import gps_input, vision_position_estimate
from rovgraph.live.outputs.nmea import gga, hdt
from rovgraph.live.outputs.output import parsed
from rovgraph.live.solution import Event, SensorHealth, Solution
from rovgraph.live.warnings import Warnings

pynmea2 = pytest.importorskip("pynmea2", reason="pynmea2 is not installed")
pytest.importorskip("pymavlink", reason="pymavlink is not installed")

NAN = math.nan
EVENT = Event(1.5, "dvl", "silent", "no ping for 2 s")
SOLUTION = Solution(
    time=1_700_000_000.123456,
    position=np.array([10.0, -20.0, 5.5]),
    velocity=np.array([0.4, -0.1, 0.02]),
    rpy=np.array([0.01, -0.02, -0.5]),
    position_sd=np.array([0.3, 0.4, 0.1]),
    velocity_sd=np.array([0.01, 0.02, 0.02]),
    rpy_sd=np.array([0.001, 0.002, 0.03]),
    cov_north_east=-0.05,
    latitude=58.123456789,
    longitude=-8.5,
    calibration={"dvl_yaw": (-0.375, 0.03)},
    sensors={"dvl": SensorHealth("ok", 0.12, 1000, 3)},
    events=(EVENT,),
    distance=123.4,
    predicted_s=0.05,
    latency_s=0.012,
    update_s=0.003,
)


@pytest.fixture
def said():
    return []


@pytest.fixture
def warnings(said):
    return Warnings(lambda *about: said.append(about))


def free_port(kind=socket.SOCK_STREAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def datagrams():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5.0)
        yield receiver


def at(k: int) -> Solution:
    return replace(SOLUTION, time=float(k))


# JSON lines


def strict(line: bytes) -> dict:
    def refuse(token):
        raise AssertionError(f"{token} is no JSON")

    return json.loads(line, parse_constant=refuse)


def test_a_json_line_reads_back_under_the_names_of_the_contract():
    read = strict(json_line(SOLUTION))
    names = ["north", "east", "down", "roll", "pitch", "yaw", "v_north", "v_east", "v_down"]
    more = "latitude longitude distance predicted_s latency_s update_s calibration sensors verdict alarms events"
    assert " ".join(read) == " ".join(["time", *names, *(n + "_sd" for n in names), "cov_north_east", more])
    assert read["time"] == SOLUTION.time
    assert [read[n] for n in ("north", "east", "down")] == [10.0, -20.0, 5.5]
    assert [read[n + "_sd"] for n in ("v_north", "v_east", "v_down")] == [0.01, 0.02, 0.02]
    assert (read["yaw"], read["yaw_sd"], read["cov_north_east"]) == (-0.5, 0.03, -0.05)
    assert (read["latitude"], read["longitude"]) == (58.123456789, -8.5)
    assert read["calibration"] == {"dvl_yaw": [-0.375, 0.03]}
    assert read["sensors"] == {"dvl": {"state": "ok", "age": 0.12, "used": 1000, "rejected": 3}}
    assert read["events"] == [{"time": 1.5, "source": "dvl", "kind": "silent", "text": "no ping for 2 s"}]


unknown = st.sampled_from([NAN, math.inf, -math.inf])
anything = st.floats(-1e6, 1e6) | unknown
vectors = st.lists(anything, min_size=3, max_size=3).map(np.array)
solutions = st.builds(
    Solution,
    time=st.floats(0, 4e9) | unknown,
    position=vectors,
    velocity=vectors,
    rpy=vectors,
    position_sd=vectors,
    velocity_sd=vectors,
    rpy_sd=vectors,
    cov_north_east=anything,
    latitude=st.none() | st.floats(-90, 90) | unknown,
    longitude=st.none() | st.floats(-180, 360) | unknown,
    calibration=st.dictionaries(st.text(), st.tuples(anything, anything), max_size=3),
    sensors=st.dictionaries(
        st.text(), st.builds(SensorHealth, st.text(), anything, st.integers(0), st.integers(0)), max_size=3
    ),
    events=st.lists(st.builds(Event, anything, st.text(), st.text(), st.text()), max_size=3).map(tuple),
    distance=anything,
    predicted_s=anything,
    latency_s=st.none() | anything,
    update_s=anything,
)


@settings(deadline=None, max_examples=60)
@given(solutions)
def test_any_solution_is_one_line_of_strict_json_with_null_for_what_is_not_finite(solution):
    line = json_line(solution)
    assert line.count(b"\n") == 1
    assert line.endswith(b"\n")
    read = strict(line)
    for name, value in zip(("roll", "pitch", "yaw"), solution.rpy, strict=True):
        assert read[name] == (pytest.approx(value, rel=1e-8, abs=0) if np.isfinite(value) else None)
    assert read["calibration"].keys() == solution.calibration.keys()
    assert [e["text"] for e in read["events"]] == [e.text for e in solution.events]


# opening


@pytest.mark.parametrize("url", ["ftp://host:1", "/dev/null", "udpp://h:1", "", "tcp"])
def test_an_unknown_form_is_refused_with_the_known_ones(url):
    with pytest.raises(InputError) as error:
        open_output(url)
    assert url == "tcp" or all(form in str(error.value) for form in FORMS.values())
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("url", "match"),
    [
        ("udp://localhost", "expected udp://host:port"),
        ("udp://:5000", "expected udp://host:port"),
        ("udp:localhost:5000", "expected udp://host:port"),
        ("tcp://:0", r"expected tcp://\[host\]:port"),
        ("tcp://:99999", "the port from 1 to 65535"),
        ("tcp://192.0.2.1:5000", "cannot listen at 192.0.2.1"),
        ("udp://no.such.host.invalid:5000", "no.such.host.invalid cannot be found"),
        ("udp://127.0.0.1:5000?rat=2", "unknown option 'rat'; known are rate"),
        ("udp://127.0.0.1:5000?rate=fast", "rate: expected a number"),
        ("udp://127.0.0.1:5000?rate=0", "rate: expected a number"),
        ("mavlink:udpout:127.0.0.1:5000?message=HEARTBEAT", "known are GPS_INPUT, VISION_POSITION_ESTIMATE"),
        ("mavlink:127.0.0.1:5000", "unknown connection '127.0.0.1:5000'"),
        ("mavlink:udpout:127.0.0.1:5000?system=300", "system: expected a number from 1 to 255"),
    ],
)
def test_what_cannot_work_is_refused_in_one_line(url, match):
    with pytest.raises(InputError, match=match) as error:
        open_output(url)
    assert "\n" not in str(error.value)


def test_a_port_in_use_is_refused():
    with socket.create_server(("127.0.0.1", 0)) as other, pytest.raises(InputError, match="cannot listen"):
        open_output(f"tcp://:{other.getsockname()[1]}")


def test_a_missing_library_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymavlink.mavutil", None)
    with pytest.raises(InputError, match=r"pip install 'rovgraph\[online\]'"):
        open_output("mavlink:udpout:127.0.0.1:5000")


def test_complaints_come_once_per_kind_and_period(said):
    now = [0.0]
    limited = Warnings(lambda *about: said.append(about), period=0.2, clock=lambda: now[0]).complain
    for _ in range(2):
        for _ in range(50):
            limited("a", "slow", "text")
            limited("a", "closed", "text")
        now[0] += 0.25
    assert sorted(kind for _, kind, _ in said) == ["closed"] * 2 + ["slow"] * 2


# standard output

PRINTS = """
import sys
import numpy as np
from rovgraph.live.warnings import Warnings
from rovgraph.live.outputs import open_output
from rovgraph.live.solution import Solution
v = np.zeros(3)
out = open_output("-", Warnings(lambda *about: print(*about, file=sys.stderr)), patient=sys.argv[2] == "patient")
for k in range(int(sys.argv[1])):
    out.send(Solution(float(k), v, v, v, v, v, v, 0.0))
out.close()
print("dropped", out.dropped, file=sys.stderr)
"""


def prints(count: int, how: str) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", PRINTS, str(count), how], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def dropped(stderr: bytes) -> int:
    name, count = stderr.decode().splitlines()[-1].split()
    assert name == "dropped"
    return int(count)


@pytest.mark.slow
def test_standard_output_has_every_line_where_its_reader_reads():
    child = prints(100, "live")
    out, err = child.communicate(timeout=30)
    assert [strict(line)["time"] for line in out.splitlines()] == list(range(100))
    assert dropped(err) == 0


@pytest.mark.slow
def test_a_reader_of_standard_output_that_does_not_read_holds_up_nothing():
    """Neither sending nor the end of the program: each would wait for ever."""
    child = prints(3000, "live")
    assert child.wait(timeout=60) == 0
    err = child.stderr.read()
    assert b"does not read" in err
    lines = child.stdout.read().splitlines()
    assert len(lines) - 1 <= 3000 - dropped(err) <= len(lines) + 1


@pytest.mark.slow
def test_a_patient_output_waits_for_its_reader_and_loses_nothing():
    child = prints(3000, "patient")
    time.sleep(1.0)
    out, err = child.communicate(timeout=30)
    assert [strict(line)["time"] for line in out.splitlines()] == list(range(3000))
    assert dropped(err) == 0


@pytest.mark.parametrize("how", [pytest.param("live", marks=pytest.mark.slow), "patient"])
def test_a_closed_pipe_is_complained_of_once_and_is_no_error(how):
    child = prints(300, how)
    child.stdout.close()
    assert child.wait(timeout=30) == 0
    err = child.stderr.read()
    assert err.count(b"cannot be written (Broken pipe)") == 1
    assert dropped(err) == 300


def test_a_line_that_was_begun_is_ended_before_the_next(said, warnings):
    """A pipe that takes a part of a line, as a full disk does."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    out = StandardOutput(parsed("-"), warnings, patient=True, descriptor=writing)
    taken = []

    def read_late():
        time.sleep(0.2)
        while data := os.read(reading, 1 << 16):
            taken.append(data)

    reader = threading.Thread(target=read_late)
    reader.start()
    for k in range(300):
        out.send(at(k))
    out.close()
    os.close(writing)
    reader.join()
    os.close(reading)
    assert [strict(line)["time"] for line in b"".join(taken).splitlines()] == list(range(300))
    assert said == []


# network


def test_udp_sends_a_line_per_datagram(datagrams):
    out = open_output(f"udp://127.0.0.1:{datagrams.getsockname()[1]}")
    for k in range(3):
        out.send(at(k))
    assert [strict(datagrams.recv(65536))["time"] for _ in range(3)] == [0, 1, 2]
    out.close()


def test_udp_to_nobody_raises_nothing():
    out = open_output(f"udp://127.0.0.1:{free_port(socket.SOCK_DGRAM)}")
    for k in range(50):
        out.send(at(k))
    out.close()


def test_a_datagram_that_cannot_be_sent_is_dropped_and_counted(said, warnings):
    out = open_output("udp://127.0.0.1:9", warnings)
    for k in range(3):
        out.send(replace(at(k), events=(Event(0.0, "", "", "x" * 70_000),)))
    assert out.dropped == 3
    assert [kind for _, kind, _ in said] == ["unreachable"]
    out.close()


def test_the_rate_thins_solutions_and_keeps_their_events(datagrams):
    out = open_output(f"udp://127.0.0.1:{datagrams.getsockname()[1]}?rate=2")
    for k in range(40):
        out.send(replace(SOLUTION, time=100.0 + 0.05 * k, events=(replace(EVENT, time=float(k)),)))
    read = [strict(datagrams.recv(65536)) for _ in range(4)]
    assert [r["time"] for r in read] == [100.0, 100.5, 101.0, 101.5]
    assert [e["time"] for r in read for e in r["events"]] == list(range(31))
    out.close()


def lines_of(connection: socket.socket, count: int) -> list[dict]:
    connection.settimeout(5.0)
    with connection.makefile("rb") as file:
        return [strict(file.readline()) for _ in range(count)]


def test_tcp_serves_every_reader_on_the_loopback_only():
    port = free_port()
    out = open_output(f"tcp://:{port}")
    readers = [socket.create_connection(("127.0.0.1", port)) for _ in range(3)]
    for k in range(5):
        out.send(at(k))
    for reader in readers:
        assert [r["time"] for r in lines_of(reader, 5)] == list(range(5))
        reader.close()
    assert out._listener.getsockname()[0] == "127.0.0.1"
    out.close()


def test_a_reader_that_stops_reading_loses_the_oldest_lines_and_holds_up_nobody(said, warnings):
    port = free_port()
    out = open_output(f"tcp://:{port}", warnings)
    slow = socket.socket()
    slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    slow.connect(("127.0.0.1", port))
    quick, received = socket.create_connection(("127.0.0.1", port)), []
    reading = threading.Thread(target=lambda: received.extend(lines_of(quick, 1000)))
    reading.start()
    for k in range(1000):
        out.send(at(k))
        time.sleep(0.0005)
    assert not any(reader.socket.getblocking() for reader in out._readers)
    reading.join(5.0)
    assert [r["time"] for r in received] == list(range(1000))
    assert out.dropped > 500
    assert [kind for _, kind, _ in said] == ["slow reader"]
    closing = threading.Thread(target=out.close)
    closing.start()
    slow.settimeout(5.0)
    with slow.makefile("rb") as file:
        late = [strict(line)["time"] for line in file]
    closing.join()
    assert len(late) == 1000 - out.dropped
    assert late[-100:] == list(range(900, 1000))  # what was queued at the end, the newest
    assert late[0] == 0
    assert (np.diff(late) > 0).all()
    slow.close()
    quick.close()


def test_readers_come_and_go(said, warnings):
    port = free_port()
    out = open_output(f"tcp://:{port}", warnings)
    for k in range(20):
        reader = socket.create_connection(("127.0.0.1", port))
        if k % 2:  # cut off at once, as a crash does
            reader.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        else:
            reader.sendall(b"GET / HTTP/1.1\r\n\r\n")
        reader.close()
        out.send(at(k))
        out.send(at(k))
    time.sleep(0.05)
    out.send(SOLUTION)
    out.send(SOLUTION)
    assert out._readers == []
    last = socket.create_connection(("127.0.0.1", port))
    out.send(at(7))
    assert lines_of(last, 1)[0]["time"] == 7
    last.close()
    out.close()
    assert said == []


def test_closing_waits_half_a_second_at_most_for_a_reader_that_does_not_read(monkeypatch):
    slept = []
    clock = SimpleNamespace(monotonic=lambda: sum(slept), sleep=slept.append)
    monkeypatch.setattr("rovgraph.live.outputs.json_lines.time", clock)
    port = free_port()
    out = open_output(f"tcp://:{port}")
    reader = socket.create_connection(("127.0.0.1", port))
    for k in range(3000):
        out.send(at(k))
    out.close()
    assert 0.4 < sum(slept) <= 0.52
    reader.close()


# NMEA


def test_gga_and_hdt_read_back_with_their_checksums(datagrams):
    out = open_output(f"nmea-udp://127.0.0.1:{datagrams.getsockname()[1]}")
    out.send(SOLUTION)
    position, heading = (pynmea2.parse(datagrams.recv(1000).decode(), check=True) for _ in range(2))
    out.close()
    assert (position.sentence_type, heading.sentence_type) == ("GGA", "HDT")
    assert position.latitude == pytest.approx(58.123456789, abs=1e-7)
    assert position.longitude == pytest.approx(-8.5, abs=1e-7)
    assert (position.gps_qual, position.altitude, position.num_sats) == (6, -5.5, "10")
    assert float(position.horizontal_dil) == pytest.approx(0.1)
    assert position.timestamp.isoformat()[:11] == "22:13:20.12"
    assert float(heading.heading) == pytest.approx(np.rad2deg(-0.5) + 360.0, abs=0.006)


@settings(deadline=None, max_examples=100)
@given(st.floats(-90, 90), st.floats(-180, 180), st.floats(-7, 7), st.floats(0, 2e9))
def test_sentences_hold_what_was_given_wherever_on_earth(latitude, longitude, yaw, at_time):
    solution = replace(SOLUTION, time=at_time, latitude=latitude, longitude=longitude, rpy=np.array([0, 0, yaw]))
    position, heading = pynmea2.parse(gga(solution), check=True), pynmea2.parse(hdt(solution), check=True)
    assert position.latitude == pytest.approx(latitude, abs=2e-7)
    assert math.cos(math.radians(position.longitude - longitude)) == pytest.approx(1.0, abs=1e-15)
    assert float(position.lat[2:]) < 60.0
    assert float(position.lon[3:]) < 60.0
    assert 0.0 <= heading.heading < 360.0
    assert math.cos(math.radians(heading.heading) - yaw) == pytest.approx(1.0, abs=1e-7)
    of_day = position.timestamp.hour * 3600 + position.timestamp.minute * 60 + position.timestamp.second
    assert abs((of_day - at_time + 43200) % 86400 - 43200) < 1.01


@pytest.mark.parametrize("latitude", [None, NAN])
def test_without_an_origin_only_the_heading_is_sent_and_that_is_said_once(datagrams, said, warnings, latitude):
    out = open_output(f"nmea-udp://127.0.0.1:{datagrams.getsockname()[1]}", warnings)
    for _ in range(3):
        out.send(replace(SOLUTION, latitude=latitude))
    assert all(datagrams.recv(1000).startswith(b"$GPHDT,331.35,T*") for _ in range(3))
    out.close()
    assert [kind for _, kind, _ in said] == ["no origin"]


# MAVLink


def parser():
    from pymavlink.dialects.v20 import ardupilotmega

    parser = ardupilotmega.MAVLink(None)
    parser.robust_parsing = False
    return parser


def mavlink_messages(receiver: socket.socket, count: int) -> list:
    found, decoder = [], parser()
    while len(found) < count:
        found += decoder.parse_buffer(receiver.recv(2000)) or []
    return found


def test_gps_input_reaches_an_autopilot_with_heartbeat_and_ids(datagrams):
    out = open_output(f"mavlink:udpout:127.0.0.1:{datagrams.getsockname()[1]}?message=GPS_INPUT&system=7")
    out.send(SOLUTION)
    beat, gps = mavlink_messages(datagrams, 2)
    out.close()
    assert (beat.get_type(), gps.get_type()) == ("HEARTBEAT", "GPS_INPUT")
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in (beat, gps)} == {(7, 220)}
    assert (gps.lat, gps.lon) == (581234568, -85000000)
    assert gps.alt == pytest.approx(-5.5)
    assert (gps.vn, gps.ve, gps.vd) == pytest.approx((0.4, -0.1, 0.02))
    assert gps.horiz_accuracy == pytest.approx(0.5)
    assert gps.vert_accuracy == pytest.approx(0.1)
    assert (gps.hdop, gps.vdop) == pytest.approx((0.1, 0.02))
    assert gps.speed_accuracy == pytest.approx(0.03)
    assert gps.yaw == round(36000 - np.rad2deg(0.5) * 100)
    assert (gps.fix_type, gps.ignore_flags, gps.time_usec) == (3, 0, 1_700_000_000_123_456)
    # 2023-11-14 22:13:20.123 UTC and 18 leap seconds: a Tuesday of GPS week 2288
    assert gps.time_week == 2288
    assert gps.time_week_ms == ((2 * 24 + 22) * 3600 + 13 * 60 + 38) * 1000 + 123


def test_vision_position_estimate_has_frames_covariance_and_ids(datagrams):
    out = open_output(f"mavlink:udpout:127.0.0.1:{datagrams.getsockname()[1]}?message=VISION_POSITION_ESTIMATE")
    out.send(SOLUTION)
    _, vision = mavlink_messages(datagrams, 2)
    out.close()
    assert (vision.get_srcSystem(), vision.get_srcComponent()) == (1, 197)
    assert (vision.x, vision.y, vision.z) == pytest.approx((10.0, -20.0, 5.5))
    assert (vision.roll, vision.pitch, vision.yaw) == pytest.approx((0.01, -0.02, -0.5))
    full = np.zeros((6, 6))
    full[np.triu_indices(6)] = vision.covariance
    assert np.diag(full) == pytest.approx(np.square([0.3, 0.4, 0.1, 0.001, 0.002, 0.03]))
    assert full[0, 1] == pytest.approx(-0.05)
    assert vision.usec == 1_700_000_000_123_456


def test_what_is_not_known_is_marked_in_the_messages():
    unknown = np.full(3, NAN)
    gps = gps_input(replace(SOLUTION, velocity=unknown, velocity_sd=unknown, position_sd=unknown, rpy=unknown))
    assert gps.ignore_flags == 2 + 4 + 8 + 16 + 32 + 64 + 128
    assert gps.yaw == 0
    assert gps_input(replace(SOLUTION, rpy=np.zeros(3))).yaw == 36000
    assert gps_input(replace(SOLUTION, position=np.array([1.0, 2.0, NAN]))).fix_type == 2
    assert gps_input(replace(SOLUTION, latitude=None)) is None
    assert gps_input(replace(SOLUTION, time=12.5)).time_week == 0
    assert vision_position_estimate(replace(SOLUTION, rpy=unknown)) is None
    assert math.isnan(vision_position_estimate(replace(SOLUTION, position_sd=unknown)).covariance[0])


@settings(deadline=None, max_examples=60)
@given(solutions)
def test_any_solution_makes_a_message_or_none(solution):
    from pymavlink.dialects.v20 import common

    for message in (gps_input(solution), vision_position_estimate(solution)):
        if message is not None:
            message.pack(common.MAVLink(None))


def test_without_an_origin_gps_input_says_so_once(said, warnings):
    out = open_output("mavlink:udpout:127.0.0.1:9?message=GPS_INPUT", warnings)
    for _ in range(3):
        out.send(replace(SOLUTION, latitude=None))
    out.close()
    assert [kind for _, kind, _ in said] == ["not known"]


def test_a_tcp_connection_is_waited_for_and_taken_up_again(said, warnings, monkeypatch, capfd):
    monkeypatch.setattr("rovgraph.live.outputs.mavlink.RETRY_S", 0.05)
    port = free_port()
    out = open_output(f"mavlink:tcp:127.0.0.1:{port}", warnings)
    out.send(SOLUTION)
    for _ in range(2):
        with socket.create_server(("127.0.0.1", port)) as server:
            server.settimeout(0.05)
            for _ in range(100):
                out.send(SOLUTION)
                try:
                    autopilot, _ = server.accept()
                    break
                except TimeoutError:
                    continue
            with autopilot:
                autopilot.settimeout(5.0)
                out.send(SOLUTION)
                assert "GPS_INPUT" in {m.get_type() for m in mavlink_messages(autopilot, 2)}
        for _ in range(5):
            out.send(SOLUTION)
            time.sleep(0.02)
    out.close()
    assert {kind for _, kind, _ in said} == {"connection"}
    assert capfd.readouterr().out == ""
