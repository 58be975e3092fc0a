"""A pyserial peer on a line: opens a port, waits for one frame, answers it.

    serial_peer.py PORT SETTINGS WAIT_HEX ANSWER_HEX [TIMES]

SETTINGS is e.g. 19200-8E1. Prints what it received as hex, one line a time.
"""

import sys
import serial

port, settings, expected, answer = sys.argv[1:5]
times = int(sys.argv[5]) if len(sys.argv) > 5 else 1
baud, shape = settings.split("-")
line = serial.Serial(
    port,
    int(baud),
    bytesize=int(shape[0]),
    parity=shape[1],
    stopbits=int(shape[2]),
    timeout=20,
)
print("open", flush=True)
for _ in range(times):
    if answer.startswith("ask:"):
        line.write(bytes.fromhex(answer[4:]))
    got = line.read(len(bytes.fromhex(expected)))
    print(got.hex(), flush=True)
    if not answer.startswith("ask:"):
        line.write(bytes.fromhex(answer))
line.flush()
if answer.startswith("ask:"):
    sys.exit(0 if got == bytes.fromhex(expected) else 1)
# Staying until the other side has read it: a terminal that is closed drops what was not read.
sys.stdin.read()
