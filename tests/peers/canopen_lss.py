"""LSS and TIME from the other side. Usage: canopen_lss.py PORT PART [ARGUMENTS]

PORT is a cannelloni server on 127.0.0.1. See the functions `part_*` below."""

import struct
import sys
import time

import can
import canopen
import canopen.lss
import canopen.timestamp
from bus import where

PATIENCE = 30
UNCONFIGURED = 255


def say(text):
    print(text, flush=True)


class Slave:
    """An LSS slave of nothing but python-can: node-id, bit timing and storing, by CiA 305."""

    def __init__(self, bus, identity):
        self.bus = bus
        self.identity = identity
        self.node_id = UNCONFIGURED
        self.pending = UNCONFIGURED
        self.configuration = False
        self.selected = 0
        self.scanned = 0

    def answer(self, *data):
        self.bus.send(can.Message(arbitration_id=0x7E4, is_extended_id=False, data=bytes(data).ljust(8, b"\0")))

    def waits(self):
        self.configuration, self.selected = False, 0
        if self.node_id == UNCONFIGURED and self.pending != UNCONFIGURED:
            self.node_id = self.pending
            boot_up = can.Message(arbitration_id=0x700 + self.node_id, is_extended_id=False, data=b"\0")
            self.bus.send(boot_up)
            say(f"node-id {self.node_id}")

    def select(self, part, value):
        right = self.identity[part] == value
        self.selected = self.selected + 1 if right and self.selected == part else int(right and part == 0)
        if self.selected == 4:
            self.configuration = True
            self.answer(0x44)

    def scan(self, data):
        value, bit, sub, following = struct.unpack("<LBBB", data[1:8])
        if self.configuration or self.node_id != UNCONFIGURED or self.pending != UNCONFIGURED:
            return
        if bit == 0x80:
            self.scanned = 0
        elif sub != self.scanned or (self.identity[sub] ^ value) >> bit:
            return
        else:
            self.scanned = following
            if bit == 0 and following < sub:
                self.configuration = True
        self.answer(0x4F)

    def configure(self, data):
        if data[0] == 0x11:
            if 1 <= data[1] <= 127:
                self.pending = data[1]
            self.answer(0x11, 0 if 1 <= data[1] <= 127 else 1)
        elif data[0] == 0x13:
            say(f"bit timing {data[2]}")
            self.answer(0x13, 0)
        elif data[0] == 0x15:
            say(f"activate after {struct.unpack('<H', data[1:3])[0]} ms")
        elif data[0] == 0x17:
            say(f"stored {self.pending}")
            self.answer(0x17, 0)
        elif 0x5A <= data[0] <= 0x5D:
            self.answer(data[0], *struct.pack("<L", self.identity[data[0] - 0x5A]))
        elif data[0] == 0x5E:
            self.answer(0x5E, self.node_id)

    def take(self, data):
        if data[0] == 0x04:
            if data[1]:
                self.configuration = True
            else:
                self.waits()
        elif 0x40 <= data[0] <= 0x43 and not self.configuration:
            self.select(data[0] - 0x40, struct.unpack("<L", data[1:5])[0])
        elif data[0] == 0x4C and self.node_id == self.pending == UNCONFIGURED:
            self.answer(0x50)
        elif data[0] == 0x51:
            self.scan(data)
        elif self.configuration:
            self.configure(data)


def part_slave(port, *identity):
    """A device without node-id. Ends by being killed."""
    bus = can.Bus(**where(port), can_filters=[{"can_id": 0x7E5, "can_mask": 0x7FF}])
    slave = Slave(bus, [int(part, 0) for part in identity])
    say("here")
    while True:
        message = bus.recv(1)
        if message is not None and message.arbitration_id == 0x7E5 and len(message.data) == 8:
            slave.take(bytes(message.data))


def until(what, check):
    end = time.time() + PATIENCE
    while True:
        value = check()
        if value:
            return value
        assert time.time() < end, f"waited in vain for: {what}"
        time.sleep(0.005)


def connect(port):
    network = canopen.Network()
    network.connect(**where(port))
    frames = []
    network.notifier.add_listener(lambda frame: frames.append((time.monotonic(), frame)))
    return network, frames


def part_bit_timing(port, node_id, *identity):
    """python-canopen as LSS master: bit timing, its activation, storing."""
    node_id = int(node_id)
    network, frames = connect(port)
    lss = network.lss
    lss.RESPONSE_TIMEOUT = 5
    node = network.add_node(node_id, canopen.ObjectDictionary())
    node.sdo.RESPONSE_TIMEOUT = PATIENCE
    node.sdo.download(0x1017, 0, struct.pack("<H", 20))
    assert lss.send_switch_state_selective(*[int(part, 0) for part in identity])
    # The bus has 1 Mbit/s and its driver owns it: another rate would take the device off the bus.
    for refused in (1, 2, 5, 8):
        try:
            lss.configure_bit_timing(refused)
            raise AssertionError(f"bit timing {refused} is not refused")
        except canopen.lss.LssError as error:
            assert "1" in str(error), error
    lss.configure_bit_timing(0)
    lss.store_configuration()
    beats = lambda: [at for at, frame in list(frames) if frame.arbitration_id == 0x700 + node_id]
    until("heartbeats", lambda: len(beats()) > 3)
    before = len(beats())
    lss.activate_bit_timing(250)
    # Silent for twice the delay, then there again.
    until("heartbeats again", lambda: len(beats()) > before + 10)
    times = beats()
    longest = max(b - a for a, b in zip(times, times[1:]))
    assert longest > 0.3, f"never silent: {longest}"
    lss.send_switch_state_global(lss.WAITING_STATE)
    network.disconnect()
    say("bit_timing")


def part_time(port, node_id):
    """python-canopen's TIME producer, for a node whose 1012h consumes it."""
    network, _ = connect(port)
    node = network.add_node(int(node_id), canopen.ObjectDictionary())
    node.sdo.RESPONSE_TIMEOUT = PATIENCE
    producer = canopen.timestamp.TimeProducer(network)
    # Nothing is consumed before 1012h says so.
    producer.transmit(1_700_000_000)
    node.sdo.download(0x1012, 0, struct.pack("<L", 0x80000100))
    producer.transmit(1_893_456_000.25)
    # The device has taken it when it answers.
    node.sdo.upload(0x1000, 0)
    network.disconnect()
    say("time")


def part_read_time(port):
    """What our TIME producer sends, read by python-can."""
    bus = can.Bus(**where(port), can_filters=[{"can_id": 0x100, "can_mask": 0x7FF}])
    stamps = []
    end = time.time() + PATIENCE
    while len(stamps) < 5:
        assert time.time() < end, "no TIME messages"
        message = bus.recv(1)
        if message is None or message.arbitration_id != 0x100:
            continue
        assert len(message.data) == 6, message
        ms, days = canopen.timestamp.TIME_OF_DAY_STRUCT.unpack(message.data)
        assert ms < 86_400_000, ms
        stamp = canopen.timestamp.OFFSET + days * canopen.timestamp.ONE_DAY + ms / 1000
        assert abs(stamp - time.time()) < 20, (stamp, time.time())
        stamps.append(stamp)
    assert all(a < b for a, b in zip(stamps, stamps[1:])), stamps
    bus.shutdown()
    say("read_time")


globals()[f"part_{sys.argv[2]}"](sys.argv[1], *sys.argv[3:])
