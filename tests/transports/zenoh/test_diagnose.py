"""What a link says that can't be, or that leads nowhere: in words, with what to do."""

import importlib
import re
import socket

import pytest

import r2p
from r2p.transports.url import open_transport
from r2p.transports.zenoh import transport
from r2p.transports.zenoh.diagnose import ConnectionSettings, diagnose_connection, diagnose_listening
from r2p.transports.zenoh.session import ZenohSession
from tests.transports.test_conformance import first, until
from tests.transports.zenoh.cable import Net, guarded, module

pytestmark = pytest.mark.anyio

NOWHERE = "nosuch.invalid"  # RFC 2606: no computer is ever called so
FAR = "192.0.2.1"  # RFC 5737: an address for documentation


def tool(name: str, via: str) -> r2p.Module:
    return r2p.Module(name, via=via, observer=True, watchdog=False)


@guarded
async def test_a_port_in_use() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(r2p.TransportError, match=f"^zenoh: can't listen at 127.0.0.1:{port}: the port is in use"):
            async with module("B", f"zenoh:?listen=tcp/127.0.0.1:{port}&scouting=off"):
                pass


@pytest.mark.parametrize(
    ("endpoint", "says"),
    [
        (f"tcp/{NOWHERE}:7447", f"^{NOWHERE} is not the name of a known computer"),
        (f"udp/{FAR}:7447", f"^can't listen at {FAR}:7447: this computer has no address {FAR}"),
        ("tcp/127.0.0.1:0#iface=nosuch0", "^there is no network interface nosuch0 here: there are .*lo"),
        ("tcp/[::1]:0", "^$"),
        ("unixsock-stream//tmp/nothing", "^$"),
    ],
)
async def test_addresses_that_cannot_be_listened_on(endpoint: str, says: str) -> None:
    assert re.search(says, diagnose_listening(ConnectionSettings([], listens=[endpoint])))


async def test_the_port_of_datagrams_is_another_one() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert "in use" in diagnose_listening(
            ConnectionSettings([], listens=["tcp/127.0.0.1:0", f"ws/127.0.0.1:{port}"])
        )
        assert not diagnose_listening(ConnectionSettings([], listens=[f"udp/127.0.0.1:{port}"]))


@pytest.mark.parametrize(
    ("endpoint", "says"),
    [
        (f"tcp/{NOWHERE}:7447", f"{NOWHERE} is not the name of a known computer"),
        ("tcp/127.0.0.1:7447#iface=nosuch0", "there is no network interface nosuch0 here"),
    ],
)
async def test_addresses_that_cannot_be_connected_to(endpoint: str, says: str) -> None:
    assert says in await diagnose_connection(ConnectionSettings([endpoint]))


@guarded
@pytest.mark.parametrize("observer", [True, False])
async def test_alone_on_a_network_while_others_are_elsewhere(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, observer: bool
) -> None:
    caplog.set_level("INFO")
    monkeypatch.setattr(transport, "_ALONE_S", 0.01)
    robot = Net("robot1")
    wrong = robot.join.replace(robot.name, "robot2")
    lonely = tool("_b", wrong) if observer else module("B", wrong)
    events = lonely.events()
    async with module("A", robot.listen), tool("_c", wrong), lonely:
        notice = await first(events, r2p.LinkNotice)
    expected = "no other module is on the network robot2, but there are modules on robot1: is ?network=robot1 meant?"
    assert (notice.kind, notice.text) == ("elsewhere", expected)
    levels = {each.levelname for each in caplog.records if expected in each.getMessage()}
    assert ("WARNING" in levels) != observer, "a program without a handler shows warnings only"


@guarded
async def test_tools_are_no_company_and_no_place_to_go(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tool on a network of a wrong name is not where another one should be."""
    monkeypatch.setattr(transport, "_ALONE_TOOL_S", 0.01)
    monkeypatch.setattr(transport, "_ALONE_MAX_S", 0.01)
    looks: list[bool] = []
    networks = ZenohSession.find_networks

    async def look(session: ZenohSession, *, tools: bool) -> set[str]:
        looks.append(tools)
        return await networks(session, tools=tools)

    monkeypatch.setattr(ZenohSession, "find_networks", look)
    net = Net("robot1")
    first_tool, second_tool = tool("_one", net.listen), tool("_two", net.join.replace(net.name, "typo"))
    told = first_tool.events()
    async with first_tool, second_tool:
        before = len(looks)
        await until(lambda: len(looks) > before + 6)
    assert [each async for each in told if isinstance(each, r2p.LinkNotice)] == []


@guarded
async def test_a_library_that_is_broken_is_not_called_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_name: str) -> None:
        raise ImportError("libsomething.so.1: cannot open", name="_native")

    zenoh = open_transport("zenoh:?scouting=off")
    monkeypatch.setattr(importlib, "import_module", broken)
    with pytest.raises(ImportError, match="libsomething"):
        async with r2p.Module("A", via=zenoh, watchdog=False):
            pass
