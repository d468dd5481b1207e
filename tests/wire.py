"""What instruments say, byte by byte, for tests of the sources; needs the extra ``online``."""

import json
from collections import Counter

import pynmea2
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from rovgraph.live.message import Message
from rovgraph.live.sources.mavlink import MavlinkDecoder, MavlinkOptions
from rovgraph.live.sources.source import Chunk, Decoder
from rovgraph.model.config import Config

ARRIVAL = 1_700_000_000.0


class Heard:
    """Warnings of a test, by kind."""

    def __init__(self) -> None:
        self.kinds: Counter[str] = Counter()
        self.texts: list[str] = []

    def __call__(self, kind: str, text: str, once: bool = False) -> None:
        self.kinds[kind] += 1
        self.texts.append(text)


def decoded(decoder: Decoder, *data: bytes, arrival: float = ARRIVAL) -> list[Message]:
    return [message for part in data for message in decoder.feed(Chunk(part, arrival))]


def report(**changes: object) -> bytes:
    velocity = {
        "time": 106.4,
        "vx": 0.5,
        "vy": -0.1,
        "vz": 0.02,
        "fom": 0.004,
        "covariance": [[1e-6, 0, 0], [0, 2e-6, 0], [0, 0, 9e-6]],
        "altitude": 1.5,
        "transducers": [{"id": i, "velocity": 0.1, "distance": 1.6, "beam_valid": True} for i in range(4)],
        "velocity_valid": True,
        "status": 0,
        "format": "json_v3.1",
        "type": "velocity",
        "time_of_validity": 1_638_191_471_563_017,
        "time_of_transmission": 1_638_191_471_752_336,
    } | changes
    return json.dumps({k: v for k, v in velocity.items() if v is not ...}).encode() + b"\r\n"


def packed(message, system: int = 1, component: int = 1) -> bytes:
    return message.pack(mavlink.MAVLink(None, srcSystem=system, srcComponent=component))


def raw_imu(usec: int = 5_000_000, acc=(10, -20, -1000), gyr=(1, 2, 3), mag=(200, 0, -400)) -> object:
    return mavlink.MAVLink_raw_imu_message(usec, *acc, *gyr, *mag)


def scaled_imu2(ms: int = 5000, acc=(1, 1, -1000), mag=(1, 1, 1)) -> object:
    return mavlink.MAVLink_scaled_imu2_message(ms, *acc, 0, 0, 0, *mag)


def highres_imu(fields: int = 0x1FF) -> object:
    return mavlink.MAVLink_highres_imu_message(
        6_000_000, 0.1, 0.2, -9.8, 0.01, 0.02, 0.03, 0.2, 0.0, -0.4, 0, 0, 0, 0, fields
    )


def pressure2(ms: int = 1000, hpa: float = 1013.25) -> object:
    return mavlink.MAVLink_scaled_pressure2_message(ms, hpa, 0.0, 1000)


def gps(usec: int = 7_000_000, fix_type: int = 3, lat: int = 583000000, lon: int = 151000000, **more: int) -> object:
    eph = more.pop("eph", 150)
    return mavlink.MAVLink_gps_raw_int_message(usec, fix_type, lat, lon, 0, eph, 65535, 0, 0, 9, **more)


def vision(confidence: float = 90.0, dt: int = 100_000, usec: int = 9_000_000) -> object:
    return mavlink.MAVLink_vision_position_delta_message(usec, dt, [0, 0, 0], [0.05, -0.01, 0.0], confidence)


def autopilot(heard: Heard, config: Config | None = None, **options: object) -> MavlinkDecoder:
    return MavlinkDecoder("m", heard, config or Config(), MavlinkOptions(**options))


def sentence(body: str) -> bytes:
    return f"${body}*{pynmea2.NMEASentence.checksum(body):02X}\r\n".encode()
