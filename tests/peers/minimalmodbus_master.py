"""A second master on a serial line: minimalmodbus. It compares every byte of an answer.

usage: minimalmodbus_master.py rtu|ascii DEVICE
"""
import sys

import minimalmodbus
import serial

mode, device = sys.argv[1:3]
instrument = minimalmodbus.Instrument(device, 1, mode=mode)
instrument.serial.parity = serial.PARITY_NONE
instrument.serial.timeout = 20
instrument.write_register(40, 1234, functioncode=6)
instrument.write_register(41, 4321, functioncode=16)
assert instrument.read_registers(40, 2) == [1234, 4321]
instrument.write_bit(30, 1)
instrument.write_bits(31, [0, 1, 1])
assert instrument.read_bits(30, 4, functioncode=1) == [1, 0, 1, 1]
instrument.write_string(50, "dinrail!", 4)
assert instrument.read_string(50, 4) == "dinrail!"
instrument.write_long(60, 123456789)
assert instrument.read_long(60) == 123456789
assert instrument.read_register(0, functioncode=4) == 0
# It waits out its time for the bytes of a good answer.
instrument.serial.timeout = 5
try:
    instrument.read_register(60000)
    sys.exit("register 60000 exists")
except minimalmodbus.IllegalRequestError:
    pass
