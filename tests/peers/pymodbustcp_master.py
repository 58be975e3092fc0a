"""A third master on TCP: pyModbusTCP.

usage: pymodbustcp_master.py PORT
"""
import sys

from pyModbusTCP.client import ModbusClient

client = ModbusClient(host="127.0.0.1", port=int(sys.argv[1]), unit_id=1, timeout=20)
assert client.write_multiple_registers(70, [1, 2, 3])
assert client.read_holding_registers(70, 3) == [1, 2, 3]
assert client.write_single_register(71, 9)
assert client.write_read_multiple_registers(72, [7], 70, 3) == [1, 9, 7]
assert client.write_single_coil(50, True) and client.write_multiple_coils(51, [True, False])
assert client.read_coils(50, 3) == [True, True, False]
assert client.read_discrete_inputs(0, 2) == [False, False]
assert client.read_input_registers(0, 2) == [0, 0]
assert client.read_device_identification().vendor_name == b"Works"
assert client.read_holding_registers(60000, 1) is None and client.last_except == 2
client.close()
