"""Pages that ask for too much: what they get is bounded, and other pages and nodes go on."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r2p.msg import Led
from r2p.testing.network import Network
from r2p.web.client import QUEUE_BYTES
from r2p.web.dash import protocol
from r2p.web.dash.session import REQUEST_RATE, REQUESTS_MAX
from r2p.web.dash.source import PLOTS_MAX, WATCHES_MAX
from tests.transports.rtcan.networks import until
from tests.web.rig import FakePage, live, open_page

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import r2p
    from r2p.web.dash.live import LiveSource

pytestmark = pytest.mark.virtual_time


@contextlib.asynccontextmanager
async def robot(**allowed: bool) -> AsyncIterator[tuple[r2p.Publisher[Led], LiveSource]]:
    """A robot that publishes leds, and the source of pages of a module beside it."""
    network = Network()
    async with network.node("ROBOT") as node, network.module("PC", observer=True) as pc:
        leds = node.advertise("leds", Led)
        async with live(pc, **allowed) as source:
            await until(lambda: "leds" in pc.network.topics())
            await asyncio.sleep(2.0)
            yield leds, source


@settings(max_examples=50)
@given(st.one_of(st.binary(), st.text(), st.recursive(st.none() | st.text(), st.lists).map(msgspec.json.encode)))
def test_no_bytes_are_a_request_by_chance(data: str | bytes) -> None:
    with pytest.raises((msgspec.DecodeError, UnicodeDecodeError)):
        protocol.decode(data)


@pytest.mark.parametrize(
    "message",
    [
        "",
        "nonsense",
        "[" * 100_000,
        '{"op": "publish", "id": 1, "topic": "leds", "value": {"led": ' + "[" * 100_000,
        b"\xff\xfe",
        '{"op": "unheard-of", "id": 1}',
        '{"op": "plot", "id": 1}',
        '{"op": "plot", "id": 1, "stream": 1, "fields": ["leds.led"], "points": 1e999}',
        '{"op": "plot", "id": "x", "stream": 1, "fields": []}',
    ],
)
async def test_what_is_no_request_is_answered_and_counted(message: str | bytes) -> None:
    async with robot() as (_, source), open_page(source) as page:
        page.connection.receive(message)
        await until(lambda: [each for each in page.messages if "error" in each])
        assert source.refused == {"malformed request": 1}
        assert await page.result("watch", topic="leds") is None


@pytest.mark.parametrize("stream", [-1, 1 << 16, 1 << 80])
async def test_numbers_of_streams_are_those_of_points(stream: int) -> None:
    async with robot() as (_, source), open_page(source) as page:
        page.connection.receive(msgspec.json.encode({"op": "plot", "id": 1, "stream": stream, "fields": ["leds.led"]}))
        await until(lambda: [each for each in page.messages if "error" in each])
        assert not source.feeds._feeds


async def test_thousands_of_plots_and_watches_are_refused_beyond_a_limit() -> None:
    async with robot() as (leds, source), open_page(source) as page:
        for stream in range(200):
            page.begin("plot", stream=stream, fields=["leds.led"])
            page.begin("watch", topic=f"nothing{stream}")
        await until(lambda: len([each for each in page.messages if "id" in each]) == 400)
        assert len([each for each in page.messages if "result" in each]) == PLOTS_MAX
        assert list(source.feeds._feeds) == ["leds"]
        assert PLOTS_MAX == WATCHES_MAX == 64
        assert leds.subscribers == 1


async def test_fields_of_one_topic_are_limited_over_all_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("r2p.web.dash.feeds.PATHS_MAX", 1)
    async with robot() as (_, source), open_page(source) as page, open_page(source) as other:
        await page.result("plot", stream=1, fields=["leds.led"])
        await other.result("plot", stream=1, fields=["leds.led"])
        error = await other.error("plot", stream=2, fields=["leds.value"])
        assert error == "all pages together plot at most 1 fields of leds: close some plots"


async def test_what_a_page_asked_for_ends_with_it() -> None:
    async with robot(publish=True) as (leds, source):
        async with open_page(source) as page:
            await page.result("plot", stream=1, fields=["leds.led"])
            await page.result("watch", topic="leds")
            await page.result("log", level="DEBUG")
            await page.result("publish", topic="leds", value={}, rate=100)
            assert leds.subscribers
            assert source.feeds.node.publishers
        assert not source.feeds._feeds
        assert not source.feeds.node.publishers
        assert source.log._follower is None
        await until(lambda: not leds.subscribers)


async def test_requests_that_are_never_answered_are_bounded() -> None:
    async with robot() as (_, source), open_page(source) as page:
        never = asyncio.get_running_loop().create_future()
        source.feeds.find_type = lambda *_arguments: asyncio.shield(never)  # type: ignore[method-assign, assignment]
        for _ in range(100):
            page.begin("describe", topic="leds")
        await until(lambda: len([each for each in page.messages if "error" in each]) == 100 - REQUESTS_MAX)
        assert source.refused["too many requests"] == 100 - REQUESTS_MAX
        never.cancel()


async def test_plots_that_change_while_a_type_is_looked_up_leave_nothing_behind() -> None:
    async with robot() as (leds, source), open_page(source) as page:
        for _ in range(20):
            page.begin("plot", stream=1, fields=["leds.led"])
            page.begin("stop_plot", stream=1)
        assert await page.result("plot", stream=1, fields=["leds.led"]) is None
        assert await page.result("stop_plot", stream=1) is None
        assert not source.feeds._feeds
        assert source.refused["too many requests"] == 0
        await until(lambda: not leds.subscribers)


async def test_a_flood_of_publishing_waits_and_what_others_publish_does_not() -> None:
    async with robot(publish=True) as (leds, source), open_page(source) as flooding, open_page(source) as other:
        loop = asyncio.get_running_loop()
        await other.result("plot", stream=1, fields=["leds.led"])
        begin = loop.time()
        for _ in range(600):
            flooding.begin("publish", topic="flood", type="r2p_msgs/Led", value={})
        sent = 0
        while len([each for each in flooding.messages if "id" in each]) < 600:
            await leds.publish(Led(sent))
            sent += 1
            await asyncio.sleep(0.01)
        assert loop.time() - begin >= (600 - REQUEST_RATE) / REQUEST_RATE - 1, "it was made to wait"
        await asyncio.sleep(0.1)
        assert _points(other) == sent


def _points(page: FakePage) -> int:
    return sum(struct.unpack_from("<BBHI", each)[3] for each in page.points)


async def test_a_page_that_does_not_read_costs_a_bounded_queue_and_no_other_page_a_point() -> None:
    async with robot() as (leds, source), open_page(source) as slow, open_page(source) as other:
        for page in (slow, other):
            await page.result("plot", stream=1, fields=["leds.led"] * 60)
            await page.result("watch", topic="leds")
        await asyncio.sleep(1.0)
        slow.connection.reads.clear()
        before = _points(slow)
        count = 20_000
        for number in range(count):
            await leds.publish(Led(number))
            if number % 100 == 0:
                await asyncio.sleep(0.01)
        await asyncio.sleep(1.0)
        assert _points(other) == count
        assert slow.client._bytes <= QUEUE_BYTES
        slow.connection.reads.set()
        await asyncio.sleep(3.0)
        dropped = slow.news("dropped")[-1]["streams"]
        assert dropped == slow.client.dropped
        assert dropped["plot 1"] == count - (_points(slow) - before) > 0
        assert not other.client.dropped


async def test_a_page_that_does_not_read_gets_states_that_are_right_and_not_many() -> None:
    async with robot() as (_, source), open_page(source) as slow, open_page(source) as other:
        await until(lambda: slow.news("state") and other.news("state"))
        slow.connection.reads.clear()
        await asyncio.sleep(100.0)
        slow.connection.reads.set()
        await asyncio.sleep(5.0)
        assert _tables(slow) == _tables(other)


def _tables(page: FakePage) -> dict[str, dict[str, Any]]:
    """The tables that a page has, after all of its states."""
    tables: dict[str, dict[str, Any]] = {}
    for state in page.news("state"):
        for table, rows in state["changed"].items():
            tables.setdefault(table, {}).update(rows)
        for table, keys in state["gone"].items():
            for key in keys:
                del tables[table][key]
    return tables
