"""Unmodified python-can with can-cannelloni, and python-can on a terminal, against one virtual bus.

usage: python_wires.py CANNELLONI_PORT SLCAN_PORT TERMINAL
Prints one line per part; ends with an exception at the first difference.
"""
import logging
import sys
import threading
import time

import can

CANNELLONI, SLCAN, TERMINAL = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
PATIENCE = 60
logging.disable(logging.WARNING)


def cannelloni():
    return can.Bus(interface="cannelloni", host="127.0.0.1", port=CANNELLONI)


def terminal():
    return can.Bus(interface="slcan", channel=TERMINAL, bitrate=500000, sleep_after_open=0)


def receive(bus, count):
    got, end = [], time.monotonic() + PATIENCE
    while len(got) < count:
        assert time.monotonic() < end, f"{len(got)} of {count} frames came"
        message = bus.recv(1.0)
        if message is not None:
            got.append(message)
    return got


def key(m):
    return (m.arbitration_id, m.is_extended_id, m.is_remote_frame, m.is_fd, m.dlc, bytes(m.data))


def message(identifier, extended, **more):
    return can.Message(arbitration_id=identifier, is_extended_id=extended, **more)


FRAMES = [
    message(0x123, False, data=[1, 2, 3]),
    message(0x1ABCDEF0, True, data=range(8)),
    message(0x7FF, False, data=[]),
    message(0x1, True, data=[]),
    message(0x123, False, is_remote_frame=True, dlc=4),
    message(0x123, True, is_remote_frame=True, dlc=0),
]


def burst(name, source, sink, rest, count=10000):
    numbers = []

    def run():
        numbers.extend(int.from_bytes(m.data, "big") for m in receive(sink, count))

    others = [threading.Thread(target=receive, args=(bus, count)) for bus in rest]
    thread = threading.Thread(target=run)
    for t in [thread, *others]:
        t.start()
    for i in range(count):
        source.send(message(i % 2048, False, data=i.to_bytes(8, "big")))
    for t in [thread, *others]:
        t.join()
    assert numbers == list(range(count)), f"{name}: {len(numbers)}"
    print("burst", name, flush=True)


a, b, c = cannelloni(), cannelloni(), terminal()
assert c.get_serial_number(PATIENCE) == "DR01"
# A cannelloni client is not told when the server has heard its greeting: what it sends proves it.
# It neither sends nor takes the length of a remote frame.
bare = lambda m: (*key(m)[:4], 0 if m.is_remote_frame else m.dlc, bytes(m.data))
for source, sinks in ((a, (b, c)), (b, (a, c)), (c, (a, b))):
    for m in FRAMES:
        source.send(m)
    for bus in sinks:
        got = [bare(m) for m in receive(bus, len(FRAMES))]
        assert got == [bare(m) for m in FRAMES], (source, bus, got)
print("kinds", flush=True)
burst("cannelloni to cannelloni", a, b, [c])
burst("cannelloni to terminal", a, c, [b])
burst("terminal to cannelloni", c, a, [b])
# Closed and opened by the next program, the terminal starts with a closed channel and nothing old in it.
c.shutdown()
for i in range(100):
    a.send(message(0x700, False, data=[i]))
receive(b, 100)
c = terminal()
assert c.get_serial_number(PATIENCE) == "DR01"
b.send(message(0x42, False, data=[1]))
assert key(receive(c, 1)[0]) == key(message(0x42, False, data=[1]))
print("terminal reopened", flush=True)
for bus in (a, b, c):
    bus.shutdown()
