"""The in-memory network: modules of one process on a bus that loses, delays, doubles and reorders as it is told.

All modules that open `memory:NAME` in one event loop share the network NAME. What happens to a message is drawn from
one seeded generator, so under virtual time a run with the same seed goes the same way.
"""

import asyncio
import random
import weakref
from collections import Counter
from collections.abc import Callable, Hashable
from typing import Any, ClassVar

import msgspec

from r2p.errors import TransportError
from r2p.names import MANAGEMENT
from r2p.sample import PublisherClass, Sample, Source
from r2p.transports.intake import Inlet
from r2p.transports.link import Hub, Link, Transport
from r2p.transports.url import Url, duration

IN_FLIGHT = 1024
"""Messages that a receiver may have waiting before senders find the network full."""


class Frame(msgspec.Struct, frozen=True, gc=False):
    """One message on the network."""

    port: int
    topic: bytes
    data: bytes
    module: str = ""
    node: str = ""
    stamp: int = 0
    deadline: int = 0
    sequence: int = 0
    publisher_class: PublisherClass = PublisherClass.NON_REAL_TIME


class MemoryNetwork:
    """A network of this process, and its faults: probabilities 0..1, `delay` and `jitter` in seconds.

    `reorder` is the probability that a message is held back long enough for the next ones to overtake it. Faults can be
    changed while it runs; `counts` tells what happened.
    """

    def __init__(
        self,
        *,
        loss: float = 0.0,
        duplicate: float = 0.0,
        reorder: float = 0.0,
        delay: float = 0.0,
        jitter: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.loss = loss
        self.duplicate = duplicate
        self.reorder = reorder
        self.delay = delay
        self.jitter = jitter
        self.counts: Counter[str] = Counter()
        self._random = random.Random(seed)
        self._ports: dict[int, Callable[[Frame], None]] = {}
        self._next_port = 1
        self._in_flight = 0

    @property
    def full(self) -> bool:
        return self._in_flight >= IN_FLIGHT

    def attach(self, receive: Callable[[Frame], None]) -> int:
        """Join; gives the port's address."""
        port, self._next_port = self._next_port, self._next_port + 1
        self._ports[port] = receive
        return port

    def detach(self, port: int) -> None:
        self._ports.pop(port, None)

    def send(self, frame: Frame) -> None:
        """Send to all other ports."""
        for port in self._ports:
            if port != frame.port:
                self._send_to(port, frame)

    def _send_to(self, port: int, frame: Frame) -> None:
        draw = self._random.random
        if self.loss and draw() < self.loss:
            self.counts["lost"] += 1
            return
        copies = 1
        if self.duplicate and draw() < self.duplicate:
            self.counts["duplicated"] += 1
            copies = 2
        for _ in range(copies):
            delay = self.delay + (self.jitter * draw() if self.jitter else 0.0)
            if self.reorder and draw() < self.reorder:
                self.counts["reordered"] += 1
                delay += 2 * (self.delay + self.jitter) + 1e-3
            self._schedule(delay, port, frame)

    def _schedule(self, delay: float, port: int, frame: Frame) -> None:
        loop = asyncio.get_running_loop()
        self._in_flight += 1
        if delay:
            loop.call_later(delay, self._arrive, port, frame)
        else:
            loop.call_soon(self._arrive, port, frame)

    def _arrive(self, port: int, frame: Frame) -> None:
        self._in_flight -= 1
        receive = self._ports.get(port)
        if receive is not None:
            self.counts["delivered"] += 1
            receive(frame)


_networks: "weakref.WeakKeyDictionary[asyncio.AbstractEventLoop, dict[str, MemoryNetwork]]" = (
    weakref.WeakKeyDictionary()
)


def network(name: str) -> MemoryNetwork:
    """The running loop's network of that name, made at first use: to change its faults, or to watch its counts."""
    networks = _networks.setdefault(asyncio.get_running_loop(), {})
    return networks.setdefault(name, MemoryNetwork())


class MemoryLink(Link):
    """One module's port on a memory network."""

    longest: ClassVar[int] = 1024
    point_to_point: ClassVar[bool] = False

    def __init__(self, name: str, hub: Hub, network: MemoryNetwork) -> None:
        super().__init__(name, hub)
        self._network = network
        self._port = 0

    def connect(self) -> None:
        """Plug in."""
        self._port = self._network.attach(lambda frame: self.take((frame,)))
        self.went_up()

    def disconnect(self, reason: str = "unplugged") -> None:
        """Pull the plug."""
        self._network.detach(self._port)
        self.went_down(reason)

    @property
    def full(self) -> bool:
        return self._network.full

    def write(self, topic: str, sample: Sample) -> None:
        self.stats.sent += 1
        self.stats.bytes_sent += len(sample.data)
        frame = Frame(
            self._port,
            topic.encode(),
            sample.data,
            sample.source.module,
            sample.source.node,
            sample.stamp,
            sample.deadline,
            sample.sequence,
            sample.publisher_class,
        )
        self._network.send(frame)

    def write_management(self, data: bytes) -> None:
        self._network.send(Frame(self._port, MANAGEMENT.encode(), data))

    def sample(self, inlet: Inlet, arrival: Frame) -> Sample:
        self.stats.bytes_received += len(arrival.data)
        source = Source(arrival.module, arrival.node, self.name)
        return Sample(arrival.data, source, arrival.stamp, arrival.deadline, arrival.sequence, arrival.publisher_class)

    def sender(self, arrival: Frame) -> Hashable:
        return arrival.port

    def close(self) -> None:
        super().close()
        self._network.detach(self._port)


class MemoryTransport(Transport):
    """`memory:NAME`; options `loss`, `duplicate`, `reorder` (0..1), `delay`, `jitter` (durations), `seed`."""

    def __init__(self, url: Url) -> None:
        if not url.address:
            raise TransportError(f"{url}: give the network a name: memory:lab")
        self._name = url.address
        self._faults: dict[str, Any] = dict(url.parsed(_OPTIONS))
        self.link: MemoryLink | None = None

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        networks = _networks.setdefault(asyncio.get_running_loop(), {})
        shared = networks.get(self._name)
        if shared is None:
            shared = networks[self._name] = MemoryNetwork(**self._faults)
        self.link = link = MemoryLink(f"memory:{self._name}", hub, shared)
        hub.attach(link)
        try:
            link.connect()
            opened()
            await asyncio.get_running_loop().create_future()
        finally:
            link.close()
            hub.detach(link)


def _probability(text: str) -> float:
    value = float(text)
    if not 0.0 <= value <= 1.0:
        raise ValueError("a probability lies between 0 and 1")
    return value


_OPTIONS: dict[str, Callable[[str], float]] = {
    "loss": _probability,
    "duplicate": _probability,
    "reorder": _probability,
    "delay": duration,
    "jitter": duration,
    "seed": int,
}
