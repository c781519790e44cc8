"""What the kernel reports of CAN interfaces; the messages are built here, as linux/if_link.h and can/netlink.h say."""

from __future__ import annotations

import errno
import socket
import struct
import sys

import pytest

if sys.platform != "linux":
    pytest.skip("rtnetlink is Linux's", allow_module_level=True)

from r2p.transports.can import netlink
from r2p.transports.can.netlink import CTRLMODES, Interface, _parse_interface, _split_messages


def attribute(kind: int, content: bytes) -> bytes:
    length = 4 + len(content)
    return struct.pack("=HH", length, kind) + content + bytes(-length % 4)


def words(*numbers: int) -> bytes:
    return struct.pack(f"={len(numbers)}I", *numbers)


def link(name: str, *attributes: bytes, kind: int = 280, up: bool = True) -> bytes:
    return struct.pack("=BxHiII", 0, kind, 3, up, 0) + attribute(3, name.encode() + b"\0") + b"".join(attributes)


def can(*data: bytes, kind: bytes = b"can\0") -> bytes:
    nested = 0x8000
    return attribute(18 | nested, attribute(1, kind) + attribute(2 | nested, b"".join(data)))


def test_a_controller() -> None:
    body = link(
        "can0",
        attribute(13, words(10)),  # the length of the queue
        can(
            attribute(1, words(500_000, 875, 125, 6, 7, 2, 1, 8)),
            attribute(2, b"mcp251x".ljust(16, b"\0") + words(3, 16, 2, 8, 4, 1, 64, 1)),
            attribute(4, words(1)),
            attribute(5, words(0xFFFF_FFFF, 0x8 | 0x10)),
            attribute(6, words(100)),
            attribute(8, struct.pack("=HH", 96, 3)),
        ),
    )
    interface = Interface(
        "can0",
        "can",
        up=True,
        state="error-warning",
        bitrate=500_000,
        modes=frozenset({"one-shot", "berr-reporting"}),
        restart_ms=100,
        errors=(96, 3),
    )
    assert _parse_interface(body) == interface
    assert interface.one_shot
    assert interface.problem == ""


def test_what_is_not_reported() -> None:
    assert _parse_interface(link("vcan0", can(kind=b"vcan\0"))) == Interface("vcan0", "vcan", up=True)
    assert _parse_interface(link("odd0", up=False)) == Interface("odd0", "", up=False)
    assert _parse_interface(
        link("slcan0", can(attribute(1, words(0xFFFF_FFFF, 0, 0, 0, 0, 0, 0, 0)), kind=b"slcan\0"))
    ) == Interface("slcan0", "slcan", up=True)
    assert _parse_interface(link("eth0", kind=1)) is None


@pytest.mark.parametrize("bit", CTRLMODES)
def test_modes(bit: int) -> None:
    interface = _parse_interface(link("can0", can(attribute(5, words(0, bit | 0x8000_0000)))))
    assert interface is not None
    assert interface.modes == {CTRLMODES[bit]}


def test_a_cut_message_is_no_disaster() -> None:
    body = link("can0", can(attribute(4, words(3))))
    for end in range(16, len(body)):
        interface = _parse_interface(body[:end])
        assert interface is not None
        assert interface.state in ("", "bus-off")


@pytest.mark.parametrize(
    ("interface", "problem"),
    [
        (Interface("can0", "can", up=False), "can0 is down: sudo ip link set can0 up type can bitrate 1000000"),
        (Interface("can0", "can", up=False, bitrate=250_000), "bitrate 250000"),
        (Interface("vcan0", "vcan", up=False), "vcan0 is down: sudo ip link set vcan0 up"),
        (
            Interface("can0", "can", up=True, state="bus-off"),
            "can0 is in bus-off: sudo ip link set can0 type can restart",
        ),
        (
            Interface("can0", "can", up=True, state="bus-off", restart_ms=100),
            "can0 is in bus-off, and restarts every 100 ms",
        ),
        (Interface("can0", "can", up=True, state="error-passive"), ""),
    ],
)
def test_problem(interface: Interface, problem: str) -> None:
    assert problem in interface.problem
    assert bool(interface.problem) == bool(problem)


def test_messages_one_after_the_other() -> None:
    data = b"".join(
        struct.pack("=IHHII", 16 + len(body), kind, 0, 1, 0) + body + bytes(-len(body) % 4)
        for kind, body in [(16, b"abc"), (3, b""), (2, b"defgh")]
    )
    assert list(_split_messages(data)) == [(16, b"abc"), (3, b""), (2, b"defgh")]
    assert list(_split_messages(data[:10])) == []
    assert list(_split_messages(bytes(20))) == []


def test_an_error_of_the_kernel_is_an_os_error(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, kernel = socket.socketpair()
    body = struct.pack("=i", -errno.EPERM)  # in the byte order of the machine, like all numbers of netlink
    kernel.send(struct.pack("=IHHII", 16 + len(body), 2, 0, 1, 0) + body)
    monkeypatch.setattr(netlink, "_rtnetlink", lambda: ours)
    with kernel, pytest.raises(OSError, match="rtnetlink") as refused:
        netlink.list_interfaces()
    assert refused.value.errno == errno.EPERM
