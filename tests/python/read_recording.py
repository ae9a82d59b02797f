"""Reads a recording with the public Python packages `mcap` and `mcap-ros2-support`, and prints what it holds.

Usage: read_recording.py RECORDING.mcap

Prints one JSON object: for each topic its schema's name, the number of messages, and every message as
[log time, publish time, sequence, value], where a value maps field names to numbers, texts and lists.
Nothing of Parallax is imported, so that this is an independent check of the files it writes.
"""

import json
import struct
import sys

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory


def plain(value):
    """A decoded message as JSON can hold it; a float as its bits, so that the comparison is exact."""
    if isinstance(value, float):
        return {"f64": struct.unpack("<Q", struct.pack("<d", value))[0]}
    if isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, (list, tuple, bytes, bytearray, memoryview)):
        return [plain(item) for item in value]
    return {name: plain(getattr(value, name)) for name in value.__slots__}


def main():
    topics = {}
    with open(sys.argv[1], "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        summary = reader.get_summary()
        for schema, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
            topic = topics.setdefault(channel.topic, {"schema": schema.name, "count": 0, "messages": []})
            topic["count"] += 1
            topic["messages"].append([message.log_time, message.publish_time, message.sequence, plain(decoded)])
        attachments = {a.name: json.loads(a.data) for a in reader.iter_attachments()}
    json.dump({"counted": summary.statistics.message_count, "topics": topics, "attachments": attachments}, sys.stdout)


main()
