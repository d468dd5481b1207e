"""Files of an autopilot, byte by byte, for tests of their readers: DataFlash logs, telemetry logs, BlueOS recordings.

They are written by other libraries than those that read them: `struct`, pymavlink, and mcap's writer.
"""

import io
import json
import struct
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

import numpy as np
import pandas as pd
from mcap.writer import CompressionType, Writer
from pymavlink.dialects.v20 import ardupilotmega as mavlink

import rovgraph as rg
from rovgraph.geometry import wrap_angle
from rovgraph.simulate import Choices

PACKED = {"b": "b", "B": "B", "h": "h", "H": "H", "i": "i", "I": "I", "q": "q", "Q": "Q", "f": "f", "d": "d"} | {
    **{"c": "h", "C": "H", "e": "i", "E": "I", "L": "i"},
    "n": "4s",
    "N": "16s",
    "Z": "64s",
    "M": "B",
}
UNITS = {
    "s": "s",
    "#": "instance",
    "E": "rad/s",
    "o": "m/s/s",
    "G": "Gauss",
    "P": "Pa",
    "d": "deg",
    "h": "degheading",
} | {**{"m": "m", "n": "m/s", "r": "rad", "D": "deglatitude", "U": "deglongitude", "Y": "us", "-": "", "O": "degC"}}
MULTIPLIERS = {"-": 0.0, "?": 1.0, "0": 1.0, "B": 1e-2, "C": 1e-3, "F": 1e-6, "G": 1e-7}
# name -> type, format, columns, units, multipliers, as ArduPilot 4.1 declares them
FORMATS = {
    "UNIT": (129, "QbZ", "TimeUS,Id,Label", "s--", "F--"),
    "MULT": (130, "Qbd", "TimeUS,Id,Mult", "s--", "F--"),
    "FMTU": (131, "QBNN", "TimeUS,FmtType,UnitIds,MultIds", "s---", "F---"),
    "PARM": (132, "QNf", "TimeUS,Name,Value", "s--", "F--"),
    "MSG": (133, "QZ", "TimeUS,Message", "s-", "F-"),
    "IMU": (140, "QBffffffBB", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,GH,AH", "s#EEEooo--", "F-000000--"),
    "MAG": (141, "QBhhhhhhBI", "TimeUS,I,MagX,MagY,MagZ,OfsX,OfsY,OfsZ,Health,S", "s#GGGGGG-s", "F-CCCCCC-F"),
    "BARO": (142, "QBffcI", "TimeUS,I,Alt,Press,Temp,SMS", "s#mPOs", "F-00BC"),
    "ATT": (143, "QccC", "TimeUS,Roll,Pitch,Yaw", "sddh", "FBBB"),
    "VISO": (144, "Qffffffff", "TimeUS,dt,AngDX,AngDY,AngDZ,PosDX,PosDY,PosDZ,conf", "ssrrrmmm-", "FF000000-"),
    "VISV": (145, "QQIffffBB", "TimeUS,RTimeUS,CTimeMS,VX,VY,VZ,VErr,Rst,Ign", "sssnnnn--", "FFC0000--"),
    "RFND": (146, "QBCBB", "TimeUS,Instance,Dist,Stat,Orient", "s#m--", "F-B--"),
    "GPS": (147, "QBBIHBcLL", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng", "s#---SmDU", "F----0BGG"),
    "RCOU": (148, "QHHHHHHHH", "TimeUS,C1,C2,C3,C4,C5,C6,C7,C8", "sYYYYYYYY", "F--------"),
    "RTC": (149, "QQB", "TimeUS,Epoch,SourceType", "ss-", "FF-"),
    "XKF1": (150, "QBf", "TimeUS,C,Roll", "s#d", "F-0"),
}


@cache
def short_dive(declination_deg: float) -> pd.DataFrame:
    """Log of a simulated dive of 40 s with all that an autopilot measures; its compass is the autopilot's."""
    environment = {"declination_deg": declination_deg, "field_norm": 50.0}
    config = rg.Config.model_validate({"environment": environment})
    frame = rg.simulate("lawnmower", config, 3, Choices(duration=40.0)).dive.log_frame
    tilt = frame["dvl_heading"] * 0.0
    return frame.rename(columns={"dvl_heading": "ahrs_yaw"}).assign(ahrs_roll=tilt + 0.021, ahrs_pitch=tilt - 0.034)


class DataFlashWriter:
    """A DataFlash log, with declared units or without."""

    def __init__(self, units: bool = True, formats: Mapping[str, tuple[int, str, str, str, str]] = FORMATS) -> None:
        self._formats = dict(formats)
        self._parts = [self.format(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")]
        for name, (kind, form, columns, *_) in formats.items():
            self._parts.append(self.format(kind, 3 + struct.calcsize(self._struct(form)), name, form, columns))
        if units:
            for letter, label in UNITS.items():
                self.add("UNIT", 0, ord(letter), label.encode())
            for letter, factor in MULTIPLIERS.items():
                self.add("MULT", 0, ord(letter), factor)
            for kind, _, _, unit_ids, scale_ids in formats.values():
                self.add("FMTU", 0, kind, unit_ids.encode(), scale_ids.encode())

    @staticmethod
    def _struct(form: str) -> str:
        return "<" + "".join(PACKED[c] for c in form)

    @staticmethod
    def format(kind: int, length: int, name: str, form: str, columns: str) -> bytes:
        texts = (text.encode() for text in (name, form, columns))
        return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", kind, length, *texts)

    def add(self, name: str, *values: Any) -> "DataFlashWriter":
        kind, form, *_ = self._formats[name]
        if name != "MSG" and form[0] == "Q":
            values = (round(values[0]), *values[1:])
        self._parts.append(b"\xa3\x95" + bytes([kind]) + struct.pack(self._struct(form), *values))
        return self

    def parameters(self, **values: float) -> "DataFlashWriter":
        for name, value in values.items():
            self.add("PARM", 0, name.encode(), value)
        return self

    def raw(self, data: bytes) -> "DataFlashWriter":
        self._parts.append(data)
        return self

    def bytes(self) -> bytes:
        return b"".join(self._parts)


def in_order(frame: pd.DataFrame) -> Iterable[tuple[float, Mapping[str, float]]]:
    """Rows of a log, as time and what is filled."""
    for row in frame.to_dict("records"):
        yield row["time"], {k: v for k, v in row.items() if v == v and k != "time"}


def dataflash_of(frame: pd.DataFrame, declination: float, surface: float, units: bool = True) -> bytes:
    """A log of ArduSub that holds what a log of ours does.

    Parameters
    ----------
    declination : [rad], that the autopilot's heading includes
    surface : pressure [Pa]
    """
    writer = DataFlashWriter(units)
    writer.parameters(COMPASS_DEC=declination, BARO_PRIMARY=1, BARO_SPEC_GRAV=1.024, BARO2_GND_PRESS=surface)
    writer.parameters(**{f"SERVO{k}_FUNCTION": 32 + k for k in range(1, 7)})
    last_ping = None
    for time, row in in_order(frame):
        us = 1e6 * time
        if "acc_x" in row:
            writer.add("IMU", us, 0, *(row[f"gyr_{a}"] for a in "xyz"), *(row[f"acc_{a}"] for a in "xyz"), 1, 1)
        if "mag_x" in row:
            field = (round(10.0 * row[f"mag_{a}"]) for a in "xyz")
            writer.add("MAG", us, 0, *field, 0, 0, 0, 1, round(us) % 2**32)
        if "ahrs_yaw" in row:
            yaw = np.rad2deg(row["ahrs_yaw"] + declination) % 360.0
            roll, pitch = (round(100.0 * np.rad2deg(row.get(f"ahrs_{a}", 0.0))) for a in ("roll", "pitch"))
            writer.add("ATT", us, roll, pitch, round(100.0 * yaw) % 36000)
        if "depth" in row:
            writer.add("BARO", us, 0, 0.0, 99_000.0, 4700, round(1e-3 * us))  # within the hull
            writer.add("BARO", us, 1, 0.0, surface + 1024.0 * 9.81 * row["depth"], 1000, round(1e-3 * us))
        if "dvl_vx" in row:
            dt = 0.1 if last_ping is None else time - last_ping
            last_ping = time
            delta = [dt * row[f"dvl_v{a}"] for a in "xyz"]
            writer.add("VISO", us + 0.5e6 * dt, dt, 0, 0, 0, *delta, 90.0)  # of the interval's middle
        if "thruster_1" in row:
            writer.add("RCOU", us, *(round(1500 + 400 * row.get(f"thruster_{k}", -3.75)) for k in range(1, 9)))
    return writer.bytes()


def packed(message: Any, system: int = 1, component: int = 1) -> bytes:
    return bytes(message.pack(mavlink.MAVLink(None, srcSystem=system, srcComponent=component)))


def tlog(*frames: tuple[float, bytes]) -> bytes:
    """A telemetry log of frames and the times of their arrival [s]."""
    return b"".join(struct.pack(">Q", round(1e6 * time)) + frame for time, frame in frames)


def as_json(message: Any, system: int = 1, component: int = 1) -> tuple[str, bytes]:
    """Topic and content of a message as BlueOS records it: names of enumerations, no extensions."""
    fields = message.to_dict()
    name = fields.pop("mavpackettype")
    if name == "GPS_RAW_INT":
        for key in ("h_acc", "v_acc", "vel_acc", "hdg_acc", "yaw", "alt_ellipsoid"):
            del fields[key]
    if "type" in fields:
        fields["mavtype"] = fields.pop("type")
    if "fix_type" in fields:
        fields["fix_type"] = {"type": mavlink.enums["GPS_FIX_TYPE"][fields["fix_type"]].name}
    if "orientation" in fields:
        fields["orientation"] = {"type": mavlink.enums["MAV_SENSOR_ORIENTATION"][fields["orientation"]].name}
    if "param_id" in fields:
        fields["param_id"] = list(fields["param_id"].ljust(16, "\0"))
    fields = {key: None if isinstance(v, float) and v != v else v for key, v in fields.items()}
    header = {"system_id": system, "component_id": component, "sequence": 0}
    text = json.dumps({"header": header, "message": {"type": name, **fields}})
    return f"mavlink/{system}/{component}/{name}", text.encode()


def mcap(
    messages: Iterable[tuple[float, str, bytes]],
    compression: CompressionType = CompressionType.ZSTD,
    finish: bool = True,
) -> bytes:
    """A recording of (time [s], topic, content)."""
    out = io.BytesIO()
    writer = Writer(out, chunk_size=20_000, compression=compression)
    writer.start(profile="", library="tests")
    channels: dict[str, int] = {}
    for time, topic, data in messages:
        if topic not in channels:
            schema = writer.register_schema(topic.replace("/", "."), "jsonschema", b'{"type": "object"}')
            channels[topic] = writer.register_channel(topic, "json", schema)
        stamp = round(1e9 * time)
        writer.add_message(channels[topic], stamp, data, stamp)
    if finish:
        writer.finish()
    return out.getvalue()


def autopilot_messages(frame: pd.DataFrame, declination: float, surface: float) -> Iterable[tuple[float, Any]]:
    """What an autopilot and a DVL's driver say of a log of ours, in MAVLink: time [s] and message."""
    known = {"COMPASS_DEC": declination, "BARO_PRIMARY": 1, "BARO_SPEC_GRAV": 1.024, "BARO2_GND_PRESS": surface}
    for name, value in known.items():
        yield frame["time"].iloc[0], mavlink.MAVLink_param_value_message(name.encode(), value, 9, len(known), 0)
    for time, row in in_order(frame):
        us = round(1e6 * time)
        if "acc_x" in row:
            acc, gyr = ([row[f"{kind}_{a}"] for a in "xyz"] for kind in ("acc", "gyr"))
            yield time, mavlink.MAVLink_highres_imu_message(us, *acc, *gyr, 0, 0, 0, 0, 0, 0, 0, 0x3F)
        if "ahrs_yaw" in row:
            yaw = float(wrap_angle(row["ahrs_yaw"] + declination))
            yield (
                time,
                mavlink.MAVLink_attitude_message(
                    round(1e3 * time), row.get("ahrs_roll", 0.0), row.get("ahrs_pitch", 0.0), yaw, 0, 0, 0
                ),
            )
        if "depth" in row:
            hpa = 0.01 * (surface + 1024.0 * 9.81 * row["depth"])
            yield time, mavlink.MAVLink_scaled_pressure2_message(round(1e3 * time), hpa, 0.0, 1000)
        if "dvl_vx" in row:
            delta = [0.1 * row[f"dvl_v{a}"] for a in "xyz"]
            yield time, mavlink.MAVLink_vision_position_delta_message(us + 50_000, 100_000, [0.0] * 3, delta, 90.0)
