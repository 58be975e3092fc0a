"""Two unmodified python-can clients of one kind on a virtual bus named can0: what this kind carries, both ways; a burst of
10,000 frames and 4,000 paced ones without loss.

usage: python_rows.py KIND PORT [TERMINAL]
KIND is socketcand, socketcand-tuned, slcan, terminal or cannelloni. A terminal has one client: its partner is SLCAN on PORT.
Prints one line per part; ends with an exception at the first difference.
"""
import logging
import sys
import threading
import time

import can

KIND, PORT, TERMINAL = sys.argv[1], int(sys.argv[2]), sys.argv[3] if len(sys.argv) > 3 else None
HOST, PATIENCE = "127.0.0.1", 60
logging.disable(logging.WARNING)


def client(first):
    if KIND.startswith("socketcand"):
        tuned = {"tcp_tune": True} if KIND.endswith("tuned") else {}
        return can.Bus(interface="socketcand", host=HOST, port=PORT, channel="can0", **tuned)
    if KIND == "cannelloni":
        return can.Bus(interface="cannelloni", host=HOST, port=PORT)
    channel = TERMINAL if KIND == "terminal" and first else f"socket://{HOST}:{PORT}"
    bus = can.Bus(interface="slcan", channel=channel, bitrate=500000, sleep_after_open=0)
    # An SLCAN client is not told when its channel is open: ask something it answers.
    assert bus.get_serial_number(PATIENCE) == "DR01"
    return bus


def message(identifier, extended, **more):
    return can.Message(arbitration_id=identifier, is_extended_id=extended, **more)


def key(m):
    return (m.arbitration_id, m.is_extended_id, m.is_remote_frame, m.is_fd, m.bitrate_switch, m.dlc, bytes(m.data))


def receive(bus, count):
    got, end = [], time.monotonic() + PATIENCE
    while len(got) < count:
        assert time.monotonic() < end, f"{len(got)} of {count} frames came: {got[:10]}"
        m = bus.recv(1.0)
        if m is not None:
            got.append(m)
    return got


def through(source, sink, frames):
    """What comes of these frames, up to a mark."""
    mark = message(0x1FFFFFFF, True, data=[0xAA])
    for m in frames:
        source.send(m)
    source.send(mark)
    got = []
    while not got or key(got[-1]) != key(mark):
        got += receive(sink, 1)
    return [key(m) for m in got[:-1]]


def meet(a, b):
    """A cannelloni client is not told when the server has heard its greeting: both have when both hear each other."""
    for source, sink in ((a, b), (b, a)):
        end = time.monotonic() + PATIENCE
        while True:
            assert time.monotonic() < end, "they never met"
            source.send(message(0x7FE, False, data=[]))
            if sink.recv(0.2) is not None:
                break
    for bus in (a, b):
        while bus.recv(0.3) is not None:
            pass


CLASSIC = [
    message(0x123, False, data=[1, 2, 3]),
    message(0x1ABCDEF0, True, data=range(8)),
    message(0x7FF, False, data=[]),
    message(0x1, True, data=[]),
]
REMOTE = [message(0x123, False, is_remote_frame=True, dlc=4), message(0x123, True, is_remote_frame=True, dlc=0)]
FD = [
    message(0x123, False, is_fd=True, data=range(8)),
    message(0x1ABCDEF0, True, is_fd=True, bitrate_switch=True, data=range(64)),
    message(0x5, False, is_fd=True, bitrate_switch=True, data=[]),
]


def kinds(source, sink):
    assert through(source, sink, CLASSIC) == [key(m) for m in CLASSIC]
    remote = through(source, sink, REMOTE)
    if KIND.startswith("socketcand"):
        # For a remote frame it sends a command without the data of its length, which is refused; one of length 0 cannot
        # be told from a data frame.
        assert remote == [(0x123, True, False, False, False, 0, b"")], remote
        # The protocol has no flags: short frames become classic ones, the data is there.
        assert [m[6] for m in through(source, sink, FD)] == [bytes(m.data) for m in FD]
    elif KIND == "cannelloni":
        assert [m[:3] for m in remote] == [key(m)[:3] for m in REMOTE], remote
        try:
            source.send(FD[0])
            raise AssertionError("can-cannelloni sends CAN FD: tell so in the table of the documentation")
        except can.CanError:
            pass
    else:
        assert remote == [key(m) for m in REMOTE], remote
        assert through(source, sink, FD) == [key(m) for m in FD]


def numbers(source, sink, count, rate=None):
    got = []
    thread = threading.Thread(target=lambda: got.extend(int.from_bytes(m.data, "big") for m in receive(sink, count)))
    thread.start()
    began = time.monotonic()
    for i in range(count):
        source.send(message(i % 2048, False, data=i.to_bytes(8, "big")))
        if rate and i % 20 == 19:
            time.sleep(max(0, began + (i + 1) / rate - time.monotonic()))
    thread.join()
    assert got == list(range(count)), f"{len(got)} of {count}, order or loss"


a, b = client(True), client(False)
meet(a, b)
for source, sink in ((a, b), (b, a)):
    kinds(source, sink)
print("kinds", flush=True)
for source, sink in ((a, b), (b, a)):
    numbers(source, sink, 10000)
print("burst", flush=True)
numbers(a, b, 4000, rate=4000)
print("paced", flush=True)
for bus in (a, b):
    bus.shutdown()
