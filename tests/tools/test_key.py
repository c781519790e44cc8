"""`r2p key`, and what tools print where a key is missing or wrong."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest
from typer.testing import CliRunner

import r2p
from r2p import keys
from r2p.tools.key import app
from r2p.tools.module import reboot
from r2p.tools.session import Settings, join, while_connected
from r2p.transports.tcp import TcpListenTransport
from r2p.transports.url import parse
from tests.transports.cables import GUARD

if TYPE_CHECKING:
    from pathlib import Path


def new_key(path: Path) -> str:
    keys.create(path)
    return f"?key={path}"


def test_key_new_makes_a_file_once(tmp_path: Path) -> None:
    file = tmp_path / "robot.key"
    made = CliRunner().invoke(app, ["new", str(file)])
    assert made.exit_code == 0
    assert f"{file} has a new key" in made.output.replace("\n", " ")
    assert keys.load(str(file)).id
    again = CliRunner().invoke(app, ["new", str(file)])
    assert again.exit_code == 1
    assert "exists already" in again.output


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    ("given", "reason"), [("", "lacks the key of the link"), ("?key=", "another key than this URL")]
)
async def test_a_command_without_the_key_fails_within_a_second_with_the_reason(
    tmp_path: Path, given: str, reason: str
) -> None:
    key = new_key(tmp_path / "robot.key")
    via = "memory:lab" + (new_key(tmp_path / "other.key") if given else "")
    async with r2p.Module("BOT", via="memory:lab" + key), join(Settings(via=[via])) as session:
        async with asyncio.timeout(1):
            with pytest.raises(r2p.Error, match=f"BOT refuses REBOOT: .*{reason}"):
                await reboot(session, "BOT")
        async with join(Settings(via=["memory:lab" + key])) as with_key:
            await reboot(with_key, "BOT")


@pytest.mark.anyio
@pytest.mark.parametrize("given", ["", "?key="])
async def test_a_tool_without_the_key_of_a_server_ends_with_the_reason(
    tmp_path: Path, given: str, caplog: pytest.LogCaptureFixture
) -> None:
    server = TcpListenTransport(parse("tcp-listen:127.0.0.1:0" + new_key(tmp_path / "robot.key")))
    async with asyncio.timeout(GUARD), r2p.Module("BOT", via=server, watchdog=False):
        url = f"tcp:127.0.0.1:{server.port}" + (new_key(tmp_path / "other.key") if given else "")
        with pytest.raises(BaseExceptionGroup) as raised:
            async with join(Settings(via=[url])) as session:
                await while_connected(session, asyncio.get_running_loop().create_future())
    assert raised.group_contains(r2p.TransportError, match=f"no connection on {url}".replace("?", r"\?"))
    assert ("the other end has another key" if given else "the other end wants a key") in caplog.text
