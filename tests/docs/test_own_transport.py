"""The transport of the how-to, as a user would install it: found by its entry point, and used between two modules."""

import asyncio
import importlib
import socket
import sys
from pathlib import Path

import pytest

import r2p
from r2p.msg import Led
from r2p.transports.url import schemes
from tests.docs.blocks import ROOT, of_page
from tests.ports import free_port

PAGE = ROOT / "docs" / "how-to" / "own-transport.md"


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A directory on the path that looks like an installed package."""
    code = next(block for block in of_page(PAGE) if block.title == "r2p_udp.py")
    entry = next(block for block in of_page(PAGE) if block.language == "toml")
    assert entry.text == '[project.entry-points."r2p.transports"]\nudp = "r2p_udp:UdpTransport"\n'
    (tmp_path / code.title).write_text(code.text)
    info = tmp_path / "r2p_udp-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: r2p-udp\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[r2p.transports]\nudp = r2p_udp:UdpTransport\n")
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    monkeypatch.delitem(sys.modules, "r2p_udp", raising=False)


@pytest.mark.anyio
@pytest.mark.usefixtures("installed")
async def test_it_connects_two_modules() -> None:
    here, there = free_port(), free_port()
    assert "udp" in schemes()
    arrived: asyncio.Future[Led] = asyncio.get_running_loop().create_future()

    async def blink(node: r2p.Node) -> None:
        leds = node.advertise("leds", Led)
        await leds.wait_subscriber()
        await leds.publish(Led(3, 1))

    async def watch(node: r2p.Node) -> None:
        arrived.set_result(await node.subscribe("leds", Led).fetch())

    async with (
        asyncio.timeout(20),
        r2p.Module("A", via=f"udp:127.0.0.1:{there},listen={here}") as a,
        r2p.Module("B", via=f"udp:127.0.0.1:{here},listen={there}") as b,
    ):
        b.start(watch)
        a.start(blink)
        assert await arrived == Led(3, 1)


@pytest.mark.usefixtures("installed")
def test_what_waiting_cannot_mend_is_an_error_that_says_what() -> None:
    async def main(via: str) -> None:
        async with r2p.Module("A", via=via):
            pass

    with socket.socket(type=socket.SOCK_DGRAM) as taken:
        taken.bind(("0.0.0.0", 0))
        port = taken.getsockname()[1]
        with pytest.raises(r2p.TransportError, match=f"udp:127.0.0.1:{port}"):
            asyncio.run(main(f"udp:127.0.0.1:{port}"))
    with pytest.raises(r2p.TransportError, match="write udp:HOST:PORT"):
        asyncio.run(main("udp:7000"))
