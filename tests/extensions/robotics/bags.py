"""Bags written with the libraries' own writers, whose values are known."""

from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)

Messages = list[tuple[str, int, Any]]
"""Topic, time of recording (ns) and message of each."""


def msg(kind: str, *args: Any, **fields: Any) -> Any:
    """Return a message of `package/Type`."""
    package, _, name = kind.partition("/")
    return STORE.types[f"{package}/msg/{name}"](*args, **fields)


def header(t: int) -> Any:
    return msg("std_msgs/Header", msg("builtin_interfaces/Time", t // 10**9, t % 10**9), "map")


def xyz(x: float, y: float, z: float, kind: str = "Vector3") -> Any:
    return msg(f"geometry_msgs/{kind}", x, y, z)


def joints(t: int, names: list[str], position: list[float]) -> Any:
    empty = np.zeros(0)
    return msg("sensor_msgs/JointState", header(t), names, np.array(position, float), empty, empty)


def fix(
    t: int, latitude: float, longitude: float, variances: tuple[float, ...], status: int = 0, known: int = 2
) -> Any:
    state = msg("sensor_msgs/NavSatStatus", status, 1)
    return msg("sensor_msgs/NavSatFix", header(t), state, latitude, longitude, 500.0, np.diag(variances).ravel(), known)


def imu(t: int, yaw_rate: float, orientation: tuple[float, ...] | None) -> Any:
    unknown = np.zeros(9)
    unknown[0] = -1.0
    x, y, z, w = orientation or (0.0, 0.0, 0.0, 1.0)
    return msg(
        "sensor_msgs/Imu", header(t), msg("geometry_msgs/Quaternion", x, y, z, w),
        np.zeros(9) if orientation else unknown, xyz(0.0, 0.0, yaw_rate), np.diag([1.0, 2.0, 3.0]).ravel(),
        xyz(0.0, 0.0, 9.8), np.zeros(9),
    )  # fmt: skip


def odometry(t: int, x: float, speed: float, variance: float) -> Any:
    pose = msg("geometry_msgs/Pose", xyz(x, 0.0, 0.0, "Point"), msg("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0))
    twist = msg("geometry_msgs/Twist", xyz(speed, 0.0, 0.0), xyz(0.0, 0.0, 0.1))
    cov = np.diag([variance, *np.arange(2.0, 7.0)]).ravel()
    return msg(
        "nav_msgs/Odometry", header(t), "base", msg("geometry_msgs/PoseWithCovariance", pose, cov),
        msg("geometry_msgs/TwistWithCovariance", twist, 2 * cov),
    )  # fmt: skip


def write_folder(path: Path, messages: Messages, storage: str = "mcap", *, packed: bool = False) -> Path:
    """Write a folder as `ros2 bag record` does, with each message compressed if `packed`; return it."""
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    writer = Writer(path, version=9, storage_plugin=plugin)
    if packed:
        writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        known: dict[str, Any] = {}
        for topic, t, message in messages:
            kind = message.__msgtype__
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(known[topic], t, STORE.serialize_cdr(message, kind))
    return path


def write_mcap(
    path: Path,
    messages: Messages,
    *,
    profile: str = "",
    encoding: str = "cdr",
    compression: CompressionType = CompressionType.ZSTD,
) -> Path:
    """Write a single MCAP of many small chunks, as other loggers do; return it."""
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=4000, compression=compression)
        writer.start(profile=profile)
        known: dict[str, int] = {}
        for topic, t, message in messages:
            kind = message.__msgtype__
            if topic not in known:
                text = STORE.generate_msgdef(kind, ros_version=2)[0].encode()
                known[topic] = writer.register_channel(topic, encoding, writer.register_schema(kind, "ros2msg", text))
            writer.add_message(known[topic], t, bytes(STORE.serialize_cdr(message, kind)), t)
        writer.finish()
    return path
