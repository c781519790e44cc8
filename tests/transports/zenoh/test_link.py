"""Topics over zenoh: flow from end to end, losses, latches, other people's keys. On loopback, in one process."""

import asyncio
import contextlib
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Annotated, Any

import msgspec
import pytest
import zenoh

import r2p
from r2p.clock import SystemClock
from r2p.codecs import attachment, liveliness
from r2p.codecs.attachment import Header, Origin
from r2p.codecs.liveliness import TopicToken
from r2p.codecs.management import ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.messages import layout
from r2p.msg import Led, Text
from r2p.protocols.flow_control import NO_LIMIT
from r2p.protocols.liveliness import session as liveliness_session
from r2p.testing.network import node_in
from r2p.transports.zenoh.link import ZenohLink
from r2p.transports.zenoh.sender import ZenohSubscriber
from r2p.transports.zenoh.session import ZenohSession
from r2p.transports.zenoh.subscribe import WINDOW
from tests.transports.test_conformance import first, other, until
from tests.transports.zenoh.cable import Net, ZenohCable, guarded, module, plain_session

pytestmark = pytest.mark.anyio

ORIGIN = Origin(r2p.PublisherClass.NON_REAL_TIME, 7, 7, layout(Led).fingerprint, "ALIEN", "node")
HEADER = Header(ORIGIN, 1, 1, 1_700_000_000_000_000_000)


@asynccontextmanager
async def nodes(net: Net, *names: str) -> AsyncIterator[list[r2p.Node]]:
    """One node in each module; the first module is the router."""
    async with AsyncExitStack() as stack:
        modules = [
            await stack.enter_async_context(module(name, net.join if number else net.listen))
            for number, name in enumerate(names)
        ]
        yield [await stack.enter_async_context(node_in(each)) for each in modules]


@asynccontextmanager
async def alien_on(net: Net) -> AsyncIterator[zenoh.Session]:
    with plain_session(net) as session:
        yield session


def link_of(node: r2p.Node) -> ZenohLink:
    link = node._space.links[0]
    assert isinstance(link, ZenohLink)
    return link


def knows(publisher: r2p.Publisher[Any], node: r2p.Node) -> bool:
    """Whether a publisher sends to a module."""
    return any(
        isinstance(subscriber, ZenohSubscriber) and subscriber.has_session(link_of(node).instance)
        for subscriber in publisher._topic.remote_subscribers
    )


async def waits_for_credit(publisher: r2p.Publisher[Any]) -> None:
    """Wait until a publisher waits for its subscriber, who does not read."""
    await until(lambda: publisher.sent > WINDOW // 2)
    stuck = -1
    while stuck != publisher.sent:
        stuck = publisher.sent
        await asyncio.sleep(0.05)


@guarded
async def test_a_slow_subscriber_slows_its_publisher_and_loses_nothing() -> None:
    total = 4 * WINDOW
    async with nodes(Net(), "A", "B") as (alice, bob):
        publisher = alice.advertise("numbers", r2p.msg.Float32, r2p.NonRealTime(stall=30.0))
        subscriber = bob.subscribe("numbers", r2p.msg.Float32)
        await publisher.wait_subscriber()

        async def send() -> None:
            for number in range(total):
                await publisher.publish(r2p.msg.Float32(float(number)))

        sending = asyncio.create_task(send())
        await waits_for_credit(publisher)
        assert publisher.sent <= WINDOW + 1 + subscriber._sink.limit
        for number in range(total):
            assert (await subscriber.fetch()).data == number
        await sending
        assert (publisher.missed, subscriber.lost) == (0, 0)
        assert not link_of(alice).losses + link_of(bob).losses


@guarded
async def test_what_waits_for_credit_when_the_link_goes_down_is_counted() -> None:
    async with (
        ZenohCable() as cable,
        r2p.Module("A", via=cable.a(), watchdog=False) as a,
        r2p.Module("B", via=cable.b(), watchdog=False) as b,
        node_in(a) as alice,
        node_in(b) as bob,
    ):
        publisher, link = bob.advertise("leds", Led, r2p.NonRealTime(stall=30.0)), link_of(bob)
        subscriber = alice.subscribe("leds", Led)
        await publisher.wait_subscriber()

        async def send() -> None:
            while link.up:
                await publisher.publish(Led())

        sending = asyncio.create_task(send())
        remote = publisher._topic.remote_subscribers[0]
        assert isinstance(remote, ZenohSubscriber)
        await until(lambda: len(subscriber.queue) == subscriber._sink.limit and not remote.unacknowledged())
        await waits_for_credit(publisher)
        await cable.cut()
        await sending
        assert link.losses["link down"] > 0
        assert link.stats.sent + link.losses["link down"] == publisher.sent
        acknowledged = link.stats.sent - link.losses["unknown at disconnect"]
        assert 0 < acknowledged <= subscriber._sink.limit  # the first, and more where their credits came in time
        assert subscriber.queue
        await cable.mend()


@guarded
async def test_who_hangs_is_left_behind_and_the_others_lose_nothing() -> None:
    total = 3 * WINDOW
    missed: list[r2p.Missed] = []
    async with nodes(Net(), "A", "HUNG", "WELL") as (alice, hung, well):
        publisher = alice.advertise("text", Text, r2p.NonRealTime(stall=0.2, on_missed=missed.append))
        stuck, fine = hung.subscribe("text", Text, queue=4), well.subscribe("text", Text)
        await publisher.wait_subscriber()
        await until(lambda: knows(publisher, hung) and knows(publisher, well))

        async def read() -> None:
            for number in range(total):
                assert (await fine.fetch()).text == f"{number}"

        reading = asyncio.create_task(read())
        for number in range(total):
            await publisher.publish(Text(f"{number}"))
        await reading
        assert (fine.lost, publisher.missed) == (0, 1)
        assert missed[0].reason == "no room for 0.2 s"

        async def read_up_to(text: str) -> None:
            while (await stuck.fetch()).text != text:
                pass

        waking = asyncio.create_task(read_up_to("latest"))
        async for _ in alice.every(0.005):  # it wakes: what has waited for it comes first
            if waking.done():
                break
            await publisher.publish(Text("latest"))
        await publisher.publish(Text("last"))  # it is waited for again
        await read_up_to("last")


@guarded
async def test_a_tool_that_watches_never_makes_a_publisher_wait() -> None:
    async with nodes(Net(), "A", "TOOL") as (alice, tool):
        publisher = alice.advertise("leds", Led, r2p.NonRealTime(stall=30.0))
        tool.subscribe("leds", Led, lossy=True)
        await publisher.wait_subscriber()
        for number in range(3 * WINDOW):  # would take 30 s if it waited once
            await publisher.publish(Led(number))
        assert publisher.missed == 0


@guarded
async def test_a_node_that_joins_a_tool_in_its_module_is_waited_for_from_then_on() -> None:
    async with nodes(Net(), "A", "B") as (alice, bob):
        publisher = alice.advertise("leds", Led, r2p.NonRealTime(stall=30.0))
        bob.subscribe("leds", Led, lossy=True)
        await publisher.wait_subscriber()
        for number in range(2 * WINDOW):
            await publisher.publish(Led(number))
        subscriber = bob.subscribe("leds", Led, queue=4 * WINDOW)
        await until(
            lambda: link_of(alice).sender.publishers.window("leds", r2p.PublisherClass.NON_REAL_TIME).limit != NO_LIMIT
        )
        for number in range(2 * WINDOW):  # would take 30 s if it waited for credit that is never sent
            await publisher.publish(Led(number))
        await until(lambda: len(subscriber.queue) >= 2 * WINDOW)
        assert publisher.missed == 0


@guarded
async def test_many_topics_at_once_lose_nothing() -> None:
    async with nodes(Net(), "A", "B") as (alice, bob):
        pairs = [
            (alice.advertise(f"t{n}", Led, r2p.NonRealTime(stall=20.0)), bob.subscribe(f"t{n}", Led)) for n in range(20)
        ]

        async def send(publisher: r2p.Publisher[Led]) -> None:
            await publisher.wait_subscriber()
            for number in range(500):
                await publisher.publish(Led(number))

        async def read(subscriber: r2p.Subscriber[Led]) -> None:
            for number in range(500):
                assert (await subscriber.fetch()).led == number

        async with asyncio.TaskGroup() as tasks:
            for publisher, subscriber in pairs:
                tasks.create_task(send(publisher))
                tasks.create_task(read(subscriber))
        assert not link_of(bob).losses


@guarded
async def test_all_three_classes_with_stamp_deadline_and_sequence() -> None:
    async with nodes(Net(), "A", "B") as (alice, bob):
        before = alice.now()
        alice.advertise("beat", Led, r2p.Periodic(0.005, lambda: Led(3)))
        event = alice.advertise("event", Led, r2p.Sporadic(deadline=2.0))
        beats, events = bob.subscribe("beat", Led).samples(), bob.subscribe("event", Led).samples()
        await event.wait_subscriber()
        await event.publish(Led(2))
        sample = await anext(events)
        assert sample.publisher_class == r2p.PublisherClass.SPORADIC
        assert sample.deadline - sample.stamp == 2_000_000_000
        assert before <= sample.stamp <= bob.now()
        assert (sample.stamped, sample.sequence, sample.hops, sample.source.module) == (True, 1, 0, "A")
        one, two = await anext(beats), await anext(beats)
        assert one.publisher_class == r2p.PublisherClass.PERIODIC
        assert two.sequence - one.sequence == 1


@guarded
async def test_a_latched_value_comes_once_to_each() -> None:
    async with nodes(Net(), "A", "B", "C") as (alice, bob, carol):
        publisher = alice.advertise("leds", Led, latch=True)
        await publisher.publish(Led(7))
        bobs = bob.subscribe("leds", Led)
        assert await bobs.fetch() == Led(7)
        carols = carol.subscribe("leds", Led)
        assert await carols.fetch() == Led(7)
        await publisher.publish(Led(8))
        assert (await bobs.fetch(), await carols.fetch()) == (Led(8), Led(8))
        assert not bobs.queue
        again = carol.subscribe("leds", Led)
        assert await again.fetch() == Led(8)


@guarded
async def test_a_subscriber_is_let_in_when_messages_reach_it() -> None:
    """Its token may come before its subscription."""
    net = Net()
    async with nodes(net, "A") as (alice,), alien_on(net) as alien:
        publisher = alice.advertise("leds", Led, latch=True)
        await publisher.publish(Led(1))
        told = liveliness.encode(TopicToken(7, ROLE_SUBSCRIBES, "leds", 7, "node", window=8))
        token = alien.liveliness().declare_token(f"r2p/lab/live/{told}")
        reach = link_of(alice).sender.reachability
        await until(lambda: ("leds", 7) in reach._pending and reach._pending["leds", 7].retries > 3)
        assert not publisher.subscribers
        heard = alien.declare_subscriber("r2p/lab/topic/leds", zenoh.handlers.FifoChannel(8))
        await publisher.wait_subscriber()
        arrived = await asyncio.to_thread(heard.recv)
        assert Led.decode(arrived.payload.to_bytes()) == Led(1)
        token.undeclare()


@guarded
async def test_who_is_not_let_in_is_forgotten_with_the_link() -> None:
    async with nodes(Net(), "A") as (alice,):
        alice.advertise("leds", Led)
        reach = link_of(alice).sender.reachability
        reach.add("leds", 7, 8)
        assert reach._pending
    assert not reach._pending


@guarded
async def test_networks_of_different_names_stay_apart() -> None:
    ours = Net("ours")
    theirs = Net("theirs")
    theirs.port = ours.port
    async with (
        module("A", ours.listen) as a,
        module("B", theirs.join) as b,
        module("C", ours.join) as c,
        node_in(a) as alice,
        node_in(b) as bob,
        node_in(c) as carol,
    ):
        publisher = alice.advertise("leds", Led)
        foreign, friend = bob.subscribe("leds", Led), carol.subscribe("leds", Led)
        await publisher.wait_subscriber()
        await publisher.publish(Led(1))
        assert await friend.fetch() == Led(1)
        assert not foreign.queue
        assert not other(b, "A")
        assert not other(a, "B")


@guarded
async def test_a_router_that_asks_who_is_there_is_not_stopped_by_many_answers() -> None:
    """They come in the call that asks, which must not wait until they are read."""
    async with nodes(net := Net(), "A") as (alice,), alien_on(net) as alien:
        live = alien.liveliness()
        tokens = [live.declare_token(f"r2p/full/live/1/{n:x}/module/M{n}/{n:x}/0/0") for n in range(1, 1001)]
        session = link_of(alice)._session
        assert session is not None
        found: set[str] = set()
        while "full" not in found:
            found = await session.find_networks(tools=False)
        assert found == {"lab", "full"}
        del tokens


@guarded
@pytest.mark.parametrize("asks", ["router", "client"])
async def test_refused_tokens_are_believed_when_there_is_room(monkeypatch: pytest.MonkeyPatch, asks: str) -> None:
    monkeypatch.setattr(liveliness_session, "TOKENS_MAX", 8)
    monkeypatch.setattr(liveliness_session, "_PAUSE_MIN", 1)
    async with nodes(net := Net(), "A", "B") as (alice, bob), alien_on(net) as alien:
        link, live = link_of(alice if asks == "router" else bob), alien.liveliness()
        tokens = [live.declare_token(f"r2p/lab/live/*/1/{n:x}/module/M{n}/{n:x}/0/0") for n in range(1, 13)]
        await until(lambda: link.losses["too many tokens"] >= 5)
        for token in tokens[:8]:
            token.undeclare()
        await until(lambda: {f"M{n}" for n in range(9, 13)} <= set(link.discovery.modules))
        await until(lambda: not {f"M{n}" for n in range(1, 9)} & set(link.discovery.modules))


@guarded
async def test_what_cannot_be_the_name_of_a_network_is_none() -> None:
    async with nodes(net := Net(), "A") as (alice,), alien_on(net) as alien:
        live = alien.liveliness()
        tokens = [
            live.declare_token(f"r2p/{name}/live/1/a1/module/EVIL/a1/0/0") for name in ("\x1b]0;hi\x07", "a b", "other")
        ]
        session = link_of(alice)._session
        assert session is not None
        found: set[str] = set()
        while "other" not in found:
            found = await session.find_networks(tools=False)
        assert found == {"lab", "other"}
        del tokens


@guarded
async def test_the_last_words_of_a_module_arrive() -> None:
    net = Net()
    async with module("A", net.listen) as a, node_in(a) as alice:
        subscriber = alice.subscribe("leds", Led, queue=200)
        async with module("B", net.join) as b, node_in(b) as bob:
            publisher = bob.advertise("leds", Led)
            await publisher.wait_subscriber()
            for number in range(100):
                await publisher.publish(Led(number))
        assert [(await subscriber.fetch()).led for _ in range(100)] == list(range(100))


@guarded
async def test_modules_share_no_wildcard_of_which_zenoh_would_keep_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """A router keeps 3 kB of each session that is closed, had a wildcard, and shared it with another session."""
    keys: Counter[str] = Counter()

    def recorded(declare: Callable[..., Any]) -> Callable[..., Any]:
        def declared(session: ZenohSession, key: str, *args: Any, **options: Any) -> Any:
            keys[key] += 1
            return declare(session, key, *args, **options)

        return declared

    for name in ("listen", "answer_queries", "subscribe"):
        monkeypatch.setattr(ZenohSession, name, recorded(getattr(ZenohSession, name)))
    net = Net()
    async with nodes(net, "A", "B") as (alice, bob):
        alice.subscribe("leds", Led)
        bob.subscribe("leds", Led)
        await until(lambda: keys["r2p/lab/topic/leds"] == 2)
    assert keys["r2p/lab/control"] == 2
    assert [key for key, count in keys.items() if "*" in key and count > 1] == []


@guarded
async def test_garbage_and_foreign_keys_are_counted_and_do_no_harm() -> None:
    net = Net()
    async with nodes(net, "A", "B") as (alice, bob), alien_on(net) as alien:
        publisher, subscriber = alice.advertise("leds", Led), bob.subscribe("leds", Led)
        await publisher.wait_subscriber()
        answers, _ = bob.advertise("answers", Led), alice.subscribe("answers", Led)
        await answers.wait_subscriber()  # so bob reads credit
        live = alien.liveliness()
        tokens = [
            live.declare_token(f"r2p/lab/live/{key}") for key in ("x", "1/zz/module/A/1/0/0", "9/1/module/A/1/0/0")
        ]
        good, huge = attachment.encode(HEADER), b"\xff" * 1_000_000
        three = attachment.encode(msgspec.structs.replace(HEADER, more=(1, 2)))
        for key, payload, header, counted in (
            ("topic/leds", huge, None, "unknown type"),
            ("topic/leds", huge, good, "wrong size"),
            ("topic/leds", b"four", good, "wrong size"),
            ("topic/leds", b"", good, "wrong size"),
            ("topic/leds", bytes(5), b"\x09" + good, "unknown type"),
            ("topic/leds", bytes(5), good[:-3] + b"///", "undecodable"),
            ("topic/leds", bytes(16), three, "undecodable"),
            ("topic/leds", b"", three, "undecodable"),
            ("topic/leds", bytes(3), three, "wrong size"),
            ("control", bytes(32), None, "foreign"),
            ("control", bytes(32), huge, "foreign"),
            ("control", bytes(32), b"\1\7\0\0", "foreign"),
            ("control", bytes(32), b"\2\7\0\0\0", "unknown type"),
            ("control", bytes(33), attachment.encode_sender(7), "undecodable"),
            ("control", huge, attachment.encode_sender(7), "undecodable"),
            (f"credit/{link_of(bob).instance:x}", b"\1\1junk", None, "undecodable"),
            (f"credit/{link_of(bob).instance:x}", huge, None, "undecodable"),
        ):
            await put_until_counted(link_of(bob), counted, alien, f"r2p/lab/{key}", payload, header)
        for key in ("topic/unknown", "whatever/else"):
            await put(alien, f"r2p/lab/{key}", huge, good)
        assert set(link_of(bob).losses) == {"wrong size", "unknown type", "foreign", "undecodable"}
        await put(alien, "r2p/lab/topic/leds", layout(Led).encode(Led(9)), good)
        assert await subscriber.fetch() == Led(9)  # it could be an r2p module, as far as can be seen here
        await publisher.publish(Led(1))
        assert await subscriber.fetch() == Led(1)
        assert not subscriber.queue
        del tokens


async def put_until_counted(link: ZenohLink, reason: str, alien: zenoh.Session, *message: Any) -> None:
    """zenoh may lose it on a slow computer."""
    before = link.losses[reason]
    while link.losses[reason] == before:
        await put(alien, *message)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(1.0):
                await until(lambda: link.losses[reason] > before)


async def put(alien: zenoh.Session, key: str, payload: bytes, header: bytes | None) -> None:
    """In a thread: it waits for room in zenoh's queue, and its receivers may need this loop for that."""
    block = zenoh.CongestionControl.BLOCK
    await asyncio.to_thread(alien.put, key, payload, attachment=header, congestion_control=block)


@guarded
async def test_what_is_lost_on_the_way_is_counted() -> None:
    net = Net()
    async with nodes(net, "A") as (alice,), alien_on(net) as alien:
        subscriber = alice.subscribe("leds", Led)
        for serial in (1, 2, 5, 6, 16):
            header = Header(HEADER.origin, serial, serial, HEADER.stamp)
            alien.put("r2p/lab/topic/leds", Led(serial).encode(), attachment=attachment.encode(header))
        for serial in (1, 2, 5, 6, 16):
            assert (await subscriber.fetch()).led == serial
        assert link_of(alice).losses["on the way"] == 11


@guarded
async def test_what_comes_by_two_links_comes_once() -> None:
    net = Net()
    both = r2p.Module("B", via=[net.join, net.join.replace("127.0.0.1", "localhost")], watchdog=False)
    async with module("A", net.listen) as a, both as b, node_in(a) as alice, node_in(b) as bob:
        publisher = alice.advertise("leds", Led)
        subscriber = bob.subscribe("leds", Led, queue=2 * WINDOW)

        def dropped() -> int:
            return sum(link.losses["seen before"] for link in b.links)

        await publisher.wait_subscriber()
        links = [link for link in b.links if isinstance(link, ZenohLink)]
        await until(lambda: all("leds" in link.receiver._streams for link in links))  # the second one listened first
        while not dropped():  # one by one: a link that joins late would hide what the other brings
            await publisher.publish(Led())
            await subscriber.fetch()
        for number in range(2 * WINDOW):  # further than it would get if what is dropped earned no credit
            await publisher.publish(Led(number))
        await until(lambda: len(subscriber.queue) == 2 * WINDOW and dropped() >= 2 * WINDOW)
        assert [Led.decode(sample.data).led for sample in subscriber.queue] == list(range(2 * WINDOW))
        assert not {"on the way", "repeated"} & {reason for link in b.links for reason in link.losses}


@guarded
async def test_what_two_gateways_send_comes_once() -> None:
    """They never should; but a message that names its publisher and class is recognised."""
    net = Net()
    async with nodes(net, "A") as (alice,), alien_on(net) as alien:
        subscriber = alice.subscribe("leds", Led)

        def put(sender: int, serial: int, sequence: int, stamp: int) -> None:
            origin = msgspec.structs.replace(HEADER.origin, sender=sender)
            header = Header(origin, serial, sequence, stamp, hops=1)
            alien.put("r2p/lab/topic/leds", Led(sequence).encode(), attachment=attachment.encode(header))

        put(1, 1, 1, 10)
        put(1, 2, 2, 20)
        put(2, 1, 2, 20)  # the other one is slower
        put(2, 2, 3, 30)
        put(1, 3, 3, 30)
        put(1, 4, 1, 40)  # the publisher was restarted, and counts anew
        put(2, 3, 4, 40)
        for expected in (1, 2, 3, 1, 4):
            assert (await subscriber.fetch()).led == expected
        assert link_of(alice).losses == {"seen before": 2}


@guarded
async def test_packets_of_two_gateways_may_overlap() -> None:
    net = Net()
    async with nodes(net, "A") as (alice,), alien_on(net) as alien:
        subscriber = alice.subscribe("leds", Led)

        def put(sender: int, serial: int, *sequences: int) -> None:
            origin = msgspec.structs.replace(HEADER.origin, sender=sender)
            first, *others = sequences
            header = Header(origin, serial, first, 10 * first, hops=1, more=tuple([10 * each for each in others]))
            payload = b"".join([Led(each).encode() for each in sequences])
            alien.put("r2p/lab/topic/leds", payload, attachment=attachment.encode(header))

        put(1, 1, 1, 2, 3)
        put(2, 1, 2, 3, 4, 5)
        put(1, 4, 4)
        put(1, 7, 7, 8)
        samples = subscriber.samples()
        came = [await anext(samples) for _ in range(7)]
        assert [(Led.decode(each.data).led, each.sequence, each.stamp) for each in came] == [
            (each, each, 10 * each) for each in (1, 2, 3, 4, 5, 7, 8)
        ]
        assert link_of(alice).losses == {"seen before": 3, "on the way": 2}
        assert (link_of(alice).stats.received, link_of(alice).stats.bytes_received) == (7, 7 * len(Led(1).encode()))


@guarded
async def test_a_packet_that_has_no_room_in_the_middle_stays_whole_and_in_order() -> None:
    net = Net()
    async with nodes(net, "A", "B") as (alice, bob):
        publisher = alice.advertise("leds", Led)
        small, large = bob.subscribe("leds", Led, queue=3), bob.subscribe("leds", Led, queue=1000)
        await publisher.wait_subscriber()
        for number in range(500):
            await publisher.publish(Led(number))
        for subscriber in (small, large):
            assert [(await subscriber.fetch()).led for _ in range(500)] == list(range(500))
            assert not subscriber.lost


@guarded
async def test_when_a_publisher_leaves_the_others_are_still_known() -> None:
    net = Net()
    async with nodes(net, "A") as (alice,), alien_on(net) as alien:
        subscriber = alice.subscribe("leds", Led)
        live, size = alien.liveliness(), layout(Led).size
        tokens = [
            live.declare_token(
                f"r2p/lab/live/{liveliness.encode(TopicToken(each, ROLE_PUBLISHES, 'leds', each, 'node', size=size))}"
            )
            for each in (7, 8)
        ]
        await until(lambda: subscriber.publishers == 2)

        def put(sender: int, serial: int, sequence: int) -> None:
            origin = msgspec.structs.replace(HEADER.origin, sender=sender, instance=sender)
            header = attachment.encode(Header(origin, serial, sequence, sequence * 10))
            alien.put("r2p/lab/topic/leds", Led(sequence).encode(), attachment=header)

        put(8, 1, 1)
        assert (await subscriber.fetch()).led == 1
        tokens[0].undeclare()
        await until(lambda: subscriber.publishers == 1)
        put(8, 2, 1)  # again, as one does who has not heard that it came
        put(8, 3, 2)
        assert (await subscriber.fetch()).led == 2
        tokens[1].undeclare()


@guarded
async def test_a_type_whose_code_is_elsewhere_is_asked_for() -> None:
    class Wheel(r2p.Message):
        """No other module has it."""

        speed: r2p.f32 = 0.0
        currents: tuple[r2p.f32, r2p.f32] = (0.0, 0.0)

    net = Net()
    async with module("A", net.listen) as a, node_in(a) as alice, module("B", net.join) as b:
        alice.advertise("wheel", Wheel)
        network = b.network
        await until(lambda: "wheel" in network.topics())
        fingerprint = network.topics()["wheel"].fingerprint
        assert fingerprint is not None
        found: Any = await network.message_type(fingerprint)
        assert found.__name__ == "Wheel"
        assert layout(found).schema == layout(Wheel).schema
        assert found.decode(Wheel(2.0, (1.0, 0.5)).encode()).currents == (1.0, 0.5)
        assert await network.message_type(b"nobody__") is None


@guarded
async def test_a_schema_that_lies_is_refused() -> None:
    net = Net()
    async with module("A", net.listen) as a, alien_on(net) as alien:
        fingerprint = layout(Led).fingerprint
        lies = [b"Led\nled:u32 value:u16", b"\xff" * 1000, b"class\n" + layout(Led).schema.encode()]

        def answer(query: zenoh.Query) -> None:
            for number, lie in enumerate(lies):
                query.reply(f"r2p/lab/schema/{number}/{fingerprint.hex()}", lie)

        queryable = alien.declare_queryable("r2p/lab/schema/*/*", answer)
        while not a.links[0].losses["wrong schema"]:  # until the query reaches it
            assert await a.network.message_type(fingerprint) is None
        assert a.links[0].losses["wrong schema"] == len(lies)
        del queryable


@guarded
async def test_a_clock_that_jumps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stamps never go back, and nothing waits for a clock."""
    async with nodes(Net(), "A", "B") as (alice, bob):
        publisher, subscriber = alice.advertise("leds", Led), bob.subscribe("leds", Led)
        await publisher.wait_subscriber()
        stamps = []
        clock = alice._space.clock
        assert isinstance(clock, SystemClock)
        for state in ("_last", "_slowed", "_anchor"):  # the computer's only one: as it was, afterwards
            monkeypatch.setattr(clock, state, getattr(clock, state))
        for jump in (0, -3600, 0, 7200, -10):
            utc = clock._utc
            monkeypatch.setattr(clock, "_utc", lambda utc=utc, jump=jump: utc() + jump * 1_000_000_000)
            await publisher.publish(Led(1))
            async for sample in subscriber.samples():
                stamps.append(sample.stamp)
                break
        assert stamps == sorted(stamps)


@guarded
async def test_it_says_where_it_listens() -> None:
    a = r2p.Module("A", via="zenoh:?mode=peer&listen=tcp/127.0.0.1:0&scouting=off&network=lab", watchdog=False)
    events = a.events()
    async with a:
        address = (await first(events, r2p.Listening)).address
        assert address.startswith("tcp/127.0.0.1:")
        async with module("B", f"zenoh:{address}?scouting=off&network=lab") as b:
            await until(lambda: other(a, "B") and other(b, "A"))


@guarded
async def test_an_address_that_is_taken_is_an_error() -> None:
    net = Net()
    async with module("A", net.listen):
        with pytest.raises(r2p.TransportError, match="the port is in use"):
            async with module("B", net.listen):
                pass


class Picture(r2p.Message):
    data: Annotated[bytes, r2p.Max(64_000_000)] = b""


@pytest.mark.parametrize("shm", ["on", "off"])
@guarded
async def test_messages_of_any_length_keep_their_order_and_none_is_lost(shm: str) -> None:
    """From the loop and from the thread, with and without fragments, and in packets of several."""
    net = Net()
    sizes = [0, 100, 3_000_000, 0, 20_000, 17, 5_000_000, 16_000, 16_000, 100_000, 1]
    async with (
        module("A", f"{net.listen}&shm={shm}") as a,
        module("B", f"{net.join}&shm={shm}") as b,
        node_in(a) as alice,
        node_in(b) as bob,
    ):
        for sender, receiver in ((alice, bob), (bob, alice)):
            topic = f"images{sender.module}"
            publisher = sender.advertise(topic, Picture, r2p.NonRealTime(stall=20.0))
            subscriber = receiver.subscribe(topic, Picture, queue=2)
            leds = f"leds{sender.module}"
            other_publisher, other = sender.advertise(leds, Led), receiver.subscribe(leds, Led)
            await publisher.wait_subscriber()
            await other_publisher.wait_subscriber()

            async def publish(publisher: r2p.Publisher[Picture] = publisher) -> None:
                for number, size in enumerate(2 * sizes):
                    await publisher.publish(Picture(bytes([number]) * size))

            publishing = asyncio.create_task(publish())
            for number, size in enumerate(2 * sizes):
                assert (await subscriber.fetch()).data == bytes([number]) * size
            await publishing
            await other_publisher.publish(Led(1))
            assert await other.fetch() == Led(1)
            guarantees = publisher.guarantees[sender._space.links[0].name]
            assert guarantees == "in order, waits for room in every subscriber; zenoh priority data low"
        assert not link_of(alice).losses + link_of(bob).losses


@guarded
async def test_a_periodic_and_a_sporadic_message_may_be_large() -> None:
    async with nodes(Net(), "A", "B") as (alice, bob):
        events, states = bob.subscribe("events", Picture), bob.subscribe("states", Picture)
        event = alice.advertise("events", Picture, r2p.Sporadic(deadline=10.0))
        state = alice.advertise("states", Picture, r2p.Periodic(0.05, lambda: Picture(bytes(200_000))))
        for publisher in (event, state):
            await publisher.wait_subscriber()
        await event.publish(Picture(bytes(2_000_000)))
        assert len((await events.fetch()).data) == 2_000_000
        assert len((await states.fetch()).data) == 200_000


@guarded
async def test_a_tool_finds_the_only_network() -> None:
    net = Net("robot1")
    tool = r2p.Module("_tool", via=f"zenoh:tcp/127.0.0.1:{net.port}?scouting=off", observer=True, watchdog=False)
    async with module("A", net.listen), tool:
        await until(lambda: other(tool, "A"))
