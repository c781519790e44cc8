"""Nodes of other modules are listed, started, stopped, restarted and swapped, with permission."""

from __future__ import annotations

import asyncio
import gc
import importlib
import logging
import math
import os
import sys
import threading
import warnings
import zlib
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import r2p
from r2p import keys
from r2p.codecs.own_services import PAGE_MAX, Operation
from r2p.errors import DecodeError
from r2p.modules import node_messages
from r2p.modules.node_control import CodeStore, digest_of
from r2p.modules.node_messages import (
    CodePiece,
    NodeAction,
    NodeCommand,
    NodeOutcome,
    TopicPauseEntry,
    decode_argument,
    decode_content,
    encode_argument,
    encode_content,
)
from r2p.msg import Led, Log
from r2p.testing.network import node_in
from tests.bench import collect, hold

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

virtual_time = pytest.mark.virtual_time

BLINK = """
import asyncio
import r2p
from r2p.msg import Led
from helper_of_blink import VALUE


async def blink(node):
    node.log.debug("value %d", VALUE)
    node.advertise("leds", Led, r2p.Periodic(0.01, lambda: Led(value=VALUE)))
    await asyncio.Event().wait()


async def crash(node):
    raise KeyError("port")


NUMBER = 3
"""


@pytest.fixture(autouse=True)
def same_modules() -> Iterator[None]:
    """Leave `sys.modules` and `sys.path` as they were."""
    modules, path = set(sys.modules), list(sys.path)
    yield
    for name in set(sys.modules) - modules:
        del sys.modules[name]
    sys.path[:] = path


def write(path: Path, text: str) -> None:
    """Write a file of another time than before, also within one tick of the file system's clock."""
    before = path.stat().st_mtime_ns if path.exists() else 0
    path.write_text(text)
    if path.stat().st_mtime_ns == before:
        os.utime(path, ns=(before + 1, before + 1))


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    write(tmp_path / "blink.py", BLINK)
    write(tmp_path / "helper_of_blink.py", "VALUE = 1\n")
    return tmp_path


def host(directory: Path, via: str = "memory:a", **options: Any) -> r2p.Module:
    return r2p.Module("BOT", via=via, allow_load=directory, **options)


async def nodes_of(stack: AsyncExitStack, via: str = "memory:a", module: str = "BOT") -> r2p.RemoteNodes:
    """The nodes of the module, as a tool has them."""
    other = await stack.enter_async_context(r2p.Module("_tool", via=via, observer=True))
    async with asyncio.timeout(10.0):
        while not any(view.name == module for view in other.network.modules()):  # noqa: ASYNC110 - there is no event
            await asyncio.sleep(0.01)
    return other.network.nodes_of(module)


async def gateways(stack: AsyncExitStack) -> str:
    """Two gateways behind each other; the URL of their far side."""
    for name, *via in (("GW1", "memory:a", "memory:b"), ("GW2", "memory:b", "memory:c")):
        await stack.enter_async_context(r2p.Module(name, via=via, bridge=True))
    return "memory:c"


@virtual_time
@pytest.mark.parametrize("far", [False, True])
async def test_a_node_is_started_swapped_restarted_and_stopped(directory: Path, far: bool) -> None:
    async with AsyncExitStack() as stack:
        bot = await stack.enter_async_context(host(directory))
        via = await gateways(stack) if far else "memory:a"
        nodes = await nodes_of(stack, via)
        watcher = await stack.enter_async_context(r2p.Module("FAR", via=via))
        test = await stack.enter_async_context(node_in(watcher))
        leds = test.subscribe("leds", Led, queue=10_000)
        assert (await nodes.fetch()).nodes == ()
        assert await nodes.start("blink.py", "blink", priority=2, restart=True) == "blink"
        assert await nodes.start("blink.py", "blink", "other") == "other"
        await nodes.stop("other")
        assert (await leds.fetch(timeout=10.0)).value == 1
        await asyncio.sleep(1.0)
        write(directory / "helper_of_blink.py", "VALUE = 2\n")
        result = await nodes.swap("blink", "blink.py", "blink")
        assert (result.node, result.cleaned_up) == ("blink", True)
        (topic,) = result.topics
        assert (topic.topic, topic.period) == ("leds", 0.01)
        assert topic.pause == pytest.approx(0.01)
        await asyncio.sleep(1.0)
        samples = [*leds.queue]
        assert Led.decode(samples[-1].data).value == 2
        own = [each.sequence for each in samples if each.stamp > samples[0].stamp + 500_000_000]
        assert own == list(range(own[0], own[-1] + 1))
        await nodes.restart("blink")
        await asyncio.sleep(0.5)
        listed = await nodes.fetch()
        assert listed.allow_load
        assert math.isnan(listed.cpu)  # under virtual time
        found = {each.node: each for each in listed.nodes}
        assert [(each.running, each.priority, each.source) for each in found.values()] == [
            (True, 2, "blink.py:blink"),
            (False, 0, "blink.py:blink"),
        ]
        assert 0.4 < found["blink"].age < 0.7
        assert math.isnan(found["other"].age)
        assert bot.nodes["blink"].options.restart
        with pytest.raises(r2p.Error, match=r"^BOT has no node wheel; its nodes: blink, other"):
            await nodes.stop("wheel")


ERRORS = {
    "blink.py:wheel": "blink.py has no function wheel; it has blink, crash",
    "blink.py:NUMBER": "3 is not a coroutine function",
    "none.py:blink": "there is no file none.py in /",
    "../blink.py:blink": "is not in /.*, and no other code may be loaded \\(--load-dir\\)",
    "/etc/passwd:blink": "/etc/passwd is not in /",
    "link.py:blink": "link.py is not in /",
    "data.txt:blink": "data.txt is not a Python file: its name must end with .py",
    "syntax.py:blink": r"can't load syntax.py:\n  File .*syntax.py.*, line 3\n    async def blink\(node\)\n.*\nSynt",
    "raises.py:blink": r'(?s)can\'t load raises.py:\nTraceback .*File ".*raises.py", line 2, in <module>.*KeyError: 5',
    "exits.py:blink": "(?s)can't load exits.py:.*SystemExit: 3",
    "imports.py:blink": "(?s)can't load imports.py:.*No module named 'not_there'",
    "a\0b.py:blink": "is not a path",
    "big.py:blink": "has more than 256 KiB",
    "loose.py:blink": "loose.py belongs to another user, or everyone can write it: chown it, and chmod o-w",
    "open/blink.py:blink": "/open belongs to another user, or everyone can write it: use another directory",
}


@virtual_time
async def test_what_is_wrong_with_a_file_reaches_the_user(directory: Path) -> None:
    write(directory / "syntax.py", "import r2p\n\nasync def blink(node)\n    pass\n")
    write(directory / "raises.py", "values = {}\nvalues[5]\n")
    write(directory / "exits.py", "raise SystemExit(3)\n")
    write(directory / "imports.py", "import helper_of_blink\nimport not_there\n")
    write(directory / "data.txt", "")
    write(directory / "big.py", "#" * (256 << 10) + "\n")
    inner = directory / "inner"
    inner.mkdir()
    (inner / "link.py").symlink_to(directory / "blink.py")
    write(inner / "data.txt", "")
    for name in ("syntax", "raises", "exits", "imports", "big"):
        (directory / f"{name}.py").rename(inner / f"{name}.py")
    write(inner / "blink.py", BLINK.replace("from helper_of_blink import VALUE", "VALUE = 1"))
    write(inner / "helper_of_blink.py", "VALUE = 1\n")
    write(inner / "loose.py", BLINK)
    (inner / "loose.py").chmod(0o646)
    (inner / "open").mkdir()
    write(inner / "open" / "blink.py", BLINK)
    (inner / "open").chmod(0o757)  # whoever can write there chooses what blink.py imports
    async with AsyncExitStack() as stack:
        bot = await stack.enter_async_context(host(inner))
        nodes = await nodes_of(stack)
        await nodes.start("blink.py", "blink")
        modules = set(sys.modules)
        for target, text in ERRORS.items():
            file, _, function = target.rpartition(":")
            with pytest.raises(r2p.Error, match=text):
                await nodes.swap("blink", file, function)
        with pytest.raises(r2p.Error, match="BOT: the new node crashed: KeyError: 'port'; blink goes on"):
            await nodes.swap("blink", "blink.py", "crash")
        assert not {"syntax", "raises", "exits", "imports", "helper_of_blink"} & (set(sys.modules) - modules)
        assert bot.nodes["blink"].running
    with pytest.raises(r2p.Error, match="/open belongs to another user"):
        host(inner / "open")


@virtual_time
async def test_an_error_with_any_characters_is_listed_and_a_command_that_never_runs_leaves_nothing(
    directory: Path,
) -> None:
    async with AsyncExitStack() as stack:
        bot = await stack.enter_async_context(host(directory))
        nodes = await nodes_of(stack)
        await nodes.start("blink.py", "blink")
        bot.nodes["blink"].error = OSError("x\udcff" * 200)
        (listed,) = (await nodes.fetch()).nodes
        assert listed.error == "x?" * 150
        bot.nodes["blink"].error = None
        with warnings.catch_warnings(record=True) as found:
            command = NodeCommand(action=NodeAction.STOP, node="blink")
            bot._node_control._command(encode_argument(command)).close()  # as where too many run
            gc.collect()
        assert not found


@virtual_time
@pytest.mark.parametrize("order", [r2p.Module.stop, r2p.Module.reboot])
async def test_a_restart_that_waits_does_not_start_a_node_that_is_stopped(order: Any) -> None:
    async def slow(node: r2p.Node) -> None:
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(1.0)

    async with r2p.Module("BOT", via="memory:a") as bot:
        bot.start(slow)
        await asyncio.sleep(0.1)
        restarting = asyncio.create_task(bot.restart_node("slow"))
        await asyncio.sleep(0.1)
        await order(bot)
        with pytest.raises(r2p.Error, match="node slow of module BOT was replaced or ended while it was restarted"):
            await restarting
        await asyncio.sleep(0.1)
        assert bot.nodes["slow"].running is not bot.stopped


@virtual_time
async def test_changed_modules_are_loaded_again_and_unchanged_ones_shared(directory: Path) -> None:
    write(directory / "shared_by_nodes.py", "OPENED = []\n")
    (directory / "package_of_nodes").mkdir()
    write(directory / "package_of_nodes" / "__init__.py", "")
    write(directory / "package_of_nodes" / "inner.py", "from helper_of_blink import VALUE\n")
    write(directory / "middle_of_nodes.py", "from package_of_nodes.inner import VALUE\n")
    installed = directory / "site-packages"
    installed.mkdir()
    write(installed / "installed_for_nodes.py", "OPENED = []\n")
    write(directory / "user.py", USER)
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(host(directory))
        nodes = await nodes_of(stack)
        for number, name in enumerate(("one", "two", "three")):
            await nodes.start("user.py", "use", name)
            shared = sys.modules["shared_by_nodes"].OPENED
            assert shared[-1] == (name, 1 if number < 2 else 7)
            assert len(shared) == number + 1
            if number == 0:
                sys.path.insert(0, str(installed))
                kept = importlib.import_module("installed_for_nodes")
            elif number == 1:
                write(directory / "helper_of_blink.py", "VALUE = 7\n")
                write(installed / "installed_for_nodes.py", "OPENED = [1]\n")
        assert sys.modules["installed_for_nodes"] is kept
        assert sys.modules["user"].__file__ == str(directory / "user.py")


USER = """
import asyncio
import middle_of_nodes
from shared_by_nodes import OPENED


async def use(node):
    OPENED.append((node.name, middle_of_nodes.VALUE))
    await asyncio.Event().wait()
"""


@virtual_time
async def test_a_module_without_allow_load_refuses_and_says_what_to_do(directory: Path) -> None:
    async with AsyncExitStack() as stack:
        bot = await stack.enter_async_context(r2p.Module("BOT", via="memory:a"))
        bot.start(hold, name="blink")
        nodes = await nodes_of(stack)
        for change in (
            nodes.start("blink.py", "blink"),
            nodes.stop("blink"),
            nodes.restart("blink"),
            nodes.swap("blink", "blink.py", "blink"),
        ):
            with pytest.raises(r2p.Error, match=r"with `r2p run --allow-load`, or Module\(allow_load=True\)"):
                await change
        assert [each.running for each in (await nodes.fetch()).nodes] == [True]
    with pytest.raises(r2p.Error, match="allow_load: there is no directory"):
        host(directory / "nowhere")


@virtual_time
async def test_code_is_sent_only_by_links_with_a_key(directory: Path, tmp_path: Path) -> None:
    (tmp_path / "here").mkdir()
    code = tmp_path / "here" / "blink.py"
    numbers = "\n".join(f"V{n} = {n * n * 7919 % 10007}" for n in range(400))
    write(code, f"{numbers}\n{BLINK.replace('from helper_of_blink import VALUE', 'VALUE = 9')}")
    key = tmp_path / "key"
    keys.create(key)
    steps: list[tuple[int, int]] = []
    async with AsyncExitStack() as stack:
        bot = await stack.enter_async_context(host(directory))
        nodes = await nodes_of(stack)
        with pytest.raises(r2p.ServiceError, match=r"only from links with a key, .* \(\?key=FILE\)"):
            await nodes.start("blink.py", "blink", code=code)
        assert not bot.nodes
    async with AsyncExitStack() as stack:
        via = f"memory:k?key={key}"
        bot = await stack.enter_async_context(host(directory, via))
        nodes = await nodes_of(stack, via)
        before = (directory / "blink.py").read_text()
        await nodes.start("blink.py", "blink", code=code, progress=lambda *at: steps.append(at))
        assert steps[0][0] == 0 < 8 < len(steps)
        assert steps[-1][0] == steps[-1][1]
        assert (directory / "blink.py").read_text() == before
        assert bot.nodes["blink"].source == "<sent blink.py>:blink"
        write(code, "import r2p\n\nvalue = 1 / 0\n")
        with pytest.raises(r2p.Error, match=r'(?s)File "<sent blink.py>", line 3, in <module>\n    value = 1 / 0\n'):
            await nodes.swap("blink", "blink.py", "blink", code=code)
        await bot.reboot()
        await asyncio.sleep(0.1)
        assert bot.nodes["blink"].running


@virtual_time
async def test_each_hop_of_code_needs_a_key(directory: Path, tmp_path: Path) -> None:
    key = tmp_path / "key"
    keys.create(key)
    code = tmp_path / "blink.py"
    for far, allowed in ((f"memory:f?key={key}", True), ("memory:g", False)):
        async with AsyncExitStack() as stack:
            bot = await stack.enter_async_context(host(directory, f"memory:n?key={key}"))
            await stack.enter_async_context(r2p.Module("GW", via=[f"memory:n?key={key}", far], bridge=True))
            nodes = await nodes_of(stack, far)
            if allowed:
                await nodes.start("blink.py", "blink", code=code)
                assert bot.nodes["blink"].running
                continue
            with pytest.raises(r2p.ServiceError, match=r"GW passes no changes .*\(\?key=FILE\)"):
                await nodes.start("blink.py", "blink", code=code)
            assert not bot.nodes


@virtual_time
async def test_a_module_that_is_gone_in_the_middle_is_a_time_out(directory: Path) -> None:
    write(directory / "slow.py", "import asyncio\n\nasync def wait(node):\n    await asyncio.sleep(60)\n")
    async with AsyncExitStack() as stack:
        async with host(directory) as bot:
            nodes = await nodes_of(stack)
            await nodes.start("blink.py", "blink")
            swap = asyncio.create_task(nodes.swap("blink", "slow.py", "wait"))
            await asyncio.sleep(1.0)
            assert not swap.done()
            for link in bot.links:
                link.on_down("pulled out")
        with pytest.raises((TimeoutError, r2p.Error), match="whether it has made the change is unknown"):
            await swap


def test_pieces_of_code_are_kept_within_limits() -> None:
    store = CodeStore()

    def piece(data: bytes, total: int = 10, offset: int = 0, digest: bytes = bytes(16)) -> CodePiece:
        return CodePiece(digest=tuple(digest), total=total, offset=offset, data=tuple(data))

    for total in (0, 1 << 16 | 1, 1 << 31):
        with pytest.raises(ValueError, match="bytes of compressed code, and at most 65536 are accepted"):
            store.add(piece(b"x", total))
    assert store.add(piece(b"12345")) == 5
    assert store.add(piece(b"67", offset=9)) == 5  # not the next one
    assert store.add(piece(b"678901", offset=5)) == 5  # too long
    with pytest.raises(r2p.Error, match="not all of it"):
        store.get(bytes(16))
    with pytest.raises(ValueError, match="damaged"):
        store.add(piece(b"67890", offset=5))
    bad = digest_of(b"1234567890")
    assert store.add(piece(b"1234567890", digest=bad)) == 10
    with pytest.raises(r2p.Error, match="not compressed"):
        store.get(bad)
    for number in range(10):
        store.add(piece(b"1", digest=bytes([number] * 16)))
    assert len(store._parts) == 4
    bomb = zlib.compress(bytes(10_000_000), 9)
    digest = digest_of(bomb)
    for offset in range(0, len(bomb), 100):
        store.add(piece(bomb[offset : offset + 100], len(bomb), offset, digest))
    with pytest.raises(r2p.Error, match="more than 256 KiB"):
        store.get(digest)


KINDS = [
    kind
    for kind in vars(node_messages).values()
    if isinstance(kind, type) and issubclass(kind, r2p.Message) and kind.__module__ == node_messages.__name__
]


@given(st.binary(max_size=300), st.sampled_from(KINDS), st.sampled_from([decode_argument, decode_content]))
def test_arbitrary_bytes_decode_or_raise_decode_error(data: bytes, kind: type[Any], decode: Any) -> None:
    for each in (data, b"\1" + len(data).to_bytes(2, "little") + data, b"\1" + len(data).to_bytes(4, "little") + data):
        try:
            decode(kind, each)
        except DecodeError:
            continue


@virtual_time
@settings(max_examples=30)
@given(data=st.binary(max_size=PAGE_MAX), operation=st.sampled_from([136, 137, 138]))
async def test_hostile_arguments_are_errors(data: bytes, operation: int) -> None:
    async with r2p.Module("BOT", via=[], allow_load=True) as bot:
        for each in (data, b"\1" + len(data).to_bytes(2, "little") + data):
            try:
                await bot._opened.own_services.change(bot.instance, Operation(operation), each)
            except (r2p.Error, LookupError, ValueError):
                continue


@virtual_time
async def test_times_that_can_not_be_are_none() -> None:
    times = [(0.1, 0.1), (0.0, 0.0), (math.inf, 1.0), (1e300, 1e-300), (-1.0, -1.0), (math.nan, math.nan)]
    topics = tuple(TopicPauseEntry(topic="leds", publisher_class=1, pause=a, period=b) for a, b in times)

    async def ask(module: str, operation: Operation, argument: bytes = b"", *, what: str, firmware: str) -> bytes:
        return encode_content(NodeOutcome(node="blink", topics=topics))

    result = await r2p.RemoteNodes(ask, "BOT").swap("blink", "blink.py", "blink")
    found = [(each.pause, each.period) for each in result.topics]
    assert found == [(0.1, 0.1), (0.0, None), (None, 1.0), (None, None), (None, None), (None, None)]


def test_arguments_fit_one_message() -> None:
    assert len(encode_argument(CodePiece(data=(1,) * node_messages.PIECE_MAX))) <= PAGE_MAX
    with pytest.raises(r2p.Error, match="bytes too long together"):
        encode_argument(NodeCommand(node="n" * 64, name="m" * 64, file="f" * 60))


@virtual_time
async def test_the_level_of_a_node_is_set_at_run_time(caplog: pytest.LogCaptureFixture) -> None:
    records: list[Log] = []

    async def talk(node: r2p.Node) -> None:
        async for _ in node.every(0.1):
            node.log.debug("detail")
            node.log.info("step")
            if crash:
                crash.clear()
                raise KeyError("port")

    crash: list[bool] = []
    async with AsyncExitStack() as stack:
        bot = await stack.enter_async_context(r2p.Module("BOT", via="memory:a"))
        bot.start(talk, restart=True)
        bot.start(talk, name="other")
        nodes = await nodes_of(stack)
        watcher = await stack.enter_async_context(r2p.Module("WATCH", via="memory:a"))
        test = await stack.enter_async_context(node_in(watcher))
        stack.callback(asyncio.create_task(collect(test.subscribe("log", Log, queue=100), records)).cancel)

        async def texts(node: str) -> set[str]:
            records.clear()
            await asyncio.sleep(1.0)
            return {each.text for each in records if each.node == node}

        await texts("talk")
        assert await texts("talk") == {"step"}
        assert await nodes.set_log_level("talk", logging.DEBUG) == ["talk"]
        assert await texts("talk") == {"detail", "step"}
        assert await texts("other") == {"step"}
        assert {each.node: each.log_level for each in (await nodes.fetch()).nodes} == {"talk": 10, "other": 0}
        crash.append(True)
        await texts("talk")
        assert bot.nodes["talk"].restarts == 1
        assert await texts("talk") == {"detail", "step"}
        assert await nodes.set_log_level("", logging.ERROR) == ["talk", "other"]
        assert await texts("other") == set()
        await nodes.set_log_level("", None)
        assert await texts("talk") == await texts("other") == {"step"}
        with pytest.raises(r2p.ServiceError, match="module BOT has no node wheel; its nodes: talk, other"):
            await nodes.set_log_level("wheel", 10)
        await nodes.set_log_level("talk", logging.DEBUG)
    assert logging.getLogger("r2p.BOT.talk").level == logging.NOTSET
    caplog.clear()


SLOW = """
import asyncio
import threading

THREAD = threading.get_ident()


async def wait(node):
    await asyncio.sleep(60)
"""


def test_code_runs_in_a_thread_and_the_share_of_the_processor_is_known(directory: Path) -> None:
    asyncio.run(load_in_thread(directory))


async def load_in_thread(directory: Path) -> None:
    write(directory / "slow.py", SLOW)
    async with AsyncExitStack() as stack:
        bot = await stack.enter_async_context(host(directory, "memory:real"))
        listed = bot._node_control.list()
        assert listed.cpu >= 0.0 or math.isnan(listed.cpu)
        await bot.network.nodes_of("BOT").start("slow.py", "wait")
        assert threading.get_ident() != sys.modules["slow"].THREAD
        write(directory / "slow.py", "raise KeyError(3)\n")
        with pytest.raises(r2p.Error, match="KeyError: 3"):
            await bot.network.nodes_of("BOT").start("slow.py", "wait", "again")
        write(directory / "slow.py", "next(iter(()))\n")
        with pytest.raises(r2p.Error, match=r"(?s)line 1, in <module>.*StopIteration"):
            await bot.network.nodes_of("BOT").start("slow.py", "wait", "again")
        await bot.stop_node("wait")
