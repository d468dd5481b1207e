"""Sources of the online mode: what is read of each protocol, and that they outlive the other side."""

import dataclasses
import gzip
import math
import os
import queue
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from wire import (
    ARRIVAL,
    Heard,
    autopilot,
    decoded,
    gps,
    highres_imu,
    packed,
    pressure2,
    raw_imu,
    report,
    scaled_imu2,
    sentence,
    vision,
)

import rovgraph as rg
from rovgraph.errors import InputError
from rovgraph.live.message import GEODETIC, Message, Reading
from rovgraph.live.session import Feed
from rovgraph.live.sources import Source, links, open_source, open_sources, with_depth_options
from rovgraph.live.sources.doppler import waterlinked
from rovgraph.live.sources.json_lines import json_lines
from rovgraph.live.sources.links import StandardInput
from rovgraph.live.sources.nmea import nmea
from rovgraph.live.sources.source import LONGEST, PATIENCE_S, LinkSource, paced
from rovgraph.live.warnings import Warnings
from rovgraph.log import read_log
from rovgraph.model.config import Config

ROOT = Path(__file__).parents[1]
DATA = Path(__file__).parents[2] / "shared" / "data"
TLOG = DATA / "ardusub" / "ardusub_small.tlog.gz"
HANGS_S = 30.0  # nothing takes as long on any machine
IMU = '"acc_x": 1, "acc_y": 2, "acc_z": -9.8, "gyr_x": 0.1, "gyr_y": 0.2, "gyr_z": 0.3'


@pytest.fixture
def heard() -> Heard:
    return Heard()


def by_sensor(messages: list[Message]) -> dict[str, list[np.ndarray]]:
    out: dict[str, list[np.ndarray]] = {}
    for message in messages:
        for reading in message.readings:
            out.setdefault(reading.sensor, []).append(reading.values)
    return out


def only(messages: list[Message]) -> tuple[Message, Reading]:
    (message,) = messages
    (reading,) = message.readings
    return message, reading


def take(source: Source, count: int, within: float = 5.0) -> list[Message]:
    """The first messages of a source; fewer where they do not come in time."""
    stop, out = threading.Event(), []
    timer = threading.Timer(within, stop.set)
    timer.start()
    try:
        for message in source.messages(stop):
            out.append(message)
            if len(out) == count:
                break
    finally:
        timer.cancel()
        stop.set()
    return out


def until(true: Callable[[], bool]) -> None:
    end = time.monotonic() + HANGS_S
    while not true():
        assert time.monotonic() < end, "it did not come to that"
        time.sleep(0.01)


@contextmanager
def server(serve: Callable[[socket.socket], None], connections: int = 1, port: int = 0) -> Iterator[int]:
    """A TCP server in a thread: each connection in turn is given to ``serve``, and closed."""
    listener = socket.create_server(("127.0.0.1", port))

    def run() -> None:
        for _ in range(connections):
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            with connection:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                serve(connection)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield listener.getsockname()[1]
    finally:
        listener.close()
        thread.join(2.0)


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(links, "RETRY_S", (0.05,))


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


# Warnings


def test_a_complaint_is_said_once_per_period_with_the_count_since():
    now, said = [0.0], []
    warnings = Warnings(lambda *line: said.append(line), period=60.0, clock=lambda: now[0])
    for _ in range(5):
        warnings.complain("a", "noise", "what is this")
    warnings.complain("b", "noise", "what is that")
    now[0] = 60.0
    warnings.complain("a", "noise", "and this")
    assert said == [
        ("a", "noise", "what is this"),
        ("b", "noise", "what is that"),
        ("a", "noise", "and this (4 more since the last)"),
    ]
    assert warnings.counts == {("a", "noise"): 6, ("b", "noise"): 1}


def test_what_is_to_be_said_once_is_counted_all_the_same():
    now, said = [0.0], []
    warnings = Warnings(lambda *line: said.append(line), clock=lambda: now[0])
    for now[0] in (0.0, 100.0, 200.0):
        warnings.complain("a", "unknown key", "foo", once=True)
    assert len(said) == 1
    assert warnings.counts == {("a", "unknown key"): 3}


def test_no_complaint_is_lost_between_threads():
    warnings = Warnings()
    work = [threading.Thread(target=lambda: [warnings.complain("a", "b", "c") for _ in range(2000)]) for _ in range(4)]
    for thread in work:
        thread.start()
    for thread in work:
        thread.join()
    assert warnings.counts == {("a", "b"): 8000}


# URLs


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("tpc://host:1", ["did you mean tcp://host:port?", "waterlinked://host"]),
        ("waterlink://host", ["did you mean waterlinked://host[:port]?"]),
        ("udpin:127.0.0.1:14550", ["did you mean mavlink:udpin:127.0.0.1:14550?"]),
        ("dive.tlog", ["did you mean mavlink:dive.tlog?"]),
        ("/dev/ttyUSB0", ["nmea:/dev/ttyUSB0"]),
        ("", ["unknown kind of source"]),
        ("tcp://host", ["expected tcp://host:port"]),
        ("tcp://host:0", ["expected tcp://host:port"]),
        ("tcp://host:70000", ["expected tcp://host:port"]),
        ("tcp://host:http", ["expected tcp://host:port"]),
        ("tcp://[::1:5", ["expected tcp://host:port"]),
        ("tcp://:5000", ["expected tcp://host:port"]),
        ("tcp://host:1/path", ["expected tcp://host:port"]),
        ("udp://", ["expected udp://host:port"]),
        ("tcp://host:1?baud=9600", ["unknown option 'baud'"]),
        ("mavlink:tcp:host:1?presure=2", ["unknown option 'presure'", "nearest is 'pressure'"]),
        ("mavlink:tcp:host:1?pressure=5", ["option pressure: '5', expected a whole number from 1 to 3"]),
        ("mavlink:tcp:host:1?density=-1", ["option density: '-1', expected a number above 0"]),
        ("mavlink:tcp:host:1?imu=IMU9", ["option imu: 'IMU9', expected one of HIGHRES_IMU"]),
        ("mavlink:tcp:host:1?pressure=1&pressure=2", ["given twice"]),
        ("mavlink:udpout:host:1", ["expected mavlink:udpin:host:port"]),
        ("mavlink:nothere.tlog", ["no such file nothere.tlog"]),
        ("nmea:nothere.txt", ["no such file nothere.txt"]),
        ("file:nothere.csv", ["nothere.csv"]),
        ("file:nothere.csv?speed=fast", ["option speed: 'fast', expected a number above 0, or max"]),
    ],
)
def test_a_url_that_cannot_be_is_refused_in_one_line_that_helps(url, words):
    with pytest.raises(InputError) as refusal:
        open_source(url)
    message = str(refusal.value)
    assert "\n" not in message
    for word in words:
        assert word in message


def test_a_file_without_its_scheme_is_recognised(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("dive.csv").write_text("time,depth\n1,2\n")
    with pytest.raises(InputError, match=r"did you mean file:dive\.csv?"):
        open_source("dive.csv")


def test_no_source_and_the_same_source_twice_are_refused():
    with pytest.raises(InputError, match="at least one source"):
        open_sources([])
    with pytest.raises(InputError, match="given twice"):
        open_sources(["-", "tcp://host:1", "-"])


def test_a_bad_speed_is_refused():
    with pytest.raises(InputError, match="speed: '0'"):
        open_source("-", speed="0")


@pytest.mark.parametrize(
    ("library", "url"),
    [("pymavlink.dialects.v20", "mavlink:tcp:host:1"), ("pynmea2", "nmea:tcp://host:1"), ("serial", "nmea:/dev/tty9")],
)
def test_a_missing_library_names_the_extra(library, url, monkeypatch):
    for name in [n for n in sys.modules if n == library or n.startswith(f"{library}.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(InputError, match=r"rovgraph\[online\]"):
        open_source(url)


# JSON lines


def test_a_line_says_what_the_row_of_a_log_would(heard):
    line = (
        f'{{"time": 12.5, {IMU}, "dvl_vx": 0.4, "dvl_vy": 0, "dvl_vz": null, "depth": 3, "fix_lat": 1, "fix_lon": 2}}'
    )
    (message,) = decoded(json_lines("-", heard, Config()), line.encode() + b"\r\n")
    assert (message.source, message.arrival, message.stamp) == ("-", ARRIVAL, 12.5)
    found = {r.sensor: r.values for r in message.readings}
    np.testing.assert_allclose(found["imu"], [1, 2, -9.8, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(found["depth"], [3.0])
    np.testing.assert_allclose(found[GEODETIC], [1.0, 2.0, *4 * [np.nan]])
    assert set(found) == {"imu", "depth", GEODETIC}
    assert heard.kinds == {"incomplete": 1}


def test_names_and_units_of_the_configuration_hold_for_lines_too(heard):
    config = Config.model_validate(
        {"columns": {"dvl_heading": "compass"}, "units": {"dvl_heading": "deg", "depth": "cm"}}
    )
    messages = decoded(json_lines("-", heard, config), b'{"compass": 90, "depth": 250}\n')
    found = by_sensor(messages)
    np.testing.assert_allclose(found["dvl_heading"], [[np.pi / 2]])
    np.testing.assert_allclose(found["depth"], [[2.5]])
    assert messages[0].stamp is None


def test_magnetometers_stay_raw_in_every_source(heard, tmp_path):
    """The navigator calibrates them: a source that did would do it a second time."""
    config = Config.model_validate({"imu": {"mag": {"centre": [1, 2, 3]}}})
    lines = decoded(json_lines("-", heard, config), b'{"mag_x": 20, "mag_y": 0, "mag_z": -40}\n')
    vehicle = decoded(autopilot(heard, config), packed(raw_imu(mag=(200, 0, -400))))
    path = tmp_path / "log.csv"
    path.write_text("time,mag_x,mag_y,mag_z\n1,20,0,-40\n")
    log = list(open_source(f"file:{path}?speed=max", config=config).messages(threading.Event()))
    for messages in (lines, vehicle, log):
        np.testing.assert_allclose(by_sensor(messages)["mag"], [[20.0, 0.0, -40.0]])


@pytest.mark.parametrize(
    ("line", "kind"),
    [
        (b'{"depth": "3"}', "string"),
        (b'{"depth": true}', "boolean"),
        (b'{"depth": [3]}', "nested value"),
        (b'{"depth": {"m": 3}}', "nested value"),
        (b'{"depth": NaN}', "NaN or Infinity"),
        (b'{"depth": -Infinity}', "NaN or Infinity"),
        (b'{"depth": 1e999}', "out of range"),
        (b'{"depth": 1' + b"0" * 400 + b"}", "out of range"),
        (b'{"depth": 1' + b"0" * 9999 + b"}", "not JSON"),
        (b'{"dvl_valid": 2}', "out of range"),
        (b'{"fix_lat": 95, "fix_lon": 0}', "out of range"),
        (b"[1, 2]", "no object"),
        (b"3", "no object"),
        (b'{"depth": 3', "not JSON"),
        (b"[" * 20000, "not JSON"),
        (b"time,depth", "not JSON"),
        (b'{"depth": 3, "name": "\xff"}', "not UTF-8"),
        (bytes(range(128, 256)), "not UTF-8"),
        (b'{"depth": 3, "pad": "' + b"x" * LONGEST + b'"}', "too long"),
        (b"x" * (3 * LONGEST), "too long"),
        (b'{"gyr_x": 0, "gyr_y": 0, "gyr_z": 0}', "no acceleration"),
        (b'{"acc_x": 0, "acc_y": 0}', "incomplete"),
        (b'{"dvl_sd": 0.1}', "incomplete"),
    ],
)
@pytest.mark.parametrize("size", [1 << 20, 1000])
def test_a_bad_line_is_counted_by_kind_and_the_next_one_read(line, kind, size, heard):
    decoder = json_lines("-", heard, Config())
    data = line + b'\n{"depth": 7}\n'
    messages = decoded(decoder, *(data[i : i + size] for i in range(0, len(data), size)))
    np.testing.assert_array_equal(only(messages)[1].values, [7.0])
    assert heard.kinds == {kind: 1}


def test_an_unknown_key_is_counted_and_said_once_with_the_one_that_is_meant():
    said = []
    warnings = Warnings(lambda *line: said.append(line))
    decoder = open_source("-", warnings).decoder
    assert len(decoded(decoder, b'{"depth": 1, "gyro_x": 2, "note": "hello"}\n' * 10)) == 10
    assert sorted(warnings.counts.values()) == [10, 10]
    assert len(said) == 2
    assert "gyr_x" in "".join(text for _, _, text in said)


def test_unknown_keys_without_end_do_not_fill_the_memory():
    warnings = Warnings()
    decoded(open_source("-", warnings).decoder, *(b'{"k%d": 1}\n' % i for i in range(1000)))
    assert len(warnings.counts) < 30
    assert sum(warnings.counts.values()) == 1000


def test_a_rate_alone_takes_the_last_acceleration_of_half_a_second(heard):
    acc = b'{"time": %.2f, "acc_x": 1, "acc_y": 2, "acc_z": 3}\n'
    gyr = b'{"time": %.2f, "gyr_x": 4, "gyr_y": 5, "gyr_z": 6}\n'
    messages = decoded(json_lines("-", heard, Config()), gyr % 9.9, acc % 10, gyr % 10.1, gyr % 10.4, gyr % 10.6)
    assert [m.stamp for m in messages] == [10.1, 10.4]
    np.testing.assert_array_equal(messages[0].readings[0].values, [1, 2, 3, 4, 5, 6])
    assert heard.kinds == {"no acceleration": 2}


def test_a_ping_without_bottom_lock_needs_no_velocities_and_a_fix_at_nought_is_none(heard):
    messages = decoded(json_lines("-", heard, Config()), b'{"dvl_valid": 0}\n{"fix_lat": 0, "fix_lon": 0}\n')
    np.testing.assert_array_equal(only(messages)[1].values, [np.nan, np.nan, np.nan, 0.0, np.nan])


# Links


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    read, write = os.pipe()
    yield read, write
    for descriptor in (read, write):
        with suppress(OSError):
            os.close(descriptor)


def test_standard_input_is_read_to_its_end_and_its_last_line_may_lack_an_end(pipe, heard):
    read, write = pipe
    source = LinkSource("-", StandardInput(read), json_lines("-", heard, Config()))
    os.write(write, b'{"depth": 1}\n{"dep')
    threading.Timer(0.1, lambda: (os.write(write, b'th": 2}\n{"depth": 3}'), os.close(write))).start()
    assert [m.readings[0].values[0] for m in source.messages(threading.Event())] == [1.0, 2.0, 3.0]
    assert not heard.kinds


def test_every_live_source_stops_when_told_as_it_never_waits_longer_than_a_fifth_of_a_second(pipe, heard, monkeypatch):
    """What else it waits for, an answer or the next attempt, may take as long as it likes."""
    monkeypatch.setattr(links, "CONNECT_S", 600.0)
    monkeypatch.setattr(links, "RETRY_S", (600.0,))
    waits, silent = [], threading.Event()

    def settimeout(connection: socket.socket, seconds: float | None, settimeout=socket.socket.settimeout) -> None:
        waits.append(seconds)
        settimeout(connection, seconds)

    def ready(read, write, failed, seconds=None):
        waits.append(seconds)
        return select.select(read, write, failed, seconds)

    monkeypatch.setattr(links, "select", SimpleNamespace(select=ready))
    with server(lambda connection: silent.wait(HANGS_S) and None) as port:
        monkeypatch.setattr(socket.socket, "settimeout", settimeout)
        sources = [
            LinkSource("-", StandardInput(pipe[0]), json_lines("-", heard, Config())),
            open_source(f"tcp://127.0.0.1:{port}"),
            open_source(f"tcp://127.0.0.1:{free_port()}"),
            open_source("tcp://192.0.2.1:9"),  # never answers
            open_source(f"udp://:{free_port()}"),
            open_source(f"nmea:udp://:{free_port()}"),
            open_source("nmea:/dev/ttyNone"),
        ]
        stop = threading.Event()
        threads = [threading.Thread(target=lambda s=s: list(s.messages(stop)), daemon=True) for s in sources]
        for thread in threads:
            thread.start()
        time.sleep(0.3)
        stop.set()
        for thread in threads:
            thread.join(HANGS_S)
        silent.set()
    assert not any(thread.is_alive() for thread in threads)
    assert len(waits) >= 4 and all(seconds is not None and seconds <= 0.2 for seconds in waits)


def test_a_tcp_source_connects_again_and_drops_the_line_that_was_cut(impatient):
    lines = iter([b'{"depth": 1}\n{"dep', b'{"depth": 2}\n'])
    warnings = Warnings()
    with server(lambda connection: connection.sendall(next(lines)), connections=2) as port:
        url = f"tcp://127.0.0.1:{port}"
        messages = take(open_source(url, warnings), 2)
    assert [m.readings[0].values[0] for m in messages] == [1.0, 2.0]
    assert warnings.counts == {(url, "disconnected"): 1}


def test_a_host_that_is_not_there_is_complained_of_until_it_is(impatient):
    port, warnings = free_port(), Warnings()
    source = open_source(f"tcp://localhost:{port}", warnings)
    started: list[list[Message]] = []
    reader = threading.Thread(target=lambda: started.append(take(source, 1, within=HANGS_S)), daemon=True)
    reader.start()
    until(lambda: warnings.counts.get((source.url, "unreachable"), 0) >= 2)
    with server(lambda connection: connection.sendall(b'{"depth": 5}\n'), port=port):
        reader.join(HANGS_S)
    assert [len(messages) for messages in started] == [1]


@pytest.mark.parametrize("host", ["no-such-host.invalid", "a..b", "x" * 70])
def test_a_name_that_does_not_resolve_is_complained_of(host, impatient):
    said = []
    source = open_source(f"tcp://{host}:9", Warnings(lambda *line: said.append(line)))
    assert take(source, 1, within=0.3) == []
    assert [kind for _, kind, _ in said] == ["unreachable"]


def test_datagrams_hold_whole_lines_and_come_to_the_loopback_only_unless_a_host_is_written():
    source = open_source(f"udp://:{free_port()}")
    assert source.link._socket.getsockname()[0] == "127.0.0.1"
    assert open_source(f"udp://0.0.0.0:{free_port()}").link._socket.getsockname()[0] == "0.0.0.0"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for datagram in (b'{"depth": 1}', b'{"depth": 2}\n{"depth": 3}\n', b'{"dep', b'{"depth": 4}'):
            sender.sendto(datagram, ("127.0.0.1", source.link.port))
        messages = take(source, 4)
    assert [m.readings[0].values[0] for m in messages] == [1.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize("form", ["udp://127.0.0.1:%d", "nmea:udp://:%d", "mavlink:udpin:127.0.0.1:%d"])
def test_a_port_that_is_taken_is_refused_at_once(form):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        with pytest.raises(InputError, match="cannot listen at 127"):
            open_source(form % other.getsockname()[1])


def test_a_serial_port_is_read_and_a_lost_one_tried_again(impatient):
    pty = pytest.importorskip("pty")
    master, slave = pty.openpty()
    warnings = Warnings()
    source = open_source(f"nmea:{os.ttyname(slave)}?baud=9600", warnings)
    threading.Timer(0.2, lambda: os.write(master, sentence("HEHDT,90.0,T"))).start()
    _, reading = only(take(source, 1))
    assert reading.values[0] == pytest.approx(np.pi / 2)
    os.close(slave)
    os.close(master)
    assert take(source, 1, within=0.3) == []
    assert warnings.counts[source.url, "unreachable"] >= 1


# Water Linked


def test_a_velocity_report_becomes_a_ping_with_its_altitude(heard):
    (message,) = decoded(waterlinked("w", heard), report())
    assert message.stamp == pytest.approx(1638191471.563017, abs=1e-6)
    found = {r.sensor: r.values for r in message.readings}
    np.testing.assert_allclose(found["dvl"], [0.5, -0.1, 0.02, 1.0, 2e-3])
    np.testing.assert_allclose(found["dvl_altitude"], [1.5])
    assert not heard.kinds


@pytest.mark.parametrize(
    ("changes", "sd"),
    [
        ({"covariance": ...}, 0.004),
        ({"covariance": [[0, 0, 0]] * 3}, 0.004),
        ({"covariance": [[-1, 0, 0]] * 3}, 0.004),
        ({"covariance": "none"}, 0.004),
        ({"covariance": [], "fom": "bad"}, math.nan),
        ({"covariance": [], "fom": 0}, math.nan),
    ],
)
def test_without_a_covariance_the_figure_of_merit_is_the_sd(changes, sd, heard):
    (message,) = decoded(waterlinked("w", heard), report(**changes))
    np.testing.assert_equal(message.readings[0].values[4], sd)


def test_a_velocity_relative_to_the_water_is_no_bottom_track(heard):
    water = {"type": "velocity_water", "format": "json_v3.2", "tracking_mode": "water", "altitude": 3.0}
    _, reading = only(decoded(waterlinked("w", heard), report(**water)))
    assert reading.sensor == "dvl_water"
    np.testing.assert_allclose(reading.values, [0.5, -0.1, 0.02])
    assert decoded(waterlinked("w", heard), report(**water, velocity_valid=False)) == []
    assert not heard.kinds


def test_a_report_without_bottom_lock_is_a_lost_ping_whatever_else_it_says(heard):
    data = report(velocity_valid=False, vx=0, vy=0, vz=0, altitude=-1, fom=2.7, status=1)
    (message,) = decoded(waterlinked("w", heard), data)
    reading, beams = message.readings
    assert beams.sensor == "dvl_beams"
    np.testing.assert_array_equal(reading.values, [np.nan, np.nan, np.nan, 0.0, np.nan])
    assert heard.kinds == {"status": 1}


@pytest.mark.parametrize(
    ("data", "kinds"),
    [
        (b'{"ts": 49056.8, "x": 12.4, "type": "position_local", "format": "json_v3"}\n', {}),
        (b'{"response_to": "get_config", "success": true, "type": "response", "format": "json_v3"}\n', {}),
        (b'{"type": "telegram", "format": "json_v3"}\n', {"unknown report": 1}),
        (report(format="json_v9"), {"unknown format": 1}),
        (report(format="json_v2"), {"unknown format": 1}),
        (report(velocity_valid="true"), {"malformed": 1}),
        (report(vx=...), {"null": 1}),
        (report(vy="fast"), {"string": 1}),
        (report(time_of_validity=[1]), {"nested value": 1}),
        (b"\x00\xff{}\n", {"not UTF-8": 1}),
    ],
)
def test_reports_of_other_kinds_are_ignored_and_bad_ones_counted(data, kinds, heard):
    (message,) = decoded(waterlinked("w", heard), data + report())
    assert [r.sensor for r in message.readings] == ["dvl", "dvl_altitude", "dvl_beams"]
    assert heard.kinds == kinds


def test_a_dvl_that_sends_partial_lines_dies_and_comes_back_is_read_all_along(impatient):
    turns = iter(range(2))

    def dvl(connection: socket.socket) -> None:
        turn = next(turns)
        for i in range(3):
            data = report(vx=10 * turn + i)
            for part in (data[:7], data[7:100], data[100:]):
                connection.sendall(part)
                time.sleep(0.005)
        connection.sendall(report()[:50])

    warnings = Warnings()
    with server(dvl, connections=2) as port:
        source = open_source(f"waterlinked://127.0.0.1:{port}", warnings)
        messages = take(source, 6)
    assert [m.readings[0].values[0] for m in messages] == [0.0, 1.0, 2.0, 10.0, 11.0, 12.0]
    assert set(warnings.counts) == {(source.url, "disconnected")}


def test_the_port_of_a_dvl_need_not_be_written():
    link = open_source("waterlinked://192.168.194.95").link
    assert (link._host, link._port) == ("192.168.194.95", 16171)


# MAVLink


def test_raw_imu_is_in_milli_g_milliradians_and_milligauss(heard):
    (message,) = decoded(autopilot(heard), packed(raw_imu()))
    assert (message.stamp, message.clock) == (5.0, "boot")
    found = {r.sensor: r.values for r in message.readings}
    np.testing.assert_allclose(found["imu"], [0.0980665, -0.196133, -9.80665, 0.001, 0.002, 0.003])
    np.testing.assert_allclose(found["mag"], [20.0, 0.0, -40.0])  # microtesla


def test_highres_imu_is_in_si_and_gauss_and_says_what_is_new(heard):
    (message,) = decoded(autopilot(heard), packed(highres_imu()))
    np.testing.assert_allclose(message.readings[0].values, [0.1, 0.2, -9.8, 0.01, 0.02, 0.03], rtol=1e-6)
    np.testing.assert_allclose(message.readings[1].values, [20.0, 0.0, -40.0], rtol=1e-6)
    (message,) = decoded(autopilot(heard), packed(highres_imu(0x03F)))
    assert [r.sensor for r in message.readings] == ["imu"]
    assert decoded(autopilot(heard), packed(highres_imu(0x1C0))) == []


def test_times_since_1970_and_since_the_start_are_told_apart(heard):
    (message,) = decoded(autopilot(heard), packed(raw_imu(usec=1_683_220_541_055_000)))
    assert (message.stamp, message.clock) == (pytest.approx(1683220541.055, abs=1e-6), "unix")


def test_the_best_imu_is_read_and_no_other_beside_it(heard):
    data = [raw_imu(), scaled_imu2(), raw_imu(), highres_imu(), raw_imu(), highres_imu()]
    decoder = autopilot(heard)
    assert [len(decoded(decoder, packed(m))) for m in data] == [1, 0, 1, 1, 0, 1]
    assert heard.kinds == {"switched": 1}


def test_an_imu_of_zeros_is_none_and_a_silent_one_is_replaced(heard):
    decoder = autopilot(heard)
    assert decoded(decoder, packed(scaled_imu2(acc=(0, 0, 0), mag=(0, 0, 0)))) == []
    assert len(decoded(decoder, packed(raw_imu()))) == 1
    assert decoded(decoder, packed(scaled_imu2()), arrival=ARRIVAL + PATIENCE_S) == []
    assert len(decoded(decoder, packed(scaled_imu2()), arrival=ARRIVAL + PATIENCE_S + 0.1)) == 1


def test_an_imu_that_was_asked_for_is_the_only_one(heard):
    decoder = autopilot(heard, imu="SCALED_IMU2")
    assert [len(decoded(decoder, packed(m))) for m in (highres_imu(), raw_imu(), scaled_imu2())] == [0, 0, 1]


def test_attitude_is_turned_from_true_to_magnetic_north(heard):
    config = Config.model_validate({"environment": {"declination_deg": 10}})
    attitude = mavlink.MAVLink_attitude_message(2500, 0.1, -0.2, -3.1, 0, 0, 0)
    message, reading = only(decoded(autopilot(heard, config), packed(attitude)))
    assert reading.sensor == "ahrs"
    np.testing.assert_allclose(reading.values, [-3.1 - np.deg2rad(10) + 2 * np.pi, 0.1, -0.2], rtol=1e-6)
    assert message.stamp == 2.5


def test_pressure_stays_pressure(heard):
    said = decoded(autopilot(heard), packed(pressure2(hpa=1818.0)))
    np.testing.assert_allclose(by_sensor(said)["pressure"], [[181_800.0]])


def parameter(name: str, value: float):
    return mavlink.MAVLink_param_value_message(name.encode(), value, 9, 1, 0)


def test_what_the_autopilot_states_of_surface_and_water_is_told_where_the_configuration_is_silent(heard):
    told = [packed(parameter("BARO2_GND_PRESS", 99_000.0)), packed(parameter("BARO_SPEC_GRAV", 1.025))]
    decoded(autopilot(heard), *told)
    assert heard.kinds == {"not stated: surface_hpa": 1, "not stated: density_kgm3": 1}
    heard.kinds.clear()
    decoded(autopilot(heard, Config().changed(depth={"surface_hpa": 990, "density_kgm3": 1025})), *told)
    assert not heard.kinds


def test_options_of_surface_and_density_become_keys_of_the_configuration():
    urls = ["mavlink:tcp:host:1?surface=900&density=1010", "mavlink:tcp:host:2", "file:log.csv?density=1000"]
    with pytest.warns(rg.DataWarning, match=r"option (surface|density) will go; state depth: ") as said:
        depth = with_depth_options(urls, Config()).depth
    assert len(said) == 2 and (depth.surface_hpa, depth.density_kgm3) == (900.0, 1010.0)
    with pytest.raises(InputError, match="option density: '-1', expected a number above 0"):
        with_depth_options(["mavlink:tcp:host:1?density=-1"], Config())


def test_an_imu_that_is_sent_twice_a_second_is_said_to_be_too_slow(heard):
    messages = [packed(raw_imu(usec=round(5e5 * k) + 1)) for k in range(30)]
    decoded(autopilot(heard), *messages)
    assert heard.kinds == {"slow": 1}


def test_only_the_pressure_sensor_that_was_asked_for_is_read(heard):
    inside = mavlink.MAVLink_scaled_pressure_message(1000, 1100.0, 0.0, 1000)
    assert decoded(autopilot(heard), packed(inside)) == []
    assert len(decoded(autopilot(heard, pressure=1), packed(inside), packed(pressure2()))) == 1


@pytest.mark.parametrize(
    ("message", "sd"),
    [(gps(h_acc=1200), 1.2), (gps(eph=150), 4.5), (gps(eph=65535), math.nan)],
)
def test_a_fix_has_the_receivers_accuracy_or_that_of_its_dilution(message, sd, heard):
    said, reading = only(decoded(autopilot(heard), packed(message)))
    assert (reading.sensor, said.stamp) == (GEODETIC, 7.0)
    np.testing.assert_allclose(reading.values, [58.3, 15.1, sd])


@pytest.mark.parametrize("message", [gps(fix_type=2), gps(lat=0, lon=0), gps(lat=910000000), gps(lon=1900000000)])
def test_no_fix_is_none(message, heard):
    assert decoded(autopilot(heard), packed(message)) == []


def test_a_fix_that_is_sent_again_counts_once(heard):
    assert len(decoded(autopilot(heard), *[packed(gps())] * 5, packed(gps(usec=8_000_000)))) == 2


def test_a_position_delta_is_the_velocity_at_its_middle_whoever_sends_it(heard):
    message, reading = only(decoded(autopilot(heard), packed(vision(), system=255, component=0)))
    assert message.stamp == pytest.approx(8.95)
    assert message.clock == "boot of 255/0"  # not the vehicle's own
    np.testing.assert_allclose(reading.values, [0.5, -0.1, 0.0, 1.0, np.nan], atol=1e-7)
    message, _ = only(decoded(autopilot(heard), packed(vision(usec=0), system=255, component=0)))
    assert (message.stamp, message.clock) == (None, "")


@pytest.mark.parametrize("message", [vision(confidence=0.0), vision(dt=0), vision(confidence=math.nan)])
def test_a_position_delta_without_confidence_is_a_lost_ping(message, heard):
    _, reading = only(decoded(autopilot(heard), packed(message)))
    assert reading.values[3] == 0.0


def test_only_the_vehicles_autopilot_is_read(heard):
    decoder = autopilot(heard)
    senders = [(255, 190), (1, 100), (1, 1), (2, 1), (1, 1)]
    assert [len(decoded(decoder, packed(raw_imu(), *sender))) for sender in senders] == [0, 0, 1, 0, 1]
    assert heard.kinds == {"another system": 1}
    assert len(decoded(autopilot(heard, system=2), packed(raw_imu(), 1, 1), packed(raw_imu(), 2, 1))) == 1


def test_a_value_that_is_no_number_is_left_out(heard):
    broken = mavlink.MAVLink_attitude_message(2500, 0.1, math.nan, 0.3, 0, 0, 0)
    assert decoded(autopilot(heard), packed(broken), packed(pressure2(hpa=math.inf))) == []
    assert heard.kinds == {"not finite": 2}


def test_noise_costs_no_good_message(heard):
    """A marker by chance swallows nothing, even where the length behind it covers good messages."""
    false_start = b"\xfd\xff\x00 and what follows"
    good = [packed(raw_imu(usec=1_000_000 * (i + 1))) for i in range(20)]
    messages = decoded(autopilot(heard), false_start, *good)
    assert [m.stamp for m in messages] == [float(i + 1) for i in range(20)]
    assert heard.kinds["bad data"] >= 1


def test_a_vehicle_is_heard_over_udp():
    source = open_source(f"mavlink:udpin:127.0.0.1:{free_port()}")
    sender = mavutil.mavlink_connection(f"udpout:127.0.0.1:{source.link.port}", source_system=1, source_component=1)
    sender.mav.heartbeat_send(12, 3, 0, 0, 0)
    sender.mav.attitude_send(2500, 0.1, 0.2, 0.3, 0, 0, 0)
    sender.write(b"\xfd noise")
    sender.mav.scaled_pressure2_send(1000, 1013.25, 0.0, 1000)
    messages = take(source, 2)
    sender.close()
    assert set(by_sensor(messages)) == {"ahrs", "pressure"}


@pytest.fixture(scope="module")
def real_tlog() -> Path:
    if not TLOG.exists():
        pytest.skip("data/ardusub does not lie beside the checkout")
    return TLOG


def test_a_real_telemetry_log_is_read_whole(real_tlog):
    warnings = Warnings()
    source = open_source(f"mavlink:{real_tlog}", warnings, speed="max")
    messages = list(source.messages(threading.Event()))
    found = {sensor: np.array(values) for sensor, values in by_sensor(messages).items()}
    # as counted with pymavlink's own reader; the second IMU says zeros, fixes repeat
    assert (len(found["ahrs"]), len(found["imu"]), len(found["mag"]), len(found["pressure"])) == (5245, 528, 528, 635)
    assert np.linalg.norm(np.median(found["imu"][:, :3], axis=0)) == pytest.approx(9.81, abs=0.2)
    assert 25.0 < np.median(np.linalg.norm(found["mag"], axis=1)) < 65.0  # the Earth's field [uT]
    assert np.ptp(found[GEODETIC][:, 0]) < 0.01
    arrivals = np.array([m.arrival for m in messages])
    assert (np.diff(arrivals) >= 0.0).all()
    stamps = np.array([m.stamp for m in messages])
    assert {m.clock for m in messages} == {"boot"}
    np.testing.assert_allclose(arrivals - stamps, np.median(arrivals - stamps), atol=2.0)
    once = "slow", "not stated: surface_hpa", "not stated: density_kgm3"  # its RAW_IMU came twice a second
    assert warnings.counts == {(source.url, "bad data"): 4} | {(source.url, kind): 1 for kind in once}


# NMEA


DECLINED = Config.model_validate({"environment": {"declination_deg": 4.5}})


@pytest.mark.parametrize(
    ("body", "magnetic_deg"),
    [
        ("HEHDT,94.5,T", 90.0),
        ("HCHDM,90.0,M", 90.0),
        ("HCHDG,90.0,,,,", 90.0),
        ("HCHDG,88.0,2.0,E,,", 90.0),
        ("HCHDG,90.0,,,4.5,E", 90.0),
        ("HCHDG,97.0,,,2.5,W", 90.0),
        ("HEHDT,364.0,T", None),
        ("HEHDT,,T", None),
        ("HEHDT,nan,T", None),
    ],
)
def test_headings_are_magnetic_whichever_north_they_come_from(body, magnetic_deg, heard):
    messages = decoded(nmea("n", heard, DECLINED), sentence(body))
    if magnetic_deg is None:
        assert messages == []
        return
    message, reading = only(messages)
    assert (reading.sensor, message.stamp) == ("ahrs", None)
    np.testing.assert_allclose(reading.values, [np.deg2rad(magnetic_deg), np.nan, np.nan])


@pytest.mark.parametrize(
    ("body", "sd"),
    [
        ("GPGGA,221320.00,5818.000,N,01506.000,E,1,08,1.5,0,M,0,M,,", 4.5),
        ("GPGGA,221320.00,5818.000,N,01506.000,E,4,12,0.8,0,M,0,M,,", 0.016),
        ("GPGGA,221320.00,5818.000,N,01506.000,E,2,12,,0,M,0,M,,", math.nan),
        ("GPRMC,221320.00,A,5818.000,N,01506.000,E,1,0,141123,,,A", math.nan),
        ("GPGLL,5818.000,N,01506.000,E,221320.00,A,A", math.nan),
    ],
)
def test_fixes_come_with_the_time_of_the_nearest_day(body, sd, heard):
    message, reading = only(decoded(nmea("n", heard, Config()), sentence(body)))
    assert message.stamp == pytest.approx(1_700_000_000.0)  # 2023-11-14 22:13:20
    np.testing.assert_allclose(reading.values, [58.3, 15.1, sd])


def test_the_day_is_right_on_both_sides_of_midnight(heard):
    midnight = 1_700_006_400.0
    for arrival, clock, stamp in (
        (midnight + 1, "235959.50", midnight - 0.5),
        (midnight - 1, "000000.50", midnight + 0.5),
    ):
        body = f"GPGGA,{clock},5818.000,N,01506.000,E,1,08,1.5,0,M,0,M,,"
        message, _ = only(decoded(nmea("n", heard, Config()), sentence(body), arrival=arrival))
        assert message.stamp == pytest.approx(stamp)


@pytest.mark.parametrize(
    "body",
    [
        "GPGGA,221320.00,5818.000,N,01506.000,E,0,08,1.5,0,M,0,M,,",
        "GPGGA,221320.00,5818.000,N,01506.000,E,6,08,1.5,0,M,0,M,,",
        "GPRMC,221320.00,V,5818.000,N,01506.000,E,1,0,141123,,,A",
        "GPRMC,221320.00,A,5818.000,N,01506.000,E,1,0,141123,,,E",
        "GPGLL,5818.000,N,01506.000,E,221320.00,V,N",
        "GPGGA,221320.00,,,,,1,08,1.5,0,M,0,M,,",
        "GPGGA,221320.00,9918.000,N,01506.000,E,1,08,1.5,0,M,0,M,,",
        "GPGGA,221320.00,5818.000,X,01506.000,E,1,08,1.5,0,M,0,M,,",
        "GPZDA,221320.00,99,99,2023,00,00",
        "GPGSV,1,1,00",
    ],
)
def test_sentences_without_a_fix_give_none(body, heard):
    assert decoded(nmea("n", heard, Config()), sentence(body)) == []


def test_one_fix_in_three_sentences_counts_once(heard):
    data = (
        sentence("GPRMC,221320.00,A,5818.000,N,01506.000,E,1,0,141123,,,A")
        + sentence("GPGGA,221320.00,5818.000,N,01506.000,E,1,08,1.5,0,M,0,M,,")
        + sentence("GPGLL,5818.000,N,01506.000,E,221320.00,A,A")
    )
    assert len(decoded(nmea("n", heard, Config()), data, data, data)) == 1 + 3  # RMC until the first GGA


def test_sentences_with_errors_are_counted_and_the_next_ones_read(heard):
    whole = sentence("HEHDT,90.0,T")
    bad = [whole.replace(b"90", b"91"), b"$HEHDT,90.0,T\r\n", b"\xff\x00\x80 junk\r\n", b"junk" + whole]
    assert len(decoded(nmea("n", heard, Config()), *bad, whole)) == 2  # one behind junk, one whole
    assert heard.kinds == {"checksum": 2, "noise": 1}


def test_a_file_of_sentences_arrives_at_the_times_it_tells(tmp_path):
    path = tmp_path / "dive.nmea"
    heading, fix = sentence("HEHDT,90.0,T"), "GPRMC,2213%02d.00,A,5818.000,N,01506.000,E,1,0,141123,,,A"
    path.write_bytes(heading + sentence(fix % 20) + heading + sentence(fix % 21) + heading)
    warnings = Warnings()
    source = open_source(f"nmea:{path}?speed=max", warnings)
    arrivals = [m.arrival for m in source.messages(threading.Event())]
    np.testing.assert_allclose(arrivals, np.array([0, 0, 1, 1]) + ARRIVAL)
    assert warnings.counts == {(source.url, "no time"): 1}


# Files


def csv(path: Path, rows: int = 5) -> Path:
    lines = [f"{100 + 0.1 * i:.1f},1,2,-9.8,0.1,0.2,0.3,,,," for i in range(rows)]
    lines += ["100.05,,,,,,,0.4,0.1,0,", "100.25,,,,,,,,,,3.5"]
    path.write_text(
        "time,acc_x,acc_y,acc_z,gyr_x,gyr_y,gyr_z,dvl_vx,dvl_vy,dvl_vz,depth\n"
        + "\n".join(sorted(lines, key=lambda line: float(line.split(",")[0])))
    )
    return path


def test_a_replay_says_everything_of_the_log_in_the_order_of_time(tmp_path):
    path = csv(tmp_path / "log.csv")
    messages = list(open_source(f"file:{path}?speed=max").messages(threading.Event()))
    log = read_log(path)
    expected = list(log.measurements())
    assert [(m.stamp, m.arrival, m.readings[0].sensor) for m in messages] == [
        (e.time, e.time, e.sensor) for e in expected
    ]
    for message, measurement in zip(messages, expected, strict=True):
        np.testing.assert_array_equal(message.readings[0].values, measurement.values)


def test_fixes_in_degrees_are_replayed_in_degrees(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("time,fix_lat,fix_lon,fix_sd,fix_east_sd,fix_cov_ne\n1,58.3,15.1,2,3,-1.5\n2,58.31,15.2,,,\n")
    messages = list(open_source(f"file:{path}", speed="max").messages(threading.Event()))
    assert all(m.readings[0].sensor == GEODETIC for m in messages)
    np.testing.assert_allclose(
        [m.readings[0].values for m in messages],
        [[58.3, 15.1, 2, 3, -1.5, np.nan], [58.31, 15.2, *4 * [np.nan]]],
        atol=1e-9,
    )


class Clock(threading.Event):
    """A host's clock, and the event by which a replay waits and is stopped: time passes while it waits."""

    def __init__(self, until: float = math.inf) -> None:
        super().__init__()
        self.now, self.until = 0.0, until

    def monotonic(self) -> float:
        return self.now

    def time(self) -> float:
        return 1.7e9 + self.now

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self.now = min(self.now + timeout, self.until)
        if self.now == self.until:
            self.set()
        return self.is_set()


def test_a_replay_at_a_speed_takes_its_time_and_stops_when_told(tmp_path, monkeypatch):
    path = csv(tmp_path / "log.csv", rows=11)  # 1 s
    clock = Clock()
    monkeypatch.setattr("rovgraph.live.sources.source.time", clock)
    messages = list(open_source(f"file:{path}?speed=4").messages(clock))
    assert clock.now == pytest.approx(0.25)
    assert messages[0].arrival == 100.0
    clock.now, clock.until = 0.0, 0.25
    live = list(open_source(f"file:{path}?speed=1").messages(clock))
    assert clock.now == 0.25
    assert [m.stamp for m in live] == [m.stamp for m in messages if m.stamp < 100.25]


def test_at_the_speed_of_life_messages_arrive_by_the_hosts_clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr("rovgraph.live.sources.source.time", clock)
    recorded = [Message("f", 100.0 + t, 100.0 + t, ()) for t in (0.0, 0.05)]
    first, second = paced(recorded, 1.0, clock)
    assert clock.now == pytest.approx(0.05)
    assert first.arrival == 1.7e9
    assert second.arrival - first.arrival == pytest.approx(0.05, abs=1e-6)
    assert (first.stamp, second.stamp) == (100.0, 100.05)


# Feed


@dataclasses.dataclass
class Scripted:
    """A source that says numbers as depths."""

    url: str
    values: list[float]
    pace: float | None = None
    lossy: bool = False
    wait: float = 0.0
    fails: bool = False
    said: int = 0

    def messages(self, stop: threading.Event) -> Iterator[Message]:
        for value in self.values:
            if stop.wait(self.wait):
                return
            self.said += 1
            yield Message(self.url, value, value, (Reading("depth", np.array([value])),))
        if self.fails:
            raise RuntimeError("a fault")


def test_files_as_fast_as_they_go_are_merged_by_arrival_without_threads():
    feed = Feed([Scripted("a", [1, 4, 5], math.inf), Scripted("b", [2, 3, 6], math.inf)])
    before = threading.active_count()
    messages = []
    for message in feed:
        messages.append(message)
        assert threading.active_count() == before
    assert [(m.source, m.arrival) for m in messages] == [("a", 1), ("b", 2), ("b", 3), ("a", 4), ("a", 5), ("b", 6)]


def test_a_live_feed_ticks_in_silence_and_ends_with_its_last_source(monkeypatch):
    waits, heard = set(), threading.Event()

    class Queue(queue.Queue):
        def get(self, block=True, timeout=None):
            waits.add(timeout)
            return super().get(block, timeout)

    class Silent(Scripted):
        def messages(self, stop: threading.Event) -> Iterator[Message]:
            for message in super().messages(stop):
                heard.wait(HANGS_S)
                yield message

    monkeypatch.setattr("rovgraph.live.session.queue.Queue", Queue)
    said = []
    for message in Feed([Silent("a", [1, 2]), Scripted("b", [3])]):
        said.append(message)
        if said.count(None) == 3:
            heard.set()
    assert sorted(m.arrival for m in said if m is not None) == [1, 2, 3]
    assert said.index(None) < [m and m.source for m in said].index("a")
    assert waits - {None} == {0.1}


def test_a_source_that_can_wait_is_kept_waiting():
    source = Scripted("a", list(range(1000)))
    feed = Feed([source], size=10)
    messages = iter(feed)
    next(messages)
    time.sleep(0.2)
    assert source.said <= 13
    assert len([m for m in messages if m is not None]) == 999


def test_a_source_that_cannot_wait_loses_messages_and_it_is_complained_of():
    warnings, source = Warnings(), Scripted("a", list(range(1000)), lossy=True)
    feed = iter(Feed([source], warnings, size=10))
    first = next(feed)
    until(lambda: source.said == 1000)
    kept = [first, *(m for m in feed if m is not None)]
    lost = warnings.counts["a", "flood"]
    assert lost > 0
    assert len(kept) + lost == 1000


def test_a_source_that_fails_ends_alone():
    warnings = Warnings()
    messages = list(Feed([Scripted("a", [1], fails=True), Scripted("b", [2], wait=0.2)], warnings))
    assert sorted(m.arrival for m in messages if m is not None) == [1, 2]
    assert warnings.counts == {("a", "failed"): 1}


def test_closing_ends_the_iteration_and_the_threads():
    feed = Feed([Scripted("endless", [1.0] * 10**6, wait=0.001), Scripted("full", [1.0] * 10**6)], size=10)
    with feed:
        for count, _ in enumerate(feed):
            if count == 20:
                break
    assert len(list(feed)) <= 10, "what was queued, and no more"
    names = ("source endless", "source full")
    until(lambda: not any(t.name in names for t in threading.enumerate()))


INTERRUPTED = """
import sys
from rovgraph.live.session import Feed
from rovgraph.live.sources import open_sources
feed = Feed(open_sources(["-", "udp://:{udp}", "tcp://127.0.0.1:{tcp}"]))
print("ready", flush=True)
try:
    for message in feed:
        pass
except KeyboardInterrupt:
    sys.exit(7)
"""


@pytest.mark.slow
def test_an_interrupt_ends_a_program():
    code = INTERRUPTED.format(udp=free_port(), tcp=free_port())
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as program:
        assert program.stdout.readline() == b"ready\n"
        time.sleep(0.3)
        program.send_signal(signal.SIGINT)
        assert program.wait(HANGS_S) == 7
        assert program.stderr.read() == b""


def test_everything_together_over_the_loopback(tmp_path, impatient):
    udp = free_port()
    nmea_file = tmp_path / "heading.nmea"
    nmea_file.write_bytes(sentence("GPZDA,221320.00,14,11,2023,00,00") + sentence("HEHDT,90.0,T"))
    with server(lambda connection: (connection.sendall(report()), time.sleep(1.0))) as port:
        urls = [f"waterlinked://127.0.0.1:{port}", f"udp://:{udp}", f"nmea:{nmea_file}"]
        found = Counter()
        with Feed(open_sources(urls)) as feed, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(f"{{{IMU}}}".encode(), ("127.0.0.1", udp))
            begin = time.monotonic()
            for message in feed:
                if message is not None:
                    found.update(r.sensor for r in message.readings)
                if len(found) == 5 or time.monotonic() - begin > HANGS_S:
                    break
    assert found == {"dvl": 1, "dvl_altitude": 1, "dvl_beams": 1, "imu": 1, "ahrs": 1}


def test_a_gzipped_telemetry_log_and_a_plain_one_are_the_same(real_tlog, tmp_path):
    plain = tmp_path / "a.tlog"
    plain.write_bytes(gzip.decompress(real_tlog.read_bytes())[:60_000])
    packed_log = tmp_path / "b.tlog.gz"
    packed_log.write_bytes(gzip.compress(plain.read_bytes()))
    one, other = (
        [(m.stamp, m.arrival) for m in open_source(f"mavlink:{p}?speed=max").messages(threading.Event())]
        for p in (plain, packed_log)
    )
    assert one == other
    assert len(one) > 50


def test_thrusters_are_taken_from_the_first_on_without_a_hole(heard):
    decoder = json_lines("-", heard, Config())
    sent = (b'{"thruster_1": 1, "thruster_2": 2}', b'{"thruster_2": 2}', b'{"thruster_1": 1, "thruster_3": 3}')
    found = [decoded(decoder, line + b"\n") for line in sent]
    assert [[r.values.tolist() for m in messages for r in m.readings] for messages in found] == [[[1.0, 2.0]], [], []]
    assert heard.kinds == {"incomplete": 2}


@pytest.mark.parametrize("sd", [0, -1])
def test_an_sd_of_0_or_less_is_not_known(sd, heard):
    (message,) = decoded(json_lines("-", heard, Config()), b'{"fix_north": 1, "fix_east": 2, "fix_sd": %d}\n' % sd)
    np.testing.assert_array_equal(message.readings[0].values[:3], [1.0, 2.0, np.nan])
    assert not heard.kinds


def test_a_report_of_a_water_linked_dvl_among_json_lines_is_read_as_by_its_own_source(heard):
    decoders = waterlinked("w", heard), json_lines("-", heard, Config())
    (direct,), (passed_on,) = (decoded(decoder, report()) for decoder in decoders)
    assert direct.latency == pytest.approx(0.189319, abs=1e-6)
    assert (passed_on.stamp, passed_on.latency, passed_on.clock) == (direct.stamp, direct.latency, "DVL")
    np.testing.assert_array_equal(passed_on.readings[0].values, direct.readings[0].values)


def test_a_processing_time_that_cannot_be_is_none(heard):
    (message,) = decoded(waterlinked("w", heard), report(time_of_transmission=12))
    assert message.latency is None


def test_logs_of_different_epochs_are_refused_before_any_solution_and_both_are_named(tmp_path):
    imu, dvl = tmp_path / "imu.csv", tmp_path / "dvl.csv"
    imu.write_text("time,acc_x,acc_y,acc_z,gyr_x,gyr_y,gyr_z\n1,0,0,-9.8,0,0,0\n2,0,0,-9.8,0,0,0\n")
    dvl.write_text("time,dvl_vx,dvl_vy,dvl_vz\n1700000001,1,0,0\n1700000002,1,0,0\n")
    with pytest.raises(InputError, match=r"dvl\.csv: its times.*imu\.csv.*clocks have different epochs"):
        open_sources([f"file:{imu}", f"file:{dvl}"])


def test_logs_that_are_replayed_together_begin_together(tmp_path):
    early, late = tmp_path / "early.csv", tmp_path / "late.csv"
    early.write_text("time,depth\n10,1\n11,1\n")
    late.write_text("time,fix_north,fix_east\n10.5,0,0\n11,0,0\n")
    first, second = (source.messages(threading.Event()) for source in open_sources([f"file:{early}", f"file:{late}"]))
    before = next(first).arrival
    assert next(second).arrival - before == pytest.approx(0.5, abs=0.3)
