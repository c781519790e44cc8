"""The time of a ROS network: published by a program under virtual time, and followed by one."""

import asyncio
import itertools
from collections import Counter
from collections.abc import Callable

import pytest

import r2p
import r2p.sim
from r2p.clock import REAL_TIME, SteeredClock, clock_of
from r2p.messages import Timestamp
from r2p.ros.clock import RosClock
from r2p.ros.middleware import MiddlewareUser
from r2p.ros.ros1 import registration
from r2p.ros.ros1.xmlrpc import XmlRpcServer
from r2p.ros.ros1.xmlrpc_codec import Value
from r2p.ros.transport import RosTransport
from r2p.testing.network import node_in
from r2p.units import MILLISECOND, SECOND
from tests.ros.fake import FakeMiddleware, FakeRosNetwork
from tests.ros.ros1.session import running

both = pytest.mark.parametrize("version", [1, 2])
SIMULATED = 100 * SECOND


@both
def test_virtual_time_is_the_time_of_ros_nodes(version: int) -> None:
    async def main() -> list[RosClock]:
        network = FakeRosNetwork(version)
        times: list[RosClock] = network.node("/listener").subscribe("/clock", RosClock)
        async with r2p.Module("PC1", via=[network.transport(), FakeRosNetwork(3 - version).transport()]):
            await asyncio.sleep(0.5)
        return times

    times = [each.clock.ns for each in r2p.sim.run(main, speed=100)]
    assert len(times) > 40
    assert {later - time for time, later in itertools.pairwise(times)} == {10 * MILLISECOND}


@both
@pytest.mark.virtual_time
async def test_free_virtual_time_is_not_published(version: int) -> None:
    """Nothing real could keep up with it."""
    network = FakeRosNetwork(version)
    async with r2p.Module("PC1", via=network.transport()):
        await asyncio.sleep(0.5)
        assert "/clock" not in {each.topic for each in network.graph().publishers}


@both
def test_a_program_follows_the_time_of_ros(version: int) -> None:
    async def main() -> None:
        network = FakeRosNetwork(version)
        simulator = network.node("/simulator")
        async with r2p.Module("PC1", via=network.transport()) as module, node_in(module) as node:
            simulator.publish("/clock", RosClock(Timestamp.from_ns(SIMULATED)))
            while node.now() != SIMULATED:
                await asyncio.sleep(0)
                simulator.publish("/clock", RosClock(Timestamp.from_ns(SIMULATED)))
            ticks = node.every(1.0)
            for second in (1, 2, 3):
                simulator.publish("/clock", RosClock(Timestamp.from_ns(SIMULATED + second * SECOND)))
                await anext(ticks)
                assert node.now() == SIMULATED + second * SECOND
            simulator.close()
            await asyncio.sleep(0.05)  # real time again
            assert node.now() > SIMULATED + 3 * SECOND

    r2p.sim.run(main, follow=True)


@pytest.mark.virtual_time
async def test_connections_have_real_time_and_what_they_deliver_has_not() -> None:
    """Else a simulator that has died could not be found out: the time that it gave stands still."""
    network, seen = FakeRosNetwork(1), list[bool]()

    class Watched(FakeMiddleware):
        async def run(self, user: MiddlewareUser, opened: Callable[[], object]) -> None:
            seen.append(REAL_TIME.get())
            await super().run(user, opened)

    transport = RosTransport("ros1:", lambda _hub: Watched(network))
    async with r2p.Module("PC1", via=transport):
        seen.append(REAL_TIME.get())
    assert seen == [True, False]


def test_a_master_is_asked_while_the_simulator_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registration, "POLL_S", 0.01)

    async def main() -> None:
        asked, often = Counter[str](), asyncio.Event()

        def answer(method: str, _arguments: list[Value]) -> object:
            asked[method] += 1
            if asked["getSystemState"] >= 3:
                often.set()
            return [1, "", [[], [], []] if method == "getSystemState" else [] if method == "getTopicTypes" else 1]

        clock = clock_of()
        assert isinstance(clock, SteeredClock)
        clock.follow(SIMULATED, lambda: True)  # and from now on it stands still
        master = XmlRpcServer("127.0.0.1", answer, Counter())
        await master.start()
        REAL_TIME.set(True)  # as of each link to ROS
        async with running(f"http://127.0.0.1:{master.port}"), asyncio.timeout(5.0):
            await often.wait()
        await master.close()

    r2p.sim.run(main, follow=True)
