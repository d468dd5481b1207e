"""Doppler instruments as live sources: what they send is what their files say, whatever the pieces it comes in."""

import socket
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest
from doppler_files import EARTH, UNIX, nucleus_ahrs, nucleus_record, nucleus_track, pd4_frame, pd6_ping, trdi_values
from hypothesis import given
from hypothesis import strategies as st
from wire import ARRIVAL, Heard, decoded, sentence

from rovgraph.errors import InputError
from rovgraph.live.message import Message
from rovgraph.live.sources import open_source
from rovgraph.live.sources.doppler import NucleusDecoder, Pd4Decoder, pd6, tracker
from rovgraph.live.sources.source import Decoder
from rovgraph.live.warnings import Warnings

MOVED, RPY = (0.5, 0.1, -0.02), (0.01, 0.02, 1.0)
NUCLEUS = b"".join(
    (
        nucleus_record(0x82, UNIX, [0.1, 0.2, -9.8, 0.01, 0.02, 0.03, 20.0]),
        nucleus_ahrs(UNIX + 0.1, RPY, 5.0),
        nucleus_track(UNIX + 0.2, MOVED),
    )
)
PD5 = b"".join(
    pd4_frame(t, trdi_values(MOVED, EARTH, (0.0, 0.0, 1.0)), EARTH, rpy=(0.0, 0.0, 1.0)) for t in (86399.5, 0.5)
)
SENT: dict[str, tuple[Callable[[str, Heard], Decoder], bytes]] = {
    "pd4": (Pd4Decoder, PD5),
    "pd6": (pd6, pd6_ping(UNIX, MOVED, RPY) + pd6_ping(UNIX + 1, MOVED, RPY)),
    "nucleus": (NucleusDecoder, NUCLEUS + nucleus_track(UNIX + 1.2, MOVED)),
}


def test_ways_of_a_tracker_are_mean_velocities_in_the_middle_of_their_interval():
    """Without confidence a ping is lost, whatever stands in it; other sentences of the instrument say nothing."""
    heard = Heard()
    data = (
        b"$DVPDL,2000000,100000,0,0,0,0.05,0.01,-0.002,95\r\n"
        + sentence("DVPDX,2100000,200000,0,0,0,0.1,0.02,-0.004,80,1,0.1,0.2,1.5")
        + b"$DVPDL,2200000,100000,0,0,0,9.0,9.0,9.0,0\r\n$DVKFC,1,2,3\r\n"
        + sentence("DVPDL,2300000,100000,0,0,0,0.05,0.01,-0.002,95").replace(b"0.05", b"0.07")
    )
    messages = decoded(tracker("u", heard), data)
    assert [stamp for stamp, _ in pings(messages)] == pytest.approx([1.95, 2.0, 2.15])
    (_, first), (_, second), (_, lost) = pings(messages)
    np.testing.assert_allclose(first[:4], [0.5, 0.1, -0.02, 1.0])
    np.testing.assert_allclose(second[:4], [0.5, 0.1, -0.02, 1.0])
    assert lost[3] == 0.0 and np.isnan(lost[:3]).all() and not heard.kinds


def pings(messages: list[Message]) -> list[tuple[float | None, np.ndarray]]:
    return [(m.stamp, r.values) for m in messages for r in m.readings if r.sensor == "dvl"]


def heard_sensors(messages: list[Message]) -> set[str]:
    return {reading.sensor for message in messages for reading in message.readings}


@pytest.mark.parametrize("name", SENT)
@pytest.mark.parametrize("size", [1, 7, 10_000])
def test_messages_are_the_same_whatever_pieces_the_bytes_come_in(name, size):
    make, data = SENT[name]
    heard = Heard()
    messages = decoded(make("u", heard), *(data[k : k + size] for k in range(0, len(data), size)))
    first, second = pings(messages)
    for _, values in (first, second):
        np.testing.assert_allclose(values[:4], [*MOVED, 1.0], atol=1e-3)
    assert (second[0] - first[0]) % 86400.0 == pytest.approx(1.0, abs=1e-3)  # times of day are continued by `Clocks`
    assert {"dvl", "dvl_altitude", "depth"} <= heard_sensors(messages)
    assert not heard.kinds


def test_a_nucleus_is_an_imu_and_an_ahrs_too():
    messages = decoded(NucleusDecoder("u", Heard()), NUCLEUS)
    assert {"imu", "ahrs"} <= heard_sensors(messages)
    assert {message.clock for message in messages} == {"unix"}
    since_start = nucleus_record(0x82, 12.0, [0.1, 0.2, -9.8, 0.01, 0.02, 0.03, 20.0], posix=False)
    (message,) = decoded(NucleusDecoder("u", Heard()), since_start)
    assert (message.stamp, message.clock) == (12.0, "boot")


def test_a_nucleus_that_asks_for_a_password_is_reported():
    heard = Heard()
    assert decoded(NucleusDecoder("u", heard), b"Please enter password:\r\n") == []
    assert heard.kinds["password"] == 1


@pytest.mark.parametrize("name", SENT)
@given(noise=st.binary(max_size=300), cut=st.integers(1, 40))
def test_noise_and_a_broken_message_cost_no_later_one(name, noise, cut):
    make, data = SENT[name]
    decoder = make("u", Heard())
    end = b"\r\n" if name == "pd6" else b""
    messages = decoded(decoder, noise + data[:cut] + end, bytes(20_000) + end, data)
    assert len(pings(messages)) >= 2
    assert all(np.isfinite(m.arrival) and m.arrival == ARRIVAL for m in messages)


@pytest.mark.parametrize("name", SENT)
def test_an_instrument_at_a_tcp_port_is_read(name):
    data = SENT[name][1]
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        connection, _ = listener.accept()
        with connection:
            for part in (data[:5], data[5:60], data[60:]):
                connection.sendall(part)
                time.sleep(0.01)
            time.sleep(0.5)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    stop, warnings, found = threading.Event(), Warnings(), []
    timer = threading.Timer(10.0, stop.set)
    timer.start()
    with listener:
        source = open_source(f"{name}:tcp://127.0.0.1:{listener.getsockname()[1]}", warnings)
        for message in source.messages(stop):
            found.append(message)
            if len(pings(found)) == 2:
                break
    stop.set()
    timer.cancel()
    thread.join(2.0)
    assert len(pings(found)) == 2
    assert not warnings.counts


@pytest.mark.parametrize("name", SENT)
def test_addresses_are_checked_as_those_of_other_sources(name):
    assert open_source(f"{name}:/dev/ttyUSB0?baud=9600").link._baud == 9600
    with pytest.raises(InputError, match=f"expected {name}:tcp://host:port"):
        open_source(f"{name}:dive.bin")
    with pytest.raises(InputError, match="unknown option 'baud'"):
        open_source(f"{name}:tcp://127.0.0.1:9?baud=9600")
