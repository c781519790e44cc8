"""`r2p topic pub`."""

from __future__ import annotations

import asyncio
import io
import os
import threading
from typing import TYPE_CHECKING, Any

import pytest
import typer

import r2p
from r2p.msg import Led, Velocity3
from r2p.tools.options import class_choice, hertz
from r2p.tools.session import TimedOut, UsageError
from r2p.tools.topic.pub import pub, read_lines
from tests.tools.rig import robot, tool

if TYPE_CHECKING:
    from pathlib import Path


class Listener:
    """A node that keeps what it receives, and when."""

    def __init__(self, type: type[r2p.Message] = Led) -> None:
        self.heard: list[r2p.Message] = []
        self.samples: list[r2p.Sample] = []
        self._type = type
        self._more = asyncio.Event()

    async def listen(self, node: r2p.Node) -> None:
        async for sample in node.subscribe("cmd", self._type, queue=64).samples():
            self.samples.append(sample)
            assert sample.message is not None
            self.heard.append(sample.message)
            self._more.set()

    async def got(self, count: int) -> list[r2p.Message]:
        while len(self.heard) < count:
            self._more.clear()
            await self._more.wait()
        return self.heard

    @property
    def gaps(self) -> list[float]:
        """Seconds between messages."""
        return [
            (later.stamp - earlier.stamp) / 1e9 for earlier, later in zip(self.samples, self.samples[1:], strict=False)
        ]


@pytest.mark.virtual_time
async def test_a_timeout_needs_something_to_wait_for() -> None:
    """Without a count nothing waits for a subscriber, so a time-out that was ignored would never end the command."""
    async with tool() as session:
        with pytest.raises(UsageError, match="add --once, -n or -, which wait for one"):
            await pub(session, "cmd", [], type="Led", timeout=2)


@pytest.mark.virtual_time
async def test_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "r2p.pub")
    listener = Listener()
    async with robot(listener.listen):
        async with tool() as session:
            await pub(session, "/cmd", ["led=3", "value=1"], type="Led", once=True)
        assert await listener.got(1) == [Led(led=3, value=1)]
    assert caplog.messages == ["1 message of cmd sent to BOT/listen"]


@pytest.mark.virtual_time
async def test_once_waits_for_a_subscriber_and_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    listener = Listener()
    async with robot() as module, tool() as session:
        asyncio.get_running_loop().call_later(60, module.start, listener.listen)
        await pub(session, "cmd", [], type="Led", once=True)
        assert await listener.got(1) == [Led()]
    assert capsys.readouterr().err == "r2p: waiting for a subscriber of cmd on memory:lab\n"


@pytest.mark.virtual_time
@pytest.mark.parametrize("once", [True, False])
async def test_a_topic_with_a_name_much_like_it_is_named(once: bool, capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(Listener().listen), tool() as session:
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(5):
                await pub(session, "cmdd", [], type="Led", once=once)
    said = capsys.readouterr().err
    assert said.startswith("r2p: waiting" if once else "r2p: cmdd has no subscriber yet, publishing anyway;")
    assert said.count("did you mean cmd?") == 1


@pytest.mark.virtual_time
async def test_a_topic_that_is_subscribed_is_not_guessed_at(capsys: pytest.CaptureFixture[str]) -> None:
    async def listen(node: r2p.Node) -> None:
        node.subscribe("cmdd", Led)
        await Listener().listen(node)

    async with robot(listen), tool() as session:
        await pub(session, "cmdd", [], type="Led", once=True)
    assert "did you mean" not in capsys.readouterr().err


@pytest.mark.virtual_time
async def test_nobody_subscribes_in_time() -> None:
    async with robot(), tool() as session:
        with pytest.raises(TimedOut, match="cmd had no subscriber for 2 s"):
            await pub(session, "cmd", [], type="Led", once=True, timeout=2)


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    ("options", "gap", "publisher_class"),
    [
        ({}, 1.0, r2p.PublisherClass.NON_REAL_TIME),
        ({"rate": 20}, 0.05, r2p.PublisherClass.NON_REAL_TIME),
        ({"rate": 20, "choice": class_choice("nrt")}, 0.05, r2p.PublisherClass.NON_REAL_TIME),
        ({"rate": 20, "choice": class_choice("sporadic:10ms")}, 0.05, r2p.PublisherClass.SPORADIC),
        ({"choice": class_choice("periodic:250ms")}, 0.25, r2p.PublisherClass.PERIODIC),
    ],
)
async def test_rate_and_class(options: dict[str, Any], gap: float, publisher_class: r2p.PublisherClass) -> None:
    listener = Listener()
    async with robot(listener.listen):
        async with tool() as session:
            await pub(session, "cmd", ["{led: 3}"], type="Led", count=4, **options)
        assert await listener.got(4) == [Led(led=3)] * 4
    assert listener.gaps == pytest.approx([gap] * 3)
    assert {sample.publisher_class for sample in listener.samples} == {publisher_class}


@pytest.mark.virtual_time
async def test_without_a_number_it_goes_on_and_says_what_and_to_whom(
    capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "r2p.pub")
    listener = Listener()
    async with robot() as module, tool() as session:
        publishing = asyncio.create_task(pub(session, "cmd", [], type="Led", rate=10))
        await asyncio.sleep(5)
        assert "cmd has no subscriber yet" in capsys.readouterr().err
        module.start(listener.listen)
        await listener.got(20)
        publishing.cancel()
        with pytest.raises(asyncio.CancelledError):
            await publishing
    assert caplog.messages == [
        'publishing cmd {"led": 0, "value": 0} at 10 Hz',
        "publishing cmd to BOT/listen",
    ]


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    ("options", "rate"), [({}, "1"), ({"rate": 0.5}, "0.5"), ({"choice": class_choice("periodic:20ms")}, "50")]
)
async def test_with_a_subscriber_it_says_all_at_once(
    options: dict[str, Any], rate: str, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "r2p.pub")
    listener = Listener()
    async with robot(listener.listen), tool() as session:
        publishing = asyncio.create_task(pub(session, "cmd", ["led=3"], type="Led", **options))
        await listener.got(3)
        publishing.cancel()
        with pytest.raises(asyncio.CancelledError):
            await publishing
    assert caplog.messages == [f'publishing cmd {{"led": 3, "value": 0}} at {rate} Hz to BOT/listen']
    assert capsys.readouterr().err == ""


@pytest.mark.virtual_time
async def test_subscribers_of_another_type_are_not_waited_for() -> None:
    async with robot(Listener(Velocity3).listen), tool() as session:
        with pytest.raises(ExceptionGroup) as caught:
            await pub(session, "cmd", [], type="Led", once=True)
    assert caught.group_contains(
        r2p.Error, match=r"cmd is subscribed as r2p_msgs/Velocity3 \(12 bytes\), not r2p_msgs/Led"
    )


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "1e9", "1e-300", "fast"])
def test_a_rate_that_no_clock_can_count(text: str) -> None:
    with pytest.raises(typer.BadParameter, match="the rate must be a number from 1e-09 to 1e\\+06"):
        hertz(text)


@pytest.mark.virtual_time
async def test_the_type_is_the_subscribers() -> None:
    listener = Listener(Velocity3)
    async with robot(listener.listen), tool() as session:
        await pub(session, "cmd", ["x=1.5"], once=True)
        assert await listener.got(1) == [Velocity3(x=1.5)]


@pytest.mark.virtual_time
async def test_a_type_in_the_file() -> None:
    listener = Listener(Velocity3)
    async with robot(listener.listen), tool(types={"cmd": "r2p.msg:Velocity3"}) as session:
        await pub(session, "cmd", ["x=1.5"], once=True)
        assert await listener.got(1) == [Velocity3(x=1.5)]


@pytest.mark.virtual_time
async def test_mistakes() -> None:
    async with robot(), tool() as session:
        with pytest.raises(UsageError, match="the type of cmd is unknown: give --type"):
            await pub(session, "cmd", [])
        with pytest.raises(UsageError, match="Led has no field x: it has led, value"):
            await pub(session, "cmd", ["x=1"], type="Led")
        with pytest.raises(UsageError, match="leave out --rate"):
            await pub(session, "cmd", ["-"], type="Led", choice=class_choice("periodic:1s"))


@pytest.mark.virtual_time
async def test_stdin(monkeypatch: pytest.MonkeyPatch) -> None:
    listener = Listener()
    monkeypatch.setattr("sys.stdin", io.StringIO('{"led": 1}\n\n{led: 2, value: 1}\nled=3\n{"led": 4, "_": {}}'))
    async with robot(listener.listen):
        async with tool() as session:
            await pub(session, "cmd", ["-"], type="Led")
        assert await listener.got(4) == [Led(led=1), Led(led=2, value=1), Led(led=3), Led(led=4)]


@pytest.mark.virtual_time
async def test_stdin_as_echo_prints_yaml(monkeypatch: pytest.MonkeyPatch) -> None:
    listener = Listener()
    yaml = "led: 1\nvalue: 1\n_:\n  topic: leds\n---\nled: 2\n\n---\n---\nled=3\nled: 4\nvalue: 1\n"
    monkeypatch.setattr("sys.stdin", io.StringIO(yaml))
    async with robot(listener.listen):
        async with tool() as session:
            await pub(session, "cmd", ["-"], type="Led")
        assert await listener.got(4) == [Led(led=1, value=1), Led(led=2), Led(led=3), Led(led=4, value=1)]


@pytest.mark.virtual_time
async def test_bad_yaml_on_stdin_is_told_by_its_first_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("led: 1\n---\nled: 1\nvalu: 1\n---\n"))
    async with robot(Listener().listen), tool() as session:
        with pytest.raises(r2p.MessageError, match="line 3: Led has no field valu"):
            await pub(session, "cmd", ["-"], type="Led")


@pytest.mark.virtual_time
async def test_stdin_paced_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    listener = Listener()
    monkeypatch.setattr("sys.stdin", io.StringIO('{"led": 1}\n' * 9))
    async with robot(listener.listen):
        async with tool() as session:
            await pub(session, "cmd", ["-"], type="Led", rate=4, count=3)
        await listener.got(3)
    assert listener.gaps == pytest.approx([0.25, 0.25])


@pytest.mark.virtual_time
async def test_a_bad_line_on_stdin_is_told_by_its_number(monkeypatch: pytest.MonkeyPatch) -> None:
    listener = Listener()
    monkeypatch.setattr("sys.stdin", io.StringIO('{"led": 1}\n\n{"led": -1}\n'))
    async with robot(listener.listen), tool() as session:
        with pytest.raises(r2p.MessageError, match=r"line 3: Led\.led takes an integer"):
            await pub(session, "cmd", ["-"], type="Led")


@pytest.mark.virtual_time
async def test_bad_json_on_stdin_is_told_by_its_line_and_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO('{"led": 1}\n{"led": 1 "value": 0}\n'))
    problem = r"""line 2: '{"led": 1 "value": 0}' is not valid JSON: expecting ',' delimiter at character 11"""
    async with robot(Listener().listen), tool() as session:
        with pytest.raises(r2p.MessageError, match=problem):
            await pub(session, "cmd", ["-"], type="Led")


@pytest.mark.parametrize("regular", [True, False], ids=["file", "pipe"])
def test_lines_are_read_alike_from_files_and_pipes(
    regular: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("r2p.tools.topic.pub._LINE_MAX", 1 << 20)

    async def lines(data: bytes) -> list[str]:
        path = tmp_path / "lines"
        if regular:
            path.write_bytes(data)
        else:
            os.mkfifo(path)
            writer = threading.Thread(target=path.write_bytes, args=(data,))
            writer.start()
        try:
            with path.open(encoding="utf-8") as stream:
                return [line async for line in read_lines(stream)]
        finally:
            if not regular:
                writer.join()
            path.unlink()

    assert asyncio.run(lines(b"one\r\n\n\xff two\nthree")) == ["one", "", "\ufffd two", "three"]
    assert asyncio.run(lines(b"x" * (1 << 20) + b"\ny")) == ["x" * (1 << 20), "y"]
    for too_long in b"x" * (1 << 20) + b"xx\n", b"x" * (1 << 20) + b"x":
        with pytest.raises(r2p.MessageError, match="longer than 128 MiB"):
            asyncio.run(lines(too_long))
