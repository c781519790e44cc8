"""What the three classes of publishers become on the bus."""

import asyncio
import itertools
from typing import Annotated, Any

import pytest

import r2p
from r2p.clock import clock_of
from r2p.codecs import rtcan
from r2p.msg import PWM2, Float32, Led
from tests.transports.rtcan.networks import CYCLE, SLOT, Lab, lab, until

pytestmark = pytest.mark.virtual_time


class Bulk(r2p.Message):
    """As much as RTCAN carries."""

    data: Annotated[tuple[r2p.u8, ...], r2p.Len(1024)] = (0,) * 1024


def slots_of(made: Lab, starts: list[int]) -> list[int]:
    """The slots (of a cycle) that begin exactly at these instants."""
    syncs = [each.start for each in made.sent(lambda found: found.laxity == rtcan.HRT and found.message_id < 256)]
    slots, rest = zip(*(divmod(start - syncs[0], SLOT) for start in starts), strict=True)
    assert set(rest) == {0}
    return [slot % 60 for slot in slots]


def phase_of(publisher: r2p.PeriodicPublisher[Any]) -> int:
    return int(publisher.guarantees["sim:"].partition("phase ")[2])


async def test_a_periodic_topic_owns_slots_and_they_are_its_clock() -> None:
    asked: list[int] = []

    def fill() -> PWM2:
        asked.append(clock_of().monotonic())
        return PWM2(pwm1=len(asked))

    async with lab("A", "B") as (made, (alice, bob)):
        subscriber = bob.subscribe("pwm", PWM2)
        publisher = alice.advertise("pwm", PWM2, r2p.Periodic(0.005, fill))
        await publisher.ready(5.0)
        assert publisher.period == pytest.approx(30 * SLOT / 1e9)
        phase = phase_of(publisher)
        assert publisher.guarantees["sim:"] == f"a slot every 30 slots (4.98 ms), phase {phase}"
        await publisher.wait_subscriber()
        await asyncio.sleep(0.1)
        made.clear()
        asked.clear()
        missed = publisher.missed  # before there was a master
        await asyncio.sleep(1.0)
        starts = [each.start for each in made.hrt("A")]
        assert {b - a for a, b in itertools.pairwise(starts)} == {30 * SLOT}
        assert set(slots_of(made, starts)) == {phase, phase + 30}
        assert {start - 7 * SLOT for start in starts[1:]} <= set(asked)  # the lead is 1 ms
        samples = [subscriber.queue.popleft() for _ in range(3)]
        assert [each.publisher_class for each in samples] == [r2p.PublisherClass.PERIODIC] * 3
        assert publisher.missed == missed


async def test_stamps_are_the_start_of_the_first_frame() -> None:
    async with lab("A", "B") as (made, (alice, bob)):
        subscriber = bob.subscribe("pwm", PWM2)
        publisher = alice.advertise("pwm", PWM2, r2p.Periodic(0.005, PWM2))
        await publisher.ready(5.0)
        await publisher.wait_subscriber()
        made.clear()
        await asyncio.sleep(0.05)
        utc = bob.now() - clock_of().monotonic()
        sample = subscriber.queue[-1]
        assert not sample.stamped
        assert sample.stamp - utc in [each.start for each in made.hrt("A")]
        assert sample.source == r2p.Source("A", "test", "sim:")


async def test_a_slot_is_reserved_without_a_subscriber_and_used_only_with_one() -> None:
    async with lab("A", "B") as (made, (alice, bob)):
        publisher = alice.advertise("pwm", PWM2, r2p.Periodic(0.005, PWM2))
        local = alice.subscribe("pwm", PWM2)
        await publisher.ready(5.0)
        await asyncio.sleep(0.1)
        assert not made.hrt("A")
        assert local.queue
        link = made.link("B")
        phase = phase_of(publisher)
        assert link.engine.cycle.mask == 1 | 1 << phase | 1 << phase + 30
        subscriber = bob.subscribe("pwm", PWM2)
        await subscriber.fetch(timeout=1.0)
        publisher.close()
        await asyncio.sleep(0.1)
        assert link.engine.cycle.mask == 1


async def test_a_long_periodic_message_gets_slots_in_a_row() -> None:
    class Long(r2p.Message):
        data: Annotated[tuple[r2p.u8, ...], r2p.Len(26)] = tuple(range(26))

    async with lab("A", "B") as (made, (alice, bob)):
        subscriber = bob.subscribe("long", Long)
        publisher = alice.advertise("long", Long, r2p.Periodic(0.010, Long))
        await publisher.ready(5.0)
        assert publisher.guarantees["sim:"].startswith("4 slots every 60 slots (9.96 ms), phase")
        assert await subscriber.fetch(timeout=1.0) == Long()
        made.clear()
        await asyncio.sleep(0.1)
        starts = [each.start for each in made.hrt("A")]
        first = phase_of(publisher)
        assert slots_of(made, starts)[:4] == [first, first + 1, first + 2, first + 3]


async def test_several_periodic_topics_never_meet() -> None:
    async with lab("A", "B", "C") as (made, nodes):
        publishers = []
        for number, period in enumerate((0.001, 0.005, 0.010)):  # the other way round the last ones might not fit
            for node in nodes:
                publishers.append(node.advertise(f"{node.module}{number}", PWM2, r2p.Periodic(period, PWM2)))
                await publishers[-1].ready(5.0)
        others = [each for each in publishers if each.node is not nodes[0]]
        subscribers = [nodes[0].subscribe(each.topic, PWM2, lossy=True) for each in others]
        await asyncio.sleep(0.2)
        made.clear()
        await asyncio.sleep(1.0)
        starts = [each.start for each in made.sent(lambda found: found.laxity == 0)]
        assert len(set(slots_of(made, starts))) > 20
        assert len(starts) == len(set(starts))
        assert [publisher.missed for publisher in others] == [0] * 6
        assert all(subscriber.lost or subscriber.queue for subscriber in subscribers)


async def test_what_can_never_be_admitted_is_refused_at_once_if_strict() -> None:
    async with lab("A") as (_, (alice,)):
        with pytest.raises(r2p.TransportError, match="slots"):
            alice.advertise("pwm", PWM2, r2p.Periodic(SLOT / 1e9, PWM2), strict=True)
        alice.advertise("bulk", Bulk, strict=True)
        alice.advertise("event", Led, r2p.Sporadic(0.01), strict=True)


async def test_what_is_refused_goes_as_soft_real_time_and_says_so() -> None:
    """Three topics want two slots of three each: there is room for one."""
    async with lab("A", "B") as (made, (alice, bob)):
        publishers = [alice.advertise(f"t{n}", PWM2, r2p.Periodic(0.0005, PWM2)) for n in range(2)]
        subscribers = [bob.subscribe(each.topic, PWM2) for each in publishers]
        await publishers[0].ready(5.0)
        await asyncio.sleep(0.5)
        third = alice.advertise("t2", PWM2, r2p.Periodic(0.0005, PWM2))
        wanted = bob.subscribe("t2", PWM2)
        with pytest.raises(TimeoutError):
            await third.ready(0.5)
        assert third.guarantees["sim:"].startswith("refused: ")
        assert "soft real-time" in third.guarantees["sim:"]
        assert third.period == 0.0005
        sample = await anext(wanted.samples())
        assert sample.publisher_class is r2p.PublisherClass.SPORADIC
        publishers[0].close()  # its slots come free
        await third.ready(5.0)
        assert third.guarantees["sim:"].startswith("a slot every 3 slots")
        assert all(subscriber.queue for subscriber in subscribers)
        assert made.link("A").slots["t2"].period == 3


async def test_events_go_by_least_laxity() -> None:
    async with lab("A", "B") as (made, (alice, bob)):
        late, soon = (
            alice.advertise("late", Led, r2p.Sporadic(0.040)),
            alice.advertise("soon", Led, r2p.Sporadic(0.010)),
        )
        subscribers = [bob.subscribe(name, Led) for name in ("late", "soon")]
        await late.wait_subscriber()
        await soon.wait_subscriber()
        await asyncio.sleep(0.5)
        made.clear()
        await late.publish(Led())
        await soon.publish(Led())
        await asyncio.sleep(0.005)
        laxities = [found.laxity for found in made.identifiers(lambda found: 0 < found.laxity < 50)]
        assert laxities[0] <= 10
        assert 30 <= laxities[1] <= 40
        sample = subscribers[1].queue.popleft()
        assert sample.publisher_class is r2p.PublisherClass.SPORADIC
        assert 0.008e9 < sample.deadline - sample.stamp <= 0.010e9


async def test_an_event_that_is_late_is_dropped_or_sent_and_signalled_either_way() -> None:
    """The bus is full of something more important for a while."""
    missed: list[r2p.Missed] = []
    late: list[r2p.Missed] = []
    async with lab("A", "B") as (made, (alice, bob)):
        drop = alice.advertise("drop", Led, r2p.Sporadic(0.005, on_missed=missed.append))
        send = alice.advertise("send", Led, r2p.Sporadic(0.005, late="send", on_late=late.append))
        dropped, sent = bob.subscribe("drop", Led), bob.subscribe("send", Led)
        await drop.wait_subscriber()
        await send.wait_subscriber()
        await asyncio.sleep(0.5)
        babbler = made.can.port("B").controller
        babbler.babble(rtcan.Frame(rtcan.encode_identifier(0, 0x02FE), bytes(8)))
        await drop.publish(Led(led=1))
        await send.publish(Led(led=1))
        await asyncio.sleep(0.020)
        babbler.babble(None)
        assert await sent.fetch(timeout=1.0) == Led(led=1)
        assert not dropped.queue
        assert (drop.missed, send.missed, send.late) == (1, 0, 1)
        assert [each.reason for each in missed] == ["overdue"]
        assert [each.where for each in late] == ["sim:"]
        assert late[0].late > 0.010


async def test_bulk_waits_and_refuses_no_event() -> None:
    total = 50

    async def send(node: r2p.Node) -> None:
        bulk = node.advertise("bulk", Bulk, r2p.NonRealTime(stall=10.0))
        await bulk.wait_subscriber()
        for _ in range(total):
            await bulk.publish(Bulk())
        assert not bulk.missed

    async with lab("A", "B") as (made, (alice, bob)):
        bulks, events = bob.subscribe("bulk", Bulk), bob.subscribe("event", Led)
        event = alice.advertise("event", Led, r2p.Sporadic(0.005))
        await event.wait_subscriber()
        made.host("A").start(send)
        for _ in range(10):
            await bulks.fetch(timeout=2.0)
        for number in range(20):
            await event.publish(Led(led=number))
            assert await events.fetch(timeout=0.005) == Led(led=number)
        for _ in range(total - 10):
            await bulks.fetch(timeout=2.0)
        assert not event.missed
        assert not made.link("A").losses
        assert not bulks.lost


async def test_a_message_of_1024_bytes() -> None:
    message = Bulk(data=tuple(number % 251 for number in range(1024)))
    async with lab("A", "B") as (made, (alice, bob)):
        publisher, subscriber = alice.advertise("bulk", Bulk), bob.subscribe("bulk", Bulk)
        await publisher.wait_subscriber()
        await publisher.publish(message)
        assert await subscriber.fetch(timeout=1.0) == message
        found = made.identifiers(lambda found: found.laxity == rtcan.NRT, "A")
        assert [each.left for each in found] == list(range(127, -1, -1))


async def test_delivered_means_seen_on_the_bus() -> None:
    """Without an acknowledge nothing is delivered, and after some errors it is given up."""
    missed: list[r2p.Missed] = []
    async with lab("A", "B") as (made, (alice, bob)):
        publisher = alice.advertise("event", Led, r2p.Sporadic(0.030, on_missed=missed.append))
        subscriber = bob.subscribe("event", Led)
        await publisher.wait_subscriber()
        made.can.bus.noise = 1.0
        await publisher.publish(Led())
        await asyncio.sleep(0.040)
        made.can.bus.noise = 0.0
        assert len(missed) == publisher.missed == 1
        assert made.link("A").stats.faults["bus errors"]
        assert not subscriber.queue


async def test_two_publishers_of_one_topic_have_two_message_ids() -> None:
    async with lab("A", "B", "C") as (made, (alice, bob, carol)):
        subscriber = carol.subscribe("number", Float32)
        publishers = [node.advertise("number", Float32) for node in (alice, bob)]
        for publisher in publishers:
            await publisher.wait_subscriber()
        for number, publisher in enumerate(publishers):
            await publisher.publish(Float32(data=float(number)))
        samples = subscriber.samples()
        seen = {(sample.source.module, sample.data) for sample in [await anext(samples), await anext(samples)]}
        assert {module for module, _ in seen} == {"A", "B"}
        messages = {each.message_id for each in made.identifiers(lambda found: found.laxity == rtcan.NRT)}
        assert len(messages) == 2
        assert len({rtcan.high_byte(message) for message in messages}) == 1


async def test_no_module_gets_what_it_does_not_subscribe() -> None:
    """The filters pass the ids of subscribed topics, and no others."""
    async with lab("A", "B", "C") as (made, (alice, bob, carol)):
        publisher = alice.advertise("leds", Led)
        subscriber = bob.subscribe("leds", Led)
        await publisher.wait_subscriber()
        await publisher.publish(Led())
        await subscriber.fetch(timeout=1.0)
        message = made.identifiers(lambda found: found.laxity == rtcan.NRT)[0].message_id
        wanted = {each: made.link(each).engine.filters() for each in ("B", "C")}
        needed = rtcan.message_filter(message)
        assert needed in wanted["B"]
        assert needed not in wanted["C"]
        subscriber.close()
        await asyncio.sleep(0.1)
        assert needed not in made.link("B").engine.filters()
        assert not publisher.subscribers
        assert not carol.subscribers


async def test_network_time_is_the_same_everywhere() -> None:
    made = Lab()
    async with made.module("A", drift_ppm=50.0) as alice, made.module("B", offset=5_000, drift_ppm=-50.0) as bob:
        assert alice.network_time() is None
        await asyncio.sleep(5.0)
        ours, theirs = alice.network_time(), bob.network_time()
        assert ours is not None
        assert theirs is not None
        assert abs(ours - theirs) < CYCLE * 1e-4 + 2  # the drift of a cycle
        utc = made.link("B").utc()
        assert utc is not None
        assert abs(utc[0] - bob.now()) < 100_000 * 5.0 + 2_000_000


async def test_discovery_leaves_room_in_the_slots_that_are_free() -> None:
    async with lab("A", "B", slots=10) as (made, (alice, bob)):
        for number in range(4):
            alice.advertise(f"pwm{number}", PWM2, r2p.Periodic(0.00996, PWM2))
            bob.subscribe(f"pwm{number}", PWM2)
        await until(lambda: [topic.period for topic in made.link("A").slots.values()] == [5] * 4)
        await asyncio.sleep(8.0)  # what was allowed before has been said: of 10 slots one is left
        made.clear()
        await asyncio.sleep(4.0)
        said = made.sent(lambda found: rtcan.high_byte(found.message_id) == rtcan.MANAGEMENT)
        assert all(topic.period for topic in made.link("A").slots.values())
        assert 50 < len(said) < 350  # of 400, with claims, renewals, and answers
