"""The kernel's CAN interfaces, their state and its changes, by rtnetlink. Read-only.

Unlike `socketcan`, this file can be imported on any system, for `r2p doctor`.
"""

import asyncio
import contextlib
import socket
import struct
from collections.abc import Iterator
from typing import Self

import msgspec

BUS_OFF = "bus-off"
STATES = ("error-active", "error-warning", "error-passive", BUS_OFF, "stopped", "sleeping")
"""States of a controller, by the kernel's number."""

ARPHRD_CAN = 280  # linux/if_arp.h
CTRLMODES = {
    0x1: "loopback",
    0x2: "listen-only",
    0x4: "triple-sampling",
    0x8: "one-shot",
    0x10: "berr-reporting",
    0x20: "fd",
    0x40: "presume-ack",
}

_GETLINK, _NEWLINK, _ERROR, _DUMP_DONE = 18, 16, 2, 3  # message types
_REQUEST_ALL = 0x301  # flags NLM_F_REQUEST and NLM_F_DUMP
_LINK_GROUP = 1  # RTMGRP_LINK: multicast group that gets every change of an interface
_IFNAME, _LINKINFO = 3, 18  # attributes of a link
_KIND, _DATA = 1, 2  # ... of its LINKINFO
_BITTIMING, _STATE, _CTRLMODE, _RESTART_MS, _BERR_COUNTER = 1, 4, 5, 6, 8  # ... of the DATA of a CAN interface
_IFF_UP = 1
_HEADER = struct.Struct("=IHHII")  # length, type, flags, sequence, sender
_LINK = struct.Struct("=BxHiII")  # family, type, index, flags, change
_ATTRIBUTE = struct.Struct("=HH")  # length, type
_NESTED = 0x3FFF  # the upper two bits of an attribute's type are flags
_READ_MAX = 1 << 16  # bytes: more than the kernel puts into one datagram


class Interface(msgspec.Struct, frozen=True):
    """A CAN interface. Values that its driver does not report are None or empty; a virtual one reports nothing."""

    name: str
    kind: str  # "can", "vcan", "vxcan", "slcan" ...
    up: bool
    state: str = ""  # of STATES
    bitrate: int | None = None  # bit/s
    modes: frozenset[str] = frozenset()  # of CTRLMODES
    restart_ms: int | None = None  # after bus-off; 0: it does not restart by itself
    errors: tuple[int, int] | None = None  # the controller's counters of transmit and receive errors

    @property
    def one_shot(self) -> bool:
        """Return whether the controller tries each frame once, not again after a lost arbitration or an error."""
        return "one-shot" in self.modes

    @property
    def problem(self) -> str:
        """The reason why the interface can't be used, and what to do; empty if it can."""
        if not self.up:
            return f"{self.name} is down: {self.command_up()}"
        if self.state == BUS_OFF and self.restart_ms:
            return f"{self.name} is in bus-off, and restarts every {self.restart_ms} ms"
        if self.state == BUS_OFF:
            return f"{self.name} is in bus-off: sudo ip link set {self.name} type can restart"
        return ""

    def command_up(self) -> str:
        """The shell command that brings the interface up."""
        up = f"sudo ip link set {self.name} up"
        if self.kind in ("", "can"):
            return f"{up} type can bitrate {self.bitrate or 1_000_000} one-shot on restart-ms 100"
        return up


def find_interface(name: str) -> Interface | None:
    """Return the CAN interface of this name; None if no such interface exists, or it is not for CAN."""
    return next((each for each in list_interfaces() if each.name == name), None)


def list_interfaces() -> list[Interface]:
    """List all CAN interfaces. Raises OSError if the kernel has no rtnetlink."""
    found: list[Interface] = []
    request = _HEADER.pack(_HEADER.size + _LINK.size, _GETLINK, _REQUEST_ALL, 1, 0) + _LINK.pack(0, 0, 0, 0, 0)
    with _rtnetlink() as netlink:
        netlink.send(request)
        while True:
            for kind, body in _split_messages(netlink.recv(_READ_MAX)):
                if kind == _DUMP_DONE:
                    return found
                if kind == _ERROR:
                    error = struct.unpack_from("=i", body)[0]  # in the byte order of this machine, as all of netlink
                    raise OSError(-error, "rtnetlink")
                interface = _parse_interface(body) if kind == _NEWLINK else None
                if interface is not None:
                    found.append(interface)


def _rtnetlink(flags: int = 0) -> socket.socket:
    return socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC | flags, socket.NETLINK_ROUTE)


def _split_messages(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Split what a netlink socket received into the types and contents of its messages."""
    while len(data) >= _HEADER.size:
        length, kind, *_ = _HEADER.unpack_from(data)
        if length < _HEADER.size:
            return
        yield kind, data[_HEADER.size : length]
        data = data[_aligned(length) :]


def _parse_interface(body: bytes) -> Interface | None:
    """Parse the interface that a link message describes; None if it is not for CAN."""
    _, kind, _, flags, _ = _LINK.unpack_from(body)
    if kind != ARPHRD_CAN:
        return None
    link = _attributes(body[_LINK.size :])
    info = _attributes(link.get(_LINKINFO, b""))
    can = _attributes(info.get(_DATA, b""))
    bitrate, state = _u32(can.get(_BITTIMING)), _u32(can.get(_STATE))
    modes = _u32(can.get(_CTRLMODE), index=1) or 0  # struct can_ctrlmode: at 0 is a mask, for requests
    errors = can.get(_BERR_COUNTER, b"")
    return Interface(
        name=_text(link.get(_IFNAME, b"")),
        kind=_text(info.get(_KIND, b"")),
        up=bool(flags & _IFF_UP),
        state=STATES[state] if state is not None and state < len(STATES) else "",
        bitrate=bitrate if bitrate and bitrate != 0xFFFF_FFFF else None,  # slcan's driver reports an unknown one so
        modes=frozenset(name for bit, name in CTRLMODES.items() if modes & bit),
        restart_ms=_u32(can.get(_RESTART_MS)),
        errors=struct.unpack("=HH", errors) if len(errors) == 4 else None,
    )


def _attributes(data: bytes) -> dict[int, bytes]:
    found: dict[int, bytes] = {}
    while len(data) >= _ATTRIBUTE.size:
        length, kind = _ATTRIBUTE.unpack_from(data)
        if length < _ATTRIBUTE.size:
            break
        found[kind & _NESTED] = data[_ATTRIBUTE.size : length]
        data = data[_aligned(length) :]
    return found


def _aligned(length: int) -> int:
    return length + 3 & ~3


def _u32(data: bytes | None, index: int = 0) -> int | None:
    """Return the 32-bit number at this index of an attribute; None if the attribute is missing or too short."""
    if data is None or len(data) < 4 * (index + 1):
        return None
    number: int = struct.unpack_from("=I", data, 4 * index)[0]
    return number


def _text(data: bytes) -> str:
    return data.rstrip(b"\0").decode("ascii", "replace")


class InterfaceWatch:
    """Notices changes of any network interface while its `async with` block runs."""

    def __init__(self) -> None:
        self._changed = asyncio.Event()
        self._netlink: socket.socket | None = None

    async def __aenter__(self) -> Self:
        with contextlib.suppress(OSError):  # without netlink, `wait` always takes its whole time-out
            self._netlink = _rtnetlink(socket.SOCK_NONBLOCK)
            self._netlink.bind((0, _LINK_GROUP))
            asyncio.get_running_loop().add_reader(self._netlink, self._readable, self._netlink)
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._netlink is not None:
            asyncio.get_running_loop().remove_reader(self._netlink)
            self._netlink.close()

    async def wait(self, timeout: float) -> None:
        """Wait until something has changed since the last call, at most `timeout` seconds."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                await self._changed.wait()
        self._changed.clear()

    def _readable(self, netlink: socket.socket) -> None:
        with contextlib.suppress(OSError):  # nothing left to read, or an overflow, which is a change as well
            while True:
                netlink.recv(_READ_MAX)
        self._changed.set()


def has_socketcan() -> bool:
    """Return whether this kernel has CAN sockets."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (AttributeError, OSError):
        return False
    return True
