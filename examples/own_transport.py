"""A transport of your own: the debug line in UDP datagrams, between two fixed ports of this computer.

python own_transport.py 7000 7001        in one terminal; in another one with the ports exchanged
"""

import asyncio
import sys
from collections.abc import Callable

import r2p
from r2p.msg import Text
from r2p.transports.line import Carrier, LineLink
from r2p.transports.link import Hub, Transport


class Udp(Transport, asyncio.DatagramProtocol, Carrier):
    """The transport, and its one connection: a carrier of bytes for a line link."""

    def __init__(self, here: int, there: int) -> None:
        self._ports = here, there

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        loop = asyncio.get_running_loop()
        here, there = (("127.0.0.1", port) for port in self._ports)
        self._link = LineLink("udp", hub, piecemeal=True)
        hub.attach(self._link)
        try:
            self._socket, _ = await loop.create_datagram_endpoint(lambda: self, local_addr=here, remote_addr=there)
            self._link.connect(self)  # announces everything
            opened()  # the module's `async with` waits for this
            await loop.create_future()
        finally:
            self._link.close()  # announces the end, and closes the carrier
            hub.detach(self._link)

    def datagram_received(self, data: bytes, addr: object) -> None:
        self._link.feed(data)

    def send(self, data: bytes) -> None:
        self._socket.sendto(data)

    def pause(self) -> None: ...  # the kernel holds what it can, and drops the rest

    def resume(self) -> None: ...

    def close(self) -> None:
        self._socket.close()


async def hello(node: r2p.Node) -> None:
    texts = node.advertise("hello", Text)
    node.subscribe("hello", Text, lambda text: print(text.text, flush=True))
    async for _ in node.every(0.5):
        await texts.publish(Text(text=f"hello from {node.module}"))
        await node.spin(timeout=0.1)


if __name__ == "__main__":
    here, there = map(int, sys.argv[1:3] or sys.exit(__doc__))
    r2p.run(hello, module=f"UDP{here % 1000}", via=Udp(here, there))
