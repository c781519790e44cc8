"""What happens when modules and masters come, go, fail, and get in each other's way."""

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack

import pytest

import r2p
from r2p.codecs import management, rtcan
from r2p.codecs.management import Advertise
from r2p.msg import PWM2, Led
from r2p.protocols.rtcan.master import Role
from r2p.protocols.rtcan.topic_ids import TopicIdAllocator
from r2p.runtime.events import ModuleEvent
from r2p.sim.can import CanNode, ControllerState
from r2p.transports.rtcan.transport import RtcanOptions
from r2p.units import SECOND
from tests.transports.rtcan.networks import CYCLE, GUARD, Lab, lab, until

pytestmark = pytest.mark.virtual_time


async def notice(events: AsyncIterator[ModuleEvent], kind: str) -> r2p.LinkNotice:
    async with asyncio.timeout(GUARD):
        async for event in events:
            if isinstance(event, r2p.LinkNotice) and event.kind == kind:
                return event
    raise AssertionError("the module is closed")


async def down(events: AsyncIterator[ModuleEvent]) -> r2p.LinkDown:
    async with asyncio.timeout(GUARD):
        async for event in events:
            if isinstance(event, r2p.LinkDown):
                return event
    raise AssertionError("the module is closed")


def master_of(made: Lab, *names: str) -> str:
    """The module that keeps the cycle."""
    (master,) = [name for name in names if made.link(name).engine.election.role is Role.MASTER]
    return master


async def test_nothing_is_announced_before_the_node_has_an_id() -> None:
    async with lab("A") as (made, (alice,)):
        alice.advertise("leds", Led)
        alice.subscribe("cmd", Led)
        link = made.link("A")
        while not link.engine.ready:
            assert not link.up
            assert "not on the bus" in link.guarantee("leds", r2p.PublisherClass.NON_REAL_TIME)
            claims = made.sent(lambda found: rtcan.high_byte(found.message_id) == rtcan.MANAGEMENT)
            assert len(claims) <= 4  # the CLAIM, which no node acknowledges
            await asyncio.sleep(0.01)
        assert link.up


async def test_the_master_dies_and_another_one_takes_over() -> None:
    """Slots are kept, and no module sends outside of them. A publisher that had none for some cycles is degraded."""
    async with lab("A", "B", "C") as (made, nodes):
        publishers = [node.advertise(node.module, PWM2, r2p.Periodic(0.005, PWM2)) for node in nodes]
        subscribers = {node.module: node.subscribe("x", PWM2) for node in nodes}
        for each in publishers:
            await each.ready(5.0)
        old = master_of(made, "A", "B", "C")
        watcher, survivor = [name for name in "ABC" if name != old]
        wanted = made.host(watcher).start(_listen, survivor, name="listen")
        events = made.host(survivor).events()
        phases = made.link(survivor).slots[survivor].phase
        made.can.port(old).power_off()
        assert "no sync" in (await notice(events, "no master")).text
        degraded = publishers["ABC".index(survivor)]
        await notice(events, "master")
        await degraded.ready(5.0)
        assert made.link(survivor).slots[survivor].phase == phases
        assert master_of(made, watcher, survivor) != old
        made.can.port(old).power_on()
        await until(lambda: made.link(old).engine.network.master is not None)
        assert master_of(made, "A", "B", "C") != old
        await publishers["ABC".index(old)].ready(5.0)
        assert wanted.subscribers
        assert not any(subscriber.queue for subscriber in subscribers.values())


@pytest.mark.parametrize("offset", [CYCLE // 2, -140_000])
async def test_a_node_that_sends_syncs_with_the_right_count_is_news(offset: int) -> None:
    """In the middle of a cycle all report it. In place of the master's, without slots, the master and the owner do."""
    async with lab("A", "B") as (made, (alice, bob)):
        publisher = alice.advertise("pwm", PWM2, r2p.Periodic(0.005, PWM2))
        _subscriber = bob.subscribe("pwm", PWM2, lossy=True)
        await publisher.ready(5.0)
        await asyncio.sleep(0.2)
        events = {name: made.host(name).events() for name in ("A", "B")}
        attacker = made.can.bus.attach(CanNode("X"))
        cycle, clock = (found := made.link("B")).engine.cycle, found.driver.port.monotonic
        start, counter = cycle.reference, cycle.counter
        for number in range(2, 40):
            at = clock(start + number * CYCLE) + offset
            await asyncio.sleep((at - made.can.bus.timeline.now()) / SECOND)
            attacker.request(rtcan.encode_sync(counter + number, 1))
        for name in ("A", "B"):
            assert "a broken node sends sync frames" in (await notice(events[name], "foreign syncs")).text


async def _listen(node: r2p.Node, topic: str) -> None:
    async for _ in node.subscribe(topic, PWM2, lossy=True):
        pass


async def test_a_lost_slot_is_signalled_and_the_topic_goes_on() -> None:
    degraded: list[r2p.Missed] = []
    made = Lab()
    async with made.module("A", options={"priority": 0}) as alice:
        async with made.module("M") as boss:
            publisher = alice.advertise("pwm", PWM2, r2p.Periodic(0.005, PWM2, on_degraded=degraded.append))
            subscriber = boss.subscribe("pwm", PWM2, lossy=True)
            await publisher.ready(5.0)
            assert publisher.period < 0.005
            made.can.port("M").power_off()
            await until(lambda: degraded)
            assert "slots lost" in degraded[0].reason
            assert publisher.period == 0.005
            assert "no master" in publisher.guarantees["sim:"]
            assert "soft real-time" in publisher.guarantees["sim:"]
            del subscriber
        async with made.module("N", options={"priority": 0}) as other:
            samples = other.subscribe("pwm", PWM2).samples()
            sample = await anext(samples)
            assert sample.publisher_class is r2p.PublisherClass.SPORADIC
            periods = []
            for _ in range(5):
                before, sample = sample, await anext(samples)
                periods.append(sample.stamp - before.stamp)
            assert all(abs(period - 5_000_000) < 1_000_000 for period in periods)


async def test_a_module_that_dies_and_returns() -> None:
    async with lab("A", "B") as (made, (alice, bob)):
        publisher = alice.advertise("leds", Led, latch=True)
        subscriber = bob.subscribe("leds", Led)
        await publisher.publish(Led(led=7))
        assert await subscriber.fetch(timeout=5.0) == Led(led=7)
        events = made.host("A").events()
        made.can.port("A").power_off()
        assert (await down(events)).reason == "no power"
        assert not publisher.subscribers
        await asyncio.sleep(6.0)
        assert "A" not in [view.name for view in made.host("B").network.modules()]
        made.can.port("A").power_on()
        assert await subscriber.fetch(timeout=5.0) == Led(led=7)
        await publisher.publish(Led(led=8))
        assert await subscriber.fetch(timeout=5.0) == Led(led=8)


async def test_a_latched_value_comes_again_when_its_reader_reboots() -> None:
    values: list[Led] = []

    async def read(node: r2p.Node) -> None:
        subscriber = node.subscribe("leds", Led)
        while True:
            values.append(await subscriber.fetch())

    async with lab("A", "B") as (made, (alice, _)):
        publisher = alice.advertise("leds", Led, latch=True)
        await publisher.publish(Led(led=7))
        made.host("B").start(read)
        await until(lambda: values == [Led(led=7)])
        await asyncio.sleep(3.0)
        await made.host("B").reboot()
        await until(lambda: values == [Led(led=7)] * 2)


async def test_a_subscriber_that_is_silent_loses_its_lease() -> None:
    async with lab("A", "B") as (made, (alice, bob)):
        publisher, subscriber = alice.advertise("leds", Led), bob.subscribe("leds", Led)
        await publisher.wait_subscriber()
        await publisher.publish(Led())
        await subscriber.fetch(timeout=1.0)
        made.can.port("B").power_off()
        assert publisher.subscribers
        await asyncio.sleep(8.0)
        assert not publisher.subscribers


async def test_bus_off_and_recovery() -> None:
    degraded: list[r2p.Missed] = []
    async with lab("A", "B", "C") as (made, (alice, bob, _)):
        publisher = alice.advertise("leds", Led, r2p.Sporadic(0.010, on_degraded=degraded.append))
        subscriber = bob.subscribe("leds", Led)
        await publisher.wait_subscriber()
        events = made.host("A").events()
        controller = made.can.port("A").controller
        controller.confinement.transmit = 250
        made.can.bus.noise = 1.0
        while controller.state is not ControllerState.BUS_OFF:
            await publisher.publish(Led())
            await asyncio.sleep(0.001)
        made.can.bus.noise = 0.0
        assert (await down(events)).reason == "bus off"
        assert degraded
        await until(lambda: made.link("A").up)
        await publisher.wait_subscriber()
        while subscriber.queue:
            subscriber.queue.popleft()
        await publisher.publish(Led(led=9))
        assert await subscriber.fetch(timeout=1.0) == Led(led=9)
        assert made.link("A").stats.ups == 2


async def test_two_nodes_of_one_id_the_one_that_came_later_yields() -> None:
    made = Lab()
    async with made.module("A", options={"id": 7}) as alice:
        await until(lambda: made.link("A").up)
        module = r2p.Module("B", via=made.can.transport(RtcanOptions(id=7, priority=1)), watchdog=False)
        events = module.events()
        async with module:
            conflict = await notice(events, "id conflict")
            assert "7" in conflict.text
            assert not module.links[0].up
            assert made.link("A").up
            assert made.link("A").engine.id8 == 7
            assert alice.network_time() is None or alice.network_time()


async def test_a_network_of_other_parameters_is_left_alone() -> None:
    made = Lab()
    async with made.module("A", options={"priority": 9}) as alice:
        await until(lambda: made.link("A").engine.election.role is Role.MASTER)
        async with made.module("B", options={"slots": 50}) as bob:
            publisher = bob.advertise("leds", Led)
            await until(lambda: made.link("B").engine.network.mismatch)
            text = publisher.guarantees["sim:"]
            assert text.startswith("nothing is sent: the network has 60 slots of 166 us")
            made.clear()
            await asyncio.sleep(1.0)
            assert not [each for each in made.frames if "B" in each.senders]
            assert not alice.publishers


async def test_two_topics_never_share_a_high_byte() -> None:
    """Two names that would take the same one first: one of them takes another, and both arrive."""
    first, second = _colliding()
    async with lab("A", "B", "C") as (made, (alice, bob, carol)):
        one, other = alice.advertise(first, Led), bob.advertise(second, PWM2)
        ones, others = carol.subscribe(first, Led), carol.subscribe(second, PWM2)
        await one.wait_subscriber()
        await other.wait_subscriber()
        await asyncio.sleep(3.0)
        await one.publish(Led(led=1))
        await other.publish(PWM2(pwm1=1))
        assert await ones.fetch(timeout=1.0) == Led(led=1)
        assert await others.fetch(timeout=1.0) == PWM2(pwm1=1)
        data = made.identifiers(lambda found: found.laxity == rtcan.NRT)
        assert len({rtcan.high_byte(each.message_id) for each in data}) == 2


def _colliding() -> tuple[str, str]:
    """Two topics that take the same high byte when each is alone."""
    seen: dict[int | None, str] = {}
    for number in range(1000):
        name = f"topic{number}"
        high = TopicIdAllocator().pick(name)
        if high in seen:
            return seen[high], name
        seen[high] = name
    raise AssertionError("256 bytes for 1000 names")


async def test_message_ids_that_a_broken_node_has_taken_come_free() -> None:
    async with lab("A", "B") as (made, (alice, bob)):
        link = made.link("A")
        publisher, subscriber = alice.advertise("leds", Led), bob.subscribe("leds", Led)
        await publisher.wait_subscriber()
        for high in range(rtcan.FIRST_TOPIC, 256):
            advertise = Advertise(f"broken{high}", 8, 0, management.rtcan_params(rtcan.message_id(high, 1)))
            for left, data in rtcan.fragments(management.encode(advertise)):
                frame = rtcan.Frame(rtcan.encode_identifier(50, 0x0101, left), data)
                link.driver.on_frame(frame, link.driver.now())
        assert publisher.subscribers == 0
        async with asyncio.timeout(330):
            await publisher.wait_subscriber()
        await publisher.publish(Led(led=1))
        assert await subscriber.fetch(timeout=1.0) == Led(led=1)


async def test_publishers_of_a_topic_share_a_high_byte() -> None:
    first, second = _colliding()
    async with lab("A", "B", "C") as (made, (alice, bob, carol)):
        subscriber = carol.subscribe(second, Led)
        blocker = alice.advertise(first, Led)
        await asyncio.sleep(3.0)
        bobs = bob.advertise(second, Led)  # the byte that the name decides is taken
        await bobs.wait_subscriber()
        blocker.close()
        alices = alice.advertise(second, Led)
        await alices.wait_subscriber()
        made.clear()
        for publisher, led in (alices, 1), (bobs, 2):
            await publisher.publish(Led(led=led))
            assert await subscriber.fetch(timeout=1.0) == Led(led=led)
        data = made.identifiers(lambda found: found.laxity == rtcan.NRT)
        assert len({each.message_id for each in data}) == 2
        assert len({rtcan.high_byte(each.message_id) for each in data}) == 1


async def test_stop_is_urgent() -> None:
    """It arrives while others send as much as they can."""

    async def flood(node: r2p.Node) -> None:
        publisher = node.advertise("flood", Led, r2p.NonRealTime(stall=10.0))
        await publisher.wait_subscriber()
        while True:
            await publisher.publish(Led())

    async with lab("A", "B") as (made, (_, bob)):
        drain = bob.subscribe("flood", Led, lossy=True)
        made.host("A").start(flood)
        await drain.fetch(timeout=5.0)
        made.host("B").command(r2p.Command.STOP, "A")
        await asyncio.sleep(0.010)
        assert made.host("A").stopped


async def test_a_fixed_id_that_is_taken_is_waited_for_and_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "r2p")
    made = Lab()
    async with AsyncExitStack() as stack, made.module("C"):
        await stack.enter_async_context(made.module("A", options={"id": 5}))
        await asyncio.sleep(3.0)
        async with made.module("B", options={"id": 5}):
            caplog.clear()
            await asyncio.sleep(20.0)
            assert not made.link("B").up
            await stack.aclose()
            await until(lambda: made.link("B").up)
            assert made.link("B").engine.id8 == 5
    conflicts = [line for line in caplog.messages if "another node uses" in line]
    assert conflicts == [
        "link sim: another node uses the id 5 of this one: the other node keeps it, this module waits until it is free"
    ]
