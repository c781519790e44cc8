"""Calls of r2p's own services through gateways: to the one module that they are for, whatever is in between."""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any, Self

import pytest

import r2p
from r2p.codecs import own_services
from r2p.codecs.own_services import CHANGES, Operation, OwnCall
from r2p.codecs.services import Kind, ServiceHeader
from r2p.errors import ServiceError
from r2p.sim import SimCan, run
from r2p.testing.network import node_in
from r2p.transports.memory import MemoryNetwork, MemoryTransport
from tests.bridge.test_topologies import CALM, populate, trouble
from tests.bridge.world import World
from tests.modules.test_changes import KEY, OTHER, TEST, Desk, IpLine, KeyedCable, knows
from tests.modules.test_own_services import WIDE, Stranger, Wide, knows_wide, services
from tests.transports.cables import LineCable
from tests.transports.rtcan.networks import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from r2p.keys import SharedKey
    from tests.transports.cables import Cable

pytestmark = pytest.mark.virtual_time


async def test_through_two_gateways_over_a_bus_and_a_line() -> None:
    near, far, can, line = MemoryNetwork(), MemoryNetwork(), SimCan(seed=1), LineCable()
    async with AsyncExitStack() as stack:
        for name, via in (("GW1", [near.transport(), can.transport()]), ("GW2", [can.transport(), line.a()])):
            await stack.enter_async_context(r2p.Module(name, via=via, bridge=True, watchdog=False))
        via = [line.b(), far.transport()]
        await stack.enter_async_context(r2p.Module("GW3", via=via, bridge=True, watchdog=False))
        a = await stack.enter_async_context(r2p.Module("A", via=far.transport()))
        (await stack.enter_async_context(node_in(a))).advertise("wide", Wide)
        b = await stack.enter_async_context(r2p.Module("B", via=near.transport()))
        await until(lambda: knows_wide(b))
        stranger = Stranger(far)
        found = await b.network.message_type(WIDE.fingerprint)
        assert found is not None
        assert r2p.layout(found).name == "lab_msgs/Wide"
        assert {(call.hops, call.is_request) for call in stranger.calls()} == {(3, True), (0, False)}
        assert not any(b"R2P_" in each.data for each in stranger.heard if each.topic == b"R2P")


async def gateway(stack: AsyncExitStack, *, robot: MemoryNetwork, lab: MemoryNetwork, **options: object) -> r2p.Module:
    """A robot's module A, and its gateway to the lab, which is returned."""
    a = await stack.enter_async_context(r2p.Module("A", via=robot.transport("robot")))
    (await stack.enter_async_context(node_in(a))).advertise("wide", Wide)
    via = [robot.transport("robot"), lab.transport("lab")]
    made = r2p.Module("GW", via=via, bridge=r2p.BridgeOptions(**options), watchdog=False)  # type: ignore[arg-type]
    return await stack.enter_async_context(made)


async def test_a_module_behind_a_prefix_is_reached_and_one_of_another_robot_is_not() -> None:
    robot, lab = MemoryNetwork(), MemoryNetwork()
    async with AsyncExitStack() as stack:
        await gateway(stack, robot=robot, lab=lab, prefix="robot1/", prefix_on=("memory:lab",))
        b = await stack.enter_async_context(r2p.Module("B", via=lab.transport("lab")))
        await until(lambda: any(view.wire for view in b.network.modules() if view.name == "robot1/A"))
        (instance,) = (view.instance for view in b.network.modules() if view.name == "robot1/A")
        assert instance is not None
        assert await services(b).fetch(instance, Operation.SCHEMA, WIDE.fingerprint)


async def test_what_is_not_passed_on_is_counted() -> None:
    robot, lab = MemoryNetwork(), MemoryNetwork()
    async with AsyncExitStack() as stack:
        gate = await gateway(stack, robot=robot, lab=lab, read_only=("memory:robot",))
        stranger = Stranger(lab)
        b = await stack.enter_async_context(r2p.Module("B", via=lab.transport("lab")))
        await until(lambda: any(view.wire for view in b.network.modules() if view.name == "A"))
        (instance,) = (view.instance for view in b.network.modules() if view.name == "A")
        assert instance is not None
        assert await services(b).fetch(instance, Operation.SCHEMA, WIDE.fingerprint), "reading is not writing"
        header = ServiceHeader(b.instance, 1, Kind.REQUEST, instance)
        stranger.say("R2P_CALL", own_services.encode(OwnCall(header, CHANGES)))
        stranger.say("R2P_CALL", own_services.encode(OwnCall(header, Operation.SCHEMA, hops=15)))
        unknown = ServiceHeader(b.instance, 1, Kind.REQUEST, instance ^ 1)
        stranger.say("R2P_CALL", own_services.encode(OwnCall(unknown, Operation.SCHEMA)))
        await until(lambda: gate.links[1].stats.lost["too many hops"])
        assert gate.links[1].stats.lost == {"change refused": 1, "too many hops": 1}


async def test_a_link_onto_which_nothing_may_go_gets_no_answer() -> None:
    robot, lab = MemoryNetwork(), MemoryNetwork()
    async with AsyncExitStack() as stack:
        gate = await gateway(stack, robot=robot, lab=lab, read_only=("memory:lab",))
        b = await stack.enter_async_context(r2p.Module("B", via=lab.transport("lab")))
        await until(lambda: any(view.wire for view in b.network.modules() if view.name == "A"))
        (instance,) = (view.instance for view in b.network.modules() if view.name == "A")
        assert instance is not None
        why = "gateway GW passes nothing on to memory: it is started with --read-only for that link"
        with pytest.raises(ServiceError, match=why):
            await services(b).fetch(instance, Operation.SCHEMA, WIDE.fingerprint)
        assert gate.links[1].stats.lost["call refused"] == 1


# Changes


class Chain:
    """B - line - GW1 - bus - GW2 - network - A: a module that can be changed, two gateways, and one that asks."""

    def __init__(self, line: Cable, one: r2p.BridgeOptions, two: r2p.BridgeOptions) -> None:
        can, self.far = SimCan(seed=1), MemoryNetwork()
        self.gateways = [
            r2p.Module("GW1", via=[line.a(), can.transport()], bridge=one, watchdog=False),
            r2p.Module("GW2", via=[can.transport(), self.far.transport()], bridge=two, watchdog=False),
        ]
        self.a = r2p.Module("A", via=self.far.transport(), watchdog=False)
        self.b = r2p.Module("B", via=line.b(), watchdog=False)
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        for each in (*self.gateways, self.a, self.b):
            await self._stack.enter_async_context(each)
        self.desk = Desk(self.a)
        await until(lambda: knows(self.b, self.a))
        return self

    async def __aexit__(self, *error: object) -> None:
        await self._stack.aclose()

    async def change(self, argument: bytes) -> bytes:
        return await services(self.b).change(self.a.instance, TEST, argument)


CONTROL = r2p.BridgeOptions(allow_control=True)


async def test_a_change_through_two_gateways_is_made_once_though_the_network_loses_and_repeats() -> None:
    async with Chain(IpLine(), CONTROL, r2p.BridgeOptions()) as chain:
        vars(chain.far).update(loss=0.2, duplicate=0.4, jitter=0.02)
        lengths = [str(length).encode() for length in (0, 1, 100, 300, 3000)]
        answers = await asyncio.gather(*[chain.change(each) for each in lengths])
        assert answers == [b"changed " + each * 100 for each in lengths]
        assert chain.desk.made == Counter(lengths)


@pytest.mark.parametrize(
    ("one", "two", "text"),
    [
        ({}, {}, "gateway GW1 refuses changes from tcp: start it with --allow-control, or give the link a key"),
        (
            {"allow_control": True, "read_only": ("sim",)},
            {},
            "gateway GW1 lets no changes onto sim: it is started with --read-only for that link",
        ),
        (
            {"allow_control": True},
            {"read_only": ("memory",)},
            "gateway GW2 lets no changes onto memory: it is started with --read-only for that link",
        ),
        (
            {"allow_control": True},
            {"read_only": ("sim",)},
            "gateway GW2 passes nothing on to sim: it is started with --read-only for that link",
        ),
    ],
)
async def test_a_gateway_that_refuses_a_change_answers_in_the_place_of_the_module(
    one: dict[str, Any], two: dict[str, Any], text: str, caplog: pytest.LogCaptureFixture
) -> None:
    async with Chain(IpLine(), r2p.BridgeOptions(**one), r2p.BridgeOptions(**two)) as chain:
        with pytest.raises(ServiceError, match=text):
            await chain.change(b"0")
        refused = [link.stats.lost["change refused"] for each in chain.gateways for link in each.links]
        assert sorted(refused) == [0, 0, 0, 1]
        assert text in caplog.text
        assert not chain.desk.made


async def test_the_module_of_a_gateway_may_be_changed_where_its_links_let_others_be() -> None:
    line = IpLine()
    bus = MemoryNetwork()
    for options, text in (
        (r2p.BridgeOptions(), "GW refuses changes from tcp: start it with --allow-control"),
        (CONTROL, ""),
        (r2p.BridgeOptions(allow_control=True, read_only=("tcp",)), "GW refuses changes from tcp: .* --read-only"),
    ):
        gateway = r2p.Module("GW", via=[line.a(), bus.transport()], bridge=options, watchdog=False)
        async with gateway as gw, r2p.Module("B", via=line.b()) as b:
            desk = Desk(gw)
            await until(lambda b=b, gw=gw: knows(b, gw))  # type: ignore[misc]
            if text:
                with pytest.raises(ServiceError, match=text):
                    await services(b).change(gw.instance, TEST, b"0")
            else:
                await services(b).change(gw.instance, TEST, b"0")
            assert len(desk.made) == (not text)


# Changes, where links have keys


@asynccontextmanager
async def robot_with_keys(
    *keys: SharedKey | None, **options: Any
) -> AsyncIterator[tuple[Desk, r2p.Module, r2p.Module]]:
    """B - GW1 - GW2 - A, on networks with these keys; A, GW1 and B."""
    networks = [MemoryTransport("lab", MemoryNetwork(delay=0.001), key=key) for key in keys]
    async with AsyncExitStack() as stack:
        for number in (0, 1):
            via, bridge = networks[number : number + 2], r2p.BridgeOptions(**options if not number else {})
            gateway = r2p.Module(f"GW{number + 1}", via=via, bridge=bridge, watchdog=False)
            await stack.enter_async_context(gateway)
            if not number:
                first = gateway
        a, b = r2p.Module("A", via=networks[2]), r2p.Module("B", via=networks[0])
        for each in (a, b):
            await stack.enter_async_context(each)
        await until(lambda: knows(b, a))
        yield Desk(a), first, b


async def change(desk: Desk, b: r2p.Module) -> bytes:
    return await services(b).change(desk.instance, TEST, b"0")


@pytest.mark.parametrize("keys", [(KEY, OTHER, KEY), (KEY, KEY, None), (KEY, None, None)])
async def test_each_gateway_seals_a_change_with_the_key_of_the_next_link(keys: tuple[SharedKey | None, ...]) -> None:
    async with robot_with_keys(*keys) as (desk, first, b):
        for _ in range(2):
            await change(desk, b)
            await asyncio.sleep(11)
        assert desk.made == {b"0": 2}
        assert not any(link.losses["without key"] or link.losses["unproven"] for link in first.links)


async def test_a_gateway_lends_its_key_to_no_change() -> None:
    async with robot_with_keys(None, KEY, KEY, allow_control=True) as (desk, first, b):
        why = "gateway GW1 passes no changes from memory to memory, which has a key: give memory one "
        with pytest.raises(ServiceError, match=why):
            await change(desk, b)
        assert first.links[0].losses["change refused"] == 1


async def test_a_gateway_with_a_key_refuses_a_change_without_it_and_one_that_is_not_on_the_way_does_not_care() -> None:
    async with robot_with_keys(KEY, KEY, KEY, allow_control=True) as (desk, first, _):
        lab = first._via[0]
        async with (
            r2p.Module("GW3", via=[lab, "memory:elsewhere"], bridge=True, watchdog=False) as other,
            r2p.Module("C", via=MemoryTransport("lab", lab._network)) as c,  # type: ignore[union-attr]
        ):
            await until(lambda: any(view.instance == desk.instance for view in c.network.modules()))
            with pytest.raises(ServiceError, match=r"gateway GW1 refuses changes from memory: the link has a key: add"):
                await change(desk, c)
            assert first.links[0].losses["without key"]
            assert not other.links[0].losses["without key"]
            assert not desk.made


async def test_a_key_does_not_help_where_nothing_may_go() -> None:
    async with robot_with_keys(KEY, KEY, KEY, allow_control=True, read_only=("memory:lab#2",)) as (desk, _, b):
        with pytest.raises(
            ServiceError, match="gateway GW1 lets no changes onto memory: it is started with --read-only"
        ):
            await change(desk, b)


async def test_a_line_with_a_key_needs_no_allow_control() -> None:
    line = KeyedCable()
    line._a.name = line._b.name = "tcp:robot"
    async with Chain(line, r2p.BridgeOptions(), r2p.BridgeOptions()) as chain:
        assert await chain.change(b"100")
        assert chain.desk.made == {b"100": 1}


@pytest.mark.parametrize("seed", range(3))
def test_random_topologies(seed: int) -> None:
    """Whatever happened before, in the end each module reaches each other one."""
    run(lambda: scenario(seed), seed=seed)


async def scenario(seed: int) -> None:
    chance = random.Random(seed)
    async with World(chance) as world:
        await populate(world)
        for _ in range(chance.randint(0, 3)):
            await world.talk(chance.uniform(0.05, 1.0))
            await trouble(world)
        await world.talk(2 * CALM)
        modules = [(each.module, each.networks) for each in world.speakers if each.module and each.pulled is None]
        for module, networks in modules:
            for other, there in modules:
                if other is not module and not world.connected(networks).isdisjoint(there):
                    with pytest.raises(ServiceError, match="no topic of this module has the type"):
                        await services(module).fetch(other.instance, Operation.SCHEMA, b"nothing.")
