"""Plays a candump log onto a bus with unmodified python-can, in file order.

usage: play_candump.py HOST PORT CHANNEL FILE FRAMES_PER_SECOND
"""
import sys
import time

import can

host, port, channel, path, rate = sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4], float(sys.argv[5])
bus = can.Bus(interface="socketcand", host=host, port=port, channel=channel)
start = time.monotonic()
count = 0
for message in can.CanutilsLogReader(path):
    bus.send(message)
    count += 1
    ahead = count / rate - (time.monotonic() - start)
    if ahead > 0.005:
        time.sleep(ahead)
print(count, flush=True)
bus.shutdown()
