"""A pymodbus server for tests: tcp PORT | rtu PATH | ascii PATH, then unit ids.

Holding register n of unit u holds u * 100 + n, input register n holds n, coil n is on when n is odd. Prints "ready".
"""
import asyncio
import logging
import sys

from pymodbus.datastore import ModbusDeviceContext, ModbusSequentialDataBlock, ModbusServerContext
from pymodbus.framer import FramerType
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.server.requesthandler import ServerRequestHandler as ModbusServerRequestHandler


def device(unit):
    # The block begins at 1, because a device context adds one to every address.
    return ModbusDeviceContext(
        co=ModbusSequentialDataBlock(1, [n % 2 == 1 for n in range(200)]),
        di=ModbusSequentialDataBlock(1, [n % 2 == 1 for n in range(200)]),
        hr=ModbusSequentialDataBlock(1, [unit * 100 + n for n in range(200)]),
        ir=ModbusSequentialDataBlock(1, list(range(200))),
    )


async def main():
    kind, where, units = sys.argv[1], sys.argv[2], [int(u) for u in sys.argv[3:]]
    context = ModbusServerContext(devices={u: device(u) for u in units}, single=False)
    if kind == "tcp":
        server = ModbusTcpServer(context, address=("127.0.0.1", int(where)))
    else:
        # On a line with other units, those that are not ours stay silent; pymodbus would answer exception 04.
        handle = ModbusServerRequestHandler.handle_request

        async def ours_only(handler):
            if handler.last_pdu and handler.last_pdu.dev_id in [0, *units]:
                await handle(handler)

        ModbusServerRequestHandler.handle_request = ours_only
        framer = FramerType.ASCII if kind == "ascii" else FramerType.RTU
        server = ModbusSerialServer(context, framer=framer, port=where, baudrate=19200, ignore_missing_devices=True)
    # Comes back when it listens, or when the port is open.
    await server.serve_forever(background=True)
    print("ready", flush=True)
    await server.serving


logging.basicConfig(level=logging.ERROR)
asyncio.run(main())
