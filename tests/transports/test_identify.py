"""What a server speaks at whose port a URL for something else points."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import cast

import pytest

import r2p
from r2p.sim.modules import FirmwareModule, Powered
from r2p.transports import identify, tcp
from r2p.transports.identify import Server, ServerKind, identify_server
from tests.ports import free_port
from tests.transports.test_conformance import first
from tests.transports.zenoh.authority import Authority
from tests.transports.zenoh.cable import Net, guarded, module

pytestmark = pytest.mark.anyio


@asynccontextmanager
async def program(greeting: bytes) -> AsyncIterator[int]:
    """A program at a port, which sends a greeting, and no answer to what it receives."""
    served: list[asyncio.Task[None]] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        served.append(cast("asyncio.Task[None]", asyncio.current_task()))
        with contextlib.suppress(OSError):
            writer.write(greeting)
            await reader.read()
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()

    async with await asyncio.start_server(serve, "127.0.0.1") as server:
        yield server.sockets[0].getsockname()[1]
        await asyncio.gather(*served)


@guarded
async def test_each_kind(tmp_path: Path) -> None:
    port, net, authority = free_port(), Net(), Authority(tmp_path / "ca")
    certificate, key = authority.sign("router")
    config = tmp_path / "tls.json5"
    config.write_text(f"""{{transport: {{link: {{tls: {{
        listen_certificate: "{certificate}", listen_private_key: "{key}"}}}}}}}}""")
    secure = f"zenoh:?mode=router&listen=tls/127.0.0.1:{free_port()}&scouting=off&network=lab&config={config}"
    async with (
        module("LINE", f"tcp-listen:{port}"),
        module("ROUTER", net.listen),
        module("SECURE", secure),
        Powered(FirmwareModule("IMU1")) as board,
    ):
        assert (await identify_server("127.0.0.1", port)).kind is ServerKind.DEBUG_LINE
        assert (await identify_server(*await board.listen())).kind is ServerKind.DEBUG_LINE
        assert (await identify_server("127.0.0.1", net.port)).kind is ServerKind.ZENOH
        tls_port = int(secure.partition("127.0.0.1:")[2].partition("?")[0].partition("&")[0])
        assert (await identify_server("127.0.0.1", tls_port)).kind is ServerKind.TLS


@guarded
async def test_others(monkeypatch: pytest.MonkeyPatch) -> None:
    async with program(b"SSH-2.0-OpenSSH_9.2\r\n") as port:
        monkeypatch.setattr(identify, "_TIMEOUT_S", 0.1)
        server = await identify_server("127.0.0.1", port)
        assert (server.kind, server.first_line) == (ServerKind.UNKNOWN, "SSH-2.0-OpenSSH_9.2")
    async with program(b"") as port:
        assert await identify_server("127.0.0.1", port) == Server(ServerKind.UNKNOWN, b"")
    assert Server(ServerKind.UNKNOWN, b"\xff\xfd\x18\r\n").first_line == ""


@guarded
async def test_a_zenoh_url_to_a_debug_line_says_so_before_zenoh_gives_up() -> None:
    port = free_port()
    lost = module("B", f"zenoh:tcp/127.0.0.1:{port}?scouting=off")
    events = lost.events()
    async with module("A", f"tcp-listen:{port}"), lost:
        reason = (await first(events, r2p.LinkWaits)).reason
    assert reason == (
        f"127.0.0.1:{port} is a debug line, not zenoh: connect by tcp:127.0.0.1:{port}, or to the router's port"
    )


@guarded
async def test_a_url_of_the_debug_line_to_zenoh_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp, "_SILENT_S", 0.01)
    net = Net()
    lost = module("B", f"tcp:127.0.0.1:{net.port}")
    events = lost.events()
    async with module("A", net.listen), lost:
        notice = await first(events, r2p.LinkNotice)
    where = f"127.0.0.1:{net.port}"
    assert notice.text == f"{where} is zenoh, not a debug line: connect by zenoh:tcp/{where}"
