"""Reads registers with pymodbus and prints them, comma separated; exceptions as `exception N`.

usage: modbus_read.py PORT holding|input|coils|discrete ADDRESS COUNT
"""
import sys

from pymodbus.client import ModbusTcpClient

port, table, address, count = int(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
client = ModbusTcpClient("127.0.0.1", port=port, timeout=20)
assert client.connect(), "no connection"
read = {"holding": client.read_holding_registers, "input": client.read_input_registers,
        "coils": client.read_coils, "discrete": client.read_discrete_inputs}[table]
answer = read(address, count=count)
if answer.isError():
    print(f"exception {answer.exception_code}")
elif table in ("coils", "discrete"):
    print(",".join(str(int(bit)) for bit in answer.bits[:count]))
else:
    print(",".join(str(register) for register in answer.registers))
client.close()
