"""Network time goes on when masters are late, sleep or die, and is the same for all."""

import pytest

from r2p.codecs import can_bits, rtcan
from r2p.codecs.management import ManagementType
from r2p.codecs.rtcan import Frame
from r2p.protocols.rtcan.cycle import Cycle, timing
from r2p.protocols.rtcan.events import LostSync, NewMaster
from r2p.protocols.rtcan.master import Role
from tests.protocols.rtcan.bus import MS, SECOND, Bus, Node
from tests.protocols.rtcan.networks import CYCLE, is_sync, network

US = 1_000


def shown(node: Node) -> int:
    """Its network time less true time."""
    time = node.engine.network_time(node.now)
    assert time is not None
    return time - node.bus.now


def first_sync_late(node: Node, by: int) -> None:
    """The next sync that it sends is late, those after it are not."""

    def late(frame: Frame) -> int:
        if not is_sync(frame):
            return 0
        node.late = lambda frame: 0
        return by

    node.late = late


@pytest.mark.parametrize("late", [0, 100 * US, MS, 4 * MS])
def test_the_next_master_s_first_sync_is_late_and_network_time_catches_up(late: int) -> None:
    """The slaves go with it: they lose nothing by that."""
    bus = Bus()
    first, second, slave, _ = network(bus, 3, 2, 0, 0)
    before, epoch = shown(slave), slave.engine.network.epoch
    first_sync_late(second, late)
    bus.kill(first)
    bus.run(200 * MS)
    assert second.engine.election.role is Role.MASTER
    losses = len(slave.of(LostSync))
    assert before - late - 100 * US < shown(slave) < before - late + 200 * US
    bus.run(20 * SECOND)
    assert abs(shown(slave) - before) < 2 * US
    assert abs(shown(slave) - shown(second)) < 2 * US
    assert (slave.engine.network.epoch, second.engine.network.epoch) == (epoch, epoch)
    assert len(slave.of(LostSync)) == losses
    assert slave.engine.counts["foreign syncs"] == 0


def test_masters_whose_first_syncs_are_late_never_add_up() -> None:
    """Each founds the network anew after it slept."""
    bus = Bus()
    master, slave, _ = network(bus, 3, 0, 0)
    before, epoch = shown(slave), slave.engine.network.epoch
    for _ in range(6):
        first_sync_late(master, 3 * MS)
        asleep(master, 100 * MS)
        bus.run(SECOND)
        assert master.engine.election.role is Role.MASTER
        if master.engine.network.epoch == epoch:
            assert before - CYCLE // 2 <= shown(master) < before + 2 * US
            assert abs(shown(slave) - shown(master)) < 2 * US
        before, epoch = (
            (before, epoch) if master.engine.network.epoch == epoch else (shown(slave), master.engine.network.epoch)
        )
        assert slave.engine.network.epoch == epoch


@pytest.mark.parametrize("late", [5 * MS, 50 * MS, 250 * MS])
def test_a_first_sync_whose_count_is_over_begins_another_network(late: int) -> None:
    """Network time can't catch up any more: so it is not the same time."""
    bus = Bus()
    master, slave, _ = network(bus, 3, 0, 0)
    epoch = master.engine.network.epoch
    first_sync_late(master, late)
    asleep(master, 100 * MS)
    bus.run(SECOND + late)
    assert master.engine.election.role is Role.MASTER
    assert master.engine.network.epoch == slave.engine.network.epoch != epoch
    assert slave.of(NewMaster)[-1].epoch == master.engine.network.epoch
    assert abs(shown(slave) - shown(master)) < 2 * US


def asleep(node: Node, duration: int) -> None:
    """Its process stands still for a while."""
    live, node.alive = node.alive, False
    node.bus.run(duration)
    node.alive = live


def test_a_master_whose_syncs_leave_late_has_the_time_of_its_slaves() -> None:
    bus = Bus()
    master, *slaves = network(bus, 3, 0, 0, slots=10)
    master.late = lambda frame: 0 if not is_sync(frame) else 100 * US + bus.now // MS % 7 * 40 * US
    for _ in range(50):
        bus.run(7 * MS)
        assert {shown(slave) for slave in slaves} == {shown(slaves[0])}
        assert abs(shown(slaves[0]) - shown(master)) < 2 * US
    assert master.engine.counts["syncs not sent"] == 0
    assert not any(slave.engine.counts["foreign syncs"] for slave in slaves)


def test_syncs_that_jitter_move_neither_the_master_s_time_nor_its_slots() -> None:
    """They move the slaves, which know nothing but when each sync came."""
    bus = Bus()
    master, slave, _ = network(bus, 3, 0, 0)
    start, cycle = shown(master), master.engine.cycle
    master.late = lambda frame: bus.now // CYCLE % 4 * 2 * US if is_sync(frame) else 0
    phases, seen = set(), set()
    for _ in range(50):
        bus.run(7 * MS)
        phases.add((cycle.reference - cycle.counter * CYCLE) // US)
        seen.add((shown(slave) - start) // US)
        assert abs(shown(master) - start) < US
        assert abs(shown(slave) - start) < 7 * US
    assert len(phases) == 1
    assert len(seen) > 2


def test_no_old_counter_is_told_when_a_master_wakes_up() -> None:
    """It would be taken for the right one less a multiple of 256."""
    bus = Bus()
    master, slave, _ = network(bus, 3, 0, 0)
    bus.run_until(lambda: waits(master))
    before, epoch = shown(slave), slave.engine.network.epoch
    asleep(master, 256 * CYCLE)
    seen = 0
    for _ in range(1000):
        bus.run(MS // 4)
        if slave.engine.network.epoch == epoch and slave.engine.network_time(slave.now) is not None:
            seen += 1
            assert abs(shown(slave) - before) < CYCLE
    assert seen


def waits(node: Node) -> bool:
    """Whether its NETWORK has yet to be sent."""
    return any(
        each.payload[-1] == ManagementType.NETWORK for each in node.engine.transmitter.queue.messages() if not each.sent
    )


@pytest.mark.parametrize("ahead", [-100, -20, 0, 20, 100])
def test_a_count_that_was_heard_long_ago_is_the_nearest_one(ahead: int) -> None:
    """While there was no sync the slave's clock has gone wrong by so many cycles."""
    cycle = Cycle(timing())
    hear(cycle, 1000, 1000 * CYCLE)
    cycle.anchor(1000)
    cycle.stop()
    hear(cycle, 301_000, (301_000 + ahead) * CYCLE)
    assert cycle.counter == 301_000


def hear(cycle: Cycle, count: int, start: int) -> None:
    frame = rtcan.encode_sync(count, 1)
    cycle.on_sync(frame, start + can_bits.frame_bits(frame.id, frame.data) * US)
