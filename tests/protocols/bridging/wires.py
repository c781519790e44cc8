"""Gateways without a program around them, on networks that lose, delay, double and reorder, and messages on their way.

Everything is one heap of events; nothing here knows asyncio. A message carries a number that gateways don't see, so
that the test does.
"""

from __future__ import annotations

import heapq
import itertools
from collections import Counter, defaultdict
from typing import TYPE_CHECKING, Any

from r2p.codecs import management
from r2p.protocols.bridging.tree import Say, Tree

if TYPE_CHECKING:
    import random
    from collections.abc import Callable

MS = 1_000_000


class Gateway:
    """One start of a gateway; `ports` are the networks that it joins, by port number."""

    def __init__(self, world: World, identity: int, ports: dict[int, str]) -> None:
        self.world = world
        self.tree = Tree(identity)
        self.ports = ports
        self.alive = True
        self.held: list[Callable[[], None]] | None = None  # while it is stopped

    def start(self) -> None:
        for number, network in self.ports.items():
            self.world.networks[network].append((self, number))
            self.tree.open(self.world.now, number)
        self.go_on()

    def crash(self) -> None:
        self.alive = False
        for number, network in self.ports.items():
            self.world.networks[network].remove((self, number))

    def hear(self, number: int, data: bytes) -> None:
        message = management.decode(data)
        if isinstance(message, management.Bridge):
            self.tree.bridge(self.world.now, number, message)
        else:
            assert isinstance(message, management.Mesh)
            self.tree.mesh(self.world.now, number, message)
        self.go_on()

    def carry(self, number: int, message: int) -> None:
        now = self.world.now
        if number not in self.tree.ports or now >= self.tree.ports[number].until:
            return
        for other, port in self.tree.ports.items():
            if other != number and now < port.until:
                self.world.send(self.ports[other], message, sender=(self, other))

    def go_on(self) -> None:
        for action in self.tree.take():
            if isinstance(action, Say):
                self.world.say(self.ports[action.port], management.encode(action.message), (self, action.port))
        due = self.tree.next_deadline()
        if due is not None:
            self.world.at(max(due, self.world.now), self.due)

    def due(self) -> None:
        if self.alive and self.held is None and (self.tree.next_deadline() or 0) <= self.world.now:
            self.tree.poll(self.world.now)
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


class World:
    """Networks by name with who is on them; faults are probabilities, delays in ns."""

    def __init__(self, random: random.Random) -> None:
        self.random = random
        self.now = 1_000 * MS
        self.loss = self.duplicate = self.reorder = 0.0
        self.delay = 0
        self.networks: dict[str, list[tuple[Gateway, int]]] = defaultdict(list)
        self.seen: Counter[tuple[int, str]] = Counter()
        """How often each message was put on each network."""
        self.hurt: set[int] = set()
        """Messages that a network lost somewhere."""
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
        message = next(self._messages)
        self.send(network, message, None)
        return message

    def say(self, network: str, data: bytes, sender: tuple[Gateway, int]) -> None:
        self.said += 1
        for place in self.networks[network]:
            if place != sender and self.random.random() >= self.loss:
                for _ in range(1 + (self.random.random() < self.duplicate)):
                    self._arrive(place, "hear", data)

    def send(self, network: str, message: int, sender: tuple[Gateway, int] | None) -> None:
        self.seen[message, network] += 1
        for place in self.networks[network]:
            if place == sender:
                continue
            if self.random.random() < self.loss:
                self.hurt.add(message)
            else:
                self._arrive(place, "carry", message)

    def _arrive(self, place: tuple[Gateway, int], method: str, what: Any) -> None:
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
