"""One end of a debug line for a test that speaks by hand, under virtual time or over a real socket."""

import asyncio
from collections.abc import Callable

import msgspec

from r2p.codecs import debug, management
from r2p.codecs.management import Management
from r2p.transports.line import Carrier, LineLink
from r2p.transports.link import Hub, Transport


class Said(msgspec.Struct, frozen=True):
    """A line that the module sent, at `ms` after the start."""

    ms: float
    topic: str
    data: bytes

    @property
    def management(self) -> Management:
        return management.decode(self.data)


class Script(Transport, Carrier):
    """A line link of a module, whose other end is the test: `hear` is what comes in, `said` what went out."""

    admits_gateways = True

    def __init__(self) -> None:
        self.said: list[Said] = []
        self.blocked = False
        """While it is set the line takes nothing after what it takes now."""
        self._reader = debug.Reader()
        self._held: list[bytes] = []
        self._paused = False

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        self.link = link = LineLink("script", hub)
        link.admits_gateways = self.admits_gateways
        hub.attach(link)
        try:
            link.connect(self)
            opened()
            await asyncio.get_running_loop().create_future()
        finally:
            link.close()
            hub.detach(link)

    def hear(self, data: bytes, chunk: int | None = None) -> None:
        """Bytes come in, in chunks of this size."""
        size = chunk or max(1, len(data))
        for at in range(0, len(data), size):
            if self._paused:
                self._held.append(data[at : at + size])
            else:
                self.link.feed(data[at : at + size])

    def unblock(self) -> None:
        self.blocked = False
        self.link.carrier_ready()

    def topics(self, topic: str) -> list[bytes]:
        """What was said on one topic."""
        return [each.data for each in self.said if each.topic == topic]

    def send(self, data: bytes) -> None:
        now = asyncio.get_running_loop().time() * 1000
        self.said += [Said(now, line.topic.decode(), line.data) for line in self._reader.feed(data)]
        if self.blocked:
            self.link.carrier_full()

    def pause(self) -> None:
        self._paused = True

    def resume(self) -> None:
        self._paused = False
        while self._held and not self._paused:
            self.link.feed(self._held.pop(0))

    def close(self) -> None:
        self._paused = True


def line(topic: str, data: bytes) -> bytes:
    """A debug line."""
    return debug.encode(topic.encode(), data, 0)


def manage(message: Management) -> bytes:
    """A debug line on the management topic."""
    return line("R2P", management.encode(message))
