"""What holds on every transport: each test here runs over all of them."""

import asyncio
import contextlib
import functools
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from itertools import count
from typing import Annotated, TypeVar

import pytest

import r2p
import r2p.msg
from r2p.codecs.management import ROLE_PUBLISHES
from r2p.messages import Message
from r2p.modules.graph import ModuleView
from r2p.msg import PWM2, Led, Speed3, Text
from r2p.protocols.discovery.events import Mismatched, ModuleGone, NameConflict
from r2p.runtime.events import ModuleEvent
from r2p.testing.network import node_in
from r2p.transports.line import LineLink
from tests.services.common import Add, Desk, Names, add
from tests.transports.cables import GUARD, Cable, SimCable, conforms, conforms_lines
from tests.transports.exchange import EVERY, filled

E = TypeVar("E")


async def until(condition: Callable[[], object]) -> None:
    """Wait for what no event tells. On a real loop it looks again each millisecond."""
    while not condition():  # noqa: ASYNC110 - there is no event
        await asyncio.sleep(0.001)


async def first(events: AsyncIterator[ModuleEvent], kind: type[E]) -> E:
    """The next event of a kind."""
    async for event in events:
        if isinstance(event, kind):
            return event
    raise AssertionError("the module is closed")


def other(module: r2p.Module, name: str) -> ModuleView | None:
    """Another module whose HELLO this one has heard; by an ALIVE alone it may be firmware."""
    return next((view for view in module.network.modules() if view.name == name and view.link and view.instance), None)


async def acquainted(a: r2p.Module, b: r2p.Module) -> None:
    """Wait until each has heard the other's HELLO: what came before may look like firmware."""
    await until(lambda: other(a, b.name) and other(b, a.name))


def module(name: str, via: object) -> r2p.Module:
    return r2p.Module(name, via=via, watchdog=False)  # type: ignore[arg-type]  # a Transport


@asynccontextmanager
async def two(cable: Cable) -> AsyncIterator[tuple[r2p.Module, r2p.Module]]:
    async with module("A", cable.a()) as a, module("B", cable.b()) as b:
        yield a, b


@asynccontextmanager
async def two_nodes(cable: Cable) -> AsyncIterator[tuple[r2p.Node, r2p.Node]]:
    """A node in module A, and one in module B."""
    async with two(cable) as (a, b), node_in(a) as alice, node_in(b) as bob:
        yield alice, bob


@conforms
async def test_every_message_type_both_ways(cable: Cable) -> None:
    async with two_nodes(cable) as (alice, bob):
        ways = [(way, cls) for cls in EVERY for way in ((alice, bob), (bob, alice))]
        pairs = [
            (cls, sender.advertise(f"t{number}", cls), receiver.subscribe(f"t{number}", cls))
            for number, ((sender, receiver), cls) in enumerate(ways)
        ]
        for cls, publisher, subscriber in pairs:
            await publisher.wait_subscriber()
            await subscriber.wait_publisher()
            message = filled(cls)
            await publisher.publish(message)
            assert await subscriber.fetch() == message


@conforms
async def test_the_handshake_in_either_order(cable: Cable) -> None:
    async with two_nodes(cable) as (alice, bob):
        late_publisher = bob.subscribe("one", Led)
        late_subscriber = alice.advertise("two", Led, latch=True)
        await late_subscriber.publish(Led(led=2))
        await asyncio.sleep(0)
        two = bob.subscribe("two", Led)
        one = alice.advertise("one", Led)
        await one.wait_subscriber()
        await one.publish(Led(led=1))
        assert (await late_publisher.fetch(), await two.fetch()) == (Led(led=1), Led(led=2))


@conforms
async def test_the_handshake_when_both_were_there_before_the_link(cable: Cable) -> None:
    await cable.cut()
    async with two_nodes(cable) as (alice, bob):
        publisher, subscriber = alice.advertise("leds", Led), bob.subscribe("leds", Led)
        await cable.mend()
        await publisher.wait_subscriber()
        await publisher.publish(Led(led=1))
        assert await subscriber.fetch() == Led(led=1)


class Gripper(r2p.Message, name="lab_msgs/Gripper"):
    """A type that only one module has; its schema takes several pages."""

    at: r2p.Timestamp
    finger_positions: tuple[r2p.f32, r2p.f32, r2p.f32]
    finger_temperatures: tuple[r2p.f32, r2p.f32, r2p.f32]
    supply_voltage_of_the_motors: r2p.f32 = 0.0
    supply_current_of_the_motors: r2p.f32 = 0.0
    holds_an_object_between_its_fingers: bool = False
    last_error_of_the_motor_controller: r2p.u16 = 0


@conforms
async def test_a_type_whose_code_is_elsewhere(cable: Cable) -> None:
    wanted = r2p.layout(Gripper)
    async with two(cable) as (a, b), node_in(a) as alice:
        alice.advertise("gripper", Gripper)
        topics = b.network.topics
        await until(lambda: "gripper" in topics() and topics()["gripper"].fingerprint and other(b, "A"))
        found = None
        while found is None:  # A may not have announced its version yet
            found = await b.network.message_type(wanted.fingerprint)
        assert (r2p.layout(found).schema, r2p.layout(found).name) == (wanted.schema, "lab_msgs/Gripper")
        assert [each.stats.received for each in (*a.links, *b.links)] == [0, 0]


@conforms
async def test_calls_both_ways_their_errors_and_their_end(cable: Cable) -> None:
    desk = Desk()

    async def fail(_request: Add.Request) -> Add.Response:
        raise r2p.ServiceError("no sensor")

    async with two_nodes(cable) as (alice, bob):
        for server, client in ((alice, bob), (bob, alice)):
            name = "add" if server is alice else "front_left/wheel/" + "a" * 238
            server.serve(name, Add, add)
            calls = client.client(name, Add)
            await calls.ready()
            answers = await asyncio.gather(*(calls.call(Add.Request(a=n), timeout=GUARD) for n in range(20)))
            assert [each.total for each in answers] == list(range(20))
        alice.serve("fail", Add, fail)
        alice.serve("wait", Add, desk.handle)
        with pytest.raises(r2p.ServiceError, match=r"service fail of A: no sensor"):
            await bob.client("fail", Add).call(Add.Request(), timeout=GUARD)
        call = asyncio.create_task(bob.client("wait", Add).call(Add.Request(a=1), timeout=GUARD))
        await until(lambda: desk.begun)
        call.cancel()
        await until(lambda: desk.cancelled)
        assert desk.begun == [1]


@conforms
async def test_calls_whose_length_varies(cable: Cable) -> None:
    """A request without fields, responses from nothing to 200 bytes, and an error whose text is as long."""

    async def names(_request: Names.Request) -> Names.Response:
        if len(known) > 4:
            raise r2p.ServiceError("too many " + "names " * 50)
        return Names.Response(names=tuple(known))

    known: list[str] = []
    async with two_nodes(cable) as (alice, bob):
        alice.serve("names", Names, names)
        calls = bob.client("names", Names)
        await calls.ready()
        while len(known) <= 4:
            assert await calls.call(Names.Request(), timeout=GUARD) == Names.Response(names=tuple(known))
            known.append("x" * 7 * len(known))
        with pytest.raises(r2p.ServiceError, match=r"^service names of A: too many names .{150,}names\.\.\.$|too many"):
            await calls.call(Names.Request(), timeout=GUARD)


@conforms
async def test_a_call_goes_on_after_a_reconnect(cable: Cable) -> None:
    async with two(cable) as (a, b), node_in(a) as alice, node_in(b) as bob:
        alice.serve("add", Add, add)
        calls = bob.client("add", Add)
        await calls.ready()
        await acquainted(a, b)
        await cable.cut()
        await until(lambda: not calls.servers)
        call = asyncio.create_task(calls.ready())
        await cable.mend()
        await call
        assert await calls.call(Add.Request(a=5), timeout=GUARD, server="A") == Add.Response(total=5)


@conforms
async def test_nothing_is_sent_without_a_subscriber(cable: Cable) -> None:
    async with two(cable) as (a, b), node_in(a) as alice, node_in(b) as bob:
        silent, heard = alice.advertise("silent", Led), alice.advertise("heard", Led)
        subscriber = bob.subscribe("heard", Led)
        for _ in range(100):
            await silent.publish(Led())
        await heard.wait_subscriber()
        await heard.publish(Led())
        await subscriber.fetch()
        assert a.links[0].stats.sent == 1
        assert b.links[0].stats.received == 1


@conforms
async def test_a_latched_value_comes_late_and_after_a_reconnect(cable: Cable) -> None:
    await latches(cable, r2p.NonRealTime())


@conforms
async def test_so_does_a_latched_event(cable: Cable) -> None:
    await latches(cable, r2p.Sporadic(deadline=10.0))


async def latches(cable: Cable, publisher_class: r2p.NonRealTime | r2p.Sporadic) -> None:
    async with two(cable) as (a, b), node_in(a) as alice, node_in(b) as bob:
        publisher = alice.advertise("leds", Led, publisher_class, latch=True)
        await publisher.publish(Led(led=7))
        subscriber = bob.subscribe("leds", Led)
        assert await subscriber.fetch() == Led(led=7)
        await acquainted(a, b)
        await cable.cut()
        await until(lambda: not publisher.subscribers)
        await cable.mend()
        assert await subscriber.fetch() == Led(led=7)


@conforms
async def test_topics_flow_again_after_a_reconnect(cable: Cable) -> None:
    async with two(cable) as (a, b), node_in(a) as alice, node_in(b) as bob:
        events = b.events()
        there, back = alice.advertise("there", Led), bob.advertise("back", Led)
        there_sub, back_sub = bob.subscribe("there", Led), alice.subscribe("back", Led)
        for turn in range(3):
            for publisher, subscriber in ((there, there_sub), (back, back_sub)):
                await publisher.wait_subscriber()
                await publisher.publish(Led(led=turn))
                assert await subscriber.fetch() == Led(led=turn)
            await acquainted(a, b)
            await cable.cut()
            await first(events, r2p.LinkDown)
            await until(lambda: not there.subscribers + back.subscribers)
            await cable.mend()
            await first(events, r2p.LinkUp)
        assert b.links[0].stats.ups >= 4


@conforms
async def test_a_peer_that_goes_and_comes_back(cable: Cable) -> None:
    async with module("A", cable.a()) as a, node_in(a) as alice:
        publisher = alice.advertise("leds", Led)
        for turn in range(3):
            async with module("B", cable.b()) as b, node_in(b) as bob:
                subscriber = bob.subscribe("leds", Led)
                await publisher.wait_subscriber()
                await publisher.publish(Led(led=turn))
                assert await subscriber.fetch() == Led(led=turn)
                await acquainted(a, b)
            await until(lambda: not publisher.subscribers and not other(a, "B"))


@conforms
async def test_a_module_that_closes_says_good_bye(cable: Cable) -> None:
    async with module("B", cable.b()) as b:
        events = b.events()
        async with module("A", cable.a()) as a, node_in(a) as alice:
            alice.advertise("leds", Led)
            await until(lambda: "leds" in b.network.topics() and other(b, "A"))
        gone = await first(events, ModuleGone)
        assert gone.info.name == "A"
        assert other(b, "A") is None


@conforms
async def test_unsubscribing_stops_the_flow(cable: Cable) -> None:
    async with two(cable) as (a, b), node_in(a) as alice, node_in(b) as bob:
        publisher = alice.advertise("leds", Led)
        subscriber = bob.subscribe("leds", Led)
        await publisher.wait_subscriber()
        await acquainted(a, b)
        subscriber.close()
        await until(lambda: not publisher.subscribers)
        sent = a.links[0].stats.sent
        await publisher.publish(Led())
        assert a.links[0].stats.sent == sent


@conforms
async def test_counters(cable: Cable) -> None:
    async with two(cable) as (a, b), node_in(a) as alice, node_in(b) as bob:
        publisher, subscriber = alice.advertise("leds", Led), bob.subscribe("leds", Led)
        await publisher.wait_subscriber()
        for number in range(100):
            await publisher.publish(Led(led=number))
            await subscriber.fetch()
        out, back = a.links[0], b.links[0]
        assert (out.stats.sent, back.stats.received, subscriber.lost) == (100, 100, 0)
        assert out.stats.bytes_sent >= back.stats.bytes_received >= 100 * 5
        assert not out.losses
        assert not back.losses


@conforms
async def test_the_source_of_a_sample(cable: Cable) -> None:
    """On a line it is worked out from what was heard: so the first samples may know less."""
    async with two(cable) as (a, b), node_in(a, name="blinker") as blinker, node_in(b) as bob:
        publisher, subscriber = blinker.advertise("leds", Led), bob.subscribe("leds", Led)
        await publisher.wait_subscriber()
        samples, source = subscriber.samples(), r2p.Source()
        while not source.node:
            await publisher.publish(Led())
            source = (await anext(samples)).source
        assert source == r2p.Source("A", "blinker", b.links[0].name)


def _knows(module: r2p.Module, nodes: set[tuple[str, str]]) -> bool:
    """Whether a module knows these nodes by their names, and no other ones but those that log."""
    found = {each for each in module.network.nodes() if each[1] != "log"}
    assert found <= nodes | {("", name) for _, name in nodes}
    return found == nodes


@conforms
async def test_names_that_are_too_long_for_firmware(cable: Cable) -> None:
    """Of topics, nodes and modules, with the same first characters: all of them arrive whole, and are told apart."""
    names = [f"front_left/wheel/{each}" for each in ("velocity", "current", "x" * 238)]
    left, right = "front_left_wheel_controller", "front_right_wheel_controller"
    async with (
        module(left, cable.a()) as a,
        module(right, cable.b()) as b,
        node_in(a, name="velocity_estimator") as alice,
        node_in(b, name="velocity_" + "e" * 55) as bob,
    ):
        publishers = [alice.advertise(name, Led) for name in names]
        subscribers = [bob.subscribe(name, Led) for name in names]
        for number, publisher in enumerate(publishers):
            await publisher.wait_subscriber()
            await publisher.publish(Led(led=number))
        assert [await subscriber.fetch() for subscriber in subscribers] == [Led(led=each) for each in range(3)]
        for here in (a, b):
            await until(functools.partial(_knows, here, {(left, alice.name), (right, bob.name)}))
            assert here.network.topics().keys() == {*names, "log"}
        samples = subscribers[0].samples()
        await publishers[0].publish(Led())
        assert (await anext(samples)).source == r2p.Source(left, "velocity_estimator", b.links[0].name)
        b.command(r2p.Command.STOP, left)
        await until(lambda: a.stopped)
        await until(lambda: (view := other(b, left)) and view.state == "stopped")


@conforms
async def test_another_size_is_refused_and_both_ends_report_it(cable: Cable) -> None:
    await _mismatch(cable, PWM2, Speed3)


@conforms
async def test_another_layout_of_the_same_size_is_refused_and_both_ends_report_it(cable: Cable) -> None:
    await _mismatch(cable, PWM2, r2p.msg.Float32)


async def _mismatch(cable: Cable, ours: type[Message], theirs: type[Message]) -> None:
    async with two(cable) as (a, b), node_in(a) as alice, node_in(b) as bob:
        told = a.events(), b.events()
        publisher, subscriber = alice.advertise("topic", ours), bob.subscribe("topic", theirs)
        for events in told:
            assert (await first(events, Mismatched)).topic == "topic"
        right = bob.subscribe("right", Led)
        leds = alice.advertise("right", Led)
        await leds.wait_subscriber()
        await publisher.publish(ours())
        await leds.publish(Led(led=1))
        assert await right.fetch() == Led(led=1)
        assert not subscriber.queue
        assert not publisher.subscribers


class Note(r2p.Message):
    """A text that fits the shortest link, and one that fits none but memory and zenoh."""

    text: Annotated[str, r2p.Max(240)] = ""
    ranges: Annotated[r2p.Array[r2p.f32], r2p.Max(1000)] = r2p.Array(())


class Go(r2p.Message):
    """An empty message."""


@conforms
async def test_messages_of_every_length_both_ways(cable: Cable) -> None:
    """From the shortest to the longest that fits, and so on; each arrives as it was sent, in its place."""
    sizes = [0, 1, 2, 3, 4, 5, 11, 12, 13, 60, 61, 200, 239, 240]
    async with two_nodes(cable) as (alice, bob):
        for sender, receiver in ((alice, bob), (bob, alice)):
            topic = f"{sender.module}notes"
            publisher = sender.advertise(topic, Note, latch=True)
            await publisher.publish(Note(text="latched"))
            subscriber = receiver.subscribe(topic, Note, queue=99)
            assert (await subscriber.fetch()).text == "latched"
            for size in sizes:
                await publisher.publish(Note(text="x" * size))
            assert [len((await subscriber.fetch()).text) for _ in sizes] == sizes
            assert (subscriber.lost, subscriber.undecodable, subscriber.too_long) == (0, 0, 0)


@conforms
async def test_empty_messages(cable: Cable) -> None:
    async with two_nodes(cable) as (alice, bob):
        publisher, subscriber = alice.advertise("go", Go), bob.subscribe("go", Go, queue=99)
        await publisher.wait_subscriber()
        await subscriber.wait_publisher()
        for _ in range(3):
            await publisher.publish(Go())
        assert [await subscriber.fetch() for _ in range(3)] == [Go()] * 3


@conforms
async def test_what_is_too_long_for_the_link_is_counted_and_reported_and_the_others_pass(cable: Cable) -> None:
    missed: list[r2p.Missed] = []
    async with two(cable) as (a, b), node_in(a) as alice, node_in(b) as bob:
        publisher = alice.advertise("notes", Note, r2p.NonRealTime(on_missed=missed.append))
        subscriber = bob.subscribe("notes", Note)
        await publisher.wait_subscriber()
        await subscriber.wait_publisher()
        long = Note(ranges=r2p.Array(range(1000)))
        await publisher.publish(long)
        await publisher.publish(Note(text="short"))
        first = await subscriber.fetch()
        if a.links[0].longest(varies=True) > publisher.size:
            assert first == long
            first = await subscriber.fetch()
        else:
            assert (a.links[0].losses, publisher.missed) == ({"too long": 1}, 1)
            assert missed == [r2p.Missed("notes", "too long", where=a.links[0].name)]
        assert first == Note(text="short")


@conforms
async def test_the_bound_of_the_receiver(cable: Cable) -> None:
    """It is no part of the type: what exceeds it is counted."""

    class Long(r2p.Message):
        text: Annotated[str, r2p.Max(64)] = ""

    class Short(r2p.Message):
        text: Annotated[str, r2p.Max(8)] = ""

    async with two_nodes(cable) as (alice, bob):
        publisher, subscriber = alice.advertise("words", Long), bob.subscribe("words", Short)
        await publisher.wait_subscriber()
        await subscriber.wait_publisher()
        for text in ("12345678", "123456789", "1"):
            await publisher.publish(Long(text=text))
        assert [await subscriber.fetch(), await subscriber.fetch()] == [Short(text="12345678"), Short(text="1")]
        assert (subscriber.too_long, subscriber.undecodable) == (1, 0)


@conforms
async def test_variable_length_does_not_match_a_fixed_one(cable: Cable) -> None:
    await _mismatch(cable, Go, Led)


class Degrees(Message):
    """An angle, as it was."""

    degrees: r2p.f32 = 0.0


class Radians(Message):
    """The same in as many bytes, so that only the announced type says which one it is."""

    radians: r2p.f32 = 0.0


class Angle(Message):
    """The same with more fields."""

    radians: r2p.f32 = 0.0
    frame: Annotated[str, r2p.Max(20)] = ""


@conforms
async def test_a_subscriber_accepts_older_types(cable: Cable) -> None:
    convert = {Degrees: lambda old: Radians(old.degrees / 2), Angle: lambda old: Radians(old.radians)}
    async with two(cable) as (a, b), node_in(a) as alice, node_in(b) as bob:
        await acquainted(a, b)
        for sent in (Degrees(1.0), Radians(0.5), Angle(0.5, "map")):
            topic = f"angle_{type(sent).__name__}"
            angles = bob.subscribe(topic, Radians, accept=convert)
            publisher = alice.advertise(topic, type(sent))
            await publisher.wait_subscriber()
            await angles.wait_publisher()
            await publisher.publish(sent)
            assert await angles.fetch(GUARD) == Radians(0.5)
            assert angles.undecodable == 0


@conforms
async def test_another_type_than_those_that_are_accepted_is_refused(cable: Cable) -> None:
    async with two(cable) as (a, b), node_in(a) as alice, node_in(b) as bob:
        await acquainted(a, b)
        events = b.events()
        angles = bob.subscribe("angle", Radians, accept={Degrees: lambda old: Radians(old.degrees / 2)})
        numbers = alice.advertise("angle", r2p.msg.Float32)
        mismatched = await first(events, Mismatched)
        assert (mismatched.topic, mismatched.role) == ("angle", ROLE_PUBLISHES)
        assert "publish messages of 4 bytes that are not accepted here: add their type to" in mismatched.describe()
        numbers.close()
        with pytest.raises(TimeoutError, match="angle"):
            await angles.fetch(0.001)
        degrees = alice.advertise("angle", Degrees)
        await degrees.wait_subscriber()
        await angles.wait_publisher()
        await degrees.publish(Degrees(1.0))
        assert await angles.fetch(GUARD) == Radians(0.5)
        assert angles.undecodable == 0


@conforms
async def test_two_modules_of_one_name_both_learn_of_it(cable: Cable) -> None:
    a, b = module("X", cable.a()), module("X", cable.b())
    told = a.events(), b.events()
    async with a, b:
        for events in told:
            assert (await first(events, NameConflict)).module == "X"


@conforms
async def test_stop_reboot_and_bootload_over_the_link(cable: Cable) -> None:
    starts: list[r2p.Node] = []

    async def serve(node: r2p.Node) -> None:
        starts.append(node)
        async for _ in node.subscribe("leds", Led):
            pass

    async with two(cable) as (a, b):
        a.start(serve)
        await until(lambda: other(b, "A"))
        b.command(r2p.Command.STOP, "A")
        await until(lambda: a.stopped and not a.nodes["serve"].running)
        await until(lambda: (view := other(b, "A")) and view.state == "stopped")
        b.command(r2p.Command.REBOOT, "A")
        await until(lambda: len(starts) == 2)
        await until(lambda: (view := other(b, "A")) and view.state == "running" and view.rebooted)
        b.command(r2p.Command.BOOTLOAD, "A")
        await until(lambda: a.refused == {"BOOTLOAD": 1})
        b.command(r2p.Command.STOP, "OTHER")
        b.command(r2p.Command.BOOTLOAD, "A")
        await until(lambda: a.refused == {"BOOTLOAD": 2})
        assert not a.stopped
        assert not b.stopped
        assert a.nodes["serve"].running


@conforms
async def test_a_reader_that_keeps_up_loses_nothing(cable: Cable) -> None:
    """Non real-time, 20 000 messages of 4 bytes each, as fast as they go; 4 000 on a bus simulated bit by bit."""
    total = 4_000 if isinstance(cable, SimCable) else 20_000

    async def send(node: r2p.Node) -> None:
        publisher = node.advertise("numbers", r2p.msg.Float32, r2p.NonRealTime(stall=20.0))
        await publisher.wait_subscriber()
        for number in range(total):
            await publisher.publish(r2p.msg.Float32(data=float(number)))

    async with two(cable) as (a, b), node_in(b) as bob:
        subscriber = bob.subscribe("numbers", r2p.msg.Float32)
        a.start(send)
        expected = count()
        async for message in subscriber:
            assert message.data == next(expected)
            if message.data == total - 1:
                break
        assert subscriber.lost == 0
        await until(lambda: not a.nodes["send"].running)  # while its subscriber stays
        assert not a.links[0].losses
        links = a.links[0], b.links[0]
    assert not links[0].losses + links[1].losses


@conforms_lines
async def test_a_peer_that_does_not_read(cable: Cable) -> None:
    """It costs its publisher `stall` seconds once, and what it lacks is reported; other subscribers lose nothing."""
    missed: list[r2p.Missed] = []
    text = Text(text="x" * 64)
    async with (
        r2p.Module("A", via=[cable.a(), "memory:aside"], watchdog=False) as a,
        module("B", cable.b()) as b,
        module("C", "memory:aside") as c,
        node_in(a) as alice,
        node_in(b) as bob,
        node_in(c) as carol,
    ):
        frozen = next(link for link in a.links if isinstance(link, LineLink))
        publisher = alice.advertise("text", Text, r2p.NonRealTime(stall=0.05, on_missed=missed.append))
        bobs = bob.subscribe("text", Text, queue=5)
        carols = carol.subscribe("text", Text, queue=5)
        await until(lambda: publisher.subscribers == 2)
        cable.freeze()
        sent = count(1)
        while not missed:  # until all buffers on the way are full
            next(sent)
            await publisher.publish(text)
            assert await carols.fetch() == text
        before = next(sent)
        for _ in range(1000):  # does not stall any more
            await publisher.publish(text)
            assert await carols.fetch() == text
        assert sum(each.count for each in missed) == publisher.missed == 1001
        assert missed[0].where == frozen.name
        assert frozen.stats.lost["send buffer full"] == 1001
        cable.thaw()
        received = 0
        while received < before - 1 - bobs.lost - 1:
            await bobs.fetch()
            received += 1
        latest = Text(text="latest")
        await until(lambda: not frozen.full)
        await publisher.publish(latest)
        while await bobs.fetch() != latest:
            pass


@conforms_lines
async def test_events_and_periods_that_wait_for_a_link_are_discarded_when_it_breaks(cable: Cable) -> None:
    degraded: list[r2p.Missed] = []
    missed: list[r2p.Missed] = []
    stale: list[r2p.Missed] = []
    number = 0
    async with two(cable) as (a, b), node_in(a) as alice, node_in(b) as bob:
        await acquainted(a, b)
        filler = alice.advertise("text", Text, r2p.NonRealTime(stall=0.01))
        klass = r2p.Sporadic(deadline=10.0, on_missed=missed.append, on_degraded=degraded.append)
        publisher = alice.advertise("cmd", Led, klass)
        state = alice.advertise("state", Led, r2p.Periodic(0.005, lambda: Led(led=number), on_missed=stale.append))
        texts, commands, states = bob.subscribe("text", Text), bob.subscribe("cmd", Led), bob.subscribe("state", Led)
        for each in (filler, publisher, state):
            await each.wait_subscriber()
        cable.freeze()
        while not filler.missed:
            await filler.publish(Text())
        number = 1
        assert not publisher.publish_nowait(Led(led=1))  # waits for room
        await until(lambda: state.missed > 1)
        assert {each.reason for each in stale} == {"no room"}
        await cable.cut()
        await until(lambda: degraded)
        await until(lambda: not publisher.subscribers)
        where = degraded[0].where
        assert missed == [r2p.Missed("cmd", "link down", where)]
        assert publisher.publish_nowait(Led(led=2)) == (not a.links)  # a server's link ends with its client
        assert missed == [r2p.Missed("cmd", "link down", where)] * (1 + len(a.links))
        assert "link down" in {each.reason for each in stale}
        number = 3
        await cable.mend()
        await publisher.wait_subscriber()
        await publisher.publish(Led(led=3))
        assert await commands.fetch() == Led(led=3)
        while (state_now := (await states.fetch()).led) != 3:
            assert state_now == 0
        texts.close()
        assert publisher.missed == len(missed)


@conforms
async def test_closing_while_it_connects(cable: Cable) -> None:
    await cable.cut()
    for _ in range(3):
        async with two(cable) as (a, b):
            await asyncio.sleep(0)
        assert not a.links
        assert not b.links


@conforms
async def test_cancelled_at_any_await(cable: Cable) -> None:
    """However far it came, a cancelled program leaves no task, link or exception, and its peer goes on."""
    answered = asyncio.Event()

    async def answer(node: r2p.Node) -> None:
        publisher = node.advertise("answer", Led)
        async for question in node.subscribe("question", Led):
            await publisher.publish(question)

    async def ask() -> None:
        async with module("B", cable.b()) as b, node_in(b) as bob:
            publisher, subscriber = bob.advertise("question", Led), bob.subscribe("answer", Led)
            await publisher.wait_subscriber()
            await subscriber.wait_publisher()
            while True:
                await publisher.publish(Led())
                with contextlib.suppress(TimeoutError):  # on zenoh A may hear the question before it knows of us
                    await subscriber.fetch(1.0)
                    answered.set()

    async with module("A", cable.a()) as a:
        a.start(answer)
        others = asyncio.all_tasks()
        for turns in (*range(12), *range(12, 60, 4)):
            task = asyncio.create_task(ask())
            for _ in range(turns):
                await asyncio.sleep(0)
            task.cancel()
            await asyncio.wait([task])
            assert task.cancelled()
            await until(lambda: asyncio.all_tasks() == others)  # asyncio accepts connections in tasks of its own
        task = asyncio.create_task(ask())
        answered.clear()
        await answered.wait()
        task.cancel()
        await asyncio.wait([task])
        assert not a.nodes["answer"].error
