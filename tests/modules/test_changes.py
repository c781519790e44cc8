"""Operations of modules that change something: once for each call, and only with permission."""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, cast

import pytest
import uvloop

import r2p
from r2p import keys
from r2p.codecs import keys as codec
from r2p.codecs import own_services
from r2p.codecs.own_services import CHANGES, Operation, OwnCall
from r2p.codecs.services import Kind, ServiceHeader
from r2p.errors import ServiceError
from r2p.keys import SharedKey
from r2p.services.answers import RememberedAnswers
from r2p.transports.memory import Datagram, MemoryNetwork, MemoryTransport
from tests.modules.test_own_services import Stranger, services
from tests.transports.cables import Cable, LineCable, Setup, TcpCable, conforms
from tests.transports.rtcan.networks import until
from tests.transports.test_keys import KeyedEnd
from tests.transports.zenoh.cable import Net, ZenohCable, guarded

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

TEST = cast("Operation", 250)  # a number that no operation has


class Desk:
    """Counts what it is to change; each change takes its argument in milliseconds."""

    def __init__(self, module: r2p.Module) -> None:
        self.made: Counter[bytes] = Counter()
        self.instance = module.instance
        services(module).serve(TEST, self._change)

    async def _change(self, argument: bytes) -> bytes:
        self.made[argument] += 1
        await asyncio.sleep(int(argument) / 1000)
        return b"changed " + argument * 100  # more than one page


@asynccontextmanager
async def two(network: MemoryNetwork) -> AsyncIterator[tuple[Desk, r2p.Module, r2p.Module]]:
    """A module that can be changed, and another one that knows it."""
    async with r2p.Module("A", via=network.transport()) as a, r2p.Module("B", via=network.transport()) as b:
        await until(lambda: knows(b, a))
        yield Desk(a), a, b


def knows(module: r2p.Module, other: r2p.Module) -> bool:
    return any(view.instance == other.instance and view.wire for view in module.network.modules())


# Once for each call


@pytest.mark.virtual_time
async def test_a_change_is_made_once_however_often_requests_and_answers_are_lost_or_repeated() -> None:
    network = MemoryNetwork(loss=0.2, duplicate=0.4, reorder=0.3, jitter=0.02, seed=3)
    async with two(network) as (desk, a, b):
        lengths = [str(length).encode() for length in [0, 1, 99, 150, 300, 1000, 4000, *range(2000, 2020)]]
        answers = await asyncio.gather(*[services(b).change(a.instance, TEST, each) for each in lengths])
        assert answers == [b"changed " + each * 100 for each in lengths]
        assert desk.made == Counter(lengths)


@pytest.mark.virtual_time
async def test_a_request_that_comes_again_later_changes_nothing() -> None:
    network = MemoryNetwork()
    stranger = Stranger(network)
    async with two(network) as (desk, a, b):
        await services(b).change(a.instance, TEST, b"0")
        recorded = [each for each in stranger.heard if each.topic == b"R2P_CALL"]
        for operation in range(200):  # what others, and this one, ask for meanwhile displaces no answer of a change
            await services(b).fetch(a.instance, Operation.STATISTICS, b"%d" % operation)
        await asyncio.sleep(50)
        for each in recorded:
            network.send(each)
        await asyncio.sleep(1)
        assert desk.made == {b"0": 1}


@pytest.mark.virtual_time
async def test_a_long_change_is_waited_for_and_its_module_is_asked_seldom() -> None:
    network = MemoryNetwork(loss=0.1, seed=2)
    stranger = Stranger(network)
    async with two(network) as (desk, a, b):
        assert (await services(b).change(a.instance, TEST, b"60000")).startswith(b"changed")
        assert desk.made == {b"60000": 1}
        calls = stranger.calls()
        assert 200 < sum(call.is_request for call in calls) < 350
        assert {call.header.kind for call in calls} == {Kind.REQUEST, Kind.WORKING, Kind.RESPONSE}


@pytest.mark.virtual_time
async def test_a_module_that_ends_or_is_cut_off_while_it_works() -> None:
    network = MemoryNetwork()
    async with two(network) as (desk, a, b):
        change = asyncio.create_task(services(b).change(a.instance, TEST, b"60000"))
        await until(lambda: desk.made)
        await asyncio.sleep(1)
        network.loss = 1.0
        with pytest.raises(TimeoutError):
            await change
        network.loss = 0.0
        left = asyncio.create_task(services(b).change(a.instance, TEST, b"50000"))
        await until(lambda: len(desk.made) == 2)
    with pytest.raises(TimeoutError):
        await left
    assert desk.made == {b"60000": 1, b"50000": 1}


@pytest.mark.virtual_time
async def test_what_a_handler_raises_is_the_answer_also_after_a_while() -> None:
    async with two(MemoryNetwork()) as (_, a, b):
        ran = 0

        async def refuse(argument: bytes) -> bytes:
            nonlocal ran
            ran += 1
            await asyncio.sleep(0.5)
            raise r2p.Error(f"kp is at most 10, not {argument.decode()}")

        services(a).serve(TEST, refuse)
        for caller in (a, b):
            with pytest.raises(ServiceError, match="kp is at most 10, not 70"):
                await services(caller).change(a.instance, TEST, b"70")
        assert ran == 2

        async def cancelled(argument: bytes) -> bytes:
            nonlocal ran
            ran += 1
            await asyncio.sleep(0.5)
            raise asyncio.CancelledError

        services(a).serve(TEST, cancelled)
        with pytest.raises(ServiceError, match="the module has cancelled it"):
            await services(b).change(a.instance, TEST, b"70")
        assert ran == 3
        for caller in (a, b):
            with pytest.raises(ServiceError, match="operation 249 is unknown to this version of r2p"):
                await services(caller).change(a.instance, cast("Operation", 249))


@pytest.mark.virtual_time
async def test_a_module_works_on_64_requests_at_most() -> None:
    network = MemoryNetwork()
    stranger = Stranger(network)
    async with two(network) as (desk, a, b):
        for caller in range(1, 100):
            header = ServiceHeader(caller, 1, Kind.REQUEST, a.instance)
            stranger.say("R2P_CALL", own_services.encode(OwnCall(header, TEST, body=b"%d" % (3000 + caller))))
        await until(lambda: len(desk.made) == 64)
        with pytest.raises(ServiceError, match="A is busy: try again later"):
            await services(b).change(a.instance, TEST, b"1")
        await asyncio.sleep(4)
        assert await services(b).change(a.instance, TEST, b"1")
        assert len(desk.made) == 65


@pytest.mark.virtual_time
async def test_an_answer_that_is_forgotten_before_its_last_page_is_no_reason_to_change_it_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("r2p.modules.own_services._pages_at_once", lambda _link: 1)
    network = MemoryNetwork(delay=0.001)
    async with two(network) as (desk, a, b):
        asyncio.get_running_loop().call_later(0.005, services(a)._contents.clear)
        with pytest.raises(ServiceError, match="the change was made, but"):
            await services(b).change(a.instance, TEST, b"000000")
        assert desk.made == {b"000000": 1}


@pytest.mark.virtual_time
@pytest.mark.parametrize("seed", range(3))
async def test_hostile_messages_change_nothing_twice_and_stop_nothing(seed: int) -> None:
    chance = random.Random(seed)
    network = MemoryNetwork(duplicate=0.2, seed=seed)
    stranger = Stranger(network)
    async with two(network) as (desk, a, b):
        for number in range(2000):
            if chance.random() < 0.3:
                stranger.say("R2P_CALL", own_services.encode(hostile(chance, a, number)))
            else:
                old = chance.choice(stranger.heard[-50:] or [Datagram(0, b"R2P_REPLY", b"")])
                cut = chance.randrange(len(old.data) + 1)
                stranger.say(old.topic.decode(), old.data[:cut] + chance.randbytes(chance.choice([0, 1, 20])))
            if chance.random() < 0.05:
                await asyncio.sleep(0.1)
        await asyncio.sleep(30)
        assert len(desk.made) > 20
        assert max(count for argument, count in desk.made.items() if len(argument) == 6) == 1
        assert not services(a)._running
        assert a.links[0].losses["internal error"] == b.links[0].losses["internal error"] == 0
        assert await services(b).change(a.instance, TEST, b"4")


def hostile(chance: random.Random, module: r2p.Module, number: int) -> OwnCall:
    """A message that might start a handler; each argument is unlike any other, also one with another last digit."""
    kind = chance.choice([Kind.REQUEST, Kind.REQUEST, Kind.CANCEL, Kind.WORKING, Kind.RESPONSE])
    header = ServiceHeader(chance.randrange(4), chance.randrange(65536), kind, module.instance)
    operation = chance.choice([TEST, TEST, CHANGES, 1, 255])
    page, pages, edition = (chance.choice([0, 0, 0, 1, 65535]) for _ in range(3))
    return OwnCall(header, operation, page, pages, edition, b"%05d0" % number)


# Permission


@conforms
async def test_a_change_on_every_link(cable: Cable) -> None:
    """With --allow-control, which only links of IP networks need."""
    a = r2p.Module("A", via=cable.a(), watchdog=False, allow_control=isinstance(cable, TcpCable | ZenohCable))
    async with a, r2p.Module("B", via=cable.b(), watchdog=False) as b:
        desk = Desk(a)
        await until(lambda: knows(b, a))
        assert await services(b).change(a.instance, TEST, b"200") == b"changed " + b"200" * 100
        assert desk.made == {b"200": 1}


@pytest.mark.parametrize(("cable", "scheme"), [(TcpCable, "tcp"), (ZenohCable, "zenoh")])
def test_links_of_ip_networks_need_permission(
    cable: type[Cable], scheme: str, caplog: pytest.LogCaptureFixture
) -> None:
    async def test(cable: Cable) -> None:
        async with (
            r2p.Module("A", via=cable.a(), watchdog=False) as a,
            r2p.Module("B", via=cable.b(), watchdog=False) as b,
        ):
            await until(lambda: knows(b, a) and knows(a, b))
            for server, caller in ((a, b), (b, a)):
                desk = Desk(server)
                expected = (
                    f"{server.name} refuses changes from {scheme}: start it with --allow-control, or give the link"
                )
                for _ in range(2):
                    with pytest.raises(ServiceError, match=f"^{expected} a key"):
                        await services(caller).change(server.instance, TEST, b"0")
                assert not desk.made
                assert await services(server).change(server.instance, TEST, b"0"), "a program may change itself"
                assert sum(each.losses["change refused"] for each in server.links) >= 2
                lines = [each.getMessage() for each in caplog.records if expected in each.getMessage()]
                assert len(lines) == 1
                await services(caller).fetch(server.instance, Operation.STATISTICS)

    Setup(cable, uvloop.new_event_loop).run(test)


class IpLine(LineCable):
    """A line in this process that counts as one of an IP network."""

    def __init__(self) -> None:
        super().__init__()
        self._a.name = self._b.name = "tcp:robot"


@pytest.mark.virtual_time
@pytest.mark.parametrize("operation", [each for each in Operation if each.changes])
async def test_every_operation_that_changes_something_needs_permission(operation: Operation) -> None:
    unknown, refused = "unknown to this version", "A refuses changes from tcp: start it with --allow-control"
    for allowed in (False, True):
        line = IpLine()
        async with r2p.Module("A", via=line.a(), allow_control=allowed) as a, r2p.Module("B", via=line.b()) as b:
            await until(lambda b=b, a=a: knows(b, a))  # type: ignore[misc]
            try:
                text = str(await services(b).change(a.instance, operation))
            except ServiceError as error:
                text = str(error)
            needs_key = operation in services(a)._needs_key
            assert (refused in text) is not (allowed or needs_key)
            assert ("A takes this only from links with a key" in text) is needs_key
            assert unknown not in text
            assert a.links[0].losses["change refused"] == (needs_key or not allowed)


@pytest.mark.virtual_time
async def test_an_operation_that_needs_a_key_is_refused_without_one() -> None:
    async with two(MemoryNetwork()) as (desk, a, b):
        services(a).serve(TEST, desk._change, needs_key=True)
        with pytest.raises(ServiceError, match=r"A takes this only from links with a key, and its memory has none"):
            await services(b).change(a.instance, TEST, b"0")
        assert not desk.made


# Keys

KEY, OTHER = SharedKey(bytes(32)), SharedKey(bytes(range(32)))


def memory(network: MemoryNetwork, key: SharedKey | None) -> MemoryTransport:
    return MemoryTransport("lab", network, key=key)


@asynccontextmanager
async def keyed(
    network: MemoryNetwork, key: SharedKey | None = KEY
) -> AsyncIterator[tuple[Desk, r2p.Module, r2p.Module]]:
    """A module that can be changed, on a link with a key, and another one that has this key."""
    via = [memory(network, each) for each in (KEY, key)]
    async with r2p.Module("A", via=via[0]) as a, r2p.Module("B", via=via[1]) as b:
        await until(lambda: knows(b, a))
        yield Desk(a), a, b


class KeyedCable(LineCable):
    """A debug line in this process with a key at both ends, or a transport of another cable."""

    def __init__(self, key: SharedKey | None = KEY) -> None:
        super().__init__()
        self._a = KeyedEnd(lambda data: self._carry(data, self._b), KEY)
        self._b = KeyedEnd(lambda data: self._carry(data, self._a), key)


@pytest.mark.virtual_time
@pytest.mark.parametrize("bus", ["memory:lab", "sim:lab", "sim:lab,profile=firmware-2014"])
async def test_buses_with_a_key(bus: str, tmp_path: Path) -> None:
    key = f",key={tmp_path / 'robot.key'}"
    keys.create(tmp_path / "robot.key")
    async with (
        r2p.Module("A", via=bus + key) as a,
        r2p.Module("B", via=bus + key) as b,
        r2p.Module("C", via=bus) as c,
    ):
        desk = Desk(a)
        await until(lambda: knows(b, a) and knows(c, a))
        assert await services(b).change(a.instance, TEST, b"200") == b"changed " + b"200" * 100
        await asyncio.sleep(11)  # the proof has expired
        assert not a.links[0].losses
        with pytest.raises(ServiceError, match=r"A refuses changes from .*: the link has a key"):
            await services(c).change(a.instance, TEST, b"0")
        assert a.links[0].losses["without key"]
        assert await services(b).change(a.instance, TEST, b"1")
        assert await services(c).fetch(a.instance, Operation.STATISTICS)
        assert desk.made == {b"200": 1, b"1": 1}


@pytest.mark.virtual_time
async def test_a_line_with_a_key() -> None:
    cable = KeyedCable()
    cable._a.name = "tcp:robot"  # what needs permission otherwise
    async with r2p.Module("A", via=cable.a()) as a, r2p.Module("B", via=cable.b()) as b:
        desk = Desk(a)
        services(a).serve(cast("Operation", 251), desk._change, needs_key=True)
        await until(lambda: knows(b, a))
        for operation in (TEST, cast("Operation", 251)):
            assert await services(b).change(a.instance, operation, b"0")
        await asyncio.sleep(11)
        b.links[0].guard = None  # as a release that does not seal requests
        with pytest.raises(ServiceError, match="A refuses changes from tcp: the link has a key"):
            await services(b).change(a.instance, TEST, b"1")
        assert desk.made == {b"0": 2}


@pytest.mark.anyio
@guarded
async def test_zenoh_with_a_key(tmp_path: Path) -> None:
    """As on any link with a key, --allow-control is neither needed nor enough."""
    keys.create(tmp_path / "robot.key")
    key, net = f"&key={tmp_path / 'robot.key'}", Net()
    async with (
        r2p.Module("A", via=net.listen + key, watchdog=False, allow_control=True) as a,
        r2p.Module("B", via=net.join + key, watchdog=False) as b,
        r2p.Module("C", via=net.join, watchdog=False) as c,
    ):
        desk = Desk(a)
        await until(lambda: knows(b, a) and knows(c, a))
        assert await asyncio.gather(*[services(b).change(a.instance, TEST, b"%d" % each) for each in range(20)])
        with pytest.raises(ServiceError, match="A refuses changes from zenoh: the link has a key"):
            await services(c).change(a.instance, TEST, b"100")
        assert desk.made == Counter(b"%d" % each for each in range(20))
        assert a.links[0].losses["without key"]


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    ("key", "reason", "text"),
    [
        (None, "without key", "the link has a key: add \\?key=FILE to the URL"),
        (OTHER, "other key", "the link has another key than the sender: give both ends copies of one file"),
    ],
)
async def test_who_lacks_the_key_learns_so_within_a_second(
    key: SharedKey | None, reason: str, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    network = MemoryNetwork()
    async with keyed(network, key) as (desk, a, b):
        for _ in range(2):
            async with asyncio.timeout(1.0):
                with pytest.raises(ServiceError, match=f"A refuses changes from memory: {text}"):
                    await services(b).change(a.instance, TEST, b"0")
        assert not desk.made
        assert set(a.links[0].losses) == {reason}
        assert caplog.text.count("changes refused: the sender") == 1
        assert await services(b).fetch(a.instance, Operation.STATISTICS), "reading needs no key"


@pytest.mark.virtual_time
async def test_with_the_key_a_change_is_made_once_on_a_lossy_network() -> None:
    network = MemoryNetwork(loss=0.1, duplicate=0.4, jitter=0.01, seed=5)
    async with keyed(network) as (desk, a, b):
        lengths = [str(length).encode() for length in range(30)]
        assert await asyncio.gather(*[services(b).change(a.instance, TEST, each) for each in lengths])
        assert desk.made == Counter(lengths)


@pytest.mark.virtual_time
async def test_recorded_requests_change_nothing_at_any_time() -> None:
    network = MemoryNetwork()
    stranger = Stranger(network)
    async with keyed(network) as (desk, a, b):
        await services(b).change(a.instance, TEST, b"0")
        first = list(stranger.heard)
        network.loss = 1.0  # what is held back now has never arrived
        with pytest.raises(TimeoutError):
            await services(b).change(a.instance, TEST, b"1")
        network.loss = 0.0
        held = [each for each in stranger.heard[len(first) :] if each.topic in (b"R2P_CALL", b"R2P")]
        for pause in (61, 0.1):  # in which all proofs expire, and in which nobody has proven anything but B lives
            await asyncio.sleep(pause)
            for each in (*first, *held):
                stranger.say(each.topic.decode(), each.data)
        await asyncio.sleep(5)
        assert desk.made == {b"0": 1}
        losses = a.links[0].losses
        assert losses["recorded"]
        services(a)._changes = RememberedAnswers()  # the memory of answers is not what protects it
        for each in first:
            stranger.say(each.topic.decode(), each.data)
        await asyncio.sleep(1)
        assert desk.made == {b"0": 1}


@pytest.mark.virtual_time
async def test_a_seal_whose_sender_has_left_and_one_for_another_topic_do_not_count() -> None:
    network = MemoryNetwork()
    stranger = Stranger(network)
    async with keyed(network) as (desk, a, _):
        foreign = OwnCall(ServiceHeader(7, 1, Kind.REQUEST, a.instance), TEST, body=b"0")
        data = own_services.encode(foreign)
        for topic in (b"R2P_CALL", b"R2P"):
            stranger.manage(codec.seal(KEY, 99, 1, 1, (topic, data)))
            stranger.say("R2P_CALL", data)
        await asyncio.sleep(11)
        assert a.links[0].losses == {"unproven": 1, "without key": 1}
        assert not desk.made


@pytest.mark.virtual_time
@pytest.mark.parametrize("seed", range(3))
async def test_no_hostile_message_changes_what_a_key_protects(seed: int) -> None:
    chance = random.Random(seed)
    network = MemoryNetwork(duplicate=0.2, reorder=0.2, seed=seed)
    stranger = Stranger(network)
    async with keyed(network) as (desk, a, b):
        changes = [asyncio.create_task(services(b).change(a.instance, TEST, b"%d" % each)) for each in range(5)]
        for number in range(2000):
            if chance.random() < 0.3:
                stranger.say("R2P_CALL", own_services.encode(hostile(chance, a, number)))
            else:
                old = chance.choice(stranger.heard[-50:] or [Datagram(0, b"R2P_REPLY", b"")])
                cut = chance.choice([len(old.data), chance.randrange(len(old.data) + 1)])
                stranger.say(old.topic.decode(), old.data[:cut] + chance.randbytes(chance.choice([0, 0, 1, 20])))
            if chance.random() < 0.05:
                await asyncio.sleep(0.1)
        await asyncio.gather(*changes)
        await asyncio.sleep(11)
        assert desk.made == Counter(b"%d" % each for each in range(5))
        guard = a.links[0].guard
        assert guard is not None
        assert not guard._doubtful
        assert a.links[0].losses["internal error"] == b.links[0].losses["internal error"] == 0
        assert a.links[0].losses["without key"] > 100
