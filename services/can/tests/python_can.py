"""Unmodified python-can against the servers of a virtual bus named can0.

usage: python_can.py SOCKETCAND_PORT SLCAN_PORT
Prints one line per part; ends with an exception at the first difference.
"""
import logging
import sys
import threading
import time

import can

SOCKETCAND, SLCAN = int(sys.argv[1]), int(sys.argv[2])
PATIENCE = 60
# python-can warns about every frame kind it does not know ("< rtr ... >").
logging.disable(logging.WARNING)


def socketcand():
    return can.Bus(interface="socketcand", host="127.0.0.1", port=SOCKETCAND, channel="can0")


def slcan():
    return can.Bus(interface="slcan", channel=f"socket://127.0.0.1:{SLCAN}", bitrate=500000, sleep_after_open=0)


def receive(bus, count):
    got, end = [], time.monotonic() + PATIENCE
    while len(got) < count:
        assert time.monotonic() < end, f"{len(got)} of {count} frames came"
        message = bus.recv(1.0)
        if message is not None:
            got.append(message)
    return got


def skip_to(bus, identifier):
    """Reads until a frame with this identifier, so that tests do not see each other's frames."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        message = bus.recv(1.0)
        if message is not None and message.arbitration_id == identifier and message.is_extended_id:
            return
    raise AssertionError("the marker never came")


def key(m):
    return (m.arbitration_id, m.is_extended_id, m.is_remote_frame, m.is_fd, m.bitrate_switch, m.dlc, bytes(m.data))


def message(identifier, extended, **more):
    return can.Message(arbitration_id=identifier, is_extended_id=extended, **more)


CLASSIC = [
    message(0x123, False, data=[1, 2, 3]),
    message(0x1ABCDEF0, True, data=range(8)),
    message(0x7FF, False, data=[]),
    message(0x1, True, data=[]),
]
REMOTE = [message(0x123, False, is_remote_frame=True, dlc=4), message(0x123, True, is_remote_frame=True, dlc=0)]
FD = [
    message(0x123, False, is_fd=True, data=range(12)),
    message(0x1ABCDEF0, True, is_fd=True, bitrate_switch=True, data=range(64)),
    message(0x5, False, is_fd=True, bitrate_switch=True, data=[]),
]


def kinds(a, b, c, d):
    for m in CLASSIC:
        a.send(m)
    for bus in (b, c, d):
        assert [key(m) for m in receive(bus, len(CLASSIC))] == [key(m) for m in CLASSIC], bus
    for m in CLASSIC + REMOTE + FD:
        c.send(m)
    assert [key(m) for m in receive(d, 9)] == [key(m) for m in CLASSIC + REMOTE + FD]
    # socketcand: python-can does not read remote frames, and the protocol has no FD flags; the data is there.
    got = receive(a, 7)
    assert [key(m) for m in got[:4]] == [key(m) for m in CLASSIC]
    assert [bytes(m.data) for m in got[4:]] == [bytes(m.data) for m in FD]
    assert abs(got[0].timestamp - time.time()) < PATIENCE, "stamps are UTC"
    receive(b, 7)
    assert c.get_version(PATIENCE) == (10, 13)
    print("kinds", flush=True)


def burst(name, source, sinks, others, count=10000):
    results = [None] * len(sinks)

    def run(i):
        results[i] = [int.from_bytes(m.data, "big") for m in receive(sinks[i], count)]

    threads = [threading.Thread(target=run, args=(i,)) for i in range(len(sinks))]
    for thread in threads:
        thread.start()
    for i in range(count):
        source.send(message(i % 2048, False, data=i.to_bytes(8, "big")))
    for thread in threads:
        thread.join()
    for numbers in results:
        assert numbers == list(range(count)), name
    source.send(message(0x1FFFFFFF, True, data=[]))
    for bus in sinks + others:
        skip_to(bus, 0x1FFFFFFF)
    print("burst", name, flush=True)


def handshakes_under_load():
    stop = threading.Event()

    def load():
        bus = socketcand()
        while not stop.is_set():
            bus.send(message(0x100, False, data=[1] * 8))
            time.sleep(0.0002)
        bus.shutdown()

    thread = threading.Thread(target=load)
    thread.start()
    try:
        for _ in range(20):
            bus = socketcand()
            assert bus.recv(PATIENCE) is not None
            bus.shutdown()
    finally:
        stop.set()
        thread.join()
    print("handshakes", flush=True)


a, b, c, d = socketcand(), socketcand(), slcan(), slcan()
# An SLCAN client is not told when its channel is open: ask something it answers.
for bus in (c, d):
    assert bus.get_serial_number(PATIENCE) == "DR01"
kinds(a, b, c, d)
burst("socketcand to socketcand", a, [b], [c, d])
burst("slcan to slcan", c, [d], [a, b])
burst("socketcand to all", a, [b, c, d], [])
for bus in (a, b, c, d):
    bus.shutdown()
handshakes_under_load()
