"""What only serial ports have: devices that vanish, permissions, and a kernel that hides a queue."""

import asyncio
import contextlib
import errno
import os
import sys
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

import r2p
from r2p.codecs import management as m
from r2p.codecs.debug import Reader
from r2p.errors import TransportError
from r2p.msg import Led, Text
from r2p.testing.network import node_in
from r2p.transports import serial as port
from r2p.transports.url import open_transport
from tests.transports.cables import GUARD
from tests.transports.conversation import line, manage
from tests.transports.test_conformance import until

pytestmark = pytest.mark.anyio

_write = os.write


class Board:
    """The other end of a device that can be pulled and plugged in again; speaks and hears by hand."""

    def __init__(self, folder: Path) -> None:
        self.device = folder / "ttyUSB0"
        self._fds: tuple[int, ...] = ()
        self._reader = Reader()

    def plug(self) -> None:
        self._fds = master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        self.device.symlink_to(os.ttyname(slave))

    def pull(self) -> None:
        self.device.unlink(missing_ok=True)  # first: the kernel gives the pty's name to the next who asks
        for each in self._fds:
            os.close(each)
        self._fds = ()

    def say(self, data: bytes) -> None:
        _write(self._fds[0], data)

    def heard(self) -> list[bytes]:
        """Topics and data of what came since."""
        try:
            return [each.data for each in self._reader.feed(os.read(self._fds[0], 65536)) if each.topic != b"R2P"]
        except BlockingIOError:
            return []


@pytest.fixture
def board(tmp_path: Path) -> Iterator[Board]:
    board = Board(tmp_path)
    yield board
    board.pull()


def on(board: Board, *, baud: int = 115200) -> r2p.Module:
    return r2p.Module("PC1", via=f"serial:{board.device},baud={baud}", watchdog=False)


async def test_pulled_in_the_middle_of_a_line_and_plugged_in_again(board: Board) -> None:
    """Under another name of the kernel's; `/dev/serial/by-id` points there."""
    message = line("leds", Led(led=1).encode())
    board.plug()
    module = on(board)
    events = module.events()
    async with asyncio.timeout(GUARD), module, node_in(module) as node:
        subscriber = node.subscribe("leds", Led)
        for _ in range(3):
            assert isinstance(await anext(events), r2p.LinkUp)
            board.say(manage(m.SubscribeResponse("leds", 5)) + message + message[:20])
            assert await subscriber.fetch() == Led(led=1)
            board.pull()
            assert isinstance(await anext(events), r2p.LinkDown)
            waits = await anext(events)
            assert isinstance(waits, r2p.LinkWaits)
            assert "is not there: plug it in" in waits.reason
            board.plug()
        assert set(module.links[0].losses) <= {"garbage"}


async def test_writing_to_a_device_that_is_gone(board: Board) -> None:
    """The break may be seen by the writer first."""
    board.plug()
    async with asyncio.timeout(GUARD), on(board) as module, node_in(module) as node:
        publisher = node.advertise("leds", Led)
        board.say(manage(m.SubscribeRequest("leds", 5, 1)))
        await publisher.wait_subscriber()
        board.pull()
        for _ in range(100):
            publisher.publish_nowait(Led())
        await until(lambda: not module.links[0].up)
        assert module.links[0].losses["link down"] > 0
        board.plug()
        await until(lambda: module.links[0].up)
        board.heard()
        await publisher.publish(Led(led=7))
        await until(lambda: Led(led=7).encode() in board.heard())


async def test_only_a_short_queue_is_left_to_the_kernel(board: Board, monkeypatch: pytest.MonkeyPatch) -> None:
    """At 9600 baud, 32 bytes take 33 ms; on faster lines 20 ms of line time may wait there."""
    queued = [0]

    def write(fd: int, data: bytes) -> int:
        sent = _write(fd, data)
        queued.append(queued[-1] + sent)
        return sent

    board.plug()
    async with asyncio.timeout(GUARD), on(board, baud=9600) as module, node_in(module) as node:
        publisher = node.advertise("text", Text, r2p.NonRealTime(stall=0.01))
        board.say(manage(m.SubscribeRequest("text", 64, 1)))
        await publisher.wait_subscriber()
        with monkeypatch.context() as patch:
            patch.setattr(port, "_queued", lambda _fd: queued[-1])
            patch.setattr(os, "write", write)
            while not publisher.missed:
                await publisher.publish(Text())
            assert 0 < queued[-1] <= 32
            queued.append(0)  # the line has sent it all; a timer finds out
            await until(lambda: queued[-1])


@pytest.mark.parametrize(("queued", "unknown"), [(0, 1), (10_000, 3)])
@pytest.mark.parametrize("publisher_class", [r2p.NonRealTime(), r2p.Sporadic(3600.0)])
async def test_what_had_not_been_sent_when_the_device_went(
    board: Board,
    monkeypatch: pytest.MonkeyPatch,
    queued: int,
    unknown: int,
    publisher_class: r2p.NonRealTime | r2p.Sporadic,
) -> None:
    """By the port, and by the kernel, where that tells; one with a deadline that the port had not sent is lost."""
    in_kernel = 0
    board.plug()
    async with asyncio.timeout(GUARD), on(board) as module, node_in(module) as node:
        publisher = node.advertise("leds", Led, publisher_class)
        board.say(manage(m.SubscribeRequest("leds", 5, 1)))
        await publisher.wait_subscriber()
        monkeypatch.setattr(port, "_queued", lambda _fd: in_kernel)
        for _ in range(2):
            await publisher.publish(Led())
            await asyncio.sleep(0)
        in_kernel = 10_000
        await publisher.publish(Led())
        in_kernel = queued
        board.pull()
        link = module.links[0]
        await until(lambda: not link.up)
        lost = isinstance(publisher_class, r2p.Sporadic)
        assert link.losses["link down"] == lost
        assert link.losses["unknown at disconnect"] == unknown - lost
        assert link.stats.sent == 3 - lost


@pytest.mark.skipif(sys.platform != "linux", reason="another ioctl")
def test_the_kernel_tells_what_it_has_queued(board: Board) -> None:
    board.plug()
    assert port._queued(board._fds[1]) == 0
    with Path("/dev/null").open() as no_terminal:
        assert port._queued(no_terminal.fileno()) == 0


async def test_closing_says_good_bye(board: Board) -> None:
    board.plug()
    async with asyncio.timeout(GUARD):
        async with on(board) as module:
            await until(lambda: module.links[0].up)
        reader, flags = Reader(), [0]

        def said_good_bye() -> bool:
            with contextlib.suppress(BlockingIOError):  # the kernel hands on what was written in its own time
                messages = [m.decode(line.data) for line in reader.feed(os.read(board._fds[0], 65536))]
                flags.extend(message.flags for message in messages if isinstance(message, m.Hello))
            return bool(flags[-1] & m.HELLO_LEAVING)

        await until(said_good_bye)


def test_silence_does_not_look_like_the_end(board: Board) -> None:
    """As pyserial sets a port, a read of nothing gives nothing, as does one of a device that is gone."""
    board.plug()
    with serial.Serial(str(board.device), timeout=0) as device:
        os.set_blocking(device.fileno(), False)
        port._end_differs_from_silence(device.fileno())
        with pytest.raises(BlockingIOError):
            os.read(device.fileno(), 1)


async def test_a_device_of_another_group(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_args: object, **_options: object) -> None:
        raise serial.SerialException(errno.EACCES, "could not open port")

    monkeypatch.setattr(serial, "Serial", refuse)
    module = r2p.Module("PC1", via="serial:/dev/null", watchdog=False)
    events = module.events()
    async with asyncio.timeout(GUARD), module:
        waits = await anext(events)
    assert isinstance(waits, r2p.LinkWaits)
    assert waits.reason == "/dev/null: permission denied; add yourself to its group: sudo usermod -aG dialout $USER"


async def test_a_device_that_another_program_has(board: Board) -> None:
    board.plug()
    module = on(board)
    events = module.events()
    async with asyncio.timeout(GUARD):
        with serial.Serial(str(board.device), exclusive=True):
            async with module:
                waits = await anext(events)
    assert isinstance(waits, r2p.LinkWaits)
    assert "is in use by another program: end that one (fuser -v " in waits.reason


async def test_a_device_that_is_no_serial_port(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    module = r2p.Module("PC1", via=f"serial:{file}", watchdog=False)
    events = module.events()
    async with asyncio.timeout(GUARD), module:
        waits = await anext(events)
        assert isinstance(waits, r2p.LinkWaits)
        assert waits.reason == f"{file} is not a serial port (ls /dev/serial/by-id lists those of adapters)"


@pytest.mark.parametrize(
    ("device", "text"),
    [
        ("/dev/null", "/dev/null is not a serial port"),
        ("ttyUSB97", "ttyUSB97 is not there, and not in the working directory: is serial:/dev/ttyUSB97 meant?"),
    ],
)
async def test_the_name_of_another_device(device: str, text: str) -> None:
    module = r2p.Module("PC1", via=f"serial:{device}", watchdog=False)
    events = module.events()
    async with asyncio.timeout(GUARD), module:
        waits = await anext(events)
        assert isinstance(waits, r2p.LinkWaits)
        assert waits.reason.startswith(text)


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("serial:", "give the device, for example serial:/dev/ttyUSB0"),
        ("serial:/dev/x,baud=0", "baud=0: give bits per second, such as 115200"),
        ("serial:/dev/x,baud=fast", "baud=fast: give bits per second"),
        ("serial:/dev/x,speed=9600", "has no option 'speed'; it knows: baud"),
    ],
)
def test_urls_that_are_wrong(url: str, text: str) -> None:
    with pytest.raises(TransportError, match=text):
        open_transport(url)


def test_without_pyserial(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(TransportError, match=r"pip install 'r2p\[serial\]'"):
        open_transport("serial:/dev/ttyUSB0")
