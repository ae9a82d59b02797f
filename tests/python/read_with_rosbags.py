"""Reads a recording with the public Python package `rosbags`, as a ROS 2 tool would, and prints what it holds.

Usage: read_with_rosbags.py RECORDING.mcap

Prints one JSON object: for each topic the type of its messages, and every message as [time, value], where a value maps
field names to numbers, texts and lists. Nothing of Parallax and nothing of ROS is imported: the types come from the file.
"""

import dataclasses
import json
import struct
import sys
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader


def plain(value):
    """A decoded message as JSON can hold it; a float as its bits, so that the comparison is exact."""
    if isinstance(value, float):
        return {"f64": struct.unpack("<Q", struct.pack("<d", value))[0]}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, list):
        return [plain(item) for item in value]
    names = (field.name for field in dataclasses.fields(value))
    return {name: plain(getattr(value, name)) for name in names if not name.startswith("__")}


def main():
    topics = {}
    with AnyReader([Path(sys.argv[1])]) as reader:
        for connection, time, data in reader.messages():
            topic = topics.setdefault(connection.topic, {"type": connection.msgtype, "messages": []})
            topic["messages"].append([time, plain(reader.deserialize(data, connection.msgtype))])
    json.dump(topics, sys.stdout)


main()
