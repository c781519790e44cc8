"""Nodes that lose frames, clocks that drift: nothing breaks, and everything comes back."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r2p.protocols.rtcan.events import Received
from r2p.protocols.rtcan.master import Role
from tests.protocols.rtcan.bus import MS, SECOND, Bus, Node
from tests.protocols.rtcan.networks import CYCLE, SLOT, counted, current_cycle, is_sync, network, publish, syncs


def busy(bus: Bus, *priorities: int, ppm: int = 0) -> list[Node]:
    """Nodes with a hard, a soft and a non real-time topic each."""
    nodes = [
        bus.add(id8=10 + i, priority=priority, ppm=ppm * (-1) ** i, offset=i * 12_345_678)
        for i, priority in enumerate(priorities)
    ]
    bus.start()
    bus.run(2 * SECOND)
    for node in nodes:
        counted(node, 12)
        node.act(node.engine.reserve(node.now, 2, 12, 5 * MS))
        for other in nodes:
            for high, size in ((2, 12), (3, 20), (4, 40)):
                node.engine.subscribe(high << 8 | (other.engine.id8 or 0), size)
    return nodes


def slots_of(bus: Bus, since: int) -> dict[int, set[Node]]:
    """Who sent hard real-time frames at which instant."""
    owners: dict[int, set[Node]] = {}
    for at, frame, node in bus.sent:
        if at >= since and frame.id >> 23 == 0 and not is_sync(frame):
            owners.setdefault(at, set()).add(node)
    return owners


def hard_failures(node: Node) -> int:
    """Hard real-time messages that were not sent."""
    return sum(count for name, count in node.engine.counts.items() if name.startswith("hrt "))


@settings(max_examples=5)
@given(st.integers(0, 1 << 32), st.sampled_from([0.01, 0.1, 0.3]), st.booleans())
def test_a_lossy_network_recovers(seed: int, loss: float, all_of_them: bool) -> None:
    numbers = random.Random(seed)
    bus = Bus()
    nodes = busy(bus, 3, 2, 0)
    for node in nodes if all_of_them else nodes[1:2]:
        node.deaf = lambda frame: numbers.random() < loss
    for n in range(60):
        for node in nodes:
            publish(node, 3 + n % 2, bytes(20 * (1 + n % 2)), None if n % 2 else 20 * MS)
        bus.run(5 * MS)
    for node in nodes:
        node.deaf = lambda frame: False
    bus.run(5 * SECOND)
    assert sorted(node.engine.election.role.value for node in nodes) == ["master", "slave", "slave"]
    assert (
        len({(node.engine.network.master, node.engine.network.epoch, current_cycle(node.engine)) for node in nodes})
        == 1
    )
    began = bus.now
    failed = [hard_failures(node) for node in nodes]
    bus.run(100 * MS)
    assert [hard_failures(node) for node in nodes] == failed
    for node in nodes:
        received = [each for each in node.of(Received) if each.stamp >= node.local(began) and each.high == 2]
        assert len({each.source for each in received}) == 2
        assert len(received) >= 2 * 18
    reference = syncs(bus, began)[0][0]
    assert all((at - reference) % SLOT < 2_000 for at in slots_of(bus, began))


def test_what_was_lost_is_counted_by_source() -> None:
    bus = Bus()
    a, b, c = busy(bus, 1, 0, 0)
    dropped = 0

    def deaf(frame: object) -> bool:
        nonlocal dropped
        lose = bus.sent[-1][2] is b and not is_sync(bus.sent[-1][1]) and bus.sent[-1][1].id >> 15 & 0xFF == 2
        lose = lose and bus.sent[-1][1].id & 0x7F == 1 and bus.sent[-1][0] % 3 == 0
        dropped += lose
        return lose

    c.deaf = deaf
    bus.run(SECOND)
    assert dropped == 0 or c.engine.reassembly.losses[11].total() >= dropped
    assert 10 not in c.engine.reassembly.losses
    assert a.engine.reassembly.losses == {}


@pytest.mark.parametrize("ppm", [0, 50, 200])
def test_hard_real_time_is_as_exact_as_the_clocks(ppm: int) -> None:
    """Start of frame against the master's grid: off by no more than what the clocks drift apart in one cycle."""
    bus = Bus()
    nodes = busy(bus, 1, 0, 0, ppm=ppm)
    bus.run(200 * MS)
    began = bus.now
    bus.run(SECOND)
    grid = [at for at, _ in syncs(bus, began - 2 * CYCLE)]
    bound = 2 * ppm * CYCLE // 1_000_000 + 2
    for at in slots_of(bus, began):
        reference = max(start for start in grid if start <= at)
        off = (at - reference + SLOT // 2) % SLOT - SLOT // 2
        assert abs(off) <= bound
    assert {len(owners) for owners in slots_of(bus, began).values()} == {1}
    assert [hard_failures(node) for node in nodes] == [0, 0, 0]


def test_master_and_slaves_agree_on_the_time() -> None:
    bus = Bus()
    nodes = [bus.add(id8=10 + i, priority=3 - i, ppm=50 * (i - 1), offset=i * SECOND) for i in range(3)]
    bus.start()
    for _ in range(20):
        bus.run(777 * MS)
        if bus.now > 3 * SECOND:
            times = [node.engine.network_time(node.now) or 0 for node in nodes]
            assert max(times) - min(times) < 1_500
    assert nodes[0].engine.election.role is Role.MASTER


def test_ten_nodes_and_three_masters_dying_one_after_the_other() -> None:
    bus = Bus()
    nodes = network(bus, *range(1, 8), 0, 0, 0)
    for node in nodes[-3:]:
        counted(node)
        node.act(node.engine.reserve(node.now, 2, 8, 10 * MS))
    bus.run(200 * MS)
    for expected in (15, 14, 13):
        bus.kill(next(node for node in nodes if node.alive and node.engine.election.role is Role.MASTER))
        bus.run(SECOND)
        assert {node.engine.network.master for node in nodes if node.alive} == {expected}
        owners = slots_of(bus, bus.now - 5 * CYCLE)
        assert {len(each) for each in owners.values()} == {1}
        assert {node for each in owners.values() for node in each} == set(nodes[-3:])
        assert len(owners) in (14, 15, 16)
