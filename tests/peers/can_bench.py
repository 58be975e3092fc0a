"""Round trips and a burst between two programs on a bus of python-can, for `dinrail bench bus`.

usage: can_bench.py BUS ROUNDS BURST
BUS is a JSON object, the arguments of can.Bus. Prints one JSON object: round trips in us, frames/s of the burst as sent and
as received, frames lost. With interface "virtual" both sides are threads of this process, else they are processes.
"""
import json
import logging
import struct
import subprocess
import sys
import threading
import time

import can

PING, PONG, BURST, END, RESULT, LEAVE = 0x100, 0x101, 0x200, 0x201, 0x202, 0x7FF
PATIENCE = 30
logging.disable(logging.WARNING)


def frame(identifier, data=b""):
    return can.Message(arbitration_id=identifier, is_extended_id=False, data=data)


def answer(bus):
    """The other side: echoes pings, counts the burst, leaves when told."""
    count, first, last = 0, 0.0, 0.0
    end = time.monotonic() + 4 * PATIENCE
    while time.monotonic() < end:
        message = bus.recv(1.0)
        if message is None:
            continue
        identifier = message.arbitration_id
        if identifier == PING:
            bus.send(frame(PONG, message.data))
        elif identifier == BURST:
            last = time.monotonic()
            first = first or last
            count += 1
        elif identifier == END:
            bus.send(frame(RESULT, struct.pack(">II", count, int((last - first) * 1e6))))
        elif identifier == LEAVE:
            return


def ask(bus, question, identifier, wait):
    bus.send(question)
    end = time.monotonic() + wait
    while (left := end - time.monotonic()) > 0:
        message = bus.recv(left)
        if message is not None and message.arbitration_id == identifier:
            return bytes(message.data)
    return None


def main():
    arguments, rounds, burst = json.loads(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    if sys.argv[4:] == ["answer"]:
        with can.Bus(**arguments) as bus:
            answer(bus)
        return
    bus = can.Bus(**arguments)
    if arguments["interface"] == "virtual":
        other = threading.Thread(target=answer, args=(can.Bus(**arguments),), daemon=True)
        other.start()
        leave = other.join
    else:
        other = subprocess.Popen([sys.executable, *sys.argv, "answer"])
        leave = other.wait
    try:
        end = time.monotonic() + PATIENCE
        while ask(bus, frame(PING), PONG, 0.2) is None:
            assert time.monotonic() < end, "the other side never answered"
        times = []
        for i in range(rounds):
            data, began = struct.pack(">Q", i), time.perf_counter()
            got = ask(bus, frame(PING, data), PONG, 1.0)
            # On a bus that loses frames one may be missing, or late.
            if got == data:
                times.append((time.perf_counter() - began) * 1e6)
        began = time.monotonic()
        for i in range(burst):
            bus.send(frame(BURST, struct.pack(">Q", i)))
        sent = burst / (time.monotonic() - began)
        end = time.monotonic() + PATIENCE
        while (result := ask(bus, frame(END), RESULT, PATIENCE / 3)) is None:
            assert time.monotonic() < end, "the burst was never answered"
        count, micros = struct.unpack(">II", result)
        print(json.dumps({"rtt_us": times, "sent": sent, "received": count / max(micros, 1) * 1e6, "lost": burst - count}))
        bus.send(frame(LEAVE))
        leave(10)
    finally:
        if arguments["interface"] != "virtual":
            other.kill()
        bus.shutdown()


main()
