"""CAN logs through python-can: `read FILE` prints one JSON list a frame, `convert IN OUT` writes IN again as OUT.

Channels are numbers: canN and vcanN are N. Dates of ASC files are taken as UTC.
"""
import json
import os
import re
import sys
import time

os.environ["TZ"] = "UTC"
time.tzset()

import can  # noqa: E402


def reader(path):
    if path.endswith(".asc"):
        return can.io.ASCReader(path, relative_timestamp=False)
    return can.io.CanutilsLogReader(path)


def number(channel):
    if isinstance(channel, int):
        return channel
    return int(re.search(r"\d+$", channel).group())


def row(message):
    stamp = round(message.timestamp * 1e6)
    if message.is_error_frame:
        # Its candump reader does not say where an error frame was.
        return [stamp, "error"]
    return [
        stamp, number(message.channel), message.arbitration_id, message.is_extended_id, message.is_remote_frame,
        message.is_fd, message.bitrate_switch, message.error_state_indicator, message.dlc,
        "" if message.is_remote_frame else bytes(message.data).hex(),
    ]


def main():
    if sys.argv[1] == "read":
        for message in reader(sys.argv[2]):
            print(json.dumps(row(message)))
    else:
        writer = can.io.ASCWriter(sys.argv[3]) if sys.argv[3].endswith(".asc") else can.io.CanutilsLogWriter(sys.argv[3])
        with writer:
            for message in reader(sys.argv[2]):
                message.channel = number(message.channel) if message.channel is not None else 0
                writer.on_message_received(message)


main()
