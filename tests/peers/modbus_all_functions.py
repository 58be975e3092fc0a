"""Asks every function of a Modbus server with pymodbus and compares the answers; prints `all good`.

usage: modbus_all_functions.py tcp|rtu_over_tcp PORT  |  rtu|ascii DEVICE
The server has a file 4 of 20 records, a queue at 1246 that is empty, unit 1, and a vendor name `Works`.
"""
import sys

from pymodbus import FramerType, ModbusException
from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.pdu.file_message import FileRecord

kind, target = sys.argv[1:3]
if kind in ("tcp", "rtu_over_tcp"):
    framer = FramerType.SOCKET if kind == "tcp" else FramerType.RTU
    client = ModbusTcpClient("127.0.0.1", port=int(target), framer=framer, timeout=20, retries=0)
else:
    framer = FramerType.RTU if kind == "rtu" else FramerType.ASCII
    # A pseudo-terminal has no parity.
    client = ModbusSerialClient(target, framer=framer, baudrate=19200, parity="N", timeout=20, retries=0)
assert client.connect(), "no connection"
unit = {"device_id": 1}


def good(answer):
    assert not answer.isError(), answer
    return answer


def refused(answer, code):
    assert answer.isError() and answer.exception_code == code, answer


good(client.write_coil(10, True, **unit))
good(client.write_coils(11, [True, False, True], **unit))
assert good(client.read_coils(10, count=4, **unit)).bits[:4] == [True, True, False, True]
assert good(client.read_discrete_inputs(0, count=9, **unit)).bits[:9] == [False] * 9
good(client.write_register(7, 4711, **unit))
good(client.write_registers(20, list(range(100)), **unit))
assert good(client.read_holding_registers(20, count=100, **unit)).registers == list(range(100))
assert good(client.read_input_registers(0, count=2, **unit)).registers == [0, 0]
good(client.write_register(4, 0x12, **unit))
good(client.mask_write_register(address=4, and_mask=0xF2, or_mask=0x25, **unit))
answer = good(client.readwrite_registers(
    read_address=4, read_count=1, write_address=30, values=[1, 2], **unit))
assert answer.registers == [0x17], answer
assert good(client.read_exception_status(**unit)).status == 0
assert good(client.diag_query_data(b"\xA5\x37", **unit)).message in (b"\xA5\x37", [0xA537], 0xA537)
good(client.diag_read_diagnostic_register(**unit))
good(client.diag_clear_counters(**unit))
good(client.diag_read_bus_message_count(**unit))
good(client.diag_read_bus_comm_error_count(**unit))
good(client.diag_read_bus_exception_error_count(**unit))
good(client.diag_read_device_message_count(**unit))
good(client.diag_read_device_no_response_count(**unit))
good(client.diag_read_device_nak_count(**unit))
good(client.diag_read_device_busy_count(**unit))
good(client.diag_read_bus_char_overrun_count(**unit))
good(client.diag_get_comm_event_counter(**unit))
good(client.diag_get_comm_event_log(**unit))
assert b"dinrail" in good(client.report_device_id(**unit)).identifier
good(client.write_file_record(
    [FileRecord(file_number=4, record_number=3, record_data=b"\x12\x34\x56\x78")], **unit))
records = good(client.read_file_record(
    # Counted in bytes here.
    [FileRecord(file_number=4, record_number=3, record_length=4)], **unit)).records
assert records[0].record_data == b"\x12\x34\x56\x78", records
if kind in ("tcp", "ascii"):
    # pymodbus 3.16.1 takes an RTU answer to this function for two bytes shorter than it is.
    assert good(client.read_fifo_queue(address=1246, **unit)).values == []
basic = good(client.read_device_information(read_code=1, object_id=0, **unit))
assert basic.information[0] == b"Works" and basic.information[1] == b"P1" and basic.information[2] == b"7", basic
single = good(client.read_device_information(read_code=4, object_id=4, **unit))
assert single.information[4] == b"Press", single
refused(client.read_holding_registers(60000, count=1, **unit), 2)
refused(client.read_fifo_queue(address=1, **unit), 2)
refused(client.read_device_information(read_code=4, object_id=200, **unit), 2)
# Unit 5 has a map of its own: a double word, high word first. Only where it is served.
if kind != "ascii":
    five = {"device_id": 5}
    good(client.write_registers(0, [0x0A0B, 0x0C0D], **five))
    assert good(client.read_holding_registers(0, count=2, **five)).registers == [0x0A0B, 0x0C0D]
    refused(client.read_holding_registers(4, count=1, **five), 2)
    # %MD400 is bytes 1600 to 1603: registers 800 and 801 of the common map, low word first.
    assert good(client.read_holding_registers(800, count=2, **unit)).registers == [0x0C0D, 0x0A0B]
client.close()
print("all good")
