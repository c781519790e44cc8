"""The in-memory network: modules of one process on a bus that loses, delays, duplicates and reorders on request.

All modules that open `memory:NAME` in one event loop share the network NAME; `MemoryNetwork.transport()` joins one
without a name. The faults come from one seeded generator, so under virtual time, runs with the same seed are identical.
"""

import asyncio
import math
import random
import weakref
from collections import Counter, deque
from collections.abc import Callable, Hashable
from typing import Any, ClassVar, cast

import msgspec

from r2p.clock import check_seconds, in_background, random_of
from r2p.codecs import own_services
from r2p.errors import TransportError
from r2p.keys import SharedKey
from r2p.messages import SIZE_MAX, ClockOffset
from r2p.names import MANAGEMENT
from r2p.protocols.discovery.session import Discovery
from r2p.protocols.discovery.topic_batch import split_topics
from r2p.protocols.time_left import TimesLeft
from r2p.runtime.sample import DirectedSample, PublisherClass, Sample, Source
from r2p.transports.buffered_link import BufferedLink
from r2p.transports.link import Hub, Transport
from r2p.transports.url import Url, duration, key_file, table_size

IN_FLIGHT = 1024
"""Places for messages on their way, without which the network is full for senders."""

_MANAGEMENT = MANAGEMENT.encode()
_PLACE = 64 * 1024
"""Bytes of a message in each place: so what is on its way has 64 MiB at most, and one message more."""


class Datagram(msgspec.Struct, frozen=True, gc=False):
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
    stamped: bool = True
    hops: int = 0
    clock: ClockOffset | None = None
    together: tuple[bytes, ...] = ()
    """Management messages that travel as one, instead of `data`."""


class MemoryPort:
    """A socket on a network. While its reader pauses, it holds messages: they are still on their way.

    `made_room` is called when the network is no longer full, `faults_changed` when it begins or ceases to have faults.
    `takes_together`: `receive` takes several management messages in one.
    """

    def __init__(
        self,
        network: "MemoryNetwork",
        receive: Callable[[Datagram], None],
        made_room: Callable[[], None],
        faults_changed: Callable[[], None] = lambda: None,
        *,
        takes_together: bool = False,
    ) -> None:
        self.network = network
        self.made_room = made_room
        self.faults_changed = faults_changed
        self._receive = receive
        self._takes_together = takes_together
        self.held: deque[Datagram] = deque()
        self.paused = False

    def receive(self, datagram: Datagram) -> None:
        """Hand on a message."""
        if not datagram.together or self._takes_together:
            self._receive(datagram)
        else:
            for data in datagram.together:
                self._receive(Datagram(datagram.port, datagram.topic, data))

    def resume(self) -> None:
        """Hand on held messages."""
        self.paused = False
        while self.held and not self.paused:
            datagram = self.held.popleft()
            self.network.release(_places(datagram))
            self.receive(datagram)


class _Fault:
    """A fault of a network, an attribute that its ports learn of when it changes."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, network: "MemoryNetwork", owner: type) -> float:
        return network.faults.get(self._name, 0.0)

    def __set__(self, network: "MemoryNetwork", value: float) -> None:
        before = bool(network.faults)
        network.faults.pop(self._name, None)
        if value:
            network.faults[self._name] = value
        if bool(network.faults) != before:
            network.faults_changed()


class MemoryNetwork:
    """A network of this process, and its faults: probabilities 0..1, `delay` and `jitter` in seconds.

    `reorder` is the probability that a message is held back long enough for the next ones to overtake it. Faults can be
    changed at any time; `counts` shows what happened. Without a `seed`, the event loop provides one at the first fault
    (under virtual time that of the test).

    While there are no faults, modules answer each other one by one, and what they announce travels together.
    """

    loss = _Fault()
    duplicate = _Fault()
    reorder = _Fault()
    delay = _Fault()
    jitter = _Fault()

    def __init__(
        self,
        *,
        loss: float = 0.0,
        duplicate: float = 0.0,
        reorder: float = 0.0,
        delay: float = 0.0,
        jitter: float = 0.0,
        seed: int | None = None,
    ) -> None:
        check_seconds("the delay of a memory network", delay, least=0.0)
        check_seconds("the jitter of a memory network", jitter, least=0.0)
        self.faults: dict[str, float] = {}
        """The present faults by name, without those that are 0."""
        self._ports: dict[int, MemoryPort] = {}
        self.loss = loss
        self.duplicate = duplicate
        self.reorder = reorder
        self.delay = delay
        self.jitter = jitter
        self.seed = seed
        self.counts: Counter[str] = Counter()
        self._random: random.Random | None = None
        self._addresses = 0
        self._in_flight = 0

    def transport(self, name: str = "") -> "MemoryTransport":
        """Return a place on this network, for `Module(via=...)` of one module."""
        return MemoryTransport(name, self)

    @property
    def full(self) -> bool:
        return self._in_flight >= IN_FLIGHT

    def new_address(self) -> int:
        self._addresses += 1
        return self._addresses

    def plug_in(self, address: int, port: MemoryPort) -> None:
        self._ports[address] = port

    def unplug(self, address: int) -> None:
        port = self._ports.pop(address, None)
        if port is not None:
            self.release(sum(map(_places, port.held)))
            port.held.clear()

    def send(self, datagram: Datagram) -> None:
        """Send to all other ports."""
        others = [address for address in self._ports if address != datagram.port]
        if self.faults:
            for address in others:
                self._send_to(address, datagram)
        else:
            self._in_flight += len(others) * _places(datagram)
            asyncio.get_running_loop().call_soon(self._arrive_everywhere, others, datagram)

    def send_to(self, address: int, datagram: Datagram) -> None:
        """Send to one port, if it is still there."""
        if address in self._ports:
            self._send_to(address, datagram)

    def faults_changed(self) -> None:
        """Tell all ports that the network begins or ceases to have faults."""
        for port in list(self._ports.values()):
            port.faults_changed()

    def release(self, places: int) -> None:
        """Note that messages are no longer on their way."""
        was_full = self.full
        self._in_flight -= places
        if was_full and not self.full:
            for port in list(self._ports.values()):
                port.made_room()

    def _send_to(self, address: int, datagram: Datagram) -> None:
        if self._happens(self.loss):
            self.counts["lost"] += 1
            return
        copies = 1
        if self._happens(self.duplicate):
            self.counts["duplicated"] += 1
            copies = 2
        for _ in range(copies):
            delay = self.delay + (self.jitter * self._draw() if self.jitter else 0.0)
            if self._happens(self.reorder):
                self.counts["reordered"] += 1
                delay += 2 * (self.delay + self.jitter) + 1e-3  # longer than any message takes that comes after it
            self._schedule(delay, address, datagram)

    def _happens(self, probability: float) -> bool:
        return probability > 0 and self._draw() < probability

    def _draw(self) -> float:
        if self._random is None:
            self._random = random.Random(random_of().getrandbits(64) if self.seed is None else self.seed)
        return self._random.random()

    def _schedule(self, delay: float, address: int, datagram: Datagram) -> None:
        loop = asyncio.get_running_loop()
        self._in_flight += _places(datagram)
        if delay:
            in_background(loop.call_later(delay, self._arrive, address, datagram))
        else:
            loop.call_soon(self._arrive, address, datagram)

    def _arrive_everywhere(self, addresses: list[int], datagram: Datagram) -> None:
        for address in addresses:
            self._arrive(address, datagram)

    def _arrive(self, address: int, datagram: Datagram) -> None:
        port = self._ports.get(address)
        if port is None:
            self.release(_places(datagram))
            return
        self.counts["delivered"] += 1
        if port.paused:
            port.held.append(datagram)
            return
        self.release(_places(datagram))
        port.receive(datagram)


def _places(datagram: Datagram) -> int:
    return 1 + len(datagram.data) // _PLACE


_networks: "weakref.WeakKeyDictionary[asyncio.AbstractEventLoop, dict[str, MemoryNetwork]]" = (
    weakref.WeakKeyDictionary()
)


def network(name: str) -> MemoryNetwork:
    """Return the running loop's network of that name, made at first use: to set its faults, or to read its counts."""
    networks = _networks.setdefault(asyncio.get_running_loop(), {})
    return networks.setdefault(name, MemoryNetwork())


class MemoryLink(BufferedLink):
    """One module's link to a memory network, which can be unplugged and plugged in again."""

    max_payload: ClassVar[int] = SIZE_MAX
    in_order: ClassVar[bool] = False

    def __init__(self, name: str, hub: Hub, network: MemoryNetwork) -> None:
        super().__init__(name, hub)
        assert isinstance(self.discovery, Discovery)
        self._discovery = self.discovery
        self.network = network
        self._address = network.new_address()
        self._port = MemoryPort(
            network,
            lambda datagram: self.receive((datagram,)),
            self.made_room,
            self._review_faults,
            takes_together=True,
        )
        self._together: list[bytes] = []
        """Management messages that go to all at the end of this turn of the loop, or before the next sample."""
        self._times_left = TimesLeft()

    def connect(self) -> None:
        """Plug the link in."""
        self.network.plug_in(self._address, self._port)
        self._review_faults()
        self.on_up()

    def disconnect(self, reason: str = "unplugged") -> None:
        """Unplug the link."""
        self._send_together()
        self.network.unplug(self._address)
        self.on_down(reason)

    @property
    def full(self) -> bool:
        return self.network.full

    def write(self, topic: str, sample: Sample) -> None:
        self._send_together()
        self.stats.sent += 1
        self.stats.bytes_sent += len(sample.data)
        hooks = self.gateway_hooks
        datagram = Datagram(
            self._address,
            topic.encode(),
            sample.data,
            sample.source.module if hooks is None else hooks.source_name(sample.source),
            sample.source.node,
            sample.stamp,
            sample.deadline,
            sample.sequence,
            sample.publisher_class,
            sample.stamped,
            sample.hops + bool(sample.source.link),
            sample.clock,
        )
        to = self.discovery.address_of(sample.to) if isinstance(sample, DirectedSample) else None
        if isinstance(to, int):
            self.network.send_to(to, datagram)
        else:
            self.network.send(datagram)

    def write_call(self, data: bytes, to: Hashable) -> None:
        self._send_together()
        self.network.send(Datagram(self._address, own_services.topic_of(data), data))

    def write_management(self, data: bytes, *, urgent: bool = False) -> None:
        if not self._together:
            self._space.loop.call_soon(self._send_together)
        self._together.append(data)

    def write_answer(self, messages: tuple[bytes, ...], to: Hashable) -> None:
        self._send_together()
        for datagram in self._datagrams(messages):
            self.network.send_to(cast("int", to), datagram)

    def _send_together(self) -> None:
        """Send the management messages of this turn, which are announcements of several topics, mostly."""
        if self._together:
            messages, self._together = tuple(self._together), []
            for datagram in self._datagrams(messages):
                self.network.send(datagram)

    def _datagrams(self, messages: tuple[bytes, ...]) -> list[Datagram]:
        """Return messages as one, unless the network has faults, which are those of single messages."""
        if len(messages) > 1 and not self.network.faults:
            return [Datagram(self._address, _MANAGEMENT, b"", together=messages)]
        return [Datagram(self._address, _MANAGEMENT, data) for data in messages]

    def _review_faults(self) -> None:
        """Repeat little, and answer each module alone, while nothing is lost; with a key, all hear what it seals."""
        lossless, now = not self.network.faults, self._clock.monotonic()
        self._apply(self.discovery.set_lossless(now, lossless=lossless, addresses=self.guard is None))

    def receive_other(self, arrival: Datagram) -> None:
        if arrival.together:
            self._manage_together(arrival.together, arrival.port)
        else:
            super().receive_other(arrival)

    def _manage_together(self, messages: tuple[bytes, ...], source: int) -> None:
        """Handle management messages that came together; what they cause comes after the last one."""
        first, topics = (messages, None) if self.guard is not None else split_topics(messages)
        acting, self._acting = self._acting, True
        try:
            for data in first:
                self.stats.lost.guard(self.manage, data, source)
        finally:
            self._acting = acting
        now = self._clock.monotonic()
        self._apply(self._discovery.receive_topics(now, topics, source) if topics is not None else ())

    def sample(self, topic: str, arrival: Datagram) -> Sample:
        self.stats.bytes_received += len(arrival.data)
        source = Source(arrival.module, arrival.node, self.name)
        return Sample(
            arrival.data,
            source,
            arrival.stamp,
            arrival.deadline,
            arrival.sequence,
            arrival.publisher_class,
            stamped=arrival.stamped,
            hops=arrival.hops,
            clock=arrival.clock,
            expires=self._expiry(arrival) if arrival.deadline else 0,
        )

    def _expiry(self, arrival: Datagram) -> int:
        """Return the deadline by the clock of this computer."""
        publisher = (arrival.port, arrival.module, arrival.node)
        left = self._times_left.of(publisher).left(self._clock.monotonic(), arrival.stamp, arrival.deadline)
        return self._clock.now() + left

    def sender(self, arrival: Datagram) -> Hashable:
        return arrival.port

    def pause(self) -> None:
        self._port.paused = True

    def resume(self) -> None:
        if self._port.paused:
            self._port.resume()

    def close(self) -> None:
        super().close()
        self._send_together()
        self.network.unplug(self._address)


class MemoryTransport(Transport):
    """A place on a memory network for one module: on the given one, or on the running loop's network of that name."""

    def __init__(
        self,
        name: str,
        network: MemoryNetwork | None = None,
        faults: dict[str, Any] | None = None,
        key: SharedKey | None = None,
        topics: int | None = None,
    ) -> None:
        self._name = name
        self._key = key
        self._topics = topics
        self._network = network
        self._faults = faults or {}

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        shared = self._network or network(self._name)
        for fault, value in self._faults.items():
            setattr(shared, fault, value)
        link = MemoryLink(f"memory:{self._name}", hub, shared)
        link.use_key(self._key)
        link.limit_tables(self._topics)
        hub.attach(link)
        try:
            link.connect()
            opened()
            await asyncio.get_running_loop().create_future()
        finally:
            link.close()
            hub.detach(link)


def from_url(url: Url) -> MemoryTransport:
    """`memory:NAME`; options `loss`, `duplicate`, `reorder` (0..1), `delay`, `jitter` (durations), `seed`.

    These hold for the whole network, from now on; `key` and `topics` for this module.
    """
    if not url.address:
        raise TransportError(f"{url}: give the network a name: memory:lab")
    faults = url.parsed(_OPTIONS)
    return MemoryTransport(url.address, None, faults, faults.pop("key", None), faults.pop("topics", None))


def _probability(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value <= 1.0:
        raise ValueError("a probability lies between 0 and 1")
    return value


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise ValueError("give a whole number")
    return int(text)


_OPTIONS: dict[str, Callable[[str], Any]] = {
    "key": key_file,
    "loss": _probability,
    "duplicate": _probability,
    "reorder": _probability,
    "delay": duration,
    "jitter": duration,
    "seed": _seed,
    "topics": table_size,
}
