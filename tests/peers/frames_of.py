"""Prints the frames of a topic of a recording, `ID#DATA`, with python's mcap alone (no code of ours, no schema
decoder: the layout is read from the ros1msg text in the file).

usage: frames_of.py TOPIC FILE...
"""
import struct
import sys

from mcap.reader import NonSeekingReader

SIZES = {"uint8": "B", "int8": "b", "uint16": "H", "int16": "h", "uint32": "I", "int32": "i", "uint64": "Q",
         "int64": "q", "float32": "f", "float64": "d"}


def layout(text):
    names, code = [], "<"
    for line in text.strip().splitlines():
        kind, name = line.split()
        if "[" in kind:
            base, count = kind[:-1].split("[")
            assert base == "uint8"
            code += f"{count}s"
        else:
            code += SIZES[kind]
        names.append(name)
    return names, struct.Struct(code)


topic = sys.argv[1]
for path in sys.argv[2:]:
    with open(path, "rb") as stream:
        for schema, channel, message in NonSeekingReader(stream).iter_messages(topics=[topic], log_time_order=False):
            assert schema.encoding == "ros1msg", schema.encoding
            names, code = layout(schema.data.decode())
            frame = dict(zip(names, code.unpack(message.data)))
            ident = frame["can_id"]
            width, ident = (8, ident & 0x1FFFFFFF) if ident & 0x80000000 else (3, ident & 0x7FF)
            print(f"{ident:0{width}X}#{frame['data'][:frame['len']].hex().upper()}")
