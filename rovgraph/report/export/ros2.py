"""ROS 2 bags (SQLite and MCAP) for RViz and Foxglove: odometry, path, tf and fixes, by REP 103 and 105.

ROS has x east, y north, z up and a body with x forward, y left, z up: both are turned here by `NED_TO_ENU` and
`FRD_TO_FLU`.
"""

import sqlite3
from pathlib import Path
from typing import Any

import numpy as np

from rovgraph.errors import InputError, in_one_line
from rovgraph.geometry import Array, quaternion_from_matrix, transpose
from rovgraph.report.export.formats import ExportFormat, ExportOptions
from rovgraph.report.export.track import Track

NED_TO_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD_TO_FLU = np.diag([1.0, -1.0, -1.0])
MAP, BODY = "map", "base_link"
PATH_POSES = 2000  # at most: a path is one message
COVARIANCE_KNOWN = 3  # COVARIANCE_TYPE_KNOWN
LATEST = 2.0**31  # seconds that a stamp of ROS holds
NO_FIX_TYPE = -1  # STATUS_NO_FIX: it is an estimate, no satellite's


def write_bag(track: Track, path: Path, options: ExportOptions, plugin: str) -> None:
    """``/odometry``, ``/path`` and ``/tf``, and ``/fix`` where the origin is known; at keyframes or at a rate.

    Raises
    ------
    InputError : times that ROS does not have
    """
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    begin, end = (float(track.trajectory.time[k]) for k in (0, -1))
    if begin < 0.0 or end >= LATEST:
        raise InputError(
            f"{track.name}: its time goes from {begin:g} to {end:g} s, and ROS's from 0 to {LATEST:g} s; state what "
            "to add as --unix-offset"
        )
    store = get_typestore(Stores.ROS2_HUMBLE)
    sampled = track.at_rate(options.rate)
    messages = RosMessages(store, sampled)
    topics = {
        "/odometry": ("nav_msgs/msg/Odometry", messages.odometry),
        "/tf": ("tf2_msgs/msg/TFMessage", messages.transform),
    }
    if track.origin is not None:
        topics["/fix"] = ("sensor_msgs/msg/NavSatFix", messages.position)
    with Writer(path, version=9, storage_plugin=StoragePlugin[plugin]) as bag:
        lines = {topic: bag.add_connection(topic, name, typestore=store) for topic, (name, _) in topics.items()}
        whole = bag.add_connection("/path", "nav_msgs/msg/Path", typestore=store)
        stamps = np.round(sampled.trajectory.time * 1e9).astype(np.int64).tolist()
        bag.write(whole, stamps[0], store.serialize_cdr(messages.path(), "nav_msgs/msg/Path"))
        for k, stamp in enumerate(stamps):
            for topic, (name, make) in topics.items():
                bag.write(lines[topic], stamp, store.serialize_cdr(make(k), name))


class RosMessages:
    """Messages of a track, in ROS's axes."""

    def __init__(self, store: Any, track: Track) -> None:
        self.types, t = store.types, track.trajectory
        self.time = t.time
        self.lat_lon = None if track.origin is None else np.column_stack(track.lat_lon)
        self.p = t.p_n @ NED_TO_ENU.T
        self.height = track.height
        R = NED_TO_ENU @ t.R_nb @ FRD_TO_FLU
        self.q = quaternion_from_matrix(R)
        self.v = np.einsum("nji,nj->ni", R, t.v_n @ NED_TO_ENU.T)  # in the body
        turned = NED_TO_ENU[None]
        self.cov_p = turned @ t.cov_p @ transpose(turned)
        self.cov_theta = turned @ t.cov_theta @ transpose(turned)
        body = transpose(R) @ turned
        self.cov_v = body @ t.cov_v @ transpose(body)

    def odometry(self, k: int) -> Any:
        """Pose in the map, velocity in the body, with covariances; what is not known is -1 first."""
        make = self._make
        return make(
            "nav_msgs/msg/Odometry",
            header=self._header(k),
            child_frame_id=BODY,
            pose=make(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=self._pose(k),
                covariance=_covariance(self.cov_p[k], self.cov_theta[k]),
            ),
            twist=make(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=make(
                    "geometry_msgs/msg/Twist", linear=self._vector(self.v[k]), angular=self._vector(np.zeros(3))
                ),
                covariance=_covariance(self.cov_v[k], np.full((3, 3), np.nan)),
            ),
        )

    def transform(self, k: int) -> Any:
        """From map to body."""
        make = self._make
        moved = make("geometry_msgs/msg/Transform", translation=self._vector(self.p[k]), rotation=self._rotation(k))
        stamped = make(
            "geometry_msgs/msg/TransformStamped", header=self._header(k), child_frame_id=BODY, transform=moved
        )
        return make("tf2_msgs/msg/TFMessage", transforms=[stamped])

    def position(self, k: int) -> Any:
        """Latitude, longitude and height with the covariance of east, north, up."""
        assert self.lat_lon is not None
        known = bool(np.isfinite(self.cov_p[k]).all())
        return self._make(
            "sensor_msgs/msg/NavSatFix",
            header=self._header(k, BODY),
            status=self._make("sensor_msgs/msg/NavSatStatus", status=NO_FIX_TYPE, service=0),
            latitude=float(self.lat_lon[k, 0]),
            longitude=float(self.lat_lon[k, 1]),
            altitude=float(self.height[k]),
            position_covariance=np.nan_to_num(self.cov_p[k]).ravel(),
            position_covariance_type=COVARIANCE_KNOWN if known else 0,
        )

    def path(self) -> Any:
        """The whole way, thinned."""
        chosen = np.unique(np.linspace(0, len(self.time) - 1, PATH_POSES).astype(int)).tolist()
        poses = [
            self._make("geometry_msgs/msg/PoseStamped", header=self._header(k), pose=self._pose(k)) for k in chosen
        ]
        return self._make("nav_msgs/msg/Path", header=self._header(0), poses=poses)

    def _make(self, name: str, **fields: Any) -> Any:
        return self.types[name](**fields)

    def _header(self, k: int, frame: str = MAP) -> Any:
        nanoseconds = round(float(self.time[k]) * 1e9)
        stamp = self._make("builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def _vector(self, xyz: Array) -> Any:
        return self._make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, xyz), strict=True)))

    def _rotation(self, k: int) -> Any:
        return self._make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, self.q[k]), strict=True)))

    def _pose(self, k: int) -> Any:
        point = self._make("geometry_msgs/msg/Point", **dict(zip("xyz", map(float, self.p[k]), strict=True)))
        return self._make("geometry_msgs/msg/Pose", position=point, orientation=self._rotation(k))


def _covariance(first: Array, second: Array) -> Array:
    """Row-major 6 x 6 of two blocks; -1 first where neither is known, as ROS has it."""
    out = np.zeros((6, 6))
    for block, values in ((slice(0, 3), first), (slice(3, 6), second)):
        if np.isfinite(values).all():
            out[block, block] = values
    if not out.any():
        out[0, 0] = -1.0
    return out.ravel()


def write_sqlite(track: Track, path: Path, options: ExportOptions) -> None:
    """A bag folder with an SQLite file."""
    try:
        write_bag(track, path, options, "SQLITE3")
    except sqlite3.Error as error:  # as of a full disk
        raise OSError(in_one_line(error)) from error


def write_mcap(track: Track, path: Path, options: ExportOptions) -> None:
    """A bag folder with an MCAP file."""
    write_bag(track, path, options, "MCAP")


FORMATS = (
    ExportFormat("rosbag2", "ROS 2 bag", "", write_sqlite, "ros"),
    ExportFormat("mcap", "ROS 2 bag (MCAP)", "", write_mcap, "ros"),
)
