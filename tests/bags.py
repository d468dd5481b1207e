"""ROS bags of simulated dives, for tests of their reader."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from rosbags.interfaces import ConnectionExtRosbag2
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rovgraph.readers.rosbag import ALL_DEFINITIONS

START = 1_700_000_000.0
SURFACE, SEA, GRAVITY = 101_325.0, 1025.0, 9.81
FORMS = ("ros1", "sqlite", "mcap")


class Sent(NamedTuple):
    """A message of a bag: times in seconds since `START`; of ``fields`` nested ones are dictionaries."""

    time: float
    topic: str
    type: str
    fields: dict[str, Any]
    frame: str = "sensor"
    stamp: float | None = None  # None: as time; absolute otherwise


def store(form: str) -> Any:
    found = get_typestore(Stores.ROS1_NOETIC if form == "ros1" else Stores.ROS2_HUMBLE)
    tf = {"tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n"}
    for name, text in (ALL_DEFINITIONS | (tf if form == "ros1" else {})).items():
        found.register(get_types_from_msg(text, name))
    return found


def xyz(*values: float) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


def imu(time: float, acc: Any, gyr: Any, q: Any = (0.0, 0.0, 0.0, 0.0), **changes: Any) -> Sent:
    fields = {
        "orientation": dict(zip("xyzw", map(float, q), strict=True)),
        "orientation_covariance": np.zeros(9),
        "angular_velocity": xyz(*gyr),
        "angular_velocity_covariance": np.zeros(9),
        "linear_acceleration": xyz(*acc),
        "linear_acceleration_covariance": np.zeros(9),
    }
    return Sent(time, "/imu/data", "sensor_msgs/msg/Imu", fields, "imu_link")._replace(**changes)


def marine_dvl(time: float, v: Any, valid: bool = True, sd: float = 0.01, **changes: Any) -> Sent:
    fields = {
        "velocity_mode": 1,
        "dvl_type": 0,
        "velocity": xyz(*np.nan_to_num(v)),
        "velocity_covar": (np.eye(3) * sd**2).ravel() if sd > 0.0 else np.full(9, -1.0),
        "altitude": 2.5 if valid else -1.0,
        "course_gnd": 0.0,
        "speed_gnd": 0.0,
        "num_good_beams": 4 if valid else 0,
        "sound_speed": 1500.0,
        "beam_ranges_valid": valid,
        "beam_velocities_valid": valid,
        "beam_unit_vec": [xyz(0, 0, 1)] * 4,
        "range": np.full(4, 2.6),
        **{name: np.zeros(4, np.float32) for name in ("range_covar", "beam_quality", "beam_velocity")},
        "beam_velocity_covar": np.full(4, -1.0, np.float32),
    }
    return Sent(time, "/dvl", "marine_acoustic_msgs/msg/Dvl", fields, "dvl_link")._replace(**changes)


def pressure(time: float, pascal: float) -> Sent:
    fields = {"fluid_pressure": pascal, "variance": 0.0}
    return Sent(time, "/pressure", "sensor_msgs/msg/FluidPressure", fields, "pressure_link")


def mag(time: float, microtesla: Any) -> Sent:
    fields = {"magnetic_field": xyz(*(1e-6 * v for v in microtesla)), "magnetic_field_covariance": np.zeros(9)}
    return Sent(time, "/imu/mag", "sensor_msgs/msg/MagneticField", fields, "imu_link")


def transform(parent: str, child: str, xyzw: Any = (0, 0, 0, 1), at: Any = (0, 0, 0)) -> Sent:
    moved = {"translation": xyz(*at), "rotation": dict(zip("xyzw", map(float, xyzw), strict=True))}
    stamped = {"header": {"frame_id": parent}, "child_frame_id": child, "transform": moved}
    return Sent(0.0, "/tf_static", "tf2_msgs/msg/TFMessage", {"transforms": [stamped]})


def of_dive(frame: pd.DataFrame) -> list[Sent]:
    """Messages with what a log's rows hold of IMU, magnetometer, DVL and depth; pressure is absolute."""
    sent = []
    for row in frame.to_dict("records"):
        time = row["time"]
        if row["acc_x"] == row["acc_x"]:
            sent.append(imu(time, [row[f"acc_{a}"] for a in "xyz"], [row[f"gyr_{a}"] for a in "xyz"]))
        if row["mag_x"] == row["mag_x"]:
            sent.append(mag(time, [row[f"mag_{a}"] for a in "xyz"]))
        if row["dvl_vx"] == row["dvl_vx"]:
            sent.append(marine_dvl(time, [row[f"dvl_v{a}"] for a in "xyz"]))
        if row["depth"] == row["depth"]:
            sent.append(pressure(time, SURFACE + SEA * GRAVITY * row["depth"]))
    return sent


class Maker:
    """Makes messages of a type store."""

    def __init__(self, form: str) -> None:
        self.store, self._ros1, self._seq = store(form), form == "ros1", 0

    def message(self, sent: Sent) -> bytes:
        fields = dict(sent.fields)
        names = [name for name, _ in self.store.fielddefs[sent.type][1]]
        if "header" in names:
            fields["header"] = {
                "stamp": START + sent.time if sent.stamp is None else sent.stamp,
                "frame_id": sent.frame,
            }
        made = self._made(sent.type, fields)
        write = self.store.serialize_ros1 if self._ros1 else self.store.serialize_cdr
        return bytes(write(made, sent.type))

    def _made(self, kind: str, fields: dict[str, Any]) -> Any:
        made = {}
        for name, (form, of) in self.store.fielddefs[kind][1]:
            value = fields.get(name, 0)
            if name == "seq":
                value = 0
            elif kind.endswith("/Header") and name == "stamp":
                ns = round(1e9 * fields.get("stamp", 0.0))
                value = self.store.types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
            elif form.name == "NAME":
                value = self._made(of, value or {})
            elif form.name in ("ARRAY", "SEQUENCE") and of[0][0].name == "NAME":
                value = [self._made(of[0][1], each) for each in value or []]
            made[name] = value
        return self.store.types[kind](**made)


def opened(path: Path, form: str) -> Any:
    """A writer of a bag, for a ``with``."""
    if form == "ros1":
        return Writer1(path)
    plugin = StoragePlugin.MCAP if form == "mcap" else StoragePlugin.SQLITE3
    return Writer2(path, version=9, storage_plugin=plugin)


def write(path: Path, form: str, sent: Iterable[Sent], definitions: bool = True) -> Path:
    """A bag, a file for ROS 1 and a folder otherwise.

    Parameters
    ----------
    definitions : whether the bag holds those of its types, as it does since ROS 2 Iron
    """
    maker = Maker(form)
    with opened(path, form) as bag:
        lines: dict[str, Any] = {}
        for each in sent:
            if each.topic not in lines:
                lines[each.topic] = bag.add_connection(each.topic, each.type, typestore=maker.store)
                assert form == "ros1" or isinstance(lines[each.topic].ext, ConnectionExtRosbag2)
            bag.write(lines[each.topic], round(1e9 * (START + each.time + 0.004)), maker.message(each))
    if not definitions:
        import sqlite3

        (file,) = path.glob("*.db3")
        with sqlite3.connect(file) as base:
            base.execute("UPDATE message_definitions SET encoded_message_definition='', encoding=''")
            base.execute("DELETE FROM message_definitions")
    return path
