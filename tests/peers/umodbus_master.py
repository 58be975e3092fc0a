"""A fourth master: uModbus, on TCP and on an RTU line.

usage: umodbus_master.py PORT DEVICE
"""
import socket
import sys

import serial
from umodbus.client import tcp
from umodbus.client.serial import rtu
from umodbus.exceptions import IllegalDataAddressError

port, device = int(sys.argv[1]), sys.argv[2]
connection = socket.create_connection(("127.0.0.1", port), timeout=20)


def over_tcp(message):
    return tcp.send_message(message, connection)


line = serial.Serial(device, 19200, timeout=20)


def over_rtu(message):
    return rtu.send_message(message, line)


for base, protocol, ask in ((80, tcp, over_tcp), (90, rtu, over_rtu)):
    assert ask(protocol.write_multiple_registers(slave_id=1, starting_address=base, values=[5, 6])) == 2
    assert ask(protocol.read_holding_registers(slave_id=1, starting_address=base, quantity=2)) == [5, 6]
    assert ask(protocol.write_single_coil(slave_id=1, address=base, value=1)) == 1
    assert ask(protocol.write_multiple_coils(slave_id=1, starting_address=base + 1, values=[1, 0, 1])) == 3
    assert ask(protocol.read_coils(slave_id=1, starting_address=base, quantity=4)) == [1, 1, 0, 1]
    assert ask(protocol.read_discrete_inputs(slave_id=1, starting_address=0, quantity=1)) == [0]
    assert ask(protocol.read_input_registers(slave_id=1, starting_address=0, quantity=1)) == [0]
    try:
        ask(protocol.read_holding_registers(slave_id=1, starting_address=60000, quantity=1))
        sys.exit("register 60000 exists")
    except IllegalDataAddressError:
        pass
line.close()
connection.close()
