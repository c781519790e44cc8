"""The configurations of zenoh in the pages: zenoh loads each, and together they do what the page says, with real
certificates.
"""

import re
from pathlib import Path

import pytest
import zenoh

import r2p
from r2p.msg import Led
from r2p.runtime.events import LinkNotice
from r2p.testing.network import node_in
from tests.docs.blocks import Block, blocks, pages
from tests.ports import free_port
from tests.transports.test_conformance import first, other, until
from tests.transports.zenoh.authority import Authority
from tests.transports.zenoh.cable import guarded, module
from tests.transports.zenoh.test_security import exchange, refused

_ENDPOINT = re.compile(r'"(tls|tcp)/[\w.]+:7447"')
_INLINE = re.compile(r"`((?:transport|listen|connect|scouting|access_control): \{[^`]*\})`")
CONFIGURATIONS = {block.title: block for block in blocks("json5")}
INLINE = [found for page in pages() for found in _INLINE.findall(page.read_text())]


class Folder:
    """The files of one robot: what the page calls router, laptop, ca.pem ..., with an endpoint on loopback."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._endpoint = f"localhost:{free_port()}"

    def url(self, title: str, *, also: str = "", owner: str = "laptop") -> str:
        """The URL of a configuration, with another one merged into it; of another owner than the page's `laptop`."""
        text = _ENDPOINT.sub(rf'"\1/{self._endpoint}"', CONFIGURATIONS[title].text).replace("laptop.", f"{owner}.")
        if also:
            text = text.rstrip().removesuffix("}") + CONFIGURATIONS[also].text.lstrip().removeprefix("{")
        file = self._folder / f"{owner}-{title}"
        file.write_text(text)
        return f"zenoh:?config={file}&network=robot1&scouting=off"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Folder:
    """Where zenoh finds the files that a configuration names: the working directory."""
    monkeypatch.chdir(tmp_path)
    return Folder(tmp_path)


def certificates(*names: str, ours: bool = True) -> None:
    """ca.pem, if it is ours, and for each name a certificate and its key, in the working directory."""
    authority = Authority(Path("ours" if ours else "theirs"))
    if ours:
        Path("ca.pem").write_bytes(Path(authority.root).read_bytes())
    for name in names:
        for file in map(Path, authority.sign(name)):
            Path(file.name).write_bytes(file.read_bytes())


def users(line: str) -> None:
    Path("users.txt").write_text(f"{line}\n")


@pytest.mark.parametrize("block", CONFIGURATIONS.values(), ids=str)
def test_zenoh_loads_it(block: Block) -> None:
    """Also what zenoh looks at only when it opens a session, for which neither address nor files are needed."""
    config = zenoh.Config.from_json5(block.text)
    if "access_control" in block.text:
        config.insert_json5("mode", '"router"')
        config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        zenoh.open(config).close()


@pytest.mark.parametrize("text", INLINE)
def test_zenoh_loads_what_stands_in_a_sentence(text: str) -> None:
    zenoh.Config.from_json5("{" + text + "}")


def test_there_are_configurations() -> None:
    assert {"router.json5", "laptop.json5", "access.json5"} <= set(CONFIGURATIONS)
    assert INLINE


@pytest.mark.anyio
@pytest.mark.one_loop
@guarded
async def test_certificates(folder: Folder) -> None:
    certificates("robot1", "laptop")
    certificates("stranger", ours=False)
    router = folder.url("router.json5")
    await exchange(router, folder.url("laptop.json5"))
    async with module("A", router):
        assert "connect_certificate" in await refused(folder.url("laptop.json5", owner="stranger"))


@pytest.mark.anyio
@pytest.mark.one_loop
@guarded
async def test_passwords(folder: Folder) -> None:
    users("alice:secret")
    router = folder.url("password-router.json5")
    await exchange(router, folder.url("password-laptop.json5"))
    users("alice:other")
    async with module("A", router):
        assert "password" in await refused(folder.url("password-laptop.json5"))


@pytest.mark.anyio
@pytest.mark.one_loop
@guarded
async def test_guests_may_look_but_neither_drive_nor_stop(folder: Folder) -> None:
    certificates("robot1", "laptop", "guest")
    async with (
        module("ROBOT", folder.url("router.json5", also="access.json5")) as robot,
        module("LAPTOP", folder.url("laptop.json5")) as laptop,
        module("GUEST", folder.url("laptop.json5", owner="guest")) as guest,
        node_in(robot) as wheels,
        node_in(laptop) as good,
        node_in(guest) as bad,
    ):
        commands = wheels.subscribe("cmd_vel", Led)
        pose = wheels.advertise("pose", Led)
        await until(lambda: other(robot, "LAPTOP") and other(robot, "GUEST"))
        seen = bad.subscribe("pose", Led)
        await pose.wait_subscriber()
        await pose.publish(Led(7))
        assert await seen.fetch() == Led(7)
        allowed, denied = good.advertise("cmd_vel", Led), bad.advertise("cmd_vel", Led)
        await allowed.wait_subscriber()
        await denied.wait_subscriber()
        told = guest.events()
        await denied.publish(Led(2))
        assert (await first(told, LinkNotice)).kind == "unreachable subscriber"
        guest.command(r2p.Command.STOP, "ROBOT")
        await allowed.publish(Led(1))
        assert await commands.fetch() == Led(1)
        assert not commands.queue
        laptop.command(r2p.Command.STOP, "ROBOT")
        await until(lambda: robot.stopped)
