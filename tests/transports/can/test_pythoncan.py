"""The port to python-can's interfaces: the virtual one, and broken ones."""

from __future__ import annotations

import itertools
import sys
from typing import TYPE_CHECKING, Any
from unittest.mock import Mock

import can
import pytest
import serial

from r2p.codecs.can_bits import Frame, OtherFrame
from r2p.errors import TransportError
from r2p.protocols.can_orders import Mailbox, Outcome, Transmit, Withdraw
from r2p.transports.can import pythoncan
from r2p.transports.can.pythoncan import PythonCanPort
from r2p.transports.rtcan.transport import INTERFACES
from r2p.transports.url import open_transport
from r2p.units import NEVER
from tests.can.rig import GUARD, RecordingListener, now, using
from tests.faults import once

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.anyio

MS = 1_000_000
SRT = 10 << 23 | 0x0242 << 7
BITRATE = 1_000_000

_channels = itertools.count()


@pytest.fixture
def channel() -> str:
    return f"test{next(_channels)}"


@pytest.fixture
def peer(channel: str) -> Iterator[can.BusABC]:
    """python-can alone, on the same channel."""
    with can.Bus(interface="virtual", channel=channel) as bus:
        yield bus


def port_on(channel: str) -> PythonCanPort:
    return PythonCanPort("virtual", channel, BITRATE)


def order(identifier: int = SRT, data: bytes = b"", *, wait: int = 0, last: int = NEVER) -> Transmit:
    begin = now()
    return Transmit(Frame(identifier, data), Mailbox.SRT, begin + wait, NEVER if last == NEVER else begin + last)


async def test_frames_go_out_and_are_confirmed(channel: str, peer: can.BusABC) -> None:
    port = port_on(channel)
    async with using(port) as listener:
        sent = []
        for size in range(9):
            before = now()
            sent.append(order(SRT | size, bytes(range(size))))
            port.transmit(sent[-1])
            await listener.until(lambda: len(listener.outcomes) == len(sent))
            assert before - MS <= listener.instants[-1] <= now()  # python-can's stamps are floats of UTC
        assert listener.outcomes == [(Mailbox.SRT, Outcome.SENT)] * 9
        for size in range(9):
            message = peer.recv(GUARD)
            assert message is not None
            assert (message.arbitration_id, bytes(message.data)) == (SRT | size, bytes(range(size)))
            assert message.is_extended_id
    assert (listener.frames, listener.states) == ([], ["up"])


async def test_frames_come_in(channel: str, peer: can.BusABC) -> None:
    async with using(port_on(channel)) as listener:
        before = now()
        for size in range(9):
            peer.send(can.Message(arbitration_id=SRT | size, data=bytes(range(size))))
        await listener.until(lambda: listener.has(9))
        assert listener.frames == [Frame(SRT | size, bytes(range(size))) for size in range(9)]
        assert all(before - MS <= stamp <= now() for stamp in listener.stamps)


async def test_other_kinds_of_frames(channel: str, peer: can.BusABC) -> None:
    port = port_on(channel)
    port.set_filters(None)
    async with using(port) as listener:
        peer.send(can.Message(arbitration_id=1, is_extended_id=False, data=b"ab"))
        peer.send(can.Message(arbitration_id=2, is_remote_frame=True, dlc=4))
        peer.send(can.Message(arbitration_id=3, is_error_frame=True))
        peer.send(can.Message(arbitration_id=4, is_fd=True))
        peer.send(can.Message(arbitration_id=5))
        await listener.until(lambda: listener.frames)
        assert (listener.frames, listener.faults) == ([Frame(5, b"")], ["bus error"])
        assert listener.others == [OtherFrame(1, b"ab"), OtherFrame(2, b"", True, 4)]


async def test_only_what_is_needed(channel: str, peer: can.BusABC) -> None:
    port = port_on(channel)
    port.set_filters([(SRT, 0x1FFFFFFF)])
    async with using(port) as listener:
        port.transmit(order())  # once it is confirmed, so is the filter before it
        await listener.until(lambda: listener.outcomes)
        for identifier in (SRT | 1, SRT, SRT | 2, SRT):
            peer.send(can.Message(arbitration_id=identifier))
        await listener.until(lambda: listener.has(2))
        assert listener.frames == [Frame(SRT, b"")] * 2


async def test_a_stamp_by_another_clock_is_not_used(channel: str, peer: can.BusABC) -> None:
    """Adapters count from when they were plugged in."""
    other = can.Bus(interface="virtual", channel=channel, preserve_timestamps=True)
    async with using(port_on(channel)) as listener:
        before = now()
        other.send(can.Message(arbitration_id=1, timestamp=12.5))
        await listener.until(lambda: listener.frames)
        assert before <= listener.stamps[0] <= now()
    other.shutdown()


async def test_waiting_frames(channel: str, peer: can.BusABC) -> None:
    port = port_on(channel)
    async with using(port) as listener:
        port.transmit(order(last=-1))
        await listener.until(lambda: listener.outcomes)
        port.transmit(order(wait=3600_000 * MS))
        port.withdraw(Withdraw(Mailbox.SRT))
        assert listener.outcomes == [(Mailbox.SRT, Outcome.LATE)] * 2
        sent = order(wait=20 * MS)
        port.transmit(sent)
        await listener.until(lambda: len(listener.outcomes) == 3)
        assert listener.outcomes[-1] == (Mailbox.SRT, Outcome.SENT)
    port.transmit(order())
    port.withdraw(Withdraw(Mailbox.SRT))
    port.set_filters([])


async def test_an_interface_that_shows_no_own_frames(
    channel: str, peer: can.BusABC, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A frame counts as sent when the driver has it."""
    monkeypatch.setattr(pythoncan, "ECHO_ON_REQUEST", frozenset[str]())
    port = port_on(channel)
    async with using(port) as listener:
        port.transmit(order())
        await listener.until(lambda: listener.outcomes)
        assert listener.outcomes == [(Mailbox.SRT, Outcome.SENT)]
        assert peer.recv(GUARD) is not None


# What goes wrong


class Broken:
    """Stands for `can.Bus`: each call has the next of these behaviours."""

    def __init__(self, *behaviours: Exception | tuple[str, Exception]) -> None:
        self._behaviours = iter(behaviours)
        self.made: list[Any] = []

    def __call__(self, *_: object, **options: Any) -> can.BusABC:
        behaviour = next(self._behaviours, None)
        if isinstance(behaviour, Exception):
            raise behaviour
        bus: can.BusABC = _VirtualBus(**{name: options[name] for name in ("channel", "receive_own_messages")})
        if behaviour is not None:
            setattr(bus, behaviour[0], Mock(side_effect=behaviour[1]))
        self.made.append(bus)
        return bus


_VirtualBus = can.interface._get_class_for_interface("virtual")


async def test_the_cause_is_reported_too(channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    error = can.CanInitializationError("could not configure socket")
    error.__cause__ = OSError(22, "Invalid argument")
    monkeypatch.setattr(can, "Bus", Broken(error))
    async with using(port_on(channel)) as listener:
        assert listener.states == ["waits: could not configure socket ([Errno 22] Invalid argument)"]


async def test_it_waits_until_it_can_be_opened(channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(can, "Bus", Broken(can.CanInitializationError("no adapter"), OSError(19, "No such device")))
    async with using(port_on(channel)) as listener:
        await listener.until(lambda: listener.states[-1] == "up")
        assert listener.states == [
            "waits: no adapter",
            "waits: [Errno 19] No such device",
            "up",
        ]


async def test_an_adapter_that_is_not_plugged_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """pyserial's text, which python-can repeats, has the device and the reason twice."""
    missing = can.CanInitializationError("[Errno 2] could not open port /dev/ttyACM97: [Errno 2] No such file")
    missing.__cause__ = serial.SerialException(2, "could not open port /dev/ttyACM97: [Errno 2] No such file")
    denied = serial.SerialException(13, "could not open port /dev/ttyACM97: [Errno 13] Permission denied")
    monkeypatch.setattr(can, "Bus", Broken(missing, denied))
    async with using(PythonCanPort("slcan", "/dev/ttyACM97@115200", BITRATE)) as listener:
        await listener.until(lambda: len(listener.states) == 2)
        assert listener.states == [
            "waits: /dev/ttyACM97 is not there: plug it in (ls /dev/serial/by-id)",
            "waits: /dev/ttyACM97: permission denied; add yourself to its group: sudo usermod -aG dialout $USER",
        ]


@pytest.mark.parametrize("method", ["send", "recv"])
async def test_it_is_opened_again_when_it_failed(method: str, channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = Broken((method, can.CanOperationError("unplugged")))
    monkeypatch.setattr(can, "Bus", broken)
    port = port_on(channel)
    async with using(port) as listener:
        port.transmit(order())
        await listener.until(lambda: len(listener.states) == 3)
        assert listener.states == ["up", "down: unplugged", "up"]
        port.transmit(order(SRT | 1))
        await listener.until(lambda: listener.outcomes)
    assert [bus._open for bus in broken.made] == [False, False]


async def test_a_frame_that_was_not_sent_in_time(channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It may have been sent all the same."""
    monkeypatch.setattr(can, "Bus", Broken(("send", can.CanTimeoutError("full"))))
    port = port_on(channel)
    async with using(port) as listener:
        port.transmit(order())
        await listener.until(lambda: listener.outcomes)
        assert (listener.outcomes, listener.states) == ([(Mailbox.SRT, Outcome.UNKNOWN)], ["up"])


@pytest.mark.parametrize(
    "error",
    [can.CanInterfaceNotImplementedError("no driver"), ValueError("no bit rate"), TypeError("no option")],
    ids=str,
)
async def test_what_waiting_does_not_mend(error: Exception, channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(can, "Bus", Broken(error))
    with pytest.raises(TransportError, match=f"rtcan:virtual:{channel}: no ") as caught:
        await port_on(channel).run(RecordingListener(), lambda: None)
    assert caught.value.__cause__ is error


async def test_a_driver_that_lacks_its_library(channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """python-can's interface to Kvaser then lacks the functions that it calls."""
    monkeypatch.setattr(can, "Bus", Broken(NameError("name 'canGetNumberOfChannels' is not defined")))
    with pytest.raises(TransportError, match=r"the driver of virtual does not work here: is it installed\?"):
        await port_on(channel).run(RecordingListener(), lambda: None)


def test_an_unknown_interface() -> None:
    with pytest.raises(TransportError, match=r"no interface 'nosuch'; it knows: .*virtual"):
        PythonCanPort("nosuch", "x", BITRATE)


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("rtcan:slcan", "lacks the channel: rtcan:slcan:/dev/ttyACM0"),
        ("rtcan:socketcan", "rtcan:socketcan:can0"),
        ("rtcan:", "lacks the CAN interface"),
        ("rtcan:can0,priority=abc", "give a number of 0 to 255"),
        ("rtcan:can0,id=256", "give a number of 1 to 255"),
        ("rtcan:can0,bitrate=fast", "whole nanoseconds"),
    ],
)
def test_invalid_urls(url: str, message: str) -> None:
    with pytest.raises(TransportError, match=message):
        open_transport(url)


def test_all_interfaces_of_python_can_are_known_by_name() -> None:
    assert set(can.interfaces.BACKENDS) <= INTERFACES


def test_without_python_can(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "can", None)
    with pytest.raises(TransportError, match=r"pip install 'r2p\[can\]'"):
        PythonCanPort("virtual", "x", BITRATE)


def test_a_pc_is_no_master_of_short_slots() -> None:
    with pytest.raises(TransportError, match=r"can't be the master with slots of 166 us.*slots=20,cycle=10ms"):
        open_transport("rtcan:virtual:x?priority=1")
    open_transport("rtcan:virtual:x?priority=1&slots=20&cycle=10ms")


async def test_a_frame_that_raises_does_not_stop_the_others(
    channel: str, peer: can.BusABC, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = port_on(channel)
    async with using(port) as listener:
        monkeypatch.setattr(listener, "on_frame", once(listener.on_frame))
        for number in range(3):
            peer.send(can.Message(arbitration_id=SRT | number, is_extended_id=True))
        await listener.until(lambda: listener.has(2))
        assert ([frame.id for frame in listener.frames], listener.faults) == (
            [SRT | 1, SRT | 2],
            ["internal error: injected"],
        )
