"""A serial CAN adapter of our own making, for what only an adapter can do: it writes every command it gets to a log, says
that it is in bus-off when frame 666 is sent, and is out of it when its channel is opened again.

usage: fake_adapter.py LINK LOG
"""
import os
import sys
import tty

link, log = sys.argv[1], open(sys.argv[2], "a", buffering=1)
master, slave = os.openpty()
tty.setraw(slave)
if os.path.lexists(link):
    os.unlink(link)
os.symlink(os.ttyname(slave), link)
# The other end is the program's alone: when that closes it, nothing is lost here.
rest = b""
while True:
    try:
        data = os.read(master, 4096)
    except OSError:
        break
    *lines, rest = (rest + data).split(b"\r")
    for line in lines:
        print(line.decode("latin-1"), file=log)
        if line[:1] in b"tTrR" and line:
            os.write(master, b"z\r" if line[:1] in b"tr" else b"Z\r")
        if line.startswith(b"t666"):
            # State bus-off, receive errors, transmit errors.
            os.write(master, b"sb000255\r")
