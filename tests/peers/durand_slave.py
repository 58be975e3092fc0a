"""A device made of durand. Usage: durand_slave.py BUS NODE-ID SERIAL..., or durand_slave.py eds

BUS is a port of a cannelloni server on 127.0.0.1, or a network interface. With `eds` it prints the electronic data
sheet that durand makes of the device. Its inputs show its outputs; 2000h is a memory of any length, 2001h a number. A
node-id of 255 waits for LSS; then there may be several, each with a serial number. Commands on stdin: `emcy`,
`emcy gone`, to the last of them."""

import sys
import threading

import can
from bus import where
from durand import CANBusNetwork, MinimalNode, Record, Variable
from durand import DatatypeEnum as DT
from durand.network import NetworkABC
from durand.scheduler import SyncScheduler, set_scheduler


class Nowhere(NetworkABC):
    def add_subscription(self, cob_id, callback):
        pass

    def remove_subscription(self, cob_id):
        pass

    def send(self, cob_id, msg):
        pass


def record(name, kind, access, count):
    made = Record(name=name)
    for sub in range(1, count + 1):
        made[sub] = Variable(kind, access, 0, name=f"{name} {sub}")
    return made


def device(network, node_id, serial):
    node = MinimalNode(network, node_id)
    od = node.object_dictionary
    node.eds.device_info.VendorName = "durand"
    od.write(0x1000, 0, 0x000F0191)
    od.write(0x1018, 1, 0x0000_0D0D)
    od.write(0x1018, 2, 0x0401)
    od.write(0x1018, 3, 2)
    od.write(0x1018, 4, serial)
    od[0x2000] = Variable(DT.DOMAIN, "rw", name="Memory")
    od[0x2001] = Variable(DT.UNSIGNED32, "rw", 0, name="Number", maximum=0xFFFF_0000)
    od[0x2002] = Variable(DT.UNSIGNED8, "ro", 0, name="Read only")
    od[0x6000] = record("Digital input", DT.UNSIGNED8, "ro", 2)
    od[0x6200] = record("Digital output", DT.UNSIGNED8, "rw", 2)
    od[0x6401] = record("Analogue input", DT.INTEGER16, "ro", 4)
    od[0x6411] = record("Analogue output", DT.INTEGER16, "rw", 4)
    for source, sink, count in ((0x6200, 0x6000, 2), (0x6411, 0x6401, 4)):
        for sub in range(1, count + 1):
            od.update_callbacks[(source, sub)].add(lambda value, sink=sink, sub=sub: od.write(sink, sub, value))
    node.tpdo[0].mapping = [(0x6000, 1), (0x6000, 2)]
    node.rpdo[0].mapping = [(0x6200, 1), (0x6200, 2)]
    return node


def main():
    if sys.argv[1] == "eds":
        print(device(Nowhere(), 1, 1).eds.content)
        return
    node_id, *serials = (int(text) for text in sys.argv[2:])
    scheduler = SyncScheduler()
    set_scheduler(scheduler)
    threading.Thread(target=scheduler.run, daemon=True).start()
    # A network of durand has one subscriber for an identifier.
    nodes = [device(CANBusNetwork(can.Bus(**where(sys.argv[1]))), node_id, serial) for serial in serials]
    node = nodes[-1]
    print("ready", flush=True)
    for line in sys.stdin:
        if line.strip() == "emcy":
            node.emcy.set(0x2310, 0x03, b"amps!")
        elif line.strip() == "emcy gone":
            node.emcy.set(0, 0)
    threading.Event().wait()


main()
