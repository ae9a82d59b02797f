"""Writes the ROS 2 bag that the tests of `parallax import` read, by the PyPI package `rosbags` (0.11.9).

Usage: make_bag.py FOLDER [mcap|sqlite3]
"""

import math
import sys
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS2_HUMBLE)
t = store.types
Header, Time = t["std_msgs/msg/Header"], t["builtin_interfaces/msg/Time"]
START = 1_700_000_000_000_000_000


def header(stamp, frame=""):
    return Header(stamp=Time(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id=frame)


def vector(x, y, z):
    return t["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)


def main():
    out, plugin = Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else "mcap"
    writer = Writer(out, version=9, storage_plugin=StoragePlugin[plugin.upper()])
    if plugin == "mcap":
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        topics = {
            "/joint_states": "sensor_msgs/msg/JointState",
            "/effort_cmd": "std_msgs/msg/Float64",
            "/gains": "std_msgs/msg/Float64MultiArray",
            "/cmd_vel": "geometry_msgs/msg/Twist",
            "/imu": "sensor_msgs/msg/Imu",
            "/camera": "sensor_msgs/msg/CompressedImage",
            "/odom": "nav_msgs/msg/Odometry",
            "/ft": "geometry_msgs/msg/WrenchStamped",
        }
        con = {
            name: writer.add_connection(name, kind, typestore=store)
            for name, kind in topics.items()
        }

        def send(topic, when, message):
            writer.write(con[topic], when, store.serialize_cdr(message, topics[topic]))

        for k in range(50):
            now = START + k * 10_000_000
            s = k * 0.01
            q, u = math.sin(6 * s), math.cos(6 * s)
            send("/effort_cmd", now, t["std_msgs/msg/Float64"](data=u))
            # The state arrives 2 ms after it was true, and with an arm whose second joint comes every other time.
            names = ["shoulder", "elbow"] if k % 2 == 0 else ["shoulder"]
            send(
                "/joint_states",
                now + 2_000_000,
                t["sensor_msgs/msg/JointState"](
                    header=header(now),
                    name=names,
                    position=np.array([q, -q][: len(names)]),
                    velocity=np.array([6 * u, -6 * u][: len(names)]),
                    effort=np.array([]),
                ),
            )
            send(
                "/cmd_vel",
                now,
                t["geometry_msgs/msg/Twist"](
                    linear=vector(0.5 * u, 0.0, 0.0), angular=vector(0.0, 0.0, q)
                ),
            )
            if k % 5 == 0:
                zero9, zero36 = np.zeros(9), np.zeros(36)
                send(
                    "/imu",
                    now + 1_000_000,
                    t["sensor_msgs/msg/Imu"](
                        header=header(now),
                        orientation=t["geometry_msgs/msg/Quaternion"](
                            x=0.0, y=0.0, z=0.0, w=1.0
                        ),
                        orientation_covariance=zero9,
                        angular_velocity=vector(0.0, 0.0, q),
                        angular_velocity_covariance=zero9,
                        linear_acceleration=vector(0.0, 0.0, 9.81),
                        linear_acceleration_covariance=zero9,
                    ),
                )
                pose = t["geometry_msgs/msg/Pose"](
                    position=t["geometry_msgs/msg/Point"](x=s, y=0.0, z=0.0),
                    orientation=t["geometry_msgs/msg/Quaternion"](
                        x=0.0, y=0.0, z=0.0, w=1.0
                    ),
                )
                send(
                    "/odom",
                    now,
                    t["nav_msgs/msg/Odometry"](
                        header=header(now),
                        child_frame_id="base",
                        pose=t["geometry_msgs/msg/PoseWithCovariance"](
                            pose=pose, covariance=zero36
                        ),
                        twist=t["geometry_msgs/msg/TwistWithCovariance"](
                            twist=t["geometry_msgs/msg/Twist"](
                                linear=vector(1.0, 0.0, 0.0),
                                angular=vector(0.0, 0.0, 0.0),
                            ),
                            covariance=zero36,
                        ),
                    ),
                )
                send(
                    "/ft",
                    now,
                    t["geometry_msgs/msg/WrenchStamped"](
                        header=header(now),
                        wrench=t["geometry_msgs/msg/Wrench"](
                            force=vector(1.0, 2.0, 3.0), torque=vector(0.1, 0.2, 0.3)
                        ),
                    ),
                )
                send(
                    "/gains",
                    now,
                    t["std_msgs/msg/Float64MultiArray"](
                        layout=t["std_msgs/msg/MultiArrayLayout"](
                            dim=[], data_offset=0
                        ),
                        data=np.array([1.0, 2.0]),
                    ),
                )
                send(
                    "/camera",
                    now,
                    t["sensor_msgs/msg/CompressedImage"](
                        header=header(now),
                        format="png",
                        data=np.zeros(200, dtype=np.uint8),
                    ),
                )


main()
