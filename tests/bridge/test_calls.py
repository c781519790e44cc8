"""Calls of r2p's own services through gateways: to the one module that they are for, whatever is in between."""

from __future__ import annotations

import random
from contextlib import AsyncExitStack

import pytest

import r2p
from r2p.codecs import own_services
from r2p.codecs.own_services import CHANGES, Operation, OwnCall
from r2p.codecs.services import Kind, ServiceHeader
from r2p.errors import ServiceError
from r2p.sim import SimCan, run
from r2p.testing.network import node_in
from r2p.transports.memory import MemoryNetwork
from tests.bridge.test_topologies import CALM, populate, trouble
from tests.bridge.world import World
from tests.modules.test_own_services import WIDE, Stranger, Wide, knows_wide, services
from tests.transports.cables import LineCable
from tests.transports.rtcan.networks import until

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
        assert gate.links[1].stats.lost == {"call refused": 1, "too many hops": 1}


async def test_a_link_onto_which_nothing_may_go_gets_no_answer() -> None:
    robot, lab = MemoryNetwork(), MemoryNetwork()
    async with AsyncExitStack() as stack:
        gate = await gateway(stack, robot=robot, lab=lab, read_only=("memory:lab",))
        b = await stack.enter_async_context(r2p.Module("B", via=lab.transport("lab")))
        await until(lambda: any(view.wire for view in b.network.modules() if view.name == "A"))
        (instance,) = (view.instance for view in b.network.modules() if view.name == "A")
        assert instance is not None
        with pytest.raises(TimeoutError):
            await services(b).fetch(instance, Operation.SCHEMA, WIDE.fingerprint)
        assert gate.links[1].stats.lost["call refused"] > 3


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
