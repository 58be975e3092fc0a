#!/usr/bin/env python3
"""Writes the seeds in corpus/: small inputs of our own making from which fuzzing starts.

Run it after a change of a format; it overwrites the named seeds and touches nothing else.
"""

from pathlib import Path
from struct import pack
from zlib import crc32

CORPUS = Path(__file__).parent / "corpus"


def seed(target: str, name: str, data: bytes | str) -> None:
    folder = CORPUS / target
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(data.encode() if isinstance(data, str) else data)


# --- CAN texts -------------------------------------------------------------------------------------------------

seed("slcan", "session", "\rC\rS6\rV\rv\rN\rF\rZ1\rO\rt1232AABB\rT1ABCDEF0800112233445566770000\rr1230\rR000001238\rC\r")
seed("slcan", "fd", "Y2\rO\rd1239" + "00" * 12 + "\rb7FFF" + "5A" * 64 + "\rD0000000008\rB1FFFFFFFF" + "A5" * 64 + "\r")
seed("slcan", "nonsense", "t\rt12\rtXYZ1\rS\rs031C\rM00000000\rmFFFFFFFF\rL\rt1230\r\n" + "t" * 200 + "\rZ0\r")

seed("socketcand", "session", "< open can0 >< rawmode >< send 123 2 AA BB >< send 1ABCDEF0 0 >< sendrtr 123 4 >< echo >< bcmmode >")
seed("socketcand", "fd", "< open can0 >< send 7ff c " + "0 " * 12 + ">< send 00000001 40 " + "FF " * 64 + ">")
seed("socketcand", "nonsense", "garbage< >< add 1 0 123 1 00 >< send >< open can0 x >< " + "a" * 300 + " ><< open vcan7 >")

seed("candump", "log", "(1436509052.249713) can0 123#DEADBEEF\n(1436509052.450000) can0 1ABCDEF0#R4 T\n"
     "# a comment\n\n(0.000000001) vcan7 7FF##5" + "00" * 64 + " R\n(1.5) can0 20000080#0000000000000000\n")
seed("candump", "frames", "123#\n123#R\n123#11.22.33\n00000123##0AA\n80000123#00\n12#00\n800#\n123##\n")
# Found by fuzzing: a stamp whose ninth decimal is half a character.
seed("candump", "stamp", "(1.00000000é) can0 123#00\n")

seed("asc", "measurement", "date Sat Sep 30 10:06:13.191 pm 2017\nbase hex  timestamps absolute\ninternal events logged\n"
     "Begin Triggerblock Sam Okt 30 22:06:13.191 2017\n   0.000000 Start of measurement\n   0.1 1  123  Rx   d 2 AA BB\n"
     "   0.2 2  1ABCDEF0x  Tx   r 8\n   0.3 1  ErrorFrame\n"
     "   0.4 CANFD   1 Rx   7FF  Name  1 0 9 12 01 02 03 04 05 06 07 08 09 0A 0B 0C  0 0 3000 0 0 0 0 0\nEnd TriggerBlock\n")
seed("asc", "decimal", "base dec  timestamps relative\n0.1 1 291 Rx d 2 255 16\n0.2 1 291x Tx r\n")
seed("asc", "candump", "(1.5) can0 123#AABB T\n(1.6) vcan1 00000123##1CC\n")

GREETING = b"CANNELLONIv1"
seed("cannelloni", "session", GREETING + bytes.fromhex("00000123 02 0102 9ABCDEF0 00 40000123 04 00000001 81 05 09 20000004 08 0010000000008000"))
seed("cannelloni", "fd", GREETING + bytes.fromhex("800007FF C0 04") + bytes(64) + bytes.fromhex("00000123 80 07"))
seed("cannelloni", "nonsense", GREETING + bytes.fromhex("00000001 C1 00"))
seed("cannelloni", "other", "GET / HTTP/1.1\r\n")

# As the kernel writes them: identifier with its class in the machine's byte order, length, 3 bytes, 8 data bytes.
for name, identifier, data in (
    ("bus_off", 0x20000040, "0000000000000000"), ("restarted", 0x20000100, "0000000000000000"),
    ("passive", 0x20000204, "0030000000008180"), ("ack", 0x200000A8, "0000801900000000"),
    ("arbitration", 0x20000002, "0500000000000000"), ("transceiver", 0x20000010, "0000000047000000"),
    ("data", 0x123, "0102030405060708"),
):
    seed("error_frame", name, pack("<IB3x", identifier, 8) + bytes.fromhex(data))


def adapter(*pieces: tuple[int, int, bytes]) -> bytes:
    """Time in 20 ms, whether the driver sends a frame, what the adapter says."""
    return b"".join(bytes([time, len(text) | (0x40 if send else 0)]) + text for time, send, text in pieces)


opened = [(1, 0, b"\r"), (4, 0, b"\r"), (1, 0, b"\r"), (1, 0, b"\r")]
seed("slcan_client", "session", b"\x06" + adapter(*opened, (1, 1, b"t1232AABB\r"), (1, 1, b"z\r"), (50, 0, b"zF00\r"), (1, 0, b"T1ABCDEF00\r")))
seed("slcan_client", "stamps_and_fd", b"\x1e" + adapter(*opened, (1, 0, b"\r"), (1, 0, b"t12300ABC\rd12390011223344556677889900AA\r"), (9, 1, b"\x07")))
seed("slcan_client", "bus_off", b"\x06" + adapter(*opened, *[(1, 1, b"\x07")] * 12, (9, 0, b"\r"), *opened, (1, 1, b"z\r")))
seed("slcan_client", "silent", b"\x06" + adapter(*[(20, 1, b"")] * 12))
seed("slcan_client", "nonsense", b"\x06" + adapter(*[(1, 0, b"GPS $GPGGA,1,2\r")] * 10))

seed("socketcand_client", "session", "< hi >< ok >< ok >< frame 123 12.345678 DEADBEEF >< frame 1ABCDEF0 0.0  >< rtr 123 1.0 4 >< error 20000080 1.5 >")
seed("socketcand_client", "refused", "< hi >< error no such bus on this server >")
seed("socketcand_client", "nonsense", "HTTP/1.1 400 Bad Request\r\n\r\n< hi >< fly >< frame 123 1.0 DEA >" + "a" * 600)

# --- Modbus ----------------------------------------------------------------------------------------------------

REQUESTS = {
    "read_coils": ("01 0000 000A", "01 02 5501"),
    "read_discrete_inputs": ("02 0000 0008", "02 01 FF"),
    "read_holding": ("03 0000 0002", "03 04 0001 0002"),
    "read_input": ("04 0001 0001", "04 02 1234"),
    "write_coil": ("05 0003 FF00", "05 0003 FF00"),
    "write_register": ("06 0001 1234", "06 0001 1234"),
    "write_coils": ("0F 0000 000A 02 5501", "0F 0000 000A"),
    "write_registers": ("10 0000 0002 04 0001 0002", "10 0000 0002"),
    "mask_write": ("16 0004 00F2 0025", "16 0004 00F2 0025"),
    "read_write": ("17 0000 0001 0002 0001 02 00FF", "17 02 0000"),
    "exception": ("03 FFFF 0001", "83 02"),
    "unknown": ("2B 0E 01 00", ""),
}


def adu(transaction: int, unit: int, pdu: bytes, protocol: int = 0) -> bytes:
    return pack(">HHHB", transaction, protocol, len(pdu) + 1, unit) + pdu


stream = b""
for i, (name, (request, response)) in enumerate(REQUESTS.items()):
    request, response = bytes.fromhex(request), bytes.fromhex(response)
    seed("modbus_pdu", name, bytes([len(request)]) + request + response)
    stream += adu(i, 1 if i % 2 else 17, request)
seed("modbus_session", "whole", b"\x00\xff" + stream)
seed("modbus_session", "openplc_in_pieces", b"\x01\x04" + stream)
seed("modbus_session", "hold_stopped", b"\x06\x10" + stream)
seed("modbus_session", "units", b"\x08\xff" + stream + adu(99, 3, bytes.fromhex("0300000001")))
seed("modbus_session", "bad", b"\x00\xff" + adu(1, 1, b"\x03\0\0\0\1", protocol=1) + stream[:12] + b"\0\2\0\0\1\x2c")

# --- Image writes ----------------------------------------------------------------------------------------------


def image_set(area: int, offset: int, data: bytes) -> bytes:
    return pack("<BBHII", area, 0, 0, offset, len(data)) + data


def image_mask(area: int, offset: int, keep: bytes, put: bytes) -> bytes:
    return pack("<BBHII", area, 1, 0, offset, len(keep)) + keep + put


seed("image_write", "set", image_set(2, 0, b"\x34\x12"))
seed("image_write", "mask", image_mask(1, 3, b"\xfe", b"\x01"))
seed("image_write", "several", b"".join(image_set(i % 3, 8 * i, bytes(i)) for i in range(16)))
seed("image_write", "outside", image_set(1, 0xFFFFFFFF, b"\1") + image_mask(2, 62, b"\0\0\0", b"\1\2\3"))

# --- Scan records ----------------------------------------------------------------------------------------------

SOURCE = pack("<IIQ", 3, 2, 77)
PATCH = pack("<IB3x8s8s", 300, 2, b"\xff" * 8, b"\x01" * 8)


def section(tag: int, body: bytes, a: int = 0, b: int = 0) -> bytes:
    return pack("<BBHI", tag, a, b, len(body)) + body


def content(kind: int, *sections: bytes) -> bytes:
    head = pack("<BBBBBBHQqQqQQIIQI", 1, kind, 1, 1, 2, 0, 0, 12, -5, 9, 10, 11, 99, 0, 64, 1, 0)
    return head.ljust(80, b"\0") + b"".join(sections)


SCAN = content(
    1,
    section(1, SOURCE, a=1),
    section(1, SOURCE, a=2, b=1),
    section(1, SOURCE + PATCH + b"prg.speed", a=3),
    section(1, SOURCE, a=5),
    section(1, SOURCE + PATCH + b"prg.speed", a=6),
    section(1, SOURCE + pack("<Q", 5), a=7),
    section(2, SOURCE + pack("<HBxII", 4, 1, 2, 2) + b"\7\x08"),
    section(3, SOURCE + image_set(2, 0, b"\x34\x12"), a=0),
    section(4, PATCH * 2, b=2),
    section(5, pack("<Q", 9), b=1),
    section(6, pack("<IIIqd", 2, 5, 640, 10, 0.5) + b"main.st:3:5", a=1),
    section(7, pack("<IH", 260, 3) + b"\1\2\3" + pack("<IH", 4096, 1) + b"\x09"),
    section(200, b"of a later version"),
)
KEYFRAME = content(
    2,
    section(16, b'{"input_bytes":16}'),
    section(17, pack("<I", 256) + bytes(range(64))),
    section(18, b"\0" * 16),
    section(19, pack("<qQ", 1_000_000, 0), a=1, b=0),
    section(20, b"\1\0"),
)
seed("scan_record", "scan", b"\0" + SCAN)
seed("scan_record", "keyframe", b"\0" + KEYFRAME)
seed("scan_record", "long", b"\0" + content(1, section(7, b"".join(pack("<IH", 8 * i, 2) + b"ab" for i in range(600)))))


def part(seq: int, scan: int, index: int, count: int, total: int, length: int, generation: int = 1) -> bytes:
    return pack("<QIIIIIxxH", seq, generation, scan, index, count, total, length)


seed("scan_record", "parts", b"\1" + part(1, 1, 0, 2, 2050, 2048) + part(2, 1, 1, 2, 2050, 2) + part(3, 2, 0, 1, 5, 5))
seed("scan_record", "losses", b"\1" + part(1, 1, 0, 3, 5000, 2048) + part(3, 1, 2, 3, 5000, 904)
     + part(1, 1, 0, 1, 0, 0, generation=2) + part(2**64 - 1, 2, 0, 1, 1, 1, generation=2) + part(0, 3, 0, 1, 1, 1, generation=2))

# --- Recordings ------------------------------------------------------------------------------------------------

MAGIC = b"\x89MCAP0\r\n"


def text(value: str) -> bytes:
    return pack("<I", len(value)) + value.encode()


def table(entries: dict[str, str]) -> bytes:
    body = b"".join(text(k) + text(v) for k, v in entries.items())
    return pack("<I", len(body)) + body


def record(opcode: int, body: bytes) -> bytes:
    return pack("<BQ", opcode, len(body)) + body


def schema(number: int, name: str, definition: str) -> bytes:
    return record(3, pack("<H", number) + text(name) + text("ros1msg") + text(definition))


def channel(number: int, of: int, topic: str, kind: str, payload: str, encoding: str = "ros1") -> bytes:
    metadata = table({"kind": kind, "payload": payload})
    return record(4, pack("<HH", number, of) + text(topic) + text(encoding) + metadata)


def message(number: int, sequence: int, data: bytes) -> bytes:
    return record(5, pack("<HIQQ", number, sequence, 1000 + sequence, 1000 + sequence) + data)


def chunk(records: bytes, compression: str = "") -> bytes:
    stored = records
    if compression == "zstd":  # one frame, single segment, one raw block
        stored = b"\x28\xb5\x2f\xfd\x60" + pack("<H", len(records) - 256) + pack("<I", 1 | len(records) << 3)[:3] + records
    head = pack("<QQQI", 1000, 2000, len(records), crc32(records)) + text(compression)
    return record(6, head + pack("<Q", len(stored)) + stored)


def attachment(name: str, data: bytes) -> bytes:
    body = pack("<QQ", 1000, 1000) + text(name) + text("text/plain") + pack("<Q", len(data)) + data
    return record(9, body + pack("<I", crc32(body)))


def stamp(seq: int) -> bytes:
    return pack("<QQII", seq, 5000 + seq, 1, 4)


PART = "uint64 seq\nuint64 t_ns\nuint32 generation\nuint32 writer\nuint64 scan\nuint32 part\nuint32 parts\nuint32 total\nuint8[] data\n"
HEADER = record(1, text("") + text("dinrail seeds"))
CHANNELS = (
    schema(1, "dinrail/ScanPart", PART)
    + channel(1, 1, "plc/scan", "scan", "dinrail.ScanPart/1")
    + channel(2, 0, "stack/events", "events", "dinrail.Event/1", "json")
    + channel(3, 1, "of/another", "unknown", "x")
)


def scan_message(sequence: int, body: bytes) -> bytes:
    return message(1, sequence, stamp(sequence) + pack("<QIIII", sequence, 0, 1, len(body), len(body)) + body)


MESSAGES = scan_message(1, SCAN) + scan_message(2, KEYFRAME) + message(2, 1, b'{"seq":1,"t_ns":7,"event":"started"}') + message(3, 1, b"abc")
CLOCK = record(12, text("dinrail.clock") + table({"utc_offset_ns": "1700000000000000000", "t_ns": "5", "reason": "start"}))
END = record(15, pack("<I", 0)) + record(2, pack("<QQI", 0, 0, 0)) + MAGIC
FILE = MAGIC + HEADER + CLOCK + attachment("stack.toml", b"[stack]\n")

seed("mcap_reader", "plain", FILE + CHANNELS + MESSAGES + END)
seed("mcap_reader", "chunk", FILE + chunk(CHANNELS + MESSAGES) + END)
seed("mcap_reader", "zstd", FILE + chunk(CHANNELS + MESSAGES, "zstd") + END)
seed("mcap_reader", "cut", (FILE + chunk(CHANNELS + MESSAGES, "zstd"))[:-40])
seed("mcap_reader", "damaged", FILE + chunk(CHANNELS) + chunk(MESSAGES).replace(b"started", b"damaged") + chunk(MESSAGES) + END)
seed("mcap_reader", "empty", MAGIC)
# Found by fuzzing: lengths that overflow when they are added up.
seed("mcap_reader", "chunk_of_2_64_bytes", MAGIC + record(6, pack("<QQQI", 0, 0, 0, 0) + text("") + pack("<Q", 2**64 - 1)) + END)

# --- Programs --------------------------------------------------------------------------------------------------

seed("st_source", "blink.st", """PROGRAM Blink
  VAR Lamp AT %QX0.0 : BOOL; T : TON; END_VAR
  T(IN := NOT T.Q, PT := T#500ms);
  IF T.Q THEN Lamp := NOT Lamp; END_IF;
END_PROGRAM
""")
seed("st_source", "statements.st", """TYPE Mode : (Off, Slow, Fast) := Off; END_TYPE
PROGRAM Main
  VAR a : ARRAY [0..3, 1..2] OF INT := [2(1), 6(7)]; i : INT; m : Mode; r : REAL; w : WORD; END_VAR
  FOR i := 0 TO 3 DO a[i, 1] := a[i, 2] MOD 3; IF i = 2 THEN CONTINUE; END_IF; END_FOR;
  WHILE i > 0 DO i := i - 1; END_WHILE;
  REPEAT i := i + 1; IF i > 9 THEN EXIT; END_IF; UNTIL i >= 5 END_REPEAT;
  CASE i OF 1: m := Mode#Slow; 2..4, 7: m := Fast; ELSE m := Off; END_CASE;
  r := SQRT(INT_TO_REAL(i)) ** 2.0; w := SHL(16#00F0, 2) AND NOT w;
  i := SEL(r > 1.5, a[0, 1], -i);
END_PROGRAM
""")
seed("st_source", "blocks.st", """FUNCTION Scale : REAL
  VAR_INPUT x : INT; gain : REAL := 2.0; END_VAR
  VAR_OUTPUT clipped : BOOL; END_VAR
  Scale := INT_TO_REAL(x) * gain; clipped := Scale > 100.0; IF clipped THEN Scale := 100.0; RETURN; END_IF;
END_FUNCTION
FUNCTION_BLOCK Filter
  VAR_INPUT x : REAL; END_VAR  VAR_OUTPUT y : REAL; END_VAR
  VAR_IN_OUT n : DINT; END_VAR  VAR last : REAL; END_VAR
  y := (x + last) / 2.0; last := x; n := n + 1;
END_FUNCTION_BLOCK
VAR_GLOBAL RETAIN count : DINT; END_VAR
PROGRAM Main
  VAR_EXTERNAL count : DINT; END_VAR
  VAR f : Filter; c : BOOL; up : CTU; e : R_TRIG; END_VAR
  f(x := Scale(x := 3, clipped => c), n := count); e(CLK := c); up(CU := e.Q, PV := 3);
END_PROGRAM
""")
seed("st_source", "tasks.st", """CONFIGURATION Plant
  VAR_GLOBAL Start AT %IX0.0 : BOOL; Speed2 AT %QW2 : UINT; END_VAR
  RESOURCE Cpu ON Soft
    TASK Fast(INTERVAL := T#1ms, PRIORITY := 0); TASK Edge(SINGLE := Start, PRIORITY := 1);
    PROGRAM P1 WITH Fast : Main; PROGRAM P2 WITH Edge : Main;
  END_RESOURCE
END_CONFIGURATION
PROGRAM Main VAR_EXTERNAL Speed2 : UINT; END_VAR Speed2 := Speed2 + 1; END_PROGRAM
""")
seed("st_source", "literals.st", """PROGRAM Main
  VAR t : TIME := T#1d2h3m4s5.6ms; b : BYTE := 2#1010_1010; d : DWORD := 16#FFFF_FFFF; l : LREAL := -1.5E-10; END_VAR
  (* nested (* comment *) *) // line
  {pragma} t := t + LT#5us; b := BYTE#8#17 XOR b; l := LREAL#1.0; ;
END_PROGRAM
""")
seed("st_source", "broken.st", "PROGRAM Main VAR x : INT; s : STRING[10] := 'a$N'; END_VAR x.3 := TRUE; x := ; IF x THEN y := 1 END_IF; a[1 := 'open\nEND_PROGRAM FUNCTION")

# --- Stack files -----------------------------------------------------------------------------------------------

seed("stack_file", "gateway.toml", """[stack]
name = "seed"

[[service]]
name = "can0"
kind = "can"
backend = "virtual"
bitrate = "500k"
feed = { file = "conveyor.log", loop = true }
serve = { socketcand = "127.0.0.1:29536" }

[[service]]
name = "io"
kind = "can-io"
bus = "can0"
[[service.in]]
id = 0x1A0
start = 0
len = 16
to = "%IW0"
type = "UINT"
symbol = "Speed"
timeout = "500ms"
[[service.out]]
id = 0x210
dlc = 2
mode = "cyclic"
period = "100ms"
signals = [{ start = 0, len = 16, from = "%QW0", type = "UINT", symbol = "Command" }]

[[service]]
name = "plc"
kind = "plc"
cycle = "10ms"
[[service.route]]
from = "%IW0"
to = "%QW0"

[[service]]
name = "modbus"
kind = "modbus-server"
tcp = { address = "127.0.0.1", port = 1502 }

[[service]]
name = "rec"
kind = "recorder"
dir = "recordings"
max_size = "100MiB"
""")
seed("stack_file", "plc.toml", '[stack]\nname = "p"\n[[service]]\nname = "plc"\nkind = "plc"\naddressing = "byte"\n'
     'max_interval = "20ms"\n[[service.route]]\nfrom = "%MW0"\nto = "%QW0"\nscale = 0.5\noffset = 1\n')
seed("stack_file", "mistakes.toml", '[stack]\nnam = "x"\n[[service]]\nname = "can0"\nkind = "cna"\nbitrate = 500\n'
     '[[service]]\nname = "can0"\nkind = "can"\nbackend = "socketcan"\nbitrat = "1M"\n')

# --- CANopen ---------------------------------------------------------------------------------------------------

# Each: who hears (0 server, 1 client), 10 ms of silence before, the frame.
def sdo(*steps: str) -> bytes:
    return b"".join(bytes.fromhex(step) for step in steps)


seed("sdo_server", "expedited", sdo("00 00 4000100000000000", "00 00 2301200001020304", "01 00 6000200000000000"))
seed("sdo_server", "segmented", sdo("00 00 2100200008000000", "00 00 0061626364656667", "00 00 1D68000000000000",
                                    "00 00 4002200000000000", "00 00 6000000000000000", "00 64 7000000000000000"))
seed("sdo_server", "block", sdo("00 00 C600200008000000", "00 00 0161626364656667", "00 00 8268000000000000", "00 00 D900000000000000",
                                "00 00 A402200014000000", "00 00 A300000000000000", "00 00 A202140000000000", "00 00 A100000000000000"))



def bus(*steps: tuple[int, int, str]) -> bytes:
    """Pause in ms, identifier (bit 15: a remote frame), data."""
    return b"".join(pack("<BHB", pause, can_id, len(data) // 2) + bytes.fromhex(data) for pause, can_id, data in steps)


seed("canopen_bus", "commands", bus((10, 0, "8002"), (50, 0, "0203"), (100, 0, "8100"), (5, 0x80, ""), (1, 0x8703, "")))
seed("canopen_bus", "sdo", bus((10, 0x602, "2B17100000000000"), (1, 0x582, "8016100111000906"), (20, 0x602, "2300180182010080"),
                               (1, 0x603, "C600200008000000"), (1, 0x583, "6016100100000000")))
seed("canopen_bus", "states", bus((3, 0x702, "00"), (3, 0x702, "7F"), (3, 0x703, "04"), (3, 0x82, "1081010000000000"),
                                  (0, 0x182, "01"), (200, 0x701, "05")))

seed("lss", "scan", sdo("13 00 5100000000800000", "01 0A 4F00000000000000", "13 0A 0401000000000000", "0F 64 0000000000000000",
                        "01 01 5A00000000000000"))
seed("lss", "configure", sdo("00 01 0401000000000000", "04 01 1105000000000000", "05 01 1100000000000000", "0A 01 1700000000000000",
                             "02 01 4011000000000000", "02 01 4122000000000000", "02 01 4233000000000000", "02 01 4301000080000000"))

EDS = """[FileInfo]
FileName=seed.eds
[DeviceInfo]
VendorName=seed
Granularity=8
NrOfRXPDO=1
CompactPDO=3
[DummyUsage]
Dummy0005=1
[Comments]
Lines=1
Line1=none
[MandatoryObjects]
SupportedObjects=1
1=0x1000
[1000]
ParameterName=Device type
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=0x191
[2000]
ParameterName=List
ObjectType=8
CompactSubObj=3
DataType=0x3
AccessType=rw
LowLimit=-5
HighLimit=0x7F
[2000Name]
NrOfEntries=1
1=First
[2001]
ParameterName=Record
ObjectType=9
SubNumber=2
[2001sub0]
ParameterName=Highest
DataType=5
AccessType=const
DefaultValue=1
[2001sub1]
ParameterName=COB-ID
DataType=7
AccessType=rw
PDOMapping=1
DefaultValue=$NODEID+0x180
ParameterValue=010
"""
seed("eds", "small", EDS)
seed("dcf", "small", EDS + "[2000Value]\nNrOfEntries=1\n2=-3\n[DeviceComissioning]\nNodeID=5\nBaudrate=250\n")
seed("concise_dcf", "two", pack("<IHBIH", 2, 0x1017, 0, 2, 1000) + pack("<HBII", 0x1400, 1, 4, 0x80000205))
