"""Random topologies of gateways: no message twice, ever; each once when nothing has changed for 2 s.

R2P_TOPOLOGIES is how many of them are tried (1000 takes long).
"""

from __future__ import annotations

import os
import random

import pytest

from r2p.sim import run
from tests.bridge.world import World

SHARE = 7
CALM = 2.0
"""Seconds after which everything flows."""


@pytest.mark.parametrize("seed", range(int(os.environ.get("R2P_TOPOLOGIES", SHARE))))
def test_random_topologies(seed: int) -> None:
    run(lambda: scenario(seed), seed=seed)


async def scenario(seed: int) -> None:
    chance = random.Random(seed)
    async with World(chance, anonymous=seed % 2 == 0) as world:
        await populate(world)
        world.faults(
            loss=chance.choice([0.0, 0.1, 0.3]),
            duplicate=chance.choice([0.0, 0.3]),
            reorder=chance.choice([0.0, 0.2]),
            delay=chance.choice([0.0, 0.005]),
            jitter=chance.choice([0.0, 0.01]),
        )
        for _ in range(chance.randint(0, 4)):
            await world.talk(chance.uniform(0.05, 2.0))
            await trouble(world)
        world.faults(loss=0.02 if chance.random() < 0.5 else 0.0)
        await world.talk(CALM)
        said = await world.talk(1.0)
        await world.talk(0.3)
        assert not world.twice(said)
        assert not world.missing(said)


async def populate(world: World) -> None:
    """2 to 7 networks, 1 to 6 gateways, 2 to 12 modules, some of them with two links, 1 to 3 topics; of half of the
    topologies these have names that travel as aliases.
    """
    chance = world.chance
    networks = "ABCDEFG"[: chance.randint(2, 7)]
    topics = ["t1", "t2", "t3"][: chance.randint(1, 3)]
    if len(networks) % 2:
        topics = [f"front_left/wheel/velocity_{each}" for each in topics]
    for _ in range(chance.randint(2, 12)):
        await world.speak(module_links(chance, networks), chance.choice(topics), chance.choice(topics))
    for _ in range(chance.randint(1, 6)):
        await world.join(gateway_ports(chance, networks))


def module_links(chance: random.Random, networks: str) -> str:
    """Mostly one network; now and then two, or the same one twice."""
    return "".join(chance.choice(networks) for _ in range(chance.choice([1, 1, 1, 2])))


def gateway_ports(chance: random.Random, networks: str) -> str:
    """Two to four networks; now and then the same one twice."""
    if chance.random() < 0.1:
        return "".join(chance.choice(networks) for _ in range(chance.randint(2, 4)))
    return "".join(chance.sample(networks, min(len(networks), chance.randint(2, 3))))


async def trouble(world: World) -> None:
    """A gateway crashes, leaves in order, comes back, or a new one joins; modules lose a link for a while."""
    chance = world.chance
    for speaker in world.speakers:
        if len(speaker.networks) > 1 and chance.random() < 0.3:
            world.pull_or_plug(speaker)
    gateway = chance.choice(world.gateways)
    if gateway.module is None:
        await world.start(gateway)
    elif len(world.gateways) < 6 and chance.random() < 0.3:
        await world.join(gateway_ports(chance, "".join(world.networks)))
    elif chance.random() < 0.7:
        await world.crash(gateway)
    else:
        await gateway.module.__aexit__(None, None, None)
        gateway.module = None
