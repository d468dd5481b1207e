"""Decoders take any bytes: none raises, nothing but sane numbers comes out, and what is good is read."""

import gzip
import json
import math
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from wire import (
    Heard,
    autopilot,
    decoded,
    gps,
    highres_imu,
    packed,
    raw_imu,
    report,
    scaled_imu2,
    sentence,
    vision,
)

from rovgraph.live.message import ON_EARTH, Message
from rovgraph.live.sources.doppler import waterlinked
from rovgraph.live.sources.json_lines import json_lines
from rovgraph.live.sources.links import timed_frames
from rovgraph.live.sources.nmea import nmea
from rovgraph.live.sources.source import Decoder
from rovgraph.log import STREAMS
from rovgraph.model.config import Config

TLOG = Path(__file__).parents[2] / "shared" / "data" / "ardusub" / "ardusub_small.tlog.gz"
LONGEST_FRAME = 293  # bytes of MAVLink
# sensor -> its first column that may be NaN
OPTIONAL = {"ahrs": 1, "dvl": 4, "fix": 2, "place": 1, "ship": 2, "usbl": 0, "range": 0, "dvl_beams": 0, "adcp": 0}
OPTIONAL |= dict.fromkeys(ON_EARTH, 2)

RAPID = settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.too_slow])

JSON = [
    b'{"time": 1.5, "acc_x": 0.1, "acc_y": 0, "acc_z": -9.8, "gyr_x": 0, "gyr_y": 0, "gyr_z": 0.1}',
    b'{"time": 1.6, "dvl_vx": 0.4, "dvl_vy": 0, "dvl_vz": null, "dvl_valid": 0, "depth": 3.25, "name": "a\\u00e5"}',
    b'{"fix_lat": 58.3, "fix_lon": 15.1, "fix_sd": 2, "mag_x": 1, "mag_y": 2, "mag_z": 3, "ahrs_yaw": 1e-3}',
]
NMEA = [
    sentence("HEHDT,94.5,T"),
    sentence("HCHDG,90.0,1.5,E,4.5,W"),
    sentence("GPZDA,221320.00,14,11,2023,00,00"),
    sentence("GPRMC,221320.00,A,5818.000,N,01506.000,E,1,0,141123,,,A"),
    sentence("GPGGA,221320.00,5818.000,N,01506.000,E,1,08,1.5,0,M,0,M,,"),
    sentence("GPGLL,5818.000,N,01506.000,E,221320.00,A,A"),
]
ACOUSTIC = [
    sentence("PSIMSSB,221320.40,B01,A,,C,H,M,10.0,20.0,30.0,0.5,N,,"),
    sentence("PSIMSNS,221320.40,B01,1,1,2.0,-1.0,0.0,91.0,,,0.0,,M"),
    sentence("PSONLLD,221320.52,2401,A,58.3315406,15.1356397,99.9,3.0,4.0,0.00,0.62,,,,"),
    b"USBLLONG,144.369001,144.132576,3,-0.0649,-3.3087,-0.9908,-3.0506,-0.5748,-1.5156,0.1,-0.0,-1.4,2303,-58,142,0.05\r\n",
]
ATTITUDE = mavlink.MAVLink_attitude_message(77_000, 0.1, 0.2, 0.3, 0, 0, 0)
MAVLINK = [packed(m) for m in (raw_imu(), scaled_imu2(), highres_imu(), gps(h_acc=900), vision())]

# name -> decoder, what it reads, one thing more that it reads, as a whole
DECODERS: dict[str, tuple[Callable[[Heard], Decoder], bytes, bytes]] = {
    "json": (lambda heard: json_lines("u", heard, Config()), b"\n".join(JSON * 3), b'\n{"depth": 7}\n'),
    "waterlinked": (lambda heard: waterlinked("u", heard), report() * 3, b"\n" + report(vx=7)),
    "nmea": (lambda heard: nmea("u", heard, Config()), b"".join(NMEA * 2), b"\n" + sentence("HEHDT,7.0,T")),
    "acoustic": (
        lambda heard: nmea("u", heard, Config()),
        b"".join((NMEA[4:5] + ACOUSTIC) * 2),
        b"\n" + ACOUSTIC[3],
    ),
    "mavlink": (autopilot, b"".join(MAVLINK * 3), packed(ATTITUDE)),
}


@st.composite
def mutations(draw: st.DrawFn, whole: bytes) -> bytes:
    """Real input with bytes flipped, dropped, doubled, put in, or its end cut off."""
    data = bytearray(whole)
    for _ in range(draw(st.integers(1, 6))):
        start = draw(st.integers(0, len(data)))
        end = min(len(data), start + draw(st.integers(0, 40)))
        match draw(st.sampled_from(["flip", "drop", "double", "insert", "truncate"])):
            case "flip" if start < len(data):
                data[start] ^= draw(st.integers(1, 255))
            case "drop":
                del data[start:end]
            case "double":
                data[start:start] = data[start:end]
            case "insert":
                data[start:start] = draw(st.binary(max_size=20))
            case "truncate":
                del data[max(start, len(data) // 2) :]
    return bytes(data)


def pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    places = sorted({0, len(data), *(cut % (len(data) + 1) for cut in cuts)})
    return [data[a:b] for a, b in pairwise(places)]


def assert_sane(messages: list[Message]) -> None:
    for message in messages:
        assert message.readings
        assert message.stamp is None or math.isfinite(message.stamp)
        assert math.isfinite(message.arrival)
        for sensor, values in message.readings:
            assert sensor in ON_EARTH or values.shape == (len(STREAMS[sensor]),)
            assert sensor not in ON_EARTH or 3 <= len(values) <= len(ON_EARTH[sensor])
            if sensor == "dvl" and values[3] == 0.0:
                continue
            assert np.isfinite(values[: OPTIONAL.get(sensor)]).all()
            if sensor in ON_EARTH:
                assert abs(values[0]) <= 90.0
                assert abs(values[1]) <= 360.0


@pytest.mark.parametrize("name", DECODERS)
@given(data=st.binary(max_size=400), cuts=st.lists(st.integers(0, 400), max_size=4))
@example(data=bytes(range(256)), cuts=[])
@example(data=b"\xfd" * 300, cuts=[1])
@example(data=b'{"time": 1e308, "depth": 1e308}\n', cuts=[])
@RAPID
def test_no_bytes_raise(name, data, cuts):
    decoder = DECODERS[name][0](Heard())
    assert_sane(decoded(decoder, *pieces(data, cuts)))


@pytest.mark.parametrize("name", DECODERS)
@given(draw=st.data(), cuts=st.lists(st.integers(0, 2000), max_size=4))
@RAPID
def test_what_is_whole_is_read_after_what_is_broken(name, draw, cuts):
    make, real, more = DECODERS[name]
    decoder = make(Heard())
    broken = decoded(decoder, *pieces(draw.draw(mutations(real)), cuts))
    # what looks like the beginning of a frame may reach that far, and that it is none shows only then
    times = 1 + math.ceil(LONGEST_FRAME / len(more)) if name == "mavlink" else 1
    good = decoded(decoder, *[more] * times, bytes(LONGEST_FRAME))
    assert_sane(broken + good)
    (expected,) = decoded(make(Heard()), more)
    assert good[-1].stamp == expected.stamp
    np.testing.assert_array_equal(good[-1].readings[0].values, expected.readings[0].values)


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=5,
)


@given(
    row=st.dictionaries(
        st.sampled_from(["time", *(c for cs in STREAMS.values() for c in cs), "fix_lat", "fix_lon"]), json_values
    )
)
@example(row={"place_id": 0.0})
@RAPID
def test_no_json_value_raises(row):
    line = json.dumps(row).encode() + b"\n"
    assert_sane(decoded(json_lines("u", Heard(), Config()), line))


WATERLINKED_KEYS = [
    "vx",
    "vy",
    "vz",
    "fom",
    "covariance",
    "altitude",
    "velocity_valid",
    "status",
    "format",
    "type",
    "time_of_validity",
]


@given(changes=st.dictionaries(st.sampled_from(WATERLINKED_KEYS), json_values))
@RAPID
def test_no_report_raises(changes):
    assert_sane(decoded(waterlinked("u", Heard()), report(**changes)))


@given(fields=st.lists(st.text(st.characters(codec="ascii", exclude_characters="*$\r\n"), max_size=8), max_size=15))
@pytest.mark.parametrize("kind", ["HDT", "HDG", "HDM", "GGA", "RMC", "GLL", "ZDA"])
@settings(parent=RAPID, max_examples=40)
def test_no_sentence_with_a_right_checksum_raises(kind, fields):
    data = sentence(",".join([f"GP{kind}", *fields]))
    assert_sane(decoded(nmea("u", Heard(), Config()), data))
    assert_sane(decoded(nmea("u", Heard(), Config(), recorded=True), data, data))


def recorded_frames(messages: list[bytes]) -> bytes:
    return b"".join((1_683_220_541_000_000 + 10_000 * i).to_bytes(8, "big") + m for i, m in enumerate(messages))


@given(draw=st.data())
@RAPID
def test_a_broken_telemetry_log_is_read_on_with_times_that_can_be(draw):
    tail = recorded_frames([packed(ATTITUDE)] * 12)
    data = draw.draw(mutations(recorded_frames(MAVLINK * 4))) + tail
    chunks = list(timed_frames(data))
    assert all(946_684_800 < chunk.arrival < 4_102_444_800 for chunk in chunks)
    decoder = autopilot(Heard())
    messages = [message for chunk in chunks for message in decoder.feed(chunk)]
    assert_sane(messages)
    assert messages[-1].stamp == 77.0


@given(data=st.binary(max_size=600))
@RAPID
def test_no_bytes_of_a_telemetry_log_raise(data):
    decoder = autopilot(Heard())
    assert_sane([m for chunk in timed_frames(data) for m in decoder.feed(chunk)])


def test_a_real_telemetry_log_with_errors_loses_little():
    """One byte in two thousand wrong, dropped or doubled: each costs at most the frames beside it."""
    if not TLOG.exists():
        pytest.skip("data/ardusub does not lie beside the checkout")
    whole = gzip.decompress(TLOG.read_bytes())[:300_000]
    rng = np.random.default_rng(0)
    data, places = bytearray(whole), np.sort(rng.choice(len(whole), len(whole) // 2000, replace=False))[::-1]
    for place in places.tolist():
        match rng.integers(3):
            case 0:
                data[place] ^= int(rng.integers(1, 256))
            case 1:
                del data[place]
            case 2:
                data.insert(place, int(rng.integers(256)))

    def read(content: bytes) -> Iterator[Message]:
        decoder = autopilot(Heard())
        return (m for chunk in timed_frames(content) for m in decoder.feed(chunk))

    clean, noisy = ({(m.stamp, m.readings[0].sensor) for m in read(c)} for c in (whole, bytes(data)))
    assert len(clean - noisy) <= 2 * len(places)
    assert len(clean & noisy) > 0.8 * len(clean)
    assert not noisy - clean
