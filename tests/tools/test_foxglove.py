"""`r2p foxglove`: where it listens, who may connect, and what it says."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import urllib.request
from typing import TYPE_CHECKING, Any

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus
from websockets.typing import Origin, Subprotocol

from r2p.errors import WebError
from r2p.msg import Led
from r2p.tools.foxglove import foxglove
from r2p.tools.session import Settings, UsageError
from r2p.tools.types import Types
from tests.tools.rig import robot, tool

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import r2p
    from r2p.tools.session import Session

pytestmark = pytest.mark.anyio

SUBPROTOCOLS = [Subprotocol("foxglove.websocket.v1")]


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return "asyncio", {"use_uvloop": True}


class Printed:
    """What the command prints for its user."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys
        self.text = ""

    async def find(self, pattern: str) -> str:
        """Wait until it has printed this."""
        async with asyncio.timeout(60):
            while not (found := re.search(pattern, self.text)):
                self.text += self._capsys.readouterr().err
                await asyncio.sleep(0.01)
        return found[1] if found.re.groups else found[0]


@contextlib.asynccontextmanager
async def running(session: Session, **options: Any) -> AsyncIterator[None]:
    serving = asyncio.create_task(foxglove(session, port=0, **options))
    try:
        yield
    finally:
        serving.cancel()
        await asyncio.wait([serving])


async def lights(node: r2p.Node) -> None:
    leds = node.advertise("leds", Led)
    async for _ in node.every(0.01):
        await leds.publish(Led(3))


async def test_a_viewer_connects_and_other_pages_are_refused_unless_they_are_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    printed = Printed(capsys)
    async with robot(lights), tool(verbose=1) as session:
        async with running(session, origin=["https://lichtblick.example:8080/"]):
            url = await printed.find(
                r"connect Foxglove, Lichtblick or PlotJuggler to (ws://127.0.0.1:\d+/); Ctrl-C ends"
            )
            for origin in (None, "https://app.foxglove.dev", "file://", "https://lichtblick.example:8080"):
                async with connect(url, subprotocols=SUBPROTOCOLS, origin=Origin(origin) if origin else None) as viewer:
                    info = json.loads(await viewer.recv())
                    assert (info["op"], info["name"]) == ("serverInfo", "r2p on memory:lab")
            with pytest.raises(InvalidStatus):
                async with connect(url, subprotocols=SUBPROTOCOLS, origin=Origin("https://example.com")):
                    pass
            await printed.find("a page of https://example.com was refused: --origin https://example.com lets it in")
            page = await asyncio.to_thread(_read, url.replace("ws:", "http:"))
            assert "open a Foxglove WebSocket connection" in page
        assert await printed.find("refused: origin") is not None


def _read(url: str) -> str:
    with urllib.request.urlopen(url) as answer:
        text: str = answer.read().decode()
    return text


async def test_a_port_that_is_in_use_is_an_error_that_says_what_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session, running(session):
        url = await Printed(capsys).find(r"ws://127.0.0.1:(\d+)/")
        with pytest.raises(WebError, match="choose another --port, or 0 for a free one"):
            await foxglove(session, port=int(url))


@pytest.mark.parametrize("origin", ["lichtblick.example", "https://", "https://a.example/path", "https://a.example?x"])
async def test_an_origin_that_is_none_is_a_usage_error(origin: str) -> None:
    async with tool() as session:
        with pytest.raises(UsageError, match="write scheme and host of the page"):
            await foxglove(session, port=0, origin=[origin])


async def test_types_are_those_of_the_settings() -> None:
    types = {"leds": "Led", "reset": "std_srvs/Trigger"}
    found = Types(Settings(types=types)).stated_topics()
    assert found["leds"] is Led
    assert found.keys() == {"leds", "reset_q", "reset_r"}
