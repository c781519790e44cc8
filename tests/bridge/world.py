"""Robots of several networks, joined by gateways that come and go, and messages that the test can tell apart."""

from __future__ import annotations

import asyncio
import struct
from collections import Counter, defaultdict
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Annotated, Self

import msgspec

import r2p
from r2p.names import LOG, MANAGEMENT, RESERVED
from r2p.testing.network import node_in
from r2p.transports.memory import Datagram, MemoryLink, MemoryNetwork

if TYPE_CHECKING:
    import random
    from collections.abc import Iterable

_MANAGEMENT = MANAGEMENT.encode()
_UNNUMBERED = frozenset(name.encode() for name in (*RESERVED, LOG))


class Numbered(r2p.Message):
    """A message that is unlike any other, in its length, too: most are short."""

    number: r2p.u32
    data: Annotated[bytes, r2p.Max(5000)] = b""


def numbered(number: int) -> Numbered:
    return Numbered(number, number.to_bytes(4, "little") * (number * number % 1250 if number % 8 == 0 else number % 8))


def number_in(data: bytes) -> int:
    """The number of a message of any length."""
    return int(struct.unpack_from("<I", data)[0])


def number_of(data: bytes) -> int:
    """The number of a message, which must be as it was sent."""
    number = number_in(data)
    assert data == numbered(number).encode()
    return number


class TestNetwork(MemoryNetwork):
    """Doubles only what gateways and modules say of themselves, and remembers which messages it lost.

    `anonymous`: messages have no number and no source, as on CAN and the debug line.
    """

    __test__ = False

    def __init__(self, *, anonymous: bool = False) -> None:
        super().__init__()
        self.anonymous = anonymous
        self.hurt: set[int] = set()

    @property
    def full(self) -> bool:
        """Never: a message that is refused for want of room would be lost on the way."""
        return False

    def send(self, frame: Datagram) -> None:
        if self.anonymous and frame.topic != _MANAGEMENT:
            frame = msgspec.structs.replace(frame, sequence=0, module="", node="", hops=0)
        super().send(frame)

    def _send_to(self, address: int, frame: Datagram) -> None:
        if frame.topic == _MANAGEMENT:
            super()._send_to(address, frame)
            return
        duplicate, self.duplicate, lost = self.duplicate, 0.0, self.counts["lost"]
        super()._send_to(address, frame)
        self.duplicate = duplicate
        if self.counts["lost"] != lost and frame.topic not in _UNNUMBERED:
            self.hurt.add(number_in(frame.data))


class Gateway:
    """A gateway that can crash."""

    def __init__(self, name: str, networks: str) -> None:
        self.name = name
        self.networks = networks
        self.module: r2p.Module | None = None


class Speaker:
    """A module with one node that publishes one topic and subscribes another; it is on one network or more.

    `pulled` is the number of the link that is unplugged.
    """

    def __init__(self, networks: str, publishes: str, subscribes: str) -> None:
        self.networks = networks
        self.module: r2p.Module | None = None
        self.pulled: int | None = None
        self.publishes = publishes
        self.subscribes = subscribes
        self.publisher: r2p.Publisher[Numbered] | None = None
        self.got: Counter[int] = Counter()

    @property
    def here(self) -> str:
        """The networks that it can reach now."""
        return "".join(each for number, each in enumerate(self.networks) if number != self.pulled)


class World:
    """Everything; open it under virtual time."""

    def __init__(self, chance: random.Random, *, anonymous: bool = False) -> None:
        self.chance = chance
        self.networks: dict[str, TestNetwork] = defaultdict(lambda: TestNetwork(anonymous=anonymous))
        self.gateways: list[Gateway] = []
        self.speakers: list[Speaker] = []
        self.said: dict[int, Speaker] = {}
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        await self._stack.__aenter__()
        return self

    async def __aexit__(self, *error: object) -> None:
        await self._stack.aclose()

    def faults(self, **faults: float) -> None:
        for network in self.networks.values():
            for name, value in faults.items():
                setattr(network, name, value)

    async def join(self, networks: str) -> Gateway:
        """A gateway starts."""
        gateway = Gateway(f"GW{len(self.gateways)}", networks)
        self.gateways.append(gateway)
        await self.start(gateway)
        return gateway

    async def start(self, gateway: Gateway) -> None:
        via = [self.networks[name].transport(f"{name}{index}") for index, name in enumerate(gateway.networks)]
        gateway.module = r2p.Module(gateway.name, via=via, bridge=True, watchdog=False)
        await self._stack.enter_async_context(gateway.module)

    async def open(self, name: str, networks: str) -> r2p.Node:
        """A module starts, with a node for the test."""
        via = [self.networks[network].transport(network) for network in networks]
        module = await self._stack.enter_async_context(r2p.Module(name, via=via, watchdog=False))
        return await self._stack.enter_async_context(node_in(module))

    async def crash(self, gateway: Gateway) -> None:
        """It is gone without a word: what it still sends is lost."""
        assert gateway.module is not None
        for link in gateway.module.links:
            assert isinstance(link, MemoryLink)
            link.network.unplug(link._address)
            link.network = link._port.network = MemoryNetwork()
        module, gateway.module = gateway.module, None
        await module.__aexit__(None, None, None)

    async def speak(self, networks: str, publishes: str, subscribes: str) -> Speaker:
        """A module starts."""
        speaker = Speaker(networks, publishes, subscribes)
        name = f"M{len(self.speakers)}"
        self.speakers.append(speaker)
        via = [self.networks[network].transport(network) for network in networks]
        module = await self._stack.enter_async_context(r2p.Module(name, via=via, watchdog=False))
        speaker.module = module
        node = await self._stack.enter_async_context(node_in(module))
        speaker.publisher = node.advertise(publishes, Numbered)
        subscriber = node.subscribe(subscribes, Numbered, queue=4096)

        async def listen(_: r2p.Node) -> None:
            async for sample in subscriber.samples():
                speaker.got[number_of(sample.data)] += 1

        module.start(listen)
        return speaker

    def pull_or_plug(self, speaker: Speaker) -> None:
        """A link of a module goes down, or comes back."""
        assert speaker.module is not None
        number = self.chance.randrange(len(speaker.networks)) if speaker.pulled is None else speaker.pulled
        link = speaker.module.links[number]
        assert isinstance(link, MemoryLink)
        if link.up:
            link.disconnect()
            speaker.pulled = number
        else:
            link.connect()
            speaker.pulled = None

    def say(self) -> int:
        """Somebody publishes something."""
        speaker = self.chance.choice(self.speakers)
        number = len(self.said) + 1
        self.said[number] = speaker
        assert speaker.publisher is not None
        speaker.publisher.publish_nowait(numbered(number))
        return number

    async def talk(self, seconds: float, pause: float = 0.03) -> list[int]:
        """Messages at random instants for a while."""
        loop = asyncio.get_running_loop()
        end = loop.time() + seconds
        said = []
        while loop.time() < end:
            said.append(self.say())
            await asyncio.sleep(self.chance.uniform(0, 2 * pause))
        return said

    # What should be

    def twice(self, lately: Iterable[int] = ()) -> list[tuple[int, str, str]]:
        """Messages that a module got more than once: number, from, to.

        Modules on several networks each hear each other by all that both are on, while no gateway joins these; so what
        such a pair says counts only `lately`, while nothing has changed.
        """
        return [
            (number, self.said[number].networks, each.networks)
            for each in self.speakers
            for number, count in each.got.items()
            if count > 1 and (number in lately or not self._both_have_several(number, each))
            if not (self._both_have_several(number, each) and self._are_parted(number, each))
        ]

    def _both_have_several(self, number: int, listener: Speaker) -> bool:
        return len(set(self.said[number].networks)) > 1 and len(set(listener.networks)) > 1

    def _are_parted(self, number: int, listener: Speaker) -> bool:
        """Whether there are networks of theirs that no gateway joins."""
        networks = self.said[number].here + listener.here
        return not self.connected(networks[0]).issuperset(networks)

    def missing(self, numbers: Iterable[int]) -> list[tuple[int, str, str]]:
        """Messages that did not reach everybody, though no network lost them: number, from, to."""
        hurt = set().union(*(network.hurt for network in self.networks.values()))
        return [
            (number, self.said[number].networks, listener.networks)
            for number in numbers
            if number not in hurt
            for listener in self.speakers
            if listener.subscribes == self.said[number].publishes
            and not self.connected(self.said[number].here).isdisjoint(listener.here)
            and not listener.got[number]
        ]

    def connected(self, networks: str) -> set[str]:
        """The networks that can be reached from these."""
        reached = set(networks)
        while True:
            joined = [set(each.networks) for each in self.gateways if each.module is not None]
            more = reached.union(*(networks for networks in joined if networks & reached))
            if more == reached:
                return reached
            reached = more
