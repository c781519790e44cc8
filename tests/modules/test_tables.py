"""The tables of a link are as large as its URL says, and what does not fit is reported."""

import asyncio
from collections.abc import AsyncIterator

import pytest

import r2p
from r2p.msg import Led
from r2p.testing.network import node_in
from tests.ports import free_port
from tests.transports.test_conformance import until

pytestmark = pytest.mark.anyio

_TEXT = (
    "there are more topics, modules or endpoints than fit into a table of 3, and those that are silent for longest are "
    "forgotten: topics=6 in the URL makes room for more"
)


async def _notice_of_full_table(events: AsyncIterator[r2p.ModuleEvent]) -> r2p.LinkNotice:
    return await anext(each async for each in events if isinstance(each, r2p.LinkNotice) and each.kind == "table full")


@pytest.mark.parametrize(
    ("server", "client"),
    [
        pytest.param("memory:lab?topics=3", "memory:lab", marks=pytest.mark.virtual_time, id="memory"),
        pytest.param("sim:lab?topics=3", "sim:lab", marks=pytest.mark.virtual_time, id="sim"),
        pytest.param("tcp-listen:127.0.0.1:{0}?topics=3", "tcp:127.0.0.1:{0}", id="tcp-listen"),
        pytest.param("tcp-listen:127.0.0.1:{0}", "tcp:127.0.0.1:{0}?topics=3", id="tcp"),
    ],
)
async def test_the_url_says_how_many_topics_are_kept(server: str, client: str) -> None:
    port = free_port()
    async with (
        asyncio.timeout(60),
        r2p.Module("A", via=server.format(port), watchdog=False) as a,
        r2p.Module("B", via=client.format(port), watchdog=False) as b,
    ):
        small, other = (a, b) if "topics" in server else (b, a)
        events = small.events()
        async with node_in(other) as node:
            for number in range(5):
                node.advertise(f"leds{number}", Led)
            assert (await _notice_of_full_table(events)).text == _TEXT
            (link,) = small.links
            await until(lambda: link.losses["topics forgotten"] > 1)
            assert len(link.discovery.topics) == 3
