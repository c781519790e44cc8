"""The port to SocketCAN, beside can-utils and bare sockets."""

from __future__ import annotations

import contextlib
import socket
import struct
import subprocess
from functools import partial
from typing import TYPE_CHECKING

import pytest

from r2p.codecs.can_bits import Frame, OtherFrame
from r2p.errors import TransportError
from r2p.protocols.can_orders import Mailbox, Outcome, Transmit, Withdraw
from r2p.transports.can import netlink, socketcan
from r2p.transports.can.socketcan import SocketCanPort
from r2p.units import NEVER
from tests.can.rig import Candump, RecordingListener, add, cangen, cansend, ip, new_name, now, port_on

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

pytestmark = [pytest.mark.can, pytest.mark.anyio]

MS = 1_000_000
HRT, SRT, NRT = (laxity << 23 | 0x0242 << 7 for laxity in (0, 10, 63))


def order(
    identifier: int = SRT, data: bytes = b"", *, mailbox: Mailbox = Mailbox.SRT, wait: int = 0, last: int = NEVER
) -> Transmit:
    """A frame that may start in `wait` ns, and within `last` ns."""
    begin = now()
    return Transmit(Frame(identifier, data), mailbox, begin + wait, NEVER if last == NEVER else begin + last)


def queue(name: str, *arguments: str) -> None:
    """Give an interface a queue that behaves badly, or take it away."""
    command, *options = arguments
    subprocess.run(("tc", "qdisc", command, "dev", name, "root", "netem", *options), check=True)


CLOCKS = 100 * MS
"""Ns that may pass between reading the clock of the stamps and reading the port's."""


async def test_candump_prints_what_is_sent(vcan: str) -> None:
    async with Candump(vcan) as candump, port_on(vcan) as (port, listener):
        sent = []
        for size in range(9):
            before = now()
            sent.append(order(SRT | size, bytes(range(size))))
            port.transmit(sent[-1])
            await listener.until(lambda: len(listener.outcomes) == len(sent))
            assert before - CLOCKS < listener.instants[-1] <= now()
        assert listener.outcomes == [(Mailbox.SRT, Outcome.SENT)] * 9
        for size in range(9):
            data = "".join(f" {byte:02X}" for byte in range(size))
            assert await candump.line() == f"{vcan} {SRT | size:08X} [{size}]{data}"
    assert listener.frames == []


async def test_what_cansend_sends_is_received(vcan: str) -> None:
    async with port_on(vcan) as (_, listener):
        before = now()
        for size in range(9):
            cansend(vcan, f"{SRT | size:08X}#{bytes(range(size)).hex()}")
        await listener.until(lambda: len(listener.frames) == 9)
        assert listener.frames == [Frame(SRT | size, bytes(range(size))) for size in range(9)]
        assert before - CLOCKS < listener.stamps[0]
        assert listener.stamps == sorted(listener.stamps)
        assert listener.stamps[-1] < now()


async def test_other_kinds_of_frames_are_ignored(vcan: str) -> None:
    """Short identifiers, and requests for frames."""
    async with port_on(vcan) as (_, listener):
        for frame in ("123#01", "00000123#R", "00000124#02"):
            cansend(vcan, frame)
        await listener.until(lambda: listener.frames)
        assert listener.frames == [Frame(0x124, b"\x02")]


async def test_own_frames_pass_the_filters_and_are_not_received(vcan: str) -> None:
    async with port_on(vcan) as (port, listener), port_on(vcan) as (_, other):
        port.transmit(order(SRT))
        await listener.until(lambda: listener.outcomes)
        await other.until(lambda: other.frames)
        cansend(vcan, f"{SRT:08X}#")  # the same frame, of another sender
        await listener.until(lambda: listener.frames)
        assert (listener.frames, listener.outcomes) == ([Frame(SRT, b"")], [(Mailbox.SRT, Outcome.SENT)])


async def test_an_alarm_does_not_outrun_frames_that_wait(vcan: str) -> None:
    """The loop was blocked: its timers are over, and the socket has more than a batch."""
    async with port_on(vcan) as (port, listener):
        seen: list[int] = []
        alarm = port.alarm(lambda: seen.append(len(listener.frames)))
        alarm.set(now())
        cangen(vcan, 300)
        await listener.until(lambda: listener.has(300) and seen)
        assert seen == [300]
        alarm.close()


async def test_the_kernel_filters(vcan: str) -> None:
    async with port_on(vcan) as (port, listener):
        port.set_filters([(0x0242 << 7, 0xFFFF << 7), (0x0100 << 7, 0xFF00 << 7)])
        sent = [0x0242, 0x0243, 0x0142, 0x0100, 0x0342, 0x0242]
        for message in sent:
            cansend(vcan, f"{63 << 23 | message << 7:08X}#AA")
        await listener.until(lambda: len(listener.frames) >= 4)
        assert [frame.id >> 7 & 0xFFFF for frame in listener.frames] == [0x0242, 0x0142, 0x0100, 0x0242]
        port.set_filters([])
        cansend(vcan, f"{0x0242 << 7:08X}#")
        port.set_filters(
            [(number << 7, 0xFFFF << 7) for number in range(600)]
        )  # more than the kernel takes: all of them
        cansend(vcan, f"{0x4444 << 7:08X}#")
        await listener.until(lambda: len(listener.frames) >= 5)
        assert listener.frames[4:] == [Frame(0x4444 << 7, b"")]


async def test_frames_that_rtcan_does_not_use_come_where_all_are_wanted(vcan: str) -> None:
    async with port_on(vcan) as (port, listener):
        cansend(vcan, "001#AA")
        port.set_filters(None)
        for text in ("123#0102", "7FF#R3", "1ABCDE00#R8", f"{SRT:08X}#BB"):
            cansend(vcan, text)
        await listener.until(lambda: listener.frames)
        assert listener.frames == [Frame(SRT, b"\xbb")]
        assert listener.others == [
            OtherFrame(0x123, b"\x01\x02"),
            OtherFrame(0x7FF, b"", False, 3),
            OtherFrame(0x1ABCDE00, b"", True, 8),
        ]


async def test_each_class_has_one_frame_on_its_way(vcan: str) -> None:
    async with Candump(vcan) as candump, port_on(vcan) as (port, listener):
        for mailbox in reversed(Mailbox):
            port.transmit(order(mailbox << 23, mailbox=mailbox))
        await listener.until(lambda: len(listener.outcomes) == 3)
        assert sorted(listener.outcomes) == [(mailbox, Outcome.SENT) for mailbox in Mailbox]
        assert {(await candump.line()).split()[1] for _ in Mailbox} == {"00000000", "00800000", "01000000"}


async def test_a_frame_is_sent_at_its_instant_and_not_before(vcan: str) -> None:
    async with port_on(vcan) as (port, listener):
        sent = order(wait=20 * MS)
        port.transmit(sent)
        await listener.until(lambda: listener.outcomes)
        assert listener.outcomes == [(Mailbox.SRT, Outcome.SENT)]
        assert listener.instants[0] >= sent.not_before - port.transmit_latency


async def test_a_frame_that_waits_can_be_withdrawn(vcan: str) -> None:
    async with port_on(vcan) as (port, listener):
        port.transmit(order(wait=3600_000 * MS))
        port.withdraw(Withdraw(Mailbox.NRT))  # there is none
        assert listener.outcomes == []
        port.withdraw(Withdraw(Mailbox.SRT))
        assert listener.outcomes == [(Mailbox.SRT, Outcome.LATE)]
        port.transmit(order())
        port.withdraw(Withdraw(Mailbox.SRT))  # too late: it was handed over
        await listener.until(lambda: len(listener.outcomes) == 2)
        assert listener.outcomes[1] == (Mailbox.SRT, Outcome.SENT)


async def test_a_frame_that_comes_too_late_is_not_sent(vcan: str) -> None:
    async with Candump(vcan) as candump, port_on(vcan) as (port, listener):
        port.transmit(order(last=-1))
        assert listener.outcomes == []
        await listener.until(lambda: listener.outcomes)
        assert listener.outcomes == [(Mailbox.SRT, Outcome.LATE)]
        port.transmit(order(SRT | 1))
        assert await candump.line() == f"{vcan} {SRT | 1:08X} [0]"


async def test_the_next_frame_goes_when_the_last_one_is_confirmed(vcan: str) -> None:
    async with Candump(vcan) as candump, port_on(vcan) as (port, listener):
        left = iter(range(1, 100))

        def again() -> None:
            number = next(left, None)
            if number is not None:
                port.transmit(order(SRT | number))

        listener.on_confirm = again
        port.transmit(order())
        await listener.until(lambda: len(listener.outcomes) == 100)
        assert [int((await candump.line()).split()[1], 16) & 0x7F for _ in range(100)] == list(range(100))


async def test_a_full_queue(vcan: str) -> None:
    """Frames wait until there is room, or it is too late."""
    queue(vcan, "add", "delay", "200s", "limit", "1")
    cansend(vcan, "00000001#")  # it takes all the room, for minutes
    async with port_on(vcan) as (port, listener):
        port.transmit(order(last=5 * MS))
        port.transmit(order(mailbox=Mailbox.NRT))
        await listener.until(lambda: listener.outcomes)
        assert listener.outcomes == [(Mailbox.SRT, Outcome.LATE)]
        queue(vcan, "delete")
        await listener.until(lambda: len(listener.outcomes) == 2)
        assert listener.outcomes[1] == (Mailbox.NRT, Outcome.SENT)


async def test_nothing_is_lost_in_bursts(vcan: str) -> None:
    async with port_on(vcan) as (_, listener):
        for burst in range(1, 11):
            cangen(vcan, 100)
            await listener.until(partial(listener.has, 100 * burst))
        assert [frame.data[0] for frame in listener.frames] == list(range(100)) * 10
        assert listener.faults == []


async def test_an_overrun_is_counted(vcan: str) -> None:
    """More comes while the loop is blocked than the queue holds."""
    async with port_on(vcan) as (_, listener):
        cangen(vcan, 5000)
        await listener.until(lambda: listener.has(1))
        cansend(vcan, "1FFFFFFF#")  # the kernel says with each frame how many it has dropped before
        await listener.until(lambda: listener.frames[-1] == Frame(0x1FFFFFFF, b""))
        dropped = listener.faults.count("receive queue full")
        assert dropped > 0
        assert len(listener.frames) + dropped == 5001


# The interface comes and goes


async def test_down_and_up_again(vcan: str) -> None:
    async with port_on(vcan) as (port, listener):
        ip("set", vcan, "down")
        await listener.until(lambda: len(listener.states) >= 3)
        assert listener.states[1:3] == [
            "down: the interface is down",
            f"waits: {vcan} is down: sudo ip link set {vcan} up",
        ]
        port.transmit(order())  # into the void
        ip("set", vcan, "up")
        await listener.until(lambda: listener.states[-1] == "up")
        assert listener.outcomes == []
        cansend(vcan, f"{SRT:08X}#")
        port.transmit(order())
        await listener.until(lambda: listener.frames and listener.outcomes)
        assert listener.outcomes == [(Mailbox.SRT, Outcome.SENT)]


async def test_deleted_and_made_again(vcan: str) -> None:
    async with port_on(vcan) as (port, listener):
        ip("delete", vcan)
        await listener.until(lambda: listener.states[-1].startswith("waits: "))
        assert listener.states[-1] == f"waits: {vcan} is not there: plug it in (ip link)"
        assert listener.states[1].startswith("down: the interface is ")
        add(vcan)
        await listener.until(lambda: listener.states[-1] == "up")
        port.transmit(order())
        await listener.until(lambda: listener.outcomes)


async def test_it_waits_for_an_interface_that_is_down(vcan: str) -> None:
    ip("set", vcan, "down")
    async with port_on(vcan) as (_, listener):
        assert listener.states == [f"waits: {vcan} is down: sudo ip link set {vcan} up"]
        ip("set", vcan, "up")
        await listener.until(lambda: listener.states[-1] == "up")


@pytest.mark.parametrize("name", ["nosuchcan", "lo"])
async def test_no_such_interface(name: str) -> None:
    with pytest.raises(TransportError, match=f"rtcan:{name}: no CAN interface has this name"):
        await SocketCanPort(name).run(NotImplemented, lambda: None)


# Error frames, which vcan sends like others


def error_frame(name: str, kind: int, data: bytes = bytes(8)) -> None:
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as sock:
        sock.bind((name,))
        sock.send(struct.pack("=IB3x8s", socket.CAN_ERR_FLAG | kind, 8, data))


async def test_error_frames_are_counted_by_kind(vcan: str) -> None:
    async with port_on(vcan) as (_, listener):
        cansend(vcan, "20000004#0010000000000000")
        error_frame(vcan, 0x2A, bytes((5, 0, 0x84, 0, 0, 0, 0, 0)))
        error_frame(vcan, 0x200)
        await listener.until(lambda: len(listener.faults) >= 5)
        assert listener.faults == [
            "error-passive (receive)",
            "arbitration lost",
            "no acknowledge",
            "stuff error",
            "error 0x200",
        ]
        assert (listener.frames, listener.states) == ([], ["up"])


async def test_bus_off(vcan: str) -> None:
    async with port_on(vcan) as (_, listener):
        error_frame(vcan, 0x40)
        await listener.until(
            lambda: (
                listener.states[-2:] == ["down: bus-off: too many errors, most often a wrong bit rate or a cable", "up"]
            )
        )
        assert listener.faults == ["bus-off"]


async def test_what_the_kernel_reports_of_interfaces(vcan: str) -> None:
    assert netlink.find_interface(vcan) == netlink.Interface(vcan, "vcan", up=True)
    ip("set", vcan, "down")
    there = netlink.find_interface(vcan)
    assert there is not None
    assert there.problem == f"{vcan} is down: sudo ip link set {vcan} up"
    assert netlink.find_interface("lo") is None


async def test_changes_of_interfaces_are_noticed() -> None:
    name = new_name()
    async with netlink.InterfaceWatch() as watch:
        add(name)
        await watch.wait(3600.0)
        ip("delete", name)
        await watch.wait(3600.0)


# What a driver reports of frames that were not sent. vcan confirms all of them, so the socket filters that out


@contextlib.asynccontextmanager
async def deaf_port(
    name: str, *, one_shot: bool, monkeypatch: pytest.MonkeyPatch
) -> AsyncIterator[tuple[SocketCanPort, RecordingListener]]:
    modes = frozenset({"one-shot"} if one_shot else ())
    monkeypatch.setattr(netlink, "find_interface", lambda _: netlink.Interface(name, "can", up=True, modes=modes))
    async with port_on(name) as (port, listener):
        assert port.one_shot is one_shot
        port.set_filters([])
        yield port, listener


@pytest.mark.parametrize(
    ("kind", "data", "outcome"), [(0x2, "05", Outcome.LOST), (0x20, "", Outcome.ERROR), (0x8, "000082", Outcome.ERROR)]
)
async def test_one_try_that_failed(
    kind: int, data: str, outcome: Outcome, vcan: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next frame is handed over only afterwards, so the error frame must be about this one."""
    monkeypatch.setattr(socketcan, "CONFIRM_TIMEOUT_ONE_SHOT_NS", 3600_000 * MS)
    async with Candump(vcan) as candump, deaf_port(vcan, one_shot=True, monkeypatch=monkeypatch) as (port, listener):
        port.transmit(order(SRT))
        port.transmit(order(NRT, mailbox=Mailbox.NRT))
        port.transmit(order(HRT, mailbox=Mailbox.HRT))
        for identifier in (SRT, HRT, NRT):
            assert (await candump.line()).split()[1] == f"{identifier:08X}"
            error_frame(vcan, kind, bytes.fromhex(data).ljust(8, b"\0"))
        await listener.until(lambda: len(listener.outcomes) == 3)
        assert listener.outcomes == [(mailbox, outcome) for mailbox in (Mailbox.SRT, Mailbox.HRT, Mailbox.NRT)]


async def test_errors_of_a_controller_that_goes_on_trying(vcan: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socketcan, "CONFIRM_TIMEOUT_NS", 20 * MS)
    async with deaf_port(vcan, one_shot=False, monkeypatch=monkeypatch) as (port, listener):
        port.transmit(order())
        error_frame(vcan, 0x2)
        error_frame(vcan, 0x20)
        await listener.until(lambda: len(listener.faults) == 2)
        await listener.until(lambda: listener.outcomes)
        assert listener.outcomes == [(Mailbox.SRT, Outcome.UNKNOWN)]


async def test_a_confirmation_that_comes_too_late_is_counted(vcan: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socketcan, "CONFIRM_TIMEOUT_NS", 0)
    async with port_on(vcan) as (port, listener):
        port.transmit(order())
        assert port._bus is not None
        port._bus._poll()
        await listener.until(lambda: listener.faults)
        assert (listener.outcomes, listener.faults) == ([(Mailbox.SRT, Outcome.UNKNOWN)], ["confirmed too late"])
