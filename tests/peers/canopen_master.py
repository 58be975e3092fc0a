"""python-canopen as master of a network. Usage: canopen_master.py INTERFACE PORT EDS PART...

INTERFACE is cannelloni or slcan, a server on 127.0.0.1 at PORT, or socketcan with the network interface PORT. Every
part prints its name when it is through; one that needs somebody else prints what it waits for. See the functions
`part_*` below."""

import random
import struct
import sys
import time

import can
import canopen
from bus import where

SIMULATED = 2
DEVICE = 5
PATIENCE = 20


def say(text):
    print(text, flush=True)


def bus(interface, port):
    if interface == "slcan":
        return {"interface": "slcan", "channel": f"socket://127.0.0.1:{port}", "sleep_after_open": 0.1}
    return where(port)


class Network:
    """The network, and every frame of the bus that is not ours."""

    def __init__(self, interface, port, eds):
        self.net = canopen.Network()
        self.frames = []
        self.net.connect(**bus(interface, port))
        self.net.notifier.add_listener(lambda message: self.frames.append(message))
        self.eds = eds

    def node(self, node_id):
        node = self.net.add_node(node_id, self.eds)
        node.sdo.RESPONSE_TIMEOUT = PATIENCE
        return node

    def seen(self, can_id):
        return [f for f in list(self.frames) if f.arbitration_id == can_id and not f.is_remote_frame]

    def forget(self):
        self.frames.clear()


def until(what, check):
    end = time.time() + PATIENCE
    while True:
        value = check()
        if value:
            return value
        assert time.time() < end, f"waited in vain for: {what}"
        time.sleep(0.005)


def aborts(code, action):
    try:
        action()
    except canopen.SdoAbortedError as error:
        assert error.code == code, f"abort {error.code:08X}h instead of {code:08X}h"
        return
    raise AssertionError(f"no abort {code:08X}h")


def heartbeat_state(network, node, expected):
    """The state that the next heartbeats tell becomes the expected one."""
    until(f"heartbeat {expected}", lambda: node.nmt.wait_for_heartbeat(PATIENCE) == expected)


def reset(network, node, command="RESET"):
    """The boot-up message may come before python-canopen's own `wait_for_bootup` begins to wait."""
    network.forget()
    node.nmt.state = command
    until("boot-up message", lambda: any(bytes(f.data) == b"\0" for f in network.seen(0x700 + node.id)))


def part_nmt(network):
    """States, boot-up message, heartbeat."""
    node = network.node(SIMULATED)
    for command in ("RESET", "RESET COMMUNICATION"):
        reset(network, node, command)
    node.sdo[0x1017].raw = 20
    for state in ("PRE-OPERATIONAL", "OPERATIONAL", "STOPPED", "PRE-OPERATIONAL", "OPERATIONAL"):
        node.nmt.state = state
        heartbeat_state(network, node, state)
    # A stopped node has no SDO server.
    node.nmt.state = "STOPPED"
    heartbeat_state(network, node, "STOPPED")
    node.sdo.RESPONSE_TIMEOUT = 0.2
    try:
        node.sdo[0x1017].raw
        raise AssertionError("SDO of a stopped node")
    except canopen.SdoCommunicationError:
        pass
    node.sdo.RESPONSE_TIMEOUT = PATIENCE
    node.nmt.state = "PRE-OPERATIONAL"
    heartbeat_state(network, node, "PRE-OPERATIONAL")
    node.sdo[0x1017].raw = 0
    # All at once.
    network.net.nmt.state = "OPERATIONAL"
    network.net.nmt.state = "RESET COMMUNICATION"
    until("boot-up of all", lambda: [f for f in network.seen(0x700 + DEVICE) if bytes(f.data) == b"\0"])


def part_heartbeat_consumer(network):
    """The slave watches the master: EMCY 8130h and the error behaviour of 1029h when it is silent, and its return."""
    node = network.node(SIMULATED)
    reset(network, node, "RESET COMMUNICATION")
    node.sdo[0x1016][1].raw = (99 << 16) | 100
    node.sdo[0x1017].raw = 20
    node.nmt.state = "OPERATIONAL"
    heartbeat_state(network, node, "OPERATIONAL")
    own = network.net.send_periodic(0x700 + 99, b"\x05", 0.02)
    time.sleep(0.2)
    assert not node.emcy.log, node.emcy.log
    own.stop()
    until("EMCY 8130h", lambda: [e for e in node.emcy.log if e.code == 0x8130 and e.register & 0x11 == 0x11])
    heartbeat_state(network, node, "PRE-OPERATIONAL")
    own = network.net.send_periodic(0x700 + 99, b"\x05", 0.02)
    until("EMCY 0000h", lambda: [e for e in node.emcy.log if e.code == 0])
    own.stop()
    reset(network, node)


def part_sdo(network):
    """Expedited and segmented transfers, 10 kB by block both ways with CRC, abort codes."""
    node = network.node(SIMULATED)
    assert node.sdo[0x1000].raw == 0x000F0191
    assert node.sdo[0x1008].raw == "Simulated I/O"
    assert node.sdo[0x1018]["Serial number"].raw == 7
    assert node.sdo[0x1018][0].raw == 4
    for value in (0, 1, 0x12345678, 0xFFFFFFFF):
        node.sdo[0x2001].raw = value
        assert node.sdo[0x2001].raw == value
    for size in (1, 4, 5, 7, 8, 700, 10_240):
        data = random.randbytes(size)
        node.sdo.download(0x2000, 0, data, force_segment=True)
        assert node.sdo.upload(0x2000, 0) == data, f"{size} bytes by segments"
    block(node, 10_240)
    # 889 bytes are one sub-block of 127 segments.
    for size in (1, 6, 7, 8, 888, 889, 890, 1778):
        block(node, size)
    sdo = node.sdo
    aborts(0x06020000, lambda: sdo.upload(0x5000, 0))
    aborts(0x06090011, lambda: sdo.upload(0x1018, 9))
    aborts(0x06010002, lambda: sdo.download(0x1000, 0, b"\0\0\0\0"))
    aborts(0x06070012, lambda: sdo.download(0x1017, 0, b"\0\0\0"))
    aborts(0x06070013, lambda: sdo.download(0x2001, 0, b"\0"))
    aborts(0x06040041, lambda: map_one(node, 0x1A00, 0x10000020))
    # A command specifier that does not exist, and a toggle bit that stays.
    network.forget()
    network.net.send_message(0x600 + SIMULATED, bytes([0xE0, 0, 0, 0, 0, 0, 0, 0]))
    refused = until("abort", lambda: network.seen(0x580 + SIMULATED))[0]
    assert struct.unpack("<I", refused.data[4:])[0] == 0x05040001, refused
    network.forget()
    network.net.send_message(0x600 + SIMULATED, bytes([0x40, 0x08, 0x10, 0, 0, 0, 0, 0]))
    until("upload begun", lambda: network.seen(0x580 + SIMULATED))
    network.forget()
    network.net.send_message(0x600 + SIMULATED, bytes([0x70, 0, 0, 0, 0, 0, 0, 0]))
    refused = until("abort", lambda: network.seen(0x580 + SIMULATED))[0]
    assert struct.unpack("<I", refused.data[4:])[0] == 0x05030000, refused


def map_one(node, index, value):
    node.sdo[index - 0x200][1].raw = node.sdo[index - 0x200][1].raw | 1 << 31
    node.sdo.download(index, 0, b"\0")
    node.sdo.download(index, 1, struct.pack("<I", value))


def block(node, size):
    data = random.randbytes(size)
    with node.sdo.open(0x2000, 0, "wb", size=size, block_transfer=True) as stream:
        stream.write(data)
    with node.sdo.open(0x2000, 0, "rb", block_transfer=True) as stream:
        assert stream.read() == data, f"{size} bytes by block"


def part_megabyte(network):
    """1 MB by block both ways: CRC, sub-blocks, the largest value of the device."""
    node = network.node(SIMULATED)
    block(node, 1 << 20)
    # One more does not fit.
    def too_long():
        with node.sdo.open(0x2000, 0, "wb", size=(1 << 20) + 1, block_transfer=True) as stream:
            stream.write(b"\0")
    aborts(0x06070012, too_long)


def fresh(network):
    node = network.node(SIMULATED)
    reset(network, node)
    return node


def outputs(node):
    node.rpdo.read()
    node.tpdo.read()
    return node.rpdo[1], node.tpdo[1]


def part_pdo(network):
    """Defaults, remapping, event, inhibit time, event timer, SYNC of every kind. RTR has a part of its own."""
    node = fresh(network)
    receive, transmit = outputs(node)
    assert [v.name for v in receive.map] == ["Digital outputs.Digital outputs 1-8", "Digital outputs.Digital outputs 9-16"]
    assert (receive.cob_id, transmit.cob_id, transmit.trans_type) == (0x202, 0x182, 255)
    # Not operational: no PDO is taken or sent.
    receive[0].raw = 1
    receive.transmit()
    assert node.sdo[0x6200][1].raw == 0
    node.nmt.state = "OPERATIONAL"
    # Event driven: the simulation shows its outputs at its inputs.
    for value in (0x55, 0xAA):
        transmit.is_received = False
        receive[0].raw, receive[1].raw = value, value ^ 0xFF
        receive.transmit()
        until("TPDO", lambda: transmit.data == bytes([value, value ^ 0xFF]))
        assert node.sdo[0x6200][1].raw == value
    remapped(network, node)
    every_type(network, node)
    synchronous(network, node)
    timed(network, node)
    wrong_length(network, node)
    reset(network, node)


def remapped(network, node):
    node.nmt.state = "PRE-OPERATIONAL"
    receive, transmit = node.rpdo[2], node.tpdo[2]
    receive.clear()
    receive.add_variable(0x6411, 3)
    receive.add_variable(0x6200, 2)
    receive.add_variable(0x6411, 1)
    receive.cob_id, receive.enabled = 0x3A2, True
    receive.save()
    transmit.clear()
    for sub in (1, 3):
        transmit.add_variable(0x6401, sub)
    transmit.add_variable(0x6000, 2)
    transmit.cob_id, transmit.enabled = 0x2A2, True
    transmit.save()
    node.nmt.state = "OPERATIONAL"
    receive[0].raw, receive[1].raw, receive[2].raw = -2, 0x3C, 1234
    receive.transmit()
    until("the remapped TPDO", lambda: transmit.data == struct.pack("<hhB", 1234, -2, 0x3C))
    assert [transmit[i].raw for i in range(3)] == [1234, -2, 0x3C]


def kind(node, pdo, number, **more):
    """Configures a PDO as the standard wants it: not valid meanwhile."""
    pdo.trans_type, pdo.enabled = number, True
    for sub, name in ((3, "inhibit_time"), (5, "event_timer"), (6, "sync_start_value")):
        setattr(pdo, name, more.get(name, 0) if sub in pdo.com_record else None)
    pdo.save()


def sync(network, node, times):
    """SYNCs one after the other: the node has seen each when it answers."""
    for _ in range(times):
        network.net.sync.transmit()
        node.sdo[0x1000].raw


def every_type(network, node):
    """What a receive PDO brought works at the next SYNC with types 0 to 240, at once with 254 and 255; the others are
    refused. A transmit PDO of type 254 is sent by the event of the manufacturer, here every change."""
    receive, transmit = node.rpdo[1], node.tpdo[1]
    for number in (0, 1, 7, 240, 254, 255):
        kind(node, receive, number)
        kind(node, transmit, 254 if number == 254 else 255)
        before = node.sdo[0x6200][1].raw
        value = before ^ 0xFF
        receive[0].raw = value
        receive.transmit()
        after = node.sdo[0x6200][1].raw
        assert after == (value if number > 240 else before), f"type {number}: {before:#x} {value:#x} {after:#x}"
        network.net.sync.transmit()
        until(f"the value of type {number}", lambda: node.sdo[0x6200][1].raw == value)
        until(f"the TPDO after type {number}", lambda: transmit.data[:1] == bytes([value]))
    for index, reserved in ((0x1400, (241, 251, 252, 253)), (0x1800, (241, 251))):
        for number in reserved:
            aborts(0x06090030, lambda: node.sdo.download(index, 2, bytes([number])))


def synchronous(network, node):
    receive, transmit = node.rpdo[1], node.tpdo[1]
    # Every third SYNC.
    kind(node, transmit, 3)
    network.forget()
    sync(network, node, 9)
    until("three TPDOs", lambda: len(network.seen(transmit.cob_id)) == 3)
    # What a synchronous RPDO brought works at the next SYNC, and type 0 sends at a SYNC after a change only.
    kind(node, receive, 1)
    kind(node, transmit, 0)
    network.net.sync.transmit()
    node.sdo[0x1000].raw
    before = node.sdo[0x6200][1].raw
    receive[0].raw = before ^ 0x0F
    receive.transmit()
    assert node.sdo[0x6200][1].raw == before
    network.forget()
    network.net.sync.transmit()
    until("the value after the SYNC", lambda: node.sdo[0x6200][1].raw == before ^ 0x0F)
    network.net.sync.transmit()
    until("the TPDO of type 0", lambda: network.seen(transmit.cob_id))
    sync(network, node, 3)
    assert len(network.seen(transmit.cob_id)) == 1, network.seen(transmit.cob_id)
    # With counter: the simulation shows it at analogue input 4; a TPDO waits for its start value.
    node.nmt.state = "PRE-OPERATIONAL"
    node.sdo[0x1019].raw = 10
    counted = node.tpdo[2]
    counted.clear()
    counted.add_variable(0x6401, 4)
    kind(node, counted, 1, sync_start_value=4)
    node.nmt.state = "OPERATIONAL"
    network.forget()
    for count in range(1, 7):
        network.net.sync.transmit(count)
        node.sdo[0x1000].raw
    sent = lambda: [struct.unpack("<h", f.data)[0] for f in network.seen(counted.cob_id)]
    until("TPDOs from the 4th SYNC on", lambda: len(sent()) == 3)
    # The counter is the application's event of the SYNC, and the TPDO is sampled before it.
    assert sent() == [3, 4, 5], sent()
    node.nmt.state = "PRE-OPERATIONAL"
    node.sdo[0x1019].raw = 0
    node.nmt.state = "OPERATIONAL"


def timed(network, node):
    receive, transmit = node.rpdo[1], node.tpdo[1]
    kind(node, receive, 255)
    # Changes within the inhibit time of 200 ms (unit 100 us) come as one TPDO with the newest value.
    kind(node, transmit, 255, inhibit_time=2000)
    node.sdo[0x1000].raw
    time.sleep(0.25)
    network.forget()
    for value in range(1, 9):
        receive[0].raw = value
        receive.transmit()
    until("the newest value", lambda: [f for f in network.seen(transmit.cob_id) if f.data[0] == 8])
    assert len(network.seen(transmit.cob_id)) < 8, network.seen(transmit.cob_id)
    # The event timer sends without change.
    kind(node, transmit, 255, event_timer=20)
    network.forget()
    until("five TPDOs by the timer", lambda: len(network.seen(transmit.cob_id)) >= 5)
    kind(node, transmit, 255)


def wrong_length(network, node):
    """A PDO that is too short is refused with EMCY 8210h, and the next right one ends the error."""
    receive = node.rpdo[1]
    node.emcy.reset()
    network.net.send_message(receive.cob_id, b"\x01")
    until("EMCY 8210h", lambda: [e for e in node.emcy.log if e.code == 0x8210])
    assert node.sdo[0x1003][0].raw >= 1
    assert node.sdo[0x1003][1].raw & 0xFFFF == 0x8210
    assert node.sdo[0x1001].raw & 0x11
    receive.transmit()
    until("EMCY 0000h", lambda: [e for e in node.emcy.log if e.code == 0])


def part_rtr(network):
    """PDOs on request: types 253 and 252, and node guarding with its toggle bit and life guarding."""
    node = fresh(network)
    receive, transmit = outputs(node)
    node.nmt.state = "OPERATIONAL"
    kind(node, transmit, 253)
    node.sdo[0x1000].raw
    network.forget()
    receive[0].raw, receive[1].raw = 0x77, 0x11
    receive.transmit()
    node.sdo[0x1000].raw
    assert not network.seen(transmit.cob_id), "type 253 sends on request only"
    transmit.remote_request()
    until("the TPDO on request", lambda: [bytes(f.data) for f in network.seen(transmit.cob_id)] == [b"\x77\x11"])
    # 252: the value is taken at the SYNC, and sent on request.
    kind(node, transmit, 252)
    network.net.sync.transmit()
    node.sdo[0x1000].raw
    receive[0].raw = 0x78
    receive.transmit()
    node.sdo[0x1000].raw
    network.forget()
    transmit.remote_request()
    until("the value of the SYNC", lambda: [f.data[0] for f in network.seen(transmit.cob_id)] == [0x77])
    network.net.sync.transmit()
    node.sdo[0x1000].raw
    network.forget()
    transmit.remote_request()
    until("the value of the next SYNC", lambda: [f.data[0] for f in network.seen(transmit.cob_id)] == [0x78])
    guarding(network, node)


def guarding(network, node):
    node.sdo[0x1017].raw = 0
    node.sdo[0x100C].raw = 50
    node.sdo[0x100D].raw = 3
    network.forget()
    node.nmt.start_node_guarding(0.05)
    answers = until("six answers", lambda: len(network.seen(0x700 + SIMULATED)) >= 6 and network.seen(0x700 + SIMULATED))
    states = [f.data[0] for f in answers[:6]]
    assert {s & 0x7F for s in states} == {5}, states
    assert all(a ^ b == 0x80 for a, b in zip(states, states[1:])), states
    assert states[0] == 0x05, "the toggle bit of the first answer is 0"
    # Nobody guards: life guarding tells, and sends the node to pre-operational (1029h is 0).
    node.emcy.reset()
    node.nmt.stop_node_guarding()
    until("EMCY 8130h", lambda: [e for e in node.emcy.log if e.code == 0x8130])
    node.nmt.start_node_guarding(0.05)
    until("pre-operational", lambda: node.nmt.state == "PRE-OPERATIONAL")
    node.nmt.stop_node_guarding()
    reset(network, node)


def silent(node):
    try:
        node.nmt.wait_for_heartbeat(0.5)
    except canopen.nmt.NmtError:
        return True
    return False


def part_loss(network):
    """A device that dies sends no heartbeat any more; when it is back it tells by its boot-up message."""
    node = fresh(network)
    node.sdo[0x1017].raw = 50
    node.nmt.state = "OPERATIONAL"
    heartbeat_state(network, node, "OPERATIONAL")
    say("kill it")
    until("silence", lambda: silent(node))
    network.forget()
    say("start it")
    until("the boot-up message", lambda: [bytes(f.data) for f in network.seen(0x700 + SIMULATED)] == [b"\0"])
    assert node.sdo[0x1017].raw == 0, "its configuration is the default again"
    node.sdo[0x1017].raw = 50
    heartbeat_state(network, node, "PRE-OPERATIONAL")
    reset(network, node)


def part_device(network):
    """A program of the PLC is the device: its inputs are the outputs of the network and back; EMCY when it stops."""
    node = network.node(DEVICE)
    reset(network, node)
    receive, transmit = outputs(node)
    analogue_out, analogue_in = node.rpdo[2], node.tpdo[2]
    node.nmt.state = "OPERATIONAL"
    for lamps, valve in ((0x5A, 1000), (0xA5, -7)):
        receive[0].raw = lamps
        receive.transmit()
        analogue_out[0].raw = valve
        analogue_out.transmit()
        until("the program's answer", lambda: transmit.data[:1] == bytes([lamps]))
        until("the program's number", lambda: analogue_in.data and analogue_in[0].raw == valve + 1)
    # SDO reaches the same objects.
    node.sdo[0x6200][1].raw = 0x3C
    until("the program's answer by SDO", lambda: node.sdo[0x6000][1].raw == 0x3C)
    # Stored objects outlive a reset.
    node.sdo[0x1015].raw = 500
    node.sdo[0x1010][1].raw = 0x65766173
    aborts(0x08000020, lambda: node.sdo.download(0x1010, 1, b"nope"))
    reset(network, node)
    assert node.sdo[0x1015].raw == 500
    node.sdo[0x1011][1].raw = 0x64616F6C
    reset(network, node)
    assert node.sdo[0x1015].raw == 0
    node.sdo[0x1017].raw = 50
    node.nmt.state = "OPERATIONAL"
    heartbeat_state(network, node, "OPERATIONAL")
    node.emcy.reset()
    say("stop the plc")
    until("EMCY FF10h", lambda: [e for e in node.emcy.log if e.code == 0xFF10 and e.register & 1])
    heartbeat_state(network, node, "PRE-OPERATIONAL")
    assert node.sdo[0x1003][1].raw & 0xFFFF == 0xFF10
    say("start the plc")
    until("EMCY 0000h", lambda: [e for e in node.emcy.log if e.code == 0])
    reset(network, node)


def part_fastscan(network):
    """Finds all devices without node-id, one by one, gives them node-ids from 20 on, and talks to them."""
    lss = network.net.lss
    # Our answers come within a millisecond; half a second of waiting for each silent bit is for slow buses. A machine
    # that is busy needs some of it all the same.
    lss.RESPONSE_TIMEOUT = 0.25
    found = []
    tries = 0
    while len(found) < 8:
        is_there, address = lss.fast_scan()
        if not is_there:
            # python-canopen takes an answer that comes more than 10 ms late, on a busy machine, for the next one's.
            tries += 1
            assert tries < 20, f"only {found} found"
            lss.send_switch_state_global(lss.WAITING_STATE)
            time.sleep(0.1)
            continue
        assert address[:3] == [0, 0x401, 0x10000], address
        found.append(address[3])
        tries = 0
        assert lss.inquire_node_id() == 255
        assert lss.inquire_lss_address(0x5D) == address[3]
        lss.configure_node_id(19 + len(found))
        lss.send_switch_state_global(lss.WAITING_STATE)
    assert sorted(found) == list(range(1, 9)), found
    assert lss.fast_scan() == (False, None), "nobody is left"
    for i, serial in enumerate(found):
        node = network.node(20 + i)
        assert node.sdo[0x1018][4].raw == serial
        node.nmt.state = "OPERATIONAL"
    # Selective switch and inquiry of one that has a node-id; a new node-id takes effect at its reset. A device
    # takes no other bit timing than that of its bus, and has no file to store anything.
    lss.RESPONSE_TIMEOUT = 2
    assert lss.send_switch_state_selective(0, 0x401, 0x10000, 3)
    third = 20 + found.index(3)
    assert lss.inquire_node_id() == third
    assert lss.inquire_lss_address(0x5B) == 0x401
    for refused in (lambda: lss.configure_bit_timing(2), lss.store_configuration, lambda: lss.configure_node_id(200)):
        try:
            refused()
            raise AssertionError("not refused")
        except canopen.lss.LssError:
            pass
    lss.configure_node_id(77)
    lss.send_switch_state_global(lss.WAITING_STATE)
    network.net[third].nmt.state = "RESET COMMUNICATION"
    until("boot-up with node-id 77", lambda: network.seen(0x700 + 77))
    assert network.node(77).sdo[0x1018][4].raw == 3


def main():
    interface, port, eds = sys.argv[1:4]
    network = Network(interface, port, eds)
    for name in sys.argv[4:]:
        globals()[f"part_{name}"](network)
        say(name)
    network.net.disconnect()


main()
