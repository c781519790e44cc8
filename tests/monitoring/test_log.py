"""The log of a network, as a tool follows it."""

import asyncio
import logging

import pytest
from hypothesis import given
from hypothesis import strategies as st

import r2p
from r2p.monitoring.log import RECORDS_MAX, LogEntry, LogFollower, log_entry
from r2p.msg import Log
from r2p.testing.network import Network, node_in
from tests.transports.rtcan.networks import until

pytestmark = pytest.mark.virtual_time


async def test_records_of_all_modules_and_of_a_robot_behind_a_gateway() -> None:
    robot, lab = Network(), Network()
    options = r2p.BridgeOptions(prefix="robot1/", prefix_on=("memory:lab",))
    async with (
        r2p.Module("GW", via=[robot.transport("robot"), lab.transport("lab")], bridge=options, watchdog=False),
        robot.node("LONG_NAMED", name="wheels") as wheels,
        lab.node("BASE", name="arm") as arm,
        lab.module("PC", observer=True) as pc,
        LogFollower(pc) as log,
    ):
        heard: list[LogEntry] = []
        log.listeners.append(heard.append)
        await until(lambda: any(name.endswith("/log") for name in pc.network.topics()))
        await asyncio.sleep(3.0)
        wheels.log.error("stuck")
        arm.log.info("ready")
        await until(lambda: log.received >= 2)
    assert {(each.module, each.node, each.level, each.text) for each in heard} == {
        ("robot1/LONG_NAMED", "wheels", logging.ERROR, "stuck"),
        ("BASE", "arm", logging.INFO, "ready"),
    }
    assert list(log.records) == heard


async def test_a_flood_keeps_the_newest_records() -> None:
    network = Network()
    async with network.node("LOUD") as node, network.module("PC", observer=True) as pc, LogFollower(pc) as log:
        publisher = node.advertise("robot1/log", Log)
        await until(lambda: "robot1/log" in pc.network.topics())
        await asyncio.sleep(3.0)
        for number in range(RECORDS_MAX + 7):
            await publisher.publish(Log(level=255, module="X", text=f"{number}"))
        await until(lambda: log.received == RECORDS_MAX + 7)
        assert [each.text for each in log.records] == [f"{number}" for number in range(7, RECORDS_MAX + 7)]
        assert log.records[0].module == "robot1/X"
        assert log.records[0].stamp > 0


async def test_a_topic_of_that_name_with_another_type_is_left_alone(caplog: pytest.LogCaptureFixture) -> None:
    network = Network()
    async with network.module("PC", observer=True) as pc, node_in(pc) as node:
        node.advertise("log", r2p.msg.Led)
        async with LogFollower(pc) as log:
            await asyncio.sleep(2.0)
            assert log.received == 0
    assert "the log has no log" in caplog.text


@given(st.text(max_size=7), st.text(max_size=90), st.text(max_size=17))
def test_any_names_make_a_record(module: str, sender: str, namespace: str) -> None:
    entry = log_entry(Log(module=module.encode("ascii", "replace").decode()), sender, 5, namespace)
    assert entry.stamp == 5
