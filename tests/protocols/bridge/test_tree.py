"""The forwarding tree: no message twice on a network, whatever happens; each once after 2 s without changes."""

from __future__ import annotations

import os
import random

import pytest

from r2p.codecs.management import Bridge, Mesh, encode
from r2p.protocols.bridge.mesh import CHANGES, HEARD_MAX, RECORDS_MAX, MeshMap, mesh_messages
from r2p.protocols.bridge.ports import STRANGE_PROBES_MAX, PortState
from r2p.protocols.bridge.tree import SpanningTree
from tests.protocols.bridge.wires import MS, Gateway, World

SECOND = 1_000 * MS
STABLE = 2 * SECOND
SHARE = 14


def world(*gateways: str, seed: int = 1) -> tuple[World, list[Gateway]]:
    """A world with gateways between networks that are named by a letter each: "AB" joins A and B."""
    made = World(random.Random(seed))
    started = [start(made, networks, 100 + number) for number, networks in enumerate(gateways)]
    return made, started


def start(made: World, networks: str, identity: int) -> Gateway:
    gateway = Gateway(made, identity, dict(enumerate(networks)))
    gateway.start()
    return gateway


def states(gateway: Gateway) -> list[str]:
    return [port.state.value for port in gateway.tree.ports.values()]


def reached(made: World, message: int) -> dict[str, int]:
    return {network: count for (number, network), count in made.seen.items() if number == message}


def test_forged_probes_are_not_kept_without_end() -> None:
    tree = SpanningTree(5)
    tree.open(0, 0)
    port = tree.ports[0]
    for gateway in range(1000, 1000 + STRANGE_PROBES_MAX + 3):
        tree.receive_probe(SECOND, 0, gateway, 1)
    assert (len(port.probes), port.lost) == (STRANGE_PROBES_MAX, {"too many probes": 3})
    tree.receive_probe(SECOND, 0, 5, 1)  # our own, and what is known already
    tree.receive_probe(2 * SECOND, 0, 1000, 1)
    assert (len(port.probes), port.probes[1000, 1]) == (STRANGE_PROBES_MAX + 1, (SECOND, 2 * SECOND))
    assert port.lost.total() == 3


def test_a_gateway_listens_then_forwards() -> None:
    made, (one,) = world("AB")
    made.run(700 * MS)
    assert states(one) == ["listening", "listening"]
    early = made.publish("A")
    made.run(150 * MS)
    assert states(one) == ["alone", "alone"]
    late = made.publish("A")
    made.run(10 * MS)
    assert reached(made, early) == {"A": 1}
    assert reached(made, late) == {"A": 1, "B": 1}


@pytest.mark.parametrize(
    "gateways",
    [
        ("AB", "AB"),
        ("AB", "BC", "CA"),
        ("AB", "BC", "CD", "DE", "EF", "FG"),
        ("ABC", "ABC", "ABC"),
        ("AA",),
        ("AAB", "AB"),
    ],
    ids="-".join,
)
def test_topologies(gateways: tuple[str, ...]) -> None:
    made, started = world(*gateways)
    made.run(STABLE)
    networks = set("".join(gateways))
    for network in sorted(networks):
        message = made.publish(network)
        made.run(20 * MS)
        assert reached(made, message) == dict.fromkeys(networks, 1)
    assert not {"converging", "listening"} & {state for each in started for state in states(each)}


def test_the_other_takes_over() -> None:
    made, (one, two) = world("AB", "AB")
    made.run(STABLE)
    assert (states(one), states(two)) == (["forwarding"] * 2, ["forwarding", "blocked"])
    one.crash()
    crashed = made.now
    while states(two) != ["alone", "alone"]:
        made.run(10 * MS)
    assert 600 * MS < made.now - crashed < 1_200 * MS


def test_a_stopped_gateway_forwards_nothing_when_it_goes_on() -> None:
    """What it got meanwhile has long been forwarded by the other one."""
    made, (one, _) = world("AB", "AB")
    made.run(STABLE)
    one.stop(5 * SECOND)
    for _ in range(60):
        made.publish("A")
        made.run(100 * MS)
    assert max(made.seen.values()) == 1


def test_hellos_are_few_when_all_is_well() -> None:
    made, _ = world("AB", "AB")
    made.run(STABLE)
    before = made.said
    made.run(10 * SECOND)
    assert (made.said - before) / 10 / 4 < 13  # a second, for each port


@pytest.mark.parametrize("seed", range(int(os.environ.get("R2P_TOPOLOGIES", SHARE))))
def test_random_topologies(seed: int) -> None:
    """Chaos, then calm: crashes, restarts, stops, lossy networks; messages all the time."""
    chance = random.Random(seed)
    made = World(chance)
    networks = "ABCDEFG"[: chance.randint(2, 7)]
    count = chance.randint(1, 6)
    gateways = [_random_gateway(made, chance, networks) for _ in range(count)]
    chaos = chance.choice([0.0, 0.1, 0.3])
    made.loss, made.duplicate, made.reorder = chaos, chance.choice([0.0, 0.3]), chance.choice([0.0, 0.3])
    made.delay = chance.choice([0, 5, 15]) * MS
    for _ in range(chance.randint(0, 4)):
        _talk(made, chance, networks, chance.randint(50, 2_500))
        _trouble(made, chance, networks, gateways)
    _talk(made, chance, networks, 3_000)  # who was stopped goes on
    made.loss = min(made.loss, 0.05)
    _talk(made, chance, networks, 2_000)
    for _ in range(20):
        network = chance.choice(networks)
        message = made.publish(network)
        made.run(200 * MS)
        if message not in made.hurt:
            assert set(reached(made, message)) == _connected(network, gateways)
    assert max(made.seen.values()) == 1
    for gateway in gateways:
        if gateway.alive:
            assert PortState.CONVERGING not in {port.state for port in gateway.tree.ports.values()} or made.loss


def _trouble(made: World, chance: random.Random, networks: str, gateways: list[Gateway]) -> None:
    """A gateway crashes, restarts, is stopped for a while, or a new one joins."""
    victim = chance.choice(gateways)
    match chance.choice(["crash", "restart", "stop", "add"]):
        case "crash" if victim.alive:
            victim.crash()
        case "restart":
            if victim.alive:
                victim.crash()
            gateways[gateways.index(victim)] = start(made, "".join(victim.ports.values()), chance.getrandbits(32))
        case "stop" if victim.alive and victim.held is None:
            victim.stop(chance.randint(10, 3_000) * MS)
        case "add" if len(gateways) < 6:
            gateways.append(_random_gateway(made, chance, networks))


def _random_gateway(made: World, chance: random.Random, networks: str) -> Gateway:
    ports = "".join(chance.choice(networks) for _ in range(chance.randint(2, 4)))
    return start(made, ports, chance.getrandbits(32))


def _talk(made: World, chance: random.Random, networks: str, milliseconds: int) -> None:
    end = made.now + milliseconds * MS
    while made.now < end:
        made.publish(chance.choice(networks))
        made.run(chance.randint(1, 30) * MS)


def _connected(network: str, gateways: list[Gateway]) -> set[str]:
    """The networks that can be reached from this one."""
    reached = {network}
    while True:
        more = {
            each
            for gateway in gateways
            if gateway.alive and reached & set(gateway.ports.values())
            for each in gateway.ports.values()
        }
        if more <= reached:
            return reached
        reached |= more


def test_tables_are_bounded() -> None:
    """Whatever is said, and without work that grows with it."""
    tree = SpanningTree(1)
    tree.open(0, 0)
    tree.poll(0)
    for number in range(2, 5_000):
        tree.receive_mesh(SECOND, 0, Mesh(number, 1, 0, bytes(18)))
        tree.receive_bridge(SECOND, 0, Bridge(number, 1, 1, 0, number, bytes(12)))
    (port,) = tree.ports.values()
    assert len(port.neighbours) == HEARD_MAX
    assert port.lost["too many gateways"] == 4_998 - HEARD_MAX
    assert len(tree.mesh._records) <= RECORDS_MAX


def test_neighbours_that_come_and_go_are_damped() -> None:
    """The others are stopped by the first ones, and from then on by one in ten seconds."""
    made, (one, two) = world("AB", "AB")
    made.run(STABLE)
    silent = 0
    for number in range(600):
        for gateway in (one, two):
            gateway.hear(0, encode(Bridge(1_000 + number, 1, 1, 0, 1_000 + number, bytes(12))))
        made.run(200 * MS)
        silent += one.tree.ports[0].forwards_until <= made.now
    assert silent < 120
    made.run(15 * SECOND)
    assert (states(one), states(two)) == (["forwarding"] * 2, ["forwarding", "blocked"])


def test_a_gateway_that_tells_another_mesh_each_time_is_damped() -> None:
    known = MeshMap(100)
    known.set_heard(0, frozenset({(1, 101, 0)}))
    learnt = 0
    for serial in range(600):
        (message,) = mesh_messages(101, serial, [(0, 100, 1), (1, 500 + serial, 1)])
        learnt += known.receive(serial * 100 * MS, message)
    assert known.members == {100, 101}
    assert CHANGES <= learnt <= CHANGES + 60 // 5 + 1


def test_a_new_gateway_that_had_to_wait_is_let_in() -> None:
    made, (one,) = world("AB")
    made.run(STABLE)
    for number in range(12):
        start(made, "A", 1_000 + number).crash()
        one.hear(0, encode(Bridge(1_000 + number, 0, 1, 0, 1_000 + number, bytes(12))))
        made.run(SECOND)
    late = start(made, "AC", 50)
    made.run(SECOND)
    assert "converging" in states(late)
    made.run(20 * SECOND)
    assert (states(one), states(late)) == (["forwarding", "alone"], ["forwarding", "alone"])
