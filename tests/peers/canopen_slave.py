"""A device made of python-canopen's LocalNode. Usage: canopen_slave.py BUS EDS NODE-ID SERIAL

BUS is a port of a cannelloni server on 127.0.0.1, or a network interface. An I/O device after CiA 401 by its EDS: its
inputs show its outputs. LocalNode brings the SDO server, the heartbeat and the PDO maps; the state machine's reset,
SYNC, remote frames and node guarding are done here, as an application of it must.
Commands on stdin: `emcy`, `emcy gone`, `quiet` (does nothing any more, without ending). It prints what happens to it."""

import sys
import threading

import can
import canopen
from bus import where


def say(text):
    print(text, flush=True)


class Device(can.Listener):
    def __init__(self, bus, eds, node_id, serial):
        self.net = canopen.Network()
        self.net.connect(**where(bus))
        self.id, self.eds, self.serial = node_id, eds, serial
        self.toggle = 0
        self.quiet = False
        self.waiting = {}
        self.syncs = 0
        self.changed = False
        self.node = self.net.create_node(node_id, eds)
        for number, pdo in self.node.rpdo.map.items():
            pdo.add_callback(lambda pdo, number=number: self.received(number, pdo))
        self.net.notifier.add_listener(self)
        self.net.subscribe(0, self.commanded)
        self.net.subscribe(0x80, self.synchronised)
        self.node.add_write_callback(self.written)
        # Before its boot-up message: the master may be faster than the next line here.
        say("ready")
        self.reset()

    def reset(self):
        self.node.data_store.clear()
        self.node.sdo[0x1018][4].raw = self.serial
        self.node.nmt.stop_heartbeat()
        self.toggle = 0
        self.syncs = 0
        # LocalNode takes its default from the EDS, where nothing may stand.
        for index in (0x6000, 0x6200, 0x6401, 0x6411):
            for sub in range(1, len(self.node.object_dictionary[index])):
                self.node.sdo[index][sub].raw = 0
        self.node.nmt.state = "INITIALISING"
        self.node.nmt.state = "PRE-OPERATIONAL"

    def commanded(self, _can_id, data, _timestamp):
        command, node_id = data[0], data[1]
        if node_id not in (0, self.id) or self.quiet:
            return
        if command in (129, 130):
            say("reset")
            self.reset()
        elif command == 1:
            self.node.rpdo.read()
            self.node.tpdo.read()
            say(f"operational {self.node.sdo[0x2001].raw:#x}")
            self.changed = True
            self.sample(lambda pdo: pdo.trans_type == 252)
            self.send(lambda pdo: pdo.trans_type >= 254)
        elif command == 128:
            say("pre-operational")
        elif command == 2:
            say("stopped")

    def operational(self):
        return self.node.nmt.state == "OPERATIONAL" and not self.quiet

    def active(self):
        return [p for p in self.node.tpdo.map.values() if p.enabled and p.map and p.trans_type is not None]

    def sample(self, which):
        chosen = [pdo for pdo in self.active() if which(pdo)]
        for pdo in chosen:
            for var in pdo.map:
                var.raw = self.node.sdo[var.index][var.subindex].raw
        return chosen

    def send(self, which):
        for pdo in self.sample(which):
            pdo.transmit()

    def received(self, number, pdo):
        if self.operational():
            self.waiting[number] = pdo
            if pdo.trans_type > 240:
                self.take()
                self.send(lambda pdo: pdo.trans_type >= 254)

    def take(self):
        for pdo in self.waiting.values():
            for var in pdo.map:
                self.node.sdo[var.index][var.subindex].raw = var.raw
        self.waiting.clear()
        self.changed = True
        self.show()

    def show(self):
        for sub in (1, 2):
            self.node.sdo[0x6000][sub].raw = self.node.sdo[0x6200][sub].raw
        for sub in range(1, 5):
            self.node.sdo[0x6401][sub].raw = self.node.sdo[0x6411][sub].raw

    def synchronised(self, _can_id, _data, _timestamp):
        if self.operational():
            self.syncs += 1
            if self.waiting:
                self.take()
                self.send(lambda pdo: pdo.trans_type >= 254)
            self.send(lambda pdo: 1 <= pdo.trans_type <= 240 and self.syncs % pdo.trans_type == 0)
            if self.changed:
                self.send(lambda pdo: pdo.trans_type == 0)
            self.changed = False
            self.sample(lambda pdo: pdo.trans_type == 252)

    def written(self, index, subindex, data, **_):
        if index == 0x1005 or index == 0x2001:
            say(f"written {index:04x}:{subindex:02x} {bytes(data).hex()}")

    def on_message_received(self, message):
        """Remote frames: PDOs on request, and node guarding, whose answer tells the state with a toggle bit."""
        if not message.is_remote_frame or self.quiet:
            return
        if self.operational():
            self.sample(lambda pdo: pdo.trans_type == 253 and pdo.cob_id == message.arbitration_id)
            for pdo in self.active():
                if pdo.trans_type in (252, 253) and pdo.cob_id == message.arbitration_id:
                    pdo.transmit()
        if message.arbitration_id == 0x700 + self.id:
            state = {"OPERATIONAL": 5, "STOPPED": 4}.get(self.node.nmt.state, 127)
            self.net.send_message(0x700 + self.id, bytes([state | self.toggle]))
            self.toggle ^= 0x80

    def told(self, line):
        if line == "emcy":
            self.node.emcy.send(0x3110, 0x05, b"volts")
        elif line == "emcy gone":
            self.node.emcy.reset()
        elif line == "quiet":
            self.quiet = True
            self.node.nmt.stop_heartbeat()
        elif line == "speak":
            self.quiet = False
            self.reset()


def main():
    bus, eds, node_id, serial = sys.argv[1:5]
    device = Device(bus, eds, int(node_id), int(serial))
    for line in sys.stdin:
        device.told(line.strip())
    threading.Event().wait()


main()
