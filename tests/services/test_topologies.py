"""Calls through random topologies of gateways that come and go: no request is handled twice, ever; each is answered
when nothing has changed for 2 s.

R2P_TOPOLOGIES is how many of them are tried (1000 takes long).
"""

from __future__ import annotations

import asyncio
import os
import random
from collections import Counter
from typing import TYPE_CHECKING

import pytest

from r2p.sim import run
from tests.bridge.test_topologies import CALM, gateway_ports, trouble
from tests.bridge.world import World
from tests.services.common import Add, add, outcome

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    import r2p

SHARE = 3
TIMEOUT = 1.0
"""Seconds."""


@pytest.mark.parametrize("seed", range(int(os.environ.get("R2P_TOPOLOGIES", SHARE))))
def test_random_topologies_with_calls(seed: int) -> None:
    run(lambda: scenario(seed), seed=seed)


async def scenario(seed: int) -> None:
    chance = random.Random(seed)
    async with World(chance, anonymous=seed % 2 == 0) as world:
        offices = [office async for office in open_offices(world)]
        world.faults(
            loss=chance.choice([0.0, 0.1, 0.3]),
            duplicate=chance.choice([0.0, 0.3]),
            reorder=chance.choice([0.0, 0.2]),
            delay=chance.choice([0.0, 0.005]),
        )
        for _ in range(chance.randint(1, 3)):
            await converse(chance, offices, chance.uniform(0.05, 1.5))
            await trouble(world)
        world.faults(loss=0.02 if chance.random() < 0.5 else 0.0)
        await converse(chance, offices, CALM)
        for office in offices:
            office.outcomes.clear()
        await converse(chance, offices, 1.0)
        await asyncio.sleep(TIMEOUT + 0.1)
        for office in offices:
            assert not office.twice
            for caller, number, result in office.outcomes:
                reachable = not world.connected(office.callers[caller][0]).isdisjoint(office.networks)
                assert not reachable or result == Add.Response(total=number)


class Office:
    """One service, with its server on some networks, and its callers."""

    def __init__(self, networks: str) -> None:
        self.networks = networks
        self.callers: list[tuple[str, r2p.ServiceClient[Add.Request, Add.Response]]] = []
        """Networks and client of each."""
        self.outcomes: list[tuple[int, int, object]] = []
        """The caller's index, the number that it sent, and what became of the call."""
        self.handled: Counter[int] = Counter()
        self._numbers: Iterator[int] = iter(range(1 << 30))
        self._tasks: set[asyncio.Task[None]] = set()

    @property
    def twice(self) -> list[int]:
        return [number for number, count in self.handled.items() if count > 1]

    async def handle(self, request: Add.Request) -> Add.Response:
        self.handled[request.a] += 1
        await asyncio.sleep(0.02 * (request.a % 3))
        return await add(request)

    def ask(self, chance: random.Random) -> None:
        """A caller calls."""
        caller = chance.randrange(len(self.callers))
        task = asyncio.create_task(self._ask(caller, next(self._numbers)))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _ask(self, caller: int, number: int) -> None:
        result = await outcome(self.callers[caller][1].call(Add.Request(a=number), timeout=TIMEOUT))
        self.outcomes.append((caller, number, result))


async def open_offices(world: World) -> AsyncIterator[Office]:
    """2 to 6 networks, 1 to 5 gateways, 1 to 3 services with 1 to 3 callers each."""
    chance = world.chance
    networks = "ABCDEF"[: chance.randint(2, 6)]
    for number in range(chance.randint(1, 3)):
        office = Office(chance.choice(networks))
        (await world.open(f"S{number}", office.networks)).serve(f"s{number}", Add, office.handle)
        for caller in range(chance.randint(1, 3)):
            where = "".join(chance.choice(networks) for _ in range(chance.choice([1, 1, 2])))
            node = await world.open(f"C{number}{caller}", where)
            office.callers.append((where, node.client(f"s{number}", Add)))
        yield office
    for _ in range(chance.randint(1, 5)):
        await world.join(gateway_ports(chance, networks))


async def converse(chance: random.Random, offices: list[Office], seconds: float) -> None:
    """Call at random instants for a while."""
    loop = asyncio.get_running_loop()
    end = loop.time() + seconds
    while loop.time() < end:
        chance.choice(offices).ask(chance)
        await asyncio.sleep(chance.uniform(0, 0.06))
