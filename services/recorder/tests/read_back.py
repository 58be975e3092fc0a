#!/usr/bin/env python3
"""Reads a recording with the public `mcap` and `mcap-ros1-support` packages alone and prints what it found as JSON.

usage: read_back.py FILE [--unfinished]

--unfinished reads the file as a stream, as one must that has no index and end yet, and stops where it stops.
"""

import json
import sys

from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from mcap_ros1.decoder import DecoderFactory


def plain(value):
    """A decoded message as JSON values."""
    if isinstance(value, (bytes, bytearray)):
        return value.hex()
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if hasattr(value, "__slots__"):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    return value


def main():
    path, unfinished = sys.argv[1], "--unfinished" in sys.argv[2:]
    found = {"messages": {}, "last": {}, "times": [], "attachments": {}, "metadata": {}, "ended": "whole"}
    factory, decoders = DecoderFactory(), {}
    with open(path, "rb") as file:
        if unfinished:
            messages = NonSeekingReader(file).iter_messages(log_time_order=False)
        else:
            reader = make_reader(file)
            found["profile"] = reader.get_header().profile
            found["statistics"] = reader.get_summary().statistics.message_count
            for a in reader.iter_attachments():
                found["attachments"].setdefault(a.name, []).append(a.data.decode("utf-8", "replace"))
            for m in reader.iter_metadata():
                found["metadata"].setdefault(m.name, []).append(m.metadata)
            # One topic alone: needs the chunk indexes to name it.
            found["filtered"] = sum(1 for _ in reader.iter_messages(topics=["can0/rx"]))
            messages = reader.iter_messages(log_time_order=False)
        try:
            for schema, channel, message in messages:
                if channel.message_encoding == "json":
                    value = json.loads(message.data)
                else:
                    if channel.id not in decoders:
                        decoders[channel.id] = factory.decoder_for(channel.message_encoding, schema)
                    value = plain(decoders[channel.id](message.data))
                    assert value["seq"] & 0xFFFFFFFF == message.sequence, (channel.topic, message.sequence)
                assert message.log_time == message.publish_time
                topic = channel.topic
                found["messages"][topic] = found["messages"].get(topic, 0) + 1
                found["last"][topic] = value
                found["times"].append(message.log_time)
        except EndOfFile:
            if not unfinished:
                raise
            found["ended"] = "end of file"
    found["in_order"] = found["times"] == sorted(found["times"])
    del found["times"]
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()
