"""Two names with one alias on a link that carries aliases: an error with both, and never a message of the other one."""

from __future__ import annotations

import asyncio
import logging

import pytest

import r2p
from r2p.msg import Led
from r2p.names import module_alias, topic_alias
from r2p.testing.network import Network, node_in

pytestmark = pytest.mark.virtual_time

ONE, OTHER = "front_left_wheel/velocity1421", "front_left_wheel/velocity1927"
WHEEL, OTHER_WHEEL = "front_wheel_1525", "front_wheel_2621"


def errors(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage().partition(": ")[2] for record in caplog.records if record.levelno == logging.ERROR]


async def test_topics_of_two_modules(caplog: pytest.LogCaptureFixture) -> None:
    net = Network()
    alias = topic_alias(ONE)
    async with net.module("A") as a, node_in(a) as alice:
        async with net.module("B") as b, node_in(b) as bob:
            publisher, subscriber = alice.advertise(ONE, Led, latch=True), bob.subscribe(OTHER, Led)
            for _ in range(20):
                await publisher.publish(Led(led=1))
                await asyncio.sleep(0.1)
            assert not subscriber.queue
            assert (publisher.subscribers, subscriber.publishers) == (0, 0)
            assert sorted(errors(caplog)) == [
                f"topics {ours} and {theirs} have one alias, {alias}: choose another one for either, in [alias] of "
                f"r2p.toml, or with aliases= of Module; until then, {ours} is not carried"
                for ours, theirs in ((ONE, OTHER), (OTHER, ONE))
            ]
        await asyncio.sleep(70)
        async with net.node("C") as carol:  # B is gone, and A is heard again
            subscriber = carol.subscribe(ONE, Led)
            assert await subscriber.fetch(5.0) == Led(led=1)


async def test_topics_of_one_module(caplog: pytest.LogCaptureFixture) -> None:
    net = Network()
    async with net.module("A") as a, net.node("B") as bob, node_in(a) as alice:
        one, other = alice.advertise(ONE, Led), alice.advertise(OTHER, Led)
        here, there = alice.subscribe(OTHER, Led), bob.subscribe(ONE, Led)
        await one.wait_subscriber()
        await other.publish(Led(led=2))
        await one.publish(Led(led=1))
        assert await here.fetch(1.0) == Led(led=2)  # within the module names are whole
        assert await there.fetch(1.0) == Led(led=1)
        (error,) = errors(caplog)
        assert error.startswith(f"topics {ONE} and {OTHER} have one alias")
        assert error.endswith(f"{OTHER} is not carried")
        there.close()
        one.close()
        late = bob.subscribe(OTHER, Led)  # it has the alias for itself now
        await asyncio.sleep(2)
        await other.publish(Led(led=3))
        assert await late.fetch(1.0) == Led(led=3)


async def test_an_alias_that_is_chosen_keeps_them_apart(caplog: pytest.LogCaptureFixture) -> None:
    aliases = {OTHER: "velocity_2"}
    async with (
        r2p.Module("A", via="memory:lab", aliases=aliases) as a,
        r2p.Module("B", via="memory:lab", aliases=aliases) as b,
        node_in(a) as alice,
        node_in(b) as bob,
    ):
        one, other = alice.advertise(ONE, Led), alice.advertise(OTHER, Led)
        first, second = bob.subscribe(ONE, Led), bob.subscribe(OTHER, Led)
        for number, publisher in enumerate((one, other)):
            await publisher.wait_subscriber()
            await publisher.publish(Led(led=number))
        assert (await first.fetch(1.0), await second.fetch(1.0)) == (Led(led=0), Led(led=1))
        assert not errors(caplog)


async def test_modules(caplog: pytest.LogCaptureFixture) -> None:
    net = Network()
    async with net.module("PC1") as pc, net.module(WHEEL) as wheel, net.module(OTHER_WHEEL) as other:
        await asyncio.sleep(2)
        found = f"have one alias, {module_alias(WHEEL)}: rename one (--module)"
        assert len([each for each in errors(caplog) if each.endswith(found)]) == 3
        for name in (WHEEL, OTHER_WHEEL):
            with pytest.raises(r2p.Error, match=f"have one alias, {module_alias(WHEEL)}: both would obey"):
                pc.command(r2p.Command.STOP, name)
        assert (wheel.stopped, other.stopped) == (False, False)
