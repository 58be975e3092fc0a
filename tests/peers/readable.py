"""Reads recordings whole with python's mcap package alone, finished or not, and prints messages per file.

usage: readable.py FILE...
"""
import sys

from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader

for path in sys.argv[1:]:
    count = 0
    with open(path, "rb") as stream:
        try:
            for _ in NonSeekingReader(stream, validate_crcs=True).iter_messages(log_time_order=False):
                count += 1
        except EndOfFile:
            pass  # cut off at a record boundary: everything before it was read
    print(f"{count} {path}", flush=True)
