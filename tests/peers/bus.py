"""Where a peer finds its bus: a port of a cannelloni server on 127.0.0.1, or a network interface of SocketCAN."""


def where(bus):
    if bus.isdigit():
        return {"interface": "cannelloni", "channel": f"127.0.0.1:{bus}"}
    return {"interface": "socketcan", "channel": bus}
