"""Waiting until a topic, node or module is seen on the network."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.codecs import management
from r2p.msg import Led
from r2p.tools.session import Session, Settings, TimedOut, UsageError
from r2p.tools.waiting import appeared, wait
from tests.tools.rig import Firmware, robot, tool

if TYPE_CHECKING:
    from r2p.tools.waiting import Kind

pytestmark = pytest.mark.virtual_time


async def leds(node: r2p.Node) -> None:
    node.advertise("leds", Led)
    await asyncio.Event().wait()


async def lamps(node: r2p.Node) -> None:
    node.subscribe("lamps", Led)
    await asyncio.Event().wait()


async def is_seen(session: Session, kind: Kind, name: str) -> bool:
    try:
        async with asyncio.timeout(5.0):
            await appeared(session, kind, name)
    except TimeoutError:
        return False
    return True


@pytest.mark.parametrize(
    ("kind", "name", "seen"),
    [
        ("topic", "leds", True),
        ("topic", "lamps", True),
        ("topic", "other", False),
        ("node", "leds", True),
        ("node", "BOT/leds", True),
        ("node", "BOT2/leds", False),
        ("node", "other", False),
        ("module", "BOT", True),
        ("module", "OTHER", False),
    ],
)
async def test_what_is_there_is_seen(kind: Kind, name: str, *, seen: bool) -> None:
    async with robot(leds, lamps), tool() as session:
        assert await is_seen(session, kind, name) == seen


async def test_what_comes_later_is_seen_when_it_comes() -> None:
    async with tool() as session, asyncio.TaskGroup() as tasks:
        waiting = tasks.create_task(appeared(session, "topic", "leds"))
        await asyncio.sleep(60)
        assert not waiting.done()
        async with robot(leds):
            await asyncio.sleep(1)
            assert waiting.done()


async def test_firmware_that_only_subscribes_is_seen() -> None:
    async with tool() as session:
        board = Firmware()
        board.send(management.SubscribeRequest("leds", 5, 1))
        assert await is_seen(session, "topic", "leds")


async def test_subscriptions_of_tools_do_not_count() -> None:
    async with tool() as session, tool() as other:
        other.node.subscribe("leds", Led)
        session.node.subscribe("leds", Led)
        assert not await is_seen(session, "topic", "leds")
        assert not await is_seen(session, "node", "tool")
        assert await is_seen(session, "module", other.module.name)


@pytest.mark.parametrize(
    ("kind", "name"), [("topic", "a-b"), ("node", "BOT/a-b"), ("node", "a-b/x"), ("module", "a b")]
)
async def test_a_name_that_is_not_valid_is_an_error(kind: Kind, name: str) -> None:
    async with tool() as session:
        with pytest.raises(r2p.InvalidName):
            await appeared(session, kind, name)


# The command


async def test_it_ends_when_the_module_is_there(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session, asyncio.TaskGroup() as tasks:
        waiting = tasks.create_task(wait(session, "module", "BOT", timeout=60.0))
        await asyncio.sleep(30)
        assert not waiting.done()
        async with robot():
            await asyncio.sleep(1)
            assert waiting.done()
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "r2p: waiting for module BOT on memory:lab\n")


@pytest.mark.parametrize(("kind", "name", "close"), [("module", "BOAT", "BOT"), ("node", "BOT/long", "BOT/log")])
async def test_it_times_out_with_a_name_that_is_there(kind: Kind, name: str, close: str) -> None:
    async with robot(), tool() as session:
        with pytest.raises(TimedOut, match=rf"no {kind} {name} on memory:lab within 2 s; did you mean {close}\?"):
            await wait(session, kind, name, timeout=2.0)


async def test_usage() -> None:
    async with tool() as session:
        with pytest.raises(r2p.InvalidName):
            await wait(session, "topic", "a b")
    async with r2p.Module("_tool01", via=[], observer=True) as module:
        with pytest.raises(UsageError, match="give --via"):
            await wait(Session(module, Settings()), "module", "BOT")
