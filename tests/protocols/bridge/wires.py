"""Gateways, and modules with several links, without a program around them; and messages on their way.

The networks lose, delay, double and reorder.

Everything is one heap of events; nothing here knows asyncio. A message carries a number that gateways don't see, so
that the test does.
"""

from __future__ import annotations

import heapq
import itertools
from collections import Counter, defaultdict
from typing import TYPE_CHECKING, Any

from r2p.codecs import management
from r2p.protocols.bridge.link_selection import LinkSelection
from r2p.protocols.bridge.ports import SendToPort
from r2p.protocols.bridge.tree import SpanningTree

if TYPE_CHECKING:
    import random
    from collections.abc import Callable

MS = 1_000_000


class Station:
    """One start of a gateway or a module; `ports` are the networks that it is on, by number."""

    def __init__(self, world: World, protocol: SpanningTree | LinkSelection, ports: dict[int, str]) -> None:
        self.world = world
        self.protocol = protocol
        self.ports = ports
        self.alive = True
        self.held: list[Callable[[], None]] | None = None  # while it is stopped

    def start(self) -> None:
        for number, network in self.ports.items():
            self.world.networks[network].append((self, number))
            self.open(number)
        self.go_on()

    def open(self, number: int) -> None:
        raise NotImplementedError

    def crash(self) -> None:
        self.alive = False
        for number, network in self.ports.items():
            self.world.networks[network].remove((self, number))

    def said(self) -> list[tuple[int, management.Management]]:
        """What to say now, and at which port."""
        raise NotImplementedError

    def go_on(self) -> None:
        for number, message in self.said():
            self.world.say(self.ports[number], management.encode(message), (self, number))
        due = self.protocol.next_deadline()
        if due is not None:
            self.world.at(max(due, self.world.now), self.due)

    def due(self) -> None:
        if self.alive and self.held is None and (self.protocol.next_deadline() or 0) <= self.world.now:
            self.protocol.poll(self.world.now)
            self.go_on()

    def stop(self, duration: int) -> None:
        """Like SIGSTOP: what comes in waits."""
        self.held = []

        def resume() -> None:
            held, self.held = self.held or [], None
            for each in held:
                each()
            self.due()

        self.world.at(self.world.now + duration, resume)


class Gateway(Station):
    """A gateway."""

    def __init__(self, world: World, identity: int, ports: dict[int, str]) -> None:
        self.tree = SpanningTree(identity)
        super().__init__(world, self.tree, ports)

    def open(self, number: int) -> None:
        self.tree.open(self.world.now, number)

    def hear(self, number: int, data: bytes) -> None:
        message = management.decode(data)
        if isinstance(message, management.Bridge):
            self.tree.receive_bridge(self.world.now, number, message)
        elif isinstance(message, management.Mesh):
            self.tree.receive_mesh(self.world.now, number, message)
        else:
            assert isinstance(message, management.Leaf)
            self.tree.receive_leaf(self.world.now, number, message)
        self.go_on()

    def said(self) -> list[tuple[int, management.Management]]:
        return [(action.port, action.message) for action in self.tree.pop_actions() if isinstance(action, SendToPort)]

    def carry(self, number: int, message: int) -> None:
        now = self.world.now
        if number not in self.tree.ports or now >= self.tree.ports[number].forwards_until:
            return
        for other, port in self.tree.ports.items():
            if other != number and now < port.forwards_until:
                self.world.send(self.ports[other], message, sender=(self, other))


class Module(Station):
    """A module with several links; it publishes by all that it uses, and counts what it got.

    It hears no hellos at the ports in `deaf`, and at those in `mute` its own get lost; messages pass.
    """

    def __init__(self, world: World, identity: int, ports: dict[int, str]) -> None:
        self.selection = LinkSelection(identity)
        self.identity = identity
        self.deaf: set[int] = set()
        self.mute: set[int] = set()
        self.selection.used(world.now, frozenset())
        self.got: Counter[int] = Counter()
        super().__init__(world, self.selection, ports)

    @property
    def used(self) -> str:
        """The networks that it uses."""
        numbers = self.selection.used(self.world.now, frozenset())
        return "".join(network for number, network in self.ports.items() if number in numbers)

    def open(self, number: int) -> None:
        self.selection.open(self.world.now, number, lone=False)

    def hear(self, number: int, data: bytes) -> None:
        message = management.decode(data)
        if number in self.deaf:
            return
        if isinstance(message, management.Bridge):
            self.selection.receive_bridge(self.world.now, number, message)
        elif isinstance(message, management.Leaf) and message.module == self.identity:
            self.selection.receive_leaf(self.world.now, number, message)
        self.go_on()

    def carry(self, number: int, message: int) -> None:
        if self._may_use(number):
            self.got[message] += 1

    def publish(self) -> int:
        """A message on all networks that it uses."""
        message = self.world.new_message()
        self.world.by_modules.add(message)
        for number, network in self.ports.items():
            if self._may_use(number):
                self.world.send(network, message, (self, number))
        return message

    def said(self) -> list[tuple[int, management.Management]]:
        said = self.selection.pop_messages()
        return [(number, message) for number, message in said if message is not None and number not in self.mute]

    def _may_use(self, number: int) -> bool:
        if self.world.now >= self.selection.consent_until:
            self.selection.poll(self.world.now)
        return number in self.selection.used(self.world.now, frozenset())


class World:
    """Networks by name with who is on them; faults are probabilities, delays in ns."""

    def __init__(self, random: random.Random) -> None:
        self.random = random
        self.now = 1_000 * MS
        self.loss = self.duplicate = self.reorder = 0.0
        self.delay = 0
        self.networks: dict[str, list[tuple[Station, int]]] = defaultdict(list)
        self.seen: Counter[tuple[int, str]] = Counter()
        """How often each message was put on each network."""
        self.hurt: set[int] = set()
        """Messages that a network lost somewhere."""
        self.by_modules: set[int] = set()
        """Messages that a module with several links published: another such module may get one by each of them."""
        self.said = 0
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._messages = itertools.count(1)

    def at(self, when: int, what: Callable[[], None]) -> None:
        heapq.heappush(self._events, (when, next(self._order), what))

    def run(self, duration: int) -> None:
        end = self.now + duration
        while self._events and self._events[0][0] <= end:
            when, _, what = heapq.heappop(self._events)
            self.now = max(self.now, when)
            what()
        self.now = end

    def publish(self, network: str) -> int:
        message = self.new_message()
        self.send(network, message, None)
        return message

    def new_message(self) -> int:
        return next(self._messages)

    def say(self, network: str, data: bytes, sender: tuple[Station, int]) -> None:
        self.said += 1
        for place in self.networks[network]:
            if place != sender and self.random.random() >= self.loss:
                for _ in range(1 + (self.random.random() < self.duplicate)):
                    self._arrive(place, "hear", data)

    def send(self, network: str, message: int, sender: tuple[Station, int] | None) -> None:
        self.seen[message, network] += 1
        for place in self.networks[network]:
            if place == sender:
                continue
            if self.random.random() < self.loss:
                self.hurt.add(message)
            else:
                self._arrive(place, "carry", message)

    def _arrive(self, place: tuple[Station, int], method: str, what: Any) -> None:
        gateway, number = place
        delay = self.random.randrange(self.delay + 1)
        if self.random.random() < self.reorder:
            delay += 2 * self.delay + MS

        def arrive() -> None:
            if not gateway.alive:
                return
            if gateway.held is not None:
                gateway.held.append(lambda: getattr(gateway, method)(number, what))
            else:
                getattr(gateway, method)(number, what)

        self.at(self.now + delay, arrive)
